"""Photographs, plates and masks in, on files made here; values are asserted exactly."""

import io
import os
import re
import struct
import tracemalloc
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest
from PIL import Image, ImageCms, ImageOps

from tests.builders.image_files import (
    codes8,
    fixed,
    icc_profile,
    matrix_profile,
    png_chunk,
    png_header,
    table_profile,
    with_chunks,
    write_image,
)
from tests.builders.refusals import unreadable
from tests.development_data import SHARED, needs_shared
from warpir.core import color
from warpir.core.arrays import Float64Array
from warpir.core.errors import InputError
from warpir.io.images import color_profile
from warpir.io.images.photos import read_envmap, read_mask, read_photo

fails = partial(unreadable, read_photo)


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


@pytest.mark.parametrize("name", ["p.png", "p.tif"], ids="I11-{}".format)
def test_sixteen_bits_survive(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    codes = rng.integers(0, 65536, (9, 7, 3), dtype=np.uint16)
    codes[0, 0] = 57300
    photo = read_photo(write_image(tmp_path / name, codes))
    assert photo.codes.dtype == np.uint16
    np.testing.assert_array_equal(photo.codes, codes)
    np.testing.assert_array_equal(np.round(photo.srgb * 65535.0), codes)


@pytest.mark.parametrize("name", ["p.exr", "p.tif"], ids="I12-{}".format)
def test_float_plates_are_linear(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    plate = rng.normal(1.0, 1.0, (9, 7, 3)).astype(np.float32)
    photo = read_photo(write_image(tmp_path / name, plate))
    np.testing.assert_array_equal(photo.codes, plate)
    np.testing.assert_array_equal(photo.linear(), plate)
    expected = np.clip(plate, 0.0, 1.0).astype(np.float64) ** (1 / 2.2)
    np.testing.assert_allclose(photo.srgb, expected, atol=1e-6)
    assert any("linear" in notice for notice in photo.notices)


@pytest.mark.case("I12")
def test_non_finite_plate_pixels_are_counted(tmp_path: Path) -> None:
    plate = np.ones((4, 5, 3), np.float32)
    plate[1, 2, 0], plate[3, 4] = np.nan, np.inf
    photo = read_photo(write_image(tmp_path / "p.exr", plate))
    assert np.isfinite(photo.codes).all()
    assert any(notice.startswith("2 non-finite") for notice in photo.notices)


@pytest.mark.parametrize("orientation", range(1, 9), ids="I7-orientation-{}".format)
@pytest.mark.parametrize("name", ["p.png", "p.tif", "p.jpg", "p.webp"])
def test_orientations_equal_pillows(
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


@pytest.mark.parametrize(
    ("size", "stated", "holds"),
    [((40, 30), (4032, 3024), True), ((30, 40), (4032, 3024), True), ((40, 30), (40, 30), True),
     ((30, 30), (4032, 3024), False), ((40, 22), (4032, 3024), False), ((40, 30), (0, 0), True)],
)  # fmt: skip
def test_focal_length_is_of_the_whole_picture(
    size: tuple[int, int],
    stated: tuple[int, int],
    holds: bool,
    tmp_path: Path,
    rng: np.random.Generator,
) -> None:
    """A picture of another shape than EXIF's was cropped: its focal length holds no longer."""
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0xA405: 28, 0xA002: stated[0], 0xA003: stated[1]})
    Image.fromarray(codes8(rng)).resize(size).save(tmp_path / "p.jpg", exif=exif)
    photo = read_photo(tmp_path / "p.jpg")
    assert photo.focal_35mm == (28.0 if holds else None)
    assert any("cropped" in notice for notice in photo.notices) != holds


@pytest.mark.parametrize("told_by", ["XMP", "EXIF"])
def test_panorama_has_no_focal_length(
    told_by: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    """What was joined from many views is no pinhole's picture; as a light it is one as it is."""
    exif, told = Image.Exif(), {}
    exif.get_ifd(0x8769)[0xA405] = 26
    if told_by == "EXIF":
        exif.get_ifd(0x8769)[0xA401] = 6
    else:
        told["xmp"] = (
            b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/'
            b'22-rdf-syntax-ns#"><rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/'
            b'panorama/" GPano:ProjectionType="equirectangular"/></rdf:RDF></x:xmpmeta>'
        )
    Image.fromarray(codes8(rng)).resize((64, 32)).save(tmp_path / "p.jpg", exif=exif, **told)
    photo = read_photo(tmp_path / "p.jpg")
    assert photo.focal_35mm is None
    assert any("panorama" in notice for notice in photo.notices)
    notices: list[str] = []
    read_envmap(tmp_path / "p.jpg", pictures=True, notices=notices)
    assert not any("panorama" in notice for notice in notices)


@pytest.mark.parametrize("mode", ["L", "1", "P", "LA"], ids="I9-{}".format)
def test_other_layouts_are_expanded(tmp_path: Path, rng: np.random.Generator, mode: str) -> None:
    picture = Image.fromarray(codes8(rng)).convert(mode)
    picture.save(tmp_path / "p.png")
    photo = read_photo(tmp_path / "p.png")
    np.testing.assert_array_equal(photo.codes, np.asarray(picture.convert("RGB")))


@pytest.mark.case("I10")
def test_i10_alpha_is_refused_unless_asked(tmp_path: Path, rng: np.random.Generator) -> None:
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


@pytest.mark.parametrize("name", ["p.png", "p.webp", "p.tif"], ids="I13-{}".format)
def test_first_of_several_frames(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    first, second = Image.fromarray(codes8(rng)), Image.fromarray(codes8(rng))
    first.save(tmp_path / name, save_all=True, append_images=[second], lossless=True)
    photo = read_photo(tmp_path / name)
    np.testing.assert_array_equal(photo.codes, np.asarray(first))
    assert any("first" in notice for notice in photo.notices)


@pytest.mark.parametrize("level", [0, 9, 255], ids="I16-level-{}".format)
def test_constant_photo_is_noted(tmp_path: Path, level: int) -> None:
    Image.fromarray(np.full((4, 4, 3), level, np.uint8)).save(tmp_path / "p.png")
    assert any("no signal" in notice for notice in read_photo(tmp_path / "p.png").notices)


@pytest.mark.parametrize("name", ["p.txt", "a?b=c.png"])
@pytest.mark.case("I17")
def test_i17_names_do_not_matter(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    Image.fromarray(codes8(rng)).save(tmp_path / name, format="PNG")
    assert read_photo(tmp_path / name).kind == "png"


@pytest.mark.case("I17")
def test_i17_name_that_is_no_text(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / os.fsdecode(b"caf\xe9.png")
    Image.fromarray(codes8(rng)).save(tmp_path / "p.png")
    (tmp_path / "p.png").rename(path)
    with pytest.raises(InputError, match="not UTF-8"):
        read_photo(path)


@pytest.mark.case("E3")
def test_e3_bit_rot_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    ramp = np.linspace(0.0, 1.0, 64 * 96 * 3, dtype=np.float32).reshape(64, 96, 3)  # compresses
    path = write_image(tmp_path / "p.exr", ramp)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 40] = bytes(rng.integers(0, 256, 40, dtype=np.uint8))
    path.write_bytes(content)
    fails(path, "corrupt")


@pytest.mark.parametrize("kind", ["jpg", "png", "tif", "webp", "exr", "hdr"])
@pytest.mark.parametrize("share", [0.05, 0.6, 0.97])
@pytest.mark.case("I3", "E1", "E12")
def test_i3_e1_e12_truncated_files_are_refused(
    tmp_path: Path, rng: np.random.Generator, kind: str, share: float
) -> None:
    path = tmp_path / f"p.{kind}"
    if kind in ("exr", "hdr"):
        write_image(path, rng.random((64, 96, 3), dtype=np.float32))
    else:
        Image.fromarray(codes8(rng, 64, 96)).save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * share)])
    fails(path, "truncated" if share > 0.1 else "")


@pytest.mark.case("E2")
def test_e2_second_part_cut_off(tmp_path: Path, rng: np.random.Generator) -> None:
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
    ("kind", "cut"),
    [
        pytest.param("scanlineimage", 0, id="E2-whole"),
        pytest.param("scanlineimage", 100, id="E2-rows-cut"),
        pytest.param("tiledimage", 0, id="E2-tiles-whole"),
        pytest.param("tiledimage", 100, id="E2-tiles-cut"),
    ],
)
def test_parts_that_are_not_used_are_not_decoded(tmp_path: Path, kind: str, cut: int) -> None:
    """Their ends are read alone, and tell whether they are there."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    header["displayWindow"] = (np.zeros(2, np.int32), np.array([63, 63], np.int32))
    other = {**header, "type": getattr(OpenEXR, kind)}
    if kind == "tiledimage":
        other["tiles"] = OpenEXR.TileDescription()
    planes = {c: np.full((64, 64), 0.5, np.float32) for c in "RGB"}
    depth = {"Z": np.zeros((5000, 5000), np.float32)}
    parts = [OpenEXR.Part(header, planes, "a"), OpenEXR.Part(other, depth, "b")]
    path = tmp_path / "p.exr"
    OpenEXR.File(parts).write(str(path))
    path.write_bytes(path.read_bytes()[: path.stat().st_size - cut])
    tracemalloc.start()
    try:
        if cut:
            fails(path, "1 of 2 parts readable")
        else:
            assert any("2 parts" in notice for notice in read_photo(path).notices)
            fails(path, "found 5000 x 5000", "--max-pixels", max_pixels=4000 * 4000)
            fails(path, "too large an image", "--max-pixels", max_pixels=64 * 64)
        assert tracemalloc.get_traced_memory()[1] < 30e6  # the part has 100 MB
    finally:
        tracemalloc.stop()


@pytest.mark.case("I5")
def test_i5_largest_limit_is_taken(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "p.png"
    Image.fromarray(codes8(rng, 8, 8)).save(path)
    assert read_photo(path, max_pixels=10**14).linear().shape == (8, 8, 3)


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
@pytest.mark.case("I6")
def test_i6_other_content_is_refused(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    fails(tmp_path / name, "JPEG", "export" if b"heic" in content else "")


@pytest.mark.parametrize(
    ("case", "head"),
    [
        ("I6-HEIC", b"\0\0\0\x18ftypheic"),
        ("I6-HEIC-mif1", b"\0\0\0\x18ftypmif1"),
        ("I6-AVIF", b"\0\0\0\x1cftypavif"),
        ("I6-camera raw-cr3", b"\0\0\0\x18ftypcrx "),
        ("I6-a film", b"\0\0\0\x14ftypqt  "),
        ("I6-camera raw-raf", b"FUJIFILMCCD-RAW 0201"),
        ("I6-camera raw-rw2", b"IIU\0\x18\0\0\0"),
        ("I6-camera raw-cr2", b"II*\0\x10\0\0\0CR\x02\0"),
        ("I6-camera raw-dng", b"MM\0*\0\0\0\x08\0\x01" + struct.pack(">HHII", 50706, 1, 4, 0)),
        ("I6-camera raw-nef", b"II*\0\x08\0\0\0\x01\0" + struct.pack("<HHII", 254, 4, 1, 1)),
        ("I6-JPEG XL", b"\0\0\0\x0cJXL \r\n"),
        ("I6-JPEG 2000", b"\xff\x4f\xff\x51"),
        ("I6-Photoshop", b"8BPS\0\x01"),
        ("I6-PDF", b"%PDF-1.7"),
        ("I13-GIF", b"GIF89a"),
    ],
)
def test_foreign_kinds_are_named(tmp_path: Path, case: str, head: bytes) -> None:
    (tmp_path / "p.jpg").write_bytes(head + bytes(60))
    fails(tmp_path / "p.jpg", case.split("-")[1], "export it as JPEG or 16-bit TIFF")


@pytest.mark.case("I5")
def test_i5_large_photo_costs_nothing_until_it_is_allowed(tmp_path: Path) -> None:
    """10000 x 10000 is refused from its header; an allowed photo takes what its arrays take."""
    Image.new("1", (10000, 10000)).save(tmp_path / "p.png")
    tracemalloc.start()
    try:
        fails(tmp_path / "p.png", "10000 x 10000", "--max-pixels")
        assert tracemalloc.get_traced_memory()[1] < 2**20
        codes = np.zeros((500, 1000, 3), np.uint8)
        codes[0] = 255
        Image.fromarray(codes).save(tmp_path / "q.png")
        tracemalloc.reset_peak()
        read_photo(tmp_path / "q.png")
        # 3 codes and 3 floats a pixel stay; the floats are made by way of a second array.
        assert tracemalloc.get_traced_memory()[1] / 500_000 < 3 + 2 * 12 + 4
    finally:
        tracemalloc.stop()


@pytest.mark.case("I1", "I2", "I18")
def test_i1_i2_i18_things_that_are_not_files(tmp_path: Path) -> None:
    fails(tmp_path / "missing.jpg", "no such file")
    fails(tmp_path, "folder")
    (tmp_path / "empty.jpg").touch()
    fails(tmp_path / "empty.jpg", "empty file")
    os.mkfifo(tmp_path / "pipe.jpg")
    fails(tmp_path / "pipe.jpg", "not a regular file")
    (tmp_path / "loop.jpg").symlink_to("loop.jpg")
    fails(tmp_path / "loop.jpg", "not a regular file")
    fails(Path("/dev/zero"), "not a regular file")


@pytest.mark.case("I4", "E12")
def test_i4_e12_size_limit_before_decoding(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "p.png"
    path.write_bytes(png_header(20000, 20000))
    fails(path, "--max-pixels")
    Image.fromarray(codes8(rng)).save(path)
    fails(path, "36 x 24", "--max-pixels", max_pixels=800)
    (tmp_path / "p.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1000000000 +X 1000000000\n"
    )
    fails(tmp_path / "p.hdr", "too large")


@pytest.mark.case("E7", "E8")
def test_e7_e8_layered_exr_names_its_channels(tmp_path: Path) -> None:
    plane = np.ones((4, 6), np.float16)
    header = {"type": OpenEXR.scanlineimage}
    path = str(tmp_path / "p.exr")
    OpenEXR.File(dict(header), {f"beauty.{c}": plane for c in "RGB"}).write(path)
    fails(Path(path), "beauty.R", "layer")
    OpenEXR.File(dict(header), {"Y": plane}).write(path)
    assert read_photo(path).codes.shape == (4, 6, 3)


@pytest.mark.parametrize(
    ("layer", "factor"),
    [("beauty", 1), ("ViewLayer.Combined", 2), (None, None)],
    ids=["E8-beauty", "E8-ViewLayer", "E8-none"],
)
def test_layers_are_chosen_by_name(
    tmp_path: Path, rng: np.random.Generator, layer: str | None, factor: int | None
) -> None:
    planes = [rng.random((4, 6), dtype=np.float32) for _ in range(3)]
    channels = {f"beauty.{c}": plane for c, plane in zip("RGB", planes, strict=True)}
    channels |= {f"ViewLayer.Combined.{c}": 2 * p for c, p in zip("RGB", planes, strict=True)}
    channels |= {"ViewLayer.Combined.A": np.ones((4, 6), np.float32), "Depth.Z": planes[0]}
    path = tmp_path / "p.exr"
    OpenEXR.File({}, channels).write(str(path))
    if factor is None:
        fails(path, "no RGB channels", "ViewLayer.Combined, beauty", "--layer")
        fails(path, "no layer 'bauty'", "bauty.R", layer="bauty")
        return
    codes = read_photo(path, layer=layer).codes
    np.testing.assert_array_equal(codes, factor * np.stack(planes, axis=-1))


@pytest.mark.case("E8")
def test_e8_colors_of_a_later_part(tmp_path: Path, rng: np.random.Generator) -> None:
    planes = [rng.random((4, 6), dtype=np.float32) for _ in range(2)]
    parts = [
        OpenEXR.Part({}, {"Z": planes[0]}, "depth"),
        OpenEXR.Part({}, dict.fromkeys("RGB", planes[0]), "left"),
        OpenEXR.Part({}, dict.fromkeys("RGB", planes[1]), "right"),
    ]
    OpenEXR.File(parts).write(str(tmp_path / "p.exr"))
    photo = read_photo(tmp_path / "p.exr")
    np.testing.assert_array_equal(photo.codes[..., 0], planes[0])
    assert "3 parts: number 2 is used" in photo.notices
    right = read_photo(tmp_path / "p.exr", layer="right")
    np.testing.assert_array_equal(right.codes[..., 2], planes[1])


@pytest.mark.case("E8")
def test_e8_layer_of_a_photo_without_layers(tmp_path: Path, rng: np.random.Generator) -> None:
    Image.fromarray(codes8(rng)).save(tmp_path / "p.png")
    fails(tmp_path / "p.png", "no layers", "--layer", layer="beauty")


@pytest.mark.parametrize("case", ["NO", "RLE", "ZIPS", "PIZ", "PXR24", "B44", "DWAA", "ZSTD"])
@pytest.mark.case("E10")
def test_e10_compressions(tmp_path: Path, case: str) -> None:
    """What loses nothing is exact; the others stay near a smooth image."""
    ramp = np.linspace(0.25, 1.0, 32 * 48).reshape(32, 48).astype(np.float16)
    kind = getattr(OpenEXR, f"{case}_COMPRESSION")
    OpenEXR.File({"compression": kind}, dict.fromkeys("RGB", ramp)).write(str(tmp_path / "p.exr"))
    found = read_photo(tmp_path / "p.exr").codes[..., 1]
    lossy = case in ("B44", "DWAA")
    np.testing.assert_allclose(found, ramp.astype(np.float32), atol=0.01 if lossy else 0.0)


@pytest.mark.case("E10")
def test_e10_tiles(tmp_path: Path, rng: np.random.Generator) -> None:
    pixels = rng.random((40, 56, 3), dtype=np.float32)
    spec = oiio.ImageSpec(56, 40, 3, "float")
    spec.tile_width = spec.tile_height = 16
    writer = oiio.ImageOutput.create(str(tmp_path / "p.exr"))
    assert writer.open(str(tmp_path / "p.exr"), spec)
    assert writer.write_image(pixels) and writer.close()
    np.testing.assert_array_equal(read_photo(tmp_path / "p.exr").codes, pixels)


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("E10-deep", "deep"),
        ("E10-luminance-chroma", "luminance/chroma"),
        ("E10-subsampled", "Subsampled"),
        ("E10-uint32", "pixel type not supported"),
        ("E7-depth-alone", "no RGB channels (found Z;"),
        ("E7-alpha-alone", "no RGB channels (found A;"),
    ],
)
def test_unusual_plates_are_refused_by_name(tmp_path: Path, case: str, words: str) -> None:
    plane = np.ones((4, 4), np.float32)
    path = tmp_path / "p.exr"
    names = {"E10-luminance-chroma": ("Y", "RY", "BY"), "E7-depth-alone": "Z"}
    names["E7-alpha-alone"] = "A"
    if case == "E10-deep":
        spec = oiio.ImageSpec(4, 4, 3, "float")
        spec.channelnames, spec.deep = ("R", "G", "B"), True
        writer = oiio.ImageOutput.create(str(path))
        assert writer.open(str(path), spec)
        samples = oiio.DeepData()
        samples.init(16, 3, [oiio.TypeFloat] * 3, ("R", "G", "B"))
        samples.set_samples(0, 1)
        assert writer.write_deep_image(samples) and writer.close()
    elif case == "E10-uint32":
        OpenEXR.File({}, dict.fromkeys("RGB", plane.astype(np.uint32))).write(str(path))
    else:
        OpenEXR.File({}, dict.fromkeys(names.get(case, "RGB"), plane)).write(str(path))
    if case == "E10-subsampled":  # name, type 2 = float, linear, sampling 1 x 1 becomes 2 x 2
        channel = b"R\0" + struct.pack("<IIII", 2, 0, 1, 1)
        content = path.read_bytes()
        assert content.count(channel) == 1
        path.write_bytes(content.replace(channel, channel[:-8] + struct.pack("<II", 2, 2)))
    fails(path, words)


AP1 = (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767)
AP1_TO_REC709 = np.array(  # ACES central, Bradford from its white to D65; rows add up to 1
    [
        [1.70505, -0.62179, -0.08326],
        [-0.13026, 1.14080, -0.01055],
        [-0.02400, -0.12897, 1.15297],
    ]
)


@pytest.mark.parametrize("case", ["chromaticities", "colorInteropID", "Rec.709"])
@pytest.mark.case("I12")
def test_i12_stated_primaries_of_plates_are_followed(
    tmp_path: Path, rng: np.random.Generator, case: str
) -> None:
    plate = rng.random((4, 6, 3), dtype=np.float32)
    header: dict[str, Any] = {
        "chromaticities": {"chromaticities": AP1},
        "colorInteropID": {"colorInteropID": "lin_ap1_scene"},
        "Rec.709": {"chromaticities": color.REC709_CHROMATICITIES},
    }[case]
    channels = {c: np.ascontiguousarray(plate[..., k]) for k, c in enumerate("RGB")}
    OpenEXR.File(header, channels).write(str(tmp_path / "p.exr"))
    photo = read_photo(tmp_path / "p.exr")
    converted = any("primaries" in notice for notice in photo.notices)
    assert converted == (case != "Rec.709")
    expected = plate @ AP1_TO_REC709.T if converted else plate
    np.testing.assert_allclose(photo.codes, expected, atol=2e-4 if converted else 0)


@pytest.mark.case("I12")
def test_i12_what_is_not_followed_is_noted(tmp_path: Path) -> None:
    plane = np.eye(4, dtype=np.float32)
    path = str(tmp_path / "p.exr")
    for header, words in (
        ({"pixelAspectRatio": 2.0}, "pixel aspect ratio 2"),
        ({"displayWindow": (np.array([1, 0], np.int32), np.array([3, 3], np.int32))}, "overscan"),
        ({"colorInteropID": "lin_of_mine"}, "lin_of_mine is not followed"),
        ({"chromaticities": (0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3)}, "broken"),
    ):
        OpenEXR.File(header, dict.fromkeys("RGB", plane)).write(path)
        assert any(words in notice for notice in read_photo(path).notices)


@pytest.mark.case("E11")
def test_e11_plates_are_divided_by_their_exposure(tmp_path: Path) -> None:
    path = write_image(tmp_path / "p.hdr", np.full((8, 12, 3), 0.5, np.float32))
    path.write_bytes(path.read_bytes().replace(b"FORMAT", b"EXPOSURE=4.0\nFORMAT", 1))
    np.testing.assert_array_equal(read_photo(path).linear(), np.float32(0.125))


def test_plate_is_exposed_for_the_estimators(tmp_path: Path, rng: np.random.Generator) -> None:
    """The 99th percentile shows as .9, whatever the plate's unit; a photograph stays as it is."""
    plate = rng.uniform(0.0, 30.0, (40, 50, 3)).astype(np.float32)
    photo = read_photo(write_image(tmp_path / "p.exr", plate))
    shown, factor = photo.exposed()
    assert np.percentile(shown, 99.0) == pytest.approx(0.9, abs=1e-3)
    unclipped = shown < 1.0
    np.testing.assert_allclose(shown[unclipped] ** 2.2, factor * plate[unclipped], rtol=1e-3)
    black = replace(photo, codes=np.zeros_like(plate))
    assert black.exposed()[1] == 1.0 and not black.exposed()[0].any()
    codes = replace(photo, codes=np.zeros((40, 50, 3), np.uint8))
    assert codes.exposed() == (codes.srgb, 1.0)


@pytest.mark.case("I12")
def test_i12_bright_plate_becomes_srgb_codes(tmp_path: Path) -> None:
    """The picture is clipped and sRGB, as its file says; `linear` keeps what is above."""
    plate = np.full((4, 5, 3), 0.18, np.float32)
    plate[1, 2], plate[2, 2] = 7.5, -0.25
    photo = read_photo(write_image(tmp_path / "p.exr", plate))
    np.testing.assert_array_equal(photo.linear(), plate)
    assert any("composite.png clips 2 pixels" in notice for notice in photo.notices)
    shown = photo.encode(photo.srgb, np.zeros((4, 5), bool))
    assert shown.dtype == np.uint16
    grey = 1.055 * 0.18 ** (1 / 2.4) - 0.055
    assert abs(int(shown[0, 0, 0]) - grey * 65535) <= 1
    assert (shown[1, 2] == 65535).all() and (shown[2, 2] == 0).all()


@pytest.mark.case("E5")
def test_strict_refuses_what_would_be_repaired(tmp_path: Path) -> None:
    plate = np.ones((4, 5, 3), np.float32)
    plate[1, 2, 0] = np.nan
    fails(write_image(tmp_path / "p.exr", plate), "found 1 such", strict=True)


@pytest.mark.parametrize(
    "read", [lambda path: read_photo(path).codes, read_envmap], ids=["E9-photo", "E9-envmap"]
)
def test_data_window_is_placed_in_the_display_window(tmp_path: Path, read: Any) -> None:
    """With a negative origin, too; around it is nothing."""
    plane = np.arange(1, 25, dtype=np.float32).reshape(4, 6)
    header = {
        "type": OpenEXR.scanlineimage,
        "dataWindow": (np.array([-2, 3], np.int32), np.array([3, 6], np.int32)),
        "displayWindow": (np.array([0, 0], np.int32), np.array([11, 5], np.int32)),
    }
    path = str(tmp_path / "p.exr")
    OpenEXR.File(header, dict.fromkeys("RGB", plane)).write(path)
    expected = np.zeros((6, 12), np.float32)
    expected[3:6, 0:4] = plane[0:3, 2:6]
    np.testing.assert_array_equal(read(path)[..., 1], expected)


# ----------------------------------------------------------------------------------- profiles


@pytest.mark.case("I8")
def test_i8_display_p3_is_converted_and_comes_back(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    icc = matrix_profile("p3")
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


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colors_beyond_srgb_stay_in_the_shadow(
    tmp_path: Path, rng: np.random.Generator, dtype: type
) -> None:
    """Ground that keeps its light keeps its codes, and half as much light keeps their hue."""
    top = np.iinfo(dtype).max
    codes = rng.integers(0, top + 1, (16, 16, 3)).astype(dtype)
    codes[0, 0] = top, 0, 0
    photo = read_photo(write_image(tmp_path / "p.tif", codes, ICCProfile=matrix_profile("p3")))
    assert ((photo.srgb == 0.0) | (photo.srgb == 1.0)).any(axis=-1).mean() > 0.2
    everywhere = np.ones((16, 16), bool)
    for kept in (1.0, 0.5):
        shown = photo.srgb * np.float32(kept ** (1.0 / 2.2))
        edited = photo.encode(shown, everywhere, np.full(codes.shape, kept, np.float32))
        # The profile's curve is 2.2 as well, but sRGB between is not quite. Clipped: off by .25.
        expected = codes * kept ** (1.0 / 2.2)
        assert np.abs(edited - expected).max() <= (1e-4 if kept == 1.0 else 0.08) * top
        hidden = photo.encode(shown, everywhere, np.zeros(codes.shape, np.float32))
        np.testing.assert_array_equal(hidden, photo.encode(shown, everywhere))
    assert np.abs(photo.encode(photo.srgb, everywhere).astype(int) - codes).max() > 0.1 * top


def test_only_changed_pixels_get_new_codes(tmp_path: Path, rng: np.random.Generator) -> None:
    codes = rng.integers(0, 65536, (8, 8, 3), dtype=np.uint16)
    photo = read_photo(write_image(tmp_path / "p.png", codes))
    changed = np.zeros((8, 8), bool)
    changed[2, 3] = True
    edited = photo.encode(np.full((8, 8, 3), 0.5, np.float32), changed)
    np.testing.assert_array_equal(edited[~changed], codes[~changed])
    np.testing.assert_array_equal(edited[2, 3], 32768)
    assert edited.dtype == np.uint16


@pytest.mark.case("I8")
def test_i8_srgb_profile_changes_nothing(tmp_path: Path, rng: np.random.Generator) -> None:
    icc = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    codes = codes8(rng)
    Image.fromarray(codes).save(tmp_path / "p.png", icc_profile=icc)
    photo = read_photo(tmp_path / "p.png")
    assert (photo.icc, photo.notices) == (None, ())
    np.testing.assert_array_equal(photo.srgb, codes.astype(np.float32) / np.float32(255))


@pytest.mark.parametrize(
    "case", ["rubbish", "lab", "tag-count", "curve-count", "cut", "singular", "thin"]
)
@pytest.mark.case("I8")
def test_unusable_profiles_are_noted(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    icc = matrix_profile("p3")
    many = struct.pack(">I", 2**31)
    red, green = fixed(0.51512, 0.24120, -0.00105), fixed(0.29198, 0.69225, 0.04189)
    icc = {
        "rubbish": b"rubbish" * 30,
        "lab": ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB")).tobytes(),
        "tag-count": icc[:128] + many + icc[132:],
        "curve-count": icc.replace(b"curv\0\0\0\0\0\0\0\x01", b"curv\0\0\0\0" + many),
        "cut": icc[:300],
        "singular": icc.replace(green, red),
        "thin": icc.replace(red[:4], bytes(4)).replace(green[:4], bytes(4)),
    }[case]
    Image.fromarray(codes8(rng)).save(tmp_path / "p.jpg", icc_profile=icc)
    assert any("taken as sRGB" in notice for notice in read_photo(tmp_path / "p.jpg").notices)


ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, 0.3127, 0.3290)
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, 0.3127, 0.3290)
REC2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, 0.3127, 0.3290)
SRGB_CURVE = struct.pack(
    ">4s4xHxx5i",
    b"para",
    3,
    *(round(65536 * n) for n in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)),
)


def gamma_curve(gamma: float) -> bytes:
    return b"curv\0\0\0\0" + struct.pack(">IHxx", 1, round(gamma * 256))


@pytest.mark.parametrize(
    ("primaries", "curve"),
    [(ADOBE_RGB, gamma_curve(563 / 256)), (P3, SRGB_CURVE)],
    ids=["I8-Adobe-RGB", "I8-Display-P3"],
)
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16], ids=["8-bit", "16-bit"])
def test_wide_profiles_against_little_cms(
    tmp_path: Path,
    rng: np.random.Generator,
    primaries: tuple[float, ...],
    curve: bytes,
    dtype: type,
) -> None:
    """LittleCMS, in 8 bits, is the referee of colours; codes come back to 1.2 of 16 bits."""
    icc = color_profile.matrix_profile(primaries, curve)
    codes = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    codes[0, :4] = [[255, 255, 255], [128, 128, 128], [0, 0, 0], [200, 120, 60]]
    deep = codes.astype(dtype) * (257 if dtype is np.uint16 else 1)
    path = write_image(tmp_path / "p.tif", deep, ICCProfile=icc)
    photo = read_photo(path)
    assert photo.icc == icc
    np.testing.assert_array_equal(photo.codes, deep)
    source = ImageCms.ImageCmsProfile(io.BytesIO(icc))
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    referee = np.asarray(ImageCms.profileToProfile(Image.fromarray(codes), source, srgb), float)
    inside = ((photo.srgb > 0.0) & (photo.srgb < 1.0)).all(axis=-1)
    assert inside.sum() > 100
    assert np.abs(photo.srgb * 255.0 - referee)[inside].max() < 1.0
    back = photo.encode(photo.srgb, np.ones((16, 16), bool)).astype(float)
    assert np.abs(back - deep)[inside].max() <= (1.2 if dtype is np.uint16 else 0.0)


def table_curve(values: Float64Array) -> bytes:
    numbers = np.round(65535.0 * values).astype(">u2")
    return b"curv\0\0\0\0" + struct.pack(">I", len(numbers)) + numbers.tobytes()


@pytest.mark.parametrize(
    "curve",
    [
        table_curve(np.linspace(-0.03, 1.03, 512).clip(0.0, 1.0) ** 2.2),
        table_curve(np.linspace(0.0, 1.0, 4096) ** 2.6),
        table_curve(np.empty(0)),
    ],
    ids=["clips", "flat-in-the-black", "linear-without-entries"],
)
def test_curves_of_screens_and_linear_ones_against_little_cms(
    tmp_path: Path, rng: np.random.Generator, curve: bytes
) -> None:
    """Those that clip are flat at their ends, so that black and white have no code of their own."""
    icc = color_profile.matrix_profile(P3, curve)
    codes = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    photo = read_photo(write_image(tmp_path / "p.tif", codes, ICCProfile=icc))
    assert photo.icc == icc
    np.testing.assert_array_equal(photo.codes, codes)
    source = ImageCms.ImageCmsProfile(io.BytesIO(icc))
    srgb = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB"))
    referee = np.asarray(ImageCms.profileToProfile(Image.fromarray(codes), source, srgb), float)
    assert np.abs(photo.srgb * 255.0 - referee).max() < 1.0
    deep = write_image(tmp_path / "deep.tif", codes.astype(np.uint16) * 257, ICCProfile=icc)
    np.testing.assert_allclose(read_photo(deep).srgb, photo.srgb, atol=1e-5)


@pytest.mark.case("I8")
def test_i8_profile_with_tables(tmp_path: Path, rng: np.random.Generator) -> None:
    columns = color.primaries_to_xyz(P3, color_profile.D50)
    codes = codes8(rng)
    icc = table_profile(columns)
    Image.fromarray(codes).save(tmp_path / "p.png", icc_profile=icc)
    photo = read_photo(tmp_path / "p.png")
    assert any("in 8 bits" in notice for notice in photo.notices)
    Image.fromarray(codes).save(tmp_path / "q.png", icc_profile=matrix_profile("p3"))
    matrix = read_photo(tmp_path / "q.png").srgb
    # Tables hold no negative numbers, so near the border of sRGB they differ.
    inside = ((matrix > 0.2) & (matrix < 1.0)).all(axis=-1)
    assert inside.sum() > 100
    assert np.abs(photo.srgb - matrix)[inside].max() < 2.0 / 255.0
    tagged = write_image(tmp_path / "p.tif", codes.astype(np.uint16) * 257, ICCProfile=icc)
    fails(tagged, "tables", "convert the image to sRGB or Display P3")


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16], ids=["I8-grey-8-bit", "I8-grey-16-bit"])
def test_grey_profiles_are_followed(tmp_path: Path, dtype: type) -> None:
    icc = icc_profile(b"GRAY", {b"kTRC": gamma_curve(1.8)})
    codes = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).astype(dtype)
    codes *= np.iinfo(dtype).max // 255
    path = write_image(tmp_path / "p.tif", codes, ICCProfile=icc)
    photo = read_photo(path)
    linear = (codes / np.iinfo(dtype).max) ** 1.8
    expected = np.repeat(color.linear_to_srgb(linear), 3, axis=-1)
    np.testing.assert_allclose(photo.srgb, expected, atol=2e-3)
    assert photo.icc is not None and photo.icc[16:20] == b"RGB "
    back = photo.encode(photo.srgb, np.ones((16, 16), bool))
    assert np.abs(back.astype(int) - codes).max() <= np.iinfo(dtype).max // 2000


def gama(gamma: float) -> bytes:
    return png_chunk(b"gAMA", struct.pack(">I", round(1e5 * gamma)))


def chrm(xy: tuple[float, ...]) -> bytes:
    return png_chunk(b"cHRM", struct.pack(">8I", *(round(1e5 * n) for n in (*xy[6:], *xy[:6]))))


CICP_P3 = png_chunk(b"cICP", bytes([12, 13, 0, 1]))
SRGB_CHUNK = png_chunk(b"sRGB", b"\0")


@pytest.mark.parametrize(
    ("case", "chunks", "primaries", "gamma"),
    [
        ("I8-cICP-P3", [CICP_P3], P3, 0.0),
        ("I8-cICP-before-sRGB", [CICP_P3, SRGB_CHUNK, gama(1.0)], P3, 0.0),
        ("I8-cICP-sRGB", [png_chunk(b"cICP", bytes([1, 13, 0, 1])), gama(1.0)], None, 0.0),
        ("I8-cICP-linear", [png_chunk(b"cICP", bytes([9, 8, 0, 1]))], REC2020, 1.0),
        ("I8-sRGB-before-gAMA", [SRGB_CHUNK, gama(1.0)], None, 0.0),
        ("I8-gAMA-linear", [gama(1.0)], color.REC709_CHROMATICITIES, 1.0),
        ("I8-gAMA-1.8", [gama(1 / 1.8)], color.REC709_CHROMATICITIES, 1.8),
        ("I8-gAMA-of-sRGB", [gama(1 / 2.2), chrm(color.REC709_CHROMATICITIES)], None, 0.0),
        ("I8-gAMA-cHRM-P3", [gama(1 / 2.2), chrm(P3)], P3, 2.2),
        ("I8-cHRM-alone", [chrm(P3)], P3, 2.2),
    ],
)  # fmt: skip
def test_png_says_its_colours(
    tmp_path: Path,
    rng: np.random.Generator,
    case: str,
    chunks: list[bytes],
    primaries: tuple[float, ...] | None,
    gamma: float,
) -> None:
    """Against the definition: curve, primaries, sRGB; gamma 0 stands for the sRGB curve."""
    codes = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    photo = read_photo(with_chunks(tmp_path / "p.png", codes, *chunks))
    np.testing.assert_array_equal(photo.codes, codes)
    shown = codes / 255.0
    if primaries is None:
        assert (photo.icc, photo.notices) == (None, ())
        np.testing.assert_allclose(photo.srgb, shown, atol=1e-6)
        return
    assert photo.icc is not None
    linear = shown**gamma if gamma else color.srgb_to_linear(shown)
    expected = color.linear_to_srgb(linear @ color.primaries_to_rec709(primaries).T)
    np.testing.assert_allclose(photo.srgb, np.clip(expected, 0.0, 1.0), atol=1e-3)


@pytest.mark.case("I8")
def test_i8_cicp_outranks_a_profile(tmp_path: Path, rng: np.random.Generator) -> None:
    codes = codes8(rng)
    icc = color_profile.matrix_profile(ADOBE_RGB, gamma_curve(2.2))
    both = with_chunks(tmp_path / "p.png", codes, CICP_P3, icc_profile=icc)
    cicp = with_chunks(tmp_path / "q.png", codes, CICP_P3)
    np.testing.assert_array_equal(read_photo(both).srgb, read_photo(cicp).srgb)
    profile = with_chunks(tmp_path / "r.png", codes, gama(1.0), icc_profile=icc)
    assert read_photo(profile).icc == icc


@pytest.mark.parametrize(
    ("case", "chunk", "words"),
    [
        ("I8-unknown-cICP", png_chunk(b"cICP", bytes([5, 13, 0, 1])), "cICP 5,13,0,1"),
        ("I8-narrow-cICP", png_chunk(b"cICP", bytes([12, 13, 0, 0])), "cICP 12,13,0,0"),
        ("I8-gAMA-0", gama(0.0), "broken"),
        ("I8-cHRM-0", chrm((0.0,) * 8), "broken"),
    ],
)
def test_strange_png_colours_are_noted(
    tmp_path: Path, rng: np.random.Generator, case: str, chunk: bytes, words: str
) -> None:
    photo = read_photo(with_chunks(tmp_path / "p.png", codes8(rng), chunk))
    assert photo.icc is None and any(words in notice for notice in photo.notices)


@pytest.mark.parametrize(("curve", "word"), [(16, "PQ"), (18, "HLG")], ids=["I8-PQ", "I8-HLG"])
def test_hdr_signals_in_png_are_refused(
    tmp_path: Path, rng: np.random.Generator, curve: int, word: str
) -> None:
    chunk = png_chunk(b"cICP", bytes([9, curve, 0, 1]))
    fails(with_chunks(tmp_path / "p.png", codes8(rng), chunk), word, "sRGB")


UNCALIBRATED = Image.Exif()
UNCALIBRATED.get_ifd(0x8769)[0xA001] = 65535
GAIN_MAP = b"<x:xmpmeta xmlns:x='adobe:ns:meta/' hdrgm:Version='1.0'></x:xmpmeta>"


@pytest.mark.parametrize(
    ("mode", "options", "words"),
    [
        pytest.param("CMYK", {}, "CMYK", id="I9-CMYK"),
        pytest.param("RGB", {"exif": UNCALIBRATED}, "uncalibrated", id="I8-uncalibrated"),
        pytest.param("RGB", {"xmp": GAIN_MAP}, "gain map", id="I19-gain-map"),
    ],
)
def test_what_a_jpeg_says_is_noted(
    tmp_path: Path, rng: np.random.Generator, mode: str, options: dict[str, Any], words: str
) -> None:
    Image.fromarray(codes8(rng)).convert(mode).save(tmp_path / "p.jpg", **options)
    photo = read_photo(tmp_path / "p.jpg")
    assert photo.codes.shape == (24, 36, 3)
    assert any(words in notice for notice in photo.notices)


@pytest.mark.parametrize(("index", "space"), [("R03", 65535), ("R98", 65535), ("R03", 1)])
def test_adobe_rgb_that_exif_alone_states(
    tmp_path: Path, rng: np.random.Generator, index: str, space: int
) -> None:
    """A camera set to Adobe RGB may embed no profile: as if it had, against the same with one."""
    codes, exif = codes8(rng), Image.Exif()
    exif.get_ifd(0x8769).update({0xA001: space, 0xA005: {1: index, 2: b"0100"}})
    Image.fromarray(codes).save(tmp_path / "p.jpg", exif=exif, quality=100, subsampling=0)
    plain = np.asarray(Image.open(tmp_path / "p.jpg")) / 255.0
    is_adobe = (index, space) == ("R03", 65535)
    if is_adobe:
        xy = color.chromaticities_of("Adobe RGB (1998)")
        linear = plain ** (563 / 256) @ color.primaries_to_rec709(xy).T
        plain = np.clip(color.linear_to_srgb(linear), 0.0, 1.0)
    photo = read_photo(tmp_path / "p.jpg")
    assert (photo.icc is not None) == is_adobe
    np.testing.assert_allclose(photo.srgb, plain, atol=0.01)


def test_gain_map_is_not_applied(tmp_path: Path) -> None:
    """An Ultra HDR picture, as Android writes it, is its base image, with its EXIF and orientation.

    OpenImageIO would multiply it by up to 4 and give half floats.
    """
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 24
    codes = np.zeros((32, 48, 3), np.uint8)
    codes[:, :24], codes[:, 24:] = (200, 60, 40), (60, 90, 180)
    gain = io.BytesIO()
    about = "hdrgm:Version='1.0' hdrgm:GainMapMax='2' hdrgm:HDRCapacityMax='2'"
    Image.new("L", (24, 16), 255).save(gain, "JPEG", xmp=gain_map_xmp(about))
    item = (
        "<rdf:li rdf:parseType='Resource'><Container:Item Item:Mime='image/jpeg' Item:{}/></rdf:li>"
    )
    listed = item.format("Item:Semantic='Primary'")
    listed += item.format(f"Item:Semantic='GainMap' Item:Length='{len(gain.getvalue())}'")
    listed = f"<Container:Directory><rdf:Seq>{listed}</rdf:Seq></Container:Directory>"
    xmp = gain_map_xmp("hdrgm:Version='1.0'", listed)
    path = tmp_path / "p.jpg"
    Image.fromarray(codes).save(path, quality=95, subsampling=0, exif=exif, xmp=xmp)
    path.write_bytes(path.read_bytes() + gain.getvalue())
    photo = read_photo(path)
    assert photo.codes.dtype == np.uint8 and photo.focal_35mm == 24.0
    np.testing.assert_allclose(photo.codes, np.rot90(codes, -1), atol=4)
    assert any("gain map" in notice for notice in photo.notices)


def test_what_is_appended_to_a_jpeg_is_not_looked_at(tmp_path: Path) -> None:
    """A motion photo's film follows the end of the picture; some of its bytes look like scans."""
    path, codes = tmp_path / "p.jpg", np.full((24, 36, 3), 90, np.uint8)
    Image.fromarray(codes).save(path, progressive=True)
    path.write_bytes(path.read_bytes() + 200 * b"film\xff\xda")
    np.testing.assert_allclose(read_photo(path).codes, codes, atol=2)


def gain_map_xmp(attributes: str, content: str = "") -> bytes:
    """Return XMP in the namespaces of Ultra HDR."""
    google = "http://ns.google.com/photos/1.0/container/"
    return (
        "<x:xmpmeta xmlns:x='adobe:ns:meta/'><rdf:RDF xmlns:rdf='http://www.w3.org/1999/02/22-rdf-"
        "syntax-ns#'><rdf:Description xmlns:hdrgm='http://ns.adobe.com/hdr-gain-map/1.0/' "
        f"xmlns:Container='{google}' xmlns:Item='{google}item/' {attributes}>{content}"
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


@pytest.mark.parametrize("case", ["I9-LAB", "I9-uint16-1-bit", "I9-CMYK", "I9-P", "I9-planar"])
def test_tiff_layouts(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    path, codes = tmp_path / "p.tif", codes8(rng)
    picture = Image.fromarray(codes)
    if case == "I9-planar":
        photo = read_photo(write_image(path, codes, planarconfig="separate"))
        np.testing.assert_array_equal(photo.codes, codes)
    elif case == "I9-uint16-1-bit":  # fax: white is 0
        picture.convert("1").save(path, compression="group4")
        bits = np.asarray(picture.convert("1").convert("RGB"))
        np.testing.assert_array_equal(read_photo(path).codes, bits)
    elif case == "I9-LAB":
        picture.convert("LAB").save(path)
        fails(path, "Lab", "RGB")
    else:
        mode = case[3:]
        picture.convert(mode).save(path)
        word = {"CMYK": "CMYK", "P": "palette"}[mode]
        assert any(word in notice for notice in read_photo(path).notices)


@pytest.mark.parametrize("read", [read_photo, read_mask], ids=["I9-PA-photo", "I20-PA-mask"])
def test_channels_that_the_decoder_mixes_up_are_refused(tmp_path: Path, read: Any) -> None:
    """Of a palette with alpha OpenImageIO returns one colour, an index and a neighbour's red."""
    picture = Image.new("RGB", (9, 6), (200, 100, 50))
    picture.convert("PA").save(tmp_path / "p.tif")
    options = {"alpha": "ignore"} if read is read_photo else {"photo_size": (9, 6)}
    with pytest.raises(InputError, match="channels R, A, B"):
        read(tmp_path / "p.tif", **options)


@pytest.mark.parametrize("case", ["I12-float64-1e300", "I12-3e38-in-AP0"])
def test_values_that_overflow_on_the_way_are_counted(tmp_path: Path, case: str) -> None:
    """What is finite in the file but not in a float32 of Rec.709 is repaired, or refused."""
    spec = oiio.ImageSpec(8, 4, 3, "double" if "64" in case else "float")
    path = tmp_path / ("p.tif" if "64" in case else "p.exr")
    pixels = np.full((4, 8, 3), 0.5)
    pixels[0] = 1e300 if "64" in case else (3e38, -3e38, 0.0)
    if "AP0" in case:
        ap0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)
        spec.attribute("chromaticities", oiio.TypeDesc("float[8]"), ap0)
    writer = oiio.ImageOutput.create(str(path))
    assert writer.open(str(path), spec) and writer.write_image(pixels) and writer.close()
    photo = read_photo(path)
    assert np.isfinite(photo.codes).all() and (photo.codes[0] == 0.0).all()
    assert (photo.codes[1:] > 0.4).all()
    assert any(notice.startswith("8 non-finite") for notice in photo.notices)
    fails(path, "not finite (found 8", strict=True)


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


@pytest.mark.parametrize("case", ["I20-labels-16", "I20-labels-palette"])
def test_labels_of_other_files_are_no_mask(tmp_path: Path, case: str) -> None:
    """8-bit codes in 16 bits, and palettes; a dim mask is one."""
    labels = np.zeros((6, 9), np.uint16 if "16" in case else np.uint8)
    labels[2:4, 2:5] = 255 if "16" in case else 1
    picture = Image.fromarray(labels)
    if "palette" in case:
        picture.putpalette([0, 0, 0, 1, 1, 1])
    picture.save(tmp_path / "m.png")
    with pytest.raises(InputError, match="all but black"):
        read_mask(tmp_path / "m.png", (9, 6))
    Image.fromarray(np.full((6, 9), 30, np.uint8)).save(tmp_path / "dim.png")
    assert read_mask(tmp_path / "dim.png", (9, 6)).max() == np.float32(30 / 255)


@pytest.mark.parametrize("case", ["I20-uint16.png", "I20-uint16.tif", "I20-float32.exr"])
def test_deep_masks_keep_their_values(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    kind, _, suffix = case.removeprefix("I20-").partition(".")
    codes = rng.random((4, 6, 1), dtype=np.float32)
    top = 1.0
    if kind == "uint16":
        codes, top = rng.integers(0, 65536, (4, 6, 1), dtype=np.uint16), 65535.0
    mask = read_mask(write_image(tmp_path / f"m.{suffix}", codes), (6, 4))
    np.testing.assert_array_equal(mask, codes[..., 0] / np.float32(top))


@pytest.mark.case("I20")
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
        ("I20-labels", "found 1 at most; expected 255"),
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
    elif case == "I20-labels":
        Image.fromarray((codes > 99).astype(np.uint8)).save(path)
    elif case in ("I20-range", "I20-nan"):
        path = tmp_path / "m.exr"
        value = 1.5 if case == "I20-range" else np.nan
        write_image(path, np.full((4, 6, 1), value, np.float32))
    unreadable(read_mask, path, words, photo_size=size)


@pytest.mark.case("I20")
def test_i20_even_mask_is_noted(tmp_path: Path) -> None:
    Image.fromarray(np.zeros((4, 6), np.uint8)).save(tmp_path / "m.png")
    notices: list[str] = []
    assert read_mask(tmp_path / "m.png", (6, 4), notices=notices).max() == 0.0
    assert any("no signal" in notice for notice in notices)


# -------------------------------------------------------------------------------- damaged bytes


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


@pytest.mark.parametrize("kind", ["png", "jpg", "exr"])
def test_border_of_one_colour_is_told(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    """Bars and frames are nothing that the scene's light or a lens made; sky at one side is."""
    photo = rng.integers(30, 226, (64, 96, 3)).astype(np.uint8)

    def told(picture: np.ndarray) -> list[str]:
        path = tmp_path / f"p.{kind}"
        if kind == "exr":
            write_image(path, picture.astype(np.float32) / 255.0)
        else:
            Image.fromarray(picture).save(path, quality=95)
        return [notice for notice in read_photo(path).notices if "border" in notice]

    assert not told(photo)
    sky = photo.copy()
    sky[:9] = 255
    assert not told(sky)
    night = np.zeros_like(photo)  # lit windows here and there
    night[12:-12, 20:50], night[10:-10, 60:64] = photo[12:-12, 20:50], photo[10:-10, 60:64]
    assert not [n for n in told(night) if "top" in n]
    bars = photo.copy()
    bars[:16] = bars[-16:] = 0
    (notice,) = told(bars)
    # JPEG may touch the last row.
    assert re.search(r"1[56] px at the top, 1[56] px at the bottom: ", notice)
    framed = np.full((96, 128, 3), 250, np.uint8)
    framed[16:-16, 16:-16] = photo
    (notice,) = told(framed)
    assert re.search(r"1[56] px at the left, 1[56] px at the right: ", notice)
