"""Triangles of a scene: attributes in the world frame, complete, and their copies on a device."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.kernels.types import MeshArgs
from warpir.scene.asset import Primitive

Corners = tuple[Float64Array, Float64Array]
"""Lowest and highest corner of a box, world frame [m], shape [3] each."""
ATTRIBUTES = {
    "positions": wp.vec3,
    "normals": wp.vec3,
    "tangents": wp.vec4,
    "uv0": wp.vec2,
    "uv1": wp.vec2,
    "colors": wp.vec4,
}
"""What each vertex has, and its type on the device."""


@dataclass
class Vertices:
    """Attribute arrays of one primitive, world frame, one row a vertex."""

    positions: Float64Array
    indices: IntArray
    normals: Float64Array
    tangents: Float64Array
    uv0: FloatArray
    uv1: FloatArray
    colors: FloatArray


def _unit(v: Float64Array) -> Float64Array:
    """Normalise rows; a zero row stays zero."""
    length = np.linalg.norm(v, axis=1, keepdims=True)
    unit: Float64Array = v / np.where(length > 0.0, length, 1.0)
    return unit


def to_world(primitive: Primitive, matrix: Float64Array) -> Vertices:
    """Transform one primitive and fill in absent attributes."""
    linear = matrix[:3, :3]
    positions = primitive.positions @ linear.T + matrix[:3, 3]
    indices = primitive.indices
    # A mirror turns the winding around; normals and tangents follow the surface.
    if np.linalg.det(linear) < 0.0:
        indices = indices[:, ::-1]
    count = len(positions)
    uv0 = primitive.uv0 if primitive.uv0 is not None else np.zeros((count, 2), np.float32)
    uv1 = primitive.uv1 if primitive.uv1 is not None else uv0
    colors = primitive.colors if primitive.colors is not None else np.ones((count, 4), np.float32)
    tangents = np.zeros((count, 4))
    if primitive.tangents is not None:
        tangents[:, :3] = _unit(primitive.tangents[:, :3].astype(np.float64) @ linear.T)
        # A zero handedness means "derive the tangent from the UVs".
        tangents[:, 3] = np.where(primitive.tangents[:, 3] < 0.0, -1.0, 1.0)
        if np.linalg.det(linear) < 0.0:
            tangents[:, 3] *= -1.0
    if primitive.normals is not None:
        normals = _unit(primitive.normals.astype(np.float64) @ np.linalg.inv(linear))
        return Vertices(positions, indices, normals, tangents, uv0, uv1, colors)
    # Flat shading (glTF 2.0, 3.7.2.1): each triangle gets vertices of its own.
    corners = indices.reshape(-1)
    positions = positions[corners]
    a, b, c = positions[0::3], positions[1::3], positions[2::3]
    normals = np.repeat(_unit(np.cross(b - a, c - a)), 3, axis=0)
    own = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return Vertices(
        positions, own, normals, tangents[corners], uv0[corners], uv1[corners], colors[corners]
    )


def box_of(parts: Iterable[Vertices]) -> Corners | None:
    """Return the box of some triangles; None without any."""
    boxes = [(v.positions.min(axis=0), v.positions.max(axis=0)) for v in parts]
    if not boxes:
        return None
    lows, highs = zip(*boxes, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def triangle_args(
    parts: Sequence[tuple[Vertices, int]], origin: Float64Array, device: wp.Device
) -> MeshArgs:
    """Upload the attributes of all triangles; what finds hits among them is the scene's.

    Args:
        parts: Primitives, each with the index of its material.
        origin: World point that becomes the origin [m], shape [3].
        device: Warp device.

    Raises:
        ValueError: A triangle names a vertex that does not exist.
    """
    args = MeshArgs()
    if not parts:
        # Kernels look at the handle before they read anything, but arrays may not be empty.
        args.id = 0
        args.indices = wp.zeros(3, dtype=wp.int32, device=device)
        args.face_material = wp.zeros(1, dtype=wp.int32, device=device)
        for name, dtype in ATTRIBUTES.items():
            setattr(args, name, wp.zeros(1, dtype=dtype, device=device))
        return args
    offsets = np.cumsum([0] + [len(v.positions) for v, _ in parts])
    indices = np.concatenate(
        [v.indices + o for (v, _), o in zip(parts, offsets[:-1], strict=True)]
    ).astype(np.int32)
    if indices.min() < 0 or indices.max() >= offsets[-1]:
        raise ValueError(f"vertex index outside 0..{offsets[-1] - 1}")
    args.indices = wp.array(indices.reshape(-1), dtype=wp.int32, device=device)
    faces = np.concatenate([np.full(len(v.indices), m, np.int32) for v, m in parts])
    args.face_material = wp.array(faces, dtype=wp.int32, device=device)
    for name, dtype in ATTRIBUTES.items():
        rows = np.concatenate([getattr(v, name) for v, _ in parts])
        rows = rows - origin if name == "positions" else rows
        values = np.asarray(rows, np.float32)
        setattr(args, name, wp.array(values, dtype=dtype, device=device))
    return args
