"""Tone curves of a picture as plain arrays: monotone rational-quadratic splines.

A curve goes from (0, 0) to (1, 1) (Durkan et al. 2019, "Neural Spline Flows") and is given by its
knots. The foreground has one, the shadow ratio one per channel. `warpir.render.tone_curve` has the
parameters that are optimised, `warpir.kernels.tone` the device's evaluation,
`warpir.io.curves_file` the file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray

TONES = ("reinhard", "linear")
"""Operators between radiance and the foreground's curve: ``x / (1 + x)``, or clipped."""
CURVE_COUNTS = {"foreground": 1, "shadow_ratio": 3}
RESOLVED = 0.97
"""Largest display-linear value that counts as unclipped [1]."""

UNSEEN = 1e-3
"""Difference of display-linear values that counts as none [1]."""


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

    @property
    def is_identity(self) -> bool:
        """Whether no curve changes a value by as much as `UNSEEN`."""
        x = np.linspace(0.0, 1.0, 33)
        return bool(np.abs(self.evaluate(x) - x[:, None]).max() < UNSEEN)

    def arrays(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the arrays in the kernels' order."""
        return self.x, self.y, self.slope

    def invert(self, y: AnyFloatArray) -> Float64Array:
        """Return where the first curve has these values (Durkan et al. 2019, eqs. 6 to 8).

        Args:
            y: Values; clamped to [0, 1]. Any shape.
        """
        knot_x, knot_y, slope = (k[0].astype(np.float64) for k in self.arrays())
        value: Float64Array = np.clip(np.asarray(y, np.float64), 0.0, 1.0)
        if np.array_equal(knot_x, knot_y) and (slope == 1.0).all():  # one that was not recovered
            return value
        b = np.clip(np.searchsorted(knot_y, value, side="right") - 1, 0, self.bin_count - 1)
        width, rise = np.diff(knot_x)[b], np.diff(knot_y)[b]
        d0, d1, m = slope[b], slope[b + 1], rise / width
        above, bend = value - knot_y[b], d0 + d1 - 2.0 * m
        a = rise * (m - d0) + above * bend
        half = rise * d0 - above * bend
        root = np.sqrt(np.maximum(half * half + 4.0 * a * m * above, 0.0))
        # 2 c / (-b - sqrt(b^2 - 4 a c)): the form that does not cancel where the bin is straight.
        inverse: Float64Array = knot_x[b] + width * 2.0 * m * above / (half + root)
        return inverse

    def evaluate(self, x: Float64Array) -> Float64Array:
        """Evaluate every curve (Durkan et al. 2019, eq. 4), as `warpir.kernels.tone` does.

        Args:
            x: Positions, clamped to [0, 1], shape [...].

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

    def evaluate_ratio(self, ratio: Float64Array) -> Float64Array:
        """Evaluate the curves of the shadow ratio, a channel each; straight on beyond 1.

        Args:
            ratio: At least 0, shape [..., curve].

        Returns:
            Shape [..., curve].
        """
        shown = np.diagonal(self.evaluate(ratio), axis1=-2, axis2=-1)
        beyond: Float64Array = shown + np.maximum(ratio - 1.0, 0.0) * self.slope[:, -1]
        return beyond

    @staticmethod
    def identity(curves: int, bins: int = 5) -> ToneKnots:
        """Return curves that change nothing."""
        x = np.tile(np.linspace(0.0, 1.0, bins + 1, dtype=np.float32), (curves, 1))
        return ToneKnots(x, x.copy(), np.ones_like(x))


def _spline(
    t: Float64Array,
    x: Float64Array,
    y: Float64Array,
    slope: Float64Array,
) -> Float64Array:
    """Evaluate one curve within [0, 1] from its knots."""
    k = np.clip(np.searchsorted(x, t, side="right") - 1, 0, len(x) - 2)
    width, rise = x[k + 1] - x[k], y[k + 1] - y[k]
    m, q = rise / width, (t - x[k]) / width
    r = q * (1.0 - q)
    bent = (m * q * q + slope[k] * r) / (m + (slope[k + 1] + slope[k] - 2.0 * m) * r)
    value: Float64Array = y[k] + rise * bent
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
    is_clipped: bool = field(default=True, kw_only=True)
    """Whether the object ends at 1 where there is no operator, as in a photo; not on a linear
    plate."""

    def radiance(self, photo_lin: AnyFloatArray) -> Float64Array:
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

    def shown(self, radiance: Float64Array) -> Float64Array:
        """Return the display-linear values that operator and curve show of radiance, any shape.

        As `radiance` reads them: without an operator, values above 1 stay what they are.
        """
        if self.tone == "reinhard":
            return self.foreground.evaluate(radiance / (1.0 + radiance))[..., 0]
        return np.where(radiance > 1.0, radiance, self.foreground.evaluate(radiance)[..., 0])

    @staticmethod
    def identity(tone: str) -> Curves:
        """Return curves that change nothing."""
        one, three = CURVE_COUNTS.values()
        return Curves(tone, ToneKnots.identity(one), ToneKnots.identity(three))
