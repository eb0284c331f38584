"""The camera of one photo, estimated, each number with its uncertainty."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F

from warpir.calibration import lines
from warpir.calibration.network import NUMBERS, Calibrator, load_calibrator, seen
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.scene.camera import Camera

NETWORK = "network"
"""Name of the network among the witnesses."""
LINES = "vanishing point of upright edges"
"""Name of the second witness."""


@dataclass(frozen=True)
class CameraEstimate:
    """What a photo shows of its camera.

    Standard deviations are calibrated: about 68 % of errors on places that were not learned from
    are smaller.
    """

    pitch_deg: float
    """Tilt of the optical axis [deg]: positive looks up, negative looks down, as ``--pitch``."""
    roll_deg: float
    """Turn about the camera's own +Z, which points out of the photo toward the viewer [deg]:
    positive is counter-clockwise from behind the camera, so the photo's horizon falls to the right.
    The camera's rotation to the world is Ry(yaw) Rx(pitch) Rz(roll)."""
    vfov_deg: float
    """Vertical field of view [deg]: 2 atan(height / 2 f), wherever the principal point is."""
    principal: tuple[float, float]
    """Principal point as shares of width and height from the top left; (.5, .5) is the middle. In a
    photo that was corrected to upright it is off the middle, and the pitch about 0."""
    pitch_sigma_deg: float
    """Standard deviation of the pitch [deg]."""
    roll_sigma_deg: float
    """Standard deviation of the roll [deg]."""
    vfov_sigma_deg: float
    """Standard deviation of the vertical field of view [deg]."""
    principal_sigma: tuple[float, float]
    """Standard deviations of the principal point, in the same shares."""
    witnesses: tuple[str, ...]
    """What the estimate rests on: `NETWORK`, and `LINES` where enough straight edges agree."""

    def camera(self, width: int, height: int, camera_height: float) -> Camera:
        """Return the estimated camera at (0, camera_height, 0), turned toward -Z.

        Args:
            width: Image width [px].
            height: Image height [px].
            camera_height: Height above the ground [m].
        """
        focal = height / 2.0 / math.tan(math.radians(self.vfov_deg) / 2.0)
        pitch, roll = math.radians(self.pitch_deg), math.radians(self.roll_deg)
        tilt = [[1, 0, 0], [0, math.cos(pitch), -math.sin(pitch)]]
        tilt.append([0, math.sin(pitch), math.cos(pitch)])
        turn = [[math.cos(roll), -math.sin(roll), 0], [math.sin(roll), math.cos(roll), 0]]
        c2w = np.eye(4)
        c2w[:3, :3] = np.array(tilt) @ np.array([*turn, [0, 0, 1]])
        c2w[1, 3] = camera_height
        cx, cy = self.principal[0] * width, self.principal[1] * height
        return Camera(width, height, focal, focal, cx, cy, c2w)


def estimate_camera(
    photo: FloatArray, network: Calibrator | None = None, vfov_deg: float | None = None
) -> CameraEstimate:
    """Estimate the camera of a photo, by the network and by upright edges where enough agree.

    Args:
        photo: Display-encoded (sRGB) in [0, 1], shape [H, W, 3].
        network: Default: the one in the package.
        vfov_deg: Vertical field of view where it is known, as from EXIF [deg]; it is taken over
            with a standard deviation of 0, and the other numbers are estimated with it.

    Raises:
        InputError: The photo has no pixels, or the network's file cannot be used
            (`ExitCode.MODEL`).
    """
    return with_lines(network_estimate(photo, network or load_calibrator(), vfov_deg), photo)


def network_estimate(
    photo: FloatArray, network: Calibrator, vfov_deg: float | None = None
) -> CameraEstimate:
    """Estimate the camera of a photo by the network alone; arguments as of `estimate_camera`.

    Raises:
        InputError: The photo has no pixels.
    """
    if photo.ndim != 3 or photo.shape[2] != 3 or 0 in photo.shape:
        raise InputError("--photo", f"no pixels (found an array of shape {list(photo.shape)})")
    device = network.spread.device
    height, width = photo.shape[:2]
    known = math.nan
    if vfov_deg is not None:
        known = -math.log(2.0 * math.tan(math.radians(vfov_deg) / 2.0))
    picture = torch.from_numpy(np.ascontiguousarray(photo, np.float32)).to(device)
    answer = network.predict(
        seen(picture.permute(2, 0, 1)[None].clamp(0.0, 1.0)),
        torch.tensor([width / height], device=device),
        torch.tensor([known], device=device),
    )
    value = dict(zip(NUMBERS, answer.value[0].tolist(), strict=True))
    sigma = dict(zip(NUMBERS, answer.sigma[0].tolist(), strict=True))
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
    whole = torch.from_numpy(np.ascontiguousarray(photo, np.float32)).permute(2, 0, 1)[None]
    small = F.interpolate(whole, size, mode="bilinear", antialias=True)
    camera = estimate.camera(size[1], size[0], 1.0)
    found = lines.upright_roll(
        lines.find_segments(small[0].permute(1, 2, 0).numpy()),
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
