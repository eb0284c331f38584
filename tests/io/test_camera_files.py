"""COLMAP, nerfstudio, Waymo, glTF and EXR cameras against their own formulas, and bad files."""

import json
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.gltf_files import pack_glb
from tests.builders.poses import points_in_view, pose, write_json
from tests.builders.refusals import unreadable
from warpir.core.errors import ExitCode, InputError
from warpir.io.cameras.reader import ABOUT_UPSIDE_DOWN, read_photo_camera
from warpir.io.cameras.source import PhotoCamera
from warpir.io.layers import write_layers
from warpir.io.results import OutputFolder
from warpir.scene.camera import Camera, camera_pose

PIXEL = 1e-3
"""How far projected points may differ from a format's own formula [px]."""
SIZE = (640, 480)
BENT = {"k1": -0.11, "k2": 0.02, "p1": 0.001, "p2": -0.002}
OPENCV_AXES = np.diag([1.0, -1.0, -1.0])


fails = partial(unreadable, read_photo_camera)


def seen_through(view: PhotoCamera, points: np.ndarray) -> np.ndarray:
    """Pixels of points in the file's world by our camera, bent by our lens, shape [point, 2]."""
    camera = view.camera
    pixels = camera.project(points @ view.world.T)
    x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
    x, y = view.lens.distort(x, y)
    return np.stack([camera.cx + camera.fx * x, camera.cy + camera.fy * y], axis=1)


def opencv_pixels(
    local: np.ndarray, intrinsics: tuple[float, float, float, float], bends: dict[str, float]
) -> np.ndarray:
    """OpenCV's projectPoints: x right, y down, z forward; radial and tangential distortion."""
    fx, fy, cx, cy = intrinsics
    k1, k2, k3, k4, p1, p2 = (bends.get(k, 0.0) for k in ("k1", "k2", "k3", "k4", "p1", "p2"))
    x, y = local[:, 0] / local[:, 2], local[:, 1] / local[:, 2]
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([fx * xd + cx, fy * yd + cy], axis=1)


def test_a_camera_upside_down_is_told(tmp_path: Path) -> None:
    """As of matrices in OpenCV's axes, of the wrong --up, and of photos that EXIF turns."""
    own = {"w": 640, "h": 480, "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0}
    for roll, up, is_told in ((0.0, "y", False), (0.0, "-y", True), (180.0, "y", True)):
        c2w = camera_pose(-20.0, roll, 1.6)
        path = write_json(tmp_path / "camera.json", {**own, "c2w": c2w.tolist()})
        notices = read_photo_camera(path, SIZE, up).camera.notices
        assert (ABOUT_UPSIDE_DOWN in notices) == is_told


# ----------------------------------------------------------------------------------------- COLMAP

MODELS: dict[str, tuple[int, list[float]]] = {
    "SIMPLE_PINHOLE": (0, [500.0, 321.5, 239.25]),
    "PINHOLE": (1, [500.0, 510.0, 321.5, 239.25]),
    "SIMPLE_RADIAL": (2, [500.0, 321.5, 239.25, BENT["k1"]]),
    "RADIAL": (3, [500.0, 321.5, 239.25, BENT["k1"], BENT["k2"]]),
    "OPENCV": (4, [500.0, 510.0, 321.5, 239.25, *BENT.values()]),
}
"""Binary id and parameters."""


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """The unit quaternion w x y z of a rotation, by the eigenvector of Bar-Itzhack (2000)."""
    r = rotation
    k = np.array(
        [
            [np.trace(r), r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [0, r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2]],
            [0, 0, r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2]],
            [0, 0, 0, r[2, 2] - r[0, 0] - r[1, 1]],
        ]
    )
    return np.linalg.eigh(k, UPLO="U")[1][:, -1]


Pose = tuple[np.ndarray, np.ndarray]
"""Quaternion and translation, world to camera."""


def colmap_pose(c2w: np.ndarray) -> Pose:
    rotation = OPENCV_AXES @ c2w[:3, :3].T
    return quaternion(rotation), -rotation @ c2w[:3, 3]


def write_text_model(
    folder: Path, model: str, parameters: list[float], poses: dict[str, Pose]
) -> Path:
    folder.mkdir(exist_ok=True)
    numbers = " ".join(map(repr, parameters))
    (folder / "cameras.txt").write_text(f"# Cameras\n7 {model} 640 480 {numbers}\n")
    lines = ["# Image list"]
    for k, (name, (q, t)) in enumerate(poses.items(), 1):
        # Every other image has no points: its second line is empty.
        values = " ".join(repr(float(x)) for x in (*q, *t))
        lines += [f"{k} {values} 7 {name}", "1.5 2.5 -1 3.0 4.0 12" if k % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def write_binary_model(
    folder: Path, model_id: int, parameters: list[float], poses: dict[str, Pose]
) -> Path:
    folder.mkdir(exist_ok=True)
    content = struct.pack("<QIiQQ", 1, 7, model_id, 640, 480)
    (folder / "cameras.bin").write_bytes(content + struct.pack(f"<{len(parameters)}d", *parameters))
    content = struct.pack("<Q", len(poses))
    for k, (name, (q, t)) in enumerate(poses.items(), 1):
        content += struct.pack("<I7dI", k, *q, *t, 7) + name.encode() + b"\0"
        content += struct.pack("<Q", k) + struct.pack("<ddQ", 1.5, 2.5, 2**64 - 1) * k
    (folder / "images.bin").write_bytes(content)
    return folder


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("form", ["txt", "bin"])
def test_colmap_projects_as_colmap_does(
    tmp_path: Path, rng: np.random.Generator, model: str, form: str
) -> None:
    """X = R(q) X + t, then the camera model; each image by its name, folders left out."""
    model_id, parameters = MODELS[model]
    names = ("cam 0/a.jpg", "b.jpg", "c.jpg")
    c2ws = [pose(rng) for _ in names]
    poses = dict(zip(names, map(colmap_pose, c2ws), strict=True))
    if form == "txt":
        folder = write_text_model(tmp_path / "0", model, parameters, poses)
    else:
        folder = write_binary_model(tmp_path / "0", model_id, parameters, poses)
    fx = parameters[0]
    fy, cx, cy, *bends = parameters[1:] if "PINHOLE" == model or "OPENCV" == model else (
        fx, *parameters[1:],
    )  # fmt: skip
    named = dict(zip(("k1", "k2", "p1", "p2"), bends, strict=False))
    for name, c2w in zip(names, c2ws, strict=True):
        points = points_in_view(c2w, rng)
        q, t = poses[name]
        w, v = q[0], q[1:]
        # The rotation by a quaternion, by cross products.
        turned = points + 2 * np.cross(v, np.cross(v, points) + w * points)
        expected = opencv_pixels(turned + t, (fx, fy, cx, cy), named)
        view = read_photo_camera(folder, SIZE, frame=name.rpartition("/")[2], undistort=True)
        np.testing.assert_allclose(seen_through(view, points), expected, atol=PIXEL)
        assert not view.has_up
        turned_view = read_photo_camera(folder / f"images.{form}", SIZE, "-y", frame=name,
                                        undistort=True)  # fmt: skip
        np.testing.assert_allclose(seen_through(turned_view, points), expected, atol=PIXEL)
        assert turned_view.has_up
    assert any("scale" in notice for notice in view.camera.notices)


def still(count: int = 1) -> dict[str, Pose]:
    return {f"{k}.jpg": (np.array([1.0, 0, 0, 0]), np.zeros(3)) for k in range(count)}


@pytest.mark.case("C6")
def test_colmap_image_of_the_photo_is_chosen(tmp_path: Path) -> None:
    """The one named as the photo, the only one, or an error that lists them (C6)."""
    poses = {f"{k}.jpg": (np.array([1.0, 0, 0, 0]), np.array([0.0, 0, k])) for k in range(20)}
    folder = write_text_model(tmp_path / "many", *text_of("PINHOLE"), poses)
    assert read_photo_camera(folder, SIZE, photo_name="3.jpg").camera.c2w[2, 3] == -3.0
    assert read_photo_camera(folder, SIZE, photo_name="3.png").camera.c2w[2, 3] == -3.0
    assert read_photo_camera(folder, SIZE, frame="4.jpg", photo_name="3.jpg").camera.c2w[2, 3] == -4
    for chosen in ({}, {"photo_name": "photo.png"}, {"frame": "20.jpg"}):
        with pytest.raises(InputError) as caught:
            read_photo_camera(folder, SIZE, **chosen)
        error = caught.value
        assert (error.reason, error.fields["found"]) == ("camera.frame", 20)
        assert ": 0.jpg, 1.jpg" in error.what and "12 more (found 20)" in error.what
        assert "--frame" in error.advice
    one = write_text_model(tmp_path / "one", *text_of("PINHOLE"), still())
    read_photo_camera(one, SIZE, photo_name="photo.png")
    with pytest.raises(InputError, match="no one image"):
        read_photo_camera(one, SIZE, frame="photo.png")


def text_of(model: str) -> tuple[str, list[float]]:
    return model, MODELS[model][1]


def edited(file: str, old: str, new: str) -> Callable[[Path], None]:
    def edit(folder: Path) -> None:
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new))

    return edit


WRONG_MODELS: dict[str, tuple[Callable[[Path], None], str, dict[str, Any]]] = {
    "C6-model": (edited("cameras.txt", "PINHOLE", "FOV"), "colmap.parameter_count", {}),
    "C7-fisheye": (
        edited("cameras.txt", "PINHOLE 640 480", "OPENCV_FISHEYE 640 480 0 0 0 0"),
        "colmap.model", {"pointer": "camera 7", "found": "OPENCV_FISHEYE"},
    ),
    "C6-unknown": (edited("cameras.txt", "PINHOLE", "MYSTERY"), "colmap.model", {}),
    "C6-count": (
        edited("cameras.txt", "239.25", ""), "colmap.parameter_count", {"found": 3, "expected": 4}
    ),
    "camera-id": (
        edited("images.txt", " 7 0.jpg", " 8 0.jpg"), "colmap.no_camera", {"camera": 8}
    ),
    "cut-camera": (edited("cameras.txt", "PINHOLE 640", "\n"), "colmap.line", {}),
    "cut-image": (
        edited("images.txt", " 7 0.jpg", ""),
        "colmap.line", {"pointer": "line 2", "found": "8 values"},
    ),
    "points": (
        edited("images.txt", "1.5 2.5 -1 ", "1.5 "),
        "colmap.line", {"pointer": "line 3", "found": "4 values"},
    ),
    "nan": (
        edited("images.txt", "1 1.0", "1 nan"), "colmap.line", {"expected": "finite numbers"}
    ),
    "quaternion": (edited("images.txt", "1 1.0", "1 1.1"), "colmap.quaternion", {"found": 1.1}),
    "focal": (
        edited("cameras.txt", "500.0", "-500.0"), "camera.focal_length", {"found": -500.0}
    ),
    "size": (edited("cameras.txt", "480", "0"), "colmap.line", {"found": "640 x 0"}),
    "no-images": (lambda folder: (folder / "images.txt").unlink(), "colmap.missing", {}),
}  # fmt: skip
MODEL_SENTENCES = {
    "C7-fisheye": "camera 7: this camera model is not supported (found OPENCV_FISHEYE; expected "
    "SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV)",
    "C6-count": "line 2: wrong parameter count (found 3; expected 4)",
    "camera-id": "image 0.jpg was taken with camera 8, which is missing (found 1)",
    "points": "line 3: damaged (found 4 values; expected x y id of the image's points)",
    "quaternion": "image 0.jpg: not a unit quaternion, by its length (found 1.1; expected 1)",
    "focal": "camera 7: not a focal length (found -500)",
    "no-images": "no COLMAP model there (expected cameras.txt and images.txt or cameras.bin and "
    "images.bin)",
}
"""The sentence of each reason, read once."""


@pytest.mark.parametrize("case", WRONG_MODELS)
def test_wrong_colmap_texts_are_named(tmp_path: Path, case: str) -> None:
    """Unknown models, wrong counts and damaged lines say where and what (C6, C7)."""
    edit, reason, fields = WRONG_MODELS[case]
    folder = write_text_model(tmp_path / "0", *text_of("PINHOLE"), still())
    read_photo_camera(folder, SIZE)
    edit(folder)
    with pytest.raises(InputError) as caught:
        read_photo_camera(folder, SIZE)
    error = caught.value
    assert (error.reason, error.code) == (reason, ExitCode.INPUT)
    assert fields.items() <= error.fields.items()
    assert error.what == MODEL_SENTENCES.get(case, error.what)
    assert error.where.startswith(str(folder))


def test_every_reason_of_a_model_has_a_sentence() -> None:
    reasons = {reason for _, reason, _ in WRONG_MODELS.values()}
    assert {WRONG_MODELS[case][1] for case in MODEL_SENTENCES} == reasons


@pytest.mark.case("C6")
@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_cut_or_long_colmap_binaries_are_refused(tmp_path: Path, file: str) -> None:
    folder = write_binary_model(tmp_path / "0", *MODELS["PINHOLE"], still(2))
    content = (folder / file).read_bytes()
    wrong = [content[:n] for n in range(len(content))]
    for changed in (*wrong, content + b"\0", struct.pack("<Q", 2**60) + content[8:]):
        (folder / file).write_bytes(changed)
        with pytest.raises(InputError) as caught:
            read_photo_camera(folder, SIZE, frame="1.jpg")
        assert caught.value.reason in ("colmap.truncated", "colmap.count", "colmap.rest")
    changed = content[:12] + struct.pack("<i", 99) + content[16:]
    (folder / file).write_bytes(changed if file == "cameras.bin" else content[:-1])
    with pytest.raises(InputError) as caught:
        read_photo_camera(folder, SIZE, frame="1.jpg")
    assert caught.value.reason == "colmap.id" if file == "cameras.bin" else "colmap.truncated"


# ------------------------------------------------------------------------------------- nerfstudio


def transforms(c2w: np.ndarray, **changes: Any) -> dict[str, Any]:
    """A transforms.json of two frames, of which the second is meant."""
    other = {"file_path": "images/1.png", "transform_matrix": np.eye(4).tolist()}
    frame = {"file_path": "images/2.png", "transform_matrix": c2w.tolist(), "fl_x": 500.0}
    frame |= changes.pop("frame", {})
    whole = {"w": 640, "h": 480, "fl_x": 111.0, "fl_y": 510.0, "cx": 321.5, "cy": 239.25}
    return {**whole, "camera_model": "OPENCV", **changes, "frames": [other, frame]}


@pytest.mark.parametrize(
    "bends", [{}, {**BENT, "k3": 0.01, "k4": -0.003}], ids=["straight", "bent"]
)
def test_nerfstudio_projects_as_nerfstudio_does(
    tmp_path: Path, rng: np.random.Generator, bends: dict[str, float]
) -> None:
    """c2w in OpenGL's axes; a frame's values go before the file's; no half pixel is added."""
    c2w = pose(rng)
    path = write_json(tmp_path / "transforms.json", transforms(c2w, **bends))
    points = points_in_view(c2w, rng)
    local = (points - c2w[:3, 3]) @ c2w[:3, :3] @ OPENCV_AXES
    expected = opencv_pixels(local, (500.0, 510.0, 321.5, 239.25), bends)
    view = read_photo_camera(path, SIZE, photo_name="2.png", undistort=True)
    np.testing.assert_allclose(seen_through(view, points), expected, atol=PIXEL)
    np.testing.assert_array_equal(view.world @ [0.0, 0.0, 1.0], [0.0, 1.0, 0.0])  # +Z is up
    assert any("gravity" in line for line in view.camera.assumed)
    told = read_photo_camera(path, SIZE, "y", photo_name="2.png", undistort=True)
    np.testing.assert_allclose(seen_through(told, points), expected, atol=PIXEL)
    assert told.camera.assumed == ()
    assert ["metres" in notice for notice in told.camera.notices] == [True]


def test_blender_scene_gives_an_angle_alone(tmp_path: Path, rng: np.random.Generator) -> None:
    """Blender's NeRF scenes: camera_angle_x and names without a suffix; f = W/2 / tan(angle/2)."""
    c2w = pose(rng)
    frame = {"file_path": "./train/r_0", "transform_matrix": c2w.tolist()}
    other = {"file_path": "./train/r_1", "transform_matrix": np.eye(4).tolist()}
    content = {"camera_angle_x": 0.7, "frames": [other, frame]}
    path = write_json(tmp_path / "transforms_train.json", content)
    points = points_in_view(c2w, rng)
    focal = 0.5 * 640 / np.tan(0.5 * 0.7)
    local = (points - c2w[:3, 3]) @ c2w[:3, :3] @ OPENCV_AXES
    expected = opencv_pixels(local, (focal, focal, 320.0, 240.0), {})
    view = read_photo_camera(path, SIZE, photo_name="r_0.png")
    np.testing.assert_allclose(seen_through(view, points), expected, atol=PIXEL)


SCALED = np.diag([2.0, 2.0, 2.0, 1.0])
WRONG_TRANSFORMS: dict[str, tuple[dict[str, Any], str, dict[str, Any]]] = {
    "C7-fisheye": (
        transforms(np.eye(4), camera_model="OPENCV_FISHEYE"), "camera.not_perspective", {}
    ),
    "C7-ngp-fisheye": (
        transforms(np.eye(4), is_fisheye=True), "camera.not_perspective", {"found": "is_fisheye"}
    ),
    "C7-distorted": (transforms(np.eye(4), k1=-0.2), "camera.distorted", {"found": -0.2}),
    "C4-scaled": (
        transforms(SCALED), "camera.scaled", {"pointer": "/frames/1/transform_matrix"}
    ),
    "C4-missing": (transforms(np.eye(4), frame={"transform_matrix": None}), "camera.matrix", {}),
    "C2-aspect": (transforms(np.eye(4), h=640), "camera.aspect", {"found": (640, 640)}),
    "C2-tiny": (transforms(np.eye(4), w=3, h=2), "camera.aspect", {"found": (3, 2)}),
    "focal": (
        transforms(np.eye(4), frame={"fl_x": 0}), "camera.focal_length", {"pointer": "/fl_x"}
    ),
    "no-focal": ({"frames": [{"file_path": "2.png"}]}, "camera.no_focal_length", {}),
    "no-size": (
        {"fl_x": 5, "frames": [{"file_path": "2.png"}]}, "camera.number", {"pointer": "/w"}
    ),
    "C3-angle": (
        {"camera_angle_x": 3.2, "frames": [{"file_path": "2.png"}]},
        "camera.field_of_view", {"pointer": "/camera_angle_x"},
    ),
    "frames": ({"frames": [3]}, "camera.type", {"pointer": "/frames/0/file_path"}),
    "no-frames": ({"frames": []}, "camera.frame", {"found": 0, "names": "none"}),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG_TRANSFORMS)
def test_wrong_transforms_are_named(tmp_path: Path, case: str) -> None:
    """What a transforms.json may have wrong; distortion without --undistort is refused (C7)."""
    content, reason, fields = WRONG_TRANSFORMS[case]
    path = write_json(tmp_path / "transforms.json", content)
    error = fails(path, photo_size=SIZE, photo_name="2.png")
    assert error.reason == reason and fields.items() <= error.fields.items()


@pytest.mark.case("C7")
def test_tiny_distortion_is_none(tmp_path: Path) -> None:
    """Coefficients up to 1e-6 are what exporters write for none."""
    path = write_json(tmp_path / "t.json", transforms(np.eye(4), k1=1e-6))
    assert read_photo_camera(path, SIZE, photo_name="2.png").lens.is_straight


# ------------------------------------------------------------------------------------------ Waymo

WAYMO_NUMBERS = [500.0, 510.0, 321.5, 239.25, BENT["k1"], BENT["k2"], BENT["p1"], BENT["p2"], 0.01]


def calibration(extrinsic: np.ndarray, name: Any = 1) -> dict[str, Any]:
    return {
        "name": name,
        "intrinsic": WAYMO_NUMBERS,
        "extrinsic": {"transform": extrinsic.ravel().tolist()},
        "width": 640,
        "height": 480,
    }


@pytest.mark.parametrize("key", ["", "camera_calibrations", "cameraCalibrations"])
def test_waymo_projects_as_waymo_does(tmp_path: Path, rng: np.random.Generator, key: str) -> None:
    """The vehicle's points into the camera (x forward, y left, z up): u = f (-y / x) + c, bent."""
    waymo_axes = np.array([[0, 0, -1], [-1, 0, 0], [0, 1, 0]], np.float64)
    upright = pose(rng)
    extrinsic = np.eye(4)
    extrinsic[:3, :3] = waymo_axes @ upright[:3, :3] @ waymo_axes.T
    extrinsic[:3, 3] = [1.5, 0.1, 2.1]
    content = calibration(extrinsic)
    if key:
        content = {key: [calibration(np.eye(4), "SIDE_LEFT"), content]}
    path = write_json(tmp_path / "calibration.json", content)
    depth = rng.uniform(2.0, 20.0, (8, 1))
    local = np.hstack([depth, rng.uniform(-0.4, 0.4, (8, 2)) * depth])
    points = local @ extrinsic[:3, :3].T + extrinsic[:3, 3]
    forward_down = np.stack([-local[:, 1], -local[:, 2], local[:, 0]], axis=1)
    bends = {**BENT, "k3": 0.01}
    expected = opencv_pixels(forward_down, (500.0, 510.0, 321.5, 239.25), bends)
    view = read_photo_camera(path, SIZE, frame="FRONT" if key else None, undistort=True)
    np.testing.assert_allclose(seen_through(view, points), expected, atol=PIXEL)
    # interop.md: c2w = Q^T extrinsic Q
    np.testing.assert_allclose(view.camera.c2w[:3, :3], upright[:3, :3], atol=1e-9)
    np.testing.assert_allclose(view.camera.c2w[:3, 3], [-0.1, 2.1, -1.5], atol=1e-12)


def test_wrong_waymo_calibrations_are_named(tmp_path: Path) -> None:
    good = calibration(np.eye(4))
    for content, reason, pointer in (
        ({**good, "intrinsic": WAYMO_NUMBERS[:8]}, "json.type", "/intrinsic"),
        ({**good, "intrinsic": [0.0, *WAYMO_NUMBERS[1:]]}, "camera.focal_length", "/intrinsic"),
        ({**good, "extrinsic": {"transform": [1.0] * 12}}, "json.type", "/extrinsic/transform"),
        ({**good, "extrinsic": None}, "camera.type", "/extrinsic"),
        ({"camera_calibrations": [good, calibration(np.eye(4), 2)]}, "camera.frame", None),
        ({"camera_calibrations": 3}, "camera.type", "/camera_calibrations"),
    ):
        path = write_json(tmp_path / "c.json", content)
        error = fails(path, photo_size=SIZE, undistort=True)
        assert (error.reason, error.fields.get("pointer")) == (reason, pointer)


# ------------------------------------------------------------------------------------------- glTF


def gltf_scene(c2w: np.ndarray, yfov: float = 0.8, **changes: Any) -> dict[str, Any]:
    """A camera below a parent that is moved, turned and scaled; a second one beside it."""
    parent = np.eye(4)
    parent[:3, :3] = 2.5 * np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    parent[:3, 3] = [1.0, 2.0, 3.0]
    below = np.linalg.inv(parent) @ c2w
    perspective = {"yfov": yfov, "aspectRatio": 640 / 480, "znear": 0.1}
    cameras = [{"type": "orthographic", "name": "flat", "orthographic": {}},
               {"type": "perspective", "name": "lens", "perspective": perspective}]  # fmt: skip
    cameras[1] |= changes
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 2]}],
        "nodes": [
            {"matrix": parent.T.ravel().tolist(), "children": [1]},
            {"matrix": below.T.ravel().tolist(), "camera": 1, "name": "rig"},
            {"camera": 0},
        ],
        "cameras": cameras,
    }


def write_glb(path: Path, content: dict[str, Any]) -> Path:
    path.write_bytes(pack_glb(json.dumps(content).encode()))
    return path


@pytest.mark.parametrize("size", [(640, 480), (480, 640)])
@pytest.mark.parametrize("frame", ["lens", "rig", "0"])
def test_gltf_camera_projects_as_gltf_says(
    tmp_path: Path, rng: np.random.Generator, size: tuple[int, int], frame: str
) -> None:
    """GlTF 2.0 section 3.10.3: y / (-z tan(yfov / 2)) in [-1, 1] over the height; no scale."""
    c2w = pose(rng)
    path = write_glb(tmp_path / "scene.glb", gltf_scene(c2w))
    width, height = size
    points = points_in_view(c2w, rng)
    local = (points - c2w[:3, 3]) @ c2w[:3, :3]
    ndc = local[:, :2] / -local[:, 2:] / np.tan(0.4) / [width / height, 1.0]
    expected = np.stack([(1 + ndc[:, 0]) / 2 * width, (1 - ndc[:, 1]) / 2 * height], axis=1)
    view = read_photo_camera(path, size, frame=frame)
    np.testing.assert_allclose(seen_through(view, points), expected, atol=PIXEL)
    assert any("aspect" in n for n in view.camera.notices) == (size != (640, 480))


@pytest.mark.parametrize(("node", "is_told"), [(0, True), (1, True), (2, False)])
def test_gltf_camera_that_is_animated_says_so(tmp_path: Path, node: int, is_told: bool) -> None:
    """The track of a shot is not played: itself or its parent; another camera's is its own."""
    target = {"node": node, "path": "translation"}
    moved = {"channels": [{"sampler": 0, "target": target}], "samplers": []}
    path = write_glb(tmp_path / "shot.glb", gltf_scene(np.eye(4)) | {"animations": [moved]})
    notices = read_photo_camera(path, SIZE, frame="lens").camera.notices
    assert any("animated" in notice for notice in notices) == is_told


@pytest.mark.case("C6")
def test_C6_gltf_camera_is_named_before_it_is_counted(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """A name that is a number is a name; where it is none, it counts the cameras from 0."""
    content = gltf_scene(pose(rng))
    content["cameras"][0] = {**content["cameras"][1], "name": "1"}
    content["cameras"][1]["name"] = "0"
    path = write_glb(tmp_path / "scene.glb", content)
    poses = {f: read_photo_camera(path, SIZE, frame=f).camera.c2w for f in ("0", "1")}
    content["cameras"][0]["name"], content["cameras"][1]["name"] = "a", "b"
    path = write_glb(tmp_path / "scene.glb", content)
    for frame, name in (("0", "b"), ("1", "a")):
        counted = read_photo_camera(path, SIZE, frame=frame).camera.c2w
        np.testing.assert_array_equal(counted, read_photo_camera(path, SIZE, frame=name).camera.c2w)
        np.testing.assert_array_equal(counted, poses[frame])
    content["cameras"][0]["name"], content["cameras"][1]["name"] = "0", "1"
    path = write_glb(tmp_path / "scene.glb", content)
    np.testing.assert_array_equal(read_photo_camera(path, SIZE, frame="0").camera.c2w, poses["1"])
    with pytest.raises(InputError, match="no one"):
        read_photo_camera(path, SIZE, frame="9" * 5000)
    content["nodes"][1]["name"] = "None"
    with pytest.raises(InputError, match="which camera"):
        read_photo_camera(write_glb(path, content), SIZE, frame=None)


@pytest.mark.case("C2")
def test_C2_tiny_camera_has_the_shape_of_the_photo(tmp_path: Path) -> None:
    """4 x 3 was never 3:2; 150 x 100 was, to a pixel."""
    camera = {"fx": 3.0, "fy": 3.0, "cx": 2.0, "cy": 1.5, "w": 4, "h": 3, "c2w": np.eye(4).tolist()}
    path = write_json(tmp_path / "c.json", camera)
    assert fails(path, "another shape", photo_size=(1280, 853)).reason == "camera.aspect"
    write_json(tmp_path / "c.json", {**camera, "w": 150, "h": 100})
    assert read_photo_camera(tmp_path / "c.json", (1280, 853)).camera.width == 1280


@pytest.mark.case("C9")
def test_C9_long_keys_are_cut(tmp_path: Path) -> None:
    """What a file holds in place of a camera is told in a line."""
    path = write_json(tmp_path / "c.json", {"A" * 10**6: 1})
    assert len(fails(path, "AAA", photo_size=SIZE).what) < 300


@pytest.mark.case("C6")
def test_C6_name_without_an_end(tmp_path: Path) -> None:
    """A name is as long as a path at most; nothing is read byte by byte beyond."""
    camera = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50.0, 50.0, 32.0, 24.0)
    (tmp_path / "cameras.bin").write_bytes(camera)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 1)
    (tmp_path / "images.bin").write_bytes(image + b"a" * 10_000)
    with pytest.raises(InputError, match="a name too long") as caught:
        read_photo_camera(tmp_path, (64, 48))
    assert (caught.value.reason, caught.value.fields["limit"]) == ("colmap.name", 4096)


@pytest.mark.case("C3")
def test_wrong_gltf_cameras_are_named(tmp_path: Path) -> None:
    path = tmp_path / "scene.gltf"
    scene, steep = gltf_scene(np.eye(4)), gltf_scene(np.eye(4), yfov=3.2)
    empty = {"asset": {"version": "2.0"}, "nodes": [{}]}
    for content, frame, reason, fields in (
        (scene, "flat", "gltf.camera", {"found": "orthographic"}),
        (scene, None, "camera.frame", {"found": 2, "names": "lens, flat"}),
        (scene, "x", "camera.frame", {"problem": "no one camera is 'x'"}),
        (steep, "lens", "gltf.range", {"what": "yfov", "found": 3.2}),
        (empty, None, "camera.frame", {"found": 0, "names": "none"}),
    ):
        error = fails(write_json(path, content), photo_size=SIZE, frame=frame)
        assert error.reason == reason and fields.items() <= error.fields.items()


# -------------------------------------------------------------------------------------------- EXR


def test_exr_camera_is_what_was_written(tmp_path: Path, rng: np.random.Generator) -> None:
    """WorldToCamera and worldToNDC of our own layers, read back; single precision in the file."""
    from tests.io.test_files import small_layers

    layers, _ = small_layers(rng)
    height, width = layers.matte.shape
    camera = Camera(width, height, 17.0, 18.0, 10.3, 5.5, pose(rng))
    with OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)
    view = read_photo_camera(tmp_path / "out" / "layers.exr", (width, height))
    points = points_in_view(camera.c2w, rng)
    np.testing.assert_allclose(seen_through(view, points), camera.project(points), atol=PIXEL)


def test_exr_without_a_camera_is_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    """A panorama has no camera; a cut file is damaged."""
    with OutputFolder(tmp_path / "out") as out:
        out.write_envmap(np.ones((4, 8, 3), np.float32))
    path = tmp_path / "out" / "envmap.exr"
    fails(path, "worldToCamera: missing", photo_size=SIZE)
    path.write_bytes(path.read_bytes()[:60])
    assert fails(path, photo_size=SIZE).reason == "image.damaged"
