"""The camera of one photo, estimated, each number with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import replace

from warpir.calibration import lines
from warpir.calibration.network import NUMBERS, Calibrator, load_calibrator, seen
from warpir.calibration.not_pinhole import looks_like
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.io.images.resize import resize
from warpir.scene.camera import CameraEstimate

NETWORK = "network"
"""Name of the network among the witnesses."""
CORRECTED_SHIFT = 0.08
"""Distance of the estimated principal point from the middle, over the height, from which a photo
counts as corrected to upright."""
NOT_PINHOLE_SIGMA_DEG = 30.0
"""Least standard deviation of pitch and field of view of a picture that no pinhole camera takes,
which the network has never seen and answers as confidently as any other [deg]."""
LINES = "vanishing point of upright edges"
"""Name of the second witness."""


def estimate_camera(
    photo: FloatArray, network: Calibrator | None = None, vfov_deg: float | None = None
) -> CameraEstimate:
    """Estimate the camera of a photo, by the network and by upright edges where enough agree.

    The principal point is the middle, unless the photo looks corrected to upright (`decided`). What
    looks like a picture that no pinhole camera takes (`looks_like`) has a wide uncertainty.

    Args:
        photo: Display-encoded (sRGB) in [0, 1], shape [H, W, 3].
        network: Default: the one in the package.
        vfov_deg: Vertical field of view where it is known, as from EXIF [deg]; it is taken over
            with a standard deviation of 0, and the other numbers are estimated with it.

    Raises:
        InputError: The photo has no pixels, or values outside of [0, 1] such as codes of 8 bits, or
            the network's file cannot be used (`ExitCode.MODEL`).
    """
    if photo.size and not 0.0 <= photo.min() <= photo.max() <= 1.0:  # nor NaN
        values = f"found {photo.min():g} to {photo.max():g}"
        what = f"expected display-encoded values from 0 to 1 ({values})"
        raise InputError("--photo", what, "divide codes of 8 bits by 255")
    alone = network_estimate(photo, network or load_calibrator(), vfov_deg)
    found = decided(with_lines(alone, photo))
    seen_as = looks_like(photo)
    if not seen_as:
        return found
    pitch_sigma = max(found.pitch_sigma_deg, NOT_PINHOLE_SIGMA_DEG)
    fov_sigma = max(found.vfov_sigma_deg, NOT_PINHOLE_SIGMA_DEG) if vfov_deg is None else 0.0
    return replace(found, pitch_sigma_deg=pitch_sigma, vfov_sigma_deg=fov_sigma, looks_like=seen_as)


def network_estimate(
    photo: FloatArray, network: Calibrator, vfov_deg: float | None = None
) -> CameraEstimate:
    """Estimate the camera of a photo by the network alone; arguments as of `estimate_camera`.

    Raises:
        InputError: The photo has no pixels.
    """
    if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
        raise InputError("--photo", f"no pixels (found an array of shape {list(photo.shape)})")
    height, width = photo.shape[:2]
    known = math.nan
    if vfov_deg is not None:
        known = -math.log(2.0 * math.tan(math.radians(vfov_deg) / 2.0))
    answer = network.predict(seen(photo.clip(0.0, 1.0)), width / height, known)
    value = dict(zip(NUMBERS, answer.value.tolist(), strict=True))
    sigma = dict(zip(NUMBERS, answer.sigma.tolist(), strict=True))
    if vfov_deg is None:
        fov = 2.0 * math.atan(0.5 * math.exp(-value["focal"]))
        # d fov / d log f = -2 t / (1 + t^2) = -sin(fov), with t = tan(fov / 2) = 1 / (2 f).
        fov_sigma = math.degrees(math.sin(fov) * sigma["focal"])
        vfov_deg = math.degrees(fov)
    else:
        fov_sigma = 0.0
    return CameraEstimate(
        pitch_deg=value["pitch"],
        roll_deg=value["roll"],
        vfov_deg=vfov_deg,
        principal=(value["x"], value["y"]),
        pitch_sigma_deg=sigma["pitch"],
        roll_sigma_deg=sigma["roll"],
        vfov_sigma_deg=fov_sigma,
        principal_sigma=(sigma["x"], sigma["y"]),
        witnesses=(NETWORK,),
    )


def decided(estimate: CameraEstimate) -> CameraEstimate:
    """Return an estimate whose principal point is the middle, or clearly above or below it.

    Nearly all photos are either as the lens drew them, then the optical axis is in the middle, or
    corrected to upright, then it is far off. Where it is put into the middle the pitch changes such
    that the horizon stays, of which the photo shows more than of either.

    Args:
        estimate: With the distributions' medians for both.
    """
    shift = estimate.principal[1] - 0.5
    if abs(shift) > CORRECTED_SHIFT:
        return replace(estimate, principal=(0.5, estimate.principal[1]))
    focal = 0.5 / math.tan(math.radians(estimate.vfov_deg) / 2.0)
    # The horizon is y + f tan(pitch) / cos(roll) in the middle column, in heights.
    risen = shift * math.cos(math.radians(estimate.roll_deg)) / focal
    pitch = math.atan(math.tan(math.radians(estimate.pitch_deg)) + risen)
    return replace(estimate, principal=(0.5, 0.5), pitch_deg=math.degrees(pitch))


def with_lines(estimate: CameraEstimate, photo: FloatArray) -> CameraEstimate:
    """Join an estimate with the roll that upright edges tell, by inverse variances.

    Args:
        estimate: The network's.
        photo: Display-encoded in [0, 1], shape [H, W, 3].
    """
    height, width = photo.shape[:2]
    factor = min(1.0, lines.LONGER_SIDE / max(height, width))
    size = (max(1, round(height * factor)), max(1, round(width * factor)))
    if min(size) < lines.SHORTEST:
        return estimate
    camera = estimate.camera(size[1], size[0], 1.0)
    found = lines.upright_roll(
        lines.find_segments(resize(photo, *size)),
        (camera.cx, camera.cy),
        camera.fx,
        estimate.pitch_deg,
        estimate.roll_deg,
    )
    if found is None:
        return estimate
    roll, sigma = _joined((estimate.roll_deg, estimate.roll_sigma_deg), (found, lines.SIGMA_DEG))
    witnesses = (*estimate.witnesses, LINES)
    return replace(estimate, roll_deg=roll, roll_sigma_deg=sigma, witnesses=witnesses)


def _joined(*witnesses: tuple[float, float]) -> tuple[float, float]:
    """Return the mean of values by inverse variance, and its standard deviation."""
    weights = [1.0 / max(sigma, 1e-3) ** 2 for _, sigma in witnesses]
    total = sum(weights)
    mean = sum(w * value for w, (value, _) in zip(weights, witnesses, strict=True)) / total
    return mean, total**-0.5
