"""Orthonormal frames: local coordinates have the normal as z."""

import warp as wp


@wp.struct
class Frame:
    """A right-handed orthonormal basis."""

    x: wp.vec3
    y: wp.vec3
    z: wp.vec3


@wp.func
def basis(n: wp.vec3) -> Frame:
    """Build a frame around the unit vector ``n`` without branches on its direction.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited", listing 3.
    """
    sign = float(1.0)
    if n[2] < 0.0:
        sign = -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    frame = Frame()
    frame.x = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    frame.y = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    frame.z = n
    return frame


@wp.func
def to_local(v: wp.vec3, frame: Frame) -> wp.vec3:
    """Express the world vector ``v`` in ``frame``."""
    return wp.vec3(wp.dot(v, frame.x), wp.dot(v, frame.y), wp.dot(v, frame.z))


@wp.func
def to_world(v: wp.vec3, frame: Frame) -> wp.vec3:
    """Express the local vector ``v`` in world coordinates."""
    return frame.x * v[0] + frame.y * v[1] + frame.z * v[2]
