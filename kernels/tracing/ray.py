"""Rays against the object: camera rays, the closest hit, visibility.

Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.maths.rng import sobol_pair
from warpir.kernels.receiver_mesh import INFINITY, plane_distance, receiver_mesh_hit
from warpir.kernels.tracing.coverage import hit_alpha
from warpir.kernels.tracing.hit import ULP, Hit, face_normal, hit_position, offset_origin
from warpir.kernels.tracing.triangles import (
    any_triangle,
    closest_triangle,
    first_triangle,
    hit_of,
)
from warpir.kernels.types import CameraArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

LAYERS_MAX = wp.constant(64)
"""Surfaces that one ray may pass through; a safety bound, not a quality setting."""
CAMERA_PASSING = wp.constant(1 << 16)
"""Pair of dimensions whose first number decides what a camera ray passes; vertices have others."""


@wp.func
def camera_ray(camera: CameraArgs, pixel: int, jitter: wp.vec2) -> wp.vec3:
    """Return the unit direction through ``pixel`` (row-major index) at a position inside it."""
    x = float(pixel % camera.width) + jitter[0]
    y = float(pixel // camera.width) + jitter[1]
    local = wp.vec3((x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy, -1.0)
    return wp.normalize(camera.rotation * local)


@wp.func
def camera_reach(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return how far a camera ray sees [m]: to the receiver's plane or mesh and what lies there.

    Without the tolerance a sheet on the ground would be seen in a random part of its samples.
    """
    reach = plane_distance(receiver, origin, direction)
    if reach < 0.0:
        reach = INFINITY
    else:
        reach = reach - receiver.tolerance / wp.dot(receiver.normal, direction)
    hit = receiver_mesh_hit(receiver, origin, direction)
    if hit.valid == 1:
        # Along a wall a ray may graze for any distance.
        slope = wp.max(-wp.dot(hit.normal, direction), 1.0e-6)
        reach = wp.min(reach, hit.t + receiver.tolerance / slope)
    return reach


@wp.func(inline=True)
def is_culled(mesh: MeshArgs, material: MaterialArgs, face: int, ray_dir: wp.vec3) -> int:
    """Return 1 where the ray meets the back of a single-sided material."""
    if material.double_sided[mesh.face_material[face]] == 1:
        return 0
    return int(wp.dot(face_normal(mesh, face), ray_dir) > 0.0)


@wp.func
def facing_twin(mesh: MeshArgs, passing: int, position: wp.vec3, ray_dir: wp.vec3) -> Hit:
    """Find a triangle in the place of a culled one that faces the ray; ``valid`` is 0 without one.

    Sheets are often modelled as two single-sided ones in one place, and a query returns either. A
    ray that goes on from the culled one starts beyond both. ``passing`` is that of `any_triangle`.
    """
    twin = Hit()
    twin.valid = 0
    largest = wp.max(wp.max(wp.abs(position[0]), wp.abs(position[1])), wp.abs(position[2]))
    reach = 4.0 * ULP * largest + mesh.epsilon
    margin = wp.vec3(reach, reach, reach)
    tree = mesh.id
    start = int(0)
    if passing == 1:
        tree = mesh.passing
        start = mesh.passing_start
    if tree == wp.uint64(0):
        return twin
    query = wp.mesh_query_aabb(tree, position - margin, position + margin)
    found = int(0)
    while wp.mesh_query_aabb_next(query, found):
        face = start + found
        a = mesh.positions[mesh.indices[3 * face]]
        b = mesh.positions[mesh.indices[3 * face + 1]]
        c = mesh.positions[mesh.indices[3 * face + 2]]
        n = wp.cross(b - a, c - a)
        area = wp.length(n)
        if wp.dot(n, ray_dir) < 0.0 and wp.abs(wp.dot(position - a, n)) <= reach * area:
            u = wp.dot(wp.cross(c - b, position - b), n) / (area * area)
            v = wp.dot(wp.cross(a - c, position - c), n) / (area * area)
            # Rounding must not drop a point between two halves of the twin.
            if wp.min(wp.min(u, v), 1.0 - u - v) >= -1.0e-5:
                twin.valid = 1
                twin.face = face
                twin.u = wp.clamp(u, 0.0, 1.0)
                twin.v = wp.clamp(v, 0.0, 1.0 - twin.u)
    return twin


@wp.func(inline=False)
def closest_of_layers(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
    max_t: float,
    is_camera_ray: int,
    u: float,
) -> Hit:
    """Find what `closest_hit` does where materials let rays pass.

    Not inlined, as `transmitted_within`: few rays come here, and CUDA's compiler takes three times
    as long for kernels that hold this code at each of their rays.
    """
    hit = Hit()
    hit.valid = 0
    origin = ray_origin
    left = float(u)
    for _layer in range(LAYERS_MAX):
        hit = closest_triangle(mesh, origin, ray_dir, max_t)
        if hit.valid == 0:
            return hit
        face = int(hit.face)
        accept = int(1)
        if is_camera_ray == 1 and material.any_culled == 1:
            if is_culled(mesh, material, face, ray_dir) == 1:
                twin = facing_twin(mesh, 0, hit_position(mesh, hit), ray_dir)
                if twin.valid == 0:
                    twin = facing_twin(mesh, 1, hit_position(mesh, hit), ray_dir)
                accept = twin.valid
                if twin.valid == 1:
                    hit = twin
        if accept == 1 and hit.face >= mesh.passing_start:
            alpha = hit_alpha(mesh, material, texture, hit, ray_dir)
            if alpha < 1.0 and left >= alpha:
                # What is left of the number is uniform again.
                accept = 0
                left = (left - alpha) / (1.0 - alpha)
        if accept == 1:
            hit.valid = 1
            return hit
        # Bounds on max_t apply to the whole ray; what is left of it shrinks with each layer.
        position = hit_position(mesh, hit)
        max_t = max_t - wp.length(position - origin)
        origin = offset_origin(position, face_normal(mesh, face), ray_dir, mesh.epsilon)
    hit.valid = 0
    return hit


@wp.func(inline=True)
def closest_hit(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
    max_t: float,
    is_camera_ray: int,
    u: float,
) -> Hit:
    """Find the first surface that the ray does not pass through.

    A camera ray passes the back of a single-sided material; any ray passes a point of opacity alpha
    where the uniform number ``u`` is not below it. One number does for all such points of a ray, so
    that a pixel's samples, stratified in it, leave little noise of what they pass.
    """
    # A call copies all of its structs, which takes as long as the ray.
    hit = closest_triangle(mesh, ray_origin, ray_dir, max_t)
    may_pass = int(0)
    if hit.valid == 1:
        if mesh.passing != wp.uint64(0) and hit.face >= mesh.passing_start:
            may_pass = 1
        elif is_camera_ray == 1 and material.any_culled == 1:
            may_pass = is_culled(mesh, material, hit.face, ray_dir)
    if may_pass == 1:
        return closest_of_layers(
            mesh, material, texture, ray_origin, ray_dir, max_t, is_camera_ray, u
        )
    return hit


@wp.func
def camera_hit(
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    s: int,
    key: wp.uint32,
    ray_dir: wp.vec3,
) -> Hit:
    """Find what a pixel's camera sample ``s`` sees of the object; the plane hides what is below.

    ``ray_dir`` is `camera_ray` at ``sobol_pair(s, key, 0)``.
    """
    reach = camera_reach(receiver, camera.origin, ray_dir)
    u = sobol_pair(s, key, CAMERA_PASSING)[0]
    return closest_hit(mesh, material, texture, camera.origin, ray_dir, reach, 1, u)


@wp.func
def meets_box(origin: wp.vec3, wi: wp.vec3, low: wp.vec3, high: wp.vec3) -> int:
    """Return 1 when the ray may meet the box; most rays from a plane do not."""
    near = float(0.0)
    far = float(INFINITY)
    for axis in range(3):
        if wp.abs(wi[axis]) > 1.0e-12:
            a = (low[axis] - origin[axis]) / wi[axis]
            b = (high[axis] - origin[axis]) / wi[axis]
            near = wp.max(near, wp.min(a, b))
            far = wp.min(far, wp.max(a, b))
        elif origin[axis] < low[axis] or origin[axis] > high[axis]:
            return 0
    if near <= far:
        return 1
    return 0


@wp.func(inline=False)
def transmitted_within(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
    max_t: float,
) -> float:
    """Find what `visibility_within` does behind triangles that may let light pass."""
    transmitted = float(1.0)
    origin = ray_origin
    left = max_t
    for _layer in range(LAYERS_MAX):
        hit = hit_of(first_triangle(mesh, 1, origin, ray_dir, left))
        if hit.valid == 0:
            return transmitted
        transmitted = transmitted * (1.0 - hit_alpha(mesh, material, texture, hit, ray_dir))
        if transmitted <= 0.0:
            return 0.0
        position = hit_position(mesh, hit)
        left = left - wp.length(position - origin)
        origin = offset_origin(position, face_normal(mesh, hit.face), ray_dir, mesh.epsilon)
    return 0.0


@wp.func(inline=True)
def visibility_within(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
    max_t: float,
) -> float:
    """Return the share of light that comes to ``ray_origin`` from ``max_t`` [m] along the ray."""
    if any_triangle(mesh, 0, ray_origin, ray_dir, max_t):
        return 0.0
    # Most rays meet no glass, and a call takes as long as a ray.
    if any_triangle(mesh, 1, ray_origin, ray_dir, max_t):
        return transmitted_within(mesh, material, texture, ray_origin, ray_dir, max_t)
    return 1.0


@wp.func(inline=True)
def visibility(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
) -> float:
    """Return the share of light that reaches ``ray_origin`` from infinity along ``ray_dir``."""
    return visibility_within(mesh, material, texture, ray_origin, ray_dir, INFINITY)
