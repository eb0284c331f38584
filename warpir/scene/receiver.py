"""Receiver mesh as plain triangles, and its ray intersection in float64.

Used before there is a renderer: for the point that a pixel shows, and for the visibility of lamps
from the ground. The kernels' half is `warpir.kernels.receiver_mesh`.
"""

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import Float64Array, Int64Array, IntArray
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera

CHUNK = 1 << 21
"""Number of ray-triangle pairs tested at once."""


@dataclass(frozen=True)
class ReceiverMesh:
    """Two-sided triangles in the world."""

    positions: Float64Array
    """Vertex positions, world frame [m], shape [vertex, 3]."""
    indices: IntArray
    """Vertices of each triangle, shape [triangle, 3]."""


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
    """Return the distance of each ray's first hit by brute force (Moeller and Trumbore 1997).

    Args:
        mesh: Triangles.
        origins: Starts of the rays, world frame [m], shape [ray, 3].
        directions: Directions of the rays, world frame, shape [ray, 3].

    Returns:
        Distances in lengths of ``directions``, infinite where nothing is met, and the triangles
        that are met, shape [ray] each.
    """
    rays = np.arange(len(origins))
    nearest, triangle = np.full(len(origins), np.inf), np.zeros(len(origins), np.int64)
    size = max(1, CHUNK // max(len(origins), 1))
    for start in range(0, len(mesh.indices), size):
        a, b, c = (mesh.positions[mesh.indices[start : start + size, k]] for k in range(3))
        e1, e2 = b - a, c - a
        p = np.cross(directions[:, None], e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1.0 / np.einsum("rtc,tc->rt", p, e1)
            s = origins[:, None] - a
            u = np.einsum("rtc,rtc->rt", s, p) * inverse
            q = np.cross(s, e1)
            v = np.einsum("rc,rtc->rt", directions, q) * inverse
            t = np.einsum("rtc,tc->rt", q, e2) * inverse
            met = (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0) & np.isfinite(t)
        t = np.where(met, t, np.inf)
        best = t.argmin(axis=1)
        triangle = np.where(t[rays, best] < nearest, start + best, triangle)
        nearest = np.minimum(nearest, t[rays, best])
    return nearest, triangle


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
