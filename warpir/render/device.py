"""Warp on one device: its start, its kernel cache, and launches cut into slices of rows.

On the CPU a Warp launch runs on one core, so every launch is cut into row slices that a thread pool
works through; on CUDA it is one launch. A row's numbers depend on its own arguments alone, so
slices and threads do not change a result.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from warpir.core.cache import KernelCache, notice
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import core_count
from warpir.io.images.decoder import captured_stderr
from warpir.kernels.composite import tone_foreground
from warpir.kernels.lamps.receiver import trace_lamps
from warpir.kernels.path import Viewer, foreground_kernel
from warpir.kernels.receiver import plane_shadow_kernel, trace_receiver
from warpir.kernels.sampling import draw_light
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.tracing.gbuffer import trace_gbuffer
from warpir.kernels.types import LAYERS

PLAIN_KERNELS = trace_gbuffer, trace_receiver, shadow_ratio, tone_foreground
"""Kernels without variants."""
SAMPLES_PER_SLICE = 1 << 16
"""CPU work of one launch; keeps launches under half a second, so that Ctrl-C is answered."""

_kernel_caches: list[KernelCache] = []
"""Kernel cache of this process, if it has its own."""
_started_by: list[int] = []
"""Process that has started Warp; one that is forked from it inherits this, but no thread."""


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


def copied(struct: Any) -> Any:
    """Return a struct of the same arrays and numbers."""
    copy = type(struct)()
    for name in struct._cls.vars:
        setattr(copy, name, getattr(struct, name))
    return copy


def start_warp() -> None:
    """Start Warp once, with a kernel cache that is writable and valid.

    Raises:
        InputError: The process was forked from one that had; OpenEXR and CUDA would wait for ever.
    """
    if _started_by not in ([], [os.getpid()]):
        what = "was forked from one in which warpir had rendered, without its threads"
        advice = 'start it by multiprocessing.get_context("spawn")'
        raise InputError("process", what, advice, ExitCode.USAGE)
    _started_by[:] = [os.getpid()]
    # The banner, the lines of each loaded module and "no CUDA driver" are for `--debug`.
    if not logging.getLogger().isEnabledFor(logging.DEBUG):
        wp.config.log_level = wp.LOG_ERROR
    if wp.config.kernel_cache_dir is None:  # set by Warp when it starts, or by the caller
        cache = KernelCache(wp.config.version)
        wp.config.kernel_cache_dir = str(cache.folder)
        _kernel_caches.append(cache)
    with captured_stderr():
        wp.init()


def choose_device(name: str | None) -> str:
    """Return the Warp device to use: the one asked for, else CUDA where there is one, else CPU.

    Raises:
        InputError: The device does not exist, or is older than those that Warp compiles for; or as
            of `start_warp`.
    """
    start_warp()
    known = [d.alias for d in wp.get_devices()]
    chosen = ("cuda" if wp.is_cuda_available() else "cpu") if name is None else name
    alias = "cuda:0" if chosen == "cuda" else chosen
    old = _old_driver()
    if alias not in known:
        raise InputError(
            "--device",
            f"no device {chosen} here (found {', '.join(known)}{old and f'; {old}'})",
            "use --device cpu",
            ExitCode.USAGE,
        )
    if name is None and old:
        notice(f"no GPU is used: {old}")
    device, oldest = wp.get_device(alias), min(wp.get_cuda_supported_archs(), default=0)
    if device.is_cuda and device.arch < oldest:
        raise InputError(
            "--device",
            f"Warp does not compile for {alias}, {device.name}, any more "
            f"(found sm_{device.arch}; expected sm_{oldest} or newer)",
            "use --device cpu",
            ExitCode.USAGE,
        )
    _ = device.context  # a card's is made when it is first asked for
    return alias


def _old_driver() -> str:
    """Say that there is a driver which is too old for Warp; nothing where that is not so."""
    found, built = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    if not found or not built or found[0] >= built[0]:
        return ""
    return f"the driver is for CUDA {found[0]}.{found[1]}, Warp needs {built[0]}.0 or newer"


def cuda_count() -> int:
    """Return how many CUDA devices this process may use."""
    start_warp()
    return len(wp.get_cuda_devices())


def cache_kernels(device: str, variants: Iterable[tuple[int, ...]]) -> None:
    """Compile the rendering kernels, or load them, and cache them for later processes.

    Args:
        device: Warp's name of it.
        variants: Variants of `foreground_kernel`.
    """
    load_kernels(wp.get_device(device), variants)
    keep_kernels()


def keep_kernels() -> None:
    """Cache the kernels that were compiled; a process that is not killed does so at its end."""
    for kept in _kernel_caches:
        kept.keep()


def load_kernels(
    device: wp.Device,
    variants: Iterable[tuple[int, ...]],
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> None:
    """Compile the rendering kernels, each module on a core of its own, or load them.

    On CUDA they are compiled one after the other still: NVRTC holds a lock.

    Args:
        device: Warp's device.
        variants: Variants of `foreground_kernel`.
        progress: Called with the share of the modules that are there, while some are compiled.
    """
    wanted = list(variants)
    has_lamps = any(flags[3] for flags in wanted)
    # The longest to compile come first
    kernels = [*(foreground_kernel(*flags) for flags in wanted), trace_receiver, trace_gbuffer]
    kernels += [trace_lamps] if has_lamps else []
    kernels += [plane_shadow_kernel(has) for has in sorted({flags[5] for flags in wanted})]
    kernels += [draw_light, tone_foreground, shadow_ratio]
    modules = list(dict.fromkeys(kernel.module for kernel in kernels))
    if not all(is_cached(module, device) for module in modules):
        settle_hashes(
            bool(device.is_cpu),
            has_lamps,
            any(flags[4] for flags in wanted),
            max((flags[0] for flags in wanted), default=0),
        )
    with ThreadPoolExecutor(core_count()) as pool:
        loads = [pool.submit(m.load, device, _block_dim(m, device)) for m in modules]
        for done, load in enumerate(as_completed(loads)):
            load.result()
            progress("compiling kernels", (done + 1) / len(modules))


def _block_dim(module: wp.Module, device: wp.Device) -> int:
    """Return the threads of a block in a launch; on the CPU there are no blocks."""
    return 1 if device.is_cpu else int(module.options["block_dim"])


def is_cached(module: wp.Module, device: wp.Device) -> bool:
    """Whether a module was compiled before, by this process or another."""
    name = module.get_module_identifier(_block_dim(module, device))
    return Path(wp.config.kernel_cache_dir, name).is_dir()


@cache
def settle_hashes(
    is_cpu: bool, has_lamps: bool = False, has_solid_glass: bool = False, layers: int = LAYERS
) -> None:
    """Compute the hashes by which Warp caches modules, before any is compiled.

    Modules share functions, and building one changes what Warp 1.19 hashes of the next: without
    this a second run finds the first run's module under another hash and compiles it again (26 s
    on an H200). Where all that a run loads is cached, nothing is built, and this saves its time.

    Args:
        is_cpu: Whether they are for the CPU.
        has_lamps: Whether those for lamps near the object are needed too (0.3 s).
        has_solid_glass: Whether those for solid glass are.
        layers: What extensions materials have (``MaterialArgs.any_layers``); those of most have
            kernels of their own only where they are needed.
    """
    kernels = [*PLAIN_KERNELS, *map(plane_shadow_kernel, (False, True))]
    viewers = (Viewer.CAMERA, Viewer.GROUND)
    # No ground with a mesh mirrors.
    mirror = (False, Viewer.MIRROR)
    variants: list[tuple[int, ...]] = []
    for lamps in (False, True)[: 1 + has_lamps]:
        scenes = [*product((False, True), viewers), mirror]
        variants += [
            (has, *scene, lamps, False, passing)
            for has, scene, passing in product((0, LAYERS), scenes, (False, True))
        ]
    if has_solid_glass:
        seen = ((False, Viewer.CAMERA), (True, Viewer.CAMERA), mirror)
        near = (False, True)[: 1 + has_lamps]
        variants += [(LAYERS, *scene, lamps, True, True) for scene, lamps in product(seen, near)]
    if layers > LAYERS:
        variants += dict.fromkeys((layers, *others) for _, *others in variants)
    kernels += [foreground_kernel(*variant) for variant in variants]
    if has_lamps:
        kernels.append(trace_lamps)
    for kernel in kernels:
        kernel.module.get_module_hash(1 if is_cpu else None)


class Launcher:
    """Launches kernels over rows on one device.

    Args:
        device: Warp device.
        threads: CPU threads; 0 means one per core. Ignored on CUDA.
        progress: Called with the share of a stage that is done, 0 to 1, from worker threads.
        needs: What else there is to compile: the last arguments of `settle_hashes`.

    Attributes:
        span: What shares of a stage are done before and after a launch.
    """

    def __init__(
        self,
        device: wp.Device,
        threads: int = 0,
        progress: Callable[[str, float], None] | None = None,
        needs: tuple[bool, bool, int] = (False, False, LAYERS),
    ) -> None:
        self.device = device
        self.threads = threads or core_count()
        self._progress = progress or (lambda stage, share: None)
        self.span = 0.0, 1.0
        self._needs = needs
        self._ready: set[wp.Module] = set()
        for kernel in PLAIN_KERNELS:
            self._settle_before(kernel.module)

    def _settle_before(self, module: wp.Module) -> None:
        """Compute all hashes before a module is compiled, if it must be."""
        if module not in self._ready and not is_cached(module, self.device):
            settle_hashes(bool(self.device.is_cpu), *self._needs)
        self._ready.add(module)

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
            stage: Name of the launch in progress reports.
            width: Threads of each row, for kernels of two indices.
        """
        if count == 0:
            return
        # Else a launch takes 256, and compiles a module anew that has another.
        block_dim = _block_dim(kernel.module, self.device)
        self._settle_before(kernel.module)
        wp.load_module(kernel.module, device=self.device)
        size = count
        if self.device.is_cpu:
            rows = min(SAMPLES_PER_SLICE // max(work, 1), -(-count // (4 * self.threads)))
            size = max(16 if width is None else 1, rows)
        starts = range(0, count, size)

        def one(start: int) -> None:
            stop = min(start + size, count)
            # What is launched whole may have more rows: those of a record are its threads'.
            whole = stop - start == count
            cut = [
                a if not isinstance(a, Rows) else a.array if whole else a.cut(start, stop)
                for a in args
            ]
            dim = stop - start if width is None else (stop - start, width)
            wp.launch(kernel, dim, cut, device=self.device, record_tape=False, block_dim=block_dim)

        self.in_threads(one, starts, stage)

    def in_threads(self, one: Callable[[int], object], starts: Sequence[int], stage: str) -> None:
        """Call ``one`` for each of ``starts``, on as many threads as the launcher has.

        Within ``one``, launches go with ``record_tape=False``: a tape belongs to one thread.
        """
        before, after = self.span

        def report(done: int) -> None:
            self._progress(stage, before + (after - before) * done / len(starts))

        if len(starts) == 1 or self.threads == 1:
            for done, start in enumerate(starts, 1):
                one(start)
                report(done)
            return
        with ThreadPoolExecutor(self.threads) as pool:
            futures = [pool.submit(one, start) for start in starts]
            try:
                for done, future in enumerate(futures, 1):
                    future.result()
                    report(done)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def upload(self, values: NDArray[np.generic], dtype: type) -> wp.array:
        """Copy values to the device."""
        return wp.array(values, dtype=dtype, device=self.device)

    def zeros(self, count: int, dtype: type) -> wp.array:
        """Return a zeroed output of ``count`` rows; one row where there are none."""
        return wp.zeros(max(count, 1), dtype=dtype, device=self.device)
