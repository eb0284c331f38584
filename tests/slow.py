"""Runs slow tests while there is time: those of numbered cases, then others in turn."""

import hashlib
import time
from typing import Any

import pytest

from tests.cases import cases_of

NO_TIME = "no time is left for it"


def slow(*values: object) -> list[Any]:
    """Return a parameter's values with which a test is slow, beside others: ``[1, *slow(2, 3)]``.

    For tests that take seconds with each value, and of which one tells nearly as much as all.
    """
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


class SlowTests:
    """Part of a run of pytest that leaves out slow tests for which there is no time.

    Those of numbered cases always run, and come first, since docs/robustness.md tells of all. The
    others come by files, in an order that differs from run to run, so that it is not the same tests
    that are left out. Processes that share them keep to it with ``--dist loadgroup
    --no-loadscope-reorder``.

    Args:
        until: When the last of the others may start [s since 1970].
    """

    def __init__(self, until: float) -> None:
        self.until = until

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Group the tests by file and by whether they are of cases, and order the groups."""

        def turn(item: pytest.Item) -> tuple[bool, str]:
            digest = hashlib.sha256(f"{self.until} {item.path}".encode()).hexdigest()
            return not cases_of(item), digest

        items.sort(key=turn)
        for item in items:
            kind = "cases" if cases_of(item) else "others"
            group = f"{item.nodeid.partition('::')[0]} {kind}"
            item.add_marker(pytest.mark.xdist_group(group))

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        """Leave the test out if it is too late."""
        is_slow = item.get_closest_marker("slow") is not None
        if is_slow and time.time() > self.until and not cases_of(item):
            pytest.skip(NO_TIME)
