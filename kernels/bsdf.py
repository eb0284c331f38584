"""The BSDF of glTF 2.0, metallic-roughness and its layers, in the frame of the shading normal (z).

glTF 2.0 specification, appendix B: ``mix(dielectric_brdf, metal_brdf, metallic)`` with GGX
(Trowbridge-Reitz), height-correlated Smith masking, Schlick's Fresnel term, and a Lambert base that
receives what the dielectric's Fresnel term leaves. Schlick's term is affine in F0, so the two
specular lobes are one with ``f0 = mix(0.04, base_color, metallic)``. (An older, single-lobe sample
code took that F0 for the base as well; Khronos corrected it in glTF issue 2386.)

Extensions, each as its specification has it (KHR_materials_ior, _specular, _clearcoat, _sheen,
_transmission, _anisotropy, _iridescence), are in `Layers`: the dielectric's F0 and F90, a clear
coat over everything with a normal of its own, and the sheen of cloth over the base, which it scales
by what the sheen leaves (the specification's form that depends on the camera's direction alone).
The coat's lobe goes with the cosine to its own normal. Anisotropy stretches the base's specular
lobe in one direction: GGX of two widths is that of one in coordinates of which one is scaled (Heitz
2014, 5.3). Iridescence replaces its Fresnel term (`warpir.kernels.maths.fresnel`).

A `Bsdf` is a point's scattering as seen from one direction. `bsdf_f` returns its value and, since
both share half of their terms, the density of `bsdf_sample`. Sampling draws visible normals (Heitz
2018; Dupuy & Benyoub 2023, "Sampling Visible GGX Normals with Spherical Caps").
"""

import warp as wp

from warpir.kernels.maths.frame import basis, to_local, to_world
from warpir.kernels.maths.fresnel import film_fresnel, schlick
from warpir.kernels.sampling import cosine_sample
from warpir.kernels.types import Layers

INV_PI = wp.constant(0.318309886183791)
ALPHA_MIN = wp.constant(1.0e-3)
"""Below this the lobe is narrower than float32 directions resolve; the specification allows it."""
F0_DIELECTRIC = wp.constant(0.04)
F0_COAT = wp.constant(0.04)


@wp.struct
class Bsdf:
    """Scattering at one point as seen from ``wo``; directions are in the shading normal's frame."""

    wo: wp.vec3
    """Unit direction toward the camera."""
    base_color: wp.vec3
    """Linear RGB [1]."""
    metallic: float
    """0 dielectric to 1 metal [1]."""
    roughness: float
    """Perceptual roughness [1]."""
    layers: Layers
    """What goes beyond that, as seen from ``wo``."""
    p: wp.vec2
    """Probabilities of sampling the coat, and else the specular lobe of the base."""


@wp.struct
class BsdfValue:
    """A BSDF's value, split as the renderer's layers need it, without cosine, and its density."""

    diffuse: wp.vec3
    """Of base and sheen [1/sr]."""
    specular: wp.vec3
    """Of base and coat [1/sr]."""
    pdf: float
    """Density of `bsdf_sample` [1/sr]; zero outside its support."""


@wp.func
def roughness_to_alpha(roughness: float) -> float:
    """Return GGX ``alpha = roughness^2``, clamped at `ALPHA_MIN`."""
    return wp.max(roughness * roughness, ALPHA_MIN)


@wp.func
def ggx_d(wm: wp.vec3, alpha: float) -> float:
    """GGX normal distribution [1/sr] (Walter et al. 2007, eq. 33), zero below the horizon.

    Written with the slopes x/alpha, y/alpha: ``1 - z^2`` would cancel for smooth surfaces.
    """
    if wm[2] <= 0.0:
        return 0.0
    x = wm[0] / alpha
    y = wm[1] / alpha
    s = x * x + y * y + wm[2] * wm[2]
    return 1.0 / (wp.PI * alpha * alpha * s * s)


@wp.func
def smith_lambda(w: wp.vec3, alpha: float) -> float:
    """Smith's auxiliary function for GGX (Heitz 2014, eq. 72)."""
    z2 = wp.max(w[2] * w[2], 1.0e-14)
    tan2 = (w[0] * w[0] + w[1] * w[1]) / z2
    return 0.5 * (wp.sqrt(1.0 + alpha * alpha * tan2) - 1.0)


@wp.func
def widening(alpha: float, layers: Layers) -> float:
    """Return how many times as wide the base's lobe is along its stretch as across it.

    ``mix(alpha, 1, strength^2) / alpha`` (KHR_materials_anisotropy).
    """
    if layers.present == 0:
        return 1.0
    return 1.0 + layers.anisotropy * (1.0 / alpha - 1.0)


@wp.func
def along_stretch(w: wp.vec3, layers: Layers, scale: float) -> wp.vec3:
    """Return ``w`` in the frame whose x is the stretch, its x scaled; as it is for a scale of 1."""
    if scale == 1.0:
        return w
    x = w[0] * layers.stretch[0] + w[1] * layers.stretch[1]
    y = w[1] * layers.stretch[0] - w[0] * layers.stretch[1]
    return wp.vec3(scale * x, y, w[2])


@wp.func
def from_stretch(wm: wp.vec3, layers: Layers, scale: float) -> wp.vec3:
    """Return ``wm`` from the frame whose x is the stretch, its x scaled first; a unit vector."""
    if scale == 1.0:
        return wm
    x = scale * wm[0]
    return wp.normalize(
        wp.vec3(
            x * layers.stretch[0] - wm[1] * layers.stretch[1],
            x * layers.stretch[1] + wm[1] * layers.stretch[0],
            wm[2],
        )
    )


@wp.func
def luminance(color: wp.vec3) -> float:
    """Return the luminance of linear Rec.709 [1]."""
    return 0.2126 * color[0] + 0.7152 * color[1] + 0.0722 * color[2]


@wp.func
def sheen_lambda(cos_theta: float, alpha: float) -> float:
    """Fitted masking of fibres (Conty & Kulla 2017; KHR_materials_sheen)."""
    q = (1.0 - alpha) * (1.0 - alpha)
    a = wp.lerp(21.5473, 25.3245, q)
    b = wp.lerp(3.82987, 3.32435, q)
    c = wp.lerp(0.19823, 0.16801, q)
    d = wp.lerp(-1.97760, -1.27393, q)
    e = wp.lerp(-4.32054, -4.85967, q)
    x = cos_theta
    if cos_theta >= 0.5:
        x = 1.0 - cos_theta
    # The curve is continued beyond 0.5 as its own reflection at that point.
    curve = a / (1.0 + b * wp.pow(wp.max(x, 0.0), c)) + d * x + e
    if cos_theta >= 0.5:
        curve = 2.0 * (a / (1.0 + b * wp.pow(0.5, c)) + 0.5 * d + e) - curve
    return wp.exp(curve)


@wp.func
def sheen_lobe(wo: wp.vec3, wi: wp.vec3, wm: wp.vec3, roughness: float) -> float:
    """Charlie distribution times its visibility [1/sr] (KHR_materials_sheen)."""
    alpha = roughness_to_alpha(roughness)
    sin2 = wm[0] * wm[0] + wm[1] * wm[1]
    D = (2.0 + 1.0 / alpha) * wp.pow(sin2, 0.5 / alpha) * (0.5 * INV_PI)
    masking = 1.0 + sheen_lambda(wo[2], alpha) + sheen_lambda(wi[2], alpha)
    return D / wp.max(masking * 4.0 * wo[2] * wi[2], 1.0e-30)


@wp.func
def sheen_albedo_at(table: wp.array2d[float], cos_o: float, roughness: float) -> float:
    """Read `warpir.scene.sheen.sheen_albedo_table` bilinearly."""
    last = table.shape[0] - 1
    x = wp.sqrt(wp.sqrt(wp.clamp(cos_o, 0.0, 1.0))) * float(last)
    y = wp.clamp(roughness, 0.0, 1.0) * float(last)
    j = wp.min(int(x), last - 1)
    i = wp.min(int(y), last - 1)
    fx = x - float(j)
    low = wp.lerp(table[i, j], table[i, j + 1], fx)
    high = wp.lerp(table[i + 1, j], table[i + 1, j + 1], fx)
    return wp.lerp(low, high, y - float(i))


@wp.func
def layers_toward(
    wo: wp.vec3,
    f0: wp.vec3,
    specular: float,
    transmission: float,
    transmitted: float,
    sheen_color: wp.vec3,
    sheen_roughness: float,
    sheen_albedo: wp.array2d[float],
    clearcoat: float,
    coat_roughness: float,
    coat_n: wp.vec3,
    anisotropy: float,
    stretch: wp.vec3,
    iridescence: float,
    film_ior: float,
    film_thickness: float,
) -> Layers:
    """Gather the extensions of one point as seen from ``wo``.

    Args:
        wo: Unit direction toward the camera, local frame.
        f0: Reflectance of the dielectric at normal incidence, before clamping [1].
        specular: Strength of the dielectric's reflection [1].
        transmission: Share of what enters the dielectric that leaves on the other side [1].
        transmitted: Share of all rays that pass the surface and never come here [1]; those that do
            stand for them too.
        sheen_color: Linear RGB [1].
        sheen_roughness: Perceptual roughness [1].
        sheen_albedo: From `warpir.scene.sheen.sheen_albedo_table`.
        clearcoat: Share of the surface that the coat covers [1].
        coat_roughness: Perceptual roughness [1].
        coat_n: Unit normal of the coat, local frame.
        anisotropy: Strength [1].
        stretch: Direction in which the base's lobe is wider, local frame; its z is not looked at.
        iridescence: Share of the base that has a thin film [1].
        film_ior: Its index of refraction.
        film_thickness: Its thickness [nm].
    """
    layers = Layers()
    layers.present = 1
    layers.f0 = wp.min(f0, wp.vec3(1.0, 1.0, 1.0)) * specular
    layers.f90 = specular
    layers.matte = 1.0 - transmission
    layers.coat_roughness = coat_roughness
    layers.coat_n = coat_n
    layers.sheen_roughness = sheen_roughness
    layers.iridescence = iridescence
    layers.film_ior = film_ior
    layers.film_thickness = film_thickness
    layers.anisotropy = 0.0
    length = wp.sqrt(stretch[0] * stretch[0] + stretch[1] * stretch[1])
    if anisotropy > 0.0 and length > 1.0e-6:
        layers.anisotropy = anisotropy * anisotropy
        layers.stretch = wp.vec2(stretch[0], stretch[1]) / length
    gain = 1.0 / wp.max(1.0 - transmitted, 1.0e-6)
    coat = clearcoat * (F0_COAT + (1.0 - F0_COAT) * schlick(wp.abs(wp.dot(wo, coat_n))))
    below = gain * (1.0 - coat)
    layers.coat_weight = gain * coat
    layers.sheen_color = sheen_color * below
    layers.sheen_albedo = 0.0
    layers.base_scale = below
    layers.emission_scale = below
    if wp.max(sheen_color) > 0.0:
        albedo = sheen_albedo_at(sheen_albedo, wo[2], sheen_roughness)
        layers.sheen_albedo = albedo
        layers.base_scale = below * wp.max(1.0 - wp.max(sheen_color) * albedo, 0.0)
    return layers


@wp.func
def under_film(fresnel: wp.vec3, f0: wp.vec3, layers: Layers, cos_d: float) -> wp.vec3:
    """Return a Fresnel term of the base with its thin film, if it has one; ``f0`` is its own."""
    if layers.present == 0 or layers.iridescence == 0.0:
        return fresnel
    film = film_fresnel(f0, layers.film_ior, layers.film_thickness, cos_d)
    return fresnel + (film - fresnel) * layers.iridescence


@wp.func
def lobe_probabilities(
    wo: wp.vec3, base_color: wp.vec3, metallic: float, layers: Layers
) -> wp.vec2:
    """Probabilities of sampling the coat, and else the specular lobe of the base.

    A lobe's share of the reflected luminance, roughly.
    """
    f0 = wp.vec3(F0_DIELECTRIC)
    f90 = float(1.0)
    matte = float(1.0)
    if layers.present == 1:
        f0 = layers.f0
        f90 = layers.f90
        matte = layers.matte
    f0 = f0 * (1.0 - metallic) + base_color * metallic
    f90 = f90 * (1.0 - metallic) + metallic
    fresnel = f0 + (wp.vec3(f90) - f0) * schlick(wo[2])
    specular = luminance(under_film(fresnel, f0, layers, wo[2]))
    diffuse = (1.0 - metallic) * (1.0 - specular) * matte * luminance(base_color)
    coat = float(0.0)
    if layers.present == 1:
        specular = specular * layers.base_scale
        diffuse = diffuse * layers.base_scale
        # Sheen is drawn with the cosine, and its estimate may round to zero.
        diffuse += luminance(layers.sheen_color) * wp.max(layers.sheen_albedo, 1.0e-3)
        if layers.coat_weight > 0.0:
            coat = wp.clamp(
                layers.coat_weight / (layers.coat_weight + specular + diffuse), 0.1, 0.9
            )
    total = specular + diffuse
    # Keep both lobes reachable: the estimate ignores roughness.
    if total <= 0.0 or diffuse <= 0.0:
        return wp.vec2(coat, 1.0)
    return wp.vec2(coat, wp.clamp(specular / total, 0.1, 0.9))


@wp.func
def bsdf_of(
    wo: wp.vec3, base_color: wp.vec3, metallic: float, roughness: float, layers: Layers
) -> Bsdf:
    """Gather a `Bsdf`."""
    bsdf = Bsdf()
    bsdf.wo = wo
    bsdf.base_color = base_color
    bsdf.metallic = metallic
    bsdf.roughness = roughness
    bsdf.layers = layers
    bsdf.p = lobe_probabilities(wo, base_color, metallic, layers)
    return bsdf


@wp.func
def bsdf_f(bsdf: Bsdf, wi: wp.vec3) -> BsdfValue:
    """Evaluate value, without the cosine, and density; zero unless both directions are above.

    The value is differentiable in base colour, metallic and roughness.

    Args:
        bsdf: Where light is scattered.
        wi: Unit direction toward the light, local frame.
    """
    wo = bsdf.wo
    base_color = bsdf.base_color
    metallic = bsdf.metallic
    layers = bsdf.layers
    value = BsdfValue()
    value.diffuse = wp.vec3(0.0)
    value.specular = wp.vec3(0.0)
    value.pdf = 0.0
    if wo[2] > 0.0 and wi[2] > 0.0:
        f0 = wp.vec3(F0_DIELECTRIC)
        f90 = float(1.0)
        matte = float(1.0)
        if layers.present == 1:
            f0 = layers.f0
            f90 = layers.f90
            matte = layers.matte
        wm = wp.normalize(wo + wi)
        alpha = roughness_to_alpha(bsdf.roughness)
        cos_d = wp.abs(wp.dot(wo, wm))
        weight = schlick(cos_d)
        F_dielectric = f0 + (wp.vec3(f90) - f0) * weight
        F_dielectric = under_film(F_dielectric, f0, layers, cos_d)
        F_metal = base_color + (wp.vec3(1.0, 1.0, 1.0) - base_color) * weight
        F_metal = under_film(F_metal, base_color, layers, cos_d)
        F = F_dielectric * (1.0 - metallic) + F_metal * metallic
        diffuse = base_color * ((1.0 - metallic) * matte * (1.0 - wp.max(F_dielectric)) * INV_PI)
        wide = widening(alpha, layers)
        D = ggx_d(along_stretch(wm, layers, 1.0 / wide), alpha) / wide
        lambda_o = smith_lambda(along_stretch(wo, layers, wide), alpha)
        # Height-correlated masking-shadowing (Heitz 2014, eq. 99). The floor only matters where the
        # product of the cosines leaves float32.
        G2 = 1.0 / (1.0 + lambda_o + smith_lambda(along_stretch(wi, layers, wide), alpha))
        specular = F * (D * G2 / wp.max(4.0 * wo[2] * wi[2], 1.0e-30))
        # Visible normals: G1(wo) max(0, wo.wm) D(wm) / cos_o, over the Jacobian 4 wo.wm.
        p = bsdf.p
        G1 = 1.0 / (1.0 + lambda_o)
        pdf = p[1] * G1 * D / wp.max(4.0 * wo[2], 1.0e-30) + (1.0 - p[1]) * wi[2] * INV_PI
        if layers.present == 1:
            diffuse = diffuse * layers.base_scale
            specular = specular * layers.base_scale
            if wp.max(layers.sheen_color) > 0.0:
                diffuse += layers.sheen_color * sheen_lobe(wo, wi, wm, layers.sheen_roughness)
            if layers.coat_weight > 0.0:
                coat = coat_lobe(wo, wi, layers.coat_n, layers.coat_roughness)
                specular += wp.vec3(layers.coat_weight * coat[0])
                pdf = p[0] * coat[1] + (1.0 - p[0]) * pdf
        value.diffuse = diffuse
        value.specular = specular
        value.pdf = pdf
    return value


@wp.func
def coat_lobe(wo: wp.vec3, wi: wp.vec3, coat_n: wp.vec3, roughness: float) -> wp.vec2:
    """Return the coat's value over the shading normal's cosine, and its density [1/sr].

    No Fresnel term: ``D G2 / (4 cos_o cos_i)`` with the coat's cosines, times its ``cos_i``.
    """
    frame = basis(coat_n)
    o = to_local(wo, frame)
    i = to_local(wi, frame)
    if o[2] <= 0.0:
        return wp.vec2(0.0, 0.0)
    alpha = roughness_to_alpha(roughness)
    D = ggx_d(wp.normalize(o + i), alpha)
    lambda_o = smith_lambda(o, alpha)
    value = float(0.0)
    if i[2] > 0.0:
        G2 = 1.0 / (1.0 + lambda_o + smith_lambda(i, alpha))
        value = D * G2 / wp.max(4.0 * o[2] * wi[2], 1.0e-30)
    # Directions below the coat's horizon are drawn too.
    return wp.vec2(value, D / wp.max((1.0 + lambda_o) * 4.0 * o[2], 1.0e-30))


@wp.func
def visible_normal_sample(wo: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Draw a microfacet normal visible from ``wo`` of any length (Dupuy & Benyoub 2023, 1)."""
    stretched = wp.normalize(wp.vec3(alpha * wo[0], alpha * wo[1], wo[2]))
    phi = 2.0 * wp.PI * u[0]
    z = (1.0 - u[1]) * (1.0 + stretched[2]) - stretched[2]
    s = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    h = wp.vec3(s * wp.cos(phi), s * wp.sin(phi), z) + stretched
    return wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], wp.max(h[2], 0.0)))


@wp.func
def bsdf_sample(bsdf: Bsdf, u: wp.vec2, u_lobe: float) -> wp.vec3:
    """Draw a direction; one that falls below the surface has density 0 and must be dropped."""
    wo = bsdf.wo
    layers = bsdf.layers
    p = bsdf.p
    if u_lobe < p[0]:
        frame = basis(layers.coat_n)
        o = to_local(wo, frame)
        wm = visible_normal_sample(o, roughness_to_alpha(layers.coat_roughness), u)
        return wp.normalize(to_world(wm * (2.0 * wp.dot(o, wm)) - o, frame))
    if u_lobe < p[0] + (1.0 - p[0]) * p[1]:
        alpha = roughness_to_alpha(bsdf.roughness)
        wide = widening(alpha, layers)
        wm = visible_normal_sample(along_stretch(wo, layers, wide), alpha, u)
        wm = from_stretch(wm, layers, wide)
        return wp.normalize(wm * (2.0 * wp.dot(wo, wm)) - wo)
    return cosine_sample(u)


@wp.func
def narrowest_roughness(roughness: float, layers: Layers) -> float:
    """Return the perceptual roughness of the narrowest specular lobe."""
    if layers.present == 1 and layers.coat_weight > 0.0:
        return wp.min(roughness, layers.coat_roughness)
    return roughness
