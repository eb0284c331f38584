"""Noise schedules: what a time stands for, and the three things a network may predict."""

import pytest
import torch
from torch import Tensor

from warpir.diffusion.schedule import (
    TIME_LIMIT,
    NoiseSchedule,
    time_range,
)
from warpir.diffusion.settings import PREDICTION_TYPES

FLOAT32 = 1e-6
"""Relative: a few operations in float32."""


def stable_diffusion_bars() -> Tensor:
    """alpha-bar of Stable Diffusion (arXiv 2112.10752): betas whose roots are evenly spaced."""
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    return (1.0 - betas).cumprod(0)


def schedule(prediction_type: str = "epsilon") -> NoiseSchedule:
    return NoiseSchedule(stable_diffusion_bars(), prediction_type)


def without_signal_at_the_end(prediction_type: str) -> NoiseSchedule:
    """Rescale to zero terminal SNR (arXiv 2305.08891, algorithm 1)."""
    roots = stable_diffusion_bars().sqrt()
    roots = (roots - roots[-1]) * roots[0] / (roots[0] - roots[-1])
    return NoiseSchedule(roots**2, prediction_type)


def latents_and_noise(count: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(3)
    return tuple(torch.randn(2, count, 4, 8, 8, generator=generator))  # type: ignore[return-value]


def test_schedule_sigma_of_stable_diffusion() -> None:
    """Times give the noise levels that are published for Stable Diffusion."""
    t = torch.tensor([0.02, 0.2, 0.3, 0.5, 0.6, 0.7, 0.8])
    expected = torch.tensor([0.137, 0.496, 0.640, 0.851, 0.916, 0.958, 0.981])
    alpha, sigma = schedule().alpha_sigma(t)
    torch.testing.assert_close(sigma, expected, rtol=0, atol=5e-4)  # three digits are given
    torch.testing.assert_close(alpha**2 + sigma**2, torch.ones(7), rtol=FLOAT32, atol=0)
    assert alpha.dtype == sigma.dtype == torch.float32


def test_schedule_timestep_covers_all_steps_evenly() -> None:
    """A time is a share of the schedule; the ends are its first and last step."""
    middle = (torch.arange(1000) + 0.5) / 1000
    assert torch.equal(schedule().timestep(middle), torch.arange(1000))
    assert schedule().timestep(torch.tensor([0.0, 1.0])).tolist() == [0, 999]


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_schedule_to_noise_undoes_target(prediction_type: str) -> None:
    """A network that is right gives back the very noise, whatever it predicts."""
    latents, noise = latents_and_noise(5)
    t = torch.tensor([0.1, 0.3, 0.5, 0.7, 0.97])
    it = schedule(prediction_type)
    noisy = it.add_noise(latents, noise, t)
    found = it.to_noise(it.target(latents, noise, t), noisy, t)
    torch.testing.assert_close(found, noise, rtol=0, atol=2e-5)  # x0: divided by sigma 0.3


def test_schedule_predictions_satisfy_their_definitions() -> None:
    """Written out in float64: z = a x0 + s eps and v = a eps - s x0 (arXiv 2202.00512)."""
    latents, noise = latents_and_noise(2)
    t = torch.tensor([0.25, 0.75])
    bar = stable_diffusion_bars()[[250, 750]].view(-1, 1, 1, 1)
    a, s = bar.sqrt(), (1.0 - bar).sqrt()
    x0, eps = latents.double(), noise.double()
    expected = {"epsilon": eps, "sample": x0, "v_prediction": a * eps - s * x0}
    for kind in PREDICTION_TYPES:
        noisy = schedule(kind).add_noise(latents, noise, t)
        torch.testing.assert_close(noisy.double(), a * x0 + s * eps, rtol=0, atol=1e-6)
        found = schedule(kind).target(latents, noise, t).double()
        torch.testing.assert_close(found, expected[kind], rtol=0, atol=1e-6)


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_schedule_without_terminal_signal_is_finite_at_one(prediction_type: str) -> None:
    """Nothing is divided by a, which is 0 at the end of such a schedule."""
    it = without_signal_at_the_end(prediction_type)
    latents, noise = latents_and_noise(1)
    t = torch.ones(1)
    assert it.alpha_sigma(t)[0].item() == 0.0
    noisy = it.add_noise(latents, noise, t)
    assert torch.equal(noisy, noise)
    found = it.to_noise(it.target(latents, noise, t), noisy, t)
    torch.testing.assert_close(found, noise, rtol=0, atol=FLOAT32)


def test_schedule_time_range_falls_linearly() -> None:
    """From 0.6 to 0.3 over a run (DiPIR, section 4.3.2); the least time stays below it."""
    tops = [time_range(step, 601, 0.02, 0.6, 0.3)[1] for step in (0, 300, 600)]
    assert tops == pytest.approx([0.6, 0.45, 0.3])
    assert time_range(0, 1, 0.02, 0.6, 0.3) == (0.02, 0.6)
    assert time_range(600, 601, 0.4, 0.6, 0.3) == pytest.approx((0.3, 0.3))
    assert time_range(0, 600, 0.02, 1.0, 1.0)[1] == TIME_LIMIT
