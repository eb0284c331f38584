"""One run of warpir in a process of its own environment; Blender is not needed here."""

import os
import re
import subprocess
import threading
from pathlib import Path

STEPS = re.compile(r": (\d+) of (\d+)\b")  # in warpir's lines about long stages
STREAMS = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
TEXT = {"encoding": "utf-8", "errors": "replace"}


class Failure(Exception):
    """What stops an operator, as one message for its user."""


class Job:
    """A process of the environment's Python and the lines it has printed."""

    def __init__(self, python: str, arguments: list[str], folder: Path) -> None:
        if not Path(python).is_file():
            named = f"No Python at {python}: name" if python else "Name"
            raise Failure(f"{named} the Python that has warpir in the add-on's preferences")
        # Blender's own PYTHONPATH would lend its modules to another Python.
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        environment["PYTHONUNBUFFERED"] = "1"
        self.python, self.is_cancelled, self.lines = python, False, [""]
        command = [python, *arguments]
        self._process = subprocess.Popen(command, cwd=folder, env=environment, **STREAMS, **TEXT)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        self.lines.extend(line.rstrip() for line in self._process.stdout)

    def has_ended(self, seconds: float = 0.0) -> bool:
        """Wait this long; return whether the process has ended and all of its lines are here."""
        self._reader.join(seconds)
        return not self._reader.is_alive() and self._process.wait() is not None

    def cancel(self) -> None:
        """End the process; warpir then leaves no half results behind."""
        self.is_cancelled = True
        self._process.terminate()

    @property
    def share(self) -> float:
        """The share of the present stage that is done, in [0, 1]; 0 where it tells none."""
        steps = STEPS.search(self.lines[-1])
        return int(steps[1]) / max(int(steps[2]), 1) if steps else 0.0

    def check(self) -> None:
        """Raise what a process that has ended failed of, a `Failure`."""
        if self.is_cancelled:
            raise Failure("Cancelled")
        if self._process.returncode == 0:
            return
        if any("No module named " in line for line in self.lines[-3:]):
            raise Failure(f"{self.python} has no warpir: install it there, or name another Python")
        errors = [k for k, line in enumerate(self.lines) if line.startswith("error: ")]
        told = self.lines[errors[0] : errors[0] + 2] if errors else self.lines[-1:]
        status = f"warpir ended with status {self._process.returncode}"
        raise Failure("; ".join(told).removeprefix("error: ") or status)
