"""A trust region: guidance may not lead the light far from what the regressor is sure of.

    trust = angle^2 / spread^2 + (log sun / sun_0)^2 / std^2 + (log ambient / ambient_0)^2 / std^2
            + sum_k share_k (log^2 (flux_k / flux_k0 * ambient_0 / ambient) + |axis_k - axis_k0|^2)
              / shape^2

of the dominant lobe, of all others together, and of how these are spread over the directions: a
prior that sees 64 x 64 pixels cannot tell fourteen lobes apart, and would bend them to please
itself. Softness and colour are free within their bounds.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance
from warpir.lighting.sg_light import SGLight

SPREAD_MIN = float(torch.pi) / 36.0
"""Least spread that a direction is believed to have [rad]: 5 degrees."""
SPREAD_MAX = float(torch.pi) / 9.0
"""Greatest spread of it [rad]: 20 degrees. Where nobody knows, a small network is no guide."""
LOG_STD_MIN, LOG_STD_MAX = 0.1, 0.7
"""Least and greatest standard deviation that a log intensity is believed to have: without the
greatest one, guidance puts out a sun that the regressor is not sure of, for soft light is never
quite wrong."""
SHAPE_STD = 0.2
"""How far the other lobes may leave their common change: logs of flux, or chords of directions."""
SMALL = 1e-4
"""Below it, (1 - cos) / 2 has the square of the angle as a series [1]."""


@dataclass(frozen=True)
class TrustRegion:
    """Where the light is expected, and how surely; the dominant lobe is the first."""

    axis: Tensor
    """Unit direction of the dominant light, world frame, shape [3]."""
    log_sun: Tensor
    """Log luminous flux of the dominant lobe, shape []."""
    log_ambient: Tensor
    """Log luminous flux of all others, shape []."""
    spread: float
    """Expected angle between `axis` and the truth [rad]."""
    sun_std: float
    """Standard deviation of `log_sun`."""
    ambient_std: float
    """Standard deviation of `log_ambient`."""
    log_fluxes: Tensor
    """Of each other lobe, shape [lobe - 1]."""
    axes: Tensor
    """Of each other lobe, unit, world frame, shape [lobe - 1, 3]."""

    @staticmethod
    def around(light: SGLight, spread: float, sun_std: float, ambient_std: float) -> TrustRegion:
        """Return the region whose middle is a light, the first of whose lobes is the dominant one.

        Args:
            light: Where the recovery starts.
            spread: Of the dominant direction [rad], brought into `SPREAD_MIN` to `SPREAD_MAX`.
            sun_std: Of the dominant lobe's log flux, brought into `LOG_STD_MIN` to `LOG_STD_MAX`.
            ambient_std: Of the others' log flux, likewise.
        """
        with torch.no_grad():
            log_fluxes = _log_fluxes(light)
            axes = torch.nn.functional.normalize(light.axis, dim=1)
        return TrustRegion(
            axes[0].clone(),
            log_fluxes[0].clone(),
            torch.logsumexp(log_fluxes[1:], dim=0),
            min(max(spread, SPREAD_MIN), SPREAD_MAX),
            min(max(sun_std, LOG_STD_MIN), LOG_STD_MAX),
            min(max(ambient_std, LOG_STD_MIN), LOG_STD_MAX),
            log_fluxes[1:].clone(),
            axes[1:].clone(),
        )

    def distance(self, light: SGLight) -> Tensor:
        """Return the squared distance of a light in units of what is uncertain, shape []."""
        log_fluxes = _log_fluxes(light)
        axes = torch.nn.functional.normalize(light.axis, dim=1)
        turned = squared_angle(axes[0], self.axis) / self.spread**2
        brighter = ((log_fluxes[0] - self.log_sun) / self.sun_std).square()
        change = torch.logsumexp(log_fluxes[1:], dim=0) - self.log_ambient
        away = (log_fluxes[1:] - self.log_fluxes - change).square()
        away = away + (axes[1:] - self.axes).square().sum(dim=1)
        share = torch.exp(self.log_fluxes - self.log_ambient)
        shape = (share * away).sum() / SHAPE_STD**2
        return turned + brighter + (change / self.ambient_std).square() + shape


def squared_angle(a: Tensor, b: Tensor) -> Tensor:
    """Return the square of the angle between unit vectors of shape [3], smooth where it is 0."""
    x = (a - b).square().sum() / 4.0
    # angle = 2 asin(sqrt(x)), whose root has no derivative at 0, nor has asin at 1.
    root = x.clamp(SMALL, 1.0 - 1e-6).sqrt()
    return torch.where(x < SMALL, 4.0 * x * (1.0 + x / 3.0), 4.0 * torch.asin(root).square())


def _log_fluxes(light: SGLight) -> Tensor:
    """Return the log of each lobe's luminous flux, shape [lobe]."""
    variance = torch.exp(2.0 * light.log_sigma)
    return torch.log(luminance(light.amplitude()) * variance * -torch.expm1(-2.0 / variance))
