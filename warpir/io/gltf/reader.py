"""Reads glTF 2.0 into an `Asset`: the drawn primitives and their geometry.

`warpir.io.gltf.gate` checks the container and every number; this module says what the numbers mean,
together with `warpir.io.gltf.nodes` and `warpir.io.gltf.materials`. Each drawn primitive of each
mesh instance becomes one `Primitive` in the asset's frame (right-handed, +Y up, front +Z, metres).
Skinned meshes stand as their joints do in the file; lights, cameras, morph targets and animations
are not read.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray, IntArray, PixelArray
from warpir.core.limits import LIMITS, Limits
from warpir.io.gltf.gate import Entry, GltfFile
from warpir.io.gltf.materials import MaterialReader, check_extensions
from warpir.io.gltf.nodes import (
    Skins,
    check_invertible,
    local_matrix,
    read_forest,
    read_instances,
    scene_nodes,
)
from warpir.io.meshes.asset_files import concise
from warpir.io.meshes.triangles import (
    EXTENT,
    check_drawable,
    check_triangle_count,
    drop_without_area,
    unit,
    unit_normals,
)
from warpir.scene.asset import Asset, Material, Primitive

POINTS_OR_LINES = (0, 1, 2, 3)
STRIP, FAN = 5, 6


def read_gltf(path: str | Path, missing_textures: str = "error", limits: Limits = LIMITS) -> Asset:
    """Read a ``.glb`` or ``.gltf`` file.

    Everything it refers to must lie in its folder. With missing textures ``grey`` instead of an
    ``error``, a base colour texture that cannot be read becomes grey, any other is left out, with a
    notice.

    Returns:
        The drawn scene, instances flattened, rest pose.

    Raises:
        InputError: The file is damaged or cannot be represented faithfully; names the JSON
            pointer at fault.
    """
    path = Path(path)
    notices: list[str] = []
    file = GltfFile(path, limits)
    check_extensions(file.root, notices)
    placed = list(placed_primitives(file, notices))
    check_counts(file, placed)
    sizes = MaterialReader(file, missing_textures, [], measures=True)
    for entry, _, _ in placed:  # too many pixels are refused before the first is decoded
        sizes.index(entry)
    materials = MaterialReader(file, missing_textures, notices)
    read: dict[str, Primitive | None] = {}
    primitives: list[Primitive] = []
    for entry, world, joints in placed:
        if entry.pointer not in read:
            read[entry.pointer] = read_primitive(file, entry, materials, notices)
        primitive = read[entry.pointer]
        if primitive is not None and joints is not None:
            primitive = pose(file, entry, primitive, joints)
        if primitive is not None:
            primitives.append(place(primitive, world))
    notices += glass_notices(primitives, materials.materials)
    notices += direction_notices(primitives, materials.materials)
    check_drawable(path, primitives, f"{len(placed)} placed primitives, none with triangles")
    return Asset(
        name=path.stem,
        primitives=tuple(primitives),
        materials=tuple(materials.materials),
        textures=tuple(materials.textures),
        notices=concise(notices),
        hashes=file.hashes,
    )


def direction_notices(primitives: Sequence[Primitive], materials: Sequence[Material]) -> list[str]:
    """Return which anisotropic materials are used where nothing gives a direction."""
    vague = {p.material for p in primitives if p.tangents is p.uv0 is p.uv1 is None}
    return [
        f"material {m.name!r}: no TANGENT or TEXCOORD_0, without a direction it is not anisotropic"
        for k, m in enumerate(materials)
        if m.anisotropy > 0.0 and k in vague
    ]


def glass_notices(primitives: Sequence[Primitive], materials: Sequence[Material]) -> list[str]:
    """Return what is odd about the bodies of solid glass, a line a material."""
    notices = []
    for k, material in enumerate(materials):
        own = [p.positions[p.indices] for p in primitives if p.material == k]
        if not material.is_solid_glass or not own:
            continue
        triangles = np.concatenate(own)
        corners = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)[1].reshape(-1, 3)
        edges = np.sort(np.concatenate([corners[:, [i, (i + 1) % 3]] for i in range(3)]))
        count = int((np.unique(edges, axis=0, return_counts=True)[1] == 1).sum())
        a, b, c = np.moveaxis(triangles - triangles.mean(axis=(0, 1)), 1, 0)
        if count:
            notices.append(
                f"material {material.name!r}: a body of glass that is open at {count} edges: light "
                "that misses its far side is not bent or dimmed there"
            )
        elif np.einsum("tk,tk->", a, np.cross(b, c)) < 0.0:
            notices.append(
                f"material {material.name!r}: a body of glass whose triangles face inward: inside "
                "and outside are swapped"
            )
    return notices


Placed = tuple[Entry, Float64Array, Float64Array | None]
"""A primitive and the matrix from its frame to the asset's, shape [4, 4]; for a skinned one the
identity and the matrices of its joints, shape [joint, 4, 4]."""


def placed_primitives(file: GltfFile, notices: list[str]) -> Iterator[Placed]:
    """Walk the scene and yield every drawable primitive with its matrix.

    Raises:
        InputError: The nodes are not a forest, or a drawn transform is singular.
    """
    root = file.root
    nodes, parents = read_forest(root, file.limits)
    listed = scene_nodes(root, nodes, parents, notices)
    if root.size("animations"):
        notices.append("animations are not played: the rest pose is used")
    instance_count = 0
    skins = Skins(file, nodes, parents)
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
        # The joints alone place a skinned mesh; its own node does not count.
        joints = skins.read(node) if "skin" in node else None
        if joints is None and not world[:3, :3].any():
            notices.append(f"{node.pointer}: scaled to nothing, which hides it")
            continue
        instances = np.eye(4)[None] if joints is not None else read_instances(file, node, world)
        check_invertible(node, instances)
        if joints is not None:
            notices.append(f"{node.pointer}: skinned, stands as its joints do in the file")
        mesh = root.item("meshes", node.integer("mesh"), node, "mesh")
        for primitive in mesh.items("primitives"):
            if primitive.integer("mode", 4) in POINTS_OR_LINES:
                notices.append(f"{primitive.pointer}: points or lines are not drawn")
                continue
            instance_count += len(instances)
            what = "/: too many instances"
            file.limits.check("instances", instance_count, file.path, what, more=" so far")
            for matrix in instances:
                yield primitive, matrix, joints


def check_counts(file: GltfFile, placed: list[Placed]) -> None:
    """Refuse more triangles or vertices than the limit, before any is read."""
    triangle_count = vertex_count = 0
    for entry, _, _ in placed:
        attributes = entry.child("attributes")
        vertices = file.count(attributes.integer("POSITION"), entry, "POSITION")
        corners = vertices
        if "indices" in entry:
            corners = file.count(entry.integer("indices"), entry, "indices")
        triangle_count += corners if entry.integer("mode", 4) in (STRIP, FAN) else corners // 3
        vertex_count += vertices
    counted = f" with {vertex_count} vertices, instances counted"
    check_triangle_count(file.path, max(triangle_count, vertex_count // 3), file.limits, counted)


def read_primitive(
    file: GltfFile, entry: Entry, materials: MaterialReader, notices: list[str]
) -> Primitive | None:
    """Read the triangles of a primitive, in its own frame; None when none has an area.

    Texture coordinates that its material reads and that are absent become zero. ``notices``
    receives what was repaired.
    """
    material = materials.index(entry)
    uv_sets = {slot.uv_set for slot in materials.materials[material].texture_slots()}
    attributes = entry.child("attributes")
    positions = file.accessor(attributes.integer("POSITION"), entry, "POSITION", ("VEC3",))
    positions = positions.astype(np.float64)
    indices = read_triangles(file, entry, len(positions), notices)
    indices = drop_without_area(positions, indices, notices, f"{entry.pointer}: ")
    if not len(indices):
        return None

    def read(name: str, types: tuple[str, ...]) -> PixelArray | None:
        return _attribute(file, entry, name, types, len(positions)) if name in attributes else None

    normals, tangents = None, None
    stored = read("NORMAL", ("VEC3",))
    if stored is not None:
        stored = stored.astype(np.float64)
        normals = unit_normals(stored, positions, indices, notices, f"{entry.pointer}: ")
        # Without normals the specification ignores tangents.
        stored = read("TANGENT", ("VEC4",))
        if stored is not None:
            tangents = stored.astype(np.float32)
            tangents[:, 3] = np.where(tangents[:, 3] < 0, -1.0, 1.0)
            across = np.cross(tangents[:, :3], normals)
            if (np.linalg.norm(across, axis=1) < 1e-3).any():
                notices.append(f"{entry.pointer}: tangents without a direction, not used")
                tangents = None
    uvs: list[FloatArray | None] = []
    for k in (0, 1):
        stored = read(f"TEXCOORD_{k}", ("VEC2",))
        if stored is None and k in uv_sets:
            notices.append(f"{entry.pointer}: no TEXCOORD_{k} for the textures, zero is used")
            stored = np.zeros((len(positions), 2))
        uvs.append(None if stored is None else stored.astype(np.float32))
    if entry.size("targets"):
        notices.append(f"{entry.pointer}: morph targets and their weights ignored")
    colors = read_colors(read("COLOR_0", ("VEC3", "VEC4")), entry, notices)
    return Primitive(positions, indices, material, normals, tangents, uvs[0], uvs[1], colors)


def _attribute(
    file: GltfFile, entry: Entry, name: str, types: tuple[str, ...], vertex_count: int
) -> PixelArray:
    """Return an attribute of a primitive, of as many elements as it has vertices."""
    accessor = entry.child("attributes").integer(name)
    count = file.count(accessor, entry, name)
    if count != vertex_count:
        raise entry.error("count", found=count, what=name, limit=vertex_count, of="vertices")
    return file.accessor(accessor, entry, name, types)


def read_triangles(file: GltfFile, entry: Entry, vertex_count: int, notices: list[str]) -> IntArray:
    """Return the triangles of a list, strip or fan, shape [triangle, 3]."""
    if "indices" in entry:
        stored = file.accessor(entry.integer("indices"), entry, "indices", ("SCALAR",))[:, 0]
        if stored.dtype.kind != "u":
            raise entry.error("component_type", what="indices are")
        highest = int(stored.max())
        if highest >= vertex_count:
            raise entry.out_of_range("index", highest, vertex_count, "vertices")
        corners = stored.astype(np.int32)
    else:
        corners = np.arange(vertex_count, dtype=np.int32)
    mode = entry.integer("mode", 4)
    if mode not in (4, STRIP, FAN):
        raise entry.error("range", what="mode", found=mode, expected="0 to 6")
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


def read_colors(stored: PixelArray | None, entry: Entry, notices: list[str]) -> FloatArray | None:
    """Return linear RGBA in [0, 1], shape [vertex, 4]."""
    if stored is None:
        return None
    if stored.dtype.kind != "f":
        raise entry.error("component_type", what="COLOR_0 is")
    if stored.min() < 0 or stored.max() > 1:
        notices.append(f"{entry.pointer}: COLOR_0 clamped to 0 ... 1")
    colors = np.ones((len(stored), 4), dtype=np.float32)
    colors[:, : stored.shape[1]] = np.clip(stored, 0, 1)
    return colors


def pose(file: GltfFile, entry: Entry, bound: Primitive, joints: Float64Array) -> Primitive:
    """Move the vertices of a skinned primitive as its joints stand (linear blend skinning).

    ``entry`` has JOINTS_n and WEIGHTS_n; the primitive is as stored, the matrices are those of
    `Skins.read`, shape [joint, 4, 4].
    """
    moved = _blended_joints(file, entry, len(bound.positions), joints)
    linear = moved[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # such sizes are refused below
        volume = np.linalg.norm(linear, axis=1).prod(axis=1)
        sign = np.linalg.det(linear)
    if not ((np.abs(moved) < EXTENT).all() and (np.abs(sign) > 1e-9 * volume).all()):
        raise entry.error("singular", what="transforms of the joints, or beyond all bounds")
    normals, tangents = bound.normals, bound.tangents
    if normals is not None:
        normals = unit(np.einsum("vk,vkj->vj", normals, np.linalg.inv(linear)))
    if tangents is not None:
        turned = unit(np.einsum("vjk,vk->vj", linear, tangents[:, :3]))
        tangents = np.column_stack([turned, tangents[:, 3]])
    positions = np.einsum("vjk,vk->vj", linear, bound.positions) + moved[:, :3, 3]
    posed = replace(bound, positions=positions, normals=normals, tangents=tangents)
    return _mirrored(posed) if np.median(sign) < 0 else posed


def _mirrored(p: Primitive) -> Primitive:
    """Return a primitive that a mirroring matrix has moved with its triangles turned round."""
    indices = np.ascontiguousarray(p.indices[:, ::-1])
    tangents = None if p.tangents is None else p.tangents * np.array([1, 1, 1, -1], np.float32)
    return replace(p, indices=indices, tangents=tangents)


def _blended_joints(file: GltfFile, entry: Entry, count: int, joints: Float64Array) -> Float64Array:
    """Return the weighted mean of the joints of each vertex, shape [vertex, 4, 4]."""
    attributes = entry.child("attributes")
    moved = np.zeros((count, 4, 4))
    total = np.zeros(count)
    sets = sum(f"JOINTS_{k}" in attributes for k in range(len(attributes.value)))
    for k in range(max(sets, 1)):
        index = _attribute(file, entry, f"JOINTS_{k}", ("VEC4",), count)
        weight = _attribute(file, entry, f"WEIGHTS_{k}", ("VEC4",), count)
        if index.dtype.kind != "u" or weight.dtype.kind != "f":
            raise entry.error("component_type", what=f"JOINTS_{k} or WEIGHTS_{k} are")
        if index.max() >= len(joints):
            raise entry.out_of_range(f"JOINTS_{k} index", int(index.max()), len(joints), "joints")
        for column in range(4):
            moved += weight[:, column, None, None] * joints[index[:, column]]
            total += weight[:, column]
    if not (total > 0.0).all():
        raise entry.error("no_weight", found=int(np.argmin(total > 0.0)))
    moved /= total[:, None, None]
    return moved


def place(p: Primitive, world: Float64Array) -> Primitive:
    """Move a primitive into the asset's frame; a mirroring matrix turns the triangles round."""
    linear = world[:3, :3]
    normals, tangents = p.normals, p.tangents
    if normals is not None:
        normals = unit(normals @ np.linalg.inv(linear))
    if tangents is not None:
        tangents = np.column_stack([unit(tangents[:, :3] @ linear.T), tangents[:, 3]])
    positions = p.positions @ linear.T + world[:3, 3]
    placed = replace(p, positions=positions, normals=normals, tangents=tangents)
    return _mirrored(placed) if np.linalg.det(linear) < 0 else placed
