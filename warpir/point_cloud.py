"""Reads point clouds: PLY (text or binary), plain text ``x y z ...``, and COLMAP's points."""

import math
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warpir.asset_files import read_regular
from warpir.colmap_model import is_model, read_points
from warpir.errors import InputError

Float64Array = NDArray[np.float64]

PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
PLY_FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_BYTES = 65536
"""Longest PLY header."""


def read_point_cloud(path: str | Path) -> Float64Array:
    """Read the positions of a point cloud, shape [point, 3], in the world of the file.

    Args:
        path: A PLY file, recognised by content; a COLMAP model (folder, or one of its files); or
            text with x y z at the start of each line, blanks or commas between.

    Raises:
        InputError: Missing, damaged, without points, or with numbers that are not finite.
    """
    path = Path(path)
    if is_model(path):
        points = read_points(path)
    else:
        content = read_regular(path, path)
        is_ply = re.match(rb"ply\s", content) is not None
        points = _read_ply(path, content) if is_ply else _read_text(path, content)
    if not len(points):
        raise InputError(path, "no points")
    if bad := int((~np.isfinite(points).all(axis=1)).sum()):
        raise InputError(path, f"{bad} of {len(points)} points are not finite")
    return points


def _read_ply(path: Path, content: bytes) -> Float64Array:
    """Read the vertices of a PLY file; what follows them is left alone."""
    found = re.search(rb"\nend_header[ \t]*\r?\n", content[:HEADER_BYTES])
    if found is None:
        raise InputError(path, "damaged PLY: the header has no end")
    lines = content[: found.start()].decode("ascii", "replace").split("\n")[1:]
    order, count, properties = None, None, []
    for number, line in enumerate(lines, 2):
        words = line.split()
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in PLY_FORMATS:
            order = PLY_FORMATS[words[1]]
        elif words[0] == "element" and count is not None:
            break
        elif words[:2] == ["element", "vertex"] and words[2:] and words[2].isdigit():
            count = int(words[2][:15])
        elif words[0] == "property" and count is not None and words[1] in PLY_TYPES:
            properties.append((words[2], PLY_TYPES[words[1]]))
        else:
            raise InputError(
                path, f"line {number}: not understood in a PLY of points ({line[:40]!a})"
            )
    names = [name for name, _ in properties]
    if order is None or count is None or not {"x", "y", "z"} <= set(names):
        raise InputError(path, "not a PLY of points (expected a format and vertices with x, y, z)")
    body = content[found.end() :]
    if not order:
        rows = body.split(b"\n")[:count]
        if len(rows) < count or not rows[-1].strip():
            raise InputError(path, f"truncated (found fewer than {count} lines of vertices)")
        columns = [names.index(axis) for axis in "xyz"]
        return _rows(path, rows, columns, len(lines) + 2)
    record = np.dtype([(name, order + kind) for name, kind in properties])
    if len(body) < count * record.itemsize:
        raise InputError(
            path,
            f"truncated (found {len(body)} bytes; expected {count * record.itemsize} of {count} "
            "vertices)",
        )
    vertices = np.frombuffer(body, record, count)
    return np.stack([vertices[axis].astype(np.float64) for axis in "xyz"], axis=1)


def _read_text(path: Path, content: bytes) -> Float64Array:
    """Read lines of numbers; the first three are the position."""
    text = content.removeprefix(b"\xef\xbb\xbf").replace(b",", b" ")
    return _rows(path, text.split(b"\n"), [0, 1, 2], 1)


def _rows(path: Path, lines: list[bytes], columns: list[int], first: int) -> Float64Array:
    """Return three columns of lines of numbers; blank lines and comments (#) are passed over."""
    rows = []
    for number, line in enumerate(lines, first):
        words = line.split()
        if not words or words[0].startswith((b"#", b"//")):
            continue
        try:
            rows.append([float(words[column]) for column in columns])
        except (ValueError, IndexError):
            rows.append([math.nan])
        if not all(map(math.isfinite, rows[-1])):
            shown = ascii(line[:40].decode("ascii", "replace"))
            raise InputError(
                path, f"line {number}: not a point (found {shown}; expected numbers x y z)"
            )
    return np.array(rows, dtype=np.float64).reshape(-1, 3)
