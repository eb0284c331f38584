"""Guided runs end to end on a tiny Stable Diffusion: files, losses, ablations, stop and resume."""

import json
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from tests.builders.insertions import ALWAYS, DETAIL, arguments, digest, record_of, write_inputs
from tests.builders.programs.stops import stop_run
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.app.command import parse
from warpir.app.config import InsertConfig
from warpir.app.earlier_runs import OtherRun, is_done
from warpir.core.errors import ExitCode
from warpir.core.limits import Limits
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import PersonalizeSettings
from warpir.insert import main
from warpir.io.images.photos import Photo
from warpir.io.lamps_file import read_lamps
from warpir.lighting.scene_light import SceneLight
from warpir.lighting.sg_light import narrowest
from warpir.optimize.course import unseen_plate
from warpir.optimize.model import assumed_class
from warpir.scene.light import Light, sun_lobe
from warpir.scene.tone_curves import Curves

GUIDED = (
    *("lobes.json", "lobes_shadow.json", "lora_diffusers.safetensors"),
    *("lora_kohya.safetensors", "optimization.json"),
)
RESULTS = ("composite.png", "envmap.exr", "curves.json", *GUIDED)
"""What must not depend on whether the run was stopped."""
CHEAP = {
    "device": "cpu",  # whose sums have one order, so that bytes can be compared
    "guidance": "stable-diffusion",
    "prompt": "a small box",
    "class_images": "2",
    "class_steps": "2",
    "lora_steps": "6",
    "steps": "8",
    "guidance_width": "32",
    "lobes": "8",
    "light_height": "16",
    "object_light_height": "8",
    "checkpoint_every": "2",
    "score_every": "2",
    "samples": "2",
    "light": None,
    "start": "uniform",
}


pytestmark = pytest.mark.usefixtures("one_thread", "own_cache")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, box and models, made once."""
    made = tmp_path_factory.mktemp("guided")
    write_inputs(made)
    for kind in ("epsilon", "v_prediction"):
        make_tiny_stable_diffusion(made / kind, kind)
    return made


@pytest.fixture(scope="module")
def finished(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of a run that nothing stopped, with a cache of its own."""
    out = tmp_path_factory.mktemp("finished") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARPIR_CACHE", str(out.parent / "cache"))
        assert main(argv(folder, out)) == ExitCode.DONE
    return out


def argv(folder: Path, out: Path, kind: str = "epsilon", **changes: str | None) -> list[str]:
    return arguments(folder, out, **{**CHEAP, "model": str(folder / kind), **changes})


def results(out: Path) -> dict[str, str]:
    found = digest(out)
    return {name: found[name] for name in RESULTS if name in found}


def test_guided_run_writes_every_file_and_says_who_spoke(finished: Path) -> None:
    assert {p.name for p in finished.iterdir()} == {
        *(*ALWAYS, *DETAIL, *GUIDED),
        *("progress", "run.json"),
    }
    run = record_of(finished)
    measured = run["measured"]
    assert measured["prior"] == "stable-diffusion" and measured["loop_integrator"] == "transport"
    assert set(measured["model"]["sha256"]) > {
        "text_encoder/model.safetensors",
        "unet/diffusion_pytorch_model.safetensors",
        "vae/diffusion_pytorch_model.safetensors",
    }
    assert measured["prompts"]["guidance"].startswith("a photo of a small box in a scene")
    assert measured["personalization"]["reused"] is False
    assert measured["optimization"]["steps"] == 8
    assert measured["optimization"]["skipped_steps"] == 0
    assert measured["optimization"]["clipped_steps"] == 0
    assert {"model", "personalize", "trace", "optimize", "render"} <= set(run["seconds"])
    assert any("fp32" in notice for notice in run["notices"])
    assert any("even one" in line for line in run["assumed"])
    assert any('show "box"' in line for line in run["assumed"])
    by_step = json.loads((finished / "optimization.json").read_text())["by_step"]
    assert len(by_step["gradient"]) == 8 and all(v > 0.0 for v in by_step["gradient"])
    assert sum(v is not None for v in by_step["score"]) == 4
    curves = json.loads((finished / "curves.json").read_text())
    assert curves["tone"] == "reinhard"


def test_class_that_is_taken_from_the_prompt_is_said() -> None:
    """A vase of flowers is taken for flowers; one word, one that is stated or none is no guess."""

    def assumed(prompt: str, **given: Any) -> list[str]:
        asked = PersonalizeSettings(**given)
        return list(assumed_class(make_prompts(prompt, asked), asked))

    (line,) = assumed("a vase of flowers")
    assert '"flowers"' in line and "--class-noun" in line
    assert not assumed("a car.") and not assumed("vase") and not assumed("An SUV")
    for given in ({"class_noun": "vase"}, {"class_images": 0}, {"lora": "l.safetensors"}):
        assert not assumed("a vase of flowers", **given)


@pytest.mark.parametrize(("unit", "words"), [(1e-3, "too dark"), (1e3, "too bright"), (1, "")])
def test_plate_that_the_model_cannot_see_is_said(unit: float, words: str) -> None:
    """In its own unit, clipped at 1, it may be black or white; a photograph never is."""
    srgb = np.random.default_rng(0).uniform(0.0, 1.0, (8, 12, 3)).astype(np.float32)
    plate = np.float32(unit) * srgb**2.2
    lines = list(unseen_plate(Photo(plate, np.clip(plate ** (1 / 2.2), 0.0, 1.0), "exr")))
    assert [words in line for line in lines] == [True] * bool(words)
    dark = np.full((8, 12, 3), 2, np.uint8)
    assert not list(unseen_plate(Photo(dark, dark / np.float32(255.0), "png")))


@pytest.mark.slow
def test_guided_run_again_reuses_the_lora_and_gives_the_same_bytes(
    folder: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WARPIR_CACHE", str(finished.parent / "cache"))
    out = tmp_path / "again"
    assert main(argv(folder, out)) == ExitCode.DONE
    assert record_of(out)["measured"]["personalization"]["reused"] is True
    assert results(out) == results(finished)


STOPS = {
    "class images": ("diffusion.personalization.class_images._png", 2),
    "lora before a checkpoint": ("diffusion.personalization.lora_training:LoraTraining.update", 2),
    "lora": ("diffusion.personalization.lora_training:LoraTraining.update", 4),
    "first trace": ("optimize.view:View.__init__", 1),
    "optimisation before a checkpoint": ("optimize.loop:Optimization.step", 2),
    "optimisation": ("optimize.loop:Optimization.step", 6),
    "checkpoint": ("core.atomic.write_staged", 16),
    "last render": ("report.result.make_picture", 1),
    "final files": ("io.results:OutputFolder._commit", 1),
}


@pytest.mark.parametrize("where", STOPS)
@pytest.mark.slow
def test_stopped_run_resumes_as_if_it_had_not_been(
    folder: Path, finished: Path, tmp_path: Path, where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    stop_run(argv(folder, out), *STOPS[where])
    assert not (out / "run.json").exists()
    is_kept = any((out / "checkpoints").glob("0*"))
    assert ("--resume goes on from there" in capsys.readouterr().out) == is_kept
    assert main([*argv(folder, out), "--resume"]) == ExitCode.DONE
    assert results(out) == results(finished)
    assert not (out / "checkpoints").exists()


@pytest.fixture
def unfinished(folder: Path, tmp_path: Path) -> Path:
    """A run that stopped in the optimisation."""
    out = tmp_path / "out"
    stop_run(argv(folder, out), "optimize.loop:Optimization.step", 6)
    return out


def test_unfinished_run_is_not_overwritten_by_accident(
    folder: Path, unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = digest(unfinished)
    assert main(argv(folder, unfinished)) == ExitCode.OUTPUT
    assert "holds an unfinished run" in capsys.readouterr().err
    assert digest(unfinished) == before


@pytest.mark.case("R3")
def test_resume_names_what_changed(
    folder: Path, unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = digest(unfinished)
    changed = argv(folder, unfinished, steps="9", prompt="a large box")
    assert main([*changed, "--resume"]) == ExitCode.INPUT
    error = capsys.readouterr().err
    assert "config.steps: was 8, is 9" in error and "config.prompt" in error
    assert "Traceback" not in error and digest(unfinished) == before


@pytest.mark.slow
def test_resume_follows_the_advice_to_raise_the_precision(folder: Path, unfinished: Path) -> None:
    """What a run that overflowed is told to try is no other run."""
    again = [*argv(folder, unfinished), "--resume", "--precision", "fp32"]
    assert main(again) == ExitCode.DONE
    assert record_of(unfinished)["measured"]["optimization"]["steps"] == 8


@pytest.mark.slow
def test_resume_without_a_checkpoint_starts_and_says_so(
    folder: Path, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A run may be killed before its first checkpoint; what is finished stays."""
    out = tmp_path / "none"
    assert main([*argv(folder, out), "--resume"]) == ExitCode.DONE
    assert "the run starts at its beginning" in capsys.readouterr().out
    assert results(out) == results(finished)
    assert main([*argv(folder, out), "--resume"]) == ExitCode.OUTPUT


@pytest.mark.slow
@pytest.mark.case("L9")
def test_resume_refuses_another_model(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Other weights, schedule, scale and words in the folder that is named as before."""
    model = tmp_path / "model"
    shutil.copytree(folder / "epsilon", model)
    out = tmp_path / "other"
    stop_run(argv(folder, out, model=str(model)), "optimize.loop:Optimization.step", 6)
    weights = model / "unet/diffusion_pytorch_model.safetensors"
    tensors = load_file(weights)
    tensors["conv_out.bias"] += 1e-3
    save_file(tensors, weights, {"format": "pt"})
    scheduler = model / "scheduler/scheduler_config.json"
    scheduler.write_text(scheduler.read_text().replace("0.012", "0.011"))
    for name, change in (
        ("vae/config", {"scaling_factor": 0.2}),
        ("tokenizer/tokenizer_config", {"model_max_length": 70}),
    ):
        file = model / f"{name}.json"
        file.write_text(json.dumps(json.loads(file.read_text()) | change))
    assert main([*argv(folder, out, model=str(model)), "--resume"]) == ExitCode.INPUT
    error = capsys.readouterr().err
    for name in (
        "unet/diffusion_pytorch_model.safetensors",
        "scheduler/scheduler_config.json",
        "vae/config.json",
        "tokenizer/tokenizer_config.json",
    ):
        assert f"model.{name}: was" in error
    assert "text_encoder" not in error


@pytest.mark.case("R1")
@pytest.mark.slow
def test_resume_stands_on_its_checkpoint_alone(
    folder: Path, finished: Path, unfinished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever empties the cache loses no step: the adapter is in the checkpoint."""
    shutil.rmtree(tmp_path / "cache")
    monkeypatch.setattr(
        "warpir.diffusion.personalization.lora_training.LoraTraining.update", pytest.fail
    )
    monkeypatch.setattr(
        "warpir.diffusion.models.stable_diffusion.StableDiffusion.sample", pytest.fail
    )
    assert main([*argv(folder, unfinished), "--resume"]) == ExitCode.DONE
    assert results(unfinished) == results(finished)


@pytest.mark.case("L9", "R16")
@pytest.mark.parametrize("name", ["vae/config.json", "unet/diffusion_pytorch_model.safetensors"])
def test_a_result_of_another_model_is_not_the_one_asked_for(
    folder: Path, finished: Path, name: str
) -> None:
    """What a batch calls done was made by the files that are in the model's folder now."""
    file, config = folder / "epsilon" / name, parse(argv(folder, finished)).config
    assert is_done(config)
    before = file.read_bytes()
    try:
        file.write_bytes(before + b" " if file.suffix == ".json" else before[:-1] + b"\0")
        with pytest.raises(OtherRun):
            is_done(config)
        file.unlink()
        with pytest.raises(OtherRun):
            is_done(config)
    finally:
        file.write_bytes(before)
    assert is_done(config)


@pytest.mark.case("L3")
@pytest.mark.slow
def test_pickles_are_read_by_a_run_that_allows_them(folder: Path, tmp_path: Path) -> None:
    model, out = tmp_path / "model", tmp_path / "out"
    shutil.copytree(folder / "epsilon", model)
    for file in [*model.rglob("*.safetensors")]:
        stem = file.stem.replace("model", "pytorch_model") if file.stem == "model" else file.stem
        torch.save(load_file(file), file.with_name(f"{stem}.bin"))
        file.unlink()
    few = {"no_personalize": "", "loss": "csd", "steps": "1", "score_every": "0"}
    asked = argv(folder, out, model=str(model), **few)
    assert main(asked) == ExitCode.MODEL
    assert main([*asked, "--allow-pickle"]) == ExitCode.DONE
    assert any("--allow-pickle" in notice for notice in record_of(out)["notices"])


def test_a_finished_run_is_not_resumed(
    folder: Path, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = digest(finished)
    assert main([*argv(folder, finished), "--resume"]) == ExitCode.OUTPUT
    assert f"the run in {finished} is finished" in capsys.readouterr().err
    assert digest(finished) == before


@pytest.mark.slow
def test_overwrite_starts_an_unfinished_run_again(
    folder: Path, finished: Path, unfinished: Path
) -> None:
    assert main([*argv(folder, unfinished), "--overwrite"]) == ExitCode.DONE
    assert results(unfinished) == results(finished)


@pytest.mark.slow
def test_stopped_overwrite_resumes(folder: Path, finished: Path, tmp_path: Path) -> None:
    """The results that were to be replaced do not stand in the way, and stay until the end."""
    out = tmp_path / "out"
    assert main(argv(folder, out, seed="5", steps="0", lora_steps="0")) == ExitCode.DONE
    before = results(out)
    stop_run([*argv(folder, out), "--overwrite"], "optimize.loop:Optimization.step", 6)
    assert results(out) == before
    assert main([*argv(folder, out), "--resume"]) == ExitCode.DONE
    assert results(out) == results(finished)


@pytest.mark.parametrize(
    "loss",
    ["sds", "sds-base", "csd", "lds-lora-both", "lds-negative", "dataset-update"],
)
@pytest.mark.slow
def test_every_loss_runs(folder: Path, tmp_path: Path, loss: str) -> None:
    changes = {"loss": loss, "steps": "3", "score_every": "0", "lora_steps": "1"}
    if loss == "lds-negative":
        changes["negative_prompt"] = "a drawing"
    if loss == "dataset-update":
        changes |= {"update_every": "2", "update_steps": "2"}
    out = tmp_path / "out"
    assert main(argv(folder, out, **changes)) == ExitCode.DONE
    by_step = json.loads((out / "optimization.json").read_text())["by_step"]
    assert len(by_step["gradient"]) == 3 and all(v > 0.0 for v in by_step["gradient"])
    asks_base_alone = loss in ("csd", "sds-base")
    assert (out / "lora_kohya.safetensors").exists() != asks_base_alone
    assert any("does without a LoRA" in x for x in record_of(out)["notices"]) == asks_base_alone


@pytest.mark.slow
def test_ablations(folder: Path, tmp_path: Path) -> None:
    """No tone curve, two lights, one light, no class images, no adapter, v-prediction."""
    few = {"steps": "3", "score_every": "0", "lora_steps": "2"}
    out = tmp_path / "apart"
    assert main(argv(folder, out, fusion="none", no_tone_curve="", **few)) == ExitCode.DONE
    assert (out / "envmap_shadow.exr").exists()
    for curve in ("foreground", "shadow_ratio"):
        knots = json.loads((out / "curves.json").read_text())[curve]
        assert knots["x"] == knots["y"]
    out = tmp_path / "single"
    assert main(argv(folder, out, "v_prediction", fusion="single", **few)) == ExitCode.DONE
    assert not (out / "envmap_shadow.exr").exists() and not (out / "lobes_shadow.json").exists()
    out = tmp_path / "concept"
    assert main(argv(folder, out, class_images="0", **few)) == ExitCode.DONE
    assert record_of(out)["measured"]["personalization"]["class_prompts"] == []
    out = tmp_path / "base"
    changes = {"no_personalize": "", "loss": "csd", "integrator": "mis", "mis_samples": "2"}
    assert main(argv(folder, out, **few, **changes)) == ExitCode.DONE
    assert not (out / "lora_kohya.safetensors").exists()


@pytest.mark.slow
def test_start_from_a_given_light_preview_and_prior(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    changes = {"light": str(folder / "sky.hdr"), "start": None, "preview_every": "2", "steps": "4"}
    changes |= {"show_prior": "a photo of a red box", "lora_steps": "2"}
    assert main(argv(folder, out, **changes)) == ExitCode.DONE
    assert sorted(p.name for p in (out / "progress").iterdir()) == [
        "preview-000000.png",
        "preview-000002.png",
        "preview-000004.png",
    ]
    assert (out / "prior.png").exists()
    assert record_of(out)["measured"]["personalization"]["reused"] is False
    assert not any("even one" in line for line in record_of(out)["assumed"])


def test_start_keeps_the_flux_of_a_sun_that_is_too_narrow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lobes that the loop's maps cannot hold are widened, and dimmed as much."""
    from warpir.optimize import recover

    monkeypatch.setattr(recover, "start_level", lambda *_: 0.5)
    config = InsertConfig(sun=(30.0, 40.0), lobes=4, light_height=16)
    sun = Light(sun_lobe(30.0, 40.0, (5.0, 4.0, 3.0)))
    run = cast(recover.Run, SimpleNamespace(config=config, inputs=SimpleNamespace(lamps=())))
    curves = Curves.identity("reinhard")
    unknowns = recover.unknowns_of(run, recover.Start(SceneLight(sun, sun, curves, 0.0, ())))
    lobes = unknowns.light_fg.lobes()
    assert (1.0 / np.sqrt(lobes.sharpness)).min() > 0.999 * narrowest(16)
    assert sun.lobes is not None
    expected = sun.lobes.flux().sum(axis=0)
    np.testing.assert_allclose(lobes.flux().sum(axis=0), expected, rtol=0.05)


def test_recovered_light_is_reused(folder: Path, finished: Path, tmp_path: Path) -> None:
    out = tmp_path / "reused"
    flags = arguments(folder, out, light=None, reuse=str(finished), place="0.3,0,-4")
    assert main(flags) == ExitCode.DONE
    assert digest(out)["envmap.exr"] == digest(finished)["envmap.exr"]
    assert digest(out)["curves.json"] == digest(finished)["curves.json"]


@pytest.mark.slow
def test_recovered_lamps_light_the_picture_and_are_written(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    lamp = {"lamp": "0.8,1.5,-3,0.1,20,1,0.5,0.25", "recover_lamps": ""}
    few = {"steps": "3", "score_every": "0", "lora_steps": "1"}
    assert main(argv(folder, out, **lamp, **few)) == ExitCode.DONE
    (found,) = read_lamps(out / "lamps.json", Limits(), [])
    (used,) = record_of(out)["measured"]["lamps"]
    np.testing.assert_allclose(found.power, used["power"], rtol=1e-12)
    assert not np.isclose(found.power, [20.0, 10.0, 5.0], rtol=1e-3).any()
    np.testing.assert_allclose(found.center, [0.8, 1.5, -3.0])


def test_object_too_far_to_be_seen_is_one_line(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(argv(folder, out, place="0,0,-900")) == ExitCode.INPUT
    error = capsys.readouterr().err
    assert "covers no pixel of the 32 x 21" in error and "Traceback" not in error
    assert error.count("error:") == 1 and not (out / "run.json").exists()


@pytest.mark.case("R3")
def test_resume_of_another_version_is_refused(
    folder: Path,
    unfinished: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Other sources may compute another result; a checkout has them without another number."""
    import warpir.app.record

    monkeypatch.setattr(warpir.app.record, "sources_hash", lambda: "0" * 64)
    assert main([*argv(folder, unfinished), "--resume"]) == ExitCode.INPUT
    assert "versions.warpir: was" in capsys.readouterr().err


@pytest.mark.case("F5")
def test_unguided_run_does_not_take_the_place_of_an_unfinished_one(
    folder: Path, unfinished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else --resume would replace its results, and neither command had --overwrite."""
    before = digest(unfinished)
    plain = [*argv(folder, unfinished), "--guidance", "none"]
    for more in ([], ["--validate"]):
        assert main([*plain, *more]) == ExitCode.OUTPUT
        assert "holds an unfinished run" in capsys.readouterr().err
    assert digest(unfinished) == before
