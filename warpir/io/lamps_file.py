"""Lamps near the object, from files: a JSON list, or the point lights of a glTF file.

The list is for --lamps; places and lengths are in the world frame [m], powers as
`warpir.scene.near.lamps` has them:

    {"format": "warpir-lamps", "version": 1,
     "lamps": [{"center": [x, y, z], "radius": r, "power": p, "color": [r, g, b]},
               {"center": [x, y, z], "edge_x": [x, y, z], "edge_y": [x, y, z], "power": p}]}

A rectangle shines toward the cross product of its edges. Of glTF (`KHR_lights_punctual`) point
lights become small spheres; the file's world is ours.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.core.limits import Limits
from warpir.core.strict_json import read_numbers, read_versioned
from warpir.io.gltf.gate import Entry, GltfFile
from warpir.io.gltf.nodes import local_matrix, read_forest, scene_nodes
from warpir.scene.near.lamps import LAMP_COUNT, Lamp, RectangleLamp, SphereLamp, problem_of

LAMPS = "lamps.json"
"""Name of a list that is written."""
VERSION = 1
LIGHTS = "KHR_lights_punctual"
LUMENS_PER_WATT = 683.0
"""By which Blender and others turn watts into the lumens of glTF."""
POINT_RADIUS = 0.05
"""Of the sphere that stands for a point light [m]."""


def given_lamps(
    lamp: tuple[float, ...] | None,
    path: str | None,
    limits: Limits,
    notice: Callable[[str], None],
) -> tuple[Lamp, ...]:
    """Return the lamps of --lamp and --lamps.

    Raises:
        InputError: The file cannot be used.
    """
    lamps: tuple[Lamp, ...] = ()
    if lamp is not None:
        color = np.array(lamp[5:] or (1.0, 1.0, 1.0))
        lamps = (SphereLamp(np.array(lamp[:3]), lamp[3], lamp[4] * color),)
    if path is not None:
        found: list[str] = []
        lamps += read_lamps(path, limits, found)
        for line in found:
            notice(f"{Path(path).name}: {line}")
    return lamps


def read_lamps(path: str | Path, limits: Limits, notices: list[str]) -> tuple[Lamp, ...]:
    """Read the lamps of a ``.json`` list or of a ``.glb`` or ``.gltf`` file.

    ``notices`` receives what was left out or assumed.

    Raises:
        InputError: Missing, of another format, without a lamp, or a lamp is out of range.
    """
    path = Path(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        return _checked(path, _of_gltf(path, limits, notices))
    return lamps_of(path, read_versioned(path, "lamps", VERSION, limits).get("lamps"))


def lamps_of(path: Path, rows: Any) -> tuple[Lamp, ...]:
    """Return the lamps of a list's plain values, the value of ``lamps``.

    Raises:
        InputError: It is no such list, or a lamp is out of range.
    """
    if not isinstance(rows, list) or not 1 <= len(rows) <= LAMP_COUNT:
        raise InputError(path, f"/lamps: a list of 1 to {LAMP_COUNT} lamps expected")
    lamps = [(f"/lamps/{k}", _lamp(path, f"/lamps/{k}", row)) for k, row in enumerate(rows)]
    return _checked(path, lamps)


def lamps_to_json(lamps: tuple[Lamp, ...]) -> dict[str, Any]:
    """Return the content of a list for ``--lamps``."""
    return {"format": "warpir-lamps", "version": VERSION, "lamps": rows_of(lamps)}


def rows_of(lamps: tuple[Lamp, ...]) -> list[dict[str, Any]]:
    """Return the plain values of which `lamps_of` makes the same lamps.

    The largest channel of a colour is 1.
    """
    rows = []
    for lamp in lamps:
        row = {name: np.asarray(value).tolist() for name, value in vars(lamp).items()}
        power = float(lamp.power.max())
        color = lamp.power / power if power > 0.0 else np.ones(3)
        rows.append({**row, "power": power, "color": color.tolist()})
    return rows


def _checked(path: Path, lamps: list[tuple[str, Lamp]]) -> tuple[Lamp, ...]:
    for pointer, lamp in lamps:
        problem = problem_of(lamp)
        if problem:
            raise InputError(path, f"{pointer}: {problem}")
    return tuple(lamp for _, lamp in lamps)


def _lamp(path: Path, pointer: str, row: Any) -> Lamp:
    if not isinstance(row, dict):
        raise InputError(path, f"{pointer}: an object expected")
    is_flat = "edge_x" in row
    shape = {"edge_x", "edge_y"} if is_flat else {"radius"}
    unknown = sorted(set(row) - {"center", "power", "color"} - shape)
    if unknown:
        expected = "center, power, color, and either radius or edge_x and edge_y"
        raise InputError(path, f"{pointer}: expected {expected} (found {unknown[0]!a:.60})")

    def vector(name: str) -> Float64Array:
        return np.array(read_numbers(path, f"{pointer}/{name}", row.get(name), 3))

    def number(name: str) -> float:
        return read_numbers(path, f"{pointer}/{name}", [row.get(name)], 1)[0]

    color = vector("color") if "color" in row else np.ones(3)
    with np.errstate(over="ignore"):  # found by `problem_of`
        power = number("power") * color
    if is_flat:
        return RectangleLamp(vector("center"), vector("edge_x"), vector("edge_y"), power)
    return SphereLamp(vector("center"), number("radius"), power)


def _of_gltf(path: Path, limits: Limits, notices: list[str]) -> list[tuple[str, Lamp]]:
    """Return the point lights of a glTF file's scene; others are counted in the notices."""
    root = GltfFile(path, limits).root
    nodes, parents = read_forest(root, limits)
    lights = root.extension(LIGHTS)
    found: list[tuple[str, Lamp]] = []
    left_out: dict[str, int] = {}
    stack = [(k, np.eye(4)) for k in sorted(scene_nodes(root, nodes, parents, notices))]
    while stack:
        index, above = stack.pop()
        node = nodes[index]
        with np.errstate(over="ignore", invalid="ignore"):  # found by `problem_of`
            world = above @ local_matrix(node)
        stack += [(child, world) for child in node.integers("children")]
        use = node.extension(LIGHTS)
        if use is None:
            continue
        if lights is None:
            raise use.error("missing", what=f"/extensions/{LIGHTS}")
        light = lights.item("lights", use.integer("light"), use, "light")
        kind = light.text("type")
        if kind == "point":
            found.append((light.pointer, _point(light, world)))
        else:
            left_out[kind] = left_out.get(kind, 0) + 1
    if len(found) > LAMP_COUNT:
        raise InputError(path, f"too many lamps (found {len(found)}; limit {LAMP_COUNT})")
    for kind, count in left_out.items():
        notices.append(f"{count} light{'s' * (count > 1)} of type {kind!a:.20} left out")
    if not found:
        raise InputError(path, f"no point light in its scene ({LIGHTS})")
    notices.append(f"its point lights have a radius of {POINT_RADIUS:g} m")
    return found


def _point(light: Entry, world: Float64Array) -> SphereLamp:
    """Return a point light: candela over all directions, as watts."""
    watts = 4.0 * np.pi * light.number("intensity", 1.0) / LUMENS_PER_WATT
    color = np.array(light.numbers("color", (1.0, 1.0, 1.0)))
    return SphereLamp(world[:3, 3], POINT_RADIUS, watts * color)
