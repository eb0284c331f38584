"""scene.usdz, opened again with OpenUSD: points, materials, camera and light are the run's."""

import importlib.util
import io
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.builders.insertions import arguments, go, read_image, write_inputs
from tests.builders.shapes import box
from warpir import demo
from warpir.insert import main
from warpir.io.assets import load_asset
from warpir.scene.asset import Asset, Material, Texture, TextureSlot
from warpir.scene.camera import Camera, camera_pose
from warpir.scene.light import axis_from_angles
from warpir.scene.near.lamps import RectangleLamp, SphereLamp

needs_usd = pytest.mark.skipif(
    importlib.util.find_spec("pxr") is None, reason="OpenUSD is not installed (usd extra)"
)
SKY = Path(demo.__file__).with_name("sky.exr")
PIXEL = 1e-3
"""Of projections by OpenUSD's own frustum [px]."""
SUN = (60.0, 40.0)
"""Azimuth and elevation of the run's sun [deg]: to the right, ahead, above."""


def stage_of(path: Path, *scene: Any) -> Any:
    """Return what OpenUSD finds in the package of a scene, the arguments of `write_usdz`."""
    from pxr import Usd

    from warpir.io.usd import write_usdz

    path.write_bytes(write_usdz(*scene))
    return Usd.Stage.Open(str(path))


def test_usd_that_is_not_installed_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line and what brings it, before anything is read."""
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "warpir.app.program.importlib.util.find_spec",
        lambda name: None if name == "pxr" else find(name),
    )
    argv = ["--photo", "a.png", "--asset", "b.glb", "--out", str(tmp_path / "out"), "--usd"]
    assert main(argv) == 2
    assert capsys.readouterr().err.splitlines() == [
        "error: pxr: not installed",
        "pip install 'warpir[usd]' brings it",
    ]


@needs_usd
def test_usdz_has_the_object_and_the_camera(tmp_path: Path) -> None:
    """Every vertex falls on the photo's pixel, also with a lens shift and pixels not square."""
    from pxr import Gf, UsdGeom

    asset = load_asset(demo.ASSET)
    camera = Camera(640, 400, 500.0, 520.0, 300.0, 220.0, camera_pose(-5.0, 2.0, 1.6))
    to_world = np.diag([2.0, 2.0, 2.0, 1.0])
    to_world[:3, 3] = 1.0, 0.0, -9.0
    path = tmp_path / "scene.usdz"
    stage = stage_of(path, asset, to_world, camera, SKY)
    frustum = UsdGeom.Camera.Get(stage, "/scene/camera").GetCamera().frustum
    to_film = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    for k, p in enumerate(asset.primitives):
        mesh = UsdGeom.Mesh.Get(stage, f"/scene/object/mesh_{k}")
        placed = UsdGeom.XformCache().GetLocalToWorldTransform(mesh.GetPrim())
        ours = p.positions @ to_world[:3, :3].T + to_world[:3, 3]
        points = np.array(mesh.GetPointsAttr().Get())
        got = np.c_[points, np.ones(len(points))] @ np.array(placed)
        np.testing.assert_allclose(got[:, :3], ours, atol=1e-5)
        film = np.array([to_film.Transform(Gf.Vec3d(*q)) for q in got[:, :3].tolist()])[:, :2]
        pixels = (film * (1.0, -1.0) + 1.0) / 2.0 * (camera.width, camera.height)
        np.testing.assert_allclose(pixels, camera.project(ours)[:, :2], atol=PIXEL)
        indices = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        np.testing.assert_array_equal(indices, p.indices)
        if p.normals is not None:
            np.testing.assert_allclose(np.array(mesh.GetNormalsAttr().Get()), p.normals, atol=1e-6)
    with zipfile.ZipFile(path) as package:
        name = next(name for name in package.namelist() if name.endswith(".exr"))
        assert package.read(name) == SKY.read_bytes()


@needs_usd
def test_usdz_has_the_lamps(tmp_path: Path) -> None:
    """Spheres and rectangles where they are, of our radiance; a rectangle shines along its -Z."""
    from pxr import UsdGeom, UsdLux

    asset = Asset("box", (box((0.0, 0.5, 0.0), (1.0, 1.0, 1.0)),), (Material(),), ())
    camera = Camera(64, 40, 50.0, 50.0, 32.0, 20.0, camera_pose(-5.0, 2.0, 1.6))
    ball = SphereLamp(np.array([1.0, 2.0, 3.0]), 0.25, np.array([40.0, 20.0, 10.0]))
    edges = np.array([0.0, 0.0, 0.8]), np.array([-0.3, 0.4, 0.0])
    flat = RectangleLamp(np.array([0.0, 2.0, -1.0]), *edges, np.array([9.0, 6.0, 0.0]))
    stage = stage_of(tmp_path / "scene.usdz", asset, np.eye(4), camera, SKY, (ball, flat))
    round_one = UsdLux.SphereLight.Get(stage, "/scene/lamp_0")
    square = UsdLux.RectLight.Get(stage, "/scene/lamp_1")
    assert round_one.GetRadiusAttr().Get() == 0.25
    for light, lamp in ((round_one, ball), (square, flat)):
        assert light.GetNormalizeAttr().Get() is False
        radiance = np.array(light.GetColorAttr().Get()) * light.GetIntensityAttr().Get()
        np.testing.assert_allclose(radiance, lamp.radiance, rtol=1e-6)
    pose = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(square.GetPrim()))
    half = np.array([square.GetWidthAttr().Get(), square.GetHeightAttr().Get()]) / 2.0
    corners = {tuple(np.round([x, y, 0, 1] @ pose, 6)[:3]) for x in (-half[0], half[0])
               for y in (-half[1], half[1])}  # fmt: skip
    expected = {tuple(np.round(flat.corner + i * edges[0] + j * edges[1], 6)) for i in (0, 1)
                for j in (0, 1)}  # fmt: skip
    assert corners == expected
    outward = np.cross(*edges)
    np.testing.assert_allclose(-pose[2, :3], outward / np.linalg.norm(outward), atol=1e-9)


@needs_usd
def test_usdz_materials_read_the_same_texels(
    tmp_path: Path, rng: np.random.Generator, capfd: pytest.CaptureFixture[str]
) -> None:
    """Each connected input by UsdUVTexture's definition, at every vertex, against ours."""
    from pxr import UsdGeom, UsdShade

    pixels = [rng.integers(0, 256, (8, 16, 4), dtype=np.uint8) for _ in range(2)]
    moved = TextureSlot(1, 1, (0.5, 0.25, 0.1, -0.25, 0.5, 0.4))
    material = Material(
        base_color=(0.5, 0.6, 0.7),
        alpha=0.8,
        alpha_mode="BLEND",
        metallic=0.3,
        roughness=0.4,
        emission=(2.0, 1.0, 0.5),
        normal_scale=0.5,
        clearcoat=0.9,
        base_color_texture=moved,
        metallic_roughness_texture=TextureSlot(0),
        normal_texture=moved,
        emission_texture=TextureSlot(0),
    )
    mesh = box((0.0, 0.0, -3.0), (1.0, 1.0, 1.0))
    uvs = rng.uniform(0.0, 1.0, (2, len(mesh.positions), 2)).astype(np.float32)
    textures = Texture(pixels[0]), Texture(pixels[1], "mirror", "clamp")
    asset = Asset("box", (replace(mesh, uv0=uvs[0], uv1=uvs[1]),), (material,), textures)
    path = tmp_path / "scene.usdz"
    camera = Camera(64, 40, 50.0, 50.0, 32.0, 20.0, np.eye(4))
    stage = stage_of(path, asset, np.eye(4), camera, SKY)
    assert capfd.readouterr() == ("", "")  # OpenUSD warns of files that it does not find
    written = UsdGeom.Mesh.Get(stage, "/scene/object/mesh_0")
    bound = UsdShade.MaterialBindingAPI(written).ComputeBoundMaterial()[0]
    surface = bound.ComputeSurfaceSource()[0]

    def read(name: str) -> tuple[np.ndarray, str, str]:
        """Return values at the vertices, the texture's colour space, and its wrap modes."""
        source, output, _ = surface.GetInput(name).GetConnectedSource()
        image = UsdShade.Shader(source.GetPrim())
        values = {i.GetBaseName(): i.Get() for i in image.GetInputs()}
        reader = UsdShade.Shader(image.GetInput("st").GetConnectedSource()[0].GetPrim())
        primvars = UsdGeom.PrimvarsAPI(written)
        st = np.array(primvars.GetPrimvar(reader.GetInput("varname").Get()).Get())
        member = values["file"].resolvedPath.removeprefix(f"{path}[").removesuffix("]")
        with zipfile.ZipFile(path) as package, Image.open(io.BytesIO(package.read(member))) as i:
            texels = np.asarray(i)
        height, width = texels.shape[:2]
        column, row = np.floor(st[:, 0] * width), np.floor((1.0 - st[:, 1]) * height)
        texel = texels[row.astype(int) % height, column.astype(int) % width] / 255.0
        texel = texel * np.array(values["scale"]) + np.array(values.get("bias", (0.0,) * 4))
        channels = ["rgba".index(c) for c in output]
        space = values["sourceColorSpace"]
        return texel[:, channels], space, f"{values['wrapS']} {values['wrapT']}"

    def expected(slot: TextureSlot) -> np.ndarray:
        """Return the texels at the vertices in glTF's coordinates, v down from the top."""
        a, b, c, d, e, f = slot.transform
        u, v = uvs[slot.uv_set].astype(np.float64).T
        texels = pixels[slot.texture]
        column = np.floor((a * u + b * v + c) * texels.shape[1]).astype(int)
        row = np.floor((d * u + e * v + f) * texels.shape[0]).astype(int)
        chosen: np.ndarray = texels[row % texels.shape[0], column % texels.shape[1]] / 255.0
        return chosen

    first, second = expected(TextureSlot(0)), expected(moved)
    for name, values, space, wrap in (
        ("diffuseColor", second[:, :3] * (0.5, 0.6, 0.7), "sRGB", "mirror clamp"),
        ("opacity", second[:, 3:] * 0.8, "sRGB", "mirror clamp"),
        ("metallic", first[:, 2:3] * 0.3, "raw", "repeat repeat"),
        ("roughness", first[:, 1:2] * 0.4, "raw", "repeat repeat"),
        ("emissiveColor", first[:, :3] * (2.0, 1.0, 0.5), "sRGB", "repeat repeat"),
        ("normal", (2.0 * second[:, :3] - 1.0) * (0.5, 0.5, 1.0), "raw", "mirror clamp"),
    ):
        found = read(name)
        np.testing.assert_allclose(found[0], values, atol=1e-6)
        assert found[1:] == (space, wrap), name
    assert surface.GetInput("clearcoat").Get() == pytest.approx(0.9)
    assert surface.GetInput("ior").Get() == pytest.approx(1.5)


@needs_usd
def test_usdz_reflects_by_color_where_the_index_is_unknown(tmp_path: Path) -> None:
    """GlTF's index 0, which specular-glossiness becomes, is no index: F0 is the color."""
    from pxr import UsdShade

    gloss = Material(ior=0.0, specular=0.5, specular_color=(0.08, 0.06, 0.04))
    asset = Asset("box", (box((0.0, 0.0, -3.0), (1.0, 1.0, 1.0)),), (gloss,))
    camera = Camera(64, 40, 50.0, 50.0, 32.0, 20.0, np.eye(4))
    stage = stage_of(tmp_path / "scene.usdz", asset, np.eye(4), camera, SKY)
    surface = UsdShade.Shader.Get(stage, "/scene/materials/material_0/surface")
    values = {i.GetBaseName(): i.Get() for i in surface.GetInputs()}
    assert "ior" not in values and values["useSpecularWorkflow"] == 1
    assert tuple(values["specularColor"]) == pytest.approx((0.04, 0.03, 0.02))


def test_usdz_of_a_run_has_its_sun_where_it_is(tmp_path: Path) -> None:
    """The dome light by OpenEXR's definition, which UsdLux names, on a stage whose +Y is up."""
    from pxr import Gf, Usd, UsdGeom, UsdLux

    write_inputs(tmp_path)
    out = tmp_path / "out"
    sun = f"{SUN[0]},{SUN[1]}"
    go(arguments(tmp_path, out, light=None, sun=sun, device="cpu", usd=""), out)
    stage = Usd.Stage.Open(str(out / "scene.usdz"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    dome = UsdLux.DomeLight.Get(stage, "/scene/light")
    assert dome.GetTextureFormatAttr().Get() == "latlong"
    turned = UsdGeom.XformCache().GetLocalToWorldTransform(dome.GetPrim())
    member = dome.GetTextureFileAttr().Get().resolvedPath.split("[")[1].removesuffix("]")
    with zipfile.ZipFile(out / "scene.usdz") as package:
        (tmp_path / "dome.exr").write_bytes(package.read(member))
    texels = read_image(tmp_path / "dome.exr")[0][..., :3]
    height, width = texels.shape[:2]

    def radiance(direction: np.ndarray) -> float:
        local = turned.GetInverse().TransformDir(Gf.Vec3d(*direction.tolist()))
        x, y, z = np.array(local)
        longitude, latitude = np.arctan2(x, z), np.arcsin(y)
        u, v = 0.5 - longitude / (2.0 * np.pi), 0.5 - latitude / np.pi
        return float(texels[int(v * height), int(u * width) % width].max())

    toward = axis_from_angles(*SUN)
    assert radiance(toward) > 0.5 * texels.max()
    for mirror in ((-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, 1, -1)):
        assert radiance(toward * mirror) < 0.05 * texels.max()
    frustum = UsdGeom.Camera.Get(stage, "/scene/camera").GetCamera().frustum
    np.testing.assert_allclose(frustum.ComputeViewDirection(), (0.0, -0.25882, -0.96593), atol=1e-4)
