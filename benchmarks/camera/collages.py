"""How many collages are recognised, and how many photos are taken for one?

    python -m benchmarks.camera.collages --panoramas DIR [--photos 8] [--seed 1]

Photographs are cut out of panoramas as `python -m warpir.evaluate --camera` cuts them: with cameras
drawn evenly, with those of the network's training, and level ones (no roll, half of them corrected
to upright), in which pillars and horizons run exactly along columns and rows. Collages are of two
to four of these: in a row, a column, a grid, or one beside two; half with a gutter, half of unequal
parts, most of them through JPEG and some resized. Places are halved by the checksum of their names:
constants were chosen on the first half.
"""

import io
import zlib
from collections import defaultdict
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from PIL import Image

from benchmarks.measure import flags
from benchmarks.scenes import panoramas_of
from warpir.calibration.not_pinhole import has_seam
from warpir.core.arrays import FloatArray
from warpir.core.color import codes_of
from warpir.core.errors import InputError
from warpir.evaluate.camera.measure import corrected_to_upright, even_cameras, photograph
from warpir.train.camera.crops import DrawnCameras, draw_cameras, read_panoramas
from warpir.train.lights import SKY_ONLY
from warpir.train.sampler import Sampler

WIDTH = 512
"""Longer side of the photographs [px]."""
LONGER, ASPECTS = (480, 1100), (2.0, 1.778, 1.5, 1.333, 1.0, 0.8, 0.75, 0.667, 0.5625)
"""Least and greatest longer side of a collage [px], and width over height."""
LAYOUTS = {
    "2 beside": (1, 1),
    "2 stacked": (2,),
    "3 beside": (1, 1, 1),
    "2 x 2": (2, 2),
    "1 beside 2": (1, 2),
}
"""Pictures of each column."""
COLLAGES = 80
"""Of each layout, with and without gutter, of each half of the places."""


def cameras(kind: str, draw: Sampler) -> DrawnCameras:
    """Return the camera of one photograph."""
    if kind == "trained":
        return draw_cameras(draw)
    drawn = even_cameras(draw)
    if kind == "even":
        return drawn
    if float(draw.unit()) < 0.5:
        return corrected_to_upright(drawn, draw)
    return replace(drawn, pitch=0.3 * drawn.pitch, roll=torch.zeros(1))


def parts(count: int, length: int, gutter: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """Return first and last of the pixels of some parts of a length, equal or not."""
    share = np.ones(count) if rng.random() < 0.5 else rng.uniform(0.5, 1.5, count)
    edges = np.round(np.cumsum([0.0, *share]) / share.sum() * (length + gutter)).astype(int)
    return [(int(a), int(b) - gutter) for a, b in pairwise(edges)]


def cells(
    layout: str, size: tuple[int, int], gutter: int, rng: np.random.Generator
) -> list[tuple[int, int, int, int]]:
    """Return left, top, right and bottom of the pictures of a collage [px]."""
    rows = LAYOUTS[layout]
    across = parts(len(rows), size[0], gutter, rng)
    return [
        (left, top, right, bottom)
        for (left, right), count in zip(across, rows, strict=True)
        for top, bottom in parts(count, size[1], gutter, rng)
    ]


def collage(
    photos: list[FloatArray], layout: str, has_gutter: bool, rng: np.random.Generator
) -> FloatArray:
    """Return a collage of some of the photos, each scaled and cut to fill its part."""
    aspect, longer = rng.choice(ASPECTS), int(rng.integers(*LONGER))
    size = (round(longer * min(aspect, 1.0)), round(longer / max(aspect, 1.0)))
    gutter = int(rng.integers(2, longer // 30)) if has_gutter else 0
    colour = ((255, 255, 255), (0, 0, 0), tuple(rng.integers(0, 256, 3).tolist()))
    sheet = Image.new("RGB", size, colour[int(rng.integers(3))])
    for left, top, right, bottom in cells(layout, size, gutter, rng):
        photo = photos[int(rng.integers(len(photos)))]
        picture = Image.fromarray(codes_of(photo))
        width, height = right - left, bottom - top
        factor = max(width / picture.width, height / picture.height) * rng.uniform(1.0, 1.3)
        shown = (width / factor, height / factor)
        x, y = (rng.uniform(0.0, a - b) for a, b in zip(picture.size, shown, strict=True))
        box = (x, y, x + shown[0], y + shown[1])
        sheet.paste(picture.resize((width, height), Image.Resampling.BICUBIC, box), (left, top))
    if rng.random() < 0.3:
        factor = rng.uniform(0.5, 1.0)
        sheet = sheet.resize((round(size[0] * factor), round(size[1] * factor)))
    if rng.random() < 0.7:
        stored = io.BytesIO()
        sheet.save(stored, "JPEG", quality=int(rng.integers(60, 96)))
        sheet = Image.open(stored)
    return np.asarray(sheet, np.float32) / np.float32(255.0)


def main() -> None:
    """Print a table."""
    parser = flags(__doc__, "panoramas")
    parser.add_argument("--photos", type=int, default=8, help="of each kind and place")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(1)
    found: dict[tuple[str, int], list[bool]] = defaultdict(list)
    photos: tuple[list[FloatArray], list[FloatArray]] = ([], [])
    files = panoramas_of(options)
    for path in [p for p in files if SKY_ONLY not in p.stem]:
        name = zlib.crc32(path.stem.encode())
        try:
            panorama, half = read_panoramas([path], "cpu"), name % 2
        except InputError as error:
            print(f"left out: {error.where}: {error.what}")
            continue
        generator = torch.Generator().manual_seed(options.seed + name)
        for kind in options.photos * ("even", "trained", "level"):
            camera = cameras(kind, Sampler(1, generator))
            photo = photograph(panorama, camera, WIDTH, generator)
            found[f"photos, {kind}", half].append(has_seam(photo))
            photos[half].append(photo)
    rng = np.random.default_rng(options.seed)
    for half, pool in enumerate(photos):
        for layout in LAYOUTS:
            for has_gutter in (False, True):
                kind = f"{layout}, {'gutter' if has_gutter else 'no gutter'}"
                pictures = (collage(pool, layout, has_gutter, rng) for _ in range(COLLAGES))
                found[kind, half] = [has_seam(picture) for picture in pictures]
                found["collages", half] += found[kind, half]
    for kind in dict.fromkeys(kind for kind, _ in found):
        cells_of = "  ".join(
            f"{100.0 * np.mean(found[kind, half]):5.1f} % of {len(found[kind, half]):4d}"
            for half in (0, 1)
        )
        print(f"{kind:24s} {cells_of}")


if __name__ == "__main__":
    main()
