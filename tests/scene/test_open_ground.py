"""Where an object that was not placed stands, by how the ground looks."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image, ImageDraw

from warpir.app.config import InsertConfig
from warpir.app.inputs import Loaders, read_inputs
from warpir.core.arrays import Float64Array, FloatArray
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.free_space import OpenGround, Stand, find_place
from warpir.scene.placement import place_asset

WIDTH, HEIGHT = 480, 318
CAMERA = camera_from_fov(WIDTH, HEIGHT, 50.0, -10.0, 1.6)
PLANE = np.array([0.0, 1.0, 0.0, 0.0])
LOW, HIGH = np.array([-0.4, 0.0, -0.4]), np.array([0.4, 0.5, 0.4])


def photo(*shapes: tuple[tuple[float, ...], tuple[int, int, int]]) -> FloatArray:
    """A sky over grainy grey ground, and rectangles of a colour each on it, in [0, 1]."""
    image = Image.new("RGB", (WIDTH, HEIGHT), (150, 180, 220))
    draw = ImageDraw.Draw(image)
    draw.rectangle((0, 0.4 * HEIGHT, WIDTH, HEIGHT), (120, 118, 112))
    for box, colour in shapes:
        draw.rectangle(box, colour)
    noise = np.random.default_rng(1).normal(0.0, 6.0, (HEIGHT, WIDTH, 1))
    return np.clip((np.asarray(image) + noise) / 255.0, 0.0, 1.0).astype(np.float32)


SOFA = (150.0, 170.0, 330.0, 260.0), (90, 30, 25)
BENCH = (200.0, 200.0, 270.0, 245.0), (112, 110, 104)
"""Hardly another colour than the ground."""


def stand(place: tuple[float, float, float] | None = None, camera: Camera = CAMERA) -> Stand:
    """Return a box of .8 m where it stands."""
    placed = place_asset(LOW, HIGH, camera, None, place=place)
    return Stand(placed.asset_to_world, LOW, HIGH, camera)


def inside(pixels: Float64Array, box: tuple[float, ...]) -> float:
    """Return the share of pixels in a box."""
    left, top, right, bottom = box
    return float(((pixels >= (left, top)) & (pixels <= (right, bottom))).all(axis=1).mean())


def test_an_object_stands_beside_what_is_there() -> None:
    """The nearest place that looks like ground; on open ground, and half its size, no other."""
    ground = OpenGround.of(photo(SOFA), CAMERA, PLANE)
    assert ground is not None and not ground.holds(stand())
    place = find_place(stand, CAMERA, PLANE, open_ground=ground)
    there = stand(place)
    assert ground.holds(there) and inside(stand().foot(), SOFA[0]) > 0.9
    assert inside(there.foot(), SOFA[0]) < 0.1 and not there.is_cut
    for shown in (photo(), photo(BENCH)):
        alike = OpenGround.of(shown, CAMERA, PLANE)
        assert alike is not None and alike.holds(stand())


@pytest.mark.parametrize("deviation", [10.0, 80.0])
def test_grain_that_is_alike_everywhere_is_open_ground(deviation: float) -> None:
    """However strong it is, as that of gravel."""
    for seed in range(4):
        luma = np.random.default_rng(seed).normal(115.0, deviation, (HEIGHT, WIDTH, 1)) / 255.0
        shown = np.clip(luma, 0.0, 1.0).repeat(3, axis=2).astype(np.float32)
        ground = OpenGround.of(shown, CAMERA, PLANE)
        assert ground is not None and ground.holds(stand())


def test_nothing_is_known_without_ground() -> None:
    """Of a camera that looks up, or of a photo of few pixels."""
    up = camera_from_fov(WIDTH, HEIGHT, 30.0, 20.0, 1.6)
    assert OpenGround.of(photo(SOFA), up, PLANE) is None
    assert OpenGround.of(photo(SOFA)[:48, :66], CAMERA, PLANE) is None


@pytest.mark.parametrize("asked", [{}, {"at": (240.0, 238.0)}], ids=["free", "at"])
def test_inputs_say_why_an_object_was_moved(tmp_path: Path, asked: dict[str, object]) -> None:
    """An object that was placed stays where it was put."""
    Image.fromarray(np.round(255.0 * photo(SOFA)).astype(np.uint8)).save(tmp_path / "photo.png")
    trimesh.creation.box(extents=(0.8, 0.5, 0.8)).export(tmp_path / "box.glb")
    files = {"photo": "photo.png", "asset": "box.glb", "out": "out"}
    paths = {name: str(tmp_path / path) for name, path in files.items()}
    camera = {"pitch": -10.0, "fov": 71.0, "roll": 0.0, "sky": "clear"}
    inputs = read_inputs(InsertConfig(**paths, **camera, **asked))
    there = Stand(inputs.placement.asset_to_world, *inputs.asset.bounds(), inputs.camera)
    is_moved = any("looks like open ground (--at" in line for line in inputs.assumed)
    assert is_moved == (not asked) == (inside(there.foot(), SOFA[0]) < 0.2)


def test_an_object_stays_where_something_passes_in_a_later_frame(tmp_path: Path) -> None:
    """Under a camera that stands still it must not jump: the first frame's look holds for all."""
    trimesh.creation.box(extents=(0.8, 0.5, 0.8)).export(tmp_path / "box.glb")
    loaders, places = Loaders(must_be_seen=False), []
    for name, shown in (("1.png", photo()), ("2.png", photo(SOFA))):
        Image.fromarray(np.round(255.0 * shown).astype(np.uint8)).save(tmp_path / name)
        files = {"photo": name, "asset": "box.glb", "out": "out"}
        paths = {key: str(tmp_path / path) for key, path in files.items()}
        config = InsertConfig(**paths, pitch=-10.0, fov=71.0, roll=0.0, sky="clear")
        places.append(read_inputs(config, loaders).placement.asset_to_world)
    np.testing.assert_array_equal(places[0], places[1])


def test_an_object_stays_where_no_open_ground_is_near(tmp_path: Path) -> None:
    """Everywhere it would stand on narrow stripes of another colour."""
    stripes = photo(*(((x, 120, x + 28, HEIGHT), (200, 60, 30)) for x in range(0, WIDTH, 80)))
    Image.fromarray(np.round(255.0 * stripes).astype(np.uint8)).save(tmp_path / "photo.png")
    trimesh.creation.box(extents=(1.2, 0.5, 1.2)).export(tmp_path / "box.glb")
    files = {"photo": "photo.png", "asset": "box.glb", "out": "out"}
    paths = {name: str(tmp_path / path) for name, path in files.items()}
    inputs = read_inputs(InsertConfig(**paths, pitch=-10.0, fov=71.0, roll=0.0, sky="clear"))
    assert any(f"at pixel {0.5 * WIDTH:g},{0.75 * HEIGHT:g}" in line for line in inputs.assumed)
