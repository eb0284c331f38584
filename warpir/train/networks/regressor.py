"""The light regressor as it is trained: what it answers is of `warpir.lighting.regressor`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpir.calibration.weights import read_weights
from warpir.core.color import GAMMA, LUMINANCE_WEIGHTS
from warpir.diffusion.models.weight_files import REGRESSOR_FORMAT, check_regressor
from warpir.lighting.regressor import (
    ASKING,
    DARKEST,
    LEVEL_COUNT,
    PLACES,
    PLANES,
    Prediction,
    Regressor,
    averaged,
    candidates,
    shapes,
)
from warpir.train.networks.blocks import TokenNetwork, TokenSizes, head
from warpir.train.networks.files import (
    filled,
    plain_sizes,
    random_network,
    save_network,
    weights_of,
)


@dataclass(frozen=True)
class RegressorConfig(TokenSizes):
    """Sizes of the network."""

    channels: tuple[int, int, int] = (48, 96, 160)
    heads: int = 5
    directions: int = 1000
    """Of the whole sphere; those that lie low are left out."""
    hidden: float = 0.3
    """Share of the tokens that training hides: no single corner of a place may tell its light."""
    members: int = 1
    """Networks whose answers are averaged."""


def mean_luminance(photo: Tensor) -> Tensor:
    """Return `warpir.lighting.regressor.mean_luminance` of photos [B, 3, H, W], shape [B]."""
    photo = photo.to(torch.promote_types(photo.dtype, torch.float32))
    weights = photo.new_tensor(LUMINANCE_WEIGHTS)
    mean = photo.clamp(min=0.0).pow(GAMMA).mean(dim=(2, 3))
    return (mean @ weights).clamp(min=DARKEST)


class Member(TokenNetwork):
    """One network: photo and rays to a flat prediction.

    There are 12 x 18 tokens, and two heads, for direction and for levels. Where a token looks takes
    the place of a position: it holds for every field of view.
    """

    def __init__(self, config: RegressorConfig, direction_count: int, level_count: int) -> None:
        super().__init__(config, PLANES, PLACES, ASKING)
        self.hidden, wide = config.hidden, config.channels[-1]
        self.direction_head = head(wide, config.dropout, direction_count)
        self.level_head = head(wide, config.dropout, level_count)

    def last_layers(self) -> tuple[nn.Linear, nn.Linear]:
        """Return what gives the logits of the directions, and what gives the levels."""
        direction, levels = self.direction_head[-1], self.level_head[-1]
        assert isinstance(direction, nn.Linear) and isinstance(levels, nn.Linear)
        return direction, levels

    def forward(self, photo: Tensor, rays: Tensor) -> Tensor:
        """Return a flat prediction; arguments are those of `RegressorModule.forward`."""
        x = self.features(torch.cat([photo * 2.0 - 1.0, rays], dim=1))
        looking = F.adaptive_avg_pool2d(rays, (x.shape[2], x.shape[3])).flatten(2).transpose(1, 2)
        tokens = x.flatten(2).transpose(1, 2) + self.place(looking)
        if self.training and self.hidden > 0.0:
            count = max(1, round(tokens.shape[1] * (1.0 - self.hidden)))
            order = torch.rand(tokens.shape[:2], device=tokens.device).argsort(dim=1)[:, :count]
            tokens = tokens.gather(1, order[..., None].expand(-1, -1, tokens.shape[2]))
        tokens = self.mixed(tokens)
        # Softmax and exponentials of the answers need more digits than autocast leaves.
        with torch.autocast(tokens.device.type, enabled=False):
            direction, levels = self.read(tokens)[0].unbind(dim=1)
            return torch.cat([self.direction_head(direction), self.level_head(levels)], dim=1)


class RegressorModule(nn.Module):
    """Photo and rays to flat predictions, by one network or by several."""

    directions: Tensor
    """Candidates, camera-yaw frame, shape [K, 3]; in the file, so that weights keep their own."""
    temperature: Tensor
    """Divides the mean logits; calibrated on places held out of every network, shape []."""
    mean_light: Tensor
    """The training set's mean light as one constant prediction, flat as `split` takes it."""

    def __init__(self, config: RegressorConfig) -> None:
        super().__init__()
        self.config = config
        self.record: Mapping[str, Any] = {}
        """How it was trained; plain values."""
        directions = torch.from_numpy(candidates(config.directions)).float()
        self.register_buffer("directions", directions)
        self.register_buffer("temperature", torch.ones(()))
        self.register_buffer("mean_light", torch.zeros(len(directions) + LEVEL_COUNT))
        self.members = nn.ModuleList(
            Member(config, len(directions), LEVEL_COUNT) for _ in range(config.members)
        )

    def last_layers(self) -> list[tuple[nn.Linear, nn.Linear]]:
        """Return `Member.last_layers` of each member."""
        return [m.last_layers() for m in self.members if isinstance(m, Member)]

    def forward(self, photo: Tensor, rays: Tensor) -> Tensor:
        """Return the flat predictions of the members, shape [M, B, K + LEVEL_COUNT].

        Args:
            photo: Display-encoded, shape [B, 3, 96, 144].
            rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
        """
        return torch.stack([member(photo, rays) for member in self.members])

    @torch.no_grad()
    def predict(self, photo: Tensor, rays: Tensor) -> Prediction:
        """Return `Regressor.predict` of many photos, as tensors; arguments as of `forward`."""
        turned = rays.flip(-1) * rays.new_tensor([-1.0, 1.0, 1.0]).view(1, 3, 1, 1)
        views = ((photo, rays), (photo.flip(-1), turned))
        seen, reflected = (self(*view).double().cpu().numpy() for view in views)
        mean = averaged(seen, reflected, float(self.temperature))
        return Prediction(*(torch.from_numpy(np.asarray(part)).to(rays) for part in mean))

    def regressor(self) -> Regressor:
        """Return what asks these weights without torch."""
        return Regressor.of(weights_of(self, self.config, self.record))


def random_regressor(seed: int, config: RegressorConfig | None = None) -> RegressorModule:
    """As `random_network`."""
    return random_network(seed, lambda: RegressorModule(config or RegressorConfig()))


def save_regressor(network: RegressorModule, path: Path, record: Mapping[str, Any]) -> None:
    """As `save_network`; the record is read back as `RegressorModule.record`."""
    exact = {"temperature", "directions"}
    save_network(network, network.config, path, record, REGRESSOR_FORMAT, exact)


def read_regressor(path: Path | None, device: str | torch.device = "cpu") -> RegressorModule:
    """Read a network for training; see `read_weights`."""
    weights = read_weights(check_regressor, shapes, path)
    config = RegressorConfig(**plain_sizes(weights.sizes))
    network = filled(RegressorModule(config), weights, device)
    network.record = weights.record
    return network
