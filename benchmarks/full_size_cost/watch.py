"""What the program reports of itself while it runs: memory by stage, and its prior and its loop."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any
from unittest import mock

import torch
import warp as wp

from benchmarks.measure import peak_mib
from warpir.app.record import Timings
from warpir.core.progress import StepProgress
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.optimize.light import LightOptimization


class Memory:
    """Peak memory by stage [GB]: torch's reserved memory and Warp's on CUDA, else resident."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.by_stage: dict[str, float] = {}

    def mark(self, stage: str) -> None:
        """Count what was used since the last mark as a stage's."""
        if self.device.is_cuda:
            # Warp's mark cannot be set back; its share is small.
            used = torch.cuda.max_memory_reserved() + wp.get_mempool_used_mem_high(self.device)
            torch.cuda.reset_peak_memory_stats()
            peak = used / 1e9
        else:
            peak = peak_mib(self.device) * 2**20 / 1e9
        self.by_stage[stage] = max(self.by_stage.get(stage, 0.0), peak)


@dataclass
class Watch:
    """Looks over the program's shoulder: memory by stage, and the objects that it makes."""

    memory: Memory
    made: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Within this context the program's own hooks report here."""
        memory, made = self.memory, self.made

        class WatchedTimings(Timings):
            @contextmanager
            def stage(self, name: str) -> Iterator[None]:
                memory.mark("between stages")
                with super().stage(name):
                    yield
                memory.mark(name)

        class WatchedProgress(StepProgress):
            def report(self, stage: str, done: int, total: int, words: str = "") -> None:
                memory.mark(stage)
                super().report(stage, done, total, words)

        def kept(name: str, make: Callable[..., Any]) -> Callable[..., Any]:
            def keep(*args: Any, **kwargs: Any) -> Any:
                made[name] = make(*args, **kwargs)
                return made[name]

            return keep

        load, loop = kept("prior", load_stable_diffusion), kept("loop", LightOptimization)
        with (
            mock.patch("warpir.app.record.Timings", WatchedTimings),
            mock.patch("warpir.core.progress.StepProgress", WatchedProgress),
            mock.patch("warpir.optimize.model.load_stable_diffusion", load),
            mock.patch("warpir.optimize.recover.LightOptimization", loop),
        ):
            yield
