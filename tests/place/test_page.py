"""The placing page in a browser: it shows what warpir renders, and counts as the camera does."""

import json
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Route

from tests.builders.insertions import read_layers
from tests.builders.programs.browser import Fingers, Opened, needs_chromium, open_browser
from tests.builders.programs.placing import (
    EXACT,
    FOOT_ON_CANVAS,
    HEIGHT,
    STATE,
    TILTED,
    WIDTH,
    box_of,
    command,
    drag,
    enter,
    handle_at,
    open_page,
    placing,
    press,
    save,
    serve,
    settle,
)
from warpir.core.errors import ExitCode
from warpir.io.assets import load_asset
from warpir.place.stance import stance_of
from warpir.scene.camera import Camera, camera_from_fov, ground_point
from warpir.scene.placement import place_asset

pytestmark = [needs_chromium, pytest.mark.slow]


def drag_away_and_back(opened: Opened, selector: str) -> None:
    """Drag the thumb of a slider and let it go where it was: it tells of no change then."""
    slider = opened.page.locator(selector)
    slider.scroll_into_view_if_needed()
    slider.evaluate("it => { it.told = []; it.onchange = it.oninput = e => it.told.push(e.type); }")
    box = slider.bounding_box()
    assert box is not None
    share = float(slider.input_value()) / 1000.0
    thumb = 16.0
    x = box["x"] + thumb / 2.0 + share * (box["width"] - thumb)
    y = box["y"] + box["height"] / 2.0
    mouse = opened.page.mouse
    mouse.move(x, y)
    mouse.down()
    mouse.move(x + 20.0, y)
    mouse.move(x, y)
    mouse.up()
    settle(opened)
    told = slider.evaluate("it => it.told")
    assert "input" in told and "change" not in told, told


SILHOUETTE = """async ([width, height]) => {
  const { stage } = await import('./page.js');
  const THREE = await import('three');
  const target = new THREE.WebGLRenderTarget(width, height);
  const [ground, grid] = [stage.ground.visible, stage.grid.visible];
  stage.ground.visible = stage.grid.visible = false;
  stage.scene.overrideMaterial = new THREE.MeshBasicMaterial({ side: THREE.DoubleSide });
  stage.renderer.setRenderTarget(target);
  stage.renderer.setClearColor(0, 0);
  stage.renderer.clear();
  stage.renderer.render(stage.scene, stage.camera);
  const pixels = new Uint8Array(width * height * 4);
  stage.renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
  stage.renderer.setRenderTarget(null);
  stage.scene.overrideMaterial = null;
  [stage.ground.visible, stage.grid.visible] = [ground, grid];
  return Array.from({ length: width * height }, (_, k) => (pixels[4 * k + 3] ? '1' : '0')).join('');
}"""
"""The object alone, as the page's own camera sees it, at the photo's resolution."""


def silhouette(opened: Opened) -> NDArray[np.bool_]:
    """Where the page shows the object, shape [H, W]."""
    digits = opened.page.evaluate(SILHOUETTE, [WIDTH, HEIGHT])
    # Row 0 of what WebGL reads is the lowest.
    shown: NDArray[np.bool_] = np.frombuffer(digits.encode(), np.uint8) == ord("1")
    return shown.reshape(HEIGHT, WIDTH)[::-1]


def extent(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """First and last column and row of a mask."""
    rows, columns = np.nonzero(mask)
    return np.array([columns.min(), columns.max(), rows.min(), rows.max()])


def render(config: Path, out: Path) -> NDArray[np.bool_]:
    """Insert as the saved file says; return where the object covers half of a pixel."""
    from warpir.insert import main

    cheap = ["--samples", "4", "--depth", "1", "--device", "cpu", "--no-hand-off", "--no-detail"]
    assert main(["--config", str(config), "--out", str(out), *cheap]) == ExitCode.DONE
    matte: NDArray[np.bool_] = read_layers(out / "layers.exr")["matte.A"] > 0.5
    return matte


def test_page_places_what_insert_renders(inputs: Path, tmp_path: Path) -> None:
    """Drag, turn, scale, tilt and save: warpir's mask is the page's silhouette, at two placements.

    Every edge of the silhouette agrees within a pixel, with the camera rolled and pitched.
    """
    out = tmp_path / "it's <i>"
    argv = command(inputs, out, "--fov", "55", "--pitch", "-14", "--size", "1.1")
    with serve(argv) as served, open_browser(1000, 620) as opened:
        open_page(opened, served)
        start = opened.page.evaluate(STATE)
        drag(opened, "foot", (-90.0, 10.0))
        drag(opened, "pitch", (0.0, -40.0))
        drag(opened, "roll", (0.0, 35.0))
        drag(opened, "turn", (70.0, -10.0))
        drag(opened, "size", (0.0, -25.0))
        first = opened.page.evaluate(STATE)
        assert first["stance"]["roll"] > 1.0 and first["stance"]["pitch"] < start["stance"]["pitch"]
        assert first["size"] > start["size"] and abs(first["turn"] - start["turn"]) > 5.0
        masks = []
        for name in ("first", "second"):
            if name == "second":
                drag(opened, "fov", (60.0, 0.0))
                drag(opened, "foot", (140.0, -40.0))
                opened.page.locator("#stage").focus()
                for key in ("q", "q", "ArrowLeft", "Shift+ArrowUp", "+"):
                    opened.page.keyboard.press(key)
                settle(opened)
            save(opened)
            shown = opened.page.inner_text("#command")
            assert shown.startswith("python -m warpir.insert --config ")
            masks.append((silhouette(opened), (out / "insert.json").read_bytes()))
            (tmp_path / f"{name}.json").write_bytes(masks[-1][1])
            camera = tmp_path / f"{name}-camera.json"
            camera.write_bytes((out / "camera.json").read_bytes())
            placed = json.loads(masks[-1][1])
            placed["camera"] = str(camera)
            (tmp_path / f"{name}.json").write_text(json.dumps(placed))
        assert opened.errors == []
        assert {address.startswith(served.address) for address in opened.requests} == {True}
    for name, (mask, content) in zip(("first", "second"), masks, strict=True):
        assert json.loads(content)["out"] == str(out / "result")
        rendered = render(tmp_path / f"{name}.json", tmp_path / f"result-{name}")
        assert np.abs(extent(mask) - extent(rendered)).max() <= 1
        centroids = [np.argwhere(m).mean(axis=0) for m in (mask, rendered)]
        assert np.abs(centroids[0] - centroids[1]).max() < 0.5
        # Edges alone may differ, where a pixel is half covered.
        assert mask.sum() > 2000
        assert (mask ^ rendered).sum() < 0.03 * mask.sum()
    assert (masks[0][0] ^ masks[1][0]).sum() > 1000


def test_page_counts_as_the_camera_does(inputs: Path, tmp_path: Path) -> None:
    """The page's projection, ground points and horizon are warpir's, by closed form."""
    camera = Camera(WIDTH, HEIGHT, 510.0, 470.0, 251.0, 143.0, TILTED.c2w())
    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    with serve(command(inputs, tmp_path / "out")) as served, open_browser() as opened:
        opened.page.goto(served.address)

        def call(name: str, *given: Any) -> Any:
            code = f"(given) => import('./camera.js').then((m) => m.{name}(...given))"
            return opened.page.evaluate(code, list(given))

        points = np.array([[1.0, 0.5, -6.0], [-2.0, 0.0, -4.0], [0.3, 1.2, -20.0]])
        for point, pixel in zip(points, camera.project(points), strict=True):
            found = call("project", numbers, TILTED.record(), point.tolist())
            np.testing.assert_allclose(found, pixel, atol=1e-6)
        assert call("project", numbers, TILTED.record(), [0.0, 0.0, 50.0]) is None
        for u, v in ((10.0, 300.0), (251.0, 143.0), (470.0, 200.0)):
            x, y, z = ground_point(camera, u, v)
            assert y == pytest.approx(0.0, abs=EXACT)
            found = call("groundPoint", numbers, TILTED.record(), u, v)
            np.testing.assert_allclose(found, [x, z], rtol=1e-9)
        assert call("groundPoint", numbers, TILTED.record(), 240.0, 0.0) is None
        # On the horizon rays are level, and its two ends give pitch and roll back.
        ends = [[u, call("horizonRow", numbers, TILTED.record(), u)] for u in (0.0, 480.0)]
        for u, v in ends:
            assert camera.ray(u, v)[1][1] == pytest.approx(0.0, abs=EXACT)
        level = {**TILTED.record(), "pitch": 0.0, "roll": 0.0}
        found = call("levelled", numbers, level, *ends)
        assert found == pytest.approx(TILTED.record(), abs=EXACT)
        # Nor is a camera turned over that stands on its head, or steeper than the page makes it.
        for pitch, roll in ((-11.0, 6.0), (20.0, 100.0), (-30.0, -95.0), (8.0, 175.0)):
            over = {**TILTED.record(), "pitch": pitch, "roll": roll}
            ends_over = [[u, call("horizonRow", numbers, over, u)] for u in (0.0, 480.0)]
            for given in (ends_over, ends_over[::-1]):
                found = call("levelled", numbers, over, *given)
                assert found == pytest.approx(over, abs=1e-6)
            for changed, rows in (
                (call("zoomed", numbers, over, 800.0), 0.0),
                ({"camera": numbers, "stance": call("lowered", numbers, over, 25.0)}, 25.0),
            ):
                assert changed["stance"]["roll"] == roll
                for u, v in ends_over:
                    row = call("horizonRow", changed["camera"], changed["stance"], u)
                    assert row == pytest.approx(v + rows, abs=1e-6)
            # Far level points are seen on it, those of the ground on its same side as before.
            far = [call("project", numbers, over, [x, 1.7, -1e9]) for x in (-1e8, -4e8)]
            found = [call("horizonRow", numbers, over, u) for u, _ in far]
            assert found == pytest.approx([v for _, v in far], abs=1e-3)
        down = {**TILTED.record(), "pitch": -90.0, "roll": 0.0}
        assert call("zoomed", numbers, down, 800.0)["stance"]["pitch"] == pytest.approx(-90.0)
        # As --horizon has it: a row of the middle column, of a camera without roll.
        flat = camera_from_fov(WIDTH, HEIGHT, 60.0, 0.0, 1.5, horizon=100.0)
        plain = {name: getattr(flat, name) for name in numbers}
        row = call("horizonRow", plain, stance_of(flat.c2w).record(), WIDTH / 2.0)
        assert row == pytest.approx(100.0, abs=EXACT)
        # Another field of view leaves the horizon where it was.
        changed = call("zoomed", numbers, TILTED.record(), 800.0)
        again = [call("horizonRow", changed["camera"], changed["stance"], u) for u in (0.0, 480.0)]
        np.testing.assert_allclose(again, [v for _, v in ends], atol=1e-6)
        asset = load_asset(inputs / "wedge.glb")
        low, high = asset.bounds()
        wanted = place_asset(low, high, camera, place=(0.5, 0.0, -6.0), rotate_y=35.0, size=1.7)
        box = {"low": low.tolist(), "high": high.tolist()}
        matrix = call("placed", box, {"x": 0.5, "z": -6.0}, 35.0, 1.7)
        found = np.reshape(matrix, (4, 4)).T
        np.testing.assert_allclose(found, wanted.asset_to_world, atol=1e-9)


def check_arrows(opened: Opened) -> None:
    """On a knob each arrow changes what the knob is for, right as up and left as down."""
    page = opened.page
    held = page.evaluate(STATE)
    for knob, group, name, sign in (
        ("pitch", "stance", "pitch", -1.0),
        ("roll", "stance", "roll", 1.0),
        ("tilt", "stance", "roll", -1.0),
    ):
        page.locator(f"[data-handle={knob}]").focus()
        for keys, way in ((("ArrowUp", "ArrowRight"), 1.0), (("ArrowDown", "ArrowLeft"), -1.0)):
            for key in keys:
                press(opened, key)
                moved = page.evaluate(STATE)[group][name] - held[group][name]
                assert moved * sign * way > 0.1, (knob, key)
                press(opened, "Control+z")
                assert page.evaluate(STATE) == held


def check_behind(opened: Opened) -> None:
    """A box that reaches behind the camera is nowhere under the pointer, and no fault."""
    page = opened.page
    enter(opened, "ahead", "0.5")
    box = box_of(opened, "#canvas")
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.8 * box["height"])
    settle(opened)
    assert opened.errors == []
    press(opened, "Control+z")


def test_page_keeps_what_was_given(inputs: Path, tmp_path: Path) -> None:
    """A camera that looks straight down, and a sun under a black sky, come out as they went in."""
    out = tmp_path / "out"
    steep = ["--pitch", "-90", "--camera-height", "6"]
    argv = command(inputs, out, *steep, "--sun=-60,45,3", "--sky", "0,0,0")
    with placing(argv, 700, 500) as opened:
        start = opened.page.evaluate(STATE)
        assert start["stance"]["pitch"] == pytest.approx(-90.0)
        opened.page.locator("#stage").focus()
        press(opened, "q")
        changed = opened.page.evaluate(STATE)
        assert changed["stance"] == start["stance"] and changed["turn"] != start["turn"]
        light = "import('./page.js').then(({ stage: { sun, scene, groundUniforms } }) =>"
        light += " [sun.intensity, ...sun.color, scene.environmentIntensity,"
        light += " groundUniforms.sunShare.value])"
        assert np.isfinite(np.array(opened.page.evaluate(light), dtype=float)).all()
        save(opened)
    saved = json.loads((out / "insert.json").read_text())
    assert saved["sun"] == pytest.approx([-60.0, 45.0, 3.0]) and saved["sky"] == [0.0, 0.0, 0.0]
    pose = np.array(json.loads((out / "camera.json").read_text())["c2w"])
    np.testing.assert_allclose(pose[:3, 2], [0.0, 1.0, 0.0], atol=EXACT)


def test_redraw_leaves_what_is_being_typed(inputs: Path, tmp_path: Path) -> None:
    """An estimate that arrives, or any other redraw, does not take a number back."""
    with placing(command(inputs, tmp_path / "out"), 1000, 700) as opened:
        page = opened.page
        for name, typed in (("size", "1.25"), ("metres", "0.75")):
            if name == "metres":
                page.click("#ruler")
            page.fill(f"#{name}", typed)
            page.evaluate("document.getElementById('keep-light').click()")  # takes no focus
            settle(opened)
            assert page.input_value(f"#{name}") == typed
            press(opened, "Enter")
        state = page.evaluate(STATE)
        assert state["size"] == 1.25 and state["ruler"]["metres"] == 0.75


def test_what_is_typed_counts_before_what_follows(inputs: Path, tmp_path: Path) -> None:
    """A drag, Save and undo by keys take a number whose field was not left."""
    out = tmp_path / "out"
    with placing(command(inputs, out, "--size", "2"), 1000, 700) as opened:
        page = opened.page
        page.fill("#size", "1.25")
        drag(opened, "turn", (30.0, 5.0))
        dragged = page.evaluate(STATE)
        assert dragged["size"] == 1.25 and dragged["turn"] != 0.0
        page.fill("#size", "1.5")
        press(opened, "Control+s")
        page.wait_for_selector("#done:not([hidden])")
        assert json.loads((out / "insert.json").read_text())["size"] == 1.5
        page.fill("#height", "7")
        press(opened, "Control+z")
        assert page.evaluate(STATE)["stance"] == dragged["stance"]
        assert page.input_value("#height") != "7"
        press(opened, "Control+z", "Control+z", "Control+z")
        assert page.evaluate(STATE)["size"] == 2.0


NO_WEBGL = """const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
  return kind.startsWith("webgl") ? null : get.call(this, kind, ...more);
};"""
NO_STORAGE = """function refuse() { throw new DOMException("refused", "SecurityError"); }
Object.defineProperty(window, "sessionStorage", { get: refuse });
window.BroadcastChannel = refuse;"""


def test_page_tells_how_far_the_view_across_may_be_off(inputs: Path, tmp_path: Path) -> None:
    """The field counts the view across; an estimate is of the vertical one."""
    with serve(command(inputs, tmp_path / "out")) as served, open_browser() as opened:

        def estimate(route: Route) -> None:
            start = route.fetch().json()
            start["camera_numbers"]["vfov_deg"].update(sigma=10.0, source="estimate")
            route.fulfill(json=start)

        opened.page.route("**/start.json", estimate)
        open_page(opened, served)
        said = opened.page.inner_text("#camera-words")
        camera = opened.page.evaluate(STATE)["camera"]
        moved = [camera["height"] / 2.0 / camera["fy"] * side for side in (0.999, 1.001)]
        vertical, across = (
            np.diff(2.0 * np.arctan(np.array(moved) * aspect))[0]
            for aspect in (1.0, WIDTH / HEIGHT)
        )
        assert said == f"Estimated from the photo: view ± {10.0 * across / vertical:.1f}°."


def test_page_that_is_loaded_again_goes_on(inputs: Path, tmp_path: Path) -> None:
    """Whatever was placed, lit and painted is there again; undo leads to the page's start."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640) as opened:
        page = opened.page
        begun = page.evaluate(STATE)
        enter(opened, "size", 1.25)
        stage = box_of(opened, "#stage")
        place = stage["x"] + 0.3 * stage["width"], stage["y"] + 0.2 * stage["height"]
        for tool in ("#add-lamp", "#paint"):
            page.click(tool)
            page.mouse.click(*place)
        settle(opened)
        placed = page.evaluate(STATE)
        assert len(placed["lamps"]) == len(placed["mask"]) == 1
        save(opened)  # or the browser asks first
        page.reload()
        page.wait_for_selector("#save:not([disabled])", timeout=60_000)
        settle(opened)
        assert page.evaluate(STATE) == placed
        page.click("#undo")
        settle(opened)
        assert page.evaluate(STATE) == begun


def test_second_tab_is_told_of_a_save(inputs: Path, tmp_path: Path) -> None:
    """Both save into one file: its placement was replaced without a word."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640) as opened:
        with opened.page.expect_popup() as popup:
            opened.page.evaluate("void window.open(location.href)")
        other = Opened(popup.value)
        other.page.wait_for_selector("#save:not([disabled])", timeout=60_000)
        for saving, told in ((other, opened), (opened, other)):
            saving.page.bring_to_front()
            save(saving)
            assert saving.page.locator("#problem").is_hidden()
            told.page.bring_to_front()
            told.page.wait_for_selector("text=Another tab has saved")
            told.page.wait_for_selector("#done", state="hidden")


def test_page_does_without_storage(inputs: Path, tmp_path: Path) -> None:
    """A browser that refuses it refuses channels between tabs too: the page stayed empty."""
    with serve(command(inputs, tmp_path / "out")) as served, open_browser() as opened:
        opened.page.add_init_script(NO_STORAGE)
        opened.page.goto(served.address)
        opened.page.wait_for_selector("#save:not([disabled])", timeout=60_000)
        save(opened)


def test_page_tells_of_a_browser_that_cannot_draw(inputs: Path, tmp_path: Path) -> None:
    with serve(command(inputs, tmp_path / "out")) as served, open_browser() as opened:
        opened.page.add_init_script(NO_WEBGL)
        opened.page.goto(served.address)
        opened.page.wait_for_function(
            "document.getElementById('loading').textContent.includes('cannot draw')"
        )
        assert "graphics acceleration" in opened.page.inner_text("#loading")


def test_page_serves_small_windows_and_fingers(inputs: Path, tmp_path: Path) -> None:
    """Save and the last field can be reached, and a second finger does not break a drag."""
    with placing(command(inputs, tmp_path / "out"), 640, 360) as opened:
        page = opened.page
        # The words of the estimate move what is below them when they come.
        page.wait_for_selector("#light[data-source]:not([data-source=pending])", timeout=60_000)
        for width, height in ((640, 360), (568, 320), (320, 256), (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            settle(opened)
            for name in ("#skyStrength", "#save"):
                # To the middle: at an edge, the browser rounds and may hide half a pixel.
                page.locator(name).evaluate("e => e.scrollIntoView({ block: 'center' })")
                box = box_of(opened, name)
                assert 0 <= box["x"] <= box["x"] + box["width"] <= width, (name, width, height)
                assert 0 <= box["y"] <= box["y"] + box["height"] <= height, (name, width, height)
            page.click("#save", timeout=5000)
            page.wait_for_selector("#done:not([hidden])")
            photo = page.locator("#photo").bounding_box()
            assert photo is not None and photo["width"] >= 60
        before = page.evaluate(STATE)
        fingers = Fingers(page)
        (x, y), (u, v) = handle_at(opened, "size"), handle_at(opened, "roll")
        fingers.press(0, x, y)
        fingers.move(0, x, y - 10.0)
        fingers.press(1, u, v)
        fingers.move(1, u, v + 30.0)
        fingers.lift(1)
        fingers.move(0, x, y - 20.0)
        fingers.lift(0)
        settle(opened)
        after = page.evaluate(STATE)
        assert after["stance"] == before["stance"] and after["size"] > 1.1 * before["size"]
        page.locator("#dial").click(position={"x": 60.0, "y": 40.0}, button="right")
        settle(opened)
        assert page.evaluate(STATE)["light"] == before["light"]
        press(opened, "Control+z")
        assert page.evaluate(STATE) == before
        # Of something flat and far away the knobs are apart, however it is turned.
        for field, value in (("size", "0.05"), ("ahead", "12")):
            enter(opened, field, value)
        for turn in (0, 70, 180, -90):
            enter(opened, "turn", str(turn))
            knobs = [np.array(handle_at(opened, name)) for name in ("size", "foot", "turn")]
            apart = [np.linalg.norm(a - b) for a, b in combinations(knobs, 2)]
            assert min(apart) > 25.5, (turn, apart)


def test_page_undoes_and_tells_what_is_wrong(inputs: Path, tmp_path: Path) -> None:
    """Undo and redo, fields, double click; a file that came meanwhile is not replaced; --once."""
    out = tmp_path / "out"
    argv = command(inputs, out, "--once", asset="wedge's <b>.stl")
    with serve(argv) as served, open_browser(390, 800) as opened:
        open_page(opened, served)
        page = opened.page
        assert page.inner_text("#title") == "wedge's <b>.stl in photo.png"
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        before = page.evaluate(STATE)
        page.fill("#size", "1.25")
        page.keyboard.press("Enter")
        page.locator("#stage").focus()
        press(opened, "e")
        changed = page.evaluate(STATE)
        assert changed["size"] == 1.25 and changed["turn"] == pytest.approx(before["turn"] - 5.0)
        press(opened, "Control+z", "Control+z")
        assert page.evaluate(STATE) == before
        press(opened, "Control+Shift+z")
        assert page.evaluate(STATE)["size"] == 1.25
        check_arrows(opened)
        check_behind(opened)
        drag_away_and_back(opened, "#turn-slide")
        page.locator("#stage").focus()
        held = page.evaluate(STATE)
        press(opened, "q")
        assert page.evaluate(STATE)["turn"] == pytest.approx(held["turn"] + 5.0)
        press(opened, "Control+z")
        assert page.evaluate(STATE) == held
        box = box_of(opened, "#canvas")
        page.mouse.dblclick(box["x"] + 100.0, box["y"] + 0.9 * box["height"])
        settle(opened)
        foot = page.evaluate(FOOT_ON_CANVAS)
        assert foot == pytest.approx((box["x"] + 100.0, box["y"] + 0.9 * box["height"]), abs=1.0)
        assert not page.is_checked("#keep-light")  # the page's own light is but a guess
        page.locator("#dial").click(position={"x": 60.0, "y": 40.0})
        settle(opened)
        assert page.is_checked("#keep-light")
        page.uncheck("#keep-light")
        out.mkdir()
        (out / "camera.json").write_text("somebody's")
        page.click("#save")
        page.wait_for_selector("#problem:not([hidden])")
        assert "exists already" in page.inner_text("#problem")
        assert [p.name for p in out.iterdir()] == ["camera.json"]
        assert (out / "camera.json").read_text() == "somebody's"
        assert [e for e in opened.errors if "422" not in e] == []
        (out / "camera.json").unlink()
        save(opened)
        saved = json.loads((out / "insert.json").read_text())
        assert saved["size"] == 1.25 and "sun" not in saved and "sky" not in saved
        said, _ = served.process.communicate(timeout=20)
        assert served.process.returncode == 0
        assert page.inner_text("#command") in said.splitlines()
        page.evaluate("window.onbeforeunload = null")
