"""The glTF 2.0 metallic-roughness BRDF, in the local frame of the shading normal (z).

glTF 2.0 specification, appendix B: ``mix(dielectric_brdf, metal_brdf, metallic)`` with GGX
(Trowbridge-Reitz), height-correlated Smith masking, Schlick's Fresnel term, and a Lambert base that
receives what the dielectric's Fresnel term leaves. Schlick's term is affine in F0, so the two
specular lobes are one with ``f0 = mix(0.04, base_color, metallic)``. (An older, single-lobe sample
code took that F0 for the base as well; Khronos corrected it in glTF issue 2386.)

Sampling draws visible normals (Heitz 2018; Dupuy & Benyoub 2023, "Sampling Visible GGX Normals with
Spherical Caps"). `brdf_eval` returns value and density of `brdf_sample`.
"""

import warp as wp

from warpir.kernels.sampling import cosine_sample

INV_PI = wp.constant(0.318309886183791)
PI = wp.constant(3.14159265358979)
ALPHA_MIN = wp.constant(1.0e-3)
"""Below this the lobe is narrower than float32 directions resolve; the specification allows it."""
F0_DIELECTRIC = wp.constant(0.04)


@wp.struct
class BrdfValue:
    """A BRDF value split as the renderer's layers need it, without the cosine, and its density."""

    diffuse: wp.vec3
    """[1/sr]."""
    specular: wp.vec3
    """[1/sr]."""
    pdf: float
    """Density of `brdf_sample` [1/sr]; zero outside its support."""


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
    return 1.0 / (PI * alpha * alpha * s * s)


@wp.func
def smith_lambda(w: wp.vec3, alpha: float) -> float:
    """Smith's auxiliary function for GGX (Heitz 2014, eq. 72)."""
    z2 = wp.max(w[2] * w[2], 1.0e-14)
    tan2 = (w[0] * w[0] + w[1] * w[1]) / z2
    return 0.5 * (wp.sqrt(1.0 + alpha * alpha * tan2) - 1.0)


@wp.func
def schlick(cos_d: float) -> float:
    """Schlick's ``(1 - cos)^5``."""
    x = wp.clamp(1.0 - cos_d, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


@wp.func
def specular_probability(wo: wp.vec3, base_color: wp.vec3, metallic: float) -> float:
    """Probability of sampling the specular lobe: its share of the reflected luminance, roughly."""
    f0 = wp.vec3(F0_DIELECTRIC) * (1.0 - metallic) + base_color * metallic
    F = f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * schlick(wo[2])
    specular = 0.2126 * F[0] + 0.7152 * F[1] + 0.0722 * F[2]
    diffuse = (
        (1.0 - metallic)
        * (1.0 - specular)
        * (0.2126 * base_color[0] + 0.7152 * base_color[1] + 0.0722 * base_color[2])
    )
    total = specular + diffuse
    if total <= 0.0:
        return 1.0
    # Keep both lobes reachable: the estimate ignores roughness.
    if diffuse <= 0.0:
        return 1.0
    return wp.clamp(specular / total, 0.1, 0.9)


@wp.func
def brdf_eval(
    wo: wp.vec3, wi: wp.vec3, base_color: wp.vec3, metallic: float, roughness: float
) -> BrdfValue:
    """Evaluate the BRDF, without the cosine; zero unless both directions are above the surface.

    Value and density share half of their terms, so both are returned. The value is differentiable
    in ``base_color``, ``metallic`` and ``roughness``.

    Args:
        wo: Unit direction toward the camera, local frame.
        wi: Unit direction toward the light, local frame.
        base_color: Linear RGB [1].
        metallic: 0 dielectric to 1 metal [1].
        roughness: Perceptual roughness [1].
    """
    value = BrdfValue()
    value.diffuse = wp.vec3(0.0)
    value.specular = wp.vec3(0.0)
    value.pdf = 0.0
    if wo[2] > 0.0 and wi[2] > 0.0:
        wm = wp.normalize(wo + wi)
        alpha = roughness_to_alpha(roughness)
        weight = schlick(wp.abs(wp.dot(wo, wm)))
        f0 = wp.vec3(F0_DIELECTRIC) * (1.0 - metallic) + base_color * metallic
        F = f0 + (wp.vec3(1.0, 1.0, 1.0) - f0) * weight
        F_dielectric = F0_DIELECTRIC + (1.0 - F0_DIELECTRIC) * weight
        value.diffuse = base_color * ((1.0 - metallic) * (1.0 - F_dielectric) * INV_PI)
        D = ggx_d(wm, alpha)
        lambda_o = smith_lambda(wo, alpha)
        # Height-correlated masking-shadowing (Heitz 2014, eq. 99). The floor only matters where the
        # product of the cosines leaves float32.
        G2 = 1.0 / (1.0 + lambda_o + smith_lambda(wi, alpha))
        value.specular = F * (D * G2 / wp.max(4.0 * wo[2] * wi[2], 1.0e-30))
        # Visible normals: G1(wo) max(0, wo.wm) D(wm) / cos_o, over the Jacobian 4 wo.wm.
        p = specular_probability(wo, base_color, metallic)
        G1 = 1.0 / (1.0 + lambda_o)
        value.pdf = p * G1 * D / wp.max(4.0 * wo[2], 1.0e-30) + (1.0 - p) * wi[2] * INV_PI
    return value


@wp.func
def visible_normal_sample(wo: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Draw a microfacet normal visible from ``wo`` (Dupuy & Benyoub 2023, listing 1)."""
    stretched = wp.normalize(wp.vec3(alpha * wo[0], alpha * wo[1], wo[2]))
    phi = 2.0 * PI * u[0]
    z = (1.0 - u[1]) * (1.0 + stretched[2]) - stretched[2]
    s = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    h = wp.vec3(s * wp.cos(phi), s * wp.sin(phi), z) + stretched
    return wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], wp.max(h[2], 0.0)))


@wp.func
def brdf_sample(
    wo: wp.vec3,
    u: wp.vec2,
    u_lobe: float,
    base_color: wp.vec3,
    metallic: float,
    roughness: float,
) -> wp.vec3:
    """Draw a direction; one that falls below the surface has density 0 and must be dropped."""
    if u_lobe < specular_probability(wo, base_color, metallic):
        wm = visible_normal_sample(wo, roughness_to_alpha(roughness), u)
        return wp.normalize(wm * (2.0 * wp.dot(wo, wm)) - wo)
    return cosine_sample(u)
