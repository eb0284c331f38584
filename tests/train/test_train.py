"""The training command, and trainings that several processes share."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from tests.builders.image_files import write_envmap
from tests.lighting.test_regressor import HELD_OUT, SMALL, TOY, blobs
from warpir.core.errors import ExitCode
from warpir.train import command
from warpir.train.camera.crops import CameraBatch, draw_batch
from warpir.train.command import main
from warpir.train.networks.calibrator import (
    CalibratorConfig,
    random_calibrator,
    read_calibrator,
    save_calibrator,
)
from warpir.train.networks.regressor import random_regressor, save_regressor
from warpir.train.places import learned_from
from warpir.train.regressor import train_regressor

pytestmark = pytest.mark.usefixtures("one_thread")

SCRIPT = """
import sys, torch
sys.path.insert(0, {root!r})
torch.set_num_threads(1)
from dataclasses import replace
from pathlib import Path
from tests.lighting.test_regressor import HELD_OUT, SMALL, TOY, blobs
from warpir.train.networks.calibrator import random_calibrator, save_calibrator
from warpir.train.networks.regressor import random_regressor
from warpir.train.regressor import train_regressor
from warpir.train.worker import Worker
out, worker = Path({out!r}), Worker.this()
network, seen = random_regressor(0, SMALL), []

def batches(count, generator):
    seen.append(generator.initial_seed())
    return blobs(count, generator)

end = train_regressor(batches, HELD_OUT, out, replace(TOY, step_limit=3), "cpu", 5.0, 5.0,
                      network=network)
total = sum(float(p.double().sum()) for p in network.parameters())
(out / f"rank-{{worker.rank}}").write_text(f"{{total.hex()}} {{seen[0]}} {{end.steps}}")
# A thread of the exchange that is left may abort or block the process as Python ends.
names = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
assert not [name for name in names if "gloo" in name], names
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
    (weights, seed, steps), other = (
        (tmp_path / "out" / f"rank-{rank}").read_text().split() for rank in (0, 1)
    )
    assert (weights, steps) == (other[0], "3") and seed != other[1]
    assert len(list((tmp_path / "out" / "checkpoints").iterdir())) == 1


def test_command_refuses_what_cannot_be_meant(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line names the flag or the folder."""
    given = ["regressor", "--out", str(tmp_path), "--panoramas"]
    argv = [*given, str(tmp_path), "--resume", "--start", "w.safetensors"]
    assert main(argv) == ExitCode.USAGE
    assert "error: --start: what is resumed has its own weights" in capsys.readouterr().err
    assert main([*given, str(tmp_path / "absent")]) == ExitCode.INPUT
    assert "no such folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("network", "given", "named"),
    [
        ("camera", ["--total-minutes", "9"], "--total-minutes"),
        ("camera", ["--networks", "2"], "--networks"),
        ("camera", ["--places", "4"], "--places"),
        ("camera", ["--start", "a", "--regressor", "b"], "--regressor"),
        ("regressor", ["--regressor", "a"], "--regressor"),
        ("regressor", ["--networks", "2", "--fold", "0/5"], "--fold"),
        ("regressor", ["--networks", "0"], "--networks"),
        ("regressor", ["--seed", "-1"], "--seed"),
    ],
)
def test_flags_that_would_do_nothing_are_refused(
    network: str, given: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    argv = [network, "--panoramas", str(tmp_path), "--out", str(tmp_path / "out"), *given]
    assert main(argv) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith(f"error: {named}: ")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["camera"], "torchrun: its processes share"),
        (["regressor", "--networks", "2"], "torchrun: its processes share"),
        (["regressor"], "--device: no device cuda:99 here"),
    ],
)
def test_processes_share_one_network_on_cards_that_are_there(
    given: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name, value in {"WORLD_SIZE": "100", "RANK": "99", "LOCAL_RANK": "99"}.items():
        monkeypatch.setenv(name, value)
    argv = [*given, "--panoramas", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main(argv) == ExitCode.USAGE
    assert capsys.readouterr().err.startswith(f"error: {words}")


@pytest.mark.parametrize(("given", "rate"), [([], 1.2e-3), (["--rate", "1e-4"], 1e-4)])
def test_the_cameras_training_heeds_its_rate(
    given: list[str], rate: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rates = []
    monkeypatch.setattr(
        "warpir.train.camera.loop.train_camera", lambda *a, **_: rates.append(a[3].learning_rate)
    )
    write_envmap(tmp_path / "place", "place", np.full((16, 32, 3), 0.5, np.float32))
    argv = ["camera", "--panoramas", str(tmp_path), "--out", str(tmp_path / "out"), *given]
    assert main([*argv, "--device", "cpu"]) == ExitCode.DONE
    assert rates == [rate]


def test_a_signal_ends_the_cameras_training_with_what_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It held nothing on disk until its time was over."""
    drawn = []

    def draw(*given: Any) -> CameraBatch:
        drawn.append(given)
        if len(drawn) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return draw_batch(*given)

    monkeypatch.setattr("warpir.train.camera.loop.draw_batch", draw)
    small = CalibratorConfig(channels=(8, 8, 16), blocks=(1, 1), depth=1, heads=2)
    start, weights = tmp_path / "start.safetensors", tmp_path / "out" / "calibrator.safetensors"
    save_calibrator(random_calibrator(0, small), start, {})
    write_envmap(tmp_path / "place", "place", np.full((16, 32, 3), 0.5, np.float32))
    argv = ["camera", "--panoramas", str(tmp_path), "--out", str(weights.parent), "--batch", "2"]
    assert main([*argv, "--device", "cpu", "--start", str(start)]) == 128 + signal.SIGINT
    assert read_calibrator(weights, torch.device("cpu")).record["steps"] == 2
    assert f"stopped by SIGINT; kept: {weights}; --start" in capsys.readouterr().err


@pytest.mark.case("F5")
@pytest.mark.parametrize(
    ("given", "code", "words"),
    [
        (["--minutes", "nan"], ExitCode.USAGE, "--minutes"),
        (["--total-minutes", "0"], ExitCode.USAGE, "--total-minutes"),
        (["--batch", "0"], ExitCode.USAGE, "--batch"),
        (["--device", "gpu"], ExitCode.USAGE, "no device gpu here"),
        (["--start", "no.safetensors"], ExitCode.MODEL, "no.safetensors"),
        (["--resume", "--out", "empty"], ExitCode.INPUT, "nothing to resume"),
        (["--out", "begun"], ExitCode.OUTPUT, "a training that was begun"),
        (["--out", "done"], ExitCode.OUTPUT, "a camera's training"),
        (["--out", "file"], ExitCode.OUTPUT, "not a folder"),
    ],
    ids=[
        "nan",
        "no-time",
        "no-batch",
        "no-device",
        "no-start",
        "no-state",
        "begun",
        "done",
        "file",
    ],
)
@pytest.mark.parametrize("network", ["camera", "regressor"])
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
    (tmp_path / "done").mkdir()
    for name in ("file", "done/calibrator.safetensors"):
        (tmp_path / name).write_text("mine")
    argv = [network, "--panoramas", "empty", "--out", "new", "--minutes", "1", *given]
    assert main(argv) == code
    assert words in capsys.readouterr().err.splitlines()[0]
    assert held.is_dir() and not (tmp_path / "new").exists()


def test_validation_on_what_was_learned_from_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    start = tmp_path / "start.safetensors"
    save_calibrator(random_calibrator(0), start, {"panoramas": ["a_noon"], "started_from": None})
    for place in ("a_noon", "b_noon"):
        write_envmap(tmp_path / place, place, np.full((16, 32, 3), 0.5, np.float32))
    monkeypatch.setattr("warpir.train.camera.loop.train_camera", lambda *_, **__: None)
    argv = ["camera", "--panoramas", str(tmp_path), "--out", str(tmp_path / "out")]
    argv += ["--device", "cpu", "--start", str(start), "--validation"]
    for place, count in (("a_noon", 1), ("b_noon", 0)):
        assert main([*argv, place]) == ExitCode.DONE
        assert capsys.readouterr().out.count("notice: validation on 1 panoramas that") == count


def test_no_training_outlives_one_that_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor the command: both would keep the card for the rest of their minutes."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\ncase "$*" in *member_0*) exit 3;; esac\nexec sleep 60\n')
    python.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(python))
    running: list[subprocess.Popen[bytes]] = []

    def started(argv: list[str]) -> subprocess.Popen[bytes]:
        running.append(popen(argv))
        return running[-1]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", started)
    argv = ["regressor", "--panoramas", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*argv, "--networks", "2"]) == ExitCode.INPUT
    try:
        assert len(running) == 2 and all(process.poll() is not None for process in running)
    finally:
        running[1].kill()


def test_training_begins_with_one_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What ships is the mean of several."""
    start = tmp_path / "start.safetensors"
    save_regressor(random_regressor(0, replace(SMALL, members=2)), start, {})
    argv = ["regressor", "--panoramas", str(tmp_path), "--out", str(tmp_path / "out")]
    assert main([*argv, "--device", "cpu", "--start", str(start)]) == ExitCode.MODEL
    assert "holds 2 networks" in capsys.readouterr().err


def test_what_is_resumed_knows_what_it_began_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its folds stay, and its record still names the panoramas behind the weights of --start."""
    start, out = tmp_path / "start.safetensors", tmp_path / "out"
    network = random_regressor(0, SMALL)
    save_regressor(network, start, {"panoramas": ["old_noon", "older_noon"]})
    for place in ("old", "a", "b", "c", "d"):
        texels = np.full((16, 32, 3), 0.5, np.float32)
        write_envmap(tmp_path / f"{place}_noon", f"{place}_noon", texels)
    records: list[dict[str, Any]] = []

    def taken(*given: Any) -> dict[str, Any]:
        records.append(given[-1])
        tiny = replace(TOY, batch=2, step_limit=1)
        end = train_regressor(
            blobs, HELD_OUT, out, tiny, "cpu", 1.0, 1.0, given[1].resume, 0, network, records[-1]
        )
        return vars(end)

    monkeypatch.setattr(command, "_train_on", taken)
    argv = ["regressor", "--panoramas", str(tmp_path), "--out", str(out), "--device", "cpu"]
    for more in (["--start", str(start)], ["--resume"]):
        assert main([*argv, "--fold", "0/3", *more]) == ExitCode.DONE
    assert records[0]["validation_panoramas"] and records[0] == records[1]
    assert "older_noon" in learned_from(records[1])
    # What is judged by must not be learned from, nor the other way about.
    for other in (["--fold", "1/3"], ["--fold", "0/3", "--without", "a_noon"]):
        assert main([*argv, *other, "--resume"]) == ExitCode.INPUT
        assert "a training with other panoramas" in capsys.readouterr().err
    assert len(records) == 2
