"""Every source of a camera against its own formula, and the files that must be refused."""

import json
import struct
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.poses import points_in_view, pose, write_json
from warpir.core.errors import ExitCode, InputError
from warpir.io.cameras.reader import read_camera
from warpir.scene.camera import (
    Camera,
    blender_camera,
    camera_from_exif,
    camera_from_fov,
    exr_matrices,
    ground_point,
    mitsuba_sensor,
    square_pixel_error,
)

PIXEL = 1e-3
"""How far projected points may differ from a format's own formula [px]."""


def fspy_parameters(
    width: int, height: int, c2w: np.ndarray, angle: float = 1.1, px: float = 0.07, py: float = -0.1
) -> dict[str, Any]:
    return {
        "principalPoint": {"x": px, "y": py},
        "cameraTransform": {"rows": c2w.tolist()},
        "horizontalFieldOfView": angle,
        "imageWidth": width,
        "imageHeight": height,
    }


def fspy_file(path: Path, state: Any, version: int = 1, image: bytes = b"png") -> Path:
    text = json.dumps(state).encode()
    path.write_bytes(b"fspy" + struct.pack("<3I", version, len(text), len(image)) + text + image)
    return path


def fspy_project(parameters: dict[str, Any], points: np.ndarray) -> np.ndarray:
    """The projection of fSpy: relative image plane, x in [-1, 1] over the longer side, y up."""
    width, height = parameters["imageWidth"], parameters["imageHeight"]
    w2c = np.linalg.inv(np.array(parameters["cameraTransform"]["rows"]))
    local = points @ w2c[:3, :3].T + w2c[:3, 3]
    relative_focal = 1.0 / np.tan(parameters["horizontalFieldOfView"] / 2.0)
    centre = parameters["principalPoint"]
    x = centre["x"] + relative_focal * local[:, 0] / -local[:, 2]
    y = centre["y"] + relative_focal * local[:, 1] / -local[:, 2]
    aspect = width / height
    if aspect > 1.0:  # x spans [-1, 1], y spans [-1/aspect, 1/aspect]
        return np.stack([(x + 1) / 2 * width, (1 - y * aspect) / 2 * height], axis=1)
    return np.stack([(x / aspect + 1) / 2 * width, (1 - y) / 2 * height], axis=1)


@pytest.mark.case("C2")
@pytest.mark.parametrize("size", [(1600, 1067), (900, 1350), (640, 640)])
@pytest.mark.parametrize("form", ["json", "fspy"])
def test_fspy_projects_as_fspy_does(
    tmp_path: Path, rng: np.random.Generator, size: tuple[int, int], form: str
) -> None:
    c2w = pose(rng)
    parameters = fspy_parameters(*size, c2w)
    if form == "json":
        path = write_json(tmp_path / "camera.json", parameters)
    else:
        path = fspy_file(tmp_path / "scene.fspy", {"cameraParameters": parameters})
    camera = read_camera(path, size)
    points = points_in_view(c2w, rng)
    np.testing.assert_allclose(camera.project(points), fspy_project(parameters, points), atol=PIXEL)
    assert any("+y" in line for line in camera.assumed)


@pytest.mark.parametrize(
    ("axis", "unit", "metres", "words"),
    [
        ("xPositive", "Meters", 1.0, ""),
        ("xPositive", "Centimeters", 0.01, "from fSpy's centimeters"),
        ("xPositive", "Feet", 0.3048, "from fSpy's feet"),
        ("xPositive", "No unit", 1.0, "not in metres"),
        (None, "Meters", 1.0, "not in metres"),
    ],
)
def test_lengths_of_fspy(
    tmp_path: Path,
    rng: np.random.Generator,
    axis: str | None,
    unit: str,
    metres: float,
    words: str,
) -> None:
    """A reference distance gives the unit; without one fSpy's distances are arbitrary."""
    c2w = pose(rng)
    state = {
        "cameraParameters": fspy_parameters(800, 600, c2w),
        "calibrationSettingsBase": {"referenceDistanceAxis": axis, "referenceDistanceUnit": unit},
    }
    camera = read_camera(fspy_file(tmp_path / "s.fspy", state), (800, 600), up="y")
    np.testing.assert_allclose(camera.c2w[:3, 3], metres * c2w[:3, 3])
    np.testing.assert_allclose(camera.c2w[:3, :3], c2w[:3, :3], atol=1e-12)
    assert [words in notice for notice in camera.notices] == [True] * bool(words)


@pytest.mark.parametrize("up", ["z", "-z", "x", "-x", "y", "-y"])
def test_up_axis_of_fspy_is_found_and_becomes_y(
    tmp_path: Path, rng: np.random.Generator, up: str
) -> None:
    upright = pose(rng)
    axis = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up[0] == "-" else 1.0)
    # Any rotation that brings +Y to the axis.
    side = np.roll(axis, 1)
    turn = np.stack([np.cross(axis, side), axis, side], axis=1)
    world = np.eye(4)
    world[:3, :3] = turn
    path = write_json(tmp_path / "c.json", fspy_parameters(800, 600, world @ upright))
    found, told = read_camera(path, (800, 600)), read_camera(path, (800, 600), up=up)
    np.testing.assert_allclose(found.c2w, told.c2w)
    np.testing.assert_allclose(found.c2w[1], upright[1], atol=1e-12)  # heights and tilt survive
    assert np.linalg.det(found.c2w) == pytest.approx(1.0)
    assert found.assumed and not told.assumed


def test_z_up_becomes_y_up_by_the_stated_map(tmp_path: Path) -> None:
    c2w = np.eye(4)
    c2w[:3, 3] = [1.0, 2.0, 3.0]
    content = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, c2w).record()
    camera = read_camera(write_json(tmp_path / "c.json", content), (40, 30), up="z")
    np.testing.assert_array_equal(camera.c2w[:3, 3], [1.0, 3.0, -2.0])


@pytest.mark.case("C2")
def test_own_file_round_trip_and_scaling(tmp_path: Path, rng: np.random.Generator) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 239.25, pose(rng))
    path = write_json(tmp_path / "camera.json", camera.record())
    points = points_in_view(camera.c2w, rng)
    same = read_camera(path, (640, 480))
    np.testing.assert_allclose(same.project(points), camera.project(points), atol=1e-9)
    assert same.notices == ()
    half = read_camera(path, (320, 240))
    np.testing.assert_allclose(half.project(points), camera.project(points) / 2.0, atol=1e-9)
    assert any("scaled" in notice for notice in half.notices)


@pytest.mark.case("C4", "C9")
def test_three_rows_and_a_byte_order_mark_are_accepted(tmp_path: Path) -> None:
    content = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4)).record()
    content["c2w"] = content["c2w"][:3]
    path = tmp_path / "camera.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(content).encode())
    np.testing.assert_array_equal(read_camera(path, (40, 30)).c2w, np.eye(4))


@pytest.mark.case("C5")
def test_principal_point_outside_is_noted(tmp_path: Path) -> None:
    content = Camera(40, 30, 50.0, 50.0, -5.0, 15.0, np.eye(4)).record()
    camera = read_camera(write_json(tmp_path / "c.json", content), (40, 30))
    assert any("outside" in notice for notice in camera.notices)


def own(**changes: Any) -> str:
    content = Camera(40, 30, 50.0, 50.0, 20.0, 15.0, np.eye(4)).record()
    return json.dumps({**content, **changes})


MOVED = np.eye(4)
MOVED[:3, 3] = [1.0, 2.0, 3.0]
SHEARED = np.eye(4)
SHEARED[0, 1] = 0.1

WRONG_FILES: dict[str, tuple[str, str, dict[str, Any]]] = {
    "C1-null": ('{"cameraParameters": null}', "camera.unsolved", {}),
    "C2-aspect": (own(w=40, h=40), "camera.aspect", {"found": (40, 40), "expected": (40, 30)}),
    "C3-fov": (
        json.dumps(fspy_parameters(40, 30, np.eye(4), angle=3.2)),
        "camera.field_of_view",
        {"pointer": "/horizontalFieldOfView", "found": 3.2},
    ),
    "C4-transposed": (own(c2w=MOVED.T.tolist()), "camera.transposed", {"pointer": "/c2w"}),
    "C4-left-handed": (
        own(c2w=np.diag([1.0, 1.0, -1.0, 1.0]).tolist()), "camera.left_handed", {}
    ),
    "C4-scaled": (
        own(c2w=np.diag([2.0, 2.0, 2.0, 1.0]).tolist()), "camera.scaled", {"found": 2.0}
    ),
    "C4-sheared": (own(c2w=SHEARED.tolist()), "camera.not_rigid", {"limit": 1e-4}),
    "C4-shape": (own(c2w=[[1, 0], [0, 1]]), "camera.shape", {"found": (2, 2)}),
    "C4-ragged": (own(c2w=[[1, 0, 0, 0], [0, 1]]), "camera.matrix", {}),
    "C4-text": (own(c2w=[["1", "0", "0", "0"]] * 4), "camera.matrix", {}),
    "C4-projective": (
        own(c2w=[*np.eye(4)[:3].tolist(), [0, 0, 0, 2]]), "camera.last_row", {"found": "0 0 0 2"}
    ),
    "C4-beyond": (own(c2w=(np.eye(4)[:3] * 1e16).tolist()), "camera.too_large", {"found": 1e16}),
    "C9-nan": ('{\n"fx": NaN}', "json.constant", {"line": 2, "word": "NaN"}),
    "C9-inf": ('{\n\n"fx": -Infinity}', "json.constant", {"line": 3, "word": "-Infinity"}),
    "C9-utf8": ('{"w":\n"\xff"}', "json.utf8", {"line": 2}),
    "C9-long-integer": ('{"fx": ' + "9" * 5000 + "}", "json.long_integer", {}),
    "C9-overflow": ('{\n\n"fx": 1e400}', "json.overflow", {"line": 3, "digits": "1e400"}),
    "C9-duplicate": (
        '{\n"fx": 1,\n"fy": 2,\n"fx": 3}', "json.twice", {"line": 4, "key": '"fx"'}
    ),
    "C9-comma": ('{\n"fx": 1,\n}', "json.syntax", {"line": 3}),
    "C9-list": ("[1, 2]", "json.not_an_object", {"found": "list"}),
    "C9-nested": ("[" * 100_000, "json.nesting", {"limit": 100}),
    "photo": ("\xff\xd8\xff\xe0", "camera.kind", {"found": "a picture"}),
    "foreign": ('{"camera_angle_x": 1}', "camera.kind", {"found": "keys 'camera_angle_x'"}),
    "focal": (own(fx=-1.0), "camera.focal_length", {"pointer": "/fx", "found": -1.0}),
    "focal-bool": (own(fx=True), "camera.number", {"pointer": "/fx", "found": "True"}),
    "focal-huge": (own(fx=10**400), "camera.number", {"pointer": "/fx"}),
    "size": (own(w=0), "camera.size", {"pointer": "/w", "found": 0.0}),
}  # fmt: skip
SENTENCES = {
    "C1-null": "fSpy found no camera in this project (cameraParameters is null)",
    "C2-aspect": "made for a picture of another shape (found 40 x 40; expected 40 x 30)",
    "C3-fov": "/horizontalFieldOfView: not a field of view (found 3.2; expected 0 to pi)",
    "C4-transposed": "/c2w: transposed (found the translation in the last row)",
    "C4-left-handed": "/c2w: left-handed (found determinant -1)",
    "C4-scaled": "/c2w: scaled (found 2; expected 1)",
    "C4-sheared": "/c2w: not orthonormal, its axes are off (found 0.1; limit 0.0001)",
    "C4-shape": "/c2w: not a matrix of this shape (found 2 x 2; expected 4 x 4 or 3 x 4)",
    "C4-text": "/c2w: not a matrix of numbers",
    "C4-projective": "/c2w: last row is not 0 0 0 1 (found 0 0 0 2)",
    "C4-beyond": "/c2w: numbers beyond every use (found 1e+16; limit 1e+15)",
    "C9-nan": "line 2: NaN is not JSON",
    "C9-utf8": "line 2: not UTF-8 text",
    "C9-long-integer": "not JSON that can be read (a number of 5000 digits)",
    "C9-overflow": "line 3: number 1e400 is too large",
    "C9-duplicate": 'line 4: key "fx" appears twice',
    "C9-comma": "line 3: not JSON (Expecting property name enclosed in double quotes)",
    "C9-list": "line 1: not a JSON object (found list)",
    "C9-nested": "JSON nested too deeply (limit 100); --max-nesting raises it",
    "foreign": "not a camera that warpir reads (found keys 'camera_angle_x'; expected fx fy cx cy "
    "w h c2w, or a file of fSpy, COLMAP, nerfstudio, Waymo or glTF)",
    "focal": "/fx: not a focal length (found -1; expected at least 1e-06 px)",
    "focal-bool": "/fx: not a number that can be used (found True)",
    "size": "/w: not an image size (found 0; expected whole pixels)",
}
"""The sentence of each reason, read once."""


@pytest.mark.parametrize("case", WRONG_FILES)
def test_wrong_camera_files_are_named(tmp_path: Path, case: str) -> None:
    text, reason, fields = WRONG_FILES[case]
    path = tmp_path / "camera.json"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError) as caught:
        read_camera(path, (40, 30))
    error = caught.value
    assert (error.reason, error.where, error.code) == (reason, str(path), ExitCode.INPUT)
    assert fields.items() <= error.fields.items()
    assert error.what == SENTENCES.get(case, error.what)
    assert "\n" not in str(error)


def test_every_reason_of_a_camera_file_has_a_sentence() -> None:
    assert {WRONG_FILES[c][1] for c in SENTENCES} == {
        reason for _, reason, _ in WRONG_FILES.values()
    }


FSPY_REASONS = {
    "version": "camera.version",
    "cut-header": "camera.truncated",
    "cut-state": "camera.truncated",
    "cut-image": "camera.truncated",
    "lying-size": "limit.json_bytes",
    "no-image": "camera.no_image",
}


@pytest.mark.parametrize(
    "case",
    FSPY_REASONS,
    ids="C1-{}".format,
)
def test_wrong_fspy_projects_are_refused(tmp_path: Path, case: str) -> None:
    state = {"cameraParameters": fspy_parameters(40, 30, np.eye(4))}
    version = 2 if case == "version" else 1
    path = fspy_file(
        tmp_path / "s.fspy", state, version=version, image=b"x" * (0 if case == "no-image" else 99)
    )
    content = path.read_bytes()
    length = {"cut-header": 10, "cut-state": 60, "cut-image": len(content) - 50}.get(case)
    content = content[:length]
    if case == "lying-size":
        content = content[:8] + struct.pack("<I", 2**31) + content[12:]
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_camera(path, (40, 30))
    assert caught.value.reason == FSPY_REASONS[case]


def test_missing_camera_and_folder(tmp_path: Path) -> None:
    for path, reason in ((tmp_path / "no.json", "json.missing"), (tmp_path, "colmap.missing")):
        with pytest.raises(InputError) as caught:
            read_camera(path, (40, 30))
        assert caught.value.reason == reason


def test_fov_spans_the_width_and_pitch_looks_up() -> None:
    camera = camera_from_fov(640, 480, 90.0, 0.0, 1.5)
    _, direction = camera.ray(640.0, 240.0)
    np.testing.assert_allclose(direction, [np.sqrt(0.5), 0.0, -np.sqrt(0.5)], atol=1e-12)
    origin, direction = camera_from_fov(640, 480, 60.0, 20.0, 1.5).ray(320.0, 240.0)
    np.testing.assert_allclose(origin, [0.0, 1.5, 0.0])
    expected = [0.0, np.sin(np.radians(20)), -np.cos(np.radians(20))]
    np.testing.assert_allclose(direction, expected, atol=1e-12)


@pytest.mark.parametrize(("horizon", "row"), [(0.25, 120.0), (300.0, 300.0), (-50.0, -50.0)])
def test_horizon_gives_the_pitch(horizon: float, row: float) -> None:
    camera = camera_from_fov(640, 480, 60.0, 0.0, 1.5, horizon=horizon)
    far = camera.project(np.array([[0.0, 1.5, -1e9], [3e8, 1.5, -1e9]]))
    np.testing.assert_allclose(far[:, 1], row, atol=1e-4)


def test_exif_focal_length_is_by_the_diagonal() -> None:
    camera = camera_from_exif(28.0, 4000, 3000, -5.0, 1.6)
    assert camera.fx == pytest.approx(28.0 * 5000.0 / 43.267)
    assert camera.assumed and not camera.notices


@pytest.mark.case("C3")
@pytest.mark.parametrize("fov", [0.0, 180.0, -10.0, float("nan")])
def test_bad_field_of_view_is_a_usage_error(fov: float) -> None:
    with pytest.raises(InputError) as caught:
        camera_from_fov(64, 48, fov, 0.0, 1.5)
    assert (caught.value.where, caught.value.code) == ("--fov", ExitCode.USAGE)


@pytest.mark.case("C3")
def test_radians_given_as_degrees_are_noted() -> None:
    assert any("radians" in notice for notice in camera_from_fov(64, 48, 0.9, 0.0, 1.5).notices)


def test_ground_point_projects_back(rng: np.random.Generator) -> None:
    camera = camera_from_fov(640, 480, 60.0, -10.0, 1.6)
    for _ in range(8):
        u, v = rng.uniform(0, 640), rng.uniform(300, 480)
        point = ground_point(camera, u, v)
        assert point[1] == pytest.approx(0.0, abs=1e-9)
        np.testing.assert_allclose(camera.project(point[None])[0], [u, v], atol=1e-6)
    tilted = (0.2, 2.0, 0.1, -0.4)
    point = ground_point(camera, 320.0, 470.0, tilted)
    assert np.dot(tilted[:3], point) + tilted[3] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.case("C8")
@pytest.mark.parametrize("v", [0.0, 119.9, 120.0])
def test_no_ground_at_or_above_the_horizon(v: float) -> None:
    camera = camera_from_fov(640, 480, 60.0, 0.0, 1.6, horizon=120.0)
    with pytest.raises(InputError, match="horizon"):
        ground_point(camera, 320.0, v)


@pytest.mark.case("C8")
@pytest.mark.parametrize(
    ("plane", "words"),
    [
        ((0.0, 0.0, 0.0, 1.0), "plane"),
        ((0.0, 1.0, 0.0, -1.6), "through the camera"),
        ((0.0, float("nan"), 0.0, 0.0), "plane"),
    ],
)
def test_bad_ground_planes(plane: tuple[float, ...], words: str) -> None:
    camera = camera_from_fov(640, 480, 60.0, -10.0, 1.6)
    with pytest.raises(InputError, match=words):
        ground_point(camera, 320.0, 400.0, plane)


def test_exr_matrices_project_as_openexr_says(rng: np.random.Generator) -> None:
    camera = Camera(640, 480, 500.0, 510.0, 321.5, 239.25, pose(rng))
    world_to_camera, world_to_ndc = exr_matrices(camera)
    points = points_in_view(camera.c2w, rng)
    rows = np.hstack([points, np.ones((8, 1))])
    # Imath: row vector times matrix; the camera looks along +Z.
    local = rows @ world_to_camera
    assert (local[:, 2] > 0.0).all()
    ndc = rows @ world_to_ndc
    pixels = ndc[:, :2] / ndc[:, 3:] * [640.0, 480.0]
    np.testing.assert_allclose(pixels, camera.project(points), atol=PIXEL)


SHIFTED = [(640, 480, 321.5, 239.25), (480, 640, 200.0, 350.5), (512, 512, -20.0, 700.0)]
"""Landscape, portrait and square pictures; the last with a principal point outside."""


def camera_of(size: tuple[int, int, float, float], rng: np.random.Generator) -> Camera:
    return Camera(*size[:2], 500.0, 500.0, *size[2:], pose(rng))


@pytest.mark.parametrize("size", SHIFTED)
def test_mitsuba_sensor_projects_as_mitsuba_does(
    size: tuple[int, int, float, float], rng: np.random.Generator
) -> None:
    """Mitsuba 3's perspective projection restated: +Z forward, +X left, y up, shares of a side."""
    camera = camera_of(size, rng)
    sensor, points = mitsuba_sensor(camera), points_in_view(camera.c2w, rng)
    width, height = size[:2]
    local = np.hstack([points, np.ones((8, 1))]) @ np.linalg.inv(sensor["to_world"]).T
    assert (local[:, 2] > 0.0).all()
    cot = 1.0 / np.tan(np.radians(sensor["fov_deg"]) / 2.0)
    # Film coordinates in [0, 1]: the x axis is flipped, y is scaled by the aspect.
    x = 0.5 - 0.5 * cot * local[:, 0] / local[:, 2] - sensor["principal_point_offset_x"]
    y = 0.5 - 0.5 * cot * width / height * local[:, 1] / local[:, 2]
    y -= sensor["principal_point_offset_y"]
    pixels = np.stack([x * width, y * height], axis=1)
    np.testing.assert_allclose(pixels, camera.project(points), atol=PIXEL)


@pytest.mark.parametrize("size", SHIFTED)
def test_blender_camera_projects_as_blender_does(
    size: tuple[int, int, float, float], rng: np.random.Generator
) -> None:
    """Blender's view frame restated: sensor 36 mm along the longer side, shifts in its units."""
    camera = camera_of(size, rng)
    blender, points = blender_camera(camera), points_in_view(camera.c2w, rng)
    width, height = size[:2]
    longer = max(width, height)
    z_up = np.stack([points[:, 0], -points[:, 2], points[:, 1], np.ones(8)], axis=1)
    local = z_up @ np.linalg.inv(blender["matrix_world"]).T
    lens_mm = 18.0 / np.tan(blender["angle"] / 2.0)
    sensor_mm = lens_mm * local[:, :2] / -local[:, 2:3]
    # The frame's centre lies at the shift; pixels count from its top left corner.
    offset = sensor_mm / 36.0 - [blender["shift_x"], blender["shift_y"]]
    pixels = np.stack([width / 2 + offset[:, 0] * longer, height / 2 - offset[:, 1] * longer], 1)
    np.testing.assert_allclose(pixels, camera.project(points), atol=PIXEL)


def test_square_pixel_error_is_the_worst_row(rng: np.random.Generator) -> None:
    """A corner of the frame is off by what is told when fx replaces fy."""
    camera = Camera(640, 480, 505.0, 500.0, 320.0, 200.0, np.eye(4))
    corner = np.array([[0.0, -280.0 / 500.0, -1.0]])  # seen at row 480
    replaced = Camera(640, 480, 505.0, 505.0, 320.0, 200.0, np.eye(4))
    off = abs(replaced.project(corner) - camera.project(corner))[0, 1]
    assert square_pixel_error(camera) == pytest.approx(off) == pytest.approx(2.8)


def test_tiles_of_triangles_hold_all_that_they_show() -> None:
    """Whatever pixel a point of a triangle falls into, it and its neighbours are among them."""
    rng = np.random.default_rng(5)
    camera = Camera(203, 117, 220.0, 210.0, 80.0, 70.0, np.eye(4))
    places = rng.uniform((-6.0, -4.0, -9.0), (6.0, 4.0, -3.0), (12, 1, 3))
    points = (places + rng.normal(scale=0.4, size=(12, 3, 3))).reshape(-1, 3)
    triangles = np.arange(36, dtype=np.int32).reshape(-1, 3)
    near = camera.tiles_of(points, triangles)
    assert near.shape == (117, 203)
    assert 0.02 < near.mean() < 0.7
    inside = rng.dirichlet(np.ones(3), (len(triangles), 500))
    shown = camera.project((inside @ points[triangles]).reshape(-1, 3))
    for dx, dy in product((-1, 0, 1), repeat=2):
        column, row = np.floor(shown + np.array([dx, dy])).astype(int).T
        held = (column >= 0) & (column < 203) & (row >= 0) & (row < 117)
        assert held.any()
        assert near[row[held], column[held]].all()


def test_tiles_of_triangles_beside_and_behind_the_camera() -> None:
    """What lies beside the picture takes no pixel of it; a point behind the camera takes all."""
    camera = Camera(64, 48, 55.0, 55.0, 32.0, 24.0, np.eye(4))
    points = np.array([[50.0, 0.0, -5.0], [51.0, 0.0, -5.0], [50.0, 1.0, -5.0]])
    one = np.array([[0, 1, 2]], np.int32)
    for axis in (1.0, -1.0):
        assert not camera.tiles_of(points * (axis, 1.0, 1.0), one).any()
    points[2, 2] = 1.0
    assert camera.tiles_of(points, one).all()
