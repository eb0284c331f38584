"""Derivatives of radiance to the place of a lamp, by directions on its rim.

Seen from a point, a lamp is a patch of directions of one radiance. Along a fixed direction nothing
depends on the lamp's place, so the derivative of ``integral of f V L cos`` over the patch is an
integral over its border alone: of the same integrand times the speed at which the border moves
outward (Reynolds' transport theorem). A point of the border ``t`` metres away moves outward by
``n . dc / t``, where ``n`` is the border's normal on the sphere of directions. Edges of shadows
need no terms of their own: they stand still in the patch. Left out: where a surface touches the
lamp, and solid glass, through which no direction can be drawn. Detached.
"""

import warp as wp

from warpir.kernels.bsdf import INV_PI, Bsdf, bsdf_f
from warpir.kernels.lamps.gather import free_distance
from warpir.kernels.lamps.solid_angle import rectangle_seen
from warpir.kernels.maths.frame import Frame, basis, to_local, to_world
from warpir.kernels.maths.rng import hash_pair, pixel_seed, sobol_pair
from warpir.kernels.receiver import (
    object_ray,
    object_window,
    receiver_origin,
    receiver_point,
)
from warpir.kernels.receiver_mesh import receiver_mesh_hit
from warpir.kernels.scatter import sample_bsdf, surface_bsdf
from warpir.kernels.tracing.hit import Hit, offset_origin
from warpir.kernels.tracing.ray import camera_hit, camera_ray, closest_hit, visibility_within
from warpir.kernels.tracing.surface import Surface, surface_at
from warpir.kernels.types import (
    CameraArgs,
    LampArgs,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

RIM_KEY = wp.constant(wp.uint32(0x85EBCA6B))
"""Keeps the draws on rims apart from all others."""


@wp.struct
class RimPoint:
    """A point of a lamp's outline as another point sees it."""

    valid: int
    wi: wp.vec3
    """Toward it."""
    distance: float
    """To it [m]."""
    speed: wp.vec3
    """Outward speed of the border per metre that the lamp moves, over the density of the draw
    [sr/m]."""


@wp.func
def rim_point(lamps: LampArgs, k: int, p: wp.vec3, u: wp.vec2) -> RimPoint:
    """Draw a point of the outline of lamp ``k``: of a circle, or of four edges."""
    out = RimPoint()
    out.valid = 0
    v = lamps.center[k] - p
    if lamps.is_rectangle[k] == 0:
        square = wp.dot(v, v)
        r = lamps.radius[k]
        if square <= r * r:
            return out  # it fills all directions
        away = wp.sqrt(square)
        sine = r / away
        out.distance = wp.sqrt((away - r) * (away + r))
        cosine = out.distance / away
        phi = wp.TAU * u[0]
        across = wp.vec3(wp.cos(phi), wp.sin(phi), 0.0)
        frame = basis(v / away)
        out.wi = wp.normalize(to_world(across * sine + wp.vec3(0.0, 0.0, cosine), frame))
        outward = to_world(across * cosine - wp.vec3(0.0, 0.0, sine), frame)
        out.speed = outward * (wp.TAU * sine / out.distance)
        out.valid = 1
        return out
    if rectangle_seen(lamps, k, p).z0 == 0.0:
        return out
    ex = lamps.edge_x[k]
    ey = lamps.edge_y[k]
    edge = int(4.0 * u[0])
    start = v
    along = ex
    if edge == 1:
        start = v + ex
        along = ey
    elif edge == 2:
        start = v + ex + ey
        along = -ex
    elif edge >= 3:
        start = v + ey
        along = -ey
    x = start + along * u[1]
    out.distance = wp.length(x)
    out.wi = x / out.distance
    # Of the front, edges run clockwise: the cross product points away from the middle.
    cube = out.distance * out.distance * out.distance
    out.speed = wp.cross(along, start) * (-4.0 / cube)
    out.valid = 1
    return out


@wp.func
def across(u: wp.vec2, j: int) -> wp.vec2:
    """Return the draw of a rim point (``j`` = 0) or of that across the lamp (1).

    The speeds of both nearly cancel: alone, their noise grows as one over the lamp's size.
    """
    if j == 0:
        return u
    return wp.vec2(u[0] + wp.where(u[0] < 0.5, 0.5, -0.5), 1.0 - u[1])


@wp.func
def rim_gain(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    lamps: LampArgs,
    surface: Surface,
    bsdf: Bsdf,
    frame: Frame,
    throughput: wp.vec3,
    u: wp.vec2,
) -> wp.mat33:
    """Return what a vertex adds to the derivative of its path's radiance, [axis, channel]."""
    total = wp.mat33(0.0)
    for j in range(2):
        rim = rim_point(lamps, 0, surface.position, across(u, j))
        wi = to_local(rim.wi, frame)
        if rim.valid == 1 and wi[2] > 0.0 and wp.dot(rim.wi, surface.ng) > 0.0 and bsdf.wo[2] > 0.0:
            f = bsdf_f(bsdf, wi)
            arriving = wp.cw_mul(throughput, wp.cw_mul(f.diffuse + f.specular, lamps.radiance[0]))
            origin = offset_origin(surface.position, surface.ng, rim.wi, mesh.epsilon)
            if wp.max(arriving) > 0.0 and free_distance(receiver, origin, rim.wi) >= rim.distance:
                seen = visibility_within(mesh, material, texture, origin, rim.wi, rim.distance)
                total += wp.outer(rim.speed, arriving * (0.5 * wi[2] * seen))
    return total


@wp.kernel
def trace_places(
    pixels: wp.array[int],
    may_see_object: wp.array[int],
    from_ground: int,
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    lamps: LampArgs,
    spp: int,
    depth: int,
    seed: int,
    slope: wp.array[wp.mat33],
):
    """Path-trace the derivative of the object's radiance to the first lamp's place.

    Paths are those of `warpir.kernels.path`, each with two directions on the rim at every vertex.

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        may_see_object: From the ground: 1 where the object may hide the receiver, shape [pixel].
        from_ground: 1: of what the object throws on the white receiver; 0: of what it shows.
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: Its plane and mesh stand in the lamp's way.
        lamps: The lamp.
        spp: Paths per pixel.
        depth: Surface interactions, that with the receiver included.
        seed: Base seed.
        slope: Derivative [1/m], axis by channel, shape [pixel].
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    rim_key = hash_pair(key, RIM_KEY)
    receiver.is_solid = from_ground
    receiver.shines = 0
    total = wp.mat33(0.0)
    count = float(0.0)
    for s in range(spp):
        hit = Hit()
        hit.valid = 0
        wo = wp.vec3(0.0)
        throughput = wp.vec3(1.0)
        if from_ground == 1:
            point = receiver_point(
                camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
            )
            count += float(point.valid + point.is_open)
            if point.valid == 1:
                origin = receiver_origin(mesh, receiver, point)
                ray = object_ray(object_window(mesh, origin, point.normal), sobol_pair(s, key, 3))
                if ray.weight > 0.0:
                    reach = receiver_mesh_hit(receiver, origin, ray.direction).t
                    u_passing = sobol_pair(s, key, 1)[0]
                    hit = closest_hit(
                        mesh, material, texture, origin, ray.direction, reach, 0, u_passing
                    )
                wo = -ray.direction
                throughput = wp.vec3(ray.weight)
        else:
            count += 1.0
            direction = camera_ray(camera, pixel, sobol_pair(s, key, 0))
            hit = camera_hit(camera, mesh, material, texture, receiver, s, key, direction)
            wo = -direction
        k = int(from_ground)
        while hit.valid == 1 and k < depth:
            surface = surface_at(mesh, material, texture, hit, wo)
            frame = basis(surface.n)
            bsdf = surface_bsdf(surface, wo, frame)
            total += rim_gain(
                mesh, material, texture, receiver, lamps, surface, bsdf, frame, throughput,
                sobol_pair(s, rim_key, k),
            )  # fmt: skip
            sample = sample_bsdf(
                mesh, material, texture, receiver, surface, bsdf, frame,
                sobol_pair(s, key, 3 * k + 3), sobol_pair(s, key, 3 * k + 1), 0,
            )  # fmt: skip
            hit = sample.next
            f = sample.f.diffuse + sample.f.specular
            throughput = wp.cw_mul(throughput, f * sample.cos_over_pdf)
            wo = -sample.wi
            k += 1
    slope[i] = total * (1.0 / wp.max(count, 1.0))


@wp.kernel
def trace_ground_places(
    pixels: wp.array[int],
    may_see_object: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    lamps: LampArgs,
    spp: int,
    seed: int,
    lit: wp.array[wp.mat33],
    unoccluded: wp.array[wp.mat33],
):
    """Sum the derivatives of what `warpir.kernels.lamps.receiver.trace_lamps` sums.

    Args:
        pixels: Row-major pixel indices, shape [receiver_pixel].
        may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
        camera: The view.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: Plane and mesh, which shades both halves.
        lamps: The lamp.
        spp: Camera samples per pixel, each with two directions on the rim.
        seed: Base seed.
        lit: With the object [1/m], axis by channel, shape [receiver_pixel].
        unoccluded: Without it.
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    rim_key = hash_pair(key, RIM_KEY)
    sum_lit = wp.mat33(0.0)
    sum_all = wp.mat33(0.0)
    count = float(0.0)
    open_count = float(0.0)
    for s in range(spp):
        point = receiver_point(
            camera, mesh, material, texture, receiver, pixel, may_see_object[i], s, key
        )
        open_count += float(point.is_open)
        if point.valid == 1:
            count += 1.0
            origin = receiver_origin(mesh, receiver, point)
            for j in range(2):
                u = across(sobol_pair(s, rim_key, 0), j)
                rim = rim_point(lamps, 0, point.position, u)
                cos_i = wp.dot(rim.wi, point.normal)
                if rim.valid == 1 and cos_i > 0.0:
                    if free_distance(receiver, origin, rim.wi) >= rim.distance:
                        gained = wp.outer(rim.speed, lamps.radiance[0] * (0.5 * cos_i * INV_PI))
                        sum_all += gained
                        sum_lit += gained * visibility_within(
                            mesh, material, texture, origin, rim.wi, rim.distance
                        )
    if open_count > 0.0:
        sum_lit += (sum_all - sum_lit) * (open_count / (count + open_count))
    scale = 1.0 / wp.max(count, 1.0)
    lit[i] = sum_lit * scale
    unoccluded[i] = sum_all * scale
