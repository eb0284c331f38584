"""Reads the ``transforms.json`` of nerfstudio, Instant-NGP and Blender's NeRF scenes.

https://docs.nerf.studio/quickstart/data_conventions.html: OpenGL's camera axes, which are ours, in
a world with +Z up; pixels have their centres at + 0.5, so the principal point is used as it is.
"""

from pathlib import Path
from typing import Any

import numpy as np

from warpir.io.cameras.source import (
    CAMERA,
    UP_TO_Y,
    PhotoCamera,
    angle,
    choose_frame,
    count,
    focal_length,
    number,
    rigid,
)
from warpir.scene.camera import Camera
from warpir.scene.lens import Lens

PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "PERSPECTIVE")
"""Values of ``camera_model`` that share the distortion model of `Lens`."""
BENDS = ("k1", "k2", "k3", "k4", "p1", "p2")


def read_nerfstudio(
    path: Path,
    content: dict[str, Any],
    photo_size: tuple[int, int],
    frame: str | None,
    photo: str | None,
) -> PhotoCamera:
    """Read the camera of one frame; what the frame says goes before what the file says.

    ``frame`` is the name of the frame's picture; default: the photo's, or the only one. Files that
    give only an angle need the photo's width and height [px].

    Raises:
        InputError: Damaged, fisheye, or without that frame.
    """
    frames = content["frames"]
    names = [f.get("file_path") if isinstance(f, dict) else None for f in frames]
    for k, name in enumerate(names):
        if not isinstance(name, str):
            raise CAMERA.error(path, "type", pointer=f"/frames/{k}/file_path", expected="a text")
    k = choose_frame(path, [str(name) for name in names], frame, photo, noun="frame")
    said = {**content, **frames[k]}
    model = said.get("camera_model", "OPENCV")
    if model not in PERSPECTIVE or said.get("is_fisheye"):
        found = "is_fisheye" if said.get("is_fisheye") else f"camera_model {ascii(model)[:60]}"
        raise CAMERA.error(path, "not_perspective", found=found, expected=", ".join(PERSPECTIVE))
    width, height = photo_size
    if "w" in said or "h" in said or "fl_x" in said:
        width, height = count(path, said, "w"), count(path, said, "h")
    fx = _focal(path, said, "x", width)
    fy = _focal(path, said, "y", height)
    if fx is None:
        raise CAMERA.error(path, "no_focal_length", expected="fl_x or camera_angle_x")
    k1, k2, k3, k4, p1, p2 = (number(path, said, key) if key in said else 0.0 for key in BENDS)
    matrix = f"frames/{k}/transform_matrix"
    camera = Camera(
        width,
        height,
        fx,
        fx if fy is None else fy,
        number(path, said, "cx") if "cx" in said else width / 2.0,
        number(path, said, "cy") if "cy" in said else height / 2.0,
        rigid(path, matrix, frames[k].get("transform_matrix")),
        (
            "only the exporter of the transforms.json knows whether its lengths are metres; those "
            "found by COLMAP are not (--size)",
        ),
        assumed=(
            "+z of the transforms.json points up, as nerfstudio has it; only its exporter "
            "knows whether gravity agrees (--up, --ground)",
        ),
    )
    return PhotoCamera(camera, Lens((k1, k2, k3, k4), (p1, p2)), UP_TO_Y["+z"])


def _focal(path: Path, said: dict[str, Any], axis: str, side: int) -> float | None:
    """Return the focal length along an axis [px], from itself or the field of view."""
    if f"fl_{axis}" in said:
        return focal_length(path, said, f"fl_{axis}")
    key = f"camera_angle_{axis}"
    # Instant-NGP writes angles beside focal lengths: then fl_x stands for both axes.
    if key not in said or (axis == "y" and "fl_x" in said):
        return None
    return float(side / 2.0 / np.tan(angle(path, said, key) / 2.0))
