"""The process that estimates and renders for the page, seen from the server.

It is started with the first job. A job is cancelled by a signal; where that is not answered, the
process is ended, and the next job starts another.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from typing import Any

from warpir.core.errors import ExitCode, InputError

PATIENCE = 1.0
"""How long a job that was cancelled may go on [s]: a kernel that is compiled cannot be left."""


class Worker:
    """Gives jobs to `warpir.place.work`, one at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[str] | None = None
        self._is_asked = threading.Lock()
        self._is_closed = False
        self._job = 0
        self._kind = ""

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
            process = None if self._is_closed else self._running()
            if process is None or self._is_closed:  # or while the process was being started
                self.stop()
                raise InputError("the page", "stopped before it was done", "", ExitCode.RESOURCES)
            self._job += 1
            self._kind = job["kind"]
            assert process.stdin is not None and process.stdout is not None
            try:
                process.stdin.write(json.dumps(job) + "\n")
                process.stdin.flush()
            except OSError:
                pass  # it has ended: nothing comes back either
            for line in process.stdout:
                said = json.loads(line)
                if "answer" in said or "error" in said:
                    self._job += 1
                if "answer" in said:
                    answer: dict[str, Any] = said["answer"]
                    return answer
                if "error" in said:
                    raise InputError(*said["error"])
                heard(said)
        raise InputError("the page", "stopped before it was done", "", ExitCode.RESOURCES)

    def interrupt(self) -> None:
        """Let the process give up its picture, and end it where it does not do so soon.

        A light is estimated to its end: the page shows it whatever becomes of a picture.
        """
        process = self._process
        if process is None or self._kind == "light":
            return
        process.send_signal(signal.SIGUSR1)

        def insist(job: int) -> None:
            if self._job == job and self._process is process:
                self.stop()

        later = threading.Timer(PATIENCE, insist, (self._job,))
        later.daemon = True
        later.start()

    @property
    def is_running(self) -> bool:
        """Whether there is a process, with all that it has loaded."""
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End the process, and with it the job that it works on."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()

    def close(self) -> None:
        """End the process; jobs that wait are refused."""
        self._is_closed = True
        self.stop()

    def _running(self) -> subprocess.Popen[str]:
        if not self.is_running:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "warpir.place.work"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
                encoding="utf-8",
                # Beside other work, threads of a library wait for each other longer than they
                # save. Those that matter, Warp's and the networks', are started by us.
                env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **os.environ},
            )
        assert self._process is not None
        return self._process
