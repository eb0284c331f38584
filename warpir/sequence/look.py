"""One look for a sequence: what its camera did, estimated in one frame for all."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from warpir.app.inputs import Inputs, Loaders, read_inputs
from warpir.core.strict_json import json_bytes, read_json_object
from warpir.sequence.frames import Frame

if TYPE_CHECKING:
    from warpir.app.run import Run
    from warpir.io.images.photos import Photo
    from warpir.lighting.scene_light import SceneLight
    from warpir.look.camera_look import CameraLook

Kind = tuple[int, int, bool]


class FirstLook:
    """Gives all frames of one size the look of the first of them that shows the object.

    One camera took them, and estimates of single frames would let the object flicker. A linear
    plate and a photo of one size are two kinds. That frame is read again where it is done already.
    """

    def __init__(self, loaders: Loaders) -> None:
        """Read frames by the loaders that have read all of them before."""
        self._loaders = loaders
        self._frames: list[tuple[Frame, Kind]] = []
        self._first: dict[Kind, tuple[Frame, bool]] = {}
        self._found: dict[Kind, CameraLook] = {}

    def look_at(self, frame: Frame, inputs: Inputs) -> None:
        """Take note of a frame; all of them, in their order, come before the first look."""
        kind, is_seen = _kind(inputs.photo), inputs.placement.is_seen
        self._frames.append((frame, kind))
        if kind not in self._first or (is_seen and not self._first[kind][1]):
            self._first[kind] = frame, is_seen

    def __call__(self, run: Run, light: SceneLight) -> CameraLook:
        """Return the look of a frame, as `warpir.report.result.look_of` does of a photo.

        Raises:
            InputError: The frame that tells it cannot be read any more.
        """
        from warpir.report.result import estimated_look, look_of  # loads Warp

        kind = _kind(run.inputs.photo)
        if kind not in self._first:  # another file since the check
            return look_of(run, light)
        if kind not in self._found:
            frame, _ = self._first[kind]
            is_own = frame.config.output.out == run.config.output.out
            inputs = run.inputs if is_own else read_inputs(frame.config, self._loaders)
            look, asked = estimated_look(inputs, run.config.look, light.curves), run.config.look
            is_told = "auto" in (asked.sharpness, asked.response, asked.grain)
            self._found[kind] = replace(look, frame=frame.folder.name if is_told else None)
        return look_of(run, light, self._found[kind])

    def others(self) -> list[str]:
        """Return which finished frames have another look than those rendered by this one.

        Of a size of which none was rendered there is nothing to compare with: the frame that tells
        the look may itself have an earlier one.
        """
        told = {
            kind: _parts(json.loads(json_bytes(look.record())))
            for kind, look in self._found.items()
        }
        return [
            frame.folder.name
            for frame, kind in self._frames
            if kind in told and _written(frame) != told[kind]
        ]


def _written(frame: Frame) -> list[Any]:
    return _parts(read_json_object(frame.folder / "run.json").get("measured", {}).get("look", {}))


def _parts(look: dict[str, Any]) -> list[Any]:
    return [look.get(part) for part in ("blur", "grain", "response", "toning")]


def _kind(photo: Photo) -> Kind:
    height, width = photo.codes.shape[:2]
    return height, width, photo.is_linear
