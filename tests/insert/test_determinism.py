"""The same bytes for the same seed: threads, kinds of processors, the clock, a GPU on request."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
import warp as wp

from tests.builders.faults import Ended, run_case
from tests.builders.insertions import arguments, read_layers, record_of
from tests.builders.outcome import outcome
from tests.optimize.test_recover import CHEAP as GUIDED
from tests.sequence.test_sequence import FAST
from warpir.kernels import composite, light_gradient, shade
from warpir.render.determinism import (
    LARGE_PARAMETERS,
    LARGE_THREADS,
    THREADS,
    _order_kernels,
    fixed_arithmetic,
    use_threads_for,
)

MANY = {"OMP_NUM_THREADS": "8", "MKL_NUM_THREADS": "8", "OPENBLAS_NUM_THREADS": "8"}
ONE = dict.fromkeys(MANY, "1")
LOWER = {
    "ATEN_CPU_CAPABILITY": "avx2",
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512CD AVX512_SKX AVX512_CLX AVX512_CNL AVX512_ICL",
}
"""A processor without AVX-512, as far as torch and NumPy are concerned."""
TINY = {
    "regressed": {"light": None},
    "stable-diffusion": {**GUIDED, "steps": "4", "lora_steps": "4"},
    "refine": {
        **GUIDED,
        "steps": "4",
        "lora_steps": "4",
        "start": None,
        "refine": "material",
        "sun": "30,40",
    },
}
"""A cheap run of each kind."""


def argv(folder: Path, kind: str, **changes: str | None) -> list[str]:
    """A run of a kind into ``out`` of the working directory."""
    flags: dict[str, str | None] = dict(TINY[kind])
    if flags.get("guidance") == "stable-diffusion":
        flags["model"] = str(folder / "model")
    return arguments(folder, "out", **{**flags, **changes})


def run(
    argv: list[str], cwd: Path, env: Mapping[str, str | None] | None = None, before: str = ""
) -> dict[str, str]:
    """Run in a process of its own, with caches of its own; return the sha256 of what it wrote.

    Seconds and the number of threads are not the result: see `tests.builders.outcome`.
    """
    cwd.mkdir()
    ended: Ended = run_case(argv, cwd, env={"WARPIR_CACHE": None, **(env or {})}, before=before)
    assert ended.status == 0, ended.err
    assert ended.err == ""
    for path in (cwd / "out").rglob("sequence.json"):
        path.unlink()  # it holds the frames' run.json by their sha256, seconds included
    return outcome(cwd / "out")


# Threads


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param(k, id=f"R13-threads-{k}") for k in TINY])
def test_threads_change_no_byte(guided_inputs: Path, tmp_path: Path, kind: str) -> None:
    """Every file, whatever --threads and the environment say of threads."""
    few = run(argv(guided_inputs, kind, threads="1"), tmp_path / "few", ONE)
    many = run(argv(guided_inputs, kind, threads="8"), tmp_path / "many", MANY)
    assert len(few) > 15 and many == few


@pytest.mark.slow
@pytest.mark.case("R13")
def test_threads_change_no_byte_of_a_sequence(guided_inputs: Path, tmp_path: Path) -> None:
    """Both frames, lit by an earlier run."""
    lines = guided_inputs / "frames.jsonl"
    lines.write_text('{}\n{"place": [0.3, 0, -5]}\n')
    first = arguments(guided_inputs, guided_inputs / "first", **FAST)
    assert run_case(first, guided_inputs).status == 0
    flags = {**FAST, "light": None, "reuse": str(guided_inputs / "first"), "sequence": str(lines)}
    few = run(arguments(guided_inputs, "out", **flags, threads="1"), tmp_path / "few", ONE)
    many = run(arguments(guided_inputs, "out", **flags, threads="8"), tmp_path / "many", MANY)
    assert len(few) > 20 and many == few


@pytest.mark.case("R13")
def test_number_of_threads_is_that_of_the_network() -> None:
    """Of its size alone, never of the machine or the environment; what was before comes back."""
    before = torch.get_num_threads()
    with torch.device("meta"):
        small, large = torch.nn.Linear(8, 8), torch.nn.Linear(10**4, LARGE_PARAMETERS // 10**4)
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            with fixed_arithmetic("cpu", False):
                assert torch.get_num_threads() == THREADS
                assert torch.are_deterministic_algorithms_enabled()
                use_threads_for(large)
                assert torch.get_num_threads() == LARGE_THREADS
                use_threads_for(small)
                assert torch.get_num_threads() == THREADS
            assert torch.get_num_threads() == threads
            assert not torch.are_deterministic_algorithms_enabled()
    finally:
        torch.set_num_threads(before)


@pytest.mark.case("R13")
def test_arithmetic_comes_back_after_an_error() -> None:
    before = torch.get_num_threads()
    stream = torch.random.get_rng_state()
    with pytest.raises(KeyboardInterrupt), fixed_arithmetic("cpu", False):
        torch.rand(1)
        raise KeyboardInterrupt
    assert torch.get_num_threads() == before
    assert torch.equal(torch.random.get_rng_state(), stream)
    assert not torch.are_deterministic_algorithms_enabled()


# Kinds of processors


@pytest.mark.slow
@pytest.mark.case("R13")
def test_kinds_of_processors_agree(guided_inputs: Path, tmp_path: Path) -> None:
    """With AVX-512 and without, the light that is read off the photo gives the same image."""
    run(argv(guided_inputs, "regressed"), tmp_path / "all", ONE)
    run(argv(guided_inputs, "regressed"), tmp_path / "lower", {**ONE, **LOWER})
    ours, theirs = (
        read_layers(tmp_path / name / "out" / "layers.exr") for name in ("all", "lower")
    )
    assert ours.keys() == theirs.keys()
    for name, plane in ours.items():
        # The file's halves are 5e-4 apart: they are equal, or the light was another.
        np.testing.assert_allclose(theirs[name], plane, rtol=0.0, atol=1e-6, err_msg=name)
    lights = [
        json.loads((tmp_path / name / "out" / "lobes.json").read_text())["lobes"]
        for name in ("all", "lower")
    ]
    for one, other in zip(*lights, strict=True):
        np.testing.assert_allclose(one["amplitude"], other["amplitude"], rtol=1e-6)
        np.testing.assert_allclose(one["axis"], other["axis"], atol=1e-6)


# The clock

BACKWARDS = """
import time, itertools
ticks = itertools.count()
def jumping():
    # An hour back at every seventh look, a day forward at every other.
    k = next(ticks)
    return 1.7e9 + 86400.0 * k - (90000.0 * k if k % 7 == 0 else 0.0)
time.time = jumping
time.time_ns = lambda: int(1e9 * jumping())
time.localtime_of = time.localtime
time.localtime = lambda seconds=None: time.localtime_of(0 if seconds is None else seconds)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("env", "before"),
    [
        pytest.param({}, BACKWARDS, id="R12-clock-jumps"),
        pytest.param({"TZ": "Pacific/Kiritimati"}, "", id="R12-time-zone"),
    ],
)
def test_clock_changes_no_byte(
    guided_inputs: Path, tmp_path: Path, env: dict[str, str], before: str, plain: dict[str, str]
) -> None:
    """No file holds a date, and nothing waits for a clock that goes backwards."""
    before = f"{'import time; time.tzset()' if env else ''}\n{before}"
    assert run(argv(guided_inputs, "regressed"), tmp_path / "a", env, before) == plain


@pytest.fixture(scope="module")
def plain(guided_inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The result of a plain run, somewhere with a clock that goes as it should."""
    return run(argv(guided_inputs, "regressed"), tmp_path_factory.mktemp("plain") / "a")


# A GPU, on request


@pytest.mark.slow
@pytest.mark.case("R13")
def test_deterministic_is_accepted_on_the_cpu(
    guided_inputs: Path, tmp_path: Path, plain: dict[str, str]
) -> None:
    """It changes nothing there; run.json and the layers' header say that it was asked for."""
    found = run(argv(guided_inputs, "regressed", deterministic="", device="cpu"), tmp_path / "a")
    differing = {name for name in plain if found[name] != plain[name]}
    assert differing == {"layers.exr", "report.html", "run.json"}
    assert record_of(tmp_path / "a/out")["config"]["deterministic"] is True


@pytest.mark.slow
@pytest.mark.skipif(not wp.is_cuda_available(), reason="needs a GPU")
@pytest.mark.parametrize(
    ("kind", "changes"),
    [
        pytest.param("regressed", {}, id="R13-cuda-regressed"),
        pytest.param("stable-diffusion", {}, id="R13-cuda-stable-diffusion"),
        pytest.param("stable-diffusion", {"integrator": "mis"}, id="R13-cuda-mis"),
        pytest.param("refine", {}, id="R13-cuda-refine"),
    ],
)
def test_deterministic_repeats_its_bytes_on_a_gpu(
    guided_inputs: Path, tmp_path: Path, kind: str, changes: dict[str, str]
) -> None:
    """Two runs with --deterministic, each in a process of its own with empty caches."""
    flags = argv(guided_inputs, kind, deterministic="", device="cuda:0", **changes)
    first, second = (run(flags, tmp_path / name) for name in ("a", "b"))
    assert first == second
    record = record_of(tmp_path / "a/out")
    assert record["config"]["deterministic"] is True and record["device"].startswith("cuda")


ORDERED, ROOM = "deterministic", "deterministic_max_records"
"""Options of Warp's modules."""


@pytest.fixture(params=[composite, light_gradient, shade], ids=lambda module: module.__name__)
def module(request: pytest.FixtureRequest) -> ModuleType:
    """Kernels that add in common places; compiling them for CUDA needs no GPU."""
    if not wp._src.context.runtime.nvrtc_supported_archs:
        pytest.skip("Warp has no CUDA compiler here")
    return request.param


@pytest.mark.slow
@pytest.mark.case("R13")
def test_every_kernel_that_adds_in_common_places_can_be_ordered(
    module: ModuleType, tmp_path: Path
) -> None:
    """Warp refuses to order what also reads the sums, and says so when it compiles."""
    options = wp.get_module_options(module)
    before = {name: options[name] for name in (ORDERED, ROOM)}
    wp.set_module_options({ORDERED: wp.DeterministicMode.RUN_TO_RUN, ROOM: 16}, module)
    try:
        wp.compile_aot_module(module, arch=80, module_dir=tmp_path, use_ptx=True)
        assert list(tmp_path.glob("*.ptx"))
    finally:
        wp.set_module_options(before, module)


@pytest.mark.slow
def test_only_additions_in_loops_need_room_to_spare(module: ModuleType, tmp_path: Path) -> None:
    """Warp counts those outside of loops itself; more room than they need is some gigabytes."""
    _order_kernels(is_deterministic=True)
    try:
        wp.compile_aot_module(module, arch=80, module_dir=tmp_path, use_ptx=True)
        source = next(tmp_path.glob("*.cu")).read_text()
        loops = re.findall(r"start_for_(\d+):;(.*?)end_for_\1:;", source, re.DOTALL)
        has_loop = any("WP_DET_SCATTER" in body for _, body in loops)
        assert has_loop == (wp.get_module_options(module)[ROOM] > 0)
    finally:
        _order_kernels(is_deterministic=False)
