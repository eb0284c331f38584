"""Peak memory of one stretch of a process, over what was there before."""

import ctypes
import gc
import re
from pathlib import Path

import torch
import warp as wp


class PeakMemory:
    """Growth of resident memory on the CPU, of all allocators' pools on CUDA.

    On Linux the kernel's high-water mark is set back before the stretch. On CUDA the allocators of
    Dr.Jit, Warp and torch each keep their own mark. Caches are emptied first, so that a stretch
    cannot live on what an earlier one left behind.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.before = 0.0
        self.warp_mark = self.warp_before = 0

    def start(self) -> None:
        """Empty caches and set the marks back."""
        import drjit as dr

        gc.collect()
        dr.sync_thread()
        dr.flush_malloc_cache()
        if self.device.is_cuda:
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
            dr.detail.malloc_clear_statistics()
            self.warp_mark = wp.get_mempool_used_mem_high(self.device)
            self.warp_before = wp.get_mempool_used_mem_current(self.device)
            self.before = self._cuda_bytes()
        else:
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")
            self.before = _status("VmRSS")

    def stop(self) -> float:
        """Return the growth since `start` [MiB]."""
        peak = self._cuda_bytes() if self.device.is_cuda else _status("VmHWM")
        return max(peak - self.before, 0.0) / 2**20

    def _cuda_bytes(self) -> float:
        import drjit as dr

        # Warp's mark cannot be set back: below the old one only what is held now is known
        warp = wp.get_mempool_used_mem_high(self.device)
        if warp <= self.warp_mark:
            warp = max(wp.get_mempool_used_mem_current(self.device), self.warp_before)
        mitsuba = dr.detail.malloc_watermark(dr.JitBackend.CUDA)
        return float(mitsuba + torch.cuda.max_memory_allocated() + warp)


def _status(name: str) -> float:
    """Return one line of the process's status [byte]."""
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    return 1024.0 * int(found[1]) if found else 0.0
