"""Distortion undone: `warpir.scene.lens` and `warpir.io.images.undistort`."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from warpir.io.images.photos import read_photo
from warpir.io.images.undistort import BAND_ROWS, source_positions, undistort_photo, undistorted
from warpir.scene.camera import Camera
from warpir.scene.lens import STRAIGHT, Lens

BARREL = Lens((-0.2, 0.05, 0.003, -0.002), (0.002, -0.001))
PINCUSHION = Lens((0.15, 0.02, 0.0, 0.0))
CAMERA = Camera(48, 36, 40.0, 42.0, 23.0, 19.0, np.eye(4))


def opencv(x: np.ndarray, y: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's documented model in powers of r."""
    r = np.sqrt(x**2 + y**2)
    factor = 1 + sum(k * r ** (2 * n) for n, k in enumerate(lens.radial, 1))
    p1, p2 = lens.tangential
    return (
        x * factor + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        y * factor + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def test_lens_distorts_as_opencv_does(rng: np.random.Generator) -> None:
    """Every coefficient, against the formula in OpenCV's documentation."""
    x, y = rng.uniform(-0.6, 0.6, (2, 100))
    np.testing.assert_allclose(BARREL.distort(x, y), opencv(x, y, BARREL), atol=1e-15)
    np.testing.assert_array_equal(STRAIGHT.distort(x, y), [x, y])
    assert STRAIGHT.is_straight and not BARREL.is_straight and not Lens((0, 0, 0, 2e-6)).is_straight
    assert not Lens(tangential=(0.0, -2e-6)).is_straight


@pytest.mark.parametrize("k1", [-0.3, -1e-3])
def test_lens_reach_is_where_the_image_folds(k1: float) -> None:
    """d/dr of r + k1 r^3 vanishes at r = sqrt(-1 / (3 k1)); a growing lens has no end."""
    assert Lens((k1, 0, 0, 0)).reach() == pytest.approx(np.sqrt(-1 / (3 * k1)))
    assert PINCUSHION.reach() == STRAIGHT.reach() == np.inf
    # r + 2 k1 r^3 with k2: 1 - 1.5 s + 0.5 s^2 = 0 has the roots 1 and 2; the smaller counts.
    assert Lens((-0.5, 0.1, 0, 0)).reach() == pytest.approx(1.0)


@pytest.mark.case("C7")
def test_points_are_seen_where_the_photo_is_sampled(rng: np.random.Generator) -> None:
    """World points through pinhole and OpenCV's distortion are what the straight pixel samples."""
    u, v, outside = source_positions(CAMERA, BARREL, 3, 30)
    assert not outside.all() and u.shape == (27, 48)
    for _ in range(8):
        row, column = rng.integers(3, 30), rng.integers(48)
        origin, direction = CAMERA.ray(column + 0.5, row + 0.5)
        point = origin + direction * rng.uniform(1.0, 9.0)
        xd, yd = opencv(point[0] / -point[2], -point[1] / -point[2], BARREL)
        sampled = u[row - 3, column], v[row - 3, column]
        np.testing.assert_allclose(sampled, (40.0 * xd + 23.0, 42.0 * yd + 19.0), atol=1e-9)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_ramps_are_read_at_the_positions(dtype: type) -> None:
    """Bilinear reading of a ramp is exact, so the codes are the positions; types are kept."""
    columns, rows = np.meshgrid(np.arange(48.0) + 0.5, np.arange(36.0) + 0.5)
    ramp = np.stack([4.0 * columns, 2.0 * rows, columns + rows], axis=-1).astype(dtype)
    (straight, mask), border = undistorted([ramp, rows > 18.0], CAMERA, BARREL)
    u, v, outside = source_positions(CAMERA, BARREL, 0, 36)
    inside = (u > 0.5) & (u < 47.5) & (v > 0.5) & (v < 35.5)
    np.testing.assert_array_equal(border, outside)
    assert straight.dtype == ramp.dtype and mask.dtype == np.bool_ and mask.shape == (36, 48)
    rounding = 1e-4 if dtype == np.float32 else 0.5 + 1e-9
    for channel, expected in enumerate((4.0 * u, 2.0 * v, u + v)):
        np.testing.assert_allclose(straight[inside][:, channel], expected[inside], atol=rounding)
    # Half way between the rows at 17.5 and 18.5 the mask begins.
    np.testing.assert_array_equal(mask[inside], v[inside] > 18.0)


def test_no_distortion_changes_nothing(rng: np.random.Generator) -> None:
    """A straight lens gives every code back, over several bands of rows."""
    camera = replace(CAMERA, height=BAND_ROWS + 5)
    codes = rng.integers(0, 65536, (camera.height, 48, 3)).astype(np.uint16)
    (same,), border = undistorted([codes], camera, STRAIGHT)
    np.testing.assert_array_equal(same, codes)
    assert not border.any()


def test_what_lies_outside_repeats_the_edge() -> None:
    """Pincushion samples beyond the frame, barrel beyond its fold: counted, never cropped."""
    codes = np.tile(np.arange(48, dtype=np.uint8), (36, 1))
    (straight,), border = undistorted([codes], CAMERA, PINCUSHION)
    assert straight.shape == codes.shape and border[0, 0] and not border[19, 23]
    assert straight[0, 0] == 0 and straight[0, -1] == 47
    folding = Lens((-1.5, 0.0, 0.0, 0.0))
    u, v, outside = source_positions(CAMERA, folding, 0, 36)
    assert outside[0, 0] and outside[19, 0]
    # Rows and columns never run backward, as they would beyond the fold.
    assert (np.diff(u[19]) >= -1e-9).all() and (np.diff(v[:, 23]) >= -1e-9).all()


@pytest.mark.parametrize("name", ["photo.png", "plate.exr"])
def test_photo_keeps_its_kind(tmp_path: Path, rng: np.random.Generator, name: str) -> None:
    """16-bit codes and scene-linear floats stay what they are; both forms of the photo agree."""
    codes = rng.uniform(0.1, 3.0, (36, 48, 3)).astype(np.float32)
    if name.endswith("png"):
        codes = rng.integers(0, 65536, (36, 48, 3)).astype(np.uint16)
    assert oiio.ImageBuf(codes).write(str(tmp_path / name))
    photo = read_photo(tmp_path / name)
    straight, share = undistort_photo(photo, CAMERA, PINCUSHION)
    assert straight.codes.dtype == photo.codes.dtype and straight.srgb.dtype == np.float32
    assert 0.0 < share < 0.5
    assert any("straightened" in notice for notice in straight.notices)
    assert any(f"{100 * share:.2g} %" in notice for notice in straight.notices)
    if not photo.is_linear:
        np.testing.assert_allclose(straight.codes / 65535.0, straight.srgb, atol=1e-5)
