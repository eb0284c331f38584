"""Signals, full disks, folders that vanish: how a run ends when something ends it."""

import hashlib
import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import trimesh

from tests.builders.faults import Ended, assert_fails, run_case, snapshot
from tests.builders.guided_runs import guided_argv, old_results, results_of
from tests.builders.insertions import arguments
from warpir.core import signals
from warpir.core.errors import ExitCode
from warpir.core.signals import Stopped

# ----------------------------------------------------------------------- where a signal is raised


def send(number: int = signal.SIGTERM) -> None:
    signal.raise_signal(number)


def test_a_signal_is_raised_at_once_where_nothing_defers_it() -> None:
    before = signal.getsignal(signal.SIGHUP)
    with pytest.raises(Stopped, match="SIGHUP") as caught, signals.handled():
        send(signal.SIGHUP)
        pytest.fail("went on")
    assert caught.value.number == signal.SIGHUP
    assert signal.getsignal(signal.SIGHUP) == before


def test_a_deferred_signal_waits_for_the_border(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Stopped, match="SIGTERM"), signals.handled(), signals.deferred():
        signals.check()
        send()
        assert signals.is_pending()
        assert "a second signal stops at once" in capfd.readouterr().err
        signals.check()
        pytest.fail("went on")
    assert not signals.is_pending(), "the next run begins anew"
    steps = []
    with pytest.raises(Stopped), signals.handled():
        with signals.deferred():
            send()
            steps.append("the end of the block is a border too")
        steps.append("not reached")
    assert len(steps) == 1


def test_a_second_signal_is_raised_at_once_and_the_first_decides() -> None:
    with pytest.raises(Stopped, match="SIGTERM"), signals.handled(), signals.deferred():
        send(signal.SIGTERM)
        send(signal.SIGINT)
        pytest.fail("went on")


def test_what_must_be_whole_is_finished_first() -> None:
    done = []
    with pytest.raises(Stopped), signals.handled(), signals.deferred():
        with signals.whole():
            with signals.whole():
                send()
                send()
            done.append("inner")
            send()
            done.append("outer")
        pytest.fail("went on")
    assert done == ["inner", "outer"]
    with pytest.raises(Stopped), signals.handled(), signals.deferred():
        with signals.whole():
            send()
        done.append("one signal waits for the border")
        signals.check()
    assert len(done) == 3


class Finalised:
    """Meets a signal where Python can raise nothing, and where it only prints other faults."""

    def __init__(self, fault: Exception | None = None) -> None:
        self.fault = fault

    def __del__(self) -> None:
        if self.fault is not None:
            raise self.fault
        send()
        pytest.fail("went on")


def test_a_signal_that_a_destructor_swallowed_is_raised_again(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """Without waiting for a border, and without a word; other faults are still reported."""
    others: list[object] = []

    def report(fault: "sys.UnraisableHookArgs") -> None:
        others.append(fault.exc_type)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "unraisablehook", report)
        with pytest.raises(Stopped, match="SIGTERM"), signals.handled():
            Finalised(ValueError("another"))
            for _ in range(3):  # as several objects of a frame that ends
                Finalised()
            began = time.monotonic()
            while time.monotonic() < began + 10.0:
                time.sleep(0.001)
            pytest.fail("went on")
        assert sys.unraisablehook is report
    assert others == [ValueError]
    assert capfd.readouterr().err == ""


def test_a_swallowed_signal_is_raised_again_at_the_border() -> None:
    """As when a library catches whatever comes."""
    with pytest.raises(Stopped), signals.handled():
        try:
            send()
        except Stopped:
            pass
        signals.check()
        pytest.fail("went on")


def test_what_the_parent_ignores_stays_ignored() -> None:
    """As SIGHUP under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with signals.handled():
            send(signal.SIGHUP)
            assert not signals.is_pending()
    finally:
        signal.signal(signal.SIGHUP, before)


# -------------------------------------------------------------------------------- runs that stop


HOOK = """
import importlib, os, signal, sys
def at(place, turn, act):
    module, *parts = place.split(":")
    importlib.import_module(module)
    owner = sys.modules[module]
    *owners, name = parts
    for part in owners:
        owner = getattr(owner, part)
    function, calls = getattr(owner, name), [0]
    def hooked(*args, **named):
        calls[0] += 1
        if calls[0] == turn:
            act()
        return function(*args, **named)
    setattr(owner, name, hooked)
def send(*numbers):
    def act():
        for number in numbers:
            os.kill(os.getpid(), number)
    return act
"""


def hook(place: str, turn: int, act: str) -> str:
    """Return code that does something when a function is called for the ``turn``-th time."""
    return HOOK + f"\nat({place!r}, {turn}, {act})\n"


UPDATE = "warpir.diffusion.personalization.lora_training:LoraTraining:update"
STEP = "warpir.optimize.loop:Optimization:step"
SAVE = "warpir.core.atomic:write_folder"
WRITE = "warpir.report.result:write_results"
COMMIT = "warpir.io.results:OutputFolder:_put_in_place"


def guided(
    guided_inputs: Path, folder: Path, *more: str, before: str = "", file_size: int | None = None
) -> Ended:
    """Run what `guided_argv` describes, into ``folder/out``, with a cache of its own."""
    cache = folder.parent / f"{folder.name}-cache"
    return run_case(
        [*guided_argv(guided_inputs), *more],
        folder,
        env={"WARPIR_CACHE": str(cache)},
        before=before,
        file_size=file_size,
        warm=True,
    )


@pytest.fixture(scope="module")
def finished(guided_inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run that nothing stopped."""
    folder = tmp_path_factory.mktemp("finished")
    ended = guided(guided_inputs, folder)
    assert ended.status == ExitCode.DONE, ended.err
    return folder / "out"


def what_is_kept(out: Path, old: dict[str, str]) -> str:
    """Return the name of the newest checkpoint; old results must be whole, and nothing else new."""
    found = snapshot(out) if out.exists() else {}
    assert {name: found.get(name) for name in old} == old
    more = [name for name in found if name not in old]
    assert all(
        name.split("/")[0] in ("checkpoints", "progress", "progress-new") for name in more
    ), more
    for name in more:
        if name.endswith("manifest.json"):
            manifest = json.loads((out / name).read_text())
            state = found[name.replace("manifest.json", "state.safetensors")]
            assert manifest["sha256"] == state
    names = {name.split("/")[1] for name in more if name.startswith("checkpoints/")}
    return max(names, default="")


TERM, INT, HUP = signal.SIGTERM, signal.SIGINT, signal.SIGHUP
STOPS = [
    pytest.param("warpir.optimize.model:load_prior", 1, (TERM,), "", id="R2-load"),
    pytest.param("warpir.optimize.model:load_prior", 1, (INT,), "", id="R2-load-int"),
    pytest.param(UPDATE, 3, (TERM,), "000002-personalize-3", id="R2-lora"),
    pytest.param(STEP, 3, (INT,), "000004-optimize-3", id="R2-iteration-int"),
    pytest.param(STEP, 3, (HUP,), "000004-optimize-3", id="R2-iteration-hup"),
    # The step is lost that both came in, and nothing that was saved.
    pytest.param(STEP, 4, (INT, TERM), "000003-optimize-2", id="R2-iteration-twice"),
    pytest.param(SAVE, 4, (TERM, TERM), "000004-optimize-4", id="R2-checkpoint-twice"),
    pytest.param(WRITE, 1, (TERM,), "000005-optimize-6", id="R2-write"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("place", "turn", "numbers", "kept"), STOPS)
def test_stopped_run_keeps_what_it_had(
    guided_inputs: Path,
    finished: Path,
    tmp_path: Path,
    place: str,
    turn: int,
    numbers: tuple[int, ...],
    kept: str,
) -> None:
    """A checkpoint at the border of the step, the old results as they were, no lock."""
    old = old_results(finished, tmp_path / "out") if kept else {}
    before = hook(place, turn, f"send{(*map(int, numbers),)}")
    ended = guided(guided_inputs, tmp_path, "--overwrite", before=before)
    assert ended.status == 128 + numbers[0], ended.err
    assert "Traceback" not in ended.err and "error:" not in ended.err
    last = ended.err.splitlines()[-1]
    assert last.startswith(f"stopped by {signal.Signals(numbers[0]).name}; ")
    assert (f"{kept}; the same command with --resume" if kept else "no checkpoint") in last
    assert what_is_kept(tmp_path / "out", old) == kept
    assert not ended.left and not ended.children


@pytest.mark.slow
@pytest.mark.case("R2")
def test_results_that_are_being_put_in_place_are_finished(
    guided_inputs: Path, finished: Path, tmp_path: Path
) -> None:
    old_results(finished, tmp_path / "out")
    before = hook(COMMIT, 1, f"send({int(TERM)}, {int(TERM)})")
    ended = guided(guided_inputs, tmp_path, "--overwrite", before=before)
    assert ended.status == 143
    assert ended.err.splitlines()[-1] == "stopped by SIGTERM; the results in out are complete"
    assert results_of(tmp_path / "out") == results_of(finished)


@pytest.mark.parametrize("number", [INT, TERM, HUP], ids=["R2-read-int", "R2-read", "R2-read-hup"])
def test_run_stops_while_it_reads(guided_inputs: Path, tmp_path: Path, number: int) -> None:
    """At once, without a file; and a folder with results is as it was."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "run.json").write_text("{}")
    before = hook("warpir.app.inputs:read_inputs", 1, f"send({int(number)})")
    was = snapshot(tmp_path)
    ended = run_case([*guided_argv(guided_inputs), "--overwrite"], tmp_path, before=before)
    assert (ended.status, snapshot(tmp_path)) == (128 + number, was)
    assert ended.err.startswith(f"stopped by {signal.Signals(number).name}; ")
    assert ended.seconds < 5.0


@pytest.mark.slow
@pytest.mark.case("R2")
def test_stopped_sequence_says_how_many_frames_are_kept(
    guided_inputs: Path, tmp_path: Path
) -> None:
    """The second frame stops; the same command then makes the rest only."""
    cheap = {"samples": "1", "depth": "1", "device": "cpu", "no_hand_off": ""}
    first = arguments(guided_inputs, "first", **cheap)
    assert run_case(first, tmp_path, warm=True).status == ExitCode.DONE
    lines = "".join(json.dumps({"place": [x, 0, -5]}) + "\n" for x in (0.0, 0.2))
    (tmp_path / "frames.jsonl").write_text(lines)
    changes = {"light": None, "reuse": "first", "sequence": "frames.jsonl"}
    argv = arguments(guided_inputs, "out", **{**cheap, **changes})
    ended = run_case(argv, tmp_path, before=hook(WRITE, 2, f"send({int(TERM)})"), warm=True)
    assert ended.status == 143
    expected = "stopped by SIGTERM; kept: 1 of 2 frames; the same command goes on with the rest"
    assert ended.err.splitlines()[-1] == expected
    ended = run_case(argv, tmp_path, before=hook(COMMIT, 1, f"send({int(signal.SIGKILL)})"))
    assert ended.status == -signal.SIGKILL
    ended = run_case(argv, tmp_path, warm=True)
    assert ended.status == ExitCode.DONE, ended.err
    # The frame that was killed while its files were put in place is made again.
    assert ended.out.count("done already") == 1


COMPILED = """
import sys
import warp as wp
from warpir.app.program import run_program

@wp.kernel
def doubled(x: wp.array(dtype=float)):
    x[wp.tid()] = 2.0 * x[wp.tid()]

def run(arguments):
    wp.config.quiet = True
    x = wp.array([1.5, -2.0], dtype=float, device="cpu")
    wp.launch(doubled, 2, inputs=[x], device="cpu")
    print(x.numpy().tolist())
    return 0

def main():
    return run_program(run, [])
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "wait"),
    [
        pytest.param("warp._src.build:build_cpu", 0.05, id="R14-compile"),
        pytest.param("warp._src.build:safe_rename", 0.0, id="R14-rename"),
    ],
)
def test_interrupted_compilation_leaves_a_sound_cache(
    tmp_path: Path, place: str, wait: float
) -> None:
    """Ctrl-C while a kernel is compiled: 130, and the next run computes what it should."""
    (tmp_path / "compiled.py").write_text(COMPILED)
    path = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    # From another process, in the middle of the compiler's work.
    act = f"lambda: os.fork() or (time.sleep({wait}), os.kill(os.getppid(), 2), os._exit(0))"
    env = {"WARP_CACHE_PATH": str(tmp_path / "cache")}
    before = path + "import time\n" + hook(place, 1, act if wait else f"send({int(INT)})")
    ended = run_case([], tmp_path, program="compiled", env=env, before=before)
    assert ended.status == 130, ended.err
    assert ended.err.splitlines()[-1] == "stopped by SIGINT"
    ended = run_case([], tmp_path, program="compiled", env=env, before=path)
    assert ended.status == 0, ended.err
    assert ended.out.splitlines()[-1] == "[3.0, -4.0]"


# ------------------------------------------------------------------- disks and folders that fail


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[str], Path]]:
    """A function that mounts a file system of its own; it needs root."""
    mounted = []

    def mount(size: str) -> Path:
        folder = tmp_path / "disk"
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", str(folder)]
        if subprocess.run(command, capture_output=True, check=False).returncode:
            pytest.skip("file systems cannot be mounted here")
        mounted.append(folder)
        return folder

    yield mount
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "limit", [pytest.param(n, id=f"R4-{n}") for n in (1_000, 10_000, 100_000, 500_000)]
)
def test_full_disk_keeps_old_results_and_checkpoints(
    guided_inputs: Path, finished: Path, tmp_path: Path, limit: int
) -> None:
    """Wherever the disk is full first: preview, checkpoint, LoRA, EXR."""
    old = old_results(finished, tmp_path / "out")
    ended = guided(guided_inputs, tmp_path, "--overwrite", file_size=limit)
    assert ended.status == ExitCode.RESOURCES, ended.err
    errors = [line for line in ended.err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1 and errors[0].startswith("error: out/")
    assert "cannot be written (File too large)" in errors[0] and "Traceback" not in ended.err
    kept = what_is_kept(tmp_path / "out", old)
    assert bool(kept) == (limit >= 500_000)
    if kept:
        assert f"{kept}; the same command with --resume" in ended.out
        ended = guided(guided_inputs, tmp_path, "--resume")
        assert ended.status == ExitCode.DONE, ended.err
        assert results_of(tmp_path / "out") == results_of(finished)


@pytest.mark.slow
@pytest.mark.case("R4", "R5")
def test_full_file_system(
    guided_inputs: Path, finished: Path, tmp_path: Path, small_disk: Callable[[str], Path]
) -> None:
    """A real one, another than that of temporary files, which others fill meanwhile.

    On one core the files are written one by one, so it is always the same that has no room.
    """
    disk = small_disk("64m")
    fill = "open('filler', 'wb').write(bytes(shutil.disk_usage('.').free - 1_420_000))"
    one_core = "os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})"
    fill = f"lambda: ({fill}, {one_core})"
    ended = guided(guided_inputs, disk, before="import shutil\n" + hook(WRITE, 1, fill))
    assert ended.status == ExitCode.RESOURCES, ended.err
    assert ended.err.startswith("error: out/envmap.hdr: written incompletely")
    (disk / "filler").unlink()
    assert what_is_kept(disk / "out", {}) == "000005-optimize-6"
    ended = guided(guided_inputs, disk, "--resume")
    assert ended.status == ExitCode.DONE, ended.err
    assert results_of(disk / "out") == results_of(finished)


GONE = [
    pytest.param(STEP, 3, "lambda: shutil.rmtree('out')", id="R6-deleted-iteration"),
    pytest.param(WRITE, 1, "lambda: shutil.rmtree('out')", id="R6-deleted-write"),
    pytest.param(
        STEP, 3, "lambda: (shutil.rmtree('out'), open('out', 'w').close())", id="R6-file-in-place"
    ),
]


@pytest.mark.slow
@pytest.mark.parametrize(("place", "turn", "act"), GONE)
def test_output_folder_that_vanishes(
    guided_inputs: Path, tmp_path: Path, place: str, turn: int, act: str
) -> None:
    """The run ends with one line, and does not make the folder anew."""
    before = "import shutil\n" + hook(place, turn, act)
    ended = guided(guided_inputs, tmp_path, before=before)
    assert ended.status == ExitCode.RESOURCES, ended.err
    assert ended.err.startswith("error: out/") and "Traceback" not in ended.err
    assert not (tmp_path / "out").is_dir()


@pytest.mark.slow
@pytest.mark.case("R6")
def test_output_folder_that_becomes_read_only(
    guided_inputs: Path, finished: Path, tmp_path: Path, small_disk: Callable[[str], Path]
) -> None:
    old = old_results(finished, tmp_path / "out")
    # What is open for writing cannot become read-only, so that another disk comes on top.
    command = ["mount", "-t", "tmpfs", "-o", "ro", "none", "out"]
    small_disk("4k")  # skips where nothing can be mounted
    act = f"lambda: subprocess.run({command!r}, check=True)"
    try:
        before = "import subprocess\n" + hook(STEP, 3, act)
        ended = guided(guided_inputs, tmp_path, "--overwrite", before=before)
    finally:
        subprocess.run(["umount", str(tmp_path / "out")], check=True)
    assert ended.status == ExitCode.RESOURCES, ended.err
    assert ended.err.startswith("error: out/") and "Read-only file system" in ended.err
    found = snapshot(tmp_path / "out")
    assert {name: found[name] for name in old} == old
    assert "checkpoints/000003-optimize-2/manifest.json" in found


# --------------------------------------------------------------- what is resumed is the same run


@pytest.fixture(scope="module")
def stopped(guided_inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Inputs, and ``run/out`` with two checkpoints of a run that was stopped."""
    folder = tmp_path_factory.mktemp("stopped")
    shutil.copytree(guided_inputs, folder / "inputs")
    (folder / "run").mkdir()
    ended = guided(folder / "inputs", folder / "run", before=hook(STEP, 3, f"send({int(TERM)})"))
    assert ended.status == 143, ended.err
    return folder


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.slow
@pytest.mark.case("L9")
def test_resume_refuses_a_changed_file_with_both_sha256(stopped: Path, tmp_path: Path) -> None:
    file, run = stopped / "inputs" / "box.glb", tmp_path / "run"
    shutil.copytree(stopped / "run", run)
    content, before = file.read_bytes(), sha256(file)
    # The path stays that of the run that was stopped: it is part of what it was.
    trimesh.creation.box(extents=(1.0, 1.0, 1.1)).export(file)
    words = (f'inputs.asset: was "{before}", is "{sha256(file)}"', "000004-optimize-3")
    try:
        argv = [*guided_argv(stopped / "inputs"), "--resume"]
        assert_fails(argv, ExitCode.INPUT, *words, cwd=run, warm=True)
    finally:
        file.write_bytes(content)


@pytest.mark.slow
@pytest.mark.case("R3")
def test_resume_goes_back_to_the_checkpoint_before(stopped: Path, tmp_path: Path) -> None:
    """With a notice, and to the same end; where all are like that it is refused."""
    folder = tmp_path / "run"
    shutil.copytree(stopped / "run", folder)
    argv = [*guided_argv(stopped / "inputs"), "--resume"]
    earlier, newest = sorted((folder / "out" / "checkpoints").iterdir())
    cut(newest)
    before = hook(STEP, 1, f"send({int(TERM)}, {int(TERM)})")
    ended = guided(stopped / "inputs", folder, "--resume", before=before)
    assert ended.status == 143
    assert "notice: checkpoint passed over: 000004-optimize-3 cannot be used" in ended.out
    assert "resumed: optimize, step 2" in ended.out
    for checkpoint in (folder / "out" / "checkpoints").iterdir():
        cut(checkpoint)
    words = "out/checkpoints", "cannot be used"
    assert_fails(argv, ExitCode.INPUT, *words, cwd=folder, warm=True)
    assert earlier.name < newest.name


def cut(checkpoint: Path) -> None:
    state = checkpoint / "state.safetensors"
    state.write_bytes(state.read_bytes()[:-100])
