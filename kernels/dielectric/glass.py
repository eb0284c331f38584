"""One scattering event at solid glass: light drawn and weighed, a ray refracted or reflected.

Shadow rays between the vertices of a path stop at solid glass, so the light behind it is found by
the rays that go on alone: at a smooth interface with their whole weight, at a rough one by the
power heuristic with the light's proposal. Where a ray that leaves the glass meets the ground or the
receiver's mesh it takes the photo's radiance, a constant to the light. The inside is where the
triangles' normals point away from. Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.dielectric.interface import (
    Interface,
    interface_f,
    interface_sample,
    is_smooth,
)
from warpir.kernels.lamps.gather import free_distance
from warpir.kernels.lamps.solid_angle import lamp_along
from warpir.kernels.maths.frame import basis, to_local, to_world
from warpir.kernels.maths.rng import hash_pair, sobol_pair, to_unit
from warpir.kernels.receiver_mesh import (
    ReceiverHit,
    photo_at,
    plane_distance,
    receiver_mesh_hit,
    receiver_radiance,
    receiver_visibility,
)
from warpir.kernels.sampling import light_eval, light_sample, power_heuristic
from warpir.kernels.scatter import BsdfSample, EmitterSample, Scatter, arrival_bin
from warpir.kernels.tracing.hit import Hit, face_normal, hit_position, offset_origin
from warpir.kernels.tracing.ray import closest_hit, visibility
from warpir.kernels.tracing.surface import Surface
from warpir.kernels.tracing.texture import SLOT_TRANSMISSION, sample_texture, slot_uv
from warpir.kernels.types import (
    GlassArgs,
    LampArgs,
    LightArgs,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

GLASS_DEPTH = wp.constant(64)
"""Interfaces and other surfaces that a path in a scene with solid glass meets at most."""
GLASS_KEY = wp.constant(wp.uint32(0x7F4A7C15))
"""Keeps the draws of glass or not apart from the others."""


@wp.struct
class GlassPoint:
    """Solid glass at a point of a surface, as seen from ``wo``."""

    share: float
    """Share of the material there that is solid glass [1]; 0: none, and nothing else is set."""
    eta: float
    """Index of refraction beyond the interface over that on the side of ``wo``."""
    side: float
    """1 where ``wo`` is outside, else -1."""


@wp.func
def glass_at(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    glass: GlassArgs,
    hit: Hit,
    metallic: float,
    wo: wp.vec3,
) -> GlassPoint:
    """Return the solid glass at a hit, whose material is ``metallic`` there."""
    point = GlassPoint()
    m = mesh.face_material[hit.face]
    point.share = glass.share[m] * (1.0 - metallic)
    if point.share > 0.0:
        k = material.slot_texture[m, SLOT_TRANSMISSION]
        if k >= 0:
            uv = slot_uv(mesh, material, m, SLOT_TRANSMISSION, hit)
            point.share *= sample_texture(texture, k, uv, 0)[0]
        point.eta = glass.ior[m]
        point.side = 1.0
        if wp.dot(face_normal(mesh, hit.face), wo) < 0.0:
            point.eta = 1.0 / point.eta
            point.side = -1.0
    return point


@wp.func
def meets_glass(point: GlassPoint, index: int, key: wp.uint32, vertex: int) -> int:
    """Draw whether a path is scattered by the glass of a point (1) or by what else is there (0)."""
    own_key = hash_pair(hash_pair(key, GLASS_KEY), wp.uint32(index))
    if point.share > 0.0 and to_unit(hash_pair(own_key, wp.uint32(vertex))) < point.share:
        return 1
    return 0


@wp.func
def metallic_beside(metallic: float, point: GlassPoint) -> float:
    """Return the metal's share of a material without its glass [1]."""
    if point.share > 0.0:
        return metallic / (1.0 - point.share)
    return metallic


@wp.func
def interface_of(surface: Surface, eta: float, wo: wp.vec3) -> Interface:
    """Return a surface as an interface; ``wo`` is in the frame of its normal."""
    interface = Interface()
    interface.wo = wo
    interface.eta = eta
    interface.alpha = surface.roughness * surface.roughness
    interface.tint = surface.base_color
    return interface


@wp.func
def receiver_start(
    mesh: MeshArgs, receiver: ReceiverArgs, surface: Surface, point: GlassPoint, wi: wp.vec3
) -> wp.vec3:
    """Return where a ray starts that looks for the receiver's mesh.

    Out of the glass it starts inside, so that it meets a mesh on which the glass stands.
    """
    origin = offset_origin(surface.position, surface.ng, wi, mesh.epsilon)
    if point.side * wp.dot(wi, surface.ng) > 0.0:
        return origin - surface.ng * (point.side * 2.0 * (receiver.tolerance + mesh.epsilon))
    return origin


@wp.func
def glass_emitter(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    surface: Surface,
    point: GlassPoint,
    interface: Interface,
    u: wp.vec2,
    keep_dark: int,
) -> EmitterSample:
    """Draw a direction from the light's proposal at a rough interface, weigh it and trace it.

    ``f.specular`` of the result holds the cosine. Where the ground is in the way, the light of that
    direction counts only if the photo does not show the place.
    """
    sample = EmitterSample()
    sample.valid = 0
    sample.L = wp.vec3(0.0)
    sample.weight = 0.0
    if is_smooth(interface):
        return sample
    drawn = light_sample(light, u)
    sample.wi = drawn.wi
    wi = to_local(drawn.wi, basis(surface.n))
    value = interface_f(interface, wi)
    # A direction counts only if it is on the same side of the shading and the geometric surface.
    if value[3] > 0.0 and wi[2] * wp.dot(drawn.wi, surface.ng) > 0.0:
        if drawn.pdf > 0.0 and (wp.max(drawn.radiance) > 0.0 or keep_dark == 1):
            origin = offset_origin(surface.position, surface.ng, drawn.wi, mesh.epsilon)
            weight = power_heuristic(drawn.pdf, value[3]) / drawn.pdf
            visible = visibility(mesh, material, texture, origin, drawn.wi)
            start = receiver_start(mesh, receiver, surface, point, drawn.wi)
            visible = visible * receiver_visibility(receiver, start, drawn.wi)
            if visible > 0.0 and receiver.shines == 1:
                visible = visible * (1.0 - photo_behind(receiver, origin, drawn.wi)[3])
            sample.valid = 1
            sample.f.diffuse = wp.vec3(0.0)
            sample.f.specular = wp.vec3(value[0], value[1], value[2])
            sample.f.pdf = value[3]
            sample.bin = arrival_bin(drawn.wi, drawn.pdf)
            sample.L = drawn.radiance
            sample.visible = visible
            sample.weight = weight * visible
    return sample


@wp.func
def glass_direction(
    surface: Surface, eta: float, wo: wp.vec3, u: wp.vec2, part: float
) -> BsdfSample:
    """Draw the direction in which a path goes on from an interface.

    ``f.specular`` of the result is ``f |cos| / pdf``. Where a smooth interface's shading normal
    sends light to the wrong side of the triangle, the triangle's own normal takes its place.
    """
    out = BsdfSample()
    out.cos_over_pdf = 0.0
    n = surface.n
    for attempt in range(2):
        frame = basis(n)
        interface = interface_of(surface, eta, to_local(wo, frame))
        if interface.wo[2] > 0.0 and (attempt == 0 or is_smooth(interface)):
            drawn = interface_sample(interface, u, part)
            out.wi = to_world(drawn.wi, frame)
            if wp.max(drawn.weight) > 0.0 and drawn.wi[2] * wp.dot(out.wi, surface.ng) > 0.0:
                out.f.diffuse = wp.vec3(0.0)
                out.f.specular = drawn.weight
                out.f.pdf = drawn.pdf
                out.cos_over_pdf = 1.0
                return out
        n = surface.ng
    return out


@wp.func
def plane_behind(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> ReceiverHit:
    """Find where a ray off the glass meets the ground plane; at once where it starts below it."""
    hit = ReceiverHit()
    hit.valid = 0
    hit.t = 1.0e30
    if wp.dot(receiver.normal, direction) < -1.0e-9:
        hit.valid = 1
        hit.t = wp.max(plane_distance(receiver, origin, direction), 0.0)
        p = origin + direction * hit.t
        hit.position = p - receiver.normal * (wp.dot(receiver.normal, p) - receiver.offset)
        hit.normal = receiver.normal
    return hit


@wp.func
def photo_behind(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> wp.vec4:
    """Return what the photo shows where a ray off the glass meets the ground plane (`photo_at`)."""
    hit = plane_behind(receiver, origin, direction)
    if hit.valid == 0 or receiver.shines == 0:
        return wp.vec4(0.0, 0.0, 0.0, 0.0)
    return photo_at(receiver, hit)


@wp.func
def photo_between(receiver: ReceiverArgs, hit: ReceiverHit) -> wp.vec4:
    """Do `photo_at`, interpolated between the middles of pixels: glass may magnify them."""
    seen = photo_at(receiver, hit)
    if seen[3] > 0.0:
        q = receiver.to_image * (hit.position - receiver.eye)
        x = wp.clamp(q[0] / q[2] - 0.5, 0.0, float(receiver.radiance.shape[1] - 1))
        y = wp.clamp(q[1] / q[2] - 0.5, 0.0, float(receiver.radiance.shape[0] - 1))
        j = int(wp.floor(x))
        i = int(wp.floor(y))
        right = wp.min(j + 1, receiver.radiance.shape[1] - 1)
        below = wp.min(i + 1, receiver.radiance.shape[0] - 1)
        u = x - float(j)
        upper = wp.lerp(receiver.radiance[i, j], receiver.radiance[i, right], u)
        lower = wp.lerp(receiver.radiance[below, j], receiver.radiance[below, right], u)
        color = wp.lerp(upper, lower, y - float(i))
        return wp.vec4(color[0], color[1], color[2], 1.0)
    return seen


@wp.func
def slack(receiver: ReceiverArgs, hit: ReceiverHit, direction: wp.vec3) -> float:
    """Return how far behind a hit the object's surface still counts as lying on the receiver [m].

    Glass that stands on the ground ends in it.
    """
    if hit.valid == 0:
        return 0.0
    return receiver.tolerance / wp.max(-wp.dot(hit.normal, direction), 1.0e-6)


@wp.func
def lamps_along(
    mesh: MeshArgs, receiver: ReceiverArgs, lamps: LampArgs, surface: Surface, sample: BsdfSample
) -> wp.vec3:
    """Return the radiance of lamps in front of what the ray meets; no lamp is drawn from glass."""
    found = wp.vec3(0.0)
    origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
    reach = free_distance(receiver, origin, sample.wi)
    if sample.next.valid == 1:
        reach = wp.min(reach, wp.length(hit_position(mesh, sample.next) - origin))
    for k in range(lamps.count):
        met = lamp_along(lamps, k, surface.position, sample.wi)
        if met.valid == 1 and met.distance < reach:
            found += lamps.radiance[k]
    return found


@wp.func
def trace_from_glass(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    surface: Surface,
    point: GlassPoint,
    drawn: BsdfSample,
    u_passing: float,
) -> Scatter:
    """Trace a drawn direction: to the object, else to what the photo shows, else to the light.

    ``u_passing`` is the number of `closest_hit`.
    """
    out = Scatter()
    sample = drawn
    origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
    start = receiver_start(mesh, receiver, surface, point, sample.wi)
    wall = receiver_mesh_hit(receiver, start, sample.wi)
    ground = plane_behind(receiver, origin, sample.wi)
    reach = wall.t + slack(receiver, wall, sample.wi)
    shown = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if ground.t < wall.t and receiver.shines == 1:
        shown = photo_between(receiver, ground)
        if shown[3] > 0.0:
            reach = wp.min(reach, ground.t + slack(receiver, ground, sample.wi))
    sample.next = closest_hit(mesh, material, texture, origin, sample.wi, reach, 0, u_passing)
    if shown[3] == 0.0 and wall.valid == 1 and receiver.shines == 1:
        shown = photo_between(receiver, wall)
    out.weight_bsdf = 0.0
    if sample.next.valid == 0:
        out.weight_bsdf = 1.0
        if shown[3] > 0.0:
            sample.from_receiver = 1
            out.L_bsdf = wp.vec3(shown[0], shown[1], shown[2])
        elif wall.valid == 1:
            sample.from_receiver = 1
            out.L_bsdf = receiver_radiance(receiver, wall)
        else:
            sample.visible = 1.0
            Li = light_eval(light, sample.wi)
            out.L_bsdf = Li.radiance
            if sample.f.pdf > 0.0:
                out.weight_bsdf = power_heuristic(sample.f.pdf, Li.pdf)
    out.bsdf = sample
    return out


@wp.func
def scatter_at_glass(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    lamps: LampArgs,
    surface: Surface,
    point: GlassPoint,
    wo: wp.vec3,
    keep_dark: int,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> Scatter:
    """Draw, weigh and trace the two directions at a vertex on solid glass; see `path.scatter`."""
    interface = interface_of(surface, point.eta, to_local(wo, basis(surface.n)))
    u_parts = sobol_pair(index, key, 3 * vertex + 1)
    u = sobol_pair(index, key, 3 * vertex + 2)
    emitter = glass_emitter(
        mesh,
        material,
        texture,
        receiver,
        light,
        surface,
        point,
        interface,
        u,
        keep_dark,
    )
    u = sobol_pair(index, key, 3 * vertex + 3)
    drawn = glass_direction(surface, point.eta, wo, u, u_parts[1])
    out = Scatter()
    if drawn.cos_over_pdf > 0.0:
        out = trace_from_glass(
            mesh, material, texture, receiver, light, surface, point, drawn, u_parts[0]
        )
        out.direct = wp.cw_mul(drawn.f.specular, out.L_bsdf) * out.weight_bsdf
        if lamps.count > 0:
            near = lamps_along(mesh, receiver, lamps, surface, out.bsdf)
            out.direct += wp.cw_mul(drawn.f.specular, near)
        if out.bsdf.next.valid == 1:
            out.throughput = drawn.f.specular
    out.emitter = emitter
    if emitter.valid == 1:
        out.direct += wp.cw_mul(emitter.f.specular, emitter.L) * emitter.weight
    return out


@wp.func
def transmittance(
    mesh: MeshArgs, glass: GlassArgs, surface: Surface, point: GlassPoint, sample: BsdfSample
) -> wp.vec3:
    """Return the share of light that is left after the way to the next hit (Beer-Lambert) [1].

    The way is inside a body if it starts behind its surface, or ends there after it started at
    something inside it. A ray that never leaves an open mesh is not dimmed.
    """
    m = mesh.face_material[sample.next.face]
    if point.share > 0.0 and point.side * wp.dot(sample.wi, surface.ng) < 0.0:
        m = surface.material
    elif glass.share[m] == 0.0 or wp.dot(face_normal(mesh, sample.next.face), sample.wi) < 0.0:
        return wp.vec3(1.0)
    way = wp.length(hit_position(mesh, sample.next) - surface.position)
    absorbed = glass.absorption[m] * way
    return wp.vec3(wp.exp(-absorbed[0]), wp.exp(-absorbed[1]), wp.exp(-absorbed[2]))
