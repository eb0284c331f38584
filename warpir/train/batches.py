"""What the regressor learns from: photographs and their light.

Pictures are display-encoded, in [0, 1]; light is in photo-linear units: the radiance that the
picture's own decoded pixels have. The camera-yaw frame is the world turned about +Y so that the
camera's horizontal forward direction is -Z.
"""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class PhotoBatch:
    """Photos and the light they were taken in."""

    photo: Tensor
    """Shape [B, 3, 96, 144]."""
    rays: Tensor
    """Unit viewing direction of each pixel, camera-yaw frame, shape [B, 3, 96, 144]."""
    axis: Tensor
    """Unit direction toward the dominant light, camera-yaw frame, shape [B, 3]."""
    share: Tensor
    """Share of a sphere's mean irradiance that the dominant light gives, in [0, 1], shape [B]."""
    sun: Tensor
    """Irradiance of a surface that faces the dominant light, linear RGB, shape [B, 3]."""
    sigma: Tensor
    """Angular standard deviation of the dominant light [rad], shape [B]."""
    ambient: Tensor
    """Radiance of all other light, lat-long in the camera-yaw frame, shape [B, 8, 16, 3]."""
    has_cue: Tensor
    """Whether anything in the photo can tell the direction, bool, shape [B]."""
