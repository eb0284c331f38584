"""The last stop of every guidance gradient: non-finite ones end here, outliers are shortened."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.prior import Counts

NORM_WINDOW = 101
"""Number of past steps whose median norm defines an outlier."""
NORM_COUNT_MIN = 10
"""Past steps before anything is clipped: the norm varies tenfold with the time alone."""


class GradientGate:
    """Lets finite gradients pass, shortens outliers, and counts those.

    Args:
        clip: Greatest norm in running medians; 0 for no limit.
    """

    def __init__(self, clip: float) -> None:
        self.clip = clip
        self.counts = Counts()
        self.norms: deque[float] = deque(maxlen=NORM_WINDOW)

    def passed(self, d_image: Tensor | None) -> Tensor | None:
        """Return the gradient, no longer than allowed; None when it is not finite.

        Args:
            d_image: Any shape; None when it is known not to be finite.
        """
        norm = math.nan
        if d_image is not None:
            # In float64 the norm is finite exactly when every element is.
            norm = float(torch.linalg.vector_norm(d_image, dtype=torch.float64))
        if d_image is None or not math.isfinite(norm):
            return None
        limit = self.clip * median(self.norms) if len(self.norms) >= NORM_COUNT_MIN else 0.0
        self.norms.append(norm)
        if not 0.0 < limit < norm:
            return d_image
        self.counts.clipped_steps += 1
        return d_image * (limit / norm)

    def state_dict(self) -> dict[str, Any]:
        """Return numbers and lists of numbers."""
        return {"norms": list(self.norms), "clipped_steps": self.counts.clipped_steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.norms = deque(state["norms"], maxlen=NORM_WINDOW)
        self.counts.clipped_steps = int(state["clipped_steps"])
