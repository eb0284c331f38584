"""Reads point clouds: PLY (text or binary), plain text ``x y z ...``, and COLMAP's points."""

import math
import re
from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.cameras.colmap_model import is_model, read_points
from warpir.io.meshes.asset_files import read_regular
from warpir.io.meshes.ply import read_header, read_ply


def read_point_cloud(path: str | Path, limits: Limits = LIMITS) -> Float64Array:
    """Read the positions of a point cloud, shape [point, 3], in the world of the file.

    Args:
        path: A PLY file, recognised by content; a COLMAP model (folder, or one of its files); or
            text with x y z at the start of each line, blanks or commas between.
        limits: How many points, and how large a file.

    Raises:
        InputError: Missing, damaged, without points, or with numbers that are not finite.
    """
    path = Path(path)
    if is_model(path):
        points = read_points(path, limits)
    else:
        content = read_regular(path, path, limits)
        is_ply = re.match(rb"ply\s", content) is not None
        points = (_read_ply if is_ply else _read_text)(path, content, limits)
    if not len(points):
        raise InputError(path, "no points")
    if bad := int((~np.isfinite(points).all(axis=1)).sum()):
        raise InputError(path, f"{bad} of {len(points)} points are not finite")
    return points


def _read_ply(path: Path, content: bytes, limits: Limits) -> Float64Array:
    """Read the vertices of a PLY file."""
    count = read_header(path, content)[0].element("vertex").count
    limits.check("points", count, path, "too many points")
    points = read_ply(path, content).element("vertex").table("x", "y", "z")
    if points is None:
        raise InputError(path, "not a PLY of points (expected vertices with x, y, z)")
    return points


def _read_text(path: Path, content: bytes, limits: Limits) -> Float64Array:
    """Read lines of numbers, blanks and comments (#) left out; the first three are the position."""
    limits.check("points", content.count(b"\n"), path, "too many points", more=" lines")
    text = content.removeprefix(b"\xef\xbb\xbf").replace(b",", b" ")
    rows = []
    for number, line in enumerate(text.split(b"\n"), 1):
        words = line.split()
        if not words or words[0].startswith((b"#", b"//")):
            continue
        try:
            x, y, z = map(float, words[:3])
        except ValueError:
            x = y = z = math.nan
        if not all(map(math.isfinite, (x, y, z))):
            shown = ascii(line[:40].decode("ascii", "replace"))
            raise InputError(
                path, f"line {number}: not a point (found {shown}; expected numbers x y z)"
            )
        rows.append([x, y, z])
    return np.array(rows, dtype=np.float64).reshape(-1, 3)
