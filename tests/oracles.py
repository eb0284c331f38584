"""Plain float64 restatements of the papers and specifications that the kernels implement.

Nothing here imports the package: every function is written from its source, so that a test
compares two independent readings of the same equation. Directions are arrays of shape
[..., 3] in a right-handed frame with +Y up; "local" means the shading frame with the normal
along +Z. Radiance is linear and relative, angles are in radians.

Sources, cited below by name:
    OpenEXR: "Technical Introduction to OpenEXR", latitude-longitude environment maps.
    DiPIR: Liang et al. 2024, https://arxiv.org/abs/2408.09702; (M n) main paper, (S n)
        supplement.
    glTF: glTF 2.0 specification, appendix B "BRDF implementation".
    Heitz 2014: "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs".
    Heitz 2018: "Sampling the GGX Distribution of Visible Normals".
    Durkan 2019: "Neural Spline Flows", https://arxiv.org/abs/1906.04032, with the constants
        of the authors' package nflows.
    Howell: "A Catalog of Radiation Heat Transfer Configuration Factors".
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warpir.core.arrays import Float64Array, Int64Array

LUMINANCE_WEIGHTS = np.array([0.2126, 0.7152, 0.0722])
"""Rec. 709 luminance of linear RGB."""
DIELECTRIC_F0 = 0.04
"""Reflectance of an index of refraction of 1.5 at normal incidence (glTF B.3.5)."""
ALPHA_MIN = 1e-3
"""Least GGX width, ours: below it a float32 lobe is a spike."""
GAMMA = 2.2
"""Display exponent (DiPIR, supplement B)."""
SPLINE_BINS = 5
"""Bins of a tone curve (DiPIR, sec. 4.1.4)."""
SPLINE_MIN = 1e-3
"""Least bin width, bin height and slope (nflows)."""
CONSISTENCY_EPSILON = 1e-8
"""Added inside the logarithm of the consistency term, ours."""


def normalize(v: ArrayLike) -> Float64Array:
    """Return ``v`` at unit length, shape [..., 3]."""
    v = np.asarray(v, float)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def dot(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Return the inner product over the last axis."""
    return np.sum(np.asarray(a, float) * np.asarray(b, float), axis=-1)


def one_minus_cos(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Return ``1 - cos`` of the angle of two directions without cancellation.

    Half the squared chord of the unit vectors; ``1 - dot`` loses all digits of a narrow lobe.
    """
    return 0.5 * np.sum((normalize(a) - normalize(b)) ** 2, axis=-1)


def angle_between(a: ArrayLike, b: ArrayLike) -> Float64Array:
    """Return the angle of two directions [rad], exact near 0 and near pi (Kahan)."""
    a, b = normalize(a), normalize(b)
    return 2.0 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))


def frame_of(axis: ArrayLike) -> Float64Array:
    """Return a rotation whose columns are two tangents and ``axis``, shape [3, 3]."""
    z = normalize(axis)
    helper = np.eye(3)[np.argmin(np.abs(z))]
    x = normalize(np.cross(helper, z))
    return np.stack([x, np.cross(z, x), z], axis=-1)


def spherical(cos_theta: ArrayLike, phi: ArrayLike) -> Float64Array:
    """Return local directions at polar cosine about +Z and azimuth from +X, shape [..., 3]."""
    cos_theta, phi = np.broadcast_arrays(np.asarray(cos_theta, float), np.asarray(phi, float))
    sin_theta = np.sqrt(np.maximum(0.0, 1.0 - cos_theta**2))
    return np.stack([sin_theta * np.cos(phi), sin_theta * np.sin(phi), cos_theta], axis=-1)


def gauss_legendre(edges: ArrayLike, order: int) -> tuple[Float64Array, Float64Array]:
    """Return nodes and weights of a composite Gauss-Legendre rule, shape [panel * order]."""
    edges = np.asarray(edges, float)
    x, w = np.polynomial.legendre.leggauss(order)
    half = 0.5 * np.diff(edges)[:, None]
    middle = 0.5 * (edges[1:] + edges[:-1])[:, None]
    return (middle + half * x).ravel(), (half * w).ravel()


# ------------------------------------------------------------------------- lat-long maps


def latlong_direction(uv: ArrayLike) -> Float64Array:
    """Return the unit direction of map coordinates (OpenEXR), shape [..., 3].

    ``u`` runs right over the width and ``v`` down over the height, both in [0, 1]: the image
    centre is +Z, its left quarter +X, its top +Y.
    """
    uv = np.asarray(uv, float)
    lon = np.pi * (1.0 - 2.0 * uv[..., 0])
    lat = np.pi * (0.5 - uv[..., 1])
    return np.stack([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)], axis=-1)


def latlong_uv(direction: ArrayLike) -> Float64Array:
    """Return map coordinates of a direction of any length (OpenEXR), shape [..., 2].

    The inverse of :func:`latlong_direction`, with ``u`` in [0, 1).
    """
    d = np.asarray(direction, float)
    lon = np.arctan2(d[..., 0], d[..., 2])
    lat = np.arctan2(d[..., 1], np.hypot(d[..., 0], d[..., 2]))
    return np.stack([np.mod(0.5 - lon / (2.0 * np.pi), 1.0), 0.5 - lat / np.pi], axis=-1)


def texel_solid_angle(height: int, width: int) -> Float64Array:
    """Return the solid angle of one texel per row [sr], shape [height].

    ``(2 pi / W) (cos(pi i / H) - cos(pi (i + 1) / H))`` written as a product of sines, which
    keeps its digits at the poles.
    """
    middle = np.pi * (np.arange(height) + 0.5) / height
    return (2.0 * np.pi / width) * 2.0 * np.sin(middle) * np.sin(0.5 * np.pi / height)


def texel_direction(height: int, width: int) -> Float64Array:
    """Return the directions of the texel centres, shape [height, width, 3]."""
    v, u = np.meshgrid(
        (np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij"
    )
    return latlong_direction(np.stack([u, v], axis=-1))


def bilinear_weights(
    uv: ArrayLike, height: int, width: int
) -> tuple[Int64Array, Int64Array, Float64Array]:
    """Return rows, columns and weights of the four texels round ``uv``, each [..., 4].

    Texel centres lie at +0.5; columns wrap in longitude, rows are clamped in latitude. The
    order is (top, left), (top, right), (bottom, left), (bottom, right).
    """
    uv = np.asarray(uv, float)
    x = uv[..., 0] * width - 0.5
    y = uv[..., 1] * height - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = x - x0, y - y0
    columns = np.stack([x0, x0 + 1, x0, x0 + 1], axis=-1).astype(np.int64) % width
    rows = np.clip(np.stack([y0, y0, y0 + 1, y0 + 1], axis=-1).astype(np.int64), 0, height - 1)
    weights = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], axis=-1)
    return rows, columns, weights


def bilinear_lookup(texels: ArrayLike, uv: ArrayLike) -> Float64Array:
    """Return the map's value at ``uv``, shape [..., channel]."""
    texels = np.asarray(texels, float)
    rows, columns, weights = bilinear_weights(uv, *texels.shape[:2])
    return np.einsum("...kc,...k->...c", texels[rows, columns], weights)


# -------------------------------------------------------------------- spherical Gaussians


def sg_radiance(
    v: ArrayLike, amplitude: ArrayLike, axis: ArrayLike, sharpness: ArrayLike
) -> Float64Array:
    """Return the radiance of a sum of lobes from direction ``v`` (M 2, M 3).

    ``sum_k amplitude_k exp(sharpness_k (v . axis_k - 1))`` with ``sharpness = 1 / sigma^2``.

    Args:
        v: Unit directions, shape [..., 3].
        amplitude: Peak radiance, relative, shape [lobe, 3].
        axis: Unit lobe axes, shape [lobe, 3].
        sharpness: Lobe concentration, shape [lobe].

    Returns:
        Linear RGB, shape [..., 3].
    """
    v = np.asarray(v, float)[..., None, :]
    shape = np.exp(-np.asarray(sharpness, float) * one_minus_cos(v, np.asarray(axis, float)))
    return shape @ np.asarray(amplitude, float)


def sg_flux(sharpness: ArrayLike) -> Float64Array:
    """Return the integral of a lobe of amplitude 1 over the sphere [sr].

    ``2 pi / sharpness (1 - exp(-2 sharpness))``: integrate (M 2) over ``cos`` from -1 to 1.
    """
    sharpness = np.asarray(sharpness, float)
    return 2.0 * np.pi * -np.expm1(-2.0 * sharpness) / sharpness


def sg_pdf(v: ArrayLike, axis: ArrayLike, sharpness: ArrayLike) -> Float64Array:
    """Return the density proportional to one lobe [1/sr] (von Mises-Fisher)."""
    return np.exp(-np.asarray(sharpness, float) * one_minus_cos(v, axis)) / sg_flux(sharpness)


def sg_irradiance(n: ArrayLike, axis: ArrayLike, sharpness: float) -> float:
    """Return the irradiance of a plane with normal ``n`` under a lobe of amplitude 1.

    ``int G(v) max(0, n . v) dv`` in polar coordinates about the lobe. The azimuth is closed
    form, the polar angle Gauss-Legendre with panels broken where the horizon begins and ends
    to cut the circle.
    """
    tilt = float(angle_between(n, axis))
    end = 2.0 * np.arcsin(np.sqrt(min(1.0, 0.5 * 745.0 / sharpness)))
    breaks = np.array(
        [0.5 * np.pi - tilt, tilt - 0.5 * np.pi, 1.5 * np.pi - tilt, 0.5 * np.pi + tilt]
    )
    edges = np.unique(
        np.concatenate([np.linspace(0.0, end, 65), breaks[(breaks > 0) & (breaks < end)]])
    )
    theta, weight = gauss_legendre(edges, 24)
    a = np.cos(tilt) * np.cos(theta)
    b = np.sin(tilt) * np.sin(theta)
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.where(a >= b, np.pi, np.where(a <= -b, 0.0, np.arccos(np.clip(-a / b, -1, 1))))
    ring = 2.0 * (a * half + b * np.sin(half))
    lobe = np.exp(-2.0 * sharpness * np.sin(0.5 * theta) ** 2)
    return float(np.sum(weight * np.sin(theta) * lobe * ring))


# ------------------------------------------------------------------------------ the BRDF


def ggx_alpha(roughness: ArrayLike) -> Float64Array:
    """Return the GGX width ``roughness^2`` (glTF B.3.5), at least ``ALPHA_MIN`` (ours)."""
    return np.maximum(np.asarray(roughness, float) ** 2, ALPHA_MIN)


def ggx_d(wm: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return the GGX density of normals [1/sr] about +Z (Heitz 2014, isotropic; glTF B.3.2).

    ``alpha^2 / (pi (cos^2 (alpha^2 - 1) + 1)^2)`` with the bracket as ``alpha^2 cos^2 +
    sin^2``, which keeps its digits at small alpha; 0 below the surface.
    """
    wm, alpha = np.asarray(wm, float), np.asarray(alpha, float)
    sin2 = wm[..., 0] ** 2 + wm[..., 1] ** 2
    d = alpha**2 / (np.pi * (alpha**2 * wm[..., 2] ** 2 + sin2) ** 2)
    return np.where(wm[..., 2] > 0.0, d, 0.0)


def smith_lambda(w: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return Smith's Lambda of GGX, ``(sqrt(1 + alpha^2 tan^2) - 1) / 2`` (Heitz 2014, eq. 72)."""
    w, alpha = np.asarray(w, float), np.asarray(alpha, float)
    tan2 = (w[..., 0] ** 2 + w[..., 1] ** 2) / w[..., 2] ** 2
    x = alpha**2 * tan2
    return 0.5 * x / (np.sqrt(1.0 + x) + 1.0)


def smith_g1(w: ArrayLike, wm: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return the masking of one direction, ``1 / (1 + Lambda)`` (Heitz 2014, eq. 43)."""
    return np.where(dot(w, wm) > 0.0, 1.0 / (1.0 + smith_lambda(w, alpha)), 0.0)


def smith_g2(wo: ArrayLike, wi: ArrayLike, wm: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return height-correlated masking and shadowing (Heitz 2014, eq. 99; glTF B.3.2)."""
    g = 1.0 / (1.0 + smith_lambda(wo, alpha) + smith_lambda(wi, alpha))
    return np.where((dot(wo, wm) > 0.0) & (dot(wi, wm) > 0.0), g, 0.0)


def schlick(f0: ArrayLike, cos_theta: ArrayLike) -> Float64Array:
    """Return Schlick's Fresnel term ``f0 + (1 - f0) (1 - |cos|)^5`` (glTF B.3.4)."""
    f0 = np.asarray(f0, float)
    return f0 + (1.0 - f0) * (1.0 - np.abs(np.asarray(cos_theta, float))) ** 5


def specular_brdf(wo: ArrayLike, wi: ArrayLike, f0: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return ``F D G / (4 |VN| |LN|)`` [1/sr], shape [..., channel] (glTF B.3.2).

    Args:
        wo: Local direction toward the camera, shape [..., 3].
        wi: Local direction toward the light, shape [..., 3].
        f0: Reflectance at normal incidence, shape [..., channel].
        alpha: GGX width, shape [...].
    """
    wo, wi = np.broadcast_arrays(np.asarray(wo, float), np.asarray(wi, float))
    above = (wo[..., 2] > 0.0) & (wi[..., 2] > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        wm = normalize(wo + wi)
        fresnel = schlick(f0, dot(wo, wm)[..., None])
        rest = ggx_d(wm, alpha) * smith_g2(wo, wi, wm, alpha) / (4.0 * wo[..., 2] * wi[..., 2])
    return np.where(above[..., None], fresnel * rest[..., None], 0.0)


def gltf_brdf(
    wo: ArrayLike,
    wi: ArrayLike,
    base_color: ArrayLike,
    metallic: ArrayLike,
    roughness: ArrayLike,
) -> Float64Array:
    """Return the metallic-roughness BRDF [1/sr], no cosine, shape [..., 3] (glTF 2.0, B.2, B.3).

    Literally the specification's composition::

        dielectric_brdf = mix(base_color / pi, specular_brdf, 0.04 + 0.96 (1 - |VH|)^5)
        metal_brdf      = specular_brdf (base_color + (1 - base_color) (1 - |VH|)^5)
        material        = mix(dielectric_brdf, metal_brdf, metallic)

    Args:
        wo: Local direction toward the camera, shape [..., 3].
        wi: Local direction toward the light, shape [..., 3].
        base_color: Linear RGB, shape [..., 3].
        metallic: 0 dielectric to 1 metal, shape [...].
        roughness: Perceptual roughness, shape [...].
    """
    wo, wi = np.broadcast_arrays(np.asarray(wo, float), np.asarray(wi, float))
    base_color = np.asarray(base_color, float)
    metallic = np.asarray(metallic, float)[..., None]
    alpha = ggx_alpha(roughness)
    with np.errstate(divide="ignore", invalid="ignore"):
        fresnel = schlick(DIELECTRIC_F0, dot(wo, normalize(wo + wi)))[..., None]
    above = ((wo[..., 2] > 0.0) & (wi[..., 2] > 0.0))[..., None]
    lambert = np.where(above, (1.0 - fresnel) * base_color / np.pi, 0.0)
    dielectric = lambert + specular_brdf(wo, wi, np.full(3, DIELECTRIC_F0), alpha)
    metal = specular_brdf(wo, wi, base_color, alpha)
    return dielectric + (metal - dielectric) * metallic


def stretch_alphas(roughness: ArrayLike, strength: float) -> tuple[Float64Array, Float64Array]:
    """Return GGX widths along and across the stretch (KHR_materials_anisotropy)."""
    alpha = ggx_alpha(roughness)
    return alpha + (1.0 - alpha) * strength**2, alpha


def across_stretch(w: ArrayLike, rotation: float) -> Float64Array:
    """Return local directions in the frame whose x is the stretch, ``rotation`` from local x."""
    c, s = np.cos(rotation), np.sin(rotation)
    return np.asarray(w, float) @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def stretch_d(wm: ArrayLike, at: ArrayLike, ab: ArrayLike) -> Float64Array:
    """Return GGX of two widths, x along the stretch [1/sr] (``D_GGX_anisotropic``)."""
    wm = np.asarray(wm, float)
    a2 = np.asarray(at) * ab
    f2 = (ab * wm[..., 0]) ** 2 + (at * wm[..., 1]) ** 2 + (a2 * wm[..., 2]) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(wm[..., 2] > 0.0, a2 * (a2 / f2) ** 2 / np.pi, 0.0)


def stretch_specular(wo: ArrayLike, wi: ArrayLike, at: ArrayLike, ab: ArrayLike) -> Float64Array:
    """Return ``V_GGX_anisotropic D_GGX_anisotropic`` [1/sr], 0 unless both are above.

    The specification's code also limits V to 1, which it leaves unexplained; nothing here does.
    """
    wo, wi = np.broadcast_arrays(np.asarray(wo, float), np.asarray(wi, float))

    def length(w: Float64Array) -> Float64Array:
        return np.sqrt((at * w[..., 0]) ** 2 + (ab * w[..., 1]) ** 2 + w[..., 2] ** 2)

    with np.errstate(divide="ignore", invalid="ignore"):
        V = 0.5 / (wi[..., 2] * length(wo) + wo[..., 2] * length(wi))
        value = V * stretch_d(normalize(wo + wi), at, ab)
    return np.where((wo[..., 2] > 0.0) & (wi[..., 2] > 0.0), value, 0.0)


def stretch_reflection_pdf(wo: ArrayLike, wi: ArrayLike, at: float, ab: float) -> Float64Array:
    """Return the density of reflecting ``wo`` at a normal visible from it [1/sr] (Heitz 2018)."""
    wo = np.asarray(wo, float)
    wm = normalize(wo + np.asarray(wi, float))
    tan2 = ((at * wo[..., 0]) ** 2 + (ab * wo[..., 1]) ** 2) / wo[..., 2] ** 2
    G1 = 2.0 / (1.0 + np.sqrt(1.0 + tan2))
    return np.where(dot(wo, wm) > 0.0, G1 * stretch_d(wm, at, ab) / (4.0 * wo[..., 2]), 0.0)


def sheen_lambda(cosine: ArrayLike, alpha: float) -> Float64Array:
    """Return the fitted Lambda of fibres (KHR_materials_sheen, ``lambda_sheen``)."""
    cosine = np.asarray(cosine, float)
    s = (1.0 - alpha) ** 2

    def curve(x: Float64Array | float) -> Float64Array:
        a, b = (1 - s) * 21.5473 + s * 25.3245, (1 - s) * 3.82987 + s * 3.32435
        c, d = (1 - s) * 0.19823 + s * 0.16801, -(1 - s) * 1.97760 - s * 1.27393
        return np.asarray(a / (1.0 + b * x**c) + d * x - (1 - s) * 4.32054 - s * 4.85967)

    upper = np.exp(2.0 * curve(0.5) - curve(np.maximum(1.0 - cosine, 0.0)))
    return np.where(cosine < 0.5, np.exp(curve(np.maximum(cosine, 0.0))), upper)


def sheen_brdf(wo: ArrayLike, wi: ArrayLike, roughness: float) -> Float64Array:
    """Return Charlie's distribution times its visibility [1/sr] (KHR_materials_sheen)."""
    wo, wi = np.broadcast_arrays(np.asarray(wo, float), np.asarray(wi, float))
    alpha = float(ggx_alpha(roughness))
    above = (wo[..., 2] > 0.0) & (wi[..., 2] > 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        sin2 = np.maximum(1.0 - normalize(wo + wi)[..., 2] ** 2, 0.0)
        D = (2.0 + 1.0 / alpha) * sin2 ** (0.5 / alpha) / (2.0 * np.pi)
        masking = 1.0 + sheen_lambda(wo[..., 2], alpha) + sheen_lambda(wi[..., 2], alpha)
        value = D / (4.0 * wo[..., 2] * wi[..., 2] * masking)
    return np.where(above, value, 0.0)


def sheen_albedo(cos_o: float, roughness: float, count: int = 40) -> float:
    """Return the share of light that the sheen lobe reflects, by quadrature.

    Panels are graded geometrically towards grazing light and towards the mirror's azimuth.
    """
    cos_i, weight = gauss_legendre(np.append(0.0, np.geomspace(1e-6, 1.0, count)), 8)
    phi, ring = gauss_legendre(np.pi * np.append(0.0, np.geomspace(1e-5, 1.0, count)), 8)
    wo = np.array([-np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    value = sheen_brdf(wo, spherical(cos_i[:, None], phi[None, :]), roughness)
    return float(2.0 * np.sum((value @ ring) * cos_i * weight))


XYZ_TO_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)
EYE = (
    ((5.4856e-13, 1.6810e6, 4.3278e9), (9.7470e-14, 2.2399e6, 4.5282e9)),
    ((4.4201e-13, 1.7953e6, 9.3046e9),),
    ((5.2481e-13, 2.2084e6, 6.6121e9),),
)
"""Gaussians of X, Y and Z in the wave number: weight, mean [1/m], half the variance [1/m^2]
(Belcour & Barla 2017, in their code and in KHR_materials_iridescence)."""


def film_fresnel(f0: ArrayLike, ior: float, thickness: float, cosine: ArrayLike) -> Float64Array:
    """Return the reflectance of a thin film on a base, linear Rec.709, shape [..., 3].

    KHR_materials_iridescence, the spectral integral by quadrature over the wave number: the mean
    of Airy's reflectance over all phases is neutral, and what varies with the phase is seen by the
    eye as it is. Brought into 0 ... 1.

    Args:
        f0: Reflectance of the base in air at normal incidence, shape [..., 3].
        ior: Of the film.
        thickness: Of the film [nm].
        cosine: Of the angle of incidence, shape [...].
    """
    cosine = np.asarray(cosine, float)[..., None]
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / ior**2)
    root = np.sqrt(np.clip(f0, 1e-6, 0.9999))
    base = (1.0 + root) / (1.0 - root)
    R12 = schlick(((ior - 1.0) / (ior + 1.0)) ** 2, cosine)
    R23 = schlick(((base - ior) / (base + ior)) ** 2, inside)
    turns = np.where(base < ior, 2.0, 1.0)
    Rs, r123 = (1.0 - R12) ** 2 * R23 / (1.0 - R12 * R23), np.sqrt(R12 * R23)
    whole = R12 + Rs
    nodes, weights = np.polynomial.hermite_e.hermegauss(64)
    path = 2.0 * ior * thickness * 1e-9 * inside
    for axis, parts in enumerate(EYE):
        for weight, mean, half in parts:
            height = weight * np.sqrt(half) / 1.0685e-7
            nu = mean + np.sqrt(2.0 * half) * nodes
            delta = 2.0 * np.pi * path * nu + np.pi * turns[..., axis, None]
            for m in (1, 2):  # of the series in the phase, as the specification has it
                seen = height * (np.cos(m * delta) @ weights)[..., None]
                varied = 2.0 * (Rs - (1.0 - R12)) * r123**m * seen
                whole = whole + varied * XYZ_TO_REC709[:, axis]
    return np.clip(whole, 0.0, 1.0)


@dataclass(frozen=True)
class LayeredMaterial:
    """The parameters of glTF's material extensions at a point; the defaults change nothing."""

    ior: float = 1.5
    specular: float = 1.0
    specular_color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    transmission: float = 0.0
    clearcoat: float = 0.0
    clearcoat_roughness: float = 0.0
    coat_n: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit normal of the coat, local frame."""
    sheen_color: tuple[float, float, float] = (0.0, 0.0, 0.0)
    sheen_roughness: float = 0.0
    anisotropy: float = 0.0
    stretch: float = 0.0
    """Angle of the stretch from local x [rad]."""
    iridescence: float = 0.0
    film_ior: float = 1.3
    film_thickness: float = 400.0
    """[nm]"""


def layered_brdf(
    wo: ArrayLike,
    wi: ArrayLike,
    base_color: ArrayLike,
    metallic: ArrayLike,
    roughness: ArrayLike,
    layers: LayeredMaterial,
) -> tuple[Float64Array, Float64Array]:
    """Return base and sheen, and coat, of the extended material, both [..., 3] [1/sr].

    The specifications' composition for reflection, literally::

        dielectric_fresnel = mix(min(f0 specular_color, 1) specular, specular, (1 - |VH|)^5)
        dielectric = mix(diffuse, 0, transmission) (1 - max(fresnel)) + fresnel specular_brdf
        material = mix(dielectric, metal, metallic)
        material = sheen_color sheen_brdf + material (1 - max(sheen_color) E(VN))
        material = mix(material, coat_brdf, clearcoat (0.04 + 0.96 (1 - |V Nc|)^5))

    The coat is divided by the cosine to the shading normal and multiplied by that to its own.

    Args:
        wo: Local direction toward the camera, one for all, shape [3].
        wi: Local directions toward the light, shape [..., 3].
        base_color: Linear RGB, shape [..., 3].
        metallic: Shape [...].
        roughness: Shape [...].
        layers: The rest.
    """
    wo, wi = np.asarray(wo, float), np.asarray(wi, float)
    both, metallic = np.broadcast_arrays(wo, wi)[0], np.asarray(metallic, float)[..., None]
    o, i = (across_stretch(w, layers.stretch) for w in (both, wi))
    above = ((wo[2] > 0.0) & (wi[..., 2] > 0.0))[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        w = (1.0 - np.abs(dot(both, normalize(both + wi)))[..., None]) ** 5
    f0 = ((1.0 - layers.ior) / (1.0 + layers.ior)) ** 2 * np.asarray(layers.specular_color)
    f0 = np.minimum(f0, 1.0) * layers.specular
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = np.abs(dot(both, normalize(both + wi)))

    def filmed(bare: Float64Array, of: ArrayLike) -> Float64Array:
        if layers.iridescence == 0.0:
            return bare
        film = film_fresnel(of, layers.film_ior, layers.film_thickness, cosine)
        return bare + (film - bare) * layers.iridescence

    fresnel = filmed(f0 + (layers.specular - f0) * w, f0)
    ggx = stretch_specular(o, i, *stretch_alphas(roughness, layers.anisotropy))[..., None]
    lambert = np.asarray(base_color, float) / np.pi * (1.0 - layers.transmission)
    dielectric = lambert * (1.0 - fresnel.max(axis=-1, keepdims=True)) + fresnel * ggx
    metal = filmed(np.asarray(base_color) + (1.0 - np.asarray(base_color)) * w, base_color) * ggx
    value = dielectric + (metal - dielectric) * metallic
    if max(layers.sheen_color) > 0.0:
        E = min(sheen_albedo(float(wo[2]), layers.sheen_roughness), 1.0)
        sheen = sheen_brdf(both, wi, layers.sheen_roughness)[..., None]
        value = sheen * layers.sheen_color + value * (1.0 - max(layers.sheen_color) * E)
    value = np.where(above, value, 0.0)
    n = np.asarray(layers.coat_n)
    weight = layers.clearcoat * float(schlick(0.04, wo @ n))
    x = normalize(np.cross([0.0, 1.0, 0.0], n))
    frame = np.stack([x, np.cross(n, x), n], axis=-1)
    coat = specular_brdf(
        both @ frame, wi @ frame, np.ones(1), ggx_alpha(layers.clearcoat_roughness)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        coat = coat * ((wi @ n) / wi[..., 2])[..., None]
    coat = np.where(above, weight * coat, 0.0) * np.ones(3)
    return value * (1.0 - weight), coat


def vndf(wo: ArrayLike, wm: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return the density of normals visible from ``wo`` [1/sr] (Heitz 2018)."""
    wo = np.asarray(wo, float)
    cos = np.maximum(0.0, dot(wo, wm))
    return smith_g1(wo, wm, alpha) * cos * ggx_d(wm, alpha) / wo[..., 2]


def vndf_reflection_pdf(wo: ArrayLike, wi: ArrayLike, alpha: ArrayLike) -> Float64Array:
    """Return the density of reflecting ``wo`` at a visible normal [1/sr] (Heitz 2018).

    ``D_visible / (4 wo . wm)``. Directions below the surface are included: their integral is
    the share of samples that a single bounce loses.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        wm = normalize(np.asarray(wo, float) + np.asarray(wi, float))
        pdf = vndf(wo, wm, alpha) / (4.0 * dot(wo, wm))
    return np.where(dot(wo, wm) > 0.0, pdf, 0.0)


def cosine_pdf(wi: ArrayLike) -> Float64Array:
    """Return the cosine-weighted density about +Z [1/sr], 0 below the surface."""
    return np.maximum(0.0, np.asarray(wi, float)[..., 2]) / np.pi


def reflected_share(
    cos_o: float, alpha: float, fresnel: Callable[[Float64Array], Float64Array], count: int = 1024
) -> float:
    """Return the share of light that a GGX lobe of this Fresnel term reflects, by quadrature.

    ``int F D G2 / (4 cos_o cos_i) cos_i dwi`` over half vectors: ``dwi = 4 (wo . wm) dwm``
    and ``tan^2 theta_m = alpha^2 u / (1 - u)``, whose density is ``D cos theta_m``, so that
    the nodes follow the lobe at any width. Midpoint in azimuth, Gauss-Legendre in ``u``.
    """
    # Graded towards u = 1, where grazing normals lie.
    s, weight = gauss_legendre(np.linspace(0.0, 1.0, count // 16 + 1), 16)
    u, weight = 1.0 - (1.0 - s) ** 3, weight * 3.0 * (1.0 - s) ** 2
    phi = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    tan2 = alpha**2 * u / (1.0 - u)
    cos_m = 1.0 / np.sqrt(1.0 + tan2)
    wo = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    wm = spherical(cos_m[:, None], phi[None, :])
    cos_om = wm @ wo
    wi = 2.0 * cos_om[..., None] * wm - wo
    with np.errstate(divide="ignore", invalid="ignore"):
        value = fresnel(cos_om) * smith_g2(wo, wi, wm, alpha) * cos_om / (cos_o * wm[..., 2])
    value = np.where((cos_om > 0.0) & (wi[..., 2] > 0.0), value, 0.0)
    return float(np.mean(value, axis=1) @ weight)


def specular_albedo(cos_o: float, alpha: float, f0: float, count: int = 1024) -> float:
    """Return the share of light that the specular lobe reflects (`reflected_share`)."""
    return reflected_share(cos_o, alpha, lambda cos: schlick(f0, cos), count)


def diffuse_albedo(cos_o: float, f0: float, count: int = 256) -> float:
    """Return ``int (1 - F(V . H)) cos_i / pi dwi`` of a white diffuse base, by quadrature."""
    cos_i, weight = gauss_legendre(np.linspace(0.0, 1.0, count // 16 + 1), 16)
    phi = 2.0 * np.pi * (np.arange(count) + 0.5) / count
    wo = np.array([np.sqrt(1.0 - cos_o**2), 0.0, cos_o])
    wi = spherical(cos_i[:, None], phi[None, :])
    cos_om = np.sqrt(np.maximum(0.0, 0.5 * (1.0 + wi @ wo)))
    ring = np.mean(1.0 - schlick(f0, cos_om), axis=1)
    return float(2.0 * np.sum(ring * cos_i * weight))


def gltf_albedo(
    cos_o: float, base_color: float, metallic: float, roughness: float, count: int = 1024
) -> float:
    """Return the directional albedo of :func:`gltf_brdf` for one channel, by quadrature.

    Exceeds 1 for a bright dielectric at grazing angles: the diffuse term is weighted by
    ``1 - F(V . H)``, whose mean over ``L`` stays near 0.96 while the specular lobe, at the
    mirror direction, already reflects almost everything.
    """
    f0 = DIELECTRIC_F0 + (base_color - DIELECTRIC_F0) * metallic
    diffuse = (1.0 - metallic) * base_color * diffuse_albedo(cos_o, DIELECTRIC_F0)
    return diffuse + specular_albedo(cos_o, float(ggx_alpha(roughness)), f0, count)


# ------------------------------------------------------------------------- tone mapping


def reinhard(x: ArrayLike) -> Float64Array:
    """Return ``x / (1 + x)`` per channel (Reinhard et al. 2002, eq. 3)."""
    x = np.asarray(x, float)
    return x / (1.0 + x)


def softmax(x: ArrayLike) -> Float64Array:
    """Return ``exp(x) / sum exp(x)`` over the last axis."""
    x = np.asarray(x, float)
    e = np.exp(x - np.max(x, axis=-1, keepdims=True))
    return e / np.sum(e, axis=-1, keepdims=True)


def spline_knots(raw: ArrayLike) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return knots ``x_k``, ``y_k`` and slopes from 16 raw numbers, each [..., 6].

    Durkan 2019, appendix A.1, with nflows' constants: softmax over 5 widths and 5 heights
    with least size 1e-3, slopes ``1e-3 + softplus`` at ``beta = ln 2 / (1 - 1e-3)``, which
    makes zero parameters the identity. The order is widths, heights, slopes.
    """
    raw = np.asarray(raw, float)
    widths = SPLINE_MIN + (1.0 - SPLINE_MIN * SPLINE_BINS) * softmax(raw[..., :SPLINE_BINS])
    heights = SPLINE_MIN + (1.0 - SPLINE_MIN * SPLINE_BINS) * softmax(
        raw[..., SPLINE_BINS : 2 * SPLINE_BINS]
    )
    beta = np.log(2.0) / (1.0 - SPLINE_MIN)
    slopes = SPLINE_MIN + np.logaddexp(0.0, beta * raw[..., 2 * SPLINE_BINS :]) / beta
    zero = np.zeros((*raw.shape[:-1], 1))
    x = np.concatenate([zero, np.cumsum(widths, axis=-1)], axis=-1)
    y = np.concatenate([zero, np.cumsum(heights, axis=-1)], axis=-1)
    x[..., -1] = 1.0
    y[..., -1] = 1.0
    return x, y, slopes


def spline(
    t: ArrayLike, x: ArrayLike, y: ArrayLike, slope: ArrayLike
) -> tuple[Float64Array, Float64Array]:
    """Return a monotone rational-quadratic spline and its derivative (Durkan 2019, eqs. 4, 5).

    Args:
        t: Where to evaluate, clipped to [0, 1], shape [...].
        x: Knot positions, rising from 0 to 1, shape [knot].
        y: Knot values, rising from 0 to 1, shape [knot].
        slope: Derivatives at the knots, > 0, shape [knot].

    Returns:
        ``f(t)`` and ``f'(t)``, each of shape [...].
    """
    x, y, slope = (np.asarray(a, float) for a in (x, y, slope))
    t = np.clip(np.asarray(t, float), 0.0, 1.0)
    k = np.clip(np.searchsorted(x, t, side="right") - 1, 0, len(x) - 2)
    width, rise = x[k + 1] - x[k], y[k + 1] - y[k]
    m, q = rise / width, (t - x[k]) / width
    p = q * (1.0 - q)
    denominator = m + (slope[k + 1] + slope[k] - 2.0 * m) * p
    f = y[k] + rise * (m * q**2 + slope[k] * p) / denominator
    numerator = m**2 * (slope[k + 1] * q**2 + 2.0 * m * p + slope[k] * (1.0 - q) ** 2)
    return f, numerator / denominator**2


# ------------------------------------------------- fusion, regularisers, composite (DiPIR)


def luminance(rgb: ArrayLike) -> Float64Array:
    """Return Rec. 709 luminance of linear RGB, shape [...]."""
    return np.asarray(rgb, float) @ LUMINANCE_WEIGHTS


def fuse_literal(texels_fg: ArrayLike, texels_shadow: ArrayLike) -> Float64Array:
    """Return the fused map as printed, in three steps (S 1, S 2, S 3)."""
    texels_fg = np.asarray(texels_fg, float)
    fg, shadow = luminance(texels_fg), luminance(texels_shadow)
    r = (fg / np.max(fg)) * (shadow / (fg + shadow))
    fused = (1.0 - r) * fg + r * shadow
    return texels_fg * (fused / fg)[..., None]


def fuse_factor(texels_fg: ArrayLike, texels_shadow: ArrayLike) -> Float64Array:
    """Return the factor on the foreground map, ``1 + S (S - F) / (M (F + S))``, shape [...].

    (S 1-3) with the division by ``F`` cancelled; ``M`` is the largest ``F``. Its least value
    over ``F <= M`` is ``2 sqrt 2 - 2``.
    """
    fg, shadow = luminance(texels_fg), luminance(texels_shadow)
    total = fg + shadow
    quotient = np.divide(shadow * (shadow - fg), total, out=np.zeros_like(total), where=total > 0)
    return 1.0 + quotient / np.max(fg)


def fuse(
    texels_fg: ArrayLike, texels_shadow: ArrayLike, fusion: float
) -> tuple[Float64Array, Float64Array]:
    """Return both maps, blended toward the fused one (S 6, S 7).

    Args:
        texels_fg: Foreground map, shape [height, width, 3].
        texels_shadow: Shadow map, shape [height, width, 3].
        fusion: 0 separate to 1 one light.
    """
    texels_fg, texels_shadow = np.asarray(texels_fg, float), np.asarray(texels_shadow, float)
    fused = texels_fg * fuse_factor(texels_fg, texels_shadow)[..., None]
    return (
        fusion * fused + (1.0 - fusion) * texels_fg,
        fusion * fused + (1.0 - fusion) * texels_shadow,
    )


def consistency(texels_fg: ArrayLike, texels_shadow: ArrayLike) -> float:
    """Return the cross entropy of the two normalised luminance maps (M 10)."""
    fg, shadow = luminance(texels_fg), luminance(texels_shadow)
    d_omega = texel_solid_angle(*fg.shape)[:, None]
    fg = fg / np.sum(fg * d_omega)
    shadow = shadow / np.sum(shadow * d_omega)
    return float(-np.sum(shadow * np.log(fg + CONSISTENCY_EPSILON) * d_omega))


def cauchy(texels: ArrayLike) -> float:
    """Return ``sum log(1 + 2 L^2) dOmega`` over texels and channels (M 11)."""
    texels = np.asarray(texels, float)
    d_omega = texel_solid_angle(*texels.shape[:2])[:, None, None]
    return float(np.sum(np.log1p(2.0 * texels**2) * d_omega))


def composite(
    photo_lin: ArrayLike, mask: ArrayLike, foreground: ArrayLike, shadow_ratio: ArrayLike
) -> Float64Array:
    """Return ``(1 - V) ratio photo + V foreground``, all linear RGB (M 6).

    Args:
        photo_lin: Photograph, shape [..., 3].
        mask: Coverage of the object, 0 to 1, shape [...].
        foreground: Object after its tone curve, not premultiplied, shape [..., 3].
        shadow_ratio: After the tone curves, shape [..., 3].
    """
    mask = np.asarray(mask, float)[..., None]
    shadowed = np.asarray(shadow_ratio, float) * np.asarray(photo_lin, float)
    return (1.0 - mask) * shadowed + mask * np.asarray(foreground, float)


def encode(linear: ArrayLike) -> Float64Array:
    """Return ``x^(1/2.2)`` (DiPIR, supplement B)."""
    return np.asarray(linear, float) ** (1.0 / GAMMA)


# --------------------------------------------------------------- shadows in closed form


def half_plane_ratio(x: ArrayLike, height: float) -> Float64Array:
    """Return the shadow ratio of a horizontal half-plane under a constant sky.

    The occluder is ``{X > 0, Y = height}``, the receiver the point ``(x, 0, z)`` of the plane
    ``Y = 0``. The edge is seen at elevation ``psi`` above the open horizon, ``cos psi = x /
    sqrt(x^2 + height^2)``, and the open lune sends ``(1 - cos psi) / 2`` of the sky's
    irradiance (Nusselt's analogue; Howell).
    """
    x = np.asarray(x, float)
    return 0.5 * (1.0 - x / np.hypot(x, height))


def lune_irradiance(psi: float, radiance: Callable[[Float64Array], Float64Array]) -> float:
    """Return the irradiance of the plane ``Y = 0`` from the lune ``0 < angle < psi``.

    The angle is the elevation above -X in the X-Y plane and the lune's corners are +Z and -Z:
    ``d = cos rho (-cos a, sin a, 0) + sin rho (0, 0, 1)``, ``d_omega = cos rho d_rho d_a`` and
    the cosine is ``cos rho sin a``.

    Args:
        psi: Where the lune ends [rad], 0 to pi.
        radiance: Scalar radiance of unit directions of shape [..., 3].
    """
    a, weight_a = gauss_legendre(np.linspace(0.0, psi, 65), 16)
    rho, weight_rho = gauss_legendre(np.linspace(-0.5 * np.pi, 0.5 * np.pi, 65), 16)
    a, rho = a[:, None], rho[None, :]
    d = np.stack(
        np.broadcast_arrays(-np.cos(rho) * np.cos(a), np.cos(rho) * np.sin(a), np.sin(rho)), -1
    )
    value = radiance(d) * np.cos(rho) ** 2 * np.sin(a)
    return float(weight_a @ value @ weight_rho)


def half_plane_ratio_lobe(x: float, height: float, axis: ArrayLike, sharpness: float) -> float:
    """Return the shadow ratio of :func:`half_plane_ratio`'s occluder under one lobe.

    By quadrature over the lune of open sky; good for sharpness up to about 1e4.
    """
    psi = float(np.arctan2(height, x))

    def radiance(d: Float64Array) -> Float64Array:
        return np.exp(-sharpness * one_minus_cos(d, np.asarray(axis, float)))

    return lune_irradiance(psi, radiance) / sg_irradiance([0.0, 1.0, 0.0], axis, sharpness)


def rectangle_ratio(x: ArrayLike, z: ArrayLike, height: float, half: float) -> Float64Array:
    """Return the shadow ratio of a horizontal square under a constant sky.

    The occluder is ``{|X| < half, |Z| < half, Y = height}``, the receiver ``(x, 0, z)``: one
    minus the configuration factor of a point to a parallel rectangle, the signed sum of its
    four corner rectangles (Howell).
    """

    def corner(a: Float64Array, b: Float64Array) -> Float64Array:
        p, q = a / height, b / height
        rp, rq = np.sqrt(1.0 + p**2), np.sqrt(1.0 + q**2)
        return (p / rp * np.arctan(q / rp) + q / rq * np.arctan(p / rq)) / (2.0 * np.pi)

    x, z = np.asarray(x, float), np.asarray(z, float)
    x0, x1, z0, z1 = -half - x, half - x, -half - z, half - z
    return 1.0 - (corner(x1, z1) - corner(x0, z1) - corner(x1, z0) + corner(x0, z0))


def sphere_ratio(distance: ArrayLike, height: float, radius: float) -> Float64Array:
    """Return the shadow ratio of a sphere over a plane under a constant sky.

    ``1 - radius^2 height / D^3`` with ``D^2 = distance^2 + height^2``: the configuration factor
    of a tilted element to a sphere wholly above its horizon, ``height >= radius`` (Howell).
    Distance, from the centre's foot, and the centre's height are along and over the plane.
    """
    if height < radius:
        raise ValueError("the sphere must not cut the plane")
    return 1.0 - radius**2 * height / np.hypot(np.asarray(distance, float), height) ** 3


def fresnel(cos_i: Float64Array, eta: float = 1.5) -> Float64Array:
    """Reflectance by Fresnel's equations, with Snell's angles; 1 beyond the critical one."""
    theta = np.maximum(np.arccos(np.clip(cos_i, 0.0, 1.0)), 1e-6)
    sine = np.sin(theta) / eta
    inner = np.arcsin(np.minimum(sine, 1.0))
    across = np.sin(theta - inner) / np.sin(theta + inner)
    along = np.tan(theta - inner) / np.tan(theta + inner)
    return np.where(sine < 1.0, 0.5 * (across**2 + along**2), 1.0)
