"""What benchmarks render: objects on the ground, photographs of places, and pictures as files."""

import zlib
from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from warpir.core.arrays import AnyFloatArray, Float64Array
from warpir.core.color import codes_of
from warpir.evaluate.scenes import ASSET_SUFFIXES, PANORAMA_SUFFIXES, Places, Subject, find_files
from warpir.io.images.photos import Photo
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.renderer import Renderer
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import Lamp


def on_the_ground(
    asset: Asset,
    asset_to_world: Float64Array,
    camera: Camera,
    device: str = "cpu",
    *,
    height: float = 0.0,
    lamps: Sequence[Lamp] = (),
    bounce_depth: int = 0,
) -> Renderer:
    """Return the renderer of an asset over the plane ``y = height``."""
    receiver = Receiver(np.array([0.0, 1.0, 0.0]), height)
    scene = Scene([Placed(asset, asset_to_world)], camera, receiver, device, lamps)
    return Renderer(scene, bounce_depth=bounce_depth)


def renderer_of(subject: Subject) -> Renderer:
    """Return the renderer of an object where it stands in a place, on the CPU."""
    return on_the_ground(subject.asset, subject.placement.asset_to_world, subject.place.camera)


def panoramas_of(options: Namespace) -> list[Path]:
    """Return the panoramas that a command line names."""
    return find_files(options.panoramas, PANORAMA_SUFFIXES, "--panoramas")


def is_for_fitting(name: str) -> bool:
    """Return which half of the places this is in: numbers are fitted to one."""
    return zlib.crc32(name.encode()) % 2 == 0


def places_of(options: Namespace, panoramas: list[Path], width: int) -> Places:
    """Return places whose objects and seed a command line names, photographs so wide [px]."""
    assets = find_files(options.assets, ASSET_SUFFIXES, "--assets")
    return Places(panoramas, assets, options.seed, width)


def photo_of(shown: AnyFloatArray) -> Photo:
    """Return display values, shape [H, W, 3], as the file of a photo of 8 bits."""
    codes = codes_of(shown)
    return Photo(codes, codes.astype(np.float32) / np.float32(255.0), "png")


def write_picture(path: Path, shown: AnyFloatArray) -> None:
    """Write display values, shape [H, W, 3], in 8 bits."""
    Image.fromarray(codes_of(shown)).save(path)
