"""Spherical Gaussians.

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
