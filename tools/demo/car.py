"""The demo's car: a small round-eyed hatchback, made from a distance function and swept parts.

Frame: front +Z, +Y up, wheels on y = 0, metres. The body is one smooth solid, meshed and then cut
along curves into paint, roof, glass, seams and lamps; everything else is bolted on.
"""

from collections.abc import Iterable

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tools.demo.mesh import (
    Surface,
    both_sides,
    ellipsoid,
    flat,
    gradient,
    grid,
    lathe,
    merge,
    mesh_distance,
    normalized,
    polygon_distance,
    project,
    quad,
    rotation,
    round_intersection,
    round_union,
    rounded_box,
    spline,
    split,
    tube,
    weld,
)
from warpir.core.arrays import Float64Array
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot

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

MATERIALS = (
    Material("paint", (0.006, 0.110, 0.128), metallic=0.0, roughness=0.08),
    Material("roof", (0.62, 0.59, 0.51), metallic=0.0, roughness=0.10),
    Material("glass", (0.012, 0.015, 0.016), metallic=0.0, roughness=0.02),
    Material("chrome", (0.76, 0.77, 0.78), metallic=1.0, roughness=0.09),
    Material("alloy", (0.66, 0.67, 0.68), metallic=1.0, roughness=0.28),
    Material("rubber", (0.022, 0.022, 0.023), metallic=0.0, roughness=0.75),
    Material("black", (0.018, 0.018, 0.019), metallic=0.0, roughness=0.5),
    Material(
        "lens", (0.85, 0.90, 0.92), alpha=0.12, metallic=0.0, roughness=0.03, alpha_mode="BLEND"
    ),
    Material("reflector", (0.86, 0.87, 0.88), metallic=1.0, roughness=0.16),
    Material("bulb", (0.9, 0.88, 0.80), metallic=0.0, roughness=0.2, emission=(0.3, 0.28, 0.22)),
    Material("tail", (0.42, 0.010, 0.012), metallic=0.0, roughness=0.06, emission=(0.02, 0.0, 0.0)),
    Material("amber", (0.75, 0.22, 0.015), metallic=0.0, roughness=0.08),
    Material("plate", metallic=0.0, roughness=0.4, base_color_texture=TextureSlot(0)),
)
NUMBER = {material.name: k for k, material in enumerate(MATERIALS)}

Part = tuple[str, Surface]

# Side views, (z, y) [m].
LOWER_SIDE = spline(
    [
        (-1.60, 0.19),
        (-1.755, 0.30),
        (-1.785, 0.48),
        (-1.745, 0.72),
        (-1.655, 0.905),
        (-1.46, 0.978),
        (-0.4, 0.972),
        (0.80, 0.935),
        (1.30, 0.872),
        (1.60, 0.775),
        (1.735, 0.62),
        (1.775, 0.45),
        (1.74, 0.29),
        (1.58, 0.19),
        (0.6, 0.185),
        (-0.6, 0.185),
    ],
    8,
    closed=True,
)
CABIN_SIDE = spline(
    [
        (-1.56, 0.72),
        (-1.555, 1.00),
        (-1.425, 1.235),
        (-1.22, 1.395),
        (-0.80, 1.478),
        (-0.30, 1.505),
        (0.12, 1.475),
        (0.36, 1.365),
        (0.63, 1.165),
        (0.93, 0.93),
        (1.05, 0.78),
        (0.4, 0.62),
        (-1.0, 0.62),
    ],
    8,
    closed=True,
)
LOWER_WIDTH = spline(
    [
        (0.10, 0.735),
        (0.25, 0.768),
        (0.42, 0.790),
        (0.58, 0.797),
        (0.72, 0.790),
        (0.86, 0.768),
        (0.98, 0.735),
        (1.10, 0.69),
    ],
    8,
)
CABIN_WIDTH = spline([(0.60, 0.735), (0.95, 0.703), (1.15, 0.672), (1.35, 0.618), (1.55, 0.545)], 8)
"""Height and half width, (y, x) [m]."""

# Windows and seams in side view, (z, y) [m]; window corners are rounded afterwards.
DOOR_WINDOW = [
    (0.62, 1.035),
    (0.525, 1.115),
    (0.27, 1.318),
    (0.13, 1.362),
    (-0.36, 1.375),
    (-0.36, 1.035),
]
REAR_WINDOW = [
    (-0.50, 1.035),
    (-0.50, 1.372),
    (-0.95, 1.335),
    (-1.12, 1.245),
    (-1.27, 1.06),
    (-1.24, 1.035),
]
DOOR = spline(
    [
        (0.66, 0.99),
        (0.70, 0.72),
        (0.66, 0.42),
        (0.58, 0.335),
        (0.0, 0.325),
        (-0.36, 0.335),
        (-0.45, 0.42),
        (-0.465, 0.72),
        (-0.465, 0.99),
    ],
    8,
)
# Windows in front and rear view, (x, y) [m].
WINDSHIELD = [
    (-0.575, 1.035),
    (0.0, 1.015),
    (0.575, 1.035),
    (0.475, 1.335),
    (0.0, 1.352),
    (-0.475, 1.335),
]
BACKLIGHT = [
    (-0.50, 1.085),
    (0.0, 1.07),
    (0.50, 1.085),
    (0.435, 1.305),
    (0.0, 1.318),
    (-0.435, 1.305),
]


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


def _body() -> list[Part]:
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

    def seam_along(values: Float64Array) -> None:
        nonlocal rest
        below, band, above = _band(rest, values, 0.0075)
        parts.append(("black", band))
        rest = merge([below, above])

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

    # Seams: doors on the sides, bonnet in front, tailgate behind.
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
    return [(name, surface) for name, surface in parts if len(surface.triangles)]


def _on_side(y: Float64Array, z: Float64Array) -> Float64Array:
    """Return where lines along x at (y, z) meet the left side of the body, shape [point, 3]."""
    near, far = np.full_like(y, 0.3), np.full_like(y, 1.0)
    for _ in range(40):
        middle = 0.5 * (near + far)
        outside = body_distance(middle, y, z) > 0.0
        near, far = np.where(outside, near, middle), np.where(outside, middle, far)
    return np.stack([0.5 * (near + far), y, z], axis=1)


def _on_end(x: Float64Array, y: Float64Array, end: float) -> Float64Array:
    """Return where lines along z at (x, y) meet the nose (``end`` 1) or tail (-1)."""
    near, far = np.zeros_like(x), np.full_like(x, 2.0)
    for _ in range(40):
        middle = 0.5 * (near + far)
        outside = body_distance(x, y, end * middle) > 0.0
        near, far = np.where(outside, near, middle), np.where(outside, middle, far)
    return np.stack([x, y, end * 0.5 * (near + far)], axis=1)


def _wells() -> list[Part]:
    """Close the floor, line the wheel arches and give them a lip."""
    parts: list[Part] = []
    for half_x, half_z, y_floor in ((ARCH_DEPTH, 1.62, 0.192), (0.72, 0.72, 0.194)):
        corners = [
            [(-half_x, y_floor, -half_z), (half_x, y_floor, -half_z)],
            [(-half_x, y_floor, half_z), (half_x, y_floor, half_z)],
        ]
        parts.append(("black", flat(np.array(corners), (0.0, -1.0, 0.0))))
    start = np.arcsin((0.19 - WHEEL_Y) / ARCH_RADIUS)
    angle = np.linspace(start, np.pi - start, 37)
    for axle in (FRONT_AXLE, REAR_AXLE):
        y, z = WHEEL_Y + ARCH_RADIUS * np.sin(angle), axle + ARCH_RADIUS * np.cos(angle)
        edge = _on_side(y, z)
        inner = edge.copy()
        inner[:, 0] = ARCH_DEPTH
        inward = np.stack([np.zeros_like(y), -np.sin(angle), -np.cos(angle)], axis=1)
        lining = np.stack([inner, edge])
        parts.append(("rubber", both_sides(grid(lining, np.stack([inward, inward])))))
        middle = np.broadcast_to([ARCH_DEPTH, 0.19, axle], inner.shape)
        parts.append(("rubber", both_sides(flat(np.stack([middle, inner]), (1.0, 0.0, 0.0)))))
        parts.append(("black", both_sides(tube(edge, 0.011, 6, up=(1.0, 0.0, 0.0)))))
    return parts


def _wheel() -> list[Part]:
    """Return the left wheel about the origin, its outer face toward +x."""
    tyre = [
        (-0.060, 0.200),
        (-0.078, 0.205),
        (-0.090, 0.225),
        (-0.092, 0.255),
        (-0.084, 0.285),
        (-0.068, 0.2995),
    ]
    for x in (-0.040, 0.0, 0.040):
        tyre += [(x - 0.0045, 0.3045), (x - 0.003, 0.296), (x + 0.003, 0.296), (x + 0.0045, 0.3045)]
    tyre += [
        (0.068, 0.2995),
        (0.084, 0.285),
        (0.092, 0.255),
        (0.090, 0.225),
        (0.078, 0.205),
        (0.060, 0.200),
    ]
    parts: list[Part] = [
        ("rubber", lathe(tyre, 40)),
        (
            "alloy",
            lathe(
                [(0.086, 0.212), (0.083, 0.204), (0.074, 0.199), (0.068, 0.187), (0.060, 0.182)], 48
            ),
        ),
        ("black", lathe([(0.066, 0.186), (0.030, 0.178), (-0.02, 0.178), (-0.075, 0.19)], 40)),
        ("alloy", lathe([(-0.012, 0.150), (-0.010, 0.150), (-0.006, 0.148), (-0.006, 0.06)], 32)),
        ("black", lathe([(-0.03, 0.19), (-0.03, 0.0)], 32)),
        (
            "alloy",
            lathe(
                [
                    (0.02, 0.068),
                    (0.050, 0.066),
                    (0.060, 0.060),
                    (0.062, 0.052),
                    (0.060, 0.040),
                    (0.060, 0.0),
                ],
                32,
            ),
        ),
        (
            "chrome",
            lathe(
                [(0.058, 0.034), (0.070, 0.032), (0.077, 0.025), (0.081, 0.012), (0.082, 0.0)], 24
            ),
        ),
    ]
    spokes = []
    for k in range(8):
        turn = rotation("x", 45.0 * k)
        path = spline(
            [(0.046, 0.050, 0.0), (0.056, 0.090, 0.0), (0.058, 0.140, 0.0), (0.052, 0.186, 0.0)], 2
        )
        width = np.linspace(0.024, 0.017, len(path))
        spokes.append(tube(path, width, 8, up=(1.0, 0.0, 0.0), aspect=0.55).turned(turn))
    parts.append(("alloy", merge(spokes)))
    nuts = []
    for k in range(4):
        c, s = np.cos(np.pi * (0.5 * k + 0.25)), np.sin(np.pi * (0.5 * k + 0.25))
        nuts.append(
            lathe([(0.055, 0.008), (0.066, 0.008), (0.069, 0.005), (0.069, 0.0)], 8).moved(
                (0.0, 0.048 * c, 0.048 * s)
            )
        )
    parts.append(("chrome", merge(nuts)))
    return parts


def _wheels() -> list[Part]:
    """Return all four wheels; the front ones are turned a little to the left."""
    parts: list[Part] = []
    for name, surface in _wheel():
        for axle in (FRONT_AXLE, REAR_AXLE):
            left, right = surface, surface.mirrored()
            parts += [
                (name, left.moved((TRACK, WHEEL_Y, axle))),
                (name, right.moved((-TRACK, WHEEL_Y, axle))),
            ]
    return parts


def _head_lamps() -> list[Part]:
    """Return both round head lamps: rim, bowl, bulb and lens."""
    turn = rotation("y", -90.0)
    pod = lathe([(-0.20, LAMP_RADIUS + 0.002), (0.0, LAMP_RADIUS + 0.010)], 40)
    rim = lathe(
        [
            (0.0, LAMP_RADIUS + 0.010),
            (0.004, LAMP_RADIUS + 0.014),
            (0.016, LAMP_RADIUS + 0.011),
            (0.021, LAMP_RADIUS + 0.003),
            (0.018, LAMP_RADIUS - 0.006),
            (0.006, LAMP_RADIUS - 0.010),
        ],
        40,
    )
    depth = np.linspace(0.0, 1.0, 6)
    bowl = lathe(
        [(0.008 - 0.075 * (1.0 - q * q), (LAMP_RADIUS - 0.008) * q) for q in depth[::-1]], 40
    )
    lens = lathe(
        [(0.008 + 0.030 * (1.0 - q * q), (LAMP_RADIUS - 0.008) * q) for q in depth[::-1]], 40
    )
    bulb = ellipsoid((-0.03, 0.0, 0.0), (0.030, 0.022, 0.022), 7)
    ring = lathe(
        [(-0.012, 0.040), (0.006, 0.038), (0.008, 0.034), (0.006, 0.030), (-0.012, 0.030)], 32
    )
    parts: list[Part] = []
    for name, surface in (
        ("paint", pod),
        ("chrome", rim),
        ("reflector", bowl),
        ("lens", lens),
        ("bulb", bulb),
        ("chrome", ring),
    ):
        parts.append((name, both_sides(surface.turned(turn).moved(LAMP))))
    return parts


def _bumper(end: float, height: float) -> list[Part]:
    """Return a chrome bar that follows the nose (``end`` 1) or the tail (-1), with overriders."""
    x = np.linspace(-0.70, 0.70, 41)
    path = _on_end(x, np.full_like(x, height), end)
    path = project(body_distance, path, 2)
    out = normalized(gradient(body_distance, path) * np.array([1.0, 0.0, 1.0]))
    path = path + 0.030 * out
    path[:, 1] = height
    bar = tube(path, 0.022, 12, aspect=1.75)
    guards = []
    for k in (10, 30):
        guards.append(rounded_box(path[k] + 0.016 * out[k], (0.026, 0.072, 0.022), 0.02, 4))
    return [("chrome", merge([bar, *guards]))]


def _nose() -> list[Part]:
    """Return the badge, the chrome whiskers, the slats, the indicators and the fog lamps."""
    parts: list[Part] = []
    x = np.linspace(0.075, 0.40, 16)
    y = 0.655 + 0.035 * (x / 0.4) ** 2
    path = _on_end(x, y, 1.0)
    parts.append(("chrome", both_sides(tube(path, np.linspace(0.014, 0.007, 16), 10, aspect=0.9))))
    badge = _on_end(np.zeros(1), np.array([0.655]), 1.0)[0]
    tilt = rotation("x", -14.0) @ rotation("y", -90.0)
    disc = lathe([(-0.02, 0.058), (0.010, 0.058), (0.016, 0.052), (0.014, 0.046)], 32)
    middle = lathe([(0.012, 0.046), (0.016, 0.025), (0.017, 0.0)], 32)
    parts.append(("chrome", disc.turned(tilt).moved(badge)))
    parts.append(("tail", middle.turned(tilt).moved(badge)))
    for height in (0.318, 0.352):
        x = np.linspace(-0.355, 0.355, 25)
        slat = _on_end(x, np.full_like(x, height), 1.0) + np.array([0.0, 0.0, 0.002])
        parts.append(("chrome", tube(slat, 0.006, 8)))
    for x_lamp, y_lamp, size, name in (
        (0.585, 0.545, 0.036, "amber"),
        (0.50, 0.335, 0.050, "reflector"),
    ):
        spot = _on_end(np.array([x_lamp]), np.array([y_lamp]), 1.0)
        parts += _button(spot, size, name)
    return parts


def _button(spot: Float64Array, size: float, name: str) -> list[Part]:
    """Return a pair of small round lamps with chrome rims on the body at ``spot``, shape [1, 3]."""
    place, out = spot[0], normalized(gradient(body_distance, spot))[0]
    side = normalized(np.cross([0.0, 1.0, 0.0], out))
    frame = np.stack([out, np.cross(side, out), side], axis=1)
    rim = lathe(
        [
            (-0.03, size + 0.004),
            (0.006, size + 0.007),
            (0.011, size + 0.002),
            (0.006, size - 0.003),
        ],
        22,
    )
    dome = lathe(
        [(0.006 + 0.014 * (1.0 - q * q), (size - 0.002) * q) for q in np.linspace(1.0, 0.0, 6)], 28
    )
    return [
        ("chrome", both_sides(rim.turned(frame).moved(place))),
        (name, both_sides(dome.turned(frame).moved(place))),
    ]


def _tail() -> list[Part]:
    """Return the rear lamps, the tailgate handle and the exhaust pipe."""
    parts: list[Part] = []
    for height, size, name in (
        (0.795, 0.062, "tail"),
        (0.655, 0.050, "amber"),
        (0.545, 0.045, "tail"),
    ):
        spot = _on_end(np.array([0.585]), np.array([height]), -1.0)
        parts += _button(spot, size, name)
    handle = _on_end(np.linspace(-0.13, 0.13, 9), np.full(9, 0.80), -1.0)
    parts.append(("chrome", tube(handle - np.array([0.0, 0.0, 0.012]), 0.014, 10)))
    pipe = lathe([(-0.2, 0.026), (0.0, 0.026), (0.003, 0.023), (0.0, 0.020), (-0.1, 0.020)], 20)
    parts.append(("chrome", pipe.turned(rotation("y", 90.0)).moved((0.38, 0.19, -1.74))))
    return parts


def _trim() -> list[Part]:
    """Return mirrors, door handles, the belt line, wipers and the aerial."""
    parts: list[Part] = []
    # Mirrors: a painted shell on a stalk, glass behind.
    shell = ellipsoid((0.0, 0.0, 0.0), (0.085, 0.062, 0.055), 10)
    shell = split(shell, shell.positions[:, 2] + 0.012)[1]
    glass = _disc(0.082, 0.059, -0.012)
    place = np.array([0.835, 1.055, 0.545])
    parts.append(("chrome", both_sides(shell.moved(place))))
    parts.append(("glass", both_sides(glass.moved(place))))
    parts.append(
        (
            "black",
            both_sides(
                tube([(0.69, 1.005, 0.56), (0.75, 1.015, 0.56), (0.80, 1.035, 0.55)], 0.016, 8)
            ),
        )
    )
    # Handles and the chrome belt line under the windows.
    z = np.linspace(-0.20, -0.385, 7)
    grip = _on_side(np.full_like(z, 0.855), z) + np.array([0.020, 0.0, 0.0])
    parts.append(("chrome", both_sides(tube(grip, 0.011, 10))))
    z = np.linspace(1.38, -1.50, 49)
    belt = _on_side(0.700 + 0.012 * np.cos(z), z)
    parts.append(("chrome", both_sides(tube(belt, 0.006, 6, aspect=1.6))))
    spot = _on_side(np.array([0.775]), np.array([0.86]))
    parts += _button(spot, 0.020, "amber")
    # Wipers lie on the windscreen.
    for start, end in (((0.10, 0.985), (0.52, 1.055)), ((-0.42, 0.985), (0.02, 1.06))):
        x = np.linspace(start[0], end[0], 15)
        y = np.linspace(start[1], end[1], 15)
        blade = _on_screen(x, y)
        parts.append(("black", tube(blade, 0.007, 6)))
        arm = _on_screen(
            np.linspace(start[0], 0.5 * (start[0] + end[0]), 9),
            np.linspace(start[1] - 0.05, 0.5 * (start[1] + end[1]), 9),
        )
        parts.append(("black", tube(arm + np.array([0.0, 0.006, 0.004]), 0.006, 6)))
    parts.append(
        (
            "black",
            tube(
                [(0.0, 1.49, -0.05), (0.0, 1.53, -0.08), (0.0, 1.78, -0.32)],
                [0.010, 0.005, 0.003],
                8,
            ),
        )
    )
    return parts


def _on_screen(x: Float64Array, y: Float64Array) -> Float64Array:
    """Return points on the windscreen, in front of it by the thickness of a wiper."""
    points = _on_end(x, y, 1.0)
    return points + 0.008 * normalized(gradient(body_distance, points))


def _disc(width: float, height: float, z: float) -> Surface:
    """Return an elliptic disc of half axes [m] that faces -z."""
    angle = np.linspace(0.0, 2.0 * np.pi, 33)
    edge = np.stack([width * np.cos(angle), height * np.sin(angle), np.full(33, z)], axis=1)
    middle = np.broadcast_to([0.0, 0.0, z], edge.shape)
    return flat(np.stack([middle, edge]), (0.0, 0.0, -1.0))


def _plates() -> list[Part]:
    """Return the number plates on their black carriers."""
    parts: list[Part] = []
    for end, height in ((1.0, 0.425), (-1.0, 0.60)):
        spot = _on_end(np.zeros(1), np.array([height]), end)[0]
        z = spot[2] + end * (0.062 if end > 0.0 else 0.02)
        right = np.array([0.46 * end, 0.0, 0.0])
        corner = np.array([0.0, height + 0.05, z]) - 0.5 * right
        parts.append(("plate", quad(corner, right, (0.0, -0.10, 0.0))))
        parts.append(
            ("black", rounded_box((0.0, height, z - end * 0.014), (0.24, 0.06, 0.0125), 0.01, 2))
        )
    return parts


def plate_texture() -> Texture:
    """Draw the number plate."""
    image = Image.new("RGBA", (256, 64), (238, 238, 232, 255))
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle((2, 2, 253, 61), 6, outline=(25, 25, 28, 255), width=3)
    draw.rectangle((4, 4, 24, 59), fill=(24, 62, 150, 255))
    draw.text(
        (140, 32), "WARP \u00b7 1R", (25, 25, 28, 255), ImageFont.load_default(42), anchor="mm"
    )
    return Texture(np.asarray(image))


def _joined(parts: Iterable[Part]) -> tuple[Primitive, ...]:
    """Merge the surfaces of each material into one primitive, in order of first use."""
    groups: dict[str, list[Surface]] = {}
    for name, surface in parts:
        groups.setdefault(name, []).append(surface)
    primitives = []
    for name, surfaces in groups.items():
        whole = weld(merge(surfaces))
        textured = MATERIALS[NUMBER[name]].base_color_texture is not None
        primitives.append(
            Primitive(
                whole.positions,
                whole.triangles.astype(np.int32),
                NUMBER[name],
                whole.normals.astype(np.float32),
                uv0=whole.uv.astype(np.float32) if textured and whole.uv is not None else None,
            )
        )
    return tuple(primitives)


def car() -> Asset:
    """Make the car: about 3.6 m long, standing on y = 0, front +Z."""
    parts = [
        *_body(),
        *_wells(),
        *_wheels(),
        *_head_lamps(),
        *_bumper(1.0, 0.455),
        *_bumper(-1.0, 0.455),
        *_nose(),
        *_tail(),
        *_trim(),
        *_plates(),
    ]
    return Asset("car", _joined(parts), MATERIALS, (plate_texture(),))
