"""All inputs of one insertion, read and checked; torch and Warp are not needed here."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeVar

import numpy as np

from warpir.asset import Asset, load_asset
from warpir.camera import Camera, camera_from_exif, camera_from_fov, read_camera
from warpir.config import InsertConfig, usage
from warpir.errors import ExitCode, InputError, raise_all
from warpir.light import Float64Array, FloatArray, Light
from warpir.lobes_file import read_lobes
from warpir.materials_file import with_materials
from warpir.photo_files import Photo, read_envmap, read_mask, read_photo
from warpir.placement import Placement, place_asset
from warpir.reuse import EarlierRun, read_run

DEFAULT_FOV = 60.0
"""Horizontal field of view without --camera, --fov and EXIF [deg]: a phone's main camera."""
DEFAULT_CAMERA_HEIGHT = 1.6
"""Height of a photographer's eyes [m]."""

Read = TypeVar("Read")


@dataclass(frozen=True)
class Inputs:
    """What was read from disk, and where the object stands."""

    photo: Photo
    asset: Asset
    """With the materials of --materials."""
    camera: Camera
    """At the photo's resolution."""
    placement: Placement
    light: Light | None = None
    """What --light holds, turned by --light-rotate; absent: --sun and --sky describe it."""
    run: EarlierRun | None = None
    """What --reuse holds, as the run left it; in place of any other light."""
    assumed: tuple[str, ...] = ()
    """What was chosen because nothing was given, one line each."""
    notices: tuple[str, ...] = ()
    """What was repaired, converted, left out or looks odd, one line each."""
    occluder: FloatArray | None = None
    """What --occluder-mask holds: share of the photo in front of the object [1], shape [H, W]."""


class Loaders:
    """Reads assets and earlier runs; the last of each is remembered, for many insertions."""

    def __init__(self) -> None:
        self.asset: Callable[[str, str], Asset] = lru_cache(maxsize=1)(load_asset)
        self.run: Callable[[str], EarlierRun] = lru_cache(maxsize=1)(read_run)


def read_inputs(config: InsertConfig, loaders: Loaders | None = None) -> Inputs:
    """Read and check every input, so that all problems are known before anything is rendered.

    Args:
        config: Names the files.
        loaders: Of earlier insertions; what they remember is not read again.

    Raises:
        InputError: The first problem; the others are in its ``also``.
    """
    config.require_inputs()
    loaders = loaders or Loaders()
    problems: list[InputError] = []

    def attempt(read: Callable[[], Read]) -> Read | None:
        try:
            return read()
        except InputError as error:
            problems.append(error)
            return None

    assert config.photo is not None and config.asset is not None
    photo_path, asset_path = config.photo, config.asset
    problems += _inputs_in_out(config)
    for path in (config.lora, config.prior, config.regressor):
        if path is not None and not Path(path).is_file():
            problems.append(InputError(path, "no such file", code=ExitCode.MODEL))
    notices: list[str] = []
    assumed: list[str] = []
    photo = attempt(
        lambda: read_photo(
            photo_path,
            max_pixels=config.max_pixels,
            alpha="ignore" if config.alpha == "ignore" else "refuse",
            layer=config.layer,
            strict=config.strict,
        )
    )
    occluder = attempt(lambda: _read_occluder(config, photo, notices))
    asset = attempt(lambda: _read_asset(asset_path, config, loaders))
    reuse = config.reuse
    run = attempt(lambda: loaders.run(reuse)) if reuse is not None else None
    camera = attempt(lambda: _make_camera(config, photo, assumed)) if photo is not None else None
    # Without a camera the run ends below, but all that is wrong with the light is told too.
    pose = camera.c2w if camera is not None else np.eye(4)
    light = attempt(lambda: _read_light(config, pose, notices))
    raise_all(problems)
    assert photo is not None and asset is not None and camera is not None

    placement = place_asset(
        *asset.bounds(),
        camera,
        config.ground,
        place=config.place,
        at=config.at,
        rotate_y=config.rotate_y,
        scale=config.scale,
        size=config.size,
    )
    notices = [
        *_about(photo_path, photo.notices),
        *_about(asset_path, asset.notices),
        *notices,
        *_split_assumed(camera.notices, assumed),
        *placement.warnings,
    ]
    if config.width is not None and config.width < camera.width:
        notices.append(
            f"a preview: object and shadow are rendered {config.width} px wide and enlarged to the "
            f"photo's {camera.width} px (--width)"
        )
    assumed += placement.assumed
    if run is not None and (assumption := run.assumption(camera.c2w, config.camera)):
        assumed.append(assumption)
    if run is not None and run.materials is not None and config.materials is None:
        notices.append(
            f"{run.path} had changed its object's materials, this run has not (--materials "
            f"{run.materials} does the same to that object)"
        )
    if occluder is not None and config.is_guided:
        notices.append("guidance does not see --occluder-mask; the pictures it leads to do")
    return Inputs(
        photo, asset, camera, placement, light, run, tuple(assumed), tuple(notices), occluder
    )


def _inputs_in_out(config: InsertConfig) -> list[InputError]:
    """Refuse an --out that holds an input: --overwrite could replace it."""
    if config.out is None:
        return []
    out = os.path.realpath(config.out)
    named = (
        *(config.photo, config.asset, config.materials, config.camera, config.light),
        config.occluder_mask,
        *(config.lora, config.prior, config.regressor),
    )
    folders = {path: os.path.dirname(path) for path in named if path is not None}
    if config.reuse is not None:
        folders[config.reuse] = config.reuse
    for path, folder in folders.items():
        if os.path.realpath(folder) == out:
            return [usage("--out", f"holds the input {path}", "choose a folder of its own")]
    return []


def _read_asset(path: str, config: InsertConfig, loaders: Loaders) -> Asset:
    asset = loaders.asset(path, config.missing_textures)
    if config.materials is not None:
        asset = with_materials(asset, config.materials)
    for name in config.refine_materials or ():
        if not asset.materials_named([name]):
            found = ", ".join(dict.fromkeys(ascii(m.name) for m in asset.materials))
            what = f"no material {name[:60]!a} in {path} (found {found[:400]})"
            raise usage("--refine-materials", what, "name some of these, or leave it out for all")
    return asset


def _make_camera(config: InsertConfig, photo: Photo, assumed: list[str]) -> Camera:
    height, width = photo.codes.shape[:2]
    if config.camera is not None:
        return read_camera(config.camera, (width, height), config.up)
    camera_height, pitch = config.camera_height, config.pitch
    if camera_height is None:
        camera_height = DEFAULT_CAMERA_HEIGHT
        assumed.append(f"the camera is {camera_height} m above the ground (--camera-height)")
    if pitch is None:
        pitch = 0.0
        if config.horizon is None:
            assumed.append("the camera is level (--pitch, --horizon)")
    pose = (pitch, camera_height, config.horizon)
    if config.fov is None and photo.focal_35mm is not None:
        return camera_from_exif(photo.focal_35mm, width, height, *pose)
    if config.fov is None:
        assumed.append(f"the horizontal field of view is {DEFAULT_FOV:g} degrees (--fov)")
    return camera_from_fov(width, height, config.fov or DEFAULT_FOV, *pose)


def _read_occluder(
    config: InsertConfig, photo: Photo | None, notices: list[str]
) -> FloatArray | None:
    if config.occluder_mask is None or photo is None:
        return None
    height, width = photo.codes.shape[:2]
    found: list[str] = []
    occluder = read_mask(config.occluder_mask, (width, height), notices=found)
    notices += _about(config.occluder_mask, found)
    return occluder


def _read_light(
    config: InsertConfig, camera_to_world: Float64Array, notices: list[str]
) -> Light | None:
    if config.light is None:
        return None
    if Path(config.light).suffix.lower() == ".json":
        if config.fit_lobes is not None:
            raise usage("--fit-lobes", f"needs a panorama to fit (found lobes: {config.light})")
        if config.light_convention != "openexr":
            raise usage("--light-convention", f"is for panoramas (found lobes: {config.light})")
        return Light(lobes=read_lobes(config.light)).rotated(config.light_rotate)
    found: list[str] = []
    texels = read_envmap(
        config.light,
        convention=config.light_convention,
        camera_to_world=camera_to_world,
        pictures=True,
        strict=config.strict,
        notices=found,
    )
    notices += _about(config.light, found)
    return Light(texels=texels).rotated(config.light_rotate)


def _about(path: str, notices: tuple[str, ...] | list[str]) -> list[str]:
    return [f"{Path(path).name}: {notice}" for notice in notices]


def _split_assumed(notices: tuple[str, ...], assumed: list[str]) -> list[str]:
    """Move the lines that begin with ``assumed:`` to `assumed`; return the others."""
    mark = "assumed: "
    assumed += [line.removeprefix(mark) for line in notices if line.startswith(mark)]
    return [line for line in notices if not line.startswith(mark)]
