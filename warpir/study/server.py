"""Serves the pages of a study and saves answers, on the loopback unless another host is named.

Of the study's folder it reads nothing but the pages and images that were there when it started, by
their exact names, which cannot be guessed without the study's seed; the key is not among them. Who
asks must name the server by an address or by the name that it was given: a page from elsewhere can
point a name of its own at it (DNS rebinding), but no address. Nothing is logged: an address is
personal data.
"""

import ipaddress
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

from warpir.core.atomic import WriteError, write_file
from warpir.core.errors import InputError
from warpir.study.answers import parse_sheet
from warpir.study.key import ANSWERS, PAGES, Study
from warpir.study.pages import SERVED, STATIC

TYPES = {".html": "text/html; charset=utf-8", ".png": "image/png"}
MOST_BYTES_PER_TRIAL = 500
"""Of a file of answers; a page sends some 100."""
SECONDS = 30
"""After which a request that does not arrive, or a part of an answer that is not taken, is given
up."""
PART = 1 << 16
"""Bytes of an answer that are sent at a time: a whole picture takes a slow line minutes."""
HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cache-Control": "no-store",
}


@dataclass
class Site:
    """What is served, and where answers go."""

    folder: Path
    study: Study
    say: Callable[[str], None]
    """Prints a line."""
    files: dict[str, Path] = field(init=False)
    """By the path of the address."""
    saving: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        pages = self.folder / PAGES
        self.files = {
            f"/{path.name}": path
            for path in pages.iterdir()
            if path.suffix in TYPES and path.is_file() and not path.is_symlink()
        }

    def saved(self, token: str) -> Path:
        """Return where the answers of a rater are."""
        return self.folder / ANSWERS / f"{token}.json"

    def save(self, token: str, body: bytes) -> tuple[HTTPStatus, str]:
        """Check and keep the answers of a rater; return the status and why."""
        try:
            sheet = parse_sheet("answers", body, self.study.plan)
        except InputError as error:
            return HTTPStatus.BAD_REQUEST, str(error)
        if sheet.rater.token != token:
            return HTTPStatus.BAD_REQUEST, "answers of another rater"
        with self.saving:
            if self.saved(token).exists():
                return HTTPStatus.CONFLICT, "answers of this rater were saved before"
            try:
                write_file(self.saved(token), body)
            except WriteError as error:
                self.say(f"notice: answers could not be saved ({error})")
                return HTTPStatus.INSUFFICIENT_STORAGE, "cannot be saved"
        self.say(f"saved: {self.saved(token)}")
        return HTTPStatus.CREATED, "saved"


class StudyServer(ThreadingHTTPServer):
    """Listens from the moment it is made.

    Args:
        site: What is served.
        host: Address to listen on, or a name that leads to it.
        port: 0 lets the system choose one.

    Raises:
        OSError: The address cannot be listened on.
    """

    daemon_threads = True

    def __init__(self, site: Site, host: str, port: int) -> None:
        self.site = site
        self.name = host
        super().__init__((host, port), _Handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Say what failed, but not for whom; a browser that went away is no fault."""
        error = sys.exception()
        if not isinstance(error, ConnectionError):
            self.site.say(f"notice: a request failed ({type(error).__name__}: {error})")

    def is_named(self, host: str) -> bool:
        """Return whether a ``Host`` header names this server, as no page from elsewhere can."""
        bound, port = str(self.server_address[0]), self.server_address[1]
        names = (bound, self.name.lower(), "localhost")
        if is_loopback(bound):
            # Browsers leave out the port that is HTTP's own.
            ports = ("", ":80") if port == 80 else (f":{port}",)
            return host.lower() in (name + end for name in names for end in ports)
        # Another machine may pass on what comes to its own address and port.
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:  # half a bracket
            return False
        return name in names or _is_address(name)


class _Handler(BaseHTTPRequestHandler):
    server: StudyServer
    protocol_version = "HTTP/1.1"
    server_version = "warpir"
    sys_version = ""
    timeout = SECONDS

    def do_GET(self) -> None:
        self._get(with_body=True)

    def do_HEAD(self) -> None:
        self._get(with_body=False)

    def do_POST(self) -> None:
        self._answer(*self._post())

    def _get(self, with_body: bool) -> None:
        path = self.server.site.files.get(urlsplit(self.path).path)
        if not self._is_ours():
            self._answer(HTTPStatus.FORBIDDEN, "asked for under another name", with_body)
        elif path is None:
            self._answer(HTTPStatus.NOT_FOUND, "Open the link that you were given.", with_body)
        else:
            try:
                content = path.read_bytes()
            except OSError:
                self._answer(HTTPStatus.NOT_FOUND, "The file is gone.", with_body)
                return
            if path.suffix == ".html":
                content = content.replace(STATIC, SERVED, 1)
            self._send(HTTPStatus.OK, TYPES[path.suffix], content, with_body)

    def _post(self) -> tuple[HTTPStatus, str]:
        """Receive answers; return the status and why."""
        site = self.server.site
        self.close_connection = True  # a body that is not read must not become the next request
        raters = {f"/{ANSWERS}/{rater.token}": rater for rater in site.study.plan.raters}
        rater = raters.get(self.path)
        if not self._is_ours():
            return HTTPStatus.FORBIDDEN, "sent from another page"
        if rater is None:
            return HTTPStatus.NOT_FOUND, "no rater of this study"
        if self.headers.get_content_type() != "application/json":
            return HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected application/json"
        length = self.headers.get("Content-Length", "")
        if "Transfer-Encoding" in self.headers or not (length.isascii() and length.isdigit()):
            return HTTPStatus.LENGTH_REQUIRED, "expected a length"
        if len(length) > 9 or int(length) > MOST_BYTES_PER_TRIAL * (len(rater.trials) + 1):
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "too large"
        body = self.rfile.read(int(length))
        if len(body) != int(length):
            return HTTPStatus.BAD_REQUEST, "cut off"
        return site.save(rater.token, body)

    def _is_ours(self) -> bool:
        """Whether the request names this server, so that no other site speaks through a browser."""
        hosts, origin = self.headers.get_all("Host", []), self.headers.get("Origin")
        if len(hosts) != 1 or not self.server.is_named(hosts[0]):
            return False
        return origin is None or origin == f"http://{hosts[0]}"

    def _answer(self, status: HTTPStatus, why: str, with_body: bool = True) -> None:
        self._send(status, "text/plain; charset=utf-8", f"{why}\n".encode(), with_body)

    def _send(self, status: HTTPStatus, kind: str, content: bytes, with_body: bool) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        if with_body:
            for start in range(0, len(content), PART):
                self.wfile.write(content[start : start + PART])

    def log_message(self, format: str, *args: object) -> None:
        pass


def is_loopback(host: str) -> bool:
    """Return whether only this machine reaches an address."""
    return host.startswith("127.")


def _is_address(name: str) -> bool:
    """Return whether a host is told by its number."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
