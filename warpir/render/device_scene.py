"""The scene on one device: triangles, materials, textures, receiver, camera.

Everything is checked here once. Coordinates are recentred on the object, in float64, before they
become float32, so an object 100 km from the origin keeps its precision.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.color import srgb_to_linear
from warpir.kernels.receiver_mesh import trace_seen
from warpir.kernels.types import (
    ANISOTROPY,
    IRIDESCENCE,
    LAYERS,
    CameraArgs,
    Extensions,
    GlassArgs,
    MaterialArgs,
    MeshArgs,
    ReceiverArgs,
    TextureArgs,
)
from warpir.render.device_light import lamp_args
from warpir.render.glass.solid import absorption, glass_args, mean_way, straight_shares
from warpir.render.rays.embree import EmbreeScene, library
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import Lamp
from warpir.scene.receiver import ReceiverMesh
from warpir.scene.sheen import sheen_albedo_table

ALPHA_MODES = {"OPAQUE": 0, "MASK": 1, "BLEND": 2}
SLOTS = (
    "base_color", "metallic_roughness", "normal", "emission",
    "specular", "specular_color", "clearcoat", "clearcoat_roughness", "clearcoat_normal",
    "sheen_color", "sheen_roughness", "transmission", "anisotropy",
    "iridescence", "iridescence_thickness",
)  # fmt: skip
"""Texture slots in the order of `warpir.kernels.tracing.texture`."""
WRAP_MODES = {"repeat": 0, "clamp": 1, "mirror": 2}


FACTORS = (
    ("base_color", wp.vec3),
    ("metallic", wp.float32),
    ("roughness", wp.float32),
    ("emission", wp.vec3),
)
"""Material factors that can be replaced and differentiated."""
POINTERS = ("id", "mesh", "embree", "embree_intersect", "embree_occluded")
"""Arguments that differ from run to run."""
RECEIVER_EPSILON = 2e-6
"""Ray offset over the diagonal of the receiver's mesh [1]; rays meet it again below 1e-7."""


@dataclass(frozen=True)
class Receiver:
    """Receiver of the shadow: the plane ``dot(normal, x) = offset``, a mesh, or both."""

    normal: Float64Array
    """Unit normal of the plane, world frame, toward the lit side, shape [3]."""
    offset: float
    """Offset of the plane [m]."""
    mesh: ReceiverMesh | None = None
    """Mesh that receives shadows and blocks light."""
    radiance: FloatArray | None = None
    """Radiance of the photo before its tone operator, in the view of the scene's camera at any
    resolution, shape [height, width, 3]; without it the mesh is black."""
    is_plane: bool = True
    """Whether the receiver has a plane beside the mesh."""


@dataclass(frozen=True)
class Placed:
    """An asset and its pose."""

    asset: Asset
    asset_to_world: Float64Array
    """Affine map to the world, column vectors, shape [4, 4]."""


@dataclass
class _Vertices:
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


def _to_world(primitive: Primitive, matrix: Float64Array) -> _Vertices:
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
        return _Vertices(positions, indices, normals, tangents, uv0, uv1, colors)
    # Flat shading (glTF 2.0, 3.7.2.1): each triangle gets vertices of its own.
    corners = indices.reshape(-1)
    positions = positions[corners]
    a, b, c = positions[0::3], positions[1::3], positions[2::3]
    normals = np.repeat(_unit(np.cross(b - a, c - a)), 3, axis=0)
    own = np.arange(len(corners), dtype=np.int32).reshape(-1, 3)
    return _Vertices(
        positions, own, normals, tangents[corners], uv0[corners], uv1[corners], colors[corners]
    )


def _slot(slot: TextureSlot | None, first_texture: int) -> tuple[int, int, list[float]]:
    """Return texture index, UV set and the six numbers of the transform."""
    if slot is None:
        return -1, 0, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    return first_texture + slot.texture, slot.uv_set, list(slot.transform)


def _extensions(material: Material, transmission: float) -> Extensions:
    """Return a material's glTF extensions for the kernels, with this share of light passing it."""
    plain = Material()
    names = (
        "ior", "specular", "specular_color", "clearcoat", "sheen_color", "transmission",
        "anisotropy", "iridescence",
    )  # fmt: skip
    out = Extensions()
    out.present = int(any(getattr(material, name) != getattr(plain, name) for name in names))
    if material.specular_texture or material.specular_color_texture:
        out.present = 1
    # KHR_materials_ior; an index of 0 stands for infinity and gives 1 as well.
    f0 = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
    out.f0 = wp.vec3(*(f0 * channel for channel in material.specular_color))
    out.sheen_color = wp.vec3(*material.sheen_color)
    for name in (
        "specular", "clearcoat", "clearcoat_roughness", "clearcoat_normal_scale",
        "sheen_roughness", "anisotropy", "iridescence",
    ):  # fmt: skip
        setattr(out, name, getattr(material, name))
    rotation = material.anisotropy_rotation
    out.stretch = wp.vec2(math.cos(rotation), math.sin(rotation))
    out.film_ior = material.iridescence_ior
    out.film_minimum, out.film_thickness = material.iridescence_thickness
    out.transmission = transmission
    return out


Corners = tuple[Float64Array, Float64Array]
"""Lowest and highest corner of a box, world frame [m], shape [3] each."""


def _corners(parts: Iterable[_Vertices]) -> Corners | None:
    """Return the box of some triangles; None without any."""
    boxes = [(v.positions.min(axis=0), v.positions.max(axis=0)) for v in parts]
    if not boxes:
        return None
    lows, highs = zip(*boxes, strict=True)
    return np.min(lows, axis=0), np.max(highs, axis=0)


class Scene:
    """Geometry, materials, plane and camera on one device; owns every Warp handle for the run.

    The scene does not change after its upload.

    Args:
        objects: Objects to render; may be empty (no triangles, no shadow).
        camera: The view.
        receiver: The ground plane, the receiver's mesh, or both.
        device: ``cpu`` or ``cuda``.
        lamps: Lamps near the object.

    Attributes:
        origin: World point that is the recentred origin [m], shape [3].
        diagonal: Diagonal of the objects' bounding box [m].
        bounds: Of the objects.
        glass_bounds: Of what is a thin wall that light passes; None: nothing is.
        has_solid_glass: Whether some material is a body of glass, which bends light.
        rays: Whose tree of the triangles finds hits, ``Embree`` or ``Warp``.
    """

    def __init__(
        self,
        objects: Sequence[Placed],
        camera: Camera,
        receiver: Receiver,
        device: str,
        lamps: Sequence[Lamp] = (),
    ) -> None:
        self.device = wp.get_device(device)
        self.camera = camera
        self.receiver = receiver
        self.lamps = tuple(lamps)
        self.rays = "Warp"
        parts: list[tuple[_Vertices, int]] = []
        materials: list[tuple[Material, int]] = []
        scales: list[float] = []
        textures: list[Texture] = []
        for placed in objects:
            for primitive in placed.asset.primitives:
                vertices = _to_world(primitive, placed.asset_to_world)
                parts.append((vertices, len(materials) + primitive.material))
            first_texture = len(textures)
            materials += [(m, first_texture) for m in placed.asset.materials]
            scale = abs(float(np.linalg.det(placed.asset_to_world[:3, :3]))) ** (1.0 / 3.0)
            scales += [scale] * len(placed.asset.materials)
            textures += placed.asset.textures
        thin = {k for k, (m, _) in enumerate(materials) if m.transmission and not m.is_solid_glass}
        eye = camera.c2w[:3, 3]
        self.bounds = _corners(v for v, _ in parts) or (eye, eye)
        self.glass_bounds = _corners(v for v, material in parts if material in thin)
        low, high = self.bounds
        self.origin: Float64Array = 0.5 * (low + high)
        self.diagonal = float(np.linalg.norm(high - low))
        self.triangle_count = sum(len(v.indices) for v, _ in parts)

        self._upload_mesh(parts)
        self._upload_materials(materials)
        self._upload_glass([m for m, _ in materials], scales, parts)
        self._upload_textures(textures)
        self.camera_args = self.camera_args_at(camera)
        self.receiver_args = self._receiver_args()
        self.lamp_args = lamp_args(self.lamps, self.origin, self.device)

    def with_lamps(self, lamps: Sequence[Lamp]) -> Scene:
        """Return the same scene, its uploads shared, with other lamps."""
        other = copy(self)
        other.lamps = tuple(lamps)
        other.lamp_args = lamp_args(other.lamps, self.origin, self.device)
        return other

    def _receiver_args(self) -> ReceiverArgs:
        receiver, camera = self.receiver, self.camera
        args = ReceiverArgs()
        # No ray comes down on a plane without a normal.
        normal = receiver.normal if receiver.is_plane else np.zeros(3)
        args.normal = wp.vec3(*normal.astype(np.float32))
        args.offset = float(receiver.offset - receiver.normal @ self.origin)
        # A sheet that lies on the plane is hit before or behind it by a few units in the last place
        # of the camera's coordinates.
        eye = np.abs(camera.c2w[:3, 3] - self.origin).max()
        args.tolerance = float(1e-5 * self.diagonal + 5e-7 * eye)
        # Plain numbers, as `contents` wants them.
        args.mesh, args.epsilon, args.shines, args.is_solid = 0, 0.0, 0, 0
        args.positions = self._array(np.zeros((1, 3), np.float32), wp.vec3)
        args.indices = self._array(np.zeros(3, np.int32), wp.int32)
        args.radiance = self._array(np.zeros((1, 1, 3), np.float32), wp.vec3)
        mesh = receiver.mesh
        if mesh is None:
            # The ground behind glass is what the photo shows there.
            if self.has_solid_glass and receiver.radiance is not None:
                args.eye = wp.vec3(*(camera.c2w[:3, 3] - self.origin).astype(np.float32))
                self._upload_radiance(args, receiver.radiance)
            return args
        positions = mesh.positions - self.origin
        args.positions = self._array(positions.astype(np.float32), wp.vec3)
        args.indices = self._array(mesh.indices.reshape(-1), wp.int32)
        self.receiver_mesh = wp.Mesh(
            points=args.positions, indices=args.indices, bvh_constructor="sah"
        )
        args.mesh = self.receiver_mesh.id
        args.epsilon = RECEIVER_EPSILON * float(np.linalg.norm(np.ptp(positions, axis=0)))
        args.eye = wp.vec3(*(camera.c2w[:3, 3] - self.origin).astype(np.float32))
        if receiver.radiance is not None:
            self._upload_radiance(args, receiver.radiance)
        return args

    def _upload_radiance(self, args: ReceiverArgs, radiance: FloatArray) -> None:
        """Upload the photo's radiance for the receiver's mesh; outside the photo, its mean."""
        height, width = radiance.shape[:2]
        view = self.camera.scaled(width, height)
        # Columns right, down and ahead; the camera looks along its own -Z.
        intrinsics = np.array(
            [[view.fx, 0.0, -view.cx], [0.0, -view.fy, -view.cy], [0.0, 0.0, -1.0]]
        )
        to_image = intrinsics @ view.c2w[:3, :3].T
        args.to_image = wp.mat33(*to_image.astype(np.float32).reshape(-1))
        args.radiance = self._array(np.ascontiguousarray(radiance, np.float32), wp.vec3)
        args.shines = 1
        seen = wp.zeros((height, width), dtype=float, device=self.device)
        to_world = wp.mat33(*np.linalg.inv(to_image).astype(np.float32).reshape(-1))
        wp.launch(
            trace_seen, dim=(height, width), inputs=[args, to_world, seen], device=self.device
        )
        weight = seen.numpy().astype(np.float64)
        if weight.any():
            mean = (radiance * weight[..., None]).sum(axis=(0, 1)) / weight.sum()
            args.elsewhere = wp.vec3(*mean.astype(np.float32))

    def camera_args_at(self, camera: Camera) -> CameraArgs:
        """Return ``camera`` in the recentred frame."""
        args = CameraArgs()
        args.origin = wp.vec3(*(camera.c2w[:3, 3] - self.origin).astype(np.float32))
        args.rotation = wp.mat33(*camera.c2w[:3, :3].astype(np.float32).reshape(-1))
        args.fx, args.fy, args.cx, args.cy = camera.fx, camera.fy, camera.cx, camera.cy
        args.width = camera.width
        return args

    def geometry(self, materials: MaterialArgs | None = None) -> tuple[Any, ...]:
        """Return triangles, materials, textures, receiver, in the order of the kernels' arguments.

        Args:
            materials: In place of the scene's own.
        """
        own = self.material_args if materials is None else materials
        return self.mesh_args, own, self.texture_args, self.receiver_args

    def shadow_geometry(self) -> tuple[Any, ...]:
        """Return `geometry` as the receiver sees it: solid glass is passed straight."""
        return self.geometry(self.shadow_material_args)

    def materials_with(self, factors: Sequence[FloatArray | None]) -> MaterialArgs:
        """Return the scene's materials with other factors, in the order of `FACTORS`; None: own."""
        args = self._copied_materials()
        for factor, (name, dtype) in zip(factors, FACTORS, strict=True):
            if factor is not None:
                setattr(args, name, wp.array(factor, dtype=dtype, device=self.device))
        if factors[3] is not None:
            args.any_emission = 1
        return args

    def _copied_materials(self) -> MaterialArgs:
        args = MaterialArgs()
        for name in cast(Any, self.material_args)._cls.vars:
            setattr(args, name, getattr(self.material_args, name))
        return args

    def contents(self) -> Iterator[NDArray[np.generic]]:
        """Yield every number that a ray can depend on, in a fixed order, for hashing."""
        structs: tuple[Any, ...] = (
            self.mesh_args,
            self.material_args,
            self.texture_args,
            self.camera_args,
            self.receiver_args,
        )
        if self.has_solid_glass:
            structs += self.glass_args, self.shadow_material_args
        for args in structs:
            for name in args._cls.vars:
                value = getattr(args, name)
                if name not in POINTERS:
                    yield value.numpy() if isinstance(value, wp.array) else np.asarray(value)

    def _array(self, values: NDArray[np.generic], dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)

    def _upload_mesh(self, parts: list[tuple[_Vertices, int]]) -> None:
        args = MeshArgs()
        args.epsilon = 1e-5 * self.diagonal
        low, high = (b - self.origin for b in self.bounds)
        args.low = wp.vec3(*(low - args.epsilon).astype(np.float32))
        args.high = wp.vec3(*(high + args.epsilon).astype(np.float32))
        # Kernels look at the handle before they read anything, but arrays may not be empty.
        if not parts:
            args.id = 0
            args.indices = self._array(np.zeros(3, np.int32), wp.int32)
            args.positions = self._array(np.zeros((1, 3), np.float32), wp.vec3)
            args.normals = self._array(np.zeros((1, 3), np.float32), wp.vec3)
            args.tangents = self._array(np.zeros((1, 4), np.float32), wp.vec4)
            args.uv0 = self._array(np.zeros((1, 2), np.float32), wp.vec2)
            args.uv1 = args.uv0
            args.colors = self._array(np.zeros((1, 4), np.float32), wp.vec4)
            args.face_material = self._array(np.zeros(1, np.int32), wp.int32)
            self.mesh_args = args
            return
        offsets = np.cumsum([0] + [len(v.positions) for v, _ in parts])
        indices = np.concatenate(
            [v.indices + o for (v, _), o in zip(parts, offsets[:-1], strict=True)]
        ).astype(np.int32)
        if indices.min() < 0 or indices.max() >= offsets[-1]:
            raise ValueError(f"vertex index outside 0..{offsets[-1] - 1}")
        positions = np.concatenate([v.positions for v, _ in parts]) - self.origin
        args.positions = self._array(positions.astype(np.float32), wp.vec3)
        args.indices = self._array(indices.reshape(-1), wp.int32)
        args.normals = self._array(
            np.concatenate([v.normals for v, _ in parts]).astype(np.float32), wp.vec3
        )
        args.tangents = self._array(
            np.concatenate([v.tangents for v, _ in parts]).astype(np.float32), wp.vec4
        )
        args.uv0 = self._array(np.concatenate([v.uv0 for v, _ in parts]), wp.vec2)
        args.uv1 = self._array(np.concatenate([v.uv1 for v, _ in parts]), wp.vec2)
        args.colors = self._array(np.concatenate([v.colors for v, _ in parts]), wp.vec4)
        args.face_material = self._array(
            np.concatenate([np.full(len(v.indices), m, np.int32) for v, m in parts]), wp.int32
        )
        # The handle is a pointer and the points are referenced: both must outlive every launch.
        # Warp's default on CUDA builds faster and traces 12 % slower; this tree is built once.
        self.mesh = wp.Mesh(points=args.positions, indices=args.indices, bvh_constructor="sah")
        args.id = self.mesh.id
        if self.device.is_cpu and (embree := library()) is not None:
            self.rays = "Embree"
            self.embree = EmbreeScene(embree, args.positions.numpy(), args.indices.numpy())
            args.embree = self.embree.handle
            args.embree_intersect, args.embree_occluded = embree.intersect, embree.occluded
        self.mesh_args = args

    def _upload_materials(self, materials: Sequence[tuple[Material, int]]) -> None:
        rows = materials or [(Material(), 0)]
        plain = [m for m, _ in rows]
        slots = [
            [_slot(getattr(m, f"{name}_texture"), first) for name in SLOTS]
            for m, (_, first) in zip(plain, rows, strict=True)
        ]
        args = MaterialArgs()
        for name in ("metallic", "roughness", "alpha", "alpha_cutoff", "normal_scale"):
            values = np.array([getattr(m, name) for m in plain], np.float32)
            setattr(args, name, self._array(values, wp.float32))
        args.base_color = self._array(np.array([m.base_color for m in plain], np.float32), wp.vec3)
        args.emission = self._array(np.array([m.emission for m in plain], np.float32), wp.vec3)
        # Rays stop at solid glass.
        extensions = [_extensions(m, 0.0 if m.is_solid_glass else m.transmission) for m in plain]
        args.extensions = wp.array(extensions, dtype=Extensions, device=self.device)
        args.any_layers = LAYERS * any(e.present for e in extensions)
        args.any_layers |= ANISOTROPY * any(e.anisotropy > 0.0 for e in extensions)
        args.any_layers |= IRIDESCENCE * any(e.iridescence > 0.0 for e in extensions)
        has_sheen = any(max(m.sheen_color) > 0.0 for m in plain)
        table = sheen_albedo_table() if has_sheen else np.zeros((2, 2))
        args.sheen_albedo = self._array(table.astype(np.float32), wp.float32)
        for name, numbers in (
            ("alpha_mode", [ALPHA_MODES[m.alpha_mode] for m in plain]),
            ("double_sided", [m.double_sided for m in plain]),
            ("slot_texture", [[s[0] for s in row] for row in slots]),
            ("slot_uv_set", [[s[1] for s in row] for row in slots]),
        ):
            setattr(args, name, self._array(np.array(numbers, np.int32), wp.int32))
        affine = np.array([[s[2] for s in row] for row in slots], np.float32)
        args.slot_u = self._array(np.ascontiguousarray(affine[:, :, :3]), wp.vec3)
        args.slot_v = self._array(np.ascontiguousarray(affine[:, :, 3:]), wp.vec3)
        has_glass = any(e.transmission > 0.0 for e in extensions)
        args.any_alpha = int(has_glass or any(m.alpha_mode != "OPAQUE" for m in plain))
        args.any_culled = int(any(not m.double_sided for m in plain))
        args.any_emission = int(any(max(m.emission) > 0.0 for m in plain))
        self.material_args = args

    def _upload_glass(
        self,
        materials: Sequence[Material],
        scales: Sequence[float],
        parts: Sequence[tuple[_Vertices, int]],
    ) -> None:
        """Upload solid glass, and the materials as rays of the shadow take them."""
        self.glass_args = GlassArgs()
        self.shadow_material_args = self.material_args
        self.has_solid_glass = any(m.is_solid_glass for m in materials)
        if not self.has_solid_glass:
            return
        absorbed = absorption(materials, scales)
        self.glass_args = glass_args(materials, absorbed, self.device)
        ways = [
            mean_way([v.positions[v.indices] for v, m in parts if m == k])
            for k in range(len(materials))
        ]
        shares = straight_shares(materials, absorbed, ways)
        extensions = [_extensions(m, share) for m, share in zip(materials, shares, strict=True)]
        args = self._copied_materials()
        args.extensions = wp.array(extensions, dtype=Extensions, device=self.device)
        args.any_alpha = 1
        self.shadow_material_args = args

    def _upload_textures(self, textures: Sequence[Texture]) -> None:
        rows = textures or [Texture(np.full((1, 1, 4), 255, np.uint8))]
        packed = [np.ascontiguousarray(t.pixels).view("<u4").reshape(-1) for t in rows]
        args = TextureArgs()
        args.texels = self._array(np.concatenate(packed), wp.uint32)
        args.offset = self._array(
            np.cumsum([0] + [len(p) for p in packed[:-1]]).astype(np.int32), wp.int32
        )
        args.width = self._array(np.array([t.pixels.shape[1] for t in rows], np.int32), wp.int32)
        args.height = self._array(np.array([t.pixels.shape[0] for t in rows], np.int32), wp.int32)
        args.wrap_u = self._array(
            np.array([WRAP_MODES[t.wrap_u] for t in rows], np.int32), wp.int32
        )
        args.wrap_v = self._array(
            np.array([WRAP_MODES[t.wrap_v] for t in rows], np.int32), wp.int32
        )
        decode = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
        args.decode = self._array(decode, wp.float32)
        self.texture_args = args
