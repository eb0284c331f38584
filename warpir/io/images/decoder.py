"""Image files decoded: OpenImageIO, with every check that it leaves to us.

A library's return value is not proof of success: a truncated JPEG comes back as an array and an
error beside it, a FIFO blocks, and the wheel opens many formats by content. So regular files only,
magic bytes first, sizes before pixels, and the error flag after them. The library is imported
inside the functions that need it, to keep start-up short.
"""

import logging
import os
import re
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS
from warpir.io.images.headers import (
    exposure,
    header_notices,
    stated_primaries,
    view_of,
    without_gain_map,
)
from warpir.io.images.kinds import KINDS, check_regular_file, check_scans, sniff
from warpir.io.images.tiff import check_tiff, tiff_codes

_LOG = logging.getLogger(__name__)
_STDERR = threading.RLock()
"""The process has one."""


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
    about_view: tuple[str, ...]
    """What matters only where it is a photograph taken with one lens."""
    notices: tuple[str, ...]

    @property
    def is_grey(self) -> bool:
        """Whether there is one channel, not three."""
        return int(self.pixels.shape[-1]) == 1


def decode_image(
    path: Path,
    max_pixels: int,
    kinds: tuple[str, ...] = KINDS,
    layer: str | None = None,
    flag: str = "--max-pixels",
) -> DecodedImage:
    """Read the pixels of one file through OpenImageIO, with every check it leaves to us.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px].
        kinds: What is accepted, of `KINDS`.
        layer: Of an EXR, the layer or part whose R, G and B are read.
        flag: What raises ``max_pixels``.

    Raises:
        InputError: Missing, not an image of these kinds, truncated, too large, or of a variant
            that is not supported.
    """
    check_regular_file(path)
    kind, head = sniff(path)
    if kind not in kinds:
        what = f"not of a kind that can be used here (found {kind}; expected {' or '.join(kinds)})"
        raise InputError(path, what, reason="image.kind", found=kind)
    if kind == "jpeg":
        check_scans(path)
    file = _File(path, kind, max_pixels, flag)
    # 64 bytes a pixel leave room for EXR layers; sizes are compared exactly below.
    with _opened(file, 64, {"oiio:UnassociatedAlpha": 1}) as reader:
        specs = _readable_parts(file, reader)
        part, channels, alpha = _choose_channels(path, kind, specs, layer)
        spec = specs[part]
        for other in specs:
            file.check_size(other)
        _check_spec(path, spec)
        wanted = channels if alpha is None else [*channels, alpha]
        first, last = min(wanted), max(wanted) + 1
        pixels = _read_pixels(file, reader, part, first, last, spec.format)
        notices = header_notices(spec, kind, head)
        notices += _check_parts(path, reader, specs, part, kind)
    pixels = np.asarray(pixels).reshape(spec.height, spec.width, last - first)
    pixels = _as_the_file_means(pixels, path, kind, spec, head)
    primaries = None
    if pixels.dtype.kind == "f":
        primaries, unknown = stated_primaries(spec, kind, head)
        notices += unknown
    focal, about_view = view_of(spec)
    return DecodedImage(
        pixels=_some_channels(pixels, [channel - first for channel in channels]),
        alpha=pixels[..., alpha - first] if alpha is not None else None,
        kind=kind,
        orientation=spec.get_int_attribute("Orientation", 1),
        icc=_profile(spec),
        primaries=primaries,
        focal_35mm=focal,
        about_view=tuple(about_view),
        notices=tuple(notices),
    )


def _as_the_file_means(
    pixels: PixelArray, path: Path, kind: str, spec: Any, head: bytes
) -> PixelArray:
    """Return what OpenImageIO leaves undone: TIFF codes, an EXR's window, the exposure of HDR."""
    if kind == "tiff":
        return tiff_codes(path, spec, pixels)
    if kind == "exr":
        return _place_in_display_window(pixels, spec)
    if kind == "hdr":
        pixels /= np.float32(exposure(path, head))
    return pixels


def read_exr_header(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Read attributes of an EXR header; ``size`` is the display window's [px], absent is None.

    Raises:
        InputError: Missing or not an EXR file.
    """
    check_regular_file(path)
    with _opened(_File(path, "exr", LIMITS.pixels)) as reader:
        spec = reader.spec()
    attributes = {name: spec.getattribute(name) for name in names}
    return {"size": (spec.full_width, spec.full_height), **attributes}


def read_exr_channels(path: Path, max_pixels: int) -> dict[str, FloatArray]:
    """Read every channel of an EXR file's first part by its full name, shape [H, W] each.

    Raises:
        InputError: Missing, not an EXR file, too large, deep, truncated or corrupt.
    """
    check_regular_file(path)
    file = _File(path, "exr", max_pixels)
    # 256 bytes a pixel: all layers of a run take 136 in float32.
    with _opened(file, 256) as reader:
        spec = reader.spec()
        file.check_size(spec)
        _check_spec(path, spec)
        pixels = _read_pixels(file, reader, 0, 0, spec.nchannels, "float")
    return {name: pixels[..., k] for k, name in enumerate(spec.channelnames)}


@dataclass(frozen=True)
class _File:
    """A file that is being decoded, for its checks and errors."""

    path: Path
    kind: str
    max_pixels: int
    flag: str = "--max-pixels"

    def check_size(self, spec: Any) -> None:
        """Refuse an image or a part that is too large, before a pixel is decoded."""
        sizes = [
            (spec.width, spec.height, ""),
            (spec.full_width, spec.full_height, ""),
            (spec.tile_width, spec.tile_height, "tiles of "),
        ]
        for width, height, what in sizes:
            if width * height > self.max_pixels:
                raise InputError(
                    self.path,
                    f"too large (found {what}{width} x {height} pixels; limit {self.max_pixels}); "
                    f"{self.flag} raises it",
                    reason="image.too_large",
                    found=(width, height),
                    limit=self.max_pixels,
                )

    def unreadable(self, text: str) -> InputError:
        """Return the error of a failure of the decoder, from its own text."""
        if _is_too_large(text):
            return InputError(
                self.path,
                f"the header claims too large an image ({one_line(text)}; "
                f"limit {self.max_pixels} pixels); {self.flag} raises it if the file is sound",
                reason="image.too_large",
                limit=self.max_pixels,
            )
        if self.kind == "hdr" and "FORMAT" in text:
            what = "not 32-bit_rle_rgbe (XYZE files are not supported)"
            return InputError(
                self.path, what, "save it as RGBE .hdr or as EXR", reason="image.variant"
            )
        why = one_line(text) or "the decoder gave no reason"
        return InputError(
            self.path,
            f"truncated, corrupt or of an unsupported variant of {self.kind} ({why})",
            "check that the file was copied or downloaded completely",
            reason="image.damaged",
            found=why,
        )


_NAMES = {
    "exr": "an EXR",
    "hdr": "a Radiance HDR",
    "jpeg": "a JPEG",
    "png": "a PNG",
    "tiff": "a TIFF",
    "webp": "a WebP",
}


@contextmanager
def _opened(
    file: _File, bytes_per_pixel: int = 64, hints: Mapping[str, int] | None = None
) -> Iterator[Any]:
    """Yield the library's reader of a file; what C libraries print meanwhile is not shown.

    ``bytes_per_pixel`` is the most that the image may take; the hints are OpenImageIO's.

    Raises:
        InputError: The library does not know it, or takes it for another kind.
    """
    try:
        str(file.path).encode()
    except UnicodeEncodeError as error:
        what = "its name is not UTF-8, which the decoder needs"
        raise InputError(file.path, what, "rename it", reason="image.name") from error
    import OpenImageIO as oiio

    megabytes = file.max_pixels * bytes_per_pixel // 2**20
    oiio.attribute("limits:imagesize_MB", min(max(64, megabytes), 2**31 - 1))
    spec = oiio.ImageSpec()
    for name, value in (hints or {}).items():
        spec.attribute(name, value)
    with captured_stderr(), without_gain_map(file.path, file.kind) as path:
        reader = oiio.ImageInput.open(str(path), spec)
        if reader is None:
            raise file.unreadable(library_error(oiio))
        try:
            name = reader.format_name()
            if name != {"exr": "openexr"}.get(file.kind, file.kind):
                what = f"not {_NAMES[file.kind]} file (the library reads it as {name})"
                raise InputError(file.path, what, reason="image.kind", found=name)
            yield reader
        finally:
            reader.close()


def _readable_parts(file: _File, reader: Any) -> list[Any]:
    """Return the headers of an EXR's parts, as far as they are readable; of others, the first."""
    specs = [reader.spec()]
    while file.kind == "exr" and reader.seek_subimage(len(specs), 0):
        specs.append(reader.spec())
    text = library_error(reader)
    reader.seek_subimage(0, 0)
    if _is_too_large(text):
        raise file.unreadable(text)
    return specs


def _read_pixels(
    file: _File, reader: Any, part: int, first: int, last: int, kind: Any
) -> PixelArray:
    """Return some channels of a part in one pixel type, shape [height, width, last - first]."""
    try:
        pixels = reader.read_image(part, 0, first, last, kind)
    except MemoryError as error:
        what = "not enough memory to decode it"
        code = ExitCode.RESOURCES
        raise InputError(file.path, what, code=code, reason="image.memory") from error
    text = library_error(reader)
    if pixels is None or text:
        raise file.unreadable(text)
    read: PixelArray = pixels
    return read


def _some_channels(pixels: PixelArray, channels: list[int]) -> PixelArray:
    """Return some channels; no copy where they follow each other."""
    if channels == [*range(channels[0], channels[0] + len(channels))]:
        return pixels[..., channels[0] : channels[0] + len(channels)]
    return pixels[..., channels]


def _profile(spec: Any) -> bytes | None:
    profile = spec.getattribute("ICCProfile")
    # An EXR may call anything so.
    return bytes(profile) if isinstance(profile, bytes | np.ndarray) else None


def _check_spec(path: Path, spec: Any) -> None:
    """Refuse a kind of image that a header announces, before a pixel is decoded."""
    import OpenImageIO as oiio

    if spec.deep:
        what = "deep EXR images are not supported"
        raise InputError(path, what, "flatten it first", reason="image.variant", found="deep")
    if spec.depth > 1:
        what = "volume images are not supported"
        raise InputError(path, what, reason="image.variant", found="volume")
    if spec.format.basetype not in (oiio.UINT8, oiio.UINT16, oiio.HALF, oiio.FLOAT, oiio.DOUBLE):
        raise InputError(
            path,
            f"pixel type not supported (found {spec.format}; expected unsigned integers of 8 or "
            "16 bits, or floats)",
            reason="image.variant",
            found=str(spec.format),
        )
    check_tiff(path, spec)


def _choose_channels(
    path: Path, kind: str, specs: list[Any], layer: str | None
) -> tuple[int, list[int], int | None]:
    """Return the part, its colour channels, 3 or 1, and its alpha channel."""
    if layer is not None and kind != "exr":
        what = f"has no layers (found {kind}; expected EXR)"
        raise InputError(path, what, "leave --layer out", reason="image.layer", found=kind)
    if kind != "exr":
        spec = specs[0]
        alpha = spec.alpha_channel if spec.alpha_channel >= 0 else None
        if spec.channelnames[:3] == ("R", "G", "B"):
            return 0, [0, 1, 2], alpha
        if spec.channelnames not in (("Y",), ("Y", "A")):
            # Such as a palette with alpha, whose codes OpenImageIO mixes up.
            found = ", ".join(spec.channelnames[:24])
            what = f"a variant of {kind} that is not supported (found channels {found})"
            advice = "save it as RGB or greyscale"
            raise InputError(path, what, advice, reason="image.channels", found=found)
        return 0, [0], alpha
    for wanted in (("r", "g", "b"), ("y",)):
        for part, spec in enumerate(specs):
            names = [name.lower() for name in spec.channelnames]
            is_part = layer is not None and _part_name(spec) == layer
            prefix = "" if layer is None or is_part else f"{layer.lower()}."
            if {f"{prefix}ry", f"{prefix}by"} & set(names):
                what = "luminance/chroma EXR is not supported"
                raise InputError(path, what, "save it as RGB", reason="image.channels")
            others = {prefix + "x", prefix + "z"} & set(names)
            if wanted == ("y",) and prefix + "y" in names and others:
                what = "neither RGB nor luminance alone"
                found = ", ".join(spec.channelnames[:24])
                raise InputError(
                    path,
                    f"{what} (found {found}; expected R, G, B)",
                    "convert CIE XYZ to RGB, or leave the other channels out",
                    reason="image.channels",
                    found=found,
                )
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
        reason="image.channels" if layer is None else "image.layer",
        found=names[:24],
    )


def _part_name(spec: Any) -> str:
    return str(spec.getattribute("oiio:subimagename") or "")


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
        what = f"truncated or corrupt ({readable} of {parts} parts readable)"
        raise InputError(path, what, reason="image.damaged", found=readable)
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
    if spec.roi == spec.roi_full:
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
    with _STDERR, ExitStack() as stack:
        try:
            saved = os.dup(2)
        except OSError:  # no stderr at all
            yield
            return
        sink = stack.enter_context(tempfile.TemporaryFile())
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
