"""Shadow ratio of the ground plane, apart from the sums it divides (Warp does not replay loops)."""

import warp as wp

DARK = wp.constant(1.0e-30)
"""Radiance that counts as none. Less is what underflow leaves of a lobe's tail: the ratio of such
numbers is noise, and its slope ``1 / denominator`` leaves float32."""


@wp.func
def safe_ratio(numerator: float, denominator: float) -> float:
    """Return the ratio, or 1 where the plane receives no light at all."""
    # NaN where the plane's light is not finite: a comparison would hide it.
    ratio = 1.0 + 0.0 * denominator
    if denominator > DARK:
        ratio = numerator / denominator
    return ratio


@wp.kernel
def shadow_ratio(lit: wp.array[wp.vec3], unoccluded: wp.array[wp.vec3], ratio: wp.array[wp.vec3]):
    """``beta = lit / unoccluded`` per channel (DiPIR, eq. 5), shape [receiver_pixel] each."""
    i = wp.tid()
    a = lit[i]
    b = unoccluded[i]
    ratio[i] = wp.vec3(safe_ratio(a[0], b[0]), safe_ratio(a[1], b[1]), safe_ratio(a[2], b[2]))
