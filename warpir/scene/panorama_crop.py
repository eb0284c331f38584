"""A view into a panorama as a photograph whose camera, light and exposure are known.

The photo is ``clip(alpha * radiance ** (1 / 2.2), 0, 1)`` with the 99th percentile of its non-zero
values at 0.9, so its linear exposure is ``alpha ** 2.2``: with ``--tone linear`` and that exposure,
an object is lit and shown exactly as the place itself. Only the camera turns; the panorama stays as
it is, since it is the light.
"""

from dataclasses import replace

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import GAMMA, linear_to_gamma
from warpir.core.latlong import look_up
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.placement import turn

WHITE_PERCENTILE = 99.0
"""Percentile of the encoded values that becomes `WHITE` [%]."""
WHITE = 0.9
"""Display value of that percentile [1]."""


def crop_camera(
    width: int, height: int, fov: float, azimuth: float, pitch: float, camera_height: float
) -> Camera:
    """Return a camera above the origin that is turned to an azimuth.

    Args:
        width: Image width [px].
        height: Image height [px].
        fov: Horizontal field of view [deg].
        azimuth: Where it looks, clockwise from -Z seen from above [deg].
        pitch: How far it looks up [deg].
        camera_height: Above the ground y = 0 [m].
    """
    camera = camera_from_fov(width, height, fov, pitch, camera_height)
    c2w = camera.c2w.copy()
    c2w[:3, :3] = turn(np.array([0.0, 1.0, 0.0]), -np.radians(azimuth)) @ c2w[:3, :3]
    return replace(camera, c2w=c2w)


def crop_radiance(texels: FloatArray, camera: Camera, side: int = 2) -> Float64Array:
    """Return what a camera sees of a panorama, linear, shape [height, width, 3].

    Args:
        texels: Lat-long map.
        camera: The view.
        side: Rows and columns of look-ups that one pixel averages.
    """
    step = (np.arange(side) + 0.5) / side
    total = np.zeros((camera.height, camera.width, 3))
    for offset_v in step:
        for offset_u in step:
            u, v = np.meshgrid(
                np.arange(camera.width) + offset_u, np.arange(camera.height) + offset_v
            )
            local = np.stack(
                [(u - camera.cx) / camera.fx, (camera.cy - v) / camera.fy, -np.ones_like(u)], -1
            )
            directions = local @ camera.c2w[:3, :3].T
            directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
            total += look_up(texels, directions)
    return total / side**2


def expose(radiance: Float64Array) -> tuple[Float64Array, float]:
    """Return the photo's display values, shape [height, width, 3], and its exposure [EV]."""
    encoded = linear_to_gamma(radiance)
    alpha = WHITE / float(np.percentile(encoded[encoded > 0.0], WHITE_PERCENTILE))
    return np.clip(alpha * encoded, 0.0, 1.0), float(GAMMA * np.log2(alpha))
