"""Our renderer in the referee's terms: means with the variance that independent seeds show."""

from typing import NamedTuple

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.mitsuba.render import Setting
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.renderer import Renderer
from warpir.scene.light import Light

SEED_COUNT = 32
"""Independent runs behind each variance; quasi-random samples of one run are not independent."""


class Estimate(NamedTuple):
    """A picture of the object or of the shadow ratio; the fields of the referee's."""

    mean: Float64Array
    """Radiance, relative [W/(m^2 sr)], or ratio, 1 where the plane is not seen; [H, W, 3]."""
    variance: Float64Array
    """Variance of ``mean``, shape [H, W, 3]."""
    coverage: Float64Array
    """Share of samples that see the object, or 1 where the plane is seen; shape [H, W]."""


def renderer(setting: Setting, device: str = "cpu", bounce_depth: int = 0) -> Renderer:
    """Set an object over the plane ``y = 0``, which it lights with a ``bounce_depth``."""
    proxy = Receiver(np.array([0.0, 1.0, 0.0]), 0.0)
    scene = Scene([Placed(setting.asset, setting.matrix)], setting.camera, proxy, device)
    return Renderer(scene, bounce_depth=bounce_depth)


def _moments(runs: list[Float64Array]) -> tuple[Float64Array, Float64Array]:
    stack = np.stack(runs)
    return stack.mean(axis=0), stack.var(axis=0, ddof=1) / len(runs)


def foreground(setting: Setting, depth: int, spp: int, seed: int, device: str = "cpu") -> Estimate:
    """Render the object alone; arguments are those of `warpir.mitsuba.render.foreground`."""
    render, camera = renderer(setting, device), setting.camera
    light = light_args(Light(texels=setting.texels), render.device)
    pixels = render.candidate_pixels(camera)
    shape = (camera.height * camera.width,)
    runs, covers = [], []
    for k in range(SEED_COUNT):
        out = render.foreground(
            light, pixels, max(1, spp // SEED_COUNT), 1, depth, SEED_COUNT * seed + k
        )
        image = np.zeros((*shape, 3))
        image[pixels] = out.radiance
        cover = np.zeros(shape)
        cover[pixels] = out.mask
        runs.append(image.reshape(camera.height, camera.width, 3))
        covers.append(cover.reshape(camera.height, camera.width))
    return Estimate(*_moments(runs), np.mean(covers, axis=0))


def shadow_ratio(
    setting: Setting, spp: int, seed: int, device: str = "cpu", bounce_depth: int = 0
) -> Estimate:
    """Render the shadow ratio; each run is long, since the quotient is biased by 1 / samples."""
    render, camera = renderer(setting, device, bounce_depth), setting.camera
    light = light_args(Light(texels=setting.texels), render.device)
    pixels = np.arange(camera.height * camera.width, dtype=np.int32)
    may_see = np.ones(len(pixels), np.int32)
    lit, unoccluded = [], []
    for k in range(SEED_COUNT):
        out = render.receiver(
            light, pixels, may_see, max(1, spp // SEED_COUNT), 1, SEED_COUNT * seed + k
        )
        lit.append(out.lit.astype(np.float64))
        unoccluded.append(out.unoccluded.astype(np.float64))
    return quotient(np.stack(lit), np.stack(unoccluded), (camera.height, camera.width))


def quotient(lit: Float64Array, unoccluded: Float64Array, size: tuple[int, int]) -> Estimate:
    """Divide the means of several runs, shape [run, pixel, 3]; variance by linearisation."""
    a, u = lit.mean(axis=0), unoccluded.mean(axis=0)
    seen = u > 0.0
    ratio = np.where(seen, a / np.where(seen, u, 1.0), 1.0)
    residual = (lit - ratio * unoccluded) / np.where(seen, u, 1.0)
    variance = np.where(seen, residual.var(axis=0, ddof=1) / len(lit), 0.0)
    return Estimate(
        ratio.reshape(*size, 3),
        variance.reshape(*size, 3),
        seen.any(-1).astype(float).reshape(size),
    )
