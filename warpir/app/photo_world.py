"""Brings camera, ground, points and object into one world whose up is known."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpir.app.config import InsertConfig
from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.core.progress import Log
from warpir.io.cameras.reader import read_photo_camera
from warpir.io.cameras.source import PhotoCamera, turned
from warpir.io.images.photos import Photo
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera, camera_from_exif, camera_from_fov
from warpir.scene.free_space import Cloud, find_place, points_in_way
from warpir.scene.ground import fit_ground
from warpir.scene.placement import Placement, place_asset, upright_plane, y_to
from warpir.scene.receiver import ReceiverMesh

DEFAULT_FOV = 60.0
"""Horizontal field of view without --camera, --fov and EXIF [deg]: a phone's main camera."""
DEFAULT_CAMERA_HEIGHT = 1.6
"""Height of a photographer's eyes [m]."""


@dataclass(frozen=True)
class PhotoWorld:
    """Camera and ground of a photograph, in our world."""

    camera: Camera
    """At the photo's resolution."""
    ground: tuple[float, float, float, float] | None
    """Plane a x + b y + c z + d = 0; absent means y = 0."""
    place: tuple[float, float, float] | None
    """``--place``, turned with the world."""
    cloud: Cloud | None = None
    """The points of ``--ground-points``."""
    assumed: tuple[str, ...] = ()
    """What was chosen because nothing was given, one line each."""
    notices: tuple[str, ...] = ()
    """What was turned, one line each."""
    measured: dict[str, Any] = field(default_factory=dict)
    """What ``run.json`` says of the fit."""


def photo_camera(config: InsertConfig, photo: Photo, log: Log) -> PhotoCamera:
    """Return the camera of --camera, else of the numbers given, the photo's EXIF and what is usual.

    Args:
        config: The flags.
        photo: The upright photo.
        log: What was chosen because nothing was given is added here.

    Raises:
        InputError: The camera file cannot be used, or does not fit the photo.
    """
    height, width = photo.codes.shape[:2]
    if config.camera.file is not None:
        assert config.inputs.photo is not None
        return read_photo_camera(
            config.camera.file,
            (width, height),
            config.camera.up,
            frame=config.camera.frame,
            photo_name=Path(config.inputs.photo).name,
            undistort=config.camera.undistort,
            limits=config.limits,
        )
    return PhotoCamera(_camera_from_numbers(config, photo, log))


def _camera_from_numbers(config: InsertConfig, photo: Photo, log: Log) -> Camera:
    height, width = photo.codes.shape[:2]
    camera_height, pitch = config.camera.height, config.camera.pitch
    if camera_height is None:
        camera_height = DEFAULT_CAMERA_HEIGHT
        log.assume(f"the camera is {camera_height} m above the ground (--camera-height)")
    if pitch is None:
        pitch = 0.0
        if config.camera.horizon is None:
            log.assume("the camera is level (--pitch, --horizon)")
    pose = (pitch, camera_height, config.camera.horizon)
    if config.camera.fov is None and photo.focal_35mm is not None:
        return camera_from_exif(photo.focal_35mm, width, height, *pose)
    if config.camera.fov is None:
        log.assume(f"the horizontal field of view is {DEFAULT_FOV:g} degrees (--fov)")
    return camera_from_fov(width, height, config.camera.fov or DEFAULT_FOV, *pose)


def make_world(config: InsertConfig, view: PhotoCamera, points: Float64Array | None) -> PhotoWorld:
    """Find the ground in the points, and level a world whose up is not known by its ground.

    Args:
        config: Names the ground and the place.
        view: The camera, and how its file's world was turned.
        points: Points of ``--ground-points``, in the world of the camera's file, shape [point, 3].

    Raises:
        InputError: No ground in the points, or nothing that tells which way is up.
    """
    camera, ground, place = view.camera, config.camera.ground, config.placement.place
    fit = None
    if points is not None:
        points = points @ view.world.T
        fit = fit_ground(points, camera, has_up=view.has_up)
        ground = _four(fit.plane)
    notices = []
    if not view.has_up:
        if ground is None:
            raise InputError(
                str(config.camera.file),
                "nothing says which way is up (a COLMAP world lies as it happens to)",
                "give --ground-points with its points, or --ground, or --up",
            )
        plane = upright_plane(ground, camera.c2w[:3, 3])
        level = y_to(plane[:3]).T
        camera = replace(camera, c2w=turned(camera.c2w, level))
        ground = _four(np.append(level @ plane[:3], plane[3]))
        if place is not None:
            x, y, z = (float(component) for component in level @ place)
            place = (x, y, z)
        points = None if points is None else points @ level.T
        notices.append(
            "the camera file's world was turned so that the ground is level; --ground and --place "
            "count before that turn, camera.json after it"
        )
    if fit is None or points is None or ground is None:
        return PhotoWorld(camera, ground, place, notices=tuple(notices))
    cloud = Cloud(points, points @ np.array(ground[:3]) + ground[3], fit.rms)
    measured = {"ground_fit": {**fit.record(), "plane": list(ground)}}
    return PhotoWorld(camera, ground, place, cloud, (fit.about,), tuple(notices), measured)


def stand_on_ground(
    config: InsertConfig, asset: Asset, world: PhotoWorld, mesh: ReceiverMesh | None
) -> Placement:
    """Set the asset on the ground: where it was asked for, or where the points leave space.

    Args:
        config: Place, turn and size.
        asset: The object.
        world: Camera, ground and points.
        mesh: What --proxy holds.

    Raises:
        InputError: There is no such place, or no free one.
    """
    low, high = asset.bounds()

    def put(place: tuple[float, float, float] | None) -> Placement:
        return place_asset(
            low,
            high,
            world.camera,
            world.ground,
            place=place,
            at=config.placement.at if place is None else None,
            rotate_y=config.placement.rotate_y,
            scale=config.placement.scale,
            size=config.placement.size,
            mesh=mesh,
            is_plane=config.camera.plane,
        )

    if world.cloud is None:
        return put(world.place)
    if world.place is None and config.placement.at is None:
        plane = upright_plane(world.ground, world.camera.c2w[:3, 3])
        place = find_place(put, low, high, world.camera, plane, world.cloud)
        placement = put(place)
        shown = ",".join(f"{x:.3g}" for x in place)
        line = f"the object stands at {shown}, where no points are in its way (--at, --place)"
        return replace(placement, assumed=(*placement.assumed, line))
    placement = put(world.place)
    if count := len(points_in_way(placement.asset_to_world, low, high, world.cloud)):
        warning = f"{count} points of --ground-points stand where the object does; is it free?"
        placement = replace(placement, warnings=(*placement.warnings, warning))
    return placement


def _four(plane: Float64Array) -> tuple[float, float, float, float]:
    a, b, c, d = (float(x) for x in plane)
    return a, b, c, d
