"""Is a picture nearer to the truth with Open Image Denoise than with more samples?

With ``by noise`` it has more samples where their noise would be seen, as an insertion without
``--samples`` has.

    python -m benchmarks.denoise --panoramas DIR --assets FILE ... --scenes 4

Crops of panoramas with an object under the crop's light, as in `benchmarks.look.composites`,
against a rendering of many samples. Errors are root mean squares of display values in codes of 255,
of the object's pixels and of those that its shadow changes; seconds are those of the whole picture,
so two rows of equal time can be compared.
"""

import json
import time
from itertools import product

import numpy as np

from benchmarks.measure import flags, rms, write_json
from benchmarks.scenes import panoramas_of, photo_of, places_of, renderer_of
from warpir.core.arrays import FloatArray
from warpir.evaluate.scenes import Subject
from warpir.render.composite import Picture, make_picture
from warpir.render.picture.quality import SEEN_NOISE, Quality
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves

SAMPLES = (4, 8, 16, 32, 64, 128)
CASES = (*product(SAMPLES, ("plain", "denoised")), (32, "by noise"))
"""Samples, and what is done about noise."""
FIGURES = ("seconds", "object", "shadow")


def measure(subject: Subject, reference: int) -> list[dict[str, float | str]]:
    """Return errors and seconds of all `CASES`."""
    renderer, photo = renderer_of(subject), photo_of(subject.place.photo)
    light, curves = Light(texels=subject.place.texels), Curves.identity("linear")

    def insert(samples: int, seed: int, way: str) -> Picture:
        noise = SEEN_NOISE if way == "by noise" else None
        quality = Quality(samples, 1, 5, seed, 8.0, way == "denoised", noise=noise)
        return make_picture(renderer, light, light, photo, quality, curves)

    truth = insert(reference, 1, "plain")
    inside = truth.layers.matte > 0.5
    shaded = (truth.layers.matte == 0.0) & (truth.layers.shadow_ratio.min(axis=-1) < 0.99)

    def error(picture: Picture, where: FloatArray) -> float:
        return 255.0 * rms((picture.image - truth.image)[where]) if where.any() else 0.0

    insert(SAMPLES[0], 3, "denoised")  # loads the network
    rows: list[dict[str, float | str]] = []
    for samples, way in CASES:
        start = time.perf_counter()
        picture = insert(samples, 2, way)
        seconds = time.perf_counter() - start
        row = {"scene": subject.name, "samples": samples, "way": way}
        errors = {"object": error(picture, inside), "shadow": error(picture, shaded)}
        rows.append({**row, "seconds": seconds, **errors})
    return rows


def main() -> None:
    """Print a table over all scenes."""
    parser = flags(__doc__, "panoramas", "objects", "json")
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--reference", type=int, default=4096, help="samples of the truth")
    parser.add_argument("--width", type=int, default=288, help="of the photographs [px]")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    places = places_of(options, panoramas_of(options), options.width)
    for _, subjects in places.make(options.scenes):
        for subject in subjects:
            rows += measure(subject, options.reference)
            print(json.dumps(rows[-2:]), flush=True)
    print("samples  way       seconds  object  shadow")
    for case in CASES:
        those = [r for r in rows if (r["samples"], r["way"]) == case]
        seconds, inside, shadow = (float(np.mean([r[k] for r in those])) for k in FIGURES)
        print(f"{case[0]:7d}  {case[1]:8s}  {seconds:7.2f}  {inside:6.2f}  {shadow:6.2f}")
    write_json(options.json, rows)


if __name__ == "__main__":
    main()
