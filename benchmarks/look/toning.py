"""Which photos are taken for toned black and white ones: crops of panoramas in colour, and toned.

    python -m benchmarks.look.toning --panoramas DIR [--crops 3] [--json FILE]

A crop is a photograph of 640 x 427 pixels with a code of noise, in a JPEG file.
Toned, it is led through a drawn curve for each channel: sepia, duotone, cast or split tones. Those
that show no detail or few tones are never taken for toned (`warpir.look.toning`).
"""

import numpy as np

from benchmarks.look.composites import jpeg_of
from benchmarks.measure import flags, write_json
from benchmarks.scenes import codes_of, panoramas_of
from warpir.core.arrays import AnyFloatArray, Float64Array
from warpir.core.color import GAMMA, expose, luminance
from warpir.evaluate.scenes import crop_camera, crop_radiance
from warpir.io.images.photos import Photo, read_envmap
from warpir.look.toning import toning_of

QUALITIES = (60, 75, 85, 92)


def toned(grey: AnyFloatArray, draw: np.random.Generator) -> Float64Array:
    """Return display values of a drawn toning, shape [..., 3]."""
    g = np.asarray(grey, np.float64)[..., None]
    kind = draw.integers(4)
    if kind == 0:  # sepia, cyanotype
        return np.asarray(g ** draw.uniform(0.8, 1.3, 3))
    if kind == 1:  # duotone
        dark, light = draw.uniform(0.0, 0.25, 3), draw.uniform(0.75, 1.0, 3)
        return np.asarray(dark + (light - dark) * g)
    if kind == 2:  # a scan with a cast
        return np.asarray(draw.uniform(0.0, 0.03, 3) + draw.uniform(0.94, 1.0, 3) * g)
    shadows, lights = draw.uniform(-0.36, 0.36, (2, 3))
    return np.asarray(g + shadows * (1.0 - g) ** 2 * g + lights * (1.0 - g) * g**2)


def photo_of(shown: AnyFloatArray, quality: int) -> Photo:
    """Return display values as the photo in a JPEG file."""
    codes, _ = jpeg_of(codes_of(shown), quality)
    return Photo(codes, codes.astype(np.float32) / np.float32(255.0), "jpeg")


def main() -> None:
    """Measure, and print."""
    parser = flags(__doc__, "panoramas", "json")
    parser.add_argument("--crops", type=int, default=3, help="of each panorama")
    options = parser.parse_args()
    taken, found = [], {quality: [] for quality in QUALITIES}
    count = 0
    for k, path in enumerate(panoramas_of(options)):
        draw, texels = np.random.default_rng(k), read_envmap(path)
        for crop in range(options.crops):
            view = float(draw.uniform(0.0, 360.0)), float(draw.uniform(-25.0, 5.0))
            shown, _ = expose(crop_radiance(texels, crop_camera(640, 427, 65.0, *view, 1.6), 1))
            noise = draw.normal(0.0, 1.0 / 255.0, shown.shape)
            quality = QUALITIES[(k + crop) % len(QUALITIES)]
            count += 1
            if toning_of(photo_of(shown + noise, quality)) is not None:
                taken.append(f"{path.stem}, crop {crop}")
            grey = luminance(np.asarray(shown) ** GAMMA) ** (1.0 / GAMMA)
            made = photo_of(toned(grey, draw) + noise, quality)
            found[quality].append(toning_of(made) is not None)
    print(f"in colour: {len(taken)} of {count} crops are taken for toned {taken}")
    for quality, is_found in found.items():
        print(f"toned, JPEG of quality {quality}: {sum(is_found)} of {len(is_found)} are found")
    write_json(options.json, {"taken": taken, "found": found})


if __name__ == "__main__":
    main()
