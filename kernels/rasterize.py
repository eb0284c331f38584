"""Lobes to a lat-long map: the mean radiance of each texel."""

import warp as wp

from warpir.kernels.latlong import uv_to_direction
from warpir.kernels.sg import sg_shape

PI = wp.constant(3.14159265358979)
STEPS_PER_SIGMA = wp.constant(3.0)
"""Directions per standard deviation of a lobe; its power is then good to 0.1 %."""
SIDE_MAX = wp.constant(64)
"""Most directions along a texel's side: power within 1 % up to sharpness ``(17 He)^2``."""
NODE = wp.constant(0.5773502691896258)
"""Node of the two-point Gauss-Legendre rule on [-1, 1]."""
REACH = wp.constant(6.0)
"""Standard deviations beyond which a lobe is dark (1.5e-8 of its peak)."""


@wp.func
def texel_mean(
    axis: wp.vec3, sharpness: float, i: int, j: int, height: int, width: int, side: int
) -> float:
    """Average one lobe of unit amplitude over a texel; ``side``, even, squared directions.

    Pairs of rows are the two-point Gauss-Legendre nodes of bands that are even in latitude, with
    the bands' exact solid angle. Even steps in the sine of latitude would leave the cap around a
    pole without directions, and midpoints would misjudge it: the integrand starts there with a
    slope, so a lobe at the pole would gain ``(step / sigma)^2 / 24`` of its power.
    """
    step = PI / float(height * side)
    texel = 2.0 * wp.sin(PI * (float(i) + 0.5) / float(height)) * wp.sin(0.5 * PI / float(height))
    scale = wp.sin(step) / (wp.cos(step * NODE) * texel * float(side))
    mean = float(0.0)
    for a in range(side):
        node = float(2 * (a % 2) - 1) * NODE
        theta = (float(i * side + 2 * (a // 2) + 1) + node) * step
        weight = scale * wp.sin(theta)
        for b in range(side):
            u = (float(j) + (float(b) + 0.5) / float(side)) / float(width)
            mean += weight * sg_shape(uv_to_direction(u, theta / PI), axis, sharpness)
    return mean


@wp.func
def texel_side(axis: wp.vec3, sharpness: float, i: int, j: int, height: int, width: int) -> int:
    """Return how many directions, an even number, a lobe needs along a side; 0 where it is dark."""
    extent = PI / float(height)
    centre = uv_to_direction((float(j) + 0.5) / float(width), (float(i) + 0.5) / float(height))
    reach = extent + REACH / wp.sqrt(sharpness)
    # Chords obey the triangle inequality and no point of a texel is farther than its extent from
    # the centre, so what is skipped is dark everywhere.
    if wp.length(centre - axis) > reach:
        return 0
    pairs = int(0.5 * STEPS_PER_SIGMA * extent * wp.sqrt(sharpness)) + 1
    return wp.min(2 * pairs, SIDE_MAX)


@wp.kernel
def rasterize(
    height: int,
    width: int,
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    texels: wp.array2d[wp.vec3],
):
    """Average the lobes over each texel's solid angle; narrow lobes get more directions.

    Differentiable in ``amplitude``, ``axis`` and ``sharpness``.

    Args:
        height: He.
        width: We.
        amplitude: Lobe peak radiance, relative [W/(m^2 sr)], shape [lobe].
        axis: Unit lobe axes, world frame, shape [lobe].
        sharpness: Lobe concentration [1], shape [lobe].
        lobe_count: Number of lobes.
        texels: Output radiance, shape [He, We].
    """
    i, j = wp.tid()
    L = wp.vec3(0.0)
    for k in range(lobe_count):
        side = texel_side(axis[k], sharpness[k], i, j, height, width)
        if side > 0:
            L += amplitude[k] * texel_mean(axis[k], sharpness[k], i, j, height, width, side)
    texels[i, j] = L
