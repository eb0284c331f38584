"""A mirror ball and a grey ball under a light, as on a film set."""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import CodeArray, FloatArray
from warpir.core.color import linear_to_gamma
from warpir.core.latlong import look_up, map_directions, texel_solid_angles, uv_of
from warpir.scene.camera import Camera
from warpir.scene.light import Light, as_map

GREY_BALL = 0.18
"""Reflectance of the matte ball in ``balls.png``."""
SIZE = 192
"""Height of that picture [px], which is twice as wide."""


def balls(light: Light, camera: Camera, is_reinhard: bool) -> CodeArray:
    """Return a mirror ball and a grey diffuse ball under the light, as the camera sees them.

    Display codes, shape [`SIZE`, 2 `SIZE`, 3], of a light at the photo's exposure. As on a film
    set: `GREY_BALL` keeps the lit side of a sunny light below the photo's white.
    """
    axis = (np.arange(SIZE) + 0.5) / SIZE * 2.0 - 1.0
    x, y = np.meshgrid(axis * 1.06, -axis * 1.06)
    inside = x * x + y * y < 1.0
    z = np.sqrt(np.maximum(1.0 - x * x - y * y, 0.0))
    normal = np.stack([x, y, z], axis=-1) @ camera.c2w[:3, :3].T
    view = camera.c2w[:3, 2]
    reflected = 2.0 * (normal @ view)[..., None] * normal - view
    sharp = as_map(light, 256)
    u, v = uv_of(reflected)
    column = (u * sharp.shape[1]).astype(int) % sharp.shape[1]
    row = np.minimum(v * sharp.shape[0], sharp.shape[0] - 1).astype(int)
    mirror = sharp[row, column].astype(np.float64)
    diffuse = look_up(_lit(light), normal)
    pair = []
    for ball in (mirror, diffuse):
        shown = ball / (1.0 + ball) if is_reinhard else np.minimum(ball, 1.0)
        shown = np.where(inside[..., None], shown, 0.03)
        pair.append(linear_to_gamma(shown))
    return np.round(np.concatenate(pair, axis=1) * 255.0).astype(np.uint8)


def _lit(light: Light) -> FloatArray:
    """Return the radiance of a grey surface by its normal, a map of shape [48, 96, 3]."""
    weighted = as_map(light, 32) * texel_solid_angles(32, 64)[:, None, None] * GREY_BALL / np.pi
    flux = weighted.reshape(-1, 3).astype(np.float32)
    toward = map_directions(32, 64).reshape(-1, 3).T.astype(np.float32)
    # One row at a time: the cosines of all normals with all texels would take 36 MB.
    facing = map_directions(48, 96).astype(np.float32)
    return np.stack([np.maximum(row @ toward, 0.0) @ flux for row in facing])
