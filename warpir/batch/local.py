"""Worker processes on this machine: each does one scene after another; the dead are replaced."""

import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from subprocess import PIPE

from warpir.batch.task import Answer, Task
from warpir.core.errors import ExitCode

GRACE_SECONDS = 60.0
"""What a stopped scene gets for its checkpoint: a step of a large model on the CPU, and its file.
"""


class LocalWorkers:
    """A pool of processes.

    Args:
        environments: Of each process, what differs from this one's.
    """

    def __init__(self, environments: Sequence[Mapping[str, str]]) -> None:
        self._selector = selectors.DefaultSelector()
        self._idle = [_Worker(environment) for environment in environments]
        self._idle.reverse()  # the first one works first

    @property
    def free(self) -> int:
        """How many tasks could be started now."""
        return len(self._idle)

    def start(self, key: int, task: Task) -> None:
        """Give a task to a free worker.

        Args:
            key: What `wait` says of it.
            task: The task.
        """
        worker = self._idle.pop()
        # Registered first: a signal may come between the two.
        self._selector.register(worker.begin(), selectors.EVENT_READ, (key, worker))
        worker.send(task)

    def wait(self) -> tuple[int, Answer]:
        """Return the key and the answer of a task that has ended; its worker is free again."""
        ready, _ = self._selector.select()[0]
        key, worker = ready.data
        answer = worker.receive()
        self._selector.unregister(ready.fileobj)
        # What it holds is unknown, such as a CUDA context that one fault has spoilt.
        if answer.died or answer.is_short or answer.status == ExitCode.BUG:
            worker.end()
        self._idle.append(worker)
        return key, answer

    def stop(self) -> list[tuple[int, Answer]]:
        """End all processes: those that work, as a signal ends a run; one that hangs is killed.

        Returns:
            What was under way, by its key, and how it ended.
        """
        busy = [registered.data for registered in self._selector.get_map().values()]
        workers = [*self._idle, *(worker for _, worker in busy)]
        try:
            for worker in workers:
                worker.close_input()
            deadline = time.monotonic() + GRACE_SECONDS
            for worker in workers:
                worker.wait(deadline)
            for worker in workers:  # before an answer is waited for: one that hangs gives none
                worker.kill()
            return [(key, worker.receive()) for key, worker in busy]
        finally:
            for worker in workers:
                worker.end()
            for descriptor in [*self._selector.get_map()]:
                self._selector.unregister(descriptor)
            self._idle.clear()


class _Worker:
    """A process that is started when there is something to do."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self) -> int:
        """Start the process if there is none; return the descriptor that its answers come from."""
        if self._process is None:
            self._process = subprocess.Popen(
                # -P: what lies in the working directory is no module of ours.
                [sys.executable, "-P", "-m", "warpir.batch.worker"],
                stdin=PIPE,
                stdout=PIPE,
                env={**os.environ, **self._environment},
                # Ctrl-C is for the batch, which ends its workers itself.
                process_group=0,
            )
        assert self._process.stdout is not None
        return self._process.stdout.fileno()

    def send(self, task: Task) -> None:
        assert self._process is not None and self._process.stdin is not None
        with suppress(BrokenPipeError):  # it has died: `receive` tells
            self._process.stdin.write(task.line())
            self._process.stdin.flush()

    def receive(self) -> Answer:
        """Read the answer, or how the process ended without one."""
        assert self._process is not None and self._process.stdout is not None
        line = self._process.stdout.readline()
        if line.endswith(b"\n"):
            return Answer.of_line(line)
        return answer_of_the_dead(self._process.wait())

    def close_input(self) -> None:
        if self._process is not None and self._process.stdin is not None:
            with suppress(BrokenPipeError):
                self._process.stdin.close()

    def wait(self, deadline: float) -> None:
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(max(0.0, deadline - time.monotonic()))

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def end(self) -> None:
        """Kill the process if it still runs, and forget it."""
        if self._process is not None:
            self.kill()
            self._process.wait()
            self.close_input()
            assert self._process.stdout is not None
            self._process.stdout.close()
            self._process = None


def answer_of_the_dead(status: int) -> Answer:
    """Make the answer of a process that has ended without one.

    Args:
        status: Its exit status, or minus the number of the signal that killed it.
    """
    if status < 0:
        with suppress(ValueError):
            name = signal.Signals(-status).name
            code = ExitCode.RESOURCES if name == "SIGKILL" else ExitCode.BUG
            why = " (what the system does when memory runs out)" if name == "SIGKILL" else ""
            return Answer(code, (f"error: worker: killed by {name}{why}",), died=name)
    how = f"exit status {status}"
    return Answer(ExitCode.BUG, (f"error: worker: ended without an answer ({how})",), died=how)
