"""Blur and grain of a photo by its texture: made-up pictures, large ones, and written weights."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks.sharpness import fit
from tests.slow import slow
from warpir.core.color import gamma_to_linear, linear_to_gamma
from warpir.core.errors import ExitCode, InputError
from warpir.look import texture
from warpir.look.grain import Grain
from warpir.look.sharpness import gaussian
from warpir.look.texture import UNITS, answers, read_texture, statistics


@pytest.fixture
def other_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Another file of weights in place of the package's."""
    path = tmp_path / "texture.safetensors"
    monkeypatch.setattr(texture, "WEIGHTS", path)
    texture._network.cache_clear()
    yield path
    texture._network.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize("blur", [0.3, 0.8, 1.4])
def test_blur_of_made_up_pictures_is_found(blur: float) -> None:
    """Of pictures that were not learned from: within .15 px in the mean, no step being sought."""
    rng = np.random.default_rng(12345)
    pictures = [gaussian(fit.leaves(150, 220, rng), blur) for _ in range(12)]
    found = np.array([read_texture(picture).blur for picture in pictures])
    assert np.abs(found - blur).mean() < 0.15


@pytest.mark.parametrize("codes", [2.0, *slow(0.0, 5.0)])
def test_grain_of_made_up_pictures_is_found(codes: float) -> None:
    """However textured: within half a code or a quarter in the mean."""
    rng = np.random.default_rng(54321)
    grain = Grain((0.5,), ((codes / 255.0,) * 3,), 0.5, 0.3)
    found = []
    for _ in range(12):
        shown = linear_to_gamma(gaussian(fit.leaves(150, 220, rng), 0.6))
        shown = shown + grain.deviation(shown) * grain.draw(shown.shape[:2], len(found))
        photo = np.round(255.0 * np.clip(shown, 0.0, 1.0)) / 255.0
        found.append(read_texture(gamma_to_linear(photo)).grain)
    error = np.abs(np.array(found, float) - grain.of_luminance).mean()
    assert error < max(0.5 / 255.0, 0.25 * grain.of_luminance)


def test_region_tells_first() -> None:
    """Left sharp, right soft: each half is told as it is."""
    rng = np.random.default_rng(7)
    sharp, soft = fit.leaves(150, 150, rng), gaussian(fit.leaves(150, 150, rng), 2.0)
    image = np.concatenate([sharp, soft], axis=1)
    left = np.zeros(image.shape[:2], bool)
    left[:, :150] = True
    assert read_texture(image, left).blur < read_texture(image, ~left).blur - 0.2
    assert read_texture(image, np.zeros_like(left)) == read_texture(image)


def test_large_photo_is_seen_in_parts() -> None:
    """A picture that repeats has the statistics of its tile, but for the seams and the border."""
    tile = gaussian(fit.leaves(128, 128, np.random.default_rng(3)), 0.7)
    small, large = np.tile(tile, (3, 3, 1)), np.tile(tile, (9, 11, 1))
    seen = statistics(small, None), statistics(large, None)
    assert np.abs(seen[0] - seen[1]).max() < 0.1
    assert read_texture(large).blur == pytest.approx(read_texture(small).blur, abs=0.05)


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (5, 300), (600, 4), (63, 64), (64, 64)])
def test_nothing_to_see_is_no_fault(value: float, size: tuple[int, int]) -> None:
    """Even, clipped and tiny pictures give a finite blur and grain."""
    told = read_texture(np.full((*size, 3), value, np.float32))
    assert 0.0 <= told.blur < 4.0
    if min(size) < texture.SMALLEST:
        assert told.grain is None
    else:
        assert told.grain is not None and 0.0 <= told.grain < 0.05


@pytest.mark.parametrize("content", [None, b"", b"no weights"])
def test_damaged_package_is_told_in_a_line(other_weights: Path, content: bytes | None) -> None:
    """Weights that are absent or cut: their file, and the status of a faulty model."""
    if content is not None:
        other_weights.write_bytes(content)
    with pytest.raises(InputError, match=r"texture\.safetensors") as raised:
        read_texture(np.full((64, 64, 3), 0.5, np.float32))
    assert raised.value.code == ExitCode.MODEL


@pytest.mark.slow
def test_written_weights_are_those_that_were_trained(
    other_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was learned from statistics that tell blur and grain is told again by the file."""
    rng = np.random.default_rng(0)
    given = rng.normal(size=(600, 118))
    blur, grain = 1.0 + 0.3 * given[:, 5] - 0.2 * given[:, 90], 0.01 + 0.003 * given[:, 20]
    true = np.stack([blur, grain], axis=1)
    rows = [(tuple(told), row) for told, row in zip(true.tolist(), given, strict=True)]
    monkeypatch.setattr(fit, "samples", lambda places: iter(rows))
    monkeypatch.setattr(fit, "STEPS", 400)
    fit.fit([], other_weights)
    assert (np.abs(answers(given) - true).mean(axis=0) < 0.1 * UNITS).all()
