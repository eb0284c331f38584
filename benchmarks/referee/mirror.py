"""Does a glossy ground show the object's mirror image as Mitsuba's own coat does?

    python -m benchmarks.referee.mirror --spp 4096

The ground is black under a dielectric coat. With the object less without it, Mitsuba's ``path``
shows what the image adds and what it hides. What our image leaves out by design, the coat's light
on the object, is left out there by paths of no more vertices than coat and object need: they have
one interaction with the object.
"""

from collections.abc import Iterator
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks.referee.lamps import GROUND, HORIZON, pair, paths_of, traced
from benchmarks.referee.ours import SEED_COUNT, Runs, over_seeds
from benchmarks.referee.sheet import compare_runs, print_lines
from benchmarks.referee.subjects import from_above, sun_and_sky
from benchmarks.scenes import on_the_ground
from tests.builders.shapes import all_pixels
from warpir.core.arrays import FloatArray
from warpir.mitsuba.render import build
from warpir.render.device_light import light_args
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.light import Light

ROUGHNESSES = (0.0, 0.1, 0.3)
"""Beyond, Mitsuba's separable shadowing of facets differs from the correlated one by percents."""


def theirs(asset: Asset, view: Camera, texels: FloatArray, roughness: float, spp: int) -> Runs:
    """Render the coat with the object and without it by Mitsuba's path tracer; the difference."""
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    parts = []
    for sign, is_there in ((1.0, True), (-1.0, False)):
        made = build(asset, np.eye(4), view, texels, 1, GROUND, 0.0, (), HORIZON, roughness)
        scene = made.scene if is_there else without_object(made.scene)
        parts.append((sign, 7 + is_there, paths_of(made, integrator, scene)))
    return traced(view, spp, parts)


def without_object(scene: mi.Scene) -> mi.Scene:
    """Return a scene of ground and light alone."""
    kept: dict[str, Any] = {"type": "scene", "light": scene.environment()}
    kept |= {s.id(): s for s in scene.shapes() if s.id() == "ground"}
    return mi.load_dict(kept)


def ours(asset: Asset, view: Camera, texels: FloatArray, roughness: float, spp: int) -> Runs:
    """Render image less what it hides."""
    r = on_the_ground(asset, np.eye(4), view)
    light = light_args(Light(texels=texels), r.device)
    pixels = all_pixels(view)
    may_see, each = np.ones_like(pixels), spp // SEED_COUNT

    def picture(seed: int) -> FloatArray:
        image, hidden, _ = r.mirrored(light, pixels, may_see, roughness, each, 1, 1, seed)
        return image - hidden

    return over_seeds(view, picture)


def compare(roughness: float, spp: int) -> Iterator[dict[str, Any]]:
    """Yield the line of a roughness."""
    asset, view = pair(), from_above()
    texels = (sun_and_sky(np.random.default_rng(5), 16) / 8.0).astype(np.float32)
    # Our ground hides no light from the object: what comes from below stands for the ground's own.
    texels[len(texels) // 2 - 1 :] = 0.0
    open_ground = np.ones((view.height, view.width, 3), bool)
    gbuffer = on_the_ground(asset, np.eye(4), view).gbuffer(3, 64)
    open_ground.reshape(-1, 3)[gbuffer.object_pixels] = False
    found, true = (side(asset, view, texels, roughness, spp) for side in (ours, theirs))
    yield compare_runs(found, true, open_ground)


if __name__ == "__main__":
    print_lines(__doc__, {f"{r:g}": r for r in ROUGHNESSES}, compare)
