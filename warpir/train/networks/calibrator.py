"""The network that estimates cameras as it is trained; see `warpir.calibration.network`.

In training each token of 8 x 8 pixels also answers where up is in the picture and how high above
the horizon it looks (the perspective field of Jin et al. 2023, arXiv:2212.03239), which teaches the
tokens far faster than one answer for the whole photo.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpir.calibration.network import (
    BLUR_REACH,
    HEIGHT,
    NUMBERS,
    PLACES,
    PLANES,
    WIDTH,
    Calibrator,
    medians,
    shapes,
)
from warpir.calibration.weights import read_weights
from warpir.diffusion.models.weight_files import CALIBRATOR_FORMAT, check_calibrator
from warpir.train.networks.blocks import TokenNetwork, TokenSizes, head
from warpir.train.networks.files import (
    filled,
    plain_sizes,
    random_network,
    save_network,
    weights_of,
)

SHAPE = (8, 8)
"""Pixels of a token, rows and columns."""


@dataclass(frozen=True)
class CalibratorConfig(TokenSizes):
    """Sizes of the network."""


def soften(photo: Tensor, sigma: Tensor) -> Tensor:
    """Blur pictures by Gaussians of their own.

    Args:
        photo: Shape [B, C, H, W].
        sigma: Standard deviation down and across [px], shape [B, 2]; 0 leaves a picture as it is.
    """
    for axis in (0, 1):
        # The kernels of a batch are cut where that of its widest picture is.
        reach = max(1, math.ceil(BLUR_REACH * float(sigma[:, axis].max())))
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


class CalibratorModule(TokenNetwork):
    """Photo, its shape and perhaps its focal length to distributions over the camera's numbers.

    There are 16 x 24 tokens, and a head for each number.
    """

    spread: Tensor
    """Factor on the width of each distribution; calibrated on held-out places, shape [5]."""

    def __init__(self, config: CalibratorConfig) -> None:
        super().__init__(config, PLANES, PLACES, len(NUMBERS))
        self.config = config
        self.record: Mapping[str, Any] = {}
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
            photo: As `warpir.calibration.network.seen` gives it, shape [B, 3, 128, 192].
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
    def predict(self, photo: Tensor, aspect: Tensor, focal: Tensor) -> tuple[Tensor, Tensor]:
        """Return `Calibrator.predict` of many photos, [B, 5] each; arguments as of `forward`."""
        plain, mirrored = (
            {
                name: part.double().cpu().numpy()
                for name, part in self(view, aspect, focal)[0].items()
            }
            for view in (photo, photo.flip(-1))
        )
        value, sigma = medians(plain, mirrored, self.spread.double().cpu().numpy())
        return torch.from_numpy(value).to(photo), torch.from_numpy(sigma).to(photo)

    def calibrator(self) -> Calibrator:
        """Return what asks these weights without torch."""
        return Calibrator(weights_of(self, self.config, self.record))


def _coordinates(aspect: Tensor, height: int, width: int) -> Tensor:
    """Return right and down from the middle, in units of the photo's height, [B, 2, H, W]."""
    across = (torch.arange(width, device=aspect.device) + 0.5) / width - 0.5
    down = (torch.arange(height, device=aspect.device) + 0.5) / height - 0.5
    x = (aspect[:, None] * across)[:, None, :].expand(-1, height, -1)
    y = down[None, :, None].expand(len(aspect), -1, width)
    return torch.stack([x, y.to(x.dtype)], dim=1)


def random_calibrator(seed: int, config: CalibratorConfig | None = None) -> CalibratorModule:
    """As `random_network`."""
    return random_network(seed, lambda: CalibratorModule(config or CalibratorConfig()))


def save_calibrator(network: CalibratorModule, path: Path, record: Mapping[str, Any]) -> None:
    """As `save_network`; the record is read back as `CalibratorModule.record`."""
    save_network(network, network.config, path, record, CALIBRATOR_FORMAT)


def read_calibrator(path: Path | None, device: str | torch.device = "cpu") -> CalibratorModule:
    """Read a network for training; see `read_weights`."""
    weights = read_weights(check_calibrator, shapes, path)
    config = CalibratorConfig(**plain_sizes(weights.sizes))
    network = filled(CalibratorModule(config), weights, device)
    network.record = weights.record
    return network
