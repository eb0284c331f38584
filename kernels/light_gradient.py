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
def map_gradient(
    d_pixel: wp.array[wp.mat33],
    lanes: int,
    record: LightRecord,
    map_height: int,
    map_width: int,
    d_texels: wp.array3d[wp.vec3],
):
    """Add each entry's gradient to the four texels that its direction reads; a thread a row.

    Neighbouring threads add to different copies of the map: most of their directions may go to the
    few texels of a sun, where one addition waits for the other.

    Args:
        d_pixel: Times a weight it is the loss gradient of the radiance from there, shape [pixel].
        lanes: Rows of a pixel.
        record: Directions and weights, rows are pixels or lanes of them.
        map_height: He.
        map_width: We.
        d_texels: Output, to be added up over its copies, shape [copy, He, We].
    """
    i = wp.tid()
    copy = i % d_texels.shape[0]
    d = d_pixel[i // lanes]
    for j in range(record.count[i]):
        d_L = d * record.weight[i, j]
        tap = bilinear_tap(direction_to_uv(record.wi[i, j]), map_height, map_width)
        top = d_L * (1.0 - tap.wi)
        bottom = d_L * tap.wi
        wp.atomic_add(d_texels, copy, tap.i0, tap.j0, top * (1.0 - tap.wj))
        wp.atomic_add(d_texels, copy, tap.i0, tap.j1, top * tap.wj)
        wp.atomic_add(d_texels, copy, tap.i1, tap.j0, bottom * (1.0 - tap.wj))
        wp.atomic_add(d_texels, copy, tap.i1, tap.j1, bottom * tap.wj)
