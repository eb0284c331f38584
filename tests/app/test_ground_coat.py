"""``--ground-roughness auto`` puts what the photo says in place of the word, and says so."""

from dataclasses import replace
from pathlib import Path

import pytest

from tests.builders.insertions import arguments, go
from warpir.app.config import InsertConfig
from warpir.app.inputs import read_inputs
from warpir.app.run import Run
from warpir.demo import WET_ROUGHNESS, demo_config
from warpir.io.results import OutputFolder
from warpir.report.facts import _coat


@pytest.mark.parametrize(("demo", "truth"), [("wet", WET_ROUGHNESS), ("dry", None)])
def test_auto_becomes_what_the_photo_shows(tmp_path: Path, demo: str, truth: float | None) -> None:
    """The wet square mirrors about as it was rendered; with its dry photo the option is off."""
    config = demo_config(InsertConfig(demo="wet", ground_roughness="auto", out=str(tmp_path)))
    if demo == "dry":
        config = config.changed(photo=config.inputs.photo.replace("wet.jpg", "photo.png"))
    run = Run(config, read_inputs(config), OutputFolder(tmp_path / "out")).with_ground_coat()
    found = run.config.render.coat_roughness
    assert found == (None if truth is None else pytest.approx(truth, abs=0.03))
    record = run.inputs.measured["ground_coat"]
    assert record["roughness"] == found
    ((_, row),) = _coat(record)
    word = "mirrors with the roughness 0." if truth else "is matt: no mirror image found"
    assert word in run.log.assumed[0] and (f"{found:.2f} ± " if truth else "no mirror") in row


def test_stated_roughness_is_not_estimated(tmp_path: Path) -> None:
    """A number and ``off`` cost nothing and say nothing."""
    config = demo_config(InsertConfig(demo="wet", out=str(tmp_path)))
    run = Run(config, read_inputs(config), OutputFolder(tmp_path / "out"))
    assert run.with_ground_coat() is run
    off = replace(run, config=config.changed(ground_roughness="off"))
    assert off.with_ground_coat() is off and "ground_coat" not in run.inputs.measured


def test_ground_that_is_found_matt_is_left_as_without(inputs: Path, tmp_path: Path) -> None:
    """The picture keeps its bytes; `run.json` keeps the word that was asked, and the reason."""
    cheap = {"samples": "2", "depth": "2", "device": "cpu"}
    plain = go(arguments(inputs, tmp_path / "a", **cheap), tmp_path / "a")
    auto = arguments(inputs, tmp_path / "b", **cheap, **{"ground-roughness": "auto"})
    run = go(auto, tmp_path / "b")
    name = "composite.png"
    assert (run.out / name).read_bytes() == (plain.out / name).read_bytes()
    assert run.record["config"]["ground_roughness"] == "auto"
    measured = run.record["measured"]
    assert measured["ground_coat"]["roughness"] is None and measured["ground_coat"]["reason"]
    assert "ground_mirror" not in measured
