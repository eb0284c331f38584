"""Hard cases of lamps near the object, of a ground that mirrors and of solid glass."""

from collections.abc import Callable

import numpy as np
import warp as wp

from benchmarks.stability.case import (
    MAX_ABSOLUTE,
    MAX_RELATIVE,
    RELATIVE,
    Case,
    Float64Array,
    Measured,
    Quantity,
    finite,
    launch,
    lit,
    max_relative,
    relative_l2,
    table,
    upload,
)
from benchmarks.stability.shadows import foot, from_above
from tests import oracles as o
from tests.builders.shapes import all_pixels, box, camera, constant, placed, quad, sphere
from warpir.kernels.receiver import mirrored_ray
from warpir.render.near.places import place_slopes
from warpir.scene.asset import Material, Primitive
from warpir.scene.near.lamps import RectangleLamp, SphereLamp

LAMPS, COAT, GLASS = "Lamps near the object", "Glossy ground", "Solid glass"
REFEREE = "see docs/referee.md"
BELOW = {
    "0.1 mm wide, 1 m up": (5e-5, 1.0),
    "touches the ground": (0.3, 0.3),
    "10 m wide, 10 km up": (5.0, 1e4),
}
"""Radius and height of a sphere [m]."""
PANELS = {"0.1 mm above the ground": (1e-4,), "1 km above": (1e3,)}
"""Height of a square of 1 m that faces the ground [m]."""
GRAZING = {"along the normal": (1.0,), "cosine 1e-2": (1e-2,), "cosine 1e-6": (1e-6,)}
ROUGH = {"roughness 0.032, cosine 0.1": (0.032, 0.1), "roughness 1, cosine 0.1": (1.0, 0.1)}
BODIES: dict[str, tuple[Primitive, float]] = {
    "ball, index 2.4": (sphere((0.0, 0.0, -4.0), 1.0, 4), 2.4),
    "ball, index 1.0001": (sphere((0.0, 0.0, -4.0), 1.0, 4), 1.0001),
    "open sheet": (quad((0.0, 0.0, -4.0), (1.0, 0.0, 0.3), (0.0, 1.0, 0.4)), 1.5),
}
"""Closed and open bodies that light always leaves, and their index of refraction."""
TRAPS = {"box, index 1.5": (box((0.2, 0.1, -4.0), (1.0, 1.0, 1.0)), 1.5)}
"""Those in which total reflection keeps a little."""
SPP, DRAWS = 4096, 1 << 16
DARK = constant((0.0, 0.0, 0.0))
POWER = np.array([1.0, 2.0, 3.0])

NOISE = 3e-3
"""Of 4096 samples in each of 40 pixels."""
SLOPE = 2e-2
"""Asked of derivatives to a lamp's place, of 4096 pairs of directions in each of 40 pixels."""
MIRROR = 2e-5
"""Some sixty roundings of 2^-24, those of a square root near 0 among them."""
KEPT = 3e-3
"""Share of paths that 64 surfaces do not let out."""
ALBEDO = 5e-3
"""Of 65536 draws, and of the midpoint rule."""


@wp.kernel(enable_backward=False)
def coat_kernel(
    wo: wp.vec3, alpha: float, u: wp.array[wp.vec2], weight: wp.array[float], wi: wp.array[wp.vec3]
):
    """Draw what a coat whose normal is +Y reflects toward ``wo``."""
    i = wp.tid()
    ray = mirrored_ray(wp.vec3(0.0, 1.0, 0.0), wo, alpha, u[i])
    weight[i] = ray.weight
    wi[i] = ray.direction


def below(
    device: str, lamp: SphereLamp | RectangleLamp, factor: Callable[[Float64Array], Float64Array]
) -> Measured:
    """Radiance of a white ground by one lamp and its derivatives to the lamp's place.

    The object is out of its way. ``factor`` gives the form factor at 8 x 8 points of each pixel by
    the vectors from there to the lamp, shape [pixel, 64, 3].
    """
    view = from_above(8, 5, 0.1, 1.0, 0.0)
    thing = placed(box((-400.0, 0.5, 0.0), (1.0, 1.0, 1.0)))
    r, dark = lit(device, [thing], view, DARK, height=0.0, lamps=[lamp])
    pixels = all_pixels(view)
    open_ground = np.zeros(len(pixels), np.int32)
    found = r.receiver(dark, pixels, open_ground, SPP, 1, 0).lit
    slopes = place_slopes(r, pixels[:0], pixels, open_ground, SPP, 1, 0)[2]
    x, z = np.moveaxis(foot(view, 8), -1, 0)
    toward = lamp.center - np.stack([x, 0.0 * x, z], axis=-1)
    step = 1e-4 * lamp.center[1] * np.eye(3)
    change = np.array([factor(toward + h) - factor(toward - h) for h in step]).mean(axis=-1)
    slope = change[..., None] * lamp.radiance / (2.0 * step.max())
    whole = factor(toward).mean(axis=1)[:, None] * lamp.radiance
    is_finite = finite(found, slopes)
    return Measured(relative_l2(found, whole), is_finite, relative_l2(slopes, slope))


def below_sphere(device: str, radius: float, height: float) -> Measured:
    """Ground below a sphere, against its form factor ``r^2 h / d^3`` (Howell, B-33)."""
    lamp = SphereLamp(np.array([0.0, height, 0.0]), radius, POWER)
    return below(device, lamp, lambda v: radius**2 * v[..., 1] / np.linalg.norm(v, axis=-1) ** 3)


def below_panel(device: str, height: float) -> Measured:
    """Ground below a square, against the form factor of a parallel rectangle."""
    edge = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    lamp = RectangleLamp(np.array([0.0, height, 0.0]), *edge, POWER)
    return below(
        device, lamp, lambda v: 1.0 - o.rectangle_ratio(v[..., 0], v[..., 2], v[..., 1], 0.5)
    )


def leak(device: str) -> Measured:
    """The most light that leaves a closed box in which a lamp hangs, over the lamp's own."""
    view = from_above(12, 12, 0.4, 1.0, 0.0)
    lamp = SphereLamp(np.array([0.0, 0.5, 0.0]), 0.3, POWER)
    closed = placed(box((0.0, 0.5, 0.0), (1.0, 1.0, 1.0)))
    r, dark = lit(device, [closed], view, DARK, height=0.0, lamps=[lamp])
    pixels = all_pixels(view)
    seen = r.receiver(dark, pixels, np.ones(len(pixels), np.int32), SPP, 1, 0)
    outside = np.abs(foot(view, 1)[:, 0]).max(axis=1) > 0.75
    assert outside.sum() > 50 and seen.unoccluded[outside].min() > 0.0
    share = seen.lit[outside] / seen.unoccluded[outside]
    return Measured(float(share.max()), finite(seen.lit, seen.unoccluded))


def toward(cos_o: float) -> Float64Array:
    """Return a unit vector at that cosine to +Y, of float32 components."""
    x, y = np.float32(np.sqrt(1.0 - cos_o**2)), np.float32(cos_o)
    return np.array([x, y, 0.0], np.float64)


def mirror(device: str, cos_o: float) -> Measured:
    """Weight of a smooth coat, against Fresnel's equations."""
    wo = toward(cos_o)
    weight, wi = coat(device, wo, 0.0, 1)
    sin_t = wo[0] / 1.5
    cos_t = np.sqrt((1.0 - sin_t) * (1.0 + sin_t))
    across = (wo[1] - 1.5 * cos_t) / (wo[1] + 1.5 * cos_t)
    along = (1.5 * wo[1] - cos_t) / (1.5 * wo[1] + cos_t)
    return Measured(max_relative(weight, 0.5 * (across**2 + along**2)), finite(weight, wi))


def mirror_direction(device: str, cos_o: float) -> Measured:
    """Direction that a smooth coat reflects."""
    wo = toward(cos_o)
    _, wi = coat(device, wo, 0.0, 1)
    return Measured(float(np.abs(wi[0] - wo * [-1.0, 1.0, -1.0]).max()), finite(wi))


def albedo(device: str, roughness: float, cos_o: float) -> Measured:
    """Mean weight of a rough coat, against quadrature."""
    weight, wi = coat(device, toward(cos_o), roughness**2, DRAWS)
    truth = o.reflected_share(cos_o, roughness**2, o.fresnel)
    return Measured(abs(float(weight.mean()) / truth - 1.0), finite(weight, wi))


def coat(device: str, wo: Float64Array, alpha: float, count: int) -> list[Float64Array]:
    """Return weights and directions of draws at the points of the R2 sequence (Roberts 2018)."""
    k = np.arange(count)[:, None] + 0.5
    u = np.mod(k * [0.7548776662466927, 0.5698402909980532], 1.0)
    inputs = [wp.vec3(*wo), alpha, upload(u, wp.vec2, device)]
    return launch(coat_kernel, count, inputs, float, wp.vec3, device=device)


def furnace(device: str, body: Primitive, ior: float) -> Measured:
    """The most that lossless glass takes from even light, over the light; 64 surfaces a path."""
    glass = Material(metallic=0.0, roughness=0.0, transmission=1.0, thickness=1.0, ior=ior)
    view = camera(24, 16, 24.0)
    r, args = lit(device, [placed(body, glass)], view)
    out = r.foreground(args, all_pixels(view), 64, 1, 64, 1)
    assert out.mask.sum() > 20
    missing = np.abs(1.0 - out.radiance.sum() / (3.0 * out.mask.sum(dtype=np.float64)))
    return Measured(float(missing), finite(out.radiance) and bool((out.radiance >= 0.0).all()))


def cases() -> list[Case]:
    """Return the cases of this module."""
    sphere_lit, panel_lit = (
        Quantity("ground below", RELATIVE, run, NOISE, REFEREE, SLOPE)
        for run in (below_sphere, below_panel)
    )
    outside = Quantity("light outside", "max share", leak, 0.0, REFEREE)
    weight = Quantity("mirror", MAX_RELATIVE, mirror, MIRROR, REFEREE)
    direction = Quantity("direction", MAX_ABSOLUTE, mirror_direction, MIRROR, REFEREE)
    kept = Quantity("furnace", RELATIVE, furnace, MIRROR, REFEREE)
    return [
        *table(LAMPS, BELOW, sphere_lit),
        *table(LAMPS, PANELS, panel_lit),
        *table(LAMPS, {"lamp in a closed box": ()}, outside),
        *table(COAT, GRAZING, weight, direction),
        *table(COAT, ROUGH, Quantity("albedo", RELATIVE, albedo, ALBEDO, REFEREE)),
        *table(GLASS, BODIES, kept),
        *table(GLASS, TRAPS, kept._replace(bound=KEPT)),
    ]
