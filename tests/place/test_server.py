"""The command `warpir.place` and its server: what they refuse, and who gets an answer."""

import base64
import json
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from tests.builders.programs.children import output_of
from tests.builders.programs.placing import Served, begun, command, serve
from warpir.app.config import InsertConfig


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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_placements_are_saved_one_at_a_time() -> None:
    """Whether by Save or by Full render: two at once took each other's files for somebody's."""
    from warpir.place.server import PlaceServer

    server = object.__new__(PlaceServer)
    server.working = threading.Lock()
    names = ("save", "insert", "preview")
    server.answers = {n: lambda _: {"alone": server.working.locked()} for n in names}
    alone = {name: server.answer(name, b"")["alone"] for name in names}
    assert alone == {"save": True, "insert": True, "preview": False}


@pytest.mark.slow
def test_once_ends_when_the_full_render_is_done(inputs: Path, tmp_path: Path) -> None:
    """A save beside it ended the program, and the render with it."""
    out = tmp_path / "out"
    named = {"photo": str(inputs / "photo.png"), "asset": str(inputs / "wedge.glb")}
    _, _, said = begun(InsertConfig(**named, out=str(out)))
    with serve(command(inputs, out, "--once", "--sun=-60,45,3", "--sky", "clear")) as served:
        port, token = served.parts
        host, body = f"127.0.0.1:{port}", json.dumps(said)
        names = "insert", "save"
        answers = ask(served, *(("POST", f"/{token}/{name}", host, body) for name in names))
        assert [status for status, _ in answers] == [200, 200]
        assert served.process.wait(timeout=300) == 0
        assert served.process.stdout is not None
        assert f"inserted: {out / 'result'}\n" in served.process.stdout.read()
    assert (out / "result" / "report.html").is_file()


def test_demo_starts_where_the_user_says() -> None:
    """A pixel, a turn and the folder replace the demo's own."""
    from warpir.place.command import _with_inputs

    config = _with_inputs(InsertConfig(demo=True, at=(600.0, 700.0), rotate_y=10.0, out="mine"))
    stands = config.placement
    assert (stands.at, stands.place, stands.rotate_y) == ((600.0, 700.0), None, 10.0)
    assert config.output.out == "mine"


def test_place_loads_neither_torch_nor_warp() -> None:
    """The page starts at once."""
    code = (
        "import sys, warpir.place, warpir.place.session, warpir.place.server\n"
        "print([m for m in ('torch', 'warp', 'trimesh', 'scipy') if m in sys.modules])"
    )
    assert output_of(code) == "[]\n"


def test_server_knows_every_file_of_the_page() -> None:
    """Nothing is in the folder that no address leads to, but for what is said of three.js."""
    from warpir.place.server import FILES, PAGE, VENDOR

    there = {path for folder in (PAGE, VENDOR) for path in folder.rglob("*") if path.is_file()}
    assert there == set(FILES.values()) | {VENDOR / "LICENSE", VENDOR / "README.md"}


RESETS = """
import socket, struct, sys, urllib.request
port, token = int(sys.argv[1]), sys.argv[2]
host = f"HTTP/1.1\\r\\nHost: 127.0.0.1:{port}\\r\\n"
head = f"POST /{token}/save {host}Content-Length: 99\\r\\n\\r\\n"
page = f"GET /{token}/vendor/three.core.min.js {host}\\r\\n"
for sent in (head[:20], head + "{", page):
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.sendall(sent.encode())
with urllib.request.urlopen(f"http://127.0.0.1:{port}/{token}/", timeout=10.0) as answer:
    print(answer.status)
"""
"""A child process may use the network of this machine, which a test may not."""


@pytest.mark.case("N9")
def test_connection_that_is_reset_is_quiet(inputs: Path, tmp_path: Path) -> None:
    """In a request's head, in its body, and before its answer; the next one is answered."""
    with serve(command(inputs, tmp_path / "out")) as served:
        argv = [sys.executable, "-c", RESETS, *map(str, served.parts)]
        done = subprocess.run(argv, capture_output=True, text=True, check=False, timeout=60)
        assert done.stdout == "200\n", done.stderr
        served.process.send_signal(signal.SIGINT)
        assert served.process.stdout is not None
        told = served.process.stdout.read()
    assert "Traceback" not in told and "Error" not in told, told
