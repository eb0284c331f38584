"""From one photograph and its camera to its HDR light, with how sure that is.

A small network sees the photo and the viewing direction of each pixel. It answers with a
distribution over fixed directions for the dominant light (so that "ahead or behind" can stay open),
that light's irradiance, colour, softness and share, and broad spherical Gaussians for all other
light; each level comes with a variance. Levels are logarithms relative to the photo's own mean
decoded luminance, so exposure drops out. It is asked twice, for the photo and for its mirror image,
and the answers are averaged: a mirrored photo gives the mirrored light by construction.

The camera-yaw frame is the world turned about +Y so that the camera looks along -Z.
"""

from __future__ import annotations

import copy
import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import load_file, save
from torch import Tensor, nn

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.atomic import write_file
from warpir.core.color import GAMMA, LUMINANCE_WEIGHTS
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import map_directions
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import REGRESSOR_FORMAT as FORMAT
from warpir.diffusion.models.weight_files import check_regressor, values_hash
from warpir.scene.camera import Camera
from warpir.scene.light import Lobes, angles_from_axis, fibonacci

HEIGHT, WIDTH = 96, 144
"""Size that the network sees [px]; photos of other shapes are stretched, and the rays say so."""
AMBIENT_SHARPNESS = 4.0
"""Of the 14 ambient lobes: with equal amplitudes their sum is even within 4 %."""
DARKEST = 1e-4
"""Mean luminance below which a photo counts as this bright."""
GATHERINGS = 4
"""Weighted means of the tokens that each head reads, of a quarter of the features each."""
LOWEST = -0.25
"""Height y of the lowest direction that a dominant light may have."""


@dataclass(frozen=True)
class RegressorConfig:
    """Size of the network."""

    channels: tuple[int, int, int] = (48, 96, 160)
    """Features at 1/2, 1/4 and 1/8 of the resolution."""
    blocks: tuple[int, int] = (2, 2)
    """Residual blocks at 1/2 and 1/4."""
    depth: int = 4
    """Transformer blocks over the 12 x 18 tokens."""
    heads: int = 5
    directions: int = 1000
    """Of the whole sphere; those that lie low are left out."""
    dropout: float = 0.1
    skipped: float = 0.1
    """Chance that a block is left out in training (stochastic depth)."""


class Prediction(NamedTuple):
    """What the network says of B photos, camera-yaw frame; levels are natural logarithms."""

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


# ------------------------------------------------------------------------------------- network


class _Skippable(nn.Module):
    """A residual branch that is left out for some samples in training (1603.09382)."""

    def __init__(self, skipped: float) -> None:
        super().__init__()
        self.skipped = skipped

    def add(self, x: Tensor, branch: Tensor) -> Tensor:
        if self.training and self.skipped > 0.0:
            kept = torch.rand(len(x), *(1,) * (x.dim() - 1), device=x.device) >= self.skipped
            branch = branch * kept / (1.0 - self.skipped)
        return x + branch


class _ConvBlock(_Skippable):
    def __init__(self, channels: int, skipped: float) -> None:
        super().__init__(skipped)
        self.branch = nn.Sequential(
            nn.GroupNorm(8, channels),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.GroupNorm(8, channels),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.add(x, self.branch(x))


class _TokenBlock(_Skippable):
    def __init__(self, channels: int, heads: int, dropout: float, skipped: float) -> None:
        super().__init__(skipped)
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)
        self.mlp = nn.Sequential(
            nn.LayerNorm(channels),
            nn.Linear(channels, 4 * channels),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(4 * channels, channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        batch, count, _ = x.shape
        qkv = self.qkv(self.norm(x)).view(batch, count, 3, self.heads, -1)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(x.shape)
        x = self.add(x, self.out(mixed))
        return self.add(x, self.mlp(x))


def _head(channels: int, dropout: float, count: int) -> nn.Sequential:
    """Return a head whose first answers are nearly the same for all photos."""
    last = nn.Linear(channels, count)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.LayerNorm(channels), nn.Dropout(dropout), last)


class Regressor(nn.Module):
    """Photo and rays to `Prediction`.

    There are 12 x 18 tokens of 8 x 8 pixels, and two learned ones that ask them. Each of the two
    heads, for direction and for levels, reads one learned token plus weighted means of the others.
    The means matter: without them training stays long at the one answer that fits all photos.
    """

    directions: Tensor
    """Candidates, camera-yaw frame, shape [K, 3]; in the file, so that weights keep their own."""
    temperature: Tensor
    """Divides the logits; calibrated on validation photos, shape []."""
    mean_light: Tensor
    """The training set's mean light as one constant prediction, flat as `split` takes it."""

    def __init__(self, config: RegressorConfig) -> None:
        super().__init__()
        self.config = config
        self.record: dict[str, Any] = {}
        """How it was trained; plain values."""
        fine, middle, wide = config.channels
        directions = torch.from_numpy(candidates(config.directions)).float()
        self.register_buffer("directions", directions)
        self.register_buffer("temperature", torch.ones(()))
        self.level_count = 10 + 3 * len(ambient_axes())
        self.register_buffer("mean_light", torch.zeros(len(directions) + self.level_count))

        # Space to depth keeps every pixel: the edges of shadows are what tells the direction.
        self.stem = nn.Conv2d(4 * 6, fine, 3, padding=1)
        self.fine = nn.Sequential(*(_ConvBlock(fine, 0.0) for _ in range(config.blocks[0])))
        self.down1 = nn.Conv2d(fine, middle, 3, stride=2, padding=1)
        self.middle = nn.Sequential(
            *(_ConvBlock(middle, config.skipped / 2.0) for _ in range(config.blocks[1]))
        )
        self.down2 = nn.Conv2d(middle, wide, 3, stride=2, padding=1)
        self.norm = nn.GroupNorm(8, wide)
        # Where a token looks takes the place of a position: it holds for every field of view.
        self.place = nn.Sequential(nn.Linear(3, wide), nn.GELU(), nn.Linear(wide, wide))
        self.asking = nn.Parameter(torch.randn(2, wide) * 0.02)
        self.blocks = nn.ModuleList(
            _TokenBlock(wide, config.heads, config.dropout, config.skipped)
            for _ in range(config.depth)
        )
        self.gather = nn.Linear(wide, 2 * GATHERINGS, bias=False)
        # Clearly different weights from the start: an even mean tells nothing of where.
        nn.init.normal_(self.gather.weight, std=3.0 / math.sqrt(wide))
        self.direction_head = _head(wide, config.dropout, len(directions))
        self.level_head = _head(wide, config.dropout, self.level_count)

    def forward(self, photo: Tensor, rays: Tensor) -> Tensor:
        """Return flat predictions, shape [B, K + level_count]; `split` names the parts.

        Args:
            photo: Display-encoded, shape [B, 3, 96, 144].
            rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
        """
        x = torch.cat([photo * 2.0 - 1.0, rays], dim=1)
        x = self.fine(self.stem(F.pixel_unshuffle(x, 2)))
        x = self.middle(self.down1(x))
        x = self.norm(self.down2(x))
        looking = F.adaptive_avg_pool2d(rays, x.shape[2:]).flatten(2).transpose(1, 2)
        tokens = x.flatten(2).transpose(1, 2) + self.place(looking)
        tokens = torch.cat([self.asking.expand(len(tokens), -1, -1), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        # Softmax and exponentials of the answers need more digits than autocast leaves.
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.to(self.gather.weight.dtype)
            asked, seen = tokens[:, :2], tokens[:, 2:]
            weights = self.gather(seen).softmax(dim=1).unflatten(2, (2, GATHERINGS))
            groups = seen.unflatten(2, (GATHERINGS, -1))
            gathered = torch.einsum("btag,btgc->bagc", weights, groups).flatten(2)
            direction, levels = (asked + gathered).unbind(dim=1)
            return torch.cat([self.direction_head(direction), self.level_head(levels)], dim=1)

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
    def predict(self, photo: Tensor, rays: Tensor) -> Prediction:
        """Return the mean over photo and mirror image, with calibrated logits.

        Args:
            photo: Display-encoded, shape [B, 3, 96, 144].
            rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
        """
        turned = rays.flip(-1) * rays.new_tensor([-1.0, 1.0, 1.0]).view(1, 3, 1, 1)
        seen = self.split(self(photo, rays))
        reflected = self.mirrored(self.split(self(photo.flip(-1), turned)))
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


# ------------------------------------------------------------------------------------- answer


@dataclass(frozen=True)
class Regression:
    """The light that the network sees in a photo, world frame, photo-linear units."""

    axis: Float64Array
    """Unit direction toward the dominant light: least expected angle, shape [3]."""
    spread_deg: float
    """Expected angle between `axis` and the truth [deg]."""
    concentration: float
    """kappa of the von Mises-Fisher distribution about `axis` nearest to the predicted one."""
    directions: Float64Array
    """Candidates for the direction, shape [K, 3]."""
    probability: Float64Array
    """Of each, sums to 1, shape [K]."""
    sun: Float64Array
    """Irradiance of a surface that faces the dominant light, linear RGB, shape [3]."""
    sun_log_std: float
    """Standard deviation of the logarithm of its luminance."""
    sigma: float
    """Angular standard deviation of the dominant light [rad]."""
    share: float
    """Share of a sphere's mean irradiance that the dominant light gives, in [0, 1]."""
    ambient: Lobes
    """All other light."""
    ambient_log_std: float
    """Standard deviation of the logarithm of the ambient irradiance."""

    def lobes(self, sigma_min: float = 0.0) -> Lobes:
        """Return the light as lobes, the dominant one first.

        Args:
            sigma_min: Least angular standard deviation of the dominant lobe [rad]; its irradiance
                stays.
        """
        sharpness = 1.0 / max(self.sigma, sigma_min) ** 2
        amplitude = self.sun / facing_irradiance(sharpness)
        return Lobes(
            np.concatenate([amplitude[None], self.ambient.amplitude]).astype(np.float32),
            np.concatenate([self.axis[None], self.ambient.axis]).astype(np.float32),
            np.append(sharpness, self.ambient.sharpness).astype(np.float32),
        )

    def irradiance(self, normals: Float64Array) -> Float64Array:
        """Return the expected irradiance of surfaces, photo-linear RGB, shape [..., 3].

        Args:
            normals: Unit, world frame, shape [..., 3].
        """
        cosine = np.maximum(normals @ self.directions.T, 0.0)
        ambient = self.ambient.axis.astype(np.float64)
        lobes = lobe_irradiance(normals @ ambient.T) @ self.ambient.amplitude.astype(np.float64)
        expected: Float64Array = (cosine @ self.probability)[..., None] * self.sun + lobes
        return expected

    def hint(
        self, albedo: NDArray[np.floating[Any]], normals: Float64Array, c2w: Float64Array
    ) -> tuple[FloatArray, FloatArray]:
        """Return a first guess of a matte object's picture, and where its light comes from.

        Args:
            albedo: Linear, shape [..., 3].
            normals: Unit, camera frame (x right, y up, z toward the camera), shape [..., 3].
            c2w: Pose of the camera, shape [4, 4].

        Returns:
            Display-encoded picture, shape [..., 3], and the expected direction toward the dominant
            light in the camera's frame times its share, shape [3].
        """
        turn = np.asarray(c2w)[:3, :3]
        shown = np.clip(albedo * self.irradiance(normals @ turn.T) / np.pi, 0.0, 1.0)
        toward = self.share * (self.probability @ self.directions) @ turn
        return (shown ** (1.0 / GAMMA)).astype(np.float32), toward.astype(np.float32)

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``."""
        azimuth, elevation = angles_from_axis(self.axis)
        return {
            "axis": self.axis.tolist(),
            "azimuth_deg": azimuth,
            "elevation_deg": elevation,
            "spread_deg": self.spread_deg,
            "concentration": self.concentration,
            "sun": self.sun.tolist(),
            "sun_log_std": self.sun_log_std,
            "sigma": self.sigma,
            "share": self.share,
            "ambient": {
                "amplitude": self.ambient.amplitude.tolist(),
                "axis": self.ambient.axis.tolist(),
                "sharpness": self.ambient.sharpness.tolist(),
            },
            "ambient_log_std": self.ambient_log_std,
        }


def facing_irradiance(sharpness: float) -> float:
    """Return the irradiance that a lobe of amplitude 1 gives a surface that faces it.

    ``2 pi integral_0^1 t exp(s (t - 1)) dt = 2 pi (s - 1 + exp(-s)) / s^2``.
    """
    return 2.0 * math.pi * (sharpness + math.expm1(-sharpness)) / sharpness**2


def lobe_irradiance(cosine: Float64Array) -> Float64Array:
    """Return the irradiance that an ambient lobe of amplitude 1 gives a surface, same shape.

    By a table over the angle to the lobe's axis, of sums over the sphere.

    Args:
        cosine: Of the angle between normal and axis.
    """
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) * ((len(_LOBE_TABLE) - 1) / math.pi)
    values: Float64Array = np.interp(angle, np.arange(len(_LOBE_TABLE)), _LOBE_TABLE)
    return values


def _lobe_table(count: int = 65) -> Float64Array:
    directions = fibonacci(20_000)
    radiance = np.exp(AMBIENT_SHARPNESS * (directions[:, 1] - 1.0)) * (4.0 * math.pi / 20_000)
    theta = np.linspace(0.0, math.pi, count)
    normals = np.stack([np.sin(theta), np.cos(theta), np.zeros(count)], axis=1)
    table: Float64Array = np.maximum(normals @ directions.T, 0.0) @ radiance
    return table


_LOBE_TABLE = _lobe_table()


class Hint(NamedTuple):
    """What a batch of photos says of the light, in the camera-yaw frame."""

    irradiance: Tensor
    """Expected irradiance by normal, a lat-long map, photo-linear RGB, shape [B, 16, 32, 3]."""
    toward: Tensor
    """Expected direction toward the dominant light times its share, shape [B, 3]."""


@torch.no_grad()
def hints(network: Regressor, photo: Tensor, rays: Tensor) -> Hint:
    """Return the light of photos for whoever lights many objects by it; see `Regression.hint`.

    Without the mirror image: half the time, for training.

    Args:
        network: In evaluation mode.
        photo: Display-encoded, shape [B, 3, 96, 144].
        rays: Unit viewing directions, camera-yaw frame, shape [B, 3, 96, 144].
    """
    prediction = network.split(network(photo, rays).float())
    probability = (prediction.logits / network.temperature).softmax(dim=1)
    luminance = mean_luminance(photo)[:, None]
    log_red, log_blue = prediction.tint.unbind(dim=1)
    ratios = torch.stack([log_red, torch.zeros_like(log_red), log_blue], dim=1).exp()
    weights = ratios.new_tensor(LUMINANCE_WEIGHTS)
    sun = luminance * prediction.level.clamp(-12, 12).exp()[:, None] * ratios
    sun = sun / (ratios @ weights)[:, None]
    normals = map_directions(16, 32).reshape(-1, 3)
    cosine = torch.from_numpy(normals).to(network.directions) @ network.directions.T
    of_lobes = torch.from_numpy(lobe_irradiance(normals @ ambient_axes().T)).to(cosine)
    facing = probability @ cosine.clamp(min=0.0).T
    ambient = luminance[..., None] * prediction.ambient.clamp(-12, 8).exp()
    irradiance = facing[..., None] * sun[:, None] + of_lobes @ ambient
    toward = prediction.share.sigmoid()[:, None] * (probability @ network.directions)
    return Hint(irradiance.unflatten(1, (16, 32)), toward)


def yaw_to_world(camera: Camera) -> Float64Array:
    """Return the rotation from the camera-yaw frame to the world, shape [3, 3].

    A camera that looks straight up or down is turned as its up axis says.
    """
    _, up, back = camera.c2w[:3, :3].T
    ahead = -back * (1.0, 0.0, 1.0)
    if np.linalg.norm(ahead) < 1e-6:
        ahead = up * (1.0, 0.0, 1.0) * np.sign(back[1])
    ahead = ahead / np.linalg.norm(ahead)
    vertical = np.array([0.0, 1.0, 0.0])
    return np.stack([np.cross(ahead, vertical), vertical, -ahead], axis=1)


def camera_rays(camera: Camera, height: int = HEIGHT, width: int = WIDTH) -> FloatArray:
    """Return the unit viewing direction of each pixel, camera-yaw frame, shape [height, width, 3].

    Args:
        camera: Of the photo at any size; the picture is stretched to the size asked for.
        height: Rows.
        width: Columns.
    """
    view = camera.scaled(width, height)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    local = np.stack([(u - view.cx) / view.fx, (view.cy - v) / view.fy, -np.ones_like(u)], axis=-1)
    rays = local @ (yaw_to_world(camera).T @ camera.c2w[:3, :3]).T
    unit: FloatArray = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return unit


def regress(
    network: Regressor, photo_srgb: NDArray[np.floating[Any]], camera: Camera
) -> Regression:
    """Read the light off a photo.

    Args:
        network: Of `load_regressor`.
        photo_srgb: Display-encoded, in [0, 1], shape [H, W, 3].
        camera: It was taken with; of any size with the photo's aspect.
    """
    device = network.directions.device
    photo = _network_photo(photo_srgb).to(device)
    rays = torch.from_numpy(camera_rays(camera)).to(device).permute(2, 0, 1)[None].double()
    # In float64, so that kinds of processors, which round sums differently, agree on the light.
    prediction = copy.deepcopy(network).double().predict(photo, rays)
    return _regression(network, prediction, float(mean_luminance(photo)), camera)


def mean_training_light(
    network: Regressor, photo_srgb: NDArray[np.floating[Any]], camera: Camera
) -> Regression:
    """Return the training set's mean light at a photo's exposure: what a guess without eyes says.

    Args:
        network: Whose training set.
        photo_srgb: Only its mean luminance counts; display-encoded, shape [H, W, 3].
        camera: Only its yaw counts.
    """
    luminance = float(mean_luminance(_network_photo(photo_srgb)))
    return _regression(network, network.split(network.mean_light[None]), luminance, camera)


def _network_photo(photo_srgb: NDArray[np.floating[Any]]) -> Tensor:
    """Bring a photo to the network's size by area, float64, shape [1, 3, 96, 144]."""
    photo = torch.from_numpy(np.ascontiguousarray(photo_srgb, np.float64)).permute(2, 0, 1)[None]
    return F.interpolate(
        photo, (HEIGHT, WIDTH), mode="bilinear", align_corners=False, antialias=True
    ).clamp(0.0, 1.0)


def _regression(
    network: Regressor, prediction: Prediction, luminance: float, camera: Camera
) -> Regression:
    """Turn one prediction into numbers in the world.

    Args:
        network: Holds the candidate directions.
        prediction: Of one photo, camera-yaw frame.
        luminance: The photo's mean decoded luminance.
        camera: Gives the yaw.
    """
    to_world = yaw_to_world(camera)
    one = Prediction(*(part.detach().cpu().double() for part in prediction))
    directions = network.directions.cpu().double()
    probability = one.logits.softmax(dim=1)
    axis, spread = least_angle(directions, probability)
    # Most likely kappa for samples about a known mean direction: coth(kappa) - 1 / kappa = R; the
    # inverse is Banerjee et al. 2005, eq. 4 in 3 dimensions.
    resultant = min(max(float(probability[0] @ directions @ axis[0]), 0.0), 1.0 - 1e-6)
    log_red, log_blue = one.tint[0].tolist()
    ratios = np.exp([log_red, 0.0, log_blue])
    level = luminance * math.exp(float(one.level[0]))
    ambient_axis = ambient_axes() @ to_world.T
    return Regression(
        axis=to_world @ axis[0].numpy(),
        spread_deg=math.degrees(float(spread)),
        concentration=resultant * (3.0 - resultant**2) / (1.0 - resultant**2),
        directions=directions.numpy() @ to_world.T,
        probability=probability[0].numpy(),
        sun=level * ratios / float(ratios @ LUMINANCE_WEIGHTS),
        sun_log_std=math.exp(0.5 * float(one.level_log_var)),
        sigma=min(math.exp(float(one.softness)), 1.0),
        share=float(one.share.sigmoid()),
        ambient=Lobes(
            (luminance * one.ambient[0].exp().numpy()).astype(np.float32),
            ambient_axis.astype(np.float32),
            np.full(len(ambient_axis), AMBIENT_SHARPNESS, np.float32),
        ),
        ambient_log_std=math.exp(0.5 * float(one.ambient_log_var)),
    )


# -------------------------------------------------------------------------------------- files


def random_regressor(seed: int, config: RegressorConfig | None = None) -> Regressor:
    """Return a network with random weights: a start for training, and a control that must fail."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Regressor(config or RegressorConfig()).eval()


def save_regressor(network: Regressor, path: Path, record: Mapping[str, Any]) -> None:
    """Write a network: fp16 weights, whole or not at all.

    Args:
        network: Its temperature and mean light go along.
        path: The safetensors file.
        record: How it was trained, plain values; read back as `Regressor.record`.

    Raises:
        OSError: The disk is full or the folder is not writable; an older file is still whole.
    """
    exact = {"temperature", "directions"}
    state = {
        name: (part if name in exact else part.half()).cpu().contiguous()
        for name, part in network.state_dict().items()
    }
    config = json.dumps(asdict(network.config))
    about = {
        "format": FORMAT,
        "config": config,
        "weights": values_hash({name: part.numpy() for name, part in state.items()}, config),
        "record": json.dumps(dict(record), allow_nan=False),
    }
    write_file(path, save(state, metadata=about))


def load_regressor(path: Path | None, device: str | torch.device = "cpu") -> Regressor:
    """Read a network for `regress`.

    Args:
        path: The safetensors file; None: the one in the package.
        device: Where it shall run.

    Raises:
        InputError: The file is absent, damaged or of another kind (`ExitCode.MODEL`).
    """
    if path is None:
        packaged = files("warpir.diffusion") / "weights" / "regressor.safetensors"
        with as_file(packaged) as found:
            return load_regressor(found, device)
    try:
        file = check_regressor(path)
        config = json.loads(file.about["config"])
        plain: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in config.items()
        }
        size = RegressorConfig(**plain)
        # Not on "meta" first: its sizes are checked, and random numbers there import the compiler.
        network = Regressor(size)
        expected = {name: part.shape for name, part in network.state_dict().items()}
        if expected != file.shapes:
            raise ModelError(str(path), "damaged (the weights are not those of its network)")
        network.load_state_dict({name: part.float() for name, part in load_file(path).items()})
    except ModelError as error:
        raise InputError(error.where, error.what, error.advice, ExitCode.MODEL) from None
    network.record = json.loads(file.about["record"])
    return network.to(device).eval().requires_grad_(False)
