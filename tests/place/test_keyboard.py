"""The placing page by keyboard alone."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.programs.browser import Opened, needs_chromium
from tests.builders.programs.placing import (
    HEIGHT,
    STATE,
    WIDTH,
    command,
    enter,
    placing,
    press,
    settle,
)
from tests.place.test_lamps import SEEN

pytestmark = [needs_chromium, pytest.mark.slow]


def focused(opened: Opened) -> str:
    """Name of the handle, or id of the element, that has the focus."""
    code = "(({ dataset, id, tagName }) => dataset.handle ?? (id || tagName))"
    name: str = opened.page.evaluate(f"{code}(document.activeElement)")
    return name


def test_lamp_is_added_moved_and_removed(inputs: Path, tmp_path: Path) -> None:
    """It hangs in the upper middle, its knob has the focus, and that is never lost."""
    with placing(command(inputs, tmp_path / "out")) as opened:
        opened.page.focus("#add-lamp")
        press(opened, "Enter")
        assert opened.page.evaluate(SEEN)[0] == pytest.approx([WIDTH / 2, HEIGHT / 4])
        assert focused(opened) == "lamp0"
        press(opened, "Shift+ArrowLeft", "ArrowUp")
        assert opened.page.evaluate(SEEN)[0] == pytest.approx([WIDTH / 2 - 10, HEIGHT / 4 - 1])
        press(opened, "Delete")
        assert opened.page.evaluate(STATE)["lamps"] == []
        assert focused(opened) == "add-lamp"
        press(opened, "Enter")
        opened.page.focus("#remove-lamp")
        press(opened, "Enter")
        assert focused(opened) == "add-lamp"


def test_focus_stays_while_something_is_made(inputs: Path, tmp_path: Path) -> None:
    """On Save, on Render here, and there again after Cancel; seconds are not read aloud."""
    said = {"state": "running", "kind": "preview", "line": "picture", "share": 0.5, "seconds": 3}
    with placing(command(inputs, tmp_path / "out")) as opened:
        page = opened.page
        page.focus("#save")
        press(opened, "Enter")
        page.wait_for_selector("#done:not([hidden])")
        assert focused(opened) == "save"
        page.route("**/preview", lambda route: route.fulfill(json={}))
        page.route("**/progress.json", lambda route: route.fulfill(json=said))
        page.focus("#preview")
        press(opened, "Enter")
        page.wait_for_selector("#clock:has-text('3 s')")
        press(opened, "Enter")
        assert page.inner_text("[role=status]:has-text('Rendering')") == "Rendering …"
        assert focused(opened) == "preview"
        page.focus("#stage")
        press(opened, "q")
        page.focus("#cancel")
        said |= {"state": "done", "address": "photo.jpg"}
        page.wait_for_selector("#rendering-words:has-text('Undo shows it')")
        assert focused(opened) == "preview"
        assert page.is_hidden("#picture")
        press(opened, "Control+z")
        page.wait_for_selector("#picture:not([hidden])")


def test_estimated_light_can_be_read(inputs: Path, tmp_path: Path) -> None:
    """What is written of it has WCAG's contrast of 4.5 on the panel; nothing dims it."""
    seen = """(element) => {
      let opacity = 1;
      for (let e = element; e; e = e.parentElement) opacity *= getComputedStyle(e).opacity;
      return [opacity, getComputedStyle(element).color];
    }"""
    with placing(command(inputs, tmp_path / "out")) as opened:
        page = opened.page
        page.wait_for_selector("#light:not([data-source=own])")
        for name in ("label", ".unit", "input[type=number]", "select"):
            opacity, color = page.locator(f"#light-fields {name}").first.evaluate(seen)
            assert opacity == 1.0, name
            codes = [float(part) / 255.0 for part in color[4:-1].split(",")]
            linear = [((part + 0.055) / 1.055) ** 2.4 for part in codes]
            luminance = np.dot(linear, [0.2126, 0.7152, 0.0722])
            assert (0.95 + 0.05) / (luminance + 0.05) > 4.5, name


@pytest.mark.parametrize(("name", "around"), [("stage", "#room"), ("zoom-in", "#zoom-in")])
def test_focus_on_the_photo_is_seen(inputs: Path, tmp_path: Path, name: str, around: str) -> None:
    """A white frame is drawn where what lies in it and over it does not hide it."""
    with placing(command(inputs, tmp_path / "out"), 700, 500) as opened:
        press(opened, "Tab")
        opened.page.focus(f"#{name}")
        settle(opened)
        picture = Image.open(BytesIO(opened.page.locator(around).screenshot())).convert("RGB")
        white = (np.asarray(picture) == 255).all(axis=-1)
        middle = white.shape[0] // 2
        assert white[middle, :8].sum() == white[middle, -8:].sum() == 2


def test_comma_is_a_decimal_sign(inputs: Path, tmp_path: Path) -> None:
    """1,5 is neither 15 nor nothing, typed or pasted."""
    with placing(command(inputs, tmp_path / "out"), 700, 500) as opened:
        for write in (opened.page.keyboard.type, opened.page.keyboard.insert_text):
            enter(opened, "size", "2")
            opened.page.focus("#size")
            press(opened, "Control+a")
            write("1,5")
            press(opened, "Enter")
            assert opened.page.evaluate(STATE)["size"] == 1.5


def test_refused_number_is_told(inputs: Path, tmp_path: Path) -> None:
    """What a field does not take is said, and what warpir can use is taken."""
    with placing(command(inputs, tmp_path / "out", "--fov", "150"), 700, 500) as opened:
        page = opened.page
        before = page.evaluate(STATE)
        for field, typed, expected in (
            ("pitch", "95", "Pitch, up is positive: expected -89 to 89 ° (found 95)."),
            ("size", "-3", "Size: expected more than 0 (found -3)."),
            ("size", "", ""),
        ):
            enter(opened, field, typed)
            assert page.inner_text("#problem") == expected
            assert page.is_visible("#problem") == bool(expected)
            assert page.evaluate(STATE) == before
        for field, typed in (("fov", "155"), ("right", "-30")):
            enter(opened, field, typed)
            assert page.is_hidden("#problem")
            assert float(page.input_value(f"#{field}")) == float(typed)


def test_refusal_stays_where_saving_follows_at_once(inputs: Path, tmp_path: Path) -> None:
    """What is saved then is not what was typed; once something has changed, it is past."""
    with placing(command(inputs, tmp_path / "out"), 700, 500) as opened:
        page = opened.page
        for save in (lambda: page.click("#save"), lambda: press(opened, "Control+s")):
            page.focus("#pitch")
            press(opened, "Control+a")
            page.keyboard.type("95")
            save()
            page.wait_for_selector("#done", state="visible")
            assert "(found 95)" in page.inner_text("#problem")
            page.focus("#turn-slide")
            press(opened, "ArrowRight", "Control+s")
            page.wait_for_selector("#done", state="visible")
            assert page.is_hidden("#problem")
