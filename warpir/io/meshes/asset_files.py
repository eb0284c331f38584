"""The bytes behind an asset: regular files inside its own folder, within limits; textures as RGBA.

Shared by the readers `warpir.io.gltf.reader` and `warpir.io.meshes.obj`. Nothing here opens a
network connection, follows a link out of the asset's folder or allocates before the size is known.
"""

import base64
import binascii
import hashlib
import os
import re
import stat
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote

import numpy as np

from warpir.core.arrays import CodeArray
from warpir.core.errors import InputError
from warpir.core.limits import Limits
from warpir.io.images.kinds import open_by_pillow
from warpir.scene.asset import ABSENT, Material

GREY = (0.8, 0.8, 0.8)
"""Base colour where the file states none."""
GREY_CODE = 188
"""sRGB code that stands for a missing base colour texture: linear 0.5."""
NOTICES = 40
"""Most notices of an asset."""


def read_regular(
    path: Path,
    where: Path,
    limits: Limits,
    pointer: str = "",
    limit: str = "file_bytes",
    hashes: dict[str, str] | None = None,
) -> bytes:
    """Return the content of a regular file, refusing folders, devices, pipes and giants.

    ``where`` is the asset that an error names, and ``pointer`` the place in it that refers to the
    file; ``hashes`` receives the sha256, see `warpir.scene.asset.Asset.hashes`.

    Raises:
        InputError: It cannot be read, is empty, or is too large.
    """
    if hashes is not None:
        name = "" if path == where else os.path.relpath(path, where.parent.resolve())
        hashes[name] = ABSENT
    place = pointer if path == where else f"{pointer}{path.name}: "
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(where, f"{place}not a regular file", reason="file.not_regular")
        limits.check(limit, status.st_size, where, f"{place}too large", more=" bytes")
        content = path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name that no file can have
        reason = error.strerror if isinstance(error, OSError) else "not a file name"
        raise InputError(where, f"{place}{reason}", reason="file.unreadable") from None
    if not content:
        raise InputError(where, f"{place}empty file", reason="file.empty")
    if hashes is not None:
        hashes[name] = hashlib.sha256(content).hexdigest()
    return content


def inside(uri: str, where: Path, pointer: str = "") -> Path:
    """Resolve a relative file name, links included; it must stay in the folder of ``where``.

    The name has ``/`` and is already percent-decoded. An error names the asset ``where`` and the
    place in it, which is empty or ends in ``: ``.

    Raises:
        InputError: The name is empty, absolute, a URL, or leads out of the folder.
    """
    outside = InputError(
        where,
        f"{pointer}{uri[:80]!r} is outside the asset folder",
        "put all files of the asset into one folder and refer to them by relative names",
        reason="file.outside",
        found=uri,
    )
    if (
        not uri
        or "\0" in uri
        or uri.startswith(("/", "\\"))
        or re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", uri)
    ):
        raise outside
    try:
        root = where.parent.resolve()
        target = (root / uri).resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise outside from None
    if not target.is_relative_to(root):
        raise outside
    return target


def read_uri(
    uri: str,
    where: Path,
    pointer: str,
    limits: Limits,
    hashes: dict[str, str],
) -> bytes:
    """Return the bytes behind a glTF URI: a base64 ``data:`` URI or a file next to the asset.

    Raises:
        InputError: The URI leaves the folder, is damaged, or its file cannot be read.
    """
    if uri.startswith("data:"):
        head, comma, payload = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise InputError(where, f"{pointer}data: URI is not base64", reason="file.data_uri")
        try:
            return base64.b64decode(payload, validate=True)
        except (binascii.Error, ValueError) as error:
            raise InputError(
                where, f"{pointer}data: URI is damaged ({error})", reason="file.data_uri"
            ) from None
    return read_regular(locate(uri, where, pointer), where, limits, pointer, hashes=hashes)


def locate(uri: str, where: Path, pointer: str) -> Path:
    """Return the file that a relative glTF URI means, percent-decoded once.

    Raises:
        InputError: It is not UTF-8 or leaves the asset's folder.
    """
    try:
        name = unquote(uri, errors="strict")
    except UnicodeDecodeError:
        raise InputError(
            where, f"{pointer}URI is not UTF-8 after percent-decoding", reason="file.name"
        ) from None
    return inside(name, where, pointer)


class TextureDecoder:
    """Decodes the images of one asset and keeps count of their pixels, which are limited together.

    ``notices`` receives one line per repair. One that ``measures`` only counts the pixels: what is
    decoded is one grey texel.
    """

    def __init__(
        self, where: Path, notices: list[str], limits: Limits, measures: bool = False
    ) -> None:
        self.where = where
        self.measures = measures
        self.notices = notices
        self.limits = limits
        self.pixel_count = 0
        self.byte_count = 0

    def decode(self, encoded: bytes, pointer: str) -> CodeArray:
        """Decode a PNG, JPEG or WebP image to RGBA codes, shape [height, width, 4].

        Colour profiles and orientation tags are ignored, as the glTF specification demands;
        16-bit images are reduced to 8 bits. ``pointer`` is the place in the asset, with ``: ``.

        Raises:
            InputError: Another format, damaged, or beyond a limit of all textures.
        """
        from PIL import Image

        self.byte_count += len(encoded)
        what = f"{pointer}too many bytes of textures"
        self.limits.check("file_bytes", self.byte_count, self.where, what, more=" so far")
        if encoded[1:5] == b"KTX ":
            raise InputError(
                self.where,
                f"{pointer}KTX2 texture (expected PNG, JPEG or WebP)",
                "re-export with PNG or JPEG textures, without KHR_texture_basisu",
                reason="texture.format",
                found="KTX2",
            )
        try:
            image = open_by_pillow(BytesIO(encoded), ("PNG", "JPEG", "WEBP"))
            self.count(image.width * image.height, pointer)
            if self.measures:
                return grey_pixels()
            image.load()
            if image.format == "PNG" and encoded[24:25] == b"\x10":
                self.notices.append(f"{pointer}16-bit texture reduced to 8 bits")
            if image.mode.startswith("I"):
                # 16-bit grey: Pillow's own conversion would clip instead of scaling.
                grey = np.asarray(image).astype(np.uint32) >> 8
                image = Image.fromarray(grey.astype(np.uint8))
            return np.array(image.convert("RGBA"))
        except (InputError, MemoryError):
            raise
        except Exception as error:  # Pillow raises a dozen kinds, struct.error among them
            short = "not a PNG, JPEG or WebP image" if "identify" in str(error) else str(error)
            raise InputError(
                self.where, f"{pointer}image cannot be decoded ({short})", reason="texture.damaged"
            ) from None

    def count(self, pixel_count: int, pointer: str) -> None:
        """Count the pixels of a texture that is about to be made.

        Raises:
            InputError: They are too many, together with those that are there.
        """
        self.pixel_count += pixel_count
        self.limits.check(
            "texture_pixels",
            self.pixel_count,
            self.where,
            f"{pointer}too many texture pixels",
            more=" so far",
            advice="use smaller textures",
        )


def grey_pixels() -> CodeArray:
    """Return the one texel that replaces a missing base colour texture, shape [1, 1, 4]."""
    return np.array([[[GREY_CODE, GREY_CODE, GREY_CODE, 255]]], dtype=np.uint8)


def plain_material(name: str, base_color: tuple[float, float, float]) -> Material:
    """Return what stands for an unstated material: rough dielectric, both sides visible."""
    return Material(
        name=name, base_color=base_color, metallic=0.0, roughness=0.5, double_sided=True
    )


def concise(notices: list[str]) -> tuple[str, ...]:
    """Return the different notices in order, cut to ``NOTICES`` lines with a count of the rest."""
    different = list(dict.fromkeys(notices))
    if len(different) > NOTICES:
        rest = len(different) - NOTICES + 1
        different[NOTICES - 1 :] = [f"and {rest} more notices"]
    return tuple(different)
