"""What stops a ray at a hit: opacity, masks, and light that passes a thin wall."""

import warp as wp

from warpir.kernels.bsdf import F0_COAT, luminance, sheen_albedo_at
from warpir.kernels.maths.fresnel import film_fresnel, schlick
from warpir.kernels.tracing.hit import Hit
from warpir.kernels.tracing.texture import (
    SLOT_ANISOTROPY,
    SLOT_BASE_COLOR,
    SLOT_CLEARCOAT,
    SLOT_CLEARCOAT_NORMAL,
    SLOT_CLEARCOAT_ROUGHNESS,
    SLOT_IRIDESCENCE,
    SLOT_METALLIC_ROUGHNESS,
    SLOT_SHEEN_COLOR,
    SLOT_SHEEN_ROUGHNESS,
    SLOT_SPECULAR,
    SLOT_SPECULAR_COLOR,
    SLOT_TRANSMISSION,
    sample_texture,
    slot_uv,
)
from warpir.kernels.types import (
    ANISOTROPY,
    IRIDESCENCE,
    Extensions,
    MaterialArgs,
    MeshArgs,
    TextureArgs,
)

FILM_MIN = wp.constant(0.03)
"""Below this a film fades out, as in Khronos's sample viewer [nm]."""


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
            elif slot == SLOT_TRANSMISSION:
                e.transmission = e.transmission * code[0]
            elif slot == SLOT_ANISOTROPY:
                e.anisotropy = e.anisotropy * code[2]
            elif slot == SLOT_IRIDESCENCE:
                e.iridescence = e.iridescence * code[0]
            else:
                e.film_thickness = wp.lerp(e.film_minimum, e.film_thickness, code[1])
    # Compilers see that what no material has is not there.
    if (material.any_layers & ANISOTROPY) == 0:
        e.anisotropy = 0.0
    if (material.any_layers & IRIDESCENCE) == 0:
        e.iridescence = 0.0
    if e.iridescence > 0.0:
        # Thinner than an atom a film fades out, and leaves the base as it is.
        x = wp.min(e.film_thickness / FILM_MIN, 1.0)
        e.iridescence = e.iridescence * x * x * (3.0 - 2.0 * x)
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
    coat, sheen and dielectric do not reflect, times the base colour. The angle is that with the
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
    cos_o = wp.abs(wp.dot(wp.normalize(n), direction))
    weight = schlick(cos_o)
    f0 = wp.min(wp.max(e.f0), 1.0)
    reflected = e.specular * (f0 + (1.0 - f0) * weight)
    coat = e.clearcoat * (F0_COAT + (1.0 - F0_COAT) * weight)
    if e.iridescence > 0.0:
        # The base's diffuse lobe too gets what the largest channel leaves.
        own = wp.min(e.f0, wp.vec3(1.0)) * e.specular
        bare = own + (wp.vec3(e.specular) - own) * weight
        film = film_fresnel(own, e.film_ior, e.film_thickness, cos_o)
        reflected = wp.max(bare + (film - bare) * e.iridescence)
    share = e.transmission * (1.0 - metallic) * luminance(tint)
    if wp.max(e.sheen_color) > 0.0:
        albedo = sheen_albedo_at(material.sheen_albedo, cos_o, e.sheen_roughness)
        share *= wp.max(1.0 - wp.max(e.sheen_color) * albedo, 0.0)
    return share * (1.0 - reflected) * (1.0 - coat)


@wp.func
def hit_alpha(
    mesh: MeshArgs, material: MaterialArgs, texture: TextureArgs, hit: Hit, ray_dir: wp.vec3
) -> float:
    """Return the share of rays that a hit stops: its coverage, less what passes the material."""
    alpha = hit_coverage(mesh, material, texture, hit)
    m = mesh.face_material[hit.face]
    if material.any_layers > 0 and material.extensions[m].transmission > 0.0:
        alpha *= 1.0 - transmitted_share(mesh, material, texture, m, hit, ray_dir)
    return alpha
