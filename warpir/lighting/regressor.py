"""The network that estimates HDR light, with its uncertainty, from a photo and its camera.

A small network sees the photo and the viewing direction of each pixel. It answers with a
distribution over fixed directions for the dominant light (so that "ahead or behind" can stay open),
that light's irradiance, colour, softness and share, and broad spherical Gaussians for all other
light; each level comes with a variance. Levels are logarithms relative to the photo's own mean
decoded luminance, so exposure drops out. It is asked twice, for the photo and for its mirror image,
and the answers are averaged: a mirrored photo gives the mirrored light by construction. What ships
holds several such networks, each trained without some of the places; their answers are averaged,
and where they disagree the variances grow.

The camera-yaw frame is the world turned about +Y so that the camera looks along -Z.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpir.calibration.blocks import TokenNetwork, TokenSizes, head
from warpir.calibration.network_files import load_network, random_network, save_network
from warpir.core.arrays import Float64Array
from warpir.core.color import GAMMA, LUMINANCE_WEIGHTS
from warpir.diffusion.models.weight_files import REGRESSOR_FORMAT as FORMAT
from warpir.diffusion.models.weight_files import check_regressor

HEIGHT, WIDTH = 96, 144
"""Size that the network sees [px]; photos of other shapes are stretched, and the rays say so."""
AMBIENT_SHARPNESS = 4.0
"""Of the 14 ambient lobes: with equal amplitudes their sum is even within 4 %."""
DARKEST = 1e-4
"""Mean luminance below which a photo counts as this bright."""
LOWEST = -0.25
"""Height y of the lowest direction that a dominant light may have."""


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


class Prediction(NamedTuple):
    """The network's output for B photos, camera-yaw frame; levels are natural logarithms."""

    logits: Tensor
    """Of the candidate directions, shape [B, K]."""
    level: Tensor
    """Log luminance of the irradiance that faces the dominant light, over the photo's mean
    luminance, shape [B]."""
    level_log_var: Tensor
    tint: Tensor
    """Log ratios red / green and blue / green of that irradiance, shape [B, 2]."""
    tint_log_var: Tensor
    softness: Tensor
    """Log angular standard deviation of the dominant light [log rad], shape [B]."""
    softness_log_var: Tensor
    share: Tensor
    """Logit of the dominant light's share of a sphere's mean irradiance, shape [B]."""
    ambient: Tensor
    """Log amplitudes of the ambient lobes over the photo's mean luminance, shape [B, 14, 3]."""
    ambient_log_var: Tensor
    """Of the log irradiance of the ambient light, shape [B]."""


def candidates(count: int) -> Float64Array:
    """Return directions that a dominant light may have, camera-yaw frame, shape [K, 3].

    Rings of cells of equal area, as if ``count`` covered the whole sphere. The second half mirrors
    the first (x negated), so that turning a distribution over is a roll by K / 2.
    """
    spacing = math.sqrt(4.0 * math.pi / count)
    lowest = math.asin(LOWEST)
    edges = np.linspace(lowest, math.pi / 2.0, round((math.pi / 2.0 - lowest) / spacing) + 1)
    rings = []
    for low, high in itertools.pairwise(edges):
        # Half of the ring, x > 0; azimuths from -Z.
        half = max(round(math.pi * (math.sin(high) - math.sin(low)) / spacing**2), 1)
        azimuth = math.pi * (np.arange(half) + 0.5) / half
        elevation = 0.5 * (low + high)
        level = math.cos(elevation)
        height = np.full(half, math.sin(elevation))
        rings.append(np.stack([level * np.sin(azimuth), height, -level * np.cos(azimuth)], axis=1))
    right = np.concatenate(rings)
    return np.concatenate([right, right * (-1.0, 1.0, 1.0)])


def ambient_axes() -> Float64Array:
    """Return the axes of the ambient lobes: faces and corners of a cube, shape [14, 3]."""
    steps = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    chosen: Float64Array = steps[np.isin(np.abs(steps).sum(axis=1), (1.0, 3.0))]
    axes: Float64Array = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return axes


def mean_luminance(photo: Tensor) -> Tensor:
    """Return the mean decoded luminance of display-encoded photos [B, 3, H, W], shape [B]."""
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
        super().__init__(config, planes=6, places=3, asking=2)
        self.hidden, wide = config.hidden, config.channels[-1]
        self.direction_head = head(wide, config.dropout, direction_count)
        self.level_head = head(wide, config.dropout, level_count)

    def last_layers(self) -> tuple[nn.Linear, nn.Linear]:
        """Return what gives the logits of the directions, and what gives the levels."""
        direction, levels = self.direction_head[-1], self.level_head[-1]
        assert isinstance(direction, nn.Linear) and isinstance(levels, nn.Linear)
        return direction, levels

    def forward(self, photo: Tensor, rays: Tensor) -> Tensor:
        """Return a flat prediction; arguments are those of `Regressor.forward`."""
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


class Regressor(nn.Module):
    """Photo and rays to `Prediction`, by one network or by several whose answers are averaged."""

    directions: Tensor
    """Candidates, camera-yaw frame, shape [K, 3]; in the file, so that weights keep their own."""
    temperature: Tensor
    """Divides the mean logits; calibrated on places held out of every network, shape []."""
    mean_light: Tensor
    """The training set's mean light as one constant prediction, flat as `split` takes it."""

    def __init__(self, config: RegressorConfig) -> None:
        super().__init__()
        self.config = config
        self.record: dict[str, Any] = {}
        """How it was trained; plain values."""
        directions = torch.from_numpy(candidates(config.directions)).float()
        self.register_buffer("directions", directions)
        self.register_buffer("temperature", torch.ones(()))
        self.level_count = 10 + 3 * len(ambient_axes())
        self.register_buffer("mean_light", torch.zeros(len(directions) + self.level_count))
        self.members = nn.ModuleList(
            Member(config, len(directions), self.level_count) for _ in range(config.members)
        )

    def last_layers(self) -> list[tuple[nn.Linear, nn.Linear]]:
        """Return `Member.last_layers` of each member."""
        return [m.last_layers() for m in self.members if isinstance(m, Member)]

    def forward(self, photo: Tensor, rays: Tensor) -> Tensor:
        """Return flat predictions, shape [B, K + level_count]; `split` names the parts.

        Logits and levels are means over the members. The variance of a level is that of the
        mixture: the mean of the members' variances plus the variance of their answers.

        Args:
            photo: Display-encoded, shape [B, 3, 96, 144].
            rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
        """
        flats = torch.stack([member(photo, rays) for member in self.members])
        mean = flats.mean(dim=0)
        if len(self.members) == 1:
            return mean
        each = self.split(flats.flatten(0, 1))

        def mixture(levels: Tensor, log_var: Tensor) -> Tensor:
            levels, log_var = (part.unflatten(0, flats.shape[:2]) for part in (levels, log_var))
            return torch.log(log_var.exp().mean(dim=0) + levels.var(dim=0, correction=0))

        of_level = mixture(each.level, each.level_log_var)
        of_tint = mixture(each.tint, each.tint_log_var)
        of_softness = mixture(each.softness, each.softness_log_var)
        brightness = each.ambient.logsumexp(dim=(1, 2))
        of_ambient = mixture(brightness, each.ambient_log_var)
        mean = mean.clone()
        first = len(self.directions)
        mean[:, first + 1], mean[:, first + 4 : first + 6] = of_level, of_tint
        mean[:, first + 7], mean[:, -1] = of_softness, of_ambient
        return mean

    def split(self, flat: Tensor) -> Prediction:
        """Name the parts of a flat prediction, shape [B, K + level_count]."""
        count = len(self.directions)
        levels = flat[:, count:]
        return Prediction(
            logits=flat[:, :count],
            level=levels[:, 0],
            level_log_var=levels[:, 1].clamp(-8.0, 6.0),
            tint=levels[:, 2:4],
            tint_log_var=levels[:, 4:6].clamp(-8.0, 6.0),
            # The offset is where most lights lie: between the sun and a window.
            softness=levels[:, 6] - 3.0,
            softness_log_var=levels[:, 7].clamp(-8.0, 6.0),
            share=levels[:, 8],
            ambient=levels[:, 9:-1].unflatten(1, (-1, 3)),
            ambient_log_var=levels[:, -1].clamp(-8.0, 6.0),
        )

    def mirrored(self, prediction: Prediction) -> Prediction:
        """Return what a prediction says of the mirror image: x of every direction negated."""
        half = len(self.directions) // 2
        return prediction._replace(
            logits=prediction.logits.roll(half, dims=1),
            ambient=prediction.ambient[:, _AMBIENT_MIRROR],
        )

    @torch.no_grad()
    def predict(self, photo: Tensor, rays: Tensor, call: Callable[..., Any] = map) -> Prediction:
        """Return the mean over photo and mirror image, with calibrated logits.

        Args:
            photo: Display-encoded, shape [B, 3, 96, 144].
            rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
            call: As `map`; that of a pool looks at both at once.
        """
        turned = rays.flip(-1) * rays.new_tensor([-1.0, 1.0, 1.0]).view(1, 3, 1, 1)
        look = torch.no_grad()(self)  # which is a thread's own
        flat = call(look, (photo, photo.flip(-1)), (rays, turned))
        seen, reflected = map(self.split, flat)
        reflected = self.mirrored(reflected)
        both = (0.5 * (a + b) for a, b in zip(seen, reflected, strict=True))
        mean = Prediction(*both)
        return mean._replace(logits=mean.logits / self.temperature)


def _ambient_mirror() -> list[int]:
    axes = ambient_axes()
    return [int(np.argmax(axes @ (axis * (-1.0, 1.0, 1.0)))) for axis in axes]


_AMBIENT_MIRROR = _ambient_mirror()
"""Which ambient lobe takes the place of each when the photo is mirrored."""


def least_angle(directions: Tensor, probability: Tensor, steps: int = 20) -> tuple[Tensor, Tensor]:
    """Return the directions of least expected angle, shape [B, 3], and that angle [rad], [B].

    The geometric median: the best candidate, refined by Weiszfeld's steps on the sphere. A
    candidate stands for its cell, so angles are smoothed by half the spacing; without that every
    step would fall back on a candidate.

    Args:
        directions: Unit candidates, shape [K, 3].
        probability: Of each, rows sum to 1, shape [B, K].
        steps: Of the refinement.
    """
    cosines = (directions @ directions.T).clamp(-1.0, 1.0)
    axis = directions[(probability @ torch.acos(cosines).T).argmin(dim=1)]
    # Of about K / (solid angle share of the candidates) cells on the whole sphere.
    half_spacing = 0.5 * math.sqrt(4.0 * math.pi * (1.0 - LOWEST) / 2.0 / len(directions))
    for _ in range(steps):
        cosine = (axis @ directions.T).clamp(-1.0, 1.0)
        angle = torch.acos(cosine)
        pull = probability / torch.sqrt(angle**2 + half_spacing**2)
        # log map: the tangent toward a candidate, as long as the angle; sin as float32 can.
        scale = pull * angle / torch.sqrt((1.0 - cosine**2).clamp(min=1e-12))
        tangent = scale @ directions - (scale * cosine).sum(1, keepdim=True) * axis
        tangent = tangent / pull.sum(1, keepdim=True)
        length = tangent.norm(dim=1, keepdim=True).clamp(min=1e-12)
        axis = F.normalize(axis * torch.cos(length) + tangent / length * torch.sin(length), dim=1)
    angle = torch.acos((axis @ directions.T).clamp(-1.0, 1.0))
    return axis, (probability * angle).sum(dim=1)


def random_regressor(seed: int, config: RegressorConfig | None = None) -> Regressor:
    """As `random_network`."""
    return random_network(seed, lambda: Regressor(config or RegressorConfig()))


def save_regressor(network: Regressor, path: Path, record: Mapping[str, Any]) -> None:
    """As `save_network`; the record is read back as `Regressor.record`."""
    exact = {"temperature", "directions"}
    save_network(network, network.config, path, record, FORMAT, exact)


def load_regressor(path: Path | None, device: str | torch.device = "cpu") -> Regressor:
    """Read a network for `regress`; see `load_network`."""
    network, record = load_network(
        check_regressor, lambda sizes: Regressor(RegressorConfig(**sizes)), path, device
    )
    network.record = record
    return network
