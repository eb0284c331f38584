"""The one error a user can cause, and the exit codes that tell schedulers the truth."""

import errno
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import IntEnum
from pathlib import Path
from typing import Any

import warpir

# A folder called warpir in the current directory, such as a checkout, hides an installation that
# follows its sources, and then a run would only break at its end.
if warpir.__file__ is None:
    raise ImportError(
        "the folder 'warpir' in the current directory hides the installed package: "
        "start Python in another folder"
    )

DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


LISTED = 30
"""Most problems that are listed beside the first."""
SHOWN = 60
"""Most characters of a user's text in an error."""


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
        reason: Stable identifier of the fault, such as ``gltf.index_out_of_range``: what programs
            and tests compare, where the sentence is for a person.
        fields: What the sentence says, as values: found, limit, pointer.
    """

    def __init__(
        self,
        where: str | Path,
        what: str,
        advice: str = "",
        code: ExitCode = ExitCode.INPUT,
        *,
        reason: str = "",
        **fields: object,
    ) -> None:
        super().__init__(f"{where}: {what}")
        self.where = str(where)
        self.what = what
        self.advice = advice
        self.code = code
        self.reason = reason
        self.fields = fields
        self.also: tuple[InputError, ...] = ()
        """Further problems found in the same pass; printed, but they decide nothing."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Let it be copied and pickled, though subclasses take other arguments."""
        return type(self).__new__, (type(self), *self.args), self.__dict__


class Faults:
    """The faults of one kind of input, each with a reason, a sentence and what to do about it.

    Args:
        kind: First part of the reasons, as in ``camera.scaled``.
        sentences: What is wrong, by the second part, or that and the advice. The fields of an error
            stand in it as in `str.format`.
    """

    def __init__(self, kind: str, sentences: Mapping[str, str | tuple[str, str]]) -> None:
        self.kind = kind
        self.sentences = sentences

    def error(
        self, where: str | Path, reason: str, /, *, advice: str = "", **fields: object
    ) -> InputError:
        """Return the error of a reason.

        Args:
            where: The file or flag at fault.
            reason: Of the table.
            advice: What to do about it, where the table does not say.
            fields: What the sentence says. ``pointer`` and ``line``, the place in the file, go
                before it; ``found``, ``expected`` and ``limit`` follow unless they stand in it.
        """
        stated = self.sentences[reason]
        sentence, usual = (stated, "") if isinstance(stated, str) else stated
        what = sentence.format(**fields)
        if "line" in fields:
            what = f"line {fields['line']}: {what}"
        if "pointer" in fields:
            what = f"{fields['pointer']}: {what}"
        values = [
            f"{name} {_as_text(fields[name])}"
            for name in ("found", "expected", "limit")
            if name in fields and f"{{{name}" not in sentence
        ]
        if values:
            what += f" ({'; '.join(values)})"
        error = InputError(where, what, advice or usual, reason=f"{self.kind}.{reason}")
        error.fields = fields  # under any names
        return error


def _as_text(value: object) -> str:
    if isinstance(value, tuple):
        return " x ".join(map(_as_text, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def raise_all(problems: Sequence[InputError]) -> None:
    """Raise the first problem with the others attached; do nothing when there is none.

    Raises:
        InputError: The first of ``problems``, the others in its ``also``.
    """
    if problems:
        first = problems[0]
        first.also = (*first.also, *(p for later in problems[1:] for p in (later, *later.also)))
        raise first


def shown(text: str) -> str:
    """Return a text of the user as an error shows it: quoted, escaped and cut."""
    return ascii(text[:SHOWN]) + ("..." if len(text) > SHOWN else "")


def disk_error(where: str | Path, error: OSError, what: str = "cannot be written") -> InputError:
    """Make the error of a file that cannot be written (`ExitCode.RESOURCES`)."""
    advice = "check the folder's permissions"
    if error.errno in DISK_FULL:
        advice = "free some disk space"
    elif error.errno == errno.ENOENT:
        advice = "was the folder removed or replaced meanwhile?"
    why = error.strerror or str(error)
    return InputError(where, f"{what} ({why})", advice, ExitCode.RESOURCES)


@contextmanager
def disk_errors(where: str | Path, what: str = "cannot be written") -> Iterator[None]:
    """Let an `OSError` in the block be a `disk_error`."""
    try:
        yield
    except OSError as error:
        raise disk_error(where, error, what) from error
