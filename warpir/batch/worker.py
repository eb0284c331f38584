"""A worker process of `warpir.batch.local`: tasks on standard input, answers on standard output.

It does one task after another, so that torch, Warp and the kernels are loaded once. When its input
ends, so does it: at once if it waits, else as a signal ends a run, with a checkpoint kept. So none
outlives the batch, however that ended.
"""

import json
import os
import signal
import sys
import threading
from queue import SimpleQueue

from warpir.app.program import run_program
from warpir.batch.task import Task, do_task


def main() -> int:
    """Work until the input ends; return the exit status."""
    return run_program(_serve)


def _serve(arguments: list[str]) -> int:
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what is printed is no answer
    lines: SimpleQueue[bytes] = SimpleQueue()
    is_busy = threading.Event()

    def listen() -> None:
        # Not sys.stdin: Python could not end while another thread reads that.
        for line in os.fdopen(os.dup(0), "rb"):
            is_busy.set()  # here: a scene that the end of the input overtakes is not begun
            lines.put(line)
        lines.put(b"")
        if is_busy.is_set():
            os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=listen, daemon=True).start()
    while line := lines.get():
        answer = do_task(Task(**json.loads(line)))
        is_busy.clear()
        try:
            answers.write(answer.line())
            answers.flush()
        except BrokenPipeError:  # the batch was killed: nobody waits for it
            # Python flushes once more at exit: give it somewhere to write to.
            os.dup2(os.open(os.devnull, os.O_WRONLY), answers.fileno())
            break
    return 0


if __name__ == "__main__":
    sys.exit(main())
