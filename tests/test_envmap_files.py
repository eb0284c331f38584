"""Environment maps in, on files made here; values are asserted exactly."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.image_files import LOBES, codes8, directions, four_lobes, write_image
from warpir import color
from warpir.envmap_conventions import IN_CAMERA_AXES, SEAM_SHIFTS
from warpir.errors import InputError
from warpir.light import rotate_map
from warpir.photo_files import read_envmap

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
needs_shared = pytest.mark.skipif(not SHARED.is_dir(), reason=f"no development data at {SHARED}")


# --------------------------------------------------------------------------- environment maps


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
