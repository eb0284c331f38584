"""The work of a batch: check all scenes, compile once, insert, and write the summary."""

import json
import os
import shutil
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import warpir
from warpir.app.config import InsertConfig
from warpir.app.program import explain, say
from warpir.batch.local import LocalWorkers
from warpir.batch.manifest import Manifest
from warpir.batch.page import PAGE, batch_page
from warpir.batch.ray import RayWorkers
from warpir.batch.scene import LOGS, STATES, Scene
from warpir.batch.task import CHECK, COMPILE, DONE_BEFORE, INSERT, Answer, Task
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError, disk_errors
from warpir.core.memory import core_count, free_host
from warpir.core.progress import duration
from warpir.core.signals import whole
from warpir.core.strict_json import json_bytes

FORMAT, VERSION = "warpir-batch", 1
SUMMARY, FAILURES = "batch.json", "failures.jsonl"
WORKER_BYTES = 700 << 20
"""Of a worker's process with torch, Warp and the regressor, and the largest maps that it writes:
measured. Without a model it holds no torch, and less."""
CHECKER_BYTES = 300 << 20
"""Of a process that reads and checks inputs, without torch and Warp."""
NONE_STARTED = "cannot be used, so none was started (--all-or-nothing)"


class Workers(Protocol):
    """Processes of this machine, or a cluster, that do tasks."""

    @property
    def free(self) -> int:
        """How many tasks could be started now."""

    def start(self, key: int, task: Task) -> None:
        """Begin a task where one is free."""

    def wait(self) -> tuple[int, Answer]:
        """Return the key and the answer of a task that has ended."""

    def stop(self) -> list[tuple[int, Answer]]:
        """End all; return what was under way."""


@dataclass(frozen=True)
class Options:
    """What the batch itself is asked to do."""

    manifest: Path
    out: Path
    workers: int | None
    retries: int
    ray: str | None
    is_validating: bool
    is_all_or_nothing: bool
    is_fresh: bool
    """Whether finished scenes are done again."""


class Batch:
    """The scenes of a manifest on their way: `check`, then `do`, then `write`."""

    def __init__(self, options: Options, manifest: Manifest) -> None:
        self.options, self._digest = options, manifest.sha256
        self.scenes = tuple(Scene(row, options.out) for row in manifest.rows)
        self.started = time.monotonic()
        self.worker_count = self.threads = 0
        self._workers: Workers = LocalWorkers([])
        for scene in self.scenes:
            if scene.row.problem is not None:
                status, lines = explain(scene.row.problem)
                # Every failure is printed with its line already.
                here = f": {options.manifest}:{scene.row.line}: "
                scene.fail(status, [line.replace(here, ": ", 1) for line in lines])

    def __enter__(self) -> "Batch":
        """Nothing runs yet."""
        return self

    def __exit__(self, *error: object) -> None:
        """End the workers."""
        self._workers.stop()

    def count(self, *states: str) -> int:
        """Return how many scenes are in one of these states."""
        return sum(scene.state in states for scene in self.scenes)

    def check(self) -> None:
        """Read and check the inputs of all scenes, each in a worker: a library may crash on one."""
        keys = self._open()

        def ended(key: int, answer: Answer) -> None:
            scene = self.scenes[key]
            if answer.status:
                scene.fail(answer.status, answer.lines)
            else:
                scene.needs = answer.found
                if scene.needs["is_done"]:
                    scene.state = DONE_BEFORE

        tasks = {key: self._task(CHECK, key) for key in keys}
        # --workers may be those of a cluster.
        most = max(1, min(core_count(), free_host() // CHECKER_BYTES))
        count = min(self.options.workers or most, most, len(keys))
        self._workers = LocalWorkers(self._environments(count))
        run_tasks(self._workers, tasks, self._retry, ended)
        for scene in self.scenes:
            if scene.state != "failed":
                scene.retries.clear()  # those of the check are none of its insertion's
        if self.options.ray is None:  # whose machines are asked when it is known what runs there
            self._compile(
                [key for key in self._open() if self._config(key).render.device == "cuda"], []
            )
        say(
            f"checked: {len(self.scenes)} scenes, of which {self.count(DONE_BEFORE)} are done "
            f"already and {self.count('failed')} cannot be used"
        )

    def do(self) -> None:
        """Insert what is not done yet."""
        keys = self._open()
        if not keys:
            return
        disk = sum(self.scenes[key].needs["disk"] for key in keys)
        free = shutil.disk_usage(self.options.out).free
        if disk > free:
            say(f"notice: about {disk >> 20} MiB will be written, and {free >> 20} MiB are free")
        gpus = self._prepare(keys)
        keys = self._open()  # a device may have been refused
        if self.options.is_all_or_nothing:
            self.raise_failures(NONE_STARTED)
        tasks = {key: self._task(INSERT, key, self._on_cuda(key, gpus)) for key in keys}
        began, finished = time.monotonic(), 0

        def ended(key: int, answer: Answer) -> None:
            nonlocal finished
            scene, finished = self.scenes[key], finished + 1
            scene.seconds, scene.has_log = answer.seconds, True
            if answer.status:
                scene.fail(answer.status, answer.lines)
                return
            how = answer.found["how"]
            scene.state = DONE_BEFORE if how == DONE_BEFORE else "done"
            left = (time.monotonic() - began) / finished * (len(keys) - finished)
            say(f"{finished} of {len(keys)}: {scene.title}: {how} in {answer.seconds:.1f} s"
                + (f", {duration(left)} left" if finished < len(keys) else ""))  # fmt: skip

        run_tasks(self._workers, tasks, self._retry, ended)

    def write(self) -> None:
        """Write the summary, the list of failures and the page.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        failed = [scene for scene in self.scenes if scene.state == "failed"]
        summary = {
            "format": FORMAT,
            "version": VERSION,
            "warpir": warpir.__version__,
            "manifest": str(self.options.manifest),
            "sha256": self._digest,
            "workers": self.worker_count,
            "threads": self.threads,
            "seconds": round(time.monotonic() - self.started, 3),
            "counts": {state: self.count(state) for state in STATES},
            "scenes": [scene.record() for scene in self.scenes],
        }
        lines = "".join(json.dumps(scene.failure()) + "\n" for scene in failed)
        with disk_errors(self.options.out / SUMMARY):
            with whole():
                # First: a list of failures without a summary is somebody else's.
                write_file(self.options.out / SUMMARY, json_bytes(summary))
                write_file(self.options.out / FAILURES, lines.encode())
            seconds = time.monotonic() - self.started
            page = batch_page(self.options.manifest, self.options.out, self.scenes, seconds)
            with whole():
                write_file(self.options.out / PAGE, page)

    def raise_failures(self, what: str) -> None:
        """End with the status of the first scene that failed.

        Raises:
            InputError: One has.
        """
        failed = [scene for scene in self.scenes if scene.state == "failed"]
        if failed:
            raise InputError(
                self.options.manifest,
                f"{len(failed)} of {len(self.scenes)} scenes {what}",
                f"the first: line {failed[0].row.line}: {failed[0].reason}",
                ExitCode(failed[0].status),
            )

    def _open(self) -> list[int]:
        return [key for key, scene in enumerate(self.scenes) if scene.is_open]

    def _config(self, key: int) -> InsertConfig:
        config = self.scenes[key].row.config
        assert config is not None, "a line without one has failed"
        return config

    def _task(self, do: str, key: int, on_cuda: bool = False) -> Task:
        config = self._config(key)
        if do == INSERT:
            config = config.changed(threads=config.render.threads or self.threads)
        config = config.changed(overwrite=self.options.is_fresh)
        log = self.options.out.absolute() / LOGS / f"{self.scenes[key].row.name}.log"
        return Task(
            do,
            config.flat(),
            str(self.options.manifest.absolute().parent),
            str(log) if do == INSERT else None,
            memory=self._memory(key),
            gpus=int(on_cuda),
        )

    def _memory(self, key: int) -> int:
        """Return the least memory that a worker takes with this scene [byte]."""
        return WORKER_BYTES + int(self.scenes[key].needs.get("memory", 0))

    def _retry(self, key: int, answer: Answer) -> bool:
        """Return whether another attempt could cure a scene, and note why it is made."""
        scene = self.scenes[key]
        why = answer.died or ("out of memory" if answer.is_short else "")
        if not why and answer.status >= 128:
            why = f"signal {answer.status - 128}"
        if not why or len(scene.retries) >= self.options.retries:
            return False
        scene.retries.append(why)
        say(f"{scene.title}: {why}: it is tried again at the end, by itself")
        return True

    def _on_cuda(self, key: int, count: int) -> bool:
        return count > 0 and self._config(key).render.device != "cpu"

    def _prepare(self, keys: Sequence[int]) -> int:
        """Compile the kernels once, which all workers would do, and get those that do the scenes.

        Returns:
            How many GPUs there are.
        """
        places = sorted({bool(self.scenes[key].needs["has_place"]) for key in keys})
        if self.options.ray is not None:
            self._workers.stop()
            cluster = RayWorkers(self.options.ray)
            self._workers = cluster
            keys = keys if cluster.gpus else self._fail_on_cuda(keys)
            if not keys:
                return cluster.gpus
            # Each machine compiles for what it has: one without a GPU gets no scene that needs it.
            devices = ["cpu" if self._config(key).render.device == "cpu" else None for key in keys]
            kernels = {"devices": [*dict.fromkeys(devices)], "places": places}
            task = Task(COMPILE, kernels | self._variants(keys))
            cluster.prepare(self.options.out.absolute(), task)
            memory: dict[int, int] = {}
            for key in keys:
                on_gpus, needed = int(self._on_cuda(key, cluster.gpus)), self._memory(key)
                memory[on_gpus] = max(memory.get(on_gpus, 0), needed)
            count = self.options.workers or (cluster.gpus if 1 in memory else cluster.cpus)
            self.worker_count = min(count, len(keys))
            self.threads = cluster.share(self.worker_count, memory)
            return cluster.gpus
        gpus = self._compile(keys, places)
        keys = [key for key in keys if self.scenes[key].is_open]
        if not keys:
            return gpus
        on_cuda = any(self._on_cuda(key, gpus) for key in keys)
        by_memory = max(1, free_host() // max(map(self._memory, keys)))
        count = self.options.workers or min(gpus if on_cuda else core_count(), by_memory)
        self.worker_count = min(count, len(keys))
        self.threads = max(1, core_count() // self.worker_count)
        say(f"workers: {self.worker_count}, of {self.threads} threads each")
        if on_cuda or self.worker_count != self._workers.free:
            self._workers.stop()
            self._workers = LocalWorkers(
                self._environments(self.worker_count, gpus if on_cuda else 0)
            )
        return gpus

    def _compile(self, keys: Sequence[int], places: Sequence[bool]) -> int:
        """Let a worker compile for one device after another; a scene fails where its device does.

        Without ``places``, which say whether a mesh of the place is rendered, the devices are only
        looked for. Returns how many CUDA devices the worker sees.
        """
        found: list[Answer] = []
        for device in dict.fromkeys(self._config(key).render.device for key in keys):
            needed = {"devices": [device], "places": list(places)}
            task = Task(COMPILE, needed | self._variants(keys))
            run_tasks(self._workers, {0: task}, lambda *_: False, lambda _, a: found.append(a))
            if found[-1].status:
                for key in keys:
                    if self._config(key).render.device == device:
                        self.scenes[key].fail(found[-1].status, found[-1].lines)
        return max((int(answer.found.get("cuda", 0)) for answer in found), default=0)

    def _variants(self, keys: Sequence[int]) -> dict[str, list[bool]]:
        """Return the variants of the path tracer that scenes need: from the ground, with lamps."""
        configs = [self._config(key) for key in keys]
        return {
            "bounces": sorted({False, *(config.render.bounce for config in configs)}),
            "lamps": sorted({config.light.has_lamps for config in configs}),
        }

    def _fail_on_cuda(self, keys: Sequence[int]) -> list[int]:
        """Let scenes fail that ask for a GPU of a cluster without one; return the others."""
        for key in keys:
            if self._config(key).render.device == "cuda":
                what = "error: --device: no machine of the cluster has a GPU (found cuda)"
                self.scenes[key].fail(ExitCode.USAGE, (what, "use --device cpu"))
        return [key for key in keys if self.scenes[key].is_open]

    def _environments(self, count: int, gpus: int = 0) -> list[dict[str, str]]:
        """Return what is special in the environment of each worker: one thread for libraries.

        A renderer has those that its configuration says, and a large network its own number.
        """
        visible = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(gpus)))
        names = visible.split(",") if gpus else []
        return [
            {"OMP_NUM_THREADS": "1"}
            | ({"CUDA_VISIBLE_DEVICES": names[k % len(names)]} if names else {})
            for k in range(count)
        ]


def run_tasks(
    workers: Workers,
    tasks: dict[int, Task],
    retry: Callable[[int, Answer], bool],
    ended: Callable[[int, Answer], None],
) -> None:
    """Do tasks, as many at a time as there are workers; where that is stopped, so are they.

    What is tried again comes last and has the machine for itself: what was killed may have been the
    one that took the memory.
    """
    queue, later, running = deque(tasks), deque[int](), 0
    attempts = dict.fromkeys(tasks, 1)
    try:
        while queue or later or running:
            while queue and workers.free:
                key = queue.popleft()
                workers.start(key, tasks[key])
                running += 1
            if not queue and not running:
                key = later.popleft()
                attempts[key] += 1
                workers.start(key, replace(tasks[key], attempt=attempts[key]))
                running += 1
            key, answer = workers.wait()
            running -= 1
            if retry(key, answer):
                later.append(key)
            else:
                ended(key, answer)
    except BaseException:
        for key, answer in workers.stop():
            if answer.status == ExitCode.DONE:  # its last moment was enough
                ended(key, answer)
        raise
