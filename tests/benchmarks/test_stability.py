"""The hard cases of `benchmarks.stability`: finite, within their bounds, gradients right (issue 3).

Each case is measured against float64, never against another run of ours; its bound is a named
constant beside it that says where it comes from.
"""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.stability import __main__ as stability
from benchmarks.stability.__main__ import cases, is_kept, measure, number
from benchmarks.stability.case import Case, Measured, max_relative, relative_l2
from warpir.render.device import choose_device


def marked(case: Case) -> object:
    """Return a case as a test parameter; long ones carry the mark ``slow``."""
    marks = [pytest.mark.slow] if case.is_slow else []
    return pytest.param(case, id=case.id, marks=marks)


@pytest.mark.parametrize("case", [marked(case) for case in cases()])
def test_hard_case(device: str, case: Case) -> None:
    """Every number is finite, the error is within its bound, and so is the gradient's."""
    measured = case.run(device)
    assert measured.is_finite
    assert measured.error <= case.bound
    if case.gradient_bound is not None:
        assert measured.gradient_error is not None
        assert measured.gradient_error <= case.gradient_bound


def test_cases_have_names_of_their_own() -> None:
    """No two rows of the table are about the same thing, and each says what Mitsuba does."""
    every = cases()
    assert len({case.id for case in every}) == len(every)
    assert all(case.mitsuba for case in every)


@pytest.mark.parametrize(
    "measured",
    [
        Measured(2.0, True, 0.0),
        Measured(0.5, False, 0.0),
        Measured(0.5, True, 2.0),
        Measured(float("nan"), True, 0.0),
        Measured(0.5, True, float("nan")),
    ],
)
def test_a_case_can_fail(measured: Measured) -> None:
    """Too large, not finite, wrong gradient, NaN: each is outside the bounds."""
    case = Case("g", "n", "q", "m", lambda device: measured, 1.0, 1.0, "none")
    record = measure(case, "cpu", False)
    assert not is_kept(record)
    good = Case("g", "n", "q", "m", lambda device: Measured(1.0, True, 1.0), 1.0, 1.0, "none")
    assert is_kept(measure(good, "cpu", False))


def test_the_page_says_how_it_was_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = Case("g", "n", "q", "m", lambda device: Measured(0.5, True), 1.0, None, "none")
    page = tmp_path / "page.md"
    monkeypatch.setattr(stability, "cases", lambda: [good])
    monkeypatch.setattr(sys, "argv", ["stability", "--docs", str(page)])
    stability.main()
    device = choose_device(None)
    assert f"python -m benchmarks.stability --device {device} --docs" in page.read_text()


def test_errors_see_what_is_not_finite() -> None:
    """A NaN is never lost in a maximum, and 0 / 0 is no error."""
    nan, truth = np.array([1.0, np.nan, 1.0]), np.ones(3)
    assert np.isnan(max_relative(nan, truth)) and np.isnan(relative_l2(nan, truth))
    assert max_relative(np.zeros(2), np.zeros(2)) == relative_l2(np.zeros(2), np.zeros(2)) == 0.0
    assert max_relative([1.0], [0.0]) == np.inf == relative_l2([1.0], [0.0])
    assert number(0.0) == "0" and number(None) == "" and number(1.25e-7) == "1.2e-07"
