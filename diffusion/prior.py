"""What the users of a diffusion prior share: chunks of its work, steps that went wrong."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol, TypeVar

from warpir.core.errors import ExitCode, InputError

T = TypeVar("T")


class InChunks(Protocol):
    """How work that may lack memory is done: at once, or tried again in halves."""

    def __call__(
        self,
        do: Callable[[int, int], T],
        count: int,
        what: str,
        flags: str,
        spare: Callable[[], object] = ...,
    ) -> Iterator[T]:
        """Yield what is made of ``count`` things; see `warpir.core.memory.Memory.in_chunks`."""


def at_once(
    do: Callable[[int, int], T],
    count: int,
    what: str,
    flags: str,
    spare: Callable[[], object] = lambda: None,
) -> Iterator[T]:
    """Yield what is made of all things; who drives the model may put another in its place."""
    yield do(0, count)


BAD_STEPS_MAX = 5
"""Steps in a row without a finite gradient that end a training or an optimisation."""


@dataclass
class BadSteps:
    """Counts the steps of a training or an optimisation that had no finite gradient."""

    bad_steps: int = 0
    """Number of the latest steps in a row without a finite gradient."""
    skipped: int = 0
    """Number of all steps without a finite gradient."""

    def count_step(self, is_finite: bool) -> bool:
        """Count a step; return whether it is the last of too many bad ones in a row."""
        self.bad_steps = 0 if is_finite else self.bad_steps + 1
        self.skipped += not is_finite
        return self.bad_steps >= BAD_STEPS_MAX


class NonFiniteError(InputError):
    """Numbers stayed non-finite; the program says so and exits with 6."""

    def __init__(self, what: str) -> None:
        advice = "try --precision fp32; the last checkpoint holds the state before"
        super().__init__("guidance", what, advice, ExitCode.NUMERIC)
