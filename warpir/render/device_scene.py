"""The scene on one device: triangles, materials, textures, receiver, camera.

Everything is checked here once. Coordinates are recentred on the object, in float64, before they
become float32, so an object 100 km from the origin keeps its precision.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.kernels.receiver_mesh import trace_seen
from warpir.kernels.types import CameraArgs, GlassArgs, MaterialArgs, ReceiverArgs
from warpir.render.device_light import lamp_args
from warpir.render.glass.solid import absorption, glass_args, mean_way, straight_shares
from warpir.render.rays.embree import EmbreeScene, library
from warpir.render.upload.materials import material_args, passed_straight, with_factors
from warpir.render.upload.textures import texture_args
from warpir.render.upload.triangles import Vertices, box_of, to_world, triangle_args
from warpir.scene.asset import Asset, Material, Texture
from warpir.scene.camera import Camera
from warpir.scene.near.lamps import Lamp
from warpir.scene.receiver import ReceiverMesh

POINTERS = (
    "id", "passing", "mesh", "embree", "embree_passing", "embree_intersect", "embree_occluded"
)  # fmt: skip
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
        parts: list[tuple[Vertices, int]] = []
        materials: list[tuple[Material, int]] = []
        scales: list[float] = []
        textures: list[Texture] = []
        for placed in objects:
            for primitive in placed.asset.primitives:
                vertices = to_world(primitive, placed.asset_to_world)
                parts.append((vertices, len(materials) + primitive.material))
            first_texture = len(textures)
            materials += [(m, first_texture) for m in placed.asset.materials]
            scale = abs(float(np.linalg.det(placed.asset_to_world[:3, :3]))) ** (1.0 / 3.0)
            scales += [scale] * len(placed.asset.materials)
            textures += placed.asset.textures
        # Those that stop every ray come first.
        parts.sort(key=lambda part: materials[part[1]][0].may_be_passed)
        passing_start = sum(len(v.indices) for v, m in parts if not materials[m][0].may_be_passed)
        thin = {k for k, (m, _) in enumerate(materials) if m.transmission and not m.is_solid_glass}
        eye = camera.c2w[:3, 3]
        self.bounds = box_of(v for v, _ in parts) or (eye, eye)
        self.glass_bounds = box_of(v for v, material in parts if material in thin)
        low, high = self.bounds
        self.origin: Float64Array = 0.5 * (low + high)
        self.diagonal = float(np.linalg.norm(high - low))
        self.triangle_count = sum(len(v.indices) for v, _ in parts)

        self._upload_mesh(parts, passing_start)
        self.material_args = material_args(materials, self.device)
        self._upload_glass([m for m, _ in materials], scales, parts)
        self.texture_args = texture_args(textures, self.device)
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
        if mesh is not None:
            positions = mesh.positions - self.origin
            args.positions = self._array(positions.astype(np.float32), wp.vec3)
            args.indices = self._array(mesh.indices.reshape(-1), wp.int32)
            self.receiver_mesh = wp.Mesh(
                points=args.positions, indices=args.indices, bvh_constructor="sah"
            )
            args.mesh = self.receiver_mesh.id
            args.epsilon = RECEIVER_EPSILON * float(np.linalg.norm(np.ptp(positions, axis=0)))
        # Without a mesh, the ground behind glass is what the photo shows there.
        elif not self.has_solid_glass or receiver.radiance is None:
            return args
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

    def triangles(self) -> tuple[Float64Array, IntArray]:
        """Return all vertices in the world [m], shape [vertex, 3], and triangles of them."""
        points = self.mesh_args.positions.numpy() + self.origin
        return points, self.mesh_args.indices.numpy().reshape(-1, 3)

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
        return with_factors(self.material_args, factors, self.device)

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

    def _upload_mesh(self, parts: Sequence[tuple[Vertices, int]], passing_start: int) -> None:
        args = triangle_args(parts, self.origin, self.device)
        args.epsilon = 1e-5 * self.diagonal
        low, high = (b - self.origin for b in self.bounds)
        args.low = wp.vec3(*(low - args.epsilon).astype(np.float32))
        args.high = wp.vec3(*(high + args.epsilon).astype(np.float32))
        args.passing_start = passing_start
        self.mesh_args = args
        # Handles are pointers and the points are referenced: all must outlive every launch.
        self.trees: list[wp.Mesh | EmbreeScene] = []
        args.id, args.embree = self._upload_tree(0, passing_start)
        args.passing, args.embree_passing = self._upload_tree(passing_start, self.triangle_count)
        self.has_passing = passing_start < self.triangle_count

    def _upload_tree(self, start: int, stop: int) -> tuple[int, int]:
        """Build the trees of some triangles; return the handles of Warp's and of Embree's, or 0."""
        if start == stop:
            return 0, 0
        args = self.mesh_args
        indices = args.indices[3 * start : 3 * stop]
        # Warp's default on CUDA builds faster and traces 12 % slower; this tree is built once.
        tree = wp.Mesh(points=args.positions, indices=indices, bvh_constructor="sah")
        self.trees.append(tree)
        if not self.device.is_cpu or (embree := library()) is None:
            return tree.id, 0
        self.rays = "Embree"
        scene = EmbreeScene(embree, args.positions.numpy(), indices.numpy())
        self.trees.append(scene)
        args.embree_intersect, args.embree_occluded = embree.intersect, embree.occluded
        return tree.id, scene.handle

    def _upload_glass(
        self,
        materials: Sequence[Material],
        scales: Sequence[float],
        parts: Sequence[tuple[Vertices, int]],
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
        self.shadow_material_args = passed_straight(
            self.material_args, materials, shares, self.device
        )
