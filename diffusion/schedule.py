"""Noise schedules: how much noise a time stands for, and the three things a network may predict.

z_t = a z + s noise,   a^2 = alphas_cumprod,   s^2 = 1 - a^2
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

TIME_LIMIT = 0.98
"""Latest time that is used: a schedule rescaled to zero terminal SNR has no signal at its end."""


@dataclass(frozen=True)
class NoiseSchedule:
    """A discrete schedule, seen through times in [0, 1]."""

    alphas_cumprod: Tensor
    """alpha-bar by timestep, float64 on the CPU, shape [T]."""
    prediction_type: str
    """``epsilon``, ``v_prediction`` or ``sample``."""

    def timestep(self, t: Tensor) -> Tensor:
        """Return the integer timesteps of times in [0, 1], same shape."""
        count = len(self.alphas_cumprod)
        return (t * count).long().clamp(0, count - 1)

    def alpha_sigma(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``a`` and ``s``, float32 on t's device, same shape as ``t``."""
        # The table goes to the times: the other way round would wait for the device's queue.
        bar = self.alphas_cumprod.to(t.device, non_blocking=True)[self.timestep(t)]
        return bar.sqrt().float(), (1.0 - bar).sqrt().float()

    def add_noise(self, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return ``z_t``, shape [B, C, h, w]."""
        a, s = (x.view(-1, 1, 1, 1) for x in self.alpha_sigma(t))
        return a * latents + s * noise

    def to_noise(self, predicted: Tensor, latents_noisy: Tensor, t: Tensor) -> Tensor:
        """Turn what the network predicts into the noise it sees.

        With v: ``a v + s z_t``; with the clean sample: ``(z_t - a x0) / s``.
        """
        if self.prediction_type == "epsilon":
            return predicted
        a, s = (x.view(-1, 1, 1, 1) for x in self.alpha_sigma(t))
        if self.prediction_type == "v_prediction":
            return a * predicted + s * latents_noisy
        return (latents_noisy - a * predicted) / s

    def target(self, latents: Tensor, noise: Tensor, t: Tensor) -> Tensor:
        """Return what the network should predict, for training."""
        if self.prediction_type == "epsilon":
            return noise
        if self.prediction_type == "sample":
            return latents
        a, s = (x.view(-1, 1, 1, 1) for x in self.alpha_sigma(t))
        return a * noise - s * latents


def weight(name: str, alpha: Tensor, sigma: Tensor, literal_alpha: bool = False) -> Tensor:
    """Return w(t) of a residual (left open by the authors).

    Args:
        name: ``sigma2`` (as threestudio's SDS), ``sigma`` or ``uniform``.
        alpha: a, any shape.
        sigma: s, same shape.
        literal_alpha: Multiply by ``a``, the factor of dz_t/dphi in DiPIR's eq. 7 and 8.
    """
    chosen = {"sigma2": sigma * sigma, "sigma": sigma, "uniform": torch.ones_like(sigma)}[name]
    return chosen * alpha if literal_alpha else chosen


def time_range(
    step: int, steps: int, low: float, high: float, high_end: float
) -> tuple[float, float]:
    """Return the least and greatest time of a step; the greatest falls linearly (section 4.3.2)."""
    share = step / max(steps - 1, 1)
    top = min(high + (high_end - high) * share, TIME_LIMIT)
    return min(low, top), top
