"""Answers to what the page sends: a light for its camera, a saved placement, a picture."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from warpir.app.config import InsertConfig, replaced_by
from warpir.app.program import say
from warpir.core.strict_json import parse_json_object
from warpir.place.renderings import Renderings
from warpir.place.session import (
    CONFIG,
    PAGE,
    PlacementFolder,
    Session,
    asset_glb,
    kept_values,
    mask_layer,
    photo_jpeg,
    placement_files,
    sent_camera,
    start_record,
)
from warpir.place.worker import Worker


class Answers:
    """One session's answers; placements are saved in ``folder``, the configuration has ``out``.

    What is ``unseen`` by the page is saved beside what it sends.
    """

    def __init__(
        self,
        session: Session,
        folder: PlacementFolder,
        config: InsertConfig,
        unseen: Mapping[str, Any],
    ) -> None:
        self.session = session
        self.unseen = unseen
        self.folder = folder
        self.asked = config.flat()
        self.worker = Worker()
        self.renderings = Renderings(self.worker)
        start = partial(start_record, session, config.light, str(config.output.out))
        self.contents: dict[str, Callable[[], bytes]] = {
            "start.json": lambda: json.dumps(start(), allow_nan=False).encode(),
            "photo.jpg": partial(photo_jpeg, session.photo),
            "asset.glb": partial(asset_glb, session.asset),
        }
        if session.mask is not None:
            self.contents["mask.png"] = partial(mask_layer, session.mask)
        """Files of the page that depend on the session, by address."""
        self.posts: dict[str, Callable[[bytes], dict[str, Any]]] = {
            "save": self.save,
            "light": self.light,
            "warm": self.warm,
            "preview": self.preview,
            "insert": self.insert,
            "cancel": lambda _: self.renderings.cancel(),
        }
        """What is called with what the page sends, by address."""

    def close(self) -> None:
        """End what still works for the page."""
        self.worker.close()
        self.renderings.close()

    def file(self, name: str) -> bytes | None:
        """Return what changes while the page is open, by its address: progress and pictures."""
        if name == "progress.json":
            return json.dumps(self.renderings.progress()).encode()
        return self.renderings.file(name)

    def save(self, body: bytes) -> dict[str, Any]:
        """Write the placement that the page sends; print and return the command that uses it."""
        files = self._files(body)
        placed = files[CONFIG]
        assert isinstance(placed, dict)
        kept = {n: v for n, v in self.unseen.items() if n not in replaced_by(placed, self.unseen)}
        path = self.folder.write({**files, CONFIG: {**kept, **placed}})
        command = f"python -m warpir.insert --config {shlex.quote(str(path))}"
        say(f"saved: {path}")
        say(command)
        return {"command": command, "file": str(path)}

    def light(self, body: bytes) -> dict[str, Any]:
        """Estimate the light that the photo shows, by the camera that the page sends."""
        camera = sent_camera(self.session, parse_json_object(PAGE, body))
        config = kept_values(self.asked)
        return self.worker.ask({"kind": "light", "config": config, "camera": camera.record()})

    def warm(self, body: bytes) -> dict[str, Any]:
        """Prepare for a preview of the placement that the page sends, as long as that takes."""
        self.renderings.warm_up(self._files(body))
        return {}

    def preview(self, body: bytes) -> dict[str, Any]:
        """Begin a preview of the placement that the page sends."""
        return self.renderings.preview(self._files(body))

    def insert(self, body: bytes) -> dict[str, Any]:
        """Save the placement that the page sends, and begin its insertion."""
        saved = self.save(body)
        return {**saved, **self.renderings.insert(Path(saved["file"]), self.folder.overwrite)}

    def _files(self, body: bytes) -> dict[str, dict[str, Any] | bytes]:
        sent = parse_json_object(PAGE, body)
        return placement_files(self.session, self.asked, sent)
