"""What a hard case is: a measurement against float64, its bound, and Mitsuba's error on it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warpir.core.arrays import Float64Array

MAX_RELATIVE = "max relative"
RMS_RELATIVE = "RMS relative"
MAX_ABSOLUTE = "max absolute"
RELATIVE = "relative"
SHARE = "share"


@dataclass(frozen=True)
class Measured:
    """What one run of a case gave."""

    error: float
    """Against float64, in the case's measure."""
    is_finite: bool
    """Whether every value and gradient was a finite number."""
    gradient_error: float | None = None
    """``|g - r| / |r|`` against central differences in float64, where the case has gradients."""


@dataclass(frozen=True)
class Case:
    """One row of the table; `run` makes its numbers."""

    group: str
    name: str
    """What is hard about it."""
    quantity: str
    """What is computed."""
    measure: str
    """How `Measured.error` is formed."""
    run: Callable[[str], Measured]
    """Takes the Warp device."""
    bound: float
    """What the error may be; the constants of each module say why."""
    gradient_bound: float | None = None
    mitsuba: Callable[[], float] | str = ""
    """Mitsuba's error in the same measure, or why it cannot run the case."""
    cost: str = "quick"
    """``quick`` takes less than a second, ``medium`` a few, ``slow`` up to a minute."""

    @property
    def id(self) -> str:
        """Name for test reports."""
        return f"{self.group}-{self.name}-{self.quantity}".replace(" ", "_")


def upload(values: ArrayLike, dtype: Any, device: str, grad: bool = False) -> wp.array:
    """Return a float32 Warp array of ``values``."""
    plain = np.ascontiguousarray(values, np.float32)
    return wp.array(plain, dtype=dtype, device=device, requires_grad=grad)


def download(array: wp.array) -> Float64Array:
    """Return a Warp array's values in float64."""
    return np.asarray(array.numpy(), np.float64)


def finite(*values: ArrayLike) -> bool:
    """Say whether all numbers are finite."""
    return all(bool(np.all(np.isfinite(np.asarray(v, np.float64)))) for v in values)


def max_relative(found: ArrayLike, truth: ArrayLike, floor: float = 0.0) -> float:
    """Return the largest ``|found - truth| / max(|truth|, floor)``; 0 / 0 counts as 0."""
    found, truth = np.asarray(found, np.float64), np.asarray(truth, np.float64)
    scale = np.maximum(np.abs(truth), floor)
    difference = np.abs(found - truth)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(difference == 0.0, 0.0, difference / scale)
    return float(np.max(ratio, initial=0.0))


def relative_l2(found: ArrayLike, truth: ArrayLike) -> float:
    """Return ``|found - truth| / |truth|`` of flat vectors."""
    f, t = np.ravel(np.asarray(found, np.float64)), np.ravel(np.asarray(truth, np.float64))
    size = float(np.linalg.norm(t))
    difference = float(np.linalg.norm(f - t))
    if size == 0.0:
        return 0.0 if difference == 0.0 else float("inf")
    return difference / size


def worst_l2(found: list[Float64Array], truth: list[Float64Array]) -> float:
    """Return the largest `relative_l2` over several parameters; NaN stays NaN."""
    return float(np.max([relative_l2(f, t) for f, t in zip(found, truth, strict=True)]))
