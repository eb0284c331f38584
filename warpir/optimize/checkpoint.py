"""When a guided run writes a checkpoint, and what an unfinished run in ``--out`` means."""

from __future__ import annotations

import os
from pathlib import Path

from warpir.app.program import say
from warpir.app.settings import OutputConfig
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.core.signals import Stopped, is_pending
from warpir.io.results import OutputFolder


def is_due(step: int, every: int) -> bool:
    """Return whether a checkpoint is due: every so many steps, and when the run is to stop."""
    return bool(every) and (step % every == 0 or is_pending())


def report_kept(asked: OutputConfig, error: BaseException) -> None:
    """Print which checkpoint remains of a run that was stopped or failed.

    Args:
        asked: Output settings of the run.
        error: Error that ended the run; a `Stopped` carries the line instead.
    """
    if isinstance(error, InputError) and error.code not in (ExitCode.RESOURCES, ExitCode.NUMERIC):
        return  # refused before it began
    assert asked.out is not None
    checkpoints = Checkpoints(Path(asked.out), {})
    line = ""
    if checkpoints.newest is not None:
        kept = checkpoints.folder / checkpoints.newest
        line = f"kept: {kept}; the same command with --resume goes on from there"
    if isinstance(error, Stopped):  # printed last; the stage may have set a better one
        error.kept = error.kept or line or "there was no checkpoint to keep yet"
    elif line:
        say(line)


def output_folder(asked: OutputConfig, is_guided: bool) -> OutputFolder:
    """Return the output folder, not yet entered.

    Args:
        asked: Output settings: the folder, and whether its run is resumed or overwritten.
        is_guided: Whether this run writes checkpoints.

    Raises:
        InputError: ``--resume`` of a finished or unguided run, or an unfinished run without
            ``--resume`` or ``--overwrite`` (`ExitCode.OUTPUT`).
    """
    out, resume, overwrite = asked.out, asked.resume, asked.overwrite
    assert out is not None
    newest = Checkpoints(Path(out), {}).newest
    if resume and newest is None and os.path.exists(Path(out, "run.json")):
        raise InputError(
            "--resume",
            f"the run in {out} is finished",
            "to run it again, give --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    if newest is not None and not (resume or overwrite):
        raise InputError(
            out,
            f"holds an unfinished run ({newest})",
            "--resume goes on with it, --overwrite starts it again",
            ExitCode.OUTPUT,
        )
    if resume and newest is not None and not is_guided:
        raise InputError(
            "--resume",
            f"the unfinished run in {out} was guided, this one is not",
            "give its flags, or --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    # A run that is resumed was allowed to replace these results, or wrote them itself.
    is_resumed = resume and newest is not None
    return OutputFolder(out, overwrite=overwrite or is_resumed, is_resumed=is_resumed)
