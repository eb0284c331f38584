"""How soft and how grainy a photo's texture is.

Blur takes fine detail and leaves coarse; grain comes after it, so that no blur takes it. How much
detail a scene had nobody knows, but scenes are alike: so small networks, which have seen places and
pictures through known cameras, read the statistics of the photo's bands (`python -m
benchmarks.sharpness --fit` trained them). The lens's blur is asked where edges are few or do not
agree on it, the strength of the grain always: what flat patches show is grain or asphalt.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file
from scipy import ndimage

from warpir.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float64Array,
    FloatArray,
    mask_box,
    on_cores,
)
from warpir.core.color import linear_to_gamma, luminance
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.weight_files import SHIPPED

SIGMAS = (0.5, 0.75, 1.1, 1.6, 2.3, 3.3, 4.8)
"""Standard deviations of the Gaussians between which the bands lie, the first from no blur [px]."""
QUANTILES = (0.2, 0.5, 0.8, 0.95, 0.99)
"""Of a band's magnitudes."""
PAIRS = ((0, 2), (1, 3), (2, 4), (3, 5), (1, 5))
"""Bands that are compared where the second has most detail: a fine and a coarse one."""
DETAILED, NEAR = 0.7, 7
"""Quantile of the local means of a band from which a place has detail, and their width [px]."""
FLOOR = 2e-4
"""Added to a magnitude before its logarithm: less is rounding [1]."""
CLIPPED, AWAY = 0.97, 4
"""Display-linear value from which a channel may be clipped, and the distance at which neither such
pixels nor the picture's border count [px]."""
FEW = 300
"""Pixels below which an area tells nothing, and clipped ones count as well."""
WINDOWS, WINDOW = 4, 128
"""Of an area that is higher or wider than both together: how many parts are seen along it, and
their size [px]; a full photo has no more to tell than these."""
MARGIN = 15
"""Seen round a part, so that its own border blurs nothing [px]."""
SMALLEST = 64
"""Side of a photo from which its grain is told [px]: the networks have seen none below 80."""
FARTHEST = 6.0
"""Standardised statistics are clipped there: a picture unlike all others."""
UNITS = np.array([1.0, 4.0 / 255.0])
"""Of the networks' answers: blur [px], and grain in display values [1]."""
WEIGHTS = SHIPPED / "texture.safetensors"


@dataclass(frozen=True)
class Texture:
    """What the texture of a photo tells of its camera."""

    blur: float
    """Standard deviation of the lens's Gaussian, the pixel left out [px]."""
    grain: float | None
    """Standard deviation of the luminance's grain in the middle of the range, in display values,
    before the photo's file was coded [1]; None where the photo is smaller than `SMALLEST`."""


def read_texture(linear: AnyFloatArray, region: BoolArray | None = None) -> Texture:
    """Estimate blur and grain of a photo by its texture.

    Args:
        linear: Display-linear photo, shape [H, W, 3].
        region: Where to look first, shape [H, W]; None or empty: everywhere.

    Raises:
        InputError: The weights in the package are absent or damaged (`ExitCode.MODEL`).
    """
    blur, grain = np.maximum(answers(statistics(linear, region)[None])[0], 0.0).tolist()
    return Texture(blur, None if min(linear.shape[:2]) < SMALLEST else grain)


def answers(given: Float64Array) -> Float64Array:
    """Return the mean answers of the networks to statistics [N, S]: fields of `Texture`, [N, 2]."""
    net = _network()
    x = np.clip((given - net["mean"]) / net["spread"], -FARTHEST, FARTHEST)
    hidden = np.broadcast_to(x, (len(net["bias.0"]), *x.shape))
    for layer in (0, 1):
        hidden = np.maximum(hidden @ net[f"weight.{layer}"] + net[f"bias.{layer}"], 0.0)
    told: Float64Array = (hidden @ net["weight.2"] + net["bias.2"]).mean(axis=0) * UNITS
    return told


@cache
def _network() -> dict[str, NDArray[np.float64]]:
    """Return the weights: ``mean``, ``spread`` [S], of each layer [networks, in, out]."""
    try:
        weights = load_file(WEIGHTS)
    except (OSError, SafetensorError) as error:
        what = f"absent or damaged weights ({error})"
        raise InputError(str(WEIGHTS), what, "install warpir again", ExitCode.MODEL) from None
    return {name: value.astype(np.float64) for name, value in weights.items()}


def statistics(linear: AnyFloatArray, region: BoolArray | None) -> Float64Array:
    """Return what the networks read of a photo: of the region's box, then of the whole, shape [S].

    Of each band between two Gaussians: logarithms of quantiles of its magnitude and of its standard
    deviation. Of pairs of bands: quantiles of the logarithm of their ratio where there is detail.
    Mean and standard deviation of the values.
    """
    height, width = linear.shape[:2]
    whole = (slice(0, height), slice(0, width))
    first = whole if region is None or not region.any() else mask_box(region)
    return np.concatenate(on_cores(lambda area: _of_area(linear, area), (first, whole)))


def _of_area(linear: AnyFloatArray, area: tuple[slice, slice]) -> Float64Array:
    """Return the statistics of a box."""
    parts = [_seen(linear, rows, columns) for rows, columns in _windows(area)]
    value, bands, near, clear = (
        np.concatenate(pieces, axis=-1) for pieces in zip(*parts, strict=True)
    )
    if clear.sum() < FEW:
        clear = np.ones_like(clear)
    value, bands, near = value[clear], bands[:, clear], near[:, clear]
    found: list[Float64Array] = []
    for band in bands:
        magnitudes = np.append(np.quantile(band, QUANTILES), band.std())
        found.append(np.log(magnitudes + FLOOR))
    for fine, coarse in PAIRS:
        detailed = near[coarse] >= np.quantile(near[coarse], DETAILED)
        ratio = np.log(near[fine][detailed] / near[coarse][detailed])
        found.append(np.quantile(ratio, (0.1, 0.5, 0.9)))
    return np.concatenate([*found, [value.mean(), value.std()]]).astype(np.float64)


def _windows(area: tuple[slice, slice]) -> list[tuple[slice, slice]]:
    """Return the parts of a box that are seen: all of it, or some that lie evenly in it."""
    along = []
    for side in area:
        starts = [side.start]
        length = side.stop - side.start
        if length > WINDOWS * WINDOW:
            starts = [int(s) for s in np.linspace(side.start, side.stop - WINDOW, WINDOWS)]
            length = WINDOW
        along.append([slice(start, start + length) for start in starts])
    return [(rows, columns) for rows in along[0] for columns in along[1]]


def _seen(
    linear: AnyFloatArray, rows: slice, columns: slice
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return values [N], bands and their local means [bands, N] of a part, and what counts [N]."""
    height, width = linear.shape[:2]
    top, left = max(rows.start - MARGIN, 0), max(columns.start - MARGIN, 0)
    wide = np.asarray(linear[top : rows.stop + MARGIN, left : columns.stop + MARGIN], np.float32)
    value = linear_to_gamma(np.minimum(luminance(wide), 1.0))
    levels = [value, *(ndimage.gaussian_filter(value, s, truncate=3.0) for s in SIGMAS)]
    bands = [np.abs(a - b) for a, b in pairwise(levels)]
    near = [ndimage.uniform_filter(band, NEAR) + FLOOR for band in bands]
    clear = ~ndimage.binary_dilation(wide.max(axis=-1) > CLIPPED, iterations=AWAY)
    y = np.arange(top, top + len(wide))
    x = np.arange(left, left + wide.shape[1])
    clear &= ((y >= AWAY) & (y < height - AWAY))[:, None] & (x >= AWAY) & (x < width - AWAY)
    inside = tuple(
        slice(side.start - first, side.stop - first)
        for side, first in ((rows, top), (columns, left))
    )
    flat = [np.stack([b[inside].ravel() for b in planes]) for planes in (bands, near)]
    return value[inside].ravel(), flat[0], flat[1], clear[inside].ravel()
