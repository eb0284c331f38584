"""Training of the embedded prior: in many short runs, on scenes that are new each time.

    min  E[ weight |f(z_t, t, prompt, conditions) - v|^2 ],   v = a noise - s z

over composites, right and wrong, with words and conditions left out at random. Object and shadow
are few pixels of a picture, and count more. The loop stops by the clock and keeps what the next
run needs in files that can travel: weights and their moving average in fp16, in shards; Adam starts
anew, with a short warm-up. Several GPUs (``torchrun``) share the gradient, each with scenes of its
own.

Nothing here knows where pictures come from: whoever trains gives a function that draws a batch.
"""

from __future__ import annotations

import copy
import json
import logging
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Protocol

import torch
import torch.distributed as dist
from torch import Tensor, nn

from warpir.core.atomic import write_file, write_folder
from warpir.diffusion.draws import seed_of
from warpir.diffusion.models.embedded import (
    CONDITIONS,
    EmbeddedNetwork,
    NetworkConfig,
    build_network,
    config_of,
    cosine_schedule,
    network_of,
    save_embedded,
)
from warpir.diffusion.models.embedded_words import training_tokens
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.network_prior import no_tf32
from warpir.diffusion.models.tensor_files import read_safetensors, serialize
from warpir.diffusion.schedule import NoiseSchedule

FORMAT = 1
HEADER_KEY = "warpir_prior_training"
"""Where a checkpoint's files say what they are."""
SHARD_BYTES = 15 << 20
"""Most that one of a checkpoint's files holds."""
CURVE = "curve.jsonl"
SIGMA_EDGES = (0.0, 0.3, 0.6, 0.85, 1.0)
"""Ranges of the noise level for which validation is reported."""
PEER_CHECK_EVERY = 10
"""Steps between two looks of other processes at the first one's clock."""

log = logging.getLogger(__name__)


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
    save_fp32: bool = False
    """Keep the raw weights of a checkpoint in fp32, in files twice as large."""
    check_resume: bool = True
    """Refuse to go on when the validation loss is not the saved one."""
    resume_tolerance: float = 0.02
    """By what share it may differ."""
    step_limit: int = 0
    """Steps in all after which the training is complete, whatever the clock says; 0: no limit."""


@dataclass
class Progress:
    """How far a training is, over all of its runs."""

    step: int = 0
    samples: int = 0
    """Of all processes."""
    seconds: float = 0.0
    runs: int = 0
    validation: dict[str, Any] = field(default_factory=dict)
    """The latest."""
    curve: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Worker:
    """Which of the processes of a training this is (``torchrun`` sets the variables)."""

    rank: int
    local_rank: int
    count: int

    @classmethod
    def this(cls) -> Worker:
        """Return this process' place; alone it is the first of one."""
        rank, local, count = (
            int(os.environ.get(name, default))
            for name, default in (("RANK", "0"), ("LOCAL_RANK", "0"), ("WORLD_SIZE", "1"))
        )
        return cls(rank, local, count)

    def device(self, kind: str) -> torch.device:
        """Return the device of this process: ``cpu``, or the GPU of its own."""
        return torch.device(kind, self.local_rank) if kind == "cuda" else torch.device(kind)


def train_prior(
    batches: Draw,
    out: Path,
    settings: TrainSettings,
    device: torch.device | str,
    minutes: float,
    total_minutes: float,
    *,
    resume: bool = False,
    seed: int = 0,
    validation: Mapping[str, Sequence[Batch]] | None = None,
    pairs: Mapping[str, Sequence[Pair]] | None = None,
    network: EmbeddedNetwork | None = None,
    say: Callable[[str], None] = log.info,
) -> Progress:
    """Train until the clock or the plan ends it; ``out`` then holds a checkpoint and the curve.

    Args:
        batches: Draws what is learnt from, fresh in each step.
        out: Folder of the checkpoint (files below 16 MiB) and of `CURVE`.
        settings: How.
        device: Where; with several processes the one of this process, see `Worker.device`.
        minutes: Of this run, from now, all included.
        total_minutes: Of all runs together; the rate follows the share that is used.
        resume: Go on from the checkpoint in ``out``.
        seed: Of weights and draws; each run draws new ones.
        validation: Fixed batches by the name of their set, on the device.
        pairs: Fixed pairs by the name of their set, on the device.
        network: What a new training starts from; default: random weights.
        say: Is told how it goes.

    Returns:
        How far it came.

    Raises:
        ModelError: There is nothing to resume, or something that would be overwritten; the
            checkpoint is damaged, another network's, or does not reproduce its validation loss;
            or the loss is no longer finite (the last checkpoint is from before).
    """
    start = time.monotonic()
    device, worker = torch.device(device), Worker.this()
    with _process_group(worker, device):
        training = _Training(settings, device, worker, out, resume, seed, network, say)
        judge = Validation(settings, device, validation or {}, pairs or {})
        training.run(batches, judge, start, 60.0 * minutes, 60.0 * total_minutes)
    return training.progress


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


class _Training:
    """Network, average, optimiser and progress of one process."""

    def __init__(
        self,
        settings: TrainSettings,
        device: torch.device,
        worker: Worker,
        out: Path,
        resume: bool,
        seed: int,
        start: EmbeddedNetwork | None,
        say: Callable[[str], None],
    ) -> None:
        self.settings, self.device, self.worker, self.out = settings, device, worker, out
        self.seed, self.say = seed, say if worker.rank == 0 else lambda text: None
        is_cuda = device.type == "cuda"
        if resume:
            held = read_checkpoint(out)
            if held.network.config != settings.network:
                what = f"another network ({held.network.config}; expected {settings.network})"
                raise ModelError(str(out), what, "resume with the settings of its start")
            network, average, self.progress = held.network, held.average, held.progress
        else:
            if checkpoints_in(out):
                advice = "resume it, or give another folder"
                raise ModelError(str(out), "holds a training that was begun", advice)
            network = start or build_network(settings.network, seed)
            average, self.progress = copy.deepcopy(network), Progress()
        self.progress.runs += 1
        self.first_step = self.progress.step
        is_new = not resume and start is None
        self.warmup_steps = settings.warmup_steps if is_new else settings.resume_warmup_steps
        self.network = network.to(device).train()
        self.average = average.to(device).requires_grad_(False).eval()
        if is_cuda:
            for each in (self.network, self.average):
                each.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.parameters: list[Tensor] = list(self.network.parameters())
        self.averages: list[Tensor] = list(self.average.parameters())
        objective: Any = Objective(self.network, settings)
        self.objective = torch.compile(objective) if settings.compile and is_cuda else objective
        self.optimizer = torch.optim.AdamW(
            self.parameters,
            lr=settings.rate,
            betas=settings.betas,
            weight_decay=settings.decay,
            fused=is_cuda,
        )
        self.schedule = schedule_on(device)
        key = "train", worker.rank, self.first_step
        self.draws = torch.Generator(device).manual_seed(seed_of(seed, "draws", *key))
        self.scenes = torch.Generator(device).manual_seed(seed_of(seed, "scenes", *key))

    def run(
        self, batches: Draw, judge: Validation, start: float, seconds: float, total: float
    ) -> None:
        """Train, log, validate and save until the time is over."""
        s, progress, earlier = self.settings, self.progress, self.progress.seconds
        is_first = self.worker.rank == 0
        reserve = self._judge_at_start(judge) if is_first else 0.0
        validated = saved = logged = time.monotonic()
        logged_step, losses = progress.step, torch.zeros((), device=self.device)
        while True:
            now = time.monotonic()
            progress.seconds = earlier + now - start
            share = progress.seconds / total
            if s.step_limit:
                share = max(share, progress.step / s.step_limit)
            if s.step_limit and progress.step >= s.step_limit:
                break
            if self._is_over(share >= 1.0 or now - start >= seconds - reserve):
                break
            rate = self._rate(share)
            losses += self._step(batches(s.batch, self.scenes), rate)
            progress.step += 1
            progress.samples += s.batch * self.worker.count
            if progress.step % s.log_every == 0:
                # The only place that waits for the device.
                count = progress.step - logged_step
                loss = float(losses) / count
                self._check_finite(loss)
                now = time.monotonic()
                speed = s.batch * self.worker.count * count / (now - logged)
                self._log(loss=loss, rate=rate, samples_per_second=speed)
                logged, logged_step = now, progress.step
                losses.zero_()
                if is_first and now - validated > 60.0 * s.validate_minutes:
                    self._validate(judge)
                    validated = logged = time.monotonic()
                if is_first and now - saved > 60.0 * s.save_minutes:
                    self.save()
                    saved = logged = time.monotonic()
        if progress.step > logged_step:
            self._check_finite(float(losses))
        if is_first:
            self._validate(judge)
            progress.seconds = earlier + time.monotonic() - start
            self.save()

    def _judge_at_start(self, judge: Validation) -> float:
        """Validate what there is, compare it with what was saved, and return the time to keep."""
        start = time.monotonic()
        found, before = judge(self.average), self.progress.validation
        self.out.mkdir(parents=True, exist_ok=True)
        write_curve(self.out, self.progress)
        for name, figures in before.get("loss", {}).items():
            if name not in found["loss"]:
                continue
            new, old = found["loss"][name]["all"], figures["all"]
            text = f"validation loss on {name}: {new:.5f}, saved: {old:.5f}"
            same = abs(new - old) <= self.settings.resume_tolerance * old
            if not same and self.settings.check_resume:
                advice = "same data, seed and code? check_resume = False goes on all the same"
                raise ModelError(str(self.out), f"{text}: not the network that was saved", advice)
            self.say(f"resumed: {text}: {'the same within noise' if same else 'NOT the same'}")
        self.progress.validation = found
        self._log(**found)
        # Validation and a checkpoint at the end, with room for a slow disk.
        return 1.5 * (time.monotonic() - start) + 3.0 if not self.settings.step_limit else 0.0

    def _step(self, batch: Batch, rate: float) -> Tensor:
        """Take one step; return its loss, detached, without waiting for the device."""
        s, count = self.settings, len(batch.image)
        u = torch.rand(count, 2 + len(CONDITIONS), device=self.device, generator=self.draws)
        t = s.time_min + (s.time_max - s.time_min) * u[:, 0]
        is_shown = (u[:, 2:] >= s.drop_condition) & (u[:, 1:2] >= s.drop_all)
        words = batch.noun, batch.setting, batch.weather, batch.kind
        noise = torch.randn(batch.image.shape, device=self.device, generator=self.draws)
        inputs = (
            batch.image,
            batch.background,
            batch.gbuffer,
            is_shown.float(),
            training_tokens(*words, self.draws),
            self.schedule.timestep(t),
            noise,
            *self.schedule.alpha_sigma(t),
        )
        self.optimizer.zero_grad(set_to_none=True)
        total = torch.zeros((), device=self.device)
        micro = s.micro or count
        for start in range(0, count, micro):
            part = [x[start : start + micro] for x in inputs]
            with autocast(self.device):
                loss = self.objective(*part).sum() / count
            torch.autograd.backward(loss)
            total += loss.detach()
        gradients = [p.grad for p in self.parameters if p.grad is not None]
        if self.worker.count > 1:
            average_over_processes(gradients, self.worker.count)
        torch.nn.utils.clip_grad_norm_(self.parameters, s.clip)
        for group in self.optimizer.param_groups:
            group["lr"] = rate
        self.optimizer.step()
        step = self.progress.step
        decay = min(s.average, (1.0 + step) / (10.0 + step))
        with torch.no_grad():
            torch._foreach_lerp_(self.averages, self.parameters, 1.0 - decay)
        return total

    def _rate(self, share: float) -> float:
        """Return the learning rate when ``share`` of the plan is used."""
        s = self.settings
        since = self.progress.step - self.first_step + 1
        rise = min(1.0, since / max(self.warmup_steps, 1))
        late = max(0.0, share - s.constant_share) / max(1.0 - s.constant_share, 1e-9)
        return s.rate * rise * (1.0 - (1.0 - s.final_rate) * min(late, 1.0))

    def _is_over(self, mine: bool) -> bool:
        """Return whether to stop: all processes follow the first one's clock."""
        if self.worker.count == 1:
            return mine
        if (self.progress.step - self.first_step) % PEER_CHECK_EVERY:
            return False
        flag = torch.tensor([float(mine)], device=self.device)
        dist.broadcast(flag, 0)
        return bool(flag.item())

    def _check_finite(self, loss: float) -> None:
        if not math.isfinite(loss):
            what = f"the loss is no longer finite (step {self.progress.step})"
            raise ModelError("training", what, "go on from the last checkpoint at a lower rate")

    def _validate(self, judge: Validation) -> None:
        self.progress.validation = judge(self.average)
        self._log(**self.progress.validation)

    def _log(self, **figures: Any) -> None:
        """Add a line to the curve."""
        if self.worker.rank:
            return
        p = self.progress
        entry = {"step": p.step, "samples": p.samples, "seconds": round(p.seconds, 1), **figures}
        p.curve.append(entry)
        line = json.dumps(entry)
        with (self.out / CURVE).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self.say(line)

    def save(self) -> None:
        """Write a checkpoint, and remove the older one when it is whole."""
        write_checkpoint(self.out, self.network, self.average, self.progress, self.settings)
        write_curve(self.out, self.progress)
        self.say(f"saved: step {self.progress.step}, {self.progress.samples} samples")


def schedule_on(device: torch.device) -> NoiseSchedule:
    """Return the prior's schedule with its table on a device, so that no step uploads it."""
    schedule = cosine_schedule()
    return NoiseSchedule(schedule.alphas_cumprod.to(device), schedule.prediction_type)


def autocast(device: torch.device) -> AbstractContextManager[Any]:
    """Return the arithmetic of training: bf16 on CUDA, fp32 elsewhere."""
    return torch.autocast("cuda", torch.bfloat16) if device.type == "cuda" else nullcontext()


def average_over_processes(gradients: Sequence[Tensor], count: int) -> None:
    """Replace gradients by their mean over all processes, in one exchange."""
    flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
    dist.all_reduce(flat)
    flat /= count
    parts = flat.split([gradient.numel() for gradient in gradients])
    for gradient, part in zip(gradients, parts, strict=True):
        gradient.copy_(part.view(gradient.shape))


@contextmanager
def _process_group(worker: Worker, device: torch.device) -> Iterator[None]:
    """Join the other processes within this context, where there are any."""
    if worker.count == 1:
        yield
        return
    if device.type == "cuda":
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        yield
        dist.barrier()
    finally:
        dist.destroy_process_group()


# Validation


class Validation:
    """How good a network is on fixed pictures, times and noises; everything in fp32.

    Called with a network it returns plain values:

    * ``loss``: by set, the training's loss with all conditions and words, over ``all`` times and by
      range of the noise level (`SIGMA_EDGES`).
    * ``difference``: by set, for wrongly lit pictures x and their consistent twins y, the cosine
      between the guidance's force and x - y, the way back: ``sds`` e(good) - noise,
      ``good-bad``, and ``csd`` e(good) - e(null), each over ``all`` times and by range; and
      ``ranked``, the share of pairs in which the error of "consistent" less that of "mismatched" is
      lower for y than for x at equal noise (chance: 0.5).

    Args:
        settings: Times and weights.
        device: Where.
        sets: Fixed batches by name.
        pairs: Fixed pairs by name.
    """

    def __init__(
        self,
        settings: TrainSettings,
        device: torch.device,
        sets: Mapping[str, Sequence[Batch]],
        pairs: Mapping[str, Sequence[Pair]],
    ) -> None:
        self.settings, self.device, self.sets, self.pairs = settings, device, sets, pairs
        self.schedule = schedule_on(device)

    @torch.no_grad()
    def __call__(self, network: EmbeddedNetwork) -> dict[str, Any]:
        """Return the figures of a network."""
        with no_tf32():
            loss = {name: self._losses(network, name, held) for name, held in self.sets.items()}
            difference = {
                name: self._differences(network, name, held) for name, held in self.pairs.items()
            }
        return {"loss": loss, "difference": difference}

    def _draws(self, name: str, place: int, count: int) -> tuple[Tensor, Tensor]:
        """Return fixed times, spread evenly, and noises of a batch."""
        random = torch.Generator().manual_seed(seed_of("validation", name, place))
        s = self.settings
        t = (torch.randperm(count, generator=random) + 0.5) / count
        t = s.time_min + (s.time_max - s.time_min) * t
        noise = torch.randn(count, 3, 64, 64, generator=random)
        return t.to(self.device), noise.to(self.device)

    def _losses(
        self, network: EmbeddedNetwork, name: str, batches: Sequence[Batch]
    ) -> dict[str, Any]:
        objective = Objective(network, self.settings)
        losses, sigmas = [], []
        for place, batch in enumerate(batches):
            count = len(batch.image)
            t, noise = self._draws(name, place, count)
            a, s = self.schedule.alpha_sigma(t)
            present = torch.ones(count, len(CONDITIONS), device=self.device)
            ids = training_tokens(batch.noun, batch.setting, batch.weather, batch.kind)
            timesteps = self.schedule.timestep(t)
            losses.append(
                objective(
                    batch.image, batch.background, batch.gbuffer, present, ids, timesteps, noise,
                    a, s,
                )
            )  # fmt: skip
            sigmas.append(s)
        return by_sigma(torch.cat(losses), torch.cat(sigmas))

    def _differences(
        self, network: EmbeddedNetwork, name: str, pairs: Sequence[Pair]
    ) -> dict[str, Any]:
        forces: dict[str, list[Tensor]] = {"sds": [], "good-bad": [], "csd": []}
        ranked, sigmas = [], []
        for place, (right, wrong) in enumerate(pairs):
            count = len(right.image)
            t, noise = self._draws(name, place, count)
            a, s = (x[:, None, None, None] for x in self.schedule.alpha_sigma(t))
            words = wrong.noun, wrong.setting, wrong.weather
            kind = torch.zeros_like(wrong.kind)
            good, bad = (training_tokens(*words, k) for k in (kind, kind - 1))
            present = torch.ones(count, len(CONDITIONS), device=self.device)

            def noise_in(
                image: Tensor,
                ids: Tensor,
                held: Batch = wrong,
                t: Tensor = t,
                noisy: tuple[Tensor, Tensor, Tensor] = (a, s, noise),
                present: Tensor = present,
            ) -> Tensor:
                a, s, noise = noisy
                z = a * (2.0 * image - 1.0) + s * noise
                v: Tensor = network(
                    z,
                    self.schedule.timestep(t),
                    network.embed(ids),
                    held.background,
                    held.gbuffer,
                    present,
                )
                return a * v + s * z

            e_good, e_bad = noise_in(wrong.image, good), noise_in(wrong.image, bad)
            e_null = noise_in(wrong.image, torch.zeros_like(good))
            back = (wrong.image - right.image).flatten(1)
            for force, delta in (
                ("sds", e_good - noise), ("good-bad", e_good - e_bad), ("csd", e_good - e_null),
            ):  # fmt: skip
                cosine = torch.nn.functional.cosine_similarity(delta.flatten(1), back, dim=1)
                forces[force].append(cosine)
            f_good, f_bad = noise_in(right.image, good), noise_in(right.image, bad)
            of_wrong = (e_good - noise).square() - (e_bad - noise).square()
            of_right = (f_good - noise).square() - (f_bad - noise).square()
            ranked.append((of_right.mean(dim=(1, 2, 3)) < of_wrong.mean(dim=(1, 2, 3))).float())
            sigmas.append(s.flatten())
        sigma = torch.cat(sigmas)
        figures: dict[str, Any] = {
            force: by_sigma(torch.cat(values), sigma) for force, values in forces.items()
        }
        return figures | {"ranked": by_sigma(torch.cat(ranked), sigma)}


def by_sigma(values: Tensor, sigma: Tensor) -> dict[str, float]:
    """Return the mean of values, over all and by range of noise level; empty ones are left out."""
    figures = {"all": values.mean()}
    for low, high in pairwise(SIGMA_EDGES):
        within = (sigma >= low) & (sigma < high)
        if bool(within.any()):
            figures[f"{low:g}-{high:g}"] = values[within].mean()
    return {name: round(float(value), 6) for name, value in figures.items()}


# Checkpoints


@dataclass(frozen=True)
class Checkpoint:
    """What a training keeps between its runs."""

    network: EmbeddedNetwork
    average: EmbeddedNetwork
    """Moving average of its weights."""
    progress: Progress
    settings: dict[str, Any]
    """`TrainSettings` as plain values."""


def checkpoints_in(out: Path) -> list[Path]:
    """Return the folders of whole checkpoints, the newest last."""
    return sorted(path for path in out.glob("checkpoint-*") if path.is_dir())


def write_checkpoint(
    out: Path,
    network: EmbeddedNetwork,
    average: EmbeddedNetwork,
    progress: Progress,
    settings: TrainSettings,
) -> Path:
    """Write ``checkpoint-<step>/``, whole or not at all, and then remove the older ones.

    Raises:
        OSError: It cannot be written; the older one is still whole.
    """
    kind = torch.float32 if settings.save_fp32 else torch.float16
    tensors = {f"network.{k}": v.detach().to("cpu", kind) for k, v in network.state_dict().items()}
    for name, value in average.state_dict().items():
        tensors[f"average.{name}"] = value.detach().to("cpu", torch.float16)
    shards: list[dict[str, Tensor]] = [{}]
    size = 0
    for name, value in tensors.items():
        if size + value.nbytes > SHARD_BYTES:
            shards.append({})
            size = 0
        shards[-1][name] = value
        size += value.nbytes
    record = {"format": FORMAT, "progress": asdict(progress), "settings": asdict(settings)}

    def files() -> Iterator[tuple[str, bytes]]:
        for place, shard in enumerate(shards):
            described: dict[str, Any] = {
                "shard": place, "shards": len(shards), "step": progress.step,
            }  # fmt: skip
            if place == 0:
                described |= record
            header = {"format": "pt", HEADER_KEY: json.dumps(described)}
            yield f"part-{place}.safetensors", serialize(shard, header)

    final = out / f"checkpoint-{progress.step:08d}"
    write_folder(final, files())
    for older in checkpoints_in(out):
        if older != final:
            shutil.rmtree(older)
    return final


def read_checkpoint(out: Path) -> Checkpoint:
    """Read the newest checkpoint of a training's folder.

    Raises:
        ModelError: There is none, or it is damaged.
    """
    found = checkpoints_in(out)
    if not found:
        raise ModelError(str(out), "holds no checkpoint of a training", "start without resuming")
    folder = found[-1]
    files = sorted(folder.glob("part-*.safetensors"))
    tensors: dict[str, Tensor] = {}
    records: dict[int, dict[str, Any]] = {}
    try:
        for file in files:
            held, header = read_safetensors(file)
            described = json.loads(header[HEADER_KEY])
            records[int(described["shard"])] = described
            tensors |= held
        record = records[0]
        if record["format"] != FORMAT or set(records) != set(range(record["shards"])):
            raise ValueError(f"{len(records)} of {record['shards']} files")
        if {described["step"] for described in records.values()} != {record["step"]}:
            raise ValueError("files of several steps")
        progress = Progress(**record["progress"])
        config = config_of(record["settings"]["network"])
    except (ValueError, TypeError, KeyError) as error:
        what = f"not a whole checkpoint ({type(error).__name__}: {error})"
        raise ModelError(str(folder), what) from error
    networks = [
        network_of(
            config,
            {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)},
            str(folder),
        )
        for prefix in ("network.", "average.")
    ]
    return Checkpoint(networks[0], networks[1], progress, record["settings"])


def write_curve(out: Path, progress: Progress) -> None:
    """Write the curve as JSON lines: all of it, without what a run that was cut off added."""
    lines = "".join(json.dumps(entry) + "\n" for entry in progress.curve)
    write_file(out / CURVE, lines.encode())


def export_prior(out: Path, path: Path, training: Mapping[str, Any]) -> Progress:
    """Write the average of a training as the weights that `load_embedded` reads.

    Args:
        out: Folder of the training.
        path: The file.
        training: What its header shall say beside steps, samples, time, settings and validation;
            plain values.

    Returns:
        How far the training was.

    Raises:
        ModelError: There is no checkpoint, or a damaged one.
        OSError: The file cannot be written.
    """
    held = read_checkpoint(out)
    record = {
        "steps": held.progress.step,
        "samples": held.progress.samples,
        "seconds": round(held.progress.seconds),
        "runs": held.progress.runs,
        "settings": held.settings,
        "validation": held.progress.validation,
        **training,
    }
    save_embedded(held.average, path, record)
    return held.progress
