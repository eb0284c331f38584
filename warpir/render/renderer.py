"""Renderer: launches the stages in order. Pure Warp, no torch.

On the CPU a Warp launch runs on one core, so every launch is cut into row slices that a thread pool
works through; on CUDA it is one launch. A pixel's numbers depend on (seed, pixel, sample) alone, so
slices and threads do not change a result. Pixels that do not fit into memory at once are traced in
two halves (`warpir.core.memory`), those whose radiance is not finite are black
(`warpir.render.bad_pixels`).
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warpir.core.arrays import AnyFloatArray, BoolArray, Float64Array, FloatArray, IntArray
from warpir.core.cache import KernelCache
from warpir.core.color import luminance
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import Memory
from warpir.io.images.decoder import captured_stderr
from warpir.kernels.composite import tone_foreground, tone_shadow
from warpir.kernels.path import foreground_kernel
from warpir.kernels.proxy import trace_proxy
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.trace import trace_gbuffer
from warpir.kernels.types import CameraArgs, LightArgs, LightRecord, VertexRecord
from warpir.render.bad_pixels import BadPixels
from warpir.render.device_scene import Scene
from warpir.scene.camera import Camera
from warpir.scene.light import Light, texel_solid_angles
from warpir.scene.tone_curves import ToneKnots

SAMPLES_PER_SLICE = 1 << 16
"""CPU work of one launch; keeps launches under half a second, so that Ctrl-C is answered."""
FULL_THREADS = 1 << 18
"""Threads that fill a CUDA device; with fewer pixels, several threads share a pixel's samples."""
GLASS_SAMPLES = 8
"""How many times as many samples find the object where clear glass stops few of them."""
PILOT_SCALE = 4
"""Edge of the pixel blocks that decide where the plane's shadow is worth tracing [px]."""
PILOT_SAMPLES = 32
UNSEEN_SHADOW = 1e-3
"""Loss of the plane's light that is not worth tracing [1]: an eighth of an 8-bit code at white."""


@dataclass(frozen=True)
class Rows:
    """An array, or a struct of arrays, whose first axis is the launch's; both are cut alike."""

    array: Any

    def cut(self, start: int, stop: int) -> Any:
        """Return the part of rows ``start`` to ``stop``."""
        if isinstance(self.array, wp.array):
            return self.array[start:stop]
        part = type(self.array)()
        for name in self.array._cls.vars:
            array = getattr(self.array, name)
            # One that is not there has no rows, and Warp cannot slice nothing.
            setattr(part, name, array[start:stop] if array.size else array)
        return part


_kernel_caches: list[KernelCache] = []
"""Of this process, if it has one of its own."""


def start_warp() -> None:
    """Start Warp with a kernel cache that can be written and believed, unless it has started."""
    # The banner, the lines of each loaded module and "no CUDA driver" are for `--debug`.
    if not logging.getLogger().isEnabledFor(logging.DEBUG):
        wp.config.log_level = wp.LOG_ERROR
    if wp.config.kernel_cache_dir is None:  # set by Warp when it starts, or by who calls us
        cache = KernelCache(wp.config.version)
        wp.config.kernel_cache_dir = str(cache.folder)
        _kernel_caches.append(cache)
    with captured_stderr():
        wp.init()


def choose_device(name: str | None) -> str:
    """Return the Warp device to use: the one asked for, else CUDA where there is one, else CPU.

    Raises:
        InputError: The device does not exist.
    """
    start_warp()
    known = [d.alias for d in wp.get_devices()]
    if name is None:
        return "cuda:0" if wp.is_cuda_available() else "cpu"
    alias = "cuda:0" if name == "cuda" else name
    if alias not in known:
        raise InputError(
            "--device",
            f"no device {name} here (found {', '.join(known)})",
            "use --device cpu",
            ExitCode.USAGE,
        )
    return alias


def default_threads() -> int:
    """Return the number of cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def light_args(light: Light, device: wp.Device) -> LightArgs:
    """Upload a light with its proposal: lobes and texels by their share of the luminous flux.

    The map's table is normalised in float64; densities are taken from the float32 table that the
    sampler searches, so both agree exactly.

    Raises:
        ValueError: The light has neither lobes nor a map, or negative values.
        InputError: It has values that are not finite (`ExitCode.NUMERIC`).
    """
    args = LightArgs()
    lobes, texels = light.lobes, light.texels
    if texels is None and (lobes is None or len(lobes.sharpness) == 0):
        raise ValueError("a light needs lobes or a map")
    flux: AnyFloatArray = np.zeros(0)
    if lobes is not None and len(lobes.sharpness):
        values = np.concatenate(
            [lobes.amplitude.reshape(-1), lobes.axis.reshape(-1), lobes.sharpness]
        )
        _require_finite(values, "lobes")
        if lobes.amplitude.min() < 0.0:
            raise ValueError("lobes must have amplitudes >= 0")
        flux = luminance(lobes.flux())
        s = lobes.sharpness.astype(np.float64)
        args.lobe_count = len(s)
        args.amplitude = wp.array(lobes.amplitude, dtype=wp.vec3, device=device)
        args.axis = wp.array(lobes.axis, dtype=wp.vec3, device=device)
        args.sharpness = wp.array(lobes.sharpness, dtype=float, device=device)
        peak = s / (2.0 * np.pi * -np.expm1(-2.0 * s))
        args.lobe_pdf_peak = wp.array(peak.astype(np.float32), dtype=float, device=device)
    else:
        args.lobe_count = 0
        args.amplitude = wp.zeros(1, dtype=wp.vec3, device=device)
        args.axis = wp.zeros(1, dtype=wp.vec3, device=device)
        args.sharpness = wp.zeros(1, dtype=float, device=device)
        args.lobe_pdf_peak = wp.zeros(1, dtype=float, device=device)

    map_flux = 0.0
    if texels is not None:
        _require_finite(texels, "map")
        if texels.min() < 0.0:
            raise ValueError("a light's map must be >= 0")
        height, width = texels.shape[:2]
        weight = luminance(texels.astype(np.float64)) * texel_solid_angles(height, width)[:, None]
        map_flux = float(weight.sum())
        if map_flux <= 0.0:
            weight = np.broadcast_to(texel_solid_angles(height, width)[:, None], (height, width))
        row = weight.sum(axis=1)
        row_cdf = np.concatenate([[0.0], np.cumsum(row) / row.sum()])
        column = np.where(row[:, None] > 0.0, weight, 1.0)
        column_cdf = np.concatenate(
            [np.zeros((height, 1)), np.cumsum(column, axis=1) / column.sum(axis=1, keepdims=True)],
            axis=1,
        )
        row_cdf = np.minimum(row_cdf, 1.0).astype(np.float32)
        column_cdf = np.minimum(column_cdf, 1.0).astype(np.float32)
        row_cdf[-1] = 1.0
        column_cdf[:, -1] = 1.0
        prob = np.diff(row_cdf.astype(np.float64))[:, None] * np.diff(
            column_cdf.astype(np.float64), axis=1
        )
        args.map_height, args.map_width = height, width
        args.texels = wp.array(np.ascontiguousarray(texels), dtype=wp.vec3, device=device)
        args.texel_prob = wp.array(prob.astype(np.float32), dtype=float, device=device)
        args.row_cdf = wp.array(row_cdf, dtype=float, device=device)
        args.column_cdf = wp.array(column_cdf, dtype=float, device=device)
    else:
        args.map_height = args.map_width = 0
        args.texels = wp.zeros((1, 1), dtype=wp.vec3, device=device)
        args.texel_prob = wp.zeros((1, 1), dtype=float, device=device)
        args.row_cdf = wp.zeros(2, dtype=float, device=device)
        args.column_cdf = wp.zeros((1, 2), dtype=float, device=device)

    total = float(flux.sum()) + map_flux
    if total > 0.0:
        lobe_prob, args.map_prob = flux / total, map_flux / total
    elif args.lobe_count:
        lobe_prob, args.map_prob = np.full(args.lobe_count, 1.0 / args.lobe_count), 0.0
    else:
        lobe_prob, args.map_prob = flux, 1.0
    prob32 = lobe_prob.astype(np.float32) if len(lobe_prob) else np.zeros(1, np.float32)
    args.lobe_prob = wp.array(prob32, dtype=float, device=device)
    return args


def _require_finite(values: AnyFloatArray, what: str) -> None:
    bad = int(values.size - np.isfinite(values).sum())
    if bad:
        found = f"{bad} of the {values.size} values of its {what} are not finite"
        raise InputError("light", found, code=ExitCode.NUMERIC)


@dataclass(frozen=True)
class GBuffer:
    """What the camera sees of the object, averaged over each pixel; rows are ``object_pixels``."""

    object_pixels: IntArray
    """Row-major pixel indices, shape [object_pixel]."""
    coverage: FloatArray
    """Share of the pixel that shows the object [1]; a first, coarse estimate of the mask."""
    position: Float64Array
    """World frame [m], shape [object_pixel, 3]."""
    normal: FloatArray
    """Unit shading normal, world frame, shape [object_pixel, 3]."""
    base_color: FloatArray
    """Linear RGB [1], shape [object_pixel, 3]."""
    roughness: FloatArray
    """Perceptual [1], shape [object_pixel]."""
    emission: FloatArray
    """Relative [W/(m^2 sr)], shape [object_pixel, 3]."""


@dataclass(frozen=True)
class Foreground:
    """The object alone under its light; rows are the traced pixels."""

    radiance: FloatArray
    """Premultiplied by ``mask``, relative [W/(m^2 sr)], shape [object_pixel, 3]."""
    diffuse: FloatArray
    """The part that the first hit's diffuse lobe reflects, shape [object_pixel, 3]."""
    emission: FloatArray
    """The part that the first hit emits, shape [object_pixel, 3]."""
    mask: FloatArray
    """Coverage [1], shape [object_pixel]."""


@dataclass(frozen=True)
class ProxyRadiance:
    """A white plane with and without the object; rows are the traced pixels."""

    lit: FloatArray
    """With the object, relative [W/(m^2 sr)], shape [proxy_pixel, 3]."""
    unoccluded: FloatArray
    """Without it, shape [proxy_pixel, 3]."""


def cuda_count() -> int:
    """Return how many CUDA devices this process may use."""
    start_warp()
    return len(wp.get_cuda_devices())


def load_kernels(device: str, variants: Iterable[tuple[bool, bool]]) -> None:
    """Compile what renders a picture, or find it compiled, and keep it for processes yet to start.

    A run does so when it needs it, and keeps it at its end.

    Args:
        device: Warp's name of it.
        variants: Of `foreground_kernel`.
    """
    on = wp.get_device(device)
    settle_hashes(on.is_cpu)
    kernels = [trace_gbuffer, trace_proxy, shadow_ratio, tone_foreground]
    for kernel in (*kernels, *(foreground_kernel(*flags) for flags in variants)):
        # As a launch does: on the CPU there are no blocks.
        kernel.module.load(on, 1 if on.is_cpu else kernel.module.options["block_dim"])
    for kept in _kernel_caches:
        kept.keep()


@cache
def settle_hashes(is_cpu: bool) -> None:
    """Compute the hashes that Warp finds compiled modules by, before any is compiled.

    Modules share functions, and building one changes what Warp 1.19 hashes of the next: without
    this a second run finds the first run's module under another hash and compiles it again (26 s
    on an H200).
    """
    kernels = [trace_gbuffer, trace_proxy, shadow_ratio, tone_foreground]
    kernels += [foreground_kernel(*flags) for flags in product((False, True), repeat=2)]
    for kernel in kernels:
        kernel.module.get_module_hash(1 if is_cpu else None)


class Renderer:
    """Launches the kernels over one scene.

    Args:
        scene: What to render.
        threads: CPU threads; 0 means one per core. Ignored on CUDA.
        progress: Called with the share of a stage that is done, 0 to 1, from worker threads.
        memory: Is told where memory was short.
        lower: What makes pictures smaller, for errors.
        is_ordered: Whether sums are to have one order on CUDA too, where that costs time.

    Attributes:
        bad_pixels: What came out that is not finite.
    """

    def __init__(
        self,
        scene: Scene,
        threads: int = 0,
        progress: Callable[[str, float], None] | None = None,
        memory: Memory | None = None,
        lower: str = "--width",
        is_ordered: bool = False,
    ) -> None:
        self.scene = scene
        self.device = scene.device
        self.memory, self.lower = memory or Memory(str(self.device.alias)), lower
        self.is_ordered = is_ordered or bool(self.device.is_cpu)
        self.bad_pixels = BadPixels()
        settle_hashes(bool(self.device.is_cpu))
        self.threads = threads or default_threads()
        self._progress = progress or (lambda stage, share: None)

    def launch(
        self,
        kernel: wp.Kernel,
        count: int,
        args: Sequence[object],
        work: int,
        stage: str = "",
        width: int | None = None,
    ) -> None:
        """Run ``kernel`` over ``count`` threads; `Rows` among ``args`` are cut with the launch.

        Args:
            kernel: A kernel without backward pass.
            count: Number of Warp threads.
            args: Kernel arguments in order.
            work: Samples that one row of the launch takes, for sizing the slices.
            stage: What to call this in progress reports.
            width: Threads of each row, for kernels of two indices.
        """
        if count == 0:
            return
        wp.load_module(kernel.module, device=self.device)
        size = count
        if self.device.is_cpu:
            rows = min(SAMPLES_PER_SLICE // max(work, 1), -(-count // (4 * self.threads)))
            size = max(16 if width is None else 1, rows)
        starts = range(0, count, size)

        def one(start: int) -> None:
            stop = min(start + size, count)
            cut = [a.cut(start, stop) if isinstance(a, Rows) else a for a in args]
            dim = stop - start if width is None else (stop - start, width)
            wp.launch(kernel, dim=dim, inputs=cut, device=self.device, record_tape=False)

        self.in_threads(one, starts, stage)

    def in_threads(self, one: Callable[[int], object], starts: Sequence[int], stage: str) -> None:
        """Call ``one`` for each of ``starts``, on as many threads as the renderer has.

        Within ``one``, launches go with ``record_tape=False``: a tape belongs to one thread.
        """
        if len(starts) == 1 or self.threads == 1:
            for done, start in enumerate(starts):
                one(start)
                self._progress(stage, (done + 1) / len(starts))
            return
        with ThreadPoolExecutor(self.threads) as pool:
            futures = [pool.submit(one, start) for start in starts]
            try:
                for done, future in enumerate(futures):
                    future.result()
                    self._progress(stage, (done + 1) / len(futures))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def _array(self, values: NDArray[np.generic], dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)

    def candidate_pixels(self, camera: Camera) -> IntArray:
        """Return the pixels that the object's bounding box may cover, row-major, conservative."""
        low, high = self.scene.bounds
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        uv = camera.project(corners)
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
        """Trace what the camera sees of the object.

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
                wp.zeros(
                    max(stop - start, 1),
                    dtype=wp.vec3 if name in vectors else float,
                    device=self.device,
                )
                for name in names
            ]
            self.launch(
                trace_gbuffer,
                stop - start,
                [
                    Rows(self._array(candidates[start:stop], wp.int32)),
                    scene.camera_args,
                    scene.mesh_args,
                    scene.material_args,
                    scene.texture_args,
                    scene.proxy_args,
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
        """Return what ``trace`` makes of all pixels, in halves where memory is short."""
        parts = [*self.memory.in_chunks(trace, count, f"rendering the {stage}", self.lower)]
        return tuple(p[0] if len(p) == 1 else np.concatenate(p) for p in zip(*parts, strict=True))

    def _first_bad_sample(self, is_bad: Callable[[int], bool], spp: int) -> int | None:
        """Return the first of ``spp`` samples with which a sum is bad; None: it is not bad now.

        Samples are a function of their number: rendering fewer leaves out the last ones.
        """
        if not is_bad(spp):
            return None
        good, bad = 0, spp
        while bad - good > 1:
            middle = (good + bad) // 2
            good, bad = (good, middle) if is_bad(middle) else (middle, bad)
        return good

    def lanes(self, count: int, spp: int) -> int:
        """Return how many threads share the camera samples of each of ``count`` pixels."""
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
        """
        scene, lanes = self.scene, self.lanes(len(pixels), spp)
        kernel = foreground_kernel(
            bool(scene.material_args.any_layers), bool(scene.proxy_args.mesh)
        )

        def sums(
            chunk: IntArray,
            spp: int,
            lanes: int,
            light_record: LightRecord | None = None,
            vertex_record: VertexRecord | None = None,
        ) -> tuple[FloatArray, ...]:
            count = len(chunk) * lanes
            out = [wp.zeros(max(count, 1), dtype=wp.vec3, device=self.device) for _ in range(3)]
            mask = wp.zeros(max(count, 1), dtype=float, device=self.device)
            self.launch(
                kernel,
                count,
                [
                    Rows(self._array(np.repeat(chunk, lanes), wp.int32)),
                    scene.camera_args,
                    scene.mesh_args,
                    scene.material_args,
                    scene.texture_args,
                    scene.proxy_args,
                    light,
                    spp // lanes,
                    rays,
                    lanes,
                    depth,
                    indirect_limit,
                    seed,
                    *map(Rows, (*out, mask)),
                    LightRecord() if light_record is None else Rows(light_record),
                    VertexRecord() if vertex_record is None else Rows(vertex_record),
                ],
                spp // lanes * rays,
                "object",
            )
            parts = (a.numpy()[:count] for a in (*out, mask))
            return tuple(p.reshape(-1, lanes, *p.shape[1:]).sum(axis=1) for p in parts)

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            # As many lanes as all pixels have together: sums keep their order.
            records = (
                r if r is None else Rows(r).cut(start * lanes, stop * lanes)
                for r in (light_record, vertex_record)
            )
            return sums(pixels[start:stop], spp, lanes, *records)

        def first_bad_sample(pixel: int) -> int | None:
            alone = np.array([pixel], np.int32)
            return self._first_bad_sample(
                lambda spp: not all(np.isfinite(p).all() for p in sums(alone, spp, 1)), spp
            )

        *planes, mask = self._in_chunks(trace, len(pixels), "object")
        width = scene.camera.width
        traced = self.bad_pixels.blackened(tuple(planes), pixels, width, "object", first_bad_sample)
        radiance, diffuse, emission = traced
        return Foreground(radiance, diffuse, emission, mask)

    def proxy(
        self,
        light: LightArgs,
        pixels: IntArray,
        may_see_object: IntArray,
        spp: int,
        rays: int,
        seed: int,
        camera_args: CameraArgs | None = None,
        record: LightRecord | None = None,
    ) -> ProxyRadiance:
        """Radiance of the white place with and without the object (both halves of DiPIR, eq. 5).

        Args:
            light: From `light_args`.
            pixels: Row-major pixel indices, shape [proxy_pixel].
            may_see_object: 1 where the object may hide the place, shape [proxy_pixel].
            spp: Camera samples per pixel.
            rays: Directions per technique and camera sample.
            seed: Base seed.
            camera_args: Another resolution of the view, or the scene's own.
            record: Filled on the way where given; rows are ``pixels``.
        """
        scene = self.scene

        def sums(
            chunk: IntArray, may_see: IntArray, spp: int, record: LightRecord | None = None
        ) -> tuple[FloatArray, ...]:
            count = len(chunk)
            out = [wp.zeros(max(count, 1), dtype=wp.vec3, device=self.device) for _ in range(2)]
            self.launch(
                trace_proxy,
                count,
                [
                    Rows(self._array(chunk, wp.int32)),
                    Rows(self._array(may_see, wp.int32)),
                    camera_args if camera_args is not None else scene.camera_args,
                    scene.mesh_args,
                    scene.material_args,
                    scene.texture_args,
                    scene.proxy_args,
                    light,
                    spp,
                    rays,
                    seed,
                    *map(Rows, out),
                    LightRecord() if record is None else Rows(record),
                ],
                spp * rays,
                "shadow",
            )
            return tuple(a.numpy()[:count] for a in out)

        def trace(start: int, stop: int) -> tuple[FloatArray, ...]:
            cut = None if record is None else Rows(record).cut(start, stop)
            return sums(pixels[start:stop], may_see_object[start:stop], spp, cut)

        def first_bad_sample(pixel: int) -> int | None:
            alone = np.array([pixel], np.int32)
            hidden = may_see_object[pixels == pixel]
            return self._first_bad_sample(
                lambda spp: not all(np.isfinite(p).all() for p in sums(alone, hidden, spp)), spp
            )

        stage, width = "shadow", scene.camera.width
        if camera_args is not None:
            stage, width = "shadow in another resolution", int(camera_args.width)
        traced = self._in_chunks(trace, len(pixels), stage)
        # Black with and without the object: there the photo stays as it is.
        traced = self.bad_pixels.blackened(traced, pixels, width, stage, first_bad_sample)
        return ProxyRadiance(*traced)

    def shaded_pixels(self, light: LightArgs, seed: int) -> IntArray:
        """Return the pixels where the object may change the plane's light, row-major.

        A pilot pass traces the same shadow rays over blocks of `PILOT_SCALE` pixels, each sample at
        a position of its own in the block. A block whose 3 x 3 neighbourhood loses less than
        `UNSEEN_SHADOW` of its light is left alone and stays the photo, bit for bit.
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
            return np.zeros(0, np.int32)
        pixels = np.arange(width * height, dtype=np.int32)
        pilot = self.proxy(
            light,
            pixels,
            np.zeros(len(pixels), np.int32),
            PILOT_SAMPLES,
            1,
            seed,
            self.scene.camera_args_at(coarse),
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            lost = np.where(pilot.unoccluded > 0.0, 1.0 - pilot.lit / pilot.unoccluded, 0.0)
        lost = lost.max(axis=1).reshape(height, width)
        blocks = _dilate(_mean_of_neighbours(lost) > UNSEEN_SHADOW)
        full = np.repeat(np.repeat(blocks, PILOT_SCALE, axis=0), PILOT_SCALE, axis=1)
        return np.flatnonzero(full[: camera.height, : camera.width]).astype(np.int32)

    def ratio(self, radiance: ProxyRadiance) -> FloatArray:
        """Return the shadow ratio per channel, shape [proxy_pixel, 3]."""
        count = len(radiance.lit)
        out = wp.zeros(max(count, 1), dtype=wp.vec3, device=self.device)
        self.launch(
            shadow_ratio,
            count,
            [
                Rows(self._array(radiance.lit, wp.vec3)),
                Rows(self._array(radiance.unoccluded, wp.vec3)),
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
        objects, proxies = len(foreground.mask), len(ratio)
        fg = wp.zeros(max(objects, 1), dtype=wp.vec3, device=self.device)
        shadow = wp.zeros(max(proxies, 1), dtype=wp.vec3, device=self.device)
        self.launch(
            tone_foreground,
            objects,
            [
                Rows(self._array(foreground.radiance, wp.vec3)),
                Rows(self._array(foreground.mask, wp.float32)),
                int(is_reinhard),
                *(self._array(k, wp.float32) for k in curve_fg.arrays()),
                curve_fg.bin_count,
                Rows(fg),
            ],
            1,
        )
        self.launch(
            tone_shadow,
            proxies,
            [
                Rows(self._array(ratio, wp.vec3)),
                *(self._array(k, wp.float32) for k in curve_shadow.arrays()),
                curve_shadow.bin_count,
                Rows(shadow),
            ],
            1,
        )
        return fg.numpy()[:objects], shadow.numpy()[:proxies]


def index_of(pixels: IntArray, count: int) -> IntArray:
    """Return the row of each pixel in ``pixels``, or -1, shape [count]."""
    index = np.full(count, -1, np.int32)
    index[pixels] = np.arange(len(pixels), dtype=np.int32)
    return index


def _mean_of_neighbours(values: FloatArray) -> FloatArray:
    """Average each value with its eight neighbours."""
    padded = np.pad(values, 1, mode="edge")
    rows, columns = values.shape
    total = sum(padded[dy : dy + rows, dx : dx + columns] for dy in range(3) for dx in range(3))
    return np.asarray(total / 9.0, np.float32)


def _dilate(mask: BoolArray) -> BoolArray:
    """Grow a mask by one pixel in all eight directions."""
    padded = np.pad(mask, 1)
    grown = np.zeros_like(mask)
    for dy in range(3):
        for dx in range(3):
            grown |= padded[dy : dy + mask.shape[0], dx : dx + mask.shape[1]]
    return grown
