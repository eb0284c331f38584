"""Personalisation: a LoRA learns the photo while class images keep the concept.

    min over A, B of  E[ |f(z_t, t, "a scene in the style of sks rendering") - target|^2 ]  photo
              + weight E[ |f(z_t, t, "a photo of a car") - target|^2 ]               class images

with the UNet f + A B (DiPIR, Liang et al. 2024, section 4.2.1 and eq. 1). The photo counts by crops
of it that are never turned over or recoloured: a flip would move the sun, and another colour would
teach another exposure. Everything random is a function of the seed and the step, drawn on the CPU.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from warpir.core.atomic import write_file
from warpir.core.cache import find_kept, seal
from warpir.diffusion.cache import content_key, model_key
from warpir.diffusion.crop import Crop
from warpir.diffusion.draws import generator_of
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.tensor_files import serialize
from warpir.diffusion.personalization.class_images import (
    Report,
    class_image_count,
    encode_pictures,
    make_class_images,
)
from warpir.diffusion.personalization.lora_files import (
    Lora,
    initial_lora,
    install_lora,
    load_lora,
    lora_parameters,
    put_weights,
    remove_lora,
)
from warpir.diffusion.prior import BAD_STEPS_MAX, NonFiniteError
from warpir.diffusion.prompts import Prompts
from warpir.diffusion.settings import PersonalizeSettings

if TYPE_CHECKING:
    from warpir.diffusion.models.network_prior import NetworkPrior

FORMAT = 1
"""Meaning of a stored LoRA; part of every key."""
CROP_COUNT = 64
"""Crops of the photo that are encoded once and drawn from."""
LOOK_EVERY = 50
"""Steps between two looks at the losses: each makes the host wait for the device."""
ENCODE_BATCH = 4
EVALUATION_COUNT = 16
"""Fixed draws of time, noise and crop by which a LoRA is judged."""
BETAS = (0.9, 0.999)
"""Of AdamW; as in diffusers' example of DreamBooth with a LoRA."""


@dataclass(frozen=True)
class Personalization:
    """A trained or loaded adapter, and how it came about."""

    adapter: str
    """Its name in the prior."""
    lora: Lora
    """The adapter as it was trained, float32, to be written by `save_lora`."""
    losses: Tensor
    """Mean squared error on the photo and on the class images by step, shape [steps, 2]; 0 where
    there are no class images; empty when a file was loaded."""
    evaluation: tuple[float, float] | None
    """Mean squared error of the noise on fixed draws from the photo, without and with the adapter;
    None when a file was loaded."""
    class_prompts: tuple[str, ...]
    seconds: dict[str, float]
    """Time by stage [s]."""
    is_reused: bool
    """Whether nothing was trained now."""
    notices: tuple[str, ...]
    """What the user is told about."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a later run needs to go on with this adapter: tensors and plain values."""
        return {
            "adapter": self.adapter,
            "weights": self.lora.weights,
            "alphas": self.lora.alphas,
            "targets": self.lora.targets,
            "losses": self.losses,
            "evaluation": self.evaluation,
            "class_prompts": self.class_prompts,
            "notices": self.notices,
        }


def restore_personalization(prior: NetworkPrior, state: Mapping[str, Any]) -> Personalization:
    """Adapt the prior as `Personalization.state_dict` says; neither a file nor a cache is asked.

    Raises:
        ModelError: The adapter belongs to another model.
    """
    lora = Lora(dict(state["weights"]), dict(state["alphas"]), tuple(state["targets"]))
    errors = state["evaluation"]
    install_lora(prior, lora, state["adapter"], "checkpoint")
    return Personalization(
        state["adapter"],
        lora,
        state["losses"],
        errors and (errors[0], errors[1]),
        tuple(state["class_prompts"]),
        {},
        True,
        tuple(state["notices"]),
    )


def personalize(
    prior: NetworkPrior,
    photo: Tensor,
    prompts: Prompts,
    settings: PersonalizeSettings,
    seed: int,
    cache: Path | None,
    *,
    name: str = "scene",
    report: Report | None = None,
    on_step: Callable[[LoraTraining], None] | None = None,
    resume: Mapping[str, Any] | None = None,
    record: Callable[[LoraTraining], Callable[[], None]] | None = None,
) -> Personalization:
    """Adapt the prior to a photo, or find the adapter of an earlier run on the same photo.

    Afterwards the adapter is frozen, has the UNet's precision, and is among ``prior.adapters``.

    Args:
        prior: The model; its text encoder is needed unless the prompts were embedded.
        photo: Display-encoded, in [0, 1], shape [1, 3, H, W].
        prompts: From `make_prompts`.
        settings: All of them count; ``settings.lora`` is loaded in place of training.
        seed: The run's seed.
        cache: Folder that keeps class images and LoRAs (`cache_folder`), or None to keep none.
        name: The adapter's name; one of that name is replaced.
        report: Is told a stage, the steps done and the steps in all; may stop the run, and no
            step or class image that it was told of is lost.
        on_step: Sees the training after each step and before the report, to keep its `state_dict`.
        resume: `LoraTraining.state_dict` of a run that was stopped.
        record: Given the training, returns what replaces its `update`; by default a CUDA graph,
            where the prior has them.

    Raises:
        ModelError: The LoRA cannot be loaded, or ``resume`` is another training's.
        NonFiniteError: The model's numbers are not finite in fp32 either, or stay so in training.
        ValueError: The photo or a setting has a value that makes no sense.
    """
    _check(photo, settings)
    if settings.lora is not None:
        lora = load_lora(prior, settings.lora, name)
        return Personalization(name, lora, torch.zeros(0, 2), None, (), {}, True, ())
    key = lora_key(prior, photo, prompts, settings, seed)
    stored = cache / "lora" / f"{key}.safetensors" if cache else None
    notices: list[str] = []
    found = _read_stored(stored, name, settings) if stored else None
    if found is not None:
        install_lora(prior, found.lora, name, str(stored))
        return found

    clock = _Clock(prior.device)
    embeddings = prior.embed([prompts.photo, prompts.class_])
    class_images = make_class_images(
        prior, prompts, settings, seed, cache / "class-images" if cache else None, report
    )
    clock.stop("class images")
    crops = photo_latents(prior, photo, settings, seed)
    kept = crops[:0]
    if len(class_images.images):
        kept = encode_pictures(prior, class_images.images, ENCODE_BATCH, report)
    clock.stop("encoding")
    before = evaluate(prior, crops, embeddings[:1], seed, None)
    lora = initial_lora(prior, settings.lora_layers, settings.lora_rank, seed)
    clock.stop("evaluation")

    with LoraTraining(prior, lora, crops, kept, embeddings, settings, seed, key, name) as training:
        if resume is not None:
            training.load_state_dict(resume)
        update: Callable[[], None] = training.update

        def spare() -> None:
            nonlocal update
            prior.spare_memory()
            training.part_count, update = len(training.timesteps), training.update

        if record:
            update = record(training)
        elif prior.graphs is not None:
            update = prior.graphs.recorded_step(training.update)
        while training.step_count < settings.lora_steps:
            training.prepare(training.step_count)
            flags = "--lora-class-batch or --lora-rank"
            for _ in prior.in_chunks(lambda *_: update(), 1, "a step of the LoRA", flags, spare):
                training.count_step()
            if training.step_count % LOOK_EVERY == 0:
                training.losses()
            if on_step:
                on_step(training)
            if report:
                report("LoRA", training.step_count, settings.lora_steps)
        lora, losses = training.lora(), training.losses()
        skipped = training.skipped()
    install_lora(prior, lora, name)
    clock.stop("training")
    after = evaluate(prior, crops, embeddings[:1], seed, name)
    clock.stop("evaluation")

    notices += class_images.notices
    if skipped:
        notices.append(f"{skipped} steps of the LoRA had no finite gradient and were skipped")
    if settings.lora_steps and not after < before:
        notices.append(
            f"the model came no closer to the photo: its error on fixed draws was {before:.4g} and "
            f"is {after:.4g}; try more --lora-steps or another --lora-rank"
        )
    texts, errors = class_images.prompts, (before, after)
    if stored is not None:
        _store(stored, lora, losses, errors, texts, notices)
    return Personalization(name, lora, losses, errors, texts, clock.seconds, False, tuple(notices))


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
        prior: NetworkPrior,
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

        Those of steps that were skipped are not a number.

        Raises:
            NonFiniteError: `BAD_STEPS_MAX` in a row were.
        """
        losses = _to_cpu(self._losses[: self.step_count])
        in_a_row = 0
        for step, is_finite in enumerate(losses.isfinite().all(dim=1).tolist()):
            in_a_row = 0 if is_finite else in_a_row + 1
            if in_a_row == BAD_STEPS_MAX:
                first = step + 2 - BAD_STEPS_MAX
                raise NonFiniteError(
                    f"the LoRA's loss is not finite from step {first} on (try a lower --lora-rate)"
                )
        return losses

    def skipped(self) -> int:
        """Return how many steps had no finite gradient."""
        return int((~self.losses().isfinite().all(dim=1)).sum())

    def state_dict(self) -> dict[str, Any]:
        """Return what a later run needs to go on: tensors on the CPU and plain values."""
        state: dict[str, Any] = {"key": self.key, "step": self.step_count, "losses": self.losses()}
        for key, parameter in self.parameters.items():
            state[f"lora.{key}"] = _to_cpu(parameter)
            for moment in ("exp_avg", "exp_avg_sq"):
                state[f"{moment}.{key}"] = _to_cpu(self.optimizer.state[parameter][moment])
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
                held["step"].fill_(self.step_count)
                for moment in ("exp_avg", "exp_avg_sq"):
                    held[moment].copy_(state[f"{moment}.{key}"])

    def _arithmetic(self) -> AbstractContextManager[Any]:
        if self.prior.device.type != "cuda":
            return nullcontext()
        # Without the cache of cast weights, which a CUDA graph could not hold on to.
        return torch.autocast("cuda", torch.bfloat16, cache_enabled=False)


def _to_cpu(tensor: Tensor) -> Tensor:
    return tensor.detach().to("cpu", copy=True)


def photo_crops(size: tuple[int, int], settings: PersonalizeSettings, seed: int) -> list[Crop]:
    """Return the crops of the photo that are learnt: squares anywhere, of slightly varied size.

    Args:
        size: Height and width of the photo [px].
        settings: Smallest side as a share of the shorter side.
        seed: The run's seed.
    """
    height, width = size
    draws = torch.rand(
        CROP_COUNT, 3, dtype=torch.float64, generator=generator_of(seed, "photo crops")
    )
    crops = []
    for u_side, u_x, u_y in draws.tolist():
        side = min(size) * (settings.lora_crop + (1.0 - settings.lora_crop) * u_side)
        crops.append(Crop(u_x * (width - side), u_y * (height - side), side))
    return crops


def photo_latents(
    prior: NetworkPrior, photo: Tensor, settings: PersonalizeSettings, seed: int
) -> Tensor:
    """Return the latents of `photo_crops`, float32 on the CPU, shape [crop, C, h, w]."""
    height, width = photo.shape[-2:]
    crops = photo_crops((height, width), settings, seed)
    photo = photo.to(prior.device)
    latents = []
    with torch.no_grad():
        for start in range(0, len(crops), ENCODE_BATCH):
            batch = [c.apply(photo, prior.resolution) for c in crops[start : start + ENCODE_BATCH]]
            encode = partial(prior.encode, torch.cat(batch))
            latents.append(prior.finite(encode, "latents").cpu())
    return torch.cat(latents)


def evaluate(
    prior: NetworkPrior, crops: Tensor, embedding: Tensor, seed: int, adapter: str | None
) -> float:
    """Return the mean squared error of the noise on fixed draws from the photo.

    Times are spread evenly, so that the few draws stand for all.

    Args:
        prior: The model, as guidance will use it.
        crops: Latents of the photo's crops, shape [crop, C, h, w].
        embedding: Of the photo's prompt, shape [1, token, channel].
        seed: The run's seed.
        adapter: Its name, or None for the base weights.

    Raises:
        NonFiniteError: The noise is not finite.
    """
    random = generator_of(seed, "evaluation")
    shares = torch.arange(EVALUATION_COUNT) + torch.rand(EVALUATION_COUNT, generator=random)
    t = shares / EVALUATION_COUNT
    drawn = crops[torch.randint(len(crops), (EVALUATION_COUNT,), generator=random)]
    noise = torch.randn(drawn.shape, generator=random)
    noisy = prior.schedule.add_noise(drawn, noise, t)
    errors = []
    for start in range(0, EVALUATION_COUNT, ENCODE_BATCH):
        part = slice(start, start + ENCODE_BATCH)
        count = len(t[part])
        prompts = embedding.expand(count, -1, -1)
        predict = partial(prior.predict, noisy[part], t[part], prompts, [adapter] * count)
        predicted = prior.finite(predict, "predictions")
        errors.append((predicted.cpu() - noise[part]).square().mean(dim=(1, 2, 3)))
    return float(torch.cat(errors).mean())


def lora_key(
    prior: NetworkPrior,
    photo: Tensor,
    prompts: Prompts,
    settings: PersonalizeSettings,
    seed: int,
) -> str:
    """Return a hash of all that a trained LoRA depends on."""
    # The caller's settings may hold more, such as where results are written.
    own = (field.name for field in fields(PersonalizeSettings))
    chosen = [(name, getattr(settings, name)) for name in sorted(own)]
    return content_key(
        FORMAT, model_key(prior), photo.float(), sorted(asdict(prompts).items()), chosen, seed
    )


# What is kept between runs


def _store(
    path: Path,
    lora: Lora,
    losses: Tensor,
    errors: tuple[float, float],
    class_prompts: tuple[str, ...],
    notices: list[str],
) -> None:
    """Keep a trained LoRA; where that fails, the run still ends as it would have."""
    header = {"errors": errors, "class_prompts": class_prompts, "notices": notices}
    try:
        content = serialize({**lora.weights, "losses": losses}, {"record": json.dumps(header)})
        write_file(path, content)
        seal(path, "*.safetensors.*")
    except OSError as error:
        notices.append(f"{path}: the LoRA is not kept ({error})")


def _read_stored(path: Path, name: str, settings: PersonalizeSettings) -> Personalization | None:
    """Return a LoRA that an earlier run kept, or None when there is none that is whole."""
    from safetensors import safe_open

    kept = find_kept(path)
    if kept is None:
        return None
    with safe_open(kept, framework="pt", device="cpu") as file:
        header = json.loads(file.metadata()["record"])
        tensors = {key: file.get_tensor(key) for key in file.keys()}
    losses = tensors.pop("losses")
    before, after = header["errors"]
    texts, told = tuple(header["class_prompts"]), tuple(header["notices"])
    layers = sorted({key.rsplit(".lora_", 1)[0] for key in tensors})
    lora = Lora(tensors, dict.fromkeys(layers, float(settings.lora_rank)), settings.lora_layers)
    return Personalization(name, lora, losses, (before, after), texts, {}, True, told)


class _Clock:
    """Adds up the time of stages, device included."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.last = device, time.perf_counter()
        self.seconds: dict[str, float] = {}

    def stop(self, stage: str) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self.last
        self.last = now


def _check(photo: Tensor, settings: PersonalizeSettings) -> None:
    """Raise a ValueError for what makes no sense."""
    if photo.ndim != 4 or photo.shape[:2] != (1, 3):
        raise ValueError(f"photo: shape {tuple(photo.shape)} (expected [1, 3, H, W])")
    if not bool(torch.isfinite(photo).all()) or photo.min() < 0.0 or photo.max() > 1.0:
        raise ValueError("photo: values outside [0, 1]")
    if not 0.0 < settings.lora_crop <= 1.0:
        raise ValueError(f"lora_crop: {settings.lora_crop} (expected above 0, at most 1)")
    for name, least in (
        ("lora_steps", 0), ("lora_class_batch", 0), ("class_batch", 1), ("class_steps", 1),
    ):  # fmt: skip
        if getattr(settings, name) < least:
            raise ValueError(f"{name}: {getattr(settings, name)} (expected at least {least})")
    if class_image_count(settings) < 0:
        raise ValueError(f"class_images: {settings.class_images} (expected at least 0)")
