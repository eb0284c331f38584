"""The blocks of the photo's JPEG file, repeated on what changes."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.image_files import table_profile
from warpir.core.color import REC709_CHROMATICITIES, primaries_to_xyz
from warpir.io.images.color_profile import D50
from warpir.io.images.decoder import upright
from warpir.io.images.jpeg import JpegCoding, read_coding
from warpir.io.images.photos import read_photo
from warpir.look.camera_look import estimate_look
from warpir.look.grain import Grain, blocks_over


def picture(rng: np.random.Generator, height: int = 72, width: int = 104) -> np.ndarray:
    """Return a picture with smooth parts and a noisy one."""
    rows, columns = np.mgrid[:height, :width]
    smooth = np.stack([rows, columns, rows + columns], axis=-1) * 1.2
    smooth[20:50, 30:70] += rng.normal(0.0, 25.0, (30, 40, 3))
    return np.clip(smooth, 0, 255).astype(np.uint8)


def written(codes: np.ndarray, path: Path, **options: object) -> JpegCoding:
    Image.fromarray(codes).save(path, **options)
    coding = read_coding(path, 1)
    assert coding is not None
    return coding


@pytest.mark.parametrize(("quality", "subsampling"), [(30, 2), (75, 1), (92, 0)])
def test_a_picture_becomes_what_the_photos_file_would_have_made_of_it(
    rng: np.random.Generator, tmp_path: Path, quality: int, subsampling: int
) -> None:
    first, other = picture(rng), picture(rng)
    coding = written(first, tmp_path / "a.jpg", quality=quality, subsampling=subsampling)
    assert (coding.subsampling, coding.quality) == (subsampling, quality)
    Image.fromarray(other).save(tmp_path / "b.jpg", quality=quality, subsampling=subsampling)
    assert (coding.recoded(other) == np.asarray(Image.open(tmp_path / "b.jpg"))).all()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_blocks_lie_in_the_files_picture(
    rng: np.random.Generator, tmp_path: Path, orientation: int
) -> None:
    stored = picture(rng)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(tmp_path / "a.jpg", quality=40, exif=exif)
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.jpeg is not None and photo.jpeg.orientation == orientation
    coded = photo.jpeg.recoded(np.ascontiguousarray(upright(stored, orientation)))
    plain = JpegCoding(photo.jpeg.tables, photo.jpeg.subsampling)
    assert (coded == upright(plain.recoded(stored), orientation)).all()


def test_grey_files_have_a_coding_and_others_none(rng: np.random.Generator, tmp_path: Path) -> None:
    codes = picture(rng)
    grey = written(codes[..., 0], tmp_path / "grey.jpg", quality=50)
    assert len(grey.tables) == 1 and grey.recoded(codes).shape == codes.shape
    Image.fromarray(codes).convert("CMYK").save(tmp_path / "cmyk.jpg")
    assert read_coding(tmp_path / "cmyk.jpg", 1) is None
    Image.fromarray(codes).save(tmp_path / "photo.png")
    assert read_photo(tmp_path / "photo.png").jpeg is None
    tables = table_profile(primaries_to_xyz(REC709_CHROMATICITIES, D50))
    Image.fromarray(codes).save(tmp_path / "tables.jpg", icc_profile=tables)
    converted = read_photo(tmp_path / "tables.jpg")
    assert converted.jpeg is None and any("in 8 bits" in notice for notice in converted.notices)


def test_max_pixels_alone_limits_the_picture(
    rng: np.random.Generator, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pillow's own, 179 million pixels, which no flag raises, stays for others in the process."""
    Image.fromarray(picture(rng)).save(tmp_path / "a.jpg")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    coding = read_photo(tmp_path / "a.jpg").jpeg
    assert coding is not None and coding.recoded(picture(rng)).shape == picture(rng).shape
    assert Image.MAX_IMAGE_PIXELS == 100


def test_only_what_changes_is_coded(rng: np.random.Generator, tmp_path: Path) -> None:
    codes = picture(rng)
    coding = written(codes, tmp_path / "a.jpg", quality=40)
    linear = ((codes / 255.0) ** 2.2).astype(np.float32)
    changed = np.zeros(codes.shape[:2], bool)
    changed[16:60, 20:80] = True
    added = blocks_over(coding, linear, changed, 2.2)
    assert not added[~changed].any()
    shown = np.round(255.0 * (linear + added) ** (1 / 2.2))
    assert np.abs(shown - coding.recoded(codes))[changed].max() <= 1.0


def test_grain_and_blocks_are_added_together(rng: np.random.Generator, tmp_path: Path) -> None:
    codes = picture(rng)
    coding = written(codes, tmp_path / "a.jpg", quality=40)
    srgb = (codes / 255.0).astype(np.float32)
    off = estimate_look(srgb, srgb**2.2, None, "off", "off", "off", coding)
    assert off.jpeg is None and off.lines() == []
    look = estimate_look(srgb, srgb**2.2, None, "off", 3.0, "off", coding)
    assert "JPEG of quality 40" in look.lines()[-1] and look.record()["jpeg"] == {"quality": 40}
    assert isinstance(look.grain, Grain)
    changed, matte = np.ones(codes.shape[:2], bool), np.ones(codes.shape[:2], np.float32)
    added = look.grain_on(srgb**2.2, srgb**2.2, matte, changed, 1, 2.2)
    again = look.grain_on(srgb**2.2, srgb**2.2, matte, changed, 1, 2.2)
    assert added is not None and (added == again).all()
    linear = np.clip(srgb**2.2 + added, 0.0, 1.0)
    final = np.round(255.0 * linear ** (1 / 2.2)).astype(np.uint8)
    # What a file of this coding holds changes little when it is coded once more.
    assert np.abs(coding.recoded(final).astype(int) - final).mean() < 0.5
