"""The list of a batch: JSON lines, each a scene with a name of its own.

    {"name": "square", "photo": "square.jpg", "asset": "car.glb", "light": "noon.hdr"}
    {"name": "yard", "photo": "yard.jpg", "asset": "car.glb", "at": [640, 610], "size": 4.2}

A line holds the keys of a configuration file. What it does not say is as at the command line of the
batch, and relative paths in it start at the manifest's folder. A line that cannot be used is kept
with its problem, so that the others can be done.
"""

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpir.app.command import read_values
from warpir.app.config import DEFAULTS, InsertConfig, flag, replaced_by, usage
from warpir.app.config_file import by_name
from warpir.app.record import PATHS
from warpir.core.errors import ExitCode, InputError, raise_all, shown
from warpir.core.limits import Limits
from warpir.core.strict_json import parse_json_object, read_json_lines

SCENE_COUNT_LIMIT = 100_000
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
RESERVED = ("batch.html", "batch.json", "failures.jsonl", "logs")
"""What a batch itself writes beside its scenes, in small letters."""
OF_THE_BATCH = {
    "out": "a scene is written to the folder of its name in --out",
    "overwrite": "--overwrite at the command line is for all scenes",
    "resume": "the same command again goes on with what is not done",
    "allow_download": "give it at the command line if you want it",
    "allow_pickle": "give it at the command line if you want it",
}
"""What no line decides, and who does."""


@dataclass(frozen=True)
class Row:
    """One line of a manifest."""

    line: int
    """Of the file, from 1."""
    name: str | None
    """Of the scene and its folder; None where it cannot be read."""
    config: InsertConfig | None = None
    """What is to be done; None where it cannot be."""
    problem: InputError | None = None
    """Why not; further problems are in its ``also``."""


@dataclass(frozen=True)
class Manifest:
    """What was read of the file, which may change or go while its scenes are done."""

    rows: tuple[Row, ...]
    sha256: str


def read_manifest(path: Path, out: Path, given: Mapping[str, Any], limits: Limits) -> Manifest:
    """Read all lines; no file that they name is opened.

    Raises:
        InputError: The file cannot be read or holds no lines, or too many (`ExitCode.USAGE`).
    """
    rows: list[Row] = []
    lines_of: dict[str, int] = {}
    folder = path.absolute().parent
    shared = {name: _absolute(Path.cwd(), name, value) for name, value in given.items()}
    lines, digest = read_json_lines(path, "scenes", SCENE_COUNT_LIMIT, limits)
    for line, raw in lines:
        where, name = f"{path}:{line}", None
        try:
            try:
                content = parse_json_object(where, raw, limits)
            except InputError as error:
                raise usage(where, error.what.removeprefix("line 1: ")) from error
            name = _name(where, content, lines_of)
            lines_of[name.lower()] = line
            config = _config(where, content, folder, shared, out / name)
            rows.append(Row(line, name, config))
        except InputError as error:
            rows.append(Row(line, name, problem=error))
    return Manifest(tuple(rows), digest)


def _name(where: str, content: dict[str, Any], lines_of: Mapping[str, int]) -> str:
    """Take the name out of a line's keys.

    Raises:
        InputError: It is not a plain name of a folder, or another line has it.
    """
    name = content.pop("name", None)
    if not isinstance(name, str):
        found = "nothing" if name is None else f"a value of type {type(name).__name__}"
        raise usage(where, f"name: a text expected (found {found})")
    if not NAME.fullmatch(name) or name.lower() in RESERVED:
        advice = "letters, digits, '.', '_' and '-', not one of " + ", ".join(RESERVED)
        raise usage(where, f"name: not a name for a folder (found {shown(name)})", advice)
    # Some file systems take capital and small letters for the same.
    if (other := lines_of.get(name.lower())) is not None:
        raise usage(where, f"name: {name} is taken by line {other}", "give each scene its own")
    return name


def _config(
    where: str, content: dict[str, Any], folder: Path, shared: dict[str, Any], out: Path
) -> InsertConfig:
    """Return what a line asks for.

    Raises:
        InputError: A key is unknown or a value is wrong.
    """
    given = by_name(where, content)
    raise_all(
        [usage(where, f"{key}: not for a line", OF_THE_BATCH[key]) for key in given
         if key in OF_THE_BATCH]
    )  # fmt: skip
    changes = read_values(given, str)
    changes = {name: _absolute(folder, name, value) for name, value in changes.items()}
    values = {**shared, **replaced_by(changes, DEFAULTS), **changes}
    if str(values.get("device")).startswith("cuda:"):
        found, advice = f"{values['device']}: a batch gives out the devices itself", "say cuda"
        raise InputError(flag("device"), found, advice, ExitCode.USAGE)
    config = InsertConfig(**values, out=str(out.absolute()))
    config.require_inputs()
    return config


def _absolute(folder: Path, name: str, value: Any) -> Any:
    """Return a path as it is found from everywhere; another value as it is."""
    if name not in PATHS or not isinstance(value, str) or "\0" in value:
        return value
    if name == "model" and not os.path.isdir(folder / value):
        return value  # a hub's id
    return str(folder / value)
