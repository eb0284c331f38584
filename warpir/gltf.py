"""Reads glTF 2.0 into an `Asset`: the scene graph and the geometry.

`warpir.gltf_file` is the gate that checks the container and every number; this module says what
the numbers mean, together with `warpir.gltf_material`. Each drawn primitive of each mesh instance
becomes one `Primitive` in the asset's frame (right-handed, +Y up, front +Z, metres). Lights,
cameras, skins and animations are not read.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.asset import Asset, FloatArray, Primitive
from warpir.asset_files import (
    EXTENT,
    TRIANGLES,
    check_drawable,
    concise,
    keep_area,
    repair_normals,
    unit,
)
from warpir.gltf_file import Entry, GltfFile
from warpir.gltf_material import MaterialReader, check_extensions

NODES = 100_000
"""Most nodes of a file."""
INSTANCES = 65_536
"""Most placed primitives."""

POINTS_OR_LINES = (0, 1, 2, 3)
STRIP, FAN = 5, 6
Matrix = NDArray[np.float64]


def read_gltf(path: str | Path, missing_textures: str = "error") -> Asset:
    """Read a ``.glb`` or ``.gltf`` file.

    Args:
        path: The file; everything it refers to must lie in its folder.
        missing_textures: ``error``, or ``grey``: a base colour texture that cannot be read becomes
            grey, any other is left out, with a notice.

    Returns:
        The drawn scene, instances flattened, rest pose.

    Raises:
        InputError: The file is damaged or cannot be represented faithfully; names the JSON
            pointer at fault.
    """
    path = Path(path)
    notices: list[str] = []
    file = GltfFile(path)
    check_extensions(file.root, notices)
    placed = list(placed_primitives(file.root, notices))
    check_counts(file, placed)
    materials = MaterialReader(file, missing_textures, notices)
    geometries: dict[str, Geometry | None] = {}
    material_of: dict[str, int] = {}
    primitives: list[Primitive] = []
    for entry, world in placed:
        key = entry.pointer
        if key not in geometries:
            material_of[key] = materials.index(entry)
            uv_sets = materials.uv_sets(material_of[key])
            geometries[key] = read_geometry(file, entry, uv_sets, notices)
        geometry = geometries[key]
        if geometry is not None:
            primitives.append(place(geometry, world, material_of[key]))
    check_drawable(path, primitives, f"{len(placed)} placed primitives, none with triangles")
    return Asset(
        name=path.stem,
        primitives=tuple(primitives),
        materials=tuple(materials.materials),
        textures=tuple(materials.textures),
        notices=concise(notices),
    )


def placed_primitives(root: Entry, notices: list[str]) -> Iterator[tuple[Entry, Matrix]]:
    """Walk the scene and yield every drawable primitive with its matrix.

    Args:
        root: The file.
        notices: Receives what is left out.

    Yields:
        The primitive and the matrix from its frame to the asset's, shape [4, 4].

    Raises:
        InputError: The nodes are not a forest, or a drawn transform is singular.
    """
    nodes, parents = read_forest(root)
    listed = scene_nodes(root, nodes, parents, notices)
    if root.size("animations"):
        notices.append("animations are not played: the rest pose is used")
    instance_count = 0
    stack = [(index, np.eye(4), False) for index in range(len(nodes)) if index not in parents]
    stack.reverse()
    while stack:
        index, parent, drawn = stack.pop()
        node = nodes[index]
        visibility = node.extension("KHR_node_visibility")
        if visibility is not None and "visible" in visibility and not visibility.flag("visible"):
            notices.append(f"{node.pointer}: hidden by KHR_node_visibility")
            continue
        with np.errstate(over="ignore", invalid="ignore"):  # `check_invertible` refuses such sizes
            world = parent @ local_matrix(node)
        drawn = drawn or index in listed
        stack += [(child, world, drawn) for child in reversed(node.integers("children"))]
        if not drawn or "mesh" not in node:
            continue
        check_invertible(node, world)
        if "skin" in node:
            notices.append(f"{node.pointer}: skin ignored, the mesh is used as stored")
        mesh = root.item("meshes", node.integer("mesh"), node, "mesh")
        for primitive in mesh.items("primitives"):
            if primitive.integer("mode", 4) in POINTS_OR_LINES:
                notices.append(f"{primitive.pointer}: points or lines are not drawn")
                continue
            instance_count += 1
            if instance_count > INSTANCES:
                raise root.error(f"too many instances (limit {INSTANCES} placed primitives)")
            yield primitive, world


def read_forest(root: Entry) -> tuple[list[Entry], dict[int, int]]:
    """Return all nodes, and the parent of each node that has one.

    Raises:
        InputError: Too many nodes, a child out of range, two parents, or a cycle.
    """
    count = root.size("nodes")
    if count > NODES:
        raise root.error(f"too many nodes (found {count}; limit {NODES})")
    nodes = list(root.items("nodes"))
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.integers("children"):
            if child >= count:
                raise node.error(f"child {child}, but {count} nodes")
            if child in parents:
                raise node.error(f"child {child} is already a child of node {parents[child]}")
            parents[child] = index
    # Every node has at most one parent, so whatever the roots do not reach is a cycle.
    reached = 0
    stack = [index for index in range(count) if index not in parents]
    while stack:
        reached += 1
        stack += nodes[stack.pop()].integers("children")
    if reached < count:
        raise root.error(f"the nodes form a cycle ({count - reached} nodes hang on no root)")
    return nodes, parents


def scene_nodes(
    root: Entry, nodes: list[Entry], parents: dict[int, int], notices: list[str]
) -> set[int]:
    """Return the nodes that ``scene`` lists, else the first scene, else all without a parent."""
    if not root.size("scenes"):
        if "scene" in root:
            raise root.error(f"scene {root.value['scene']}, but 0 scenes")
        notices.append("the file has no scenes: all root nodes are drawn")
        return {index for index in range(len(nodes)) if index not in parents}
    scene = root.item("scenes", root.integer("scene", 0), root, "scene")
    listed = scene.integers("nodes")
    for index in listed:
        if index >= len(nodes):
            raise scene.error(f"node {index}, but {len(nodes)} nodes")
        if index in parents:
            notices.append(f"{scene.pointer}: node {index} is not a root; drawn below its parents")
    if len(set(listed)) < len(listed):
        raise scene.error("the same node twice")
    return set(listed)


def local_matrix(node: Entry) -> Matrix:
    """Return the matrix from a node's frame to its parent's, shape [4, 4]."""
    parts = [key for key in ("translation", "rotation", "scale") if key in node]
    if "matrix" in node:
        if parts:
            raise node.error(f"both matrix and {parts[0]}")
        matrix = np.array(node.numbers("matrix", (0.0,) * 16)).reshape(4, 4).T
        if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            raise node.error("matrix is not affine (last row is not 0 0 0 1)")
        return matrix
    matrix = np.eye(4)
    if not parts:
        return matrix
    x, y, z, w = node.numbers("rotation", (0.0, 0.0, 0.0, 1.0))
    length = math.hypot(x, y, z, w)
    if length < 1e-6:
        raise node.error("rotation is the zero quaternion")
    x, y, z, w = x / length, y / length, z / length, w / length
    rotation = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] = np.array(rotation) * node.numbers("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.numbers("translation", (0.0, 0.0, 0.0))
    return matrix


def check_invertible(node: Entry, world: Matrix) -> None:
    """Refuse a transform that flattens the mesh or overflows."""
    linear = world[:3, :3]
    if not (np.abs(world) < EXTENT).all():
        raise node.error(f"transform with numbers beyond {EXTENT:g}")
    volume = np.linalg.norm(linear, axis=0).prod()
    if abs(np.linalg.det(linear)) <= 1e-9 * volume:
        raise node.error(
            "singular transform (a scale of zero?)", "give the object a thickness, or remove it"
        )


def check_counts(file: GltfFile, placed: list[tuple[Entry, Matrix]]) -> None:
    """Refuse more triangles or vertices than the limit, before any is read."""
    triangle_count = vertex_count = 0
    for entry, _ in placed:
        attributes = entry.child("attributes")
        vertices = file.count(attributes.integer("POSITION"), entry, "POSITION")
        corners = vertices
        if "indices" in entry:
            corners = file.count(entry.integer("indices"), entry, "indices")
        triangle_count += corners if entry.integer("mode", 4) in (STRIP, FAN) else corners // 3
        vertex_count += vertices
    if triangle_count > TRIANGLES or vertex_count > 3 * TRIANGLES:
        raise file.root.error(
            f"too many triangles (found {triangle_count} with {vertex_count} vertices, instances "
            f"counted; limit {TRIANGLES})",
            "decimate the mesh",
        )


@dataclass(frozen=True)
class Geometry:
    """A primitive in its own frame; the fields are those of `Primitive`."""

    positions: NDArray[np.float64]
    indices: NDArray[np.int32]
    normals: FloatArray | None
    tangents: FloatArray | None
    uv0: FloatArray | None
    uv1: FloatArray | None
    colors: FloatArray | None


def read_geometry(
    file: GltfFile, entry: Entry, uv_sets: set[int], notices: list[str]
) -> Geometry | None:
    """Read the triangles of a primitive.

    Args:
        file: The file.
        entry: The primitive.
        uv_sets: Texture coordinate sets that its material reads; absent ones become zero.
        notices: Receives what was repaired.

    Returns:
        The geometry, or None when no triangle has an area.
    """
    attributes = entry.child("attributes")
    positions = file.accessor(attributes.integer("POSITION"), entry, "POSITION", ("VEC3",))
    positions = positions.astype(np.float64)
    indices = read_triangles(file, entry, len(positions), notices)
    indices, flat, repeated = keep_area(positions, indices)
    if flat or repeated:
        notices.append(
            f"{entry.pointer}: dropped {flat} triangles of zero area and {repeated} repeated ones"
        )
    if not len(indices):
        return None

    def read(name: str, types: tuple[str, ...]) -> NDArray[Any] | None:
        if name not in attributes:
            return None
        elements = file.accessor(attributes.integer(name), entry, name, types)
        if len(elements) != len(positions):
            raise entry.error(f"{len(elements)} {name}, but {len(positions)} vertices")
        return elements

    normals, tangents = None, None
    stored = read("NORMAL", ("VEC3",))
    if stored is not None:
        normals, lost = repair_normals(stored.astype(np.float64), positions, indices)
        if lost:
            notices.append(f"{entry.pointer}: {lost} normals of length zero taken from the faces")
        # Without normals the specification ignores tangents.
        stored = read("TANGENT", ("VEC4",))
        if stored is not None:
            tangents = stored.astype(np.float32)
            tangents[:, 3] = np.where(tangents[:, 3] < 0, -1.0, 1.0)
    uvs: list[FloatArray | None] = []
    for k in (0, 1):
        stored = read(f"TEXCOORD_{k}", ("VEC2",))
        if stored is None and k in uv_sets:
            notices.append(f"{entry.pointer}: no TEXCOORD_{k} for the textures, zero is used")
            stored = np.zeros((len(positions), 2))
        uvs.append(None if stored is None else stored.astype(np.float32))
    if entry.size("targets"):
        notices.append(f"{entry.pointer}: morph targets ignored, the rest pose is used")
    colors = read_colors(read("COLOR_0", ("VEC3", "VEC4")), entry, notices)
    return Geometry(positions, indices, normals, tangents, uvs[0], uvs[1], colors)


def read_triangles(
    file: GltfFile, entry: Entry, vertex_count: int, notices: list[str]
) -> NDArray[np.int32]:
    """Return the triangles of a list, strip or fan, shape [triangle, 3]."""
    if "indices" in entry:
        stored = file.accessor(entry.integer("indices"), entry, "indices", ("SCALAR",))[:, 0]
        if stored.dtype.kind != "u":
            raise entry.error("indices are not unsigned integers")
        highest = int(stored.max())
        if highest >= vertex_count:
            raise entry.error(f"index {highest}, but {vertex_count} vertices")
        corners = stored.astype(np.int32)
    else:
        corners = np.arange(vertex_count, dtype=np.int32)
    mode = entry.integer("mode", 4)
    if mode not in (4, STRIP, FAN):
        raise entry.error(f"mode is {mode}, expected 0 to 6")
    if mode == 4:
        spare = len(corners) % 3
        if spare:
            notices.append(f"{entry.pointer}: {spare} corners after the last triangle ignored")
        return corners[: len(corners) - spare].reshape(-1, 3)
    first = np.arange(max(len(corners) - 2, 0))
    if mode == FAN:
        return np.stack([corners[first + 1], corners[first + 2], corners[first * 0]], axis=1)
    odd = first % 2
    return np.stack([corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1)


def read_colors(stored: NDArray[Any] | None, entry: Entry, notices: list[str]) -> FloatArray | None:
    """Return linear RGBA in [0, 1], shape [vertex, 4]."""
    if stored is None:
        return None
    if stored.dtype.kind != "f":
        raise entry.error("COLOR_0 holds integers that are not normalized")
    if stored.min() < 0 or stored.max() > 1:
        notices.append(f"{entry.pointer}: COLOR_0 clamped to 0 ... 1")
    colors = np.ones((len(stored), 4), dtype=np.float32)
    colors[:, : stored.shape[1]] = np.clip(stored, 0, 1)
    return colors


def place(geometry: Geometry, world: Matrix, material: int) -> Primitive:
    """Move a geometry into the asset's frame; a mirroring matrix turns the triangles round."""
    linear = world[:3, :3]
    mirrored = bool(np.linalg.det(linear) < 0)
    indices, normals, tangents = geometry.indices, geometry.normals, geometry.tangents
    if normals is not None:
        normals = unit(normals @ np.linalg.inv(linear))
    if tangents is not None:
        tangents = np.column_stack(
            [unit(tangents[:, :3] @ linear.T), tangents[:, 3] * (-1 if mirrored else 1)]
        ).astype(np.float32)
    return Primitive(
        positions=geometry.positions @ linear.T + world[:3, 3],
        indices=np.ascontiguousarray(indices[:, ::-1]) if mirrored else indices,
        material=material,
        normals=normals,
        tangents=tangents,
        uv0=geometry.uv0,
        uv1=geometry.uv1,
        colors=geometry.colors,
    )
