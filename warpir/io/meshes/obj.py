"""Reads OBJ into an `Asset`, one primitive per material.

Parsed here and not by a library: trimesh 5.2 cuts concave polygons into fans and does not read
``Pr`` and ``Pm``. Materials come from `warpir.io.meshes.mtl`. The texture coordinate v is turned
from up to down.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray, Int64Array, IntArray
from warpir.core.color import srgb_to_linear
from warpir.core.errors import Faults, InputError
from warpir.core.limits import Limits
from warpir.io.meshes.asset_files import concise, read_regular
from warpir.io.meshes.mtl import MaterialLibrary
from warpir.io.meshes.triangles import (
    LARGEST,
    check_drawable,
    check_triangle_count,
    drop_without_area,
    triangulate,
    unit_normals,
)
from warpir.scene.asset import Asset, Primitive

OBJ = Faults(
    "obj",
    {
        "color": (
            "v with {found} numbers (expected x y z r g b)",
            "export colours of three numbers, or as GLB",
        ),
        "face": "face with {found} corners",
        "index_out_of_range": "corner {found}, but {limit} {word} (indices start at 1)",
        "kind": ("not an OBJ file", "convert it to GLB"),
        "polygon": ("face with more corners than can be triangulated", "triangulate it"),
        "number": "{found}, expected {count} numbers up to {limit:g}",
    },
)
"""What a file may have wrong."""
WIDTHS = {"v": 3, "vt": 2, "vn": 3}
"""Statements that the three indices of a corner count, and how many numbers they have."""
MOST_CORNERS = 1 << 16
"""Corners of a face, which take a second; a concave one may have fewer (`triangulate`)."""
NAMED = ("usemtl", "mtllib")
"""Statements that end in a name, which may hold ``#`` (3ds Max: ``Material #1``)."""
IGNORED = {"o", "g", "s", "vp", "shadow_obj", "trace_obj", "lod", "bevel", "c_interp", "d_interp"}


def read_obj(path: Path, missing_textures: str, limits: Limits) -> Asset:
    """Read an ``.obj`` file; its material files and textures must lie in its folder.

    With missing textures ``grey`` instead of an ``error``, a missing material file or base colour
    texture becomes grey, other textures are left out, with a notice.

    Returns:
        Double-sided materials; grey, rough and dielectric where the file states none.

    Raises:
        InputError: The file is damaged, with the line at fault, or holds no triangles.
    """
    notices: list[str] = []
    hashes: dict[str, str] = {}
    text = _read_statements(path, read_regular(path, path, limits, hashes=hashes), notices)
    library = MaterialLibrary(path, missing_textures, notices, hashes, limits)
    for name in text.libraries:
        library.add(name)
    triangle_count = sum(len(c) - 2 for faces in text.faces.values() for _, c in faces)
    check_triangle_count(path, triangle_count, limits)
    positions, uvs, normals = (
        np.array(text.tables[word], dtype=np.float64).reshape(-1, width)
        for word, width in WIDTHS.items()
    )
    colors = _vertex_colors(text.colors, len(positions), notices)
    vertices = Vertices(positions, uvs, normals, colors)
    primitives = []
    for name, faces in text.faces.items():
        primitive = _read_primitive(path, name, faces, vertices, library, notices)
        if primitive is not None:
            primitives.append(primitive)
    check_drawable(path, primitives, f"{len(positions)} vertices")
    return Asset(
        name=path.stem,
        primitives=tuple(primitives),
        materials=tuple(library.materials),
        textures=tuple(library.textures),
        notices=concise(notices),
        hashes=hashes,
    )


Face = tuple[int, list[str]]
"""A face: its line and its corners as written, negative indices made absolute."""


@dataclass
class Statements:
    """What an OBJ file states, sorted by kind; line numbers start at 1."""

    tables: dict[str, list[list[float]]] = field(default_factory=lambda: {w: [] for w in WIDTHS})
    """Rows of positions, texture coordinates and normals, by their word."""
    colors: dict[int, list[float]] = field(default_factory=dict)
    """Red, green and blue of the positions that have them, by index of the position."""
    faces: dict[str, list[Face]] = field(default_factory=dict)
    """By name of the material."""
    libraries: list[str] = field(default_factory=list)

    def counts(self) -> list[int]:
        """Return how many positions, texture coordinates and normals there are so far."""
        return [len(rows) for rows in self.tables.values()]


@dataclass(frozen=True)
class Vertices:
    """The tables that the corners of faces refer to."""

    positions: Float64Array
    """Shape [position, 3]."""
    uvs: Float64Array
    """v up, shape [uv, 2]."""
    normals: Float64Array
    """Any length, shape [normal, 3]."""
    colors: FloatArray | None
    """Linear RGBA of the positions, shape [position, 4]."""


def _read_statements(path: Path, content: bytes, notices: list[str]) -> Statements:
    """Read the lines of an OBJ file, or refuse it with the line at fault."""
    if b"\0" in content[:4096]:
        raise OBJ.error(path, "kind", found="no text")
    try:
        whole = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        whole = content.decode("latin-1")
    text = Statements()
    material = ""
    left_out: Counter[str] = Counter()
    for line, statement in _logical_lines(whole):
        word, *values = statement.split()
        match word:
            case "v" | "vt" | "vn":
                rows = text.tables[word]
                if word == "v" and len(values) > 6:  # a weight, or an opacity, beside the colour
                    raise OBJ.error(path, "color", line=line, found=len(values))
                if word == "v" and len(values) == 6:
                    text.colors[len(rows)] = _numbers(path, line, word, values[3:], 3)
                if word == "vt" and len(values) == 1:
                    values.append("0")  # v is optional; the format says 0
                rows.append(_numbers(path, line, word, values, WIDTHS[word]))
            case "f":
                if len(values) < 3:
                    raise OBJ.error(path, "face", line=line, found=len(values))
                if len(values) > MOST_CORNERS:
                    raise OBJ.error(
                        path, "polygon", line=line, found=len(values), limit=MOST_CORNERS
                    )
                if "-" in statement:
                    values = [_absolute(path, line, v, text.counts()) for v in values]
                text.faces.setdefault(material, []).append((line, values))
            case "usemtl":
                material = statement[len(word) :].strip()
            case "mtllib":
                text.libraries.append(statement[len(word) :].strip())
            case _ if word not in IGNORED:
                left_out[word] += 1
    if not (text.tables["v"] or text.faces):
        raise OBJ.error(path, "kind", found="no v and no f statements")
    notices += [f"{count} {word[:20]!r} statements ignored" for word, count in left_out.items()]
    painted = _polypaint(whole)
    if len(painted) == len(text.tables["v"]) and not text.libraries:
        text.colors = dict(enumerate(painted)) | text.colors
    elif painted:
        notices.append("polypaint (#MRGB) not read: beside materials, or not of every vertex")
    return text


def _polypaint(text: str) -> list[list[float]]:
    """Return ZBrush's colours of the vertices, which stand in comments: mask, red, green, blue."""
    digits = "".join(re.findall(r"^#MRGB ((?:[0-9A-Fa-f]{8})+)\s*$", text, re.MULTILINE))
    codes = np.frombuffer(bytes.fromhex(digits), np.uint8).reshape(-1, 4)[:, 1:]
    colors: list[list[float]] = (codes / 255.0).tolist()
    return colors


def _logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield line numbers and statements, continued lines joined and comments removed.

    Names are kept whole; of the other statements all from ``#`` on is a comment.
    """
    pending: list[str] = []
    start = 0
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        start = start if pending else number
        line = line.strip()
        word = (pending[0] if pending else line).split(maxsplit=1)
        if "#" in line and word and word[0] not in NAMED:
            line = line.partition("#")[0].rstrip()
        if line.endswith("\\"):
            pending.append(line[:-1] + " ")
            continue
        if statement := "".join([*pending, line]):
            yield start, statement
        pending = []
    if statement := "".join(pending).strip():
        yield start, statement


def _numbers(path: Path, line: int, word: str, values: list[str], width: int) -> list[float]:
    """Return the first numbers of a statement, all of which float32 holds, or refuse it."""
    try:
        numbers = [float(value) for value in values[:width]]
        sound = len(numbers) == width and all(abs(number) < LARGEST for number in numbers)
    except ValueError:
        sound = False
    if not sound or any("_" in value for value in values[:width]):  # Python reads 1_0 as 10
        found = repr(" ".join([word, *values])[:60])
        advice = "write numbers with decimal points" if "," in found else ""
        raise OBJ.error(
            path, "number", line=line, found=found, count=width, limit=LARGEST, advice=advice
        )
    return numbers


def _absolute(path: Path, line: int, corner: str, counts: list[int]) -> str:
    """Rewrite ``-1/-2/-3`` as indices from 1, counted from the statements read so far."""
    parts = corner.split("/")
    for k, part in enumerate(parts[:3]):
        if re.fullmatch(r"-[0-9]+", part):  # what else begins so is refused by `_unique_corners`
            value = counts[k] + 1 - int(part[1:20])  # of more digits it is out of range anyway
            if not 1 <= value <= counts[k]:
                raise _no_such(path, line, part[:20], k, counts)
            parts[k] = str(value)
    return "/".join(parts)


def _no_such(path: Path, line: int, found: str, k: int, counts: list[int]) -> InputError:
    """Return the error of a corner's index ``k`` that counts none of its statements."""
    limit, word = counts[k % 3], list(WIDTHS)[k % 3]
    return OBJ.error(path, "index_out_of_range", line=line, found=found, limit=limit, word=word)


def _vertex_colors(
    stated: dict[int, list[float]], count: int, notices: list[str]
) -> FloatArray | None:
    """Return the colours after the positions (``v x y z r g b``), linear RGBA, shape [position, 4].

    Exporters write them in sRGB. Whole numbers up to 255 are codes of 8 bits; positions without a
    colour are white, and where none has one it is None.
    """
    if not stated:
        return None
    notices.append("vertex colours read as sRGB")
    values = np.array(list(stated.values()))
    if 1.0 < values.max() <= 255.0 and (values == np.round(values)).all():
        notices.append("vertex colours up to 255 divided by that")
        values /= 255.0
    elif values.min() < 0.0 or values.max() > 1.0:
        notices.append("vertex colours clamped to 0 ... 1")
    colors = np.ones((count, 4), dtype=np.float32)
    colors[list(stated), :3] = srgb_to_linear(np.clip(values, 0.0, 1.0))
    return colors


def _read_primitive(
    path: Path,
    name: str,
    faces: list[Face],
    vertices: Vertices,
    library: MaterialLibrary,
    notices: list[str],
) -> Primitive | None:
    """Return the triangles of one material, None where none has an area."""
    corners, polygons = _unique_corners(path, faces, vertices)
    position, uv, normal = corners.T
    points = vertices.positions[position]
    indices = triangulate(path, points, polygons, notices)
    indices = drop_without_area(points, indices, notices, f"material {name!r}: ")
    if not len(indices):
        return None
    shading = None
    if (normal >= 0).all():
        shading = unit_normals(vertices.normals[normal], points, indices, notices)
    else:
        notices.append("no normals: shaded flat")
    uv0 = None
    if (uv >= 0).any():
        stated = vertices.uvs[np.maximum(uv, 0)] * (uv >= 0)[:, None]
        uv0 = np.column_stack([stated[:, 0], 1.0 - stated[:, 1]]).astype(np.float32)
    material = library.index(name, white=vertices.colors is not None)
    if uv0 is None and library.materials[material].texture_slots():
        notices.append(f"material {name!r}: no texture coordinates, zero is used")
        uv0 = np.zeros((len(points), 2), dtype=np.float32)
    colors = None if vertices.colors is None else vertices.colors[position]
    return Primitive(points, indices, material, normals=shading, uv0=uv0, colors=colors)


def _unique_corners(
    path: Path, faces: list[Face], vertices: Vertices
) -> tuple[Int64Array, dict[int, IntArray]]:
    """Make one vertex of every different ``v/vt/vn`` corner.

    Returns:
        Zero-based indices of position, texture coordinate and normal, -1 where absent, shape
        [vertex, 3]; and the polygons as vertex indices, by number of corners, shape
        [polygon, corner].

    Raises:
        InputError: With the line at fault.
    """
    counts = [len(vertices.positions), len(vertices.uvs), len(vertices.normals)]
    seen: dict[str, int] = {}
    by_size: dict[int, list[list[int]]] = {}
    for _, corners in faces:
        polygon = [seen.setdefault(corner, len(seen)) for corner in corners]
        by_size.setdefault(len(polygon), []).append(polygon)
    triples = np.full((len(seen), 3), -1, dtype=np.int64)
    for corner, row in seen.items():
        for k, part in enumerate(corner.split("/")):
            if k and not part:
                continue
            is_index = k < 3 and re.fullmatch("[0-9]{1,18}", part)
            value = int(part) if is_index else 0
            if not 1 <= value <= counts[k % 3]:
                line = next(line for line, corners in faces if corner in corners)
                raise _no_such(path, line, repr(corner[:40]), k, counts)
            triples[row, k] = value - 1
    return triples, {size: np.array(p, dtype=np.int32) for size, p in by_size.items()}
