"""Directional albedo of the sheen of cloth, by which the base below it is scaled.

KHR_materials_sheen scales the base by ``1 - max(sheenColor) E(cos)``, where E is the directional
albedo of the Charlie lobe (Conty & Kulla 2017, "Production Friendly Microfacet Sheen BRDF"). The
table is integrated here, in float64.
"""

from functools import cache

import numpy as np

from warpir.core.arrays import Float64Array

TABLE_SIZE = 32
ALPHA_MIN = 1e-3
"""Least width of a lobe in the kernels [1]."""
COSINE_MIN = 1e-5
"""Cosine that replaces 0 at grazing angles, where the lobe is 0 times infinity [1]."""


@cache
def sheen_albedo_table() -> Float64Array:
    """Return E by roughness and by the fourth root of the cosine, both from 0 to 1 [1].

    At most 1: the lobe itself exceeds that at roughness below 0.3 and grazing angles. Read
    bilinearly it is right to 0.02, from roughness 0.3 on to 0.004; the mean error is 5e-4.

    Returns:
        Shape [`TABLE_SIZE`, `TABLE_SIZE`].
    """
    grid = np.linspace(0.0, 1.0, TABLE_SIZE)
    cosine = np.maximum(grid**4, COSINE_MIN)
    table = np.stack([sheen_albedo(cosine, roughness) for roughness in grid])
    return np.minimum(table, 1.0)


def sheen_albedo(cosine: Float64Array, roughness: float) -> Float64Array:
    """Integrate the lobe times the cosine over all directions toward the light [1].

    For cosines of directions toward the camera, above 0, shape [angle]; roughness is perceptual.
    """
    alpha = max(roughness**2, ALPHA_MIN)
    x, weight = np.polynomial.legendre.leggauss(64)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    # Both grazing angles and the mirror's azimuth are steep.
    cos_i, d_cos = x**4, 4.0 * x**3 * weight
    phi, d_phi = np.pi * (1.0 - x**3), 3.0 * np.pi * x**2 * weight
    cos_o, cos_i = cosine[:, None, None], cos_i[None, :, None]
    across = np.sqrt((1.0 - cos_o**2) * (1.0 - cos_i**2)) * np.cos(phi)
    cos2_m = (cos_o + cos_i) ** 2 / (2.0 + 2.0 * (cos_o * cos_i + across))
    sin2_m = np.clip(1.0 - cos2_m, 0.0, 1.0)
    D = (2.0 + 1.0 / alpha) * sin2_m ** (0.5 / alpha) / (2.0 * np.pi)
    masking = 1.0 + _masking(cos_o, alpha) + _masking(cos_i, alpha)
    value = D / (4.0 * cos_o * masking)
    return np.asarray(2.0 * (value @ d_phi) @ d_cos)


def _masking(cosine: Float64Array, alpha: float) -> Float64Array:
    """Return the fitted Lambda of fibres (KHR_materials_sheen)."""
    q = (1.0 - alpha) ** 2
    ends = (
        (21.5473, 25.3245), (3.82987, 3.32435), (0.19823, 0.16801),
        (-1.97760, -1.27393), (-4.32054, -4.85967),
    )  # fmt: skip
    a, b, c, d, e = (first + (second - first) * q for first, second in ends)

    def curve(x: Float64Array) -> Float64Array:
        return np.asarray(a / (1.0 + b * x**c) + d * x + e)

    half = curve(np.array(0.5))
    below = curve(np.minimum(cosine, 0.5))
    above = 2.0 * half - curve(np.minimum(1.0 - cosine, 0.5))
    return np.exp(np.where(cosine < 0.5, below, above))
