"""The kinds of NumPy array that annotations name, one alias each, and the box of a mask."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

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
