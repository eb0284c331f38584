"""What all commands share: errors as one line and an exit status, signals, and lines of output."""

import errno
import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from types import FrameType

from warpir.config import usage
from warpir.errors import ExitCode, InputError

INTERRUPTED = 130
TERMINATED = 143
EXTRA_OF = {"ray": "ray", "mitsuba": "bench", "matplotlib": "bench"}
"""Which extra brings a package that a plain install does not have."""
NO_MEMORY = ("allocate mem", "Failed to allocate", "out of memory", "ALLOC_FAILED")
"""How torch, Warp and CUDA say in a RuntimeError that memory is short."""


def run_program(run: Callable[[list[str]], int], argv: Sequence[str] | None = None) -> int:
    """Run a command; the one place that prints errors.

    Args:
        run: Given the arguments, returns the exit status.
        argv: Arguments without the program's name; ``sys.argv`` when absent.

    Returns:
        The exit status, an `ExitCode` or 128 plus the number of a signal.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in arguments
    if debug:
        logging.basicConfig(level=logging.DEBUG, format="debug: %(name)s: %(message)s")
    for stream in (sys.stdout, sys.stderr):
        # A terminal without UTF-8 shows escapes; it must not end the run.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        with _terminate_as_exception():
            return run(arguments)
    except BaseException as error:
        status, lines = _explain(error)
        if debug and not isinstance(error, SystemExit):
            traceback.print_exc()
        elif status == ExitCode.BUG:
            # Without --debug too: without it nobody could repair what is our fault.
            traceback.print_exc()
        for line in lines:
            print(line, file=sys.stderr)
        return status


def _explain(error: BaseException) -> tuple[int, list[str]]:
    """Return the exit status of an exception and the lines that tell the user about it."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else ExitCode.DONE, []
    if isinstance(error, _Terminated):
        return TERMINATED, ["stopped"]
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, ["stopped"]
    missing = (getattr(error, "name", None) or "").split(".")[0]
    if isinstance(error, ModuleNotFoundError) and missing in EXTRA_OF:
        error = usage(
            missing, "not installed", f"pip install 'warpir[{EXTRA_OF[missing]}]' brings it"
        )
    elif _is_short_of_memory(error):
        error = InputError(
            "memory",
            "not enough of it",
            "lower --width, --samples or --rays, with --guidance --class-batch, --noises or "
            "--guidance-width, or use --device cpu",
            ExitCode.RESOURCES,
        )
    elif isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        name = error.filename or "--out"
        error = InputError(name, f"cannot be written ({error.strerror})", code=ExitCode.RESOURCES)
    if isinstance(error, InputError):
        lines = [_one_line(f"error: {error.where}: {error.what}")]
        lines += [_one_line(error.advice)] if error.advice else []
        return error.code, lines + [_one_line(f"also: {o.where}: {o.what}") for o in error.also]
    kind = _one_line(f"{type(error).__name__}: {error}")
    return ExitCode.BUG, [
        f"error: warpir: a fault of its own ({kind})",
        "please report it with the lines above and the command that was run",
    ]


def _is_short_of_memory(error: BaseException) -> bool:
    told = isinstance(error, RuntimeError) and any(words in str(error) for words in NO_MEMORY)
    return told or isinstance(error, MemoryError)


def _one_line(text: str) -> str:
    # File names may hold line breaks and control characters.
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def say(line: str) -> None:
    """Print on standard output; a reader that went away (``| head``) does not end the run."""
    try:
        print(_one_line(line), flush=True)
    except BrokenPipeError:
        # Python flushes once more at exit: give it somewhere to write to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class _Terminated(BaseException):
    """SIGTERM, turned into an exception so that staged files and locks are removed."""


@contextmanager
def _terminate_as_exception() -> Iterator[None]:
    def terminate(signum: int, frame: FrameType | None) -> None:
        raise _Terminated

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    previous = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
