"""A line of a batch's manifest on its way: what became of it, and why."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warpir.app.program import say
from warpir.batch.manifest import Row
from warpir.batch.task import DONE_BEFORE
from warpir.core.errors import ExitCode

LOGS = "logs"
"""Folder of the scenes' logs, beside the summary."""
STATES = ("done", DONE_BEFORE, "failed", "not run")
"""Of a scene; "done before" is by an earlier batch."""


@dataclass
class Scene:
    """A line of the manifest, and what became of it."""

    row: Row
    out: Path
    """Folder of the batch."""
    state: str = "not run"
    """One of `STATES`."""
    status: int = 0
    """Exit status of one that failed, an `ExitCode`."""
    lines: tuple[str, ...] = ()
    """Why it failed."""
    seconds: float = 0.0
    retries: list[str] = field(default_factory=list)
    """Why it was tried again, once for each time."""
    needs: dict[str, Any] = field(default_factory=dict)
    """The result of `warpir.batch.task.CHECK`."""
    has_log: bool = False

    @property
    def title(self) -> str:
        """Its name; of a line that has none, its number."""
        return self.row.name or f"line {self.row.line}"

    @property
    def is_open(self) -> bool:
        """Whether it is still to be done."""
        return self.state == "not run"

    def fail(self, status: int, lines: Sequence[str]) -> None:
        """Note why it cannot be done, and print it."""
        # A signal that came to this scene alone is none of the batch's.
        self.status = status if status < 128 else ExitCode.RESOURCES
        self.state, self.lines = "failed", tuple(lines)
        name = self.row.name
        say(f"line {self.row.line}{f', {name}' if name else ''}: failed "
            f"({self.status}): {self.reason}")  # fmt: skip
        files = ("run.json", "sequence.json")
        # Not Path.exists, which raises where the folder is another user's.
        if name and any(os.path.exists(self.out / name / file) for file in files):
            self.lines += (f"{self.out / name} holds the result of an earlier run",)
            say(f"notice: {self.lines[-1]}")

    @property
    def reason(self) -> str:
        """Why it failed, in one line."""
        return self.lines[0].removeprefix("error: ") if self.lines else "no reason given"

    def record(self) -> dict[str, Any]:
        """Return its entry in the summary."""
        record: dict[str, Any] = {
            "line": self.row.line,
            "name": self.row.name,
            "state": self.state,
            "seconds": round(self.seconds, 3),
            "retries": self.retries,
        }
        if self.state == "failed":
            record |= {"exit_code": int(self.status), "error": self.reason}
        return record

    def failure(self) -> dict[str, Any]:
        """Return its line in the list of failures."""
        return {
            "line": self.row.line,
            "name": self.row.name,
            "exit_code": int(self.status),
            "error": self.reason,
            "more": list(self.lines[1:]),
            "attempts": 1 + len(self.retries),
            "log": f"{LOGS}/{self.row.name}.log" if self.has_log else None,
        }
