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
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from warpir.core.atomic import write_file
from warpir.core.cache import find_kept, seal
from warpir.diffusion.cache import content_key, model_key
from warpir.diffusion.crop import Crop
from warpir.diffusion.draws import generator_of
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.models.tensor_files import read_safetensors, serialize
from warpir.diffusion.personalization.class_images import (
    ClassImages,
    Report,
    encode_pictures,
    make_class_images,
)
from warpir.diffusion.personalization.lora_files import (
    Lora,
    initial_lora,
    install_lora,
    load_lora,
)
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.prompts import Prompts
from warpir.diffusion.settings import PersonalizeSettings

FORMAT = 1
"""Meaning of a stored LoRA; part of every key."""
CROP_COUNT = 64
"""Crops of the photo that are encoded once and drawn from."""
LOOK_EVERY = 50
"""Steps between two looks at the losses: each makes the host wait for the device."""
ENCODE_BATCH = 4
EVALUATION_COUNT = 16
"""Fixed draws of time, noise and crop by which a LoRA is judged."""


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
    class_prompts: tuple[str, ...] = ()
    notices: tuple[str, ...] = ()
    """What the user is told about."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Time by stage [s]."""
    is_reused: bool = True
    """Whether nothing was trained now."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a later run needs to go on with this adapter: tensors and plain values."""
        return {
            "adapter": self.adapter,
            **vars(self.lora),
            "losses": self.losses,
            "evaluation": self.evaluation,
            "class_prompts": self.class_prompts,
            "notices": self.notices,
        }


def restore_personalization(prior: StableDiffusion, state: Mapping[str, Any]) -> Personalization:
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
        tuple(state["notices"]),
    )


def personalize(
    prior: StableDiffusion,
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

    Raises:
        ModelError: The LoRA cannot be loaded, or ``resume`` is another training's.
        NonFiniteError: The model's numbers are not finite in fp32 either, or stay so in training.
        ValueError: The photo has another shape or range.
    """
    _check(photo)
    if settings.lora is not None:
        lora = load_lora(prior, settings.lora, name)
        return Personalization(name, lora, torch.zeros(0, 2), None)
    key = lora_key(prior, photo, prompts, settings, seed)
    stored = cache / "lora" / f"{key}.safetensors" if cache else None
    if stored is not None and (found := _read_stored(stored, name, settings)) is not None:
        install_lora(prior, found.lora, name, stored)
        return found
    clock = _Clock(prior.device)
    embeddings = prior.embed([prompts.photo, prompts.class_])
    folder = cache / "class-images" if cache else None
    class_images = make_class_images(prior, prompts, settings, seed, folder, report)
    clock.stop("class images")
    crops = photo_latents(prior, photo, settings, seed)
    kept = encode_pictures(prior, class_images.images, ENCODE_BATCH, report)
    clock.stop("encoding")
    before = evaluate(prior, crops, embeddings[:1], seed, None)
    lora = initial_lora(prior, settings.lora_layers, settings.lora_rank, seed)
    clock.stop("evaluation")
    training = LoraTraining(prior, lora, crops, kept, embeddings, settings, seed, key, name)
    return _learn(training, before, class_images, stored, clock, report, on_step, resume)


def _learn(
    training: LoraTraining,
    before: float,
    class_images: ClassImages,
    stored: Path | None,
    clock: _Clock,
    report: Report | None,
    on_step: Callable[[LoraTraining], None] | None,
    resume: Mapping[str, Any] | None,
) -> Personalization:
    """Train an adapter, put it to use, judge it, and keep it where ``stored`` says, if it does.

    The training has not begun; ``before`` is `evaluate` without the adapter, ``clock`` adds up the
    time of stages. The others, and the errors, are as of `personalize`.
    """
    prior, settings, name = training.prior, training.settings, training.name
    embedding = training.embeddings[:1]
    with training:
        if resume is not None:
            training.load_state_dict(resume)
        _train(training, report, on_step)
        lora, losses = training.lora(), training.losses()
    install_lora(prior, lora, name)
    clock.stop("training")
    after = evaluate(prior, training.photo, embedding, training.seed, name)
    clock.stop("evaluation")

    notices = list(class_images.notices)
    if skipped := training.skipped:
        notices.append(f"{skipped} steps of the LoRA had no finite gradient and were skipped")
    if settings.lora_steps and not after < before:
        notices.append(
            f"the model came no closer to the photo: its error on fixed draws was {before:.4g} and "
            f"is {after:.4g}; try more --lora-steps or another --lora-rank"
        )
    learnt = Personalization(
        name,
        lora,
        losses,
        (before, after),
        class_images.prompts,
        tuple(notices),
        clock.seconds,
        is_reused=False,
    )
    if stored is None:
        return learnt
    return replace(learnt, notices=(*learnt.notices, *_store(stored, learnt)))


def _train(
    training: LoraTraining,
    report: Report | None,
    on_step: Callable[[LoraTraining], None] | None,
) -> None:
    """Take the steps that are left; arguments and errors as in `personalize`."""
    prior, step_count = training.prior, training.settings.lora_steps
    update: Callable[[], None] = training.update

    def spare() -> None:
        nonlocal update
        prior.spare_memory()
        training.part_count, update = len(training.timesteps), training.update

    if prior.graphs is not None:
        update = prior.graphs.recorded_step(training.update)
    while training.step_count < step_count:
        training.prepare(training.step_count)
        flags = "--lora-class-batch or --lora-rank"
        for _ in prior.in_chunks(lambda *_: update(), 1, "a step of the LoRA", flags, spare):
            training.count_step()
        if training.step_count % LOOK_EVERY == 0:
            training.losses()
        if on_step:
            on_step(training)
        if report:
            report("LoRA", training.step_count, step_count)


def photo_crops(size: tuple[int, int], settings: PersonalizeSettings, seed: int) -> list[Crop]:
    """Return the crops of the photo that are learnt: squares anywhere, of slightly varied size.

    The photo's size is height and width [px]; the settings have a crop's smallest side as a share
    of the shorter.
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
    prior: StableDiffusion, photo: Tensor, settings: PersonalizeSettings, seed: int
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
    prior: StableDiffusion, crops: Tensor, embedding: Tensor, seed: int, adapter: str | None
) -> float:
    """Return the mean squared error of the noise on fixed draws from the photo.

    Times are spread evenly, so that the few draws stand for all. Crops are latents, shape
    [crop, C, h, w], the embedding is that of the photo's prompt, shape [1, token, channel]. Without
    an adapter the base weights are used.

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
    prior: StableDiffusion,
    photo: Tensor,
    prompts: Prompts,
    settings: PersonalizeSettings,
    seed: int,
) -> str:
    """Return a hash of all that a trained LoRA depends on."""
    # The caller's settings may hold more, such as where results are written.
    own = sorted(each.name for each in fields(PersonalizeSettings))
    chosen = [(name, getattr(settings, name)) for name in own]
    return content_key(
        FORMAT, model_key(prior), photo.float(), sorted(asdict(prompts).items()), chosen, seed
    )


# What is kept between runs


def _store(path: Path, learnt: Personalization) -> tuple[str, ...]:
    """Keep a trained LoRA; return a notice where that fails: the run ends as it would have."""
    header = {
        "errors": learnt.evaluation,
        "class_prompts": learnt.class_prompts,
        "notices": learnt.notices,
    }
    tensors = {**learnt.lora.weights, "losses": learnt.losses}
    try:
        content = serialize(tensors, {"record": json.dumps(header)})
        write_file(path, content)
        seal(path, "*.safetensors.*")
    except OSError as error:
        return (f"{path}: the LoRA is not kept ({error})",)
    return ()


def _read_stored(path: Path, name: str, settings: PersonalizeSettings) -> Personalization | None:
    """Return a LoRA that an earlier run kept, or None when there is none that is whole."""
    kept = find_kept(path)
    if kept is None:
        return None
    tensors, about = read_safetensors(kept)
    header = json.loads(about["record"])
    losses = tensors.pop("losses")
    before, after = header["errors"]
    texts, told = tuple(header["class_prompts"]), tuple(header["notices"])
    layers = sorted({key.rsplit(".lora_", 1)[0] for key in tensors})
    lora = Lora(tensors, dict.fromkeys(layers, float(settings.lora_rank)), settings.lora_layers)
    return Personalization(name, lora, losses, (before, after), texts, told)


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


def _check(photo: Tensor) -> None:
    """Raise a ValueError for a photo of another shape or range."""
    if photo.ndim != 4 or photo.shape[:2] != (1, 3):
        raise ValueError(f"photo: shape {tuple(photo.shape)} (expected [1, 3, H, W])")
    if not bool(torch.isfinite(photo).all()) or photo.min() < 0.0 or photo.max() > 1.0:
        raise ValueError("photo: values outside [0, 1]")
