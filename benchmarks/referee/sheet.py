"""Statistics of two noisy renders of one scene, and a picture of both."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.referee.ours import Runs
from benchmarks.referee.subjects import from_above
from benchmarks.scenes import write_picture
from warpir.core.arrays import BoolArray, Float64Array, FloatArray
from warpir.scene.camera import Camera

FLOOR = 1e-3
"""Error that is granted to runs, over the root mean square of a picture [1]."""
BLOCK = 8
"""Side of the blocks of pixels that are compared as one [px]."""
CaseT = TypeVar("CaseT")
Pair = tuple[Runs, Runs]
"""Our picture and theirs."""


def compare_images(candidate: Any, reference: Any) -> dict[str, float | int]:
    """Test whether two unbiased estimates share one mean.

    Single pixels show a local fault, blocks of pixels a small bias that noise hides in one.
    Two estimates of one integral give ``z_std`` near 1, ``z_mean`` near 0 and
    ``beyond_3`` near 0.0027 (more where the samples' tails are heavy). Both hold mean, variance of
    the mean and coverage, as `warpir.mitsuba.render.Foreground`, of independent samples.

    Returns:
        Statistics of the z scores per pixel and channel (``z_*``, ``beyond_3``) and per block
        (``block_*``), relative RMSE, relative bias and its standard error, pixels whose
        variance is 0 on both sides but whose means differ, largest difference in coverage.
    """
    difference = candidate.mean - reference.mean
    variance = candidate.variance + reference.variance
    noisy = variance > 0.0
    z = difference[noisy] / np.sqrt(variance[noisy])
    total, total_variance = block_sums(difference), block_sums(variance)
    used = total_variance > 0.0
    block_z = total[used] / np.sqrt(total_variance[used])
    power = reference.mean.sum()
    scale = np.abs(reference.mean).max()
    silent = ~noisy & (np.abs(difference) > 1e-5 * scale)
    return {
        "z_count": int(z.size),
        "z_mean": float(z.mean()),
        "z_std": float(z.std()),
        "z_max": float(np.abs(z).max()),
        "beyond_3": float((np.abs(z) > 3.0).mean()),
        "block_z_mean": float(block_z.mean()),
        "block_z_std": float(block_z.std()),
        "block_z_max": float(np.abs(block_z).max()),
        "block_count": int(block_z.size),
        "relative_rmse": float(
            np.sqrt(np.square(difference).mean() / np.square(reference.mean).mean())
        ),
        "expected_rmse": float(np.sqrt(variance.mean() / np.square(reference.mean).mean())),
        "relative_bias": float(difference.sum() / power),
        # One sample's channels vary together: their errors add, not their variances
        "relative_bias_error": float(np.sqrt(variance.sum(axis=(0, 1))).sum() / power),
        "display_rmse": display_rmse(candidate.mean, reference.mean),
        "silent_differences": int(silent.sum()),
        "coverage_difference": float(np.abs(candidate.coverage - reference.coverage).max()),
    }


def compare_runs(a: Runs, b: Runs, counts: BoolArray) -> dict[str, float]:
    """Return z scores of pixels and of blocks, over pixels that count."""
    # Where hardly a path brings light, the spread of samples says nothing of their error.
    floor = FLOOR * np.sqrt(np.square(b.mean[counts & (b.mean != 0.0)]).mean())
    variance = a.variance + b.variance + floor**2
    seen = counts & ((a.mean != 0.0) | (b.mean != 0.0))
    z = (a.mean - b.mean)[seen] / np.sqrt(variance[seen])
    off, spread = (block_sums(np.where(seen, plane, 0.0)) for plane in (a.mean - b.mean, variance))
    of_blocks = off[spread > 0.0] / np.sqrt(spread[spread > 0.0])
    level = np.sqrt(np.square(b.mean[seen]).mean())
    difference = (a.mean - b.mean)[seen]
    return {
        "pixels": int(seen.any(axis=-1).sum()),
        "z_mean": float(z.mean()),
        "z_std": float(z.std()),
        "beyond_3": float((np.abs(z) > 3.0).mean()),
        "block_z_std": float(of_blocks.std()),
        "block_z_max": float(np.abs(of_blocks).max()),
        "relative_rmse": float(np.sqrt(np.square(difference).mean()) / level),
        "expected_rmse": float(np.sqrt(variance[seen].mean()) / level),
        "relative_bias": float(difference.sum() / np.abs(b.mean[seen]).sum()),
        "relative_bias_error": float(np.sqrt(variance[seen].sum()) / np.abs(b.mean[seen]).sum()),
    }


def compare_cases(
    about: str, known: dict[str, CaseT], render: Callable[[CaseT, Camera, FloatArray, int], Pair]
) -> None:
    """Print one line of JSON a comparison; ``render`` returns our picture of a case and theirs."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--spp", type=int, default=4096)
    parser.add_argument("--cases", nargs="*", default=list(known))
    options = parser.parse_args()
    view = from_above(64, 64, 1.6)
    # Every direction differs, and none is so bright that noise would hide an error.
    texels = (2.0 * np.random.default_rng(5).random((16, 32, 3)) ** 3).astype(np.float32)
    everywhere = np.ones((view.height, view.width, 3), bool)
    for name in options.cases:
        line = {"case": name, "spp": options.spp}
        found, true = render(known[name], view, texels, options.spp)
        print(json.dumps(line | compare_runs(found, true, everywhere)), flush=True)


def display_rmse(candidate: Float64Array, reference: Float64Array) -> float:
    """RMSE of display values over the reference's own RMS [1]: what a viewer sees of fireflies.

    Both images are divided by the reference's mean over lit pixels, then Reinhard and gamma 2.2.
    """
    lit = reference.sum(axis=-1) > 0.0
    level = float(reference[lit].mean()) if lit.any() else 1.0

    def shown(image: Float64Array) -> Float64Array:
        x = np.maximum(image, 0.0) / level
        values: Float64Array = (x / (1.0 + x)) ** (1.0 / 2.2)
        return values

    a, b = shown(candidate), shown(reference)
    return float(np.sqrt(np.square(a - b).mean() / np.square(b).mean()))


def write_sheet(path: Path, candidate: Any, reference: Any) -> None:
    """Write candidate, reference and difference side by side.

    The first two share one exposure and Reinhard's curve; the difference is signed, grey for
    none, black and white at 10 % of the reference's 95th percentile.
    """
    covered = reference.mean[reference.coverage > 0.5]
    white = float(np.percentile(covered, 95.0)) if covered.size else 1.0
    white = white or 1.0
    panels = [_display(image.mean / white) for image in (candidate, reference)]
    panels.append(0.5 + 5.0 * (candidate.mean - reference.mean) / white)
    sheet = np.concatenate(panels, axis=1)
    write_picture(path, sheet.repeat(3, axis=0).repeat(3, axis=1))


def _display(radiance: Float64Array) -> Float64Array:
    """Display values of radiance whose 1 is bright: extended Reinhard, white at 4, gamma 2.2."""
    x = np.maximum(radiance, 0.0)
    return np.clip(x * (1.0 + x / 16.0) / (1.0 + x) * 1.5, 0.0, 1.0) ** (1.0 / 2.2)


def block_sums(image: Float64Array) -> Float64Array:
    """Sums over whole blocks, shape [blocks down, blocks across, 3]."""
    rows, columns = image.shape[0] // BLOCK, image.shape[1] // BLOCK
    cut = image[: rows * BLOCK, : columns * BLOCK]
    return cut.reshape(rows, BLOCK, columns, BLOCK, 3).sum(axis=(1, 3))
