"""What the header of an image says about its colours, and what of it is not followed."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core import color
from warpir.core.errors import InputError
from warpir.io.images.kinds import start_of

EXPOSURE_LIMIT = 1e12
"""Largest product of a Radiance file's exposures, and its inverse the least [1]."""


def exposure(path: Path, head: bytes) -> float:
    """Return by what the values of a Radiance file were multiplied [1].

    Every program on the way adds its line; OpenImageIO knows the last one alone.
    """
    product = 1.0
    for line in _radiance_lines(head, b"EXPOSURE"):
        try:
            product *= float(line)
        except ValueError:
            product = np.nan
    if not 1.0 / EXPOSURE_LIMIT <= product <= EXPOSURE_LIMIT:
        expected = f"{1.0 / EXPOSURE_LIMIT:g} to {EXPOSURE_LIMIT:g}"
        what = f"EXPOSURE is not such a number (found {product:g}; expected {expected})"
        advice = "correct or remove the EXPOSURE lines of its header"
        raise InputError(path, what, advice, reason="image.exposure", found=product)
    return product


def _radiance_lines(head: bytes, name: bytes) -> list[bytes]:
    """Return the values of all lines of one name in the header of a Radiance file."""
    header = re.split(rb"\r?\n\r?\n", head, maxsplit=1)[0]
    return re.findall(rb"\n" + name + rb"=([^\r\n]*)", header)


def stated_primaries(
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
_ULTRA_HDR = b"hdrgm:Version"
"""Sign in a JPEG's XMP by which OpenImageIO knows an Ultra HDR picture."""
_PNG_PALETTE = 3
"""Colour type in a PNG's IHDR, byte 25 of the file."""


@contextmanager
def without_gain_map(path: Path, kind: str) -> Iterator[Path]:
    """Yield a file in which OpenImageIO finds no gain map: the same, or a copy for that time.

    Its half floats of an Ultra HDR picture are display light up to several times white; the photo
    that people see, and all other programs open, is the base image.
    """
    content = start_of(path) if kind == "jpeg" else b""
    if _ULTRA_HDR not in content:
        yield path
        return
    with tempfile.NamedTemporaryFile(prefix="warpir-", suffix=".jpg") as copy:
        copy.write(content.replace(_ULTRA_HDR, _ULTRA_HDR.replace(b":", b"_")))
        copy.flush()
        yield Path(copy.name)


def header_notices(spec: Any, kind: str, head: bytes) -> list[str]:
    """Say what the header tells about colour and content that is not followed."""
    notices = []
    if (
        spec.getattribute("jpeg:ColorSpace") in ("CMYK", "YCCK")
        or spec.getattribute("tiff:ColorSpace") == "CMYK"
    ):
        notices.append("CMYK converted without its profile; export as RGB for exact colours")
    if spec.getattribute("Exif:ColorSpace") == 65535:
        notices.append(
            "EXIF says uncalibrated colour; its profile, Adobe RGB where EXIF names it, or else "
            "sRGB, is used"
        )
    aspect = spec.get_float_attribute("PixelAspectRatio", 1.0)
    if kind == "exr" and abs(aspect - 1.0) > 1e-3:
        notices.append(f"pixel aspect ratio {aspect:g} is not followed: pixels are taken as square")
    if kind == "exr" and not spec.roi_full.contains(spec.roi):
        notices.append("overscan, beyond the display window, is left out")
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


_SAME_SHAPE = 0.02
"""How far a picture's shape may be from that which its EXIF states."""
_PANORAMA = 6
"""EXIF's CustomRendered, as Apple writes it."""


def view_of(spec: Any) -> tuple[float | None, list[str]]:
    """Return EXIF's 35 mm equivalent focal length [mm] where it holds, and what does not hold."""
    panorama = spec.get_int_attribute("Exif:CustomRendered", 0) == _PANORAMA
    if panorama or spec.getattribute("GPano:ProjectionType"):
        return None, [
            "a panorama, not what one lens sees: camera, place and light will be wrong; cut a "
            "plain view out of it"
        ]
    # A tag of another type than it should have comes back as the default.
    focal = float(spec.get_float_attribute("Exif:FocalLengthIn35mmFilm", 0.0))
    if not 1.0 <= focal <= 10000.0:
        return None, []
    short, long = sorted(spec.get_int_attribute(f"Exif:Pixel{k}Dimension", 0) for k in "XY")
    least, most = sorted((spec.width, spec.height))  # some programs turn the picture, not the tags
    if short > 0 and abs(most * short / long - least) > max(1.0, _SAME_SHAPE * least):
        return None, [
            f"cropped since its EXIF was written ({long} x {short}): its focal length is not used"
        ]
    return focal, []
