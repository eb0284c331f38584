"""Image files decoded: OpenImageIO, with every check that it leaves to us.

A library's return value is not proof of success: a truncated JPEG comes back as an array and an
error beside it, a FIFO blocks, and the wheel opens many formats by content. So regular files only,
magic bytes first, sizes before pixels, and the error flag after them. The library is imported
inside the functions that need it, to keep start-up short.
"""

import logging
import os
import re
import stat
import struct
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core import color
from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.errors import ExitCode, InputError

_LOG = logging.getLogger(__name__)


EXPOSURE_LIMIT = 1e12
"""Largest product of a Radiance file's exposures, and its inverse the least [1]."""


@dataclass(frozen=True)
class DecodedImage:
    """What one file holds, before orientation and colour."""

    pixels: PixelArray
    """Native type, as stored, shape [height, width, 1 or 3]."""
    alpha: PixelArray | None
    kind: str
    orientation: int
    icc: bytes | None
    primaries: tuple[float, ...] | None
    """Chromaticities of a float image that are not Rec.709: xy of red, green, blue and white."""
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
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise InputError(path, f"not a regular file ({reason})") from error
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
        if _is_raw_tiff(head):
            what = "a camera raw file (what it holds as a picture is a thumbnail)"
            raise InputError(path, what, "export it as JPEG or 16-bit TIFF")
        return "tiff", head
    if head.startswith(b"RIFF") and head[8:12] == b"WEBP":
        return "webp", head
    if head.startswith(b"\x76\x2f\x31\x01"):
        return "exr", head
    if head.startswith((b"#?RADIANCE", b"#?RGBE")):
        return "hdr", head
    found = _foreign_kind(head)
    raise InputError(
        path,
        f"not an image that warpir reads ({f'found {found}; ' if found else ''}"
        "expected JPEG, PNG, TIFF, WebP, EXR or Radiance HDR)",
        "export it as JPEG or 16-bit TIFF" if found else "",
    )


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
_BRANDS = {b"avif": "AVIF", b"avis": "AVIF", b"crx ": "camera raw"}
_NEW_SUBFILE_TYPE, _DNG_VERSION = 254, 50706
"""TIFF tags; bit 0 of the first says that a picture is a reduced version of another."""


def _foreign_kind(head: bytes) -> str:
    """Return the name of a kind of image that people have but that is not read, or nothing."""
    if head[4:8] == b"ftyp":
        return _BRANDS.get(head[8:12], "HEIC")
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


_OIIO_NAMES = {
    "jpeg": "jpeg",
    "png": "png",
    "tiff": "tiff",
    "webp": "webp",
    "exr": "openexr",
    "hdr": "hdr",
}


def decode_image(
    path: Path,
    max_pixels: int,
    kinds: tuple[str, ...] = tuple(_OIIO_NAMES),
    layer: str | None = None,
    flag: str = "--max-pixels",
) -> DecodedImage:
    """Read the pixels of one file through OpenImageIO, with every check it leaves to us.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px].
        kinds: What is accepted, of the kinds that `DecodedImage.kind` names.
        layer: Of an EXR, the layer or part whose R, G and B are read.
        flag: What raises ``max_pixels``.

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
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        what = "its name is not UTF-8, which the decoder needs"
        raise InputError(path, what, "rename it") from error
    import OpenImageIO as oiio

    # 64 bytes a pixel leave room for EXR layers; sizes are compared exactly below.
    _limit_bytes(max_pixels * 64)
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    with captured_stderr():
        reader = oiio.ImageInput.open(str(path), hints)
        if reader is None:
            raise _unreadable(path, kind, library_error(oiio), max_pixels, flag)
        try:
            if reader.format_name() != _OIIO_NAMES[kind]:
                raise InputError(
                    path,
                    f"content contradicts itself (found {kind} magic bytes, "
                    f"read as {reader.format_name()})",
                )
            specs, error_text = _parts(reader, kind)
            if _is_too_large(error_text):
                raise _unreadable(path, kind, error_text, max_pixels, flag)
            part, channels, alpha = _choose_channels(path, kind, specs, layer)
            spec = specs[part]
            for other in specs:
                _check_size(path, other, max_pixels, flag)
            _check_spec(path, spec)
            wanted = channels if alpha is None else [*channels, alpha]
            first, last = min(wanted), max(wanted) + 1
            try:
                pixels = reader.read_image(part, 0, first, last, spec.format)
            except MemoryError as error:
                raise InputError(
                    path, "not enough memory to decode it", code=ExitCode.RESOURCES
                ) from error
            error_text = library_error(reader)
            if pixels is None or error_text:
                raise _unreadable(path, kind, error_text, max_pixels, flag)
            notices = _header_notices(spec, kind, head)
            notices += _check_parts(path, reader, specs, part, kind)
        finally:
            reader.close()
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, last - first)
    if kind == "exr":
        pixels = _place_in_display_window(pixels, spec)
    if kind == "hdr":
        pixels = pixels / np.float32(_exposure(path, head))
    primaries = None
    if pixels.dtype.kind == "f":
        primaries, unknown = _stated_primaries(spec, kind, head)
        notices += unknown
    profile = spec.getattribute("ICCProfile")
    if not isinstance(profile, bytes | np.ndarray):  # an EXR may call anything so
        profile = None
    # Tags of another type than they should have come back as the default.
    focal = spec.get_float_attribute("Exif:FocalLengthIn35mmFilm", 0.0)
    chosen: Any = [channel - first for channel in channels]
    if chosen == [*range(chosen[0], chosen[0] + len(chosen))]:
        chosen = slice(chosen[0], chosen[0] + len(chosen))  # no copy
    return DecodedImage(
        pixels=pixels[..., chosen],
        alpha=pixels[..., alpha - first] if alpha is not None else None,
        kind=kind,
        orientation=spec.get_int_attribute("Orientation", 1),
        icc=bytes(profile) if profile is not None else None,
        primaries=primaries,
        focal_35mm=focal if 1.0 <= focal <= 10000.0 else None,
        notices=tuple(notices),
    )


def read_exr_header(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Read attributes of an EXR header; ``size`` is the display window's [px], absent is None.

    Raises:
        InputError: Missing or not an EXR file.
    """
    check_regular_file(path)
    import OpenImageIO as oiio

    with captured_stderr():
        reader = oiio.ImageInput.open(str(path))
        if reader is None or reader.format_name() != "openexr":
            raise InputError(path, f"not an EXR file ({library_error(oiio)[:80]})")
        spec = reader.spec()
        reader.close()
    attributes = {name: spec.getattribute(name) for name in names}
    return {"size": (spec.full_width, spec.full_height), **attributes}


def read_exr_channels(path: Path, max_pixels: int) -> dict[str, FloatArray]:
    """Read every channel of an EXR file's first part by its full name, shape [H, W] each.

    Args:
        path: The file.
        max_pixels: Largest image decoded [px].

    Raises:
        InputError: Missing, not an EXR file, too large, deep, truncated or corrupt.
    """
    check_regular_file(path)
    import OpenImageIO as oiio

    # 256 bytes a pixel: all layers of a run take 136 in float32.
    _limit_bytes(max_pixels * 256)
    with captured_stderr():
        reader = oiio.ImageInput.open(str(path))
        if reader is None or reader.format_name() != "openexr":
            raise InputError(path, f"not an EXR file ({library_error(oiio)[:80]})")
        try:
            spec = reader.spec()
            _check_size(path, spec, max_pixels, "--max-pixels")
            _check_spec(path, spec)
            pixels = reader.read_image(0, 0, 0, spec.nchannels, "float")
            error_text = library_error(reader)
        finally:
            reader.close()
    if pixels is None or error_text:
        raise _unreadable(path, "exr", error_text, max_pixels, "--max-pixels")
    return {name: pixels[..., k] for k, name in enumerate(spec.channelnames)}


def _limit_bytes(count: int) -> None:
    """Tell the library the most that an image may take [byte]."""
    import OpenImageIO as oiio

    oiio.attribute("limits:imagesize_MB", min(max(64, count // 2**20), 2**31 - 1))


def _parts(reader: Any, kind: str) -> tuple[list[Any], str]:
    """Return the headers of an EXR's parts, as far as they are readable; of others, the first.

    And what was wrong with the next one, if anything.
    """
    specs = [reader.spec()]
    while kind == "exr" and reader.seek_subimage(len(specs), 0):
        specs.append(reader.spec())
    text = library_error(reader)
    reader.seek_subimage(0, 0)
    return specs, text


def _check_size(path: Path, spec: Any, max_pixels: int, flag: str) -> None:
    """Refuse an image or a part that is too large, before a pixel is decoded."""
    for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
        if width * height > max_pixels:
            raise InputError(
                path,
                f"too large (found {width} x {height} pixels; limit {max_pixels}); "
                f"{flag} raises it",
            )


def _check_spec(path: Path, spec: Any) -> None:
    """Refuse a kind of image that a header announces, before a pixel is decoded."""
    import OpenImageIO as oiio

    if spec.deep:
        raise InputError(path, "deep EXR images are not supported", "flatten it first")
    if spec.depth > 1:
        raise InputError(path, "volume images are not supported")
    if spec.format.basetype not in (oiio.UINT8, oiio.UINT16, oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        raise InputError(
            path,
            f"pixel type not supported (found {spec.format}; expected unsigned integers of 8 or "
            "16 bits, or floats)",
        )
    if "LAB" in str(spec.getattribute("tiff:ColorSpace") or "").upper():
        raise InputError(path, "CIE Lab images are not supported", "save it as RGB")


def _choose_channels(
    path: Path, kind: str, specs: list[Any], layer: str | None
) -> tuple[int, list[int], int | None]:
    """Return the part, its colour channels, 3 or 1, and its alpha channel."""
    if layer is not None and kind != "exr":
        raise InputError(path, f"has no layers (found {kind}; expected EXR)", "leave --layer out")
    if kind != "exr":
        spec = specs[0]
        alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
        if spec.channelnames[:3] == ("R", "G", "B"):
            return 0, [0, 1, 2], alpha
        if spec.channelnames not in (("Y",), ("Y", "A")):
            # Such as a palette with alpha, whose codes OpenImageIO mixes up.
            found = ", ".join(spec.channelnames[:24])
            what = f"a variant of {kind} that is not supported (found channels {found})"
            raise InputError(path, what, "save it as RGB or greyscale")
        return 0, [0], alpha
    for wanted in (("r", "g", "b"), ("y",)):
        for part, spec in enumerate(specs):
            names = [name.lower() for name in spec.channelnames]
            is_part = layer is not None and _part_name(spec) == layer
            prefix = "" if layer is None or is_part else f"{layer.lower()}."
            if {f"{prefix}ry", f"{prefix}by"} & set(names):
                raise InputError(path, "luminance/chroma EXR is not supported", "save it as RGB")
            if all(prefix + name in names for name in wanted):
                colors = [names.index(prefix + name) for name in wanted]
                alpha = names.index(f"{prefix}a") if f"{prefix}a" in names else None
                return part, colors, alpha
    names = [name for spec in specs for name in spec.channelnames]
    layers = {name.rpartition(".")[0] for name in names if re.search(r"\.[RrYy]$", name)}
    layers |= {_part_name(s) for s in specs[1:] if {"R", "G", "B"} <= set(s.channelnames)}
    what = "no RGB channels" if layer is None else f"no layer {layer!a} with R, G and B"
    expected = "R, G, B" if layer is None else f"{layer}.R, {layer}.G, {layer}.B"
    raise InputError(
        path,
        f"{what} (found {', '.join(names[:24])}; expected {expected})",
        f"layers that it has: {', '.join(sorted(layers)[:12])} (--layer)" if layers else "",
    )


def _part_name(spec: Any) -> str:
    return str(spec.getattribute("oiio:subimagename") or "")


def _exposure(path: Path, head: bytes) -> float:
    """Return by what the values of a Radiance file were multiplied [1].

    Every program on the way adds its line; OpenImageIO knows the last one alone.
    """
    exposure = 1.0
    for line in _radiance_lines(head, b"EXPOSURE"):
        try:
            exposure *= float(line)
        except ValueError:
            exposure = np.nan
    if not 1.0 / EXPOSURE_LIMIT <= exposure <= EXPOSURE_LIMIT:
        expected = f"{1.0 / EXPOSURE_LIMIT:g} to {EXPOSURE_LIMIT:g}"
        what = f"EXPOSURE is not such a number (found {exposure:g}; expected {expected})"
        raise InputError(path, what, "correct or remove the EXPOSURE lines of its header")
    return exposure


def _radiance_lines(head: bytes, name: bytes) -> list[bytes]:
    """Return the values of all lines of one name in the header of a Radiance file."""
    header = re.split(rb"\r?\n\r?\n", head, maxsplit=1)[0]
    return re.findall(rb"\n" + name + rb"=([^\r\n]*)", header)


def _stated_primaries(
    spec: Any, kind: str, head: bytes
) -> tuple[tuple[float, ...] | None, list[str]]:
    """Return the chromaticities of a float file, None for Rec.709, and what is not followed."""
    stated = spec.getattribute("chromaticities")
    space = str(spec.getattribute("colorInteropID") or "")
    lines = _radiance_lines(head, b"PRIMARIES") if kind == "hdr" else []
    lines = [line for line in lines if set(line.split()) != {b"0"}]  # Photoshop's "not stated"
    if lines:
        with suppress(ValueError):
            stated = [float(number) for number in lines[-1].split()]
    elif stated is None and space in color.INTEROP_SPACES:
        stated = color.chromaticities_of(color.INTEROP_SPACES[space])
    elif stated is None:
        is_ours = space in ("", "unknown", "data", "lin_rec709_scene")
        return None, [] if is_ours else [f"colour space {space} is not followed"]
    if not isinstance(stated, tuple | list) or len(stated) != 8 or not color.are_primaries(stated):
        return None, ["primaries of the header are broken: taken as Rec.709"]
    if np.allclose(stated, color.REC709_CHROMATICITIES, atol=2e-3):
        return None, []
    return tuple(float(number) for number in stated), []


_GAIN_MAPS = (b"hdrgm:", b"hdr-gain-map", b"hdrgainmap", b"urn:iso:std:iso:ts:21496")
_PNG_PALETTE = 3
"""Colour type in a PNG's IHDR, byte 25 of the file."""


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
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)
    if kind == "exr" and abs(aspect - 1.0) > 1e-3:
        notices.append(f"pixel aspect ratio {aspect:g} is not followed: pixels are taken as square")
    corrections = _radiance_lines(head, b"(?:GAMMA|COLORCORR)") if kind == "hdr" else []
    if any(set(line.split()) - {b"1", b"1.0"} for line in corrections):
        notices.append("GAMMA and COLORCORR of the header are not followed")
    if kind == "jpeg" and any(name in head for name in _GAIN_MAPS):
        notices.append("gain map ignored: read as its base image")
    if kind == "png" and b"acTL" in head[:4096]:
        notices.append("animated: first frame used")
    if (kind == "png" and head[25] == _PNG_PALETTE) or (
        spec.getattribute("tiff:ColorSpace") == "palette"
    ):
        notices.append("palette expanded to RGB")
    return notices


def _check_parts(path: Path, reader: Any, specs: list[Any], used: int, kind: str) -> list[str]:
    """Notice further pages; of an EXR, whose other parts may be cut off, see that they are there.

    Of those the first and the last rows are read: more would be no use, and may be a lot.
    """
    if kind in ("tiff", "webp") and reader.seek_subimage(1, 0):
        return ["more than one page or frame: the first is used"]
    library_error(reader)
    parts = specs[0].get_int_attribute("oiio:subimages", 1)
    if kind != "exr" or parts == 1:
        return []
    readable = 1
    for part, other in enumerate(specs):
        if part == used:
            continue
        ends = () if other.deep else (other.y, other.y + other.height - 1)
        rows = [_read_row(reader, part, other, y) for y in ends]
        readable += all(row is not None for row in rows) and not library_error(reader)
    if readable < parts:
        raise InputError(path, f"truncated or corrupt ({readable} of {parts} parts readable)")
    return [f"{parts} parts: {'the first' if used == 0 else f'number {used + 1}'} is used"]


def _read_row(reader: Any, part: int, spec: Any, y: int) -> PixelArray | None:
    """Return one row of a part of an EXR, or the row of tiles around it; None where it is cut."""
    row: PixelArray | None
    if not spec.tile_height:
        row = reader.read_scanlines(part, 0, y, y + 1, 0, 0, spec.nchannels, spec.format)
        return row
    top = y - (y - spec.y) % spec.tile_height
    bottom = min(top + spec.tile_height, spec.y + spec.height)
    left, right = spec.x, spec.x + spec.width
    row = reader.read_tiles(part, 0, left, right, top, bottom, 0, 1, 0, spec.nchannels, spec.format)
    return row


def _place_in_display_window(pixels: PixelArray, spec: Any) -> PixelArray:
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


def upright(pixels: PixelArray, orientation: int) -> PixelArray:
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


def _unreadable(path: Path, kind: str, text: str, max_pixels: int, flag: str) -> InputError:
    """Word a failure of the decoder."""
    if _is_too_large(text):
        return InputError(
            path,
            f"the header claims too large an image ({one_line(text)}; "
            f"limit {max_pixels} pixels); {flag} raises it if the file is sound",
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


def _is_too_large(text: str) -> bool:
    return any(word in text for word in ("exceed", "claims a", "claimed to be"))


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
