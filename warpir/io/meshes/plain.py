"""Reads PLY and STL, which state no material, into an `Asset` of one grey primitive.

Parsed here and not by trimesh 5.2, with which 40 of 100 tests of these two formats failed: it cuts
concave polygons into fans, refuses binary files that mix triangles and quads, drops colours that
are not 8-bit, stops at the first bad number of a text without a word, and accepts a cut STL.
"""

from pathlib import Path

import numpy as np

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.color import srgb_to_linear
from warpir.core.limits import Limits
from warpir.io.meshes.asset_files import GREY, concise, plain_material, read_regular
from warpir.io.meshes.ply import PLY, Element, Lists, read_ply
from warpir.io.meshes.stl import read_stl
from warpir.io.meshes.triangles import (
    LARGEST,
    MESH,
    check_drawable,
    check_triangle_count,
    drop_without_area,
    triangulate,
    unit_normals,
)
from warpir.scene.asset import Asset, Primitive


def read_ply_mesh(path: Path, limits: Limits) -> Asset:
    """Read the faces of a PLY file with the normals and colours of its vertices.

    Raises:
        InputError: The file is damaged or holds no faces.
    """
    notices: list[str] = []
    hashes: dict[str, str] = {}
    ply = read_ply(path, read_regular(path, path, limits, hashes=hashes))
    vertex, face = ply.element("vertex"), ply.element("face")
    positions = _finite(path, vertex, ("x", "y", "z"))
    if positions is None:
        raise PLY.error(path, "no_positions")
    corners = face.lists.get("vertex_indices", face.lists.get("vertex_index"))
    if corners is None or not len(corners.lengths):
        found = ", ".join(f"{e.count} {e.name}" for e in ply.elements.values())[:80]
        advice = "a point cloud of the place belongs to --ground-points"
        raise MESH.error(path, "nothing_to_render", found=found, expected="faces", advice=advice)
    check_triangle_count(path, int(np.maximum(corners.lengths - 2, 0).sum()), limits)
    polygons = _polygons(path, corners, len(positions), notices)
    normals = _finite(path, vertex, ("nx", "ny", "nz"))
    colors = _colors(path, vertex)
    if _finite(path, face, ("red", "green", "blue")) is not None:
        notices.append("colours of faces are not read; those of vertices would be")
    if any(line.startswith("TextureFile") for line in ply.comments):
        notices.append("the texture is not read: export as GLB or OBJ")
    indices = triangulate(path, positions, polygons, notices)
    return _asset(path, positions, indices, normals, colors, notices, hashes)


def read_stl_mesh(path: Path, limits: Limits) -> Asset:
    """Read an STL file; flat shading, since its normals are those of the faces.

    Raises:
        InputError: The file is damaged or holds no triangles.
    """
    notices: list[str] = []
    hashes: dict[str, str] = {}
    corners = read_stl(path, read_regular(path, path, limits, hashes=hashes), notices)
    check_triangle_count(path, len(corners), limits)
    if not np.isfinite(corners).all():
        raise MESH.error(path, "not_finite", what="vertices")
    indices = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return _asset(path, corners.reshape(-1, 3), indices, None, None, notices, hashes)


def _asset(
    path: Path,
    positions: Float64Array,
    indices: IntArray,
    normals: Float64Array | None,
    colors: FloatArray | None,
    notices: list[str],
    hashes: dict[str, str],
) -> Asset:
    """Return an asset of one material, which the file does not state."""
    indices = drop_without_area(positions, indices, notices)
    shading = None
    if normals is None:
        notices.append("no normals: shaded flat")
    else:
        shading = unit_normals(normals, positions, indices, notices)
    if colors is None:
        material = plain_material("grey", GREY)
        notices.append("no material: grey 0.8, roughness 0.5")
    else:
        material = plain_material("vertex colours", (1.0, 1.0, 1.0))
        notices.append("vertex colours read as sRGB")
        notices.append("no material: roughness 0.5")
    primitives = []
    if len(indices):
        primitives.append(Primitive(positions, indices, 0, normals=shading, colors=colors))
        size = np.ptp(positions, axis=0)
        notices.append(
            f"no unit in the file: read as metres, size {size[0]:g} x {size[1]:g} x {size[2]:g}"
        )
    check_drawable(path, primitives, f"{len(positions)} vertices")
    return Asset(path.stem, tuple(primitives), (material,), notices=concise(notices), hashes=hashes)


def _polygons(
    path: Path, corners: Lists, vertex_count: int, notices: list[str]
) -> dict[int, IntArray]:
    """Return the faces as vertex indices, by number of corners, shape [polygon, corner]."""
    used = corners.values
    if (used != np.round(used)).any():
        raise PLY.error(path, "index", found=float(used[used != np.round(used)][0]))
    if len(used) and not 0 <= used.min() <= used.max() < vertex_count:
        worst = int(used.min() if used.min() < 0 else used.max())
        raise PLY.error(path, "index_out_of_range", found=worst, limit=vertex_count)
    if lines := int((corners.lengths < 3).sum()):
        notices.append(f"{lines} faces of fewer than 3 corners ignored")
    return {n: rows.astype(np.int32) for n, rows in corners.by_length().items() if n >= 3}


def _finite(path: Path, element: Element, names: tuple[str, ...]) -> Float64Array | None:
    """Return finite columns of a PLY element, shape [row, column]; None when one is absent."""
    table = element.table(*names)
    if table is not None and not (usable := np.abs(table) < LARGEST).all():
        row = int(np.flatnonzero(~usable.all(axis=1))[0])
        raise MESH.error(path, "not_finite", what=f"{' '.join(names)} of {element.name} {row}")
    return table


def _colors(path: Path, vertex: Element) -> FloatArray | None:
    """Return the vertex colours of a PLY file, linear RGBA, shape [vertex, 4].

    Exporters write them in sRGB; integers count up to their largest value, floats to 1.
    """
    for prefix in ("", "diffuse_"):
        names = (f"{prefix}red", f"{prefix}green", f"{prefix}blue")
        if _finite(path, vertex, names) is None:
            continue
        colors = np.ones((vertex.count, 4))
        for k, name in enumerate([*names, "alpha"] if "alpha" in vertex.columns else names):
            kind = np.dtype(vertex.types[name][0])
            scale = 1.0 if kind.kind == "f" else float(np.iinfo(kind).max)
            colors[:, k] = vertex.columns[name] / scale
        if not ((colors >= 0.0) & (colors <= 1.0)).all():
            found = f"{colors.min():g} to {colors.max():g}"
            raise PLY.error(path, "color", found=found)
        colors[:, :3] = srgb_to_linear(colors[:, :3])
        return colors.astype(np.float32)
    return None
