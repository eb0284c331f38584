"""Did guidance help? The work of its force from where the light started to where it ended.

A loop follows the force downhill, so along its own way the potential falls by construction. Asked
anew, with noises, times and crops that no step used, along the straight way through the space of
the unknowns, the force tells whether the end is better; if it does not clearly say so, the start is
kept. What a prior does not know it contradicts itself about, and then the start stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

PIECES = 8
"""Of the way; the force is asked in the middle of each."""
DRAWS = 16
"""Noises, times and crops, the same along the whole way."""
ONE_SIDED = 1.64
"""Standard errors that a fall must exceed: 95 % of a normal distribution."""


class Force(Protocol):
    """What pulls at a picture."""

    def work(self, start: Tensor, middle: Tensor, end: Tensor, draws: Sequence[int]) -> list[float]:
        """Return by draw what the potential rises by on a short way from one picture to another.

        Args:
            start: Display-encoded, in [0, 1], shape [1, 3, H, W].
            middle: Halfway, same shape.
            end: Same shape.
            draws: Seeds of noise, time and crop.
        """


@dataclass(frozen=True)
class Verdict:
    """Whether the end is kept, and why."""

    is_accepted: bool
    rise: float
    """Mean of the potential's rise from start to end over the draws."""
    error: float
    """Its standard error."""
    draws: int

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``; what is not finite is absent."""
        numbers = {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}
        return {**numbers, "is_accepted": self.is_accepted}

    @property
    def line(self) -> str:
        """What is printed."""
        numbers = f"dU = {self.rise:.3g} +- {self.error:.2g}"
        if self.is_accepted:
            return f"accepted: guidance, asked anew, prefers the end ({numbers})"
        return f"kept the start: guidance could not show an improvement ({numbers})"


@torch.no_grad()
def judge(
    force: Force,
    image: Callable[[float], Tensor],
    pieces: int = PIECES,
    draws: int = DRAWS,
) -> Verdict:
    """Return whether the potential clearly falls along a way.

    Args:
        force: Asked in the middle of each piece.
        image: The picture at a share of the way, 0 to 1, without noise of its own.
        pieces: Of the way.
        draws: At least 2.
    """
    seeds = range(draws)
    total = np.zeros(draws)
    before = image(0.0)
    for k in range(pieces):
        after = image((k + 1) / pieces)
        total += force.work(before, image((k + 0.5) / pieces), after, seeds)
        before = after
    rise, error = float(total.mean()), float(total.std(ddof=1)) / math.sqrt(draws)
    # Not finite: nothing was shown.
    return Verdict(bool(rise + ONE_SIDED * error < 0.0), rise, error, draws)


def blend(start: dict[str, Tensor], end: dict[str, Tensor], share: float) -> dict[str, Tensor]:
    """Return a state on the straight way between two; directions are to be normalised again."""
    return {name: torch.lerp(value, end[name], share) for name, value in start.items()}
