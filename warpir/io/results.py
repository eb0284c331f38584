"""Every file that is written: one staged folder, whole or not at all.

`OutputFolder` stages everything and renames at the end, `run.json` last. What is read is in
`warpir.io.images.photos`. The image libraries are imported inside the functions that need them, to
keep start-up short.
"""

import errno
import fcntl
import hashlib
import io
import json
import os
import re
import shutil
import socket
import stat
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import warpir
from warpir.core import color
from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.atomic import remove_folder, sync, write_staged
from warpir.core.errors import ExitCode, InputError, disk_error
from warpir.core.limits import LIMITS
from warpir.core.signals import Stopped, whole
from warpir.core.strict_json import read_json_object
from warpir.io.images.decoder import decode_image, library_error, read_exr_channels
from warpir.scene.camera import Camera, exr_matrices

UNFINISHED = {
    "checkpoints": re.compile(r"[0-9]{6,}-[a-z-]+-[0-9]+|\.partial-.*"),
    "progress": re.compile(r"preview-[0-9]{6,}\.png"),
}
"""Folders of an output folder that hold what a run needs, or shows, before it has results."""

HALF_MAX = 65504.0
"""Largest finite half-precision number."""

BACKGROUND_DEPTH = 1e10
"""``Z`` where no object is [m]."""

_PLAIN_NAME = re.compile(r"(?:[A-Za-z0-9][A-Za-z0-9_.-]{0,99}/)?[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
"""A file, or a file in a folder of the output folder."""
_RUN_JSON = "run.json"
_OWN_LOCK = re.compile(rb"(?:[0-9]+ on [^\n]*\n?)?")
"""What a lock file holds; empty while it is being written."""
_READY = ".ready"
"""Folder of a complete result that is being put in place of an old one, in the output folder."""
_MADE = ("mitsuba",)
"""Folders of the results themselves."""
_OLD, _JOURNAL = ".old", ".journal.json"
"""In that folder: the files of the old result, and the names of what is moved in and out."""

_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about=""
    xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/">
   <Iptc4xmpExt:DigitalSourceType>\
http://cv.iptc.org/newscodes/digitalsourcetype/compositeSynthetic\
</Iptc4xmpExt:DigitalSourceType>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


class OutputFolder:
    """The folder a run writes: all of it, or nothing.

    A context manager. Files are staged in ``.partial-<pid>/`` inside the folder, so on the same
    file system; leaving the block without an exception renames them into place, ``run.json``
    last. A folder with ``run.json`` therefore holds a complete result, and after a failure the
    earlier files are what they were, byte for byte. ``.lock`` keeps a second run out; the
    kernel releases it with the process, so it is never stale.

    The one rename of the staging folder to ``.ready/`` decides: a process that is killed before it
    leaves the old result, and for one that is killed after it the next run that enters the folder
    puts the rest in place. Signals wait meanwhile (`warpir.core.signals.whole`).
    """

    def __init__(self, path: str | Path, overwrite: bool = False) -> None:
        """Name the folder; nothing is touched before the block is entered.

        Args:
            path: The folder; made when missing.
            overwrite: Whether results that are already there are replaced.
        """
        self.path = Path(path)
        self.overwrite = overwrite
        self.staging = self.path / f".partial-{os.getpid()}"
        """On the file system of the results; what lies there is removed at the end."""
        self._lock = -1
        self._made = False
        self._superseded: list[Path] = []
        self._hashes: dict[str, str] = {}
        self._run: dict[str, Any] = {}

    def __enter__(self) -> "OutputFolder":
        """Make and lock the folder; finish what a killed run had ready.

        Raises:
            InputError: Locked or holding results (exit 7), or not writable (exit 5).
        """
        self._make()
        try:
            self._take_lock()
            self._refuse_links()
            for abandoned in self.path.glob(".partial-*"):  # of killed runs: the lock is ours
                shutil.rmtree(abandoned, ignore_errors=True)
            was_ready = self._finish_earlier()
            self._refuse_results(was_ready)
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
            with whole():
                try:
                    if kind is None:
                        self._commit()
                        is_complete = True
                finally:
                    shutil.rmtree(self.staging, ignore_errors=True)
                    self._release()
        except Stopped as stopped:
            if is_complete:
                stopped.kept = f"the results in {self.path} are complete"
            raise

    def check(self) -> None:
        """Find what would keep a run out of the folder; nothing is made, and nothing is left.

        Raises:
            InputError: As on entering the block.
        """
        self._refuse_name()
        try:
            found = self.path.absolute()
            while not _is_there(found):
                found = found.parent
            if not found.is_dir():
                raise self._no_folder()
            if not os.access(found, os.W_OK | os.X_OK):
                raise PermissionError(errno.EACCES, f"no permission to write in {found}")
            if found == self.path.absolute():
                self._refuse_locked()
                self._refuse_links()
                self._refuse_results(is_ready(self.path))
        except OSError as error:
            raise disk_error(self.path, error) from error

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

    # What is written. Each writer ends in `write_bytes` or does the same checks.

    def write_bytes(self, name: str, content: bytes) -> None:
        """Stage one file and see that all of it reached the disk."""
        path = self._staged(name)
        try:
            write_staged(path, content)
        except OSError as error:
            raise disk_error(self.path / name, error) from error
        self._hashes[name] = hashlib.sha256(content).hexdigest()

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Stage a JSON file; ``run.json`` gets the sha256 of all others and is written last.

        Raises:
            ValueError: A number is not finite.
        """
        if name == _RUN_JSON:
            self._run = dict(content)
            _json_bytes(self._run)
        else:
            self.write_bytes(name, _json_bytes(content))

    def write_png(
        self,
        name: str,
        codes: PixelArray,
        *,
        icc: bytes | None = None,
        mark: bool = True,
        description: str = "",
    ) -> None:
        """Stage a PNG.

        Args:
            name: File name inside the folder.
            codes: uint8 or uint16, shape [H, W, 3], or [H, W] for grey.
            icc: Profile the codes are in; sRGB is stated when absent.
            mark: Whether to say in XMP that the picture is a composite (IPTC digital source
                type ``compositeSynthetic``).
            description: Text for the ``Description`` field.
        """
        self.write_bytes(name, png_bytes(codes, icc, mark, description))

    def write_preview(self, step: int, codes: PixelArray, icc: bytes | None = None) -> Path:
        """Write a picture of the way to the result, at once and outside of what is staged.

        Args:
            step: Of the optimisation; 0 is its start.
            codes: As of `write_png`.
            icc: Profile the codes are in.

        Returns:
            The file, in ``progress/``; never seen half written.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        path = self.path / "progress" / f"preview-{step:06d}.png"
        staged = self.staging / path.name
        try:
            path.parent.mkdir(exist_ok=True)
            write_staged(staged, png_bytes(codes, icc, False, ""))
            os.replace(staged, path)
        except OSError as error:
            raise disk_error(path, error) from error
        return path

    def write_exr(
        self, name: str, channels: Mapping[str, PixelArray], header: Mapping[str, Any] | None = None
    ) -> None:
        """Stage a single-part scanline EXR with ZIP compression.

        Args:
            name: File name inside the folder.
            channels: One plane per full channel name (``shadow.R``), shape [H, W]; float16
                planes become half channels, float32 planes float channels.
            header: Attributes; text, numbers, tuples, or float32 arrays for matrices.

        Raises:
            InputError: A value is not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        planes = {}
        for channel, plane in channels.items():
            if plane.dtype not in (np.float16, np.float32) or plane.ndim != 2:
                raise ValueError(
                    f"{channel}: float16 or float32 planes [H, W] are needed, got "
                    f"{plane.dtype} {plane.shape}"
                )
            bad = int(plane.size - np.isfinite(plane).sum())
            if bad:
                raise InputError(
                    self.path / name,
                    f"channel {channel} is not finite (found {bad} bad values)",
                    code=ExitCode.NUMERIC,
                )
            planes[channel] = np.ascontiguousarray(plane)
        attributes: dict[str, Any] = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
        }
        for key, value in (header or {}).items():
            # OpenEXR reads a matrix's memory in order, whatever its strides say.
            is_array = isinstance(value, np.ndarray)
            attributes[key] = np.ascontiguousarray(value) if is_array else value
        # In memory first: a stream cannot run full, and the size to check is known.
        stream = io.BytesIO()
        OpenEXR.File(attributes, planes).write(stream)
        self.write_bytes(name, stream.getvalue())

    def write_envmap(self, texels: FloatArray, stem: str = "envmap") -> None:
        """Stage an environment map: ``.exr`` (float32), ``.hdr`` (RGBE) and ``_preview.png``.

        Args:
            texels: Radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].
            stem: First part of the names.

        Raises:
            InputError: A value is negative or not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        if texels.ndim != 3 or texels.shape[2] != 3 or texels.shape[1] != 2 * texels.shape[0]:
            raise ValueError(f"texels [He, 2 He, 3] are needed, got {texels.shape}")
        if not bool((np.isfinite(texels) & (texels >= 0.0)).all()):
            raise InputError(
                self.path / f"{stem}.exr",
                "the light is negative or not finite",
                code=ExitCode.NUMERIC,
            )
        texels = np.ascontiguousarray(texels, dtype=np.float32)
        self.write_exr(
            f"{stem}.exr",
            {c: texels[..., k] for k, c in enumerate("RGB")},
            {**_color_header(), "envmap": OpenEXR.ENVMAP_LATLONG},
        )
        self.write_hdr(f"{stem}.hdr", texels)
        # A person expects the viewing direction -Z, our seam, in the middle.
        seen = np.roll(texels, texels.shape[1] // 2, axis=1)
        white = float(np.percentile(color.luminance(seen), 95.0)) / 0.8
        shown = color.linear_to_srgb(np.clip(seen / np.float32(white or 1.0), 0.0, 1.0))
        self.write_png(
            f"{stem}_preview.png",
            np.round(shown * 255.0).astype(np.uint8),
            mark=False,
            description="Preview: rolled by half its width, so that -Z is in the "
            "middle; scaled and clipped to 8 bits",
        )

    def write_hdr(self, name: str, texels: FloatArray) -> None:
        """Stage a Radiance file; the library's last flush is unchecked, so it is read back.

        Args:
            name: File name inside the folder.
            texels: Finite and not negative, shape [height, width, 3].

        Raises:
            InputError: The disk is full (exit 5).
        """
        import OpenImageIO as oiio

        path = self._staged(name)
        height, width = texels.shape[:2]
        spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
        spec.attribute("DateTime", "")
        writer = oiio.ImageOutput.create(str(path))
        assert writer is not None, "OpenImageIO is built with Radiance HDR"
        done = writer.open(str(path), spec) and writer.write_image(texels)
        text = library_error(writer)
        done = writer.close() and done and not text
        try:
            if not done:
                raise InputError(path, text)
            decode_image(path, width * height, kinds=("hdr",))
            with path.open("rb+") as stream:
                os.fsync(stream.fileno())
                self._hashes[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except InputError as error:  # its text is the library's, and names a staged file
            what, advice = "written incompletely", "free some disk space"
            raise InputError(self.path / name, what, advice, ExitCode.RESOURCES) from error
        except OSError as error:
            raise disk_error(self.path / name, error) from error

    # How it is kept whole.

    def _staged(self, name: str) -> Path:
        """Return where a file is staged; names are ours, never a path that leads out."""
        if not _PLAIN_NAME.fullmatch(name):
            raise ValueError(f"not a plain file name: {name!r}")
        path = self.staging / name
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise disk_error(self.path / name, error) from error
        return path

    def _make(self) -> None:
        self._refuse_name()
        try:
            self._made = not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            self._made = False
            raise self._no_folder() from error
        except OSError as error:
            self._made = False
            raise InputError(
                self.path, f"cannot be made ({error.strerror})", code=ExitCode.RESOURCES
            ) from error

    def _refuse_name(self) -> None:
        if os.path.realpath(self.path) == os.path.realpath("/"):
            raise InputError(
                "--out", f"{self.path} is the root of the file system", code=ExitCode.USAGE
            )
        try:
            str(self.path).encode()
        except UnicodeEncodeError:
            raise InputError(
                "--out", f"{str(self.path)!a} is not a name in UTF-8", code=ExitCode.USAGE
            ) from None

    def _no_folder(self) -> InputError:
        return InputError(
            self.path,
            "not a folder (found a file in its place)",
            "choose another --out",
            ExitCode.OUTPUT,
        )

    def _refuse_locked(self) -> None:
        """Refuse a folder that a run writes now; the lock is tried, not kept."""
        try:
            lock = self._open_lock(os.O_RDONLY)
        except FileNotFoundError:
            return
        try:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise self._locked(lock) from error
        finally:
            os.close(lock)

    def _open_lock(self, flags: int) -> int:
        """Open the lock file.

        Raises:
            OSError: It cannot be opened.
            InputError: It is something else, which a lock would not work on.
        """
        path = self.path / ".lock"
        # A FIFO would wait for somebody at its other end.
        lock = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK, 0o644)
        if not stat.S_ISREG(os.fstat(lock).st_mode):
            os.close(lock)
            raise self._no_lock()
        return lock

    def _no_lock(self) -> InputError:
        what, advice = "not a lock of warpir's", "choose another --out"
        return InputError(self.path / ".lock", what, advice, ExitCode.OUTPUT)

    def _locked(self, lock: int) -> InputError:
        """Make the error of a folder whose lock another process holds."""
        holder = os.read(lock, 200).decode("utf-8", "replace").strip() or "unknown"
        return InputError(
            self.path,
            f"locked by pid {holder}",
            "wait for that run, or choose another --out",
            ExitCode.OUTPUT,
        )

    def _take_lock(self) -> None:
        path = self.path / ".lock"
        while True:
            try:
                lock = self._open_lock(os.O_RDWR | os.O_CREAT)
            except OSError as error:
                raise disk_error(path, error) from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_ino == os.stat(path).st_ino:
                    break  # else the holder before us removed this file after we opened it
                os.close(lock)
            except FileNotFoundError:
                os.close(lock)
            except BlockingIOError as error:
                locked = self._locked(lock)
                os.close(lock)
                raise locked from error
            except OSError as error:
                os.close(lock)
                raise disk_error(path, error) from error
        if not _OWN_LOCK.fullmatch(os.read(lock, 200)):
            os.close(lock)
            raise self._no_lock()
        self._lock = lock
        try:
            os.lseek(lock, 0, os.SEEK_SET)
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()} on {socket.gethostname()}\n".encode())
        except OSError as error:
            raise disk_error(path, error) from error

    def _release(self) -> None:
        if self._lock >= 0:
            if self._holds_lock():  # else it is another run's
                with suppress(OSError):
                    (self.path / ".lock").unlink()
            os.close(self._lock)
            self._lock = -1
        if self._made:
            with suppress(OSError):
                self.path.rmdir()  # only succeeds when nothing was written

    def _refuse_links(self) -> None:
        """Refuse links in place of the folders that a run makes: they lead out of this one."""
        for name in (*UNFINISHED, *_MADE, _READY):
            if (self.path / name).is_symlink():
                what = "a link in place of a folder of its own"
                raise InputError(self.path / name, what, "remove it", ExitCode.OUTPUT)

    def _refuse_results(self, was_ready: bool) -> None:
        """Refuse a folder in use; hidden files and an unfinished run's do not count as results."""
        found = results_in(self.path)
        if found and not self.overwrite:
            shown = _RUN_JSON if _RUN_JSON in found else found[0]
            of_whom = ", all of a run that was killed in its last moment" if was_ready else ""
            raise InputError(
                self.path,
                f"already holds files (found {shown}"
                f"{f' and {len(found) - 1} more' if len(found) > 1 else ''}{of_whom}; "
                "expected an empty folder)",
                "pass --overwrite to replace results",
                ExitCode.OUTPUT,
            )

    def _commit(self) -> None:
        """Replace the old result by the new one; undo all of it if a step fails."""
        self._require_whole()
        names = sorted(self._hashes)
        leftover = [name for name in self._old_results() if name not in self._hashes]
        self.write_bytes(_RUN_JSON, _json_bytes({**self._run, "files": dict(self._hashes)}))
        ready = self.path / _READY
        try:
            journal = _json_bytes({"new": names, "leftover": leftover})
            write_staged(self.staging / _JOURNAL, journal)
            (self.staging / _OLD).mkdir()
            for folder in {(self.staging / name).parent for name in names} | {self.staging}:
                sync(folder)
            os.rename(self.staging, ready)
        except OSError as error:
            raise disk_error(self.path / "results", error) from error
        try:
            self._put_in_place()
        except BaseException:
            if not any(path.is_file() for path in (ready / _OLD).rglob("*")):
                with suppress(OSError):  # where it stays, the next run goes on with it
                    os.rename(ready, self.staging)
            raise
        for folder in self._superseded:
            with suppress(OSError):  # nothing but room is lost when it stays
                remove_unfinished(folder)
        shutil.rmtree(ready, ignore_errors=True)

    def _require_whole(self) -> None:
        """See that the folder is still ours and that what was staged is still there.

        Raises:
            InputError: The lock was deleted and another run may have come in (exit 7), or a staged
                file has changed (exit 5).
        """
        if not self._holds_lock():
            raise InputError(
                self.path / ".lock",
                "deleted while the run was under way: another run may write here",
                "choose another --out; what was there is left as it is",
                ExitCode.OUTPUT,
            )
        there = [n for n in (_RUN_JSON, *self._hashes) if os.path.lexists(self.path / n)]
        if there and not self.overwrite:
            raise InputError(
                self.path / there[0],
                "came while the run was under way",
                "pass --overwrite to replace it",
                ExitCode.OUTPUT,
            )
        for name, digest in self._hashes.items():
            try:
                with (self.staging / name).open("rb") as stream:
                    found = hashlib.file_digest(stream, "sha256").hexdigest()
            except OSError as error:
                raise disk_error(self.staging / name, error) from error
            if found != digest:
                raise InputError(
                    self.staging / name,
                    "changed by somebody else before the run was complete",
                    code=ExitCode.RESOURCES,
                )

    def _holds_lock(self) -> bool:
        try:
            return os.fstat(self._lock).st_ino == (self.path / ".lock").stat().st_ino
        except OSError:
            return False

    def _finish_earlier(self) -> bool:
        """Put in place what a killed run had ready; return whether there was something."""
        was_ready = is_ready(self.path)
        if was_ready:
            self._put_in_place()
        shutil.rmtree(self.path / _READY, ignore_errors=True)
        return was_ready

    def _put_in_place(self) -> None:
        """Move the old result out and the one in ``.ready/`` in, from wherever that was left.

        Raises:
            InputError: A file cannot be moved; then those that were moved are where they had been.
        """
        ready = self.path / _READY
        journal = read_json_object(ready / _JOURNAL)
        names, leftover = (
            [name for name in journal[part] if _PLAIN_NAME.fullmatch(name)]
            for part in ("new", "leftover")
        )
        moved: list[tuple[Path, Path]] = []

        def move(name: str, source: Path, target: Path) -> None:
            source, target = source / name, target / name
            target.parent.mkdir(exist_ok=True)
            if target.parent != self.path and target.parent.is_symlink():
                raise OSError(None, f"found a link in place of the folder {target.parent.name}")
            if source.is_dir():
                raise OSError(None, f"found a folder in place of {name}")
            source.rename(target)
            moved.append((source, target))

        try:
            sync(self.path)
            for name in (_RUN_JSON, *names, *leftover):
                is_old = name in leftover or (ready / name).exists()
                if is_old and (self.path / name).exists():
                    move(name, self.path, ready / _OLD)
                    if name == _RUN_JSON:  # nothing is mixed under its name, not by a power cut
                        sync(self.path)
            for name in names:
                if (ready / name).exists():
                    move(name, ready, self.path)
            for folder in {(self.path / name).parent for name in names} | {self.path}:
                sync(folder)
            move(_RUN_JSON, ready, self.path)
            sync(self.path)
        except BaseException as error:
            try:
                for source, target in reversed(moved):
                    target.rename(source)
            except OSError as stuck:
                what = "results are half in place: the next run into it finishes that"
                raise disk_error(self.path, stuck, what) from error
            self._remove_empty_folders([*names, *leftover])
            if isinstance(error, OSError):
                raise disk_error(self.path / "results", error) from error
            raise
        self._remove_empty_folders(leftover)

    def _remove_empty_folders(self, names: Iterable[str]) -> None:
        """Remove the folders of files that are gone, as far as nothing else is in them."""
        for folder in {(self.path / name).parent for name in names} - {self.path}:
            with suppress(OSError):
                folder.rmdir()

    def _old_results(self) -> list[str]:
        """Return the files of the result being replaced, as far as nobody has changed them."""
        try:
            listed = read_json_object(self.path / _RUN_JSON).get("files")
        except InputError:
            return []
        unchanged = []
        for name, digest in listed.items() if isinstance(listed, dict) else ():
            path = self.path / name
            if not _PLAIN_NAME.fullmatch(name) or not path.is_file() or path.is_symlink():
                continue
            with suppress(OSError), path.open("rb") as stream:  # what cannot be read stays
                if hashlib.file_digest(stream, "sha256").hexdigest() == digest:
                    unchanged.append(name)
        return unchanged


def results_in(path: Path) -> list[str]:
    """Return the names of what counts as somebody's results in an output folder, sorted.

    Hidden files do not, nor what an unfinished run has left.
    """
    found = []
    for entry in path.iterdir():
        own = UNFINISHED.get(entry.name)
        if own is None or not entry.is_dir():
            found += [] if entry.name.startswith(".") else [entry.name]
        else:
            others = (other for other in entry.iterdir() if not own.fullmatch(other.name))
            found += [f"{entry.name}/{other.name}" for other in others]
    return sorted(found)


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


def _is_there(path: Path) -> bool:
    """Return whether anything has this name; unlike `os.path.lexists`, an unusable one raises."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    return True


def is_ready(path: Path) -> bool:
    """Return whether a killed run had complete results ready in a folder; see `finish_results`."""
    return (path / _READY / _RUN_JSON).exists()  # the last file to leave it


def finish_results(path: Path) -> None:
    """Put results in place that a killed run had ready in a folder; do nothing where none are.

    Raises:
        InputError: The folder is locked (exit 7) or not writable (exit 5).
    """
    if is_ready(path):
        folder = OutputFolder(path)
        folder._take_lock()
        try:
            folder._finish_earlier()
        finally:
            folder._release()


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Keep other runs out of a folder within the block; it is made, and stays.

    Raises:
        InputError: It is locked (exit 7) or not writable (exit 5).
    """
    folder = OutputFolder(path)
    folder._make()
    try:
        folder._take_lock()
        yield
    finally:
        folder._release()


def _json_bytes(content: Mapping[str, Any]) -> bytes:
    """Serialise as strict JSON; NumPy scalars and arrays and paths become plain values."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"{type(value).__name__} does not belong in JSON")

    return (json.dumps(content, indent=2, allow_nan=False, default=plain) + "\n").encode()


def png_bytes(codes: PixelArray, icc: bytes | None, mark: bool, description: str) -> bytes:
    """Serialise a PNG.

    Written out here because Pillow has no 16-bit RGB, and OpenImageIO states sRGB beside any
    profile and adds EXIF.
    """
    if (
        codes.dtype not in (np.uint8, np.uint16)
        or codes.ndim not in (2, 3)
        or (codes.ndim == 3 and codes.shape[2] != 3)
    ):
        raise ValueError(
            f"uint8 or uint16 codes [H, W, 3] or [H, W] are needed, got {codes.dtype} {codes.shape}"
        )
    height, width = codes.shape[:2]
    # Samples are big-endian; each row is preceded by its filter: 2, difference to the row above.
    big_endian = np.ascontiguousarray(codes, dtype=codes.dtype.newbyteorder(">"))
    rows = big_endian.view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])

    def chunk(name: bytes, content: bytes) -> bytes:
        body = name + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(
        ">IIBBBBB", width, height, 8 * codes.dtype.itemsize, 2 if codes.ndim == 3 else 0, 0, 0, 0
    )
    parts = [b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header)]
    if icc is not None:
        parts.append(chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(icc)))
    else:
        parts.append(chunk(b"sRGB", b"\0"))
    texts = {"XML:com.adobe.xmp": _XMP if mark else "", "Description": description}
    for keyword, text in texts.items():
        if text:
            parts.append(chunk(b"iTXt", keyword.encode() + b"\0\0\0\0\0" + text.encode()))
    parts += [chunk(b"IDAT", zlib.compress(filtered.data, 6)), chunk(b"IEND", b"")]
    return b"".join(parts)


def _color_header() -> dict[str, Any]:
    """Return the EXR attributes that state our working space."""
    return {
        "chromaticities": color.REC709_CHROMATICITIES,
        "colorInteropID": "lin_rec709_scene",
        "software": f"warpir {warpir.__version__}",
    }


@dataclass(frozen=True)
class Layers:
    """What ``layers.exr`` holds, all linear Rec.709; buffers that a run has not made are absent."""

    composite: PixelArray
    """``foreground.rgb + (1 - foreground.a) * plate * shadow_ratio`` [1], shape [H, W, 3]."""
    foreground: PixelArray
    """Object alone, premultiplied by coverage [1], shape [H, W, 4]."""
    shadow_ratio: PixelArray
    """Multiplies the plate; 1 where the object changes nothing [1], shape [H, W, 3]."""
    plate: PixelArray
    """Linearised photograph [1], shape [H, W, 3]."""
    matte: PixelArray
    """Object coverage, 0 to 1, shape [H, W]."""
    depth: PixelArray | None = None
    """Distance along the viewing axis [m], infinite on the background, shape [H, W]."""
    position: PixelArray | None = None
    """World position [m], shape [H, W, 3]."""
    normal: PixelArray | None = None
    """World unit normal, shape [H, W, 3]."""
    albedo: PixelArray | None = None
    """Base colour [1], shape [H, W, 3]."""
    roughness: PixelArray | None = None
    """Perceptual roughness [1], shape [H, W]."""
    emission: PixelArray | None = None
    """Part of `foreground` that the object emits [1], shape [H, W, 3]."""
    diffuse: PixelArray | None = None
    """Part of `foreground` reflected diffusely [1], shape [H, W, 3]."""
    specular: PixelArray | None = None
    """Part of `foreground` reflected specularly [1], shape [H, W, 3]."""


_CHANNELS = {
    "composite": ("", "RGB"),
    "foreground": ("fg", "RGBA"),
    "shadow_ratio": ("shadow", "RGB"),
    "plate": ("plate", "RGB"),
    "matte": ("matte", "A"),
    "depth": ("", "Z"),
    "position": ("position", "XYZ"),
    "normal": ("normal", "XYZ"),
    "albedo": ("albedo", "RGB"),
    "roughness": ("roughness", "Y"),
    "emission": ("emission", "RGB"),
    "diffuse": ("diffuse", "RGB"),
    "specular": ("specular", "RGB"),
}
"""Layer and channels that each plane has in ``layers.exr``."""
_WHOLE_FLOATS = {"depth", "position", "normal"}
_DEEP = {"composite", "foreground", "shadow_ratio", "plate"}
"""What is stored as float32: always, and of a photograph of more than 8 bits."""


def _channel_names(plane: str) -> list[str]:
    prefix, suffixes = _CHANNELS[plane]
    return [f"{prefix}.{suffix}" if prefix else suffix for suffix in suffixes]


def read_layers(path: str | Path, max_pixels: int = LIMITS.pixels) -> Layers:
    """Read ``layers.exr`` back, as far as its own precision goes; all planes are float32.

    Args:
        path: A file that `write_layers` made.
        max_pixels: Largest image decoded [px].

    Raises:
        InputError: Missing, too large, truncated, or without the layers that every such file has.
    """
    channels = read_exr_channels(Path(path), max_pixels)
    planes: dict[str, PixelArray] = {}
    for plane in _CHANNELS:
        names = _channel_names(plane)
        if all(name in channels for name in names):
            values = [channels[name] for name in names]
            planes[plane] = np.stack(values, axis=-1) if len(values) > 1 else values[0]
    missing = [f.name for f in fields(Layers) if f.default is MISSING and f.name not in planes]
    if missing:
        wanted = ", ".join(_channel_names(missing[0]))
        raise InputError(path, f"not the layers of a run (found no {wanted})")
    if "depth" in planes:
        planes["depth"] = np.where(planes["depth"] >= BACKGROUND_DEPTH, np.inf, planes["depth"])
    return Layers(**planes)


def write_layers(
    folder: OutputFolder,
    layers: Layers,
    camera: Camera,
    *,
    is_deep: bool = False,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> int:
    """Stage ``layers.exr``: half channels, float32 for depth, position and normal.

    The composite recomposes exactly. Of a photograph of 8 bits the layers hold halves to begin with
    (`warpir.render.composite`), so nothing is lost here, and the composite is stored rounded to
    half. A deeper one has codes that halves cannot tell apart: its composite and its layers are
    float32.

    Args:
        folder: Where.
        layers: The image planes.
        camera: The camera that made them, at their resolution.
        is_deep: Whether the photograph has more than 8 bits (`Photo.is_deep`).
        config: Resolved configuration, kept as JSON in the attribute ``warpir/config``.
        inputs: sha256 of the input files by name, kept as JSON in ``warpir/inputs``.

    Returns:
        How many values were beyond the half range and clamped; for ``run.json``.

    Raises:
        ValueError: Shapes disagree, or the composite is not what its layers compute.
        InputError: A value is not finite (exit 6), or the disk is full (exit 5).
    """
    height, width = camera.height, camera.width
    recomputed = (
        layers.foreground[..., :3]
        + (1.0 - layers.foreground[..., 3:]) * layers.plate * layers.shadow_ratio
    )
    if not np.allclose(layers.composite, recomputed, rtol=2e-3, atol=2e-3, equal_nan=True):
        worst = float(np.nanmax(np.abs(layers.composite - recomputed)))
        raise ValueError(f"composite differs from fg + (1 - a) plate shadow by up to {worst:g}")

    channels: dict[str, PixelArray] = {}
    clamped = 0

    for name in _CHANNELS:
        plane: PixelArray | None = getattr(layers, name)
        if plane is None:
            continue
        if name == "depth":
            plane = np.where(np.isposinf(plane), BACKGROUND_DEPTH, plane)
        plane = plane[..., None] if plane.ndim == 2 else plane
        names = _channel_names(name)
        if plane.shape != (height, width, len(names)):
            expected = (height, width, len(names))
            raise ValueError(f"layer {name}: shape {plane.shape}, expected {expected}")
        is_whole = name in _WHOLE_FLOATS or (is_deep and name in _DEEP)
        if not is_whole:
            clamped += int((np.isfinite(plane) & (np.abs(plane) > HALF_MAX)).sum())
            # NaN and Inf pass through, and the writer refuses them.
            plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
        for k, channel in enumerate(names):
            channels[channel] = plane[..., k].astype(np.float32 if is_whole else np.float16)
    channels["A"] = np.ones((height, width), np.float16)

    world_to_camera, world_to_ndc = exr_matrices(camera)
    folder.write_exr(
        "layers.exr",
        channels,
        {
            **_color_header(),
            "worldToCamera": world_to_camera.astype(np.float32),
            "worldToNDC": world_to_ndc.astype(np.float32),
            "warpir/formula": "RGB = fg.RGB + (1 - fg.A) * plate.RGB * shadow.RGB",
            "warpir/config": json.dumps(config or {}, sort_keys=True, default=str),
            "warpir/inputs": json.dumps(inputs or {}, sort_keys=True),
        },
    )
    return clamped
