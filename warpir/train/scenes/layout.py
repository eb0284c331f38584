"""The cameras of a batch of scenes, what their solids stand around, and their grounds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from warpir.train.sampler import Sampler

ASPECTS = (1.5, 1.5, 1.5, 1.5, 1.333, 1.333, 1.778, 1.0, 0.75)
"""Width over height of the photos, by frequency."""
CAMERA_HEIGHTS = ((1.2, 2.0), (1.1, 1.9), (0.25, 0.7), (1.0, 1.7))
"""Least and most above the ground, of streets, yards, tables and rooms [m]."""


@dataclass(frozen=True)
class Views:
    """Cameras, world frame (that is the camera-yaw frame)."""

    origin: Tensor
    """Shape [B, 3] [m]."""
    right: Tensor
    """Unit axes of the camera, shape [B, 3] each; it looks along -back."""
    up: Tensor
    back: Tensor
    tilt: Tensor
    """Above the horizon [rad], shape [B]."""
    half_width: Tensor
    """Of the photo on the image plane at depth 1, shape [B]."""
    half_height: Tensor

    @property
    def height(self) -> Tensor:
        """Above the ground [m], shape [B]."""
        return self.origin[:, 1]

    @property
    def window(self) -> Tensor:
        """The photo's left, upper, width and height on the image plane, shape [B, 4]."""
        w, h = self.half_width, self.half_height
        return torch.stack([-w, -h, 2.0 * w, 2.0 * h], dim=1)

    def rays(self, size: tuple[int, int]) -> Tensor:
        """Return the unit viewing directions of the photo's pixels, world frame, [B, 3, H, W]."""
        height, width = size
        window, device = self.window, self.origin.device
        across = (torch.arange(width, device=device) + 0.5) / width
        down = (torch.arange(height, device=device) + 0.5) / height
        u = (window[:, 0:1] + across * window[:, 2:3])[:, None, :, None]
        v = (window[:, 1:2] + down * window[:, 3:4])[:, :, None, None]
        right, up, back = (x[:, None, None] for x in (self.right, self.up, self.back))
        rays = torch.nn.functional.normalize(right * u - up * v - back, dim=-1)
        return rays.permute(0, 3, 1, 2).contiguous()


def turned_about(axis: Tensor, vector: Tensor, angle: Tensor) -> Tensor:
    """Turn vectors [B, 3] by angles [rad] about unit axes that stand at right angles to them."""
    across: Tensor = torch.linalg.cross(axis, vector)
    return angle.cos()[:, None] * vector + angle.sin()[:, None] * across


def misjudged(draw: Sampler, views: Views) -> Views:
    """Return the cameras as estimates from their photos would have them.

    Pitch, roll and field of view are off as estimates are; the yaw stays, since the frame is the
    camera's own.
    """
    pitch, roll = (torch.deg2rad(sigma * draw.normal()) for sigma in (4.0, 2.0))
    # About +X of the camera-yaw frame: what is ahead stays ahead.
    level = torch.zeros_like(views.right)
    level[:, 0] = 1.0
    right, up, back = (_rotated(level, v, pitch) for v in (views.right, views.up, views.back))
    zoom = torch.exp((0.12 * draw.normal()).clamp(-0.4, 0.4))
    return replace(
        views,
        right=turned_about(back, right, roll),
        up=turned_about(back, up, roll),
        back=back,
        half_width=views.half_width * zoom,
        half_height=views.half_height * zoom,
    )


def _rotated(axis: Tensor, vector: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors about unit axes (Rodrigues), shape [B, 3]."""
    along: Tensor = (axis * vector).sum(dim=1, keepdim=True) * axis
    return along + turned_about(axis, vector - along, angle)


def draw_views(draw: Sampler, place_kind: Tensor) -> Views:
    """Draw cameras for scenes of some kinds: 0 street, 1 yard, 2 table, 3 room, shape [B]."""
    device = draw.device
    fov = torch.deg2rad(draw.uniform(32.0, 74.0))
    half_height = torch.tan(fov / 2.0)
    half_width = half_height * torch.tensor(ASPECTS, device=device)[draw.index(len(ASPECTS))]
    half_width = half_width.clamp(max=1.6)
    steepest = torch.atan(half_height * 0.7)
    tilt = torch.deg2rad(-5.0 + 9.0 * draw.normal())
    tilt = torch.minimum(tilt.clamp(min=-0.6), steepest)
    low, high = torch.tensor(CAMERA_HEIGHTS, device=device)[place_kind].T
    camera_height = low + (high - low) * draw.unit()
    zero, one = torch.zeros_like(tilt), torch.ones_like(tilt)
    right = torch.stack([one, zero, zero], dim=1)
    up = torch.stack([zero, tilt.cos(), tilt.sin()], dim=1)
    back = torch.stack([zero, -tilt.sin(), tilt.cos()], dim=1)
    roll = torch.deg2rad((4.0 * draw.normal()).clamp(-15.0, 15.0))
    roll = torch.where(draw.chance(0.4), roll, zero)
    return Views(
        origin=torch.stack([zero, camera_height, zero], dim=1),
        right=turned_about(back, right, roll),
        up=turned_about(back, up, roll),
        back=back,
        tilt=tilt,
        half_width=half_width,
        half_height=half_height,
    )


def draw_stands(draw: Sampler, views: Views) -> tuple[Tensor, Tensor]:
    """Draw what the solids of each scene stand around: a point on the ground, below the horizon.

    Returns:
        Points, world frame [m], shape [B, 3], and the size of what could stand there [m], [B].
    """
    a = draw.uniform(-0.65, 0.65) * views.half_width
    horizon = torch.tan(views.tilt)
    top = torch.maximum(horizon + 0.12 * views.half_height, -0.1 * views.half_height)
    b = top + draw.unit() * (0.95 * views.half_height - top).clamp(min=0.02)
    d = views.right * a[:, None] - views.up * b[:, None] - views.back
    place = views.origin + d * (-views.height / d[:, 1].clamp(max=-0.03))[:, None]
    depth = -((place - views.origin) * views.back).sum(dim=1)
    return place, draw.log_uniform(0.14, 0.55) * 2.0 * views.half_height * depth


def draw_colours(draw: Sampler, low: float, high: float) -> Tensor:
    """Draw albedos of some level and of any hue, shape [B, 3]."""
    tint = 1.0 + draw.uniform(-0.35, 0.35, 3) * draw.uniform(0.0, 1.0, 1)
    return (draw.log_uniform(low, high)[:, None] * tint).clamp(0.02, 0.9)


def draw_grounds(
    draw: Sampler, is_panorama: Tensor, seen: Tensor, camera_height: Tensor, texture_count: int
) -> dict[str, Tensor]:
    """Draw the grounds, columns of the kernel's ``GroundTable``.

    Scenes whose photo is a panorama crop only assume their ground. ``seen``, the panorama behind
    each scene, -1 for none, and the cameras' heights above the ground [m] have shape [B]; texels of
    ``texture_count`` panoramas may cover a ground.
    """
    zero = torch.zeros_like(camera_height)
    albedo = draw_colours(draw, 0.06, 0.55)
    second = albedo * torch.exp(draw.uniform(-0.7, 0.7, 1) + draw.uniform(-0.15, 0.15, 3))
    second = second.clamp(0.02, 0.9)
    return {
        "is_seen": (~is_panorama).int(),
        "seen": seen.int(),
        "albedo": albedo,
        "second": torch.where(draw.chance(0.25)[:, None], albedo, second),
        "pattern": torch.where(
            draw.chance(0.5) if texture_count else zero.bool(), 4, draw.index(4)
        ).int(),
        "texture": (draw.unit() * max(texture_count, 1)).int(),
        "size": camera_height * draw.log_uniform(0.08, 1.5),
        "turn": draw.uniform(0.0, np.pi),
        "roughen": draw.uniform(0.0, 0.4),
        "wetness": torch.where(draw.chance(0.15), draw.uniform(0.2, 1.0), zero),
    }
