"""What repeating a camera's look on the object is worth: pairs whose truth is known.

    python -m benchmarks.look.composites --panoramas DIR --assets DIR --scenes 20 --json FILE

Panorama crops pass through a camera that is drawn: blur, response, grain by level, and in half of
them the blocks of JPEG; the responses are those that the regressor trains with
(`warpir.train.photo_look`). The truth is the object in the crop under the crop's own light, through
the same camera. The light is given, so all that is left between truth and composite is what the
camera did. A camera blurs scene and object alike, and so is it here: the crop is soft by its
look-up between texels (`softness`), and so is the object before the camera takes both. The places
are those that `benchmarks.response` does not fit its estimate to.
"""

import json
import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from benchmarks.look.pair import blacks_and_contrast
from benchmarks.measure import flags, write_json
from benchmarks.response import LEVELS, codes_of, curve
from benchmarks.scenes import is_for_fitting, panoramas_of, photo_of, places_of, renderer_of
from warpir.core.arrays import CodeArray, Float64Array, FloatArray
from warpir.evaluate.image_errors import image_errors, make_regions
from warpir.evaluate.scenes import Subject
from warpir.io.images.jpeg import JpegCoding, read_coding
from warpir.io.images.photos import read_envmap
from warpir.look.camera_look import CameraLook, estimate_look, region_around
from warpir.look.grain import Grain
from warpir.look.response import Response
from warpir.look.sharpness import PIXEL_SIGMA, EdgeBlur, gaussian
from warpir.render.composite import composite
from warpir.render.picture.planes import Rendering, render
from warpir.render.picture.quality import Quality
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves
from warpir.train.photo_look import Look, draw_looks

ROWS = {
    "off": ("off", "off", "off"),
    "response": ("off", "off", "auto"),
    "sharpness": ("auto", "off", "off"),
    "grain": ("off", "auto", "off"),
    "blocks": ("off", "auto", "off"),
    "auto": ("auto", "auto", "auto"),
    "true blur": ("off", "auto", "auto"),
}
"""Sharpness, grain and response of each row. `--grain` stands for the blocks of JPEG too; of these
two rows each keeps one of both. The last has the camera's own blur in place of the estimate."""
TRUE = "true camera"
"""Row of the object through the camera itself, with other grain and other samples: the floor."""
QUALITY = (40, 95)
"""Least and most quality of the JPEG files that half of the cameras write."""
BLUR, GRAIN = (0.0, 1.6), (0.0, 6.0)
"""Least and most deviation of the drawn blur [px] and of the drawn grain [codes of 255]."""
Errors = dict[str, dict[str, float]]
"""Figures of one object by row."""


@dataclass(frozen=True)
class Shot:
    """A simulated camera and what it was drawn with."""

    blur: float
    """Standard deviation [px]."""
    grain: Grain
    noise: Float64Array
    """Of unit variance, shape [H, W, 3]."""
    response: Look
    """Without its exposure and white balance."""
    quality: int | None
    """Of the JPEG file that it writes; None: it writes none."""

    def shoot(self, linear: FloatArray) -> FloatArray:
        """Return codes of 255 over 255, [H, W, 3]."""
        seen = gaussian(linear, self.blur)
        shown = self.response.show(torch.from_numpy(seen).permute(2, 0, 1)[None].float())
        shown = shown[0].permute(1, 2, 0).numpy()
        noisy = shown + self.grain.deviation(shown) * self.noise
        codes = np.round(255.0 * np.clip(noisy, 0.0, 1.0)).astype(np.uint8)
        if self.quality is not None:
            codes = jpeg_of(codes, self.quality)[0]
        return (codes / np.float32(255.0)).astype(np.float32)


def jpeg_of(codes: CodeArray, quality: int) -> tuple[CodeArray, JpegCoding]:
    """Return a picture as a JPEG file leaves it, and how the file is coded."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "photo.jpg"
        Image.fromarray(codes).save(path, quality=quality)
        with Image.open(path) as image:
            coded = np.asarray(image)
        coding = read_coding(path, 1)
    assert coding is not None
    return coded, coding


def draw_camera(
    photo_lin: FloatArray, rng: np.random.Generator, blur: tuple[float, float] = BLUR
) -> Shot:
    """Draw a camera that takes a photo, shape [H, W, 3], its blur between two deviations [px]."""
    sigma, strength = float(rng.uniform(*blur)), float(rng.uniform(*GRAIN)) / 255.0
    grain = Grain((0.0, 1.0), ((strength,) * 3, (0.6 * strength,) * 3), 0.5, 0.2)
    noise = grain.draw(photo_lin.shape[:2], int(rng.integers(2**31)))
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    response = draw_looks(torch.from_numpy(photo_lin).permute(2, 0, 1)[None], generator)
    plain = replace(response, gain=torch.ones_like(response.gain))
    quality = int(rng.integers(*QUALITY)) if rng.random() < 0.5 else None
    return Shot(sigma, grain, noise, plain, quality)


def softness(camera: Camera, columns: int) -> Float64Array:
    """Return how much softer a crop is than what is rendered into it [px], shape [H, W].

    The weights of a bilinear look-up between texels are a triangle, whose variance is a sixth of
    the texel's square. A pixel of the crop is the mean of two by two look-ups, whose variance is
    1/16, a rendered one of a whole square, 1/12. What blurred the panorama, of so many columns,
    itself comes on top, and is not known.
    """
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = camera.toward(u, v)
    distance = np.linalg.norm(local, axis=-1)
    upward = local @ camera.c2w[1, :3] / distance
    pixel = 1.0 / (camera.fx * camera.fy * distance**3)
    texel = (2.0 * np.pi / columns) ** 2 * np.sqrt(1.0 - upward**2)
    variance = texel / pixel / 6.0 + 1.0 / 16.0 - PIXEL_SIGMA**2
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)), np.float64)


def measure(subject: Subject, samples: int, columns: int) -> Errors:
    """Return the errors of every row for one object in a panorama of so many columns."""
    place = subject.place
    rng, crop = np.random.default_rng([9, *place.seed]), photo_of(place.photo)
    camera = draw_camera(place.photo_lin, rng)
    first, second = _rendered(subject, samples)
    crisp = composite(first, crop, 1).layers
    soft = float(softness(place.camera, columns)[crisp.matte > 0.0].mean())
    as_crop = CameraLook(blur=EdgeBlur(float(np.hypot(soft, PIXEL_SIGMA)), 0))
    clean = composite(first, crop, 1, look=as_crop).layers.composite
    truth = camera.shoot(clean)
    photo = photo_of(camera.shoot(place.photo_lin))
    coding = None if camera.quality is None else jpeg_of(photo.codes, camera.quality)[1]
    regions = make_regions(crisp.matte, crisp.shadow_ratio)
    inside = crisp.matte > 0.99
    true_blacks, detail = blacks_and_contrast(truth, inside)
    positions = np.argwhere(crisp.matte > 0.0)[:, ::-1].astype(np.float64) + 0.5
    around = region_around(positions, *crisp.matte.shape)

    def errors(shown: FloatArray) -> dict[str, float]:
        of_box = image_errors(shown, truth, regions)["box"]
        blacks, contrast = blacks_and_contrast(shown, inside)
        return {
            "rmse": of_box["rmse"],
            "flip": of_box.get("flip", float("nan")),
            "laplacian": contrast / detail,
            "blacks": blacks - true_blacks,
        }

    found = {}
    for name, words in ROWS.items():
        jpeg = None if name == "grain" else coding
        look = estimate_look(photo.srgb, photo.linear(), around, *words, jpeg)
        if name == "blocks":
            look = replace(look, grain=None)
        if name == "true blur":
            look = replace(look, blur=EdgeBlur(math.hypot(camera.blur, soft, PIXEL_SIGMA), 0))
        picture = composite(second, photo, 2, look=look)
        shown = photo.encode(picture.image, picture.changed).astype(np.float32) / 255.0
        found[name] = errors(shown) | _estimates(look)
    again = camera.grain.draw(place.photo.shape[:2], int(rng.integers(2**31)))
    perfect = composite(second, crop, 2, look=as_crop).layers.composite
    found[TRUE] = errors(replace(camera, noise=again).shoot(perfect))
    found["camera"] = _drawn(camera) | {"softness": soft}
    return found


def _rendered(subject: Subject, samples: int) -> tuple[Rendering, Rendering]:
    """Return the object under the place's own light, twice, by other samples."""
    renderer = renderer_of(subject)
    light, curves = Light(texels=subject.place.texels), Curves.identity("linear")
    first, second = (
        render(renderer, light, light, Quality(samples, 1, 5, seed, 8.0), curves) for seed in (1, 2)
    )
    return first, second


def _drawn(camera: Shot) -> dict[str, float]:
    """Return the figures of a drawn camera: blur [px], grain [codes of 255], quality, codes."""
    grey = codes_of(camera.response, LEVELS) - curve(Response(1.0), LEVELS)
    return {
        "blur": camera.blur,
        "grain": 255.0 * float(camera.grain.deviation(np.full(3, 0.4))[0]),
        "quality": float(camera.quality or 100),
        "response at .003": float(grey[0]),
    }


def _estimates(look: CameraLook) -> dict[str, float]:
    """Return the figures of a look: exponent, blur [px], grain [codes of 255]."""
    return {
        "response": look.response.exponent if look.response else 1.0,
        "blur": look.blur.sigma if look.blur else float("nan"),
        "grain": 255.0 * look.grain.typical if look.grain else 0.0,
    }


def main() -> None:
    """Print a table over all scenes."""
    parser = flags(__doc__, "panoramas", "objects", "json")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--samples", type=int, default=64)
    about = "of the photographs [px]; panoramas of 1024 columns are soft in wider ones"
    parser.add_argument("--width", type=int, default=192, help=about)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    files = {p.stem: p for p in panoramas_of(options) if not is_for_fitting(p.stem)}
    places = places_of(options, list(files.values()), options.width)
    measured: list[dict[str, Any]] = []
    for place, subjects in places.make(options.scenes):
        for subject in subjects:
            columns = read_envmap(files[place.panorama]).shape[1]
            found = measure(subject, options.samples, columns)
            measured.append({"scene": subject.name, **found})
            print(subject.name, json.dumps({k: measured[-1][k] for k in ("camera", "auto")}))
    print("row           RMSE    FLIP    Laplacian: median, within 25 %; blacks: off by, within 3")
    for name in (*ROWS, TRUE):
        rows = [m[name] for m in measured]
        mean = {key: float(np.nanmean([r[key] for r in rows])) for key in ("rmse", "flip")}
        ratio = np.array([r["laplacian"] for r in rows])
        within = float((np.abs(ratio - 1.0) < 0.25).mean())
        off = np.abs([r["blacks"] for r in rows])
        errors = f"{mean['rmse']:.4f}  {mean['flip']:.4f}  {np.median(ratio):.2f}  {within:.2f}"
        print(f"{name:11s} {errors}  {off.mean():.1f}  {(off < 3.0).mean():.2f}")
    write_json(options.json, measured)


if __name__ == "__main__":
    main()
