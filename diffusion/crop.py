"""Square crops around the object, of random place and size, resampled for the prior.

A small crop shows details, a large one the cues of the scene (DiPIR, section 4.3.2). Pixels have
their centres at +0.5, so a crop of corner ``x`` and side ``s`` covers ``[x, x + s]``, whole or not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from warpir.diffusion.settings import GuidanceSettings

BOX_MIN = 16
"""Smaller objects are cropped as if their box had this side [px]: less is nothing but blur."""


def box_of(mask: Tensor) -> tuple[int, int, int, int]:
    """Return the object's box ``(x0, y0, x1, y1)`` [px], half-open.

    Args:
        mask: Coverage of the object, shape [H, W]; whatever is above 0 counts.

    Raises:
        ValueError: Nothing is covered.
    """
    ys, xs = torch.nonzero(mask > 0, as_tuple=True)
    if len(xs) == 0:
        raise ValueError("mask: the object covers no pixel")
    return int(xs.min()), int(ys.min()), int(xs.max()) + 1, int(ys.max()) + 1


@dataclass(frozen=True)
class Crop:
    """A square part of an image."""

    x: float
    """Left edge [px]."""
    y: float
    """Upper edge [px]."""
    side: float
    """Width and height [px]."""

    def apply(self, image: Tensor, size: int) -> Tensor:
        """Return the crop, bilinearly resampled; its range is the image's.

        Where it shrinks, the bilinear filter is widened so that it averages over the area of a
        pixel of the crop, as Pillow's and torch's ``interpolate(antialias=True)`` do; beside the
        crop it sees the image, and stops at the image's border.

        A row of the crop is a fixed mix of the image's rows, and a column of its columns, so the
        crop is two matrix products. Their gradient is exact, and the same in every run:
        ``grid_sample`` does not average where it shrinks, ``interpolate`` takes whole pixels only,
        and both add up their CUDA gradients in an order that changes.

        Args:
            image: Shape [B, C, H, W].
            size: Side of the crop in pixels of its own.

        Returns:
            Shape [B, C, size, size].
        """
        height, width = image.shape[-2:]
        rows = _filter(self.y, self.side, size, height, image.device).to(image)
        columns = _filter(self.x, self.side, size, width, image.device).to(image)
        return rows @ image @ columns.T


def _filter(start: float, side: float, size: int, length: int, device: torch.device) -> Tensor:
    """Return the weights of an axis' pixels in each pixel of the crop, float64 [size, length]."""
    pixel = side / size
    own, theirs = (
        torch.arange(count, dtype=torch.float64, device=device) + 0.5 for count in (size, length)
    )
    distance = (start + own[:, None] * pixel - theirs).abs()
    weights = (1.0 - distance / max(pixel, 1.0)).clamp(min=0.0)
    return weights / weights.sum(dim=1, keepdim=True)


def draw_crop(
    box: tuple[int, int, int, int],
    image_size: tuple[int, int],
    settings: GuidanceSettings,
    generator: torch.Generator,
) -> Crop:
    """Draw a square around the object (DiPIR, section 4.3.2; the range of its side is ours).

    The side is log-uniform between ``crop_min`` and ``crop_max`` longer sides of the box, at most
    the image's shorter side. The centre is uniform in the box; the crop is then moved into the
    image. The box is that of `box_of`, the image's size is height and width [px]; three numbers are
    drawn, whatever the box.
    """
    height, width = image_size
    x0, y0, x1, y1 = box
    object_side = max(x1 - x0, y1 - y0, BOX_MIN)
    side_max = min(settings.crop_max * object_side, height, width)
    side_min = min(settings.crop_min * object_side, side_max)
    u_side, u_x, u_y = torch.rand(3, dtype=torch.float64, generator=generator).tolist()
    side = side_min * math.exp(u_side * math.log(side_max / side_min))
    x = x0 + u_x * (x1 - x0) - side / 2.0
    y = y0 + u_y * (y1 - y0) - side / 2.0
    return Crop(min(max(x, 0.0), width - side), min(max(y, 0.0), height - side), side)
