"""Recovery of light and tone curves at a small size, with guidance that knows the true composite.

`benchmarks.light.recovery` measures the same at full size on six panoramas. Here a ball and a box
stand on a plane, in pictures of 48 x 32 pixels under panoramas that are made in the test, and under
the demo's sky, whose sun is a real one. No diffusion model takes part.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import warpir.demo
from benchmarks.light.recovery import (
    RecoveryScene,
    TowardTruth,
    Truth,
    brightest_direction,
    make_truth,
    measure,
    recover,
    reference,
    response,
    sun_sky_ratio,
    true_curves,
)
from benchmarks.speed.scenes import standing_ball
from tests import oracles as o
from tests.builders.shapes import box
from tests.slow import slow
from warpir.app.settings import OptimizeSettings
from warpir.core.arrays import FloatArray
from warpir.core.latlong import resize_map
from warpir.io.images.photos import read_envmap
from warpir.optimize.light import LightOptimization
from warpir.scene.asset import Asset, Material
from warpir.scene.light import axis_from_angles

WIDTH, HEIGHT = 48, 32
"""Of the picture [px]."""
SETTINGS = OptimizeSettings(steps=160, lobes=32, light_height=40, object_light_height=24)
"""The narrowest lobe of 40 rows has a standard deviation of 5.6 degrees."""
ANGLE = 3.0
"""Of the sun's direction [deg]: what the task asks for. Measured over three seeds: up to 1.1 under
made skies, 1.8 under the real sun, which is a point to lobes of 5.6 degrees."""
SUN_SKY = 0.75
"""Log error of the sun's flux over the sky's. Measured: up to 0.53, always too little sun: a sky
that brightens toward the sun makes almost the same picture, and 160 steps do not empty it (250
leave 0.50; under made skies, 600 left 0.27)."""
TONE = 0.038
"""RMSE of the foreground curve [1]; the identity's is 0.052 and more. Measured: up to 0.029; the
object's colours fill a part of the curve, and `bend` draws the rest toward the identity."""

pytestmark = pytest.mark.usefixtures("one_thread")


def made_sky(azimuth: float, elevation: float, sun: float = 4.0, sigma: float = 0.1) -> FloatArray:
    """A blue sky that darkens toward the horizon, brown ground, and a sun of a few degrees.

    Args:
        azimuth: Of the sun [deg].
        elevation: Of the sun [deg].
        sun: Irradiance of a surface that faces the sun, relative [W/m^2].
        sigma: Its width [rad].
    """
    d = o.texel_direction(64, 128)
    height = d[..., 1:2]
    sky = np.array([0.35, 0.5, 0.8]) * (0.6 + 0.6 * np.clip(height, 0.0, 1.0))
    texels = np.where(height > 0.0, sky, np.array([0.3, 0.26, 0.2]))
    axis, peak = axis_from_angles(azimuth, elevation), sun / (2.0 * np.pi * sigma**2)
    disc = o.sg_radiance(d, [[peak, 0.9 * peak, 0.75 * peak]], axis[None], [sigma**-2.0])
    return (texels + disc).astype(np.float32)


def real_sky() -> FloatArray:
    """The demo's panorama at 128 rows."""
    return resize_map(read_envmap(Path(warpir.demo.__file__).parent / "sky.exr"), 128)


def ball_and_box() -> Asset:
    """A ball of 2 m and a taller box beside it: smooth shading, and a shadow with an edge."""
    parts = standing_ball(24), box((1.6, 0.9, 0.3), (0.5, 1.8, 0.5))
    return Asset("ball and box", parts, (Material(base_color=(0.8, 0.5, 0.4), roughness=0.5),))


def a_truth(panorama: FloatArray, turn: float, contrast: float, device: str) -> Truth:
    """The photo looks ``turn`` degrees clockwise of the sun."""
    x, _, z = brightest_direction(panorama)
    azimuth = float(np.degrees(np.arctan2(x, -z))) + turn
    scene = RecoveryScene("test", "", "", 1.6, azimuth, 4.0, 1.4, 20.0, contrast)
    return make_truth(scene, panorama, ball_and_box(), WIDTH, HEIGHT, 64, device)


def tone_error_of_identity(contrast: float) -> float:
    """RMSE that no curve at all would have, over the radiances that `measure` looks at."""
    radiance = np.geomspace(0.02, 2.0, 64)
    curves = (response(true_curves(c)[0](), radiance) for c in (contrast, 0.0))
    return float(np.sqrt(np.square(np.subtract(*curves)).mean()))


# ----------------------------------------------------------------------------- the measures


@pytest.mark.parametrize("sigma", [0.005, *slow(0.05, 0.1)])
@pytest.mark.parametrize("angles", [(50.0, 35.0), (-170.0, 8.0), (90.0, 85.0)])
def test_brightest_direction_finds_the_sun(sigma: float, angles: tuple[float, float]) -> None:
    """From a point to six degrees, low and high, to a tenth of the map's texels."""
    texels = made_sky(*angles, sigma=max(sigma, 0.05))
    if sigma < 0.05:  # a sun within one texel
        texels = made_sky(*angles, sun=0.0)
        toward = o.texel_direction(64, 128) @ axis_from_angles(*angles)
        texels[np.unravel_index(np.argmax(toward), toward.shape)] = 1e4
        expected = o.texel_direction(64, 128).reshape(-1, 3)[np.argmax(toward)]
    else:
        expected = axis_from_angles(*angles)
    found = brightest_direction(texels)
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert np.degrees(o.angle_between(found, expected)) < 0.3


def test_sun_sky_ratio_in_closed_form() -> None:
    """``E / (2 pi L)`` of a sun of irradiance E over an even sky of radiance L; black ground."""
    axis, sigma = axis_from_angles(40.0, 45.0), 0.06
    d = o.texel_direction(128, 256)
    sky = np.where(d[..., 1:2] > 0.0, 0.2, 0.0) * np.ones(3)
    peak = 3.0 / (2.0 * np.pi * sigma**2)
    texels = (sky + o.sg_radiance(d, [[peak] * 3], axis[None], [sigma**-2.0])).astype(np.float32)
    for factor in (1.0, 1e3):
        ratio = sun_sky_ratio((factor * texels).astype(np.float32), axis)
        assert ratio == pytest.approx(3.0 / (2.0 * np.pi * 0.2), rel=0.01)
    assert sun_sky_ratio(sky.astype(np.float32), axis) == pytest.approx(0.0, abs=1e-6)


def test_response_is_reinhard_and_the_spline(rng: np.random.Generator) -> None:
    """Against the oracles, from dark to far beyond white."""
    curve = true_curves(0.8)[0]
    with torch.no_grad():
        for parameter in curve.parameters():
            parameter.add_(torch.from_numpy(rng.normal(0.0, 0.3, parameter.shape)))
    raw = torch.cat([curve.widths, curve.heights, curve.slopes], dim=1).detach().numpy()[0]
    radiance = np.geomspace(1e-3, 1e3, 50)
    expected, _ = o.spline(o.reinhard(radiance), *o.spline_knots(raw))
    np.testing.assert_allclose(response(curve(), radiance), expected, rtol=1e-5, atol=1e-6)


def test_guide_pulls_toward_the_truth() -> None:
    """The gradient of half the squared distance, over as many pixels as 384 x 256 has."""
    truth = torch.full((1, 3, 4, 6), 0.25)
    guide = TowardTruth(truth)
    image = torch.full((1, 3, 4, 6), 0.75)
    gradient = guide.gradient(image, 0)
    assert gradient.unique().tolist() == [0.5 * 384 * 256 / 24.0]
    assert guide.score(image) == 0.25 and guide.score(truth) == 0.0
    noisy = TowardTruth(truth, noise=1.0)
    first, again, other = (noisy.gradient(image, step) for step in (3, 3, 4))
    assert torch.equal(first, again) and not torch.equal(first, other)


# ----------------------------------------------------------------------------- the recovery


MADE = [
    # azimuth and elevation of the sun, turn of the camera from it, contrast
    pytest.param((20.0, 20.0, -120.0, 0.5), id="low sun"),
    pytest.param((-120.0, 45.0, -60.0, -0.5), id="high sun", marks=pytest.mark.slow),
]


def check(truth: Truth, loop: LightOptimization, contrast: float) -> None:
    """Assert the bounds, and that no curve at all would miss its own."""
    found = measure(truth, loop)
    assert found["angle_deg"] < ANGLE, found
    assert found["sun_sky_log_error"] < SUN_SKY, found
    assert found["tone_rmse"] < TONE < 0.75 * tone_error_of_identity(contrast), found


@pytest.mark.parametrize("case", MADE)
@pytest.mark.slow
def test_recovery_of_a_made_sky(device: str, case: tuple[float, float, float, float]) -> None:
    """Direction, sun against sky, and tone curve come out of an even light and the identity."""
    azimuth, elevation, turn, contrast = case
    truth = a_truth(made_sky(azimuth, elevation), turn, contrast, device)
    start = measure(truth, recover(truth, replace(SETTINGS, steps=0)))
    assert start["angle_deg"] > 30.0 and start["sun_sky_log_error"] > 2.0, "nothing to recover"
    loop = recover(truth, SETTINGS)
    check(truth, loop, contrast)
    assert measure(truth, loop)["rmse_changed"] < 0.1 * start["rmse_changed"]


@pytest.mark.slow
@pytest.mark.parametrize(("turn", "contrast"), [(-120.0, -0.5), (-60.0, 0.5)])
def test_recovery_of_a_real_sky(device: str, turn: float, contrast: float) -> None:
    """The demo's sun is 0.5 degrees wide and 10^5 times its sky."""
    truth = a_truth(real_sky(), turn, contrast, device)
    check(truth, recover(truth, SETTINGS), contrast)


@pytest.mark.slow
def test_recovery_follows_its_guide(device: str) -> None:
    """Toward the composite under the mirrored panorama, the mirrored sun is found, not the true.

    So what `check` accepts comes from the guidance, not from the photo or the start.
    """
    truth = a_truth(made_sky(20.0, 20.0), -120.0, 0.5, device)
    mirrored = np.ascontiguousarray(truth.texels[:, ::-1])
    image = reference(truth.frame, mirrored, truth.curve_fg, truth.curve_shadow, 64)
    wrong = replace(truth, image=image, texels=mirrored)
    loop = recover(wrong, SETTINGS)
    assert measure(wrong, loop)["angle_deg"] < ANGLE
    apart = np.degrees(
        o.angle_between(brightest_direction(mirrored), brightest_direction(truth.texels))
    )
    assert measure(truth, loop)["angle_deg"] == pytest.approx(apart, abs=ANGLE)
    assert apart > 10.0 * ANGLE


@pytest.mark.slow
def test_recovery_with_mis(device: str) -> None:
    """Six noisy samples a step find the same: noise averages out, and pulls nowhere.

    With the samples of the picture in its gradient, the sun would move by 5 degrees to where the
    picture is less noisy.
    """
    truth = a_truth(made_sky(20.0, 20.0), -120.0, 0.5, device)
    loop = recover(truth, replace(SETTINGS, steps=120, integrator="mis", mis_samples=6))
    check(truth, loop, 0.5)
