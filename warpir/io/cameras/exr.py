"""Reads the camera of an EXR render from OpenEXR's ``worldToCamera`` and ``worldToNDC``.

https://openexr.com/en/latest/StandardAttributes.html: what `warpir.scene.camera.exr_matrices`
makes, read back. The attributes are single precision.
"""

from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.io.cameras.source import CAMERA, PhotoCamera, rigid
from warpir.io.images.decoder import read_exr_header
from warpir.scene.camera import Camera

AFFINE_TOLERANCE = 1e-3
"""How far a projection may be from a pinhole's, relative to its focal lengths."""


def read_exr_camera(path: Path) -> PhotoCamera:
    """Read the camera of an EXR file.

    Raises:
        InputError: Damaged, without both attributes, or not of a pinhole camera.
    """
    header = read_exr_header(path, ("worldToCamera", "worldToNDC"))
    w2c = np.diag([1.0, 1.0, -1.0, 1.0]) @ _matrix(path, header, "worldToCamera").T
    c2w: Float64Array = np.linalg.inv(rigid(path, "worldToCamera", w2c)).astype(np.float64)
    # Columns: camera coordinates; rows: x w, y w, any depth, w of the display window's share.
    projection = _matrix(path, header, "worldToNDC").T @ c2w
    projection = projection / -projection[3, 2] if projection[3, 2] else np.zeros((4, 4))
    scale = abs(projection[0, 0]) + abs(projection[1, 1])
    rest = projection[[0, 0, 1, 1, 3, 3, 3], [1, 3, 0, 3, 0, 1, 3]]
    if not (projection[0, 0] > 0.0 > projection[1, 1]) or (
        np.abs(rest).max() > AFFINE_TOLERANCE * scale
    ):
        raise CAMERA.error(path, "projection", pointer="worldToNDC")
    width, height = header["size"]
    camera = Camera(
        width,
        height,
        float(projection[0, 0] * width),
        float(-projection[1, 1] * height),
        float(-projection[0, 2] * width),
        float(-projection[1, 2] * height),
        c2w,
    )
    return PhotoCamera(camera)


def _matrix(path: Path, header: dict[str, Any], name: str) -> Float64Array:
    """Return a matrix of the header, which multiplies row vectors, shape [4, 4]."""
    values = header[name]
    if not isinstance(values, tuple) or len(values) != 16 or not np.isfinite(values).all():
        raise CAMERA.error(path, "type", pointer=name, expected="a matrix in the EXR header")
    matrix: Float64Array = np.reshape(np.array(values, dtype=np.float64), (4, 4))
    return matrix
