"""Placement of the object: the matrix from the asset's frame to the world.

The asset's +Y becomes the ground's normal, its front +Z faces world +Z (toward a level camera) at
``rotate_y = 0``, and its lowest point touches the ground. What stands at the chosen point is the
centre of its footprint, since an asset's origin can be anywhere.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array, affine_matrix
from warpir.core.errors import InputError
from warpir.scene.camera import Camera, ground_point
from warpir.scene.receiver import ReceiverMesh, first_hit

DEFAULT_STAND = (0.5, 0.75)
"""Default place of an object, as fractions of the photo's width and height."""
OFF_GROUND = 0.01
"""Distance from the ground by which a place may be moved without a word [m]."""
MILLIMETRES = 500.0
"""Longest side from which an object around the camera is taken to be in millimetres [m]."""
SMALLEST_PLAUSIBLE = 0.01
LARGEST_PLAUSIBLE = 100.0
"""Range of plausible sizes [m]; others are more often a mistake of the unit."""
SETTLED, SETTLED_SHARE = 0.005, 0.01
"""Largest gap that is closed below an object: length [m], or share of its longest side [1]."""
UNSEEN_GAP = 1e-5
"""Share of the longest side below which a gap is rounding [1]."""
FOOT_CELLS = 32
"""Cells along each side of an object's footprint, of which the lowest vertex each is measured."""
STEEP = 0.5
"""Cosine between a surface and the ground below which nothing is expected to stand on it [1]."""


@dataclass(frozen=True)
class Placement:
    """Pose of the object and its ground plane."""

    asset_to_world: Float64Array
    """Rotation, uniform scale and translation, column vectors [m], shape [4, 4]."""
    ground: Float64Array
    """Ground plane (a, b, c, d): unit normal on the camera's side, offset [m], shape [4]."""
    assumed: tuple[str, ...] = ()
    """Assumed values, one line each."""
    warnings: tuple[str, ...] = ()
    """Doubtful values, one line each."""
    summary: str = ""
    """Distance, size and position in the photo of the object, one line."""
    is_seen: bool = True
    """Whether its box reaches into the photo."""

    def record(
        self, low: Float64Array, high: Float64Array, camera: Camera, sink: float
    ) -> dict[str, Any]:
        """Return the entry of ``run.json``; ``at`` is the pixel that ``--at`` takes back.

        Args:
            low: Lowest corner of the asset, asset frame [m], shape [3].
            high: Highest corner.
            camera: Camera of the photo.
            sink: How deep the object was sunk [m].
        """
        stand = self.asset_to_world[:3, :3] @ foot_of_box(low, high) + self.asset_to_world[:3, 3]
        (at,) = camera.project((stand + sink * self.ground[:3])[None])
        return {
            "summary": self.summary,
            "scale": float(np.linalg.norm(self.asset_to_world[:3, 0])),
            "ground": self.ground.tolist(),
            "at": np.round(at, 1).tolist() if np.isfinite(at).all() else None,
        }


def place_asset(
    low: Float64Array,
    high: Float64Array,
    camera: Camera,
    ground: tuple[float, float, float, float] | Float64Array | None = None,
    *,
    place: tuple[float, float, float] | None = None,
    at: tuple[float, float] | None = None,
    rotate_y: float = 0.0,
    scale: float | None = None,
    size: float | None = None,
    mesh: ReceiverMesh | None = None,
    is_plane: bool = True,
    must_be_seen: bool = True,
) -> Placement:
    """Set an asset on the ground.

    Args:
        low: Lowest corner of the asset's bounding box, asset frame [m], shape [3].
        high: Highest corner of the asset's bounding box, asset frame [m], shape [3].
        camera: Camera of the photo at the photo's resolution.
        ground: Plane ``a x + b y + c z + d = 0``, world frame; absent means ``y = 0``.
        place: Place of the object, world frame [m]; moved onto the ground along its normal.
        at: Place of the object, as a pixel of the ground or of ``mesh`` in the photo [px].
        rotate_y: Turn about the ground's normal, counter-clockwise seen from above [deg].
        scale: Factor on the asset's own size [1].
        size: Longest side of the bounding box after scaling [m].
        mesh: Receiver mesh that the object may stand on.
        is_plane: Whether it may stand on the plane too; else that tells up, and ``place`` stays.
        must_be_seen: Whether an object outside the photo is refused.

    Raises:
        InputError: The place is not on the visible ground, or the camera cannot see the object.
    """
    assumed = ["the ground is the plane y = 0"] if ground is None else []
    warnings: list[str] = []
    origin = camera.c2w[:3, 3]
    plane = upright_plane(ground, origin)
    if place is not None:
        stand = np.asarray(place, dtype=np.float64)
        if is_plane:
            stand = _onto_ground(stand, plane, mesh, warnings)
    else:
        if at is None:
            at = (DEFAULT_STAND[0] * camera.width, DEFAULT_STAND[1] * camera.height)
            assumed.append(f"the object stands at pixel {at[0]:g},{at[1]:g} (--at, --place)")
        stand, steep = _point_at_pixel(at, camera, plane, mesh, is_plane)
        warnings += steep
    scale = _scale_of(high - low, scale, size, assumed, warnings)
    rotation = turn(plane[:3], math.radians(rotate_y)) @ y_to(plane[:3])
    moved = stand - scale * (rotation @ foot_of_box(low, high))
    asset_to_world = affine_matrix(scale * rotation, moved)
    shown = " x ".join(f"{scale * side:.3g}" for side in high - low)
    where, corners = "--at" if place is None else "--place", box_corners(low, high)
    standing = where, corners, asset_to_world, camera
    _refuse_within(shown, *standing)
    is_seen, seen, cut = _in_view(*standing, must_be_seen)
    away = float(np.linalg.norm(stand - origin))
    summary = f"the object of {shown} m stands {away:.3g} m from the camera, {seen}"
    return Placement(asset_to_world, plane, tuple(assumed), tuple(warnings + cut), summary, is_seen)


def settled(
    placement: Placement,
    vertices: Float64Array,
    mesh: ReceiverMesh | None = None,
    *,
    is_plane: bool = True,
    settles: bool = True,
    sink: float = 0.0,
) -> Placement:
    """Close a small gap between an object and what it stands on, then sink it into soft ground.

    The object moves along the ground's normal alone, so that three feet stay as level as they were.
    A gap above `SETTLED` and `SETTLED_SHARE` is taken as meant.

    Args:
        placement: Of `place_asset`.
        vertices: Corners of the object's triangles, asset frame [m], shape [vertex, 3].
        mesh: Of the photo's place.
        is_plane: Whether the ground plane receives the object too.
        settles: Whether a gap is closed.
        sink: How deep it sinks after that [m].

    Raises:
        InputError: All of it would be below the ground.
    """
    normal = placement.ground[:3]
    world = vertices @ placement.asset_to_world[:3, :3].T + placement.asset_to_world[:3, 3]
    height = float(np.ptp(world @ normal))
    scale = float(np.linalg.norm(placement.asset_to_world[:3, 0]))
    longest = scale * float(np.ptp(vertices, axis=0).max())
    assumed, rise = list(placement.assumed), 0.0
    if settles:
        gap = gap_below(world, placement.ground, mesh, is_plane)
        if UNSEEN_GAP * longest < abs(gap) <= max(SETTLED, SETTLED_SHARE * longest):
            rise = -gap
            how = "hovered: it is set down" if gap > 0.0 else "was sunk: it is raised"
            assumed.append(f"the object {how} by {1000.0 * abs(gap):.3g} mm (--no-settle)")
    if sink > 0.0:
        if sink >= height:
            what = f"the object is only {height:.3g} m high (found {sink:g})"
            raise InputError("--sink", what, "give less")
        rise -= sink
    if rise == 0.0:
        return placement
    moved = placement.asset_to_world.copy()
    moved[:3, 3] += rise * normal
    return replace(placement, asset_to_world=moved, assumed=tuple(assumed))


def gap_below(
    points: Float64Array, plane: Float64Array, mesh: ReceiverMesh | None, is_plane: bool
) -> float:
    """Return the least height of points above the receiver below them [m]; negative if below it.

    What is higher than the highest point is no ground: an object may stand under a table. Points,
    world frame [m], shape [point, 3], are vertices of the object, the plane is of `upright_plane`;
    without plane and mesh the gap is infinite.
    """
    up = y_to(plane[:3])
    local = points @ up  # +Y is the ground's normal
    level = -float(plane[3])
    if mesh is None:
        return float(local[:, 1].min()) - level if is_plane else math.inf
    low, high = local.min(axis=0), local.max(axis=0)
    cell = (local[:, (0, 2)] - low[[0, 2]]) / np.maximum(high - low, 1e-30)[[0, 2]] * FOOT_CELLS
    cells = np.minimum(cell.astype(np.int64), FOOT_CELLS - 1) @ np.array([FOOT_CELLS, 1])
    order = np.lexsort((local[:, 1], cells))
    lowest = local[order[np.unique(cells[order], return_index=True)[1]]]
    corners = (mesh.positions @ up)[mesh.indices]
    near = ((corners.min(axis=1) <= high) & (corners.max(axis=1) >= low))[:, (0, 2)].all(axis=1)
    top = lowest * (1.0, 0.0, 1.0) + (0.0, high[1] + SETTLED, 0.0)
    below = ReceiverMesh(mesh.positions @ up, mesh.indices[near])
    reach = first_hit(below, top, np.tile((0.0, -1.0, 0.0), (len(top), 1)))[0]
    floor = np.maximum(top[:, 1] - reach, level if is_plane else -math.inf)
    return float((lowest[:, 1] - floor).min())


def foot_of_box(low: Float64Array, high: Float64Array) -> Float64Array:
    """Return the centre of a bounding box's lowest face, shape [3]."""
    return np.array([(low[0] + high[0]) / 2.0, low[1], (low[2] + high[2]) / 2.0])


def _scale_of(
    sides: Float64Array,
    scale: float | None,
    size: float | None,
    assumed: list[str],
    warnings: list[str],
) -> float:
    """Return the factor on the asset's own size; add to assumptions and warnings.

    Raises:
        InputError: A single point cannot be brought to a size.
    """
    longest = float(sides.max())
    if size is not None:
        if longest <= 0.0:
            raise InputError("--size", "the asset is a single point", "use another asset")
        scale = size / longest
    elif scale is None:
        scale = 1.0
        shown = " x ".join(f"{side:.3g}" for side in sides)
        assumed.append(f"the asset keeps its own size of {shown} m (--size, --scale)")
    if not SMALLEST_PLAUSIBLE <= longest * scale <= LARGEST_PLAUSIBLE:
        warnings.append(f"the object is {longest * scale:.3g} m large; meant? (--size, --scale)")
    return scale


def upright_plane(
    ground: tuple[float, float, float, float] | Float64Array | None, camera_origin: Float64Array
) -> Float64Array:
    """Return the ground plane with a unit normal that points to the camera's side, shape [4].

    Args:
        ground: Plane ``a x + b y + c z + d = 0``, world frame; absent means ``y = 0``.
        camera_origin: Camera position, world frame [m], shape [3].

    Raises:
        InputError: The plane has no normal or runs through the camera.
    """
    plane = np.array((0.0, 1.0, 0.0, 0.0) if ground is None else ground, dtype=np.float64)
    length = float(np.linalg.norm(plane[:3]))
    if not (math.isfinite(length) and length > 0.0):
        raise InputError("--ground", "a normal a,b,c that is not 0 is needed (found 0)")
    plane /= length
    distance = float(plane[:3] @ camera_origin + plane[3])
    if abs(distance) < 1e-6 * (1.0 + float(np.linalg.norm(camera_origin))):
        raise InputError(
            "--ground", "the ground runs through the camera", "give --camera-height or --ground"
        )
    return plane if distance > 0.0 else -plane


def point_on_ground(at: tuple[float, float], camera: Camera, plane: Float64Array) -> Float64Array:
    """Return the ground point seen at a pixel, world frame [m], shape [3].

    Args:
        at: Pixel position (u, v) [px].
        camera: Camera of the photo at the photo's resolution.
        plane: Ground plane of `upright_plane`, shape [4].

    Raises:
        InputError: The pixel is outside the photo, or at or above the horizon.
    """
    _check_in_photo(at, camera)
    return ground_point(camera, *at, plane=tuple(map(float, plane)))


def _check_in_photo(at: tuple[float, float], camera: Camera) -> None:
    if not (0.0 <= at[0] <= camera.width and 0.0 <= at[1] <= camera.height):
        raise InputError(
            "--at",
            f"outside the photo (found {at[0]:g},{at[1]:g}; "
            f"expected up to {camera.width},{camera.height})",
        )


def _onto_ground(
    stand: Float64Array, plane: Float64Array, mesh: ReceiverMesh | None, warnings: list[str]
) -> Float64Array:
    """Return a place moved onto the ground along its normal, and warn where that is far."""
    up, rise = plane[:3], float(plane[:3] @ stand + plane[3])
    if abs(rise) > OFF_GROUND:
        side = "above" if rise > 0.0 else "below"
        level = ",".join(f"{part:.6g}" for part in (*up, plane[3] - rise))
        advice = f"--ground {level} is a ground at its height"
        if mesh is not None:
            top, down = stand + OFF_GROUND * up, -2.0 * OFF_GROUND * up
            if first_hit(mesh, top[None], down[None])[0][0] <= 1.0:
                advice = "on --proxy, where it was, it stands by --at, or with --no-plane"
        warnings.append(
            f"--place is {abs(rise):.3g} m {side} the ground, onto which the object is moved; "
            f"{advice}"
        )
    moved: Float64Array = stand - up * rise
    return moved


def _point_at_pixel(
    at: tuple[float, float],
    camera: Camera,
    plane: Float64Array,
    mesh: ReceiverMesh | None,
    is_plane: bool,
) -> tuple[Float64Array, list[str]]:
    """Return the first point of mesh or plane at a pixel, world frame [m], and warnings."""
    if mesh is None:
        return point_on_ground(at, camera, plane), []
    _check_in_photo(at, camera)
    origin, direction = camera.ray(*at)
    distances, triangles = first_hit(mesh, origin[None], direction[None])
    reach = float(distances[0])
    slope = float(plane[:3] @ direction)
    if is_plane and slope < 0.0:
        to_plane = -float(plane[:3] @ origin + plane[3]) / slope
        if to_plane <= reach:
            return origin + to_plane * direction, []
    pixel = f"pixel ({at[0]:g}, {at[1]:g}) shows"
    if not math.isfinite(reach):
        shown = "neither ground nor --proxy" if is_plane else "nothing of --proxy"
        raise InputError("--at", f"{pixel} {shown}", "choose another pixel")
    a, b, c = mesh.positions[mesh.indices[triangles[0]]]
    normal = np.cross(b - a, c - a)
    steep = abs(float(plane[:3] @ normal)) < STEEP * float(np.linalg.norm(normal))
    warning = f"{pixel} a steep side of --proxy: is the object to stand there? (--at)"
    return origin + reach * direction, [warning] if steep else []


def y_to(normal: Float64Array) -> Float64Array:
    """Return the smallest rotation from +Y to a unit vector, shape [3, 3]."""
    x, y, z = (float(component) for component in normal)
    if y < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    # Rodrigues' formula about the axis (+Y) x normal = (z, 0, -x).
    k = 1.0 / (1.0 + y)
    return np.array(
        [[1.0 - k * x * x, x, -k * x * z], [-x, y, -z], [-k * x * z, z, 1.0 - k * z * z]]
    )


def up_to_y(axis: str) -> Float64Array:
    """Return the smallest rotation from an axis such as ``+z`` or ``-x`` to +Y, shape [3, 3]."""
    up = np.zeros(3)
    up["xyz".index(axis[-1])] = -1.0 if axis.startswith("-") else 1.0
    return y_to(up).T


def levelled(normal: Float64Array) -> Float64Array:
    """Return a rotation from a unit vector to +Y, which hardly changes with it, shape [3, 3].

    It goes by way of the axis closest to the vector: the smallest rotation from near -Y, where
    most COLMAP worlds have their up, turns about any axis for the last digits of it.
    """
    axis = int(np.abs(normal).argmax())
    to_y = up_to_y(("-" if normal[axis] < 0.0 else "+") + "xyz"[axis])
    rotation: Float64Array = y_to(to_y @ normal).T @ to_y
    return rotation


def turn(axis: Float64Array, angle: float) -> Float64Array:
    """Return the right-handed rotation about a unit axis by an angle [rad], shape [3, 3]."""
    x, y, z = (float(component) for component in axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    rotation: Float64Array = np.eye(3) + math.sin(angle) * cross
    rotation += (1.0 - math.cos(angle)) * (cross @ cross)
    return rotation


def box_corners(low: Float64Array, high: Float64Array) -> Float64Array:
    """Return the corners of a box, the lowest first and the highest last, shape [8, 3]."""
    return np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )


def _refuse_within(
    size: str, where: str, corners: Float64Array, asset_to_world: Float64Array, camera: Camera
) -> None:
    """Refuse an object whose bounding box holds the camera."""
    eye = np.linalg.solve(asset_to_world, camera.c2w[:, 3])[:3]
    if np.all((eye > corners[0]) & (eye < corners[-1])):
        # Files in millimetres are a thousand times as large as what they show.
        longest = float((corners[-1] - corners[0]).max()) * float(
            np.linalg.norm(asset_to_world[:3, 0])
        )
        unit = ".001 for millimetres" if longest >= MILLIMETRES else ".01 for centimetres"
        raise InputError(
            where,
            f"the camera is inside the object of {size} m",
            f"move it away, or use --size or --scale ({unit})",
        )


def _in_view(
    where: str,
    corners: Float64Array,
    asset_to_world: Float64Array,
    camera: Camera,
    must_be_seen: bool,
) -> tuple[bool, str, list[str]]:
    """Return whether and where an object is in the photo, and warnings.

    The bounding box is tested, so an object that just fits may be reported as cut.

    Raises:
        InputError: It must be seen, and the camera cannot see it.
    """
    pixels = camera.project(corners @ asset_to_world[:3, :3].T + asset_to_world[:3, 3])
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    if 0 < len(seen) < len(pixels):
        return True, "partly behind it", ["the object reaches behind the camera"]
    unseen = InputError(where, "the object is behind the camera", "the camera looks along -Z")
    if len(seen):
        (left, top), (right, bottom) = seen.min(axis=0), seen.max(axis=0)
        box = f"columns {left:.0f} to {right:.0f}, rows {top:.0f} to {bottom:.0f}"
        frame = f"the photo is {camera.width} x {camera.height}"
        if min(left, top) >= 0.0 and right <= camera.width and bottom <= camera.height:
            return True, f"its box in {box}", []
        if right > 0.0 and bottom > 0.0 and left < camera.width and top < camera.height:
            cut = f"the object may be cut by the photo's edge ({box}; {frame})"
            return True, f"its box in {box}", [cut]
        unseen = InputError(where, f"the object is outside the photo ({box}; {frame})")
    if must_be_seen:
        raise unseen
    return False, "not in the photo", [unseen.what]
