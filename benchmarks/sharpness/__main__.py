"""How well does one photo tell its camera's blur?

    python -m benchmarks.sharpness --panoramas DIR [--fit]

Photographs are crops of panoramas through the cameras of `benchmarks.look`, with blurs of up to
3 px. A crop is soft by itself where its pixels are finer than the panorama's texels
(`benchmarks.look.softness`); what is to be found is both together. Places are halved as in
`benchmarks.response`; ``--fit`` prints the numbers of `warpir.look.sharpness` that one half gives,
and the other half is judged.
"""

import argparse
import itertools
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.look import draw_camera, softness
from benchmarks.response import is_for_fitting
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import GAMMA
from warpir.evaluate.scenes import (
    CAMERA_HEIGHT,
    PANORAMA_SUFFIXES,
    crop_camera,
    crop_radiance,
    expose,
    find_files,
)
from warpir.io.images.photos import read_envmap
from warpir.look.sharpness import (
    PIXEL_SIGMA,
    RIDGES,
    SCALES,
    SOFTENED,
    edge_statistics,
    estimate_blur,
    terms,
)

WIDTHS = (192, 320)
"""Of the crops [px]."""
CROPS, CAMERAS = 4, 4
"""Crops of a place for each width, and cameras of a crop."""
BLURS = ((0.0, 1.6), (0.0, 3.0))
"""Least and most deviation of the drawn blur, of every other camera [px]."""
RIDGE = 0.5
"""Weight of a coefficient's square, of standardised terms."""
STEPS, HEIGHTS = 25, (0.15, 0.5)
"""Number of blurs and heights of the ideal steps that are fitted too [display values]."""
TAIL = 0.01
"""Share of the fit's photos on each side of the range that an estimate is held to."""
BINS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.5)
"""Edges of the true blurs by which errors are told [px]."""


@dataclass(frozen=True)
class Measured:
    """One photo and what it tells."""

    place: str
    """Name of the panorama."""
    sigma: float
    """True deviation of the blur, the pixel left out [px]."""
    statistics: Float64Array | None
    """`edge_statistics`, shape [5]."""
    found: float
    """The estimate of `sigma` [px]; 0 where the photo tells none, for then nothing is blurred."""


def photos(path: Path) -> Iterator[tuple[FloatArray, float]]:
    """Yield photos of one place, display-linear [H, W, 3], and how they are blurred [px]."""
    texels = read_envmap(path)
    rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
    for width in WIDTHS * CROPS:
        fov, azimuth, pitch = rng.uniform((45, 0, -18), (85, 360, 8))
        camera = crop_camera(width, 2 * width // 3, fov, azimuth, pitch, CAMERA_HEIGHT)
        seen = crop_radiance(texels, camera)
        if not seen.any():
            continue
        shown = np.round(255.0 * expose(seen)[0]) / 255.0
        linear = (shown**GAMMA).astype(np.float32)
        own = float(softness(camera, texels.shape[1]).mean())
        for k in range(CAMERAS):
            shot = draw_camera(linear, rng, BLURS[k % 2])
            yield shot.shoot(linear) ** np.float32(GAMMA), float(np.hypot(shot.blur, own))


def measure(path: Path) -> list[Measured]:
    """Return what the photos of one place tell."""
    rows = []
    for linear, sigma in photos(path):
        edges, blur = edge_statistics(linear), estimate_blur(linear)
        found = 0.0 if blur is None else np.sqrt(max(blur.sigma**2 - PIXEL_SIGMA**2, 0.0))
        rows.append(Measured(path.stem, sigma, None if edges is None else edges[0], float(found)))
    return rows


def ideal_steps() -> tuple[Float64Array, Float64Array]:
    """Return the statistics of ideal steps, shape [N, 5], and how they are blurred [px].

    They keep the regression in place where photos are sharper or cleaner than the crops.
    """
    blurs = BLURS[-1][-1] * np.linspace(0.0, 1.0, STEPS) ** 2
    steps = [(s, h) for s in blurs for h in HEIGHTS]
    sigma, height = np.array(steps).T
    variance = (sigma**2 + PIXEL_SIGMA**2)[:, None] + np.array(SCALES) ** 2
    slope = np.log(height / np.sqrt(2.0 * np.pi * variance[:, RIDGES]))
    return np.column_stack([np.diff(np.log(variance), axis=1), slope]), sigma


def fit(rows: list[Measured]) -> None:
    """Print the numbers that `warpir.look.sharpness` has."""
    told = [(r.statistics, r.sigma) for r in rows if r.statistics is not None]
    values = np.array([v for v, _ in told])
    low, high = np.quantile(values, (TAIL, 1.0 - TAIL), axis=0)
    steps, sigmas = ideal_steps()
    low = np.minimum(low, steps.min(axis=0)).round(3)
    high = np.maximum(high, steps.max(axis=0)).round(3)
    values = np.concatenate([values, steps])
    design = terms(np.clip(values, low, high))[:, 1:]
    target = np.log(np.append([s for _, s in told], sigmas) ** 2 + SOFTENED)
    mean, spread = design.mean(axis=0), design.std(axis=0)
    scaled = (design - mean) / spread
    gram = scaled.T @ scaled + RIDGE * np.eye(scaled.shape[1])
    factors = np.linalg.solve(gram, scaled.T @ (target - target.mean())) / spread
    numbers = [target.mean() - mean @ factors, *factors]
    print("COEFFICIENTS =", tuple(round(float(x), 4) for x in numbers))
    print("RANGES =", (tuple(low.tolist()), tuple(high.tolist())))


def main() -> None:
    """Print the fit and a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panoramas", type=Path, nargs="+", required=True)
    parser.add_argument("--fit", action="store_true", help="print new numbers")
    options = parser.parse_args()
    rows = []
    for path in find_files(options.panoramas, PANORAMA_SUFFIXES, "--panoramas"):
        if options.fit or not is_for_fitting(path.stem):
            rows += measure(path)
    if options.fit:
        fit([r for r in rows if is_for_fitting(r.place)])
    judged = [r for r in rows if not is_for_fitting(r.place)]
    true, found = (np.array([getattr(r, name) for r in judged]) for name in ("sigma", "found"))
    told = np.array([r.statistics is not None for r in judged])
    print(f"{len(judged)} photos of places not fitted, {told.mean():.0%} of them with edges")
    print("true blur    photos  told  bias  mean error  10 % to 90 % of the estimates")
    for low, high in [*itertools.pairwise(BINS), (BINS[0], BINS[-1])]:
        inside = (true >= low) & (true < high)
        sure = inside & told
        error = found[sure] - true[sure]
        spread = np.quantile(found[sure], (0.1, 0.9))
        print(
            f"{low:.1f} to {high:.1f}  {inside.sum():6d}  {sure.sum() / inside.sum():.2f}  "
            f"{error.mean():+.2f}  {np.abs(error).mean():.2f}        "
            f"{spread[0]:.2f} to {spread[1]:.2f}"
        )
    print(f"mean error of all, those without edges at 0: {np.abs(found - true).mean():.3f}")


if __name__ == "__main__":
    main()
