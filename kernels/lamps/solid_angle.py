"""Lamps as a point sees them: solid angle, directions drawn from it, where a ray meets a lamp.

A sphere is sampled evenly within its cone, and over all directions from inside. A rectangle is
sampled evenly over its solid angle (Urena et al. 2013, "An Area-Preserving Parametrization for
Spherical Rectangles"), and evenly over its area where that angle is so small that float32 cannot
tell it. A lamp is picked in proportion to its luminance times its solid angle. Detached.
"""

import warp as wp

from warpir.kernels.maths.frame import basis, to_world
from warpir.kernels.types import LampArgs

wp.set_module_options({"enable_backward": False})

SMALL_ANGLE = wp.constant(0.03)
"""Solid angle of a rectangle up to which its area is sampled [sr]; 4 angles of float32 err by
10^-6."""


@wp.struct
class Rectangle:
    """A rectangle in a frame of its own, seen from the origin; it lies in the plane ``z = z0``."""

    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    """Negative; 0 where the origin is behind the rectangle, which does not shine there."""
    area: float
    b0: float
    b1: float
    k: float
    """Constants of the parametrization, as its listing calls them."""
    solid_angle: float


@wp.func
def corner_angle(ax: float, az: float, bx: float, bz: float) -> float:
    """Return the angle of the spherical rectangle between the planes (0, ax, az), (bx, 0, bz)."""
    # By atan2: near 0 and pi the cosine has lost its digits.
    cross = wp.vec3(ax * bz, az * bx, -ax * bx)
    return wp.atan2(wp.length(cross), -az * bz)


@wp.func
def rectangle_seen(lamps: LampArgs, k: int, p: wp.vec3) -> Rectangle:
    """Return lamp ``k``, a rectangle, as ``p`` sees it."""
    q = Rectangle()
    width = wp.length(lamps.edge_x[k])
    height = wp.length(lamps.edge_y[k])
    q.area = width * height
    q.x = lamps.edge_x[k] / width
    q.y = lamps.edge_y[k] / height
    q.z = wp.cross(q.x, q.y)
    d = lamps.center[k] - p
    q.z0 = wp.dot(d, q.z)
    q.x0 = wp.dot(d, q.x)
    q.y0 = wp.dot(d, q.y)
    q.x1 = q.x0 + width
    q.y1 = q.y0 + height
    q.solid_angle = 0.0
    if q.z0 >= 0.0:
        q.z0 = 0.0
        return q
    g0 = corner_angle(q.z0, -q.y0, -q.z0, q.x1)
    g1 = corner_angle(-q.z0, q.y1, -q.z0, q.x1)
    g2 = corner_angle(-q.z0, q.y1, q.z0, -q.x0)
    g3 = corner_angle(q.z0, -q.y0, q.z0, -q.x0)
    q.b0 = -q.y0 / wp.sqrt(q.z0 * q.z0 + q.y0 * q.y0)
    q.b1 = q.y1 / wp.sqrt(q.z0 * q.z0 + q.y1 * q.y1)
    q.k = 2.0 * wp.PI - g2 - g3
    q.solid_angle = g0 + g1 - q.k
    if q.solid_angle < SMALL_ANGLE:
        # Of the middle: what is drawn over the area needs a share that is not 0, no more.
        middle = wp.vec3(0.5 * (q.x0 + q.x1), 0.5 * (q.y0 + q.y1), q.z0)
        away = wp.length(middle)
        q.solid_angle = wp.min(q.area * -q.z0 / (away * away * away), SMALL_ANGLE)
        q.k = -1.0
    return q


@wp.func
def one_minus_cosine(lamps: LampArgs, k: int, p: wp.vec3) -> float:
    """Return 1 - cos of half the cone around lamp ``k``, a sphere; 2 from inside."""
    v = lamps.center[k] - p
    square = wp.dot(v, v)
    r = lamps.radius[k]
    if square <= r * r:
        return 2.0
    sine_squared = r * r / square
    return sine_squared / (1.0 + wp.sqrt(1.0 - sine_squared))


@wp.func
def pick_weight(lamps: LampArgs, k: int, p: wp.vec3) -> float:
    """Return luminance times solid angle of lamp ``k`` as seen from ``p``."""
    if lamps.is_rectangle[k] == 1:
        return lamps.brightness[k] * rectangle_seen(lamps, k, p).solid_angle
    return lamps.brightness[k] * 2.0 * wp.PI * one_minus_cosine(lamps, k, p)


@wp.func
def pick_total(lamps: LampArgs, p: wp.vec3) -> float:
    """Return the sum of `pick_weight` over all lamps."""
    total = float(0.0)
    for k in range(lamps.count):
        total += pick_weight(lamps, k, p)
    return total


@wp.struct
class LampPoint:
    """A point of a lamp as it is seen from another."""

    valid: int
    wi: wp.vec3
    """Toward it."""
    distance: float
    """To it [m]."""
    pdf: float
    """Density of the lamp's own sampler there [1/sr]."""


@wp.func
def sphere_point(lamps: LampArgs, k: int, p: wp.vec3, u: wp.vec2) -> LampPoint:
    """Draw a direction from lamp ``k``, a sphere."""
    out = LampPoint()
    spread = one_minus_cosine(lamps, k, p)
    v = lamps.center[k] - p
    t = u[0] * spread
    sine = wp.sqrt(wp.max(t * (2.0 - t), 0.0))
    phi = 2.0 * wp.PI * u[1]
    local = wp.vec3(sine * wp.cos(phi), sine * wp.sin(phi), 1.0 - t)
    away = wp.length(v)
    axis = wp.vec3(0.0, 0.0, 1.0)
    if away > 0.0:
        axis = v / away
    out.wi = wp.normalize(to_world(local, basis(axis)))
    b = away * (1.0 - t)
    half = wp.sqrt(wp.max(lamps.radius[k] * lamps.radius[k] - away * sine * away * sine, 0.0))
    out.distance = wp.where(spread == 2.0, b + half, wp.max(b - half, 0.0))
    out.pdf = 1.0 / (2.0 * wp.PI * spread)
    out.valid = 1
    return out


@wp.func
def rectangle_pdf(q: Rectangle, distance: float) -> float:
    """Return the density of a rectangle's own sampler at a point so far away [1/sr]."""
    if q.k < 0.0:
        return distance * distance * distance / (q.area * -q.z0)
    return 1.0 / q.solid_angle


@wp.func
def rectangle_point(lamps: LampArgs, k: int, p: wp.vec3, u: wp.vec2) -> LampPoint:
    """Draw a direction from lamp ``k``, a rectangle (Urena et al. 2013, listing 2)."""
    out = LampPoint()
    out.valid = 0
    q = rectangle_seen(lamps, k, p)
    if q.z0 == 0.0:
        return out
    x = wp.lerp(q.x0, q.x1, u[0])
    y = wp.lerp(q.y0, q.y1, u[1])
    if q.k >= 0.0:
        angle = u[0] * q.solid_angle + q.k
        f = (wp.cos(angle) * q.b0 - q.b1) / wp.sin(angle)
        c = wp.clamp(wp.sign(f) / wp.sqrt(f * f + q.b0 * q.b0), -0.9999999, 0.9999999)
        x = wp.clamp(-(c * q.z0) / wp.sqrt(1.0 - c * c), q.x0, q.x1)
        d = x * x + q.z0 * q.z0
        h0 = q.y0 / wp.sqrt(d + q.y0 * q.y0)
        h1 = q.y1 / wp.sqrt(d + q.y1 * q.y1)
        h = wp.lerp(h0, h1, u[1])
        y = q.y1
        if h * h < 0.999999:
            y = wp.clamp(h * wp.sqrt(d / (1.0 - h * h)), q.y0, q.y1)
    toward = q.x * x + q.y * y + q.z * q.z0
    out.distance = wp.length(toward)
    out.wi = toward / out.distance
    out.pdf = rectangle_pdf(q, out.distance)
    out.valid = 1
    return out


@wp.func
def lamp_point(lamps: LampArgs, k: int, p: wp.vec3, u: wp.vec2) -> LampPoint:
    """Draw a direction from lamp ``k``; not valid where it does not shine on ``p``."""
    if lamps.is_rectangle[k] == 1:
        return rectangle_point(lamps, k, p, u)
    return sphere_point(lamps, k, p, u)


@wp.func
def lamp_along(lamps: LampArgs, k: int, p: wp.vec3, wi: wp.vec3) -> LampPoint:
    """Return where a ray from ``p`` meets lamp ``k`` from the side that shines."""
    out = LampPoint()
    out.valid = 0
    out.wi = wi
    v = lamps.center[k] - p
    if lamps.is_rectangle[k] == 1:
        q = rectangle_seen(lamps, k, p)
        slope = wp.dot(wi, q.z)
        if q.z0 < 0.0 and slope < 0.0:
            out.distance = q.z0 / slope
            x = out.distance * wp.dot(wi, q.x)
            y = out.distance * wp.dot(wi, q.y)
            if x >= q.x0 and x <= q.x1 and y >= q.y0 and y <= q.y1:
                out.pdf = rectangle_pdf(q, out.distance)
                out.valid = 1
        return out
    b = wp.dot(v, wi)
    beside = v - wi * b
    r = lamps.radius[k]
    rest = r * r - wp.dot(beside, beside)
    spread = one_minus_cosine(lamps, k, p)
    if rest >= 0.0 and (b > 0.0 or spread == 2.0):
        half = wp.sqrt(rest)
        out.distance = wp.where(spread == 2.0, b + half, wp.max(b - half, 0.0))
        out.pdf = 1.0 / (2.0 * wp.PI * spread)
        out.valid = 1
    return out


@wp.struct
class LampSample:
    """A direction drawn from one of the lamps."""

    valid: int
    wi: wp.vec3
    distance: float
    """How far the lamp is along it [m]."""
    radiance: wp.vec3
    pdf: float
    """Density, that of the pick included [1/sr]."""


@wp.func
def lamps_sample(
    lamps: LampArgs, p: wp.vec3, total: float, u: wp.vec2, u_pick: float
) -> LampSample:
    """Pick a lamp and draw a direction from it; ``total`` is `pick_total` of ``p``."""
    out = LampSample()
    out.valid = 0
    if total <= 0.0:
        return out
    rest = u_pick * total
    pick = int(-1)
    weight = float(0.0)
    for k in range(lamps.count):
        own = pick_weight(lamps, k, p)
        if own > 0.0 and (pick < 0 or rest >= 0.0):
            pick = k
            weight = own
        rest -= own
    point = lamp_point(lamps, pick, p, u)
    if point.valid == 1:
        out.valid = 1
        out.wi = point.wi
        out.distance = point.distance
        out.radiance = lamps.radiance[pick]
        out.pdf = point.pdf * (weight / total)
    return out
