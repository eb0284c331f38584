"""Rendering noise taken out by Open Image Denoise, which the package ``pyoidn`` brings.

The object's reflections are filtered apart from each other, with albedo and normals as guides;
what it emits has no noise. The network runs on the CPU, where its bytes repeat for any number of
threads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import numpy as np
from scipy import ndimage

from warpir.core.arrays import BoolArray, FloatArray, IntArray

MARGIN = 16
"""Pixels around what is filtered, filled from its edge: the network looks that far."""
MEAN_SIGMA = 3.0
"""Deviation of the weights of a mean about a pixel [px]."""
LEAST_COVERAGE = 0.02
"""Coverage from which a pixel's colour is known well enough to fill others [1]."""


@cache
def denoiser_version() -> str | None:
    """Return the version of ``pyoidn``, or None where it is not installed."""
    try:
        return f"pyoidn {version('pyoidn')}"
    except PackageNotFoundError:
        return None


@dataclass(frozen=True)
class Window:
    """Part of a picture that is filtered, and the rows of pixels in it."""

    corner: tuple[int, int]
    """Its first row and column [px]."""
    shape: tuple[int, int]
    rows: IntArray
    """Row-major indices in the window, a row each."""

    @staticmethod
    def around(pixels: IntArray, height: int, width: int) -> Window:
        """Return the box of some pixels with a margin, cut at the picture's border.

        Args:
            pixels: Row-major indices in the picture, at least one, shape [N].
            height: Of the picture [px].
            width: Of the picture [px].
        """
        y, x = np.divmod(pixels, width)
        top, left = max(int(y.min()) - MARGIN, 0), max(int(x.min()) - MARGIN, 0)
        bottom = min(int(y.max()) + MARGIN + 1, height)
        right = min(int(x.max()) + MARGIN + 1, width)
        rows = (y - top) * (right - left) + (x - left)
        return Window((top, left), (bottom - top, right - left), rows.astype(np.int32))

    def spread(self, values: FloatArray, outside: float = 0.0) -> FloatArray:
        """Return a picture of rows of values, [height, width, ...]."""
        count = self.shape[0] * self.shape[1]
        plane = np.full((count, *values.shape[1:]), outside, np.float32)
        plane[self.rows] = values
        return plane.reshape(*self.shape, *values.shape[1:])

    def cut(self, plane: BoolArray) -> BoolArray:
        """Return the part of a plane of the whole picture that is in the window."""
        (top, left), (height, width) = self.corner, self.shape
        return plane[top : top + height, left : left + width]

    def gather(self, plane: FloatArray) -> FloatArray:
        """Return the rows of values of a picture."""
        rows: FloatArray = plane.reshape(-1, *plane.shape[2:])[self.rows]
        return rows


def denoised_object(
    reflected: tuple[FloatArray, ...],
    mask: FloatArray,
    albedo: FloatArray,
    normal: FloatArray,
    pixels: IntArray,
    size: tuple[int, int],
) -> tuple[FloatArray, ...]:
    """Return parts of the object's radiance without noise.

    Args:
        reflected: Radiance of each part, premultiplied by the coverage, shape [N, 3].
        mask: Coverage [1], shape [N].
        albedo: Base colour [1], shape [N, 3].
        normal: Unit shading normal, world frame, shape [N, 3].
        pixels: Row-major indices in the picture, shape [N].
        size: Height and width of the picture [px].
    """
    seen = mask > LEAST_COVERAGE
    if not seen.any():
        return reflected
    window = Window.around(pixels, *size)
    is_seen = window.spread(seen.astype(np.float32)) > 0.5
    surface = _filled(window.spread(albedo.clip(0.0, 1.0)), is_seen)
    facing = _filled(window.spread(normal), is_seen)
    found = []
    for part in reflected:
        colour = part / np.maximum(mask, 1e-6)[:, None]
        filled = _filled(window.spread(colour.astype(np.float32)), is_seen)
        clean = np.maximum(window.gather(_filter(filled, surface, facing)), 0.0)
        found.append(np.where(seen[:, None], clean * mask[:, None], part).astype(np.float32))
    return tuple(found)


def denoised_ratio(
    ratio: FloatArray, pixels: IntArray, hidden: IntArray, size: tuple[int, int]
) -> FloatArray:
    """Return a shadow ratio without noise; where a channel is exactly 1 it stays exactly 1.

    Args:
        ratio: Of the traced pixels [1]; that of other ground is 1; shape [N, 3].
        pixels: Row-major indices in the picture, shape [N].
        hidden: Those of pixels without ground, which are filled from beside them: lit ground there
            would brighten the shadow that reaches the object; shape [M].
        size: Height and width of the picture [px].
    """
    if len(pixels) == 0:
        return ratio
    window = Window.around(pixels, *size)
    is_ground = np.ones(size, bool)
    is_ground.reshape(-1)[hidden] = False
    filled = _continued(window.spread(ratio, outside=1.0), window.cut(is_ground))
    clean = window.gather(_filter(filled))
    most = max(1.0, float(ratio.max()))
    return np.where(ratio == 1.0, ratio, np.clip(clean, 0.0, most)).astype(np.float32)


def _filled(plane: FloatArray, known: BoolArray) -> FloatArray:
    """Return a plane in which unknown pixels have the value of the nearest known one."""
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    filled: FloatArray = plane[tuple(nearest)]
    return filled


def _continued(plane: FloatArray, known: BoolArray) -> FloatArray:
    """Return a plane in which unknown pixels have the mean about the nearest known one.

    One noisy pixel, spread far, would look like something that is there.
    """
    weight = known[..., None].astype(np.float32)
    sums, weights = (
        ndimage.gaussian_filter(p, (MEAN_SIGMA, MEAN_SIGMA, 0)) for p in (plane * weight, weight)
    )
    mean = _filled(sums / np.maximum(weights, 1e-6), known)
    return np.where(known[..., None], plane, mean).astype(np.float32)


def _filter(colour: FloatArray, *guides: FloatArray) -> FloatArray:
    """Return a linear picture through the network, shape [H, W, 3]; guides are noisy ones."""
    oidn: Any = import_module("pyoidn")
    clean: FloatArray = oidn.denoise(colour, *guides, hdr=True)
    return clean
