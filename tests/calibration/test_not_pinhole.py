"""Pictures that no pinhole camera takes, beside photos that look a little like them."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import warpir.demo
from warpir.calibration import not_pinhole
from warpir.calibration.estimate import NOT_PINHOLE_SIGMA_DEG, estimate_camera
from warpir.calibration.not_pinhole import (
    has_image_circle,
    has_seam,
    is_panorama,
    looks_like,
)
from warpir.core.arrays import BoolArray, FloatArray
from warpir.train.networks.calibrator import CalibratorConfig, random_calibrator

SMALL = CalibratorConfig(channels=(8, 8, 16), blocks=(1, 1), depth=1, heads=2)


def scene(seed: int, height: int = 240, width: int = 320) -> FloatArray:
    """Return a smooth picture with edges of all directions and grain, shape [H, W, 3]."""
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[:height, :width] / 240.0
    photo = np.full((height, width, 3), 0.4)
    for _ in range(12):
        angle, where = rng.uniform(0.0, math.pi), rng.uniform(-0.3, 1.3)
        side = np.cos(angle) * u + np.sin(angle) * v > where
        photo += 0.2 * side[..., None] * rng.normal(size=3)
    photo += 0.2 * np.sin(rng.uniform(2.0, 9.0) * u + rng.uniform(2.0, 9.0) * v)[..., None]
    photo += 0.02 * rng.normal(size=photo.shape)
    return photo.clip(0.0, 1.0).astype(np.float32)


def ellipse(height: int, width: int, axes: tuple[float, float]) -> BoolArray:
    """Return what lies in an ellipse of such semi-axes, across and high [px]; shape [H, W, 1]."""
    v, u = np.ogrid[:height, :width]
    across = (u + 0.5 - width / 2.0) / axes[0]
    high = (v + 0.5 - height / 2.0) / axes[1]
    inside: BoolArray = (np.hypot(across, high) < 1.0)[..., None]
    return inside


def side_by_side(gutter: int) -> FloatArray:
    """Return two pictures beside each other, of unequal width, with a white gutter [px]."""
    parts = [scene(1)[:, :200], np.ones((240, gutter, 3), np.float32), scene(2)]
    return np.concatenate(parts, axis=1)


def test_whole_panorama_is_one() -> None:
    """Its ends meet, its top row is one point; a part of the same shape is a photo."""
    v, u = (np.mgrid[:256, :512] + 0.5) / 256.0 * math.pi
    across, up, ahead = np.sin(v) * np.sin(u), np.cos(v), np.sin(v) * np.cos(u)
    bands = [np.sin(5.0 * across + 2.0 * up), np.sin(7.0 * ahead + up), np.sin(4.0 * up)]
    whole = (0.5 + 0.4 * np.stack(bands, axis=-1)).astype(np.float32)
    assert "panorama, which --light takes" in looks_like(whole)
    assert looks_like(np.roll(whole, 100, axis=1)) == looks_like(whole)
    for part in (whole[:, :500], whole[64:192, 40:296], whole[:128, 40:296]):
        assert looks_like(part) == ""
    assert not is_panorama(scene(1, 160))


@pytest.mark.parametrize("gutter", [0, 2, 9])
def test_collage_has_a_seam(gutter: int) -> None:
    collage = side_by_side(gutter)
    assert has_seam(collage) and looks_like(collage) == "a collage"
    assert has_seam(collage.swapaxes(0, 1))


@pytest.mark.parametrize("border", [0.0, 1.0])
def test_borders_neither_are_nor_hide_a_seam(border: float) -> None:
    around = ((50, 50), (60, 60), (0, 0))
    assert not has_seam(np.pad(scene(3), around, constant_values=border))
    assert not has_seam(np.pad(scene(3), around[:1] + ((0, 0),) * 2, constant_values=border))
    assert has_seam(np.pad(side_by_side(0), around, constant_values=border))


def test_seam_of_a_large_collage_is_found() -> None:
    """It is averaged to 1024 pixels, by a factor that is no whole number."""
    large = side_by_side(0).repeat(5, axis=0).repeat(5, axis=1)
    assert large.shape[1] == 2600 and has_seam(large)


@pytest.mark.parametrize("seed", range(4))
def test_photo_has_no_seam(seed: int) -> None:
    assert not has_seam(scene(seed)) and looks_like(scene(seed)) == ""


def test_edge_that_ends_or_leans_is_no_seam() -> None:
    """A house before the sky: its wall ends at the ground; and a post that leans by a degree."""
    photo = scene(4)
    photo[:160, 150:] = 0.7 * scene(5)[:160, 150:]
    assert not has_seam(photo)
    v, u = np.mgrid[:240, :320]
    leaning = (u > 150 + v * math.tan(math.radians(1.5)))[..., None]
    assert not has_seam(np.where(leaning, scene(5), scene(4)))
    assert has_seam(np.where(u[..., None] > 150, scene(5), scene(4)))


def test_even_step_must_show_along_the_whole_length() -> None:
    """As a post's, nine tenths high; where the step varies, nine tenths are enough."""
    post = np.random.default_rng(0).uniform(0.57, 0.63, (240, 320, 3)).astype(np.float32)
    post[24:, 150:] -= 0.3
    assert not has_seam(post)
    varied = post.copy()
    varied[24:, 150:] += (0.5 * np.sin(np.arange(216) / 17.0)).astype(np.float32)[:, None, None]
    assert has_seam(varied.clip(0.0, 1.0))


def test_line_from_side_to_side_is_no_seam() -> None:
    """Joints between rows of stones, of which each has a colour of its own."""
    rng = np.random.default_rng(1)
    rows = 0.5 + 0.01 * rng.normal(size=(6, 9, 3)).repeat(40, axis=0).repeat(40, axis=1)
    shifts = rng.integers(0, 40, 6).repeat(40)
    stones = np.stack([row[k : k + 320] for row, k in zip(rows, shifts, strict=True)])
    stones += 0.01 * rng.normal(size=stones.shape)
    for joint in (1, 3, 6):
        photo = stones.copy()
        for k in range(joint):
            photo[39 + k :: 40] = 0.2
        assert not has_seam(photo.astype(np.float32))


def test_demo_photo_is_a_photo() -> None:
    """Level, with joints of the pavement from side to side."""
    with Image.open(Path(warpir.demo.__file__).parent / "photo.png") as picture:
        photo = np.asarray(picture.convert("RGB"), np.float32) / 255.0
    assert looks_like(photo) == ""


@pytest.mark.parametrize("shape", [(1, 1), (3, 900), (64, 64), (70, 70)])
def test_pictures_of_any_size_have_an_answer(shape: tuple[int, int]) -> None:
    assert not has_seam(np.full((*shape, 3), 0.5, np.float32))
    noise = np.random.default_rng(0).random((*shape, 3), np.float32)
    assert not has_seam(noise)


@pytest.mark.parametrize("height, width", [(240, 320), (256, 512), (400, 533), (800, 600)])
@pytest.mark.parametrize("corner", [0.0, 1.0])
def test_circle_in_even_corners_is_a_fisheye_picture(
    height: int, width: int, corner: float
) -> None:
    """Of any size: larger ones are looked at in steps, which may not squeeze the circle."""
    inside = ellipse(height, width, (min(height, width) / 2, min(height, width) / 2))
    photo = scene(6, height, width)
    circle = np.where(inside, photo, np.float32(corner))
    assert has_image_circle(circle) and looks_like(circle) == "a circular fisheye picture"
    assert not has_image_circle(photo)


@pytest.mark.parametrize("height, width", [(240, 320), (400, 533), (800, 600)])
@pytest.mark.parametrize("across, high", [(0.95, 0.5), (0.5, 0.95), (0.75, 0.7)])
def test_object_before_an_even_backdrop_is_no_fisheye_picture(
    height: int, width: int, across: float, high: float
) -> None:
    inside = ellipse(height, width, (across * width / 2, high * height / 2))
    shot = np.where(inside, scene(6, height, width), np.float32(1.0))
    assert not has_image_circle(shot)


def test_estimate_of_a_collage_is_unsure_and_otherwise_as_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network, collage = random_calibrator(0, SMALL).calibrator(), side_by_side(0)
    found = estimate_camera(collage, network)
    assert found.looks_like == "a collage"
    assert min(found.pitch_sigma_deg, found.vfov_sigma_deg) >= NOT_PINHOLE_SIGMA_DEG
    known = estimate_camera(collage, network, vfov_deg=40.0)
    assert known.vfov_deg == 40.0 and known.vfov_sigma_deg == 0.0
    monkeypatch.setattr(not_pinhole, "has_seam", lambda _: False)
    plain = estimate_camera(collage, network)
    assert plain.looks_like == ""
    assert (plain.pitch_deg, plain.vfov_deg) == (found.pitch_deg, found.vfov_deg)
