"""Reads an asset of any kind that is known: the reader by its extension, then the shared checks."""

from pathlib import Path

from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.gltf.reader import read_gltf
from warpir.io.meshes.obj import read_obj
from warpir.io.meshes.plain import read_ply_mesh, read_stl_mesh
from warpir.scene.asset import Asset

TEXTURE_LIMIT = 1e6
"""Of texture coordinates and their transforms [1]; beyond it float32 knows no part of a texel."""


def load_asset(path: str | Path, missing_textures: str = "error", limits: Limits = LIMITS) -> Asset:
    """Read a ``.glb``, ``.gltf``, ``.obj``, ``.ply`` or ``.stl`` file.

    A missing texture is an ``error``, or mid ``grey`` takes its place.

    Raises:
        InputError: The file is missing, of another kind, or cannot be represented faithfully.
    """
    path = Path(path)
    asset = _read(path, missing_textures, limits)
    _check_numbers(path, asset)
    return asset


def _check_numbers(path: Path, asset: Asset) -> None:
    """Refuse numbers that are finite, but whose products are not."""
    for material in asset.materials:
        slots = material.texture_slots()
        scales = [material.normal_scale, material.clearcoat_normal_scale, material.ior]
        scales += [number for slot in slots for number in slot.transform]
        if abs(found := max(scales, key=abs)) > TEXTURE_LIMIT:
            what = f"material {material.name[:60]!a}: a texture's transform or scale, or an index"
            raise InputError(
                path,
                f"{what} of {found:g} (expected at most {TEXTURE_LIMIT:g})",
                reason="asset.texture_transform",
                limit=TEXTURE_LIMIT,
            )
    for primitive in asset.primitives:
        for uv in (primitive.uv0, primitive.uv1):
            greatest = 0.0 if uv is None else float(max(uv.max(), -uv.min()))
            if greatest > TEXTURE_LIMIT:
                what = f"texture coordinates of {greatest:g} (expected at most {TEXTURE_LIMIT:g})"
                raise InputError(
                    path,
                    what,
                    reason="asset.texture_coordinates",
                    found=greatest,
                    limit=TEXTURE_LIMIT,
                )


def _read(path: Path, missing_textures: str, limits: Limits) -> Asset:
    suffix = path.suffix.lower()
    if suffix in {".glb", ".gltf"}:
        return read_gltf(path, missing_textures, limits)
    if suffix == ".obj":
        return read_obj(path, missing_textures, limits)
    if suffix == ".ply":
        return read_ply_mesh(path, limits)
    if suffix == ".stl":
        return read_stl_mesh(path, limits)
    raise InputError(
        path,
        f"not a mesh that warpir reads (found {suffix or 'no extension'}; "
        "expected .glb, .gltf, .obj, .ply or .stl)",
        ("unpack it and give its .glb or .gltf, or " if suffix == ".zip" else "")
        + "convert it to GLB",
        reason="asset.kind",
        found=suffix,
    )
