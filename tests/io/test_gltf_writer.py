"""The glTF writer: what our own reader gets back, and what the file says to other tools.

`test_khronos` puts its output before the Khronos validator.
"""

import io
import json
import struct
import threading
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from warpir.core import arrays
from warpir.io.assets import load_asset
from warpir.io.gltf import writer
from warpir.io.gltf.materials import HONOURED
from warpir.io.gltf.writer import write_glb
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import camera_from_fov

IDENTITY = np.eye(4)
# cos and sin of an angle that was taken apart and put together again in float64.
TRANSFORM_ATOL = 1e-14


def noise(shape: tuple[int, ...], opaque: bool = False) -> np.ndarray:
    codes = np.random.default_rng(len(shape)).integers(0, 256, shape, dtype=np.uint8)
    if opaque:
        codes[..., 3] = 255
    return codes


def patch(count: int, material: int, full: bool = True) -> Primitive:
    """Return a strip of ``count`` vertices with every attribute, or with none."""
    rng = np.random.default_rng(count)

    def unit(width: int) -> np.ndarray:
        vectors = rng.normal(size=(count, width))
        return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)

    first = np.arange(count - 2, dtype=np.int32)
    return Primitive(
        positions=rng.uniform(-1, 2, (count, 3)).astype(np.float32).astype(np.float64),
        indices=np.stack([first, first + 1, first + 2], axis=1),
        material=material,
        normals=unit(3) if full else None,
        tangents=np.column_stack([unit(3), np.where(np.arange(count) % 2, 1, -1)]).astype("f")
        if full
        else None,
        uv0=rng.uniform(-2, 2, (count, 2)).astype("f") if full else None,
        uv1=rng.uniform(0, 1, (count, 2)).astype("f") if full else None,
        colors=rng.uniform(0, 1, (count, 4)).astype("f") if full else None,
    )


TURNED = (np.cos(0.3) * 2.0, np.sin(0.3) * 3.0, 0.1, -np.sin(0.3) * 2.0, np.cos(0.3) * 3.0, 0.2)
PLAIN = Material(
    name="plain",
    base_color=(0.125, 0.3, 0.7),
    alpha=0.25,
    metallic=0.3,
    roughness=0.6,
    emission=(7.0, 0.1, 0.0),
    alpha_mode="MASK",
    alpha_cutoff=0.3,
    double_sided=True,
    normal_scale=0.5,
    base_color_texture=TextureSlot(0, 1),
    metallic_roughness_texture=TextureSlot(1, 0, TURNED),
    normal_texture=TextureSlot(2),
    emission_texture=TextureSlot(0, 0, (-2.0, 0.0, 0.5, 0.0, 3.0, -1.0)),
)
EXTENDED: dict[str, tuple[Material, dict[str, Any]]] = {
    "KHR_materials_ior": (Material(name="m", ior=1.33), {"ior": 1.33}),
    "KHR_materials_specular": (
        Material(
            name="m", specular=0.5, specular_color=(0.5, 1.0, 2.0),
            specular_texture=TextureSlot(0), specular_color_texture=TextureSlot(1),
        ),
        {
            "specularFactor": 0.5, "specularColorFactor": [0.5, 1.0, 2.0],
            "specularTexture": {"index": 0}, "specularColorTexture": {"index": 1},
        },
    ),
    "KHR_materials_clearcoat": (
        Material(
            name="m", clearcoat=0.5, clearcoat_roughness=0.25, clearcoat_normal_scale=2.0,
            clearcoat_texture=TextureSlot(0), clearcoat_roughness_texture=TextureSlot(1),
            clearcoat_normal_texture=TextureSlot(2),
        ),
        {
            "clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.25,
            "clearcoatTexture": {"index": 0}, "clearcoatRoughnessTexture": {"index": 1},
            "clearcoatNormalTexture": {"index": 2, "scale": 2.0},
        },
    ),
    "KHR_materials_sheen": (
        Material(
            name="m", sheen_color=(0.5, 0.25, 1.0), sheen_roughness=0.75,
            sheen_color_texture=TextureSlot(0), sheen_roughness_texture=TextureSlot(1),
        ),
        {
            "sheenColorFactor": [0.5, 0.25, 1.0], "sheenRoughnessFactor": 0.75,
            "sheenColorTexture": {"index": 0}, "sheenRoughnessTexture": {"index": 1},
        },
    ),
    "KHR_materials_anisotropy": (
        Material(
            name="m", anisotropy=0.5, anisotropy_rotation=-0.75, anisotropy_texture=TextureSlot(1)
        ),
        {
            "anisotropyStrength": 0.5, "anisotropyRotation": -0.75,
            "anisotropyTexture": {"index": 1},
        },
    ),
    "KHR_materials_iridescence": (
        Material(
            name="m", iridescence=0.5, iridescence_ior=1.5, iridescence_thickness=(50.0, 750.0),
            iridescence_texture=TextureSlot(1), iridescence_thickness_texture=TextureSlot(2),
        ),
        {
            "iridescenceFactor": 0.5, "iridescenceIor": 1.5,
            "iridescenceThicknessMinimum": 50.0, "iridescenceThicknessMaximum": 750.0,
            "iridescenceTexture": {"index": 1}, "iridescenceThicknessTexture": {"index": 2},
        },
    ),
    "KHR_materials_transmission": (
        Material(name="m", transmission=0.5, transmission_texture=TextureSlot(0)),
        {"transmissionFactor": 0.5, "transmissionTexture": {"index": 0}},
    ),
}  # fmt: skip


def everything() -> Asset:
    """Return an asset of all attributes, wraps and slots that our reader has always known."""
    shared = noise((4, 8, 4))
    textures = (
        Texture(shared, "clamp", "mirror"),
        Texture(shared),
        Texture(noise((2, 2, 4), opaque=True), "mirror", "repeat"),
    )
    return Asset(
        "every thing", (patch(7, 0), patch(5, 1, full=False)), (PLAIN, Material(name="other")),
        textures, ("repaired: nothing",),
    )  # fmt: skip


def extended(material: Material) -> Asset:
    textures = tuple(Texture(noise((2, 4, 4), opaque=True)) for _ in range(3))
    return Asset("coated", (patch(6, 0),), (material,), textures)


def document(content: bytes) -> dict[str, Any]:
    """Return the JSON of a ``.glb``."""
    (length,) = struct.unpack_from("<I", content, 12)
    parsed: dict[str, Any] = json.loads(content[20 : 20 + length])
    return parsed


def read_back(folder: Path, content: bytes) -> Asset:
    path = folder / "written.glb"
    path.write_bytes(content)
    return load_asset(path)


def assert_same_slots(ours: Asset, theirs: Asset) -> None:
    """Assert that materials agree, and that each slot reads the same pixels in the same way."""
    for a, b in zip(ours.materials, theirs.materials, strict=True):
        for one in fields(Material):
            x, y = getattr(a, one.name), getattr(b, one.name)
            if not isinstance(x, TextureSlot):
                assert x == y, one.name
                continue
            assert y is not None and x.uv_set == y.uv_set, one.name
            np.testing.assert_allclose(y.transform, x.transform, atol=TRANSFORM_ATOL)
            p, q = ours.textures[x.texture], theirs.textures[y.texture]
            np.testing.assert_array_equal(q.pixels, p.pixels)
            assert (q.wrap_u, q.wrap_v) == (p.wrap_u, p.wrap_v)


def test_what_is_written_reads_back_exactly(tmp_path: Path) -> None:
    asset = everything()
    theirs = read_back(tmp_path, write_glb(asset, IDENTITY))
    for a, b in zip(asset.primitives, theirs.primitives, strict=True):
        for one in fields(Primitive):
            x, y = getattr(a, one.name), getattr(b, one.name)
            assert (x is None) == (y is None), one.name
            if x is not None:
                np.testing.assert_array_equal(y, x, one.name)
    assert_same_slots(asset, theirs)


@pytest.mark.parametrize("name", EXTENDED)
def test_material_extension_is_stated(name: str) -> None:
    """Each extension holds what differs from its defaults, and is listed as used."""
    material, members = EXTENDED[name]
    written = document(write_glb(extended(material), IDENTITY))
    assert written["materials"][0]["extensions"] == {name: members}
    assert written["extensionsUsed"] == [name]


@pytest.mark.parametrize("name", sorted(EXTENDED.keys() & HONOURED))
def test_material_extension_reads_back(name: str, tmp_path: Path) -> None:
    asset = extended(EXTENDED[name][0])
    assert_same_slots(asset, read_back(tmp_path, write_glb(asset, IDENTITY)))


def test_solid_glass_reads_back(tmp_path: Path) -> None:
    """Transmission and volume are two extensions of one material."""
    glass = Material(
        name="m", transmission=0.5, thickness=0.25, attenuation_distance=0.125,
        attenuation_color=(0.5, 0.25, 1.0), ior=1.25,
    )  # fmt: skip
    written = write_glb(extended(glass), IDENTITY)
    assert document(written)["materials"][0]["extensions"]["KHR_materials_volume"] == {
        "thicknessFactor": 0.25, "attenuationDistance": 0.125,
        "attenuationColor": [0.5, 0.25, 1.0],
    }  # fmt: skip
    assert read_back(tmp_path, written).materials[0] == glass
    # The extension's distance is one of the world; ours is one of the asset, and grows with it.
    larger = write_glb(extended(glass), np.diag([4.0, 4.0, 4.0, 1.0]))
    (material,) = document(larger)["materials"]
    volume = material["extensions"]["KHR_materials_volume"]
    assert volume["attenuationDistance"] == 0.5 and volume["thicknessFactor"] == 0.25


def test_plain_asset_uses_no_extension() -> None:
    asset = Asset("plain", (patch(4, 0),), (Material(name="grey", emission=(0.5, 0.0, 0.0)),))
    written = document(write_glb(asset, IDENTITY))
    assert "extensionsUsed" not in written and "textures" not in written
    assert written["nodes"] == [{"name": "plain", "mesh": 0}]


def placed() -> np.ndarray:
    """Return a turn about a slanted axis, a scale and a shift."""
    axis = np.array([1.0, 2.0, 3.0]) / np.sqrt(14.0)
    cross = np.cross(np.eye(3), axis)
    matrix = np.eye(4)
    matrix[:3, :3] = 0.7 * (np.eye(3) + np.sin(2.0) * cross + (1.0 - np.cos(2.0)) * cross @ cross)
    matrix[:3, 3] = (1.0, -2.0, 3.0)
    return matrix


def test_object_stands_where_it_was_placed(tmp_path: Path) -> None:
    """The node carries the placement, in float64."""
    asset, matrix = everything(), placed()
    theirs = read_back(tmp_path, write_glb(asset, matrix))
    for a, b in zip(asset.primitives, theirs.primitives, strict=True):
        np.testing.assert_allclose(
            b.positions, a.positions @ matrix[:3, :3].T + matrix[:3, 3], atol=1e-14
        )


def test_object_far_from_its_origin_keeps_its_shape(tmp_path: Path) -> None:
    """A map's coordinates (10 km) would lose half a millimetre in float32; they lose none."""
    asset = everything()
    away = np.array([1.0e4, 0.0, -7.0e3])
    moved = tuple(replace(p, positions=p.positions + away) for p in asset.primitives)
    theirs = read_back(tmp_path, write_glb(replace(asset, primitives=moved), IDENTITY))
    for a, b in zip(moved, theirs.primitives, strict=True):
        np.testing.assert_allclose(b.positions, a.positions, rtol=0, atol=2e-7)


def test_camera_sees_what_the_photo_saw() -> None:
    """Field of view, aspect and pose project points like our camera, pixels not square."""
    camera = replace(camera_from_fov(640, 480, 50.0, -8.0, 1.6), fy=600.0, cx=320.0, cy=240.0)
    written = document(write_glb(everything(), IDENTITY, camera))
    assert written["scenes"] == [{"nodes": [0, 1]}]
    node = written["nodes"][1]
    c2w = np.reshape(node["matrix"], (4, 4)).T
    (entry,) = written["cameras"]
    lens = entry["perspective"]
    points = np.array([[0.3, 0.2, -4.0], [-1.0, 0.0, -6.0]])
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    # The projection matrix of the specification, then its window: y up, the picture 2 x 2.
    height = np.tan(lens["yfov"] / 2.0)
    x = local[:, 0] / -local[:, 2] / (height * lens["aspectRatio"])
    y = local[:, 1] / -local[:, 2] / height
    pixels = np.stack([(x + 1.0) * 320.0, (1.0 - y) * 240.0], axis=1)
    np.testing.assert_allclose(pixels, camera.project(points), atol=1e-9)
    assert "note" not in entry["extras"]


def test_camera_with_an_off_centre_principal_point_says_so() -> None:
    """What glTF cannot say stands in the extras."""
    camera = replace(camera_from_fov(640, 480, 50.0, 0.0, 1.6), cx=300.0)
    (entry,) = document(write_glb(everything(), IDENTITY, camera))["cameras"]
    assert "principal point" in entry["extras"]["note"]
    assert (entry["extras"]["cx"], entry["extras"]["w"]) == (300.0, 640)


def test_equal_images_are_written_once() -> None:
    """Textures that share pixels share the image, and opaque ones have no alpha channel."""
    content = write_glb(everything(), IDENTITY)
    written = document(content)
    assert [entry["source"] for entry in written["textures"]] == [0, 0, 1]
    modes = []
    binary = content[20 + struct.unpack_from("<I", content, 12)[0] + 8 :]
    for image in written["images"]:
        view = written["bufferViews"][image["bufferView"]]
        start = view["byteOffset"]
        encoded = binary[start : start + view["byteLength"]]
        modes.append(Image.open(io.BytesIO(encoded)).mode)
    assert modes == ["RGBA", "RGB"]


def test_layout_is_aligned_and_bounded() -> None:
    """Views start at multiples of four, positions state their bounds, lengths agree."""
    content = write_glb(everything(), IDENTITY)
    written = document(content)
    assert all(view["byteOffset"] % 4 == 0 for view in written["bufferViews"])
    position = written["accessors"][written["meshes"][0]["primitives"][0]["attributes"]["POSITION"]]
    points = everything().primitives[0].positions
    assert position["min"] == points.min(axis=0).tolist()
    assert position["max"] == points.max(axis=0).tolist()
    assert struct.unpack_from("<I", content, 8) == (len(content),)
    assert len(content) % 4 == 0


@pytest.mark.parametrize(("count", "component"), [(65535, 5123), (65536, 5125)])
def test_index_width_follows_the_vertex_count(count: int, component: int) -> None:
    """16 bits as long as no index is 65535, which restarts a strip."""
    positions = np.zeros((count, 3))
    positions[-1, 0] = positions[-2, 1] = 1.0
    triangle = np.array([[0, count - 1, count - 2]], dtype=np.int32)
    asset = Asset("wide", (Primitive(positions, triangle, 0),), (Material(),))
    written = document(write_glb(asset, IDENTITY))
    indices = written["accessors"][written["meshes"][0]["primitives"][0]["indices"]]
    assert indices["componentType"] == component


def test_textures_are_compressed_side_by_side(monkeypatch) -> None:
    both = threading.Barrier(2, timeout=20.0)

    def png(pixels: np.ndarray) -> bytes:
        both.wait()
        return pixels.tobytes()

    monkeypatch.setattr(arrays, "core_count", lambda: 2)
    monkeypatch.setattr(writer, "png", png)
    first, second = (np.full((1, 1, 4), k, np.uint8) for k in (1, 2))
    corner = Primitive(np.eye(3), np.array([[0, 1, 2]], np.int32), 0)
    textures = Texture(first), Texture(second), Texture(first)
    glb = write_glb(Asset("tile", (corner,), (Material(),), textures), np.eye(4))
    assert glb.index(first.tobytes()) < glb.index(second.tobytes())


def test_absent_coordinates_of_a_texture_are_zero(tmp_path: Path) -> None:
    """A texture without its coordinates reads texel zero, in the file as in our renderer."""
    bare = replace(patch(4, 0), uv0=None, uv1=None)
    asset = replace(extended(Material(base_color_texture=TextureSlot(0, 1))), primitives=(bare,))
    (theirs,) = read_back(tmp_path, write_glb(asset, IDENTITY)).primitives
    np.testing.assert_array_equal(theirs.uv0, np.zeros((4, 2)))
    np.testing.assert_array_equal(theirs.uv1, np.zeros((4, 2)))


def test_shear_of_coordinates_is_refused() -> None:
    """GlTF has no sheared texture coordinates, and nothing else is written instead."""
    slot = TextureSlot(0, 0, (1.0, 0.5, 0.0, 0.0, 1.0, 0.0))
    with pytest.raises(ValueError, match="'m': texture coordinates are sheared"):
        write_glb(extended(Material(name="m", base_color_texture=slot)), IDENTITY)


def test_equal_assets_give_equal_bytes() -> None:
    """Nothing in the file depends on the run."""
    camera = camera_from_fov(64, 48, 50.0, 0.0, 1.6)
    first, second = (write_glb(everything(), placed(), camera) for _ in range(2))
    assert first == second
