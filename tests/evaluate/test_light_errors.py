"""Errors of a light: closed forms of lights whose direction, flux and colour are known."""

import numpy as np
import pytest

from tests import oracles
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, rotate_map, texel_solid_angles
from warpir.evaluate.light_errors import (
    CHANCE_DEG,
    SUN_RADIUS_DEG,
    directional_error,
    light_errors,
    lights_of,
    sun_sky_ratio_error,
)
from warpir.scene.light import Lobes, axis_from_angles, rasterize_lobes

TEXEL_DEG = 180.0 / 128
"""Directions are those of texel centres, so they are known to about half a diagonal."""


def sky(
    azimuth: float,
    elevation: float,
    sun: float = 600.0,
    sharpness: float = 400.0,
    ambient: tuple[float, float, float] = (0.8, 0.9, 1.0),
    height: int = 128,
) -> np.ndarray:
    """Return one lobe over a constant sky."""
    lobe = Lobes(
        np.full((1, 3), sun, np.float32),
        axis_from_angles(azimuth, elevation)[None].astype(np.float32),
        np.array([sharpness], np.float32),
    )
    return rasterize_lobes(lobe, height, 2 * height) + np.float32(ambient)


def test_errors_of_a_light_against_itself_are_zero() -> None:
    light = sky(30.0, 40.0)
    errors = light_errors(light, light)
    assert errors.pop("true_is_sunny") == 1.0
    assert errors.pop("predicted_has_direction") == 1.0
    assert 0.25 < errors.pop("true_peak_share") < 1.0
    assert set(errors) == {
        *("peak_angle_deg", "bright_angle_deg", "blob_angle_deg"),
        *("azimuth_error_deg", "elevation_error_deg"),
        *("log_sun_sky_ratio_error", "log_own_sun_sky_ratio_error", "log_flux_error"),
        *("rgb_angle_deg", "directional_deg", "directional_published_deg"),
        *("ambient_log_error", "ambient_red_log_error", "ambient_blue_log_error"),
    }
    assert list(errors.values()) == pytest.approx([0.0] * len(errors), abs=1e-5)


@pytest.mark.parametrize(
    ("azimuth", "elevation"), [(50.0, 40.0), (-179.0, 10.0), (0.0, 89.0), (200.0, -30.0)]
)
def test_angles_are_those_between_the_axes(azimuth: float, elevation: float) -> None:
    """Also over the map's seam (behind: azimuth 180 and 0 are columns 0 and 128) and the pole."""
    true, predicted = sky(10.0, 45.0), sky(azimuth, elevation)
    expected = np.degrees(
        oracles.angle_between(axis_from_angles(azimuth, elevation), axis_from_angles(10.0, 45.0))
    )
    errors = light_errors(predicted, true)
    assert errors["peak_angle_deg"] == pytest.approx(expected, abs=TEXEL_DEG)
    # Centroids of a symmetric lobe are not bound to texel centres
    assert errors["blob_angle_deg"] == pytest.approx(expected, abs=0.3)
    assert errors["bright_angle_deg"] == pytest.approx(expected, abs=1.0)
    assert errors["directional_deg"] == pytest.approx(expected, abs=0.5)


def test_azimuth_and_elevation_errors_are_apart_absolute_and_wrap() -> None:
    lights = sky(-170.0, 50.0), sky(170.0, 20.0)
    for errors in (light_errors(*lights), light_errors(*reversed(lights))):
        assert errors["azimuth_error_deg"] == pytest.approx(20.0, abs=TEXEL_DEG)
        assert errors["elevation_error_deg"] == pytest.approx(30.0, abs=TEXEL_DEG)


def test_blob_centre_is_not_drawn_by_a_second_light_but_the_bright_centre_is() -> None:
    true = sky(0.0, 30.0)
    predicted = true + sky(120.0, 30.0, sun=120.0, ambient=(0.0, 0.0, 0.0))
    errors = light_errors(predicted, true)
    assert errors["blob_angle_deg"] == pytest.approx(0.0, abs=0.05)
    assert errors["bright_angle_deg"] > 10.0


def test_equally_bright_texels_have_their_centre_as_peak() -> None:
    """A clipped map must not answer with the first of its white texels in memory."""
    true = sky(20.0, 35.0, sharpness=60.0)
    errors = light_errors(np.minimum(true, np.float32(100.0)), true)
    assert errors["peak_angle_deg"] == pytest.approx(0.0, abs=TEXEL_DEG)


def test_light_without_direction_counts_as_a_random_guess() -> None:
    """The mean angle of random directions to a fixed one is 90 degrees."""
    errors = light_errors(np.full((16, 32, 3), 0.5, np.float32), sky(0.0, 30.0))
    for key in ("peak_angle_deg", "bright_angle_deg", "blob_angle_deg", "directional_deg"):
        assert errors[key] == CHANCE_DEG
    assert errors["predicted_has_direction"] == 0.0
    assert "azimuth_error_deg" not in errors
    back = light_errors(sky(0.0, 30.0), np.full((16, 32, 3), 0.5, np.float32))
    assert back["peak_angle_deg"] == CHANCE_DEG
    assert "directional_deg" not in back
    assert back["true_is_sunny"] == 0.0


def test_ratio_error_is_the_logarithm_of_the_sun_s_factor() -> None:
    """Sun and sky are known apart: what the sky adds to the cap is its solid angle."""
    ambient, factor = (1.0, 1.0, 1.0), 7.0
    true, predicted = (sky(40.0, 30.0, sun=s, ambient=ambient) for s in (20.0, 20.0 * factor))
    flux = 20.0 * oracles.sg_flux(400.0)
    cap = 2.0 * np.pi * (1.0 - np.cos(np.radians(SUN_RADIUS_DEG)))
    rest = 4.0 * np.pi - cap
    expected = np.log((factor * flux + cap) / rest) - np.log((flux + cap) / rest)
    errors = light_errors(predicted, true)
    assert errors["log_sun_sky_ratio_error"] == pytest.approx(expected, abs=0.02)
    assert errors["log_own_sun_sky_ratio_error"] == pytest.approx(expected, abs=0.02)
    assert sun_sky_ratio_error(predicted, true) == errors["log_sun_sky_ratio_error"]


def test_sun_in_the_wrong_place_fails_the_shared_ratio_and_passes_its_own() -> None:
    errors = light_errors(sky(100.0, 30.0), sky(-60.0, 30.0))
    assert errors["log_sun_sky_ratio_error"] < -3.0
    assert errors["log_own_sun_sky_ratio_error"] == pytest.approx(0.0, abs=0.02)


def test_exposure_and_colour_of_the_whole_light() -> None:
    light = sky(0.0, 30.0, ambient=(1.0, 1.0, 1.0))
    errors = light_errors(3.0 * light, light)
    assert errors["log_flux_error"] == pytest.approx(np.log(3.0), abs=1e-6)
    assert errors["rgb_angle_deg"] == pytest.approx(0.0, abs=1e-5)
    tinted = light_errors(light * np.float32([1.0, 0.0, 0.0]), light)
    assert tinted["rgb_angle_deg"] == pytest.approx(np.degrees(np.arccos(1.0 / np.sqrt(3.0))))
    assert tinted["log_flux_error"] == pytest.approx(np.log(0.2126), abs=1e-6)


def test_ambient_errors_leave_the_sun_out() -> None:
    """Of suns unlike in strength and place under skies of known ratio and colour."""
    truth = sky(30.0, 40.0, ambient=(1.0, 1.0, 1.0))
    tinted = sky(120.0, 20.0, sun=3000.0, sharpness=1000.0, ambient=(2.4, 2.0, 1.5))
    errors = light_errors(tinted, truth)
    assert errors["ambient_red_log_error"] == pytest.approx(np.log(1.2), abs=1e-3)
    assert errors["ambient_blue_log_error"] == pytest.approx(-np.log(0.75), abs=1e-3)
    # What the two caps hide differs from surface to surface.
    level = np.log(luminance(np.array([2.4, 2.0, 1.5])))
    assert errors["ambient_log_error"] == pytest.approx(level, abs=0.05)


def test_sunny_means_a_large_share_from_one_place() -> None:
    assert light_errors(sky(0.0, 30.0), sky(0.0, 30.0, sun=1.0))["true_is_sunny"] == 0.0
    assert light_errors(sky(0.0, 30.0), sky(0.0, 30.0, sun=500.0))["true_is_sunny"] == 1.0


def test_errors_do_not_depend_on_size_or_on_a_turn_of_both() -> None:
    true, predicted = sky(33.0, 30.0), sky(-70.0, 55.0)
    errors = light_errors(predicted, true)
    turned = light_errors(rotate_map(predicted, 90.0), rotate_map(true, 90.0))
    del turned["directional_published_deg"]  # it is not the same everywhere, see below
    for key, value in turned.items():
        assert value == pytest.approx(errors[key], abs=1e-4), key
    larger = light_errors(sky(-70.0, 55.0, height=256), true)
    for key in ("blob_angle_deg", "log_sun_sky_ratio_error", "log_flux_error"):
        assert larger[key] == pytest.approx(errors[key], abs=0.02), key


def test_lights_are_found_across_the_seam_brightest_first() -> None:
    axes = [axis_from_angles(a, e) for a, e in ((0.0, 20.0), (120.0, 60.0), (-100.0, -10.0))]
    light = sum(
        sky(a, e, sun=s, ambient=(0.0, 0.0, 0.0))
        for (a, e), s in zip(((0.0, 20.0), (120.0, 60.0), (-100.0, -10.0)), (3, 9, 5), strict=True)
    )
    found = lights_of(np.asarray(light, np.float64))
    assert len(found) == 3
    for direction, axis in zip(found, (axes[1], axes[2], axes[0]), strict=True):
        assert np.degrees(oracles.angle_between(direction, axis)) < 0.5


@pytest.mark.parametrize(
    ("first", "second", "count"),
    [
        ((60, 255), (60, 0), 1),  # over the seam
        ((60, 255), (61, 0), 1),
        ((0, 10), (0, 138), 1),  # over the pole
        ((127, 200), (127, 72), 1),
        ((60, 10), (60, 12), 2),
        ((0, 10), (0, 100), 2),
    ],
)
def test_texels_that_touch_on_the_sphere_are_one_light(
    first: tuple[int, int], second: tuple[int, int], count: int
) -> None:
    texels = np.zeros((128, 256, 3))
    texels[first] = texels[second] = 1.0
    assert len(lights_of(texels)) == count


def test_directional_error_is_the_symmetric_mean_of_the_nearest() -> None:
    a, b = np.array([[0.0, 0.0, -1.0]]), np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    # a finds 0; b finds 0 and 90
    assert directional_error(a, b) == pytest.approx(30.0)
    assert directional_error(b, a) == pytest.approx(30.0)
    assert directional_error(np.zeros((0, 3)), a) == CHANCE_DEG


def test_published_directional_error_sees_the_blue_channel_alone() -> None:
    """The trap that the corrected variant is there for: a warm sun is no light there."""
    sun = sky(60.0, 40.0, sun=100.0, ambient=(0.0, 0.0, 0.0)) * np.float32([1.0, 1.0, 0.02])
    lamp = sky(-140.0, 40.0, sun=20.0, ambient=(0.0, 0.0, 0.0)) * np.float32([0.2, 0.2, 1.0])
    without_lamp = light_errors(sun, sun + lamp)
    assert without_lamp["directional_deg"] < 0.5
    assert without_lamp["directional_published_deg"] > 45.0
    without_sun = light_errors(lamp, sun + lamp)
    assert without_sun["directional_deg"] > 45.0
    assert without_sun["directional_published_deg"] < 0.5


def test_percentile_is_taken_over_the_sphere_not_over_the_texels() -> None:
    """A cap of 4 % at the pole holds 13 % of the texels, but leaves room for 1 % elsewhere."""
    directions = map_directions(128, 256)
    omega = texel_solid_angles(128, 256)[:, None]
    cap = directions[..., 1] > 1.0 - 2.0 * 0.04
    patch = directions @ axis_from_angles(70.0, 0.0) > 1.0 - 2.0 * 0.02
    true = np.where(cap, 10.0, 0.1)
    predicted = np.where(patch, 5.0, true)
    seen = np.where(cap | patch, predicted * omega, 0.0)
    centre = np.einsum("ij,ijc->c", seen, directions)
    expected = np.degrees(oracles.angle_between(centre, [0.0, 1.0, 0.0]))
    grey = (np.repeat(m[..., None], 3, axis=2).astype(np.float32) for m in (predicted, true))
    assert light_errors(*grey)["bright_angle_deg"] == pytest.approx(expected, abs=0.01)
    assert expected > 10.0


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (np.ones((8, 8, 3), np.float32), "lat-long"),
        (np.zeros((8, 16, 3), np.float32), "black"),
        (np.full((8, 16, 3), -1.0, np.float32), "negative"),
        (np.full((8, 16, 3), np.nan, np.float32), "not finite"),
    ],
)
def test_maps_that_cannot_be_compared_are_refused(fault: np.ndarray, message: str) -> None:
    good = sky(0.0, 30.0, height=16)
    with pytest.raises(ValueError, match=message):
        light_errors(fault, good)
    with pytest.raises(ValueError, match=message):
        light_errors(good, fault)
