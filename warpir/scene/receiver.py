"""Receiver mesh as plain triangles, and its ray intersection in float64.

Used before there is a renderer: for the point that a pixel shows, and for the visibility of lamps
from the ground. The kernels' half is `warpir.kernels.receiver_mesh`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warpir.core.arrays import Float64Array, Int64Array, IntArray
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera

CHUNK = 1 << 21
"""Number of pairs of a ray and a box, or a triangle, tested at once."""
WIDTH = 16
"""Boxes or triangles in a box."""
MORTON_BITS = 10
"""Of each coordinate of a triangle's place on the curve."""
SLACK = 1e-9
"""Share by which boxes are larger than what they hold, beyond all rounding."""


@dataclass(frozen=True)
class ReceiverMesh:
    """Two-sided triangles in the world."""

    positions: Float64Array
    """Vertex positions, world frame [m], shape [vertex, 3]."""
    indices: IntArray
    """Vertices of each triangle, shape [triangle, 3]."""

    @cached_property
    def tree(self) -> tuple[Int64Array, list[tuple[Float64Array, Float64Array]]]:
        """Order of the triangles along a Morton curve, and the boxes over them, level by level.

        Each box holds `WIDTH` triangles, or boxes of the level before; a level is the lows and the
        highs, shape [box, 3] each.
        """
        corners = self.positions[self.indices]
        low, high = corners.min(axis=1), corners.max(axis=1)
        middle = low + high
        cell = (middle - middle.min(axis=0)) / max(float(np.ptp(middle, axis=0).max()), 1e-300)
        cell = (cell * ((1 << MORTON_BITS) - 1)).astype(np.int64)
        code = np.zeros(len(cell), np.int64)
        for bit in range(MORTON_BITS):
            code |= (cell >> bit & 1) @ (1 << 3 * bit + np.arange(3))
        order = code.argsort(kind="stable")
        slack = SLACK * float(np.abs(self.positions).max())
        low, high, levels = low[order] - slack, high[order] + slack, []
        while len(low) > WIDTH:
            starts = np.arange(0, len(low), WIDTH)
            low, high = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
            levels.append((low, high))
        return order, levels


def mesh_of(asset: Asset) -> ReceiverMesh:
    """Return all triangles of an asset whose frame is the photo's world."""
    counts = [len(p.positions) for p in asset.primitives]
    offsets = np.cumsum([0, *counts[:-1]])
    return ReceiverMesh(
        np.concatenate([p.positions for p in asset.primitives]),
        np.concatenate(
            [p.indices + o for p, o in zip(asset.primitives, offsets, strict=True)]
        ).astype(np.int32),
    )


def first_hit(
    mesh: ReceiverMesh, origins: Float64Array, directions: Float64Array
) -> tuple[Float64Array, Int64Array]:
    """Return the distance of each ray's first hit, down the boxes of the mesh.

    Args:
        mesh: Triangles.
        origins: Starts of the rays, world frame [m], shape [ray, 3].
        directions: Directions of the rays, world frame, shape [ray, 3].

    Returns:
        Distances in lengths of ``directions``, infinite where nothing is met, and the triangles
        that are met, shape [ray] each.
    """
    nearest, triangle = np.full(len(origins), np.inf), np.zeros(len(origins), np.int64)
    if not len(mesh.indices):
        return nearest, triangle
    order, levels = mesh.tree
    counts = [len(order), *(len(low) for low, _ in levels)]

    def visit(rays: Int64Array, nodes: Int64Array, level: int) -> None:
        """Test pairs of a ray and a triangle (level 0) or a box, then what is in the box."""
        for start in range(0, len(rays), CHUNK // WIDTH):
            ray, node = (part[start : start + CHUNK // WIDTH] for part in (rays, nodes))
            if level == 0:
                met, hit = order[node], _reach(mesh, order[node], origins[ray], directions[ray])
                by = np.lexsort((met, hit, ray))
                by = by[np.unique(ray[by], return_index=True)[1]]
                ray, met, hit = ray[by], met[by], hit[by]
                # Of triangles as near, the first one, whatever the order of the boxes.
                is_new = (hit < nearest[ray]) | ((hit == nearest[ray]) & (met < triangle[ray]))
                nearest[ray[is_new]], triangle[ray[is_new]] = hit[is_new], met[is_new]
                continue
            low, high = (side[node] for side in levels[level - 1])
            enter, leave = _span(low, high, origins[ray], directions[ray])
            # Not the other way round: where a ray runs within a side, these are NaN.
            may = ~((enter > leave) | (leave < 0.0) | (enter > nearest[ray]))
            inside = node[may][:, None] * WIDTH + np.arange(WIDTH)
            there = inside < counts[level - 1]
            visit(np.repeat(ray[may], WIDTH)[there.ravel()], inside[there], level - 1)

    rays, nodes = np.indices((len(origins), counts[-1])).reshape(2, -1)
    visit(rays, nodes, len(levels))
    return nearest, triangle


def _span(
    low: Float64Array, high: Float64Array, origins: Float64Array, directions: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return where rays enter boxes and leave them, in lengths of the directions."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = (low - origins) / directions, (high - origins) / directions
    enter, leave = np.minimum(*sides).max(axis=1), np.maximum(*sides).min(axis=1)
    return enter * (1.0 - SLACK), leave * (1.0 + SLACK)


def _reach(
    mesh: ReceiverMesh, triangles: Int64Array, origins: Float64Array, directions: Float64Array
) -> Float64Array:
    """Return where each ray meets its triangle, or infinity (Moeller and Trumbore 1997)."""
    a, b, c = (mesh.positions[mesh.indices[triangles, k]] for k in range(3))
    e1, e2, s = b - a, c - a, origins - a
    p, q = np.cross(directions, e2), np.cross(s, e1)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / np.einsum("pc,pc->p", p, e1)
        u, v, t = (
            np.einsum("pc,pc->p", *pair) * inverse for pair in ((s, p), (directions, q), (q, e2))
        )
        met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0) & np.isfinite(t)
    return np.where(met, t, np.inf)


def is_in_view(mesh: ReceiverMesh, camera: Camera) -> bool:
    """Return whether a triangle may be seen: not all of its corners are beyond one of the edges."""
    local = (mesh.positions - camera.c2w[:3, 3]) @ camera.c2w[:3, :3]
    x, y, depth = local[:, 0], local[:, 1], -local[:, 2]
    beyond = (
        depth <= 0.0,
        camera.cx * depth + camera.fx * x < 0.0,
        camera.cx * depth + camera.fx * x > camera.width * depth,
        camera.cy * depth - camera.fy * y < 0.0,
        camera.cy * depth - camera.fy * y > camera.height * depth,
    )
    hidden = np.zeros(len(mesh.indices), bool)
    for side in beyond:
        hidden |= side[mesh.indices].all(axis=1)
    return bool((~hidden).any())
