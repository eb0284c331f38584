"""Samplers and their densities per solid angle; the power heuristic; the light's proposal."""

import warp as wp

from warpir.kernels.maths.frame import basis, to_world
from warpir.kernels.maths.latlong import (
    bilinear_tap,
    direction_to_uv,
    map_radiance,
    map_scalar,
    uv_to_direction,
)
from warpir.kernels.maths.rng import hash_pair, pixel_seed, to_unit
from warpir.kernels.maths.sg import sg_shape
from warpir.kernels.types import DrawnLight, LightArgs


@wp.func
def power_heuristic(pdf: float, pdf_other: float) -> float:
    """MIS weight of the technique with density ``pdf``; equal counts (Veach 1997, eq. 9.13)."""
    # The ratio form neither overflows nor loses the small density when one is huge.
    if pdf <= 0.0:
        return 0.0
    r = pdf_other / pdf
    return 1.0 / (1.0 + r * r)


@wp.func
def cosine_sample(u: wp.vec2) -> wp.vec3:
    """Draw a direction with density ``cos / pi`` around local z."""
    r = wp.sqrt(u[0])
    phi = 2.0 * wp.PI * u[1]
    return wp.vec3(r * wp.cos(phi), r * wp.sin(phi), wp.sqrt(wp.max(1.0 - u[0], 0.0)))


@wp.func
def one_minus_exp(x: float) -> float:
    """Return ``1 - exp(-x)`` for x >= 0 without cancellation at small x."""
    if x < 1.0e-2:
        return x * (1.0 - x * (0.5 - x * (1.0 / 6.0 - x / 24.0)))
    return 1.0 - wp.exp(-x)


@wp.func
def minus_log_one_minus(x: float) -> float:
    """Return ``-log(1 - x)`` for 0 <= x < 1 without cancellation at small x."""
    if x < 1.0e-2:
        return x * (1.0 + x * (0.5 + x * (1.0 / 3.0 + x * 0.25)))
    return -wp.log(1.0 - x)


@wp.func
def lobe_sample(u: wp.vec2, axis: wp.vec3, sharpness: float) -> wp.vec3:
    """Draw a direction from one spherical Gaussian, exactly, at any sharpness.

    Inverts the CDF of ``t = 1 - cos``: ``t = -log(1 - u (1 - exp(-2 s))) / s`` (a von Mises-Fisher
    distribution; Jakob 2012, "Numerically stable sampling of the von Mises-Fisher distribution").
    """
    t = minus_log_one_minus(u[0] * one_minus_exp(2.0 * sharpness)) / sharpness
    t = wp.clamp(t, 0.0, 2.0)
    s = wp.sqrt(t * (2.0 - t))
    phi = 2.0 * wp.PI * u[1]
    local = wp.vec3(s * wp.cos(phi), s * wp.sin(phi), 1.0 - t)
    return wp.normalize(to_world(local, basis(axis)))


@wp.struct
class LightValue:
    """What the light sends along one direction, and how likely the proposal draws it."""

    radiance: wp.vec3
    pdf: float


@wp.func
def light_eval(light: LightArgs, wi: wp.vec3) -> LightValue:
    """Evaluate radiance and proposal density together, since they share every exponential."""
    value = LightValue()
    L = wp.vec3(0.0)
    pdf = float(0.0)
    for k in range(light.lobe_count):
        g = sg_shape(wi, light.axis[k], light.sharpness[k])
        L += light.amplitude[k] * g
        pdf += light.lobe_prob[k] * light.lobe_pdf_peak[k] * g
    if light.map_height > 0:
        tap = bilinear_tap(direction_to_uv(wi), light.map_height, light.map_width)
        L += map_radiance(light.texels, tap)
        if light.map_prob > 0.0:
            # The sampler works in (u, v): d_omega = 2 pi^2 sin(theta) du dv.
            s = wp.max(wp.sqrt(wi[0] * wi[0] + wi[2] * wi[2]), 1.0e-7)
            density = map_scalar(light.texel_prob, tap) * float(light.map_height * light.map_width)
            pdf += density / (2.0 * wp.PI * wp.PI * s)
    value.radiance = L
    value.pdf = pdf
    return value


@wp.func
def tent(u: float) -> float:
    """Map a uniform number to the tent density ``1 - |x|`` on [-1, 1]."""
    if u < 0.5:
        return wp.sqrt(2.0 * u) - 1.0
    return 1.0 - wp.sqrt(wp.max(2.0 - 2.0 * u, 0.0))


@wp.func
def row_search(cdf: wp.array2d[float], row: int, count: int, u: float) -> int:
    """Return the largest j < count with ``cdf[row, j] <= u``."""
    low = int(0)
    high = int(count)
    while high - low > 1:
        middle = (low + high) // 2
        if cdf[row, middle] <= u:
            low = middle
        else:
            high = middle
    return low


@wp.func
def left_over(cdf: wp.array2d[float], row: int, j: int, u: float) -> float:
    """Return what is left of ``u`` within cell ``j``; it is uniform again."""
    width = wp.max(cdf[row, j + 1] - cdf[row, j], 1.0e-30)
    return wp.clamp((u - cdf[row, j]) / width, 0.0, 0.99999994)


@wp.func
def map_sample(light: LightArgs, part: int, u: wp.vec2) -> wp.vec3:
    """Draw a direction from the map in proportion to its *bilinear* luminance times solid angle.

    A texel is drawn from the table, then a point from its tent: the sum of tents is the bilinear
    interpolant, so the neighbours of a sun that interpolation brightens are drawn as often as they
    shine, and no firefly remains. ``part`` is 1 for the bright texels, 0 for the others.
    """
    i = row_search(light.row_cdf, part, light.map_height, u[1])
    row = part * light.map_height + i
    j = row_search(light.column_cdf, row, light.map_width, u[0])
    x = (float(j) + 0.5 + tent(left_over(light.column_cdf, row, j, u[0]))) / float(light.map_width)
    y = (float(i) + 0.5 + tent(left_over(light.row_cdf, part, i, u[1]))) / float(light.map_height)
    x = x - wp.floor(x)
    # Folding at the poles is what clamping the lookup means: the two halves add up to weight 1.
    if y < 0.0:
        y = -y
    if y > 1.0:
        y = 2.0 - y
    return uv_to_direction(x, y)


@wp.func
def proposal_sample(light: LightArgs, u: wp.vec2) -> wp.vec3:
    """Draw a direction from the light's proposal; its density is `light_eval`'s.

    The first number picks part of the map or a lobe; what is left of it is uniform again.
    """
    first = u[0]
    if first < light.bright_prob:
        return map_sample(light, 1, wp.vec2(first / light.bright_prob, u[1]))
    first -= light.bright_prob
    others = light.map_prob - light.bright_prob
    if first < others or light.lobe_count == 0:
        within = wp.clamp(first / wp.max(others, 1.0e-30), 0.0, 0.99999994)
        return map_sample(light, 0, wp.vec2(within, u[1]))
    first -= others
    pick = int(0)
    while pick < light.lobe_count - 1 and first >= light.lobe_prob[pick]:
        first -= light.lobe_prob[pick]
        pick += 1
    within = wp.clamp(first / wp.max(light.lobe_prob[pick], 1.0e-30), 0.0, 0.99999994)
    return lobe_sample(wp.vec2(within, u[1]), light.axis[pick], light.sharpness[pick])


@wp.func
def light_sample(light: LightArgs, u: wp.vec2) -> DrawnLight:
    """Return one of the directions that `draw_light` left, that of the cell around ``u``."""
    at = light_cell(light, u)
    return light.drawn[at[0], at[1]]


@wp.func
def light_cell(light: LightArgs, u: wp.vec2) -> wp.vec2i:
    """Return row and column of the cell around ``u`` among what `draw_light` left."""
    cells = light.drawn.shape[0]
    i = wp.min(int(u[1] * float(cells)), cells - 1)
    j = wp.min(int(u[0] * float(cells)), cells - 1)
    return wp.vec2i(i, j)


_FETCH = """
#if !defined(__CUDA_ARCH__)
__builtin_prefetch(drawn.data + row * drawn.shape[1] + column);
#endif
"""


@wp.func_native(_FETCH)
def fetch(drawn: wp.array2d[DrawnLight], row: int, column: int):
    """Bring an entry into the CPU's cache ahead of its use; CUDA's threads wait side by side."""
    ...


@wp.kernel(enable_backward=False)
def draw_light(
    cell: wp.array[int],
    light: LightArgs,
    seed: int,
    side: int,
    drawn: wp.array[DrawnLight],
):
    """Draw a direction in each of ``side`` x ``side`` strata of the unit square; a thread a cell.

    All pixels of a launch share them, each in an order of its own: they are drawn and looked up
    once and not for each sample.

    Args:
        cell: Row-major strata, shape [cell].
        light: The light.
        seed: Base seed.
        side: Strata along each axis.
        drawn: Output, shape [cell].
    """
    i = wp.tid()
    key = pixel_seed(seed, cell[i])
    x = float(cell[i] % side) + to_unit(hash_pair(key, wp.uint32(0)))
    y = float(cell[i] // side) + to_unit(hash_pair(key, wp.uint32(1)))
    u = wp.vec2(wp.min(x / float(side), 0.99999994), wp.min(y / float(side), 0.99999994))
    out = DrawnLight()
    out.wi = proposal_sample(light, u)
    value = light_eval(light, out.wi)
    out.radiance = value.radiance
    out.pdf = value.pdf
    drawn[i] = out


@wp.kernel(enable_backward=False)
def sum_plane(drawn: wp.array2d[DrawnLight], normal: wp.vec3, sums: wp.array[wp.vec3d]):
    """Sum what each row of drawn directions says of the radiance of an open white plane.

    Args:
        drawn: From `draw_light`, shape [side, side].
        normal: Unit normal of the plane.
        sums: Output: ``sum(L cos / (pi pdf))``, shape [side].
    """
    i = wp.tid()
    total = wp.vec3d()
    for j in range(drawn.shape[1]):
        sample = drawn[i, j]
        # A NaN counts, and is seen.
        if sample.pdf != 0.0:
            cosine = wp.max(wp.dot(sample.wi, normal), 0.0)
            arriving = sample.radiance * (cosine / (wp.PI * sample.pdf))
            total += wp.vec3d(arriving)
    sums[i] = total
