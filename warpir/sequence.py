"""Many insertions under one light: the lines of ``--sequence``, one frame each.

    {"photo": "frames/0001.png", "camera": "frames/0001.json", "place": [0, 0, -4]}
    {"photo": "frames/0002.png", "camera": "frames/0002.json", "place": [0, 0, -4.2]}

A line holds what differs from the command line; its relative paths start at the working directory
too. Frame k is written to ``OUT/000k`` as a result folder of its own; ``OUT/sequence.json`` lists
all of them at the end. Frames that are there already, made by the same configuration from the same
files, are left as they are, so an interrupted sequence goes on where it stopped.
"""

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import warpir
from warpir.command import CONFIG_BYTES_LIMIT, closest, read_values
from warpir.config import DEFAULTS, EXCLUSIVE, InsertConfig
from warpir.errors import ExitCode, InputError, raise_all
from warpir.inputs import Loaders, read_inputs
from warpir.lighting import make_light
from warpir.record import input_hashes
from warpir.reuse import check_files, run_record
from warpir.strict_json import parse_json_object

FORMAT = "warpir-sequence"
VERSION = 1
SUMMARY = "sequence.json"
FRAME_COUNT_LIMIT = 9999
FRAME_FIELDS = (
    "photo", "occluder_mask", "asset", "camera", "frame", "fov", "pitch", "horizon",
    "camera_height", "up", "ground", "ground_points", "proxy", "plane", "shadow_mask", "asset_up",
    "place", "at", "rotate_y", "scale", "size", "light_rotate", "exposure", "width", "seed",
)  # fmt: skip
"""What a line may change. The light, its curves and the quality are one for all frames."""


@dataclass(frozen=True)
class Frame:
    """One line of a sequence."""

    line: int
    """Of the file, from 1."""
    config: InsertConfig
    """Complete: it makes the same result without the sequence."""
    changed: tuple[str, ...]
    """The fields that the line names."""
    is_done: bool = False
    """Whether its folder holds the result already."""

    @property
    def folder(self) -> Path:
        """Where the frame is written."""
        assert self.config.out is not None
        return Path(self.config.out)


def read_sequence(config: InsertConfig, loaders: Loaders) -> tuple[Frame, ...]:
    """Read all lines and check the inputs of all frames, before the first is rendered.

    Args:
        config: What the lines are relative to; names the sequence.
        loaders: Read the frames' assets and the run.

    Raises:
        InputError: A line cannot be used; all problems are listed, each with ``FILE:line``.
    """
    assert config.sequence is not None and config.out is not None
    if (Path(config.out) / "run.json").exists():
        raise InputError(
            config.out, "holds the result of one run", "choose another --out", ExitCode.OUTPUT
        )
    if config.reuse is not None:  # once, not as a problem of every line
        loaders.run(config.reuse)
    frames, problems = [], []
    for number, (line, raw) in enumerate(_lines(config.sequence), start=1):
        try:
            frame = _read_line(config, number, line, raw)
            make_light(read_inputs(frame.config, loaders), frame.config)
            frames.append(replace(frame, is_done=_is_done(frame.config)))
        except InputError as error:
            problems += [_at_line(config.sequence, line, e) for e in (error, *error.also)]
    raise_all(problems)
    return tuple(frames)


def write_summary(config: InsertConfig, frames: Sequence[Frame]) -> dict[str, Any]:
    """Write ``sequence.json``: every frame's folder, line, changes and the sha256 of its run.

    Returns:
        Its content.
    """
    assert config.out is not None
    content = {
        "format": FORMAT,
        "version": VERSION,
        "warpir": warpir.__version__,
        "sequence": config.sequence,
        "reuse": config.reuse,
        "frames": [
            {
                "folder": frame.folder.name,
                "line": frame.line,
                "changes": {name: getattr(frame.config, name) for name in frame.changed},
                "run": hashlib.sha256((frame.folder / "run.json").read_bytes()).hexdigest(),
            }
            for frame in frames
        ],
    }
    path = Path(config.out) / SUMMARY
    partial = path.with_name(f".partial-{os.getpid()}.json")
    try:
        with partial.open("w", encoding="utf-8") as stream:
            stream.write(json.dumps(content, indent=2, allow_nan=False) + "\n")
            stream.flush()
            os.fsync(stream.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
    return content


def _lines(path: str) -> Iterator[tuple[int, bytes]]:
    """Yield the number and the bytes of each line that is not blank."""
    try:
        if not Path(path).is_file():
            found = "not a regular file" if Path(path).exists() else "no such file"
            raise InputError(path, found, code=ExitCode.USAGE)
        size = Path(path).stat().st_size
        if size > CONFIG_BYTES_LIMIT:
            expected = f"at most {CONFIG_BYTES_LIMIT}"
            what = f"too large (found {size} bytes; expected {expected})"
            raise InputError(path, what, code=ExitCode.USAGE)
        raw = Path(path).read_bytes()
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
        raise InputError(path, reason, code=ExitCode.USAGE) from error
    lines = [(number, line) for number, line in enumerate(raw.split(b"\n"), 1) if line.strip()]
    if not 1 <= len(lines) <= FRAME_COUNT_LIMIT:
        expected = f"expected 1 to {FRAME_COUNT_LIMIT}"
        what = f"frames miscounted (found {len(lines)}; {expected})"
        raise InputError(path, what, code=ExitCode.USAGE)
    yield from lines


def _read_line(config: InsertConfig, number: int, line: int, raw: bytes) -> Frame:
    assert config.out is not None
    where = f"{config.sequence}:{line}"
    try:
        content = parse_json_object(where, raw)
    except InputError as error:
        error.code = ExitCode.USAGE
        raise
    given, problems = {}, []
    for key, value in content.items():
        name = key.replace("-", "_")
        if name in FRAME_FIELDS:
            given[name] = (value, name)
        elif name in DEFAULTS:
            what = f"key {key[:60]!a} is one for all frames"
            problems.append(InputError(where, what, code=ExitCode.USAGE))
        else:
            advice = closest(name, FRAME_FIELDS)
            what = f"unknown key {key[:60]!a}"
            problems.append(InputError(where, what, advice, ExitCode.USAGE))
    raise_all(problems)
    changes = read_values(given)
    # What a line names replaces what excludes it: "at" in place of --place.
    for pair in EXCLUSIVE:
        for name, other in (pair, pair[::-1]):
            if changes.get(name) is not None and other in FRAME_FIELDS:
                changes.setdefault(other, DEFAULTS[other])
    out = str(Path(config.out) / f"{number:04d}")
    frame = replace(config, **changes, sequence=None, out=out)
    frame.require_inputs()
    return Frame(line, frame, tuple(given))


def _at_line(path: str, line: int, problem: InputError) -> InputError:
    """Name the line of a problem, and keep the file or the field that it is about."""
    where = f"{path}:{line}"
    what = problem.what.removeprefix("line 1: ")
    if problem.where != where:
        what = f"{problem.where}: {what}"
    return InputError(where, what, problem.advice, problem.code)


def _is_done(config: InsertConfig) -> bool:
    """Return whether a frame's folder holds its result already.

    Raises:
        InputError: It holds something else, and --overwrite is not given.
    """
    assert config.out is not None
    out = Path(config.out)
    if config.overwrite or not out.is_dir():
        return False
    if not (out / "run.json").exists():
        if any(not entry.name.startswith(".") for entry in out.iterdir()):
            raise _other_result(out, "no finished run")
        return False
    try:
        record = run_record(out)
        check_files(out, record["files"])
        same = _same(config, record)
    except InputError as error:
        raise _other_result(out, f"{error.where}: {error.what}") from error
    if not same:
        raise _other_result(out, "a run of other settings or other files")
    return True


def _same(config: InsertConfig, record: dict[str, Any]) -> bool:
    """Return whether a run was asked for the same and read the same files."""
    made = {name: value for name, value in record["config"].items() if name in DEFAULTS}
    if len(made) < len(record["config"]):
        return False
    earlier = InsertConfig(**read_values({name: (value, name) for name, value in made.items()}))
    return replace(earlier, overwrite=False) == config and record.get("inputs") == input_hashes(
        config
    )


def _other_result(out: Path, found: str) -> InputError:
    return InputError(
        out,
        f"holds something other than this frame (found {found})",
        "pass --overwrite to replace results",
        ExitCode.OUTPUT,
    )
