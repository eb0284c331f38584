"""The receiver with and without the object: numerator and denominator of the shadow ratio.

``beta = PathTrace(X + P, L, 1) / PathTrace(P, L, 1)`` per channel (DiPIR, eq. 5). Both use the same
directions, so the ratio lies in [0, 1] and is exactly 1 where nothing is blocked; and their noise
cancels, which a closed form of the denominator would undo. P is the ground plane and the receiver's
mesh, whichever the camera sees first. The mesh shades both halves: where a wall keeps the sun away
the object can take away only what is left, so shadows do not double. Detached.
"""

import warp as wp

from warpir.kernels.light_gradient import keep_direction
from warpir.kernels.maths.frame import basis, to_world
from warpir.kernels.maths.rng import hash_pair, pixel_seed, sobol_pair
from warpir.kernels.receiver_mesh import (
    plane_distance,
    receiver_mesh_hit,
    receiver_radiance,
    receiver_visibility,
)
from warpir.kernels.sampling import (
    cosine_sample,
    light_eval,
    light_sample,
    power_heuristic,
)
from warpir.kernels.tracing.hit import offset_origin
from warpir.kernels.tracing.ray import camera_hit, camera_ray, closest_hit, visibility
from warpir.kernels.types import (
    CameraArgs,
    LightArgs,
    LightRecord,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

INV_PI = wp.constant(0.318309886183791)


BOUNCE_KEY = wp.constant(wp.uint32(0x2545F491))
"""Keeps the draws of what the object lets through of the mesh's light apart from the camera's."""


@wp.struct
class ReceiverPoint:
    """A point of the receiver that the camera sees."""

    valid: int
    is_open: int
    """1 where a receiver with a mesh ends: the camera sees neither it nor the object."""
    position: wp.vec3
    normal: wp.vec3
    """Unit, toward the side that receives light; of the mesh, toward the camera."""


@wp.func
def receiver_origin(mesh: MeshArgs, receiver: ReceiverArgs, point: ReceiverPoint) -> wp.vec3:
    """Return where rays from a receiver start, off the plane and the receiver's mesh."""
    if receiver.mesh == wp.uint64(0):
        return point.position + point.normal * mesh.epsilon
    epsilon = wp.max(mesh.epsilon, receiver.epsilon)
    return offset_origin(point.position, point.normal, point.normal, epsilon)


@wp.struct
class ReceiverSample:
    """Two directions from one point of the receiver; ``weight`` is ``cos / pi * mis / pdf``."""

    wi_light: wp.vec3
    weight_light: float
    """0 where the receiver's mesh is in the way; so is the other."""
    visible_light: float
    radiance_light: wp.vec3
    wi_cosine: wp.vec3
    weight_cosine: float
    visible_cosine: float
    radiance_cosine: wp.vec3
    bounced: wp.vec3
    """Radiance from the receiver's mesh where the second direction meets it; a constant to the
    light."""


@wp.func
def receiver_sample(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    point: ReceiverPoint,
    keep_dark: int,
    index: int,
    key: wp.uint32,
) -> ReceiverSample:
    """Draw one direction from the light and one from the cosine, and trace both.

    ``keep_dark`` asks for directions that bring no light now, too: a gradient needs them.
    """
    out = ReceiverSample()
    out.weight_light = 0.0
    out.visible_light = 1.0
    out.weight_cosine = 0.0
    out.visible_cosine = 1.0
    out.bounced = wp.vec3(0.0)
    origin = receiver_origin(mesh, receiver, point)
    pick = sobol_pair(index, key, 1)
    wi = light_sample(light, sobol_pair(index, key, 2), pick[0])
    cos_i = wp.dot(wi, point.normal)
    out.wi_light = wi
    if cos_i > 0.0:
        Li = light_eval(light, wi)
        if Li.pdf > 0.0 and (wp.max(Li.radiance) > 0.0 or keep_dark == 1):
            pdf = cos_i * INV_PI
            out.weight_light = pdf * power_heuristic(Li.pdf, pdf) / Li.pdf
            out.weight_light = out.weight_light * receiver_visibility(receiver, origin, wi)
            out.radiance_light = Li.radiance
            out.visible_light = visibility(mesh, material, texture, origin, wi)
    wi = to_world(cosine_sample(sobol_pair(index, key, 3)), basis(point.normal))
    cos_i = wp.dot(wi, point.normal)
    out.wi_cosine = wi
    if cos_i > 0.0:
        receiver_hit = receiver_mesh_hit(receiver, origin, wi)
        if receiver_hit.valid == 1:
            out.bounced = receiver_radiance(receiver, receiver_hit)
            ray_key = hash_pair(hash_pair(key, BOUNCE_KEY), wp.uint32(index))
            hit = closest_hit(mesh, material, texture, origin, wi, receiver_hit.t, 0, ray_key)
            out.visible_cosine = 1.0 - float(hit.valid)
            return out
        Li = light_eval(light, wi)
        if wp.max(Li.radiance) > 0.0 or keep_dark == 1:
            out.weight_cosine = power_heuristic(cos_i * INV_PI, Li.pdf)
            out.radiance_cosine = Li.radiance
            out.visible_cosine = visibility(mesh, material, texture, origin, wi)
    return out


@wp.func
def receiver_point(
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    pixel: int,
    may_see_object: int,
    s: int,
    key: wp.uint32,
) -> ReceiverPoint:
    """Find the point of plane or mesh that camera sample ``s`` sees, if it sees one."""
    point = ReceiverPoint()
    point.valid = 0
    point.is_open = 0
    ray_dir = camera_ray(camera, pixel, sobol_pair(s, key, 0))
    t = plane_distance(receiver, camera.origin, ray_dir)
    receiver_hit = receiver_mesh_hit(receiver, camera.origin, ray_dir)
    if t <= 0.0 and receiver_hit.valid == 0 and receiver.mesh == wp.uint64(0):
        return point
    if may_see_object == 1:
        if camera_hit(camera, mesh, material, texture, receiver, s, key, ray_dir).valid == 1:
            return point
    if t <= 0.0 and receiver_hit.valid == 0:
        point.is_open = 1
        return point
    point.valid = 1
    if receiver_hit.valid == 1 and (t <= 0.0 or receiver_hit.t < t):
        point.position = receiver_hit.position
        point.normal = receiver_hit.normal
        return point
    p = camera.origin + ray_dir * t
    # Back onto the plane: far hits lose digits along the ray.
    point.position = p - receiver.normal * (wp.dot(receiver.normal, p) - receiver.offset)
    point.normal = receiver.normal
    return point


@wp.struct
class ObjectRay:
    """A direction in which a point of the receiver may see the object."""

    direction: wp.vec3
    weight: float
    """``cos / pi / pdf``; 0 where there is no direction."""


@wp.func
def object_ray(mesh: MeshArgs, origin: wp.vec3, normal: wp.vec3, u: wp.vec2) -> ObjectRay:
    """Draw a direction in proportion to its cosine, as far as it may meet the object.

    The cosine is even on the unit disc below the hemisphere (Nusselt's analogue). There the sphere
    around the object's box covers an ellipse, or a part of one; a point is drawn from the rectangle
    around that, and from the square around the disc where ``origin`` is within the sphere.
    """
    frame = basis(normal)
    low = wp.vec2(-1.0, -1.0)
    high = wp.vec2(1.0, 1.0)
    toward = 0.5 * (mesh.low + mesh.high) - origin
    distance = wp.length(toward)
    radius = 0.5 * wp.length(mesh.high - mesh.low)
    if distance > radius:
        # Elevation of the sphere's centre, and half the angle that the sphere covers
        up = wp.clamp(wp.dot(toward, normal) / distance, -1.0, 1.0)
        along = wp.sqrt(1.0 - up * up)
        reach = radius / distance
        spare = wp.sqrt(1.0 - reach * reach)
        if along > 1.0e-4:
            frame.x = wp.normalize(toward - normal * (up * distance))
            frame.y = wp.cross(normal, frame.x)
        low = wp.vec2(along * spare - up * reach, -reach)
        high = wp.vec2(1.0, reach)
        if up > reach:
            high = wp.vec2(along * spare + up * reach, reach)
    out = ObjectRay()
    out.weight = 0.0
    x = wp.lerp(low[0], high[0], u[0])
    y = wp.lerp(low[1], high[1], u[1])
    rest = 1.0 - x * x - y * y
    if rest > 0.0:
        out.weight = (high[0] - low[0]) * (high[1] - low[1]) * INV_PI
        out.direction = to_world(wp.vec3(x, y, wp.sqrt(rest)), frame)
    return out


@wp.func
def plane_weight(weight: float, visible: float) -> wp.vec3:
    """Return what a direction adds to ``lit`` and to ``unoccluded``."""
    return wp.vec3(weight * visible, weight, 0.0)


@wp.kernel
def trace_receiver(
    pixels: wp.array[int],
    may_see_object: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    spp: int,
    rays: int,
    seed: int,
    lit: wp.array[wp.vec3],
    unoccluded: wp.array[wp.vec3],
    record: LightRecord,
):
    """Sum the radiance of the receiver in white, with and without the object, in each listed pixel.

    Args:
        pixels: Row-major pixel indices, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh.
        light: The light.
        spp: Camera samples per pixel.
        rays: Directions per technique that share one camera sample.
        seed: Base seed.
        lit: Mean radiance with the object over the samples that see the receiver. Where a mesh ends
            within a pixel, what is open there loses nothing.
        unoccluded: The same without the object.
        record: Output: the weights of each direction in both, or without arrays.
    """
    i = wp.tid()
    keep_dark = int(0)
    if record.wi.shape[1] > 0:
        keep_dark = 1
    entries = int(0)
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    sum_lit = wp.vec3(0.0)
    sum_all = wp.vec3(0.0)
    count = float(0.0)
    open_count = float(0.0)
    for s in range(spp):
        point = receiver_point(
            camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
        )
        open_count += float(point.is_open)
        if point.valid == 1:
            count += 1.0
            for r in range(rays):
                x = receiver_sample(
                    mesh, material, texture, receiver, light, point, keep_dark, s * rays + r, key
                )
                from_light = x.radiance_light * x.weight_light
                from_cosine = x.radiance_cosine * x.weight_cosine + x.bounced
                sum_all += from_light + from_cosine
                sum_lit += from_light * x.visible_light + from_cosine * x.visible_cosine
                if keep_dark == 1:
                    weight = plane_weight(x.weight_light, x.visible_light)
                    entries += keep_direction(record, i, entries, x.wi_light, weight)
                    weight = plane_weight(x.weight_cosine, x.visible_cosine)
                    entries += keep_direction(record, i, entries, x.wi_cosine, weight)
    scale = 1.0 / wp.max(count * float(rays), 1.0)
    if open_count > 0.0:
        share = open_count / (count + open_count)
        sum_lit += (sum_all - sum_lit) * share
        for j in range(entries):
            weight = record.weight[i, j]
            weight[0] = weight[0] + (weight[1] - weight[0]) * share
            record.weight[i, j] = weight
    lit[i] = sum_lit * scale
    unoccluded[i] = sum_all * scale
    if keep_dark == 1:
        record.count[i] = entries
        for j in range(entries):
            record.weight[i, j] = record.weight[i, j] * scale
