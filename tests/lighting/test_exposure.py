"""The level of an estimated light, checked by the ground."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.builders.shapes import a_regression, box_before, camera, even_ambient
from tests.slow import slow
from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs
from warpir.core.arrays import FloatArray
from warpir.core.color import linear_to_gamma
from warpir.io.images.photos import Photo
from warpir.lighting import estimate, exposure
from warpir.lighting.estimate import estimate_light
from warpir.lighting.exposure import (
    FREEDOM,
    STATED_LOG_STD,
    ask_ground,
    expected_stops,
)
from warpir.lighting.regression import Regression
from warpir.scene.light import Light, axis_from_angles
from warpir.scene.shadow_mask import ShadowMask

ELEVATION = 50.0
SUN = 2.0
"""Irradiance of a surface that faces the sun, in the photo's units."""


def regression(level: float = 1.0, log_std: float = 0.5, ambient: float = 0.0) -> Regression:
    """A white sun of `SUN` times ``level`` [1], and an even ambient light of that radiance."""
    return a_regression(
        axis=axis_from_angles(20.0, ELEVATION),
        sun=np.full(3, SUN * level),
        sun_log_std=log_std,
        sigma=0.005,
        share=0.9,
        ambient=even_ambient(ambient),
        ambient_log_std=log_std,
    )


def inputs_of(albedo: float | FloatArray) -> Inputs:
    """A 48 x 32 photo of level ground under the true sun, and a box on it in the middle."""
    radiance = np.asarray(albedo) * SUN * math.sin(math.radians(ELEVATION)) / math.pi
    srgb = np.broadcast_to(np.clip(radiance, 0.0, 1.0) ** (1.0 / 2.2), (32, 48, 3))
    srgb = srgb.astype(np.float32)
    codes = np.round(srgb * 65535.0).astype(np.uint16)
    view = camera(48, 32, 48.0, (0.0, 1.5, 0.0), -15.0)
    return box_before(view, srgb, codes)


@pytest.mark.parametrize("level", [0.25, 0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("albedo", [0.1, 0.19, 0.4])
def test_implied_albedo_is_true_albedo_over_level(level: float, albedo: float) -> None:
    """Ground of a known albedo under a light that is ``level`` times too strong."""
    ground = ask_ground(regression(level), inputs_of(albedo))
    assert ground is not None
    assert ground.implied == pytest.approx(albedo / level, rel=3e-3)
    # Nobody stated the albedo, so the light stays.
    assert ground.stops == 0.0 and ground.albedo == ground.implied


@pytest.mark.parametrize("level", [0.4, 1.0, 2.5])
def test_stated_albedo_gives_the_true_level(level: float) -> None:
    """A known albedo and a regressor that is not sure of its level: the light becomes the truth."""
    ground = ask_ground(regression(level, log_std=2.0), inputs_of(0.4), stated=0.4)
    assert ground is not None
    assert 2.0**ground.stops * level == pytest.approx(1.0, rel=0.05)
    assert ground.albedo == pytest.approx(0.4, rel=0.05)


def test_sure_regressor_is_left_alone() -> None:
    """A level that is known to a thousandth stays, whatever the ground looks like."""
    ground = ask_ground(regression(log_std=1e-3), inputs_of(0.02), stated=0.2)
    assert ground is not None and ground.stops == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("log_std", [0.2, 0.6, 1.2])
def test_normal_witnesses_are_weighed_by_their_variances(
    log_std: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of many degrees of freedom t is the normal: the mean is x s^2 / (s^2 + S^2)."""
    monkeypatch.setattr(exposure, "FREEDOM", 1e7)
    weight = log_std**2 / (log_std**2 + STATED_LOG_STD**2)
    for excess in (-0.8, 0.0, 0.5):
        change = expected_stops(excess, log_std)
        assert change == pytest.approx(weight * excess / math.log(2.0), abs=1e-4)


def test_change_is_the_mean_of_the_stated_density() -> None:
    """By an independent quadrature of the product of the normal and Student's t."""
    from scipy.integrate import quad
    from scipy.stats import norm, t

    def density(x: float) -> float:
        ground = t.pdf(1.7 - x, FREEDOM, scale=STATED_LOG_STD)
        return float(norm.pdf(x, scale=0.5) * ground)

    whole, mean = (quad(lambda x, k=k: x**k * density(x), -6.0, 6.0)[0] for k in (0, 1))
    assert expected_stops(1.7, 0.5) == pytest.approx(mean / whole / math.log(2.0), abs=1e-4)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_snow_and_asphalt_count_for_little(sign: float) -> None:
    """The further the ground is from any albedo, the smaller its weight; far out its pull too."""
    changes = [expected_stops(sign * excess, 0.4) for excess in (0.5, 2.0, 8.0)]
    weights = [
        change / (sign * excess) for change, excess in zip(changes, (0.5, 2, 8), strict=True)
    ]
    assert weights[0] > 1.1 * weights[1] > 0.0 and weights[1] > 2.0 * weights[2] > 0.0
    assert abs(changes[2]) < abs(changes[1])


def test_black_ground_keeps_the_light_finite() -> None:
    """Of a black photo, which no albedo explains, the regressor decides."""
    ground = ask_ground(regression(log_std=0.5), inputs_of(0.0), stated=0.2)
    assert ground is not None and -1.0 < ground.stops < 0.0


def test_a_shadow_on_a_third_of_the_ground_counts_for_nothing() -> None:
    """The middle of the ground's levels is that of the lit part."""
    albedo = np.full((32, 48, 3), 0.3, np.float32)
    albedo[:, :16] = 0.01
    whole, shaded = (ask_ground(regression(), inputs_of(a)) for a in (0.3, albedo))
    assert whole is not None and shaded is not None
    assert shaded.implied == pytest.approx(whole.implied, rel=1e-3)


def test_without_ground_in_view_the_regressor_decides() -> None:
    """A camera that looks up past the object's foot, and a mask that hides all of the ground."""
    upward = camera(48, 32, 48.0, (0.0, 1.5, 0.0), 60.0)
    assert ask_ground(regression(), replace(inputs_of(0.3), camera=upward)) is None
    hidden = replace(inputs_of(0.3), occluder=np.ones((32, 48), np.float32))
    assert ask_ground(regression(), hidden) is None


@pytest.mark.parametrize(
    ("name", "mask_of", "dark"),
    [("occluder", np.asarray, 0.01), ("shadow_mask", lambda m: ShadowMask(m, 0.0), 0.03)],
)
def test_ground_that_a_mask_marks_is_left_out(
    name: str, mask_of: Callable[[FloatArray], object], dark: float
) -> None:
    """A dark post in front of the left half is no ground, nor is what --shadow-mask marks lit."""
    albedo = np.full((32, 48, 3), 0.3, np.float32)
    albedo[:, :30] = dark
    mask = np.zeros((32, 48), np.float32)
    mask[:, :30] = 1.0
    seen = inputs_of(albedo)
    fooled = ask_ground(regression(), seen)
    masked = ask_ground(regression(), replace(seen, **{name: mask_of(mask)}))
    assert fooled is not None and masked is not None
    assert fooled.implied < 0.05 and masked.implied == pytest.approx(0.3, rel=3e-3)


def test_estimate_follows_the_ground_where_its_albedo_is_stated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sun and ambient alike, by the stops that the line says; --exposure overrules the ground."""
    found = regression(level=3.0, ambient=0.2)
    monkeypatch.setattr(estimate, "load_regressor", lambda *_: None)
    monkeypatch.setattr(estimate, "regress", lambda *_: found)
    plain = found.lobes().amplitude

    def estimated(albedo: float = 0.3, **values: object) -> tuple[estimate.Estimate, FloatArray]:
        config = InsertConfig(photo="p", asset="a", out="o", tone="linear", **values)
        made = estimate_light(inputs_of(albedo), config.light, config.tone_operator)
        assert made.light.light.lobes is not None
        return made, made.light.light.lobes.amplitude

    made, amplitude = estimated()
    assert made.ground is not None and made.ground.stops == 0.0
    assert made.gain == 1.0 and made.light.exposure == 0.0
    np.testing.assert_array_equal(amplitude, plain)
    record = made.record()["ground"]
    assert record["stops"] == 0.0 and record["albedo"] == record["implied_albedo"]
    (line,) = [line for line in made.light.assumed if "--ground-albedo" in line]
    assert f"albedo is {made.ground.implied:.2g} (" in line

    dark, amplitude = estimated(0.06)
    np.testing.assert_array_equal(amplitude, plain)
    (line,) = [line for line in dark.light.assumed if "--ground-albedo" in line]
    assert "which few grounds have: it may be too strong" in line

    stated, amplitude = estimated(ground_albedo=0.3)
    assert stated.ground is not None and stated.ground.stops < 0.0
    assert stated.light.exposure == pytest.approx(stated.ground.stops)
    np.testing.assert_allclose(amplitude, 2.0**stated.ground.stops * plain, rtol=1e-5)
    (line,) = [line for line in stated.light.assumed if "albedo" in line]
    assert f"{stated.ground.stops:+.2f} EV" in line
    assert f"{stated.ground.albedo:.2g} instead of {stated.ground.implied:.2g}" in line

    for stops in (0.0, -1.0):
        given, amplitude = estimated(exposure=stops, ground_albedo=0.3)
        assert given.ground is None and given.record()["ground"] is None
        assert given.light.exposure == stops and len(given.light.assumed) == 1
        np.testing.assert_allclose(amplitude, 2.0**stops * plain, rtol=1e-5)


@pytest.mark.parametrize("unit", [1.0 / 64.0, *slow(64.0)])
def test_plate_of_any_unit_gives_the_same_light_in_that_unit(unit: float) -> None:
    """The networks see the plate exposed as a photo, and the ground's level is not cut."""

    def estimated(factor: float) -> estimate.Estimate:
        inputs = inputs_of(0.3)
        shade = np.linspace(0.2, 1.0, 32, dtype=np.float32)[:, None, None]
        plate = np.float32(factor) * shade * inputs.photo.linear()
        photo = Photo(plate, np.clip(linear_to_gamma(plate), 0.0, 1.0), "exr")
        config = InsertConfig(photo="p", asset="a", out="o")
        return estimate_light(replace(inputs, photo=photo), config.light, config.tone_operator)

    plain, other = estimated(1.0), estimated(unit)
    np.testing.assert_allclose(other.regression.axis, plain.regression.axis, atol=1e-4)
    lobes, others = plain.light.light.lobes, other.light.light.lobes
    assert lobes is not None and others is not None
    np.testing.assert_allclose(others.amplitude, unit * lobes.amplitude, rtol=1e-3)
    assert plain.ground is not None and other.ground is not None
    assert other.ground.implied == pytest.approx(plain.ground.implied, rel=1e-3)


def test_a_glimpse_of_the_ground_is_not_enough() -> None:
    """A mask that leaves a column open silences the ground; a wider gap does not."""
    mask = np.ones((32, 48), np.float32)
    inputs = inputs_of(0.3)
    mask[:, 24] = 0.0
    assert ask_ground(regression(), replace(inputs, occluder=mask)) is None
    mask[:, 20:28] = 0.0
    open_gap = ask_ground(regression(), replace(inputs, occluder=mask))
    assert open_gap is not None
    assert open_gap.implied == pytest.approx(0.3, rel=3e-3)


def test_light_without_a_clear_direction_casts_a_soft_shadow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The object's glints stay sharp; so does all of a clear light, and what a mask is given of."""
    monkeypatch.setattr(estimate, "load_regressor", lambda *_: None)
    config = InsertConfig(photo="p", asset="a", out="o", tone="linear")

    def estimated(spread_deg: float, inputs: Inputs) -> tuple[Light, Light]:
        found = a_regression(spread_deg=spread_deg)
        light = estimate_light(inputs, config.light, config.tone_operator, found).light
        return light.light, light.light_shadow

    inputs = inputs_of(0.3)
    mask = ShadowMask(np.zeros(inputs.photo.srgb.shape[:2], np.float32), 0.0)
    for spread_deg, given in ((30.0, inputs), (60.0, replace(inputs, shadow_mask=mask))):
        light, shadow = estimated(spread_deg, given)
        assert shadow is light
    light, shadow = estimated(60.0, inputs)
    assert light.lobes is not None and shadow.lobes is not None
    assert light.lobes.sharpness[0] == pytest.approx(0.05**-2)
    assert shadow.lobes.sharpness[0] == pytest.approx(math.radians(30.0) ** -2)
    axis = light.lobes.axis[0].astype(np.float64)
    np.testing.assert_allclose(shadow.irradiance(axis), light.irradiance(axis), rtol=1e-3)
