"""Colour profiles (ICC): from a photo's own codes to sRGB and back.

OpenColorIO, behind OpenImageIO, reads matrix profiles in float; profiles with tables go through
Pillow, in 8 bits and one way only.
"""

import hashlib
import io
import struct
import tempfile
from pathlib import Path

import numpy as np

from warpir import color
from warpir.errors import InputError
from warpir.image_decoder import FloatArray, Pixels, captured_stderr


def convert_profile(
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
    back = srgb_to_profile(expected, icc)
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
