"""The bytes behind an asset: regular files inside its own folder, within limits; textures as RGBA.

Shared by the readers `warpir.gltf` and `warpir.obj`. Nothing here opens a network connection,
follows a link out of the asset's folder or allocates before the size is known.
"""

import base64
import binascii
import re
import stat
import warnings
from io import BytesIO
from pathlib import Path
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from warpir.asset import Material, Primitive
from warpir.errors import InputError

FILE_BYTES = 2 << 30
"""Largest mesh, buffer or image file [byte]."""
TRIANGLES = 20_000_000
"""Most triangles of an asset, instances counted."""
EXTENT = 1e18
"""Largest coordinate [m]; its square still fits float32."""
TEXTURE_PIXELS = 512_000_000
"""Most pixels of all textures together."""
GREY = 188
"""sRGB code that stands for a missing base colour texture: linear 0.5."""
NOTICES = 40
"""Most notices of an asset."""

Pixels = NDArray[np.uint8]


def read_regular(path: Path, where: str | Path, pointer: str = "") -> bytes:
    """Return the content of a regular file, refusing folders, devices, pipes and giants.

    Args:
        path: The file to read.
        where: The asset that is named in an error.
        pointer: The place in the asset that refers to ``path``, ending in ``: ``, or empty.

    Raises:
        InputError: It cannot be read, is empty, or is larger than ``FILE_BYTES``.
    """
    named = "" if Path(where) == path else f"{path.name}: "
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise InputError(where, f"{pointer}{named}not a regular file")
        if status.st_size > FILE_BYTES:
            raise InputError(
                where,
                f"{pointer}{named}too large (found {status.st_size} bytes; limit {FILE_BYTES})",
            )
        content = path.read_bytes()
    except OSError as error:
        raise InputError(where, f"{pointer}{named}{error.strerror or error}") from None
    if not content:
        raise InputError(where, f"{pointer}{named}empty file")
    return content


def inside(folder: Path, uri: str, where: Path, pointer: str = "") -> Path:
    """Resolve a relative file name, links included, and insist that it stays in ``folder``.

    Args:
        folder: The folder of the asset.
        uri: Relative path with ``/``, already percent-decoded.
        where: The asset that is named in an error.
        pointer: The place in the asset, ending in ``: ``, or empty.

    Raises:
        InputError: The name is empty, absolute, a URL, or leads out of the folder.
    """
    outside = InputError(
        where,
        f"{pointer}{uri[:80]!r} is outside the asset folder",
        "put all files of the asset into one folder and refer to them by relative names",
    )
    if not uri or "\0" in uri or uri.startswith("/") or re.match(r"[A-Za-z][A-Za-z0-9+.-]*:", uri):
        raise outside
    try:
        root = folder.resolve()
        target = (root / uri).resolve()
    except (OSError, RuntimeError):  # a loop of links
        raise outside from None
    if not target.is_relative_to(root):
        raise outside
    return target


def read_uri(uri: str, where: Path, pointer: str) -> bytes:
    """Return the bytes behind a glTF URI: a base64 ``data:`` URI or a file next to the asset.

    Raises:
        InputError: The URI leaves the folder, is damaged, or its file cannot be read.
    """
    if uri.startswith("data:"):
        head, comma, payload = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise InputError(where, f"{pointer}data: URI is not base64")
        try:
            return base64.b64decode(payload, validate=True)
        except (binascii.Error, ValueError) as error:
            raise InputError(where, f"{pointer}data: URI is damaged ({error})") from None
    return read_regular(locate(uri, where, pointer), where, pointer)


def locate(uri: str, where: Path, pointer: str) -> Path:
    """Return the file that a relative glTF URI means, percent-decoded once.

    Raises:
        InputError: It is not UTF-8 or leaves the asset's folder.
    """
    try:
        name = unquote(uri, errors="strict")
    except UnicodeDecodeError:
        raise InputError(where, f"{pointer}URI is not UTF-8 after percent-decoding") from None
    return inside(where.parent, name, where, pointer)


class TextureDecoder:
    """Decodes the images of one asset and keeps count of their pixels.

    Args:
        where: The asset that is named in an error.
        notices: Receives one line per repair.
    """

    def __init__(self, where: Path, notices: list[str]) -> None:
        self.where = where
        self.notices = notices
        self.pixel_count = 0

    def decode(self, encoded: bytes, pointer: str) -> Pixels:
        """Decode a PNG, JPEG or WebP image to RGBA codes, shape [height, width, 4].

        Colour profiles and orientation tags are ignored, as the glTF specification demands;
        16-bit images are reduced to 8 bits.

        Args:
            encoded: The image file's content.
            pointer: The place in the asset, ending in ``: ``.

        Raises:
            InputError: Another format, damaged, or beyond the pixel limit.
        """
        from PIL import Image

        if encoded[1:5] == b"KTX ":
            raise InputError(
                self.where,
                f"{pointer}KTX2 texture (expected PNG, JPEG or WebP)",
                "re-export with PNG or JPEG textures, without KHR_texture_basisu",
            )
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", Image.DecompressionBombWarning)
                image: Image.Image = Image.open(BytesIO(encoded), formats=["PNG", "JPEG", "WEBP"])
                self._count(image.width * image.height, pointer)
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
            raise InputError(self.where, f"{pointer}image cannot be decoded ({short})") from None

    def _count(self, pixel_count: int, pointer: str) -> None:
        self.pixel_count += pixel_count
        if self.pixel_count > TEXTURE_PIXELS:
            raise InputError(
                self.where,
                f"{pointer}too many texture pixels (found {self.pixel_count} so far; "
                f"limit {TEXTURE_PIXELS})",
                "use smaller textures",
            )


def grey_pixels() -> Pixels:
    """Return the one texel that replaces a missing base colour texture, shape [1, 1, 4]."""
    return np.array([[[GREY, GREY, GREY, 255]]], dtype=np.uint8)


def keep_area(
    positions: NDArray[np.float64], indices: NDArray[np.int32]
) -> tuple[NDArray[np.int32], int, int]:
    """Drop triangles that no ray can hit and exact repetitions.

    Args:
        positions: Any frame [m], shape [vertex, 3].
        indices: Shape [triangle, 3].

    Returns:
        The remaining triangles, C-contiguous, the number without area, and the number of
        repetitions (the same three vertices in the same cyclic order).
    """
    a, b, c = (positions[indices[:, k]] for k in range(3))
    with np.errstate(over="ignore", invalid="ignore"):  # `check_drawable` refuses such sizes
        area_squared = np.square(np.cross(b - a, c - a)).sum(axis=1)
        longest_squared = np.maximum(np.square(b - a).sum(axis=1), np.square(c - a).sum(axis=1))
        # Collinear corners leave rounding errors of float64, relative to the longest side.
        flat = area_squared <= np.square(1e-12 * longest_squared)
        flat &= np.isfinite(area_squared)
    kept = indices[~flat] if flat.any() else indices
    # Start each triangle at its lowest vertex, so that equal triangles are equal rows.
    first = kept.argmin(axis=1)
    rows = np.arange(len(kept))
    key = [kept[rows, (first + k) % 3] for k in range(3)]
    order = np.lexsort(key)
    same = np.ones(max(len(kept) - 1, 0), dtype=bool)
    for column in key:
        same &= np.diff(column[order]) == 0
    repeated = np.sort(order[1:][same])
    if len(repeated):
        kept = np.delete(kept, repeated, axis=0)
    return np.ascontiguousarray(kept), int(flat.sum()), len(repeated)


def repair_normals(
    normals: NDArray[np.float64], positions: NDArray[np.float64], indices: NDArray[np.int32]
) -> tuple[NDArray[np.float32], int]:
    """Normalise shading normals; those of length zero become the mean of their triangles.

    Args:
        normals: Any length, shape [vertex, 3].
        positions: The same frame [m], shape [vertex, 3].
        indices: Shape [triangle, 3].

    Returns:
        Unit normals, shape [vertex, 3], and how many had no length.
    """
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    lost = length[:, 0] < 1e-20
    if lost.any():
        a, b, c = (positions[indices[:, k]] for k in range(3))
        area = np.cross(b - a, c - a)
        mean = np.zeros_like(normals)
        for k in range(3):
            np.add.at(mean, indices[:, k], area)
        normals = np.where(lost[:, None], mean, normals)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        still = length[:, 0] < 1e-20  # vertices that no triangle uses, or a folded pair
        normals = np.where(still[:, None], [0.0, 1.0, 0.0], normals)
    return unit(normals), int(lost.sum())


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float32]:
    """Normalise the rows, shape [vertex, 3]; zeros stay, and so does what float32 calls unit.

    Stored unit vectors are 6e-8 off in length. Left alone, they read back as they were written.
    """
    with np.errstate(over="ignore"):  # beyond float32 is no unit vector either
        stored = vectors.astype(np.float32)
    is_unit = np.abs(np.linalg.norm(stored.astype(np.float64), axis=1, keepdims=True) - 1.0) < 1e-7
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    scaled = vectors / np.where(length > 0.0, length, 1.0)
    return np.where(is_unit, stored, scaled).astype(np.float32)


def check_drawable(where: Path, primitives: list[Primitive], found: str) -> None:
    """Refuse an asset without triangles, or beyond what float32 kernels can place.

    Args:
        where: The asset.
        primitives: What was read.
        found: What the file has instead of triangles.

    Raises:
        InputError: ``primitives`` is empty or a coordinate is not below ``EXTENT``.
    """
    if not primitives:
        raise InputError(where, f"nothing to render (found {found}; expected triangles)")
    largest = max(float(np.abs(p.positions).max()) for p in primitives)
    if not largest < EXTENT:
        raise InputError(
            where, f"coordinates up to {largest:g} (expected below {EXTENT:g})", "scale it down"
        )


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
