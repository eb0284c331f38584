"""Photographs, plates and masks in, on files made here; values are asserted exactly."""

import io
import os
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image, ImageCms, ImageOps

from tests.image_files import codes8, matrix_profile, png_chunk, write_image
from warpir import color
from warpir.errors import ExitCode, InputError
from warpir.photo_files import Photo, read_envmap, read_mask, read_photo

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no development data at {SHARED}")


def fails(path: Path, *words: str, code: ExitCode = ExitCode.INPUT, **options: Any) -> None:
    with pytest.raises(InputError) as caught:
        read_photo(path, **options)
    text = f"{caught.value.what} {caught.value.advice}"
    assert all(word in text for word in words), text
    assert caught.value.where == str(path)
    assert caught.value.code == code
    assert "\n" not in str(caught.value)


# ------------------------------------------------------------------------------- photographs


@pytest.mark.parametrize("name", ["p.png", "p.tif", "p.webp"])
def test_eight_bits_are_exact(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    codes = codes8(rng)
    Image.fromarray(codes).save(tmp_path / name, lossless=True)
    photo = read_photo(tmp_path / name)
    np.testing.assert_array_equal(photo.codes, codes)
    assert photo.codes.dtype == np.uint8
    np.testing.assert_array_equal(photo.srgb, codes.astype(np.float32) / np.float32(255))
    np.testing.assert_allclose(photo.linear(), (codes / 255.0) ** 2.2, rtol=1e-5)
    assert photo.notices == ()


@pytest.mark.parametrize("name", ["p.png", "p.tif"])
def test_sixteen_bits_survive(tmp_path: Path, rng: np.random.Generator, name: str) -> None:  # I11
    codes = rng.integers(0, 65536, (9, 7, 3), dtype=np.uint16)
    codes[0, 0] = 57300
    photo = read_photo(write_image(tmp_path / name, codes))
    assert photo.codes.dtype == np.uint16
    np.testing.assert_array_equal(photo.codes, codes)
    np.testing.assert_array_equal(np.round(photo.srgb * 65535.0), codes)


@pytest.mark.parametrize("name", ["p.exr", "p.tif"])
def test_float_plates_are_linear(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    plate = rng.normal(1.0, 1.0, (9, 7, 3)).astype(np.float32)  # I12
    photo = read_photo(write_image(tmp_path / name, plate))
    np.testing.assert_array_equal(photo.codes, plate)
    np.testing.assert_array_equal(photo.linear(), plate)
    expected = np.clip(plate, 0.0, 1.0).astype(np.float64) ** (1 / 2.2)
    np.testing.assert_allclose(photo.srgb, expected, atol=1e-6)
    assert any("linear" in notice for notice in photo.notices)


def test_non_finite_plate_pixels_are_counted(tmp_path: Path) -> None:
    plate = np.ones((4, 5, 3), np.float32)
    plate[1, 2, 0], plate[3, 4] = np.nan, np.inf
    photo = read_photo(write_image(tmp_path / "p.exr", plate))
    assert np.isfinite(photo.codes).all()
    assert any(notice.startswith("2 non-finite") for notice in photo.notices)


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("name", ["p.png", "p.tif", "p.jpg", "p.webp"])
def test_orientations_equal_pillows(  # I7
    tmp_path: Path, rng: np.random.Generator, orientation: int, name: str
) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    options: dict[str, Any] = {"quality": 95, "subsampling": 0} if name == "p.jpg" else {}
    if name == "p.webp":
        options = {"lossless": True}
    Image.fromarray(codes8(rng)).save(tmp_path / name, exif=exif, **options)
    with Image.open(tmp_path / name) as picture:
        upright = np.asarray(ImageOps.exif_transpose(picture).convert("RGB"), dtype=int)
    codes = read_photo(tmp_path / name).codes
    assert codes.shape == upright.shape
    # JPEG decoders may round differently.
    assert np.abs(codes - upright).max() <= (2 if name == "p.jpg" else 0)


def test_focal_length_of_exif(tmp_path: Path, rng: np.random.Generator) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 28
    Image.fromarray(codes8(rng)).save(tmp_path / "p.jpg", exif=exif)
    assert read_photo(tmp_path / "p.jpg").focal_35mm == 28.0
    Image.fromarray(codes8(rng)).save(tmp_path / "q.jpg")
    assert read_photo(tmp_path / "q.jpg").focal_35mm is None


@pytest.mark.parametrize("mode", ["L", "1", "P", "LA"])
def test_other_layouts_are_expanded(tmp_path: Path, rng: np.random.Generator, mode: str) -> None:
    picture = Image.fromarray(codes8(rng)).convert(mode)  # I9
    picture.save(tmp_path / "p.png")
    photo = read_photo(tmp_path / "p.png")
    np.testing.assert_array_equal(photo.codes, np.asarray(picture.convert("RGB")))


def test_cmyk_is_noted(tmp_path: Path, rng: np.random.Generator) -> None:
    Image.fromarray(codes8(rng)).convert("CMYK").save(tmp_path / "p.jpg")
    photo = read_photo(tmp_path / "p.jpg")
    assert photo.codes.shape == (24, 36, 3)
    assert any("CMYK" in notice for notice in photo.notices)


def test_alpha_is_refused_unless_asked(tmp_path: Path, rng: np.random.Generator) -> None:  # I10
    rgba = np.dstack([codes8(rng), np.full((24, 36), 255, np.uint8)])
    path = tmp_path / "p.png"
    Image.fromarray(rgba).save(path)
    np.testing.assert_array_equal(read_photo(path).codes, rgba[..., :3])
    rgba[3, 4, 3] = 128
    Image.fromarray(rgba).save(path)
    fails(path, "transparent", "--alpha ignore")
    photo = read_photo(path, alpha="ignore")
    np.testing.assert_array_equal(photo.codes, rgba[..., :3])  # not premultiplied
    assert any("alpha" in notice for notice in photo.notices)


@pytest.mark.parametrize("name", ["p.png", "p.webp", "p.tif"])
def test_first_of_several_frames(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    first, second = Image.fromarray(codes8(rng)), Image.fromarray(codes8(rng))  # I13
    first.save(tmp_path / name, save_all=True, append_images=[second], lossless=True)
    photo = read_photo(tmp_path / name)
    np.testing.assert_array_equal(photo.codes, np.asarray(first))
    assert any("first" in notice for notice in photo.notices)


@pytest.mark.parametrize("size", [(1, 1), (7, 5), (3, 400)])
def test_odd_sizes(tmp_path: Path, rng: np.random.Generator, size: tuple[int, int]) -> None:
    Image.fromarray(codes8(rng, *size)).save(tmp_path / "p.png")  # I14
    assert read_photo(tmp_path / "p.png").srgb.shape == (*size, 3)


def test_constant_photo_is_noted(tmp_path: Path) -> None:  # I16
    Image.fromarray(np.full((4, 4, 3), 9, np.uint8)).save(tmp_path / "p.png")
    assert any("no signal" in notice for notice in read_photo(tmp_path / "p.png").notices)


@pytest.mark.parametrize("name", ["-x.png", "na\u00efve \u5199\u771f.png", "quo'te\".png", "p.txt"])
def test_names_do_not_matter(tmp_path: Path, rng: np.random.Generator, name: str) -> None:  # I17
    Image.fromarray(codes8(rng)).save(tmp_path / name, format="PNG")
    assert read_photo(tmp_path / name).kind == "png"


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp", "exr", "hdr"])
@pytest.mark.parametrize("share", [0.05, 0.6, 0.97])
def test_truncated_files_are_refused(
    tmp_path: Path, rng: np.random.Generator, kind: str, share: float
) -> None:  # I3, E1, E12
    path = tmp_path / f"p.{kind}"
    if kind in ("exr", "hdr"):
        write_image(path, rng.random((64, 96, 3), dtype=np.float32))
    else:
        Image.fromarray(codes8(rng, 64, 96)).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    fails(path, "truncated" if share > 0.1 else "")


def test_second_part_cut_off(tmp_path: Path, rng: np.random.Generator) -> None:  # E2
    planes = {c: rng.random((64, 96), dtype=np.float32) for c in "RGB"}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path = tmp_path / "p.exr"
    parts = [OpenEXR.Part(dict(header), planes, name) for name in "ab"]
    OpenEXR.File(parts).write(str(path))
    assert any("2 parts" in notice for notice in read_photo(path).notices)
    content = path.read_bytes()
    path.write_bytes(content[: len(content) * 8 // 10])
    fails(path, "1 of 2 parts readable")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("text.jpg", b"hello, I am a text\n" * 9),
        ("ps.png", b"%!PS-Adobe-3.0 EPSF-3.0\n"),
        ("pnm.jpg", b"P6\n1 1\n255\nabc"),
        ("svg.png", b"<svg xmlns='http://www.w3.org/2000/svg'/>"),
        ("gif.png", b"GIF89a" + bytes(40)),
        ("photo.jpg", b"\0\0\0\x18ftypheic" + bytes(40)),
    ],
)
def test_other_content_is_refused(tmp_path: Path, name: str, content: bytes) -> None:  # I6
    (tmp_path / name).write_bytes(content)
    fails(tmp_path / name, "JPEG", "export" if b"heic" in content else "")


def test_things_that_are_not_files(tmp_path: Path) -> None:  # I1, I2, I18
    fails(tmp_path / "missing.jpg", "no such file")
    fails(tmp_path, "folder")
    (tmp_path / "empty.jpg").touch()
    fails(tmp_path / "empty.jpg", "empty file")
    os.mkfifo(tmp_path / "pipe.jpg")
    fails(tmp_path / "pipe.jpg", "not a regular file")
    (tmp_path / "loop.jpg").symlink_to("loop.jpg")
    fails(tmp_path / "loop.jpg", "not a regular file")
    fails(Path("/dev/zero"), "not a regular file")


def test_size_limit_before_decoding(tmp_path: Path, rng: np.random.Generator) -> None:  # I4, E4
    path = tmp_path / "p.png"
    header = struct.pack(">IIBBBBB", 20000, 20000, 8, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + png_chunk(b"IDAT", zlib.compress(b""))
    )
    fails(path, "--max-pixels")
    Image.fromarray(codes8(rng)).save(path)
    fails(path, "36 x 24", "--max-pixels", max_pixels=800)
    (tmp_path / "p.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000000 +X 1000000000\n"
    )
    fails(tmp_path / "p.hdr", "too large")
    plane = np.zeros((8, 8), np.float32)
    stream = io.BytesIO()
    OpenEXR.File({"type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", plane)).write(stream)
    marker = b"dataWindow\0box2i\0"
    content = stream.getvalue()
    start = content.index(marker) + len(marker) + 4
    window = struct.pack("<4i", 0, 0, 999_999, 999_999)
    (tmp_path / "p.exr").write_bytes(content[:start] + window + content[start + 16 :])
    fails(tmp_path / "p.exr", "too large")


def test_layered_exr_names_its_channels(tmp_path: Path) -> None:  # E7, E8
    plane = np.ones((4, 6), np.float16)
    header = {"type": OpenEXR.scanlineimage}
    path = str(tmp_path / "p.exr")
    OpenEXR.File(dict(header), {f"beauty.{c}": plane for c in "RGB"}).write(path)
    fails(Path(path), "beauty.R", "layer")
    OpenEXR.File(dict(header), {"Y": plane}).write(path)
    assert read_photo(path).codes.shape == (4, 6, 3)


def test_data_window_is_placed_in_the_display_window(tmp_path: Path) -> None:  # E9
    plane = np.arange(1, 17, dtype=np.float32).reshape(4, 4)
    header = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.array([-1, 2], np.int32), np.array([2, 5], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([4, 4], np.int32)),
    }
    path = str(tmp_path / "p.exr")
    OpenEXR.File(header, dict.fromkeys("RGB", plane)).write(path)
    expected = np.zeros((5, 5), np.float32)
    expected[2:5, 0:3] = plane[0:3, 1:4]
    np.testing.assert_array_equal(read_photo(path).codes[..., 1], expected)


# ----------------------------------------------------------------------------------- profiles


def test_display_p3_is_converted_and_comes_back(tmp_path: Path, rng: np.random.Generator) -> None:
    icc = matrix_profile("p3")  # I8
    codes = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    codes[0, 0], codes[0, 1], codes[0, 2] = (255, 0, 0), (255, 255, 255), (128, 128, 128)
    Image.fromarray(codes).save(tmp_path / "p.png", icc_profile=icc)
    photo = read_photo(tmp_path / "p.png")
    assert photo.icc == icc
    assert any("converted" in notice for notice in photo.notices)
    np.testing.assert_array_equal(photo.codes, codes)
    np.testing.assert_allclose(photo.srgb[0, 1], 1.0, atol=1e-3)
    grey = color.linear_to_srgb(np.array([(128 / 255) ** 2.2]))
    np.testing.assert_allclose(photo.srgb[0, 2], grey[0], atol=2e-3)
    inside = ((photo.srgb > 0.0) & (photo.srgb < 1.0)).all(axis=-1)
    assert inside.sum() > 30
    back = photo.encode(photo.srgb, np.ones((16, 16), bool))
    assert np.abs(back[inside].astype(int) - codes[inside]).max() <= 1


def test_only_changed_pixels_get_new_codes(tmp_path: Path, rng: np.random.Generator) -> None:
    codes = rng.integers(0, 65536, (8, 8, 3), dtype=np.uint16)
    photo = read_photo(write_image(tmp_path / "p.png", codes))
    changed = np.zeros((8, 8), bool)
    changed[2, 3] = True
    edited = photo.encode(np.full((8, 8, 3), 0.5, np.float32), changed)
    np.testing.assert_array_equal(edited[~changed], codes[~changed])
    np.testing.assert_array_equal(edited[2, 3], 32768)
    assert edited.dtype == np.uint16


def test_srgb_profile_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    icc = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    codes = codes8(rng)
    Image.fromarray(codes).save(tmp_path / "p.png", icc_profile=icc)
    photo = read_photo(tmp_path / "p.png")
    assert (photo.icc, photo.notices) == (None, ())
    np.testing.assert_array_equal(photo.srgb, codes.astype(np.float32) / np.float32(255))


@pytest.mark.parametrize("case", ["rubbish", "lab", "tag-count", "curve-count", "cut", "singular"])
def test_unusable_profiles_are_noted(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    icc = matrix_profile("p3")
    many = struct.pack(">I", 2**31)
    icc = {
        "rubbish": b"rubbish" * 30,
        "lab": ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes(),
        "tag-count": icc[:128] + many + icc[132:],
        "curve-count": icc.replace(b"curv\0\0\0\0\0\0\0\x01", b"curv\0\0\0\0" + many),
        "cut": icc[:300],
        "singular": icc.replace(struct.pack(">i", round(0.51512 * 65536)), bytes(4)).replace(
            struct.pack(">i", round(0.29198 * 65536)), bytes(4)
        ),
    }[case]
    Image.fromarray(codes8(rng)).save(tmp_path / "p.jpg", icc_profile=icc)
    assert any("taken as sRGB" in notice for notice in read_photo(tmp_path / "p.jpg").notices)


# -------------------------------------------------------------------------------------- masks


@pytest.mark.parametrize("case", ["I20-L", "I20-LA", "I20-P", "I20-1", "I20-RGB", "I20-RGBA"])
def test_mask_layouts(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    mode = case.split("-")[1]
    codes = rng.integers(0, 256, (5, 7), dtype=np.uint8)
    picture = Image.fromarray(codes).convert(mode)
    if mode.endswith("A"):
        picture.putalpha(128)
    picture.save(tmp_path / "m.png")
    expected = np.asarray(picture.convert("RGB"))[..., 0] / np.float32(255)
    notices: list[str] = []
    mask = read_mask(tmp_path / "m.png", (7, 5), notices=notices)
    assert (mask.shape, mask.dtype) == ((5, 7), np.float32)
    np.testing.assert_array_equal(mask, expected)
    expected_notices = {"LA": ["alpha channel ignored"], "P": ["palette expanded to RGB"]}
    expected_notices["RGBA"] = expected_notices["LA"]
    assert notices == expected_notices.get(mode, [])


@pytest.mark.parametrize("case", ["I20-uint16.png", "I20-uint16.tif", "I20-float32.exr"])
def test_deep_masks_keep_their_values(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    kind, _, suffix = case.removeprefix("I20-").partition(".")
    codes = rng.random((4, 6, 1), dtype=np.float32)
    top = 1.0
    if kind == "uint16":
        codes, top = rng.integers(0, 65536, (4, 6, 1), dtype=np.uint16), 65535.0
    mask = read_mask(write_image(tmp_path / f"m.{suffix}", codes), (6, 4))
    np.testing.assert_array_equal(mask, codes[..., 0] / np.float32(top))


def test_i20_mask_is_turned_upright(tmp_path: Path, rng: np.random.Generator) -> None:
    codes = rng.integers(0, 256, (4, 6), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(codes).save(tmp_path / "m.png", exif=exif)
    mask = read_mask(tmp_path / "m.png", (4, 6))
    np.testing.assert_array_equal(mask, np.rot90(codes, -1) / np.float32(255))


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("I20-size", "found 6 x 4; expected 8 x 4"),
        ("I20-turned", "found 6 x 4; expected 4 x 6"),
        ("I20-color", "three channels that differ"),
        ("I20-in-alpha", "only its alpha differs"),
        ("I20-range", "outside 0 to 1"),
        ("I20-nan", "outside 0 to 1, or not finite"),
        ("I20-missing", "no such file"),
    ],
)
def test_wrong_masks_are_refused(
    tmp_path: Path, rng: np.random.Generator, case: str, words: str
) -> None:
    path, size = tmp_path / "m.png", (6, 4)
    codes = rng.integers(0, 256, (4, 6), dtype=np.uint8)
    if case in ("I20-size", "I20-turned"):
        size = (8, 4) if case == "I20-size" else (4, 6)
        Image.fromarray(codes).save(path)
    elif case == "I20-color":
        Image.fromarray(codes8(rng, 4, 6)).save(path)
    elif case == "I20-in-alpha":
        Image.fromarray(np.stack([np.full_like(codes, 255), codes], axis=-1)).save(path)
    elif case in ("I20-range", "I20-nan"):
        path = tmp_path / "m.exr"
        value = 1.5 if case == "I20-range" else np.nan
        write_image(path, np.full((4, 6, 1), value, np.float32))
    with pytest.raises(InputError) as caught:
        read_mask(path, size)
    assert words in caught.value.what
    assert (caught.value.where, caught.value.code) == (str(path), ExitCode.INPUT)


def test_i20_even_mask_is_noted(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(tmp_path / "m.png")
    notices: list[str] = []
    assert read_mask(tmp_path / "m.png", (6, 4), notices=notices).max() == 0.0
    assert any("no signal" in notice for notice in notices)


# -------------------------------------------------------------------------------- damaged bytes


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp", "exr", "hdr"])
def test_flipped_bytes_give_a_picture_or_our_error(
    tmp_path: Path, rng: np.random.Generator, kind: str
) -> None:
    path = tmp_path / f"p.{kind}"
    if kind in ("exr", "hdr"):
        write_image(path, rng.random((16, 32, 3), dtype=np.float32))
    else:
        Image.fromarray(codes8(rng)).save(path, icc_profile=matrix_profile("p3"))
    sound = path.read_bytes()
    for trial in range(60):
        content = bytearray(sound)
        # Half of the flips hit the header, where counts and sizes are.
        places = rng.integers(0, len(sound) if trial % 2 else min(300, len(sound)), 3)
        for place in places:
            content[place] = rng.integers(0, 256)
        path.write_bytes(content)
        for read in (read_photo, read_envmap):
            try:
                pixels = read(path)
            except InputError as error:
                assert "\n" not in str(error)
            else:
                values = pixels.srgb if isinstance(pixels, Photo) else pixels
                assert np.isfinite(values).all()


@needs_shared
def test_real_photographs() -> None:
    paths = sorted((SHARED / "photo").glob("*.*g"))
    assert paths
    for path in paths:
        photo = read_photo(path)
        assert photo.srgb.shape == photo.codes.shape
        assert 0.0 <= photo.srgb.min() < photo.srgb.max() <= 1.0
        same = photo.encode(photo.srgb, np.zeros(photo.codes.shape[:2], bool))
        np.testing.assert_array_equal(same, photo.codes)
