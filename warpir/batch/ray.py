"""The scenes of a batch on a Ray cluster: one scene a task, on machines that share their storage.

Retries are the batch's own (``max_retries=0``), so that they are the same as on one machine and are
told of. Nothing is sent anywhere but to the cluster: no usage statistics, no dashboard.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from warpir.app.program import require_packages
from warpir.batch.local import GRACE_SECONDS
from warpir.batch.task import Answer, Task, do_task
from warpir.core.errors import ExitCode, InputError
from warpir.core.signals import STOPPING

LOCAL = "local"
"""In place of an address: a cluster of this machine alone, for this batch."""
CONNECT_SECONDS = 10.0
PROBE_SECONDS = 60.0
"""Until a file that was written on one machine is seen on the others, whose storage may be slow."""


class RayWorkers:
    """Scenes as tasks of Ray.

    Args:
        address: Of the cluster, ``auto``, or `LOCAL`.

    Attributes:
        cpus: Of the whole cluster.
        gpus: The same.

    Raises:
        InputError: There is no cluster at the address (`ExitCode.USAGE`).
        ModuleNotFoundError: Ray is not installed.
    """

    def __init__(self, address: str) -> None:
        require_packages("ray")
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        import ray

        _require_reachable(address)
        self._ray: Any = ray
        before = {number: signal.getsignal(number) for number in STOPPING}
        local: dict[str, Any] = {"include_dashboard": False, "_node_ip_address": "127.0.0.1"}
        try:
            self._ray.init(
                address=address,
                log_to_driver=False,
                logging_level="ERROR",
                runtime_env={"env_vars": {"OPENBLAS_NUM_THREADS": "1", "DO_NOT_TRACK": "1"}},
                **(local if address == LOCAL else {}),
            )
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise _no_cluster(address, error) from error
        finally:
            for number, handler in before.items():  # Ray puts its own in their place
                signal.signal(number, handler)
        total = self._ray.cluster_resources()
        self.cpus, self.gpus = int(total.get("CPU", 1)), int(total.get("GPU", 0))
        self._memory: dict[int, int] = {}
        """The most that a task asks for [byte], by its GPUs."""
        self._running: dict[Any, int] = {}
        self.count = self.threads = 1

    def share(self, count: int, memory: Mapping[int, int]) -> int:
        """Let so many scenes run at the same time; return the threads that each may use.

        Args:
            count: How many.
            memory: The most that a task takes [byte], by its GPUs: 0, 1 or both.

        Raises:
            InputError: No machine could do one, and Ray would wait for one for ever
                (`ExitCode.RESOURCES`).
        """
        self.count, threads = count, list[int]()
        for gpus, wanted in memory.items():
            # A task runs on one machine: what others have more of is nothing to it.
            found = [node["Resources"] for node in self._nodes()]
            able = [has for has in found if has.get("CPU", 0) >= 1 and has.get("GPU", 0) >= gpus]
            if not able:
                what = f"no machine of the cluster has a CPU{' and a GPU' if gpus else ''} to give"
                raise InputError("--ray", what, "start one that has", ExitCode.RESOURCES)
            most = int(max(has.get("memory", 0) for has in able))
            self._memory[gpus] = min(wanted, most)
            cpus = max(has["CPU"] for has in able if has.get("memory", 0) >= self._memory[gpus])
            threads.append(int(min(sum(has["CPU"] for has in able) // count, cpus)))
        self.threads = max(1, min(threads))
        return self.threads

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self._ray.nodes() if node["Alive"]]

    def prepare(self, out: Path, task: Task) -> None:
        """See on every machine that it shares the folder of the results, and compile there once.

        Raises:
            InputError: A machine does not see the folder, or this one not what that wrote
                (`ExitCode.USAGE`); or it cannot run warpir or compile.
        """
        from ray.exceptions import RayError
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        folder = out / f".batch-{secrets.token_hex(8)}"
        folder.mkdir()
        try:
            (folder / "driver").write_text(folder.name)
            probe = self._ray.remote(num_cpus=0, max_retries=0)(_probe)
            probes, nodes = {}, self._nodes()
            for node in nodes:
                where = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                asked = probe.options(scheduling_strategy=where)
                probes[node["NodeID"]] = asked.remote(str(folder), node["NodeID"], task)
            for node in nodes:
                name = node["NodeManagerHostname"]
                try:
                    sees, answer = self._ray.get(probes[node["NodeID"]])
                except RayError as error:
                    why = (str(error).strip() or type(error).__name__).splitlines()[-1]
                    what = f"a first task failed there ({why})"
                    advice = "is the same version of warpir installed there?"
                    raise InputError(f"the machine {name}", what, advice, ExitCode.USAGE) from error
                if not sees or not _appears(folder / node["NodeID"]):
                    raise InputError(
                        "--out",
                        f"{out} is not on storage that all machines of the cluster share: "
                        + (f"its files are not there on {name}" if not sees else
                           f"what {name} writes there is not seen here"),
                        "name a folder that is mounted at the same place on all of them",
                        ExitCode.USAGE,
                    )  # fmt: skip
                if answer.status:
                    line = " ".join(answer.lines).removeprefix("error: ")
                    raise InputError(f"the machine {name}", line, code=ExitCode(answer.status))
        finally:
            # A machine that comes late may write into it meanwhile: not what the user is to read.
            shutil.rmtree(folder, ignore_errors=True)

    @property
    def free(self) -> int:
        """How many tasks could be started now; whether they run then is up to Ray."""
        return self.count - len(self._running)

    def start(self, key: int, task: Task) -> None:
        """Hand a task to Ray."""
        remote = self._ray.remote(
            num_cpus=self.threads,
            num_gpus=task.gpus,
            memory=min(task.memory, self._memory[task.gpus]),
            max_retries=0,
            # A process that has met a fault of CUDA does nothing with it any more.
            max_calls=1 if task.gpus else 0,
        )(do_task)
        self._running[remote.remote(task)] = key

    def wait(self) -> tuple[int, Answer]:
        """Return the key and the answer of a task that has ended."""
        (done,), _ = self._ray.wait([*self._running], num_returns=1)
        key = self._running.pop(done)
        return key, self._answer(done)

    def _answer(self, reference: Any) -> Answer:
        from ray import exceptions

        try:
            answer: Answer = self._ray.get(reference)
            return answer
        except exceptions.OutOfMemoryError:
            line = "error: worker: ended by Ray, as its machine ran out of memory"
            return Answer(ExitCode.RESOURCES, (line,), is_short=True, died="OutOfMemoryError")
        except exceptions.RayError as error:
            kind = type(error).__name__
            line = f"error: worker: lost ({kind}): killed, out of memory, or its machine is gone"
            return Answer(ExitCode.RESOURCES, (line,), died=kind)

    def stop(self) -> list[tuple[int, Answer]]:
        """End what runs, as a signal ends a run, and leave the cluster.

        Returns:
            What was under way, by its key, and how it ended.
        """
        try:
            for reference in self._running:
                self._ray.cancel(reference)
            running = list(self._running)
            if running:
                self._ray.wait(running, num_returns=len(running), timeout=GRACE_SECONDS)
            return [(key, self._stopped(reference)) for reference, key in self._running.items()]
        finally:
            self._running.clear()
            self._ray.shutdown()

    def _stopped(self, reference: Any) -> Answer:
        ready, _ = self._ray.wait([reference], timeout=0)
        return self._answer(reference) if ready else Answer(ExitCode.RESOURCES, died="stopped")


def _require_reachable(address: str) -> None:
    """See that somebody listens: Ray itself would try for minutes.

    Raises:
        InputError: Nobody does (`ExitCode.USAGE`).
    """
    host, _, port = address.rpartition(":")
    if not (host and port.isdigit()):
        return
    try:
        socket.create_connection((host, int(port)), CONNECT_SECONDS).close()
    except (OSError, OverflowError) as error:
        raise _no_cluster(address, error) from error


def _no_cluster(address: str, error: Exception) -> InputError:
    words = (str(error).strip() or type(error).__name__).splitlines()[0]
    advice = "ray start --head starts one; --ray without an address uses this machine"
    return InputError(
        "--ray", f"no cluster can be used at {address} ({words})", advice, ExitCode.USAGE
    )


def _probe(folder: str, node: str, task: Task) -> tuple[bool, Answer]:
    """Return whether this machine sees a folder; write into it, and compile."""
    seen = Path(folder, "driver")
    if not _appears(seen):
        return False, Answer(ExitCode.USAGE)
    Path(folder, node).write_text(seen.read_text())
    return True, do_task(task)


def _appears(path: Path) -> bool:
    """Wait until a file is seen that another machine wrote; return whether it is."""
    deadline = time.monotonic() + PROBE_SECONDS
    while not path.exists():
        # Listing a folder makes network file systems look anew.
        if time.monotonic() > deadline or not path.parent.is_dir():
            return path.exists()
        time.sleep(0.2)
    return True
