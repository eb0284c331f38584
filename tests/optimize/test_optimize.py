"""The optimisation loop on a ball of a few hundred pixels: its gradient, its state, its schedules.

What stands in for guidance is a fixed image gradient, a target image, or one that fails on purpose.
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tests import oracles as o
from tests.builders.loops import (
    HEIGHT,
    RATES,
    ROWS,
    SETTINGS,
    TRACED,
    WIDTH,
    Pull,
    a_frame,
    a_loop,
    bent,
    values,
)
from tests.statistics import central_differences, compare_gradients
from warpir.core.arrays import Float64Array
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.prior import BAD_STEPS_MAX
from warpir.lighting.sg_light import WIDEST
from warpir.optimize import light as light_optimization
from warpir.optimize.light import LightOptimization
from warpir.optimize.view import View, expected_light
from warpir.render.transport.rows import TransportSettings

RELATIVE_L2, COSINE = 0.01, 0.9999
"""Of whole gradients. Measured: 0.004, of which half is the step's and half float32's noise."""
MIS_COSINE, MIS_BIAS = 0.99, 0.02
"""Asked of `transport` against `mis`, as in `tests.render.test_transport`; three runs of each."""
pytestmark = pytest.mark.usefixtures("one_thread")


class NoisyPull(Pull):
    """Draws its gradients from a generator of its own, which is its state; darker scores better."""

    def __init__(self) -> None:
        super().__init__()
        self.generator = torch.Generator().manual_seed(4)

    def gradient(self, image: Tensor, step: int) -> Tensor:
        return torch.randn(image.shape, generator=self.generator).to(image.device) + 0.1

    def score(self, image: Tensor) -> float:
        return float(image.mean())

    def state_dict(self) -> dict[str, Any]:
        return {"generator": self.generator.get_state()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.generator.set_state(state["generator"])


class Faulty(Pull):
    """Has no gradient at some steps: none, or one with a NaN or an infinity in one pixel."""

    def __init__(
        self, bad: set[int], value: float | None = None, pixel: tuple[int, int] = (0, 0)
    ) -> None:
        super().__init__()
        self.bad, self.value, self.pixel = bad, value, pixel

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        if step not in self.bad:
            return super().gradient(image, step)
        if self.value is None:
            return None
        planted = self.d_image.clone()
        planted[0, 1, self.pixel[0], self.pixel[1]] = self.value
        return planted.to(image.device)


class Scored(Pull):
    """Hands out prepared scores."""

    def __init__(self, scores: list[float]) -> None:
        super().__init__()
        self.scores = iter(scores)

    def score(self, image: Tensor) -> float:
        return next(self.scores)


def changed(loop: LightOptimization, before: dict[str, Tensor]) -> set[str]:
    """Names of the parameters that are not bit-identical to a copy."""
    now = loop.unknowns.state_dict()
    return {name for name, value in before.items() if not torch.equal(value, now[name])}


# --------------------------------------------------------------------------- the gradient


def check_gradient(loop: LightOptimization, step: int, names: tuple[str, ...]) -> None:
    """Compare what Adam reads after a step with central differences of all that it descends.

    The loop must leave out the terms that detach a part of themselves: no function has their
    gradient.
    """
    assert loop.settings.consistency == loop.settings.chroma == 0.0
    guide, before = loop.guide, values(loop)
    assert isinstance(guide, Pull)
    loop.state.step = step
    loop.step()
    read = {name: p.grad for name, p in loop.unknowns.named_parameters()}
    loop.unknowns.load_state_dict(before)

    def objective() -> float:
        with torch.no_grad():
            composite = loop.composite(step)
            image = composite.image.cpu().double()
            terms = sum(weight * float(term) for weight, term in composite.terms.values())
        return float((guide.d_image.double() * image).sum()) + terms

    for name, parameter in loop.unknowns.named_parameters():
        if not name.startswith(names):
            continue
        start = parameter.detach().double().cpu().numpy()

        def moved(
            values: Float64Array, start: Float64Array = start, parameter: Tensor = parameter
        ) -> float:
            with torch.no_grad():
                parameter.copy_(torch.from_numpy(values))
                result = objective()
                parameter.copy_(torch.from_numpy(start))
            return result

        gradient = read[name]
        assert gradient is not None, name
        match = compare_gradients(
            gradient.double().cpu().numpy(), central_differences(moved, start, 1e-2)
        )
        assert match.relative_l2 <= RELATIVE_L2 and match.cosine >= COSINE, (name, match)


@pytest.mark.parametrize("step", [0, 1, 2])
def test_gradient_against_central_differences(device: str, step: int) -> None:
    """Raw parameters to image and terms, at fusion 0, 0.5 and 1; transport's rows are frozen."""
    settings = replace(SETTINGS, steps=3, consistency=0.0, chroma=0.0)
    loop = a_loop(device, settings=settings, unknowns=bent())
    assert loop.fusion(step) == 0.5 * step
    check_gradient(loop, step, ("light", "curve") if step == 1 else ("light",))


@pytest.mark.parametrize("fusion", ["single", "none"])
def test_gradient_without_fusion_against_central_differences(device: str, fusion: str) -> None:
    """One light from the start, and two to the end."""
    settings = replace(SETTINGS, fusion=fusion, consistency=0.0, chroma=0.0)
    loop = a_loop(device, settings=settings, unknowns=bent())
    check_gradient(loop, 1, ("light_fg",) if fusion == "single" else ("light",))
    for name, parameter in loop.unknowns.named_parameters():
        is_idle = fusion == "single" and name.startswith("light_shadow")
        has_gradient = parameter.grad is not None and bool(parameter.grad.any())
        assert has_gradient != is_idle, name


def test_gradient_of_mis_is_that_of_transport(device: str) -> None:
    """Both integrators send the optimiser the same way: their mean gradients agree."""
    finer = replace(TRACED, subsamples=32, paths=128, bright_directions=512)
    ramp = torch.linspace(0.5, 1.5, WIDTH).expand(1, 3, HEIGHT, WIDTH)
    unweighted = replace(SETTINGS, consistency=0.0, spread=0.0, chroma=0.0, bend=0.0)
    settings = replace(unweighted, steps=3, mis_samples=256, integrator="mis")

    def gradient(rows: TransportSettings | None, seed: int) -> Float64Array:
        frame = replace(a_frame(device), seed=seed)
        loop = LightOptimization(frame, Pull(ramp), settings, bent(), transport=rows)
        assert (loop.view.transport is None) == (rows is None)
        loop.state.step = 1
        loop.step()
        light = [p for n, p in loop.unknowns.named_parameters() if n.startswith("light")]
        found = [p.grad.reshape(-1) for p in light if p.grad is not None]
        return torch.cat(found).double().cpu().numpy()

    own = np.mean([gradient(finer, seed) for seed in range(3)], axis=0)
    match = compare_gradients(own, np.mean([gradient(None, seed) for seed in range(3)], axis=0))
    assert match.cosine > MIS_COSINE and abs(match.signed_bias) < MIS_BIAS, match


# ----------------------------------------------------------------------- steps and resuming


def unordered(device: str) -> float:
    """How far two renders of one light may be apart: CUDA's sums have no order [1]."""
    return 0.0 if device == "cpu" else 2e-6


def test_steps_are_what_adam_makes_of_the_gradient(device: str) -> None:
    """One step of torch's Adam by hand; the guide sees each step's own picture, in order."""
    seen: list[Tensor] = []

    class Watch(Pull):
        def gradient(self, image: Tensor, step: int) -> Tensor | None:
            seen.append(image.clone())
            return super().gradient(image, step)

    loop = a_loop(device, Watch(), unknowns=bent())
    with torch.no_grad():
        image = loop.composite(0).image
    before = values(loop)
    loop.step()
    torch.testing.assert_close(seen[0], image, rtol=0.0, atol=unordered(device))
    # Adam's first step has the length of the rate and the gradient's sign.
    for name, rate in (("log_intensity", RATES["intensity"]), ("log_sigma", RATES["width"])):
        parameter = loop.unknowns.light_fg.get_parameter(name)
        assert parameter.grad is not None
        moved = parameter.detach() - before[f"light_fg.{name}"]
        torch.testing.assert_close(
            moved, -rate * parameter.grad.sign(), rtol=1e-4, atol=1e-6, msg=name
        )
    loop.run()
    assert isinstance(loop.guide, Pull) and loop.guide.steps == list(range(SETTINGS.step_count))
    assert len(seen) == len(loop.state.history) == loop.state.step == SETTINGS.step_count


def test_steps_do_not_see_the_scale_of_the_gradient(device: str) -> None:
    """Adam's eps is far below any gradient: a ten-thousandth of it takes the same path."""
    settings = replace(SETTINGS, consistency=0.0, spread=0.0, chroma=0.0, bend=0.0)
    ends = []
    for scale in (1.0, 2.0**-14):
        loop = a_loop(device, Pull(scale * Pull().d_image), settings, bent())
        loop.run()
        ends.append(values(loop))
    for name, value in ends[0].items():
        torch.testing.assert_close(ends[1][name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_steps_keep_the_bounds(device: str) -> None:
    """Rates far too high: after every step axes are unit and the lights within their bounds."""
    settings = replace(
        SETTINGS, rate_axis=3.0, rate_width=3.0, rate_intensity=30.0, intensity_limit=100.0
    )
    loop = a_loop(device, settings=settings)

    def check(loop: LightOptimization) -> None:
        for light in (loop.unknowns.light_fg, loop.unknowns.light_shadow):
            reach = light.log_intensity.detach() - np.log(light.level)
            assert float(reach.abs().max()) <= np.log(100.0) * (1.0 + 1e-5)
            sigma = light.log_sigma.detach().exp()
            assert light.bounds.sigma_min * 0.9999 < float(sigma.min())
            assert float(sigma.max()) < WIDEST * 1.0001
            assert float((light.axis.detach().norm(dim=1) - 1.0).abs().max()) < 1e-5

    loop.run(check)
    assert loop.state.skipped == 0


@pytest.mark.parametrize("integrator", ["transport", "mis"])
def test_resumed_run_ends_as_if_it_had_not_stopped(
    device: str, integrator: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written to disk after step 6, loaded into a fresh loop: the same bits 6 steps later.

    Light transport is traced again at the steps 4 and 8, so the loaded loop needs the rows of the
    light at step 4. The guide's own generator, Adam's moments and the best state come along.
    """
    if device != "cpu":
        pytest.skip("sums of CUDA kernels have no fixed order")
    monkeypatch.setattr(light_optimization, "RETRACE_EVERY", 4)
    settings = replace(SETTINGS, integrator=integrator, retrace_at=0.0, score_every=3)
    checkpoints = Checkpoints(tmp_path, {"settings": vars(settings)})

    def save(loop: LightOptimization) -> None:
        if loop.state.step == 6:
            checkpoints.save("optimize", 6, loop.state_dict())

    whole = a_loop(device, NoisyPull(), settings, bent())
    whole.run(save)
    resumed = a_loop(device, NoisyPull(), settings)
    resumed.load_state_dict(checkpoints.load(pytest.fail).state)
    assert resumed.state.step == 6 and changed(resumed, values(whole))
    resumed.run()
    assert whole.retraced == resumed.retraced == (2 if integrator == "transport" else 0)
    assert changed(resumed, values(whole)) == set()
    assert whole.state == resumed.state and len(whole.state.history) == 12
    assert whole.state.best_step == resumed.state.best_step > 6
    for name, value in whole.best.items():
        assert torch.equal(value, resumed.best[name])
    with torch.no_grad():
        assert torch.equal(whole.final_image(1), resumed.final_image(1))


def test_a_long_history_stays_readable(device: str, tmp_path: Path) -> None:
    """A checkpoint's text, whose length is bounded, does not grow with the steps that it knows."""
    loop = a_loop(device)
    loop.state.history = [{"gradient": 1.0 / (k + 3), "bend": 0.1 * k} for k in range(100_000)]
    loop.state.history[7] = {}
    loop.state.history[9]["score"] = 0.1 + 0.2
    loop.state.step = len(loop.state.history)
    checkpoints = Checkpoints(tmp_path, {})
    checkpoints.save("optimize", loop.state.step, loop.state_dict())
    assert (tmp_path / "checkpoints/000001-optimize-100000/manifest.json").stat().st_size < 2**14
    resumed = a_loop(device)
    resumed.load_state_dict(checkpoints.load(pytest.fail).state)
    assert resumed.state == loop.state


@pytest.mark.parametrize("integrator", ["transport", "mis"])
def test_run_does_not_depend_on_threads(device: str, integrator: str) -> None:
    """One thread or two, tracing and sampling give the same bytes."""
    if device != "cpu":
        pytest.skip("threads are the CPU's")
    settings = replace(SETTINGS, steps=3, integrator=integrator)
    ends = []
    for threads in (1, 2):
        loop = a_loop(device, Pull(), settings, bent(), threads)
        loop.run()
        ends.append(loop)
    assert changed(ends[0], values(ends[1])) == set()


# ------------------------------------------------------------------------- what goes wrong


@pytest.mark.parametrize("value", [None, np.nan, np.inf])
@pytest.mark.parametrize("pixel", [(HEIGHT // 2, WIDTH // 2), (0, 0)], ids=["object", "sky"])
def test_step_without_a_finite_gradient_is_skipped(
    device: str, value: float | None, pixel: tuple[int, int], tmp_path: Path
) -> None:
    """Parameters and moments stay as they were, the step is counted, and the next one is taken.

    Wherever the number is, even where no unknown reaches. The run can be checkpointed then: no
    number in its history is a NaN.
    """
    loop = a_loop(device, Faulty({1, 2, 4}, value, pixel), unknowns=bent())
    skipped = []
    for _ in range(6):
        before, moments = values(loop), loop.optimizer.state_dict()["state"]
        copies = {k: {n: v.clone() for n, v in entry.items()} for k, entry in moments.items()}
        step = loop.state.step
        loop.step()
        if not changed(loop, before):
            skipped.append(step)
            after = loop.optimizer.state_dict()["state"]
            assert all(torch.equal(v, after[k][n]) for k in copies for n, v in copies[k].items())
    assert skipped == [1, 2, 4]
    assert (loop.state.skipped, loop.state.bad_steps, loop.state.step) == (3, 0, 6)
    assert len(loop.state.history) == 6
    assert [k for k, entry in enumerate(loop.state.history) if "gradient" not in entry] == skipped
    assert all(bool(v.isfinite().all()) for v in values(loop).values())
    Checkpoints(tmp_path, {}).save("optimize", 6, loop.state_dict())


@pytest.mark.parametrize("value", [None, np.nan])
def test_run_without_finite_gradients_stops(device: str, value: float | None) -> None:
    """Five in a row are an error of its own exit code; four are not."""
    four = a_loop(device, Faulty({2, 3, 4, 5, 7}, value))
    four.run()
    assert four.state.skipped == 5 and BAD_STEPS_MAX == 5
    five = a_loop(device, Faulty({2, 3, 4, 5, 6}, value))
    with pytest.raises(InputError, match="no finite gradient in 5 steps in a row") as caught:
        five.run()
    assert caught.value.code == ExitCode.NUMERIC and int(ExitCode.NUMERIC) == 6
    assert five.state.skipped == 5
    assert all(bool(v.isfinite().all()) for v in values(five).values())


# ---------------------------------------------------------------------- the best state, scores


def test_best_state_is_kept(device: str) -> None:
    """The lowest score of the second half wins, however low one was before and what came after."""
    settings = replace(SETTINGS, score_every=2)
    loop = a_loop(device, Scored([0.1, 0.5, 0.9, 0.4, 0.7, 0.8]), settings, bent())
    kept: dict[int, dict[str, Tensor]] = {}

    def keep(loop: LightOptimization) -> None:
        kept[loop.state.step] = values(loop)

    loop.run(keep)
    assert (loop.state.best_step, loop.state.best_score) == (8, 0.4)
    assert changed(loop, kept[8]) == set() and changed(loop, kept[12])
    scores = {k + 1: e["score"] for k, e in enumerate(loop.state.history) if "score" in e}
    assert scores == {2: 0.1, 4: 0.5, 6: 0.9, 8: 0.4, 10: 0.7, 12: 0.8}


def test_best_state_survives_a_stop(device: str, tmp_path: Path) -> None:
    """What was best before a stop is delivered if nothing better follows."""
    settings, checkpoints = replace(SETTINGS, score_every=4), Checkpoints(tmp_path, {})
    first = a_loop(device, Scored([0.9, 0.2]), settings, bent())
    for _ in range(10):
        first.step()
        if first.state.step == 8:
            best = values(first)
    checkpoints.save("optimize", 10, first.state_dict())
    resumed = a_loop(device, Scored([0.5]), settings)
    resumed.load_state_dict(checkpoints.load(pytest.fail).state)
    resumed.run()
    assert (resumed.state.best_step, resumed.state.best_score) == (8, 0.2)
    assert changed(resumed, best) == set() and resumed.state.step == 12


def test_best_state_is_the_last_without_scores(device: str) -> None:
    """No score asked for, or none known: where the loop ended."""
    for every in (0, 4):
        loop = a_loop(device, settings=replace(SETTINGS, score_every=every))
        kept: dict[str, Tensor] = {}
        loop.run(lambda loop, kept=kept: kept.update(values(loop)))  # type: ignore[misc]
        assert changed(loop, kept) == set()
        assert loop.state.best_score is None and loop.state.best_step == -1


def test_best_state_ignores_scores_that_are_not_numbers(device: str, tmp_path: Path) -> None:
    """A NaN is not better than what comes after it, and a run with one can be checkpointed."""
    settings = replace(SETTINGS, score_every=3)
    loop = a_loop(device, Scored([0.5, float("nan"), 0.4, float("nan")]), settings)
    loop.run(lambda loop: Checkpoints(tmp_path, {}).save("o", 1, loop.state_dict()))
    assert (loop.state.best_step, loop.state.best_score) == (9, 0.4)


def test_score_is_of_what_would_be_delivered(device: str) -> None:
    """Under the light as fused at the end, whatever the step: not the picture of the step."""
    seen: list[Tensor] = []

    class Judge(Pull):
        def score(self, image: Tensor) -> float | None:
            seen.append(image.clone())
            return None

    settings = replace(SETTINGS, score_every=1)
    loop = a_loop(device, Judge(), settings, bent())
    loop.step()
    with torch.no_grad():
        fused = loop.view.image(
            *loop.lights(1.0), loop.unknowns.curve_fg(), loop.unknowns.curve_shadow(), 0
        )
        assert float((loop.composite(1).image - fused).abs().max()) > 1e-3
    torch.testing.assert_close(seen[0], fused, rtol=0.0, atol=unordered(device))


# ---------------------------------------------------------------------------- the schedules


def test_fusion_schedule(device: str) -> None:
    """0 to 1 over the run (S 6, S 7); one light throughout; or never."""
    loop = a_loop(device)
    assert [loop.fusion(k) for k in range(12)] == pytest.approx(np.arange(12) / 11.0)
    assert loop.final_fusion == 1.0
    for fusion in ("single", "none"):
        other = a_loop(device, settings=replace(SETTINGS, fusion=fusion))
        assert {other.fusion(k) for k in range(12)} == {0.0} == {other.final_fusion}
    assert a_loop(device, settings=replace(SETTINGS, steps=1)).fusion(0) == 0.0


@pytest.mark.parametrize("fusion", ["schedule", "single", "none"])
def test_fusion_decides_what_is_delivered(device: str, fusion: str) -> None:
    """One light where they are fused or never were two; else both, at any resolution."""
    loop = a_loop(device, settings=replace(SETTINGS, fusion=fusion), unknowns=bent())
    own = [
        x.texels(24).detach().numpy() for x in (loop.unknowns.light_fg, loop.unknowns.light_shadow)
    ]
    fg, shadow = (light.texels for light in loop.final_lights(24))
    expected = {
        "schedule": o.fuse(own[0], own[1], 1.0),
        "single": (own[0], own[0]),
        "none": (own[0], own[1]),
    }[fusion]
    assert fg is not None and shadow is not None
    for found, truth in zip((fg, shadow), expected, strict=True):
        np.testing.assert_allclose(found, truth, rtol=2e-5)


def test_fusion_single_leaves_the_other_light_alone(device: str) -> None:
    """The shadow's lobes are not used, so they do not move."""
    loop = a_loop(device, settings=replace(SETTINGS, fusion="single", chroma=0.0), unknowns=bent())
    before = values(loop)
    loop.run()
    moved = changed(loop, before)
    assert not any(name.startswith("light_shadow") for name in moved)
    assert {name for name in before if name.startswith(("light_fg", "curve"))} == moved
    assert set(loop.state.history[0]) == {"chroma", "bend", "gradient"}


@pytest.mark.parametrize("rate", [1.0, 0.25])
def test_rate_schedule(device: str, rate: float) -> None:
    """Full in the first half, then a cosine to a tenth; each kind has its own, ``--rate`` all."""
    loop = a_loop(device, settings=replace(SETTINGS, steps=8, rate=rate))
    rates = []
    for _ in range(8):
        loop.step()
        rates.append([group["lr"] / rate for group in loop.optimizer.param_groups])
    kinds = [RATES[name] for name in ("intensity", "chroma", "axis", "width")]
    assert rates[0] == pytest.approx([*kinds, *kinds, RATES["tone"]])
    share = np.maximum(2.0 * np.arange(8) / 8.0 - 1.0, 0.0)
    expected = 0.1 + 0.45 * (1.0 + np.cos(np.pi * share))
    assert [r[0] / RATES["intensity"] for r in rates] == pytest.approx(expected.tolist())
    assert [r[-1] / RATES["tone"] for r in rates] == pytest.approx(expected.tolist())


def test_no_lobe_shape_leaves_widths_and_colours_alone(device: str) -> None:
    """``--no-lobe-shape``: directions and strengths move; no term for a still colour."""
    loop = a_loop(device, settings=replace(SETTINGS, lobe_shape=False))
    before = values(loop)
    loop.run()
    still = {name for name in before if name.endswith(("chroma", "log_sigma"))}
    assert len(still) == 4 and changed(loop, before) == before.keys() - still
    assert "chroma" not in loop.state.history[0] and "spread" in loop.state.history[0]


def test_no_tone_curve_leaves_the_curves_alone(device: str) -> None:
    """``--no-tone-curve``: the identity before and after, and no term for its bend."""
    loop = a_loop(device, settings=replace(SETTINGS, tone_curve=False))
    before = values(loop)
    loop.run()
    curves = {name for name in before if name.startswith("curve")}
    assert curves and changed(loop, before) == before.keys() - curves
    knots = loop.unknowns.curve_fg()
    torch.testing.assert_close(knots.y, knots.x)
    assert "bend" not in loop.state.history[0]
    bent_curves = a_loop(device)
    before = values(bent_curves)
    bent_curves.run()
    assert changed(bent_curves, before) == before.keys()


# ------------------------------------------------------------------------ tracing, the view


def test_transport_is_traced_again_when_the_light_has_moved(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sun jumps after step 6: the rows follow at step 8, where they are looked at, and once."""
    monkeypatch.setattr(light_optimization, "RETRACE_EVERY", 4)
    start = bent()
    with torch.no_grad():
        for light in (start.light_fg, start.light_shadow):
            light.log_intensity[0] += 3.0
            light.log_sigma[0] = np.log(light.bounds.sigma_min)

    def jump(loop: LightOptimization) -> None:
        if loop.state.step == 6:
            with torch.no_grad():
                loop.unknowns.light_fg.axis[0] *= -1.0
                loop.unknowns.light_shadow.axis[0] *= -1.0
        views.append(loop.view)

    for limit, expected in ((1e3, []), (2.0, [8])):
        settings = replace(SETTINGS, steps=14, retrace_at=limit)
        loop = a_loop(device, settings=settings, unknowns=deepcopy(start))
        views = [loop.view]
        loop.run(jump)
        assert [k for k in range(14) if views[k + 1] is not views[k]] == expected
        assert loop.retraced == len(expected)


def test_transport_expects_both_lights() -> None:
    """The mean of both maps, each at mean 1: a dim light counts as much as a bright one."""
    first, second = torch.zeros(2, 4, 3), torch.zeros(2, 4, 3)
    first[0, 0], second[1, 2] = 1e-3, 1e3
    texels = expected_light(first, second).texels
    assert texels is not None
    assert texels[0, 0] == pytest.approx(4.0) and texels[1, 2] == pytest.approx(4.0)
    assert texels.sum() == pytest.approx(3 * 8.0)


@pytest.mark.parametrize("integrator", ["transport", "mis"])
def test_view_changes_what_the_object_reaches(device: str, integrator: str) -> None:
    """The sky shows the photo, the covered pixels show the ball, and shadows take light alone."""
    loop = a_loop(device, settings=replace(SETTINGS, integrator=integrator))
    with torch.no_grad():
        image = loop.composite(0).image.cpu().numpy()[0]
    photo = o.encode(loop.frame.photo_lin).transpose(2, 0, 1)
    difference = np.abs(image - photo).max(axis=0)
    coverage = loop.frame.coverage()
    horizon = HEIGHT // 2 - int(1.4 * WIDTH * np.tan(np.radians(12.0)))
    assert not coverage[:horizon].any() and difference[:horizon].max() < 1e-6
    # The ball is smooth where the photo is noise.
    covered = coverage == 1.0
    assert covered.sum() > 40
    assert image[:, covered].std(axis=1).max() < 0.6 * photo[:, covered].std(axis=1).min()
    bare = coverage == 0.0
    assert image[:, bare].mean() < photo[:, bare].mean() - 1e-3
    assert (image - photo)[:, bare].max() < 1e-6


def test_mis_draws_other_samples_in_every_step(device: str) -> None:
    """And the same ones again for the same step: a run is a function of its seed."""
    loop = a_loop(device, settings=replace(SETTINGS, integrator="mis"))
    with torch.no_grad():
        first, again, other = (
            loop.composite(0).image,
            loop.composite(0).image,
            loop.composite(1).image,
        )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_mis_takes_its_gradient_from_other_samples(device: str) -> None:
    """Guidance follows the noise of what it sees; the gradient must not know that noise."""
    loop = a_loop(device, settings=replace(SETTINGS, integrator="mis"), unknowns=bent())
    leaf = loop.unknowns.light_fg.log_intensity
    weight = Pull().d_image

    def picture(seed: int) -> tuple[Tensor, Tensor]:
        curves = loop.unknowns.curve_fg(), loop.unknowns.curve_shadow()
        image = loop.view.image(*loop.lights(loop.fusion(2)), *curves, seed)
        (gradient,) = torch.autograd.grad((image.cpu() * weight).sum(), leaf)
        with torch.no_grad():
            return loop.view.image(*loop.lights(loop.fusion(2)), *curves, seed), gradient

    image = loop.composite(2).image
    (gradient,) = torch.autograd.grad((image.cpu() * weight).sum(), leaf)
    found = [picture(loop.seed + k) for k in range(10)]
    same_image = [torch.allclose(image, other, rtol=0.0, atol=1e-6) for other, _ in found]
    same_gradient = [torch.allclose(gradient, other, rtol=1e-5) for _, other in found]
    assert sum(same_image) == sum(same_gradient) == 1
    assert same_image.index(True) != same_gradient.index(True)


def test_view_has_no_gradient_of_the_photo(device: str) -> None:
    """Only the two maps and the curves are differentiated."""
    frame = a_frame(device)
    even = torch.ones(ROWS, 2 * ROWS, 3, requires_grad=True)
    view = View(frame, expected_light(even, even), TRACED)
    curves = bent().curve_fg(), bent().curve_shadow()
    image = view.image(even, even, *curves, 0)
    image.sum().backward()
    assert even.grad is not None and bool(even.grad.isfinite().all()) and bool(even.grad.any())
