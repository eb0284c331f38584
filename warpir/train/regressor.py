"""How the light regressor learns: its loss, what is done to its batches, and a resumable loop.

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
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed as dist
import torch.nn.functional as F
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor

from warpir.core.atomic import write_folder
from warpir.core.color import GAMMA, LUMINANCE_WEIGHTS
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.core.strict_json import read_json_object
from warpir.lighting.regressor import (
    AMBIENT_SHARPNESS,
    Prediction,
    Regressor,
    RegressorConfig,
    ambient_axes,
    least_angle,
    load_regressor,
    mean_luminance,
    random_regressor,
    save_regressor,
)
from warpir.scene.light import fibonacci
from warpir.train.batches import PhotoBatch

NORMALS = 32
"""Directions of surfaces whose irradiance is compared."""
MAP_FLOOR = 0.02
"""Ambient radiance over the mean luminance, below which differences fade."""
SUNNY_SHARE = 0.2
"""Share of the irradiance from which a dominant light counts as one."""
COVERAGE = 0.68
"""Share of the truth that the region of this probability shall hold."""
WEIGHTS, BEST, CURVE, STATE = (
    "regressor.safetensors",
    "best.safetensors",
    "curve.jsonl",
    "state.json",
)
STATE_FILES = ("weights", "average", "first", "second", "mean")
"""Parts of a state: the network, its average, Adam's two moments, sums of the training light."""


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained."""

    batch: int = 256
    learning_rate: float = 1e-3
    weight_decay: float = 0.05
    warmup_steps: int = 300
    """After every start: Adam's moments are kept, but the scenes are new."""
    constant_share: float = 0.5
    """Share of the planned training at full rate; then it falls linearly."""
    final_rate: float = 0.01
    """Share of the learning rate that is left at the end."""
    clip: float = 1.0
    """Largest norm of a step's gradient."""
    average: float = 0.9995
    """Decay of the moving average of the weights."""
    label_sigma_deg: float = 6.0
    """Width of the direction's soft label [deg]."""
    crop_share: float = 0.3
    """Share of photos of which a random part is stretched over the picture."""
    erase_share: float = 0.3
    """Chance of each of three patches to be painted over."""
    grey_share: float = 0.05
    """Share of photos without colour; their light has none either."""
    noise: float = 0.02
    """Largest standard deviation of noise on the encoded photo."""
    validate_minutes: float = 1.0
    save_minutes: float = 2.0
    compile: bool = False
    """``torch.compile`` on CUDA."""
    step_limit: int = 0
    """Steps after which the training is complete, whatever the clock says; 0: no such limit."""


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


# --------------------------------------------------------------------------------------- loss


class LightLoss:
    """Loss of a prediction, and the constants it needs.

    Args:
        network: Whose directions and layout.
        label_sigma_deg: Width of the direction's soft label [deg].
    """

    def __init__(self, network: Regressor, label_sigma_deg: float) -> None:
        device = network.directions.device
        self.directions = network.directions
        self.kappa = 1.0 / math.radians(label_sigma_deg) ** 2
        self.luminance = torch.tensor(LUMINANCE_WEIGHTS, device=device)
        texels = map_directions(8, 16).reshape(-1, 3)
        omega = np.repeat(texel_solid_angles(8, 16), 16)
        self.omega = torch.from_numpy(omega).float().to(device)
        """Solid angle of each texel of the ambient maps [sr], shape [128]."""
        # Mean of the lobes over each texel from 8 x 8 directions, weighted by solid angle.
        fine = np.exp(AMBIENT_SHARPNESS * (map_directions(64, 128) @ ambient_axes().T - 1.0))
        fine *= texel_solid_angles(64, 128)[:, None, None]
        mean = fine.reshape(8, 8, 16, 8, -1).sum(axis=(1, 3)).reshape(128, -1) / omega[:, None]
        self.lobe_map = torch.from_numpy(mean).float().to(device)
        """Radiance of each ambient lobe of amplitude 1 in each texel, shape [128, 14]."""
        cosine = np.maximum(fibonacci(NORMALS) @ texels.T, 0.0) * omega
        self.map_irradiance = torch.from_numpy(cosine).float().to(device)
        """From a map to the irradiance of the normals, shape [32, 128]."""

    def labels(self, axis: Tensor) -> Tensor:
        """Return soft labels: von Mises-Fisher about the truth, rows sum to 1, shape [B, K]."""
        return (self.kappa * (axis.float() @ self.directions.T)).softmax(dim=1)

    def ambient(self, prediction: Prediction) -> Tensor:
        """Return the predicted ambient map over the mean luminance, shape [B, 128, 3]."""
        return torch.einsum("tl,blc->btc", self.lobe_map, prediction.ambient.clamp(-12, 8).exp())

    def targets(self, batch: PhotoBatch) -> dict[str, Tensor]:
        """Return the truth in the terms of `Prediction`, and the weight of the dominant light."""
        scale = mean_luminance(batch.photo)
        sun = batch.sun.float().clamp(min=1e-6)
        red, green, blue = sun.unbind(dim=1)
        return {
            "labels": self.labels(batch.axis),
            "level": torch.log((sun @ self.luminance) / scale),
            "tint": torch.log(torch.stack([red / green, blue / green], dim=1)),
            "softness": torch.log(batch.sigma.float().clamp(1e-3, 1.0)),
            "share": batch.share.float().clamp(0.0, 1.0),
            "ambient": batch.ambient.float().flatten(1, 2) / scale[:, None, None],
            # Below this a direction means little to the picture, and the light may have none.
            "weight": (batch.share.float() / SUNNY_SHARE).clamp(0.0, 1.0),
        }

    def terms(self, prediction: Prediction, targets: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the parts of the loss by name, each of shape []."""
        weight = targets["weight"]
        total = weight.sum().clamp(min=1e-6)

        def of_sun(loss: Tensor) -> Tensor:
            return (loss * weight).sum() / total

        direction = -(targets["labels"] * prediction.logits.log_softmax(dim=1)).sum(dim=1)
        level = gaussian(prediction.level - targets["level"], prediction.level_log_var)
        tint = gaussian(prediction.tint - targets["tint"], prediction.tint_log_var).mean(dim=1)
        softness = gaussian(prediction.softness - targets["softness"], prediction.softness_log_var)
        share = F.binary_cross_entropy_with_logits(prediction.share, targets["share"])
        found, truth = self.ambient(prediction), targets["ambient"]
        error = self.irradiance_error(found, truth)
        radiance = torch.log((found + MAP_FLOOR) / (truth + MAP_FLOOR)).abs().mean(dim=2)
        return {
            "direction": of_sun(direction),
            "level": of_sun(level),
            "tint": of_sun(tint),
            "softness": of_sun(softness),
            "share": share,
            "irradiance": error.abs().mean(),
            "radiance": (radiance @ self.omega).mean() / (4.0 * math.pi),
            # The level's variance alone learns here: the lobes follow the two terms above.
            "ambient_level": gaussian(
                error.detach().mean(dim=(1, 2)), prediction.ambient_log_var
            ).mean(),
        }

    def irradiance_error(self, found: Tensor, truth: Tensor) -> Tensor:
        """Return the log ratio of two maps' irradiances, shape [B, 32, 3]."""
        floor = MAP_FLOOR * math.pi
        return torch.log(
            (self.map_irradiance @ found + floor) / (self.map_irradiance @ truth + floor)
        )


TERM_WEIGHTS = {
    "direction": 1.0,
    "level": 0.3,
    "tint": 0.15,
    "softness": 0.1,
    "share": 0.5,
    "irradiance": 1.0,
    "radiance": 0.3,
    "ambient_level": 0.1,
}


def gaussian(error: Tensor, log_var: Tensor) -> Tensor:
    """Return a Gaussian's negative log likelihood, weighted by its own standard deviation.

    The weight (beta = 1/2 of Seitzer et al. 2022, arXiv:2203.09168, eq. 5) has no gradient: without
    it, samples that are badly predicted stop to count and stay so.
    """
    loss = 0.5 * (error**2 * torch.exp(-log_var) + log_var)
    return loss * torch.exp(0.5 * log_var.detach())


# ---------------------------------------------------------------------------- augmentation


def mirror(batch: PhotoBatch, chosen: Tensor) -> PhotoBatch:
    """Mirror the chosen photos, and with them everything that has a left and a right.

    Args:
        batch: Photos and light.
        chosen: Which, bool, shape [B].
    """
    sign = batch.axis.new_tensor([-1.0, 1.0, 1.0])

    def turned(plain: Tensor, reflected: Tensor) -> Tensor:
        return torch.where(chosen.view(-1, *(1,) * (plain.dim() - 1)), reflected, plain)

    return PhotoBatch(
        photo=turned(batch.photo, batch.photo.flip(3)),
        rays=turned(batch.rays, batch.rays.flip(3) * sign.view(1, 3, 1, 1)),
        axis=turned(batch.axis, batch.axis * sign),
        share=batch.share,
        sun=batch.sun,
        sigma=batch.sigma,
        # x = sin(lon) and lon = pi (1 - 2u): negating x turns the columns about.
        ambient=turned(batch.ambient, batch.ambient.flip(2)),
        has_cue=batch.has_cue,
    )


def stretch(batch: PhotoBatch, chosen: Tensor, generator: torch.Generator) -> PhotoBatch:
    """Replace the chosen photos by a random part of them, brought to the full size.

    The rays come along, so the light stays what it is. It stands for other fields of view, other
    shapes of photo and principal points off the centre.

    Args:
        batch: Photos and light.
        chosen: Which, bool, shape [B].
        generator: Of the photos' device.
    """
    count, device = len(batch.photo), batch.photo.device

    def uniform(low: float, high: float) -> Tensor:
        drawn = torch.rand(count, 2, device=device, generator=generator)
        return low + (high - low) * drawn

    size = torch.where(chosen[:, None], uniform(0.5, 1.0), torch.ones((), device=device))
    centre = (1.0 - size) * uniform(-1.0, 1.0)
    theta = torch.zeros(count, 2, 3, device=device)
    theta[:, 0, 0], theta[:, 1, 1], theta[:, :, 2] = size[:, 0], size[:, 1], centre
    grid = F.affine_grid(theta, list(batch.photo.shape), align_corners=False)
    both = torch.cat([batch.photo, batch.rays], dim=1)
    both = F.grid_sample(both, grid, padding_mode="border", align_corners=False)
    return PhotoBatch(
        **_parts(batch) | {"photo": both[:, :3], "rays": F.normalize(both[:, 3:], dim=1)}
    )


def discolour(batch: PhotoBatch, chosen: Tensor) -> PhotoBatch:
    """Take the colour out of the chosen photos and of their light.

    Args:
        batch: Photos and light.
        chosen: Which, bool, shape [B].
    """
    weights = batch.photo.new_tensor(LUMINANCE_WEIGHTS)
    grey = torch.einsum("bchw,c->bhw", batch.photo.clamp(min=0.0) ** GAMMA, weights)
    grey = grey.clamp(min=0.0)[:, None].expand_as(batch.photo) ** (1.0 / GAMMA)
    sun = (batch.sun @ weights)[:, None].expand_as(batch.sun)
    ambient = (batch.ambient @ weights)[..., None].expand_as(batch.ambient)
    return PhotoBatch(
        **_parts(batch)
        | {
            "photo": torch.where(chosen[:, None, None, None], grey, batch.photo),
            "sun": torch.where(chosen[:, None], sun, batch.sun),
            "ambient": torch.where(chosen[:, None, None, None], ambient, batch.ambient),
        }
    )


def erase(photo: Tensor, share: float, generator: torch.Generator) -> Tensor:
    """Paint up to three random rectangles of each photo in one colour each (1708.04896).

    Args:
        photo: Display-encoded, shape [B, 3, H, W].
        share: Chance of each rectangle.
        generator: Of the photos' device.
    """
    count, _, height, width = photo.shape
    device = photo.device
    across = (torch.arange(width, device=device) + 0.5) / width
    down = (torch.arange(height, device=device) + 0.5) / height
    for _ in range(3):
        u = torch.rand(count, 8, device=device, generator=generator)
        half = 0.025 + 0.15 * u[:, :2]
        in_x = (across - u[:, 2:3]).abs() < half[:, :1]
        in_y = (down - u[:, 3:4]).abs() < half[:, 1:]
        covered = in_y[:, None, :, None] & in_x[:, None, None, :]
        covered = covered & (u[:, 4] < share)[:, None, None, None]
        photo = torch.where(covered, u[:, 5:, None, None], photo)
    return photo


def augment(
    batch: PhotoBatch, settings: TrainingSettings, generator: torch.Generator
) -> PhotoBatch:
    """Vary a batch in ways that keep photo and light consistent.

    Args:
        batch: Photos and light.
        settings: How often.
        generator: Of the photos' device.
    """
    device = batch.photo.device

    def chosen(share: float) -> Tensor:
        return torch.rand(len(batch.photo), device=device, generator=generator) < share

    batch = mirror(batch, chosen(0.5))
    batch = stretch(batch, chosen(settings.crop_share), generator)
    batch = discolour(batch, chosen(settings.grey_share))
    photo = erase(batch.photo, settings.erase_share, generator)
    size = torch.rand(len(photo), 1, 1, 1, device=device, generator=generator) * settings.noise
    photo = photo + size * torch.randn(photo.shape, device=device, generator=generator)
    return PhotoBatch(**_parts(batch) | {"photo": photo.clamp(0.0, 1.0)})


def _parts(batch: PhotoBatch) -> dict[str, Tensor]:
    return {f.name: getattr(batch, f.name) for f in fields(PhotoBatch)}


# ------------------------------------------------------------------------------ validation


@dataclass(frozen=True)
class _Answers:
    """Predictions for one validation set, mirror image included, and the truth."""

    prediction: Prediction
    targets: dict[str, Tensor]
    axis: Tensor
    counts: Tensor
    """Whether a photo's direction is judged: sunny, with a cue; bool, shape [B]."""


def _answers(network: Regressor, loss: LightLoss, batches: Sequence[PhotoBatch]) -> _Answers:
    predictions = [network.predict(b.photo, b.rays) for b in batches]
    targets = [loss.targets(b) for b in batches]
    return _Answers(
        Prediction(*(torch.cat(parts) for parts in zip(*predictions, strict=True))),
        {name: torch.cat([t[name] for t in targets]) for name in targets[0]},
        torch.cat([b.axis for b in batches]).float(),
        torch.cat([(b.share > SUNNY_SHARE) & b.has_cue for b in batches]),
    )


@torch.no_grad()
def measure(network: Regressor, loss: LightLoss, batches: Sequence[PhotoBatch]) -> dict[str, float]:
    """Return how well a network reads one validation set.

    Angles, their likelihood and coverage are over sunny photos with a cue.

    Args:
        network: In evaluation mode.
        loss: Of that network.
        batches: The set.
    """
    return _measure(_answers(network, loss, batches), loss)


def _measure(answers: _Answers, loss: LightLoss) -> dict[str, float]:
    prediction, targets, chosen = answers.prediction, answers.targets, answers.counts
    error = loss.irradiance_error(loss.ambient(prediction), targets["ambient"])
    measured = {
        "photos": float(len(chosen)),
        "sunny": float(chosen.sum()),
        "ambient_error": float(error.abs().mean()),
        "share_error": float((prediction.share.sigmoid() - targets["share"]).abs().mean()),
    }
    if not chosen.any():
        return measured
    probability = prediction.logits[chosen].softmax(dim=1)
    axis, spread = least_angle(loss.directions, probability)
    angle = torch.rad2deg(torch.acos((axis * answers.axis[chosen]).sum(1).clamp(-1.0, 1.0)))
    labels = targets["labels"][chosen]
    level = (prediction.level - targets["level"])[chosen]
    return measured | {
        "angle_median": float(angle.median()),
        "angle_mean": float(angle.mean()),
        "below_25_deg": float((angle < 25.0).float().mean()),
        "spread_mean": float(torch.rad2deg(spread).mean()),
        "nll": float(-(labels * prediction.logits[chosen].log_softmax(1)).sum(1).mean()),
        "coverage": float(
            (region_mass(loss.directions, probability, answers.axis[chosen]) <= COVERAGE)
            .float()
            .mean()
        ),
        "sun_error": float(level.abs().mean()),
        "sun_coverage": float(
            (level.abs() < torch.exp(0.5 * prediction.level_log_var[chosen])).float().mean()
        ),
    }


def score(validation: Mapping[str, Mapping[str, float]]) -> float:
    """Return what decides which weights are kept; lower is better.

    The mean over the sets of: mean angle / 30 degrees + log error of the dominant light's level / 2
    + log error of the ambient irradiance.
    """
    marks = [
        m.get("angle_mean", 0.0) / 30.0 + m.get("sun_error", 0.0) / 2.0 + m["ambient_error"]
        for m in validation.values()
    ]
    return sum(marks) / len(marks)


def region_mass(directions: Tensor, probability: Tensor, axis: Tensor) -> Tensor:
    """Return the mass of the smallest region that holds the truth, shape [B].

    Candidates are taken by falling probability; the truth's own counts half. For calibrated
    distributions these masses are uniform in [0, 1].

    Args:
        directions: Candidates, shape [K, 3].
        probability: Rows sum to 1, shape [B, K].
        axis: Truth, unit, shape [B, 3].
    """
    own = probability.gather(1, (axis @ directions.T).argmax(dim=1, keepdim=True))
    above = (probability * (probability > own)).sum(dim=1)
    return above + 0.5 * own[:, 0]


def calibrated_temperature(directions: Tensor, sets: Sequence[tuple[Tensor, Tensor]]) -> float:
    """Return the temperature at which the 68 % region holds the truth in 68 % of the photos.

    Coverage is the mean over the sets of each set's own, so that a large one does not decide.

    Args:
        directions: Candidates, shape [K, 3].
        sets: Logits [B, K] and true axes [B, 3] of each set.
    """
    found, gap = 1.0, math.inf
    for temperature in np.geomspace(0.5, 8.0, 100):
        covered = [
            float(
                (region_mass(directions, (logits / temperature).softmax(1), axis) <= COVERAGE)
                .float()
                .mean()
            )
            for logits, axis in sets
        ]
        distance = abs(sum(covered) / len(covered) - COVERAGE)
        if distance < gap:
            found, gap = float(temperature), distance
    return found


@torch.no_grad()
def calibrate(
    network: Regressor, loss: LightLoss, validation: Mapping[str, Sequence[PhotoBatch]]
) -> None:
    """Set the network's temperature and scale its variances, on sunny validation photos.

    A variance is scaled so that one standard deviation covers 68 %, by its head's bias; the sets'
    factors are averaged as logs.

    Args:
        network: In evaluation mode; changed in place.
        loss: Of that network.
        validation: Sets by name.
    """
    network.temperature.fill_(1.0)
    sets = [_answers(network, loss, batches) for batches in validation.values()]
    sunny = [a for a in sets if a.counts.any()]
    if sunny:
        pairs = [(a.prediction.logits[a.counts], a.axis[a.counts]) for a in sunny]
        network.temperature.fill_(calibrated_temperature(loss.directions, pairs))
    scales: dict[int, list[float]] = {}
    for a in sets:
        p, t = a.prediction, a.targets
        errors = [
            (1, p.level - t["level"], p.level_log_var, a.counts),
            (4, p.tint[:, 0] - t["tint"][:, 0], p.tint_log_var[:, 0], a.counts),
            (5, p.tint[:, 1] - t["tint"][:, 1], p.tint_log_var[:, 1], a.counts),
            (7, p.softness - t["softness"], p.softness_log_var, a.counts),
            (
                network.level_count - 1,
                loss.irradiance_error(loss.ambient(p), t["ambient"]).mean(dim=(1, 2)),
                p.ambient_log_var,
                torch.ones_like(a.counts),
            ),
        ]
        for place, error, log_var, counts in errors:
            if counts.any():
                z = (error.abs() * torch.exp(-0.5 * log_var))[counts]
                scales.setdefault(place, []).append(float(z.quantile(COVERAGE)))
    last = network.level_head[-1]
    assert isinstance(last, torch.nn.Linear)
    for place, found in scales.items():
        # The geometric mean: one place that is misread altogether must not decide for all photos.
        last.bias[place] += 2.0 * sum(math.log(max(z, 1e-3)) for z in found) / len(found)


# ------------------------------------------------------------------------------ mean light


class MeanLight:
    """Running mean of the training light, as one constant prediction.

    Args:
        loss: Of the network.
    """

    def __init__(self, loss: LightLoss) -> None:
        self.loss = loss
        self.sums: dict[str, Tensor] = {}

    def add(self, targets: Mapping[str, Tensor]) -> None:
        """Count a batch in; sunny photos count for the dominant light."""
        weight = targets["weight"]
        error = self.loss.map_irradiance @ targets["ambient"] + MAP_FLOOR * math.pi
        ambient_level = torch.log(error).mean(dim=(1, 2))
        parts = {
            "weight": weight.sum(),
            "count": torch.tensor(float(len(weight)), device=weight.device),
            "labels": weight @ targets["labels"],
            "level": weight @ targets["level"],
            "level_square": weight @ targets["level"] ** 2,
            "tint": weight @ targets["tint"],
            "tint_square": weight @ targets["tint"] ** 2,
            "softness": weight @ targets["softness"],
            "softness_square": weight @ targets["softness"] ** 2,
            "share": targets["share"].sum(),
            "ambient": torch.log(targets["ambient"] + MAP_FLOOR).sum(dim=0),
            "ambient_level": ambient_level.sum(),
            "ambient_level_square": (ambient_level**2).sum(),
        }
        for name, part in parts.items():
            kept = self.sums.get(name)
            self.sums[name] = part.double() if kept is None else kept + part

    def flat(self) -> Tensor:
        """Return the mean as `Regressor.mean_light` holds it, shape [K + level_count].

        Levels are means of logarithms; the ambient lobes are fitted to the mean log map.
        """
        from scipy.optimize import nnls

        s = self.sums
        weight, count = s["weight"].clamp(min=1e-6), s["count"]

        def log_var(name: str, total: Tensor) -> Tensor:
            mean = s[name] / total
            return torch.log((s[f"{name}_square"] / total - mean**2).clamp(min=1e-3))

        lobe_map = self.loss.lobe_map.double().cpu().numpy()
        root = self.loss.omega.double().sqrt().cpu().numpy()[:, None]
        radiance = torch.expm1(s["ambient"] / count - math.log(MAP_FLOOR)) * MAP_FLOOR
        fitted = [nnls(lobe_map * root, column)[0] for column in (radiance.cpu().numpy() * root).T]
        share = (s["share"] / count).clamp(1e-3, 1.0 - 1e-3)
        parts = [
            torch.log((s["labels"] / weight).clamp(min=1e-8)),
            (s["level"] / weight)[None],
            log_var("level", weight)[None],
            s["tint"] / weight,
            log_var("tint", weight),
            (s["softness"] / weight + 3.0)[None],
            log_var("softness", weight)[None],
            torch.logit(share)[None],
            torch.from_numpy(np.log(np.maximum(np.stack(fitted, axis=1), 1e-3)).ravel()),
            log_var("ambient_level", count)[None],
        ]
        return torch.cat([part.cpu().float() for part in parts])


# ---------------------------------------------------------------------------------- training


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
        if any(out.glob("state-*")):
            advice = "resume it, or give another folder"
            raise InputError(out, "holds a training that was begun", advice, ExitCode.OUTPUT)
        if peers.is_first:
            (out / CURVE).unlink(missing_ok=True)
        run = _Run(out, network or random_regressor(seed), settings, device)
    generator = torch.Generator(device)
    for draws in (generator, torch):
        draws.manual_seed((seed * 1_000_003 + run.step) * peers.count + peers.rank)
    is_cuda = torch.device(device).type == "cuda"
    if is_cuda:
        run.network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    trained = torch.compile(run.network) if settings.compile and is_cuda else run.network
    earlier, first = run.minutes, run.step
    validated = saved = began
    losses: dict[str, Tensor] = {}
    run.network.train()
    while True:
        run.minutes = earlier + peers.agree(time.monotonic() - began) / 60.0
        by_steps = run.step / settings.step_limit if settings.step_limit else 0.0
        progress = max(run.minutes / total_minutes, by_steps)
        if progress >= 1.0 or run.minutes - earlier >= minutes:
            break
        for group in run.optimizer.param_groups:
            group["lr"] = _rate(settings, progress, run.step - first)
        with torch.no_grad():
            batch = augment(batches(settings.batch, generator), settings, generator)
            targets = run.loss.targets(batch)
            run.mean.add(targets)
        with torch.autocast("cuda", torch.bfloat16) if is_cuda else nullcontext():
            flat = trained(batch.photo, batch.rays)
        terms = run.loss.terms(run.network.split(flat.float()), targets)
        run.optimizer.zero_grad(set_to_none=True)
        torch.stack([TERM_WEIGHTS[name] * term for name, term in terms.items()]).sum().backward()
        peers.average(run.network)
        torch.nn.utils.clip_grad_norm_(run.network.parameters(), settings.clip)
        run.optimizer.step()
        run.step += 1
        run.follow(settings.average)
        for name, term in terms.items():
            kept = losses.get(name, term.detach())
            losses[name] = 0.98 * kept + 0.02 * term.detach()
        if not peers.is_first:
            continue
        if time.monotonic() - validated >= 60.0 * settings.validate_minutes:
            run.validate(validation, losses)
            validated = time.monotonic()
        if time.monotonic() - saved >= 60.0 * settings.save_minutes:
            run.save()
            saved = time.monotonic()
    if not peers.is_first:
        peers.leave()
        return TrainingEnd(run.step, run.minutes, progress >= 1.0, {})
    if run.step > first:
        run.validate(validation, losses)
        run.save()
    known = dict(record or {}) | {"settings": asdict(settings), "seed": seed}
    known |= {"processes": peers.count}
    finished = run.finish(validation, known)
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
        self.step, self.minutes, self.best = 0, 0.0, math.inf

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

    def follow(self, decay: float) -> None:
        """Move the average toward the weights; at first it follows closely."""
        share = 1.0 - min(decay, (1.0 + self.step) / (10.0 + self.step))
        average = [p.detach() for p in self.average.parameters()]
        torch._foreach_lerp_(average, [p.detach() for p in self.network.parameters()], share)

    def validate(
        self, validation: Mapping[str, Sequence[PhotoBatch]], losses: Mapping[str, Tensor]
    ) -> None:
        """Measure the average, write a line of the curve, and keep it if it is the best so far."""
        measured = {k: measure(self.average, self.loss, v) for k, v in validation.items()}
        mark = score(measured)
        line = {
            "step": self.step,
            "minutes": round(self.minutes, 3),
            "score": mark,
            "losses": {name: float(value) for name, value in losses.items()},
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
