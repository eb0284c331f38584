"""What the photo shows of the surroundings, as detail of the light that the object reflects.

A recovered light is smooth: a shiny object under it mirrors fog. The photo knows part of what such
an object would show: the directions that the camera saw, and the ground in view, which lies where
the plane is. In those directions the photo takes the light's place; lamps stay, for a photo clips
them; everywhere else the light stays as it is. The authors leave reflections open (DiPIR, section
5). That the photo replaces the light's low frequencies as well was measured to be nearer to the
truth than keeping them (docs/detail.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import interpolate, map_directions, texel_solid_angles
from warpir.io.images.resize import resize
from warpir.render.picture.photo_scene import photo_radiance
from warpir.scene.camera import Camera
from warpir.scene.lamps import lamps_alone, without_lamps
from warpir.scene.light import Light, as_map
from warpir.scene.tone_curves import Curves

HEIGHT = 512
"""Rows of the map with detail: 0.35 degrees, what a mirror of 200 pixels can show."""
FEATHER = 0.06
"""Share of the photo's shorter side over which it fades into the light at its border [1]."""


@dataclass(frozen=True)
class Detail:
    """What the photo shows of the directions round a point."""

    radiance: FloatArray
    """World frame, relative [W/(m^2 sr)], shape [He, 2 He, 3]."""
    weight: FloatArray
    """1 where the photo shows it, 0 where not, shape [He, 2 He]."""

    @property
    def seen(self) -> float:
        """Share of the sphere that the photo shows [1]."""
        omega = texel_solid_angles(*self.weight.shape)[:, None]
        return float((self.weight * omega).sum() / (4.0 * np.pi))


def detail_of(inputs: Inputs, curves: Curves, height: int = HEIGHT) -> Detail:
    """Return what the photo shows round the object's centre, as a map of ``height`` rows.

    The curves turn radiance into the photo's values, and are inverted here.
    """
    low, high = inputs.asset.bounds()
    centre = inputs.placement.asset_to_world @ np.append((low + high) / 2.0, 1.0)
    radiance = photo_radiance(inputs.photo, curves)
    return seen_from(centre[:3], radiance, inputs.camera, inputs.placement.ground, height)


def with_detail(light: Light, detail: Detail) -> Light:
    """Return the light with the photo in place of what it says of the photo's directions.

    Its lamps stay everywhere.

    Args:
        light: What lights the object.
        detail: Of the same frame and exposure.
    """
    height = detail.weight.shape[0]
    rest = as_map(without_lamps(light), height)
    lamps = as_map(lamps_alone(light), height)
    weight = detail.weight[..., None]
    return Light(texels=lamps + weight * detail.radiance + (1.0 - weight) * rest)


def seen_from(
    viewpoint: Float64Array,
    radiance: FloatArray,
    camera: Camera,
    ground: Float64Array,
    height: int = HEIGHT,
) -> Detail:
    """Look round at a point and find what of it is in a photo.

    Directions that meet the ground show it where the camera sees that point of the ground; all
    others are taken for far away.

    Args:
        viewpoint: World frame [m], shape [3].
        radiance: The photo before its tone curve, of any size, shape [H, W, 3].
        camera: At the photo's own resolution.
        ground: Plane (a, b, c, d), unit normal on the camera's side, shape [4].
        height: Rows of the map.
    """
    rays = map_directions(height, 2 * height)
    above = float(ground[:3] @ viewpoint + ground[3])
    slope = rays @ ground[:3]
    below = (slope < 0.0) & (above > 0.0)
    point = viewpoint + (above / -slope[below])[:, None] * rays[below]
    rays[below] = point - camera.c2w[:3, 3]
    local = rays @ camera.c2w[:3, :3]
    ahead = local[..., 2] < -1e-9
    depth = np.where(ahead, -local[..., 2], 1.0)
    u = camera.cx + camera.fx * local[..., 0] / depth
    v = camera.cy - camera.fy * local[..., 1] / depth
    border = np.minimum(np.minimum(u, camera.width - u), np.minimum(v, camera.height - v))
    share = np.clip(border / (FEATHER * min(camera.width, camera.height)), 0.0, 1.0)
    weight = np.where(ahead, share * share * (3.0 - 2.0 * share), 0.0)
    seen = weight > 0.0
    shown = np.zeros((*weight.shape, 3), np.float32)
    shown[seen] = _look_up(_texel_sized(radiance, camera, height), u[seen], v[seen], camera)
    return Detail(shown, weight.astype(np.float32))


def _texel_sized(radiance: FloatArray, camera: Camera, rows: int) -> FloatArray:
    """Average the photo until a pixel in its middle is as large as a texel of the map."""
    scale = rows / np.pi / (camera.fx * radiance.shape[1] / camera.width)
    if scale >= 1.0:
        return radiance
    height, width = (max(2, round(side * scale)) for side in radiance.shape[:2])
    return resize(radiance, height, width)


def _look_up(image: FloatArray, u: Float64Array, v: Float64Array, camera: Camera) -> FloatArray:
    """Read an image of any size at pixel positions of the camera, bilinear, shape [point, 3]."""
    height, width = image.shape[:2]
    # Unlike a map's, the columns of a photo do not wrap.
    column = np.clip(u * (width / camera.width) - 0.5, 0.0, width - 1.0)
    row = v * (height / camera.height) - 0.5
    return interpolate(image, column, row).astype(np.float32)
