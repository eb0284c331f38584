"""The one error a user can cause, and the exit codes that tell schedulers the truth."""

from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path


class ExitCode(IntEnum):
    """How a run ended."""

    DONE = 0
    BUG = 1
    """Our own failure: a traceback and a request to report it."""
    USAGE = 2
    """Command line, configuration, missing extra or device."""
    INPUT = 3
    """A bad input file: photo, mask, environment map, mesh, camera, checkpoint."""
    MODEL = 4
    """A model folder or LoRA file."""
    RESOURCES = 5
    """Out of memory or disk."""
    NUMERIC = 6
    """Non-finite numbers that persisted."""
    OUTPUT = 7
    """The output exists without ``--overwrite``, or is locked by another run."""


class InputError(Exception):
    """Something the user gave cannot be used; printed as one line, never as a traceback.

    Args:
        where: The file or flag at fault.
        what: What is wrong, with what was found and what was expected.
        advice: What to do about it, or an empty string.
        code: The exit code of this class of fault.
    """

    def __init__(
        self,
        where: str | Path,
        what: str,
        advice: str = "",
        code: ExitCode = ExitCode.INPUT,
    ) -> None:
        super().__init__(f"{where}: {what}")
        self.where = str(where)
        self.what = what
        self.advice = advice
        self.code = code
        self.also: tuple[InputError, ...] = ()
        """Further problems found in the same pass; printed, but they decide nothing."""


def raise_all(problems: Sequence[InputError]) -> None:
    """Raise the first problem with the others attached; do nothing when there is none.

    Raises:
        InputError: The first of ``problems``, the others in its ``also``.
    """
    if problems:
        first = problems[0]
        first.also = (*first.also, *(p for later in problems[1:] for p in (later, *later.also)))
        raise first
