"""Do more answers of the camera's network tell the field of view better than its histogram?

    python -m benchmarks.camera.witnesses --panoramas DIR [--scenes 200] [--seed 2]

Photographs are cut out of panoramas that the network has not learned from, as `python -m
warpir.evaluate --camera` cuts them. A part of a photo has the photo's focal length, and its
principal point elsewhere; the field of view of the whole is estimated from

* the histogram of the whole photo, as shipped;
* the mean of the histograms of the whole and of a centred part, or of four parts in the corners;
* the elevations above the horizon that the tokens answer (what training asks of them), to which a
  camera is fitted;
* the same, after the network was told the focal length of its own histogram;
* the mean of the histogram's and the two fitted ones.

Each is asked for the photo and for its mirror image. Median errors are printed over all photographs
and for each place.
"""

import argparse
import math
from collections import defaultdict
from itertools import count
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import least_squares
from torch import Tensor

from warpir.calibration.network import NUMBERS, Calibrator, load_calibrator, seen
from warpir.core.arrays import Float64Array
from warpir.evaluate.camera.measure import even_cameras, photograph, unlearned
from warpir.evaluate.scenes import PANORAMA_SUFFIXES, find_files
from warpir.train.camera.crops import DrawnCameras, read_panoramas
from warpir.train.lights import SKY_ONLY
from warpir.train.sampler import Sampler

WIDTH = 384
"""Longer side of the photographs [px]."""
CENTRE = ((0.075, 0.075, 0.85),)
"""Left, top and size of a part, as shares of the photo's width and height."""
CORNERS = tuple((x, y, 0.75) for x in (0.0, 0.25) for y in (0.0, 0.25))
WHOLE = (0.0, 0.0, 1.0)
ROBUST = 0.1
"""Error of an elevation from which it counts less [rad]."""


def ask(
    network: Calibrator, photo: Tensor, part: tuple[float, float, float], told: float = math.nan
) -> tuple[Tensor, Tensor]:
    """Ask for a part of a photo and its mirror image.

    Args:
        network: That answers.
        photo: Display-encoded, shape [1, 3, H, W].
        part: As `CENTRE`.
        told: Logarithm of the part's focal length over its height, or NaN.

    Returns:
        The mean histogram of that, shape [1, 65], and the mean elevations of the tokens [rad],
        shape [384].
    """
    rows, columns = photo.shape[2:]
    left, top, size = part
    first, last = round(top * rows), round((top + size) * rows)
    begin, end = round(left * columns), round((left + size) * columns)
    small = seen(photo[:, :, first:last, begin:end])
    aspect = torch.full((2,), (end - begin) / (last - first))
    with torch.no_grad():
        both = torch.cat([small, small.flip(-1)])
        logits, field = network(both, aspect, torch.full((2,), told))
    elevation = field[..., 2].unflatten(1, (16, 24))
    mean = 0.5 * (elevation[0] + elevation[1].flip(-1))
    return logits["focal"].softmax(1).mean(0, keepdim=True), mean.flatten()


def joined(parts: list[tuple[Tensor, float]]) -> float:
    """Return the median of the mean of histograms of parts, moved to the whole's focal length.

    Args:
        parts: Histogram, shape [1, 65], and size of each.
    """
    bins = NUMBERS["focal"]
    centres = bins.centres(parts[0][0]).numpy()
    # A part's focal length over its own height is longer than that over the whole's.
    moved = [
        np.interp(centres, centres + math.log(size), histogram[0].numpy(), left=0.0, right=0.0)
        for histogram, size in parts
    ]
    total = torch.from_numpy(np.mean(moved, axis=0)).float()[None]
    return float(bins.quantile(total / total.sum(), 0.5))


def fitted(elevation: Tensor, aspect: float, focal: float) -> float:
    """Return the logarithm of the focal length of the camera that fits elevations best.

    Args:
        elevation: Of the tokens of a whole photo [rad], shape [384].
        aspect: Width of the photo over its height.
        focal: Where the search begins.
    """
    seen_so = elevation.double().numpy()
    middle, none = torch.full((1,), 0.5), torch.zeros(1)

    def off(numbers: Float64Array) -> Float64Array:
        pitch, roll, log_focal = torch.from_numpy(numbers)[:, None]
        width = torch.tensor([aspect])
        camera = DrawnCameras(pitch, roll, log_focal.exp(), middle, middle, width, none)
        apart: Float64Array = camera.field()[0, :, 2].numpy() - seen_so
        return apart

    start = [float(elevation.mean()), 0.0, focal]
    found = least_squares(off, start, loss="soft_l1", f_scale=ROBUST, max_nfev=30)
    bins = NUMBERS["focal"]
    return float(np.clip(found.x[2], bins.low, bins.high))


def estimates(network: Calibrator, photo: Tensor) -> dict[str, float]:
    """Return the logarithm of the focal length over the height by each way, by its words."""
    aspect = photo.shape[3] / photo.shape[2]
    whole, elevation = ask(network, photo, WHOLE)
    histogram = joined([(whole, 1.0)])
    found = {"histogram (as shipped)": histogram}
    for words, parts in (("a centred part of .85", CENTRE), ("four corners of .75", CORNERS)):
        answers = [(ask(network, photo, part)[0], part[2]) for part in parts]
        found[f"with {words}"] = joined([(whole, 1.0), *answers])
    by_tokens = fitted(elevation, aspect, histogram)
    told = fitted(ask(network, photo, WHOLE, histogram)[1], aspect, by_tokens)
    found |= {"elevations of the tokens": by_tokens, "the same, told the histogram's": told}
    return found | {"mean of histogram and both": (histogram + by_tokens + told) / 3.0}


def degrees(log_focal: float) -> float:
    """Return the vertical field of view [deg]."""
    return math.degrees(2.0 * math.atan(0.5 * math.exp(-log_focal)))


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panoramas", type=Path, nargs="+", required=True)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--seed", type=int, default=2)
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = load_calibrator()
    files = find_files(options.panoramas, PANORAMA_SUFFIXES, "--panoramas")
    files, _ = unlearned([path for path in files if SKY_ONLY not in path.stem], network)
    generator = torch.Generator().manual_seed(options.seed)
    errors: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for path, first in zip(files, count(), strict=False):
        panorama = read_panoramas([path], "cpu")
        for _ in range(first, options.scenes, len(files)):
            camera = even_cameras(Sampler(1, generator))
            picture = photograph(panorama, camera, WIDTH, generator)
            true = degrees(float(camera.focal.log()))
            photo = torch.from_numpy(picture).permute(2, 0, 1)[None]
            for words, found in estimates(network, photo).items():
                errors[words][path.stem].append(abs(degrees(found) - true))
    print(f"{'median / mean error [deg]':32s} {'all':>13s}  " + "  ".join(p.stem for p in files))
    for words, places in errors.items():
        every = np.concatenate(list(places.values()))
        cells = "  ".join(f"{np.median(e):{len(p)}.2f}" for p, e in places.items())
        print(f"{words:32s} {np.median(every):5.2f} / {every.mean():5.2f}  {cells}")


if __name__ == "__main__":
    main()
