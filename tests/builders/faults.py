"""Bad inputs and faults, each met by a process of its own: what every refusal must look like.

A refused run takes milliseconds, a new Python a quarter of a second and more. So each case is a
child that is forked from a small server: this very file, run as a program. The server has imported
what a run imports before it loads torch or Warp, and nothing else.
"""

import atexit
import hashlib
import importlib
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, ClassVar, NoReturn

from warpir.core.cache import kernel_store

SECONDS = 10.0
"""What a refusal may take."""
PEAK_BYTES = 500e6
"""What a refusal may use, the size of its input not counted."""
LONGEST = 300.0
"""Seconds after which a child is killed; a run that works may need its time."""
HASHED_BYTES = 64 * 2**20
"""Larger files are compared by size and time of change: they are sparse, and nobody copies them."""
KERNELS = str(kernel_store().parent)
"""Where compiled kernels are kept: a child with another home finds them."""


def refusing(*packages: str) -> str:
    """Return a hook for `run_case`: packages that are there, and must not be imported."""
    return f"""
import sys
from importlib.machinery import ModuleSpec
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name in {packages!r}:
            return ModuleSpec(name, self)  # installed, and whether it is may be asked
    def create_module(self, spec):
        raise AssertionError(spec.name + " is imported")
    def exec_module(self, module):
        pass
sys.meta_path.insert(0, Refuse())
"""


NO_TORCH = refusing("torch", "warp", "diffusers", "transformers", "peft")
COSTS: list[float] = [0.0, 0.0]
"""Most seconds and bytes that a refused run of this session took."""


@dataclass(frozen=True)
class Ended:
    """A run that is over."""

    status: int
    """Exit status; minus the signal's number when one killed it."""
    out: str
    err: str
    seconds: float
    peak_bytes: int
    """Largest resident memory, of which 90 MB are Python and its libraries."""
    left: tuple[str, ...]
    """What it left behind in the folder of temporary files and in the home folder."""
    children: int
    """Processes that it left running."""


def run_case(
    argv: Sequence[str],
    cwd: Path,
    *,
    program: str = "warpir.insert",
    env: Mapping[str, str | None] | None = None,
    address_space: int | None = None,
    file_size: int | None = None,
    before: str = "",
    warm: bool = False,
) -> Ended:
    """Run ``python -m program argv`` in a child in which sockets raise.

    Args:
        argv: Arguments.
        cwd: Working directory.
        program: Module with a ``main``.
        env: Changes of the environment; None removes a variable.
        address_space: Limit of virtual memory [byte].
        file_size: Largest file that can be written [byte]; beyond it writes fail as on a full disk.
        before: Python that the child executes first: hooks and injected faults.
        warm: Whether torch, Warp and the model's libraries are loaded before the fork, and torch
            has one thread. For runs that work; memory and what is imported are not its own then.
    """
    with tempfile.TemporaryDirectory(prefix="warpir-case-") as beside:
        request = {
            "argv": [str(a) for a in argv],
            "cwd": str(cwd),
            "program": program,
            "env": {"WARP_CACHE_PATH": KERNELS, "HOME": beside, "TMPDIR": beside, **(env or {})},
            "address_space": address_space,
            "file_size": file_size,
            "before": before,
        }
        answer = _Server.ask(request, warm)
        left = tuple(sorted(str(p.relative_to(beside)) for p in Path(beside).rglob("*")))
        return Ended(**answer, left=left)


def assert_fails(argv: Sequence[str], code: int, *words: str, cwd: Path, **same: Any) -> list[str]:
    """Check all that is promised of a refused run; see `run_case`.

    Its exit status must be the code, its ``error:`` line must hold the words, and no file below the
    working directory may change, appear or vanish.

    Returns:
        The lines on standard error, the ``error:`` line first.
    """
    before = snapshot(cwd)
    ended = run_case(argv, cwd, **same)
    lines = ended.err.splitlines()
    errors = [line for line in lines if line.startswith("error:")]
    assert ended.status == code, ended
    assert len(errors) == 1 and lines[0] == errors[0], ended.err
    for word in words:
        assert word in errors[0], (word, ended.err)
    assert "Traceback" not in ended.out + ended.err
    assert snapshot(cwd) == before
    assert not ended.left, "temporary files are left"
    assert not ended.children, "processes are left"
    assert ended.seconds < SECONDS
    if not same.get("warm"):  # whose memory is that of its libraries
        COSTS[:] = max(COSTS[0], ended.seconds), max(COSTS[1], ended.peak_bytes)
        assert ended.peak_bytes < PEAK_BYTES
    return lines


def snapshot(folder: Path) -> dict[str, str]:
    """Return what is below a folder: names, and of files the sha256."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_symlink():
            found[name] = f"link to {os.readlink(path)}"
        elif not path.is_file():
            found[name] = "folder" if path.is_dir() else "special"
        elif path.stat().st_size > HASHED_BYTES:
            found[name] = f"{path.stat().st_size} {path.stat().st_mtime_ns}"
        else:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
    return found


class _Server:
    """The processes that cases are forked from; started when the first one asks."""

    processes: ClassVar[dict[bool, subprocess.Popen[str]]] = {}

    @classmethod
    def ask(cls, request: dict[str, Any], warm: bool) -> dict[str, Any]:
        if warm not in cls.processes:
            cls.processes[warm] = subprocess.Popen(
                # -P: the modules beside this file have names of the standard library.
                [sys.executable, "-P", __file__, *(["warm"] if warm else [])],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                cwd=Path(__file__).parents[2],
            )
            atexit.register(cls.stop, warm)
        process = cls.processes[warm]
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write(json.dumps(request) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        assert answer, "the server of cases is gone"
        return dict(json.loads(answer))

    @classmethod
    def stop(cls, warm: bool) -> None:
        process = cls.processes.pop(warm)
        process.kill()
        process.wait()


# What follows runs in the server and in its children.

PRELOADED = ("numpy", "OpenImageIO", "yaml", "PIL.Image", "warpir.insert", "warpir.app.inputs")
NOT_PRELOADED = ("torch", "warp")
PRELOADED_WARM = (
    *(
        "warpir.optimize.recover",
        "warpir.optimize.materials",
        "warpir.optimize.find_light",
        "warpir.report.result",
        "warpir.lighting.detail",
        "warpir.io.export",
        "warpir.mitsuba.scene",
    ),
    *("diffusers", "peft", "transformers"),
)


def _serve(requests: IO[str], answers: IO[str], warm: bool) -> None:
    for name in PRELOADED:
        importlib.import_module(name)
    assert not set(NOT_PRELOADED) & set(sys.modules), "torch and Warp must not be forked"
    if warm:
        for name in PRELOADED_WARM:
            importlib.import_module(name)
        importlib.import_module("torch").set_num_threads(1)  # threads do not survive a fork
    for line in requests:
        request = json.loads(line)
        with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
            start = time.perf_counter()
            pid = os.fork()
            if pid == 0:
                requests.close()
                _child(request, out.fileno(), err.fileno())
            status, usage = _wait(pid, start + LONGEST)
            answer = {
                "status": status,
                "seconds": time.perf_counter() - start,
                "peak_bytes": usage.ru_maxrss * 1024,
                "children": _end_session(pid),
            }
            for name, stream in (("out", out), ("err", err)):
                stream.seek(0)
                answer[name] = stream.read().decode("utf-8", "replace")
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


def _child(request: dict[str, Any], out: int, err: int) -> NoReturn:
    os.setsid()
    os.chdir(request["cwd"])
    for name, value in request["env"].items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value
    tempfile.tempdir = None  # the server has looked TMPDIR up before
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(out, 1)
    os.dup2(err, 2)
    _refuse_sockets()
    for kind, name in ((resource.RLIMIT_AS, "address_space"), (resource.RLIMIT_FSIZE, "file_size")):
        if request[name] is not None:
            resource.setrlimit(kind, (request[name], request[name]))
    exec(request["before"], {"__name__": "before"})
    module = importlib.import_module(request["program"])
    sys.argv = [str(module.__file__), *request["argv"]]
    sys.exit(module.main())


def _refuse_sockets() -> None:
    class Refused(socket.socket):
        def __init__(self, *args: object, **kwargs: object) -> None:
            raise RuntimeError("a run must not use the network")

    socket.socket = Refused  # type: ignore[misc]


def _wait(pid: int, deadline: float) -> tuple[int, resource.struct_rusage]:
    """Wait for a child, and kill it when it takes too long."""
    pause = 0.001
    while True:
        found, status, usage = os.wait4(pid, os.WNOHANG)
        if found:
            return os.waitstatus_to_exitcode(status), usage
        if time.perf_counter() > deadline:
            os.killpg(pid, signal.SIGKILL)
        time.sleep(pause)
        pause = min(1.5 * pause, 0.05)


def _end_session(session: int) -> int:
    """Kill what a child has left running and return how many processes it was."""
    count = 0
    for entry in Path("/proc").iterdir():
        try:
            fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
        except (OSError, IndexError):
            continue
        if entry.name.isdigit() and int(fields[3]) == session and fields[0] != "Z":
            os.kill(int(entry.name), signal.SIGKILL)
            count += 1
    return count


if __name__ == "__main__":
    _serve(sys.stdin, sys.stdout, warm="warm" in sys.argv)
