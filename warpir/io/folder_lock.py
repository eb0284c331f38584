"""Keeps a second run out of an output folder, and inputs out of it.

The lock is on ``.lock`` in the folder; the kernel releases it with the process, so it is never
stale.
"""

import fcntl
import os
import re
import socket
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from warpir.core.errors import ExitCode, InputError, disk_errors

_CONTENT = re.compile(rb"(?:[0-9]+ on [^\n]*\n?)?")
"""What a lock file holds; empty while it is being written."""


class FolderLock:
    """The lock of one folder, which must be there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.path = folder / ".lock"
        self._descriptor = -1

    def take(self) -> None:
        """Take the lock and write into it who holds it.

        Raises:
            InputError: Another process holds it, or the file is not a lock (exit 7), or it cannot
                be written (exit 5).
        """
        with disk_errors(self.path):
            lock = self._take_file()
            self._descriptor = lock
            os.lseek(lock, 0, os.SEEK_SET)
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()} on {socket.gethostname()}\n".encode())

    def _take_file(self) -> int:
        """Return a descriptor of the lock file with the lock on it."""
        while True:
            lock = self._open(os.O_RDWR | os.O_CREAT)
            try:
                self._try(lock, fcntl.LOCK_EX)
                with suppress(FileNotFoundError):
                    # Else the holder before us removed this file after we opened it.
                    if os.fstat(lock).st_ino == os.stat(self.path).st_ino:
                        if not _CONTENT.fullmatch(os.read(lock, 200)):
                            raise self._no_lock()
                        return lock
            except BaseException:
                os.close(lock)
                raise
            os.close(lock)

    def refuse_held(self) -> None:
        """Refuse a folder that a run writes now; the lock is tried, not kept.

        Raises:
            InputError: As of `take`.
        """
        try:
            lock = self._open(os.O_RDONLY)
        except FileNotFoundError:
            return
        try:
            self._try(lock, fcntl.LOCK_SH)
        finally:
            os.close(lock)

    def is_held(self) -> bool:
        """Return whether this process still holds the lock; its file may have been deleted."""
        try:
            return os.fstat(self._descriptor).st_ino == self.path.stat().st_ino
        except OSError:
            return False

    def release(self) -> None:
        """Give the lock up and remove its file; do nothing where it was not taken."""
        if self._descriptor >= 0:
            if self.is_held():  # else it is another run's
                with suppress(OSError):
                    self.path.unlink()
            os.close(self._descriptor)
            self._descriptor = -1

    def _open(self, flags: int) -> int:
        # A FIFO would wait for somebody at its other end.
        lock = os.open(self.path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            os.close(lock)
            raise self._no_lock()
        return lock

    def _try(self, lock: int, kind: int) -> None:
        try:
            fcntl.flock(lock, kind | fcntl.LOCK_NB)
        except BlockingIOError as error:
            holder = os.read(lock, 200).decode("utf-8", "replace").strip() or "unknown"
            raise InputError(
                self.folder,
                f"locked by pid {holder}",
                "wait for that run, or choose another --out",
                ExitCode.OUTPUT,
                reason="output.locked",
                found=holder,
            ) from error

    def _no_lock(self) -> InputError:
        what, advice = "not a lock of warpir's", "choose another --out"
        return InputError(self.path, what, advice, ExitCode.OUTPUT, reason="output.not_a_lock")


def make_folder(path: Path) -> bool:
    """Make an output folder; return whether it was missing.

    Raises:
        InputError: A file is in its place (exit 7), or it cannot be made (exit 5).
    """
    try:
        is_new = not path.exists()
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise no_folder(path) from error
    except OSError as error:
        raise InputError(
            path, f"cannot be made ({error.strerror})", code=ExitCode.RESOURCES
        ) from error
    return is_new


def no_folder(path: Path) -> InputError:
    """Return the error of a file in place of an output folder."""
    return InputError(
        path,
        "not a folder (found a file in its place)",
        "choose another --out",
        ExitCode.OUTPUT,
        reason="output.not_a_folder",
    )


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other runs out of a folder within the block; it is made, and stays.

    Raises:
        InputError: It is locked (exit 7) or not writable (exit 5).
    """
    is_new = make_folder(path)
    lock = FolderLock(path)
    try:
        lock.take()
        yield
    finally:
        lock.release()
        if is_new:
            with suppress(OSError):
                path.rmdir()  # only succeeds when nothing was written


def inputs_within(out: str | None, *paths: str | Path) -> list[InputError]:
    """Return an error for the first path that is the output folder or below it, by links too."""
    if out is None:
        return []
    folder = _places(out)[:1]
    if not folder or folder[0] == folder[0].parent:
        return []  # no name, or the root: the output folder refuses it
    for path in paths:
        if any(place.is_relative_to(folder[0]) for place in _places(path)):
            what, advice = f"holds the input {path}", "choose a folder of its own"
            return [InputError("--out", what, advice, ExitCode.USAGE)]
    return []


def _places(path: str | Path) -> list[Path]:
    """Return where a path leads, and where it lies itself if it is a link: either can be replaced.

    None for what no file can be called; its reader reports it.
    """
    folder, name = os.path.split(os.path.abspath(path))
    try:
        return [Path(os.path.realpath(path)), Path(os.path.realpath(folder), name)]
    except ValueError:
        return []
