"""Gradient of the light over recorded directions: radiance is linear in it.

A pixel is ``sum_j weight_j * L(wi_j)`` with weights that do not depend on L (detached sampling), so
``d_L(wi_j) = d_pixel * weight_j`` goes straight to the texels that shine there: no BRDF,
no ray, no tape. Detached: it *is* the backward pass.
"""

import warp as wp

from warpir.kernels.maths.latlong import bilinear_tap, direction_to_uv
from warpir.kernels.types import LightRecord

wp.set_module_options({"enable_backward": False})


@wp.func
def keep_direction(record: LightRecord, i: int, j: int, wi: wp.vec3, weight: wp.vec3) -> int:
    """Write entry ``j`` of pixel ``i`` unless its weight is 0; return how many that makes."""
    if wp.max(weight) <= 0.0:
        return 0
    record.wi[i, j] = wi
    record.weight[i, j] = weight
    return 1


@wp.kernel
def radiance_gradient(d_pixel: wp.array[wp.mat33], record: LightRecord):
    """Turn each weight into the loss gradient of the radiance from there; a thread a pixel.

    Args:
        d_pixel: What a weight is multiplied by, shape [pixel].
        record: Directions and weights, rows are pixels; overwritten.
    """
    i = wp.tid()
    d = d_pixel[i]
    for j in range(record.count[i]):
        record.weight[i, j] = d * record.weight[i, j]


@wp.kernel
def map_gradient(
    record: LightRecord,
    map_height: int,
    map_width: int,
    d_texels: wp.array2d[wp.vec3],
):
    """Add each entry's gradient to the four texels that its direction reads; a thread a pixel.

    Args:
        record: Directions, and what `radiance_gradient` left; rows are pixels.
        map_height: He.
        map_width: We.
        d_texels: Output, shape [He, We].
    """
    i = wp.tid()
    for j in range(record.count[i]):
        d_L = record.weight[i, j]
        tap = bilinear_tap(direction_to_uv(record.wi[i, j]), map_height, map_width)
        top = d_L * (1.0 - tap.wi)
        bottom = d_L * tap.wi
        wp.atomic_add(d_texels, tap.i0, tap.j0, top * (1.0 - tap.wj))
        wp.atomic_add(d_texels, tap.i0, tap.j1, top * tap.wj)
        wp.atomic_add(d_texels, tap.i1, tap.j0, bottom * (1.0 - tap.wj))
        wp.atomic_add(d_texels, tap.i1, tap.j1, bottom * tap.wj)
