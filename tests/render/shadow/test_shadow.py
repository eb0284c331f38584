"""The shadow ratio of a picture: blocks that are interpolated beside pixels that are traced."""

from dataclasses import replace

import numpy as np
import pytest

from tests.builders.shapes import (
    all_pixels,
    camera,
    constant,
    ground,
    lobe,
    placed,
    quad,
    seen_ground,
    sphere,
)
from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.kernels.types import LightArgs
from warpir.render import device_light
from warpir.render.device_light import light_args, propose
from warpir.render.device_scene import Receiver, Scene
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.render.shadow.picture import BEND, picture_ratio
from warpir.render.shadow.pilot import run_pilot
from warpir.scene.asset import Material
from warpir.scene.light import Light
from warpir.scene.receiver import mesh_of

RADIUS, HEIGHT = 0.5, 1.5
"""Of a ball, and of its centre above the ground [m]."""
VIEW = camera(128, 80, 126.0, (0.0, 3.0, 6.0), pitch=-25.0)
QUALITY = Quality(16, 1, 1, 5)
EXACT_SAMPLES = 512


def ball(device: str, bounce_depth: int = 0, receiver: Receiver | None = None) -> Renderer:
    thing = placed(sphere((0.0, HEIGHT, 0.0), RADIUS, detail=5))
    scene = Scene([thing], VIEW, receiver or ground(0.0), device)
    return Renderer(scene, bounce_depth=bounce_depth)


def ratio_everywhere(
    renderer: Renderer, light: Light, quality: Quality = QUALITY
) -> tuple[IntArray, FloatArray]:
    args = light_args(light, renderer.device)
    count = len(all_pixels(renderer.scene.camera))
    nothing, everywhere = np.zeros(count, np.int32), np.ones(count, np.bool_)
    return picture_ratio(renderer, args, nothing, everywhere, quality)


def sunny() -> Light:
    sun = lobe((0.5, 0.6, 0.4), 300.0, (40.0, 36.0, 30.0)).lobes
    return Light(sun, np.full((8, 16, 3), (0.4, 0.5, 0.8), np.float32))


def test_loss_under_an_even_sky_is_the_balls_form_factor(device: str) -> None:
    """A sphere wholly above the horizon takes ``(r / d)^2 cos`` (its configuration factor).

    Siegel and Howell, "Thermal Radiation Heat Transfer".
    """
    renderer = ball(device)
    point = seen_ground(VIEW)[:, 0]
    pixels = np.flatnonzero(np.isfinite(point[:, 0]))[::37].astype(np.int32)
    to_ball = np.array([0.0, HEIGHT, 0.0]) - point[pixels]
    distance = np.linalg.norm(to_ball, axis=1)
    expected = (RADIUS / distance) ** 2 * (HEIGHT / distance)
    light = light_args(constant((1.0, 2.0, 0.5)), renderer.device)
    seen = renderer.receiver(light, pixels, np.zeros(len(pixels), np.int32), 4096, 1, 3)
    lost = (seen.unoccluded - seen.lit) / np.array([1.0, 2.0, 0.5])
    # Within a pixel far away the factor changes by a few per cent, and facets hide .1 % less.
    np.testing.assert_allclose(lost, np.repeat(expected[:, None], 3, axis=1), rtol=0.03, atol=2e-4)
    assert lost.mean() == pytest.approx(expected.mean(), rel=4e-3)


def test_sampled_loss_is_that_of_the_ratio_of_two_sums(device: str) -> None:
    """Near the object, in its shadow and beside it, and less noisy."""
    renderer, light = ball(device), sunny()
    args = light_args(light, renderer.device)
    pixels = all_pixels(VIEW)[::53]
    nothing = np.zeros(len(pixels), np.int32)
    runs = np.zeros((2, 24, len(pixels), 3))
    for k, is_recorded in enumerate((True, False)):
        for seed in range(24):
            sums = renderer.receiver(
                args, pixels, nothing, 64, 1, 100 * k + seed, is_recorded=is_recorded
            )
            with np.errstate(invalid="ignore"):
                runs[k, seed] = np.where(sums.unoccluded > 0.0, sums.lit / sums.unoccluded, 1.0)
    (ours, theirs), (noise, other) = runs.mean(axis=1), runs.var(axis=1, ddof=1)
    z = (ours - theirs) / np.sqrt((noise + other) / 24 + 1e-8)
    assert np.abs(z).max() < 5.5 and abs(z.mean()) < 0.2, (np.abs(z).max(), z.mean())
    assert other.sum() < 0.6 * noise.sum()


def test_interpolation_is_nearer_to_the_truth_than_tracing_each_pixel(device: str) -> None:
    renderer, light = ball(device), sunny()
    pixels, ratio = ratio_everywhere(renderer, light)
    args, nothing = light_args(light, renderer.device), np.zeros(len(pixels), np.int32)
    truth = renderer.ratio(renderer.receiver(args, pixels, nothing, EXACT_SAMPLES, 1, 99))
    traced = renderer.ratio(renderer.receiver(args, pixels, nothing, QUALITY.samples, 1, 5))
    interpolated = np.abs(ratio - traced).max(axis=1) > 0.0
    assert interpolated.mean() > 0.3
    ours, theirs = (np.sqrt(((r - truth)[interpolated] ** 2).mean()) for r in (ratio, traced))
    assert ours < 0.6 * theirs
    error = ratio[interpolated] - truth[interpolated]
    assert np.abs(error).max() < 2.0 * BEND and np.abs(error.mean()) < 3e-4


@pytest.mark.slow
def test_light_that_the_ball_throws_is_interpolated_too(device: str) -> None:
    renderer, light = ball(device, bounce_depth=3), sunny()
    quality = replace(QUALITY, samples=64)
    pixels, ratio = ratio_everywhere(renderer, light, quality)
    args, nothing = light_args(light, renderer.device), np.zeros(len(pixels), np.int32)
    sums = renderer.receiver(args, pixels, nothing, EXACT_SAMPLES, 1, 99)
    gain = sums.thrown / sums.unoccluded
    bare = ball(device)
    there, without = ratio_everywhere(bare, light, quality)
    shown = np.ones((VIEW.width * VIEW.height, 3), np.float32)
    shown[there] = without
    found = ratio - shown[pixels]
    assert gain.mean() > 1e-3
    assert found.mean() == pytest.approx(gain.mean(), rel=0.05)
    assert np.sqrt(((found - gain) ** 2).mean()) < 0.5 * np.sqrt((gain**2).mean())


def test_only_wanted_pixels_are_returned_and_others_do_not_change_them(device: str) -> None:
    renderer, light = ball(device), sunny()
    args = light_args(light, renderer.device)
    count = VIEW.width * VIEW.height
    wanted = np.arange(count) % 3 == 0
    whole, ratio = ratio_everywhere(renderer, light)
    some, of_some = picture_ratio(renderer, args, np.zeros(count, np.int32), wanted, QUALITY)
    np.testing.assert_array_equal(some, whole[wanted[whole]])
    np.testing.assert_array_equal(of_some, ratio[wanted[whole]])


def test_the_planes_proposal_is_made_once_a_light(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pilot, blocks and pixels draw from it; of a large map it takes seconds each time."""
    renderer, made = ball(device), list[LightArgs]()

    def counted(args: LightArgs, normal: Float64Array | None = None) -> None:
        made.extend([] if normal is None else [args])
        propose(args, normal)

    monkeypatch.setattr(device_light, "propose", counted)
    first = ratio_everywhere(renderer, sunny())[1]
    assert len(made) == 1
    dim = ratio_everywhere(renderer, constant())[1]
    assert len(made) == 2 and first.shape != dim.shape
    np.testing.assert_array_equal(ratio_everywhere(renderer, sunny())[1], first)


def test_a_mesh_of_the_receiver_is_traced_by_the_pixel(device: str) -> None:
    wall = mesh_of(placed(quad((0.0, 1.0, -2.0), (3.0, 0.0, 0.0), (0.0, 1.0, 0.0))).asset)
    plane = replace(ground(0.0), mesh=wall)
    renderer, light = ball(device, receiver=plane), sunny()
    pixels, ratio = ratio_everywhere(renderer, light)
    args, nothing = light_args(light, renderer.device), np.zeros(len(pixels), np.int32)
    traced = renderer.receiver(args, pixels, nothing, QUALITY.samples, 1, QUALITY.seed)
    np.testing.assert_array_equal(ratio, renderer.ratio(traced))


def test_no_light_is_a_ratio_of_one(device: str) -> None:
    pixels, ratio = ratio_everywhere(ball(device), constant((0.0, 0.0, 0.0)))
    assert len(pixels) == 0 and ratio.shape == (0, 3)


def test_the_pilot_knows_the_open_planes_radiance(device: str) -> None:
    renderer = ball(device)
    pilot = run_pilot(renderer, light_args(constant((0.5, 1.0, 2.0)), renderer.device), 0)
    np.testing.assert_allclose(pilot.open_radiance, [0.5, 1.0, 2.0], rtol=2e-3)


def test_what_a_mirror_throws_is_the_same_share_of_dark_ground(device: str) -> None:
    """The limit of specks follows the ground's own light: a photo may be dark."""
    mirror = placed(sphere((0.0, RADIUS, 0.0), RADIUS, detail=4), Material(roughness=0.05))
    renderer = Renderer(Scene([mirror], VIEW, ground(0.0), device), bounce_depth=2)
    quality = replace(QUALITY, indirect_limit=8.0)
    sky = np.full((8, 16, 3), 0.5, np.float32)
    sun = lobe((0.5, 0.6, 0.4), 3000.0, (400.0, 400.0, 400.0)).lobes
    assert sun is not None
    at = [
        ratio_everywhere(
            renderer,
            Light(replace(sun, amplitude=sun.amplitude * level), sky * np.float32(level)),
            quality,
        )[1]
        for level in (1.0, 1.0 / 64.0)
    ]
    bright, dark = at
    assert bright.max() > 1.0
    np.testing.assert_allclose(dark, bright, rtol=1e-3)
