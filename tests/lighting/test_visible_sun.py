"""A sun in the photo: what counts as one, where it is, and what it does to the regressed light."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.builders.shapes import a_regression, box_before, even_ambient, view_rays
from warpir.app.config import InsertConfig
from warpir.core.color import luminance
from warpir.lighting import estimate
from warpir.lighting.regression import Regression
from warpir.lighting.visible_sun import (
    LOG_RATIO,
    LOG_TOTAL,
    PROBABILITY_MIN,
    find_spots,
    probability,
    with_sun,
    with_visible_sun,
)
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.light import SUN_RADIUS_DEG, axis_from_angles, fibonacci

WIDTH, HEIGHT = 288, 192
FLIP = np.array([-1.0, 1.0, 1.0])
Picture = NDArray[np.float32]


def camera_of(pitch: float = 5.0, width: int = WIDTH) -> Camera:
    return camera_from_fov(width, round(width / 1.5), 70.0, pitch, 1.6)


def regression_of(seed: int | None = None) -> Regression:
    """A regression that knows no direction, or is wrong about it, at random."""
    plain = a_regression(
        axis=axis_from_angles(150.0, 40.0),
        spread_deg=40.0,
        concentration=2.0,
        sun=np.array([1.2, 1.0, 0.8]),
        sun_log_std=0.7,
        sigma=0.1,
        share=0.2,
        ambient=even_ambient(0.3),
        ambient_log_std=0.4,
    )
    if seed is None:
        return plain
    count = len(plain.directions)
    return replace(plain, probability=np.random.default_rng(seed).dirichlet(np.full(count, 0.3)))


def rays_of(camera: Camera) -> NDArray[np.float64]:
    return view_rays(camera).reshape(camera.height, camera.width, 3)


def photo_of(radiance: NDArray[np.float64]) -> Picture:
    """8 bits, clipped."""
    shown = np.clip(radiance, 0.0, 1.0) ** (1.0 / 2.2)
    return (np.round(255.0 * shown) / 255.0).astype(np.float32)


def glow(rays: NDArray[np.float64], axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radiance of a sun as a camera spreads it: a disc far beyond white, and a falling glow."""
    angle = np.degrees(np.arccos(np.clip(rays @ axis, -1.0, 1.0)))
    disc = np.where(angle < 0.3, 1e4, 0.0)
    spread = 3.0 / (angle**2 + 0.5) + 0.25 * np.exp(-angle / 12.0)
    return (disc + spread)[..., None]


def sky(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """A blue sky over dark ground, radiance."""
    above = np.array([0.12, 0.2, 0.35]) * (1.0 + 0.4 * (1.0 - np.abs(rays[..., 1:2])))
    return np.where(rays[..., 1:2] > 0.0, above, np.array([0.08, 0.07, 0.05]))


def sunny(camera: Camera, axis: NDArray[np.float64]) -> Picture:
    rays = rays_of(camera)
    lit = rays[..., 1:2] > 0.0
    return photo_of(sky(rays) + np.where(lit, glow(rays, axis), 0.0))


def angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.degrees(2.0 * np.arcsin(min(0.5 * np.linalg.norm(a - b), 1.0))))


@pytest.mark.parametrize("pitch", [-8.0, 5.0, 25.0])
@pytest.mark.parametrize("place", [(0.2, 0.15), (0.5, 0.1), (0.8, 0.2)])
def test_sun_is_found_where_it_is(pitch: float, place: tuple[float, float]) -> None:
    """A sun with glare, clipped, of a camera that looks up or down: within half a degree."""
    camera = camera_of(pitch)
    _, axis = camera.ray(place[0] * WIDTH, place[1] * HEIGHT)
    assert axis[1] > 0.02
    seen = with_visible_sun(regression_of(), sunny(camera, axis), camera)
    assert seen.sun_in_view is not None and seen.sun_in_view >= PROBABILITY_MIN
    assert angle_deg(seen.axis, axis) < 0.5


def test_size_of_the_photo_does_not_count() -> None:
    """The same view at three sizes gives the same sun."""
    small, middle, large = (camera_of(5.0, width) for width in (288, 600, 1500))
    _, axis = small.ray(0.4 * WIDTH, 0.2 * HEIGHT)
    found = [with_visible_sun(regression_of(), sunny(c, axis), c) for c in (small, middle, large)]
    assert all(angle_deg(seen.axis, axis) < 0.5 for seen in found)


def test_mirrored_photo_has_the_mirrored_sun() -> None:
    """Same probability; direction and spot with the other sign of x."""
    camera = camera_of()
    _, axis = camera.ray(0.3 * WIDTH, 0.22 * HEIGHT)
    photo = sunny(camera, axis)
    flipped = np.ascontiguousarray(photo[:, ::-1])
    seen, other = (with_visible_sun(regression_of(), p, camera) for p in (photo, flipped))
    np.testing.assert_allclose(other.axis, seen.axis * FLIP, atol=1e-9)
    assert seen.sun_in_view is not None and other.sun_in_view is not None
    assert math.isclose(seen.sun_in_view, other.sun_in_view, rel_tol=1e-6)


def wall(camera: Camera) -> Picture:
    """A room with a white wall that takes up a third of the photo."""
    radiance = np.full((HEIGHT, WIDTH, 3), 0.2)
    radiance[10:120, 30:150] = 2.0
    return photo_of(radiance)


def window(camera: Camera) -> Picture:
    """A dark room with a clipped window."""
    radiance = np.full((HEIGHT, WIDTH, 3), 0.05)
    radiance[30:55, 120:142] = 3.0
    return photo_of(radiance)


def clouds(camera: Camera) -> Picture:
    """A blue sky with clouds of which several are clipped."""
    rays = rays_of(camera)
    radiance = sky(rays)
    for u, v, wide, high in ((60, 40, 18, 6), (150, 25, 25, 9), (230, 60, 20, 7)):
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        inside = ((x - u) / wide) ** 2 + ((y - v) / high) ** 2
        radiance = radiance + 1.3 * np.exp(-0.5 * inside**2)[..., None]
    return photo_of(radiance)


def overcast(camera: Camera) -> Picture:
    """A white sky, clipped as a whole."""
    return photo_of(np.where(rays_of(camera)[..., 1:2] > 0.0, 1.4, 0.1) * np.ones(3))


def glint(camera: Camera) -> Picture:
    """Wet ground that mirrors a sun above the picture."""
    rays = rays_of(camera)
    return photo_of(sky(rays) + glow(rays, camera.ray(0.5 * WIDTH, 0.75 * HEIGHT)[1]))


def stars(camera: Camera) -> Picture:
    """A night with a few clipped pixels."""
    radiance = np.full((HEIGHT, WIDTH, 3), 0.01)
    radiance[20:60:9, 15:270:31] = 2.0
    return photo_of(radiance)


def black(camera: Camera) -> Picture:
    return photo_of(np.zeros((HEIGHT, WIDTH, 3)))


@pytest.mark.parametrize("paint", [wall, window, clouds, overcast, glint, stars, black])
@pytest.mark.parametrize("seed", [None, 1])
def test_other_clipped_parts_are_no_sun(paint, seed: int | None) -> None:  # type: ignore[no-untyped-def]
    """Walls, windows, clouds, glints below the horizon: the very same object comes back."""
    camera, regression = camera_of(), regression_of(seed)
    assert with_visible_sun(regression, paint(camera), camera) is regression


def test_glint_would_be_a_sun_above_the_horizon() -> None:
    """The control of the test above: the same picture, by a camera that looks up."""
    low, high = camera_of(5.0), camera_of(60.0)
    photo = glint(low)
    assert not [s for s in find_spots(photo, low) if s.axis[1] > 0.0]
    assert max(probability(s, regression_of()) for s in find_spots(photo, high)) > 0.5


def test_moon_that_glares_is_found() -> None:
    """A moon at night, long exposed: round, clipped, with its glow on the dark sky."""
    camera = camera_of(20.0)
    _, axis = camera.ray(0.6 * WIDTH, 0.3 * HEIGHT)
    rays = rays_of(camera)
    photo = photo_of((0.02 + glow(rays, axis)) * np.ones(3))
    assert angle_deg(with_visible_sun(regression_of(), photo, camera).axis, axis) < 0.5


def test_opinion_of_the_regressor_counts() -> None:
    """A spot where the regressor expects the sun is likelier than where it does not."""
    camera = camera_of()
    _, axis = camera.ray(0.3 * WIDTH, 0.22 * HEIGHT)
    spot = find_spots(sunny(camera, axis), camera)[0]
    regression = regression_of()
    toward, away = (
        replace(regression, probability=p / p.sum())
        for p in (np.exp(s * regression.directions @ axis) for s in (3.0, -3.0))
    )
    chances = [probability(spot, r) for r in (away, regression, toward)]
    assert chances == sorted(chances) and chances[0] < chances[2]


def test_light_takes_the_sun_over() -> None:
    """Direction and width are the sun's, colours stay, levels go toward those of suns in view."""
    axis, regression = axis_from_angles(20.0, 35.0), regression_of()
    seen = with_sun(regression, axis, 0.9, 0.4)
    np.testing.assert_array_equal(seen.probability @ seen.directions, axis)
    assert seen.spread_deg < 2.0 and seen.concentration > 1000.0
    assert math.isclose(seen.sigma, math.radians(SUN_RADIUS_DEG) / 2.0)
    np.testing.assert_allclose(seen.sun / seen.sun[1], regression.sun / regression.sun[1])

    def flux(r: Regression) -> tuple[float, float]:
        return float(luminance(r.sun)), float(luminance(r.ambient.flux().sum(axis=0)))

    (sun, rest), (was, around) = flux(seen), flux(regression)
    own, new = math.log((was + around) / 0.4), math.log((sun + rest) / 0.4)
    assert min(own, LOG_TOTAL) < new < max(own, LOG_TOTAL)
    assert math.isclose(seen.share, sun / (sun + rest), rel_tol=1e-5)
    # Between what the regressor says and what suns in view are.
    assert math.log(was / around) < math.log(sun / rest) < LOG_RATIO
    assert seen.sun_log_std < regression.sun_log_std


def test_lobes_of_the_sun_cast_its_irradiance() -> None:
    """The dominant lobe gives a surface that faces it what the regression says, from the sun."""
    axis = axis_from_angles(20.0, 35.0)
    seen = with_sun(regression_of(), axis, 0.9, 0.4)
    lobes = seen.lobes()
    near = fibonacci(400_000)
    near = near[near @ axis > math.cos(math.radians(2.0))]
    np.testing.assert_allclose(lobes.axis[0], axis, atol=1e-6)
    flux = 2.0 * math.pi * lobes.amplitude[0] / lobes.sharpness[0]
    np.testing.assert_allclose(flux, seen.sun, rtol=1e-4)


@pytest.mark.parametrize("doubt", [0.1, 3.0])
def test_sure_regressor_counts_for_more(doubt: float) -> None:
    """The ratio moves to that of suns in view the less the regressor is sure of its own."""
    regression = replace(regression_of(), sun_log_std=doubt, ambient_log_std=0.1)
    seen = with_sun(regression, axis_from_angles(20.0, 35.0), 0.9, 0.4)
    ratio = math.log(seen.share / (1.0 - seen.share))
    own = math.log(luminance(regression.sun) / luminance(regression.ambient.flux().sum(axis=0)))
    weight = (LOG_RATIO - ratio) / (LOG_RATIO - own)
    assert weight > 0.8 if doubt < 1.0 else weight < 0.05


@pytest.mark.parametrize("is_wanted", [True, False])
def test_run_says_that_it_saw_the_sun(is_wanted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The estimate takes the sun over and prints it; ``--no-visible-sun`` leaves the regression."""
    view, regression = camera_of(), regression_of()
    _, axis = view.ray(0.3 * WIDTH, 0.22 * HEIGHT)
    monkeypatch.setattr(estimate, "load_regressor", lambda path: None)
    monkeypatch.setattr(estimate, "regress", lambda network, photo, camera: regression)
    config = InsertConfig(out="o", demo=True, visible_sun=is_wanted)
    photo = sunny(view, axis)
    inputs = box_before(view, photo, np.round(255.0 * photo).astype(np.uint8))
    seen = estimate.estimate_light(inputs, config.light, config.tone_operator)
    assert ("the photo shows the sun" in seen.light.assumed[0]) == is_wanted
    assert (seen.regression is regression) != is_wanted
    assert (seen.regression.record()["sun_in_view"] is not None) == is_wanted
    assert seen.light.light.lobes is not None
    toward = seen.light.light.lobes.axis[0].astype(np.float64)
    assert (angle_deg(toward, axis) < 0.5) == is_wanted
