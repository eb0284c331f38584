"""Monotone rational-quadratic tone curves on [0, 1].

Durkan et al. 2019, "Neural Spline Flows", eq. 4. The host's half, raw parameters to knots, is
`warpir.render.tone_curve`.
"""

import warp as wp


@wp.func
def find_bin(x: float, curve: int, knot_x: wp.array2d[float], bin_count: int) -> int:
    """Return the bin that holds ``x``; apart from the curve because Warp does not replay loops."""
    b = int(0)
    for k in range(1, bin_count):
        if x >= knot_x[curve, k]:
            b += 1
    return b


@wp.func_grad(find_bin)
def adj_find_bin(x: float, curve: int, knot_x: wp.array2d[float], bin_count: int, adj_ret: int):
    """Do nothing: a bin's number has no slope, and nothing need be added to the knots."""
    pass


@wp.func
def tone_curve(
    x: float,
    curve: int,
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
) -> float:
    """Evaluate one curve; values outside [0, 1] are clamped first.

    Differentiable in ``x`` and the knots.

    Args:
        x: Linear value [1].
        curve: Which curve.
        knot_x: Increasing from 0 to 1, shape [curve, bin_count + 1].
        knot_y: Increasing from 0 to 1, same shape.
        knot_slope: Positive slopes at the knots, same shape.
        bin_count: Number of bins.
    """
    x = wp.clamp(x, 0.0, 1.0)
    b = find_bin(x, curve, knot_x, bin_count)
    x0 = knot_x[curve, b]
    y0 = knot_y[curve, b]
    width = knot_x[curve, b + 1] - x0
    rise = knot_y[curve, b + 1] - y0
    # A bin of no height is flat; one of no width is met at the right end alone.
    if width <= 0.0 or rise <= 0.0:
        return knot_y[curve, b + 1]
    m = rise / width
    q = (x - x0) / width
    d0 = knot_slope[curve, b]
    d1 = knot_slope[curve, b + 1]
    r = q * (1.0 - q)
    return y0 + rise * (m * q * q + d0 * r) / (m + (d1 + d0 - 2.0 * m) * r)


@wp.func
def ratio_curve(
    x: float,
    curve: int,
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
) -> float:
    """Evaluate a curve of the shadow ratio; beyond 1 it goes on straight, with its slope there.

    Arguments and gradients are those of `tone_curve`.
    """
    shown = tone_curve(x, curve, knot_x, knot_y, knot_slope, bin_count)
    if x > 1.0:
        shown += (x - 1.0) * knot_slope[curve, bin_count]
    return shown


@wp.func
def reinhard(x: float) -> float:
    """Map radiance [0, inf) to [0, 1): ``x / (1 + x)`` (Reinhard et al. 2002, eq. 3)."""
    x = wp.max(x, 0.0)
    return x / (1.0 + x)


@wp.func_grad(reinhard)
def adj_reinhard(x: float, adj_ret: float):
    """Slope ``1 / (1 + x)^2``: that of the quotient, ``1 / (1 + x) - x / (1 + x)^2``, cancels."""
    if x >= 0.0:
        r = 1.0 / (1.0 + x)
        wp.adjoint[x] += adj_ret * r * r
