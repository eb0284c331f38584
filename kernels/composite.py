"""Tone, composite and encode: ``I = (1 - V) beta' I_bg + V I'_fg`` in linear RGB (DiPIR, eq. 6)."""

import warp as wp

from warpir.kernels.tone import ratio_curve, reinhard, tone_curve

ENCODE_KNEE = wp.constant(1.0e-6)
"""Below this the power's slope explodes; there the encoding is linear (half a code of 8 bits)."""


@wp.func
def encode(x: float) -> float:
    """Linear value to display value, ``x^(1/2.2)`` (DiPIR supplement B)."""
    y = float(0.0)
    if x > ENCODE_KNEE:
        y = wp.pow(x, 1.0 / 2.2)
    elif x > 0.0:
        y = x * (wp.pow(ENCODE_KNEE, 1.0 / 2.2) / ENCODE_KNEE)
    return wp.min(y, 1.0)


@wp.func
def unhidden(value: wp.vec3, source: wp.vec3) -> wp.vec3:
    """Return the value, but NaN where its source is not finite.

    Maxima, clamps and branches turn a NaN into an ordinary number, and then nobody learns of it.
    """
    return value + source * 0.0


@wp.kernel
def tone_foreground(
    foreground: wp.array[wp.vec3],
    mask: wp.array[float],
    is_reinhard: int,
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    display: wp.array[wp.vec3],
):
    """Object radiance, premultiplied, to display-linear values in [0, 1], not premultiplied.

    Curves are not linear, so coverage is divided out first; one curve serves all channels. There
    may be equal copies of it, which share the threads: gradients are added up one by one, and one
    curve would make all threads wait for each other.
    """
    i = wp.tid()
    curve = i % knot_x.shape[0]
    if mask[i] <= 0.0:
        display[i] = wp.vec3(0.0)
        return
    x = foreground[i] / mask[i]
    r = x[0]
    g = x[1]
    b = x[2]
    if is_reinhard == 1:
        r = reinhard(r)
        g = reinhard(g)
        b = reinhard(b)
    shown = wp.vec3(
        tone_curve(r, curve, knot_x, knot_y, knot_slope, bin_count),
        tone_curve(g, curve, knot_x, knot_y, knot_slope, bin_count),
        tone_curve(b, curve, knot_x, knot_y, knot_slope, bin_count),
    )
    display[i] = unhidden(shown, x)


@wp.kernel
def tone_shadow(
    ratio: wp.array[wp.vec3],
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    display: wp.array[wp.vec3],
):
    """Shadow ratio through one curve per channel; 1 stays 1. Copies are as in the foreground."""
    i = wp.tid()
    curve = 3 * (i % (knot_x.shape[0] // 3))
    x = ratio[i]
    shown = wp.vec3(
        ratio_curve(x[0], curve, knot_x, knot_y, knot_slope, bin_count),
        ratio_curve(x[1], curve + 1, knot_x, knot_y, knot_slope, bin_count),
        ratio_curve(x[2], curve + 2, knot_x, knot_y, knot_slope, bin_count),
    )
    display[i] = unhidden(shown, x)


@wp.kernel
def compose(
    photo_lin: wp.array[wp.vec3],
    object_index: wp.array[int],
    receiver_index: wp.array[int],
    mask: wp.array[float],
    foreground_display: wp.array[wp.vec3],
    ratio_display: wp.array[wp.vec3],
    image: wp.array[wp.vec3],
):
    """Put the object over the shaded photo and encode, one thread a pixel.

    Args:
        photo_lin: Linear photo, shape [pixel].
        object_index: Row of the object's arrays or -1, shape [pixel].
        receiver_index: Row of the plane's arrays or -1, shape [pixel].
        mask: Coverage, shape [object_pixel].
        foreground_display: Tone-mapped object, not premultiplied, shape [object_pixel].
        ratio_display: Tone-mapped shadow ratio, shape [receiver_pixel].
        image: Output, display-encoded, shape [pixel].
    """
    i = wp.tid()
    x = photo_lin[i]
    p = receiver_index[i]
    if p >= 0:
        x = wp.cw_mul(x, ratio_display[p])
    o = object_index[i]
    if o >= 0:
        x = x * (1.0 - mask[o]) + foreground_display[o] * mask[o]
    image[i] = unhidden(wp.vec3(encode(x[0]), encode(x[1]), encode(x[2])), x)
