"""The camera's response: its curve, what it does to object and shadow, when it is estimated."""

import numpy as np
import pytest

from warpir.core.arrays import FloatArray
from warpir.look.camera_look import CameraLook, estimate_look
from warpir.look.response import (
    BLACK,
    GREY,
    PLACED,
    RANGE,
    Response,
    estimate_response,
    response_through,
    statistics,
)


def ramp(low: float, high: float) -> FloatArray:
    """A picture whose display values run evenly from one to the other, decoded, [H, W, 3]."""
    shown = np.linspace(low, high, 320)[None, :, None] * np.ones((200, 1, 3))
    return (shown**2.2).astype(np.float32)


@pytest.mark.parametrize("toe", [0.0, 0.002, 0.0085, 0.02])
@pytest.mark.parametrize("exponent", [0.8, 1.0, 1.1, 1.35])
def test_curve_is_monotone_and_a_power_with_a_toe(exponent: float, toe: float) -> None:
    """Grey and both ends stay; below grey within .1 codes of the formula; it never falls."""
    response = Response(exponent, toe)
    x = np.linspace(0.0, 1.0, 2001)
    y = response.colour(x)
    assert (np.diff(y) > 0.0).all() and y[0] == 0.0 and y[-1] == 1.0
    assert response.colour(np.array(GREY)) == pytest.approx(GREY, abs=1e-6)
    dark = np.geomspace(0.0005, GREY, 200)
    codes = 255.0 * response.colour(dark) ** (1 / 2.2)
    left = dark * (GREY + toe) / (GREY * (dark + toe))
    wanted = 255.0 * (GREY * (dark / GREY) ** exponent * left) ** (1 / 2.2)
    np.testing.assert_allclose(codes, wanted, atol=0.1)
    if toe == 0.0:
        bright = response.colour(np.array([0.3, 0.5, 0.8])) - [0.3, 0.5, 0.8]
        assert (np.sign(bright.round(4)) == np.sign(exponent - 1.0)).all()


def test_shadow_is_what_the_camera_shows_of_less_light() -> None:
    """A photo of a scene through the curve, and the same scene under a share of the light."""
    response = Response(1.25)
    scene = np.random.default_rng(0).uniform(0.01, 0.9, (50, 3))
    share = np.random.default_rng(1).uniform(0.1, 0.95, (50, 3)).astype(np.float32)
    plate = response.colour(scene)
    shaded = plate * response.shadow_ratio(share, plate)
    np.testing.assert_allclose(shaded, response.colour(scene * share), atol=1e-5)
    # What no curve shows, black and brighter than white, keeps its ratio.
    odd = np.array([[0.0, 1.5, 0.0]], np.float32)
    np.testing.assert_array_equal(response.shadow_ratio(share[:1], odd), share[:1])


def test_layers_keep_their_parts_and_untouched_ground() -> None:
    """Parts add up to the object, coverage stays, a ratio of exactly 1 stays exactly 1."""
    rng = np.random.default_rng(2)
    matte = rng.uniform(0.0, 1.0, (20, 30)).astype(np.float32)
    matte[:5] = 0.0
    parts = {
        name: (rng.uniform(0.0, 0.3, (20, 30, 3)) * matte[..., None]).astype(np.float32)
        for name in ("diffuse", "specular", "emission")
    }
    ratio = np.ones((20, 30, 3), np.float32)
    ratio[10:, :, :2] = 0.4
    planes = {"matte": matte, "shadow_ratio": ratio, "foreground": sum(parts.values()), **parts}
    before = {name: plane.copy() for name, plane in planes.items()}
    plate = np.full((20, 30, 3), 0.1, np.float32)
    shown = CameraLook(response=Response(1.3)).shown_like_photo(planes, plate)
    total = shown["diffuse"] + shown["specular"] + shown["emission"]
    np.testing.assert_allclose(total, shown["foreground"], atol=1e-6)
    np.testing.assert_array_equal(shown["matte"], before["matte"])
    assert (shown["foreground"][:5] == 0.0).all()
    assert (shown["shadow_ratio"][:10] == 1.0).all() and (shown["shadow_ratio"][..., 2] == 1).all()
    assert (shown["shadow_ratio"][10:, :, :2] < 0.4).all()
    seen = matte > 0.0
    colour = before["foreground"][seen] / matte[seen][:, None]
    wanted = Response(1.3).colour(colour) * matte[seen][:, None]
    np.testing.assert_allclose(shown["foreground"][seen], wanted, atol=1e-6)


@pytest.mark.parametrize(("low", "high"), [(0.45, 0.8), (0.7, 1.0), (0.25, 0.6), (1.0, 1.0)])
def test_no_dark_regions_tell_nothing(low: float, high: float) -> None:
    """Fog, snow, a pale wall and white: the curve stays the identity."""
    assert estimate_response(ramp(low, high)) is None
    look = estimate_look(ramp(low, high) ** (1 / 2.2), ramp(low, high), None, "off", "off", "auto")
    assert look.response is None and look.record().keys() == {"blur", "grain"}


def test_strip_of_a_photo_has_statistics() -> None:
    """Lower than the squares that a photo as wide is averaged in."""
    strip = np.tile(ramp(0.0, 0.9)[:1], (4, 1000, 1))[:, :1000]
    assert np.isfinite(statistics(strip)).all() and estimate_response(strip) is not None


def test_values_above_white_stay() -> None:
    """Those of a linear plate, which a value of the flag is applied to."""
    shown = np.array([0.1, 1.0, 1.5, 20.0], np.float32)
    bent = Response(1.2).colour(shown)
    assert bent[0] < 0.1 and bent[1:].tolist() == [1.0, 1.5, 20.0]


def test_a_steeper_camera_gives_darker_blacks() -> None:
    """The same scene through three cameras; black and the steepest pictures stay in range."""
    rng = np.random.default_rng(3)
    scene = np.exp(rng.normal(-3.0, 1.2, (60, 90, 1))) * rng.uniform(0.8, 1.2, (60, 90, 3))
    scene = np.repeat(np.repeat(np.clip(scene, 0.0, 1.0), 4, axis=0), 4, axis=1)
    found = [estimate_response(Response(c).colour(scene)) for c in (0.85, 1.0, 1.3)]
    blacks = [float(r.dark(np.array(0.005))) for r in found if r is not None]
    assert len(blacks) == 3 and blacks[0] > blacks[1] > blacks[2]
    for linear in (np.zeros((40, 60, 3), np.float32), ramp(0.0, 1.0) ** 8):
        response = estimate_response(linear)
        assert response is not None and RANGE[0] <= response.exponent <= RANGE[1]


def test_no_object_is_darker_than_the_photos_blacks() -> None:
    """Where the darkest half percent is hardly below a black object's value, that is the limit."""
    for low in (0.0, 0.05, 0.07, 0.085):
        response = estimate_response(ramp(low, 0.9))
        assert response is not None and response.black is not None
        shown = float(response.dark(np.array(BLACK**2.2))) ** (1 / 2.2)
        assert shown >= response.black - 1e-9
        assert shown < BLACK


@pytest.mark.parametrize("known", [Response(1.0), Response(1.1, 0.004), Response(0.9, 0.012)])
def test_response_passes_through_two_values(known: Response) -> None:
    """A known exponent and toe come back from the display values of two radiances."""
    shown = known.dark(np.array(PLACED)) ** (1 / 2.2)
    again = response_through(*shown)
    assert again.exponent == pytest.approx(known.exponent, abs=1e-6)
    assert again.toe == pytest.approx(known.toe, abs=1e-9)


def test_srgb_is_a_toe() -> None:
    """What sRGB shows, which gamma 2.2 decodes too dark, is met within a code and a half."""
    x = np.geomspace(0.003, GREY, 30)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    placed = np.array(PLACED)
    ends = np.where(placed <= 0.0031308, 12.92 * placed, 1.055 * placed ** (1 / 2.4) - 0.055)
    shown = response_through(*ends).dark(x) ** (1 / 2.2)
    np.testing.assert_allclose(255.0 * shown, 255.0 * encoded, atol=1.5)


def test_words_and_numbers_decide() -> None:
    """``off`` leaves it out, a number is taken as it is."""
    photo = ramp(0.0, 1.0)
    assert estimate_look(photo, photo, None, "off", "off", "off").response is None
    given = estimate_look(photo, photo, None, "off", "off", 1.4)
    assert given.response == Response(1.4) and given.record()["response"]["black"] is None
    auto = estimate_look(photo, photo, None, "off", "off", "auto")
    assert auto.response is not None and len(auto.lines()) == 1
    assert auto.response.black is not None and auto.response.black < 0.02
