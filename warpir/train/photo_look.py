"""What a camera does to radiance: exposure, white balance, tone curve, and faults of its picture.

Heavily varied, because nothing else makes networks that learned from renders survive photographs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from warpir.train.sampler import Sampler

GRAY = 0.18
"""Radiance that every tone curve leaves alone, so that exposure keeps its meaning."""
WHITE_PERCENTILE, WHITE = 0.99, 0.9
"""Display value of that share of a photo's pixels before exposure errors (method of the insertion
benchmark)."""


@dataclass(frozen=True)
class Look:
    """Cameras, one per picture."""

    gain: Tensor
    """Exposure and white balance, linear RGB, shape [B, 3]."""
    contrast: Tensor
    """Exponent around `GRAY`, shape [B]."""
    shoulder: Tensor
    """Where highlights begin to be compressed; 1 and above: they clip; shape [B]."""
    is_srgb: Tensor
    """Encoded by the sRGB curve, else by gamma 2.2; bool, shape [B]."""

    def show(self, radiance: Tensor) -> Tensor:
        """Return display values in [0, 1] of radiance, both shape [B, 3, H, W]."""
        x = radiance.clamp(min=0.0) * self.gain[:, :, None, None]
        contrast, shoulder = (p[:, None, None, None] for p in (self.contrast, self.shoulder))
        x = GRAY * (x / GRAY).clamp(min=1e-8) ** contrast
        room = (1.0 - shoulder).clamp(min=1e-3)
        soft = shoulder + room * torch.tanh((x - shoulder).clamp(min=0.0) / room)
        x = torch.where((shoulder < 1.0) & (x > shoulder), soft, x).clamp(0.0, 1.0)
        srgb = torch.where(
            x <= 0.0031308, 12.92 * x, 1.055 * x.clamp(min=1e-8) ** (1 / 2.4) - 0.055
        )
        return torch.where(self.is_srgb[:, None, None, None], srgb, x ** (1.0 / 2.2)).clamp(0, 1)


def draw_looks(radiance: Tensor, generator: torch.Generator) -> Look:
    """Draw cameras that expose some photos of radiance [B, 3, H, W] about right."""
    draw = Sampler(len(radiance), generator)
    # Of what is not black, as in the benchmark; a kth value is a quantile without its size limit.
    values = radiance.flatten(1)
    rank = max(1, round(WHITE_PERCENTILE * values.shape[1]))
    white = values.kthvalue(rank, dim=1).values.clamp(min=1e-6)
    is_plain = draw.chance(0.35)
    stops = torch.where(is_plain, 0.15 * draw.normal(), (0.6 * draw.normal()).clamp(-1.6, 1.6))
    balance = torch.exp(
        torch.where(is_plain[:, None], 0.04 * draw.normal(3), 0.10 * draw.normal(3))
    )
    balance = balance / balance.mean(dim=1, keepdim=True)
    gain = (WHITE**2.2 / white * torch.exp2(stops))[:, None] * balance
    contrast = torch.where(is_plain, torch.ones_like(stops), draw.uniform(0.85, 1.25))
    clips = is_plain | draw.chance(0.4)
    return Look(
        gain,
        contrast,
        torch.where(clips, torch.full_like(stops, 2.0), draw.uniform(0.4, 0.9)),
        draw.chance(0.5),
    )


def draw_faults(shown: Tensor, generator: torch.Generator) -> Tensor:
    """Return photos [B, 3, H, W] with vignetting, blur, noise or JPEG's blocks in some of them."""
    count, _, height, width = shown.shape
    device, draw = shown.device, Sampler(count, generator)

    def u(low: float, high: float) -> Tensor:
        return draw.uniform(low, high, 1, 1, 1)

    y = torch.linspace(-1.0, 1.0, height, device=device)[:, None]
    x = torch.linspace(-1.0, 1.0, width, device=device)[None]
    corner = (x.square() + y.square()) * 0.5
    shown = shown * (1.0 - torch.where(u(0, 1) < 0.3, u(0.0, 0.3), u(0, 0)) * corner)
    blurred = torch.nn.functional.avg_pool2d(
        torch.nn.functional.pad(shown, (1, 1, 1, 1), mode="replicate"), 3, stride=1
    )
    share = torch.where(u(0, 1) < 0.35, u(0.0, 1.0), u(0, 0))
    shown = shown * (1.0 - share) + blurred * share
    grain = torch.where(u(0, 1) < 0.6, u(0.0, 0.03), u(0, 0))
    noise = torch.randn(shown.shape, generator=generator, device=device)
    shown = (shown + grain * noise * (0.3 + shown)).clamp(0.0, 1.0)
    blocks = _jpeg(shown, u(0.2, 1.8))
    return torch.where(u(0, 1) < 0.3, blocks, shown).clamp(0.0, 1.0)


def _jpeg(shown: Tensor, coarseness: Tensor) -> Tensor:
    """Return pictures whose 8 x 8 blocks went through a rounded cosine transform.

    Args:
        shown: Shape [B, C, H, W], of sides that 8 divides.
        coarseness: Factor on the steps, shape [B, 1, 1, 1].
    """
    k = torch.arange(8, device=shown.device, dtype=torch.float32)
    dct = torch.cos((k[None] + 0.5) * k[:, None] * np.pi / 8.0) * 0.5
    dct[0] *= np.sqrt(0.5)
    steps = (8.0 + 7.0 * (k[:, None] + k[None])) / 255.0
    b, c, h, w = shown.shape
    tiles = shown.view(b, c, h // 8, 8, w // 8, 8).permute(0, 1, 2, 4, 3, 5)
    step = steps * coarseness[..., None, None]
    coded = torch.round(dct @ (tiles - 0.5) @ dct.T / step) * step
    decoded = dct.T @ coded @ dct + 0.5
    return decoded.permute(0, 1, 2, 4, 3, 5).reshape(b, c, h, w)
