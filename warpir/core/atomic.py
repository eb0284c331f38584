"""How a file comes to be: whole under its name, or not at all.

    write_file(path, content)           one file
    with replacing(path) as staged:     one file that a library writes
    write_folder(path, files)           several files that belong together

A name is given by one rename, after the content has reached the disk; until then what had the name
before is what a reader, or the next run, finds. `warpir.io.results.OutputFolder` does the same for
results of several files.
"""

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from warpir.core.signals import whole


class WriteError(OSError):
    """A file cannot be written; what had its name before is whole."""


def write_file(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; its folder is made where it is missing.

    Raises:
        WriteError: The disk is full or the folder is not writable.
    """
    with replacing(path) as staged:
        write_staged(staged, content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a name to write to; at the end of the block it becomes ``path``.

    Raises:
        WriteError: The disk is full or the folder is not writable.
    """
    staged = path.with_name(f".{path.name}.{os.getpid()}.part")
    with _naming(path):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            yield staged
            sync(staged)
            os.replace(staged, path)
            sync(path.parent)
        finally:
            staged.unlink(missing_ok=True)


def write_folder(path: Path, files: Iterable[tuple[str, bytes]]) -> None:
    """Write a folder of files whole or not at all; one of the same name is replaced.

    Args:
        path: The folder.
        files: Names and contents, in the order in which they are written; a name may begin with
            a folder, as in ``pages/a.html``.

    Where a kill leaves none under the name, `restore_folders` gives it the earlier one.

    Raises:
        WriteError: The disk is full or the folder is not writable.
    """
    staged = path.with_name(f".partial-{path.name}-{os.getpid()}")
    earlier = staged.with_name(f"{staged.name}.earlier")
    with _naming(path):
        try:
            staged.mkdir(parents=True)
            for name, content in files:
                (staged / name).parent.mkdir(exist_ok=True)
                write_staged(staged / name, content)
            for folder in (*filter(Path.is_dir, staged.iterdir()), staged):
                sync(folder)
            with whole():  # a signal between two names would leave none
                _exchange(staged, path, earlier)
            sync(path.parent)
        finally:
            shutil.rmtree(staged, ignore_errors=True)
            if path.is_dir():
                shutil.rmtree(earlier, ignore_errors=True)


def _exchange(staged: Path, path: Path, earlier: Path) -> None:
    """Give a folder its name; one that had it is kept under a third, ``earlier``."""
    try:
        if path.is_dir():  # a full folder cannot be replaced by a rename
            os.rename(path, earlier)
        os.rename(staged, path)
    except BaseException:
        if earlier.is_dir() and not path.exists():
            os.rename(earlier, path)
        raise


def restore_folders(parent: Path) -> None:
    """Give folders their names back that a kill took, between the two renames of `write_folder`.

    Nobody else may write in ``parent`` meanwhile.
    """
    for earlier in parent.glob(".partial-*.earlier"):
        name = earlier.name.removeprefix(".partial-").rpartition("-")[0]
        with suppress(OSError):  # another process was first
            if not (parent / name).exists():
                os.rename(earlier, parent / name)


def remove_folder(path: Path) -> None:
    """Remove a folder so that no part of it is ever found under its name.

    Raises:
        OSError: It is not there, or the folder around it is not writable.
    """
    doomed = path.with_name(f".partial-{path.name}-{os.getpid()}.old")
    os.rename(path, doomed)
    shutil.rmtree(doomed, ignore_errors=True)


def write_staged(path: Path, content: bytes) -> None:
    """Write a file that has not got its name yet, and see that all of it reaches the disk.

    Raises:
        OSError: It does not.
    """
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())
    written = path.stat().st_size
    if written != len(content):
        raise OSError(None, f"found {written} of {len(content)} bytes")


def sync(path: Path) -> None:
    """Bring a file, or the names in a folder, to the disk: they survive a power cut then."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Say of every error which file it was about."""
    try:
        yield
    except OSError as error:
        raise WriteError(error.errno, error.strerror or str(error), str(path)) from error
