"""The light that is optimised: spherical Gaussians with bounded raw parameters.

    L(v) = sum_k c_k exp(-(1 - v . mu_k) / sigma_k^2)        DiPIR (Liang et al. 2024), eq. 2 and 3

Amplitudes and widths are optimised as logarithms, because a sun is 10^3 to 10^5 times its sky: a
step multiplies. Score distillation is known to let colours run away, so a lobe's colour ratios are
bounded smoothly; the bound is far beyond any real lamp, and inside it nothing is held back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from warpir.light import Lobes, map_directions

UNIFORM_MEAN = 2.262
"""Mean of the map that equal lobes of the start width make, in amplitudes, for any count."""
WIDTH_FACTOR = 0.6
"""Start width of a lobe in spacings of the lobes: their sum ripples by 1.8 %."""
TEXELS_PER_SIGMA = 1.25
"""Narrowest lobe, in texels: its value at a texel's centre is then its mean (spectral accuracy of
the midpoint rule for Gaussians), so maps need no supersampling and its flux is right."""
WIDEST = 3.0
"""Widest lobe, sigma [rad]."""


@dataclass(frozen=True)
class LightBounds:
    """What a light may not leave."""

    sigma_min: float
    """Narrowest lobe [rad]."""
    chroma: float = 1.5
    """Largest log ratio of a channel to a lobe's mean, either way [1]."""
    intensity: float = 1e6
    """Largest factor between an amplitude and the start level, either way [1]."""


class SGLight(torch.nn.Module):
    """One set of lobes, as the optimiser holds it.

    Args:
        lobes: Where to start; amplitudes of 0 start at the least intensity.
        level: Radiance that the intensity bound is relative to, relative [W/(m^2 sr)].
        bounds: What the lobes may not leave.

    Attributes:
        log_intensity: Log of the channels' geometric mean, shape [lobe].
        chroma: Raw log colour ratios, shape [lobe, 3].
        axis: Directions, unit after `project`, world frame, shape [lobe, 3].
        log_sigma: Log of the width [rad], shape [lobe].
    """

    def __init__(self, lobes: Lobes, level: float, bounds: LightBounds) -> None:
        super().__init__()
        self.level, self.bounds = float(level), bounds
        amplitude = np.maximum(lobes.amplitude.astype(np.float64), level / bounds.intensity)
        log = np.log(amplitude)
        intensity = log.mean(axis=1)
        # The inverse of the bound; ratios at the bound itself have no raw value.
        ratio = np.clip((log - intensity[:, None]) / bounds.chroma, -0.99, 0.99)
        raw = bounds.chroma * np.arctanh(ratio)
        sigma = 1.0 / np.sqrt(lobes.sharpness.astype(np.float64))

        def parameter(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Tensor:
            return torch.nn.Parameter(torch.from_numpy(values.astype(np.float32)))

        self.log_intensity = parameter(intensity)
        self.chroma = parameter(raw)
        self.axis = parameter(lobes.axis.astype(np.float64))
        self.log_sigma = parameter(np.log(sigma))
        self.project()

    @staticmethod
    def uniform(count: int, level: float, bounds: LightBounds) -> SGLight:
        """Return grey lobes spread evenly whose map has the mean ``level``."""
        sigma = max(WIDTH_FACTOR * np.sqrt(4.0 * np.pi / count), bounds.sigma_min)
        lobes = Lobes(
            np.full((count, 3), level / UNIFORM_MEAN, np.float32),
            fibonacci(count),
            np.full(count, 1.0 / sigma**2, np.float32),
        )
        return SGLight(lobes, level, bounds)

    def project(self) -> None:
        """Bring the parameters back within their bounds; called after each optimiser step."""
        low, high = np.log(self.bounds.sigma_min), np.log(WIDEST)
        reach = float(np.log(self.bounds.intensity))
        with torch.no_grad():
            self.axis /= self.axis.norm(dim=1, keepdim=True).clamp(min=1e-12)
            self.log_sigma.clamp_(low, high)
            self.log_intensity.clamp_(np.log(self.level) - reach, np.log(self.level) + reach)
            self.chroma -= self.chroma.mean(dim=1, keepdim=True)

    def log_ratios(self) -> Tensor:
        """Return the bounded log colour ratios, shape [lobe, 3]."""
        limit = self.bounds.chroma
        return limit * torch.tanh(self.chroma / limit)

    def amplitude(self) -> Tensor:
        """Return the lobes' peaks, relative [W/(m^2 sr)], shape [lobe, 3]."""
        return torch.exp(self.log_intensity[:, None] + self.log_ratios())

    def texels(self, height: int) -> Tensor:
        """Return the light as a lat-long map, shape [height, 2 height, 3]; differentiable.

        Each texel holds the light at its centre, which is exact enough for lobes of at least
        `TEXELS_PER_SIGMA` texels; `warpir.bridge.rasterize` averages lobes of any width.
        """
        directions = _directions(height).to(self.axis.device)
        axis = self.axis / self.axis.norm(dim=1, keepdim=True)
        sharpness = torch.exp(-2.0 * self.log_sigma)
        exponent = (directions @ axis.T - 1.0) * sharpness
        return (torch.exp(exponent) @ self.amplitude()).reshape(height, 2 * height, 3)

    def lobes(self) -> Lobes:
        """Return the current lobes as plain arrays."""
        with torch.no_grad():
            axis = self.axis / self.axis.norm(dim=1, keepdim=True)
            sharpness = torch.exp(-2.0 * self.log_sigma)
            parts = (self.amplitude(), axis, sharpness)
            amplitude, unit, concentration = (p.cpu().numpy().copy() for p in parts)
        return Lobes(amplitude, unit, concentration)


def narrowest(height: int) -> float:
    """Return the width of the narrowest lobe that a map of that height holds, sigma [rad]."""
    return TEXELS_PER_SIGMA * np.pi / height


def fibonacci(count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """Return evenly spread unit directions, world frame, shape [count, 3]."""
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    lon = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - y * y)
    return np.stack([r * np.sin(lon), y, r * np.cos(lon)], axis=1).astype(np.float32)


@lru_cache(maxsize=8)
def _directions(height: int) -> Tensor:
    return torch.from_numpy(map_directions(height, 2 * height).reshape(-1, 3).astype(np.float32))
