"""The receiver with and without the object: numerator and denominator of the shadow ratio.

``beta = PathTrace(X + P, L, 1) / PathTrace(P, L, 1)`` per channel (DiPIR, eq. 5). In
`trace_receiver` both use the same directions, so the ratio lies in [0, 1] and is exactly 1 where
nothing is blocked, and their noise cancels; `trace_plane_shadow` does so near the object, and else
takes what the object blocks from the light of the open plane, which is the same everywhere. P is
the ground plane and the receiver's mesh, whichever the camera sees first. The mesh shades both
halves: where a wall keeps the sun away the object can take away only what is left, so shadows do
not double. Detached.
"""

from functools import cache

import warp as wp

from warpir.kernels.bsdf import INV_PI, smith_lambda, visible_normal_sample
from warpir.kernels.dielectric.interface import fresnel_dielectric
from warpir.kernels.light_gradient import keep_direction
from warpir.kernels.maths.frame import Frame, basis, to_local, to_world
from warpir.kernels.maths.lanes import lane_sum
from warpir.kernels.maths.rng import pixel_seed, sobol_pair
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
from warpir.kernels.tracing.ray import camera_hit, camera_ray, closest_hit, meets_box, visibility
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

LIGHT_RAYS = wp.constant(2)
"""Directions of the light for each from `object_window` in `trace_plane_shadow`: half shadows hold
most of the noise, and what the light sends there is cheap to draw."""

GROUND_IOR = wp.constant(1.5)
"""Refractive index of a glossy ground's coat [1]."""


@wp.struct
class ReceiverPoint:
    """A point of the receiver that the camera sees."""

    valid: int
    is_open: int
    """1 where a receiver with a mesh ends: the camera sees neither it nor the object."""
    position: wp.vec3
    normal: wp.vec3
    """Unit, toward the side that receives light; of the mesh, toward the camera."""


@wp.func(inline=True)
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


@wp.func(inline=True)
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
    drawn = light_sample(light, sobol_pair(index, key, 2))
    wi = drawn.wi
    cos_i = wp.dot(wi, point.normal)
    out.wi_light = wi
    if cos_i > 0.0 and drawn.pdf > 0.0 and (wp.max(drawn.radiance) > 0.0 or keep_dark == 1):
        pdf = cos_i * INV_PI
        out.weight_light = pdf * power_heuristic(drawn.pdf, pdf) / drawn.pdf
        out.weight_light = out.weight_light * receiver_visibility(receiver, origin, wi)
        out.radiance_light = drawn.radiance
        if meets_box(origin, wi, mesh.low, mesh.high) == 1:
            out.visible_light = visibility(mesh, material, texture, origin, wi)
    wi = to_world(cosine_sample(sobol_pair(index, key, 3)), basis(point.normal))
    cos_i = wp.dot(wi, point.normal)
    out.wi_cosine = wi
    if cos_i > 0.0:
        receiver_hit = receiver_mesh_hit(receiver, origin, wi)
        if receiver_hit.valid == 1:
            out.bounced = receiver_radiance(receiver, receiver_hit)
            u_passing = sobol_pair(index, key, 1)[0]
            hit = closest_hit(mesh, material, texture, origin, wi, receiver_hit.t, 0, u_passing)
            out.visible_cosine = 1.0 - float(hit.valid)
            return out
        Li = light_eval(light, wi)
        if wp.max(Li.radiance) > 0.0 or keep_dark == 1:
            out.weight_cosine = power_heuristic(cos_i * INV_PI, Li.pdf)
            out.radiance_cosine = Li.radiance
            if meets_box(origin, wi, mesh.low, mesh.high) == 1:
                out.visible_cosine = visibility(mesh, material, texture, origin, wi)
    return out


@wp.func(inline=True)
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
class ObjectWindow:
    """A rectangle of the unit disc below a point's hemisphere around what it sees of the object.

    The cosine is even on that disc (Nusselt's analogue), so directions that are drawn from the
    window have the density ``cos / area``.
    """

    frame: Frame
    low: wp.vec2
    high: wp.vec2
    area: float
    is_whole: int
    """1 where the window holds all directions: ``origin`` is near the object."""


@wp.func
def object_window(mesh: MeshArgs, origin: wp.vec3, normal: wp.vec3) -> ObjectWindow:
    """Return the window of a point at ``origin`` with the unit ``normal``.

    The sphere around the object's box covers an ellipse of the disc, or a part of one; the window
    is the rectangle around that, and the square around the disc where ``origin`` is within the
    sphere.
    """
    window = ObjectWindow()
    window.frame = basis(normal)
    window.low = wp.vec2(-1.0, -1.0)
    window.high = wp.vec2(1.0, 1.0)
    window.is_whole = 1
    toward = 0.5 * (mesh.low + mesh.high) - origin
    distance = wp.length(toward)
    radius = 0.5 * wp.length(mesh.high - mesh.low)
    if distance > radius:
        window.is_whole = 0
        # Elevation of the sphere's centre, and half the angle that the sphere covers
        up = wp.clamp(wp.dot(toward, normal) / distance, -1.0, 1.0)
        along = wp.sqrt(1.0 - up * up)
        reach = radius / distance
        spare = wp.sqrt(1.0 - reach * reach)
        if along > 1.0e-4:
            window.frame.x = wp.normalize(toward - normal * (up * distance))
            window.frame.y = wp.cross(normal, window.frame.x)
        low_x = along * spare - up * reach
        if up < 0.0:
            # Of a sphere whose centre is below the horizon, what is seen reaches furthest down at
            # the horizon, where the cosine with the direction to the centre is `spare`.
            low_x = wp.min(low_x, spare / wp.max(along, 1.0e-6))
        window.low = wp.vec2(low_x, -reach)
        window.high = wp.vec2(1.0, reach)
        if up > reach:
            window.high = wp.vec2(along * spare + up * reach, reach)
    sides = window.high - window.low
    window.area = sides[0] * sides[1]
    return window


@wp.struct
class ObjectRay:
    """A direction in which a point of the receiver may see the object."""

    direction: wp.vec3
    weight: float
    """``f cos / pdf`` of white Lambert's ``f``, or of the coat's; 0 where there is no direction."""


@wp.func
def object_ray(window: ObjectWindow, u: wp.vec2) -> ObjectRay:
    """Draw a direction from the window, in proportion to its cosine."""
    out = ObjectRay()
    out.weight = 0.0
    x = wp.lerp(window.low[0], window.high[0], u[0])
    y = wp.lerp(window.low[1], window.high[1], u[1])
    rest = 1.0 - x * x - y * y
    if rest > 0.0:
        out.weight = window.area * INV_PI
        out.direction = to_world(wp.vec3(x, y, wp.sqrt(rest)), window.frame)
    return out


@wp.func
def mirrored_ray(normal: wp.vec3, wo: wp.vec3, alpha: float, u: wp.vec2) -> ObjectRay:
    """Draw a direction that a coat reflects toward ``wo``, by its visible GGX normals.

    The weight is ``F G2 / G1`` (Heitz 2018, "Sampling the GGX Distribution of Visible Normals",
    eq. 19). With an ``alpha`` of 0 the direction is the mirror's, and the weight ``F``.
    """
    out = ObjectRay()
    out.weight = 0.0
    frame = basis(normal)
    o = to_local(wo, frame)
    if o[2] > 0.0:
        wm = visible_normal_sample(o, alpha, u)
        cos_d = wp.dot(o, wm)
        wi = wm * (2.0 * cos_d) - o
        if wi[2] > 0.0:
            masked = 1.0 + smith_lambda(o, alpha)
            out.weight = (
                fresnel_dielectric(cos_d, GROUND_IOR) * masked / (masked + smith_lambda(wi, alpha))
            )
            out.direction = to_world(wi, frame)
    return out


@wp.func
def plane_weight(weight: float, visible: float) -> wp.vec3:
    """Return what a direction adds to ``lit`` and to ``unoccluded``."""
    return wp.vec3(weight * visible, weight, 0.0)


# On an H200 12.8 ms for 256 samples of a ball's shadow, in place of 20.4 with as many registers as
# the compiler likes; 13.8 with 128.
@wp.kernel(module="unique", enable_backward=False, cuda_max_registers=64)
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
    lanes: int,
    seed: int,
    lit: wp.array[wp.vec3],
    unoccluded: wp.array[wp.vec3],
    record: LightRecord,
):
    """Sum the radiance of the receiver in white, with and without the object, in each listed pixel.

    Indices are the pixel's row and one of its ``lanes`` threads, which share its samples.

    Args:
        pixels: Row-major pixel indices, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver: plane and mesh.
        light: The light.
        spp: Camera samples per thread.
        rays: Directions per technique that share one camera sample.
        lanes: Threads per pixel (`warpir.kernels.maths.lanes`).
        seed: Base seed.
        lit: Mean radiance with the object over the samples that see the receiver. Where a mesh ends
            within a pixel, what is open there loses nothing.
        unoccluded: The same without the object.
        record: Output: the weights of each direction in both, a row a thread, or without arrays.
    """
    i, lane = wp.tid()
    row = i * lanes + lane
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
    for s in range(lane * spp, (lane + 1) * spp):
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
                    entries += keep_direction(record, row, entries, x.wi_light, weight)
                    weight = plane_weight(x.weight_cosine, x.visible_cosine)
                    entries += keep_direction(record, row, entries, x.wi_cosine, weight)
    counts = lane_sum(wp.vec3(count, open_count, 0.0), lanes)
    sum_lit = lane_sum(sum_lit, lanes)
    sum_all = lane_sum(sum_all, lanes)
    scale = 1.0 / wp.max(counts[0] * float(rays), 1.0)
    share = float(0.0)
    if counts[1] > 0.0:
        share = counts[1] / (counts[0] + counts[1])
        sum_lit += (sum_all - sum_lit) * share
    if lane == 0:
        lit[i] = sum_lit * scale
        unoccluded[i] = sum_all * scale
    if keep_dark == 1:
        record.count[row] = entries
        for j in range(entries):
            weight = record.weight[row, j] * scale
            weight[0] = weight[0] + (weight[1] - weight[0]) * share
            record.weight[row, j] = weight


@cache
def plane_shadow_kernel(has_passing: bool) -> wp.Kernel:
    """Return `trace_plane_shadow` for objects with or without triangles that may let rays pass.

    They alone have the code for it, whose registers slow down the others by 7 % on an H200.
    """

    # On an H200 more threads at a time are worth more than registers: 8.5 ms for 128 samples of a
    # ball's shadow in place of 10.6 with 128 registers, 9.7 in place of 10.0 for a car with glass,
    # which takes 10.5 with 64.
    @wp.kernel(module="unique", enable_backward=False, cuda_max_registers=80)
    def trace_plane_shadow(
        pixels: wp.array[int],
        may_see_object: wp.array[int],
        camera: CameraArgs,
        mesh: MeshArgs,
        material: MaterialArgs,
        texture: TextureArgs,
        receiver: ReceiverArgs,
        light: LightArgs,
        open_radiance: wp.vec3,
        spp: int,
        rays: int,
        lanes: int,
        seed: int,
        lit: wp.array[wp.vec3],
        unoccluded: wp.array[wp.vec3],
    ):
        """Do what `trace_receiver` does, for a plane without a mesh, where no gradient is asked.

        Indices are the pixel's row and one of its ``lanes`` threads, which share its samples.

        What the open plane receives is the same everywhere, and the object takes a part of it: each
        sample draws `LIGHT_RAYS` directions from the light times the cosine and one from
        `object_window`, looks what light the object blocks there, and combines them with the power
        heuristic. Near the object, where the window holds all directions, the same directions say
        what both sums are, whose noise cancels in the ratio.

        Args:
            pixels: Row-major pixel indices, shape [receiver_pixel].
            may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
            camera: The view.
            mesh: The object's triangles.
            material: Their materials.
            texture: Their textures.
            receiver: The plane.
            light: The light, its directions drawn for the plane.
            open_radiance: Radiance of the plane without the object.
            spp: Camera samples per thread.
            rays: Directions from the window that share one camera sample.
            lanes: Threads per pixel (`warpir.kernels.maths.lanes`).
            seed: Base seed.
            lit: Mean radiance with the object over the samples that see the plane.
            unoccluded: The same without the object.
        """
        if wp.static(not has_passing):
            mesh.passing = wp.uint64(0)
            mesh.embree_passing = wp.uint64(0)
        i, lane = wp.tid()
        pixel = pixels[i]
        key = pixel_seed(seed, pixel)
        light_rays = float(LIGHT_RAYS)
        lit_near = wp.vec3(0.0)
        open_near = wp.vec3(0.0)
        lost_far = wp.vec3(0.0)
        far = float(0.0)
        count = float(0.0)
        for s in range(lane * spp, (lane + 1) * spp):
            point = receiver_point(
                camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
            )
            if point.valid == 1:
                count += float(rays)
                origin = receiver_origin(mesh, receiver, point)
                window = object_window(mesh, origin, point.normal)
                near = float(window.is_whole)
                far += (1.0 - near) * float(rays)
                for r in range(s * rays * LIGHT_RAYS, (s + 1) * rays * LIGHT_RAYS):
                    drawn = light_sample(light, sobol_pair(r, key, 2))
                    cos_i = wp.dot(drawn.wi, point.normal)
                    if cos_i > 0.0 and drawn.pdf > 0.0:
                        dark = float(0.0)
                        if meets_box(origin, drawn.wi, mesh.low, mesh.high) == 1:
                            dark = 1.0 - visibility(mesh, material, texture, origin, drawn.wi)
                        pdf = light_rays * drawn.pdf
                        share = power_heuristic(pdf, cos_i / window.area)
                        value = drawn.radiance * (cos_i * INV_PI * share / pdf)
                        open_near += value * near
                        lit_near += value * (near * (1.0 - dark))
                        lost_far += value * ((1.0 - near) * dark)
                for r in range(s * rays, (s + 1) * rays):
                    ray = object_ray(window, sobol_pair(r, key, 3))
                    if ray.weight > 0.0:
                        dark = float(0.0)
                        if meets_box(origin, ray.direction, mesh.low, mesh.high) == 1:
                            dark = 1.0 - visibility(mesh, material, texture, origin, ray.direction)
                        if dark > 0.0 or window.is_whole == 1:
                            Li = light_eval(light, ray.direction)
                            pdf = wp.dot(ray.direction, point.normal) / window.area
                            share = power_heuristic(pdf, light_rays * Li.pdf)
                            value = Li.radiance * (ray.weight * share)
                            open_near += value * near
                            lit_near += value * (near * (1.0 - dark))
                            lost_far += value * ((1.0 - near) * dark)
        lit_near = lane_sum(lit_near, lanes)
        open_near = lane_sum(open_near, lanes)
        lost_far = lane_sum(lost_far, lanes)
        counts = lane_sum(wp.vec3(count, far, 0.0), lanes)
        if lane > 0:
            return
        count = wp.max(counts[0], 1.0)
        far = counts[1]
        open_far = wp.vec3(0.0)
        if far > 0.0:
            open_far = open_radiance * far
        left_far = open_far - lost_far
        for c in range(3):
            # What noise takes beyond the whole is not there to be taken; a NaN stays one.
            if left_far[c] < 0.0:
                left_far[c] = 0.0
        lit[i] = (lit_near + left_far) / count
        unoccluded[i] = (open_near + open_far) / count

    return trace_plane_shadow
