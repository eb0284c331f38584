"""Reads the camera calibration of the Waymo Open Dataset from JSON with the fields of its proto.

``CameraCalibration`` in dataset.proto (https://github.com/waymo-research/waymo-open-dataset):
``intrinsic`` is f_u f_v c_u c_v k1 k2 p1 p2 k3 with OpenCV's distortion; ``extrinsic.transform``
leads from the camera to the vehicle, both of whose frames have x forward, y left and z up.
"""

from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import affine_matrix
from warpir.core.strict_json import read_numbers
from warpir.io.cameras.source import (
    CAMERA,
    SHORTEST,
    PhotoCamera,
    choose_frame,
    count,
    member,
    rigid,
)
from warpir.scene.camera import Camera
from warpir.scene.lens import Lens

OURS_TO_WAYMO = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Our axes (right, up, back) in Waymo's (forward, left, up)."""
NAMES = ("UNKNOWN", "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "SIDE_LEFT", "SIDE_RIGHT")
"""``CameraName.Name`` by number."""


def read_waymo(path: Path, content: dict[str, Any], frame: str | None) -> PhotoCamera:
    """Read one calibration, by itself or out of ``camera_calibrations``.

    The content is JSON, names as in the proto or in protobuf's JSON form (camelCase); ``frame`` is
    the name of the camera, such as FRONT; default: the only one.

    Raises:
        InputError: Damaged, or without that camera.
    """
    listed = content.get("camera_calibrations", content.get("cameraCalibrations", [content]))
    if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
        pointer = "/camera_calibrations"
        raise CAMERA.error(path, "type", pointer=pointer, expected="a list of objects")
    names = [_name(entry.get("name", 0)) for entry in listed]
    entry = listed[choose_frame(path, names, frame, None, noun="camera")]
    numbers = read_numbers(path, "/intrinsic", entry.get("intrinsic"), 9)
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    if not min(fx, fy) >= SHORTEST:
        raise CAMERA.error(path, "focal_length", pointer="/intrinsic", found=min(fx, fy))
    transform = member(path, entry, "extrinsic").get("transform")
    flat = read_numbers(path, "/extrinsic/transform", transform, 16)
    camera_to_vehicle = rigid(path, "extrinsic/transform", np.reshape(flat, (4, 4)))
    size = count(path, entry, "width"), count(path, entry, "height")
    camera = Camera(*size, fx, fy, cx, cy, camera_to_vehicle @ affine_matrix(OURS_TO_WAYMO))
    return PhotoCamera(camera, Lens((k1, k2, k3, 0.0), (p1, p2)), OURS_TO_WAYMO.T)


def _name(value: Any) -> str:
    is_number = isinstance(value, int) and 0 <= value < len(NAMES)
    return NAMES[value] if is_number else str(value)
