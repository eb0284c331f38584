"""The inside of the demo's car, which its windows show: lining, seats, dashboard and wheel."""

import numpy as np

from tools.demo.body import (
    BACKLIGHT,
    DOOR_WINDOW,
    REAR_WINDOW,
    WINDSHIELD,
    Part,
    body_distance,
)
from tools.demo.distance import mesh_distance, polygon_distance
from tools.demo.mesh import Surface, merge, rotation, rounded_box, split, tube
from warpir.core.arrays import Float64Array

LINING = 0.014
"""Distance of the lining from the body's outside [m]."""
CELL = 0.06
"""Side of the lining's triangles [m]."""
FRONT, REAR, SILL = 1.02, -1.52, 0.36
"""Where the cabin ends, along z, and its floor [m]."""


def _lining() -> Surface:
    """Return the body's inside around the cabin, its windows open a little wider than the glass."""

    def inside(x: Float64Array, y: Float64Array, z: Float64Array) -> Float64Array:
        return body_distance(x, y, z) + LINING

    shell = mesh_distance(inside, (-0.94, 0.10, -1.90), (0.94, 1.60, 1.90), CELL)
    x, y, z = shell.positions.T
    shell = split(shell, np.maximum(np.maximum(z - FRONT, REAR - z), SILL - y))[0]
    for polygon in (DOOR_WINDOW, REAR_WINDOW):
        x, y, z = shell.positions.T
        window = polygon_distance(polygon, z, y) - 0.03
        shell = split(shell, np.maximum(window, 0.4 - np.abs(x)))[1]
    for polygon, end in ((WINDSHIELD, 1.0), (BACKLIGHT, -1.0)):
        x, y, z = shell.positions.T
        window = polygon_distance(polygon, x, y) - 0.04
        shell = split(shell, np.maximum(window, 0.1 - end * z))[1]
    return Surface(shell.positions, -shell.normals, shell.triangles[:, ::-1])


def _seat(x: float) -> list[Part]:
    """Return a front seat: cushion, back and head rest."""
    lean = rotation("x", -16.0)
    back = rounded_box((0.0, 0.30, 0.0), (0.225, 0.31, 0.055), 0.05, 3)
    rest = rounded_box((0.0, 0.70, 0.0), (0.125, 0.075, 0.045), 0.04, 2)
    posts = [tube([(side, 0.55, 0.0), (side, 0.70, 0.0)], 0.008, 6) for side in (-0.055, 0.055)]
    cushion = rounded_box((x, 0.50, 0.06), (0.23, 0.075, 0.25), 0.06, 3)
    place = np.array([x, 0.52, -0.20])
    return [
        ("seat", cushion),
        *(("seat", part.turned(lean).moved(place)) for part in (back, rest)),
        *(("alloy", post.turned(lean).moved(place)) for post in posts),
    ]


def cabin() -> list[Part]:
    """Furnish the cabin."""
    floor = rounded_box((0.0, SILL - 0.01, -0.25), (0.66, 0.02, 1.25), 0.01, 1)
    dashboard = rounded_box((0.0, 0.80, 0.72), (0.60, 0.12, 0.15), 0.07, 3)
    bench = rounded_box((0.0, 0.52, -0.82), (0.56, 0.08, 0.24), 0.06, 3)
    lean = rotation("x", -14.0)
    bench_back = rounded_box((0.0, 0.28, 0.0), (0.54, 0.30, 0.06), 0.05, 3)
    shelf = rounded_box((0.0, 0.98, -1.33), (0.54, 0.012, 0.16), 0.01, 1)
    angle = 2.0 * np.pi * np.arange(32) / 32
    rim = np.stack([0.175 * np.cos(angle), 0.175 * np.sin(angle), np.zeros(32)], axis=1)
    spokes = [
        tube([(r * np.cos(a), r * np.sin(a), 0.0) for r in (0.02, 0.17)], 0.010, 6)
        for a in np.radians([-90.0, 30.0, 150.0])
    ]
    wheel = merge([tube(rim, 0.014, 8, up=(0.0, 0.0, 1.0), closed=True), *spokes])
    wheel = wheel.turned(rotation("x", 24.0))
    column = tube([(0.33, 0.92, 0.45), (0.33, 0.86, 0.66)], 0.022, 8)
    parts: list[Part] = [
        ("lining", _lining()),
        ("black", floor),
        ("black", dashboard),
        ("seat", bench),
        ("seat", bench_back.turned(lean).moved((0.0, 0.55, -1.06))),
        ("black", shelf),
        ("black", wheel.moved((0.33, 0.93, 0.43))),
        ("black", column),
    ]
    for x in (-0.33, 0.33):
        parts += _seat(x)
    return parts
