"""The blur of a photo by its texture: made-up pictures, large ones, and written weights."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sharpness import fit
from warpir.core.errors import ExitCode, InputError
from warpir.look import texture
from warpir.look.sharpness import gaussian
from warpir.look.texture import answers, statistics, texture_blur


@pytest.fixture
def other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Another file of weights in place of the package's."""
    path = tmp_path / "texture.safetensors"
    monkeypatch.setattr(texture, "WEIGHTS", path)
    texture._network.cache_clear()
    yield path
    texture._network.cache_clear()


@pytest.mark.parametrize("blur", [0.3, 0.8, 1.4])
def test_blur_of_made_up_pictures_is_found(blur: float) -> None:
    """Of pictures that were not learned from: within .15 px in the mean, no step being sought."""
    rng = np.random.default_rng(12345)
    pictures = [gaussian(fit.leaves(150, 220, rng), blur) for _ in range(12)]
    found = np.array([texture_blur(picture) for picture in pictures])
    assert np.abs(found - blur).mean() < 0.15


def test_region_tells_first() -> None:
    """Left sharp, right soft: each half is told as it is."""
    rng = np.random.default_rng(7)
    sharp, soft = fit.leaves(150, 150, rng), gaussian(fit.leaves(150, 150, rng), 2.0)
    image = np.concatenate([sharp, soft], axis=1)
    left = np.zeros(image.shape[:2], bool)
    left[:, :150] = True
    assert texture_blur(image, left) < texture_blur(image, ~left) - 0.2
    assert texture_blur(image, np.zeros_like(left)) == texture_blur(image)


def test_large_photo_is_seen_in_parts() -> None:
    """A picture that repeats has the statistics of its tile, but for the seams and the border."""
    tile = gaussian(fit.leaves(128, 128, np.random.default_rng(3)), 0.7)
    small, large = np.tile(tile, (3, 3, 1)), np.tile(tile, (9, 11, 1))
    seen = statistics(small, None), statistics(large, None)
    assert np.abs(seen[0] - seen[1]).max() < 0.1
    assert texture_blur(large) == pytest.approx(texture_blur(small), abs=0.05)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (5, 300), (600, 4)])
def test_nothing_to_see_is_no_fault(value: float, size: tuple[int, int]) -> None:
    """Even, clipped and tiny pictures give a finite blur."""
    assert 0.0 <= texture_blur(np.full((*size, 3), value, np.float32)) < 4.0


@pytest.mark.parametrize("content", [None, b"", b"no weights"])
def test_damaged_package_is_told_in_a_line(other_weights: Path, content: bytes | None) -> None:
    """Weights that are absent or cut: their file, and the status of a faulty model."""
    if content is not None:
        other_weights.write_bytes(content)
    with pytest.raises(InputError, match=r"texture\.safetensors") as raised:
        texture_blur(np.full((64, 64, 3), 0.5, np.float32))
    assert raised.value.code == ExitCode.MODEL


def test_written_weights_are_those_that_were_trained(
    other_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was learned from statistics that tell the blur is told again by the file."""
    rng = np.random.default_rng(0)
    given = rng.normal(size=(600, 118))
    blur = 1.0 + 0.3 * given[:, 5] - 0.2 * given[:, 90]
    told = [(float(b), row) for b, row in zip(blur, given, strict=True)]
    monkeypatch.setattr(fit, "samples", lambda places: iter(told))
    monkeypatch.setattr(fit, "STEPS", 400)
    fit.fit([], other_weights)
    assert np.abs(answers(given) - blur).mean() < 0.1
