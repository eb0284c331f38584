"""Lights of a batch of scenes: their frames, the directions that stand for them, wrong ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from warpir.diffusion.models.embedded_words import KINDS
from warpir.lighting.latlong_tensors import directions_of, luminance, solid_angles
from warpir.train.lights import LightPool
from warpir.train.sampler import Sampler

DIRECTIONS, SUN_DIRECTIONS = 96, 16
"""Directions that stand for a light, shared by a pixel's four points."""
WRONG_SHARES = [0.12, 0.26, 0.20, 0.24, 0.18]
"""Of each kind of wrong composite, in the order of `KINDS` after the right one: what a composite
shows best is drawn most. The last has the right light, and a wrong black point."""
BLACK_POINTS = (0.03, 0.18)
"""Least and most by which a wrong black point is off, display-encoded [1]."""


@dataclass
class Lighting:
    """Lights of a batch, one per scene, world frame (that is the camera-yaw frame)."""

    map: Tensor
    yaw: Tensor
    mirror: Tensor
    gain: Tensor
    axis: Tensor
    sun: Tensor
    """Gain included."""
    sigma: Tensor

    def turned(self, angle: Tensor) -> Lighting:
        """Return the lights turned about +Y [rad]."""
        # World directions w become turn(w, angle); the map's frame stays: yaw' o turn = yaw.
        return replace(self, yaw=self.yaw - self.mirror * angle, axis=about_y(self.axis, angle))

    def chosen(self, other: Lighting, use_other: Tensor) -> Lighting:
        """Return these lights, or the others where asked for, bool [B]."""

        def pick(a: Tensor, b: Tensor) -> Tensor:
            return torch.where(use_other.view(-1, *[1] * (a.ndim - 1)), b, a)

        return Lighting(**{k: pick(v, getattr(other, k)) for k, v in vars(self).items()})

    def brightened(self, factor: Tensor) -> Lighting:
        """Return the lights times a factor, shape [B, 1] or, by channel, [B, 3]."""
        return replace(self, gain=self.gain * factor, sun=self.sun * factor)


def about_y(v: Tensor, angle: Tensor) -> Tensor:
    """Turn vectors [B, ..., 3] about +Y by angles [B]; the kernel's ``turned``."""
    shape = (-1, *[1] * (v.ndim - 2))
    c, s = angle.cos().view(shape), angle.sin().view(shape)
    x, y, z = v.unbind(-1)
    return torch.stack([c * x + s * z, y, c * z - s * x], dim=-1)


def to_world(lighting: Lighting, in_map: Tensor) -> Tensor:
    """Turn directions of the lights' maps [B, D, 3] into the world."""
    turned = about_y(in_map, -lighting.yaw)
    flip = torch.ones_like(turned)
    flip[..., 0] = lighting.mirror[:, None]
    return turned * flip


def to_map(lighting: Lighting, directions: Tensor) -> Tensor:
    """Turn world directions [B, D, 3] into the frame of the lights' maps."""
    flip = torch.ones_like(directions)
    flip[..., 0] = lighting.mirror[:, None]
    return about_y(directions * flip, lighting.yaw)


def lighting_of(pool: LightPool, index: Tensor, yaw: Tensor, is_mirrored: Tensor) -> Lighting:
    """Return lights of the pool, turned and mirrored.

    Args:
        pool: The lights to choose from.
        index: Into the pool, shape [B].
        yaw: Turn of the map about +Y [rad], shape [B].
        is_mirrored: x of every direction is negated, bool, shape [B].
    """
    mirror = torch.where(is_mirrored, -1.0, 1.0)
    gain = torch.ones(len(index), 3, device=index.device)
    light = Lighting(
        index.int(), yaw, mirror, gain, pool.axis[index], pool.sun[index], pool.sigma[index]
    )
    return replace(light, axis=to_world(light, light.axis[:, None])[:, 0])


def draw_directions(light: Lighting, maps: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
    """Draw directions that stand for the lights, and the flux of each.

    Half of them follow the luminance, half the solid angle; drawn systematically over the
    texels, so every fourth one of them covers the whole sphere too.

    Args:
        light: One for each scene.
        maps: Of the pool, without suns, shape [light, He, We, 3].
        generator: Of the maps' device.
    """
    fine = maps[light.map.long()]
    count, height, width, _ = fine.shape
    omega = solid_angles(fine)
    power = luminance(fine) * omega
    p = 0.5 * power / power.sum(dim=(1, 2), keepdim=True).clamp(min=1e-20)
    p = (p + 0.5 * omega / (4.0 * np.pi)).flatten(1)
    p = p / p.sum(dim=1, keepdim=True)
    draw = Sampler(count, generator)
    steps = (torch.arange(DIRECTIONS, device=draw.device) + draw.unit(1)) / DIRECTIONS
    index = torch.searchsorted(p.cumsum(dim=1), steps).clamp(max=height * width - 1)
    row, column = index // width, index % width
    u = (column + draw.unit(DIRECTIONS)) / width
    v = (row + draw.unit(DIRECTIONS)) / height
    texel = fine.flatten(1, 2).gather(1, index[..., None].expand(-1, -1, 3))
    share = (omega.expand(height, width).reshape(1, -1).expand(count, -1)).gather(1, index)
    share = share / (p.gather(1, index) * DIRECTIONS)
    flux = texel * share[..., None] * light.gain[:, None]
    return {
        "direction": to_world(light, directions_of(u, v)).contiguous(),
        "flux": flux.contiguous(),
        "sun_direction": _draw_sun_directions(light, draw),
    }


def _draw_sun_directions(light: Lighting, draw: Sampler) -> Tensor:
    """Draw directions of the suns' discs, Gaussians, by a spiral turned at random, [B, D, 3]."""
    device = draw.device
    k = torch.arange(SUN_DIRECTIONS, device=device) + 0.5
    radius = torch.sqrt(-2.0 * torch.log1p(-k / SUN_DIRECTIONS * 0.98))
    angle = k * (np.pi * (3.0 - np.sqrt(5.0))) + 2.0 * np.pi * draw.unit(1)
    helper = torch.zeros_like(light.axis)
    helper[:, 0] = 1.0
    helper[light.axis[:, 0].abs() > 0.8] = torch.tensor([0.0, 0.0, 1.0], device=device)
    x = torch.nn.functional.normalize(torch.linalg.cross(helper, light.axis), dim=1)
    y = torch.linalg.cross(light.axis, x)
    r = (light.sigma[:, None] * radius)[..., None]
    sun = light.axis[:, None] + r * (
        angle.cos()[..., None] * x[:, None] + angle.sin()[..., None] * y[:, None]
    )
    return torch.nn.functional.normalize(sun, dim=-1).contiguous()


def draw_wrong_lights(
    light: Lighting,
    rest: Tensor,
    is_weak: Tensor,
    mismatched: float,
    generator: torch.Generator,
) -> tuple[Tensor, Lighting, Tensor]:
    """Draw what is wrong with the objects' lights.

    Args:
        light: The scenes' lights.
        rest: Luminance of their irradiance without the sun, shape [B].
        is_weak: Whether the sun hardly counts, bool, shape [B].
        mismatched: Share of scenes whose object has another light.
        generator: Of the lights' device.

    Returns:
        Index into `KINDS`, int64, shape [B], the objects' lights, and by how much their display
        values are lifted, or below 0 lowered, where they are black, shape [B].
    """
    draw = Sampler(len(rest), generator)
    drawn = 1 + draw.category(WRONG_SHARES)
    kind = torch.where(draw.chance(mismatched), drawn, 0)
    wrong = _draw_wrong_direction(light, rest, is_weak, draw)
    stops = torch.exp2((0.6 + 1.9 * draw.unit(1)) * draw.sign()[:, None])
    cast = torch.exp(draw.normal(3) * 0.35)
    cast = cast / cast.mean(dim=1, keepdim=True)
    soft = _draw_wrong_softness(light, rest, is_weak, draw)
    result = light
    choices = (wrong, light.brightened(stops), light.brightened(cast), soft)
    for number, choice in enumerate(choices, start=1):
        result = result.chosen(choice, kind == number)
    assert KINDS[1:] == ("direction", "exposure", "colour", "softness", "shadow")
    black = torch.where(kind == 5, draw.uniform(*BLACK_POINTS) * draw.sign(), 0.0)
    return kind, result, black


def _draw_wrong_direction(
    light: Lighting, rest: Tensor, is_weak: Tensor, draw: Sampler
) -> Lighting:
    """Turn the whole light and raise or lower its sun, or take another scene's light."""
    device = draw.device
    near = draw.chance(0.3)
    angle = torch.where(near, 0.2 + 0.4 * draw.unit(), 0.6 + (np.pi - 0.6) * draw.unit())
    turned = light.turned(angle * draw.sign())
    old = torch.arcsin(turned.axis[:, 1].clamp(-1.0, 1.0))
    new = torch.where(
        near, old + 0.25 * (draw.unit() - 0.5), torch.deg2rad(5.0 + 75.0 * draw.unit())
    )
    new = torch.where(draw.chance(0.5) | (old < 0.0), new.clamp(0.03, 1.5), old)
    flat = torch.nn.functional.normalize(
        turned.axis * torch.tensor([1.0, 0.0, 1.0], device=device) + 1e-6, dim=1
    )
    axis = flat * new.cos()[:, None]
    axis[:, 1] = new.sin()
    # Without a sun nothing shows a direction: a sun is put there.
    added = rest[:, None] * (0.3 + 1.5 * draw.unit(1)) * (1.0 - 0.3 * draw.unit(3))
    sun = torch.where(is_weak[:, None], added, turned.sun)
    turned = replace(turned, axis=axis, sun=sun)
    # Another scene's light, at about the same exposure.
    order = torch.randperm(draw.count, generator=draw.generator, device=device)
    other = Lighting(**{k: v[order] for k, v in vars(light).items()})
    level = rest + luminance(light.sun)
    balance = (level / level[order].clamp(min=1e-9))[:, None].clamp(0.02, 50.0)
    far = (other.axis * light.axis).sum(dim=1) < 0.85
    return turned.chosen(other.brightened(balance), far & ~near & draw.chance(0.35) & ~is_weak)


def _draw_wrong_softness(light: Lighting, rest: Tensor, is_weak: Tensor, draw: Sampler) -> Lighting:
    """Move the sun's light to the sky, or the sky's to a sun where there is hardly any."""
    moved = luminance(light.sun)[:, None] / rest.clamp(min=1e-9)[:, None]
    part = 0.6 + 0.4 * draw.unit(1)
    softer = replace(light, gain=light.gain * (1.0 + part * moved), sun=light.sun * (1.0 - part))
    harder = replace(
        light, gain=light.gain * 0.45, sun=0.55 * rest[:, None] * (0.7 + draw.unit(3) * 0.3)
    )
    return softer.chosen(harder, is_weak)
