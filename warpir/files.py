"""Every file that is read or written: photographs and maps in, one staged folder out.

Reading: OpenImageIO, behind checks in this order: `stat`, magic bytes, header against the size
limit, pixels, the library's error flag, orientation, colour, alpha. Nothing behind this border
checks again. Writing: `OutputFolder` stages everything and renames at the end, `run.json` last.
The image libraries are imported inside the functions that need them, to keep start-up short.
"""

import errno
import fcntl
import hashlib
import io
import json
import logging
import os
import re
import shutil
import socket
import stat
import struct
import tempfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import warpir
from warpir import color
from warpir.camera import Camera, exr_matrices
from warpir.envmap_conventions import SEAM_SHIFTS, to_ours
from warpir.errors import ExitCode, InputError
from warpir.light import Float64Array
from warpir.strict_json import read_json_object

FloatArray = NDArray[np.float32]
Pixels = NDArray[Any]

PHOTO_PIXELS_MAX = 64_000_000
"""Default of ``--max-pixels`` [px]."""
ENVMAP_WIDTH_MAX = 16384
"""Widest environment map accepted [px]."""

UNFINISHED = ("checkpoints", "progress")
"""Folders of an output folder that hold what a run needs, or shows, before it has results."""

_SRGB_NAMES = {"", "srgb_rec709_scene", "srgb_rec709_display", "sRGB", "g22_rec709_scene"}
_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class Photo:
    """A photograph or plate as its file has it, upright, and what the renderer makes of it."""

    codes: Pixels
    """The file's own numbers in their native type, upright, shape [H, W, 3]."""
    srgb: FloatArray
    """Display-encoded Rec.709, in [0, 1], shape [H, W, 3]."""
    kind: str
    """``jpeg``, ``png``, ``tiff``, ``webp``, ``exr`` or ``hdr``."""
    icc: bytes | None = None
    """The file's colour profile when it is not sRGB; `codes` are in it."""
    focal_35mm: float | None = None
    """EXIF focal length, 35 mm equivalent [mm]."""
    notices: tuple[str, ...] = ()
    """What was assumed, expanded, repaired or left out, one line each."""

    @property
    def is_linear(self) -> bool:
        """Whether the codes are scene-linear floats (EXR, HDR, float TIFF)."""
        return self.codes.dtype.kind == "f"

    @property
    def is_deep(self) -> bool:
        """Whether the codes have more than 8 bits, so that half floats would lose some."""
        return self.codes.dtype.itemsize > 1

    def linear(self) -> FloatArray:
        """Return ``photo_lin`` [1], shape [H, W, 3]: ``srgb ** 2.2``, or a plate's own values.

        Unlike `srgb`, a linear plate keeps what lies outside [0, 1].
        """
        if self.is_linear:
            return self.codes.astype(np.float32, copy=False)
        linear: FloatArray = color.gamma_to_linear(self.srgb)
        return linear

    def encode(self, srgb: FloatArray, changed: NDArray[np.bool_]) -> Pixels:
        """Turn an edited image into codes that can be saved in place of the photograph.

        Args:
            srgb: The edited image, display-encoded Rec.709, shape [H, W, 3].
            changed: Where it was edited, shape [H, W]; all other pixels keep their codes.

        Returns:
            Integer codes in the photograph's own type and profile, shape [H, W, 3]; 16-bit
            ones for a linear plate, which has no display codes to keep.
        """
        if self.is_linear:
            return np.round(np.clip(srgb, 0.0, 1.0) * 65535.0).astype(np.uint16)
        own = srgb
        if self.icc is not None:
            in_profile = _srgb_to_profile(srgb, self.icc)
            assert in_profile is not None, "read_photo keeps only profiles that work both ways"
            own = in_profile
        top = np.iinfo(self.codes.dtype).max
        edited = np.round(np.clip(own.astype(np.float64), 0.0, 1.0) * top).astype(self.codes.dtype)
        return np.where(changed[..., None], edited, self.codes)


def read_photo(
    path: str | Path,
    *,
    max_pixels: int = PHOTO_PIXELS_MAX,
    alpha: str = "refuse",
) -> Photo:
    """Read a photograph: JPEG, PNG, TIFF or WebP, or a linear plate in EXR, HDR or float TIFF.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px] (``--max-pixels``).
        alpha: ``refuse`` a transparent image, or ``ignore`` its alpha (``--alpha``).

    Raises:
        InputError: Missing, not an image, truncated, too large, transparent, or in a colour
            space that cannot be converted.
    """
    path = Path(path)
    image = _decode(path, max_pixels)
    notices = list(image.notices)
    codes = image.pixels
    if image.alpha is not None:
        opaque = 1.0 if codes.dtype.kind == "f" else np.iinfo(codes.dtype).max
        if not bool(np.all(image.alpha >= opaque)):
            if alpha != "ignore":
                raise InputError(
                    path,
                    "partly transparent (found an alpha channel; expected an opaque photograph)",
                    "flatten it, or pass --alpha ignore",
                )
            notices.append("alpha channel ignored")
    codes = _upright(codes, image.orientation)
    if codes.shape[-1] == 1:
        notices.append("grey image expanded to three channels")
        codes = np.repeat(codes, 3, axis=-1)
    if bool((codes == codes[0, 0]).all()):
        notices.append("no signal: every pixel has the same value")

    icc: bytes | None = None
    if codes.dtype.kind == "f":
        codes, repaired = _finite(codes)
        if repaired:
            notices.append(f"{repaired} non-finite pixels set to 0")
        notices.append("float image taken as scene-linear, encoded with exponent 1/2.2")
        plate = codes.astype(np.float32, copy=False)
        srgb: FloatArray = np.clip(color.linear_to_gamma(plate), 0.0, 1.0)
    else:
        srgb = codes.astype(np.float32) / np.float32(np.iinfo(codes.dtype).max)
        if image.icc is not None:
            codes, srgb, icc, notice = _convert_profile(path, codes, srgb, image.icc)
            notices += [notice] if notice else []
    return Photo(
        np.ascontiguousarray(codes),
        np.ascontiguousarray(srgb),
        image.kind,
        icc,
        image.focal_35mm,
        tuple(notices),
    )


def read_envmap(
    path: str | Path,
    *,
    convention: str = "openexr",
    camera_to_world: Float64Array | None = None,
    strict: bool = False,
    notices: list[str] | None = None,
) -> FloatArray:
    """Read a lat-long environment map and turn it to our orientation; never clamped.

    Ours is OpenEXR's: image centre +Z, left quarter +X, so the texel at (u, v) shines from
    ``(sin lon cos lat, sin lat, cos lon cos lat)``, ``lon = pi (1 - 2u)``, ``lat = pi (1/2 - v)``.

    Args:
        path: A 2:1 ``.hdr`` or ``.exr`` file, recognised by content.
        convention: Who made the map: a key of `SEAM_SHIFTS`.
        camera_to_world: Pose of the camera, shape [4, 4], for a map in camera axes.
        strict: Refuse NaN, infinite and negative values instead of repairing them.
        notices: One line per repair is appended here.

    Returns:
        Radiance, relative [W/(m^2 sr)], finite and not negative, shape [He, We, 3].

    Raises:
        InputError: Missing, damaged, not 2:1, not an HDR format, or (strict) not clean.
    """
    path = Path(path)
    if convention not in SEAM_SHIFTS:
        raise ValueError(f"convention {convention!r} is not one of {', '.join(SEAM_SHIFTS)}")
    image = _decode(path, ENVMAP_WIDTH_MAX * ENVMAP_WIDTH_MAX // 2, kinds=("exr", "hdr"))
    texels = _upright(image.pixels, image.orientation).astype(np.float32)
    if texels.shape[-1] == 1:
        texels = np.repeat(texels, 3, axis=-1)
    height, width = texels.shape[:2]
    if width != 2 * height or height < 2:
        raise InputError(
            path,
            f"not a lat-long map (found {width} x {height}; expected 2:1)",
            "resize it to twice as wide as high",
        )
    texels /= np.float32(image.exposure)
    messages = list(image.notices)
    bad = ~np.isfinite(texels)
    negative = texels < 0.0
    negative &= ~bad
    if bad.any() or negative.any():
        found = (
            f"{int(np.isnan(texels).sum())} NaN, {int(np.isinf(texels).sum())} infinite, "
            f"{int(negative.sum())} negative values"
        )
        if strict:
            raise InputError(
                path, f"not clean radiance (found {found}; expected finite values >= 0)"
            )
        brightest = float(texels[~bad].max(initial=0.0))
        texels[np.isposinf(texels)] = brightest
        texels[~(texels >= 0.0)] = 0.0
        messages.append(f"{found} repaired: +Inf to the brightest finite value, the others to 0")
    if notices is not None:
        notices += messages
    return to_ours(texels, convention, camera_to_world)


# ----------------------------------------------------------------------------------- decoding


@dataclass(frozen=True)
class _Image:
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


def _decode(path: Path, max_pixels: int, kinds: tuple[str, ...] = tuple(_OIIO_NAMES)) -> _Image:
    """Read the pixels of one file through OpenImageIO, with every check it leaves to us."""
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
            raise _unreadable(path, kind, _library_error(oiio), max_pixels)
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
            error_text = _library_error(reader)
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
    return _Image(
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
        readable += planes is not None and not _library_error(reader)
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


def _upright(pixels: Pixels, orientation: int) -> Pixels:
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


def _finite(codes: Pixels) -> tuple[Pixels, int]:
    """Set non-finite pixels to black; return how many there were."""
    bad = ~np.isfinite(codes).all(axis=-1)
    count = int(bad.sum())
    if count:
        codes = codes.copy()
        codes[bad] = 0
    return codes, count


def _unreadable(path: Path, kind: str, text: str, max_pixels: int) -> InputError:
    """Word a failure of the decoder."""
    if any(word in text for word in ("exceed", "claims a", "claimed to be")):
        return InputError(
            path,
            f"the header claims too large an image ({_one_line(text)}; "
            f"expected at most {max_pixels} pixels)",
            "raise --max-pixels if the file is sound",
        )
    if kind == "hdr" and "FORMAT" in text:
        return InputError(
            path,
            "not 32-bit_rle_rgbe (XYZE files are not supported)",
            "save it as RGBE .hdr or as EXR",
        )
    reason = _one_line(text) or "the decoder gave no reason"
    return InputError(
        path,
        f"truncated, corrupt or of an unsupported variant of {kind} ({reason})",
        "check that the file was copied or downloaded completely",
    )


def _library_error(source: Any) -> str:
    """Return OpenImageIO's pending error; on garbage it may itself be undecodable."""
    try:
        return str(source.geterror())
    except UnicodeDecodeError:
        return "unreadable header"


def _one_line(text: str) -> str:
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


# ------------------------------------------------------------------------------------ profiles


def _convert_profile(
    path: Path, codes: Pixels, srgb: FloatArray, icc: bytes
) -> tuple[Pixels, FloatArray, bytes | None, str]:
    """Return (codes, srgb, profile to keep, notice) of an image that carries a profile."""
    broken = "colour profile is broken: taken as sRGB"
    if not _profile_is_whole(icc):
        return codes, srgb, None, broken
    probe = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 9, dtype=np.float32)] * 3), axis=-1)
    probe = probe.reshape(27, 27, 3)
    expected = _profile_to_srgb(probe, icc)
    if expected is None:
        return _convert_lut_profile(path, codes, srgb, icc)
    if float(np.abs(expected - probe).max()) < 2e-3:  # the profile is sRGB
        return codes, srgb, None, ""
    back = _srgb_to_profile(expected, icc)
    if back is None or not np.allclose(back, probe, atol=0.01):  # a NaN is not close either
        return codes, srgb, None, broken
    converted = _profile_to_srgb(srgb, icc)
    if converted is None or not np.isfinite(converted).all():
        return codes, srgb, None, broken
    outside = int(((converted < -1e-3) | (converted > 1.0 + 1e-3)).any(axis=-1).sum())
    notice = "colours converted from the embedded profile to sRGB"
    if outside:
        notice += f"; {outside} pixels lie outside sRGB and are clipped for the renderer"
    return codes, np.clip(converted, 0.0, 1.0), icc, notice


def _profile_is_whole(icc: bytes) -> bool:
    """Check that the tags of a profile lie inside it.

    OpenColorIO believes the counts: a flipped byte in them costs a minute and gigabytes.
    """
    if len(icc) < 132 or icc[36:40] != b"acsp":
        return False
    (tag_count,) = struct.unpack_from(">I", icc, 128)
    if 132 + 12 * tag_count > len(icc):
        return False
    for k in range(tag_count):
        offset, size = struct.unpack_from(">4xII", icc, 132 + 12 * k)
        if size < 8 or offset + size > len(icc):
            return False
        if icc[offset : offset + 4] == b"curv":
            if size < 12 or 12 + 2 * struct.unpack_from(">I", icc, offset + 8)[0] > size:
                return False
    return True


def _convert_lut_profile(
    path: Path, codes: Pixels, srgb: FloatArray, icc: bytes
) -> tuple[Pixels, FloatArray, bytes | None, str]:
    """Convert by Pillow what OpenColorIO does not read: profiles with tables, 8 bits only."""
    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        space = str(profile.profile.xcolor_space).strip()
    except (OSError, ValueError, ImageCms.PyCMSError):
        return codes, srgb, None, "colour profile is broken: taken as sRGB"
    if space != "RGB":
        return codes, srgb, None, f"colour profile is for {space} images: taken as sRGB"
    if codes.dtype != np.uint8:
        raise InputError(
            path,
            "colour profile with tables on a 16-bit image is not supported",
            "convert the image to sRGB or Display P3",
        )
    try:
        picture = ImageCms.profileToProfile(
            Image.fromarray(np.ascontiguousarray(codes)),
            profile,
            ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")),
        )
    except ImageCms.PyCMSError:
        return codes, srgb, None, "colour profile is broken: taken as sRGB"
    assert picture is not None
    codes = np.asarray(picture)
    return (
        codes,
        codes.astype(np.float32) / np.float32(255.0),
        None,
        "colours converted in 8 bits from the embedded table profile to sRGB",
    )


def _profile_to_srgb(encoded: FloatArray, icc: bytes) -> FloatArray | None:
    """Decode matrix profiles, shape [H, W, 3]; None when OpenColorIO cannot use the profile.

    Values outside [0, 1] are colours outside sRGB.
    """
    xyz = _apply_profile(encoded, icc, inverse=True)
    if xyz is None:
        return None
    linear = xyz @ color.XYZ_TO_REC709.T.astype(np.float32)
    srgb: FloatArray = color.linear_to_srgb(linear)
    return srgb


def _srgb_to_profile(srgb: FloatArray, icc: bytes) -> FloatArray | None:
    """Encode display-encoded Rec.709 into a matrix profile, shape [H, W, 3], in [0, 1]."""
    linear = color.srgb_to_linear(srgb)
    xyz = linear @ np.linalg.inv(color.XYZ_TO_REC709).T.astype(np.float32)
    return _apply_profile(xyz, icc, inverse=False)


def _apply_profile(values: FloatArray, icc: bytes, inverse: bool) -> FloatArray | None:
    """Run an ICC profile by OpenColorIO: encoded to CIE XYZ (D65) when `inverse`, else back."""
    import OpenImageIO as oiio

    with tempfile.TemporaryDirectory(prefix="warpir-icc-") as folder:
        # OpenColorIO caches by path, so the path must tell profiles apart: the folder is new.
        profile_path = Path(folder) / f"{hashlib.sha256(icc).hexdigest()[:16]}.icc"
        profile_path.write_bytes(icc)
        source = oiio.ImageBuf(np.ascontiguousarray(values, dtype=np.float32))
        target = oiio.ImageBuf()
        with captured_stderr():
            done = oiio.ImageBufAlgo.ociofiletransform(
                target, source, str(profile_path), False, inverse
            )
        if not done:
            target.geterror()
            return None
        pixels = np.asarray(target.get_pixels(oiio.FLOAT), dtype=np.float32)
        return pixels.reshape(values.shape)


# ------------------------------------------------------------------------------------- output

HALF_MAX = 65504.0
"""Largest finite half-precision number."""

BACKGROUND_DEPTH = 1e10
"""``Z`` where no object is [m]."""

_PLAIN_NAME = re.compile(r"(?:[A-Za-z0-9][A-Za-z0-9_.-]{0,99}/)?[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
"""A file, or a file in a folder of the output folder."""
_RUN_JSON = "run.json"

_XMP = """<?xpacket begin="\ufeff" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/">
 <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
  <rdf:Description rdf:about=""
    xmlns:Iptc4xmpExt="http://iptc.org/std/Iptc4xmpExt/2008-02-29/">
   <Iptc4xmpExt:DigitalSourceType>\
http://cv.iptc.org/newscodes/digitalsourcetype/compositeSynthetic\
</Iptc4xmpExt:DigitalSourceType>
  </rdf:Description>
 </rdf:RDF>
</x:xmpmeta>
<?xpacket end="w"?>"""


class OutputFolder:
    """The folder a run writes: all of it, or nothing.

    A context manager. Files are staged in ``.partial-<pid>/`` inside the folder, so on the same
    file system; leaving the block without an exception renames them into place, ``run.json``
    last. A folder with ``run.json`` therefore holds a complete result, and after a failure the
    earlier files are what they were, byte for byte. ``.lock`` keeps a second run out; the
    kernel releases it with the process, so it is never stale.
    """

    def __init__(self, path: str | Path, overwrite: bool = False) -> None:
        """Name the folder; nothing is touched before the block is entered.

        Args:
            path: The folder; made when missing.
            overwrite: Whether results that are already there are replaced.
        """
        self.path = Path(path)
        self.overwrite = overwrite
        self._staging = self.path / f".partial-{os.getpid()}"
        self._lock = -1
        self._made = False
        self._hashes: dict[str, str] = {}
        self._run: dict[str, Any] = {}

    def __enter__(self) -> "OutputFolder":
        """Make and lock the folder.

        Raises:
            InputError: Locked or holding results (exit 7), or not writable (exit 5).
        """
        self._make()
        try:
            self._take_lock()
            for abandoned in self.path.glob(".partial-*"):  # of killed runs: the lock is ours
                shutil.rmtree(abandoned, ignore_errors=True)
            self._refuse_results()
            try:
                self._staging.mkdir()
            except OSError as error:
                raise self._disk_error(self._staging.name, error) from error
        except BaseException:
            self._release()
            raise
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        """Move the staged files into place, or on an exception remove them."""
        try:
            if kind is None:
                self._commit()
        finally:
            shutil.rmtree(self._staging, ignore_errors=True)
            self._release()

    # What is written. Each writer ends in `write_bytes` or does the same checks.

    def write_bytes(self, name: str, content: bytes) -> None:
        """Stage one file and see that all of it reached the disk."""
        path = self._staged(name)
        try:
            with path.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            written = path.stat().st_size
        except OSError as error:
            raise self._disk_error(name, error) from error
        if written != len(content):
            raise InputError(
                self.path / name,
                f"written incompletely (found {written} bytes; expected {len(content)})",
                code=ExitCode.RESOURCES,
            )
        self._hashes[name] = hashlib.sha256(content).hexdigest()

    def write_json(self, name: str, content: Mapping[str, Any]) -> None:
        """Stage a JSON file; ``run.json`` gets the sha256 of all others and is written last.

        Raises:
            ValueError: A number is not finite.
        """
        if name == _RUN_JSON:
            self._run = dict(content)
            _json_bytes(self._run)
        else:
            self.write_bytes(name, _json_bytes(content))

    def write_png(
        self,
        name: str,
        codes: Pixels,
        *,
        icc: bytes | None = None,
        mark: bool = True,
        description: str = "",
    ) -> None:
        """Stage a PNG.

        Args:
            name: File name inside the folder.
            codes: uint8 or uint16, shape [H, W, 3], or [H, W] for grey.
            icc: Profile the codes are in; sRGB is stated when absent.
            mark: Whether to say in XMP that the picture is a composite (IPTC digital source
                type ``compositeSynthetic``).
            description: Text for the ``Description`` field.
        """
        self.write_bytes(name, png_bytes(codes, icc, mark, description))

    def write_preview(self, step: int, codes: Pixels, icc: bytes | None = None) -> Path:
        """Write a picture of the way to the result, at once and outside of what is staged.

        Args:
            step: Of the optimisation; 0 is its start.
            codes: As of `write_png`.
            icc: Profile the codes are in.

        Returns:
            The file, in ``progress/``; never seen half written.

        Raises:
            InputError: The disk is full or the folder is not writable (exit 5).
        """
        path = self.path / "progress" / f"preview-{step:06d}.png"
        staged = self._staging / path.name
        try:
            path.parent.mkdir(exist_ok=True)
            staged.write_bytes(png_bytes(codes, icc, False, ""))
            os.replace(staged, path)
        except OSError as error:
            raise self._disk_error(f"progress/{path.name}", error) from error
        return path

    def write_exr(
        self, name: str, channels: Mapping[str, Pixels], header: Mapping[str, Any] | None = None
    ) -> None:
        """Stage a single-part scanline EXR with ZIP compression.

        Args:
            name: File name inside the folder.
            channels: One plane per full channel name (``shadow.R``), shape [H, W]; float16
                planes become half channels, float32 planes float channels.
            header: Attributes; text, numbers, tuples, or float32 arrays for matrices.

        Raises:
            InputError: A value is not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        planes = {}
        for channel, plane in channels.items():
            if plane.dtype not in (np.float16, np.float32) or plane.ndim != 2:
                raise ValueError(
                    f"{channel}: float16 or float32 planes [H, W] are needed, got "
                    f"{plane.dtype} {plane.shape}"
                )
            bad = int(plane.size - np.isfinite(plane).sum())
            if bad:
                raise InputError(
                    self.path / name,
                    f"channel {channel} is not finite (found {bad} bad values)",
                    code=ExitCode.NUMERIC,
                )
            planes[channel] = np.ascontiguousarray(plane)
        attributes: dict[str, Any] = {
            "compression": OpenEXR.ZIP_COMPRESSION,
            "type": OpenEXR.scanlineimage,
        }
        for key, value in (header or {}).items():
            # OpenEXR reads a matrix's memory in order, whatever its strides say.
            is_array = isinstance(value, np.ndarray)
            attributes[key] = np.ascontiguousarray(value) if is_array else value
        # In memory first: a stream cannot run full, and the size to check is known.
        stream = io.BytesIO()
        OpenEXR.File(attributes, planes).write(stream)
        self.write_bytes(name, stream.getvalue())

    def write_envmap(self, texels: FloatArray, stem: str = "envmap") -> None:
        """Stage an environment map: ``.exr`` (float32), ``.hdr`` (RGBE) and ``_preview.png``.

        Args:
            texels: Radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].
            stem: First part of the names.

        Raises:
            InputError: A value is negative or not finite (exit 6), or the disk is full (exit 5).
        """
        import OpenEXR

        if texels.ndim != 3 or texels.shape[2] != 3 or texels.shape[1] != 2 * texels.shape[0]:
            raise ValueError(f"texels [He, 2 He, 3] are needed, got {texels.shape}")
        if not bool((np.isfinite(texels) & (texels >= 0.0)).all()):
            raise InputError(
                self.path / f"{stem}.exr",
                "the light is negative or not finite",
                code=ExitCode.NUMERIC,
            )
        texels = np.ascontiguousarray(texels, dtype=np.float32)
        self.write_exr(
            f"{stem}.exr",
            {c: texels[..., k] for k, c in enumerate("RGB")},
            {**_color_header(), "envmap": OpenEXR.ENVMAP_LATLONG},
        )
        self.write_hdr(f"{stem}.hdr", texels)
        # A person expects the viewing direction -Z, our seam, in the middle.
        seen = np.roll(texels, texels.shape[1] // 2, axis=1)
        white = float(np.percentile(color.luminance(seen), 95.0)) / 0.8
        shown = color.linear_to_srgb(np.clip(seen / np.float32(white or 1.0), 0.0, 1.0))
        self.write_png(
            f"{stem}_preview.png",
            np.round(shown * 255.0).astype(np.uint8),
            mark=False,
            description="Preview: rolled by half its width, so that -Z is in the "
            "middle; scaled and clipped to 8 bits",
        )

    def write_hdr(self, name: str, texels: FloatArray) -> None:
        """Stage a Radiance file; the library's last flush is unchecked, so it is read back.

        Args:
            name: File name inside the folder.
            texels: Finite and not negative, shape [height, width, 3].

        Raises:
            InputError: The disk is full (exit 5).
        """
        import OpenImageIO as oiio

        path = self._staged(name)
        height, width = texels.shape[:2]
        spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
        spec.attribute("DateTime", "")
        writer = oiio.ImageOutput.create(str(path))
        assert writer is not None, "OpenImageIO is built with Radiance HDR"
        done = writer.open(str(path), spec) and writer.write_image(texels)
        text = _library_error(writer)
        done = writer.close() and done and not text
        try:
            if not done:
                raise InputError(path, text)
            _decode(path, width * height, kinds=("hdr",))
            with path.open("rb+") as stream:
                os.fsync(stream.fileno())
                self._hashes[name] = hashlib.file_digest(stream, "sha256").hexdigest()
        except (InputError, OSError) as error:
            raise InputError(
                self.path / name,
                f"cannot be written ({_one_line(str(error))})",
                "free some disk space",
                ExitCode.RESOURCES,
            ) from error

    # How it is kept whole.

    def _staged(self, name: str) -> Path:
        """Return where a file is staged; names are ours, never a path that leads out."""
        if not _PLAIN_NAME.fullmatch(name):
            raise ValueError(f"not a plain file name: {name!r}")
        path = self._staging / name
        try:
            path.parent.mkdir(exist_ok=True)
        except OSError as error:
            raise self._disk_error(name, error) from error
        return path

    def _make(self) -> None:
        if self.path.resolve() == Path(self.path.resolve().anchor):
            raise InputError(
                "--out", f"{self.path} is the root of the file system", code=ExitCode.USAGE
            )
        try:
            self._made = not self.path.exists()
            self.path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError) as error:
            self._made = False
            raise InputError(
                self.path,
                "not a folder (found a file in its place)",
                "choose another --out",
                ExitCode.OUTPUT,
            ) from error
        except OSError as error:
            self._made = False
            raise InputError(
                self.path, f"cannot be made ({error.strerror})", code=ExitCode.RESOURCES
            ) from error

    def _take_lock(self) -> None:
        path = self.path / ".lock"
        while True:
            try:
                lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
            except OSError as error:
                raise self._disk_error(path.name, error) from error
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(lock).st_ino == os.stat(path).st_ino:
                    break  # else the holder before us removed this file after we opened it
                os.close(lock)
            except FileNotFoundError:
                os.close(lock)
            except BlockingIOError as error:
                holder = os.read(lock, 200).decode("utf-8", "replace").strip() or "unknown"
                os.close(lock)
                raise InputError(
                    self.path,
                    f"locked by pid {holder}",
                    "wait for that run, or choose another --out",
                    ExitCode.OUTPUT,
                ) from error
            except OSError as error:
                os.close(lock)
                raise self._disk_error(path.name, error) from error
        self._lock = lock
        try:
            os.ftruncate(lock, 0)
            os.write(lock, f"{os.getpid()} on {socket.gethostname()}\n".encode())
        except OSError as error:
            raise self._disk_error(path.name, error) from error

    def _release(self) -> None:
        if self._lock >= 0:
            with suppress(OSError):
                (self.path / ".lock").unlink()
            os.close(self._lock)
            self._lock = -1
        if self._made:
            with suppress(OSError):
                self.path.rmdir()  # only succeeds when nothing was written

    def _refuse_results(self) -> None:
        """Refuse a folder in use; hidden files and an unfinished run's do not count as results."""
        found = sorted(
            entry.name
            for entry in self.path.iterdir()
            if not entry.name.startswith(".") and entry.name not in UNFINISHED
        )
        if found and not self.overwrite:
            shown = _RUN_JSON if _RUN_JSON in found else found[0]
            raise InputError(
                self.path,
                f"already holds files (found {shown}"
                f"{f' and {len(found) - 1} more' if len(found) > 1 else ''}; "
                "expected an empty folder)",
                "pass --overwrite to replace results",
                ExitCode.OUTPUT,
            )

    def _commit(self) -> None:
        """Move the old results away and the new ones in; undo all of it if a step fails."""
        names = sorted(self._hashes)
        leftover = [name for name in self._old_results() if name not in self._hashes]
        self.write_bytes(_RUN_JSON, _json_bytes({**self._run, "files": dict(self._hashes)}))
        old = self._staging / "old"
        moved: list[tuple[Path, Path]] = []

        def move(source: Path, target: Path) -> None:
            target.parent.mkdir(exist_ok=True)
            if target.parent != self.path and target.parent.is_symlink():
                raise NotADirectoryError(errno.ENOTDIR, "found a link in place of its folder")
            source.rename(target)
            moved.append((source, target))

        try:
            _sync_folder(self._staging)
            old.mkdir()
            for name in (_RUN_JSON, *names, *leftover):
                if (self.path / name).exists():
                    move(self.path / name, old / name)
            for name in names:
                move(self._staging / name, self.path / name)
            for folder in {(self.path / name).parent for name in names} | {self.path}:
                _sync_folder(folder)
            move(self._staging / _RUN_JSON, self.path / _RUN_JSON)
            _sync_folder(self.path)
        except BaseException as error:
            for source, target in reversed(moved):
                target.rename(source)
            self._remove_empty_folders([*names, *leftover])
            if isinstance(error, OSError):
                raise self._disk_error("results", error) from error
            raise
        self._remove_empty_folders(leftover)

    def _remove_empty_folders(self, names: list[str]) -> None:
        """Remove the folders of files that are gone, as far as nothing else is in them."""
        for folder in {(self.path / name).parent for name in names} - {self.path}:
            with suppress(OSError):
                folder.rmdir()

    def _old_results(self) -> list[str]:
        """Return the files of the result being replaced, as far as nobody has changed them."""
        try:
            listed = read_json_object(self.path / _RUN_JSON).get("files")
        except InputError:
            return []
        unchanged = []
        for name, digest in listed.items() if isinstance(listed, dict) else ():
            path = self.path / name
            if _PLAIN_NAME.fullmatch(name) and path.is_file() and not path.is_symlink():
                with path.open("rb") as stream:
                    if hashlib.file_digest(stream, "sha256").hexdigest() == digest:
                        unchanged.append(name)
        return unchanged

    def _disk_error(self, name: str, error: OSError) -> InputError:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
        return InputError(
            self.path / name,
            f"cannot be written ({error.strerror})",
            "free some disk space" if full else "check the folder's permissions",
            ExitCode.RESOURCES,
        )


def _sync_folder(path: Path) -> None:
    """Make renames in a folder survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _json_bytes(content: Mapping[str, Any]) -> bytes:
    """Serialise as strict JSON; NumPy scalars and arrays and paths become plain values."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.generic | np.ndarray):
            return value.tolist()
        if isinstance(value, Path):
            return str(value)
        raise TypeError(f"{type(value).__name__} does not belong in JSON")

    return (json.dumps(content, indent=2, allow_nan=False, default=plain) + "\n").encode()


def png_bytes(codes: Pixels, icc: bytes | None, mark: bool, description: str) -> bytes:
    """Serialise a PNG.

    Written out here because Pillow has no 16-bit RGB, and OpenImageIO states sRGB beside any
    profile and adds EXIF.
    """
    if (
        codes.dtype not in (np.uint8, np.uint16)
        or codes.ndim not in (2, 3)
        or (codes.ndim == 3 and codes.shape[2] != 3)
    ):
        raise ValueError(
            f"uint8 or uint16 codes [H, W, 3] or [H, W] are needed, got {codes.dtype} {codes.shape}"
        )
    height, width = codes.shape[:2]
    # Samples are big-endian; each row is preceded by its filter: 2, difference to the row above.
    big_endian = np.ascontiguousarray(codes, dtype=codes.dtype.newbyteorder(">"))
    rows = big_endian.view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, rows.shape[1] + 1), np.uint8)
    filtered[:, 0] = 2
    filtered[0, 1:] = rows[0]
    np.subtract(rows[1:], rows[:-1], out=filtered[1:, 1:])

    def chunk(name: bytes, content: bytes) -> bytes:
        body = name + content
        return struct.pack(">I", len(content)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(
        ">IIBBBBB", width, height, 8 * codes.dtype.itemsize, 2 if codes.ndim == 3 else 0, 0, 0, 0
    )
    parts = [b"\x89PNG\r\n\x1a\n", chunk(b"IHDR", header)]
    if icc is not None:
        parts.append(chunk(b"iCCP", b"ICC profile\0\0" + zlib.compress(icc)))
    else:
        parts.append(chunk(b"sRGB", b"\0"))
    texts = {"XML:com.adobe.xmp": _XMP if mark else "", "Description": description}
    for keyword, text in texts.items():
        if text:
            parts.append(chunk(b"iTXt", keyword.encode() + b"\0\0\0\0\0" + text.encode()))
    parts += [chunk(b"IDAT", zlib.compress(filtered.data, 6)), chunk(b"IEND", b"")]
    return b"".join(parts)


def _color_header() -> dict[str, Any]:
    """Return the EXR attributes that state our working space."""
    return {
        "chromaticities": color.REC709_CHROMATICITIES,
        "colorInteropID": "lin_rec709_scene",
        "software": f"warpir {warpir.__version__}",
    }


@dataclass(frozen=True)
class Layers:
    """What ``layers.exr`` holds, all linear Rec.709; buffers that a run has not made are absent."""

    composite: Pixels
    """``foreground.rgb + (1 - foreground.a) * plate * shadow_ratio`` [1], shape [H, W, 3]."""
    foreground: Pixels
    """Object alone, premultiplied by coverage [1], shape [H, W, 4]."""
    shadow_ratio: Pixels
    """Multiplies the plate; 1 where the object changes nothing [1], shape [H, W, 3]."""
    plate: Pixels
    """Linearised photograph [1], shape [H, W, 3]."""
    matte: Pixels
    """Object coverage, 0 to 1, shape [H, W]."""
    depth: Pixels | None = None
    """Distance along the viewing axis [m], infinite on the background, shape [H, W]."""
    position: Pixels | None = None
    """World position [m], shape [H, W, 3]."""
    normal: Pixels | None = None
    """World unit normal, shape [H, W, 3]."""
    albedo: Pixels | None = None
    """Base colour [1], shape [H, W, 3]."""
    roughness: Pixels | None = None
    """Perceptual roughness [1], shape [H, W]."""
    emission: Pixels | None = None
    """Part of `foreground` that the object emits [1], shape [H, W, 3]."""
    diffuse: Pixels | None = None
    """Part of `foreground` reflected diffusely [1], shape [H, W, 3]."""
    specular: Pixels | None = None
    """Part of `foreground` reflected specularly [1], shape [H, W, 3]."""


def write_layers(
    folder: OutputFolder,
    layers: Layers,
    camera: Camera,
    *,
    is_deep: bool = False,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> int:
    """Stage ``layers.exr``: half channels, float32 for depth, position and normal.

    The composite recomposes exactly. Of a photograph of 8 bits the layers hold halves to begin with
    (`warpir.picture`), so nothing is lost here, and the composite is stored rounded to half. A
    deeper one has codes that halves cannot tell apart: its composite and its layers are float32.

    Args:
        folder: Where.
        layers: The image planes.
        camera: The camera that made them, at their resolution.
        is_deep: Whether the photograph has more than 8 bits (`Photo.is_deep`).
        config: Resolved configuration, kept as JSON in the attribute ``warpir/config``.
        inputs: sha256 of the input files by name, kept as JSON in ``warpir/inputs``.

    Returns:
        How many values were beyond the half range and clamped; for ``run.json``.

    Raises:
        ValueError: Shapes disagree, or the composite is not what its layers compute.
        InputError: A value is not finite (exit 6), or the disk is full (exit 5).
    """
    height, width = camera.height, camera.width
    recomputed = (
        layers.foreground[..., :3]
        + (1.0 - layers.foreground[..., 3:]) * layers.plate * layers.shadow_ratio
    )
    if not np.allclose(layers.composite, recomputed, rtol=2e-3, atol=2e-3, equal_nan=True):
        worst = float(np.nanmax(np.abs(layers.composite - recomputed)))
        raise ValueError(f"composite differs from fg + (1 - a) plate shadow by up to {worst:g}")

    channels: dict[str, Pixels] = {}
    clamped = 0

    def add(prefix: str, suffixes: str, plane: Pixels | None, whole_floats: bool = False) -> None:
        nonlocal clamped
        if plane is None:
            return
        plane = plane[..., None] if plane.ndim == 2 else plane
        if plane.shape != (height, width, len(suffixes)):
            raise ValueError(
                f"layer {prefix or 'composite'}: shape {plane.shape}, expected "
                f"{(height, width, len(suffixes))}"
            )
        if not whole_floats:
            clamped += int((np.isfinite(plane) & (np.abs(plane) > HALF_MAX)).sum())
            # NaN and Inf pass through, and the writer refuses them.
            plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
        for k, suffix in enumerate(suffixes):
            name = f"{prefix}.{suffix}" if prefix else suffix
            channels[name] = plane[..., k].astype(np.float32 if whole_floats else np.float16)

    add("", "RGB", layers.composite, is_deep)
    add("", "A", np.ones((height, width), np.float32))
    add("fg", "RGBA", layers.foreground, is_deep)
    add("shadow", "RGB", layers.shadow_ratio, is_deep)
    add("plate", "RGB", layers.plate, is_deep)
    add("matte", "A", layers.matte, is_deep)
    if layers.depth is not None:
        depth = np.where(np.isposinf(layers.depth), BACKGROUND_DEPTH, layers.depth)
        add("", "Z", depth, whole_floats=True)
    add("position", "XYZ", layers.position, whole_floats=True)
    add("normal", "XYZ", layers.normal, whole_floats=True)
    add("albedo", "RGB", layers.albedo)
    add("roughness", "Y", layers.roughness)
    add("emission", "RGB", layers.emission)
    add("diffuse", "RGB", layers.diffuse)
    add("specular", "RGB", layers.specular)

    world_to_camera, world_to_ndc = exr_matrices(camera)
    folder.write_exr(
        "layers.exr",
        channels,
        {
            **_color_header(),
            "worldToCamera": world_to_camera.astype(np.float32),
            "worldToNDC": world_to_ndc.astype(np.float32),
            "warpir/formula": "RGB = fg.RGB + (1 - fg.A) * plate.RGB * shadow.RGB",
            "warpir/config": json.dumps(config or {}, sort_keys=True, default=str),
            "warpir/inputs": json.dumps(inputs or {}, sort_keys=True),
        },
    )
    return clamped
