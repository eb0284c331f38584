"""Spherical Gaussians: radiance of a sum of lobes.

A lobe is ``G(v) = amplitude * exp(sharpness * (dot(v, axis) - 1))``; DiPIR (Liang et al. 2024,
eq. 2) writes the same lobe with ``sharpness = 1 / sigma^2``.
"""

import warp as wp


@wp.func
def sg_shape(v: wp.vec3, axis: wp.vec3, sharpness: float) -> float:
    """Return ``exp(sharpness * (dot(v, axis) - 1))`` for unit vectors.

    ``1 - dot`` is formed as ``|v - axis|^2 / 2``: the dot product of nearly equal float32 vectors
    keeps no digit of it, and a sun has a sharpness of 1e5. The gradient with respect to ``axis``
    differs from that of the dot form along ``axis`` alone, which normalising ``axis`` removes.
    """
    difference = v - axis
    return wp.exp(-0.5 * sharpness * wp.dot(difference, difference))


@wp.func
def sg_radiance(
    v: wp.vec3,
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
) -> wp.vec3:
    """Radiance arriving from direction ``v``, summed over the lobes.

    Differentiable in ``amplitude``, ``axis`` and ``sharpness``; ``v`` stays detached. Returns the
    raw sum: callers scale or divide it, since Warp does not replay this loop in the backward pass.

    Args:
        v: Unit direction from the shaded point toward the light, world frame.
        amplitude: Lobe peak radiance, relative [W/(m^2 sr)], shape [lobe].
        axis: Unit lobe axes, world frame, shape [lobe].
        sharpness: Lobe concentration [1], shape [lobe].
        lobe_count: Number of lobes to sum.

    Returns:
        Linear RGB radiance, relative [W/(m^2 sr)].
    """
    L = wp.vec3(0.0)
    for k in range(lobe_count):
        L += amplitude[k] * sg_shape(v, axis[k], sharpness[k])
    return L
