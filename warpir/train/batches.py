"""What the two networks of the embedded default learn from: one batch for each.

Pictures are display-encoded, in [0, 1]; light is in photo-linear units: the radiance that the
picture's own decoded pixels have. The camera-yaw frame is the world turned about +Y so that the
camera's horizontal forward direction is -Z.
"""

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class PriorBatch:
    """Composites, right and wrong, and what they were made of."""

    image: Tensor
    """Composites, shape [B, 3, 64, 64]."""
    background: Tensor
    """The same crops without the object, and with each the whole photo that it is cut from,
    squeezed into the same square, shape [B, 6, 64, 64]."""
    gbuffer: Tensor
    """Mask in [0, 1], albedo display-encoded in [0, 1], camera-space unit normals (x right, y up, z
    toward the camera), and the regressor's estimate
    (`warpir.lighting.regression.Regression.matte_picture`): a picture, all 0 beside the object,
    and a direction that is the same everywhere; shape [B, 13, 64, 64]."""
    noun: Tensor
    """Index into `warpir.diffusion.models.embedded_words.NOUNS`, int64, shape [B]."""
    setting: Tensor
    """Index into ``SETTINGS`` there, int64, shape [B]."""
    weather: Tensor
    """Index into ``WEATHERS`` there, int64, shape [B]."""
    kind: Tensor
    """Index into ``KINDS`` there: 0 is consistent, the others say what is wrong; int64, [B]."""


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
