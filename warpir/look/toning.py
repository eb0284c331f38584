"""Black and white photos, plain or toned: sepia, cyanotype, duotone, or a scan with a cast.

All of their pixels lie on one curve through RGB, so object, shadow and mirror image are put on it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray
from warpir.core.color import GAMMA, luminance
from warpir.io.images.photos import Photo

KNOTS = 9
"""Values of the curve, evenly over the display values 0 to 1."""
SIDE = 640
"""Longer side that a photo is looked at in [px]; pixels are left out, not averaged."""
TILE = 4
"""Distances from the curve are averaged over tiles of this side [px]: noise and what JPEG leaves of
small colours count for little."""
OFF = 0.8 / 255.0
"""RMS distance of a toned photo's tiles from its curve, in display values [1], at most, where it
has no detail; see ``docs/look.md``."""
OFF_OF_DETAIL = 0.02
"""What is added, of the median step between neighbours: JPEG blurs colours at edges [1]."""
DETAIL_MIN = 1.5 / 255.0
"""Least such step, in display values [1]: a bare backdrop has one colour too."""
SPREAD_MIN = (0.5, 0.08)
"""Least range of tones, in display values [1], without the half per cent at each end and of the
middle half: one or two materials, such as a white wall and a black curtain, have one colour too."""
SMOOTHNESS = 1e-3
"""Weight of the curve's bends, per pixel [1]; it goes on straight where the photo has no value."""
LEAST = 1e-6
"""Luminance below which colours fall off in proportion [1], half a code."""


@dataclass(frozen=True)
class Toning:
    """The curve through RGB that a black and white photo's pixels lie on."""

    offsets: tuple[tuple[float, float, float], ...]
    """Display values of red, green and blue over that of the luminance, at `KNOTS` [1]."""

    @property
    def is_grey(self) -> bool:
        """Whether all channels are equal."""
        return not np.any(self.offsets)

    def colour(self, grey: AnyFloatArray) -> FloatArray:
        """Return display-linear colours of luminances.

        Args:
            grey: Display-linear luminance, any shape.

        Returns:
            Shape [..., 3], of the same luminance, as far as channels do not clip.
        """
        held = np.maximum(np.asarray(grey, np.float64), LEAST)
        level = held ** (1.0 / GAMMA)
        knots = np.linspace(0.0, 1.0, KNOTS)
        offset = [np.interp(level, knots, channel) for channel in np.transpose(self.offsets)]
        shown = np.maximum(level[..., None] + np.stack(offset, axis=-1), 0.0) ** GAMMA
        share = np.minimum(np.asarray(grey) / held, 1.0)
        return np.asarray(shown * share[..., None], np.float32)

    def on_object(self, colour: FloatArray, parts: list[FloatArray], matte: FloatArray) -> None:
        """Tone the object and its parts, in place; they still sum up.

        Args:
            colour: Display-linear object times its coverage, shape [H, W, 3].
            parts: Of it, shape [H, W, 3] each.
            matte: Coverage [1], shape [H, W].
        """
        seen = matte > 0.0
        grey = np.asarray(luminance(colour[seen]), np.float32)
        toned = self.colour(grey / matte[seen]) * matte[seen][:, None]
        share = toned / np.maximum(grey, np.float32(1e-30))[:, None]
        colour[seen] = toned
        for part in parts:
            part[seen] = np.asarray(luminance(part[seen]), np.float32)[:, None] * share

    def on_ground(self, ratio: FloatArray, plate: AnyFloatArray) -> FloatArray:
        """Return the shadow ratio by channel that leaves the shaded photo on the curve.

        Args:
            ratio: Shadow ratio [1], shape [H, W, 3].
            plate: Display-linear photo, shape [H, W, 3].
        """
        shaded = (ratio != 1.0).any(axis=-1)
        before = luminance(plate[shaded])
        after = self.colour(before * luminance(ratio[shaded]))
        toned = ratio.copy()
        toned[shaded] = after / np.maximum(self.colour(before), np.float32(LEAST))
        return toned

    def on_mirror(self, added: FloatArray, shaded: AnyFloatArray) -> FloatArray:
        """Return what a mirror image adds to the shaded photo.

        Args:
            added: Display-linear, of either sign, shape [H, W, 3].
            shaded: Display-linear photo in the object's shadow, shape [H, W, 3].
        """
        before, more = luminance(shaded), luminance(added)
        toned = self.colour(np.maximum(before + more, 0.0)) - self.colour(before)
        return np.where((more == 0.0)[..., None], np.float32(0.0), toned)


def toning_of(photo: Photo) -> Toning | None:
    """Return the curve that all colours of a photo lie on; None for a photo in colour.

    Where the channels of all codes are equal it is grey, but for a photo of one value. A linear
    plate is never taken for toned.
    """
    codes = photo.codes
    if (codes == codes[..., :1]).all():
        is_even = bool((codes == codes[0, 0]).all())
        return None if is_even else Toning(((0.0, 0.0, 0.0),) * KNOTS)
    return None if photo.is_linear else _toning_of(photo.srgb)


def _toning_of(srgb: FloatArray) -> Toning | None:
    stride = max(1, round(max(srgb.shape[:2]) / SIDE))
    shown = srgb[::stride, ::stride].astype(np.float64)
    if min(shown.shape[:2]) < 2 * TILE:
        return None
    level = luminance(shown**GAMMA) ** (1.0 / GAMMA)
    tiles = _tiles(level)
    step = np.hypot(np.diff(tiles, axis=1)[:-1], np.diff(tiles, axis=0)[:, :-1])
    detail = float(np.median(step))
    least, low, high, most = np.quantile(tiles, (0.005, 0.25, 0.75, 0.995))
    spread = most - least, high - low
    if detail < DETAIL_MIN or np.less(spread, SPREAD_MIN).any():
        return None
    offset = shown - level[..., None]
    offsets, curve = _curve_through(level.ravel(), offset.reshape(-1, 3))
    off = _tiles(offset - curve.reshape(offset.shape))
    if float(np.sqrt((off**2).mean())) > OFF + OFF_OF_DETAIL * detail:
        return None
    return Toning(tuple((float(r), float(g), float(b)) for r, g, b in offsets))


def _tiles(plane: AnyFloatArray) -> Float64Array:
    rows, columns = plane.shape[0] // TILE, plane.shape[1] // TILE
    held = plane[: rows * TILE, : columns * TILE]
    tiles = held.reshape(rows, TILE, columns, TILE, *plane.shape[2:])
    return np.asarray(tiles.mean(axis=(1, 3)), np.float64)


def _curve_through(level: AnyFloatArray, offset: AnyFloatArray) -> tuple[Float64Array, FloatArray]:
    """Return offsets at the knots, shape [KNOTS, 3], and the curve's at each level."""
    place = np.clip(level, 0.0, 1.0) * (KNOTS - 1)
    below = np.minimum(place.astype(int), KNOTS - 2)
    right = place - below
    # Of a piecewise linear curve the normal matrix has three bands.
    normal, wanted = np.zeros((KNOTS, KNOTS)), np.zeros((KNOTS, 3))
    weights = ((below, 1.0 - right), (below + 1, right))
    for i, a in weights:
        for channel in range(3):
            wanted[:, channel] += np.bincount(i, a * offset[:, channel], KNOTS)
        for j, b in weights:
            normal += np.bincount(i * KNOTS + j, a * b, KNOTS**2).reshape(KNOTS, KNOTS)
    bends = np.diff(np.eye(KNOTS), 2, axis=0)
    normal += SMOOTHNESS * len(level) * bends.T @ bends
    offsets = np.asarray(np.linalg.solve(normal, wanted), np.float64)
    curve = offsets[below] * (1.0 - right)[:, None] + offsets[below + 1] * right[:, None]
    return offsets, curve
