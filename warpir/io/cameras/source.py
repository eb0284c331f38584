"""What every reader of a camera file returns, and the checks that they share."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array, affine_matrix
from warpir.core.errors import Faults
from warpir.scene.camera import Camera
from warpir.scene.lens import STRAIGHT, Lens

RIGID_TOLERANCE = 1e-4
"""How far R^T R may be from the identity; smaller errors are removed."""
LARGEST = 1e15
"""Largest number of a camera: of a matrix, an offset, a focal length."""
SHORTEST = 1e-6
"""Shortest focal length [px]: one pixel sees 179.9999 degrees, and squares of rays are finite."""
SIZE_LIMIT = 1_000_000
"""Widest and highest image taken for one [px]."""
NAMES_SHOWN = 8
CAMERA = Faults(
    "camera",
    {
        "aspect": (
            "made for a picture of another shape",
            "use the camera of this photograph, before cropping or turning it",
        ),
        "distorted": (
            "the photograph is distorted by a coefficient",
            "--undistort straightens photo and composite; or give a photo without distortion",
        ),
        "field_of_view": "not a field of view",
        "focal_length": "not a focal length",
        "frame": ("{problem}: {names}", "name one with --frame"),
        "kind": "not a camera that warpir reads",
        "last_row": "last row is not 0 0 0 1",
        "left_handed": (
            "left-handed",
            "export it with right-handed axes: camera along -Z, +Y up, +X right",
        ),
        "matrix": "not a matrix of numbers",
        "no_focal_length": "no focal length",
        "no_image": ("fSpy project without an image", "open and save it in fSpy"),
        "not_finite": "numbers that are not finite",
        "not_perspective": ("not a perspective camera", "undistort the images first"),
        "not_rigid": "not orthonormal, its axes are off",
        "number": "not a number that can be used",
        "projection": "not the projection of a pinhole camera",
        "scaled": ("scaled", "remove the scale from the camera"),
        "shape": "not a matrix of this shape",
        "size": "not an image size",
        "too_large": "numbers beyond every use",
        "transposed": ("transposed", "transpose the matrix"),
        "truncated": "truncated fSpy project",
        "type": "missing or of another kind",
        "unsolved": (
            "fSpy found no camera in this project (cameraParameters is null)",
            "place the vanishing lines in fSpy until it shows a camera, save again",
        ),
        "version": "fSpy project of another version",
    },
)
"""What a camera file may have wrong; ``pointer`` is the place in it."""

UP_TO_Y: dict[str, Float64Array] = {
    "+x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "-x": np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "+y": np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]),
    "+z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
"""Rotations that turn a world whose up axis is the key into ours."""


@dataclass(frozen=True)
class PhotoCamera:
    """The camera of a photograph, and what else its file says."""

    camera: Camera
    """As its reader returns it, in the world of the file; then in ours, at the photograph's
    resolution. What `world` rests on, unless the user says which way is up, is in `assumed`."""
    lens: Lens = STRAIGHT
    """What bent the photograph; undone with ``--undistort``."""
    world: Float64Array = field(default_factory=lambda: np.eye(3))
    """Rotation from the file's world to ours, shape [3, 3]."""
    has_up: bool = True
    """Whether it is known which way is up; else our world is the file's, as it happens to lie."""


def choose_frame(
    path: Path, names: Sequence[str], frame: str | None, photo: str | None, noun: str = "image"
) -> int:
    """Return which of a file's images is meant: by ``--frame``, else by the photo's file name.

    Folders and suffixes may be left out of the names. A name stands for a ``noun``.

    Raises:
        InputError: None or several fit; lists the first names.
    """
    wanted = frame if frame is not None else photo
    if wanted is not None:
        # Blender's files leave the suffix out, and a photo may have been saved as another kind.
        name = PurePosixPath(wanted).name
        stem = PurePosixPath(wanted).stem
        for found in (
            [k for k, n in enumerate(names) if n == wanted],
            [k for k, n in enumerate(names) if PurePosixPath(n).name == name],
            [k for k, n in enumerate(names) if PurePosixPath(n).stem == stem],
        ):
            if len(found) == 1:
                return found[0]
            if found:
                names = [names[k] for k in found]
                break
    if frame is None and len(names) == 1:
        return 0
    listed = ", ".join(ascii(name)[1:-1] for name in names[:NAMES_SHOWN])
    rest = len(names) - NAMES_SHOWN
    listed += f" and {rest} more" if rest > 0 else ""
    what = f"which {noun} is meant" if wanted is None else f"no one {noun} is {ascii(wanted)[:80]}"
    raise CAMERA.error(path, "frame", problem=what, found=len(names), names=listed or "none")


def rigid(path: Path, name: str, rows: Any) -> Float64Array:
    """Check a camera-to-world matrix given as 3 or 4 rows; return it exactly rigid, [4, 4]."""
    pointer = f"/{name}"
    matrix = _affine(path, pointer, rows)
    rotation = matrix[:3, :3]
    if (largest := float(np.abs(matrix).max())) > LARGEST:
        raise CAMERA.error(path, "too_large", pointer=pointer, found=largest, limit=LARGEST)
    product = rotation.T @ rotation
    scale = float(np.trace(product)) / 3.0
    deviation = float(np.abs(product - np.eye(3)).max())
    if deviation > RIGID_TOLERANCE:
        if scale > 0.0 and np.abs(product / scale - np.eye(3)).max() <= RIGID_TOLERANCE:
            raise CAMERA.error(
                path, "scaled", pointer=pointer, found=float(np.sqrt(scale)), expected=1
            )
        raise CAMERA.error(
            path, "not_rigid", pointer=pointer, found=deviation, limit=RIGID_TOLERANCE
        )
    if np.linalg.det(rotation) < 0.0:
        raise CAMERA.error(path, "left_handed", pointer=pointer, found="determinant -1")
    left, _, right = np.linalg.svd(rotation)
    return affine_matrix(left @ right, matrix[:3, 3])


def _affine(path: Path, pointer: str, rows: Any) -> Float64Array:
    """Return a finite matrix whose last row is 0 0 0 1, [4, 4], or refuse the file."""
    try:
        matrix = np.array(rows)
        if matrix.dtype.kind not in "if":
            raise ValueError
        matrix = matrix.astype(np.float64)
    except (TypeError, ValueError) as error:
        raise CAMERA.error(path, "matrix", pointer=pointer) from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4):
        raise CAMERA.error(
            path, "shape", pointer=pointer, found=matrix.shape, expected="4 x 4 or 3 x 4"
        )
    if not np.isfinite(matrix).all():
        raise CAMERA.error(path, "not_finite", pointer=pointer)
    last = np.array([0.0, 0.0, 0.0, 1.0])
    if np.abs(matrix[3] - last).max() > RIGID_TOLERANCE:
        if np.abs(matrix[:, 3] - last).max() <= RIGID_TOLERANCE:
            raise CAMERA.error(
                path, "transposed", pointer=pointer, found="the translation in the last row"
            )
        found = " ".join(f"{x:g}" for x in matrix[3])
        raise CAMERA.error(path, "last_row", pointer=pointer, found=found)
    return matrix


def member(path: Path, content: Any, key: str) -> dict[str, Any]:
    """Return an object within an object, or refuse the file."""
    value = content.get(key) if isinstance(content, dict) else None
    if not isinstance(value, dict):
        raise CAMERA.error(path, "type", pointer=f"/{key}", expected="an object")
    return value


def number(path: Path, content: Any, key: str) -> float:
    """Return a number of an object, or refuse the file."""
    value = content.get(key) if isinstance(content, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or abs(value) > LARGEST:
        raise CAMERA.error(path, "number", pointer=f"/{key}", found=str(value)[:40])
    return float(value)


def focal_length(path: Path, content: Any, key: str) -> float:
    """Return a focal length of an object [px], or refuse the file."""
    value = number(path, content, key)
    if value < SHORTEST:
        expected = f"at least {SHORTEST:g} px"
        raise CAMERA.error(path, "focal_length", pointer=f"/{key}", found=value, expected=expected)
    return value


def angle(path: Path, content: Any, key: str) -> float:
    """Return a field of view of an object [rad], between 0 and pi, or refuse the file."""
    value = number(path, content, key)
    if not 0.0 < value < np.pi:
        raise CAMERA.error(
            path, "field_of_view", pointer=f"/{key}", found=value, expected="0 to pi"
        )
    return value


def count(path: Path, content: Any, key: str) -> int:
    """Return an image size of an object [px], or refuse the file."""
    value = number(path, content, key)
    if value != int(value) or not 1 <= value <= SIZE_LIMIT:
        raise CAMERA.error(path, "size", pointer=f"/{key}", found=value, expected="whole pixels")
    return int(value)
