"""Path tracing of the object under a light at infinity, ``PathTrace(X, L_fg, D)`` (DiPIR, eq. 4).

The object is seen by the camera, or from the ground: what it throws on the receiver is the light
that the receiver gains by it, the part of differential rendering that DiPIR's ratio leaves out
(`warpir.kernels.receiver`). Or it is seen in a glossy ground, as a mirror image.

Each vertex traces one direction toward the light, picked among candidates, and one of the BSDF
(`warpir.kernels.scatter`); the BSDF's direction continues the path. At the first vertex a thread
knows from its samples before how often light arrives, by where it comes from: what of it is
expected is a control variate, and what is uncertain is traced. `trace_foreground` sums radiance
and, if asked, writes down what the two adjoints need: `warpir.kernels.light_gradient` for the
light, `warpir.kernels.shade` for the materials. Detached: no backward pass.
"""

from enum import IntEnum
from functools import cache

import warp as wp

from warpir.kernels.dielectric.glass import (
    GLASS_DEPTH,
    GlassPoint,
    glass_at,
    meets_glass,
    metallic_beside,
    scatter_at_glass,
    transmittance,
)
from warpir.kernels.lamps.gather import gather_lamps
from warpir.kernels.light_gradient import keep_direction
from warpir.kernels.maths.frame import basis
from warpir.kernels.maths.lanes import lane_sum
from warpir.kernels.maths.rng import hash_pair, pixel_seed, sobol_pair, to_unit
from warpir.kernels.receiver import (
    ReceiverPoint,
    mirrored_ray,
    object_ray,
    object_window,
    receiver_origin,
    receiver_point,
)
from warpir.kernels.receiver_mesh import receiver_mesh_hit
from warpir.kernels.sampling import light_eval
from warpir.kernels.scatter import (
    Arrival,
    ArrivalBins,
    Scatter,
    bsdf_weight,
    expected_arrival,
    light_count,
    limited,
    sample_bsdf,
    sample_emitter,
    surface_bsdf,
    unknown_arrival,
    variate_share,
)
from warpir.kernels.tracing.hit import Hit
from warpir.kernels.tracing.ray import camera_hit, camera_ray, closest_hit
from warpir.kernels.tracing.surface import Surface, surface_at
from warpir.kernels.types import (
    CameraArgs,
    GlassArgs,
    LampArgs,
    LightArgs,
    LightRecord,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
    VertexRecord,
)

wp.set_module_options({"enable_backward": False})

BLOCK_DIM = 128
"""Threads of a block on CUDA: 1.2 times as many paths a second as with 256 on an H100. Twice as
many blocks at a time, of half the registers each, are a tenth faster on an H200 without layers, and
a seventh slower with them."""
LATER_CANDIDATES = wp.constant(2)
"""Most directions of the light among which a vertex behind the first picks one. Four take a tenth
more time for no less noise; the one alone leaves fireflies."""
PICK = wp.constant(wp.uint32(0x9E3779B9))
"""Sets the number that picks one apart from others of the same vertex."""


@wp.func(inline=True)
def scatter(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    lamps: LampArgs,
    surface: Surface,
    wo: wp.vec3,
    is_last: int,
    candidates: int,
    arrival: Arrival,
    keep_dark: int,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> Scatter:
    """Draw, weigh and trace the two directions of one path vertex.

    ``is_last`` is that of `sample_bsdf`, ``candidates``, ``arrival`` and ``keep_dark`` are
    `sample_emitter`'s.
    """
    out = Scatter()
    out.direct = wp.vec3(0.0)
    out.direct_diffuse = wp.vec3(0.0)
    out.throughput = wp.vec3(0.0)
    out.throughput_diffuse = wp.vec3(0.0)
    out.L_bsdf = wp.vec3(0.0)
    out.weight_bsdf = 0.0
    frame = basis(surface.n)
    bsdf = surface_bsdf(surface, wo, frame)
    u_parts = sobol_pair(index, key, 3 * vertex + 1)

    # Sample the emitter
    pick = hash_pair(hash_pair(key, wp.uint32(index)), wp.uint32(vertex) + PICK)
    emitter = sample_emitter(
        mesh, material, texture, receiver, light, surface, bsdf, frame,
        candidates, arrival, to_unit(pick), keep_dark, index, key, vertex,
    )  # fmt: skip
    out.emitter = emitter
    if emitter.valid == 1:
        f = emitter.f
        out.direct = wp.cw_mul(f.diffuse + f.specular, emitter.L) * emitter.weight
        out.direct_diffuse = wp.cw_mul(f.diffuse, emitter.L) * emitter.weight

    # Sample the BSDF, continue the path
    u = sobol_pair(index, key, 3 * vertex + 3)
    sample = sample_bsdf(
        mesh, material, texture, receiver, surface, bsdf, frame, u, u_parts, is_last
    )
    out.bsdf = sample
    f_sample = sample.f.diffuse + sample.f.specular
    if sample.from_receiver == 1:
        # No light is sampled from there, so this technique has all of it.
        out.L_bsdf = sample.L_receiver
        out.weight_bsdf = sample.cos_over_pdf
    if sample.visible > 0.0:
        Li = light_eval(light, sample.wi)
        out.L_bsdf = Li.radiance
        out.weight_bsdf = bsdf_weight(sample, light_count(candidates) * Li.pdf)
    if sample.from_receiver == 1 or sample.visible > 0.0:
        out.direct += wp.cw_mul(f_sample, out.L_bsdf) * out.weight_bsdf
        out.direct_diffuse += wp.cw_mul(sample.f.diffuse, out.L_bsdf) * out.weight_bsdf
    if lamps.count > 0:
        near = gather_lamps(
            mesh, material, texture, receiver, lamps,
            surface, bsdf, frame, sample, index, key, vertex,
        )  # fmt: skip
        out.direct += near.whole
        out.direct_diffuse += near.diffuse
    if sample.next.valid == 1:
        out.throughput = f_sample * sample.cos_over_pdf
        out.throughput_diffuse = sample.f.diffuse * sample.cos_over_pdf
    return out


@wp.func
def scatter_with_glass(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    light: LightArgs,
    lamps: LampArgs,
    glass: GlassArgs,
    surface: Surface,
    point: GlassPoint,
    is_glass: int,
    wo: wp.vec3,
    candidates: int,
    arrival: Arrival,
    keep_dark: int,
    index: int,
    key: wp.uint32,
    vertex: int,
) -> Scatter:
    """Do `scatter` in a scene with solid glass, at glass (``is_glass``) or at what is beside it.

    Nothing is the last vertex there, since light comes through glass.
    """
    event = Scatter()
    if is_glass == 1:
        event = scatter_at_glass(
            mesh, material, texture, receiver, light, lamps,
            surface, point, wo, keep_dark, index, key, vertex,
        )  # fmt: skip
    else:
        rest = surface
        rest.metallic = metallic_beside(surface.metallic, point)
        event = scatter(
            mesh, material, texture, receiver, light, lamps,
            rest, wo, 0, candidates, arrival, keep_dark, index, key, vertex,
        )  # fmt: skip
    if event.bsdf.next.valid == 1:
        left = transmittance(mesh, glass, surface, point, event.bsdf)
        event.throughput = wp.cw_mul(event.throughput, left)
        event.throughput_diffuse = wp.cw_mul(event.throughput_diffuse, left)
    return event


@wp.func
def keep_surface(record: VertexRecord, i: int, j: int, surface: Surface, wo: wp.vec3):
    """Write down where a path is; what it gathers there is 0 until `keep_event`."""
    record.material[i, j] = surface.material
    record.n[i, j] = surface.n
    record.wo[i, j] = wo
    record.texture_color[i, j] = surface.texture_color
    record.texture_metallic[i, j] = surface.texture_metallic
    record.texture_roughness[i, j] = surface.texture_roughness
    record.texture_emission[i, j] = surface.texture_emission
    record.incident_light[i, j] = wp.vec3(0.0)
    record.incident_bsdf[i, j] = wp.vec3(0.0)
    record.cos_over_pdf[i, j] = 0.0
    if record.layers.shape[1] > 0:
        record.layers[i, j] = surface.layers


@wp.func
def keep_event(record: VertexRecord, i: int, j: int, event: Scatter):
    """Write down what a path gathers at a vertex and how it goes on."""
    record.wi_light[i, j] = event.emitter.wi
    record.incident_light[i, j] = event.emitter.L * event.emitter.weight
    record.wi_bsdf[i, j] = event.bsdf.wi
    record.incident_bsdf[i, j] = event.L_bsdf * event.weight_bsdf
    if event.bsdf.next.valid == 1:
        record.cos_over_pdf[i, j] = event.bsdf.cos_over_pdf


class Viewer(IntEnum):
    """From where the object is seen."""

    CAMERA = 0
    GROUND = 1
    """From the white receiver, on which it throws light."""
    MIRROR = 2
    """From the camera, in the ground's coat."""


@cache
def foreground_kernel(
    layers: int,
    has_receiver_mesh: bool,
    viewer: int,
    has_lamps: bool,
    has_solid_glass: bool,
    has_passing: bool,
) -> wp.Kernel:
    """Return `trace_foreground` for scenes with or without these; what is not there costs nothing.

    A flag that is looked at while tracing would do on the CPU. On CUDA the registers of code that
    never runs slow down what does.

    Args:
        layers: What extensions some material has (``MaterialArgs.any_layers``).
        has_receiver_mesh: Whether there is a mesh of the receiver (``ReceiverArgs.mesh``).
        viewer: From where the object is seen (`Viewer`).
        has_lamps: Whether there are lamps near the object (`LampArgs`).
        has_solid_glass: Whether some material is solid glass (`GlassArgs`); not on the ground.
        has_passing: Whether some triangle may let rays pass (``MeshArgs.passing``).
    """
    from_camera, from_ground = viewer == Viewer.CAMERA, viewer == Viewer.GROUND
    in_mirror = viewer == Viewer.MIRROR

    @wp.kernel(
        module="unique",
        enable_backward=False,
        module_options={"block_dim": BLOCK_DIM},
        cuda_max_registers=None if layers else 128,
    )
    def trace_foreground(
        pixels: wp.array[int],
        may_see_object: wp.array[int],
        camera: CameraArgs,
        mesh: MeshArgs,
        material: MaterialArgs,
        texture: TextureArgs,
        receiver: ReceiverArgs,
        light: LightArgs,
        behind: LightArgs,
        lamps: LampArgs,
        glass: GlassArgs,
        spp: int,
        rays: int,
        lanes: int,
        depth: int,
        candidates: int,
        indirect_limit: float,
        seed: int,
        ground_alpha: float,
        foreground: wp.array[wp.vec3],
        diffuse: wp.array[wp.vec3],
        emission: wp.array[wp.vec3],
        coverage: wp.array[float],
        light_record: LightRecord,
        vertex_record: VertexRecord,
    ):
        """Path-trace the object in each listed pixel; the receiver hides it but is not lit.

        Indices are the pixel's row and one of its ``lanes`` threads, which share its samples.

        From the ground, ``foreground`` is the radiance of a white receiver by what the object
        reflects and emits, the mean over the samples that see the receiver.
        The receiver is the path's first vertex. It is black to the object: light that goes from the
        ground to the object and back is left out, and the shadow stays dark at the contact.

        In the mirror, ``foreground`` is the radiance of the object's image, ``diffuse`` that of the
        light behind it, which the coat showed before, and ``emission`` that of the light beside it,
        which it goes on showing; the mean as from the ground. The coat is the path's first vertex.

        Args:
            pixels: Row-major pixel indices, shape [row].
            may_see_object: From the ground: 1 where the object may hide the receiver, shape [row].
            camera: The view.
            mesh: The object's triangles.
            material: Their materials.
            texture: Their textures.
            receiver: The ground plane, which hides what is below it from the camera, and the mesh,
                which also stands in the light's way.
            light: The light.
            behind: What the mirror shows where the object is not; only the mirror looks at it.
            lamps: Lamps near the object.
            glass: Solid glass.
            spp: Camera samples per thread.
            rays: Paths that share one camera sample.
            lanes: Threads per pixel (`warpir.kernels.maths.lanes`).
            depth: Surface interactions, that with the receiver included; with solid glass those
                with other materials, and `GLASS_DEPTH` in all at most.
            candidates: Directions of the light among which the object's first vertex picks one
                (`sample_emitter`); 1 with a record.
            indirect_limit: Most radiance that each vertex behind the first may add to a path, by
                its largest channel, emission apart; 0 for no limit. It takes the fireflies of light
                that a mirror throws onto a matte surface, and with them some of that light.
            seed: Base seed.
            ground_alpha: GGX alpha of the ground's coat; only the mirror looks at it.
            foreground: Radiance premultiplied by coverage, shape [row].
            diffuse: The part of it that the first hit's diffuse lobe reflects, shape [row]; not
                written from the ground, nor are the next two there, or the coverage in the mirror.
            emission: The part of it that the first hit emits, shape [row].
            coverage: Share of samples that see the object, shape [row].
            light_record: Output: the weight of each direction that saw the light, a row a thread,
                or without arrays.
            vertex_record: Output: every vertex, a row a thread; ``material`` must come filled with
                -1. Or without arrays.
        """
        material.any_layers = wp.static(int(layers))
        if wp.static(not has_receiver_mesh):
            receiver.mesh = wp.uint64(0)
        if wp.static(not has_lamps):
            lamps.count = 0
        if wp.static(not has_passing):
            mesh.passing = wp.uint64(0)
            mesh.embree_passing = wp.uint64(0)
        receiver.is_solid = wp.static(int(from_ground))
        if wp.static(from_ground):
            receiver.shines = 0
        if wp.static(not from_camera):
            point = ReceiverPoint()
            hidden = wp.vec3(0.0)
            beside = wp.vec3(0.0)
        i, lane = wp.tid()
        record_row = i * lanes + lane
        pixel = pixels[i]
        key = pixel_seed(seed, pixel)
        scale = 1.0 / float(spp * rays * lanes)
        before = lane * spp
        keep_dark = int(0)
        if light_record.wi.shape[1] > 0 or vertex_record.material.shape[1] > 0:
            keep_dark = 1
        entries = int(0)
        radiance = wp.vec3(0.0)
        radiance_diffuse = wp.vec3(0.0)
        radiance_emission = wp.vec3(0.0)
        count = float(0.0)
        if wp.static(from_camera):
            picks = ArrivalBins(0.0)
            arrived = ArrivalBins(0.0)

        # One loop over vertices rather than one over paths: a thread whose path has ended starts
        # the next one at once instead of waiting for the longest path among its neighbours (1.5 x
        # on CUDA).
        index = int(0)
        k = int(0)
        alive = int(0)
        first = Hit()
        hit = Hit()
        wo = wp.vec3(0.0)
        throughput = wp.vec3(0.0)
        throughput_diffuse = wp.vec3(0.0)
        if wp.static(has_solid_glass):
            interfaces = int(0)
        while index < spp * rays:
            # Among all samples of the pixel
            path = before * rays + index
            if alive == 0:
                s = before + index // rays
                if wp.static(not from_camera):
                    if index % rays == 0:
                        point = receiver_point(
                            camera, mesh, material, texture, receiver, pixel, may_see_object[i],
                            s, key,
                        )  # fmt: skip
                        count += float(point.valid + point.is_open)
                    if point.valid == 0:
                        index += rays
                        continue
                    origin = receiver_origin(mesh, receiver, point)
                    u = sobol_pair(path, key, 3)
                    if wp.static(from_ground):
                        window = object_window(mesh, origin, point.normal)
                        ray = object_ray(window, u)
                    else:
                        toward = wp.normalize(camera.origin - point.position)
                        ray = mirrored_ray(point.normal, toward, ground_alpha, u)
                    first.valid = 0
                    if ray.weight > 0.0:
                        reach = receiver_mesh_hit(receiver, origin, ray.direction).t
                        u_passing = sobol_pair(path, key, 1)[0]
                        first = closest_hit(
                            mesh, material, texture, origin, ray.direction, reach, 0, u_passing
                        )
                    if wp.static(in_mirror):
                        if ray.weight > 0.0:
                            shown = light_eval(behind, ray.direction).radiance * ray.weight
                            hidden += shown * float(first.valid)
                            beside += shown * float(1 - first.valid)
                    if first.valid == 0:
                        index += 1
                        continue
                    wo = -ray.direction
                    throughput = wp.vec3(ray.weight)
                    k = 1
                else:
                    ray_dir = camera_ray(camera, pixel, sobol_pair(s, key, 0))
                    if index % rays == 0:
                        first = camera_hit(
                            camera, mesh, material, texture, receiver, s, key, ray_dir
                        )
                        if first.valid == 1:
                            count += 1.0
                    if first.valid == 0:
                        index += rays
                        continue
                    wo = -ray_dir
                    throughput = wp.vec3(1.0, 1.0, 1.0)
                    k = 0
                alive = 1
                hit = first
                throughput_diffuse = wp.vec3(0.0)
                if wp.static(has_solid_glass):
                    interfaces = 0

            # The one place where surfaces are read, of first and of later vertices: half the code.
            surface = surface_at(mesh, material, texture, hit, wo)
            radiance += wp.cw_mul(throughput, surface.emission)
            if k == 0:
                radiance_emission += surface.emission
            else:
                radiance_diffuse += wp.cw_mul(throughput_diffuse, surface.emission)
            if vertex_record.material.shape[1] > 0:
                keep_surface(vertex_record, record_row, k * spp * rays + index, surface, wo)
            if wp.static(has_solid_glass):
                glassy = glass_at(mesh, material, texture, glass, hit, surface.metallic, wo)
                # Light comes through glass that follows the last other surface.
                if k - interfaces >= depth and glassy.share == 0.0:
                    alive = 0
                if k == wp.max(depth, GLASS_DEPTH):
                    alive = 0
            elif k == depth:
                alive = 0
            if alive == 0:
                index += 1
                continue

            among = candidates
            arrival = unknown_arrival()
            if wp.static(from_camera):
                if k == 0 and candidates > 1:
                    arrival = expected_arrival(picks, arrived)
            if k > wp.static(int(not from_camera)):
                among = wp.min(candidates, LATER_CANDIDATES)
            if wp.static(has_solid_glass):
                is_glass = meets_glass(glassy, path, key, k)
                if is_glass == 0 and k - interfaces >= depth:
                    alive = 0
                    index += 1
                    continue
                interfaces += is_glass
                event = scatter_with_glass(
                    mesh, material, texture, receiver, light, lamps, glass,
                    surface, glassy, is_glass, wo, among, arrival, keep_dark,
                    path, key, k,
                )  # fmt: skip
            else:
                is_last = int(0)
                if k == depth - 1 and material.any_emission == 0 and lamps.count == 0:
                    is_last = 1  # lamps in front of a hit are seen by the closest alone
                event = scatter(
                    mesh, material, texture, receiver, light, lamps,
                    surface, wo, is_last, among, arrival, keep_dark, path, key, k,
                )  # fmt: skip
            if vertex_record.material.shape[1] > 0:
                keep_event(vertex_record, record_row, k * spp * rays + index, event)
            if light_record.wi.shape[1] > 0:
                if event.emitter.valid == 1:
                    f = event.emitter.f.diffuse + event.emitter.f.specular
                    gain = wp.cw_mul(throughput, f) * (event.emitter.weight * scale)
                    entries += keep_direction(
                        light_record, record_row, entries, event.emitter.wi, gain
                    )
                if event.bsdf.visible > 0.0:
                    f = event.bsdf.f.diffuse + event.bsdf.f.specular
                    gain = wp.cw_mul(throughput, f) * (event.weight_bsdf * scale)
                    entries += keep_direction(
                        light_record, record_row, entries, event.bsdf.wi, gain
                    )
            if wp.static(from_camera):
                if k == 0 and candidates > 1 and event.emitter.valid == 1:
                    # Before this path's own light is added: the share must not depend on its pick.
                    emitter = event.emitter
                    kept = variate_share(emitter, radiance)
                    radiance += wp.cw_mul(emitter.all_expected - emitter.picked_expected, kept)
                    radiance_diffuse += wp.cw_mul(
                        emitter.all_expected_diffuse - emitter.picked_expected_diffuse, kept
                    )
                    picks[emitter.bin] = picks[emitter.bin] + 1.0
                    arrived[emitter.bin] = arrived[emitter.bin] + emitter.visible
            if k == 0:
                radiance += event.direct
                radiance_diffuse += event.direct_diffuse
                throughput_diffuse = event.throughput_diffuse
            else:
                gathered = wp.cw_mul(throughput, event.direct)
                limit = limited(gathered, indirect_limit)
                radiance += gathered * limit
                radiance_diffuse += wp.cw_mul(throughput_diffuse, event.direct) * limit
                throughput_diffuse = wp.cw_mul(throughput_diffuse, event.throughput)
            k += 1
            alive = event.bsdf.next.valid
            if alive == 1:
                throughput = wp.cw_mul(throughput, event.throughput)
                wo = -event.bsdf.wi
                hit = event.bsdf.next
            else:
                index += 1

        counted = lane_sum(wp.vec3(count, 0.0, 0.0), lanes)[0]
        seen = float(1.0)
        if wp.static(not from_camera):
            seen = float(spp * lanes) / wp.max(counted, 1.0)
        if light_record.wi.shape[1] > 0:
            light_record.count[record_row] = entries
            if wp.static(not from_camera):
                for j in range(entries):
                    light_record.weight[record_row, j] = light_record.weight[record_row, j] * seen
        radiance = lane_sum(radiance, lanes)
        if wp.static(from_camera):
            # A part of the radiance, which is bounded, may fall below 0 by a control variate.
            radiance_diffuse = wp.max(lane_sum(radiance_diffuse, lanes), wp.vec3(0.0))
            radiance_emission = lane_sum(radiance_emission, lanes)
        elif wp.static(in_mirror):
            radiance_diffuse = lane_sum(hidden, lanes)
            radiance_emission = lane_sum(beside, lanes)
        if lane == 0:
            foreground[i] = radiance * (scale * seen)
            if wp.static(not from_ground):
                diffuse[i] = radiance_diffuse * (scale * seen)
                emission[i] = radiance_emission * (scale * seen)
            if wp.static(from_camera):
                coverage[i] = counted / float(spp * lanes)

    return trace_foreground
