"""The blur of a photo's edges, by which an object is as sharp as what stands around it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from warpir.core.arrays import AnyFloatArray, BoolArray, Float64Array, FloatArray
from warpir.core.color import GAMMA, linear_to_gamma, luminance

SCALES = (0.7, 1.0, 1.4, 2.0, 2.8)
"""Standard deviations of the Gaussian derivatives [px]; what is left of the edges' energy from one
to the next tells the blur."""
RIDGES = 3
"""Which of `SCALES` finds the edges: one at which noise is weak and few edges have merged."""
CLEAR, FAINT = 8.0, 4.0
"""Least slope of an edge over the noise's, and what counts where the first finds too few edges."""
LEAST_SLOPE = 0.018
"""Root mean square of the edges' slopes [display values per px] below which they tell no blur: they
are clouds or gradients, soft by themselves. An object that is blurred too much looks worse than one
that is too sharp."""
LEAST_EDGES, AROUND = 60, 200
"""Edge pixels below which a photo tells no blur, and below which a part of it does not [1]."""
BLOCK, FLAT = 16, 0.1
"""Side of the blocks [px] and the share of them, the flattest, that tell the noise."""
ROUNDING = 0.29 / 255.0
"""Least noise of a photo: that of rounding to 8 bits, in display values."""
BLACK = 0.02
"""Display value below which noise may be cut off [1]."""
CLIPPED = 0.97
"""Display value over that of the photo's brightest thousandth from which a channel may be clipped
or compressed, which makes edges look sharper; at most `WHITE` counts."""
WHITE = 0.985
"""Display value that is certainly clipped [1]."""
COEFFICIENTS = (
    0.3576,
    -8.6138,
    -6.8135,
    -4.4015,
    5.3459,
    -1.2611,
    2.3692,
    0.4478,
    4.9764,
    -5.5343,
    -0.0101,
    2.5619,
    6.0743,
    1.9342,
    0.0289,
    2.5904,
    -0.7568,
    0.3982,
    -3.1557,
    -0.2122,
    -0.1902,
)
"""Of `terms`: the logarithm of the variance [px^2] plus `SOFTENED`."""
RANGES = ((0.04, 0.084, 0.163, 0.25, -4.102), (0.636, 0.635, 0.845, 1.005, -2.316))
"""Least and largest values of `edge_statistics` that the fit has seen."""
SOFTENED = 0.08
"""Added to the variance before its logarithm is fitted [px^2]: blurs below .3 px look alike."""
SHARP = 0.38
"""What the regression gives for photos without any blur, which the fit has few of [px]; it is taken
off where little else is. Sharp photographs, made a third as large, would get .4 to .5."""
PIXEL_SIGMA = 12.0**-0.5
"""Standard deviation of a square pixel, the blur that a rendered edge has already [px]."""
TRUNCATE = 3.5
"""Standard deviations at which a Gaussian that blurs a picture is cut."""


@dataclass(frozen=True)
class EdgeBlur:
    """How blurred the edges of a picture are."""

    sigma: float
    """Standard deviation of the Gaussian that blurred an ideal step, the pixel included [px]."""
    edges: int
    """Edge pixels it was estimated from."""


def estimate_blur(linear: AnyFloatArray, region: BoolArray | None = None) -> EdgeBlur | None:
    """Estimate the blur of a photo's edges.

    Args:
        linear: Display-linear photo, shape [H, W, 3].
        region: Where to look, shape [H, W]; everywhere where that has too few edges.

    Returns:
        The blur, or None where the photo has too few edges.
    """
    found = edge_statistics(linear, region)
    if found is None:
        return None
    statistics, edges = found
    low, high = np.array(RANGES)
    inside = np.clip(statistics, low, high)
    variance = math.exp(float(terms(inside) @ np.array(COEFFICIENTS))) - SOFTENED
    variance -= SHARP**2 * math.exp(-variance)
    return EdgeBlur(math.sqrt(max(variance, 0.0) + PIXEL_SIGMA**2), edges)


def terms(statistics: Float64Array) -> Float64Array:
    """Return the terms of the quadratic in `edge_statistics`, shapes [..., 5] and [..., 21]."""
    first, second = np.triu_indices(statistics.shape[-1])
    squares = statistics[..., first] * statistics[..., second]
    return np.concatenate([np.ones_like(statistics[..., :1]), statistics, squares], axis=-1)


def edge_statistics(
    linear: AnyFloatArray, region: BoolArray | None = None
) -> tuple[Float64Array, int] | None:
    """Measure how the energy of a photo's edges falls from scale to scale.

    A step behind a Gaussian of deviation s has, seen through a Gaussian derivative of deviation t,
    the largest slope ``A / sqrt(2 pi (s^2 + t^2))``; the ratio of two such slopes tells s without
    the height A (Zhuo and Sim 2011, "Defocus map estimation from a single image", equation 5, with
    both derivatives Gaussian). Here it is the ratio of their mean squares over all edges, less the
    noise's, which is far steadier than the ratio at any one edge. Edges of a scene are no ideal
    steps, and weak ones are softer by themselves, so several ratios and the strength of the edges
    are left to a regression. Edges are the ridges of the slope, in display values, that stand clear
    of the noise and of clipped highlights.

    Args:
        linear: Display-linear photo, shape [H, W, 3].
        region: Where to look, shape [H, W]; everywhere where that has too few edges.

    Returns:
        Logarithms of the mean squares over those of the next of `SCALES`, four, and of the root
        mean square at `RIDGES` [display values per px]; and the number of edge pixels. None where
        the photo has too few.
    """
    shown = np.asarray(linear_to_gamma(luminance(np.asarray(linear, np.float32))), np.float32)
    usable, even = _unclipped(linear)
    squares, ridge, noises = [], np.zeros_like(usable), []
    for k, scale in enumerate(SCALES):
        gx, gy = (ndimage.gaussian_filter(shown, scale, order=o) for o in ((0, 1), (1, 0)))
        squares.append(gx * gx + gy * gy)
        noises.append(_flattest(squares[k], even) + ROUNDING**2 / (4.0 * np.pi * scale**4))
        if k == RIDGES:
            ridge = _is_ridge(squares[k], gx, gy) & usable
    for over_noise in (CLEAR, FAINT):
        edge = ridge & (squares[RIDGES] > over_noise**2 * noises[RIDGES])
        if region is not None and int((edge & region).sum()) >= AROUND:
            edge &= region
        count = int(edge.sum())
        if count < LEAST_EDGES:
            continue
        energy = [
            max(float(s[edge].mean(dtype=np.float64)) - n, 1e-12)
            for s, n in zip(squares, noises, strict=True)
        ]
        if energy[RIDGES] >= LEAST_SLOPE**2:
            logs = np.log(energy)
            return np.append(-np.diff(logs), 0.5 * logs[RIDGES]), count
    return None


def _unclipped(linear: AnyFloatArray) -> tuple[BoolArray, BoolArray]:
    """Return the pixels away from the border and from clipped highlights, shape [H, W].

    The second array leaves out blacks too, where noise is cut off.
    """
    brightest = linear.max(axis=-1)
    limit = min(WHITE**GAMMA, CLIPPED**GAMMA * float(np.quantile(brightest, 0.999)))
    usable = np.zeros(brightest.shape, bool)
    usable[6:-6, 6:-6] = True
    usable &= ~ndimage.binary_dilation(brightest > limit, iterations=4)
    return usable, usable & (brightest > BLACK**GAMMA)


def _flattest(squares: FloatArray, usable: BoolArray) -> float:
    """Return the mean square of the noise's slope, from blocks with the least of it.

    Args:
        squares: Squared slope, shape [H, W].
        usable: Which pixels count, shape [H, W].
    """

    def means(plane: FloatArray | BoolArray) -> Float64Array:
        rows, columns = (side // BLOCK for side in plane.shape)
        blocks = plane[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
        return np.asarray(blocks.mean(axis=(1, 3)), np.float64)

    whole = means(usable) > 0.99
    values = means(squares)[whole]
    return float(np.quantile(values, FLAT)) if len(values) >= 8 else 0.0


def _is_ridge(slope: FloatArray, gx: FloatArray, gy: FloatArray) -> BoolArray:
    """Return where a slope is the largest across its edge, shape [H, W]."""
    across = np.abs(gx) >= np.abs(gy)
    left, right = np.roll(slope, 1, axis=1), np.roll(slope, -1, axis=1)
    above, below = np.roll(slope, 1, axis=0), np.roll(slope, -1, axis=0)
    first = np.where(across, left, above)
    second = np.where(across, right, below)
    ridge: BoolArray = (slope >= first) & (slope > second)
    return ridge


def blurred_layers(
    planes: dict[str, FloatArray], sigma: float, summed: tuple[str, ...]
) -> dict[str, FloatArray]:
    """Blur the object, its matte and its shadow by the lens.

    Premultiplied colours and the matte are blurred alike, so the outline keeps its colour. The
    shadow ratio is averaged over the ground that is seen, so what lies below the object's edge has
    the ratio beside it, and no light leaks in at the contact.

    Args:
        planes: ``matte`` [H, W], ``shadow_ratio`` [H, W, 3] and the planes of ``summed``.
        sigma: Standard deviation [px].
        summed: Names of premultiplied planes, [H, W, 3].

    Returns:
        All planes; pixels without any share of the object or its shadow keep their values.
    """
    if sigma <= 0.0:
        return planes
    shown = (planes["matte"] > 0.0) | (planes["shadow_ratio"] != 1.0).any(axis=-1)
    if not shown.any():
        return planes
    reach = math.ceil(TRUNCATE * sigma) + 1
    box = tuple(
        # Twice as far as the blur reaches, so that its own border has nothing to mirror.
        slice(max(0, int(where.min()) - 2 * reach), int(where.max()) + 2 * reach + 1)
        for where in np.nonzero(shown)
    )
    names = (*summed, "matte", "shadow_ratio")
    part = _blurred({name: planes[name][box] for name in names}, sigma)
    result = planes | {name: planes[name].copy() for name in names}
    for name in names:
        result[name][box] = part[name]
    return result


def _blurred(planes: dict[str, FloatArray], sigma: float) -> dict[str, FloatArray]:
    """Blur every plane, shape [H, W] or [H, W, 3]; ``shadow_ratio`` as `blurred_layers` says."""

    def blur(plane: FloatArray) -> FloatArray:
        widths = (sigma, sigma, 0.0)[: plane.ndim]
        return np.asarray(ndimage.gaussian_filter(plane, widths, truncate=TRUNCATE), np.float32)

    result = {name: blur(plane) for name, plane in planes.items() if name != "shadow_ratio"}
    seen = 1.0 - planes["matte"]
    weight = blur(seen)[..., None]
    # In differences from 1, so that ground beyond the shadow stays exactly 1.
    change = blur((planes["shadow_ratio"] - 1.0) * seen[..., None])
    ratio = 1.0 + change / np.maximum(weight, 1e-6)
    inside = weight[..., 0] < 1e-3
    ratio[inside] = planes["shadow_ratio"][inside]
    result["shadow_ratio"] = np.maximum(ratio, 0.0).astype(np.float32)
    return result
