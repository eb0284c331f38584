"""Runs `warpir.place` for tests, and uses its page as a person would."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from playwright.sync_api import FloatRect

from tests.builders.programs.browser import Opened, open_browser
from warpir.app.config import InsertConfig
from warpir.place.session import Session, open_session, start_record
from warpir.place.stance import Stance

WIDTH, HEIGHT = 480, 320
"""Size of the photo of the tests [px]."""
EXACT = 1e-9
"""Float64 on both sides, a few dozen operations on numbers up to 1000."""
TILTED = Stance(0.4, 1.7, -0.3, 25.0, -11.0, 6.0)
"""A camera that is level in nothing."""
STATE = "import('./page.js').then((m) => m.state)"
"""The page's state, for `Page.evaluate`."""
FOOT_ON_CANVAS = """import('./page.js').then(async ({ stage, state }) => {
  const { Vector3 } = await import('three');
  const at = new Vector3(state.stand.x, 0, state.stand.z);
  at.applyMatrix4(stage.camera.matrixWorldInverse).applyMatrix4(stage.camera.projectionMatrix);
  const box = document.getElementById('canvas').getBoundingClientRect();
  return [box.left + (at.x + 1) / 2 * box.width, box.top + (1 - at.y) / 2 * box.height];
})"""
"""Where the canvas draws the object's foot, in pixels of the window."""


def begun(config: InsertConfig) -> tuple[Session, dict[str, Any], dict[str, Any]]:
    """A session, what its page starts with, and what that sends of an unchanged placement."""
    session = open_session(config.inputs, config.camera, config.placement, config.limits)
    start = start_record(session, config.light, str(config.output.out))
    said = {**start["camera"], **{k: start[k] for k in ("stance", "stand", "rotate_y", "size")}}
    return session, start, said


def command(folder: Path, out: Path, *more: str, asset: str = "wedge.glb") -> list[str]:
    """A command line that opens no browser."""
    named = ["--photo", str(folder / "photo.png"), "--asset", str(folder / asset)]
    return [*named, "--out", str(out), "--no-browser", *more]


@dataclass(frozen=True)
class Served:
    """A running server."""

    process: subprocess.Popen[str]
    address: str

    @property
    def parts(self) -> tuple[int, str]:
        """Port and token."""
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/([\w-]+)/", self.address)
        assert found is not None
        return int(found[1]), found[2]


@contextmanager
def serve(argv: Sequence[str]) -> Iterator[Served]:
    """Run the command in a child process; it is told to end where the test has not."""
    process = subprocess.Popen(
        [sys.executable, "-m", "warpir.place", *argv],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=Path(argv[argv.index("--out") + 1]).parent,
    )
    assert process.stdout is not None
    try:
        lines = []
        for line in process.stdout:
            lines.append(line)
            if line.startswith("page: "):
                yield Served(process, line.split()[1])
                return
        raise AssertionError("".join(lines))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)


@contextmanager
def placing(
    argv: Sequence[str], width: int = 1280, height: int = 800, known: str | None = None
) -> Iterator[Opened]:
    """Serve the page and open it; nothing goes wrong in it but what has the known words."""
    with serve(argv) as served, open_browser(width, height) as opened:
        open_page(opened, served)
        yield opened
        assert [e for e in opened.errors if known is None or known not in e] == []


def open_page(opened: Opened, served: Served) -> None:
    """Go to the page and wait until the object is in it."""
    opened.page.goto(served.address)
    opened.page.wait_for_selector("#save:not([disabled])", timeout=60_000)
    opened.page.wait_for_selector("[data-handle=foot][transform]")


def settle(opened: Opened) -> None:
    """Wait until what was changed is drawn."""
    opened.page.evaluate(
        "new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))"
    )


def box_of(opened: Opened, selector: str) -> FloatRect:
    """Where an element is, in pixels of the window."""
    box = opened.page.locator(selector).bounding_box()
    assert box is not None
    return box


def handle_at(opened: Opened, name: str) -> tuple[float, float]:
    """Where the middle of a handle is, in pixels of the window."""
    box = box_of(opened, f"[data-handle={name}]")
    return box["x"] + box["width"] / 2.0, box["y"] + box["height"] / 2.0


def pull(
    opened: Opened, start: tuple[float, float], end: tuple[float, float], steps: int = 1
) -> None:
    """Drag with the mouse from one place of the window to another."""
    mouse = opened.page.mouse
    mouse.move(*start)
    mouse.down()
    mouse.move(*end, steps=steps)
    mouse.up()
    settle(opened)


def drag(opened: Opened, name: str, by: tuple[float, float]) -> None:
    """Drag a handle by some pixels."""
    x, y = handle_at(opened, name)
    pull(opened, (x, y), (x + by[0], y + by[1]), steps=2)


def press(opened: Opened, *keys: str) -> None:
    """Press keys, one after another."""
    for key in keys:
        opened.page.keyboard.press(key)
    settle(opened)


def enter(opened: Opened, field: str, value: object) -> None:
    """Type a value into a field."""
    opened.page.fill(f"#{field}", str(value))
    press(opened, "Enter")


def save(opened: Opened) -> None:
    """Save the placement."""
    opened.page.click("#save")
    opened.page.wait_for_selector("#done:not([hidden])")
