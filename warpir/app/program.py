"""What all commands share: errors as one line and an exit status, signals, and lines of output."""

import atexit
import ctypes
import importlib.util
import logging
import os
import resource
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress

from warpir.app.config import InsertConfig, usage
from warpir.core import signals
from warpir.core.atomic import WriteError
from warpir.core.errors import DISK_FULL, LISTED, ExitCode, InputError, disk_error
from warpir.core.memory import MIB, free_host, is_shortage

_LOG = logging.getLogger(__name__)
INTERRUPTED = 130
"""Of a Ctrl-C where nobody handles signals: 128 and the number of SIGINT."""
LEAST_STACK = 1 << 20
"""Stack of the main thread below which LLVM's may overflow [byte]; systems give 8 MiB."""
LONGEST = 10_000
"""Most characters of a line: two file names of any length and a sentence."""
EXTRA_OF = {
    "ray": "ray",
    "mitsuba": "bench",
    "pxr": "usd",
    "matplotlib": "bench",
    **dict.fromkeys(("accelerate", "diffusers", "peft", "transformers"), "guidance"),
}
"""Which extra brings a package that a plain install does not have."""
BROUGHT = (
    *("OpenEXR", "OpenImageIO", "PIL", "colour", "numpy", "rich", "safetensors", "scipy"),
    *("skimage", "torch", "trimesh", "warp", "yaml"),
)
"""What a plain install brings, so that only a broken one lacks it."""


M_ARENA_MAX = -8
"""Of glibc's ``mallopt``."""


def settle_environment() -> None:
    """Set what libraries read when they are loaded, so before they are.

    NumPy's BLAS gets one thread, as the last bits of its sums depend on how many there are, and
    Hugging Face's libraries send nothing home. The threads share one heap: with a heap each, a run
    holds a quarter more memory.
    """
    with suppress(OSError, AttributeError):  # another C library than glibc
        ctypes.CDLL(None).mallopt(M_ARENA_MAX, 1)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    for name in ("HF_HUB_DISABLE_TELEMETRY", "DO_NOT_TRACK"):
        os.environ[name] = "1"


def silence_warnings() -> None:
    """Keep warnings of NumPy and others, which are noise to the user, from standard error.

    What they tell of is checked for; ``--debug`` shows them.
    """
    logging.captureWarnings(True)
    logging.getLogger("py.warnings").addHandler(logging.NullHandler())


def _open_closed_streams() -> None:
    """Put nothing in the place of closed standard streams.

    Otherwise the next files that are opened get their numbers, and what libraries print would go
    into them.
    """
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            os.dup2(os.open(os.devnull, os.O_RDWR), number)
    # Python has no stream where the descriptor was closed at its start.
    sys.stdout = sys.stdout or open(1, "w", closefd=False)
    sys.stderr = sys.stderr or open(2, "w", closefd=False)


def attempt(page: str, make: Callable[[], None]) -> list[str]:
    """Make a page about results; where that fails return, having printed it, a notice.

    Raises:
        InputError: There is no room for it (exit 5).
    """
    try:
        make()
    # Whatever it is: all results are there, and a page about them must not cost them.
    except Exception as error:
        if isinstance(error, InputError) and error.code == ExitCode.RESOURCES:
            raise
        _LOG.debug(page, exc_info=True)
        why = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        line = f"{page} could not be made ({why})"
        say(f"notice: {line}")
        return [line]
    return []


def require_packages(*names: str) -> None:
    """Look for packages that are imported late, without importing them.

    Raises:
        ModuleNotFoundError: One is not installed; `run_program` says what brings it.
    """
    for name in names:
        if importlib.util.find_spec(name) is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def extras_of(config: InsertConfig) -> tuple[str, ...]:
    """Return the packages of extras that an insertion imports late; for `require_packages`."""
    of_model = ("diffusers", "transformers", "peft") if config.is_guided else ()
    return (*of_model, *(("pxr",) if config.output.usd else ()))


def _require_process() -> None:
    """Refuse a process in which libraries crash: without a folder, or with hardly any stack.

    Raises:
        InputError: It is so (`ExitCode.RESOURCES`).
    """
    try:
        os.getcwd()
    except OSError as error:
        what, advice = "was removed", "change into one that is there"
        raise InputError("working folder", what, advice, ExitCode.RESOURCES) from error
    stack = resource.getrlimit(resource.RLIMIT_STACK)[0]
    if stack != resource.RLIM_INFINITY and stack < LEAST_STACK:
        what = f"too small for the renderer's compiler (found {stack}; needed {LEAST_STACK} bytes)"
        raise InputError("stack", what, "ulimit -s 8192 sets the usual", ExitCode.RESOURCES)


def stay_offline() -> None:
    """Tell Hugging Face's libraries, before they are loaded, to open no connection."""
    for name in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE"):
        os.environ[name] = "1"


def run_program(run: Callable[[list[str]], int], argv: Sequence[str] | None = None) -> int:
    """Run a command; the one place that prints errors.

    Args:
        run: Given the arguments, returns the exit status.
        argv: Arguments without the program's name; ``sys.argv`` when absent, and then the process
            ends with the status.

    Returns:
        The exit status, an `ExitCode` or 128 plus the number of a signal.
    """
    status = _status_of(run, list(sys.argv[1:] if argv is None else argv))
    if argv is None:
        _leave(status)
    return status


def _leave(status: int) -> None:
    """End the process without taking torch and Warp down, which takes them half a second.

    Where a stream cannot be written any more, a thread still runs, or a profiler is to tell what it
    saw, nothing is done: Python's own way to the end waits, and tells of it.
    """
    if threading.active_count() > 1 or sys.getprofile() is not None or sys.flags.interactive:
        return
    atexit._run_exitfuncs()
    try:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    except (OSError, ValueError):
        return
    os._exit(status)


def _status_of(run: Callable[[list[str]], int], arguments: list[str]) -> int:
    _open_closed_streams()
    settle_environment()
    debug = "--debug" in arguments
    silence_warnings()
    if debug:
        logging.basicConfig(level=logging.DEBUG, format="debug: %(name)s: %(message)s")
    for stream in (sys.stdout, sys.stderr):
        # A terminal without UTF-8 shows escapes; it must not end the run.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    atexit.unregister(signals.ignore_at_exit)
    with signals.handled():
        try:
            _require_process()
            return run(arguments)
        except BaseException as error:
            signals.ignore()
            status, lines = explain(error)
            with suppress(OSError):  # nobody can read it: the status says it all
                # Without --debug too what is our fault, which nobody could repair without it.
                if status == ExitCode.BUG or (debug and not isinstance(error, SystemExit)):
                    traceback.print_exc()
                for line in lines:
                    print(line, file=sys.stderr, flush=True)
            return status
        finally:
            # What is registered last is called first: before caches are written and torch is gone.
            atexit.register(signals.ignore_at_exit)


def explain(error: BaseException) -> tuple[int, list[str]]:
    """Return the exit status of an exception and the lines that tell the user about it."""
    if isinstance(error, SystemExit):
        return error.code if isinstance(error.code, int) else ExitCode.DONE, []
    if isinstance(error, signals.Stopped):
        kept = f"; {error.kept}" if error.kept else ""
        return 128 + error.number, [_one_line(f"stopped by {error}{kept}")]
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, ["stopped"]
    missing = (getattr(error, "name", None) or "").split(".")[0]
    if isinstance(error, ModuleNotFoundError) and missing in EXTRA_OF:
        error = usage(
            missing, "not installed", f"pip install 'warpir[{EXTRA_OF[missing]}]' brings it"
        )
    elif isinstance(error, ModuleNotFoundError) and missing in BROUGHT:
        error = usage(missing, "not installed", "pip install --upgrade warpir brings it")
    elif is_shortage(error):
        error = InputError(
            "memory",
            f"not enough of it ({free_host() // MIB} MiB of the host are free now)",
            "lower --width, --samples or --rays, with --guidance --class-batch, --noises or "
            "--guidance-width, give a smaller --photo or --asset, or use --device cpu",
            ExitCode.RESOURCES,
        )
    elif isinstance(error, WriteError) or (isinstance(error, OSError) and error.errno in DISK_FULL):
        error = disk_error(error.filename or "--out or the folder of temporary files", error)
    if isinstance(error, InputError):
        lines = [_one_line(f"error: {error.where}: {error.what}")]
        lines += [_one_line(error.advice)] if error.advice else []
        lines += [_one_line(f"also: {o.where}: {o.what}") for o in error.also[:LISTED]]
        if len(error.also) > LISTED:
            lines.append(f"also: and {len(error.also) - LISTED} more")
        return error.code, lines
    kind = _one_line(f"{type(error).__name__}: {error}")
    return ExitCode.BUG, [
        f"error: warpir: a fault of its own ({kind})",
        "please report it with the lines above and the command that was run",
    ]


def _one_line(text: str) -> str:
    if len(text) > LONGEST:  # what was found stands at the beginning, what was expected at the end
        text = f"{text[: LONGEST // 2]} ... {text[-LONGEST // 2 :]}"
    # File names may hold line breaks and control characters.
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def say(line: str) -> None:
    """Print on standard output; a reader that went away, or a full disk, does not end the run."""
    try:
        print(f"{_one_line(line)}\n", end="", flush=True)  # one write: threads print too
    except OSError:
        # Python flushes once more at exit: give it somewhere to write to.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
