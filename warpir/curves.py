"""Tone curves as plain arrays, and as the file ``curves.json`` that every run writes.

A curve is a monotone rational-quadratic spline from (0, 0) to (1, 1) (Durkan et al. 2019, "Neural
Spline Flows"), given by its knots. The foreground has one, the shadow ratio one per channel:

    {"format": "warpir-curves", "version": 1, "tone": "linear",
     "foreground": {"x": [[0, ..., 1]], "y": [[0, ..., 1]], "slope": [[1, ..., 1]]},
     "shadow_ratio": {...}}

``tone`` is the operator between radiance and the foreground's curve.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.config import CHOICES
from warpir.errors import InputError
from warpir.limits import LIMITS, Limits
from warpir.strict_json import read_json_object

FloatArray = NDArray[np.float32]
Float64Array = NDArray[np.float64]

FORMAT = "warpir-curves"
VERSION = 1
CURVE_COUNTS = {"foreground": 1, "shadow_ratio": 3}
BIN_COUNT_LIMIT = 256
SLOPE_LIMIT = 1e6
RESOLVED = 0.97
"""Display-linear value up to which a photo says how bright a thing is [1]: more may be clipped."""
END_TOLERANCE = 1e-6
"""How far the outer knots may be from 0 and 1 [1]: a rounding, not another curve."""


@dataclass(frozen=True)
class ToneKnots:
    """Knots of one or several tone curves, shape [curve, bin + 1] each."""

    x: FloatArray
    y: FloatArray
    slope: FloatArray

    @property
    def bin_count(self) -> int:
        """Number of bins."""
        return int(self.x.shape[1]) - 1

    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the arrays in the kernels' order."""
        return self.x, self.y, self.slope

    def invert(self, y: NDArray[np.floating[Any]], curve: int = 0) -> Float64Array:
        """Return where a curve has these values in [0, 1] (Durkan et al. 2019, eqs. 6 to 8).

        Args:
            y: Values; clamped to [0, 1]. Any shape.
            curve: Which curve.
        """
        knot_x, knot_y, slope = (k[curve].astype(np.float64) for k in self.arrays())
        y = np.clip(np.asarray(y, np.float64), 0.0, 1.0)
        b = np.clip(np.searchsorted(knot_y, y, side="right") - 1, 0, self.bin_count - 1)
        width, rise = np.diff(knot_x)[b], np.diff(knot_y)[b]
        d0, d1, m = slope[b], slope[b + 1], rise / width
        above, bend = y - knot_y[b], d0 + d1 - 2.0 * m
        a = rise * (m - d0) + above * bend
        half = rise * d0 - above * bend
        root = np.sqrt(np.maximum(half * half + 4.0 * a * m * above, 0.0))
        # 2 c / (-b - sqrt(b^2 - 4 a c)): the form that does not cancel where the bin is straight.
        inverse: Float64Array = knot_x[b] + width * 2.0 * m * above / (half + root)
        return inverse

    def evaluate(self, x: NDArray[np.float64]) -> NDArray[np.float64]:
        """Evaluate every curve (Durkan et al. 2019, eq. 4), as `warpir.kernels.tone` does.

        Args:
            x: Where; clamped to [0, 1], shape [...].

        Returns:
            Values in [0, 1], shape [..., curve].
        """
        x = np.clip(x, 0.0, 1.0)
        return np.stack(
            [
                _spline(x, *(a[k].astype(np.float64) for a in self.arrays()))
                for k in range(len(self.x))
            ],
            axis=-1,
        )

    @staticmethod
    def identity(curves: int, bins: int = 5) -> ToneKnots:
        """Return curves that change nothing."""
        x = np.tile(np.linspace(0.0, 1.0, bins + 1, dtype=np.float32), (curves, 1))
        return ToneKnots(x, x.copy(), np.ones_like(x))


def _spline(
    t: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    slope: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Evaluate one curve within [0, 1] from its knots."""
    k = np.clip(np.searchsorted(x, t, side="right") - 1, 0, len(x) - 2)
    width, rise = x[k + 1] - x[k], y[k + 1] - y[k]
    m, q = rise / width, (t - x[k]) / width
    r = q * (1.0 - q)
    bent = (m * q * q + slope[k] * r) / (m + (slope[k + 1] + slope[k] - 2.0 * m) * r)
    value: NDArray[np.float64] = y[k] + rise * bent
    return value


@dataclass(frozen=True)
class Curves:
    """All tone curves of a picture, and the operator in front of the foreground's."""

    tone: str
    """``linear`` or ``reinhard``."""
    foreground: ToneKnots
    """One curve."""
    shadow_ratio: ToneKnots
    """Three curves, red, green and blue."""

    def radiance(self, photo_lin: NDArray[np.floating[Any]]) -> Float64Array:
        """Return the radiance that the foreground's curve and operator show as these values.

        Values above 1, which only a linear plate has, are radiance as they are; without an
        operator that is. With Reinhard's, `RESOLVED` is the most that is read.

        Args:
            photo_lin: Display-linear values [1], any shape.
        """
        shown = self.foreground.invert(photo_lin)
        if self.tone == "reinhard":
            shown = np.minimum(shown, RESOLVED)
            return shown / (1.0 - shown)
        return np.where(photo_lin > 1.0, photo_lin, shown)

    @staticmethod
    def identity(tone: str) -> Curves:
        """Return curves that change nothing."""
        one, three = CURVE_COUNTS.values()
        return Curves(tone, ToneKnots.identity(one), ToneKnots.identity(three))


def curves_to_json(curves: Curves) -> dict[str, Any]:
    """Return what `read_curves` reads."""
    content: dict[str, Any] = {"format": FORMAT, "version": VERSION, "tone": curves.tone}
    for name in CURVE_COUNTS:
        knots: ToneKnots = getattr(curves, name)
        content[name] = {
            "x": knots.x.tolist(),
            "y": knots.y.tolist(),
            "slope": knots.slope.tolist(),
        }
    return content


def read_curves(path: str | Path, limits: Limits = LIMITS) -> Curves:
    """Read and check a curves file.

    Args:
        path: The JSON file.
        limits: How large it may be.

    Raises:
        InputError: Missing, of another format, or not monotone curves from (0, 0) to (1, 1); names
            the curve.
    """
    root = read_json_object(path, limits)
    if root.get("format") != FORMAT or root.get("version") != VERSION:
        found = f"{root.get('format')!r:.40} version {root.get('version')!r:.10}"
        raise InputError(path, f"not curves (found {found}; expected {FORMAT!r} version {VERSION})")
    tone = root.get("tone")
    if tone not in CHOICES["tone"]:
        expected = " or ".join(CHOICES["tone"])
        raise InputError(path, f"/tone: {expected} expected (found {tone!r:.40})")
    knots = {name: _read_knots(path, f"/{name}", root.get(name)) for name in CURVE_COUNTS}
    for name, count in CURVE_COUNTS.items():
        given = len(knots[name].x)
        if given != count:
            raise InputError(path, f"/{name}: curves miscounted (found {given}; expected {count})")
    return Curves(str(tone), knots["foreground"], knots["shadow_ratio"])


def _read_knots(path: str | Path, pointer: str, value: Any) -> ToneKnots:
    if not isinstance(value, dict):
        raise InputError(path, f"{pointer}: an object with x, y and slope expected")
    x, y, slope = (
        _numbers(path, f"{pointer}/{name}", value.get(name)) for name in ("x", "y", "slope")
    )
    if not x.shape == y.shape == slope.shape or not 2 <= x.shape[1] <= BIN_COUNT_LIMIT + 1:
        shapes = ", ".join(f"{part.shape[0]} x {part.shape[1]}" for part in (x, y, slope))
        raise InputError(
            path,
            f"{pointer}: x, y and slope of one size expected, of 2 to {BIN_COUNT_LIMIT + 1} knots "
            f"(found {shapes})",
        )
    for name, knots in (("x", x), ("y", y)):
        ends = np.abs(knots[:, [0, -1]] - (0.0, 1.0)).max()
        if ends > END_TOLERANCE or not (np.diff(knots, axis=1) > 0.0).all():
            raise InputError(path, f"{pointer}/{name}: knots that rise from 0 to 1 expected")
    if not ((slope > 0.0) & (slope <= SLOPE_LIMIT)).all():
        raise InputError(path, f"{pointer}/slope: more than 0 and at most {SLOPE_LIMIT:g} expected")
    return ToneKnots(x, y, slope)


def _numbers(path: str | Path, pointer: str, value: Any) -> FloatArray:
    """Return a list of lists of numbers as it will be used, in float32, shape [curve, knot]."""
    rows = value if isinstance(value, list) and value else [None]
    lengths = {len(row) if isinstance(row, list) else 0 for row in rows}
    plain = len(lengths) == 1 and all(
        isinstance(number, int | float) and not isinstance(number, bool)
        for row in rows
        for number in (row if isinstance(row, list) else [None])
    )
    if not plain or lengths == {0}:
        raise InputError(path, f"{pointer}: lists of numbers expected, one for each curve")
    try:
        numbers = np.asarray(rows, np.float64)
    except OverflowError:
        raise InputError(path, f"{pointer}: a number beyond every use") from None
    with np.errstate(over="ignore"):
        return numbers.astype(np.float32)
