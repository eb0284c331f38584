"""Colour profiles (ICC): from a photo's own codes to sRGB and back.

OpenColorIO, behind OpenImageIO, reads matrix profiles in float; profiles with tables go through
Pillow, in 8 bits and one way only. What a PNG says in other words than a profile (cICP, gAMA and
cHRM) becomes a profile first, and so does the curve of a grey image: one path for all of them.
"""

import hashlib
import io
import math
import struct
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from warpir.core import color
from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.errors import InputError
from warpir.io.images.decoder import captured_stderr

D50 = (0.34567, 0.35850)
"""CIE xy of the white of ICC's connection space."""
_D50_XYZ = (0.9642, 1.0, 0.8249)
"""The same in XYZ, with the digits of the ICC specification."""
_MOST_CONDITION = 100.0
"""Of the matrix of a profile's primaries; sRGB has 4.3, ProPhoto RGB 1.8."""
_INNER, _ENDS = 0.01, 0.06
"""How far codes may come back off, and black and white, where curves are flat that clip [1]."""
_CICP_PRIMARIES = {1: "ITU-R BT.709", 9: "ITU-R BT.2020", 12: "P3-D65"}
_CICP_CURVES = {
    4: (2.2,),
    8: (1.0,),
    13: (2.4, 1.0 / 1.055, 0.055 / 1.055, 1.0 / 12.92, 0.04045),
    **dict.fromkeys((1, 6, 14, 15), (1.0 / 0.45, 1.0 / 1.099, 0.099 / 1.099, 1.0 / 4.5, 0.081)),
}
"""Code points of ITU-T H.273; curves as an ICC parametric curve of type 0 or 3 has them."""
_EXIF_BYTES = 1 << 17
"""EXIF is the first or the second segment of a JPEG, each of 64 KiB at most [byte]."""
_ADOBE_RGB = [
    (struct.pack(f"{k}HHIH", 0xA001, 3, 1, 65535), struct.pack(f"{k}HHI4s", 1, 2, 4, b"R03"))
    for k in "<>"
]
"""Entries of EXIF in either byte order: ColorSpace uncalibrated, InteroperabilityIndex R03."""


def png_profile(path: Path, icc: bytes | None) -> tuple[bytes | None, list[str]]:
    """Return the profile of a PNG, whichever way it is stated; None for sRGB.

    The PNG specification (third edition, 4.3) ranks cICP, iCCP, sRGB, gAMA with cHRM.

    Returns:
        The profile, and what is not followed, one line each.

    Raises:
        InputError: The signal is high dynamic range (PQ, HLG).
    """
    chunks = _color_chunks(path)
    if len(chunks.get(b"cICP", b"")) == 4:
        primaries, curve, matrix, is_full = chunks[b"cICP"]
        if curve in (16, 18):
            found = "PQ" if curve == 16 else "HLG"
            raise InputError(
                path,
                f"high dynamic range in a PNG is not supported (found {found})",
                "save it as a linear EXR, or as sRGB",
                reason="icc.high_dynamic_range",
                found=found,
            )
        if primaries in _CICP_PRIMARIES and curve in _CICP_CURVES and not matrix and is_full:
            if (primaries, curve) == (1, 13):
                return None, []
            xy = color.chromaticities_of(_CICP_PRIMARIES[primaries])
            return matrix_profile(xy, _parametric(_CICP_CURVES[curve])), []
        return icc, [f"cICP {primaries},{curve},{matrix},{is_full} of the header is not followed"]
    if icc is not None or b"sRGB" in chunks:
        return icc, []
    gamma, xy = 1.0 / 2.2, color.REC709_CHROMATICITIES
    if len(chunks.get(b"gAMA", b"")) == 4:
        gamma = struct.unpack(">I", chunks[b"gAMA"])[0] / 1e5
    if len(chunks.get(b"cHRM", b"")) == 32:
        white_x, white_y, *rgb = (n / 1e5 for n in struct.unpack(">8I", chunks[b"cHRM"]))
        xy = (*rgb, white_x, white_y)
    if not (0.05 <= gamma <= 5.0 and color.are_primaries(xy)):
        return None, ["gAMA or cHRM of the header is broken: taken as sRGB"]
    # 1 / 2.2 with these primaries is how sRGB was written before there was a chunk for it.
    if np.allclose(xy, color.REC709_CHROMATICITIES, atol=2e-3) and abs(gamma * 2.2 - 1.0) < 0.01:
        return None, []
    return matrix_profile(xy, _parametric((1.0 / gamma,))), []


def camera_profile(path: Path) -> bytes | None:
    """Return the profile of a JPEG that carries none and is Adobe RGB by its EXIF; None for sRGB.

    Cameras that are set to it state it so (DCF 2.0), and often write no profile.
    """
    with path.open("rb") as stream:
        head = stream.read(_EXIF_BYTES)
    if not any(all(entry in head for entry in entries) for entries in _ADOBE_RGB):
        return None
    return matrix_profile(color.chromaticities_of("Adobe RGB (1998)"), _parametric((563 / 256,)))


def grey_profile(icc: bytes) -> bytes:
    """Return an RGB profile with the curve of a grey one, or the profile itself if it is none."""
    curve = _tags(icc).get(b"kTRC") if icc[16:20] == b"GRAY" else None
    return icc if curve is None else matrix_profile(color.REC709_CHROMATICITIES, curve)


def matrix_profile(chromaticities: Sequence[float], curve: bytes) -> bytes:
    """Return an ICC profile (version 4.3) of three primaries and one curve for all.

    Args:
        chromaticities: CIE xy of red, green, blue and white.
        curve: Content of a ``curv`` or ``para`` tag, from codes to linear.
    """

    def fixed(*values: float) -> bytes:
        return struct.pack(f">{len(values)}i", *(round(value * 65536.0) for value in values))

    def text(content: str) -> bytes:
        coded = content.encode("utf-16-be")
        return b"mluc" + struct.pack(">4xII4sII", 1, 12, b"enUS", len(coded), 28) + coded

    tags = {
        b"desc": text("Stated by the picture"),
        b"cprt": text("None"),
        b"wtpt": b"XYZ \0\0\0\0" + fixed(*_D50_XYZ),
    }
    columns = color.primaries_to_xyz(chromaticities, D50).T
    for letter, column in zip((b"r", b"g", b"b"), columns, strict=True):
        tags[letter + b"XYZ"] = b"XYZ \0\0\0\0" + fixed(*column)
        tags[letter + b"TRC"] = curve
    head = struct.pack(">8xI4s4s4s", 0x04300000, b"mntr", b"RGB ", b"XYZ ")
    head += struct.pack(">6H4s", 2026, 1, 1, 0, 0, 0, b"acsp") + bytes(28) + fixed(*_D50_XYZ)
    return _packed(head.ljust(128, b"\0"), tags)


def _packed(head: bytes, tags: Mapping[bytes, bytes]) -> bytes:
    """Return the profile of a header, whose length is set, and some tags."""
    table, body, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for name, content in tags.items():
        table += name + struct.pack(">II", start + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    return struct.pack(">I", start + len(body)) + head[4:] + table + body


def _tags(icc: bytes) -> dict[bytes, bytes]:
    """Return the tags of a profile by their names; none where one does not lie inside it.

    OpenColorIO believes the counts: a flipped byte in them costs a minute and gigabytes.
    """
    if len(icc) < 132 or icc[36:40] != b"acsp":
        return {}
    (count,) = struct.unpack_from(">I", icc, 128)
    if 132 + 12 * count > len(icc):
        return {}
    tags = {}
    for k in range(count):
        name, offset, size = struct.unpack_from(">4sII", icc, 132 + 12 * k)
        tags[name] = icc[offset : offset + size]
        if size < 8 or offset + size > len(icc) or not _tag_is_whole(tags[name]):
            return {}
    return tags


def _parametric(numbers: Sequence[float]) -> bytes:
    """Return an ICC parametric curve: of type 0 for one number, of type 3 for five."""
    kind = {1: 0, 5: 3}[len(numbers)]
    fixed = (round(number * 65536.0) for number in numbers)
    return struct.pack(f">4s4xHxx{len(numbers)}i", b"para", kind, *fixed)


def _color_chunks(path: Path) -> dict[bytes, bytes]:
    """Return the chunks of a PNG that state its colours, from before its pixels."""
    found = {}
    with path.open("rb") as stream:
        stream.seek(8)
        while len(header := stream.read(8)) == 8:
            size, name = struct.unpack(">I4s", header)
            if name == b"IDAT" or size > 2**31:
                break
            if name in (b"cICP", b"sRGB", b"gAMA", b"cHRM") and size <= 32:
                found[name] = stream.read(size)
                stream.seek(4, 1)
            else:
                stream.seek(size + 4, 1)
    return found


def convert_profile(
    path: Path, codes: PixelArray, srgb: FloatArray, icc: bytes
) -> tuple[PixelArray, FloatArray, bytes | None, str]:
    """Return (codes, srgb, profile to keep, notice) of an image that carries a profile."""
    broken = "colour profile is broken: taken as sRGB"
    if not _tags(icc):
        return codes, srgb, None, broken
    probe = np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 9, dtype=np.float32)] * 3), axis=-1)
    probe = probe.reshape(27, 27, 3)
    expected = profile_to_srgb(probe, icc)
    if expected is None:
        return _convert_lut_profile(path, codes, srgb, icc)
    if float(np.abs(expected - probe).max()) < 2e-3:  # the profile is sRGB
        return codes, srgb, None, ""
    # How far off the way back of thin primaries lies depends on the processor: they are looked at.
    back = srgb_to_profile(expected, icc) if _primaries_are_apart(icc) else None
    most = np.where((probe > 0.0) & (probe < 1.0), _INNER, _ENDS)
    if back is None or not np.allclose(back, probe, atol=most):  # a NaN is not close either
        return codes, srgb, None, broken
    converted = profile_to_srgb(srgb, icc)
    if converted is None or not np.isfinite(converted).all():
        return codes, srgb, None, broken
    outside = int(((converted < -1e-3) | (converted > 1.0 + 1e-3)).any(axis=-1).sum())
    notice = "colours converted from the embedded profile to sRGB"
    if outside:
        notice += f"; {outside} pixels lie outside sRGB and are clipped for the renderer"
    return codes, np.clip(converted, 0.0, 1.0), icc, notice


def _primaries_are_apart(icc: bytes) -> bool:
    """Return whether codes can be told from the colours that a profile's primaries mix."""
    tags = _tags(icc)
    columns = [tags.get(name, b"") for name in (b"rXYZ", b"gXYZ", b"bXYZ")]
    if min(map(len, columns)) < 20:  # tables mix them
        return True
    primaries = np.array([struct.unpack_from(">3i", column, 8) for column in columns]) / 65536.0
    return bool(np.linalg.cond(primaries) < _MOST_CONDITION)


_NO_ENTRIES = b"curv" + bytes(8)
_COLOR_TAGS = (
    *(b"A2B", b"B2A", b"wtpt", b"chad", b"rXYZ", b"gXYZ", b"bXYZ"),
    *(b"rTRC", b"gTRC", b"bTRC", b"kTRC"),
)


def _colors_alone(icc: bytes) -> bytes:
    """Return a profile without its texts, whose lengths OpenColorIO believes, up to gigabytes.

    A curve without entries, which is linear, has a gamma in their place: OpenColorIO knows none.
    """
    tags = {name: tag for name, tag in _tags(icc).items() if name.startswith(_COLOR_TAGS)}
    linear = {name: _parametric((1.0,)) for name, tag in tags.items() if tag[:12] == _NO_ENTRIES}
    return _packed(icc[:128], tags | linear)


def _tag_is_whole(tag: bytes) -> bool:
    """Check that the numbers of a curve or a lookup table are as many as its sizes say."""
    if tag[:4] == b"curv":
        count = int.from_bytes(tag[8:12])
        return len(tag) >= 12 and 12 + 2 * count <= len(tag)
    if tag[:4] in (b"mft1", b"mft2"):
        width = 1 if tag[:4] == b"mft1" else 2
        if len(tag) < 52:
            return False
        inputs, outputs, points = tag[8:11]
        rows = struct.unpack_from(">2H", tag, 48) if width == 2 else (256, 256)
        numbers = inputs * rows[0] + points**inputs * outputs + outputs * rows[1]
        return bool((52 if width == 2 else 48) + width * numbers <= len(tag))
    if tag[:4] in (b"mAB ", b"mBA "):
        if len(tag) < 32:
            return False
        inputs, outputs = tag[8:10]
        (start,) = struct.unpack_from(">I", tag, 24)
        if not start:
            return True
        if inputs > 16 or start + 20 > len(tag):
            return False
        points, width = math.prod(tag[start : start + inputs]), tag[start + 16]
        return bool(start + 20 + width * points * outputs <= len(tag))
    return True


def _convert_lut_profile(
    path: Path, codes: PixelArray, srgb: FloatArray, icc: bytes
) -> tuple[PixelArray, FloatArray, bytes | None, str]:
    """Convert by Pillow what OpenColorIO does not read: profiles with tables, 8 bits only."""
    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(_colors_alone(icc)))
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
            reason="icc.table_depth",
            found=codes.dtype.name,
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


def profile_to_srgb(encoded: FloatArray, icc: bytes) -> FloatArray | None:
    """Decode matrix profiles, shape [H, W, 3]; None when OpenColorIO cannot use the profile.

    Values outside [0, 1] are colours outside sRGB.
    """
    xyz = _apply_profile(encoded, icc, inverse=True)
    if xyz is None:
        return None
    linear = xyz @ color.XYZ_TO_REC709.T.astype(np.float32)
    srgb: FloatArray = color.linear_to_srgb(linear)
    return srgb


def srgb_to_profile(srgb: FloatArray, icc: bytes) -> FloatArray | None:
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
        profile_path.write_bytes(_colors_alone(icc))
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
