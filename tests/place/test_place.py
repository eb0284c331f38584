"""Placing in the browser: the page shows what warpir renders, and saves what warpir takes."""

import base64
import json
import signal
import stat
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from tests.builders.insertions import read_layers
from tests.builders.programs.browser import Fingers, Opened, needs_chromium, open_browser
from tests.builders.programs.children import output_of
from tests.builders.programs.placing import (
    FOOT_ON_CANVAS,
    HEIGHT,
    STATE,
    WIDTH,
    Served,
    command,
    drag,
    handle_at,
    open_page,
    serve,
    settle,
)
from warpir.app.config import InsertConfig
from warpir.core.errors import ExitCode, InputError
from warpir.io.assets import load_asset
from warpir.place.preview_asset import preview_asset, triangle_count
from warpir.place.session import (
    PlacementFolder,
    Session,
    open_session,
    placement_files,
    start_record,
)
from warpir.place.stance import Stance, ground_to_world, stance_of
from warpir.scene.camera import Camera, CameraEstimate, camera_from_fov, ground_point
from warpir.scene.placement import place_asset

EXACT = 1e-9
"""Float64 on both sides, a few dozen operations on numbers up to 1000."""
TILTED = Stance(0.4, 1.7, -0.3, 25.0, -11.0, 6.0)
"""A camera that is level in nothing."""

# What is sent for a placement, from what the page starts with.
SAID = {"sun": [-40, 50, 8], "sky": "clear"}


def session_of(config: InsertConfig) -> Session:
    """A session of this configuration."""
    return open_session(config.inputs, config.camera, config.placement, config.limits)


# --------------------------------------------------------------------------- numbers of a camera


@pytest.mark.parametrize(
    "stance",
    [
        Stance(0, 1.6, 0, 0, 0, 0),
        TILTED,
        Stance(1, 2, 3, -170, 80, -40),
        Stance(0, 9, 0, 30, -90, 0),
    ],
)
def test_stance_is_the_pose(stance: Stance) -> None:
    """The numbers of a pose give the pose back."""
    again = stance_of(stance.c2w())
    np.testing.assert_allclose(again.c2w(), stance.c2w(), atol=EXACT)


def test_stance_of_a_level_camera() -> None:
    """Pitch and height are those of --pitch and --camera-height, with no roll and no heading."""
    camera = camera_from_fov(WIDTH, HEIGHT, 60.0, -12.0, 1.4)
    np.testing.assert_allclose(camera.c2w, Stance(0, 1.4, 0, 0, -12.0, 0).c2w(), atol=EXACT)


def test_ground_frame_holds_the_plane() -> None:
    """Points of the frame's y = 0 lie on the plane, and its +Y is the plane's normal."""
    normal = np.array([0.1, 0.95, -0.2]) / np.linalg.norm([0.1, 0.95, -0.2])
    plane = np.append(normal, 0.7)
    pose = ground_to_world(plane)
    for point in ((0, 0, 0, 1), (2, 0, -5, 1)):
        assert plane @ (pose @ point) == pytest.approx(0.0, abs=EXACT)
    np.testing.assert_allclose(pose[:3, 1], normal, atol=EXACT)


def test_placement_in_the_world_of_the_camera_file(inputs: Path, tmp_path: Path) -> None:
    """What is saved unchanged is the placement that was given, on a tilted ground and camera."""
    ground = (0.1, 0.95, -0.2, 0.7)
    pose = (
        ground_to_world(np.array([0.1, 0.95, -0.2, 0.7]) / np.linalg.norm(ground[:3]))
        @ TILTED.c2w()
    )
    camera = Camera(WIDTH, HEIGHT, 500.0, 480.0, 250.0, 150.0, pose)
    (tmp_path / "camera.json").write_text(json.dumps(camera.record()))
    config = InsertConfig(
        photo=str(inputs / "photo.png"),
        asset=str(inputs / "wedge.glb"),
        out=str(tmp_path / "out"),
        camera=str(tmp_path / "camera.json"),
        ground=ground,
        at=(220.0, 260.0),
        rotate_y=70.0,
        size=1.5,
    )
    session = session_of(config)
    start = start_record(session, config.light, str(config.output.out))
    said = {**start["camera"], **{k: start[k] for k in ("stance", "stand", "rotate_y", "size")}}
    files = placement_files(session, config.flat(), said)
    np.testing.assert_allclose(files["camera.json"]["c2w"], pose, atol=EXACT)
    saved = files["insert.json"]
    low, high = session.asset.bounds()
    named = {name: saved[name] for name in ("place", "rotate_y", "size")}
    again = place_asset(low, high, camera, saved["ground"], **named)
    np.testing.assert_allclose(again.asset_to_world, session.asset_to_world, atol=EXACT)
    assert "sun" not in saved and "sky" not in saved


def test_start_shows_what_insert_would_refuse(inputs: Path, tmp_path: Path) -> None:
    """An asset in millimetres, in which the camera would stand, starts small and in view."""
    huge = trimesh.creation.box(extents=(900.0, 700.0, 2000.0))
    huge.export(tmp_path / "huge.stl")
    photo, asset = str(inputs / "photo.png"), str(tmp_path / "huge.stl")
    for pitch in (0.0, 30.0, -60.0, -90.0):
        config = InsertConfig(photo=photo, asset=asset, out=str(tmp_path / "o"), pitch=pitch)
        session = session_of(config)
        start = start_record(session, config.light, str(config.output.out))
        said = {**start["camera"], **{k: start[k] for k in ("stance", "stand", "rotate_y", "size")}}
        assert 0.01 < start["size"] < 20.0
        if pitch < 30.0:
            assert placement_files(session, config.flat(), said)
    with pytest.raises(InputError, match="camera is inside"):
        session_of(config.changed(pitch=0.0, place=(0.0, 0.0, -5.0)))


# ---------------------------------------------------------------------------- what the page gets


def test_preview_asset_keeps_what_is_small(inputs: Path) -> None:
    """Nothing is thinned where there is no need."""
    asset = load_asset(inputs / "wedge.glb")
    assert preview_asset(asset).primitives == asset.primitives


def test_preview_asset_thins_a_heavy_one(tmp_path: Path) -> None:
    """A sphere of 82 k triangles becomes one of less than 5 k that lies on it everywhere."""
    trimesh.creation.icosphere(subdivisions=6).export(tmp_path / "ball.ply")
    asset = load_asset(tmp_path / "ball.ply")
    thin = preview_asset(asset, 5000)
    assert 500 < triangle_count(thin) <= 5000
    (part,) = thin.primitives
    corners = part.positions[part.indices]
    assert np.abs(np.linalg.norm(corners, axis=2) - 1.0).max() < 1e-6
    # Nothing is missing: the triangles cover the sphere but for what flat ones cut off.
    a, b, c = np.moveaxis(corners, 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    assert area == pytest.approx(4.0 * np.pi, rel=0.03)


# ---------------------------------------------------------------------------------------- saving


def placed_files(inputs: Path, out: Path) -> dict[str, dict[str, Any]]:
    """The files of a placement that is as it started."""
    config = InsertConfig(
        photo=str(inputs / "photo.png"), asset=str(inputs / "wedge.glb"), out=str(out)
    )
    session = session_of(config)
    start = start_record(session, config.light, str(config.output.out))
    said = {**start["camera"], **{k: start[k] for k in ("stance", "stand", "rotate_y", "size")}}
    return placement_files(session, config.flat(), {**said, **SAID})


def test_page_starts_with_the_estimated_camera(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its numbers, and that they are estimates; a camera that sees no ground gives way."""
    found = CameraEstimate(
        pitch_deg=-8.0,
        roll_deg=3.0,
        vfov_deg=40.0,
        principal=(0.5, 0.5),
        pitch_sigma_deg=2.0,
        roll_sigma_deg=2.0,
        vfov_sigma_deg=2.0,
        principal_sigma=(0.1, 0.1),
        witnesses=("network",),
    )
    photo, asset = str(inputs / "photo.png"), str(inputs / "wedge.glb")
    config = InsertConfig(photo=photo, asset=asset, out=str(tmp_path / "o"))
    monkeypatch.setattr("warpir.place.session.estimate_photo", lambda *_: found)
    start = start_record(session_of(config), config.light, "o")
    assert start["stance"]["pitch"] == pytest.approx(-8.0)
    assert start["stance"]["roll"] == pytest.approx(3.0)
    assert start["camera"]["fy"] == pytest.approx(HEIGHT / 2.0 / np.tan(np.radians(20.0)))
    assert any("estimated from the photo" in line for line in start["assumed"])
    up = replace(found, pitch_deg=60.0)
    monkeypatch.setattr("warpir.place.session.estimate_photo", lambda *_: up)
    start = start_record(session_of(config), config.light, "o")
    assert start["stance"]["pitch"] == pytest.approx(0.0)
    assert any("assumed, not estimated" in line for line in start["assumed"])


def test_folder_replaces_its_own_only(inputs: Path, tmp_path: Path) -> None:
    """A second save of a session replaces the first; what others changed or wrote stays."""
    files = placed_files(inputs, tmp_path / "out")
    folder = PlacementFolder(str(tmp_path / "out"), overwrite=False)
    path = folder.write(files)
    assert folder.write(files) == path
    with pytest.raises(InputError, match="exists already") as error:
        PlacementFolder(str(tmp_path / "out"), overwrite=False).write(files)
    assert error.value.code == ExitCode.OUTPUT
    path.write_text("mine")
    with pytest.raises(InputError, match="exists already"):
        folder.write(files)
    assert path.read_text() == "mine"
    assert PlacementFolder(str(tmp_path / "out"), overwrite=True).write(files) == path
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["camera.json", "insert.json"]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"size": 0}, "--size"),
        ({"size": "large"}, "--size"),
        ({"fx": -3.0}, "focal length"),
        ({"fx": None}, "/fx"),
        ({"stance": 5}, "/x"),
        ({"stand": {"x": 0, "z": 50}}, "behind the camera"),
        ({"stand": [0, 1]}, "/x"),
        ({"sun": [1, 2, 3, 4]}, "--sun"),
        ({"sky": "green"}, "--sky"),
    ],
)
def test_placement_refuses_wrong_numbers(
    inputs: Path, tmp_path: Path, change: dict[str, Any], words: str
) -> None:
    """What insert would refuse is refused when it is saved, and told."""
    config = InsertConfig(
        photo=str(inputs / "photo.png"), asset=str(inputs / "wedge.glb"), out=str(tmp_path / "o")
    )
    session = session_of(config)
    start = start_record(session, config.light, str(config.output.out))
    said = {**start["camera"], **{k: start[k] for k in ("stance", "stand", "rotate_y", "size")}}
    with pytest.raises(InputError) as error:
        placement_files(session, config.flat(), {**said, **SAID, **change})
    assert words in str(error.value)


# ----------------------------------------------------------------------------------- the command


@pytest.mark.parametrize(
    ("argv", "status", "words"),
    [
        (["--asset", "a.glb"], 2, "--photo"),
        (["--photo", "none.jpg", "--asset", "wedge.glb"], 3, "none.jpg"),
        (["--photo", "photo.png", "--asset", "photo.png"], 3, "not a mesh"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--at", "5,1"], 3, "--at"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--port", "x"], 2, "--port"),
        (["--photo", "a.png", "--asset", "a.glb", "--port", "9" * 5000], 2, "--port"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--sky", "green"], 2, "--sky"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--light", "a.hdr"], 2, "no such flag"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--out", "photo.png"], 7, "not a folder"),
        (["--photo", "photo.png", "--asset", "wedge.glb", "--out", "held"], 7, "--overwrite"),
    ],
)
def test_place_refuses_before_it_serves(
    inputs: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    argv: list[str],
    status: int,
    words: str,
) -> None:
    """Bad input is one error line and its exit code; no socket is opened, as none can be here."""
    from warpir.place.command import main

    monkeypatch.chdir(inputs)
    (inputs / "held").mkdir(exist_ok=True)
    (inputs / "held" / "insert.json").write_text("{}")
    assert main([*argv, "--no-browser"]) == status
    shown = capsys.readouterr()
    errors = [line for line in shown.err.splitlines() if line.startswith("error:")]
    assert len(errors) == 1 and words in shown.err
    assert "page:" not in shown.out and "Traceback" not in shown.err


def ask(served: Served, *requests: tuple[str, str, str, str]) -> list[tuple[int, bytes]]:
    """Ask in a child process, as this one has no network; paths go out as they are.

    Args:
        served: Whom.
        requests: Method, path, host and body of each.
    """
    code = (
        "import base64, http.client\n"
        f"for method, path, host, body in {requests!r}:\n"
        f"    c = http.client.HTTPConnection('127.0.0.1', {served.parts[0]}, timeout=20)\n"
        "    c.putrequest(method, path, skip_host=True)\n"
        "    c.putheader('Host', host)\n"
        "    c.putheader('Content-Length', '9000000' if body == 'too long' else str(len(body)))\n"
        "    c.endheaders(body.encode())\n"
        "    r = c.getresponse()\n"
        "    print(r.status, base64.b64encode(r.read()).decode())"
    )
    answers = (line.partition(" ") for line in output_of(code).splitlines())
    return [(int(status), base64.b64decode(content)) for status, _, content in answers]


def test_server_answers_its_own_page_only(inputs: Path, tmp_path: Path) -> None:
    """Wrong token, wrong host, paths that lead out, unknown names get nothing; Ctrl-C ends it."""
    with serve(command(inputs, tmp_path / "out")) as served:
        port, token = served.parts
        host, page = f"127.0.0.1:{port}", f"/{token}/"
        foreign = ("/", f"/{token}", f"/{token[:-1]}/", "/x/page.js", f"/{token}x/page.js")
        unknown = ("../insert.py", "..%2finsert.py", "vendor/../../place.py", "/etc/passwd", "x")
        hosts = ("evil.example", f"localhost:{port}", f"evil.example:{port}", "127.0.0.1")
        wanted = [
            (200, ("GET", page, host, "")),
            *((403, ("GET", path, host, "")) for path in foreign),
            *((404, ("GET", page + name, host, "")) for name in unknown),
            *((403, ("GET", page, name, "")) for name in hosts),
            (403, ("POST", "/wrong/save", host, "{}")),
            (403, ("POST", f"{page}save", "evil.example", "{}")),
            (404, ("POST", f"{page}photo.jpg", host, "{}")),
            (413, ("POST", f"{page}save", host, "too long")),
            (422, ("POST", f"{page}save", host, "[")),
        ]
        answers = ask(served, *(request for _, request in wanted))
        for (status, request), (found, content) in zip(wanted, answers, strict=True):
            assert found == status, request[:3]
            assert status in (200, 422) or content == b"", request[:3]
        assert "JSON" in json.loads(answers[-1][1])["what"]
        assert not (tmp_path / "out").exists()
        served.process.send_signal(signal.SIGINT)
        shown, _ = served.process.communicate(timeout=20)
        assert served.process.returncode == 130
        assert "stopped by SIGINT" in shown and "Traceback" not in shown


def test_server_says_who_may_show_it(inputs: Path, tmp_path: Path) -> None:
    """Every answer forbids what the page does not need."""
    with serve(command(inputs, tmp_path / "out")) as served:
        port, token = served.parts
        code = (
            "import http.client\n"
            f"c = http.client.HTTPConnection('127.0.0.1', {port}, timeout=20)\n"
            f"c.request('GET', '/{token}/')\n"
            "print(dict(c.getresponse().getheaders()))"
        )
        headers = output_of(code)
        assert "default-src 'none'" in headers and "unsafe" not in headers
        assert "frame-ancestors 'none'" in headers and "'no-referrer'" in headers


def test_browser_is_not_started_with_the_token(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It gets a file that only this user can read, and that is gone when the server is."""
    browser, started = tmp_path / "browser", tmp_path / "started"
    browser.write_text(f'#!/bin/sh\necho "$@" > {started}.new\nmv {started}.new {started}\n')
    browser.chmod(0o700)
    monkeypatch.setenv("BROWSER", str(browser))
    monkeypatch.setenv("DISPLAY", ":none")
    argv = [word for word in command(inputs, tmp_path / "out") if word != "--no-browser"]
    with serve(argv) as served:
        until = time.monotonic() + 20.0
        while not started.exists() and time.monotonic() < until:
            time.sleep(0.05)
        given = started.read_text().strip()
        assert given.startswith("file:///") and served.parts[1] not in given
        way = Path(given.removeprefix("file://"))
        assert f'content="0; url={served.address}"' in way.read_text()
        assert stat.S_IMODE(way.stat().st_mode) == 0o600
        assert stat.S_IMODE(way.parent.stat().st_mode) == 0o700
    assert not way.parent.exists()


def test_address_leaves_out_the_port_of_http() -> None:
    """As browsers do, whose requests must name what the address has."""
    from warpir.place.server import PlaceServer

    server = object.__new__(PlaceServer)
    for port, host in ((80, "127.0.0.1"), (8080, "127.0.0.1:8080")):
        server.server_address = ("127.0.0.1", port)
        assert server.host == host


def test_demo_starts_where_the_user_says(tmp_path: Path) -> None:
    """A pixel, a turn and the folder replace the demo's own."""
    from warpir.place.command import _with_inputs

    config = _with_inputs(InsertConfig(demo=True, at=(600.0, 700.0), rotate_y=10.0, out="mine"))
    assert (config.placement.at, config.placement.place, config.placement.rotate_y) == (
        (600.0, 700.0),
        None,
        10.0,
    )
    assert config.output.out == "mine"


def test_place_loads_neither_torch_nor_warp() -> None:
    """The page starts at once."""
    code = (
        "import sys, warpir.place, warpir.place.session, warpir.place.server\n"
        "print([m for m in ('torch', 'warp', 'trimesh', 'scipy') if m in sys.modules])"
    )
    assert output_of(code) == "[]\n"


# --------------------------------------------------------------------------------- in the browser


def test_server_knows_every_file_of_the_page() -> None:
    """Nothing is in the folder that no address leads to, but for what is said of three.js."""
    from warpir.place.server import FILES, PAGE, VENDOR

    files = [(path, path.relative_to(PAGE)) for path in PAGE.rglob("*")]
    files += [(path, path.relative_to(VENDOR.parent)) for path in VENDOR.rglob("*")]
    there = {name.as_posix() for path, name in files if path.is_file()}
    assert there == set(FILES.values()) | {"vendor/LICENSE", "vendor/README.md"}


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


@needs_chromium
@pytest.mark.slow
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
            opened.page.click("#save")
            opened.page.wait_for_selector("#done:not([hidden])")
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


@needs_chromium
@pytest.mark.slow
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
                page.keyboard.press(key)
                settle(opened)
                moved = page.evaluate(STATE)[group][name] - held[group][name]
                assert moved * sign * way > 0.1, (knob, key)
                page.keyboard.press("Control+z")
                settle(opened)
                assert page.evaluate(STATE) == held


def check_behind(opened: Opened) -> None:
    """A box that reaches behind the camera is nowhere under the pointer, and no fault."""
    page = opened.page
    page.fill("#ahead", "0.5")
    page.keyboard.press("Enter")
    settle(opened)
    box = page.locator("#canvas").bounding_box()
    assert box is not None
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.8 * box["height"])
    settle(opened)
    assert opened.errors == []
    page.keyboard.press("Control+z")
    settle(opened)


@needs_chromium
@pytest.mark.slow
def test_page_keeps_what_was_given(inputs: Path, tmp_path: Path) -> None:
    """A camera that looks straight down, and a sun under a black sky, come out as they went in."""
    out = tmp_path / "out"
    steep = ["--pitch", "-90", "--camera-height", "6"]
    argv = command(inputs, out, *steep, "--sun=-60,45,3", "--sky", "0,0,0")
    with serve(argv) as served, open_browser(700, 500) as opened:
        open_page(opened, served)
        start = opened.page.evaluate(STATE)
        assert start["stance"]["pitch"] == pytest.approx(-90.0)
        opened.page.locator("#stage").focus()
        opened.page.keyboard.press("q")
        settle(opened)
        changed = opened.page.evaluate(STATE)
        assert changed["stance"] == start["stance"] and changed["turn"] != start["turn"]
        light = "import('./page.js').then(({ stage: { sun, scene, groundUniforms } }) =>"
        light += " [sun.intensity, ...sun.color, scene.environmentIntensity,"
        light += " groundUniforms.sunShare.value])"
        assert np.isfinite(np.array(opened.page.evaluate(light), dtype=float)).all()
        opened.page.click("#save")
        opened.page.wait_for_selector("#done:not([hidden])")
        assert opened.errors == []
    saved = json.loads((out / "insert.json").read_text())
    assert saved["sun"] == pytest.approx([-60.0, 45.0, 3.0]) and saved["sky"] == [0.0, 0.0, 0.0]
    pose = np.array(json.loads((out / "camera.json").read_text())["c2w"])
    np.testing.assert_allclose(pose[:3, 2], [0.0, 1.0, 0.0], atol=EXACT)


@needs_chromium
@pytest.mark.slow
def test_page_serves_small_windows_and_fingers(inputs: Path, tmp_path: Path) -> None:
    """Save and the last field can be reached, and a second finger does not break a drag."""
    with serve(command(inputs, tmp_path / "out")) as served, open_browser(640, 360) as opened:
        page = opened.page
        open_page(opened, served)
        for width, height in ((640, 360), (568, 320), (320, 256), (390, 844)):
            page.set_viewport_size({"width": width, "height": height})
            settle(opened)
            for name in ("#skyStrength", "#save"):
                page.locator(name).scroll_into_view_if_needed()
                box = page.locator(name).bounding_box()
                assert box is not None
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
        page.keyboard.press("Control+z")
        settle(opened)
        assert page.evaluate(STATE) == before
        # Of something flat and far away the knobs are apart, however it is turned.
        for field, value in (("size", "0.05"), ("ahead", "12")):
            page.fill(f"#{field}", value)
            page.keyboard.press("Enter")
            settle(opened)
        for turn in (0, 70, 180, -90):
            page.fill("#turn", str(turn))
            page.keyboard.press("Enter")
            settle(opened)
            knobs = [np.array(handle_at(opened, name)) for name in ("size", "foot", "turn")]
            apart = [np.linalg.norm(a - b) for a, b in combinations(knobs, 2)]
            assert min(apart) > 25.5, (turn, apart)
        assert opened.errors == []


@needs_chromium
@pytest.mark.slow
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
        page.keyboard.press("e")
        settle(opened)
        changed = page.evaluate(STATE)
        assert changed["size"] == 1.25 and changed["turn"] == pytest.approx(before["turn"] - 5.0)
        page.keyboard.press("Control+z")
        page.keyboard.press("Control+z")
        settle(opened)
        assert page.evaluate(STATE) == before
        page.keyboard.press("Control+Shift+z")
        settle(opened)
        assert page.evaluate(STATE)["size"] == 1.25
        check_arrows(opened)
        check_behind(opened)
        drag_away_and_back(opened, "#turn-slide")
        page.locator("#stage").focus()
        held = page.evaluate(STATE)
        page.keyboard.press("q")
        settle(opened)
        assert page.evaluate(STATE)["turn"] == pytest.approx(held["turn"] + 5.0)
        page.keyboard.press("Control+z")
        settle(opened)
        assert page.evaluate(STATE) == held
        box = page.locator("#canvas").bounding_box()
        assert box is not None
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
        page.click("#save")
        page.wait_for_selector("#done:not([hidden])")
        saved = json.loads((out / "insert.json").read_text())
        assert saved["size"] == 1.25 and "sun" not in saved and "sky" not in saved
        said, _ = served.process.communicate(timeout=20)
        assert served.process.returncode == 0
        assert page.inner_text("#command") in said.splitlines()
        page.evaluate("window.onbeforeunload = null")
