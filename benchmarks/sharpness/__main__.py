"""How well does one photo tell its camera's blur and grain?

    python -m benchmarks.sharpness --panoramas DIR [--photos DIR] [--fit]

Crops of panoramas pass through the cameras of `benchmarks.look.composites`, and edges are looked
for round where an object might stand. What is to be found is the camera's blur with the crop's own
(`benchmarks.look.composites.softness`). Places are halved as in `benchmarks.response`: the numbers
of `warpir.look.sharpness` were chosen by the one half, and both are judged. Photographs are made 3,
4 and 5 times smaller, hence sharp, and are then blurred by a known Gaussian. The grain is the
luminance's, in codes of 255 in the middle of the range. ``--fit`` trains the networks of
`warpir.look.texture` first (`benchmarks.sharpness.fit`).
"""

import itertools
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.look.composites import draw_camera, softness
from benchmarks.measure import flags, rms
from benchmarks.scenes import is_for_fitting, panoramas_of
from benchmarks.sharpness.fit import fit, shown_crop
from warpir.core.arrays import BoolArray, FloatArray
from warpir.core.color import gamma_to_linear, linear_to_gamma
from warpir.evaluate.scenes import (
    CAMERA_HEIGHT,
    FOOT_COLUMN,
    FOOT_ROW,
    HEIGHT_SHARE,
    PITCH,
    crop_camera,
    find_files,
)
from warpir.io.images.photos import read_envmap
from warpir.look.camera_look import region_around
from warpir.look.grain import Grain, estimate_grain
from warpir.look.sharpness import PIXEL_SIGMA, estimate_blur, gaussian
from warpir.look.texture import read_texture

WIDTHS, CROPS, CAMERAS = (192, 288), 4, 2
"""Of the crops [px]; crops of a place for each width, and cameras of a crop."""
SMALLER, BLURS, NOISES = (3, 4, 5), (0.0, 0.4, 0.7, 1.0, 1.3, 1.6), (1.0, 3.0)
"""Of the photographs: how much smaller they are made [1], where that leaves 200 px; blurs [px] and
noises [codes of 255]."""
BINS = (0.0, 0.5, 1.0, 1.5, 3.0)
"""Edges of the true blurs by which errors are told [px]."""
Sample = tuple[FloatArray, BoolArray | None, float, float]
"""Display-linear photo [H, W, 3], where to look [H, W], the true blur, the pixel left out [px], and
the true grain [1]."""


def crops(path: Path) -> Iterator[Sample]:
    """Yield photos of one place."""
    texels = read_envmap(path)
    rng = np.random.default_rng(zlib.crc32(path.stem.encode()))
    for width in WIDTHS * CROPS:
        height, pitch = 2 * width // 3, float(rng.uniform(*PITCH))
        fov, azimuth = rng.uniform((55, 0), (82, 360))
        camera = crop_camera(width, height, fov, azimuth, pitch, CAMERA_HEIGHT)
        linear = shown_crop(texels, camera)
        if linear is None:
            continue
        horizon = camera.cy + camera.fy * np.tan(np.radians(pitch))
        foot = horizon + rng.uniform(*FOOT_ROW) * (height - horizon)
        middle, size = rng.uniform(*FOOT_COLUMN) * width, rng.uniform(*HEIGHT_SHARE) * height
        box = np.array([[middle - 0.5 * size, foot - size], [middle + 0.5 * size, foot]])
        around = region_around(box, height, width)
        own = float(softness(camera, texels.shape[1])[around].mean())
        for _ in range(CAMERAS):
            shot = draw_camera(linear, rng)
            blur, grain = float(np.hypot(shot.blur, own)), shot.grain.of_luminance
            yield gamma_to_linear(shot.shoot(linear)), around, blur, grain


def photographs(path: Path) -> Iterator[Sample]:
    """Yield a photograph, smaller and blurred again."""
    with Image.open(path) as image:
        codes = np.asarray(image.convert("RGB"))
    for times in SMALLER:
        height, width = codes.shape[0] // times, codes.shape[1] // times
        if width < 200:
            continue
        whole = gamma_to_linear(codes[: height * times, : width * times] / np.float32(255.0))
        sharp = whole.reshape(height, times, width, times, 3).mean(axis=(1, 3))
        for blur, noise in itertools.product(BLURS, NOISES):
            shown = 255.0 * gaussian(sharp, blur) ** (1.0 / 2.2)
            shown += noise * np.random.default_rng(3).normal(size=shown.shape)
            photo = (np.clip(np.round(shown), 0.0, 255.0) / 255.0).astype(np.float32)
            grain = Grain((0.5,), ((noise / 255.0,) * 3,), 0.0, 0.0).of_luminance
            yield gamma_to_linear(photo), None, blur, grain


def judge(name: str, samples: Iterator[Sample]) -> None:
    """Print the errors of some photos that tell their blur, by true blur, and of their grain."""
    rows, grains = [], []
    for linear, region, blur, grain in samples:
        texture = read_texture(linear, region)
        found = estimate_blur(linear, region, lambda told=texture: told)
        own = np.nan if found is None else np.sqrt(found.sigma**2 - PIXEL_SIGMA**2 + 1e-12)
        rows.append((blur, own))
        flat = estimate_grain(linear_to_gamma(linear))
        grains.append((grain, texture.grain, 0.0 if flat is None else flat.of_luminance))
    true, estimate = np.array(rows).T
    told = np.isfinite(estimate)
    print(f"{name}: {len(rows)} photos, {told.mean():.0%} tell their blur")
    for low, high in [*itertools.pairwise(BINS), (BINS[0], BINS[-1])]:
        error = (estimate - true)[told & (true >= low) & (true < high)]
        print(
            f"  {low:.1f} to {high:.1f} px: {len(error):4d}  bias {error.mean():+.2f}  "
            f"mean error {np.abs(error).mean():.3f}  RMS {rms(error):.3f}"
        )
    grain, *guesses = 255.0 * np.array(grains).T
    guesses.append(np.median(grain))
    by_whom = zip(("texture", "flat patches", "one guess"), guesses, strict=True)
    errors = [f"{by} {np.abs(guess - grain).mean():.2f}" for by, guess in by_whom]
    print(f"  grain, mean error in codes: {', '.join(errors)}")


def main() -> None:
    """Print tables."""
    parser = flags(__doc__, "panoramas")
    parser.add_argument("--photos", type=Path, nargs="+")
    about = "train the networks of `warpir.look.texture` on the half that numbers are chosen by"
    parser.add_argument("--fit", action="store_true", help=about)
    options = parser.parse_args()
    places = panoramas_of(options)
    if options.fit:
        fit([p for p in places if is_for_fitting(p.stem)])
    for name, is_fitted in (("places chosen by", True), ("other places", False)):
        paths = [p for p in places if is_for_fitting(p.stem) == is_fitted]
        judge(name, itertools.chain.from_iterable(map(crops, paths)))
    if options.photos:
        files = find_files(options.photos, (".jpg", ".png"), "--photos")
        judge("photographs", itertools.chain.from_iterable(map(photographs, files)))


if __name__ == "__main__":
    main()
