"""Crops out, maps back: each map stands where its file says, and faults are one line each."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests import oracles
from tests.builders.image_files import write_envmap
from warpir.core.color import linear_to_gamma
from warpir.core.errors import InputError
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.evaluate.predictions import (
    INDEX,
    export_crops,
    public_crop,
    read_predictions,
    to_world,
)
from warpir.evaluate.scenes import Place, crop_camera
from warpir.io.cameras.reader import read_camera
from warpir.io.results import OutputFolder
from warpir.scene.camera import Camera


def view(azimuth: float = 90.0, pitch: float = 0.0, width: int = 96, height: int = 64) -> Camera:
    """Return a camera of 60 degrees vertical field of view that looks at an azimuth."""
    across = 2.0 * np.degrees(np.arctan(np.tan(np.radians(30.0)) * width / height))
    return crop_camera(width, height, float(across), azimuth, pitch, 1.6)


def scene(name: str = "yard", azimuth: float = 90.0, pitch: float = 0.0) -> Place:
    camera = view(azimuth, pitch)
    ramp = np.linspace(0.0, 1.0, camera.width, dtype=np.float32)
    photo = np.broadcast_to(ramp[None, :, None], (camera.height, camera.width, 3))
    light = np.ones((8, 16, 3), np.float32)
    return Place(name, "yard_1k", camera, azimuth, pitch, photo, 0.25, "gamma", light, (0,))


def dot_map(u: float, v: float, height: int = 64) -> np.ndarray:
    """Return a dim map with one bright texel at a share of its width and height."""
    texels = np.full((height, 2 * height, 3), 0.01, np.float32)
    texels[min(int(v * height), height - 1), int(u * 2 * height)] = (9.0, 8.0, 7.0)
    return texels


def write_map(folder: Path, name: str, texels: np.ndarray, kind: str = "npy") -> None:
    folder.mkdir(exist_ok=True)
    if kind == "npy":
        np.save(folder / f"{name}.npy", texels)
    else:
        write_envmap(folder, name, texels, kind)


def bright_direction(texels: np.ndarray) -> np.ndarray:
    """Return the centroid of what exceeds half the peak, world frame."""
    lum = texels[..., 0].astype(np.float64)
    lum = np.where(lum > 0.5 * lum.max(), lum, 0.0)
    height, width = lum.shape
    weight = lum * texel_solid_angles(height, width)[:, None]
    return oracles.normalize(np.einsum("ij,ijc->c", weight, map_directions(height, width)))


# ----------------------------------------------------------------------------------------- crops


def test_exported_crops_hold_photo_camera_and_light_unit(tmp_path: Path) -> None:
    crops = [scene("yard"), scene("table_2", -144.0, -12.0)]
    export_crops(crops, tmp_path / "crops")
    index = json.loads((tmp_path / "crops" / INDEX).read_text())
    assert [entry["name"] for entry in index["crops"]] == ["yard", "table_2"]
    for entry, crop in zip(index["crops"], crops, strict=True):
        codes = np.asarray(Image.open(tmp_path / "crops" / entry["photo"]))
        assert np.abs(codes / 255.0 - crop.photo).max() <= 0.5 / 255.0 + 1e-6
        assert entry["panorama"] == "yard_1k"
        assert entry["exposure"] == 0.25
        camera_file = tmp_path / "camera.json"
        camera_file.write_text(json.dumps(entry["camera"]))
        assert read_camera(camera_file, (96, 64)).c2w == pytest.approx(crop.camera.c2w)
    assert index["crops"][1]["azimuth_deg"] == pytest.approx(-144.0)
    assert index["crops"][1]["pitch_deg"] == pytest.approx(-12.0)
    assert index["maps"] == {"frame": "camera", "scale": 1.0}


def test_earlier_export_is_replaced_only_when_told(tmp_path: Path) -> None:
    export_crops([scene()], tmp_path)
    with pytest.raises(InputError, match="already holds files"):
        export_crops([scene()], tmp_path)
    export_crops([scene("other")], tmp_path, overwrite=True)
    assert (tmp_path / "other.png").exists()
    assert not (tmp_path / "yard.png").exists()


def test_public_crop_is_the_protocol_s() -> None:
    """Middle 4:3 of the photo, 192 x 256, gamma 2.4, 99th percentile at .9."""
    camera = view(width=384, height=256)
    linear = np.linspace(0.02, 0.8, 384)[None, :, None] * np.ones((256, 1, 3))
    photo = linear_to_gamma(linear).astype(np.float32)
    public = public_crop(photo, camera)
    assert public is not None
    assert public.shape == (192, 256, 3)
    assert np.percentile(public, 99.0) == pytest.approx(0.9, abs=1e-3)
    # Columns 21.5 .. 362.5 of 384 are kept; linear light is a ramp over them.
    shown = public[96, :, 0] ** 2.4
    columns = 21.0 + (np.arange(256) + 0.5) * 341.0 / 256.0 - 0.5
    expected = np.interp(columns, np.arange(384), linear[0, :, 0])
    inner = slice(8, -8)
    assert np.allclose(shown[inner] / shown[128], expected[inner] / expected[128], rtol=2e-3)


def test_public_crop_needs_sixty_degrees_and_enough_width() -> None:
    camera = view(width=96, height=64)
    photo = np.full((64, 96, 3), 0.5, np.float32)
    assert public_crop(photo, camera) is not None
    assert public_crop(photo, replace(camera, fy=camera.fy * 1.1)) is None
    assert public_crop(photo[:, :80], replace(camera, width=80)) is None


# ---------------------------------------------------------------------------------- orientation


@pytest.mark.parametrize("pitch", [0.0, -20.0, 35.0])
@pytest.mark.parametrize("azimuth", [0.0, 90.0, -157.5])
def test_map_in_the_camera_s_frame_shines_from_where_the_crop_says(
    tmp_path: Path, azimuth: float, pitch: float
) -> None:
    """The index holds the world directions of three places of a map: so do the maps read."""
    crop = scene("yard", azimuth, pitch)
    export_crops([crop], tmp_path / "crops")
    entry = json.loads((tmp_path / "crops" / INDEX).read_text())["crops"][0]
    stated = entry["world_direction_of_a_map_in_the_camera_frame"]
    places = {
        "image_centre": (0.5, 0.5),
        "middle_row_three_quarters_to_the_right": (0.75, 0.5),
        "top_row": (0.5, 0.0),
    }
    assert set(stated) == set(places)
    for place, (u, v) in places.items():
        write_map(tmp_path / "maps", "yard", dot_map(u, v))
        world = read_predictions(tmp_path / "maps", [crop]).maps["yard"]
        off = oracles.angle_between(bright_direction(world), stated[place])
        assert np.degrees(off) < 3.0, place  # a texel has 2.8 degrees
    assert stated["image_centre"] == pytest.approx(crop.camera.ray(48.0, 32.0)[1].tolist())


def test_bright_texel_is_seen_where_the_photo_shows_it() -> None:
    """A map of the photo's frame: a spot right of and above the centre projects to there."""
    camera = view(-130.0, -25.0)
    texels = dot_map(0.5 + 15.0 / 360.0, 0.5 - 10.0 / 180.0, 128)
    direction = bright_direction(to_world(texels, camera, "camera"))
    pixel = camera.project((camera.c2w[:3, 3] + 1e3 * direction)[None])[0]
    expected = [
        camera.cx + camera.fx * np.tan(np.radians(15.0)),
        camera.cy - camera.fy * np.tan(np.radians(10.0)) / np.cos(np.radians(15.0)),
    ]
    # A texel of 1.4 degrees is 1.4 pixels wide
    assert pixel == pytest.approx(expected, abs=1.5)


def test_level_frame_ignores_the_pitch_and_keeps_every_texel() -> None:
    texels = dot_map(0.5, 0.3)
    flat = to_world(texels, view(45.0, 0.0), "camera")
    pitched = to_world(texels, view(45.0, -30.0), "level")
    assert np.array_equal(flat, pitched)
    assert np.array_equal(np.sort(flat, axis=1), np.sort(texels, axis=1))


@pytest.mark.parametrize(
    ("place", "tolerance"),
    [
        ((0.5, 0.5), 0.02),
        ((0.31, 0.2), 0.02),
        ((0.9, 0.8), 0.02),
        ((0.3, 0.03), 0.02),
        # Look-ups beyond the centres of the first row meet that row alone: it counts 8 % more.
        ((0.7, 0.0), 0.1),
    ],
)
def test_tilted_map_keeps_its_flux(place: tuple[float, float], tolerance: float) -> None:
    """Also that of a single texel, wherever it comes to lie."""
    texels = dot_map(*place, 128) - np.float32(0.01)
    omega = texel_solid_angles(128, 256)[:, None, None]
    before = (texels * omega).sum(axis=(0, 1))
    after = (to_world(texels, view(77.0, -23.0), "camera") * omega).sum(axis=(0, 1))
    assert after == pytest.approx(before, rel=tolerance)


# ---------------------------------------------------------------------------------------- reading


@pytest.mark.parametrize("kind", ["npy", "exr", "hdr"])
def test_maps_of_each_kind_are_read_alike(tmp_path: Path, kind: str) -> None:
    texels = dot_map(0.6, 0.3)
    write_map(tmp_path, "yard", texels, kind)
    world = read_predictions(tmp_path, [scene("yard")]).maps["yard"]
    expected = to_world(texels, scene("yard").camera, "camera")
    assert np.allclose(world, expected, rtol=1e-2)  # RGBE has 8 bits


def test_missing_and_unused_maps_are_listed(tmp_path: Path) -> None:
    write_map(tmp_path, "yard", dot_map(0.5, 0.5))
    write_map(tmp_path, "yrad_2", dot_map(0.5, 0.5))
    (tmp_path / "notes.txt").write_text("no map")
    found = read_predictions(tmp_path, [scene("yard"), scene("yard_2")])
    assert list(found.maps) == ["yard"]
    assert found.missing == ("yard_2",)
    assert found.unused == ("yrad_2.npy",)


def test_options_of_the_folder_hold_for_its_maps(tmp_path: Path) -> None:
    write_map(tmp_path, "yard", dot_map(0.5, 0.3))
    crop = scene("yard", 20.0, -30.0)
    (tmp_path / INDEX).write_text(json.dumps({"maps": {"frame": "level", "scale": 3.0}}))
    found = read_predictions(tmp_path, [crop]).maps["yard"]
    assert np.allclose(found, 3.0 * to_world(dot_map(0.5, 0.3), crop.camera, "level"))
    export_crops([crop], tmp_path / "crops")
    (tmp_path / INDEX).write_bytes((tmp_path / "crops" / INDEX).read_bytes())
    found = read_predictions(tmp_path, [crop]).maps["yard"]
    assert np.allclose(found, to_world(dot_map(0.5, 0.3), crop.camera, "camera"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"maps": {"frame": "tilted"}}, "/maps/frame: unknown"),
        ({"maps": {"scale": 0}}, "/maps/scale: not a factor"),
        ({"maps": {"scale": True}}, "/maps/scale: not a factor"),
        ({"maps": []}, "/maps: not an object"),
    ],
)
def test_wrong_options_are_refused(tmp_path: Path, options: object, message: str) -> None:
    write_map(tmp_path, "yard", dot_map(0.5, 0.5))
    (tmp_path / INDEX).write_text(json.dumps(options))
    with pytest.raises(InputError, match=message) as raised:
        read_predictions(tmp_path, [scene()])
    assert raised.value.where == str(tmp_path / INDEX)


GOOD = dot_map(0.5, 0.5, 8)


@pytest.mark.parametrize(
    ("stored", "message"),
    [
        (np.ones((8, 15, 3), np.float32), r"not a lat-long map \(found shape \(8, 15, 3\)"),
        (np.ones((8, 16), np.float32), "not a lat-long map"),
        (np.ones((8, 16, 4), np.float32), "not a lat-long map"),
        (np.float32(1.0), "not a lat-long map"),
        (np.ones((8, 16, 3), np.uint8), "floating-point"),
        (np.array(["x"], object), "not a NumPy array of numbers"),
        (np.array(["x"]), "floating-point"),
        (np.where(GOOD > 1.0, np.nan, GOOD), "not clean radiance .found 3 values"),
        (np.full((8, 16, 3), 1e300), "not clean radiance"),
        (-GOOD, "not clean radiance .*negative"),
        (np.zeros((8, 16, 3), np.float32), "black"),
    ],
)
def test_maps_that_are_not_clean_are_named(
    tmp_path: Path, stored: np.ndarray, message: str
) -> None:
    np.save(tmp_path / "yard.npy", stored, allow_pickle=True)
    with pytest.raises(InputError, match=message) as raised:
        read_predictions(tmp_path, [scene("yard")])
    assert raised.value.where == str(tmp_path / "yard.npy")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01\x00", b"not numbers", b"PK\x03\x04"])
def test_damaged_arrays_are_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "yard.npy").write_bytes(content)
    with pytest.raises(InputError) as raised:
        read_predictions(tmp_path, [scene("yard")])
    assert raised.value.where == str(tmp_path / "yard.npy")


def test_flipped_bytes_are_refused_or_read_never_a_bug(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    write_map(tmp_path, "yard", np.ones((8, 16, 3), np.float32))
    path = tmp_path / "yard.npy"
    whole = path.read_bytes()
    read = 0
    for _ in range(300):
        flipped = bytearray(whole)
        flipped[rng.integers(256)] ^= 1 << rng.integers(8)  # header and numbers
        path.write_bytes(flipped)
        try:
            read_predictions(tmp_path, [scene("yard")])
            read += 1
        except InputError as error:
            assert error.where == str(path)
    assert 0 < read < 300


def test_image_files_pass_the_same_checks(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out") as output:
        plane = np.full((8, 16), -1.0, np.float32)
        output.write_exr("a.exr", {"R": plane, "G": plane, "B": plane})
    (tmp_path / "out" / "a.exr").rename(tmp_path / "yard.exr")
    with pytest.raises(InputError, match="not clean radiance"):
        read_predictions(tmp_path, [scene("yard")])


def test_all_faults_are_told_at_once(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.zeros((8, 16, 3), np.float32))
    write_map(tmp_path, "b", GOOD)
    write_map(tmp_path, "b", GOOD, "exr")
    with pytest.raises(InputError, match="black") as raised:
        read_predictions(tmp_path, [scene("a"), scene("b")])
    assert ["more than one map" in str(also) for also in raised.value.also] == [True]


def test_folder_without_any_of_the_maps_is_refused(tmp_path: Path) -> None:
    write_map(tmp_path, "elsewhere", GOOD)
    with pytest.raises(InputError, match=r"found elsewhere.npy; expected yard.exr"):
        read_predictions(tmp_path, [scene("yard")])
    with pytest.raises(InputError, match="not a folder"):
        read_predictions(tmp_path / "none", [scene("yard")])
