"""A ray against the object's triangles: by Embree on a CPU, by Warp's tree elsewhere.

Triangles that stop every ray have a tree, and those that may let rays pass another, so that any hit
in the first ends a ray of light.

On two x86 cores a ray through a car of 67 000 triangles costs .16 to .36 us in Embree 4.4 and .5 to
1.3 us in Warp 1.19 (`benchmarks.speed.rays`). Warp's CPU kernels are native code, so they call
Embree's C functions by address. Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.tracing.hit import Hit
from warpir.kernels.types import MeshArgs

# Embree 4's RTCRay and RTCRayHit. It fills what follows `geom` by the depth of instancing that it
# was built for, so there is room for more than any build uses.
_OCCLUDED = """
#if !defined(__CUDA_ARCH__)
struct alignas(16) Ray {
    float origin[3], near, direction[3], time, far;
    unsigned mask, id, flags;
} ray = {
    {origin[0], origin[1], origin[2]}, 0.0f,
    {direction[0], direction[1], direction[2]}, 0.0f, max_t, ~0u, 0u, 0u};
reinterpret_cast<void (*)(void*, Ray*, void*)>(function)(
    reinterpret_cast<void*>(scene), &ray, nullptr);
return ray.far < 0.0f;
#else
return false;
#endif
"""
_INTERSECT = """
#if !defined(__CUDA_ARCH__)
struct alignas(16) RayHit {
    float origin[3], near, direction[3], time, far;
    unsigned mask, id, flags;
    float normal[3], u, v;
    unsigned triangle, geom, instances[16];
} ray = {
    {origin[0], origin[1], origin[2]}, 0.0f,
    {direction[0], direction[1], direction[2]}, 0.0f, max_t, ~0u, 0u, 0u};
ray.geom = ~0u;
reinterpret_cast<void (*)(void*, RayHit*, void*)>(function)(
    reinterpret_cast<void*>(scene), &ray, nullptr);
// Warp's weights are those of the first and second corner, Embree's of the second and third.
if (ray.geom != ~0u)
    return wp::vec4(wp::cast<float>((int)ray.triangle), 1.0f - ray.u - ray.v, ray.u, ray.far);
#endif
return wp::vec4(wp::cast<float>(-1), 0.0f, 0.0f, max_t);
"""


@wp.func_native(_OCCLUDED)
def any_in_embree(
    scene: wp.uint64, function: wp.uint64, origin: wp.vec3, direction: wp.vec3, max_t: float
) -> bool:
    """Return whether the ray meets a triangle of Embree's scene before ``max_t`` [m]."""
    ...


@wp.func_native(_INTERSECT)
def first_in_embree(
    scene: wp.uint64, function: wp.uint64, origin: wp.vec3, direction: wp.vec3, max_t: float
) -> wp.vec4:
    """Return what `first_in_tree` does of Embree's scene."""
    ...


# A kernel for CUDA holds one copy of each search, which is called: as fast as a copy at each call
# for a plain object, faster by a seventh for one with layers, and compiled in half the time.
@wp.func(inline=False)
def any_in_tree(tree: wp.uint64, origin: wp.vec3, direction: wp.vec3, max_t: float) -> bool:
    """Return whether the ray meets a triangle of Warp's tree before ``max_t`` [m]."""
    return wp.mesh_query_ray_anyhit(tree, origin, direction, max_t)


@wp.func(inline=False)
def first_in_tree(tree: wp.uint64, origin: wp.vec3, direction: wp.vec3, max_t: float) -> wp.vec4:
    """Return the bits of the triangle's index, or of -1, the weights of two corners, the distance.

    The distance is ``max_t`` where the ray meets nothing before that [m].
    """
    query = wp.mesh_query_ray(tree, origin, direction, max_t)
    if query.result:
        return wp.vec4(wp.cast(query.face, float), query.u, query.v, query.t)
    return wp.vec4(wp.cast(-1, float), 0.0, 0.0, max_t)


@wp.func(inline=True)
def any_triangle(
    mesh: MeshArgs, passing: int, origin: wp.vec3, direction: wp.vec3, max_t: float
) -> bool:
    """Return whether the ray meets a triangle before ``max_t`` [m].

    ``passing`` is 0 for the triangles that stop every ray, 1 for those that may let rays pass.
    """
    tree = mesh.id
    scene = mesh.embree
    if passing == 1:
        tree = mesh.passing
        scene = mesh.embree_passing
    if scene != wp.uint64(0):
        return any_in_embree(scene, mesh.embree_occluded, origin, direction, max_t)
    if tree == wp.uint64(0):
        return False
    return any_in_tree(tree, origin, direction, max_t)


@wp.func(inline=True)
def first_triangle(
    mesh: MeshArgs, passing: int, origin: wp.vec3, direction: wp.vec3, max_t: float
) -> wp.vec4:
    """Return what `first_in_tree` does; ``passing`` is that of `any_triangle`."""
    tree = mesh.id
    scene = mesh.embree
    start = int(0)
    if passing == 1:
        tree = mesh.passing
        scene = mesh.embree_passing
        start = mesh.passing_start
    found = wp.vec4(wp.cast(-1, float), 0.0, 0.0, max_t)
    if scene != wp.uint64(0):
        found = first_in_embree(scene, mesh.embree_intersect, origin, direction, max_t)
    elif tree != wp.uint64(0):
        found = first_in_tree(tree, origin, direction, max_t)
    face = wp.cast(found[0], int)
    if face >= 0:
        found[0] = wp.cast(start + face, float)
    return found


@wp.func
def hit_of(found: wp.vec4) -> Hit:
    """Return what `first_triangle` has found."""
    hit = Hit()
    hit.face = wp.cast(found[0], int)
    hit.u = found[1]
    hit.v = found[2]
    hit.valid = int(hit.face >= 0)
    return hit


@wp.func(inline=True)
def closest_triangle(mesh: MeshArgs, origin: wp.vec3, direction: wp.vec3, max_t: float) -> Hit:
    """Return the first triangle that the ray meets before ``max_t`` [m]."""
    found = first_triangle(mesh, 0, origin, direction, max_t)
    if mesh.passing != wp.uint64(0):
        nearer = first_triangle(mesh, 1, origin, direction, found[3])
        if wp.cast(nearer[0], int) >= 0:
            found = nearer
    return hit_of(found)
