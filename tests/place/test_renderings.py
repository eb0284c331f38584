"""Pictures that warpir renders for the placing page."""

import json
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.builders.programs.browser import needs_chromium
from tests.builders.programs.placing import STATE, command, placing, press, save, settle
from warpir.core.errors import InputError
from warpir.place.renderings import Renderings, policy_of
from warpir.place.server import PlaceServer
from warpir.place.worker import PATIENCE, Worker


class Silent(Worker):
    """A worker that works until it is stopped."""

    def __init__(self) -> None:
        super().__init__()
        self.is_stopped = False

    def ask(self, job: Any, heard: Any = None) -> dict[str, Any]:
        """Wait for the end."""
        while not self.is_stopped and job["kind"] == "preview":
            time.sleep(0.01)
        raise InputError("the page", "stopped before it was done")

    def interrupt(self) -> None:
        """Let it go."""
        self.is_stopped = True


def test_one_picture_at_a_time_and_cancelled() -> None:
    """A second one is refused while the first is rendered; what is cancelled is no failure."""
    renderings = Renderings(Silent())
    files: dict[str, dict[str, Any]] = {"camera.json": {}, "insert.json": {}}
    try:
        assert renderings.preview(files)["state"] == "running"
        with pytest.raises(InputError, match="already"):
            renderings.preview(files)
        renderings.cancel()
        until = time.monotonic() + 10.0
        while renderings.progress()["state"] == "running" and time.monotonic() < until:
            time.sleep(0.01)
        assert renderings.progress()["state"] == "cancelled"
    finally:
        renderings.close()


def test_files_of_results_only(tmp_path: Path) -> None:
    """Of a result its record and the files named there can be read, and none before it is there."""
    renderings = Renderings(Silent())
    try:
        for name in ("a.png", "other.txt", "run.json"):
            (tmp_path / name).write_text(json.dumps({"files": ["a.png"]}))
        (tmp_path.parent / "secret").write_text("x")
        assert renderings.file("result/a.png") is None
        renderings._results = tmp_path
        assert renderings.file("result/a.png") is not None
        assert renderings.file("result/run.json") is not None  # the report links it
        for name in ("result/other.txt", "result/../secret", "result/", "a.png", "preview-1.png"):
            assert renderings.file(name) is None
    finally:
        renderings.close()


@pytest.mark.parametrize("kind", ["preview", "insert"])
def test_a_session_that_ends_waits_for_an_insertion_alone(kind: str) -> None:
    """Whose results stay; and for nothing where nothing was begun."""
    renderings, goes_on, is_done = Renderings(Silent()), threading.Event(), threading.Event()
    server = object.__new__(PlaceServer)
    server.shutdown = is_done.set  # type: ignore[method-assign]
    try:
        server.end(renderings.wait)
        assert is_done.is_set()
        is_done.clear()
        renderings._begin(kind, lambda: str(goes_on.wait(30.0)))
        ending = threading.Thread(target=server.end, args=(renderings.wait,))
        ending.start()
        assert is_done.wait(0.3) == (kind == "preview")
        goes_on.set()
        ending.join(30.0)
        assert is_done.is_set()
    finally:
        renderings.close()


def test_what_became_of_the_insertion_waited_for_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A page that asks now and then finds no server any more."""
    renderings = Renderings(Silent())

    def full() -> str:
        raise InputError("warpir.insert", "the disk is full")

    try:
        renderings.wait()
        assert capsys.readouterr().out == ""
        renderings._begin("insert", full)
        renderings.wait()
        said = "notice: the full render failed (warpir.insert: the disk is full)\n"
        assert capsys.readouterr().out == said
        renderings._results = tmp_path
        renderings._begin("insert", lambda: "result/report.html")
        renderings.wait()
        assert capsys.readouterr().out == f"inserted: {tmp_path}\n"
    finally:
        renderings.close()


def test_policy_of_a_page_is_its_own() -> None:
    """A report's policy names its own script; other files have none."""
    page = b'<meta http-equiv="Content-Security-Policy" content="default-src &#39;none&#39;">'
    assert policy_of(page) == "default-src 'none'"
    assert policy_of(b"\x89PNG") is None


@needs_chromium
@pytest.mark.slow
def test_page_renders_what_insert_does(inputs: Path, tmp_path: Path) -> None:
    """The preview is the composite of the saved placement; it can be cancelled, and grows stale.

    Beside a full insertion it has fewer samples and a coarser map of reflections, so that noise of
    some codes stays; object and shadow are where they are there.
    """
    out = tmp_path / "out"
    argv = command(inputs, out, "--size", "2", "--sun=-60,45,3", "--sky", "clear")
    with placing(argv, 1000, 640) as opened:
        page = opened.page
        # A preview may be done before a pointer has come to the button, so the page itself clicks.
        page.evaluate("""async () => {
          const [preview, cancel] = ['preview', 'cancel'].map((id) => document.getElementById(id));
          preview.click();
          if (cancel.hidden) throw new Error('a preview cannot be cancelled');
          const state = async () => (await (await fetch('progress.json')).json()).state;
          while (await state() === 'idle');
          cancel.click();
        }""")
        page.wait_for_selector("#cancel", state="hidden", timeout=30_000)
        assert page.inner_text("#rendering-words") == "Cancelled."
        page.click("#preview")
        page.wait_for_selector("#picture:not([hidden])", timeout=240_000)
        assert "Preview" in page.inner_text("#rendering-words")
        source = page.get_attribute("#picture", "src")
        page.locator("#stage").focus()
        press(opened, "q")
        assert page.locator("#picture").is_hidden()
        press(opened, "Control+z")
        assert page.locator("#picture").is_visible()
        before = page.evaluate(STATE)
        # The pixels of the preview, through a canvas of the page.
        code = """async (address) => {
          const image = new Image();
          image.src = address;
          await image.decode();
          const size = { width: image.naturalWidth, height: image.naturalHeight };
          const brush = Object.assign(document.createElement('canvas'), size).getContext('2d');
          brush.drawImage(image, 0, 0);
          const { data } = brush.getImageData(0, 0, size.width, size.height);
          return [size.width, size.height, Array.from(data)];
        }"""
        width, height, codes = page.evaluate(code, source)
        shown = np.array(codes, np.float64).reshape(height, width, 4)[..., :3]
        page.click("#insert")
        page.wait_for_selector("#report:not([hidden])", timeout=400_000)
        assert page.evaluate(STATE) == before
        with page.expect_popup() as popup:
            page.click("#report")
        popup.value.wait_for_selector("h1")
        assert popup.value.url.endswith("/result/report.html")
    composite = np.asarray(Image.open(out / "result" / "composite.png"), np.float64)
    photo = np.asarray(Image.open(inputs / "photo.png"), np.float64)
    assert shown.shape == composite.shape
    changed = np.abs(composite - photo).max(axis=-1) > 12.0
    assert changed.sum() > 2000
    assert np.abs(shown - composite)[changed].mean() < 6.0
    assert np.abs(shown - composite)[~changed].mean() < 1.5


@needs_chromium
@pytest.mark.slow
def test_picture_is_that_of_its_own_state(inputs: Path, tmp_path: Path) -> None:
    """One that is cancelled does not put the picture before it over another placement."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640) as opened:
        page = opened.page
        said = {"state": "done", "kind": "preview", "seconds": 1.0, "address": "photo.jpg"}
        page.route("**/preview", lambda route: route.fulfill(json={}))
        page.route("**/progress.json", lambda route: route.fulfill(json=said))
        page.click("#preview")
        page.wait_for_selector("#picture:not([hidden])")
        page.locator("#stage").focus()
        press(opened, "q")
        said["state"] = "cancelled"
        page.click("#preview")
        page.get_by_text("Cancelled.").wait_for()
        page.click("#zoom-in")  # draws all again
        settle(opened)
        assert page.locator("#picture").is_hidden()
        press(opened, "Control+z")
        assert page.locator("#picture").is_visible()


@needs_chromium
@pytest.mark.slow
def test_what_is_rendered_already_is_told(inputs: Path, tmp_path: Path) -> None:
    """A page that was loaded again, and a second one, tell how far it is and can cancel it."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640, known="422") as opened:
        page = opened.page
        said = {"state": "running", "kind": "insert", "line": "light", "share": 0.5, "seconds": 3}
        page.route("**/progress.json", lambda route: route.fulfill(json=said))
        page.reload()
        page.wait_for_selector("#cancel:not([hidden])")
        assert page.locator("#preview").is_disabled()
        said |= {"state": "done", "address": "result/report.html"}
        page.wait_for_selector("#report:not([hidden])")
        assert page.locator("#cancel").is_hidden()
        refusal = {"where": "the page", "what": "rendered already", "advice": ""}
        page.route("**/preview", lambda route: route.fulfill(status=422, json=refusal))
        said |= {"state": "running", "kind": "preview"}
        page.click("#preview")
        # Not Cancel, which is there before the refusal comes, too.
        page.wait_for_selector("#rendering-words:has-text('Estimating the light')")
        said |= {"state": "done", "address": "photo.jpg"}
        page.wait_for_selector("#cancel", state="hidden")
        assert page.locator("#picture").is_hidden()
        assert page.inner_text("#rendering-words") == ""


@needs_chromium
@pytest.mark.slow
def test_command_is_shown_for_what_was_saved_alone(inputs: Path, tmp_path: Path) -> None:
    """Any change hides it, for it would render the placement before; undo shows it again."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640) as opened:
        save(opened)
        for key, is_shown in (("q", False), ("Control+z", True)):
            opened.page.focus("#stage")
            press(opened, key)
            assert opened.page.locator("#done").is_visible() == is_shown


@needs_chromium
@pytest.mark.slow
def test_page_tells_when_warpir_ends_in_a_picture(inputs: Path, tmp_path: Path) -> None:
    """In its own words, not in those of the browser."""
    with placing(command(inputs, tmp_path / "out"), 1000, 640, known="ERR_FAILED") as opened:
        page = opened.page
        page.route("**/preview", lambda route: route.fulfill(json={}))
        page.route("**/progress.json", lambda route: route.abort())
        page.click("#preview")
        page.get_by_text("warpir.place is not running any more.").wait_for()


@pytest.mark.slow
def test_preview_refuses_as_insert_does(inputs: Path, worker: Worker, tmp_path: Path) -> None:
    """A photo that went away is one line, and the next preview is answered again."""
    config = {"photo": str(tmp_path / "none.png"), "asset": str(inputs / "wedge.glb")}
    job = {"kind": "preview", "config": {**config, "out": "x"}, "width": 64, "picture": "y.png"}
    with pytest.raises(InputError, match="none"):
        worker.ask(job)
    good = {**config, "photo": str(inputs / "photo.png"), "out": "x"}
    assert worker.ask({**job, "kind": "warm", "config": good})["device"]


@pytest.mark.slow
def test_cancelled_job_leaves_what_is_loaded(
    inputs: Path, worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process lives on, and its kernels are kept though it is killed."""
    monkeypatch.setenv("WARP_CACHE_PATH", str(tmp_path / "kernels"))
    config = {"photo": str(inputs / "photo.png"), "asset": str(inputs / "wedge.glb")}
    picture = tmp_path / "p.png"
    job = {"config": {**config, "out": "x"}, "width": 64, "picture": str(picture)}
    heard: list[str] = []
    worker.ask({**job, "kind": "warm"}, lambda said: heard.append(said["stage"]))
    assert "compiling kernels" in heard
    process = worker._process
    with pytest.raises(InputError, match="stopped"):
        worker.ask({**job, "kind": "preview"}, lambda _: worker.interrupt())
    assert not picture.exists()
    time.sleep(PATIENCE + 0.5)  # nothing ends the process later
    assert worker.ask({**job, "kind": "preview"})["width"] == 64
    assert worker._process is process and picture.exists()
    worker.stop()
    assert [f for f in (tmp_path / "kernels").rglob("*") if f.is_file()]
