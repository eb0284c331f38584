"""The training loop of the network that estimates cameras.

It takes minutes, so it is not resumed; a training that shall go on starts from the weights of
another. A signal ends it early, with what it has until then; a second one at once. What is kept is
the best moving average of the weights on places that are only looked at.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from warpir.app.program import say
from warpir.calibration.network import NUMBERS
from warpir.core import signals
from warpir.train.camera.crops import CameraBatch, Panoramas, draw_batch
from warpir.train.networks.calibrator import (
    CalibratorModule,
    random_calibrator,
    save_calibrator,
)
from warpir.train.networks.regressor import RegressorModule
from warpir.train.stepping import CameraSettings, follow, left_to_fall, make_optimizer, warmed_up

WEIGHTS, CURVE = "calibrator.safetensors", "curve.jsonl"
NUMBER_WEIGHTS = {"pitch": 1.0, "roll": 1.0, "focal": 1.0, "x": 0.3, "y": 0.6}
"""Of each number's histogram in the loss."""
FIELD_WEIGHT = 2.0
"""Of the perspective field's errors, in radians, in the loss."""
GOALS = {"pitch": 3.0, "roll": 1.5, "vfov": 6.0}
"""Median errors that shall be reached [deg]; the score weighs errors by them."""
COVERAGE = 0.68
"""Share of errors within one standard deviation."""
VALIDATION_SEED = 10**6


def train_camera(
    learned: Panoramas,
    watched: Panoramas | None,
    out: Path,
    settings: CameraSettings,
    device: torch.device,
    minutes: float,
    seed: int = 0,
    start: CalibratorModule | None = None,
    record: Mapping[str, Any] | None = None,
) -> dict[str, float]:
    """Train until the time is over; write ``calibrator.safetensors`` and ``curve.jsonl`` to out.

    Args:
        learned: Panoramas to learn from.
        watched: Others, of which only the errors are looked at: they choose which weights are kept,
            and calibrate the standard deviations. None: the last weights are kept, with the
            calibration of ``start``.
        out: Folder of the results.
        settings: Of the optimiser, its schedule and the validation.
        device: Of the panoramas, the network and its training.
        minutes: Time, on the wall clock.
        seed: Of the weights and the photos.
        start: Network to begin with; default: random weights.
        record: Put into the weights file beside what is known here; plain values.

    Returns:
        What `measure` finds on the places that are looked at; without any, nothing.

    Raises:
        OSError: The results cannot be written.
        Stopped: A signal has ended it; what was trained is in ``out``.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / CURVE).unlink(missing_ok=True)
    network = (start or random_calibrator(seed)).to(device).requires_grad_(True)
    known = dict(record or {}) | {"settings": asdict(settings), "seed": seed}
    validation = (
        [] if watched is None else validation_batches(watched, settings.validation_photos, device)
    )
    course = _Course(network, validation, out / CURVE)
    step = _step_of(network, settings)
    generator = torch.Generator(device).manual_seed(seed)
    torch.manual_seed(seed)
    began = validated = time.monotonic()
    with signals.deferred():
        while (progress := (time.monotonic() - began) / (60.0 * minutes)) < 1.0:
            with torch.no_grad():
                batch = draw_batch(learned, settings.batch, generator)
            course.follow(step(batch, _rate(settings, progress, course.steps)), settings.average)
            if signals.is_pending():
                break
            if validation and time.monotonic() - validated >= 60.0 * settings.validate_minutes:
                course.validate(progress * minutes)
                validated = time.monotonic()
        minutes *= min(progress, 1.0)
        finished = course.finish(minutes)
        known |= {"steps": course.steps, "minutes": minutes, "validation": finished}
        save_calibrator(course.kept, out / WEIGHTS, known)
    return finished


class _Course:
    """A training as it goes: the moving average of the weights, and the best one so far."""

    def __init__(
        self, network: CalibratorModule, validation: Sequence[CameraBatch], curve: Path
    ) -> None:
        self.network, self.validation, self.curve = network, validation, curve
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        self.kept, self.best, self.steps = self.average, math.inf, 0
        self.loss = torch.full((), math.nan, device=network.spread.device)

    def follow(self, loss: Tensor, decay: float) -> None:
        """Move the average toward the weights after a step."""
        self.loss = torch.where(self.loss.isnan(), loss, self.loss.lerp(loss, 0.05))
        follow(self.average, self.network, self.steps, decay)
        self.steps += 1

    def validate(self, minutes: float) -> None:
        """Measure the average, write a line of the curve, and keep it if it is the best so far."""
        say(f"step {self.steps}, {minutes:.1f} minutes: validating")  # on a CPU it takes minutes
        found = measure(self.average, self.validation)
        if found["score"] < self.best:
            self.kept, self.best = copy.deepcopy(self.average), found["score"]
        line = {"step": self.steps, "minutes": round(minutes, 3), "loss": float(self.loss)} | found
        with self.curve.open("a", encoding="utf-8") as curve:
            curve.write(json.dumps(line, allow_nan=False) + "\n")

    def finish(self, minutes: float) -> dict[str, float]:
        """Calibrate the best average and return what it reaches; nothing without validation."""
        if not self.validation:
            return {}
        self.validate(minutes)
        calibrate(self.kept, self.validation)
        return measure(self.kept, self.validation)


def _rate(settings: CameraSettings, progress: float, steps: int) -> float:
    """Return the learning rate: warm-up by steps, then constant, then a cosine down to 0."""
    share = 0.5 - 0.5 * math.cos(math.pi * left_to_fall(settings, progress))
    return warmed_up(settings, share, steps)


def _step_of(
    network: CalibratorModule, settings: CameraSettings
) -> Callable[[CameraBatch, float], Tensor]:
    """Return what takes a step of the optimiser on a batch, at a rate, and returns the loss."""
    is_cuda = network.spread.is_cuda
    if is_cuda:
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = make_optimizer(network, settings, fused=is_cuda)
    network.train()

    def step(batch: CameraBatch, rate: float) -> Tensor:
        for group in optimizer.param_groups:
            group["lr"] = rate
        with torch.autocast("cuda", torch.bfloat16) if is_cuda else nullcontext():
            logits, field = network(batch.photo, batch.aspect, batch.focal)
        loss = camera_loss(logits, field, batch)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), settings.clip)
        optimizer.step()
        return loss.detach()

    return step


def camera_loss(logits: Mapping[str, Tensor], field: Tensor, batch: CameraBatch) -> Tensor:
    """Return the loss of predictions: cross entropies of the histograms, and the field's errors.

    The truth of a histogram is spread over the neighbouring bins, by a Gaussian of one bin.
    """
    total = torch.zeros((), device=field.device)
    for (name, bins), truth in zip(NUMBERS.items(), batch.numbers.T, strict=True):
        centres = torch.from_numpy(bins.centres()).to(truth)
        step = centres[1] - centres[0]
        labels = (-0.5 * ((centres - truth[:, None]) / step) ** 2).softmax(dim=1)
        entropy = -(labels * logits[name].float().log_softmax(dim=1)).sum(dim=1)
        # A focal length that was given teaches nothing.
        weight = batch.focal.isnan().float() if name == "focal" else torch.ones_like(entropy)
        total = total + NUMBER_WEIGHTS[name] * (entropy * weight).mean()
    up = F.normalize(field[..., :2], dim=-1, eps=1e-4)
    off = (up - batch.field[..., :2]).norm(dim=-1) + (field[..., 2] - batch.field[..., 2]).abs()
    loss: Tensor = total + FIELD_WEIGHT * off.mean()
    return loss


def validation_batches(
    watched: Panoramas, count: int, device: torch.device
) -> Sequence[CameraBatch]:
    """Return photos that are the same in every training, without known focal lengths."""
    generator = torch.Generator(device).manual_seed(VALIDATION_SEED)
    sizes = [min(128, count - first) for first in range(0, count, 128)]
    drawn = [draw_batch(watched, size, generator) for size in sizes]
    return [batch._replace(focal=torch.full_like(batch.focal, math.nan)) for batch in drawn]


def errors_of(
    network: CalibratorModule, batches: Sequence[CameraBatch]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return errors and standard deviations, by number, shape [count] each.

    Angles are in degrees, the focal length a vertical field of view; the principal point is in
    shares.
    """
    answers = [network.predict(b.photo, b.aspect, b.focal) for b in batches]
    value, sigma = (torch.cat(parts).T for parts in zip(*answers, strict=True))
    truth = torch.cat([b.numbers for b in batches]).T
    error, spread = {}, {}
    for name, found, true, width in zip(NUMBERS, value, truth, sigma, strict=True):
        if name == "focal":
            fov, true_fov = (2.0 * torch.atan(0.5 * torch.exp(-x)) for x in (found, true))
            error["vfov"] = torch.rad2deg((fov - true_fov).abs())
            spread["vfov"] = torch.rad2deg(torch.sin(fov) * width)
        else:
            error[name], spread[name] = (found - true).abs(), width
    return error, spread


def measure(network: CalibratorModule, batches: Sequence[CameraBatch]) -> dict[str, float]:
    """Return median errors, the share within one standard deviation, and a score, by name."""
    error, spread = errors_of(network, batches)
    found = {f"{name}_median": float(e.median()) for name, e in error.items()}
    for name, e in error.items():
        found[f"{name}_covered"] = float((e <= spread[name]).float().mean())
    score = sum(found[f"{name}_median"] / goal for name, goal in GOALS.items()) / len(GOALS)
    return found | {"score": score}


def calibrate(network: CalibratorModule, batches: Sequence[CameraBatch]) -> None:
    """Set the network's spread, so that 68 % of errors of each angle lie within one sigma.

    The principal point keeps its distribution's own width: most photos are centred, and a factor
    that suits those would make the network look sure of the others.
    """
    network.spread.fill_(1.0)
    error, spread = errors_of(network, batches)
    for place, name in enumerate(error):
        if name in GOALS:
            ratio = error[name] / spread[name].clamp(min=1e-6)
            network.spread[place] = torch.quantile(ratio, COVERAGE)


def begin_with_trunk(network: CalibratorModule, regressor: RegressorModule) -> None:
    """Copy the convolutions of a light regressor into a network, as far as both have them.

    What the regressor has learned to see of a photo teaches the camera too: from random weights the
    same training takes far longer.

    Args:
        network: Changed in place; the coordinates that it sees beside the photo begin with 0.
        regressor: Its first member is taken; of the same sizes at 1/2 and 1/4.
    """
    # These share their memory with the parameters.
    own, trunk = network.state_dict(), regressor.members[0].state_dict()
    colours = 3 * 4
    own["stem.weight"][:, colours:] = 0.0
    own["stem.weight"][:, :colours] = trunk["stem.weight"][:, :colours]
    for name, part in trunk.items():
        if name == "stem.bias" or name.startswith(("fine.", "down1.", "middle.")):
            own[name].copy_(part)
    for name in ("down2.weight", "down2.bias"):
        wide = min(len(own[name]), len(trunk[name]))
        own[name][:wide] = trunk[name][:wide]
