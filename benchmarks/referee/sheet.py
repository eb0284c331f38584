"""Statistics of two noisy renders of one scene, and a picture of both."""

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
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

    Both hold mean, variance of the mean and coverage, as `warpir.mitsuba.render.Foreground`, of
    independent samples.

    Returns:
        `z_scores`, relative RMSE, relative bias and its standard error, pixels whose variance is 0
        on both sides but whose means differ, largest difference in coverage.
    """
    difference = candidate.mean - reference.mean
    variance = candidate.variance + reference.variance
    power = reference.mean.sum()
    scale = np.abs(reference.mean).max()
    silent = (variance == 0.0) & (np.abs(difference) > 1e-5 * scale)
    return {
        **z_scores(difference, variance),
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
    """Return `z_scores`, relative RMSE and relative bias over pixels that count."""
    # Where hardly a path brings light, the spread of samples says nothing of their error.
    floor = FLOOR * np.sqrt(np.square(b.mean[counts & (b.mean != 0.0)]).mean())
    seen = counts & ((a.mean != 0.0) | (b.mean != 0.0))
    difference = np.where(seen, a.mean - b.mean, 0.0)
    variance = np.where(seen, a.variance + b.variance + floor**2, 0.0)
    energy, power = np.square(b.mean[seen]).sum(), np.abs(b.mean[seen]).sum()
    return {
        "pixels": int(seen.any(axis=-1).sum()),
        **z_scores(difference, variance),
        "relative_rmse": float(np.sqrt(np.square(difference).sum() / energy)),
        "expected_rmse": float(np.sqrt(variance.sum() / energy)),
        "relative_bias": float(difference.sum() / power),
        "relative_bias_error": float(np.sqrt(variance.sum()) / power),
    }


def z_scores(difference: Float64Array, variance: Float64Array) -> dict[str, float]:
    """Return statistics of the z scores of pixels and channels, and of blocks of pixels.

    Single pixels show a local fault, blocks of pixels a small bias that noise hides in one.
    Two estimates of one integral give ``z_std`` near 1, ``z_mean`` near 0 and
    ``beyond_3`` near 0.0027 (more where the samples' tails are heavy). What has no variance is not
    counted.
    """
    noisy = variance > 0.0
    z = difference[noisy] / np.sqrt(variance[noisy])
    total, total_variance = block_sums(difference), block_sums(variance)
    used = total_variance > 0.0
    block_z = total[used] / np.sqrt(total_variance[used])
    return {
        "z_mean": float(z.mean()),
        "z_std": float(z.std()),
        "beyond_3": float((np.abs(z) > 3.0).mean()),
        "block_z_std": float(block_z.std()),
        "block_z_max": float(np.abs(block_z).max()),
    }


def print_lines(
    about: str,
    known: dict[str, CaseT],
    compare: Callable[[CaseT, int], Iterable[dict[str, Any]]],
) -> None:
    """Print the comparisons of each case, at so many samples, as lines of JSON."""
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--spp", type=int, default=4096)
    parser.add_argument("--cases", nargs="*", default=list(known))
    options = parser.parse_args()
    for name in options.cases:
        for line in compare(known[name], options.spp):
            print(json.dumps({"case": name, "spp": options.spp} | line), flush=True)


def compare_cases(
    about: str, known: dict[str, CaseT], render: Callable[[CaseT, Camera, FloatArray, int], Pair]
) -> None:
    """Print a line a case; ``render`` returns our picture of it and theirs."""
    view = from_above(64, 64, 1.6)
    # Every direction differs, and none is so bright that noise would hide an error.
    texels = (2.0 * np.random.default_rng(5).random((16, 32, 3)) ** 3).astype(np.float32)
    everywhere = np.ones((view.height, view.width, 3), bool)

    def compare(case: CaseT, spp: int) -> Iterator[dict[str, Any]]:
        yield compare_runs(*render(case, view, texels, spp), everywhere)

    print_lines(about, known, compare)


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
