"""Acceptance test of guidance: the work of its force from the start of the loop to its end.

A loop follows the force downhill, so along its own path the potential falls by construction. The
force is therefore evaluated again, with noises, times and crops that no step used, along the
straight path through the space of the unknowns. Unless the potential clearly falls there, the start
is kept: where a prior knows nothing, its forces contradict each other and the test fails.
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
"""Number of pieces of the path; the force is evaluated in the middle of each."""
DRAWS = 16
"""Number of draws of noise, time and crop, the same along the whole path."""
ONE_SIDED = 1.64
"""Standard errors that a fall must exceed: 95 % of a normal distribution."""


class Force(Protocol):
    """A force on an image, as the gradient of a potential."""

    def work(self, start: Tensor, middle: Tensor, end: Tensor, draws: Sequence[int]) -> list[float]:
        """Return the rise of the potential from one image to a near one, for each draw.

        Args:
            start: Display-encoded, in [0, 1], shape [1, 3, H, W].
            middle: Halfway, same shape.
            end: Same shape.
            draws: Seeds of noise, time and crop.
        """


@dataclass(frozen=True)
class Verdict:
    """Result of the acceptance test."""

    is_accepted: bool
    rise: float
    """Mean of the potential's rise from start to end over the draws."""
    error: float
    """Standard error of `rise`."""
    draws: int

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``; what is not finite is absent."""
        numbers = {k: v if math.isfinite(v) else None for k, v in asdict(self).items()}
        return {**numbers, "is_accepted": self.is_accepted}

    @property
    def line(self) -> str:
        """Verdict in one line."""
        numbers = f"dU = {self.rise:.3g} +- {self.error:.2g}"
        if self.is_accepted:
            return f"accepted: guidance, asked anew, prefers the end ({numbers})"
        return f"kept the start: guidance could not show an improvement ({numbers})"


@torch.no_grad()
def judge(force: Force, image: Callable[[float], Tensor], pieces: int = PIECES) -> Verdict:
    """Return whether the potential clearly falls along a path.

    Args:
        force: Evaluated in the middle of each piece.
        image: Image at a share of the path, 0 to 1, without noise of its own.
        pieces: Number of pieces of the path.
    """
    total = np.zeros(DRAWS)
    before = image(0.0)
    for k in range(pieces):
        after = image((k + 1) / pieces)
        total += force.work(before, image((k + 0.5) / pieces), after, range(DRAWS))
        before = after
    rise, error = float(total.mean()), float(total.std(ddof=1)) / math.sqrt(DRAWS)
    # Not finite: nothing was shown.
    return Verdict(bool(rise + ONE_SIDED * error < 0.0), rise, error, DRAWS)


def blend(start: dict[str, Tensor], end: dict[str, Tensor], share: float) -> dict[str, Tensor]:
    """Return a state on the straight line between two; directions need normalising again."""
    return {name: torch.lerp(value, end[name], share) for name, value in start.items()}
