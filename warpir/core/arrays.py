"""The kinds of NumPy array that annotations name, one alias each; transforms, boxes, bands."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpir.core.memory import core_count

Result = TypeVar("Result")

FloatArray = NDArray[np.float32]
Float64Array = NDArray[np.float64]
AnyFloatArray = NDArray[np.floating[Any]]
IntArray = NDArray[np.int32]
Int64Array = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
CodeArray = NDArray[np.uint8]
"""Pixels as a file stores them, 8 bits a channel."""
PixelArray = NDArray[Any]
"""Pixels of any kind: codes of 8 or 16 bits, or floats."""

BAND = 1 << 15
"""Pixels that are computed at once: their float64 colours take less than the MiB from which memory
is asked of the system anew (`warpir.core.memory.sparing`)."""


def affine_matrix(linear: ArrayLike, offset: ArrayLike = (0.0, 0.0, 0.0)) -> Float64Array:
    """Return the matrix [4, 4], of column vectors, of a linear map [3, 3] and an offset [3]."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = offset
    return matrix


def mask_box(mask: BoolArray, margin: int = 0) -> tuple[slice, slice]:
    """Return the rows and columns that hold what a mask, shape [H, W], marks; empty for nothing.

    Args:
        mask: What is marked.
        margin: How much farther they reach, as far as the mask does [px].
    """
    marked = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    rows, columns = (
        slice(max(0, int(k[0]) - margin), int(k[-1]) + margin + 1) if len(k) else slice(0, 0)
        for k in marked
    )
    return rows, columns


def on_cores(function: Callable[[Any], Result], items: Iterable[Any]) -> list[Result]:
    """Return what a function makes of each item, by as many threads as there are cores.

    One item is left to the caller's own thread: to start another takes longer than small work.
    """
    todo = list(items)
    if len(todo) < 2:
        return [function(item) for item in todo]
    with ThreadPoolExecutor(core_count()) as pool:
        return list(pool.map(function, todo))


def in_bands(work: Callable[[slice], object], height: int, width: int) -> None:
    """Call for the rows of a picture, band by band, on every core.

    In bands, since what lies between would be the largest arrays of a run; NumPy leaves other
    threads the interpreter while it computes.

    Args:
        work: Takes the rows of a band, which it alone writes.
        height: Of the picture [px].
        width: Of the picture [px].
    """
    rows = max(1, BAND // max(1, width))
    on_cores(work, [slice(top, min(top + rows, height)) for top in range(0, height, rows)])


def by_pixel(function: Callable[[FloatArray], AnyFloatArray], plane: FloatArray) -> FloatArray:
    """Return what a function makes of every pixel of a picture, float32, `in_bands`."""
    result = np.empty(plane.shape, np.float32)

    def fill(rows: slice) -> None:
        result[rows] = function(plane[rows])

    in_bands(fill, *plane.shape[:2])
    return result
