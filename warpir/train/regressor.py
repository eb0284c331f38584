"""The training loop of the light regressor, which can be interrupted and resumed.

Batches come from a callable; nothing here knows whether a photo was rendered or is a crop of a
panorama. A run stops on the wall clock and goes on where it stopped with ``resume``, so that a long
training fits into short commands. What is kept is the best moving average of the weights on
validation photos, which stops panoramas from being learned by heart.
"""

from __future__ import annotations

import copy
import json
import logging
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from warpir.app.program import say
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.lighting.regressor import split
from warpir.train.augmentation import augment
from warpir.train.batches import PhotoBatch
from warpir.train.light_loss import TERM_WEIGHTS, LightLoss, MeanLight
from warpir.train.networks.files import plain_sizes
from warpir.train.networks.regressor import (
    RegressorConfig,
    RegressorModule,
    random_regressor,
    read_regressor,
    save_regressor,
)
from warpir.train.stepping import TrainingSettings, follow, left_to_fall, make_optimizer, warmed_up
from warpir.train.validation import calibrate, measure, score
from warpir.train.worker import Worker

WEIGHTS, BEST, CURVE = "regressor.safetensors", "best.safetensors", "curve.jsonl"
PANORAMAS = "panoramas"
"""Name of the validation set of crops of panoramas that are not learned from."""
STAGE = "regressor"
"""What the checkpoints of this training are called."""

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrainingEnd:
    """What a call of `train_regressor` came to."""

    steps: int
    """Of all calls together."""
    minutes: float
    """Of all calls together."""
    is_complete: bool
    """Whether the planned time is used up; then the file holds calibrated weights."""
    validation: dict[str, dict[str, float]]
    """Of the weights kept, by set."""


def train_regressor(
    batches: Callable[[int, torch.Generator], PhotoBatch],
    validation: Mapping[str, Sequence[PhotoBatch]],
    out: Path,
    settings: TrainingSettings,
    device: str | torch.device,
    minutes: float,
    total_minutes: float,
    resume: bool = False,
    seed: int = 0,
    network: RegressorModule | None = None,
    record: Mapping[str, Any] | None = None,
) -> TrainingEnd:
    """Train a regressor until the time is over, and write its weights and its curve.

    The schedule goes by the time used of ``total_minutes``, in all calls together. ``out``
    then holds ``regressor.safetensors``, the best moving average so far (`score`), calibrated, and
    ``curve.jsonl`` with one line a validation.

    Args:
        batches: Gives that many photos on ``device``, drawn with the generator given.
        validation: Fixed batches by the set's name, such as ``procedural`` and ``panoramas``.
        out: Folder of the weights, the curve and the checkpoints to resume from.
        settings: Of the optimiser, its schedule and the augmentation.
        device: Where the network is trained.
        minutes: Time for this call.
        total_minutes: Time for all calls.
        resume: Go on from the newest checkpoint in ``out``.
        seed: Of the weights and of the scenes; each call draws new scenes.
        network: To start from; default: random weights.
        record: Put into the weights file beside what is known here; plain values.

    Raises:
        InputError: Nothing to resume from, or no checkpoint that is whole.
    """
    began, device, worker = time.monotonic(), torch.device(device), Worker.this()
    with worker.joined(device):
        out.mkdir(parents=True, exist_ok=True)
        if resume:
            run = _Run.resumed(out, settings, device, record or {})
        else:
            start = network or random_regressor(seed)
            run = _Run(out, start, settings, device, record or {})
            if worker.is_first:
                (out / CURVE).unlink(missing_ok=True)
        first = run.step
        is_complete = run.go(batches, validation, worker, seed, began, minutes, total_minutes)
        finished: dict[str, dict[str, float]] = {}
        if worker.is_first:
            if run.step > first:
                run.validate(validation)
                run.save()
            known = {"settings": asdict(settings), "seed": seed, "processes": worker.count}
            finished = run.finish(validation, dict(record or {}) | known)
    return TrainingEnd(run.step, run.minutes, is_complete, finished)


def join_members(paths: Sequence[Path], out: Path) -> RegressorModule:
    """Join calibrated networks of one size into one that averages their answers, and write it.

    Raises:
        InputError: A file cannot be used (`ExitCode.MODEL`).
    """
    networks = [read_regressor(path) for path in paths]
    for path, network in zip(paths, networks, strict=True):
        if not torch.equal(network.directions, networks[0].directions):
            what = f"its candidate directions are not those of {paths[0]}"
            raise InputError(path, what, code=ExitCode.MODEL)
    joined = RegressorModule(replace(networks[0].config, members=len(networks))).eval()
    with torch.no_grad():
        for place, network in enumerate(networks):
            # Each network's own temperature goes into its logits, since these are averaged.
            ((direction, _),) = network.last_layers()
            direction.weight.div_(network.temperature)
            direction.bias.div_(network.temperature)
            joined.members[place].load_state_dict(network.members[0].state_dict())
        joined.mean_light.copy_(torch.stack([n.mean_light for n in networks]).mean(dim=0))
        # A file keeps the directions that its network was trained with.
        joined.directions.copy_(networks[0].directions)
    save_regressor(joined, out, {"members": [n.record for n in networks]})
    return joined


def _rate(settings: TrainingSettings, progress: float, steps: int) -> float:
    """Return the learning rate: warm-up by steps of this call, then constant, then linear down."""
    left = left_to_fall(settings, progress)
    return warmed_up(settings, settings.final_rate + (1.0 - settings.final_rate) * left, steps)


def checkpoints_of(out: Path) -> Checkpoints:
    """Return the checkpoints of a training in its folder."""
    return Checkpoints(out, {"trained": STAGE}, "another --out")


class _Run:
    """Everything that a training carries from step to step and from call to call."""

    def __init__(
        self,
        out: Path,
        network: RegressorModule,
        settings: TrainingSettings,
        device: str | torch.device,
        record: Mapping[str, Any],
    ) -> None:
        self.out, self.record = out, record
        self.network = network.to(device).requires_grad_(True)
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        self.loss = LightLoss(self.network, settings.label_sigma_deg)
        self.mean = MeanLight(self.loss)
        self.optimizer = make_optimizer(network, settings)
        self.settings, self.device = settings, torch.device(device)
        self.checkpoints = checkpoints_of(out)
        self.step, self.minutes, self.best = 0, 0.0, math.inf
        self.losses: dict[str, Tensor] = {}
        """Running means of the terms of the loss."""

    @classmethod
    def resumed(
        cls,
        out: Path,
        settings: TrainingSettings,
        device: torch.device,
        record: Mapping[str, Any],
    ) -> _Run:
        """Read the newest whole checkpoint back.

        Raises:
            InputError: There is none.
        """
        held = checkpoints_of(out).load(log.warning).state
        config = RegressorConfig(**plain_sizes(held["config"]))
        run = cls(out, RegressorModule(config), settings, device, record)
        run.network.load_state_dict(held["weights"])
        run.average.load_state_dict(held["average"])
        run.step, run.minutes = held["step"], held["minutes"]
        run.best = math.inf if held["best"] is None else held["best"]
        for name, parameter in run.network.named_parameters():
            run.optimizer.state[parameter] = {
                "step": torch.tensor(float(run.step)),
                "exp_avg": held["first"][name].to(parameter.device),
                "exp_avg_sq": held["second"][name].to(parameter.device),
            }
        run.mean.sums = {k: v.to(device) for k, v in held["mean"].items()}
        return run

    def go(
        self,
        batches: Callable[[int, torch.Generator], PhotoBatch],
        validation: Mapping[str, Sequence[PhotoBatch]],
        worker: Worker,
        seed: int,
        began: float,
        minutes: float,
        total_minutes: float,
    ) -> bool:
        """Take steps until the time is over; validate and save now and then.

        Arguments as of `train_regressor`; ``began`` is when it was called, by a clock that only
        runs forward [s].

        Returns:
            Whether the time for all calls is used up.
        """
        settings, earlier, first = self.settings, self.minutes, self.step
        generator = torch.Generator(self.device)
        for draws in (generator, torch):
            draws.manual_seed((seed * 1_000_003 + first) * worker.count + worker.rank)
        step = self.compiled_step(worker)
        validated = saved = began
        while True:
            seconds = worker.agree(time.monotonic() - began, self.device)
            self.minutes = earlier + seconds / 60.0
            by_steps = self.step / settings.step_limit if settings.step_limit else 0.0
            progress = min(max(self.minutes / total_minutes, by_steps), 1.0)
            # A step at least: without any there are no weights to write.
            if self.step and (progress >= 1.0 or self.minutes - earlier >= minutes):
                return progress >= 1.0
            with torch.no_grad():
                batch = augment(batches(settings.batch, generator), settings, generator)
            step(batch, _rate(settings, progress, self.step - first))
            if not worker.is_first:
                continue
            if time.monotonic() - validated >= 60.0 * settings.validate_minutes:
                self.validate(validation)
                validated = time.monotonic()
            if time.monotonic() - saved >= 60.0 * settings.save_minutes:
                self.save()
                saved = time.monotonic()

    def compiled_step(self, worker: Worker) -> Callable[[PhotoBatch, float], None]:
        """Return what takes a step of the optimiser on a batch, at a learning rate."""
        is_cuda = self.device.type == "cuda"
        if is_cuda:
            self.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        use_compiler = self.settings.compile and is_cuda
        trained = torch.compile(self.network) if use_compiler else self.network
        self.network.train()

        def step(batch: PhotoBatch, rate: float) -> None:
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            with torch.no_grad():
                targets = self.loss.targets(batch)
                self.mean.add(targets)
            with torch.autocast("cuda", torch.bfloat16) if is_cuda else nullcontext():
                (flat,) = trained(batch.photo, batch.rays)
            terms = self.loss.terms(split(flat.float()), targets)
            weighted = [TERM_WEIGHTS[name] * term for name, term in terms.items()]
            self.optimizer.zero_grad(set_to_none=True)
            torch.stack(weighted).sum().backward()
            worker.average_gradients(self.network.parameters())
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
            self.optimizer.step()
            self.step += 1
            follow(self.average, self.network, self.step, self.settings.average)
            for name, term in terms.items():
                kept = self.losses.get(name, term.detach())
                self.losses[name] = 0.98 * kept + 0.02 * term.detach()

        return step

    def validate(self, validation: Mapping[str, Sequence[PhotoBatch]]) -> None:
        """Measure the average, write a line of the curve, and keep it if it is the best so far."""
        # On a CPU it takes minutes.
        say(f"step {self.step}, {self.minutes:.1f} minutes: validating")
        measured = {k: measure(self.average, self.loss, v) for k, v in validation.items()}
        mark = score(measured)
        line = {
            "step": self.step,
            "minutes": round(self.minutes, 3),
            "score": mark,
            "losses": {name: float(value) for name, value in self.losses.items()},
            "validation": measured,
        }
        with (self.out / CURVE).open("a", encoding="utf-8") as curve:
            curve.write(json.dumps(line, allow_nan=False) + "\n")
        if mark < self.best:
            self.best = mark
            save_regressor(self.average, self.out / BEST, {"step": self.step, "score": mark})

    def save(self) -> None:
        """Write a checkpoint."""
        moments = {k: self.optimizer.state[p] for k, p in self.network.named_parameters()}
        state = {
            "config": asdict(self.network.config),
            "record": self.record,
            "weights": self.network.state_dict(),
            "average": self.average.state_dict(),
            "first": {k: m["exp_avg"] for k, m in moments.items()},
            "second": {k: m["exp_avg_sq"] for k, m in moments.items()},
            "mean": self.mean.sums,
            "step": self.step,
            "minutes": self.minutes,
            "best": None if math.isinf(self.best) else self.best,  # JSON has no infinity
        }
        self.checkpoints.save(STAGE, self.step, state)

    def finish(
        self, validation: Mapping[str, Sequence[PhotoBatch]], record: Mapping[str, Any]
    ) -> dict[str, dict[str, float]]:
        """Calibrate the best average, write it, and return what it reaches."""
        say("calibrating the best weights")
        device = self.network.directions.device
        network = read_regressor(self.out / BEST, device)
        network.mean_light.copy_(self.mean.flat())
        # By real places where there are some: made-up ones are easier to read.
        real = {name: v for name, v in validation.items() if name == PANORAMAS}
        calibrate(network, self.loss, real or validation)
        measured = {k: measure(network, self.loss, v) for k, v in validation.items()}
        known = {
            "steps": self.step,
            "minutes": self.minutes,
            "kept": network.record,
            "temperature": float(network.temperature),
            "validation": measured,
        }
        save_regressor(network, self.out / WEIGHTS, dict(record) | known)
        return measured
