"""What an output folder holds beside results: the remains of runs that did not end."""

import re
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from warpir.core.atomic import remove_folder, sha256_of
from warpir.core.errors import InputError
from warpir.core.strict_json import read_json_object

PREVIEWS, NEW_PREVIEWS = "progress", "progress-new"
"""The second holds those of a run that is to replace an earlier result, until it does."""
_PREVIEW = re.compile(r"preview-[0-9]{6,}\.png")
UNFINISHED = {
    "checkpoints": re.compile(r"[0-9]{6,}-[a-z-]+-[0-9]+|\.partial-.*"),
    PREVIEWS: _PREVIEW,
    NEW_PREVIEWS: _PREVIEW,
}
"""Folders of an output folder that hold what a run needs, or shows, before it has results."""
PLAIN_NAME = re.compile(r"(?:[A-Za-z0-9][A-Za-z0-9_.-]{0,99}/)?[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
"""A file, or a file in a folder of the output folder."""
RUN_JSON = "run.json"
STAGING = ".partial-"


def results_in(path: Path) -> list[str]:
    """Return the names of what counts as somebody's results in an output folder, sorted.

    Hidden files do not, nor what an unfinished run has left.
    """
    half = set(half_in_place(path))
    names: set[str] = set()
    for entry in path.iterdir():
        own = UNFINISHED.get(entry.name)
        is_mixed = any(name.startswith(f"{entry.name}/") for name in half)
        if entry.is_dir() and (own or is_mixed):
            others = (other.name for other in entry.iterdir())
            names |= {f"{entry.name}/{n}" for n in others if not (own and own.fullmatch(n))}
        elif not entry.name.startswith("."):
            names.add(entry.name)
    return sorted(names - half)


def remove_unfinished(folder: Path) -> None:
    """Remove what an unfinished run has left in one of its folders; what is not ours stays.

    Raises:
        OSError: The folder around it is not writable.
    """
    if not folder.is_dir():
        return
    entries = sorted(folder.iterdir())
    ours = [entry for entry in entries if UNFINISHED[folder.name].fullmatch(entry.name)]
    if len(ours) == len(entries):
        remove_folder(folder)
        return
    for entry in ours:  # the newest last: what is left is whole at every moment
        remove_folder(entry)


def half_in_place(path: Path) -> list[str]:
    """Return the files that a run which did not get to its ``run.json`` has moved into a folder."""
    if (path / RUN_JSON).exists():
        return []
    staged = path.glob(f"{STAGING}*/{RUN_JSON}")
    return sorted({name for run_json in staged for name in unchanged_files(run_json, path)})


def unchanged_files(run_json: Path, folder: Path) -> list[str]:
    """Return the files that a ``run.json`` lists, as far as they are in a folder and unchanged."""
    try:
        listed = read_json_object(run_json).get("files")
    except InputError:
        return []
    unchanged = []
    for name, digest in listed.items() if isinstance(listed, dict) else ():
        path = folder / name
        if not PLAIN_NAME.fullmatch(name) or not path.is_file() or path.is_symlink():
            continue
        with suppress(OSError):  # what cannot be read stays
            if sha256_of(path) == digest:
                unchanged.append(name)
    return unchanged


def remove_empty_folders(path: Path, names: Iterable[str]) -> None:
    """Remove the folders of files that are gone, as far as nothing else is in them."""
    for folder in {(path / name).parent for name in names} - {path}:
        with suppress(OSError):
            folder.rmdir()
