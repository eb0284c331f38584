"""The speed comparison's arithmetic, layout and documents; one short run where Mitsuba is there."""

import importlib.util
import json
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.speed import __main__ as bench
from benchmarks.speed import cost, fireflies, report
from benchmarks.speed import ratios as r
from benchmarks.speed.references import Reference, quiet
from tests.builders.programs.llvm import LIBRARY, llvm

HALF = -0.5
"""Exponent of error over time of plain Monte Carlo."""


def curve(constant: float, times: tuple[float, ...] = (1.0, 4.0, 16.0)) -> r.Curve:
    """A curve on which error is ``constant / sqrt(time)``."""
    return r.Curve(times, [constant * t**HALF for t in times])


def sweep_row(integrator: str, spp: int, seconds: float, scale: float = 1.0) -> dict[str, Any]:
    """A row whose parts take half of the time each and have plain Monte Carlo's errors."""
    part = {
        "seconds_forward": 0.2 * seconds,
        "seconds_step": 0.5 * seconds,
        "rmse_forward": scale * 0.08 * seconds**HALF,
        "rmse_image": scale * 0.1 * seconds**HALF,
        "rmse_image_all": scale * 0.2 * seconds**HALF,
        "rmse_gradient": scale * 0.4 * seconds**HALF,
    }
    return {
        **{"device": "test CPU", "scene": "ball", "integrator": integrator},
        **part,
        "settings": {"spp": spp},
        "seconds_forward": 0.4 * seconds,
        "seconds_step": seconds,
        "rmse_resolution": 0.01,
        "peak_mib": 12.0,
        "parts": {"foreground": part, "ratio": dict(part)},
    }


def transport_row(image: float, gradient: float) -> dict[str, Any]:
    """A row of `transport`: 6 s of tracing, 10 ms a step."""
    part = {"rmse_image": image, "rmse_image_all": image, "rmse_gradient": gradient}
    return {
        **sweep_row("transport", 0, 0.01),
        "settings": {},
        **part,
        "seconds_traced": 6.0,
        "parts": {"foreground": part, "ratio": part},
    }


def result(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What a run writes."""
    return {
        "conditions": {
            "device": "test CPU",
            "threads": 2,
            "date": "2000-01-01",
            "commit": "0000000",
            "warp": "1",
            "torch": "2",
            "instructions": "AVX2",
            "mitsuba": "3",
            "variant": "llvm_ad_rgb",
            "size": [96, 64],
            "command": "python -m benchmarks.speed",
            "seconds": 1.0,
        },
        "scenes": [
            {"name": "ball", "triangles": 1, "depth": 3, "object_pixels": 2, "receiver_pixels": 3}
        ],
        "skipped": ["toycar: mesh/ToyCar.glb is not in the folder of assets (--assets)"],
        "ratios": r.ratios(rows),
        "references": [],
        "disagreements": [],
        "rows": rows,
    }


@pytest.fixture
def rows() -> list[dict[str, Any]]:
    """A sweep of each integrator."""
    found = [sweep_row("mitsuba", 4**k, 4.0**k) for k in range(4)]
    found += [sweep_row("mis", 4**k, 4.0**k, scale=0.5) for k in range(4)]
    return [*found, transport_row(0.05, 0.2)]


def test_curve_is_straight_in_log_log() -> None:
    seconds, bound = curve(1.0).at([1.0, 2**-0.5, 0.5, 0.3, 0.25])
    assert seconds == pytest.approx([1.0, 2.0, 4.0, 1.0 / 0.09, 16.0])
    assert not bound.any()


def test_curve_beyond_its_ends() -> None:
    """The shortest run is the least there is; past the longest the time is a lower bound."""
    seconds, bound = curve(1.0).at([5.0, 0.1])
    assert seconds == pytest.approx([1.0, 16.0 * 2.5])
    assert bound.tolist() == [False, True]


def test_curve_drops_what_is_beaten_and_what_is_not_resolved() -> None:
    made = r.Curve([1.0, 2.0, 4.0, 8.0, 16.0], [1.0, 1.5, 0.5, 0.0, np.nan])
    assert made.seconds.tolist() == [1.0, 4.0]
    assert made.errors.tolist() == [1.0, 0.5]
    with pytest.raises(ValueError, match="above 0"):
        r.Curve([1.0], [0.0])


def test_best_split_of_monte_carlo() -> None:
    """Minimum of ``a^2/x^2 + b^2/y^2`` with ``x^2 + y^2 = 2 e^2`` is ``(a + b)^2 / (2 e^2)``."""
    times = tuple(float(t) for t in np.geomspace(1e-4, 1e4, 9))
    found = r.best_split(curve(1.0, times), curve(3.0, times), 0.2)
    assert found.seconds == pytest.approx(16.0 / (2.0 * 0.04), rel=1e-4)
    assert not found.at_least


def test_best_split_never_beats_the_measured_point() -> None:
    """At the combined error of two measured points the best split takes no longer than they do."""
    for k in range(3):
        a, b = curve(1.0), curve(0.2)
        error = r.combined(float(a.errors[k]), float(b.errors[k]))
        assert r.best_split(a, b, error).seconds <= float(a.seconds[k] + b.seconds[k]) * (1 + 1e-6)


def test_best_split_says_when_it_is_a_lower_bound() -> None:
    found = r.best_split(curve(1.0), curve(1.0), 0.01)
    assert found.seconds == pytest.approx(2.0 * 16.0 * 25.0, rel=1e-4)
    assert found.at_least


def test_transport_ratio_takes_the_earlier_of_image_and_gradient(
    rows: list[dict[str, Any]],
) -> None:
    """Image 0.05 is reached at 4 s, gradient 0.2 at 4 s; a better gradient alone gains nothing."""
    theirs = [row for row in rows if row["integrator"] == "mitsuba"]
    both = r.transport_ratio(transport_row(0.05, 0.2), theirs)
    assert both["step"] == pytest.approx(400.0, rel=1e-4)
    assert both["run_600"] == pytest.approx(600.0 * 4.0 / (6.0 + 600.0 * 0.01), rel=1e-4)
    assert both["break_even_steps"] == pytest.approx(6.0 / (4.0 - 0.01), rel=1e-4)
    better = r.transport_ratio(transport_row(0.05, 1e-6), theirs)
    assert better["step"] == pytest.approx(both["step"])
    assert not better["at_least"] and better["mitsuba_at_least_by_gradient"]
    worse = r.transport_ratio(transport_row(0.05, 0.4), theirs)
    assert worse["step"] == pytest.approx(100.0, rel=1e-4)
    beyond = r.transport_ratio(transport_row(1e-6, 1e-6), theirs)
    assert beyond["at_least"] and beyond["step"] > 6400.0


def test_mis_ratio_compares_where_both_sweeps_reach(rows: list[dict[str, Any]]) -> None:
    """Half the error per sample is a quarter of the time."""
    by = {n: [x for x in rows if x["integrator"] == n] for n in ("mis", "mitsuba")}
    found = r.mis_ratio(by["mis"], by["mitsuba"])
    assert set(found) == {"forward_image", "step_image", "step_gradient"}
    for entry in found.values():
        assert entry["ratio"] == pytest.approx(4.0, rel=0.05)
    assert found["step_image"]["rmse"] == pytest.approx(0.1 / 8.0)


def test_ratios_hold_one_record_per_scene(rows: list[dict[str, Any]]) -> None:
    other = [{**row, "scene": "metal"} for row in rows]
    for scene, found in zip(("ball", "metal"), r.ratios([*rows, *other]), strict=True):
        assert found["scene"] == scene
        assert found["transport"][0]["step"] == pytest.approx(400.0, rel=1e-4)


def test_rmse_is_free_of_the_references_noise(rng: np.random.Generator) -> None:
    """References ten times as noisy as the error still give it, whatever their weights."""
    truth = 1.0 + rng.random(200_000)
    size = np.square(truth).mean()
    noisy = np.stack([truth + rng.normal(0.0, 0.1, truth.shape) for _ in range(4)])
    values = truth + rng.normal(0.0, 0.01, truth.shape)
    exact = r.rmse(values, np.stack([truth, truth]), np.ones(2))
    assert exact == pytest.approx(0.01 / np.sqrt(size), rel=0.01)
    for weights in ([0.25, 0.25, 0.25, 0.25], [0.5, 0.5, 0.0, 0.0]):
        squared = r.rmse(values, noisy, np.array(weights)) ** 2 * size
        # Standard error of the mean of one pair's product: 0.1^2 / sqrt(200 000)
        assert squared == pytest.approx(1e-4, abs=4.0 * 0.01 / np.sqrt(len(truth)))


def test_reference_leaves_out_the_noisiest_pixels() -> None:
    variance = np.ones(100)
    variance[[3, 70]] = 2.0
    kept = quiet(variance)
    assert np.flatnonzero(~kept).tolist() == [3, 70]
    truth, gradient = np.ones((2, 100, 3)), np.ones((2, 4, 8, 3))
    reference = Reference((truth, gradient), (truth, gradient), kept)
    values = np.ones((100, 3))
    values[3] = 2.0
    errors = reference.rmse((values, gradient[0]))
    assert errors["image"] == 0.0 and errors["gradient"] == 0.0
    assert errors["image_all"] == pytest.approx(0.1)
    assert reference.agreement()["image"]["difference"] == 0.0


def agreement(apart: float, resolved: float) -> dict[str, Any]:
    """References that differ by ``apart`` in everything."""
    entry = {"difference": apart, "noise": 0.0, "without_noise": apart, "resolved": resolved}
    where = {"scene": "ball", "part": "foreground"}
    return {**where, "image": entry, "gradient": {**entry, "without_noise": 0.0}}


def test_disagreement_is_a_tenth_of_the_smallest_error(rows: list[dict[str, Any]]) -> None:
    """The smallest foreground error is mis's at 64 samples, 0.1 / 16."""
    assert bench.disagreements([agreement(0.0006, 0.0)], rows) == []
    assert len(bench.disagreements([agreement(0.0007, 0.0)], rows)) == 1
    assert bench.disagreements([agreement(0.0007, 0.001)], rows) == []


def test_documents_hold_every_device_that_was_kept(
    rows: list[dict[str, Any]], tmp_path: Path
) -> None:
    # colour-science puts a stand-in into sys.modules where matplotlib is absent.
    try:
        version("matplotlib")
    except PackageNotFoundError:
        pytest.skip("the plot needs the bench extra")
    one = result(rows)
    other = json.loads(json.dumps(one))
    other["conditions"]["device"] = "Some GPU 1"
    paths = [report.keep_run(x, tmp_path) for x in (one, other)]
    assert [p.name for p in paths] == ["test_cpu.json", "some_gpu_1.json"]
    report.write_documents(tmp_path)
    text = (tmp_path / "speed_against_error.md").read_text()
    assert "## test CPU, 2 threads, AVX2" in text and "## Some GPU 1" in text
    assert "400 x" in text and "ToyCar.glb is not in the folder" in text
    assert (tmp_path / "speed_against_error.png").stat().st_size < 300_000


def test_a_picture_costs_more_with_more_samples(tmp_path: Path) -> None:
    """Of one size and object; the table holds both, and a run that was kept is drawn."""
    few, many = (cost.render_one(96, 2000, samples, "cpu") for samples in (1, 256))
    assert few["triangles"] == many["triangles"] == pytest.approx(2000, rel=0.1)
    assert 0.0 < few["seconds_picture"] < many["seconds_picture"]
    assert many["peak_mib"] > 50.0
    run = {"rows": [{"sweep": name, **row} for name in cost.LABELS for row in (few, many)]}
    table = cost.cost_text([run]).splitlines()
    assert len([line for line in table if line.startswith("| 96 |")]) == 6
    (tmp_path / "run.json").write_text(json.dumps(run))
    assert cost.kept_runs(tmp_path) == [run]


def test_tables_are_rectangular(rows: list[dict[str, Any]]) -> None:
    made = result(rows)
    for text in (report.row_table(made), report.transport_table(made), report.mis_table(made)):
        assert len({line.count("|") for line in text.splitlines()}) == 1
    assert len(report.row_table(made).splitlines()) == 2 + len(rows)


@pytest.mark.parametrize(
    "value, text", [(None, "-"), (0.00123456, "0.00123"), (1234.5, "1230"), (12.0, "12")]
)
def test_number(value: float | None, text: str) -> None:
    assert report.number(value) == text


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("mitsuba") is None, reason="Mitsuba is not installed (bench extra)"
)
@pytest.mark.skipif(llvm() is None, reason=f"no LLVM for Mitsuba: name it in {LIBRARY}")
def test_a_quick_run_holds_what_it_promises(tmp_path: Path) -> None:
    """In a process of its own: a process has one Mitsuba variant."""
    path = tmp_path / "run.json"
    command = [sys.executable, "-m", "benchmarks.speed", "--quick", "--device", "cpu"]
    command += ["--scenes", "ball", "--cache", str(tmp_path), "--json", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    made = json.loads(path.read_text())
    promised = {"device", "scene", "integrator", "settings", "peak_mib", "rmse_resolution"}
    promised |= {"seconds_forward", "seconds_step", "rmse_forward", "rmse_image", "rmse_gradient"}
    assert all(promised <= set(row) for row in made["rows"])
    assert {row["integrator"] for row in made["rows"]} == {"mis", "mitsuba", "transport"}
    (record,) = made["ratios"]
    # Far below what is measured, far above what a wrong gradient or a slow step would give
    assert record["transport"][0]["step"] > 3.0
    assert record["mis"]["forward_image"]["ratio"] > 0.1
    best = min(row["rmse_gradient"] for row in made["rows"] if row["integrator"] == "mitsuba")
    assert best < 0.3


def test_fireflies_are_counted_in_the_mean_square() -> None:
    """One run in four with an error of 8 beside three of 1; the median does not see it."""
    made = SimpleNamespace(integrator="mis", spp=4, warm=lambda: None)
    made.forward = lambda seed: lambda: {"foreground": 8.0 if seed % 4 == 0 else 1.0}
    reference = SimpleNamespace(own=[None, [None]], rmse=lambda values: {"image": values[0]})
    references = SimpleNamespace(by_part={"foreground": reference})
    row = fireflies.measured(made, references, 8)  # type: ignore[arg-type]
    assert row["rmse"] == pytest.approx((67.0 / 4.0) ** 0.5) and row["median_rmse"] == 1.0
    squares = np.array([64.0, 1.0, 1.0, 1.0] * 2)
    error = squares.std(ddof=1) / 8.0**0.5 / (2.0 * float(row["rmse"]))
    assert row["rmse_standard_error"] == pytest.approx(error)
