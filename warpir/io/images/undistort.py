"""The photograph as a pinhole camera of the same intrinsics would have taken it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, PixelArray
from warpir.io.images.photos import Photo
from warpir.scene.camera import Camera
from warpir.scene.lens import Lens

BAND_ROWS = 256
"""Rows resampled at a time, which bounds the memory for positions."""


def source_positions(
    camera: Camera, lens: Lens, first: int, last: int
) -> tuple[Float64Array, Float64Array, BoolArray]:
    """Return where the distorted photograph shows what a pinhole would show at some rows.

    Returns:
        Columns and rows [px], and whether they lie outside the photograph or beyond the lens's
        reach, shape [last - first, width] each. Beyond the reach the position stays at it.
    """
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(first, last) + 0.5)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    radius, reach = np.hypot(x, y), lens.reach()
    beyond = radius > reach
    if beyond.any():
        shrink = np.where(beyond, reach / np.maximum(radius, reach), 1.0)
        x, y = x * shrink, y * shrink
    x, y = lens.distort(x, y)
    u, v = camera.cx + camera.fx * x, camera.cy + camera.fy * y
    outside = beyond | (u < 0.0) | (u > camera.width) | (v < 0.0) | (v > camera.height)
    return u, v, outside


def undistorted(
    images: Sequence[PixelArray], camera: Camera, lens: Lens
) -> tuple[list[PixelArray], BoolArray]:
    """Resample images to the pinhole of the same intrinsics, bilinear, as OpenCV does.

    They are of the camera's size, shape [H, W] or [H, W, C]; types are kept, integers rounded.

    Returns:
        The images, and where they show nothing that was photographed, shape [H, W]: the nearest
        pixel of the photograph's edge stands there.
    """
    from scipy.ndimage import map_coordinates

    results = [np.empty_like(image) for image in images]
    border = np.empty((camera.height, camera.width), np.bool_)
    for first in range(0, camera.height, BAND_ROWS):
        last = min(first + BAND_ROWS, camera.height)
        u, v, border[first:last] = source_positions(camera, lens, first, last)
        positions = np.stack([v - 0.5, u - 0.5])
        for image, result in zip(images, results, strict=True):
            source = image.reshape(*image.shape[:2], -1)
            band = result.reshape(source.shape)[first:last]
            for channel in range(source.shape[2]):
                values = map_coordinates(
                    source[..., channel], positions, np.float64, order=1, mode="nearest"
                )
                is_integer = image.dtype.kind in "iub"
                band[..., channel] = np.round(values) if is_integer else values
    return results, border


def undistort_photo(photo: Photo, camera: Camera, lens: Lens) -> tuple[Photo, float]:
    """Return a photograph without the distortion of its lens, and the share of empty border.

    The type of the codes is kept, so is the colour profile; every code is resampled.
    """
    (codes, srgb), border = undistorted([photo.codes, photo.srgb], camera, lens)
    share = float(border.mean())
    notices = [
        "distortion undone (--undistort): the composite, camera.json and all pixel positions are "
        "of the straightened photo, all of whose pixels were resampled"
    ]
    if share > 0.0:
        notices.append(
            f"{100.0 * share:.2g} % of the straightened photo lies outside the original and "
            "repeats its edge; nothing was cropped"
        )
    changed = replace(photo, codes=codes, srgb=srgb, notices=(*photo.notices, *notices))
    return changed, share
