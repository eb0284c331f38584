"""Rows of ``T_shadow``: what the object keeps of each texel's light from the receiver.

Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.maths.frame import basis, to_world
from warpir.kernels.maths.rng import hash_pair, hash_uint, pixel_seed, sobol_pair, to_unit
from warpir.kernels.receiver import ReceiverPoint, receiver_origin, receiver_point
from warpir.kernels.receiver_mesh import receiver_mesh_hit, receiver_radiance, receiver_visibility
from warpir.kernels.sampling import cosine_sample
from warpir.kernels.tracing.ray import closest_hit, meets_box, visibility
from warpir.kernels.transport.texels import (
    TENT_REACH,
    TexelArgs,
    point_of,
    tent_direction,
)
from warpir.kernels.types import CameraArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

wp.set_module_options({"enable_backward": False})


@wp.kernel
def trace_receiver_points(
    pixels: wp.array[int],
    may_see_object: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    subsamples: int,
    seed: int,
    count: wp.array[int],
    position: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    spread: wp.array[float],
    share: wp.array[float],
):
    """Find the receiver, plane or mesh, under ``subsamples`` positions of each listed pixel.

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        may_see_object: 1 where the object may hide the receiver from the camera, shape [pixel].
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh.
        subsamples: Camera samples per pixel.
        seed: Base seed.
        count: Filled points of each pixel, shape [pixel].
        position: Points of the receiver, recentred [m], shape [pixel, subsample].
        normal: Its unit normals there, shape [pixel, subsample].
        spread: Largest distance of a pixel's points from its first one [m], shape [pixel].
        share: Of its subsamples that do not see the object, those that see the receiver and
            not what is behind the end of its mesh [1], shape [pixel].
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    found = int(0)
    is_open = int(0)
    farthest = float(0.0)
    for s in range(subsamples):
        point = receiver_point(
            camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
        )
        is_open += point.is_open
        if point.valid == 1:
            position[i, found] = point.position
            normal[i, found] = point.normal
            farthest = wp.max(farthest, wp.length(point.position - position[i, 0]))
            found += 1
    count[i] = found
    spread[i] = farthest
    share[i] = float(found) / float(wp.max(found + is_open, 1))


@wp.func
def blocked_share(
    position: wp.array2d[wp.vec3],
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    p: int,
    t: int,
    first: int,
    filled: int,
    pixel_key: wp.uint32,
    shift: float,
) -> float:
    """Return the share of texel ``t``'s irradiance that does not reach row ``p`` [1].

    Only the part of one piece of work, whose directions start at ``first``.
    """
    i = t // texels.width
    j = t % texels.width
    key = hash_pair(pixel_key, wp.uint32(t))
    directions = texels.direction_count[t]
    start = point_of(i, j, shift, filled)
    total = float(0.0)
    for r in range(first, wp.min(first + texels.item_size, directions)):
        wi = tent_direction(texels, i, j, r, key, 1, receiver.normal)
        origin = position[p, (start + r) % filled] + receiver.normal * mesh.epsilon
        if wp.dot(wi, receiver.normal) > 0.0 and meets_box(origin, wi, mesh.low, mesh.high) == 1:
            total += 1.0 - visibility(mesh, material, texture, origin, wi)
    return total / float(directions)


@wp.kernel
def trace_blocked(
    pixels: wp.array[int],
    count: wp.array[int],
    position: wp.array2d[wp.vec3],
    spread: wp.array[float],
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    columns: wp.array[int],
    seed: int,
    blocked: wp.array2d[float],
):
    """Write which share of a texel's irradiance the object keeps from the plane; (pixel, lane).

    Directions follow the tent times the cosine, so the share is exactly 0 where nothing is in the
    way and exactly 1 where everything is.

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        count: Filled points of each pixel, shape [pixel].
        position: Points of the plane [m], shape [pixel, subsample].
        spread: From `trace_receiver_points` [m], shape [pixel].
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The plane.
        texels: The map and how many directions each texel gets.
        columns: Texels whose tents rise above the plane, shape [column].
        seed: Base seed.
        blocked: Share [1], zero, shape [pixel, column].
    """
    p, lane = wp.tid()
    filled = count[p]
    key = pixel_seed(seed, pixels[p])
    shift = to_unit(hash_uint(key))
    start = position[p, 0]
    # A tent's direction that meets the box passes the centre's ray at less than this distance.
    reach = TENT_REACH * wp.PI / float(texels.height)
    far = wp.length(wp.max(wp.abs(mesh.low - start), wp.abs(mesh.high - start))) + spread[p]
    margin = reach * far + spread[p]
    low = mesh.low - wp.vec3(margin, margin, margin)
    high = mesh.high + wp.vec3(margin, margin, margin)
    for item in range(lane, texels.item_count, texels.lanes):
        c = texels.item_column[item]
        t = columns[c]
        if filled > 0 and meets_box(start, texels.centre[t], low, high) == 1:
            share = blocked_share(
                position,
                mesh,
                material,
                texture,
                receiver,
                texels,
                p,
                t,
                texels.item_first[item],
                filled,
                key,
                shift,
            )
            wp.atomic_add(blocked, p, c, share)


@wp.kernel
def trace_received(
    pixels: wp.array[int],
    count: wp.array[int],
    position: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    share: wp.array[float],
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    seed: int,
    received: wp.array2d[float],
    blocked: wp.array2d[float],
):
    """Write what each texel sends to a receiving mesh, and what the object keeps; (pixel, lane).

    Normals differ within a pixel there and the mesh hides part of the sky, so no row is known
    beforehand. Directions are spread evenly over the tent.

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        count: Filled points of each pixel, shape [pixel].
        position: Points of the receiver [m], shape [pixel, subsample].
        normal: Its unit normals there, shape [pixel, subsample].
        share: From `trace_receiver_points` [1], shape [pixel].
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh.
        texels: The map and how many directions each texel gets.
        seed: Base seed.
        received: Radiance of the white receiver without the object per texel radiance [1], zero,
            shape [pixel, texel].
        blocked: The part of it that the object keeps away [1], zero, shape [pixel, texel].
    """
    p, lane = wp.tid()
    filled = count[p]
    if filled == 0:
        return
    pixel_key = pixel_seed(seed, pixels[p])
    shift = to_unit(hash_uint(pixel_key))
    for item in range(lane, texels.item_count, texels.lanes):
        t = texels.item_column[item]
        i = t // texels.width
        j = t % texels.width
        key = hash_pair(pixel_key, wp.uint32(t))
        directions = texels.direction_count[t]
        start = point_of(i, j, shift, filled)
        first = texels.item_first[item]
        total = float(0.0)
        kept = float(0.0)
        for r in range(first, wp.min(first + texels.item_size, directions)):
            s = (start + r) % filled
            point = ReceiverPoint()
            point.position = position[p, s]
            point.normal = normal[p, s]
            wi = tent_direction(texels, i, j, r, key, 0, point.normal)
            cos_i = wp.dot(wi, point.normal)
            if cos_i > 0.0:
                origin = receiver_origin(mesh, receiver, point)
                arriving = cos_i * receiver_visibility(receiver, origin, wi)
                total += arriving
                if arriving > 0.0 and meets_box(origin, wi, mesh.low, mesh.high) == 1:
                    kept += arriving * (1.0 - visibility(mesh, material, texture, origin, wi))
        scale = texels.d_omega[i] / (wp.PI * float(directions))
        wp.atomic_add(received, p, t, total * scale)
        wp.atomic_add(blocked, p, t, kept * scale * share[p])


@wp.kernel
def trace_bounced(
    pixels: wp.array[int],
    count: wp.array[int],
    position: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    share: wp.array[float],
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    path_count: int,
    seed: int,
    received: wp.array[wp.vec3],
    blocked: wp.array[wp.vec3],
):
    """Add up what the receiver's mesh sends to the receiver, and what the object keeps of it.

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        count: Filled points of each pixel, shape [pixel].
        position: Points of the receiver [m], shape [pixel, subsample].
        normal: Its unit normals there, shape [pixel, subsample].
        share: From `trace_receiver_points` [1], shape [pixel].
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh.
        path_count: Directions per pixel.
        seed: Base seed.
        received: Radiance of the white receiver without the object, shape [pixel].
        blocked: The part of it that the object keeps away, shape [pixel].
    """
    p = wp.tid()
    filled = count[p]
    if filled == 0:
        return
    key = hash_pair(pixel_seed(seed, pixels[p]), wp.uint32(0x51ED27))
    total = wp.vec3(0.0)
    kept = wp.vec3(0.0)
    for q in range(path_count):
        point = ReceiverPoint()
        point.position = position[p, q % filled]
        point.normal = normal[p, q % filled]
        wi = to_world(cosine_sample(sobol_pair(q, key, 0)), basis(point.normal))
        origin = receiver_origin(mesh, receiver, point)
        receiver_hit = receiver_mesh_hit(receiver, origin, wi)
        if receiver_hit.valid == 1:
            L = receiver_radiance(receiver, receiver_hit)
            total += L
            u_passing = sobol_pair(q, key, 1)[0]
            hit = closest_hit(mesh, material, texture, origin, wi, receiver_hit.t, 0, u_passing)
            if hit.valid == 1:
                kept += L
    received[p] = total / float(path_count)
    blocked[p] = kept * (share[p] / float(path_count))
