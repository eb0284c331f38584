"""Scattering lobes of the glTF material in Dr.Jit: GGX, sheen, their sampling; a film's Fresnel.

Directions ``wo`` and ``wi`` point away from the surface, toward the camera and the light.
"""

import math
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

MIN_ALPHA = 1e-3
"""Least GGX width [1]."""
EYE = tuple(
    tuple((w * math.sqrt(2.0 * math.pi * v) / 1.0685e-7, mean, v) for w, mean, v in gaussians)
    for gaussians in (
        ((5.4856e-13, 1.6810e6, 4.3278e9), (9.7470e-14, 2.2399e6, 4.5282e9)),
        ((4.4201e-13, 1.7953e6, 9.3046e9),),
        ((5.2481e-13, 2.2084e6, 6.6121e9),),
    )
)
"""Height [1], mean [1/m] and half the variance [1/m^2] of the Gaussians of X, Y and Z."""
RGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)
"""From XYZ to linear Rec.709, rows."""
SHEEN_ROWS, SHEEN_COLUMNS = 64, 96
"""Size of the table of the sheen's albedo, by roughness and by the square root of the cosine."""


def schlick_weight(cosine: mi.Float) -> mi.Float:
    """Schlick's ``(1 - cos)^5`` [1]."""
    x = dr.clip(1.0 - cosine, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


def ggx(
    frame: mi.Frame3f, alpha: mi.Vector2f, wo: mi.Vector3f, wi: mi.Vector3f
) -> tuple[mi.Float, mi.Float]:
    """GGX lobe without Fresnel term, and the density of reflecting at visible normals.

    Of width ``alpha.x`` along the tangent of ``frame`` and ``alpha.y`` along its bitangent. The
    value is 0 where either direction is below the normal; visible normals also draw directions
    below it, so the density is not. Both [1/sr].
    """
    o, i = frame.to_local(wo), frame.to_local(wi)
    wm = dr.normalize(o + i)
    cos_o, cos_i = o.z, i.z
    # From tangents: 1 - cos^2 would lose the narrow lobes to rounding
    slope = dr.squared_norm(mi.Vector3f(wm.x / alpha.x, wm.y / alpha.y, wm.z))
    D = dr.select(wm.z > 0.0, dr.rcp(dr.pi * alpha.x * alpha.y * dr.square(slope)), 0.0)
    root_o = dr.norm(mi.Vector3f(alpha.x * o.x, alpha.y * o.y, o.z))
    root_i = dr.norm(mi.Vector3f(alpha.x * i.x, alpha.y * i.y, i.z))
    visibility = 0.5 / (cos_i * root_o + cos_o * root_i)
    value = dr.select((cos_o > 0.0) & (cos_i > 0.0), D * visibility, 0.0)
    # G1(wo) D / (4 cos_o), with G1 = 2 cos_o / (cos_o + root_o)
    return value, dr.select(cos_o > 0.0, D * 0.5 / (cos_o + root_o), 0.0)


def film_reflectance(
    f0: mi.Color3f, ior: mi.Float, thickness: mi.Float, cosine: mi.Float
) -> mi.Color3f:
    """Fresnel term of a thin film on a base (KHR_materials_iridescence), between 0 and 1.

    Args:
        f0: Reflectance of the base in air [1].
        ior: Of the film.
        thickness: Of the film [nm].
        cosine: Outside the film [1].
    """
    inside = dr.safe_sqrt(1.0 - (1.0 - dr.square(cosine)) / dr.square(ior))
    root = dr.sqrt(dr.clip(f0, 1e-6, 0.9999))
    base = (1.0 + root) / (1.0 - root)
    upper = dr.square((ior - 1.0) / (ior + 1.0))
    lower = dr.square((base - ior) / (base + ior))
    R12 = dr.lerp(upper, 1.0, schlick_weight(cosine))
    R23 = dr.lerp(lower, mi.Color3f(1.0), schlick_weight(inside))
    T = 1.0 - R12
    r = dr.sqrt(dr.clip(R12 * R23, 1e-10, 0.9999))
    Rs = dr.square(T) * R23 / (1.0 - dr.square(r))
    phase = 4e-9 * dr.pi * ior * thickness * inside
    out = R12 + Rs
    for order in (1, 2):
        xyz = []
        for turns, gaussians in zip(dr.select(base < ior, 2.0 * dr.pi, dr.pi), EYE, strict=True):
            parts = [
                height
                * dr.cos(order * (mean * phase + turns))
                * dr.exp(-variance * dr.square(order * phase))
                for height, mean, variance in gaussians
            ]
            xyz.append(sum(parts[1:], parts[0]))
        seen = mi.Color3f(*(sum(m * v for m, v in zip(row, xyz, strict=True)) for row in RGB))
        out += 2.0 * (Rs - T) * r**order * seen
    return dr.clip(out, 0.0, 1.0)


def charlie(cos_m: mi.Float, cos_o: mi.Float, cos_i: mi.Float, alpha: mi.Float) -> mi.Float:
    """Sheen lobe times ``cos_i``: Charlie's distribution and its visibility [1/sr]."""
    inverse = dr.rcp(alpha)
    sin2 = dr.maximum(1.0 - dr.square(cos_m), 0.0)
    D = (2.0 + inverse) * sin2 ** (0.5 * inverse) * (0.5 * dr.inv_pi)
    return D / (4.0 * cos_o * (1.0 + fibre_lambda(cos_o, alpha) + fibre_lambda(cos_i, alpha)))


def fibre_lambda(cosine: Any, alpha: Any) -> Any:
    """``lambda_sheen`` of KHR_materials_sheen, for Dr.Jit and NumPy alike."""
    is_array = isinstance(cosine, np.ndarray)
    exp, where = (np.exp, np.where) if is_array else (dr.exp, dr.select)
    t = (1.0 - alpha) * (1.0 - alpha)
    a = 21.5473 + (25.3245 - 21.5473) * t
    b = 3.82987 + (3.32435 - 3.82987) * t
    c = 0.19823 + (0.16801 - 0.19823) * t
    d = -1.97760 + (-1.27393 + 1.97760) * t
    e = -4.32054 + (-4.85967 + 4.32054) * t
    near = abs(where(cosine < 0.5, cosine, 1.0 - cosine))
    curve = a / (1.0 + b * near**c) + d * near + e
    middle = a / (1.0 + b * 0.5**c) + d * 0.5 + e
    return exp(where(cosine < 0.5, curve, 2.0 * middle - curve))


@cache
def sheen_table() -> NDArray[np.float32]:
    """Albedo of the sheen's lobe by midpoint sums, at most 1, shape [roughness, sqrt(cosine)]."""
    cosine = np.maximum(np.linspace(0.0, 1.0, SHEEN_COLUMNS) ** 2, 1e-5)
    steps = (np.arange(200) + 0.5) / 200.0
    cos_i, phi = (steps**3)[:, None], (np.pi * steps**2)[None, :]
    d_cos, d_phi = 2.0 * 3.0 * steps**2 / 200.0, 2.0 * np.pi * steps / 200.0
    alphas = [max(r**2, MIN_ALPHA) for r in np.linspace(0.0, 1.0, SHEEN_ROWS)]
    shades = [1.0 + fibre_lambda(cos_i[:, 0], alpha) for alpha in alphas]
    table = np.zeros((SHEEN_ROWS, SHEEN_COLUMNS))
    for column, cos_o in enumerate(cosine):
        dot = cos_o * cos_i - np.sqrt((1.0 - cos_o**2) * (1.0 - cos_i**2)) * np.cos(phi)
        sin2 = np.clip(1.0 - (cos_o + cos_i) ** 2 / (2.0 + 2.0 * dot), 1e-300, 1.0)
        log_sin2 = np.log(sin2)  # once for all powers of it
        for row, (alpha, shade) in enumerate(zip(alphas, shades, strict=True)):
            D = (2.0 + 1.0 / alpha) * np.exp(log_sin2 * (0.5 / alpha)) / (2.0 * np.pi)
            masked = shade + fibre_lambda(np.array(cos_o), alpha)
            table[row, column] = (D @ d_phi) @ (d_cos / masked) / (4.0 * cos_o)
    return np.minimum(table, 1.0).astype(np.float32)


def read_sheen_table(table: mi.Float, cosine: mi.Float, roughness: mi.Float) -> mi.Float:
    """Bilinear lookup of `sheen_table`."""
    x = dr.sqrt(dr.clip(cosine, 0.0, 1.0)) * (SHEEN_COLUMNS - 1)
    y = dr.clip(roughness, 0.0, 1.0) * (SHEEN_ROWS - 1)
    column = dr.minimum(mi.UInt32(x), SHEEN_COLUMNS - 2)
    row = dr.minimum(mi.UInt32(y), SHEEN_ROWS - 2)
    x, y = x - mi.Float(column), y - mi.Float(row)

    def at(i: mi.UInt32, j: mi.UInt32) -> mi.Float:
        return dr.gather(mi.Float, table, i * SHEEN_COLUMNS + j)

    low = dr.lerp(at(row, column), at(row, column + 1), x)
    high = dr.lerp(at(row + 1, column), at(row + 1, column + 1), x)
    return dr.lerp(low, high, y)


def sample_visible_normal(wo: mi.Vector3f, alpha: mi.Vector2f, u: mi.Point2f) -> mi.Vector3f:
    """Draw a GGX normal visible from ``wo`` (Dupuy and Benyoub 2023, spherical caps)."""
    stretched = dr.normalize(mi.Vector3f(wo.x * alpha.x, wo.y * alpha.y, wo.z))
    z = dr.fma(1.0 - u.y, 1.0 + stretched.z, -stretched.z)
    sin_phi, cos_phi = dr.sincos(dr.two_pi * u.x)
    r = dr.safe_sqrt((1.0 - z) * (1.0 + z))
    h = mi.Vector3f(r * cos_phi, r * sin_phi, z) + stretched
    return dr.normalize(mi.Vector3f(h.x * alpha.x, h.y * alpha.y, dr.maximum(h.z, 1e-9)))
