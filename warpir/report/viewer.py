"""The insertion in 3D: ``viewer.html``, one page with three.js inside that needs no other file.

The photo is the background, the object is drawn with glTF's materials under the run's light, and a
plane takes its shadow. What the plane shows is the share of the light that is left on it, summed
over directions that are drawn in proportion to the light that they bring to the ground.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray, Int64Array
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.io.images.envmap_conventions import from_ours
from warpir.report.html import render_page
from warpir.report.panorama import rgbe
from warpir.report.pictures import encoded, jpeg, shrink
from warpir.report.words import EVEN, characterize
from warpir.scene.light import axis_from_angles

VIEWER = "viewer.html"
LARGEST = 2048
"""Longest side of the photo in the page [px]."""
HEIGHT = 64
"""Rows of the light's map on the object, without its direct part."""
BANDS, SECTORS = 8, 12
"""Bands of elevation and sectors of each from which the shadow's other light is drawn."""
SCRIPTS = {
    "core": "three.core.min.js",
    "three": "three.module.min.js",
    "geometry": "utils/BufferGeometryUtils.js",
    "gltf": "loaders/GLTFLoader.js",
}
"""Files of three.js in ``vendor/`` by their names in the page."""


def viewer_page(
    glb: bytes,
    bounds: tuple[Float64Array, Float64Array],
    photo: FloatArray,
    camera: Mapping[str, Any],
    ground: Float64Array,
    lights: tuple[FloatArray, FloatArray],
    tone: str,
) -> bytes:
    """Return the page, in UTF-8.

    Args:
        glb: The object, in the world.
        bounds: Lowest and highest corner of its bounding box, world frame [m], shape [3] each.
        photo: Linear, shape [H, W, 3].
        camera: Content of ``camera.json``.
        ground: Plane (a, b, c, d) of the ground, unit normal on the camera's side.
        lights: Lat-long radiance on the object and for the shadow, our orientation, relative
            [W/(m^2 sr)], shape [He, 2 He, 3] each.
        tone: ``linear`` or ``reinhard``.
    """
    low, high = bounds
    of_object, of_shadow = lights
    sun, rest = _split(of_object, ground[:3])
    scene = {
        "camera": {name: camera[name] for name in ("w", "h", "fx", "fy", "cx", "cy", "c2w")},
        "middle": (0.5 * (low + high)).tolist(),
        "radius": 0.5 * float(np.linalg.norm(high - low)),
        "ground": np.asarray(ground, np.float64).tolist(),
        "sun": sun,
        "shadow": shadow_directions(of_shadow, ground[:3]).round(6).tolist(),
        "tone": tone,
        "rows": HEIGHT,
    }
    return render_page(
        "viewer",
        style="viewer",
        images="data: blob:",
        scripts=("blob:",),
        connections="data: blob:",
        title="The object on the photo, in 3D",
        photo=jpeg(encoded(shrink(photo, LARGEST))),
        scene=json.dumps(scene),
        data={
            **_three(),
            "object": _packed(glb),
            "sky": _packed(rgbe(from_ours(rest, "threejs")).tobytes()),
        },
    )


def _split(texels: FloatArray, normal: Float64Array) -> tuple[dict[str, Any] | None, FloatArray]:
    """Return the direct light, if there is any, and a small map of all other light.

    The direct light is a direction and the irradiance of a surface that faces it, RGB.
    """
    small = resize_map(texels, HEIGHT)
    found = characterize(texels, normal, np.eye(4)) if texels.any() else None
    axis = None if found is None else axis_from_angles(found.azimuth_deg, found.elevation_deg)
    if found is None or axis is None or found.direct_share < EVEN or axis @ normal < 0.02:
        return None, small
    away = np.degrees(np.arccos(np.clip(map_directions(*small.shape[:2]) @ axis, -1.0, 1.0)))
    reach = max(3.0 * found.half_width_deg, 2.0 * 180.0 / HEIGHT)
    near, ring = away <= reach, (away > reach) & (away <= reach + 12.0)
    if ring.any():
        small = np.where(near[..., None], np.minimum(small, np.median(small[ring], axis=0)), small)
    facing = found.direct / float(axis @ normal)
    return {"axis": axis.tolist(), "irradiance": facing.tolist()}, small.astype(np.float32)


def shadow_directions(texels: FloatArray, normal: Float64Array) -> Float64Array:
    """Return directions and the shares of the ground's light that they stand for.

    Texels that bring more than one of BANDS x SECTORS equal parts of the light stand for
    themselves, so that a sun is one direction. All others are divided into bands of equal light,
    and these into sectors of equal light.

    Args:
        texels: Lat-long radiance in our orientation, shape [He, 2 He, 3].
        normal: Of the ground, world frame, shape [3].

    Returns:
        x, y, z and red, green, blue by row; the shares of each colour sum to 1, or are 0 in the
        dark.
    """
    small = resize_map(texels, 2 * HEIGHT).astype(np.float64)
    directions = map_directions(*small.shape[:2]).reshape(-1, 3)
    solid_angles = np.repeat(texel_solid_angles(*small.shape[:2]), small.shape[1])
    weight = np.maximum(directions @ normal, 0.0) * solid_angles
    brought = small.reshape(-1, 3) * weight[:, None]
    share = np.asarray(luminance(brought), np.float64)
    total = brought.sum(axis=0)
    if not share.sum() > 0.0:
        return np.zeros((0, 6))
    share /= share.sum()
    is_large = share > 1.0 / (BANDS * SECTORS)
    other = np.where(is_large, 0.0, share).reshape(small.shape[:2])
    band = _parts(other.sum(axis=1), BANDS)
    group: Int64Array = np.empty(other.shape, np.int64)
    for k in range(BANDS):
        group[band == k] = k * SECTORS + _parts(other[band == k].sum(axis=0), SECTORS)
    part = group.reshape(-1)
    part[is_large] = BANDS * SECTORS + np.arange(int(is_large.sum()))
    count = int(part.max()) + 1
    axis, color = np.zeros((count, 3)), np.zeros((count, 3))
    np.add.at(axis, part, directions * share[:, None])
    np.add.at(color, part, brought / np.maximum(total, 1e-30))
    length = np.linalg.norm(axis, axis=1)
    kept = (length > 0.0) & (color.sum(axis=1) > 0.0)
    return np.concatenate([axis[kept] / length[kept, None], color[kept]], axis=1)


def _parts(share: Float64Array, count: int) -> Int64Array:
    """Return which of ``count`` consecutive equal parts of a sum each term belongs to."""
    middle = count * (np.cumsum(share) - 0.5 * share) / max(float(share.sum()), 1e-30)
    parts: Int64Array = np.minimum(middle, count - 1).astype(np.int64)
    return parts


@cache
def _three() -> dict[str, str]:
    vendor = files("warpir.report") / "vendor"
    return {name: _packed((vendor / path).read_bytes()) for name, path in SCRIPTS.items()}


def _packed(content: bytes) -> str:
    """Return bytes compressed with zlib, in base64."""
    return base64.b64encode(zlib.compress(content)).decode()
