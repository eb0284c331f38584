"""One scattering event of a path: a direction toward the emitter, and one drawn from the BSDF.

Both techniques are shared by the path tracer (`warpir.kernels.path`), which adds radiance up, and
the tracer of light transport (`warpir.kernels.transport`), which adds to the texels that the
directions meet. They are combined with the power heuristic. A direction counts only if it leaves
both the shading and the geometric surface. Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.bsdf import Bsdf, BsdfValue, bsdf_f, bsdf_of, bsdf_sample
from warpir.kernels.maths.frame import Frame, to_local, to_world
from warpir.kernels.maths.rng import sobol_pair
from warpir.kernels.receiver_mesh import receiver_hit, receiver_radiance, sky_visibility
from warpir.kernels.sampling import light_sample, power_heuristic
from warpir.kernels.tracing.hit import Hit, offset_origin
from warpir.kernels.tracing.ray import closest_hit, visibility
from warpir.kernels.tracing.surface import Surface
from warpir.kernels.types import LightArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

wp.set_module_options({"enable_backward": False})


@wp.struct
class EmitterSample:
    """A direction drawn from the light's proposal; what it brings is 0 where it does not count."""

    valid: int
    """1 where value, radiance and weight are set."""
    wi: wp.vec3
    """World frame."""
    f: BsdfValue
    L: wp.vec3
    """Radiance from there."""
    weight: float
    """``cos visible mis / pdf``, without f."""
    visible: float
    """Share of light from infinity that arrives along it; ``weight`` has it."""
    all_open: wp.vec3
    """What all candidates would bring if nothing stood in the light's way [radiance]."""
    all_open_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    picked_open: wp.vec3
    """What this direction, in the name of all, would bring if nothing stood in the light's way."""
    picked_open_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    most_open: wp.vec3
    """The most that ``picked_open`` could have been, by channel."""


@wp.struct
class BsdfSample:
    """A direction drawn from the BSDF, and what it met."""

    wi: wp.vec3
    """World frame."""
    f: BsdfValue
    cos_over_pdf: float
    visible: float
    """Share of light from infinity that arrives along it."""
    from_receiver: int
    """1 when it met the receiver's mesh: what that sends is a constant to the light."""
    L_receiver: wp.vec3
    """Radiance of that mesh."""
    next: Hit
    """Where it met the object, and the path goes on."""


@wp.struct
class Scatter:
    """One scattering event: both light estimates, and how the path goes on."""

    direct: wp.vec3
    """Light gathered here, both techniques [radiance]."""
    direct_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    throughput: wp.vec3
    """``f cos / pdf`` of the continued path."""
    throughput_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    emitter: EmitterSample
    bsdf: BsdfSample
    L_bsdf: wp.vec3
    """Radiance that arrives along the BSDF's direction, of the light or of the receiver's mesh."""
    weight_bsdf: float
    """``cos visible mis / pdf`` of it; 0 when it met the object."""


@wp.func
def surface_bsdf(surface: Surface, wo: wp.vec3, frame: Frame) -> Bsdf:
    """Return the scattering of a surface toward ``wo``, world frame; ``frame`` has its normal."""
    return bsdf_of(
        to_local(wo, frame),
        surface.base_color,
        surface.metallic,
        surface.roughness,
        surface.layers,
    )


@wp.func(inline=True)
def sample_emitter(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    surface: Surface,
    bsdf: Bsdf,
    frame: Frame,
    candidates: int,
    u_pick: float,
    keep_dark: int,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> EmitterSample:
    """Draw directions from the light's proposal, pick one and trace it.

    One is picked by the sum of channels that each brings if nothing stands in its way, and it
    stands for all of them (resampled importance sampling: Talbot, Cline & Egbert 2005, "Importance
    Resampling for Global Illumination", eq. 5, in one pass over the candidates). All are weighed
    against the BSDF's direction by the power heuristic with their number as the sample count (Veach
    1997).

    Args:
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver's mesh, which stands in the light's way.
        light: The light.
        surface: Where light is scattered.
        bsdf: How, toward the camera.
        frame: Of the shading normal.
        candidates: How many directions are drawn; 1 with ``keep_dark``.
        u_pick: Uniform number that picks one; `arrived_share` asks that it depends on no other.
        keep_dark: 1 weighs directions too that bring nothing now: a gradient needs them.
        index: Of the path.
        key: Of the pixel.
        vertex: Number of the vertex.
    """
    sample = EmitterSample()
    sample.valid = 0
    sample.L = wp.vec3(0.0)
    sample.weight = 0.0
    sample.all_open = wp.vec3(0.0)
    sample.all_open_diffuse = wp.vec3(0.0)
    sample.most_open = wp.vec3(0.0)
    count = float(candidates)
    total = float(0.0)
    picked = float(0.0)
    for c in range(candidates):
        drawn = light_sample(light, sobol_pair(candidates * index + c, key, 3 * vertex + 2))
        if c == 0:
            sample.wi = drawn.wi
        wi = to_local(drawn.wi, frame)
        if wi[2] > 0.0 and wp.dot(drawn.wi, surface.ng) > 0.0 and bsdf.wo[2] > 0.0:
            f = bsdf_f(bsdf, wi)
            reflected = wp.cw_mul(f.diffuse + f.specular, drawn.radiance)
            if drawn.pdf > 0.0 and (wp.max(reflected) > 0.0 or keep_dark == 1):
                pdf = count * drawn.pdf
                weight = wi[2] * power_heuristic(pdf, f.pdf) / pdf
                channels = reflected[0] + reflected[1] + reflected[2]
                gain = weight * channels
                total += gain
                is_picked = int(1)
                if candidates > 1:
                    sample.all_open += reflected * weight
                    sample.all_open_diffuse += wp.cw_mul(f.diffuse, drawn.radiance) * weight
                    sample.most_open = wp.max(sample.most_open, reflected / channels)
                    # What is left of the number is uniform again. A NaN is picked, and is seen.
                    if u_pick * total >= gain:
                        is_picked = 0
                        if gain > 0.0:
                            u_pick = (u_pick * total - gain) / (total - gain)
                    else:
                        u_pick = u_pick * total / gain
                if is_picked == 1:
                    picked = gain
                    sample.valid = 1
                    sample.wi = drawn.wi
                    sample.f = f
                    sample.L = drawn.radiance
                    sample.weight = weight
    if sample.valid == 1:
        if candidates > 1:
            sample.weight = sample.weight * (total / picked)
            sample.most_open = sample.most_open * total
            f = sample.f
            sample.picked_open = wp.cw_mul(f.diffuse + f.specular, sample.L) * sample.weight
            sample.picked_open_diffuse = wp.cw_mul(f.diffuse, sample.L) * sample.weight
        origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
        sample.visible = visibility(mesh, material, texture, origin, sample.wi)
        sample.visible = sample.visible * sky_visibility(receiver, origin, sample.wi)
        sample.weight = sample.weight * sample.visible
    return sample


@wp.func
def arrived_share(sample: EmitterSample, gathered: wp.vec3, arrived: float) -> wp.vec3:
    """Return how much of ``all_open - picked_open`` to add to a sum of samples, by channel.

    That difference has the mean 0 over ``u_pick``, so any factor that does not depend on ``u_pick``
    leaves the sum unbiased; the share of light that arrives takes the most of the noise of picking,
    and all of it where nothing stands in the light's way (a control variate: Owen 2013, "Monte
    Carlo Theory, Methods and Examples", section 8.9). It is bounded so that no pick can take more
    than a half of what was gathered before: no sum falls below 0.

    Args:
        sample: Of the emitter.
        gathered: The sum of the samples before this one.
        arrived: The share of their picked directions along which light arrived.
    """
    taken = arrived * (sample.most_open - sample.all_open)
    share = wp.vec3(arrived)
    for c in range(3):
        if taken[c] > 0.5 * gathered[c]:
            share[c] = arrived * (0.5 * gathered[c] / taken[c])
    return share


@wp.func(inline=True)
def sample_bsdf(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    surface: Surface,
    bsdf: Bsdf,
    frame: Frame,
    u: wp.vec2,
    u_lobe: float,
    is_last: int,
    ray_key: wp.uint32,
) -> BsdfSample:
    """Draw a direction from the BSDF and trace it; the path may go on along it.

    Args:
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: Its mesh stands in the light's way and sends what the photo shows.
        surface: Where light is scattered.
        bsdf: How, toward the camera.
        frame: Of the shading normal.
        u: Uniform numbers.
        u_lobe: Another, which picks the lobe.
        is_last: 1 when nothing behind this vertex can add light, so that any hit will do.
        ray_key: Of the ray's own random numbers.
    """
    sample = BsdfSample()
    sample.cos_over_pdf = 0.0
    sample.visible = 0.0
    sample.from_receiver = 0
    sample.next.valid = 0
    wi = bsdf_sample(bsdf, u, u_lobe)
    sample.wi = to_world(wi, frame)
    if wi[2] > 0.0 and wp.dot(sample.wi, surface.ng) > 0.0 and bsdf.wo[2] > 0.0:
        sample.f = bsdf_f(bsdf, wi)
        if sample.f.pdf > 0.0:
            sample.cos_over_pdf = wi[2] / sample.f.pdf
            origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
            ended = receiver_hit(receiver, origin, sample.wi)
            if is_last == 1 and ended.valid == 0:
                sample.visible = visibility(mesh, material, texture, origin, sample.wi)
            else:
                sample.next = closest_hit(
                    mesh, material, texture, origin, sample.wi, ended.t, 0, ray_key
                )
                if sample.next.valid == 0 and ended.valid == 0:
                    sample.visible = 1.0
                elif sample.next.valid == 0:
                    sample.from_receiver = 1
                    sample.L_receiver = receiver_radiance(receiver, ended)
    return sample


@wp.func
def bsdf_weight(sample: BsdfSample, light_pdf: float) -> float:
    """Return ``cos visible mis / pdf`` of the BSDF's direction, without f."""
    return sample.cos_over_pdf * sample.visible * power_heuristic(sample.f.pdf, light_pdf)


@wp.func
def limited(radiance: wp.vec3, limit: float) -> float:
    """Return the factor that brings the largest channel down to ``limit``; 1 without a limit."""
    largest = wp.max(radiance)
    if limit > 0.0 and largest > limit:
        return limit / largest
    return 1.0
