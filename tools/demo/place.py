"""The demo's place: a paved square in front of a brick house, with planters, bollards and trees.

World frame: +Y up, metres, the camera above the origin looking along -Z. Nothing stands where the
car goes; the shadows of a tree and of a lamp post lie near it.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from tools.demo.mesh import (
    Surface,
    ellipsoid,
    lathe,
    merge,
    normalized,
    quad,
    rotation,
    rounded_box,
    tube,
)
from tools.demo.textures import PAVED, brick_texture, paving_texture, plaster_texture
from warpir.core.arrays import Float64Array
from warpir.demo import PLACE, ROTATE_Y, WET_ROUGHNESS
from warpir.scene.asset import Asset, Material, Primitive, TextureSlot
from warpir.scene.camera import Camera, camera_from_fov

WIDTH, HEIGHT = 1280, 853
FIELD_OF_VIEW, PITCH, EYE_HEIGHT = 50.0, -3.8, 1.55
"""Horizontal field of view, pitch [deg] and height of the camera [m]."""
HOUSE_Z = -17.5
"""Where the house and the garden wall stand [m]."""

MATERIALS = (
    Material("paving", metallic=0.0, roughness=0.85, base_color_texture=TextureSlot(0)),
    Material("brick", metallic=0.0, roughness=0.9, base_color_texture=TextureSlot(1)),
    Material("plaster", metallic=0.0, roughness=0.9, base_color_texture=TextureSlot(2)),
    Material("stone", (0.42, 0.39, 0.34), metallic=0.0, roughness=0.8),
    Material("concrete", (0.36, 0.35, 0.33), metallic=0.0, roughness=0.8),
    Material("frame", (0.72, 0.71, 0.67), metallic=0.0, roughness=0.4),
    Material("door", (0.045, 0.075, 0.055), metallic=0.0, roughness=0.3),
    Material("pane", (0.02, 0.024, 0.028), metallic=0.0, roughness=0.04),
    Material("iron", (0.025, 0.027, 0.028), metallic=0.0, roughness=0.4),
    Material("white", (0.70, 0.70, 0.68), metallic=0.0, roughness=0.5),
    Material("globe", (0.80, 0.80, 0.77), metallic=0.0, roughness=0.2),
    Material("bark", (0.11, 0.085, 0.065), metallic=0.0, roughness=0.95),
    Material("soil", (0.05, 0.035, 0.025), metallic=0.0, roughness=1.0),
    Material("leaf", (0.085, 0.165, 0.030), metallic=0.0, roughness=0.6, double_sided=True),
    Material("leaf_dark", (0.045, 0.105, 0.025), metallic=0.0, roughness=0.6, double_sided=True),
    Material("leaf_light", (0.15, 0.22, 0.045), metallic=0.0, roughness=0.6, double_sided=True),
    Material("flower", (0.65, 0.12, 0.10), metallic=0.0, roughness=0.6, double_sided=True),
    Material("tiles", (0.21, 0.085, 0.055), metallic=0.0, roughness=0.8),
)
BOLLARD = [
    (0.0, 0.085), (0.05, 0.085), (0.07, 0.062), (0.66, 0.055), (0.68, 0.072), (0.74, 0.072),
    (0.78, 0.066), (0.83, 0.045), (0.86, 0.0),
]  # fmt: skip
LAMP_POST = [
    (0.0, 0.14), (0.10, 0.14), (0.14, 0.10), (0.75, 0.085), (0.80, 0.062), (3.55, 0.042),
    (3.60, 0.07), (3.66, 0.07), (3.70, 0.045), (3.78, 0.045),
]  # fmt: skip
"""Profiles (height, radius) [m]."""
NUMBER = {material.name: k for k, material in enumerate(MATERIALS)}


@dataclass
class Builder:
    """Collects surfaces by material."""

    rng: np.random.Generator
    parts: dict[str, list[Surface]] = field(default_factory=dict)

    def add(self, name: str, *surfaces: Surface) -> None:
        """Add surfaces of one material."""
        self.parts.setdefault(name, []).extend(surfaces)

    def box(self, name: str, low: ArrayLike, high: ArrayLike, radius: float = 0.01) -> None:
        """Add a box between two corners [m]."""
        a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
        self.add(name, rounded_box(0.5 * (a + b), 0.5 * (b - a), radius, 2))

    def foliage(
        self,
        center: ArrayLike,
        half: ArrayLike,
        count: int,
        size: float,
        names: tuple[str, ...] = ("leaf", "leaf_dark", "leaf_light"),
        boxed: bool = False,
    ) -> None:
        """Scatter leaves near the surface of an ellipsoid, or, if ``boxed``, in a box.

        Centre and half axes have shape [3], ``size`` is the length of a leaf, all [m]. Materials
        are shared out evenly.
        """
        rng, axes = self.rng, np.asarray(half, dtype=np.float64)
        if boxed:
            inside = rng.uniform(-1.0, 1.0, (count, 3))
            side = rng.integers(0, 3, count)
            sign = rng.choice([-1.0, 1.0], count)
            inside[np.arange(count), side] = sign * (1.0 - 0.12 * rng.random(count))
            out = normalized(np.sign(inside) * np.abs(inside) ** 8)
        else:
            out = normalized(rng.standard_normal((count, 3)))
            inside = out * (1.0 - 0.45 * rng.random((count, 1)) ** 1.6)
        place = np.asarray(center) + inside * axes
        normal = normalized(out + 0.9 * rng.standard_normal((count, 3)))
        along = normalized(np.cross(normal, rng.standard_normal((count, 3))))
        across = np.cross(normal, along)
        length = size * rng.uniform(0.7, 1.2, (count, 1))
        half_long, half_wide = 0.5 * length * along, 0.27 * length * across
        corners = (place - half_long, place + half_wide, place + half_long, place - half_wide)
        leaves = np.stack(corners, axis=1)
        kind = rng.integers(0, len(names), count)
        for k, name in enumerate(names):
            chosen = kind == k
            start = 4 * np.arange(np.count_nonzero(chosen))[:, None]
            triangles = np.concatenate([start + np.array([0, 1, 2]), start + np.array([0, 2, 3])])
            normals = np.repeat(normal[chosen], 4, axis=0)
            self.add(name, Surface(leaves[chosen].reshape(-1, 3), normals, triangles))

    def tree(
        self, foot: ArrayLike, height: float, spread: float, leaves: int, size: float = 0.13
    ) -> None:
        """Add a tree with a crown of several clumps.

        Args:
            foot: Where the trunk leaves the ground [m], shape [3].
            height: Height of the tree [m].
            spread: Radius of the crown [m].
            leaves: Number of leaves.
            size: Length of a leaf [m].
        """
        base = np.asarray(foot, dtype=np.float64)
        top = base + np.array([0.0, 0.62 * height, 0.0])
        bend = self.rng.normal(0.0, 0.05 * height, 3) * [1.0, 0.0, 1.0]
        trunk = [base, 0.5 * (base + top) + 0.3 * bend, top + bend]
        radii = [0.035 * height, 0.026 * height, 0.012 * height]
        self.add("bark", tube(trunk, radii, 10, up=(1.0, 0.0, 0.0)))
        clumps = 11
        for k in range(clumps):
            turn = 2.4 * k
            lift = (k + 0.5) / clumps
            reach = spread * 0.62 * np.sqrt(np.clip(1.0 - (2.0 * lift - 0.75) ** 2, 0.05, 1.0))
            middle = base + np.array(
                [reach * np.cos(turn), height * (0.42 + 0.46 * lift), reach * np.sin(turn)]
            )
            half = spread * self.rng.uniform(0.38, 0.55) * np.array([1.0, 0.78, 1.0])
            branch = [top * 0.6 + base * 0.4, 0.5 * (top + middle), middle]
            radii = [0.009 * height, 0.006 * height, 0.003 * height]
            self.add("bark", tube(branch, radii, 6, up=(0.31, 0.0, 0.95)))
            self.foliage(middle, half, leaves // clumps, size)

    def primitives(self) -> tuple[Primitive, ...]:
        """Return one primitive per material."""
        return tuple(merge(own).primitive(NUMBER[name]) for name, own in self.parts.items())


def _wall(
    build: Builder,
    name: str,
    left: float,
    right: float,
    bottom: float,
    top: float,
    openings: tuple[tuple[float, float, float, float], ...],
    tile: float,
) -> None:
    """Add a house front with rectangular openings (left, right, bottom, top) and their reveals."""
    xs = sorted({left, right, *(k for o in openings for k in o[:2])})
    ys = sorted({bottom, top, *(k for o in openings for k in o[2:])})
    for x0, x1 in pairwise(xs):
        for y0, y1 in pairwise(ys):
            if any(o[0] <= x0 < o[1] and o[2] <= y0 < o[3] for o in openings):
                continue
            piece = quad((x0, y1, HOUSE_Z), (x1 - x0, 0.0, 0.0), (0.0, y0 - y1, 0.0), tile)
            assert piece.uv is not None
            build.add(name, replace(piece, uv=piece.uv + np.array([x0 / tile, -y1 / tile])))


def _window(build: Builder, left: float, right: float, bottom: float, top: float) -> None:
    """Add a window in its opening: reveal, frame, bars, pane and sill."""
    deep = HOUSE_Z - 0.16
    build.add(
        "pane", quad((left, top, deep + 0.01), (right - left, 0.0, 0.0), (0.0, bottom - top, 0.0))
    )
    middle = 0.5 * (left + right)
    for x0, x1 in ((left, left + 0.07), (middle - 0.025, middle + 0.025), (right - 0.07, right)):
        build.box("frame", (x0, bottom, deep), (x1, top, deep + 0.06))
    third = bottom + 0.66 * (top - bottom)
    for y0, y1 in ((bottom, bottom + 0.07), (third - 0.02, third + 0.02), (top - 0.07, top)):
        build.box("frame", (left, y0, deep), (right, y1, deep + 0.055))
    for x0, x1 in ((left - 0.02, left), (right, right + 0.02)):
        build.box("frame", (x0, bottom, deep), (x1, top, HOUSE_Z + 0.004), 0.003)
    build.box("stone", (left - 0.10, bottom - 0.09, deep), (right + 0.10, bottom, HOUSE_Z + 0.07))
    build.box("stone", (left - 0.14, top, deep), (right + 0.14, top + 0.18, HOUSE_Z + 0.03))


def _house(build: Builder) -> None:
    """Add the house on the left: brick below, plaster above, windows, a door and the eaves."""
    left, right = -14.0, -0.6
    windows = ((-12.3, -11.0), (-9.2, -7.9), (-3.0, -1.7))
    door = (-6.35, -5.2, 0.0, 2.25)
    lower = tuple((a, b, 1.0, 2.45) for a, b in windows)
    upper = tuple((a, b, 3.75, 5.05) for a, b in (*windows, (-6.42, -5.12)))
    _wall(build, "brick", left, right, 0.0, 3.05, (*lower, door), 1.92)
    _wall(build, "plaster", left, right, 3.05, 6.0, upper, 3.0)
    for a, b, bottom, top in (*lower, *upper):
        _window(build, a, b, bottom, top)
    build.box("stone", (left, 2.98, HOUSE_Z - 0.05), (right + 0.04, 3.14, HOUSE_Z + 0.06))
    build.box("stone", (left, 0.0, HOUSE_Z - 0.05), (door[0], 0.34, HOUSE_Z + 0.035))
    build.box("stone", (door[1], 0.0, HOUSE_Z - 0.05), (right + 0.04, 0.34, HOUSE_Z + 0.035))
    # The side of the house is seen at its right edge; the eaves stand out over the front.
    build.box("plaster", (right - 0.3, 0.0, HOUSE_Z - 8.0), (right - 0.001, 6.0, HOUSE_Z - 0.01))
    build.box("tiles", (left, 6.0, HOUSE_Z - 8.0), (right + 0.35, 6.14, HOUSE_Z + 0.45))
    build.add(
        "iron", tube([(left, 5.97, HOUSE_Z + 0.5), (right + 0.35, 5.97, HOUSE_Z + 0.5)], 0.06, 10)
    )
    pipe = np.array([right - 0.22, 0.0, HOUSE_Z + 0.09])
    build.add("iron", tube([pipe, pipe + np.array([0.0, 5.9, 0.0])], 0.045, 10, up=(1.0, 0.0, 0.0)))
    # The door with its step, frame and a small light above.
    a, b, _, top = door
    build.box("door", (a, 0.14, HOUSE_Z - 0.20), (b, top, HOUSE_Z - 0.13))
    for y0, y1 in ((0.35, 1.05), (1.2, 2.05)):
        for x0, x1 in ((a + 0.12, a + 0.52), (b - 0.52, b - 0.12)):
            build.box("door", (x0, y0, HOUSE_Z - 0.14), (x1, y1, HOUSE_Z - 0.112), 0.012)
    build.box("frame", (a - 0.12, 0.0, HOUSE_Z - 0.2), (a, top + 0.12, HOUSE_Z + 0.03))
    build.box("frame", (b, 0.0, HOUSE_Z - 0.2), (b + 0.12, top + 0.12, HOUSE_Z + 0.03))
    build.box("frame", (a - 0.12, top, HOUSE_Z - 0.2), (b + 0.12, top + 0.12, HOUSE_Z + 0.03))
    build.box("stone", (a - 0.25, 0.0, HOUSE_Z - 0.2), (b + 0.25, 0.14, HOUSE_Z + 0.38))
    build.add("white", ellipsoid((b - 0.08, 1.1, HOUSE_Z - 0.10), (0.025, 0.025, 0.025), 8))


def _garden(build: Builder) -> None:
    """Add the low brick wall on the right with its coping, the hedge and the trees behind."""
    left, right, height = -0.6, 15.0, 0.95
    build.add(
        "brick", quad((left, height, HOUSE_Z), (right - left, 0.0, 0.0), (0.0, -height, 0.0), 1.92)
    )
    for k in range(int((right - left) / 0.8)):
        x = left + 0.8 * k
        low, high = (x + 0.004, height, HOUSE_Z - 0.34), (x + 0.796, height + 0.08, HOUSE_Z + 0.05)
        build.box("stone", low, high, 0.015)
    middle = 0.5 * (left + right)
    build.box("leaf_dark", (left, 0.0, HOUSE_Z - 1.55), (right, 1.42, HOUSE_Z - 0.82))
    build.foliage(
        (middle, 0.95, HOUSE_Z - 1.15), (middle - left, 0.62, 0.52), 42000, 0.085, boxed=True
    )
    build.tree((3.3, 0.0, -23.5), 6.6, 2.5, 15000)
    build.tree((8.6, 0.0, -22.0), 5.4, 2.1, 12000)
    build.tree((13.0, 0.0, -26.0), 8.0, 3.0, 12000, 0.16)
    for k in range(16):
        x = -10.0 + 3.6 * k + build.rng.uniform(-1.0, 1.0)
        build.foliage(
            (x, build.rng.uniform(1.0, 2.6), -48.0 + build.rng.uniform(-4.0, 4.0)),
            (3.2, build.rng.uniform(2.6, 4.2), 2.6),
            1700,
            0.42,
        )


def _planter(build: Builder, x: float, z: float, bush: float) -> None:
    """Add a square concrete planter with a bush and a few flowers."""
    half, height = 0.46, 0.62

    def block(name: str, wider: float, bottom: float, top: float, radius: float = 0.01) -> None:
        low = x - half - wider, bottom, z - half - wider
        build.box(name, low, (x + half + wider, top, z + half + wider), radius)

    block("concrete", 0.0, 0.03, height, 0.02)
    block("concrete", -0.06, 0.0, 0.04)
    block("concrete", 0.03, height - 0.10, height + 0.02, 0.015)
    block("soil", -0.06, height, height + 0.05)
    build.add("soil", ellipsoid((x, height + 0.6 * bush, z), np.full(3, 0.62 * bush), 10))
    build.foliage((x, height + 0.62 * bush, z), np.array([1.0, 0.95, 1.0]) * bush, 5200, 0.07)
    build.foliage((x, height + 0.12, z), (half, 0.16, half), 240, 0.06, ("flower", "leaf_light"))


def _furniture(build: Builder) -> None:
    """Add bollards, planters, a lamp post and a bench."""
    upright = rotation("z", 90.0)
    post = lathe(BOLLARD, 24).turned(upright)
    band = lathe([(0.54, 0.0595), (0.62, 0.0590)], 24).turned(upright)
    for k in range(5):
        place = (2.9 + 1.55 * k, 0.0, -13.6)
        build.add("iron", post.moved(place))
        build.add("white", band.moved(place))
    _planter(build, -5.5, -13.4, 0.58)
    _planter(build, -2.1, -15.6, 0.50)
    # The lamp post: its long shadow runs behind the car.
    x, z = -3.3, -11.0
    cap = lathe([(4.17, 0.13), (4.19, 0.12), (4.24, 0.05), (4.30, 0.0)], 24)
    build.add("iron", *(p.turned(upright).moved((x, 0.0, z)) for p in (lathe(LAMP_POST, 24), cap)))
    build.add("globe", ellipsoid((x, 3.98, z), (0.21, 0.22, 0.21), 16))
    # A bench before the garden wall.
    for k in range(4):
        build.box("bark", (3.6, 0.44, -16.62 + 0.115 * k), (5.3, 0.475, -16.52 + 0.115 * k), 0.008)
    for k in range(3):
        build.box("bark", (3.6, 0.56 + 0.125 * k, -16.72), (5.3, 0.66 + 0.125 * k, -16.685), 0.008)
    for x in (3.8, 5.1):
        build.box("iron", (x - 0.03, 0.0, -16.24), (x + 0.03, 0.44, -16.18))
        build.box("iron", (x - 0.03, 0.0, -16.76), (x + 0.03, 0.92, -16.70))
        build.box("iron", (x - 0.03, 0.40, -16.74), (x + 0.03, 0.44, -16.18))


WET = replace(
    MATERIALS[0], base_color=(0.5, 0.5, 0.5), clearcoat=1.0, clearcoat_roughness=WET_ROUGHNESS
)
"""Paving after rain: darker for the water in its pores, under a film of water as a coat."""


def background(is_wet: bool = False) -> Asset:
    """Make the place that the photo shows, in the world frame."""
    build = Builder(np.random.default_rng(20))
    build.add(
        "paving",
        quad((-PAVED, 0.0, -2.0 * PAVED), (2.0 * PAVED, 0.0, 0.0), (0.0, 0.0, 3.0 * PAVED), PAVED),
    )
    _house(build)
    _garden(build)
    _furniture(build)
    # Out of the picture on the left: the tree whose shadow lies in the foreground.
    build.tree((-7.7, 0.0, -0.4), 6.6, 2.1, 14000)
    textures = (paving_texture(), brick_texture(), plaster_texture())
    materials = (WET, *MATERIALS[1:]) if is_wet else MATERIALS
    return Asset("square", build.primitives(), materials, textures)


def camera() -> Camera:
    """Return the photo's camera, at eye height, looking along -Z and a little down."""
    return camera_from_fov(WIDTH, HEIGHT, FIELD_OF_VIEW, PITCH, EYE_HEIGHT)


def car_to_world() -> Float64Array:
    """Return the pose of the car, column vectors, shape [4, 4]."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation("y", ROTATE_Y)
    matrix[:3, 3] = PLACE
    return matrix
