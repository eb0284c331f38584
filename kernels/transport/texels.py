"""Texels of a lat-long map as columns of the transport: the tent of each, and draws from it.

A texel stands for the tent of bilinear interpolation around it (`bilinear_tap`). Directions are
drawn from that tent, evenly in solid angle, and belong to that texel alone: spread over the four
texels around it, a direction would let a sun in one texel flicker by its interpolation weight.
"""

import warp as wp

from warpir.kernels.maths.latlong import BilinearTap, uv_to_direction
from warpir.kernels.maths.rng import hash_pair, hash_uint, sobol_pair, to_unit
from warpir.kernels.sampling import tent

TRIES_MAX = wp.constant(32)
"""Draws until one is accepted; a texel at the horizon accepts about every third."""
TENT_REACH = wp.constant(1.5)
"""No direction of a tent is farther than this many texel heights from the texel's centre."""
GOLDEN_ROW = wp.constant(0.5698402909980532)
GOLDEN_COLUMN = wp.constant(0.7548776662466927)
"""Steps of the R2 sequence (Roberts 2018): neighbouring texels use different points of a pixel."""


@wp.struct
class TexelArgs:
    """The map whose texels are the columns of the transport."""

    height: int
    width: int
    d_omega: wp.array[float]
    """Solid angle of a texel's tent in each row [sr], shape [He]."""
    direction_count: wp.array[int]
    """Directions drawn for each texel, shape [He * We]."""
    centre: wp.array[wp.vec3]
    """Direction of each texel's centre, shape [He * We]."""
    bound: wp.array[float]
    """Largest sine of the polar angle within each texel's tent; of the plane, times the largest
    cosine with its normal. Shape [He * We]."""
    item_column: wp.array[int]
    """Columns of the rows cut into pieces of work of `item_size` directions; shape [item]."""
    item_first: wp.array[int]
    """First direction of each piece, shape [item]."""
    item_count: int
    item_size: int
    lanes: int
    """Threads of a pixel; each takes every ``lanes``-th piece. A thread costs as much as a texel on
    the CPU, where one per pixel is best."""


@wp.func
def random_pair(key: wp.uint32, draw: int) -> wp.vec2:
    """Return draw number ``draw`` of an independent sequence, in [0, 1)^2."""
    a = hash_pair(key, wp.uint32(draw))
    return wp.vec2(to_unit(a), to_unit(hash_uint(a)))


@wp.func
def point_of(i: int, j: int, shift: float, count: int) -> int:
    """Return with which of a pixel's ``count`` points the directions of texel (i, j) begin."""
    spot = shift + GOLDEN_ROW * float(i) + GOLDEN_COLUMN * float(j)
    spot = spot - wp.floor(spot)
    return wp.min(int(spot * float(count)), count - 1)


@wp.func
def tent_uv(i: int, j: int, height: int, width: int, u: wp.vec2) -> wp.vec2:
    """Draw texture coordinates from the tent of texel (i, j), folded at the poles."""
    x = (float(j) + 0.5 + tent(u[0])) / float(width)
    y = (float(i) + 0.5 + tent(u[1])) / float(height)
    x = x - wp.floor(x)
    # Clamping the lookup beyond a pole is the same as folding the tent back.
    if y < 0.0:
        y = -y
    if y > 1.0:
        y = 2.0 - y
    return wp.vec2(x, y)


@wp.func
def tent_direction(
    texels: TexelArgs, i: int, j: int, r: int, key: wp.uint32, weigh: int, normal: wp.vec3
) -> wp.vec3:
    """Draw direction ``r`` from texel (i, j)'s tent, evenly in solid angle; ``key`` is the texel's.

    The density is ``weight / d_omega`` [1/sr]; with ``weigh`` 1 it also follows the cosine with
    ``normal``. The first tries of several directions are stratified, which survives where they are
    accepted.
    """
    t = i * texels.width + j
    bound = texels.bound[t]
    u = random_pair(key, -1)
    if texels.direction_count[t] > 1:
        u = sobol_pair(r, key, 0)
    ray_key = hash_pair(key, wp.uint32(r))
    uv = tent_uv(i, j, texels.height, texels.width, u)
    wi = uv_to_direction(uv[0], uv[1])
    for draw in range(TRIES_MAX):
        share = wp.sqrt(wi[0] * wi[0] + wi[2] * wi[2])
        if weigh == 1:
            share = share * wp.dot(wi, normal)
        if random_pair(ray_key, 2 * draw)[0] * bound <= share:
            break
        uv = tent_uv(i, j, texels.height, texels.width, random_pair(ray_key, 2 * draw + 1))
        wi = uv_to_direction(uv[0], uv[1])
    return wi


@wp.func
def tent_weight(tap: BilinearTap, i: int, j: int) -> float:
    """Return the interpolation weight of texel (i, j) at ``tap``."""
    weight = float(0.0)
    if tap.j0 == j:
        weight += 1.0 - tap.wj
    if tap.j1 == j:
        weight += tap.wj
    across = float(0.0)
    if tap.i0 == i:
        across += 1.0 - tap.wi
    if tap.i1 == i:
        across += tap.wi
    return weight * across


@wp.func
def texel_pdf(texels: TexelArgs, tap: BilinearTap, i: int, j: int) -> float:
    """Return the expected density of all directions drawn for texel (i, j) at ``tap`` [1/sr]."""
    count = float(texels.direction_count[i * texels.width + j])
    return count * tent_weight(tap, i, j) / texels.d_omega[i]
