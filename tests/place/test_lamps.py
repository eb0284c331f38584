"""Lamps near the object, put into the photo on the placing page."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.builders.programs.browser import Fingers, Opened, needs_chromium
from tests.builders.programs.placing import (
    EXACT,
    HEIGHT,
    STATE,
    TILTED,
    WIDTH,
    begun,
    box_of,
    command,
    drag,
    placing,
    press,
    pull,
    save,
    settle,
)
from warpir.app.config import InsertConfig
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.core.strict_json import parse_json_object
from warpir.io.lamps_file import read_lamps
from warpir.place.lamps import lamps_file, page_lamps
from warpir.place.renderings import Renderings
from warpir.place.session import placement_files
from warpir.place.worker import Worker
from warpir.scene.near.lamps import RectangleLamp, SphereLamp

BALL = SphereLamp(np.array([1.0, 2.0, -4.0]), 0.1, np.array([20.0, 10.0, 0.0]))
DARK = SphereLamp(np.array([0.0, 1.0, -3.0]), 0.2, np.zeros(3))
FLAT = RectangleLamp(
    np.array([0.0, 2.4, -3.0]),
    np.array([1.0, 0.0, 0.0]),
    np.array([0.0, 0.0, 0.5]),
    np.array([5.0, 30.0, 15.0]),
)
SIDES = {"left": 160, "right": 290}
"""First column of ground beside the object of `test_preview_shows_the_lamp`."""
SEEN = """import('./page.js').then(async ({ state }) => {
  const { project } = await import('./camera.js');
  return state.lamps.map((lamp) => project(state.camera, state.stance, lamp.center));
})"""
"""Where the lamps are, in pixels of the photo."""


def test_saved_lamps_are_those_of_the_page(tmp_path: Path) -> None:
    """Through the page's frame and a file back into the world, nothing has changed."""
    frame, path = TILTED.c2w(), tmp_path / "lamps.json"
    rows = page_lamps((BALL, DARK, FLAT), frame)
    np.testing.assert_allclose(
        frame @ [*rows[0]["center"], 1.0], [*BALL.center, 1.0], rtol=0.0, atol=EXACT
    )
    assert rows[0]["power"] == 20.0 and rows[0]["color"] == [1.0, 0.5, 0.0]
    sent = parse_json_object(path, json.dumps({"lamps": rows}).encode())
    path.write_text(json.dumps(lamps_file(path, sent, frame)))
    for lamp, again in zip((BALL, DARK, FLAT), read_lamps(path, LIMITS, []), strict=True):
        assert type(again) is type(lamp)
        for name, value in vars(lamp).items():
            np.testing.assert_allclose(getattr(again, name), value, rtol=0.0, atol=EXACT)
    for none in ({}, {"lamps": None}, {"lamps": []}):
        assert lamps_file(path, none, frame) is None


@pytest.mark.parametrize(
    "change", [{"radius": 0.0}, {"power": -1.0}, {"center": [1.0, 2.0]}, {"color": "red"}, {"a": 1}]
)
def test_lamps_out_of_range_are_refused(change: dict[str, Any]) -> None:
    """What the page may not send is one line that names the lamp."""
    row = {**page_lamps((BALL,), np.eye(4))[0], **change}
    with pytest.raises(InputError, match="/lamps/0"):
        lamps_file(Path("the page"), {"lamps": [row]}, np.eye(4))
    with pytest.raises(InputError, match="/lamps"):
        lamps_file(Path("the page"), {"lamps": 5}, np.eye(4))


def click_photo(opened: Opened, u: float, v: float) -> None:
    """Click a pixel of the photo."""
    box = box_of(opened, "#photo")
    scale = box["width"] / WIDTH
    opened.page.mouse.click(box["x"] + scale * u, box["y"] + scale * v)
    settle(opened)


def away(state: dict[str, Any]) -> float:
    """Distance of the first lamp from the camera [m]."""
    stance = state["stance"]
    eye = [stance["x"], stance["height"], stance["z"]]
    return float(np.linalg.norm(np.subtract(state["lamps"][0]["center"], eye)))


@needs_chromium
@pytest.mark.slow
@pytest.mark.parametrize("width", [1000, 390])
def test_lamp_is_clicked_dragged_set_and_saved(inputs: Path, tmp_path: Path, width: int) -> None:
    """Each step does what it says and can be undone; `warpir.insert` reads what was saved."""
    out = tmp_path / "out"
    with placing(command(inputs, out), width, 800) as opened:
        page = opened.page
        states = [page.evaluate(STATE)]
        assert states[0]["lamps"] == []

        def step() -> dict[str, Any]:
            settle(opened)
            states.append(page.evaluate(STATE))
            assert states[-1] != states[-2]
            return states[-1]["lamps"][0] if states[-1]["lamps"] else {}

        page.click("#add-lamp")
        click_photo(opened, 150.0, 60.0)
        lamp = step()
        # It hangs at the pixel, above the object's part of the ground, and stays chosen.
        np.testing.assert_allclose(page.evaluate(SEEN)[0], [150.0, 60.0], atol=1.0)
        assert lamp["center"][1] == pytest.approx(2.6) and lamp["power"] > 0.0
        assert page.get_attribute("#add-lamp", "aria-pressed") == "false"
        assert page.locator("#lamp-options").is_visible()
        assert states[-1]["stand"] == states[0]["stand"]
        at, far = np.array(page.evaluate(SEEN)[0]), away(states[-1])
        drag(opened, "lamp0", (24.0, 8.0))
        step()
        moved = np.array(page.evaluate(SEEN)[0])
        scale = page.locator("#photo").bounding_box()["width"] / WIDTH  # type: ignore[index]
        np.testing.assert_allclose(scale * (moved - at), [24.0, 8.0], atol=0.1)
        assert away(states[-1]) == pytest.approx(far)
        drag(opened, "below0", (0.0, 12.0))
        step()
        # Nearer along its ray.
        np.testing.assert_allclose(page.evaluate(SEEN)[0], moved, atol=1e-6)
        assert away(states[-1]) < 0.98 * far
        for name, value in (("distance", 5.0), ("radius", 0.2), ("power", 90.0)):
            page.fill(f"#{name}", str(value))
            page.keyboard.press("Enter")
            lamp = step()
        assert away(states[-1]) == pytest.approx(5.0)
        assert lamp["radius"] == 0.2 and lamp["power"] == 90.0
        # The camera changes: the lamp stays where the photo shows it.
        page.fill("#pitch", "-4")
        page.keyboard.press("Enter")
        step()
        np.testing.assert_allclose(page.evaluate(SEEN)[0], moved, atol=1e-6)
        save(opened)
        saved = json.loads((out / "insert.json").read_text())
        assert saved["lamps"] == str(out / "lamps.json")
        (read,) = read_lamps(saved["lamps"], LIMITS, [])
        # The ground frame stands below the camera, whose height the world's origin has.
        camera = np.array(json.loads((out / "camera.json").read_text())["c2w"])
        assert np.linalg.norm(read.center - camera[:3, 3]) == pytest.approx(5.0)
        assert read.power.max() == pytest.approx(90.0)
        page.click("#remove-lamp")
        step()
        assert states[-1]["lamps"] == [] and page.locator("#lamp-options").is_hidden()
        for before in reversed(states[:-1]):
            page.click("#undo")
            settle(opened)
            assert page.evaluate(STATE) == before
        for after in states[1:]:
            page.click("#redo")
            settle(opened)
            assert page.evaluate(STATE) == after
        # A placement without lamps leaves none behind.
        save(opened)
        assert "lamps" not in json.loads((out / "insert.json").read_text())
        assert not (out / "lamps.json").exists()


@needs_chromium
@pytest.mark.slow
def test_two_fingers_zoom_and_add_no_lamp(inputs: Path, tmp_path: Path) -> None:
    """A pinch that begins where a lamp would be added adds none; the next touch does."""
    argv = command(inputs, tmp_path / "out", "--lamp", "0.5,1,-4,0.1,20")
    with placing(argv, 390, 844) as opened:
        page = opened.page
        assert [lamp["power"] for lamp in page.evaluate(STATE)["lamps"]] == [20.0]
        page.click("#add-lamp")
        box = box_of(opened, "#photo")
        x, y = box["x"] + 100.0, box["y"] + 50.0
        fingers = Fingers(page)
        fingers.press(1, x, y)
        fingers.press(2, x + 60.0, y)
        fingers.move(2, x + 120.0, y)
        fingers.lift(1)
        fingers.lift(2)
        settle(opened)
        assert len(page.evaluate(STATE)["lamps"]) == 1
        assert page.get_attribute("#add-lamp", "aria-pressed") == "true"
        fingers.press(3, x, y)
        fingers.lift(3)
        settle(opened)
        assert len(page.evaluate(STATE)["lamps"]) == 2
        assert page.get_attribute("#add-lamp", "aria-pressed") == "false"
        assert page.input_value("#lamp-which") == "1"
        page.select_option("#lamp-which", "0")
        settle(opened)
        assert float(page.input_value("#power")) == 20.0
        page.locator("[data-handle=lamp1]").focus()
        press(opened, "Delete")
        assert [lamp["power"] for lamp in page.evaluate(STATE)["lamps"]] == [20.0]


@needs_chromium
@pytest.mark.slow
def test_press_beside_the_photo_leaves_the_page_usable(inputs: Path, tmp_path: Path) -> None:
    """No lamp is added there, and an object that reaches out of the photo is dragged and let go."""
    argv = command(inputs, tmp_path / "out", "--size", "4", "--at", "100,318")
    with placing(argv, 900, 900) as opened:
        page = opened.page
        photo = box_of(opened, "#photo")
        x, y = photo["x"] + 60.0, photo["y"] + photo["height"] + 4.0
        page.click("#add-lamp")
        page.mouse.click(x, photo["y"] - 60.0)
        settle(opened)
        assert page.evaluate(STATE)["lamps"] == []
        page.click("#add-lamp")
        before = page.evaluate(STATE)
        pull(opened, (x, y), (x + 50.0, y))
        assert page.evaluate(STATE)["stand"] != before["stand"]
        press(opened, "Control+z")
        assert page.evaluate(STATE) == before


@pytest.mark.slow
def test_preview_shows_the_lamp(inputs: Path, worker: Worker, tmp_path: Path) -> None:
    """It lights the shadow that the sky casts on its side, and the object; its own is opposite."""
    config = InsertConfig(
        photo=str(inputs / "photo.png"),
        asset=str(inputs / "wedge.glb"),
        out=str(tmp_path / "out"),
        size=3.0,
        sky="overcast",
    )
    session, start, said = begun(config)
    stand = start["stand"]
    left = {"center": [stand["x"] - 2.0, 1.0, stand["z"] + 1.0], "radius": 0.05, "power": 400.0}
    renderings = Renderings(worker)
    pictures = []
    try:
        for k, lamps in enumerate(([], [{**left, "color": [1.0, 1.0, 1.0]}])):
            files = placement_files(
                session, config.flat(), {**said, "sky": "overcast", "lamps": lamps}
            )
            renderings._count = k
            content = renderings.file(renderings._preview(files))
            assert content is not None
            (tmp_path / "p.png").write_bytes(content)
            pictures.append(np.asarray(Image.open(tmp_path / "p.png"), np.float64).mean(axis=-1))
    finally:
        renderings.close()
    assert pictures[0].shape == (HEIGHT, WIDTH)
    change = pictures[1] - pictures[0]
    beside = {side: change[225:255, first : first + 30].mean() for side, first in SIDES.items()}
    # Less comes from the sky then: the photo's ground shows both.
    assert beside["left"] > 5.0 and beside["right"] < -4.0
    assert change[150:188, 257:271].mean() > 20.0  # of the fin, which is upright
    assert (change[:120] == 0.0).all()
