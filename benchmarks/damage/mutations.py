"""How files are damaged: bytes anywhere, and the structure behind checksums and lengths.

A flipped byte rarely passes a checksum or a parser. So beside plain bytes the parts of a format are
damaged and put together again: chunks of a PNG with their CRC, the JSON of a GLB with its length,
attributes of an EXR. Every strategy yields whole files.
"""

import copy
import json
import re
import struct
import zlib
from collections.abc import Callable
from typing import Any

from hypothesis import strategies as st

from tests.builders.gltf_files import pack_glb
from tests.builders.image_files import png_chunk

Bytes = st.SearchStrategy[bytes]

HEAD = 300
"""Where headers are, which half of the damage goes to [byte]."""
EXTREMES = (0, 1, -1, 2**7, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
WORDS = (
    b"", b"nan", b"-inf", b"-1", b"0", b"1e308", b"1e999", b"1e-400", b"2147483648",
    b"9007199254740993", b"18446744073709551616", b"9" * 5000, b"x" * 1000, b"\xff\xfe", b"\0",
    b"0x7f", b"1_0", b"\xd9\xa1", b"[" * 3000, b"{}", b"''", b"../../x", b"%00", b"# ", b"/", b"-",
)  # fmt: skip
ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2, 0.5, 1e308, -1e308, 1e-308, 2**31, 2**53, 2**64, 10**400, "",
    "x" * 1000, "\ud800", "\0", "nan", "../../x", "line\nline", [], {}, [[]], [{}], [None],
    [0] * 3, [1e308] * 3, [1e308] * 16, [[1e200] * 4] * 4, {"a": {"b": [1]}},
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """Yield a file with one to four places of its bytes damaged."""
    content = sound
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 4)))):
        content = draw(_damaged_once(content))
    return content


@st.composite
def _damaged_once(draw: st.DrawFn, content: bytes) -> bytes:
    end = draw(st.sampled_from((min(HEAD, len(content)), len(content))))
    at = draw(st.integers(0, max(end - 1, 0)))
    size = draw(st.sampled_from((1, 2, 4, 8, 16, 100)))
    kinds = ("flip", "byte", "number", "cut", "insert", "drop", "swap", "copy")
    match draw(st.sampled_from(kinds)):
        case "flip" if content:
            flipped = content[at] ^ (1 << draw(st.integers(0, 7)))
            return content[:at] + bytes([flipped]) + content[at + 1 :]
        case "byte":
            return content[:at] + bytes([draw(st.integers(0, 255))]) + content[at + 1 :]
        case "number":
            width = draw(st.sampled_from((2, 4, 8)))
            value = draw(st.sampled_from(EXTREMES)) % 256**width
            number = value.to_bytes(width, draw(st.sampled_from(("little", "big"))))
            return content[:at] + bytes(number) + content[at + width :]
        case "cut":
            return content[:at]
        case "insert":
            inserted = bytes([draw(st.sampled_from((0, 255, 65, 10)))]) * size
            return content[:at] + inserted + content[at:]
        case "drop":
            return content[:at] + content[at + size :]
        case "swap":
            other = draw(st.integers(0, max(len(content) - 1, 0)))
            low, high = sorted((at, other))
            size = min(size, high - low)
            a, b = content[low : low + size], content[high : high + size]
            return content[:low] + b + content[low + size : high] + a + content[high + size :]
    return content[:at] + content[at : at + size] * 2 + content[at + size :]


@st.composite
def damaged_words(draw: st.DrawFn, sound: bytes) -> bytes:
    """Yield a text with one to three of its words or numbers replaced, or a line moved."""
    content = sound
    for _ in range(draw(st.sampled_from((1, 1, 2, 3)))):
        words = list(re.finditer(rb"[-+.\w]+", content))
        if draw(st.integers(0, 4)) == 0 or not words:
            lines = content.split(b"\n")
            a, b = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
            lines[a], lines[b] = (lines[b], lines[a]) if draw(st.booleans()) else (lines[b],) * 2
            content = b"\n".join(lines)
        else:
            word = words[draw(st.integers(0, len(words) - 1))]
            new = draw(st.sampled_from(WORDS))
            content = content[: word.start()] + new + content[word.end() :]
    return content


def damaged_text(sound: bytes) -> Bytes:
    """Yield a text damaged in its words or in its bytes."""
    return st.one_of(damaged_words(sound), damaged(sound))


# ------------------------------------------------------------------------------------ JSON


class _Pairs:
    """An object with a key given twice, which a dict cannot hold."""

    def __init__(self, *pairs: tuple[str, Any]) -> None:
        self.pairs = pairs


def dump_json(value: Any) -> bytes:
    """Write JSON as it stands, keys twice and lone surrogates included."""
    if isinstance(value, _Pairs | dict):
        pairs = value.pairs if isinstance(value, _Pairs) else value.items()
        inner = (json.dumps(key).encode() + b":" + dump_json(part) for key, part in pairs)
        return b"{" + b",".join(inner) + b"}"
    if isinstance(value, list):
        return b"[" + b",".join(map(dump_json, value)) + b"]"
    return json.dumps(value).encode()


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Return the paths to everything below a JSON value."""
    keys = list(value) if isinstance(value, dict) else range(len(value))
    found = [(*path, key) for key in keys]
    for key in keys:
        if isinstance(value[key], dict | list):
            found += places(value[key], (*path, key))
    return found


@st.composite
def damaged_tree(draw: st.DrawFn, sound: Any) -> Any:
    """Yield a JSON value with one to three of its members replaced, deleted, doubled or nested."""
    root = [copy.deepcopy(sound)]
    for _ in range(draw(st.sampled_from((1, 1, 2, 3)))):
        # Of the members behind a key given twice nothing is changed again.
        *above, key = draw(st.sampled_from(places(root)))
        parent: Any = root
        for step in above:
            parent = parent[step]
        match draw(st.sampled_from(("odd", "odd", "odd", "delete", "double", "nest", "number"))):
            case "delete" if parent is not root:
                del parent[key]
            case "double" if isinstance(parent, dict) and above:
                holder: Any = root
                for step in above[:-1]:
                    holder = holder[step]
                pairs = (*parent.items(), (key, draw(st.sampled_from(ODD))))
                holder[above[-1]] = _Pairs(*pairs)
            case "double" if isinstance(parent, list):
                parent += [copy.deepcopy(parent[key])] * draw(st.sampled_from((1, 3, 50)))
            case "nest":
                for _ in range(draw(st.sampled_from((1, 2, 60)))):
                    parent[key] = [parent[key]]
            case "number" if type(parent[key]) in (int, float) and abs(parent[key]) < 1e30:
                factor = draw(st.sampled_from((-1, 0.5, 2, 1e-9, 1e9, 1e30)))
                parent[key] = parent[key] * factor
            case _:
                parent[key] = copy.deepcopy(draw(st.sampled_from(ODD)))
    return root[0]


def damaged_json(sound: Any, pack: Callable[[bytes], bytes] = bytes) -> Bytes:
    """Yield JSON damaged in its structure or its bytes, put into its file by ``pack``."""
    text = json.dumps(sound).encode()
    tree = damaged_tree(sound).map(dump_json)
    return st.one_of(tree, tree, damaged_text(text)).map(pack)


# ------------------------------------------------------------------------- files of parts


def png_chunks(content: bytes) -> list[tuple[bytes, bytes]]:
    """Return names and contents of a PNG's chunks."""
    found, at = [], 8
    while at < len(content):
        size, name = struct.unpack_from(">I4s", content, at)
        found.append((name, content[at + 8 : at + 8 + size]))
        at += size + 12
    return found


@st.composite
def damaged_png(draw: st.DrawFn, sound: bytes) -> bytes:
    """Yield a PNG whose chunks are damaged, in their compressed contents too; checksums fit."""
    chunks = png_chunks(sound)
    k = draw(st.integers(0, len(chunks) - 1))
    name, body = chunks[k]
    match draw(st.sampled_from(("body", "body", "packed", "swap", "drop", "double"))):
        case "body" if body:
            chunks[k] = name, draw(damaged(body))
        case "packed":  # the pixels themselves: filters, too few, too many
            k = next(i for i, (name, _) in enumerate(chunks) if name == b"IDAT")
            raw = draw(damaged(zlib.decompress(chunks[k][1])))
            chunks[k] = b"IDAT", zlib.compress(raw)
        case "swap":
            other = draw(st.integers(0, len(chunks) - 1))
            chunks[k], chunks[other] = chunks[other], chunks[k]
        case "drop":
            del chunks[k]
        case _:
            chunks.insert(k, chunks[k])
    return b"\x89PNG\r\n\x1a\n" + b"".join(png_chunk(name, body) for name, body in chunks)


def exr_attributes(content: bytes) -> list[tuple[int, int]]:
    """Return where the values of an EXR's header begin and how long they are [byte]."""
    found, at = [], 8
    while content[at]:
        for _ in range(2):  # name and type
            at = content.index(b"\0", at) + 1
        (size,) = struct.unpack_from("<i", content, at)
        found.append((at + 4, size))
        at += 4 + size
    return found


@st.composite
def damaged_exr(draw: st.DrawFn, sound: bytes) -> bytes:
    """Yield an EXR with a value of its header damaged: numbers in place, or another length."""
    at, size = draw(st.sampled_from(exr_attributes(sound)))
    value = sound[at : at + size]
    match draw(st.sampled_from(("number", "float", "bytes", "length"))):
        case "number" if size >= 4:
            place = 4 * draw(st.integers(0, size // 4 - 1))
            number = draw(st.sampled_from((*EXTREMES, 1000, 60000))) % 2**32
            value = value[:place] + struct.pack("<I", number) + value[place + 4 :]
        case "float" if size >= 4:
            place = 4 * draw(st.integers(0, size // 4 - 1))
            real = draw(st.sampled_from((float("nan"), float("inf"), 0.0, -1.0, 1e38, 1e-38)))
            value = value[:place] + struct.pack("<f", real) + value[place + 4 :]
        case "length":
            length = draw(st.sampled_from(EXTREMES)) % 2**32
            return sound[: at - 4] + struct.pack("<I", length) + sound[at:]
        case _:
            value = draw(damaged(value)) if size else b"\xff"
    return sound[: at - 4] + struct.pack("<i", len(value)) + value + sound[at + size :]


def damaged_glb(sound: bytes) -> Bytes:
    """Yield a GLB damaged in its bytes, its JSON or its buffer."""
    (size,) = struct.unpack_from("<I", sound, 12)
    text, binary = sound[20 : 20 + size], sound[28 + size :]
    return st.one_of(
        damaged(sound),
        damaged_json(json.loads(text), lambda text: pack_glb(text, binary)),
        damaged(binary).map(lambda binary: pack_glb(text, binary)),
    )


def damaged_safetensors(sound: bytes) -> Bytes:
    """Yield a safetensors file damaged in its bytes, its header or its numbers."""
    (size,) = struct.unpack_from("<Q", sound)
    text, numbers = sound[8 : 8 + size], sound[8 + size :]

    def pack(text: bytes, numbers: bytes = numbers) -> bytes:
        return struct.pack("<Q", len(text)) + text + numbers

    header = json.loads(text)
    strategies = [damaged(sound), damaged_json(header, pack)]
    strategies.append(damaged(numbers).map(lambda numbers: pack(text, numbers)))
    # What stands as JSON within the header's texts.
    for key, inner in header.get("__metadata__", {}).items():
        if inner.startswith("{"):

            def repack(inner: bytes, key: str = key) -> bytes:
                words = inner.decode("utf-8", "replace")
                about = {**header["__metadata__"], key: words}
                return pack(json.dumps({**header, "__metadata__": about}).encode())

            strategies.append(damaged_json(json.loads(inner), repack))
    return st.one_of(strategies)
