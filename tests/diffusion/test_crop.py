"""Crops around the object: box, sizes, places, resampling and its gradient."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from torch.nn.functional import interpolate

from tests.statistics import SIGNIFICANCE, sidak
from warpir.diffusion.crop import BOX_MIN, Crop, box_of, draw_crop
from warpir.diffusion.settings import GuidanceSettings

FLOAT32 = 2e-6
"""About ten float32 operations on values of order 1."""
FLOAT64 = 1e-12
"""About a hundred float64 operations on values of order 1 to 100."""
DRAWS = 4000


def image(
    rng: np.random.Generator, *shape: int, dtype: torch.dtype = torch.float64
) -> torch.Tensor:
    return torch.tensor(rng.random(shape), dtype=dtype)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_box_is_half_open_and_holds_the_object() -> None:
    """The box ends behind the last covered pixel; faint coverage counts."""
    mask = torch.zeros(9, 12)
    mask[2:5, 3:9] = 1.0
    assert box_of(mask) == (3, 2, 9, 5)
    mask[8, 11] = 1e-6
    assert box_of(mask) == (3, 2, 12, 9)
    assert box_of(torch.ones(4, 6)) == (0, 0, 6, 4)


def test_box_of_nothing_is_refused() -> None:
    """A mask without an object names itself."""
    with pytest.raises(ValueError, match="mask"):
        box_of(torch.zeros(4, 6))


@pytest.mark.parametrize(("length", "size"), [(48, 64), (64, 64), (97, 32), (40, 123)])
def test_whole_image_is_the_plain_resize(rng: np.random.Generator, length: int, size: int) -> None:
    """A square image as a whole is torch's antialiased bilinear resize, up or down."""
    picture = image(rng, 2, 3, length, length)
    ours = Crop(0.0, 0.0, float(length)).apply(picture, size)
    theirs = interpolate(picture, (size, size), mode="bilinear", antialias=True)
    torch.testing.assert_close(ours, theirs, rtol=0.0, atol=FLOAT64)


def test_whole_pixels_at_their_size_are_a_slice(rng: np.random.Generator) -> None:
    """A crop at whole pixels and scale 1 copies them bit for bit."""
    picture = image(rng, 1, 3, 20, 30, dtype=torch.float32)
    assert torch.equal(Crop(5.0, 3.0, 12.0).apply(picture, 12), picture[:, :, 3:15, 5:17])


@pytest.mark.parametrize("size", [16, 100, 512])
@pytest.mark.parametrize(
    "crop", [Crop(0.0, 0.0, 60.0), Crop(13.37, 7.77, 41.3), Crop(1.2, 3.4, 2.1)]
)
def test_constant_stays_constant(crop: Crop, size: int) -> None:
    """Weights add up to 1 everywhere, at the border too, so the range is kept."""
    picture = torch.full((1, 3, 64, 96), 0.7)
    torch.testing.assert_close(
        crop.apply(picture, size), torch.full((1, 3, size, size), 0.7), rtol=FLOAT32, atol=0.0
    )


@pytest.mark.parametrize("size", [7, 100])
def test_ramp_stays_a_ramp(size: int) -> None:
    """Values are read at ``x + (i + 0.5) side / size``: pixel centres at +0.5, axes not swapped."""
    xs = torch.arange(96, dtype=torch.float64) + 0.5
    ys = torch.arange(64, dtype=torch.float64) + 0.5
    picture = torch.stack([xs.expand(64, 96), ys[:, None].expand(64, 96)])[None]
    crop = Crop(21.3, 10.9, 37.7)
    steps = (torch.arange(size, dtype=torch.float64) + 0.5) * 37.7 / size
    expected = torch.stack(
        [(21.3 + steps).expand(size, size), (10.9 + steps)[:, None].expand(size, size)]
    )[None]
    if size < 37.7:
        # A filter wider than a pixel sees the ramp at whole pixels: exact only on average.
        found = crop.apply(picture, size)
        assert (found - expected).abs().max() < 0.05
        torch.testing.assert_close(found.mean(), expected.mean(), rtol=1e-3, atol=0.0)
    else:
        torch.testing.assert_close(crop.apply(picture, size), expected, rtol=0.0, atol=FLOAT64)


@pytest.mark.parametrize("crop", [Crop(0.0, 0.0, 8.0), Crop(3.3, 1.1, 5.7), Crop(2.5, 0.25, 3.9)])
@pytest.mark.parametrize("size", [3, 16])
def test_crop_passes_gradients(rng: np.random.Generator, crop: Crop, size: int) -> None:
    """Central differences agree on an 8 x 12 image: 256 x 384 at 1/32, enlarged and shrunk."""
    picture = image(rng, 1, 2, 8, 12).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: crop.apply(x, size), (picture,))


def test_side_is_log_uniform_and_centre_uniform() -> None:
    """Kolmogorov-Smirnov on the side between 0.5 and 3 box sides and the centre in the box."""
    box, size = (180, 120, 220, 150), (256, 384)  # 3 x 40 px fit around every point of the box
    g = generator()
    crops = [draw_crop(box, size, GuidanceSettings(), g) for _ in range(DRAWS)]
    shares = [math.log(c.side / 20.0) / math.log(120.0 / 20.0) for c in crops]
    xs = [(c.x + c.side / 2 - 180) / 40 for c in crops]
    ys = [(c.y + c.side / 2 - 120) / 30 for c in crops]
    for numbers in (shares, xs, ys):
        assert stats.kstest(numbers, "uniform").pvalue > sidak(SIGNIFICANCE, 6)
    for first, second in ((shares, xs), (shares, ys), (xs, ys)):
        assert stats.pearsonr(first, second).pvalue > sidak(SIGNIFICANCE, 6)


@pytest.mark.parametrize(
    "box",
    [
        (0, 0, 40, 30),  # in the corner
        (350, 200, 384, 256),  # in the other corner
        (0, 0, 384, 256),  # the whole image
        (100, 255, 101, 256),  # one pixel on the border
        (10, 100, 380, 140),  # wider than the image is high
    ],
)
def test_crop_stays_inside(box: tuple[int, int, int, int]) -> None:
    """No crop leaves the image or its range of sides, and each touches the box."""
    settings = GuidanceSettings()
    longer = max(box[2] - box[0], box[3] - box[1], BOX_MIN)
    g = generator(1)
    for _ in range(300):
        crop = draw_crop(box, (256, 384), settings, g)
        assert crop.x >= 0.0 and crop.x + crop.side <= 384.0 + 1e-9
        assert crop.y >= 0.0 and crop.y + crop.side <= 256.0 + 1e-9
        assert min(0.5 * longer, 256.0) - 1e-9 <= crop.side <= min(3.0 * longer, 256.0) + 1e-9
        assert crop.x < box[2] and crop.x + crop.side > box[0]
        assert crop.y < box[3] and crop.y + crop.side > box[1]
        assert crop.apply(torch.ones(1, 1, 256, 384), 16).isfinite().all()


def test_range_of_sides_is_chosen() -> None:
    """Equal limits give one side; an image smaller than every crop is taken as a whole."""
    settings = replace(GuidanceSettings(), crop_min=2.0, crop_max=2.0)
    crop = draw_crop((100, 100, 130, 120), (256, 384), settings, generator())
    assert crop.side == pytest.approx(60.0)
    assert draw_crop((2, 2, 7, 7), (8, 8), GuidanceSettings(), generator()) == Crop(0, 0, 8)


def test_draw_depends_on_the_seed_alone() -> None:
    """Equal seeds give equal crops; each draw takes as many numbers, whatever the box."""
    one, other = generator(7), generator(7)
    first = draw_crop((10, 10, 50, 50), (256, 384), GuidanceSettings(), one)
    assert first == draw_crop((10, 10, 50, 50), (256, 384), GuidanceSettings(), other)
    assert first != draw_crop((10, 10, 50, 50), (256, 384), GuidanceSettings(), one)
    draw_crop((0, 0, 384, 256), (256, 384), GuidanceSettings(), other)
    assert torch.rand(1, generator=one) == torch.rand(1, generator=other)


@pytest.mark.parametrize(
    ("height", "width"),
    [pytest.param(61, 97, id="I15-61x97"), pytest.param(33, 31, id="I15-33x31")],
)
def test_odd_sizes_need_no_padding(rng: np.random.Generator, height: int, width: int) -> None:
    """The model sees a square of its own resolution; the gradient has the photo's size."""
    picture = image(rng, 1, 3, height, width).requires_grad_()
    mask = torch.zeros(height, width)
    mask[10:21, 7:26] = 1.0
    crop = draw_crop(box_of(mask), (height, width), GuidanceSettings(), generator())
    seen = crop.apply(picture, 64)
    assert seen.shape == (1, 3, 64, 64)
    seen.sum().backward()
    assert picture.grad is not None and picture.grad.shape == picture.shape
    outside = torch.ones(height, width, dtype=torch.bool)
    reach = [(max(int(a) - 1, 0), int(a + crop.side) + 2) for a in (crop.y, crop.x)]
    outside[slice(*reach[0]), slice(*reach[1])] = False
    assert not picture.grad[0, :, outside].any()
