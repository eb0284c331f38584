"""The receiver as a mesh: what it hides from the camera, which light it blocks, what it sends.

Light at infinity that the mesh blocks is replaced by the mesh's own radiance, which is what the
photo shows of it: a constant to the light, as emission is. Both sides of a triangle count. Without
a mesh (handle 0) every function is one comparison. Detached.
"""

import warp as wp

from warpir.kernels.types import ReceiverArgs

wp.set_module_options({"enable_backward": False})

INFINITY = wp.constant(1.0e30)
SEEN = wp.constant(0.999)
"""A point counts as seen when the camera's ray gets this share of the way to it."""


@wp.struct
class ReceiverHit:
    """Where a ray met the receiver's mesh."""

    valid: int
    t: float
    """Distance along the ray [m]; `INFINITY` where it met nothing."""
    position: wp.vec3
    normal: wp.vec3
    """Unit geometric normal, toward the side that the ray came from."""


@wp.func
def plane_distance(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return the distance to the plane's lit side [m], or a negative number."""
    slope = wp.dot(receiver.normal, direction)
    if slope > -1.0e-9:
        return -1.0
    return (receiver.offset - wp.dot(receiver.normal, origin)) / slope


@wp.func
def receiver_mesh_hit(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> ReceiverHit:
    """Find the first triangle of the receiver's mesh."""
    hit = ReceiverHit()
    hit.valid = 0
    hit.t = INFINITY
    if receiver.mesh == wp.uint64(0):
        return hit
    query = wp.mesh_query_ray(receiver.mesh, origin, direction, INFINITY)
    if query.result:
        a = receiver.positions[receiver.indices[3 * query.face]]
        b = receiver.positions[receiver.indices[3 * query.face + 1]]
        c = receiver.positions[receiver.indices[3 * query.face + 2]]
        n = wp.normalize(wp.cross(b - a, c - a))
        if wp.dot(n, direction) > 0.0:
            n = -n
        hit.valid = 1
        hit.t = query.t
        # From the corners: more precise than along the ray.
        hit.position = a * query.u + b * query.v + c * (1.0 - query.u - query.v)
        hit.normal = n
    return hit


@wp.func
def receiver_visibility(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return 1 where light from infinity passes the receiver's mesh, else 0."""
    if receiver.mesh == wp.uint64(0):
        return 1.0
    if wp.mesh_query_ray_anyhit(receiver.mesh, origin, direction, INFINITY):
        return 0.0
    return 1.0


@wp.func
def receiver_hit(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> ReceiverHit:
    """Find where a ray off the object meets the receiver: its mesh, and its plane if solid."""
    hit = receiver_mesh_hit(receiver, origin, direction)
    if receiver.is_solid == 1 and wp.dot(receiver.normal, direction) < 0.0:
        hit.valid = 1
        hit.t = wp.min(hit.t, wp.max(plane_distance(receiver, origin, direction), 0.0))
    return hit


@wp.func
def sky_visibility(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return 1 where light from infinity passes mesh and solid plane to the object, else 0."""
    if receiver.is_solid == 1 and wp.dot(receiver.normal, direction) < 0.0:
        return 0.0
    return receiver_visibility(receiver, origin, direction)


@wp.func
def photo_at(receiver: ReceiverArgs, hit: ReceiverHit) -> wp.vec4:
    """Return the photo's radiance at a point of plane or mesh, with 1 behind it.

    All is 0 where the camera does not see the same side of the same point.
    """
    nothing = wp.vec4(0.0, 0.0, 0.0, 0.0)
    from_eye = hit.position - receiver.eye
    if wp.dot(from_eye, hit.normal) < 0.0:
        q = receiver.to_image * from_eye
        if q[2] > 0.0:
            j = int(wp.floor(q[0] / q[2]))
            i = int(wp.floor(q[1] / q[2]))
            if (
                i >= 0
                and j >= 0
                and i < receiver.radiance.shape[0]
                and j < receiver.radiance.shape[1]
            ):
                distance = wp.length(from_eye)
                direction = from_eye / distance
                plane = plane_distance(receiver, receiver.eye, direction)
                if plane < 0.0 or plane > SEEN * distance:
                    if receiver_mesh_hit(receiver, receiver.eye, direction).t > SEEN * distance:
                        seen = receiver.radiance[i, j]
                        return wp.vec4(seen[0], seen[1], seen[2], 1.0)
    return nothing


@wp.func
def receiver_radiance(receiver: ReceiverArgs, hit: ReceiverHit) -> wp.vec3:
    """Return what the receiver's mesh sends from a hit back along the ray.

    That is the photo's radiance where the camera sees it, else the mean of all that it sees of the
    mesh.
    """
    if receiver.shines == 0:
        return wp.vec3(0.0)
    seen = photo_at(receiver, hit)
    if seen[3] > 0.0:
        return wp.vec3(seen[0], seen[1], seen[2])
    return receiver.elsewhere


@wp.kernel
def trace_seen(receiver: ReceiverArgs, to_world: wp.mat33, seen: wp.array2d[float]):
    """Write 1 where the middle of a pixel of ``receiver.radiance`` shows the mesh, else 0.

    Args:
        receiver: The receiver.
        to_world: Inverse of ``receiver.to_image``.
        seen: Shape [height, width].
    """
    i, j = wp.tid()
    direction = wp.normalize(to_world * wp.vec3(float(j) + 0.5, float(i) + 0.5, 1.0))
    hit = receiver_mesh_hit(receiver, receiver.eye, direction)
    plane = plane_distance(receiver, receiver.eye, direction)
    is_seen = float(hit.valid)
    if plane > 0.0 and plane < hit.t:
        is_seen = 0.0
    seen[i, j] = is_seen
