"""Image files made by code, for the tests of what is read and written."""

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio

OIIO_TYPES = {"uint8": "uint8", "uint16": "uint16", "float16": "half", "float32": "float"}


def write_image(path: Path, pixels: np.ndarray, **attributes: Any) -> Path:
    """Write by OpenImageIO in the array's own type."""
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, OIIO_TYPES[pixels.dtype.name])
    for name, value in attributes.items():
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


def matrix_profile(primaries: str) -> bytes:
    """An ICC v2 matrix profile made from bytes: gamma 2.2, Display P3 or Rec.709 primaries."""
    columns = {  # D50-adapted
        "p3": [[0.51512, 0.24120, -0.00105], [0.29198, 0.69225, 0.04189],
               [0.15710, 0.06657, 0.78407]],
        "709": [[0.43607, 0.22249, 0.01392], [0.38515, 0.71687, 0.09708],
                [0.14307, 0.06061, 0.71410]],
    }[primaries]  # fmt: skip

    def fixed(*values: float) -> bytes:
        return struct.pack(f">{len(values)}i", *(round(value * 65536) for value in values))

    tags = {b"wtpt": b"XYZ \0\0\0\0" + fixed(0.9642, 1.0, 0.8249)}
    for letter, column in zip(b"rgb", columns, strict=True):
        tags[bytes([letter]) + b"XYZ"] = b"XYZ \0\0\0\0" + fixed(*column)
        tags[bytes([letter]) + b"TRC"] = b"curv\0\0\0\0" + struct.pack(">IHxx", 1, 563)  # 2.2
    tags[b"desc"] = b"desc\0\0\0\0" + struct.pack(">I", 5) + b"test\0" + bytes(82)
    tags[b"cprt"] = b"text\0\0\0\0none\0\0\0\0"
    offset, table, body = 128 + 4 + 12 * len(tags), struct.pack(">I", len(tags)), b""
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += name + struct.pack(">II", offset + len(body), len(content))
        body += content
    size = 128 + len(table) + len(body)
    head = struct.pack(">I4sI4s4s4s", size, bytes(4), 0x02400000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28)
    head += fixed(0.9642, 1.0, 0.8249)
    return head.ljust(128, b"\0") + table + body


def directions(height: int) -> np.ndarray:
    """Direction of each texel centre, written out from the convention sheet, [He, 2 He, 3]."""
    width = 2 * height
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height
    lon, lat = np.pi * (1 - 2 * u), np.pi * (0.5 - v)
    return np.stack(
        [
            np.sin(lon)[None] * np.cos(lat)[:, None],
            np.repeat(np.sin(lat)[:, None], width, axis=1),
            np.cos(lon)[None] * np.cos(lat)[:, None],
        ],
        axis=-1,
    )


LOBES = {  # one colour per horizontal axis: enough to tell turns and mirror images apart
    (1, 0, 0): (1.0, 0.0, 0.0),
    (-1, 0, 0): (0.0, 1.0, 1.0),
    (0, 0, 1): (0.0, 1.0, 0.0),
    (0, 0, -1): (1.0, 0.0, 1.0),
}


def four_lobes(directions: np.ndarray) -> np.ndarray:
    texels = np.zeros(directions.shape, np.float32)
    for axis, rgb in LOBES.items():
        strength = np.exp(20.0 * (directions @ np.array(axis, float) - 1.0))[..., None]
        texels += (strength * np.array(rgb)).astype(np.float32)
    return texels + np.float32(0.125) * (directions[..., 1:2] > 0)  # brighter sky: up is up
