"""Slow tests are left out when it is late, but for those of numbered cases."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.slow import NO_TIME

CONTENT = """
import pytest
def test_quick(): pass
@pytest.mark.slow
def test_slow(): pass
@pytest.mark.slow
@pytest.mark.case("R1")
def test_of_a_case(): pass
@pytest.mark.slow
@pytest.mark.parametrize("x", [pytest.param(0, id="I4-x")])
def test_of_another(x): pass
"""


@pytest.mark.parametrize("is_late", [False, True])
def test_slow_tests_run_while_there_is_time(tmp_path: Path, is_late: bool) -> None:
    """Quick tests and numbered cases always do; cases come first."""
    for name in ("test_a.py", "test_b.py"):
        content = CONTENT if name == "test_b.py" else CONTENT.partition("@pytest.mark.case")[0]
        (tmp_path / name).write_text(content.removesuffix("@pytest.mark.slow\n"))
    until = time.time() + (-1.0 if is_late else 600.0)
    root = Path(__file__).parents[1]
    ended = subprocess.run(
        [
            *(sys.executable, "-m", "pytest", "-v", "-rs", "-c", str(root / "pyproject.toml")),
            *("-p", "tests.conftest", "-p", "no:cacheprovider", f"--slow-until={until}"),
            str(tmp_path),
        ],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    lines = [line for line in ended.stdout.splitlines() if "::test_" in line]
    names = [line.split("::")[1].split(" ")[0] for line in lines]
    first = ["test_of_a_case", "test_of_another[I4-x]", "test_quick", "test_slow"]
    assert names == [*first, "test_quick", "test_slow"]
    outcomes = ["PASSED"] * 3 + (["SKIPPED"] if is_late else ["PASSED"])
    assert [line.split()[1] for line in lines] == [*outcomes, "PASSED", outcomes[-1]]
    assert (NO_TIME in ended.stdout) == is_late
