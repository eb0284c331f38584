"""Reads OBJ, PLY and STL into an `Asset`.

OBJ is parsed here: every number has to be checked before a library sees it, and then the arrays are
already there. Materials of OBJ come from `warpir.io.meshes.mtl`, the numbers of PLY and STL from
`warpir.io.meshes.ply` and `warpir.io.meshes.stl`. The texture coordinate v is turned from up to
down.
"""

import contextlib
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, Int64Array, IntArray
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.meshes.asset_files import (
    check_drawable,
    check_triangle_count,
    concise,
    keep_area,
    plain_material,
    read_regular,
    repair_normals,
)
from warpir.io.meshes.mtl import MaterialLibrary
from warpir.io.meshes.ply import Element, read_ply
from warpir.io.meshes.stl import read_stl
from warpir.scene.asset import Asset, Primitive

GREY = (0.8, 0.8, 0.8)
LARGEST = 3e38
"""Largest number of a mesh: what a float32 holds; of positions `EXTENT` is the limit."""
"""Base colour of what has no material."""
CROSSINGS = 100
"""After as many cuts that were no ears a polygon is taken for a tangle and cut into a fan."""
CONCAVE_COST = 100_000_000
"""Largest sum of the squared numbers of corners of all concave polygons of a material."""
NAMED = ("usemtl", "mtllib")
"""Statements that end in a name, which may hold ``#`` (3ds Max: ``Material #1``)."""
IGNORED = {"o", "g", "s", "vp", "shadow_obj", "trace_obj", "lod", "bevel", "c_interp", "d_interp"}
NO_TRIANGLES: IntArray = np.zeros((0, 3), dtype=np.int32)


def read_mesh(path: str | Path, missing_textures: str = "error", limits: Limits = LIMITS) -> Asset:
    """Read an ``.obj``, ``.ply`` or ``.stl`` file.

    Args:
        path: The file; material files and textures must lie in its folder.
        missing_textures: ``error``, or ``grey``: a missing material file or base colour texture
            becomes grey, other textures are left out, with a notice.
        limits: How large it may be.

    Returns:
        Double-sided materials; grey, rough and dielectric where the file states none.

    Raises:
        InputError: The file is damaged or holds no triangles.
    """
    path = Path(path)
    hashes: dict[str, str] = {}
    content = read_regular(path, path, limits=limits, hashes=hashes)
    if path.suffix.lower() == ".obj":
        asset = read_obj(path, content, missing_textures, limits)
    elif path.suffix.lower() == ".ply":
        asset = read_ply_mesh(path, content, limits)
    else:
        asset = read_stl_mesh(path, content, limits)
    return replace(asset, hashes={**hashes, **asset.hashes})


@dataclass
class ObjText:
    """The statements of an OBJ file, sorted by kind; line numbers start at 1."""

    positions: list[tuple[int, list[str]]] = field(default_factory=list)
    uvs: list[tuple[int, list[str]]] = field(default_factory=list)
    normals: list[tuple[int, list[str]]] = field(default_factory=list)
    faces: dict[str, list[tuple[int, list[str]]]] = field(default_factory=dict)
    """Corners as written, made absolute, per material name."""
    libraries: list[str] = field(default_factory=list)


def read_obj(path: Path, content: bytes, missing_textures: str, limits: Limits) -> Asset:
    """Read an OBJ file; one primitive per material.

    Raises:
        InputError: With the line at fault.
    """
    notices: list[str] = []
    text = split_statements(path, content, notices)
    positions = float_rows(path, "v", text.positions, 3)
    colors = vertex_colors(path, text.positions, notices)
    # v is optional; the format says 0.
    uvs = float_rows(path, "vt", [(n, v + ["0"] * (len(v) == 1)) for n, v in text.uvs], 2)
    normals = float_rows(path, "vn", text.normals, 3)
    library = MaterialLibrary(path, missing_textures, notices, limits)
    for name in text.libraries:
        library.add(name)
    triangle_count = sum(len(c) - 2 for faces in text.faces.values() for _, c in faces)
    check_triangle_count(path, triangle_count, limits)

    primitives: list[Primitive] = []
    for name, faces in text.faces.items():
        corners, polygons = unique_corners(path, faces, (len(positions), len(uvs), len(normals)))
        points = positions[corners[:, 0]]
        indices = triangulate(path, points, polygons, notices)
        indices, flat, repeated = keep_area(points, indices)
        if flat or repeated:
            notices.append(
                f"material {name!r}: dropped {flat} triangles of zero area and {repeated} "
                "repeated ones"
            )
        if not len(indices):
            continue
        shading: FloatArray | None = None
        if (corners[:, 2] >= 0).all():
            shading, lost = repair_normals(normals[corners[:, 2]], points, indices)
            if lost:
                notices.append(f"{lost} normals of length zero taken from the faces")
        else:
            notices.append("no normals: shaded flat")
        uv0: FloatArray | None = None
        if (corners[:, 1] >= 0).any():
            stated = uvs[np.maximum(corners[:, 1], 0)] * (corners[:, 1:2] >= 0)
            uv0 = np.column_stack([stated[:, 0], 1.0 - stated[:, 1]]).astype(np.float32)
        material = library.index(name, white=colors is not None)
        if uv0 is None and library.is_textured(material):
            notices.append(f"material {name!r}: no texture coordinates, zero is used")
            uv0 = np.zeros((len(points), 2), dtype=np.float32)
        primitives.append(
            Primitive(
                positions=points,
                indices=indices,
                material=material,
                normals=shading,
                uv0=uv0,
                colors=None if colors is None else colors[corners[:, 0]],
            )
        )
    check_drawable(path, primitives, f"{len(positions)} vertices")
    return Asset(
        name=path.stem,
        primitives=tuple(primitives),
        materials=tuple(library.materials),
        textures=tuple(library.textures),
        notices=concise(notices),
        hashes=library.hashes,
    )


def split_statements(path: Path, content: bytes, notices: list[str]) -> ObjText:
    """Sort the lines of an OBJ file by statement; corners become absolute indices from 1."""
    if b"\0" in content[:4096]:
        raise InputError(path, "not an OBJ text file", "convert it to GLB")
    try:
        whole = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        whole = content.decode("latin-1")
    text = ObjText()
    material = ""
    left_out: dict[str, int] = {}
    for line, statement in logical_lines(whole):
        word, *values = statement.split()
        match word:
            case "v":
                text.positions.append((line, values))
            case "vt":
                text.uvs.append((line, values))
            case "vn":
                text.normals.append((line, values))
            case "f":
                if len(values) < 3:
                    raise InputError(path, f"line {line}: face with {len(values)} corners")
                if "-" in statement:
                    counts = len(text.positions), len(text.uvs), len(text.normals)
                    values = [absolute_corner(path, line, v, counts) for v in values]
                text.faces.setdefault(material, []).append((line, values))
            case "usemtl":
                material = statement[len(word) :].strip()
            case "mtllib":
                text.libraries.append(statement[len(word) :].strip())
            case _ if word not in IGNORED:
                left_out[word] = left_out.get(word, 0) + 1
    if not (text.positions or text.faces):
        raise InputError(path, "not an OBJ file (no v and no f statements)", "convert it to GLB")
    for word, count in left_out.items():
        notices.append(f"{count} {word[:20]!r} statements ignored")
    return text


def logical_lines(text: str) -> Iterator[tuple[int, str]]:
    """Yield line numbers and statements, continued lines joined and comments removed.

    Names are kept whole; of the other statements all from ``#`` on is a comment.
    """
    pending, start = "", 0
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        start = start if pending else number
        line = pending + line.strip()
        if "#" in line and line.split()[0] not in NAMED:
            line = line.partition("#")[0].rstrip()
        if line.endswith("\\"):
            pending = line[:-1] + " "
            continue
        pending = ""
        if line:
            yield start, line
    if pending.strip():
        yield start, pending


def absolute_corner(path: Path, line: int, corner: str, counts: tuple[int, int, int]) -> str:
    """Rewrite ``-1/-2/-3`` as indices from 1, counted from the statements read so far."""
    parts = corner.split("/")
    for k, part in enumerate(parts[:3]):
        if part.startswith("-"):
            with contextlib.suppress(ValueError):  # reported with all other corners
                value = counts[k] + 1 + int(part)
                if not 1 <= value <= counts[k]:
                    word = ("v", "vt", "vn")[k]
                    what = f"line {line}: index {part[:20]}, but {counts[k]} {word}"
                    raise InputError(path, what)
                parts[k] = str(value)
    return "/".join(parts)


def float_rows(
    path: Path, word: str, rows: list[tuple[int, list[str]]], width: int
) -> Float64Array:
    """Return the first numbers of ``v``, ``vt`` or ``vn`` statements.

    Args:
        path: The file.
        word: The statement.
        rows: Line number and words of each.
        width: How many numbers it needs.

    Returns:
        Shape [statement, width].

    Raises:
        InputError: With the line at fault.
    """
    try:
        numbers = np.array([v[:width] for _, v in rows], dtype=np.float64).reshape(-1, width)
        if (
            not any(map(separated, (v[:width] for _, v in rows)))
            and (np.abs(numbers) < LARGEST).all()
        ):
            return numbers
    except (ValueError, OverflowError):
        pass
    for line, values in rows:
        try:
            sound = len(values) >= width and not separated(values[:width])
            if sound and all(abs(float(v)) < LARGEST for v in values[:width]):
                continue
        except ValueError:
            pass
        found = " ".join([word, *values])[:60]
        advice = "write numbers with decimal points" if "," in found else ""
        raise InputError(
            path,
            f"line {line}: {found!r}, expected {width} numbers up to {LARGEST:g}",
            advice,
        )
    raise InputError(path, f"{word} statements cannot be read")


def separated(words: list[str]) -> bool:
    """Return whether there is a ``_`` in numbers, which Python would pass over."""
    return any("_" in word for word in words)


def vertex_colors(
    path: Path, rows: list[tuple[int, list[str]]], notices: list[str]
) -> FloatArray | None:
    """Return the colours after the positions (``v x y z r g b``), shape [vertex, 4].

    Whole numbers above 1 are codes of 8 bits.
    """
    colored = [len(values) >= 6 for _, values in rows]
    if not any(colored):
        return None
    notices.append("vertex colours read as linear Rec.709")
    for line, values in rows:
        if len(values) > 6:  # a weight before the colour, or an opacity behind it
            what = f"line {line}: v with {len(values)} numbers (expected x y z r g b)"
            raise InputError(path, what, "export colours of three numbers, or as GLB")
    tails = [
        (line, values[3:6] if has else ["1"] * 3)
        for (line, values), has in zip(rows, colored, strict=True)
    ]
    stated = float_rows(path, "v ... r g b", tails, 3)
    has = np.array(colored)
    if stated.max() > 1.0 and stated.max() <= 255.0 and (stated == np.round(stated)).all():
        notices.append("vertex colours up to 255 divided by that")
        stated[has] /= 255.0
    elif stated.min() < 0.0 or stated.max() > 1.0:
        notices.append("vertex colours clamped to 0 ... 1")
    colors = np.ones((len(rows), 4), dtype=np.float32)
    colors[:, :3] = np.clip(stated, 0.0, 1.0)
    return colors


def unique_corners(
    path: Path, faces: list[tuple[int, list[str]]], counts: tuple[int, int, int]
) -> tuple[Int64Array, dict[int, IntArray]]:
    """Make one vertex of every different ``v/vt/vn`` corner.

    Args:
        path: The file.
        faces: Line number and corners of each face.
        counts: How many positions, texture coordinates and normals there are.

    Returns:
        Zero-based indices of position, texture coordinate and normal, -1 where absent, shape
        [vertex, 3]; and the polygons as vertex indices, by number of corners, shape
        [polygon, corner].

    Raises:
        InputError: With the line at fault.
    """
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
            try:
                value = int(part) if k < 3 and "_" not in part else 0
            except ValueError:
                value = 0
            if not 1 <= value <= counts[k % 3]:
                line = next(line for line, corners in faces if corner in corners)
                word = ("v", "vt", "vn")[k % 3]
                raise InputError(
                    path, f"line {line}: corner {corner[:40]!r}, but {counts[k % 3]} {word} "
                    "(indices start at 1)"
                )  # fmt: skip
            triples[row, k] = value - 1
    return triples, {size: np.array(p, dtype=np.int32) for size, p in by_size.items()}


def triangulate(
    path: Path, points: Float64Array, polygons: dict[int, IntArray], notices: list[str]
) -> IntArray:
    """Cut polygons into triangles: fans where convex, ears where not.

    Args:
        path: The file.
        points: Shape [vertex, 3].
        polygons: Vertex indices by number of corners, shape [polygon, corner].
        notices: Receives the number of concave polygons.

    Returns:
        Shape [triangle, 3], the winding kept.

    Raises:
        InputError: Concave polygons of so many corners that cutting them would take minutes.
    """
    triangles = []
    concave_count = cost = 0
    for size, polygon in polygons.items():
        concave = np.zeros(len(polygon), dtype=bool)
        if size > 3:
            corner = points[polygon]
            edge = np.roll(corner, -1, axis=1) - corner
            turn = np.cross(np.roll(edge, 1, axis=1), edge)
            normal = np.cross(corner, np.roll(corner, -1, axis=1)).sum(axis=1, keepdims=True)
            along = (turn * normal).sum(axis=2)
            concave = (along < -1e-9 * np.abs(along).max(axis=1, keepdims=True)).any(axis=1)
        cost += int(concave.sum()) * size**2
        if cost > CONCAVE_COST:
            raise InputError(
                path,
                f"concave polygons of too many corners (found {concave.sum()} of {size}; the limit "
                f"for one is {math.isqrt(CONCAVE_COST)})",
                "triangulate the faces on export",
            )
        fan = np.stack([np.array([0, k, k + 1]) for k in range(1, size - 1)])
        triangles.append(polygon[~concave][:, fan].reshape(-1, 3))
        for row in polygon[concave]:
            triangles.append(row[clip_ears(points[row])])
        concave_count += int(concave.sum())
    if concave_count:
        notices.append(f"{concave_count} concave polygons triangulated by ear clipping")
    return np.concatenate(triangles).astype(np.int32)


def clip_ears(points: Float64Array) -> IntArray:
    """Triangulate one simple polygon (Meisters 1975), seen along its mean normal.

    A corner that was no ear is looked at again only when a neighbour of it, or the corner that was
    found within it, is gone: for most polygons the time grows as the square of the corners.

    Args:
        points: Corners in order, shape [corner, 3].

    Returns:
        Indices of the corners, shape [corner - 2, 3].
    """
    normal = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    flat = np.delete(points, axis, axis=1)
    if (normal[axis] < 0) != (axis == 1):  # dropping y mirrors the plane
        flat = flat * [1.0, -1.0]

    x, y = flat.T
    rest = list(range(len(points)))
    left = np.ones(len(points), dtype=bool)
    within: dict[int, int] = {}
    triangles = []
    start = stuck = 0
    while len(rest) > 3 and stuck < CROSSINGS:
        for step in range(len(rest)):
            k = (start + step) % len(rest)
            a, b, c = rest[k - 1], rest[k], rest[(k + 1) % len(rest)]
            if b not in within or not left[within[b]]:
                within[b] = corner_within(x, y, left, (a, b, c))
            if within[b] < 0:
                break
        else:
            k = 1  # self-intersecting: any cut is as good as another
            a, b, c = rest[0], rest[1], rest[2]
            stuck += 1
        triangles.append((a, b, c))
        del rest[k]
        left[b] = False
        within.pop(a, None)
        within.pop(c, None)
        start = max(k - 1, 0)
    triangles += [(rest[0], b, c) for b, c in pairwise(rest[1:])]
    return np.array(triangles, dtype=np.int32)


def corner_within(
    x: Float64Array,
    y: Float64Array,
    left: BoolArray,
    triangle: tuple[int, int, int],
) -> int:
    """Return what keeps a corner of a polygon from being an ear.

    Args:
        x: Of all corners, shape [corner].
        y: Likewise.
        left: Which of them were not cut off.
        triangle: The corner in the middle, its neighbours around it.

    Returns:
        Another corner in the triangle, its own where it is concave, -1 where it is an ear.
    """

    def left_of(p: int, q: int) -> BoolArray:
        side: BoolArray = (x[q] - x[p]) * (y - y[p]) >= (y[q] - y[p]) * (x - x[p])
        return side

    a, b, c = triangle
    if (x[b] - x[a]) * (y[c] - y[a]) <= (y[b] - y[a]) * (x[c] - x[a]):
        return b
    inside = left & left_of(a, b) & left_of(b, c) & left_of(c, a)
    inside[list(triangle)] = False
    found = int(inside.argmax())
    return found if inside[found] else -1


def read_ply_mesh(path: Path, content: bytes, limits: Limits) -> Asset:
    """Read the faces of a PLY file with the normals and colours of its vertices.

    Raises:
        InputError: The file is damaged or holds no faces.
    """
    notices: list[str] = []
    ply = read_ply(path, content)
    vertex, face = ply.element("vertex"), ply.element("face")
    positions = finite_columns(path, vertex, ("x", "y", "z"))
    if positions is None:
        raise InputError(path, "no x, y and z of vertices", "convert it to GLB")
    corners = face.lists.get("vertex_indices", face.lists.get("vertex_index"))
    if corners is None or not len(corners.lengths):
        others = ", ".join(f"{e.count} {e.name}" for e in ply.elements.values())
        raise InputError(
            path,
            f"nothing to render (found {others[:80]}; expected faces)",
            "a point cloud of the place belongs to --ground-points",
        )
    check_triangle_count(path, int(np.maximum(corners.lengths - 2, 0).sum()), limits)
    used = corners.values
    if (used != np.round(used)).any():
        raise InputError(path, f"index {used[used != np.round(used)][0]:g} is no whole number")
    if len(used) and not 0 <= used.min() <= used.max() < len(positions):
        worst = used.min() if used.min() < 0 else used.max()
        raise InputError(path, f"index {worst:g}, but {len(positions)} vertices")
    polygons = {n: rows.astype(np.int32) for n, rows in corners.by_length().items() if n >= 3}
    lines = int((corners.lengths < 3).sum())
    if lines:
        notices.append(f"{lines} faces of fewer than 3 corners ignored")
    stored = finite_columns(path, vertex, ("nx", "ny", "nz"))
    colors = ply_colors(path, vertex, notices)
    if finite_columns(path, face, ("red", "green", "blue")) is not None:
        notices.append("colours of faces are not read; those of vertices would be")
    if any(line.startswith("TextureFile") for line in ply.comments):
        notices.append("the texture is not read: export as GLB or OBJ")
    indices = triangulate(path, positions, polygons, notices) if polygons else NO_TRIANGLES
    return plain_asset(path, positions, indices, stored, colors, notices)


def read_stl_mesh(path: Path, content: bytes, limits: Limits) -> Asset:
    """Read an STL file; flat shading, since its normals are those of the faces.

    Raises:
        InputError: The file is damaged or holds no triangles.
    """
    notices: list[str] = []
    corners = read_stl(path, content, notices)
    check_triangle_count(path, len(corners), limits)
    if not np.isfinite(corners).all():
        raise InputError(path, "vertices are NaN or infinite")
    indices = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return plain_asset(path, corners.reshape(-1, 3), indices, None, None, notices)


def plain_asset(
    path: Path,
    positions: Float64Array,
    indices: IntArray,
    normals: Float64Array | None,
    colors: FloatArray | None,
    notices: list[str],
) -> Asset:
    """Return an asset of one material that the file does not state.

    Args:
        path: The file.
        positions: Shape [vertex, 3].
        indices: Shape [triangle, 3].
        normals: Of any length, shape [vertex, 3].
        colors: Linear RGBA, shape [vertex, 4].
        notices: What was found on reading.

    Raises:
        InputError: No triangle has an area.
    """
    indices, flat, repeated = keep_area(positions, indices)
    if flat or repeated:
        notices.append(f"dropped {flat} triangles of zero area and {repeated} repeated ones")
    shading: FloatArray | None = None
    if normals is None:
        notices.append("no normals: shaded flat")
    else:
        shading, lost = repair_normals(normals, positions, indices)
        if lost:
            notices.append(f"{lost} normals of length zero taken from the faces")
    if colors is None:
        material = plain_material("grey", GREY)
        notices.append("no material: grey 0.8, roughness 0.5")
    else:
        material = plain_material("vertex colours", (1.0, 1.0, 1.0))
        notices.append("vertex colours read as linear Rec.709")
        notices.append("no material: roughness 0.5")
    primitives = []
    if len(indices):
        primitives.append(Primitive(positions, indices, 0, normals=shading, colors=colors))
        size = np.ptp(positions, axis=0)
        notices.append(
            f"no unit in the file: read as metres, size {size[0]:g} x {size[1]:g} x {size[2]:g}"
        )
    check_drawable(path, primitives, f"{len(positions)} vertices")
    return Asset(path.stem, tuple(primitives), (material,), notices=concise(notices))


def finite_columns(path: Path, element: Element, names: tuple[str, ...]) -> Float64Array | None:
    """Return columns of a PLY element, shape [row, column]; None when one is absent.

    Raises:
        InputError: One of the numbers is not finite.
    """
    table = element.table(*names)
    if table is not None and not (usable := np.abs(table) < LARGEST).all():
        row = int(np.flatnonzero(~usable.all(axis=1))[0])
        raise InputError(path, f"{' '.join(names)} of {element.name} {row} are NaN or infinite")
    return table


def ply_colors(path: Path, vertex: Element, notices: list[str]) -> FloatArray | None:
    """Return the vertex colours of a PLY file, linear RGBA, shape [vertex, 4].

    Integers count up to their largest value, floats to 1.
    """
    for prefix in ("", "diffuse_"):
        names = (f"{prefix}red", f"{prefix}green", f"{prefix}blue")
        stored = finite_columns(path, vertex, names)
        if stored is None:
            continue
        stated = [*names, *(key for key in ("alpha",) if key in vertex.columns)]
        colors = np.ones((len(stored), 4))
        for k, name in enumerate(stated):
            kind = np.dtype(vertex.types[name][0])
            scale = 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)
            colors[:, k] = vertex.columns[name] / scale
        if not ((colors >= 0.0) & (colors <= 1.0)).all():
            raise InputError(
                path,
                f"vertex colours from {colors.min():g} to {colors.max():g} (expected 0 to 1, or "
                "integers)",
            )
        return colors.astype(np.float32)
    return None
