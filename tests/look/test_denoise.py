"""Open Image Denoise on the object's radiance and the shadow ratio, where it is installed."""

import numpy as np
import pytest

from warpir.core.arrays import FloatArray, IntArray
from warpir.look import denoise
from warpir.look.denoise import Window, denoised_object, denoised_ratio

needs_oidn = pytest.mark.skipif(
    denoise.denoiser_version() is None, reason="pyoidn is not installed"
)
SIZE = (80, 100)
NONE = np.zeros(0, np.int32)


def disc() -> tuple[IntArray, FloatArray]:
    """Pixels of a disc, and their coverage: half at its rim."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    distance = np.hypot(y - 40, x - 50)
    mask = np.clip(25.5 - distance, 0.0, 1.0).astype(np.float32)
    pixels = np.flatnonzero(mask.reshape(-1) > 0.0).astype(np.int32)
    return pixels, mask.reshape(-1)[pixels]


def test_window_holds_its_pixels() -> None:
    """Values come back where they were, and the border of the picture cuts the margin."""
    pixels = np.array([3, 105, 7999], np.int32)
    window = Window.around(pixels, *SIZE)
    assert window.corner == (0, 0) and window.shape == SIZE
    values = np.arange(9, dtype=np.float32).reshape(3, 3)
    plane = window.spread(values, outside=-1.0)
    np.testing.assert_array_equal(plane.reshape(-1, 3)[pixels], values)
    assert (plane == -1.0).sum() == plane.size - 9
    np.testing.assert_array_equal(window.gather(plane), values)
    small = Window.around(np.array([40 * 100 + 50], np.int32), *SIZE)
    assert small.shape == (2 * denoise.MARGIN + 1,) * 2


def test_no_shadow_needs_no_network() -> None:
    """Nothing to filter comes back as it is."""
    nothing = np.zeros((0, 3), np.float32)
    assert denoised_ratio(nothing, NONE, NONE, SIZE) is nothing
    pixels = np.array([5], np.int32)
    part = np.ones((1, 3), np.float32)
    bare = denoised_object((part,), np.zeros(1, np.float32), part, part, pixels, SIZE)
    assert bare[0] is part


@needs_oidn
def test_noise_of_an_object_is_taken_out() -> None:
    """Half the error or less, the rim keeps its colour, and the same bytes come again."""
    pixels, mask = disc()
    rng = np.random.default_rng(0)
    albedo = np.where((pixels % 100 < 50)[:, None], [0.8, 0.3, 0.2], [0.2, 0.4, 0.7])
    clean = (albedo * mask[:, None]).astype(np.float32)
    noisy = (clean * rng.gamma(9.0, 1.0 / 9.0, clean.shape)).astype(np.float32)
    normal = np.tile([0.0, 0.0, 1.0], (len(pixels), 1)).astype(np.float32)
    guides = albedo.astype(np.float32), normal
    (found,) = denoised_object((noisy,), mask, *guides, pixels, SIZE)
    rms = np.sqrt(((noisy - clean) ** 2).mean())
    assert np.sqrt(((found - clean) ** 2).mean()) < 0.5 * rms
    rim = (mask < 0.9) & (mask > 0.1)
    assert np.abs((found - clean)[rim]).mean() < 0.8 * np.abs((noisy - clean)[rim]).mean()
    again = denoised_object((noisy,), mask, *guides, pixels, SIZE)[0]
    np.testing.assert_array_equal(again, found)


@needs_oidn
def test_noise_of_a_shadow_is_taken_out() -> None:
    """Half the error or less; what is exactly 1 stays exactly 1, and nothing exceeds 1."""
    pixels, share = disc()
    clean = (1.0 - 0.6 * share)[:, None] * np.ones((1, 3), np.float32)
    noise = 0.08 * np.random.default_rng(1).normal(size=clean.shape)
    noisy = np.clip(clean + noise, 0.0, 1.0).astype(np.float32)
    assert (noisy == 1.0).any()
    found = denoised_ratio(noisy, pixels, NONE, SIZE)
    assert (found[noisy == 1.0] == 1.0).all() and found.max() <= 1.0 and found.min() >= 0.0
    below = noisy < 1.0
    before, after = (np.sqrt(((r - clean)[below] ** 2).mean()) for r in (noisy, found))
    assert after < 0.5 * before


@needs_oidn
def test_shadow_beside_the_object_stays_dark() -> None:
    """Lit ground that the object hides gave what it does not cover of its rim 0.03 of light."""
    distance = np.hypot(*(np.indices(SIZE) - np.reshape((40, 50), (2, 1, 1)))).reshape(-1)
    covered, around = distance < 15.3, (distance >= 15.3) & (distance < 30.0)
    pixels, hidden = (np.flatnonzero(p).astype(np.int32) for p in (around, covered))
    noise = 0.1 * np.random.default_rng(0).normal(size=(len(pixels), 1))
    noisy = (np.clip(0.3 + noise, 0.0, 0.9) * np.ones((1, 3))).astype(np.float32)
    found = denoised_ratio(noisy, pixels, hidden, SIZE)
    beside = distance[pixels] < 16.3
    assert abs(float((found - noisy)[beside].mean())) < 0.01
