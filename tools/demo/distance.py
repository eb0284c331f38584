"""Signed distances for the demo's solids, and the surface on which one of them is 0."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from tools.demo.mesh import Surface, normalized
from warpir.core.arrays import Float64Array, Int64Array

Distance = Callable[[Float64Array, Float64Array, Float64Array], Float64Array]
"""Signed distance of x, y and z [m], which broadcast; negative inside [m]."""


def polygon_distance(points: ArrayLike, a: Float64Array, b: Float64Array) -> Float64Array:
    """Return the signed distance to a closed polygon, negative inside.

    Args:
        points: Corners in either order, shape [corner, 2].
        a: First coordinate of the queries, any shape.
        b: Second coordinate, broadcast against ``a``.
    """
    corners = np.asarray(points, dtype=np.float64)
    squared = np.full(np.broadcast_shapes(a.shape, b.shape), np.inf)
    inside = np.zeros(squared.shape, dtype=bool)
    for (a0, b0), (a1, b1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        da, db = a1 - a0, b1 - b0
        s = np.clip(((a - a0) * da + (b - b0) * db) / (da * da + db * db), 0.0, 1.0)
        squared = np.minimum(squared, (a - a0 - s * da) ** 2 + (b - b0 - s * db) ** 2)
        if db != 0.0:
            inside ^= ((b0 > b) != (b1 > b)) & (a < a0 + (b - b0) / db * da)
    distance: Float64Array = np.where(inside, -1.0, 1.0) * np.sqrt(squared)
    return distance


def round_intersection(a: Float64Array, b: Float64Array, radius: float) -> Float64Array:
    """Intersect two distances with an edge rounded to a radius [m]."""
    corner = np.hypot(np.maximum(a + radius, 0.0), np.maximum(b + radius, 0.0))
    joined: Float64Array = np.minimum(np.maximum(a, b), -radius) + corner
    return joined


def round_union(a: Float64Array, b: Float64Array, radius: float) -> Float64Array:
    """Join two distances with an inner edge filled to a radius [m]."""
    return -round_intersection(-a, -b, radius)


def gradient(distance: Distance, points: Float64Array, step: float = 1e-3) -> Float64Array:
    """Differentiate a distance by central differences, shape [point, 3]."""
    columns = []
    for shift in np.eye(3) * step:
        ahead, behind = points + shift, points - shift
        columns.append((distance(*ahead.T) - distance(*behind.T)) / (2.0 * step))
    return np.stack(columns, axis=1)


def project(distance: Distance, points: Float64Array, count: int = 3) -> Float64Array:
    """Move points onto the zero level of a distance by Newton steps, shape [point, 3]."""
    for _ in range(count):
        slope = gradient(distance, points)
        value = distance(*points.T)
        points = points - slope * (value / np.maximum((slope**2).sum(axis=1), 0.1))[:, None]
    return points


def mesh_distance(distance: Distance, low: ArrayLike, high: ArrayLike, step: float) -> Surface:
    """Mesh the zero level of a distance function (surface nets, Gibson 1998).

    One vertex per cell that the surface crosses, evened out along the surface and moved exactly
    onto it; normals are the gradient of the distance over half a cell, which hides the facets of
    distances made from polygons.

    Args:
        distance: Signed distance of broadcastable x, y, z [m], negative inside.
        low: Lowest corner of the grid, outside the solid [m].
        high: Highest corner [m].
        step: Edge of a cell [m].
    """
    origin = np.asarray(low, dtype=np.float64)
    counts = np.ceil((np.asarray(high) - origin) / step).astype(int) + 1
    x, y, z = (origin[k] + step * np.arange(counts[k]) for k in range(3))
    values = distance(x[:, None, None], y[None, :, None], z[None, None, :])

    # The vertex of a cell: the mean of the crossings on its twelve edges.
    cells = tuple(counts - 1)
    total, crossings = np.zeros((*cells, 3)), np.zeros(cells)
    quads = []
    number = np.full(cells, -1)
    for k in range(3):
        near = np.take(values, range(counts[k] - 1), axis=k)
        far = np.take(values, range(1, counts[k]), axis=k)
        crossed = (near < 0.0) != (far < 0.0)
        where = np.argwhere(crossed)
        point = where.astype(np.float64)
        point[:, k] += near[crossed] / (near[crossed] - far[crossed])
        i, j = (k + 1) % 3, (k + 2) % 3
        around = []
        for di, dj in ((-1, -1), (0, -1), (0, 0), (-1, 0)):
            cell = where.copy()
            cell[:, i] += di
            cell[:, j] += dj
            np.add.at(total, tuple(cell.T), point)
            np.add.at(crossings, tuple(cell.T), 1.0)
            around.append(cell)
        inward = (far[crossed] < 0.0)[:, None, None]
        ring = np.stack(around, axis=1)
        quads.append(np.where(inward, ring[:, ::-1], ring))
    occupied = crossings > 0.0
    number[occupied] = np.arange(np.count_nonzero(occupied))
    points = origin + step * total[occupied] / crossings[occupied][:, None]
    corners = np.concatenate(quads)
    quad = number[corners[..., 0], corners[..., 1], corners[..., 2]]

    points = _evened(distance, project(distance, points), quad)
    # Each quad is cut along its shorter diagonal, which keeps bent ones from folding.
    diagonals = [
        np.linalg.norm(points[quad[:, k]] - points[quad[:, k + 2]], axis=1) for k in (0, 1)
    ]
    quad = np.where((diagonals[1] < diagonals[0])[:, None], np.roll(quad, -1, axis=1), quad)
    triangles = np.concatenate([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return Surface(points, normalized(gradient(distance, points, 0.5 * step)), triangles)


def _evened(distance: Distance, points: Float64Array, quad: Int64Array) -> Float64Array:
    """Move each point toward the mean of its neighbours, and back onto the zero level."""
    edges = np.concatenate([quad[:, [k, (k + 1) % 4]] for k in range(4)])
    for _ in range(3):
        mean, degree = np.zeros_like(points), np.zeros((len(points), 1))
        np.add.at(mean, edges[:, 0], points[edges[:, 1]])
        np.add.at(degree, edges[:, 0], 1.0)
        points = project(distance, 0.5 * points + 0.5 * mean / degree, 2)
    return points
