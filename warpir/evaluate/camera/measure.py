"""Errors of estimated cameras, on photographs cut out of panoramas with cameras drawn at random.

Pitch, roll and field of view are drawn evenly over wide ranges, so that no constant guess can score
well. Panoramas that the network has learned from are left out where others remain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpir.calibration.estimate import CameraEstimate, estimate_camera
from warpir.calibration.network import Calibrator
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.train.camera.crops import ASPECTS, DrawnCameras, cut, read_panoramas
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.sampler import Sampler

CONSTANT_FOV = 60.0
"""Horizontal field of view that is assumed where nothing is known [deg]."""
RANGES = {"pitch": (-40.0, 25.0), "roll": (-20.0, 20.0), "fov": (25.0, 95.0)}
"""Least and greatest pitch, roll and field of view of the shorter side [deg]."""
SIDE = 8
"""Sides of the photographs are multiples of this, as JPEG's blocks are [px]."""
Errors = dict[str, list[float]]


def even_cameras(draw: Sampler) -> DrawnCameras:
    """Draw cameras with even pitch, roll and field of view of the shorter side, within `RANGES`."""
    pitch, roll, fov = (torch.deg2rad(draw.uniform(*RANGES[k])) for k in ("pitch", "roll", "fov"))
    aspect = torch.tensor(ASPECTS)[draw.index(len(ASPECTS))]
    focal = 0.5 / torch.tan(fov / 2.0) * aspect.clamp(max=1.0)
    middle = torch.full_like(pitch, 0.5)
    return DrawnCameras(pitch, roll, focal, middle, middle, aspect, torch.zeros_like(pitch))


def truth_of(cameras: DrawnCameras, row: int) -> dict[str, float]:
    """Return pitch, roll and vertical field of view [deg] of one of the cameras."""
    return {
        "pitch_deg": math.degrees(float(cameras.pitch[row])),
        "roll_deg": math.degrees(float(cameras.roll[row])),
        "vfov_deg": math.degrees(2.0 * math.atan(0.5 / float(cameras.focal[row]))),
    }


def constant_camera(aspect: float) -> dict[str, float]:
    """Return the camera that is assumed where nothing is known, for a photo's width over height."""
    half = math.tan(math.radians(CONSTANT_FOV) / 2.0) / aspect
    return {"pitch_deg": 0.0, "roll_deg": 0.0, "vfov_deg": math.degrees(2.0 * math.atan(half))}


def photograph(
    path: Path, cameras: DrawnCameras, width: int, generator: torch.Generator
) -> FloatArray:
    """Return one photograph as a camera would store it, display-encoded, shape [H, W, 3].

    Args:
        path: The panorama.
        cameras: One camera; its aspect is that of whole multiples of `SIDE`.
        width: Longer side [px].
        generator: On the CPU: of azimuth, look and faults.

    Raises:
        InputError: The panorama cannot be used.
    """
    draw = Sampler(1, generator)
    panorama = read_panoramas([path], "cpu")
    size = _size(float(cameras.aspect[0]), width)
    # Four rays a pixel.
    radiance = cut(panorama, cameras, torch.zeros(1), draw, (2 * size[0], 2 * size[1]))
    radiance = torch.nn.functional.avg_pool2d(radiance, 2)
    shown = draw_faults(draw_looks(radiance, generator).show(radiance), generator)
    photo: FloatArray = shown[0].permute(1, 2, 0).contiguous().numpy()
    return photo


def _size(aspect: float, longer: int) -> tuple[int, int]:
    """Return height and width [px] of a photograph."""
    sides = (longer / max(aspect, 1.0), longer * min(aspect, 1.0))
    height, width = (max(SIDE, SIDE * round(side / SIDE)) for side in sides)
    return height, width


def unlearned(panoramas: Sequence[Path], network: Calibrator) -> tuple[list[Path], list[str]]:
    """Return the panoramas that a network has not learned from, and notices.

    Where it has learned from all of them, all are returned.
    """
    learned = set(network.record.get("panoramas", ()))
    fresh = [path for path in panoramas if path.stem not in learned]
    known = len(panoramas) - len(fresh)
    if not fresh:
        words = "the network has learned from all of these panoramas: errors elsewhere are larger"
        return list(panoramas), [words]
    words = f"{known} panoramas are left out: the network has learned from them"
    return fresh, [words] if known else []


def measure_cameras(
    panoramas: Sequence[Path], scenes: int, seed: int, width: int, network: Calibrator
) -> dict[str, Any]:
    """Estimate the cameras of photographs, and return the errors.

    Args:
        panoramas: Files, each photographed once before any is photographed again.
        scenes: Photographs.
        seed: Of all random numbers.
        width: Longer side of the photographs [px].
        network: That estimates.

    Returns:
        ``estimated`` and ``constant``, each with ``pitch_deg``, ``roll_deg`` and ``vfov_deg``:
        ``median`` and ``mean`` absolute error; the first also ``within_sigma``, the share of errors
        within one estimated standard deviation, and ``seconds`` per photograph (median).

    Raises:
        InputError: A panorama cannot be used.
    """
    if not panoramas:
        raise InputError("--panoramas", "none with a ground", "sky-only maps show no camera")
    generator = torch.Generator().manual_seed(seed)
    rounds = math.ceil(scenes / len(panoramas))
    shuffled = np.random.default_rng(seed)
    order = [panoramas[k] for _ in range(rounds) for k in shuffled.permutation(len(panoramas))]
    drawn = even_cameras(Sampler(scenes, generator))
    estimated, constant, covered = Errors(), Errors(), Errors()
    seconds = []
    for row, path in enumerate(order[:scenes]):
        one = DrawnCameras(**{k: v[row : row + 1] for k, v in vars(drawn).items()})
        height, columns = _size(float(one.aspect[0]), width)
        one = replace(one, aspect=torch.tensor([columns / height]))
        photo = photograph(path, one, width, generator)
        began = time.perf_counter()
        estimate = estimate_camera(photo, network)
        seconds.append(time.perf_counter() - began)
        _add(estimated, covered, constant, estimate, truth_of(one, 0), columns / height)
    return {
        "estimated": {
            name: _summary(values) | {"within_sigma": float(np.mean(covered[name]))}
            for name, values in estimated.items()
        }
        | {"seconds": float(np.median(seconds))},
        "constant": {name: _summary(values) for name, values in constant.items()},
    }


def _add(
    estimated: Errors,
    covered: Errors,
    constant: Errors,
    estimate: CameraEstimate,
    truth: dict[str, float],
    aspect: float,
) -> None:
    """Append the errors of one photograph to the lists by number."""
    assumed = constant_camera(aspect)
    for name, true in truth.items():
        error = abs(getattr(estimate, name) - true)
        sigma = getattr(estimate, name.replace("_deg", "_sigma_deg"))
        estimated.setdefault(name, []).append(error)
        covered.setdefault(name, []).append(float(error <= sigma))
        constant.setdefault(name, []).append(abs(assumed[name] - true))


def _summary(values: list[float]) -> dict[str, float]:
    """Return median and mean."""
    return {"median": float(np.median(values)), "mean": float(np.mean(values))}


def lines_of(measured: dict[str, Any]) -> list[str]:
    """Return the errors as a table, one line of text each."""
    head = "| camera | pitch, median / mean [deg] | roll | vertical field of view |"
    lines = [head, "|---|---|---|---|"]
    for row in ("estimated", "constant"):
        cells = [
            f"{measured[row][name]['median']:.2f} / {measured[row][name]['mean']:.2f}"
            for name in ("pitch_deg", "roll_deg", "vfov_deg")
        ]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return lines
