"""What is read and written, on files made here; values are asserted exactly."""

import hashlib
import io
import json
import os
import struct
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms, ImageOps

from warpir import color
from warpir.camera import Camera, camera_from_fov
from warpir.envmap_conventions import IN_CAMERA_AXES, SEAM_SHIFTS
from warpir.errors import ExitCode, InputError
from warpir.files import (
    BACKGROUND_DEPTH,
    Layers,
    OutputFolder,
    Photo,
    read_envmap,
    read_photo,
    write_layers,
)
from warpir.light import rotate_map

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no development data at {SHARED}")


OIIO_TYPES = {"uint8": "uint8", "uint16": "uint16", "float16": "half", "float32": "float"}


def write_image(path: Path, pixels: np.ndarray, **attributes: Any) -> Path:
    """Write by OpenImageIO in the array's own type."""
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, OIIO_TYPES[pixels.dtype.name])
    for name, value in attributes.items():
        spec.attribute(name, value)
    writer = oiio.ImageOutput.create(str(path))
    assert writer.open(str(path), spec), oiio.geterror()
    assert writer.write_image(pixels)
    assert writer.close()
    return path


def codes8(rng: np.random.Generator, height: int = 24, width: int = 36) -> np.ndarray:
    return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)


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


def png_chunk(name: bytes, content: bytes) -> bytes:
    body = name + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))


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


def matrix_profile(primaries: str) -> bytes:
    """An ICC v2 matrix profile made from bytes: gamma 2.2, Display P3 or Rec.709 primaries."""
    columns = {  # D50-adapted
        "p3": [[0.51512, 0.24120, -0.00105], [0.29198, 0.69225, 0.04189],
               [0.15710, 0.06657, 0.78407]],
        "709": [[0.43607, 0.22249, 0.01392], [0.38515, 0.71687, 0.09708],
                [0.14307, 0.06061, 0.71410]],
    }[primaries]  # fmt: skip

    def fixed(*values: float) -> bytes:
        return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))

    tags = {b"wtpt": b"XYZ \0\0\0\0" + fixed(0.9642, 1.0, 0.8249)}
    for letter, column in zip(b"rgb", columns, strict=True):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ \0\0\0\0" + fixed(*column)
        tags[bytes([letter]) + b"TRC"] = b"curv\0\0\0\0" + struct.pack(">IHxx", 1, 563)  # 2.2
    tags[b"desc"] = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(82)
    tags[b"cprt"] = b"text\0\0\0\0none\0\0\0\0"
    offset, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", offset + len(body), len(content))
        body += content
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28)
    head += fixed(0.9642, 1.0, 0.8249)
    return head.ljust(128, b"\0") + table + body


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


# --------------------------------------------------------------------------- environment maps


def directions(height: int) -> np.ndarray:
    """Direction of each texel centre, written out from the convention sheet, [He, 2 He, 3]."""
    width = 2 * height
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    lon, lat = np.pi * (1 - 2 * u), np.pi * (0.5 - v)
    return np.stack(
        [
            np.sin(lon)[None] * np.cos(lat)[:, None],
            np.repeat(np.sin(lat)[:, None], width, axis=1),
            np.cos(lon)[None] * np.cos(lat)[:, None],
        ],
        axis=-1,
    )


LOBES = {  # one colour per horizontal axis: enough to tell turns and mirror images apart
    (1, 0, 0): (1.0, 0.0, 0.0),
    (-1, 0, 0): (0.0, 1.0, 1.0),
    (0, 0, 1): (0.0, 1.0, 0.0),
    (0, 0, -1): (1.0, 0.0, 1.0),
}


def four_lobes(directions: np.ndarray) -> np.ndarray:
    texels = np.zeros(directions.shape, np.float32)
    for axis, rgb in LOBES.items():
        strength = np.exp(20.0 * (directions @ np.array(axis, float) - 1.0))[..., None]
        texels += (strength * np.array(rgb)).astype(np.float32)
    return texels + np.float32(0.125) * (directions[..., 1:2] > 0)  # brighter sky: up is up


def brightest(texels: np.ndarray, rgb: tuple[float, ...]) -> np.ndarray:
    """Direction in which the map shines most in one colour and least in the others."""
    score = texels @ (2 * np.array(rgb) - 1)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    return directions(len(texels))[row, column]


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_orientation_and_chirality(tmp_path: Path, suffix: str) -> None:
    path = write_image(tmp_path / f"m.{suffix}", four_lobes(directions(32)))
    texels = read_envmap(path)
    for axis, rgb in LOBES.items():
        assert brightest(texels, rgb) @ axis > 0.99
        mirrored = brightest(texels[:, ::-1], rgb)
        assert (mirrored @ axis > 0.99) == (axis[0] == 0)
    assert texels[0].mean() > texels[-1].mean()
    # As stated in words: centre +Z, left quarter +X.
    np.testing.assert_allclose(directions(32)[15:17, 31:33].mean(axis=(0, 1)), [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(directions(32)[15:17, 15:17].mean(axis=(0, 1)), [1, 0, 0], atol=0.01)


@pytest.mark.parametrize("convention", sorted(SEAM_SHIFTS.keys() - IN_CAMERA_AXES))
def test_foreign_conventions_by_their_own_formula(tmp_path: Path, convention: str) -> None:
    height, width = 32, 64
    u = (np.arange(width) + 0.5) / width
    azimuth = {  # direction (x, z) in our axes of each column, from each tool's own definition
        "openexr": 2 * np.pi * u,
        "nvdiffrec": 2 * np.pi * (u - 0.5),
    }.get(convention)
    if azimuth is not None:  # u = atan2(x, -z) / 2 pi (+ 1/2)
        x, z = np.sin(azimuth), -np.cos(azimuth)
    elif convention == "threejs":  # u = atan2(z, x) / 2 pi + 1/2
        x, z = np.cos(2 * np.pi * (u - 0.5)), np.sin(2 * np.pi * (u - 0.5))
    else:  # Cycles, Z up: u = 1/2 - atan2(yb, xb) / 2 pi, (xb, yb, zb) = (x, -z, y)
        x, z = np.cos(2 * np.pi * (0.5 - u)), -np.sin(2 * np.pi * (0.5 - u))
    lat = np.pi * (0.5 - (np.arange(height) + 0.5) / height)
    foreign = np.stack(
        [
            np.cos(lat)[:, None] * x,
            np.repeat(np.sin(lat)[:, None], width, axis=1),
            np.cos(lat)[:, None] * z,
        ],
        axis=-1,
    )
    path = write_image(tmp_path / "m.exr", four_lobes(foreign))
    texels = read_envmap(path, convention=convention)
    np.testing.assert_allclose(texels, four_lobes(directions(height)), atol=1e-5)


def test_rotation_is_counter_clockwise_from_above(tmp_path: Path) -> None:
    path = write_image(tmp_path / "m.exr", four_lobes(directions(32)))
    turned = rotate_map(read_envmap(path), 90.0)
    for axis, rgb in LOBES.items():
        x, _, z = axis
        # Seen from above +X is right and +Z is down: a quarter turn takes +X to -Z, +Z to +X.
        assert brightest(turned, rgb) @ (z, 0, -x) > 0.99
    np.testing.assert_array_equal(turned, np.roll(read_envmap(path), -16, axis=1))
    np.testing.assert_array_equal(rotate_map(read_envmap(path), -270.0), turned)
    np.testing.assert_array_equal(rotate_map(read_envmap(path), 720.0), read_envmap(path))


@pytest.mark.parametrize("degrees", [1.0, 33.3, -187.77])
def test_rotation_by_part_columns_keeps_energy(
    tmp_path: Path, rng: np.random.Generator, degrees: float
) -> None:
    texels = (rng.random((16, 32, 3)) ** 8 * 1e5).astype(np.float32)
    turned = rotate_map(read_envmap(write_image(tmp_path / "m.exr", texels)), degrees)
    np.testing.assert_allclose(turned.sum(axis=1), texels.sum(axis=1), rtol=1e-5)


def test_bad_radiance_is_repaired_and_counted(tmp_path: Path) -> None:  # E5, E6
    texels = np.full((4, 8, 3), 0.5, np.float32)
    texels[0, 0, 0], texels[1, 1], texels[2, 2, 2], texels[3, 3, 1] = np.nan, np.inf, -2.0, 1e6
    path = write_image(tmp_path / "m.exr", texels)
    notices: list[str] = []
    repaired = read_envmap(path, notices=notices)
    assert repaired[3, 3, 1] == np.float32(1e6)  # above the half range, not clamped
    np.testing.assert_array_equal(repaired[1, 1], np.float32(1e6))
    assert repaired[0, 0, 0] == 0.0
    assert repaired[2, 2, 2] == 0.0
    assert "1 NaN, 3 infinite, 1 negative" in notices[0]
    with pytest.raises(InputError, match="clean"):
        read_envmap(path, strict=True)


def rgbe_file(path: Path, resolution: str, rgbe: np.ndarray, extra: str = "") -> Path:
    header = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{extra}\n{resolution}\n"
    path.write_bytes(header.encode() + rgbe.astype(np.uint8).tobytes())
    return path


def test_radiance_orientation_and_exposure(tmp_path: Path, rng: np.random.Generator) -> None:  # E11
    rgbe = rng.integers(128, 256, (4, 8, 4))
    rgbe[..., 3] = 129
    flat = read_envmap(rgbe_file(tmp_path / "a.hdr", "-Y 4 +X 8", rgbe))
    flipped = read_envmap(rgbe_file(tmp_path / "b.hdr", "+Y 4 +X 8", rgbe[::-1]))
    np.testing.assert_array_equal(flat, flipped)
    mirrored = read_envmap(rgbe_file(tmp_path / "c.hdr", "-Y 4 -X 8", rgbe[:, ::-1]))
    np.testing.assert_array_equal(flat, mirrored)
    by_columns = read_envmap(rgbe_file(tmp_path / "d.hdr", "+X 8 -Y 4", rgbe.swapaxes(0, 1)))
    np.testing.assert_array_equal(flat, by_columns)
    exposed = read_envmap(rgbe_file(tmp_path / "e.hdr", "-Y 4 +X 8", rgbe, "EXPOSURE=2.0\n"))
    np.testing.assert_array_equal(flat, 2.0 * exposed)


@pytest.mark.parametrize("case", ["square", "row", "jpeg", "xyze", "garbage", "missing"])
def test_wrong_maps_are_refused(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    path = tmp_path / "m.exr"  # E7, E11, E12
    if case in ("square", "row"):
        write_image(path, np.ones((8 if case == "square" else 1, 8, 3), np.float32))
    elif case == "jpeg":
        Image.fromarray(codes8(rng)).save(path, format="JPEG")
    elif case == "xyze":
        path = write_image(tmp_path / "m.hdr", np.ones((8, 16, 3), np.float32))
        path.write_bytes(path.read_bytes().replace(b"rle_rgbe", b"rle_xyze"))
    elif case == "garbage":
        path.write_bytes(b"#?RADIANCE\n\xff\xfe\x80\n")
    with pytest.raises(InputError) as caught:
        read_envmap(path)
    assert caught.value.where == str(path)


# ------------------------------------------------------------------------------------- output


def sha256s(folder: Path) -> dict[str, str]:
    return {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
        if path.is_file()
    }


def write_small(folder: Path, seed: int = 0, overwrite: bool = False) -> None:
    codes = np.random.default_rng(seed).integers(0, 256, (6, 5, 3), dtype=np.uint8)
    with OutputFolder(folder, overwrite=overwrite) as out:
        out.write_png("composite.png", codes)
        out.write_json("camera.json", {"seed": seed})
        out.write_json("run.json", {"seed": seed})


def test_folder_is_complete_and_clean(tmp_path: Path) -> None:
    write_small(tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == ["camera.json", "composite.png", "run.json"]
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    hashes = sha256s(tmp_path / "out")
    del hashes["run.json"]
    assert run == {"seed": 0, "files": hashes}


def test_results_are_not_overwritten_unless_asked(tmp_path: Path) -> None:  # F5
    write_small(tmp_path / "out")
    before = sha256s(tmp_path / "out")
    with pytest.raises(InputError, match=r"run\.json") as caught:
        write_small(tmp_path / "out", seed=1)
    assert caught.value.code == ExitCode.OUTPUT
    assert sha256s(tmp_path / "out") == before
    write_small(tmp_path / "out", seed=1, overwrite=True)
    assert sha256s(tmp_path / "out") != before


def test_overwriting_takes_away_what_the_old_run_wrote_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with OutputFolder(folder) as out:
        out.write_json("lobes.json", {"old": 1})
        out.write_json("edited.json", {"old": 2})
        out.write_json("run.json", {})
    (folder / "notes.txt").write_text("mine")
    (folder / "edited.json").write_text("mine too")
    write_small(folder, overwrite=True)
    names = {"camera.json", "composite.png", "run.json", "notes.txt", "edited.json"}
    assert set(os.listdir(folder)) == names
    assert (folder / "edited.json").read_text() == "mine too"


def write_nested(folder: Path, name: str, overwrite: bool = False) -> None:
    with OutputFolder(folder, overwrite=overwrite) as out:
        out.write_bytes("top.bin", b"1")
        out.write_bytes(f"sub/{name}", name.encode())
        out.write_json("run.json", {})


def test_files_in_a_folder_follow_the_same_rules(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Listed, replaced, taken away with their empty folder, left alone when a run fails."""
    folder = tmp_path / "out"
    write_nested(folder, "a.bin")
    files = json.loads((folder / "run.json").read_text())["files"]
    assert files["sub/a.bin"] == hashlib.sha256(b"a.bin").hexdigest()
    write_nested(folder, "b.bin", overwrite=True)
    assert os.listdir(folder / "sub") == ["b.bin"]

    rename = Path.rename

    def no_space(source: Path, target: Path) -> Path:
        if source.parent.name.startswith(".partial") and source.name == "run.json":
            raise OSError(28, "No space left on device")
        return rename(source, target)

    with monkeypatch.context() as patched, pytest.raises(InputError):
        patched.setattr(Path, "rename", no_space)
        write_nested(folder, "c.bin", overwrite=True)
    assert os.listdir(folder / "sub") == ["b.bin"]
    (folder / "sub" / "mine.txt").write_text("mine")
    write_small(folder, overwrite=True)
    assert os.listdir(folder / "sub") == ["mine.txt"]
    (folder / "sub" / "mine.txt").unlink()
    write_nested(folder, "a.bin", overwrite=True)
    write_small(folder, overwrite=True)
    assert not (folder / "sub").exists()


def test_a_link_in_place_of_a_folder_is_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / "elsewhere").mkdir()
    (folder / "sub").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="link") as caught:
        write_nested(folder, "a.bin", overwrite=True)
    assert caught.value.code == ExitCode.RESOURCES
    assert os.listdir(tmp_path / "elsewhere") == [] and os.listdir(folder) == ["sub"]
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")  # the output folder itself may be one
    write_nested(tmp_path / "link", "a.bin")
    assert (tmp_path / "elsewhere" / "sub" / "a.bin").exists()


@pytest.mark.parametrize("existing", [False, True])
def test_failed_run_leaves_everything_as_it_was(tmp_path: Path, existing: bool) -> None:
    folder = tmp_path / "out"
    if existing:
        write_small(folder)
    before = sha256s(folder) if existing else {}
    with pytest.raises(KeyboardInterrupt), OutputFolder(folder, overwrite=True) as out:
        out.write_png("composite.png", np.zeros((4, 4, 3), np.uint8))
        raise KeyboardInterrupt
    assert folder.exists() == existing
    if existing:
        assert sha256s(folder) == before
        assert sorted(os.listdir(folder)) == sorted(before)


def test_failed_rename_is_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # R4
    folder = tmp_path / "out"
    write_small(folder)
    before = sha256s(folder)
    rename = Path.rename

    def no_space(source: Path, target: Path) -> Path:
        if source.parent.name.startswith(".partial") and source.name == "run.json":
            raise OSError(28, "No space left on device")
        return rename(source, target)

    monkeypatch.setattr(Path, "rename", no_space)
    with pytest.raises(InputError) as caught:
        write_small(folder, seed=1, overwrite=True)
    assert caught.value.code == ExitCode.RESOURCES
    assert sha256s(folder) == before
    assert sorted(os.listdir(folder)) == sorted(before)


def test_second_run_is_locked_out(tmp_path: Path) -> None:  # F6
    folder = tmp_path / "out"
    with OutputFolder(folder):
        with pytest.raises(InputError, match=f"locked by pid {os.getpid()}") as caught:
            write_small(folder)
        assert caught.value.code == ExitCode.OUTPUT
        assert (folder / ".lock").exists()
    write_small(folder, overwrite=True)  # the lock went with its owner


def test_killed_run_leaves_no_lock(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / ".lock").write_text("99999 on elsewhere\n")
    (folder / ".partial-99999").mkdir()
    (folder / ".partial-99999" / "composite.png").write_bytes(b"half")
    write_small(folder)
    assert sorted(os.listdir(folder)) == ["camera.json", "composite.png", "run.json"]


def test_places_that_cannot_be_output(tmp_path: Path) -> None:  # F5
    (tmp_path / "file").write_text("x")
    cases = [(tmp_path / "file", 7), (tmp_path / "file" / "out", 7), (Path("/"), 2), (tmp_path, 7)]
    for place, code in cases:
        with pytest.raises(InputError) as caught:
            write_small(place)
        assert caught.value.code == code
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize(
    "name", ["../x.json", "a/b/c.json", "a/../x.json", "a/.lock", "/x.json", ".lock", ""]
)
def test_names_never_become_paths(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="plain"), OutputFolder(tmp_path / "out") as out:
        out.write_json(name, {})


FULL_DISK = """
import resource, sys
import numpy as np
import OpenEXR, OpenImageIO
from warpir.errors import InputError
from warpir.files import OutputFolder
limit, kind, folder = int(sys.argv[1]), sys.argv[2], sys.argv[3]
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
rng = np.random.default_rng(1)
try:
    with OutputFolder(folder, overwrite=True) as out:
        if kind == "png":
            out.write_png("composite.png", rng.integers(0, 65536, (200, 300, 3), dtype=np.uint16))
        elif kind == "exr":
            out.write_exr("layers.exr", {"R": rng.random((400, 400), dtype=np.float32)})
        elif kind == "hdr":
            out.write_hdr("envmap.hdr", rng.random((256, 512, 3), dtype=np.float32))
        else:
            out.write_json("camera.json", {"text": "x" * 400000})
        out.write_json("run.json", {"seed": 2})
except InputError as error:
    print(error.code, error)
    sys.exit(int(error.code))
"""


@pytest.mark.parametrize("kind", ["png", "exr", "hdr", "json"])
def test_full_disk(tmp_path: Path, kind: str) -> None:  # F5, R4
    folder = tmp_path / "out"
    write_small(folder)
    before = sha256s(folder)
    for limit in (1_000, 100_000):
        child = subprocess.run(
            [sys.executable, "-c", FULL_DISK, str(limit), kind, str(folder)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert child.returncode == ExitCode.RESOURCES, child.stdout + child.stderr
        assert "Traceback" not in child.stderr
        assert sha256s(folder) == before
        assert sorted(os.listdir(folder)) == sorted(before)


def test_json_is_strict_and_plain(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out") as out:
        out.write_json("a.json", {"x": np.float32(0.5), "y": np.arange(3), "z": Path("p")})
        with pytest.raises(ValueError, match="JSON"):
            out.write_json("b.json", {"x": float("nan")})
    assert json.loads((tmp_path / "out" / "a.json").read_text()) == {
        "x": 0.5,
        "y": [0, 1, 2],
        "z": "p",
    }


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1, 3), (17, 5, 3), (9, 4)])
def test_png_round_trip(
    tmp_path: Path, rng: np.random.Generator, dtype: type, shape: tuple[int, ...]
) -> None:
    codes = rng.integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
    with OutputFolder(tmp_path / "out") as out:
        out.write_png("p.png", codes)
        out.write_png("plain.png", codes, mark=False)
        out.write_png("tagged.png", codes, icc=matrix_profile("p3"), description="what it is")
    reader = oiio.ImageInput.open(str(tmp_path / "out" / "p.png"))
    pixels = reader.read_image(0, 0, 0, reader.spec().nchannels, reader.spec().format)
    assert pixels.dtype == dtype
    np.testing.assert_array_equal(pixels.reshape(shape), codes)
    with Image.open(tmp_path / "out" / "p.png") as picture:
        picture.load()
        assert "compositeSynthetic" in picture.info["XML:com.adobe.xmp"]
        assert "icc_profile" not in picture.info
    with Image.open(tmp_path / "out" / "plain.png") as picture:
        assert "XML:com.adobe.xmp" not in picture.info
    with Image.open(tmp_path / "out" / "tagged.png") as picture:
        assert picture.info["icc_profile"] == matrix_profile("p3")
        assert picture.info["Description"] == "what it is"


def test_envmap_files(tmp_path: Path) -> None:
    texels = four_lobes(directions(32))
    texels[3, 5] = 2e5  # a sun above the half range
    with OutputFolder(tmp_path / "out") as out:
        out.write_envmap(texels)
    np.testing.assert_array_equal(read_envmap(tmp_path / "out" / "envmap.exr"), texels)
    hdr = read_envmap(tmp_path / "out" / "envmap.hdr")
    assert np.abs(hdr - texels).max(axis=-1) == pytest.approx(0.0, abs=2e5 / 128)
    assert (np.abs(hdr - texels) <= texels.max(axis=-1, keepdims=True) / 127).all()
    preview = read_photo(tmp_path / "out" / "envmap_preview.png").srgb
    # Rolled: magenta, which shines along -Z, is in the middle.
    assert preview[16, 32] @ (1.0, -1.0, 1.0) > 0.9
    with OutputFolder(tmp_path / "bad") as out, pytest.raises(InputError) as caught:
        out.write_envmap(-texels)
    assert caught.value.code == ExitCode.NUMERIC


def small_layers(rng: np.random.Generator) -> tuple[Layers, Camera]:
    camera = camera_from_fov(20, 12, 60.0, -5.0, 1.5)
    shape = (12, 20)
    foreground = rng.random((*shape, 4)).astype(np.float32)
    foreground[:6] = 0.0
    plate = (rng.random((*shape, 3)) * 4.0).astype(np.float32)
    shadow_ratio = np.ones((*shape, 3), np.float32)
    shadow_ratio[4:9] = rng.random((5, 20, 3)) * 1.5
    depth = np.full(shape, np.inf, np.float32)
    depth[6:] = 123.456
    layers = Layers(
        composite=foreground[..., :3] + (1 - foreground[..., 3:]) * plate * shadow_ratio,
        foreground=foreground,
        shadow_ratio=shadow_ratio,
        plate=plate,
        matte=foreground[..., 3],
        depth=depth,
        position=rng.normal(size=(*shape, 3)).astype(np.float32),
        normal=rng.normal(size=(*shape, 3)).astype(np.float32),
        roughness=np.full(shape, 0.25, np.float32),
        diffuse=np.full((*shape, 3), 1e6, np.float32),
    )
    return layers, camera


def read_channels(path: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Read by OpenImageIO, each channel in float32."""
    reader = oiio.ImageInput.open(str(path))
    spec = reader.spec()
    pixels = reader.read_image(0, 0, 0, spec.nchannels, "float")
    return {name: pixels[..., k] for k, name in enumerate(spec.channelnames)}, spec


def test_layers_recompute_the_composite(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    with OutputFolder(tmp_path / "out") as out:
        assert write_layers(out, layers, camera, config={"b": 1, "a": 2}) == 12 * 20 * 3
    planes, spec = read_channels(tmp_path / "out" / "layers.exr")
    fg = np.stack([planes[f"fg.{c}"] for c in "RGBA"], axis=-1)
    plate, ratio = (np.stack([planes[f"{n}.{c}"] for c in "RGB"], -1) for n in ("plate", "shadow"))
    composite = np.stack([planes[c] for c in "RGB"], axis=-1)
    ulp = 2.0**-11  # relative rounding of one half number; four of them meet here
    np.testing.assert_allclose(
        composite, fg[..., :3] + (1 - fg[..., 3:]) * plate * ratio, rtol=5 * ulp, atol=5 * ulp
    )
    untouched = (fg[..., 3] == 0) & (ratio == 1).all(axis=-1)
    assert untouched.any()
    np.testing.assert_array_equal(composite[untouched], plate[untouched])
    np.testing.assert_array_equal(planes["position.X"], layers.position[..., 0])
    np.testing.assert_array_equal(planes["Z"][6:], np.float32(123.456))
    np.testing.assert_array_equal(planes["Z"][:6], np.float32(BACKGROUND_DEPTH))
    np.testing.assert_array_equal(planes["diffuse.G"], 65504.0)
    assert "albedo.R" not in planes
    formats = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    floats = {name for name, kind in formats.items() if kind == "float"}
    assert floats == {"Z", *(f"{n}.{c}" for n in ("position", "normal") for c in "XYZ")}
    np.testing.assert_allclose(spec.getattribute("chromaticities"), color.REC709_CHROMATICITIES)
    assert spec.getattribute("colorInteropID") == "lin_rec709_scene"
    assert json.loads(spec.getattribute("warpir/config")) == {"a": 2, "b": 1}
    assert spec.getattribute("capDate") is None
    assert spec.getattribute("DateTime") is None
    # The stored matrix multiplies row vectors: its translation is in the last row.
    matrix = np.array(spec.getattribute("worldToCamera")).reshape(4, 4)
    np.testing.assert_allclose(matrix[:, 3], [0, 0, 0, 1])
    ndc = np.array(spec.getattribute("worldToNDC")).reshape(4, 4)
    point = np.array([0.3, 0.2, -5.0])
    row = np.append(point, 1.0) @ ndc
    np.testing.assert_allclose(
        row[:2] / row[3] * [20, 12], camera.project(point[None])[0], atol=1e-3
    )


def test_layers_are_the_same_bytes_every_time(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    for name in ("a", "b"):
        with OutputFolder(tmp_path / name) as out:
            write_layers(out, layers, camera)
            out.write_envmap(four_lobes(directions(8)))
    assert sha256s(tmp_path / "a") == sha256s(tmp_path / "b")


def test_layers_that_do_not_add_up_are_our_bug(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    layers.composite[7, 7] += 0.5
    with pytest.raises(ValueError, match="differs"), OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)


def test_non_finite_layer_is_a_numeric_failure(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    assert layers.normal is not None
    layers.normal[0, 0, 1] = np.nan
    with pytest.raises(InputError, match=r"normal\.Y") as caught:
        with OutputFolder(tmp_path / "out") as out:
            write_layers(out, layers, camera)
    assert caught.value.code == ExitCode.NUMERIC
    assert not (tmp_path / "out").exists()


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


# ------------------------------------------------------------------------- real data, imports


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


@needs_shared
def test_real_maps_have_their_sun_where_it_was_measured() -> None:
    # Elevation [deg] and column / width * 360 of the brightest texel, from the data's own sheet.
    for name, elevation, column in (
        ("pmndrs_sunrise", 8, 216),
        ("noon_grass_1k", 86, 109),
        ("pmndrs_sky", 48, 214),
    ):
        texels = read_envmap(SHARED / "hdri" / f"{name}.hdr")
        row, col = np.unravel_index(int(color.luminance(texels).argmax()), texels.shape[:2])
        assert 90 - 180 * (row + 0.5) / len(texels) == pytest.approx(elevation, abs=1)
        assert 360 * (col + 0.5) / texels.shape[1] == pytest.approx(column, abs=1)
    with pytest.raises(InputError, match="2:1"):
        read_envmap(SHARED / "hdri" / "odd" / "urban_alley_01_1k_256x512.hdr")


def test_importing_loads_no_heavy_library() -> None:
    code = (
        "import sys, warpir.files, warpir.camera; "
        "heavy = {'torch', 'warp', 'trimesh', 'PIL', 'OpenImageIO', 'OpenEXR', 'colour'}; "
        "print(*sorted(heavy & set(sys.modules)))"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (child.returncode, child.stdout) == (0, "\n"), child.stderr
