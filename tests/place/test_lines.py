"""Vanishing lines of the placing page: the closed form against known cameras, and by hand."""

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.programs.browser import Opened, needs_chromium, open_browser
from tests.builders.programs.placing import (
    HEIGHT,
    STATE,
    WIDTH,
    box_of,
    command,
    enter,
    handle_at,
    placing,
    press,
    pull,
    save,
    serve,
    settle,
)
from warpir.core.arrays import Float64Array
from warpir.place.stance import Stance
from warpir.scene.camera import Camera

pytestmark = [needs_chromium, pytest.mark.slow]

ENDS = {
    "a": [[(-1.0, 0.2, -5.0), (2.0, 0.2, -5.0)], [(-1.0, 1.9, -7.0), (1.5, 1.9, -7.0)]],
    "b": [[(-1.2, 0.1, -4.0), (-1.2, 0.1, -7.0)], [(1.4, 1.2, -5.0), (1.4, 1.2, -8.0)]],
    "c": [[(-1.3, 0.0, -5.0), (-1.3, 2.0, -5.0)], [(1.2, 0.0, -6.0), (1.2, 2.5, -6.0)]],
}
"""Segments along x, z and y of a house that is turned in the world [m]."""


def camera_of(stance: Stance, cy: float = HEIGHT / 2.0) -> Camera:
    """A camera whose pixels are not square, centred but for its row."""
    return Camera(WIDTH, HEIGHT, 510.0, 480.0, WIDTH / 2.0, cy, stance.c2w())


def lines_of(camera: Camera, axes: str, turn: float) -> dict[str, Any]:
    """The segments of these axes in the photo."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    house = np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def seen(points: Float64Array) -> Any:
        around = (points - (0.0, 0.0, -6.0)) @ house.T + (0.0, 0.0, -6.0)
        return camera.project(around).tolist()

    return {
        axis: [seen(np.array(segment)) for segment in ends] if axis in axes else None
        for axis, ends in ENDS.items()
    }


def test_lines_tell_known_cameras(inputs: Path, tmp_path: Path) -> None:
    """Two axes give pose and focal length, three the principal point too, an upright photo its row.

    Lines of the tests are exact, so that the camera comes back to rounding.
    """
    guess = Stance(0.3, 1.7, -0.2, 25.0, 0.0, 0.0)
    start = camera_of(guess)
    numbers = {name: getattr(start, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    numbers |= {"fx": 510.0 * 0.7, "fy": 480.0 * 0.7}
    with serve(command(inputs, tmp_path / "out")) as served, open_browser() as opened:
        opened.page.goto(served.address)

        def solved(lines: dict[str, Any], is_upright: bool = False) -> Any:
            code = "(given) => import('./vanishing.js').then((m) => m.solved(...given))"
            return opened.page.evaluate(code, [numbers, guess.record(), lines, is_upright])

        for pitch, roll, turn in ((-11.0, 6.0, 30.0), (14.0, -3.0, 55.0), (-25.0, 20.0, 10.0)):
            stance = Stance(0.3, 1.7, -0.2, 25.0, pitch, roll)
            for axes in ("ab", "ac", "bc", "abc"):
                # Only three axes tell a principal point that is not in the middle.
                cy = 143.0 if axes == "abc" else HEIGHT / 2.0
                camera = camera_of(stance, cy)
                found = solved(lines_of(camera, axes, 25.0 + turn))
                wanted = {**stance.record()}
                assert found["stance"] == pytest.approx(wanted, abs=1e-5), (axes, pitch)
                got = [found["camera"][name] for name in ("fx", "fy", "cx", "cy")]
                assert got == pytest.approx([510.0, 480.0, WIDTH / 2.0, cy], rel=1e-6)
        level = Stance(0.3, 1.7, -0.2, 25.0, 0.0, 4.0)
        found = solved(lines_of(camera_of(level, 95.0), "ab", 60.0), True)
        assert found["stance"] == pytest.approx(level.record(), abs=1e-5)
        assert found["camera"]["cy"] == pytest.approx(95.0) and found["camera"]["fx"] == (
            pytest.approx(510.0)
        )
        # One axis is not enough, nor lines that no camera sees at right angles.
        lines = lines_of(camera_of(guess), "ab", 60.0)
        assert solved({**lines, "b": None}) is None
        assert solved({**lines, "b": lines["a"]}) is None


def lay(opened: Opened, lines: dict[str, Any]) -> None:
    """Drag the ends of the lines where they belong; those that lie under others by keys."""
    page = opened.page
    box = box_of(opened, "#photo")
    scale = box["width"] / WIDTH
    under = "([x, y]) => document.elementFromPoint(x, y).closest('[data-handle]')?.dataset.handle"
    for axis, which, end in ((a, *k) for a in lines if lines[a] for k in np.ndindex(2, 2)):
        name, (u, v) = f"{axis}{which}{end}", lines[axis][which][end]
        x, y = handle_at(opened, name)
        if page.evaluate(under, [x, y]) == name:
            pull(opened, (x, y), (box["x"] + scale * u, box["y"] + scale * v), steps=3)
            continue
        at = page.evaluate(STATE)["lines"][axis][which][end]
        page.locator(f"[data-handle={name}]").focus()
        for away, keys in ((u - at[0], ("Left", "Right")), (v - at[1], ("Up", "Down"))):
            tens, ones = divmod(abs(round(away)), 10)
            for _ in range(tens):
                page.keyboard.press(f"Shift+Arrow{keys[away > 0]}")
            for _ in range(ones):
                page.keyboard.press(f"Arrow{keys[away > 0]}")
        settle(opened)


@pytest.mark.parametrize("width", [1100, 390])
def test_lines_are_dragged_and_saved(inputs: Path, tmp_path: Path, width: int) -> None:
    """Lines that begin as the camera sees them change nothing; laid on edges they tell it."""
    truth = camera_of(Stance(0.0, 1.6, 0.0, 0.0, -9.0, 3.0))
    truth = Camera(WIDTH, HEIGHT, 480.0, 480.0, WIDTH / 2.0, HEIGHT / 2.0, truth.c2w)
    out = tmp_path / "out"
    argv = command(inputs, out, "--fov", "60", "--pitch", "-2")
    with placing(argv, width, 800) as opened:
        page = opened.page
        before = page.evaluate(STATE)
        page.click("#lines")
        settle(opened)
        begun = page.evaluate(STATE)
        assert begun["camera"] == before["camera"] and begun["lines"]["c"] is None
        assert page.inner_text("#lines-words") == ""
        lines = {**lines_of(truth, "ab", 40.0)}
        inside = np.array([lines[axis] for axis in "ab"]).reshape(-1, 2)
        assert (inside > 0).all() and (inside < (WIDTH, HEIGHT)).all()
        for one, other in combinations(inside, 2):
            assert np.linalg.norm(one - other) > 20.0
        lay(opened, lines)
        found = page.evaluate(STATE)
        # The pointer stands on whole pixels of the window.
        coarse = 0.03 if width > 1000 else 0.12
        assert found["camera"]["fx"] == pytest.approx(480.0, rel=coarse)
        assert found["stance"]["pitch"] == pytest.approx(-9.0, abs=40.0 * coarse)
        assert found["stance"]["roll"] == pytest.approx(3.0, abs=40.0 * coarse)
        page.locator("[data-handle=a00]").focus()
        press(opened, "Shift+ArrowUp")
        assert page.evaluate(STATE)["camera"] != found["camera"]
        press(opened, "Control+z")
        assert page.evaluate(STATE) == found
        # An upright photo keeps its horizon, without a pitch.
        page.check("#upright")
        settle(opened)
        upright = page.evaluate(STATE)
        assert upright["stance"]["pitch"] == 0.0
        assert upright["camera"]["cy"] != found["camera"]["cy"]
        page.uncheck("#upright")
        settle(opened)
        assert page.evaluate(STATE)["stance"]["pitch"] == pytest.approx(found["stance"]["pitch"])
        page.check("#upright")
        page.click("#lines")
        settle(opened)
        assert page.locator("[data-handle=pitch]").is_visible()
        save(opened)
    saved = json.loads((out / "camera.json").read_text())
    assert saved["cy"] == pytest.approx(upright["camera"]["cy"])
    assert saved["fx"] == pytest.approx(upright["camera"]["fx"])


@pytest.mark.parametrize("width", [1100, 390])
def test_known_length_tells_the_height(inputs: Path, tmp_path: Path, width: int) -> None:
    """A pole and a distance on the ground, of a known camera, in closed form and on the page."""
    camera = camera_of(Stance(0.3, 1.7, -0.2, 25.0, -11.0, 6.0))
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    ground = np.array([[-2.5, 0.0, -5.0], [-1.0, 0.0, -7.5]])
    pole = np.array([[-2.5, 0.0, -5.0], [-2.5, 2.1, -5.0]])
    argv = command(inputs, tmp_path / "out", "--fov", "60", "--pitch", "-8")
    with placing(argv, width, 800) as opened:
        page = opened.page
        code = "(given) => import('./camera.js').then((m) => m.lengthSeen(...given))"
        for points, is_upright in ((ground, False), (pole, True)):
            ends = camera.project(points).tolist()
            wanted = float(np.linalg.norm(points[0] - points[1]))
            # The stance counts with half the height: everything is half as long.
            for height, share in ((1.7, 1.0), (0.85, 0.5)):
                stance = Stance(0.3, height, -0.2, 25.0, -11.0, 6.0).record()
                found = page.evaluate(code, [numbers, stance, ends[::-1], is_upright])
                assert found == pytest.approx(share * wanted)
        sky = [[10.0, 3.0], [50.0, 4.0]]
        assert page.evaluate(code, [numbers, stance, sky, False]) is None
        before = page.evaluate(STATE)
        page.click("#ruler")
        settle(opened)
        begun = page.evaluate(STATE)
        assert begun["stance"] == before["stance"]
        length = begun["ruler"]["metres"]
        enter(opened, "metres", str(2.0 * length))
        doubled = page.evaluate(STATE)
        assert doubled["stance"]["height"] == pytest.approx(2.0 * before["stance"]["height"])
        assert doubled["size"] == before["size"]
        # Half of the line for the same length: twice as high again, nearly.
        x, y = handle_at(opened, "r1")
        _, foot = handle_at(opened, "r0")
        pull(opened, (x, y), (x, (y + foot) / 2.0), steps=3)
        higher = page.evaluate(STATE)["stance"]["height"]
        assert 1.7 < higher / doubled["stance"]["height"] < 2.3
        for _ in range(3):
            page.keyboard.press("Control+z")
        settle(opened)
        assert page.evaluate(STATE) == before
