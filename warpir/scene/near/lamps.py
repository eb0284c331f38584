"""Lamps near the object: spheres and rectangles that shine, and what they give unoccluded ground.

A lamp has the same radiance in all its points and directions, a rectangle on one side. It blocks no
light and is in no picture: the photo shows what is there. Powers are in the photo's units: white
that faces a lamp of power P at a distance d shows ``P / (4 pi^2 d^2)``, and 1 is the photo's white.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import Float64Array


@dataclass(frozen=True)
class SphereLamp:
    """A sphere that shines evenly outward, and inward to what is in it."""

    center: Float64Array
    """World frame [m], shape [3]."""
    radius: float
    """[m]."""
    power: Float64Array
    """Radiant flux of the outside, relative [W], RGB, shape [3]."""

    @property
    def radiance(self) -> Float64Array:
        """Relative [W/(m^2 sr)], RGB, shape [3]."""
        return np.asarray(self.power / (4.0 * np.pi**2 * self.radius**2))


@dataclass(frozen=True)
class RectangleLamp:
    """A rectangle that shines evenly on the side of the cross product of its edges."""

    center: Float64Array
    """World frame [m], shape [3]."""
    edge_x: Float64Array
    edge_y: Float64Array
    """Its sides, at right angles, world frame [m], shape [3] each."""
    power: Float64Array
    """Radiant flux, relative [W], RGB, shape [3]."""

    @property
    def radiance(self) -> Float64Array:
        """Relative [W/(m^2 sr)], RGB, shape [3]."""
        area = np.linalg.norm(self.edge_x) * np.linalg.norm(self.edge_y)
        return np.asarray(self.power / (np.pi * area))

    @property
    def corner(self) -> Float64Array:
        """Where both edges start [m], shape [3]."""
        return np.asarray(self.center - 0.5 * (self.edge_x + self.edge_y))


Lamp = SphereLamp | RectangleLamp

LAMP_COUNT = 64
"""Most lamps of a scene: each ray asks for all of them."""
LARGEST = 1e9
"""Of a coordinate or a length [m], and of a power."""
LEAST = 1e-4
"""Radius or side [m]: float32 radiance overflows where a lamp is a point."""
RIGHT_ANGLE = 1e-3
"""Cosine up to which edges are at right angles [1]."""


def problem_of(lamp: Lamp) -> str:
    """Return what is wrong with a lamp, or nothing."""
    if not (np.abs(lamp.center) <= LARGEST).all():  # nor are NaN and infinity
        return f"a place within {LARGEST:g} m expected"
    if not ((lamp.power >= 0.0) & (lamp.power <= LARGEST)).all():
        return f"power and colour of 0 to {LARGEST:g} expected"
    if isinstance(lamp, SphereLamp):
        if not LEAST <= lamp.radius <= LARGEST:
            return f"a radius of {LEAST:g} to {LARGEST:g} m expected (found {lamp.radius:g})"
        return ""
    for edge in (lamp.edge_x, lamp.edge_y):
        if not ((np.abs(edge) <= LARGEST).all() and np.linalg.norm(edge) >= LEAST):
            return f"edges of {LEAST:g} to {LARGEST:g} m expected"
    slant = abs(float(lamp.edge_x @ lamp.edge_y))
    if slant > RIGHT_ANGLE * float(np.linalg.norm(lamp.edge_x) * np.linalg.norm(lamp.edge_y)):
        return "edges at right angles expected"
    return ""


def records_of(lamps: tuple[Lamp, ...]) -> list[dict[str, list[float] | float]]:
    """Return lamps as plain values for ``run.json``, with the names of their fields."""
    return [
        {name: np.asarray(value).tolist() for name, value in vars(lamp).items()} for lamp in lamps
    ]


def notices_of(lamps: tuple[Lamp, ...], ground: Float64Array | None) -> list[str]:
    """Return what looks odd of lamps that are in order, one line each.

    Args:
        lamps: The lamps.
        ground: Plane ``a x + b y + c z + d = 0``, unit normal up, shape [4]; None: there is none.
    """
    if ground is None:
        return []
    lines = []
    for k, lamp in enumerate(lamps):
        if isinstance(lamp, SphereLamp):
            top = lamp.center @ ground[:3] + ground[3] + lamp.radius
        else:
            corners = [
                lamp.corner + i * lamp.edge_x + j * lamp.edge_y for i in (0, 1) for j in (0, 1)
            ]
            top = max(float(corner @ ground[:3]) for corner in corners) + ground[3]
        if top <= 0.0:
            lines.append(f"lamp {k + 1} is below the ground, which keeps its light away")
    return lines


def irradiance(lamp: Lamp, point: Float64Array, normal: Float64Array) -> Float64Array:
    """Return what a lamp gives a surface that nothing hides it from, relative [W/m^2], RGB.

    Args:
        lamp: The lamp.
        point: On the surface, world frame [m], shape [3].
        normal: Unit normal of the surface, shape [3].
    """
    if isinstance(lamp, SphereLamp):
        return np.asarray(_of_sphere(lamp, point, normal) * lamp.radiance)
    return np.asarray(_of_rectangle(lamp, point, normal) * lamp.radiance)


def _of_sphere(lamp: SphereLamp, point: Float64Array, normal: Float64Array) -> float:
    """Return the irradiance by radiance 1, also of a sphere that the horizon cuts.

    Lagarde and de Rousiers 2014, "Moving Frostbite to Physically Based Rendering", listing 7.
    """
    toward = lamp.center - point
    distance = float(np.linalg.norm(toward))
    if distance <= lamp.radius:
        return float(np.pi)
    sine_squared = (lamp.radius / distance) ** 2
    cosine = float(toward @ normal) / distance
    if cosine**2 >= sine_squared:
        return float(np.pi * sine_squared * max(cosine, 0.0))
    sine = np.sqrt(1.0 - cosine**2)
    x = np.sqrt(1.0 / sine_squared - 1.0)
    y = -x * cosine / sine
    edge = sine * np.sqrt(1.0 - y**2)
    cut = (cosine * np.arccos(y) - x * edge) * sine_squared + np.arctan2(edge, x)
    return max(float(cut), 0.0)


def _of_rectangle(lamp: RectangleLamp, point: Float64Array, normal: Float64Array) -> float:
    """Return the irradiance by radiance 1: Lambert's sum over the edges above the horizon.

    Arvo 1995, "Applications of Irradiance Tensors to the Simulation of Non-Lambertian Phenomena",
    eq. 1.
    """
    start = lamp.corner - point
    if float(start @ np.cross(lamp.edge_x, lamp.edge_y)) >= 0.0:
        return 0.0  # from behind
    corners = start + np.array([lamp.edge_x * 0.0, lamp.edge_x, lamp.edge_x, lamp.edge_y * 0.0])
    corners[2:] += lamp.edge_y
    heights = corners @ normal
    above = []
    for k in range(4):
        a, b, up, next_up = corners[k - 1], corners[k], heights[k - 1], heights[k]
        if (up < 0.0) != (next_up < 0.0):
            above.append(a + (b - a) * (up / (up - next_up)))
        if next_up >= 0.0:
            above.append(b)
    total = 0.0
    for a, b in zip(above, [*above[1:], *above[:1]], strict=True):
        across = np.cross(a, b)
        length = float(np.linalg.norm(across))
        if length > 0.0:
            total += np.arctan2(length, a @ b) * float(across @ normal) / length
    return abs(0.5 * total)
