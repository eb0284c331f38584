"""Errors of a composite against the true one: RMSE, si-RMSE, SSIM, FLIP and LPIPS, by region.

Pictures are display-encoded floats in [0, 1], shape [H, W, 3]. With a full picture most pixels are
the photograph itself and equal, so every figure is given for smaller regions too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, mask_box
from warpir.core.color import gamma_to_linear

SHADOW_RATIO = 0.95
"""Shadow ratio below which the ground counts as the object's shadow [1]."""
BOX_GROWTH = 0.5
"""Excess of the box over the object's width and height, half of it to each side [1]."""

Distance = Callable[[FloatArray, FloatArray], float]
"""Distance of two pictures of one size, such as LPIPS."""


def make_regions(mask: FloatArray, ratio: FloatArray) -> dict[str, BoolArray]:
    """Return the regions of separate figures by name, shape [H, W] each.

    ``full``; ``box``, the object's bounding box grown by `BOX_GROWTH`; ``asset``, where any of the
    object is seen; ``shadow``, beside it where the true shadow is darker than `SHADOW_RATIO`.

    Args:
        mask: The object's share of each pixel [1], shape [H, W].
        ratio: True shadow ratio [1], shape [H, W, 3].
    """
    asset = mask > 0.0
    box, edges = np.zeros_like(asset), []
    for side in mask_box(asset):
        grow = round(0.5 * BOX_GROWTH * (side.stop - side.start))
        edges.append(slice(max(side.start - grow, 0), side.stop + grow))
    box[tuple(edges)] = True
    shadow = (ratio.mean(axis=-1) < SHADOW_RATIO) & (mask == 0.0)
    return {"full": np.ones_like(asset), "box": box, "asset": asset, "shadow": shadow}


def image_errors(
    image: FloatArray,
    truth: FloatArray,
    regions: Mapping[str, BoolArray],
    lpips: Distance | None = None,
) -> dict[str, dict[str, float]]:
    """Return every error by region and name; an empty region has none.

    ``rmse``, ``linear_rmse`` (of values decoded by the power 2.2), ``si_rmse``, ``ssim`` and
    ``flip`` are means over the region's pixels, the latter two of maps made of the whole picture.
    ``lpips`` is of the full picture alone.
    """
    maps = {"ssim": ssim_map(image, truth)}
    if has_flip():
        maps["flip"] = flip_map(image, truth)
    errors: dict[str, dict[str, float]] = {}
    for name, region in regions.items():
        if not region.any():
            errors[name] = {}
            continue
        a, b = image[region].astype(np.float64), truth[region].astype(np.float64)
        linear = [gamma_to_linear(x).astype(np.float64) for x in (a, b)]
        errors[name] = {
            "rmse": rmse(a, b),
            "linear_rmse": rmse(*linear),
            "si_rmse": si_rmse(a, b),
            **{key: float(values[region].mean()) for key, values in maps.items()},
        }
    if lpips is not None:
        errors["full"]["lpips"] = lpips(image, truth)
    return errors


def rmse(a: Float64Array, b: Float64Array) -> float:
    """Return the root of the mean squared difference over pixels and channels."""
    return float(np.sqrt(np.square(a - b).mean()))


def si_rmse(a: Float64Array, b: Float64Array) -> float:
    """Return the RMSE of ``a`` times the factor that makes it least: ``<a, b> / <a, a>``."""
    power = float(np.square(a).sum())
    return rmse(a * (float((a * b).sum()) / power if power > 0.0 else 0.0), b)


def ssim_map(image: FloatArray, truth: FloatArray) -> Float64Array:
    """Return the structural similarity of each pixel, the mean of RGB, shape [H, W].

    Wang et al. 2004 with their window: 11 x 11, Gaussian of 1.5 pixels; data range 1.
    """
    from skimage.metrics import structural_similarity

    _, similarity = structural_similarity(  # type: ignore[no-untyped-call]
        truth.astype(np.float64),
        image.astype(np.float64),
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    return np.asarray(similarity.mean(axis=-1), np.float64)


def has_flip() -> bool:
    """Return whether FLIP is installed (``pip install 'warpir[bench]'``)."""
    from importlib.util import find_spec

    return find_spec("flip_evaluator") is not None


def flip_map(image: FloatArray, truth: FloatArray) -> Float64Array:
    """Return LDR-FLIP of each pixel at 67 pixels per degree, shape [H, W].

    Andersson et al. 2020, by the authors' package; display values count as sRGB.
    """
    from importlib import import_module

    pictures = (np.ascontiguousarray(x, np.float32) for x in (truth, image))
    error, _, _ = import_module("flip_evaluator").evaluate(*pictures, "LDR", True, False, False)
    return np.asarray(error, np.float64).reshape(image.shape[:2])
