"""How well a regressor estimates the light of photos, and the calibration of its certainty."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from warpir.lighting.regressor import LEVEL_COUNT, Prediction, least_angle
from warpir.train.batches import PhotoBatch
from warpir.train.light_loss import SUNNY_SHARE, LightLoss
from warpir.train.networks.regressor import RegressorModule

COVERAGE = 0.68
"""Share of the truth that the region of this probability shall hold."""


@dataclass(frozen=True)
class _Answers:
    """Predictions for one validation set, mirror image included, and the truth."""

    prediction: Prediction
    targets: dict[str, Tensor]
    axis: Tensor
    counts: Tensor
    """Whether a photo's direction is judged: sunny, with a cue; bool, shape [B]."""


def _answers(network: RegressorModule, loss: LightLoss, batches: Sequence[PhotoBatch]) -> _Answers:
    predictions = [network.predict(b.photo, b.rays) for b in batches]
    targets = [loss.targets(b) for b in batches]
    return _Answers(
        Prediction(*(torch.cat(parts) for parts in zip(*predictions, strict=True))),
        {name: torch.cat([t[name] for t in targets]) for name in targets[0]},
        torch.cat([b.axis for b in batches]).float(),
        torch.cat([(b.share > SUNNY_SHARE) & b.has_cue for b in batches]),
    )


@torch.no_grad()
def measure(
    network: RegressorModule, loss: LightLoss, batches: Sequence[PhotoBatch]
) -> dict[str, float]:
    """Return how well a network reads one validation set.

    Angles, their likelihood and coverage are over sunny photos with a cue.
    """
    answers = _answers(network, loss, batches)
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
    axis, spread = centres(loss.directions, probability)
    angle = torch.rad2deg(torch.acos((axis * answers.axis[chosen]).sum(1).clamp(-1.0, 1.0)))
    labels = targets["labels"][chosen]
    level = (prediction.level - targets["level"])[chosen]
    return measured | {
        "angle_median": float(angle.median()),
        "angle_mean": float(angle.mean()),
        "below_25_deg": float((angle < 25.0).float().mean()),
        "spread_mean": float(torch.rad2deg(spread).mean()),
        "nll": float(-(labels * prediction.logits[chosen].log_softmax(1)).sum(1).mean()),
        "coverage": coverage(loss.directions, probability, answers.axis[chosen]),
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


def centres(directions: Tensor, probability: Tensor) -> tuple[Tensor, Tensor]:
    """Return `least_angle` of tensors, float32."""
    arrays = directions.double().cpu().numpy(), probability.double().cpu().numpy()
    axis, spread = (torch.from_numpy(part).to(directions) for part in least_angle(*arrays))
    return axis, spread


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


def coverage(directions: Tensor, probability: Tensor, axis: Tensor) -> float:
    """Return the share of truths in their regions of probability `COVERAGE`; see `region_mass`."""
    return float((region_mass(directions, probability, axis) <= COVERAGE).float().mean())


def calibrated_temperature(directions: Tensor, sets: Sequence[tuple[Tensor, Tensor]]) -> float:
    """Return the temperature at which the 68 % region holds the truth in 68 % of the photos.

    Coverage is the mean over the sets of each set's own, so that a large one does not decide.

    Args:
        directions: Candidates, shape [K, 3].
        sets: Logits [B, K] and true axes [B, 3] of each set.
    """

    def gap(temperature: float) -> float:
        covered = [coverage(directions, (x / temperature).softmax(1), axis) for x, axis in sets]
        return abs(sum(covered) / len(covered) - COVERAGE)

    return float(min(np.geomspace(0.25, 8.0, 126), key=gap))


@torch.no_grad()
def calibrate(
    network: RegressorModule, loss: LightLoss, validation: Mapping[str, Sequence[PhotoBatch]]
) -> None:
    """Set the network's temperature and scale its variances, on sunny validation photos.

    A variance is scaled so that one standard deviation covers 68 %, by its head's bias; the sets'
    factors are averaged as logs.
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
                LEVEL_COUNT - 1,
                loss.irradiance_error(loss.ambient(p), t["ambient"]).mean(dim=(1, 2)),
                p.ambient_log_var,
                torch.ones_like(a.counts),
            ),
        ]
        for place, error, log_var, counts in errors:
            if counts.any():
                z = (error.abs() * torch.exp(-0.5 * log_var))[counts]
                scales.setdefault(place, []).append(float(z.quantile(COVERAGE)))
    for place, found in scales.items():
        # The geometric mean: one place that is misread altogether must not decide for all photos.
        wider = 2.0 * sum(math.log(max(z, 1e-3)) for z in found) / len(found)
        for _, levels in network.last_layers():
            levels.bias[place] += wider
