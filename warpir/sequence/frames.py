"""Many insertions under one light: the lines of ``--sequence``, one frame each.

    {"photo": "frames/0001.png", "camera": "frames/0001.json", "place": [0, 0, -4]}
    {"photo": "frames/0002.png", "camera": "frames/0002.json", "place": [0, 0, -4.2]}

A line holds what differs from the command line; its relative paths start at the working directory
too. Frame k is written to ``OUT/000k`` as a result folder of its own; at the end
``OUT/sequence.json`` lists all of them, and where ffmpeg is found their composites also make the
video ``OUT/composite.mp4``. Frames that are there already, made by the same configuration from the
same files, are left as they are, so an interrupted sequence goes on where it stopped.
"""

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import warpir
from warpir.app.command import read_values
from warpir.app.config import DEFAULTS, InsertConfig, as_usage, replaced_by, usage
from warpir.app.config_file import by_name
from warpir.app.earlier_runs import OtherRun, is_done
from warpir.app.inputs import Inputs, Loaders, read_inputs
from warpir.app.record import file_hash
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError, disk_error, raise_all, shown
from warpir.core.signals import whole
from warpir.core.strict_json import (
    json_bytes,
    parse_json_object,
    read_json_lines,
    read_json_object,
)
from warpir.lighting.scene_light import make_light
from warpir.sequence.video import VIDEO, NoVideo, write_video

FORMAT = "warpir-sequence"
VERSION = 1
SUMMARY = "sequence.json"
FRAME_COUNT_LIMIT = 9999
FRAME_FIELDS = (
    "photo", "occluder_mask", "asset", "camera", "frame", "fov", "pitch", "roll", "horizon",
    "camera_height", "camera_from", "up", "ground", "ground_points", "proxy", "plane",
    "shadow_mask", "asset_up",
    "place", "at", "rotate_y", "scale", "size", "light_rotate", "exposure", "width", "seed",
)  # fmt: skip
"""What a line may change. The light, its curves and the quality are one for all frames."""


@dataclass(frozen=True)
class Frame:
    """One line of a sequence."""

    line: int
    """Of the file, from 1."""
    config: InsertConfig
    """Complete: it makes the same result without the sequence, but for a camera or a look that is
    estimated, a ground that is fitted and open ground that is looked for, where those of the first
    frame that has them hold for the others; and for an object outside the photo, which a single
    photo refuses."""
    changed: tuple[str, ...]
    """The fields that the line names."""
    is_done: bool = False
    """Whether its folder holds the result already."""

    @property
    def folder(self) -> Path:
        """Where the frame is written."""
        return self.config.output.folder


def read_sequence(
    config: InsertConfig,
    loaders: Loaders,
    *,
    renews: bool = False,
    look_at: Callable[[Frame, Inputs], None] = lambda *_: None,
) -> tuple[Frame, ...]:
    """Read all lines and check the inputs of all frames, before the first is rendered.

    Args:
        config: What the lines are relative to; names the sequence.
        loaders: Read the frames' assets and the run.
        renews: Whether a frame of other settings or other files is to be replaced.
        look_at: Shown each frame and what it reads, which is not kept.

    Raises:
        InputError: A line cannot be used; all problems are listed, each with ``FILE:line``.
    """
    assert config.task.sequence is not None
    out = config.output.folder
    if (out / "run.json").exists():
        what, advice = "holds the result of one run", "choose another --out"
        raise InputError(str(config.output.out), what, advice, ExitCode.OUTPUT)
    _refuse_other_summary(out / SUMMARY, config)
    if config.light.reuse is not None:  # once, not as a problem of every line
        loaders.run(config.light.reuse, config.limits)
    frames, problems, is_seen = [], [], False
    lines, _ = read_json_lines(config.task.sequence, "frames", FRAME_COUNT_LIMIT, config.limits)
    for number, (line, raw) in enumerate(lines, start=1):
        try:
            frame = _read_line(config, number, line, raw)
            inputs = read_inputs(frame.config, loaders)
            make_light(inputs, frame.config.light, frame.config.tone_operator)
            frames.append(_looked_up(frame, renews))
            is_seen |= inputs.placement.is_seen
            look_at(frames[-1], inputs)
        except InputError as error:
            problems += [_at_line(config.task.sequence, line, e) for e in (error, *error.also)]
    raise_all(problems)
    if not is_seen:
        advice = "give another --place, or the cameras of its world"
        raise InputError(config.task.sequence, "no frame sees the object", advice)
    return tuple(frames)


def _looked_up(frame: Frame, renews: bool) -> Frame:
    """Return a frame that knows what is in its folder."""
    try:
        return replace(frame, is_done=is_done(frame.config))
    except OtherRun as error:
        if not renews:
            advice = "remove that folder to render the frame again; --overwrite renders all again"
            raise InputError(error.where, error.what, advice, error.code) from error
        return replace(frame, config=frame.config.changed(overwrite=True))


def _refuse_other_summary(path: Path, config: InsertConfig) -> None:
    """Refuse to write where --sequence itself, or a file that is none of ours, would be lost."""
    assert config.task.sequence is not None
    if not os.path.lexists(path):
        return
    if os.path.exists(config.task.sequence) and os.path.samefile(path, config.task.sequence):
        advice = "choose another --out, or another name for it"
        raise usage("--out", f"the summary {path} would replace --sequence", advice)
    try:
        is_ours = read_json_object(path).get("format") == FORMAT
    except InputError:
        is_ours = False
    if not is_ours and not config.output.overwrite:
        raise InputError(
            path,
            "not the summary of a sequence, which would replace it",
            "choose another --out, or pass --overwrite",
            ExitCode.OUTPUT,
        )


def write_summary(
    config: InsertConfig, frames: Sequence[Frame], say: Callable[[str], None]
) -> dict[str, Any]:
    """Write ``sequence.json`` and, beside it, the frames' video, unless that is there.

    The summary, which is returned, holds every frame's folder, line, changes and the sha256 of its
    run. It tells of a video before that gets its name, and an earlier one is gone by then: whenever
    the run is killed, a video that is there is one that the summary knows.

    Raises:
        InputError: The disk is full or the folder is not writable (exit 5).
    """
    path, video = config.output.folder / SUMMARY, config.output.folder / VIDEO
    made = video.with_name(f".{VIDEO}.{os.getpid()}.made")
    try:
        content = {
            "format": FORMAT,
            "version": VERSION,
            "warpir": warpir.__version__,
            "sequence": config.task.sequence,
            "reuse": config.light.reuse,
            "frames": _records(frames),
            "video": _make_video(config, frames, made, say),
        }
        with whole():
            if made.exists():
                video.unlink(missing_ok=True)
            write_file(path, json_bytes(content))
            if made.exists():
                os.replace(made, video)
    except OSError as error:
        raise disk_error(path, error) from error
    finally:
        made.unlink(missing_ok=True)
    return content


def is_whole(config: InsertConfig, frames: Sequence[Frame]) -> bool:
    """Return whether all frames are done and the summary is of them and of the video beside it.

    Where there is no video, ffmpeg is not there either.

    Args:
        config: Of the sequence.
        frames: All of them, from `read_sequence`.
    """
    if not all(frame.is_done for frame in frames):
        return False
    try:
        found = read_json_object(config.output.folder / SUMMARY)
    except InputError:
        return False
    if found.get("frames") != json.loads(json.dumps(_records(frames))):
        return False
    before, digest = _made_before(config), _video_digest(config)
    if not before:
        return shutil.which("ffmpeg") is None
    return before == _video_record(config, frames, digest)


def _make_video(
    config: InsertConfig, frames: Sequence[Frame], made: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Make the video where another one, or none, is there; return its entry in the summary."""
    before, digest = _made_before(config), _video_digest(config)
    video = config.output.folder / VIDEO
    if digest is not None and before.get("sha256") == digest:
        if before == _video_record(config, frames, digest):
            return {VIDEO: before}
    elif os.path.lexists(video) and (not config.output.overwrite or video.is_dir()):
        say(f"notice: {video} is none of this sequence's and stays as it is (--overwrite)")
        return {}
    try:
        composites = [frame.folder / "composite.png" for frame in frames]
        write_video(made, composites, config.task.fps, config.limits.pixels)
    except NoVideo as error:
        say(f"notice: {error}")
        return {}
    return {VIDEO: _video_record(config, frames, file_hash(made))}


def _video_record(
    config: InsertConfig, frames: Sequence[Frame], digest: str | None
) -> dict[str, Any]:
    runs = [_run_digest(frame) for frame in frames]
    return {"fps": config.task.fps, "frames": runs, "sha256": digest}


def _video_digest(config: InsertConfig) -> str | None:
    path = config.output.folder / VIDEO
    return file_hash(path) if path.is_file() else None


def _made_before(config: InsertConfig) -> dict[str, Any]:
    """Return the summary's entry of an earlier video."""
    try:
        found = read_json_object(config.output.folder / SUMMARY).get("video")
    except InputError:
        return {}
    video = found.get(VIDEO) if isinstance(found, dict) else None
    return video if isinstance(video, dict) else {}


def _records(frames: Sequence[Frame]) -> list[dict[str, Any]]:
    """Return the summary's entries of the frames."""
    return [
        {
            "folder": frame.folder.name,
            "line": frame.line,
            "changes": {name: frame.config.flat()[name] for name in frame.changed},
            "run": _run_digest(frame),
        }
        for frame in frames
    ]


def _run_digest(frame: Frame) -> str:
    return hashlib.sha256((frame.folder / "run.json").read_bytes()).hexdigest()


def _read_line(config: InsertConfig, number: int, line: int, raw: bytes) -> Frame:
    where = f"{config.task.sequence}:{line}"
    with as_usage():
        content = parse_json_object(where, raw, config.limits)
    given = by_name(where, content)
    raise_all(
        [
            InputError(where, f"key {shown(name)} is one for all frames", code=ExitCode.USAGE)
            for name in given
            if name not in FRAME_FIELDS
        ]
    )
    changes = read_values(given, str)
    changes |= replaced_by(changes, FRAME_FIELDS)
    out = str(config.output.folder / f"{number:04d}")
    of_one: dict[str, Any] = {"sequence": None, "fps": DEFAULTS["fps"], "out": out}
    frame = config.changed(**changes, **of_one)
    frame.require_inputs()
    return Frame(line, frame, tuple(given))


def _at_line(path: str, line: int, problem: InputError) -> InputError:
    """Name the line of a problem, and keep the file or the field that it is about."""
    where = f"{path}:{line}"
    what = problem.what.removeprefix("line 1: ")
    if problem.where != where:
        what = f"{problem.where}: {what}"
    return InputError(where, what, problem.advice, problem.code)
