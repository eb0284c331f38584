"""Shadows in hard places: tiny and huge scenes, far away, boxes on, above and in the plane."""

import numpy as np

from benchmarks.measure import rms
from benchmarks.stability.case import Float64Array, Measured, finite, lit
from benchmarks.stability.rays import AWAY, mitsuba_visible
from tests import oracles as o
from tests.builders.shapes import all_pixels, box, camera, placed, quad, seen_ground
from warpir.scene.asset import Primitive
from warpir.scene.camera import Camera

SHADOW_SPP = 4096


def from_above(width: int, height: int, metres: float, size: float, away: float) -> Camera:
    """A camera 50 sizes above the scene; ``metres`` a pixel at size 1."""
    eye = AWAY * away + np.array([0.0, 50.0 * size, 0.0])
    return camera(width, height, 50.0 / metres, eye, -90.0)


def foot(view: Camera, side: int) -> Float64Array:
    """The plane's x and z at ``side x side`` points of each pixel, size 1, [pixel, side^2, 2]."""
    at_one = from_above(view.width, view.height, 50.0 / view.fx, 1.0, 0.0)
    return seen_ground(at_one, side)[..., [0, 2]]


def ratio_of(
    part: Primitive, view: Camera, height: float, device: str
) -> tuple[Float64Array, bool]:
    """Shadow ratio of the plane under a constant sky in every pixel, whatever stands before it.

    Returns:
        The ratio, shape [pixel], and whether it and both radiances are finite.
    """
    renderer, args = lit(device, [placed(part)], view, height=height)
    pixels = all_pixels(view)
    radiance = renderer.receiver(args, pixels, np.zeros(len(pixels), np.int32), SHADOW_SPP, 1, 0)
    ratio = renderer.ratio(radiance)[:, 0].astype(np.float64)
    return ratio, finite(ratio, radiance.lit, radiance.unoccluded)


def roof(size: float, away: float) -> Primitive:
    """A square of 3 sizes, one size above the plane."""
    return quad(
        AWAY * away + np.array([0.0, size, 0.0]),
        (1.5 * size, 0.0, 0.0),
        (0.0, 0.0, -1.5 * size),
    )


def square_shadow(device: str, size: float, away: float) -> Measured:
    """Shadow ratio below and beside a square in a constant sky, RMS against its form factor."""
    view = from_above(8, 5, 0.6, size, away)
    height = float((AWAY * away)[1])
    ratio, is_finite = ratio_of(roof(size, away), view, height, device)
    points = foot(view, 8)
    truth = o.rectangle_ratio(points[..., 0], points[..., 1], 1.0, 1.5).mean(axis=1)
    return Measured(rms(ratio - truth), is_finite)


def wall_factor(c: Float64Array, low: Float64Array, high: Float64Array, h: float) -> Float64Array:
    """Configuration factor of a plane's point to a wall at distance ``c`` that stands on it.

    The wall is ``h`` high and reaches from ``low`` to ``high`` along itself (Howell, B-4).
    """

    def corner(b: Float64Array) -> Float64Array:
        far = np.hypot(c, h)
        return (np.arctan(b / c) - c / far * np.arctan(b / far)) / (2.0 * np.pi)

    return np.asarray(corner(high) - corner(low))


def box_ratio(points: Float64Array, gap: float) -> Float64Array:
    """Shadow ratio of a unit box whose bottom is ``gap`` above the plane, or below it."""
    x, z = np.abs(points[..., 0]), np.abs(points[..., 1])
    blocked = np.zeros(x.shape)
    for along, across in ((x, z), (z, x)):
        c = along - 0.5
        beside = c > 0.0
        c = np.where(beside, c, 1.0)
        wall = wall_factor(c, -0.5 - across, 0.5 - across, 1.0 + gap)
        if gap > 0.0:
            wall -= wall_factor(c, -0.5 - across, 0.5 - across, gap)
        blocked += np.where(beside, wall, 0.0)
    if gap > 0.0:
        return np.asarray(o.rectangle_ratio(points[..., 0], points[..., 1], gap, 0.5) - blocked)
    return np.where((x < 0.5) & (z < 0.5), 0.0, 1.0 - blocked)


def cube(gap: float, size: float) -> Primitive:
    """A cube whose bottom is ``gap`` of its size above the plane, or below it."""
    return box((0.0, (0.5 + gap) * size, 0.0), (size, size, size))


def contact(device: str, gap: float, size: float) -> Measured:
    """Shadow ratio round a unit box on, just above or sunk into the plane, RMS."""
    view = from_above(12, 12, 0.2, size, 0.0)
    ratio, is_finite = ratio_of(cube(gap, size), view, 0.0, device)
    truth = box_ratio(foot(view, 16), gap).mean(axis=1)
    return Measured(rms(ratio - truth), is_finite)


def contact_leak(device: str, gap: float, size: float) -> Measured:
    """The most light that gets below a box which touches the plane."""
    view = from_above(12, 12, 0.2, size, 0.0)
    ratio, is_finite = ratio_of(cube(gap, size), view, 0.0, device)
    under = np.abs(foot(view, 1)[:, 0]).max(axis=1) < 0.4
    assert under.sum() > 10
    return Measured(float(ratio[under].max()), is_finite)


def mitsuba_ratio(
    part: Primitive, points: Float64Array, height: float, size: float, away: float
) -> Float64Array:
    """Return the shadow ratio of a constant sky at points, 4096 cosine directions each."""
    index = np.arange(SHADOW_SPP)[None]
    shift = np.random.default_rng(16).random((2, len(points), 1))
    # The R2 sequence (Roberts 2018), shifted at each point.
    u = np.mod(shift[0] + 0.7548776662466927 * index, 1.0).ravel()
    phi = 2.0 * np.pi * np.mod(shift[1] + 0.5698402909980532 * index, 1.0).ravel()
    radius = np.sqrt(u)
    d = np.stack([radius * np.cos(phi), np.sqrt(1.0 - u), radius * np.sin(phi)], axis=-1)
    repeated = np.repeat(points, SHADOW_SPP, axis=0)
    visible = mitsuba_visible(part, repeated, d, height, size, away)
    return np.asarray(visible.reshape(len(points), SHADOW_SPP).mean(axis=1))


def mitsuba_square(size: float, away: float) -> float:
    """RMS error of the square's shadow at the pixels' centres."""
    points = foot(from_above(8, 5, 0.6, size, 0.0), 1)[:, 0]
    ratio = mitsuba_ratio(roof(size, away), points, float((AWAY * away)[1]), size, away)
    truth = o.rectangle_ratio(points[:, 0], points[:, 1], 1.0, 1.5)
    return rms(ratio - truth)


def mitsuba_contact(gap: float, size: float) -> float:
    """RMS error of the shadow round a box."""
    # Off the pixels' centres, some of which lie below the box's edges.
    points = foot(from_above(12, 12, 0.2, size, 0.0), 1)[:, 0] + 0.03
    ratio = mitsuba_ratio(cube(gap, size), points, 0.0, size, 0.0)
    return rms(ratio - box_ratio(points, gap))


def mitsuba_contact_leak(gap: float, size: float) -> float:
    """The most light that gets below a box which touches the plane."""
    points = foot(from_above(12, 12, 0.2, size, 0.0), 1)[:, 0]
    under = points[np.abs(points).max(axis=1) < 0.4]
    return float(mitsuba_ratio(cube(gap, size), under, 0.0, size, 0.0).max())
