"""Point clouds, the ground in them, and the free space on it."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
import trimesh

from tests.builders.poses import pose, write_json
from warpir.app.config import InsertConfig
from warpir.app.inputs import Loaders, read_inputs
from warpir.app.photo_world import make_world
from warpir.app.settings import CameraConfig
from warpir.core.arrays import affine_matrix
from warpir.core.errors import ExitCode, InputError
from warpir.io.cameras.source import UP_TO_Y, PhotoCamera
from warpir.io.images.photos import read_photo
from warpir.io.meshes.point_cloud import read_point_cloud
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.free_space import Cloud, Stand, find_place
from warpir.scene.ground import fit_ground, in_view
from warpir.scene.placement import Placement, place_asset

CAMERA = camera_from_fov(640, 480, 60.0, -8.0, 1.7)
NOISE = 0.02
"""Standard deviation of the LiDAR [m]."""
CAR = np.array([-0.9, 0.0, -2.2]), np.array([0.9, 1.5, 2.2])


def street(rng: np.random.Generator, noise: float = NOISE) -> np.ndarray:
    """A road with slope, a wall on its left, a parked car on its right; a quarter is the road."""
    road = np.stack([rng.uniform(-8, 8, 2000), np.zeros(2000), rng.uniform(-40, -2, 2000)], 1)
    wall = np.stack([np.full(4000, -8.0), rng.uniform(0, 8, 4000), rng.uniform(-40, -2, 4000)], 1)
    car = rng.uniform([1.5, 0.0, -14.0], [3.5, 1.6, -9.0], (1500, 3))
    stray = rng.uniform([-10, -3, -40], [10, 10, -1], (500, 3))
    points = np.concatenate([road, wall, car, stray])
    return points + rng.normal(0.0, noise, points.shape)


# ------------------------------------------------------------------------------------ point clouds


def ply(form: str, points: np.ndarray, **swap: str) -> bytes:
    """A PLY with a colour and an element after the vertices."""
    header = [
        "ply", f"format {form} 1.0", "comment made by hand", f"element vertex {len(points)}",
        "property uchar red", "property float x", "property double y", "property float z",
        "element face 1", "property list uchar int vertex_indices", "end_header", "",
    ]  # fmt: skip
    text = "\n".join(header)
    for old, new in swap.items():
        assert old in text
        text = text.replace(old, new)
    if form == "ascii":
        rows = "".join(f"7 {x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
        return (text + rows + "3 0 1 2\n").encode()
    order = "<" if "little" in form else ">"
    rows = b"".join(struct.pack(order + "Bfdf", 7, *point) for point in points)
    return text.encode() + rows + struct.pack(order + "B3i", 3, 0, 1, 2)


def colmap_points(folder: Path, points: np.ndarray, form: str) -> Path:
    folder.mkdir()
    if form == "txt":
        rows = [f"{k} {x} {y} {z} 1 2 3 0.5 4 5" for k, (x, y, z) in enumerate(points.tolist())]
        (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(rows) + "\n")
    else:
        rows = [struct.pack("<Q3d3Bd", k, *p, 1, 2, 3, 0.5) for k, p in enumerate(points)]
        tracks = [struct.pack("<Q", k % 3) + b"\0" * 8 * (k % 3) for k in range(len(points))]
        content = b"".join(row + track for row, track in zip(rows, tracks, strict=True))
        (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + content)
    return folder


@pytest.mark.parametrize(
    "form",
    [
        "ascii",
        "binary_little_endian",
        "binary_big_endian",
        "xyz",
        "csv",
        "colmap-txt",
        "colmap-bin",
    ],
)
def test_point_clouds_are_read(tmp_path: Path, rng: np.random.Generator, form: str) -> None:
    """Every form gives the same positions, whatever stands beside them."""
    points = rng.normal(size=(20, 3)).astype(np.float32).astype(np.float64)
    path = tmp_path / "points"
    if form.startswith("colmap"):
        path = colmap_points(path, points, form[-3:])
    elif form in ("xyz", "csv"):
        comma = ", " if form == "csv" else " "
        rows = [comma.join([*map(repr, p), "0.3"]) for p in points.tolist()]
        path.write_text("\ufeff# x y z intensity\n\n" + "\r\n".join(rows))
    else:
        path.write_bytes(ply(form, points))
    np.testing.assert_array_equal(read_point_cloud(path), points)


POINTS = np.arange(12.0).reshape(4, 3)
LITTLE = ply("binary_little_endian", POINTS)
WRONG_CLOUDS = {
    "empty": (b"", "empty"),
    "no-points": (b"# nothing\n", "no points"),
    "words": (b"1 2 3\nx y z\n", "line 2: not a point"),
    "two": (b"1 2 3\n\n1 2\n", "line 3: not a point"),
    "nan": (b"1 2 nan\n", "line 1: not a point"),
    "decimal-comma": (b"1,5;2,5;3,5\n", "line 1: not a point"),
    "cut": (LITTLE[: -13 - 20], "ends within its 4 vertex"),
    "cut-text": (
        b"\n".join(ply("ascii", POINTS).split(b"\n")[:13]) + b"\n",
        "ends within its 4 vertex",
    ),
    "no-end": (LITTLE[:60], "no end"),
    "no-x": (ply("ascii", POINTS, **{"float x": "float u"}), "with x, y, z"),
    "list": (
        ply("ascii", POINTS, **{"uchar red": "list uchar int red"}),
        "ends within its 4 vertex",
    ),
    "form": (ply("ascii", POINTS, ascii="utf"), "line 2"),
    "late-nan": (ply("binary_big_endian", np.where(POINTS == 5.0, np.nan, POINTS)), "1 of 4"),
    "count": (LITTLE.replace(b"vertex 4", b"vertex 99999999999"), "line 4"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(99), "line 1"),
}


@pytest.mark.parametrize("case", WRONG_CLOUDS)
def test_wrong_point_clouds_are_named(tmp_path: Path, case: str) -> None:
    """Damaged files say what and in which line."""
    content, words = WRONG_CLOUDS[case]
    path = tmp_path / "cloud.ply"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_point_cloud(path)
    assert words in caught.value.what
    assert (caught.value.where, caught.value.code) == (str(path), ExitCode.INPUT)


def test_cut_colmap_points_are_refused(tmp_path: Path) -> None:
    """Text and binary; a folder without points names both."""
    folder = colmap_points(tmp_path / "0", POINTS, "bin")
    file = folder / "points3D.bin"
    content = file.read_bytes()
    for n in range(1, len(content), 7):
        file.write_bytes(content[:n])
        with pytest.raises(InputError, match=r"truncated|damaged"):
            read_point_cloud(folder)
    file.unlink()
    with pytest.raises(InputError, match=r"points3D.txt or points3D.bin"):
        read_point_cloud(folder)
    (folder / "points3D.txt").write_text("1 2 3 4\n")
    with pytest.raises(InputError, match="line 1"):
        read_point_cloud(folder)


# ----------------------------------------------------------------------------------------- ground


@pytest.mark.parametrize("tilt_deg", [0.0, 6.0, 20.0])
def test_ground_of_a_street_is_found(rng: np.random.Generator, tilt_deg: float) -> None:
    """Wall, car and stray points are three quarters: the plane is right to the noise."""
    cos, sin = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    roll = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
    points = street(rng) @ roll.T + [0.0, -0.3, 0.0]
    fit = fit_ground(points, CAMERA)
    normal = roll @ [0, 1, 0]
    assert np.degrees(np.arccos(min(fit.plane[:3] @ normal, 1.0))) < 0.1
    # The plane passes through (0, -0.3, 0) and the camera is 1.7 above y = 0.
    assert fit.plane[3] == pytest.approx(0.3 * cos, abs=0.01)
    assert fit.camera_height == pytest.approx(2.0 * cos, abs=0.01)
    assert fit.tilt_deg == pytest.approx(tilt_deg, abs=0.1)
    assert fit.rms == pytest.approx(NOISE, rel=0.2)
    seen = in_view(points, CAMERA)
    road = seen & (np.arange(len(points)) < 2000)
    assert fit.points == seen.sum() and road.sum() * 0.97 < fit.inliers < road.sum() * 1.2
    again = fit_ground(points, CAMERA)
    np.testing.assert_array_equal(again.plane, fit.plane)


def test_exact_ground_is_exact(rng: np.random.Generator) -> None:
    """Without noise the plane is right to rounding, at any scale of the world."""
    for scale in (1.0, 1e-3, 1e4):
        camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0, CAMERA.c2w.copy())
        camera.c2w[:3, 3] *= scale
        road = street(rng, 0.0)[:2000]
        above = rng.uniform([-8, 1, -40], [8, 5, -2], (4000, 3))
        fit = fit_ground(scale * np.concatenate([road, above]), camera)
        np.testing.assert_allclose(fit.plane, [0, 1, 0, 0], atol=1e-9 * max(scale, 1.0))


@pytest.mark.parametrize("seed", range(3))
def test_no_ground_is_refused(seed: int) -> None:
    """Points without order, a wall alone, a ceiling above the camera, nothing in view (C8)."""
    rng = np.random.default_rng(seed)
    cloud = rng.uniform([-5, -5, -20], [5, 5, -2], (4000, 3))
    wall = np.stack([rng.uniform(-5, 5, 999), rng.uniform(0, 5, 999), np.full(999, -9.0)], 1)
    ceiling = np.stack([rng.uniform(-5, 5, 999), np.full(999, 3.0), rng.uniform(-20, -9, 999)], 1)
    for points, words in (
        (cloud, "no ground found"),
        (wall, "no ground found"),
        (ceiling, "no ground found"),
        (cloud * [1, 1, -1], "found 0 of 4000 points in view"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            fit_ground(points, CAMERA)
        assert (caught.value.where, caught.value.code) == ("--ground-points", ExitCode.INPUT)


# -------------------------------------------------------------------------------------- the world


def test_points_turn_with_the_camera_file_s_world(rng: np.random.Generator) -> None:
    """A Z-up cloud and its camera come out as if both had been Y-up."""
    world = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    points = street(rng)
    view = PhotoCamera(CAMERA, world=world)
    made = make_world(CameraConfig(ground_points="x"), None, view, points @ world)
    straight = make_world(CameraConfig(ground_points="x"), None, PhotoCamera(CAMERA), points)
    assert made.ground == pytest.approx(straight.ground, abs=1e-9)
    assert made.cloud is not None
    np.testing.assert_allclose(made.cloud.points, points, atol=1e-12)
    assert made.measured["ground_fit"]["rms"] == pytest.approx(NOISE, rel=0.2)
    assert "fitted to" in made.assumed[0] and "degrees off level" in made.assumed[0]


def test_a_world_without_up_is_levelled_by_its_ground(rng: np.random.Generator) -> None:
    """Any turn of world, camera and points gives the level ground, the view and heights back."""
    rotation = pose(rng, 2.0)[:3, :3]
    camera = replace(CAMERA, c2w=affine_matrix(rotation) @ CAMERA.c2w)
    points = street(rng)
    view = PhotoCamera(camera, has_up=False)
    made = make_world(CameraConfig(ground_points="x"), None, view, points @ rotation.T)
    assert made.ground is not None and made.cloud is not None
    assert made.ground[:3] == pytest.approx((0, 1, 0), abs=1e-12)
    assert made.camera.c2w[1, 3] + made.ground[3] == pytest.approx(1.7, abs=0.01)
    np.testing.assert_allclose(made.camera.c2w[1, :3], CAMERA.c2w[1, :3], atol=0.002)
    seen = made.camera.project(made.cloud.points)
    np.testing.assert_allclose(seen, CAMERA.project(points), atol=1e-6)
    # The same with --ground; --place is turned too.
    normal = rotation @ [0, 1, 0]
    stand = np.array([0.5, 0.0, -9.0])
    x, y, z = (float(component) for component in rotation @ stand)
    made = make_world(CameraConfig(ground=(*normal, 0.0)), (x, y, z), view, None)
    assert made.ground == pytest.approx((0, 1, 0, 0), abs=1e-12)
    seen = made.camera.project(np.array([made.place]))
    np.testing.assert_allclose(seen, camera.project((rotation @ stand)[None]), atol=1e-6)
    with pytest.raises(InputError, match="which way is up"):
        make_world(CameraConfig(), None, view, None)


def test_a_turned_world_is_told_where_something_is_placed_in_it() -> None:
    """Coordinates of a file with +Z up are not those of --place and --proxy; the map is stated."""
    view = PhotoCamera(CAMERA, world=UP_TO_Y["+z"])
    asked = CameraConfig(proxy="mesh.glb")
    (notice,) = make_world(asked, (0.0, 0.0, -4.0), view, None).notices
    assert notice.endswith("its x,y,z are x,z,-y: so count --place, --proxy")
    assert not make_world(CameraConfig(), None, view, None).notices
    assert not make_world(asked, (0.0, 0.0, -4.0), PhotoCamera(CAMERA), None).notices


def test_an_object_hangs_from_no_ground_that_was_only_assumed() -> None:
    """Worlds of nerfstudio have cameras below y = 0: such a ground must be asked for, and is said.

    A wall is no ground from below.
    """
    view = PhotoCamera(replace(CAMERA, c2w=affine_matrix(np.eye(3), (0.0, -0.3, 0.0))))
    with pytest.raises(InputError, match=r"0\.3 m below the ground y = 0"):
        make_world(CameraConfig(), None, view, None)
    (notice,) = make_world(CameraConfig(ground=(0, 2, 0, -1)), None, view, None).notices
    assert "0.8 m below the ground" in notice and "head down" in notice
    for ground in ((0.0, 1.0, 0.0, 1.5), (0.0, -0.1, 1.0, 4.0)):
        assert not make_world(CameraConfig(ground=ground), None, view, None).notices


# -------------------------------------------------------------------------------------- free space


def put_car(camera: Camera = CAMERA, scale: float = 1.0) -> Callable[..., Placement]:
    def put(place: tuple[float, float, float]) -> Placement:
        return place_asset(*CAR, camera, place=place, scale=scale)

    return put


def cloud_of(points: np.ndarray, noise: float = NOISE) -> Cloud:
    return Cloud(points, points[:, 1], noise)


def test_points_in_way_are_those_over_the_footprint() -> None:
    """Higher than the step and lower than the top, within the margin; exact by counting."""
    placed = place_asset(*CAR, CAMERA, place=(1.0, 0.0, -12.0), rotate_y=90.0)
    inside = [[1.0, 0.5, -12.0], [3.5, 0.2, -12.0], [1.0, 1.4, -10.8]]  # the last two by the margin
    low, top, beside, front = [1, 0.14, -12], [1, 1.6, -12], [4.0, 1, -12], [1, 1, -10.5]
    points = np.array([*inside, low, top, beside, front], np.float64)
    stand = Stand(placed.asset_to_world, *CAR, CAMERA)
    found = stand.points_in_way(cloud_of(points))
    np.testing.assert_array_equal(found, inside)
    noisy = stand.points_in_way(cloud_of(points, 0.06))
    assert len(noisy) == 2  # a point 0.2 m up may be of a ground that is off by 0.06 m


def plane() -> np.ndarray:
    return np.array([0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_free_place_avoids_what_stands_there(rng: np.random.Generator, scale: float) -> None:
    """The default stand is taken by a parked car; the place is beside it, whatever the scale."""
    road = np.stack([rng.uniform(-9, 9, 4000), np.zeros(4000), rng.uniform(-40, -3, 4000)], 1)
    parked = rng.uniform([-0.9, 0.0, -11.0], [0.9, 1.5, -6.0], (500, 3))
    camera = camera_from_fov(640, 480, 60.0, -8.0, 1.7 * scale)
    put = put_car(camera, scale)

    def stand(place: tuple[float, float, float]) -> Stand:
        return Stand(put(place).asset_to_world, *CAR, camera)

    empty = find_place(stand, camera, plane(), cloud_of(scale * road, NOISE * scale))
    assert 5.0 < -empty[2] / scale < 30.0
    assert abs(camera.project(np.array([empty]))[0, 0] - 320.0) < 30.0
    cloud = cloud_of(scale * np.concatenate([road, parked]), NOISE * scale)
    place = find_place(stand, camera, plane(), cloud)
    assert len(stand(empty).points_in_way(cloud)) > 50
    assert len(stand(place).points_in_way(cloud)) == 0
    # Not behind it either: no point of the parked car is seen in front of the box.
    right = max(abs(place[0]) / scale, 0.0)
    assert right > 1.5
    assert put(place).warnings == ()


def test_no_free_place_is_refused(rng: np.random.Generator) -> None:
    """A crowd everywhere, in one line."""
    points = rng.uniform([-30, 0, -60], [30, 1.8, -1], (6000, 3))
    with pytest.raises(InputError, match="no free place") as caught:
        put = put_car()
        find_place(
            lambda place: Stand(put(place).asset_to_world, *CAR, CAMERA),
            CAMERA,
            plane(),
            cloud_of(points),
        )
    assert caught.value.where == "--ground-points"


# ------------------------------------------------------------------------- from files to placement


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo, a box and a COLMAP model of a street, bent by a lens, in a world of its own."""
    folder = tmp_path_factory.mktemp("scene")
    rng = np.random.default_rng(5)
    codes = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
    assert oiio.ImageBuf(codes).write(str(folder / "photo.png"))
    trimesh.creation.box(extents=(1.5, 1.5, 1.5)).export(folder / "box.glb")
    # COLMAP's world often is the first camera: OpenCV's axes, level and 1.7 above the road.
    points = (street(rng) - [0.0, 1.7, 0.0]) * [1, -1, -1]
    model = colmap_points(folder / "sparse", points, "bin")
    (model / "cameras.txt").write_text("1 SIMPLE_RADIAL 640 480 554 320 240 -0.1\n")
    lines = ("1 1 0 0 0 0 0 0 1 photo.png", "", "2 1 0 0 0 0 0 5 1 b.png", "", "")
    (model / "images.txt").write_text("\n".join(lines))
    return folder


def asked(scene: Path, **values: object) -> InsertConfig:
    paths = {"photo": "photo.png", "asset": "box.glb", "camera": "sparse", "out": "out"}
    given = {name: str(scene / path) for name, path in paths.items()} | {"sky": "clear"}
    return InsertConfig(**(given | values))


def test_colmap_scene_is_set_up_from_its_files(scene: Path) -> None:
    """Distortion undone, ground fitted, world levelled, a free place found; all of it is said."""
    config = asked(scene, undistort=True, ground_points=str(scene / "sparse"))
    inputs = read_inputs(config)
    assert inputs.measured["undistorted"]["radial"] == [-0.1, 0, 0, 0]
    assert inputs.measured["ground_fit"]["camera_height"] == pytest.approx(1.7, abs=0.02)
    np.testing.assert_allclose(inputs.placement.ground[:3], [0, 1, 0], atol=1e-9)
    np.testing.assert_allclose(inputs.camera.c2w[1, 1], 1.0, atol=1e-4)
    words = " / ".join((*inputs.assumed, *inputs.notices))
    for said in (
        "straightened photo",
        "fitted to",
        "no points are in its way",
        "scale of a COLMAP",
    ):
        assert said in words
    assert (inputs.photo.codes != read_photo(scene / "photo.png").codes).any()
    assert {"camera/cameras.txt", "camera/images.txt", "ground_points/points3D.bin"} < set(
        inputs.hashes
    )
    warned = read_inputs(config.changed(at=(46.0, 31.0), size=3.0))
    assert any("points of --ground-points stand where" in line for line in warned.notices)


def test_two_runs_in_a_colmap_scene_share_their_world(scene: Path) -> None:
    """Each fits its own ground, COLMAP's up is about -Y, and the light of one is the other's."""
    config = asked(scene, undistort=True, ground_points=str(scene / "sparse"), size=1.0)
    first, second = (
        read_inputs(config.changed(frame=name)).camera.c2w[:3, :3]
        for name in ("photo.png", "b.png")
    )
    np.testing.assert_allclose(second, first, atol=np.radians(1.0))
    np.testing.assert_allclose(first, np.eye(3), atol=np.radians(1.0))


def test_frames_of_a_colmap_scene_share_their_ground(scene: Path) -> None:
    """What each camera sees of the points would fit another plane: object and world would move."""
    config = asked(scene, undistort=True, ground_points=str(scene / "sparse"), size=1.0)
    config, loaders = config.changed(place=(0.0, 0.0, 9.0)), Loaders()
    first, second, again = (
        read_inputs(config.changed(frame=name), loaders)
        for name in ("photo.png", "b.png", "photo.png")
    )
    moved = np.linalg.inv(first.camera.c2w) @ second.camera.c2w
    np.testing.assert_allclose(moved[:3], [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5]], atol=1e-9)
    for other in (second, again):
        np.testing.assert_allclose(
            other.placement.asset_to_world, first.placement.asset_to_world, atol=1e-9
        )
    assert "what an earlier frame sees" in " / ".join(second.assumed)
    assert again.assumed == first.assumed


def test_colmap_scene_needs_its_flags(scene: Path) -> None:
    """Distortion and a world without up are refused, each with the flag that helps."""
    with pytest.raises(InputError) as caught:
        read_inputs(asked(scene))
    assert "--undistort" in caught.value.advice
    with pytest.raises(InputError) as caught:
        read_inputs(asked(scene, undistort=True))
    assert "--ground-points" in caught.value.advice and "--up" in caught.value.advice
    told = asked(scene, undistort=True, up="-y", frame="b.png", ground=(0.0, 1.0, 0.0, 1.7))
    inputs = read_inputs(told)
    # t = (0, 0, 5) is world to camera: the camera stands 5 behind the origin, on our +Z.
    np.testing.assert_array_equal(inputs.camera.c2w[:3, 3], [0, 0, 5])
    np.testing.assert_array_equal(inputs.camera.c2w[:3, :3], np.eye(3))
    assert "ground_fit" not in inputs.measured
    with pytest.raises(InputError, match="holds the input"):
        read_inputs(told.changed(out=str(scene / "sparse")))


@pytest.mark.case("C2")
def test_camera_files_refer_to_the_upright_photo(tmp_path: Path) -> None:
    """A photo stored on its side takes the camera of its upright size (C2)."""
    codes = np.random.default_rng(1).integers(0, 256, (64, 48, 3)).astype(np.uint8)
    image = oiio.ImageBuf(codes)
    image.specmod().attribute("Orientation", 6)
    assert image.write(str(tmp_path / "photo.tif"))
    trimesh.creation.box(extents=(1.0, 1.0, 1.0)).export(tmp_path / "box.glb")
    camera = camera_from_fov(64, 48, 60.0, -10.0, 1.5)
    path = write_json(tmp_path / "c.json", camera.record())
    values = {"photo": "photo.tif", "asset": "box.glb", "out": "out"}
    given = {name: str(tmp_path / value) for name, value in values.items()}
    inputs = read_inputs(InsertConfig(**given, camera=str(path), sky="clear"))
    np.testing.assert_allclose(inputs.camera.c2w, camera.c2w, atol=1e-12)
    assert inputs.camera.width == 64 and set(inputs.measured) == {"camera"}
