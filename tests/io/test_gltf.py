"""The glTF reader against a tiny correct file and named faults in it.

The ids are the rows of the project's interoperability (G) and fault (M) tables. Everything is
built in memory; the files of the development data are read where they exist.
"""

import json
import os
import struct
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from benchmarks.damage.mutations import places
from tests.builders.faults import assert_fails
from tests.builders.gltf_files import CODES, CORNERS, NORMALS, TWO, UVS, Builder, png
from tests.builders.image_files import png_header, write_image
from tests.builders.insertions import arguments
from tests.builders.refusals import unreadable
from tests.builders.shapes import box
from tests.development_data import MESHES, needs_shared
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.assets import load_asset
from warpir.io.gltf.nodes import from_trs
from warpir.io.gltf.reader import glass_notices, read_gltf
from warpir.io.meshes.asset_files import TextureDecoder
from warpir.scene.asset import Asset, Material, TextureSlot

TANGENTS = np.tile(np.array([1, 0, 0, 1], dtype="f"), (4, 1))

# Decoding c / 65535 and the like rounds once in float32.
FLOAT32_RTOL = 1e-6


def written(folder: Path, builder: Builder) -> Path:
    path = folder / "asset.glb"
    path.write_bytes(builder.glb())
    return path


def load(folder: Path, builder: Builder, **options: Any) -> Asset:
    return read_gltf(written(folder, builder), **options)


@pytest.fixture
def builder() -> Builder:
    """A correct file, to be changed."""
    return Builder()


fails = partial(unreadable, load_asset)
Plant = Callable[[Builder], object]
PRIMITIVE, SPARSE = "/meshes/0/primitives/0", "/accessors/0/sparse"


def fault(
    plant: Plant, reason: str, pointer: str = "", **fields: object
) -> tuple[Plant, str, str, dict[str, object]]:
    """What is planted; and of the error the reason, the start of the pointer, and fields."""
    return plant, reason, pointer, fields


def node(**members: Any) -> Plant:
    return lambda b: b.json["nodes"][0].update(members)


def set_accessor(index: int, **members: Any) -> Plant:
    return lambda b: b.json["accessors"][index].update(members)


def sparse(at: list[int], values: np.ndarray, code: str = "B", **members: Any) -> Plant:
    """Replace vertices ``at`` of POSITION by ``values``."""

    def plant(b: Builder) -> None:
        b.json["accessors"][0]["sparse"] = {
            "count": len(at),
            "indices": {
                "bufferView": b.view(np.array(at, code).tobytes()), "componentType": CODES[code]
            },
            "values": {"bufferView": b.view(values.astype("f").tobytes())},
        } | members  # fmt: skip

    return plant


ONE_ROW = np.full((1, 3), 9.0)


def zeros(b: Builder) -> None:
    """Ask for 24 GiB of zeros with one element replaced."""
    sparse([1], ONE_ROW)(b)
    b.json["accessors"][0].pop("bufferView")
    b.json["accessors"][0].update(count=10_000_000 * 3)
    b.primitive.pop("indices")


def instanced(**attributes: np.ndarray) -> Plant:
    """Place the square's mesh as EXT_mesh_gpu_instancing says."""

    def plant(b: Builder) -> None:
        b.json["extensionsUsed"] = b.json["extensionsRequired"] = ["EXT_mesh_gpu_instancing"]
        stored = {
            name: b.accessor(array, normalized=array.dtype.kind != "f")
            for name, array in attributes.items()
        }
        node(extensions={"EXT_mesh_gpu_instancing": {"attributes": stored}})(b)

    return plant


def poisoned(name: str, array: np.ndarray, bad: float) -> Plant:
    values = array.copy()
    values[2, 1] = bad
    return lambda b: b.attribute(name, values)


INSTANCING = "/nodes/0/extensions/EXT_mesh_gpu_instancing/attributes"

FAULTS = {
    "M3-G5-image-missing": fault(
        lambda b: b.base_color({"uri": "gone.png"}), "file.unreadable", "/images/0"),
    "M3-G5-image-corrupt": fault(
        lambda b: b.base_color({"bufferView": b.view(png()[:40])}), "texture.damaged", "/images/0"),
    "M3-G5-image-text": fault(
        lambda b: b.base_color({"bufferView": b.view(b"plain text")}),
        "texture.damaged", "/images/0"),
    "M3-G5-image-ktx2": fault(
        lambda b: b.base_color({"bufferView": b.view(b"\xabKTX 20\xbb\r\n\x1a\n" + bytes(64))}),
        "texture.format", "/images/0", found="KTX2"),
    "M6-G8-sparse-without-indices": fault(
        set_accessor(0, sparse={"count": 1}), "gltf.missing", f"{SPARSE}/indices"),
    "M6-G8-sparse-index-out-of-range": fault(
        sparse([4], ONE_ROW), "gltf.index_out_of_range", f"{SPARSE}/indices", found=4, limit=4),
    "M6-G8-sparse-indices-not-increasing": fault(
        sparse([2, 2], np.zeros((2, 3))), "gltf.sparse_order", f"{SPARSE}/indices"),
    "M6-G8-sparse-signed-indices": fault(
        sparse([1], ONE_ROW, "b"), "gltf.component_type", f"{SPARSE}/indices", found=5120),
    "M6-G8-sparse-values-too-short": fault(
        sparse([1, 2], ONE_ROW), "gltf.beyond_data", f"{SPARSE}/values", found=24, limit=12),
    "M6-G8-sparse-count-lies": fault(
        sparse([1], ONE_ROW, count=2**31),
        "gltf.beyond_data", f"{SPARSE}/indices", found=2147483648, limit=1),
    "M6-G8-sparse-NaN": fault(
        sparse([1], ONE_ROW * np.nan), "gltf.not_finite", "/accessors/0", found=1),
    "M17-G12-unknown-extension": fault(
        lambda b: b.json.update(extensionsRequired=["ACME_holograms"]),
        "gltf.extension", "/extensionsRequired", found="ACME_holograms"),
    "G14-M7-index-out-of-range": fault(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 1, 999], "H"))),
        "gltf.index_out_of_range", PRIMITIVE, found=999, limit=4),
    "M7-G14-index-restart-value": fault(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 1, 2**32 - 1], "I"))),
        "gltf.index_out_of_range", PRIMITIVE, found=4294967295, limit=4),
    "M7-G14-indices-float": fault(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 1, 2], "f"))),
        "gltf.component_type", PRIMITIVE),
    "G16-M10-cycle": fault(
        lambda b: b.json["nodes"].extend([{"children": [2]}, {"children": [1]}]),
        "gltf.cycle", "/", found=2),
    "M10-G16-self-child": fault(node(children=[0]), "gltf.cycle", "/", found=1),
    "G16-M10-two-parents": fault(
        lambda b: (node(children=[2])(b), b.json["nodes"].extend([{"children": [2]}, {}])),
        "gltf.two_parents", "/nodes/1", found=2),
    "M10-G16-same-child-twice": fault(
        lambda b: (node(children=[1, 1])(b), b.json["nodes"].append({})),
        "gltf.two_parents", "/nodes/0", found=1),
    "M10-G16-root-twice": fault(
        lambda b: b.json.update(scenes=[{"nodes": [0, 0]}]), "gltf.two_parents", "/scenes/0"),
    "G17-scene-out-of-range": fault(
        lambda b: b.json.update(scene=7), "gltf.index_out_of_range", "/", found=7, limit=1),
    "G17-scene-node-out-of-range": fault(
        lambda b: b.json.update(scenes=[{"nodes": [7]}]),
        "gltf.index_out_of_range", "/scenes/0", found=7, limit=1),
    "M12-G19-mode-7": fault(lambda b: b.primitive.update(mode=7), "gltf.range", PRIMITIVE, found=7),
    "M12-G19-empty-scene": fault(lambda b: b.json.update(scenes=[{}]), "mesh.nothing_to_render"),
    "M12-G19-no-nodes": fault(
        lambda b: [b.json.pop(key) for key in ("nodes", "scenes", "scene")],
        "mesh.nothing_to_render"),
    "G22-componentType-9999": fault(
        set_accessor(0, componentType=9999), "gltf.component_type", "/accessors/0", found=9999),
    "G22-child-99": fault(
        node(children=[99]), "gltf.index_out_of_range", "/nodes/0", found=99, limit=1),
    "G22-mesh-9": fault(node(mesh=9), "gltf.index_out_of_range", "/nodes/0", found=9, limit=1),
    "G22-mesh-is-text": fault(node(mesh="0"), "gltf.type", "/nodes/0"),
    "G22-mesh-is-true": fault(node(mesh=True), "gltf.type", "/nodes/0"),
    "G22-accessor-99": fault(
        lambda b: b.primitive["attributes"].update(POSITION=99),
        "gltf.index_out_of_range", PRIMITIVE, found=99, limit=4),
    "G22-no-position": fault(
        lambda b: b.primitive["attributes"].pop("POSITION"),
        "gltf.missing", "/meshes/0/primitives/0/attributes"),
    "G22-material-5": fault(
        lambda b: b.primitive.update(material=5),
        "gltf.index_out_of_range", PRIMITIVE, found=5, limit=1),
    "G22-view-too-long": fault(
        lambda b: b.json["bufferViews"][0].update(byteLength=1 << 20),
        "gltf.beyond_data", "/bufferViews/0", found=1048576, limit=140),
    "G22-buffer-too-long": fault(
        lambda b: b.json["buffers"][0].update(byteLength=1 << 20),
        "gltf.beyond_data", "/buffers/0", found=1048576, limit=140),
    "G22-wrong-type": fault(
        lambda b: b.attribute("POSITION", UVS), "gltf.type", "/accessors/4", found="VEC2"),
    "G22-counts-differ": fault(
        lambda b: b.attribute("NORMAL", NORMALS[:3]), "gltf.count", PRIMITIVE, found=3, limit=4),
    "G22-color-not-normalized": fault(
        lambda b: b.attribute("COLOR_0", np.full((4, 3), 9, "B")),
        "gltf.component_type", PRIMITIVE),
    "G22-asset-version-1": fault(
        lambda b: b.json.update(asset={"version": "1.0"}), "gltf.version", "/", found="1.0"),
    "G22-texCoord-2": fault(
        lambda b: b.base_color().update(texCoord=2),
        "gltf.uv_set", "/materials/0/pbrMetallicRoughness/baseColorTexture", found=2, limit=1),
    "M6-G23-count-2^31-no-view": fault(
        lambda b: (
            b.json["accessors"][0].pop("bufferView"),
            b.primitive.pop("indices"),
            set_accessor(0, count=40_000_000)(b),
        ),
        "gltf.missing", "/accessors/0"),
    "M6-G23-count-2^31-limit": fault(
        lambda b: (b.primitive.pop("indices"), set_accessor(0, count=2**31)(b)),
        "limit.triangles", found=715827882, limit=20000000),
    "M11-G25-zero-scale": fault(node(scale=[1, 0, 1]), "gltf.singular", "/nodes/0"),
    "M11-G25-zero-quaternion": fault(node(rotation=[0, 0, 0, 0]), "gltf.matrix", "/nodes/0"),
    "G28-M10-2^18-instances": fault(
        lambda b: b.json.update(nodes=[{"mesh": 0}] * 2**18),
        "limit.nodes", "/nodes", found=262144, limit=100000),
    "M10-G28-too-many-placed": fault(
        lambda b: (
            b.json["meshes"][0].update(primitives=[b.primitive] * 300),
            b.json.update(nodes=[{"mesh": 0}] * 300, scenes=[{"nodes": list(range(300))}])),
        "limit.instances", "/", found=65537, limit=65536),
    "M6-G23-sparse-zeros": fault(
        zeros, "gltf.too_large", "/accessors/0", found=360000000, limit=268435456),
    "M6-G23-normal-count-2^31": fault(
        set_accessor(1, count=2**31), "gltf.count", PRIMITIVE, found=2147483648, limit=4),
    "M10-G28-instances-without-attributes": fault(instanced(), "gltf.count", INSTANCING),
    "M10-G28-instances-unequal": fault(
        instanced(TRANSLATION=np.zeros((2, 3), "f"), SCALE=np.ones((3, 3), "f")),
        "gltf.count", INSTANCING),
    "M10-G28-instances-2^18": fault(
        instanced(TRANSLATION=np.zeros((2**18, 3), "f")),
        "limit.instances", INSTANCING, found=262144, limit=65536),
    "M10-G28-instances-of-two-nodes": fault(
        lambda b: (
            instanced(TRANSLATION=np.zeros((40_000, 3), "f"))(b),
            b.json["nodes"].append(b.json["nodes"][0]),
            b.json.update(scenes=[{"nodes": [0, 1]}]),
        ),
        "limit.instances", "/", found=80000, limit=65536),
    "M11-G25-instance-of-zero-scale": fault(
        instanced(SCALE=np.array([[1, 1, 1], [0, 1, 0]], "f")), "gltf.singular", "/nodes/0"),
    "M11-G25-instance-of-zero-quaternion": fault(
        instanced(ROTATION=np.zeros((1, 4), "f")), "gltf.matrix", INSTANCING),
    "M8-G15-instance-NaN": fault(
        instanced(TRANSLATION=np.full((1, 3), np.nan, "f")),
        "gltf.not_finite", "/accessors/4", found=1),
    "M6-past-the-buffer": fault(
        set_accessor(0, count=5), "gltf.beyond_data", "/accessors/0", found=60, limit=48),
    "M6-negative-offset": fault(
        set_accessor(0, byteOffset=-4), "gltf.range", "/accessors/0", found=-4, limit=0),
    "M6-view-negative-offset": fault(
        lambda b: b.json["bufferViews"][0].update(byteOffset=-4),
        "gltf.range", "/bufferViews/0", found=-4, limit=0),
    "M6-count-0": fault(set_accessor(0, count=0), "gltf.range", "/accessors/0", found=0, limit=1),
    "M11-scale-1e300": fault(node(scale=[1e300, 1, 1]), "gltf.transform_too_large", "/nodes/0"),
    "M11-positions-1e30": fault(
        lambda b: b.attribute("POSITION", CORNERS * np.float32(1e30)), "mesh.too_large"),
    "M11-singular-matrix": fault(
        node(matrix=[1, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "gltf.singular", "/nodes/0"),
    "M11-projective-matrix": fault(
        node(matrix=[1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "gltf.matrix", "/nodes/0"),
    "M11-matrix-and-trs": fault(
        node(matrix=np.eye(4).ravel().tolist(), scale=[1, 1, 1]), "gltf.matrix", "/nodes/0"),
    "M11-short-scale": fault(node(scale=[1, 1]), "gltf.type", "/nodes/0"),
    "M13-only-zero-area": fault(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 0, 1], "H"))),
        "mesh.nothing_to_render"),
    "M18-alphaMode": fault(
        lambda b: b.material.update(alphaMode="GLOW"), "gltf.range", "/materials/0", found="GLOW"),
    **{
        f"M17-G13-{name}": fault(
            lambda b, name=name: b.json.update(extensionsRequired=[name]),
            "gltf.extension", "/extensionsRequired", found=name)
        for name in (
            "KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression",
            "KHR_texture_basisu",
        )
    },
    **{
        f"M8-G15-{name}-{bad}": fault(poisoned(name, array, bad), "gltf.not_finite", "/accessors/")
        for name, array in {
            "POSITION": CORNERS, "NORMAL": NORMALS, "TEXCOORD_0": UVS, "TANGENT": TANGENTS,
            "COLOR_0": NORMALS,
        }.items()
        for bad in (np.nan, np.inf)
    },
    **{
        f"M12-G19-mode-{mode}-only": fault(
            lambda b, mode=mode: b.primitive.update(mode=mode), "mesh.nothing_to_render")
        for mode in (0, 1, 2, 3)
    },
    **{
        f"M6-stride-{stride}": fault(
            lambda b, stride=stride: b.json["bufferViews"][0].update(byteStride=stride),
            "gltf.stride", "/bufferViews/0", found=stride, limit=12)
        for stride in (0, 1)
    },
}  # fmt: skip


def planted(case: str, folder: Path) -> Path:
    """Write the correct file with a fault in it."""
    builder = Builder()
    FAULTS[case][0](builder)
    return written(folder, builder)


@pytest.mark.parametrize("case", FAULTS)
def test_fault_is_refused_with_its_pointer(case: str, tmp_path: Path) -> None:
    """The error has its reason, place and numbers, before anything large is allocated."""
    _, reason, pointer, fields = FAULTS[case]
    error = fails(planted(case, tmp_path))
    assert error.reason == reason
    assert error.what.startswith(pointer)
    assert str(error.fields.get("pointer", pointer)).startswith(pointer)
    assert fields.items() <= error.fields.items()


SENTENCES: dict[str, tuple[str, ...]] = {
    "M3-G5-image-missing": ("/images/0", "gone.png", "--missing-textures grey"),
    "M3-G5-image-corrupt": ("/images/0", "cannot be decoded"),
    "M3-G5-image-ktx2": ("/images/0", "KTX2", "PNG or JPEG"),
    "M6-G8-sparse-without-indices": ("/accessors/0/sparse/indices: componentType is missing",),
    "M6-G8-sparse-index-out-of-range": ("/accessors/0/sparse/indices: index 4, but 4 elements",),
    "M6-G8-sparse-indices-not-increasing": ("/accessors/0/sparse/indices", "do not increase"),
    "M6-G8-sparse-signed-indices": (f"{SPARSE}/indices: componentType of a wrong", "5120"),
    "M6-G8-sparse-values-too-short": ("/accessors/0/sparse/values: 2 elements end at byte 24",),
    "M6-G8-sparse-NaN": ("/accessors/0: 1 elements, first", "are NaN"),
    "M17-G12-unknown-extension": ("/extensionsRequired", "ACME_holograms", "re-export without"),
    "G16-M10-cycle": ("cycle",),
    "G16-M10-two-parents": ("/nodes/1: node 2 is listed twice",),
    "M12-G19-mode-7": ("mode out of range (found 7; expected 0 to 6)",),
    "M12-G19-empty-scene": ("nothing to render",),
    "G22-mesh-is-text": ('/nodes/0: mesh of another type (found "0"; expected an integer)',),
    "G22-counts-differ": ("3 NORMAL, but 4 vertices",),
    "G22-asset-version-1": ("asset version is '1.0'",),
    "G22-texCoord-2": ("texCoord 2, but only sets 0 to 1",),
    "M6-G23-count-2^31-limit": ("too many triangles", "715827882", "20000000"),
    "M11-G25-zero-scale": ("/nodes/0: singular transform",),
    "M11-G25-zero-quaternion": ("/nodes/0: rotation is the zero quaternion",),
    "G28-M10-2^18-instances": ("too many nodes", "262144", "100000"),
    "M10-G28-too-many-placed": ("too many instances", "65536"),
    "M6-G23-sparse-zeros": ("/accessors/0: 360000000 bytes of zeros (limit 268435456)",),
    "M11-scale-1e300": ("/nodes/0: transform with numbers beyond 1e+18",),
    "M11-positions-1e30": ("coordinates up to 1e+30", "1e+18"),
    "G18-vertex-without-weight": ("/meshes/0/primitives/0: vertex 3 has no weight",),
    "M6-stride-1": ("/bufferViews/0: byteStride 1, but elements of 12",),
}
"""Words of one error of each reason."""


@pytest.mark.parametrize("case", SENTENCES)
def test_sentence_of_a_reason(case: str, tmp_path: Path) -> None:
    fails(planted(case, tmp_path), *SENTENCES[case])


def test_every_reason_has_a_sentence() -> None:
    reasons = {reason for _, reason, _, _ in FAULTS.values()}
    assert reasons == {FAULTS[case][1] for case in SENTENCES}


COSTLY = [
    case for case in FAULTS if case.startswith(("M6-", "M10-", "M14-", "M11-")) or "2^" in case
]


@pytest.mark.parametrize("case", COSTLY)
def test_fault_costs_nothing(case: str, inputs: Path, tmp_path: Path) -> None:
    """What asks for much memory or time ends the program at once, and with little of both."""
    planted(case, tmp_path)
    argv = arguments(inputs, "out", asset="asset.glb", device="cpu")
    assert_fails(argv, 3, "asset.glb", FAULTS[case][2], cwd=tmp_path)


URIS = {
    "parent": "../secret.png", "encoded-parent": "%2e%2e/secret.png",
    "inner-parent": "a/../../secret.png", "absolute": "/etc/hostname",
    "file": "file:///etc/hostname", "http": "http://127.0.0.1:9/x.png",
    "https": "https://127.0.0.1:9/x.png", "ftp": "ftp://127.0.0.1/x.png", "drive": "C:\\x.png",
    "share": "\\\\127.0.0.1\\x.png", "two-slashes": "//127.0.0.1/x.png", "link": "link.png",
    "link-of-a-folder": "folder/secret.png",
}  # fmt: skip


def with_uri(uri: str, what: str, folder: Path) -> Path:
    """An asset in a folder of its own, with a link to the file beside that, and to its folder."""
    (folder / "asset").mkdir()
    builder = Builder()
    (folder / "secret.png").write_bytes(png() if what == "image" else bytes(builder.binary))
    for name, target in (("link.png", "../secret.png"), ("folder", ".."), ("loop.png", "loop.png")):
        (folder / "asset" / name).symlink_to(target)
    path = folder / "asset" / "asset.gltf"
    if what == "image":
        builder.base_color({"uri": uri})
        path.write_text(builder.gltf())
    else:
        builder.json["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(builder.json))
    return path


@pytest.mark.parametrize("what", ["image", "buffer"])
@pytest.mark.parametrize("case", URIS, ids="M4-{}".format)
def test_uri_opens_nothing_outside(case: str, what: str, inputs: Path, tmp_path: Path) -> None:
    """Of images and of buffers: refused by the program, without a socket."""
    with_uri(URIS[case], what, tmp_path)
    argv = arguments(inputs, "out", asset="asset/asset.gltf", device="cpu")
    assert_fails(argv, 3, "asset.gltf", f"/{what}s/0", "outside", cwd=tmp_path)


@pytest.mark.case("M4")
@pytest.mark.parametrize("uri", [*URIS.values(), "nul%00.png", ""])
def test_G24_no_texture_from_outside_becomes_grey(uri: str, tmp_path: Path) -> None:
    path = with_uri(uri, "image", tmp_path)
    fails(path, "/images/0", "outside", missing_textures="grey")


@pytest.mark.case("M4")
def test_G24_link_to_itself_is_refused(tmp_path: Path) -> None:
    fails(with_uri("loop.png", "image", tmp_path), "/images/0")


def test_unchanged_builder_loads(tmp_path: Path) -> None:
    """The faults above are the only thing wrong with their files."""
    asset = load(tmp_path, Builder())
    (square,) = asset.primitives
    np.testing.assert_array_equal(square.positions, CORNERS)
    np.testing.assert_array_equal(square.indices, TWO.reshape(2, 3))
    assert square.normals is not None and square.uv0 is not None
    np.testing.assert_array_equal(square.normals, NORMALS)
    np.testing.assert_array_equal(square.uv0, UVS)
    assert asset.notices == ()


CONTAINERS: dict[str, tuple[Callable[[bytes], bytes], tuple[str, ...]]] = {
    "M1-G21-empty": (lambda c: b"", ("empty file",)),
    "M1-G21-4-bytes": (lambda c: c[:4], ("damaged .glb", "byte 4")),
    "M1-G21-cut": (lambda c: c[:-40], ("total length", "byte 8")),
    "M1-G21-png-inside": (lambda c: png(), ("not a .glb file", "PNG")),
    "M1-json-length-lies": (
        lambda c: c[:12] + struct.pack("<I", 1 << 30) + c[16:],
        ("chunk of 1073741824 bytes leaves the file at byte 12",),
    ),
    "M1-total-length-lies": (
        lambda c: c[:8] + struct.pack("<I", 7) + c[12:],
        ("total length 7",),
    ),
    "M1-version-1": (lambda c: c[:4] + b"\1" + c[5:], ("container version 1",)),
    "M1-binary-chunk-first": (lambda c: c[:16] + b"BIN\0" + c[20:], ("first chunk",)),
}


@pytest.mark.parametrize("case", CONTAINERS)
def test_damaged_container_is_named_with_offset(case: str, tmp_path: Path) -> None:
    damage, words = CONTAINERS[case]
    path = tmp_path / "asset.glb"
    path.write_bytes(damage(Builder().glb()))
    fails(path, *words)


TEXTS: dict[str, tuple[str | bytes, tuple[str, ...]]] = {
    "M2-G20-truncated": ('{"asset": {"version": "2.0"},\n "nodes": [', ("line 2: not JSON",)),
    "M2-100000-brackets": ("[" * 100_000, ("nested",)),
    "M2-list-at-root": ("[]", ("not a JSON object",)),
    "M2-nan": ('{"asset": NaN}', ("NaN is not JSON",)),
    "M2-key-twice": ('{"asset": {}, "asset": {}}', ('key "asset" appears twice',)),
    "M2-not-utf8": (b'{"asset": "\xff"}', ("line 1: not UTF-8",)),
    "M2-json-65-MB": (b" " * (65 << 20), ("too large", "67108864")),
    "M2-no-asset": ("{}", ("asset version",)),
}


@pytest.mark.parametrize("case", TEXTS)
def test_damaged_json_is_named_with_position(case: str, tmp_path: Path) -> None:
    text, words = TEXTS[case]
    path = tmp_path / "asset.gltf"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    fails(path, *words)


@pytest.mark.case("M4")
def test_G24_no_fallback_to_the_base_name(builder: Builder, tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(png())
    builder.base_color({"uri": "a/b/x.png"})
    fails(written(tmp_path, builder), "/images/0", "x.png")


@pytest.mark.case("M3")
def test_M3_missing_buffer_is_refused(builder: Builder, tmp_path: Path) -> None:
    builder.json["buffers"][0]["uri"] = "mesh.bin"
    path = tmp_path / "asset.gltf"
    path.write_text(json.dumps(builder.json))
    fails(path, "/buffers/0", "mesh.bin")
    os.mkfifo(tmp_path / "mesh.bin")
    fails(path, "/buffers/0", "not a regular file")


def test_missing_file_folder_and_kind(tmp_path: Path) -> None:
    fails(tmp_path / "none.glb", "No such file")
    (tmp_path / "folder.glb").mkdir()
    fails(tmp_path / "folder.glb", "not a regular file")


@pytest.mark.case("M21")
@pytest.mark.parametrize("suffix", [".fbx", ".usdz", ".blend", ".zip", ""])
def test_M21_other_kinds_are_refused(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"asset{suffix}"
    path.write_bytes(b"x")
    fails(path, "convert it to GLB")
    if suffix == ".zip":
        fails(path, "unpack it and give its .glb or .gltf")


@pytest.mark.parametrize("kind", ["glb", "base64", "bin"])
def test_G1_containers_agree(builder: Builder, kind: str, tmp_path: Path) -> None:
    path = tmp_path / ("asset.glb" if kind == "glb" else "asset.gltf")
    if kind == "glb":
        path.write_bytes(builder.glb())
    elif kind == "base64":
        path.write_text("\ufeff" + builder.gltf())
    else:
        (tmp_path / "mesh.bin").write_bytes(builder.binary)
        builder.json["buffers"][0]["uri"] = "mesh.bin"
        path.write_text(json.dumps(builder.json))
    np.testing.assert_array_equal(load_asset(path).primitives[0].positions, CORNERS)


@pytest.mark.parametrize("code", ["B", "H", "I", "none", "strip", "stride"])
def test_G1_index_and_layout_kinds(builder: Builder, code: str, tmp_path: Path) -> None:
    """Indices of every width, none, strips and interleaved vertices give the same triangles."""
    if code in "BHI":
        builder.primitive["indices"] = builder.accessor(TWO.astype(code))
    elif code == "none":
        del builder.primitive["indices"]
        for name, array in {"POSITION": CORNERS, "NORMAL": NORMALS, "TEXCOORD_0": UVS}.items():
            builder.attribute(name, array[TWO])
    elif code == "strip":
        strip = np.array([1, 2, 0, 3], "B")
        builder.primitive.update(mode=5, indices=builder.accessor(strip))
    else:
        builder.attribute("POSITION", CORNERS, stride=28)
    (square,) = load(tmp_path, builder).primitives
    a, b, c = square.positions[square.indices].transpose(1, 0, 2)
    np.testing.assert_array_equal(np.cross(b - a, c - a), [[0, 0, 1], [0, 0, 1]])


def test_G1_material_values(builder: Builder, tmp_path: Path) -> None:
    builder.pbr.update(metallicFactor=0.25, roughnessFactor=0.75, baseColorFactor=[1, 0.5, 0.25, 1])
    builder.base_color()
    builder.pbr["metallicRoughnessTexture"] = {"index": builder.texture()}
    builder.material.update(
        alphaMode="MASK", alphaCutoff=0.3, doubleSided=True, emissiveFactor=[0.1, 0.2, 0.3],
        emissiveTexture={"index": 0}, normalTexture={"index": 1}, occlusionTexture={"index": 0},
    )  # fmt: skip
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    assert (material.metallic, material.roughness) == (0.25, 0.75)
    assert material.base_color == (1.0, 0.5, 0.25)
    assert (material.alpha_mode, material.alpha_cutoff) == ("MASK", 0.3)
    assert material.double_sided
    assert material.emission == (0.1, 0.2, 0.3)
    slots = (
        material.base_color_texture, material.metallic_roughness_texture, material.normal_texture,
        material.emission_texture,
    )  # fmt: skip
    assert [slot.texture for slot in slots if slot] == [0, 1, 1, 0]
    np.testing.assert_array_equal(asset.textures[0].pixels, np.full((2, 2, 4), (200, 100, 50, 255)))
    assert any("occlusion" in notice for notice in asset.notices)


def test_G2_factors_are_exact(builder: Builder, tmp_path: Path) -> None:
    """No factor is rounded to 8 bits."""
    builder.pbr["baseColorFactor"] = [0.125, 0.126, 0.127, 0.124]
    builder.attribute("COLOR_0", np.full((4, 3), 0.123, "f"))
    asset = load(tmp_path, builder)
    assert asset.materials[0].base_color == (0.125, 0.126, 0.127)
    assert asset.materials[0].alpha == 0.124
    del builder.primitive["material"]
    colors = load(tmp_path, builder).primitives[0].colors
    np.testing.assert_array_equal(colors, np.array([[0.123] * 3 + [1]] * 4, "f"))


def test_G3_absent_factors_are_one(builder: Builder, tmp_path: Path) -> None:
    """Metallic and roughness default to 1, with and without a material."""
    for _ in range(2):
        (material,) = load(tmp_path, builder).materials
        assert (material.metallic, material.roughness) == (1.0, 1.0)
        assert material.base_color == (1.0, 1.0, 1.0) and not material.double_sided
        builder.primitive.pop("material", None)


@pytest.mark.case("M5")
@pytest.mark.parametrize(
    ("uri", "name"),
    [("tex%20a.png", "tex a.png"), ("tex a.png", "tex a.png"), ("sch\u00f6n.png", "sch\u00f6n.png"),
     ("sch%C3%B6n.png", "sch\u00f6n.png"), ("a/../b%252e.png", "b%2e.png")],
)  # fmt: skip
def test_G4_M5_names_are_decoded_once(
    builder: Builder, uri: str, name: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(png())
    builder.base_color({"uri": uri})
    assert load(tmp_path, builder).textures[0].pixels[0, 0].tolist() == [200, 100, 50, 255]


@pytest.mark.case("M3")
@pytest.mark.parametrize("image", ["missing", "corrupt", "ktx2"])
def test_G5_missing_textures_become_grey_on_request(
    builder: Builder, image: str, tmp_path: Path
) -> None:
    """The base colour becomes one grey texel, a normal map is left out, both are mentioned."""
    content = {"corrupt": png()[:40], "ktx2": b"\xabKTX 20\xbb" + bytes(80)}.get(image, b"")
    entry = {"bufferView": builder.view(content)} if content else {"uri": "gone.png"}
    builder.base_color(entry)
    builder.material["normalTexture"] = {"index": 0}
    asset = load(tmp_path, builder, missing_textures="grey")
    assert asset.textures[0].pixels.shape == (1, 1, 4)
    assert asset.materials[0].normal_texture is None
    assert any("/images/0" in notice and "grey" in notice for notice in asset.notices)


@pytest.mark.case("M9")
@pytest.mark.parametrize(
    ("codes", "values"),
    [
        (np.array([[0, 255], [255, 255], [255, 0], [51, 0]], "B"), [0, 1, 1, 1, 1, 0, 0.2, 0]),
        (np.array([[0, 65535], [65535, 0], [13107, 0], [0, 0]], "H"), [0, 1, 1, 0, 0.2, 0, 0, 0]),
        # The two lowest signed codes both mean -1: max(c / 127, -1).
        (np.array([[-128, -127], [0, 127]] * 2, "b"), [-1, -1, 0, 1] * 2),
        (np.array([[-32768, -32767], [0, 32767]] * 2, "h"), [-1, -1, 0, 1] * 2),
    ],
    ids="BHbh",
)
def test_G6_M9_normalised_uv_equals_float(
    builder: Builder, codes: np.ndarray, values: list[float], tmp_path: Path
) -> None:
    builder.attribute("TEXCOORD_0", codes, normalized=True)
    uv0 = load(tmp_path, builder).primitives[0].uv0
    np.testing.assert_array_equal(uv0, np.array(values, "f").reshape(4, 2))


@pytest.mark.case("M9")
def test_G6_normalised_colors_equal_float(builder: Builder, tmp_path: Path) -> None:
    for codes, scale in ((np.full((4, 4), 51, "B"), 255), (np.full((4, 3), 13107, "H"), 65535)):
        builder.attribute("COLOR_0", codes, normalized=True)
        colors = load(tmp_path, builder).primitives[0].colors
        assert colors is not None
        np.testing.assert_allclose(colors[:, :3], codes[:, :3] / scale, rtol=FLOAT32_RTOL)


@pytest.mark.case("M9")
@pytest.mark.parametrize("code", ["b", "B", "h", "H"])
@pytest.mark.parametrize("normalized", [False, True])
def test_G7_M9_quantised_positions_equal_float(
    builder: Builder, code: str, normalized: bool, tmp_path: Path
) -> None:
    top = np.iinfo(code).max
    builder.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    builder.attribute("POSITION", (CORNERS * top).astype(code), normalized=normalized)
    low = np.array([[-128 if code in "bB" else -32768, 0, 0]] * 4)
    builder.attribute("NORMAL", low.astype("b" if code in "bB" else "h"), normalized=True)
    if not normalized:
        node(scale=[1 / top] * 3)(builder)
    (square,) = load(tmp_path, builder).primitives
    np.testing.assert_allclose(square.positions, CORNERS, rtol=FLOAT32_RTOL)
    assert square.normals is not None
    np.testing.assert_allclose(square.normals, [[-1, 0, 0]] * 4, rtol=FLOAT32_RTOL)


@pytest.mark.case("M6")
@pytest.mark.parametrize("code", ["B", "H", "I"])
@pytest.mark.parametrize("base", ["stored", "zeros"])
def test_G8_sparse_equals_dense(builder: Builder, code: str, base: str, tmp_path: Path) -> None:
    """Replaced vertices, on a stored base or on zeros, give the mesh that states them all."""
    expected = CORNERS if base == "stored" else np.zeros_like(CORNERS)
    expected = expected.copy()
    expected[[1, 3]] = [[2, 0, 1], [0, 3, 1]]
    expected[2, 1] += base == "zeros"  # so that both triangles have an area
    at = [1, 3] if base == "stored" else [1, 2, 3]
    sparse(at, expected[at], code)(builder)
    if base == "zeros":
        del builder.json["accessors"][0]["bufferView"]
    (square,) = load(tmp_path, builder).primitives
    np.testing.assert_array_equal(square.positions, expected)
    assert len(square.indices) == 2


@pytest.mark.case("M6")
def test_G8_sparse_quantised_uv_equals_dense(builder: Builder, tmp_path: Path) -> None:
    """Normalised integers are replaced before they are scaled; other attributes may be sparse."""
    codes = np.array([[0, 255], [255, 255], [255, 0], [0, 0]], "B")
    builder.attribute("TEXCOORD_0", codes, normalized=True, stride=4)
    builder.json["accessors"][-1]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": builder.view(b"\3"), "componentType": 5121},
        "values": {"bufferView": builder.view(b"\x33\xff")},
    }
    uv0 = load(tmp_path, builder).primitives[0].uv0
    np.testing.assert_allclose(uv0, [[0, 1], [1, 1], [1, 0], [0.2, 1]], rtol=FLOAT32_RTOL)


def test_G9_tangents_and_second_uv_are_used(builder: Builder, tmp_path: Path) -> None:
    builder.attribute("TANGENT", TANGENTS * np.array([1, 1, 1, -1], "f"))
    builder.attribute("TEXCOORD_1", UVS / 2)
    builder.base_color().update(texCoord=1)
    asset = load(tmp_path, builder)
    (square,) = asset.primitives
    assert square.tangents is not None and square.uv1 is not None
    np.testing.assert_array_equal(square.tangents[0], [1, 0, 0, -1])
    np.testing.assert_array_equal(square.uv1, UVS / 2)
    slot = asset.materials[0].base_color_texture
    assert slot is not None and slot.uv_set == 1


def test_G9_absent_uv_set_is_noted(builder: Builder, tmp_path: Path) -> None:
    """A texture whose coordinates are absent reads texel zero, with a notice."""
    builder.base_color().update(texCoord=1)
    asset = load(tmp_path, builder)
    np.testing.assert_array_equal(asset.primitives[0].uv1, np.zeros((4, 2)))
    assert any("no TEXCOORD_1" in notice for notice in asset.notices)


def test_G10_sampler_and_normal_scale(builder: Builder, tmp_path: Path) -> None:
    """Wrap modes and the scale of a normal map are used; one image may have several wraps."""
    builder.base_color(wrapS=33071, wrapT=33648, magFilter=9728)
    builder.json["samplers"].append({})
    builder.json["textures"].append({"source": 0, "sampler": 1})
    builder.material["normalTexture"] = {"index": 1, "scale": 0.5}
    asset = load(tmp_path, builder)
    first, second = asset.textures
    assert (first.wrap_u, first.wrap_v) == ("clamp", "mirror")
    assert (second.wrap_u, second.wrap_v) == ("repeat", "repeat")
    assert first.pixels is second.pixels
    assert asset.materials[0].normal_scale == 0.5
    assert any("nearest" in notice for notice in asset.notices)


def test_G10_texture_transform(builder: Builder, tmp_path: Path) -> None:
    """Match the extension's GLSL: translation * rotation * scale, columns first."""
    angle, (sx, sy), (ox, oy) = 0.3, (2.0, 3.0), (0.1, 0.2)
    builder.attribute("TEXCOORD_1", UVS)
    builder.base_color()["extensions"] = {
        "KHR_texture_transform": {
            "offset": [ox, oy], "rotation": angle, "scale": [sx, sy], "texCoord": 1,
        }
    }  # fmt: skip
    slot = load(tmp_path, builder).materials[0].base_color_texture
    assert slot is not None and slot.uv_set == 1
    cos, sin = np.cos(angle), np.sin(angle)
    translation = np.array([[1, 0, 0], [0, 1, 0], [ox, oy, 1]]).T
    rotation = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]).T
    matrix = translation @ rotation @ np.diag([sx, sy, 1])
    np.testing.assert_allclose(np.reshape(slot.transform, (2, 3)), matrix[:2])


def test_G11_material_extensions(builder: Builder, tmp_path: Path) -> None:
    """Emissive strength multiplies; unlit is matte; what is not supported gives one notice."""
    builder.material.update(
        name="lamp",
        emissiveFactor=[1, 0.5, 0],
        extensions={
            "KHR_materials_emissive_strength": {"emissiveStrength": 8},
            "KHR_materials_ior": {"ior": 1.3},
            "KHR_materials_volume": {"thicknessFactor": 1},
            "KHR_materials_dispersion": {},
            "KHR_materials_iridescence": {"iridescenceIor": 1.5},
            "KHR_materials_diffuse_transmission": {},
        },
    )
    asset = load(tmp_path, builder)
    assert asset.materials[0].emission == (8.0, 4.0, 0.0)
    assert asset.materials[0].ior == 1.3
    volume, others = asset.notices
    assert "KHR_materials_volume without transmission" in volume
    assert "lamp" in others and "KHR_materials_dispersion, KHR_materials_diffuse" in others
    assert "iridescence" not in others and asset.materials[0].iridescence_ior == 1.3
    builder.material["extensions"] = {
        "KHR_materials_unlit": {}, "KHR_materials_clearcoat": {"clearcoatFactor": 1},
    }  # fmt: skip
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    assert (material.metallic, material.emission) == (0.0, (0.0, 0.0, 0.0))
    assert material.clearcoat == 0.0
    assert any("unlit" in notice for notice in asset.notices)


def test_G11_layers_are_read(builder: Builder, tmp_path: Path) -> None:
    """Coat, sheen, glass and reflection keep factors, textures, UV sets and transforms."""
    builder.base_color()
    turned = {"index": 0, "texCoord": 1, "extensions": {"KHR_texture_transform": {"scale": [2, 3]}}}
    plain = {"index": 0}
    builder.material.pop("pbrMetallicRoughness", None)
    builder.material["extensions"] = {
        "KHR_materials_clearcoat": {
            "clearcoatFactor": 0.75, "clearcoatRoughnessFactor": 0.125, "clearcoatTexture": turned,
            "clearcoatRoughnessTexture": plain, "clearcoatNormalTexture": {"index": 0, "scale": 2},
        },
        "KHR_materials_sheen": {
            "sheenColorFactor": [0.5, 0.25, 0], "sheenRoughnessFactor": 0.5,
            "sheenColorTexture": plain, "sheenRoughnessTexture": turned,
        },
        "KHR_materials_transmission": {"transmissionFactor": 0.5, "transmissionTexture": plain},
        "KHR_materials_anisotropy": {
            "anisotropyStrength": 0.5, "anisotropyRotation": -1.5, "anisotropyTexture": turned,
        },
        "KHR_materials_iridescence": {
            "iridescenceFactor": 0.5, "iridescenceIor": 1.75, "iridescenceThicknessMinimum": 20,
            "iridescenceThicknessMaximum": 80, "iridescenceTexture": turned,
            "iridescenceThicknessTexture": plain,
        },
        "KHR_materials_specular": {
            "specularFactor": 0.25, "specularColorFactor": [2, 1, 0.5], "specularTexture": plain,
            "specularColorTexture": turned,
        },
    }  # fmt: skip
    builder.json["extensionsRequired"] = list(builder.material["extensions"])
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    slot = TextureSlot(0)
    scaled = TextureSlot(0, 1, (2.0, 0.0, 0.0, 0.0, 3.0, 0.0))
    expected = Material(
        name=material.name, clearcoat=0.75, clearcoat_roughness=0.125, clearcoat_normal_scale=2.0,
        clearcoat_texture=scaled, clearcoat_roughness_texture=slot, clearcoat_normal_texture=slot,
        sheen_color=(0.5, 0.25, 0.0), sheen_roughness=0.5, sheen_color_texture=slot,
        sheen_roughness_texture=scaled, transmission=0.5, transmission_texture=slot,
        specular=0.25, specular_color=(2.0, 1.0, 0.5), specular_texture=slot,
        specular_color_texture=scaled, anisotropy=0.5, anisotropy_rotation=-1.5,
        anisotropy_texture=scaled, iridescence=0.5, iridescence_ior=1.75,
        iridescence_thickness=(20.0, 80.0), iridescence_texture=scaled,
        iridescence_thickness_texture=slot,
    )  # fmt: skip
    assert material == expected
    assert any("not blurred" in notice for notice in asset.notices)


def test_G11_layers_are_clamped(builder: Builder, tmp_path: Path) -> None:
    builder.material["extensions"] = {
        "KHR_materials_ior": {"ior": 0.5},
        "KHR_materials_clearcoat": {"clearcoatFactor": 2, "clearcoatRoughnessFactor": -1},
        "KHR_materials_sheen": {"sheenColorFactor": [2, 0, 0], "sheenRoughnessFactor": 3},
        "KHR_materials_anisotropy": {"anisotropyStrength": 1.5},
        "KHR_materials_iridescence": {
            "iridescenceFactor": 3,
            "iridescenceIor": 0.5,
            "iridescenceThicknessMaximum": 1e30,
        },
        "KHR_materials_specular": {"specularFactor": -1, "specularColorFactor": [-1, 9, 0]},
    }
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    assert (material.ior, material.clearcoat, material.clearcoat_roughness) == (1.0, 1.0, 0.0)
    assert (material.sheen_color, material.sheen_roughness) == ((1.0, 0.0, 0.0), 1.0)
    assert (material.specular, material.specular_color) == (0.0, (0.0, 9.0, 0.0))
    assert (material.anisotropy, material.iridescence, material.iridescence_ior) == (1.0,) * 3
    assert material.iridescence_thickness == (100.0, 1e5)
    assert sum("clamped" in notice for notice in asset.notices) == 11


def test_G11_anisotropy_needs_a_direction(builder: Builder, tmp_path: Path) -> None:
    """Without tangents and texture coordinates it is named; without strength it is not read."""
    builder.material["extensions"] = {"KHR_materials_anisotropy": {"anisotropyStrength": 1}}
    assert load(tmp_path, builder).notices == ()
    del builder.primitive["attributes"]["TEXCOORD_0"]
    (notice,) = load(tmp_path, builder).notices
    assert "not anisotropic" in notice
    builder.material["extensions"] = {"KHR_materials_anisotropy": {"anisotropyRotation": 1}}
    asset = load(tmp_path, builder)
    assert asset.notices == () and asset.materials[0].anisotropy_rotation == 0.0


def test_G11_glass_says_what_it_does_not_do(builder: Builder, tmp_path: Path) -> None:
    """One notice of a tint or blur that is lost, none for clear glass."""
    builder.material.update(
        pbrMetallicRoughness={"metallicFactor": 0, "roughnessFactor": 0},
        extensions={"KHR_materials_transmission": {"transmissionFactor": 1}},
    )
    assert load(tmp_path, builder).notices == ()
    builder.material["pbrMetallicRoughness"] = {"baseColorFactor": [0.3, 0.8, 0.3, 1]}
    (notice,) = load(tmp_path, builder).notices
    assert "tinted or blurred" in notice


def glass(builder: Builder, **volume: object) -> Builder:
    """Make the builder's material glass with this KHR_materials_volume."""
    builder.material.update(
        name="glass",
        pbrMetallicRoughness={"metallicFactor": 0, "roughnessFactor": 0.25},
        extensions={
            "KHR_materials_transmission": {"transmissionFactor": 1},
            "KHR_materials_volume": volume,
        },
    )
    return builder


def test_G11_volume_is_read(tmp_path: Path) -> None:
    """Thickness makes solid glass, of which an open body is noted; without it glass stays thin."""
    builder = glass(
        Builder(), thicknessFactor=0.1, attenuationDistance=2, attenuationColor=[0.5, 0.25, 0]
    )
    builder.json["extensionsRequired"] = ["KHR_materials_volume"]
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    assert material.is_solid_glass and material.thickness == 0.1
    assert material.attenuation_distance == 2.0
    assert material.attenuation_color == (0.5, 0.25, 0.0)
    (notice,) = asset.notices
    assert "glass" in notice and "open at 4 edges" in notice
    (thin,) = load(tmp_path, glass(Builder())).materials
    assert not thin.is_solid_glass and thin.transmission == 1.0


@pytest.mark.parametrize(
    ("volume", "words"),
    [
        ({"attenuationDistance": 2, "attenuationColor": [0.5, 1, 1]}, "thicknessFactor of glass"),
        (
            {"thicknessFactor": 0, "attenuationDistance": 1, "attenuationColor": [0, 0, 0]},
            "above 0",
        ),
        ({"thicknessFactor": -0.1}, "thicknessFactor out of range (found -0.1"),
        ({"thicknessFactor": 1, "attenuationDistance": 0}, "attenuationDistance out of range"),
        ({"thicknessFactor": 1, "attenuationDistance": "far"}, "attenuationDistance"),
        ({"thicknessFactor": 1, "attenuationColor": [1, 1]}, "attenuationColor"),
    ],
)
def test_G11_wrong_volumes_are_refused(
    tmp_path: Path, volume: dict[str, object], words: str
) -> None:
    """Glass that absorbs on a way without length, and values out of range, by their place."""
    path = written(tmp_path, glass(Builder(), **volume))
    fails(path, words, "/materials/0/extensions/KHR_materials_volume")


def test_G11_glass_bodies_are_looked_at() -> None:
    """A closed body is in order also where corners are split, an inward one is told."""
    solid = Material(name="solid", transmission=1.0, thickness=1.0)
    ball = box((0, 0, 0), (1, 1, 1))
    split = replace(
        ball,
        positions=ball.positions[ball.indices].reshape(-1, 3),
        indices=np.arange(36).reshape(-1, 3),
    )
    inward = replace(ball, indices=ball.indices[:, ::-1])
    assert glass_notices([split], [solid]) == []
    assert "face inward" in glass_notices([inward], [solid])[0]
    assert "open at 3 edges" in glass_notices([replace(ball, indices=ball.indices[1:])], [solid])[0]
    assert glass_notices([inward], [replace(solid, thickness=0.0)]) == []


def test_G25_scale_of_zero_on_all_axes_hides(builder: Builder, tmp_path: Path) -> None:
    """So animations hide a part and its children, by the specification; the rest is drawn."""
    nodes = [{"mesh": 0}, {"mesh": 0, "scale": [0, 0, 0], "children": [2]}, {"mesh": 0}]
    builder.json.update(nodes=nodes, scenes=[{"nodes": [0, 1]}])
    asset = load(tmp_path, builder)
    assert len(asset.primitives) == 1
    assert sum("hides it" in notice for notice in asset.notices) == 2


@pytest.mark.parametrize("fallback", [None, {}, {"baseColorFactor": [1, 0, 0, 1]}])
def test_G11_specular_glossiness_is_converted(
    builder: Builder, tmp_path: Path, fallback: dict[str, Any] | None
) -> None:
    """Specular-glossiness becomes a dielectric whose F0 is its specular colour.

    It goes before a metallic fallback, as its specification asks. The texture's alpha is
    glossiness; roughness is what the factor times it leaves to 1.
    """
    builder.base_color()
    extension = {
        "diffuseFactor": [0.5, 0.25, 0.125, 1], "specularFactor": [0.5, 0.25, 1],
        "glossinessFactor": 0.75,
    }  # fmt: skip
    builder.json["materials"][0] = {
        "extensions": {"KHR_materials_pbrSpecularGlossiness": extension}
    }
    if fallback is not None:
        builder.json["materials"][0]["pbrMetallicRoughness"] = fallback
    (material,) = load(tmp_path, builder).materials
    assert material.base_color == (0.5, 0.25, 0.125)
    assert (material.metallic, material.roughness, material.ior) == (0.0, 0.25, 0.0)
    assert material.specular_color == (0.5, 0.25, 1.0)
    extension["specularGlossinessTexture"] = {"index": 0}
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    given, rough = material.specular_color_texture, material.metallic_roughness_texture
    assert given is not None and rough is not None and material.roughness == 1.0
    glossiness = asset.textures[given.texture].pixels[..., 3] / 255.0
    found = asset.textures[rough.texture].pixels[..., 1] / 255.0
    np.testing.assert_allclose(found, 1.0 - 0.75 * glossiness, atol=0.5 / 255.0 + 1e-9)


@pytest.mark.case("M17")
@pytest.mark.parametrize(
    "name", ["KHR_texture_transform", "KHR_materials_clearcoat", "KHR_lights_punctual"]
)
def test_G12_known_required_extensions_load(builder: Builder, name: str, tmp_path: Path) -> None:
    builder.json.update(extensionsRequired=[name], extensionsUsed=[name])
    load(tmp_path, builder)


@pytest.mark.case("M17")
def test_G13_used_but_not_required_reads_the_fallback(builder: Builder, tmp_path: Path) -> None:
    """Compression that is only offered is passed over; its fallback is read."""
    builder.json["extensionsUsed"] = ["KHR_draco_mesh_compression", "KHR_texture_basisu"]
    builder.primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    builder.base_color()
    builder.json["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": 9}}
    asset = load(tmp_path, builder)
    np.testing.assert_array_equal(asset.primitives[0].positions, CORNERS)
    assert len(asset.textures) == 1


@pytest.mark.case("M17")
def test_G13_webp_is_read(builder: Builder, tmp_path: Path) -> None:
    builder.json["extensionsRequired"] = ["EXT_texture_webp"]
    builder.base_color({"bufferView": builder.view(png(kind="WEBP")), "mimeType": "image/webp"})
    builder.json["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    assert load(tmp_path, builder).textures[0].pixels[0, 0].tolist() == [200, 100, 50, 255]


@pytest.mark.parametrize("kind", ["16-bit grey", "16-bit rgb", "palette", "grey", "rgba"])
def test_image_kinds_become_rgba(builder: Builder, kind: str, tmp_path: Path) -> None:
    """Every kind of PNG becomes 8-bit RGBA without rescaling its codes."""
    image, expected = {
        "16-bit grey": (Image.fromarray(np.full((2, 2), 200 * 257, "H")), [200, 200, 200, 255]),
        "16-bit rgb": (np.full((2, 2, 3), (51400, 25700, 12850), "H"), [200, 100, 50, 255]),
        "palette": (Image.new("RGB", (2, 2), (200, 100, 50)).quantize(4), [200, 100, 50, 255]),
        "grey": (Image.new("L", (2, 2), 200), [200, 200, 200, 255]),
        "rgba": (Image.new("RGBA", (2, 2), (200, 100, 50, 7)), [200, 100, 50, 7]),
    }[kind]
    path = tmp_path / "image.png"
    if isinstance(image, np.ndarray):  # which Pillow cannot write
        write_image(path, image)
    else:
        image.save(path)
    builder.base_color({"bufferView": builder.view(path.read_bytes())})
    asset = load(tmp_path, builder)
    assert asset.textures[0].pixels[1, 1].tolist() == expected
    assert any("16-bit" in notice for notice in asset.notices) == ("16-bit" in kind)


@pytest.mark.case("M14")
def test_M14_texture_pixels_are_limited(tmp_path: Path) -> None:
    """A header that promises 8000 x 8000 x 9 pixels stops before decoding."""
    decoder = TextureDecoder(tmp_path / "asset.glb", [], LIMITS)
    decoder.pixel_count = decoder.limits.texture_pixels - 10
    with pytest.raises(InputError, match="too many texture pixels"):
        decoder.decode(png_header(8000, 8000), "/images/0: ")


@pytest.mark.case("M14")
@pytest.mark.parametrize("kind", ["glb", "obj", "ply", "stl"])
def test_M14_triangles_are_limited(kind: str, tmp_path: Path) -> None:
    facet = "facet normal 0 0 1\nouter loop\n" + "vertex 0 0 {}\n" * 3 + "endloop\nendfacet\n"
    content = {
        "glb": Builder().glb(),
        "obj": b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n",
        "ply": b"ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\n"
        b"property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
        b"0 0 0\n1 0 0\n1 1 0\n0 1 0\n4 0 1 2 3\n",
        "stl": f"solid\n{facet.format(0, 1, 2) * 2}endsolid\n".encode(),
    }[kind]
    path = tmp_path / f"asset.{kind}"
    path.write_bytes(content)
    words = "too many triangles (found 2", "limit 1)", "--max-triangles"
    fails(path, *words, limits=Limits(triangles=1))


def test_G17_scene_member_selects(builder: Builder, tmp_path: Path) -> None:
    builder.json["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
    builder.json.update(scenes=[{"nodes": [0]}, {"nodes": [1]}], scene=1)
    assert load(tmp_path, builder).bounds()[0][0] == 5
    del builder.json["scene"]
    assert load(tmp_path, builder).bounds()[0][0] == 0


@pytest.mark.case("M10")
def test_G16_scene_that_lists_an_inner_node(builder: Builder, tmp_path: Path) -> None:
    """A listed inner node keeps its parents' transforms and is drawn once."""
    builder.json["nodes"] = [{"children": [1], "translation": [5, 0, 0]}, {"mesh": 0}]
    builder.json["scenes"] = [{"nodes": [1]}]
    asset = load(tmp_path, builder)
    assert asset.bounds()[0][0] == 5
    assert any("not a root" in notice for notice in asset.notices)
    builder.json["scenes"] = [{"nodes": [0, 1]}]
    assert len(load(tmp_path, builder).primitives) == 1


def skinned(weights: list[list[float]], bones: list[dict[str, Any]], **members: Any) -> Plant:
    """Bind the square's corners to joints: nodes 1, 2, ..., all bound at the origin by default."""

    def plant(b: Builder) -> None:
        b.json["nodes"][0]["skin"] = 0
        b.json["nodes"] += bones
        b.json["scenes"] = [{"nodes": [0, 1]}]
        b.json["skins"] = [{"joints": [1 + k for k in range(len(bones))]} | members]
        b.attribute("JOINTS_0", np.tile(np.array([0, 1, 0, 0], "B"), (4, 1)))
        b.attribute("WEIGHTS_0", np.array([[*w, 0, 0] for w in weights], "f"))

    return plant


HALF = [[1, 0], [1, 0], [0.5, 0.5], [0, 1]]
ARM: list[dict[str, Any]] = [{"children": [2], "scale": [2, 2, 2]}, {"translation": [0, 0, 3]}]
FAULTS |= {
    "G18-joint-out-of-range": fault(
        skinned(HALF, ARM[1:]), "gltf.index_out_of_range", PRIMITIVE, found=1, limit=1),
    "G18-joint-is-no-node": fault(
        skinned(HALF, ARM, joints=[1, 9]), "gltf.index_out_of_range", "/skins/0", found=9, limit=3),
    "G18-vertex-without-weight": fault(
        skinned([*HALF[:3], [0, 0]], ARM), "gltf.no_weight", PRIMITIVE),
    "G18-skin-without-joints": fault(
        lambda b: (skinned(HALF, ARM)(b), b.primitive["attributes"].pop("JOINTS_0")),
        "gltf.missing", "/meshes/0/primitives/0/attributes"),
    "G18-flat-joint": fault(skinned(HALF, [{"scale": [1, 0, 1]}, {}]), "gltf.singular", PRIMITIVE),
}  # fmt: skip


def test_G18_skinned_mesh_stands_as_its_joints_do(builder: Builder, tmp_path: Path) -> None:
    """Linear blend of joint * inverse bind matrix; the mesh's own node does not count."""
    bind = np.eye(4)
    bind[:3, 3] = (-1.0, 0.0, 0.0)
    matrices = np.stack([np.eye(4).T.ravel(), bind.T.ravel()]).astype("f")
    view = builder.view(matrices.tobytes())
    builder.json["accessors"].append(
        {"bufferView": view, "componentType": 5126, "count": 2, "type": "MAT4"}
    )
    inverse = len(builder.json["accessors"]) - 1
    skinned(HALF, ARM, inverseBindMatrices=inverse)(builder)
    node(translation=[99, 0, 0])(builder)
    (square,) = load(tmp_path, builder).primitives
    first, second = 2.0 * CORNERS, 2.0 * (CORNERS + np.array([-1, 0, 3]))
    weight = np.array(HALF, dtype=float)[:, 1:]
    np.testing.assert_allclose(square.positions, first + weight * (second - first), atol=1e-6)
    np.testing.assert_array_equal(square.normals, NORMALS)


def test_G18_mirrored_skin_keeps_the_outside(builder: Builder, tmp_path: Path) -> None:
    """Joints that mirror turn the winding round, and the normals follow."""
    skinned([[1, 0]] * 4, [{"scale": [-1, 1, 1]}, {}])(builder)
    asset = load(tmp_path, builder)
    assert winding_agrees(asset)
    assert asset.primitives[0].positions[1, 0] == -1.0


@pytest.mark.case("M12")
def test_G19_fan_is_expanded(builder: Builder, tmp_path: Path) -> None:
    builder.primitive.update(mode=6, indices=builder.accessor(np.array([0, 1, 2, 3], "B")))
    (square,) = load(tmp_path, builder).primitives
    assert square.indices.tolist() == [[1, 2, 0], [2, 3, 0]]


NOTED: dict[str, tuple[Plant, tuple[str, ...]]] = {
    "M6-G8-morph-target": (
        lambda b: (
            b.primitive.update(targets=[{"POSITION": b.accessor(CORNERS)}]),
            b.json["accessors"][-1].update(sparse={"count": 1}),
        ),
        ("morph",)),
    "G17-no-scenes": (lambda b: [b.json.pop(key) for key in ("scenes", "scene")], ("no scenes",)),
    "G18-rest-pose": (
        lambda b: (
            skinned([[1, 0]] * 4, [{}, {}])(b),
            b.json.update(animations=[{}]),
            b.primitive.update(targets=[{"POSITION": 0}]),
        ),
        ("skin", "animations", "morph")),
    "M12-G19-lines-beside-triangles": (
        lambda b: b.json["meshes"][0]["primitives"].append(b.primitive | {"mode": 1}),
        ("points or lines",)),
    "zero-normals-come-from-the-faces": (
        lambda b: b.attribute("NORMAL", NORMALS * np.array([[1], [0], [2], [1]], "f")),
        ("1 normals of length zero",)),
    "hidden-node": (
        lambda b: b.json.update(
            nodes=[
                {"mesh": 0},
                {"extensions": {"KHR_node_visibility": {"visible": False}}, "children": [2]},
                {"mesh": 0},
            ],
            scenes=[{"nodes": [0, 1]}]),
        ()),
}  # fmt: skip


@pytest.mark.parametrize("case", NOTED)
def test_what_changes_nothing_is_noted(builder: Builder, case: str, tmp_path: Path) -> None:
    """The square stays the only primitive, as it was; a notice has each of the words."""
    plant, words = NOTED[case]
    plant(builder)
    asset = load(tmp_path, builder)
    (square,) = asset.primitives
    np.testing.assert_array_equal(square.positions, CORNERS)
    np.testing.assert_array_equal(square.normals, NORMALS)
    for word in words:
        assert any(word in notice for notice in asset.notices)


def winding_agrees(asset: Asset) -> bool:
    """Return whether all geometric normals point to the side of the shading normals."""
    agree = True
    for p in asset.primitives:
        assert p.normals is not None
        a, b, c = p.positions[p.indices].transpose(1, 0, 2)
        agree &= bool(((np.cross(b - a, c - a) * p.normals[p.indices[:, 0]]).sum(1) > 0).all())
    return agree


@pytest.mark.case("M11")
@pytest.mark.parametrize("scale", [[-1, 1, 1], [-2, -3, -1], [1, 1, -1], [-1, -1, 1]])
def test_G25_mirrored_node_keeps_the_outside(
    builder: Builder, scale: list[float], tmp_path: Path
) -> None:
    """Winding agrees with the normals, and bitangents follow the mirror."""
    builder.attribute("TANGENT", TANGENTS)
    node(scale=scale)(builder)
    asset = load(tmp_path, builder)
    assert winding_agrees(asset)
    (square,) = asset.primitives
    assert square.indices.flags.c_contiguous
    assert square.normals is not None and square.tangents is not None
    bitangent = np.cross(square.normals, square.tangents[:, :3]) * square.tangents[:, 3:]
    np.testing.assert_allclose(bitangent[0], [0, np.sign(scale[1]), 0], atol=FLOAT32_RTOL)


@pytest.mark.case("M11")
def test_M11_shear_keeps_normals_perpendicular(builder: Builder, tmp_path: Path) -> None:
    """Normals under shear stay perpendicular to the surface (inverse transpose)."""
    node(matrix=[1, 0, 2, 0, 0, 1, 0, 0, 0.5, 0, 3, 0, 0, 0, 0, 1])(builder)
    asset = load(tmp_path, builder)
    (square,) = asset.primitives
    assert square.normals is not None
    a, b, c = square.positions[square.indices[0]]
    np.testing.assert_allclose(square.normals[0] @ np.stack([b - a, c - a]).T, 0, atol=1e-6)
    assert winding_agrees(asset)


def test_node_rotation_and_order(builder: Builder, tmp_path: Path) -> None:
    """TRS apply as T * R * S, parents on the left; 90 degrees about +Z takes +X to +Y."""
    half = np.sqrt(0.5)
    builder.json["nodes"] = [
        {"children": [1], "translation": [10, 0, 0]},
        {"mesh": 0, "rotation": [0, 0, half, half], "scale": [2, 1, 1], "translation": [0, 0, 1]},
    ]
    (square,) = load(tmp_path, builder).primitives
    np.testing.assert_allclose(square.positions[1], [10, 2, 1], atol=1e-12)


def test_G26_absent_normals_mean_flat(builder: Builder, tmp_path: Path) -> None:
    """No NORMAL: no shading normals; TANGENT is ignored then."""
    builder.attribute("TANGENT", TANGENTS)
    del builder.primitive["attributes"]["NORMAL"]
    (square,) = load(tmp_path, builder).primitives
    assert square.normals is None and square.tangents is None


def test_G27_camera_node_with_mesh_children(builder: Builder, tmp_path: Path) -> None:
    builder.json["cameras"] = [{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]
    builder.json["nodes"] = [{"camera": 0, "children": [1], "translation": [5, 0, 0]}, {"mesh": 0}]
    assert load(tmp_path, builder).bounds()[0][0] == 5


@pytest.mark.case("M10")
def test_G28_M10_deep_chain_loads(builder: Builder, tmp_path: Path) -> None:
    chain = [{"children": [k + 1], "translation": [0.5, 0, 0]} for k in range(2999)]
    builder.json["nodes"] = [*chain, {"mesh": 0}]
    assert load(tmp_path, builder).bounds()[0][0] == 2999 * 0.5


@pytest.mark.parametrize("length", [1e-6, 1.0, 1e308])
def test_trs_is_the_product_of_its_parts(length: float) -> None:
    """Of numbers and of rows of instances, with a quaternion of any length."""
    rng = np.random.default_rng(5)
    shifts, turns, scales = rng.uniform(-1.0, 1.0, (3, 6, 4))
    shifts, scales = shifts[:, :3], scales[:, :3]
    expected = np.zeros((6, 4, 4))
    expected[:, :3, :3] = Rotation.from_quat(turns).as_matrix() * scales[:, None]
    expected[:, :3, 3], expected[:, 3, 3] = shifts, 1.0
    found = from_trs(shifts.T, length * turns.T, scales.T)
    np.testing.assert_allclose(found, expected, atol=1e-14)
    for parts, matrix in zip(zip(shifts, length * turns, scales, strict=True), found, strict=True):
        alone = from_trs(*(part.tolist() for part in parts))
        np.testing.assert_allclose(alone, matrix, atol=1e-15)


@pytest.mark.case("M10")
@pytest.mark.parametrize("code", ["f", "b", "h"])
def test_G28_instances_equal_nodes(builder: Builder, code: str, tmp_path: Path) -> None:
    """EXT_mesh_gpu_instancing places the mesh where nodes of the same numbers do."""
    shifts = np.array([[1, 0, 0], [0, 2, 0], [0, 0, 3]], "f")
    turns = np.array([[0, 0, 0, 1], [0, 0, 1, 0], [1, 0, 0, 0]], "f")
    scales = np.array([[1, 1, 1], [2, 1, 1], [-1, 1, 1]], "f")
    stored = turns if code == "f" else (turns * np.iinfo(code).max).astype(code)
    instanced(TRANSLATION=shifts, ROTATION=stored, SCALE=scales)(builder)
    node(translation=[5, 0, 0], scale=[1, 2, 1])(builder)
    asset = load(tmp_path, builder)
    assert asset.notices == () and winding_agrees(asset)
    builder = Builder()
    builder.json["nodes"] = [{"children": [1, 2, 3], "translation": [5, 0, 0], "scale": [1, 2, 1]}]
    builder.json["nodes"] += [
        {"mesh": 0, "translation": t.tolist(), "rotation": r.tolist(), "scale": s.tolist()}
        for t, r, s in zip(shifts, turns, scales, strict=True)
    ]
    nodes = load(tmp_path, builder)
    for a, b in zip(asset.primitives, nodes.primitives, strict=True):
        np.testing.assert_array_equal(a.positions, b.positions)
        np.testing.assert_array_equal(a.indices, b.indices)
        np.testing.assert_array_equal(a.normals, b.normals)


def test_G29_primitives_are_not_merged(builder: Builder, tmp_path: Path) -> None:
    builder.json["materials"].append({"name": "second"})
    builder.json["meshes"][0]["primitives"].append(builder.primitive | {"material": 1})
    builder.json["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
    builder.json["scenes"] = [{"nodes": [0, 1]}]
    asset = load(tmp_path, builder)
    assert [p.material for p in asset.primitives] == [0, 1, 0, 1]
    assert [p.positions[0, 0] for p in asset.primitives] == [0, 0, 5, 5]


@pytest.mark.case("M13")
def test_M13_degenerate_and_repeated_triangles_are_counted(
    builder: Builder, tmp_path: Path
) -> None:
    bad = np.array([[0, 1, 2], [0, 2, 3], [1, 1, 2], [2, 0, 1], [0, 2, 1]], "H")
    builder.primitive["indices"] = builder.accessor(bad.reshape(-1))
    asset = load(tmp_path, builder)
    # The last one is a back side, not a repetition.
    assert asset.primitives[0].indices.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 1]]
    assert any("1 triangles of zero area and 1 repeated" in n for n in asset.notices)


@pytest.mark.case("M14")
def test_M14_one_skin_of_many_nodes_is_read_once(builder: Builder, tmp_path: Path) -> None:
    """100 meshes on one skin of 3000 joints take what one takes, not 100 times that."""
    skinned([[1, 0]] * 4, [{} for _ in range(3000)])(builder)
    builder.json["nodes"] += [dict(builder.json["nodes"][0]) for _ in range(99)]
    count = len(builder.json["nodes"])
    builder.json["scenes"] = [{"nodes": list(range(count))}]
    start = time.perf_counter()
    assert len(load(tmp_path, builder).primitives) == 100
    assert time.perf_counter() - start < 3.0


@pytest.mark.case("M14")
def test_M14_images_of_one_buffer_view_are_counted(builder: Builder, tmp_path: Path) -> None:
    """Images that nothing draws cost nothing; what is drawn has as many bytes as a file at most."""
    content = png() + bytes(100_000)
    view = builder.view(content)
    image = {"bufferView": view, "mimeType": "image/png"}
    builder.base_color(image)
    builder.json["images"] += [dict(image) for _ in range(100_000)]
    start = time.perf_counter()
    assert len(load(tmp_path, builder).textures) == 1
    assert time.perf_counter() - start < 3.0
    for k in range(5):
        builder.json["materials"].append(
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": builder.texture(dict(image))}}}
        )
        primitive = {**builder.primitive, "material": k + 1}
        builder.json["meshes"][0]["primitives"].append(primitive)
    del builder.json["images"][1:-5]
    for k in range(5):
        builder.json["textures"][-5 + k]["source"] = k + 1
    with pytest.raises(InputError, match=r"too many bytes of textures .*--max-file-bytes"):
        load(tmp_path, builder, limits=Limits(file_bytes=5 * len(content)))
    limits = Limits(file_bytes=7 * len(content))
    assert len(load(tmp_path, builder, limits=limits).materials) == 6


@pytest.mark.case("M14")
def test_M14_textures_made_of_others_are_shared_and_counted(
    builder: Builder, tmp_path: Path
) -> None:
    """Materials of one texture and one glossiness share what is made of it."""
    index = builder.texture({"bufferView": builder.view(png(size=8)), "mimeType": "image/png"})
    primitives = builder.json["meshes"][0]["primitives"]
    for k in range(40):
        extension = {
            "specularGlossinessTexture": {"index": index},
            "glossinessFactor": 0.5 if k < 20 else 0.25,
        }
        builder.json["materials"].append(
            {"extensions": {"KHR_materials_pbrSpecularGlossiness": extension}}
        )
        primitives.append({**builder.primitive, "material": k + 1})
    assert len(load(tmp_path, builder, limits=Limits(texture_pixels=3 * 64)).textures) == 3
    with pytest.raises(InputError, match="too many texture pixels"):
        load(tmp_path, builder, limits=Limits(texture_pixels=2 * 64))


@pytest.mark.case("M14")
def test_M14_limit_of_texture_pixels_is_ours(
    builder: Builder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow warns of its own limit, and refuses what is twice that: neither reaches the user."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 16)
    builder.base_color({"bufferView": builder.view(png(size=8)), "mimeType": "image/png"})
    assert load(tmp_path, builder).textures[0].pixels.shape == (8, 8, 4)
    assert Image.MAX_IMAGE_PIXELS == 16


@pytest.mark.case("M18")
def test_M18_values_out_of_range_are_clamped(builder: Builder, tmp_path: Path) -> None:
    builder.pbr.update(metallicFactor=2, roughnessFactor=-1, baseColorFactor=[2, 0, 0, 1])
    builder.material.update(emissiveFactor=[-1, 0, 0], alphaCutoff=3)
    asset = load(tmp_path, builder)
    (material,) = asset.materials
    assert (material.metallic, material.roughness, material.alpha_cutoff) == (1.0, 0.0, 1.0)
    assert material.base_color == (1.0, 0.0, 0.0) and material.emission == (0.0, 0.0, 0.0)
    for word in ("metallic", "roughness", "baseColor", "emissive"):
        assert any(f"{word}Factor" in n and "clamped" in n for n in asset.notices)
    assert any("alphaCutoff" in n and "clamped" in n for n in asset.notices)
    builder.material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": -2}}
    builder.material["emissiveFactor"] = [1, 1, 1]
    dark = load(tmp_path, builder)
    assert dark.materials[0].emission == (0.0, 0.0, 0.0)
    assert any("emissiveStrength -2 clamped" in notice for notice in dark.notices)


@pytest.mark.parametrize(
    ("factor", "strength"),
    [pytest.param(1e300, 1.0, id="M18-emission"), pytest.param(1.0, 1e38, id="M18-strength")],
)
def test_emission_beyond_all_light_is_refused(
    builder: Builder, tmp_path: Path, factor: float, strength: float
) -> None:
    """It would be infinite in the picture, far from the file that is at fault."""
    extension = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
    builder.material.update(emissiveFactor=[factor, 1, 1], extensions=extension)
    with pytest.raises(InputError, match=r"/materials/0: emission out of range .*limit 1e\+12"):
        load(tmp_path, builder)


ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2, 99, 2**31, 2**63, 1e300, -0.5, "", "x", [], {}, [0], [{}], [None],
    "\ud800", [1, 2, 3], [0] * 16, 5126, 5121, "VEC3", "MASK",
)  # fmt: skip


@pytest.mark.parametrize("kind", ["instances", "skin"])
@pytest.mark.filterwarnings("error")
def test_odd_values_give_an_asset_or_our_error(
    builder: Builder, kind: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Any value of the JSON replaced by an odd one ends in a sound asset or in one InputError."""
    builder.base_color()["extensions"] = {"KHR_texture_transform": {"scale": [2, 3]}}
    builder.attribute("TANGENT", TANGENTS)
    sparse([2], np.full((1, 3), 2.0))(builder)
    if kind == "skin":
        skinned(HALF, ARM)(builder)
    else:
        instanced(TRANSLATION=np.eye(3, dtype="f"), ROTATION=np.full((3, 4), 64, "b"))(builder)
    original = json.dumps(builder.json)
    paths = places(builder.json)
    for _ in range(150):
        builder.json = json.loads(original)
        *above, last = paths[rng.integers(len(paths))]
        holder = builder.json
        for key in above:
            holder = holder[key]
        holder[last] = ODD[rng.integers(len(ODD))]
        try:
            asset = load(tmp_path, builder)
        except InputError as error:
            assert error.where == str(tmp_path / "asset.glb")
            continue
        for p in asset.primitives:
            assert np.isfinite(p.positions).all() and p.indices.max() < len(p.positions)


REAL = {  # triangles placed, those of zero area, primitives, textures read
    "ToyCar.glb": (108_936, 2, 3, 7),
    "AlphaBlendModeTest.glb": (61, 0, 9, 8),
    "ClearcoatWicker.glb": (3072, 0, 1, 4),
    "cakeBirthday.glb": (1332, 0, 42, 0),
    "ferris-wheel.glb": (4914, 2, 1, 1),
    "mug.glb": (114_688, 0, 1, 0),
    "shaderball.glb": (88_264, 0, 2, 0),
    "kenney_trucks/vehicle-truck-red.glb": (946, 8, 6, 1),
    "kenney_trucks/vehicle-truck-yellow.glb": (989, 15, 6, 1),
    "hard/no_indices_3storybuilding.glb": (72, 0, 3, 0),
    "hard/pins.glb": (3408, 0, 7, 0),
    "hard/simple_pole.glb": (580, 0, 11, 0),
}


@needs_shared
@pytest.mark.parametrize("name", REAL)
def test_real_file_has_the_published_counts(name: str) -> None:
    asset = load_asset(MESHES / name)
    triangle_count, flat_count, primitive_count, texture_count = REAL[name]
    assert sum(len(p.indices) for p in asset.primitives) == triangle_count - flat_count
    assert (len(asset.primitives), len(asset.textures)) == (primitive_count, texture_count)


@needs_shared
@pytest.mark.parametrize("name", ["ToyCar_meshopt.glb", "mug_draco.gltf"])
def test_real_compressed_file_is_refused(name: str) -> None:
    fails(MESHES / "compressed_originals" / name, "_compression", "re-export")
