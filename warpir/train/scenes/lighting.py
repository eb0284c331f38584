"""Lights of a batch of scenes: their frames, and the directions that stand for them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import directions_of, luminance, solid_angles
from warpir.train.lights import LightPool
from warpir.train.sampler import Sampler

DIRECTIONS, SUN_DIRECTIONS = 96, 16
"""Directions that stand for a light, shared by a pixel's four points."""


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
    """Draw directions that stand for the lights, one for each scene, and the flux of each.

    Half of them follow the luminance, half the solid angle; drawn systematically over the
    texels, so every fourth one of them covers the whole sphere too. The pool's maps, without suns,
    have shape [light, He, We, 3]; the generator is of their device.
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
