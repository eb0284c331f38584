"""The processes that train one network together, each with scenes of its own (``torchrun``)."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor


@dataclass(frozen=True)
class Worker:
    """Which of the processes of a training this is (``torchrun`` sets the variables)."""

    rank: int
    local_rank: int
    count: int

    @classmethod
    def this(cls) -> Worker:
        """Return this process' place; alone it is the first of one."""
        rank, local, count = (
            int(os.environ.get(name, default))
            for name, default in (("RANK", "0"), ("LOCAL_RANK", "0"), ("WORLD_SIZE", "1"))
        )
        return cls(rank, local, count)

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that validates and writes."""
        return self.rank == 0

    @contextmanager
    def joined(self, device: torch.device) -> Iterator[None]:
        """Join the other processes within this context, where there are any."""
        if self.count == 1:
            yield
            return
        # The optimiser's first step imports this module, whose default arguments are the group of
        # that moment. They would keep the group and its threads beyond `destroy_process_group`, and
        # a thread that frees a tensor while Python ends aborts the process or waits for ever.
        importlib.import_module("torch.distributed.nn.functional")
        if device.type == "cuda":
            torch.cuda.set_device(device)
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        try:
            yield
            dist.barrier()
        finally:
            dist.destroy_process_group()

    def agree(self, value: float, device: torch.device) -> float:
        """Return the first process' value: rates and the end depend on its clock."""
        if self.count == 1:
            return value
        shared = torch.tensor(value, dtype=torch.float64, device=device)
        dist.broadcast(shared, 0)
        return float(shared)

    def average_gradients(self, parameters: Iterable[Tensor]) -> None:
        """Replace the gradients of parameters by their mean over all processes, in one exchange."""
        if self.count == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        dist.all_reduce(flat)
        flat /= self.count
        parts = flat.split([gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view(gradient.shape))
