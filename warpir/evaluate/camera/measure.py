"""Errors of estimated cameras, on photographs cut out of panoramas with cameras drawn at random.

Pitch, roll and field of view are drawn evenly over wide ranges, so that no constant guess can score
well. Panoramas that the network has learned from are left out where others remain.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpir.calibration.estimate import LINES, decided, network_estimate, with_lines
from warpir.calibration.network import Calibrator
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.scene.camera import CameraEstimate
from warpir.train.camera.crops import ASPECTS, DrawnCameras, Panoramas, cut, read_panoramas
from warpir.train.photo_look import draw_faults, draw_looks
from warpir.train.places import learned_from, without_size
from warpir.train.sampler import Sampler

CONSTANT_FOV = 60.0
"""Horizontal field of view that is assumed where nothing is known [deg]."""
SHIFTS = (0.1, 0.4)
"""Least and greatest distance of the optical axis from the middle, over the height, of photographs
that are corrected to upright."""
RANGES = {"pitch": (-40.0, 25.0), "roll": (-20.0, 20.0), "fov": (25.0, 95.0)}
"""Least and greatest pitch, roll and field of view of the shorter side [deg]."""
SIDE = 8
"""Sides of the photographs are multiples of this, as JPEG's blocks are [px]."""
UPRIGHT = ("recognised", "mistaken", "axis", "axis_constant")
"""What is measured of photographs that are corrected to upright; see `measure_cameras`."""
Errors = dict[str, list[float]]


def even_cameras(draw: Sampler) -> DrawnCameras:
    """Draw cameras with even pitch, roll and field of view of the shorter side, within `RANGES`."""
    pitch, roll, fov = (torch.deg2rad(draw.uniform(*RANGES[k])) for k in ("pitch", "roll", "fov"))
    aspect = torch.tensor(ASPECTS)[draw.index(len(ASPECTS))]
    focal = 0.5 / torch.tan(fov / 2.0) * aspect.clamp(max=1.0)
    middle = torch.full_like(pitch, 0.5)
    return DrawnCameras(pitch, roll, focal, middle, middle, aspect, torch.zeros_like(pitch))


def corrected_to_upright(cameras: DrawnCameras, draw: Sampler) -> DrawnCameras:
    """Return cameras that are level, with the optical axis off the middle by a share of `SHIFTS`.

    Args:
        cameras: Field of view and shape are kept.
        draw: Of as many.
    """
    level, sign = torch.zeros_like(cameras.pitch), torch.where(draw.unit() < 0.5, -1.0, 1.0)
    return replace(cameras, pitch=level, roll=level, y=0.5 + sign * draw.uniform(*SHIFTS))


def truth_of(camera: DrawnCameras) -> dict[str, float]:
    """Return pitch, roll and vertical field of view [deg] of one camera."""
    return {
        "pitch_deg": math.degrees(float(camera.pitch)),
        "roll_deg": math.degrees(float(camera.roll)),
        "vfov_deg": math.degrees(2.0 * math.atan(0.5 / float(camera.focal))),
    }


def constant_camera(aspect: float) -> dict[str, float]:
    """Return the camera that is assumed where nothing is known, for a photo's width over height."""
    half = math.tan(math.radians(CONSTANT_FOV) / 2.0) / aspect
    return {"pitch_deg": 0.0, "roll_deg": 0.0, "vfov_deg": math.degrees(2.0 * math.atan(half))}


def photograph(
    panorama: Panoramas, cameras: DrawnCameras, width: int, generator: torch.Generator
) -> FloatArray:
    """Return one photograph as a camera would store it, display-encoded, shape [H, W, 3].

    There is one panorama, on the CPU like the generator, which draws azimuth, look and faults, and
    one camera, whose aspect is that of whole multiples of `SIDE`; ``width`` is the longer side.
    """
    draw = Sampler(1, generator)
    size = _size(float(cameras.aspect[0]), width)
    radiance = cut(panorama, cameras, torch.zeros(1), draw, size)
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
    learned = learned_from(network.record)
    fresh = [path for path in panoramas if without_size(path.stem) not in learned]
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
        ``estimated``, ``network`` (the same without upright edges) and ``constant``, each with
        ``pitch_deg``, ``roll_deg`` and ``vfov_deg``: ``median`` and ``mean`` absolute error; the
        first also ``within_sigma``, the share of errors within one estimated standard deviation,
        ``seconds`` per photograph (median) and ``with_lines``, the share of photographs in which
        enough upright edges agree; ``corrected``, of one more photograph of each panorama that is
        corrected to upright: the share ``recognised``, the share ``mistaken`` of the other
        photographs, the median error of the optical axis' row over the height, ``axis``, and
        that of the middle, ``axis_constant``; ``panoramas``, the names of those that were
        photographed; and ``notices``, what could not be read.

    Raises:
        InputError: None of the panoramas can be used.
    """
    generator = torch.Generator().manual_seed(seed)
    drawn = even_cameras(Sampler(scenes, generator))
    other = torch.Generator().manual_seed(seed + 1)  # its photographs leave the others as they are
    corrected: list[tuple[float, ...]] = []
    errors: dict[str, Errors] = {"estimated": {}, "network": {}, "constant": {}}
    covered = Errors()
    seconds, by_lines, used = [], 0, set[str]()
    notices: list[str] = []
    for row, (panorama, name) in enumerate(_shuffled(panoramas, scenes, seed, notices)):
        used.add(name)
        one = DrawnCameras(**{k: v[row : row + 1] for k, v in vars(drawn).items()})
        height, columns = _size(float(one.aspect[0]), width)
        one = replace(one, aspect=torch.tensor([columns / height]))
        photo = photograph(panorama, one, width, generator)
        began = time.perf_counter()
        alone = network_estimate(photo, network)
        estimate = decided(with_lines(alone, photo))
        seconds.append(time.perf_counter() - began)
        by_lines += LINES in estimate.witnesses
        truth = truth_of(one)
        _add(errors["estimated"], truth, vars(estimate))
        _add(errors["network"], truth, vars(alone))
        _add(errors["constant"], truth, constant_camera(columns / height))
        _add_covered(covered, truth, estimate)
        level = corrected_to_upright(one, Sampler(1, other))
        seen = network_estimate(photograph(panorama, level, width, other), network)
        corrected.append(_upright(estimate, decided(seen), float(level.y[0])))
    summary: dict[str, Any] = {row: _summary(parts) for row, parts in errors.items()}
    for name, inside in covered.items():
        summary["estimated"][name]["within_sigma"] = float(np.mean(inside))
    summary["estimated"]["seconds"] = float(np.median(seconds))
    summary["estimated"]["with_lines"] = by_lines / scenes
    summary["corrected"] = _upright_summary(corrected)
    return summary | {"panoramas": sorted(used), "notices": notices}


def _upright(plain: CameraEstimate, corrected: CameraEstimate, axis: float) -> tuple[float, ...]:
    """Return `UPRIGHT` of one photograph of either kind; the row is the second's true axis."""
    off, off_middle = abs(corrected.principal[1] - axis), abs(0.5 - axis)
    return corrected.is_upright_corrected, plain.is_upright_corrected, off, off_middle


def _upright_summary(photographs: Sequence[tuple[float, ...]]) -> dict[str, float]:
    """Return shares and median errors by `UPRIGHT`."""
    shares, medians = np.mean(photographs, axis=0), np.median(photographs, axis=0)
    return dict(zip(UPRIGHT, [*shares[:2].tolist(), *medians[2:].tolist()], strict=True))


def _shuffled(
    panoramas: Sequence[Path], scenes: int, seed: int, notices: list[str]
) -> Iterator[tuple[Panoramas, str]]:
    """Yield so many panoramas and their names, all in a new order each round.

    Raises:
        InputError: None of them can be used.
    """
    left, order = list(panoramas), np.random.default_rng(seed)
    while left and scenes > 0:
        for path in [left[k] for k in order.permutation(len(left))][:scenes]:
            try:
                panorama = read_panoramas([path], "cpu")
            except InputError as error:
                notices.append(f"left out: {error.where}: {error.what}")
                left.remove(path)
            else:
                scenes -= 1
                yield panorama, path.stem
    if scenes > 0:
        raise InputError("--panoramas", "none can be used", "sky-only maps show no camera")


def _add(errors: Errors, truth: dict[str, float], found: dict[str, Any]) -> None:
    """Append the absolute errors of one photograph to the lists by number."""
    for name, true in truth.items():
        errors.setdefault(name, []).append(abs(found[name] - true))


def _add_covered(covered: Errors, truth: dict[str, float], estimate: CameraEstimate) -> None:
    """Append whether each number lies within its standard deviation."""
    for name, true in truth.items():
        sigma = getattr(estimate, name.replace("_deg", "_sigma_deg"))
        inside = abs(getattr(estimate, name) - true) <= sigma
        covered.setdefault(name, []).append(float(inside))


def _summary(errors: Errors) -> dict[str, dict[str, float]]:
    """Return median and mean of each number's errors."""
    return {
        name: {"median": float(np.median(values)), "mean": float(np.mean(values))}
        for name, values in errors.items()
    }


def lines_of(measured: dict[str, Any]) -> list[str]:
    """Return the errors as a table, one line of text each."""
    head = "| camera | pitch, median / mean [deg] | roll | vertical field of view |"
    lines = [head, "|---|---|---|---|"]
    for row in ("estimated", "network", "constant"):
        cells = [
            f"{measured[row][name]['median']:.2f} / {measured[row][name]['mean']:.2f}"
            for name in ("pitch_deg", "roll_deg", "vfov_deg")
        ]
        lines.append(f"| {row} | {' | '.join(cells)} |")
    upright = measured["corrected"]
    return [
        *lines,
        "",
        f"corrected to upright: {100.0 * upright['recognised']:.0f} % recognised, "
        f"{100.0 * upright['mistaken']:.0f} % of the other photographs mistaken for it; optical "
        f"axis off by {upright['axis']:.3f} of the height (median; the middle would be by "
        f"{upright['axis_constant']:.3f})",
    ]
