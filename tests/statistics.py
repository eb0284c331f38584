"""Statistical verdicts that tests share: chi-square, z-test, comparison of gradients.

A verdict is a small record with the numbers that explain it; tests assert ``verdict.passed`` and
print the record on failure.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from tests.oracles import gauss_legendre
from warpir.core.arrays import Float64Array

SIGNIFICANCE = 0.01
"""Chance that a family of correct cases fails once; seeds are fixed, so it is drawn once."""
EXPECTED_MIN = 5.0
"""Cells with fewer expected samples are merged: the chi-square law is an approximation."""

DUST = 1e-6
"""Mass that the quadrature of a density may lose."""


def sidak(significance: float, case_count: int) -> float:
    """Return the significance of one of ``case_count`` independent cases (Sidak 1967)."""
    return float(-np.expm1(np.log1p(-significance) / case_count))


@dataclass(frozen=True)
class ChiSquare:
    """Outcome of a chi-square test."""

    passed: bool
    """True when the counts do not contradict the density."""
    p_value: float
    """Chance of a statistic at least as large."""
    statistic: float
    """``sum (count - expected)^2 / expected`` over the merged cells."""
    cell_count: int
    """Cells after merging."""
    reason: str
    """What failed, empty when it passed."""


def chi_square_counts(
    count: ArrayLike, expected: ArrayLike, case_count: int = 1, significance: float = SIGNIFICANCE
) -> ChiSquare:
    """Compare observed with expected counts per cell.

    Cells of fewer than ``EXPECTED_MIN`` expected samples are pooled in rising order. A sample in a
    cell whose expectation is exactly 0 fails at once, however many others agree.

    Args:
        count: Observed counts.
        expected: Expected counts, of the same shape.
        case_count: Number of tests in the family (Sidak correction).
        significance: Of the whole family.
    """
    count = np.asarray(count, float).ravel()
    expected = np.asarray(expected, float).ravel()
    if not np.all(np.isfinite(expected)) or np.any(expected < 0.0):
        return ChiSquare(False, 0.0, np.inf, 0, "an expected count is negative or not finite")
    forbidden = count[expected == 0.0].sum()
    if forbidden > 0.0:
        return ChiSquare(False, 0.0, np.inf, 0, f"{forbidden:.0f} samples where the density is 0")
    order = np.argsort(expected)
    order = order[expected[order] > 0.0]
    count, expected = count[order], expected[order]
    # Pool the small cells: the shortest run of the smallest that reaches the limit, together with
    # every other cell that is below it on its own.
    pool = int(np.searchsorted(expected, EXPECTED_MIN))
    if pool > 0:
        pool = max(pool, int(np.searchsorted(np.cumsum(expected), EXPECTED_MIN)) + 1)
        count = np.concatenate([[count[:pool].sum()], count[pool:]])
        expected = np.concatenate([[expected[:pool].sum()], expected[pool:]])
    if len(count) < 2:
        return ChiSquare(False, 0.0, np.inf, len(count), "fewer than two cells: refine the grid")
    statistic = float(np.sum((count - expected) ** 2 / expected))
    p_value = float(stats.chi2.sf(statistic, len(count) - 1))
    passed = p_value > sidak(significance, case_count)
    return ChiSquare(passed, p_value, statistic, len(count), "" if passed else "counts differ")


def chi_square(
    direction: ArrayLike,
    pdf: Callable[[Float64Array], Float64Array],
    theta_edges: ArrayLike,
    phi_edges: ArrayLike,
    frame: ArrayLike | None = None,
    sample_count: int | None = None,
    case_count: int = 1,
    order: int = 6,
) -> ChiSquare:
    """Compare sampled directions with the integral of their density over lat-long cells.

    Polar angle and azimuth are taken about the third column of ``frame``. Edges may be graded, so
    that narrow lobes span many cells, and should include every line on which the density jumps.
    What the cells do not cover is one more cell, which expects the missing mass.

    Args:
        direction: Sampled unit directions that were used, shape [sample, 3].
        pdf: Density per solid angle of unit directions of shape [..., 3].
        theta_edges: Rising polar angles of the cells' borders [rad].
        phi_edges: Rising azimuths of the cells' borders [rad], within one turn.
        frame: Rotation with the grid's axes as columns; identity when absent.
        sample_count: Samples drawn, when some were dropped before ``direction``.
        case_count: Number of tests in the family.
        order: Gauss-Legendre nodes per cell and axis.
    """
    frame = np.eye(3) if frame is None else np.asarray(frame, float)
    theta_edges, phi_edges = np.asarray(theta_edges, float), np.asarray(phi_edges, float)
    local = np.asarray(direction, float) @ frame
    drawn = len(local) if sample_count is None else sample_count
    theta = np.arctan2(np.hypot(local[:, 0], local[:, 1]), local[:, 2])
    phi = phi_edges[0] + np.mod(np.arctan2(local[:, 1], local[:, 0]) - phi_edges[0], 2.0 * np.pi)
    count, _, _ = np.histogram2d(theta, phi, bins=(theta_edges, phi_edges))

    node_t, weight_t = gauss_legendre(theta_edges, order)
    node_p, weight_p = gauss_legendre(phi_edges, order)
    sin_t = np.sin(node_t)[:, None]
    node = np.stack(
        np.broadcast_arrays(
            sin_t * np.cos(node_p), sin_t * np.sin(node_p), np.cos(node_t)[:, None]
        ),
        axis=-1,
    )
    mass = np.asarray(pdf(node @ frame.T), float) * sin_t * weight_t[:, None] * weight_p
    shape = (len(theta_edges) - 1, order, len(phi_edges) - 1, order)
    expected = mass.reshape(shape).sum(axis=(1, 3))
    total = float(expected.sum())
    if total > 1.0 + 1e-3:
        return ChiSquare(False, 0.0, np.inf, 0, f"the density integrates to {total:.6f}")
    # The quadrature is good to 1e-6: without dropped samples less than that is no cell of its own,
    # with them it is the least that may be missing.
    missing = max(1.0 - total, DUST) if drawn > len(local) or 1.0 - total > DUST else 0.0
    outside = drawn - count.sum()
    if missing == 0.0 and outside > 0:
        return ChiSquare(False, 0.0, np.inf, 0, f"{outside:.0f} samples outside the support")
    return chi_square_counts(
        np.append(count.ravel(), outside), drawn * np.append(expected.ravel(), missing), case_count
    )


def graded_edges(centre: float, width: float, low: float, high: float, count: int) -> Float64Array:
    """Return rising edges from ``low`` to ``high``, dense within ``width`` of ``centre``.

    The spacing grows like ``sinh`` on both sides, so a lobe of any width gets a similar number of
    cells.
    """
    reach_low = np.arcsinh((centre - low) / width)
    reach_high = np.arcsinh((high - centre) / width)
    s = np.linspace(-reach_low, reach_high, count + 1)
    edges = centre + width * np.sinh(s)
    edges[0], edges[-1] = low, high
    return edges


@dataclass(frozen=True)
class ZTest:
    """Outcome of a per-pixel comparison with a reference of known variance."""

    passed: bool
    """True when enough pixels agree."""
    share: float
    """Share of pixels whose p-value exceeds the significance."""
    p_value: Float64Array
    """Two-sided, one per value of the image."""


def z_test(
    image: ArrayLike,
    mean: ArrayLike,
    variance: ArrayLike,
    share_min: float = 0.9975,
    significance: float = SIGNIFICANCE,
) -> ZTest:
    """Compare an image with a mean and the variance of that difference, pixel by pixel.

    Args:
        image: Values under test.
        mean: Reference of the same shape.
        variance: Of ``image - mean``: the variance of the image's estimator plus that of the
            reference.
        share_min: Pixels that must agree.
        significance: Family-wise, corrected by Sidak over all values.
    """
    image, mean = np.asarray(image, float), np.asarray(mean, float)
    variance = np.asarray(variance, float)
    difference = np.abs(image - mean)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(
            variance > 0.0, difference / np.sqrt(variance), np.where(difference > 0, np.inf, 0)
        )
    z = np.where(np.isfinite(image), z, np.inf)
    p_value = 2.0 * stats.norm.sf(z)
    share = float(np.mean(p_value > sidak(significance, image.size)))
    return ZTest(share >= share_min, share, p_value)


@dataclass(frozen=True)
class GradientMatch:
    """How a gradient compares with its reference, as vectors."""

    relative_l2: float
    """``|g - r| / |r|``."""
    cosine: float
    """Of the angle between both."""
    signed_bias: float
    """``(<g, r> - |r|^2) / |r|^2``: the scale error along the reference."""


def compare_gradients(gradient: ArrayLike, reference: ArrayLike) -> GradientMatch:
    """Compare a gradient with its reference as flat float64 vectors."""
    g, r = np.asarray(gradient, float).ravel(), np.asarray(reference, float).ravel()
    if g.shape != r.shape:
        raise ValueError(f"shapes differ: {g.shape} and {r.shape}")
    rr, gg = float(r @ r), float(g @ g)
    if rr == 0.0:
        return GradientMatch(np.inf if gg > 0 else 0.0, 0.0 if gg > 0 else 1.0, 0.0)
    return GradientMatch(
        float(np.linalg.norm(g - r) / np.sqrt(rr)),
        float(g @ r / np.sqrt(rr * gg)) if gg > 0.0 else 0.0,
        float((g @ r - rr) / rr),
    )


def central_differences(
    function: Callable[[Float64Array], float], x: ArrayLike, step: float | ArrayLike = 1e-6
) -> Float64Array:
    """Return the gradient of a scalar function by central differences, of the shape of ``x``.

    Args:
        function: Maps an array of the shape of ``x`` to a float.
        x: Where to differentiate.
        step: Half the distance of the two evaluations, scalar or per element.
    """
    x = np.asarray(x, float)
    step = np.broadcast_to(np.asarray(step, float), x.shape)
    gradient = np.empty_like(x)
    for index in np.ndindex(x.shape):
        plus, minus = x.copy(), x.copy()
        plus[index] += step[index]
        minus[index] -= step[index]
        gradient[index] = (function(plus) - function(minus)) / (plus[index] - minus[index])
    return gradient
