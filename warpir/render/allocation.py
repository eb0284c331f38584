"""Samples of a picture shared out among its pixels by the noise that a pilot sees.

Of a given number of independent samples the mean squared error is least where each pixel takes them
in proportion to its deviation (Neyman 1934, "On the Two Different Aspects of the Representative
Method"); a Sobol' sequence's falls faster than as 1 / n, so here they are spread a little more
evenly. A mirrored sun's pixels and those of a shadow's edge have ten times the deviation of the
rest. The pilot is thrown away, so that a pixel's mean is that of as many samples as it was given,
whatever the pilot saw: no bias (Kirk and Arvo 1991, "Unbiased Sampling Techniques for Image
Synthesis").

The pilot also says how much noise the picture will have. Where that is too much a picture may have
more samples than were asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.render.device import Launcher

Judged = Callable[[FloatArray], FloatArray]
"""What of a radiance or a ratio is to have little noise."""
Rows = tuple[FloatArray, ...]
"""What is traced of some pixels, a row each."""
Trace = Callable[[IntArray, int, int], Rows]
"""Traces rows of the pixels with so many samples; the last number is 0 for the picture, 1 or 2 for
a pilot, whose samples are others than the picture's."""


@dataclass(frozen=True)
class Sharing:
    """How samples are shared out."""

    judged: Judged
    """Of the first of what is traced this has the noise that counts."""
    noise: float | None = None
    """Root mean square error of what is judged above which a picture has up to `MOST` times the
    samples [1]; None: it has as many as asked for."""


LEAST_SAMPLES = 32
"""Mean samples of a pixel from which on a pilot is worth its time."""
LEAST_WORK = {"cpu": 1 << 16, "cuda": 1 << 26}
"""Samples of a picture from which on. On an H200 even samples are the faster road to a given error
below that: few pixels do not fill it, and those with noise have the longer rays."""
PILOT_SHARE, PILOT_SAMPLES = 16, (4, 8)
"""A pilot takes a sixteenth of the samples, within these bounds, of every second pixel of every
second row."""
SIDE = 7
"""Side of the square over which the pilots' variance is averaged [px]: of a few samples one pixel's
says little."""
STEPS = (-1, 3)
"""Samples of a pixel over their mean, as powers of two: a Sobol' sequence is cut at those alone. No
pixel has less than half of them, whatever the pilot has missed."""
MOST = 4.0
"""Samples of a picture whose noise is too much, over those asked for."""
MUCH_WORK = 1 << 21
"""Samples up to which a picture with too much noise has more than those asked for: three seconds of
two cores, or twice that on a slow one. On CUDA none has, for those so small are traced evenly."""
DEVIATION_POWER = 0.85
"""Of a deviation, for its samples: 2 / (1 + b) where squared errors fall as n^-b."""
FIREFLY = 0.3
"""Share of the pilots' variance in one pixel from which on the samples stay even: where the next
path of that kind goes, it does not say."""
PILOT_SEED = 0x2F6E2B1
"""Distance of the pilots' seeds from the picture's."""
WORTH = 1.25
"""Predicted gain from which on the samples are shared out, where launches cost nothing."""


def as_it_is(values: FloatArray) -> FloatArray:
    """Judge radiance, or a ratio, by its own error: highlights count most."""
    return values


def as_shown(values: FloatArray, white: float = 1.0) -> FloatArray:
    """Judge radiance by its error in a picture: Reinhard's operator, then gamma 2.2.

    ``white`` is the radiance that the picture shows as white. Of a ratio, which multiplies what the
    photo shows, the second alone is in the picture, and nearly what this is below 1.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((values / (white + values)) ** (1.0 / 2.2), np.float32)


def by_noise(
    launcher: Launcher,
    trace: Trace,
    sharing: Sharing | None,
    pixels: IntArray,
    width: int,
    samples: tuple[int, int],
) -> tuple[Rows, float]:
    """Trace pixels, more often where noise is; return their rows and their mean samples.

    Those of the pilot count, but where it finds that all pixels should have as many. Small pictures
    and few samples are traced evenly.

    Args:
        launcher: Is told of the share of the work that each launch does.
        trace: See `Trace`.
        sharing: Which noise counts; None: all pixels have as many samples.
        pixels: Row-major pixel indices, shape [pixel].
        width: Of the picture [px].
        samples: Camera samples per pixel, up to `MOST` times as many where there is too much noise,
            and rays of each.
    """
    spp, rays = samples
    work = spp * rays * len(pixels)
    least = LEAST_WORK["cpu" if launcher.device.is_cpu else "cuda"]
    if sharing is None or spp < LEAST_SAMPLES or work < least:
        return trace(np.arange(len(pixels), dtype=np.int32), spp, 0), float(spp)
    worth = WORTH * (1.0 + 2.0 * least / work)
    most = 1.0 if sharing.noise is None else float(np.clip(MUCH_WORK / work, 1.0, MOST))
    try:
        steps, cost = _pilot(launcher, trace, sharing, pixels, (width, spp), (worth, most))
        out: Rows = ()
        done, left = cost, (1.0 - cost) / (2.0**steps).sum()
        for step in np.unique(steps):
            rows = np.flatnonzero(steps == step).astype(np.int32)
            share = left * 2.0**step * len(rows)
            launcher.span = done, done + share
            done += share
            part = trace(rows, max(1, int(spp * 2.0**step)), 0)
            out = out or tuple(np.empty((len(pixels), *p.shape[1:]), p.dtype) for p in part)
            for whole, values in zip(out, part, strict=True):
                whole[rows] = values
        return out, spp * float((2.0**steps).mean())
    finally:
        launcher.span = 0.0, 1.0


def _pilot(
    launcher: Launcher,
    trace: Trace,
    sharing: Sharing,
    pixels: IntArray,
    size: tuple[int, int],
    limits: tuple[float, float],
) -> tuple[IntArray, float]:
    """Return `_steps` of the pixels, and the share of the picture's samples that the pilot took.

    ``size`` is the picture's width [px] and the asked samples of a pixel; ``limits`` are the
    predicted gain from which on they are shared out, and the most samples over those asked for.
    """
    (width, spp), (worth, most) = size, limits
    count = int(np.clip(spp // PILOT_SHARE, *PILOT_SAMPLES))
    seen = np.flatnonzero((pixels % width | pixels // width) % 2 == 0).astype(np.int32)
    cost = count * len(seen) / (spp * len(pixels))
    pilots = []
    for number in (1, 2):
        launcher.span = (number - 1) * cost, number * cost
        pilots.append(sharing.judged(trace(seen, count, number)[0]).astype(np.float64))
    squares = ((pilots[0] - pilots[1]) ** 2).mean(axis=-1)
    # What is not finite says nothing of the noise; in the picture it is seen and counted.
    squares[~np.isfinite(squares)] = 0.0
    if squares.max(initial=0.0) > FIREFLY * squares.sum():
        return np.zeros(len(pixels), np.int32), 2.0 * cost
    # The difference of two means of so many samples has twice the variance of either.
    deviation = np.sqrt(0.5 * count) * _deviation(squares, seen, pixels, width)
    factor = 1.0
    while True:
        steps = _steps(deviation, factor, 2.0 * cost, worth)
        error = (deviation**2 / (spp * 2.0**steps)).mean()
        if sharing.noise is None or error <= sharing.noise**2 or factor >= most:
            return steps, 2.0 * cost
        factor = min(most, np.sqrt(2.0) * factor)


def pilot_seed(seed: int, number: int) -> int:
    """Return the seed of a pilot; number 0 is the picture."""
    return (seed + PILOT_SEED * number) % (1 << 31) if number else seed


def _deviation(squares: Float64Array, seen: IntArray, pixels: IntArray, width: int) -> Float64Array:
    """Return a pixel's deviation up to a factor, from those in its neighbourhood, shape [pixel].

    Args:
        squares: Squared differences of two pilots, shape [seen].
        seen: Their rows among ``pixels``.
        pixels: Row-major pixel indices, shape [pixel].
        width: Of the picture [px].
    """
    top = int(pixels.min()) // width
    height = int(pixels.max()) // width - top + 1
    index = pixels - top * width
    planes = np.zeros((2, height * width))
    planes[:, index[seen]] = squares, np.ones(len(seen))
    total, count = (
        ndimage.uniform_filter(plane.reshape(height, width), SIDE, mode="constant").reshape(-1)
        for plane in planes
    )
    # The filter's running sums leave rounding, also below zero.
    mean = np.maximum(total[index], 0.0) / np.maximum(count[index], 0.5 / SIDE**2)
    return np.asarray(np.sqrt(mean))


def _steps(deviation: Float64Array, factor: float, cost: float, worth: float) -> IntArray:
    """Return the binary logarithm of each pixel's samples over the asked number, shape [pixel].

    Their mean is ``factor - cost`` at most; all have the largest power of two in the factor where
    another choice promises to lower the mean squared error by less than ``worth``.
    """
    mean, budget = deviation.mean(), factor - cost
    even = np.full(len(deviation), int(np.log2(factor)), np.int32)
    if mean == 0.0 or budget * (deviation**2).mean() < worth * factor * mean**2:
        return even
    relative = DEVIATION_POWER * np.log2(np.maximum(deviation / mean, 2.0**-20))
    ordered = np.sort(relative)
    lowest, highest = STEPS[0], STEPS[1] + int(np.log2(factor))
    # From which sum on a pixel takes the next step, and by how much its samples grow there
    bounds = np.arange(lowest, highest) + 0.5
    growth = 2.0 ** np.floor(bounds)
    low, high = -20.0, 20.0
    for _ in range(30):
        middle = 0.5 * (low + high)
        above = len(ordered) - np.searchsorted(ordered, bounds - middle)
        is_over = 2.0**lowest + (above * growth).sum() / len(ordered) > budget
        low, high = (low, middle) if is_over else (middle, high)
    steps: IntArray = np.clip(np.round(relative + low), lowest, highest).astype(np.int32)
    return steps
