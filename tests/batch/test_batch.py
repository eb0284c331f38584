"""``warpir.batch``: many scenes of which one is bad, one kills its worker, and all others are done.

Scenes are real and small. They are written to memory where the system has such a folder: what is
tested is not the disk, which waits for every file of every scene.
"""

import errno
import hashlib
import importlib.util
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import pytest

from tests.builders.faults import snapshot
from tests.builders.insertions import arguments, record_of, write_inputs
from warpir.app.command import parse
from warpir.app.config import DEFAULTS, InsertConfig
from warpir.batch import run as batch
from warpir.batch.command import main
from warpir.batch.local import LocalWorkers, answer_of_the_dead
from warpir.batch.manifest import Row, read_manifest
from warpir.batch.ray import RayWorkers, _probe
from warpir.batch.task import CHECK, COMPILE, INSERT, Answer, Task, do_task
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS
from warpir.core.signals import Stopped
from warpir.insert import main as insert_main

FLAGS = ["--samples", "1", "--depth", "1", "--device", "cpu", "--no-detail", "--no-hand-off"]
POSE = {"fov": 60, "pitch": -15, "camera-height": 1.5, "place": [0, 0, -5]}

HOOK = """
import os, signal, sys, time
from pathlib import Path
if any(word.endswith(("--multiprocessing-fork", "/default_worker.py")) for word in sys.orig_argv):
    from warpir.io.results import OutputFolder
    here, pid = Path(os.environ["HOOKED"]), os.getpid()
    (here / f"worker-{pid}").touch()
    write = OutputFolder.write_together
    def hooked(self, *writers):
        done = write(self, *writers)
        (here / f"wrote-{self.path.name}").touch()
        if (here / f"kill-{self.path.name}").exists():
            (here / f"kill-{self.path.name}").unlink()
            os.kill(pid, signal.SIGKILL)
        while (here / f"wait-{self.path.name}").exists():
            time.sleep(0.01)
        return done
    OutputFolder.write_together = hooked
"""
"""In each worker, Ray's too: files in a folder tell who is there, and what is to happen."""


@pytest.fixture
def memory(tmp_path: Path) -> Iterator[Path]:
    """A folder in memory, or else an ordinary one, with inputs of an insertion."""
    where = "/dev/shm" if os.access("/dev/shm", os.W_OK) else tmp_path
    with tempfile.TemporaryDirectory(dir=where, prefix="warpir-batch-") as folder:
        write_inputs(Path(folder))
        yield Path(folder)


@pytest.fixture
def hooked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder by which workers are told what to do."""
    (tmp_path / "hook").mkdir()
    (tmp_path / "hook" / "sitecustomize.py").write_text(HOOK)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "hook"))
    monkeypatch.setenv("HOOKED", str(tmp_path / "hook"))
    return tmp_path / "hook"


def scenes(count: int) -> list[dict[str, Any]]:
    """Rows that differ by their seeds, with two kinds of asset and of light."""
    return [
        {
            "name": f"scene-{k}", "photo": "photo.png", **POSE, "seed": k,
            "asset": ("box.glb", "box.obj")[k % 2], "light": ("sky.hdr", "lobes.json")[k // 2 % 2],
        }
        for k in range(count)
    ]  # fmt: skip


def write_manifest(folder: Path, rows: Sequence[object]) -> Path:
    lines = [row if isinstance(row, str) else json.dumps(row) for row in rows]
    (folder / "scenes.jsonl").write_text("\n".join(lines) + "\n")
    return folder / "scenes.jsonl"


def summary_of(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "batch.json").read_text()))


def states_of(out: Path) -> dict[str, str]:
    return {scene["name"]: scene["state"] for scene in summary_of(out)["scenes"]}


def failures_of(out: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (out / "failures.jsonl").read_text().splitlines()]


def check_batch(memory: Path, hooked: Path, count: int, capsys: Any) -> Path:
    """R16 with so many scenes: one has no photo, the worker of another is killed in it."""
    rows = scenes(count)
    rows[2]["photo"] = "late.png"
    manifest, out = write_manifest(memory, rows), memory / "out"
    (hooked / "kill-scene-3").touch()
    argv = [str(manifest), "--out", str(out), "--workers", "2", *FLAGS]
    assert main(argv) == ExitCode.INPUT
    said = capsys.readouterr()
    assert said.err.splitlines()[0] == (
        f"error: {manifest}: 1 of {count} scenes failed; {out / 'failures.jsonl'} lists them"
    )
    assert "SIGKILL: it is tried again at the end, by itself" in said.out and " left" in said.out
    (failure,) = failures_of(out)
    assert (failure["line"], failure["name"], failure["exit_code"]) == (3, "scene-2", 3)
    assert failure["error"] == f"{memory / 'late.png'}: no such file"
    summary = summary_of(out)
    assert summary["counts"] == {"done": count - 1, "done before": 0, "failed": 1, "not run": 0}
    retried = {scene["name"]: scene["retries"] for scene in summary["scenes"] if scene["retries"]}
    assert retried == {"scene-3": ["SIGKILL"]}
    assert not (hooked / "kill-scene-3").exists() and not (out / "scene-2").exists()
    assert not list(out.glob("*/.partial-*"))
    # What is left is one scene, and one whose row has changed.
    before = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    assert len(before) == count - 1
    shutil.copy(memory / "photo.png", memory / "late.png")
    rows[0]["seed"] = 77
    write_manifest(memory, rows)
    assert main(argv) == ExitCode.DONE
    states = states_of(out)
    assert {name for name, state in states.items() if state == "done"} == {"scene-0", "scene-2"}
    assert summary_of(out)["counts"]["done before"] == count - 2
    after = {path: path.stat().st_mtime_ns for path in out.glob("*/run.json")}
    changed = {path.parent.name for path in after if after[path] != before.get(path)}
    assert changed == {"scene-0", "scene-2"} and failures_of(out) == []
    assert record_of(out / "scene-0")["config"]["seed"] == 77
    page = (out / "batch.html").read_text()
    assert all(f'href="{name}/report.html"' in page for name in states_of(out) if name)
    return out


@pytest.mark.slow
@pytest.mark.case("R16")
def test_one_bad_scene_and_one_killed_worker(
    memory: Path, hooked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All others are done and the killed one too; a rerun does the rest; as `insert` would."""
    out = check_batch(memory, hooked, 6, capsys)
    changes = {"seed": "5", "asset": str(memory / "box.obj"), "samples": "1", "depth": "1"}
    argv = arguments(memory, memory / "alone", **changes, no_detail="", no_hand_off="")
    assert insert_main([*argv, "--device", "cpu"]) == ExitCode.DONE
    files = [record_of(folder)["files"] for folder in (memory / "alone", out / "scene-5")]
    for listed in files:
        del listed["report.html"]  # which tells the seconds
    assert files[0] == files[1] and len(files[0]) > 5


@pytest.mark.slow
@pytest.mark.case("R16")
def test_one_bad_of_a_hundred(
    memory: Path, hooked: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    check_batch(memory, hooked, 100, capsys)


LOADED = """
import sys
from warpir.render.device import cache_kernels, start_warp
start_warp()
import warp
from warpir.insert import main
def loaded():
    return {name for name, module in warp._src.context.user_modules.items() if module.execs}
cache_kernels("cpu", [(0, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0)])
before = loaded()
assert before and main(sys.argv[1:]) == 0
assert loaded() == before, loaded() ^ before
"""


@pytest.mark.slow
def test_nothing_is_left_for_workers_to_compile(memory: Path) -> None:
    """What is compiled before they start is all that a scene loads."""
    argv = [*arguments(memory, memory / "out", samples="1", depth="1"), *FLAGS]
    child = [sys.executable, "-P", "-c", LOADED, *argv]
    ended = subprocess.run(child, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr


# ------------------------------------------------------------------------------ how it is stopped


def start(argv: Sequence[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "warpir.batch", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def running(hooked: Path) -> list[int]:
    """Workers that are not gone, dead ones that nobody has waited for counted."""
    pids = [int(path.name.split("-")[1]) for path in hooked.glob("worker-*")]
    return [pid for pid in pids if Path("/proc", str(pid)).exists()]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_batch_that_is_stopped(memory: Path, hooked: Path, number: int) -> None:
    """Its workers end, nothing is half there, and it goes on; also after a kill."""
    argv = [str(write_manifest(memory, scenes(3))), "--out", str(memory / "out"), *FLAGS]
    (hooked / "wait-scene-1").touch()
    process = start([*argv, "--workers", "1"])
    wait_for(lambda: (hooked / "wrote-scene-1").exists())
    process.send_signal(number)
    if number == signal.SIGKILL:
        assert process.wait(60) == -signal.SIGKILL
        process.communicate()
        wait_for(lambda: not running(hooked))
    else:
        err = process.communicate(timeout=60)[1]
        assert process.returncode == 128 + number
        kept = "kept: 1 of 3 scenes; the same command goes on with the rest"
        assert err.splitlines()[-1] == f"stopped by {signal.Signals(number).name}; {kept}"
        assert running(hooked) == []
        counts = {"done": 1, "done before": 0, "failed": 0, "not run": 2}
        assert summary_of(memory / "out")["counts"] == counts
    assert [p.parent.name for p in (memory / "out").glob("*/run.json")] == ["scene-0"]
    assert number == signal.SIGKILL or not list((memory / "out").rglob(".partial-*"))
    (hooked / "wait-scene-1").unlink()
    assert main(argv) == ExitCode.DONE
    expected = {"scene-0": "done before", "scene-1": "done", "scene-2": "done"}
    assert states_of(memory / "out") == expected


@pytest.mark.slow
def test_a_killed_guided_scene_goes_on_from_its_checkpoint(memory: Path, hooked: Path) -> None:
    """Killed when it writes its light, it takes that up again; changed, it starts anew."""
    from tests.builders.guided_runs import guided_argv, write_guided_inputs

    write_guided_inputs(memory)
    asked = parse(guided_argv(memory)).config.flat()
    row = {key: value for key, value in asked.items() if value != DEFAULTS[key] and key != "out"}
    manifest, out = write_manifest(memory, [{"name": "guided", **row}]), memory / "out"
    (hooked / "kill-guided").touch()
    argv = [str(manifest), "--out", str(out)]
    assert main([*argv, "--retries", "0"]) == ExitCode.RESOURCES
    (failure,) = failures_of(out)
    assert "killed by SIGKILL" in failure["error"] and (out / failure["log"]).exists()
    shutil.copytree(out, memory / "other")
    assert main(argv) == ExitCode.DONE
    assert "resumed: optimize, step 6" in (out / "logs" / "guided.log").read_text()
    # A checkpoint of other settings is none of the changed scene's: it starts anew, and says so.
    write_manifest(memory, [{"name": "guided", **row, "seed": 5}])
    argv[-1] = str(memory / "other")
    assert main(argv) == ExitCode.DONE
    assert "it starts again" in (memory / "other" / "logs" / "guided.log").read_text()
    assert record_of(memory / "other/guided")["config"]["seed"] == 5


@pytest.mark.slow
def test_a_sequence_is_one_scene(memory: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its frames and its video; paths in its lines start at the manifest; changed, it is redone."""
    argv = arguments(memory, memory / "first", samples="1", depth="1", no_hand_off="", no_detail="")
    assert insert_main([*argv, "--device", "cpu"]) == ExitCode.DONE
    (memory / "bin").mkdir()
    (memory / "bin" / "ffmpeg").symlink_to(imageio_ffmpeg.get_ffmpeg_exe())
    monkeypatch.setenv("PATH", str(memory / "bin"))
    row = {"name": "drive", "sequence": "frames.jsonl", "reuse": "first", "fps": 12, **POSE}
    row |= {"photo": "photo.png", "asset": "box.glb"}
    manifest, out = write_manifest(memory, [row]), memory / "out"
    argv = [str(manifest), "--out", str(out), *FLAGS]

    def go(*frames: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        (memory / "frames.jsonl").write_text("".join(json.dumps(f) + "\n" for f in frames))
        assert main(argv) == ExitCode.DONE
        summary = json.loads((out / "drive" / "sequence.json").read_text())
        return states_of(out)["drive"], summary

    frames: list[dict[str, Any]] = [{}, {"asset": "box.obj", "rotate-y": 20}]
    state, first = go(*frames)
    assert state == "done" and first["video"]["composite.mp4"]["fps"] == 12.0
    names = {path.name for path in (out / "drive").iterdir()}
    assert names >= {"0001", "0002", "composite.mp4", "sequence.json"} and "0003" not in names
    assert go(*frames) == ("done before", first)
    # As a kill leaves it before the video has its name.
    (out / "drive" / "composite.mp4").unlink()
    assert go(*frames) == ("done", first) and (out / "drive" / "composite.mp4").exists()
    state, changed = go(frames[0], {"rotate-y": 30})
    assert state == "done"
    videos = [summary["video"]["composite.mp4"]["sha256"] for summary in (first, changed)]
    assert videos[0] != videos[1] and changed["frames"][1]["changes"] == {"rotate_y": 30.0}


# ------------------------------------------------------------------------------- what is refused


def test_a_failed_scene_tells_of_an_earlier_result(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is in its folder then is not what the line asks for."""
    manifest = write_manifest(tmp_path, [{"name": "a", "fotos": 1}, {"name": "b", "fotos": 1}])
    (tmp_path / "out" / "a").mkdir(parents=True)
    (tmp_path / "out" / "a" / "run.json").write_text("{}")
    assert main([str(manifest), "--out", str(tmp_path / "out"), *FLAGS]) == ExitCode.USAGE
    told = f"{tmp_path / 'out' / 'a'} holds the result of an earlier run"
    assert [line for line in capsys.readouterr().out.splitlines() if "earlier" in line] == [
        f"notice: {told}"
    ]
    listed = (tmp_path / "out" / "failures.jsonl").read_text().splitlines()
    assert [told in json.loads(line)["more"] for line in listed] == [True, False]


def test_a_folder_of_another_user_ends_no_batch(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What it holds cannot be told; the other lines go on."""
    stat = os.stat

    def refusing(path: Any, **given: Any) -> os.stat_result:
        if str(path).endswith("out/a/run.json"):
            raise PermissionError(errno.EACCES, "Permission denied", path)
        return stat(path, **given)

    monkeypatch.setattr(os, "stat", refusing)
    manifest = write_manifest(tmp_path, [{"name": "a", "fotos": 1}, {"name": "b", "fotos": 1}])
    assert main([str(manifest), "--out", str(tmp_path / "out"), *FLAGS]) == ExitCode.USAGE
    assert "2 of 2 scenes failed" in capsys.readouterr().err


@pytest.mark.slow
def test_validate_looks_at_all_lines_and_writes_nothing(
    memory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every line that cannot be used is told by its number and its scene."""
    rows: list[object] = list(scenes(4))
    rows[1] = {**scenes(2)[1], "asset": "photo.png"}
    manifest, out = write_manifest(memory, [*rows, "{", {"name": "x", "fotos": 1}]), memory / "out"
    argv = [str(manifest), "--out", str(out), *FLAGS]
    assert main([*argv, "--validate"]) == ExitCode.INPUT
    said = capsys.readouterr()
    assert f"line 2, scene-1: failed (3): {memory / 'photo.png'}: not a mesh" in said.out
    assert "line 5: failed (2): not JSON" in said.out
    assert "line 6, x: failed (2): unknown key 'fotos'" in said.out
    assert said.err.startswith(f"error: {manifest}: 3 of 6 scenes cannot be used\n")
    assert not out.exists()
    assert main([*argv, "--all-or-nothing"]) == ExitCode.INPUT
    assert "none was started" in capsys.readouterr().err
    names = sorted(path.name for path in out.iterdir())
    assert names == ["batch.html", "batch.json", "failures.jsonl"]
    page = (out / "batch.html").read_text()
    assert "3 not run, 3 failed" in page or "3 failed, 3 not run" in page
    assert "unknown key &#39;fotos&#39;" in page and "line 5, exit code 2" in page
    assert set(states_of(out).values()) == {"not run", "failed"} and len(failures_of(out)) == 3
    write_manifest(memory, scenes(2))
    assert main([*argv, "--validate"]) == ExitCode.DONE


@pytest.mark.parametrize("row", [{"demo": True}, {"sequence": "s", "asset": "a", "reuse": "r"}])
def test_an_extra_that_is_not_installed_is_told_by_the_check(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, row: dict[str, Any]
) -> None:
    """Before any scene is done, as `insert` does it."""
    monkeypatch.setattr(
        "warpir.app.program.importlib.util.find_spec", lambda name: name != "pxr" or None
    )
    config = InsertConfig(**row, usd=True, out=str(tmp_path / "out"))
    answer = do_task(Task(CHECK, config.flat(), str(tmp_path)))
    assert (answer.status, answer.lines[0]) == (ExitCode.USAGE, "error: pxr: not installed")


def read(path: Path, **given: Any) -> tuple[Row, ...]:
    return read_manifest(path, path.parent / "out", given, LIMITS).rows


BAD_ROWS: list[tuple[object, str]] = [
    ("[1]", "not a JSON object"),
    ('{"name": "a", "name": "b"}', 'key "name" appears twice'),
    ('{"name": "a", "fov": NaN}', "NaN is not JSON"),
    ({"photo": "p.png"}, "name: a text expected (found nothing)"),
    ({"name": 3}, "name: a text expected (found a value of type int)"),
    ({"name": "../a"}, "name: not a name for a folder (found '../a')"),
    ({"name": "Logs"}, "name: not a name for a folder (found 'Logs')"),
    ({"name": "GOOD"}, "name: GOOD is taken by line 1"),
    ({"name": "a", "plaice": [0, 0, -5]}, "unknown key 'plaice'"),
    ({"name": "b", "out": "elsewhere"}, "out: not for a line"),
    ({"name": "c", "allow_pickle": True}, "allow_pickle: not for a line"),
    ({"name": "d", "seed": 1.5}, "seed: expected a whole number (found 1.5)"),
    ({"name": "e", "photo": "p.png"}, "--asset: needed"),
    ({"name": "f", "demo": True, "device": "cuda:1"}, "a batch gives out the devices itself"),
    ({"name": "g", "demo": True, "at": [1, 1], "place": [0, 0, 1]}, "cannot be used with"),
]


def test_every_bad_row_is_kept_with_its_problem(tmp_path: Path) -> None:
    good = {"name": "good", "demo": True}
    rows = read(write_manifest(tmp_path, [good, *(row for row, _ in BAD_ROWS), "", good | {
        "name": "last"}]))  # fmt: skip
    assert [row.line for row in rows] == [*range(1, len(BAD_ROWS) + 2), len(BAD_ROWS) + 3]
    assert rows[0].config is not None and rows[-1].config is not None
    for row, (_, words) in zip(rows[1:-1], BAD_ROWS, strict=True):
        assert row.config is None and row.problem is not None
        assert words in str(row.problem), (words, str(row.problem))


def test_rows_and_flags_become_configurations(tmp_path: Path) -> None:
    """Paths start at the manifest, those of the command line where that is; a row wins."""
    rows = read(
        write_manifest(tmp_path, [
            {"name": "a", "photo": "sub/p.png", "asset": "/abs/car.glb", "at": [3, 4]},
            {"name": "b", "photo": "p.png", "demo": False, "camera-height": 2, "light": None,
             "sun": "10,20", "model": "someone/some-model", "prompt": "a car", "guidance": "none"},
        ]),
        place=(0.0, 0.0, -5.0), asset="car.glb", light="noon.hdr",
    )  # fmt: skip
    first, second = (row.config for row in rows)
    assert first is not None and second is not None, [row.problem for row in rows]
    assert (first.inputs.photo, first.inputs.asset) == (str(tmp_path / "sub/p.png"), "/abs/car.glb")
    assert first.light.file == second.light.file or first.light.file == str(Path.cwd() / "noon.hdr")
    assert (first.placement.at, first.placement.place) == ((3.0, 4.0), None)
    assert first.output.out == str(tmp_path / "out" / "a")
    assert second.inputs.asset == str(Path.cwd() / "car.glb")
    assert second.placement.place == (0.0, 0.0, -5.0) and second.camera.height == 2.0
    assert second.light.file is None and second.light.sun == (10.0, 20.0)
    assert second.diffusion.model == "someone/some-model"


def test_a_name_longer_than_a_file_can_have_is_its_scenes_alone(tmp_path: Path) -> None:
    """No folder has it; the model's reader says so."""
    long = {"name": "a", "demo": True, "model": "m" * 300, "prompt": "a car"}
    first, second = read(write_manifest(tmp_path, [long, {"name": "b", "demo": True}]))
    assert first.config is not None and first.config.diffusion.model == "m" * 300
    assert second.config is not None


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        ([], ExitCode.USAGE, "command line: the following arguments are required: MANIFEST"),
        (["m.jsonl"], ExitCode.USAGE, "--out: needed"),
        (["m.jsonl", "--out", "o", "--workers", "0"], ExitCode.USAGE, "--workers: a whole number"),
        (["m.jsonl", "--out", "o", "--retries", "x"], ExitCode.USAGE, "--retries: a whole number"),
        (["m.jsonl", "--out", "o", "--wrokers", "2"], ExitCode.USAGE, "--wrokers: no such flag"),
        (["none.jsonl", "--out", "o"], ExitCode.USAGE, "none.jsonl: no such file"),
        (["empty.jsonl", "--out", "o"], ExitCode.USAGE, "scenes miscounted (found 0"),
        (["table.csv", "--out", "o"], ExitCode.USAGE, "table.csv: not JSON lines (expected"),
        (["list.json", "--out", "o"], ExitCode.USAGE, "list.json: not JSON lines (expected"),
        (["spread.json", "--out", "o"], ExitCode.USAGE, "expected an object {...} on each line"),
        (["m.jsonl", "--out", "o", "--max-json-bytes", "9"], ExitCode.USAGE, "too large"),
        (["m.jsonl", "--out", "o", "--workers", "1" * 5000], ExitCode.USAGE, "--workers: a whole"),
        (["o/batch.json", "--out", "o"], ExitCode.USAGE, "would replace the manifest"),
        (["m.jsonl", "--out", "foreign"], ExitCode.OUTPUT, "not the summary of a batch"),
        (["m.jsonl", "--out", "linked"], ExitCode.OUTPUT, "not the summary of a batch"),
        (["m.jsonl", "--out", "list"], ExitCode.OUTPUT, "failures.jsonl: there without"),
        (["m.jsonl", "--out", "logged"], ExitCode.OUTPUT, "logs: there without"),
        (["m.jsonl", "--out", "ours"], ExitCode.OUTPUT, "logs: not a folder"),
    ],
)
def test_a_batch_that_cannot_begin(
    argv: list[str], code: ExitCode, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "m.jsonl").write_text('{"name": "a", "demo": true}\n')
    (tmp_path / "empty.jsonl").write_text("\n")
    (tmp_path / "table.csv").write_text("name,demo\na,true\n")
    (tmp_path / "spread.json").write_text('{\n  "name": "a",\n  "demo": true\n}\n')
    (tmp_path / "list.json").write_text('[\n{"name": "a", "demo": true}\n]\n')
    for name, text in (("o", '{"name": "a", "demo": true}'), ("foreign", "mine")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "batch.json").write_text(text)
    for name in ("linked", "list", "logged/logs", "ours"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "linked" / "batch.json").symlink_to("nowhere")
    (tmp_path / "list" / "failures.jsonl").write_text("mine")
    (tmp_path / "logged" / "logs" / "a.log").write_text("mine")
    (tmp_path / "ours" / "batch.json").write_text('{"format": "warpir-batch"}')
    (tmp_path / "ours" / "logs").write_text("mine")
    before = snapshot(tmp_path)
    assert main(argv) == code
    error = capsys.readouterr().err.splitlines()[0]
    assert error.startswith("error: ") and words in error
    assert snapshot(tmp_path) == before


# -------------------------------------------------------------------------- who does what, and when


class Scripted:
    """Workers that answer as they are told, the oldest task first."""

    def __init__(self, count: int, answers: dict[int, list[Answer]]) -> None:
        self.count, self.answers = count, answers
        self.running: list[int] = []
        self.started: list[tuple[int, int, int]] = []
        """Of each task: its key, its attempt, and how many others run."""

    @property
    def free(self) -> int:
        return self.count - len(self.running)

    def start(self, key: int, task: Task) -> None:
        self.started.append((key, task.attempt, len(self.running)))
        self.running.append(key)

    def wait(self) -> tuple[int, Answer]:
        key = self.running.pop(0)
        return key, self.answers.get(key, [Answer(0, found={"how": "done"})]).pop(0)

    def stop(self) -> list[tuple[int, Answer]]:
        return [(key, Answer(143)) for key in self.running]


def options_of(tmp_path: Path, **changes: Any) -> batch.Options:
    values = {"workers": None, "retries": 1, "ray": None, "is_validating": False}
    values |= {"is_all_or_nothing": False, "is_fresh": False}
    return batch.Options(tmp_path / "m.jsonl", tmp_path, **{**values, **changes})


def batch_of(tmp_path: Path, count: int, **changes: Any) -> batch.Batch:
    (tmp_path / "m.jsonl").write_text(
        "".join(json.dumps({"name": f"s{k}", "demo": True, "device": "cpu"}) + "\n"
                for k in range(count))
    )  # fmt: skip
    manifest = read_manifest(tmp_path / "m.jsonl", tmp_path / "out", {}, LIMITS)
    made = batch.Batch(options_of(tmp_path, **changes), manifest)
    for scene in made.scenes:
        scene.needs = {"memory": 1 << 30, "disk": 0, "has_place": False, "is_done": False}
    return made


def test_only_what_another_attempt_can_cure_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At the end, alone, as often as was said; never a bad input."""
    killed = answer_of_the_dead(-signal.SIGKILL)
    crashed = answer_of_the_dead(-signal.SIGSEGV)
    short = Answer(ExitCode.RESOURCES, ("error: memory: not enough",), is_short=True)
    full = Answer(ExitCode.RESOURCES, ("error: o: cannot be written",))
    bad = Answer(ExitCode.INPUT, ("error: p.png: truncated",))
    good = Answer(0, found={"how": "done"})
    made = batch_of(tmp_path, 6)
    workers = Scripted(2, {0: [killed, good], 1: [short, short], 2: [bad], 3: [full], 4: [crashed,
                       good]})  # fmt: skip
    monkeypatch.setattr(made, "_prepare", lambda keys: 0)
    made._workers = workers
    made.threads = 1
    made.do()
    firsts = [(key, attempt) for key, attempt, _ in workers.started]
    assert firsts == [*((k, 1) for k in range(6)), (0, 2), (1, 2), (4, 2)]
    assert [others for _, _, others in workers.started[6:]] == [0, 0, 0]
    states = [(scene.state, int(scene.status), len(scene.retries)) for scene in made.scenes]
    assert states == [
        ("done", 0, 1), ("failed", 5, 1), ("failed", 3, 0), ("failed", 5, 0), ("done", 0, 1),
        ("done", 0, 0),
    ]  # fmt: skip
    made.write()
    assert [failure["name"] for failure in failures_of(tmp_path)] == ["s1", "s2", "s3"]
    with pytest.raises(InputError) as caught:
        made.raise_failures("failed")
    assert caught.value.code == ExitCode.RESOURCES, "of the first in the manifest's order"
    assert crashed.status == ExitCode.BUG and "SIGSEGV" in crashed.lines[0]


def test_attempts_at_the_check_of_a_scene_that_failed_in_it_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of one that passed are none of its insertion's."""
    killed, good = answer_of_the_dead(-signal.SIGKILL), Answer(0, found={"is_done": False})
    made = batch_of(tmp_path, 2)
    workers = Scripted(2, {0: [killed, killed], 1: [killed, good]})
    monkeypatch.setattr(batch, "LocalWorkers", lambda environments: workers)
    made.check()
    assert [scene.failure()["attempts"] for scene in made.scenes] == [2, 1]
    assert [scene.state for scene in made.scenes] == ["failed", "not run"]


def test_a_manifest_that_goes_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The summary has the digest of what was read, and both files are there."""
    manifest = write_manifest(tmp_path, [{"name": "a", "demo": True, "plaice": 1}])
    digest = hashlib.sha256(manifest.read_bytes()).hexdigest()
    monkeypatch.setattr(batch.Batch, "check", lambda self: manifest.unlink())
    assert main([str(manifest), "--out", str(tmp_path / "out")]) == ExitCode.USAGE
    assert summary_of(tmp_path / "out")["sha256"] == digest
    assert [failure["name"] for failure in failures_of(tmp_path / "out")] == ["a"]


@pytest.mark.parametrize(
    ("flags", "how"), [([], "goes on with the rest"), (["--overwrite"], "does all again")]
)
def test_how_a_stopped_batch_goes_on(
    flags: list[str], how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """The last line tells; the next one takes the folder for a batch's."""

    def stop(self: object) -> None:
        raise Stopped(signal.SIGTERM)

    manifest = write_manifest(tmp_path, [{"name": "a", "demo": True}])
    monkeypatch.setattr(batch.Batch, "check", lambda self: None)
    monkeypatch.setattr(batch.Batch, "do", stop)
    for _ in range(2):
        assert main([str(manifest), "--out", str(tmp_path / "out"), *flags]) == 143
        said = f"stopped by SIGTERM; kept: 0 of 1 scenes; the same command {how}\n"
        assert capsys.readouterr().err == said
        (tmp_path / "out" / "logs").mkdir(exist_ok=True)


def test_a_worker_that_hangs_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When its time is over, and its answer is not waited for."""
    (tmp_path / "sitecustomize.py").write_text(
        "import pathlib, signal, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        f"pathlib.Path({str(tmp_path)!r}, 'begun').touch()\n"
        "time.sleep(60)\n"
    )
    monkeypatch.setattr("warpir.batch.local.GRACE_SECONDS", 0.2)
    workers, began = LocalWorkers([{"PYTHONPATH": str(tmp_path)}]), time.monotonic()
    workers.start(7, Task(COMPILE))
    wait_for(lambda: (tmp_path / "begun").exists())
    ((key, answer),) = workers.stop()
    assert (key, answer.died) == (7, "SIGKILL") and time.monotonic() - began < 30.0


def test_a_worker_with_a_fault_of_its_own_is_replaced() -> None:
    """What it holds may be spoilt, such as a CUDA context: the next scene gets a new process."""
    workers = LocalWorkers([{}])
    processes: list[Any] = []
    try:
        for _ in range(2):
            workers.start(0, Task("no such thing"))
            ((_, worker),) = workers._running.values()
            processes.append(worker._process)
            assert workers.wait()[1].status == ExitCode.BUG
    finally:
        workers.stop()
    assert processes[0].pid != processes[1].pid and processes[0].exitcode is not None


def test_a_worker_without_a_log(tmp_path: Path) -> None:
    """A full disk hides no answer, and a log that cannot be opened is one; the worker goes on.

    Killed while it has nothing to do, it is replaced.
    """
    (tmp_path / "logs").write_text("a file")
    workers, answers, pids = LocalWorkers([{}]), [], []
    try:
        for log in ("/dev/full", str(tmp_path / "logs" / "a.log"), None):
            workers.start(0, Task(COMPILE, folder=str(tmp_path / "gone"), log=log))
            ((_, worker),) = workers._running.values()
            assert worker._process is not None
            pids.append(worker._process.pid)
            answers.append(workers.wait()[1])
            if len(pids) == 2:
                worker._process.kill()
                worker._process.join()
                time.sleep(0.2)  # the pool learns of it in a thread
    finally:
        workers.stop()
    assert [answer.status for answer in answers] == [
        ExitCode.INPUT, ExitCode.RESOURCES, ExitCode.INPUT,
    ]  # fmt: skip
    assert "the folder of the manifest cannot be entered" in answers[0].lines[0]
    assert answers[1].lines[0].startswith(f"error: {tmp_path / 'logs' / 'a.log'}: cannot be")
    assert pids[0] == pids[1] != pids[2]


def on_devices(made: batch.Batch, *devices: str | None) -> None:
    """Let scenes name their devices."""
    for scene, device in zip(made.scenes, devices, strict=True):
        assert scene.row.config is not None
        scene.row = replace(scene.row, config=scene.row.config.changed(device=device))


class Devices(Scripted):
    """Compiles for the CPU alone, and notes for what it was asked."""

    def __init__(self, environments: Sequence[object]) -> None:
        super().__init__(len(environments), {})
        self.asked: list[Any] = []

    def start(self, key: int, task: Task) -> None:
        super().start(key, task)
        self.answers[key] = [Answer(0, found={"is_done": False, "how": "done", "cuda": 0})]
        if task.do == COMPILE:
            self.asked.append((task.config["devices"], task.config["places"]))
            if task.config["devices"] == ["cuda"]:
                self.answers[key] = [Answer(ExitCode.USAGE, ("error: --device: no device cuda",))]


@pytest.mark.parametrize("are_all_checked", [True, False])
def test_a_device_that_is_not_there_is_its_lines_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, are_all_checked: bool
) -> None:
    """The check finds it; so does what comes later, and the other scenes are done."""
    made = batch_of(tmp_path, 3)
    on_devices(made, "cpu", "cuda", None)
    workers = Devices([1])
    monkeypatch.setattr(batch, "LocalWorkers", lambda environments: workers)
    made._workers = workers
    if are_all_checked:
        made.check()
        assert workers.asked == [(["cuda"], [])]
        assert [scene.state for scene in made.scenes] == ["not run", "failed", "not run"]
    for scene in made.scenes:
        scene.needs = {"memory": 0, "disk": 0, "has_place": False}
    made.do()
    assert [scene.state for scene in made.scenes] == ["done", "failed", "done"]
    assert made.scenes[1].failure()["error"] == "--device: no device cuda"


def test_no_scene_whose_device_is_there(tmp_path: Path) -> None:
    """Nothing is started then; with --all-or-nothing neither is any other."""
    for devices, is_all_or_nothing in ((["cuda"], False), (["cuda", "cpu"], True)):
        made = batch_of(tmp_path, len(devices), is_all_or_nothing=is_all_or_nothing)
        on_devices(made, *devices)
        made._workers = Devices([1])
        with pytest.raises(InputError, match=r"1 of . scenes") as caught:
            made.do()
            made.raise_failures("failed")
        assert caught.value.code == ExitCode.USAGE
        assert "done" not in [scene.state for scene in made.scenes]


@pytest.mark.slow
def test_a_batch_on_a_machine_without_the_device(
    memory: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """--validate tells the line, and without it the other scene is done."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    rows = [{**scenes(2)[k], "device": device} for k, device in enumerate(("cuda", "cpu"))]
    argv = [str(write_manifest(memory, rows)), "--out", str(memory / "out"), *FLAGS[:4], *FLAGS[6:]]
    told = "line 1, scene-0: failed (2): --device: no device cuda here (found cpu)"
    assert main([*argv, "--validate"]) == ExitCode.USAGE
    assert told in capsys.readouterr().out
    assert main(argv) == ExitCode.USAGE
    assert told in capsys.readouterr().out
    assert states_of(memory / "out") == {"scene-0": "failed", "scene-1": "done"}


def test_the_check_takes_no_more_than_the_machine_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever --workers says, which may be those of a cluster."""
    made = batch_of(tmp_path, 9, workers=256, ray="far:1")
    found: list[int] = []

    def workers(environments: Sequence[object]) -> Devices:
        found.append(len(environments))
        return Devices(environments)

    monkeypatch.setattr(batch, "LocalWorkers", workers)
    monkeypatch.setattr(batch, "core_count", lambda: 8)
    for free in (100 << 30, 1 << 30, 1):
        monkeypatch.setattr(batch, "free_host", lambda free=free: free)
        made.check()
    assert found == [8, 3, 1]


def test_workers_by_cores_memory_and_devices(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Together they use no more threads than there are cores, and no more memory than is free."""
    made = batch_of(tmp_path, 5)
    found: list[list[dict[str, str]]] = []

    class Noted(Scripted):
        def __init__(self, environments: list[dict[str, str]]) -> None:
            super().__init__(len(environments), {})
            found.append(environments)

    monkeypatch.setattr(batch, "LocalWorkers", Noted)
    monkeypatch.setattr(batch, "core_count", lambda: 8)
    monkeypatch.setattr(batch, "free_host", lambda: 100 << 30)
    monkeypatch.setattr(made, "_compile", lambda *_: 2)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)

    def counts(**changes: Any) -> tuple[int, int]:
        for name, value in changes.items():
            monkeypatch.setattr(batch, name, value)
        made._prepare(range(5))
        assert len(found[-1]) == made.worker_count
        return made.worker_count, made.threads

    assert counts() == (5, 1) and "CUDA_VISIBLE_DEVICES" not in found[-1][0]
    assert counts(free_host=lambda: 5 << 30) == (2, 4)
    assert counts(free_host=lambda: 1) == (1, 8)
    made.options = options_of(tmp_path, workers=3)
    assert counts() == (3, 2)
    assert made._task(INSERT, 0).config["threads"] == 2
    on_devices(made, *[None] * 5)
    made.options = options_of(tmp_path)
    assert counts(free_host=lambda: 100 << 30) == (2, 4)
    assert [e["CUDA_VISIBLE_DEVICES"] for e in found[-1]] == ["0", "1"]
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    made.options = options_of(tmp_path, workers=4)
    assert counts() == (4, 2)
    assert [e["CUDA_VISIBLE_DEVICES"] for e in found[-1]] == ["3", "5", "3", "5"]


# -------------------------------------------------------------------------------------------- Ray

CLUSTER = """
import sys
from ray.cluster_utils import Cluster

if __name__ == "__main__":
    small = {"num_cpus": 1, "object_store_memory": 80 << 20}
    cluster = Cluster(initialize_head=True, head_node_args={**small, "include_dashboard": False})
    cluster.add_node(**small)
    try:
        from warpir.batch.command import main
        sys.exit(main([*sys.argv[1:], "--ray", cluster.address]))
    finally:
        cluster.shutdown()
"""


@pytest.mark.slow
@pytest.mark.case("R16")
def test_a_batch_on_a_cluster_of_two_machines(memory: Path, hooked: Path) -> None:
    """A worker is killed, all scenes are done. In a child, since a cluster needs sockets."""
    (hooked / "kill-scene-1").touch()
    (memory / "cluster.py").write_text(CLUSTER)
    argv = [sys.executable, "-P", "cluster.py", str(write_manifest(memory, scenes(4)))]
    argv += ["--out", str(memory / "out"), *FLAGS]
    env = {**os.environ, "RAY_USAGE_STATS_ENABLED": "0", "RAY_TMPDIR": str(memory)}
    child = subprocess.run(
        argv, cwd=memory, env=env, capture_output=True, text=True, timeout=300, check=False
    )
    assert child.returncode == ExitCode.DONE, child.stderr
    why = "WorkerCrashedError"
    assert f"scene-1: {why}: it is tried again at the end, by itself" in child.stdout
    found = summary_of(memory / "out")
    assert [scene["retries"] for scene in found["scenes"]] == [[], [why], [], []]
    assert set(states_of(memory / "out").values()) == {"done"} and found["workers"] == 2
    assert len(list((memory / "out").glob("*/run.json"))) == 4
    assert not list((memory / "out").glob(".batch-*")) and failures_of(memory / "out") == []


def cluster_of(*machines: dict[str, float]) -> RayWorkers:
    """Workers on machines with these resources, of which nothing runs."""
    nodes = [{"Alive": True, "Resources": machine} for machine in machines]
    workers = RayWorkers.__new__(RayWorkers)
    workers._ray, workers._memory, workers._running = SimpleNamespace(nodes=lambda: nodes), {}, {}
    return workers


def test_what_a_task_asks_of_a_cluster_is_there_on_one_machine() -> None:
    """Cores and memory of those with a GPU where it takes one: Ray would wait for ever."""
    head = {"CPU": 64.0, "memory": 256e9}
    small = {"CPU": 8.0, "GPU": 1.0, "memory": 32e9}
    large = {"CPU": 4.0, "GPU": 2.0, "memory": 64e9}
    mixed = cluster_of(head, small)
    assert mixed.share(1, {1: 1 << 30}) == 8 and mixed.share(2, {1: 1 << 30}) == 4
    assert mixed.share(1, {0: 1 << 30}) == 64 and mixed.share(1, {0: 1, 1: 1}) == 8
    mixed.share(1, {0: 10**15, 1: 10**15})
    assert mixed._memory == {0: int(256e9), 1: int(32e9)}
    # The machine with the memory has fewer cores than another one.
    assert cluster_of(small, large).share(1, {1: int(16e9)}) == 8
    assert cluster_of(small, large).share(1, {1: int(48e9)}) == 4
    assert cluster_of({"CPU": 0.0, "memory": 64e9}, small).share(1, {0: int(48e9)}) == 8
    for machines in ([head], [head, {"GPU": 4.0, "memory": 1e9}]):
        with pytest.raises(InputError, match="no machine of the cluster has a CPU and a GPU") as e:
            cluster_of(*machines).share(1, {1: 1})
        assert e.value.code == ExitCode.RESOURCES


def test_a_task_with_a_gpu_has_a_process_of_its_own() -> None:
    """As a fault of CUDA stays in the process that saw it."""
    workers = cluster_of({"CPU": 8.0, "GPU": 1.0, "memory": 8e9})
    options: list[dict[str, Any]] = []

    def remote(**given: object) -> Any:
        options.append(given)
        return lambda function: SimpleNamespace(remote=lambda task: len(options))

    workers._ray.remote = remote
    workers.share(1, {0: 1 << 40, 1: 1 << 20})
    workers.start(0, Task(INSERT, memory=1 << 40))
    workers.start(1, Task(INSERT, memory=1 << 20, gpus=1))
    assert [given["max_calls"] for given in options] == [0, 1]
    assert [given["memory"] for given in options] == [int(8e9), 1 << 20]


@pytest.mark.parametrize("gpus", [0, 1])
def test_a_device_that_no_machine_of_a_cluster_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gpus: int
) -> None:
    """Lines that name it fail, and no machine is asked to compile for it."""
    asked: list[Any] = []

    class Cluster(Scripted):
        cpus = 4

        def __init__(self, address: str) -> None:
            super().__init__(1, {})
            self.gpus = gpus

        def prepare(self, out: Path, task: Task) -> None:
            asked.append(task.config["devices"])

        def share(self, count: int, memory: dict[int, int]) -> int:
            asked.append(sorted(memory))
            return 1

    made = batch_of(tmp_path, 2, ray="far:1")
    on_devices(made, "cuda", "cpu")
    monkeypatch.setattr(batch, "RayWorkers", Cluster)
    made.do()
    assert [scene.state for scene in made.scenes] == ["done" if gpus else "failed", "done"]
    assert asked == ([[None, "cpu"], [0, 1]] if gpus else [["cpu"], [0]])


def test_ray_is_an_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Asked for and not there, it is named with what brings it, before anything is read."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda n: None if n == "ray" else find(n))
    assert main([str(tmp_path / "m.jsonl"), "--out", str(tmp_path / "o"), "--ray"]) == 2
    error = capsys.readouterr().err.splitlines()
    assert error == ["error: ray: not installed", "pip install 'warpir[ray]' brings it"]
    assert not (tmp_path / "o").exists()


def test_an_address_where_nobody_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    """Said at once; sockets raise in tests as they do where a machine cannot be reached."""

    def refuse(*arguments: object) -> None:
        raise ConnectionRefusedError(111, "Connection refused")

    monkeypatch.setattr("socket.create_connection", refuse)
    with pytest.raises(InputError, match=r"no cluster can be used at 10.0.0.1:6379") as caught:
        RayWorkers("10.0.0.1:6379")
    assert caught.value.code == ExitCode.USAGE and caught.value.where == "--ray"


def test_a_machine_without_the_folder_says_so(tmp_path: Path) -> None:
    """What each machine of a cluster is asked before any scene."""
    task = Task(COMPILE, {"devices": [], "places": []})
    assert not _probe(str(tmp_path / "elsewhere"), "node", task)[0]
    (tmp_path / "driver").write_text("token")
    seen, answer = _probe(str(tmp_path), "node", task)
    assert seen and answer.status == 0, answer
    assert (tmp_path / "node").read_text() == "token"


def test_a_machine_that_cannot_run_says_so(tmp_path: Path) -> None:
    """Such as one without warpir; what another one writes late hides nothing."""
    from ray.exceptions import RayError

    class Cluster:
        def nodes(self) -> list[dict[str, Any]]:
            return [{"Alive": True, "NodeID": "00" * 28, "NodeManagerHostname": "far"}]

        def remote(self, **options: object) -> Any:
            return lambda function: self

        def options(self, **options: object) -> Any:
            return SimpleNamespace(remote=lambda *arguments: None)

        def get(self, reference: object) -> None:
            (folder,) = tmp_path.glob(".batch-*")
            (folder / "late").mkdir()
            raise RayError("first\nModuleNotFoundError: No module named 'warpir'\n")

    workers = RayWorkers.__new__(RayWorkers)
    workers._ray = Cluster()
    with pytest.raises(InputError, match=r"the machine far: .*No module named 'warpir'") as caught:
        workers.prepare(tmp_path, Task(COMPILE))
    assert caught.value.code == ExitCode.USAGE and not list(tmp_path.iterdir())
