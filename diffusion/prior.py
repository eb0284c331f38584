"""What every diffusion prior promises, and what a picture is judged by.

A prior is a frozen denoiser: it turns pictures into latents, knows its noise schedule, and predicts
the noise in noisy latents for a prompt, with or without an adapter (a LoRA). Guidance
(`warpir.diffusion.guidance`) asks nothing else of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from warpir.diffusion.schedule import NoiseSchedule

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


class NonFiniteError(Exception):
    """Numbers stayed non-finite; the program says so and exits with 6."""


class Editor(Protocol):
    """Changes a picture towards a prompt; an ability that a prior may lack."""

    def edit(
        self,
        image: Tensor,
        prompt: str,
        seed: int,
        *,
        strength: float,
        steps: int,
        scale: float,
        adapter: str | None = None,
    ) -> Tensor:
        """Return the picture after noise and denoising (SDEdit), in [0, 1], of the same shape."""


class HalfPrecision(Protocol):
    """Networks that compute in less than full precision, and can be switched over to it."""

    def upcast(self) -> bool:
        """Compute in fp32 from now on; return False where that is so already."""

    def ensure_precision(self, difference: Callable[[], Tensor]) -> float:
        """Compute in fp32 from now on if a difference of predictions needs it.

        Args:
            difference: Predicts and subtracts; called twice, with all else equal.

        Returns:
            Cosine between the difference as computed before and in fp32.
        """


class Prior(Protocol):
    """A denoiser and its schedule; weights never change, adapters are added beside them."""

    name: str
    """Such as ``stable-diffusion``; goes into every run's record."""
    digest: str
    """sha256 of the weights."""
    resolution: int
    """Side of the square pictures it judges [px]."""
    schedule: NoiseSchedule
    device: torch.device
    adapters: set[str]
    """Names of the LoRAs that were loaded or trained."""
    in_chunks: InChunks
    """How its larger batches are computed, such as in halves where memory is short."""

    @property
    def editor(self) -> Editor | None:
        """Return what edits pictures, or None."""

    @property
    def half_precision(self) -> HalfPrecision | None:
        """Return what switches to full precision, or None where nothing else is computed in."""

    def spare_memory(self) -> None:
        """Free what only makes it faster."""

    def embed(self, prompts: Sequence[str]) -> Tensor:
        """Return the prompts' embeddings, shape [prompt, token, channel]; each is computed once.

        Raises:
            ModelError: The text encoder was freed and a prompt is new.
        """

    def encode(self, image: Tensor) -> Tensor:
        """Return latents, float32, shape [B, C, h, w]; differentiable, without sampling noise.

        Args:
            image: Display-encoded, in [0, 1], shape [B, 3, resolution, resolution].
        """

    def predict(
        self,
        latents_noisy: Tensor,
        t: Tensor,
        embeddings: Tensor,
        adapters: Sequence[str | None],
    ) -> Tensor:
        """Return the predicted noise (epsilon, whatever the network predicts), float32, detached.

        One batched call; each sample has its own prompt and adapter.

        Args:
            latents_noisy: ``a z + s noise``, shape [B, C, h, w].
            t: Times in [0, 1], shape [B].
            embeddings: From `embed`, one per sample, shape [B, token, channel].
            adapters: Per sample the name of its adapter, or None for the base weights.

        Raises:
            ModelError: An adapter is unknown.
        """


@dataclass
class Counts:
    """What happened during a run that the user is told about."""

    clipped_steps: int = 0
    """Steps whose gradient was shortened."""
