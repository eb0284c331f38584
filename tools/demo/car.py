"""The demo's car: a small round-eyed hatchback, its body from a distance function, the rest swept.

Frame: front +Z, +Y up, wheels on y = 0, metres. The body is one smooth solid, meshed and then cut
along curves into paint, roof, glass, seams and lamps; everything else is bolted on.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from tools.demo.body import (
    ARCH_DEPTH,
    ARCH_RADIUS,
    FRONT_AXLE,
    LAMP,
    LAMP_RADIUS,
    REAR_AXLE,
    TRACK,
    WHEEL_Y,
    Part,
    body,
    body_distance,
    on_end,
    on_side,
)
from tools.demo.cabin import cabin
from tools.demo.distance import gradient, project
from tools.demo.mesh import (
    Surface,
    both_sides,
    ellipsoid,
    flat,
    grid,
    lathe,
    merge,
    normalized,
    quad,
    rotation,
    rounded_box,
    spline,
    split,
    tube,
    weld,
)
from warpir.core.arrays import Float64Array
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot

MATERIALS = (
    Material("paint", (0.006, 0.110, 0.128), metallic=0.0, roughness=0.08),
    Material("roof", (0.62, 0.59, 0.51), metallic=0.0, roughness=0.10),
    Material("glass", metallic=0.0, roughness=0.0, transmission=1.0),
    Material("lining", (0.16, 0.15, 0.14), metallic=0.0, roughness=0.9),
    Material("seat", (0.20, 0.085, 0.045), metallic=0.0, roughness=0.55),
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

# fmt: off
TYRE = [
    (-0.060, 0.200), (-0.078, 0.205), (-0.090, 0.225), (-0.092, 0.255), (-0.084, 0.285),
    (-0.068, 0.2995),
    (-0.0445, 0.3045), (-0.043, 0.296), (-0.037, 0.296), (-0.0355, 0.3045),
    (-0.0045, 0.3045), (-0.003, 0.296), (0.003, 0.296), (0.0045, 0.3045),
    (0.0355, 0.3045), (0.037, 0.296), (0.043, 0.296), (0.0445, 0.3045),
    (0.068, 0.2995), (0.084, 0.285), (0.092, 0.255), (0.090, 0.225), (0.078, 0.205),
    (0.060, 0.200),
]
TURNED = (
    ("rubber", 40, TYRE),
    ("alloy", 48, [(0.086, 0.212), (0.083, 0.204), (0.074, 0.199), (0.068, 0.187), (0.060, 0.182)]),
    ("black", 40, [(0.066, 0.186), (0.030, 0.178), (-0.02, 0.178), (-0.075, 0.19)]),
    ("alloy", 32, [(-0.012, 0.150), (-0.010, 0.150), (-0.006, 0.148), (-0.006, 0.06)]),
    ("black", 32, [(-0.03, 0.19), (-0.03, 0.0)]),
    ("alloy", 32, [(0.02, 0.068), (0.050, 0.066), (0.060, 0.060), (0.062, 0.052), (0.060, 0.040),
                   (0.060, 0.0)]),
    ("chrome", 24, [(0.058, 0.034), (0.070, 0.032), (0.077, 0.025), (0.081, 0.012), (0.082, 0.0)]),
)
"""What a wheel is turned from: material, facets around, profile of (x, radius) [m]."""
FROM_RIM = np.linspace(0.0, 1.0, 6)[::-1]
"""Where bowls and lenses of lamps are sampled, from the rim to the middle [1]."""
# fmt: on


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
        edge = on_side(y, z)
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
    parts: list[Part] = [(name, lathe(profile, count)) for name, count, profile in TURNED]
    spokes = []
    for k in range(8):
        turn = rotation("x", 45.0 * k)
        path = spline(
            [(0.046, 0.050, 0.0), (0.056, 0.090, 0.0), (0.058, 0.140, 0.0), (0.052, 0.186, 0.0)], 2
        )
        width = np.linspace(0.024, 0.017, len(path))
        spokes.append(tube(path, width, 8, up=(1.0, 0.0, 0.0), aspect=0.55).turned(turn))
    parts.append(("alloy", merge(spokes)))
    nut = lathe([(0.055, 0.008), (0.066, 0.008), (0.069, 0.005), (0.069, 0.0)], 8)
    nuts = []
    for k in range(4):
        c, s = np.cos(np.pi * (0.5 * k + 0.25)), np.sin(np.pi * (0.5 * k + 0.25))
        nuts.append(nut.moved((0.0, 0.048 * c, 0.048 * s)))
    parts.append(("chrome", merge(nuts)))
    return parts


def _wheels() -> list[Part]:
    """Return all four wheels; the front ones are turned a little to the left."""
    parts: list[Part] = []
    for name, left in _wheel():
        right = left.mirrored()
        for axle in (FRONT_AXLE, REAR_AXLE):
            parts.append((name, left.moved((TRACK, WHEEL_Y, axle))))
            parts.append((name, right.moved((-TRACK, WHEEL_Y, axle))))
    return parts


def _head_lamps() -> list[Part]:
    """Return both round head lamps: rim, bowl, bulb and lens."""
    turn = rotation("y", -90.0)
    pod = lathe([(-0.20, LAMP_RADIUS + 0.002), (0.0, LAMP_RADIUS + 0.010)], 40)
    profile = ((0.0, 0.010), (0.004, 0.014), (0.016, 0.011))
    profile += ((0.021, 0.003), (0.018, -0.006), (0.006, -0.010))
    rim = lathe([(x, LAMP_RADIUS + wider) for x, wider in profile], 40)
    bowl, lens = (
        lathe([(0.008 + deep * (1.0 - q * q), (LAMP_RADIUS - 0.008) * q) for q in FROM_RIM], 40)
        for deep in (-0.075, 0.030)
    )
    bulb = ellipsoid((-0.03, 0.0, 0.0), (0.030, 0.022, 0.022), 7)
    ring = lathe(
        [(-0.012, 0.040), (0.006, 0.038), (0.008, 0.034), (0.006, 0.030), (-0.012, 0.030)], 32
    )
    parts = ("paint", pod), ("chrome", rim), ("reflector", bowl)
    parts += ("lens", lens), ("bulb", bulb), ("chrome", ring)
    return [(name, both_sides(surface.turned(turn).moved(LAMP))) for name, surface in parts]


def _bumper(end: float) -> list[Part]:
    """Return a chrome bar that follows the nose (``end`` 1) or the tail (-1), with overriders."""
    x, height = np.linspace(-0.70, 0.70, 41), 0.455
    path = on_end(x, np.full_like(x, height), end)
    path = project(body_distance, path, 2)
    out = normalized(gradient(body_distance, path) * np.array([1.0, 0.0, 1.0]))
    path = path + 0.030 * out
    path[:, 1] = height
    bar = tube(path, 0.022, 12, aspect=1.75)
    guards = (
        rounded_box(path[k] + 0.016 * out[k], (0.026, 0.072, 0.022), 0.02, 4) for k in (10, 30)
    )
    return [("chrome", merge([bar, *guards]))]


def _nose() -> list[Part]:
    """Return the badge, the chrome whiskers, the slats, the indicators and the fog lamps."""
    parts: list[Part] = []
    x = np.linspace(0.075, 0.40, 16)
    y = 0.655 + 0.035 * (x / 0.4) ** 2
    path = on_end(x, y, 1.0)
    parts.append(("chrome", both_sides(tube(path, np.linspace(0.014, 0.007, 16), 10, aspect=0.9))))
    badge = on_end(np.zeros(1), np.array([0.655]), 1.0)[0]
    tilt = rotation("x", -14.0) @ rotation("y", -90.0)
    disc = lathe([(-0.02, 0.058), (0.010, 0.058), (0.016, 0.052), (0.014, 0.046)], 32)
    middle = lathe([(0.012, 0.046), (0.016, 0.025), (0.017, 0.0)], 32)
    parts.append(("chrome", disc.turned(tilt).moved(badge)))
    parts.append(("tail", middle.turned(tilt).moved(badge)))
    for height in (0.318, 0.352):
        x = np.linspace(-0.355, 0.355, 25)
        slat = on_end(x, np.full_like(x, height), 1.0) + np.array([0.0, 0.0, 0.002])
        parts.append(("chrome", tube(slat, 0.006, 8)))
    for at, size, name in (((0.585, 0.545), 0.036, "amber"), ((0.50, 0.335), 0.050, "reflector")):
        spot = on_end(np.array(at[:1]), np.array(at[1:]), 1.0)
        parts += _button(spot, size, name)
    return parts


def _button(spot: Float64Array, size: float, name: str) -> list[Part]:
    """Return a pair of small round lamps with chrome rims on the body at ``spot``, shape [1, 3]."""
    place, out = spot[0], normalized(gradient(body_distance, spot))[0]
    side = normalized(np.cross([0.0, 1.0, 0.0], out))
    frame = np.stack([out, np.cross(side, out), side], axis=1)
    profile = (-0.03, 0.004), (0.006, 0.007), (0.011, 0.002), (0.006, -0.003)
    rim = lathe([(x, size + wider) for x, wider in profile], 22)
    steps = np.linspace(1.0, 0.0, 6)
    dome = lathe([(0.006 + 0.014 * (1.0 - q * q), (size - 0.002) * q) for q in steps], 28)
    return [
        ("chrome", both_sides(rim.turned(frame).moved(place))),
        (name, both_sides(dome.turned(frame).moved(place))),
    ]


def _tail() -> list[Part]:
    """Return the rear lamps, the tailgate handle and the exhaust pipe."""
    parts: list[Part] = []
    lamps = (0.795, 0.062, "tail"), (0.655, 0.050, "amber"), (0.545, 0.045, "tail")
    for height, size, name in lamps:
        spot = on_end(np.array([0.585]), np.array([height]), -1.0)
        parts += _button(spot, size, name)
    handle = on_end(np.linspace(-0.13, 0.13, 9), np.full(9, 0.80), -1.0)
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
    parts.append(("reflector", both_sides(glass.moved(place))))
    stalk = tube([(0.69, 1.005, 0.56), (0.75, 1.015, 0.56), (0.80, 1.035, 0.55)], 0.016, 8)
    parts.append(("black", both_sides(stalk)))
    # Handles and the chrome belt line under the windows.
    z = np.linspace(-0.20, -0.385, 7)
    grip = on_side(np.full_like(z, 0.855), z) + np.array([0.020, 0.0, 0.0])
    parts.append(("chrome", both_sides(tube(grip, 0.011, 10))))
    z = np.linspace(1.38, -1.50, 49)
    belt = on_side(0.700 + 0.012 * np.cos(z), z)
    parts.append(("chrome", both_sides(tube(belt, 0.006, 6, aspect=1.6))))
    spot = on_side(np.array([0.775]), np.array([0.86]))
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
    path = [(0.0, 1.49, -0.05), (0.0, 1.53, -0.08), (0.0, 1.78, -0.32)]
    parts.append(("black", tube(path, [0.010, 0.005, 0.003], 8)))
    return parts


def _on_screen(x: Float64Array, y: Float64Array) -> Float64Array:
    """Return points on the windscreen, in front of it by the thickness of a wiper."""
    points = on_end(x, y, 1.0)
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
        spot = on_end(np.zeros(1), np.array([height]), end)[0]
        z = spot[2] + end * (0.062 if end > 0.0 else 0.02)
        right = np.array([0.46 * end, 0.0, 0.0])
        corner = np.array([0.0, height + 0.05, z]) - 0.5 * right
        parts.append(("plate", quad(corner, right, (0.0, -0.10, 0.0))))
        carrier = rounded_box((0.0, height, z - end * 0.014), (0.24, 0.06, 0.0125), 0.01, 2)
        parts.append(("black", carrier))
    return parts


def plate_texture() -> Texture:
    """Draw the number plate."""
    image = Image.new("RGBA", (256, 64), (238, 238, 232, 255))
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle((2, 2, 253, 61), 6, outline=(25, 25, 28, 255), width=3)
    draw.rectangle((4, 4, 24, 59), fill=(24, 62, 150, 255))
    font = ImageFont.load_default(42)
    draw.text((140, 32), "WARP \u00b7 1R", (25, 25, 28, 255), font, anchor="mm")
    return Texture(np.asarray(image))


def _joined(parts: Iterable[Part]) -> tuple[Primitive, ...]:
    """Merge the surfaces of each material into one primitive, in order of first use."""
    groups: dict[str, list[Surface]] = {}
    for name, surface in parts:
        groups.setdefault(name, []).append(surface)
    primitives = []
    for name, surfaces in groups.items():
        whole = weld(merge(surfaces))
        if MATERIALS[NUMBER[name]].base_color_texture is None:
            whole = replace(whole, uv=None)
        primitives.append(whole.primitive(NUMBER[name]))
    return tuple(primitives)


def car() -> Asset:
    """Make the car: about 3.6 m long, standing on y = 0, front +Z."""
    parts = [
        *body(),
        *cabin(),
        *_wells(),
        *_wheels(),
        *_head_lamps(),
        *_bumper(1.0),
        *_bumper(-1.0),
        *_nose(),
        *_tail(),
        *_trim(),
        *_plates(),
    ]
    return Asset("car", _joined(parts), MATERIALS, (plate_texture(),))
