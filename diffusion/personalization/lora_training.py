"""The training of one LoRA on a photo and class images; every step draws from the seed alone."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.draws import generator_of
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.lora_files import (
    Lora,
    install_lora,
    lora_parameters,
    put_weights,
    remove_lora,
)
from warpir.diffusion.prior import BAD_STEPS_MAX, BadSteps, NonFiniteError
from warpir.diffusion.settings import PersonalizeSettings

BETAS = (0.9, 0.999)
"""Of AdamW; as in diffusers' example of DreamBooth with a LoRA."""


class LoraTraining:
    """The adapter while it learns; the UNet's own weights stay as they are.

    A step is `prepare` (draws on the CPU, uploads into the same memory each time), `update` (all
    that the device does, without waiting for it; may be recorded as a CUDA graph) and `count_step`.
    Leaving the context takes the adapter away from the UNet.

    Args:
        prior: The model; arithmetic is bf16 on CUDA beside fp32 adapter weights.
        lora: Where to start.
        photo: Latents of crops of the photo, on the CPU, shape [crop, C, h, w].
        classes: Latents of class images, on the CPU, shape [N, C, h, w]; N may be 0.
        embeddings: Of the photo's and the class' prompts, shape [2, token, channel].
        settings: Rate, batch and weight.
        seed: The run's seed.
        key: What tells this training from all others; a resumed one has the same.
        name: The adapter's name.
    """

    def __init__(
        self,
        prior: StableDiffusion,
        lora: Lora,
        photo: Tensor,
        classes: Tensor,
        embeddings: Tensor,
        settings: PersonalizeSettings,
        seed: int,
        key: str = "",
        name: str = "scene",
    ) -> None:
        self.prior, self.photo, self.classes = prior, photo, classes
        self.settings, self.seed, self.key, self.name = settings, seed, key, name
        self.start = lora
        self.step_count = 0
        """Steps that were taken."""
        self.skipped = 0
        """Of these, those without a finite gradient, when `losses` was last called."""
        self.class_count = settings.lora_class_batch if len(classes) else 0
        self.part_count = 1
        """Parts that a step's samples are taken in; more need less memory."""

        install_lora(prior, lora, name)
        put_weights(prior, name, lora.weights, torch.float32)
        prior.unet.set_adapter(name)
        self.parameters = lora_parameters(prior, name)
        is_cuda = prior.device.type == "cuda"
        self.optimizer = torch.optim.AdamW(
            list(self.parameters.values()),
            lr=settings.lora_rate,
            betas=BETAS,
            weight_decay=settings.lora_decay,
            capturable=is_cuda,
            fused=is_cuda,
        )
        for parameter in self.parameters.values():
            parameter.requires_grad_(True)
            # What the first step would make: a graph needs its memory before.
            self.optimizer.state[parameter] = {
                "step": torch.zeros((), device=prior.device if is_cuda else None),
                "exp_avg": torch.zeros_like(parameter),
                "exp_avg_sq": torch.zeros_like(parameter),
            }

        count = 1 + self.class_count
        shape = (count, *photo.shape[1:])
        self.latents_noisy = torch.zeros(shape, device=prior.device)
        self.target = torch.zeros(shape, device=prior.device)
        self.timesteps = torch.zeros(count, dtype=torch.int64, device=prior.device)
        which = [0] + [1] * self.class_count
        self.embeddings = embeddings[which].to(prior.device)
        share = settings.lora_class_weight / max(self.class_count, 1)
        self.weights = torch.tensor([1.0] + [share] * self.class_count, device=prior.device)
        self.loss_pair = torch.zeros(2, device=prior.device)
        self._losses = torch.zeros(settings.lora_steps, 2, device=prior.device)
        self._weights: list[tuple[torch.nn.Parameter, Tensor]] = []

    def __enter__(self) -> LoraTraining:
        """Return the training; on CUDA the model's own weights are in bf16 until it ends."""
        if self.prior.device.type == "cuda":
            own = [w for w in self.prior.unet.parameters() if not w.requires_grad]
            self._weights = [(weight, weight.data) for weight in own]
            for weight in own:
                # What autocast would make of it in every step.
                weight.data = weight.data.bfloat16()
        return self

    def __exit__(self, *error: object) -> None:
        """Take the adapter away, with gradients and moments."""
        for weight, value in self._weights:
            weight.data = value
        self._weights.clear()
        self.optimizer.zero_grad(set_to_none=True)
        self.optimizer.state.clear()
        remove_lora(self.prior, self.name)

    def prepare(self, step: int) -> None:
        """Draw crop, class images, times and noises of a step, and hand them to the device."""
        random = generator_of(self.seed, "lora step", step)
        count = 1 + self.class_count
        chosen = self.photo[torch.randint(len(self.photo), (1,), generator=random)]
        t = torch.rand(count, generator=random)
        noise = torch.randn(count, *self.photo.shape[1:], generator=random)
        if self.class_count:
            drawn = torch.randint(len(self.classes), (self.class_count,), generator=random)
            chosen = torch.cat([chosen, self.classes[drawn]])
        schedule = self.prior.schedule
        for buffer, value in (
            (self.latents_noisy, schedule.add_noise(chosen, noise, t)),
            (self.target, schedule.target(chosen, noise, t)),
            (self.timesteps, schedule.timestep(t)),
        ):
            # Pinned memory is not used again before the copy is done, so nothing has to wait.
            pinned = value.pin_memory() if buffer.is_cuda else value
            buffer.copy_(pinned, non_blocking=True)

    def update(self) -> None:
        """Take one step on what `prepare` uploaded; writes `loss_pair`, waits on the CPU only.

        Without a finite gradient nothing changes, and the loss is not a number.
        """
        self.optimizer.zero_grad(set_to_none=True)
        errors = []
        count = len(self.timesteps)
        borders = [k * count // self.part_count for k in range(self.part_count + 1)]
        for these in (slice(*pair) for pair in pairwise(borders)):
            with self._arithmetic():
                predicted = self.prior.denoise(
                    self.latents_noisy[these], self.timesteps[these], self.embeddings[these]
                )
            error = (predicted.float() - self.target[these]).square().mean(dim=(1, 2, 3))
            torch.autograd.backward((self.weights[these] * error).sum())
            errors.append(error.detach())
        each = torch.cat(errors)
        clip = self.settings.lora_clip
        norm = torch.nn.utils.clip_grad_norm_(self.parameters.values(), clip)
        self._step_where_finite(norm)
        loss_class = each[1:].mean() if self.class_count else torch.zeros_like(each[0])
        losses = torch.stack([each[0], loss_class])
        self.loss_pair.copy_(torch.where(norm.isfinite(), losses, torch.nan))

    def _step_where_finite(self, norm: Tensor) -> None:
        if norm.is_cuda:
            # The fused optimiser looks at this on the device, as it does for gradient scalers.
            self.optimizer.found_inf = (~norm.isfinite()).float()  # type: ignore[attr-defined]
            self.optimizer.step()
        elif bool(norm.isfinite()):
            self.optimizer.step()

    def count_step(self) -> None:
        """Keep the losses of a step that was taken, and go on to the next."""
        self._losses[self.step_count] = self.loss_pair
        self.step_count += 1

    def lora(self) -> Lora:
        """Return the adapter as it is now."""
        weights = {key: _to_cpu(parameter) for key, parameter in self.parameters.items()}
        return Lora(weights, self.start.alphas, self.start.targets)

    def losses(self) -> Tensor:
        """Return the photo's and the class images' losses by step, shape [step_count, 2].

        Those of steps that were skipped are not a number; they are counted in `skipped`.

        Raises:
            NonFiniteError: `BAD_STEPS_MAX` in a row were.
        """
        losses = _to_cpu(self._losses[: self.step_count])
        counter = BadSteps()
        for step, is_finite in enumerate(losses.isfinite().all(dim=1).tolist()):
            if counter.count_step(is_finite):
                first = step + 2 - BAD_STEPS_MAX
                raise NonFiniteError(
                    f"the LoRA's loss is not finite from step {first} on (try a lower --lora-rate)"
                )
        self.skipped = counter.skipped
        return losses

    def state_dict(self) -> dict[str, Any]:
        """Return what a later run needs to go on: tensors on the CPU and plain values."""
        state: dict[str, Any] = {"key": self.key, "step": self.step_count, "losses": self.losses()}
        for key, parameter in self.parameters.items():
            state[f"lora.{key}"] = _to_cpu(parameter)
            # The optimiser's own count too: it leaves out the steps that were skipped.
            for name in ("step", "exp_avg", "exp_avg_sq"):
                state[f"{name}.{key}"] = _to_cpu(self.optimizer.state[parameter][name])
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`; everything stays in the same memory.

        Raises:
            ModelError: It is another training's.
        """
        if state.get("key") != self.key:
            raise ModelError(
                "checkpoint",
                "belongs to another personalisation (model, photo, prompts, settings or seed)",
                "start the run anew",
            )
        self.step_count = int(state["step"])
        with torch.no_grad():
            self._losses[: self.step_count].copy_(state["losses"])
            for key, parameter in self.parameters.items():
                parameter.copy_(state[f"lora.{key}"])
                held = self.optimizer.state[parameter]
                for name in ("step", "exp_avg", "exp_avg_sq"):
                    held[name].copy_(state[f"{name}.{key}"])

    def _arithmetic(self) -> AbstractContextManager[Any]:
        if self.prior.device.type != "cuda":
            return nullcontext()
        # Without the cache of cast weights, which a CUDA graph could not hold on to.
        return torch.autocast("cuda", torch.bfloat16, cache_enabled=False)


def _to_cpu(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", copy=True)
