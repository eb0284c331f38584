"""What the regressor learns from: photographs and their light.

Pictures are display-encoded, in [0, 1]; light is in photo-linear units: the radiance that the
picture's own decoded pixels have. The camera-yaw frame is the world turned about +Y so that the
camera's horizontal forward direction is -Z.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
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


class Replay:
    """Batches of photos drawn from the newest ``kept`` ones; each is used so often on average."""

    def __init__(
        self, batches: Callable[[int, torch.Generator], PhotoBatch], uses: int, kept: int
    ) -> None:
        self.batches, self.uses, self.kept = batches, uses, kept
        self.held: dict[str, Tensor] = {}
        self.drawn = self.rendered = 0

    def __call__(self, count: int, generator: torch.Generator) -> PhotoBatch:
        """Return a batch of so many photos, drawn with a generator of their device."""
        if self.rendered * self.uses <= self.drawn:
            slot = self.rendered % self.kept * count
            for name, part in vars(self.batches(count, generator)).items():
                shape = (self.kept * count, *part.shape[1:])
                held = self.held.setdefault(name, part.new_empty(shape))
                held[slot : slot + count] = part
            self.rendered += 1
        self.drawn += 1
        filled = min(self.rendered, self.kept) * count
        index = torch.randint(filled, (count,), generator=generator, device=generator.device)
        return PhotoBatch(**{name: held[index] for name, held in self.held.items()})
