"""Solid glass for the kernels: absorption in the world's units, and its share of straight light.

Paths refract. Rays of the shadow pass straight, as they pass thin walls; what they lose inside is
that of the mean way through the body, since they do not know their own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpir.core.arrays import Float64Array
from warpir.core.color import luminance
from warpir.kernels.types import GlassArgs
from warpir.scene.asset import Material

DARKEST = 1e-8
"""Least colour that is told from black [1]."""
IOR_INFINITE = 1e4
"""Index that stands for an infinite one, which glTF writes as 0."""


def absorption(materials: Sequence[Material], scales: Sequence[float]) -> Float64Array:
    """Return absorption coefficients [1/m], shape [material, 3]; 0 for all but solid glass.

    ``-ln(attenuationColor) / attenuationDistance`` (KHR_materials_volume). The distance is in the
    asset's units, so it grows with the asset.

    Args:
        materials: All materials of the scene.
        scales: Metres of the world per unit of each material's asset [1].
    """
    rows = np.zeros((len(materials), 3))
    for row, material, scale in zip(rows, materials, scales, strict=True):
        if material.is_solid_glass:
            color = np.maximum(material.attenuation_color, DARKEST)
            row[:] = -np.log(color) / (material.attenuation_distance * scale)
    return rows


def glass_args(
    materials: Sequence[Material], absorbed: Float64Array, device: wp.Device
) -> GlassArgs:
    """Upload solid glass; ``absorbed`` is from `absorption`."""
    args = GlassArgs()
    shares = [m.transmission * m.is_solid_glass for m in materials]
    args.share = wp.array(shares, dtype=wp.float32, device=device)
    args.ior = wp.array([m.ior or IOR_INFINITE for m in materials], dtype=wp.float32, device=device)
    args.absorption = wp.array(absorbed.astype(np.float32), dtype=wp.vec3, device=device)
    return args


def mean_way(triangles: Sequence[Float64Array]) -> float:
    """Return the mean way of straight rays through a closed body, ``4 V / S`` (Cauchy) [m].

    Over all rays that meet it, in an even flux from all sides; of a body that is not convex, for
    each time that a ray enters it.

    Args:
        triangles: Corners, counter-clockwise from outside [m], shape [triangle, 3, 3] each.
    """
    if not sum(map(len, triangles)):
        return 0.0
    corners = np.concatenate(list(triangles))
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    volume = abs(float(np.einsum("tk,tk->t", a, np.cross(b, c)).sum())) / 6.0
    area = 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())
    return 4.0 * volume / area if area > 0.0 else 0.0


def straight_shares(
    materials: Sequence[Material], absorbed: Float64Array, ways: Sequence[float]
) -> list[float]:
    """Return the share of light that passes each material straight where it does not reflect [1].

    Of solid glass, half of what the way inside takes is taken at either side of it; the colour of
    what is left counts by its luminance.
    """
    left = luminance(np.exp(-0.5 * absorbed * np.asarray(ways)[:, None]))
    return [m.transmission * float(share) for m, share in zip(materials, left, strict=True)]
