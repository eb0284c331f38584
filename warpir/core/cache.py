"""Where made things are kept between runs, and what happens where nothing can be kept.

Two caches, and this module alone decides where they are:

    made things       WARPIR_CACHE, else $XDG_CACHE_HOME/warpir, else ~/.cache/warpir
    compiled kernels  warpir/ in Warp's own: WARP_CACHE_PATH, else $XDG_CACHE_HOME/warp, else
                      ~/.cache/warp

A cache makes a run faster and never decides whether it works: one that is not there, cannot be
written or holds junk is replaced by a temporary folder, which is removed at exit, with a notice.
"""

from __future__ import annotations

import atexit
import errno
import fcntl
import hashlib
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from warpir.core.atomic import sha256_of
from warpir.core.errors import ExitCode, InputError

CACHE_BYTES = 4 << 30
"""What a folder of made things may hold; what was used longest ago goes first."""
KERNEL_BYTES = 256 << 20
"""What the cache of compiled kernels may hold; what was used longest ago goes first."""
KERNEL_SUFFIXES = (".o", ".cubin", ".ptx", ".meta")
"""What is loaded of a compiled module; its source stays behind."""

_replaced: dict[Path, Path] = {}
_notices: list[str] = []


def cache_folder(kind: str = "") -> Path:
    """Return the folder for made things, which can be written.

    Args:
        kind: ``lora``, ``class-images`` or ``transport``; empty: the folder of all kinds.

    Raises:
        InputError: There is no folder for temporary files either (`ExitCode.RESOURCES`).
    """
    root = Path("~/.cache/warpir")
    try:
        root = Path(os.environ.get("WARPIR_CACHE") or _users_cache() / "warpir")
        _check(root)
        return root / kind
    except (OSError, RuntimeError) as error:
        why = _reason(error)
    if root not in _replaced:
        _replaced[root] = _temporary("warpir-cache-")
        notice(f"{root}: {why}: what is made is kept for this run only (WARPIR_CACHE)")
    return _replaced[root] / kind


def notice(line: str) -> None:
    """Remember what the user is to be told about a cache, or about the device."""
    if line not in _notices:
        _notices.append(line)


def take_notices() -> tuple[str, ...]:
    """Return what is to be told since the last call."""
    told = tuple(_notices)
    _notices.clear()
    return told


def find_kept(path: Path) -> Path | None:
    """Return the file that `seal` has kept under a name, as far as its sha256 is still its own.

    A damaged one is removed, with a notice: what it held is made again.
    """
    for kept in sorted(path.parent.glob(f"{path.name}.*")):
        try:
            if kept.suffix == f".{sha256_of(kept)}":
                with suppress(OSError):  # a folder that may only be read is used all the same
                    os.utime(kept)
                return kept
            notice(f"{kept}: damaged, made again")
            kept.unlink()
        except OSError:  # gone, or not to be read: made again
            continue
    return None


def seal(path: Path, pattern: str) -> None:
    """Give a file that was written whole its sha256 as part of its name, and make room for it.

    Args:
        path: The file; `find_kept` finds it by this name.
        pattern: Of the names in its folder that count together.

    Raises:
        OSError: It cannot be read or renamed.
    """
    os.rename(path, path.with_name(f"{path.name}.{sha256_of(path)}"))
    make_room(path.parent.glob(pattern), CACHE_BYTES)


def make_room(files: Iterable[Path], limit: int) -> None:
    """Delete the files that were used longest ago until the rest fits ``limit`` [byte]."""
    held = []
    for file in files:
        with suppress(FileNotFoundError):  # another process made room
            held.append((file.stat(), file))
    total = 0
    for status, file in sorted(held, key=lambda entry: entry[0].st_mtime, reverse=True):
        total += status.st_size
        if total > limit:
            file.unlink(missing_ok=True)


class KernelCache:
    """Warp's kernel cache of this process: a private folder into which the kept modules are linked.

    Warp believes its cache: it loads a damaged module, which ends the process or fails, and
    processes that compile at the same time share half-written folders. In a private folder nobody
    else writes, and what is linked into it was compared with the sha256 in its file's name.

    Args:
        version: Warp's, on which compiled modules depend.

    Attributes:
        folder: What Warp is to use.
        store: Where modules are kept, ``<module>/<file>.<sha256>``; None: nowhere.
    """

    def __init__(self, version: str) -> None:
        self.folder = _temporary("warpir-kernels-")
        _sweep(self.folder)
        self.version = version
        self.store: Path | None = None
        try:
            self.store = kernel_store() / version
            damaged = sum(not self._link(file) for file in self._kept())
            _check(self.store)
        except (OSError, RuntimeError) as error:
            where = self.store or "~/.cache/warp"
            notice(f"{where}: {_reason(error)}: kernels are compiled for this run only")
        else:
            if damaged:
                notice(f"{self.store}: {damaged} damaged files were removed and are compiled again")
        atexit.register(self.keep)

    def keep(self) -> None:
        """Keep what was compiled since; a cache that is full or gone takes nothing."""
        if self.store is None:
            return
        try:
            there = {self._place(file) for file in self._kept()}
            base = self.folder / self.version
            new = [file for file in self._compiled() if file.relative_to(base) not in there]
            for file in new:
                self._keep(file)
            if new:
                make_room(self._kept(), KERNEL_BYTES)
        except OSError:  # the run is over and has its result: the next one compiles again
            return

    def _kept(self) -> list[Path]:
        assert self.store is not None
        return sorted(file for file in self.store.glob("*/*") if file.is_file())

    def _place(self, kept: Path) -> Path:
        """Return where Warp looks for a kept file, below its folder."""
        return Path(kept.parent.name, kept.stem)

    def _compiled(self) -> Iterator[Path]:
        """Yield what this process has compiled: what was linked is not a file of its own."""
        for file in sorted((self.folder / self.version).glob("wp_*/*")):
            if file.suffix in KERNEL_SUFFIXES and file.is_file() and not file.is_symlink():
                yield file

    def _link(self, kept: Path) -> bool:
        """Make a kept file visible to Warp; return whether it was whole, else it is removed."""
        if kept.name.startswith("."):  # another process is writing it
            return True
        try:
            is_whole = kept.suffix == f".{sha256_of(kept)}"
        except FileNotFoundError:  # another process made room
            return True
        with suppress(OSError):  # a folder that may only be read is used all the same
            if is_whole:
                os.utime(kept)
            else:
                kept.unlink()
        if not is_whole:
            return False
        place = self.folder / self.version / self._place(kept)
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.is_symlink():
            place.symlink_to(kept.absolute())
        return True

    def _keep(self, file: Path) -> None:
        assert self.store is not None
        content = file.read_bytes()
        name = f"{file.name}.{hashlib.sha256(content).hexdigest()}"
        folder = self.store / file.parent.name
        folder.mkdir(parents=True, exist_ok=True)
        staged = folder / f".{name}.{os.getpid()}"
        try:
            staged.write_bytes(content)
            os.replace(staged, folder / name)
        finally:
            staged.unlink(missing_ok=True)


def kernel_store() -> Path:
    """Return the folder in which compiled kernels are kept, by Warp's version.

    Raises:
        OSError: The home folder is not there.
        RuntimeError: Nobody says where it is.
    """
    own = os.environ.get("WARP_CACHE_PATH")
    return (Path(own) if own else _users_cache() / "warp") / "warpir"


def _users_cache() -> Path:
    """Return the folder of the user's caches.

    Raises:
        OSError: The home folder is not there; it is not ours to make.
        RuntimeError: Nobody says where it is.
    """
    base = os.environ.get("XDG_CACHE_HOME")
    if base:
        return Path(base)
    home = Path.home()
    if not home.is_dir():
        raise FileNotFoundError(errno.ENOENT, "no such home folder", str(home))
    return home / ".cache"


def _check(folder: Path) -> None:
    """Make a folder and write into it and what it holds.

    Raises:
        OSError: That is not possible.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for place in (folder, *(folder / kind for kind in ("lora", "class-images", "transport"))):
        if place == folder or os.path.lexists(place):
            with tempfile.TemporaryFile(dir=place) as probe:
                probe.write(b"0")


def _temporary(prefix: str) -> Path:
    """Return a new folder that is removed at exit.

    Raises:
        InputError: None can be made, or none written to (`ExitCode.RESOURCES`).
    """
    try:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
    except OSError as error:
        what = f"no folder can be made among the temporary files ({_reason(error)})"
        advice = "free some disk space, or name a folder that can be written"
        raise InputError("TMPDIR", what, advice, ExitCode.RESOURCES) from error
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def _sweep(own: Path) -> None:
    """Remove the folders like ``own`` whose processes were killed: their locks are free."""
    lock = os.open(own / ".making", os.O_RDWR | os.O_CREAT, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)  # as long as this process lives
    os.rename(own / ".making", own / ".lock")  # never seen under this name without the lock
    for folder in own.parent.glob("warpir-kernels-*"):
        with suppress(OSError):  # another user's, in use, or being made
            other = os.open(folder / ".lock", os.O_RDWR)
            try:
                fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
            finally:
                os.close(other)


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)
