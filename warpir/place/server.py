"""HTTP server of `warpir.place`, for the browser of this user on this machine only.

It listens on 127.0.0.1 alone. Every request must name that host and begin with a token that was
drawn for this session, so that neither a page from elsewhere (DNS rebinding) nor another user gets
anything: the address is printed, and given to the browser in a file that only this user can read,
never as an argument, which everybody sees. Addresses are looked up in a table; none is a path on
disk.
"""

from __future__ import annotations

import json
import re
import secrets
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import warpir.report
from warpir.app.config import usage
from warpir.core.errors import InputError
from warpir.place.renderings import policy_of
from warpir.report.html import source_hash

HOST = "127.0.0.1"
LARGEST_REQUEST = 1 << 23
"""Largest request body [byte]: a mask of 2048 x 2048 pixels in base64."""
PAGE = Path(__file__).parent / "page"
VENDOR = Path(warpir.report.__file__).parent / "vendor"
"""Folder of three.js."""
OWN = (
    "page.css", "icon.svg", "camera.js", "fields.js", "handles.js", "history.js", "lamps.js",
    "light.js", "lines.js", "mask.js", "page.js", "pictures.js", "stage.js", "vanishing.js",
    "view.js",
)  # fmt: skip
LIBRARY = (
    "vendor/three.core.min.js", "vendor/three.module.min.js", "vendor/loaders/GLTFLoader.js",
    "vendor/utils/BufferGeometryUtils.js",
)  # fmt: skip
FILES = {
    "": PAGE / "index.html",
    **{name: PAGE / name for name in OWN},
    **{name: VENDOR.parent / name for name in LIBRARY},
}
"""Files of the page by their addresses behind the token."""
KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
    "jpg": "image/jpeg",
    "png": "image/png",
    "glb": "model/gltf-binary",
    "json": "application/json",
}


class PlaceServer(ThreadingHTTPServer):
    """Serves one session.

    Args:
        port: Port to listen on; 0 for any that is free.
        contents: Functions that build the other files, by address; each is called once, when its
            file is first requested.
        answers: By address, what is called with the bytes that the page sends there and returns the
            answer, in a thread of each request's own. ``save`` is among them; it and ``insert``,
            which saves, are called while nothing else is read, built or saved. Each raises
            `InputError`.
        changing: Returns a file that may be another one the next time, by its address; None where
            there is none.
        once: What is waited for once a placement was saved, before that ends `serve_forever`; None:
            it does not.

    Raises:
        InputError: The port cannot be used (`ExitCode.USAGE`).
    """

    daemon_threads = True

    def __init__(
        self,
        port: int,
        contents: Mapping[str, Callable[[], bytes]],
        answers: Mapping[str, Callable[[bytes], dict[str, Any]]],
        changing: Callable[[str], bytes | None] = lambda _: None,
        once: Callable[[], object] | None = None,
    ) -> None:
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            what = f"cannot be listened on (found {port}: {error.strerror})"
            raise usage("--port", what, "leave it out for any that is free") from None
        self.token = secrets.token_urlsafe(24)
        self.answers = dict(answers)
        self.changing = changing
        self.once = once
        self.working = threading.Lock()
        """Held while files are read, built or saved."""
        self._makers = dict(contents)
        self._made: dict[str, bytes] = {}
        html = (PAGE / "index.html").read_bytes()
        scripts = re.findall(rb'<script type="importmap">(.*?)</script>', html, re.DOTALL)
        allowed = " ".join(source_hash(script) for script in scripts)
        self.policy = (
            f"default-src 'none'; script-src 'self' {allowed}; style-src 'self'; "
            "img-src 'self' blob:; connect-src 'self' blob:; base-uri 'none'; "
            "form-action 'none'; frame-ancestors 'none'"
        )

    @property
    def host(self) -> str:
        """Host and port, as a browser names them: it leaves out the port that is HTTP's own."""
        port = self.server_address[1]
        return HOST if port == 80 else f"{HOST}:{port}"

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{self.host}/{self.token}/"

    def answer(self, name: str, body: bytes) -> dict[str, Any]:
        """Return the answer to what the page sends to an address behind the token.

        Raises:
            InputError: It cannot be used.
        """
        with self.working if name in ("save", "insert") else nullcontext():
            return self.answers[name](body)

    def end(self, when: Callable[[], object]) -> None:
        """End `serve_forever` when what is waited for is there; until then all is answered."""
        when()
        self.shutdown()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Tell of a fault, unless it is a browser that went away in the middle of a request."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def content(self, name: str) -> bytes | None:
        """Return the file at an address behind the token; None where there is none."""
        with self.working:
            if name not in self._made:
                if name in FILES:
                    self._made[name] = FILES[name].read_bytes()
                elif name in self._makers:
                    self._made[name] = self._makers[name]()
            return self._made.get(name)


class _Handler(BaseHTTPRequestHandler):
    server: PlaceServer
    timeout = 30

    def do_GET(self) -> None:
        name = self._name()
        if name is None:
            return
        content = self.server.content(name)
        policy = self.server.policy
        if content is None:
            content = self.server.changing(name)
            policy = policy_of(content or b"") or policy
        if content is None:
            self._refuse(404)
            return
        suffix = "html" if name == "" else name.rpartition(".")[2]
        self._answer(200, KINDS.get(suffix, "application/octet-stream"), content, policy)

    def do_POST(self) -> None:
        name = self._name()
        if name is None:
            return
        length = self.headers.get("Content-Length", "")
        is_number = length.isascii() and length.isdigit() and len(length) < 10
        if name not in self.server.answers:
            self._refuse(404)
        elif not (is_number and int(length) <= LARGEST_REQUEST):
            self._refuse(413)
        else:
            body = self.rfile.read(int(length))
            try:
                status, answer = 200, self.server.answer(name, body)
            except InputError as error:
                status = 422
                answer = {"where": error.where, "what": error.what, "advice": error.advice}
            self._answer(status, KINDS["json"], json.dumps(answer).encode())
            if self.server.once is not None and name == "save" and status == 200:
                # In a thread of its own: it waits for the loop, which may wait for this one.
                wait = self.server.once
                threading.Thread(target=self.server.end, args=(wait,), daemon=True).start()

    def _name(self) -> str | None:
        """Return the address behind the token; None when the request was refused."""
        _, _, rest = self.path.partition("/")
        token, slash, name = rest.partition("/")
        is_ours = secrets.compare_digest(token.encode(), self.server.token.encode())
        if not (is_ours and slash and self.headers.get_all("Host") == [self.server.host]):
            self._refuse(403)
            return None
        return name.partition("?")[0]

    def _refuse(self, status: int) -> None:
        self._answer(status, "text/plain", b"")

    def _answer(self, status: int, kind: str, content: bytes, policy: str = "") -> None:
        self.send_response(status)
        headers = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Content-Security-Policy": policy or self.server.policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cache-Control": "no-store",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        try:
            self.wfile.write(content)
        except ConnectionError:  # the page was closed meanwhile
            self.close_connection = True

    def log_message(self, *args: object) -> None:
        """Print nothing: lines on the terminal are for the user."""
