"""Image files made by code, for the tests of what is read and written."""

import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
from PIL import Image

from tests.oracles import texel_direction
from warpir.io.results import OutputFolder

OIIO_TYPES = {"uint8": "uint8", "uint16": "uint16", "float16": "half", "float32": "float"}


def write_image(path: Path, pixels: np.ndarray, **attributes: Any) -> Path:
    """Write by OpenImageIO in the array's own type."""
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, OIIO_TYPES[pixels.dtype.name])
    for name, value in attributes.items():
        if isinstance(value, bytes):
            spec.attribute(name, oiio.TypeDesc(f"uint8[{len(value)}]"), value)
        else:
            spec.attribute(name, value)
    writer = oiio.ImageOutput.create(str(path))
    assert writer.open(str(path), spec), oiio.geterror()
    assert writer.write_image(pixels)
    assert writer.close()
    return path


def codes8(rng: np.random.Generator, height: int = 24, width: int = 36) -> np.ndarray:
    return rng.integers(0, 256, (height, width, 3), dtype=np.uint8)


def png_chunk(name: bytes, content: bytes) -> bytes:
    body = name + content
    return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))


def png_of(*chunks: bytes, size: tuple[int, int] = (48, 32)) -> bytes:
    """A PNG of 8-bit RGB of that width and height whose other chunks are given."""
    header = struct.pack(">IIBBBBB", *size, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + png_chunk(b"IHDR", header) + b"".join(chunks)


def png_header(width: int, height: int) -> bytes:
    """A PNG of a few bytes that claims a size and holds no pixel."""
    rest = png_chunk(b"IDAT", zlib.compress(b"")), png_chunk(b"IEND", b"")
    return png_of(*rest, size=(width, height))


def fixed(*values: float) -> bytes:
    """Numbers as a profile holds them, s15Fixed16."""
    return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))


def matrix_profile(primaries: str) -> bytes:
    """An ICC v2 matrix profile made from bytes: gamma 2.2, Display P3 or Rec.709 primaries."""
    columns = {  # D50-adapted
        "p3": [[0.51512, 0.24120, -0.00105], [0.29198, 0.69225, 0.04189],
               [0.15710, 0.06657, 0.78407]],
        "709": [[0.43607, 0.22249, 0.01392], [0.38515, 0.71687, 0.09708],
                [0.14307, 0.06061, 0.71410]],
    }[primaries]  # fmt: skip

    tags = {}
    for letter, column in zip(b"rgb", columns, strict=True):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ \0\0\0\0" + fixed(*column)
        tags[bytes([letter]) + b"TRC"] = b"curv\0\0\0\0" + struct.pack(">IHxx", 1, 563)  # 2.2
    return icc_profile(b"RGB ", tags)


LOBES = {  # one colour per horizontal axis: enough to tell turns and mirror images apart
    (1, 0, 0): (1.0, 0.0, 0.0),
    (-1, 0, 0): (0.0, 1.0, 1.0),
    (0, 0, 1): (0.0, 1.0, 0.0),
    (0, 0, -1): (1.0, 0.0, 1.0),
}


def four_lobes(height: int) -> np.ndarray:
    """The map of `LOBES` under a brighter sky, shape [height, 2 height, 3]."""
    directions = texel_direction(height, 2 * height)
    texels = np.zeros(directions.shape, np.float32)
    for axis, rgb in LOBES.items():
        strength = np.exp(20.0 * (directions @ np.array(axis, float) - 1.0))[..., None]
        texels += (strength * np.array(rgb)).astype(np.float32)
    return texels + np.float32(0.125) * (directions[..., 1:2] > 0)  # brighter sky: up is up


def icc_profile(space: bytes, tags: dict[bytes, bytes]) -> bytes:
    """An ICC v2 display profile made from its tags; a white point and texts are added."""
    tags = {
        b"desc": b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(82),
        b"cprt": b"text\0\0\0\0none\0\0\0\0",
        b"wtpt": b"XYZ \0\0\0\0" + fixed(0.9642, 1.0, 0.8249),
        **tags,
    }
    offset, table, body = 132 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        table += name + struct.pack(">II", offset + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    size = offset + len(body)
    head = struct.pack(">I4xI4s4s4s", size, 0x02400000, b"mntr", space, b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28)
    return (head + fixed(0.9642, 1.0, 0.8249)).ljust(128, b"\0") + table + body


def table_profile(columns: np.ndarray) -> bytes:
    """A profile of gamma 2.2 whose tables (lut16Type) say what a matrix profile would say."""
    curve = np.round((np.arange(256) / 255.0) ** 2.2 * 65535.0).astype(int).tolist()
    corners = [
        round(float(columns[k] @ (r, g, b)) / (1.0 + 32767.0 / 32768.0) * 65535.0)
        for r in (0, 1) for g in (0, 1) for b in (0, 1) for k in range(3)
    ]  # fmt: skip
    matrix = struct.pack(">9i", 65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
    table = b"mft2\0\0\0\0" + bytes([3, 3, 2, 0]) + matrix + struct.pack(">2H", 256, 2)
    numbers = [*curve * 3, *(min(max(c, 0), 65535) for c in corners), *[0, 65535] * 3]
    table += struct.pack(f">{len(numbers)}H", *numbers)
    return icc_profile(b"RGB ", {b"A2B0": table})


def with_chunks(path: Path, codes: np.ndarray, *chunks: bytes, **options: Any) -> Path:
    """Write a PNG with further chunks behind its header."""
    Image.fromarray(codes).save(path, **options)
    content = path.read_bytes()
    path.write_bytes(content[:33] + b"".join(chunks) + content[33:])
    return path


def write_envmap(folder: Path, name: str, texels: np.ndarray, kind: str = "exr") -> Path:
    """Write one panorama and nothing else into a folder, which need not be there."""
    with OutputFolder(folder / "made", overwrite=True) as output:
        output.write_envmap(texels, name)
    path = (folder / "made" / f"{name}.{kind}").rename(folder / f"{name}.{kind}")
    shutil.rmtree(folder / "made")
    return path
