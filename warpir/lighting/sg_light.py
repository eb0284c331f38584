"""The light that is optimised: spherical Gaussians with bounded raw parameters.

    L(v) = sum_k c_k exp(-(1 - v . mu_k) / sigma_k^2)        DiPIR (Liang et al. 2024), eq. 2 and 3

Amplitudes and widths are optimised as logarithms, because a sun is 10^3 to 10^5 times its sky: a
step multiplies. Score distillation is known to let colours run away, so a lobe's colour ratios are
bounded smoothly: far beyond daylight and white lamps, and inside the bound nothing is held back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from warpir.core.color import luminance
from warpir.lighting.latlong_tensors import map_directions
from warpir.scene.light import Lobes, fibonacci

WIDTH_FACTOR = 0.6
"""Start width of a lobe in spacings of the lobes: the sum of 64 ripples by 1.8 % (rms)."""
TEXELS_PER_SIGMA = 1.25
"""Narrowest lobe, in texels: its values at texel centres then sum to its flux (spectral accuracy of
the midpoint rule for Gaussians; 3 % too much at a pole), so maps need no supersampling."""
WIDEST = 3.0
"""Widest lobe, sigma [rad]."""


@dataclass(frozen=True)
class LightBounds:
    """What a light may not leave."""

    sigma_min: float
    """Narrowest lobe [rad]."""
    chroma: float = 1.5
    """Largest log ratio of a channel to the geometric mean of its lobe, either way; above 0 [1]."""
    intensity: float = 1e6
    """Largest factor between that mean and the start level, either way; at least 1 [1]."""

    @property
    def chroma_length(self) -> float:
        """Bound on the length of a lobe's three log ratios; they sum to 0 [1]."""
        return self.chroma * float(np.sqrt(1.5))


class SGLight(torch.nn.Module):
    """One set of lobes, as the optimiser holds it.

    Lobes narrower than the bounds allow are widened at the same peak, so their flux grows;
    `warpir.optimize.recover.widened` widens them at the same flux.

    Args:
        lobes: Where to start; amplitudes of 0 start at the least intensity, and colours that the
            bound excludes are drawn toward white at their luminance.
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
        log = np.log(np.maximum(lobes.amplitude.astype(np.float64), level / bounds.intensity))
        intensity = log.mean(axis=1)
        ratio = log - intensity[:, None]
        # The inverse of `log_ratios`; ratios at the bound itself have no raw value.
        length, most = np.linalg.norm(ratio, axis=1), 0.99 * bounds.chroma_length
        inside = ratio * (most / np.maximum(length, most))[:, None]
        intensity += np.log(luminance(np.exp(ratio)) / luminance(np.exp(inside)))
        share = (inside / bounds.chroma_length) ** 2
        raw = inside / np.sqrt(1.0 - share.sum(axis=1, keepdims=True))
        sigma = 1.0 / np.sqrt(lobes.sharpness.astype(np.float64))

        def parameter(values: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> Tensor:
            return torch.nn.Parameter(torch.from_numpy(values.astype(np.float32)))

        self.log_intensity = parameter(intensity)
        self.chroma = parameter(raw)
        self.axis = parameter(lobes.axis.astype(np.float64))
        self.log_sigma = parameter(np.log(sigma))
        self.project()

    @staticmethod
    def uniform(
        count: int, level: float, bounds: LightBounds, width: float = WIDTH_FACTOR
    ) -> SGLight:
        """Return grey lobes spread evenly whose map has the mean ``level`` [W/(m^2 sr)], relative.

        ``width`` is sigma in spacings of the lobes.
        """
        sigma = max(width * np.sqrt(4.0 * np.pi / count), bounds.sigma_min)
        sharpness = np.full(count, 1.0 / sigma**2, np.float32)
        lobes = Lobes(
            np.ones((count, 3), np.float32), fibonacci(count).astype(np.float32), sharpness
        )
        lobes.amplitude[:] = 4.0 * np.pi * level / lobes.flux().sum(axis=0)
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
        """Return the bounded log colour ratios, which sum to 0, shape [lobe, 3]."""
        return bounded_ratios(self.chroma, self.bounds)

    def amplitude(self) -> Tensor:
        """Return the lobes' peaks, relative [W/(m^2 sr)], shape [lobe, 3]."""
        return torch.exp(self.log_intensity[:, None] + self.log_ratios())

    def texels(self, height: int) -> Tensor:
        """Return the light as a lat-long map, shape [height, 2 height, 3]; differentiable.

        Each texel holds the light at its centre, which is exact enough for lobes of at least
        `TEXELS_PER_SIGMA` texels; `warpir.scene.light.rasterize_lobes` averages lobes of any width.
        """
        directions = map_directions(height, 2 * height, self.axis.device, self.axis.dtype)
        axis = self.axis / self.axis.norm(dim=1, keepdim=True)
        sharpness = torch.exp(-2.0 * self.log_sigma)
        exponent = (directions.reshape(-1, 3) @ axis.T - 1.0) * sharpness
        return (torch.exp(exponent) @ self.amplitude()).reshape(height, 2 * height, 3)

    def lobes(self) -> Lobes:
        """Return the current lobes as plain arrays."""
        with torch.no_grad():
            axis = self.axis / self.axis.norm(dim=1, keepdim=True)
            sharpness = torch.exp(-2.0 * self.log_sigma)
            parts = (self.amplitude(), axis, sharpness)
            amplitude, unit, concentration = (p.cpu().numpy().copy() for p in parts)
        return Lobes(amplitude, unit, concentration)


def bounded_ratios(raw: Tensor, bounds: LightBounds) -> Tensor:
    """Return log colour ratios that sum to 0, within their bound, of raw ones, shape [..., 3]."""
    raw = raw - raw.mean(dim=-1, keepdim=True)
    size = (raw / bounds.chroma_length).square().sum(dim=-1, keepdim=True)
    return raw / torch.sqrt(1.0 + size)


def narrowest(height: int) -> float:
    """Return the width of the narrowest lobe that a map of that height holds, sigma [rad]."""
    return TEXELS_PER_SIGMA * np.pi / height
