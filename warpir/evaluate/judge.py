"""Errors of every row's light and of its composites, place by place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from warpir.core.arrays import BoolArray, FloatArray
from warpir.core.color import codes_of
from warpir.evaluate.image_errors import Distance, image_errors, make_regions
from warpir.evaluate.light_errors import light_errors
from warpir.evaluate.report import Entry, bootstrap
from warpir.evaluate.results import Panel
from warpir.evaluate.rows import ROWS
from warpir.evaluate.scenes import Place, Subject
from warpir.evaluate.stage import Bench, Prediction, Stage
from warpir.evaluate.three_spheres import sphere_errors
from warpir.lighting.regressor import split
from warpir.render.picture.quality import Quality
from warpir.scene.light import as_map
from warpir.train.lights import load_panoramas
from warpir.train.networks.regressor import RegressorModule
from warpir.train.scenes.generator import Mixture, SceneGenerator
from warpir.train.validation import COVERAGE, centres

LIGHT_HEIGHT = 128
"""Rows of the maps that are compared."""
UNSEEN_SEED = 0xE7A1
"""Added to the seed of rendered photographs; training and its validation use others."""
PROCEDURAL_BATCH = 64
"""Number of photographs rendered at once."""


@dataclass(frozen=True)
class Judge:
    """Computes the errors of the rows, place by place."""

    bench: Bench
    """Scenes and models of the rows."""
    rows: Sequence[str]
    """Names of the rows."""
    samples: int
    """Camera samples per pixel."""
    threads: int
    """Threads on the CPU; 0 for one per core."""
    lpips: Distance | None
    """The perceptual distance."""
    sheet_row: str
    """Row on the contact sheet."""
    kinds: Mapping[str, str]
    """Kind of place by the panorama's name."""

    def place(self, place: Place, subjects: list[Subject]) -> tuple[list[Entry], list[Panel]]:
        """Return the errors of every row in one place, and its panels of the contact sheet."""
        quality = Quality(self.samples, 2, 5, self.bench.seed, 8.0)
        entries, panels = [], []
        rows = list(self.rows)
        if "predictions" in rows and place.name not in self.bench.predictions:
            rows.remove("predictions")
        of_place: dict[str, tuple[Prediction, FloatArray, dict[str, float]]] = {}
        for subject in subjects:
            stage = Stage(subject, self.bench.device, quality, self.threads)
            regions = make_regions(stage.mask, stage.ratio)
            lights: dict[str, FloatArray] = {}
            for name in rows:
                row = ROWS[name]
                if row.of_subject is not None:
                    judged = _judge_light(place, row.of_subject(self.bench, stage, subject))
                else:
                    if name not in of_place:
                        assert row.of_place is not None
                        of_place[name] = _judge_light(place, row.of_place(self.bench, place))
                    judged = of_place[name]
                prediction, lights[name], of_light = judged
                figures = dict(of_light)
                if row.same_as in lights:
                    same = light_errors(lights[name], lights[row.same_as])
                    figures["light.same_deg"] = same["peak_angle_deg"]
                image, errors = self._judge_picture(stage, prediction, regions)
                figures |= errors
                entries.append(
                    Entry(
                        name, place.name, place.panorama, place.is_sunny, subject.material,
                        figures, prediction.about, self.kinds.get(place.panorama, ""),
                    )
                )  # fmt: skip
                if name == self.sheet_row:
                    pictures = (place.photo, image, stage.truth)
                    error = figures["image.box.rmse"]
                    panels.append(Panel(subject.name, error, *map(codes_of, pictures)))
        return entries, panels

    def _judge_picture(
        self, stage: Stage, prediction: Prediction, regions: dict[str, BoolArray]
    ) -> tuple[FloatArray, dict[str, float]]:
        """Return the picture under a light, and its errors as it is and at the best exposure."""
        rendered = stage.render(prediction)
        image = stage.compose(rendered, prediction.curves)
        figures = _flat("image", image_errors(image, stage.truth, regions, self.lpips))
        gain = stage.fit_exposure(rendered, prediction.curves)
        fitted = stage.compose(rendered, prediction.curves, gain)
        figures |= _flat("fitted", image_errors(fitted, stage.truth, regions, self.lpips))
        figures["fitted.ev"] = float(np.log2(gain))
        return image, figures


def _judge_light(
    place: Place, prediction: Prediction
) -> tuple[Prediction, FloatArray, dict[str, float]]:
    texels = as_map(prediction.light, LIGHT_HEIGHT)
    figures = light_figures(place, texels)
    if "truth_mass" in prediction.about:
        figures["light.in_region"] = float(prediction.about["truth_mass"] <= COVERAGE)
    return prediction, texels, figures


def light_figures(place: Place, texels: FloatArray) -> dict[str, float]:
    """Return the errors of a lat-long light, world frame: ``light.*`` and ``spheres.*``."""
    predicted, true = place.to_camera(texels), place.to_camera(place.texels)
    errors = light_errors(predicted, true)
    for name in [n for n in errors if n.startswith("log_")]:
        errors[f"abs_{name}"] = abs(errors[name])
    return _flat("", {"light": errors, "spheres": sphere_errors(predicted, true)})


def procedural_errors(
    network: RegressorModule, count: int, seed: int
) -> dict[str, dict[str, float]]:
    """Return how well the regressor finds the direction in rendered photographs never seen.

    Returns:
        Angle between found and true dominant direction [deg]: median, mean and 95 % interval of the
        mean, of the photographs with a visible cue and of those without; beside it that of a guess,
        the direction of the mean training light.
    """
    where = network.directions.device
    scenes = SceneGenerator(
        load_panoramas([], where), UNSEEN_SEED + seed, Mixture(made_up=1.0, hybrid=0.0)
    )
    mean_light = split(network.mean_light[None])
    guess, _ = centres(network.directions, mean_light.logits.softmax(dim=1))
    angles: dict[str, list[float]] = {"found": [], "guessed": []}
    cues: list[bool] = []
    for index, first in enumerate(range(0, count, PROCEDURAL_BATCH)):
        batch = scenes.photo_batch(index, PROCEDURAL_BATCH)
        prediction = network.predict(batch.photo, batch.rays)
        axis, _ = centres(network.directions, prediction.logits.softmax(dim=1))
        wanted = min(PROCEDURAL_BATCH, count - first)
        cues += batch.has_cue[:wanted].tolist()
        for name, directions in (("found", axis), ("guessed", guess.expand_as(axis))):
            cosine = (directions * batch.axis).sum(dim=1).clamp(-1.0, 1.0)
            angles[name] += torch.rad2deg(torch.acos(cosine))[:wanted].tolist()
    return {
        f"{name}, {words}": _spread([a for a, c in zip(values, cues, strict=True) if c == is_cue])
        for name, values in angles.items()
        for words, is_cue in (("visible cue", True), ("no cue", False))
        if is_cue in cues
    }


def _spread(angles: list[float]) -> dict[str, float]:
    low, high = bootstrap(angles, [str(k) for k in range(len(angles))], rounds=1000)
    return {
        "median_deg": float(np.median(angles)),
        "mean_deg": float(np.mean(angles)),
        "mean_low_deg": low,
        "mean_high_deg": high,
        "count": len(angles),
    }


def _flat(prefix: str, nested: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return nested figures by dotted name."""
    start = f"{prefix}." if prefix else ""
    return {f"{start}{k}.{n}": v for k, errors in nested.items() for n, v in errors.items()}
