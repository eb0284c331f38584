"""Places on the ground where an object can stand: seen whole, free of points, on open ground.

Points above the ground by a tenth of the object's height, and lower than its top, are obstacles (of
a car: between 0.15 m and 1.5 m). Lengths go by the object's size, because the scale of a point
cloud need not be metres.

Without points the photo tells: most of its lower part is ground, and what stands there, the foot of
a wall and a kerb look different in colour or texture. It does not tell a sofa from a floor of its
colour, nor water from asphalt.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray
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
GROUND_ROWS, GROUND_COLUMNS = 0.45, 0.8
"""Shares of the photo, at its lower edge and about its middle, that mostly show ground."""
GRAZING = 0.1
"""Sine of the angle to the ground below which a ray may show what stands there [1]."""
LOOKED_AT = 480
"""Longest side of a photo in which open ground is looked for [px]."""
BLOCK = 6
"""Side of the blocks of it whose colour and texture are compared [px]."""
LIKE = 8.0
"""Difference at which a block counts little for the usual appearance, in per cent of white."""
LEAST_RANGE = 3.0
"""Least difference of open ground from its usual appearance, where it is all alike, in per cent."""
ODD_MOST = 5.0
"""Difference over the ground's own beyond which more says no more [1]."""
OPEN, CLEAR = 1.1, 0.8
"""Mean of that under an object up to which it need not be moved (coloured noise has some 1.05), and
up to which another place is better [1]."""
REACH = 0.3
"""How much farther than the nearest place a better one may be, in shares of the photo [1]."""
LEAST_BLOCKS = 100
"""Blocks of ground that say what it usually looks like."""
FOOT = 9
"""Points along each side of an object's foot at which the ground is looked at."""


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

    def foot(self) -> Float64Array:
        """Return pixels of a grid over the footprint and its margin, shape [FOOT ** 2, 2]."""
        margin = MARGIN * float((self.high - self.low).max())
        x, z = (np.linspace(self.low[k] - margin, self.high[k] + margin, FOOT) for k in (0, 2))
        grid = np.stack(np.meshgrid(x, self.low[1], z, indexing="ij"), axis=-1).reshape(-1, 3)
        return self.camera.project(self._in_world(grid))

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


@dataclass(frozen=True)
class OpenGround:
    """How unlike the ground a photo looks."""

    odd: Float64Array
    """Difference of a block from the usual, over the ground's own [1], shape [rows, columns]."""

    @staticmethod
    def of(shown: FloatArray, camera: Camera, plane: Float64Array) -> "OpenGround | None":
        """Look at a photo; return None where it shows hardly any ground.

        Args:
            shown: Display-encoded values in [0, 1], shape [h, w, 3], both multiples of `BLOCK`.
            camera: The camera, at any size.
            plane: The ground, unit normal on the camera's side, shape [4].
        """
        appearance = _appearance(shown)
        rows, columns = appearance.shape[:2]
        is_ground = camera.scaled(columns, rows).pixel_rays() @ plane[:3] < -GRAZING
        is_ground[: round((1.0 - GROUND_ROWS) * rows)] = False
        edge = round(0.5 * (1.0 - GROUND_COLUMNS) * columns)
        is_ground[:, :edge] = is_ground[:, columns - edge :] = False
        if is_ground.sum() < LEAST_BLOCKS:
            return None
        ground = appearance[is_ground]
        usual = np.median(ground, axis=0)
        # The mode: what stands there moves it less than the mean (mean shift, Cheng 1995).
        for _ in range(8):
            weight = np.exp(-0.5 * ((ground - usual) ** 2).sum(axis=-1) / LIKE**2)
            usual = weight @ ground / weight.sum()
        away = np.sqrt(((appearance - usual) ** 2).sum(axis=-1))
        own = max(float(np.median(away[is_ground])), LEAST_RANGE)
        return OpenGround(np.minimum(away / own, ODD_MOST))

    def holds(self, stand: Stand, most: float = OPEN) -> bool:
        """Return whether an object stands on what looks like open ground."""
        rows, columns = self.odd.shape
        places = stand.foot() / (stand.camera.width, stand.camera.height)
        seen = places[((places >= 0.0) & (places < 1.0)).all(axis=1)]
        if not len(seen):
            return False
        column, row = (seen * (columns, rows)).astype(int).T
        return float(self.odd[row, column].mean()) <= most


def _appearance(shown: FloatArray) -> Float64Array:
    """Return colour and texture of blocks [per cent of white], shape [rows, columns, 4]."""
    red, green, blue = 100.0 * np.moveaxis(shown, 2, 0).astype(np.float64)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    slope = np.hypot(*np.gradient(luma))
    # Light changes luminance across open ground, so it counts half.
    planes = np.stack([0.5 * luma, red - luma, blue - luma, slope])
    height, width = luma.shape
    cut = planes.reshape(4, height // BLOCK, BLOCK, width // BLOCK, BLOCK)
    *colour, texture = cut.mean(axis=(2, 4))
    return np.stack([*colour, 6.0 * np.log1p(8.0 * texture)], axis=-1)


def find_place(
    put: Callable[[Place], Stand],
    camera: Camera,
    plane: Float64Array,
    cloud: Cloud | None = None,
    open_ground: OpenGround | None = None,
) -> Place:
    """Return where the object stands free, world frame [m].

    Of the places where it is seen whole, on ground that has points, with none in its way or in
    front of it, the one nearest to the default pixel and the preferred distance. Where no place
    is like that, the ground may lack points, and then the frame may cut the object. Without points
    only the frame and the appearance of the ground decide.

    Args:
        put: Sets the object down at a place; refuses those that the camera cannot see.
        camera: The camera.
        plane: The ground, unit normal on the camera's side, shape [4].
        cloud: The points, if there are any.
        open_ground: How the ground appears, where that is to count.

    Raises:
        InputError: Every place is occupied or hidden, or the photo shows no ground.
    """
    candidates, is_ground_seen = _candidates(put, camera, plane)
    fallback: tuple[int, Place, float] | None = None
    for cost, place, stand in candidates:
        rank = 2 * stand.is_cut
        if cloud is not None:
            if len(stand.points_in_way(cloud)) > STRAY or stand.hiding_points(cloud) > STRAY:
                continue
            rank += stand.ground_points(cloud) <= STRAY
        elif open_ground is not None:
            rank += not open_ground.holds(stand, CLEAR)
            if fallback is not None and fallback[0] == 1 and cost > fallback[2] + REACH:
                break
        if rank == 0:
            return place
        if fallback is None or rank < fallback[0]:
            fallback = rank, place, cost
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
