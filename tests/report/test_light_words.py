"""Lights in figures and words: directions in the camera's frame, widths, shares, colours."""

import numpy as np
import pytest

from tests.builders.poses import rotation
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import map_directions
from warpir.report.words import (
    LightCharacter,
    characterize,
    color_words,
    direction_words,
    softness_words,
    strength_words,
)
from warpir.scene.camera import camera_from_fov
from warpir.scene.light import Light, Lobes, as_map, axis_from_angles, bearing, plain_sky, sun_lobe

UP = np.array([0.0, 1.0, 0.0])
AHEAD = np.eye(4)
"""A camera that looks along -Z of the world."""
TEXEL = 180.0 / 128
"""Of the map that is measured [deg]."""


def turned(azimuth_deg: float, pitch_deg: float = 0.0) -> Float64Array:
    """Pose of a camera that looks toward an azimuth, up by the pitch."""
    pose = np.eye(4)
    pose[:3, :3] = rotation(*np.radians([-azimuth_deg, pitch_deg]))
    return pose


def lobe(azimuth: float, elevation: float, sharpness: float, peak: float = 10.0) -> Light:
    axis = axis_from_angles(azimuth, elevation)[None].astype(np.float32)
    lobes = Lobes(np.full((1, 3), peak, np.float32), axis, np.array([sharpness], np.float32))
    return Light(lobes, np.full((16, 32, 3), 0.5, np.float32))


@pytest.mark.parametrize(
    ("bearing_deg", "elevation", "words"),
    [
        (-135.0, 38.0, "from the upper left, behind the camera, 38 degrees above the horizon"),
        (135.0, 38.0, "from the upper right, behind the camera, 38 degrees above the horizon"),
        (90.0, 10.0, "from the right, 10 degrees above the horizon"),
        (-90.0, 45.0, "from the upper left, 45 degrees above the horizon"),
        (30.0, 30.0, "from the upper right, ahead of the camera, 30 degrees above the horizon"),
        (0.0, 40.0, "from above, ahead of the camera, 40 degrees above the horizon"),
        (180.0, 5.0, "from behind the camera, 5 degrees above the horizon"),
        (-179.0, -40.0, "from below, behind the camera, 40 degrees below the horizon"),
        (77.0, 80.0, "from overhead, 80 degrees above the horizon"),
        (77.0, -80.0, "from straight below, 80 degrees below the horizon"),
    ],
)
def test_direction_in_words(bearing_deg: float, elevation: float, words: str) -> None:
    """Left and right as in the photo; the height in degrees."""
    assert direction_words(bearing_deg, elevation) == words


@pytest.mark.parametrize("azimuth", [-150.0, -90.0, 0.0, 40.0, 120.0])
@pytest.mark.parametrize("pitch", [-60.0, 0.0, 30.0])
def test_bearing_is_the_azimuth_from_where_the_camera_looks(azimuth: float, pitch: float) -> None:
    """Our azimuth is clockwise from -Z; the pitch does not turn anything around the vertical."""
    axis = axis_from_angles(50.0, 35.0)
    found = bearing(axis, turned(azimuth, pitch))
    assert (found - (50.0 - azimuth) + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)


def test_bearing_follows_the_picture() -> None:
    """A thing on the right of a picture has a bearing to the right, of any camera of ours."""
    camera = camera_from_fov(64, 48, 60.0, -20.0, 1.6)
    for u, sign in ((10.0, -1.0), (54.0, 1.0)):
        _, ray = camera.ray(u, 24.0)
        assert np.sign(bearing(ray, camera.c2w)) == sign


def test_camera_that_looks_straight_down_has_a_bearing() -> None:
    """What is up in its picture is ahead."""
    assert bearing(np.array([0.0, 0.0, -1.0]), turned(0.0, -90.0)) == pytest.approx(0.0, abs=1e-6)
    assert bearing(np.array([1.0, 0.0, 0.0]), turned(0.0, -90.0)) == pytest.approx(90.0)


@pytest.mark.parametrize("sharpness", [5.0, 20.0, 100.0, 1000.0])
def test_half_width_is_that_of_the_lobe(sharpness: float) -> None:
    """A lobe falls to half at acos(1 - ln 2 / s); found within half a texel."""
    found = characterize(as_map(lobe(-40.0, 38.0, sharpness), 256), UP, AHEAD)
    expected = np.degrees(np.arccos(1.0 - np.log(2.0) / sharpness))
    assert found.half_width_deg == pytest.approx(expected, abs=0.5 * TEXEL)
    assert found.azimuth_deg == pytest.approx(-40.0, abs=TEXEL)
    assert found.elevation_deg == pytest.approx(38.0, abs=TEXEL)


@pytest.mark.parametrize("sharpness", [20.0, 1000.0, 5e4])
def test_direct_light_is_the_lobe_and_the_rest_the_sky(sharpness: float) -> None:
    """The lobe's irradiance of the ground is direct, within 2 %; both parts are the whole."""
    light = lobe(-40.0, 38.0, sharpness, peak=200.0)
    found = characterize(as_map(light, 256), UP, AHEAD)
    np.testing.assert_allclose(found.direct, Light(light.lobes).irradiance(UP), rtol=0.02)
    np.testing.assert_allclose(found.direct + found.sky, light.irradiance(UP), rtol=0.01)


def disc(azimuth: float, elevation: float, radius: float, radiance: float) -> FloatArray:
    """A uniform disc in an even light of 1, shape [512, 1024, 3]."""
    far = map_directions(512, 1024) @ axis_from_angles(azimuth, elevation)
    inside = (radius - np.degrees(np.arccos(np.clip(far, -1.0, 1.0)))) / (180.0 / 512)
    texels = 1.0 + (radiance - 1.0) * np.clip(0.5 + inside, 0.0, 1.0)  # the edge is smooth
    return np.repeat(texels[..., None], 3, axis=-1).astype(np.float32)


@pytest.mark.parametrize("radius", [1.0, 10.0, 20.0])
@pytest.mark.parametrize(
    ("azimuth", "elevation"), [(30.0, 45.0), (180.0, 45.0), (0.0, 30.0), (77.0, 80.0)]
)
def test_uniform_disc_is_told_by_its_middle(
    azimuth: float, elevation: float, radius: float
) -> None:
    """A softbox, wherever the map has its seam or its pole.

    Of its excess the ground gets pi (L - 1) sin^2 r sin(elevation), and of the even light pi.
    """
    irradiance = 4.0 * np.pi
    size = np.sin(np.radians(radius)) ** 2 * np.sin(np.radians(elevation))
    found = characterize(disc(azimuth, elevation, radius, 1.0 + 4.0 / size), UP, AHEAD)
    middle = axis_from_angles(found.azimuth_deg, found.elevation_deg)
    off = np.degrees(np.arccos(min(middle @ axis_from_angles(azimuth, elevation), 1.0)))
    assert off < 0.5 * TEXEL
    assert found.half_width_deg == pytest.approx(radius, abs=0.5 * TEXEL)
    np.testing.assert_allclose(found.direct, irradiance, rtol=0.02)
    assert found.direct_share == pytest.approx(0.8, abs=0.01)


def test_band_around_the_horizon_has_no_middle() -> None:
    """Its brightest texel stands for it, and its light comes from all around."""
    texels = np.full((128, 256, 3), 0.5, np.float32)
    texels[60:68] = 4.0
    found = characterize(texels, UP, AHEAD)
    assert abs(found.elevation_deg) < 6.0 and found.direct_share < 0.3


def test_even_light_has_neither_direction_nor_edge() -> None:
    """Of a sky without a sun, and of a light that is the same everywhere."""
    for texels in (
        plain_sky((0.4, 0.6, 1.0), (0.1, 0.1, 0.1)),
        np.full((8, 16, 3), 0.7, np.float32),
        np.zeros((8, 16, 3), np.float32),
    ):
        found = characterize(texels, UP, AHEAD)
        assert found.direct_share == 0.0
        assert "no direct light" in strength_words(found)
        assert softness_words(found).startswith("no edge")


def test_sun_is_hard_and_strong() -> None:
    """The real sun's size is below what the map resolves, and the words say so."""
    sun = sun_lobe(120.0, 50.0, (9.0, 8.0, 6.0))
    texels = as_map(Light(sun, plain_sky((0.3, 0.4, 0.7), (0.1, 0.1, 0.1))), 128)
    found = characterize(texels, UP, turned(30.0))
    assert found.bearing_deg == pytest.approx(90.0, abs=TEXEL)
    assert softness_words(found).startswith("hard") and "less than" in softness_words(found)
    assert strength_words(found).startswith("strong direct light")
    assert color_words(found.direct) == "orange" and color_words(found.sky) == "strongly blue"


def with_figures(half_width: float, direct: float) -> LightCharacter:
    return LightCharacter(0.0, 40.0, 0.0, half_width, np.full(3, direct), np.full(3, 1.0))


def test_words_follow_the_figures() -> None:
    """From hard to none; the ratio on the ground is told."""
    words = [softness_words(with_figures(w, 1.0)).split(",")[0] for w in (0.5, 3.0, 8.0, 40.0)]
    assert words == ["hard", "fairly hard", "soft", "very soft"]
    assert "17 cm of blur per metre" in softness_words(with_figures(5.0, 1.0))
    assert "4.0 times the rest" in strength_words(with_figures(5.0, 4.0))
    told = [strength_words(with_figures(5.0, d)).split(":")[0] for d in (4.0, 2.3, 1.0, 0.5)]
    assert told[:2] == ["strong direct light", "more direct light than sky"]
    assert told[2] == "direct light and sky of similar strength"
    assert told[3].startswith("mostly light from all around")


@pytest.mark.parametrize(
    ("rgb", "words"),
    [
        ((1.0, 1.0, 0.97), "neutral white"),
        ((1.0, 0.9, 0.8), "slightly orange"),
        ((1.0, 0.7, 0.4), "strongly orange"),
        ((0.6, 0.75, 1.0), "blue"),
        ((0.2, 1.0, 0.2), "strongly green"),
        ((1.0, 0.2, 0.2), "strongly red"),
        ((1.0, 1.0, 0.5), "yellow"),
        ((0.5, 1.0, 1.0), "turquoise"),
        ((1.0, 0.5, 1.0), "violet"),
        ((0.0, 0.0, 0.0), "black"),
    ],
)
def test_color_in_words(rgb: tuple[float, float, float], words: str) -> None:
    assert color_words(np.array(rgb)) == words
