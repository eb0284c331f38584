"""How long does one full frame take, and how much memory?

    python -m benchmarks.frame [--assets DIR] [--device cpu|cuda] [--size 3.2] [--width 1280]

ToyCar at 1280 x 853, or another width, under a sunny 1k panorama, 64 samples, five surface
interactions: G-buffer, object, pilot, shadow, tone and all layers; everything behind reading files
and before writing them.
"""

import time

import numpy as np

from benchmarks.measure import context, flags, peak_mib, report
from benchmarks.scenes import on_the_ground, photo_of
from warpir.io.assets import load_asset
from warpir.io.images.photos import read_envmap
from warpir.render.composite import make_picture
from warpir.render.device import choose_device
from warpir.render.picture.quality import Quality
from warpir.scene.camera import camera_from_fov
from warpir.scene.light import Light
from warpir.scene.placement import place_asset
from warpir.scene.tone_curves import Curves

SAMPLES, DEPTH, REPEATS = 64, 5, 3


def main() -> None:
    """Render the frame cold, with compilation, and warm."""
    parser = flags(__doc__)
    about = "2 m fills half of the width, 3.2 m nearly all"
    parser.add_argument("--size", type=float, default=2.0, help=about)
    parser.add_argument("--width", type=int, default=1280, help="4243: 12 megapixels")
    options = parser.parse_args()
    width, height = options.width, round(options.width / 1.5)
    asset = load_asset(options.assets / "mesh/ToyCar.glb")
    light = Light(texels=read_envmap(options.assets / "hdri/modern_buildings_2_1k.hdr"))
    camera = camera_from_fov(width, height, 40.0, -12.0, 1.4)
    stand = {"place": (0.0, 0.0, -5.5), "rotate_y": -35.0, "size": options.size}
    placement = place_asset(*asset.bounds(), camera, **stand)
    photo = photo_of(np.full((height, width, 3), 0.45, np.float32))
    start = time.perf_counter()
    device = choose_device(options.device)
    renderer = on_the_ground(asset, placement.asset_to_world, camera, device)
    quality = Quality(SAMPLES, 1, DEPTH, 0)
    curves = Curves.identity("reinhard")
    times = []
    for _ in range(1 + REPEATS):
        picture = make_picture(renderer, light, light, photo, quality, curves)
        times.append(time.perf_counter() - start)
        start = time.perf_counter()
    report(
        {
            "question": "frame",
            "scene": f"ToyCar, modern_buildings_2, {width}x{height}",
            "samples": SAMPLES,
            "depth": DEPTH,
            "size_m": options.size,
            "object_pixels": picture.object_pixel_count,
            "shadow_pixels": picture.receiver_pixel_count,
            "first_s": round(times[0], 3),
            "warm_s": [round(t, 3) for t in times[1:]],
            "peak_mib": round(peak_mib(renderer.device)),
            **context(renderer.device, renderer.threads),
        },
        options.json,
    )


if __name__ == "__main__":
    main()
