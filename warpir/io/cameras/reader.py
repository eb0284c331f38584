"""The camera of a photograph from a file of any kind that is known; recognised by content.

Each reader returns the camera in the world of its file; here the world is turned so that +Y is up,
and the camera is brought to the photograph's size.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

from warpir.core.arrays import affine_matrix
from warpir.core.errors import ExitCode, InputError, shown
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_json_object
from warpir.io.cameras.colmap import read_colmap
from warpir.io.cameras.colmap_model import is_model
from warpir.io.cameras.exr import read_exr_camera
from warpir.io.cameras.fspy import read_fspy, read_fspy_project
from warpir.io.cameras.gltf import read_gltf_camera
from warpir.io.cameras.nerfstudio import read_nerfstudio
from warpir.io.cameras.source import (
    CAMERA,
    UP_TO_Y,
    PhotoCamera,
    count,
    focal_length,
    number,
    rigid,
)
from warpir.io.cameras.waymo import read_waymo
from warpir.scene.camera import Camera

ASPECT_SLACK = 0.01
"""Most that a camera's picture may differ in shape from the photograph, share of its long side."""
UPSIDE_DOWN = -0.5
"""Height of the camera's unit up vector below which hardly a photograph is meant so."""
ABOUT_UPSIDE_DOWN = (
    "the camera is upside down: of a matrix in OpenCV's axes (+Y down, looking along +Z) negate "
    "the second and third columns; a camera of a photo that EXIF turns must be turned as well; "
    "or give --up"
)


def read_photo_camera(
    path: str | Path,
    photo_size: tuple[int, int],
    up: str | None = None,
    *,
    frame: str | None = None,
    photo_name: str | None = None,
    undistort: bool = False,
    limits: Limits = LIMITS,
) -> PhotoCamera:
    """Read the camera of a photograph.

    Args:
        path: Our ``camera.json``, an fSpy project or export, a COLMAP model (folder, or its images
            file), nerfstudio's ``transforms.json``, Waymo's calibration as JSON, a glTF file with
            a camera, or an EXR file with OpenEXR's camera attributes.
        photo_size: Width and height of the upright photograph [px]. A camera made for another
            size of the same aspect is scaled.
        up: World axis of the file that points up: ``x``, ``y``, ``z``, with a sign if wanted.
            Default: what the format says; for fSpy the axis closest to the camera's up.
        frame: Which of the file's images or cameras; default: the one named as the photograph.
        photo_name: File name of the photograph.
        undistort: Accept lens distortion, which the caller will undo.
        limits: How large the file may be.

    Raises:
        InputError: Missing, malformed, not a rigid right-handed pose, or of another aspect;
            distorted without `undistort`.
    """
    path = Path(path)
    axis = None if up is None else _up_axis(up)
    view = _read(path, photo_size, frame, photo_name, limits)
    if not (view.lens.is_straight or undistort):
        worst = max((*view.lens.radial, *view.lens.tangential), key=abs)
        raise CAMERA.error(path, "distorted", found=worst, expected=0)
    if axis is not None:
        camera = replace(view.camera, assumed=())
        view = replace(view, camera=camera, world=UP_TO_Y[axis], has_up=True)
    camera = replace(view.camera, c2w=affine_matrix(view.world) @ view.camera.c2w)
    if view.has_up and camera.c2w[1, 1] < UPSIDE_DOWN:
        camera = replace(camera, notices=(*camera.notices, ABOUT_UPSIDE_DOWN))
    return replace(view, camera=_fit(path, camera, photo_size))


def read_camera(path: str | Path, photo_size: tuple[int, int], up: str | None = None) -> Camera:
    """As `read_photo_camera`, for a straight photograph: the camera alone."""
    return read_photo_camera(path, photo_size, up).camera


def _up_axis(up: str) -> str:
    axis = up.strip().lower()
    axis = axis if axis[:1] in ("+", "-") else f"+{axis}"
    if axis not in UP_TO_Y:
        raise InputError(
            "--up", f"not an axis (found {up}; expected x, y, z, -x, -y or -z)", code=ExitCode.USAGE
        )
    return axis


def _read(
    path: Path,
    photo_size: tuple[int, int],
    frame: str | None,
    photo_name: str | None,
    limits: Limits,
) -> PhotoCamera:
    """Recognise a file and read it."""
    if is_model(path):
        return read_colmap(path, frame, photo_name, limits)
    magic = _magic(path)
    if magic == b"fspy":
        return read_fspy_project(path, limits)
    if magic == b"\x76\x2f\x31\x01":
        return read_exr_camera(path)
    if magic == b"glTF" or path.suffix.lower() == ".gltf":
        return read_gltf_camera(path, photo_size, frame, limits)
    expected = "fx fy cx cy w h c2w, or a file of fSpy, COLMAP, nerfstudio, Waymo or glTF"
    if magic.startswith((b"\xff\xd8", b"\x89PNG")):
        advice = "leave it out: of the photo the EXIF is read anyway"
        raise CAMERA.error(path, "kind", found="a picture", expected=expected, advice=advice)
    content = read_json_object(path, limits)
    if "cameraTransform" in content or "cameraParameters" in content:
        return read_fspy(path, content)
    if isinstance(content.get("frames"), list):
        return read_nerfstudio(path, content, photo_size, frame, photo_name)
    if any(key in content for key in ("intrinsic", "cameraCalibrations", "camera_calibrations")):
        return read_waymo(path, content, frame)
    if "asset" in content and "nodes" in content:
        return read_gltf_camera(path, photo_size, frame, limits)
    if "fx" in content or "c2w" in content:
        return _read_own(path, content)
    keys = [shown(key) for key in list(content)[:8]]
    raise CAMERA.error(path, "kind", found=f"keys {', '.join(keys) or 'none'}", expected=expected)


def _read_own(path: Path, content: dict[str, Any]) -> PhotoCamera:
    """Read our own ``camera.json``."""
    fx, fy = (focal_length(path, content, key) for key in ("fx", "fy"))
    c2w = rigid(path, "c2w", content.get("c2w"))
    camera = Camera(
        count(path, content, "w"),
        count(path, content, "h"),
        fx,
        fy,
        number(path, content, "cx"),
        number(path, content, "cy"),
        c2w,
    )
    return PhotoCamera(camera)


def _fit(path: Path, camera: Camera, photo_size: tuple[int, int]) -> Camera:
    """Scale to the photograph's size; note what looks odd."""
    width, height = photo_size
    # The other side may have been rounded to a whole pixel, once in each size. Of a camera for a
    # tiny picture that pixel says nothing of the shape.
    slack = max(width / camera.width, height / camera.height)
    slack = max(min(slack, ASPECT_SLACK * max(width, height)), 1.0)
    if (
        abs(camera.width * height / camera.height - width) > slack
        and abs(camera.height * width / camera.width - height) > slack
    ):
        size = camera.width, camera.height
        raise CAMERA.error(path, "aspect", found=size, expected=photo_size)
    notices = list(camera.notices)
    if (camera.width, camera.height) != photo_size:
        notices.append(
            f"camera scaled from {camera.width} x {camera.height} to the photograph's "
            f"{width} x {height}"
        )
    if not (0.0 <= camera.cx <= camera.width and 0.0 <= camera.cy <= camera.height):
        notices.append(f"principal point ({camera.cx:.1f}, {camera.cy:.1f}) lies outside the image")
    return replace(camera.scaled(width, height), notices=tuple(notices))


def _magic(path: Path) -> bytes:
    """Return the first four bytes of a file; none where there is none, for the reader to say."""
    try:
        if not path.is_file():  # opening a pipe would wait for its other end
            return b""
        with path.open("rb") as stream:
            return stream.read(4)
    except OSError:
        return b""
