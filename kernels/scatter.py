"""One scattering event of a path: a direction toward the emitter, and one drawn from the BSDF.

Both techniques are shared by the path tracer (`warpir.kernels.path`), which adds radiance up, and
the tracer of light transport (`warpir.kernels.transport`), which adds to the texels that the
directions meet. They are combined with the power heuristic. A direction counts only if it leaves
both the shading and the geometric surface. Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.bsdf import Bsdf, BsdfValue, bsdf_f, bsdf_of, bsdf_sample
from warpir.kernels.maths.frame import Frame, to_local, to_world
from warpir.kernels.maths.rng import sobol_point, sobol_shuffled
from warpir.kernels.receiver_mesh import receiver_hit, receiver_radiance, sky_visibility
from warpir.kernels.sampling import fetch, light_cell, power_heuristic
from warpir.kernels.tracing.hit import Hit, offset_origin
from warpir.kernels.tracing.ray import closest_hit, visibility
from warpir.kernels.tracing.surface import Surface
from warpir.kernels.types import LightArgs, MaterialArgs, MeshArgs, ReceiverArgs, TextureArgs

wp.set_module_options({"enable_backward": False})

BINS = 5
ArrivalBins = wp.types.vector(length=BINS, dtype=float)
"""A number for each kind of direction (`arrival_bin`)."""
BRIGHT_BIN = wp.constant(4)
BRIGHT_PDF = wp.constant(1.0)
"""Density of the light's proposal from which on a direction is bright; an even light's is .08
[1/sr]."""
LIGHT_COUNT = wp.constant(6.0)
"""Most directions of the light as which picking one of many counts in the power heuristic: the one
ray leaves the noise of what stands in its way. On an object with highlights and shadows 8 of 8
leave up to 6 % more noise; 2 twice as much where a metal mirrors the sun."""


@wp.struct
class Arrival:
    """Whether light arrives, by the kind of direction it comes from."""

    share: ArrivalBins
    """What is expected to arrive of it."""
    deviation: ArrivalBins
    """Of whether it does, up to a factor; above 0."""


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
    bin: int
    """What kind of direction it is (`arrival_bin`)."""
    all_expected: wp.vec3
    """What all candidates would bring if of each the share arrived that is expected [radiance]."""
    all_expected_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    picked_expected: wp.vec3
    """What this direction, in the name of all, would bring if the expected share arrived."""
    picked_expected_diffuse: wp.vec3
    """The diffuse lobe's part of it."""
    most_expected: wp.vec3
    """The most that ``picked_expected`` could have been, by channel."""


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


@wp.func
def arrival_bin(wi: wp.vec3, pdf: float) -> int:
    """Return the kind of a direction of the light, by which light arrives more or less often.

    The bright ones are one kind, a sun; the others are told by their quarter of the compass.

    Args:
        wi: World frame.
        pdf: Of the light's proposal [1/sr].
    """
    kind = int(0)
    if wi[0] > 0.0:
        kind += 1
    if wi[2] > 0.0:
        kind += 2
    if pdf > BRIGHT_PDF:
        kind = BRIGHT_BIN
    return kind


@wp.func
def expected_arrival(picks: ArrivalBins, arrived: ArrivalBins) -> Arrival:
    """Return what to expect of each kind of direction.

    One more pick of each kind is taken to be as all kinds are together, so that few picks are not
    believed. If light has always arrived, or never, all of it or none is expected, and of that
    there is no noise; but no deviation is 0, for then no direction of the kind would be picked (a
    rule of succession: Laplace 1814).

    Args:
        picks: Directions traced before.
        arrived: The sum of the shares of light that arrived along them.
    """
    all_picks = float(0.0)
    all_arrived = float(0.0)
    for kind in range(wp.static(BINS)):
        all_picks += picks[kind]
        all_arrived += arrived[kind]
    pooled = all_arrived / wp.max(all_picks, 1.0)
    # The complement of a share is counted, not subtracted from 1: of many samples, which nearly
    # all see the light, the difference would round to 0.
    missed = (wp.max(all_picks - all_arrived, 0.0) + 0.5) / (all_picks + 1.0)
    seen = (all_arrived + 0.5) / (all_picks + 1.0)
    out = Arrival()
    for kind in range(wp.static(BINS)):
        one_more = picks[kind] + 1.0
        out.share[kind] = (arrived[kind] + pooled) / one_more
        p = (arrived[kind] + seen) / one_more
        q = (wp.max(picks[kind] - arrived[kind], 0.0) + missed) / one_more
        out.deviation[kind] = wp.sqrt(p * q)
    return out


@wp.func
def unknown_arrival() -> Arrival:
    """Return what to expect where nothing was traced: every kind of direction is as uncertain."""
    out = Arrival()
    out.share = ArrivalBins(0.0)
    out.deviation = ArrivalBins(1.0)
    return out


@wp.func
def light_count(candidates: int) -> float:
    """Return as how many directions of the light picking one of so many counts in MIS."""
    return wp.min(float(candidates), LIGHT_COUNT)


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
    arrival: Arrival,
    u_pick: float,
    keep_dark: int,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> EmitterSample:
    """Draw directions from the light's proposal, pick one and trace it.

    One is picked, and stands for all of them (resampled importance sampling: Talbot, Cline & Egbert
    2005, "Importance Resampling for Global Illumination", eq. 5, in one pass over the candidates).
    The number that decides is the deviation of what each brings: its sum of channels if nothing
    stands in its way, times that of whether light arrives, ``sqrt(p (1 - p))``. What is expected of
    it is in the control variate (`variate_share`), and needs no ray. All are weighed against the
    BSDF's direction by the power heuristic with `light_count` as the sample count (Veach 1997).

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
        arrival: From `expected_arrival`.
        u_pick: Uniform number that picks one; `variate_share` asks that it depends on no other.
        keep_dark: 1 weighs directions too that bring nothing now: a gradient needs them.
        index: Of the path.
        key: Of the pixel.
        vertex: Number of the vertex.
    """
    sample = EmitterSample()
    sample.valid = 0
    sample.L = wp.vec3(0.0)
    sample.weight = 0.0
    sample.all_expected = wp.vec3(0.0)
    sample.all_expected_diffuse = wp.vec3(0.0)
    sample.most_expected = wp.vec3(0.0)
    count = light_count(candidates)
    total = float(0.0)
    picked = float(0.0)
    pair = 3 * vertex + 2
    run = sobol_shuffled(index, key, pair) * wp.uint32(candidates)
    ahead = light_cell(light, sobol_point(run, key, pair))
    for c in range(candidates):
        drawn = light.drawn[ahead[0], ahead[1]]
        if c + 1 < candidates:
            ahead = light_cell(light, sobol_point(run + wp.uint32(c + 1), key, pair))
            fetch(light.drawn, ahead[0], ahead[1])
        if c == 0:
            sample.wi = drawn.wi
        wi = to_local(drawn.wi, frame)
        if wi[2] > 0.0 and wp.dot(drawn.wi, surface.ng) > 0.0 and bsdf.wo[2] > 0.0:
            f = bsdf_f(bsdf, wi)
            reflected = wp.cw_mul(f.diffuse + f.specular, drawn.radiance)
            if drawn.pdf > 0.0 and (wp.max(reflected) > 0.0 or keep_dark == 1):
                weight = wi[2] * power_heuristic(count * drawn.pdf, f.pdf)
                weight = weight / (float(candidates) * drawn.pdf)
                kind = arrival_bin(drawn.wi, drawn.pdf)
                deviation = arrival.deviation[kind]
                channels = reflected[0] + reflected[1] + reflected[2]
                gain = weight * channels * deviation
                total += gain
                is_picked = int(1)
                if candidates > 1:
                    expected = weight * arrival.share[kind]
                    sample.all_expected += reflected * expected
                    sample.all_expected_diffuse += wp.cw_mul(f.diffuse, drawn.radiance) * expected
                    most = (reflected / channels) * (arrival.share[kind] / deviation)
                    sample.most_expected = wp.max(sample.most_expected, most)
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
                    sample.bin = kind
                    sample.f = f
                    sample.L = drawn.radiance
                    sample.weight = weight
    if sample.valid == 1:
        if candidates > 1:
            sample.weight = sample.weight * (total / picked)
            sample.most_expected = sample.most_expected * total
            f = sample.f
            expected = sample.weight * arrival.share[sample.bin]
            sample.picked_expected = wp.cw_mul(f.diffuse + f.specular, sample.L) * expected
            sample.picked_expected_diffuse = wp.cw_mul(f.diffuse, sample.L) * expected
        origin = offset_origin(surface.position, surface.ng, sample.wi, mesh.epsilon)
        sample.visible = visibility(mesh, material, texture, origin, sample.wi)
        sample.visible = sample.visible * sky_visibility(receiver, origin, sample.wi)
        sample.weight = sample.weight * sample.visible
    return sample


@wp.func
def variate_share(sample: EmitterSample, gathered: wp.vec3) -> wp.vec3:
    """Return how much of ``all_expected - picked_expected`` to add to a sum, by channel.

    That difference has the mean 0 over ``u_pick``, so any factor that does not depend on ``u_pick``
    leaves the sum unbiased. The whole of it leaves the noise of what arrives beside what was
    expected to (a control variate: Owen 2013, "Monte Carlo Theory, Methods and Examples", section
    8.9). It is bounded so that no pick can take more than a half of what was gathered before: no
    sum falls below 0.

    Args:
        sample: Of the emitter.
        gathered: The sum of the samples before this one.
    """
    taken = sample.most_expected - sample.all_expected
    share = wp.vec3(1.0)
    for c in range(3):
        if taken[c] > 0.5 * gathered[c]:
            share[c] = 0.5 * gathered[c] / taken[c]
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
    u_parts: wp.vec2,
    is_last: int,
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
        u_parts: Two more: what the ray passes (`closest_hit`), and which lobe is picked.
        is_last: 1 when nothing behind this vertex can add light, so that any hit will do.
    """
    sample = BsdfSample()
    sample.cos_over_pdf = 0.0
    sample.visible = 0.0
    sample.from_receiver = 0
    sample.next.valid = 0
    wi = bsdf_sample(bsdf, u, u_parts[1])
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
                    mesh, material, texture, origin, sample.wi, ended.t, 0, u_parts[0]
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
