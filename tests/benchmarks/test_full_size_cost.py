"""The cost benchmark: shapes of the real model, and a tiny run whose figures add up."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.full_size_cost.__main__ import EXTRA_STAGES, TARGETS, main
from benchmarks.full_size_cost.model import full_size_parts

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module", autouse=True)
def _threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def figures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a tiny run on the CPU writes."""
    path = tmp_path_factory.mktemp("cost") / "cost.json"
    main(["--tiny", "--device", "cpu", "--json", str(path)])
    read: dict[str, Any] = json.loads(path.read_text())
    return read


def test_full_size_model_has_the_published_parameter_counts() -> None:
    """865.9 M, 83.7 M and 340.4 M, as the files of Stable Diffusion 2.1-base hold."""
    parts = full_size_parts(torch.device("meta"), 0, 1)
    counts = [sum(p.numel() for p in part.parameters()) for part in parts]
    assert counts == [865_910_724, 83_653_863, 340_387_840]
    assert {p.dtype for part in parts for p in part.parameters()} == {torch.float16}


@pytest.mark.slow
def test_stages_are_those_of_the_program_and_sum_up(figures: dict[str, Any]) -> None:
    stages = figures["seconds"]
    program = {"read", "load", "model", "personalize", "scene", "trace", "optimize", "render"}
    assert {*program, *EXTRA_STAGES, "write", "other"} == set(stages)
    assert all(spent >= 0.0 for spent in stages.values())
    assert sum(stages.values()) == pytest.approx(figures["whole_run_s"], abs=0.01)
    # What no stage claims must stay a small part of the run.
    assert stages["other"] < 0.3 * figures["whole_run_s"]
    for name in ("model", "class images", "encoding", "training", "trace", "optimize", "render"):
        assert stages[name] > 0.0


@pytest.mark.slow
def test_rendering_is_a_part_of_a_step(figures: dict[str, Any]) -> None:
    rendering, light = (figures["step_ms"][name]["eager"] for name in ("rendering", "light"))
    assert 0.0 < rendering < light
    assert figures["rendering_share"] == pytest.approx(rendering / light, rel=1e-6)
    assert figures["step_ms"]["lora"]["eager"] > 0.0


@pytest.mark.slow
def test_figures_say_what_they_depend_on(figures: dict[str, Any]) -> None:
    assert figures["command"].startswith("python -m benchmarks.full_size_cost --tiny")
    for name in ("commit", "date", "device", "versions", "dtype", "parameters"):
        assert figures[name]
    assert figures["dtype"]["unet"] == "float32"  # the CPU's only one
    settings = figures["settings"]
    assert settings["class_images"] == 2 and settings["picture"] == [32, 21]
    assert settings["graphs"] is False
    peaks = figures["peak_gb_by_stage"]
    assert {"model", "class images", "LoRA", "trace", "optimisation", "render"} <= set(peaks)
    assert figures["peak_gb"] == pytest.approx(max(peaks.values()), abs=1e-3)
    for name, target in figures["targets"].items():
        assert target["found"] == figures[name]
        assert target["met"] is (target["found"] <= target["limit"])


@pytest.mark.slow
def test_published_figures_are_this_programs(figures: dict[str, Any]) -> None:
    """Same fields as a run today, the authors' setting, the real model's size, all targets met."""
    published = json.loads((ROOT / "docs/full_size_cost.json").read_text())
    assert set(published) == set(figures)
    assert set(published["seconds"]) == set(figures["seconds"])
    assert set(published["settings"]) == set(figures["settings"])
    settings = published["settings"]
    assert (settings["class_images"], settings["lora_steps"], settings["steps"]) == (200, 1000, 600)
    assert settings["picture"] == [384, 256] and settings["graphs"] is True
    assert published["parameters"] == {"unet": 865_910_724, "vae": 83_653_863}
    assert published["command"].endswith(
        "benchmarks.full_size_cost --json docs/full_size_cost.json"
    )
    assert {name: t["limit"] for name, t in published["targets"].items()} == TARGETS
    assert all(t["met"] for t in published["targets"].values())
