"""What holds the two lights together and their colours in bounds (DiPIR, eq. 9 to 11).

All are sums over the sphere, as the authors write them; their weights are relative to a guidance
loss that is summed over its latents.
"""

from __future__ import annotations

import torch
from torch import Tensor

from warpir.lighting.latlong_tensors import luminance, solid_angles
from warpir.lighting.sg_light import SGLight
from warpir.render.tone_curve import Knots

LOG_FLOOR = 1e-8
"""Added to a normalised luminance before its logarithm [1/sr]."""
FLUX_FLOOR = 1e-20
"""Least flux that a map is normalised by; with less it is black, and its gradient stays finite."""


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
