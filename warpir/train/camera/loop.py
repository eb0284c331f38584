"""The training of the network that estimates cameras; minutes on two cores.

Photographs are drawn first and only their features are kept, with those of their mirror images; the
rest of the time the network learns from them in random order. It is not resumed. The standard
deviations are calibrated on places that are only looked at.
"""

from __future__ import annotations

import copy
import json
import math
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from warpir.calibration.network import (
    NUMBERS,
    Calibrator,
    describe,
    random_calibrator,
    save_calibrator,
)
from warpir.train.camera.crops import Panoramas, draw_batch

WEIGHTS, CURVE = "calibrator.safetensors", "curve.jsonl"
NUMBER_WEIGHTS = {"pitch": 1.0, "roll": 1.0, "focal": 1.0, "x": 0.3, "y": 0.6}
"""Of each number's histogram in the loss."""
SCALES = {"pitch": 10.0, "roll": 5.0, "focal": 0.3, "x": 0.2, "y": 0.2}
"""Errors of each histogram's mean that weigh as much as 1 in the loss, in the number's units."""
GOALS = {"pitch": 3.0, "roll": 1.5, "vfov": 6.0}
"""Median errors that shall be reached [deg]; the score weighs errors by them."""
COVERAGE = 0.68
"""Share of errors within one standard deviation."""
SIGNS = {"roll": -1.0, "x": -1.0}
"""Of the numbers that the mirror image turns over, about 0 and .5."""
VALIDATION_SEED = 10**6


@dataclass(frozen=True)
class CameraSettings:
    """How the network is trained."""

    batch: int = 256
    """Photos of a step of the optimiser."""
    learning_rate: float = 1e-3
    weight_decay: float = 0.1
    warmup_steps: int = 100
    constant_share: float = 0.3
    """Share of the learning at full rate; then it falls along a cosine to 0."""
    average: float = 0.99
    """Decay of the moving average of the weights."""
    draw_share: float = 0.45
    """Share of the time in which photos are drawn."""
    known_share: float = 0.2
    """Share of photos whose focal length the network is given."""
    validate_steps: int = 500
    validation_photos: int = 2048


class Drawn(NamedTuple):
    """Photos that are reduced to what is learned from."""

    features: Tensor
    """Float16, shape [N, FEATURES]."""
    mirrored: Tensor
    """Of the mirror images, likewise."""
    numbers: Tensor
    """The truth, as `warpir.train.camera.crops.DrawnCameras.numbers`, shape [N, 5]."""


def draw_photos(
    panoramas: Panoramas, generator: torch.Generator, count: int = 2**30, until: float = math.inf
) -> Drawn:
    """Draw photos and describe them, at least one batch.

    Args:
        panoramas: To photograph.
        generator: Of their device.
        count: Photos, unless the time is over before.
        until: When to stop, on the monotonic clock [s].
    """
    parts: list[Drawn] = []
    while count > 0 and (not parts or time.monotonic() < until):
        batch = draw_batch(panoramas, min(64, count), generator)
        both = (describe(p, batch.aspect).half() for p in (batch.photo, batch.photo.flip(-1)))
        parts.append(Drawn(*both, batch.numbers))
        count -= len(batch.photo)
    return Drawn(*(torch.cat(column) for column in zip(*parts, strict=True)))


def train_camera(
    learned: Panoramas,
    watched: Panoramas,
    out: Path,
    settings: CameraSettings,
    minutes: float,
    seed: int = 0,
    network: Calibrator | None = None,
    record: Mapping[str, Any] | None = None,
) -> dict[str, float]:
    """Train until the time is over; write ``calibrator.safetensors`` and ``curve.jsonl`` to out.

    Args:
        learned: Panoramas to learn from, on the device that trains.
        watched: Others, of which only the errors are looked at: they choose which weights are kept,
            and calibrate the standard deviations.
        out: Folder of the results.
        settings: How.
        minutes: Time, on the wall clock.
        seed: Of the weights and the photos.
        network: To begin with; default: random weights.
        record: Put into the weights file beside what is known here; plain values.

    Returns:
        What `measure` finds on the places that are looked at.

    Raises:
        OSError: The results cannot be written.
    """
    out.mkdir(parents=True, exist_ok=True)
    (out / CURVE).unlink(missing_ok=True)
    began, device = time.monotonic(), learned.texels.device
    seeds = (VALIDATION_SEED, seed)
    unseen, drawing = (torch.Generator(device).manual_seed(k) for k in seeds)
    validation = draw_photos(watched, unseen, settings.validation_photos)
    until = began + 60.0 * minutes * settings.draw_share
    photos = draw_photos(learned, drawing, until=until)
    network = (network or random_calibrator(seed)).to(device).requires_grad_(True)
    network.mean.copy_(photos.features.float().mean(dim=0))
    # Features that hardly vary must not be blown up.
    network.deviation.copy_(photos.features.float().std(dim=0) + 0.05)
    run = _Learning(network, settings, seed)
    best, kept = math.inf, run.average
    learning, end = time.monotonic(), began + 60.0 * minutes
    is_over = False
    while not is_over:
        progress = (time.monotonic() - learning) / max(end - learning, 1e-3)
        is_over = progress >= 1.0
        run.step(photos, min(progress, 1.0))
        if not is_over and run.steps % settings.validate_steps:
            continue
        found = measure(run.average, validation)
        if found["score"] < best:
            best, kept = found["score"], copy.deepcopy(run.average)
        spent = round((time.monotonic() - began) / 60.0, 3)
        line = {"step": run.steps, "minutes": spent, "loss": run.loss} | found
        with (out / CURVE).open("a", encoding="utf-8") as curve:
            curve.write(json.dumps(line, allow_nan=False) + "\n")
    calibrate(kept, validation)
    finished = measure(kept, validation)
    known = {"settings": asdict(settings), "seed": seed, "photos": len(photos.numbers)}
    known |= {"steps": run.steps, "minutes": minutes, "validation": finished}
    save_calibrator(kept, out / WEIGHTS, dict(record or {}) | known)
    return finished


class _Learning:
    """The network, its moving average and its optimiser."""

    def __init__(self, network: Calibrator, settings: CameraSettings, seed: int) -> None:
        self.network, self.settings = network.train(), settings
        self.average = copy.deepcopy(network).eval().requires_grad_(False)
        self.optimizer = torch.optim.AdamW(
            network.parameters(), weight_decay=settings.weight_decay, betas=(0.9, 0.99)
        )
        self.generator = torch.Generator(network.spread.device).manual_seed(seed)
        torch.manual_seed(seed)
        self.steps, self.loss = 0, math.nan

    def step(self, photos: Drawn, progress: float) -> None:
        """Take a step of the optimiser, at a share of the learning's time."""
        settings, generator = self.settings, self.generator
        device = generator.device
        for group in self.optimizer.param_groups:
            group["lr"] = _rate(settings, progress, self.steps)
        count = len(photos.numbers)
        index = torch.randint(count, (settings.batch,), generator=generator, device=device)
        is_mirrored, is_known = (
            torch.rand(settings.batch, generator=generator, device=device) < share
            for share in (0.5, settings.known_share)
        )
        features = torch.where(
            is_mirrored[:, None], photos.mirrored[index], photos.features[index]
        ).float()
        numbers = photos.numbers[index]
        numbers = torch.where(is_mirrored[:, None], mirrored_numbers(numbers), numbers)
        focal = numbers[:, list(NUMBERS).index("focal")]
        given = torch.where(is_known, focal, torch.full_like(focal, math.nan))
        loss = camera_loss(self.network(features, given), numbers, ~is_known)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        self.optimizer.step()
        self.steps += 1
        value = float(loss.detach())
        self.loss = value if math.isnan(self.loss) else 0.98 * self.loss + 0.02 * value
        share = 1.0 - min(settings.average, (1.0 + self.steps) / (10.0 + self.steps))
        torch._foreach_lerp_(
            [p.detach() for p in self.average.parameters()],
            [p.detach() for p in self.network.parameters()],
            share,
        )


def _rate(settings: CameraSettings, progress: float, steps: int) -> float:
    """Return the learning rate: warm-up by steps, then constant, then a cosine down to 0."""
    left = min((1.0 - progress) / (1.0 - settings.constant_share), 1.0)
    share = 0.5 - 0.5 * math.cos(math.pi * left)
    return settings.learning_rate * share * min((steps + 1) / settings.warmup_steps, 1.0)


def mirrored_numbers(numbers: Tensor) -> Tensor:
    """Return the numbers of the mirror images, shape [B, 5]."""
    sign = numbers.new_tensor([SIGNS.get(name, 1.0) for name in NUMBERS])
    middle = numbers.new_tensor([0.5 if name == "x" else 0.0 for name in NUMBERS])
    return middle + sign * (numbers - middle)


def camera_loss(logits: Mapping[str, Tensor], numbers: Tensor, is_unknown: Tensor) -> Tensor:
    """Return the loss of predictions, shape [].

    Of each histogram the cross entropy, with the truth spread over the neighbouring bins by a
    Gaussian of one bin, and the error of its mean, which pulls from afar.

    Args:
        logits: By the names of `NUMBERS`, shape [B, K].
        numbers: The truth, shape [B, 5].
        is_unknown: Photos whose focal length was not given: that of others teaches nothing; [B].
    """
    total = numbers.new_zeros(())
    for (name, bins), truth in zip(NUMBERS.items(), numbers.T, strict=True):
        centres = bins.centres(truth)
        step = centres[1] - centres[0]
        labels = (-0.5 * ((centres - truth[:, None]) / step) ** 2).softmax(dim=1)
        log_share = logits[name].log_softmax(dim=1)
        entropy = -(labels * log_share).sum(dim=1)
        error = (log_share.exp() @ centres - truth).abs() / SCALES[name]
        weight = is_unknown.float() if name == "focal" else torch.ones_like(entropy)
        total = total + NUMBER_WEIGHTS[name] * ((entropy + error) * weight).mean()
    return total


def errors_of(network: Calibrator, photos: Drawn) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Return errors and standard deviations, by number, shape [N] each.

    Angles are in degrees, the focal length a vertical field of view; the principal point is in
    shares.
    """
    unknown = torch.full_like(photos.numbers[:, 0], math.nan)
    answer = network.answer(photos.features.float(), photos.mirrored.float(), unknown)
    error, spread = {}, {}
    columns = zip(NUMBERS, answer.value.T, photos.numbers.T, answer.sigma.T, strict=True)
    for name, found, true, width in columns:
        if name == "focal":
            fov, true_fov = (2.0 * torch.atan(0.5 * torch.exp(-x)) for x in (found, true))
            error["vfov"] = torch.rad2deg((fov - true_fov).abs())
            spread["vfov"] = torch.rad2deg(torch.sin(fov) * width)
        else:
            error[name], spread[name] = (found - true).abs(), width
    return error, spread


def measure(network: Calibrator, photos: Drawn) -> dict[str, float]:
    """Return median and mean errors, the share within one standard deviation, and a score."""
    error, spread = errors_of(network, photos)
    found = {}
    for name, e in error.items():
        found[f"{name}_median"], found[f"{name}_mean"] = float(e.median()), float(e.mean())
        found[f"{name}_covered"] = float((e <= spread[name]).float().mean())
    score = sum(found[f"{name}_mean"] / goal for name, goal in GOALS.items()) / len(GOALS)
    return found | {"score": score}


def calibrate(network: Calibrator, photos: Drawn) -> None:
    """Set the network's spread, so that 68 % of errors of each angle lie within one sigma.

    The principal point keeps its distribution's own width: most photos are centred, and a factor
    that suits those would make the network look sure of the others.
    """
    network.spread.fill_(1.0)
    error, spread = errors_of(network, photos)
    for place, name in enumerate(error):
        if name in GOALS:
            ratio = error[name] / spread[name].clamp(min=1e-6)
            network.spread[place] = torch.quantile(ratio, COVERAGE)
