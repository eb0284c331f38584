"""The process that estimates and renders for the page, seen from the server.

It is started with the first job; to cancel a job is to end it, and the next job starts another.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

from warpir.core.errors import ExitCode, InputError


class Worker:
    """Gives jobs to `warpir.place.work`, one at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._is_asked = threading.Lock()

    def ask(
        self, job: Mapping[str, Any], heard: Callable[[dict[str, Any]], None] = lambda _: None
    ) -> dict[str, Any]:
        """Return the answer to a job; waits for those that were given before.

        Args:
            job: Plain values; ``kind`` is a key of `warpir.place.work.JOBS`.
            heard: Called with each line of progress, in this thread.

        Raises:
            InputError: The job cannot be done, or was cancelled (`ExitCode.RESOURCES`).
        """
        with self._is_asked:
            process = self._running()
            assert process.stdin is not None and process.stdout is not None
            try:
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()
            except OSError:
                pass  # it has ended: nothing comes back either
            for line in process.stdout:
                said = json.loads(line)
                if "answer" in said:
                    answer: dict[str, Any] = said["answer"]
                    return answer
                if "error" in said:
                    raise InputError(*said["error"])
                heard(said)
        raise InputError("the page", "stopped before it was done", "", ExitCode.RESOURCES)

    def stop(self) -> None:
        """End the process, and with it the job that it works on."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def _running(self) -> subprocess.Popen[str]:
        if self._process is None or self._process.poll() is not None:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "warpir.place.work"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                # Its networks are small: beside other work, threads of torch wait for each other
                # longer than they save. Warp's are its own.
                env={"OMP_NUM_THREADS": "1", **os.environ},
            )
        return self._process
