"""Hits on the object's triangles: position, geometric normal, and where a new ray starts."""

import warp as wp

from warpir.kernels.types import MeshArgs

ULP = wp.constant(1.1920929e-07)


@wp.struct
class Hit:
    """Where a ray met the mesh."""

    valid: int
    face: int
    u: float
    v: float
    """Barycentric weights of the first and second corner."""


@wp.func
def offset_origin(p: wp.vec3, ng: wp.vec3, direction: wp.vec3, epsilon: float) -> wp.vec3:
    """Move a ray's start off the surface, to the side it leaves on.

    The offset is a few units in the last place of the coordinates plus a share of the scene's size.
    """
    largest = wp.max(wp.max(wp.abs(p[0]), wp.abs(p[1])), wp.abs(p[2]))
    amount = 4.0 * ULP * largest + epsilon
    if wp.dot(ng, direction) < 0.0:
        amount = -amount
    return p + ng * amount


@wp.func
def face_normal(mesh: MeshArgs, face: int) -> wp.vec3:
    """Return the unit geometric normal of a triangle."""
    a = mesh.positions[mesh.indices[3 * face]]
    b = mesh.positions[mesh.indices[3 * face + 1]]
    c = mesh.positions[mesh.indices[3 * face + 2]]
    return wp.normalize(wp.cross(b - a, c - a))


@wp.func
def hit_position(mesh: MeshArgs, hit: Hit) -> wp.vec3:
    """Interpolate the position from the corners, which is more precise than ``o + t d``."""
    a = mesh.positions[mesh.indices[3 * hit.face]]
    b = mesh.positions[mesh.indices[3 * hit.face + 1]]
    c = mesh.positions[mesh.indices[3 * hit.face + 2]]
    return a * hit.u + b * hit.v + c * (1.0 - hit.u - hit.v)
