"""Our renderer in the referee's terms: means with the variance that independent seeds show."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.scenes import on_the_ground
from tests.builders.shapes import all_pixels
from warpir.core.arrays import AnyFloatArray, Float64Array
from warpir.mitsuba.render import Setting
from warpir.render.device_light import light_args
from warpir.render.renderer import Renderer
from warpir.scene.camera import Camera
from warpir.scene.light import Light

SEED_COUNT = 32
"""Independent runs behind each variance; quasi-random samples of one run are not independent."""


class Runs(NamedTuple):
    """Mean and its variance over runs, shape [H, W, 3] each."""

    mean: Float64Array
    variance: Float64Array


class Estimate(NamedTuple):
    """A picture of the object or of the shadow ratio; the fields of the referee's."""

    mean: Float64Array
    """Radiance, relative [W/(m^2 sr)], or ratio, 1 where the plane is not seen; [H, W, 3]."""
    variance: Float64Array
    """Variance of ``mean``, shape [H, W, 3]."""
    coverage: Float64Array
    """Share of samples that see the object, or 1 where the plane is seen; shape [H, W]."""


def over_seeds(view: Camera, picture: Callable[[int], AnyFloatArray]) -> Runs:
    """Return the moments of independent pictures, given by seed in float, row-major [pixel, 3]."""
    stack = np.stack([np.asarray(picture(seed), np.float64) for seed in range(SEED_COUNT)])
    stack = stack.reshape(SEED_COUNT, view.height, view.width, 3)
    return Runs(stack.mean(axis=0), stack.var(axis=0, ddof=1) / SEED_COUNT)


def renderer(setting: Setting, device: str = "cpu", bounce_depth: int = 0) -> Renderer:
    """Set an object over the plane ``y = 0``, which it lights with a ``bounce_depth``."""
    return on_the_ground(*setting[:3], device, bounce_depth=bounce_depth)


def foreground(setting: Setting, depth: int, spp: int, seed: int, device: str = "cpu") -> Estimate:
    """Render the object alone; arguments are those of `warpir.mitsuba.render.foreground`."""
    render, camera = renderer(setting, device), setting.camera
    light = light_args(Light(texels=setting.texels), render.device)
    pixels, each = render.candidate_pixels(camera), max(1, spp // SEED_COUNT)
    cover = np.zeros(camera.height * camera.width)

    def picture(k: int) -> Float64Array:
        out = render.foreground(light, pixels, each, 1, depth, SEED_COUNT * seed + k)
        cover[pixels] += out.mask
        image = np.zeros((camera.height * camera.width, 3))
        image[pixels] = out.radiance
        return image

    runs = over_seeds(camera, picture)
    return Estimate(*runs, cover.reshape(camera.height, camera.width) / SEED_COUNT)


def shadow_ratio(
    setting: Setting, spp: int, seed: int, device: str = "cpu", bounce_depth: int = 0
) -> Estimate:
    """Render the shadow ratio; each run is long, since the quotient is biased by 1 / samples.

    The means of all runs are divided; the variance is that of the quotient, linearised.
    """
    render, camera = renderer(setting, device, bounce_depth), setting.camera
    light = light_args(Light(texels=setting.texels), render.device)
    pixels = all_pixels(camera)
    may_see, each = np.ones(len(pixels), np.int32), max(1, spp // SEED_COUNT)
    runs = [
        render.receiver(light, pixels, may_see, each, 1, SEED_COUNT * seed + k)
        for k in range(SEED_COUNT)
    ]
    lit = np.stack([run.lit.astype(np.float64) for run in runs])
    unoccluded = np.stack([run.unoccluded.astype(np.float64) for run in runs])
    a, u = lit.mean(axis=0), unoccluded.mean(axis=0)
    seen = u > 0.0
    ratio = np.where(seen, a / np.where(seen, u, 1.0), 1.0)
    residual = (lit - ratio * unoccluded) / np.where(seen, u, 1.0)
    variance = np.where(seen, residual.var(axis=0, ddof=1) / SEED_COUNT, 0.0)
    shape = (camera.height, camera.width)
    coverage = seen.any(axis=-1).astype(float).reshape(shape)
    return Estimate(ratio.reshape(*shape, 3), variance.reshape(*shape, 3), coverage)
