"""Lens distortion: the Brown-Conrady model in the terms of OpenCV, and the photograph without it.

A point at (x, y) of the image plane at depth 1, x right and y down, is seen at

    (x, y) (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8)
        + (2 p1 x y + p2 (r^2 + 2 x^2), p1 (r^2 + 2 y^2) + 2 p2 x y),    r^2 = x^2 + y^2

(OpenCV's ``calib3d`` without its rational terms; k4 is nerfstudio's).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.camera import Camera
from warpir.files import Photo

Float64Array = NDArray[np.float64]
Pixels = NDArray[Any]

NEGLIGIBLE = 1e-6
"""A lens none of whose coefficients is larger is taken to be straight."""
BAND_ROWS = 256
"""Rows resampled at a time, which bounds the memory for positions."""


@dataclass(frozen=True)
class Lens:
    """Distortion in normalised image coordinates, so the same at every resolution."""

    radial: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, k4 [1]."""
    tangential: tuple[float, float] = (0.0, 0.0)
    """p1, p2 [1]."""

    @property
    def is_straight(self) -> bool:
        """Whether no coefficient is large enough to matter."""
        return all(abs(k) <= NEGLIGIBLE for k in (*self.radial, *self.tangential))

    def reach(self) -> float:
        """Return the radius up to which the radial part grows; beyond it the image folds back."""
        factors = [float(2 * n + 1) * k for n, k in enumerate((1.0, *self.radial))]
        roots = np.roots(np.trim_zeros(factors[::-1], "f"))
        real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0.0)]
        return float(np.sqrt(real.min())) if len(real) else float("inf")

    def distort(self, x: Float64Array, y: Float64Array) -> tuple[Float64Array, Float64Array]:
        """Return where points of the plane at depth 1 are seen through the lens; y is down."""
        k1, k2, k3, k4 = self.radial
        p1, p2 = self.tangential
        rr = x * x + y * y
        radial = 1.0 + rr * (k1 + rr * (k2 + rr * (k3 + rr * k4)))
        return (
            x * radial + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x),
            y * radial + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y,
        )

    def record(self) -> dict[str, list[float]]:
        """Return what ``run.json`` says of it."""
        return {"radial": list(self.radial), "tangential": list(self.tangential)}


STRAIGHT = Lens()
"""The lens of a pinhole camera."""


def source_positions(
    camera: Camera, lens: Lens, first: int, last: int
) -> tuple[Float64Array, Float64Array, NDArray[np.bool_]]:
    """Return where the distorted photograph shows what a pinhole would show at some rows.

    Args:
        camera: The pinhole, whose intrinsics are also the lens's.
        lens: The lens.
        first: First row.
        last: Row after the last.

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
    images: Sequence[Pixels], camera: Camera, lens: Lens
) -> tuple[list[Pixels], NDArray[np.bool_]]:
    """Resample images to the pinhole of the same intrinsics, bilinear, as OpenCV does.

    Args:
        images: Of the camera's size, shape [H, W] or [H, W, C]; their types are kept, integers
            rounded.
        camera: The pinhole.
        lens: What bent the images.

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
