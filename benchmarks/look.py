"""What repeating a camera's blur and grain on the object is worth: pairs whose truth is known.

    python -m benchmarks.look --panoramas DIR --assets DIR --scenes 20 --json FILE

Panorama crops pass through a camera that is drawn: blur, and grain by level. The truth is the
object in the crop under the crop's own light, through the same camera. The light is given, so all
that is left between truth and composite is what the camera did.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy import ndimage

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import GAMMA, luminance
from warpir.evaluate.image_errors import image_errors, make_regions
from warpir.evaluate.scenes import Place, Places, Subject, find_files
from warpir.io.images.photos import Photo
from warpir.look.camera_look import CameraLook, estimate_look
from warpir.look.grain import Grain
from warpir.render.composite import Picture, Quality, make_picture
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.renderer import Renderer
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves

ROWS = {
    "off": ("off", "off"),
    "sharpness": ("auto", "off"),
    "grain": ("off", "auto"),
    "auto": ("auto", "auto"),
}
"""Sharpness and grain of each row."""
BLUR, GRAIN = (0.0, 1.6), (0.0, 6.0)
"""Least and most deviation of the drawn blur [px] and of the drawn grain [codes of 255]."""


def shoot(linear: FloatArray, blur: float, grain: Grain, noise: Float64Array) -> FloatArray:
    """Return what a camera with a blur and a grain shows: codes of 255 over 255, [H, W, 3]."""
    seen = ndimage.gaussian_filter(linear, (blur, blur, 0.0)) if blur > 0.0 else linear
    shown = np.clip(seen, 0.0, 1.0) ** (1.0 / GAMMA)
    codes = np.round(255.0 * np.clip(shown + grain.deviation(shown) * noise, 0.0, 1.0))
    return (codes / 255.0).astype(np.float32)


def laplacian(image: FloatArray, matte: FloatArray) -> float:
    """Return the mean absolute Laplacian of the object, in codes."""
    inside = ndimage.binary_erosion(matte > 0.99, iterations=1)
    return float(np.abs(ndimage.laplace(255.0 * luminance(image)))[inside].mean())


def photo_of(shown: FloatArray) -> Photo:
    """Return a picture as the file of a photo."""
    return Photo(np.round(255.0 * shown).astype(np.uint8), shown, "png")


def measure(place: Place, subject: Subject, samples: int) -> dict[str, dict[str, float]]:
    """Return the errors of every row for one object."""
    rng = np.random.default_rng([9, *place.seed])
    blur, strength = float(rng.uniform(*BLUR)), float(rng.uniform(*GRAIN)) / 255.0
    grain = Grain((0.0, 1.0), ((strength,) * 3, (0.6 * strength,) * 3), 0.5, 0.2)
    noise = grain.draw(place.photo.shape[:2], int(rng.integers(2**31)))
    ground = subject.placement.ground
    receiver = Receiver(ground[:3], -float(ground[3]))
    placed = Placed(subject.asset, subject.placement.asset_to_world)
    renderer = Renderer(Scene([placed], place.camera, receiver, "cpu"), 0)
    light, curves = Light(texels=place.texels), Curves.identity("linear")

    def insert(photo: Photo, look: CameraLook, seed: int) -> Picture:
        quality = Quality(samples, 1, 5, seed, 8.0)
        return make_picture(
            renderer, light, light, photo, quality, curves.foreground, curves.shadow_ratio,
            is_reinhard=False, look=look,
        )  # fmt: skip

    clean = insert(photo_of(place.photo), CameraLook(), 1)
    truth = shoot(clean.layers.composite, blur, grain, noise)
    photo = photo_of(shoot(place.photo_lin, blur, grain, noise))
    regions = make_regions(clean.layers.matte, clean.layers.shadow_ratio)
    detail = laplacian(truth, clean.layers.matte)
    found = {}
    for name, (sharpness, grained) in ROWS.items():
        look = estimate_look(photo.srgb, photo.linear(), regions["box"], sharpness, grained)
        picture = insert(photo, look, 2)
        shown = photo.encode(picture.image, picture.changed).astype(np.float32) / 255.0
        errors = image_errors(shown, truth, regions)["box"]
        found[name] = {
            "rmse": errors["rmse"],
            "flip": errors.get("flip", float("nan")),
            "laplacian": laplacian(shown, clean.layers.matte) / detail,
            "blur": look.blur.sigma if look.blur else float("nan"),
            "grain": 255.0 * look.grain.typical if look.grain else 0.0,
        }
    found["camera"] = {"blur": blur, "grain": 255.0 * float(grain.deviation(np.full(3, 0.4))[0])}
    return found


def main() -> None:
    """Print a table over all scenes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--panoramas", type=Path, nargs="+", required=True)
    parser.add_argument("--assets", type=Path, nargs="+", required=True)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--samples", type=int, default=64)
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
    measured = []
    for place, subjects in places.make(options.scenes):
        for subject in subjects:
            measured.append({"scene": subject.name, **measure(place, subject, options.samples)})
            print(subject.name, json.dumps({k: measured[-1][k] for k in ("camera", "auto")}))
    print("row          RMSE    FLIP    Laplacian over the truth's: median, within 25 %")
    for name in ROWS:
        rows = [m[name] for m in measured]
        mean = {key: float(np.nanmean([r[key] for r in rows])) for key in ("rmse", "flip")}
        ratio = np.array([r["laplacian"] for r in rows])
        within = float((np.abs(ratio - 1.0) < 0.25).mean())
        errors = f"{mean['rmse']:.4f}  {mean['flip']:.4f}"
        print(f"{name:10s} {errors}  {np.median(ratio):.2f}  {within:.2f}")
    if options.json:
        options.json.write_text(json.dumps(measured, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
