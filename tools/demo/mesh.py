"""Surfaces for the demo: joining and cutting them, and a few swept solids.

Every function returns triangles counter-clockwise seen from outside, with smooth unit normals and
vertices doubled where an edge is meant to be sharp.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from warpir.core.arrays import BoolArray, Float64Array, Int64Array
from warpir.scene.asset import Primitive

CREASE_COS = np.cos(np.radians(35.0))
"""Profile corners sharper than this get one normal per side."""


@dataclass(frozen=True)
class Surface:
    """Triangles with shading normals."""

    positions: Float64Array
    """Position [m], shape [vertex, 3]."""
    normals: Float64Array
    """Unit shading normals, shape [vertex, 3]."""
    triangles: Int64Array
    """Counter-clockwise seen from outside, shape [triangle, 3]."""
    uv: Float64Array | None = None
    """Texture coordinates, v down, shape [vertex, 2]."""

    def moved(self, offset: ArrayLike) -> "Surface":
        """Return the surface shifted by an offset [m], shape [3]."""
        return replace(self, positions=self.positions + np.asarray(offset, dtype=np.float64))

    def primitive(self, material: int) -> Primitive:
        """Return the surface as an asset holds it."""
        return Primitive(
            self.positions,
            self.triangles.astype(np.int32),
            material,
            self.normals.astype(np.float32),
            uv0=None if self.uv is None else self.uv.astype(np.float32),
        )

    def turned(self, rotation: Float64Array) -> "Surface":
        """Return the surface turned by a rotation matrix, shape [3, 3]."""
        return replace(
            self, positions=self.positions @ rotation.T, normals=self.normals @ rotation.T
        )

    def mirrored(self) -> "Surface":
        """Return the mirror image in the plane x = 0."""
        flip = np.array([-1.0, 1.0, 1.0])
        return replace(
            self,
            positions=self.positions * flip,
            normals=self.normals * flip,
            triangles=self.triangles[:, ::-1],
        )

    def where(self, keep: BoolArray) -> "Surface":
        """Return the triangles that are kept, shape [triangle], without unused vertices."""
        used, inverse = np.unique(self.triangles[keep], return_inverse=True)
        return Surface(
            self.positions[used],
            self.normals[used],
            inverse.reshape(-1, 3),
            None if self.uv is None else self.uv[used],
        )


def weld(surface: Surface) -> Surface:
    """Share the vertices that agree in position, normal and texture coordinates."""
    columns = [surface.positions, surface.normals]
    if surface.uv is not None:
        columns.append(surface.uv)
    rounded = np.round(np.concatenate(columns, axis=1), 6)
    _, first, inverse = np.unique(rounded, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.arange(len(order))
    kept = first[order]
    return Surface(
        surface.positions[kept],
        surface.normals[kept],
        number[inverse.ravel()][surface.triangles],
        None if surface.uv is None else surface.uv[kept],
    )


def rotation(axis: str, degrees: float) -> Float64Array:
    """Return the matrix that turns by an angle [deg] about ``x``, ``y`` or ``z``."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = c
    matrix[i, j], matrix[j, i] = -s, s
    return matrix


def merge(surfaces: Iterable[Surface]) -> Surface:
    """Join surfaces into one; texture coordinates survive only if all of them have some."""
    parts = list(surfaces)
    starts = np.cumsum([0] + [len(p.positions) for p in parts[:-1]])
    coordinates = [p.uv for p in parts if p.uv is not None]
    return Surface(
        np.concatenate([p.positions for p in parts]),
        np.concatenate([p.normals for p in parts]),
        np.concatenate([p.triangles + start for p, start in zip(parts, starts, strict=True)]),
        np.concatenate(coordinates) if len(coordinates) == len(parts) else None,
    )


def both_sides(surface: Surface) -> Surface:
    """Join a surface with its mirror image in the plane x = 0."""
    return merge([surface, surface.mirrored()])


def normalized(vectors: Float64Array) -> Float64Array:
    """Scale vectors to unit length along the last axis."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Float64Array = vectors / np.maximum(length, 1e-12)
    return unit


def spline(points: ArrayLike, count: int, closed: bool = False) -> Float64Array:
    """Sample a Catmull-Rom curve through control points.

    Args:
        points: Control points, shape [point, dimension].
        count: Samples per span.
        closed: Whether the last point is joined to the first.

    Returns:
        Curve points, shape [sample, dimension].
    """
    p = np.asarray(points, dtype=np.float64)
    if closed:
        p = np.concatenate([p[-1:], p, p[:2]])
    else:
        p = np.concatenate([2.0 * p[:1] - p[1:2], p, 2.0 * p[-1:] - p[-2:-1]])
    t = np.arange(count)[:, None] / count
    spans = [
        0.5
        * (
            2.0 * b
            + (c - a) * t
            + (2.0 * a - 5.0 * b + 4.0 * c - d) * t**2
            + (3.0 * b - a - 3.0 * c + d) * t**3
        )
        for a, b, c, d in zip(p, p[1:], p[2:], p[3:], strict=False)
    ]
    if not closed:
        spans.append(p[-2:-1])
    return np.concatenate(spans)


def split(surface: Surface, values: Float64Array) -> tuple[Surface, Surface]:
    """Cut a surface along the zero line of a function given at its vertices, shape [vertex].

    Returns:
        The part where the function is negative, and the rest.
    """
    size = np.linalg.norm(np.ptp(surface.positions[surface.triangles], axis=1), axis=1).mean()
    values = np.where(np.abs(values) < 0.04 * size, 0.0, values)
    side = np.sign(values)[surface.triangles]
    crossed = (side.min(axis=1) < 0) & (side.max(axis=1) > 0)

    # New vertices, one per crossed edge.
    triangles = surface.triangles[crossed]
    edges = np.sort(np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)]), axis=1)
    edges = np.unique(edges[values[edges[:, 0]] * values[edges[:, 1]] < 0.0], axis=0)
    start = len(surface.positions)
    added = {(int(a), int(b)): start + k for k, (a, b) in enumerate(edges)}
    a, b = edges[:, 0], edges[:, 1]
    s = (values[a] / (values[a] - values[b]))[:, None]

    def between(values: Float64Array) -> Float64Array:
        return (1.0 - s) * values[a] + s * values[b]

    positions = np.concatenate([surface.positions, between(surface.positions)])
    normals = np.concatenate([surface.normals, normalized(between(surface.normals))])
    uv = None if surface.uv is None else np.concatenate([surface.uv, between(surface.uv)])

    # Each crossed triangle becomes a polygon on either side, cut into a fan.
    pieces: tuple[list[list[int]], list[list[int]]] = ([], [])
    for triangle in triangles:
        below: list[int] = []
        above: list[int] = []
        for k in range(3):
            p, q = int(triangle[k]), int(triangle[(k + 1) % 3])
            if values[p] <= 0.0:
                below.append(p)
            if values[p] >= 0.0:
                above.append(p)
            if values[p] * values[q] < 0.0:
                below.append(added[min(p, q), max(p, q)])
                above.append(added[min(p, q), max(p, q)])
        for polygon, into in zip((below, above), pieces, strict=True):
            into.extend(
                [polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1)
            )
    whole = surface.triangles[~crossed]
    negative = side[~crossed].min(axis=1) < 0
    parts = []
    for kept, cut in ((whole[negative], pieces[0]), (whole[~negative], pieces[1])):
        both = np.concatenate([kept, np.array(cut, dtype=np.int64).reshape(-1, 3)])
        part = Surface(positions, normals, both, uv)
        parts.append(part.where(np.ones(len(both), dtype=bool)))
    return parts[0], parts[1]


def grid(positions: Float64Array, normals: Float64Array, uv: Float64Array | None = None) -> Surface:
    """Join a grid of points, shape [row, column, 3], into triangles that face their normals."""
    rows, columns = positions.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    points, unit = positions.reshape(-1, 3), normalized(normals.reshape(-1, 3))
    p, q, r = (points[triangles[:, k]] for k in range(3))
    area = np.cross(q - p, r - p)
    backward = (area * unit[triangles].sum(axis=1)).sum(axis=1) < 0.0
    triangles = np.where(backward[:, None], triangles[:, ::-1], triangles)
    surface = Surface(points, unit, triangles, None if uv is None else uv.reshape(-1, 2))
    return surface.where(np.linalg.norm(area, axis=1) > 1e-12)


def flat(positions: Float64Array, normal: ArrayLike) -> Surface:
    """Join a plane grid of points, shape [row, column, 3], that faces one normal."""
    return grid(positions, np.broadcast_to(np.asarray(normal, dtype=np.float64), positions.shape))


def lathe(profile: ArrayLike, segments: int) -> Surface:
    """Turn a profile about the x axis.

    Args:
        profile: Points (x, radius) [m] in order; outside lies to the left of the walk, seen
            with x to the right and the radius upward; shape [point, 2].
        segments: Facets around the axis.
    """
    p = np.asarray(profile, dtype=np.float64)
    span = p[1:] - p[:-1]
    outward = normalized(np.stack([-span[:, 1], span[:, 0]], axis=1))
    rows: list[tuple[Float64Array, Float64Array]] = [(p[0], outward[0])]
    strips = []
    for k in range(1, len(p)):
        last = k == len(p) - 1
        smooth = not last and float(outward[k - 1] @ outward[k]) > CREASE_COS
        normal = outward[k - 1] + outward[k] if smooth else outward[k - 1]
        rows.append((p[k], normalized(normal)))
        if not smooth:
            strips.append(rows)
            rows = [] if last else [(p[k], outward[k])]
    angle = np.linspace(0.0, 2.0 * np.pi, segments + 1)
    c, s = np.cos(angle), np.sin(angle)
    surfaces = []
    for strip in strips:
        points = [np.stack([np.full_like(c, q[0]), q[1] * c, q[1] * s], 1) for q, _ in strip]
        normals = [np.stack([np.full_like(c, n[0]), n[1] * c, n[1] * s], 1) for _, n in strip]
        surfaces.append(grid(np.stack(points), np.stack(normals)))
    return merge(surfaces)


def tube(
    path: ArrayLike,
    radius: ArrayLike,
    sides: int = 10,
    *,
    up: ArrayLike = (0.0, 1.0, 0.0),
    aspect: float = 1.0,
    closed: bool = False,
) -> Surface:
    """Sweep an ellipse along a path; open ends are rounded.

    Args:
        path: Centre line [m], shape [point, 3].
        radius: Half width across ``up`` [m], one number or one per point.
        sides: Facets around the path.
        up: Direction, not along the path, in which the ellipse is ``aspect`` times as wide.
        aspect: Ratio of the ellipse's axes [1].
        closed: Whether the path returns to its start.
    """
    p = np.asarray(path, dtype=np.float64)
    r = np.broadcast_to(np.asarray(radius, dtype=np.float64), len(p))
    if closed:
        ahead = normalized(np.roll(p, -1, axis=0) - np.roll(p, 1, axis=0))
        ahead, p, r = np.r_[ahead, ahead[:1]], np.r_[p, p[:1]], np.r_[r, r[:1]]
        tilt = np.zeros(len(p))
    else:
        ahead = normalized(np.gradient(p, axis=0))
        bend = np.sin(np.radians([90.0, 60.0, 30.0]))
        out = np.cos(np.radians([90.0, 60.0, 30.0]))
        p = np.concatenate(
            [
                p[:1] - ahead[:1] * r[0] * bend[:, None],
                p,
                p[-1:] + ahead[-1:] * r[-1] * bend[::-1, None],
            ]
        )
        r = np.concatenate([r[0] * out, r, r[-1] * out[::-1]])
        tilt = np.concatenate([-bend, np.zeros(len(ahead)), bend[::-1]])
        ahead = np.concatenate([np.repeat(ahead[:1], 3, 0), ahead, np.repeat(ahead[-1:], 3, 0)])
    side = normalized(np.cross(np.asarray(up, dtype=np.float64), ahead))
    over = np.cross(ahead, side)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)[None, :, None]
    ring = np.cos(angle) * side[:, None] + aspect * np.sin(angle) * over[:, None]
    normal = np.cos(angle) * side[:, None] + np.sin(angle) / aspect * over[:, None]
    cap = np.sqrt(1.0 - tilt**2)[:, None, None]
    normal = cap * normalized(normal) + (tilt[:, None] * ahead)[:, None]
    return grid(p[:, None] + r[:, None, None] * ring, normal)


def rounded_box(center: ArrayLike, half: ArrayLike, radius: float, steps: int = 3) -> Surface:
    """Return a box with rounded edges.

    Args:
        center: Centre [m], shape [3].
        half: Half edges [m], shape [3].
        radius: Radius of the edges [m].
        steps: Facets per quarter turn.
    """
    quarter = np.linspace(0.0, 0.5 * np.pi, steps + 1)
    lon = np.concatenate([quarter + 0.5 * np.pi * k for k in range(4)] + [np.zeros(1)])
    sx = np.concatenate([np.full(steps + 1, s) for s in (1.0, -1.0, -1.0, 1.0)] + [np.ones(1)])
    sz = np.concatenate([np.full(steps + 1, s) for s in (1.0, 1.0, -1.0, -1.0)] + [np.ones(1)])
    lat = np.concatenate([quarter[::-1], -quarter])
    sy = np.repeat([1.0, -1.0], steps + 1)
    normal = np.stack(
        [
            np.cos(lat)[:, None] * np.cos(lon),
            np.sin(lat)[:, None] + 0.0 * lon,
            np.cos(lat)[:, None] * np.sin(lon),
        ],
        axis=2,
    )
    sign = np.stack(np.broadcast_arrays(sx[None], sy[:, None], sz[None]), axis=2)
    core = np.asarray(half, dtype=np.float64) - radius
    points = np.asarray(center, dtype=np.float64) + sign * core + radius * normal
    # The poles are flat faces: rings of one height, closed by a point in the middle.
    top, bottom = points[:1].mean(1, keepdims=True), points[-1:].mean(1, keepdims=True)
    points = np.concatenate([np.repeat(top, len(lon), 1), points, np.repeat(bottom, len(lon), 1)])
    normal = np.concatenate([normal[:1], normal, normal[-1:]])
    return grid(points, normal)


def ellipsoid(center: ArrayLike, half: ArrayLike, steps: int = 16) -> Surface:
    """Return an ellipsoid of half axes ``half`` [m] about ``center`` [m]."""
    lat = np.linspace(0.5 * np.pi, -0.5 * np.pi, steps + 1)[:, None]
    lon = np.linspace(0.0, 2.0 * np.pi, 2 * steps + 1)[None]
    unit = np.stack(
        [np.cos(lat) * np.cos(lon), np.sin(lat) + 0.0 * lon, np.cos(lat) * np.sin(lon)], axis=2
    )
    axes = np.asarray(half, dtype=np.float64)
    return grid(np.asarray(center) + unit * axes, unit / axes)


def quad(
    corner: ArrayLike, right: ArrayLike, down: ArrayLike, tile: float | None = None
) -> Surface:
    """Return a flat rectangle seen from the front.

    Args:
        corner: Top left corner [m], shape [3].
        right: Vector along the top edge [m], shape [3].
        down: Vector along the left edge [m], shape [3].
        tile: Edge of one texture tile [m]; one tile fills the rectangle when absent.
    """
    p, u, v = (np.asarray(k, dtype=np.float64) for k in (corner, right, down))
    points = np.array([[p, p + u], [p + v, p + u + v]])
    across = 1.0 if tile is None else float(np.linalg.norm(u)) / tile
    along = 1.0 if tile is None else float(np.linalg.norm(v)) / tile
    uv = np.array([[[0.0, 0.0], [across, 0.0]], [[0.0, along], [across, along]]])
    return grid(points, np.broadcast_to(np.cross(v, u), points.shape), uv)
