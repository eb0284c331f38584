"""Training of the embedded prior: its loss, its draws, and runs that go on where others stopped."""

import copy
import json
import math
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import warpir.diffusion.train.loop as module
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.embedded import NetworkConfig, build_network, load_embedded
from warpir.diffusion.models.embedded_words import tokenize, training_tokens
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.train.loop import (
    CURVE,
    Held,
    Progress,
    checkpoints_of,
    export_prior,
    read_checkpoint,
    train_prior,
)
from warpir.diffusion.train.objective import Objective, TrainSettings, pixel_weight, schedule_on
from warpir.diffusion.train.validation import Validation, by_sigma
from warpir.diffusion.train.worker import Worker
from warpir.train.command import main

pytestmark = pytest.mark.usefixtures("one_thread")

TINY = NetworkConfig(
    widths=(16, 32), layers=1, attention_from=1, head_width=16, groups=8, embedding_width=16
)
SETTINGS = TrainSettings(
    network=TINY, batch=4, rate=4e-3, warmup_steps=4, resume_warmup_steps=2, average=0.8,
    log_every=5, step_limit=12,
)  # fmt: skip
CPU = torch.device("cpu")


@dataclass
class Toy:
    """A batch of flat squares on flat backgrounds, lit alike or not."""

    image: Tensor
    background: Tensor
    gbuffer: Tensor
    noun: Tensor
    setting: Tensor
    weather: Tensor
    kind: Tensor


def draw(count: int, generator: torch.Generator) -> Toy:
    kind = (torch.rand(count, generator=generator) < 0.5).long()
    colour, other = (torch.rand(count, 3, 1, 1, generator=generator) for _ in range(2))
    mask = torch.zeros(count, 1, 64, 64)
    mask[:, :, 20:44, 20:44] = 1.0
    background = colour.expand(-1, -1, 64, 64).contiguous()
    lit = torch.where(kind[:, None, None, None] > 0, other, colour)
    image = background * (1.0 - mask) + 0.5 * lit * mask
    background = torch.cat([background, background], dim=1)
    gbuffer = torch.cat(
        [mask, 0.5 * mask.expand(-1, 3, -1, -1), torch.zeros(count, 8, 64, 64), mask], 1
    )
    place = torch.zeros(count, dtype=torch.int64)
    return Toy(image, background, gbuffer, place, place, place, kind)


def fixed(count: int = 8, seed: int = 9) -> Toy:
    return draw(count, torch.Generator().manual_seed(seed))


def pair() -> tuple[Toy, Toy]:
    """Return the same scenes lit consistently and wrongly."""
    wrong = fixed(6, 1)
    wrong.image = wrong.background[:, :3] + 0.2 * wrong.gbuffer[:, 1:4]
    wrong.kind = torch.ones_like(wrong.kind)
    right = copy.copy(wrong)
    right.image = wrong.background[:, :3] - 0.2 * wrong.gbuffer[:, :1]
    right.kind = torch.zeros_like(wrong.kind)
    return right, wrong


def train(out: Path, settings: TrainSettings = SETTINGS, **more: Any) -> tuple[Progress, list[str]]:
    said: list[str] = []
    arguments: dict[str, Any] = {"validation": {"toy": [fixed()]}, "say": said.append, **more}
    progress = train_prior(draw, out, settings, "cpu", 10.0, 1e6, **arguments)
    return progress, said


def held_in(out: Path) -> Held:
    """Return the newest checkpoint of a training, which is whole."""
    return read_checkpoint(out, TINY, pytest.fail)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a short training."""
    out = tmp_path_factory.mktemp("trained")
    train(out, pairs={"toy": [pair()]})
    return out


@pytest.fixture
def out(trained: Path, tmp_path: Path) -> Path:
    """A copy of that folder."""
    return Path(shutil.copytree(trained, tmp_path / "out"))


# The loss


def test_loss_is_its_printed_formula() -> None:
    """Weighted squared error of v = a noise - s z at z_t = a z + s noise, per composite."""
    network = build_network(TINY)
    batch, settings = fixed(3), TrainSettings(network=TINY, mask_weight=5.0, shadow_weight=3.0)
    batch.image[:, :, 50:60] *= 0.7  # a shadow
    alpha = torch.tensor([0.9, 0.5, 0.2])
    sigma = (1.0 - alpha.square()).sqrt()
    noise = torch.randn(batch.image.shape)
    present = torch.tensor([[1.0] * 5, [0.0] * 5, [0.0, 1.0, 1.0, 0.0, 0.0]])
    ids = training_tokens(batch.noun, batch.setting, batch.weather, batch.kind)
    timesteps = torch.tensor([100, 500, 900])
    with torch.no_grad():
        found = Objective(network, settings)(
            batch.image, batch.background, batch.gbuffer, present, ids, timesteps, noise,
            alpha, sigma,
        )  # fmt: skip
        z, z_background = 2.0 * batch.image - 1.0, 2.0 * batch.background[:, :3] - 1.0
        mask = batch.gbuffer[:, :1]
        weight = 1.0 + 5.0 * mask
        difference = (z - z_background).abs().mean(dim=1, keepdim=True)
        weight = weight + 3.0 * torch.where(mask > 0, 0.0, (2.0 * difference).clamp(0.0, 1.0))
        assert weight.max() > 5.9 and 1.1 < weight[0, 0, 55, 5] <= 4.0
        for i in range(3):
            v = network(
                (alpha[i] * z + sigma[i] * noise)[i : i + 1],
                timesteps[i : i + 1],
                network.embed(ids[i : i + 1]),
                batch.background[i : i + 1],
                batch.gbuffer[i : i + 1],
                present[i : i + 1],
            )
            error = (v - alpha[i] * noise[i] + sigma[i] * z[i]).square()
            expected = (error * weight[i]).sum() / weight.mean() / error.numel()
            assert float(found[i]) == pytest.approx(float(expected), rel=1e-4)


def test_weights_are_one_on_average() -> None:
    batch = fixed()
    weight = pixel_weight(batch.image, batch.background[:, :3], batch.gbuffer[:, :1], SETTINGS)
    assert float(weight.mean()) == pytest.approx(1.0, rel=1e-5)
    inside, outside = weight[:, :, 30, 30], weight[:, :, 5, 5]
    torch.testing.assert_close(inside, 9.0 * outside)


def training(out: Path, settings: TrainSettings = SETTINGS) -> module._Training:
    return module._Training(settings, CPU, Worker.this(), out, False, 0, None, lambda text: None)


def test_conditions_and_words_are_withheld_as_often_as_stated(tmp_path: Path) -> None:
    made = training(tmp_path)
    seen: list[tuple[Tensor, ...]] = []
    free = made.parameters[0].sum() * 0.0

    def objective(*inputs: Tensor) -> Tensor:
        seen.append(inputs)
        return free.expand(len(inputs[0]))

    made.objective = objective
    count = 3000
    one = draw(1, torch.Generator().manual_seed(0))
    many = Toy(**{name: value.expand(count, *value.shape[1:]) for name, value in vars(one).items()})
    made._step(many, 1e-3)
    _, _, _, present, ids, timesteps, noise, alpha, sigma = seen[0]
    tolerance = 4.0 * math.sqrt(0.25 / count)
    assert present.mean(dim=0).tolist() == pytest.approx([0.9 * 0.85] * 5, abs=tolerance)
    none = float((present == 0).all(dim=1).float().mean())
    assert none == pytest.approx(0.15 + 0.85 * 0.1**4, abs=tolerance)
    assert float((ids == 0).all(dim=1).float().mean()) == pytest.approx(0.2, abs=tolerance)
    t = timesteps.float() / 1000.0
    assert 0.03 <= t.min() < 0.035 and 0.895 < t.max() < 0.9
    assert float(t.mean()) == pytest.approx(0.465, abs=4.0 * 0.87 / math.sqrt(12 * count))
    torch.testing.assert_close(sigma, torch.sin(0.5 * math.pi * (t + 0.0005)), atol=1e-5, rtol=0)
    torch.testing.assert_close(alpha.square() + sigma.square(), torch.ones(count))
    assert float(noise.std()) == pytest.approx(1.0, abs=0.01) and ids.shape == (count, 16)


def test_micro_batches_add_up(tmp_path: Path) -> None:
    """The gradient is the mean over all composites, however many go through at once."""
    gradients = []
    for micro in (0, 2):
        made = training(tmp_path, replace(SETTINGS, micro=micro, mask_weight=0, shadow_weight=0))
        made._step(fixed(4), 0.0)
        gradients.append(
            torch.cat([p.grad.flatten() for p in made.parameters if p.grad is not None])
        )
    torch.testing.assert_close(gradients[0], gradients[1], atol=1e-5, rtol=1e-3)


def test_the_rate_rises_stays_and_falls(tmp_path: Path) -> None:
    made = training(tmp_path, replace(SETTINGS, rate=1.0, warmup_steps=4))
    rates = []
    for step in range(6):
        made.progress.step = step
        rates.append(made._rate(0.0))
    assert rates == [0.25, 0.5, 0.75, 1.0, 1.0, 1.0]
    for share, rate in ((0.55, 1.0), (0.775, 0.51), (1.0, 0.02), (1.5, 0.02)):
        assert made._rate(share) == pytest.approx(rate)
    made.first_step, made.warmup_steps = 4, 2  # resumed: its own warm-up, of two steps
    made.progress.step = 4
    assert made._rate(0.0) == 0.5


def test_the_average_follows_with_an_early_ramp(tmp_path: Path) -> None:
    """Decay (1 + n) / (10 + n) at first: the start is soon forgotten."""
    made = training(tmp_path, replace(SETTINGS, average=0.9995))
    before = [p.clone() for p in made.averages]
    made.progress.step = 3
    made._step(fixed(2), 1e-2)
    for old, new, weight in zip(before, made.averages, made.parameters, strict=True):
        torch.testing.assert_close(new, weight + (4.0 / 13.0) * (old - weight))


# Learning, stopping, going on


@pytest.mark.slow
def test_it_learns(trained: Path) -> None:
    """A dozen steps on a trivial world; the curve tells it, and the average is what is judged."""
    curve = [json.loads(line) for line in (trained / CURVE).read_text().splitlines()]
    judged = [entry["loss"]["toy"]["all"] for entry in curve if isinstance(entry["loss"], dict)]
    assert len(judged) == 2 and judged[1] < 0.85 * judged[0]
    steps = [entry["step"] for entry in curve if not isinstance(entry["loss"], dict)]
    assert steps == [5, 10] and curve[-1]["step"] == 12 and curve[-1]["samples"] == 48
    assert {"sds", "good-bad", "csd", "ranked"} == set(curve[-1]["difference"]["toy"])


def test_a_resumed_run_goes_on(out: Path) -> None:
    """It says that it has what was saved; steps, samples, time and curve continue."""
    before = held_in(out).progress
    lines = (out / CURVE).read_text().splitlines()
    # A run that was cut off after its last checkpoint has added to the curve.
    with (out / CURVE).open("a") as file:
        file.write('{"step": 13}\n')
    progress, said = train(out, replace(SETTINGS, step_limit=18), resume=True)
    assert any("the same within noise" in text for text in said)
    assert (progress.step, progress.samples, progress.runs) == (18, 72, 2)
    assert progress.seconds > before.seconds > 0.0
    after = (out / CURVE).read_text().splitlines()
    assert after[: len(lines)] == lines and '{"step": 13}' not in after
    assert json.loads(after[-1])["loss"]["toy"]["all"] < before.validation["loss"]["toy"]["all"]
    assert checkpoints_of(out, TINY).newest == "000002-prior-18"


def test_resuming_is_repeatable_and_new(out: Path, tmp_path: Path) -> None:
    """Two runs from one checkpoint end alike, and see other scenes than the run before."""
    seen: list[int] = []

    def watched(count: int, generator: torch.Generator) -> Toy:
        seen.append(generator.initial_seed())
        return draw(count, generator)

    ends = []
    for name in ("first", "second"):
        folder = Path(shutil.copytree(out, tmp_path / name))
        train_prior(
            watched, folder, replace(SETTINGS, step_limit=15), "cpu", 10.0, 1e6, resume=True
        )
        ends.append(held_in(folder))
    for one, other in zip(ends[0].network.parameters(), ends[1].network.parameters(), strict=True):
        assert torch.equal(one, other)
    assert len(set(seen)) == 1
    fresh: list[int] = []

    def first_run(count: int, generator: torch.Generator) -> Toy:
        fresh.append(generator.initial_seed())
        return draw(count, generator)

    train_prior(first_run, tmp_path / "new", replace(SETTINGS, step_limit=1), "cpu", 10.0, 1e6)
    assert fresh[0] != seen[0]


def test_another_network_or_world_is_refused(out: Path) -> None:
    """The saved validation loss must come out again."""
    world = {"toy": [replace_image(fixed())]}
    with pytest.raises(ModelError, match="not the network that was saved"):
        train(out, resume=True, validation=world)
    unchecked = replace(SETTINGS, check_resume=False)
    _, said = train(out, unchecked, resume=True, validation=world)
    assert any("NOT the same" in text for text in said)
    with pytest.raises(InputError, match=r"network\.layers: was 1, is 2"):
        train(out, replace(SETTINGS, network=replace(TINY, layers=2)), resume=True)


def replace_image(batch: Toy) -> Toy:
    batch.image = torch.rand(batch.image.shape, generator=torch.Generator().manual_seed(0))
    return batch


def test_nothing_is_overwritten_or_invented(out: Path, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="was begun"):
        train(out)
    with pytest.raises(InputError, match="nothing to go on from"):
        train(tmp_path / "empty", resume=True)


def test_no_time_is_enough_for_a_checkpoint(tmp_path: Path) -> None:
    settings = replace(SETTINGS, step_limit=0)
    progress = train_prior(draw, tmp_path, settings, "cpu", 0.0, 1.0)
    assert progress.step == 0 and held_in(tmp_path).progress.step == 0


def test_the_plan_ends_the_training(tmp_path: Path) -> None:
    """Time of all runs counts: a plan that is used up leaves no step."""
    train_prior(draw, tmp_path, replace(SETTINGS, step_limit=1), "cpu", 10.0, 1e6)
    over = replace(SETTINGS, step_limit=0)
    progress = train_prior(draw, tmp_path, over, "cpu", 10.0, 1e-9, resume=True)
    assert progress.step == 1


def test_a_loss_that_is_not_finite_ends_the_run(tmp_path: Path) -> None:
    """Before anything is saved."""

    def broken(count: int, generator: torch.Generator) -> Toy:
        batch = draw(count, generator)
        batch.image[0] = math.nan
        return batch

    with pytest.raises(ModelError, match="no longer finite"):
        train_prior(broken, tmp_path, replace(SETTINGS, step_limit=2), "cpu", 10.0, 1e6)
    assert checkpoints_of(tmp_path, TINY).newest is None


# Checkpoints


def test_a_damaged_checkpoint_is_passed_over_or_refused(out: Path) -> None:
    """The one before is what goes on, with a notice; where none is whole, nothing does."""
    train(out, replace(SETTINGS, step_limit=13), resume=True)
    for step in (13, 12):
        (state,) = out.glob(f"checkpoints/*-prior-{step}/state.safetensors")
        state.write_bytes(state.read_bytes()[:1000])
        if step == 13:
            notices: list[str] = []
            assert read_checkpoint(out, TINY, notices.append).progress.step == 12
            assert len(notices) == 1 and "000002-prior-13" in notices[0]
    with pytest.raises(InputError, match="cannot be used"):
        train(out, resume=True)


def test_the_average_is_what_is_shipped(out: Path, tmp_path: Path) -> None:
    file = tmp_path / "prior.safetensors"
    export_prior(out, file, TINY, {"data": "toy"})
    held, prior = held_in(out), load_embedded(file, "cpu")
    for one, other in zip(held.average.parameters(), prior.network.parameters(), strict=True):
        assert torch.equal(one.half().float(), other)
    assert prior.training["steps"] == 12 and prior.training["samples"] == 48
    assert prior.training["data"] == "toy" and "toy" in prior.training["validation"]["loss"]
    assert prior.training["settings"]["network"]["widths"] == [16, 32]


# Validation


class Known(nn.Module):
    """Takes every picture for one of two: the prompt says which, none means halfway."""

    def __init__(self, right: Tensor, wrong: Tensor) -> None:
        super().__init__()
        self.right, self.wrong = right, wrong

    def embed(self, ids: Tensor) -> Tensor:
        return ids

    def forward(self, z: Tensor, timesteps: Tensor, ids: Tensor, *_: Tensor) -> Tensor:
        share = torch.full((len(ids), 1, 1, 1), 0.5)
        share[ids[:, 0] == tokenize("consistent")[0]] = 0.0
        share[ids[:, 0] == tokenize("mismatched")[0]] = 1.0
        x0 = 2.0 * (self.right + share * (self.wrong - self.right)) - 1.0
        bar = schedule_on(CPU).alphas_cumprod[timesteps][:, None, None, None]
        a, s = bar.sqrt().float(), (1.0 - bar).sqrt().float()
        return ((z - a * x0) / s - s * z) / a


def judge(network: Any, **more: Any) -> dict[str, Any]:
    return Validation(SETTINGS, CPU, more.get("sets", {}), more.get("pairs", {}))(network)


def test_differences_of_one_who_knows_point_the_way_back() -> None:
    right, wrong = pair()
    figures = judge(Known(right.image, wrong.image), pairs={"toy": [(right, wrong)]})
    for row in ("sds", "good-bad", "csd"):
        assert figures["difference"]["toy"][row]["all"] == pytest.approx(1.0, abs=1e-2)
    assert figures["difference"]["toy"]["ranked"]["all"] == 1.0
    opposite = judge(Known(wrong.image, right.image), pairs={"toy": [(right, wrong)]})
    assert opposite["difference"]["toy"]["good-bad"]["all"] == pytest.approx(-1.0, abs=1e-2)
    assert opposite["difference"]["toy"]["ranked"]["all"] == 0.0


def test_a_perfect_network_has_no_loss() -> None:
    batch = fixed()
    perfect = Known(batch.image, batch.image)
    figures = judge(perfect, sets={"toy": [batch]})["loss"]["toy"]
    assert figures["all"] < 1e-4 and set(figures) >= {"all", "0-0.3", "0.3-0.6", "0.85-1"}


def test_validation_is_the_same_every_time() -> None:
    network = build_network(TINY)
    arguments = {"sets": {"toy": [fixed()]}, "pairs": {"toy": [pair()]}}
    assert judge(network, **arguments) == judge(network, **arguments)


def test_ranges_are_means_of_their_own() -> None:
    values, sigma = torch.tensor([1.0, 2.0, 4.0]), torch.tensor([0.1, 0.2, 0.9])
    assert by_sigma(values, sigma) == {"all": 2.333333, "0-0.3": 1.5, "0.85-1": 4.0}


# Several processes

SCRIPT = """
import sys, torch, warpir.diffusion
sys.path.insert(0, {root!r})
torch.set_num_threads(1)
from pathlib import Path
from dataclasses import replace
import warpir.diffusion.train.loop as module
from tests.train.test_train import SETTINGS, draw, fixed
from warpir.diffusion.models.embedded import weight_hash
from warpir.diffusion.train.loop import train_prior
from warpir.diffusion.train.worker import Worker
out, worker = Path({out!r}), Worker.this()
made = []
kept = module._Training
module._Training = lambda *arguments: made.append(kept(*arguments)) or made[-1]
train_prior(draw, out, replace(SETTINGS, step_limit=3), worker.device("cpu"), 1.0, 1e6,
            validation={{"toy": [fixed()]}})
end = weight_hash(made[0].network.state_dict()), made[0].scenes.initial_seed()
(out / f"rank-{{worker.rank}}").write_text(" ".join(map(str, end)))
"""


@pytest.mark.slow
def test_processes_share_their_gradients(tmp_path: Path) -> None:
    """Two processes draw different scenes and end with the same weights; one of them saves."""
    root = Path(__file__).resolve().parents[2]
    script = tmp_path / "both.py"
    script.write_text(SCRIPT.format(root=str(root), out=str(tmp_path / "out")))
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    subprocess.run(
        [*command, "--nproc-per-node=2", str(script)], cwd=tmp_path, check=True, timeout=300,
        env=os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(root)},
    )  # fmt: skip
    ends = [(tmp_path / "out" / f"rank-{rank}").read_text().split() for rank in (0, 1)]
    assert ends[0][0] == ends[1][0] and ends[0][1] != ends[1][1]
    progress = held_in(tmp_path / "out").progress
    assert (progress.step, progress.samples) == (3, 24)


def test_a_new_training_may_start_from_given_weights(tmp_path: Path) -> None:
    begun = build_network(TINY, 7)
    before = {k: v.clone() for k, v in begun.state_dict().items()}
    settings = replace(SETTINGS, step_limit=1, rate=1e-12, decay=0.0)
    train_prior(draw, tmp_path, settings, CPU, 1.0, 1.0, network=begun)
    after = held_in(tmp_path).average.state_dict()
    for name, value in before.items():
        torch.testing.assert_close(after[name], value, rtol=1e-5, atol=1e-7)
    assert not torch.equal(before["words.weight"], build_network(TINY, 0).words.weight)


def test_command_refuses_what_cannot_be_meant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line names the flag or the folder."""
    given = ["prior", "--out", str(tmp_path), "--panoramas"]
    argv = [*given, str(tmp_path), "--resume", "--start", "w.safetensors"]
    assert main(argv) == ExitCode.USAGE
    assert "error: --start: what is resumed has its own weights" in capsys.readouterr().err
    assert main([*given, str(tmp_path / "absent")]) == ExitCode.INPUT
    assert "no such folder" in capsys.readouterr().err


@pytest.mark.case("F5")
@pytest.mark.parametrize(
    ("given", "code", "words"),
    [
        (["--minutes", "nan"], ExitCode.USAGE, "--minutes"),
        (["--total-minutes", "0"], ExitCode.USAGE, "--total-minutes"),
        (["--batch", "0"], ExitCode.USAGE, "--batch"),
        (["--start", "no.safetensors"], ExitCode.MODEL, "no.safetensors"),
        (["--resume", "--out", "empty"], ExitCode.INPUT, "nothing to resume"),
        (["--out", "begun"], ExitCode.OUTPUT, "a training that was begun"),
        (["--out", "file"], ExitCode.OUTPUT, "not a folder"),
    ],
    ids=["nan", "no-time", "no-batch", "no-start", "no-state", "begun", "file"],
)
@pytest.mark.parametrize("network", ["prior", "regressor"])
def test_training_looks_before_it_begins(
    network: str,
    given: list[str],
    code: int,
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Scenes take minutes to make, and hours of training must not be lost."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    held = tmp_path / "begun" / "checkpoints" / f"000001-{network}-900"
    held.mkdir(parents=True)
    (tmp_path / "file").write_text("mine")
    argv = [network, "--panoramas", "empty", "--out", "new", "--minutes", "1", *given]
    assert main(argv) == code
    assert words in capsys.readouterr().err.splitlines()[0]
    assert held.is_dir() and not (tmp_path / "new").exists()
