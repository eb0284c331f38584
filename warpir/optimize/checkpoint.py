"""Checkpoints of a run: safetensors and JSON, written atomically and bound to the run's inputs.

    checkpoints/000003-optimize-150/state.safetensors  tensors, named by their path in the state
    checkpoints/000003-optimize-150/manifest.json      plain values, sha256, what it depends on

A checkpoint is built under a temporary name, its manifest last, and renamed once. Serial numbers
increase, so the newest is known without a clock. The previous one is removed after the newer is
complete; nothing is pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import SafetensorError

from warpir.app.program import say
from warpir.app.settings import OutputConfig
from warpir.core.atomic import remove_folder, write_folder
from warpir.core.errors import ExitCode, InputError, disk_error
from warpir.core.signals import Stopped, is_pending, whole
from warpir.core.strict_json import read_json_object
from warpir.io.results import OutputFolder, remove_unfinished

if TYPE_CHECKING:
    from torch import Tensor

FORMAT = 2
"""Version of the layout; others are refused."""
KEPT = 2
"""Number of checkpoints that stay on disk."""
FOLDER = "checkpoints"
UNUSABLE: tuple[type[Exception], ...] = (
    *(InputError, OSError, SafetensorError, RecursionError),
    *(AttributeError, KeyError, TypeError, ValueError),
)
"""Exceptions of reading a damaged checkpoint; the second line for JSON values of other types."""
STATE, MANIFEST = "state.safetensors", "manifest.json"


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
    """The checkpoints of one run in its output folder.

    Args:
        out: The output folder.
        identity: Settings, input hashes and versions of the run; plain values.
    """

    def __init__(self, out: Path, identity: Mapping[str, Any]) -> None:
        self.folder = out / FOLDER
        # Through JSON, so that tuples compare equal to what is read back.
        self.identity: dict[str, Any] = json.loads(json.dumps(identity))

    @property
    def newest(self) -> str | None:
        """Name of the newest checkpoint, such as ``000003-optimize-150``."""
        return next(iter(self._names()), None)

    def save(self, stage: str, step: int, state: Mapping[str, Any]) -> None:
        """Write a checkpoint, then remove those that are two older.

        Args:
            stage: Part of the run.
            step: Number of its finished steps.
            state: Nested mappings of tensors and plain values.

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
        try:
            with whole():
                self.folder.mkdir(exist_ok=True)
                for abandoned in self.folder.glob(".partial-*"):  # of killed runs: --out is locked
                    shutil.rmtree(abandoned)
                text = json.dumps(manifest | {"manifest_sha256": manifest_digest(manifest)})
                write_folder(path, [(STATE, content), (MANIFEST, text.encode())])
                for old in list(self._names())[KEPT:]:
                    remove_folder(self.folder / old)
        except OSError as error:
            what = "a checkpoint cannot be written"
            raise disk_error(self.folder, error, what) from None

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
                "give the same again, or start the run again with --overwrite",
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
            advice = "--overwrite starts the run again"
            raise InputError(self.folder, "; ".join(problems), advice)
        raise InputError(
            "--resume",
            f"nothing to go on from (no checkpoint in {self.folder})",
            "leave --resume out to start the run",
        )

    def remove(self) -> None:
        """Delete all checkpoints before the run starts again."""
        remove_unfinished(self.folder)

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
    from torch import Tensor

    if isinstance(state, Tensor):
        # safetensors refuses tensors that share memory.
        tensors[place] = state.detach().cpu().contiguous().clone()
        return {"tensor": place}
    if isinstance(state, Mapping):
        parts = {k: _split(v, f"{place}/{k}", tensors) for k, v in state.items()}
        return {"mapping": parts}
    return {"plain": state}


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
            absent = "absent"
            yield from _differences(
                then.get(key, absent), now.get(key, absent), f"{place}.{key}".lstrip(".")
            )
    elif then != now:
        yield f"{place}: was {_shown(then)}, is {_shown(now)}"


def _shown(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 80 else text[:77] + "..."  # a sha256 is shown whole


def is_due(step: int, every: int) -> bool:
    """Return whether a checkpoint is due: every so many steps, and when the run is to stop."""
    return bool(every) and (step % every == 0 or is_pending())


def report_kept(asked: OutputConfig, error: BaseException) -> None:
    """Print which checkpoint remains of a run that was stopped or failed.

    Args:
        asked: Output settings of the run.
        error: What ended it; a `Stopped` carries the line instead.
    """
    if isinstance(error, InputError) and error.code not in (ExitCode.RESOURCES, ExitCode.NUMERIC):
        return  # refused before it began
    assert asked.out is not None
    checkpoints = Checkpoints(Path(asked.out), {})
    line = ""
    if checkpoints.newest is not None:
        kept = checkpoints.folder / checkpoints.newest
        line = f"kept: {kept}; the same command with --resume goes on from there"
    if isinstance(error, Stopped):  # printed last; the stage may have set a better one
        error.kept = error.kept or line or "there was no checkpoint to keep yet"
    elif line:
        say(line)


def output_folder(asked: OutputConfig, is_guided: bool) -> OutputFolder:
    """Return the output folder, not yet entered.

    Args:
        asked: Output settings: the folder, and whether its run is resumed or overwritten.
        is_guided: Whether this run writes checkpoints.

    Raises:
        InputError: ``--resume`` of a finished or unguided run, or an unfinished run without
            ``--resume`` or ``--overwrite`` (`ExitCode.OUTPUT`).
    """
    out, resume, overwrite = asked.out, asked.resume, asked.overwrite
    assert out is not None
    newest = Checkpoints(Path(out), {}).newest
    if resume and newest is None and os.path.exists(Path(out, "run.json")):
        raise InputError(
            "--resume",
            f"the run in {out} is finished",
            "to run it again, give --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    if newest is not None and not (resume or overwrite):
        raise InputError(
            out,
            f"holds an unfinished run ({newest})",
            "--resume goes on with it, --overwrite starts it again",
            ExitCode.OUTPUT,
        )
    if resume and newest is not None and not is_guided:
        raise InputError(
            "--resume",
            f"the unfinished run in {out} was guided, this one is not",
            "give its flags, or --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    # A run that is resumed was allowed to replace these results, or wrote them itself.
    return OutputFolder(out, overwrite=overwrite or (resume and newest is not None))
