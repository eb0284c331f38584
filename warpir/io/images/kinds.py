"""What kind of image a file is, by its content, before any library opens it."""

from __future__ import annotations

import re
import stat
import struct
import threading
from pathlib import Path
from typing import IO, TYPE_CHECKING

from warpir.core.errors import InputError

if TYPE_CHECKING:
    from PIL import Image

_MAGIC = {
    "jpeg": (b"\xff\xd8\xff",),
    "png": (b"\x89PNG\r\n\x1a\n",),
    "tiff": (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"),
    "webp": (b"RIFF",),
    "exr": (b"\x76\x2f\x31\x01",),
    "hdr": (b"#?RADIANCE", b"#?RGBE"),
}
KINDS = tuple(_MAGIC)
"""Kinds that are read."""
_MARKER = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")
"""Start of a segment of a JPEG, which its length follows (ITU-T T.81, B.1.1); between a scan's
header and the next one stands its data, in which a byte of 255 is followed by none of these."""
_START_OF_SCAN, _END_OF_IMAGE = 0xDA, 0xD9
_MOST_READ = 1 << 28
"""More than a picture has that is not refused for its pixels [byte]; a phone may append a film."""
_MOST_SCANS = 100
"""Scans of a JPEG; encoders write about 10, and each of them costs a pass over the picture."""

_OPENING = threading.Lock()


def open_by_pillow(file: Path | IO[bytes], formats: tuple[str, ...] | None = None) -> Image.Image:
    """Open as ``PIL.Image.open``, without Pillow's limit of pixels: ours may be raised.

    For other users of Pillow in this process the limit stays.
    """
    from PIL import Image

    with _OPENING:
        limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            return Image.open(file, formats=formats)
        finally:
            Image.MAX_IMAGE_PIXELS = limit


def check_regular_file(path: Path) -> None:
    """Refuse what is no regular file, before any library opens it (a FIFO blocks).

    Raises:
        InputError: Missing, a folder, a device, empty, or not readable.
    """
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(path, "no such file", reason="file.missing") from error
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        what = f"not a regular file ({reason})"
        raise InputError(path, what, reason="file.not_regular") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, pipe or socket"
        what = f"not a regular file (found {kind})"
        raise InputError(path, what, reason="file.not_regular", found=kind)
    if status.st_size == 0:
        raise InputError(path, "empty file", reason="file.empty")


def sniff(path: Path) -> tuple[str, bytes]:
    """Return the kind of image by its magic bytes, and the first 64 KiB.

    Raises:
        InputError: It is of none of `KINDS`, or cannot be read.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(65536)
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(path, what, reason="file.unreadable") from error
    for kind, starts in _MAGIC.items():
        if head.startswith(starts) and (kind != "webp" or head[8:12] == b"WEBP"):
            if kind == "tiff" and _is_raw_tiff(head):
                what = "a camera raw file (what it holds as a picture is a thumbnail)"
                advice = "export it as JPEG or 16-bit TIFF"
                raise InputError(path, what, advice, reason="image.kind", found="camera raw")
            return kind, head
    found = _foreign_kind(head)
    raise InputError(
        path,
        f"not an image that warpir reads ({f'found {found}; ' if found else ''}"
        "expected JPEG, PNG, TIFF, WebP, EXR or Radiance HDR)",
        "export it as JPEG or 16-bit TIFF" if found else "",
        reason="image.kind",
        found=found,
    )


def start_of(path: Path) -> bytes:
    """Return what is looked at of a JPEG, `_MOST_READ` bytes at most."""
    with path.open("rb") as stream:
        return stream.read(_MOST_READ)


def check_scans(path: Path) -> None:
    """Refuse a JPEG of so many scans that it takes minutes to decode.

    What a phone appends to its picture, such as a motion photo's film, is not counted.

    Raises:
        InputError: More than `_MOST_SCANS`.
    """
    content = start_of(path)
    scans, at = 0, 2
    while (found := _MARKER.search(content, at)) and (marker := found[0][1]) != _END_OF_IMAGE:
        scans += marker == _START_OF_SCAN
        at = found.end() + max(int.from_bytes(content[found.end() : found.end() + 2]), 2)
    if scans > _MOST_SCANS:
        what = f"a JPEG of too many scans (found {scans}; limit {_MOST_SCANS})"
        raise InputError(path, what, "save it anew", reason="image.scans", found=scans)


_FOREIGN_KINDS = {
    "camera raw": (b"IIRO", b"IIRS", b"MMOR", b"IIU\0", b"FUJIFILMCCD-RAW", b"FOVb"),
    "JPEG XL": (b"\xff\x0a", b"\0\0\0\x0cJXL "),
    "JPEG 2000": (b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"),
    "GIF": (b"GIF8",),
    "BMP": (b"BM",),
    "Photoshop": (b"8BPS",),
    "PDF": (b"%PDF",),
    "PostScript": (b"%!PS",),
}
_BRANDS = {
    **dict.fromkeys((b"avif", b"avis"), "AVIF"),
    b"crx ": "camera raw",
    **dict.fromkeys((b"heic", b"heix", b"heim", b"heis", b"hevc", b"mif1", b"msf1"), "HEIC"),
}
"""Brands of the ISO base media format; the others are films (MP4, MOV)."""
_NEW_SUBFILE_TYPE, _DNG_VERSION = 254, 50706
"""TIFF tags; bit 0 of the first says that a picture is a reduced version of another."""


def _foreign_kind(head: bytes) -> str:
    """Return the name of a kind of image that people have but that is not read, or nothing."""
    if head[4:8] == b"ftyp":
        return _BRANDS.get(head[8:12], "a film")
    return next((name for name, starts in _FOREIGN_KINDS.items() if head.startswith(starts)), "")


def _is_raw_tiff(head: bytes) -> bool:
    """Tell camera raw by its first directory: what a TIFF reader shows of it is a thumbnail."""
    if head[8:10] == b"CR":  # Canon CR2
        return True
    order = "<" if head[:2] == b"II" else ">"
    try:
        (start,) = struct.unpack_from(f"{order}I", head, 4)
        (count,) = struct.unpack_from(f"{order}H", head, start)
        for k in range(count):
            tag, _, _, value = struct.unpack_from(f"{order}HHII", head, start + 2 + 12 * k)
            if tag == _DNG_VERSION or (tag == _NEW_SUBFILE_TYPE and value & 1):
                return True
    except struct.error:  # a directory behind the head: not how cameras write
        pass
    return False
