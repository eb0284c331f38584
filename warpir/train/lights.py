"""Lights to learn from: real panoramas, and made-up skies and rooms, each split into sun and rest.

The sun of a light is what exceeds its surroundings within a few degrees of the brightest spot: the
real sun, a lamp, or a window. Everything else is a small map. Kept apart, both can be turned,
weakened and coloured without ray tracing ever meeting a texel that holds most of the light.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.io.images.photos import read_envmap
from warpir.lighting import latlong_tensors as tensors
from warpir.train.sampler import Sampler

HEIGHT = 32
"""Rows of the map of everything but the sun."""
SPLIT_HEIGHT = 128
"""Rows of the map on which the sun is found."""
SPOT_DEG = 4.0
"""Width of the filter that finds the brightest spot [deg]."""
CAP_DEG, RING_DEG = 10.0, 16.0
"""The sun lies within the first; between both is what it is compared with [deg]."""
SEEN_HEIGHT = 512
"""Rows of the panoramas that are photographed."""
SKY_ONLY = "sky"
"""In the names of panoramas without a ground, such as ``mud_road_puresky``."""
CIE_SKIES = (
    (4.0, -0.70, 0.0, -1.0, 0.0), (4.0, -0.70, 2.0, -1.5, 0.15), (1.1, -0.80, 0.0, -1.0, 0.0),
    (1.1, -0.80, 2.0, -1.5, 0.15), (0.0, -1.0, 0.0, -1.0, 0.0), (0.0, -1.0, 2.0, -1.5, 0.15),
    (0.0, -1.0, 5.0, -2.5, 0.30), (0.0, -1.0, 10.0, -3.0, 0.45), (-1.0, -0.55, 2.0, -1.5, 0.15),
    (-1.0, -0.55, 5.0, -2.5, 0.30), (-1.0, -0.55, 10.0, -3.0, 0.45),
    (-1.0, -0.32, 10.0, -3.0, 0.45), (-1.0, -0.32, 16.0, -3.0, 0.30),
    (-1.0, -0.15, 16.0, -3.0, 0.30), (-1.0, -0.15, 24.0, -2.8, 0.15),
)  # fmt: skip
"""Parameters a to e of the CIE standard general sky (ISO 15469:2004), overcast to clear."""


CLEAR, BROKEN, OVERCAST, LOW_SUN, ROOM, NIGHT = range(6)
KIND_SHARES = [0.34, 0.14, 0.12, 0.12, 0.18, 0.10]
"""Of each kind of made-up light, in their order."""
KIND_SKIES = ((11, 14), (6, 10), (0, 5), (8, 14), (0, 4), (0, 4))
"""First and last row of `CIE_SKIES` for each kind."""
SKY_COLOURS = ((0.42, 0.62, 1.0), (0.85, 0.93, 1.0), (0.95, 0.98, 1.0), (1.0, 0.62, 0.32))
"""Blue, pale, grey and warm, linear RGB."""


@dataclass(frozen=True)
class Split:
    """A light as its sun and the rest; luminance-weighted where one number is asked for."""

    axis: Float64Array
    """Unit direction of the sun, the map's frame, shape [3]."""
    sun: Float64Array
    """Irradiance of a surface that faces it, linear RGB, shape [3]."""
    sigma: float
    """Its angular standard deviation per axis [rad]."""
    rest: FloatArray
    """Everything else, shape [He, We, 3] of the map that was split."""


def split_sun(texels: FloatArray) -> Split:
    """Split a lat-long map into its dominant light and the rest; both sum to the map.

    Args:
        texels: Radiance, shape [He, We, 3].
    """
    height = texels.shape[0]
    values = texels.astype(np.float64)
    directions = map_directions(height, 2 * height)
    omega = np.broadcast_to(texel_solid_angles(height, 2 * height)[:, None], directions.shape[:2])
    lum = luminance(values)
    # The brightest spot, not the brightest texel: a lamp's reflex must not outdo a window.
    # A count, not a threshold: in an even map every texel reaches the quantile.
    bright = np.argsort(lum, axis=None, kind="stable")[-max(1, lum.size // 200) :]
    axes, weights = directions.reshape(-1, 3)[bright], (lum * omega).ravel()[bright]
    nearness = np.exp((axes @ axes.T - 1.0) / np.radians(SPOT_DEG) ** 2)
    centre = axes[int(np.argmax(nearness @ weights))]
    angle = np.degrees(np.arccos(np.clip(directions @ centre, -1.0, 1.0)))
    ring = (angle >= CAP_DEG) & (angle < RING_DEG)
    around = np.median(values[ring], axis=0)
    # Full within most of the cap, then fading, so that no edge is left behind.
    share = np.clip((CAP_DEG - angle) / (0.3 * CAP_DEG), 0.0, 1.0)[..., None]
    excess = np.maximum(values - around, 0.0) * share
    flux = luminance(excess) * omega
    total = max(float(flux.sum()), 1e-30)
    axis = (directions * flux[..., None]).sum(axis=(0, 1)) + 1e-30 * centre
    axis /= np.linalg.norm(axis)
    cosine = np.clip(directions @ axis, -1.0, 1.0)
    sigma = float(np.sqrt((flux * np.arccos(cosine) ** 2).sum() / (2.0 * total)))
    sun = (excess * (omega * np.maximum(cosine, 0.0))[..., None]).sum(axis=(0, 1))
    return Split(axis, sun, max(sigma, 0.0047), (values - excess).astype(np.float32))


@dataclass(frozen=True)
class LightPool:
    """Lights by index, on one device; panoramas first."""

    fine: Tensor
    """Maps without suns, shape [light, 32, 64, 3]."""
    axis: Tensor
    """Shape [light, 3]."""
    sun: Tensor
    """Shape [light, 3]."""
    sigma: Tensor
    """Shape [light]."""
    indoors: Tensor
    """1 indoors, 0 outdoors, -1 unknown, int64, shape [light]."""
    seen: Tensor
    """Panoramas as they are photographed, shape [panorama, 512, 1024, 3]; one black one if none."""
    panorama_count: int
    grounded_count: int
    """Those of them, in front, that show a ground."""

    @property
    def count(self) -> int:
        """Number of lights."""
        return len(self.fine)

    def flux_share(self) -> Tensor:
        """Return the sun's share of the light's flux, which is that of a sphere's irradiance."""
        omega = tensors.solid_angles(self.fine)
        rest = (tensors.luminance(self.fine) * omega).sum(dim=(1, 2))
        sun = tensors.luminance(self.sun)
        return sun / (sun + rest).clamp(min=1e-20)

    def with_skies(self, skies: LightPool) -> LightPool:
        """Return the panoramas of this pool with other made-up lights behind them."""
        n = self.panorama_count
        names = ("fine", "axis", "sun", "sigma", "indoors")
        joined: dict[str, Any] = {
            k: torch.cat([getattr(self, k)[:n], getattr(skies, k)]) for k in names
        }
        return replace(self, **joined)


def at_mean_luminance(texels: FloatArray) -> FloatArray:
    """Return a map scaled to mean luminance 1, which changes nothing in a photograph of it."""
    omega = texel_solid_angles(*texels.shape[:2])[:, None]
    mean = float((luminance(texels.astype(np.float64)) * omega).sum() / (4.0 * np.pi))
    return (texels / max(mean, 1e-20)).astype(np.float32)


def load_panoramas(paths: list[Path], device: torch.device | str) -> LightPool:
    """Read panoramas, each scaled to mean luminance 1.

    Raises:
        InputError: A file cannot be used.
    """
    seen, fine, splits = [], [], []
    paths = sorted(paths, key=lambda path: (SKY_ONLY in path.stem, path.stem))
    for path in paths:
        texels = at_mean_luminance(read_envmap(path))
        split = split_sun(resize_map(texels, SPLIT_HEIGHT))
        splits.append(split)
        fine.append(resize_map(split.rest, HEIGHT))
        seen.append(resize_map(texels, SEEN_HEIGHT))

    def stacked(values: list[FloatArray] | list[Float64Array]) -> Tensor:
        return torch.from_numpy(np.stack(values).astype(np.float32)).to(device)

    unknown = torch.full((len(paths),), -1, dtype=torch.int64, device=device)
    if not paths:
        black = torch.zeros(1, 2, 4, 3, device=device)
        nothing = torch.zeros(0, 3, device=device)
        maps = torch.zeros(0, HEIGHT, 2 * HEIGHT, 3, device=device)
        return LightPool(maps, nothing, nothing, nothing[:, 0], unknown, black, 0, 0)
    return LightPool(
        stacked(fine),
        stacked([s.axis for s in splits]),
        stacked([s.sun for s in splits]),
        torch.tensor([s.sigma for s in splits], dtype=torch.float32, device=device),
        unknown,
        stacked(seen),
        len(paths),
        sum(SKY_ONLY not in path.stem for path in paths),
    )


def make_lights(count: int, generator: torch.Generator, device: torch.device | str) -> LightPool:
    """Draw lights: CIE skies with a sun over a ground, and rooms with lamps and windows."""
    draw = Sampler(count, generator)
    directions = tensors.map_directions(HEIGHT, 2 * HEIGHT, torch.device(device))
    omega = tensors.solid_angles(directions)
    y = directions[..., 1]
    kind = draw.category(KIND_SHARES)
    is_night = kind == NIGHT
    within = (kind == ROOM) | is_night
    # Half of the clear days have a sun below 45 degrees, as those that people photograph.
    highest = torch.where(draw.chance(0.5), 45.0, 78.0)
    elevation = torch.deg2rad(8.0 + (highest - 8.0) * draw.unit())
    elevation = torch.where(kind == LOW_SUN, torch.deg2rad(draw.uniform(1.0, 14.0)), elevation)
    elevation = torch.where(within, torch.deg2rad(draw.uniform(5.0, 88.0)), elevation)
    azimuth = draw.uniform(0.0, 2.0 * np.pi)
    level = elevation.cos()
    axis = torch.stack([level * azimuth.sin(), elevation.sin(), -level * azimuth.cos()], dim=1)
    maps = _draw_skies(draw, kind, directions, axis, elevation)
    sun, sigma = _draw_suns(draw, kind, elevation)
    walls = _draw_walls(draw, directions)
    lamp_tint = 1.0 - draw.uniform(0.0, 0.45, 1) * torch.tensor([0.0, 0.45, 1.0], device=device)
    lamp = draw.log_uniform(0.1, 4.0)[:, None] * lamp_tint
    ground_albedo = draw.uniform(0.05, 0.4, 3) * torch.tensor([1.0, 0.92, 0.8], device=device)
    falling = (tensors.luminance(maps) * y.clamp(min=0.0) * omega).sum(dim=(1, 2))[:, None]
    below = ground_albedo * (falling + sun * axis[:, 1:2].clamp(min=0.0)) / np.pi
    maps = torch.where(y[None, ..., None] > 0.0, maps, below[:, None, None, :])
    maps = torch.where(_per_texel(within), walls, maps)
    night_level = _per_texel(draw.log_uniform(0.05, 0.6))
    maps = torch.where(_per_texel(is_night), maps * night_level, maps)
    lamp_sigma = torch.deg2rad(draw.log_uniform(1.5, 13.0))
    lamp_sigma = torch.where(is_night, 0.4 * lamp_sigma, lamp_sigma)
    return LightPool(
        maps.contiguous(),
        axis,
        torch.where(within[:, None], lamp, sun).contiguous(),
        torch.where(within, lamp_sigma, sigma),
        (kind == ROOM).long(),
        torch.zeros(1, 2, 4, 3, device=device),
        0,
        0,
    )


def _per_texel(values: Tensor) -> Tensor:
    return values[:, None, None, None]


def _draw_skies(
    draw: Sampler, kind: Tensor, directions: Tensor, axis: Tensor, elevation: Tensor
) -> Tensor:
    """Draw skies of irradiance 1 on level ground but for colour and clouds, shape [B, H, W, 3].

    Args:
        draw: For the lights.
        kind: Of each light, shape [B].
        directions: Of the texels, shape [H, W, 3].
        axis: Unit direction toward the sun, shape [B, 3].
        elevation: Of the sun [rad], shape [B].
    """
    device, y = draw.device, directions[..., 1]
    cosine = torch.einsum("hwc,nc->nhw", directions, axis).clamp(-1.0, 1.0)
    # Luminance of the sky (ISO 15469): gradation from the zenith times indicatrix around the sun.
    table = torch.tensor(CIE_SKIES, device=device)
    first, last = torch.tensor(KIND_SKIES, device=device)[kind].T
    chosen = first + (draw.unit() * (last - first + 1)).long().clamp(max=4)
    a, b, c, d, e = table[chosen.clamp(max=14)].T[:, :, None, None]
    chi = torch.arccos(cosine)
    zenith = torch.exp(b / y.clamp(min=0.02))
    sky = (1.0 + a * zenith) * (
        1.0 + c * (torch.exp(d * chi) - torch.exp(d * np.pi / 2.0)) + e * cosine.square()
    )
    sky = sky.clamp(min=0.02) * (y > 0.0)
    omega = tensors.solid_angles(directions)
    sky = sky / (sky * y.clamp(min=0.0) * omega).sum(dim=(1, 2), keepdim=True)
    # Colours: blue above, paler at the horizon; grey under clouds; warm near a low sun.
    blue, pale, grey, warm = torch.tensor(SKY_COLOURS, device=device)
    up = y.clamp(min=0.0).sqrt()[None, ..., None]
    clear = pale * (1.0 - up) + blue * up
    cloudy = torch.where(kind <= CLEAR, draw.uniform(0.0, 0.25), draw.uniform(0.3, 1.0))
    cloudy = _per_texel(cloudy)
    colour = clear * (1.0 - cloudy) + grey * cloudy
    lowness = (1.0 - (elevation / 0.5).clamp(0.0, 1.0))[:, None, None]
    glow = torch.exp(-2.0 * chi) * lowness * draw.uniform(0.3, 1.0, 1, 1)
    glow = glow[..., None] * (1.0 - 0.8 * up)
    colour = colour * (1.0 - glow) + warm * glow
    maps = sky[..., None] * colour
    # Clouds: patches that brighten and darken.
    coarse, finer = draw.normal(1, 5, 10), draw.normal(1, 10, 20)
    patches = sum(
        torch.nn.functional.interpolate(x, directions.shape[:2], mode="bicubic")[:, 0] * s
        for x, s in ((coarse, 1.0), (finer, 0.6))
    )
    strength = torch.where(kind == BROKEN, draw.uniform(0.2, 0.7), draw.uniform(0.0, 0.25))
    clouded: Tensor = maps * torch.exp(strength[:, None, None] * patches)[..., None]
    return clouded


def _draw_suns(draw: Sampler, kind: Tensor, elevation: Tensor) -> tuple[Tensor, Tensor]:
    """Draw irradiances facing the sun, shape [B, 3], and its sigmas [rad], shape [B]."""
    # The sun, facing it, over the sky on level ground. The air that it passes colours it more than
    # it weakens that ratio, for the sky darkens with it: clear panoramas have 4 to 13, at all
    # elevations.
    ratio = draw.log_uniform(2.0, 16.0)
    ratio = torch.where(kind == BROKEN, draw.log_uniform(0.2, 5.0), ratio)
    ratio = torch.where(kind == OVERCAST, draw.uniform(0.0, 0.03), ratio)
    sine = elevation.sin().clamp(min=0.03)
    air = torch.exp(-0.12 / sine)
    tint = torch.stack([torch.ones_like(air), 0.55 + 0.42 * air, 0.25 + 0.65 * air], dim=1)
    sun = (ratio * torch.exp(-0.03 / sine))[:, None] * tint
    sigma = torch.deg2rad(draw.log_uniform(0.27, 1.5))
    return sun, torch.where(kind == BROKEN, sigma * draw.uniform(1.0, 4.0), sigma)


def _draw_walls(draw: Sampler, directions: Tensor) -> Tensor:
    """Draw walls with blobs of light, of mean luminance 1 / pi, shape [B, H, W, 3]."""
    wall = (
        draw.uniform(0.05, 0.4, 1, 1, 1)
        * draw.uniform(0.75, 1.25, 1, 1, 3)
        * (1.0 + 0.6 * directions[None, ..., 1:2] * draw.uniform(-0.5, 1.0, 1, 1, 1))
    )
    above = torch.tensor([0.0, 0.6, 0.0], device=draw.device)
    for _ in range(3):
        spot = torch.nn.functional.normalize(draw.normal(3) + above, dim=1)
        cosine = torch.einsum("hwc,nc->nhw", directions, spot)
        near = (cosine - 1.0) / draw.uniform(0.06, 0.35, 1, 1).square()
        strength = draw.unit(1, 1, 1) ** 3 * 6.0
        wall = wall + torch.exp(near)[..., None] * strength * draw.uniform(0.6, 1.0, 1, 1, 3)
    flux = (tensors.luminance(wall) * tensors.solid_angles(directions)).sum(dim=(1, 2))
    return wall / _per_texel(flux) * 4.0
