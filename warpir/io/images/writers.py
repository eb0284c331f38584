"""Image files as bytes: PNG, EXR and Radiance HDR, equal bytes for equal input.

The image libraries are imported inside the functions that need them, to keep start-up short.
"""

import io
import struct
import tempfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import warpir
from warpir.core import color
from warpir.core.arrays import CodeArray, FloatArray, PixelArray, on_cores
from warpir.core.errors import ExitCode, InputError, disk_error
from warpir.core.latlong import resize_map
from warpir.core.memory import core_count
from warpir.io.images.decoder import decode_image, library_error

BLOCK, WINDOW = 1 << 18, 1 << 15
"""Bytes that are deflated at once, and how far back deflate looks [byte]."""
PREVIEW_ROWS = 1024
"""Rows of an environment map's preview, at most."""
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


def png_bytes(
    codes: PixelArray,
    icc: bytes | None = None,
    mark: bool = False,
    description: str = "",
    level: int = 6,
) -> bytes:
    """Serialise a PNG.

    Written out here because Pillow has no 16-bit RGB, and OpenImageIO states sRGB beside any
    profile and adds EXIF.

    Args:
        codes: uint8 or uint16, shape [H, W, 3], or [H, W] for grey.
        icc: Profile the codes are in; sRGB is stated when absent.
        mark: Whether to say in XMP that the picture is a composite (IPTC digital source type
            ``compositeSynthetic``).
        description: Text for the ``Description`` field.
        level: Of zlib; photos at 1 take a quarter of the time and a sixteenth more bytes.
    """
    assert codes.dtype in (np.uint8, np.uint16) and codes.shape[2:] in ((), (3,)), codes.shape
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
    parts += [chunk(b"IDAT", _deflated(filtered.data.cast("B"), level)), chunk(b"IEND", b"")]
    return b"".join(parts)


def _deflated(content: memoryview, level: int) -> bytes:
    """Return a zlib stream (RFC 1950) whose blocks were compressed on every core."""

    def block(first: int) -> bytes:
        last = first + BLOCK
        before = content[max(0, first - WINDOW) : first]
        packer = zlib.compressobj(level, wbits=-zlib.MAX_WBITS, zdict=before)
        packed = packer.compress(content[first:last])
        end = zlib.Z_FINISH if last >= len(content) else zlib.Z_SYNC_FLUSH
        return packed + packer.flush(end)

    blocks = on_cores(block, range(0, len(content), BLOCK))
    return b"".join([b"\x78\x9c", *blocks, struct.pack(">I", zlib.adler32(content))])


def exr_bytes(
    where: Path, channels: Mapping[str, PixelArray], header: Mapping[str, Any] | None = None
) -> bytes:
    """Serialise a single-part scanline EXR with ZIP compression.

    Args:
        where: The file, for errors.
        channels: One plane per full channel name (``shadow.R``), shape [H, W]; float16 planes
            become half channels, float32 planes float channels.
        header: Attributes; text, numbers, tuples, or float32 arrays for matrices.

    Raises:
        InputError: A value is not finite (exit 6).
    """
    import OpenEXR

    planes = {}
    for channel, plane in channels.items():
        assert plane.dtype in (np.float16, np.float32) and plane.ndim == 2, channel
        bad = plane.size - np.count_nonzero(np.isfinite(plane))
        if bad:
            what = f"channel {channel} is not finite (found {bad} bad values)"
            raise InputError(where, what, code=ExitCode.NUMERIC)
        planes[channel] = np.ascontiguousarray(plane)
    attributes: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    for key, value in (header or {}).items():
        # OpenEXR reads a matrix's memory in order, whatever its strides say.
        is_array = isinstance(value, np.ndarray)
        attributes[key] = np.ascontiguousarray(value) if is_array else value
    OpenEXR.set_global_thread_count(core_count())
    # In memory first: a stream cannot run full, and the size to check is known.
    stream = io.BytesIO()
    OpenEXR.File(attributes, planes).write(stream)
    return stream.getvalue()


def envmap_exr_bytes(where: Path, texels: FloatArray) -> bytes:
    """Serialise an environment map as EXR, float32; ``where`` is the file that an error names.

    Texels are radiance in our orientation, relative [W/(m^2 sr)], shape [He, 2 He, 3].

    Raises:
        InputError: A value is negative or not finite (exit 6).
    """
    import OpenEXR

    assert texels.shape == (len(texels), 2 * len(texels), 3), texels.shape
    if not bool((np.isfinite(texels) & (texels >= 0.0)).all()):
        raise InputError(where, "the light is negative or not finite", code=ExitCode.NUMERIC)
    planes = {c: texels[..., k].astype(np.float32) for k, c in enumerate("RGB")}
    return exr_bytes(where, planes, {**color_header(), "envmap": OpenEXR.ENVMAP_LATLONG})


def envmap_preview(texels: FloatArray) -> CodeArray:
    """Return an environment map as a person expects it: the viewing direction -Z in the middle.

    Texels are those of `envmap_exr_bytes`, the result sRGB codes of `PREVIEW_ROWS` rows at most,
    scaled and clipped.
    """
    texels = resize_map(texels, min(len(texels), PREVIEW_ROWS))
    seen = np.roll(texels.astype(np.float32), texels.shape[1] // 2, axis=1)
    white = float(np.percentile(color.luminance(seen), 95.0)) / 0.8
    shown = color.linear_to_srgb(np.clip(seen / np.float32(white or 1.0), 0.0, 1.0))
    return np.asarray(np.round(shown * 255.0).astype(np.uint8))


def hdr_bytes(where: Path, texels: FloatArray, folder: Path) -> bytes:
    """Serialise a Radiance file; the library's last flush is unchecked, so it is read back.

    Args:
        where: The file, for errors.
        texels: Finite and not negative, shape [height, width, 3].
        folder: Where the library may write; nothing stays there.

    Raises:
        InputError: The disk is full (exit 5).
    """
    import OpenImageIO as oiio

    height, width = texels.shape[:2]
    spec = oiio.ImageSpec(width, height, 3, oiio.FLOAT)
    spec.attribute("DateTime", "")
    try:
        with tempfile.TemporaryDirectory(dir=folder) as inner:
            path = Path(inner) / where.name
            writer = oiio.ImageOutput.create(str(path))
            assert writer is not None, "OpenImageIO is built with Radiance HDR"
            is_done = writer.open(str(path), spec) and writer.write_image(texels)
            text = library_error(writer)
            is_done = writer.close() and is_done and not text
            if not is_done:
                raise InputError(path, text)
            decode_image(path, width * height, kinds=("hdr",))
            return path.read_bytes()
    except InputError as error:  # its text is the library's, and names another file
        what, advice = "written incompletely", "free some disk space"
        raise InputError(where, what, advice, ExitCode.RESOURCES) from error
    except OSError as error:
        raise disk_error(where, error) from error


def color_header() -> dict[str, Any]:
    """Return the EXR attributes that state our working space."""
    return {
        "chromaticities": color.REC709_CHROMATICITIES,
        "colorInteropID": "lin_rec709_scene",
        "software": f"warpir {warpir.__version__}",
    }
