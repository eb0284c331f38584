"""The contrast of a camera's response, which darkens the object's blacks as it did the photo's.

Photos are decoded by gamma 2.2 (`warpir.core.color`). Cameras encode by sRGB, which is darker in
the blacks, and bend the tones on the way: steeper about mid grey, a toe below, a shoulder above.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray
from warpir.core.color import GAMMA, luminance
from warpir.scene.tone_curves import ToneKnots

GREY = 0.18
"""Display-linear value that the curve leaves alone [1]: there the light's exposure was judged."""
DARK = (0.0005, 0.0015, 0.004, 0.01, 0.025, 0.06, 0.105)
"""Knots below `GREY`; a spline between them is right to .1 codes."""
RANGE = (0.8, 1.35)
"""Least and largest exponent that is estimated [1]."""
TOES = tuple(0.0004 * k for k in range(51))
"""Toes that are estimated [1]; encoding by sRGB has about .0085."""
PLACED = (0.003, 0.03)
"""Radiances whose display values are estimated, of a black and of a dark object [1]."""
WIDTH = 160
"""Width that photos are averaged to before their values are counted [px], so that grain and tiny
shadows count as little in a large photo as in a small one."""
BLACK = 0.09
"""Display value of a black object's radiance of .005 under gamma 2.2 [1], code 23 of 255."""
DARKEST = 0.005
"""Share of a photo's pixels that are its blacks [1]."""
BRIGHT = 0.97
"""Display value from which a channel is near clipping [1]."""
COEFFICIENTS = (
    (0.1216, -0.0143, 0.0135, -0.0678, -0.0344),
    (0.2446, -0.0441, 0.0102, -0.047, -0.0306),
)
"""Display values at `PLACED`: constant, and factors of `statistics`, of ``python -m
benchmarks.response``."""


@dataclass(frozen=True)
class Response:
    """A camera's response as an S-curve about mid grey, equal for all channels."""

    exponent: float
    """Slope at mid grey in logarithms without the toe, and power of all darker values [1]; 1 is no
    change."""
    toe: float = 0.0
    """Display-linear value at which about half is left of what the power gives [1]; 0: no toe."""
    black: float | None = None
    """Display value of the photo's blacks [1], where the photo was asked."""

    def dark(self, x: AnyFloatArray) -> Float64Array:
        """Return ``GREY (x / GREY)^exponent * x (GREY + toe) / (GREY (x + toe))``.

        Args:
            x: Display-linear values in (0, `GREY`], any shape.
        """
        share = x / GREY
        left = share * (GREY + self.toe) / (x + self.toe)
        return np.asarray(GREY * share**self.exponent * left, np.float64)

    def knots(self) -> ToneKnots:
        """Return the curve, display-linear to display-linear.

        Up to `GREY` that of `dark`; above, one bin of the spline to (1, 1), where the slope is the
        exponent's inverse.
        """
        dark = np.array([*DARK, GREY])
        shown = self.dark(dark)
        slope = (self.exponent + self.toe / (dark + self.toe)) * shown / dark
        x = np.concatenate([[0.0], dark, [1.0]])
        y = np.concatenate([[0.0], shown, [1.0]])
        slope = np.concatenate([[shown[0] / dark[0]], slope, [1.0 / self.exponent]])
        return ToneKnots(*(k[None].astype(np.float32) for k in (x, y, slope)))

    def shadow_ratio(self, ratio: FloatArray, plate: AnyFloatArray) -> FloatArray:
        """Return what darkens the photo as the response shows the ground under less light.

        The photo's value p is ``f(E)``; under the share r of the light it is ``f(r E)``.

        Args:
            ratio: Traced shadow ratio [1], shape [N, 3].
            plate: Display-linear photo; values that no curve shows keep their ratio; same shape.
        """
        knots = self.knots()
        is_shown = (plate > 0.0) & (plate <= 1.0)
        p = np.where(is_shown, plate, 1.0).astype(np.float64)
        shaded = knots.evaluate(knots.invert(p) * ratio)[..., 0]
        return np.where(is_shown, shaded / p, ratio).astype(np.float32)

    def colour(self, shown: AnyFloatArray) -> FloatArray:
        """Return display-linear values behind the response, any shape; those above 1 stay."""
        bent = self.knots().evaluate(np.asarray(shown, np.float64))[..., 0]
        return np.where(shown > 1.0, shown, bent).astype(np.float32)


def statistics(linear: AnyFloatArray) -> Float64Array:
    """Return what of a photo's values tells its contrast, weakly.

    Contrast clips highlights, deepens the darkest values, moves the mean and saturates colours.

    Args:
        linear: Display-linear photo, shape [H, W, 3].

    Returns:
        Share of near clipped pixels, logarithm of the darkest thousandth's display value, mean
        display value, mean saturation [1].
    """
    step = max(1, min(round(linear.shape[1] / WIDTH), len(linear)))
    rows, columns = linear.shape[0] // step * step, linear.shape[1] // step * step
    tiles = linear[:rows, :columns].reshape(rows // step, step, columns // step, step, 3)
    shown = np.clip(tiles.mean(axis=(1, 3), dtype=np.float64), 0.0, 1.0) ** (1.0 / GAMMA)
    level = luminance(shown**GAMMA) ** (1.0 / GAMMA)
    high, low = shown.max(axis=-1), shown.min(axis=-1)
    return np.array(
        [
            (high >= BRIGHT).mean(),
            np.log(np.quantile(level, 0.001) + 1.0 / 255.0),
            level.mean(),
            ((high - low) / (high + 0.02)).mean(),
        ]
    )


def estimate_response(linear: AnyFloatArray) -> Response | None:
    """Estimate a camera's contrast from the photo's own values.

    One photo does not separate the scene's contrast from the camera's: the statistics move the
    estimate by little about what cameras do on average. So a black object is never shown darker
    than the photo's blacks.

    Args:
        linear: Display-linear photo, shape [H, W, 3].

    Returns:
        The response, or None where the photo is nowhere darker than a black object, as in fog.
    """
    level = np.maximum(luminance(np.asarray(linear)), 0.0) ** (1.0 / GAMMA)
    black = float(np.quantile(level, DARKEST))
    if black >= BLACK:
        return None
    response = response_through(*np.array(COEFFICIENTS) @ [1.0, *statistics(linear)])
    for share in np.linspace(1.0, 0.0, 41):
        exponent = 1.0 + share * (response.exponent - 1.0)
        part = Response(float(exponent), float(share * response.toe), black)
        if part.dark(np.array(BLACK**GAMMA)) >= black**GAMMA:
            break
    return part


def response_through(black: float, dark: float) -> Response:
    """Return the response that shows the radiances `PLACED` as two display values [1].

    Exponent and toe stay in `RANGE` and `TOES`; where one of them ends, the dark value is met.
    """
    toes = np.array(TOES)
    low, high = (x / GREY * (GREY + toes) / (x + toes) for x in PLACED)
    shown = np.clip([black, dark], 1e-3, 1.0) ** GAMMA / GREY
    exponents = np.clip(np.log(shown[1] / high) / np.log(PLACED[1] / GREY), *RANGE)
    off = (PLACED[0] / GREY) ** exponents * low - shown[0]
    best = int(np.abs(off).argmin())
    return Response(float(exponents[best]), TOES[best])
