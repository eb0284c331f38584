"""R9: caches that are read-only, damaged, full, shared or nowhere harm no run."""

import errno
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.builders.faults import run_case
from tests.builders.guided_runs import guided_flags, write_guided_inputs
from tests.builders.outcome import outcome
from warpir.app.program import explain
from warpir.core import cache as caches
from warpir.core.cache import KernelCache, cache_folder, take_notices
from warpir.core.errors import ExitCode, InputError

VERSION = "1.2"


@pytest.fixture(autouse=True)
def _own_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Temporary caches go where the test can see them, and no notice is left to other tests."""
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setattr(caches, "_replaced", {})
    for name in ("WARPIR_CACHE", "WARP_CACHE_PATH", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    (tmp_path / "home").mkdir()
    take_notices()
    yield
    take_notices()


# Made things


def test_cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The variables, in their order; what they name is made."""
    assert cache_folder() == tmp_path / "home/.cache/warpir"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder("class-images") == tmp_path / "xdg/warpir/class-images"
    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "own"))
    assert cache_folder("lora") == tmp_path / "own/lora"
    assert cache_folder() == tmp_path / "own" and cache_folder().is_dir()
    assert take_notices() == ()


def refuse_to_write(monkeypatch: pytest.MonkeyPatch, below: Path, number: int) -> None:
    """Let every file that is to be made below a folder fail with an error of the system."""
    inner, inner_file = os.open, tempfile.TemporaryFile

    def opened(path: object, flags: int, *rest: object, **more: object) -> int:
        if str(path).startswith(str(below)) and flags & os.O_CREAT:
            raise OSError(number, os.strerror(number), str(path))
        return inner(path, flags, *rest, **more)  # type: ignore[arg-type]

    def temporary(*args: object, **more: object) -> object:
        if str(more.get("dir", "")).startswith(str(below)):
            raise OSError(number, os.strerror(number), str(below))
        return inner_file(*args, **more)  # type: ignore[call-overload]

    def written(self: Path, content: bytes) -> int:
        if str(self).startswith(str(below)):
            raise OSError(number, os.strerror(number), str(self))
        with self.open("wb") as file:
            return file.write(content)

    monkeypatch.setattr(os, "open", opened)
    monkeypatch.setattr(tempfile, "TemporaryFile", temporary)
    monkeypatch.setattr(Path, "write_bytes", written)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param("read-only", id="R9-made-things-read-only"),
        pytest.param("full", id="R9-made-things-full"),
        pytest.param("file", id="R9-made-things-are-a-file"),
        pytest.param("kind", id="R9-made-things-a-file-for-a-kind"),
        pytest.param("no-home", id="R9-home-is-not-there"),
        pytest.param("nobody", id="R9-home-unset-and-unknown"),
    ],
)
def test_unusable_cache_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """By one temporary folder for the whole process, with one notice; no home is made."""
    root = tmp_path / "own"
    if case in ("no-home", "nobody"):
        root = tmp_path / "absent"
        monkeypatch.setenv("HOME", str(root))
        if case == "nobody":

            def unknown() -> Path:
                raise RuntimeError("Could not determine home directory.")

            monkeypatch.setattr(Path, "home", unknown)
    else:
        monkeypatch.setenv("WARPIR_CACHE", str(root))
        root.mkdir()
        if case == "file":
            root.rmdir()
            root.write_text("in the way")
        elif case == "kind":
            (root / "transport").write_text("in the way")
        else:
            refuse_to_write(monkeypatch, root, errno.EROFS if case == "read-only" else errno.ENOSPC)
    found = cache_folder("lora")
    assert found.parent.parent == tmp_path / "tmp"
    assert cache_folder("transport").parent == found.parent
    (told,) = take_notices()
    assert "kept for this run only" in told and "WARPIR_CACHE" in told
    if case in ("no-home", "nobody"):
        assert not root.exists()


@pytest.mark.parametrize("make", [cache_folder, lambda: KernelCache(VERSION)])
def test_no_temporary_folder_is_a_full_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[], object]
) -> None:
    """All of them are full: the run ends with 5, and the line that says so needs none."""

    def full(*_: object, **__: object) -> str:
        raise FileNotFoundError(errno.ENOENT, "No usable temporary directory found in ['/tmp']")

    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "own"))
    (tmp_path / "own").write_text("in the way")
    for name in ("mkdtemp", "gettempdir"):
        monkeypatch.setattr(tempfile, name, full)
    with pytest.raises(InputError, match="No usable temporary directory") as caught:
        make()
    assert caught.value.code == ExitCode.RESOURCES and "disk space" in caught.value.advice
    status, lines = explain(OSError(errno.ENOSPC, "No space left on device"))
    assert status == ExitCode.RESOURCES and "No space left" in lines[0]


# Compiled kernels


def files_in(folder: Path) -> list[Path]:
    """What a cache of kernels holds."""
    return [file for file in folder.rglob("*.*") if file.is_file()]


def compile_into(cache: KernelCache, name: str = "wp_a_1", content: bytes = b"code") -> Path:
    """Do as Warp does when it compiles a module."""
    folder = cache.folder / VERSION / name
    folder.mkdir(parents=True, exist_ok=True)
    for suffix in (".cpu12.o", ".meta", ".cpp"):
        (folder / f"{name}{suffix}").write_bytes(content + suffix.encode())
    return folder


def seen_by(cache: KernelCache) -> dict[str, bytes]:
    """What Warp finds in its folder."""
    files = files_in(cache.folder / VERSION)
    return {f"{f.parent.name}/{f.name}": f.read_bytes() for f in files}


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache in which one process has kept a module."""
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    cache = KernelCache(VERSION)
    compile_into(cache)
    cache.keep()
    return tmp_path / "kernels" / "warpir" / VERSION


def test_next_process_finds_what_one_has_compiled(store: Path) -> None:
    """Binary and description, by their sha256; nothing is kept twice."""
    names = sorted(file.name for file in files_in(store))
    digests = [hashlib.sha256(b"code" + s).hexdigest() for s in (b".cpu12.o", b".meta")]
    assert names == [f"wp_a_1.cpu12.o.{digests[0]}", f"wp_a_1.meta.{digests[1]}"]
    again = KernelCache(VERSION)
    found = {"wp_a_1/wp_a_1.cpu12.o": b"code.cpu12.o", "wp_a_1/wp_a_1.meta": b"code.meta"}
    assert seen_by(again) == found
    compile_into(again, "wp_b_2")
    again.keep()
    again.keep()
    assert len(files_in(store)) == 4
    assert seen_by(KernelCache("1.3")) == {}
    assert take_notices() == ()


def test_cache_of_kernels_keeps_within_its_size(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was used longest ago goes first."""
    for file in store.rglob("*.*"):
        os.utime(file, (0, 0))
    monkeypatch.setattr(caches, "KERNEL_BYTES", 24)
    cache = KernelCache("1.2")
    for file in files_in(store):
        os.utime(file, (0, 0))
    compile_into(cache, "wp_b_2")
    cache.keep()
    assert {file.parent.name for file in files_in(store)} == {"wp_b_2"}


@pytest.mark.parametrize(
    "junk",
    [
        pytest.param(b"", id="R9-kernels-empty"),
        pytest.param(b"code", id="R9-kernels-truncated"),
        pytest.param(b"Code.cpu12.o", id="R9-kernels-one-bit"),
        pytest.param(bytes(1000), id="R9-kernels-junk"),
    ],
)
def test_damaged_kernels_are_not_seen(store: Path, junk: bytes) -> None:
    """They go, with a notice, and are compiled and kept again."""
    (binary,) = store.rglob("*.o.*")
    binary.write_bytes(junk)
    cache = KernelCache(VERSION)
    assert list(seen_by(cache)) == ["wp_a_1/wp_a_1.meta"]
    (told,) = take_notices()
    assert str(store) in told and "1 damaged" in told
    compile_into(cache)
    cache.keep()
    assert len(seen_by(KernelCache(VERSION))) == 2
    assert take_notices() == ()


def test_strange_files_are_left_alone_or_removed(store: Path) -> None:
    """What is no kept file has no right digest; a folder or a file being written is not touched."""
    (store / "notes.txt").write_text("a file among the folders")
    (store / "wp_a_1" / "folder").mkdir()
    (store / "wp_a_1" / ".wp_a_1.o.12.345").write_bytes(b"half")
    (store / "wp_a_1" / "wp_a_1.o").write_bytes(b"of no digest")
    assert len(seen_by(KernelCache(VERSION))) == 2
    assert (store / "notes.txt").exists() and (store / "wp_a_1" / ".wp_a_1.o.12.345").exists()
    assert not (store / "wp_a_1" / "wp_a_1.o").exists()


@pytest.mark.parametrize(
    "case",
    [
        pytest.param("read-only", id="R9-kernels-read-only"),
        pytest.param("full", id="R9-kernels-full"),
        pytest.param("file", id="R9-kernels-are-a-file"),
        pytest.param("no-home", id="R9-kernels-home-is-not-there"),
        pytest.param("gone", id="R9-kernels-folder-vanishes"),
    ],
)
def test_unusable_cache_of_kernels(
    tmp_path: Path, store: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    """The run has a folder of its own in any case; where one may read, what is kept is used."""
    if case == "file":
        monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels" / "warpir" / "f"))
        (tmp_path / "kernels" / "warpir" / "f").write_text("in the way")
    elif case == "no-home":
        monkeypatch.delenv("WARP_CACHE_PATH")
        monkeypatch.setenv("HOME", str(tmp_path / "absent"))
    elif case in ("read-only", "full"):
        refuse_to_write(monkeypatch, store, errno.EROFS if case == "read-only" else errno.ENOSPC)
    cache = KernelCache(VERSION)
    assert len(seen_by(cache)) == (0 if case in ("file", "no-home") else 2)
    if case == "gone":
        for path in sorted(store.parent.rglob("*"), reverse=True):
            path.rmdir() if path.is_dir() else path.unlink()
        store.parent.rmdir()
        store.parent.write_text("in the way")
        assert take_notices() == ()
    else:
        (told,) = take_notices()
        assert "compiled for this run only" in told
    cache_file = compile_into(cache, "wp_b_2") / "wp_b_2.cpu12.o"
    cache.keep()
    assert cache_file.read_bytes() == b"code.cpu12.o"
    assert not (tmp_path / "absent").exists()
    assert not list((tmp_path / "kernels").rglob(".*"))


# Warp itself

KERNEL = """
import numpy as np
import warp as wp
from warpir.core.cache import take_notices
from warpir.render.device import start_warp

start_warp()

@wp.kernel(enable_backward=False)
def double(values: wp.array[float]):
    i = wp.tid()
    values[i] = 2.0 * values[i]

values = wp.array(np.arange(4.0), dtype=float, device="cpu")
wp.launch(double, dim=4, inputs=[values], device="cpu")
print(values.numpy().tolist(), *take_notices())
"""
DOUBLED = "[0.0, 2.0, 4.0, 6.0]"


def start(folder: Path) -> subprocess.Popen[str]:
    """Start a process that compiles a small kernel, or finds it."""
    script = folder / "kernel.py"
    if not script.exists():  # a process started before may be about to read it
        script.write_text(KERNEL)
    own = {"WARP_CACHE_PATH": str(folder / "kernels"), "TMPDIR": str(folder / "tmp")}
    return subprocess.Popen(
        [sys.executable, str(script)],
        cwd=folder,
        env={**os.environ, **own},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def said(process: subprocess.Popen[str]) -> str:
    """Return what a process printed; it ended well."""
    out, err = process.communicate(timeout=200)
    assert (process.returncode, err) == (0, "")
    return out.strip()


@pytest.mark.slow
@pytest.mark.case("R9")
def test_eight_cold_processes_share_a_cache(tmp_path: Path) -> None:
    """All compile at once, all are right, and what they leave is whole: the next two read it."""
    cold = [start(tmp_path) for _ in range(8)]
    assert [said(process) for process in cold] == [DOUBLED] * 8
    kept = files_in(tmp_path / "kernels")
    assert any(".o." in file.name for file in kept)
    for file in kept:
        if not file.parent.name.startswith("warpir") and file.suffix:
            assert hashlib.sha256(file.read_bytes()).hexdigest() == file.suffix[1:]
    assert said(start(tmp_path)) == DOUBLED
    assert set(files_in(tmp_path / "kernels")) == set(kept)
    assert not list((tmp_path / "tmp").iterdir()), "temporary caches are left"


@pytest.mark.slow
@pytest.mark.case("R9")
def test_warp_loads_no_damaged_module(tmp_path: Path) -> None:
    """Junk of which Warp 1.19 would end the process is compiled again, with a notice."""
    assert said(start(tmp_path)) == DOUBLED
    for file in (tmp_path / "kernels").rglob("*.o.*"):
        file.write_bytes(file.read_bytes()[:200])
    out = said(start(tmp_path))
    assert out.startswith(DOUBLED) and "1 damaged" in out


@pytest.mark.slow
@pytest.mark.case("R9")
def test_warp_without_a_cache(tmp_path: Path) -> None:
    """A file in its place: compiled for this process only, which leaves nothing behind."""
    (tmp_path / "kernels").write_text("in the way")
    out = said(start(tmp_path))
    assert out.startswith(DOUBLED) and "compiled for this run only" in out
    assert (tmp_path / "kernels").read_text() == "in the way"
    assert not list((tmp_path / "tmp").iterdir())


# A whole run


@pytest.mark.slow
@pytest.mark.case("R9")
def test_guided_run_without_a_cache(tmp_path: Path) -> None:
    """The same result, the notice in run.json, nothing left behind."""
    write_guided_inputs(tmp_path)
    (tmp_path / "file").write_text("in the way")
    argv = guided_flags(tmp_path, "out", steps="4", checkpoint_every="2")
    results = []
    for name, cache in (("a", None), ("b", str(tmp_path / "file"))):
        (tmp_path / name).mkdir()
        ended = run_case(argv, tmp_path / name, env={"WARPIR_CACHE": cache})
        assert ended.status == 0 and ended.err == ""
        results.append(outcome(tmp_path / name / "out"))
        del results[-1]["run.json"], results[-1]["report.html"]  # the notice stands in both
    assert results[0] == results[1]
    assert ended.left == ()
    told = json.loads((tmp_path / "b/out/run.json").read_text())["notices"]
    (line,) = [line for line in told if "for this run only" in line]
    assert f"notice: {line}" in ended.out
