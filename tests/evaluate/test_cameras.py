"""Errors of estimated cameras: the command, and the constant guess beside the estimate."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.builders.image_files import write_envmap
from warpir.evaluate.camera.measure import (
    constant_camera,
    corrected_to_upright,
    even_cameras,
    photograph,
    unlearned,
)
from warpir.evaluate.command import main
from warpir.scene.camera import camera_from_fov
from warpir.train.camera.crops import DrawnCameras, read_panoramas
from warpir.train.networks.calibrator import CalibratorConfig, random_calibrator, save_calibrator
from warpir.train.sampler import Sampler

SMALL = CalibratorConfig(channels=(8, 8, 16), blocks=(1, 1), depth=1, heads=2)


@pytest.fixture
def panoramas(tmp_path: Path) -> Path:
    """A folder with a panorama, dark ground and bright sky, and with a file that is none."""
    texels = np.full((64, 128, 3), 0.2, np.float32)
    texels[:32] = 1.0
    write_envmap(tmp_path / "field", "field", texels)
    (tmp_path / "field" / "broken.hdr").write_bytes(b"#?RADIANCE")
    return tmp_path / "field"


def weights(folder: Path, learned: list[str]) -> Path:
    path = folder / "calibrator.safetensors"
    network = random_calibrator(0, SMALL)
    save_calibrator(network, path, {"panoramas": learned})
    return path


def test_command_writes_errors_of_both_rows(panoramas: Path, tmp_path: Path) -> None:
    out = tmp_path / "camera.json"
    arguments = ["--camera", "--panoramas", str(panoramas), "--scenes", "3", "--seed", "4"]
    arguments += ["--width", "96", "--calibrator", str(weights(tmp_path, []))]
    assert main([*arguments, "--json", str(out)]) == 0
    record = json.loads(out.read_text())
    camera = record["camera"]
    assert record["panoramas"] == ["field"]
    assert len(record["notices"]) == 1 and "broken.hdr" in record["notices"][0]
    for row in ("estimated", "constant"):
        for name in ("pitch_deg", "roll_deg", "vfov_deg"):
            assert 0.0 <= camera[row][name]["median"] < 180.0
            assert 0.0 < camera[row][name]["mean"] < 180.0
    assert 0.0 <= camera["estimated"]["roll_deg"]["within_sigma"] <= 1.0
    corrected = camera["corrected"]
    assert 0.0 <= corrected["recognised"] <= 1.0 and 0.0 <= corrected["mistaken"] <= 1.0
    assert 0.1 <= corrected["axis_constant"] <= 0.4 and 0.0 <= corrected["axis"] < 1.0
    # Roll is even in -20 .. 20 degrees, so a level guess errs by the roll itself.
    rolls = even_cameras(Sampler(3, torch.Generator().manual_seed(4))).roll
    expected = float(torch.rad2deg(rolls.abs()).mean())
    assert camera["constant"]["roll_deg"]["mean"] == pytest.approx(expected, abs=1e-4)


def test_missing_weights_are_named(panoramas: Path, tmp_path: Path) -> None:
    arguments = ["--camera", "--panoramas", str(panoramas), "--scenes", "1"]
    assert main([*arguments, "--calibrator", str(tmp_path / "none.safetensors")]) == 4


def test_constant_camera_is_that_of_the_flags() -> None:
    camera = camera_from_fov(600, 400, 60.0, 0.0, 1.6)
    vfov = np.degrees(2.0 * np.arctan(200.0 / camera.fy))
    assert constant_camera(1.5)["vfov_deg"] == pytest.approx(vfov)


def test_photograph_shows_the_horizon_of_its_camera(panoramas: Path) -> None:
    """Level, 90 degrees high: bright above the middle, dark below."""
    level = dict.fromkeys(("pitch", "roll", "bend"), torch.zeros(1))
    half = {name: torch.tensor([0.5]) for name in ("focal", "x", "y")}
    camera = DrawnCameras(**level, **half, aspect=torch.tensor([1.5]))
    field = read_panoramas([panoramas / "field.exr"], "cpu")
    photo = photograph(field, camera, 96, torch.Generator().manual_seed(0))
    assert photo.shape == (64, 96, 3)
    assert photo[:28].mean() > photo[36:].mean() + 0.2


def test_corrected_photograph_shows_the_horizon_at_its_axis(panoramas: Path) -> None:
    """Level and off the middle by a tenth to four tenths of the height, up or down."""
    drawn = even_cameras(Sampler(200, torch.Generator().manual_seed(2)))
    level = corrected_to_upright(drawn, Sampler(200, torch.Generator().manual_seed(3)))
    shifts = (level.y - 0.5).abs()
    assert not level.pitch.any() and not level.roll.any()
    assert 0.1 <= shifts.min() < 0.12 and 0.38 < shifts.max() <= 0.4
    assert 0.4 < (level.y > 0.5).float().mean() < 0.6
    one = DrawnCameras(**{k: v[:1] for k, v in vars(level).items()})
    one = replace(one, aspect=torch.tensor([1.5]), focal=torch.tensor([0.8]))
    field = read_panoramas([panoramas / "field.exr"], "cpu")
    photo = photograph(field, one, 96, torch.Generator().manual_seed(0))
    row = round(float(one.y[0]) * 64)
    assert photo[: row - 4].mean() > photo[row + 4 :].mean() + 0.2


def test_panoramas_that_were_learned_from_are_left_out(tmp_path: Path) -> None:
    network = random_calibrator(0, SMALL)
    network.record = {"panoramas": ["a"], "started_from": {"panoramas": ["old"]}}
    asked = network.calibrator()
    paths = [tmp_path / name for name in ("a.exr", "a_4k.hdr", "b.exr", "old.exr")]
    fresh, notices = unlearned(paths, asked)
    assert [path.stem for path in fresh] == ["b"] and "3 panoramas" in notices[0]
    network.record = {"panoramas": ["a"], "started_from": None}
    assert len(unlearned(paths, network.calibrator())[0]) == 2
    known, notices = unlearned([tmp_path / "a.exr"], asked)
    assert [path.stem for path in known] == ["a"] and "learned from all" in notices[0]
