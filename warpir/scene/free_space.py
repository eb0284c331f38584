"""Places on the ground where an object can stand: seen whole by the camera, free of points.

Points above the ground by a tenth of the object's height, and lower than its top, are obstacles (of
a car: between 0.15 m and 1.5 m). Lengths go by the object's size, because the scale of a point
cloud need not be metres.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array
from warpir.core.errors import InputError
from warpir.scene.camera import Camera
from warpir.scene.placement import DEFAULT_STAND, box_corners, foot_of_box, point_on_ground

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


@dataclass(frozen=True)
class Stand:
    """The bounding box of an object where it may stand, as the camera sees it."""

    asset_to_world: Float64Array
    """Shape [4, 4]."""
    low: Float64Array
    """Lowest corner of the asset's bounding box, asset frame [m], shape [3]."""
    high: Float64Array
    """Highest corner of it, shape [3]."""
    camera: Camera

    @cached_property
    def _scale(self) -> float:
        return float(np.linalg.norm(self.asset_to_world[:3, 0]))

    @cached_property
    def _height(self) -> float:
        return self._scale * float(self.high[1] - self.low[1])

    @cached_property
    def longest(self) -> float:
        """Longest side [m]."""
        return self._scale * float((self.high - self.low).max())

    @cached_property
    def _corners(self) -> Float64Array:
        return self._in_world(box_corners(self.low, self.high))

    @cached_property
    def _pixels(self) -> Float64Array:
        return self.camera.project(self._corners)

    def _in_world(self, points: Float64Array) -> Float64Array:
        found: Float64Array = points @ self.asset_to_world[:3, :3].T + self.asset_to_world[:3, 3]
        return found

    def _away(self, point: Float64Array) -> float:
        """Return how far a point of the asset is from the camera [m]."""
        return float(np.linalg.norm(self._in_world(point) - self.camera.c2w[:3, 3]))

    @property
    def is_cut(self) -> bool:
        """Whether the frame cuts the box, or the box reaches behind the camera."""
        size = (self.camera.width, self.camera.height)
        return not ((self._pixels >= 0.0) & (self._pixels <= size)).all()

    @property
    def is_well_seen(self) -> bool:
        """Whether the frame holds the object whole, and it is neither close nor far away."""
        sides = self._away(0.5 * (self.low + self.high)) / self.longest
        return NEAR <= sides <= FAR and not self.is_cut

    @property
    def share_of_height(self) -> float:
        """How large the object is seen, by its longest side over the photo's height [1]."""
        away = self._away(foot_of_box(self.low, self.high))
        return float(self.longest / away * self.camera.fy / self.camera.height)

    def points_in_way(self, cloud: Cloud) -> Float64Array:
        """Return the points that stand where the object does, world frame [m], shape [point, 3]."""
        is_raised = cloud.heights > cloud.least_height(self._height)
        above = cloud.points[is_raised & (cloud.heights <= self._height)]
        return above[self._over_footprint(above)]

    def ground_points(self, cloud: Cloud) -> int:
        """Return how many points of the ground lie under the object."""
        ground = cloud.points[np.abs(cloud.heights) <= cloud.least_height(self._height)]
        return int(self._over_footprint(ground).sum())

    def hiding_points(self, cloud: Cloud) -> int:
        """Return how many points are between the box and the camera."""
        raised = cloud.points[cloud.heights > 4.0 * cloud.noise]
        pixels, box = self.camera.project(raised), self._pixels
        within = (pixels >= box.min(axis=0)) & (pixels <= box.max(axis=0))
        nearer = self._depths(raised) < self._depths(self._corners).min()
        return int((within.all(axis=1) & nearer).sum())

    def _over_footprint(self, points: Float64Array) -> BoolArray:
        """Return which points lie above or below the footprint and its margin, shape [point]."""
        inverse = np.linalg.inv(self.asset_to_world)
        local = points @ inverse[:3, :3].T + inverse[:3, 3]
        margin = MARGIN * float((self.high - self.low).max())
        inside = (local >= self.low - margin) & (local <= self.high + margin)
        return np.asarray(inside[:, 0] & inside[:, 2])

    def _depths(self, points: Float64Array) -> Float64Array:
        depths: Float64Array = (self.camera.c2w[:3, 3] - points) @ self.camera.c2w[:3, 2]
        return depths


def find_place(
    put: Callable[[Place], Stand],
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
        camera: The camera.
        plane: The ground, unit normal on the camera's side, shape [4].
        cloud: The points, if there are any.

    Raises:
        InputError: Every place is occupied or hidden, or the photo shows no ground.
    """
    candidates, is_ground_seen = _candidates(put, camera, plane)
    fallback: tuple[int, Place] | None = None
    for _, place, stand in candidates:
        rank = 2 * stand.is_cut
        if cloud is not None:
            if len(stand.points_in_way(cloud)) > STRAY or stand.hiding_points(cloud) > STRAY:
                continue
            rank += stand.ground_points(cloud) <= STRAY
        if rank == 0:
            return place
        if fallback is None or rank < fallback[0]:
            fallback = rank, place
    if not candidates and is_ground_seen:
        what = "the object reaches the camera wherever on the ground in view it stands"
        raise InputError("--size", what, "give less")
    if fallback is None and cloud is None:
        what = "the photo shows no ground on which the object could stand"
        raise InputError("--horizon", what, "give another, or --pitch, or place the object by --at")
    if fallback is None:
        raise InputError(
            "--ground-points",
            f"no free place for the object in view (tried {len(candidates)})",
            "give --at or --place, or a smaller --size",
        )
    return fallback[1]


def _candidates(
    put: Callable[[Place], Stand], camera: Camera, plane: Float64Array
) -> tuple[list[tuple[float, Place, Stand]], bool]:
    """Return (cost, place, stand) over a grid, cheapest first, and whether ground is in view."""
    found: list[tuple[float, Place, Stand]] = []
    is_ground_seen = False
    for v in (np.arange(GRID[1]) + 0.5) / GRID[1]:
        for u in (np.arange(GRID[0]) + 0.5) / GRID[0]:
            try:
                point = point_on_ground((u * camera.width, v * camera.height), camera, plane)
                is_ground_seen = True
                place = (float(point[0]), float(point[1]), float(point[2]))
                stand = put(place)
            except InputError:
                continue
            sides = float(np.linalg.norm(point - camera.c2w[:3, 3])) / stand.longest
            off = max(np.log(NEAR / sides), np.log(sides / FAR), 0.0)
            cost = float(np.hypot(u - DEFAULT_STAND[0], v - DEFAULT_STAND[1]) + off)
            found.append((cost, place, stand))
    return sorted(found, key=lambda entry: entry[0]), is_ground_seen
