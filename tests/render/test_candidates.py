"""Picked directions of the light: their control variate has no bias and takes the noise."""

import numpy as np
import pytest

from tests.builders.shapes import box, camera, ground, placed, sphere
from tests.statistics import z_test
from warpir.core.arrays import Float64Array
from warpir.render import launches
from warpir.render import renderer as render
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Scene
from warpir.render.renderer import Renderer
from warpir.scene.asset import Material
from warpir.scene.light import Light, Lobes

WIDTH, HEIGHT, TILE = 32, 24, 4
SEEDS = 400


def light_of(peaks: list[list[float]], axes: list[list[float]], sharpness: list[float]) -> Light:
    """Suns, and a blue sky behind them."""
    axis = np.array([*axes, [0.0, 1.0, 0.0]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    values = np.array([*peaks, [0.3, 0.4, 0.6]]), axis, np.array([*sharpness, 1.0])
    return Light(lobes=Lobes(*(a.astype(np.float32) for a in values)))


def a_sun() -> Light:
    """One warm sun."""
    return light_of([[200.0, 160.0, 100.0]], [[5.0, 7.0, 5.0]], [800.0])


def colored_suns() -> Light:
    """A warm, a red, a green and a blue sun of like strength: a pick changes the colour."""
    peaks = [[90.0, 70.0, 50.0], [20.0, 0.0, 0.0], [0.0, 20.0, 0.0], [0.0, 0.0, 20.0]]
    axes = [[5.0, 7.0, 5.0], [-8.0, 3.0, 4.0], [1.0, 4.0, 9.0], [6.0, 2.0, 6.0]]
    return light_of(peaks, axes, [400.0, 100.0, 100.0, 100.0])


def a_ball() -> Placed:
    """A ball in the middle of the picture."""
    return placed(sphere((0.0, 0.0, -3.0), 0.5, 3), Material(metallic=0.0))


def a_crowd() -> Placed:
    """A ball in the shadow of a box, and a metal ball beside them."""
    parts = (
        sphere((0.0, 0.0, -3.0), 0.4, 3),
        box((0.3, 0.3, -2.4), (0.3, 0.3, 0.3)),
        sphere((-0.6, 0.1, -3.2), 0.3, 3, material=1),
    )
    return placed(
        parts, Material(metallic=0.0, roughness=0.6), Material(metallic=1.0, roughness=0.4)
    )


def runs(
    device: str, thing: Placed, sky: Light, seeds: int, spp: int = 4, depth: int = 2
) -> tuple[Float64Array, Float64Array]:
    """Return the radiance and its diffuse part, shape [seed, pixel, 3], of all of a picture."""
    view = camera(WIDTH, HEIGHT, 60.0)
    renderer = Renderer(Scene([thing], view, ground(), device))
    light = light_args(sky, renderer.device)
    pixels = np.arange(WIDTH * HEIGHT, dtype=np.int32)
    out = [renderer.foreground(light, pixels, spp, 1, depth, seed) for seed in range(seeds)]
    whole = np.array([o.radiance for o in out], np.float64)
    return whole, np.array([o.diffuse for o in out], np.float64)


def tiles(radiance: Float64Array) -> Float64Array:
    """Sums over squares of pixels, and that over all: a small bias of each pixel adds up there."""
    image = radiance.reshape(-1, HEIGHT // TILE, TILE, WIDTH // TILE, TILE, 3)
    square = image.sum(axis=(2, 4)).reshape(len(image), -1, 3)
    return np.concatenate([square, square.sum(axis=1, keepdims=True)], axis=1)


@pytest.mark.slow
def test_no_bias(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight candidates against one, in open light and in shadow, over many seeds of few samples."""
    picked = runs(device, a_crowd(), colored_suns(), SEEDS)
    monkeypatch.setattr(launches, "CANDIDATES", 1)
    plain = runs(device, a_crowd(), colored_suns(), SEEDS)
    for many, one in zip(picked, plain, strict=True):
        a, b = tiles(many), tiles(one)
        assert a.mean() > 0.1
        variance = (a.var(axis=0, ddof=1) + b.var(axis=0, ddof=1)) / SEEDS
        verdict = z_test(a.mean(axis=0), b.mean(axis=0), variance, share_min=1.0)
        assert verdict.passed, verdict


def test_open_light_has_little_noise(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of the variance of one candidate inside an open ball; one ray is traced for each.

    Samples of a thread know the light's share from those before, so one thread has them all.
    """
    monkeypatch.setattr(render, "FULL_THREADS", 0)
    pixels = np.hypot(*(np.indices((HEIGHT, WIDTH)) - [[[11.5]], [[15.5]]])).reshape(-1) < 8.0

    def noise() -> float:
        return float(
            runs(device, a_ball(), a_sun(), 16, 64, 1)[0][:, pixels].var(axis=0, ddof=1).sum()
        )

    picked = noise()
    monkeypatch.setattr(launches, "CANDIDATES", 1)
    assert picked < 0.25 * noise()


def test_no_pixel_falls_below_zero(device: str) -> None:
    """Neither radiance nor its parts, at few samples in the edge of a shadow."""
    for spp in (2, 3, 16):
        whole, diffuse = runs(device, a_crowd(), colored_suns(), 40, spp)
        for values in (whole, diffuse, whole - diffuse):
            assert values.min() == 0.0
