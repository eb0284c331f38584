"""The page of a batch, ``batch.html``: thumbnails that link to reports, and failures."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import quote

from warpir.batch.scene import LOGS, STATES, Scene
from warpir.batch.task import DONE_BEFORE
from warpir.core.errors import InputError
from warpir.core.progress import duration
from warpir.report.facts import without_folders
from warpir.report.html import render_page
from warpir.report.page import REPORT
from warpir.report.pictures import thumbnail

PAGE = "batch.html"
SHOWN = 240
"""Most scenes with a picture, spread over the batch: the page stays small."""


def batch_page(manifest: Path, out: Path, scenes: Sequence[Scene], seconds: float) -> bytes:
    """Return the page, in UTF-8, of all scenes, whose results are in ``out``.

    The manifest's name is the title; ``seconds`` are what the batch has taken.
    """
    counts = [(state, sum(scene.state == state for scene in scenes)) for state in STATES]
    every = max(1, -(-len(scenes) // SHOWN))
    return render_page(
        "batch",
        package="warpir.batch",
        kind="warpir, summary of a batch",
        title=f"{manifest.name}: {len(scenes)} scenes",
        lead=", ".join(f"{n} {state}" for state, n in counts if n) + f", in {duration(seconds)}.",
        failed=[_failure(scene) for scene in scenes if scene.state == "failed"],
        scenes=[
            _card(scene, out, k % every == 0)
            for k, scene in enumerate(scenes)
            if scene.state in ("done", DONE_BEFORE)
        ],
    )


def _failure(scene: Scene) -> dict[str, Any]:
    config = scene.row.config
    asked = {} if config is None else config.flat()
    return {
        "title": scene.title,
        "line": scene.row.line,
        "code": int(scene.status),
        "reason": without_folders(scene.reason, asked),
        "more": [without_folders(line, asked) for line in scene.lines[1:]],
        "log": quote(f"{LOGS}/{scene.row.name}.log") if scene.has_log else "",
    }


def _card(scene: Scene, out: Path, has_picture: bool) -> dict[str, Any]:
    """Return what the page shows of a finished scene; of a sequence, its first frame."""
    folder = out / str(scene.row.name)
    pages = (REPORT, "sequence.html", "composite.png", "sequence.json")
    target = next((name for name in pages if (folder / name).is_file()), "run.json")
    path = folder / "composite.png"
    if target == "sequence.html" or not path.is_file():
        path = next(iter(sorted(folder.glob("[0-9]*/composite.png"))), path)
    picture = None
    if has_picture:
        assert scene.row.config is not None
        with suppress(InputError):  # removed meanwhile: the link is what is left
            picture = thumbnail(path, scene.row.config.limits.pixels)
    return {
        "name": scene.title,
        "target": quote(f"{scene.row.name}/{target}"),
        "picture": picture,
        "state": scene.state,
        "seconds": f"{scene.seconds:.1f} s" if scene.seconds else "",
        "retries": len(scene.retries),
    }
