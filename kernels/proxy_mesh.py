"""The photo's place as a mesh: what it hides from the camera, which light it blocks, what it sends.

Light at infinity that the mesh blocks is replaced by the mesh's own radiance, which is what the
photo shows of it: a constant to the light, as emission is. Both sides of a triangle count. Without
a mesh (handle 0) every function is one comparison. Detached.
"""

import warp as wp

from warpir.kernels.types import ProxyArgs

wp.set_module_options({"enable_backward": False})

INFINITY = wp.constant(1.0e30)
SEEN = wp.constant(0.999)
"""A point counts as seen when the camera's ray gets this share of the way to it."""


@wp.struct
class ProxyHit:
    """Where a ray met the place's mesh."""

    valid: int
    t: float
    """Distance along the ray [m]; `INFINITY` where it met nothing."""
    position: wp.vec3
    normal: wp.vec3
    """Unit geometric normal, toward the side that the ray came from."""


@wp.func
def proxy_distance(proxy: ProxyArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return the distance to the plane's lit side [m], or a negative number."""
    slope = wp.dot(proxy.normal, direction)
    if slope > -1.0e-9:
        return -1.0
    return (proxy.offset - wp.dot(proxy.normal, origin)) / slope


@wp.func
def proxy_mesh_hit(proxy: ProxyArgs, origin: wp.vec3, direction: wp.vec3) -> ProxyHit:
    """Find the first triangle of the place's mesh."""
    hit = ProxyHit()
    hit.valid = 0
    hit.t = INFINITY
    if proxy.mesh == wp.uint64(0):
        return hit
    query = wp.mesh_query_ray(proxy.mesh, origin, direction, INFINITY)
    if query.result:
        a = proxy.positions[proxy.indices[3 * query.face]]
        b = proxy.positions[proxy.indices[3 * query.face + 1]]
        c = proxy.positions[proxy.indices[3 * query.face + 2]]
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
def proxy_visibility(proxy: ProxyArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return 1 where light from infinity passes the place's mesh, else 0."""
    if proxy.mesh == wp.uint64(0):
        return 1.0
    if wp.mesh_query_ray_anyhit(proxy.mesh, origin, direction, INFINITY):
        return 0.0
    return 1.0


@wp.func
def proxy_radiance(proxy: ProxyArgs, hit: ProxyHit) -> wp.vec3:
    """Return what the place's mesh sends from a hit back along the ray.

    That is the photo's radiance where the camera sees the same side of the same point, else the
    mean of all that it sees of the mesh.
    """
    if proxy.shines == 0:
        return wp.vec3(0.0)
    from_eye = hit.position - proxy.eye
    if wp.dot(from_eye, hit.normal) < 0.0:
        q = proxy.to_image * from_eye
        if q[2] > 0.0:
            j = int(wp.floor(q[0] / q[2]))
            i = int(wp.floor(q[1] / q[2]))
            if i >= 0 and j >= 0 and i < proxy.radiance.shape[0] and j < proxy.radiance.shape[1]:
                distance = wp.length(from_eye)
                direction = from_eye / distance
                plane = proxy_distance(proxy, proxy.eye, direction)
                if plane < 0.0 or plane > SEEN * distance:
                    if proxy_mesh_hit(proxy, proxy.eye, direction).t > SEEN * distance:
                        return proxy.radiance[i, j]
    return proxy.elsewhere


@wp.kernel
def trace_seen(proxy: ProxyArgs, to_world: wp.mat33, seen: wp.array2d[float]):
    """Write 1 where the middle of a pixel of ``proxy.radiance`` shows the place's mesh, else 0.

    Args:
        proxy: The place.
        to_world: Inverse of ``proxy.to_image``.
        seen: Shape [height, width].
    """
    i, j = wp.tid()
    direction = wp.normalize(to_world * wp.vec3(float(j) + 0.5, float(i) + 0.5, 1.0))
    hit = proxy_mesh_hit(proxy, proxy.eye, direction)
    plane = proxy_distance(proxy, proxy.eye, direction)
    is_seen = float(hit.valid)
    if plane > 0.0 and plane < hit.t:
        is_seen = 0.0
    seen[i, j] = is_seen
