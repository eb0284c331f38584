"""Memory of host and device: who owns it, whether a run fits, and what is done when it does not.

On a GPU two allocators share one memory. torch's cache is the owner: it keeps what it once had,
since the model's passes ask for the same again and again. Warp's pool is the guest: it gives back
at each synchronisation what is not in use (`share_device`), as its large buffers belong to stages
that come once. At the border of such a stage, and before a second attempt, torch's cache is emptied
too (`release`), so that what lies idle in one never starves the other.

What runs out of memory is tried once more, in halves where it can be cut (`Memory.in_chunks`).
Pixels, rows and noises depend on their seeds alone, so the halves make the same picture. After that
the run ends with exit code 5 and the name of what to lower. Neither torch nor Warp is imported
here: what was not loaded holds nothing.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import os
import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from warpir.core.errors import ExitCode, InputError

T = TypeVar("T")

SHORTAGES = (
    *("allocate mem", "Failed to allocate", "out of memory", "ALLOC_FAILED", "bad_alloc"),
    *("failed to map segment", "start new thread"),
)
"""How torch, Warp, CUDA, the loader and threads say that memory is short."""
PHOTO_BYTES = 190
"""Of a photo's pixel: its layers, and what writing them takes; measured from 3 to 12 megapixels."""
VERTEX_BYTES, TRIANGLE_BYTES = 72, 80
"""On the renderer's device; a triangle has its indices, and its share of the tree."""
VAE_BYTES = 2560
"""Of a picture's pixel that a VAE encodes in half precision, for its backward pass; measured on
Stable Diffusion 2.1: 1.5 GB a picture. Recomputing leaves a tenth."""
CERTAIN = 2.0
"""Needs in free memories beyond which a run is refused; up to it an estimate may be wrong."""
SHORT = "memory.short"
"""Reason of an `InputError` that another run's end, or a smaller task, would remove."""
MIB = 1 << 20
M_MMAP_THRESHOLD = -3
"""Of glibc's ``mallopt``."""
HEAP_MOST = 32 * MIB
"""Largest block in its heap, up to which glibc goes by itself [byte]."""
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024
"""What the system counts resident memory in [byte]."""


def is_shortage(error: BaseException) -> bool:
    """Return whether an exception says that memory is short."""
    if isinstance(error, InputError):
        return False
    if isinstance(error, OSError) and error.errno == errno.ENOMEM:
        return True
    # torch.OutOfMemoryError is a RuntimeError; the loader's errors have no number.
    told = isinstance(error, RuntimeError | ImportError | OSError)
    if isinstance(error, MemoryError) or (told and any(w in str(error) for w in SHORTAGES)):
        return True
    # A CUDA graph that cannot be recorded to its end says so after the reason.
    before = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return before is not None and is_shortage(before)


def lacked_memory(error: BaseException) -> bool:
    """Return whether memory is what a run ended for: it may do in a memory that others have left.

    `Memory.require` and `Memory.in_chunks` raise such errors; so do the libraries themselves.
    """
    if isinstance(error, InputError):
        return error.reason == SHORT
    return is_shortage(error)


@dataclass(frozen=True)
class Need:
    """Memory that a part of the run is going to hold, at least."""

    what: str
    bytes: int
    flags: str
    """What lowers it."""


class Memory:
    """What a run needs, and did where memory was short.

    Args:
        device: Warp device on which the run renders and asks its model.
        say: Prints a line.

    Attributes:
        retries: How often something was tried again, by its name; for ``run.json``.
        doubts: What may not fit, one line each.
    """

    def __init__(self, device: str = "cpu", say: Callable[[str], None] = lambda _: None) -> None:
        self.device, self.say = device, say
        self.doubts: list[str] = []
        self.retries: dict[str, int] = {}

    def require(self, *needs: Need, on_host: bool = False) -> None:
        """Compare needs that are held at the same time with what is free.

        An estimate may be wrong: what is up to `CERTAIN` times too large is only a doubt.

        Args:
            needs: What is needed; the largest names what to lower.
            on_host: Of the host's memory, whatever the device is.

        Raises:
            InputError: It is certain not to fit (`ExitCode.RESOURCES`).
        """
        free, where = None if on_host else free_device(self.device), self.device
        if free is None:
            free, where = free_host(), "the host"
        total = sum(need.bytes for need in needs)
        if total <= free:
            return
        largest = max(needs, key=lambda need: need.bytes)
        parts = ", ".join(f"{n.what} {n.bytes // MIB}" for n in needs if n.bytes >= MIB)
        found = f"about {total // MIB} MiB are needed ({parts}), {free // MIB} MiB of {where} free"
        if total > CERTAIN * free:
            advice = f"ask for less by {largest.flags}"
            raise InputError(
                largest.flags,
                f"memory: {found}",
                advice,
                ExitCode.RESOURCES,
                reason=SHORT,
                needed=total,
                free=free,
            )
        self.doubts.append(f"memory may be short: {found}; {largest.flags} would lower it")
        self.say(f"notice: {self.doubts[-1]}")

    def in_chunks(
        self,
        do: Callable[[int, int], T],
        count: int,
        what: str,
        flags: str,
        spare: Callable[[], object] = lambda: None,
    ) -> Iterator[T]:
        """Yield what is made of ``count`` things: of all at once, or of halves if that fails.

        Args:
            do: Makes it of the things from a first to before a last; called again after a failure,
                so it may only change what it returns.
            count: How many there are; one alone is tried again as it is, in a freed memory.
            what: What is made, for a person.
            flags: By what less of it is asked for, such as ``--width``.
            spare: Called before the second attempt.

        Raises:
            InputError: Halves do not fit either (`ExitCode.RESOURCES`).
        """
        try:
            whole = do(0, count)
        except Exception as error:  # each library has a type of its own for this
            if not is_shortage(error) or _is_recording():
                raise
        else:
            yield whole
            return
        # Behind the handler: the exception held all that was made before it.
        if what not in self.retries:
            self.say(f"notice: memory is short for {what}: tried again in smaller parts")
        self.retries[what] = self.retries.get(what, 0) + 1
        release()
        spare()
        middle = (count + 1) // 2
        halves = [(0, middle), (middle, count)] if count > 1 else [(0, count)]
        for start, stop in halves:
            try:
                part = do(start, stop)
            except Exception as error:  # as above
                if not is_shortage(error):
                    raise
                raise self._too_large(what, flags, len(halves)) from None
            yield part

    def again(
        self,
        do: Callable[[], T],
        what: str,
        flags: str,
        spare: Callable[[], object] = lambda: None,
    ) -> T:
        """Return what ``do`` makes, at the second attempt if the first lacks memory.

        Arguments are those of `in_chunks`.

        Raises:
            InputError: So does the second (`ExitCode.RESOURCES`).
        """
        return next(self.in_chunks(lambda start, stop: do(), 1, what, flags, spare))

    def _too_large(self, what: str, flags: str, parts: int) -> InputError:
        free = f"{free_host() // MIB} MiB of the host are free"
        on_device = free_device(self.device)
        advice = f"ask for less by {flags}"
        if on_device is not None:
            free += f", {on_device // MIB} MiB of {self.device}"
            advice += ", or use --device cpu"
        tried = "in one piece and in halves" if parts > 1 else "twice"
        found = f"not enough memory for {what} (tried {tried}; {free})"
        return InputError(flags, found, advice, ExitCode.RESOURCES, reason=SHORT)

    def notices(self) -> Iterator[str]:
        """Yield what the user should know of it."""
        yield from self.doubts
        for what, count in self.retries.items():
            times = "" if count == 1 else f" ({count} times)"
            yield f"memory was short for {what}: made in smaller parts, with the same result{times}"


@contextmanager
def no_collection() -> Iterator[None]:
    """Within this context cycles of Python are not looked for: where modules are loaded, all stays.

    Of torch and Warp alone there is so much that looking takes half a second.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def trim() -> None:
    """Give back what the C library keeps of freed memory: after the networks 100 MiB."""
    with suppress(OSError, AttributeError):  # another one than glibc
        ctypes.CDLL(None).malloc_trim(0)


@contextmanager
def sparing() -> Iterator[None]:
    """Let large arrays lie beside the C library's heap within the block.

    They go back when they are freed, and pages of zeros that nothing is written to take no room.
    Networks, which ask for the same again and again, would take half as long again.
    """
    _set_largest_in_heap(MIB)
    trim()
    try:
        yield
    finally:
        _set_largest_in_heap(HEAP_MOST)


def _set_largest_in_heap(size: int) -> None:
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).mallopt(M_MMAP_THRESHOLD, size)


def release() -> None:
    """Give back what nobody uses: cycles of Python, torch's cache, Warp's pools."""
    gc.collect()
    torch, warp = sys.modules.get("torch"), sys.modules.get("warp")
    if warp is not None and warp.is_cuda_available():
        # Only cards that were used: to ask another one would make a context there, or fail.
        for device in warp.get_cuda_devices():
            if device.has_context:
                warp.synchronize_device(device)
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.empty_cache()


def peak_mib() -> dict[str, float]:
    """Return the most memory that this process has held so far, by who held it [MiB]."""
    held = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _RSS_UNIT / MIB}
    torch, warp = sys.modules.get("torch"), sys.modules.get("warp")
    if torch is not None and torch.cuda.is_available() and torch.cuda.is_initialized():
        most = max(torch.cuda.max_memory_reserved(k) for k in range(torch.cuda.device_count()))
        held["torch on the GPU"] = most / MIB
    if warp is not None and warp.is_cuda_available():
        pools = [d for d in warp.get_cuda_devices() if d.is_mempool_supported]
        if pools:
            most = max(warp.get_mempool_used_mem_high(device) for device in pools)
            held["Warp on the GPU"] = most / MIB
    return {name: round(mib, 1) for name, mib in held.items()}


def _is_recording() -> bool:
    """Return whether a CUDA graph is being recorded, in which nothing can be freed or redone."""
    torch = sys.modules.get("torch")
    if torch is None or not torch.cuda.is_available() or not torch.cuda.is_initialized():
        return False
    return bool(torch.cuda.is_current_stream_capturing())


def share_device(alias: str) -> None:
    """Let Warp's pool of a device keep nothing that is not in use; torch's cache may."""
    warp = sys.modules["warp"]
    device = warp.get_device(alias)
    if device.is_cuda and device.is_mempool_supported:
        warp.set_mempool_release_threshold(device, 0)


# ------------------------------------------------------------------- before the work


def needs_of_scene(vertex_count: int, triangle_count: int, texel_count: int) -> tuple[Need, ...]:
    """Return what an object takes of the device that renders it."""
    geometry = VERTEX_BYTES * vertex_count + TRIANGLE_BYTES * triangle_count
    return (
        Need("triangles and their tree", geometry, "--asset (fewer triangles)"),
        Need("textures", 4 * texel_count, "--asset (smaller textures)"),
    )


def needs_of_model(file_bytes: int, side: int, pictures: int, *, is_half: bool) -> tuple[Need, ...]:
    """Return what Stable Diffusion takes of the device that guides.

    It encodes so many pictures of ``side`` pixels at once, with a backward pass. Half precision is
    that of the computation; the files of its weights may hold more.
    """
    encoder = VAE_BYTES * side * side * pictures * (1 if is_half else 2)
    return (
        Need("the model", file_bytes // 2 if is_half else file_bytes, "--model"),
        Need("its encoder's backward pass", encoder // 10, "--noises"),
    )


def free_host(proc: Path = Path("/proc"), groups: Path = Path("/sys/fs/cgroup")) -> int:
    """Return what this process may still take of the host's memory [byte].

    The least of the system's estimate, of its control groups' limits and of ``RLIMIT_AS``; very
    much where the system tells none of them.
    """
    return min(_available(proc), _left_in_group(proc, groups), _left_to_map(proc))


def core_count() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_device(alias: str) -> int | None:
    """Return what is free on a Warp device [byte], or None where it is the host."""
    device = sys.modules["warp"].get_device(alias) if alias != "cpu" else None
    if device is None or not device.is_cuda:
        return None
    # The context is made first, and kept: asked without one, the driver makes one and drops it.
    return int(device.free_memory) if device.context is not None else None


def _available(proc: Path) -> int:
    return next((kib << 10 for kib in _numbers(proc / "meminfo", "MemAvailable:")), sys.maxsize)


def _left_to_map(proc: Path) -> int:
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit == resource.RLIM_INFINITY:
        return sys.maxsize
    used = next((kib << 10 for kib in _numbers(proc / "self/status", "VmSize:")), 0)
    return max(limit - used, 0)


def _left_in_group(proc: Path, groups: Path) -> int:
    """Return what the control groups of this process leave: version 2, or the memory one of 1."""
    left = sys.maxsize
    for line in _lines(proc / "self/cgroup"):
        _, controllers, name = line.split(":", 2)
        if controllers not in ("", "memory"):
            continue
        root = groups / controllers
        names = ("memory.max", "memory.current")
        if controllers:
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes")
        # A group is bound by those above it too; in a container the name may lead nowhere.
        folder = root / name.strip("/")
        for place in (folder, *folder.parents):
            limit, used = (_lines(place / file) for file in names)
            if limit and limit[0].isdigit():
                cached = next(iter(_numbers(place / "memory.stat", "inactive_file")), 0)
                left = min(left, int(limit[0]) - int(used[0] if used else 0) + cached)
            if place == root:
                break
    return max(left, 0)


def _lines(path: Path) -> Sequence[str]:
    try:
        return path.read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:  # another system, or a group that is not mounted here
        return ()


def _numbers(path: Path, name: str) -> Iterator[int]:
    for line in _lines(path):
        words = line.split()
        if len(words) > 1 and words[0] == name:
            yield int(words[1])
