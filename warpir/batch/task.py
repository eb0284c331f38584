"""What a worker of a batch does with one scene, and what it answers: both hold plain values.

A task is done in a process of its own, whoever starts that: `warpir.batch.local` on this machine,
`warpir.batch.ray` on others. Whatever ends a scene becomes an `Answer`; only what ends the process
does not.
"""

import os
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from warpir.app.config import InsertConfig
from warpir.app.earlier_runs import OtherRun, config_of_record, is_done
from warpir.app.inputs import Inputs, Loaders, read_inputs
from warpir.app.program import explain, extras_of, require_packages, say, stay_offline
from warpir.app.run import memory_needs, needed_bytes, require_space
from warpir.core import signals
from warpir.core.errors import ExitCode, InputError, disk_errors
from warpir.core.memory import lacked_memory, release
from warpir.insert import insert
from warpir.io.results import OutputFolder
from warpir.lighting.scene_light import make_light
from warpir.sequence.frames import Frame, is_whole, read_sequence
from warpir.sequence.page import refuse_other_page

CHECK, INSERT, COMPILE = "check", "insert", "compile"
DONE_BEFORE = "done before"


@dataclass(frozen=True)
class Task:
    """What is to be done."""

    do: str
    """`CHECK`: read and check its inputs; `INSERT`; `COMPILE`: the kernels of a batch."""
    config: dict[str, Any] = field(default_factory=dict)
    """Of the scene; of `COMPILE` what `_compile` takes."""
    folder: str = "."
    """Where relative paths in the files of the scene start."""
    log: str | None = None
    """File for what it prints; None: nowhere."""
    attempt: int = 1
    """From 1; later ones add to the log."""
    memory: int = 0
    """Of the host, at least [byte]; what a cluster looks for."""
    gpus: int = 0
    """The same, 0 or 1."""


@dataclass(frozen=True)
class Answer:
    """How a task ended."""

    status: int
    """An `ExitCode`, or 128 plus the number of a signal."""
    lines: tuple[str, ...] = ()
    """What a person would have read of it, the error first; empty where it was done."""
    seconds: float = 0.0
    found: dict[str, Any] = field(default_factory=dict)
    """What the task returns; see `do_task`."""
    is_short: bool = False
    """Whether it ended for want of memory."""
    died: str = ""
    """How the process ended that should have answered; empty: it has."""


def do_task(task: Task) -> Answer:
    """Do a task to its end, whatever that is; the process can do another one then.

    Returns:
        Its ``found`` holds, of `CHECK`, whether the scene is done (``is_done``), the least memory
        and disk that it takes (``memory``, ``disk``) [byte] and what is to be compiled for it
        (``has_place``); of `INSERT` what was done (``how``); of `COMPILE` how many CUDA devices
        there are (``cuda``).
    """
    start, status, is_short = time.monotonic(), int(ExitCode.DONE), False
    is_printing = False
    lines: list[str] = []
    found: dict[str, Any] = {}
    with ExitStack() as stack:
        stack.enter_context(signals.handled())
        try:
            stack.enter_context(_printing_to(task.log, is_new=task.attempt == 1))
            is_printing = True
            stack.enter_context(_working_in(task.folder))
            found = {CHECK: _check, INSERT: _insert, COMPILE: _compile}[task.do](task)
        # Everything: also a fault of our own ends this scene alone.
        except BaseException as error:
            signals.ignore()
            status, lines = explain(error)
            is_short = lacked_memory(error)
            with suppress(OSError):  # the log's disk is full: the answer says it all
                if status == ExitCode.BUG:
                    traceback.print_exc()
                for line in (
                    lines if is_printing else ()
                ):  # without a log they are told by the batch
                    print(line, file=sys.stderr, flush=True)
    release()  # the scene's memory, which nothing refers to any more
    return Answer(status, tuple(lines), time.monotonic() - start, found, is_short)


def _check(task: Task) -> dict[str, Any]:
    config = config_of_record(task.config)
    require_packages(*extras_of(config))
    if config.task.sequence is not None:
        return _check_sequence(config)
    filled = _filled(config)
    try:
        if is_done(config, filled):
            return {"is_done": True}
    except OtherRun:
        pass  # of earlier settings or inputs: done again
    config = filled
    inputs = read_inputs(config)
    make_light(inputs, config.light, config.tone_operator)
    OutputFolder(config.output.folder, overwrite=True).check()  # what is in it was looked at
    disk = needed_bytes(config, inputs)
    require_space(config.output.folder, disk)
    return {
        "is_done": False,
        "memory": _memory(config, inputs),
        "disk": disk,
        "has_place": inputs.proxy is not None,
    }


def _filled(config: InsertConfig) -> InsertConfig:
    """Return a configuration with the demo's files, where it asks for them."""
    if not config.inputs.demo:
        return config
    from warpir.demo import demo_config

    return demo_config(config)


def _memory(config: InsertConfig, inputs: Inputs) -> int:
    """Return the least memory that a scene takes of the host beside the program [byte]."""
    of_photo, of_scene = memory_needs(inputs)
    total = of_photo.bytes + sum(need.bytes for need in of_scene)
    if config.is_guided and config.diffusion.model is not None:
        total += sum(f.stat().st_size for f in Path(config.diffusion.model).rglob("*.safetensors"))
    return total


def _check_sequence(config: InsertConfig) -> dict[str, Any]:
    memory, disk = [0], [0]

    def look_at(frame: Frame, inputs: Inputs) -> None:
        if not frame.is_done:
            memory.append(_memory(frame.config, inputs))
            disk.append(needed_bytes(frame.config, inputs))

    loaders = Loaders(must_be_seen=False)
    frames = read_sequence(config, loaders, renews=True, look_at=look_at)
    refuse_other_page(config)
    OutputFolder(config.output.folder, overwrite=True).check()
    return {
        "is_done": is_whole(config, frames),
        "memory": max(memory),
        "disk": sum(disk),
        "has_place": any(frame.config.camera.proxy is not None for frame in frames),
    }


def _insert(task: Task) -> dict[str, Any]:
    config = config_of_record(task.config)
    if not config.diffusion.allow_download:
        stay_offline()
    if config.task.sequence is not None:
        insert(config, renews=True)
        return {"how": "done"}
    out = config.output.folder
    is_fresh = replaces = config.output.overwrite
    try:
        if is_done(config, _filled(config)):
            return {"how": DONE_BEFORE}
    except OtherRun:
        say("notice: its settings or inputs have changed: it is done again")
        replaces = True
    has_checkpoint = any((out / "checkpoints").glob("[0-9]*"))
    # Of an earlier attempt it is this batch's own, whatever --overwrite says.
    if has_checkpoint and config.is_guided and (task.attempt > 1 or not is_fresh):
        try:
            insert(config.changed(resume=True, overwrite=False))
            return {"how": "resumed"}
        except InputError as error:
            if not Path(error.where).is_relative_to(out / "checkpoints"):
                raise
            say(f"notice: it starts again: {error.where}: {error.what}")
    insert(config.changed(overwrite=replaces or has_checkpoint))
    return {"how": "done"}


def _compile(task: Task) -> dict[str, Any]:
    """Compile what the scenes need, once, before many processes would do it at the same time.

    Where nothing is said of places, only the devices are looked for.
    """
    from warpir.render.device import cache_kernels, choose_device, cuda_count

    places = task.config["places"]
    for device in [choose_device(name) for name in task.config["devices"]]:
        if places:
            bounces, lamps = task.config["bounces"], task.config["lamps"]
            both = (False, True)
            cache_kernels(device, product(both, places, bounces, lamps, (False,), both))
    return {"cuda": cuda_count()}


@contextmanager
def _working_in(folder: str) -> Iterator[None]:
    """Work in a folder within the block.

    Raises:
        InputError: It is gone.
    """
    before = os.getcwd()
    try:
        os.chdir(folder)
    except OSError as error:
        what = f"the folder of the manifest cannot be entered ({error.strerror})"
        raise InputError(folder, what, "was it moved meanwhile?") from error
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def _printing_to(path: str | None, is_new: bool) -> Iterator[None]:
    """Let this process, libraries too, print into a file within the block.

    Raises:
        InputError: It cannot be written (`ExitCode.RESOURCES`).
    """
    mode = os.O_TRUNC if is_new and path is not None else os.O_APPEND
    with disk_errors(path or os.devnull):
        if path is not None:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        target = os.open(path or os.devnull, os.O_WRONLY | os.O_CREAT | mode, 0o644)
    before = [os.dup(1), os.dup(2)]
    try:
        os.dup2(target, 1)
        os.dup2(target, 2)
        yield
    finally:
        for number, stream in ((1, sys.stdout), (2, sys.stderr)):
            try:
                stream.flush()
            except OSError:  # a full disk: what could not be written is not the next scene's
                _discard(number)
                stream.flush()
        for number, kept in zip((1, 2), before, strict=True):
            os.dup2(kept, number)
        for descriptor in (*before, target):
            os.close(descriptor)


def _discard(number: int) -> None:
    """Let what is written to a descriptor go nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, number)
    os.close(nowhere)
