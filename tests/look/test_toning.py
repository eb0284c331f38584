"""The one curve of a black and white photo's colours: when it is believed, and what it tones."""

import io
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.color import GAMMA, luminance
from warpir.io.images.photos import Photo
from warpir.look.camera_look import CameraLook
from warpir.look.toning import KNOTS, LEAST, Toning, toning_of

Tone = Callable[[Float64Array], Float64Array]
TONES: dict[str, Tone] = {
    "sepia": lambda g: np.stack([g**0.85, g, g**1.25], axis=-1),
    "duotone": lambda g: np.array([0.1, 0.05, 0.3]) + g[..., None] * np.array([0.9, 0.88, 0.45]),
    "scan": lambda g: np.array([0.02, 0.01, 0.0]) + g[..., None] * np.array([0.97, 0.96, 0.93]),
}


def a_scene(low: float = 0.03, high: float = 0.97) -> Float64Array:
    """Display values with detail of all sizes, shape [256, 384]."""
    rng = np.random.default_rng(5)
    parts = [
        ndimage.gaussian_filter(rng.normal(size=(256, 384)), s, mode="wrap") * s**2
        for s in (1.0, 4.0, 16.0)
    ]
    rank = np.argsort(np.argsort(sum(parts), axis=None)).reshape(256, 384) / (256.0 * 384.0)
    return low + (high - low) * rank


def photo_of(shown: Float64Array, quality: int | None = None) -> Photo:
    """A photo of 8 bits, through a JPEG file where its quality is given."""
    codes = np.round(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)
    if quality is not None:
        file = io.BytesIO()
        Image.fromarray(codes).save(file, "JPEG", quality=quality)
        codes = np.asarray(Image.open(file))
    return Photo(codes, codes.astype(np.float32) / np.float32(255.0), "png")


def curve(shown: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return luminances of display values, display-linear, and the display values by them."""
    return np.asarray(luminance(shown**GAMMA)), shown


@pytest.mark.parametrize("quality", [90, None])
@pytest.mark.parametrize("name", TONES)
def test_toned_photo_tells_its_curve(name: str, quality: int | None) -> None:
    """Within three codes of the curve that it was toned by, over all levels it has."""
    tone = TONES[name]
    toning = toning_of(photo_of(tone(a_scene()), quality))
    assert toning is not None and not toning.is_grey
    grey, shown = curve(tone(np.linspace(0.05, 0.95, 19)))
    found = toning.colour(grey) ** (1.0 / GAMMA)
    np.testing.assert_allclose(found, shown, atol=3.0 / 255.0)


def _with_color(shown: Float64Array) -> Float64Array:
    patches = np.kron(np.random.default_rng(2).normal(size=(4, 6, 3)), np.ones((64, 64, 1)))
    return shown + 2.5 / 255.0 * patches


@pytest.mark.parametrize(
    "shown",
    [
        pytest.param(_with_color(TONES["sepia"](a_scene())), id="faint-colours"),
        pytest.param(TONES["sepia"](a_scene(0.4, 0.8)), id="one-material"),
        pytest.param(TONES["sepia"](np.tile(np.linspace(0.2, 0.8, 640), (256, 1))), id="backdrop"),
        pytest.param(np.full((256, 384, 3), 0.4), id="one-value"),
        pytest.param(TONES["sepia"](a_scene()[:6, :6]), id="tiny"),
    ],
)
def test_other_photos_are_in_colour(shown: Float64Array) -> None:
    """Colours of 2.5 codes, and scenes that show too little to tell a toning from a material."""
    assert toning_of(photo_of(shown)) is None


def test_linear_plate_is_grey_or_in_colour() -> None:
    """A renderer's plate is not toned by a laboratory."""
    linear = np.float32(TONES["sepia"](a_scene()) ** GAMMA)
    srgb = np.float32(TONES["sepia"](a_scene()))
    assert toning_of(Photo(linear, srgb, "exr")) is None
    grey = np.repeat(linear[..., :1], 3, axis=-1)
    toning = toning_of(Photo(grey, srgb, "exr"))
    assert toning is not None and toning.is_grey


@pytest.fixture
def toning() -> Toning:
    """That of the sepia photo."""
    found = toning_of(photo_of(TONES["sepia"](a_scene())))
    assert found is not None
    return found


def test_colour_keeps_the_luminance(toning: Toning) -> None:
    """To a hundredth of a stop, down to black, where it falls off in proportion."""
    grey = np.geomspace(2e-3, 0.9, 50)
    np.testing.assert_allclose(luminance(toning.colour(grey)), grey, rtol=0.02)
    dark = toning.colour(np.array([0.0, 0.1 * LEAST, LEAST]))
    np.testing.assert_array_equal(dark[0], 0.0)
    np.testing.assert_allclose(dark[1], 0.1 * dark[2], rtol=1e-5)
    plain = Toning(((0.0, 0.0, 0.0),) * KNOTS).colour(np.float32(grey))
    np.testing.assert_allclose(plain, np.repeat(grey[:, None], 3, axis=1), rtol=1e-6)


def planes(rng: np.random.Generator) -> dict[str, FloatArray]:
    """A coloured object over half of 8 x 8 pixels, and its shadow and mirror image beside it."""
    matte = np.zeros((8, 8), np.float32)
    matte[:4] = rng.uniform(0.2, 1.0, (4, 8))
    made = {
        name: np.float32(rng.uniform(0.0, 0.4, (8, 8, 3))) * matte[..., None]
        for name in ("diffuse", "specular", "emission")
    }
    made["foreground"] = made["diffuse"] + made["specular"] + made["emission"]
    ratio = np.ones((8, 8, 3), np.float32)
    ratio[4:6] = rng.uniform(0.3, 0.9, (2, 8, 3))
    mirror = np.zeros((8, 8, 3), np.float32)
    mirror[5:7] = rng.uniform(-0.02, 0.1, (2, 8, 3))
    return {**made, "matte": matte, "shadow_ratio": ratio, "mirror": mirror}


def test_object_shadow_and_mirror_image_are_toned(toning: Toning) -> None:
    """All that is shown lies on the curve, parts sum up, and nothing else is changed."""
    before = planes(np.random.default_rng(1))
    plate = toning.colour(np.random.default_rng(2).uniform(0.05, 0.9, (8, 8)))
    kept = {name: plane.copy() for name, plane in before.items()}
    after = CameraLook(toning=toning).coloured_like_photo(before, plate)
    for name, plane in kept.items():
        np.testing.assert_array_equal(before[name], plane)

    seen = after["matte"] > 0.0
    own = after["foreground"][seen] / after["matte"][seen][:, None]
    np.testing.assert_allclose(own, toning.colour(luminance(own)), rtol=0.02, atol=1e-4)
    summed = after["diffuse"] + after["specular"] + after["emission"]
    np.testing.assert_allclose(after["foreground"], summed, rtol=1e-4, atol=1e-7)
    grey = luminance(kept["foreground"][seen])
    np.testing.assert_allclose(luminance(after["foreground"][seen]), grey, rtol=0.02)

    ground = plate * after["shadow_ratio"] + after["mirror"]
    expected = luminance(plate) * luminance(kept["shadow_ratio"]) + luminance(kept["mirror"])
    np.testing.assert_allclose(ground, toning.colour(expected), rtol=0.03, atol=1e-4)
    untouched = (kept["shadow_ratio"] == 1.0).all(axis=-1)
    assert (after["shadow_ratio"][untouched] == 1.0).all()
    assert (after["mirror"][(kept["mirror"] == 0.0).all(axis=-1)] == 0.0).all()
