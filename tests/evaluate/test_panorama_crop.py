"""A crop of a panorama: directions land where the camera says, and the exposure is the photo's."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from benchmarks.light.panorama_crop import write_crop
from warpir.app.command import parse
from warpir.core.color import expose
from warpir.core.latlong import look_up, map_directions
from warpir.evaluate.scenes import crop_camera, crop_radiance
from warpir.io.cameras.reader import read_camera
from warpir.scene.light import angles_from_axis, axis_from_angles


def one_texel(row: int, column: int) -> np.ndarray:
    texels = np.full((256, 512, 3), 0.1, np.float32)
    texels[row, column] = (50.0, 40.0, 30.0)
    return texels


def test_camera_looks_where_azimuth_and_pitch_say() -> None:
    camera = crop_camera(64, 48, 60.0, 70.0, -12.0, 1.6)
    _, direction = camera.ray(32.0, 24.0)
    assert angles_from_axis(direction) == pytest.approx((70.0, -12.0))
    assert camera.c2w[:3, 3] == pytest.approx((0.0, 1.6, 0.0))
    # No roll: the camera's right is level
    assert camera.c2w[1, 0] == pytest.approx(0.0)


@pytest.mark.parametrize("azimuth", [0.0, 90.0, -144.0, 179.0])
def test_bright_texel_lands_where_the_camera_projects_its_direction(azimuth: float) -> None:
    directions = map_directions(256, 512)
    wanted = axis_from_angles(azimuth + 9.0, -4.0)
    row, column = np.unravel_index(np.argmax(directions @ wanted), (256, 512))
    camera = crop_camera(320, 214, 60.0, azimuth, -10.0, 1.6)
    far = camera.c2w[:3, 3] + 1e6 * directions[row, column]
    expected = camera.project(far[None])[0]

    radiance = crop_radiance(one_texel(int(row), int(column)), camera)

    weight = radiance[..., 0] - 0.1
    v, u = np.mgrid[:214, :320] + 0.5
    centre = np.array([(weight * u).sum(), (weight * v).sum()]) / weight.sum()
    assert centre == pytest.approx(expected, abs=0.3)


def test_look_up_returns_texels_at_their_centres_and_joins_the_seam(
    rng: np.random.Generator,
) -> None:
    texels = rng.uniform(0.1, 2.0, (16, 32, 3)).astype(np.float32)
    assert look_up(texels, map_directions(16, 32)) == pytest.approx(texels, rel=1e-6)
    seam = map_directions(16, 32)[5, 0] + map_directions(16, 32)[5, 31]
    seam /= np.linalg.norm(seam)
    # On the great circle between two texels of a row, a little nearer to the pole than the row
    halves = 0.5 * (texels[4:6, 0] + texels[4:6, 31])
    found = look_up(texels, seam)
    assert np.all(found >= halves.min(axis=0) - 1e-6)
    assert np.all(found <= halves.max(axis=0) + 1e-6)


def test_exposure_makes_light_times_exposure_the_decoded_photo(rng: np.random.Generator) -> None:
    radiance = rng.uniform(0.0, 3.0, (40, 60, 3))
    display, exposure = expose(radiance)
    shown = display < 1.0
    assert (display**2.2)[shown] == pytest.approx((radiance * 2.0**exposure)[shown])
    assert np.percentile(display[display > 0.0], 99.0) == pytest.approx(0.9)


def test_written_files_are_what_the_command_reads(tmp_path: Path) -> None:
    from warpir.io.results import OutputFolder

    with OutputFolder(str(tmp_path / "map")) as output:
        output.write_envmap(one_texel(140, 300))
        output.write_json("run.json", {})
    camera = crop_camera(96, 64, 70.0, 30.0, -5.0, 1.2)
    out = tmp_path / "crop"

    light = write_crop(tmp_path / "map" / "envmap.hdr", camera, out)

    assert np.asarray(Image.open(out / "photo.png")).shape == (64, 96, 3)
    assert read_camera(out / "camera.json", (96, 64)).c2w == pytest.approx(camera.c2w)
    assert json.loads((out / "light.json").read_text()) == light
    argv = ["--photo", str(out / "photo.png"), "--asset", "a.glb", "--out", "o"]
    config = parse([*argv, "--config", str(out / "light.json")]).config
    assert config.light.file == light["light"]
    assert (config.light.exposure, config.light.tone) == (light["exposure"], "linear")
