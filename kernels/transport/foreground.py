"""Rows of ``T_fg``: what each texel sends into a pixel by the object, directly and by paths.

Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.bsdf import bsdf_f, bsdf_of, narrowest_roughness, roughness_to_alpha
from warpir.kernels.maths.frame import basis, to_local
from warpir.kernels.maths.latlong import bilinear_tap, direction_to_uv
from warpir.kernels.maths.rng import hash_pair, hash_uint, pixel_seed, sobol_pair, to_unit
from warpir.kernels.receiver_mesh import receiver_visibility
from warpir.kernels.sampling import light_eval, power_heuristic
from warpir.kernels.scatter import (
    bsdf_weight,
    sample_bsdf,
    sample_emitter,
    surface_bsdf,
    unknown_arrival,
)
from warpir.kernels.tracing.hit import offset_origin
from warpir.kernels.tracing.ray import camera_hit, camera_ray, visibility
from warpir.kernels.tracing.surface import Surface, surface_at
from warpir.kernels.transport.texels import (
    TENT_REACH,
    TexelArgs,
    point_of,
    tent_direction,
    texel_pdf,
)
from warpir.kernels.types import (
    CameraArgs,
    Layers,
    LightArgs,
    LightRecord,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

NARROW = wp.constant(4.0)
"""Specular lobes with ``alpha`` below this many texel sides are sampled by the BSDF too."""


@wp.struct
class SurfacePoints:
    """What the camera samples of each pixel met; the first ``count`` of each row are filled."""

    count: wp.array[int]
    """Shape [pixel]."""
    position: wp.array2d[wp.vec3]
    """Recentred world [m], shape [pixel, subsample]; so are the others."""
    ng: wp.array2d[wp.vec3]
    n: wp.array2d[wp.vec3]
    wo: wp.array2d[wp.vec3]
    base_color: wp.array2d[wp.vec3]
    metallic: wp.array2d[float]
    roughness: wp.array2d[float]
    layers: wp.array2d[Layers]
    """Without columns where no material is layered."""


@wp.kernel
def trace_points(
    pixels: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    subsamples: int,
    seed: int,
    points: SurfacePoints,
    emission: wp.array[wp.vec3],
):
    """Find the object's surface under ``subsamples`` positions of each listed pixel.

    ``emission`` is the mean radiance that these points emit, premultiplied by coverage.
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    count = int(0)
    emitted = wp.vec3(0.0)
    for s in range(subsamples):
        ray_dir = camera_ray(camera, pixel, sobol_pair(s, key, 0))
        hit = camera_hit(camera, mesh, material, texture, receiver, s, key, ray_dir)
        if hit.valid == 1:
            surface = surface_at(mesh, material, texture, hit, -ray_dir)
            points.position[i, count] = surface.position
            points.ng[i, count] = surface.ng
            points.n[i, count] = surface.n
            points.wo[i, count] = -ray_dir
            points.base_color[i, count] = surface.base_color
            points.metallic[i, count] = surface.metallic
            points.roughness[i, count] = surface.roughness
            if material.any_layers > 0:
                points.layers[i, count] = surface.layers
            emitted += surface.emission
            count += 1
    points.count[i] = count
    emission[i] = emitted / float(subsamples)


@wp.func
def layers_of(points: SurfacePoints, material: MaterialArgs, p: int, s: int) -> Layers:
    """Return the extensions at point ``s`` of row ``p``."""
    if material.any_layers > 0:
        return points.layers[p, s]
    layers = Layers()
    layers.present = 0
    return layers


@wp.func
def is_narrow(roughness: float, layers: Layers, height: int) -> int:
    """Return 1 when a specular lobe may be too narrow for one direction per texel."""
    if roughness_to_alpha(narrowest_roughness(roughness, layers)) < NARROW * wp.PI / float(height):
        return 1
    return 0


@wp.func
def direct_row(
    points: SurfacePoints,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    subsamples: int,
    path_count: int,
    p: int,
    t: int,
    first: int,
    count: int,
    pixel_key: wp.uint32,
    shift: float,
) -> wp.vec3:
    """Return what texel ``t`` sends into row ``p`` by one interaction, per texel radiance [1].

    Only the part of one piece of work, whose directions start at ``first``.
    """
    total = wp.vec3(0.0)
    if count == 0:
        return total
    i = t // texels.width
    j = t % texels.width
    directions = texels.direction_count[t]
    below = -wp.sin(TENT_REACH * wp.PI / float(texels.height))
    key = hash_pair(pixel_key, wp.uint32(t))
    start = point_of(i, j, shift, count)
    for r in range(first, wp.min(first + texels.item_size, directions)):
        s = (start + r) % count
        n = points.n[p, s]
        # Half of the texels are behind the surface: say so before a direction is drawn.
        if wp.dot(texels.centre[t], n) > below:
            wi = tent_direction(texels, i, j, r, key, 0, n)
            ng = points.ng[p, s]
            if wp.dot(wi, n) > 0.0 and wp.dot(wi, ng) > 0.0:
                frame = basis(n)
                roughness = points.roughness[p, s]
                layers = layers_of(points, material, p, s)
                wo = to_local(points.wo[p, s], frame)
                base_color = points.base_color[p, s]
                bsdf = bsdf_of(wo, base_color, points.metallic[p, s], roughness, layers)
                f = bsdf_f(bsdf, to_local(wi, frame))
                specular = f.specular
                if path_count > 0 and is_narrow(roughness, layers, texels.height) == 1:
                    tap = bilinear_tap(direction_to_uv(wi), texels.height, texels.width)
                    pdf = texel_pdf(texels, tap, i, j)
                    specular = specular * power_heuristic(pdf, float(path_count) * f.pdf)
                throughput = (f.diffuse + specular) * wp.dot(wi, n)
                if wp.max(throughput) > 0.0:
                    origin = offset_origin(points.position[p, s], ng, wi, mesh.epsilon)
                    arriving = visibility(mesh, material, texture, origin, wi)
                    total += throughput * (arriving * receiver_visibility(receiver, origin, wi))
    return total * (texels.d_omega[i] * float(count) / float(subsamples * directions))


@wp.kernel
def trace_direct(
    pixels: wp.array[int],
    points: SurfacePoints,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    subsamples: int,
    path_count: int,
    seed: int,
    T: wp.array2d[wp.vec3],
):
    """Write the light that reaches the camera by one interaction; thread = (pixel, lane).

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        points: From `trace_points`.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: The receiver's mesh, which stands in the light's way.
        texels: The map and how many directions each texel gets.
        subsamples: Camera samples per pixel.
        path_count: Paths that `trace_paths` will add, for the weights of narrow lobes.
        seed: Base seed.
        T: Pixel radiance per texel radiance [1], zero, shape [pixel, texel].
    """
    p, lane = wp.tid()
    count = points.count[p]
    key = pixel_seed(seed, pixels[p])
    shift = to_unit(hash_uint(key))
    for item in range(lane, texels.item_count, texels.lanes):
        t = texels.item_column[item]
        part = direct_row(
            points,
            mesh,
            material,
            texture,
            receiver,
            texels,
            subsamples,
            path_count,
            p,
            t,
            texels.item_first[item],
            count,
            key,
            shift,
        )
        wp.atomic_add(T, p, t, part)


@wp.func
def add_to_texels(
    T: wp.array2d[wp.vec3],
    p: int,
    texels: TexelArgs,
    wi: wp.vec3,
    diffuse: wp.vec3,
    specular: wp.vec3,
    pdf: float,
):
    """Spread what arrives from ``wi`` over the four texels that interpolation reads there.

    ``specular`` competes with the directions drawn for each of those texels; a ``pdf`` of 0 says
    that it does not.
    """
    tap = bilinear_tap(direction_to_uv(wi), texels.height, texels.width)
    for corner in range(4):
        i = tap.i0
        across = 1.0 - tap.wi
        if corner >= 2:
            i = tap.i1
            across = tap.wi
        j = tap.j0
        along = 1.0 - tap.wj
        if corner % 2 == 1:
            j = tap.j1
            along = tap.wj
        value = diffuse
        if pdf > 0.0:
            value = value + specular * power_heuristic(pdf, texel_pdf(texels, tap, i, j))
        else:
            value = value + specular
        wp.atomic_add(T, p, i * texels.width + j, value * (across * along))


@wp.kernel
def trace_paths(
    pixels: wp.array[int],
    points: SurfacePoints,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    texels: TexelArgs,
    proposal: LightArgs,
    subsamples: int,
    first_path: int,
    path_count: int,
    depth: int,
    seed: int,
    T: wp.array2d[wp.vec3],
    emission: wp.array[wp.vec3],
):
    """Add narrow specular lobes and all light of two or more interactions; (pixel, path).

    Args:
        pixels: Row-major pixel indices, shape [pixel].
        points: From `trace_points`.
        mesh: The object's triangles.
        material: Their materials.
        texture: Their textures.
        receiver: Its mesh stands in the light's way and sends what the photo shows.
        texels: The map.
        proposal: Where light is expected, for the second and later vertices; any positive map.
        subsamples: Camera samples per pixel.
        first_path: Path of the launch's first column.
        path_count: Paths per pixel.
        depth: Surface interactions.
        seed: Base seed.
        T: From `trace_direct`, shape [pixel, texel].
        emission: Radiance that does not depend on the light, shape [pixel].
    """
    receiver.is_solid = 0
    p, column = wp.tid()
    q = first_path + column
    count = points.count[p]
    if count == 0:
        return
    key = hash_pair(pixel_seed(seed, pixels[p]), wp.uint32(0x51ED27))
    s = (q + int(hash_uint(key) >> wp.uint32(8))) % count
    surface = Surface()
    surface.position = points.position[p, s]
    surface.ng = points.ng[p, s]
    surface.n = points.n[p, s]
    surface.base_color = points.base_color[p, s]
    surface.metallic = points.metallic[p, s]
    surface.roughness = points.roughness[p, s]
    surface.layers = layers_of(points, material, p, s)
    wo = points.wo[p, s]
    scale = float(count) / float(subsamples * path_count)
    throughput = wp.vec3(scale, scale, scale)
    for k in range(depth):
        frame = basis(surface.n)
        bsdf = surface_bsdf(surface, wo, frame)
        is_narrow_first = int(0)
        if k == 0:
            is_narrow_first = is_narrow(surface.roughness, surface.layers, texels.height)
        is_last = int(0)
        if k == depth - 1 and material.any_emission == 0:
            is_last = 1
        if k == 0 and is_last == 1 and is_narrow_first == 0 and receiver.mesh == wp.uint64(0):
            break
        u_parts = sobol_pair(q, key, 3 * k + 1)

        # Sample the emitter: where light is expected; the first vertex has its directions already
        if k > 0:
            emitter = sample_emitter(
                mesh, material, texture, receiver, proposal, surface, bsdf, frame,
                1, unknown_arrival(), 0.0, 0, q, key, k,
            )  # fmt: skip
            if emitter.weight > 0.0:
                value = wp.cw_mul(throughput, emitter.f.diffuse + emitter.f.specular)
                add_to_texels(T, p, texels, emitter.wi, value * emitter.weight, wp.vec3(0.0), 0.0)

        # Sample the BSDF, continue the path
        u = sobol_pair(q, key, 3 * k + 3)
        sample = sample_bsdf(
            mesh, material, texture, receiver, surface, bsdf, frame, u, u_parts, is_last
        )
        f = sample.f.diffuse + sample.f.specular
        if sample.from_receiver == 1:
            reflected = wp.cw_mul(throughput, f) * sample.cos_over_pdf
            wp.atomic_add(emission, p, wp.cw_mul(reflected, sample.L_receiver))
        if sample.visible > 0.0:
            if k > 0:
                expected = light_eval(proposal, sample.wi)
                value = wp.cw_mul(throughput, f) * bsdf_weight(sample, expected.pdf)
                add_to_texels(T, p, texels, sample.wi, value, wp.vec3(0.0), 0.0)
            elif is_narrow_first == 1:
                arriving = sample.cos_over_pdf * sample.visible
                specular = wp.cw_mul(throughput, sample.f.specular) * arriving
                drawn = float(path_count) * sample.f.pdf
                add_to_texels(T, p, texels, sample.wi, wp.vec3(0.0), specular, drawn)
        if is_last == 1 or sample.next.valid == 0:
            break
        throughput = wp.cw_mul(throughput, f * sample.cos_over_pdf)
        wo = -sample.wi
        surface = surface_at(mesh, material, texture, sample.next, wo)
        if material.any_emission == 1:
            wp.atomic_add(emission, p, wp.cw_mul(throughput, surface.emission))


@wp.kernel
def spread_record(record: LightRecord, height: int, width: int, T: wp.array2d[wp.vec3]):
    """Turn recorded directions into rows of transport; a thread a pixel.

    Args:
        record: Directions and their weights, rows are pixels.
        height: He.
        width: We.
        T: Pixel radiance per texel radiance [1], zero, shape [pixel, texel].
    """
    p = wp.tid()
    texels = TexelArgs()
    texels.height = height
    texels.width = width
    for j in range(record.count[p]):
        add_to_texels(T, p, texels, record.wi[p, j], record.weight[p, j], wp.vec3(0.0), 0.0)
