"""What OpenImageIO reads of a TIFF as if it were a picture, and what it leaves undone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import PixelArray
from warpir.core.errors import InputError
from warpir.io.images.kinds import open_by_pillow

_FOREIGN_TIFF = {
    4: "a transparency mask",
    32803: "a colour filter array (camera raw)",
    34892: "linear raw values (camera raw)",
    51177: "a depth map",
    52527: "a photometric mask",
}
"""What PhotometricInterpretation says of files that OpenImageIO reads as if they were pictures."""
_WHITE_IS_ZERO, _PALETTE = 0, 3


def check_tiff(path: Path, spec: Any) -> None:
    """Refuse a TIFF that is no picture of RGB or grey, by its ``OpenImageIO.ImageSpec``.

    Raises:
        InputError: Camera raw, a mask, a depth map or CIE Lab.
    """
    photometric = spec.get_int_attribute("tiff:PhotometricInterpretation", 2)
    if found := _FOREIGN_TIFF.get(photometric):
        advice = "save it as RGB or greyscale"
        what = f"a TIFF of {found}, not a picture"
        raise InputError(path, what, advice, reason="image.variant", found=found)
    if "LAB" in str(spec.getattribute("tiff:ColorSpace") or "").upper():
        what = "CIE Lab images are not supported"
        raise InputError(path, what, "save it as RGB", reason="image.variant", found="Lab")


def tiff_codes(path: Path, spec: Any, pixels: PixelArray) -> PixelArray:
    """Return what OpenImageIO leaves undone: deep TIFFs whose zero is white, palettes of 8 bits.

    Raises:
        InputError: The palette's entries have 8 bits, of which OpenImageIO takes the upper 8 of 16.
    """
    photometric = spec.get_int_attribute("tiff:PhotometricInterpretation", 2)
    if photometric == _WHITE_IS_ZERO and pixels.dtype == np.uint16:
        inverted: PixelArray = np.iinfo(np.uint16).max - pixels
        return inverted
    if photometric == _PALETTE and not pixels.any() and (entries := _palette(path)):
        if 0 < max(entries) < 256:
            what = "a palette whose entries have 8 bits, not 16"
            raise InputError(path, what, "save it as RGB", reason="image.variant", found="palette")
    return pixels


def _palette(path: Path) -> tuple[int, ...]:
    """Return the entries of a TIFF's ColorMap; none where they cannot be read."""
    from PIL import TiffImagePlugin

    try:
        with open_by_pillow(path) as picture:
            assert isinstance(picture, TiffImagePlugin.TiffImageFile)
            return tuple(picture.tag_v2.get(TiffImagePlugin.COLORMAP, ()))
    except (OSError, ValueError, SyntaxError):
        return ()
