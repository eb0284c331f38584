"""The scene graph of glTF: which nodes are drawn, and where their transforms put them."""

import math
from collections.abc import Sequence

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.core.limits import Limits
from warpir.io.gltf.gate import Entry, GltfFile
from warpir.io.meshes.triangles import EXTENT

Components = Sequence[float] | Float64Array
"""Numbers, or the rows of an array whose columns are instances."""


def read_forest(root: Entry, limits: Limits) -> tuple[list[Entry], dict[int, int]]:
    """Return all nodes, and the parent of each node that has one.

    Raises:
        InputError: Too many nodes, a child out of range, two parents, or a cycle.
    """
    count = root.size("nodes")
    limits.check("nodes", count, root.path, "/nodes: too many nodes")
    nodes = list(root.items("nodes"))
    parents: dict[int, int] = {}
    for index, node in enumerate(nodes):
        for child in node.integers("children"):
            if child >= count:
                raise node.out_of_range("child", child, count, "nodes")
            if child in parents:
                raise node.error("two_parents", found=child)
            parents[child] = index
    # Every node has at most one parent, so whatever the roots do not reach is a cycle.
    reached = 0
    stack = [index for index in range(count) if index not in parents]
    while stack:
        reached += 1
        stack += nodes[stack.pop()].integers("children")
    if reached < count:
        raise root.error("cycle", found=count - reached)
    return nodes, parents


def scene_nodes(
    root: Entry, nodes: list[Entry], parents: dict[int, int], notices: list[str]
) -> set[int]:
    """Return the nodes that ``scene`` lists, else the first scene, else all without a parent."""
    if not root.size("scenes"):
        if "scene" in root:
            raise root.out_of_range("scene", root.value["scene"], 0, "scenes")
        notices.append("the file has no scenes: all root nodes are drawn")
        return {index for index in range(len(nodes)) if index not in parents}
    scene = root.item("scenes", root.integer("scene", 0), root, "scene")
    listed = scene.integers("nodes")
    for index in listed:
        if index >= len(nodes):
            raise scene.out_of_range("node", index, len(nodes), "nodes")
        if index in parents:
            notices.append(f"{scene.pointer}: node {index} is not a root; drawn below its parents")
    if len(set(listed)) < len(listed):
        raise scene.error("two_parents", found=max(listed, key=listed.count))
    return set(listed)


def local_matrix(node: Entry) -> Float64Array:
    """Return the matrix from a node's frame to its parent's, shape [4, 4]."""
    parts = [key for key in ("translation", "rotation", "scale") if key in node]
    if "matrix" in node:
        if parts:
            raise node.error("matrix", what=f"both matrix and {parts[0]}")
        matrix = np.array(node.numbers("matrix", (0.0,) * 16)).reshape(4, 4).T
        if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0]):
            what = "matrix is not affine (last row is not 0 0 0 1)"
            raise node.error("matrix", what=what)
        return matrix
    if not parts:
        return np.eye(4)
    rotation = node.numbers("rotation", (0.0, 0.0, 0.0, 1.0))
    if math.hypot(*rotation) < 1e-6:
        raise node.error("matrix", what="rotation is the zero quaternion")
    return from_trs(
        node.numbers("translation", (0.0, 0.0, 0.0)), rotation, node.numbers("scale", (1.0,) * 3)
    )


def from_trs(translation: Components, rotation: Components, scale: Components) -> Float64Array:
    """Return translation * rotation * scale as matrices, shape [..., 4, 4].

    Args:
        translation: x, y and z [m], numbers or shape [...] each.
        rotation: Quaternions x, y, z and w of any length but 0.
        scale: Along x, y and z.
    """
    mean = sum(0.25 * abs(component) for component in rotation)
    x, y, z, w = (component / mean for component in rotation)  # whose squares cannot overflow
    length = (x * x + y * y + z * z + w * w) ** 0.5
    x, y, z, w = x / length, y / length, z / length, w / length
    a, b, c = scale
    columns = [
        [a * (1 - 2 * (y * y + z * z)), a * 2 * (x * y + z * w), a * 2 * (x * z - y * w)],
        [b * 2 * (x * y - z * w), b * (1 - 2 * (x * x + z * z)), b * 2 * (y * z + x * w)],
        [c * 2 * (x * z + y * w), c * 2 * (y * z - x * w), c * (1 - 2 * (x * x + y * y))],
        [*translation],
    ]
    matrices = np.zeros((*np.shape(x), 4, 4))
    matrices[..., :3, :] = np.array(columns).T
    matrices[..., 3, 3] = 1.0
    return matrices


def read_instances(file: GltfFile, node: Entry, world: Float64Array) -> Float64Array:
    """Return the matrices at which a node's mesh stands, shape [instance, 4, 4].

    One, or as many as EXT_mesh_gpu_instancing lists below the node.
    """
    extension = node.extension("EXT_mesh_gpu_instancing")
    if extension is None:
        return world[None]
    attributes = extension.child("attributes")
    read: dict[str, Float64Array] = {}
    for name, kind in {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}.items():
        if name in attributes:
            accessor = attributes.integer(name)
            count = file.count(accessor, attributes, name)
            what = f"{attributes.pointer}: too many instances"
            file.limits.check("instances", count, file.path, what)
            stored = file.accessor(accessor, attributes, name, (kind,))
            if stored.dtype.kind != "f":
                raise attributes.error("component_type", what=f"{name} is")
            read[name] = stored.astype(np.float64)
    counts = {name: len(values) for name, values in read.items()}
    if len(set(counts.values())) != 1:
        found = ", ".join(f"{count} {name}" for name, count in counts.items()) or "no"
        what, limit = "of the attributes", "equally many"
        raise attributes.error("count", found=found, what=what, limit=limit, of="are expected")
    (count,) = set(counts.values())
    shifts = read.get("TRANSLATION", np.zeros((count, 3)))
    rotations = read.get("ROTATION", np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)))
    scales = read.get("SCALE", np.ones((count, 3)))
    if (np.linalg.norm(rotations, axis=-1) < 1e-6).any():
        raise attributes.error("matrix", what="ROTATION holds the zero quaternion")
    with np.errstate(over="ignore", invalid="ignore"):  # `check_invertible` refuses such sizes
        return np.asarray(world @ from_trs(shifts.T, rotations.T, scales.T))


class Skins:
    """The joints of a file's skins, each read once."""

    def __init__(self, file: GltfFile, nodes: list[Entry], parents: dict[int, int]) -> None:
        self._file = file
        self._nodes = nodes
        self._parents = parents
        self._worlds: dict[int, Float64Array] = {}
        self._skins: dict[int, Float64Array] = {}

    def read(self, node: Entry) -> Float64Array:
        """Return, for each joint of a node's skin, the matrix that moves what is bound to it alone.

        Joint times inverse bind matrix, from the mesh's frame to the asset's, shape [joint, 4, 4].
        """
        index = node.integer("skin")
        if index not in self._skins:
            self._skins[index] = self._read(self._file.root.item("skins", index, node, "skin"))
        return self._skins[index]

    def _read(self, skin: Entry) -> Float64Array:
        joints = skin.integers("joints")
        for joint in joints:
            if joint >= len(self._nodes):
                raise skin.out_of_range("joint", joint, len(self._nodes), "nodes")
        worlds = [self._world(joint) for joint in joints]
        bound = np.stack(worlds) if joints else np.zeros((0, 4, 4))
        if "inverseBindMatrices" not in skin:
            return bound
        accessor = skin.integer("inverseBindMatrices")
        if self._file.count(accessor, skin, "inverseBindMatrices") < len(joints):
            limit, what = len(joints), "inverseBindMatrices"
            raise skin.error("count", found="too few", what=what, limit=limit, of="joints")
        stored = self._file.accessor(accessor, skin, "inverseBindMatrices", ("MAT4",))[
            : len(joints)
        ]
        if stored.dtype.kind != "f":
            raise skin.error("component_type", what="inverseBindMatrices are")
        inverse = stored.astype(np.float64).reshape(-1, 4, 4).transpose(0, 2, 1)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.asarray(bound @ inverse)

    def _world(self, joint: int) -> Float64Array:
        """Return the matrix from a node's frame to the asset's, shape [4, 4]."""
        chain = [joint]
        while chain[-1] not in self._worlds and chain[-1] in self._parents:
            chain.append(self._parents[chain[-1]])
        for index in reversed(chain):
            if index not in self._worlds:
                above = self._worlds[self._parents[index]] if index in self._parents else np.eye(4)
                with np.errstate(over="ignore", invalid="ignore"):  # refused by `pose`
                    self._worlds[index] = above @ local_matrix(self._nodes[index])
        return self._worlds[joint]


def check_invertible(node: Entry, placed: Float64Array) -> None:
    """Refuse a transform that flattens the mesh or overflows, of one instance [instance, 4, 4]."""
    linear = placed[:, :3, :3]
    is_small = np.abs(placed).max(axis=(1, 2)) < EXTENT
    with np.errstate(over="ignore", invalid="ignore"):
        volume = np.linalg.norm(linear, axis=1).prod(axis=-1)
        is_flat = np.abs(np.linalg.det(linear)) <= 1e-9 * volume
    refused = np.flatnonzero(~is_small | is_flat)
    if refused.size:
        which = f" of instance {refused[0]}" if len(placed) > 1 else ""
        if is_small[refused[0]]:
            raise node.error("singular", what=f"transform{which}")
        raise node.error("transform_too_large", what=f"transform{which}", limit=EXTENT)
