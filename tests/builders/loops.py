"""A frame of a few hundred pixels and a loop over it, with a gradient whose end is known."""

import gc
import resource
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tests import oracles as o
from tests.builders.shapes import camera, ground, placed, sphere
from warpir.app.settings import OptimizeSettings
from warpir.lighting.sg_light import LightBounds, SGLight, narrowest
from warpir.optimize.light import LightOptimization, Unknowns
from warpir.optimize.loop import Guide
from warpir.optimize.view import Frame
from warpir.render.device_scene import Scene
from warpir.render.renderer import Renderer
from warpir.render.transport.rows import TransportSettings
from warpir.scene.asset import Material
from warpir.scene.light import Lobes

STATM = Path("/proc/self/statm")
"""Where Linux tells a process its memory."""
WIDTH, HEIGHT, ROWS = 36, 24, 12
"""Of the picture [px] and of the maps."""


RATES = {"intensity": 0.06, "chroma": 0.01, "axis": 0.03, "width": 0.04, "tone": 0.02}


SETTINGS = OptimizeSettings(
    steps=12,
    lobes=3,
    light_height=ROWS,
    object_light_height=ROWS,
    score_every=0,
    mis_samples=4,
    rate_intensity=RATES["intensity"],
    rate_chroma=RATES["chroma"],
    rate_axis=RATES["axis"],
    rate_width=RATES["width"],
    rate_tone=RATES["tone"],
)


TRACED = TransportSettings(
    height_fg=ROWS,
    height_shadow=ROWS,
    subsamples=8,
    paths=16,
    bright_directions=256,
    dtype="float32",
)


def a_frame(device: str, threads: int = 0) -> Frame:
    """A ball on the ground before noise."""
    view = camera(WIDTH, HEIGHT, 1.4 * WIDTH, (0.0, 1.2, 0.0), pitch=-12.0)
    material = Material(base_color=(0.7, 0.5, 0.4), roughness=0.4)
    ball = placed(sphere((0.0, 0.5, -3.5), 0.5, detail=3), material)
    photo = np.random.default_rng(5).uniform(0.2, 0.6, (HEIGHT, WIDTH, 3)).astype(np.float32)
    renderer = Renderer(Scene([ball], view, ground(0.0), device), threads=threads)
    return Frame(renderer, photo, True, 2, seed=3)


def bent(count: int = 3) -> Unknowns:
    """Two lights of different, coloured lobes and bent curves: no gradient is 0 by symmetry."""
    rng, bounds = np.random.default_rng(8), LightBounds(narrowest(ROWS))

    def light() -> SGLight:
        axis = o.normalize(rng.normal(size=(count, 3)) + np.array([0.0, 1.0, 0.0]))
        amplitude = np.exp(rng.uniform(-1, 1, (count, 1)) + rng.uniform(-0.3, 0.3, (count, 3)))
        sigma = rng.uniform(1.05 * bounds.sigma_min, 1.0, count)
        parts = (a.astype(np.float32) for a in (amplitude, axis, sigma**-2.0))
        return SGLight(Lobes(*parts), 1.0, bounds)

    unknowns = Unknowns(light(), light())
    with torch.no_grad():
        for curve in (unknowns.curve_fg, unknowns.curve_shadow):
            for parameter in curve.parameters():
                parameter.copy_(torch.from_numpy(rng.normal(0.0, 0.4, parameter.shape)))
    return unknowns


class Pull:
    """A fixed gradient of the image, and no score."""

    def __init__(self, d_image: Tensor | None = None) -> None:
        rng = np.random.default_rng(1)
        y = torch.from_numpy(rng.normal(size=(1, 3, HEIGHT, WIDTH))).float()
        self.d_image = y if d_image is None else d_image
        self.steps: list[int] = []

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        assert not image.requires_grad and image.shape == (1, 3, HEIGHT, WIDTH)
        self.steps.append(step)
        return self.d_image.to(image.device)

    def score(self, image: Tensor) -> float | None:
        return None

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        pass


def a_loop(
    device: str,
    guide: Guide | None = None,
    settings: OptimizeSettings = SETTINGS,
    unknowns: Unknowns | None = None,
    threads: int = 0,
) -> LightOptimization:
    rows = TRACED if settings.integrator == "transport" else None
    return LightOptimization(
        a_frame(device, threads),
        guide or Pull(),
        settings,
        unknowns or Unknowns.start(None, 0.5, settings),
        transport=rows,
    )


def values(loop: LightOptimization) -> dict[str, Tensor]:
    """A copy of the parameters."""
    return {name: value.clone() for name, value in loop.unknowns.state_dict().items()}


def growth(device: str, settings: OptimizeSettings) -> tuple[int, int, int]:
    """Run a loop in a process of its own, where no test before it left holes in the heap to fill.

    Returns:
        Steps, and growth after the first 20 of resident memory and of torch's on the card [byte].
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_growth, device, settings).result()


def _growth(device: str, settings: OptimizeSettings) -> tuple[int, int, int]:
    def held() -> tuple[int, int]:
        gc.collect()
        on_device = torch.cuda.memory_allocated() if device != "cpu" else 0
        return int(STATM.read_text().split()[1]) * resource.getpagesize(), on_device

    loop = a_loop(device, settings=settings)
    for _ in range(20):
        loop.step()
    before = held()
    loop.run()
    host, on_device = (after - first for after, first in zip(held(), before, strict=True))
    return loop.state.step, host, on_device
