"""Does a glossy ground show the object's mirror image as Mitsuba's own coat does?

    python -m benchmarks.referee.mirror --spp 4096

The ground is black under a dielectric coat. With the object less without it, Mitsuba's ``path``
shows what the image adds and what it hides. What our image leaves out by design, the coat's light
on the object, is left out there by paths of no more vertices than coat and object need: they have
one interaction with the object.
"""

import argparse
import json
from typing import Any

import mitsuba as mi
import numpy as np

from benchmarks.referee.lamps import (
    GROUND,
    HORIZON,
    SEED_COUNT,
    Runs,
    camera,
    compare,
    pair,
    paths_of,
    runs_of,
)
from benchmarks.referee.subjects import sun_and_sky
from warpir.core.arrays import FloatArray
from warpir.mitsuba.render import build, mean_and_variance, sums
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.renderer import Renderer
from warpir.scene.asset import Asset
from warpir.scene.camera import Camera
from warpir.scene.light import Light

ROUGHNESSES = (0.0, 0.1, 0.3)
"""Beyond, Mitsuba's separable shadowing of facets differs from the correlated one by percents."""


def theirs(asset: Asset, view: Camera, texels: FloatArray, roughness: float, spp: int) -> Runs:
    """Render the coat with the object and without it by Mitsuba's path tracer; the difference."""
    integrator = mi.load_dict({"type": "path", "max_depth": 3, "hide_emitters": True})
    shape = (view.height, view.width)
    mean, variance = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    for sign, is_there in ((1.0, True), (-1.0, False)):
        made = build(asset, np.eye(4), view, texels, 1, GROUND, 0.0, (), HORIZON, roughness)
        scene = made.scene if is_there else without_object(made.scene)
        moments, _ = sums(view, spp, 7 + is_there, paths_of(made, integrator, scene))
        parts = mean_and_variance(moments, spp)
        mean, variance = mean + sign * parts[0], variance + parts[1]
    return Runs(mean, variance)


def without_object(scene: mi.Scene) -> mi.Scene:
    """Return a scene of ground and light alone."""
    kept: dict[str, Any] = {"type": "scene", "light": scene.environment()}
    kept |= {s.id(): s for s in scene.shapes() if s.id() == "ground"}
    return mi.load_dict(kept)


def renderer(asset: Asset, view: Camera) -> Renderer:
    """Return ours, over the plane ``y = 0``."""
    receiver = Receiver(np.array(GROUND[:3]), 0.0)
    return Renderer(Scene([Placed(asset, np.eye(4))], view, receiver, "cpu"))


def ours(asset: Asset, view: Camera, texels: FloatArray, roughness: float, spp: int) -> Runs:
    """Render image less what it hides."""
    r = renderer(asset, view)
    light = light_args(Light(texels=texels), r.device)
    pixels = np.arange(view.width * view.height, dtype=np.int32)
    pictures = []
    for seed in range(SEED_COUNT):
        image, hidden, _ = r.mirrored(
            light, pixels, np.ones_like(pixels), roughness, spp // SEED_COUNT, 1, 1, seed
        )
        change = (image - hidden).reshape(view.height, view.width, 3)
        pictures.append(change.astype(np.float64))
    return runs_of(pictures)


def main() -> None:
    """Print one line of JSON a roughness."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spp", type=int, default=4096)
    parser.add_argument("--save", default=None, help="also write both pictures to this file (npz)")
    options = parser.parse_args()
    asset, view = pair(), camera()
    texels = (sun_and_sky(np.random.default_rng(5), 16) / 8.0).astype(np.float32)
    # Our ground hides no light from the object: what comes from below stands for the ground's own.
    texels[len(texels) // 2 - 1 :] = 0.0
    open_ground = np.ones((view.height, view.width, 3), bool)
    open_ground.reshape(-1, 3)[renderer(asset, view).gbuffer(3, 64).object_pixels] = False
    for roughness in ROUGHNESSES:
        found = ours(asset, view, texels, roughness, options.spp)
        true = theirs(asset, view, texels, roughness, options.spp)
        line = {"roughness": roughness, "spp": options.spp}
        print(json.dumps(line | compare(found, true, open_ground)), flush=True)
        if options.save is not None:
            np.savez(f"{options.save}-{roughness}.npz", ours=found.mean, theirs=true.mean)


if __name__ == "__main__":
    main()
