"""Tone curves, the host's half: raw parameters to knots of a monotone rational-quadratic spline.

Durkan et al. 2019, "Neural Spline Flows", with the constants of the authors' code `nflows`; the
device's half, evaluation, is `warpir.kernels.tone`. Zero parameters are the identity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import FloatArray
from warpir.scene.tone_curves import ToneKnots

MIN_BIN = 1e-3
"""Least width, height and slope of a bin [1]."""
BETA = float(np.log(2.0) / (1.0 - MIN_BIN))
"""Sharpness of the slopes' softplus: softplus(0) = 1 - MIN_BIN, so a zero parameter is slope 1."""
LEAST = 1e-6
"""Least excess over `MIN_BIN` when raw parameters are computed from knots [1]."""


@dataclass(frozen=True)
class Knots:
    """Knots of one or several curves, shape [curve, bin + 1] each; differentiable."""

    x: Tensor
    y: Tensor
    slope: Tensor


def _edges(raw: Tensor) -> Tensor:
    """Turn raw bin sizes, shape [curve, bin], into increasing edges from 0 to 1."""
    bins = raw.shape[1]
    size = MIN_BIN + (1.0 - MIN_BIN * bins) * torch.softmax(raw, dim=1)
    inner = torch.cumsum(size, dim=1)[:, :-1]
    zero = torch.zeros_like(raw[:, :1])
    return torch.cat([zero, inner, zero + 1.0], dim=1)


def _raw_bins(edges: FloatArray) -> Tensor:
    """Return raw bin sizes whose `_edges` are these; even bins are zeros."""
    sizes = torch.from_numpy(np.diff(edges.astype(np.float64), axis=1))
    raw = torch.log((sizes - MIN_BIN).clamp(min=LEAST))
    return raw - raw.mean(dim=1, keepdim=True)


class ToneCurve(torch.nn.Module):
    """One or several tone curves; 16 raw numbers a curve at 5 bins.

    Args:
        curves: 1 for the foreground, 3 for the shadow ratio's channels.
        bins: Bins of the spline.

    Attributes:
        widths: Raw bin widths, shape [curve, bin].
        heights: Raw bin heights, shape [curve, bin].
        slopes: Raw slopes, shape [curve, bin + 1].
    """

    def __init__(self, curves: int, bins: int = 5) -> None:
        super().__init__()
        self.widths = torch.nn.Parameter(torch.zeros(curves, bins))
        self.heights = torch.nn.Parameter(torch.zeros(curves, bins))
        self.slopes = torch.nn.Parameter(torch.zeros(curves, bins + 1))

    @staticmethod
    def from_knots(knots: ToneKnots) -> ToneCurve:
        """Return curves that start at given knots.

        Bins and slopes below `MIN_BIN`, which no parameters mean, are raised to it.
        """
        curve = ToneCurve(len(knots.x), knots.bin_count)
        with torch.no_grad():
            curve.widths.copy_(_raw_bins(knots.x))
            curve.heights.copy_(_raw_bins(knots.y))
            above = torch.from_numpy(knots.slope.astype(np.float64) - MIN_BIN).clamp(min=LEAST)
            curve.slopes.copy_(above + torch.log(-torch.expm1(-BETA * above)) / BETA)
        return curve

    def forward(self) -> Knots:
        """Return the knots of the current parameters."""
        slope = MIN_BIN + torch.nn.functional.softplus(self.slopes, beta=BETA)
        return Knots(_edges(self.widths), _edges(self.heights), slope)

    def plain(self) -> ToneKnots:
        """Return the knots as plain arrays, for files and the final render."""
        with torch.no_grad():
            return ToneKnots(*(part.cpu().numpy() for part in vars(self.forward()).values()))
