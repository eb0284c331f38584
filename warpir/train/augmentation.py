"""Variations of photos that keep photo and light consistent."""

from __future__ import annotations

from dataclasses import replace

import torch
import torch.nn.functional as F
from torch import Tensor

from warpir.core.color import GAMMA, LUMINANCE_WEIGHTS
from warpir.train.batches import PhotoBatch
from warpir.train.stepping import TrainingSettings


def mirror(batch: PhotoBatch, chosen: Tensor) -> PhotoBatch:
    """Mirror the chosen photos [B], and with them everything that has a left and a right."""
    sign = batch.axis.new_tensor([-1.0, 1.0, 1.0])

    def turned(plain: Tensor, reflected: Tensor) -> Tensor:
        return torch.where(chosen.view(-1, *(1,) * (plain.dim() - 1)), reflected, plain)

    return replace(
        batch,
        photo=turned(batch.photo, batch.photo.flip(3)),
        rays=turned(batch.rays, batch.rays.flip(3) * sign.view(1, 3, 1, 1)),
        axis=turned(batch.axis, batch.axis * sign),
        # x = sin(lon) and lon = pi (1 - 2u): negating x turns the columns about.
        ambient=turned(batch.ambient, batch.ambient.flip(2)),
    )


def stretch(batch: PhotoBatch, chosen: Tensor, generator: torch.Generator) -> PhotoBatch:
    """Replace the chosen photos by a random part of them, brought to the full size.

    The rays come along, so the light stays what it is. It stands for other fields of view, other
    shapes of photo and principal points off the centre. ``chosen`` is bool, shape [B], the
    generator of the photos' device.
    """
    count, device = len(batch.photo), batch.photo.device

    def uniform(low: float, high: float) -> Tensor:
        drawn = torch.rand(count, 2, device=device, generator=generator)
        return low + (high - low) * drawn

    size = torch.where(chosen[:, None], uniform(0.5, 1.0), torch.ones((), device=device))
    centre = (1.0 - size) * uniform(-1.0, 1.0)
    theta = torch.zeros(count, 2, 3, device=device)
    theta[:, 0, 0], theta[:, 1, 1], theta[:, :, 2] = size[:, 0], size[:, 1], centre
    grid = F.affine_grid(theta, list(batch.photo.shape), align_corners=False)
    both = torch.cat([batch.photo, batch.rays], dim=1)
    both = F.grid_sample(both, grid, padding_mode="border", align_corners=False)
    return replace(batch, photo=both[:, :3], rays=F.normalize(both[:, 3:], dim=1))


def discolour(batch: PhotoBatch, chosen: Tensor) -> PhotoBatch:
    """Take the colour out of the chosen photos [B] and of their light."""
    weights = batch.photo.new_tensor(LUMINANCE_WEIGHTS)
    grey = torch.einsum("bchw,c->bhw", batch.photo.clamp(min=0.0) ** GAMMA, weights)
    grey = grey.clamp(min=0.0)[:, None].expand_as(batch.photo) ** (1.0 / GAMMA)
    sun = (batch.sun @ weights)[:, None].expand_as(batch.sun)
    ambient = (batch.ambient @ weights)[..., None].expand_as(batch.ambient)
    return replace(
        batch,
        photo=torch.where(chosen[:, None, None, None], grey, batch.photo),
        sun=torch.where(chosen[:, None], sun, batch.sun),
        ambient=torch.where(chosen[:, None, None, None], ambient, batch.ambient),
    )


def erase(photo: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Paint up to three random rectangles of each photo in one colour each (1708.04896).

    The photo is display-encoded, shape [B, 3, H, W], ``share`` the chance of each rectangle, the
    generator of the photos' device.
    """
    count, _, height, width = photo.shape
    device = photo.device
    across = (torch.arange(width, device=device) + 0.5) / width
    down = (torch.arange(height, device=device) + 0.5) / height
    for _ in range(3):
        u = torch.rand(count, 8, device=device, generator=generator)
        half = 0.025 + 0.15 * u[:, :2]
        in_x = (across - u[:, 2:3]).abs() < half[:, :1]
        in_y = (down - u[:, 3:4]).abs() < half[:, 1:]
        covered = in_y[:, None, :, None] & in_x[:, None, None, :]
        covered = covered & (u[:, 4] < share)[:, None, None, None]
        photo = torch.where(covered, u[:, 5:, None, None], photo)
    return photo


def augment(
    batch: PhotoBatch, settings: TrainingSettings, generator: torch.Generator
) -> PhotoBatch:
    """Vary a batch in ways that keep photo and light consistent."""
    device = batch.photo.device

    def chosen(share: float) -> Tensor:
        return torch.rand(len(batch.photo), device=device, generator=generator) < share

    batch = mirror(batch, chosen(0.5))
    batch = stretch(batch, chosen(settings.crop_share), generator)
    batch = discolour(batch, chosen(settings.grey_share))
    photo = erase(batch.photo, settings.erase_share, generator)
    size = torch.rand(len(photo), 1, 1, 1, device=device, generator=generator) * settings.noise
    photo = photo + size * torch.randn(photo.shape, device=device, generator=generator)
    return replace(batch, photo=photo.clamp(0.0, 1.0))
