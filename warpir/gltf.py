"""Reads glTF 2.0 into an `Asset`: scene graph, geometry, materials.

`warpir.gltf_file` is the gate that checks the container and every number; this module says what
the numbers mean. Each drawn primitive of each mesh instance becomes one `Primitive` in the
asset's frame (right-handed, +Y up, front +Z, metres). Lights, cameras and animations are not read.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.asset import Asset, FloatArray, Material, Primitive, Texture, TextureSlot
from warpir.asset_files import (
    TRIANGLES,
    Pixels,
    TextureDecoder,
    grey_pixels,
    keep_area,
    locate,
    nothing_to_render,
    read_uri,
    repair_normals,
)
from warpir.errors import InputError
from warpir.gltf_file import RE_EXPORT_MESH, Entry, GltfFile

NODES = 100_000
"""Most nodes of a file."""
INSTANCES = 65_536
"""Most placed primitives."""

HONOURED = {
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_node_visibility",
    "KHR_texture_transform",
}
"""Extensions whose meaning reaches the picture."""
BASE_MATERIAL = {
    f"KHR_materials_{name}"
    for name in (
        "anisotropy", "clearcoat", "diffuse_transmission", "dispersion", "ior", "iridescence",
        "sheen", "specular", "transmission", "variants", "volume",
    )
}  # fmt: skip
"""Extensions that refine a material; the material below them is used, with a notice."""
LEFT_OUT = {
    "KHR_animation_pointer": "animations are not played",
    "KHR_lights_punctual": "the lights of the file are not used",
    "KHR_xmp_json_ld": "metadata is not read",
}
"""Extensions that can be ignored even when required, and the notice."""
ADVICE = {
    "EXT_mesh_gpu_instancing": "re-export with instances as nodes",
    "EXT_meshopt_compression": RE_EXPORT_MESH,
    "KHR_draco_mesh_compression": RE_EXPORT_MESH,
    "KHR_meshopt_compression": RE_EXPORT_MESH,
    "KHR_texture_basisu": "re-export with PNG or JPEG textures instead of KTX2",
}
"""What to do about an extension that is refused when required."""

WRAPS = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
NEAREST = (9728, 9984, 9986)
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
    nothing_to_render(path, primitives, f"{len(placed)} placed primitives, none with triangles")
    return Asset(
        name=path.stem,
        primitives=tuple(primitives),
        materials=tuple(materials.materials),
        textures=tuple(materials.textures),
        notices=tuple(dict.fromkeys(notices)),
    )


def check_extensions(root: Entry, notices: list[str]) -> None:
    """Refuse required extensions that are not honoured; mention the others that are ignored."""
    names = {}
    for key in ("extensionsRequired", "extensionsUsed"):
        listed = root.value.get(key, [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise root.error(f"{key} is not a list of names")
        names[key] = dict.fromkeys(listed)
    for name in names["extensionsRequired"]:
        if name not in HONOURED | BASE_MATERIAL and name not in LEFT_OUT:
            raise InputError(
                root.path,
                f"/extensionsRequired: {name} is not supported",
                ADVICE.get(name, f"re-export without {name}"),
            )
    for name in names["extensionsUsed"]:
        if name in LEFT_OUT:
            notices.append(f"{name}: {LEFT_OUT[name]}")
        elif name not in HONOURED | BASE_MATERIAL:
            notices.append(f"{name} is not supported: what the file holds without it is used")


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
    starts = scene_roots(root, nodes, parents, notices)
    stack = [(index, ancestor_matrix(nodes, parents, index)) for index in reversed(starts)]
    if root.size("animations"):
        notices.append("animations are not played: the rest pose is used")
    instance_count = 0
    while stack:
        index, parent = stack.pop()
        node = nodes[index]
        visibility = node.extension("KHR_node_visibility")
        if visibility is not None and "visible" in visibility and not visibility.flag("visible"):
            notices.append(f"{node.pointer}: hidden by KHR_node_visibility")
            continue
        world = parent @ local_matrix(node)
        stack += [(child, world) for child in reversed(node.integers("children"))]
        if "mesh" not in node:
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


def scene_roots(
    root: Entry, nodes: list[Entry], parents: dict[int, int], notices: list[str]
) -> list[int]:
    """Return where drawing starts: the nodes of ``scene``, else of the first, else all roots."""
    if not root.size("scenes"):
        if "scene" in root:
            raise root.error(f"scene {root.value['scene']}, but 0 scenes")
        notices.append("the file has no scenes: all root nodes are drawn")
        return [index for index in range(len(nodes)) if index not in parents]
    scene = root.item("scenes", root.integer("scene", 0), root, "scene")
    listed = scene.integers("nodes")
    starts = []
    for index in listed:
        if index >= len(nodes):
            raise scene.error(f"node {index}, but {len(nodes)} nodes")
        ancestors = set(ancestor_indices(parents, index))
        if ancestors:
            notices.append(f"{scene.pointer}: node {index} is not a root; drawn below its parents")
        if not ancestors.intersection(listed):
            starts.append(index)
    if len(set(starts)) < len(starts):
        raise scene.error("the same node twice")
    return starts


def ancestor_indices(parents: dict[int, int], index: int) -> Iterator[int]:
    """Yield the parent of a node, the parent's parent and so on."""
    while index in parents:
        index = parents[index]
        yield index


def ancestor_matrix(nodes: list[Entry], parents: dict[int, int], index: int) -> Matrix:
    """Return the matrix from the frame of a node's parent to the asset's, shape [4, 4]."""
    matrix = np.eye(4)
    for ancestor in ancestor_indices(parents, index):
        matrix = local_matrix(nodes[ancestor]) @ matrix
    return matrix


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
    volume = np.linalg.norm(linear, axis=0).prod()
    if not np.isfinite(world).all() or abs(np.linalg.det(linear)) <= 1e-9 * volume:
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
    return np.stack(
        [corners[first], corners[first + 1 + odd], corners[first + 2 - odd]], axis=1
    )


def read_colors(
    stored: NDArray[Any] | None, entry: Entry, notices: list[str]
) -> FloatArray | None:
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
        indices=indices[:, ::-1] if mirrored else indices,
        material=material,
        normals=normals,
        tangents=tangents,
        uv0=geometry.uv0,
        uv1=geometry.uv1,
        colors=geometry.colors,
    )


def unit(vectors: NDArray[Any]) -> FloatArray:
    """Normalise the rows; a row of zeros stays, shape [vertex, 3]."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 0, length, 1.0)).astype(np.float32)


class MaterialReader:
    """Reads the materials that are drawn, and their textures, each once.

    Args:
        file: The file.
        missing_textures: ``error`` or ``grey``.
        notices: Receives what was assumed or left out.
    """

    def __init__(self, file: GltfFile, missing_textures: str, notices: list[str]) -> None:
        self.file = file
        self.missing_textures = missing_textures
        self.notices = notices
        self.materials: list[Material] = []
        self.textures: list[Texture] = []
        self._decoder = TextureDecoder(file.path, notices)
        self._material_index: dict[int, int] = {}
        self._texture_index: dict[tuple[int, str, str], int] = {}
        self._pixels: dict[int, Pixels | None] = {}

    def index(self, primitive: Entry) -> int:
        """Return the index in ``materials`` of what a primitive is made of."""
        stated = primitive.integer("material", -1, low=-1)
        if stated not in self._material_index:
            if stated == -1:
                material = Material(name="default")
                self.notices.append("no material: glTF's default (white, fully metallic, rough)")
            else:
                material = self._read(
                    self.file.root.item("materials", stated, primitive, "material")
                )
            self._material_index[stated] = len(self.materials)
            self.materials.append(material)
        return self._material_index[stated]

    def uv_sets(self, index: int) -> set[int]:
        """Return the texture coordinate sets that material ``index`` reads."""
        material = self.materials[index]
        slots = (
            material.base_color_texture,
            material.metallic_roughness_texture,
            material.normal_texture,
            material.emission_texture,
        )
        return {slot.uv_set for slot in slots if slot is not None}

    def _read(self, entry: Entry) -> Material:
        name = entry.text("name", "") or entry.pointer
        pbr = entry.child("pbrMetallicRoughness")
        *base_color, alpha = self._factors(pbr, "baseColorFactor", (1.0,) * 4, 0.0, 1.0)
        mode = entry.text("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise entry.error(f"alphaMode is {mode!r}, expected OPAQUE, MASK or BLEND")
        strength = entry.extension("KHR_materials_emissive_strength")
        gain = 1.0 if strength is None else strength.number("emissiveStrength", 1.0)
        if gain < 0:
            self.notices.append(f"{entry.pointer}: emissiveStrength {gain:g} clamped to 0")
        emission = self._factors(entry, "emissiveFactor", (0.0,) * 3, 0.0, math.inf)
        material = Material(
            name=name,
            base_color=(base_color[0], base_color[1], base_color[2]),
            alpha=alpha,
            metallic=self._factor(pbr, "metallicFactor", 1.0),
            roughness=self._factor(pbr, "roughnessFactor", 1.0),
            emission=(
                emission[0] * max(gain, 0.0),
                emission[1] * max(gain, 0.0),
                emission[2] * max(gain, 0.0),
            ),
            alpha_mode=mode,
            alpha_cutoff=self._factor(entry, "alphaCutoff", 0.5),
            double_sided=entry.flag("doubleSided"),
            normal_scale=entry.child("normalTexture").number("scale", 1.0),
            base_color_texture=self._slot(pbr, "baseColorTexture"),
            metallic_roughness_texture=self._slot(pbr, "metallicRoughnessTexture"),
            normal_texture=self._slot(entry, "normalTexture"),
            emission_texture=self._slot(entry, "emissiveTexture") if any(emission) else None,
        )
        if "occlusionTexture" in entry:
            self.notices.append("occlusion textures are not used: occlusion is traced")
        return self._extend(material, entry)

    def _extend(self, material: Material, entry: Entry) -> Material:
        """Apply the material extensions that replace the model; mention those left out."""
        glossiness = entry.extension("KHR_materials_pbrSpecularGlossiness")
        if glossiness is not None and "pbrMetallicRoughness" not in entry:
            *diffuse, alpha = self._factors(glossiness, "diffuseFactor", (1.0,) * 4, 0.0, 1.0)
            material = replace(
                material,
                base_color=(diffuse[0], diffuse[1], diffuse[2]),
                alpha=alpha,
                metallic=0.0,
                roughness=1.0 - self._factor(glossiness, "glossinessFactor", 1.0),
                base_color_texture=self._slot(glossiness, "diffuseTexture"),
            )
            self.notices.append(
                f"material {material.name!r}: specular-glossiness read as a dielectric of its "
                "diffuse colour and glossiness factor"
            )
        if entry.extension("KHR_materials_unlit") is not None:
            material = replace(
                material,
                metallic=0.0,
                roughness=1.0,
                emission=(0.0, 0.0, 0.0),
                metallic_roughness_texture=None,
                normal_texture=None,
                emission_texture=None,
            )
            self.notices.append(f"material {material.name!r}: unlit, shown as a lit matte surface")
        left_out = [name for name in entry.child("extensions").value if name not in HONOURED]
        if left_out:
            self.notices.append(
                f"material {material.name!r}: {', '.join(left_out)} not supported, "
                "its base material is used"
            )
        return material

    def _factor(self, entry: Entry, key: str, default: float) -> float:
        value = entry.number(key, default)
        if not 0.0 <= value <= 1.0:
            self.notices.append(f"{entry.pointer}: {key} {value:g} clamped to 0 ... 1")
        return min(max(value, 0.0), 1.0)

    def _factors(
        self, entry: Entry, key: str, default: tuple[float, ...], low: float, high: float
    ) -> tuple[float, ...]:
        values = entry.numbers(key, default)
        if any(not low <= value <= high for value in values):
            self.notices.append(f"{entry.pointer}: {key} clamped to {low:g} ... {high:g}")
        return tuple(min(max(value, low), high) for value in values)

    def _slot(self, owner: Entry, key: str) -> TextureSlot | None:
        """Return how ``owner`` reads texture ``key``, or None when it has none."""
        if key not in owner:
            return None
        entry = owner.child(key)
        texture = self._texture(entry, key in ("baseColorTexture", "diffuseTexture"))
        if texture is None:
            return None
        uv_set = entry.integer("texCoord", 0)
        affine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
        transform = entry.extension("KHR_texture_transform")
        if transform is not None:
            uv_set = transform.integer("texCoord", uv_set)
            (ox, oy), (sx, sy) = (
                transform.numbers("offset", (0.0, 0.0)),
                transform.numbers("scale", (1.0, 1.0)),
            )
            angle = transform.number("rotation", 0.0)
            c, s = math.cos(angle), math.sin(angle)
            # translation * rotation * scale, as in the extension's own GLSL.
            affine = (c * sx, s * sy, ox, -s * sx, c * sy, oy)
        if uv_set > 1:
            raise entry.error(f"texCoord {uv_set}, but only sets 0 and 1 are supported")
        return TextureSlot(texture, uv_set, affine)

    def _texture(self, user: Entry, is_base_color: bool) -> int | None:
        """Return the index in ``textures``, or None when a missing image is left out."""
        root = self.file.root
        entry = root.item("textures", user.integer("index"), user, "index")
        webp = entry.extension("EXT_texture_webp")
        source = entry.integer("source", -1, low=-1) if webp is None else webp.integer("source")
        wraps = ["repeat", "repeat"]
        if "sampler" in entry:
            sampler = root.item("samplers", entry.integer("sampler"), entry, "sampler")
            for k, key in enumerate(("wrapS", "wrapT")):
                code = sampler.integer(key, 10497)
                if code not in WRAPS:
                    raise sampler.error(f"{key} is {code}, expected one of {sorted(WRAPS)}")
                wraps[k] = WRAPS[code]
            if sampler.integer("magFilter", 9729) in NEAREST:
                self.notices.append(f"{sampler.pointer}: nearest filter replaced by bilinear")
        use = (source, wraps[0], wraps[1])
        if use not in self._texture_index:
            if source not in self._pixels:
                self._pixels[source] = self._load(source, entry)
            pixels = self._pixels[source]
            if pixels is None and not is_base_color:
                return None
            texture = Texture(grey_pixels() if pixels is None else pixels, *wraps)
            self._texture_index[use] = len(self.textures)
            self.textures.append(texture)
        return self._texture_index[use]

    def _load(self, source: int, texture: Entry) -> Pixels | None:
        """Return the pixels of an image; None when it is missing and that is allowed."""
        if source == -1 and texture.extension("KHR_texture_basisu") is None:
            raise texture.error("no image source")
        image = texture
        if source != -1:
            image = self.file.root.item("images", source, texture, "source")
        where = f"{image.pointer}: "
        uri = image.text("uri", "")
        if "uri" in image and not uri.startswith("data:"):
            locate(uri, self.file.path, where)  # outside the folder is refused in any case
        try:
            if source == -1:
                raise texture.error("only a KTX2 image", ADVICE["KHR_texture_basisu"])
            if "uri" in image:
                encoded = read_uri(uri, self.file.path, where)
            else:
                encoded = bytes(self.file.view(image.integer("bufferView"), image)[0])
            return self._decoder.decode(encoded, where)
        except InputError as error:
            if self.missing_textures != "grey":
                raise InputError(
                    error.where,
                    error.what,
                    error.advice or "add the image, or pass --missing-textures grey",
                ) from None
            self.notices.append(f"{error.what}: replaced by grey, or left out where no colour")
            return None
