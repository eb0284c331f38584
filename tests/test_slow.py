"""Slow tests are left out when it is late, but for those of numbered cases."""

import time
from pathlib import Path

import pytest

from tests.slow import NO_TIME, SlowTests

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
PROJECT = Path(__file__).parents[1] / "pyproject.toml"


class Ended:
    """What became of each test, in their order; of one that was left out the reason."""

    def __init__(self) -> None:
        self.tests: list[tuple[str, str]] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Note a test that was skipped or called."""
        if report.skipped or report.when == "call":
            reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.outcome
            self.tests.append((report.location[2], reason.removeprefix("Skipped: ")))


@pytest.mark.parametrize("is_late", [False, True])
def test_slow_tests_run_while_there_is_time(tmp_path: Path, is_late: bool) -> None:
    """Quick tests and numbered cases always do; cases come first."""
    for name in ("test_a.py", "test_b.py"):
        content = CONTENT if name == "test_b.py" else CONTENT.partition("@pytest.mark.case")[0]
        (tmp_path / name).write_text(content.removesuffix("@pytest.mark.slow\n"))
    until = time.time() + (-1.0 if is_late else 600.0)
    ended = Ended()
    argv = ["-q", "-c", str(PROJECT), "-p", "no:cacheprovider", str(tmp_path)]
    assert pytest.main(argv, plugins=[SlowTests(until), ended]) == pytest.ExitCode.OK
    slow = NO_TIME if is_late else "passed"
    others = [("test_quick", "passed"), ("test_slow", slow)]
    cases = [("test_of_a_case", "passed"), ("test_of_another[I4-x]", "passed")]
    assert ended.tests == [*cases, *others, *others]
