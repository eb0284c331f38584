"""Light transport without a light: what each texel of a lat-long map sends into each pixel.

Light at infinity enters linearly, so a pixel's radiance is a row of numbers times the map's texels.
`trace_points` finds what the camera sees; `trace_direct` and `trace_paths` make the rows of
``T_fg``, `trace_blocked` those of ``T_shadow``. The host's half is
`warpir.render.transport.integrator`. Detached: no backward pass.

A texel stands for the tent of bilinear interpolation around it (`bilinear_tap`). Directions are
drawn from that tent, evenly in solid angle, and belong to that texel alone: spread over the four
texels around it, a direction would let a sun in one texel flicker by its interpolation weight.
"""

import warp as wp

from warpir.kernels.bsdf import bsdf_f, bsdf_of, narrowest_roughness, roughness_to_alpha
from warpir.kernels.frame import basis, to_local, to_world
from warpir.kernels.latlong import BilinearTap, bilinear_tap, direction_to_uv, uv_to_direction
from warpir.kernels.receiver import ReceiverPoint, receiver_origin, receiver_point
from warpir.kernels.receiver_mesh import receiver_mesh_hit, receiver_radiance, receiver_visibility
from warpir.kernels.rng import hash_pair, hash_uint, pixel_seed, sobol_pair, to_unit
from warpir.kernels.sampling import cosine_sample, light_eval, power_heuristic, tent
from warpir.kernels.scatter import bsdf_weight, sample_bsdf, sample_emitter, surface_bsdf
from warpir.kernels.trace import (
    Surface,
    camera_hit,
    camera_ray,
    closest_hit,
    meets_box,
    offset_origin,
    surface_at,
    visibility,
)
from warpir.kernels.types import (
    CameraArgs,
    Layers,
    LightArgs,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

PI = wp.constant(3.14159265358979)
TRIES_MAX = wp.constant(32)
"""Draws until one is accepted; a texel at the horizon accepts about every third."""
TENT_REACH = wp.constant(1.5)
"""No direction of a tent is farther than this many texel heights from the texel's centre."""
NARROW = wp.constant(4.0)
"""Specular lobes with ``alpha`` below this many texel sides are sampled by the BSDF too."""
GOLDEN_ROW = wp.constant(0.5698402909980532)
GOLDEN_COLUMN = wp.constant(0.7548776662466927)
"""Steps of the R2 sequence (Roberts 2018): neighbouring texels use different points of a pixel."""


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


@wp.struct
class TexelArgs:
    """The map whose texels are the columns of the transport."""

    height: int
    width: int
    d_omega: wp.array[float]
    """Solid angle of a texel's tent in each row [sr], shape [He]."""
    direction_count: wp.array[int]
    """Directions drawn for each texel, shape [He * We]."""
    centre: wp.array[wp.vec3]
    """Direction of each texel's centre, shape [He * We]."""
    bound: wp.array[float]
    """Largest sine of the polar angle within each texel's tent; of the plane, times the largest
    cosine with its normal. Shape [He * We]."""
    item_column: wp.array[int]
    """Columns of the rows cut into pieces of work of `item_size` directions; shape [item]."""
    item_first: wp.array[int]
    """First direction of each piece, shape [item]."""
    item_count: int
    item_size: int
    lanes: int
    """Threads of a pixel; each takes every ``lanes``-th piece. A thread costs as much as a texel on
    the CPU, where one per pixel is best."""


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
            if material.any_layers == 1:
                points.layers[i, count] = surface.layers
            emitted += surface.emission
            count += 1
    points.count[i] = count
    emission[i] = emitted / float(subsamples)


@wp.func
def random_pair(key: wp.uint32, draw: int) -> wp.vec2:
    """Return draw number ``draw`` of an independent sequence, in [0, 1)^2."""
    a = hash_pair(key, wp.uint32(draw))
    return wp.vec2(to_unit(a), to_unit(hash_uint(a)))


@wp.func
def tent_uv(i: int, j: int, height: int, width: int, u: wp.vec2) -> wp.vec2:
    """Draw texture coordinates from the tent of texel (i, j), folded at the poles."""
    x = (float(j) + 0.5 + tent(u[0])) / float(width)
    y = (float(i) + 0.5 + tent(u[1])) / float(height)
    x = x - wp.floor(x)
    # Clamping the lookup beyond a pole is the same as folding the tent back.
    if y < 0.0:
        y = -y
    if y > 1.0:
        y = 2.0 - y
    return wp.vec2(x, y)


@wp.func
def tent_direction(
    texels: TexelArgs, i: int, j: int, u: wp.vec2, key: wp.uint32, weigh: int, normal: wp.vec3
) -> wp.vec3:
    """Draw a direction from texel (i, j)'s tent, evenly in solid angle.

    The density is ``weight / d_omega`` [1/sr]; with ``weigh`` 1 it also follows the cosine with
    ``normal``. ``u`` makes the first try, so its stratification survives where that is accepted.
    """
    bound = texels.bound[i * texels.width + j]
    uv = tent_uv(i, j, texels.height, texels.width, u)
    wi = uv_to_direction(uv[0], uv[1])
    for draw in range(TRIES_MAX):
        share = wp.sqrt(wi[0] * wi[0] + wi[2] * wi[2])
        if weigh == 1:
            share = share * wp.dot(wi, normal)
        if random_pair(key, 2 * draw)[0] * bound <= share:
            break
        uv = tent_uv(i, j, texels.height, texels.width, random_pair(key, 2 * draw + 1))
        wi = uv_to_direction(uv[0], uv[1])
    return wi


@wp.func
def tent_weight(tap: BilinearTap, i: int, j: int) -> float:
    """Return the interpolation weight of texel (i, j) at ``tap``."""
    weight = float(0.0)
    if tap.j0 == j:
        weight += 1.0 - tap.wj
    if tap.j1 == j:
        weight += tap.wj
    across = float(0.0)
    if tap.i0 == i:
        across += 1.0 - tap.wi
    if tap.i1 == i:
        across += tap.wi
    return weight * across


@wp.func
def texel_pdf(texels: TexelArgs, tap: BilinearTap, i: int, j: int) -> float:
    """Return the expected density of all directions drawn for texel (i, j) at ``tap`` [1/sr]."""
    count = float(texels.direction_count[i * texels.width + j])
    return count * tent_weight(tap, i, j) / texels.d_omega[i]


@wp.func
def layers_of(points: SurfacePoints, material: MaterialArgs, p: int, s: int) -> Layers:
    """Return the extensions at point ``s`` of row ``p``."""
    if material.any_layers == 1:
        return points.layers[p, s]
    layers = Layers()
    layers.present = 0
    return layers


@wp.func
def is_narrow(roughness: float, layers: Layers, height: int) -> int:
    """Return 1 when a specular lobe may be too narrow for one direction per texel."""
    if roughness_to_alpha(narrowest_roughness(roughness, layers)) < NARROW * PI / float(height):
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
    below = -wp.sin(TENT_REACH * PI / float(texels.height))
    key = hash_pair(pixel_key, wp.uint32(t))
    # Which of the pixel's points
    spot = shift + GOLDEN_ROW * float(i) + GOLDEN_COLUMN * float(j)
    spot = spot - wp.floor(spot)
    start = wp.min(int(spot * float(count)), count - 1)
    for r in range(first, wp.min(first + texels.item_size, directions)):
        s = (start + r) % count
        n = points.n[p, s]
        # Half of the texels are behind the surface: say so before a direction is drawn.
        if wp.dot(texels.centre[t], n) > below:
            u = random_pair(key, -1)
            if directions > 1:
                u = sobol_pair(r, key, 0)
            ray_key = hash_pair(key, wp.uint32(r))
            wi = tent_direction(texels, i, j, u, ray_key, 0, n)
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
            u = sobol_pair(q, key, 3 * k + 2)
            emitter = sample_emitter(
                mesh, material, texture, receiver, proposal, surface, bsdf, frame, u, u_parts[0], 0
            )
            if emitter.weight > 0.0:
                value = wp.cw_mul(throughput, emitter.f.diffuse + emitter.f.specular)
                add_to_texels(T, p, texels, emitter.wi, value * emitter.weight, wp.vec3(0.0), 0.0)

        # Sample the BSDF, continue the path
        u = sobol_pair(q, key, 3 * k + 3)
        ray_key = hash_pair(hash_pair(key, wp.uint32(q)), wp.uint32(k + 1))
        sample = sample_bsdf(
            mesh, material, texture, receiver, surface, bsdf, frame, u, u_parts[1], is_last, ray_key
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
    spot = shift + GOLDEN_ROW * float(i) + GOLDEN_COLUMN * float(j)
    spot = spot - wp.floor(spot)
    start = wp.min(int(spot * float(filled)), filled - 1)
    total = float(0.0)
    for r in range(first, wp.min(first + texels.item_size, directions)):
        ray_key = hash_pair(key, wp.uint32(r))
        u = random_pair(key, -1)
        if directions > 1:
            u = sobol_pair(r, key, 0)
        wi = tent_direction(texels, i, j, u, ray_key, 1, receiver.normal)
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
    reach = TENT_REACH * PI / float(texels.height)
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
        spot = shift + GOLDEN_ROW * float(i) + GOLDEN_COLUMN * float(j)
        spot = spot - wp.floor(spot)
        start = wp.min(int(spot * float(filled)), filled - 1)
        first = texels.item_first[item]
        total = float(0.0)
        kept = float(0.0)
        for r in range(first, wp.min(first + texels.item_size, directions)):
            s = (start + r) % filled
            point = ReceiverPoint()
            point.position = position[p, s]
            point.normal = normal[p, s]
            u = random_pair(key, -1)
            if directions > 1:
                u = sobol_pair(r, key, 0)
            wi = tent_direction(texels, i, j, u, hash_pair(key, wp.uint32(r)), 0, point.normal)
            cos_i = wp.dot(wi, point.normal)
            if cos_i > 0.0:
                origin = receiver_origin(mesh, receiver, point)
                arriving = cos_i * receiver_visibility(receiver, origin, wi)
                total += arriving
                if arriving > 0.0 and meets_box(origin, wi, mesh.low, mesh.high) == 1:
                    kept += arriving * (1.0 - visibility(mesh, material, texture, origin, wi))
        scale = texels.d_omega[i] / (PI * float(directions))
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
            ray_key = hash_pair(key, wp.uint32(q))
            hit = closest_hit(mesh, material, texture, origin, wi, receiver_hit.t, 0, ray_key)
            if hit.valid == 1:
                kept += L
    received[p] = total / float(path_count)
    blocked[p] = kept * (share[p] / float(path_count))
