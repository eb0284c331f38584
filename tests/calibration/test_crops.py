"""Photographs cut out of panoramas: their truth is that of the camera, whatever it does."""

from pathlib import Path

import numpy as np
import pytest
import torch

from warpir.calibration.network import (
    HEIGHT,
    NUMBERS,
    WIDTH,
    CalibratorConfig,
    load_calibrator,
    random_calibrator,
)
from warpir.scene.camera import Camera, camera_from_fov
from warpir.train.camera.crops import (
    DrawnCameras,
    Panoramas,
    cut,
    draw_cameras,
    panoramas_of,
    with_blur,
)
from warpir.train.camera.loop import CameraSettings, mirrored_numbers, train_camera
from warpir.train.sampler import Sampler


def level_panorama() -> Panoramas:
    """Return a panorama whose red is the elevation: 0 at the nadir, 1 at the zenith."""
    rows = 1.0 - (torch.arange(512.0) + 0.5) / 512.0
    texels = torch.ones(1, 3, 512, 1024)
    texels[0, 0] = rows[:, None]
    return panoramas_of(texels, torch.ones(1))


def cameras(**given: float) -> DrawnCameras:
    """Return one camera, level and of 60 degrees where nothing else is given."""
    plain = {"pitch": 0.0, "roll": 0.0, "focal": 0.866, "x": 0.5, "y": 0.5, "aspect": 1.5}
    values = plain | {"bend": 0.0} | given
    return DrawnCameras(**{k: torch.tensor([v]) for k, v in values.items()})


@pytest.mark.parametrize(
    "given",
    [
        {"pitch": -0.4},
        {"pitch": 0.2, "roll": 0.3},
        {"roll": -0.5, "y": 0.8},
        {"pitch": -0.1, "roll": 0.1, "x": 0.3, "y": 0.4, "focal": 1.6, "aspect": 0.75},
    ],
)
def test_horizon_of_a_crop_is_where_the_camera_has_it(given: dict[str, float]) -> None:
    """The photograph's own texels against the projection of `warpir.scene.camera.Camera`."""
    drawn = cameras(**given)
    size = (HEIGHT, WIDTH)
    photo = cut(
        level_panorama(),
        drawn,
        torch.tensor([0]),
        Sampler(1, torch.Generator().manual_seed(3)),
        size,
    )
    elevation = np.pi * (photo[0, 0].numpy() - 0.5)
    pitch, roll = float(drawn.pitch), float(drawn.roll)
    focal = float(drawn.focal) * HEIGHT
    c2w = camera_from_fov(WIDTH, HEIGHT, 60.0, float(np.degrees(pitch)), 1.0).c2w.copy()
    cos, sin = np.cos(roll), np.sin(roll)
    c2w[:3, :3] = c2w[:3, :3] @ np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    # The photo is stretched: its columns are not as wide as its rows are high.
    fx = focal * WIDTH / HEIGHT / float(drawn.aspect)
    camera = Camera(WIDTH, HEIGHT, fx, focal, float(drawn.x) * WIDTH, float(drawn.y) * HEIGHT, c2w)
    for row in range(2, HEIGHT, 15):
        for column in range(2, WIDTH, 18):
            _, direction = camera.ray(column + 0.5, row + 0.5)
            assert elevation[row, column] == pytest.approx(np.arcsin(direction[1]), abs=4e-3)


def test_histograms_hold_every_camera_that_is_drawn() -> None:
    numbers = draw_cameras(Sampler(20_000, torch.Generator().manual_seed(0))).numbers()
    for bins, values in zip(NUMBERS.values(), numbers.T, strict=True):
        assert bins.low < float(values.min())
        assert float(values.max()) < bins.high


def test_mirrored_numbers_are_those_of_the_mirror_image() -> None:
    """The features of a mirrored photo belong to them: roll and column turn over."""
    numbers = torch.tensor([[-12.0, 7.0, 0.2, 0.3, 0.6]])
    torch.testing.assert_close(
        mirrored_numbers(numbers), torch.tensor([[-12.0, -7.0, 0.2, 0.7, 0.6]])
    )


def test_barrel_shows_more_at_the_corner() -> None:
    straight, barrel = (cameras(bend=b).plane(64, 96)[0] for b in (0.0, 0.2))
    assert float(barrel[0, 0].norm() / straight[0, 0].norm()) == pytest.approx(1.2, abs=0.01)
    torch.testing.assert_close(barrel[32, 48], straight[32, 48], atol=1e-3, rtol=0.0)


def test_sharpness_does_not_tell_the_field_of_view() -> None:
    """A photograph of noise, a panorama's finest detail, varies alike from row to row."""
    torch.manual_seed(0)
    panoramas = panoramas_of(torch.rand(1, 3, 512, 1024), torch.ones(1))
    changes = []
    for focal in (2.6, 1.2, 0.5):
        camera = cameras(focal=focal)
        draw = Sampler(1, torch.Generator().manual_seed(1))
        layers = panoramas.layers(torch.tensor([0]), camera.focal)
        photo = cut(panoramas, camera, layers, draw)
        photo = with_blur(photo, camera, panoramas.coarseness[layers], torch.tensor([0.75]))
        inner = photo[0, :, 16:48, 24:72]
        changes.append(float(inner.diff(dim=1).std() / inner.std()))
    assert changes == pytest.approx([changes[0]] * 3, rel=0.15)


def test_training_writes_weights_that_are_calibrated(tmp_path: Path) -> None:
    small = CalibratorConfig(hidden=16)
    found = train_camera(
        level_panorama(),
        level_panorama(),
        tmp_path,
        CameraSettings(batch=4, validation_photos=50, validate_steps=20),
        minutes=0.05,
        network=random_calibrator(0, small),
    )
    network = load_calibrator(tmp_path / "calibrator.safetensors")
    assert network.record["steps"] >= 1
    for name in ("pitch", "roll", "vfov"):
        assert found[f"{name}_covered"] == pytest.approx(0.68, abs=0.05)
    assert (tmp_path / "curve.jsonl").read_text().count("\n") >= 1
