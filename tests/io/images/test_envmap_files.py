"""Environment maps in, on files made here; values are asserted exactly."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from tests.builders.image_files import LOBES, codes8, four_lobes, write_image
from tests.builders.refusals import unreadable
from tests.development_data import SHARED, needs_shared
from tests.io.images.test_envmap_conventions import TOOLS
from tests.oracles import texel_direction
from warpir.core import color
from warpir.core.errors import InputError
from warpir.io.images.envmap_conventions import IN_CAMERA_AXES, SEAM_SHIFTS
from warpir.io.images.photos import read_envmap, read_photo

# --------------------------------------------------------------------------- environment maps


def brightest(texels: np.ndarray, rgb: tuple[float, ...]) -> np.ndarray:
    """Direction in which the map shines most in one colour and least in the others."""
    score = texels @ (2 * np.array(rgb) - 1)
    row, column = np.unravel_index(int(score.argmax()), score.shape)
    return texel_direction(*texels.shape[:2])[row, column]


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_orientation_and_chirality(tmp_path: Path, suffix: str) -> None:
    path = write_image(tmp_path / f"m.{suffix}", four_lobes(32))
    texels = read_envmap(path)
    for axis, rgb in LOBES.items():
        assert brightest(texels, rgb) @ axis > 0.99
        mirrored = brightest(texels[:, ::-1], rgb)
        assert (mirrored @ axis > 0.99) == (axis[0] == 0)
    assert texels[0].mean() > texels[-1].mean()
    # As stated in words: centre +Z, left quarter +X.
    of_texels = texel_direction(32, 64)
    np.testing.assert_allclose(of_texels[15:17, 31:33].mean(axis=(0, 1)), [0, 0, 1], atol=0.01)
    np.testing.assert_allclose(of_texels[15:17, 15:17].mean(axis=(0, 1)), [1, 0, 0], atol=0.01)


@pytest.mark.parametrize("convention", sorted(SEAM_SHIFTS.keys() - IN_CAMERA_AXES))
def test_foreign_conventions_by_their_own_formula(tmp_path: Path, convention: str) -> None:
    """Each texel is where the tool's formula looks for its direction."""
    texels = four_lobes(32)
    u, v = TOOLS[convention](texel_direction(32, 64))
    foreign = np.empty_like(texels)
    foreign[(v * 32).astype(int), (u % 1.0 * 64).astype(int)] = texels
    path = write_image(tmp_path / "m.exr", foreign)
    np.testing.assert_array_equal(read_envmap(path, convention=convention), texels)


@pytest.mark.case("E5", "E6")
def test_e5_e6_bad_radiance_is_repaired_and_counted(tmp_path: Path) -> None:
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


@pytest.mark.case("E11")
def test_e11_radiance_orientation_and_exposure(tmp_path: Path, rng: np.random.Generator) -> None:
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


@pytest.mark.parametrize(
    "case",
    ["E7-square", "E7-row", "E7-photo", "E7-channels", "E11-xyze", "E11-old-rle", "E12-garbage",
     "E-missing"],
)  # fmt: skip
def test_wrong_maps_are_refused(tmp_path: Path, rng: np.random.Generator, case: str) -> None:
    path = tmp_path / "m.exr"
    if case in ("E7-square", "E7-row"):
        write_image(path, np.ones((8 if case == "E7-square" else 1, 8, 3), np.float32))
    elif case == "E7-photo":
        Image.fromarray(codes8(rng)).save(path, format="JPEG")
    elif case == "E11-xyze":
        path = write_image(tmp_path / "m.hdr", np.ones((8, 16, 3), np.float32))
        path.write_bytes(path.read_bytes().replace(b"rle_rgbe", b"rle_xyze"))
    elif case == "E7-channels":
        OpenEXR.File({}, dict.fromkeys("UV", np.ones((4, 8), np.float32))).write(str(path))
    elif case == "E11-old-rle":
        row = bytes([200, 100, 50, 129, 1, 1, 1, 15])  # fifteen more of the pixel before
        path = rgbe_file(tmp_path / "m.hdr", "-Y 8 +X 16", np.frombuffer(row * 8, np.uint8))
    elif case == "E12-garbage":
        path.write_bytes(b"#?RADIANCE\n\xff\xfe\x80\n")
    unreadable(read_envmap, path)


@pytest.mark.parametrize("kind", ["png8", "png16", "jpeg", "grey"], ids="E-picture-{}".format)
def test_pictures_are_panoramas_without_a_sun(
    tmp_path: Path, rng: np.random.Generator, kind: str
) -> None:
    """Codes are sRGB, in the exact curve: maps are not the paper's photo."""
    path = tmp_path / "m.png"
    codes = rng.integers(0, 256, (4, 8, 3), dtype=np.uint8)
    if kind == "png16":
        codes = codes.astype(np.uint16) * 257
        write_image(path, codes)
    elif kind == "jpeg":
        codes[:] = codes[..., :1] // 64 * 64
        path = tmp_path / "m.jpg"
        Image.fromarray(codes).save(path, quality=100, subsampling=0)
    elif kind == "grey":
        codes[:] = codes[..., :1]
        Image.fromarray(codes[..., 0]).save(path)
    else:
        Image.fromarray(codes).save(path)
    notices: list[str] = []
    with pytest.raises(InputError, match="expected exr or hdr"):
        read_envmap(path)
    texels = read_envmap(path, pictures=True, notices=notices)
    shown = codes.astype(np.float64) / np.iinfo(codes.dtype).max
    expected = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(texels, expected, atol=0.02 if kind == "jpeg" else 1e-6)
    assert any("not high dynamic range" in notice for notice in notices)


@pytest.mark.case("E7")
def test_e7_single_channel_is_expanded(tmp_path: Path, rng: np.random.Generator) -> None:
    plane = rng.random((4, 8), dtype=np.float32)
    OpenEXR.File({}, {"Y": plane}).write(str(tmp_path / "m.exr"))
    texels = read_envmap(tmp_path / "m.exr")
    np.testing.assert_array_equal(texels, np.repeat(plane[..., None], 3, axis=-1))


@pytest.mark.case("E11")
def test_e11_flat_and_run_length_files_are_one(tmp_path: Path, rng: np.random.Generator) -> None:
    """OpenImageIO writes new run lengths from width 8 on, and narrower files flat."""
    rgbe = rng.integers(128, 256, (4, 8, 4))
    rgbe[..., 3] = 129
    flat = read_envmap(rgbe_file(tmp_path / "a.hdr", "-Y 4 +X 8", rgbe))
    packed = write_image(tmp_path / "b.hdr", flat)
    assert packed.read_bytes().split(b"+X 8\n")[1][:4] == b"\x02\x02\x00\x08"
    np.testing.assert_array_equal(read_envmap(packed), flat)
    tiny = read_envmap(rgbe_file(tmp_path / "c.hdr", "-Y 2 +X 4", rgbe[:2, :4]))
    np.testing.assert_array_equal(tiny, flat[:2, :4])


@pytest.mark.case("E11")
def test_e11_exposures_multiply_and_other_lines_are_noted(tmp_path: Path) -> None:
    rgbe = np.full((4, 8, 4), 129)
    plain = read_envmap(rgbe_file(tmp_path / "a.hdr", "-Y 4 +X 8", rgbe))
    lines = "EXPOSURE=2\nEXPOSURE=4\nGAMMA=2.2\n"
    notices: list[str] = []
    path = rgbe_file(tmp_path / "b.hdr", "-Y 4 +X 8", rgbe, lines)
    np.testing.assert_allclose(8.0 * read_envmap(path, notices=notices), plain, rtol=1e-6)
    assert any("GAMMA" in notice for notice in notices)
    photoshop = "GAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\n"
    notices.clear()
    read_envmap(rgbe_file(tmp_path / "d.hdr", "-Y 4 +X 8", rgbe, photoshop), notices=notices)
    assert notices == []


@pytest.mark.parametrize(
    "lines",
    [
        pytest.param("EXPOSURE=-1\n", id="E11-exposure-negative"),
        pytest.param("EXPOSURE=1e39\n", id="E11-exposure-1e39"),
        pytest.param("EXPOSURE=1e-50\n", id="E11-exposure-1e-50"),
        pytest.param("EXPOSURE=1e-9\n" * 40, id="E11-exposure-product-underflows"),
        pytest.param("EXPOSURE=nan\n", id="E11-exposure-nan"),
    ],
)
def test_an_exposure_that_leaves_no_light_is_refused(lines: str, tmp_path: Path) -> None:
    rgbe = np.full((4, 8, 4), 129)
    for read in (read_envmap, read_photo):
        with pytest.raises(InputError, match="EXPOSURE"):
            read(rgbe_file(tmp_path / "c.hdr", "-Y 4 +X 8", rgbe, lines))


AP0 = (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767)


@pytest.mark.parametrize(
    ("value", "header", "words"),
    [
        pytest.param(np.float32(3e38), {"chromaticities": AP0}, "too bright", id="E5-3e38-in-AP0"),
        pytest.param(np.float32(1e13), {}, "too bright", id="E6-1e13"),
        pytest.param(np.float32(np.inf), {}, "no light in it", id="E5-all-infinite"),
    ],
)
def test_light_that_no_sum_can_hold_is_refused(
    value: np.float32, header: dict[str, Any], words: str, tmp_path: Path
) -> None:
    texels = np.full((4, 8, 3), value)
    texels[0] = 0.0
    channels = {"RGB": OpenEXR.Channel(texels)}
    kind = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION}
    OpenEXR.File({**kind, **header}, channels).write(str(tmp_path / "m.exr"))
    with pytest.raises(InputError, match=words):
        read_envmap(tmp_path / "m.exr")


def test_a_black_panorama_is_told(tmp_path: Path) -> None:
    notices: list[str] = []
    path = write_image(tmp_path / "m.exr", np.zeros((4, 8, 3), np.float32))
    assert read_envmap(path, notices=notices).max() == 0.0
    assert any("no light" in notice for notice in notices)


def test_e_stated_primaries_of_maps_are_followed(tmp_path: Path) -> None:
    """Red of Rec.2020 is more than red of Rec.709; what then is negative becomes 0, and white 1."""
    rgbe = np.array([[[128, 0, 0, 129]] * 8, [[128, 128, 128, 129]] * 8] * 2)
    lines = "PRIMARIES=0.708 0.292 0.170 0.797 0.131 0.046 0.3127 0.3290\n"
    notices: list[str] = []
    path = rgbe_file(tmp_path / "a.hdr", "-Y 4 +X 8", rgbe, lines)
    texels = read_envmap(path, notices=notices)
    # ITU-R BT.2087, matrix from Rec.2020 to Rec.709
    np.testing.assert_allclose(texels[0, 0], texels[1, 0] * (1.6605, 0.0, 0.0), rtol=4e-3)
    assert np.ptp(texels[1, 0]) < 1e-5
    assert any("primaries" in notice for notice in notices)
    broken = rgbe_file(tmp_path / "b.hdr", "-Y 4 +X 8", rgbe, "PRIMARIES=1 2 x\n")
    read_envmap(broken, notices=notices)
    assert "broken" in notices[-1]


@pytest.mark.parametrize("suffix", [".hdr", ".exr"])
def test_a_map_is_read_without_copies(tmp_path: Path, suffix: str) -> None:
    path = write_image(tmp_path / f"map{suffix}", np.full((512, 1024, 3), 0.5, np.float32))
    read_envmap(path)  # loads the libraries
    tracemalloc.start()
    try:
        size = read_envmap(path).nbytes
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 2.0 * size


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
