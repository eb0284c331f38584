"""Light recovery from a photograph: model, personalisation, guidance, optimisation.

The result has the type of a given light (`warpir.lighting.scene_light.SceneLight`), so that the
final render and the files need not know where the light came from.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch

from warpir.app.run import Run
from warpir.core.cache import cache_folder
from warpir.core.memory import release
from warpir.diffusion.guidance import Guidance
from warpir.io.lamps_file import LAMPS, lamps_to_json
from warpir.io.lobes_file import lobes_to_json
from warpir.lighting.estimate import Estimate, estimate_light
from warpir.lighting.fit import fit_lobes
from warpir.lighting.regression import Regression
from warpir.lighting.regularizers import TrustRegion
from warpir.lighting.scene_light import SceneLight, start_level
from warpir.lighting.sg_light import narrowest
from warpir.optimize.acceptance import Verdict, blend, judge
from warpir.optimize.course import (
    Outcome,
    follow,
    make_frame,
    open_checkpoints,
    write_start,
)
from warpir.optimize.light import LightOptimization, Unknowns
from warpir.optimize.model import make_guide, prepare_guidance
from warpir.scene.light import Lobes, as_map, summarize
from warpir.scene.tone_curves import Curves

LIGHT_HEIGHT = 256
"""Rows of the delivered map."""
START_HEIGHT = 128
"""Rows of the map of a given light to which the start's lobes are fitted."""
CHECK_DRAWS = 16
"""Number of noises of the scores beside a verdict."""


@dataclass(frozen=True)
class Start:
    """Start of a recovery."""

    light: SceneLight
    """Given, default or estimated light."""
    estimate: Estimate | None = None
    """The regressor's estimate, if it is the start."""


def recover(run: Run, given: SceneLight | None, regression: Regression | None = None) -> Outcome:
    """Recover light and tone curves.

    Args:
        run: Configuration, inputs, output folder.
        given: Given or default light; None to estimate it from the photo.
        regression: What the regressor sees in the photo, where it is known.

    Returns:
        Light, curves and lamps; those of the start where the acceptance test fails.

    Raises:
        InputError: The model cannot be used (exit 4), memory is short (5), the numbers stayed
            non-finite (6), or what ``--resume`` finds is another run's.
    """
    settings = run.config.optimize
    start = Start(given) if given is not None else _estimated(run, regression)
    checkpoints = open_checkpoints(run)
    with run.timings.stage("scene"):
        frame = make_frame(run)
        unknowns = unknowns_of(run, start).to(run.device)
        region = region_of(start, unknowns)
    if settings.preview_every:
        with run.timings.stage("preview"):
            write_start(run, frame, start.light)
    guided = prepare_guidance(run, checkpoints)
    with run.timings.stage("trace"):
        release()
        guide = make_guide(run, guided, frame)
        graphs = guided.prior.graphs
        record = graphs.recorded_module if graphs else None
        cache = cache_folder("transport")
        loop = LightOptimization(
            frame, guide, settings, unknowns, cache, record=record, region=region
        )
    before = _state_of(unknowns)
    course = follow(run, loop, guided, guide, frame.renderer)
    judged = None
    if run.config.guidance.accept:
        assert isinstance(guide, Guidance)
        with run.timings.stage("accept"):
            judged = judge_end(loop, guide, before)
        run.log.say(judged.verdict.line)
    with run.timings.stage("write"):
        light = delivered(run, loop, start)
        course.write()
    measured = course.record(settings.integrator) | _measured(start, light, judged)
    notices = tuple(course.notices())
    if judged is not None and not judged.verdict.is_accepted:
        return Outcome(start.light, run.inputs, measured, (*notices, judged.verdict.line))
    run.output.write_json("lobes.json", lobes_to_json(unknowns.light_fg.lobes()))
    if settings.fusion != "single":
        run.output.write_json("lobes_shadow.json", lobes_to_json(unknowns.light_shadow.lobes()))
    inputs = run.inputs
    if unknowns.lamps is not None:
        inputs = replace(inputs, lamps=unknowns.lamps.found())
        run.output.write_json(LAMPS, lamps_to_json(inputs.lamps))
    return Outcome(light, inputs, measured, notices)


def _estimated(run: Run, regression: Regression | None) -> Start:
    """Return the regressor's estimate from the photo; log its assumptions."""
    light, tone = run.config.light, run.config.tone_operator
    with run.timings.stage("regress"):
        estimate = estimate_light(run.inputs, light, tone, regression)
    run.log.assume(*estimate.light.assumed)
    return Start(estimate.light, estimate)


def unknowns_of(run: Run, start: Start) -> Unknowns:
    """Return the unknowns: lobes of the given or estimated light, else an even light."""
    config, settings = run.config, run.config.optimize
    lobes, least = None, narrowest(settings.light_height)
    if start.estimate is not None:
        lobes = start.estimate.regression.lobes(least)
        lobes = replace(lobes, amplitude=(start.estimate.gain * lobes.amplitude).astype(np.float32))
    elif config.light.is_described:
        fitted = fit_lobes(as_map(start.light.light, START_HEIGHT), settings.lobes).lobes
        lobes = widened(fitted, least)
    level = start_level(run.inputs, config.tone_operator)
    return Unknowns.start(lobes, level, settings, run.inputs.lamps)


def region_of(start: Start, unknowns: Unknowns) -> TrustRegion | None:
    """Return the trust region around an estimated light; None without an estimate."""
    if start.estimate is None:
        return None
    regression = start.estimate.regression
    spread = float(np.radians(regression.spread_deg))
    light = unknowns.light_fg
    return TrustRegion.around(light, spread, regression.sun_log_std, regression.ambient_log_std)


def widened(lobes: Lobes, sigma_min: float) -> Lobes:
    """Return lobes that are no narrower than ``sigma_min`` [rad], of the same flux."""
    sharpness = np.minimum(lobes.sharpness, 1.0 / sigma_min**2).astype(np.float32)
    wide = Lobes(np.ones_like(lobes.amplitude), lobes.axis, sharpness)
    amplitude = (lobes.flux() / wide.flux()).astype(np.float32)
    return Lobes(amplitude, lobes.axis, sharpness)


def delivered(run: Run, loop: LightOptimization, start: Start) -> SceneLight:
    """Return light and curves at the loop's end."""
    light_fg, light_shadow = loop.final_lights(LIGHT_HEIGHT)
    fitted = loop.unknowns.curve_fg.plain(), loop.unknowns.curve_shadow.plain()
    curves = Curves(run.config.tone_operator, *fitted)
    return SceneLight(light_fg, light_shadow, curves, 0.0, start.light.assumed)


def _measured(start: Start, end: SceneLight, judged: Judged | None) -> dict[str, Any]:
    """Return the entries of ``run.json`` about start, end and acceptance."""
    measured: dict[str, Any] = {
        "start_light": asdict(summarize(start.light.light)),
        "end_light": asdict(summarize(end.light)),
    }
    if start.estimate is not None:
        measured = start.estimate.record() | measured
    if judged is not None:
        measured["acceptance"] = judged.record()
    return measured


@dataclass(frozen=True)
class Judged:
    """Acceptance verdict on a loop, and scores of both ends."""

    verdict: Verdict
    compared: dict[str, float | None]
    """Scores of both ends with common noises: of the run's own loss, and of the difference of the
    errors of the right and the wrong prompt where there is a wrong one."""

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``."""
        return self.verdict.record() | self.compared


def judge_end(loop: LightOptimization, guide: Guidance, before: dict[str, torch.Tensor]) -> Judged:
    """Test whether the loop's end is better than its start, by fresh evaluations of guidance.

    Args:
        loop: A finished loop; left unchanged.
        guide: Guidance of the loop.
        before: The unknowns at the start.
    """
    after = _state_of(loop.unknowns)

    def image(share: float) -> torch.Tensor:
        loop.unknowns.load_state_dict(blend(before, after, share))
        return loop.final_image(loop.seed)

    verdict = judge(guide, image)
    judges = {"score": guide}
    if guide.settings.negative_prompt and guide.settings.loss != "good-bad":
        judges["good_bad"] = guide.with_loss("good-bad")
    compared = {}
    with torch.no_grad():
        for end, share in (("start", 0.0), ("end", 1.0)):
            picture = image(share)
            for name, judging in judges.items():
                # The seed of no score that chose among the states.
                seed = loop.seed + 1
                compared[f"{name}_{end}"] = judging.score(picture, seed, CHECK_DRAWS)
    loop.unknowns.load_state_dict(after)
    return Judged(verdict, compared)


def _state_of(unknowns: Unknowns) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in unknowns.state_dict().items()}
