"""Reads the camera of fSpy: its project file (``.fspy``) and its JSON export.

https://github.com/stuffmatic/fSpy/blob/develop/project_file_format.md
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.limits import Limits
from warpir.core.strict_json import parse_json_object
from warpir.io.cameras.source import (
    CAMERA,
    UP_TO_Y,
    PhotoCamera,
    angle,
    count,
    member,
    number,
    rigid,
)
from warpir.scene.camera import Camera

METRES = {
    "Millimeters": 0.001, "Centimeters": 0.01, "Meters": 1.0, "Kilometers": 1000.0,
    "Inches": 0.0254, "Feet": 0.3048, "Yards": 0.9144, "Miles": 1609.344,
}  # fmt: skip
"""What the units of a reference distance are [m]."""


def read_fspy_project(path: Path, limits: Limits) -> PhotoCamera:
    """Read a binary fSpy project: magic, three u32, JSON, image."""
    with path.open("rb") as stream:
        header = stream.read(16)
        if len(header) < 16:
            raise CAMERA.error(path, "truncated", found=len(header), expected=16)
        version, state_size, image_size = struct.unpack("<3I", header[4:])
        if version != 1:
            raise CAMERA.error(path, "version", found=version, expected=1)
        if image_size == 0:
            raise CAMERA.error(path, "no_image")
        limits.check("json_bytes", state_size, path, "fSpy state too large", more=" bytes")
        state = stream.read(state_size)
    found, expected = path.stat().st_size, 16 + state_size + image_size
    if len(state) < state_size or found < expected:
        raise CAMERA.error(path, "truncated", found=found, expected=expected)
    return read_fspy(path, parse_json_object(path, state, limits))


def read_fspy(path: Path, content: dict[str, Any]) -> PhotoCamera:
    """Read fSpy's camera parameters; its camera axes are ours, its world may stand otherwise."""
    parameters = content.get("cameraParameters", content)
    if parameters is None:
        raise CAMERA.error(path, "unsolved")
    width = count(path, parameters, "imageWidth")
    height = count(path, parameters, "imageHeight")
    centre = member(path, parameters, "principalPoint")
    px, py = number(path, centre, "x"), number(path, centre, "y")
    # fSpy's "horizontal" angle spans the longer side; its principal point has y up.
    fov = angle(path, parameters, "horizontalFieldOfView")
    focal = max(width, height) / 2.0 / float(np.tan(fov / 2.0))
    aspect = width / height
    if aspect > 1.0:
        cx, cy = width / 2.0 * (px + 1.0), height / 2.0 * (1.0 - py * aspect)
    else:
        cx, cy = width / 2.0 * (px / aspect + 1.0), height / 2.0 * (1.0 - py)
    c2w = rigid(path, "cameraTransform", member(path, parameters, "cameraTransform").get("rows"))
    camera_up = c2w[:3, 1]
    k = int(np.argmax(np.abs(camera_up)))
    axis = f"{'+' if camera_up[k] > 0.0 else '-'}{'xyz'[k]}"
    assumed = (f"{axis} of the fSpy world points up; --up overrides",)
    metres, notices = _unit(content)
    c2w[:3, 3] *= metres
    camera = Camera(width, height, focal, focal, cx, cy, c2w, notices, assumed)
    return PhotoCamera(camera, world=UP_TO_Y[axis])


def _unit(content: dict[str, Any]) -> tuple[float, tuple[str, ...]]:
    """Return metres per unit of the fSpy world, and what is done about it.

    A reference distance tells it, which projects have where one was set, and exports never. Without
    one fSpy puts the camera at an arbitrary distance from the origin.
    """
    settings = content.get("calibrationSettingsBase")
    settings = settings if isinstance(settings, dict) else {}
    unit = settings.get("referenceDistanceUnit")
    if settings.get("referenceDistanceAxis") is None or str(unit) not in METRES:
        return 1.0, (
            "no reference distance with a unit in the fSpy file: lengths are in its units, not in "
            "metres (--size, or set one in fSpy and give its .fspy project)",
        )
    converted = f"lengths converted from fSpy's {str(unit).lower()} to metres"
    return METRES[str(unit)], () if unit == "Meters" else (converted,)
