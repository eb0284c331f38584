"""CUDA graphs: what the device did once is recorded, and asked for again by a single call.

A pass through a UNet is a few thousand short kernels; for a small batch it takes Python longer to
ask for them than the device to run them. A recording runs the same kernels on the same memory, so
whatever it reads must stay where it is: `Graphs.clear` before weights or adapters move. The plain
functions stay the reference; a recording is nothing but faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
from torch import Tensor

PLAIN_CALLS = 4
"""Calls of a kind before it is recorded: a recording takes as long as several of them."""
PLAIN_STEPS = 2
"""Steps of a training before it is recorded; by then the libraries have chosen their kernels."""


class Graphs:
    """Recorded functions of one device.

    Args:
        device: A CUDA device.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds = 0.0
        """Time that recording took, in all [s]."""
        # A stream's libraries keep workspaces: with one stream they are made before a recording,
        # and not in its memory.
        self._stream = torch.cuda.Stream(device)
        self._calls: dict[Hashable, int] = {}
        self._passes: dict[Hashable, _Pass] = {}
        self._gradients: dict[Hashable, _Gradient] = {}
        self._steps: list[RecordedStep] = []

    def run(self, key: Hashable, function: Callable[..., Tensor], *arguments: Tensor) -> Tensor:
        """Return ``function(*arguments)`` without a gradient.

        Args:
            key: Whatever the result depends on besides the arguments' values, shapes and dtypes.
            function: Does the same to the same shapes; waits for nothing and uploads nothing.
            arguments: On the device.
        """
        key = key, *((x.shape, x.dtype) for x in arguments)
        if key not in self._passes:
            if self._is_rare(key):
                return function(*arguments)
            with self._recording():
                pool = next(iter(self._passes.values())).graph.pool() if self._passes else None
                self._passes[key] = _Pass(function, arguments, self._stream, pool)
        return self._passes[key](*arguments)

    def run_with_gradient(
        self, key: Hashable, function: Callable[[Tensor], Tensor], x: Tensor
    ) -> Tensor:
        """Return ``function(x)``, differentiable in ``x`` alone; its arguments are those of `run`.

        The gradient is that of the latest call of its kind: what it needs is overwritten by the
        next.

        Raises:
            RuntimeError: In the backward pass, when there was another call of its kind since.
        """
        key = key, x.shape, x.dtype
        if key not in self._gradients:
            if self._is_rare(key):
                return function(x)
            with self._recording():
                self._gradients[key] = _Gradient(function, x, self._stream)
        return self._gradients[key](x)

    def recorded_step(self, update: Callable[[], None]) -> RecordedStep:
        """Return what does ``update`` again and again.

        Args:
            update: Reads and writes the same memory each time; waits for nothing.
        """
        step = RecordedStep(update, self._stream, self._recording)
        self._steps.append(step)
        return step

    def clear(self) -> None:
        """Forget all recordings and free their memory; later calls record anew."""
        if not (self._calls or self._steps):
            return
        torch.cuda.synchronize(self.device)
        self._calls.clear()
        self._passes.clear()
        self._gradients.clear()
        for step in self._steps:
            step.forget()
        self._steps.clear()
        torch.cuda.empty_cache()

    def _is_rare(self, key: Hashable) -> bool:
        self._calls[key] = self._calls.get(key, 0) + 1
        return self._calls[key] <= PLAIN_CALLS

    @contextmanager
    def _recording(self) -> Iterator[None]:
        start = time.perf_counter()
        with torch.cuda.device(self.device):
            yield
            torch.cuda.synchronize()
        self.seconds += time.perf_counter() - start


class _Pass:
    """A function of some tensors, recorded for their shapes.

    Recordings share their memory, as one runs after the other; what they return is copied.
    """

    def __init__(
        self,
        function: Callable[..., Tensor],
        arguments: tuple[Tensor, ...],
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


class _Gradient:
    """A function of one tensor and its gradient, recorded as two graphs with memory of their own.

    Other recordings run between the two, so they must not share it.
    """

    def __init__(
        self, function: Callable[[Tensor], Tensor], x: Tensor, stream: torch.cuda.Stream
    ) -> None:
        self.x = x.detach().clone().requires_grad_()
        self.forward, self.backward = torch.cuda.CUDAGraph(), torch.cuda.CUDAGraph()
        self.calls = 0
        stream.wait_stream(torch.cuda.current_stream())
        with torch.enable_grad():
            with torch.cuda.stream(stream):
                result = function(self.x)
                self.d_result = torch.zeros_like(result)
                torch.autograd.grad(result, self.x, self.d_result)
                del result
            with torch.cuda.graph(self.forward, stream=stream):
                result = function(self.x)
            with torch.cuda.graph(self.backward, pool=self.forward.pool(), stream=stream):
                (self.d_x,) = torch.autograd.grad(result, self.x, self.d_result)
        self.result = result.detach()

    def __call__(self, x: Tensor) -> Tensor:
        result: Tensor = _Replay.apply(self, x)  # type: ignore[no-untyped-call]
        return result


class _Replay(torch.autograd.Function):
    """Both halves of a `_Gradient`; what leaves its memory is copied."""

    @staticmethod
    def forward(ctx: Any, recording: _Gradient, x: Tensor) -> Tensor:
        recording.calls += 1
        ctx.recording, ctx.call = recording, recording.calls
        recording.x.detach().copy_(x)
        recording.forward.replay()
        return recording.result.clone()

    @staticmethod
    def backward(ctx: Any, *d_results: Tensor) -> tuple[None, Tensor]:
        recording = ctx.recording
        if ctx.call != recording.calls:
            raise RuntimeError(
                "the gradient of a recorded pass was asked for too late: "
                f"{recording.calls - ctx.call} passes came after it"
            )
        recording.d_result.copy_(d_results[0])
        recording.backward.replay()
        return None, recording.d_x.clone()


class RecordedStep:
    """A training's step; the first are taken as they are, and later ones replayed."""

    def __init__(
        self,
        update: Callable[[], None],
        stream: torch.cuda.Stream,
        recording: Callable[[], AbstractContextManager[None]],
    ) -> None:
        self._update, self._stream, self._recording = update, stream, recording
        self._graph: torch.cuda.CUDAGraph | None = None
        self._calls = 0

    def __call__(self) -> None:
        """Take one step."""
        self._calls += 1
        if self._graph is None and self._calls <= PLAIN_STEPS:
            # Gradients remember the stream they were first made in.
            current = torch.cuda.current_stream()
            self._stream.wait_stream(current)
            with torch.cuda.stream(self._stream):
                self._update()
            current.wait_stream(self._stream)
            return
        if self._graph is None:
            with self._recording():
                graph = torch.cuda.CUDAGraph()
                with torch.cuda.graph(graph, stream=self._stream):
                    self._update()
                self._graph = graph
        self._graph.replay()

    def forget(self) -> None:
        """Free the recording; the next calls start anew."""
        self._graph, self._calls = None, 0
