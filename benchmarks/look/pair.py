"""Blacks and fine contrast of an object beside the photo's own around it, before and after.

    python -m benchmarks.look.pair OFF_DIR AUTO_DIR [--jpeg FILE]

Both folders are finished runs of one insertion, the first with ``--response off --sharpness off
--grain off``. Blacks are the 1st percentile of the luminance, fine contrast is the mean absolute
Laplacian, both in codes of 255; the photo's are those of the box three times the object's, without
the object and its shadow. The picture shows both runs side by side, cut to the object.
"""

import argparse
from pathlib import Path

import numpy as np
from scipy import ndimage

from warpir.core.arrays import BoolArray, FloatArray
from warpir.core.color import luminance
from warpir.core.limits import LIMITS
from warpir.io.images.photos import read_photo
from warpir.io.layers import read_layers
from warpir.look.camera_look import region_around

SHADED = 0.02
"""Darkening from which a pixel is the object's shadow [1]: two codes."""
HALF_WIDTH = 400
"""Width of each half of the picture [px]."""


def blacks_and_contrast(image: FloatArray, where: BoolArray) -> tuple[float, float]:
    """Return blacks and fine contrast of some pixels of a display-encoded picture."""
    level = 255.0 * luminance(image)
    inside = ndimage.binary_erosion(where, iterations=1)
    return float(np.quantile(level[where], 0.01)), float(
        np.abs(ndimage.laplace(level))[inside].mean()
    )


def main() -> None:
    """Print a line for the photo and for each run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("runs", type=Path, nargs=2)
    parser.add_argument("--jpeg", type=Path)
    options = parser.parse_args()
    layers = read_layers(options.runs[0] / "layers.exr", LIMITS.pixels)
    before, after = (read_photo(run / "composite.png").srgb for run in options.runs)
    matte, ratio = np.asarray(layers.matte), np.asarray(layers.shadow_ratio)
    height, width = matte.shape
    seen = np.argwhere(matte > 0.5)[:, ::-1].astype(np.float64)
    around = region_around(seen, height, width)
    shaded = (np.abs(ratio - 1.0) > SHADED).any(axis=-1)
    around &= ~ndimage.binary_dilation((matte > 0.0) | shaded, iterations=2)
    print("                      blacks  fine contrast")
    for name, image, where in (
        ("photo around it", before, around),
        ("object, all off", before, matte > 0.99),
        ("object, auto", after, matte > 0.99),
    ):
        print("{:20s}  {:6.1f}  {:6.1f}".format(name, *blacks_and_contrast(image, where)))
    if options.jpeg:
        write_pair(options.jpeg, before, after, seen)


def write_pair(path: Path, before: FloatArray, after: FloatArray, seen: FloatArray) -> None:
    """Save both pictures side by side, cut to the object with half of its size around it."""
    from PIL import Image

    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = 0.5 * (low + high), 0.75 * (high - low).max()
    half = min(half, *(0.5 * np.array(before.shape[1::-1])))
    limit = np.array(before.shape[1::-1]) - half
    x, y = np.clip(middle, half, limit)
    cut = np.s_[int(y - half) : int(y + half), int(x - half) : int(x + half)]
    halves = []
    for picture in (before, after):
        image = Image.fromarray(np.round(255.0 * picture[cut]).astype(np.uint8))
        if image.width > HALF_WIDTH:
            image = image.resize((HALF_WIDTH, HALF_WIDTH), Image.Resampling.LANCZOS)
        halves.append(np.asarray(image))
    Image.fromarray(np.concatenate(halves, axis=1)).save(path, quality=85)


if __name__ == "__main__":
    main()
