"""Whether guidance helped: forces whose truth is known are judged as they should be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from warpir.optimize.acceptance import DRAWS, ONE_SIDED, Verdict, blend, judge

SHAPE = (1, 3, 6, 8)


@dataclass
class Pull:
    """Pulls toward a picture, ``strength (x - target)``, and shakes; each draw in its own way."""

    target: Tensor
    strength: float = 1.0
    noise: float = 0.0
    seed: int = 0

    def work(self, start: Tensor, middle: Tensor, end: Tensor, draws: Sequence[int]) -> list[float]:
        found = []
        for draw in draws:
            g = torch.Generator().manual_seed(1000 * self.seed + draw)
            shake = torch.randn(middle.shape, generator=g, dtype=middle.dtype)
            force = self.strength * (middle - self.target) + self.noise * shake
            found.append(float((force * (end - start)).sum()))
        return found


def picture(seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed)
    return torch.rand(SHAPE, generator=g, dtype=torch.float64)


def straight(start: Tensor, end: Tensor):
    return lambda share: start + share * (end - start)


def test_rise_of_a_quadratic_is_its_difference() -> None:
    """The midpoint rule is exact for it, however the way is cut."""
    start, end, target = picture(1), picture(2), picture(3)
    expected = 0.5 * float((end - target).square().sum() - (start - target).square().sum())
    for pieces in (1, 8):
        verdict = judge(Pull(target), straight(start, end), pieces)
        assert verdict.rise == pytest.approx(expected, rel=1e-12)
        assert verdict.error == pytest.approx(0.0, abs=1e-12) and verdict.draws == DRAWS


def test_rise_along_a_bent_way() -> None:
    """Pictures are not linear in the unknowns: eight pieces are still good to a few percent."""
    start, end, target = picture(1), picture(2), picture(3)

    def bent(share: float) -> Tensor:
        return straight(start, end)(share**1.7) + 0.2 * math.sin(math.pi * share)

    expected = 0.5 * float((end - target).square().sum() - (start - target).square().sum())
    verdict = judge(Pull(target), bent)
    assert verdict.rise == pytest.approx(expected, abs=0.03 * float((end - start).norm()))


def test_a_way_toward_the_truth_is_accepted_and_one_away_is_not() -> None:
    """A force toward the truth, with noise, knows which end is nearer; so does its reverse."""
    start, truth = picture(1), picture(3)
    near = start + 0.6 * (truth - start)
    force = Pull(truth, noise=0.5)
    there, back = judge(force, straight(start, near)), judge(force, straight(near, start))
    assert there.is_accepted and not back.is_accepted
    assert there.rise == pytest.approx(-back.rise) and there.error > 0.0
    assert "prefers the end" in there.line and "kept the start" in back.line
    wrong = judge(Pull(picture(9), noise=0.5), straight(start, near))
    nearer = (near - picture(9)).norm() < (start - picture(9)).norm()
    assert wrong.is_accepted == bool(nearer)


@pytest.mark.slow
def test_pure_noise_is_refused_nineteen_times_in_twenty() -> None:
    """Student's distribution of 16 draws puts 6 % beyond 1.64; 400 trials scatter by 1.2 %."""
    start, end = picture(1), picture(2)
    force = [Pull(start, strength=0.0, noise=1.0, seed=seed) for seed in range(400)]
    accepted = np.mean([judge(f, straight(start, end)).is_accepted for f in force])
    assert 0.02 < accepted < 0.10


def test_error_is_that_of_the_mean_over_draws() -> None:
    """The same draws go along the whole way, so their noise adds up, not their variance."""
    start, end = picture(1), picture(2)
    way = float((end - start).norm())
    errors = [judge(Pull(start, 0.0, 1.0, seed), straight(start, end)).error for seed in range(200)]
    expected = way / math.sqrt(DRAWS)
    assert np.mean(np.square(errors)) == pytest.approx(expected**2, rel=0.1)


def test_the_limit_is_the_stated_one() -> None:
    """A fall of less than 1.64 standard errors is refused; no number at all is, too."""

    @dataclass
    class Fixed:
        values: list[float]

        def work(self, *_: object) -> list[float]:
            return self.values

    def verdict(fall: float) -> Verdict:
        base = np.tile([-1.0, 1.0], DRAWS // 2) / 8.0
        return judge(Fixed([*(base - fall / 8.0)]), lambda _: torch.zeros(SHAPE))

    error = math.sqrt(DRAWS / (DRAWS - 1)) / math.sqrt(DRAWS)
    assert verdict(0.5).error == pytest.approx(error)
    assert not verdict(0.99 * ONE_SIDED * error).is_accepted
    assert verdict(1.01 * ONE_SIDED * error).is_accepted
    assert not verdict(-1.0).is_accepted
    broken = judge(Fixed([math.nan] * DRAWS), lambda _: torch.zeros(SHAPE))
    assert not broken.is_accepted
    assert broken.record() == {"is_accepted": False, "rise": None, "error": None, "draws": DRAWS}


def test_blend_is_straight() -> None:
    start, end = {"a": torch.tensor([0.0, 4.0])}, {"a": torch.tensor([1.0, 2.0])}
    assert torch.equal(blend(start, end, 0.0)["a"], start["a"])
    assert torch.equal(blend(start, end, 0.25)["a"], torch.tensor([0.25, 3.5]))
    assert torch.equal(blend(start, end, 1.0)["a"], end["a"])
