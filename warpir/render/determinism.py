"""Bit-reproducible results: thread counts and summation order are fixed.

On the CPU the last bits of a sum depend on how many threads share it: convolutions, matrix products
and reductions of torch. So the number of its threads is a constant, never that of the machine's
cores or of an environment variable; `warpir.app.program` does the same for NumPy's.
(`warpir.render.renderer` may use all cores: a pixel's numbers do not depend on the slices that it
cuts.) On a GPU the order of additions is open as well, unless `fixed_arithmetic` fixes it, which
costs time.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from warpir.core.errors import ExitCode, InputError

if TYPE_CHECKING:
    from torch import nn

THREADS = 1
"""Number of torch's threads on the CPU, unless a network is large."""
LARGE_THREADS = 8
"""Number of threads for a network of Stable Diffusion's size; with fewer cores it takes no longer
than with as many threads as cores."""
LARGE_PARAMETERS = 10**8
"""Number of parameters from which a network counts as large."""
MAX_RECORDS = 1024
"""Largest number of ordered additions of one thread of `warpir.kernels.light_gradient`, whose loop
Warp cannot count; it keeps room for as many of each thread."""
WORKSPACE = ":4096:8"
"""Workspace of cuBLAS with which its results are reproducible, by NVIDIA's documentation."""


@contextmanager
def fixed_arithmetic(device: str, is_deterministic: bool) -> Iterator[None]:
    """Within this context torch computes the same bytes each time; its random stream stays.

    On the CPU always, with `THREADS` threads; on CUDA if ``is_deterministic``, and then Warp's
    kernels too.

    Args:
        device: Warp's name of the device.
        is_deterministic: Whether a GPU is to repeat its bytes, slower.

    Raises:
        InputError: torch cannot use the GPU that Warp has found (`ExitCode.USAGE`).
    """
    import torch

    if device != "cpu" and not torch.cuda.is_available():
        raise InputError(
            "--device",
            f"torch cannot use {device}: it is built without CUDA, or the driver is too old for it",
            "use --device cpu, or install a torch that fits the driver",
            ExitCode.USAGE,
        )
    is_strict = is_deterministic or device == "cpu"
    if device != "cpu":
        if is_deterministic:
            # cuBLAS reads it when its first handle is made.
            os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", WORKSPACE)
        _order_kernels(is_deterministic)
    threads, mode = torch.get_num_threads(), torch.get_deterministic_debug_mode()
    memory: Any = torch.utils.deterministic  # which has no types
    is_filling = memory.fill_uninitialized_memory
    torch.set_num_threads(THREADS)
    # Of `torch.use_deterministic_algorithms`, without the compiler that it loads (2 s).
    torch.set_deterministic_debug_mode("error" if is_strict else "default")
    # It exposes reads of uninitialised memory, at the cost of writing all of it.
    memory.fill_uninitialized_memory = False
    try:
        # Libraries draw weights that are then replaced: nothing here depends on the stream.
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)
        torch.set_deterministic_debug_mode(mode)
        memory.fill_uninitialized_memory = is_filling


def use_threads_for(network: nn.Module) -> None:
    """Set the number of torch's threads, which depends on the network's size alone."""
    import torch

    count = sum(parameter.numel() for parameter in network.parameters())
    torch.set_num_threads(LARGE_THREADS if count >= LARGE_PARAMETERS else THREADS)


def _order_kernels(is_deterministic: bool) -> None:
    """Switch Warp's ordered addition on CUDA on or off, before the modules are compiled."""
    import warp as wp

    from warpir.kernels import composite, light_gradient, shade

    mode = (
        wp.DeterministicMode.RUN_TO_RUN if is_deterministic else wp.DeterministicMode.NOT_GUARANTEED
    )
    # Those whose threads add to common places, most of them in their backward pass. The threads of
    # `warpir.render.transport.rows` each get a row of their own instead.
    for module in (composite, light_gradient, shade):
        if wp.get_module_options(module)["deterministic"] != mode:
            records = MAX_RECORDS if is_deterministic and module is light_gradient else 0
            wp.set_module_options(
                {"deterministic": mode, "deterministic_max_records": records}, module
            )
