"""Checkpoints of a run: safetensors and JSON, whole or not there, and of this very run.

    checkpoints/000003-optimize-150/state.safetensors  tensors, named by their place in the state
    checkpoints/000003-optimize-150/manifest.json      plain values, sha256, what it depends on

A checkpoint is built under a temporary name, its manifest last, and renamed once. Its serial number
grows, so the newest needs no clock to be known. The one before stays until the newer is complete;
nothing is pickled.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load, save
from torch import Tensor

from warpir.errors import ExitCode, InputError
from warpir.strict_json import read_json_object

FORMAT = 1
"""Layout of a checkpoint; another is refused."""
KEPT = 2
"""Checkpoints that stay on disk."""
FOLDER = "checkpoints"
STATE, MANIFEST = "state.safetensors", "manifest.json"


@dataclass(frozen=True)
class Checkpoint:
    """A state that was read back."""

    stage: str
    """Part of the run that wrote it, such as ``personalize`` or ``optimize``."""
    step: int
    """Steps of that part that were done."""
    state: dict[str, Any]
    """Nested tensors and plain values, as they were given to `Checkpoints.save`."""


class Checkpoints:
    """The checkpoints of one run in its output folder.

    Args:
        out: The output folder.
        identity: What the run depends on: settings, input hashes, versions; plain values.
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
            step: Steps of it that are done.
            state: Nested mappings of tensors and plain values.

        Raises:
            InputError: The disk is full or cannot be written (`ExitCode.RESOURCES`).
        """
        tensors: dict[str, Tensor] = {}
        plain = _split(state, "", tensors)
        content = save(tensors)
        manifest = {
            "format": FORMAT,
            "stage": stage,
            "step": step,
            "sha256": hashlib.sha256(content).hexdigest(),
            "identity": self.identity,
            "state": plain,
        }
        newest = self.newest
        serial = int(newest.split("-")[0]) + 1 if newest is not None else 1
        partial = self.folder / f".partial-{os.getpid()}"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for abandoned in self.folder.glob(".partial-*"):  # of killed runs: --out is locked
                shutil.rmtree(abandoned)
            partial.mkdir()
            _write(partial / STATE, content)
            _write(partial / MANIFEST, json.dumps(manifest, allow_nan=False).encode())
            os.replace(partial, self.folder / f"{serial:06d}-{stage}-{step}")
            for old in list(self._names())[KEPT:]:
                shutil.rmtree(self.folder / old)
        except OSError as error:
            shutil.rmtree(partial, ignore_errors=True)
            why = error.strerror or str(error)
            what = f"a checkpoint cannot be written ({why})"
            raise InputError(self.folder, what, code=ExitCode.RESOURCES) from None

    def load(self, notice: Callable[[str], None]) -> Checkpoint:
        """Return the newest checkpoint that is whole.

        Args:
            notice: Told of each damaged one that was passed over.

        Raises:
            InputError: There is none, none is whole, or the run has changed; every field that
                differs is named.
        """
        problems = []
        for name in self._names():
            path = self.folder / name
            try:
                manifest = read_json_object(path / MANIFEST)
                content = (path / STATE).read_bytes()
                if hashlib.sha256(content).hexdigest() != manifest["sha256"]:
                    raise InputError(path, "its sha256 is not the one that was written")
                if manifest["format"] != FORMAT:
                    raise InputError(path, f"of another format ({manifest['format']!r:.20})")
                state = _join(manifest["state"], load(content))
                found = Checkpoint(str(manifest["stage"]), int(manifest["step"]), state)
                identity = dict(manifest["identity"])
            except (InputError, OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
                why = error.what if isinstance(error, InputError) else repr(error)
                problems.append(f"{name} is damaged: {why}")
                continue
            differing = sorted(_differences(identity, self.identity))
            if differing:
                raise InputError(
                    path,
                    f"of a run with other inputs or settings ({'; '.join(differing)})",
                    "give the same again, or start the run again with --overwrite",
                )
            for problem in problems:
                notice(f"checkpoint passed over: {problem}")
            return found
        if problems:
            advice = "--overwrite starts the run again"
            raise InputError(self.folder, "; ".join(problems), advice)
        raise InputError(
            "--resume",
            f"nothing to go on from (no checkpoint in {self.folder})",
            "leave --resume out to start the run",
        )

    def remove(self) -> None:
        """Delete all of them: the run is complete, or starts again."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _names(self) -> Iterator[str]:
        """Yield the complete checkpoints, the newest first."""
        found = self.folder.glob(f"[0-9]*-*-*/{MANIFEST}") if self.folder.is_dir() else ()
        yield from sorted((path.parent.name for path in found), reverse=True)


def _write(path: Path, content: bytes) -> None:
    with path.open("wb") as stream:
        stream.write(content)
        stream.flush()
        os.fsync(stream.fileno())


def _split(state: Any, place: str, tensors: dict[str, Tensor]) -> Any:
    """Move the tensors of a nested state into ``tensors``; return the rest, plain."""
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
    """Yield what differs between two plain trees, one line a leaf."""
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
    return text if len(text) <= 40 else text[:37] + "..."
