"""The loop that trains the embedded prior: in many short runs, on scenes that are new each time.

It stops by the clock and keeps weights, their moving average and the progress for the next run;
Adam starts anew, with a short warm-up. Several GPUs (``torchrun``) share the gradient, each with
scenes of its own. A function that draws a batch is given.
"""

from __future__ import annotations

import copy
import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from warpir.core.atomic import Checkpoints, write_file
from warpir.diffusion.draws import seed_of
from warpir.diffusion.models.embedded import (
    CONDITIONS,
    EmbeddedNetwork,
    NetworkConfig,
    build_network,
    network_of,
    save_embedded,
)
from warpir.diffusion.models.embedded_words import training_tokens
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.train.objective import (
    Batch,
    Draw,
    Objective,
    Pair,
    TrainSettings,
    autocast,
    schedule_on,
)
from warpir.diffusion.train.validation import Validation
from warpir.diffusion.train.worker import Worker

STAGE = "prior"
"""What the checkpoints of this training are called."""
CURVE = "curve.jsonl"
PEER_CHECK_EVERY = 10
"""Steps between two looks of other processes at the first one's clock."""

log = logging.getLogger(__name__)


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
        out: Folder of the checkpoints and of `CURVE`.
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
        InputError: There is nothing to resume, or no checkpoint is whole or of this network.
        ModelError: Something would be overwritten; the checkpoint does not reproduce its validation
            loss; or the loss is no longer finite (the last checkpoint is from before).
    """
    start = time.monotonic()
    device, worker = torch.device(device), Worker.this()
    with worker.joined(device):
        training = _Training(settings, device, worker, out, resume, seed, network, say)
        judge = Validation(settings, device, validation or {}, pairs or {})
        training.run(batches, judge, start, 60.0 * minutes, 60.0 * total_minutes)
    return training.progress


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
        self.seed, self.say = seed, say if worker.is_first else lambda text: None
        is_cuda = device.type == "cuda"
        self.checkpoints = checkpoints_of(out, settings.network)
        if resume:
            held = read_checkpoint(out, settings.network, self.say)
            network, average, self.progress = held.network, held.average, held.progress
        else:
            if self.checkpoints.newest is not None:
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
        is_first = self.worker.is_first
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
        self.worker.average_gradients(self.parameters)
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
        if self.worker.count > 1 and (self.progress.step - self.first_step) % PEER_CHECK_EVERY:
            return False
        return bool(self.worker.agree(float(mine), self.device))

    def _check_finite(self, loss: float) -> None:
        if not math.isfinite(loss):
            what = f"the loss is no longer finite (step {self.progress.step})"
            raise ModelError("training", what, "go on from the last checkpoint at a lower rate")

    def _validate(self, judge: Validation) -> None:
        self.progress.validation = judge(self.average)
        self._log(**self.progress.validation)

    def _log(self, **figures: Any) -> None:
        """Add a line to the curve."""
        if not self.worker.is_first:
            return
        p = self.progress
        entry = {"step": p.step, "samples": p.samples, "seconds": round(p.seconds, 1), **figures}
        p.curve.append(entry)
        line = json.dumps(entry)
        with (self.out / CURVE).open("a", encoding="utf-8") as file:
            file.write(line + "\n")
        self.say(line)

    def save(self) -> None:
        """Write a checkpoint and the curve."""
        state = {
            "network": self.network.state_dict(),
            "average": self.average.state_dict(),
            "progress": asdict(self.progress),
            "settings": asdict(self.settings),
        }
        self.checkpoints.save(STAGE, self.progress.step, state)
        write_curve(self.out, self.progress)
        self.say(f"saved: step {self.progress.step}, {self.progress.samples} samples")


# Checkpoints


@dataclass(frozen=True)
class Held:
    """What a training keeps between its runs."""

    network: EmbeddedNetwork
    average: EmbeddedNetwork
    """Moving average of its weights."""
    progress: Progress
    settings: dict[str, Any]
    """`TrainSettings` as plain values."""


def checkpoints_of(out: Path, network: NetworkConfig) -> Checkpoints:
    """Return the checkpoints of a training in its folder, which are of a network of this size."""
    return Checkpoints(out, {"trained": STAGE, "network": asdict(network)}, "another --out")


def read_checkpoint(
    out: Path, network: NetworkConfig, notice: Callable[[str], None] = log.warning
) -> Held:
    """Read the newest whole checkpoint of a training's folder.

    Args:
        out: The folder.
        network: Size of the network.
        notice: Told of each damaged checkpoint that was passed over.

    Raises:
        InputError: There is none, none is whole, or they are another network's.
    """
    state = checkpoints_of(out, network).load(notice).state
    raw, average = (network_of(network, state[name], str(out)) for name in ("network", "average"))
    return Held(raw, average, Progress(**state["progress"]), state["settings"])


def write_curve(out: Path, progress: Progress) -> None:
    """Write the curve as JSON lines: all of it, without what a run that was cut off added."""
    lines = "".join(json.dumps(entry) + "\n" for entry in progress.curve)
    write_file(out / CURVE, lines.encode())


def export_prior(
    out: Path, path: Path, network: NetworkConfig, training: Mapping[str, Any]
) -> Progress:
    """Write the average of a training as the weights that `load_embedded` reads.

    Args:
        out: Folder of the training.
        path: The file.
        network: Size of the network.
        training: What its header shall say beside steps, samples, time, settings and validation;
            plain values.

    Returns:
        How far the training was.

    Raises:
        InputError: There is no checkpoint, or none that is whole and of this network.
        OSError: The file cannot be written.
    """
    held = read_checkpoint(out, network)
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
