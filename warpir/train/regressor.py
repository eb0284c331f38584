"""The training loop of the light regressor, which can be interrupted and resumed.

Batches come from a callable; nothing here knows whether a photo was rendered or is a crop of a
panorama. A run stops on the wall clock and goes on where it stopped with ``resume``, so that a long
training fits into short commands. What is kept is the best moving average of the weights on
validation photos, which stops panoramas from being learned by heart.
"""

from __future__ import annotations

import copy
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from warpir.core.atomic import write_folder
from warpir.core.errors import ExitCode, InputError
from warpir.core.strict_json import read_json_object
from warpir.lighting.regressor import (
    Regressor,
    RegressorConfig,
    load_regressor,
    random_regressor,
    save_regressor,
)
from warpir.train.augmentation import augment
from warpir.train.batches import PhotoBatch
from warpir.train.light_loss import TERM_WEIGHTS, LightLoss, MeanLight
from warpir.train.settings import TrainingSettings
from warpir.train.validation import calibrate, measure, score

WEIGHTS, BEST, CURVE, STATE = (
    "regressor.safetensors",
    "best.safetensors",
    "curve.jsonl",
    "state.json",
)
STATE_FILES = ("weights", "average", "first", "second", "mean")
"""Parts of a state: the network, its average, Adam's two moments, sums of the training light."""


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
    network: Regressor | None = None,
    record: Mapping[str, Any] | None = None,
) -> TrainingEnd:
    """Train a regressor until the time is over, and write its weights and its curve.

    The schedule goes by the time used of ``total_minutes``, in all calls together. ``out``
    then holds ``regressor.safetensors``, the best moving average so far (`score`), calibrated, and
    ``curve.jsonl`` with one line a validation.

    Args:
        batches: Gives that many photos on ``device``, drawn with the generator given.
        validation: Fixed batches by the set's name, such as ``procedural`` and ``panoramas``.
        out: Folder of the weights, the curve and the state to resume from (files <= 16 MiB).
        settings: How.
        device: Where the network is trained.
        minutes: Time for this call.
        total_minutes: Time for all calls.
        resume: Go on from the state in ``out``.
        seed: Of the weights and of the scenes; each call draws new scenes.
        network: To start from; default: random weights.
        record: Put into the weights file beside what is known here; plain values.

    Raises:
        InputError: Nothing to resume from, a state that is not whole, or ``out`` holds a training
            that was begun.
    """
    began = time.monotonic()
    peers = _Peers(torch.device(device))
    out.mkdir(parents=True, exist_ok=True)
    if resume:
        run = _Run.resumed(out, settings, device)
    else:
        run = _Run.begun(out, network or random_regressor(seed), settings, device, peers.is_first)
    generator = torch.Generator(device)
    for draws in (generator, torch):
        draws.manual_seed((seed * 1_000_003 + run.step) * peers.count + peers.rank)
    step = run.compiled_step(peers)
    earlier, first = run.minutes, run.step
    validated = saved = began
    while True:
        run.minutes = earlier + peers.agree(time.monotonic() - began) / 60.0
        by_steps = run.step / settings.step_limit if settings.step_limit else 0.0
        progress = max(run.minutes / total_minutes, by_steps)
        if progress >= 1.0 or run.minutes - earlier >= minutes:
            break
        with torch.no_grad():
            batch = augment(batches(settings.batch, generator), settings, generator)
        step(batch, _rate(settings, progress, run.step - first))
        if not peers.is_first:
            continue
        if time.monotonic() - validated >= 60.0 * settings.validate_minutes:
            run.validate(validation)
            validated = time.monotonic()
        if time.monotonic() - saved >= 60.0 * settings.save_minutes:
            run.save()
            saved = time.monotonic()
    finished: dict[str, dict[str, float]] = {}
    if peers.is_first:
        if run.step > first:
            run.validate(validation)
            run.save()
        known = {"settings": asdict(settings), "seed": seed, "processes": peers.count}
        finished = run.finish(validation, dict(record or {}) | known)
    peers.leave()
    return TrainingEnd(run.step, run.minutes, progress >= 1.0, finished)


class _Peers:
    """The processes that train one network together, each with scenes of its own (``torchrun``).

    Args:
        device: Of this process.
    """

    def __init__(self, device: torch.device) -> None:
        self.rank, self.count = (
            int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("WORLD_SIZE", 1))
        )
        self.device = device
        if self.count > 1:
            if device.type == "cuda":
                torch.cuda.set_device(device)
            dist.init_process_group("nccl" if device.type == "cuda" else "gloo")

    @property
    def is_first(self) -> bool:
        """Whether this process is the one that validates and writes."""
        return self.rank == 0

    def agree(self, seconds: float) -> float:
        """Return the first process's seconds: rates and the end depend on them."""
        if self.count == 1:
            return seconds
        shared = torch.tensor(seconds, dtype=torch.float64, device=self.device)
        dist.broadcast(shared, 0)
        return float(shared)

    def average(self, network: Regressor) -> None:
        """Replace the gradients by their means over the processes."""
        if self.count == 1:
            return
        gradients = [p.grad for p in network.parameters() if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients])
        dist.all_reduce(flat)
        parts = (flat / self.count).split([g.numel() for g in gradients])
        for gradient, mean in zip(gradients, parts, strict=True):
            gradient.copy_(mean.view_as(gradient))

    def leave(self) -> None:
        """Wait for the others, and end what was shared."""
        if self.count > 1:
            dist.destroy_process_group()


def _rate(settings: TrainingSettings, progress: float, steps: int) -> float:
    """Return the learning rate: warm-up by steps of this call, then constant, then linear down."""
    left = min((1.0 - progress) / (1.0 - settings.constant_share), 1.0)
    share = settings.final_rate + (1.0 - settings.final_rate) * left
    return settings.learning_rate * share * min((steps + 1) / settings.warmup_steps, 1.0)


class _Run:
    """Everything that a training carries from step to step and from call to call."""

    def __init__(
        self, out: Path, network: Regressor, settings: TrainingSettings, device: str | torch.device
    ) -> None:
        self.out = out
        self.network = network.to(device).requires_grad_(True)
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        self.loss = LightLoss(self.network, settings.label_sigma_deg)
        self.mean = MeanLight(self.loss)
        # Norms, biases and tokens are not pulled toward 0.
        pulled = [p for p in network.parameters() if p.dim() > 1 and p is not network.asking]
        plain = [p for p in network.parameters() if p.dim() < 2 or p is network.asking]
        self.optimizer = torch.optim.AdamW(
            [
                {"params": pulled, "weight_decay": settings.weight_decay},
                {"params": plain, "weight_decay": 0.0},
            ],
            betas=(0.9, 0.99),
        )
        self.settings = settings
        self.step, self.minutes, self.best = 0, 0.0, math.inf
        self.losses: dict[str, Tensor] = {}
        """Running means of the terms of the loss."""

    @classmethod
    def begun(
        cls,
        out: Path,
        network: Regressor,
        settings: TrainingSettings,
        device: str | torch.device,
        is_first: bool,
    ) -> _Run:
        """Start a training in a folder that holds none.

        Raises:
            InputError: The folder holds the state of a training.
        """
        if any(out.glob("state-*")):
            advice = "resume it, or give another folder"
            raise InputError(out, "holds a training that was begun", advice, ExitCode.OUTPUT)
        if is_first:
            (out / CURVE).unlink(missing_ok=True)
        return cls(out, network, settings, device)

    @classmethod
    def resumed(cls, out: Path, settings: TrainingSettings, device: str | torch.device) -> _Run:
        """Read the newest state back.

        Raises:
            InputError: There is none, or it is not whole.
        """
        states = sorted(out.glob(f"state-*/{STATE}"))
        if not states:
            raise InputError("--resume", f"nothing to go on from (no state in {out})")
        folder = states[-1].parent
        try:
            about = read_json_object(folder / STATE)
            config: dict[str, Any] = {
                k: tuple(v) if isinstance(v, list) else v for k, v in about["config"].items()
            }
            run = cls(out, Regressor(RegressorConfig(**config)), settings, device)
            held = {name: load_file(folder / f"{name}.safetensors") for name in STATE_FILES}
            run.network.load_state_dict(held["weights"])
            run.average.load_state_dict(held["average"])
            for name, parameter in run.network.named_parameters():
                run.optimizer.state[parameter] = {
                    "step": torch.tensor(float(about["step"])),
                    "exp_avg": held["first"][name].to(parameter.device),
                    "exp_avg_sq": held["second"][name].to(parameter.device),
                }
            run.mean.sums = {k: v.to(device) for k, v in held["mean"].items()}
            run.step, run.minutes = int(about["step"]), float(about["minutes"])
            run.best = float(about["best"])
        except (SafetensorError, OSError, KeyError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(folder, f"damaged ({str(error).splitlines()[0][:120]})") from error
        return run

    def compiled_step(self, peers: _Peers) -> Callable[[PhotoBatch, float], None]:
        """Return what takes a step of the optimiser on a batch, at a learning rate."""
        is_cuda = peers.device.type == "cuda"
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
                flat = trained(batch.photo, batch.rays)
            terms = self.loss.terms(self.network.split(flat.float()), targets)
            weighted = [TERM_WEIGHTS[name] * term for name, term in terms.items()]
            self.optimizer.zero_grad(set_to_none=True)
            torch.stack(weighted).sum().backward()
            peers.average(self.network)
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), self.settings.clip)
            self.optimizer.step()
            self.step += 1
            self.follow(self.settings.average)
            for name, term in terms.items():
                kept = self.losses.get(name, term.detach())
                self.losses[name] = 0.98 * kept + 0.02 * term.detach()

        return step

    def follow(self, decay: float) -> None:
        """Move the average toward the weights; at first it follows closely."""
        share = 1.0 - min(decay, (1.0 + self.step) / (10.0 + self.step))
        average = [p.detach() for p in self.average.parameters()]
        torch._foreach_lerp_(average, [p.detach() for p in self.network.parameters()], share)

    def validate(self, validation: Mapping[str, Sequence[PhotoBatch]]) -> None:
        """Measure the average, write a line of the curve, and keep it if it is the best so far."""
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
        """Write the state in files of at most 16 MiB, then remove the one before."""
        moments = {k: self.optimizer.state[p] for k, p in self.network.named_parameters()}
        held: dict[str, Mapping[str, Tensor]] = {
            "weights": self.network.state_dict(),
            "average": self.average.state_dict(),
            "first": {k: m["exp_avg"] for k, m in moments.items()},
            "second": {k: m["exp_avg_sq"] for k, m in moments.items()},
            "mean": self.mean.sums,
        }
        about = {
            "config": asdict(self.network.config),
            "step": self.step,
            "minutes": self.minutes,
            "best": self.best,
        }
        earlier = list(self.out.glob("state-*"))
        folder = self.out / f"state-{self.step:09d}"
        files = {
            f"{name}.safetensors": save(
                {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
            )
            for name, tensors in held.items()
        }
        write_folder(folder, [*files.items(), (STATE, json.dumps(about).encode())])
        for old in earlier:
            if old != folder:
                shutil.rmtree(old)

    def finish(
        self, validation: Mapping[str, Sequence[PhotoBatch]], record: Mapping[str, Any]
    ) -> dict[str, dict[str, float]]:
        """Calibrate the best average, write it, and return what it reaches."""
        device = self.network.directions.device
        network = load_regressor(self.out / BEST, device)
        network.mean_light.copy_(self.mean.flat())
        calibrate(network, self.loss, validation)
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
