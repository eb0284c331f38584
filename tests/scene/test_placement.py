"""Where the object stands: `warpir.scene.placement`."""

import math
import re

import numpy as np
import pytest

from warpir.core.arrays import Float64Array, IntArray
from warpir.core.errors import InputError
from warpir.scene.asset import Asset, Material, Primitive
from warpir.scene.camera import Camera, camera_from_fov
from warpir.scene.placement import (
    levelled,
    place_asset,
    settled,
    turn,
    up_to_y,
    upright_plane,
    y_to,
)
from warpir.scene.receiver import ReceiverMesh

# float64 and a handful of products
EXACT = 1e-12

LOW, HIGH = np.array([-1.0, 0.5, -2.0]), np.array([3.0, 2.5, 4.0])
"""A box whose origin is neither at its foot nor in its middle."""
PLACE = (0.0, 0.0, -4.0)


@pytest.fixture
def camera() -> Camera:
    return camera_from_fov(800, 600, 60.0, -10.0, 1.5)


def world(matrix: Float64Array, *points: tuple[float, float, float]) -> Float64Array:
    homogeneous = np.array([[*point, 1.0] for point in points])
    moved: Float64Array = (homogeneous @ matrix.T)[:, :3]
    return moved


def test_placement_sets_the_lowest_point_on_the_ground(camera: Camera) -> None:
    """The centre of the footprint stands at the place and nothing is below the ground."""
    placed = place_asset(LOW, HIGH, camera, place=(0.5, 7.0, -30.0), scale=2.0, rotate_y=33.0)
    foot = world(placed.asset_to_world, (1.0, 0.5, 1.0))[0]
    np.testing.assert_allclose(foot, (0.5, 0.0, -30.0), atol=1e-12)
    top = world(placed.asset_to_world, (1.0, 2.5, 1.0))[0]
    np.testing.assert_allclose(top, (0.5, 4.0, -30.0), atol=1e-12)


def test_placement_turns_counter_clockwise_seen_from_above(camera: Camera) -> None:
    """The asset's front, +Z, faces +X after a quarter turn (right-handed about +Y)."""
    placed = place_asset(LOW, HIGH, camera, place=(0.0, 0.0, -30.0), rotate_y=90.0)
    front = placed.asset_to_world[:3, :3] @ (0.0, 0.0, 1.0)
    np.testing.assert_allclose(front, (1.0, 0.0, 0.0), atol=EXACT)


def test_placement_without_turn_keeps_the_axes(camera: Camera) -> None:
    """On level ground the rotation is the identity."""
    placed = place_asset(LOW, HIGH, camera, place=(0.0, 0.0, -30.0), scale=3.0)
    np.testing.assert_array_equal(placed.asset_to_world[:3, :3], 3.0 * np.eye(3))


def test_placement_size_is_the_longest_side(camera: Camera) -> None:
    """--size scales the longest side, here 6 m along z, to the given metres."""
    placed = place_asset(LOW, HIGH, camera, place=(0.0, 0.0, -30.0), size=1.5)
    assert np.linalg.norm(placed.asset_to_world[:3, 0]) == pytest.approx(0.25, abs=EXACT)


def test_placement_at_a_pixel_is_seen_there(camera: Camera) -> None:
    """The foot of an object placed --at U,V projects to U,V."""
    placed = place_asset(LOW, HIGH, camera, at=(300.0, 400.0), size=0.2)
    foot = world(placed.asset_to_world, (1.0, 0.5, 1.0))
    np.testing.assert_allclose(camera.project(foot)[0], (300.0, 400.0), atol=1e-9)


def test_placement_on_a_slope_stands_along_its_normal(camera: Camera) -> None:
    """Up becomes the ground's normal, and the box touches the ground with its lowest side."""
    ground = (0.2, 2.0, 0.3, 1.0)
    placed = place_asset(LOW, HIGH, camera, ground, place=(0.0, 0.0, -20.0), rotate_y=20.0)
    normal = np.array(ground[:3]) / np.linalg.norm(ground[:3])
    up = placed.asset_to_world[:3, :3] @ (0.0, 1.0, 0.0)
    np.testing.assert_allclose(up, normal, atol=EXACT)
    corners = [(x, y, z) for x in (-1.0, 3.0) for y in (0.5, 2.5) for z in (-2.0, 4.0)]
    heights = world(placed.asset_to_world, *corners) @ normal + 1.0 / np.linalg.norm(ground[:3])
    assert heights.min() == pytest.approx(0.0, abs=1e-12)


def test_placement_of_a_ground_given_upside_down_is_the_same(camera: Camera) -> None:
    """(a, b, c, d) and its negative are one plane; the normal points to the camera's side."""
    one = place_asset(LOW, HIGH, camera, (0.0, 2.0, 0.0, 0.0), place=(0.0, 0.0, -30.0))
    other = place_asset(LOW, HIGH, camera, (0.0, -4.0, 0.0, 0.0), place=(0.0, 0.0, -30.0))
    np.testing.assert_allclose(one.asset_to_world, other.asset_to_world, atol=EXACT)
    np.testing.assert_allclose(one.ground, (0.0, 1.0, 0.0, 0.0), atol=EXACT)


@pytest.mark.parametrize("seed", range(8))
def test_placement_rotations_are_rigid(seed: int) -> None:
    """`y_to` takes +Y to the normal; both rotations are orthonormal with determinant +1."""
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    for rotation in (y_to(normal), turn(normal, float(rng.uniform(-7.0, 7.0)))):
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT)
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=EXACT)
    np.testing.assert_allclose(y_to(normal)[:, 1], normal, atol=EXACT)


def test_placement_rotation_to_straight_down() -> None:
    """The one normal without a smallest rotation still gets a proper one."""
    rotation = y_to(np.array([0.0, -1.0, 0.0]))
    np.testing.assert_allclose(rotation[:, 1], (0.0, -1.0, 0.0), atol=EXACT)
    assert np.linalg.det(rotation) == pytest.approx(1.0, abs=EXACT)


@pytest.mark.parametrize("axis", ["x", "y", "z", "-x", "-y", "-z"])
def test_levelling_hardly_changes_with_the_normal(axis: str) -> None:
    """Near each axis it is about the turn of that axis; the smallest one turns over near -Y."""
    up = up_to_y(axis).T @ [0.0, 1.0, 0.0]
    for normal in up + np.random.default_rng(3).normal(0.0, 0.01, (8, 3)):
        normal /= np.linalg.norm(normal)
        rotation = levelled(normal)
        np.testing.assert_allclose(rotation @ normal, [0, 1, 0], atol=EXACT)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=EXACT)
        np.testing.assert_allclose(rotation, up_to_y(axis), atol=0.05)


def test_placement_says_what_it_assumed(camera: Camera) -> None:
    """With nothing given: ground, place and scale are named; with all given, nothing is."""
    words = " / ".join(place_asset(LOW, HIGH, camera_from_fov(800, 600, 60, -5, 3.0)).assumed)
    assert "y = 0" in words and "--at" in words and "--size" in words
    given = place_asset(LOW, HIGH, camera, (0, 1, 0, 0), place=(0, 0, -30), scale=1.0)
    assert given.assumed == () and given.warnings == ()


@pytest.mark.parametrize(
    ("arguments", "where", "words"),
    [
        ({"place": (0.0, 0.0, 30.0)}, "--place", "behind"),
        ({"place": (0.0, 0.0, -1.0), "scale": 3.0}, "--place", "inside"),
        ({"place": (90.0, 0.0, -20.0)}, "--place", "outside the photo"),
        ({"at": (400.0, 100.0)}, "--at", "horizon"),
        ({"at": (400.0, 601.0)}, "--at", "outside the photo"),
        ({"ground": (0.0, 1.0, 0.0, -1.5)}, "--ground", "through the camera"),
    ],
    ids=["M22-behind", "M22-around", "M22-out-of-frame", "sky", "off-image", "C8-through"],
)
def test_placement_refuses(
    camera: Camera, arguments: dict[str, tuple[float, ...]], where: str, words: str
) -> None:
    """What cannot be seen is an error that names the flag."""
    with pytest.raises(InputError) as caught:
        place_asset(LOW, HIGH, camera, **arguments)  # type: ignore[arg-type]
    assert caught.value.where == where
    assert words in caught.value.what


@pytest.mark.parametrize(
    ("size", "distance", "words"),
    [(0.001, 3.0, "0.001 m large"), (5000.0, 3.0, "5e+03 m large"), (1.0, 2.3, "cut by")],
    ids=["M15-small", "M15-large", "M22-cut"],
)
def test_placement_warns(size: float, distance: float, words: str) -> None:
    """Doubtful sizes, and objects that the frame cuts, are placed with a warning."""
    camera = camera_from_fov(800, 600, 60.0, 0.0, size)
    placed = place_asset(LOW, HIGH, camera, place=(0.0, 0.0, -distance * size), size=size)
    assert len(placed.warnings) == 1
    assert words in placed.warnings[0]


@pytest.mark.parametrize("y", [-3.0, 0.0, 7.0], ids=["M22-below", "M22-on", "M22-above"])
def test_placement_off_the_ground_is_set_on_it(camera: Camera, y: float) -> None:
    """A place below or above the ground means the point of the ground under or over it."""
    placed = place_asset(LOW, HIGH, camera, place=(0.5, y, -20.0), scale=1.0)
    on_ground = place_asset(LOW, HIGH, camera, place=(0.5, 0.0, -20.0), scale=1.0)
    np.testing.assert_array_equal(placed.asset_to_world, on_ground.asset_to_world)
    corners = np.array([[x, v, z] for x in (LOW[0], HIGH[0]) for v in (LOW[1], HIGH[1])
                        for z in (LOW[2], HIGH[2])])  # fmt: skip
    world = corners @ placed.asset_to_world[:3, :3].T + placed.asset_to_world[:3, 3]
    assert world[:, 1].min() == pytest.approx(0.0, abs=1e-12)


def test_place_that_is_moved_onto_the_ground_is_told(camera: Camera) -> None:
    """The plane that the notice names carries the object where it was asked to stand."""
    asked = 0.5, 0.75, -20.0
    (notice,) = place_asset(LOW, HIGH, camera, place=asked, scale=1.0).warnings
    assert notice.startswith("--place is 0.75 m above the ground")
    (level,) = re.findall(r"--ground (\S+)", notice)
    a, b, c, d = map(float, level.split(","))
    placed = place_asset(LOW, HIGH, camera, (a, b, c, d), place=asked, scale=1.0)
    np.testing.assert_allclose(world(placed.asset_to_world, (1.0, 0.5, 1.0))[0], asked, atol=1e-9)
    near = place_asset(LOW, HIGH, camera, place=(0.5, 0.005, -20.0), scale=1.0)
    assert not placed.warnings and not near.warnings


@pytest.mark.parametrize(("table", "is_on_it"), [(0.5, True), (0.495, True), (0.3, False)])
def test_place_that_is_moved_off_a_mesh_is_told(
    camera: Camera, table: float, is_on_it: bool
) -> None:
    """A ground for all of the scene at the height of a table of --proxy is no advice."""
    place = (0.5, 0.5, -4.0)
    (line,) = place_asset(LOW, HIGH, camera, place=place, size=0.4, mesh=_table(table)).warnings
    assert ("by --at, or with --no-plane" in line, "--ground 0,1" in line) == (
        is_on_it,
        not is_on_it,
    )


def test_placement_tells_distance_size_and_pixels() -> None:
    """A wrong horizon, height or unit shows in one line before anything is rendered."""
    camera = camera_from_fov(800, 600, 90.0, 0.0, 3.0)
    low, high = np.array([-1.0, 0.0, 0.0]), np.array([1.0, 1.0, 0.0])
    placed = place_asset(low, high, camera, place=(0.0, 0.0, -4.0), scale=2.0)
    # 400 px of focal length: 4 m at a distance of 4 m is 400 px wide, its foot 300 px below the eye
    assert placed.summary == (
        "the object of 4 x 2 x 0 m stands 5 m from the camera, its box in columns 200 to 600, "
        "rows 400 to 600"
    )


@pytest.mark.case("C8")
def test_placement_plane_needs_a_normal() -> None:
    """A plane of zeros is refused."""
    with pytest.raises(InputError, match="--ground"):
        upright_plane((0.0, 0.0, 0.0, 1.0), np.array([0.0, 1.5, 0.0]))


@pytest.mark.case("M16")
@pytest.mark.parametrize("axis", ["x", "+x", "-x", "y", "-y", "z", "-z"])
def test_M16_up_axis_of_an_asset_becomes_y(axis: str) -> None:
    """What points along the axis points up; normals and tangents follow, nothing is mirrored."""
    up = np.zeros(3)
    up["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    corners = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [-2.0, 1.0, 0.5], 5.0 * up])
    first, second = (v / np.linalg.norm(v) for v in (corners[1], corners[2]))
    normal = np.cross(first, second)
    stored = np.tile(normal / np.linalg.norm(normal), (4, 1)).astype(np.float32)
    tangents = np.column_stack([np.tile(first, (4, 1)), [1, -1, 1, -1]]).astype(np.float32)
    triangle = np.array([[0, 1, 2]], dtype=np.int32)
    asset = Asset("", (Primitive(corners, triangle, 0, stored, tangents),), (Material(),))
    (turned,) = asset.turned(up_to_y(axis)).primitives
    np.testing.assert_array_equal(turned.positions[3], [0.0, 5.0, 0.0])
    a, b, c = turned.positions[turned.indices[0]]
    outward = np.cross(b - a, c - a)
    assert turned.normals is not None and turned.tangents is not None
    np.testing.assert_allclose(turned.normals[0], outward / np.linalg.norm(outward), atol=1e-6)
    np.testing.assert_allclose(turned.tangents[0, :3], b / np.linalg.norm(b), atol=1e-6)
    np.testing.assert_array_equal(turned.tangents[:, 3], [1, -1, 1, -1])
    assert turned.normals.dtype == turned.tangents.dtype == np.float32


@pytest.mark.case("M16")
def test_M16_z_up_is_turned_by_the_stated_map() -> None:
    """(x, y, z) becomes (x, z, -y), as everywhere in the project."""
    np.testing.assert_array_equal(up_to_y("z") @ (1.0, 2.0, 3.0), (1.0, 3.0, -2.0))


def _stool(foot: float) -> Float64Array:
    """Return the vertices of a stool of 0.5 m on three thin feet, whose tips are this high [m]."""
    angles = np.radians((90.0, 210.0, 330.0))
    feet = np.stack([0.2 * np.cos(angles), np.full(3, foot), 0.2 * np.sin(angles)], axis=1)
    return np.concatenate([feet, feet * (1.0, 0.0, 1.0) + (0.0, 0.5, 0.0)])


def _table(height: float, tilt: float = 0.0) -> ReceiverMesh:
    """Return a square of 4 m around (0, height, -4), whose height grows by the tilt along x."""
    corners = [(x, height + tilt * x, z) for x, z in ((-2, -6), (2, -6), (2, -2), (-2, -2))]
    return ReceiverMesh(np.array(corners), np.array([[0, 2, 1], [0, 3, 2]], np.int32))


@pytest.mark.parametrize(
    ("foot", "rise"),
    [(0.004, -0.004), (-0.004, 0.004), (0.03, 0.0), (-0.03, 0.0), (0.0, 0.0)],
    ids=["hovers", "sunk", "hangs", "buried", "stands"],
)
def test_a_small_gap_is_closed_and_a_large_one_is_meant(
    camera: Camera, foot: float, rise: float
) -> None:
    """Up to 5 mm or 1 % of the size, along the normal alone; the line states the millimetres."""
    placed = place_asset(-np.array([0.2, 0, 0.2]), np.array([0.2, 0.5, 0.2]), camera, place=PLACE)
    for mesh, is_plane in ((None, True), (_table(0.0), True), (_table(0.0), False)):
        down = settled(placed, _stool(foot), mesh, is_plane=is_plane)
        moved = down.asset_to_world - placed.asset_to_world
        np.testing.assert_allclose(moved[:3, 3], (0.0, rise, 0.0), atol=1e-12)
        np.testing.assert_array_equal(moved[:3, :3], 0.0)
        said = down.assumed[len(placed.assumed) :]
        assert len(said) == (rise != 0.0) and all("by 4 mm (--no-settle)" in line for line in said)
    assert settled(placed, _stool(foot), settles=False) is placed


def test_feet_on_a_slope_meet_it_without_a_tilt(camera: Camera) -> None:
    """On a mesh that rises by 1 % the uphill foot touches it: 0.2 cos(30) of the foot's radius."""
    placed = place_asset(-np.array([0.2, 0, 0.2]), np.array([0.2, 0.5, 0.2]), camera, place=PLACE)
    down = settled(placed, _stool(0.0), _table(0.0, 0.01), is_plane=False)
    rise = 0.01 * 0.2 * math.cos(math.radians(30.0))
    moved = down.asset_to_world - placed.asset_to_world
    np.testing.assert_allclose(moved[:3, 3], (0.0, rise, 0.0), atol=1e-12)
    np.testing.assert_array_equal(moved[:3, :3], 0.0)
    under = settled(placed, _stool(0.004), ReceiverMesh(*_both(_table(0.0), _table(0.7))))
    assert under.asset_to_world[1, 3] == pytest.approx(placed.asset_to_world[1, 3] - 0.004)


def _both(*meshes: ReceiverMesh) -> tuple[Float64Array, IntArray]:
    """Return positions and triangles of two meshes of four vertices as one."""
    a, b = meshes
    return np.concatenate([a.positions, b.positions]), np.concatenate([a.indices, b.indices + 4])


def test_an_object_sinks_along_the_normal_by_what_is_asked(camera: Camera) -> None:
    """After the gap is closed; one that would vanish is refused."""
    normal = np.array([0.1, 1.0, 0.2]) / math.hypot(0.1, 1.0, 0.2)
    low, high = -np.array([0.2, 0, 0.2]), np.array([0.2, 0.5, 0.2])
    placed = place_asset(low, high, camera, np.append(normal, 0.0), place=PLACE)
    sunk = settled(placed, _stool(0.004), sink=0.02)
    np.testing.assert_allclose(
        sunk.asset_to_world[:3, 3] - placed.asset_to_world[:3, 3], -0.024 * normal, atol=1e-12
    )
    with pytest.raises(InputError) as caught:
        settled(placed, _stool(0.0), sink=0.51)
    assert caught.value.where == "--sink"
