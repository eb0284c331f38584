"""The demo's content: a sound car, a light of the stated energy, and files within their budget."""

from pathlib import Path

import numpy as np
import pytest

from tools.demo.car import car
from tools.demo.distance import mesh_distance
from tools.demo.make import without_fireflies
from tools.demo.mesh import ellipsoid, lathe, rounded_box, split, tube
from tools.demo.place import HEIGHT, WIDTH, camera, car_to_world
from tools.demo.sky import LUMINANCE, SKY_IRRADIANCE, SUN_TO_SKY, sky, sun_direction
from warpir import demo
from warpir.app.config import InsertConfig
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.io.assets import load_asset
from warpir.io.cameras.reader import read_camera
from warpir.io.images.photos import read_envmap, read_photo
from warpir.lighting.regression import regress
from warpir.lighting.regressor import load_regressor
from warpir.scene.asset import Asset

SHIPPED_MAX = 5_000_000
"""All shipped files together [byte]: they travel in every wheel."""
CAR_MAX = 1_750_000
"""The car's file [byte]."""
RADIUS_TOLERANCE = 0.002
"""Share of a sphere's radius; chords of cells a tenth of it wide sag by 0.13 %."""


@pytest.fixture(scope="module")
def shipped_car() -> Asset:
    """The car, read once."""
    return load_asset(demo.ASSET)


def test_car_stands_on_the_ground_and_faces_z(shipped_car: Asset) -> None:
    """A car of about 3.6 m, symmetric about x = 0, whose tyres touch y = 0."""
    low, high = shipped_car.bounds()
    assert low[1] == pytest.approx(0.0, abs=1e-3)
    assert high[0] == pytest.approx(-low[0], abs=1e-6)
    assert 3.5 < high[2] - low[2] < 3.8
    lamps = [p for p in shipped_car.primitives if shipped_car.materials[p.material].name == "lens"]
    assert lamps[0].positions[:, 2].min() > 1.0


def test_car_normals_are_unit_and_face_outward(shipped_car: Asset) -> None:
    """Shading normals lie on the front side of every visible triangle."""
    for p in shipped_car.primitives:
        assert p.normals is not None
        np.testing.assert_allclose(np.linalg.norm(p.normals, axis=1), 1.0, atol=1e-5)
        corners = p.positions[p.indices]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled = np.linalg.norm(area, axis=1)
        assert (doubled > 0.0).all()
        outward = (area * p.normals[p.indices].sum(axis=1)).sum(axis=1) > 0.0
        assert outward.all()


def test_sky_has_the_stated_energy() -> None:
    """Level irradiance is the sky's plus the sun's, whatever texels the disc falls on."""
    for height in (128, 256, 512):
        texels = sky(height) @ LUMINANCE
        direction = map_directions(height, 2 * height)
        angle = texel_solid_angles(height, 2 * height)[:, None]
        falling = np.maximum(direction[..., 1], 0.0) * angle
        near_sun = direction @ sun_direction() > np.cos(np.radians(3.0))
        total = float((texels * falling).sum())
        assert total == pytest.approx(SKY_IRRADIANCE * (1.0 + SUN_TO_SKY), rel=1e-4)
        sun = float((texels * falling)[near_sun].sum())
        assert sun == pytest.approx(SKY_IRRADIANCE * SUN_TO_SKY, rel=0.03)


def test_sky_is_in_our_orientation() -> None:
    """The brightest texel lies where its own row and column say the sun is."""
    texels = sky(256)
    row, column = np.unravel_index(int(texels[..., 1].argmax()), texels.shape[:2])
    lon, lat = np.pi * (1.0 - (column + 0.5) / 256), np.pi * (0.5 - (row + 0.5) / 256)
    toward = np.array([np.sin(lon) * np.cos(lat), np.sin(lat), np.cos(lon) * np.cos(lat)])
    assert float(toward @ sun_direction()) > np.cos(np.radians(1.0))


def test_car_is_in_the_picture() -> None:
    """The placed car lies inside the frame and fills a quarter to two fifths of its width."""
    low, high = car_corners()
    assert (low > 0.0).all() and (high < [WIDTH, HEIGHT]).all()
    assert 0.25 < (high - low)[0] / WIDTH < 0.4


def car_corners() -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the shipped car's box in the picture [px]."""
    matrix = car_to_world()
    pixels = np.concatenate(
        [
            camera().project(p.positions @ matrix[:3, :3].T + matrix[:3, 3])
            for p in load_asset(demo.ASSET).primitives
        ]
    )
    return pixels.min(axis=0), pixels.max(axis=0)


@pytest.mark.slow
def test_shipped_files_are_what_the_code_makes(shipped_car: Asset) -> None:
    """car.glb, sky.exr and camera.json read back as the content functions' output."""
    made = car()
    assert not shipped_car.notices
    assert {m.name for m in shipped_car.materials} == {m.name for m in made.materials}
    for ours, theirs in zip(made.primitives, shipped_car.primitives, strict=True):
        np.testing.assert_allclose(theirs.positions, ours.positions, atol=1e-5)
        np.testing.assert_array_equal(theirs.indices, ours.indices)
    # Eleven significant bits.
    np.testing.assert_allclose(read_envmap(demo.LIGHT), sky(), rtol=2.0**-10)
    np.testing.assert_allclose(read_camera(demo.CAMERA, (WIDTH, HEIGHT)).c2w, camera().c2w)


def test_shipped_files_keep_their_budget() -> None:
    """The demo adds no more than 5 MB to the wheel."""
    assert demo.ASSET.stat().st_size <= CAR_MAX
    assert sum(f.stat().st_size for f in demo.FOLDER.iterdir() if f.is_file()) <= SHIPPED_MAX


def test_demo_config_names_files_that_exist() -> None:
    """``--demo`` becomes an ordinary run, and one under its own light with ``--guidance none``."""
    plain = demo.demo_config(InsertConfig(demo=True, out="unused"))
    lit = demo.demo_config(InsertConfig(demo=True, out="unused", guidance="none"))
    for config in (plain, lit):
        for name in (config.inputs.photo, config.inputs.asset, config.camera.file):
            assert name is not None and Path(name).is_file()
    assert plain.light.file is None and plain.light.exposure is None
    assert lit.light.file is not None and Path(lit.light.file).is_file()
    assert (lit.light.exposure, lit.light.tone) == (0.0, "linear")


def test_demo_config_keeps_what_the_user_named() -> None:
    """A place, a pixel, a turn; and exposure and tone under its own light."""
    named = demo.demo_config(InsertConfig(demo=True, place=(1.0, 0.0, -9.0), rotate_y=20.0))
    assert (named.placement.place, named.placement.rotate_y) == ((1.0, 0.0, -9.0), 20.0)
    pixel = demo.demo_config(InsertConfig(demo=True, at=(600.0, 700.0)))
    stands = pixel.placement
    assert (stands.place, stands.at, stands.rotate_y) == (None, (600.0, 700.0), demo.ROTATE_Y)
    lit = InsertConfig(demo=True, guidance="none", exposure=1.0, tone="reinhard")
    light = demo.demo_config(lit).light
    assert (light.exposure, light.tone) == (1.0, "reinhard")


def test_shipped_regressor_sees_the_sun_of_the_demo() -> None:
    """`make demo` lights the car from about where the photo's shadows say (12 degrees off)."""
    photo, where = read_photo(demo.PHOTO).srgb, camera()
    found = regress(load_regressor(None), photo, where)
    cosine = float(np.clip(found.axis @ sun_direction(), -1.0, 1.0))
    assert np.degrees(np.arccos(cosine)) < 15.0
    assert found.spread_deg < 45.0


def test_fireflies_are_left_out_and_light_is_kept() -> None:
    """One blown-up batch does not count; an even pixel is its plain mean."""
    batches = np.ones((8, 2, 3), dtype=np.float32)
    batches[3, 0] = 1000.0
    batches[:, 1] = np.linspace(0.5, 1.5, 8)[:, None]
    np.testing.assert_allclose(without_fireflies(batches), 1.0, rtol=1e-6)


def test_meshed_sphere_lies_on_the_sphere() -> None:
    """Surface nets put vertices on the zero level, normals along the radius."""
    mesh = mesh_distance(
        lambda x, y, z: np.sqrt(x * x + y * y + z * z) - 1.0, (-1.2,) * 3, (1.2,) * 3, 0.1
    )
    radius = np.linalg.norm(mesh.positions, axis=1)
    np.testing.assert_allclose(radius, 1.0, atol=RADIUS_TOLERANCE)
    np.testing.assert_allclose(mesh.normals, mesh.positions, atol=0.01)
    a, b, c = mesh.positions[mesh.triangles.T]
    volume = np.einsum("tk,tk->", a, np.cross(b, c)) / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)


def test_split_keeps_the_area_and_respects_the_line() -> None:
    """Both parts together are the whole; neither reaches past the cut."""
    whole = ellipsoid((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), 12)
    below, above = split(whole, whole.positions[:, 0] - 0.31)
    assert below.positions[:, 0].max() < 0.32 and above.positions[:, 0].min() > 0.30

    def area(surface: object) -> float:
        corners = surface.positions[surface.triangles]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return 0.5 * float(np.linalg.norm(cross, axis=1).sum())

    assert area(below) + area(above) == pytest.approx(area(whole), rel=1e-9)


@pytest.mark.parametrize(
    "surface",
    [
        lathe([(-1.0, 0.0), (-1.0, 0.5), (1.0, 0.5), (1.0, 0.0)], 24),
        tube([(0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.0, 2.0)], 0.1),
        rounded_box((0.1, 0.2, 0.3), (1.0, 0.5, 0.4), 0.05),
        ellipsoid((0.0, 0.0, 0.0), (1.0, 2.0, 0.5)),
    ],
    ids=["lathe", "tube", "rounded_box", "ellipsoid"],
)
def test_swept_solids_are_closed(surface: object) -> None:
    """Every edge is shared by two triangles that run along it in opposite directions."""
    _, number = np.unique(np.round(surface.positions, 9), axis=0, return_inverse=True)
    triangles = number.reshape(-1)[surface.triangles]
    edges = np.concatenate([triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    forward = {(int(a), int(b)) for a, b in edges}
    assert all((b, a) in forward for a, b in forward)
