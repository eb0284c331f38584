"""What a waiting person sees: what was assumed, notices, stages, steps, the time that is left."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any, Self

LINE_SECONDS = 10.0
"""Least time between two lines where there is no terminal [s]."""

_asked: ContextVar[Callable[[], object]] = ContextVar("_asked", default=lambda: None)


@contextmanager
def asking(ask: Callable[[], object]) -> Iterator[None]:
    """Call ``ask`` with each report of progress that this thread makes within the block.

    What it raises ends the run: so a program that warpir runs in, and that has a button for it,
    stops an insertion.
    """
    before = _asked.set(ask)
    try:
        yield
    finally:
        _asked.reset(before)


@dataclass
class Log:
    """Lines for a person, by kind; each is printed when it is added, and kept for ``run.json``."""

    say: Callable[[str], None] = lambda _: None
    """Prints a line."""
    assumed: list[str] = field(default_factory=list)
    """What was chosen because nothing was given."""
    notices: list[str] = field(default_factory=list)
    """What was repaired, converted, left out or looks odd."""

    def assume(self, *lines: str) -> None:
        """Add what was assumed."""
        for line in lines:
            self.assumed.append(line)
            self.say(f"assumed: {line}")

    def notice(self, *lines: str) -> None:
        """Add notices."""
        for line in lines:
            self.notices.append(line)
            self.say(f"notice: {line}")


@contextmanager
def progress_bar(say: Callable[[str], None]) -> Iterator[Callable[[str, float], None]]:
    """Show the stages of a render: bars on a terminal, now and then a line where there is none.

    Yields:
        A function to be called with a stage's name and the share of it that is done.
    """
    if not sys.stderr.isatty():
        last_line = time.monotonic()

        def report_line(stage: str, share: float) -> None:
            nonlocal last_line
            _asked.get()()
            if stage and time.monotonic() - last_line >= LINE_SECONDS:
                last_line = time.monotonic()
                say(f"{stage}: {100.0 * share:.0f} of 100 %")

        yield report_line
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        tasks: dict[str, Any] = {}

        def report(stage: str, share: float) -> None:
            _asked.get()()
            if stage:
                if stage not in tasks:
                    tasks[stage] = progress.add_task(stage, total=1.0)
                progress.update(tasks[stage], completed=share)

        yield report


class StepProgress:
    """Steps of long stages: bars on a terminal, now and then a line where there is none."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self.say = say
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._started: dict[str, tuple[float, int]] = {}
        self._last_line = -LINE_SECONDS

    def __enter__(self) -> Self:
        """Open the bars where there is a terminal."""
        if sys.stderr.isatty():
            from rich import progress
            from rich.console import Console

            self._bars = progress.Progress(
                progress.TextColumn("{task.description}"),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
                progress.TimeRemainingColumn(),
                progress.TextColumn("{task.fields[words]}"),
                console=Console(stderr=True),
            )
            self._bars.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Close the bars."""
        if self._bars is not None:
            self._bars.stop()

    def report(self, stage: str, done: int, total: int, words: str = "") -> None:
        """Show how far a stage is."""
        _asked.get()()
        if self._bars is not None:
            if stage not in self._tasks:
                self._tasks[stage] = self._bars.add_task(stage, total=total, words=words)
            self._bars.update(self._tasks[stage], completed=done, total=total, words=words)
            return
        now = time.monotonic()
        # A resumed stage does not start at 0.
        started, first = self._started.setdefault(stage, (now, done))
        is_end = done >= total
        if now - self._last_line < LINE_SECONDS and not is_end:
            return
        self._last_line = now
        left = ""
        if first < done < total:
            left = f", {duration((now - started) / (done - first) * (total - done))} left"
        self.say(f"{stage}: {done} of {total}{left}{'; ' if words else ''}{words}")


def duration(seconds: float) -> str:
    """Return a time as a person says it."""
    if seconds < 100.0:
        return f"about {seconds:.0f} s"
    return f"about {seconds / 60.0:.0f} min"
