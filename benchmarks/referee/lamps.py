"""Do lamps near the object light it, and the ground, as Mitsuba's own emitters do?

    python -m benchmarks.referee.lamps --spp 4096

Mitsuba's lamps are surfaces and block light, ours do not: they stand where that changes nothing,
outside the object's convex hull where paths have more than one interaction. Light from afar is a
render of its own in Mitsuba, and is added. Mitsuba's own ``path`` traces all of it.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks.referee.ours import SEED_COUNT, Runs, over_seeds
from benchmarks.referee.sheet import compare_runs, print_lines
from benchmarks.referee.subjects import ball, from_above, sun_and_sky
from benchmarks.scenes import on_the_ground
from tests.builders.shapes import all_pixels, quad
from warpir.core.arrays import Float64Array, FloatArray
from warpir.mitsuba.render import ObjectScene, build, mean_and_variance, sums
from warpir.render.device_light import light_args
from warpir.render.renderer import Renderer
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import Camera
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp, RectangleLamp, SphereLamp

GROUND = (0.0, 1.0, 0.0, 0.0)
DARK = np.zeros((8, 16, 3), np.float32)
HORIZON = 150.0
"""Where Mitsuba's ground ends, in radii of the object: further than the pictures show."""
POWER = np.array([60.0, 45.0, 30.0])
Traced = tuple[mi.Color3f, mi.Bool]
"""Radiance of a pass's samples, and which of them count."""
GLOSS = Material(base_color=(0.7, 0.4, 0.2), metallic=0.3, roughness=0.35)
PAPER = Material(base_color=(0.8, 0.8, 0.7), metallic=0.0, roughness=0.8, double_sided=True)


def pair() -> Asset:
    """Return a glossy ball before an upright card."""
    small = ball()
    round_one = Primitive(0.4 * small.positions + [0.0, 0.41, 0.0], small.indices, 0, small.normals)
    upright = quad((0, 0.51, -0.6), (0.8, 0, 0), (0, 0.5, 0), 1)
    return Asset("pair", (round_one, upright), (GLOSS, PAPER))


def shade() -> Asset:
    """Return four walls around a lamp, open above and just off the ground."""
    walls = (
        quad((0, 0.45, 0.4), (0.4, 0, 0), (0, 0.35, 0), 1),
        quad((0.4, 0.45, 0), (0, 0, -0.4), (0, 0.35, 0), 1),
        quad((0, 0.45, -0.4), (-0.4, 0, 0), (0, 0.35, 0), 1),
        quad((-0.4, 0.45, 0), (0, 0, 0.4), (0, 0.35, 0), 1),
    )
    return Asset("shade", walls, (GLOSS, PAPER))


@dataclass(frozen=True)
class Case:
    """An object among lamps."""

    asset: Asset
    lamps: tuple[Lamp, ...]
    depths: tuple[int, ...] = (1, 4)
    """Of the object."""
    texels: FloatArray | None = None
    """Light from afar."""
    is_cut: bool = False
    """Whether a lamp is partly below the ground."""
    ground_depths: tuple[int, ...] = (1, 2)
    """Of the ground, itself included; 1 where Mitsuba's lamp hides it from the object."""


def cases() -> dict[str, Case]:
    """Return what is compared, by name."""
    beside = SphereLamp(np.array([-1.1, 1.3, 0.9]), 0.2, POWER)
    touching = SphereLamp(np.array([-0.65, 0.31, 0.55]), 0.3, POWER)
    edges = np.array([0.0, 0.0, 0.7]), np.array([-0.4, 0.5, 0.0])
    flat = RectangleLamp(np.array([1.2, 1.5, 0.8]), *edges, POWER)
    sunk = SphereLamp(np.array([-0.9, 0.0, 0.6]), 0.25, POWER)
    within = SphereLamp(np.array([0.05, 0.4, 0.0]), 0.1, POWER)
    sky = sun_and_sky(np.random.default_rng(5), 16) / 8.0
    return {
        "sphere": Case(pair(), (beside,)),
        "rectangle": Case(pair(), (flat,)),
        "both_and_sky": Case(pair(), (beside, flat), texels=sky.astype(np.float32)),
        "close": Case(pair(), (touching,), (1,), ground_depths=(1,)),
        "on_the_ground": Case(pair(), (sunk,), (1,), is_cut=True, ground_depths=(1,)),
        "in_the_object": Case(shade(), (within,), (1,), ground_depths=(1,)),
    }


def paths_of(
    made: ObjectScene, integrator: mi.Integrator, scene: mi.Scene | None = None
) -> Callable[[int, int], Traced]:
    """Return what traces a pass through a scene, or one like it, by an integrator of Mitsuba's."""

    def trace(seed: int, spp: int) -> Traced:
        sampler, _ = made.integrator.prepare(made.sensor, seed, spp)
        ray, _, _ = made.integrator.sample_rays(made.scene, made.sensor, sampler)
        L, seen, *_ = integrator.sample(scene or made.scene, sampler, ray)
        return L, seen

    return trace


def traced(
    view: Camera, spp: int, parts: Iterable[tuple[float, int, Callable[[int, int], Traced]]]
) -> Runs:
    """Return the sum of several scenes' pictures, each with its sign, seed and paths."""
    mean, variance = np.zeros((2, view.height, view.width, 3))
    for sign, seed, trace in parts:
        moments, _ = sums(view, spp, seed, trace)
        own = mean_and_variance(moments, spp)
        mean, variance = mean + sign * own[0], variance + own[1]
    return Runs(mean, variance)


def theirs(case: Case, view: Camera, depth: int, spp: int, is_ground: bool) -> Runs:
    """Render by Mitsuba's path tracer: the object over black ground, or white ground beside it."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth + 1, "hide_emitters": True})
    lights: list[tuple[FloatArray, tuple[Lamp, ...]]] = [(DARK, case.lamps)]
    if case.texels is not None:
        lights.append((case.texels, ()))
    ground = GROUND if is_ground or case.is_cut else None

    def paths(texels: FloatArray, lamps: tuple[Lamp, ...]) -> Callable[[int, int], Traced]:
        lit = float(is_ground), lamps, HORIZON
        return paths_of(build(case.asset, np.eye(4), view, texels, depth, ground, *lit), integrator)

    return traced(view, spp, ((1.0, 7 + k, paths(*light)) for k, light in enumerate(lights)))


def renderer(case: Case, view: Camera, bounce_depth: int) -> Renderer:
    """Return ours, over the plane ``y = 0``."""
    given = {"lamps": case.lamps, "bounce_depth": bounce_depth}
    return on_the_ground(case.asset, np.eye(4), view, **given)


def ours(case: Case, view: Camera, depth: int, spp: int, is_ground: bool) -> Runs:
    """Render the same; the ground by paths of ``depth`` interactions, that with it included."""
    r = renderer(case, view, depth - 1 if is_ground else 0)
    light = light_args(Light(texels=DARK if case.texels is None else case.texels), r.device)
    pixels = all_pixels(view)
    may_see, each = np.ones_like(pixels), spp // SEED_COUNT

    def picture(seed: int) -> FloatArray:
        if is_ground:
            return r.receiver(light, pixels, may_see, each, 1, seed).lit
        return r.foreground(light, pixels, each, 1, depth, seed).radiance

    return over_seeds(view, picture)


def clear_of(lamps: tuple[Lamp, ...], view: Camera) -> Float64Array:
    """Return False in pixels that Mitsuba's spheres may cover, shape [H, W, 1]."""
    rays = view.pixel_rays()
    clear = np.ones((view.height, view.width, 1), bool)
    for lamp in lamps:
        if isinstance(lamp, SphereLamp):
            toward = lamp.center - view.c2w[:3, 3]
            beside = np.linalg.norm(np.cross(rays, toward), axis=-1)
            pixel = np.linalg.norm(toward) / view.fx
            clear[..., 0] &= beside > lamp.radius + pixel
    return clear


def compare(case: Case, spp: int) -> Iterator[dict[str, Any]]:
    """Yield a line for object and ground at each depth."""
    view = from_above()
    pixels = all_pixels(view)
    r = renderer(case, view, 0)
    mask = r.foreground(light_args(Light(texels=DARK), r.device), pixels, 64, 1, 1, 7).mask
    covered = np.zeros(len(pixels), bool)
    covered[r.gbuffer(3, 64).object_pixels] = True
    everywhere = np.ones((view.height, view.width, 3), bool)
    open_ground = everywhere & ~(covered | (mask > 0.0)).reshape(view.height, view.width, 1)
    everywhere &= clear_of(case.lamps, view)
    open_ground &= everywhere
    for what, depths in (("object", case.depths), ("ground", case.ground_depths)):
        is_ground = what == "ground"
        for depth in depths:
            found = ours(case, view, depth, spp, is_ground)
            true = theirs(case, view, depth, spp, is_ground)
            counts = open_ground if is_ground else everywhere
            yield {"what": what, "depth": depth, **compare_runs(found, true, counts)}


if __name__ == "__main__":
    print_lines(__doc__, cases(), compare)
