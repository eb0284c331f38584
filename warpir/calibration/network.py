"""The network that estimates a camera from a photo: a distribution over each of its numbers.

A photo is stretched to 128 x 192 pixels; the coordinates of its pixels, in units of its height,
come along and say how it was stretched. A distribution is a histogram, so that "looks up" and "was
corrected to upright" can both stay open. In training each token of 8 x 8 pixels also answers where
up is in the picture and how high above the horizon it looks (the perspective field of Jin et al.
2023, arXiv:2212.03239), which teaches the tokens far faster than one answer for the whole photo.

Photos are blurred alike before they are seen. The panoramas that it learned from are coarse beside
photos, so sharpness would otherwise tell the field of view in training and mislead afterwards.

Frames and signs are those of `warpir.scene.camera`: the camera looks along its -Z with +X right and
+Y up, and its rotation to the world is Ry(yaw) Rx(pitch) Rz(roll).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpir.calibration.blocks import TokenNetwork, TokenSizes, head
from warpir.calibration.network_files import load_network, random_network, save_network
from warpir.diffusion.models.weight_files import CALIBRATOR_FORMAT, check_calibrator

HEIGHT, WIDTH = 128, 192
"""Size that the network sees [px]; photos of other shapes are stretched."""
BLUR = 1.4
"""Standard deviation of the blur of every photo that the network sees, over the photo's height
times `HEIGHT`: 1 is a row of what it sees."""
MIRRORED = ("roll", "x")
"""Numbers whose distribution turns over when the photo is mirrored."""


class Bins(NamedTuple):
    """The histogram of one number of the camera."""

    low: float
    high: float
    number: int

    def centres(self, like: Tensor) -> Tensor:
        """Return the middle of each bin, shape [K]."""
        step = (self.high - self.low) / self.number
        return self.low + step * (torch.arange(self.number, device=like.device) + 0.5)

    def quantile(self, probability: Tensor, share: float) -> Tensor:
        """Return the value below which a share of each distribution lies, shape [B].

        Args:
            probability: Of each bin, spread evenly within it; rows sum to 1; shape [B, K].
            share: In (0, 1).
        """
        above = probability.cumsum(dim=1)
        index = (above < share).sum(dim=1, keepdim=True).clamp(max=self.number - 1)
        inside = probability.gather(1, index).clamp(min=1e-12)
        below = above.gather(1, index) - inside
        step = (self.high - self.low) / self.number
        position = index + ((share - below) / inside).clamp(0.0, 1.0)
        return self.low + step * position[:, 0]


NUMBERS = {
    "pitch": Bins(-92.0, 64.0, 104),
    "roll": Bins(-45.5, 45.5, 91),
    "focal": Bins(-1.15, 1.45, 65),
    "x": Bins(0.0, 1.0, 41),
    "y": Bins(-0.2, 1.2, 57),
}
"""Pitch [deg], roll [deg], natural logarithm of the focal length over the photo's height, and the
principal point as shares of width and height from the top left; the order of the heads."""
SHAPE = (8, 8)
"""Pixels of a token, rows and columns."""


@dataclass(frozen=True)
class CalibratorConfig(TokenSizes):
    """Sizes of the network."""


class CameraNumbers(NamedTuple):
    """Most likely cameras of B photos, and how wrong they may be; shape [B, 5], as `NUMBERS`."""

    value: Tensor
    sigma: Tensor
    """Standard deviations in the same units; 68 % of errors lie within one."""


def soften(photo: Tensor, sigma: Tensor) -> Tensor:
    """Blur pictures by Gaussians of their own.

    Args:
        photo: Shape [B, C, H, W].
        sigma: Standard deviation down and across [px], shape [B, 2]; 0 leaves a picture as it is.
    """
    for axis in (0, 1):
        # The kernel is cut at three standard deviations of the widest picture of the batch.
        reach = max(1, math.ceil(3.0 * float(sigma[:, axis].max())))
        offsets = torch.arange(-reach, reach + 1, device=photo.device, dtype=photo.dtype)
        weights = torch.exp(-0.5 * (offsets / sigma[:, axis : axis + 1].clamp(min=1e-3)) ** 2)
        weights = weights / weights.sum(dim=1, keepdim=True)
        size = photo.shape[2 + axis]
        padding = (0, 0, reach, reach) if axis == 0 else (reach, reach, 0, 0)
        padded = F.pad(photo, padding, mode="replicate")
        photo = torch.zeros_like(photo)
        for k, weight in enumerate(weights.unbind(dim=1)):
            photo.addcmul_(padded.narrow(2 + axis, k, size), weight[:, None, None, None])
    return photo


def blur_sigma(rows: Tensor, aspect: Tensor) -> Tensor:
    """Return the blur [px] down and across of stretched photos, shape [B, 2].

    Args:
        rows: The blur, over the photo's height times `HEIGHT`, shape [B].
        aspect: Width of the photo over its height before it was stretched, shape [B].
    """
    return torch.stack([rows, rows * (WIDTH / HEIGHT) / aspect], dim=1)


def seen(photo: Tensor) -> Tensor:
    """Return photos as the network sees them: stretched to 128 x 192 and blurred.

    Args:
        photo: Display-encoded, shape [B, 3, H, W].
    """
    height, width = photo.shape[2:]
    small = F.interpolate(photo, (HEIGHT, WIDTH), mode="bilinear", antialias=True)
    rows = torch.full((len(photo),), BLUR, device=photo.device)
    return soften(small, blur_sigma(rows, torch.full_like(rows, width / height)).clamp(max=WIDTH))


class Calibrator(TokenNetwork):
    """Photo, its shape and perhaps its focal length to distributions over the camera's numbers.

    There are 16 x 24 tokens, and a head for each number.
    """

    spread: Tensor
    """Factor on the width of each distribution; calibrated on held-out places, shape [5]."""

    def __init__(self, config: CalibratorConfig) -> None:
        super().__init__(config, planes=5, places=5, asking=len(NUMBERS))
        self.config = config
        self.record: dict[str, Any] = {}
        """How it was trained; plain values."""
        self.register_buffer("spread", torch.ones(len(NUMBERS)))
        wide = config.channels[-1]
        self.numbers = nn.ModuleDict(
            {name: head(wide, config.dropout, bins.number) for name, bins in NUMBERS.items()}
        )
        self.field = head(wide, 0.0, 3)

    def forward(
        self, photo: Tensor, aspect: Tensor, focal: Tensor
    ) -> tuple[dict[str, Tensor], Tensor]:
        """Return the logits of each number's bins, and the perspective field of the tokens.

        Args:
            photo: As `seen` gives it, shape [B, 3, 128, 192].
            aspect: Width over height before it was stretched, shape [B].
            focal: Logarithm of the focal length over the height where it is known, else NaN,
                shape [B].

        Returns:
            Logits of shape [B, K] by the names of `NUMBERS`; and, shape [B, 384, 3], where up is
            in the picture (right, up; any length) and the elevation [rad] of what a token sees.
        """
        plane = _coordinates(aspect, HEIGHT, WIDTH)
        x = self.features(torch.cat([photo * 2.0 - 1.0, plane], dim=1))
        known = ~focal.isnan()
        given = torch.where(known, focal, torch.zeros_like(focal))
        about = torch.stack([aspect.log(), known.to(aspect.dtype), given], dim=1)
        where = _coordinates(aspect, *x.shape[2:]).flatten(2).transpose(1, 2)
        about = about[:, None].expand(-1, where.shape[1], -1)
        tokens = x.flatten(2).transpose(1, 2) + self.place(torch.cat([where, about], dim=2))
        tokens = self.mixed(tokens)
        # Softmax and exponentials of the answers need more digits than autocast leaves.
        with torch.autocast(tokens.device.type, enabled=False):
            read, others = self.read(tokens)
            heads = zip(self.numbers.items(), read.unbind(dim=1), strict=True)
            return {name: answer(part) for (name, answer), part in heads}, self.field(others)

    @torch.no_grad()
    def predict(self, photo: Tensor, aspect: Tensor, focal: Tensor) -> CameraNumbers:
        """Return the medians of the distributions and their calibrated standard deviations.

        The network is asked twice, for the photo and for its mirror image, and the distributions
        are averaged: a mirrored photo gives the mirrored camera by construction.

        Args:
            photo: As `seen` gives it, shape [B, 3, 128, 192].
            aspect: Width over height before it was stretched, shape [B].
            focal: Logarithm of the focal length over the height where it is known, else NaN,
                shape [B].
        """
        both = torch.cat([photo, photo.flip(-1)])
        logits, _ = self(both, aspect.repeat(2), focal.repeat(2))
        value, sigma = [], []
        for name, bins in NUMBERS.items():
            plain, mirrored = logits[name].softmax(dim=1).chunk(2)
            turned = mirrored.flip(-1) if name in MIRRORED else mirrored
            probability = 0.5 * (plain + turned)
            value.append(bins.quantile(probability, 0.5))
            # A Gaussian has 68 % between these two, one standard deviation to either side.
            low, high = (bins.quantile(probability, share) for share in (0.16, 0.84))
            sigma.append(0.5 * (high - low))
        return CameraNumbers(torch.stack(value, 1), torch.stack(sigma, 1) * self.spread)


def _coordinates(aspect: Tensor, height: int, width: int) -> Tensor:
    """Return right and down from the middle, in units of the photo's height, [B, 2, H, W]."""
    across = (torch.arange(width, device=aspect.device) + 0.5) / width - 0.5
    down = (torch.arange(height, device=aspect.device) + 0.5) / height - 0.5
    x = (aspect[:, None] * across)[:, None, :].expand(-1, height, -1)
    y = down[None, :, None].expand(len(aspect), -1, width)
    return torch.stack([x, y.to(x.dtype)], dim=1)


def random_calibrator(seed: int, config: CalibratorConfig | None = None) -> Calibrator:
    """As `random_network`."""
    return random_network(seed, lambda: Calibrator(config or CalibratorConfig()))


def save_calibrator(network: Calibrator, path: Path, record: Mapping[str, Any]) -> None:
    """As `save_network`; the record is read back as `Calibrator.record`."""
    save_network(network, network.config, path, record, CALIBRATOR_FORMAT)


def load_calibrator(path: Path | None = None, device: str | torch.device = "cpu") -> Calibrator:
    """Read a network for `warpir.calibration.estimate.estimate_camera`; see `load_network`."""
    network, record = load_network(
        check_calibrator, lambda sizes: Calibrator(CalibratorConfig(**sizes)), path, device
    )
    network.record = record
    return network
