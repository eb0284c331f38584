"""The page with the object on the photo in 3D: its numbers, and what a browser draws of them."""

import base64
import json
import re
import zlib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests.builders.insertions import arguments, go, write_inputs
from tests.builders.programs.browser import needs_chromium, open_browser
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.io.layers import read_layers
from warpir.report.viewer import shadow_directions


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run under lobes."""
    folder = tmp_path_factory.mktemp("viewer")
    write_inputs(folder)
    light = str(folder / "lobes.json")
    argv = arguments(folder, folder / "out", light=light, samples="16", device="cpu", no_detail="")
    go(argv, folder / "out")
    return folder


def test_viewer_holds_what_it_needs_and_no_path(inputs: Path) -> None:
    """One page under a policy that lets nothing else in; the numbers are those of the run."""
    page = (inputs / "out" / "viewer.html").read_text()
    (policy,) = re.findall('Content-Security-Policy" content="([^"]*)"', page)
    assert policy.startswith("default-src 'none'; img-src data: blob:;") and "unsafe" not in policy
    told = re.sub(r'<script type="text/plain".*?</script>', "", page, flags=re.DOTALL)
    assert "http:" not in told and "https:" not in told
    assert str(inputs) not in page and len(page) < 1.5e6
    scene = json.loads(re.findall(r'id="scene">(.*?)</script>', page)[0])
    camera = json.loads((inputs / "out" / "camera.json").read_text())
    assert scene["camera"] == {name: camera[name] for name in scene["camera"]}
    packed = re.findall(r'id="data-object">(.*?)</script>', page)[0]
    assert zlib.decompress(base64.b64decode(packed)) == (inputs / "out/object.glb").read_bytes()


def test_directions_of_a_shadow_bring_all_of_the_light() -> None:
    """A sun is one direction with its share of the irradiance; an even sky is spread by cosine."""
    directions = map_directions(128, 256)
    up = np.array([0.0, 1.0, 0.0])
    even = np.ones((128, 256, 3), np.float32)
    found = shadow_directions(even, up)
    np.testing.assert_allclose(found[:, 3:].sum(axis=0), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 1.0)
    # The mean cosine under light that is spread by the cosine is 2 / 3.
    assert (found[:, 1] * found[:, 3]).sum() == pytest.approx(2.0 / 3.0, abs=0.02)
    sun = np.unravel_index(np.argmax(directions @ np.array([0.6, 0.8, 0.0])), (128, 256))
    even[sun] += (4e4, 3e4, 1e4)
    lit = shadow_directions(even, up)
    largest = lit[np.argmax(lit[:, 3])]
    assert largest[:3] @ directions[sun] == pytest.approx(1.0, abs=1e-6)
    irradiance = even[sun] * 0.8 * texel_solid_angles(128, 256)[sun[0]]
    np.testing.assert_allclose(largest[3:], irradiance / (irradiance + np.pi), rtol=0.02)
    assert len(shadow_directions(0.0 * even, up)) == 0


@pytest.mark.slow
@needs_chromium
def test_viewer_shows_the_object_where_the_picture_has_it(inputs: Path, tmp_path: Path) -> None:
    """Orbit is off; the object covers its pixels, the shadow darkens, turning leaves the photo."""
    layers = read_layers(inputs / "out" / "layers.exr")
    height, width = layers.matte.shape
    with open_browser(400, 500) as opened:
        page, canvas = opened.page, opened.page.locator("#stage")
        page.goto((inputs / "out" / "viewer.html").as_uri())
        page.wait_for_selector("body[data-ready]", timeout=120_000)
        assert not page.is_checked("#orbit")

        def look() -> NDArray[np.float64]:
            canvas.screenshot(path=str(tmp_path / "shot.png"))
            shot = Image.open(tmp_path / "shot.png").convert("RGB")
            return np.asarray(shot.resize((width, height), Image.Resampling.BOX), np.float64)

        both = look()
        page.uncheck("#shadow")
        unshaded = look()
        page.uncheck("#object")
        photo = look()
        page.check("#orbit")
        page.focus("#stage")
        page.keyboard.press("ArrowLeft")
        turned = look()
        assert opened.errors == []
        assert opened.requests == [(inputs / "out" / "viewer.html").as_uri()]
    plate = 255.0 * np.clip(layers.plate, 0.0, 1.0) ** (1.0 / 2.2)
    inner = np.s_[2:-2, 2:-2]  # the corners are round
    assert np.corrcoef(photo[inner].ravel(), plate[inner].ravel())[0, 1] > 0.9
    is_object = np.abs(unshaded - photo).max(axis=-1) > 6.0
    covered = layers.matte > 0.5
    assert (is_object & covered).sum() / (is_object | covered).sum() > 0.7
    is_shaded = (layers.shadow_ratio[..., 1] < 0.8) & (layers.matte == 0.0)
    assert is_shaded.any() and (both - unshaded)[is_shaded].mean() < -3.0
    assert np.abs(turned - photo).mean() > 10.0
