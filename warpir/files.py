"""Every file that is read or written: photographs and maps in, one staged folder out.

Reading: OpenImageIO, behind checks in this order: `stat`, magic bytes, header against the size
limit, pixels, the library's error flag, orientation, colour, alpha. Nothing behind this border
checks again. Writing: `OutputFolder` stages everything and renames at the end, `run.json` last.
The image libraries are imported inside the functions that need them, to keep start-up short.
"""

import hashlib
import logging
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from warpir import color
from warpir.errors import ExitCode, InputError

FloatArray = NDArray[np.float32]
Pixels = NDArray[Any]

PHOTO_PIXELS_MAX = 64_000_000
"""Default of ``--max-pixels`` [px]."""
ENVMAP_WIDTH_MAX = 16384
"""Widest environment map accepted [px]."""

ENVMAP_ROLLS = {"openexr": 0.0, "nvdiffrec": -0.5, "threejs": -0.25, "blender": -0.25}
"""Columns to roll a map of each convention by, as a share of its width, to make it ours."""

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
        own = _srgb_to_profile(srgb, self.icc) if self.icc is not None else srgb
        top = np.iinfo(self.codes.dtype).max
        edited = np.round(np.clip(own.astype(np.float64), 0.0, 1.0) * top).astype(self.codes.dtype)
        return np.where(changed[..., None], edited, self.codes)


def read_photo(
    path: str | Path,
    *,
    max_pixels: int = PHOTO_PIXELS_MAX,
    alpha: Literal["refuse", "ignore"] = "refuse",
    layer: str = "",
) -> Photo:
    """Read a photograph: JPEG, PNG, TIFF or WebP, or a linear plate in EXR, HDR or float TIFF.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px] (``--max-pixels``).
        alpha: Whether a transparent image is refused or its alpha dropped (``--alpha``).
        layer: EXR layer to read, such as ``beauty`` for ``beauty.R``; empty for the plain RGB.

    Raises:
        InputError: Missing, not an image, truncated, too large, transparent, or in a colour
            space that cannot be converted.
    """
    path = Path(path)
    image = _decode(path, max_pixels, layer)
    notices = list(image.notices)
    codes = image.pixels
    if image.alpha is not None:
        opaque = 1.0 if codes.dtype.kind == "f" else np.iinfo(codes.dtype).max
        if not bool(np.all(image.alpha >= opaque)):
            if alpha == "refuse":
                raise InputError(path, "partly transparent (found an alpha channel; expected an "
                                 "opaque photograph)", "flatten it, or pass --alpha ignore")
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
    return Photo(np.ascontiguousarray(codes), np.ascontiguousarray(srgb), image.kind, icc,
                 image.focal_35mm, tuple(notices))


def read_envmap(
    path: str | Path,
    rotate_deg: float = 0.0,
    *,
    convention: str = "openexr",
    strict: bool = False,
    notices: list[str] | None = None,
) -> FloatArray:
    """Read a lat-long environment map and turn it to our orientation; never clamped.

    Ours is OpenEXR's: image centre +Z, left quarter +X, so the texel at (u, v) shines from
    ``(sin lon cos lat, sin lat, cos lon cos lat)``, ``lon = pi (1 - 2u)``, ``lat = pi (1/2 - v)``.

    Args:
        path: A 2:1 ``.hdr`` or ``.exr`` file, recognised by content.
        rotate_deg: Turns the light about +Y, counter-clockwise seen from above [deg]; whole
            columns are moved exactly, parts of a column keep each row's sum.
        convention: Who made the map: a key of `ENVMAP_ROLLS`.
        strict: Refuse NaN, infinite and negative values instead of repairing them.
        notices: One line per repair is appended here.

    Returns:
        Radiance, relative [W/(m^2 sr)], finite and not negative, shape [He, We, 3].

    Raises:
        InputError: Missing, damaged, not 2:1, not an HDR format, or (strict) not clean.
    """
    path = Path(path)
    if convention not in ENVMAP_ROLLS:
        raise InputError("--env-convention", f"unknown convention (found {convention}; expected "
                         f"{', '.join(ENVMAP_ROLLS)})", code=ExitCode.USAGE)
    if not np.isfinite(rotate_deg):
        raise InputError("--env-rotate", f"not a number of degrees (found {rotate_deg})",
                         code=ExitCode.USAGE)
    image = _decode(path, ENVMAP_WIDTH_MAX * ENVMAP_WIDTH_MAX // 2, "", kinds=("exr", "hdr"))
    texels = _upright(image.pixels, image.orientation).astype(np.float32)
    if texels.shape[-1] == 1:
        texels = np.repeat(texels, 3, axis=-1)
    height, width = texels.shape[:2]
    if width != 2 * height or height < 2:
        raise InputError(path, f"not a lat-long map (found {width} x {height}; expected 2:1)",
                         "resize it to twice as wide as high")
    texels /= np.float32(image.exposure)
    messages = list(image.notices)
    bad = ~np.isfinite(texels)
    negative = texels < 0.0
    negative &= ~bad
    if bad.any() or negative.any():
        found = (f"{int(np.isnan(texels).sum())} NaN, {int(np.isinf(texels).sum())} infinite, "
                 f"{int(negative.sum())} negative values")
        if strict:
            raise InputError(path, f"not clean radiance (found {found}; expected finite values "
                             ">= 0)")
        brightest = float(texels[~bad].max(initial=0.0))
        texels[np.isposinf(texels)] = brightest
        texels[~(texels >= 0.0)] = 0.0
        messages.append(f"{found} repaired: +Inf to the brightest finite value, the others to 0")
    if notices is not None:
        notices += messages
    columns = width * (ENVMAP_ROLLS[convention] - rotate_deg / 360.0)
    return _roll_columns(texels, columns)


def _roll_columns(texels: FloatArray, columns: float) -> FloatArray:
    """Move a map to the right by any number of columns, with wrap; each row keeps its sum."""
    if abs(columns - round(columns)) < 1e-6:  # what 360 degrees in float64 leave behind
        columns = round(columns)
    whole = int(np.floor(columns))
    part = np.float32(columns - whole)
    moved = np.roll(texels, whole, axis=1)
    if part > 0.0:
        moved = (np.float32(1.0) - part) * moved + part * np.roll(texels, whole + 1, axis=1)
    return np.ascontiguousarray(moved)


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
    raise InputError(path, "not an image that warpir reads (expected JPEG, PNG, TIFF, WebP, EXR "
                     "or Radiance HDR)", advice)


_OIIO_NAMES = {"jpeg": "jpeg", "png": "png", "tiff": "tiff", "webp": "webp", "exr": "openexr",
               "hdr": "hdr"}


def _decode(
    path: Path, max_pixels: int, layer: str, kinds: tuple[str, ...] = tuple(_OIIO_NAMES)
) -> _Image:
    """Read the pixels of one file through OpenImageIO, with every check it leaves to us."""
    check_regular_file(path)
    kind, head = _sniff(path)
    if kind not in kinds:
        raise InputError(path, f"not of a kind that can be used here (found {kind}; expected "
                         f"{' or '.join(kinds)})")
    import OpenImageIO as oiio

    # 64 bytes a pixel leave room for EXR layers; sizes are compared exactly below.
    oiio.attribute("limits:imagesize_MB", max(64, max_pixels * 64 // 2**20))
    hints = oiio.ImageSpec()
    hints.attribute("oiio:UnassociatedAlpha", 1)
    with _captured_stderr():
        reader = oiio.ImageInput.open(str(path), hints)
        if reader is None:
            raise _unreadable(path, kind, _library_error(oiio), max_pixels)
        try:
            if reader.format_name() != _OIIO_NAMES[kind]:
                raise InputError(path, f"content contradicts itself (found {kind} magic bytes, "
                                 f"read as {reader.format_name()})")
            spec = reader.spec()
            for width, height in ((spec.width, spec.height), (spec.full_width, spec.full_height)):
                if width * height > max_pixels:
                    raise InputError(path, f"too large (found {width} x {height} pixels; expected "
                                     f"at most {max_pixels})", "raise --max-pixels")
            if spec.deep:
                raise InputError(path, "deep EXR images are not supported", "flatten it first")
            if spec.depth > 1:
                raise InputError(path, "volume images are not supported")
            if spec.format.basetype in (oiio.INT8, oiio.INT16, oiio.INT32, oiio.INT64,
                                        oiio.UINT64):
                raise InputError(path, f"pixel type not supported (found {spec.format}; expected "
                                 "unsigned integers or floats)")
            first, count = _choose_channels(path, spec.channelnames, layer)
            has_alpha = not layer and spec.alpha_channel >= 0
            last = max(first + count, spec.alpha_channel + 1 if has_alpha else 0)
            try:
                pixels = reader.read_image(0, 0, first, last, spec.format)
            except MemoryError as error:
                raise InputError(path, "not enough memory to decode it",
                                 code=ExitCode.RESOURCES) from error
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


def _choose_channels(path: Path, names: tuple[str, ...], layer: str) -> tuple[int, int]:
    """Return the first channel and the count (1 or 3) of the colour to read.

    OpenImageIO puts R, G, B next to each other, within layers too.
    """
    wanted = [f"{layer}.{c}" if layer else c for c in "RGB"]
    if all(name in names for name in wanted):
        first = names.index(wanted[0])
        if list(names[first:first + 3]) == wanted:
            return first, 3
    grey = f"{layer}.Y" if layer else "Y"
    if grey in names and not layer and ("RY" in names or "BY" in names):
        raise InputError(path, "luminance/chroma EXR is not supported", "save it as RGB")
    if grey in names:
        return names.index(grey), 1
    if not layer and len(names) == 1:
        return 0, 1
    layers = sorted({name.rpartition(".")[0] for name in names if "." in name})
    raise InputError(path, f"no RGB channels{f' in layer {layer}' if layer else ''} (found "
                     f"{', '.join(names[:24])}; expected {', '.join(wanted)})",
                     f"choose a layer with --layer: {', '.join(layers[:12])}" if layers else "")


def _header_notices(spec: Any, kind: str, head: bytes) -> list[str]:
    """Say what the header tells about colour and content that is not followed."""
    notices = []
    if spec.getattribute("jpeg:ColorSpace") in ("CMYK", "YCCK") or spec.getattribute(
            "tiff:ColorSpace") == "CMYK":
        notices.append("CMYK converted without its profile; export as RGB for exact colours")
    if spec.getattribute("Exif:ColorSpace") == 65535:
        notices.append("EXIF says uncalibrated colour; its profile, or else sRGB, is used")
    space = str(spec.getattribute("oiio:ColorSpace") or "")
    if kind == "png" and spec.getattribute("ICCProfile") is None and space not in _SRGB_NAMES:
        notices.append(f"colour space {space} of the header is not followed: taken as sRGB")
    primaries = spec.getattribute("chromaticities")
    if primaries is not None and not np.allclose(primaries, color.REC709_CHROMATICITIES,
                                                 atol=2e-3):
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
        planes = None if other.deep else reader.read_image(part, 0, 0, other.nchannels,
                                                           other.format)
        readable += planes is not None and not _library_error(reader)
    if readable < parts:
        raise InputError(path, f"truncated or corrupt ({readable} of {parts} parts readable)")
    return [f"{parts} parts: the first is used"]


def _place_in_display_window(pixels: Pixels, spec: Any) -> Pixels:
    """Crop or pad the data window of an EXR, with zeros, to its display window."""
    if (spec.x, spec.y, spec.width, spec.height) == (
            spec.full_x, spec.full_y, spec.full_width, spec.full_height):
        return pixels
    placed = np.zeros((spec.full_height, spec.full_width, pixels.shape[-1]), pixels.dtype)
    x0, y0 = max(spec.x, spec.full_x), max(spec.y, spec.full_y)
    x1 = min(spec.x + spec.width, spec.full_x + spec.full_width)
    y1 = min(spec.y + spec.height, spec.full_y + spec.full_height)
    if x1 > x0 and y1 > y0:
        placed[y0 - spec.full_y:y1 - spec.full_y, x0 - spec.full_x:x1 - spec.full_x] = pixels[
            y0 - spec.y:y1 - spec.y, x0 - spec.x:x1 - spec.x]
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
        return InputError(path, f"the header claims too large an image ({_one_line(text)}; "
                          f"expected at most {max_pixels} pixels)",
                          "raise --max-pixels if the file is sound")
    if kind == "hdr" and "FORMAT" in text:
        return InputError(path, "not 32-bit_rle_rgbe (XYZE files are not supported)",
                          "save it as RGBE .hdr or as EXR")
    reason = _one_line(text) or "the decoder gave no reason"
    return InputError(path, f"truncated, corrupt or of an unsupported variant of {kind} "
                      f"({reason})", "check that the file was copied or downloaded completely")


def _library_error(source: Any) -> str:
    """Return OpenImageIO's pending error; on garbage it may itself be undecodable."""
    try:
        return str(source.geterror())
    except UnicodeDecodeError:
        return "unreadable header"


def _one_line(text: str) -> str:
    return " ".join(text.split("\n", 1)[0].split())[:160]


@contextmanager
def _captured_stderr() -> Iterator[None]:
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
    probe = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 9, dtype=np.float32)] * 3), axis=-1)
    probe = probe.reshape(27, 27, 3)
    expected = _profile_to_srgb(probe, icc)
    if expected is not None:
        if float(np.abs(expected - probe).max()) < 2e-3:  # the profile is sRGB
            return codes, srgb, None, ""
        converted = _profile_to_srgb(srgb, icc)
        assert converted is not None
        outside = int(((converted < -1e-3) | (converted > 1.0 + 1e-3)).any(axis=-1).sum())
        notice = "colours converted from the embedded profile to sRGB"
        if outside:
            notice += f"; {outside} pixels lie outside sRGB and are clipped for the renderer"
        return codes, np.clip(converted, 0.0, 1.0), icc, notice
    return _convert_lut_profile(path, codes, srgb, icc)


def _convert_lut_profile(
    path: Path, codes: Pixels, srgb: FloatArray, icc: bytes
) -> tuple[Pixels, FloatArray, bytes | None, str]:
    """Convert by Pillow what OpenColorIO does not read: profiles with tables, 8 bits only."""
    import io

    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        space = str(profile.profile.xcolor_space).strip()
    except (OSError, ImageCms.PyCMSError):
        return codes, srgb, None, "colour profile is broken: taken as sRGB"
    if space != "RGB":
        return codes, srgb, None, f"colour profile is for {space} images: taken as sRGB"
    if codes.dtype != np.uint8:
        raise InputError(path, "colour profile with tables on a 16-bit image is not supported",
                         "convert the image to sRGB or Display P3")
    try:
        picture = ImageCms.profileToProfile(
            Image.fromarray(np.ascontiguousarray(codes)), profile,
            ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")))
    except ImageCms.PyCMSError:
        return codes, srgb, None, "colour profile is broken: taken as sRGB"
    assert picture is not None
    codes = np.asarray(picture)
    return (codes, codes.astype(np.float32) / np.float32(255.0), None,
            "colours converted in 8 bits from the embedded table profile to sRGB")


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


def _srgb_to_profile(srgb: FloatArray, icc: bytes) -> FloatArray:
    """Encode display-encoded Rec.709 into a matrix profile, shape [H, W, 3], in [0, 1]."""
    linear = color.srgb_to_linear(srgb)
    xyz = linear @ np.linalg.inv(color.XYZ_TO_REC709).T.astype(np.float32)
    encoded = _apply_profile(xyz, icc, inverse=False)
    assert encoded is not None, "a profile that was read can be written"
    return encoded


def _apply_profile(values: FloatArray, icc: bytes, inverse: bool) -> FloatArray | None:
    """Run an ICC profile by OpenColorIO: encoded to CIE XYZ (D65) when `inverse`, else back."""
    import OpenImageIO as oiio

    with tempfile.TemporaryDirectory(prefix="warpir-icc-") as folder:
        # OpenColorIO caches by path, so the path must tell profiles apart: the folder is new.
        profile_path = Path(folder) / f"{hashlib.sha256(icc).hexdigest()[:16]}.icc"
        profile_path.write_bytes(icc)
        source = oiio.ImageBuf(np.ascontiguousarray(values, dtype=np.float32))
        target = oiio.ImageBuf()
        done = oiio.ImageBufAlgo.ociofiletransform(target, source, str(profile_path), False,
                                                   inverse)
        if not done:
            target.geterror()
            return None
        pixels = np.asarray(target.get_pixels(oiio.FLOAT), dtype=np.float32)
        return pixels.reshape(values.shape)
