"""The blur of a photo's lens, by which an object is as sharp as what stands around it."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.special import ive

from warpir.core.arrays import AnyFloatArray, BoolArray, FloatArray, mask_box, on_cores
from warpir.core.color import luminance
from warpir.core.memory import core_count
from warpir.look.texture import CLIPPED, SMALLEST, Texture, read_texture

FINE, COARSE, WIDE = 1.0, 2.0, 3.0
"""Standard deviations of the Gaussian derivatives [px]; the ratio of the first two tells the blur,
the third tells steps from lines and from crowded edges."""
CLEAR, FAINT = (10.0, 0.06, 60), (6.0, 0.15, 20)
"""Least slope over the noise's, how far the third slope may be from that of a step [1], and steps
below which they tell no blur: of clear edges, and of the fainter ones that count where these
are too few."""
AROUND = 100
"""Clear steps below which a part of a photo tells none, and the whole photo is asked."""
LENS = 0.4
"""Quantile of the blurs of all steps that counts as the lens's: many edges of a scene are soft."""
LOW, HIGH, SPREAD = 0.15, 0.6, 0.33
"""Quantiles whose distance tells how far the steps agree, and the distance at which they tell half
of the blur, the texture the other half [px]."""
WEAK = 0.2
"""Median contrast of the steps at which their spread counts twice [1]: clouds, haze and shadows are
weak, and soft by themselves."""
MOST_BY_TEXTURE = 1.0
"""Blur that is believed of a photo without steps [px]: that of a clear sky or a bare wall is read
too large."""
LEAST_CONTRAST = 0.03
"""Luminance step over the photo's 99th percentile from which an edge counts [1]."""
SOFT, BROAD, WIDER = 1.2, 2.5, 1.25
"""Blur from which on the photo is asked at half its size too [px], the least that is believed of
that [px], and by which factor it must be the larger one [1]: what the widest derivative hardly sees
reads too low, a blur of 6 px as 1.6."""
PIXEL_SIGMA = 12.0**-0.5
"""Standard deviation of a square pixel, the blur that a rendered edge has already [px]."""
GROUND = {"shadow_ratio": 1.0, "image": 0.0, "hidden": 0.0, "kept": 0.0}
"""Planes of the ground that is seen, and what they hold where the object hides all of it."""
TRUNCATE = 3.5
"""Standard deviations at which a Gaussian that blurs a picture is cut."""


@dataclass(frozen=True)
class EdgeBlur:
    """How blurred a picture is."""

    sigma: float
    """Standard deviation of the Gaussian that blurred an ideal step, the pixel included [px]."""
    edges: int
    """Edge pixels it was estimated from."""


def estimate_blur(
    linear: AnyFloatArray,
    region: BoolArray | None = None,
    texture: Callable[[], Texture] | None = None,
) -> EdgeBlur | None:
    """Estimate the blur of the lens, by edges and, where they do not agree or are few, by texture.

    A step of height A behind a Gaussian of deviation s has, seen through a Gaussian derivative of
    deviation t, the largest slope ``A / sqrt(2 pi (s^2 + t^2))``; the ratio R of two such slopes
    gives ``s^2 = (t2^2 - R^2 t1^2) / (R^2 - 1)`` without A (Zhuo and Sim 2011, "Defocus map
    estimation from a single image", equation 5, with both derivatives Gaussian). Edges are the
    ridges of the slope that stand clear of noise and of clipped highlights.

    Args:
        linear: Display-linear photo, shape [H, W, 3].
        region: Where to look, shape [H, W]; everywhere where that has too few edges.
        texture: Gives what is read of the texture there, if that is known.

    Returns:
        The blur, or None where the photo has no texture either, or is smaller than `SMALLEST`.
    """
    found = _by_steps(linear, region, texture)
    if found is None and min(linear.shape[:2]) >= SMALLEST and np.ptp(linear) > 0.0:
        told = min((texture() if texture else read_texture(linear, region)).blur, MOST_BY_TEXTURE)
        return EdgeBlur(math.hypot(told, PIXEL_SIGMA), 0)
    return found


def _by_steps(
    linear: AnyFloatArray, region: BoolArray | None, texture: Callable[[], Texture] | None
) -> EdgeBlur | None:
    """Return the blur where there are steps, of a very soft photo that at half its size."""
    found = _blur_at_size(linear, region, texture)
    if found is None or found.sigma < SOFT or min(linear.shape[:2]) < 4 * SMALLEST:
        return found
    height, width = (side // 2 * 2 for side in linear.shape[:2])
    tiles = linear[:height, :width].reshape(height // 2, 2, width // 2, 2, 3)
    seen = None if region is None else region[1::2, 1::2]
    half = _by_steps(tiles.mean(axis=(1, 3)), seen, None)
    # Its pixel is as wide as two.
    sigma = 0.0 if half is None else math.sqrt(4.0 * half.sigma**2 - 3.0 * PIXEL_SIGMA**2)
    if half is None or sigma < max(BROAD, WIDER * found.sigma):
        return found
    return EdgeBlur(sigma, half.edges)


def _blur_at_size(
    linear: AnyFloatArray, region: BoolArray | None, texture: Callable[[], Texture] | None
) -> EdgeBlur | None:
    """Return the blur of `estimate_blur` by the photo's own pixels."""
    lum = luminance(np.asarray(linear, np.float32))
    with ThreadPoolExecutor(core_count()) as pool:
        (fine, gx, gy), (coarse, *_), (wide, *_), mean = (
            future.result()
            for future in [
                *(pool.submit(_slope, lum, deviation) for deviation in (FINE, COARSE, WIDE)),
                pool.submit(ndimage.gaussian_filter, lum, WIDE),
            ]
        )
    clipped = ndimage.binary_dilation(linear.max(axis=-1) > CLIPPED, iterations=4)
    white = max(float(np.quantile(lum, 0.99)), 1e-6)
    noise = 1.4826 * float(np.median(np.abs(fine - np.median(fine))))
    # A step of contrast c has at least this slope for all blurs up to 3 px.
    least = LEAST_CONTRAST * white / np.sqrt(2.0 * np.pi * (9.0 + FINE**2))
    ridge = _is_ridge(fine, gx, gy) & ~clipped
    border = np.zeros_like(ridge)
    border[6:-6, 6:-6] = True
    everywhere = ridge & border
    asked = [(everywhere, CLEAR), (everywhere, FAINT)]
    if region is not None:
        asked.insert(0, (everywhere & region, (*CLEAR[:2], AROUND)))
    for where, (over_noise, step_error, count) in asked:
        edge = where & (fine > max(least, over_noise * noise))
        sigmas, is_step = _step_blurs(fine[edge], coarse[edge], wide[edge], step_error)
        if int(is_step.sum()) >= count:
            heights = fine[edge] * np.sqrt(2.0 * np.pi * (sigmas**2 + FINE**2))
            contrast = heights / np.maximum(mean[edge], 1e-3)
            around = None if where is everywhere else region
            told = texture() if texture and around is region else read_texture(linear, around)
            soft = float(np.hypot(told.blur, PIXEL_SIGMA))
            sigma = _of_lens(sigmas[is_step], float(np.median(contrast[is_step])), soft)
            return EdgeBlur(sigma, int(is_step.sum()))
    return None


def _slope(lum: FloatArray, deviation: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the slope through Gaussian derivatives, and its parts along x and y."""
    gy, gx = (ndimage.gaussian_filter(lum, deviation, order=order) for order in ((1, 0), (0, 1)))
    return np.hypot(gx, gy), gx, gy


def _of_lens(sigmas: FloatArray, contrast: float, texture: float) -> float:
    """Return the blur of the lens, by the steps that it blurred [px].

    Steps that differ, or are weak, are soft by themselves; the more so, the more the blur is that
    of the texture.

    Args:
        sigmas: Blurs of the steps [px], shape [N].
        contrast: Median height of a step over the mean value around it [1].
        texture: Blur by the texture, the pixel included [px].
    """
    low, middle, high = np.quantile(sigmas, (LOW, LENS, HIGH))
    doubt = (high - low) / SPREAD * (1.0 + WEAK / contrast)
    return max(float(texture + (middle - texture) / (1.0 + doubt**6)), PIXEL_SIGMA)


def _step_blurs(
    fine: FloatArray, coarse: FloatArray, wide: FloatArray, step_error: float
) -> tuple[FloatArray, BoolArray]:
    """Return the blurs of edges [px], and which of them are steps, from their slopes [N]."""
    ratio = (fine / np.maximum(coarse, 1e-12)) ** 2
    limit = (COARSE / FINE) ** 2
    variance = (COARSE**2 - ratio * FINE**2) / np.maximum(ratio - 1.0, 1e-3)
    # Thin lines have larger ratios than any step, crowded edges smaller ones.
    plain = np.maximum(variance, 0.0)
    expected = fine * np.sqrt((plain + FINE**2) / (plain + WIDE**2))
    is_step = np.abs(wide / np.maximum(expected, 1e-12) - 1.0) < step_error
    is_step &= (ratio > 1.02) & (ratio < 1.05 * limit)
    return np.asarray(np.sqrt(plain)), is_step


def _is_ridge(slope: FloatArray, gx: FloatArray, gy: FloatArray) -> BoolArray:
    """Return where a slope is the largest across its edge, shape [H, W]."""
    across = np.abs(gx) >= np.abs(gy)
    left, right = np.roll(slope, 1, axis=1), np.roll(slope, -1, axis=1)
    above, below = np.roll(slope, 1, axis=0), np.roll(slope, -1, axis=0)
    first = np.where(across, left, above)
    second = np.where(across, right, below)
    ridge: BoolArray = (slope >= first) & (slope > second)
    return ridge


def gaussian(plane: FloatArray, sigma: float) -> FloatArray:
    """Return a plane behind a Gaussian, shape [H, W] or [H, W, 3].

    The kernel is the discrete analogue (Lindeberg 1990, "Scale-space for discrete signals"), whose
    variance is that of ``sigma`` [px] however small; samples of a Gaussian of .3 px blur by .09.
    """
    reach = math.ceil(TRUNCATE * sigma) + 1
    kernel = ive(np.abs(np.arange(-reach, reach + 1)), sigma**2)
    across = ndimage.correlate1d(plane, kernel / kernel.sum(), axis=1)
    return np.asarray(ndimage.correlate1d(across, kernel / kernel.sum(), axis=0), np.float32)


def shown_box(planes: dict[str, FloatArray], sigma: float) -> tuple[slice, slice]:
    """Return the rows and columns beyond which planes show nothing, even behind a Gaussian.

    Args:
        planes: ``shadow_ratio``, which is 1 where it shows nothing, and planes that are 0 there,
            shape [H, W] or [H, W, 3].
        sigma: Standard deviation [px].
    """
    shows = np.zeros(planes["matte"].shape, np.bool_)
    for name, plane in planes.items():
        here = plane != (1.0 if name == "shadow_ratio" else 0.0)
        shows |= here.any(axis=-1) if here.ndim == 3 else here
    # Twice as far as the blur reaches, so that its own border has nothing to mirror.
    return mask_box(shows, 2 * (math.ceil(TRUNCATE * sigma) + 1))


def blurred_layers(
    planes: dict[str, FloatArray], sigma: float, summed: tuple[str, ...]
) -> dict[str, FloatArray]:
    """Blur the object, its matte, its shadow and its mirror image by the lens.

    Premultiplied colours and the matte are blurred alike, so the outline keeps its colour. What
    `GROUND` names is averaged over the ground that is seen, so what lies below the object's edge
    has the ratio beside it, and no light leaks in at the contact.

    Args:
        planes: ``matte`` [H, W], the planes of ``summed`` and any of `GROUND` [H, W, 3].
        sigma: Standard deviation [px].
        summed: Names of premultiplied planes, [H, W, 3].

    Returns:
        All planes; pixels without any share of the object or its shadow keep their values.
    """
    if sigma <= 0.0 or planes["matte"].size == 0:
        return planes
    seen = 1.0 - planes["matte"]
    ground = {name: outside for name, outside in GROUND.items() if name in planes}
    # In differences, so that ground beyond the shadow stays exactly 1.
    changes = [(planes[name] - outside) * seen[..., None] for name, outside in ground.items()]
    names = (*summed, "matte")
    clear = [*(planes[name] for name in names), seen, *changes]
    blurred = on_cores(lambda plane: gaussian(plane, sigma), clear)
    result = dict(zip(names, blurred[: len(names)], strict=True))
    weight, *changes = blurred[len(names) :]
    inside = weight < 1e-3
    for (name, outside), change in zip(ground.items(), changes, strict=True):
        mean = outside + change / np.maximum(weight[..., None], 1e-6)
        mean[inside] = planes[name][inside]
        result[name] = np.maximum(mean, 0.0).astype(np.float32)
    return planes | result
