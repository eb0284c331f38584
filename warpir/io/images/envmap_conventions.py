"""Lat-long conventions of other tools: the one place where their maps become ours and back.

Ours is OpenEXR's, also OpenUSD's and Mitsuba's: with ``u`` to the right and ``v`` down in [0, 1],
``u = atan2(x, -z) / 2 pi mod 1`` and ``v = acos(y) / pi`` for the unit direction (x, y, z) in a
world with +Y up, so the image's centre is +Z and its left quarter +X. All tools agree on ``v``
and, seen from inside, on the sense of rotation; they differ by where the seam lies:

======================================  ===========================  =======  ============
tool                                    u                            centre   left quarter
======================================  ===========================  =======  ============
openexr, OpenUSD, Mitsuba               atan2(x, -z) / 2 pi mod 1    +Z       +X
nvdiffrec (render/util.py)              atan2(x, -z) / 2 pi + 1/2    -Z       -X
threejs (common.glsl.js)                atan2(z, x) / 2 pi + 1/2     +X       -Z
blender (Cycles, projection.h), Z up    1/2 - atan2(y, x) / 2 pi     +X       +Y, our -Z
diffusionlight (ball2envmap.py)         atan2(x, -z) / 2 pi + 1/2    ahead    image left
======================================  ===========================  =======  ============

DiffusionLight's directions are in camera axes: its maps also turn with the camera.
"""

from __future__ import annotations

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import latitudes, look_up, map_directions, rotate_map

SEAM_SHIFTS = {
    "openexr": 0.0,
    "nvdiffrec": 0.5,
    "threejs": 0.25,
    "blender": 0.25,
    "diffusionlight": 0.5,
}
"""Columns to roll our map to the right by, as a share of its width, to make it the tool's."""

IN_CAMERA_AXES = frozenset({"diffusionlight"})
"""Conventions whose directions refer to the camera instead of the world."""
SIDE = 3
"""Directions along a texel's side that are averaged where a map is tilted."""


def to_ours(
    texels: FloatArray, convention: str, camera_to_world: Float64Array | None = None
) -> FloatArray:
    """Turn another tool's map to our orientation.

    Args:
        texels: Radiance in the tool's orientation, shape [He, 2 He, 3].
        convention: Who made the map: a key of `SEAM_SHIFTS`.
        camera_to_world: Rotation or pose of the camera, shape [3, 3] or [4, 4]; needed, and used,
            only for a convention in `IN_CAMERA_AXES`.

    Returns:
        The map in our orientation and world frame. Whole columns are moved exactly; a camera that
        is not level makes each texel a mean over its own area.

    Raises:
        ValueError: An unknown convention, or the camera is missing.
    """
    rotation = _rotation(convention, camera_to_world)
    # Longitude falls with u: rolling to the right by a share of the width is a clockwise turn.
    return rotate_directions(rotate_map(texels, 360.0 * SEAM_SHIFTS[convention]), rotation)


def from_ours(
    texels: FloatArray, convention: str, camera_to_world: Float64Array | None = None
) -> FloatArray:
    """Turn our map to another tool's orientation; the inverse of `to_ours`, with its arguments."""
    rotation = _rotation(convention, camera_to_world)
    return rotate_map(rotate_directions(texels, rotation.T), -360.0 * SEAM_SHIFTS[convention])


def _rotation(convention: str, camera_to_world: Float64Array | None) -> Float64Array:
    """Return the rotation from the convention's axes to the world, shape [3, 3]."""
    if convention not in SEAM_SHIFTS:
        raise ValueError(f"convention {convention!r} is not one of {', '.join(SEAM_SHIFTS)}")
    if convention not in IN_CAMERA_AXES:
        return np.eye(3)
    if camera_to_world is None:
        raise ValueError(f"convention {convention!r} is in camera axes: the camera is needed")
    return np.asarray(camera_to_world, np.float64)[:3, :3]


def rotate_directions(texels: FloatArray, rotation: Float64Array) -> FloatArray:
    """Turn a map by any rotation; one about +Y is left to `rotate_map`, which keeps each row's sum.

    Args:
        texels: Radiance in our orientation, shape [He, 2 He, 3].
        rotation: Takes a direction of the given map to one of the result, shape [3, 3].
    """
    if np.allclose(rotation[1], (0.0, 1.0, 0.0), atol=1e-7):
        return rotate_map(texels, float(np.degrees(np.arctan2(rotation[0, 2], rotation[0, 0]))))
    height, width = texels.shape[:2]
    turned = np.zeros(texels.shape)
    fine = map_directions(height * SIDE, width * SIDE).reshape(height, SIDE, width, SIDE, 3)
    # Within a texel, the points nearer to a pole stand for less of the sphere.
    share = np.cos(latitudes(height * SIDE)).reshape(height, SIDE)
    share = share / share.sum(axis=1, keepdims=True)
    for i in range(SIDE):
        for j in range(SIDE):
            seen = look_up(texels, fine[:, i, :, j] @ rotation)
            turned += (share[:, i] / SIDE)[:, None, None] * seen
    return turned.astype(np.float32)
