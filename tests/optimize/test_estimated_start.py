"""Runs that begin with the light estimated from the photo: alone, and where a model guides them.

Random weights know nothing about light. What is tested is what a run does with their answers.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.insertions import arguments, digest, record_of, write_inputs
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.app.config import InsertConfig
from warpir.app.inputs import read_inputs
from warpir.app.run import Run
from warpir.core.errors import ExitCode
from warpir.demo import demo_config
from warpir.insert import main
from warpir.io.images.photos import read_photo
from warpir.io.results import OutputFolder
from warpir.lighting.regularizers import SPREAD_MAX
from warpir.lighting.sg_light import narrowest
from warpir.optimize import recover
from warpir.optimize.acceptance import Verdict
from warpir.train.networks.regressor import random_regressor, save_regressor

CHEAP = {
    "guidance_width": "32",
    "light_height": "16",
    "object_light_height": "8",
    "steps": "4",
    "score_every": "2",
    "checkpoint_every": "2",
    "preview_every": "2",
    "samples": "2",
    "lora_steps": "2",
    "class_images": "0",
    "light": None,
}


pytestmark = pytest.mark.usefixtures("one_thread", "own_cache")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, box, a model and the weights of a regressor."""
    made = tmp_path_factory.mktemp("estimated")
    write_inputs(made)
    make_tiny_stable_diffusion(made / "model")
    save_regressor(random_regressor(1), made / "regressor.safetensors", {})
    return made


def argv(folder: Path, out: Path, **changes: str | None) -> list[str]:
    files = {"model": str(folder / "model"), "regressor": str(folder / "regressor.safetensors")}
    return arguments(folder, out, **{**CHEAP, **files, "prompt": "a box", **changes})


UNGUIDED = dict.fromkeys(
    ("model", "prompt", "lora_steps", "class_images", "steps", "guidance_width"),
)
"""Flags that a run without a model leaves out."""


def judged_as(monkeypatch: pytest.MonkeyPatch, is_accepted: bool) -> None:
    verdict = Verdict(is_accepted, -3.0 if is_accepted else 2.0, 1.0, 16)
    monkeypatch.setattr(recover, "judge", lambda *_: verdict)


@pytest.mark.slow
def test_default_run_is_the_estimated_light(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """No model is asked; the light is that of --guidance none with a model at hand."""
    out, alone = tmp_path / "out", tmp_path / "alone"
    flags = argv(folder, out, **UNGUIDED, device="cpu")
    assert main([*flags, "--validate"]) == ExitCode.DONE
    assert main(flags) == ExitCode.DONE
    said = capsys.readouterr().out
    measured = record_of(out)["measured"]
    spread = measured["regression"]["spread_deg"]
    assert f"light regressed from the photo, +- {spread:.0f} degrees" in said
    assert measured["prior"] == "none" and "acceptance" not in measured
    assert [p.name for p in (out / "progress").iterdir()] == ["preview-000000.png"]
    more = {"guidance": "none", "preview_every": "0", "device": "cpu"}
    assert main(argv(folder, alone, **more)) == ExitCode.DONE
    assert not (alone / "progress").exists()
    for name in ("lobes.json", "curves.json", "envmap.exr", "composite.png"):
        assert digest(out)[name] == digest(alone)[name]


def test_preview_is_the_result_in_small(folder: Path, tmp_path: Path) -> None:
    """A grainy picture of the photo's size under the same light, written before the result."""
    out = tmp_path / "out"
    flags = argv(folder, out, **UNGUIDED, samples="64", device="cpu")
    assert main(flags) == ExitCode.DONE
    shown, result = (
        read_photo(path).srgb
        for path in (out / "progress" / "preview-000000.png", out / "composite.png")
    )
    before = read_photo(folder / "photo.png").srgb
    assert shown.shape == result.shape
    off, change = (np.abs(x - result).mean() for x in (shown, before))
    assert 0.0 < off < 0.5 * change


@pytest.mark.slow
def test_guided_run_says_where_it_began(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Estimate, model and verdict: report and output name all three."""
    judged_as(monkeypatch, True)
    out = tmp_path / "out"
    assert main(argv(folder, out, accept="", device="cpu")) == ExitCode.DONE
    said = capsys.readouterr().out
    assert "summary: prior stable-diffusion (sha256" in said
    assert "its end accepted; light regressed from the photo, +- " in said
    assert "degrees; transport and mis on cpu" in said
    assert "accepted: guidance, asked anew, prefers the end (dU = -3 +- 1)" in said
    previews = [f"preview-{step:06d}.png" for step in (0, 2, 4)]
    assert sorted(p.name for p in (out / "progress").iterdir()) == previews
    run = record_of(out)
    measured = run["measured"]
    assert len(measured["prior_sha256"]) == 64 and "regressor" in run["inputs"]
    assert any("what the regressor sees in the photo" in line for line in run["assumed"])
    assert measured["settings"] == {"steps": 4, "tone": "reinhard"}
    assert 0.0 < measured["regression"]["spread_deg"] < 180.0
    numbers = measured["acceptance"]
    assert (numbers["rise"], numbers["error"], numbers["is_accepted"]) == (-3.0, 1.0, True)
    assert all(math.isfinite(numbers[f"score_{end}"]) for end in ("start", "end"))
    assert measured["end_light"] == pytest.approx(measured["light"], rel=1e-3)
    by_step = json.loads((out / "optimization.json").read_text())["by_step"]
    assert by_step["trust"][0] == pytest.approx(0.0, abs=1e-9) and by_step["trust"][3] > 0.0


@pytest.mark.slow
def test_refused_end_is_the_start(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The result is that of the estimate alone, and what was refused is still reported."""
    judged_as(monkeypatch, False)
    out, alone = tmp_path / "out", tmp_path / "alone"
    flags = {"accept": "", "tone": "linear"}
    assert main(argv(folder, out, **flags)) == ExitCode.DONE
    line = "kept the start: guidance could not show an improvement (dU = 2 +- 1)"
    assert line in capsys.readouterr().out
    assert main(argv(folder, alone, **UNGUIDED)) == ExitCode.DONE
    for name in ("lobes.json", "curves.json", "envmap.exr", "composite.png"):
        assert digest(out)[name] == digest(alone)[name]
    assert not (out / "lobes_shadow.json").exists()
    run = record_of(out)
    assert line in run["notices"] and run["measured"]["acceptance"]["is_accepted"] is False
    measured = run["measured"]
    assert measured["start_light"] == measured["light"] != measured["end_light"]


@pytest.mark.slow
def test_judging_leaves_the_end_as_it_was(folder: Path, tmp_path: Path) -> None:
    """The model's verdict is a finite number; what is judged is the end of the same run."""
    judged, plain = tmp_path / "judged", tmp_path / "plain"
    assert main(argv(folder, judged, accept="")) == ExitCode.DONE
    assert main(argv(folder, plain)) == ExitCode.DONE
    assert "acceptance" not in record_of(plain)["measured"]
    numbers = record_of(judged)["measured"]["acceptance"]
    assert math.isfinite(numbers["rise"]) and numbers["error"] > 0.0
    assert record_of(judged)["measured"]["end_light"] == record_of(plain)["measured"]["end_light"]
    same = digest(judged)["envmap.exr"] == digest(plain)["envmap.exr"]
    assert same == numbers["is_accepted"]


def made_run(config: InsertConfig, folder: Path) -> Run:
    """A run whose output nobody looks at."""
    with OutputFolder(folder / "unused", overwrite=True) as output:
        return Run(config, read_inputs(config), output)


def config_of(folder: Path, **changes: Any) -> InsertConfig:
    return InsertConfig(
        photo=str(folder / "photo.png"), asset=str(folder / "box.glb"), out="o", fov=60.0,
        pitch=-15.0, camera_height=1.5, place=(0.0, 0.0, -5.0), guidance_width=48,
        light_height=16, object_light_height=8, regressor=str(folder / "regressor.safetensors"),
        steps=4, **changes,
    )  # fmt: skip


def test_start_is_the_regressed_light(folder: Path, tmp_path: Path) -> None:
    """Both sets of lobes begin with it: same directions, same irradiance, a width the maps hold."""
    from warpir.lighting.estimate import estimate_light

    for tone, albedo in (("linear", None), ("reinhard", None), ("linear", 0.9)):
        run = made_run(config_of(folder, tone=tone, ground_albedo=albedo), tmp_path)
        estimate = estimate_light(run.inputs, run.config.light, run.config.tone_operator)
        start = recover.Start(estimate.light, estimate)
        unknowns = recover.unknowns_of(run, start)
        found = estimate.regression
        for light in (unknowns.light_fg, unknowns.light_shadow):
            lobes = light.lobes()
            np.testing.assert_allclose(lobes.axis[0], found.axis, atol=1e-6)
            assert 1.0 / math.sqrt(lobes.sharpness[0]) >= 0.999 * narrowest(16)
            expected = found.lobes(narrowest(16)).flux() * estimate.gain
            np.testing.assert_allclose(lobes.flux(), expected, rtol=2e-3)
        region = recover.region_of(start, unknowns)
        assert region is not None
        believed = min(math.radians(found.spread_deg), SPREAD_MAX)
        assert region.spread == pytest.approx(believed)
        # Only an operator that darkens is made up for, and ground of a stated albedo.
        assert estimate.ground is not None and (estimate.ground.stops == 0.0) == (albedo is None)
        of_tone = estimate.gain / 2.0**estimate.ground.stops
        assert of_tone == pytest.approx(1.0) if tone == "linear" else of_tone > 1.0


@pytest.mark.slow
def test_demo_does_the_real_job(folder: Path, tmp_path: Path) -> None:
    """--demo with a model recovers its light; its own is not looked at."""
    out = tmp_path / "demo"
    flags = ["--demo", "--out", str(out), "--width", "64", "--steps", "2", "--samples", "1"]
    flags += ["--light-height", "16", "--object-light-height", "8", "--guidance-width", "64"]
    flags += ["--model", str(folder / "model"), "--prompt", "a car", "--class-images", "0"]
    flags += ["--lora-steps", "2", "--regressor", str(folder / "regressor.safetensors")]
    assert main(flags) == ExitCode.DONE
    run = record_of(out)
    assert run["measured"]["prior"] == "stable-diffusion" and "light" not in run["inputs"]
    assert demo_config(InsertConfig(demo=True, out="o")).light.file is None
