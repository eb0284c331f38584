"""The loss without a row of coefficients: the picture is edited, and the edit is the target."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.crop import Crop, draw_crop
from warpir.diffusion.draws import generator_of, seed_of
from warpir.diffusion.gradient_gate import GatedGuidance

DATASET_UPDATE = "dataset-update"
"""Name of this loss."""
EDIT_COUNT = 4
"""Edited crops of a score, each of which costs many passes."""
VALUES_PER_LATENT = 48
"""Values of a picture for each of its latents: Stable Diffusion makes 4 of 8 x 8 x 3."""


class DatasetUpdate(GatedGuidance):
    """The picture is edited now and then, and drawn towards its edit (DiPIR, table 3).

    Every ``update_every`` steps a crop is edited by SDEdit with the adapted model; its strength is
    the greatest time of that step. Until the next edit the gradient is that of the L1 distance
    between this crop and its edit: its mean times the number of latents, so that it counts as much
    as a sum over latents does in the other losses. One crop at a time, however many noises.

    Arguments as of `GatedGuidance`; of the prompts this one alone counts.

    Raises:
        ValueError: The mask is empty.
    """

    def prepare(self) -> None:
        """Embed the prompts that an edit asks for; by then the text encoder may be gone."""
        self.prior.embed([self.prompt, ""])
        self.crop: Crop | None = None
        self.edited: Tensor | None = None

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        """Return the gradient of the L1 distance between the crop and its edit.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].
            step: From 0.

        Returns:
            Same shape, dtype and device; None when it is not finite.
        """
        is_due = step % self.settings.update_every == 0
        if self.crop is None or self.edited is None or is_due:
            self.crop = self._draw(image, self.seed, step)
            self.edited = self._edit(image, self.crop, self.times(step)[1], self.seed, step)
        leaf = image.detach().requires_grad_()
        distance = self._distance(leaf, self.crop, self.edited)
        # The derivative of |x| is a sign, and that of NaN is 0: only the distance tells.
        if not math.isfinite(distance.item()):
            self.edited = None
            return None
        (d_image,) = torch.autograd.grad(distance, leaf)
        return self.gate.passed(d_image)

    @torch.no_grad()
    def score(self, image: Tensor) -> float | None:
        """Return how much the model would change an image; None when that is not finite.

        The mean distance between `EDIT_COUNT` crops and their edits, all of the run's greatest
        strength. The image is display-encoded, in [0, 1], shape [1, 3, H, W].
        """
        distances = []
        for k in range(EDIT_COUNT):
            crop = self._draw(image, self.seed, "score", k)
            edited = self._edit(image, crop, self.settings.time_max, self.seed, "score", k)
            distances.append(self._distance(image, crop, edited).item())
        score = sum(distances) / EDIT_COUNT
        return score if math.isfinite(score) else None

    def state_dict(self) -> dict[str, Any]:
        """Return numbers, lists of numbers and the edited crop."""
        state = super().state_dict()
        if self.crop is not None and self.edited is not None:
            state["crop"] = [self.crop.x, self.crop.y, self.crop.side]
            state["edited"] = self.edited.cpu()
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        super().load_state_dict(state)
        self.crop = Crop(*state["crop"]) if "crop" in state else None
        self.edited = state["edited"].to(self.prior.device) if "edited" in state else None

    def _draw(self, image: Tensor, *key: int | str) -> Crop:
        height, width = image.shape[-2:]
        return draw_crop(self.box, (height, width), self.settings, generator_of(*key))

    @torch.no_grad()
    def _edit(self, image: Tensor, crop: Crop, strength: float, *key: int | str) -> Tensor:
        """Return the edited crop, shape [1, 3, R, R]."""

        def edited(first: int, last: int) -> Tensor:
            return self.prior.edit(
                crop.apply(image, self.prior.resolution).to(self.prior.device),
                self.prompt,
                seed_of(*key, "edit"),
                strength=strength,
                steps=self.settings.update_steps,
                scale=self.settings.update_scale,
                adapter=self.adapter,
            )

        def whole() -> Tensor:
            return next(self.prior.in_chunks(edited, 1, "an edit of the picture", "--precision"))

        picture = whole()
        is_spoilt = not bool(picture.isfinite().all()) and bool(image.isfinite().all())
        if is_spoilt and self.prior.upcast("edits of the picture"):
            picture = whole()
        return picture

    def _distance(self, image: Tensor, crop: Crop, edited: Tensor) -> Tensor:
        difference = crop.apply(image, self.prior.resolution) - edited.to(image)
        return difference.abs().sum() / VALUES_PER_LATENT
