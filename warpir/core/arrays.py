"""The kinds of NumPy array that annotations name, one alias each; shapes stand in docstrings."""

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
