"""Runs that the embedded prior guides, with random weights: start, verdict, report, resume, demo.

Random weights know nothing about light. What is tested is what a run does with what it is told.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.builders.insertions import ALWAYS, DETAIL, arguments, digest, write_inputs
from tests.builders.programs.stops import Killed, stop_at, stop_hard
from warpir.app.config import InsertConfig
from warpir.app.inputs import read_inputs
from warpir.app.run import Run
from warpir.core.errors import ExitCode
from warpir.demo import demo_config
from warpir.diffusion.models import embedded
from warpir.diffusion.models.embedded import GBUFFER_CHANNELS
from warpir.insert import main
from warpir.io.images.photos import read_photo
from warpir.io.results import OutputFolder
from warpir.lighting.regression import regress
from warpir.lighting.regressor import load_regressor, random_regressor, save_regressor
from warpir.lighting.regularizers import SPREAD_MAX
from warpir.lighting.sg_light import narrowest
from warpir.optimize import recover
from warpir.optimize.acceptance import Verdict
from warpir.optimize.course import make_frame
from warpir.optimize.view import gbuffer_of, with_light

CHEAP = {
    "guidance_width": "32",
    "light_height": "16",
    "object_light_height": "8",
    "steps": "4",
    "score_every": "2",
    "checkpoint_every": "2",
    "preview_every": "2",
    "samples": "2",
    "light": None,
}
NETWORK = embedded.NetworkConfig(widths=(16, 32), layers=1, head_width=16, groups=8)
ABOUT = (
    "prior: embedded, trained on rendered scenes, experimental: it failed its release gate; for "
    "photographs Stable Diffusion is recommended"
)


pytestmark = pytest.mark.usefixtures("one_thread", "own_cache")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, box, and weights of both networks."""
    made = tmp_path_factory.mktemp("embedded")
    write_inputs(made)
    network = embedded.build_network(NETWORK, seed=1)
    embedded.save_embedded(network, made / "prior.safetensors", {})
    save_regressor(random_regressor(1), made / "regressor.safetensors", {})
    return made


def argv(folder: Path, out: Path, **changes: str | None) -> list[str]:
    weights = {name: str(folder / f"{name}.safetensors") for name in ("prior", "regressor")}
    return arguments(folder, out, **{**CHEAP, **weights, **changes})


def record(out: Path) -> dict[str, Any]:
    read: dict[str, Any] = json.loads((out / "run.json").read_text())
    return read


def judged_as(monkeypatch: pytest.MonkeyPatch, is_accepted: bool) -> None:
    verdict = Verdict(is_accepted, -3.0 if is_accepted else 2.0, 1.0, 16)
    monkeypatch.setattr(recover, "judge", lambda *_: verdict)


def test_default_run_is_the_regressed_light(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The prior is not asked, nor need it be there; the picture is that of --guidance none."""
    monkeypatch.setattr(embedded, "WEIGHTS", tmp_path / "absent.safetensors")
    few = dict.fromkeys(("prior", "steps", "preview_every", "checkpoint_every"))
    out, alone = tmp_path / "out", tmp_path / "alone"
    flags = argv(folder, out, **few)
    assert main([*flags, "--validate"]) == ExitCode.DONE
    assert main(flags) == ExitCode.DONE
    said = capsys.readouterr().out
    measured = record(out)["measured"]
    spread = measured["regression"]["spread_deg"]
    assert f"light regressed from the photo, +- {spread:.0f} degrees" in said
    not_asked = "the embedded prior was not asked (--steps 60: experimental, it failed its release"
    assert not_asked in said and not_asked in measured["prior_about"]
    assert measured["prior"] == "none" and "acceptance" not in measured
    assert [p.name for p in (out / "progress").iterdir()] == ["preview-000000.png"]
    assert main(argv(folder, alone, guidance="none", **few)) == ExitCode.DONE
    assert not (alone / "progress").exists()
    assert "prior_about" not in record(alone)["measured"]
    for name in ("lobes.json", "curves.json", "envmap.exr", "composite.png"):
        assert digest(out)[name] == digest(alone)[name]


def test_preview_is_the_result_in_small(folder: Path, tmp_path: Path) -> None:
    """A grainy picture of the photo's size under the same light, written before the result."""
    out = tmp_path / "out"
    few = {"prior": None, "steps": None, "samples": "64", "preview_every": None}
    assert main(argv(folder, out, **few)) == ExitCode.DONE
    shown, result = (
        read_photo(path).srgb
        for path in (out / "progress" / "preview-000000.png", out / "composite.png")
    )
    before = read_photo(folder / "photo.png").srgb
    assert shown.shape == result.shape
    off, change = (np.abs(x - result).mean() for x in (shown, before))
    assert 0.0 < off < 0.5 * change


def test_guided_run_says_who_spoke(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With --steps the embedded prior guides, and report and output say all of it."""
    judged_as(monkeypatch, True)
    out = tmp_path / "out"
    assert main(argv(folder, out)) == ExitCode.DONE
    said = capsys.readouterr().out
    assert ABOUT in said and "summary: prior embedded (sha256" in said
    assert "its end accepted; light regressed from the photo, +- " in said
    assert "degrees; transport and mis on cpu" in said
    assert "accepted: guidance, asked anew, prefers the end (dU = -3 +- 1)" in said
    names = {"lobes.json", "optimization.json", "progress", "run.json"}
    assert {p.name for p in out.iterdir()} == {*ALWAYS, *DETAIL, *names}
    previews = [f"preview-{step:06d}.png" for step in (0, 2, 4)]
    assert sorted(p.name for p in (out / "progress").iterdir()) == previews
    run = record(out)
    measured = run["measured"]
    assert measured["prior"] == "embedded" and ABOUT in measured["prior_about"]
    assert len(measured["prior_sha256"]) == 64 and set(run["inputs"]) >= {"prior", "regressor"}
    assert any(ABOUT in notice for notice in run["notices"])
    assert any("what the regressor sees in the photo" in line for line in run["assumed"])
    settings = measured["settings"]
    assert (settings["loss"], settings["noises"], settings["steps"]) == ("sds-base", 2, 4)
    assert settings["personalize"] is False and settings["tone"] == "linear"
    assert measured["prompts"]["guidance"] == "consistent object"
    assert measured["prompts"]["negative"] == "mismatched object"
    assert 0.0 < measured["regression"]["spread_deg"] < 180.0
    numbers = measured["acceptance"]
    assert (numbers["rise"], numbers["error"], numbers["is_accepted"]) == (-3.0, 1.0, True)
    for name in ("score", "good_bad"):
        assert all(math.isfinite(numbers[f"{name}_{end}"]) for end in ("start", "end"))
    assert measured["end_light"] == pytest.approx(measured["light"], rel=1e-3)
    by_step = json.loads((out / "optimization.json").read_text())["by_step"]
    assert by_step["trust"][0] == pytest.approx(0.0, abs=1e-9) and by_step["trust"][3] > 0.0
    curves = json.loads((out / "curves.json").read_text())
    assert curves["tone"] == "linear"


@pytest.mark.slow
def test_refused_end_is_the_start(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The result is that of the regression alone, and what was refused is still reported."""
    judged_as(monkeypatch, False)
    out, alone = tmp_path / "out", tmp_path / "alone"
    assert main(argv(folder, out)) == ExitCode.DONE
    line = "kept the start: guidance could not show an improvement (dU = 2 +- 1)"
    assert line in capsys.readouterr().out
    few = dict.fromkeys(("prior", "guidance_width", "checkpoint_every", "preview_every", "steps"))
    assert main(argv(folder, alone, guidance="none", **few)) == ExitCode.DONE
    for name in ("lobes.json", "curves.json", "envmap.exr", "composite.png"):
        assert digest(out)[name] == digest(alone)[name]
    assert not (out / "lobes_shadow.json").exists()
    run = record(out)
    assert line in run["notices"] and run["measured"]["acceptance"]["is_accepted"] is False
    measured = run["measured"]
    assert measured["start_light"] == measured["light"] != measured["end_light"]


def test_verdict_can_be_left_out(folder: Path, tmp_path: Path) -> None:
    """--no-accept keeps the end whatever guidance says of it; nothing is judged."""
    out = tmp_path / "out"
    assert main(argv(folder, out, no_accept="", preview_every="0")) == ExitCode.DONE
    run = record(out)
    assert "acceptance" not in run["measured"] and "accept" not in run["seconds"]
    assert (out / "lobes.json").exists() and not (out / "progress").exists()


@pytest.mark.slow
def test_judging_leaves_the_end_as_it_was(folder: Path, tmp_path: Path) -> None:
    """The verdict of the real prior is a finite number; the kept end is that of --no-accept."""
    judged, plain = tmp_path / "judged", tmp_path / "plain"
    assert main(argv(folder, judged)) == ExitCode.DONE
    assert main(argv(folder, plain, no_accept="")) == ExitCode.DONE
    numbers = record(judged)["measured"]["acceptance"]
    assert math.isfinite(numbers["rise"]) and numbers["error"] > 0.0
    assert record(judged)["measured"]["end_light"] == record(plain)["measured"]["end_light"]
    same = digest(judged)["envmap.exr"] == digest(plain)["envmap.exr"]
    assert same == numbers["is_accepted"]


def test_a_loss_without_an_adapter_and_without_the_photo(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    few = {"loss": "csd", "null_background": "drop", "steps": "2", "no_accept": ""}
    assert main(argv(folder, out, **few)) == ExitCode.DONE
    by_step = json.loads((out / "optimization.json").read_text())["by_step"]
    assert len(by_step["gradient"]) == 2 and all(v > 0.0 for v in by_step["gradient"])


@pytest.mark.slow
def test_adapted_to_the_photo(folder: Path, tmp_path: Path) -> None:
    """--personalize trains a LoRA through the same code, and its files are written."""
    out = tmp_path / "out"
    few = {"personalize": "", "lora_steps": "2", "class_images": "0", "steps": "2"}
    assert main(argv(folder, out, **few, prompt="a red car")) == ExitCode.DONE
    assert (out / "lora_diffusers.safetensors").exists()
    measured = record(out)["measured"]
    assert measured["settings"]["personalize"] is True and measured["settings"]["loss"] == "sds"
    assert measured["prompts"]["guidance"] == "consistent car in the style of sks rendering"
    assert "the embedded prior does not know: red" in record(out)["notices"]


@pytest.mark.slow
def test_stopped_run_resumes_as_if_it_had_not_been(folder: Path, tmp_path: Path) -> None:
    """In the loop: the start is read off the photo again, and the verdict is the same."""
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert main(argv(folder, whole)) == ExitCode.DONE
    with pytest.MonkeyPatch.context() as patch:
        stop_at(patch, "optimize.loop:Optimization.step", 4)
        with pytest.raises(Killed):
            stop_hard(argv(folder, out))
    assert main([*argv(folder, out), "--resume"]) == ExitCode.DONE
    same = ("composite.png", "envmap.exr", "curves.json", "optimization.json")
    assert {n: digest(out)[n] for n in same} == {n: digest(whole)[n] for n in same}
    assert record(out)["measured"]["acceptance"] == record(whole)["measured"]["acceptance"]


@pytest.mark.parametrize("validate", [False, True])
@pytest.mark.parametrize("absent", ["prior", "regressor"])
def test_absent_weights_are_one_line(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    absent: str,
    validate: bool,
) -> None:
    """A file that is not there, before anything is written and in a look at the inputs."""
    out = tmp_path / "out"
    flags = argv(folder, out, **{absent: "/nowhere.safetensors"})
    assert main([*flags, *["--validate"] * validate]) == ExitCode.MODEL
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and "/nowhere.safetensors" in error
    assert not (out / "run.json").exists()


def test_absent_package_weights_say_so(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(embedded, "WEIGHTS", tmp_path / "prior.safetensors")
    assert main(argv(folder, tmp_path / "out", prior=None)) == ExitCode.MODEL
    assert "not in this installation" in capsys.readouterr().err


def made_run(config: InsertConfig, folder: Path) -> Run:
    """A run whose output nobody looks at."""
    config = config.settled(on_cuda=False)
    with OutputFolder(folder / "unused", overwrite=True) as output:
        return Run(config, read_inputs(config), output)


def config_of(folder: Path, **changes: Any) -> InsertConfig:
    return InsertConfig(
        photo=str(folder / "photo.png"), asset=str(folder / "box.glb"), out="o", fov=60.0,
        pitch=-15.0, camera_height=1.5, place=(0.0, 0.0, -5.0), guidance_width=48,
        light_height=16, object_light_height=8, regressor=str(folder / "regressor.safetensors"),
        prior=str(folder / "prior.safetensors"), steps=4, **changes,
    )  # fmt: skip


def test_prior_sees_the_object_as_in_its_training(folder: Path, tmp_path: Path) -> None:
    """Mask, display-encoded albedo, camera-space normals; all 0 beside the object.

    A box seen from the front and from above, by a camera that looks down by 30 degrees.
    """
    config = config_of(folder).changed(pitch=-30.0, camera_height=3.0)
    run = made_run(config, tmp_path)
    frame = make_frame(run)
    gbuffer = gbuffer_of(frame)
    assert gbuffer.shape == (1, 7, 32, 48) and gbuffer.dtype == torch.float32
    mask, albedo, normals = gbuffer[0].split([1, 3, 3])
    np.testing.assert_array_equal(mask[0].numpy(), frame.coverage())
    assert not gbuffer[:, 1:, mask[0] == 0.0].any()
    inside = normals[:, mask[0] == 1.0]
    assert torch.allclose(inside.norm(dim=0), torch.ones(inside.shape[1]), atol=1e-3)
    s, c = math.sin(math.radians(30.0)), math.cos(math.radians(30.0))
    # The front's +Z and the top's +Y in the camera's frame.
    for face in ((0.0, -s, c), (0.0, c, s)):
        near = inside.T @ torch.tensor(face) > 0.999
        assert near.float().mean() > 0.1
    base = run.inputs.asset.materials[0].base_color
    expected = np.asarray(base) ** (1.0 / 2.2)
    found = albedo[:, mask[0] == 1.0].mean(dim=1).numpy()
    np.testing.assert_allclose(found, expected, atol=1e-3)


def test_prior_is_told_the_regressed_light(folder: Path, tmp_path: Path) -> None:
    """A first guess of the object's picture, dark beside it, and one direction for all pixels."""
    config = config_of(folder)
    run = made_run(config, tmp_path)
    frame = make_frame(run)
    camera = frame.renderer.scene.camera
    network = load_regressor(folder / "regressor.safetensors")
    regression = regress(network, run.inputs.photo.srgb, run.inputs.camera)
    plain = gbuffer_of(frame)
    told = with_light(plain, regression, camera)
    assert told.shape == (1, GBUFFER_CHANNELS, 32, 48) and told.dtype == torch.float32
    assert torch.equal(told[:, :7], plain)
    mask = plain[0, 0]
    assert not told[0, 7:10, mask == 0.0].any()
    toward = told[0, 10:].flatten(1)
    assert torch.equal(toward, toward[:, :1].expand_as(toward))
    place = tuple(torch.nonzero(mask == 1.0)[0].tolist())
    normal = plain[0, 4:7, *place].double().numpy() @ camera.c2w[:3, :3].T
    albedo = plain[0, 1:4, *place].double().numpy() ** 2.2
    expected = np.clip(albedo * regression.irradiance(normal) / np.pi, 0.0, 1.0) ** (1.0 / 2.2)
    np.testing.assert_allclose(told[0, 7:10, *place].numpy(), expected, atol=1e-5)


def test_start_is_the_regressed_light(folder: Path, tmp_path: Path) -> None:
    """Both sets of lobes begin with it: same directions, same irradiance, a width the maps hold."""
    from warpir.lighting.estimate import estimate_light

    for tone, albedo in (("linear", None), ("reinhard", None), ("linear", 0.9)):
        run = made_run(config_of(folder, tone=tone, ground_albedo=albedo), tmp_path)
        estimate = estimate_light(run.inputs, run.config.light, run.config.tone_operator, "cpu")
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
    """--demo with --steps recovers its light; its own is not looked at."""
    out = tmp_path / "demo"
    flags = ["--demo", "--out", str(out), "--width", "64", "--steps", "2", "--samples", "1"]
    flags += ["--light-height", "16", "--object-light-height", "8", "--guidance-width", "64"]
    for name in ("prior", "regressor"):
        flags += [f"--{name}", str(folder / f"{name}.safetensors")]
    assert main(flags) == ExitCode.DONE
    run = record(out)
    assert run["measured"]["prior"] == "embedded" and "light" not in run["inputs"]
    assert demo_config(InsertConfig(demo=True, out="o")).light.file is None
