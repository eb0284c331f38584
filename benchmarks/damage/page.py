"""What the placing page's server does with strange requests.

    python -m benchmarks.damage.page --minutes 15 --seed 1

Right is an answer of 200, 4xx or, for what HTTP itself has no name for, 501 or 505, or a closed
connection; nothing on standard error, no content that is not the page's, and a server that answers
its own page afterwards. Requests are drawn from the seed; some are sent slowly, some are cut, some
at once with others.
"""

import argparse
import base64
import io
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.damage.draws import Draw
from tests.builders.gltf_files import png
from tests.builders.image_files import png_chunk
from tests.builders.insertions import write_inputs

ALLOWED = {200, 400, 403, 404, 413, 414, 422, 431, 501, 505}
LONGEST = 40.0
"""Longest that an answer may take [s]: the server waits 30 s for a slow client."""
SECRET = "fuzz-secret-beside-the-page"
"""Content of a file beside the photo, which no answer may hold."""
PLACED = {
    **{"fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0, "rotate_y": 10.0, "size": 1.0},
    "stance": {"x": 0.0, "height": 1.5, "z": 0.0, "heading": 0.0, "pitch": -15.0, "roll": 0.0},
    **{"stand": {"x": 0.0, "z": -5.0}, "sun": None, "sky": None, "mask": None},
}
"""What the page sends to save a placement."""
NUMBERS = (0, -0.0, 1, -1, 2**63, 10**400, 1e308, -1e308, 5e-324, 1e15, 1e-30, 0.5, 90, 1e9)
TEXTS = ("", "x", "\0", "é\ud800", "1,2", "1,2,3", "0,90,1e30", "clear", "overcast", "nan", "../x")
NAMES = ("save", "light", "preview", "cancel", "insert", "progress.json", "start.json")
PATHS = (
    *("", "../secret.txt", "..%2fsecret.txt", "%2e%2e/secret.txt", "vendor/../../secret.txt"),
    *("result/../secret.txt", "result/run.json", "result//etc/passwd", "preview-1.png", "\\..\\x"),
    *("preview-9/../../secret.txt", "vendor/three.core.min.js", "page.js?x=../secret.txt", "%00"),
    *("a" * 60_000, "a" * 70_000, "é", "?" * 300, "#", "//", "photo.jpg", "asset.glb"),
)


class Requests(Draw):
    """Draws requests from a seed."""

    def __init__(self, seed: int, port: int, token: str) -> None:
        super().__init__(seed)
        self.port, self.token = port, token

    def value(self) -> Any:
        """Return a value of JSON of any type."""
        kind = self.rng.integers(8)
        if kind < 3:
            return self.one(NUMBERS)
        if kind < 5:
            return self.one(TEXTS)
        return self.one((None, True, [], {}, [1, [2]], [0.0] * 3, {"x": {}}, float("nan"), [1e30]))

    def mask(self) -> Any:
        """Return a mask of the page: a PNG of any mode, some with an odd chunk, in base64."""
        sizes = ((1, 1), (64, 48), (3000, 1), (2048, 2), (1, 2048))
        mode = self.one(("1", "L", "LA", "P", "RGB", "RGBA", "I;16"))
        stream = io.BytesIO()
        Image.new(mode, self.one(sizes), self.one((0, 1))).save(stream, "PNG")
        content = stream.getvalue()
        if self.odd(0.5):
            chunk = self.one((b"cHRM", b"gAMA", b"pHYs", b"iCCP", b"tRNS", b"zTXt", b"iTXt",
                              b"fcTL", b"acTL", b"sRGB", b"PLTE", b"eXIf", b"fdAT",
                              b"IHDR"))  # fmt: skip
            data = self.rng.bytes(int(self.rng.integers(40)))
            if chunk == b"IHDR":
                size = [int(self.one((1, 64, 2**31 - 1, 60_000))) for _ in "wh"]
                data = b"".join(n.to_bytes(4, "big") for n in size) + b"\x08\x02\0\0\0"
                content = content[:8] + png_chunk(chunk, data) + content[33:]
            else:
                content = content[:33] + png_chunk(chunk, data) + content[33:]
        if self.odd(0.2):
            content = content[: int(self.rng.integers(len(content)))]
        return base64.b64encode(content).decode()

    def body(self) -> bytes:
        """Return a body: a placement with odd values, or no JSON at all."""
        if self.odd(0.12):
            return self.one((b"", b"{", b"[" * 100_000, b"\xff\xfe", b'{"a":' * 9000, b"null",
                             b"1", b'{"fx": 1e999}', b'{"fx": NaN}', b'{"a":1,"a":2}',
                             b"\0" * 100))  # fmt: skip
        sent = json.loads(json.dumps(PLACED))
        for _ in range(int(self.rng.integers(1, 4))):
            name = self.one((*sent, "odd"))
            if name in ("stance", "stand") and self.odd(0.7):
                part = sent.get(name)
                if isinstance(part, dict):
                    part[self.one(tuple(part) or ("x",))] = self.value()
            elif name == "mask" and self.odd(0.7):
                sent["mask"] = self.mask()
            elif self.odd(0.1):
                sent.pop(name, None)
            else:
                sent[name] = self.value()
        text = json.dumps(sent).encode()
        return text[: int(self.rng.integers(len(text)))] if self.odd(0.05) else text

    def request(self) -> bytes:
        """Return the bytes of a request."""
        own = f"/{self.token}/"
        method = self.one(("GET",) * 5 + ("POST",) * 12 + ("HEAD", "PUT", "X" * 900, "get"))
        name = self.one(NAMES if method == "POST" else (*NAMES, *PATHS))
        path = own + name
        if self.odd(0.1):
            path = self.one(("/", "*", "", "//" + own, f"http://127.0.0.1{own}", own[:-1] + name))
        body = self.body() if method in ("POST", "PUT") else b""
        if name == "insert":
            body = body[: len(body) // 2]  # a whole insertion is another test's
        version = "HTTP/1.1" if not self.odd(0.05) else self.one(("HTTP/9.9", "HTTP/1", "", "X"))
        lines = [f"{method} {path} {version}"]
        if not self.odd(0.05):
            host = f"127.0.0.1:{self.port}"
            lines.append("Host: " + (self.one(("x", "a:b")) if self.odd(0.1) else host))
        length: Any = len(body)
        if self.odd(0.15):
            length = self.one((-1, "x", "1e3", 2**70, length + 5, 0, "٣", "0x10", 10**8, "1, 1"))
        lines.append(f"Content-Length: {length}")
        if self.odd(0.15):
            lines.append(self.one(("Transfer-Encoding: chunked", "Origin: http://evil.example",
                                   "X: " + "y" * 70_000, ": x", "no colon", "Expect: 100-continue",
                                   "\n".join(f"X{k}: y" for k in range(150)), " folded", "Host: a",
                                   "Range: bytes=0-99999999999",
                                   "Connection: keep-alive")))  # fmt: skip
        return "\r\n".join(lines).encode("utf-8", "replace") + b"\r\n\r\n" + body


def send(port: int, content: bytes, how: str) -> bytes | None:
    """Send a request and return the answer; None where nobody waited for one."""
    with socket.create_connection(("127.0.0.1", port), timeout=LONGEST) as link:
        try:
            if how == "cut":
                link.sendall(content[: len(content) // 2])
                link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # reset
                return None
            if how == "slow":
                for k in range(0, min(len(content), 300), 30):
                    link.sendall(content[k : k + 30])
                    time.sleep(0.01)
                content = content[300:]
            link.sendall(content)
            with suppress(OSError):  # it was closed already
                link.shutdown(socket.SHUT_WR)
            parts = []
            while part := link.recv(1 << 16):
                parts.append(part)
                if how == "leave":
                    return None
            return b"".join(parts)
        except ConnectionError:
            return b""


def fault_of(answer: bytes | None) -> str:
    """Return what is wrong with an answer, or an empty text."""
    if not answer:
        return ""
    if SECRET.encode() in answer:
        return "the content of a file outside of the page"
    line = answer.partition(b"\r\n")[0].decode("latin-1")
    if not line.startswith("HTTP/"):  # HTTP/0.9 has neither status nor headers
        return ""
    return "" if int(line.split()[1]) in ALLOWED else line


def survey(minutes: float, seed: int, keep: Path | None) -> dict[str, Any]:
    """Send requests for some minutes and return what became of them."""
    with tempfile.TemporaryDirectory(prefix="warpir-page-") as temporary:
        folder = Path(temporary)
        write_inputs(folder)
        (folder / "photo.png").write_bytes(png(size=64))
        (folder / "secret.txt").write_text(SECRET)
        with open(folder / "err", "w+b") as err:
            server = subprocess.Popen(
                [sys.executable, "-m", "warpir.place", "--photo", folder / "photo.png", "--asset",
                 folder / "box.glb", "--out", folder / "out", "--no-browser", "--fov", "60",
                 "--pitch", "-15", "--camera-height", "1.5"],
                stdout=subprocess.PIPE, stderr=err, text=True,
            )  # fmt: skip
            assert server.stdout is not None
            address = next(line for line in server.stdout if line.startswith("page: ")).split()[1]
            threading.Thread(target=server.stdout.read, daemon=True).start()
            port, token = int(address.split(":")[2].split("/")[0]), address.split("/")[3]
            try:
                return _meet(Requests(seed, port, token), server, err, minutes, keep)
            finally:
                server.terminate()
                server.wait(60)


def _meet(
    draw: Requests, server: Any, err: io.BufferedRandom, minutes: float, keep: Path | None
) -> dict[str, Any]:
    codes: Counter[str] = Counter()
    faults: dict[str, bytes] = {}
    longest, seen = 0.0, 0

    def meet(content: bytes, how: str) -> None:
        nonlocal longest
        start = time.monotonic()
        try:
            answer = send(draw.port, content, how)
        except (OSError, TimeoutError) as error:
            faults.setdefault(f"{type(error).__name__}: {error}", content)
            return
        longest = max(longest, time.monotonic() - start)
        status = answer[9:12].decode() if answer and answer.startswith(b"HTTP/") else "closed"
        codes[status] += 1
        fault = fault_of(answer)
        if fault:
            faults.setdefault(fault, content)

    start = time.monotonic()
    while time.monotonic() - start < 60.0 * minutes and server.poll() is None:
        how = draw.one(("whole",) * 12 + ("slow", "cut", "leave"))
        count = 30 if draw.odd(0.005) else 1
        contents = [draw.request() for _ in range(count)]
        threads = [threading.Thread(target=meet, args=(each, how)) for each in contents]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        size = os.fstat(err.fileno()).st_size
        if size > seen:
            text = os.pread(err.fileno(), size - seen, seen).decode("utf-8", "replace")
            lines = [line for line in text.splitlines() if line.strip("- ")]
            faults.setdefault("standard error: " + lines[-1], contents[0])
            seen = size
    alive = fault_of(send(draw.port, _page(draw), "whole")) or server.poll()
    if alive:
        faults["the server went"] = b""
    for k, (fault, content) in enumerate(faults.items()):
        print(f"    {fault[:300]}", flush=True)
        if keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            (keep / f"request-{k}").write_bytes(content)
    minutes = round((time.monotonic() - start) / 60.0, 1)
    return {"kind": "requests", "inputs": sum(codes.values()), "minutes": minutes,
            "ends": dict(sorted(codes.items())),
            "longest_seconds": round(longest, 1), "faults": len(faults)}  # fmt: skip


def _page(draw: Requests) -> bytes:
    return f"GET /{draw.token}/ HTTP/1.1\r\nHost: 127.0.0.1:{draw.port}\r\n\r\n".encode()


def main(argv: Sequence[str] | None = None) -> int:
    """Survey the server; 1 when there was a fault."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.damage.page", description=__doc__)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="folder for requests that make a fault")
    options = parser.parse_args(argv)
    row = survey(options.minutes, options.seed, options.keep)
    print(json.dumps(row | {"seed": options.seed}))
    return int(row["faults"] > 0)


if __name__ == "__main__":
    sys.exit(main())
