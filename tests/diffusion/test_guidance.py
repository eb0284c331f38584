"""Guidance: rows of coefficients against closed forms, draws, limits, state and score."""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy import stats
from torch import Tensor

from tests.builders.tiny_stable_diffusion import add_lora, make_tiny_stable_diffusion
from tests.statistics import central_differences, compare_gradients
from warpir.diffusion.crop import Crop
from warpir.diffusion.dataset_update import VALUES_PER_LATENT, DatasetUpdate
from warpir.diffusion.draws import seed_of
from warpir.diffusion.gradient_gate import NORM_COUNT_MIN, NORM_WINDOW, GradientGate
from warpir.diffusion.guidance import Guidance, kind_of
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.prior import InChunks, at_once
from warpir.diffusion.schedule import NoiseSchedule
from warpir.diffusion.settings import GuidanceSettings, ModelSettings

PROMPTS = {"p": "a car in sks", "b": "a car", "null": "", "n": "a wrong shadow"}
TERMS = {
    "lds": ["p+", "null"],
    "sds": ["p+", "null+"],
    "sds-base": ["b", "null"],
    "csd": ["b", "null"],
    "lds-lora-both": ["p+", "null+"],
    "lds-negative": ["p+", "n"],
    "good-bad": ["b", "n"],
    "sds-good-bad": ["p+", "n"],
}
"""Prompts of each loss, with the adapter after a +."""
LOSSES = tuple(TERMS)
FLOAT32 = 1e-5
"""About a hundred float32 operations; times, a and s are float32."""
PROMPT = "a car in sks"
ASKED = GuidanceSettings(base_prompt="a car", negative_prompt="a wrong shadow")
MASK = torch.ones(4, 4)
"""Of an object so small that every crop of 4 x 4 pixels is the whole picture."""


ROOTS = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64)
SCHEDULE = NoiseSchedule(torch.cumprod(1.0 - ROOTS**2, dim=0), "epsilon")
"""Stable Diffusion's: scaled linear from .00085 to .012."""


@dataclass
class Call:
    """What `predict` was asked."""

    latents_noisy: Tensor
    t: Tensor
    prompts: list[str]
    adapters: list[str | None]


@dataclass
class GaussianPrior:
    """Knows each prompt's pictures to be Gaussian, so its noise has a closed form.

    Pictures are their own latents. Each (prompt, adapter) has a mean; all share one variance.
    """

    device, schedule = torch.device("cpu"), SCHEDULE

    resolution: int = 4
    variance: float = 0.3
    adapter_shift: float = 0.25
    """What the adapter adds to the means."""
    calls: list[Call] = field(default_factory=list)
    prompts: list[str] = field(default_factory=list)
    in_chunks: InChunks = at_once

    def upcast(self, what: str) -> bool:
        """Return False: everything is computed in full precision."""
        return False

    def spare_memory(self) -> None:
        """There is nothing to free."""

    def mean(self, prompt: str, adapter: str | None) -> Tensor:
        """Return the mean picture, shape [3, R, R]."""
        g = torch.Generator().manual_seed(seed_of(prompt))
        mean = torch.rand(3, self.resolution, self.resolution, dtype=torch.float64, generator=g)
        return mean + (self.adapter_shift if adapter else 0.0)

    def embed(self, prompts: Sequence[str]) -> Tensor:
        self.prompts += [p for p in prompts if p not in self.prompts]
        return torch.tensor([[[float(self.prompts.index(p))]] for p in prompts])

    def encode(self, image: Tensor) -> Tensor:
        return image

    def noise(self, z: Tensor, t: Tensor, prompt: str, adapter: str | None) -> Tensor:
        """Return the best guess ``s (z - a mean) / (a^2 variance + s^2)`` of one sample's noise."""
        a, s = self.schedule.alpha_sigma(t)
        return s * (z - a * self.mean(prompt, adapter)) / (a**2 * self.variance + s**2)

    def predict(
        self,
        latents_noisy: Tensor,
        t: Tensor,
        embeddings: Tensor,
        adapters: Sequence[str | None],
    ) -> Tensor:
        prompts = [self.prompts[int(e)] for e in embeddings.flatten()]
        assert len(latents_noisy) == len(t) == len(prompts) == len(adapters)
        self.calls.append(Call(latents_noisy, t, prompts, list(adapters)))
        samples = zip(latents_noisy, t, prompts, adapters, strict=True)
        return torch.stack([self.noise(*sample) for sample in samples])


class NarrowPrior(GaussianPrior):
    """Predicts nothing finite until it computes in full precision."""

    is_half = True
    said: str = ""

    def upcast(self, what: str) -> bool:
        """Widen it, as `StableDiffusion.upcast` does."""
        was_half, self.is_half, self.said = self.is_half, False, what
        return was_half

    def predict(self, *given: Any) -> Tensor:
        found = super().predict(*given)
        return found * torch.nan if self.is_half else found


def picture(rng: np.random.Generator, height: int = 4, width: int = 4) -> Tensor:
    return torch.tensor(rng.random((1, 3, height, width)))


def at_time(t: float, **changes: object) -> GuidanceSettings:
    """Return settings whose time is fixed."""
    fixed = replace(ASKED, time_min=t, time_max=t, time_max_end=t)
    return replace(fixed, **changes)


def guidance(
    prior: GaussianPrior, settings: GuidanceSettings, mask: Tensor = MASK, seed: int = 3
) -> Guidance:
    made = kind_of(settings)(prior, PROMPT, settings, mask, steps=100, seed=seed, adapter="scene")
    assert isinstance(made, Guidance)
    return made


def literal_delta(loss: str, g: float, e: dict[str, Tensor], noise: Tensor) -> Tensor:
    """Return the residual as the papers print it; ``e`` by prompt and, after a +, adapter."""
    return {
        "lds": lambda: e["p+"] - e["null"],
        "sds": lambda: e["null+"] + g * (e["p+"] - e["null+"]) - noise,
        "sds-base": lambda: e["null"] + g * (e["b"] - e["null"]) - noise,
        "csd": lambda: e["b"] - e["null"],
        "lds-lora-both": lambda: e["p+"] - e["null+"],
        "lds-negative": lambda: e["p+"] - e["n"],
        "good-bad": lambda: e["b"] - e["n"],
        "sds-good-bad": lambda: (e["p+"] - noise) + 2.0 * (e["p+"] - e["n"]),
    }[loss]()


@pytest.mark.parametrize("noises", [1, 3])
@pytest.mark.parametrize("loss", LOSSES)
def test_row_is_its_printed_formula(rng: np.random.Generator, loss: str, noises: int) -> None:
    """w(t) times the literal residual, mean over the noises."""
    prior = GaussianPrior()
    x = picture(rng)
    settings = replace(ASKED, loss=loss, noises=noises, guidance_scale=7.5)
    found = guidance(prior, settings).gradient(x, step=5)
    (call,) = prior.calls
    expected = torch.zeros_like(x)
    for k in range(noises):
        z, t = call.latents_noisy[k], call.t[k]
        bar = prior.schedule.alphas_cumprod[int(1000 * t)]
        a, s = bar.sqrt(), (1 - bar).sqrt()
        e = {
            name + plus: prior.noise(z, t, prompt, "scene" if plus else None)
            for name, prompt in PROMPTS.items()
            for plus in ("", "+")
        }
        expected += s**2 * literal_delta(loss, 7.5, e, (z - a * x[0]) / s) / noises
    torch.testing.assert_close(found, expected, rtol=FLOAT32, atol=FLOAT32)
    assert found is not None and found.abs().max() > 0.01


@pytest.mark.parametrize("loss", LOSSES)
def test_terms_are_one_call_without_idle_branches(rng: np.random.Generator, loss: str) -> None:
    """One batch of terms x noises; prompts of coefficient 0 are neither embedded nor predicted."""
    prior = GaussianPrior()
    guidance(prior, replace(ASKED, loss=loss, noises=3)).gradient(picture(rng), 0)
    (call,) = prior.calls
    names = [name for name in TERMS[loss] for _ in range(3)]
    assert call.prompts == [PROMPTS[name.rstrip("+")] for name in names]
    assert call.adapters == ["scene" if name.endswith("+") else None for name in names]
    assert set(prior.prompts) == {PROMPTS[name.rstrip("+")] for name in TERMS[loss]}
    for half in (call.latents_noisy, call.t):
        torch.testing.assert_close(half[:3], half[3:], rtol=0, atol=0)


@pytest.mark.parametrize("loss", ["good-bad", "sds-good-bad"])
def test_losses_of_the_base_model_do_without_an_adapter(
    rng: np.random.Generator, loss: str
) -> None:
    """The base model says what is good and what is bad."""
    prior = GaussianPrior()
    x = picture(rng)
    settings = at_time(0.4, loss=loss, weight="uniform")
    found = Guidance(prior, PROMPT, settings, MASK, 100, 3, None).gradient(x, 0)
    (call,) = prior.calls
    assert call.prompts == ["a car", "a wrong shadow"] and call.adapters == [None, None]
    z, t = call.latents_noisy[0], call.t[0]
    a, s = prior.schedule.alpha_sigma(t)
    good, bad = (prior.noise(z, t, prompt, None) for prompt in ("a car", "a wrong shadow"))
    expected = good - bad if loss == "good-bad" else 3 * good - 2 * bad - (z - a * x[0]) / s
    assert found is not None
    torch.testing.assert_close(found[0], expected, rtol=FLOAT32, atol=FLOAT32)


@pytest.mark.slow
def test_work_is_the_difference_of_the_potential(rng: np.random.Generator) -> None:
    """Along a straight way the work of SDS at g = 1 is the rise of the noised -log p, in the mean.

    For Gaussian pictures the mean force is ``w s a (x - mean) / v`` (see above), so the potential
    is quadratic, and the midpoint rule is exact for it. Single draws scatter by their noise; the
    mean of many lies within its standard error.
    """
    prior, t, count = GaussianPrior(), 0.4, 4000
    settings = at_time(t, loss="sds-base", guidance_scale=1.0, noises=500)
    made = guidance(prior, settings)
    start, end = picture(rng), picture(rng)
    works = np.array(made.work(start, (start + end) / 2, end, range(count)))
    bar = float(prior.schedule.alphas_cumprod[int(1000 * t)])
    a, s, v = math.sqrt(bar), math.sqrt(1 - bar), bar * prior.variance + 1 - bar
    mean = prior.mean("a car", None)

    def potential(x: Tensor) -> float:
        return s**2 * s * a / v / 2.0 * float((x - mean).square().sum())

    error = works.std(ddof=1) / math.sqrt(count)
    rise = potential(end) - potential(start)
    assert abs(works.mean() - rise) < 4.0 * error and error < 0.05 * abs(rise)
    # Draws are their own: one alone, or in another batch, is the same.
    assert made.work(start, (start + end) / 2, end, [7]) == pytest.approx([works[7]], rel=1e-6)


def test_work_draws_what_no_step_does(rng: np.random.Generator) -> None:
    """Times of the whole run, noises of none of its steps, and the same ones for each call."""
    prior = GaussianPrior()
    made = guidance(prior, replace(ASKED, noises=50))
    x = picture(rng)
    made.work(x, x, x, range(1000))
    t = torch.cat([call.t[:50] for call in prior.calls]).double().numpy()
    assert t.min() >= 0.02 and t.max() <= 0.6
    # Some step's greatest time lies evenly between .6 and .3, and the time evenly below it.
    top = np.random.default_rng(1).uniform(0.3, 0.6, 100_000)
    expected = 0.02 + (top - 0.02) * np.random.default_rng(2).uniform(size=len(top))
    assert stats.ks_2samp(t, expected).pvalue > 0.01
    noisy = prior.calls[0].latents_noisy[:50]
    for step in range(3):
        made.gradient(x, step)
        stepped = prior.calls[-1].latents_noisy[:50]
        assert (noisy[:, None] - stepped[None]).abs().amax(dim=(2, 3, 4)).min() > 1e-3


def test_sds_without_guidance_has_one_term(rng: np.random.Generator) -> None:
    """At g = 1 the null prompt counts 0 and is not computed."""
    prior = GaussianPrior()
    settings = replace(ASKED, loss="sds-base", guidance_scale=1.0)
    guidance(prior, settings).gradient(picture(rng), 0)
    assert prior.calls[0].prompts == ["a car"]


@pytest.mark.parametrize("t", [0.1, 0.5, 0.9])
def test_sds_is_the_score_of_the_noised_density(rng: np.random.Generator, t: float) -> None:
    """At g = 1 its mean over the noise is ``-w(t) s grad log p_t(a x)`` for Gaussian pictures.

    The best noise is affine in z_t, so that one sample deviates from the mean by
    ``w (s^2 / v - 1) noise`` with ``v = a^2 variance + s^2``; the deviations of the mean over many
    samples, in their standard errors, are chi-square distributed.
    """
    count = 2000
    prior = GaussianPrior()
    x = picture(rng)
    found = guidance(prior, at_time(t, loss="sds-base", guidance_scale=1.0, noises=count)).gradient(
        x, 0
    )
    bar = float(prior.schedule.alphas_cumprod[int(1000 * t)])
    a, s, v = math.sqrt(bar), math.sqrt(1 - bar), bar * prior.variance + 1 - bar
    grad_log_p = -(a * x - a * prior.mean("a car", None)) / v
    expected = -(s**2) * s * grad_log_p
    standard_error = s**2 * abs(s**2 / v - 1) / math.sqrt(count)
    assert found is not None
    chi_square = float(((found - expected) / standard_error).square().sum())
    assert 0.001 < stats.chi2.cdf(chi_square, x.numel()) < 0.999
    # The bound is sharp enough to see a tenth of the score.
    assert expected.norm() / math.sqrt(x.numel()) > 10 * standard_error


@pytest.mark.parametrize("literal_alpha", [False, True])
@pytest.mark.parametrize("name", ["sigma2", "sigma", "uniform"])
def test_weight_scales_the_gradient(
    rng: np.random.Generator, name: str, literal_alpha: bool
) -> None:
    """w(t) is s^2, s or 1, and a times that when eq. 7 and 8 are read literally."""
    x = picture(rng)
    unit = guidance(GaussianPrior(), at_time(0.4, weight="uniform")).gradient(x, 0)
    found = guidance(
        GaussianPrior(), at_time(0.4, weight=name, literal_alpha=literal_alpha)
    ).gradient(x, 0)
    bar = float(SCHEDULE.alphas_cumprod[400])
    w = {"sigma2": 1 - bar, "sigma": math.sqrt(1 - bar), "uniform": 1.0}[name]
    assert unit is not None
    torch.testing.assert_close(
        found, unit * w * (math.sqrt(bar) if literal_alpha else 1.0), rtol=FLOAT32, atol=0.0
    )


@pytest.mark.parametrize(("step", "top"), [(0, 0.6), (99, 0.3)])
def test_times_are_uniform_in_the_steps_range(
    rng: np.random.Generator, step: int, top: float
) -> None:
    """Times fill the range of the first and the last step (Kolmogorov-Smirnov)."""
    prior = GaussianPrior()
    guidance(prior, replace(ASKED, noises=1000)).gradient(picture(rng), step)
    shares = (prior.calls[0].t[:1000].double() - 0.02) / (top - 0.02)
    assert stats.kstest(shares.numpy(), "uniform").pvalue > 0.01


def test_draws_are_a_function_of_seed_step_and_noise(rng: np.random.Generator) -> None:
    """All losses see the same z_t; another step or seed another; more noises keep the first."""
    x = picture(rng, 24, 36)
    mask = torch.zeros(24, 36)
    mask[8:16, 10:26] = 1.0

    def seen(loss: str, seed: int, step: int, noises: int) -> Tensor:
        prior = GaussianPrior()
        settings = replace(ASKED, loss=loss, noises=noises)
        guidance(prior, settings, mask, seed).gradient(x, step)
        return prior.calls[0].latents_noisy[:noises]

    first = seen("lds", 3, 7, 1)
    for loss in LOSSES:
        assert torch.equal(seen(loss, 3, 7, 1), first)
    assert torch.equal(seen("lds", 3, 7, 3)[:1], first)
    others = [*seen("lds", 3, 7, 3)[1:], *seen("lds", 3, 8, 1), *seen("lds", 4, 7, 1)]
    assert all((other - first).abs().max() > 0.1 for other in others)


def test_residual_is_summed_over_the_latents() -> None:
    """A residual of 1 everywhere pulls with the number of latents, whatever the picture's size."""

    class Ones(GaussianPrior):
        def predict(self, latents_noisy: Tensor, t: Tensor, *rest: object) -> Tensor:
            return torch.stack(
                [torch.ones_like(latents_noisy[0]), torch.zeros_like(latents_noisy[0])]
            )

    made = guidance(Ones(resolution=32), at_time(0.3, weight="uniform"))
    found = made.gradient(torch.rand(1, 3, 4, 4, dtype=torch.float64), 0)
    assert found is not None
    assert float(found.sum()) == pytest.approx(3 * 32 * 32)


def draw_as_guidance_does(made: Guidance, x: Tensor, step: int) -> Crop:
    """Return the crop of a step, seen through `Crop.apply`."""
    crops: list[Crop] = []
    apply = Crop.apply

    def remember(self: Crop, image: Tensor, size: int) -> Tensor:
        crops.append(self)
        return apply(self, image, size)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Crop, "apply", remember)
        made.gradient(x, step)
    return crops[0]


def test_small_residuals_survive_a_half_precision_encoder(rng: np.random.Generator) -> None:
    """A residual of 1e-6 would vanish in a float16 backward pass; it is scaled to about 1."""

    class Half(GaussianPrior):
        def encode(self, image: Tensor) -> Tensor:
            return (image.half() * 0.01).float()

        def noise(self, z: Tensor, t: Tensor, prompt: str, adapter: str | None) -> Tensor:
            return 1e-6 * self.mean(prompt, adapter).float()

    prior = Half()
    found = guidance(prior, at_time(0.5, weight="uniform")).gradient(picture(rng).float(), 0)
    delta = prior.mean("a car in sks", "scene") - prior.mean("", None)
    assert found is not None
    # Two roundings to float16, of the residual and of its product.
    torch.testing.assert_close(found[0].double(), 1e-8 * delta, rtol=2e-3, atol=1e-13)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("where", ["prediction", "image"])
def test_steps_without_finite_gradient_are_skipped(
    rng: np.random.Generator, where: str, bad: float
) -> None:
    """A bad value anywhere leaves the step without a gradient; the next good one has one."""

    class Faulty(GaussianPrior):
        faulty = False

        def noise(self, z: Tensor, t: Tensor, prompt: str, adapter: str | None) -> Tensor:
            noise = super().noise(z, t, prompt, adapter)
            if self.faulty and prompt == "":
                noise[0, 1, 2] = bad
            return noise

    prior = Faulty()
    made = guidance(prior, ASKED)
    good, broken = picture(rng), picture(rng)
    if where == "image":
        broken[0, 0, 0, 0] = bad

    def fail(step: int) -> None:
        prior.faulty = where == "prediction"
        assert made.gradient(broken, step) is None
        prior.faulty = False

    fail(0)
    fail(1)
    assert made.gradient(good, 2) is not None
    fail(3)
    assert len(made.gate.norms) == 1


def test_outliers_are_shortened_to_the_running_median() -> None:
    """A gradient of more than ten medians of past norms keeps its direction; medians are raw."""
    gate = GradientGate(10.0)
    unit = torch.tensor([0.6, 0.8])
    for i in range(NORM_COUNT_MIN):
        norm = 100.0 if i % 2 else 1.0 + i  # nothing is clipped before there is a median
        assert gate.passed(norm * unit) is not None
    assert gate.clipped_steps == 0
    middle = (9.0 + 100.0) / 2
    torch.testing.assert_close(gate.passed(9.9 * middle * unit), 9.9 * middle * unit)
    found = gate.passed(1e6 * unit)
    torch.testing.assert_close(found, 10 * 100.0 * unit)  # 54.5 * 9.9 came in: the median is 100
    assert gate.clipped_steps == 1
    assert list(gate.norms)[-1] == pytest.approx(1e6)


def test_median_forgets_and_zero_is_no_limit() -> None:
    """Only the last window counts; clip 0 and a median of 0 let everything pass."""
    gate, free = GradientGate(2.0), GradientGate(0.0)
    for _ in range(NORM_WINDOW):
        assert gate.passed(torch.zeros(2)) is not None
        free.passed(torch.ones(2))
    assert torch.equal(free.passed(torch.full((2,), 1e9)), torch.full((2,), 1e9))
    for _ in range(NORM_WINDOW):
        gate.passed(torch.ones(1))
    torch.testing.assert_close(gate.passed(torch.full((1,), 5.0)), torch.full((1,), 2.0))
    assert (gate.clipped_steps, free.clipped_steps) == (1, 0)
    assert len(gate.norms) == NORM_WINDOW


def test_restored_state_continues_identically(rng: np.random.Generator) -> None:
    """Through JSON, a restored run clips, counts and draws as if it had not been stopped."""
    settings = replace(ASKED, gradient_clip=1.1)
    x = picture(rng)
    whole, first, second = (guidance(GaussianPrior(), settings) for _ in range(3))
    for step in range(30):
        whole.gradient(x, step)
    for step in range(15):
        first.gradient(x, step)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    for step in range(15, 30):
        second.gradient(x, step)
    assert second.state_dict() == whole.state_dict()
    assert whole.gate.clipped_steps > first.gate.clipped_steps > 0
    ends = whole.gradient(x, 30), second.gradient(x, 30)
    assert ends[0] is not None and ends[1] is not None and torch.equal(*ends)


def test_gradient_has_the_pictures_shape_and_type(rng: np.random.Generator) -> None:
    """float32 in, float32 out, detached; the picture itself is left alone."""
    x = picture(rng, 20, 30).float()
    before = x.clone()
    found = guidance(GaussianPrior(), ASKED, torch.ones(20, 30)).gradient(x, 0)
    assert found is not None
    assert (found.shape, found.dtype, found.requires_grad) == (x.shape, torch.float32, False)
    assert torch.equal(x, before) and not x.requires_grad


@pytest.mark.parametrize("noises", [1, 3])
@pytest.mark.parametrize("loss", LOSSES)
def test_score_is_its_printed_formula(rng: np.random.Generator, loss: str, noises: int) -> None:
    """Errors of both predictions, or |delta|^2 with noise, over 8 times of equal spacing."""
    prior = GaussianPrior()
    x = picture(rng)
    settings = replace(ASKED, loss=loss, noises=noises, guidance_scale=7.5)
    found = guidance(prior, settings).score(x, seed=11)
    expected, times = [], []
    for call in prior.calls:
        count = len(call.t) // 2
        for k in range(count):
            z, t = call.latents_noisy[k], call.t[k]
            a, s = (float(v) for v in prior.schedule.alpha_sigma(t))
            noise = (z - a * x[0]) / s
            first = prior.noise(z, t, call.prompts[k], call.adapters[k])
            second = prior.noise(z, t, call.prompts[k + count], call.adapters[k + count])
            if loss in ("sds", "sds-base"):
                error = (7.5 * first - 6.5 * second - noise).square().sum()
            elif loss == "sds-good-bad":
                error = (3.0 * first - 2.0 * second - noise).square().sum()
            else:
                error = (first - noise).square().sum() - (second - noise).square().sum()
            expected.append(s**2 * float(error))
            times.append(float(t))
    assert found == pytest.approx(np.mean(expected), rel=1e-4)
    assert times == pytest.approx(list(0.02 + 0.58 * (np.arange(8) + 0.5) / 8), abs=1e-6)


@pytest.mark.parametrize("loss", LOSSES)
def test_score_is_a_function_of_the_picture(rng: np.random.Generator, loss: str) -> None:
    """Steps in between change nothing, nor does the number of noises; another seed does."""
    x = picture(rng, 20, 30)
    mask = torch.zeros(20, 30)
    mask[5:15, 5:25] = 1.0
    settings = replace(ASKED, loss=loss)
    made = guidance(GaussianPrior(), settings, mask)
    first = made.score(x)
    made.gradient(x, 0)
    assert made.score(x) == first == made.score(x, seed=3)
    assert made.score(x, seed=4) != first
    assert guidance(GaussianPrior(), replace(settings, noises=3), mask).score(x) == pytest.approx(
        first, rel=1e-9
    )


@pytest.mark.parametrize("loss", ["lds", "csd", "lds-lora-both", "lds-negative"])
def test_score_falls_along_the_gradient(rng: np.random.Generator, loss: str) -> None:
    """Steps against the gradient lower the score: both name the same pictures better."""
    made = guidance(GaussianPrior(), replace(ASKED, loss=loss))
    x = picture(rng)
    scores = [made.score(x)]
    for step in range(20):
        d_image = made.gradient(x, step)
        assert d_image is not None
        x = x - 0.05 * d_image
    scores.append(made.score(x))
    assert scores[1] < scores[0]


class Rounded(GaussianPrior):
    """Predicts in bfloat16 unless told otherwise; its prompts hardly differ."""

    precise = False

    def ensure_precision(self, difference: Callable[[], Tensor]) -> float:
        low = difference()
        self.precise = True
        return float(torch.cosine_similarity(low.flatten(), difference().flatten(), dim=0))

    def mean(self, prompt: str, adapter: str | None) -> Tensor:
        return torch.full((3, 4, 4), 0.004 if prompt else 0.0)

    def noise(self, z: Tensor, t: Tensor, prompt: str, adapter: str | None) -> Tensor:
        noise = super().noise(z, t, prompt, adapter)
        return noise if self.precise else noise.bfloat16().double()


@pytest.mark.parametrize("noises", [1, 3])
def test_precision_is_judged_by_the_difference(rng: np.random.Generator, noises: int) -> None:
    """Four samples of delta: bfloat16 spoils near-equal terms, and not one beside the noise."""
    x = picture(rng)
    cosines = {}
    for loss in ("csd", "sds-base"):
        prior = Rounded()
        settings = replace(ASKED, loss=loss, guidance_scale=1.0, noises=noises)
        made = guidance(prior, settings)
        cosines[loss] = made.ensure_precision(x)
        assert prior.precise
        assert sum(len(call.t) for call in prior.calls) == 2 * 4 * len(made.terms)
    assert cosines["sds-base"] > 0.999 and cosines["csd"] < 0.9


def test_loss_without_its_adapter_is_refused() -> None:
    """LDS without a LoRA would be CSD under another name."""
    for loss in LOSSES:
        settings = replace(ASKED, loss=loss)
        if loss in ("csd", "sds-base", "good-bad", "sds-good-bad"):
            kind_of(settings)(GaussianPrior(), PROMPT, settings, MASK, 10, 0, None)
        else:
            with pytest.raises(ValueError, match=f"{loss} needs an adapter"):
                kind_of(settings)(GaussianPrior(), PROMPT, settings, MASK, 10, 0, None)


@dataclass
class EditingPrior(GaussianPrior):
    """Moves a picture towards grey, by the strength asked for."""

    edits: list[tuple[str, int, float, int, float, str | None]] = field(default_factory=list)

    def edit(
        self,
        image: Tensor,
        prompt: str,
        seed: int,
        *,
        strength: float,
        steps: int,
        scale: float,
        adapter: str | None = None,
    ) -> Tensor:
        self.edits.append((prompt, seed, strength, steps, scale, adapter))
        assert not image.requires_grad
        return image + strength * (0.5 - image)


def update(prior: GaussianPrior, mask: Tensor = MASK, **changes: object) -> DatasetUpdate:
    settings = replace(ASKED, loss="dataset-update", **changes)
    made = kind_of(settings)(prior, PROMPT, settings, mask, steps=100, seed=3, adapter="scene")
    assert isinstance(made, DatasetUpdate)
    return made


def test_dataset_update_pulls_to_the_edit(rng: np.random.Generator) -> None:
    """The gradient is the sign of the difference, one latent for 48 values, through the crop."""
    prior = EditingPrior()
    x = picture(rng)
    found = update(prior).gradient(x, 0)
    assert found is not None
    torch.testing.assert_close(found, (x - 0.5).sign() / VALUES_PER_LATENT)
    enlarged = update(EditingPrior(resolution=32)).gradient(torch.full_like(x, 0.9), 0)
    assert enlarged is not None
    assert float(enlarged.sum()) == pytest.approx(3 * 32 * 32 / VALUES_PER_LATENT)


def test_dataset_update_edits_now_and_then(rng: np.random.Generator) -> None:
    """Every ten steps, with the adapted model, the schedule's strength and a seed of its own."""
    prior = EditingPrior()
    made = update(prior, update_steps=12, update_scale=5.0)
    x = picture(rng)
    for step in range(100):
        made.gradient(x, step)
    assert len(prior.edits) == 10 and set(prior.prompts) == {"a car in sks", ""}
    assert len({seed for _, seed, *_ in prior.edits}) == 10
    for k, (prompt, _, strength, steps, scale, adapter) in enumerate(prior.edits):
        assert (prompt, steps, scale, adapter) == ("a car in sks", 12, 5.0, "scene")
        assert strength == pytest.approx(0.6 - 0.3 * 10 * k / 99)


def test_dataset_update_restored_between_edits_continues_identically(
    rng: np.random.Generator,
) -> None:
    """The edit and its crop are part of the state; nothing is edited again early."""
    mask = torch.zeros(24, 36)
    mask[8:16, 10:26] = 1.0
    pictures = [picture(rng, 24, 36) for _ in range(25)]
    whole, first = update(EditingPrior(), mask), update(EditingPrior(), mask)
    expected = [whole.gradient(x, step) for step, x in enumerate(pictures)]
    for step in range(13):
        first.gradient(pictures[step], step)
    prior = EditingPrior()
    second = update(prior, mask)
    second.load_state_dict(first.state_dict())
    for step in range(13, 25):
        found = second.gradient(pictures[step], step)
        assert found is not None and torch.equal(found, expected[step])
    assert len(prior.edits) == 1
    assert second.state_dict()["norms"] == whole.state_dict()["norms"]


def test_dataset_update_skips_what_is_not_finite(rng: np.random.Generator) -> None:
    """NaN has a sign of 0, so that the distance is looked at; the bad edit is not kept."""
    prior = EditingPrior()
    made = update(prior)
    bad = torch.full((1, 3, 4, 4), math.nan, dtype=torch.float64)
    for step in range(4):
        assert made.gradient(bad, step) is None
    assert len(prior.edits) == 4
    assert made.gradient(picture(rng), 4) is not None
    assert made.gradient(bad, 5) is None
    assert made.score(bad) is None


def test_dataset_update_scores_how_much_would_change(rng: np.random.Generator) -> None:
    """The mean distance to edits of strength 0.6: a function of the picture, 0 when all is well."""
    made = update(EditingPrior())
    x = picture(rng)
    first = made.score(x)
    made.gradient(x, 0)
    assert made.score(x) == first
    assert first == pytest.approx(0.6 * float((x - 0.5).abs().sum()) / VALUES_PER_LATENT)
    assert made.score(torch.full_like(x, 0.5)) == 0.0


@pytest.fixture(scope="module", params=["epsilon", "v_prediction"])
def folder(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny Stable Diffusion of each prediction type."""
    kind = request.param
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("model"), prediction_type=kind)


def load_adapted(folder: Path, gain: float) -> StableDiffusion:
    """Return the tiny model with a LoRA ``scene``; gain 0 adapts nothing."""
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    add_lora(prior, "scene", 5, gain)
    return prior


SD_SETTINGS = GuidanceSettings(noises=2, weight="uniform")


def photo(rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return a picture of 40 x 60 and the mask of an object in it, of 20 x 16 pixels."""
    mask = torch.zeros(40, 60)
    mask[12:28, 20:40] = 1.0
    return picture(rng, 40, 60).float(), mask


def test_zero_lora_makes_lds_equal_csd_exactly(rng: np.random.Generator, folder: Path) -> None:
    """On a real UNet: LoRAs of zero in a batch with base samples change no bit; others do."""
    x, mask = photo(rng)
    prompt = "a car in the style of sks rendering"
    for gain in (0.0, 0.5):
        prior = load_adapted(folder, gain)
        lds, csd = (
            Guidance(prior, prompt, replace(SD_SETTINGS, loss=loss), mask, 10, 3, "scene")
            for loss in ("lds", "csd")
        )
        first, second = lds.gradient(x, 4), csd.gradient(x, 4)
        assert first is not None and second is not None and second.norm() > 0
        assert torch.equal(first, second) is (gain == 0.0)


def test_gradient_passes_autoencoder_and_crop(rng: np.random.Generator, folder: Path) -> None:
    """Central differences in float64 through the crop and diffusers' autoencoder.

    The residual is held fixed; the latents are the posterior's mean of ``2 x - 1``, scaled.
    """
    x, mask = photo(rng)
    x = x.double()
    prior = load_adapted(folder, 0.5)
    prior.vae.double()
    settings = replace(SD_SETTINGS, noises=1)
    made = Guidance(prior, PROMPT, settings, mask, 10, 3, "scene")
    said: list[Tensor] = []
    predict = prior.predict

    def watched(*args: Any) -> Tensor:
        said.append(predict(*args))
        return said[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prior, "predict", watched)
        found = made.gradient(x, 0)
    assert found is not None
    residual = (said[0][:1] - said[0][1:]).double()
    crop = draw_as_guidance_does(made, x, step=0)
    directions = torch.linalg.qr(torch.tensor(rng.standard_normal((x.numel(), 12)))).Q

    @torch.no_grad()
    def surrogate(lengths: np.ndarray) -> float:
        moved = x + (directions @ torch.tensor(lengths)).view_as(x)
        mean = prior.vae.encode(2 * crop.apply(moved, 64) - 1).latent_dist.mean
        return float((prior.vae.config.scaling_factor * mean * residual).sum())

    match = compare_gradients(
        directions.T @ found.flatten(), central_differences(surrogate, np.zeros(12), 1e-4)
    )
    assert match.relative_l2 < 1e-6  # latents and residual pass through float32


@pytest.mark.slow
def test_guidance_works_without_the_text_encoder(rng: np.random.Generator, folder: Path) -> None:
    """Every loss embeds what it needs when it is made; score and precision need no more."""
    x, mask = photo(rng)
    prior = load_adapted(folder, 0.5)
    asked = (
        replace(SD_SETTINGS, loss=loss, update_steps=2) for loss in (*LOSSES, "dataset-update")
    )
    made = [kind_of(s)(prior, PROMPT, s, mask, 10, 3, "scene") for s in asked]
    prior.free_text_encoder()
    for each in made:
        d_image = each.gradient(x, 0)
        assert d_image is not None and d_image.shape == x.shape and d_image.norm() > 0
        score = each.score(x)
        assert score is not None and score == each.score(x)
        if isinstance(each, Guidance):
            assert each.ensure_precision(x) == 1.0


def test_gradient_and_score_fall_back_to_full_precision(rng: np.random.Generator) -> None:
    """What half precision cannot hold is computed again, and said; not so of a bad picture."""
    image = picture(rng)
    wide = guidance(GaussianPrior(), at_time(0.4))
    narrow = guidance(NarrowPrior(), at_time(0.4))
    found, expected = narrow.gradient(image, 0), wide.gradient(image, 0)
    assert found is not None and expected is not None and torch.equal(found, expected)
    for pairs in (2, 4):
        narrow = guidance(NarrowPrior(), at_time(0.4))
        assert narrow.score(image, pairs=pairs) == wide.score(image, pairs=pairs)
    prior = NarrowPrior()
    assert guidance(prior, at_time(0.4)).score(image * torch.nan) is None
    assert prior.is_half and not prior.said
