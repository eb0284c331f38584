"""Triangles of a mesh: polygons cut up, those without area dropped, normals of unit length."""

import math
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.core.errors import Faults
from warpir.core.limits import Limits
from warpir.scene.asset import Primitive

EXTENT = 1e18
"""Largest coordinate [m]; its square still fits float32."""
LARGEST = 3e38
"""Largest number of a mesh: what a float32 holds; of positions `EXTENT` is the limit."""
CROSSINGS = 100
"""After as many cuts that were no ears a polygon is taken for a tangle and cut into a fan."""
MESH = Faults(
    "mesh",
    {
        "concave": ("concave polygons of too many corners", "triangulate the faces on export"),
        "not_finite": "{what} are NaN or infinite",
        "nothing_to_render": "nothing to render",
        "too_large": ("coordinates up to {found:g} (expected below {limit:g})", "scale it down"),
    },
)
"""What the triangles of any file may have wrong."""
CONCAVE_COST = 100_000_000
"""Largest sum of the squared numbers of corners of all concave polygons of a material."""


def triangulate(
    path: Path, points: Float64Array, polygons: dict[int, IntArray], notices: list[str]
) -> IntArray:
    """Cut polygons into triangles: fans where convex, ears where not.

    Polygons, vertex indices of shape [polygon, corner], are given by number of corners; ``notices``
    receives the number of concave ones.

    Returns:
        Shape [triangle, 3], the winding kept.

    Raises:
        InputError: Concave polygons of so many corners that cutting them would take minutes.
    """
    triangles = [np.zeros((0, 3), dtype=np.int32)]
    concave_count = cost = 0
    for size, polygon in polygons.items():
        concave = np.zeros(len(polygon), dtype=bool)
        if size > 3:
            corner = points[polygon]
            edge = np.roll(corner, -1, axis=1) - corner
            turn = np.cross(np.roll(edge, 1, axis=1), edge)
            normal = np.cross(corner, np.roll(corner, -1, axis=1)).sum(axis=1, keepdims=True)
            along = (turn * normal).sum(axis=2)
            concave = (along < -1e-9 * np.abs(along).max(axis=1, keepdims=True)).any(axis=1)
        cost += int(concave.sum()) * size**2
        if cost > CONCAVE_COST:
            found, limit = f"{concave.sum()} of {size}", f"one of {math.isqrt(CONCAVE_COST)}"
            raise MESH.error(path, "concave", found=found, limit=limit)
        fan = np.stack([np.array([0, k, k + 1]) for k in range(1, size - 1)])
        triangles.append(polygon[~concave][:, fan].reshape(-1, 3))
        for row in polygon[concave]:
            triangles.append(row[clip_ears(points[row])])
        concave_count += int(concave.sum())
    if concave_count:
        notices.append(f"{concave_count} concave polygons triangulated by ear clipping")
    return np.concatenate(triangles).astype(np.int32)


def clip_ears(points: Float64Array) -> IntArray:
    """Triangulate one simple polygon (Meisters 1975), seen along its mean normal.

    A corner that was no ear is looked at again only when a neighbour of it, or the corner that was
    found within it, is gone: for most polygons the time grows as the square of the corners.

    ``points`` are the corners in order, shape [corner, 3]; the triangles are indices of them, shape
    [corner - 2, 3].
    """
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, axis=1)
    if (normal[axis] < 0) != (axis == 1):  # dropping y mirrors the plane
        flat = flat * [1.0, -1.0]

    x, y = flat.T
    rest = list(range(len(points)))
    left = np.ones(len(points), dtype=bool)
    within: dict[int, int] = {}
    triangles = []
    start = stuck = 0
    while len(rest) > 3 and stuck < CROSSINGS:
        for step in range(len(rest)):
            k = (start + step) % len(rest)
            a, b, c = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            if b not in within or not left[within[b]]:
                within[b] = corner_within(x, y, left, (a, b, c))
            if within[b] < 0:
                break
        else:
            k = 1  # self-intersecting: any cut is as good as another
            a, b, c = rest[0], rest[1], rest[2]
            stuck += 1
        triangles.append((a, b, c))
        del rest[k]
        left[b] = False
        within.pop(a, None)
        within.pop(c, None)
        start = max(k - 1, 0)
    triangles += [(rest[0], b, c) for b, c in pairwise(rest[1:])]
    return np.array(triangles, dtype=np.int32)


def corner_within(
    x: Float64Array,
    y: Float64Array,
    left: BoolArray,
    triangle: tuple[int, int, int],
) -> int:
    """Return what keeps a corner of a polygon from being an ear.

    ``left`` are the corners that were not cut off, ``triangle`` the corner in the middle, its
    neighbours around it.

    Returns:
        Another corner in the triangle, its own where it is concave, -1 where it is an ear.
    """

    def left_of(p: int, q: int) -> BoolArray:
        side: BoolArray = (x[q] - x[p]) * (y - y[p]) >= (y[q] - y[p]) * (x - x[p])
        return side

    a, b, c = triangle
    if (x[b] - x[a]) * (y[c] - y[a]) <= (y[b] - y[a]) * (x[c] - x[a]):
        return b
    inside = left & left_of(a, b) & left_of(b, c) & left_of(c, a)
    inside[list(triangle)] = False
    found = int(inside.argmax())
    return found if inside[found] else -1


def drop_without_area(
    positions: Float64Array, indices: IntArray, notices: list[str], where: str = ""
) -> IntArray:
    """Drop triangles that no ray can hit, and exact repetitions, and note how many.

    Positions [m] are of shape [vertex, 3], triangles of shape [triangle, 3]; ``where`` is the place
    in the file, ending in ``: ``, or empty.

    Returns:
        The remaining triangles, C-contiguous. A repetition has the same three vertices in the same
        cyclic order.
    """
    a, b, c = (positions[indices[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):  # `check_drawable` refuses such sizes
        area_squared = np.square(np.cross(b - a, c - a)).sum(axis=1)
        longest_squared = np.maximum(np.square(b - a).sum(axis=1), np.square(c - a).sum(axis=1))
        # Collinear corners leave rounding errors of float64, relative to the longest side.
        flat = area_squared <= np.square(1e-12 * longest_squared)
        flat &= np.isfinite(area_squared)
    kept = indices[~flat] if flat.any() else indices
    # Start each triangle at its lowest vertex, so that equal triangles are equal rows.
    first = kept.argmin(axis=1)
    rows = np.arange(len(kept))
    key = [kept[rows, (first + k) % 3] for k in range(3)]
    order = np.lexsort(key)
    same = np.ones(max(len(kept) - 1, 0), dtype=bool)
    for column in key:
        same &= np.diff(column[order]) == 0
    repeated = order[1:][same]
    if len(repeated):
        kept = np.delete(kept, repeated, axis=0)
    if len(kept) < len(indices):
        notices.append(
            f"{where}dropped {int(flat.sum())} triangles of zero area and {len(repeated)} "
            "repeated ones"
        )
    return np.ascontiguousarray(kept)


def unit_normals(
    normals: Float64Array,
    positions: Float64Array,
    indices: IntArray,
    notices: list[str],
    where: str = "",
) -> FloatArray:
    """Normalise shading normals, shape [vertex, 3]; note how many have no length.

    Those become the mean of their triangles. The other arguments are as of `drop_without_area`.
    """
    lost = np.linalg.norm(normals, axis=1) < 1e-20
    if not lost.any():
        return unit(normals)
    notices.append(f"{where}{int(lost.sum())} normals of length zero taken from the faces")
    a, b, c = (positions[indices[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    mean = np.zeros_like(normals)
    for k in range(3):
        np.add.at(mean, indices[:, k], area)
    normals = np.where(lost[:, None], mean, normals)
    # Vertices that no triangle uses, or a folded pair.
    still = np.linalg.norm(normals, axis=1, keepdims=True) < 1e-20
    return unit(np.where(still, [0.0, 1.0, 0.0], normals))


def unit(vectors: Float64Array) -> FloatArray:
    """Normalise the rows, shape [vertex, 3]; zeros stay, and so does what float32 calls unit.

    Stored unit vectors are 6e-8 off in length. Left alone, they read back as they were written.
    """
    with np.errstate(over="ignore"):  # beyond float32 is no unit vector either
        stored = vectors.astype(np.float32)
    is_unit = np.abs(np.linalg.norm(stored.astype(np.float64), axis=1, keepdims=True) - 1.0) < 1e-7
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    scaled = vectors / np.where(length > 0.0, length, 1.0)
    return np.where(is_unit, stored, scaled).astype(np.float32)


def check_triangle_count(where: Path, count: int, limits: Limits, more: str = "") -> None:
    """Refuse more triangles than the limit.

    Raises:
        InputError: There are more.
    """
    limits.check(
        "triangles", count, where, "too many triangles", more=more, advice="decimate the mesh"
    )


def check_drawable(where: Path, primitives: list[Primitive], found: str) -> None:
    """Refuse an asset without triangles, or beyond what float32 kernels can place.

    Raises:
        InputError: ``primitives`` is empty or a coordinate is not below ``EXTENT``.
    """
    if not primitives:
        raise MESH.error(where, "nothing_to_render", found=found, expected="triangles")
    largest = max(float(np.abs(p.positions).max()) for p in primitives)
    if not largest < EXTENT:
        raise MESH.error(where, "too_large", found=largest, limit=EXTENT)
