"""Pictures for the page: a preview in seconds, and the full insertion with its report.

One is rendered at a time, in a thread that waits for a process; the page asks how far it is.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from html import unescape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from warpir.app.program import say
from warpir.core.atomic import write_file
from warpir.core.errors import InputError
from warpir.core.strict_json import read_json_object
from warpir.io.lamps_file import LAMPS
from warpir.place.session import CAMERA, CONFIG, MASK, PAGE
from warpir.place.worker import Worker

PREVIEW_WIDTH = 640
"""Width of a preview [px]."""


class Renderings:
    """What is rendered for one session."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self._folder = TemporaryDirectory(prefix="warpir-place-", ignore_cleanup_errors=True)
        self._lock = threading.Lock()
        self._process: subprocess.Popen[str] | None = None
        self._results: Path | None = None
        self._is_cancelled = False
        self._progress: dict[str, Any] = {"state": "idle"}
        self._count = 0
        self._placement: Mapping[str, Any] | None = None
        self._insertion: threading.Thread | None = None

    # ------------------------------------------------------------------------ what the page asks

    def preview(self, files: Mapping[str, Any]) -> dict[str, Any]:
        """Begin a preview of a placement.

        Raises:
            InputError: Something is rendered already.
        """
        return self._begin("preview", lambda: self._preview(files))

    def insert(self, config: Path, overwrite: bool) -> dict[str, Any]:
        """Begin the insertion of a saved placement.

        Raises:
            InputError: Something is rendered already.
        """
        return self._begin("insert", lambda: self._insert(config, overwrite))

    def cancel(self) -> dict[str, Any]:
        """End what is rendered now, if anything is."""
        with self._lock:
            if self._progress["state"] != "running":
                return self._progress
            self._is_cancelled = True
            process, kind = self._process, self._progress["kind"]
        if kind == "preview":
            self.worker.interrupt()
        elif process is not None:
            process.send_signal(signal.SIGINT)
        return self._progress

    def progress(self) -> dict[str, Any]:
        """Return how far it is: ``state`` and ``kind``, ``line``, ``share`` [1] and ``seconds``.

        States are idle, running, done, cancelled and failed. What is done has ``address`` of the
        picture or the report, a failure ``problem``.
        """
        with self._lock:
            now = dict(self._progress)
        if now["state"] == "running":
            now["seconds"] = round(time.monotonic() - now.pop("began"), 1)
        return now

    def load(self) -> None:
        """Begin to load the libraries, while the browser opens the page."""

        def wait() -> None:
            with suppress(InputError):  # that of the next job tells
                self.worker.ask({"kind": "load"})

        threading.Thread(target=wait, daemon=True).start()

    def warm_up(self, files: Mapping[str, Any]) -> None:
        """Read, load and compile what a preview of a placement needs; returns when that is done."""
        self._placement = files
        # What is refused the next job tells; a session that ends takes its folder along.
        with suppress(InputError, OSError):
            self.worker.ask(self._job("warm", "warm", files), self._hear)

    def file(self, name: str) -> bytes | None:
        """Return a file of what was rendered, by its address; None where there is none."""
        if re.fullmatch(r"preview-\d+\.png", name):
            return _content(Path(self._folder.name, name))
        folder, slash, rest = name.partition("/")
        if self._results is None or folder != "result" or not slash:
            return None
        with suppress(InputError):
            record = read_json_object(self._results / "run.json")
            if rest in (*record["files"], "run.json"):
                return _content(self._results / rest)
        return None

    def wait(self) -> None:
        """Return when the insertion that has begun, if any has, is done; a preview is not kept.

        What became of it is printed: the page may be gone before it asks again.
        """
        if self._insertion is None:
            return
        self._insertion.join()
        end = self.progress()
        if (end["kind"], end["state"]) == ("insert", "done"):
            say(f"inserted: {self._results}")
        elif (end["kind"], end["state"]) == ("insert", "failed"):
            say(f"notice: the full render failed ({end['problem']})")

    def close(self) -> None:
        """End what is rendered, and remove the previews."""
        self.cancel()
        self._folder.cleanup()

    # -------------------------------------------------------------------------------- the work

    def _begin(self, kind: str, work: Callable[[], str]) -> dict[str, Any]:
        with self._lock:
            if self._progress["state"] == "running":
                raise InputError(PAGE, "a picture is being rendered already", "cancel it first")
            self._is_cancelled = False
            self._count += 1
            self._progress = {
                "state": "running",
                "kind": kind,
                "line": "starting",
                "share": None,
                "began": time.monotonic(),
            }
        thread = threading.Thread(target=self._run, args=(work,), daemon=True)
        thread.start()
        if kind == "insert":
            self._insertion = thread
        return self.progress()

    def _run(self, work: Callable[[], str]) -> None:
        try:
            end: dict[str, Any] = {"state": "done", "address": work()}
        except InputError as error:
            advice = f" ({error.advice})" if error.advice else ""
            end = {"state": "failed", "problem": f"{error.where}: {error.what}{advice}"}
        with self._lock:
            if self._is_cancelled and end["state"] != "done":
                end = {"state": "cancelled"}
            kind, began = self._progress["kind"], self._progress["began"]
            seconds = round(time.monotonic() - began, 1)
            self._progress = {**end, "kind": kind, "seconds": seconds}
        is_lost = kind == "preview" and not self.worker.is_running
        if is_lost and self._placement is not None:
            self.warm_up(self._placement)

    def _hear(self, said: Mapping[str, Any]) -> None:
        """Tell a preview's progress, and that of what it waits for."""
        with self._lock:
            if self._progress.get("kind") == "preview" and self._progress["state"] == "running":
                self._progress.update(line=said["stage"], share=said["share"])

    def _preview(self, files: Mapping[str, Any]) -> str:
        def hear(said: Mapping[str, Any]) -> None:
            if self._is_cancelled:  # while it waited for another job
                self.worker.interrupt()
            self._hear(said)

        self._placement = files
        name = f"preview-{self._count}"
        self.worker.ask(self._job("preview", name, files), hear)
        return f"{name}.png"

    def _job(self, kind: str, name: str, files: Mapping[str, Any]) -> dict[str, Any]:
        """Write a placement's files into a folder of their own, and return the job of them."""
        folder = Path(self._folder.name, name)
        folder.mkdir(exist_ok=True)
        config = {**files[CONFIG], "out": str(folder / "unused")}
        write_file(folder / CAMERA, json.dumps(files[CAMERA]).encode())
        config["camera"] = str(folder / CAMERA)
        if MASK in files:
            write_file(folder / MASK, files[MASK])
            config["occluder_mask"] = str(folder / MASK)
        if LAMPS in files:
            write_file(folder / LAMPS, json.dumps(files[LAMPS]).encode())
            config["lamps"] = str(folder / LAMPS)
        picture = str(Path(self._folder.name, f"{name}.png"))
        return {"kind": kind, "config": config, "width": PREVIEW_WIDTH, "picture": picture}

    def _insert(self, config: Path, overwrite: bool) -> str:
        results = config.parent / "result"
        command = [sys.executable, "-m", "warpir.insert", "--config", str(config)]
        if overwrite or results == self._results:
            command.append("--overwrite")
        process = subprocess.Popen(
            command,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            errors="replace",
        )
        with self._lock:
            self._process = process
            if self._is_cancelled:
                process.send_signal(signal.SIGINT)
        assert process.stdout is not None
        last = ""
        for line in process.stdout:
            if line.startswith("error: ") or not last.startswith("error: "):
                last = line.strip()
            with self._lock:
                self._progress.update(line=last, share=None)
        if process.wait() != 0:
            raise InputError("warpir.insert", last.removeprefix("error: "))
        self._results = results
        return "result/report.html"


def policy_of(page: bytes) -> str | None:
    """Return the content security policy that a page states in its head; None of other files."""
    found = re.search(rb'http-equiv="Content-Security-Policy" content="([^"]*)"', page[:4096])
    return None if found is None else unescape(found[1].decode())


def _content(path: Path) -> bytes | None:
    try:
        return path.read_bytes()
    except OSError:
        return None
