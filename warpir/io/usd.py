"""Writes a run's object, light and camera as one OpenUSD package, ``scene.usdz``.

Frames agree: USD's stage is +Y up in metres, its camera looks along -Z, and its dome light reads a
latitude-longitude map as OpenEXR orients it, so that nothing is turned. Matrices are USD's row
vectors, the transpose of ours. https://openusd.org/release/spec_usdpreviewsurface.html.
"""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux, UsdShade, UsdUtils, Vt

from warpir.core.arrays import Float64Array, affine_matrix
from warpir.core.errors import InputError
from warpir.io.gltf.writer import float32_center
from warpir.scene.asset import Asset, Material, Primitive, TextureSlot
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import Lamp, RectangleLamp

USDZ = "scene.usdz"
APERTURE = 0.36
"""Width of the written camera's film, in tenths of the stage's unit, as USD has it: 36 mm."""
TYPES = Sdf.ValueTypeNames
Names = dict[tuple[int, tuple[float, ...]], str]
"""Primvars by the set and transform of the coordinates that they hold."""


def write_usdz(
    asset: Asset,
    asset_to_world: Float64Array,
    camera: Camera,
    envmap: Path,
    lamps: Sequence[Lamp] = (),
) -> bytes:
    """Return the scene as one ``.usdz`` file.

    UsdPreviewSurface has no sheen, anisotropy, iridescence, transmission, coloured specular or
    vertex colour, and no normal map of the coat: those are left out.

    ``asset_to_world`` are column vectors [m], shape [4, 4]; ``envmap`` is the map on the object, an
    ``.exr`` file in OpenEXR's orientation; the camera keeps its principal point.

    Raises:
        InputError: The package cannot be written.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "envmap.exr").write_bytes(envmap.read_bytes())
        for k, texture in enumerate(asset.textures):
            Image.fromarray(texture.pixels).save(folder / f"texture_{k}.png")
        stage = Usd.Stage.CreateNew(str(folder / "scene.usdc"))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/scene").GetPrim())
        _object(stage, asset, asset_to_world)
        _camera(stage, camera)
        dome = UsdLux.DomeLight.Define(stage, "/scene/light")
        dome.CreateTextureFileAttr(Sdf.AssetPath("./envmap.exr"))
        dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
        for k, lamp in enumerate(lamps):
            _lamp(stage, lamp, f"/scene/lamp_{k}")
        stage.GetRootLayer().Save()
        package = folder / USDZ
        if not UsdUtils.CreateNewUsdzPackage(str(folder / "scene.usdc"), str(package)):
            raise InputError(USDZ, "OpenUSD could not write it", "see its message above")
        return package.read_bytes()


def _matrix(matrix: Float64Array) -> Gf.Matrix4d:
    return Gf.Matrix4d(*matrix.T.ravel().tolist())


def _camera(stage: Usd.Stage, camera: Camera) -> None:
    written = UsdGeom.Camera.Define(stage, "/scene/camera")
    written.AddTransformOp().Set(_matrix(camera.c2w))
    focal = APERTURE * camera.fx / camera.width
    vertical = focal * camera.height / camera.fy
    written.CreateFocalLengthAttr(focal)
    written.CreateHorizontalApertureAttr(APERTURE)
    written.CreateVerticalApertureAttr(vertical)
    written.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - camera.cx / camera.width))
    written.CreateVerticalApertureOffsetAttr(vertical * (camera.cy / camera.height - 0.5))
    # USD's default of 1 m would cut off what stands near.
    written.CreateClippingRangeAttr(Gf.Vec2f(0.01, 1e6))


def _lamp(stage: Usd.Stage, lamp: Lamp, path: str) -> None:
    """Write a lamp; a light of USD that is not normalised has its intensity as radiance."""
    pose = affine_matrix(np.eye(3), lamp.center)
    if isinstance(lamp, RectangleLamp):
        width, height = (float(np.linalg.norm(edge)) for edge in (lamp.edge_x, lamp.edge_y))
        written = UsdLux.RectLight.Define(stage, path)
        written.CreateWidthAttr(width)
        written.CreateHeightAttr(height)
        # USD's shines toward its -Z.
        pose[:3, 0], pose[:3, 1] = lamp.edge_x / width, -lamp.edge_y / height
        pose[:3, 2] = np.cross(pose[:3, 0], pose[:3, 1])
    else:
        written = UsdLux.SphereLight.Define(stage, path)
        written.CreateRadiusAttr(lamp.radius)
    written.AddTransformOp().Set(_matrix(pose))
    strength = float(lamp.radiance.max())
    written.CreateIntensityAttr(strength)
    written.CreateColorAttr(Gf.Vec3f(*(lamp.radiance / max(strength, 1e-30)).tolist()))


def _object(stage: Usd.Stage, asset: Asset, asset_to_world: Float64Array) -> None:
    center = float32_center(asset)
    root = UsdGeom.Xform.Define(stage, "/scene/object")
    root.AddTransformOp().Set(_matrix(asset_to_world @ affine_matrix(np.eye(3), center)))
    slots = [slot for material in asset.materials for slot in material.texture_slots()]
    keys = dict.fromkeys((slot.uv_set, slot.transform) for slot in slots)
    names: Names = {key: f"st{k}" for k, key in enumerate(keys)}
    materials = [_material(stage, asset, m, k, names) for k, m in enumerate(asset.materials)]
    for k, p in enumerate(asset.primitives):
        mesh = UsdGeom.Mesh.Define(stage, f"/scene/object/mesh_{k}")
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy((p.positions - center).astype("f4")))
        mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(mesh.GetPointsAttr().Get()))
        mesh.CreateFaceVertexCountsAttr([3] * len(p.indices))
        mesh.CreateFaceVertexIndicesAttr(p.indices.ravel().tolist())
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateDoubleSidedAttr(asset.materials[p.material].double_sided)
        if p.normals is not None:
            mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(p.normals.astype("f4")))
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        for slot in asset.materials[p.material].texture_slots():
            _primvar(mesh, p, slot, names[slot.uv_set, slot.transform])
        UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(materials[p.material])


def _primvar(mesh: UsdGeom.Mesh, p: Primitive, slot: TextureSlot, name: str) -> None:
    a, b, c, d, e, f = slot.transform
    if (uv := (p.uv0, p.uv1)[slot.uv_set]) is not None:
        moved = uv @ [[a, -d], [b, -e]] + [c, 1.0 - f]  # USD's v counts from the image's bottom
        kind, each = TYPES.TexCoord2fArray, UsdGeom.Tokens.vertex
        written = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, each)
        written.Set(Vt.Vec2fArray.FromNumpy(moved.astype("f4")))


def _reflectance(m: Material) -> Iterator[tuple[str, Any, Any, TextureSlot | None, str]]:
    """Yield what the dielectric reflects: by its index, or by a colour, as glTF's index 0 means."""
    if m.ior != 0.0:
        yield "ior", TYPES.Float, m.ior, None, ""
        return
    color = tuple(m.specular * c for c in m.specular_color)
    yield "useSpecularWorkflow", TYPES.Int, 1, None, ""
    yield "specularColor", TYPES.Color3f, color, m.specular_color_texture, "rgb"


def _material(
    stage: Usd.Stage, asset: Asset, m: Material, index: int, names: Names
) -> UsdShade.Material:
    path = f"/scene/materials/material_{index}"
    material = UsdShade.Material.Define(stage, path)
    surface = UsdShade.Shader.Define(stage, f"{path}/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    alpha, coat = (1.0 if m.alpha_mode == "OPAQUE" else m.alpha), m.clearcoat_roughness
    cutoff = m.alpha_cutoff if m.alpha_mode == "MASK" else 0.0
    seen = m.base_color_texture if m.alpha_mode != "OPAQUE" else None
    metal, bump, s = m.metallic_roughness_texture, m.normal_texture, m.normal_scale
    rgb = TYPES.Color3f
    inputs: tuple[tuple[str, Any, Any, TextureSlot | None, str], ...] = (
        ("diffuseColor", rgb, m.base_color, m.base_color_texture, "rgb"),
        ("opacity", TYPES.Float, alpha, seen, "a"),
        ("opacityThreshold", TYPES.Float, cutoff, None, ""),
        ("emissiveColor", rgb, m.emission, m.emission_texture, "rgb"),
        ("metallic", TYPES.Float, m.metallic, metal, "b"),
        ("roughness", TYPES.Float, m.roughness, metal, "g"),
        *_reflectance(m),
        ("clearcoat", TYPES.Float, m.clearcoat, m.clearcoat_texture, "r"),
        ("clearcoatRoughness", TYPES.Float, coat, m.clearcoat_roughness_texture, "g"),
        ("normal", TYPES.Normal3f, (0.0, 0.0, 1.0), bump, "rgb"),
    )
    for name, kind, value, slot, channel in inputs:
        target = surface.CreateInput(name, kind)
        if slot is None:
            target.Set(value)
            continue
        read = UsdShade.Shader.Define(stage, f"{path}/{name}_st")
        read.CreateIdAttr("UsdPrimvarReader_float2")
        read.CreateInput("varname", TYPES.String).Set(names[slot.uv_set, slot.transform])
        image = UsdShade.Shader.Define(stage, f"{path}/{name}_texture")
        image.CreateIdAttr("UsdUVTexture")
        image.CreateInput("file", TYPES.Asset).Set(Sdf.AssetPath(f"./texture_{slot.texture}.png"))
        image.CreateInput("st", TYPES.Float2).ConnectToSource(read.ConnectableAPI(), "result")
        texture, is_color = asset.textures[slot.texture], kind == rgb or channel == "a"
        space = "sRGB" if is_color else "raw"
        image.CreateInput("sourceColorSpace", TYPES.Token).Set(space)
        image.CreateInput("wrapS", TYPES.Token).Set(texture.wrap_u)
        image.CreateInput("wrapT", TYPES.Token).Set(texture.wrap_v)
        scale = (*value, 1.0) if kind == rgb else (value,) * 4 if kind == TYPES.Float else ()
        if not scale:  # a normal map's codes stand for -1 to 1
            scale = 2.0 * s, 2.0 * s, 2.0, 1.0
            image.CreateInput("bias", TYPES.Float4).Set(Gf.Vec4f(-s, -s, -1.0, 0.0))
        image.CreateInput("scale", TYPES.Float4).Set(Gf.Vec4f(*scale))
        image.CreateOutput(channel, kind if channel == "rgb" else TYPES.Float)
        target.ConnectToSource(image.ConnectableAPI(), channel)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return material
