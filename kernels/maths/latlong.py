"""Lat-long environment maps: direction to texture coordinates and back, bilinear lookup.

OpenEXR orientation (``ImfEnvmap.h``): image centre = +Z, left quarter = +X. Texel (i, j) has its
centre at ``u = (j + 0.5) / We``, ``v = (i + 0.5) / He``; longitude wraps, latitude is clamped.
"""

import warp as wp


@wp.func
def arc_tangent(y: float, x: float) -> float:
    """Return the angle of (x, y) in [-pi, pi], to 2 ulp.

    A minimax polynomial takes a third of the time of the C library's ``atan2f``, which was an
    eighth of the time of a shadow ratio on the CPU.
    """
    long = wp.max(wp.abs(x), wp.abs(y))
    r = wp.min(wp.abs(x), wp.abs(y)) / wp.max(long, 1.0e-30)
    s = r * r
    p = 0.04303929954767227 + s * (-0.01628296636044979 + s * 0.0029035420157015324)
    p = -0.14207133650779724 + s * (0.10654674470424652 + s * (-0.07533670216798782 + s * p))
    a = r + r * s * (-0.3333309292793274 + s * (0.19993053376674652 + s * p))
    if wp.abs(y) > wp.abs(x):
        a = 0.5 * wp.PI - a
    if x < 0.0:
        a = wp.PI - a
    if y < 0.0:
        a = -a
    return a


@wp.func
def direction_to_uv(d: wp.vec3) -> wp.vec2:
    """Map a unit direction, world frame, to (u, v) in [0, 1)^2."""
    u = 0.5 - arc_tangent(d[0], d[2]) * (0.5 / wp.PI)
    # acos(y) loses all digits near the poles; atan2 of the horizontal part does not.
    v = arc_tangent(wp.sqrt(d[0] * d[0] + d[2] * d[2]), d[1]) * (1.0 / wp.PI)
    if u >= 1.0:
        u = u - 1.0
    return wp.vec2(u, v)


@wp.func
def uv_to_direction(u: float, v: float) -> wp.vec3:
    """Map (u, v) to a unit direction, world frame."""
    lon = wp.PI * (1.0 - 2.0 * u)
    theta = wp.PI * v
    s = wp.sin(theta)
    return wp.vec3(wp.sin(lon) * s, wp.cos(theta), wp.cos(lon) * s)


@wp.struct
class BilinearTap:
    """The four texels around a direction and their weights."""

    i0: int
    i1: int
    j0: int
    j1: int
    wi: float
    """Weight of row ``i1``."""
    wj: float
    """Weight of column ``j1``."""


@wp.func
def bilinear_tap(uv: wp.vec2, height: int, width: int) -> BilinearTap:
    """Find the texels and weights that every lookup of a map uses."""
    x = uv[0] * float(width) - 0.5
    y = uv[1] * float(height) - 0.5
    xf = wp.floor(x)
    yf = wp.floor(y)
    j = int(xf)
    i = int(yf)
    tap = BilinearTap()
    tap.wj = x - xf
    tap.wi = y - yf
    j0 = j
    if j0 < 0:
        j0 = j0 + width
    j1 = j + 1
    if j1 >= width:
        j1 = j1 - width
    tap.j0 = wp.clamp(j0, 0, width - 1)
    tap.j1 = wp.clamp(j1, 0, width - 1)
    tap.i0 = wp.clamp(i, 0, height - 1)
    tap.i1 = wp.clamp(i + 1, 0, height - 1)
    return tap


@wp.func
def map_radiance(texels: wp.array2d[wp.vec3], tap: BilinearTap) -> wp.vec3:
    """Interpolate radiance at ``tap``; differentiable in ``texels``."""
    top = texels[tap.i0, tap.j0] * (1.0 - tap.wj) + texels[tap.i0, tap.j1] * tap.wj
    bottom = texels[tap.i1, tap.j0] * (1.0 - tap.wj) + texels[tap.i1, tap.j1] * tap.wj
    return top * (1.0 - tap.wi) + bottom * tap.wi


@wp.func
def map_scalar(values: wp.array2d[float], tap: BilinearTap) -> float:
    """Interpolate a scalar map at ``tap``."""
    top = values[tap.i0, tap.j0] * (1.0 - tap.wj) + values[tap.i0, tap.j1] * tap.wj
    bottom = values[tap.i1, tap.j0] * (1.0 - tap.wj) + values[tap.i1, tap.j1] * tap.wj
    return top * (1.0 - tap.wi) + bottom * tap.wi
