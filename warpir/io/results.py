"""The output folder of a run: staged, then put in place with ``run.json`` last.

A folder that contains ``run.json`` holds one complete result. Until all files of a run are staged
the old result is untouched, byte for byte. Then ``run.json`` is removed first and written last, so
a run that is killed in between leaves a folder without ``run.json``; the next run that enters it
removes what was half in place.
"""

import errno
import hashlib
import os
import shutil
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core import signals
from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.atomic import sha256_of, sync, write_staged
from warpir.core.errors import ExitCode, InputError, disk_error, disk_errors
from warpir.core.memory import core_count
from warpir.core.strict_json import json_bytes
from warpir.io.folder_lock import FolderLock, make_folder, no_folder
from warpir.io.images import writers
from warpir.io.unfinished import (
    NEW_PREVIEWS,
    PLAIN_NAME,
    PREVIEWS,
    RUN_JSON,
    STAGING,
    UNFINISHED,
    half_in_place,
    remove_empty_folders,
    remove_unfinished,
    results_in,
    unchanged_files,
)

_OWN_FOLDERS = (*UNFINISHED, "mitsuba")
"""Folders that a run makes."""


class OutputFolder:
    """The folder a run writes: all of it, or nothing.

    A context manager. Files are staged in ``.partial-<pid>/`` inside the folder, so on the same
    file system; leaving the block without an exception renames them into place, ``run.json``
    last. After a failure before that the earlier files are what they were, byte for byte.
    Signals wait while files are put in place (`warpir.core.signals.whole`); ``.lock`` keeps a
    second run out (`warpir.io.folder_lock`).
    """

    def __init__(self, path: str | Path, overwrite: bool = False, is_resumed: bool = False) -> None:
        """Name the folder; nothing is touched before the block is entered.

        Args:
            path: Made when it is not there.
            overwrite: Whether results in it may be replaced.
            is_resumed: Whether a run goes on in it that has shown its first preview there.
        """
        self.path = Path(path)
        self.overwrite = overwrite
        self.is_resumed = is_resumed
        self.staging = self.path / f"{STAGING}{os.getpid()}"
        """On the file system of the results; what lies there is removed at the end."""
        self._lock = FolderLock(self.path)
        self._is_new = False
        self._superseded: list[Path] = []
        self._hashes: dict[str, str] = {}
        self._of_writer = threading.local()  # within `write_together`, what a writer stages
        self._run: dict[str, Any] = {}

    def __enter__(self) -> "OutputFolder":
        """Make and lock the folder; remove what a killed run has left of its staging.

        Raises:
            InputError: Locked or holding results (exit 7), or not writable (exit 5).
        """
        self._refuse_name()
        self._is_new = make_folder(self.path)
        try:
            self._lock.take()
            self._refuse_links()
            self._remove_staging()
            self._refuse_results()
            if not self._holds_a_result():
                self._show_previews()  # of a run that was killed while it was put in place
            self.staging.mkdir()
        except BaseException as error:
            self._release()
            if isinstance(error, OSError):
                raise disk_error(error.filename or self.path, error) from error
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Move the staged files into place, or on an exception remove them."""
        is_complete = False
        try:
            with signals.whole():
                try:
                    if kind is None:
                        self._commit()
                        is_complete = True
                finally:
                    if self._lock.is_held():
                        with suppress(OSError):  # then the next run removes it
                            self._remove_staging()
                    shutil.rmtree(self.staging, ignore_errors=True)
                    self._release()
        except signals.Stopped as stopped:
            if is_complete:
                stopped.kept = f"the results in {self.path} are complete"
            raise

    def check(self) -> None:
        """Find what would keep a run out of the folder; nothing is made, and nothing is left.

        Raises:
            InputError: As on entering the block.
        """
        self._refuse_name()
        with disk_errors(self.path):
            nearest = self.path.absolute()
            while not _is_there(nearest):
                nearest = nearest.parent
            if not nearest.is_dir():
                raise no_folder(self.path)
            if not os.access(nearest, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, f"no permission to write in {nearest}")
            if nearest == self.path.absolute():
                self._lock.refuse_held()
                self._refuse_links()
                self._refuse_results()

    def supersede(self, folder: Path) -> None:
        """Remove a folder as soon as the results are in place; until then it is needed."""
        self._superseded.append(folder)

    @property
    def hashes(self) -> dict[str, str]:
        """sha256 of what is staged so far, by its name."""
        return dict(self._hashes)

    def sizes(self) -> dict[str, int]:
        """Return the sizes of what is staged so far [byte], by its name."""
        return {name: (self.staging / name).stat().st_size for name in self._hashes}

    # What is written. Each writer ends in `write_bytes`.

    def write_bytes(self, name: str, content: bytes) -> None:
        """Stage one file and see that all of it reached the disk.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        if not PLAIN_NAME.fullmatch(name):
            raise ValueError(f"not a plain file name: {name!r}")
        path = self.staging / name
        with disk_errors(self.path / name):
            path.parent.mkdir(exist_ok=True)
            write_staged(path, content)
        hashes = getattr(self._of_writer, "hashes", self._hashes)
        if hashes is not self._hashes:
            signals.check()  # a signal interrupts the main thread only, which waits for this one
        hashes[name] = hashlib.sha256(content).hexdigest()

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Stage a JSON file; ``run.json`` gets the sha256 of all others and is written last.

        Raises:
            ValueError: A number is not finite.
        """
        if name == RUN_JSON:
            self._run = dict(content)
            json_bytes(self._run, _plain)
        else:
            self.write_bytes(name, json_bytes(content, _plain))

    def write_png(
        self,
        name: str,
        codes: PixelArray,
        *,
        icc: bytes | None = None,
        mark: bool = True,
        description: str = "",
    ) -> None:
        """Stage a PNG; see `writers.png_bytes`."""
        self.write_bytes(name, writers.png_bytes(codes, icc, mark, description))

    def write_preview(self, step: int, codes: PixelArray, icc: bytes | None = None) -> Path:
        """Write a picture of the way to the result, at once and outside of what is staged.

        Args:
            step: Of the optimisation; 0 is its start.
            codes: As of `writers.png_bytes`.
            icc: Profile the codes are in.

        Returns:
            The file, in ``progress/``, or ``progress-new/`` while an earlier result stands; never
            seen half written.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        # A run that was killed while it replaced the earlier result has left its own there. One
        # that was killed after it, before its checkpoints were gone, goes on beside its own result.
        is_new = self._holds_a_result() and not self.is_resumed
        folder = NEW_PREVIEWS if is_new or (self.path / NEW_PREVIEWS).is_dir() else PREVIEWS
        path = self.path / folder / f"preview-{step:06d}.png"
        staged = self.staging / path.name
        with disk_errors(path):
            path.parent.mkdir(exist_ok=True)
            write_staged(staged, writers.png_bytes(codes, icc, level=1))
            os.replace(staged, path)
        return path

    def write_exr(
        self, name: str, channels: Mapping[str, PixelArray], header: Mapping[str, Any] | None = None
    ) -> None:
        """Stage an EXR; see `writers.exr_bytes`."""
        self.write_bytes(name, writers.exr_bytes(self.path / name, channels, header))

    def write_hdr(self, name: str, texels: FloatArray) -> None:
        """Stage a Radiance file; see `writers.hdr_bytes`."""
        self.write_bytes(name, writers.hdr_bytes(self.path / name, texels, self.staging))

    def write_envmap(self, texels: FloatArray, stem: str = "envmap") -> None:
        """Stage an environment map: ``.exr`` (float32), ``.hdr`` (RGBE) and ``_preview.png``.

        Texels are radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].

        Raises:
            InputError: A value is negative or not finite (exit 6), or the disk is full (exit 5).
        """
        exr = f"{stem}.exr"
        self.write_bytes(exr, writers.envmap_exr_bytes(self.path / exr, texels))
        self.write_hdr(f"{stem}.hdr", np.ascontiguousarray(texels, dtype=np.float32))
        self.write_png(
            f"{stem}_preview.png",
            writers.envmap_preview(texels),
            mark=False,
            description="Preview: rolled by half its width, so that -Z is in the "
            "middle; scaled and clipped to 8 bits",
        )

    def write_together(self, *writers: Callable[[], Any]) -> list[Any]:
        """Call writers side by side, one per core, and return what they return.

        Their files are listed, and the first error is raised, in the writers' order, when all have
        ended: nothing is staged behind a signal, which ends each of them with the file it is at.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
            signals.Stopped: A signal came.
        """

        def call(writer: Callable[[], Any]) -> tuple[Any, dict[str, str]]:
            self._of_writer.hashes = hashes = dict[str, str]()
            return writer(), hashes

        with ThreadPoolExecutor(core_count()) as pool:
            futures = [pool.submit(call, writer) for writer in writers]
            # A signal that comes just before a wait begins does not end it, so none is long.
            while wait(futures, timeout=0.05).not_done:
                pass
            done = [future.result() for future in futures]
        for _, hashes in done:
            self._hashes |= hashes
        return [result for result, _ in done]

    # What keeps a run out.

    def _refuse_name(self) -> None:
        fault = ""
        if os.path.realpath(self.path) == os.path.realpath("/"):
            fault = f"{self.path} is the root of the file system"
        try:
            str(self.path).encode()
        except UnicodeEncodeError:
            fault = f"{str(self.path)!a} is not a name in UTF-8"
        if fault:
            raise InputError("--out", fault, code=ExitCode.USAGE)

    def _refuse_links(self) -> None:
        """Refuse links in place of the folders that a run makes: they lead out of this one."""
        for name in _OWN_FOLDERS:
            if (self.path / name).is_symlink():
                what = "a link in place of a folder of its own"
                raise InputError(self.path / name, what, "remove it", ExitCode.OUTPUT)

    def _refuse_results(self) -> None:
        """Refuse a folder in use; hidden files and an unfinished run's do not count as results."""
        found = results_in(self.path)
        if found and not self.overwrite:
            shown = RUN_JSON if RUN_JSON in found else found[0]
            more = f" and {len(found) - 1} more" if len(found) > 1 else ""
            raise InputError(
                self.path,
                f"already holds files (found {shown}{more}; expected an empty folder)",
                "pass --overwrite to replace results",
                ExitCode.OUTPUT,
                reason="output.holds_files",
                found=found,
            )

    def _require_whole(self) -> None:
        """Check that the folder is still ours and that what was staged is still there.

        Raises:
            InputError: The lock was deleted and another run may have come in, or a file has come
                (exit 7), or a staged file has changed or cannot get its name (exit 5).
        """
        if not self._lock.is_held():
            raise InputError(
                self._lock.path,
                "deleted while the run was under way: another run may write here",
                "choose another --out; what was there is left as it is",
                ExitCode.OUTPUT,
                reason="output.lock_deleted",
            )
        for name in (RUN_JSON, *self._hashes):
            target = self.path / name
            if not self.overwrite and os.path.lexists(target):
                what = "came while the run was under way"
                advice = "pass --overwrite to replace it"
                raise InputError(target, what, advice, ExitCode.OUTPUT, reason="output.holds_files")
            if target.is_dir() and not target.is_symlink():
                raise InputError(target, "a folder in place of a file", code=ExitCode.RESOURCES)
            if target.parent != self.path and target.parent.is_symlink():
                what = "a link in place of a folder of its own"
                raise InputError(target.parent, what, "remove it", ExitCode.RESOURCES)
        for name, digest in self._hashes.items():
            with disk_errors(self.staging / name):
                found = sha256_of(self.staging / name)
            if found != digest:
                what = "changed by somebody else before the run was complete"
                raise InputError(self.staging / name, what, code=ExitCode.RESOURCES)

    # How it is put in place.

    def _commit(self) -> None:
        """Replace the old result by the new one.

        Raises:
            InputError: As of `_require_whole`; or a file cannot be moved (exit 5), and then the
                folder is left without ``run.json``.
        """
        self._require_whole()
        names = sorted(self._hashes)
        old = unchanged_files(self.path / RUN_JSON, self.path)
        leftover = [name for name in old if name not in self._hashes]
        run = {**self._run, "files": dict(self._hashes)}
        with disk_errors(self.path / "results"):
            write_staged(self.staging / RUN_JSON, json_bytes(run, _plain))
            for folder in {(self.staging / name).parent for name in names} | {self.staging}:
                sync(folder)
            self._put_in_place(names, leftover)
        for folder in self._superseded:
            with suppress(OSError):  # nothing but room is lost when it stays
                remove_unfinished(folder)
        remove_empty_folders(self.path, leftover)

    def _put_in_place(self, names: list[str], leftover: list[str]) -> None:
        """Remove ``run.json`` and what only the old result had; move the new files in.

        Raises:
            OSError: A file cannot be removed or moved.
        """
        (self.path / RUN_JSON).unlink(missing_ok=True)
        sync(self.path)  # nothing is mixed under its name, not by a power cut
        self._show_previews()
        for name in leftover:
            (self.path / name).unlink()
        for name in names:
            (self.path / name).parent.mkdir(exist_ok=True)
            os.replace(self.staging / name, self.path / name)
        for folder in {(self.path / name).parent for name in names} | {self.path}:
            sync(folder)
        os.replace(self.staging / RUN_JSON, self.path / RUN_JSON)
        sync(self.path)

    def _holds_a_result(self) -> bool:
        return (self.path / RUN_JSON).exists()

    def _show_previews(self) -> None:
        """Put the previews of a run that replaces an earlier result in place of the earlier ones.

        All in one step: a run that is killed here and goes on must know whose previews it sees.

        Raises:
            OSError: A file cannot be removed or moved.
        """
        new, shown = self.path / NEW_PREVIEWS, self.path / PREVIEWS
        if new.is_dir():
            remove_unfinished(shown)
            if not shown.is_dir():
                os.replace(new, shown)
                return
            # It holds what is not ours, and stays.
            for preview in sorted(new.iterdir()):
                os.replace(preview, shown / preview.name)
            new.rmdir()

    def _remove_staging(self) -> None:
        """Remove what was staged, here or by a killed run, and what of it is half in place."""
        names = half_in_place(self.path)
        for name in names:
            (self.path / name).unlink()
        remove_empty_folders(self.path, names)
        for abandoned in self.path.glob(f"{STAGING}*"):  # of killed runs: the lock is ours
            shutil.rmtree(abandoned, ignore_errors=True)

    def _release(self) -> None:
        self._lock.release()
        if self._is_new:
            with suppress(OSError):
                self.path.rmdir()  # only succeeds when nothing was written


def _is_there(path: Path) -> bool:
    """Return whether anything has this name; unlike `os.path.lexists`, an unusable one raises."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def _plain(value: Any) -> Any:
    """Return NumPy's scalars and arrays, and paths, as JSON holds them."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} does not belong in JSON")
