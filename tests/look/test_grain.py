"""Grain: drawn with known strength, size and correlation, found again, and put on the object."""

from dataclasses import replace

import numpy as np
import pytest
from skimage import data

from warpir.core.arrays import Float64Array
from warpir.core.color import gamma_to_linear, linear_to_gamma, luminance
from warpir.look.camera_look import estimate_look
from warpir.look.grain import EXCESS, Grain, as_told, estimate_grain, grain_over
from warpir.look.texture import Texture


def clean(height: int = 300, width: int = 400) -> Float64Array:
    """A smooth picture with all levels and a few edges, display values, [H, W, 3]."""
    y, x = np.mgrid[0:height, 0:width]
    ramp = 0.15 + 0.7 * x / width
    picture = np.stack([ramp, 0.9 * ramp, 0.8 * ramp + 0.1 * y / height], axis=-1)
    picture[100:140, 50:350] *= 0.6
    return picture


def noisy(grain: Grain, seed: int = 0) -> Float64Array:
    """The same through a sensor of 8 bits."""
    picture = clean()
    shown = picture + grain.deviation(picture) * grain.draw(picture.shape[:2], seed)
    return np.round(255.0 * np.clip(shown, 0.0, 1.0)) / 255.0


@pytest.mark.parametrize("codes", [1.5, 4.0, 8.0])
@pytest.mark.parametrize(("size", "correlation"), [(0.0, 0.0), (0.6, 0.5)])
def test_known_grain_is_found(codes: float, size: float, correlation: float) -> None:
    """Strength within 12 %, size within .15 px, correlation within .15."""
    found = estimate_grain(noisy(Grain((0.5,), ((codes / 255.0,) * 3,), size, correlation), seed=3))
    assert found is not None
    rounding = 1.0 / 12.0  # of codes
    assert 255.0 * found.typical == pytest.approx(np.hypot(codes, rounding**0.5), rel=0.12)
    assert found.size == pytest.approx(size, abs=0.15)
    assert found.correlation == pytest.approx(correlation, abs=0.15)


def test_strength_follows_the_level() -> None:
    """A sensor with twice the noise in the dark, as far as `EXCESS` lets levels differ."""
    true = Grain((0.15, 0.85), ((5 / 255,) * 3, (4 / 255,) * 3), 0.0, 0.0)
    found = estimate_grain(noisy(true))
    assert found is not None
    dark, bright = found.deviation(np.array([[0.2] * 3, [0.75] * 3])).mean(axis=1) * 255.0
    assert dark == pytest.approx(4.9, abs=0.6) and bright == pytest.approx(4.1, abs=0.5)
    assert dark > bright


def test_a_clean_picture_has_none() -> None:
    """Eight bits of a smooth ramp show rounding alone."""
    assert estimate_grain(np.round(255.0 * clean()) / 255.0) is None
    assert estimate_grain(np.zeros((8, 8, 3))) is None


def test_texture_decides_the_strength() -> None:
    """Levels, channels and size stay; grain that patches do not show is told too, none is none."""
    flat = Grain((0.2, 0.8), ((0.01, 0.02, 0.03), (0.02, 0.02, 0.02)), 0.7, 0.4)
    told = as_told(flat, 0.01 * flat.luminance_share)
    assert told is not None and told.of_luminance == pytest.approx(0.01 * flat.luminance_share)
    assert told.strength[0] == pytest.approx((0.005, 0.01, 0.015))
    assert (told.level, told.size, told.correlation) == (flat.level, 0.7, 0.4)
    posterised = replace(
        flat, level=(0.2, 0.4, 0.8), strength=((0.01,) * 3, (0.0,) * 3, (0.01,) * 3)
    )
    told = as_told(posterised, 0.02 * flat.luminance_share, is_recoded=True)
    assert told is not None and np.max(told.strength) == pytest.approx(0.02)
    # Flat patches show what a file has, but not what its coding took.
    most = 0.02 * flat.luminance_share
    told = as_told(flat, 2.0 * most)
    assert told is not None and told.of_luminance == pytest.approx(EXCESS * most)
    told = as_told(flat, 2.0 * most, is_recoded=True)
    assert told is not None and told.of_luminance == pytest.approx(2.0 * most)
    for is_grey in (False, True):
        alone = as_told(None, 0.012, is_grey)
        assert alone is not None and alone.of_luminance == pytest.approx(0.012)
        assert alone.correlation == is_grey
    assert as_told(flat, 0.0005) is None


def test_grey_photo_without_flat_patches_has_the_told_grain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In a channel as much as in the luminance, since all are drawn alike."""
    texture = Texture(0.0, 2.0 / 255.0)
    monkeypatch.setattr("warpir.look.camera_look.read_texture", lambda *_: texture)
    photo = np.zeros((90, 90, 3), np.float32)
    grain = estimate_look(photo, photo, None, "off").grain
    assert grain is not None and 255.0 * grain.typical == pytest.approx(2.0)


@pytest.mark.parametrize("codes", [10.0, 16.0, 24.0])
def test_heavy_grain_is_that_of_flat_patches(codes: float) -> None:
    """The texture tells no more than about 4 codes of any; within a tenth."""
    photo = noisy(Grain((0.5,), ((codes / 255.0,) * 3,), 0.4, 0.5)).astype(np.float32)
    found = estimate_look(photo, gamma_to_linear(photo), None, "off").grain
    assert found is not None and 255.0 * found.typical == pytest.approx(codes, rel=0.1)


def test_texture_of_some_levels_is_no_heavy_grain() -> None:
    """Rock and leaves look as grainy, but dark water among them does not; grain is everywhere."""
    rock = Grain((0.1, 0.4, 0.6), ((0.009,) * 3, (0.05,) * 3, (0.055,) * 3), 0.6, 0.95)
    told = as_told(rock, 4.0 / 255.0)
    assert told is not None and 255.0 * told.of_luminance == pytest.approx(4.0)
    grainy = replace(rock, strength=((0.04,) * 3, (0.05,) * 3, (0.055,) * 3))
    found = as_told(grainy, 4.0 / 255.0)
    assert found is not None and found.strength[:2] == grainy.strength[:2]
    assert found.strength[2] == pytest.approx((EXCESS * 0.04,) * 3)


def test_lawn_is_no_heavy_grain() -> None:
    """Grass fills the photo, and no patch of it is flat: 26 codes by these alone."""
    grass = np.repeat(data.grass()[..., None], 3, axis=2).astype(np.float32) / 255.0
    flat = estimate_grain(grass)
    assert flat is not None and 255.0 * flat.of_luminance > 20.0
    found = estimate_look(grass, gamma_to_linear(grass), None, "off").grain
    assert found is not None and 255.0 * found.of_luminance < 4.0


@pytest.mark.parametrize("correlation", [0.0, 0.3, 1.0])
def test_luminance_has_its_share_of_the_grain(correlation: float) -> None:
    """Of drawn noise on mid grey, within 3 %."""
    grain = Grain((0.5,), ((0.01,) * 3,), 0.4, correlation)
    shown = 0.4 + 0.01 * grain.draw((300, 300), 2)
    seen = linear_to_gamma(luminance(gamma_to_linear(shown)))
    assert seen.std() == pytest.approx(grain.of_luminance, rel=0.03)


def test_drawn_grain_has_unit_variance() -> None:
    """For every size, and the seed decides every byte."""
    for size in (0.0, 0.5, 1.0):
        grain = Grain((0.5,), ((0.01,) * 3,), size, 0.4)
        noise = grain.draw((200, 200), 5)
        assert noise.std() == pytest.approx(1.0, abs=0.03)
        assert np.corrcoef(noise.reshape(-1, 3).T)[0, 1] == pytest.approx(0.4, abs=0.05)
        assert (noise == grain.draw((200, 200), 5)).all()
        assert (noise != grain.draw((200, 200), 6)).any()


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (1, 60), (6, 6)])
def test_few_pixels_have_no_more_grain_than_many(shape: tuple[int, int]) -> None:
    """An object far away: the filter met itself round the edge, up to seven times the grain."""
    grain = Grain((0.5,), ((0.01,) * 3,), 2.0, 0.4)
    power = np.mean([(grain.draw(shape, seed) ** 2).mean() for seed in range(600)])
    assert power**0.5 == pytest.approx(1.0, abs=0.08)


def test_object_gets_grain_and_ground_what_it_lacks() -> None:
    """Full strength on the object, next to nothing on ground that kept the photo's, 0 elsewhere."""
    grain = Grain((0.5,), ((0.02,) * 3,), 0.0, 0.0)
    plate = np.full((90, 90, 3), 0.2, np.float32)
    matte = np.zeros((90, 90), np.float32)
    matte[:30] = 1.0
    changed = np.zeros((90, 90), bool)
    changed[:60] = True
    added = grain_over(grain, plate, plate, matte, changed, 1, 2.2)
    shown = (plate + added) ** (1 / 2.2) - plate ** (1 / 2.2)
    assert shown[:30].std() == pytest.approx(0.02, rel=0.05)
    assert np.abs(shown[30:60]).max() < 1e-6 and (added[60:] == 0.0).all()
    # In the shadow the photo's grain is weaker than the sensor's would be there.
    shadow = np.where(matte[..., None] > 0.0, plate, 0.25 * plate).astype(np.float32)
    added = grain_over(grain, shadow, plate, matte, changed, 1, 2.2)
    shown = (shadow + added) ** (1 / 2.2) - shadow ** (1 / 2.2)
    kept = 0.25 ** (1 / 2.2)
    assert shown[30:60].std() == pytest.approx(0.02 * np.sqrt(1.0 - kept**2), rel=0.05)


def test_words_and_numbers_decide() -> None:
    """``off`` estimates nothing, a number is taken as it is."""
    photo = noisy(Grain((0.5,), ((4 / 255,) * 3,), 0.0, 0.0))
    off = estimate_look(photo, photo**2.2, None, "off", "off")
    assert off.blur is None and off.grain is None and off.lines() == []
    given = estimate_look(photo, photo**2.2, None, 1.5, 3.0)
    assert given.blur is not None and given.blur.sigma == 1.5
    assert given.grain is not None and 255.0 * given.grain.typical == pytest.approx(3.0)
    auto = estimate_look(photo, photo**2.2)
    assert auto.grain is not None and len(auto.lines()) == 2
