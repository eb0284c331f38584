"""The page of a sequence, ``sequence.html``: thumbnails that link to the frames' reports."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Any

from warpir.app.config import InsertConfig
from warpir.app.record import name_of
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError, disk_errors
from warpir.core.signals import whole
from warpir.core.strict_json import read_json_object
from warpir.report.facts import in_words, without_folders
from warpir.report.html import render_page
from warpir.report.page import MADE_BY, REPORT
from warpir.report.pictures import thumbnail
from warpir.sequence.frames import Frame

PAGE = "sequence.html"
SHOWN = 240
"""Most frames with a picture, spread over the sequence: the page stays small."""


def refuse_other_page(config: InsertConfig) -> None:
    """Refuse to replace a page that warpir did not write.

    Raises:
        InputError: There is one, and --overwrite is not given (`ExitCode.OUTPUT`).
    """
    path = config.output.folder / PAGE
    if not config.output.report or config.output.overwrite or not os.path.lexists(path):
        return
    try:
        with path.open("rb") as stream:
            is_ours = MADE_BY in stream.read(4096)
    except OSError:
        is_ours = False
    if not is_ours:
        advice = "choose another --out, or pass --overwrite"
        raise InputError(path, "not a page of warpir's", advice, ExitCode.OUTPUT)


def write_sequence_report(config: InsertConfig, frames: Sequence[Frame]) -> None:
    """Write ``sequence.html`` beside the frames' folders.

    Args:
        config: Of the sequence.
        frames: All finished.

    Raises:
        InputError: A result is not readable, or the disk is full (exit 5).
    """
    assert config.task.sequence is not None
    every = max(1, -(-len(frames) // SHOWN))
    content = render_page(
        "sequence",
        package="warpir.sequence",
        kind="warpir, report of a sequence",
        title=f"{name_of(config.task.sequence)}: {len(frames)} frames",
        lead=f"Lit by {name_of(config.light.reuse)}." if config.light.reuse else "",
        frames=[_card(frame, k % every == 0) for k, frame in enumerate(frames)],
    )
    path = config.output.folder / PAGE
    with disk_errors(path), whole():
        write_file(path, content)


def _card(frame: Frame, has_picture: bool) -> dict[str, Any]:
    """Return what the page shows of a frame."""
    picture = None
    if has_picture:
        picture = thumbnail(frame.folder / "composite.png", frame.config.limits.pixels)
    asked = frame.config.flat()
    changes = ", ".join(f"{n.replace('_', '-')} {in_words(n, asked[n])}" for n in frame.changed)
    return {
        "name": frame.folder.name,
        "target": REPORT if (frame.folder / REPORT).exists() else "composite.png",
        "picture": picture,
        "changes": without_folders(changes, asked),
        "notices": len(read_json_object(frame.folder / "run.json").get("notices", ())),
    }
