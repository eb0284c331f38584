"""A sequence from its first frame to its summary: what is done already is left as it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs, Loaders
from warpir.app.program import attempt, say
from warpir.calibration.photos import FirstPhoto
from warpir.core.progress import LINE_SECONDS, duration
from warpir.core.signals import Stopped
from warpir.io.results import OutputFolder
from warpir.sequence.frames import SUMMARY, Frame, read_sequence, write_summary
from warpir.sequence.look import FirstLook
from warpir.sequence.page import PAGE, refuse_other_page, write_sequence_report


def check_frames(config: InsertConfig) -> None:
    """Check everything that can be checked before the first frame is rendered.

    Raises:
        InputError: A line or a frame cannot be used, or the folder not written.
    """
    frames = _read_frames(config, Loaders(must_be_seen=False))
    OutputFolder(config.output.folder, overwrite=True).check()  # the frames' folders were looked at
    say(f"frames: {len(frames)}, of which {sum(f.is_done for f in frames)} are done already")


def insert_frames(
    config: InsertConfig,
    insert_one: Callable[[InsertConfig, Loaders, FirstLook], object],
    renews: bool,
) -> tuple[Path, tuple[str, ...], dict[str, Any]]:
    """Insert into every frame that is not done, then write summary, page and video.

    With ``renews`` a frame of other settings or other files is replaced.

    Returns:
        The folder, the names of the composites, video and summary in it, and the summary.

    Raises:
        InputError: A line or a frame cannot be used, or the disk is full.
    """
    loaders = Loaders(FirstPhoto(), must_be_seen=False)
    first = FirstLook(loaders)
    frames = _read_frames(config, loaders, renews, first.look_at)
    done, rendered, began = 0, 0, time.monotonic()
    todo = sum(not frame.is_done for frame in frames)
    try:
        for frame in frames:
            if frame.is_done:
                say(f"frame {frame.folder.name}: done already")
            else:
                line = f"frame {frame.folder.name}: line {frame.line} of {config.task.sequence}"
                if rendered:
                    left = (time.monotonic() - began) / rendered * (todo - rendered)
                    line += f", {rendered} of {todo} rendered, {duration(left)} left"
                say(line)
                if frame.config.output.overwrite and not config.output.overwrite:
                    say("notice: its settings or inputs have changed: it is rendered again")
                insert_one(frame.config, loaders, first)
                rendered += 1
            done += 1
    except Stopped as error:
        done += bool(error.kept)  # the signal came while this frame's results were put in place
        how = "renders them again" if config.output.overwrite else "goes on with the rest"
        error.kept = f"kept: {done} of {len(frames)} frames; the same command {how}"
        raise
    if config.output.report:  # before the summary, by which others see that nothing is left to do
        attempt(PAGE, lambda: write_sequence_report(config, frames))
    record = write_summary(config, frames, say)
    _say_left_over(config.output.folder, frames)
    if others := first.others():
        say(
            f"notice: {', '.join(others[:5])}{' ...' * (len(others) > 5)}, of an earlier run, have "
            "another blur, contrast or grain than the frame that tells them now: remove these "
            "folders to render them again"
        )
    composites = (f"{frame.folder.name}/composite.png" for frame in frames)
    return config.output.folder, (*composites, *record["video"], SUMMARY), record


def _say_left_over(out: Path, frames: tuple[Frame, ...]) -> None:
    """Say which folders of a longer sequence before are there: other programs would show them."""
    found = {path.parent.name for path in out.glob("[0-9][0-9][0-9][0-9]/run.json")}
    if left := sorted(found - {frame.folder.name for frame in frames}):
        names = left[0] if len(left) == 1 else f"{left[0]} to {left[-1]}"
        say(
            f"notice: {out} still holds {names}, of a longer sequence before: {len(left)} "
            f"{'folder is' if len(left) == 1 else 'folders are'} no part of this one"
        )


def _read_frames(
    config: InsertConfig,
    loaders: Loaders,
    renews: bool = False,
    take_note: Callable[[Frame, Inputs], None] = lambda *_: None,
) -> tuple[Frame, ...]:
    """Read all frames, as `read_sequence`, and say where an object would not stay in its place.

    Raises:
        InputError: A line or a frame cannot be used, or there is another page.
    """
    poses: set[bytes] = set()
    told = time.monotonic()

    def look_at(frame: Frame, inputs: Inputs) -> None:
        nonlocal told
        if time.monotonic() - told >= LINE_SECONDS:
            told = time.monotonic()
            say(f"checked: frames up to {frame.folder.name}")
        if frame.config.placement.place is None and "at" not in frame.changed:
            poses.add(inputs.camera.c2w.tobytes())
        take_note(frame, inputs)

    frames = read_sequence(config, loaders, renews=renews, look_at=look_at)
    if len(poses) > 1:
        how = "at its pixel" if config.placement.at is not None else "where it is seen"
        say(
            f"notice: the camera moves, and the object is set {how} in each frame anew: it moves "
            "with the camera (--place keeps it where it stands)"
        )
    alone = [frame.line for frame in frames if frame.config.camera.file is None]
    if 0 < len(alone) < len(frames):
        more = f" and {len(alone) - 1} more" if len(alone) > 1 else ""
        say(
            f"notice: line {alone[0]}{more} of {len(frames)} has no --camera, as others have: what "
            "stands for it is in a world of its own, and the object jumps there"
        )
    refuse_other_page(config)
    return frames
