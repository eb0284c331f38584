"""The grain of a photo: its strength by level and channel, its size, and grain drawn like it.

Flat patches tell levels, channels and size, the texture the strength (`warpir.look.texture`). The
blocks of the photo's JPEG coding are repeated too.
"""

from __future__ import annotations

import itertools
import math
import zlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from warpir.core.arrays import (
    AnyFloatArray,
    BoolArray,
    Float64Array,
    FloatArray,
    in_bands,
    mask_box,
)
from warpir.core.color import LUMINANCE_WEIGHTS
from warpir.io.images.jpeg import JpegCoding

SIDE = 12
"""Side of the patches in which grain is looked for [px]."""
LEVELS = 8
"""Bins of the display value."""
FLAT_SHARE = 0.08
"""Share of a bin's patches, the flattest, that are taken to show nothing but grain."""
LEAST_PATCHES = 6
"""Flat patches that a bin needs."""
MOST_PATCHES = 12000
"""Patches of a photo that are looked at, or up to twice as many. Of two photographs a third of all
gives the grain within 2 %."""
UNCLIPPED = (0.02, 0.98)
"""Display values between which a patch lies: beyond, grain is cut off."""
LEAST = 0.4 / 255.0
"""Strength in display values below which there is no grain to speak of: rounding to 8 bits alone
has .29 codes."""
EXCESS = 1.3
"""Strength of a level over the weakest quarter of levels [1], beyond which it is taken for texture:
the noise of a sensor changes little over the display values of a picture. Also of what the texture
tells over flat patches (`as_told`)."""
WIDEST = 2.0
"""Largest standard deviation of the blur that stands for the grain's size [px]."""
HEAVY = (3.5 / 255.0, 6.0 / 255.0)
"""Luminance's grain by the texture, and by flat patches of the level with the least of it, beyond
which flat patches count [1]: the networks have seen up to 6 codes, and tell 4 of all that is
stronger. Rock and leaves look like grain as heavy, but not at every level."""
NEAR = 32
"""What is farther off changes nothing in JPEG [px]: two blocks of subsampled chroma."""


@dataclass(frozen=True)
class Grain:
    """Noise of a photo, in display values; spatially stationary, Gaussian."""

    level: tuple[float, ...]
    """Display values at which the strength is known, rising [1]."""
    strength: tuple[tuple[float, float, float], ...]
    """Standard deviation of red, green and blue at each level, in display values [1]."""
    size: float
    """Standard deviation of the Gaussian that white noise was blurred with [px]."""
    correlation: float
    """Mean correlation between two channels [1]."""

    def deviation(self, display: AnyFloatArray) -> Float64Array:
        """Return the standard deviation at display values, both shape [..., 3]."""
        table = np.asarray(self.strength)
        return np.stack(
            [np.interp(display[..., k], self.level, table[:, k]) for k in range(3)], axis=-1
        )

    @property
    def typical(self) -> float:
        """Standard deviation of the luminous middle of the range, over channels [1]."""
        return float(np.mean(self.deviation(np.full(3, 0.4))))

    @property
    def luminance_share(self) -> float:
        """Standard deviation of the luminance over a channel's: what differs cancels out [1]."""
        own = sum(weight**2 for weight in LUMINANCE_WEIGHTS)
        return float(np.sqrt(self.correlation + (1.0 - self.correlation) * own))

    @property
    def of_luminance(self) -> float:
        """Standard deviation of the luminance in the middle of the range [1]."""
        return self.typical * self.luminance_share

    def draw(self, shape: tuple[int, int], *seed: int) -> Float64Array:
        """Return noise of unit variance with the grain's size and correlation, shape [H, W, 3]."""
        rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(seed)))
        # In less than the filter's reach of four deviations noise would meet itself round the edge.
        height, width = (max(side, 2 * math.ceil(4.0 * self.size) + 1) for side in shape)
        shared, own = (rng.standard_normal((height, width, count)) for count in (1, 3))
        common = min(max(self.correlation, 0.0), 1.0)
        # In place: these are the largest arrays of a run with a large photo.
        noise: Float64Array = own
        noise *= np.sqrt(1.0 - common)
        noise += np.sqrt(common) * shared
        if self.size > 0.0:
            ndimage.gaussian_filter(noise, (self.size, self.size, 0.0), output=noise, mode="wrap")
            impulse = np.zeros((33, 33))
            impulse[16, 16] = 1.0
            kernel = ndimage.gaussian_filter(impulse, self.size)
            noise /= np.sqrt((kernel**2).sum())
        return noise[: shape[0], : shape[1]]


def estimate_grain(srgb: AnyFloatArray) -> Grain | None:
    """Estimate a photo's grain from its flattest patches, as if these showed nothing else.

    Each patch loses its best plane; what is left in the flattest patches of each level is taken for
    grain (after Liu et al. 2008, "Automatic estimation and removal of noise from a single image",
    section 3, whose lower envelope this is). Flatness is judged by another channel's residual than
    the one whose strength is estimated, so that choosing does not make the estimate small; the
    correlation of neighbours gives the grain's size.

    Args:
        srgb: Display-encoded photo in [0, 1], shape [H, W, 3].

    Returns:
        The grain, or None where no level has flat patches enough, or less than `LEAST` of it.
    """
    every = _patches(srgb)
    patches = every[:: max(1, len(every) // MOST_PATCHES)].astype(np.float64)
    means = patches.mean(axis=(1, 2))
    inside = ((patches > UNCLIPPED[0]) & (patches < UNCLIPPED[1])).all(axis=(1, 2, 3))
    rest = _without_plane(patches[inside])
    means = means[inside]
    if len(rest) < LEAST_PATCHES:
        return None
    # Structure is smooth where grain is not: the mean over 4 x 4 blocks keeps the former.
    blocks = rest.reshape(len(rest), SIDE // 4, 4, SIDE // 4, 4, 3).mean(axis=(2, 4))
    structure = np.sqrt((blocks**2).mean(axis=(1, 2, 3)))
    brightness = means.mean(axis=1)
    edges = np.quantile(brightness, np.linspace(0.0, 1.0, LEVELS + 1))
    levels: list[float] = []
    strengths: list[Float64Array] = []
    flat: list[NDArray[np.int64]] = []
    for low, high in itertools.pairwise(edges):
        rows = np.flatnonzero((brightness >= low) & (brightness <= high))
        count = max(LEAST_PATCHES, round(FLAT_SHARE * len(rows)))
        if len(rows) < count:
            continue
        rows = rows[np.argsort(structure[rows], kind="stable")[:count]]
        # The median over patches: one with an edge that is left must not count.
        variance = np.median((rest[rows] ** 2).sum(axis=(1, 2)) / (SIDE**2 - 3), axis=0)
        level = float(np.median(brightness[rows]))
        if levels and level <= levels[-1] + 1e-4:
            continue
        levels.append(level)
        strengths.append(np.sqrt(variance))
        flat.append(rows)
    if not levels or np.quantile(strengths, 0.25) < LEAST:
        return None
    limit = EXCESS * np.quantile(strengths, 0.25, axis=0)
    kept = [k for k, strength in enumerate(strengths) if (strength <= limit).all()] or [
        int(np.argmin(np.sum(strengths, axis=1)))
    ]
    chosen = rest[np.concatenate([flat[k] for k in kept])]
    capped = np.minimum(strengths, limit)
    return Grain(
        tuple(levels),
        tuple((float(r), float(g), float(b)) for r, g, b in capped),
        _size(chosen),
        _correlation(chosen),
    )


def _patches(srgb: AnyFloatArray) -> AnyFloatArray:
    """Return the photo's whole patches, shape [N, SIDE, SIDE, 3]."""
    rows, columns = srgb.shape[0] // SIDE, srgb.shape[1] // SIDE
    tiles = srgb[: rows * SIDE, : columns * SIDE].reshape(rows, SIDE, columns, SIDE, 3)
    return tiles.transpose(0, 2, 1, 3, 4).reshape(-1, SIDE, SIDE, 3)


def as_told(
    grain: Grain | None, luminance: float, is_grey: bool = False, is_recoded: bool = False
) -> Grain | None:
    """Return a grain with the strength that the texture tells, or None below `LEAST`.

    Flat patches show all the grain of a file, and perhaps texture. So more than they show, by
    `EXCESS`, is sharpened texture or was there before the file was coded, and counts only where
    that is repeated.

    Args:
        grain: That of flat patches, whose levels, channels and size are kept, its median level
            at the strength, but for one beyond `HEAVY`, whose strengths are kept up to `EXCESS` of
            the least; None: without any.
        luminance: Standard deviation of the luminance [1].
        is_grey: Whether the photo's channels are equal, and so is what is not known of its grain.
        is_recoded: Whether `blocks_over` comes after it, and takes off what the file's coding did.
    """
    if grain and luminance > HEAVY[0]:
        least = min(grain.strength, key=sum)
        if float(np.mean(least)) * grain.luminance_share > HEAVY[1]:
            table = np.minimum(grain.strength, EXCESS * np.asarray(least))
            return replace(
                grain, strength=tuple((float(r), float(g), float(b)) for r, g, b in table)
            )
    found = grain or Grain((0.5,), ((LEAST,) * 3,), 0.0, float(is_grey))
    # Not that in the middle of the range, where a posterised picture may have none.
    median = float(np.median(np.mean(found.strength, axis=1))) * found.luminance_share
    if grain is not None and not is_recoded:
        luminance = min(luminance, EXCESS * median)
    if luminance < LEAST:
        return None
    times = luminance / median
    told = tuple((times * r, times * g, times * b) for r, g, b in found.strength)
    return replace(found, strength=told)


def _without_plane(patches: Float64Array) -> Float64Array:
    """Return patches less their least-squares planes."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] - (SIDE - 1) / 2.0
    basis = np.stack([np.ones(SIDE**2), x.ravel(), y.ravel()], axis=1)
    basis /= np.linalg.norm(basis, axis=0)
    flat = patches.reshape(len(patches), SIDE**2, 3)
    rest: Float64Array = (flat - basis @ (basis.T @ flat)).reshape(patches.shape)
    return rest


def _size(rest: Float64Array) -> float:
    """Return the Gaussian blur of white noise with the correlation of neighbours that is found.

    White noise behind a Gaussian of deviation s has the autocorrelation ``exp(-d^2 / (4 s^2))`` at
    distance d, so the correlation r of neighbours gives ``s = 1 / (2 sqrt(-ln r))``.
    """
    power = (rest**2).mean()
    along = (rest[:, :, 1:] * rest[:, :, :-1]).mean() + (rest[:, 1:] * rest[:, :-1]).mean()
    neighbour = float(0.5 * along / max(power, 1e-20))
    # The plane that was taken away left neighbours of white noise with a negative correlation.
    neighbour += 3.0 / SIDE**2
    if neighbour <= 0.02:
        return 0.0
    return float(min(0.5 / np.sqrt(-np.log(min(neighbour, 0.99))), WIDEST))


def _correlation(rest: Float64Array) -> float:
    flat = rest.reshape(-1, 3)
    covariance = flat.T @ flat / len(flat)
    deviation = np.sqrt(np.diag(covariance))
    # An even channel varies with no other.
    matrix = covariance / np.maximum(np.outer(deviation, deviation), 1e-12)
    return float(np.clip(matrix[np.triu_indices(3, 1)].mean(), 0.0, 1.0))


def grain_over(
    grain: Grain,
    composite: FloatArray,
    plate: FloatArray,
    matte: FloatArray,
    changed: BoolArray,
    seed: int,
    gamma: float,
) -> FloatArray:
    """Return what the sensor's grain adds to a composite, display-linear, shape [H, W, 3].

    The object gets the grain of its level. The photo's own grain is still in the ground, scaled by
    the shadow; what its darker level lacks is added.

    Composite, without new grain, and plate are display-linear too, the matte is the object's
    coverage, shape [H, W]. Pixels that may not change get 0. ``gamma`` is the exponent from display
    values to display-linear ones.
    """
    added = np.zeros_like(composite, np.float32)
    if not changed.any():
        return added
    box = mask_box(changed)
    # Other frames of a sequence have other grain.
    frame = zlib.crc32(np.ascontiguousarray(plate[::8, ::8], np.float32).tobytes())
    height, width = matte[box].shape
    noise = grain.draw((height, width), seed, frame)

    def add(rows: slice) -> None:
        here = changed[box][rows]
        linear = np.clip(composite[box][rows][here], 0.0, 1.0)
        shown = linear ** (1.0 / gamma)
        wanted = grain.deviation(shown)
        before = np.clip(plate[box][rows][here], 1e-6, 1.0) ** (1.0 / gamma)
        share = (1.0 - matte[box][rows][here])[:, None]
        # Of the photo's grain the uncovered share is left, scaled as its signal is.
        kept = share * grain.deviation(before) * np.minimum(shown / before, 1.0)
        lacking = np.sqrt(np.maximum(wanted**2 - kept**2, 0.0))
        noisy = np.clip(shown + lacking * noise[rows][here], 0.0, 1.0) ** gamma
        added[box][rows][here] = noisy - linear

    in_bands(add, height, width)
    return added


def blocks_over(
    coding: JpegCoding, composite: FloatArray, changed: BoolArray, gamma: float
) -> FloatArray:
    """Return what the photo's JPEG coding adds to a composite, display-linear, shape [H, W, 3].

    The composite is display-linear, with the grain. Pixels that may not change get 0. ``gamma`` is
    the exponent from display values to display-linear ones.
    """
    added = np.zeros_like(composite, np.float32)
    if not changed.any():
        return added
    box = mask_box(changed, NEAR)
    linear = np.clip(composite[box], 0.0, 1.0)
    shown = linear ** (1.0 / gamma)
    codes = np.zeros(composite.shape, np.uint8)
    codes[box] = np.round(255.0 * shown)
    off = (coding.recoded(codes)[box].astype(np.float32) - codes[box]) / np.float32(255.0)
    coded = np.clip(shown + off, 0.0, 1.0) ** gamma
    added[box] = (coded - linear) * changed[box][..., None]
    return added
