"""Session of placing by hand: the page's initial values, and the files of a saved placement.

A saved placement is two files in one folder: ``camera.json``, as `warpir.insert` writes it, and
``insert.json``, a configuration for ``--config`` that names photo, asset, camera, place and light;
``occluder.png``, where a mask was painted; and ``lamps.json``, where there are lamps.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpir.app.command import read_values
from warpir.app.config import DEFAULTS, SKY_PRESETS, InsertConfig
from warpir.app.inputs import Loaders, read_asset, read_photo_of
from warpir.app.photo_world import (
    NO_PLACE,
    PhotoWorld,
    is_estimated,
    make_world,
    photo_camera,
)
from warpir.app.settings import CameraConfig, InputConfig, LightConfig, PlacementConfig
from warpir.app.standing import stand_on_ground, thumbnail_of
from warpir.calibration.photos import estimate_photo
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.atomic import replacing, write_staged
from warpir.core.errors import ExitCode, InputError, disk_error
from warpir.core.limits import Limits
from warpir.core.progress import Log
from warpir.core.strict_json import json_bytes
from warpir.io.cameras.source import focal_length, number
from warpir.io.gltf.writer import write_glb
from warpir.io.images.photos import Photo, read_mask
from warpir.io.lamps_file import LAMPS
from warpir.lighting.scene_light import SKIES, SUN_TO_SKY
from warpir.place.lamps import lamps_file, page_lamps
from warpir.place.preview_asset import preview_asset, triangle_count
from warpir.place.stance import Stance, ground_to_world, stance_of
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import Lamp
from warpir.scene.placement import foot_of_box, place_asset, upright_plane

CAMERA, CONFIG, MASK = "camera.json", "insert.json", "occluder.png"
"""Names of the files."""
FILES = CAMERA, CONFIG, MASK, LAMPS
MASK_SIDE = 2048
"""Longest side of the page's mask [px]."""
PHOTO_SIDE = 2048
"""Longest side of the photo for the page [px]."""
PLACED = (
    *("place", "at", "rotate_y", "scale", "size", "sun", "sky", "lamp", "lamps"),
    "occluder_mask",
)
"""Fields that the page sets."""
SEEN_BY = (
    *("camera", "frame", "up", "fov", "pitch", "roll", "horizon", "camera_height", "camera_from"),
    "ground",
)
"""Fields that the saved camera file replaces."""
LARGEST_START = 0.6
"""Initial longest side of an asset of unknown scale, over its distance [1]."""
PAGE = Path("the page")
"""Location in errors about numbers from the page."""


@dataclass(frozen=True)
class Session:
    """A photo and an asset that is to be placed in it."""

    photo: Photo
    photo_name: str
    asset: Asset
    asset_name: str
    camera: Camera
    """Initial camera, at the photo's resolution."""
    ground: tuple[float, float, float, float] | None
    """Plane a x + b y + c z + d = 0; absent means y = 0."""
    asset_to_world: Float64Array
    """Initial pose of the asset, shape [4, 4]."""
    rotate_y: float
    """Initial turn about the vertical [deg]."""
    assumed: tuple[str, ...]
    """Assumed and doubtful values, one line each."""
    mask: FloatArray | None = None
    """Initial share of each pixel in which the photo stays in front, shape [H, W]."""
    lamps: tuple[Lamp, ...] = ()
    """Initial lamps near the object, in the world frame."""

    @property
    def frame(self) -> Float64Array:
        """Pose of the ground frame in the world, shape [4, 4]."""
        return ground_to_world(upright_plane(self.ground, self.camera.c2w[:3, 3]))


def open_session(
    inputs: InputConfig, camera: CameraConfig, placement: PlacementConfig, limits: Limits
) -> Session:
    """Read photo, asset and camera as `warpir.insert` does, and choose the initial placement.

    Raises:
        InputError: One of them cannot be used, or the place that was named is not in the photo.
    """
    assert inputs.photo is not None and inputs.asset is not None
    log = Log()
    photo, name = read_photo_of(inputs, limits), Path(inputs.photo).name
    asset = read_asset(inputs, limits, Loaders(), log)

    def seen_by(asked: CameraConfig) -> tuple[PhotoWorld, Float64Array, list[str]]:
        view = photo_camera(asked, photo, name, estimate_photo, limits)
        world = make_world(asked, placement.place, view, None)
        world = replace(world, thumbnail=partial(thumbnail_of, photo))
        try:
            placed = stand_on_ground(placement, asset, world)
        except InputError as error:
            if is_estimated(view.camera):
                world, pose, lines = seen_by(replace(asked, source="assume"))
                return world, pose, [NO_PLACE, *lines]
            named = (placement.place, placement.at, placement.scale, placement.size)
            if any(value is not None for value in named):
                raise
            # It is here that this can be put right: begin with something that is seen.
            pose = _in_view(asset, world.camera, world.ground, placement.rotate_y)
            return world, pose, [f"{error.what}: it starts in front of the camera, and smaller"]
        return world, placed.asset_to_world, [*placed.assumed, *placed.warnings]

    world, asset_to_world, lines = seen_by(camera)
    mask, about_mask = None, list[str]()
    if inputs.occluder_mask is not None:
        size = world.camera.width, world.camera.height
        mask = read_mask(inputs.occluder_mask, size, max_pixels=limits.pixels, notices=about_mask)
    assumed = [*log.assumed, *world.camera.assumed, *world.camera.notices, *lines, *about_mask]
    return Session(
        photo,
        name,
        asset,
        Path(inputs.asset).name,
        world.camera,
        world.ground,
        asset_to_world,
        placement.rotate_y,
        tuple(assumed),
        mask,
    )


def _in_view(
    asset: Asset, camera: Camera, ground: tuple[float, ...] | None, rotate_y: float
) -> Float64Array:
    """Return a pose some heights ahead of the camera, at a size that fits into the view."""
    plane = upright_plane(None if ground is None else np.array(ground), camera.c2w[:3, 3])
    frame = ground_to_world(plane)
    stance = stance_of(np.linalg.inv(frame) @ camera.c2w)
    ahead = replace(stance, pitch=0.0, roll=0.0).c2w()
    # Straight ahead on the ground where that is in view, else where the camera looks down at.
    steep = np.radians(np.clip(-stance.pitch, 0.0, 85.0))
    away = stance.height * (4.0 if steep < np.arctan(0.25) else 1.0 / np.tan(steep))
    x, _, z = (float(c) for c in (ahead @ (0.0, 0.0, -away, 1.0))[:3])
    place = frame @ (x, 0.0, z, 1.0)
    low, high = asset.bounds()
    scale = min(1.0, LARGEST_START * np.hypot(away, stance.height) / float((high - low).max()))
    pose = frame @ Stance(0.0, 0.0, 0.0, rotate_y, 0.0, 0.0).c2w()
    pose[:3, :3] *= scale
    pose[:3, 3] = place[:3] - pose[:3, :3] @ foot_of_box(low, high)
    return pose


def start_record(session: Session, light: LightConfig, folder: str) -> dict[str, Any]:
    """Return the page's initial values, as plain values.

    Lengths are metres, angles degrees, pixels those of the upright photo.
    """
    camera, asset = session.camera, session.asset
    low, high = asset.bounds()
    to_ground = np.linalg.inv(session.frame)
    foot = np.append(foot_of_box(low, high), 1.0)
    x, _, z, _ = (float(c) for c in to_ground @ session.asset_to_world @ foot)
    scale = float(np.linalg.norm(session.asset_to_world[:3, 0]))
    sky_radiance = {name: sky for name, (sky, _) in SKIES.items()}
    sun_color = {name: color for name, (_, color) in SKIES.items()}
    return {
        "photo": {
            "name": session.photo_name,
            "width": camera.width,
            "height": camera.height,
        },
        "asset": {
            "name": session.asset_name,
            "low": low.tolist(),
            "high": high.tolist(),
            "triangles": triangle_count(asset),
        },
        "camera": {
            "width": camera.width,
            "height": camera.height,
            **{name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        },
        "camera_numbers": camera.numbers(),
        "stance": stance_of(to_ground @ camera.c2w).record(),
        "stand": {"x": x, "z": z},
        "rotate_y": session.rotate_y,
        "size": scale * float((high - low).max()),
        "ground_to_world": session.frame.tolist(),
        "sun": None if light.sun is None else [*light.sun, None][:3],
        "sky": light.sky or SKY_PRESETS[0],
        "keeps_light": light.sun is not None or light.sky is not None,
        "sky_radiance": sky_radiance,
        "sun_color": sun_color,
        "sun_to_sky": SUN_TO_SKY,
        "ground_albedo": light.assumed_albedo,
        "lamps": page_lamps(session.lamps, session.frame),
        "has_mask": session.mask is not None,
        "assumed": list(session.assumed),
        "folder": folder,
    }


def photo_jpeg(photo: Photo) -> bytes:
    """Return the upright photo as sRGB JPEG, its longest side at most `PHOTO_SIDE`."""
    from PIL import Image

    picture = Image.fromarray(np.round(photo.srgb * 255.0).astype(np.uint8))
    picture.thumbnail((PHOTO_SIDE, PHOTO_SIDE), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    picture.save(stream, "JPEG", quality=90)
    return stream.getvalue()


def mask_layer(mask: FloatArray) -> bytes:
    """Return a mask, shape [H, W], as the page paints it: a white PNG that it makes opaque."""
    from PIL import Image

    grey = Image.fromarray(np.round(mask * 255.0).astype(np.uint8))
    grey.thumbnail((MASK_SIDE, MASK_SIDE), Image.Resampling.BILINEAR)
    stream = io.BytesIO()
    Image.merge("LA", (Image.new("L", grey.size, 255), grey)).save(stream, "PNG")
    return stream.getvalue()


def asset_glb(asset: Asset) -> bytes:
    """Return the asset in its own frame as binary glTF, thinned where it is heavy."""
    return write_glb(preview_asset(asset), np.eye(4))


def sent_camera(session: Session, sent: Mapping[str, Any]) -> Camera:
    """Return the camera that the page sends.

    Args:
        session: Session of the page.
        sent: ``fx``, ``fy``, ``cx`` and ``cy`` [px], and ``stance`` (`Stance.record`).

    Raises:
        InputError: Numbers out of range.
    """
    stance = Stance(*(number(PAGE, sent.get("stance"), f.name) for f in fields(Stance)))
    fx, fy = (focal_length(PAGE, sent, name) for name in ("fx", "fy"))
    cx, cy = (number(PAGE, sent, name) for name in ("cx", "cy"))
    if stance.height <= 0.0:
        raise InputError(PAGE, "camera height must be more than 0")
    pose = session.frame @ stance.c2w()
    return replace(session.camera, fx=fx, fy=fy, cx=cx, cy=cy, c2w=pose)


def placement_files(
    session: Session, asked: Mapping[str, Any], sent: Mapping[str, Any]
) -> dict[str, dict[str, Any] | bytes]:
    """Return the files of a placement: JSON as plain values, the mask as PNG.

    Args:
        session: Session of the placement.
        asked: Values of the command line, from `InsertConfig.flat`; ``out`` is the folder of the
            two files.
        sent: Page values: those of `sent_camera`, ``stand`` (``x`` and ``z`` in the ground frame)
            [m], ``rotate_y`` [deg], ``size`` [m], and ``sun`` and ``sky`` as the flags, or null
            where the light is to be estimated from the photo; `mask_png`'s and `lamps_file`'s.

    Raises:
        InputError: Numbers out of range, an object that the camera does not see, or a mask that is
            no picture.
    """
    camera = sent_camera(session, sent)
    stand = [number(PAGE, sent.get("stand"), axis) for axis in "xz"]
    x, y, z = (float(c) for c in (session.frame @ (stand[0], 0.0, stand[1], 1.0))[:3])
    sets = ("rotate_y", "size", "sun", "sky")
    given = {name: sent[name] for name in sets if sent.get(name) is not None}
    chosen = read_values(given)
    config = InsertConfig(place=(x, y, z), **chosen)
    place_asset(
        *session.asset.bounds(),
        camera,
        session.ground,
        place=config.placement.place,
        rotate_y=config.placement.rotate_y,
        size=config.placement.size,
    )
    folder = Path(os.path.abspath(asked["out"]))
    ground = {} if session.ground is None else {"ground": session.ground}
    mask = mask_png((camera.width, camera.height), sent)
    occluder = {} if mask is None else {"occluder_mask": str(folder / MASK)}
    lamps = lamps_file(PAGE, sent, session.frame)
    return {
        **({} if mask is None else {MASK: mask}),
        **({} if lamps is None else {LAMPS: lamps}),
        CAMERA: camera.record(),
        CONFIG: {
            **kept_values(asked),
            "camera": str(folder / CAMERA),
            **ground,
            "place": config.placement.place,
            **chosen,
            **occluder,
            **({} if lamps is None else {"lamps": str(folder / LAMPS)}),
            "out": str(folder / "result"),
        },
    }


def mask_png(size: tuple[int, int], sent: Mapping[str, Any]) -> bytes | None:
    """Return the mask that the page sends, at the photo's size, as a grey PNG.

    Args:
        size: Width and height of the photo [px].
        sent: ``mask``: a PNG in base64, white where the photo stays in front; absent or null where
            nothing was painted.

    Raises:
        InputError: It is no such picture.
    """
    from PIL import Image

    text = sent.get("mask")
    if text is None:
        return None
    try:
        picture = Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"])
        if max(picture.size) > MASK_SIDE:
            raise InputError(PAGE, f"the mask is too large (found {max(picture.size)} px)")
        mask = picture.convert("L")
    except (TypeError, ValueError, OSError, SyntaxError, Image.DecompressionBombError):
        raise InputError(PAGE, "the mask is not a PNG in base64") from None
    if mask.getextrema() == (0, 0):
        return None
    stream = io.BytesIO()
    mask.resize(size, Image.Resampling.BILINEAR).save(stream, "PNG")
    return stream.getvalue()


def kept_values(asked: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the command line that a placement keeps, files by their whole paths."""
    kept = {
        name: value
        for name, value in asked.items()
        if value != DEFAULTS[name] and name not in (*PLACED, *SEEN_BY, "overwrite", "demo", "out")
    }
    own = ("photo", "asset", "materials")
    return {**kept, **{name: os.path.abspath(kept[name]) for name in own if name in kept}}


class PlacementFolder:
    """The folder of these files; it replaces its own, and others' where `overwrite` allows it."""

    def __init__(self, path: str, overwrite: bool) -> None:
        """Name the folder, which is created with the first file."""
        self.path = Path(path)
        self.overwrite = overwrite
        self._written: dict[str, bytes] = {}

    @property
    def is_written(self) -> bool:
        """Whether a placement of this session is in it."""
        return bool(self._written)

    def take(self, config: str) -> None:
        """Take what is there for this session's own, if that is the placement it goes on with."""
        goes_on = os.path.abspath(config) == os.path.abspath(self.path / CONFIG)
        for name in FILES if goes_on else ():
            with suppress(FileNotFoundError):
                self._written[name] = (self.path / name).read_bytes()

    def check(self) -> None:
        """Check that a placement can be saved.

        Raises:
            InputError: The folder is a file or holds a placement (`ExitCode.OUTPUT`).
        """
        if self.path.exists() and not self.path.is_dir():
            what = "not a folder (found a file)"
            raise InputError(self.path, what, "choose another --out", ExitCode.OUTPUT)
        for name in FILES:
            path = self.path / name
            if self.overwrite or not os.path.lexists(path):
                continue
            try:
                is_ours = path.read_bytes() == self._written.get(name)
            except OSError:
                is_ours = False
            if not is_ours:
                what = "exists already, and is not of this session"
                advice = "pass --overwrite to replace it, or choose another --out"
                raise InputError(path, what, advice, ExitCode.OUTPUT)

    def write(self, files: Mapping[str, Mapping[str, Any] | bytes]) -> Path:
        """Write the files, each whole or not at all; return the configuration's path.

        Mask and lamps of an earlier placement are removed when this one has none.

        Raises:
            InputError: There is one already (`ExitCode.OUTPUT`), or it cannot be written
                (`ExitCode.RESOURCES`).
        """
        self.check()
        contents = {
            name: content if isinstance(content, bytes) else json_bytes(content)
            for name, content in files.items()
        }
        config = self.path / CONFIG
        try:
            # All are on the disk before any gets its name, the one that names the others last.
            with ExitStack() as renamed:
                for name in (CONFIG, *(other for other in contents if other != CONFIG)):
                    staged = renamed.enter_context(replacing(self.path / name))
                    write_staged(staged, contents[name])
            for name in {MASK, LAMPS} - set(contents):
                (self.path / name).unlink(missing_ok=True)
        except OSError as error:
            raise disk_error(error.filename or self.path, error) from error
        self._written = contents
        return Path(os.path.abspath(config))
