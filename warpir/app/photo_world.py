"""Brings camera, ground and points into one world whose up is known."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpir.app.settings import CameraConfig
from warpir.core.arrays import Float64Array, FloatArray, affine_matrix
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.cameras.reader import read_photo_camera
from warpir.io.cameras.source import PhotoCamera
from warpir.io.images.photos import Photo
from warpir.scene.camera import (
    ASSUMED,
    ESTIMATE,
    Camera,
    CameraEstimate,
    Source,
    camera_from_exif,
    camera_from_fov,
    camera_pose,
    horizon_row,
)
from warpir.scene.free_space import Cloud
from warpir.scene.ground import GroundFit, fit_ground
from warpir.scene.placement import (
    STEEP,
    levelled,
    upright_plane,
)

DEFAULT_FOV = 60.0
"""Horizontal field of view without --camera, --fov and EXIF [deg]: a phone's main camera."""
DEFAULT_CAMERA_HEIGHT = 1.6
"""Height of a photographer's eyes [m]."""
WIDE = {"pitch_deg": 8.0, "roll_deg": 5.0, "vfov_deg": 18.0}
"""Standard deviation above which an estimate is doubtful [deg]."""
WORDS = {"pitch_deg": "pitch", "roll_deg": "roll", "vfov_deg": "vertical field of view"}
"""What the numbers are called where they are printed."""
LOOKING_DOWN = -30.0
"""Pitch of a camera that sees ground nearly everywhere [deg]."""
USUAL_VFOV = 60.0
"""Its vertical field of view, where the photo's is not known [deg]."""
PENDING = "to be estimated"
"""Name of the source of numbers that a run would estimate, where nothing may be estimated yet."""
NO_PLACE = (
    "the camera is assumed, not estimated, since the estimated one sees no place for the object; "
    "give --horizon and --fov"
)
"""Where an estimate gives way, so that what a level camera can do is done."""

CameraEstimator = Callable[[FloatArray, float | None], CameraEstimate]
"""Estimates the camera of a display-encoded photo, given its vertical field of view where that is
known [deg]; see `warpir.calibration.estimate.estimate_camera`."""


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
    thumbnail: Callable[[], FloatArray] | None = None
    """Shows the ground (`warpir.app.standing.thumbnail_of`); without it how that appears does not
    count."""


def photo_camera(
    asked: CameraConfig,
    photo: Photo,
    photo_name: str,
    estimator: CameraEstimator | None = None,
    limits: Limits = LIMITS,
) -> PhotoCamera:
    """Return the camera of --camera, else of the numbers given, the photo's EXIF and an estimate.

    ``photo_name`` tells the images of a camera file apart. The estimator is asked for the numbers
    that nothing else gives; without one, as where only the inputs are checked, the usual ones
    stand for them.

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
    camera, seen_as = _camera_of_flags(asked, photo), ""
    if asked.source == "estimate" and any(
        camera.sources[name].name == ASSUMED for name in ("pitch_deg", "vfov_deg")
    ):
        if estimator is None:
            camera = _pending(camera)
        else:
            camera, seen_as = _estimated(camera, asked, photo, estimator)
    assumed, doubtful = _about_sources(camera, seen_as)
    if asked.height is None:
        line = f"the camera is {DEFAULT_CAMERA_HEIGHT} m above the ground (--camera-height)"
        assumed.insert(0, line)
    assumed = [*assumed, *camera.assumed]
    notices = (*camera.notices, *doubtful)
    return PhotoCamera(replace(camera, assumed=tuple(assumed), notices=notices))


def _camera_of_flags(asked: CameraConfig, photo: Photo) -> Camera:
    """Return the camera of flags and EXIF; the usual numbers stand for what they leave open."""
    height, width = photo.codes.shape[:2]
    sources = dict.fromkeys((*WORDS, "principal"), Source(ASSUMED))
    if asked.pitch is not None or asked.horizon is not None:
        sources["pitch_deg"] = Source("--pitch" if asked.horizon is None else "--horizon")
    pose = (asked.pitch or 0.0, asked.height or DEFAULT_CAMERA_HEIGHT, asked.horizon)
    if asked.fov is None and photo.focal_35mm is not None:
        camera = camera_from_exif(photo.focal_35mm, width, height, *pose)
        sources["vfov_deg"] = Source("EXIF")
    else:
        camera = camera_from_fov(width, height, asked.fov or DEFAULT_FOV, *pose)
        if asked.fov is not None:
            sources["vfov_deg"] = Source("--fov")
    if asked.roll is not None:
        sources["roll_deg"] = Source("--roll")
        pitch = _asked_pitch(asked, camera, camera.cy, asked.roll) or 0.0
        camera = replace(camera, c2w=camera_pose(pitch, asked.roll, float(camera.c2w[1, 3])))
    return replace(camera, sources=sources)


def _asked_pitch(asked: CameraConfig, camera: Camera, centre: float, roll: float) -> float | None:
    """Return the pitch that flags name [deg], of a camera whose optical axis is at a row [px].

    The horizon's row is that of the middle column, so the roll [deg] counts.
    """
    if asked.horizon is None:
        return asked.pitch
    row = horizon_row(asked.horizon, camera.height)
    return math.degrees(math.atan2((row - centre) * math.cos(math.radians(roll)), camera.fy))


def _pending(camera: Camera) -> Camera:
    """Return a camera whose assumed numbers are marked as those that a run estimates."""
    sources = {k: Source(PENDING) if s.name == ASSUMED else s for k, s in camera.sources.items()}
    return replace(camera, sources=sources)


def _estimated(
    camera: Camera, asked: CameraConfig, photo: Photo, estimator: CameraEstimator
) -> tuple[Camera, str]:
    """Return a camera with estimates for its assumed numbers, and what the photo looks like.

    That is `CameraEstimate.looks_like`. The estimates are rounded to a tenth of a degree, far less
    than their errors: other processors add up in another order, and shall give the same camera.
    """
    sources = dict(camera.sources)
    is_known = sources["vfov_deg"].name != ASSUMED
    fov = math.degrees(2.0 * math.atan(camera.height / 2.0 / camera.fy))
    found = estimator(photo.exposed()[0], fov if is_known else None)
    focal, centre = camera.fy, camera.cy
    if not is_known:
        focal = camera.height / 2.0 / math.tan(math.radians(round(found.vfov_deg, 1)) / 2.0)
        sources["vfov_deg"] = Source(ESTIMATE, found.vfov_sigma_deg)
    if found.is_upright_corrected and asked.pitch is None:
        centre = round(found.principal[1], 2) * camera.height
        sources["principal"] = Source(ESTIMATE, found.principal_sigma[1])
    roll = asked.roll
    if roll is None and found.roll_sigma_deg <= WIDE["roll_deg"]:
        roll = round(found.roll_deg, 1)
        sources["roll_deg"] = Source(ESTIMATE, found.roll_sigma_deg)
    roll = roll or 0.0  # where there is nothing to go by most photos are level
    camera = replace(camera, fx=focal, fy=focal, cy=centre)
    pitch = _asked_pitch(asked, camera, centre, roll)
    if pitch is None:
        pitch = round(found.pitch_deg, 1)
        sources["pitch_deg"] = Source(ESTIMATE, found.pitch_sigma_deg)
    pose = camera_pose(pitch, roll, float(camera.c2w[1, 3]))
    return replace(camera, c2w=pose, sources=sources), found.looks_like


def _about_sources(camera: Camera, seen_as: str) -> tuple[list[str], list[str]]:
    """Return what is assumed and estimated of a camera, and which estimates are doubtful.

    ``seen_as`` is `CameraEstimate.looks_like`.
    """
    assumed, doubtful = [], []
    numbers = camera.numbers()
    estimated = [k for k in WORDS if camera.sources[k].name == ESTIMATE]
    shown = [
        f"{WORDS[k]} {numbers[k]['value']:.1f} +- {numbers[k]['sigma']:.1f}" for k in estimated
    ]
    if estimated:
        line = f"estimated from the photo: {', '.join(shown)} degrees"
        if "vfov_deg" in estimated:
            across = math.degrees(2.0 * math.atan(camera.width / 2.0 / camera.fx))
            line += f", horizontal {across:.1f}"
        if camera.sources["principal"].name == ESTIMATE:
            line += f", corrected to upright (optical axis at row {camera.cy:.0f})"
        assumed.append(f"camera {line} (--pitch, --roll, --horizon, --fov; --camera-from assume)")
    wide = [WORDS[k] for k in estimated if numbers[k]["sigma"] > WIDE[k]]
    if wide:
        looks = f"looks like {seen_as} and " if seen_as else ""
        doubtful.append(
            f"the photo {looks}hardly shows the camera's {' and '.join(wide)}: "
            "give --horizon and --fov, or place the object by hand (python -m warpir.place)"
        )
    pending = [WORDS[k] for k in WORDS if camera.sources[k].name == PENDING]
    if pending:
        assumed.append(
            f"the camera's {', '.join(pending)} will be estimated from the photo; checked as "
            f"level and {DEFAULT_FOV:g} degrees wide (--pitch, --horizon, --fov)"
        )
    if camera.sources["pitch_deg"].name == ASSUMED:
        assumed.append("the camera is level (--pitch, --horizon)")
    if camera.sources["vfov_deg"].name == ASSUMED:
        assumed.append(f"the horizontal field of view is {DEFAULT_FOV:g} degrees (--fov)")
    return assumed, doubtful


def other_camera(camera: Camera) -> tuple[dict[str, Any], str] | None:
    """Return what to try where a camera sees no place for the object, and what to say of it.

    None where the camera is not an estimate. What would be estimated may look down: an object
    above a level camera's horizon is no reason yet to refuse the inputs.
    """
    if is_estimated(camera):
        return {}, NO_PLACE
    if camera.sources and camera.sources["pitch_deg"].name == PENDING:
        changed = {"pitch": LOOKING_DOWN}
        # The assumed field is horizontal: of a tall, narrow photo the vertical one is absurd.
        if camera.sources["vfov_deg"].name == PENDING:
            across = math.tan(math.radians(USUAL_VFOV / 2.0)) * camera.width / camera.height
            changed["fov"] = math.degrees(2.0 * math.atan(across))
        return changed, (
            "whether there is a place for the object is known when the camera is estimated"
        )
    return None


def is_estimated(camera: Camera) -> bool:
    """Return whether pitch or field of view of a camera were estimated from the photo."""
    return any(
        name in camera.sources and camera.sources[name].name == ESTIMATE
        for name in ("pitch_deg", "vfov_deg")
    )


def make_world(
    asked: CameraConfig,
    place: tuple[float, float, float] | None,
    view: PhotoCamera,
    points: Float64Array | None,
    fitted: Callable[..., GroundFit] = fit_ground,
) -> PhotoWorld:
    """Find the ground in the points, and level a world whose up is not known by its ground.

    The points, shape [point, 3], are in the world of the camera's file, and so are ground and
    ``place`` where its up is unknown; ``view`` says how that was turned. ``fitted`` is called as
    `fit_ground`.

    Raises:
        InputError: No ground in the points, nothing that tells which way is up, or a ground that
            is assumed above the camera.
    """
    camera, ground = view.camera, asked.ground
    fit = None
    if points is not None:
        points = points @ view.world.T
        fit = fitted(points, camera, has_up=view.has_up)
        ground = _four(fit.plane)
    notices = _about_turn(asked, place, view)
    if not view.has_up:
        if ground is None:
            raise InputError(
                str(asked.file),
                "nothing says which way is up (a COLMAP world lies as it happens to)",
                "give --ground-points with its points, or --ground, or --up",
            )
        plane = upright_plane(ground, camera.c2w[:3, 3])
        level = levelled(plane[:3])
        camera = replace(camera, c2w=affine_matrix(level) @ camera.c2w)
        ground = _four(np.append(level @ plane[:3], plane[3]))
        if place is not None:
            x, y, z = (float(component) for component in level @ place)
            place = (x, y, z)
        points = None if points is None else points @ level.T
        notices.append(
            "the camera file's world was turned so that the ground is level; --ground and --place "
            "count before that turn, camera.json after it"
        )
    notices += _about_side(camera, ground)
    if fit is None or points is None or ground is None:
        return PhotoWorld(camera, ground, place, notices=tuple(notices))
    cloud = Cloud(points, points @ np.array(ground[:3]) + ground[3], fit.rms)
    measured = {"ground_fit": {**fit.record(), "plane": list(ground)}}
    return PhotoWorld(camera, ground, place, cloud, (fit.about,), tuple(notices), measured)


def _about_turn(
    asked: CameraConfig, place: tuple[float, float, float] | None, view: PhotoCamera
) -> list[str]:
    """Say that the file's world was turned, where something was given that counts after it."""
    named = {"--ground": asked.ground, "--place": place, "--proxy": asked.proxy}
    given = ", ".join(flag for flag, value in named.items() if value is not None)
    if not given or np.array_equal(view.world, np.eye(3)):
        return []
    axes = [f"{'-' if row.min() < -0.5 else ''}{'xyz'[abs(row).argmax()]}" for row in view.world]
    return [
        f"the camera file's world was turned so that +y points up, where its x,y,z are "
        f"{','.join(axes)}: so count {given}"
    ]


def _about_side(camera: Camera, ground: tuple[float, float, float, float] | None) -> list[str]:
    """Say where the camera sees the ground from below: an object there hangs head down.

    Raises:
        InputError: Nobody asked for that ground.
    """
    eye = camera.c2w[:3, 3]
    plane = upright_plane(ground, eye)
    if plane[1] > -STEEP:
        return []
    what = f"the camera is {float(plane[:3] @ eye + plane[3]):.3g} m below the ground"
    if ground is None:
        advice = "give a ground below it, as 0,1,0,H of one at y = -H; or --up"
        raise InputError("--ground", f"{what} y = 0, which is assumed", advice)
    return [f"{what}, from which the object hangs head down (--ground)"]


def _four(plane: Float64Array) -> tuple[float, float, float, float]:
    a, b, c, d = (float(x) for x in plane)
    return a, b, c, d
