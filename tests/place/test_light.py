"""The page's light: estimated from the photo, and without a direction where none is clear."""

import json
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.image_files import write_image
from tests.builders.programs.browser import needs_chromium
from tests.builders.programs.placing import STATE, command, enter, placing, press, save, settle
from warpir.app.inputs import read_light
from warpir.app.settings import LightConfig
from warpir.core.errors import InputError
from warpir.core.latlong import resize_map
from warpir.core.limits import Limits
from warpir.core.progress import Log
from warpir.lighting.regression import CLEAR_DEG, Regression, regress
from warpir.lighting.regressor import load_regressor
from warpir.place import kept
from warpir.place.work import light_record
from warpir.place.worker import Worker
from warpir.scene.camera import camera_from_fov

FLAT = np.full((64, 96, 3), 0.4)
"""A photo that shows nothing."""


@pytest.fixture(scope="module")
def found() -> Regression:
    """An estimate of the shipped networks."""
    return regress(load_regressor(None), FLAT, camera_from_fov(96, 64, 60.0, -8.0, 1.6))


def test_light_record_keeps_the_light_of_the_ground(found: Regression) -> None:
    """With and without a direction the ground gets the estimated irradiance."""
    overhead = replace(
        found,
        axis=np.array([0.0, 1.0, 0.0]),
        directions=np.array([[0.0, 1.0, 0.0]]),
        probability=np.ones(1),
    )
    wanted = overhead.irradiance(np.array([0.0, 1.0, 0.0]))
    clear = light_record(replace(overhead, spread_deg=CLEAR_DEG))
    assert clear["direction"][1] == pytest.approx(90.0)
    np.testing.assert_allclose(np.pi * np.array(clear["sky"]) + clear["sun"], wanted, rtol=1e-12)
    unclear = light_record(replace(overhead, spread_deg=CLEAR_DEG + 0.1))
    assert unclear["direction"] is None and unclear["sun"] == [0.0, 0.0, 0.0]
    np.testing.assert_allclose(np.pi * np.array(unclear["sky"]), wanted, rtol=1e-12)


def test_a_photo_that_shows_nothing_has_no_direction(found: Regression) -> None:
    """The networks say of it that they do not know."""
    assert light_record(found)["direction"] is None


@pytest.mark.slow
def test_worker_prints_no_warnings(
    inputs: Path, worker: Worker, capfd: pytest.CaptureFixture[str]
) -> None:
    """Numbers that overflow are an error of the page; NumPy's lines are for nobody."""
    camera = camera_from_fov(480, 320, 60.0, -8.0, 1.6).record() | {"fx": 5e-324}
    job = {"kind": "light", "config": {"photo": str(inputs / "photo.png")}, "camera": camera}
    with pytest.raises(InputError):
        worker.ask(job)
    worker.stop()
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_worker_answers_refuses_and_starts_again(inputs: Path, worker: Worker) -> None:
    """A job that cannot be done is an error, one whose process was ended too; then another runs."""
    camera = camera_from_fov(480, 320, 60.0, -8.0, 1.6).record()
    job = {"kind": "light", "config": {"photo": str(inputs / "photo.png")}, "camera": camera}
    with pytest.raises(InputError, match="none"):
        worker.ask({**job, "config": {"photo": "none.png"}})
    assert worker.ask(job)["spread_deg"] > 0.0
    worker.stop()
    assert worker.ask(job)["spread_deg"] > 0.0


def test_worker_that_is_closed_while_it_starts_is_ended() -> None:
    """Ctrl-C then leaves no process behind that works on and finds nobody to answer to."""

    class Closed(Worker):
        def _running(self) -> subprocess.Popen[str]:
            process = super()._running()
            self._process = None  # as `close` finds it while the process is being started
            self.close()
            self._process = process
            return process

    closed = Closed()
    with pytest.raises(InputError, match="stopped before it was done"):
        closed.ask({"kind": "none"})
    assert not closed.is_running


@pytest.mark.slow
def test_cancelled_picture_leaves_the_light(inputs: Path, worker: Worker) -> None:
    """The light that is estimated before it is answered, however long that takes."""
    camera = camera_from_fov(480, 320, 60.0, -8.0, 1.6).record()
    job = {"kind": "light", "config": {"photo": str(inputs / "photo.png")}, "camera": camera}
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(worker.ask, job)
        while not worker.is_running:
            time.sleep(0.01)
        worker.interrupt()
        assert asked.result()["spread_deg"] > 0.0


@needs_chromium
@pytest.mark.slow
def test_page_opens_with_the_estimated_light(tmp_path: Path) -> None:
    """Of the demo's photo: marked as an estimate, drawn with its doubt, saved only when changed."""
    argv = ["--demo", "--out", str(tmp_path / "out"), "--no-browser"]
    with placing(argv) as opened:
        page = opened.page
        page.wait_for_selector("#light[data-source=estimate]", timeout=60_000)
        words = page.inner_text("#light-words")
        assert words.startswith("Estimated from the photo: azimuth")
        azimuth, elevation = (float(page.input_value(f"#{n}")) for n in ("azimuth", "elevation"))
        assert f"azimuth {azimuth:.0f}°, elevation {elevation:.0f}°, ±" in words
        assert page.locator("#dial .doubt").is_visible() and page.locator(".sun").is_visible()
        assert not page.is_checked("#keep-light")
        axis = page.evaluate("import('./page.js').then(({ stage }) => stage.axis.toArray())")
        a, e = np.radians([azimuth, elevation])
        wanted = [np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)]
        np.testing.assert_allclose(axis, wanted, atol=0.02)  # shown in whole degrees
        enter(opened, "elevation", "30")
        assert page.is_checked("#keep-light") and page.locator(".doubt").is_hidden()
        assert page.evaluate(STATE)["light"]["azimuth"] == pytest.approx(azimuth, abs=0.6)
        press(opened, "Control+z")
        assert not page.is_checked("#keep-light") and page.locator(".doubt").is_visible()
        page.check("#keep-light")
        save(opened)
    saved = json.loads((tmp_path / "out" / "insert.json").read_text())
    assert saved["sun"][:2] == pytest.approx([azimuth, elevation], abs=0.6)
    assert len(saved["sky"]) == 3


@needs_chromium
@pytest.mark.slow
def test_estimated_colours_can_be_chosen_for_a_given_light(inputs: Path, tmp_path: Path) -> None:
    """Also for a light of before the estimate, as undo brings it back."""
    out = tmp_path / "out"
    with placing(command(inputs, out, "--sky", "clear"), 1000, 700) as opened:
        page = opened.page
        page.uncheck("#keep-light")
        page.wait_for_selector("#light:is([data-source=estimate], [data-source=unclear])")
        press(opened, "Control+z")
        assert page.input_value("#sky") == "clear"
        page.select_option("#sky", "custom")
        save(opened)
    assert len(json.loads((out / "insert.json").read_text())["sky"]) == 3


@needs_chromium
@pytest.mark.slow
def test_page_draws_no_sun_at_night(inputs: Path, tmp_path: Path) -> None:
    """Of a dark photo no direction is invented; one that is clicked is the user's."""
    noise = np.random.default_rng(0).normal(8.0, 2.0, (320, 480, 3))
    Image.fromarray(np.clip(noise, 0, 255).astype(np.uint8)).save(tmp_path / "night.png")
    argv = command(inputs, tmp_path / "out")
    argv[argv.index("--photo") + 1] = str(tmp_path / "night.png")
    with placing(argv, 390, 844) as opened:
        page = opened.page
        assert page.locator("#dial .sun").is_hidden()  # nor before anything is known
        page.wait_for_selector("#light[data-source=unclear]", timeout=60_000)
        assert "no clear direction" in page.inner_text("#light-words")
        assert page.locator("#dial .sun").is_hidden() and page.input_value("#azimuth") == ""
        sun = "import('./page.js').then(({ stage }) => stage.sun.visible)"
        assert page.evaluate(sun) is False
        page.locator("#dial").click(position={"x": 60.0, "y": 40.0})
        settle(opened)
        assert page.is_checked("#keep-light") and page.evaluate(sun) is True
        assert page.locator("#dial .sun").is_visible()


def test_a_large_panorama_is_read_once_and_shrunk(tmp_path: Path, monkeypatch) -> None:
    texels = np.full((1024, 2048, 3), 0.25, np.float32)
    texels[200:202, 500:504] = 900.0
    path = write_image(tmp_path / "sky.exr", texels)
    reads = []

    def read(*asked):
        reads.append(asked)
        return read_light(*asked)

    monkeypatch.setattr(kept, "read_light", read)
    loaders, up = kept.Kept(), np.array([0.0, 1.0, 0.0])
    for turn in (0.0, 90.0):
        asked = LightConfig(file=str(path), rotate=turn)
        light = loaders.light(asked, False, np.eye(4), Limits(), Log())
        assert light is not None and light.texels is not None
        assert light.texels.shape == (512, 1024, 3)
        given = read_light(asked, False, np.eye(4), Limits(), Log())
        np.testing.assert_allclose(light.irradiance(up), given.irradiance(up), rtol=1e-3)
        np.testing.assert_array_equal(light.texels, resize_map(given.texels, 512))
    assert len(reads) == 1
    write_image(path, texels[::2, ::2] + np.float32(1.0))
    light = loaders.light(asked, False, np.eye(4), Limits(), Log())
    given = read_light(asked, False, np.eye(4), Limits(), Log())
    np.testing.assert_array_equal(light.texels, given.texels)  # the file has changed
