"""Renderer of the object's G-buffer, its radiance and the shadow ratio.

Pure Warp, no torch. A pixel's numbers depend on seed, pixel and number of samples alone, but where
noise shares these out. Pixels that do not fit into memory at once are traced in two halves
(`warpir.core.memory`), those whose radiance is not finite are black (`warpir.render.bad_pixels`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.core.memory import Memory
from warpir.kernels.maths.lanes import LANES_MAX
from warpir.kernels.path import Viewer
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.types import CameraArgs, LightArgs, LightRecord, MaterialArgs, VertexRecord
from warpir.render.allocation import Sharing, by_noise
from warpir.render.bad_pixels import BadPixels, all_finite, first_bad_sample_of
from warpir.render.device import Launcher, Rows, load_kernels
from warpir.render.device_light import PlaneLight, drawn, plane_radiance
from warpir.render.device_scene import Scene
from warpir.render.launches import (
    THROWN_LIMIT,
    ObjectLaunch,
    ReceiverLaunch,
    ReceiverRows,
    geometry_of,
    launch_of_part,
    variant_of,
)
from warpir.render.shadow.pilot import dilate
from warpir.scene.camera import Camera
from warpir.scene.placement import box_corners

FULL_THREADS = 1 << 20
"""Threads that fill a CUDA device; with fewer pixels, several threads share a pixel's samples."""
GLASS_SAMPLES = 8
"""Factor on the samples of the G-buffer for clear glass, which few samples hit."""


@dataclass(frozen=True)
class GBuffer:
    """Geometry and material of the object, averaged over each pixel; a row an object pixel."""

    object_pixels: IntArray
    """Row-major pixel indices, shape [object_pixel]."""
    coverage: FloatArray
    """Share of the pixel that shows the object [1]; a first, coarse estimate of the mask."""
    position: Float64Array
    """Position, world frame [m], shape [object_pixel, 3]."""
    normal: FloatArray
    """Unit shading normal, world frame, shape [object_pixel, 3]."""
    base_color: FloatArray
    """Base colour, linear RGB [1], shape [object_pixel, 3]."""
    roughness: FloatArray
    """Perceptual roughness [1], shape [object_pixel]."""
    emission: FloatArray
    """Emitted radiance, relative [W/(m^2 sr)], shape [object_pixel, 3]."""


@dataclass(frozen=True)
class Foreground:
    """Radiance of the object alone; a row a traced pixel."""

    radiance: FloatArray
    """Radiance premultiplied by ``mask``, relative [W/(m^2 sr)], shape [object_pixel, 3]."""
    diffuse: FloatArray
    """Part reflected by the first hit's diffuse lobe, shape [object_pixel, 3]."""
    emission: FloatArray
    """Part emitted by the first hit, shape [object_pixel, 3]."""
    mask: FloatArray
    """Coverage of the pixel [1], shape [object_pixel]."""


@dataclass(frozen=True)
class ReceiverRadiance:
    """Radiance of the white receiver with and without the object; a row a traced pixel."""

    lit: FloatArray
    """Radiance with the object, relative [W/(m^2 sr)], shape [receiver_pixel, 3]; what the object
    throws there is in it where the renderer has a `bounce_depth`."""
    unoccluded: FloatArray
    """Radiance without the object, shape [receiver_pixel, 3]."""
    thrown: FloatArray
    """What the object throws there, a part of ``lit``, shape [receiver_pixel, 3]."""


class Renderer(Launcher):
    """Launches the kernels over one scene; pixels outside its picture are a ValueError.

    Args:
        scene: Scene to render, never changed.
        threads: CPU threads; 0 means one per core. Ignored on CUDA.
        progress: Called with the share of a stage that is done, 0 to 1, from worker threads.
        memory: Counts repeated launches for want of memory.
        lower: Flag that lowers the memory of a picture, for errors.
        is_ordered: Whether sums are to have one order on CUDA too, where that costs time.
        bounce_depth: Interactions with the object of light that it throws onto the receiver; 0
            leaves that light out, as DiPIR's ratio does.

    Attributes:
        bad_pixels: Counts of pixels that are not finite.
        mean_samples: Of a pixel, when object and shadow were last traced.
    """

    def __init__(
        self,
        scene: Scene,
        threads: int = 0,
        progress: Callable[[str, float], None] | None = None,
        memory: Memory | None = None,
        lower: str = "--width",
        is_ordered: bool = False,
        bounce_depth: int = 0,
    ) -> None:
        needs = bool(scene.lamps), scene.has_solid_glass, scene.material_args.any_layers
        super().__init__(scene.device, threads, progress, needs)
        self.bounce_depth = bounce_depth if scene.triangle_count else 0
        self.scene = scene
        self.memory, self.lower = memory or Memory(str(self.device.alias)), lower
        self.is_ordered = is_ordered or bool(self.device.is_cpu)
        self.bad_pixels = BadPixels()
        self.mean_samples: dict[str, float] = {}
        self._on_plane = PlaneLight(scene.receiver.normal)

    def load_kernels(self, mirrors: bool = False) -> None:
        """Compile or load what a picture of the scene needs, all at once.

        Else each kernel is compiled when it is first launched, one after the other.

        Args:
            mirrors: Whether the ground shows the object's mirror image.
        """
        scene, viewers = self.scene, [Viewer.CAMERA]
        viewers += [Viewer.GROUND] if self.bounce_depth else []
        viewers += [Viewer.MIRROR] if mirrors else []
        variants = [variant_of(scene, scene.material_args, viewer) for viewer in viewers]
        load_kernels(self.device, variants, self._progress)

    def candidate_pixels(self, camera: Camera) -> IntArray:
        """Return a superset of the object's pixels and their neighbours, row-major."""
        count = self.scene.triangle_count
        if not count:
            return np.zeros(0, np.int32)
        pixels = camera.pixels_of_box(box_corners(*self.scene.bounds))
        if count < len(pixels):  # else rays that miss are as cheap
            pixels = pixels[camera.tiles_of(*self.scene.triangles()).reshape(-1)[pixels]]
        return pixels

    def gbuffer(self, seed: int, spp: int = 8) -> GBuffer:
        """Trace the object's geometry and materials.

        ``object_pixels`` are those that a sample hits and their neighbours, so that a pixel whose
        corner alone is covered is still traced.
        """
        camera = self.scene.camera
        candidates = self.candidate_pixels(camera)
        names = ("coverage", "position", "normal", "base_color", "roughness", "emission")
        coverage, *planes = self._traced_geometry(candidates, spp, seed)
        if self.scene.glass_bounds is not None:
            # Clear glass stops 1 ray in 25: few samples may all have missed it.
            is_glass = np.zeros(camera.height * camera.width, bool)
            is_glass[camera.pixels_of_box(box_corners(*self.scene.glass_bounds))] = True
            thin = np.flatnonzero((coverage < 1.0) & is_glass[candidates])
            again = self._traced_geometry(candidates[thin], spp * GLASS_SAMPLES, seed)
            for plane, better in zip((coverage, *planes), again, strict=True):
                plane[thin] = better
        traced = self.bad_pixels.blackened(tuple(planes), candidates, camera.width, "geometry")
        host: dict[str, Any] = dict(zip(names, (coverage, *traced), strict=True))
        hit = np.zeros((camera.height, camera.width), bool)
        hit.reshape(-1)[candidates] = host["coverage"] > 0.0
        near = dilate(hit)
        keep = near.reshape(-1)[candidates]
        host = {name: values[keep] for name, values in host.items()}
        # In float64: float32 is 8 mm coarse 100 km from the origin, and depth follows from this.
        host["position"] = host["position"].astype(np.float64) + self.scene.origin
        return GBuffer(object_pixels=candidates[keep], **host)

    def _traced_geometry(self, pixels: IntArray, spp: int, seed: int) -> tuple[FloatArray, ...]:
        """Return coverage, position, normal, base colour, roughness and emission, a row a pixel."""

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            return geometry_of(self, pixels[start:stop], spp, seed)

        return self._in_chunks(trace, len(pixels), "geometry")

    def _in_chunks(
        self, trace: Callable[[int, int], tuple[FloatArray, ...]], count: int, stage: str
    ) -> tuple[FloatArray, ...]:
        """Return ``trace`` of all pixels, in halves where memory is short."""
        parts = [*self.memory.in_chunks(trace, count, f"rendering the {stage}", self.lower)]
        return tuple(p[0] if len(p) == 1 else np.concatenate(p) for p in zip(*parts, strict=True))

    def lanes(self, count: int, spp: int) -> int:
        """Return the number of threads that share the samples of each of ``count`` pixels."""
        lanes, most = 1, FULL_THREADS // max(count, 1) if self.device.is_cuda else 1
        while 2 * lanes <= min(most, LANES_MAX) and spp % (2 * lanes) == 0:
            lanes *= 2
        return lanes

    def foreground(
        self,
        light: LightArgs,
        pixels: IntArray,
        spp: int,
        rays: int,
        depth: int,
        seed: int,
        indirect_limit: float = 0.0,
        light_record: LightRecord | None = None,
        vertex_record: VertexRecord | None = None,
        materials: MaterialArgs | None = None,
        is_recorded: bool = False,
        sharing: Sharing | None = None,
    ) -> Foreground:
        """Path-trace the object alone (DiPIR, eq. 4).

        Args:
            light: From `light_args`.
            pixels: Row-major pixel indices, shape [object_pixel].
            spp: Camera samples per pixel.
            rays: Paths per camera sample, each with one direction per technique.
            depth: Surface interactions.
            seed: Base seed.
            indirect_limit: Most radiance that each vertex behind the first may add to a path, or 0:
                no limit, unbiased. With ``sharing``, in a pixel of ``spp`` samples.
            light_record: Filled where given, without a limit; rows are ``pixels``, `lanes` of each.
            vertex_record: The same.
            materials: In place of the scene's own (`Scene.materials_with`).
            is_recorded: Draw what a record holds also where none is given. Else the first vertex
                picks among several directions of the light, which is less noisy.
            sharing: Where given, ``spp`` is a mean, which `Sharing.noise` may raise, and samples go
                where radiance is noisy: a pixel's depend on the others, and no record is kept.
        """
        if len(pixels) == 0:
            none = np.zeros((0, 3), np.float32)
            return Foreground(none, none, none, none[:, 0])
        own, view = materials or self.scene.material_args, self.scene.camera_args
        drawn_light = drawn(self, light, seed, spp * rays)
        launch = ObjectLaunch(
            drawn_light, own, view, rays, depth, indirect_limit, seed, is_recorded=is_recorded
        )
        return self._object(launch, pixels, spp, (light_record, vertex_record), sharing)

    def _object(
        self,
        launch: ObjectLaunch,
        pixels: IntArray,
        spp: int,
        records: tuple[LightRecord | VertexRecord | None, ...],
        sharing: Sharing | None,
    ) -> Foreground:
        """Trace what `foreground` has set up."""

        def rows_of(rows: IntArray, count: int, number: int) -> tuple[FloatArray, ...]:
            own = launch_of_part(launch, number, count / spp)
            lanes = self.lanes(len(rows), count)

            def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
                # As many lanes as all rows have together: sums keep their order.
                first, last = start * lanes, stop * lanes
                cut = (r if r is None else Rows(r).cut(first, last) for r in records)
                return own.sums(self, pixels[rows[start:stop]], count, lanes, *cut)

            return self._in_chunks(trace, len(rows), "object")

        def first_bad_sample(pixel: int) -> int | None:
            alone = np.array([pixel], np.int32)
            return first_bad_sample_of(
                lambda spp: not all_finite(launch.sums(self, alone, spp, 1)), spp
            )

        width = self.scene.camera.width
        (*planes, mask), self.mean_samples["object"] = by_noise(
            self, rows_of, sharing, pixels, width, (spp, launch.rays)
        )
        traced = self.bad_pixels.blackened(tuple(planes), pixels, width, "object", first_bad_sample)
        radiance, diffuse, emission = traced
        # The whole is bounded by what was gathered, its parts are not (`variate_share`).
        emission = np.minimum(emission, radiance)
        diffuse = np.minimum(diffuse, radiance - emission)
        return Foreground(radiance, diffuse, emission, mask)

    def receiver(
        self,
        light: LightArgs,
        pixels: IntArray,
        may_see_object: IntArray,
        spp: int,
        rays: int,
        seed: int,
        camera_args: CameraArgs | None = None,
        record: LightRecord | None = None,
        thrown_record: LightRecord | None = None,
        indirect_limit: float = 0.0,
        may_gain: BoolArray | None = None,
        is_recorded: bool = False,
        sharing: Sharing | None = None,
    ) -> ReceiverRadiance:
        """Radiance of the white receiver with and without the object (both halves of DiPIR, eq. 5).

        With a `bounce_depth` the first half is that of differential rendering (Debevec 1998,
        "Rendering Synthetic Objects into Real Scenes", eq. 3): all light that the ground receives
        with the object there, also what the object reflects and emits.

        Args:
            light: From `light_args`.
            pixels: Row-major pixel indices, shape [receiver_pixel].
            may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
            spp: Camera samples per pixel.
            rays: Directions per technique and camera sample.
            seed: Base seed.
            camera_args: Another resolution of the view, or the scene's own.
            record: Filled on the way where given; rows are ``pixels``, `lanes` of each.
            thrown_record: The same of the light that the object throws there, RGB weights of `lit`.
            indirect_limit: Of `foreground`; what is thrown has `THROWN_LIMIT` of it. 0: no limit.
            may_gain: False where the object throws nothing (`warpir.render.shadow.pilot`), shape
                [receiver_pixel]; None: it may everywhere. A ``thrown_record`` needs all of them.
            is_recorded: Draw what a record holds also where none is given. Else a plane's loss is
                sampled, which is less noisy (`warpir.kernels.receiver.trace_plane_shadow`).
            sharing: As in `foreground`, by the noise of the ratio.
        """
        if len(pixels) == 0:
            none = np.zeros((0, 3), np.float32)
            return ReceiverRadiance(none, none, none)
        normal = self.scene.receiver.normal if self.scene.receiver.mesh is None else None
        from_light = light if normal is None else self._on_plane.of(light)
        from_light = drawn(self, from_light, seed, spp * rays)
        launch = ReceiverLaunch(
            from_light,
            drawn(self, light, seed, spp * rays) if self.bounce_depth else None,
            None if normal is None or is_recorded else plane_radiance(self, from_light, normal),
            self.scene.camera_args if camera_args is None else camera_args,
            rays,
            seed,
            self.bounce_depth,
            indirect_limit,
            is_recorded,
        )
        gain = np.ones(len(pixels), np.bool_) if may_gain is None else may_gain
        assert thrown_record is None or gain.all(), "rows of the record are pixels"
        rows, records = ReceiverRows(pixels, may_see_object, gain), (record, thrown_record)
        return self._white_radiance(launch, rows, spp, records, camera_args, sharing)

    def _white_radiance(
        self,
        launch: ReceiverLaunch,
        rows: ReceiverRows,
        spp: int,
        records: tuple[LightRecord | None, LightRecord | None],
        camera_args: CameraArgs | None,
        sharing: Sharing | None,
    ) -> ReceiverRadiance:
        """Trace what `receiver` has set up."""
        stage, width = "shadow", self.scene.camera.width
        if camera_args is not None:
            stage, width = "shadow in another resolution", int(camera_args.width)

        def rows_of(chosen: IntArray, count: int, number: int) -> tuple[FloatArray, ...]:
            own = launch_of_part(launch, number, count / spp)
            lanes = self.lanes(len(chosen), count)

            def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
                first, last = start * lanes, stop * lanes
                cut = (r if r is None else Rows(r).cut(first, last) for r in records)
                return own.sums(self, rows.at(chosen[start:stop]), count, lanes, *cut)

            traced = self._in_chunks(trace, len(chosen), stage)
            if number:
                lit, unoccluded, _ = traced
                return (np.asarray(lit / np.maximum(unoccluded, 1e-12), np.float32),)
            return traced

        def first_bad_sample(pixel: int) -> int | None:
            alone = rows.at(rows.pixels == pixel)
            return first_bad_sample_of(
                lambda spp: not all_finite(launch.sums(self, alone, spp, 1)), spp
            )

        traced, self.mean_samples[stage] = by_noise(
            self, rows_of, sharing, rows.pixels, width, (spp, launch.rays)
        )
        # Black with and without the object: there the photo stays as it is.
        traced = self.bad_pixels.blackened(traced, rows.pixels, width, stage, first_bad_sample)
        return ReceiverRadiance(*traced)

    def thrown(
        self,
        light: LightArgs,
        pixels: IntArray,
        spp: int,
        rays: int,
        seed: int,
        camera_args: CameraArgs,
        indirect_limit: float,
    ) -> FloatArray:
        """Return the radiance that the object throws on a plane, shape [receiver_pixel, 3].

        Arguments as `receiver` has them. Where the object hides the plane, this is what it throws
        behind itself.
        """
        from_light, depth = drawn(self, light, seed, spp * rays), self.bounce_depth
        launch = ReceiverLaunch(
            from_light, from_light, None, camera_args, rays, seed, depth, indirect_limit
        ).thrown(self)
        lanes = self.lanes(len(pixels), spp)

        def trace(start: int, stop: int) -> tuple[FloatArray]:
            nothing = np.zeros(stop - start, np.int32)
            return (launch.thrown(self, pixels[start:stop], nothing, spp, lanes),)

        return self._in_chunks(trace, len(pixels), "bounce in blocks")[0]

    def mirrored(
        self,
        light: LightArgs,
        pixels: IntArray,
        may_see_object: IntArray,
        roughness: float,
        spp: int,
        rays: int,
        depth: int,
        seed: int,
        indirect_limit: float = 0.0,
        behind: LightArgs | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the object's mirror image in a glossy plane, what it hides, and what it does not.

        Radiance, ``F L`` over the coat's GGX normals, of the object, of the light behind it and of
        that beside it; for a receiver without a mesh. Means over the samples that see the plane,
        shape [receiver_pixel, 3] each.

        Args:
            light: Light on the object.
            pixels: Row-major pixel indices, shape [receiver_pixel].
            may_see_object: 1 where the object may hide the receiver, shape [receiver_pixel].
            roughness: Perceptual roughness of the coat [1]; 0 is a mirror.
            spp: Camera samples per pixel.
            rays: Directions per camera sample.
            depth: Largest number of interactions with the object.
            seed: Base seed.
            indirect_limit: Limit of `foreground`; `THROWN_LIMIT` of it is the most that a path may
                add, as in `receiver`: the sun's glint on the object, mirrored, leaves specks.
            behind: What the coat mirrors without the object; None: the light.
        """
        assert self.scene.receiver.mesh is None
        scene = self.scene
        launch = ObjectLaunch(
            drawn(self, light, seed, spp * rays),
            scene.material_args,
            scene.camera_args,
            rays,
            depth,
            THROWN_LIMIT * indirect_limit,
            seed,
            roughness,
            behind,
        )

        lanes = self.lanes(len(pixels), spp)

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            part = slice(start, stop)
            return launch.mirrored(self, pixels[part], may_see_object[part], spp, lanes)

        traced = self._in_chunks(trace, len(pixels), "mirror image")
        image, hidden, kept = self.bad_pixels.blackened(
            traced, pixels, scene.camera.width, "mirror image"
        )
        return image, hidden, kept

    def ratio(self, radiance: ReceiverRadiance) -> FloatArray:
        """Return the shadow ratio per channel, shape [receiver_pixel, 3]."""
        count = len(radiance.lit)
        out = self.zeros(count, wp.vec3)
        self.launch(
            shadow_ratio,
            count,
            [
                Rows(self.upload(radiance.lit, wp.vec3)),
                Rows(self.upload(radiance.unoccluded, wp.vec3)),
                Rows(out),
            ],
            1,
        )
        ratio: FloatArray = out.numpy()[:count]
        return ratio


def index_of(pixels: IntArray, count: int) -> IntArray:
    """Return the row of each pixel in ``pixels``, or -1, shape [count]."""
    index = np.full(count, -1, np.int32)
    index[pixels] = np.arange(len(pixels), dtype=np.int32)
    return index
