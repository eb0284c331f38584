"""Pixels whose radiance is not finite: black, counted, and the first of them named.

The kernels let NaN and infinity reach the picture's border and stop there; a number that is washed
away inside a path hides the fault that made it. pbrt does the same with each sample
(src/pbrt/cpu/integrators.cpp); here it is a pixel, since only its sum comes back from the device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from warpir.core.arrays import BoolArray, FloatArray, IntArray
from warpir.core.errors import ExitCode, InputError

BAD_SHARE = 0.01
"""Largest share of bad pixels in one rendering [1]; more are an error."""
NAMED = 5
"""Number of bad pixels whose position is reported."""


class BadPixels:
    """Counts the bad pixels of a renderer.

    Attributes:
        count: Number of bad pixels in all renderings.
        named: The first of them: column, row, sample if known, iteration of a loop.
        iteration: Set by a loop to its step, None outside of one.
    """

    def __init__(self) -> None:
        self.count = 0
        self.named: list[str] = []
        self.iteration: int | None = None

    def blackened(
        self,
        planes: tuple[FloatArray, ...],
        pixels: IntArray,
        width: int,
        stage: str,
        first_sample: Callable[[int], int | None] = lambda pixel: None,
    ) -> tuple[FloatArray, ...]:
        """Return the rendered planes with bad pixels black.

        Args:
            planes: Values of the traced pixels, shape [pixel, ...] each.
            pixels: Row-major pixel indices, shape [pixel].
            width: Width of the picture [px].
            stage: Name of the rendering stage, for the message.
            first_sample: Given a bad pixel, returns its first bad sample, or None.

        Raises:
            InputError: More than `BAD_SHARE` of them are bad (`ExitCode.NUMERIC`).
        """
        bad = np.zeros(len(pixels), bool)
        for plane in planes:
            # In float64 the sum is finite exactly when every value is; one pass, nothing kept.
            if not np.isfinite(np.sum(plane, dtype=np.float64)):
                bad |= ~np.isfinite(plane.reshape(len(pixels), -1)).all(axis=1)
        if not bad.any():
            return planes
        self.add(bad, pixels, width, stage, first_sample)
        return tuple(np.where(bad.reshape(-1, *[1] * (p.ndim - 1)), 0.0, p) for p in planes)

    def add(
        self,
        bad: BoolArray,
        pixels: IntArray,
        width: int,
        stage: str,
        first_sample: Callable[[int], int | None] = lambda pixel: None,
    ) -> None:
        """Count bad pixels and name the first; arguments and errors are those of `blackened`."""
        count = int(bad.sum())
        self.count += count
        for pixel in pixels[bad][: NAMED - len(self.named)]:
            place = f"{stage}, x {pixel % width}, y {pixel // width}"
            sample = first_sample(int(pixel))
            place += "" if sample is None else f", sample {sample}"
            place += "" if self.iteration is None else f", iteration {self.iteration}"
            self.named.append(f"({place})")
        # One alone is a speck, however few there are.
        if count > max(BAD_SHARE * len(pixels), 1.0):
            raise InputError(
                stage,
                f"{count} of {len(pixels)} pixels are not finite (at most {BAD_SHARE:.0%} may be; "
                f"the first: {', '.join(self.named)})",
                "look for extreme values in the materials and the light",
                ExitCode.NUMERIC,
            )

    def state_dict(self) -> dict[str, Any]:
        """Return plain values."""
        return {"count": self.count, "named": self.named}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Count on from `state_dict`."""
        self.count, self.named = int(state["count"]), list(state["named"])

    def notices(self) -> Iterator[str]:
        """Yield a notice if there were any."""
        if self.count:
            places = ", ".join(self.named)
            yield f"{self.count} pixels were not finite and were set to black, such as {places}"


def all_finite(values: Sequence[FloatArray]) -> bool:
    """Return whether no number is NaN or infinite."""
    return all(bool(np.isfinite(v).all()) for v in values)


def first_bad_sample_of(is_bad: Callable[[int], bool], spp: int) -> int | None:
    """Return the first of ``spp`` samples with which a sum is bad; None: it is not bad now.

    Samples are a function of their number: rendering fewer leaves out the last ones.
    """
    if not is_bad(spp):
        return None
    good, bad = 0, spp
    while bad - good > 1:
        middle = (good + bad) // 2
        good, bad = (good, middle) if is_bad(middle) else (middle, bad)
    return good
