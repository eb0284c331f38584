"""The loss without a row of coefficients: the picture is edited, and the edit is the target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.crop import Crop, box_of, draw_crop
from warpir.diffusion.draws import generator_of, seed_of
from warpir.diffusion.gradient_gate import GradientGate
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.prior import Condition, Counts, Prior
from warpir.diffusion.schedule import time_range
from warpir.diffusion.settings import GuidanceSettings

DATASET_UPDATE = "dataset-update"
"""Name of this loss."""
EDIT_COUNT = 4
"""Edited crops of a score, each of which costs many passes."""
VALUES_PER_LATENT = 48
"""Values of a picture for each of its latents: Stable Diffusion makes 4 of 8 x 8 x 3."""


class DatasetUpdate:
    """The picture is edited now and then, and drawn towards its edit (DiPIR, table 3).

    Every ``update_every`` steps a crop is edited by SDEdit with the adapted model; its strength is
    the greatest time of that step. Until the next edit the gradient is that of the L1 distance
    between this crop and its edit: its mean times the number of latents, so that it counts as much
    as a sum over latents does in the other losses. One crop at a time, however many noises.

    Args:
        prior: Has an editor.
        condition: What the picture is to be judged by; its prompt alone counts.
        settings: Times, crops and edits.
        mask: Coverage of the object, shape [H, W].
        steps: Length of the run, over which the strength falls.
        seed: Of what is drawn.
        adapter: Name of the LoRA of this photo, or None for the base model.

    Raises:
        ValueError: The mask is empty.
        ModelError: The prior cannot edit pictures.
    """

    def __init__(
        self,
        prior: Prior,
        condition: Condition,
        settings: GuidanceSettings,
        mask: Tensor,
        steps: int,
        seed: int,
        adapter: str | None,
    ) -> None:
        if prior.editor is None:
            raise ModelError(prior.name, f"cannot edit pictures, as {DATASET_UPDATE} needs")
        self.prior, self.editor = prior, prior.editor
        # An edit asks for the same two; by then the text encoder may be gone.
        prior.embed([condition.prompt, ""])
        self.condition, self.settings, self.adapter = condition, settings, adapter
        self.box, self.steps, self.seed = box_of(mask), steps, seed
        self.gate = GradientGate(settings.gradient_clip)
        self.crop: Crop | None = None
        self.edited: Tensor | None = None

    @property
    def counts(self) -> Counts:
        """What the user is told in the end."""
        return self.gate.counts

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        """Return the gradient of the L1 distance between the crop and its edit.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].
            step: From 0.

        Returns:
            Same shape, dtype and device; None when it is not finite.
        """
        s = self.settings
        if self.crop is None or self.edited is None or step % s.update_every == 0:
            strength = time_range(step, self.steps, s.time_min, s.time_max, s.time_max_end)[1]
            self.crop = self._draw(image, self.seed, step)
            self.edited = self._edit(image, self.crop, strength, self.seed, step)
        leaf = image.detach().requires_grad_()
        distance = self._distance(leaf, self.crop, self.edited)
        # The derivative of |x| is a sign, and that of NaN is 0: only the distance tells.
        if not math.isfinite(distance.item()):
            self.edited = None
            return self.gate.passed(None)
        (d_image,) = torch.autograd.grad(distance, leaf)
        return self.gate.passed(d_image)

    @torch.no_grad()
    def score(
        self, image: Tensor, seed: int | None = None, edits: int = EDIT_COUNT
    ) -> float | None:
        """Return how much the model would change an image; None when that is not finite.

        The mean distance between crops and their edits, all of the run's greatest strength.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].
            seed: Of edits and crops; the guidance's own by default.
            edits: Crops.
        """
        seed = self.seed if seed is None else seed
        distances = []
        for k in range(edits):
            crop = self._draw(image, seed, "score", k)
            edited = self._edit(image, crop, self.settings.time_max, seed, "score", k)
            distances.append(self._distance(image, crop, edited).item())
        score = sum(distances) / edits
        return score if math.isfinite(score) else None

    def state_dict(self) -> dict[str, Any]:
        """Return numbers, lists of numbers and the edited crop."""
        state = self.gate.state_dict()
        if self.crop is not None and self.edited is not None:
            state["crop"] = [self.crop.x, self.crop.y, self.crop.side]
            state["edited"] = self.edited.cpu()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.gate.load_state_dict(state)
        self.crop = Crop(*state["crop"]) if "crop" in state else None
        self.edited = state["edited"].to(self.prior.device) if "edited" in state else None

    def _draw(self, image: Tensor, *key: int | str) -> Crop:
        height, width = image.shape[-2:]
        return draw_crop(self.box, (height, width), self.settings, generator_of(*key))

    @torch.no_grad()
    def _edit(self, image: Tensor, crop: Crop, strength: float, *key: int | str) -> Tensor:
        """Return the edited crop, shape [1, 3, R, R]."""

        def edited(first: int, last: int) -> Tensor:
            return self.editor.edit(
                crop.apply(image, self.prior.resolution).to(self.prior.device),
                self.condition.prompt,
                seed_of(*key, "edit"),
                strength=strength,
                steps=self.settings.update_steps,
                scale=self.settings.update_scale,
                adapter=self.adapter,
            )

        return next(self.prior.in_chunks(edited, 1, "an edit of the picture", "--precision"))

    def _distance(self, image: Tensor, crop: Crop, edited: Tensor) -> Tensor:
        difference = crop.apply(image, self.prior.resolution) - edited.to(image)
        return difference.abs().sum() / VALUES_PER_LATENT
