"""Everything that shading needs at a hit: normals, factors times textures, layers."""

import warp as wp

from warpir.kernels.bsdf import layers_toward
from warpir.kernels.maths.frame import basis, to_local
from warpir.kernels.tracing.coverage import extensions_at, transmitted_share
from warpir.kernels.tracing.hit import Hit, face_normal, hit_position
from warpir.kernels.tracing.texture import (
    SLOT_ANISOTROPY,
    SLOT_BASE_COLOR,
    SLOT_CLEARCOAT_NORMAL,
    SLOT_EMISSION,
    SLOT_METALLIC_ROUGHNESS,
    SLOT_NORMAL,
    sample_texture,
    slot_difference,
    slot_uv,
)
from warpir.kernels.types import ANISOTROPY, Layers, MaterialArgs, MeshArgs, TextureArgs


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
def mapped(
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

    In the slot of anisotropy, return its direction, or ``n`` where it has none. Tangents come from
    the asset, or from the triangle's UVs as the slot transforms them. The map's green axis points
    to the top of the image, that is against v.
    """
    k = material.slot_texture[m, slot]
    uv_slot = slot
    if k < 0:
        if slot != SLOT_ANISOTROPY:
            return n
        uv_slot = SLOT_NORMAL
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
        if material.slot_uv_set[m, uv_slot] == 1:
            uv_a = mesh.uv1[a]
            uv_b = mesh.uv1[b]
            uv_c = mesh.uv1[c]
        e1 = mesh.positions[b] - mesh.positions[a]
        e2 = mesh.positions[c] - mesh.positions[a]
        d1 = slot_difference(material, m, uv_slot, uv_b - uv_a)
        d2 = slot_difference(material, m, uv_slot, uv_c - uv_a)
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
    code = wp.vec4(1.0, 0.5, 1.0, 1.0)
    if k >= 0:
        code = sample_texture(texture, k, slot_uv(mesh, material, m, slot, hit), 0)
    x = (2.0 * code[0] - 1.0) * strength
    y = (2.0 * code[1] - 1.0) * strength
    z = 2.0 * code[2] - 1.0
    if slot == SLOT_ANISOTROPY:
        turn = material.extensions[m].stretch
        along = turn[0] * x - turn[1] * y
        y = turn[1] * x + turn[0] * y
        x = along
        z = 0.0
    direction = t * x + bitangent * y + n * z
    if wp.dot(direction, direction) < 1.0e-12:
        return n
    return wp.normalize(direction)


@wp.func
def facing(n: wp.vec3, ng: wp.vec3, wo: wp.vec3) -> wp.vec3:
    """Return ``n``, or ``ng`` where it faces away from a viewer who sees the triangle.

    Interpolated and mapped normals may.
    """
    if wp.dot(n, wo) <= 0.0:
        return ng
    return n


@wp.func(inline=True)
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
    layer_count = int(1)
    if material.any_layers > 0:
        s.layers.present = material.extensions[m].present
        layer_count += s.layers.present
        if (material.any_layers & ANISOTROPY) > 0 and material.extensions[m].anisotropy > 0.0:
            layer_count = 3
    # One call in a loop: a function with one caller is inlined, else its arguments are copied.
    n = smooth_n
    coat_n = smooth_n
    stretch = smooth_n
    for layer in range(layer_count):
        slot = SLOT_NORMAL
        strength = material.normal_scale[m]
        if layer == 1:
            slot = SLOT_CLEARCOAT_NORMAL
            strength = material.extensions[m].clearcoat_normal_scale
        if layer == 2:
            slot = SLOT_ANISOTROPY
            strength = 1.0
        direction = mapped(mesh, material, texture, m, slot, strength, hit, smooth_n)
        if layer == 0:
            n = direction
        elif layer == 1:
            coat_n = direction
        else:
            # Nothing is left where it has no direction.
            stretch = direction - smooth_n * wp.dot(direction, smooth_n)
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
            e.anisotropy,
            to_local(stretch, frame),
            e.iridescence,
            e.film_ior,
            e.film_thickness,
        )
        # What shines from below the coat; all of it stands for the rays that passed too.
        s.texture_emission = s.texture_emission * s.layers.emission_scale
    s.emission = wp.cw_mul(material.emission[m], s.texture_emission)
    return s
