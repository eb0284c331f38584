"""Tone curves as the file ``curves.json`` that every run writes and ``--reuse`` reads.

    {"format": "warpir-curves", "version": 1, "tone": "linear",
     "foreground": {"x": [[0, ..., 1]], "y": [[0, ..., 1]], "slope": [[1, ..., 1]]},
     "shadow_ratio": {...}, "response": {...}}

``tone`` is the operator between radiance and the foreground's curve. ``is_clipped``, default true,
is false on a linear plate: without an operator, radiance above 1 is shown as it is. ``response`` is
there where the picture repeats a camera's response (`warpir.look.response`), which follows both; it
belongs to the picture, is estimated from each photo, and is not read back.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_versioned
from warpir.scene.tone_curves import CURVE_COUNTS, TONES, Curves, ToneKnots

VERSION = 1
BIN_COUNT_LIMIT = 256
SLOPE_LIMIT = 1e6
END_TOLERANCE = 1e-6
"""How far the outer knots may be from 0 and 1 [1]: a rounding, not another curve."""


def curves_to_json(curves: Curves, response: ToneKnots | None = None) -> dict[str, Any]:
    """Return what `read_curves` reads, and the response that follows the curves."""
    content: dict[str, Any] = {"format": "warpir-curves", "version": VERSION, "tone": curves.tone}
    if not curves.is_clipped:
        content["is_clipped"] = False
    written = {name: getattr(curves, name) for name in CURVE_COUNTS}
    if response is not None:
        written["response"] = response
    for name, knots in written.items():
        content[name] = {
            "x": knots.x.tolist(),
            "y": knots.y.tolist(),
            "slope": knots.slope.tolist(),
        }
    return content


def read_curves(path: str | Path, limits: Limits = LIMITS) -> Curves:
    """Read and check a curves file.

    Raises:
        InputError: Missing, of another format, or not monotone curves from (0, 0) to (1, 1); names
            the curve.
    """
    root = read_versioned(path, "curves", VERSION, limits)
    tone = root.get("tone")
    if tone not in TONES:
        expected = " or ".join(TONES)
        raise InputError(path, f"/tone: {expected} expected (found {tone!r:.40})")
    knots = {name: _read_knots(path, f"/{name}", root.get(name)) for name in CURVE_COUNTS}
    for name, count in CURVE_COUNTS.items():
        given = len(knots[name].x)
        if given != count:
            raise InputError(path, f"/{name}: curves miscounted (found {given}; expected {count})")
    is_clipped = root.get("is_clipped", True)
    if not isinstance(is_clipped, bool):
        raise InputError(path, f"/is_clipped: true or false expected (found {is_clipped!r:.40})")
    return Curves(str(tone), knots["foreground"], knots["shadow_ratio"], is_clipped=is_clipped)


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
    rows = value if isinstance(value, list) else []
    lengths = {len(row) if isinstance(row, list) else 0 for row in rows}
    if len(lengths) != 1 or lengths == {0} or not all(_is_number(n) for row in rows for n in row):
        raise InputError(path, f"{pointer}: lists of numbers expected, one for each curve")
    try:
        numbers = np.asarray(rows, np.float64)
    except OverflowError:
        raise InputError(path, f"{pointer}: a number beyond every use") from None
    with np.errstate(over="ignore"):
        return numbers.astype(np.float32)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
