"""Statistics of two noisy renders of one scene, and a picture of both."""

from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array


def compare_images(candidate: Any, reference: Any, block: int = 8) -> dict[str, float | int]:
    """Test whether two unbiased estimates share one mean.

    Single pixels show a local fault, blocks of pixels a small bias that noise hides in one.
    Two estimates of one integral give ``z_std`` near 1, ``z_mean`` near 0 and
    ``beyond_3`` near 0.0027 (more where the samples' tails are heavy).

    Args:
        candidate: Mean, variance of the mean and coverage, as `warpir.mitsuba.render.Foreground`.
        reference: The same from the other renderer, independent samples.
        block: Side of the blocks [px].

    Returns:
        Statistics of the z scores per pixel and channel (``z_*``, ``beyond_3``) and per block
        (``block_*``), relative RMSE, relative bias and its standard error, pixels whose
        variance is 0 on both sides but whose means differ, largest difference in coverage.
    """
    difference = candidate.mean - reference.mean
    variance = candidate.variance + reference.variance
    noisy = variance > 0.0
    z = difference[noisy] / np.sqrt(variance[noisy])
    total, total_variance = block_sums(difference, block), block_sums(variance, block)
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

    Args:
        path: PNG to write.
        candidate: Left third, as `compare_images` takes it.
        reference: Middle third.
    """
    from PIL import Image

    covered = reference.mean[reference.coverage > 0.5]
    white = float(np.percentile(covered, 95.0)) if covered.size else 1.0
    white = white or 1.0
    panels = [_display(image.mean / white) for image in (candidate, reference)]
    panels.append(np.clip(0.5 + 5.0 * (candidate.mean - reference.mean) / white, 0.0, 1.0))
    codes = np.round(255.0 * np.concatenate(panels, axis=1)).astype(np.uint8)
    enlarged = np.repeat(np.repeat(codes, 3, axis=0), 3, axis=1)
    Image.fromarray(enlarged).save(path)


def _display(radiance: Float64Array) -> Float64Array:
    """Display values of radiance whose 1 is bright: extended Reinhard, white at 4, gamma 2.2."""
    x = np.maximum(radiance, 0.0)
    return np.clip(x * (1.0 + x / 16.0) / (1.0 + x) * 1.5, 0.0, 1.0) ** (1.0 / 2.2)


def block_sums(image: Float64Array, block: int) -> Float64Array:
    """Sums over whole blocks, shape [blocks down, blocks across, 3]."""
    rows, columns = image.shape[0] // block, image.shape[1] // block
    cut = image[: rows * block, : columns * block]
    return cut.reshape(rows, block, columns, block, 3).sum(axis=(1, 3))
