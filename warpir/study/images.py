"""The images of a study: read, checked, and written again without anything but their pixels.

Files keep more than a picture: a mark of how it was made, settings, profiles, dates. All of it
could tell which method made an image, so each is written anew as an 8-bit sRGB PNG.
"""

from pathlib import Path

import numpy as np

from warpir.core.arrays import PixelArray
from warpir.core.color import codes_of
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.io.images.photos import read_photo
from warpir.io.images.writers import png_bytes

CHANGED_CODES = 8
"""Smallest difference from the photo that counts as changed, of 255: above what JPEG adds."""
LARGEST_SHARE = 0.5
"""Of the image that the box round what changed may cover; more would not be one object."""

HOW_MADE = "what differs from the photo is turned upside down in place"


def read_image(path: Path, *, max_pixels: int = LIMITS.pixels, alpha: str = "refuse") -> PixelArray:
    """Read a picture as raters see it: 8-bit sRGB codes, upright, shape [H, W, 3].

    Args:
        path: JPEG, PNG, TIFF or WebP, of 8 or 16 bits.
        max_pixels: Largest image decoded [px].
        alpha: ``refuse`` a transparent image, or ``ignore`` its alpha.

    Raises:
        InputError: It is missing, damaged, too large, transparent, or holds scene-linear floats,
            which have no look of their own.
    """
    photo = read_photo(path, max_pixels=max_pixels, alpha=alpha)
    if photo.is_linear:
        raise InputError(
            path, f"scene-linear ({photo.kind}; expected a picture as it is displayed)"
        )
    return codes_of(photo.srgb)


def require_same_size(first: Path, image: PixelArray, second: Path, other: PixelArray) -> None:
    """Refuse two images of different size: a rater would tell them apart by it.

    Raises:
        InputError: They differ.
    """
    if image.shape != other.shape:
        sizes = (f"{codes.shape[1]} x {codes.shape[0]}" for codes in (other, image))
        found, expected = sizes
        raise InputError(second, f"size {found} px (expected {expected} px, as {first})")


def upside_down(image: PixelArray, photo: PixelArray) -> PixelArray | None:
    """Make the worse image of a catch pair: the object and its shadow hang upside down.

    Args:
        image: An image of the scene with the object, uint8 [H, W, 3].
        photo: The scene without it, same shape.

    Returns:
        The image in which the box round all that differs from the photo is turned upside down, or
        None where nothing differs or it is not one place in the picture.
    """
    difference = np.abs(image.astype(np.int16) - photo.astype(np.int16)).max(axis=-1)
    changed = difference > CHANGED_CODES
    if not changed.any():
        return None
    rows, columns = (np.flatnonzero(changed.any(axis=axis)) for axis in (1, 0))
    box = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    if changed[box].size > LARGEST_SHARE * changed.size:
        return None
    turned = photo.copy()
    turned[box][changed[box][::-1]] = image[box][::-1][changed[box][::-1]]
    return turned


def neutral_png(codes: PixelArray) -> bytes:
    """Serialise an image with nothing in the file but its pixels and the word sRGB."""
    return png_bytes(codes, icc=None, mark=False, description="")
