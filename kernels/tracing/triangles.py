"""A ray against the object's triangles: by Embree on a CPU, by Warp's tree elsewhere.

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
if (mesh.embree != 0) {
    struct alignas(16) Ray {
        float origin[3], near, direction[3], time, far;
        unsigned mask, id, flags;
    } ray = {
        {origin[0], origin[1], origin[2]}, 0.0f,
        {direction[0], direction[1], direction[2]}, 0.0f, max_t, ~0u, 0u, 0u};
    reinterpret_cast<void (*)(void*, Ray*, void*)>(mesh.embree_occluded)(
        reinterpret_cast<void*>(mesh.embree), &ray, nullptr);
    return ray.far < 0.0f;
}
#endif
return wp::mesh_query_ray_anyhit(mesh.id, origin, direction, max_t);
"""
_INTERSECT = """
const wp::vec3 miss(wp::cast<float>(-1), 0.0f, 0.0f);
#if !defined(__CUDA_ARCH__)
if (mesh.embree != 0) {
    struct alignas(16) RayHit {
        float origin[3], near, direction[3], time, far;
        unsigned mask, id, flags;
        float normal[3], u, v;
        unsigned triangle, geom, instances[16];
    } ray = {
        {origin[0], origin[1], origin[2]}, 0.0f,
        {direction[0], direction[1], direction[2]}, 0.0f, max_t, ~0u, 0u, 0u};
    ray.geom = ~0u;
    reinterpret_cast<void (*)(void*, RayHit*, void*)>(mesh.embree_intersect)(
        reinterpret_cast<void*>(mesh.embree), &ray, nullptr);
    if (ray.geom == ~0u)
        return miss;
    // Warp's weights are those of the first and second corner, Embree's of the second and third.
    return wp::vec3(wp::cast<float>((int)ray.triangle), 1.0f - ray.u - ray.v, ray.u);
}
#endif
const wp::mesh_query_ray_t query = wp::mesh_query_ray(mesh.id, origin, direction, max_t, -1);
if (!query.result)
    return miss;
return wp::vec3(wp::cast<float>(query.face), query.u, query.v);
"""


@wp.func_native(_OCCLUDED)
def any_triangle(mesh: MeshArgs, origin: wp.vec3, direction: wp.vec3, max_t: float) -> bool:
    """Return whether the ray meets a triangle before ``max_t`` [m]."""
    ...


@wp.func_native(_INTERSECT)
def first_triangle(mesh: MeshArgs, origin: wp.vec3, direction: wp.vec3, max_t: float) -> wp.vec3:
    """Return the bits of the triangle's index, or of -1, and the weights of two corners."""
    ...


@wp.func
def closest_triangle(mesh: MeshArgs, origin: wp.vec3, direction: wp.vec3, max_t: float) -> Hit:
    """Return the first triangle that the ray meets before ``max_t`` [m]."""
    found = first_triangle(mesh, origin, direction, max_t)
    hit = Hit()
    hit.face = wp.cast(found[0], int)
    hit.u = found[1]
    hit.v = found[2]
    hit.valid = int(hit.face >= 0)
    return hit
