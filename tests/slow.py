"""Runs slow tests while there is time: those of numbered cases, then others in turn."""

import hashlib
import time

import pytest

from tests.cases import cases_of

NO_TIME = "no time is left for it"


class SlowTests:
    """Part of a run of pytest that leaves out slow tests for which there is no time.

    Those of numbered cases always run, since docs/robustness.md tells of all. Files come in an
    order that differs from run to run, so that it is not the same tests that are left out.

    Args:
        until: When the last of the others may start [s since 1970].
    """

    def __init__(self, until: float) -> None:
        self.until = until

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Put files with cases first, and in each file the tests of cases."""
        with_cases = {str(item.path) for item in items if cases_of(item)}

        def turn(item: pytest.Item) -> tuple[bool, str, bool]:
            path = str(item.path)
            digest = hashlib.sha256(f"{self.until} {path}".encode()).hexdigest()
            return path not in with_cases, digest, not cases_of(item)

        items.sort(key=turn)

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Leave the test out if it is too late."""
        is_slow = item.get_closest_marker("slow") is not None
        if is_slow and time.time() > self.until and not cases_of(item):
            pytest.skip(NO_TIME)
