"""Renderer of the object's G-buffer, its radiance and shadow ratio, and their tone mapping.

Pure Warp, no torch. A pixel's numbers depend on (seed, pixel, sample) alone. Pixels that do not fit
into memory at once are traced in two halves (`warpir.core.memory`), those whose radiance is not
finite are black (`warpir.render.bad_pixels`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.core.memory import Memory
from warpir.kernels.composite import tone_foreground, tone_shadow
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.tracing.gbuffer import trace_gbuffer
from warpir.kernels.types import CameraArgs, LightArgs, LightRecord, MaterialArgs, VertexRecord
from warpir.render.bad_pixels import BadPixels, all_finite, first_bad_sample_of
from warpir.render.device import Launcher, Rows
from warpir.render.device_scene import Scene
from warpir.render.launches import ObjectLaunch, ReceiverLaunch
from warpir.scene.camera import Camera
from warpir.scene.placement import box_corners
from warpir.scene.tone_curves import ToneKnots

FULL_THREADS = 1 << 18
"""Threads that fill a CUDA device; with fewer pixels, several threads share a pixel's samples."""
GLASS_SAMPLES = 8
"""Factor on the samples of the G-buffer for clear glass, which few samples hit."""
PILOT_SCALE = 4
"""Side of the pixel blocks of the pilot pass for the receiver's shadow [px]."""
PILOT_SAMPLES = 32
UNSEEN_SHADOW = 1e-3
"""Loss of light below which no shadow is traced [1]: an eighth of an 8-bit code at white."""
UNSEEN_GAIN = 2e-3
"""Gain of light below which it is not traced [1]: a quarter of an 8-bit code at white."""


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
    """Launches the kernels over one scene.

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
        super().__init__(scene.device, threads, progress)
        self.bounce_depth = bounce_depth if scene.triangle_count else 0
        self.scene = scene
        self.memory, self.lower = memory or Memory(str(self.device.alias)), lower
        self.is_ordered = is_ordered or bool(self.device.is_cpu)
        self.bad_pixels = BadPixels()

    def candidate_pixels(self, camera: Camera) -> IntArray:
        """Return a superset of the object's pixels by its bounding box, row-major."""
        uv = camera.project(box_corners(*self.scene.bounds))
        if np.isnan(uv).any():
            left, top, right, bottom = 0, 0, camera.width, camera.height
        else:
            left, top = np.maximum(np.floor(uv.min(axis=0)).astype(int) - 1, 0)
            right, bottom = np.ceil(uv.max(axis=0)).astype(int) + 1
            right, bottom = min(right, camera.width), min(bottom, camera.height)
        if right <= left or bottom <= top or self.scene.triangle_count == 0:
            return np.zeros(0, np.int32)
        rows = np.arange(top, bottom, dtype=np.int64)[:, None] * camera.width
        return (rows + np.arange(left, right)[None]).reshape(-1).astype(np.int32)

    def gbuffer(self, seed: int, spp: int = 8) -> GBuffer:
        """Trace the object's geometry and materials.

        ``object_pixels`` are those that a sample hits and their neighbours, so that a pixel whose
        corner alone is covered is still traced.
        """
        scene, camera = self.scene, self.scene.camera
        if scene.has_glass:
            # Clear glass stops 1 ray in 25.
            spp *= GLASS_SAMPLES
        candidates = self.candidate_pixels(camera)
        names = ("coverage", "position", "normal", "base_color", "roughness", "emission")
        vectors = {"position", "normal", "base_color", "emission"}

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            out = [
                self.zeros(stop - start, wp.vec3 if name in vectors else float) for name in names
            ]
            self.launch(
                trace_gbuffer,
                stop - start,
                [
                    Rows(self.upload(candidates[start:stop], wp.int32)),
                    scene.camera_args,
                    *scene.geometry(),
                    spp,
                    seed,
                    *map(Rows, out),
                ],
                spp,
                "geometry",
            )
            return tuple(array.numpy()[: stop - start] for array in out)

        coverage, *planes = self._in_chunks(trace, len(candidates), "geometry")
        traced = self.bad_pixels.blackened(tuple(planes), candidates, camera.width, "geometry")
        host: dict[str, Any] = dict(zip(names, (coverage, *traced), strict=True))
        hit = np.zeros((camera.height, camera.width), bool)
        hit.reshape(-1)[candidates] = host["coverage"] > 0.0
        near = _dilate(hit)
        keep = near.reshape(-1)[candidates]
        host = {name: values[keep] for name, values in host.items()}
        # In float64: float32 is 8 mm coarse 100 km from the origin, and depth follows from this.
        host["position"] = host["position"].astype(np.float64) + self.scene.origin
        return GBuffer(object_pixels=candidates[keep], **host)

    def _in_chunks(
        self, trace: Callable[[int, int], tuple[FloatArray, ...]], count: int, stage: str
    ) -> tuple[FloatArray, ...]:
        """Return ``trace`` of all pixels, in halves where memory is short."""
        parts = [*self.memory.in_chunks(trace, count, f"rendering the {stage}", self.lower)]
        return tuple(p[0] if len(p) == 1 else np.concatenate(p) for p in zip(*parts, strict=True))

    def lanes(self, count: int, spp: int) -> int:
        """Return the number of threads that share the samples of each of ``count`` pixels."""
        lanes = 1
        if self.device.is_cuda:
            while 0 < count * lanes * 2 <= FULL_THREADS and spp % (2 * lanes) == 0:
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
    ) -> Foreground:
        """Path-trace the object alone (DiPIR, eq. 4).

        Args:
            light: From `light_args`.
            pixels: Row-major pixel indices, shape [object_pixel].
            spp: Camera samples per pixel.
            rays: Paths per camera sample, each with one direction per technique.
            depth: Surface interactions.
            seed: Base seed.
            indirect_limit: Most radiance that one path may add behind its first vertex, or 0: no
                limit, unbiased.
            light_record: Filled on the way where given; rows are ``pixels``, `lanes` of each.
                Without a limit only.
            vertex_record: The same.
            materials: In place of the scene's own (`Scene.materials_with`).
        """
        own = materials or self.scene.material_args
        view = self.scene.camera_args
        launch = ObjectLaunch(light, own, view, rays, depth, indirect_limit, seed)
        lanes = self.lanes(len(pixels), spp)

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            # As many lanes as all pixels have together: sums keep their order.
            records = (
                r if r is None else Rows(r).cut(start * lanes, stop * lanes)
                for r in (light_record, vertex_record)
            )
            return launch.sums(self, pixels[start:stop], spp, lanes, *records)

        def first_bad_sample(pixel: int) -> int | None:
            alone = np.array([pixel], np.int32)
            return first_bad_sample_of(
                lambda spp: not all_finite(launch.sums(self, alone, spp, 1)), spp
            )

        *planes, mask = self._in_chunks(trace, len(pixels), "object")
        width = self.scene.camera.width
        traced = self.bad_pixels.blackened(tuple(planes), pixels, width, "object", first_bad_sample)
        radiance, diffuse, emission = traced
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
            record: Filled on the way where given; rows are ``pixels``.
            thrown_record: The same of the light that the object throws there, RGB weights of `lit`.
            indirect_limit: Limit of `foreground`; `THROWN_LIMIT` of it is the most radiance that
                one path of that light may add. 0: no limit.
            may_gain: False where the object throws nothing, as `changed_pixels` returns it, shape
                [receiver_pixel]; None: it may everywhere. A ``thrown_record`` needs all of them.
        """
        view = self.scene.camera_args if camera_args is None else camera_args
        launch = ReceiverLaunch(light, view, rays, seed, self.bounce_depth, indirect_limit)

        gain = np.ones(len(pixels), np.bool_) if may_gain is None else may_gain
        assert thrown_record is None or gain.all(), "rows of the record are pixels"

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            part = slice(start, stop)
            cut = (r if r is None else Rows(r).cut(start, stop) for r in (record, thrown_record))
            return launch.sums(self, pixels[part], may_see_object[part], gain[part], spp, *cut)

        def first_bad_sample(pixel: int) -> int | None:
            alone = np.array([pixel], np.int32)
            hidden, gains = may_see_object[pixels == pixel], gain[pixels == pixel]
            return first_bad_sample_of(
                lambda spp: not all_finite(launch.sums(self, alone, hidden, gains, spp)), spp
            )

        stage, width = "shadow", self.scene.camera.width
        if camera_args is not None:
            stage, width = "shadow in another resolution", int(camera_args.width)
        traced = self._in_chunks(trace, len(pixels), stage)
        # Black with and without the object: there the photo stays as it is.
        traced = self.bad_pixels.blackened(traced, pixels, width, stage, first_bad_sample)
        return ReceiverRadiance(*traced)

    def shaded_pixels(self, light: LightArgs, seed: int) -> IntArray:
        """Return the pixels where the object may change the plane's light, row-major."""
        return self.changed_pixels(light, seed)[0]

    def changed_pixels(
        self, light: LightArgs, seed: int, indirect_limit: float = 0.0
    ) -> tuple[IntArray, BoolArray]:
        """Return `shaded_pixels`, and which of them the object may throw light on.

        A pilot pass traces the same rays over blocks of `PILOT_SCALE` pixels, each sample at a
        position of its own in the block. A block whose 3 x 3 neighbourhood loses less than
        `UNSEEN_SHADOW` of its light and gains less than `UNSEEN_GAIN` is left alone and stays the
        photo, bit for bit.

        Args:
            light: From `light_args`.
            seed: Base seed.
            indirect_limit: As `receiver` has it.
        """
        camera = self.scene.camera
        width, height = -(-camera.width // PILOT_SCALE), -(-camera.height // PILOT_SCALE)
        # Blocks at the right and lower border reach past the photo; the intrinsics are the photo's.
        coarse = Camera(
            width,
            height,
            camera.fx / PILOT_SCALE,
            camera.fy / PILOT_SCALE,
            camera.cx / PILOT_SCALE,
            camera.cy / PILOT_SCALE,
            camera.c2w,
        )
        if self.scene.triangle_count == 0:
            return np.zeros(0, np.int32), np.zeros(0, np.bool_)
        pixels = np.arange(width * height, dtype=np.int32)
        pilot = self.receiver(
            light,
            pixels,
            np.zeros(len(pixels), np.int32),
            PILOT_SAMPLES,
            1,
            seed,
            self.scene.camera_args_at(coarse),
            indirect_limit=indirect_limit,
        )
        lost = pilot.unoccluded - (pilot.lit - pilot.thrown)

        def pixels_of(change: FloatArray, unseen: float) -> BoolArray:
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(pilot.unoccluded > 0.0, np.abs(change) / pilot.unoccluded, 0.0)
            share = share.max(axis=1).reshape(height, width)
            blocks = _dilate(_mean_of_neighbours(share) > unseen)
            full = blocks.repeat(PILOT_SCALE, axis=0).repeat(PILOT_SCALE, axis=1)
            seen: BoolArray = full[: camera.height, : camera.width].reshape(-1)
            return seen

        gains = pixels_of(pilot.thrown, UNSEEN_GAIN)
        shaded = np.flatnonzero(pixels_of(lost, UNSEEN_SHADOW) | gains).astype(np.int32)
        return shaded, gains[shaded]

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

    def tone(
        self,
        foreground: Foreground,
        ratio: FloatArray,
        curve_fg: ToneKnots,
        curve_shadow: ToneKnots,
        is_reinhard: bool,
    ) -> tuple[FloatArray, FloatArray]:
        """Map object radiance and shadow ratio to display-linear values, shapes [row, 3]."""
        objects, receivers = len(foreground.mask), len(ratio)
        fg = self.zeros(objects, wp.vec3)
        shadow = self.zeros(receivers, wp.vec3)
        self.launch(
            tone_foreground,
            objects,
            [
                Rows(self.upload(foreground.radiance, wp.vec3)),
                Rows(self.upload(foreground.mask, wp.float32)),
                int(is_reinhard),
                *(self.upload(k, wp.float32) for k in curve_fg.arrays()),
                curve_fg.bin_count,
                Rows(fg),
            ],
            1,
        )
        self.launch(
            tone_shadow,
            receivers,
            [
                Rows(self.upload(ratio, wp.vec3)),
                *(self.upload(k, wp.float32) for k in curve_shadow.arrays()),
                curve_shadow.bin_count,
                Rows(shadow),
            ],
            1,
        )
        return fg.numpy()[:objects], shadow.numpy()[:receivers]


def index_of(pixels: IntArray, count: int) -> IntArray:
    """Return the row of each pixel in ``pixels``, or -1, shape [count]."""
    index = np.full(count, -1, np.int32)
    index[pixels] = np.arange(len(pixels), dtype=np.int32)
    return index


def _mean_of_neighbours(values: FloatArray) -> FloatArray:
    """Average each value with its eight neighbours."""
    return np.asarray(sum(_neighbourhood(np.pad(values, 1, mode="edge"))) / 9.0, np.float32)


def _dilate(mask: BoolArray) -> BoolArray:
    """Grow a mask by one pixel in all eight directions."""
    return np.asarray(np.any(_neighbourhood(np.pad(mask, 1)), axis=0))


def _neighbourhood(padded: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the nine shifts of an array that is padded by one on all sides."""
    rows, columns = padded.shape[0] - 2, padded.shape[1] - 2
    return [padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)]
