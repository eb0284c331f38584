"""Processes that are killed, or whose disk fails, at any moment: nothing is lost, nothing is mixed.

Once at every operation on the file system, in a child that loads neither torch nor Warp; and at 40
random moments of guided runs, which then resume to the bytes of a run that nothing stopped.
"""

import errno
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.builders.faults import Ended, run_case, snapshot
from tests.builders.guided_runs import guided_argv, old_results, results_of, write_guided_inputs
from tests.builders.outcome import outcome_of
from warpir.core.errors import InputError

ROOT = Path(__file__).resolve().parents[2]

# ------------------------------------------------------------- every operation, one after another


def at_each_operation(case: str, folder: Path, how: str) -> list[dict[str, Any]]:
    """Do a thing once for each of its operations, and fail at that one.

    Args:
        case: ``results`` replaces the results in a folder, ``again`` does so after a kill in the
            middle of that, ``checkpoint`` writes one more.
        folder: Where; must be empty.
        how: ``kill``; ``full``: that operation finds no room; ``broken``: that and all later ones.

    Returns:
        By operation: its name, what `files_of` finds then, what it finds after the next run has
        entered the folder, and how the process ended.
    """
    child = subprocess.run(
        [
            sys.executable,
            "-c",
            f"from tests.insert.test_kill import _each; _each({case!r}, {how!r})",
        ],
        cwd=ROOT,
        env={**os.environ, "FOLDER": str(folder)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert child.returncode == 0, child.stderr
    return [json.loads(line) for line in child.stdout.splitlines()]


OLD = {"composite.png": b"old", "sub/object.glb": b"old", "lobes.json": b"old", "same.json": b"="}
NEW = {"composite.png": b"new", "sub/light.hdr": b"new", "camera.json": b"new", "same.json": b"="}


def files_of(folder: Path) -> dict[str, str]:
    """Return a folder's files and what is in them; of `run.json` whether its list is right."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = str(path.relative_to(folder))
            found[name] = path.read_bytes().decode("latin-1")
            if path.name == "run.json":
                run = json.loads(found[name])
                hashes = {
                    n: hashlib.sha256((folder / n).read_bytes()).hexdigest()
                    for n in run["files"]
                    if (folder / n).is_file()
                }
                found[name] = f"{run['who']}, {'whole' if hashes == run['files'] else 'in parts'}"
    return found


def _write_results(folder: Path, files: dict[str, bytes], who: str) -> None:
    from warpir.io.results import OutputFolder

    with OutputFolder(folder, overwrite=True) as output:
        for name, content in files.items():
            output.write_bytes(name, content)
        output.write_json("run.json", {"who": who})


def _each(case: str, how: str) -> None:
    """Fork a child for each operation; print a line for each. Runs in a process of its own."""
    root = Path(os.environ["FOLDER"])
    start, thing, next_run = _things(case, root / "start")
    sys.addaudithook(_Counter.hook)
    fsync = os.fsync

    def counted_fsync(descriptor: Any) -> None:
        _Counter.count("fsync")
        fsync(descriptor)

    os.fsync = counted_fsync
    start()
    for turn in range(1, 1000):
        folder = root / str(turn)
        shutil.copytree(root / "start", folder)
        read, write = os.pipe()
        pid = os.fork()
        if pid == 0:
            _Counter.begin(str(folder), turn, how, write)
            status = 0
            try:
                thing(folder)
            except InputError as error:
                status = int(error.code)
            os._exit(status)
        os.close(write)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        operation = os.read(read, 1000).decode()
        os.close(read)
        if not operation:  # there were not that many: it went through
            assert status == 0
            return
        line = {"operation": operation, "status": status, "left": files_of(folder)}
        next_run(folder)
        print(json.dumps({**line, "then": files_of(folder)}), flush=True)
        shutil.rmtree(folder)
    raise AssertionError("no end of operations")


def _things(
    case: str, start: Path
) -> tuple[Callable[[], None], Callable[[Path], None], Callable[[Path], None]]:
    from warpir.io.results import OutputFolder

    def old_results() -> None:
        _write_results(start, OLD, "old")
        (start / "notes.txt").write_text("mine")

    def enter(folder: Path) -> None:
        with pytest.raises(KeyboardInterrupt), OutputFolder(folder, overwrite=True):
            raise KeyboardInterrupt

    if case == "results":
        return old_results, lambda folder: _write_results(folder, NEW, "new"), enter
    if case == "again":

        def killed() -> None:
            old_results()
            pid = os.fork()
            if pid == 0:
                renamed = 0

                def stop(event: str, args: tuple[Any, ...]) -> None:
                    nonlocal renamed
                    renamed += event == "os.rename"
                    if event == "os.rename" and renamed == 3:  # two of the new files are in place
                        os.kill(os.getpid(), signal.SIGKILL)

                sys.addaudithook(stop)
                _write_results(start, NEW, "new")
            assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL
            assert not (start / "run.json").exists()
            assert set(NEW) & {str(p.relative_to(start)) for p in start.rglob("*")}

        return killed, lambda folder: _write_results(folder, NEW, "new"), enter

    import torch

    from warpir.core.atomic import Checkpoints

    def save(folder: Path, steps: tuple[int, ...] = (3,)) -> None:
        for step in steps:
            state = {"unknowns": torch.full((4,), float(step)), "history": [step]}
            Checkpoints(folder, {"a": 1}).save("optimize", step, state)

    def load(folder: Path) -> None:
        found = Checkpoints(folder, {"a": 1}).load(pytest.fail)
        assert found.state["history"] == [found.step]
        assert float(found.state["unknowns"][0]) == found.step
        (folder / "loaded").write_text(str(found.step))
        save(folder, (4,))

    def first() -> None:
        start.mkdir()
        save(start, (1, 2))

    return first, save, load


class _Counter:
    """Counts what a process does to a folder, and lets one of the operations fail."""

    folder = ""
    left = 0
    how = ""
    pipe = 0
    EVENTS = ("open", "os.rename", "os.remove", "os.mkdir", "os.rmdir")

    @classmethod
    def begin(cls, folder: str, turn: int, how: str, pipe: int) -> None:
        cls.left, cls.how, cls.pipe, cls.folder = turn, how, pipe, folder

    @classmethod
    def hook(cls, event: str, args: tuple[Any, ...]) -> None:
        # Within shutil.rmtree names are relative to a descriptor.
        if event in cls.EVENTS and cls.folder:
            place = str(args[0])
            if event == "open" and not args[2] & (os.O_WRONLY | os.O_RDWR):
                return
            if place.startswith(cls.folder) or not place.startswith("/"):
                cls.count(f"{event} {place.removeprefix(cls.folder)}")

    @classmethod
    def count(cls, operation: str) -> None:
        if not cls.folder:
            return
        cls.left -= 1
        if cls.left == 0:
            os.write(cls.pipe, operation.encode())
        if cls.how == "kill" and cls.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        if cls.left == 0 or (cls.how == "broken" and cls.left < 0):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def whole_result(files: dict[str, str]) -> str:
    """Return whose result is there: ``old`` or ``new``; empty where there is no `run.json`."""
    if "run.json" not in files:
        return ""
    who, state = files["run.json"].split(", ")
    assert state == "whole", files
    shown = {name: text for name, text in files.items() if not name.startswith(".")}
    expected = {"old": OLD, "new": NEW}[who]
    assert shown == {
        **{name: content.decode() for name, content in expected.items()},
        "notes.txt": "mine",
        "run.json": f"{who}, whole",
    }
    return who


@pytest.mark.slow
@pytest.mark.case("R1", "R4")
@pytest.mark.parametrize("how", ["kill", "full", "broken"])
@pytest.mark.parametrize("case", ["results", "again"])
def test_results_are_the_old_or_the_new_ones(tmp_path: Path, case: str, how: str) -> None:
    """Whatever operation is the last: no ``run.json`` over a mixture, and none over half of it.

    Between the two results there is a time without ``run.json``; the next run that enters the
    folder then removes what of the new one is in place.
    """
    turns = at_each_operation(case, tmp_path, how)
    assert len(turns) > 20
    left = [whole_result(turn["left"]) for turn in turns]
    then = [whole_result(turn["then"]) for turn in turns]
    assert left == then
    assert set(left) == ({"old", "", "new"} if case == "results" else {"", "new"})
    if how == "kill":
        assert left == sorted(left, key=("old", "", "new").index), "they do not come and go"
    for turn, who in zip(turns, left, strict=True):
        # Of the next run nothing stays, and nothing of a result that is in parts.
        assert not any(name.startswith(".") for name in turn["then"])
        assert turn["then"]["notes.txt"] == "mine"
        if who == "":
            assert "new" not in turn["then"].values()
        if how == "kill":
            assert turn["status"] == -signal.SIGKILL
        else:  # what fails when the new ones are complete harms nobody
            assert turn["status"] in ((5, 0) if who == "new" else (5,)), turn


@pytest.mark.slow
@pytest.mark.case("R1", "R4")
@pytest.mark.parametrize("how", ["kill", "full", "broken"])
def test_a_whole_checkpoint_is_always_there(tmp_path: Path, how: str) -> None:
    """The one before, until the new one is complete; the next run reads it and goes on."""
    turns = at_each_operation("checkpoint", tmp_path, how)
    assert len(turns) > 8
    loaded = [turn["then"]["loaded"] for turn in turns]
    assert set(loaded) == {"2", "3"}
    if how == "kill":
        assert loaded == sorted(loaded)
    for turn in turns:
        assert sum(name.endswith("manifest.json") for name in turn["then"]) == 2
        assert not any("/." in name for name in turn["then"])
        assert turn["status"] in ((-signal.SIGKILL,) if how == "kill" else (5, 0))


# ------------------------------------------------------------------ random moments of guided runs

MOMENTS = r"""
import os, signal, sys, time
log = os.open({log!r}, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
count = 0
def note(event):
    global count
    os.write(log, f"{{time.monotonic()}} {{event}}\n".encode())
    count += event == {event!r}
    if event == {event!r} and count == {turn}:
        me = os.pidfd_open(os.getpid())
        if os.fork() == 0:  # not a thread: it would wait for the interpreter
            os.closerange(0, me)  # the folder's lock too: it would outlive the run in this one
            os.closerange(me + 1, 65536)
            try:
                time.sleep({delay})
                signal.pidfd_send_signal(me, signal.SIGKILL)
            finally:
                os._exit(0)
    if event == "end" and {event!r}:
        time.sleep(10)  # a run that is faster than the measured one waits for its kill
def mark(owner, name, event, after=None):
    function = getattr(owner, name)
    def marked(*args, **named):
        note(event)
        result = function(*args, **named)
        if after:
            note(after)
        return result
    setattr(owner, name, marked)
import warpir.diffusion.personalization.personalize, warpir.insert, warpir.io.results
import warpir.core.atomic, warpir.optimize.loop
mark(warpir.diffusion.personalization.lora_training.LoraTraining, "prepare", "iteration")
mark(warpir.optimize.loop.Optimization, "step", "iteration")
mark(warpir.core.atomic.Checkpoints, "save", "checkpoint", "iteration ends")
mark(sys.modules["warpir.insert"], "_write", "write")
mark(warpir.io.results.OutputFolder, "_commit", "commit", "end")
note("load")
"""


class Killable:
    """A guided run, personalisation included, that is started again and again in one folder."""

    def __init__(self, inputs: Path, folder: Path) -> None:
        self.folder, self.out, self.log = folder, folder / "out", folder / "moments"
        self.argv = guided_argv(inputs)
        folder.mkdir()

    def go(self, *more: str, event: str = "", turn: int = 1, delay: float = 0.0) -> Ended:
        """Run; kill it so many seconds after an event has come for the ``turn``-th time."""
        self.log.unlink(missing_ok=True)
        hooks = MOMENTS.format(log=str(self.log), event=event, turn=turn, delay=delay)
        return run_case(
            [*self.argv, *more],
            self.folder,
            env={"WARPIR_CACHE": str(self.folder / "cache")},
            before=hooks,
            warm=True,
        )

    def go_on(self, **kill: Any) -> Ended:
        """Do what a user does after a kill: resume what there is of it, else start again."""
        has_checkpoint = any((self.out / "checkpoints").glob("0*"))
        return self.go("--resume" if has_checkpoint else "--overwrite", **kill)

    def events(self) -> list[tuple[float, str]]:
        """What the last run came by, and when [s]."""
        lines = (line.split(" ", 1) for line in self.log.read_text().splitlines())
        return [(float(when), event) for when, event in lines]


def check_after_kill(out: Path, old: dict[str, str], new: dict[str, str]) -> None:
    """Results are the old ones or the new ones, whole, and so is the newest checkpoint."""
    found = snapshot(out) if out.exists() else {}
    if "run.json" in found:
        listed = json.loads((out / "run.json").read_text())["files"]
        assert {name: found[name] for name in listed} == listed
        names = {*listed, "run.json"}
        is_old = {n: found[n] for n in names} == {n: old.get(n) for n in names}
        made = outcome_of(out, listed)  # not of what was half written beside them
        assert is_old or made == {n: new[n] for n in listed}
    elif old:  # in the middle of the exchange: what is there is of the old ones or the new ones
        for name in set(old) & set(found):
            is_new = name in new and outcome_of(out, [name])[name] == new[name]
            assert found[name] == old[name] or is_new, name
    for folder in (out / "checkpoints").glob("0*"):
        manifest = json.loads((folder / "manifest.json").read_text())
        content = (folder / "state.safetensors").read_bytes()
        assert hashlib.sha256(content).hexdigest() == manifest["sha256"]


CHAINS = 8
SEED = 20


@pytest.mark.slow
@pytest.mark.case("R1")
def test_killed_at_random_moments_resumes_to_the_same_bytes(
    tmp_path: Path, record_property: Callable[[str, object], None]
) -> None:
    """Forty kills in eight runs, each killed while it loads, iterates, saves and writes files."""
    inputs = tmp_path / "inputs"
    inputs.mkdir()
    write_guided_inputs(inputs)
    whole = Killable(inputs, tmp_path / "whole")
    ended = whole.go()
    assert ended.status == 0, ended.err
    expected = results_of(whole.out)
    times = whole.events()
    first = {event: when for when, event in reversed(times)}
    length = {
        "load": first["iteration"] - first["load"],
        "iteration": (first["write"] - first["iteration"]) / 10,
        "checkpoint": first["iteration ends"] - first["checkpoint"],
        "write": first["commit"] - first["write"],
        "commit": first["end"] - first["commit"],
    }
    draws = random.Random(SEED)
    met = dict.fromkeys(length, 0)
    for chain in range(CHAINS):
        run = Killable(inputs, tmp_path / f"chain-{chain}")
        old = old_results(whole.out, run.out) if chain % 2 else {}
        last = "commit" if chain % 3 else "write"
        for phase in ("load", "iteration", "iteration", "checkpoint", last):
            # Of ten steps: after both some are left, and a checkpoint to be killed in.
            turn = draws.randint(1, 4) if phase == "iteration" else 1
            delay = draws.uniform(0.0, 0.7 * length[phase])
            ended = run.go_on(event=phase, turn=turn, delay=delay)
            while ended.status == 0:  # faster than the first run was: it ended before its kill
                assert results_of(run.out) == expected
                delay /= 2.0
                ended = run.go_on(event=phase, turn=turn, delay=delay)
            assert ended.status == -signal.SIGKILL, (phase, ended)
            at = run.events()[-1][1]
            met[{"iteration ends": "iteration", "end": "commit"}.get(at, at)] += 1
            check_after_kill(run.out, old, expected)
        ended = run.go_on()
        assert ended.status == 0, ended.err
        assert results_of(run.out) == expected
    record_property("phases", met)
    assert sum(met.values()) == 40
    assert met["load"] >= 4 and met["iteration"] >= 8 and met["checkpoint"] >= 4, met
    assert met["write"] >= 2 and met["commit"] >= 3, met
