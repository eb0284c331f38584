"""Where the numbers of a photo's camera come from: flags, EXIF, a file, an estimate."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs, Loaders, read_inputs
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.report.remedies import remedies
from warpir.scene.camera import CameraEstimate, camera_from_fov, ground_point

WIDTH, HEIGHT = 96, 64


class Asked:
    """Stands for the network: gives one answer, and remembers what it was asked."""

    def __init__(self, **changes: Any) -> None:
        values: dict[str, Any] = {
            "pitch_deg": -9.04, "roll_deg": 2.0, "vfov_deg": 40.0, "principal": (0.5, 0.5),
            "pitch_sigma_deg": 2.5, "roll_sigma_deg": 1.0, "vfov_sigma_deg": 9.0,
            "principal_sigma": (0.03, 0.05), "witnesses": ("network",),
        }  # fmt: skip
        self.answer = CameraEstimate(**values | changes)
        self.known: list[float | None] = []

    def __call__(self, photo: FloatArray, vfov_deg: float | None) -> CameraEstimate:
        assert photo.shape == (HEIGHT, WIDTH, 3) and 0.0 <= photo.min() <= photo.max() <= 1.0
        self.known.append(vfov_deg)
        return self.answer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo without EXIF, one with, and a box."""
    folder = tmp_path_factory.mktemp("camera")
    codes = np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    Image.fromarray(codes).save(folder / "photo.png")
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 35  # FocalLengthIn35mmFilm
    Image.fromarray(codes).save(folder / "exif.jpg", exif=exif)
    trimesh.creation.box(extents=(0.5, 0.5, 0.5)).export(folder / "box.glb")
    return folder


def read(
    folder: Path,
    estimator: Asked | None,
    photo: str | Path = "photo.png",
    asset: str | Path = "box.glb",
    **given: Any,
) -> Inputs:
    """Read the inputs of a run whose camera may be estimated."""
    paths = {"photo": str(folder / photo), "asset": str(folder / asset)}
    config = InsertConfig(**paths, sky="clear", out=str(folder / "out"), **given)
    return read_inputs(config, Loaders(estimator))


def sources(inputs: Inputs) -> dict[str, str]:
    """Return the source of each number, by name."""
    return {name: number["source"] for name, number in inputs.measured["camera"].items()}


def horizon_at_middle(inputs: Inputs) -> float:
    """Return the row in which the middle column shows the horizon [px]."""
    camera = inputs.camera
    low, high = -10.0 * HEIGHT, 10.0 * HEIGHT
    for _ in range(60):
        row = 0.5 * (low + high)
        is_above = camera.ray(WIDTH / 2.0, row)[1][1] > 0.0
        low, high = (row, high) if is_above else (low, row)
    return row


def test_nothing_given_is_estimated_and_said(folder: Path) -> None:
    estimator = Asked()
    inputs = read(folder, estimator)
    assert estimator.known == [None]
    numbers = inputs.measured["camera"]
    assert numbers["pitch_deg"] == {"value": -9.0, "sigma": 2.5, "source": "estimate"}
    assert numbers["roll_deg"] == {"value": 2.0, "sigma": 1.0, "source": "estimate"}
    assert numbers["vfov_deg"] == {"value": 40.0, "sigma": 9.0, "source": "estimate"}
    assert numbers["principal"] == {"value": [0.5, 0.5], "sigma": None, "source": "assumed"}
    (line,) = [line for line in inputs.assumed if "estimated from the photo" in line]
    assert "pitch -9.0 +- 2.5, roll 2.0 +- 1.0, vertical field of view 40.0 +- 9.0" in line
    (across,) = re.findall(r"degrees, horizontal ([\d.]+) \(", line)  # what --fov takes
    again = read(folder, None, pitch=-9.0, roll=2.0, fov=float(across)).camera
    assert again.fx == pytest.approx(inputs.camera.fx, rel=1e-3)
    assert any("1.6 m above the ground" in line for line in inputs.assumed)
    assert not any("level" in line or "60 degrees" in line for line in inputs.assumed)
    json.dumps(numbers)


@pytest.mark.parametrize(
    ("photo", "given", "expected", "known"),
    [
        ("photo.png", {"fov": 50.0}, ("estimate", "estimate", "--fov"), True),
        ("exif.jpg", {}, ("estimate", "estimate", "EXIF"), True),
        ("photo.png", {"pitch": -20.0}, ("--pitch", "estimate", "estimate"), False),
        ("photo.png", {"horizon": 0.3}, ("--horizon", "estimate", "estimate"), False),
        ("photo.png", {"roll": -7.0}, ("estimate", "--roll", "estimate"), False),
        ("photo.png", {"roll": 7.0, "horizon": 0.3}, ("--horizon", "--roll", "estimate"), False),
    ],
    ids=["fov", "exif", "pitch", "horizon", "roll", "roll-horizon"],
)
def test_what_is_given_comes_before_the_estimate(
    folder: Path, photo: str, given: dict[str, Any], expected: tuple[str, ...], known: bool
) -> None:
    estimator = Asked()
    inputs = read(folder, estimator, photo, **given)
    found = sources(inputs)
    assert (found["pitch_deg"], found["roll_deg"], found["vfov_deg"]) == expected
    numbers = inputs.measured["camera"]
    assert numbers["roll_deg"]["value"] == pytest.approx(given.get("roll", 2.0))
    if known:
        assert estimator.known == [pytest.approx(numbers["vfov_deg"]["value"], abs=1e-5)]
        assert numbers["pitch_deg"]["value"] == -9.0
    else:
        assert estimator.known == [None] and numbers["vfov_deg"]["value"] == 40.0
    if "pitch" in given:
        assert numbers["pitch_deg"]["value"] == -20.0
    if "horizon" in given:
        assert horizon_at_middle(inputs) == pytest.approx(0.3 * HEIGHT, abs=1e-6)


@pytest.mark.parametrize("tilt", [{"horizon": 0.3}, {"pitch": 6.0}])
def test_roll_turns_the_horizon(folder: Path, tilt: dict[str, float]) -> None:
    """By its slope: a camera turned counter-clockwise shows a horizon that falls to the right."""
    inputs = read(folder, None, fov=50.0, roll=5.0, camera_from="assume", **tilt)
    camera = inputs.camera
    level = read(folder, None, fov=50.0, camera_from="assume", **tilt)
    assert sources(inputs)["roll_deg"] == "--roll"
    # Directions at infinity in the horizon, projected: x right, y down.
    points = []
    for azimuth in (-10.0, 10.0):
        way = np.array([np.sin(np.radians(azimuth)), 0.0, -np.cos(np.radians(azimuth))])
        x, y, z = camera.c2w[:3, :3].T @ way
        points.append((camera.cx - camera.fx * x / z, camera.cy + camera.fy * y / z))
    slope = (points[1][1] - points[0][1]) / (points[1][0] - points[0][0])
    assert slope == pytest.approx(np.tan(np.radians(5.0)))
    if "horizon" in tilt:
        assert horizon_at_middle(inputs) == pytest.approx(0.3 * HEIGHT, abs=1e-6)
    else:
        assert camera.c2w[1, 2] == pytest.approx(level.camera.c2w[1, 2])


@pytest.mark.parametrize(
    ("photo", "given"),
    [
        ("photo.png", {"fov": 50.0, "pitch": -10.0}),
        ("exif.jpg", {"horizon": 0.3}),
        ("photo.png", {"camera_from": "assume"}),
    ],
    ids=["flags", "exif-and-horizon", "assume"],
)
def test_nothing_is_estimated_where_the_camera_is_known(
    folder: Path, photo: str, given: dict[str, Any]
) -> None:
    """Field of view and horizon are all there is to an upright camera; assume asks for one."""
    estimator = Asked()
    inputs = read(folder, estimator, photo, **given)
    assert estimator.known == []
    assert "estimate" not in sources(inputs).values()
    assert inputs.measured["camera"]["roll_deg"]["value"] == 0.0


def test_assumed_camera_is_level_and_60_degrees_wide(folder: Path) -> None:
    inputs = read(folder, Asked(), camera_from="assume")
    expected = camera_from_fov(WIDTH, HEIGHT, 60.0, 0.0, 1.6)
    np.testing.assert_array_equal(inputs.camera.c2w, expected.c2w)
    assert inputs.camera.fx == expected.fx
    said = " / ".join(inputs.assumed)
    assert "level (--pitch" in said and "60 degrees (--fov)" in said


def test_camera_file_comes_first(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    path.write_text(json.dumps(camera_from_fov(WIDTH, HEIGHT, 50.0, -12.0, 1.5).record()))
    estimator = Asked()
    inputs = read(folder, estimator, camera=str(path))
    assert estimator.known == [] and set(sources(inputs).values()) == {"camera file"}
    assert inputs.measured["camera"]["pitch_deg"]["value"] == pytest.approx(-12.0, abs=1e-5)


def test_upright_corrected_photo_shifts_the_axis(folder: Path) -> None:
    estimator = Asked(pitch_deg=0.3, principal=(0.5, 0.274))
    inputs = read(folder, estimator)
    assert inputs.camera.cy == pytest.approx(0.27 * HEIGHT)
    assert inputs.measured["camera"]["principal"]["sigma"] == 0.05
    assert any("corrected to upright" in line for line in inputs.assumed)
    given = read(folder, Asked(pitch_deg=0.3, principal=(0.5, 0.274)), pitch=-5.0)
    assert given.camera.cy == HEIGHT / 2.0  # the flag means a tilted camera
    row = read(folder, Asked(pitch_deg=0.3, principal=(0.5, 0.274)), horizon=0.3)
    assert row.camera.cy == pytest.approx(0.27 * HEIGHT)
    assert horizon_at_middle(row) == pytest.approx(0.3 * HEIGHT, abs=1e-6)


def test_doubtful_estimate_asks_for_flags(folder: Path) -> None:
    """A flat texture has no camera: the numbers are used and doubted, the roll is not used."""
    wide = Asked(pitch_sigma_deg=15.0, roll_sigma_deg=9.0, vfov_sigma_deg=30.0)
    inputs = read(folder, wide)
    (line,) = [line for line in inputs.notices if "hardly shows" in line]
    assert "pitch and vertical field of view" in line and "--horizon and --fov" in line
    roll = inputs.measured["camera"]["roll_deg"]
    assert roll == {"value": 0.0, "sigma": None, "source": "assumed"}
    assert not any("hardly shows" in line for line in read(folder, Asked()).notices)


def test_notice_says_what_the_photo_looks_like(folder: Path) -> None:
    collage = Asked(pitch_sigma_deg=30.0, vfov_sigma_deg=30.0, looks_like="a collage")
    (line,) = [line for line in read(folder, collage).notices if "hardly shows" in line]
    assert line.startswith("the photo looks like a collage and hardly shows the camera's pitch")
    assert "--horizon and --fov" in line
    known = read(folder, collage, pitch=-5.0, fov=60.0)
    assert not any("collage" in line for line in known.notices)


@pytest.mark.parametrize("given", [{}, {"at": (48.0, 50.0)}], ids=["free", "at"])
def test_estimate_that_sees_no_ground_gives_way_to_a_level_camera(
    folder: Path, given: dict[str, Any]
) -> None:
    inputs = read(folder, Asked(pitch_deg=50.0), **given)
    (line,) = [line for line in inputs.notices if "assumed, not estimated" in line]
    assert "--horizon and --fov" in line
    assert set(sources(inputs).values()) == {"assumed"}
    assert any("the camera is level" in line for line in inputs.assumed)


def test_place_that_no_camera_sees_is_refused(folder: Path) -> None:
    with pytest.raises(InputError, match="shows no ground"):
        read(folder, Asked(), at=(48.0, 1.0), camera_from="assume")
    with pytest.raises(InputError) as refused:
        read(folder, Asked(), at=(0.5, 0.8), camera_from="assume")
    assert refused.value.advice == "give pixels of the photo, not shares of it"
    with pytest.raises(InputError, match="outside the photo"):
        read(folder, Asked(pitch_deg=50.0), at=(48.0, 500.0))


def test_check_without_estimator_says_what_will_be_estimated(folder: Path) -> None:
    inputs = read(folder, None)
    (line,) = [line for line in inputs.assumed if "will be estimated" in line]
    assert all(word in line for word in ("pitch", "roll", "field of view", "--horizon"))
    assert sources(inputs)["pitch_deg"] == "to be estimated"
    # A level camera shows sky there; the one that is estimated may look down.
    high = read(folder, None, at=(48.0, 20.0))
    assert any("known when the camera is estimated" in line for line in high.notices)
    with pytest.raises(InputError, match="outside the photo"):
        read(folder, None, at=(48.0, 500.0))


@pytest.mark.parametrize("size", [(20, 400), (1, 500), (400, 20)], ids=str)
def test_check_without_estimator_passes_photos_of_all_shapes(
    folder: Path, tmp_path: Path, size: tuple[int, int]
) -> None:
    """What the assumed camera does not see of a narrow photo, the estimated one may."""
    Image.new("RGB", size, (90, 100, 110)).save(tmp_path / "photo.png")
    assert read(folder, None, tmp_path / "photo.png").camera.width == size[0]


def test_width_that_makes_too_many_pixels_is_refused(folder: Path, tmp_path: Path) -> None:
    Image.new("RGB", (2, 900), (90, 100, 110)).save(tmp_path / "photo.png")
    with pytest.raises(InputError, match=r"--width: too many pixels to render .*--max-pixels"):
        read(folder, None, tmp_path / "photo.png", width=500)


# ------------------------------------------------------------------------- where nothing is placed


@pytest.mark.parametrize(
    ("vfov", "pitch"),
    [(40.0, -35.0), (40.0, -10.0), (40.0, 8.0), (40.0, 15.0), (25.0, -12.0), (31.0, -16.0)],
)
@pytest.mark.parametrize("size", [0.02, 0.5, 3.0, 40.0])
def test_unplaced_object_is_whole_and_of_a_size_that_is_seen(
    folder: Path, tmp_path: Path, vfov: float, pitch: float, size: float
) -> None:
    """On the ground below the horizon, upright, not cut by the frame, neither tiny nor huge."""
    trimesh.creation.box(extents=(size, 0.6 * size, 0.5 * size)).export(tmp_path / "b.glb")
    asked = Asked(pitch_deg=pitch, vfov_deg=vfov)
    inputs = read(folder, asked, asset=tmp_path / "b.glb")
    camera, matrix = inputs.camera, inputs.placement.asset_to_world
    assert sources(inputs)["pitch_deg"] == "estimate"
    corners = inputs.asset.corners() @ matrix[:3, :3].T + matrix[:3, 3]
    pixels = camera.project(corners)
    assert np.isfinite(pixels).all()
    assert (pixels >= 0.0).all() and (pixels <= (WIDTH, HEIGHT)).all()
    assert corners[:, 1].min() == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(matrix[:3, 1] / np.linalg.norm(matrix[:3, 1]), [0, 1, 0], atol=1e-9)
    assert 0.03 * HEIGHT < np.ptp(pixels, axis=0).max()
    is_kept = np.linalg.norm(matrix[:3, 0]) == pytest.approx(1.0)
    assert is_kept != any("since with its own" in line for line in inputs.assumed)


def test_object_that_is_well_seen_stays_at_the_usual_pixel(folder: Path) -> None:
    inputs = read(folder, Asked(), size=1.0)
    stand = ground_point(inputs.camera, 0.5 * WIDTH, 0.75 * HEIGHT)
    centre = inputs.placement.asset_to_world[:3, 3]
    np.testing.assert_allclose(centre[[0, 2]], stand[[0, 2]], atol=1e-6)


def test_asked_size_is_kept(folder: Path) -> None:
    inputs = read(folder, Asked(), size=0.02)
    scale = np.linalg.norm(inputs.placement.asset_to_world[:3, 0])
    assert scale * 0.5 == pytest.approx(0.02)


def test_object_of_an_asked_size_is_not_said_to_be_whole_where_it_is_cut(folder: Path) -> None:
    inputs = read(folder, Asked(pitch_deg=-16.0, vfov_deg=25.0), size=2.0)
    assert any("may be cut" in line for line in inputs.notices)
    assert not any("seen whole" in line for line in inputs.assumed)


def test_object_that_is_placed_keeps_its_size_and_is_said_to_be_tiny(folder: Path) -> None:
    """A speck is no result that anyone wants unknowingly; who asked for its size knows it."""
    at = (0.5 * WIDTH, 0.6 * HEIGHT)
    small = read(folder, Asked(), at=at, scale=0.02)
    assert not any("pixels long" in line for line in small.notices)
    trimesh.creation.box(extents=(0.02, 0.02, 0.02)).export(folder / "speck.glb")
    speck = read(folder, Asked(), asset=folder / "speck.glb", at=at)
    assert any("with its own 0.02 m the object is" in line for line in speck.notices)
    assert np.linalg.norm(speck.placement.asset_to_world[:3, 0]) == pytest.approx(1.0)


@pytest.mark.parametrize("extent", [0.02, 40.0], ids=["speck", "house"])
def test_remedies_keep_what_was_found_of_place_and_size(folder: Path, extent: float) -> None:
    """The report's commands change one thing: not the size with the place, nor the reverse."""
    file = folder / f"{extent}.glb"
    trimesh.creation.box(extents=(extent, 0.6 * extent, 0.5 * extent)).export(file)

    def placed(**changes: Any) -> tuple[InsertConfig, dict[str, Any]]:
        inputs = read(folder, Asked(), asset=file, **changes)
        record = inputs.placement.record(*inputs.asset.bounds(), inputs.camera, 0.0)
        return InsertConfig(photo="photo.png", asset=str(file)), record

    config, first = placed()
    light = {"azimuth_deg": 0.0, "elevation_deg": 45.0}
    measured = {"light": light, "exposure_ev": 0.0, "samples": 40, "placement": first}
    told_of = remedies(config, {"measured": measured}, None)
    found = {remedy.fault: shlex.split(remedy.command) for remedy in told_of}

    def told(fault: str) -> dict[str, Any]:
        words = found[fault]
        at = tuple(float(x) for x in words[words.index("--at") + 1].split(","))
        return {"at": at, "scale": float(words[words.index("--scale") + 1])}

    again = placed(**told("It stands in the wrong place"))[1]
    assert again["at"] == first["at"]
    assert again["scale"] == pytest.approx(first["scale"], rel=1e-3)
    larger = placed(**told("It is too small or too large"))[1]
    assert larger["at"] == first["at"]
    assert larger["scale"] == pytest.approx(1.2 * first["scale"], rel=1e-2)
