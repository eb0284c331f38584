"""What the embedded prior is trained on, by which settings, and its loss.

    min  E[ weight |f(z_t, t, prompt, conditions) - v|^2 ],   v = a noise - s z

over composites, right and wrong, with words and conditions left out at random. Object and shadow
are few pixels of a picture, and count more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from warpir.diffusion.models.embedded import EmbeddedNetwork, NetworkConfig, cosine_schedule
from warpir.diffusion.schedule import NoiseSchedule


class Batch(Protocol):
    """Composites and what they are made of; fields as in ``warpir.train.batches.PriorBatch``."""

    @property
    def image(self) -> Tensor:
        """Composites, display-encoded, in [0, 1], shape [B, 3, 64, 64]."""

    @property
    def background(self) -> Tensor:
        """The same crops without the object, and the whole photos, shape [B, 6, 64, 64]."""

    @property
    def gbuffer(self) -> Tensor:
        """Mask, albedo and normals, shape [B, 7, 64, 64]."""

    @property
    def noun(self) -> Tensor:
        """Index into ``NOUNS``, int64, shape [B]."""

    @property
    def setting(self) -> Tensor:
        """Index into ``SETTINGS``, shape [B]."""

    @property
    def weather(self) -> Tensor:
        """Index into ``WEATHERS``, shape [B]."""

    @property
    def kind(self) -> Tensor:
        """Index into ``KINDS``, shape [B]."""


Draw = Callable[[int, torch.Generator], Batch]
"""Returns that many composites on the generator's device. The generator's ``initial_seed`` differs
between commands and processes."""
Pair = tuple[Batch, Batch]
"""The same scenes lit consistently and wrongly: all but image and kind are equal."""


@dataclass(frozen=True)
class TrainSettings:
    """How the prior is trained; guidance.md 4.5 unless it says otherwise."""

    network: NetworkConfig = field(default_factory=NetworkConfig)
    batch: int = 256
    """Composites of a step, in each process."""
    micro: int = 0
    """Composites that go through the network at once; 0: all of them."""
    rate: float = 6e-4
    betas: tuple[float, float] = (0.9, 0.99)
    decay: float = 1e-3
    warmup_steps: int = 300
    resume_warmup_steps: int = 100
    constant_share: float = 0.55
    """Share of the planned time at the full rate; then it falls linearly."""
    final_rate: float = 0.02
    """Share of the rate that is left at the end."""
    clip: float = 1.0
    """Greatest norm of a step's gradient."""
    average: float = 0.9995
    """Decay of the moving average of the weights, which is what is shipped."""
    time_min: float = 0.03
    time_max: float = 0.9
    drop_condition: float = 0.1
    """Chance of each condition to be withheld."""
    drop_all: float = 0.15
    """Chance of all of them to be withheld."""
    mask_weight: float = 8.0
    """What a pixel of the object counts beside 1."""
    shadow_weight: float = 8.0
    """What a pixel that the object changes beside itself counts beside 1."""
    compile: bool = True
    """``torch.compile``, on CUDA."""
    log_every: int = 50
    validate_minutes: float = 2.0
    save_minutes: float = 3.0
    check_resume: bool = True
    """Refuse to go on when the validation loss is not the saved one."""
    resume_tolerance: float = 0.02
    """By what share it may differ."""
    step_limit: int = 0
    """Steps in all after which the training is complete, whatever the clock says; 0: no limit."""


class Objective(nn.Module):
    """The weighted loss of a network on composites, as one function to compile.

    Args:
        network: What is trained.
        settings: Weights of the pixels.
    """

    def __init__(self, network: EmbeddedNetwork, settings: TrainSettings) -> None:
        super().__init__()
        self.network, self.settings = network, settings

    def forward(
        self,
        image: Tensor,
        background: Tensor,
        gbuffer: Tensor,
        present: Tensor,
        ids: Tensor,
        timesteps: Tensor,
        noise: Tensor,
        alpha: Tensor,
        sigma: Tensor,
    ) -> Tensor:
        """Return the loss of each composite, float32, shape [B]; weights average to 1 over all."""
        a, s = alpha[:, None, None, None], sigma[:, None, None, None]
        latents = 2.0 * image - 1.0
        predicted = self.network(
            a * latents + s * noise,
            timesteps,
            self.network.embed(ids),
            background,
            gbuffer,
            present,
        )
        error = (predicted.float() - (a * noise - s * latents)).square()
        weight = pixel_weight(image, background[:, :3], gbuffer[:, :1], self.settings)
        losses: Tensor = (weight * error).mean(dim=(1, 2, 3))
        return losses


def pixel_weight(
    image: Tensor, background: Tensor, mask: Tensor, settings: TrainSettings
) -> Tensor:
    """Return what each pixel counts, shape [B, 1, H, W]; 1 on average.

    ``1 + 8 mask + 8 (1 - mask) min(2 |z - z_background|, 1)`` before it is normalised, with
    pictures z in [-1, 1]: a shadow is where the composite differs from the photo.
    """
    changed = 2.0 * (image - background).abs().mean(dim=1, keepdim=True)
    shadow = (2.0 * changed).clamp(max=1.0) * (1.0 - mask)
    weight = 1.0 + settings.mask_weight * mask + settings.shadow_weight * shadow
    return weight / weight.mean()


def schedule_on(device: torch.device) -> NoiseSchedule:
    """Return the prior's schedule with its table on a device, so that no step uploads it."""
    schedule = cosine_schedule()
    return NoiseSchedule(schedule.alphas_cumprod.to(device), schedule.prediction_type)


def autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Return the arithmetic of training: bf16 on CUDA, fp32 elsewhere."""
    return torch.autocast("cuda", torch.bfloat16) if device.type == "cuda" else nullcontext()
