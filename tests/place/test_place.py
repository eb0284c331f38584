"""Placements: numbers of a camera, what the page gets, and what is saved."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from tests.builders.programs.placing import EXACT, HEIGHT, TILTED, WIDTH, begun
from tests.builders.shapes import a_camera
from warpir.app.config import InsertConfig
from warpir.core.errors import ExitCode, InputError
from warpir.io.assets import load_asset
from warpir.place.preview_asset import preview_asset, triangle_count
from warpir.place.session import PlacementFolder, placement_files
from warpir.place.stance import Stance, ground_to_world, stance_of
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.placement import place_asset

# What is sent for a placement, from what the page starts with.
SAID = {"sun": [-40, 50, 8], "sky": "clear"}


# --------------------------------------------------------------------------- numbers of a camera


@pytest.mark.parametrize(
    "stance",
    [
        Stance(0, 1.6, 0, 0, 0, 0),
        TILTED,
        Stance(1, 2, 3, -170, 80, -40),
        Stance(0, 9, 0, 30, -90, 0),
    ],
)
def test_stance_is_the_pose(stance: Stance) -> None:
    """The numbers of a pose give the pose back."""
    again = stance_of(stance.c2w())
    np.testing.assert_allclose(again.c2w(), stance.c2w(), atol=EXACT)


def test_stance_of_a_level_camera() -> None:
    """Pitch and height are those of --pitch and --camera-height, with no roll and no heading."""
    camera = camera_from_fov(WIDTH, HEIGHT, 60.0, -12.0, 1.4)
    np.testing.assert_allclose(camera.c2w, Stance(0, 1.4, 0, 0, -12.0, 0).c2w(), atol=EXACT)


def test_ground_frame_holds_the_plane() -> None:
    """Points of the frame's y = 0 lie on the plane, and its +Y is the plane's normal."""
    normal = np.array([0.1, 0.95, -0.2]) / np.linalg.norm([0.1, 0.95, -0.2])
    plane = np.append(normal, 0.7)
    pose = ground_to_world(plane)
    for point in ((0, 0, 0, 1), (2, 0, -5, 1)):
        assert plane @ (pose @ point) == pytest.approx(0.0, abs=EXACT)
    np.testing.assert_allclose(pose[:3, 1], normal, atol=EXACT)


def test_placement_in_the_world_of_the_camera_file(inputs: Path, tmp_path: Path) -> None:
    """What is saved unchanged is the placement that was given, on a tilted ground and camera."""
    ground = (0.1, 0.95, -0.2, 0.7)
    pose = (
        ground_to_world(np.array([0.1, 0.95, -0.2, 0.7]) / np.linalg.norm(ground[:3]))
        @ TILTED.c2w()
    )
    camera = Camera(WIDTH, HEIGHT, 500.0, 480.0, 250.0, 150.0, pose)
    (tmp_path / "camera.json").write_text(json.dumps(camera.record()))
    config = InsertConfig(
        photo=str(inputs / "photo.png"),
        asset=str(inputs / "wedge.glb"),
        out=str(tmp_path / "out"),
        camera=str(tmp_path / "camera.json"),
        ground=ground,
        at=(220.0, 260.0),
        rotate_y=70.0,
        size=1.5,
    )
    session, _, said = begun(config)
    files = placement_files(session, config.flat(), said)
    np.testing.assert_allclose(files["camera.json"]["c2w"], pose, atol=EXACT)
    saved = files["insert.json"]
    low, high = session.asset.bounds()
    named = {name: saved[name] for name in ("place", "rotate_y", "size")}
    again = place_asset(low, high, camera, saved["ground"], **named)
    np.testing.assert_allclose(again.asset_to_world, session.asset_to_world, atol=EXACT)
    assert "sun" not in saved and "sky" not in saved


@pytest.mark.slow
def test_start_shows_what_insert_would_refuse(inputs: Path, tmp_path: Path) -> None:
    """An asset in millimetres, in which the camera would stand, starts small and in view."""
    huge = trimesh.creation.box(extents=(900.0, 700.0, 2000.0))
    huge.export(tmp_path / "huge.stl")
    photo, asset = str(inputs / "photo.png"), str(tmp_path / "huge.stl")
    for pitch in (0.0, 30.0, -60.0, -90.0):
        config = InsertConfig(photo=photo, asset=asset, out=str(tmp_path / "o"), pitch=pitch)
        session, start, said = begun(config)
        assert 0.01 < start["size"] < 20.0
        if pitch < 30.0:
            assert placement_files(session, config.flat(), said)
    with pytest.raises(InputError, match="camera is inside"):
        begun(config.changed(pitch=0.0, place=(0.0, 0.0, -5.0)))


# ---------------------------------------------------------------------------- what the page gets


def test_preview_asset_keeps_what_is_small(inputs: Path) -> None:
    """Nothing is thinned where there is no need."""
    asset = load_asset(inputs / "wedge.glb")
    assert preview_asset(asset).primitives == asset.primitives


def test_preview_asset_thins_a_heavy_one(tmp_path: Path) -> None:
    """A sphere of 82 k triangles becomes one of less than 5 k that lies on it everywhere."""
    trimesh.creation.icosphere(subdivisions=6).export(tmp_path / "ball.ply")
    asset = load_asset(tmp_path / "ball.ply")
    thin = preview_asset(asset, 5000)
    assert 500 < triangle_count(thin) <= 5000
    (part,) = thin.primitives
    corners = part.positions[part.indices]
    assert np.abs(np.linalg.norm(corners, axis=2) - 1.0).max() < 1e-6
    # Nothing is missing: the triangles cover the sphere but for what flat ones cut off.
    a, b, c = np.moveaxis(corners, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    assert area == pytest.approx(4.0 * np.pi, rel=0.03)


# ---------------------------------------------------------------------------------------- saving


def placed_files(inputs: Path, out: Path, **change: Any) -> dict[str, dict[str, Any]]:
    """The files of a placement that is as it started but for what is changed."""
    config = InsertConfig(
        photo=str(inputs / "photo.png"), asset=str(inputs / "wedge.glb"), out=str(out)
    )
    session, _, said = begun(config)
    return placement_files(session, config.flat(), {**said, **SAID, **change})


def test_page_starts_with_the_estimated_camera(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its numbers, and that they are estimates; a camera that sees no ground gives way."""
    found = a_camera(pitch_deg=-8.0, roll_deg=3.0, vfov_deg=40.0)
    photo, asset = str(inputs / "photo.png"), str(inputs / "wedge.glb")
    config = InsertConfig(photo=photo, asset=asset, out=str(tmp_path / "o"))
    monkeypatch.setattr("warpir.place.session.estimate_photo", lambda *_: found)
    _, start, _ = begun(config)
    assert start["stance"]["pitch"] == pytest.approx(-8.0)
    assert start["stance"]["roll"] == pytest.approx(3.0)
    assert start["camera"]["fy"] == pytest.approx(HEIGHT / 2.0 / np.tan(np.radians(20.0)))
    assert any("estimated from the photo" in line for line in start["assumed"])
    up = replace(found, pitch_deg=60.0)
    monkeypatch.setattr("warpir.place.session.estimate_photo", lambda *_: up)
    _, start, _ = begun(config)
    assert start["stance"]["pitch"] == pytest.approx(0.0)
    assert any("assumed, not estimated" in line for line in start["assumed"])


def test_folder_replaces_its_own_only(inputs: Path, tmp_path: Path) -> None:
    """A second save of a session replaces the first; what others changed or wrote stays."""
    files = placed_files(inputs, tmp_path / "out")
    folder = PlacementFolder(str(tmp_path / "out"), overwrite=False)
    path = folder.write(files)
    assert folder.write(files) == path
    with pytest.raises(InputError, match="exists already") as error:
        PlacementFolder(str(tmp_path / "out"), overwrite=False).write(files)
    assert error.value.code == ExitCode.OUTPUT
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        folder.write(files)
    assert path.read_text() == "mine"
    assert PlacementFolder(str(tmp_path / "out"), overwrite=True).write(files) == path
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["camera.json", "insert.json"]


def test_folder_goes_on_with_its_placement(inputs: Path, tmp_path: Path) -> None:
    """What a session goes on with is its own until somebody else changes it; nothing else is."""
    files = placed_files(inputs, tmp_path / "out")
    path = PlacementFolder(str(tmp_path / "out"), overwrite=False).write(files)
    other = PlacementFolder(str(tmp_path / "out"), overwrite=False)
    other.take(str(tmp_path / "insert.json"))
    with pytest.raises(InputError, match="exists already"):
        other.check()
    other.take(str(path))
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        other.write(files)
    other.take(str(path))
    assert other.write(files) == path and path.read_text() != "mine"


@pytest.mark.case("N19")
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": 0}, "--size"),
        ({"size": "large"}, "--size"),
        ({"fx": -3.0}, "focal length"),
        ({"fy": 5e-324}, "focal length"),
        ({"fx": None}, "/fx"),
        ({"stance": 5}, "/x"),
        ({"stand": {"x": 0, "z": 50}}, "behind the camera"),
        ({"stand": [0, 1]}, "/x"),
        ({"sun": [1, 2, 3, 4]}, "--sun"),
        ({"sky": "green"}, "--sky"),
    ],
)
def test_placement_refuses_wrong_numbers(
    inputs: Path, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    """What insert would refuse is refused when it is saved, and told."""
    with pytest.raises(InputError) as error:
        placed_files(inputs, tmp_path / "o", **change)
    assert words in str(error.value)
