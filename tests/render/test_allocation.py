"""Samples shared out by a pilot's noise: no bias, less error, even where that promises nothing."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
import torch
import warp as wp

from tests.builders.shapes import camera, ground, placed, sphere
from tests.statistics import z_test
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.kernels.types import CameraArgs, LightArgs, MaterialArgs
from warpir.render import allocation
from warpir.render.allocation import MOST, Sharing, as_it_is, as_shown, by_noise
from warpir.render.device import Launcher
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.launches import ObjectLaunch, launch_of_part
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.scene.asset import Material
from warpir.scene.light import Light, Lobes

WIDTH, HEIGHT = 64, 48
PIXELS = np.arange(WIDTH * HEIGHT, dtype=np.int32)


@dataclass
class Noise:
    """Traces pixels of mean 1 whose noise is known, and counts their samples."""

    deviation: Float64Array
    seed: int = 0
    counts: IntArray = field(default_factory=lambda: np.zeros(len(PIXELS), np.int32))
    pilots: int = 0

    def __call__(self, rows: IntArray, spp: int, number: int) -> tuple[FloatArray, ...]:
        rng = np.random.default_rng([self.seed, spp, number])
        noise = rng.normal(size=(len(rows), 3)) * self.deviation[rows, None] / np.sqrt(spp)
        if number:
            self.pilots += spp * len(rows)
        else:
            self.counts[rows] += spp
        return (1.0 + noise).astype(np.float32), np.full(len(rows), spp, np.float32)


def spread(noise: Noise, spp: int = 64, most: float | None = None) -> tuple[FloatArray, ...]:
    """Share ``spp`` samples out, or more where the picture has more noise than ``most``."""
    launcher = Launcher(wp.get_device("cpu"), 1)
    rows, mean = by_noise(launcher, noise, Sharing(as_it_is, most), PIXELS, WIDTH, (spp, 1))
    assert mean == noise.counts.mean()
    return rows


def a_spot() -> Float64Array:
    """Deviation 1 in a disc of a tenth of the picture, else .02."""
    x, y = PIXELS % WIDTH - 20, PIXELS // WIDTH - 24
    return np.where(x * x + y * y < 100, 1.0, 0.02)


def test_samples_go_where_noise_is() -> None:
    """Their mean is what was asked for, pilot included; the spot has most, no pixel under half."""
    noise = Noise(a_spot())
    values, counts = spread(noise)
    assert (counts == noise.counts).all()
    assert 0.8 * 64 < (noise.counts.sum() + noise.pilots) / len(PIXELS) <= 64
    assert noise.counts.min() == 32
    assert np.median(noise.counts[noise.deviation == 1.0]) == 256
    error = ((values - 1.0) ** 2).mean()
    assert error < 0.4 * (noise.deviation**2).mean() / 64


def test_even_noise_has_even_samples() -> None:
    """So has none at all, and a firefly in one pixel of the pilot."""
    for deviation in (np.ones(len(PIXELS)), np.zeros(len(PIXELS)), 1e-3 + 9.0 * (PIXELS == 130)):
        noise = Noise(deviation)
        spread(noise)
        assert (noise.counts == 64).all()


@pytest.mark.parametrize("deviation", [a_spot(), np.ones(len(PIXELS))], ids=["spot", "even"])
def test_noise_that_is_too_much_has_more_samples(deviation: Float64Array) -> None:
    """As many as bring it below the limit, at most `MOST` times those asked for; else no more."""
    values, counts = spread(Noise(deviation))
    error = np.sqrt(((values - 1.0) ** 2).mean())
    np.testing.assert_array_equal(spread(Noise(deviation), most=1.1 * error)[1], counts)
    for share in (0.75, 0.55):
        noise = Noise(deviation)
        values, counts = spread(noise, most=share * error)
        assert np.sqrt(((values - 1.0) ** 2).mean()) < 1.1 * share * error
        assert 1.2 * 64 < noise.counts.mean() < 1.5 * 64 / share**2
        assert counts.min() >= 32
    noise = Noise(deviation)
    spread(noise, most=0.01 * error)
    assert 0.9 * MOST * 64 < noise.counts.mean() <= MOST * 64


def test_large_pictures_have_few_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of a picture's samples are bounded, for time, but for those that were asked for."""
    for much, fewest, most in ((96, 1.2, 1.5), (32, 0.9, 1.0)):
        monkeypatch.setattr(allocation, "MUCH_WORK", much * len(PIXELS))
        noise = Noise(a_spot())
        spread(noise, most=1e-6)
        assert fewest * 64 < noise.counts.mean() <= most * 64


def test_small_pictures_have_no_pilot() -> None:
    """Nor do pictures of few samples."""
    noise = Noise(a_spot())
    spread(noise, 16)
    assert noise.pilots == 0 and (noise.counts == 16).all()


def test_bad_pilots_are_no_reason_to_fail() -> None:
    """NaN and infinity of a pilot say nothing of the noise."""
    deviation = a_spot()
    deviation[[0, 2]] = np.nan, np.inf
    noise = Noise(deviation)
    with np.errstate(invalid="ignore"):
        spread(noise)
    assert noise.counts.min() == 32 and (noise.counts[deviation == 1.0] >= 128).all()


def test_shared_out_samples_have_no_bias() -> None:
    """Over 400 seeds, by noise that differs from pixel to pixel."""
    deviation = np.random.default_rng(5).lognormal(0.0, 1.0, len(PIXELS)) * (a_spot() + 0.05)
    runs = np.array([spread(Noise(deviation, seed))[0].mean(axis=1) for seed in range(400)])
    truth, variance = np.ones(len(PIXELS)), runs.var(axis=0, ddof=1) / len(runs)
    verdict = z_test(runs.mean(axis=0), truth, variance)
    assert verdict.passed, verdict


def test_judged_as_shown() -> None:
    """A picture's error of radiance: highlights are pressed together, darkness is spread."""
    values = np.array([1e-3, 0.1, 1.0, 100.0], np.float32)
    slope = (as_shown(values * 1.01) - as_shown(values)) / (0.01 * values)
    assert (np.diff(slope) < 0.0).all() and slope[-1] < 1e-3 * slope[1]


def metal(device: str, **about: object) -> Renderer:
    """A metal ball on the ground."""
    thing = placed(sphere((0.0, 0.5, -3.0), 0.5), Material(metallic=1.0, roughness=0.3))
    view = camera(192, 128, 360.0, (0.0, 0.9, 0.0), pitch=-8.0)
    return Renderer(Scene([thing], view, ground(0.0), device), **about)  # type: ignore[arg-type]


def sun() -> Light:
    """A sun in a grey sky."""
    axis = np.array([[0.5, 0.7, 0.5], [0.0, 1.0, 0.0]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    peak = np.array([[300.0, 280.0, 250.0], [0.3, 0.35, 0.4]])
    lobes = (a.astype(np.float32) for a in (peak, axis, np.array([600.0, 1.0])))
    return Light(lobes=Lobes(*lobes))


@pytest.mark.slow
def test_highlights_of_metal(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Less than half of the variance, the same mean, shares of the work in order.

    On CUDA such small pictures have no pilot otherwise.
    """
    monkeypatch.setattr(allocation, "LEAST_WORK", {"cpu": 0, "cuda": 0})
    shares: list[float] = []

    def report(stage: str, share: float) -> None:
        shares.extend([share] if stage == "object" else [])

    renderer = metal(device, progress=report)
    light = light_args(sun(), renderer.device)
    pixels = renderer.gbuffer(0, 16).object_pixels

    def render(seed: int, **more: object) -> Float64Array:
        out = renderer.foreground(light, pixels, 64, 1, 1, seed, **more)  # type: ignore[arg-type]
        return out.radiance.astype(np.float64)

    even = np.array([render(seed) for seed in range(8)])
    del shares[:]
    shared = np.array([render(seed, sharing=Sharing(as_it_is)) for seed in range(8)])
    ones = [k for k, share in enumerate(shares) if share == pytest.approx(1.0)]
    assert len(ones) == 8 and renderer.span == (0.0, 1.0)
    first = shares[: ones[0] + 1]
    assert first == sorted(first)
    assert shared.var(axis=0, ddof=1).sum() < 0.5 * even.var(axis=0, ddof=1).sum()
    variance = (shared.var(axis=0, ddof=1) + even.var(axis=0, ddof=1)) / 8
    # Eight runs: outliers of a t distribution.
    assert z_test(shared.mean(axis=0), even.mean(axis=0), 2.0 * variance + 1e-6).passed
    np.testing.assert_array_equal(shared[3], render(3, sharing=Sharing(as_it_is)))


def test_gradients_take_even_samples(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A record holds as many of each pixel, so the image beside a gradient has them too."""
    monkeypatch.setattr(allocation, "LEAST_WORK", {"cpu": 0, "cuda": 0})
    calls: list[object] = []
    monkeypatch.setattr(allocation, "_pilot", lambda *a: calls.append(a))
    renderer = metal(device)
    pixels = renderer.gbuffer(0, 16).object_pixels
    mis = MisIntegrator(renderer, pixels, np.zeros(0, np.int32), spp=64, rays=1, depth=1)
    texels = torch.full((8, 16, 3), 0.5, requires_grad=True)
    mis.radiance(texels, texels, 0).foreground.sum().backward()  # type: ignore[no-untyped-call]
    assert texels.grad is not None and not calls


def test_limit_of_a_path_grows_with_a_pixels_samples() -> None:
    """So a path adds as much to a pixel of few samples as to one of many; pilots keep theirs."""
    nothing = (LightArgs(), MaterialArgs(), CameraArgs())
    launch = ObjectLaunch(*nothing, rays=1, depth=2, indirect_limit=4.0, seed=7)
    assert launch_of_part(launch, 0, 0.5) == replace(launch, indirect_limit=2.0)
    assert launch_of_part(launch, 0, 1.0) == launch
    pilot = launch_of_part(launch, 2, 0.125)
    assert pilot == replace(launch, seed=pilot.seed) and pilot.seed != launch.seed


def test_parts_of_a_picture_have_their_limits(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each has that of its samples; the pilots come before."""
    monkeypatch.setattr(allocation, "LEAST_WORK", {"cpu": 0, "cuda": 0})
    parts: list[tuple[int, float]] = []

    def spied(launch: ObjectLaunch, number: int, share: float) -> ObjectLaunch:
        parts.append((number, share))
        return launch_of_part(launch, number, share)

    monkeypatch.setattr("warpir.render.renderer.launch_of_part", spied)
    renderer = metal(device)
    pixels = renderer.gbuffer(0, 16).object_pixels
    light = light_args(sun(), renderer.device)
    renderer.foreground(light, pixels, 64, 1, 1, 0, 4.0, sharing=Sharing(as_it_is))
    shares = [share for number, share in parts if number == 0]
    assert [number for number, _ in parts[:2]] == [1, 2] and len(shares) == len(parts) - 2 > 1
    assert shares == sorted(shares) and set(shares) <= {0.5, 1.0, 2.0, 4.0, 8.0}
