"""Worker processes on this machine: each does one scene after another; the dead are replaced."""

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.process import BaseProcess

from warpir.app.program import silence_warnings
from warpir.batch.task import Answer, Task, do_task
from warpir.core.errors import ExitCode

GRACE_SECONDS = 60.0
"""What a stopped scene gets for its checkpoint: a step of a large model on the CPU, and its file.
"""


class LocalWorkers:
    """Processes that load Warp and the kernels once, and torch where a model guides.

    Args:
        environments: Of each process, what differs from this one's.
    """

    def __init__(self, environments: Sequence[Mapping[str, str]]) -> None:
        self._idle = [_Worker(environment) for environment in environments]
        self._idle.reverse()  # the first one works first
        self._running: dict[Future[Answer], tuple[int, _Worker]] = {}

    @property
    def free(self) -> int:
        """How many tasks could be started now."""
        return len(self._idle)

    def start(self, key: int, task: Task) -> None:
        """Give a task to a free worker."""
        worker = self._idle.pop()
        self._running[worker.submit(task)] = key, worker

    def wait(self) -> tuple[int, Answer]:
        """Return the key and the answer of a task that has ended; its worker is free again."""
        done, _ = wait(self._running, return_when=FIRST_COMPLETED)
        future = done.pop()
        key, worker = self._running[future]
        answer = worker.answer(future)
        del self._running[future]
        # What it holds is unknown, such as a CUDA context that one fault has spoilt.
        if answer.died or answer.is_short or answer.status == ExitCode.BUG:
            worker.end()
        self._idle.append(worker)
        return key, answer

    def stop(self) -> list[tuple[int, Answer]]:
        """End all processes: those that work, as a signal ends a run; one that hangs is killed.

        Returns:
            The tasks under way: the key of each, and how it ended.
        """
        busy = [worker for _, worker in self._running.values()]
        try:
            for worker in busy:
                worker.terminate()
            wait(self._running, timeout=GRACE_SECONDS)
        finally:
            for worker in [*self._idle, *busy]:
                worker.end()
        answers = [(key, worker.answer(future)) for future, (key, worker) in self._running.items()]
        self._running.clear()
        self._idle.clear()
        return answers


class _Worker:
    """One process behind an executor of its own, so that its end is that of one scene."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment
        self._executor: ProcessPoolExecutor | None = None
        self._process: BaseProcess | None = None

    def submit(self, task: Task) -> Future[Answer]:
        """Give it a task, and start its process where there is none."""
        if self._executor is not None:
            with suppress(BrokenProcessPool):
                return self._executor.submit(do_task, task)
            self.end()  # it died while it had nothing to do
        context = multiprocessing.get_context("spawn")
        executor = self._executor = ProcessPoolExecutor(1, context, _begin)
        others = {*multiprocessing.active_children()}
        with _starting(self._environment):
            future = executor.submit(do_task, task)
        (self._process,) = {*multiprocessing.active_children()} - others
        return future

    def answer(self, future: Future[Answer]) -> Answer:
        """Return the answer to a task that has ended, or how its process ended without one."""
        try:
            return future.result()
        except BrokenProcessPool:
            self.end()
            assert self._process is not None
            return answer_of_the_dead(self._process.exitcode or 0)

    def terminate(self) -> None:
        """End the task of a worker that has one, as a signal ends a run."""
        if self._process is not None:
            self._process.terminate()

    def end(self) -> None:
        """Kill the process if it still runs; the next task gets another one."""
        if self._process is not None:
            self._process.kill()
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None


@contextmanager
def _starting(environment: Mapping[str, str]) -> Iterator[None]:
    """Let a process that is started within the block have its environment, and no Ctrl-C yet."""
    before = dict(os.environ)
    blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    os.environ.update(environment)
    try:
        yield
    finally:
        for name in environment:
            if name in before:
                os.environ[name] = before[name]
            else:
                del os.environ[name]
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _begin() -> None:
    """Make a process a worker: Ctrl-C goes to the batch alone, and it ends with the batch."""
    os.setpgid(0, 0)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    os.dup2(2, 1)  # what libraries print outside of a scene is no line of the batch's
    silence_warnings()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Wait until the batch is gone, then end this process as a signal ends a run."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE_SECONDS)
    os.kill(os.getpid(), signal.SIGKILL)


def answer_of_the_dead(status: int) -> Answer:
    """Return the answer in place of a process that has ended without one.

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
