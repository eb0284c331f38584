"""Image files decoded: OpenImageIO, with every check that it leaves to us.

A library's return value is not proof of success: a truncated JPEG comes back as an array and an
error beside it, a FIFO blocks, and the wheel opens many formats by content. So regular files only,
magic bytes first, sizes before pixels, and the error flag after them. The library is imported
inside the functions that need it, to keep start-up short.
"""

import logging
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir import color
from warpir.errors import ExitCode, InputError

FloatArray = NDArray[np.float32]
Pixels = NDArray[Any]

_SRGB_NAMES = {"", "srgb_rec709_scene", "srgb_rec709_display", "sRGB", "g22_rec709_scene"}
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class DecodedImage:
    """What one file holds, before orientation and colour."""

    pixels: Pixels
    """Native type, as stored, shape [height, width, 1 or 3]."""
    alpha: Pixels | None
    kind: str
    orientation: int
    exposure: float
    icc: bytes | None
    focal_35mm: float | None
    notices: tuple[str, ...]


def check_regular_file(path: Path) -> int:
    """Return the size of a regular file [byte], before any library opens it (a FIFO blocks).

    Raises:
        InputError: Missing, a folder, a device, empty, or not readable.
    """
    try:
        status = path.stat()
    except FileNotFoundError as error:
        raise InputError(path, "no such file") from error
    except OSError as error:
        raise InputError(path, f"not a regular file ({error.strerror})") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a device, pipe or socket"
        raise InputError(path, f"not a regular file (found {kind})")
    if status.st_size == 0:
        raise InputError(path, "empty file")
    return status.st_size


def _sniff(path: Path) -> tuple[str, bytes]:
    """Return the kind of image by its magic bytes, and the first 64 KiB."""
    try:
        with path.open("rb") as stream:
            head = stream.read(65536)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from error
    if head.startswith(b"\xff\xd8\xff"):
        return "jpeg", head
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png", head
    if head[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"):
        return "tiff", head
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return "webp", head
    if head.startswith(b"\x76\x2f\x31\x01"):
        return "exr", head
    if head.startswith((b"#?RADIANCE", b"#?RGBE")):
        return "hdr", head
    advice = ""
    if head[4:8] == b"ftyp" and head[8:12] in (b"heic", b"heix", b"mif1", b"avif", b"crx "):
        advice = "export it as JPEG or 16-bit TIFF"
    raise InputError(
        path,
        "not an image that warpir reads (expected JPEG, PNG, TIFF, WebP, EXR or Radiance HDR)",
        advice,
    )


_OIIO_NAMES = {
    "jpeg": "jpeg",
    "png": "png",
    "tiff": "tiff",
    "webp": "webp",
    "exr": "openexr",
    "hdr": "hdr",
}


def decode_image(
    path: Path, max_pixels: int, kinds: tuple[str, ...] = tuple(_OIIO_NAMES)
) -> DecodedImage:
    """Read the pixels of one file through OpenImageIO, with every check it leaves to us.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px].
        kinds: What is accepted, of the kinds that `DecodedImage.kind` names.

    Raises:
        InputError: Missing, not an image of these kinds, truncated, too large, or of a variant
            that is not supported.
    """
    check_regular_file(path)
    kind, head = _sniff(path)
    if kind not in kinds:
        raise InputError(
            path,
            f"not of a kind that can be used here (found {kind}; expected {' or '.join(kinds)})",
        )
    import OpenImageIO as oiio

    # 64 bytes a pixel leave room for EXR layers; sizes are compared exactly below.
    oiio.attribute("limits:imagesize_MB", max(64, max_pixels * 64 // 2**20))
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    with captured_stderr():
        reader = oiio.ImageInput.open(str(path), hints)
        if reader is None:
            raise _unreadable(path, kind, library_error(oiio), max_pixels)
        try:
            if reader.format_name() != _OIIO_NAMES[kind]:
                raise InputError(
                    path,
                    f"content contradicts itself (found {kind} magic bytes, "
                    f"read as {reader.format_name()})",
                )
            spec = reader.spec()
            for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
                if width * height > max_pixels:
                    raise InputError(
                        path,
                        f"too large (found {width} x {height} pixels; expected "
                        f"at most {max_pixels})",
                        "raise --max-pixels",
                    )
            if spec.deep:
                raise InputError(path, "deep EXR images are not supported", "flatten it first")
            if spec.depth > 1:
                raise InputError(path, "volume images are not supported")
            if spec.format.basetype in (oiio.INT8, oiio.INT16, oiio.INT32, oiio.INT64, oiio.UINT64):
                raise InputError(
                    path,
                    f"pixel type not supported (found {spec.format}; expected "
                    "unsigned integers or floats)",
                )
            first, count = _choose_channels(path, spec.channelnames)
            has_alpha = spec.alpha_channel >= 0
            last = max(first + count, spec.alpha_channel + 1 if has_alpha else 0)
            try:
                pixels = reader.read_image(0, 0, first, last, spec.format)
            except MemoryError as error:
                raise InputError(
                    path, "not enough memory to decode it", code=ExitCode.RESOURCES
                ) from error
            error_text = library_error(reader)
            if pixels is None or error_text:
                raise _unreadable(path, kind, error_text, max_pixels)
            notices = _header_notices(spec, kind, head)
            part_notice = _check_parts(path, reader, spec, kind)
        finally:
            reader.close()
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, last - first)
    if kind == "exr":
        pixels = _place_in_display_window(pixels, spec)
    exposure = float(spec.getattribute("hdr:exposure") or 1.0)
    if not (np.isfinite(exposure) and exposure > 0.0):
        raise InputError(path, f"EXPOSURE is not a positive number (found {exposure})")
    profile = spec.getattribute("ICCProfile")
    focal = spec.getattribute("Exif:FocalLengthIn35mmFilm")
    return DecodedImage(
        pixels=pixels[..., :count],
        alpha=pixels[..., spec.alpha_channel - first] if has_alpha else None,
        kind=kind,
        orientation=int(spec.getattribute("Orientation") or 1),
        exposure=exposure,
        icc=bytes(profile) if profile is not None and count == 3 else None,
        focal_35mm=float(focal) if focal and 1.0 <= float(focal) <= 10000.0 else None,
        notices=(*notices, *part_notice),
    )


def _choose_channels(path: Path, names: tuple[str, ...]) -> tuple[int, int]:
    """Return the first colour channel and their count, 1 or 3; OpenImageIO puts RGB first."""
    if names[:3] == ("R", "G", "B"):
        return 0, 3
    if "RY" in names or "BY" in names:
        raise InputError(path, "luminance/chroma EXR is not supported", "save it as RGB")
    if "Y" in names or len(names) == 1:
        return (names.index("Y") if "Y" in names else 0), 1
    layers = sorted({name.rpartition(".")[0] for name in names if "." in name})
    raise InputError(
        path,
        f"no RGB channels (found {', '.join(names[:24])}; expected R, G, B)",
        f"save one layer as plain RGB: {', '.join(layers[:12])}" if layers else "",
    )


def _header_notices(spec: Any, kind: str, head: bytes) -> list[str]:
    """Say what the header tells about colour and content that is not followed."""
    notices = []
    if (
        spec.getattribute("jpeg:ColorSpace") in ("CMYK", "YCCK")
        or spec.getattribute("tiff:ColorSpace") == "CMYK"
    ):
        notices.append("CMYK converted without its profile; export as RGB for exact colours")
    if spec.getattribute("Exif:ColorSpace") == 65535:
        notices.append("EXIF says uncalibrated colour; its profile, or else sRGB, is used")
    space = str(spec.getattribute("oiio:ColorSpace") or "")
    if kind == "png" and spec.getattribute("ICCProfile") is None and space not in _SRGB_NAMES:
        notices.append(f"colour space {space} of the header is not followed: taken as sRGB")
    primaries = spec.getattribute("chromaticities")
    if primaries is not None and not np.allclose(primaries, color.REC709_CHROMATICITIES, atol=2e-3):
        notices.append("chromaticities of the header are not Rec.709 and are not followed")
    if kind == "jpeg" and (b"hdrgm:" in head or b"hdr-gain-map" in head):
        notices.append("gain map ignored: read as its base image")
    if kind == "png" and b"acTL" in head[:4096]:
        notices.append("animated: first frame used")
    return notices


def _check_parts(path: Path, reader: Any, spec: Any, kind: str) -> list[str]:
    """Notice further pages; of an EXR, whose later parts may be cut off, read them all."""
    if kind not in ("exr", "tiff", "webp") or not reader.seek_subimage(1, 0):
        reader.geterror()
        return []
    if kind != "exr":
        return ["more than one page or frame: the first is used"]
    parts = int(spec.getattribute("oiio:subimages") or 1)
    readable = 1
    for part in range(1, parts):
        if not reader.seek_subimage(part, 0):
            break
        other = reader.spec()
        planes = (
            None if other.deep else reader.read_image(part, 0, 0, other.nchannels, other.format)
        )
        readable += planes is not None and not library_error(reader)
    if readable < parts:
        raise InputError(path, f"truncated or corrupt ({readable} of {parts} parts readable)")
    return [f"{parts} parts: the first is used"]


def _place_in_display_window(pixels: Pixels, spec: Any) -> Pixels:
    """Crop or pad the data window of an EXR, with zeros, to its display window."""
    if (spec.x, spec.y, spec.width, spec.height) == (
        spec.full_x,
        spec.full_y,
        spec.full_width,
        spec.full_height,
    ):
        return pixels
    placed = np.zeros((spec.full_height, spec.full_width, pixels.shape[-1]), pixels.dtype)
    x0, y0 = max(spec.x, spec.full_x), max(spec.y, spec.full_y)
    x1 = min(spec.x + spec.width, spec.full_x + spec.full_width)
    y1 = min(spec.y + spec.height, spec.full_y + spec.full_height)
    if x1 > x0 and y1 > y0:
        placed[y0 - spec.full_y : y1 - spec.full_y, x0 - spec.full_x : x1 - spec.full_x] = pixels[
            y0 - spec.y : y1 - spec.y, x0 - spec.x : x1 - spec.x
        ]
    return placed


def upright(pixels: Pixels, orientation: int) -> Pixels:
    """Apply the EXIF orientation (tag 0x0112), shape [height, width, channel]."""
    turned = {
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.swapaxes(0, 1),
        6: lambda a: np.rot90(a, -1),
        7: lambda a: np.rot90(a, 2).swapaxes(0, 1),
        8: lambda a: np.rot90(a, 1),
    }
    return turned[orientation](pixels) if orientation in turned else pixels


def _unreadable(path: Path, kind: str, text: str, max_pixels: int) -> InputError:
    """Word a failure of the decoder."""
    if any(word in text for word in ("exceed", "claims a", "claimed to be")):
        return InputError(
            path,
            f"the header claims too large an image ({one_line(text)}; "
            f"expected at most {max_pixels} pixels)",
            "raise --max-pixels if the file is sound",
        )
    if kind == "hdr" and "FORMAT" in text:
        return InputError(
            path,
            "not 32-bit_rle_rgbe (XYZE files are not supported)",
            "save it as RGBE .hdr or as EXR",
        )
    reason = one_line(text) or "the decoder gave no reason"
    return InputError(
        path,
        f"truncated, corrupt or of an unsupported variant of {kind} ({reason})",
        "check that the file was copied or downloaded completely",
    )


def library_error(source: Any) -> str:
    """Return OpenImageIO's pending error; on garbage it may itself be undecodable."""
    try:
        return str(source.geterror())
    except UnicodeDecodeError:
        return "unreadable header"


def one_line(text: str) -> str:
    """Return the first line of a library's text, 160 characters at most."""
    return " ".join(text.split("\n", 1)[0].split())[:160]


@contextmanager
def captured_stderr() -> Iterator[None]:
    """Keep what C libraries print (libpng does) off the terminal; it goes to the debug log."""
    try:
        saved = os.dup(2)
    except OSError:  # no stderr at all
        yield
        return
    with tempfile.TemporaryFile() as sink:
        os.dup2(sink.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            sink.seek(0)
            noise = sink.read(4096).decode("utf-8", "replace").strip()
            if noise:
                _LOG.debug("image library: %s", noise)
