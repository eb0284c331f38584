"""What holds lights together, their colours in bounds, and an estimated light near its estimate.

The first are DiPIR's (eq. 9 to 11), sums over the sphere, as the authors write them; their weights
are relative to a guidance loss that is summed over its latents. The last is a trust region:
guidance may not lead the light far from what the regressor is sure of.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance, solid_angles
from warpir.lighting.regression import LOG_STD_MAX, LOG_STD_MIN
from warpir.lighting.sg_light import SGLight
from warpir.render.tone_curve import Knots

LOG_FLOOR = 1e-8
"""Added to a normalised luminance before its logarithm [1/sr]."""
FLUX_FLOOR = 1e-20
"""Least flux that a map is normalised by; with less it is black, and its gradient stays finite."""
SPREAD_MIN = float(torch.pi) / 36.0
"""Least spread that a direction is believed to have [rad]: 5 degrees."""
SPREAD_MAX = float(torch.pi) / 9.0
"""Greatest spread of it [rad]: 20 degrees. Where nobody knows, a small network is no guide."""
SHAPE_STD = 0.2
"""How far the other lobes may leave their common change: logs of flux, or chords of directions."""
SMALL = 1e-4
"""Below it, (1 - cos) / 2 has the square of the angle as a series [1]."""


def consistency(texels_fg: Tensor, texels_shadow: Tensor) -> Tensor:
    """Pull the foreground's light toward the shape of the shadow's (eq. 10), without its entropy.

    ``sum Ls log(Ls / Lf) dOmega`` of luminances that are normalised to integrate to 1: the paper's
    cross entropy less a constant, so that 0 means equal shapes. The shadow's light is detached.

    Args:
        texels_fg: Lat-long radiance >= 0, shape [He, We, 3].
        texels_shadow: The same for the shadow.
    """
    omega = solid_angles(texels_fg)

    def normalised(texels: Tensor) -> Tensor:
        grey = luminance(texels)
        return grey / (grey * omega).sum().clamp(min=FLUX_FLOOR)

    shadow = normalised(texels_shadow.detach())
    log_fg = torch.log(normalised(texels_fg) + LOG_FLOOR)
    return (shadow * (torch.log(shadow + LOG_FLOOR) - log_fg) * omega).sum()


def spread(texels_shadow: Tensor) -> Tensor:
    """Keep the shadow's light to few directions: Cauchy, ``sum log(1 + 2 L^2) dOmega`` (eq. 11)."""
    omega = solid_angles(texels_shadow)[..., None]
    return (torch.log1p(2.0 * texels_shadow.square()) * omega).sum()


def chroma(light: SGLight) -> Tensor:
    """Return the mean squared log colour ratio of the light's flux [1], ours.

    Lobes count by their share of the flux, so a coloured lamp among white light is cheap and a
    light that is coloured as a whole is dear. The shares are detached: else a lobe would be dimmed
    for its colour.
    """
    variance = torch.exp(2.0 * light.log_sigma)
    flux = light.amplitude().mean(dim=1) * variance * -torch.expm1(-2.0 / variance)
    share = (flux / flux.sum()).detach()
    return (share[:, None] * light.log_ratios().square()).sum()


def bend(knots: Knots) -> Tensor:
    """Return how far curves are from the identity: mean square of ``y - x`` at the knots [1], ours.

    A tone curve and the light's contrast explain the same pixels; of two explanations the one with
    the plainer curve is preferred.
    """
    return (knots.y - knots.x).square().mean() + 0.1 * torch.log(knots.slope).square().mean()


@dataclass(frozen=True)
class TrustRegion:
    """Where the light is expected, and how surely; the dominant lobe is the first.

        trust = angle^2 / spread^2
                + (log sun / sun_0)^2 / std^2 + (log ambient / ambient_0)^2 / std^2
                + sum_k share_k (log^2 (flux_k / flux_k0 * ambient_0 / ambient)
                                 + |axis_k - axis_k0|^2) / shape^2

    of the dominant lobe, of all others together, and of how these are spread over the directions: a
    prior that sees 64 x 64 pixels cannot tell fourteen lobes apart, and would bend them to please
    itself. Softness and colour are free within their bounds.
    """

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
