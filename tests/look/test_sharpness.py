"""The blur of edges: pictures blurred by a known Gaussian, and layers behind it."""

import numpy as np
import pytest
from scipy import ndimage

from warpir.core.arrays import FloatArray
from warpir.io.images.resize import resize
from warpir.look.camera_look import CameraLook, region_around
from warpir.look.sharpness import (
    PIXEL_SIGMA,
    EdgeBlur,
    blurred_layers,
    estimate_blur,
    gaussian,
    shown_box,
)

FINER = 6
"""Rows and columns of the ideal picture in a pixel."""


def boxes(sigma: float, seed: int = 0, height: int = 160, width: int = 240) -> FloatArray:
    """Turned boxes of random levels behind a Gaussian [px] and square pixels, [H, W, 3]."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0 : height * FINER, 0 : width * FINER]
    image = np.full(y.shape, 0.3, np.float32)
    for _ in range(12):
        turn, value = rng.uniform(0.0, np.pi), rng.uniform(0.05, 0.8)
        cx, cy = rng.uniform(0.0, 1.0, 2) * (width * FINER, height * FINER)
        half = rng.uniform(12, 40) * FINER
        across = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        along = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        image[(np.abs(across) < half) & (np.abs(along) < half)] = value
    if sigma > 0.0:
        image = ndimage.gaussian_filter(image, sigma * FINER)
    pixels = image.reshape(height, FINER, width, FINER).mean(axis=(1, 3))
    return np.repeat(pixels[..., None], 3, axis=2)


@pytest.mark.parametrize("sigma", [0.0, 0.5, 1.0, 1.6])
@pytest.mark.parametrize("noise", [0.0, 2.0])
def test_known_blur_is_found(sigma: float, noise: float) -> None:
    """Within .12 px, with two codes of noise too."""
    linear = boxes(sigma)
    codes = linear ** (1 / 2.2) + noise / 255.0 * np.random.default_rng(1).normal(size=linear.shape)
    found = estimate_blur(np.clip(codes, 0.0, 1.0) ** 2.2)
    assert found is not None and found.edges > 300
    assert found.sigma == pytest.approx(np.hypot(sigma, PIXEL_SIGMA), abs=0.12)


@pytest.mark.slow
def test_blur_beyond_the_derivatives_is_found() -> None:
    """Twice as blurred is told as more blurred, up to where nothing of the boxes is left."""
    found = [estimate_blur(boxes(sigma, height=320, width=480)) for sigma in (3.0, 4.5, 6.0)]
    sigmas = [blur.sigma for blur in found if blur is not None]
    assert sigmas == pytest.approx([3.0, 4.5, 6.0], rel=0.15)


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.3, 0.5, 1.6])
def test_blur_has_its_variance(sigma: float) -> None:
    """However small; a point keeps its sum."""
    point = np.zeros((31, 31), np.float32)
    point[15, 15] = 1.0
    seen = gaussian(point, sigma).astype(np.float64)
    assert seen.sum() == pytest.approx(1.0, abs=1e-5)
    rows = seen.sum(axis=1)
    assert (rows * (np.arange(31) - 15) ** 2).sum() == pytest.approx(sigma**2, rel=0.02)


def test_region_decides_where_it_has_edges() -> None:
    """Sharp left, soft right: each half has its own blur, and an empty region asks the photo."""
    image = np.concatenate([boxes(0.2), boxes(1.8)], axis=1)
    left = np.zeros(image.shape[:2], bool)
    left[:, :230] = True
    sharp, soft = estimate_blur(image, left), estimate_blur(image, ~left)
    assert sharp is not None and soft is not None
    assert sharp.sigma < 0.6 and soft.sigma > 1.4
    nowhere = estimate_blur(image, np.zeros_like(left))
    assert nowhere == estimate_blur(image)


def test_soft_scene_is_not_a_soft_lens() -> None:
    """Where edges differ the lens is not the softer ones; where they agree it is, however soft."""
    scene = np.concatenate([boxes(s, seed) for seed, s in enumerate((1.0, 2.0, 3.0))], axis=1)
    found, lens = estimate_blur(scene), estimate_blur(boxes(2.0))
    assert found is not None and lens is not None
    assert 0.58 < found.sigma < 1.3
    assert lens.sigma == pytest.approx(2.0, abs=0.12)


def test_part_with_few_steps_asks_the_whole_photo() -> None:
    """Some 70 edges of a soft part tell less than the hundreds beside it."""
    image = np.concatenate([boxes(0.2), boxes(1.8)], axis=1)
    part = np.zeros(image.shape[:2], bool)
    part[:60, 240:300] = True
    assert estimate_blur(image, part) == estimate_blur(image)


def test_texture_tells_where_no_step_does() -> None:
    """Of detail that is too faint for an edge: some blur, as a lens has, and 1 px at most."""
    noise = np.random.default_rng(2).normal(size=(160, 240))
    faint = 0.004 * sum(ndimage.gaussian_filter(noise, s) * s for s in (0.6, 1.2, 2.4, 4.8))
    found = estimate_blur(np.repeat(0.5 + faint[..., None], 3, axis=2))
    assert found is not None and found.edges == 0
    assert 0.1 < np.sqrt(found.sigma**2 - PIXEL_SIGMA**2) < 1.001


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
def test_no_edges_tell_nothing(value: float) -> None:
    """An even picture, black and white ones too."""
    assert estimate_blur(np.full((64, 64, 3), value)) is None


def test_layers_are_blurred_alike() -> None:
    """The outline keeps its colour, the contact shadow and mirror image; far ground stays as is."""
    matte = np.zeros((60, 60), np.float32)
    matte[20:40, 20:40] = 1.0
    colour = np.array([0.6, 0.3, 0.1], np.float32)
    ratio = np.ones((60, 60, 3), np.float32)
    ratio[36:44, 16:44] = 0.2
    planes = {"matte": matte, "foreground": matte[..., None] * colour, "shadow_ratio": ratio}
    planes["image"] = np.where((ratio < 1.0) & (matte[..., None] == 0.0), colour, np.float32(0.0))
    blurred = blurred_layers(planes, 1.2, ("foreground",))
    soft = blurred["matte"]
    assert soft.sum() == pytest.approx(matte.sum(), rel=1e-4)
    np.testing.assert_allclose(blurred["foreground"], soft[..., None] * colour, atol=1e-6)
    # Beside the object's foot the shadow is as dark as before: nothing leaks from under it.
    assert blurred["shadow_ratio"][41, 30].max() < 0.25
    assert (blurred["shadow_ratio"][:10] == 1.0).all()
    np.testing.assert_allclose(blurred["image"][39, 30], colour, rtol=0.02)
    assert 0.4 * colour[0] < blurred["image"][43, 30, 0] < 0.7 * colour[0]
    assert not blurred["image"][:10].any()
    assert blurred_layers(planes, 0.0, ("foreground",)) is planes


@pytest.mark.parametrize("middle", [(40, 50), (2, 3), (79, 118), (40, 0)])
@pytest.mark.parametrize("sigma", [0.3, 1.2, 4.0])
def test_a_part_is_blurred_as_the_whole(middle: tuple[int, int], sigma: float) -> None:
    """Pixels far from the object cost nothing, and no byte of any plane knows."""
    rng = np.random.default_rng(4)
    row, column = np.mgrid[0:80, 0:120]
    seen = np.hypot(row - middle[0], column - middle[1]) < 9
    matte = np.where(seen, rng.uniform(0.0, 1.0, seen.shape), 0.0).astype(np.float32)
    ratio = np.ones((80, 120, 3), np.float32)
    shaded = np.roll(seen, 4, axis=0)
    ratio[shaded] = rng.uniform(0.1, 1.0, (int(shaded.sum()), 3))
    planes = {"matte": matte, "foreground": matte[..., None] * ratio, "shadow_ratio": ratio}
    box = shown_box(planes, sigma)
    part, whole = (
        blurred_layers(given, sigma, ("foreground",))
        for given in ({name: plane[box] for name, plane in planes.items()}, planes)
    )
    for name, plane in planes.items():
        np.testing.assert_array_equal(part[name], whole[name][box], err_msg=name)
        whole[name][box] = plane[box]
        np.testing.assert_array_equal(whole[name], plane, err_msg=name)
    bare = {"matte": 0.0 * matte, "shadow_ratio": np.ones_like(ratio)}
    nothing = {name: plane[shown_box(bare, sigma)] for name, plane in bare.items()}
    assert nothing["matte"].size == 0
    assert blurred_layers(nothing, sigma, ()) is nothing


def test_nothing_is_sharpened() -> None:
    """An enlarged rendering is softer than the photo already."""
    look = CameraLook(blur=EdgeBlur(0.8, 100))
    assert look.blur_to_add() == pytest.approx(np.sqrt(0.64 - 1 / 12))
    assert look.blur_to_add(enlarged=4.0) == 0.0
    assert CameraLook(blur=EdgeBlur(0.1, 100)).blur_to_add() == 0.0


@pytest.mark.parametrize("larger", [2, 3, 4])
@pytest.mark.parametrize("sigma", [0.47, 0.6, 0.8, 1.2])
def test_what_is_averaged_down_is_as_sharp_as_the_photo(sigma: float, larger: int) -> None:
    """A step rendered larger has the blur that is asked for, within 6 %."""
    variance = 0.0
    for place in np.linspace(31.0, 32.0, 8, endpoint=False):
        step = np.clip(np.arange(64 * larger) + 1.0 - place * larger, 0.0, 1.0)
        step = resize(np.tile(step.astype(np.float32), (64 * larger, 1)), 64, 64)
        added = CameraLook(blur=EdgeBlur(sigma, 100)).blur_to_add(1.0 / larger)
        slope = np.diff(gaussian(step, added)[32].astype(np.float64))
        x = np.arange(63)
        variance += slope @ x**2 - (slope @ x) ** 2 - 1 / 12  # the difference blurs as a pixel does
    assert np.sqrt(variance / 8.0) == pytest.approx(sigma, rel=0.06)


def test_region_is_three_times_the_box() -> None:
    """Points behind the camera do not count; none at all mean everywhere."""
    points = np.array([[40.0, 30.0], [50.0, 40.0], [np.nan, np.nan]])
    region = region_around(points, 100, 60)
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    assert (rows[0], rows[-1], columns[0], columns[-1]) == (20, 49, 30, 59)
    assert region_around(points[2:], 10, 10).all()
