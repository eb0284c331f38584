"""Spherical-Gaussian lobes as a JSON file: ``lobes.json``, written by warpir and read by --light.

A lobe is ``G(v) = amplitude * exp(sharpness * (dot(v, axis) - 1))`` (DiPIR, Liang et al. 2024,
eq. 2, with ``sharpness = 1 / sigma^2``); axes are in the world frame. The file is

    {"format": "warpir-lobes", "version": 1,
     "lobes": [{"amplitude": [r, g, b], "axis": [x, y, z], "sharpness": s}, ...]}
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.errors import InputError
from warpir.strict_json import read_json_object

Float64Array = NDArray[np.float64]

FORMAT = "warpir-lobes"
VERSION = 1
LOBE_COUNT_LIMIT = 4096
SHARPNESS_LIMIT = 1e6
"""The real sun has a sharpness near 90 000; float32 lobes lose their shape beyond this."""


@dataclass(frozen=True)
class LobesFile:
    """The lobes of one file."""

    amplitude: Float64Array
    """Lobe peak radiance, linear Rec.709, relative [W/(m^2 sr)], shape [lobe, 3]."""
    axis: Float64Array
    """Unit lobe axes, world frame, shape [lobe, 3]."""
    sharpness: Float64Array
    """Lobe concentration [1], shape [lobe]."""


def read_lobes(path: str | Path, rotate_deg: float = 0.0) -> LobesFile:
    """Read and check a lobes file.

    Args:
        path: The JSON file.
        rotate_deg: Turns the light about +Y, counter-clockwise seen from above [deg].

    Raises:
        InputError: Missing, of another format, or a lobe is out of range; names the lobe.
    """
    root = read_json_object(path)
    if root.get("format") != FORMAT or root.get("version") != VERSION:
        found = f"{root.get('format')!r:.40} version {root.get('version')!r:.10}"
        raise InputError(path, f"not lobes (found {found}; expected {FORMAT!r} version {VERSION})")
    lobes = root.get("lobes")
    if not isinstance(lobes, list) or not 1 <= len(lobes) <= LOBE_COUNT_LIMIT:
        raise InputError(path, f"/lobes: a list of 1 to {LOBE_COUNT_LIMIT} lobes expected")
    amplitude, axis, sharpness = np.empty((len(lobes), 3)), np.empty((len(lobes), 3)), []
    for i, lobe in enumerate(lobes):
        if not isinstance(lobe, dict):
            raise InputError(path, f"/lobes/{i}: an object expected")
        amplitude[i] = _numbers(path, f"/lobes/{i}/amplitude", lobe.get("amplitude"), 3)
        axis[i] = _numbers(path, f"/lobes/{i}/axis", lobe.get("axis"), 3)
        sharpness += _numbers(path, f"/lobes/{i}/sharpness", [lobe.get("sharpness")], 1)
        if amplitude[i].min() < 0.0:
            raise InputError(path, f"/lobes/{i}/amplitude: at least 0 (found {amplitude[i].min()})")
        if not 0.0 <= sharpness[i] <= SHARPNESS_LIMIT:
            expected = f"0 to {SHARPNESS_LIMIT:g}"
            raise InputError(path, f"/lobes/{i}/sharpness: {expected} (found {sharpness[i]:g})")
        length = float(np.linalg.norm(axis[i]))
        if not 1e-6 < length < 1e6:
            raise InputError(path, f"/lobes/{i}/axis: a direction expected (found {lobe['axis']})")
        axis[i] /= length
    angle = math.radians(rotate_deg)
    x, z = axis[:, 0].copy(), axis[:, 2].copy()
    axis[:, 0] = math.cos(angle) * x + math.sin(angle) * z
    axis[:, 2] = math.cos(angle) * z - math.sin(angle) * x
    return LobesFile(amplitude, axis, np.array(sharpness))


def lobes_to_json(amplitude: Any, axis: Any, sharpness: Any) -> dict[str, Any]:
    """Return what `read_lobes` reads, from arrays of the shapes of `LobesFile`."""
    rows = zip(amplitude, axis, sharpness, strict=True)
    return {
        "format": FORMAT,
        "version": VERSION,
        "lobes": [
            {
                "amplitude": [float(c) for c in a],
                "axis": [float(c) for c in d],
                "sharpness": float(s),
            }
            for a, d, s in rows
        ],
    }


def _numbers(path: str | Path, pointer: str, value: Any, count: int) -> list[float]:
    numeric = isinstance(value, list) and len(value) == count
    if not numeric or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise InputError(path, f"{pointer}: {expected} expected")
    numbers = []
    for v in value:
        try:
            numbers.append(float(v))
        except OverflowError:
            raise InputError(path, f"{pointer}: a number beyond every use") from None
    return numbers
