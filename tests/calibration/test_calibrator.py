"""The network that estimates cameras: its file, its symmetry, and photos of every shape."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

import warpir.demo
from tests.builders.shapes import a_camera
from warpir.calibration.estimate import LINES, decided, estimate_camera
from warpir.calibration.lines import find_segments, upright_roll
from warpir.calibration.network import (
    BLUR,
    HEIGHT,
    NUMBERS,
    WIDTH,
    blur_sigma,
    load_calibrator,
    seen,
    shapes,
)
from warpir.calibration.photos import FirstPhoto
from warpir.core.arrays import FloatArray
from warpir.core.errors import ExitCode, InputError
from warpir.scene.camera import camera_from_fov
from warpir.train.networks.calibrator import (
    CalibratorConfig,
    random_calibrator,
    save_calibrator,
    soften,
)

SMALL = CalibratorConfig(channels=(8, 8, 16), blocks=(1, 1), depth=1, heads=2)


def test_file_gives_the_same_network_back(tmp_path: Path) -> None:
    network = random_calibrator(0, SMALL)
    path = tmp_path / "calibrator.safetensors"
    save_calibrator(network, path, {"seed": 3})
    found = load_calibrator(path)
    assert found.record == {"seed": 3}
    photo = np.random.default_rng(0).random((60, 90, 3)).astype(np.float32)
    first, second = (estimate_camera(photo, n) for n in (network.calibrator(), found))
    assert second.pitch_deg == pytest.approx(first.pitch_deg, abs=0.1)
    assert second.vfov_deg == pytest.approx(first.vfov_deg, abs=0.1)


def test_damaged_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "calibrator.safetensors"
    save_calibrator(random_calibrator(0, SMALL), path, {})
    content = bytearray(path.read_bytes())
    content[-7] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="damaged") as caught:
        load_calibrator(path)
    assert caught.value.code == ExitCode.MODEL
    with pytest.raises(InputError, match="no such file"):
        load_calibrator(tmp_path / "none.safetensors")


def test_mirrored_photo_gives_the_mirrored_camera() -> None:
    network = random_calibrator(1, SMALL)
    with torch.no_grad():
        for answer in network.numbers.values():
            answer[-1].weight.mul_(100.0)  # a random network's distributions are nearly even
    photo = np.random.default_rng(1).random((96, 144, 3)).astype(np.float32)
    plain = estimate_camera(photo, network.calibrator())
    mirrored = estimate_camera(photo[:, ::-1].copy(), network.calibrator())
    assert abs(plain.roll_deg) > 0.1
    assert mirrored.pitch_deg == pytest.approx(plain.pitch_deg, abs=1e-2)
    assert mirrored.roll_deg == pytest.approx(-plain.roll_deg, abs=1e-2)
    assert mirrored.principal[0] == pytest.approx(1.0 - plain.principal[0], abs=1e-3)
    assert mirrored.principal[1] == pytest.approx(plain.principal[1], abs=1e-3)


@pytest.mark.parametrize("shape", [(1, 1), (1, 700), (700, 1), (130, 190), (2000, 1500)])
def test_photo_of_any_shape_has_an_answer(shape: tuple[int, int]) -> None:
    photo = np.full((*shape, 3), 0.5, np.float32)
    estimate = estimate_camera(photo, random_calibrator(2, SMALL).calibrator())
    values = (estimate.pitch_deg, estimate.roll_deg, estimate.vfov_deg, *estimate.principal)
    assert np.isfinite(values).all()
    assert estimate.pitch_sigma_deg > 20.0  # an untrained network knows nothing


def test_photo_without_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="no pixels"):
        estimate_camera(np.zeros((0, 4, 3), np.float32), random_calibrator(0, SMALL).calibrator())


@pytest.mark.parametrize("value", [np.uint8(200), np.float32(-0.1), np.float32("nan")])
def test_photo_of_other_numbers_is_refused(value: Any) -> None:
    """Codes of 8 bits, as Pillow reads them, were clipped to a white picture."""
    with pytest.raises(InputError, match="from 0 to 1"):
        estimate_camera(np.full((8, 9, 3), value), random_calibrator(0, SMALL).calibrator())


def test_known_field_of_view_is_kept() -> None:
    photo = np.full((20, 30, 3), 0.5, np.float32)
    estimate = estimate_camera(photo, random_calibrator(0, SMALL).calibrator(), vfov_deg=41.0)
    assert (estimate.vfov_deg, estimate.vfov_sigma_deg) == (41.0, 0.0)


def test_seen_photo_keeps_its_mean_and_its_ramp() -> None:
    ramp = np.broadcast_to(np.linspace(0.0, 1.0, 900)[None, :, None], (600, 900, 3))
    small = seen(ramp)
    assert small.shape == (HEIGHT, WIDTH, 3)
    centres = (np.arange(WIDTH) + 0.5) / WIDTH
    assert small[7, 8:-8, 1] == pytest.approx(centres[8:-8], abs=2e-3)


def test_seen_photo_is_blurred_as_in_training() -> None:
    photo = np.random.default_rng(3).random((HEIGHT, WIDTH, 3)).astype(np.float32)
    sigma = torch.tensor([blur_sigma(BLUR, WIDTH / HEIGHT)])
    expected = soften(torch.from_numpy(photo).permute(2, 0, 1)[None].double(), sigma)
    found = seen(photo)
    np.testing.assert_allclose(found, expected[0].permute(1, 2, 0), atol=1e-6)


def test_numpy_gives_the_answers_of_torch() -> None:
    """What asks one photo without torch, against the module that is trained, in float64."""
    network = random_calibrator(5, replace(SMALL, blocks=(2, 1), depth=2)).double()
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=0.2, generator=torch.Generator().manual_seed(1))
    photo = np.random.default_rng(4).random((HEIGHT, WIDTH, 3))
    planes = torch.from_numpy(photo).permute(2, 0, 1)[None]
    for focal in (np.nan, 0.2):
        given = (torch.tensor([part], dtype=torch.float64) for part in (1.4, focal))
        found = network.calibrator().predict(photo, 1.4, focal)
        for numbers, expected in zip(found, network.predict(planes, *given), strict=True):
            np.testing.assert_allclose(numbers, expected[0], rtol=1e-9, atol=1e-9)


def test_sizes_tell_the_shapes_of_the_weights() -> None:
    """The shapes that a file must have are those that torch gives the network."""
    for config in (SMALL, replace(SMALL, blocks=(2, 1), depth=3)):
        state = random_calibrator(0, config).state_dict()
        assert shapes(asdict(config)) == {name: tuple(part.shape) for name, part in state.items()}


def test_soften_has_the_asked_standard_deviation() -> None:
    point = torch.zeros(2, 1, 41, 41)
    point[:, :, 20, 20] = 1.0
    blurred = soften(point, torch.tensor([[1.5, 3.0], [0.0, 2.0]]))
    offsets = torch.arange(41.0) - 20.0
    for picture, (down, across) in zip(blurred[:, 0], [(1.5, 3.0), (0.0, 2.0)], strict=True):
        assert float(picture.sum()) == pytest.approx(1.0, abs=1e-4)
        assert float((picture.sum(1) * offsets**2).sum()) == pytest.approx(down**2, rel=0.03)
        assert float((picture.sum(0) * offsets**2).sum()) == pytest.approx(across**2, rel=0.03)


def test_quantiles_of_an_even_histogram() -> None:
    bins = NUMBERS["roll"]
    even = np.full((1, bins.number), 1.0 / bins.number)
    for share in (0.1, 0.5, 0.84):
        expected = bins.low + share * (bins.high - bins.low)
        assert bins.quantile(even, share)[0] == pytest.approx(expected, abs=1e-2)


def test_camera_without_roll_is_the_camera_of_the_flags() -> None:
    camera = a_camera(pitch_deg=-9.0, vfov_deg=40.0).camera(60, 40, 1.6)
    hfov = np.degrees(2.0 * np.arctan(1.5 * np.tan(np.radians(20.0))))
    expected = camera_from_fov(60, 40, hfov, -9.0, 1.6)
    assert camera.fx == pytest.approx(expected.fx)
    np.testing.assert_allclose(camera.c2w, expected.c2w, atol=1e-12)


def test_positive_roll_lets_the_horizon_fall_to_the_right() -> None:
    camera = a_camera(roll_deg=10.0, vfov_deg=40.0).camera(60, 40, 1.6)
    left, right = camera.project(np.array([[-10.0, 1.6, -50.0], [10.0, 1.6, -50.0]]))
    assert right[1] > left[1]
    slope = (right[1] - left[1]) / (right[0] - left[0])
    assert slope == pytest.approx(np.tan(np.radians(10.0)))


def test_upright_edges_tell_the_roll() -> None:
    """Posts in front of a known camera, found from a first guess that is far off."""
    camera = a_camera(roll_deg=6.0, pitch_deg=-12.0).camera(480, 320, 1.6)
    posts = [(x, z) for x in np.linspace(-4.0, 4.0, 9) for z in (-6.0, -9.0)]
    ends = [camera.project(np.array([[x, 0.2, z], [x, 1.8, z]])).ravel() for x, z in posts]
    rng = np.random.default_rng(0)
    clutter = rng.uniform(0.0, 300.0, (6, 4))
    segments = np.concatenate([np.array(ends) + 0.2 * rng.normal(size=(18, 4)), clutter])
    roll = upright_roll(segments, (240.0, 160.0), camera.fx, -4.0, 1.0)
    assert roll == pytest.approx(6.0, abs=0.5)
    assert upright_roll(segments[:8], (240.0, 160.0), camera.fx, -4.0, 1.0) is None


@pytest.mark.parametrize("pitch", [-80.0, -65.0, 65.0])
def test_edges_of_a_floor_seen_from_above_are_not_upright(pitch: float) -> None:
    """Where up lies nearly along the optical axis any edge may pass for an upright one."""
    camera = a_camera(roll_deg=0.0, pitch_deg=pitch).camera(480, 320, 1.6)
    rng = np.random.default_rng(0)
    slabs = [[x, 20.0, x + rng.normal(), 300.0] for x in np.linspace(30.0, 450.0, 20)]
    centre = (240.0, 160.0)
    assert upright_roll(np.array(slabs), centre, camera.fx, pitch, 0.0) is None
    along = [
        [y, x, y2, x + rng.normal()] for y, x, y2 in [(20.0, x, 460.0) for x in range(20, 300, 14)]
    ]
    assert upright_roll(np.array(along), centre, camera.fx, pitch, 0.0) is None


def test_segments_of_a_drawn_post() -> None:
    photo = np.zeros((200, 300, 3), np.float32)
    photo[20:180, 140:160] = 1.0
    segments = find_segments(photo)
    upright = segments[np.abs(segments[:, 0] - segments[:, 2]) < 3.0]
    assert len(upright) >= 2
    assert {round(x / 20.0) for x in upright[:, 0]} <= {7, 8}


def test_shipped_network_estimates_the_camera_of_the_demo() -> None:
    """A photo with a known camera: pitch -3.8 degrees, no roll, 34.5 degrees high."""
    demo = Path(warpir.demo.__file__).parent
    truth = json.loads((demo / "camera.json").read_text())
    with Image.open(demo / "photo.png") as picture:
        photo = np.asarray(picture.convert("RGB"), np.float32) / 255.0
    estimate = estimate_camera(photo)
    pitch = np.degrees(np.arcsin(-truth["c2w"][1][2]))
    vfov = np.degrees(2.0 * np.arctan(truth["h"] / 2.0 / truth["fy"]))
    assert LINES in estimate.witnesses
    assert abs(estimate.pitch_deg - pitch) < min(2.0 * estimate.pitch_sigma_deg, 6.0)
    assert abs(estimate.roll_deg) < min(2.0 * estimate.roll_sigma_deg, 2.0)
    assert abs(estimate.vfov_deg - vfov) < min(2.0 * estimate.vfov_sigma_deg, 12.0)


def test_shipped_network_knows_little_of_even_photos() -> None:
    flat = estimate_camera(np.full((300, 450, 3), 0.5, np.float32))
    assert flat.pitch_sigma_deg > 8.0 and flat.vfov_sigma_deg > 15.0
    ground = 0.3 + 0.02 * np.random.default_rng(0).normal(size=(300, 450, 1))
    texture = estimate_camera(np.repeat(ground, 3, axis=2).astype(np.float32))
    assert texture.pitch_sigma_deg > 8.0 and texture.vfov_sigma_deg > 10.0


def test_shipped_network_sees_tiles_from_above() -> None:
    """No horizon: square tiles, the camera looks straight down."""
    tiles = np.full((320, 480, 3), 0.5, np.float32)
    tiles[::40] = tiles[:, ::40] = 0.2
    found = estimate_camera(tiles)
    assert abs(found.pitch_deg + 90.0) < 2.0 * found.pitch_sigma_deg < 20.0


def test_shipped_network_is_unsure_of_a_fisheye_picture() -> None:
    """A circle in black corners, in which straight lines are bent."""
    v, u = (np.mgrid[:320, :480] + 0.5 - np.array([160, 240])[:, None, None]) / 160.0
    radius = np.hypot(u, v)
    angle = np.minimum(radius * np.radians(85.0), 1.4)
    x, y = (np.tan(angle) / np.maximum(radius, 1e-6) * part for part in (u, v))
    # A street between walls with windows under a bright sky, by plane equations.
    wall = (np.floor(x / 0.4) + np.floor(y / 0.4)) % 2
    photo = np.where(y > 0.3, 0.35, np.where(y < -np.abs(x), 0.9, 0.3 + 0.3 * wall))
    photo = np.where(radius < 1.0, photo, 0.0)
    found = estimate_camera(np.repeat(photo[..., None], 3, axis=2).astype(np.float32))
    assert found.pitch_sigma_deg > 8.0 and found.vfov_sigma_deg > 18.0
    assert not found.is_upright_corrected


def test_axis_near_the_middle_is_the_middle_and_the_horizon_stays() -> None:
    near = a_camera(pitch_deg=-9.0, roll_deg=5.0, principal=(0.47, 0.55))
    centred = decided(near)
    assert centred.principal == (0.5, 0.5) and not centred.is_upright_corrected
    assert centred.pitch_deg > -9.0
    rows = []
    for estimate in (replace(near, principal=(0.5, 0.55)), centred):
        camera = estimate.camera(600, 400, 1.6)
        far = camera.c2w[:3, 3] - 1e4 * np.array([0.0, 0.0, 1.0])
        sideways = far + np.array([[-1e3, 0.0, 0.0], [1e3, 0.0, 0.0]])
        left, right = camera.project(sideways)
        along = (300.0 - left[0]) / (right[0] - left[0])
        rows.append(left[1] + along * (right[1] - left[1]))
    assert rows[0] == pytest.approx(rows[1], abs=1e-3)


def test_axis_far_from_the_middle_is_that_of_a_corrected_photo() -> None:
    found = decided(a_camera(pitch_deg=0.5, principal=(0.46, 0.24)))
    assert found.principal == (0.5, 0.24) and found.is_upright_corrected
    assert found.pitch_deg == 0.5


def test_first_photo_of_a_size_stands_for_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera for a sequence; another size or focal length is another camera."""
    asked: list[tuple[tuple[int, ...], float | None]] = []

    def estimate(photo: FloatArray, vfov_deg: float | None) -> int:
        asked.append((photo.shape, vfov_deg))
        return len(asked)

    monkeypatch.setattr("warpir.calibration.photos.estimate_photo", estimate)
    first = FirstPhoto()
    small, large = np.zeros((4, 6, 3), np.float32), np.zeros((8, 12, 3), np.float32)
    found: list[Any] = [
        first(small, None),
        first(small + 1.0, None),
        first(large, None),
        first(small, 40.0),
    ]
    assert found == [1, 1, 2, 3]
    assert asked == [((4, 6, 3), None), ((8, 12, 3), None), ((4, 6, 3), 40.0)]
