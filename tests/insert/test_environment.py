"""What surrounds a run: devices, standard streams, locale, missing packages, the network."""

import importlib.metadata
import os
import subprocess
import sys
import tomllib
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
import warp as wp

from tests.builders.faults import assert_fails, refusing, run_case
from tests.builders.insertions import arguments
from tests.builders.outcome import outcome
from warpir.app.program import BROUGHT, EXTRA_OF
from warpir.core.cache import take_notices
from warpir.core.errors import ExitCode, InputError
from warpir.render.determinism import fixed_arithmetic
from warpir.render.device import choose_device

ROOT = Path(__file__).resolve().parents[2]


# R8: devices


@pytest.mark.parametrize(
    ("device", "env", "words"),
    [
        pytest.param("cuda:7", None, "no device cuda:7", id="R8-device-7"),
        pytest.param("cuda:64", None, "no device cuda:64", id="R8-device-64"),
        # A machine without a driver, as which this variable makes any.
        pytest.param("cuda", {"CUDA_VISIBLE_DEVICES": ""}, "found cpu", id="R8-no-driver"),
    ],
)
def test_device_that_is_not_there(
    inputs: Path, device: str, env: dict[str, str] | None, words: str
) -> None:
    argv = arguments(inputs, "out", device=device)
    for wanted in (argv, [*argv, "--validate"]):
        lines = assert_fails(wanted, 2, "--device", words, cwd=inputs, env=env)
        assert "--device cpu" in lines[1]


@pytest.mark.parametrize("name", [None, "cuda", "cuda:0"])
def test_card_is_too_old_for_warp(monkeypatch: pytest.MonkeyPatch, name: str | None) -> None:
    """Warp lists a card of before Turing, and refuses it when the first kernel is compiled."""
    card = SimpleNamespace(alias="cuda:0", name="GeForce GTX 1080", is_cuda=True, arch=61)
    monkeypatch.setattr(wp, "get_devices", lambda: [card])
    monkeypatch.setattr(wp, "get_device", lambda alias: card)
    monkeypatch.setattr(wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(wp, "get_cuda_supported_archs", lambda: [75, 80, 90])
    with pytest.raises(InputError, match=r"GTX 1080.*found sm_61; expected sm_75") as found:
        choose_device(name)
    assert found.value.code == ExitCode.USAGE and found.value.advice == "use --device cpu"


def test_driver_is_too_old_for_warp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Then Warp lists no card; who names none is told why the CPU is used."""
    cpu = wp.get_device("cpu")
    monkeypatch.setattr(wp, "get_devices", lambda: [cpu])
    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: (12, 4))
    monkeypatch.setattr(wp, "get_cuda_toolkit_version", lambda: (13, 4))
    why = "the driver is for CUDA 12.4, Warp needs 13.0 or newer"
    take_notices()
    assert choose_device("cpu") == "cpu" and take_notices() == ()
    assert choose_device(None) == "cpu" and take_notices() == (f"no GPU is used: {why}",)
    with pytest.raises(InputError, match=why):
        choose_device("cuda")
    monkeypatch.setattr(wp, "get_cuda_driver_version", lambda: None)
    assert choose_device(None) == "cpu" and take_notices() == ()


@pytest.mark.case("R8")
def test_driver_is_too_old_for_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Warp has found a GPU that torch cannot use."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    threads = torch.get_num_threads()
    with pytest.raises(InputError, match="driver") as found, fixed_arithmetic("cuda:0", False):
        raise AssertionError("not reached")
    assert found.value.code == ExitCode.USAGE and "--device cpu" in found.value.advice
    assert torch.get_num_threads() == threads


def test_fork_of_a_process_that_has_rendered_is_refused() -> None:
    """It waited for ever for threads of OpenEXR that it had not inherited."""
    if (pid := os.fork()) == 0:
        status = 1
        with suppress(BaseException):
            with pytest.raises(InputError, match="forked"):
                choose_device("cpu")
            status = 0
        os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert choose_device("cpu") == "cpu"


BUSY = """
import warpir.render.device
def busy(name):
    raise RuntimeError("Failed to allocate 1073741824 bytes on device 'cuda:0'")
warpir.render.device.choose_device = busy
"""


@pytest.mark.case("R8")
def test_gpu_memory_is_taken(inputs: Path) -> None:
    lines = assert_fails(arguments(inputs, "out"), 5, "memory", cwd=inputs, before=BUSY)
    assert "--device cpu" in lines[1]


# R11: standard streams and locale

CLOSED = {"stdin": "os.close(0)", "stdout": "os.close(1)", "stderr": "os.close(2)"}
FULL = "os.dup2(os.open('/dev/full', os.O_WRONLY), {})"


@pytest.mark.parametrize(
    "before",
    [
        *(pytest.param(code, id=f"R11-{name}-closed") for name, code in CLOSED.items()),
        pytest.param("; ".join(CLOSED.values()), id="R11-all-closed"),
        pytest.param(FULL.format(1), id="R11-stdout-full"),
        pytest.param(FULL.format(2), id="R11-stderr-full"),
    ],
)
def test_standard_streams(inputs: Path, before: str) -> None:
    """Status and files are the same; nothing that is printed goes into a file of ours."""
    before = f"import os; {before}"
    for argv, status in (
        (["--help"], 0),
        (["--no-such-flag"], 2),
        (arguments(inputs, "out", validate=""), 0),
        (arguments(inputs, "out", photo="absent.png"), 3),
    ):
        ended = run_case(argv, inputs, before=before)
        assert ended.status == status and "Traceback" not in ended.out + ended.err
    assert not (inputs / "out").exists()


@pytest.mark.slow
@pytest.mark.case("R11")
def test_run_without_any_stream_writes_its_files(inputs: Path, tmp_path: Path) -> None:
    """Not a line of a log is in them: the streams' numbers are not given to files."""
    closed = f"import os; {'; '.join(CLOSED.values())}"
    argv = arguments(inputs, "out")
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    assert run_case(argv, tmp_path / "a", before=closed).status == 0
    assert run_case(argv, tmp_path / "b").status == 0
    assert outcome(tmp_path / "a/out") == outcome(tmp_path / "b/out")


@pytest.mark.parametrize(
    "argv",
    [
        pytest.param(["--help"], id="R11-head-help"),
        pytest.param(["--validate"], id="R11-head-validate"),
    ],
)
def test_reader_goes_away(inputs: Path, argv: list[str]) -> None:
    """``| head -1``: the pipe breaks after the first line, or before it."""
    if argv == ["--validate"]:
        argv = arguments(inputs, "out", validate="")
    for count in (0, 1):
        child = subprocess.Popen(
            [sys.executable, "-m", "warpir.insert", *argv],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            cwd=inputs,
        )
        assert child.stdout is not None and child.stderr is not None
        for _ in range(count):
            assert child.stdout.readline()
        child.stdout.close()
        err = child.stderr.read().decode()
        assert child.wait(60) == 0 and err == ""


@pytest.mark.parametrize(
    "env",
    [
        pytest.param({"LANG": "C", "LC_ALL": "C", "PYTHONUTF8": "0"}, id="R11-locale-C"),
        pytest.param({"PYTHONIOENCODING": "ascii"}, id="R11-ascii"),
        pytest.param({"TERM": "dumb"}, id="R11-dumb-terminal"),
        pytest.param({"TERM": None, "COLUMNS": "0"}, id="R11-no-terminal"),
    ],
)
def test_locale_and_terminal(inputs: Path, env: dict[str, str | None]) -> None:
    """Names outside ASCII are printed in escapes, never a traceback; in a Python of its own."""
    own = {k: v for k, v in {**os.environ, **env}.items() if v is not None and env.get(k, v)}
    for name, status in (("schnée.png", 3), ("photo.png", 0)):
        argv = arguments(inputs, "out", photo=name, validate="")
        ended = subprocess.run(
            [sys.executable, "-m", "warpir.insert", *argv],
            env=own,
            cwd=inputs,
            capture_output=True,
            check=False,
        )
        assert ended.returncode == status, ended.stderr
        assert b"Traceback" not in ended.stderr
        assert ended.stderr.count(b"error:") == (status != 0)


# R15: packages that are missing

HIDDEN = """
import sys
for name in [n for n in sys.modules if n.split(".")[0] == {name!r}]:
    del sys.modules[name]
class Hide:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == {name!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Hide())
"""


@pytest.mark.parametrize(
    ("name", "changes", "advice"),
    [
        pytest.param("torch", {"light": None}, "--upgrade warpir", id="R15-torch"),
        pytest.param("warp", {}, "--upgrade warpir", id="R15-warp"),
        pytest.param(
            "diffusers",
            {"light": None, "model": "model", "prompt": "a box"},
            "'warpir[guidance]'",
            id="R15-diffusers",
        ),
    ],
)
def test_missing_package(
    inputs: Path, name: str, changes: dict[str, str | None], advice: str
) -> None:
    argv, before = arguments(inputs, "out", **changes), HIDDEN.format(name=name)
    lines = assert_fails(argv, 2, f"{name}: not installed", cwd=inputs, before=before)
    assert lines[1] == f"pip install {advice} brings it"


@pytest.mark.slow
def test_run_without_a_model_does_not_import_torch(inputs: Path) -> None:
    """Camera and light are estimated and the picture is written without it: seconds, 200 MB."""
    argv = arguments(inputs, "out", light=None, camera=None, horizon=None, fov=None)
    ended = run_case(argv, inputs, before=refusing("torch"))
    assert ended.status == 0, ended.err
    assert "torch is imported" not in ended.err + ended.out
    for needed in ("estimated", "regressor"):
        assert needed in ended.out


@pytest.mark.case("R15")
def test_advice_about_packages_is_true() -> None:
    """What an error says is brought by an install is in pyproject.toml, there and nowhere else."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    distributions = importlib.metadata.packages_distributions()

    def names(requirements: list[str]) -> set[str]:
        return {line.split(">")[0].split("[")[0].lower() for line in requirements}

    for name in BROUGHT:
        of = {d.lower() for d in distributions.get(name, [name])}
        assert of & names(project["dependencies"]), name
    for name, extra in EXTRA_OF.items():
        of = {d.lower() for d in distributions.get(name, [name])}
        assert of & names(project["optional-dependencies"][extra]), name
        assert not of & names(project["dependencies"])


# The network


@pytest.mark.slow
def test_run_in_a_namespace_without_network(tmp_path: Path) -> None:
    """The demo, in a process to which not even the loopback device is left."""
    unshare = ["unshare", "-rn"]
    if subprocess.run([*unshare, "true"], capture_output=True, check=False).returncode:
        pytest.skip("namespaces cannot be made here")
    few = ["--demo", "--samples", "1", "--width", "48", "--out", str(tmp_path / "out")]
    ended = subprocess.run(
        [*unshare, sys.executable, "-m", "warpir.insert", *few],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (0, "")
    assert (tmp_path / "out" / "run.json").exists()


@pytest.mark.case("L6")
@pytest.mark.parametrize("allow", [False, True])
def test_libraries_are_told_before_they_are_loaded(inputs: Path, allow: bool) -> None:
    """Offline unless --allow-download; no telemetry in any case."""
    told = """
import atexit, os, sys
def tell():
    names = ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE", "HF_HUB_DISABLE_TELEMETRY", "DO_NOT_TRACK")
    print("told", *(os.environ.get(name, "-") for name in names))
atexit.register(tell)
import warpir.insert
def stop(config):
    assert "huggingface_hub" not in sys.modules
    raise KeyboardInterrupt
warpir.insert.insert = stop
"""
    clean = dict.fromkeys(("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"))
    flags = {"allow_download": ""} if allow else {}
    ended = run_case(arguments(inputs, "out", **flags), inputs, before=told, env=clean)
    assert ended.status == 130
    assert ended.out.splitlines()[-1] == ("told - - 1 1" if allow else "told 1 1 1 1")
