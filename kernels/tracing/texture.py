"""Textures at a hit: wrapped texels, bilinear lookup, transformed coordinates."""

import warp as wp

from warpir.kernels.tracing.hit import Hit
from warpir.kernels.types import MaterialArgs, MeshArgs, TextureArgs

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
SLOT_ANISOTROPY = wp.constant(12)
SLOT_IRIDESCENCE = wp.constant(13)
SLOT_IRIDESCENCE_THICKNESS = wp.constant(14)


@wp.func
def wrap(x: int, count: int, mode: int) -> int:
    """Bring a texel index into range: 0 repeat, 1 clamp, 2 mirror."""
    if x >= 0 and x < count:
        return x  # without a division
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
def slot_difference(material: MaterialArgs, m: int, slot: int, uv: wp.vec2) -> wp.vec2:
    """Transform a difference of texture coordinates as a slot does: without the shift."""
    row_u = material.slot_u[m, slot]
    row_v = material.slot_v[m, slot]
    return wp.vec2(row_u[0] * uv[0] + row_u[1] * uv[1], row_v[0] * uv[0] + row_v[1] * uv[1])


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
    shift = wp.vec2(material.slot_u[m, slot][2], material.slot_v[m, slot][2])
    return slot_difference(material, m, slot, uv) + shift
