"""What every guidance knows, and the last stop of its gradients: outliers are shortened there."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from statistics import median
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.crop import box_of
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.schedule import time_range
from warpir.diffusion.settings import GuidanceSettings

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
        self.clipped_steps = 0
        """Steps whose gradient was shortened."""
        self.norms: deque[float] = deque(maxlen=NORM_WINDOW)

    def passed(self, d_image: Tensor) -> Tensor | None:
        """Return the gradient, no longer than allowed; None when it is not finite."""
        # In float64 the norm is finite exactly when every element is.
        norm = float(torch.linalg.vector_norm(d_image, dtype=torch.float64))
        if not math.isfinite(norm):
            return None
        limit = self.clip * median(self.norms) if len(self.norms) >= NORM_COUNT_MIN else 0.0
        self.norms.append(norm)
        if not 0.0 < limit < norm:
            return d_image
        self.clipped_steps += 1
        return d_image * (limit / norm)

    def state_dict(self) -> dict[str, Any]:
        """Return numbers and lists of numbers."""
        return {"norms": list(self.norms), "clipped_steps": self.clipped_steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.norms = deque(state["norms"], maxlen=NORM_WINDOW)
        self.clipped_steps = int(state["clipped_steps"])


class GatedGuidance:
    """A guidance whose gradients pass a `GradientGate`.

    Args:
        prior: The frozen denoiser.
        prompt: What the adapted model is asked for; what the others are is in the settings.
        settings: Loss, weights, times, crops and edits.
        mask: Coverage of the object, shape [H, W].
        steps: Length of the run, over which the times fall.
        seed: Of what is drawn.
        adapter: Name of the LoRA of this photo, or None for the base model.

    Raises:
        ValueError: The mask is empty.
    """

    def __init__(
        self,
        prior: StableDiffusion,
        prompt: str,
        settings: GuidanceSettings,
        mask: Tensor,
        steps: int,
        seed: int,
        adapter: str | None,
    ) -> None:
        self.prior, self.prompt, self.settings = prior, prompt, settings
        self.mask, self.adapter = mask, adapter
        self.box, self.steps, self.seed = box_of(mask), steps, seed
        self.gate = GradientGate(settings.gradient_clip)
        self.prepare()

    def prepare(self) -> None:
        """Compute once what every step needs."""

    def times(self, step: int) -> tuple[float, float]:
        """Return the least and the greatest time of a step."""
        s = self.settings
        return time_range(step, self.steps, s.time_min, s.time_max, s.time_max_end)

    def state_dict(self) -> dict[str, Any]:
        """Return tensors, numbers and lists of numbers."""
        return self.gate.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.gate.load_state_dict(state)
