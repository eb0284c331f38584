"""Reads the camera of a COLMAP model (https://colmap.github.io/format.html).

The camera has OpenCV's axes (+Z forward, +Y down), poses are from world to camera with the
quaternion's w first, and pixels have their centres at + 0.5. The world's axes and its scale are
arbitrary.
"""

import math
from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array, affine_matrix
from warpir.core.limits import Limits
from warpir.io.cameras.colmap_model import (
    COLMAP,
    MODELS,
    Image,
    Intrinsics,
    model_files,
    read_cameras,
    read_images,
)
from warpir.io.cameras.source import CAMERA, SHORTEST, PhotoCamera, choose_frame
from warpir.io.gltf.nodes import from_trs
from warpir.scene.camera import Camera
from warpir.scene.lens import Lens

UNDERSTOOD = tuple(MODELS)[:5]
UNIT_TOLERANCE = 1e-3
"""How far the length of a quaternion may be from 1 before it is not taken for one."""


def read_colmap(path: Path, frame: str | None, photo: str | None, limits: Limits) -> PhotoCamera:
    """Read the camera of one image of a model, given its folder or one of its files.

    ``frame`` is the image's name; default: the photo's, or the only one.

    Raises:
        InputError: Damaged, of a camera model that is not understood, or without that image.
    """
    cameras_path, images_path = model_files(path, "cameras", "images", limits=limits)
    cameras, images = read_cameras(cameras_path), read_images(images_path)
    image = images[choose_frame(images_path, [i.name for i in images], frame, photo)]
    if image.camera_id not in cameras:
        taken_with, name, count = image.camera_id, image.name[:80], len(cameras)
        raise COLMAP.error(cameras_path, "no_camera", camera=taken_with, image=name, found=count)
    camera, lens = _pinhole(cameras_path, image.camera_id, cameras[image.camera_id])
    notice = (
        "the scale of a COLMAP world is arbitrary: lengths are in its units, not in metres (--size)"
    )
    c2w = _pose(images_path, image)
    return PhotoCamera(Camera(*camera, c2w, (notice,)), lens, has_up=False)


def _pinhole(
    path: Path, camera_id: int, intrinsics: Intrinsics
) -> tuple[tuple[int, int, float, float, float, float], Lens]:
    """Return size, fx, fy, cx, cy and the lens of a camera."""
    model, numbers = intrinsics.model, intrinsics.parameters
    if model not in UNDERSTOOD:
        expected = ", ".join(UNDERSTOOD)
        raise COLMAP.error(
            path, "model", pointer=f"camera {camera_id}", found=model[:40], expected=expected
        )
    focal_count = 2 if model in ("PINHOLE", "OPENCV") else 1
    fx, fy = numbers[0], numbers[focal_count - 1]
    cx, cy, *bends = numbers[focal_count:]
    if not min(fx, fy) >= SHORTEST:
        raise CAMERA.error(path, "focal_length", pointer=f"camera {camera_id}", found=min(fx, fy))
    k1, k2, p1, p2 = (*bends, 0.0, 0.0, 0.0, 0.0)[:4]
    size = (intrinsics.width, intrinsics.height)
    return (*size, fx, fy, cx, cy), Lens((k1, k2, 0.0, 0.0), (p1, p2))


def _pose(path: Path, image: Image) -> Float64Array:
    """Return the pose of an image from its world to camera transform, [4, 4]."""
    length = math.hypot(*image.quaternion)
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise COLMAP.error(
            path, "quaternion", pointer=f"image {image.name[:80]}", found=length, expected=1
        )
    w, x, y, z = image.quaternion
    world_to_camera = from_trs((0.0,) * 3, (x, y, z, w), (1.0,) * 3)[:3, :3]
    # OpenCV's camera axes become ours: y and z change their signs.
    axes = world_to_camera.T * [1.0, -1.0, -1.0]
    return affine_matrix(axes, -world_to_camera.T @ np.array(image.translation))
