"""Zoom and pan of the placing page."""

from pathlib import Path

import numpy as np
import pytest

from tests.builders.programs.browser import Fingers, Opened, needs_chromium
from tests.builders.programs.placing import (
    FOOT_ON_CANVAS,
    HEIGHT,
    STATE,
    WIDTH,
    box_of,
    command,
    drag,
    handle_at,
    placing,
    press,
    pull,
    settle,
)

pytestmark = [needs_chromium, pytest.mark.slow]


def photo_box(opened: Opened) -> tuple[float, float, float, float]:
    """Left, top, width and height of the photo, in pixels of the window."""
    box = box_of(opened, "#photo")
    return box["x"], box["y"], box["width"], box["height"]


def share_at(opened: Opened, x: float, y: float) -> list[float]:
    """Where in the photo a point of the window lies, as shares of its sides."""
    left, top, width, height = photo_box(opened)
    return [(x - left) / width, (y - top) / height]


FOOT_IN_PHOTO = """import('./page.js').then(async ({ state: { stance, stand, camera } }) => {
  const { project } = await import('./camera.js');
  return project(camera, stance, [stand.x, 0, stand.z]);
})"""
"""Where in the photo the object's foot is [px]."""


def check_agreement(opened: Opened) -> None:
    """The canvas shows the foot where it is in the photo below it."""
    settle(opened)
    drawn = opened.page.evaluate(FOOT_ON_CANVAS)
    u, v = opened.page.evaluate(FOOT_IN_PHOTO)
    left, top, width, height = photo_box(opened)
    wanted = (left + u / WIDTH * width, top + v / HEIGHT * height)
    assert drawn == pytest.approx(wanted, abs=0.6)


def test_page_zooms_where_the_pointer_is(inputs: Path, tmp_path: Path) -> None:
    """What is under the pointer stays there; placing goes on at any zoom; undo leaves it alone."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640) as opened:
        page = opened.page
        before, whole = page.evaluate(STATE), photo_box(opened)
        check_agreement(opened)
        x, y = handle_at(opened, "foot")
        share = share_at(opened, x + 30.0, y + 20.0)
        page.mouse.move(x + 30.0, y + 20.0)
        page.mouse.wheel(0, -600)
        settle(opened)
        zoomed = photo_box(opened)
        assert zoomed[2] > 2.0 * whole[2]
        assert share_at(opened, x + 30.0, y + 20.0) == pytest.approx(share, abs=1e-3)
        check_agreement(opened)
        assert page.evaluate(STATE) == before
        # The foot follows the pointer, and the photo stays.
        x, y = handle_at(opened, "foot")
        drag(opened, "foot", (40.0, 15.0))
        assert handle_at(opened, "foot") == pytest.approx((x + 40.0, y + 15.0), abs=0.6)
        assert photo_box(opened) == zoomed
        press(opened, "Control+z")
        assert page.evaluate(STATE) == before and photo_box(opened) == zoomed
        # Beside the object the photo is dragged, never past its edge.
        room = box_of(opened, "#room")
        pull(opened, (40.0, 40.0), (100.0, 60.0))
        panned = photo_box(opened)
        assert panned[0] - zoomed[0] == pytest.approx(min(60.0, room["x"] - zoomed[0]), abs=0.6)
        assert panned[0] <= room["x"] + 0.5
        assert page.evaluate(STATE) == before
        check_agreement(opened)
        press(opened, "0")
        assert photo_box(opened) == pytest.approx(whole, abs=0.5)
        # Keys; the closest is 16 times.
        for key in ("z", "z", "l", "k"):
            page.keyboard.press(key)
        settle(opened)
        assert photo_box(opened)[2] == pytest.approx(whole[2] * 1.25**2, rel=1e-3)
        for _ in range(20):
            page.keyboard.press("z")
        settle(opened)
        assert photo_box(opened)[2] == pytest.approx(16.0 * whole[2], rel=1e-3)
        for _ in range(20):
            page.click("#zoom-out")
        settle(opened)
        assert photo_box(opened) == pytest.approx(whole, abs=0.5)
        assert page.evaluate(STATE) == before


def test_fingers_zoom_and_do_not_move_the_object(inputs: Path, tmp_path: Path) -> None:
    """A pinch whose first finger was on the object zooms, and takes back what that had moved."""
    argv = command(inputs, tmp_path / "out", "--size", "4")
    with placing(argv, 390, 844) as opened:
        page = opened.page
        before, whole = page.evaluate(STATE), photo_box(opened)
        bounds = "import('./page.js').then(({ handles }) => [handles.bounds, handles.scale])"
        (left, top, right, bottom), scale = page.evaluate(bounds)
        # Beside the knobs, which go on with what they do whatever other fingers touch.
        x, y = (
            whole[0] + scale * (0.2 * left + 0.8 * right),
            whole[1] + scale * (top + bottom) / 2.0,
        )
        fingers = Fingers(page)
        fingers.press(0, x, y)
        fingers.move(0, x - 8.0, y)
        assert page.evaluate(STATE)["stand"] != before["stand"]
        fingers.press(1, x + 40.0, y)
        share = share_at(opened, x + 16.0, y)
        fingers.move(1, x + 88.0, y)
        fingers.lift(1)
        fingers.lift(0)
        settle(opened)
        assert page.evaluate(STATE) == before
        zoomed = photo_box(opened)
        assert zoomed[2] == pytest.approx(2.0 * whole[2], rel=0.02)
        assert share_at(opened, x + 40.0, y) == pytest.approx(share, abs=0.01)
        check_agreement(opened)
        # One finger beside the object pans.
        fingers.press(0, 20.0, 40.0)
        fingers.move(0, 60.0, 40.0)
        fingers.lift(0)
        settle(opened)
        assert photo_box(opened)[0] > zoomed[0] + 5.0
        assert page.evaluate(STATE) == before
        assert page.is_disabled("#undo")
        page.click("#zoom-fit")
        settle(opened)
        assert np.allclose(photo_box(opened), whole, atol=0.5)
