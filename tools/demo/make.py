"""Make the demo's files: car, light, camera and photo.

    python -m tools.demo.make [--content-only] [--wet] [--truth FILE] [--samples N]

The photo is the place without the car, path-traced with warpir's own renderer under the light that
is shipped beside it, and clipped like a sensor. The truth, on request, is the same picture with
the car really standing in the scene. With ``--wet`` both show the square after rain. Both are
encoded with gamma 2.2, which `warpir.insert` undoes. Deterministic: the same seed gives the same
bytes on the same device.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tools.demo.car import car
from tools.demo.place import background, camera, car_to_world
from tools.demo.sky import sky
from warpir.core.color import codes_of, linear_to_gamma
from warpir.core.latlong import look_up
from warpir.demo import ASSET, CAMERA, LIGHT, PHOTO, WET_PHOTO
from warpir.io.gltf.writer import write_glb
from warpir.io.images.writers import envmap_exr_bytes

DEPTH = 4
"""Surface hits of a light path in the photo."""
BATCHES = 8
"""The photo is rendered in so many parts, which tells fireflies from light."""
FIREFLY = 3.0
"""A batch this many times as bright as the pixel's median batch is left out [1]."""
FINE_SKY = 2048
"""Rows of the map from which the photo's own sky is drawn."""


def write_content() -> None:
    """Write ``car.glb``, ``sky.exr`` and ``camera.json``."""
    ASSET.write_bytes(write_glb(car(), np.eye(4)))
    write_light(sky(), LIGHT)
    CAMERA.write_text(json.dumps(camera().record(), indent=2) + "\n")


def write_light(texels: NDArray[np.float32], path: Path) -> None:
    """Write the light as float32 EXR, its values rounded to 11 bits so that it compresses.

    Half floats would not do: the sun is above their range.

    Args:
        texels: Radiance, relative [W/(m^2 sr)], shape [He, 2 He, 3].
        path: The ``.exr`` file, replaced when it exists.
    """
    bits = np.ascontiguousarray(texels, dtype=np.float32).view(np.uint32)
    rounded = ((bits + np.uint32(1 << 12)) & np.uint32(0xFFFFE000)).view(np.float32)
    path.write_bytes(envmap_exr_bytes(path, rounded))


def render(
    with_car: bool, is_wet: bool, samples: int, device: str | None, seed: int = 0
) -> NDArray[np.float32]:
    """Path-trace the place under the shipped light; on two CPU cores this takes an hour.

    The car stands in it or not, and it has rained or not. The device is ``cpu``, ``cuda``, or the
    best there is.

    Returns:
        Linear Rec.709 radiance, shape [H, W, 3].
    """
    from warpir.io.images.photos import read_envmap
    from warpir.render.device import choose_device
    from warpir.render.device_light import light_args
    from warpir.render.device_scene import Placed, Receiver, Scene
    from warpir.render.renderer import Renderer
    from warpir.scene.light import Light

    view = camera()
    objects = [Placed(background(is_wet), np.eye(4))]
    if with_car:
        objects.append(Placed(car(), car_to_world()))
    # The ground is part of the place; the analytic plane is put out of the way.
    buried = Receiver(np.array([0.0, 1.0, 0.0]), -1000.0)
    scene = Scene(objects, view, buried, choose_device(device))
    renderer = Renderer(scene)
    light = light_args(Light(texels=read_envmap(LIGHT)), renderer.device)
    pixels = np.arange(view.width * view.height, dtype=np.int32)
    batches = [
        renderer.foreground(light, pixels, samples // BATCHES, 1, DEPTH, seed + k)
        for k in range(BATCHES)
    ]
    shape = (view.height, view.width, -1)
    radiance = without_fireflies(np.stack([b.radiance for b in batches])).reshape(shape)
    empty = 1.0 - np.mean([b.mask for b in batches], axis=0).reshape(shape)
    picture = radiance + empty * look_up(sky(FINE_SKY), view.pixel_rays())
    return np.asarray(picture, dtype=np.float32)


def without_fireflies(batches: NDArray[np.float32]) -> NDArray[np.float64]:
    """Average batches of one picture, leaving out those that one rare path has blown up.

    Args:
        batches: Independent estimates of each pixel, shape [batch, pixel, 3].

    Returns:
        Radiance, shape [pixel, 3].
    """
    level = batches.mean(axis=2)
    kept = level <= FIREFLY * np.median(level, axis=0) + 1e-3
    total = np.where(kept[..., None], batches, 0.0).sum(axis=0, dtype=np.float64)
    average: NDArray[np.float64] = total / kept.sum(axis=0)[:, None]
    return average


def write_photo(radiance: NDArray[np.float32], path: Path) -> None:
    """Clip radiance, shape [H, W, 3], like a sensor, encode it and write it."""
    codes = codes_of(linear_to_gamma(np.clip(radiance, 0.0, 1.0)))
    Image.fromarray(codes).save(path, optimize=True, quality=95, subsampling=0)


def main() -> None:
    """Write the files."""
    parser = argparse.ArgumentParser(description="Make the demo's files in place.")
    parser.add_argument("--content-only", action="store_true", help="leave the photo as it is")
    parser.add_argument("--truth", type=Path, help="also render the car in the place, to this PNG")
    parser.add_argument("--samples", type=int, default=256, help="samples per pixel")
    parser.add_argument("--device", help="cpu or cuda (default: the best there is)")
    parser.add_argument("--wet", action="store_true", help="the square after rain")
    arguments = parser.parse_args()
    write_content()
    settings = arguments.wet, arguments.samples, arguments.device
    if not arguments.content_only:
        write_photo(render(False, *settings), WET_PHOTO if arguments.wet else PHOTO)
    if arguments.truth is not None:
        write_photo(render(True, *settings), arguments.truth)


if __name__ == "__main__":
    main()
