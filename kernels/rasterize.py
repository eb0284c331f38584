"""Lobes to a lat-long map: the mean radiance of each texel."""

import warp as wp

from warpir.kernels.latlong import uv_to_direction
from warpir.kernels.sg import sg_radiance

PI = wp.constant(3.14159265358979)


@wp.kernel
def rasterize(
    height: int,
    width: int,
    side: int,
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    texels: wp.array2d[wp.vec3],
):
    """Average the lobes over each texel's solid angle with ``side x side`` directions.

    Directions are even in longitude and in the sine of latitude, so each stands for the same solid
    angle. One direction alone loses lobes narrower than a texel.

    Args:
        height: He.
        width: We.
        side: Directions along each side of a texel.
        amplitude: Lobe peak radiance, relative [W/(m^2 sr)], shape [lobe].
        axis: Unit lobe axes, world frame, shape [lobe].
        sharpness: Lobe concentration [1], shape [lobe].
        lobe_count: Number of lobes.
        texels: Output radiance, shape [He, We].
    """
    i, j = wp.tid()
    top = wp.cos(PI * float(i) / float(height))
    bottom = wp.cos(PI * float(i + 1) / float(height))
    L = wp.vec3(0.0)
    scale = 1.0 / float(side * side)
    for s in range(side * side):
        a = (float(s // side) + 0.5) / float(side)
        b = (float(s % side) + 0.5) / float(side)
        y = top + (bottom - top) * a
        v = wp.acos(y) / PI
        u = (float(j) + b) / float(width)
        L += scale * sg_radiance(uv_to_direction(u, v), amplitude, axis, sharpness, lobe_count)
    texels[i, j] = L
