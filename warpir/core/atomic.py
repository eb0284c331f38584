"""How a file comes to be: whole under its name, or not at all.

    write_file(path, content)           one file
    with replacing(path) as staged:     one file that a library writes
    write_folder(path, files)           several files that belong together
    Checkpoints(out, identity)          states of a run or training, the newest whole one read back

A name is given by one rename, after the content has reached the disk; until then what had the name
before is what a reader, or the next run, finds. `warpir.io.results.OutputFolder` does the same for
results of several files.

    checkpoints/000003-optimize-150/state.safetensors  tensors, named by their path in the state
    checkpoints/000003-optimize-150/manifest.json      plain values, sha256, what it depends on

Serial numbers of checkpoints increase, so the newest is known without a clock. The previous one is
removed after the newer is complete; nothing is pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError

from warpir.core.errors import InputError, disk_errors
from warpir.core.signals import whole
from warpir.core.strict_json import read_json_object

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 2
"""Version of a checkpoint's layout; others are refused."""
KEPT = 2
"""Number of checkpoints that stay on disk."""
FOLDER = "checkpoints"
STATE, MANIFEST = "state.safetensors", "manifest.json"
UNUSABLE: tuple[type[Exception], ...] = (
    *(InputError, OSError, SafetensorError, RecursionError),
    *(AttributeError, KeyError, TypeError, ValueError),
)
"""Exceptions of reading a damaged checkpoint; the second line for JSON values of other types."""


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


def sha256_of(path: Path) -> str:
    """Return the sha256 of a file, as hexadecimal digits.

    Raises:
        OSError: It cannot be read.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


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


# States of a run or training


@dataclass(frozen=True)
class Checkpoint:
    """A state read from disk."""

    stage: str
    """Part of the run that wrote it, such as ``personalize`` or ``optimize``."""
    step: int
    """Number of finished steps of that part."""
    state: dict[str, Any]
    """Nested tensors and plain values, as passed to `Checkpoints.save`."""


class Checkpoints:
    """The checkpoints of one run or training in its output folder.

    They are known by the run's settings, input hashes and versions, plain values; errors say by
    ``restart`` how a user starts again.
    """

    def __init__(
        self, out: Path, identity: Mapping[str, Any], restart: str = "--overwrite"
    ) -> None:
        self.folder, self.restart = out / FOLDER, restart
        # Through JSON, so that tuples compare equal to what is read back.
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))

    @property
    def newest(self) -> str | None:
        """Name of the newest checkpoint, such as ``000003-optimize-150``."""
        return next(iter(self._names()), None)

    def save(self, stage: str, step: int, state: Mapping[str, Any]) -> None:
        """Write a checkpoint, then remove those that are two older.

        Raises:
            InputError: The disk is full or cannot be written (`ExitCode.RESOURCES`).
        """
        from safetensors.torch import save  # torch: only whether there are any is asked without it

        tensors: dict[str, Tensor] = {}
        plain = _split(state, "", tensors)
        content = save(tensors)
        manifest: dict[str, Any] = {
            "format": FORMAT,
            "stage": stage,
            "step": step,
            "sha256": hashlib.sha256(content).hexdigest(),
            "identity": self.identity,
            "state": plain,
        }
        serial = 1 + max((int(name.split("-")[0]) for name in self._names()), default=0)
        path = self.folder / f"{serial:06d}-{stage}-{step}"
        with disk_errors(self.folder, "a checkpoint cannot be written"), whole():
            self.folder.mkdir(exist_ok=True)
            for abandoned in self.folder.glob(".partial-*"):  # of killed runs: --out is locked
                shutil.rmtree(abandoned)
            text = json.dumps(manifest | {"manifest_sha256": manifest_digest(manifest)})
            write_folder(path, [(STATE, content), (MANIFEST, text.encode())])
            for old in list(self._names())[KEPT:]:
                remove_folder(self.folder / old)

    def load(self, notice: Callable[[str], None]) -> Checkpoint:
        """Return the newest checkpoint that is whole.

        Args:
            notice: Called with a line about each damaged checkpoint that is skipped.

        Raises:
            InputError: There is none, none is whole, or the run has changed; every field that
                differs is named.
        """
        path, found, identity, problems = self._newest_whole()
        self._compare(path, identity)
        for problem in problems:
            notice(f"checkpoint passed over: {problem}")
        return found

    def check(self) -> None:
        """Compare the identity so far with that of the checkpoint to resume from.

        Raises:
            InputError: As `load`; parts that `identity` lacks so far are not compared.
        """
        path, _, identity, _ = self._newest_whole()
        self._compare(path, {key: value for key, value in identity.items() if key in self.identity})

    def _compare(self, path: Path, identity: dict[str, Any]) -> None:
        differing = sorted(_differences(identity, self.identity))
        if differing:
            raise InputError(
                path,
                f"of a run with other inputs or settings ({'; '.join(differing)})",
                f"give the same again, or start the run again with {self.restart}",
            )

    def _newest_whole(self) -> tuple[Path, Checkpoint, dict[str, Any], list[str]]:
        """Return the newest whole checkpoint, its path and identity, and problems of newer ones."""
        from safetensors.torch import load

        problems: list[str] = []
        for name in self._names():
            path = self.folder / name
            try:
                manifest = read_json_object(path / MANIFEST)
                if manifest["format"] != FORMAT:
                    found_format = repr(manifest["format"])[:20]
                    what = f"of another format (found {found_format}; expected {FORMAT})"
                    raise InputError(path, what)
                if manifest.pop("manifest_sha256", None) != manifest_digest(manifest):
                    raise InputError(path / MANIFEST, "its sha256 is not the one that was written")
                content = (path / STATE).read_bytes()
                digest = hashlib.sha256(content).hexdigest()
                if digest != manifest["sha256"]:
                    raise InputError(
                        path / STATE,
                        f"its sha256 is not the one that was written (found {digest}; "
                        f"expected {manifest['sha256']!r:.70})",
                    )
                state = _join(manifest["state"], load(content))
                found = Checkpoint(str(manifest["stage"]), int(manifest["step"]), state)
                return path, found, dict(manifest["identity"]), problems
            except UNUSABLE as error:
                why = error.what if isinstance(error, InputError) else repr(error)
                problems.append(f"{name} cannot be used: {why}")
        if problems:
            advice = f"{self.restart} starts the run again"
            raise InputError(self.folder, "; ".join(problems), advice)
        raise InputError(
            "--resume",
            f"nothing to go on from (no checkpoint in {self.folder})",
            "leave --resume out to start the run",
        )

    def _names(self) -> Iterator[str]:
        """Yield the names of checkpoints, newest first, damaged ones included."""
        found = self.folder.glob("[0-9]*-*-*") if os.path.isdir(self.folder) else ()
        yield from sorted((path.name for path in found), reverse=True)


def manifest_digest(manifest: Mapping[str, Any]) -> str:
    """Return the sha256 of a manifest without its own digest."""
    text = json.dumps(manifest, sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _split(state: Any, place: str, tensors: dict[str, Tensor]) -> Any:
    """Move the tensors of a nested state into ``tensors``; return the rest, plain."""
    if isinstance(state, Mapping):
        return {"mapping": {k: _split(v, f"{place}/{k}", tensors) for k, v in state.items()}}
    if state is None or isinstance(state, str | int | float | list | tuple):
        return {"plain": state}
    # safetensors refuses tensors that share memory.
    tensors[place] = state.detach().cpu().contiguous().clone()
    return {"tensor": place}


def _join(plain: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Undo `_split`; tensors come back on the CPU."""
    if "tensor" in plain:
        return tensors[plain["tensor"]]
    if "mapping" in plain:
        return {k: _join(v, tensors) for k, v in plain["mapping"].items()}
    return plain["plain"]


def _differences(then: Any, now: Any, place: str = "") -> Iterator[str]:
    """Yield the differences of two plain trees, one line a leaf."""
    if isinstance(then, dict) and isinstance(now, dict):
        for key in sorted({*then, *now}):
            one, other = then.get(key, "absent"), now.get(key, "absent")
            yield from _differences(one, other, f"{place}.{key}".lstrip("."))
    elif then != now:
        yield f"{place}: was {_shown(then)}, is {_shown(now)}"


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."  # a sha256 is shown whole
