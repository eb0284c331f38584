"""Objects to learn from: made-up shapes of several families, and assets.

Every mesh stands on ``y = 0``, is centred, and its longest side is 1. Its corners have normals of
their own and its faces one albedo each: pictures of 64 pixels show no more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.color import srgb_to_linear
from warpir.io.assets import load_asset
from warpir.scene.asset import Asset, Material, Primitive

Random = np.random.Generator

ASSET_NOUNS = {
    "car": "car", "truck": "truck", "spot": "cow", "mug": "mug", "cake": "cake", "ball": "ball",
    "wicker": "ball", "wheel": "toy",
}  # fmt: skip
"""What a file is called by a part of its name; others are "object"."""


@dataclass(frozen=True)
class TrainingMesh:
    """One object."""

    noun: str
    vertices: FloatArray
    """Shape [vertex, 3]."""
    faces: IntArray
    """Shape [face, 3]."""
    normals: FloatArray
    """Of the corners, shape [face, 3, 3]."""
    albedo: FloatArray
    """Linear, shape [face, 3]."""


@dataclass(frozen=True)
class _Part:
    mesh: trimesh.Trimesh
    is_smooth: bool
    color: tuple[float, ...]


def _joined(noun: str, parts: Iterable[_Part]) -> TrainingMesh:
    vertices, faces, normals, albedo, count = [], [], [], [], 0
    for part in parts:
        mesh = part.mesh
        corner = mesh.vertex_normals[mesh.faces] if part.is_smooth else mesh.face_normals[:, None]
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + count)
        normals.append(np.broadcast_to(corner, (len(mesh.faces), 3, 3)))
        albedo.append(np.broadcast_to(part.color, (len(mesh.faces), 3)))
        count += len(mesh.vertices)
    return _normalised(
        noun,
        np.concatenate(vertices),
        np.concatenate(faces),
        np.concatenate(normals),
        np.concatenate(albedo),
    )


def _normalised(
    noun: str,
    vertices: NDArray[np.floating],
    faces: NDArray[np.integer],
    normals: NDArray[np.floating],
    albedo: NDArray[np.floating],
) -> TrainingMesh:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle = 0.5 * (low + high)
    middle[1] = low[1]
    placed = (vertices - middle) / max(float((high - low).max()), 1e-9)
    return TrainingMesh(
        noun,
        np.ascontiguousarray(placed, np.float32),
        np.ascontiguousarray(faces, np.int32),
        np.ascontiguousarray(normals, np.float32),
        np.ascontiguousarray(albedo, np.float32),
    )


def _color(random: Random) -> tuple[float, ...]:
    return tuple(random.uniform(0.04, 0.85) * random.uniform(0.25, 1.0, 3))


def _box(random: Random, size: tuple[float, ...], at: tuple[float, ...]) -> _Part:
    mesh = trimesh.creation.box(size)
    mesh.apply_translation(at)
    return _Part(mesh, False, _color(random))


def _column(random: Random, radius: float, height: float, at: tuple[float, ...]) -> _Part:
    mesh = trimesh.creation.cylinder(radius, height, sections=20)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [1, 0, 0]))
    mesh.apply_translation(at)
    # The caps of a smooth cylinder would be shaded round; twenty flat sides are round enough.
    return _Part(mesh, False, _color(random))


def _egg(random: Random, half: tuple[float, ...], at: tuple[float, ...]) -> _Part:
    mesh = trimesh.creation.icosphere(3)
    mesh.apply_scale(half)
    mesh.apply_translation(at)
    return _Part(mesh, True, _color(random))


def _ball(r: Random) -> TrainingMesh:
    return _joined("ball", [_egg(r, (1.0, r.uniform(0.7, 1.2), 1.0), (0, 0, 0))])


def _crate(r: Random) -> TrainingMesh:
    return _joined("box", [_box(r, tuple(r.uniform(0.4, 1.2, 3)), (0, 0, 0))])


def _stack(r: Random) -> TrainingMesh:
    parts, y = [], 0.0
    for _ in range(int(r.integers(2, 5))):
        size = r.uniform(0.3, 1.0, 3)
        x, z = r.uniform(-0.15, 0.15, 2)
        parts.append(_box(r, tuple(size), (x, y + size[1] / 2.0, z)))
        y += size[1]
    return _joined("box", parts)


def _table(r: Random) -> TrainingMesh:
    w, d, h = r.uniform(0.5, 1.2), r.uniform(0.4, 0.9), r.uniform(0.35, 0.9)
    leg = r.uniform(0.04, 0.1)
    corners = [(x * (w - leg) / 2, h / 2, z * (d - leg) / 2) for x in (-1, 1) for z in (-1, 1)]
    parts = [_box(r, (w, 0.06, d), (0, h, 0)), *(_box(r, (leg, h, leg), c) for c in corners)]
    if r.random() < 0.5:
        parts.append(_box(r, (w, r.uniform(0.3, 0.7), 0.06), (0, h + 0.25, -d / 2)))
        return _joined("chair", parts)
    return _joined("table", parts)


def _car(r: Random) -> TrainingMesh:
    length, width, body = 1.0, r.uniform(0.38, 0.46), r.uniform(0.13, 0.2)
    wheel = r.uniform(0.08, 0.11)
    color = _color(r)
    lower = _box(r, (length, body, width), (0, wheel + body / 2, 0))
    cabin_length, cabin = r.uniform(0.4, 0.65), r.uniform(0.12, 0.18)
    top = trimesh.creation.box((cabin_length, cabin, width * 0.9))
    taper = np.where(top.vertices[:, 1] > 0, r.uniform(0.6, 0.9), 1.0)
    top.vertices[:, 0] *= taper
    top.vertices[:, 2] *= 0.5 + 0.5 * taper
    top.apply_translation((r.uniform(-0.1, 0.05), wheel + body + cabin / 2, 0))
    parts = [_Part(lower.mesh, False, color), _Part(top, False, color)]
    for x in (-0.3, 0.3):
        for z in (-1, 1):
            tyre = trimesh.creation.cylinder(wheel, 0.08, sections=18)
            tyre.apply_translation((x, wheel, z * width / 2))
            parts.append(_Part(tyre, False, (0.03, 0.03, 0.03)))
    return _joined("car", parts)


def _tree(r: Random) -> TrainingMesh:
    trunk = r.uniform(0.2, 0.5)
    parts = [_column(r, r.uniform(0.03, 0.07), trunk, (0, trunk / 2, 0))]
    for _ in range(int(r.integers(1, 4))):
        half = r.uniform(0.15, 0.35, 3)
        x, z = r.uniform(-0.12, 0.12, 2)
        parts.append(_egg(r, tuple(half), (x, trunk + r.uniform(0.05, 0.4), z)))
    return _joined("tree", parts)


def _animal(r: Random) -> TrainingMesh:
    body = r.uniform([0.3, 0.14, 0.12], [0.45, 0.24, 0.2])
    leg = r.uniform(0.15, 0.35)
    y = leg + body[1] * 0.8
    parts = [_egg(r, tuple(body), (0, y, 0))]
    head = r.uniform(0.09, 0.16)
    parts.append(_egg(r, (head * 1.3, head, head), (body[0] * 1.05, y + body[1] * 0.9, 0)))
    for x in (-0.6, 0.6):
        for z in (-0.6, 0.6):
            parts.append(_column(r, 0.04, leg, (x * body[0], leg / 2, z * body[2])))
    return _joined("animal", parts)


def _mug(r: Random) -> TrainingMesh:
    height = r.uniform(0.7, 1.3)
    wall = trimesh.creation.annulus(0.42, 0.5, height, sections=32)
    handle = trimesh.creation.torus(height * 0.28, 0.07, major_sections=24, minor_sections=10)
    handle.apply_translation((0.55, 0, 0))
    for part in (wall,):
        part.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2.0, [1, 0, 0]))
    color = _color(r)
    floor = _column(r, 0.45, 0.06, (0, -height / 2 + 0.03, 0))
    return _joined(
        "mug",
        [_Part(wall, False, color), _Part(handle, True, color), _Part(floor.mesh, False, color)],
    )


def _lamp(r: Random) -> TrainingMesh:
    height = r.uniform(0.6, 1.0)
    shade = trimesh.creation.cone(r.uniform(0.15, 0.3), r.uniform(0.2, 0.4), sections=24)
    shade.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2.0, [1, 0, 0]))
    shade.apply_translation((0, height, 0))
    return _joined(
        "lamp",
        [
            _column(r, 0.18, 0.05, (0, 0.025, 0)),
            _column(r, 0.025, height, (0, height / 2, 0)),
            _Part(shade, False, _color(r)),
        ],
    )


def _statue(r: Random) -> TrainingMesh:
    """Return a lump: a sphere pushed in and out by a few waves, on a plinth."""
    mesh = trimesh.creation.icosphere(4)
    push = np.ones(len(mesh.vertices))
    for _ in range(4):
        push += r.uniform(0.05, 0.2) * np.sin(mesh.vertices @ r.normal(0, 2.5, 3) + r.uniform(0, 6))
    mesh.vertices *= push[:, None] * np.array([0.35, r.uniform(0.4, 0.7), 0.35])
    mesh.apply_translation((0, 0.7, 0))
    return _joined("statue", [_Part(mesh, True, _color(r)), _box(r, (0.5, 0.15, 0.5), (0, 0.1, 0))])


def _building(r: Random) -> TrainingMesh:
    w, h, d = r.uniform([0.5, 0.4, 0.5], [1.0, 1.0, 1.0])
    roof = trimesh.creation.cone(0.75 * max(w, d), r.uniform(0.2, 0.4), sections=4)
    roof.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2.0, [1, 0, 0]))
    roof.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4.0, [0, 1, 0]))
    roof.apply_translation((0, h, 0))
    return _joined("building", [_box(r, (w, h, d), (0, h / 2, 0)), _Part(roof, False, _color(r))])


FAMILIES: tuple[Callable[[Random], TrainingMesh], ...] = (
    _ball, _crate, _stack, _table, _car, _car, _tree, _animal, _mug, _lamp, _statue, _building,
)  # fmt: skip


def make_meshes(count: int, seed: int) -> list[TrainingMesh]:
    """Make up objects, the families in turn; the same for the same seed."""
    return [FAMILIES[k % len(FAMILIES)](np.random.default_rng((seed, k))) for k in range(count)]


def read_meshes(paths: Iterable[Path]) -> list[TrainingMesh]:
    """Read assets.

    Raises:
        InputError: One cannot be used.
    """
    return [mesh_of(load_asset(path, missing_textures="grey"), path.stem) for path in paths]


def mesh_of(asset: Asset, name: str) -> TrainingMesh:
    """Return an asset as a training mesh."""
    noun = next((noun for part, noun in ASSET_NOUNS.items() if part in name.lower()), "object")
    vertices, faces, normals, albedo, count = [], [], [], [], 0
    for primitive in asset.primitives:
        corners = primitive.positions[primitive.indices]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-30)
        own = primitive.normals
        corner = np.broadcast_to(flat[:, None], corners.shape)
        vertices.append(primitive.positions)
        faces.append(primitive.indices + count)
        normals.append(corner if own is None else own[primitive.indices])
        albedo.append(_face_albedo(asset, asset.materials[primitive.material], primitive))
        count += len(primitive.positions)
    return _normalised(
        noun,
        np.concatenate(vertices),
        np.concatenate(faces),
        np.concatenate(normals),
        np.concatenate(albedo),
    )


def _face_albedo(asset: Asset, material: Material, primitive: Primitive) -> Float64Array:
    """Return the base colour in the middle of each face, linear, shape [face, 3]."""
    albedo = np.broadcast_to(material.base_color, (len(primitive.indices), 3)).astype(np.float64)
    slot = material.base_color_texture
    uv = primitive.uv0 if slot is None or slot.uv_set == 0 else primitive.uv1
    if primitive.colors is not None:
        albedo = albedo * primitive.colors[primitive.indices][..., :3].mean(axis=1)
    if slot is None or uv is None:
        return albedo
    a, b, c, d, e, f = slot.transform
    u, v = uv[primitive.indices].mean(axis=1).T
    pixels = asset.textures[slot.texture].pixels
    rows, columns = pixels.shape[:2]
    x = np.floor((a * u + b * v + c) * columns).astype(np.int64) % columns
    y = np.floor((d * u + e * v + f) * rows).astype(np.int64) % rows
    return albedo * srgb_to_linear(pixels[y, x, :3].astype(np.float64) / 255.0)
