"""Materials as a JSON file: ``materials.json``, written by --refine and read by --materials.

    {"format": "warpir-materials", "version": 1,
     "materials": [{"name": "paint", "base_color": [r, g, b], "metallic": m, "roughness": r,
                    "emission": [r, g, b], "before": {...}}, ...]}

One entry for each of the asset's materials, in the asset's order. The factors multiply its textures
and are linear; ``before`` holds the same four as the asset had them, for people, and is not read.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_numbers, read_versioned
from warpir.scene.asset import Asset, Material

VERSION = 1
MATERIALS = "materials.json"
EMISSION_LIMIT = 1e12
"""Relative [W/(m^2 sr)]; float32 products overflow from 10^19 on."""
FACTORS = {
    "base_color": (3, 1.0),
    "metallic": (1, 1.0),
    "roughness": (1, 1.0),
    "emission": (3, EMISSION_LIMIT),
}
"""How many numbers each factor of a `Material` has, and the greatest; the least is 0."""


def with_materials(asset: Asset, path: str | Path, limits: Limits = LIMITS) -> Asset:
    """Return an asset whose material factors are those of a file, made for the same materials.

    Raises:
        InputError: Missing, of another format, made for another asset, or a factor is out of range;
            names the material.
    """
    root = read_versioned(path, "materials", VERSION, limits)
    entries = root.get("materials")
    if not isinstance(entries, list) or len(entries) != len(asset.materials):
        count = f"{len(entries)}" if isinstance(entries, list) else "no list"
        raise InputError(
            path,
            f"/materials: not those of {asset.name} (found {count}; expected "
            f"{len(asset.materials)})",
            "name the asset that the file was made for",
        )
    materials = tuple(
        _read(path, f"/materials/{index}", entry, material)
        for index, (entry, material) in enumerate(zip(entries, asset.materials, strict=True))
    )
    return replace(asset, materials=materials)


def _read(path: str | Path, pointer: str, entry: Any, material: Material) -> Material:
    known = {"name", "before", *FACTORS}
    if not isinstance(entry, dict) or not set(entry) <= known:
        raise InputError(path, f"{pointer}: an object with {', '.join(sorted(known))} expected")
    if entry.get("name") != material.name:
        raise InputError(
            path,
            f"{pointer}/name: of another asset (found {entry.get('name')!r:.60}; expected "
            f"{material.name!r:.60})",
            "name the asset that the file was made for",
        )
    values: dict[str, Any] = {}
    for name, (count, high) in FACTORS.items():
        value = entry.get(name)
        numbers = read_numbers(path, f"{pointer}/{name}", [value] if count == 1 else value, count)
        if not 0.0 <= min(numbers) <= max(numbers) <= high:
            raise InputError(path, f"{pointer}/{name}: 0 to {high:g} expected (found {value})")
        values[name] = numbers[0] if count == 1 else tuple(numbers)
    return replace(material, **values)


def materials_to_json(before: Sequence[Material], after: Sequence[Material]) -> dict[str, Any]:
    """Return what `with_materials` reads."""

    def factors(material: Material) -> dict[str, Any]:
        return {name: getattr(material, name) for name in FACTORS}

    entries = [
        {"name": new.name, **factors(new), "before": factors(old)}
        for old, new in zip(before, after, strict=True)
    ]
    return {"format": "warpir-materials", "version": VERSION, "materials": entries}
