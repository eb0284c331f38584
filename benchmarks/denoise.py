"""Is a picture nearer to the truth with Open Image Denoise than with more samples?

    python -m benchmarks.denoise --panoramas DIR --assets FILE ... --scenes 4

Crops of panoramas with an object under the crop's light, as in `benchmarks.look`, against a
rendering of many samples. Errors are root mean squares of display values in codes of 255, of the
object's pixels and of those that its shadow changes; seconds are those of the whole picture, so
two rows of equal time can be compared.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from benchmarks.look import photo_of
from warpir.core.arrays import FloatArray
from warpir.evaluate.scenes import Place, Places, Subject, find_files
from warpir.render.composite import Picture, make_picture
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.picture.planes import Quality
from warpir.render.renderer import Renderer
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves

SAMPLES = (4, 8, 16, 32, 64, 128)


def measure(place: Place, subject: Subject, reference: int) -> list[dict[str, float | str]]:
    """Return errors and seconds of every number of samples, with and without the denoiser."""
    ground = subject.placement.ground
    receiver = Receiver(ground[:3], -float(ground[3]))
    placed = Placed(subject.asset, subject.placement.asset_to_world)
    renderer = Renderer(Scene([placed], place.camera, receiver, "cpu"), 0)
    light, curves = Light(texels=place.texels), Curves.identity("linear")

    def insert(samples: int, seed: int, is_denoised: bool) -> Picture:
        quality = Quality(samples, 1, 5, seed, 8.0, is_denoised)
        return make_picture(
            renderer, light, light, photo_of(place.photo), quality,
            curves.foreground, curves.shadow_ratio, is_reinhard=False,
        )  # fmt: skip

    truth = insert(reference, 1, is_denoised=False)
    inside = truth.layers.matte > 0.5
    shaded = (truth.layers.matte == 0.0) & (truth.layers.shadow_ratio.min(axis=-1) < 0.99)

    def error(picture: Picture, where: FloatArray) -> float:
        difference = 255.0 * (picture.image - truth.image)[where]
        return float(np.sqrt((difference**2).mean())) if where.any() else 0.0

    insert(SAMPLES[0], 3, is_denoised=True)  # loads the network
    rows: list[dict[str, float | str]] = []
    for samples in SAMPLES:
        for is_denoised in (False, True):
            start = time.perf_counter()
            picture = insert(samples, 2, is_denoised)
            seconds = time.perf_counter() - start
            rows.append(
                {
                    "scene": subject.name,
                    "samples": samples,
                    "denoised": is_denoised,
                    "seconds": seconds,
                    "object": error(picture, inside),
                    "shadow": error(picture, shaded),
                }
            )
    return rows


def main() -> None:
    """Print a table over all scenes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panoramas", type=Path, nargs="+", required=True)
    parser.add_argument("--assets", type=Path, nargs="+", required=True)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--reference", type=int, default=4096, help="samples of the truth")
    parser.add_argument("--width", type=int, default=288, help="of the photographs [px]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    places = Places(
        find_files(options.panoramas, (".hdr", ".exr"), "--panoramas"),
        find_files(options.assets, (".glb", ".gltf", ".obj"), "--assets"),
        options.seed,
        options.width,
    )
    rows = []
    for place, subjects in places.make(options.scenes):
        for subject in subjects:
            rows += measure(place, subject, options.reference)
            print(json.dumps(rows[-2:]), flush=True)
    print("samples  denoised  seconds  object  shadow")
    for samples in SAMPLES:
        for is_denoised in (False, True):
            those = [r for r in rows if r["samples"] == samples and r["denoised"] == is_denoised]
            mean = {
                k: float(np.mean([r[k] for r in those])) for k in ("seconds", "object", "shadow")
            }
            values = f"{mean['seconds']:7.2f}  {mean['object']:6.2f}  {mean['shadow']:6.2f}"
            print(f"{samples:7d}  {is_denoised!s:8s}  {values}")
    if options.json:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
