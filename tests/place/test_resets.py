"""The placing page's server outlives browsers that go away in the middle of a request."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.builders.programs.placing import command, serve

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
