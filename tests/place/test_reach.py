"""The object stays in the photo whatever is done to the camera, and its handles beside it."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.programs.browser import needs_chromium
from tests.builders.programs.placing import (
    STATE,
    box_of,
    command,
    drag,
    enter,
    handle_at,
    placing,
    press,
    pull,
)

pytestmark = [needs_chromium, pytest.mark.slow]


def away(state: dict[str, Any]) -> float:
    """Distance of the object over the camera's height."""
    stand, stance = state["stand"], state["stance"]
    return float(np.hypot(stand["x"] - stance["x"], stand["z"] - stance["z"]) / stance["height"])


@pytest.mark.parametrize("width", [1000, 390])
def test_horizon_never_throws_the_object_away(inputs: Path, tmp_path: Path, width: int) -> None:
    """Dragged to the foot, below it and below the photo: the object stays in it, and comes back."""
    argv = command(inputs, tmp_path / "out", "--size", "2")
    with placing(argv, width, 800) as opened:
        page = opened.page
        photo = box_of(opened, "#photo")
        before = page.evaluate(STATE)
        for share in (0.3, 0.5, 1.5):
            # The line itself: the knob in its middle may lie below the object's.
            x, y = photo["x"] + 0.25 * photo["width"], handle_at(opened, "tilt")[1]
            pull(opened, (x, y), (x, y + share * photo["height"]), steps=2)
            state = page.evaluate(STATE)
            assert state["stance"]["pitch"] > before["stance"]["pitch"]
            bounds = page.evaluate("import('./page.js').then(({ handles }) => handles.bounds)")
            assert bounds is not None
            # Its foot is in the photo, and it is not a dot.
            assert bounds[3] < 330.0 and bounds[1] > 0.0 and bounds[3] - bounds[1] > 12.0
            assert away(state) <= 4.0 * away(before) * (1.0 + 1e-6)
            page.locator("#stage").focus()
            press(opened, "Control+z")
            assert page.evaluate(STATE) == before
        # A field does no more than the handle.
        enter(opened, "pitch", "80")
        assert page.evaluate(STATE) == before
        assert float(page.input_value("#pitch")) == pytest.approx(before["stance"]["pitch"])


def test_handles_stand_beside_the_object_on_a_phone(inputs: Path, tmp_path: Path) -> None:
    """None covers it, they are apart, and each does what it does elsewhere."""
    argv = command(inputs, tmp_path / "out", "--size", "2.5")
    with placing(argv, 390, 844) as opened:
        page = opened.page
        for place in ((0.0, 0.0), (-120.0, 20.0), (200.0, 10.0)):
            if place != (0.0, 0.0):
                drag(opened, "foot", place)
            bounds = "import('./page.js').then(({ handles }) => [handles.bounds, handles.scale])"
            box, scale = page.evaluate(bounds)
            photo = box_of(opened, "#photo")
            left, right = photo["x"] + scale * box[0], photo["x"] + scale * box[2]
            top, bottom = photo["y"] + scale * box[1], photo["y"] + scale * box[3]
            knobs = {
                name: handle_at(opened, name) for name in ("size", "turn", "foot", "pitch", "fov")
            }
            for name, (x, y) in knobs.items():
                assert 0.0 <= x <= 390.0, name
                assert not (left < x < right and top < y < bottom), (name, place)
            three = [np.array(knobs[name]) for name in ("size", "turn", "foot")]
            assert min(np.linalg.norm(a - b) for a, b in pairwise(three)) > 35.0
        # Nor does one lie on that of the field of view, where the object reaches to the horizon.
        for size, ahead in (("3.3", "9.3"), ("4", "9.3"), ("4", "12")):
            enter(opened, "size", size)
            enter(opened, "ahead", ahead)
            fov = np.array(handle_at(opened, "fov"))
            for name in ("size", "turn", "foot"):
                assert np.linalg.norm(fov - handle_at(opened, name)) > 24.0, (name, size)
        before = page.evaluate(STATE)
        drag(opened, "turn", (20.0, 0.0))
        turned = page.evaluate(STATE)
        assert turned["turn"] - before["turn"] > 5.0 and turned["stand"] == before["stand"]
        drag(opened, "size", (0.0, -20.0))
        assert page.evaluate(STATE)["size"] > 1.1 * before["size"]
