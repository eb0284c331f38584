"""Answers to what the page sends: a light for its camera, a saved placement."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable
from functools import partial
from typing import Any

from warpir.app.config import InsertConfig
from warpir.app.program import say
from warpir.core.strict_json import parse_json_object
from warpir.place.session import (
    PAGE,
    PlacementFolder,
    Session,
    asset_glb,
    kept_values,
    photo_jpeg,
    placement_files,
    sent_camera,
    start_record,
)
from warpir.place.worker import Worker


class Answers:
    """One session's answers.

    Args:
        session: Photo, asset, camera.
        folder: Where placements are saved.
        config: Of the command line, with ``out``.
    """

    def __init__(self, session: Session, folder: PlacementFolder, config: InsertConfig) -> None:
        self.session = session
        self.folder = folder
        self.asked = config.flat()
        self.worker = Worker()
        start = partial(start_record, session, config.light, str(config.output.out))
        self.contents: dict[str, Callable[[], bytes]] = {
            "start.json": lambda: json.dumps(start(), allow_nan=False).encode(),
            "photo.jpg": partial(photo_jpeg, session.photo),
            "asset.glb": partial(asset_glb, session.asset),
        }
        """Files of the page that depend on the session, by address."""
        self.posts: dict[str, Callable[[bytes], dict[str, Any]]] = {
            "save": self.save,
            "light": self.light,
        }
        """What is called with what the page sends, by address."""

    def close(self) -> None:
        """End what still works for the page."""
        self.worker.stop()

    def save(self, body: bytes) -> dict[str, Any]:
        """Write the placement that the page sends; print and return the command that uses it."""
        sent = parse_json_object(PAGE, body)
        path = self.folder.write(placement_files(self.session, self.asked, sent))
        command = f"python -m warpir.insert --config {shlex.quote(str(path))}"
        say(f"saved: {path}")
        say(command)
        return {"command": command, "file": str(path)}

    def light(self, body: bytes) -> dict[str, Any]:
        """Estimate the light that the photo shows, by the camera that the page sends."""
        camera = sent_camera(self.session, parse_json_object(PAGE, body))
        config = kept_values(self.asked)
        return self.worker.ask({"kind": "light", "config": config, "camera": camera.record()})
