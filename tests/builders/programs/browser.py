"""A headless Chromium for the tests that open our pages and use them as a person would."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import ConsoleMessage, Page, Request, sync_playwright

NAMES = ("chromium", "chromium-browser", "google-chrome")
CHROMIUM = next((path for name in NAMES if (path := shutil.which(name))), None)

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no Chromium on PATH")


@dataclass
class Opened:
    """A page with all that went wrong in it.

    Attributes:
        page: The page, which has not gone anywhere yet.
        errors: Messages of the console at level warning and above, and exceptions.
        requests: Addresses that were asked for, without ``data:`` and ``blob:``.
    """

    page: Page
    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


class Fingers:
    """Fingers on the screen of a page, each under a number of its own."""

    def __init__(self, page: Page) -> None:
        """Touch nothing yet."""
        self._page, self._screen = page, page.context.new_cdp_session(page)
        self._places: dict[int, tuple[float, float]] = {}

    def press(self, finger: int, x: float, y: float) -> None:
        """Put a finger down."""
        self._send("touchStart", finger, x, y)

    def move(self, finger: int, x: float, y: float) -> None:
        """Move a finger that is down; pages are told with the next frame."""
        self._send("touchMove", finger, x, y)
        self._page.evaluate(
            "new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))"
        )

    def lift(self, finger: int) -> None:
        """Take a finger away."""
        self._send("touchEnd", finger, *self._places[finger])

    def _send(self, kind: str, finger: int, x: float, y: float) -> None:
        self._places[finger] = (x, y)
        points = [{"id": finger, "x": x, "y": y}]
        self._screen.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})


@contextmanager
def open_browser(width: int = 1280, height: int = 800) -> Iterator[Opened]:
    """Open an empty page of some size [pixels]; WebGL is drawn by the CPU."""
    with sync_playwright() as tool:
        browser = tool.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"],
        )
        opened = Opened(browser.new_page(viewport={"width": width, "height": height}))

        def note(message: ConsoleMessage) -> None:
            if message.type in ("warning", "error"):
                opened.errors.append(f"{message.type}: {message.text}")

        def ask(request: Request) -> None:
            if not request.url.startswith(("data:", "blob:")):
                opened.requests.append(request.url)

        opened.page.on("console", note)
        opened.page.on("pageerror", lambda error: opened.errors.append(f"exception: {error}"))
        opened.page.on("request", ask)
        yield opened
        browser.close()
