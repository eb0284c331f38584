"""Mask of the ground that is already in shadow in the photo (``--shadow-mask``).

A shadow removes the lamps (`warpir.scene.lamps`) and leaves the rest of the light. There, the
object removes no more than its share of that rest, and no lamp lights an object that stands in
the shadow.
"""

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.scene.camera import Camera

FOOTPRINT_SIDE = 16
"""Number of points along each side of the footprint at which the mask is read."""


@dataclass(frozen=True)
class ShadowMask:
    """Share of the lamps' light that the photo's own shadows remove."""

    shares: FloatArray
    """Share removed from the ground in each pixel, 1 in full shadow, shape [H, W]."""
    at_object: float
    """Share removed from the object: the mean under its footprint [1]."""


def shadow_mask(
    shares: FloatArray,
    low: Float64Array,
    high: Float64Array,
    asset_to_world: Float64Array,
    camera: Camera,
) -> ShadowMask:
    """Measure a mask under an object's footprint, the lower side of its bounding box.

    Args:
        shares: 1 where the photo's ground is in full shadow, shape [H, W].
        low: Lowest corner of the asset's bounding box, asset frame [m], shape [3].
        high: Highest corner, shape [3].
        asset_to_world: Pose of the object, shape [4, 4].
        camera: Camera of the photo at the photo's resolution.
    """
    step = (np.arange(FOOTPRINT_SIDE) + 0.5) / FOOTPRINT_SIDE
    x, z = (g.reshape(-1) for g in np.meshgrid(step, step))
    foot = np.stack([x, np.zeros_like(x), z], axis=1) * (high - low) + low
    values = values_at(shares, foot @ asset_to_world[:3, :3].T + asset_to_world[:3, 3], camera)
    inside = np.isfinite(values)
    return ShadowMask(shares, float(values[inside].mean()) if inside.any() else 0.0)


def values_at(shares: FloatArray, points: Float64Array, camera: Camera) -> Float64Array:
    """Return the mask at world points [m], shape [point, 3]; NaN outside the photo."""
    uv = camera.project(points)
    inside = (uv >= 0.0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    values = np.full(len(points), np.nan)
    columns, rows = uv[inside].astype(int).T
    values[inside] = shares[rows, columns]
    return values
