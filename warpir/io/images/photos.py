"""Photographs, masks and environment maps in: upright, finite and in our colours.

The order of the checks: `stat`, magic bytes, header against the size limit, pixels, the library's
error flag (`warpir.io.images.decoder`), orientation, colour (`warpir.io.images.color_profile`),
alpha. Nothing behind this border checks again. What is written is in `warpir.io.results`.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.core import color
from warpir.core.arrays import Float64Array, FloatArray, PixelArray, by_pixel, mask_box
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.io.images.color_profile import (
    camera_profile,
    convert_profile,
    grey_profile,
    png_profile,
    profile_to_srgb,
    srgb_to_profile,
)
from warpir.io.images.decoder import DecodedImage, decode_image, upright
from warpir.io.images.envmap_conventions import to_ours
from warpir.io.images.jpeg import JpegCoding, read_coding

BOTH_WAYS = "read_photo keeps only profiles that work both ways"
RADIANCE_LIMIT = 1e12
"""Of a panorama, relative [W/(m^2 sr)]; float32 products overflow from 10^19 on."""


@dataclass(frozen=True)
class Photo:
    """A photograph or plate as its file has it, upright, and what the renderer makes of it."""

    codes: PixelArray
    """The file's own numbers in their native type, upright, shape [H, W, 3]; of a linear plate
    float32 in Rec.709, of a profile with tables in sRGB."""
    srgb: FloatArray
    """Display-encoded Rec.709, in [0, 1], shape [H, W, 3]."""
    kind: str
    """``jpeg``, ``png``, ``tiff``, ``webp``, ``exr`` or ``hdr``."""
    icc: bytes | None = None
    """The file's colour profile when it is not sRGB; `codes` are in it. Made here where a PNG
    states its colours in other words, or the profile is of a grey image."""
    focal_35mm: float | None = None
    """EXIF focal length, 35 mm equivalent [mm]."""
    notices: tuple[str, ...] = ()
    """What was assumed, expanded, repaired or left out, one line each."""
    jpeg: JpegCoding | None = None
    """How the file's blocks were quantised; None of other files, and of codes in a profile."""

    @property
    def is_linear(self) -> bool:
        """Whether the codes are scene-linear floats (EXR, HDR, float TIFF)."""
        return self.codes.dtype.kind == "f"

    @property
    def is_deep(self) -> bool:
        """Whether the codes have more than 8 bits, so that half floats would lose some."""
        return self.codes.dtype.itemsize > 1

    @property
    def exposure(self) -> float:
        """Factor on radiance with which the estimators see a linear plate; 1 of a photograph."""
        if not self.is_linear:
            return 1.0
        step = math.ceil(math.sqrt(self.codes.size / EXPOSED_BY))
        return float(2.0 ** color.expose(self.codes[::step, ::step])[1])

    @property
    def unit(self) -> float:
        """Radiance that is as much as 1 in a photograph [1]: more in a plate of larger numbers."""
        return max(1.0, 1.0 / self.exposure)

    def exposed(self) -> tuple[FloatArray, float]:
        """Return what the estimators look at, and by what its light is to be divided.

        A photograph is as it is. A linear plate of any unit is exposed as their photographs are.

        Returns:
            Display-encoded values in [0, 1], shape [H, W, 3], and the factor on radiance [1].
        """
        if not self.is_linear:
            return self.srgb, 1.0
        factor = self.exposure
        alpha = np.float32(factor ** (1.0 / color.GAMMA))
        return np.clip(alpha * color.linear_to_gamma(self.codes), 0.0, 1.0), factor

    def linear(self, where: Any = ...) -> FloatArray:
        """Return ``photo_lin`` [1], shape [H, W, 3]: ``srgb ** 2.2``, or a plate's own values.

        Unlike `srgb`, a linear plate keeps what lies outside [0, 1].

        Args:
            where: Index of the pixels that are wanted; all of them when absent.
        """
        if self.is_linear:
            plate: FloatArray = self.codes[where].astype(np.float32, copy=False)
            return plate
        if where is ...:
            return by_pixel(color.gamma_to_linear, self.srgb)
        linear: FloatArray = color.gamma_to_linear(self.srgb[where])
        return linear

    def encode(
        self, srgb: FloatArray, changed: NDArray[np.bool_], kept: FloatArray | None = None
    ) -> PixelArray:
        """Turn an edited image into codes that can be saved in place of the photograph.

        Args:
            srgb: The edited image, display-encoded Rec.709, shape [H, W, 3].
            changed: Where it was edited, shape [H, W]; all other pixels keep their codes.
            kept: Share of the photograph's own light that is left [1], shape [H, W, 3]: it keeps
                as much of its colours beyond sRGB. Absent: nothing.

        Returns:
            Integer codes in the photograph's own type and profile, shape [H, W, 3]; 16-bit
            ones for a linear plate, which has no display codes to keep.
        """
        if self.is_linear:
            # Not the photo's own encoding come back, so what the file states: sRGB.
            linear = color.gamma_to_linear(np.clip(srgb, 0.0, 1.0).astype(np.float64))
            return np.round(color.linear_to_srgb(linear) * 65535.0).astype(np.uint16)
        top, box = np.iinfo(self.codes.dtype).max, mask_box(changed)
        own = srgb[box]
        if self.icc is not None and changed.any():
            if kept is not None:
                given = self.codes[box].astype(np.float32) / np.float32(top)
                whole = profile_to_srgb(given, self.icc)
                assert whole is not None, BOTH_WAYS
                own = own + (whole - self.srgb[box]) * by_pixel(color.linear_to_gamma, kept[box])
            in_profile = srgb_to_profile(own, self.icc)
            assert in_profile is not None, BOTH_WAYS
            own = in_profile
        codes = self.codes.copy()
        edited = np.clip(own[changed[box]].astype(np.float64), 0.0, 1.0)
        codes[box][changed[box]] = np.round(edited * top).astype(codes.dtype)
        return codes


EXPOSED_BY = 3e6
"""Number of values, evenly in the picture, that the exposure of a larger plate goes by."""
EVEN = 0.016
"""How far the values of a border may differ, as JPEG makes them, over the largest code [1]."""
LABELS = 0.05
"""Below this share of white the codes of a mask are labels, not shares."""


def read_photo(
    path: str | Path,
    *,
    max_pixels: int = LIMITS.pixels,
    alpha: str = "refuse",
    layer: str | None = None,
    strict: bool = False,
) -> Photo:
    """Read a photograph: JPEG, PNG, TIFF or WebP, or a linear plate in EXR, HDR or float TIFF.

    Args:
        path: The file; recognised by content, not by name.
        max_pixels: Largest image decoded [px] (``--max-pixels``).
        alpha: ``refuse`` a transparent image, or ``ignore`` its alpha (``--alpha``).
        layer: Layer or part of an EXR (``--layer``); its plain R, G and B when absent.
        strict: Refuse pixels that are not finite instead of setting them to black.

    Raises:
        InputError: Missing, not an image, truncated, too large, transparent, or in a colour
            space that cannot be converted.
    """
    path = Path(path)
    image = decode_image(path, max_pixels, layer=layer)
    notices = [*image.notices, *image.about_view]
    if _is_transparent(image):
        if alpha != "ignore":
            what = "partly transparent (found an alpha channel; expected an opaque photograph)"
            advice = "flatten it, or pass --alpha ignore"
            raise InputError(path, what, advice, reason="photo.transparent")
        notices.append("alpha channel ignored")
    codes = stored = _upright_rgb(image)
    if image.is_grey:
        notices.append("grey image expanded to three channels")
    if bool((codes == codes[0, 0]).all()):
        notices.append("no signal: every pixel has the same value")
    elif border := _border_of(codes):
        notices.append(
            f"a border of one colour, {border}: light, camera and look are estimated with it, "
            "so cut it off"
        )

    icc: bytes | None = None
    if codes.dtype.kind == "f":
        with np.errstate(over="ignore", invalid="ignore"):  # counted below
            plate = _to_rec709(codes.astype(np.float32, copy=False), image, notices)
        codes = plate = _finite(path, plate, strict, notices)
        notices.append(_about_plate(plate))
        srgb: FloatArray = np.clip(color.linear_to_gamma(plate), 0.0, 1.0)
    else:
        codes, srgb, icc = _to_srgb(path, codes, image, notices)
    is_coded = image.kind == "jpeg" and icc is None and codes is stored
    return Photo(
        np.ascontiguousarray(codes),
        np.ascontiguousarray(srgb),
        image.kind,
        icc,
        image.focal_35mm,
        tuple(notices),
        read_coding(path, image.orientation) if is_coded else None,
    )


def _border_of(codes: PixelArray) -> str:
    """Return how wide a letterbox's bars or a frame are, in words; nothing where there is none.

    Rows or columns of one colour at both of two opposite sides: at one side it may be the sky. They
    end at once: white snow under a white sky, and the dark of a night, do so bit by bit.
    """
    tolerance = EVEN * (np.iinfo(codes.dtype).max if codes.dtype.kind == "u" else 1.0)
    found = []
    for turned, sides in ((codes, ("top", "bottom")), (codes.swapaxes(0, 1), ("left", "right"))):
        color = turned[0].mean(axis=0)

        def width(lines: PixelArray, color: Float64Array = color) -> int:
            for k, line in enumerate(lines):
                if not (np.abs(line - color) <= tolerance).all():
                    # A little further in, beyond what JPEG smears.
                    beyond = np.abs(lines[min(k + 2, len(lines) - 1)] - color) > tolerance
                    return k if beyond.any(axis=-1).mean() > 0.5 else 0
            return 0  # nothing else is there

        widths = [width(turned), width(turned[::-1])]
        if all(widths):
            found += [f"{w} px at the {side}" for w, side in zip(widths, sides, strict=True)]
    return ", ".join(found)


def read_envmap(
    path: str | Path,
    *,
    convention: str = "openexr",
    camera_to_world: Float64Array | None = None,
    pictures: bool = False,
    strict: bool = False,
    max_width: int = LIMITS.envmap_width,
    notices: list[str] | None = None,
) -> FloatArray:
    """Read a lat-long environment map and turn it to our orientation; never clamped.

    Ours is OpenEXR's: image centre +Z, left quarter +X, so the texel at (u, v) shines from
    ``(sin lon cos lat, sin lat, cos lon cos lat)``, ``lon = pi (1 - 2u)``, ``lat = pi (1/2 - v)``.

    Args:
        path: A 2:1 file, recognised by content: ``.hdr`` or ``.exr``.
        convention: Who made the map: a key of `envmap_conventions.SEAM_SHIFTS`.
        camera_to_world: Pose of the camera, shape [4, 4], for a map in camera axes.
        pictures: Whether JPEG, PNG, TIFF and WebP are read too; codes of 8 and 16 bits are
            decoded as sRGB and lack what is brighter than white, floats are radiance.
        strict: Refuse NaN, infinite and negative values instead of repairing them.
        max_width: Widest map decoded [px] (``--max-envmap-width``).
        notices: One line per repair is appended here.

    Returns:
        Radiance, relative [W/(m^2 sr)], finite and not negative, shape [He, We, 3].

    Raises:
        InputError: Missing, damaged, not 2:1, not of these formats, or (strict) not clean.
    """
    path = Path(path)
    kinds = ("exr", "hdr", "jpeg", "png", "tiff", "webp") if pictures else ("exr", "hdr")
    image = decode_image(path, max_width * max_width // 2, kinds, flag="--max-envmap-width")
    messages = list(image.notices)
    codes = _upright_rgb(image)
    height, width = codes.shape[:2]
    if width != 2 * height or height < 2:
        raise InputError(
            path,
            f"not a lat-long map (found {width} x {height}; expected 2:1)",
            "resize it to twice as wide as high",
            reason="envmap.not_two_to_one",
            found=(width, height),
        )
    if image.alpha is not None and image.kind != "exr":
        messages.append("alpha channel ignored")
    texels = _radiance(path, codes, image, messages)
    _repair_radiance(path, texels, strict, messages)
    # Colours outside Rec.709 are negative in it, and no light is.
    with np.errstate(over="ignore", invalid="ignore"):  # refused below
        texels = _to_rec709(texels, image, messages)
        np.maximum(texels, 0.0, out=texels)
    _check_brightness(path, texels, messages)
    if notices is not None:
        notices += messages
    return to_ours(texels, convention, camera_to_world)


def read_mask(
    path: str | Path,
    photo_size: tuple[int, int],
    *,
    max_pixels: int = LIMITS.pixels,
    notices: list[str] | None = None,
) -> FloatArray:
    """Read a mask that belongs to a photograph: grey, upright, of the photograph's size.

    Codes are shares, not colours: no profile and no transfer function is applied.

    Args:
        path: 8 or 16 bits, float, 1 bit or a palette; RGB where its channels are equal.
        photo_size: Width and height of the upright photograph [px].
        max_pixels: Largest image decoded [px] (``--max-pixels``).
        notices: One line per thing that was left out, or looks odd, is appended here.

    Returns:
        Share of the pixel, 0 (black) to 1 (white) [1], shape [H, W].

    Raises:
        InputError: Missing, damaged, of another size, coloured, or floats outside [0, 1].
    """
    path = Path(path)
    width, height = photo_size
    image = decode_image(path, max_pixels)
    codes = upright(image.pixels, image.orientation)
    if codes.shape[:2] != (height, width):
        raise InputError(
            path,
            f"not of the photo's size (found {codes.shape[1]} x {codes.shape[0]}; expected "
            f"{width} x {height}, the upright photo)",
            "resize it, or draw it over the upright photo",
            reason="mask.size",
            found=codes.shape[1::-1],
            limit=photo_size,
        )
    _check_grey(path, codes)
    is_even = bool((codes == codes[0, 0]).all())
    messages = list(image.notices)
    if image.alpha is not None:
        if is_even and not bool((image.alpha == image.alpha[0, 0]).all()):
            what = "one value everywhere, and only its alpha differs (expected a grey image)"
            advice = "save the alpha channel as a greyscale image"
            raise InputError(path, what, advice, reason="mask.alpha")
        messages.append("alpha channel ignored")
    if is_even:
        messages.append("no signal: every pixel has the same value")
    mask = codes[..., 0].astype(np.float32)
    if codes.dtype.kind != "f":
        mask /= np.float32(np.iinfo(codes.dtype).max)
    if notices is not None:
        notices += messages
    return np.ascontiguousarray(mask)


def _check_grey(path: Path, codes: PixelArray) -> None:
    """Refuse what is no mask: colours, floats beyond 0 to 1, and labels."""
    if codes.dtype.kind == "f" and not bool(((codes >= 0.0) & (codes <= 1.0)).all()):
        what = "not a mask (found floats outside 0 to 1, or not finite)"
        raise InputError(path, what, reason="mask.range")
    if not bool((codes == codes[..., :1]).all()):
        what = "not a mask (found three channels that differ; expected a grey image)"
        advice = "save it as greyscale: black is 0, white is 1"
        raise InputError(path, what, advice, reason="mask.colored")
    if codes.dtype.kind != "f":
        white, brightest = np.iinfo(codes.dtype).max, int(codes.max())
        if 0 < brightest < LABELS * white:
            raise InputError(
                path,
                f"all but black (found {brightest} at most; expected {white} for white)",
                "multiply labels of 0 and 1 by 255",
                reason="mask.labels",
                found=brightest,
                limit=white,
            )


def _upright_rgb(image: DecodedImage) -> PixelArray:
    """Return the pixels as they are to be seen, grey ones three times, shape [H, W, 3]."""
    codes = upright(image.pixels, image.orientation)
    return np.repeat(codes, 3, axis=-1) if image.is_grey else codes


def _is_transparent(image: DecodedImage) -> bool:
    """Return whether any pixel is not opaque."""
    if image.alpha is None:
        return False
    is_float = image.pixels.dtype.kind == "f"
    opaque = 1.0 if is_float else np.iinfo(image.pixels.dtype).max
    return not bool(np.all(image.alpha >= opaque))


def _radiance(path: Path, codes: PixelArray, image: DecodedImage, notices: list[str]) -> FloatArray:
    """Return the values of a panorama as radiance, not yet checked, shape [height, width, 3]."""
    if codes.dtype.kind == "f":
        with np.errstate(over="ignore"):  # `_repair_radiance` counts them
            return np.asarray(codes, dtype=np.float32)
    srgb = _to_srgb(path, codes, image, notices)[1]
    notices.append(
        "a picture, not high dynamic range: decoded as sRGB; lamps and a sun in it are no "
        "brighter than its white"
    )
    return color.srgb_to_linear(srgb).astype(np.float32)


def _check_brightness(path: Path, texels: FloatArray, notices: list[str]) -> None:
    """Refuse radiance above `RADIANCE_LIMIT`; note a map that is black."""
    brightest = float(texels.max())
    if not brightest <= RADIANCE_LIMIT:
        raise InputError(
            path,
            f"too bright (found a radiance of {brightest:g}; limit {RADIANCE_LIMIT:g})",
            "divide its values, and give --exposure",
            reason="envmap.too_bright",
            found=brightest,
            limit=RADIANCE_LIMIT,
        )
    if brightest == 0.0:
        notices.append("no light: every texel is 0")


def _repair_radiance(path: Path, texels: FloatArray, strict: bool, notices: list[str]) -> None:
    """Put finite, non-negative numbers in place of others, in the array given, with a notice."""
    bad = ~np.isfinite(texels)
    negative = texels < 0.0
    negative &= ~bad
    if not (bad.any() or negative.any()):
        return
    found = (
        f"{int(np.isnan(texels).sum())} NaN, {int(np.isinf(texels).sum())} infinite, "
        f"{int(negative.sum())} negative values"
    )
    if strict:
        what = f"not clean radiance (found {found}; expected finite values >= 0)"
        raise InputError(path, what, reason="envmap.not_clean", found=found)
    brightest = float(texels[~bad].max(initial=0.0))
    if brightest == 0.0:
        what = f"no light in it (found {found} beside 0)"
        raise InputError(path, what, reason="envmap.no_light", found=found)
    texels[np.isposinf(texels)] = brightest
    texels[~(texels >= 0.0)] = 0.0
    notices.append(f"{found} repaired: +Inf to the brightest finite value, the others to 0")


def _to_srgb(
    path: Path, codes: PixelArray, image: DecodedImage, notices: list[str]
) -> tuple[PixelArray, FloatArray, bytes | None]:
    """Return codes [H, W, 3], the same as sRGB in [0, 1], and the profile that they are in."""
    srgb = codes.astype(np.float32)
    srgb /= np.float32(np.iinfo(codes.dtype).max)
    icc = image.icc
    if image.kind == "png":
        icc, ignored = png_profile(path, icc)
        notices += ignored
    elif image.kind == "jpeg" and icc is None and not image.is_grey:
        icc = camera_profile(path)
    if icc is None:
        return codes, srgb, None
    codes, srgb, icc, notice = convert_profile(
        path, codes, srgb, grey_profile(icc) if image.is_grey else icc
    )
    notices += [notice] if notice else []
    return codes, srgb, icc


def _to_rec709(linear: FloatArray, image: DecodedImage, notices: list[str]) -> FloatArray:
    """Bring a float image to linear Rec.709 from the primaries that its header states."""
    if image.icc is not None:
        notices.append("colour profile of a float image is not followed")
    if image.primaries is None:
        return linear
    notices.append("colours converted from the primaries of the header to Rec.709")
    return linear @ color.primaries_to_rec709(image.primaries).T.astype(np.float32)


def _about_plate(plate: FloatArray) -> str:
    """Word what becomes of a linear plate."""
    text = "float image taken as scene-linear; layers.exr holds its composite as linear floats"
    outside = int(((plate < 0.0) | (plate > 1.0)).any(axis=-1).sum())
    if outside:
        text += f", composite.png clips {outside} pixels to 0..1"
    return text


def _finite(path: Path, plate: FloatArray, strict: bool, notices: list[str]) -> FloatArray:
    """Set non-finite pixels to black, and say how many there were."""
    bad = ~np.isfinite(plate).all(axis=-1)
    count = int(bad.sum())
    if not count:
        return plate
    if strict:
        what = f"not finite (found {count} such pixels; expected none)"
        raise InputError(path, what, reason="photo.not_finite", found=count)
    notices.append(f"{count} non-finite pixels set to 0")
    plate = plate.copy()
    plate[bad] = 0
    return plate
