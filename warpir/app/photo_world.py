"""Brings camera, ground and points into one world whose up is known."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from warpir.app.config import InsertConfig
from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.io.cameras.source import PhotoCamera, turned
from warpir.scene.camera import Camera
from warpir.scene.free_space import Cloud
from warpir.scene.ground import fit_ground
from warpir.scene.placement import upright_plane, y_to


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


def _four(plane: Float64Array) -> tuple[float, float, float, float]:
    a, b, c, d = (float(x) for x in plane)
    return a, b, c, d
