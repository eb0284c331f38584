"""The loss of a predicted light, and the mean light of a training set."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from warpir.core.color import LUMINANCE_WEIGHTS
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.lighting.regressor import AMBIENT_SHARPNESS, Prediction, ambient_axes
from warpir.scene.light import fibonacci
from warpir.train.batches import PhotoBatch
from warpir.train.networks.regressor import RegressorModule, mean_luminance

NORMALS = 32
"""Directions of surfaces whose irradiance is compared."""
MAP_FLOOR = 0.02
"""Ambient radiance over the mean luminance, below which differences fade."""
SUNNY_SHARE = 0.2
"""Share of the irradiance from which a dominant light counts as one."""
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
"""Of each term of the loss."""


class LightLoss:
    """Loss of a prediction, and the constants it needs.

    Args:
        network: Whose directions and layout.
        label_sigma_deg: Width of the direction's soft label [deg].
    """

    def __init__(self, network: RegressorModule, label_sigma_deg: float) -> None:
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


def gaussian(error: Tensor, log_var: Tensor) -> Tensor:
    """Return a Gaussian's negative log likelihood, weighted by its own standard deviation.

    The weight (beta = 1/2 of Seitzer et al. 2022, arXiv:2203.09168, eq. 5) has no gradient: without
    it, samples that are badly predicted stop to count and stay so.
    """
    loss = 0.5 * (error**2 * torch.exp(-log_var) + log_var)
    return loss * torch.exp(0.5 * log_var.detach())


class MeanLight:
    """Running mean of the training light, as one constant prediction."""

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
            "share": targets["share"].sum(),
            "ambient": torch.log(targets["ambient"] + MAP_FLOOR).sum(dim=0),
            "ambient_level": ambient_level.sum(),
            "ambient_level_square": (ambient_level**2).sum(),
        }
        for name in ("level", "tint", "softness"):
            parts[name] = weight @ targets[name]
            parts[f"{name}_square"] = weight @ targets[name] ** 2
        for name, part in parts.items():
            kept = self.sums.get(name)
            self.sums[name] = part.double() if kept is None else kept + part

    def flat(self) -> Tensor:
        """Return the mean as `RegressorModule.mean_light` holds it, shape [K + LEVEL_COUNT].

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
