"""The self-check: what it measures on a tiny model, how it judges, and how it ends."""

import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.app.config import InsertConfig
from warpir.check_model import main
from warpir.core.errors import ExitCode
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import (
    CHECK_TIMES,
    LEAST_COSINE,
    StableDiffusion,
)
from warpir.diffusion.settings import ModelSettings
from warpir.optimize import model_check
from warpir.optimize.model_check import (
    NOISE_ERROR_MAX,
    Verdict,
    check_model,
    judge_effect,
    judge_gradient,
    judge_lora,
    judge_noise,
    judge_precision,
)

NAMES = ["noise", "prompt", "precision", "LoRA", "guidance"]
TRAINED = {"noise_error": 0.06, "precision": 0.999} | {f"difference_{t}": 0.05 for t in CHECK_TIMES}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random models of all three kinds."""
    made = tmp_path_factory.mktemp("models")
    for kind in ("epsilon", "v_prediction", "sample"):
        make_tiny_stable_diffusion(made / kind, kind)
    return made


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["epsilon", "v_prediction"])
def test_random_weights_are_not_a_trained_model(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    """They are found out by the noise alone: whatever else they do, they do soundly."""
    report = tmp_path / "report.json"
    argv = ["--model", str(folder / kind), "--device", "cpu", "--json", str(report)]
    assert main(argv) == ExitCode.MODEL
    said = capsys.readouterr().out
    assert f"64 x 64 pixels, predicts {kind}, UNet in fp32, VAE in fp32, on cpu" in said
    assert "4 of 5 checks" in said and said.count("NOT AS A TRAINED MODEL") == 1
    found = json.loads(report.read_text())
    assert found["ok"] is False and found["model"]["prediction_type"] == kind
    assert [check["name"] for check in found["checks"]] == NAMES
    assert [check["ok"] for check in found["checks"]] == [False, True, True, True, True]
    noise = found["checks"][0]["values"]
    assert noise["error"] > 0.9 * noise["error_of_nothing"]
    lora = found["checks"][3]["values"]
    assert lora["error_after"] < lora["error_before"]
    assert 0.0 < found["seconds"]["lora_step"] and 0.0 < found["seconds"]["guidance_step"]


@pytest.mark.slow
def test_a_trained_model_passes(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(StableDiffusion, "self_check", lambda *_: TRAINED)
    assert main(["--model", str(folder / "epsilon"), "--device", "cpu"]) == ExitCode.DONE
    said = capsys.readouterr()
    assert "5 of 5 checks" in said.out and "NOT AS" not in said.out and not said.err


def test_a_perfect_denoiser_is_seen_through_the_real_measurement(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that knows the photo makes no error; its LoRA, which it ignores, learns nothing."""
    config = InsertConfig(model=str(folder / "epsilon"))
    prior = load_stable_diffusion(config.diffusion, "cpu")
    photo = torch.rand(64, 96, 3, generator=torch.Generator().manual_seed(3))
    with torch.no_grad():
        clean = prior.encode(photo[:, 16:80].permute(2, 0, 1)[None].contiguous())
    empty = prior.embed([""])[0]

    def known(latents: Tensor, timesteps: Tensor, embeddings: Tensor, names: Any) -> Tensor:
        bar = prior.schedule.alphas_cumprod[timesteps].float().view(-1, 1, 1, 1)
        prompted = torch.tensor([0.0 if torch.equal(e, empty) else 0.1 for e in embeddings])
        eps = (latents - bar.sqrt() * clean) / (1.0 - bar).sqrt()
        return eps + prompted.view(-1, 1, 1, 1)

    monkeypatch.setattr(prior, "_denoise", known)
    report = check_model(prior, photo.numpy(), config, lambda line: None)
    assert [verdict.ok for verdict in report.verdicts] == [True, True, True, False, True]
    assert report.verdicts[0].values["error"] == pytest.approx(0.01, rel=1e-2)
    assert list(report.verdicts[1].values.values()) == pytest.approx([0.1] * 5, rel=1e-3)


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample"])
def test_saying_nothing_has_the_error_of_its_prediction_type(folder: Path, kind: str) -> None:
    """Expected of noise: 1; ``a^4 + a^2 s^2 |z|^2``; ``a^2 |z|^2 / s^2``."""
    prior = load_stable_diffusion(ModelSettings(model=str(folder / kind)), "cpu")
    square = torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    a2 = float(prior.schedule.alphas_cumprod[500])
    z2 = float(prior.encode(square).detach().square().mean())
    expected = {
        "epsilon": 1.0,
        "v_prediction": a2**2 + a2 * (1.0 - a2) * z2,
        "sample": a2 * z2 / (1.0 - a2),
    }[kind]
    found = [model_check._silent_error(prior, square, seed) for seed in range(32)]
    assert sum(found) / len(found) == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize(
    ("verdict", "ok"),
    [
        (judge_noise(0.06, 1.0), True),
        (judge_noise(0.06, 0.277), True),
        (judge_noise(NOISE_ERROR_MAX * 0.277, 0.277), False),
        (judge_noise(0.26, 0.277), False),
        (judge_noise(math.nan, 1.0), False),
        (judge_effect([0.02, 0.02, 0.03, 0.03, 0.05]), True),
        (judge_effect([0.02, 0.02, 0.0, 0.03, 0.05]), False),
        (judge_effect([0.02, 0.02, 0.03, 0.03, 3.0]), False),
        (judge_effect([math.nan] * 5), False),
        (judge_precision(LEAST_COSINE, "fp16"), True),
        (judge_precision(0.8, "bf16"), False),
        (judge_precision(math.nan, "fp16"), False),
        (judge_lora(0.1, 0.0999), True),
        (judge_lora(0.1, 0.1), False),
        (judge_lora(0.1, math.nan), False),
        (judge_gradient([1.0, 2.0]), True),
        (judge_gradient([1.0, math.nan]), False),
        (judge_gradient([1.0, 0.0]), False),
    ],
)
def test_verdicts(verdict: Verdict, ok: bool) -> None:
    """Each limit from both sides; nan never passes."""
    assert verdict.ok is ok
    assert verdict.line.endswith(": ok") is ok
    assert (verdict.expected in verdict.line) is not ok


@pytest.mark.slow
def test_guidance_that_is_never_finite_is_a_verdict(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It does not end the check as it would end a run."""
    delta = model_check.Guidance._delta
    monkeypatch.setattr(model_check.Guidance, "_delta", lambda *args: delta(*args) * math.nan)
    monkeypatch.setattr(model_check.Guidance, "ensure_precision", lambda self, image: 1.0)
    assert main(["--model", str(folder / "epsilon"), "--device", "cpu"]) == ExitCode.MODEL
    assert "guidance: 0 of 10 gradients usable: NOT AS" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        ([], ExitCode.USAGE, "--model: needed"),
        (["--model", "/nowhere"], ExitCode.MODEL, "/nowhere: no such folder"),
        (["--model", "m", "--photo", "/none.png"], ExitCode.INPUT, "/none.png"),
        (["--model", "m", "--device", "cuda:77"], ExitCode.USAGE, "--device"),
        (["--model", "m", "--precision", "fp8"], ExitCode.USAGE, "--precision"),
        (["--model", "m", "--asset", "a.glb"], ExitCode.USAGE, "--asset: no such flag"),
    ],
)
def test_bad_input_is_one_line(
    capsys: pytest.CaptureFixture[str], argv: list[str], code: ExitCode, words: str
) -> None:
    """Errors and statuses are those of the main command."""
    assert main(argv) == code
    error = capsys.readouterr().err
    assert words in error and error.count("error:") == 1 and "Traceback" not in error


@pytest.mark.slow
def test_a_report_that_cannot_be_written_comes_after_the_verdicts(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = ["--model", str(folder / "epsilon"), "--device", "cpu", "--json", str(tmp_path)]
    assert main(argv) == ExitCode.RESOURCES
    said = capsys.readouterr()
    assert "4 of 5 checks" in said.out and said.err.startswith(f"error: {tmp_path}: cannot be")


def test_wrong_flags_answer_without_torch() -> None:
    code = (
        "import sys\nfrom warpir.check_model import main\n"
        "assert main(['--modell', 'm']) == 2\n"
        "assert not {'torch', 'warp', 'diffusers'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "did you mean --model?" in done.stderr
