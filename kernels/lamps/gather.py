"""Light of the lamps at a vertex of a path: a direction drawn from them, and the BSDF's.

It comes beside the light at infinity (`warpir.kernels.scatter`): each lamp is an integral of its
own, whose two techniques are combined with the power heuristic. Lamps block nothing and no camera
sees them. The ground plane keeps their light from what is on its other side, which light at
infinity may come from. Detached.
"""

import warp as wp

from warpir.kernels.bsdf import Bsdf, bsdf_f
from warpir.kernels.lamps.solid_angle import (
    lamp_along,
    lamps_sample,
    pick_total,
    pick_weight,
)
from warpir.kernels.maths.frame import Frame, to_local
from warpir.kernels.maths.rng import hash_pair, sobol_pair
from warpir.kernels.receiver_mesh import plane_distance, receiver_mesh_hit
from warpir.kernels.sampling import power_heuristic
from warpir.kernels.scatter import BsdfSample
from warpir.kernels.tracing.hit import hit_position, offset_origin
from warpir.kernels.tracing.ray import visibility_within
from warpir.kernels.tracing.surface import Surface
from warpir.kernels.types import LampArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

wp.set_module_options({"enable_backward": False})

LAMP_KEY = wp.constant(wp.uint32(0x9E3779B1))
"""Keeps the lamps' draws apart from those of the light at infinity."""


@wp.struct
class LampLight:
    """Light that a vertex gathers from lamps."""

    whole: wp.vec3
    """Radiance, both techniques."""
    diffuse: wp.vec3
    """The diffuse lobe's part of it."""


@wp.func
def free_distance(receiver: ReceiverArgs, origin: wp.vec3, wi: wp.vec3) -> float:
    """Return how far a ray goes before the receiver's mesh or plane ends it [m]."""
    reach = receiver_mesh_hit(receiver, origin, wi).t
    if wp.dot(receiver.normal, wi) < -1.0e-9:
        reach = wp.min(reach, wp.max(plane_distance(receiver, origin, wi), 0.0))
    return reach


@wp.func
def gather_lamps(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    lamps: LampArgs,
    surface: Surface,
    bsdf: Bsdf,
    frame: Frame,
    sample: BsdfSample,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> LampLight:
    """Draw and trace a direction toward a lamp, and look for lamps along the BSDF's direction.

    Args:
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: Its mesh and plane stand in the lamps' way.
        lamps: The lamps.
        surface: Where light is scattered.
        bsdf: How, toward the camera.
        frame: Of the shading normal.
        sample: The BSDF's direction, with the closest hit along it.
        index: Of the path.
        key: Of the pixel.
        vertex: Number of the vertex.
    """
    out = LampLight()
    out.whole = wp.vec3(0.0)
    out.diffuse = wp.vec3(0.0)
    total = pick_total(lamps, surface.position)
    if total <= 0.0 or bsdf.wo[2] <= 0.0:
        return out
    own_key = hash_pair(key, LAMP_KEY)
    u_pick = sobol_pair(index, own_key, 2 * vertex)
    drawn = lamps_sample(
        lamps, surface.position, total, sobol_pair(index, own_key, 2 * vertex + 1), u_pick[0]
    )
    wi = to_local(drawn.wi, frame)
    if drawn.valid == 1 and wi[2] > 0.0 and wp.dot(drawn.wi, surface.ng) > 0.0:
        f = bsdf_f(bsdf, wi)
        origin = offset_origin(surface.position, surface.ng, drawn.wi, mesh.epsilon)
        if wp.max(f.diffuse + f.specular) > 0.0:
            weight = wi[2] * power_heuristic(drawn.pdf, f.pdf) / drawn.pdf
            if free_distance(receiver, origin, drawn.wi) < drawn.distance:
                weight = 0.0
            if weight > 0.0:
                weight = weight * visibility_within(
                    mesh, material, texture, origin, drawn.wi, drawn.distance
                )
            arriving = drawn.radiance * weight
            out.whole += wp.cw_mul(f.diffuse + f.specular, arriving)
            out.diffuse += wp.cw_mul(f.diffuse, arriving)

    if sample.cos_over_pdf > 0.0:
        origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
        reach = free_distance(receiver, origin, sample.wi)
        if sample.next.valid == 1:
            reach = wp.min(reach, wp.length(hit_position(mesh, sample.next) - origin))
        for k in range(lamps.count):
            met = lamp_along(lamps, k, surface.position, sample.wi)
            if met.valid == 1 and met.distance < reach:
                pdf = met.pdf * (pick_weight(lamps, k, surface.position) / total)
                weight = sample.cos_over_pdf * power_heuristic(sample.f.pdf, pdf)
                arriving = lamps.radiance[k] * weight
                out.whole += wp.cw_mul(sample.f.diffuse + sample.f.specular, arriving)
                out.diffuse += wp.cw_mul(sample.f.diffuse, arriving)
    return out
