"""Brings camera, ground, points and object into one world whose up is known."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpir.app.settings import CameraConfig, PlacementConfig
from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.progress import Log
from warpir.io.cameras.reader import read_photo_camera
from warpir.io.cameras.source import PhotoCamera, turned
from warpir.io.images.photos import Photo
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera, camera_from_exif, camera_from_fov
from warpir.scene.free_space import Cloud, find_place, points_in_way
from warpir.scene.ground import fit_ground
from warpir.scene.placement import Placement, place_asset, settled, upright_plane, y_to
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


def photo_camera(
    asked: CameraConfig, photo: Photo, photo_name: str, log: Log, limits: Limits = LIMITS
) -> PhotoCamera:
    """Return the camera of --camera, else of the numbers given, the photo's EXIF and what is usual.

    Args:
        asked: The file or the numbers.
        photo: The upright photo.
        photo_name: Its file name, which tells the images of a file apart.
        log: What was chosen because nothing was given is added here.
        limits: How large the file may be.

    Raises:
        InputError: The camera file cannot be used, or does not fit the photo.
    """
    height, width = photo.codes.shape[:2]
    if asked.file is not None:
        return read_photo_camera(
            asked.file,
            (width, height),
            asked.up,
            frame=asked.frame,
            photo_name=photo_name,
            undistort=asked.undistort,
            limits=limits,
        )
    return PhotoCamera(_camera_from_numbers(asked, photo, log))


def _camera_from_numbers(asked: CameraConfig, photo: Photo, log: Log) -> Camera:
    height, width = photo.codes.shape[:2]
    camera_height, pitch = asked.height, asked.pitch
    if camera_height is None:
        camera_height = DEFAULT_CAMERA_HEIGHT
        log.assume(f"the camera is {camera_height} m above the ground (--camera-height)")
    if pitch is None:
        pitch = 0.0
        if asked.horizon is None:
            log.assume("the camera is level (--pitch, --horizon)")
    pose = (pitch, camera_height, asked.horizon)
    if asked.fov is None and photo.focal_35mm is not None:
        return camera_from_exif(photo.focal_35mm, width, height, *pose)
    if asked.fov is None:
        log.assume(f"the horizontal field of view is {DEFAULT_FOV:g} degrees (--fov)")
    return camera_from_fov(width, height, asked.fov or DEFAULT_FOV, *pose)


def make_world(
    asked: CameraConfig,
    place: tuple[float, float, float] | None,
    view: PhotoCamera,
    points: Float64Array | None,
) -> PhotoWorld:
    """Find the ground in the points, and level a world whose up is not known by its ground.

    Args:
        asked: Names the ground.
        place: ``--place``, in the world of the camera's file.
        view: The camera, and how its file's world was turned.
        points: Points of ``--ground-points``, in the world of the camera's file, shape [point, 3].

    Raises:
        InputError: No ground in the points, or nothing that tells which way is up.
    """
    camera, ground = view.camera, asked.ground
    fit = None
    if points is not None:
        points = points @ view.world.T
        fit = fit_ground(points, camera, has_up=view.has_up)
        ground = _four(fit.plane)
    notices = []
    if not view.has_up:
        if ground is None:
            raise InputError(
                str(asked.file),
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
    asked: PlacementConfig,
    asset: Asset,
    world: PhotoWorld,
    mesh: ReceiverMesh | None = None,
    is_plane: bool = True,
) -> Placement:
    """Set the asset on the ground, so that it neither hovers nor sinks unless that is asked for.

    Args:
        asked: Place, turn, size and depth.
        asset: The object.
        world: Camera, ground and points.
        mesh: What --proxy holds.
        is_plane: Whether the object may stand on the ground plane.

    Raises:
        InputError: There is no such place, or no free one, or the object would be below the ground.
    """
    return settled(
        _stood(asked, asset, world, mesh, is_plane),
        asset.corners(),
        mesh,
        is_plane=is_plane,
        settles=asked.settle,
        sink=asked.sink,
    )


def _stood(
    asked: PlacementConfig,
    asset: Asset,
    world: PhotoWorld,
    mesh: ReceiverMesh | None,
    is_plane: bool,
) -> Placement:
    """Place the asset where it was asked for, or where the points leave space."""
    low, high = asset.bounds()

    def put(place: tuple[float, float, float] | None) -> Placement:
        return place_asset(
            low,
            high,
            world.camera,
            world.ground,
            place=place,
            at=asked.at if place is None else None,
            rotate_y=asked.rotate_y,
            scale=asked.scale,
            size=asked.size,
            mesh=mesh,
            is_plane=is_plane,
        )

    if world.cloud is None:
        return put(world.place)
    if world.place is None and asked.at is None:
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
