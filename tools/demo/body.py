"""The body of the demo's car: one smooth solid, meshed and cut along curves into its panels."""

import numpy as np

from tools.demo.distance import mesh_distance, polygon_distance, round_intersection, round_union
from tools.demo.mesh import Surface, merge, spline, split
from warpir.core.arrays import Float64Array

CELL = 0.040
"""Edge of the body's meshing cells [m]."""
WHEEL_Y, FRONT_AXLE, REAR_AXLE = 0.305, 1.13, -1.17
"""Height and places along z of the axles [m]."""
TRACK = 0.70
"""Distance of a wheel's middle from the car's middle [m]."""
ARCH_RADIUS = 0.365
"""Radius of the wheel arches [m]."""
ARCH_DEPTH = 0.42
"""The wheel wells reach in to this distance from the middle [m]."""
LAMP = np.array([0.575, 0.690, 1.668])
"""Centre of the left head lamp's rim [m]."""
LAMP_RADIUS = 0.112
"""Inner radius of the head lamp's rim [m]."""

Part = tuple[str, Surface]
"""A surface with the name of its material."""

# fmt: off
# Side views, (z, y) [m].
LOWER_SIDE = spline(
    [
        (-1.60, 0.19), (-1.755, 0.30), (-1.785, 0.48), (-1.745, 0.72), (-1.655, 0.905),
        (-1.46, 0.978),
        (-0.4, 0.972), (0.80, 0.935), (1.30, 0.872), (1.60, 0.775), (1.735, 0.62), (1.775, 0.45),
        (1.74, 0.29), (1.58, 0.19), (0.6, 0.185), (-0.6, 0.185),
    ],
    8,
    closed=True,
)
CABIN_SIDE = spline(
    [
        (-1.56, 0.72), (-1.555, 1.00), (-1.425, 1.235), (-1.22, 1.395), (-0.80, 1.478),
        (-0.30, 1.505),
        (0.12, 1.475), (0.36, 1.365), (0.63, 1.165), (0.93, 0.93), (1.05, 0.78), (0.4, 0.62),
        (-1.0, 0.62),
    ],
    8,
    closed=True,
)
LOWER_WIDTH = spline(
    [
        (0.10, 0.735), (0.25, 0.768), (0.42, 0.790), (0.58, 0.797), (0.72, 0.790), (0.86, 0.768),
        (0.98, 0.735), (1.10, 0.69),
    ],
    8,
)
CABIN_WIDTH = spline([(0.60, 0.735), (0.95, 0.703), (1.15, 0.672), (1.35, 0.618), (1.55, 0.545)], 8)
"""Height and half width, (y, x) [m]."""

# Windows and seams in side view, (z, y) [m]; window corners are rounded afterwards.
DOOR_WINDOW = [
    (0.62, 1.035), (0.525, 1.115), (0.27, 1.318), (0.13, 1.362), (-0.36, 1.375), (-0.36, 1.035),
]
REAR_WINDOW = [
    (-0.50, 1.035), (-0.50, 1.372), (-0.95, 1.335), (-1.12, 1.245), (-1.27, 1.06), (-1.24, 1.035),
]
DOOR = spline(
    [
        (0.66, 0.99), (0.70, 0.72), (0.66, 0.42), (0.58, 0.335), (0.0, 0.325), (-0.36, 0.335),
        (-0.45, 0.42), (-0.465, 0.72), (-0.465, 0.99),
    ],
    8,
)
# Windows in front and rear view, (x, y) [m].
WINDSHIELD = [
    (-0.575, 1.035), (0.0, 1.015), (0.575, 1.035), (0.475, 1.335), (0.0, 1.352), (-0.475, 1.335),
]
BACKLIGHT = [
    (-0.50, 1.085), (0.0, 1.07), (0.50, 1.085), (0.435, 1.305), (0.0, 1.318), (-0.435, 1.305),
]
# fmt: on


def _at(curve: Float64Array, height: Float64Array) -> Float64Array:
    """Read a half width [m] off a curve of (y, x) at heights [m]."""
    widths: Float64Array = np.interp(height, curve[:, 0], curve[:, 1])
    return widths


def body_distance(x: Float64Array, y: Float64Array, z: Float64Array) -> Float64Array:
    """Return the signed distance to the closed body [m], wheel arches not yet cut."""
    across = np.abs(x)
    # Nose and tail are bowed in plan, the bonnet and the roof are crowned.
    bow = 0.13 * across**2 + 0.38 * across**4
    lower = round_intersection(
        polygon_distance(LOWER_SIDE[::2], z + bow * np.tanh(1.5 * z), y + 0.05 * across**2),
        across - _at(LOWER_WIDTH, y) + 0.012 * z**2,
        0.085,
    )
    for axle in (FRONT_AXLE, REAR_AXLE):
        radius = np.hypot(y - WHEEL_Y, z - axle)
        lower = lower - 0.026 * np.exp(-(((radius - ARCH_RADIUS) / 0.085) ** 2)) * (
            np.clip((across - 0.5) / 0.2, 0.0, 1.0)
        )
    # A fender from the lamp to the windscreen.
    start, end = np.array([0.568, 0.675, 1.525]), np.array([0.60, 0.80, 0.62])
    along = end - start
    s = np.clip(
        ((across - start[0]) * along[0] + (y - start[1]) * along[1] + (z - start[2]) * along[2])
        / (along @ along),
        0.0,
        1.0,
    )
    fender = np.sqrt(
        (across - start[0] - s * along[0]) ** 2
        + (y - start[1] - s * along[1]) ** 2
        + (z - start[2] - s * along[2]) ** 2
    ) - (0.142 - 0.02 * s)
    lower = round_union(lower, fender, 0.10)
    cabin = round_intersection(
        polygon_distance(
            CABIN_SIDE[::2], z + 0.16 * across**2 * np.tanh(2.0 * z), y + 0.07 * across**2
        ),
        across - _at(CABIN_WIDTH, y) + 0.03 * np.clip(-z - 0.6, 0.0, None) ** 2,
        0.085,
    )
    return round_union(lower, cabin, 0.04)


def _arches(surface: Surface) -> Surface:
    """Cut the four wheel arches out of the body."""
    for axle in (FRONT_AXLE, REAR_AXLE):
        x, y, z = surface.positions.T
        circle = np.hypot(y - WHEEL_Y, z - axle) - ARCH_RADIUS
        surface = split(surface, np.maximum(circle, ARCH_DEPTH - np.abs(x)))[1]
    return surface


def _band(surface: Surface, values: Float64Array, width: float) -> tuple[Surface, Surface, Surface]:
    """Cut a surface into what is below 0, a band from 0 to a width [m], and what is above.

    Cut twice along the same straight function, so that a band narrower than a triangle survives.
    """
    shifted = Surface(
        surface.positions, surface.normals, surface.triangles, np.stack([values, values], axis=1)
    )
    inside, outside = split(shifted, values)
    assert outside.uv is not None
    band, outside = split(outside, outside.uv[:, 0] - width)
    return inside, band, outside


def body() -> list[Part]:
    """Mesh the body and cut it into its panels."""
    # No plane of the grid may graze the flat flanks, near x = 0.8: such cells fold.
    shell = mesh_distance(body_distance, (-0.94, 0.10, -1.90), (0.94, 1.60, 1.90), CELL)
    rest = _arches(shell)
    parts: list[Part] = []

    def cut(name: str, values: Float64Array, seal: str | None = None, width: float = 0.0) -> None:
        nonlocal rest
        inside, band, rest = _band(rest, values, width)
        parts.append((name, inside))
        if seal is not None:
            parts.append((seal, band))

    # Windows with their rubber seals, then the lamps' holes.
    for polygon, rounding in ((DOOR_WINDOW, 0.02), (REAR_WINDOW, 0.02)):
        x, y, z = rest.positions.T
        window = polygon_distance(polygon, z, y) - rounding
        cut("glass", np.maximum(window, 0.4 - np.abs(x)), "black", 0.020)
    for polygon, end in ((WINDSHIELD, 1.0), (BACKLIGHT, -1.0)):
        x, y, z = rest.positions.T
        window = polygon_distance(polygon, x, y) - 0.03
        cut("glass", np.maximum(window, 0.1 - end * z), "black", 0.022)
    x, y, z = rest.positions.T
    hole = np.hypot(np.abs(x) - LAMP[0], y - LAMP[1]) - LAMP_RADIUS
    rest = split(rest, np.maximum(hole, 1.2 - z))[1]

    # Openings of the nose, and the dark sill all around.
    x, y, z = rest.positions.T
    cut(
        "black", np.maximum(np.hypot(np.maximum(np.abs(x) - 0.34, 0.0), y - 0.335) - 0.052, 1.2 - z)
    )
    x, y, z = rest.positions.T
    sill, rest = split(rest, y - 0.235)
    seen = (sill.normals[sill.triangles, 1] > -0.98).any(axis=1)
    parts.append(("black", sill.where(np.asarray(seen))))

    # The white roof above its chrome gutter.
    x, y, z = rest.positions.T
    gutter = 1.412 - 0.09 * np.clip(-z - 0.55, 0.0, None) ** 1.5 - y
    cut("roof", gutter, "chrome", 0.011)

    parts += _seams(rest)
    return [(name, surface) for name, surface in parts if len(surface.triangles)]


def _seams(rest: Surface) -> list[Part]:
    """Cut the seams of doors, bonnet and tailgate out of the painted body."""
    parts: list[Part] = []

    def seam_along(values: Float64Array) -> None:
        nonlocal rest
        below, band, above = _band(rest, values, 0.0075)
        parts.append(("black", band))
        rest = merge([below, above])

    side, rest = split(rest, 0.45 - np.abs(rest.positions[:, 0]))
    distance = polygon_distance(DOOR, side.positions[:, 2], side.positions[:, 1])
    door, seam, wing = _band(side, distance, 0.0075)
    parts.append(("black", seam))
    x, y, z = rest.positions.T
    bonnet = np.maximum(np.abs(x) - 0.435, np.maximum(0.905 - z, z - 1.575))
    seam_along(np.where(z > 0.0, bonnet, 1.0))
    x, y, z = rest.positions.T
    gate = polygon_distance([(-0.44, 0.50), (0.44, 0.50), (0.44, 1.35), (-0.44, 1.35)], x, y) - 0.03
    seam_along(np.where(z < -1.2, gate, 1.0))
    parts.append(("paint", merge([rest, door, wing])))
    return parts


def on_side(y: Float64Array, z: Float64Array) -> Float64Array:
    """Return where lines along x at (y, z) meet the left side of the body, shape [point, 3]."""
    near, far = np.full_like(y, 0.3), np.full_like(y, 1.0)
    for _ in range(40):
        middle = 0.5 * (near + far)
        outside = body_distance(middle, y, z) > 0.0
        near, far = np.where(outside, near, middle), np.where(outside, middle, far)
    return np.stack([0.5 * (near + far), y, z], axis=1)


def on_end(x: Float64Array, y: Float64Array, end: float) -> Float64Array:
    """Return where lines along z at (x, y) meet the nose (``end`` 1) or tail (-1)."""
    near, far = np.zeros_like(x), np.full_like(x, 2.0)
    for _ in range(40):
        middle = 0.5 * (near + far)
        outside = body_distance(x, y, end * middle) > 0.0
        near, far = np.where(outside, near, middle), np.where(outside, middle, far)
    return np.stack([x, y, end * 0.5 * (near + far)], axis=1)
