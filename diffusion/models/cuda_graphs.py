"""CUDA graphs: what the device did once is recorded, and asked for again by a single call.

A pass through a UNet is a few thousand short kernels; for a small batch it takes Python longer to
ask for them than the device to run them. A recording runs the same kernels on the same memory, so
whatever it reads must stay where it is: `Graphs.clear` before weights or adapters move. The plain
functions stay the reference; a recording is nothing but faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn
from torch.func import functional_call

PLAIN_CALLS = 4
"""Calls of a kind before it is recorded: a recording takes as long as several of them."""
PLAIN_STEPS = 2
"""Steps of a training before it is recorded; by then the libraries have chosen their kernels."""


class Graphs:
    """Recorded functions of one device."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = 0.0
        """Time that recording took, in all [s]."""
        # A stream's libraries keep workspaces: with one stream they are made before a recording,
        # and not in its memory.
        self.stream = torch.cuda.Stream(device)
        self._calls: dict[Hashable, int] = {}
        self._passes: dict[Hashable, _Pass] = {}
        self._recorded: WeakSet[RecordedModule | RecordedStep] = WeakSet()

    def run(self, key: Hashable, function: Callable[..., Tensor], *arguments: Tensor) -> Tensor:
        """Return ``function(*arguments)`` without a gradient.

        Args:
            key: Whatever the result depends on besides the arguments' values, shapes and dtypes.
            function: Does the same to the same shapes; waits for nothing and uploads nothing.
            arguments: On the device.
        """
        key = key, *_kinds(arguments)
        if key not in self._passes:
            self._calls[key] = self._calls.get(key, 0) + 1
            if self._calls[key] <= PLAIN_CALLS:
                return function(*arguments)
            with self.recording():
                pool = next(iter(self._passes.values())).graph.pool() if self._passes else None
                self._passes[key] = _Pass(function, arguments, self.stream, pool)
        return self._passes[key](*arguments)

    def recorded_module(self, module: nn.Module) -> RecordedModule:
        """Return what computes a module and, when it is asked for, its gradient.

        Args:
            module: Returns a tuple of tensors; does the same to the same shapes, waits for nothing
                and uploads nothing. Its free parameters always stay in the same memory.
        """
        made = RecordedModule(self, module)
        self._recorded.add(made)
        return made

    def recorded_step(self, update: Callable[[], None]) -> RecordedStep:
        """Return what does ``update`` again and again.

        Args:
            update: Reads and writes the same memory each time; waits for nothing.
        """
        made = RecordedStep(self, update)
        self._recorded.add(made)
        return made

    def clear(self) -> None:
        """Forget all recordings and free their memory; later calls record anew."""
        torch.cuda.synchronize(self.device)
        self._calls.clear()
        self._passes.clear()
        for recorded in self._recorded:
            recorded.forget()
        torch.cuda.empty_cache()

    @contextmanager
    def recording(self) -> Iterator[None]:
        """Count the time within this context as that of recording."""
        start = time.perf_counter()
        with torch.cuda.device(self.device):
            yield
            torch.cuda.synchronize()
        self.seconds += time.perf_counter() - start


def _kinds(arguments: Sequence[Tensor]) -> tuple[Hashable, ...]:
    return tuple((x.shape, x.dtype) for x in arguments)


class _Pass:
    """A function of some tensors, recorded for their shapes.

    Recordings share their memory, as one runs after the other; what they return is copied.
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        arguments: Sequence[Tensor],
        stream: torch.cuda.Stream,
        pool: Any,
    ) -> None:
        self.arguments = tuple(x.detach().clone() for x in arguments)
        stream.wait_stream(torch.cuda.current_stream())
        with torch.no_grad(), torch.cuda.stream(stream):
            function(*self.arguments)
        self.graph = torch.cuda.CUDAGraph()
        with torch.no_grad(), torch.cuda.graph(self.graph, pool=pool, stream=stream):
            self.result: Tensor = function(*self.arguments)

    def __call__(self, *arguments: Tensor) -> Tensor:
        for held, given in zip(self.arguments, arguments, strict=True):
            held.copy_(given)
        self.graph.replay()
        return self.result.clone()


class RecordedModule:
    """A function of some tensors with its gradient; made by `Graphs.recorded_module`.

    The gradient is that of the latest call with its shapes: what it needs is overwritten by the
    next, and then asking for it raises a RuntimeError.
    """

    def __init__(self, graphs: Graphs, module: nn.Module) -> None:
        self._graphs, self._module = graphs, module
        free = {name: p for name, p in module.named_parameters() if p.requires_grad}
        self._parameters = free
        self._calls: dict[Hashable, int] = {}
        self._gradients: dict[Hashable, _Gradient] = {}

    def __call__(self, *arguments: Tensor) -> tuple[Tensor, ...]:
        """Return what the module returns."""
        key = _kinds(arguments)
        results: tuple[Tensor, ...]
        if key not in self._gradients:
            self._calls[key] = self._calls.get(key, 0) + 1
            if self._calls[key] <= PLAIN_CALLS:
                results = self._module(*arguments)
                return results
            with self._graphs.recording():
                self._gradients[key] = _Gradient(
                    self._module, arguments, self._parameters, self._graphs.stream
                )
        results = _Replay.apply(  # type: ignore[no-untyped-call]
            self._gradients[key], *arguments, *self._parameters.values()
        )
        return results

    def forget(self) -> None:
        """Free the recordings; the next calls start anew."""
        self._calls.clear()
        self._gradients.clear()


class _Gradient:
    """Both halves of a module, recorded as two graphs with memory of their own.

    Other recordings run between the two, so they must not share it.
    """

    def __init__(
        self,
        module: nn.Module,
        arguments: Sequence[Tensor],
        parameters: Mapping[str, nn.Parameter],
        stream: torch.cuda.Stream,
    ) -> None:
        self.arguments = [x.detach().clone().requires_grad_(x.requires_grad) for x in arguments]
        # The same memory, but unknown to what was computed before, which may still wait for its
        # gradient in another stream.
        aliases = {name: p.detach().requires_grad_() for name, p in parameters.items()}
        self.inputs = [*self.arguments, *aliases.values()]
        self.forward, self.backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        self.calls = 0
        results: tuple[Tensor, ...]
        stream.wait_stream(torch.cuda.current_stream())
        with torch.enable_grad():
            with torch.cuda.stream(stream):
                results = functional_call(module, aliases, tuple(self.arguments))
                self.is_free = [x.requires_grad for x in results]
                self.d_results = [torch.zeros_like(x) for x in results if x.requires_grad]
                self._differentiate(results)
            del results
            with torch.cuda.graph(self.forward, stream=stream):
                results = functional_call(module, aliases, tuple(self.arguments))
            with torch.cuda.graph(self.backward, pool=self.forward.pool(), stream=stream):
                self.d_inputs = self._differentiate(results)
        self.results = [x.detach() for x in results]

    def _differentiate(self, results: Sequence[Tensor]) -> list[Tensor | None]:
        """Return the gradient of each argument and parameter, None where there is none."""
        gradients = iter(
            torch.autograd.grad(
                [x for x in results if x.requires_grad],
                [x for x in self.inputs if x.requires_grad],
                self.d_results,
                allow_unused=True,
            )
        )
        return [next(gradients) if x.requires_grad else None for x in self.inputs]


class _Replay(torch.autograd.Function):
    """Both halves of a `_Gradient`; what leaves its memory is copied."""

    @staticmethod
    def forward(ctx: Any, recorded: _Gradient, *inputs: Tensor) -> tuple[Tensor, ...]:
        recorded.calls += 1
        ctx.recorded, ctx.call = recorded, recorded.calls
        for held, given in zip(recorded.arguments, inputs, strict=False):  # parameters stay
            held.detach().copy_(given)
        recorded.forward.replay()
        results = tuple(x.clone() for x in recorded.results)
        fixed = (x for x, is_free in zip(results, recorded.is_free, strict=True) if not is_free)
        ctx.mark_non_differentiable(*fixed)
        return results

    @staticmethod
    def backward(ctx: Any, *d_results: Tensor) -> tuple[Tensor | None, ...]:
        recorded = ctx.recorded
        if ctx.call != recorded.calls:
            raise RuntimeError(
                "the gradient of a recorded pass was asked for too late: "
                f"{recorded.calls - ctx.call} passes came after it"
            )
        given = (d for d, is_free in zip(d_results, recorded.is_free, strict=True) if is_free)
        for held, d_result in zip(recorded.d_results, given, strict=True):
            held.copy_(d_result)
        recorded.backward.replay()
        return None, *(None if d is None else d.clone() for d in recorded.d_inputs)


class RecordedStep:
    """A training's step; the first are taken as they are, and later ones replayed."""

    def __init__(self, graphs: Graphs, update: Callable[[], None]) -> None:
        self._graphs, self._update = graphs, update
        self._graph: torch.cuda.CUDAGraph | None = None
        self._calls = 0

    def __call__(self) -> None:
        """Take one step."""
        self._calls += 1
        stream = self._graphs.stream
        if self._graph is None and self._calls <= PLAIN_STEPS:
            # Gradients remember the stream they were first made in.
            current = torch.cuda.current_stream(self._graphs.device)
            stream.wait_stream(current)
            with torch.cuda.stream(stream):
                self._update()
            current.wait_stream(stream)
            return
        if self._graph is None:
            with self._graphs.recording():
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, stream=stream):
                    self._update()
                self._graph = graph
        self._graph.replay()

    def forget(self) -> None:
        """Free the recording; the next calls start anew."""
        self._graph, self._calls = None, 0
