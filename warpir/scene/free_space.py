"""Places on the ground where an object can stand: seen whole by the camera, free of points.

Points above the ground by a tenth of the object's height, and lower than its top, are obstacles (of
a car: between 0.15 m and 1.5 m). Lengths go by the object's size, because the scale of a point
cloud need not be metres.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array
from warpir.core.errors import InputError
from warpir.scene.camera import Camera
from warpir.scene.placement import DEFAULT_STAND, Placement, box_corners, point_on_ground

Place = tuple[float, float, float]

MARGIN = 0.1
"""Space kept free around the object, as a share of its longest side."""
STEP = 0.1
"""Height above the ground from which a point is an obstacle, over the object's height [1]."""
STRAY = 2
"""Number of obstacle points that counts as noise of the cloud."""
NEAR, FAR = 1.2, 7.0
"""Preferred distance, in longest sides of the object: 5 m to 30 m for a car."""
GRID = (25, 24)
"""Number of places tried, across the photo and down."""


@dataclass(frozen=True)
class Cloud:
    """Points over a ground plane."""

    points: Float64Array
    """Points, world frame [m], shape [point, 3]."""
    heights: Float64Array
    """Heights above the ground [m], shape [point]."""
    noise: float
    """Standard deviation of the ground's points from the plane [m]."""

    def least_height(self, height: float) -> float:
        """Return the height from which a point obstructs an object of that height [m]."""
        return max(STEP * height, 4.0 * self.noise)


def find_place(
    put: Callable[[Place], Placement],
    low: Float64Array,
    high: Float64Array,
    camera: Camera,
    plane: Float64Array,
    cloud: Cloud | None = None,
) -> Place:
    """Return where the object stands free, world frame [m].

    Of the places where it is seen whole, on ground that has points, with none in its way or in
    front of it, the one nearest to the default pixel and the preferred distance. Where no place
    is like that, the ground may lack points, and then the frame may cut the object. Without points
    only the frame decides.

    Args:
        put: Sets the object down at a place; refuses those that the camera cannot see.
        low: Lowest corner of the asset's bounding box, asset frame [m], shape [3].
        high: Highest corner of it, shape [3].
        camera: The camera.
        plane: The ground, unit normal on the camera's side, shape [4].
        cloud: The points, if there are any.

    Raises:
        InputError: Every place is occupied or hidden, or the photo shows no ground.
    """
    candidates = _candidates(put, low, high, camera, plane)
    fallback: tuple[int, Place] | None = None
    for _, place, matrix in candidates:
        box = _Box(matrix, low, high, camera)
        rank = 2 * box.is_cut
        if cloud is not None:
            if len(points_in_way(matrix, low, high, cloud)) > STRAY or box.hidden(cloud) > STRAY:
                continue
            rank += _ground_points(matrix, low, high, cloud) <= STRAY
        if rank == 0:
            return place
        if fallback is None or rank < fallback[0]:
            fallback = rank, place
    if fallback is None and cloud is None:
        raise InputError(
            "--at",
            "the photo shows no ground on which the object could stand",
            "give --horizon and --fov, or --at",
        )
    if fallback is None:
        raise InputError(
            "--ground-points",
            f"no free place for the object in view (tried {len(candidates)})",
            "give --at or --place, or a smaller --size",
        )
    return fallback[1]


def _candidates(
    put: Callable[[Place], Placement],
    low: Float64Array,
    high: Float64Array,
    camera: Camera,
    plane: Float64Array,
) -> list[tuple[float, Place, Float64Array]]:
    """Return (cost, place, pose) on a grid over the photo, cheapest first."""
    found: list[tuple[float, Place, Float64Array]] = []
    for v in (np.arange(GRID[1]) + 0.5) / GRID[1]:
        for u in (np.arange(GRID[0]) + 0.5) / GRID[0]:
            try:
                stand = point_on_ground((u * camera.width, v * camera.height), camera, plane)
                place = (float(stand[0]), float(stand[1]), float(stand[2]))
                matrix = put(place).asset_to_world
            except InputError:
                continue
            sides = float(np.linalg.norm(stand - camera.c2w[:3, 3])) / _longest(matrix, low, high)
            off = max(np.log(NEAR / sides), np.log(sides / FAR), 0.0)
            cost = float(np.hypot(u - DEFAULT_STAND[0], v - DEFAULT_STAND[1]) + off)
            found.append((cost, place, matrix))
    return sorted(found, key=lambda entry: entry[0])


def is_well_seen(
    matrix: Float64Array, low: Float64Array, high: Float64Array, camera: Camera
) -> bool:
    """Return whether the frame holds an object whole, and it is neither close nor far away.

    Args:
        matrix: Asset to world, shape [4, 4].
        low: Lowest corner of the asset's bounding box, asset frame [m], shape [3].
        high: Highest corner of it, shape [3].
        camera: The camera.
    """
    middle = matrix[:3, :3] @ (0.5 * (low + high)) + matrix[:3, 3]
    away = float(np.linalg.norm(middle - camera.c2w[:3, 3]))
    sides = away / _longest(matrix, low, high)
    return NEAR <= sides <= FAR and not _Box(matrix, low, high, camera).is_cut


def share_of_height(
    matrix: Float64Array, low: Float64Array, high: Float64Array, camera: Camera
) -> float:
    """Return how large an object is seen, by its longest side over the photo's height [1].

    Args:
        matrix: Asset to world, shape [4, 4].
        low: Lowest corner of the asset's bounding box, asset frame [m], shape [3].
        high: Highest corner of it, shape [3].
        camera: The camera.
    """
    foot = np.array([(low[0] + high[0]) / 2.0, low[1], (low[2] + high[2]) / 2.0])
    away = np.linalg.norm(matrix[:3, :3] @ foot + matrix[:3, 3] - camera.c2w[:3, 3])
    return float(_longest(matrix, low, high) / away * camera.fy / camera.height)


def points_in_way(
    asset_to_world: Float64Array, low: Float64Array, high: Float64Array, cloud: Cloud
) -> Float64Array:
    """Return the points that stand where the object does, world frame [m], shape [point, 3]."""
    height = _scale(asset_to_world) * float(high[1] - low[1])
    is_raised = cloud.heights > cloud.least_height(height)
    above = cloud.points[is_raised & (cloud.heights <= height)]
    return above[_over_footprint(asset_to_world, low, high, above)]


def _over_footprint(
    asset_to_world: Float64Array, low: Float64Array, high: Float64Array, points: Float64Array
) -> BoolArray:
    """Return which points lie above or below the footprint and its margin, shape [point]."""
    inverse = np.linalg.inv(asset_to_world)
    local = points @ inverse[:3, :3].T + inverse[:3, 3]
    margin = MARGIN * float((high - low).max())
    inside = (local >= low - margin) & (local <= high + margin)
    return np.asarray(inside[:, 0] & inside[:, 2])


def _ground_points(
    asset_to_world: Float64Array, low: Float64Array, high: Float64Array, cloud: Cloud
) -> int:
    """Return how many points of the ground lie under the object."""
    height = _scale(asset_to_world) * float(high[1] - low[1])
    ground = cloud.points[np.abs(cloud.heights) <= cloud.least_height(height)]
    return int(_over_footprint(asset_to_world, low, high, ground).sum())


class _Box:
    """The object's bounding box as the camera sees it."""

    def __init__(
        self, asset_to_world: Float64Array, low: Float64Array, high: Float64Array, camera: Camera
    ) -> None:
        world = box_corners(low, high) @ asset_to_world[:3, :3].T + asset_to_world[:3, 3]
        self.camera = camera
        self.pixels = camera.project(world)
        self.depth = float(_depths(world, camera).min())

    @property
    def is_cut(self) -> bool:
        """Whether the frame cuts the box, or the box reaches behind the camera."""
        size = (self.camera.width, self.camera.height)
        return not ((self.pixels >= 0.0) & (self.pixels <= size)).all()

    def hidden(self, cloud: Cloud) -> int:
        """Return the number of points between the box and the camera."""
        raised = cloud.points[cloud.heights > 4.0 * cloud.noise]
        pixels = self.camera.project(raised)
        within = (pixels >= self.pixels.min(axis=0)) & (pixels <= self.pixels.max(axis=0))
        return int((within.all(axis=1) & (_depths(raised, self.camera) < self.depth)).sum())


def _depths(points: Float64Array, camera: Camera) -> Float64Array:
    depths: Float64Array = (camera.c2w[:3, 3] - points) @ camera.c2w[:3, 2]
    return depths


def _scale(asset_to_world: Float64Array) -> float:
    return float(np.linalg.norm(asset_to_world[:3, 0]))


def _longest(asset_to_world: Float64Array, low: Float64Array, high: Float64Array) -> float:
    return _scale(asset_to_world) * float((high - low).max())
