"""Spherical-Gaussian lobes as a JSON file: ``lobes.json``, written by warpir and read by --light.

A lobe is ``G(v) = amplitude * exp(sharpness * (dot(v, axis) - 1))`` (DiPIR, Liang et al. 2024,
eq. 2, with ``sharpness = 1 / sigma^2``); axes are in the world frame. The file is

    {"format": "warpir-lobes", "version": 1,
     "lobes": [{"amplitude": [r, g, b], "axis": [x, y, z], "sharpness": s}, ...]}
"""

import math
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_numbers, read_versioned
from warpir.scene.light import Lobes

VERSION = 1
LOBE_COUNT_LIMIT = 4096
AMPLITUDE_LIMIT = 1e12
"""The sun over its sky is 10^5; float32 products overflow from 10^19 on."""
LEAST_SHARPNESS = 1e-6
"""Light from everywhere, within what float32 tells apart; it divides by it."""
SHARPNESS_LIMIT = 1e6
"""The real sun has a sharpness near 190 000; float32 lobes lose their shape beyond this."""


def read_lobes(path: str | Path, limits: Limits = LIMITS) -> Lobes:
    """Read and check a lobes file.

    Raises:
        InputError: Missing, of another format, or a lobe is out of range; names the lobe.
    """
    root = read_versioned(path, "lobes", VERSION, limits)
    lobes = root.get("lobes")
    if not isinstance(lobes, list) or not 1 <= len(lobes) <= LOBE_COUNT_LIMIT:
        raise InputError(path, f"/lobes: a list of 1 to {LOBE_COUNT_LIMIT} lobes expected")
    amplitude, axis, sharpness = np.empty((len(lobes), 3)), np.empty((len(lobes), 3)), []
    for i, lobe in enumerate(lobes):
        if not isinstance(lobe, dict):
            raise InputError(path, f"/lobes/{i}: an object expected")
        amplitude[i] = read_numbers(path, f"/lobes/{i}/amplitude", lobe.get("amplitude"), 3)
        axis[i] = read_numbers(path, f"/lobes/{i}/axis", lobe.get("axis"), 3)
        sharpness += read_numbers(path, f"/lobes/{i}/sharpness", [lobe.get("sharpness")], 1)
        if amplitude[i].min() < 0.0 or amplitude[i].max() > AMPLITUDE_LIMIT:
            expected = f"0 to {AMPLITUDE_LIMIT:g}"
            raise InputError(path, f"/lobes/{i}/amplitude: {expected} (found {lobe['amplitude']})")
        if not LEAST_SHARPNESS <= sharpness[i] <= SHARPNESS_LIMIT:
            expected = f"{LEAST_SHARPNESS:g} to {SHARPNESS_LIMIT:g}"
            raise InputError(path, f"/lobes/{i}/sharpness: {expected} (found {sharpness[i]:g})")
        length = math.hypot(*axis[i])  # of huge numbers too
        if not 1e-6 < length < 1e6:
            raise InputError(path, f"/lobes/{i}/axis: a direction expected (found {lobe['axis']})")
        axis[i] /= length
    return Lobes(
        amplitude.astype(np.float32), axis.astype(np.float32), np.array(sharpness, np.float32)
    )


def lobes_to_json(lobes: Lobes) -> dict[str, Any]:
    """Return what `read_lobes` reads."""
    numbers = lobes.amplitude.tolist(), lobes.axis.tolist(), lobes.sharpness.tolist()
    rows = [
        {"amplitude": amplitude, "axis": axis, "sharpness": sharpness}
        for amplitude, axis, sharpness in zip(*numbers, strict=True)
    ]
    return {"format": "warpir-lobes", "version": VERSION, "lobes": rows}
