"""Photographs cut out of panoramas: their truth is that of the camera, whatever it does."""

from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tests.builders.poses import rotation
from warpir.calibration.network import HEIGHT, NUMBERS, WIDTH, load_calibrator
from warpir.scene.camera import Camera, camera_from_fov
from warpir.train.camera.crops import (
    DrawnCameras,
    Panoramas,
    cut,
    draw_cameras,
    with_blur,
)
from warpir.train.camera.loop import CameraSettings, begin_with_trunk, train_camera
from warpir.train.networks.calibrator import SHAPE, CalibratorConfig, random_calibrator
from warpir.train.networks.regressor import RegressorConfig, random_regressor
from warpir.train.sampler import Sampler


def level_panorama() -> Panoramas:
    """Return a panorama whose red is the elevation: 0 at the nadir, 1 at the zenith."""
    rows = 1.0 - (torch.arange(512.0) + 0.5) / 512.0
    texels = torch.ones(1, 3, 1, 512, 1026)
    texels[0, 0, 0] = rows[:, None]
    return Panoramas(texels, torch.ones(1))


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
    for row in range(4, HEIGHT, 31):
        for column in range(4, WIDTH, 37):
            _, direction = camera.ray(column + 0.5, row + 0.5)
            assert elevation[row, column] == pytest.approx(np.arcsin(direction[1]), abs=4e-3)


def test_field_points_up_in_the_picture() -> None:
    """Against finite differences: a scene point that rises moves along the field's direction."""
    drawn = draw_cameras(Sampler(64, torch.Generator().manual_seed(5)))
    drawn = DrawnCameras(**vars(drawn) | {"bend": torch.linspace(-0.08, 0.3, 64)})

    def shown(point: np.ndarray) -> np.ndarray:
        """Return where the lens shows a point of the image plane."""
        away = np.linalg.norm(point)
        near = np.roots([float(drawn.barrel[k]), 0.0, 1.0, -away])
        return point * min(near[(abs(near.imag) < 1e-9) & (near.real > 0.0)].real) / away

    field = drawn.field().unflatten(1, (HEIGHT // SHAPE[0], WIDTH // SHAPE[1]))
    plane = drawn.plane(HEIGHT // SHAPE[0], WIDTH // SHAPE[1]).double()
    for k in range(0, 64, 7):
        turn = rotation(0.0, float(drawn.pitch[k]), float(drawn.roll[k]))
        x, y = plane[k, 3, 5].tolist()
        point = np.array([x, y, -1.0]) + 1e-6 * turn.T @ np.array([0.0, 1.0, 0.0])
        moved = shown(point[:2] / -point[2]) - shown(np.array([x, y]))
        np.testing.assert_allclose(
            field[k, 3, 5, :2].numpy(), moved / np.linalg.norm(moved), atol=1e-3
        )


def test_histograms_hold_every_camera_that_is_drawn() -> None:
    numbers = draw_cameras(Sampler(20_000, torch.Generator().manual_seed(0))).numbers()
    for bins, values in zip(NUMBERS.values(), numbers.T, strict=True):
        assert bins.low < float(values.min())
        assert float(values.max()) < bins.high


def test_barrel_shows_more_at_the_corner() -> None:
    straight, barrel = (cameras(bend=b).plane(64, 96)[0] for b in (0.0, 0.2))
    assert float(barrel[0, 0].norm() / straight[0, 0].norm()) == pytest.approx(1.2, abs=0.01)
    torch.testing.assert_close(barrel[32, 48], straight[32, 48], atol=1e-3, rtol=0.0)


def test_sharpness_does_not_tell_the_field_of_view() -> None:
    """A photograph of noise, a panorama's finest detail, varies alike from row to row."""
    torch.manual_seed(0)
    panoramas = Panoramas(torch.rand(1, 3, 1, 512, 1026), torch.ones(1))
    changes = []
    for focal in (2.6, 1.2, 0.5):
        camera = cameras(focal=focal)
        draw = Sampler(1, torch.Generator().manual_seed(1))
        photo = cut(panoramas, camera, torch.tensor([0]), draw)
        photo = with_blur(photo, camera, torch.ones(1), torch.tensor([1.5]))
        inner = photo[0, :, 32:96, 48:144]
        changes.append(float(inner.diff(dim=1).std() / inner.std()))
    assert changes == pytest.approx([changes[0]] * 3, rel=0.15)


@pytest.mark.slow
def test_training_writes_weights_that_are_calibrated(tmp_path: Path) -> None:
    small = CalibratorConfig(channels=(8, 8, 16), blocks=(1, 1), depth=1, heads=2)
    found = train_camera(
        level_panorama(),
        level_panorama(),
        tmp_path,
        CameraSettings(batch=4, validation_photos=25),
        torch.device("cpu"),
        minutes=0.03,
        start=random_calibrator(0, small),
    )
    network = load_calibrator(tmp_path / "calibrator.safetensors")
    assert network.record["steps"] >= 1
    for name in ("pitch", "roll", "vfov"):
        assert found[f"{name}_covered"] == pytest.approx(0.68, abs=0.05)
    assert (tmp_path / "curve.jsonl").read_text().count("\n") >= 1


def test_training_can_begin_with_the_regressors_first_layers() -> None:
    """The same photo gives the same features there, whatever the coordinates beside it."""
    size = {"channels": (8, 16, 24), "blocks": (1, 1), "depth": 1, "heads": 2}
    regressor = random_regressor(1, RegressorConfig(**size, directions=40))
    network = random_calibrator(2, CalibratorConfig(**size))
    begin_with_trunk(network, regressor)
    trunk = regressor.members[0]
    photo = torch.rand(1, 3, 32, 48)
    beside = torch.cat([photo, torch.zeros(1, 3, 32, 48)], dim=1)
    with torch.no_grad():
        ours = network.stem(F.pixel_unshuffle(torch.cat([photo, photo[:, :2]], dim=1), 2))
        theirs = trunk.stem(F.pixel_unshuffle(beside, 2))
        both = [
            part.down2(part.middle(part.down1(part.fine(x))))
            for part, x in ((network, ours), (trunk, theirs))
        ]
    torch.testing.assert_close(*both)
