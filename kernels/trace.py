"""Rays against the scene: camera rays, hits, surfaces, visibility, and the G-buffer.

Detached: no backward pass.
"""

import warp as wp

from warpir.kernels.bsdf import F0_COAT, layers_toward, luminance, schlick
from warpir.kernels.frame import basis, to_local
from warpir.kernels.receiver_mesh import INFINITY, plane_distance, receiver_mesh_hit
from warpir.kernels.rng import hash_pair, pixel_seed, sobol_pair, to_unit
from warpir.kernels.types import (
    CameraArgs,
    Extensions,
    Layers,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)

wp.set_module_options({"enable_backward": False})

ULP = wp.constant(1.1920929e-07)
LAYERS_MAX = wp.constant(64)
"""Surfaces that one ray may pass through; a safety bound, not a quality setting."""
SLOT_BASE_COLOR = wp.constant(0)
SLOT_METALLIC_ROUGHNESS = wp.constant(1)
SLOT_NORMAL = wp.constant(2)
SLOT_EMISSION = wp.constant(3)
SLOT_SPECULAR = wp.constant(4)
SLOT_SPECULAR_COLOR = wp.constant(5)
SLOT_CLEARCOAT = wp.constant(6)
SLOT_CLEARCOAT_ROUGHNESS = wp.constant(7)
SLOT_CLEARCOAT_NORMAL = wp.constant(8)
SLOT_SHEEN_COLOR = wp.constant(9)
SLOT_SHEEN_ROUGHNESS = wp.constant(10)
SLOT_TRANSMISSION = wp.constant(11)


@wp.struct
class Hit:
    """Where a ray met the mesh."""

    valid: int
    face: int
    u: float
    v: float
    """Barycentric weights of the first and second corner."""


@wp.struct
class Surface:
    """Everything that shading needs at a hit; normals face ``wo``."""

    position: wp.vec3
    ng: wp.vec3
    """Geometric normal."""
    n: wp.vec3
    """Shading normal."""
    material: int
    texture_color: wp.vec3
    """What multiplies the base colour factor: texture and vertex colour."""
    texture_metallic: float
    texture_roughness: float
    texture_emission: wp.vec3
    base_color: wp.vec3
    metallic: float
    roughness: float
    emission: wp.vec3
    layers: Layers


@wp.func
def camera_ray(camera: CameraArgs, pixel: int, jitter: wp.vec2) -> wp.vec3:
    """Return the unit direction through ``pixel`` (row-major index) at a position inside it."""
    x = float(pixel % camera.width) + jitter[0]
    y = float(pixel // camera.width) + jitter[1]
    local = wp.vec3((x - camera.cx) / camera.fx, -(y - camera.cy) / camera.fy, -1.0)
    return wp.normalize(camera.rotation * local)


@wp.func
def camera_reach(receiver: ReceiverArgs, origin: wp.vec3, direction: wp.vec3) -> float:
    """Return how far a camera ray sees [m]: to the receiver's plane or mesh and what lies there.

    Without the tolerance a sheet on the ground would be seen in a random part of its samples.
    """
    reach = plane_distance(receiver, origin, direction)
    if reach < 0.0:
        reach = INFINITY
    else:
        reach = reach - receiver.tolerance / wp.dot(receiver.normal, direction)
    hit = receiver_mesh_hit(receiver, origin, direction)
    if hit.valid == 1:
        # Along a wall a ray may graze for any distance.
        slope = wp.max(-wp.dot(hit.normal, direction), 1.0e-6)
        reach = wp.min(reach, hit.t + receiver.tolerance / slope)
    return reach


@wp.func
def offset_origin(p: wp.vec3, ng: wp.vec3, direction: wp.vec3, epsilon: float) -> wp.vec3:
    """Move a ray's start off the surface, to the side it leaves on.

    The offset is a few units in the last place of the coordinates plus a share of the scene's size.
    """
    largest = wp.max(wp.max(wp.abs(p[0]), wp.abs(p[1])), wp.abs(p[2]))
    amount = 4.0 * ULP * largest + epsilon
    if wp.dot(ng, direction) < 0.0:
        amount = -amount
    return p + ng * amount


@wp.func
def wrap(x: int, count: int, mode: int) -> int:
    """Bring a texel index into range: 0 repeat, 1 clamp, 2 mirror."""
    if mode == 1:
        return wp.clamp(x, 0, count - 1)
    if mode == 2:
        period = 2 * count
        m = x % period
        if m < 0:
            m = m + period
        if m >= count:
            m = period - 1 - m
        return m
    m = x % count
    if m < 0:
        m = m + count
    return m


@wp.func
def texel(texture: TextureArgs, k: int, i: int, j: int, is_color: int) -> wp.vec4:
    """Read one texel of texture ``k``; colour is decoded from sRGB, alpha never."""
    code = texture.texels[texture.offset[k] + i * texture.width[k] + j]
    mask = wp.uint32(255)
    r = int(code & mask)
    g = int((code >> wp.uint32(8)) & mask)
    b = int((code >> wp.uint32(16)) & mask)
    a = float(int((code >> wp.uint32(24)) & mask)) / 255.0
    if is_color == 1:
        return wp.vec4(texture.decode[r], texture.decode[g], texture.decode[b], a)
    return wp.vec4(float(r) / 255.0, float(g) / 255.0, float(b) / 255.0, a)


@wp.func
def sample_texture(texture: TextureArgs, k: int, uv: wp.vec2, is_color: int) -> wp.vec4:
    """Bilinear lookup of texture ``k``; colour is decoded before it is filtered (glTF 2.0, 3.8)."""
    width = texture.width[k]
    height = texture.height[k]
    # Far texture coordinates would overflow the integers below and carry no detail anyway.
    x = wp.clamp(uv[0] * float(width) - 0.5, -1.0e9, 1.0e9)
    y = wp.clamp(uv[1] * float(height) - 0.5, -1.0e9, 1.0e9)
    xf = wp.floor(x)
    yf = wp.floor(y)
    fx = x - xf
    fy = y - yf
    j0 = wrap(int(xf), width, texture.wrap_u[k])
    j1 = wrap(int(xf) + 1, width, texture.wrap_u[k])
    i0 = wrap(int(yf), height, texture.wrap_v[k])
    i1 = wrap(int(yf) + 1, height, texture.wrap_v[k])
    # Equal texels give exactly their value: an opaque texture must not let 1e-7 of the light pass.
    top = texel(texture, k, i0, j0, is_color)
    top = top + (texel(texture, k, i0, j1, is_color) - top) * fx
    bottom = texel(texture, k, i1, j0, is_color)
    bottom = bottom + (texel(texture, k, i1, j1, is_color) - bottom) * fx
    return top + (bottom - top) * fy


@wp.func
def slot_uv(mesh: MeshArgs, material: MaterialArgs, m: int, slot: int, hit: Hit) -> wp.vec2:
    """Interpolate and transform the texture coordinates that a slot uses."""
    a = mesh.indices[3 * hit.face]
    b = mesh.indices[3 * hit.face + 1]
    c = mesh.indices[3 * hit.face + 2]
    w = 1.0 - hit.u - hit.v
    uv = mesh.uv0[a] * hit.u + mesh.uv0[b] * hit.v + mesh.uv0[c] * w
    if material.slot_uv_set[m, slot] == 1:
        uv = mesh.uv1[a] * hit.u + mesh.uv1[b] * hit.v + mesh.uv1[c] * w
    row_u = material.slot_u[m, slot]
    row_v = material.slot_v[m, slot]
    return wp.vec2(
        row_u[0] * uv[0] + row_u[1] * uv[1] + row_u[2],
        row_v[0] * uv[0] + row_v[1] * uv[1] + row_v[2],
    )


@wp.func
def face_normal(mesh: MeshArgs, face: int) -> wp.vec3:
    """Return the unit geometric normal of a triangle."""
    a = mesh.positions[mesh.indices[3 * face]]
    b = mesh.positions[mesh.indices[3 * face + 1]]
    c = mesh.positions[mesh.indices[3 * face + 2]]
    return wp.normalize(wp.cross(b - a, c - a))


@wp.func
def hit_coverage(mesh: MeshArgs, material: MaterialArgs, texture: TextureArgs, hit: Hit) -> float:
    """Return the coverage at a hit: 1 for opaque materials, 0 or 1 for masked ones."""
    m = mesh.face_material[hit.face]
    if material.alpha_mode[m] == 0:
        return 1.0
    a = mesh.colors[mesh.indices[3 * hit.face]][3]
    b = mesh.colors[mesh.indices[3 * hit.face + 1]][3]
    c = mesh.colors[mesh.indices[3 * hit.face + 2]][3]
    # Written so that equal corners give exactly their value: the cutoff compares with it.
    alpha = material.alpha[m] * (c + (a - c) * hit.u + (b - c) * hit.v)
    k = material.slot_texture[m, SLOT_BASE_COLOR]
    if k >= 0:
        uv = slot_uv(mesh, material, m, SLOT_BASE_COLOR, hit)
        alpha = alpha * sample_texture(texture, k, uv, 0)[3]
    if material.alpha_mode[m] == 1:
        if alpha >= material.alpha_cutoff[m]:
            return 1.0
        return 0.0
    return wp.clamp(alpha, 0.0, 1.0)


@wp.func
def extensions_at(
    mesh: MeshArgs, material: MaterialArgs, texture: TextureArgs, m: int, hit: Hit
) -> Extensions:
    """Read the extensions of material ``m`` at a hit."""
    e = material.extensions[m]
    # In a loop: eight inlined lookups slow down scenes that need none of them.
    for slot in range(SLOT_SPECULAR, material.slot_texture.shape[1]):
        k = material.slot_texture[m, slot]
        if k >= 0 and slot != SLOT_CLEARCOAT_NORMAL:
            is_color = int(0)
            if slot == SLOT_SPECULAR_COLOR or slot == SLOT_SHEEN_COLOR:
                is_color = 1
            uv = slot_uv(mesh, material, m, slot, hit)
            code = sample_texture(texture, k, uv, is_color)
            color = wp.vec3(code[0], code[1], code[2])
            if slot == SLOT_SPECULAR:
                e.specular = e.specular * code[3]
            elif slot == SLOT_SPECULAR_COLOR:
                e.f0 = wp.cw_mul(e.f0, color)
            elif slot == SLOT_CLEARCOAT:
                e.clearcoat = e.clearcoat * code[0]
            elif slot == SLOT_CLEARCOAT_ROUGHNESS:
                e.clearcoat_roughness = e.clearcoat_roughness * code[1]
            elif slot == SLOT_SHEEN_COLOR:
                e.sheen_color = wp.cw_mul(e.sheen_color, color)
            elif slot == SLOT_SHEEN_ROUGHNESS:
                e.sheen_roughness = e.sheen_roughness * code[3]
            else:
                e.transmission = e.transmission * code[0]
    return e


@wp.func
def transmitted_share(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    m: int,
    hit: Hit,
    direction: wp.vec3,
) -> float:
    """Return the share of light that passes a thin transmissive wall straight on.

    KHR_materials_transmission for a surface of roughness 0, its tint reduced to luminance: what
    coat and dielectric do not reflect, times the base colour. The angle is that with the
    interpolated normal, so that rays need not read normal maps.
    """
    e = extensions_at(mesh, material, texture, m, hit)
    a = mesh.indices[3 * hit.face]
    b = mesh.indices[3 * hit.face + 1]
    c = mesh.indices[3 * hit.face + 2]
    w = 1.0 - hit.u - hit.v
    n = mesh.normals[a] * hit.u + mesh.normals[b] * hit.v + mesh.normals[c] * w
    vertex = mesh.colors[a] * hit.u + mesh.colors[b] * hit.v + mesh.colors[c] * w
    tint = wp.cw_mul(material.base_color[m], wp.vec3(vertex[0], vertex[1], vertex[2]))
    k = material.slot_texture[m, SLOT_BASE_COLOR]
    if k >= 0:
        code = sample_texture(texture, k, slot_uv(mesh, material, m, SLOT_BASE_COLOR, hit), 1)
        tint = wp.cw_mul(tint, wp.vec3(code[0], code[1], code[2]))
    metallic = material.metallic[m]
    k = material.slot_texture[m, SLOT_METALLIC_ROUGHNESS]
    if k >= 0:
        uv = slot_uv(mesh, material, m, SLOT_METALLIC_ROUGHNESS, hit)
        metallic *= sample_texture(texture, k, uv, 0)[2]
    weight = schlick(wp.abs(wp.dot(wp.normalize(n), direction)))
    f0 = wp.min(wp.max(e.f0), 1.0)
    reflected = e.specular * (f0 + (1.0 - f0) * weight)
    coat = e.clearcoat * (F0_COAT + (1.0 - F0_COAT) * weight)
    share = e.transmission * (1.0 - metallic) * luminance(tint)
    return share * (1.0 - reflected) * (1.0 - coat)


@wp.func
def hit_alpha(
    mesh: MeshArgs, material: MaterialArgs, texture: TextureArgs, hit: Hit, ray_dir: wp.vec3
) -> float:
    """Return the share of rays that a hit stops: its coverage, less what passes the material."""
    alpha = hit_coverage(mesh, material, texture, hit)
    m = mesh.face_material[hit.face]
    if material.any_layers == 1 and material.extensions[m].transmission > 0.0:
        alpha *= 1.0 - transmitted_share(mesh, material, texture, m, hit, ray_dir)
    return alpha


@wp.func
def hit_position(mesh: MeshArgs, hit: Hit) -> wp.vec3:
    """Interpolate the position from the corners, which is more precise than ``o + t d``."""
    a = mesh.positions[mesh.indices[3 * hit.face]]
    b = mesh.positions[mesh.indices[3 * hit.face + 1]]
    c = mesh.positions[mesh.indices[3 * hit.face + 2]]
    return a * hit.u + b * hit.v + c * (1.0 - hit.u - hit.v)


@wp.func
def facing_twin(mesh: MeshArgs, position: wp.vec3, ray_dir: wp.vec3) -> Hit:
    """Find a triangle in the place of a culled one that faces the ray; ``valid`` is 0 without one.

    Sheets are often modelled as two single-sided ones in one place, and a query returns either. A
    ray that goes on from the culled one starts beyond both.
    """
    twin = Hit()
    twin.valid = 0
    largest = wp.max(wp.max(wp.abs(position[0]), wp.abs(position[1])), wp.abs(position[2]))
    reach = 4.0 * ULP * largest + mesh.epsilon
    margin = wp.vec3(reach, reach, reach)
    query = wp.mesh_query_aabb(mesh.id, position - margin, position + margin)
    face = int(0)
    while wp.mesh_query_aabb_next(query, face):
        a = mesh.positions[mesh.indices[3 * face]]
        b = mesh.positions[mesh.indices[3 * face + 1]]
        c = mesh.positions[mesh.indices[3 * face + 2]]
        n = wp.cross(b - a, c - a)
        area = wp.length(n)
        if wp.dot(n, ray_dir) < 0.0 and wp.abs(wp.dot(position - a, n)) <= reach * area:
            u = wp.dot(wp.cross(c - b, position - b), n) / (area * area)
            v = wp.dot(wp.cross(a - c, position - c), n) / (area * area)
            # Rounding must not drop a point between two halves of the twin.
            if wp.min(wp.min(u, v), 1.0 - u - v) >= -1.0e-5:
                twin.valid = 1
                twin.face = face
                twin.u = wp.clamp(u, 0.0, 1.0)
                twin.v = wp.clamp(v, 0.0, 1.0 - twin.u)
    return twin


@wp.func
def closest_hit(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
    max_t: float,
    is_camera_ray: int,
    key: wp.uint32,
) -> Hit:
    """Find the first surface that the ray does not pass through.

    A camera ray passes the back of a single-sided material; any ray passes a point of opacity alpha
    with probability ``1 - alpha``, drawn from ``key``.
    """
    hit = Hit()
    hit.valid = 0
    if mesh.id == wp.uint64(0):
        return hit
    origin = ray_origin
    for layer in range(LAYERS_MAX):
        query = wp.mesh_query_ray(mesh.id, origin, ray_dir, max_t)
        if not query.result:
            return hit
        hit.face = query.face
        hit.u = query.u
        hit.v = query.v
        accept = int(1)
        if is_camera_ray == 1 and material.any_culled == 1:
            if material.double_sided[mesh.face_material[query.face]] == 0:
                if wp.dot(face_normal(mesh, query.face), ray_dir) > 0.0:
                    twin = facing_twin(mesh, hit_position(mesh, hit), ray_dir)
                    accept = twin.valid
                    if twin.valid == 1:
                        hit = twin
        if accept == 1 and material.any_alpha == 1:
            alpha = hit_alpha(mesh, material, texture, hit, ray_dir)
            if alpha < 1.0:
                if to_unit(hash_pair(key, wp.uint32(layer))) >= alpha:
                    accept = 0
        if accept == 1:
            hit.valid = 1
            return hit
        # Bounds on max_t apply to the whole ray; what is left of it shrinks with each layer.
        position = hit_position(mesh, hit)
        max_t = max_t - wp.length(position - origin)
        origin = offset_origin(position, face_normal(mesh, query.face), ray_dir, mesh.epsilon)
    return hit


@wp.func
def camera_hit(
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    s: int,
    key: wp.uint32,
    ray_dir: wp.vec3,
) -> Hit:
    """Find what a pixel's camera sample ``s`` sees of the object; the plane hides what is below.

    ``ray_dir`` is `camera_ray` at ``sobol_pair(s, key, 0)``.
    """
    reach = camera_reach(receiver, camera.origin, ray_dir)
    return closest_hit(
        mesh, material, texture, camera.origin, ray_dir, reach, 1, hash_pair(key, wp.uint32(s))
    )


@wp.func
def meets_box(origin: wp.vec3, wi: wp.vec3, low: wp.vec3, high: wp.vec3) -> int:
    """Return 1 when the ray may meet the box; most rays from a plane do not."""
    near = float(0.0)
    far = float(INFINITY)
    for axis in range(3):
        if wp.abs(wi[axis]) > 1.0e-12:
            a = (low[axis] - origin[axis]) / wi[axis]
            b = (high[axis] - origin[axis]) / wi[axis]
            near = wp.max(near, wp.min(a, b))
            far = wp.min(far, wp.max(a, b))
        elif origin[axis] < low[axis] or origin[axis] > high[axis]:
            return 0
    if near <= far:
        return 1
    return 0


@wp.func
def visibility(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    ray_origin: wp.vec3,
    ray_dir: wp.vec3,
) -> float:
    """Return the share of light that reaches ``ray_origin`` from infinity along ``ray_dir``."""
    if mesh.id == wp.uint64(0):
        return 1.0
    if material.any_alpha == 0:
        if wp.mesh_query_ray_anyhit(mesh.id, ray_origin, ray_dir, INFINITY):
            return 0.0
        return 1.0
    transmitted = float(1.0)
    origin = ray_origin
    hit = Hit()
    for _layer in range(LAYERS_MAX):
        query = wp.mesh_query_ray(mesh.id, origin, ray_dir, INFINITY)
        if not query.result:
            return transmitted
        hit.face = query.face
        hit.u = query.u
        hit.v = query.v
        transmitted = transmitted * (1.0 - hit_alpha(mesh, material, texture, hit, ray_dir))
        if transmitted <= 0.0:
            return 0.0
        origin = offset_origin(
            hit_position(mesh, hit), face_normal(mesh, query.face), ray_dir, mesh.epsilon
        )
    return 0.0


@wp.func
def mapped_normal(
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    m: int,
    slot: int,
    strength: float,
    hit: Hit,
    n: wp.vec3,
) -> wp.vec3:
    """Apply a normal map of material ``m``, of that strength, to the interpolated normal ``n``.

    Tangents come from the asset, or from the triangle's UVs. The map's green axis points to the top
    of the image, that is against v.
    """
    k = material.slot_texture[m, slot]
    if k < 0:
        return n
    a = mesh.indices[3 * hit.face]
    b = mesh.indices[3 * hit.face + 1]
    c = mesh.indices[3 * hit.face + 2]
    w = 1.0 - hit.u - hit.v
    given = mesh.tangents[a] * hit.u + mesh.tangents[b] * hit.v + mesh.tangents[c] * w
    t = wp.vec3(given[0], given[1], given[2])
    handedness = mesh.tangents[a][3]
    if handedness == 0.0:
        uv_a = mesh.uv0[a]
        uv_b = mesh.uv0[b]
        uv_c = mesh.uv0[c]
        if material.slot_uv_set[m, slot] == 1:
            uv_a = mesh.uv1[a]
            uv_b = mesh.uv1[b]
            uv_c = mesh.uv1[c]
        e1 = mesh.positions[b] - mesh.positions[a]
        e2 = mesh.positions[c] - mesh.positions[a]
        d1 = uv_b - uv_a
        d2 = uv_c - uv_a
        det = d1[0] * d2[1] - d1[1] * d2[0]
        if wp.abs(det) < 1.0e-20:
            return n
        inv = 1.0
        if det < 0.0:
            inv = -1.0
        t = (e1 * d2[1] - e2 * d1[1]) * inv
        up = (e1 * d2[0] - e2 * d1[0]) * inv  # -dp/dv, up to a positive factor
        handedness = 1.0
        if wp.dot(wp.cross(n, t), up) < 0.0:
            handedness = -1.0
    t = t - n * wp.dot(n, t)
    if wp.dot(t, t) < 1.0e-20:
        return n
    t = wp.normalize(t)
    bitangent = wp.cross(n, t) * handedness
    code = sample_texture(texture, k, slot_uv(mesh, material, m, slot, hit), 0)
    x = (2.0 * code[0] - 1.0) * strength
    y = (2.0 * code[1] - 1.0) * strength
    z = 2.0 * code[2] - 1.0
    mapped = t * x + bitangent * y + n * z
    if wp.dot(mapped, mapped) < 1.0e-12:
        return n
    return wp.normalize(mapped)


@wp.func
def facing(n: wp.vec3, ng: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """Return ``n``, or ``ng`` where it faces away from a viewer who sees the triangle.

    Interpolated and mapped normals may.
    """
    if wp.dot(n, wo) <= 0.0:
        return ng
    return n


@wp.func
def surface_at(
    mesh: MeshArgs, material: MaterialArgs, texture: TextureArgs, hit: Hit, wo: wp.vec3
) -> Surface:
    """Gather everything that shading needs at a hit."""
    a = mesh.indices[3 * hit.face]
    b = mesh.indices[3 * hit.face + 1]
    c = mesh.indices[3 * hit.face + 2]
    w = 1.0 - hit.u - hit.v
    m = mesh.face_material[hit.face]
    s = Surface()
    s.position = hit_position(mesh, hit)
    s.material = m
    s.ng = face_normal(mesh, hit.face)
    smooth_n = mesh.normals[a] * hit.u + mesh.normals[b] * hit.v + mesh.normals[c] * w
    if wp.dot(smooth_n, smooth_n) > 1.0e-12:
        smooth_n = wp.normalize(smooth_n)
    else:
        smooth_n = s.ng
    s.layers.present = 0
    if material.any_layers == 1:
        s.layers.present = material.extensions[m].present
    # One call in a loop: a function with one caller is inlined, else its arguments are copied.
    n = smooth_n
    coat_n = smooth_n
    for layer in range(1 + s.layers.present):
        slot = SLOT_NORMAL
        strength = material.normal_scale[m]
        if layer == 1:
            slot = SLOT_CLEARCOAT_NORMAL
            strength = material.extensions[m].clearcoat_normal_scale
        mapped = mapped_normal(mesh, material, texture, m, slot, strength, hit, smooth_n)
        if layer == 0:
            n = mapped
        else:
            coat_n = mapped
    side = float(1.0)
    if wp.dot(s.ng, wo) < 0.0:
        side = -1.0
    s.ng = s.ng * side
    s.n = facing(n * side, s.ng, wo)

    color = mesh.colors[a] * hit.u + mesh.colors[b] * hit.v + mesh.colors[c] * w
    s.texture_color = wp.vec3(color[0], color[1], color[2])
    k = material.slot_texture[m, SLOT_BASE_COLOR]
    if k >= 0:
        uv = slot_uv(mesh, material, m, SLOT_BASE_COLOR, hit)
        code = sample_texture(texture, k, uv, 1)
        s.texture_color = wp.cw_mul(s.texture_color, wp.vec3(code[0], code[1], code[2]))
    s.texture_metallic = 1.0
    s.texture_roughness = 1.0
    k = material.slot_texture[m, SLOT_METALLIC_ROUGHNESS]
    if k >= 0:
        uv = slot_uv(mesh, material, m, SLOT_METALLIC_ROUGHNESS, hit)
        code = sample_texture(texture, k, uv, 0)
        s.texture_roughness = code[1]
        s.texture_metallic = code[2]
    s.texture_emission = wp.vec3(1.0, 1.0, 1.0)
    k = material.slot_texture[m, SLOT_EMISSION]
    if k >= 0:
        uv = slot_uv(mesh, material, m, SLOT_EMISSION, hit)
        code = sample_texture(texture, k, uv, 1)
        s.texture_emission = wp.vec3(code[0], code[1], code[2])
    s.base_color = wp.cw_mul(material.base_color[m], s.texture_color)
    s.metallic = material.metallic[m] * s.texture_metallic
    s.roughness = material.roughness[m] * s.texture_roughness
    if s.layers.present == 1:
        coat_n = facing(coat_n * side, s.ng, wo)
        e = extensions_at(mesh, material, texture, m, hit)
        transmitted = float(0.0)
        if e.transmission > 0.0:
            transmitted = transmitted_share(mesh, material, texture, m, hit, wo)
        frame = basis(s.n)
        s.layers = layers_toward(
            to_local(wo, frame),
            e.f0,
            e.specular,
            e.transmission,
            transmitted,
            e.sheen_color,
            e.sheen_roughness,
            material.sheen_albedo,
            e.clearcoat,
            e.clearcoat_roughness,
            to_local(coat_n, frame),
        )
        # What shines from below the coat; all of it stands for the rays that passed too.
        s.texture_emission = s.texture_emission * s.layers.emission_scale
    s.emission = wp.cw_mul(material.emission[m], s.texture_emission)
    return s


@wp.kernel
def trace_gbuffer(
    pixels: wp.array[int],
    camera: CameraArgs,
    mesh: MeshArgs,
    material: MaterialArgs,
    texture: TextureArgs,
    receiver: ReceiverArgs,
    spp: int,
    seed: int,
    coverage: wp.array[float],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    roughness: wp.array[float],
    emission: wp.array[wp.vec3],
):
    """Average what the camera sees of the object in each listed pixel.

    ``coverage`` is the share of samples that see the object; the others are means over those.
    """
    i = wp.tid()
    pixel = pixels[i]
    key = pixel_seed(seed, pixel)
    count = float(0.0)
    p = wp.vec3(0.0)
    n = wp.vec3(0.0)
    color = wp.vec3(0.0)
    rough = float(0.0)
    emitted = wp.vec3(0.0)
    for s in range(spp):
        ray_dir = camera_ray(camera, pixel, sobol_pair(s, key, 0))
        hit = camera_hit(camera, mesh, material, texture, receiver, s, key, ray_dir)
        if hit.valid == 1:
            surface = surface_at(mesh, material, texture, hit, -ray_dir)
            count += 1.0
            p += surface.position
            n += surface.n
            color += surface.base_color
            rough += surface.roughness
            emitted += surface.emission
    if count > 0.0:
        coverage[i] = count / float(spp)
        position[i] = p / count
        normal[i] = wp.normalize(n)
        base_color[i] = color / count
        roughness[i] = rough / count
        emission[i] = emitted / count
