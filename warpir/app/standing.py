"""Where the object stands in the photo's world: where it was put, else on free and open ground."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warpir.app.photo_world import PhotoWorld
from warpir.app.settings import PlacementConfig
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.errors import InputError
from warpir.io.images.photos import Photo
from warpir.io.images.resize import resize
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.free_space import BLOCK, LOOKED_AT, OpenGround, Place, Stand, find_place
from warpir.scene.placement import (
    DEFAULT_STAND,
    Placement,
    place_asset,
    point_on_ground,
    settled,
    upright_plane,
)
from warpir.scene.receiver import ReceiverMesh

SEEN = 0.04
"""Longest side of an object that was given no size, over the photo's height, from which it keeps
its own where it is whole: smaller ones are hardly seen."""
SHOWN = 0.25
"""The same where it does not."""


def thumbnail_of(photo: Photo) -> FloatArray:
    """Return a photo made small, in which `OpenGround` looks for open ground."""
    shown = photo.exposed()[0]
    share = min(1.0, LOOKED_AT / max(shown.shape[:2]))
    height, width = (BLOCK * max(1, round(share * side / BLOCK)) for side in shown.shape[:2])
    return resize(shown, height, width)


class FirstThumbnail:
    """Returns the thumbnail of the first photo of a sequence for all that have its size.

    Who walks by in a later one would let the object jump.
    """

    def __init__(self) -> None:
        self._found: dict[tuple[int, ...], FloatArray] = {}

    def __call__(self, photo: Photo) -> FloatArray:
        """Return `thumbnail_of` of the first such photo."""
        size = photo.codes.shape[:2]
        if size not in self._found:
            self._found[size] = thumbnail_of(photo)
        return self._found[size]


def stand_on_ground(
    asked: PlacementConfig,
    asset: Asset,
    world: PhotoWorld,
    mesh: ReceiverMesh | None = None,
    is_plane: bool = True,
    must_be_seen: bool = True,
) -> Placement:
    """Set the asset on the ground, so that it neither hovers nor sinks unless that is asked for.

    It stands where it was asked for, or where the points leave space, or on open ground; a
    ``--place`` outside the photo is refused where it must be seen.

    Raises:
        InputError: There is no such place, or no free one, or the object would be below the ground.
    """
    low, high = asset.bounds()

    def put(place: Place | None, size: float | None = None) -> Placement:
        return place_asset(
            low,
            high,
            world.camera,
            world.ground,
            place=place,
            at=asked.at if place is None else None,
            rotate_y=asked.rotate_y,
            scale=asked.scale,
            size=asked.size if size is None else size,
            mesh=mesh,
            is_plane=is_plane,
            must_be_seen=must_be_seen or world.place is None,
        )

    is_sized = asked.size is not None or asked.scale is not None
    if world.place is None and asked.at is None:
        placement = _set_free(put, asset, world, mesh, is_sized)
    else:
        placement = put(world.place)
        stand = Stand(placement.asset_to_world, low, high, world.camera)
        if world.cloud is not None and (count := len(stand.points_in_way(world.cloud))):
            warning = f"{count} points of --ground-points stand where the object does; is it free?"
            placement = replace(placement, warnings=(*placement.warnings, warning))
        if not is_sized and stand.share_of_height < SEEN:
            pixels = stand.share_of_height * world.camera.height
            metres = float((high - low).max())
            warning = f"with its own {metres:.3g} m the object is {pixels:.2g} pixels long (--size)"
            placement = replace(placement, warnings=(*placement.warnings, warning))
    return settled(
        placement,
        asset.corners(),
        mesh,
        is_plane=is_plane,
        settles=asked.settle,
        sink=asked.sink,
    )


def _set_free(
    put: Callable[..., Placement],
    asset: Asset,
    world: PhotoWorld,
    mesh: ReceiverMesh | None,
    is_sized: bool,
) -> Placement:
    """Place an object that was not placed: in the lower middle, else where it is seen whole.

    Without points it stands on what looks like open ground. With a mesh and no points only the
    usual pixel is tried.

    Raises:
        InputError: There is no free place, or no ground in view.
    """
    low, high = asset.bounds()

    def stand(place: Place | None, size: float | None = None) -> Stand:
        return Stand(put(place, size).asset_to_world, low, high, world.camera)

    if mesh is not None and world.cloud is None:
        return put(None)
    eye = world.camera.c2w[:3, 3]
    plane = upright_plane(world.ground, eye)
    ground = _open_ground(world, plane)
    usual = _usual(stand) if world.cloud is None else None
    if usual is not None and (ground is None or ground.holds(usual)):
        return put(None)
    own, keeps_size = float((high - low).max()), is_sized
    lines = []
    try:
        place = find_place(stand, world.camera, plane, world.cloud, ground)
    except InputError:
        if is_sized or world.cloud is not None:
            raise
        # So large that the camera is inside wherever it stands: begin with what lies ahead.
        away = 2.0 * float(plane[:3] @ eye + plane[3])
    else:
        if usual is not None and ground is not None and not ground.holds(stand(place)):
            return put(None)  # nothing is gained there
        placement = put(place)
        away = float(np.linalg.norm(np.subtract(place, eye)))
        keeps_size |= not stand(place).is_cut and stand(place).share_of_height >= SEEN
    if not keeps_size:
        away = min(away, _usual_distance(world.camera, plane))
        size = float(f"{SHOWN * away * world.camera.height / world.camera.fy:.2g}")
        place = find_place(
            lambda there: stand(there, size), world.camera, plane, world.cloud, ground
        )
        placement = put(place, size)
        lines.append(
            f"the object is {size:g} m large, since with its own {own:.3g} m "
            f"it would be {'hardly seen' if own < size else 'cut'} (--size, --scale)"
        )
    shown = ",".join(f"{round(x, 3) + 0.0:.3g}" for x in place)
    there = Stand(placement.asset_to_world, low, high, world.camera)
    lines.append(f"the object stands at {shown}, {_reason(world, there, ground)} (--at, --place)")
    return replace(placement, assumed=(*placement.assumed, *lines))


def _usual(stand: Callable[[None], Stand]) -> Stand | None:
    """Return how an object stands at the usual pixel; None where it is not well seen there."""
    try:
        there = stand(None)
    except InputError:
        return None  # above the horizon, or outside the photo: the search for a place tells
    return there if there.is_well_seen else None


def _reason(world: PhotoWorld, there: Stand, ground: OpenGround | None) -> str:
    """Return why an object that was not placed stands there."""
    if world.cloud is not None:
        return "where no points are in its way"
    why = "since the frame cuts it everywhere" if there.is_cut else "where it is seen whole"
    is_open = ground is not None and ground.holds(there)
    return f"{why}, on what looks like open ground" if is_open else why


def _open_ground(world: PhotoWorld, plane: Float64Array) -> OpenGround | None:
    """Return how the ground looks, where no points tell what stands there."""
    if world.thumbnail is None or world.cloud is not None:
        return None
    return OpenGround.of(world.thumbnail(), world.camera, plane)


def _usual_distance(camera: Camera, plane: Float64Array) -> float:
    """Return how far away the ground of the usual pixel is [m]; infinite where there is none."""
    pixel = DEFAULT_STAND[0] * camera.width, DEFAULT_STAND[1] * camera.height
    try:
        point = point_on_ground(pixel, camera, plane)
    except InputError:
        return math.inf
    return float(np.linalg.norm(point - camera.c2w[:3, 3]))
