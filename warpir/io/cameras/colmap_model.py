"""What the files of a COLMAP model hold, text or binary: cameras, images and points.

https://colmap.github.io/format.html
"""

import math
import os
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from warpir.core.arrays import Float64Array
from warpir.core.errors import Faults, InputError
from warpir.core.limits import LIMITS, Limits
from warpir.io.cameras.source import SIZE_LIMIT

MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}
"""Number of parameters by model, in the order of their binary ids."""
POINT_BYTES = 24
"""Of an image's point in ``images.bin``: two coordinates and the id of its 3D point."""
COLMAP = Faults(
    "colmap",
    {
        "count": "damaged: records of {least} bytes or more, in {size} bytes",
        "id": "unknown model",
        "line": "damaged",
        "missing": ("no COLMAP model there", "give its folder, such as sparse/0"),
        "model": (
            "this camera model is not supported",
            "undistort the images with COLMAP's image_undistorter",
        ),
        "name": "damaged: a name too long",
        "no_camera": "image {image} was taken with camera {camera}, which is missing",
        "parameter_count": "wrong parameter count",
        "quaternion": "not a unit quaternion, by its length",
        "rest": "damaged: bytes after the last record",
        "text": "not UTF-8 text",
        "truncated": "truncated: its bytes end in a record",
        "unreadable": "cannot be read",
    },
)
"""What a model may have wrong."""


@dataclass(frozen=True)
class Intrinsics:
    """A line of ``cameras.txt``."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class Image:
    """A pair of lines of ``images.txt``, without the points."""

    name: str
    quaternion: tuple[float, ...]
    """World to camera, w x y z [1]."""
    translation: tuple[float, ...]
    """World to camera, in units of the world."""
    camera_id: int


def is_model(path: Path) -> bool:
    """Whether a path is a folder, or a file of a model by its name."""
    return os.path.isdir(path) or (  # unlike Path's, False too for a name that is too long
        path.suffix in (".txt", ".bin") and path.stem in ("cameras", "images", "points3D")
    )


def model_files(path: Path, *stems: str, limits: Limits = LIMITS) -> list[Path]:
    """Return the files of a model, binary ones first, as COLMAP looks for them.

    The path is the model's folder, or one of its files, whose kind is then taken; stems are
    ``cameras``, ``images`` or ``points3D``.

    Raises:
        InputError: A file is missing or too large.
    """
    folder = path if path.is_dir() else path.parent
    kinds = (".bin", ".txt") if path.is_dir() else (path.suffix,)
    for kind in kinds:
        files = [folder / f"{stem}{kind}" for stem in stems]
        if all(map(os.path.isfile, files)):
            for file in files:
                size = file.stat().st_size
                limits.check("file_bytes", size, file, "too large", more=" bytes")
            return files
    expected = " or ".join(" and ".join(stem + kind for stem in stems) for kind in kinds[::-1])
    raise COLMAP.error(path, "missing", expected=expected)


def read_cameras(path: Path) -> dict[int, Intrinsics]:
    """Read the cameras of ``cameras.txt`` or ``cameras.bin`` by their ids.

    Raises:
        InputError: Damaged.
    """
    return _binary_cameras(path) if path.suffix == ".bin" else _text_cameras(path)


def read_images(path: Path) -> list[Image]:
    """Read the images of ``images.txt`` or ``images.bin``.

    Raises:
        InputError: Damaged.
    """
    return list(_binary_images(path) if path.suffix == ".bin" else _text_images(path))


def read_points(path: Path, limits: Limits) -> Float64Array:
    """Read the points of a model, world of the file, shape [point, 3].

    Raises:
        InputError: Missing, damaged or too large.
    """
    (points_path,) = model_files(path, "points3D", limits=limits)
    if points_path.suffix == ".txt":
        rows: list[Sequence[float]] = []
        for where, line in _lines(points_path):
            words = line.split(maxsplit=8)
            _require(points_path, where, len(words) >= 8, f"{len(words)} values", "at least 8")
            rows.append(_floats(points_path, where, words[1:4]))
            limits.check("points", len(rows), points_path, "too many points", more=" so far")
        return np.array(rows, dtype=np.float64).reshape(-1, 3)
    with _Binary(points_path) as file:
        rows = []
        count = file.count(43)
        limits.check("points", count, points_path, "too many points")
        for _ in range(count):
            rows.append(file.take("<8x3d3x8x"))
            file.skip(8 * file.take("<Q")[0])
        file.end()
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


# ------------------------------------------------------------------------------------------- text


def _text_cameras(path: Path) -> dict[int, Intrinsics]:
    cameras = {}
    for where, line in _lines(path):
        words = line.split()
        _require(path, where, len(words) >= 4, f"{len(words)} values", "at least 4")
        camera_id = _integer(path, where, words[0])
        _require(path, where, camera_id not in cameras, f"camera {camera_id} again", "each id once")
        width, height = (_integer(path, where, word) for word in words[2:4])
        parameters = _floats(path, where, words[4:])
        cameras[camera_id] = _intrinsics(path, where, words[1], width, height, parameters)
    return cameras


def _text_images(path: Path) -> Iterator[Image]:
    lines = _lines(path, with_blank=True)
    for where, line in lines:
        if not line:
            continue
        words = line.split(maxsplit=9)  # the name may hold blanks
        _require(path, where, len(words) == 10, f"{len(words)} values", "10 of an image")
        numbers = _floats(path, where, words[1:8])
        camera_id = _integer(path, where, words[8])
        image = Image(words[9], tuple(numbers[:4]), tuple(numbers[4:]), camera_id)
        # The second line of a pair holds the points; it may be empty, or end the file.
        where, line = next(lines, (where, ""))
        found = len(line.split())
        _require(path, where, found % 3 == 0, f"{found} values", "x y id of the image's points")
        yield image


def _lines(path: Path, with_blank: bool = False) -> Iterator[tuple[str, str]]:
    """Yield each line that is not a comment, and where it stands."""
    try:
        with path.open(encoding="utf-8-sig") as stream:
            for number, line in enumerate(stream, 1):
                line = line.strip()
                if (line or with_blank) and not line.startswith("#"):
                    yield f"line {number}", line
    except UnicodeDecodeError as error:
        raise COLMAP.error(path, "text") from error
    except OSError as error:
        raise COLMAP.error(path, "unreadable", found=error.strerror) from error


def _require(path: Path, where: str, fulfilled: bool, found: str, expected: str) -> None:
    if not fulfilled:
        raise COLMAP.error(path, "line", pointer=where, found=found, expected=expected)


def _integer(path: Path, where: str, word: str) -> int:
    _require(path, where, word.isascii() and word.isdigit(), ascii(word[:20]), "a whole number")
    return int(word[:19])


def _floats(path: Path, where: str, words: Sequence[str]) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = [math.nan]
    _require(path, where, all(map(math.isfinite, numbers)), " ".join(words)[:60], "finite numbers")
    return numbers


def _intrinsics(
    path: Path, where: str, model: str, width: int, height: int, parameters: Sequence[float]
) -> Intrinsics:
    """Check what text and binary have in common."""
    if model in MODELS and len(parameters) != MODELS[model]:
        found, expected = len(parameters), MODELS[model]
        raise COLMAP.error(
            path, "parameter_count", pointer=where, found=found, expected=expected, model=model
        )
    sized = 1 <= width <= SIZE_LIMIT and 1 <= height <= SIZE_LIMIT
    _require(path, where, sized, f"{width} x {height}", "an image size")
    return Intrinsics(model, width, height, tuple(parameters))


# ----------------------------------------------------------------------------------------- binary


NAME_BYTES = 4096
"""Longest name of an image: that of a path."""


class _Binary:
    """A binary file of little-endian numbers, read from start to end."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.size = path.stat().st_size
        try:
            self.stream: BinaryIO = path.open("rb")
        except OSError as error:
            raise COLMAP.error(path, "unreadable", found=error.strerror) from error

    def __enter__(self) -> "_Binary":
        return self

    def __exit__(self, *_: object) -> None:
        self.stream.close()

    def take(self, form: str) -> tuple[Any, ...]:
        """Read the numbers of a `struct` format."""
        wanted = struct.calcsize(form)
        raw = self.stream.read(wanted)
        if len(raw) < wanted:
            raise self.truncated()
        return struct.unpack(form, raw)

    def count(self, least: int) -> int:
        """Read how many records follow, each of at least so many bytes."""
        (number,) = self.take("<Q")
        if number * least > self.size:
            raise COLMAP.error(self.path, "count", found=number, least=least, size=self.size)
        return int(number)

    def skip(self, size: int) -> None:
        """Pass over some bytes."""
        if size > self.size - self.stream.tell():
            raise self.truncated()
        self.stream.seek(size, 1)

    def text(self) -> str:
        """Read a text that ends with a zero byte."""
        raw = bytearray()
        while (byte := self.stream.read(1)) != b"\0":
            if not byte:
                raise self.truncated()
            raw += byte
            if len(raw) > NAME_BYTES:
                raise COLMAP.error(self.path, "name", limit=NAME_BYTES)
        return raw.decode("utf-8", "replace")

    def end(self) -> None:
        """Require that nothing follows."""
        if (left := self.size - self.stream.tell()) > 0:
            raise COLMAP.error(self.path, "rest", found=left)

    def truncated(self) -> InputError:
        """Return the error of a file that ends too early."""
        return COLMAP.error(self.path, "truncated", found=self.size)


def _binary_cameras(path: Path) -> dict[int, Intrinsics]:
    cameras = {}
    names = tuple(MODELS)
    with _Binary(path) as file:
        for _ in range(file.count(24 + 3 * 8)):
            camera_id, model_id, width, height = file.take("<IiQQ")
            where = f"camera {camera_id}"
            if not 0 <= model_id < len(names):
                raise COLMAP.error(path, "id", pointer=where, found=model_id)
            parameters = file.take(f"<{MODELS[names[model_id]]}d")
            finite = all(map(math.isfinite, parameters))
            _require(path, where, finite, "NaN or infinity", "finite numbers")
            cameras[camera_id] = _intrinsics(
                path, where, names[model_id], width, height, parameters
            )
        file.end()
    return cameras


def _binary_images(path: Path) -> Iterator[Image]:
    with _Binary(path) as file:
        for _ in range(file.count(64 + 1 + 8)):
            _, *numbers, camera_id = file.take("<I7dI")
            name = file.text()
            finite = all(map(math.isfinite, numbers))
            _require(path, f"image {name[:80]}", finite, "NaN or infinity", "finite numbers")
            file.skip(POINT_BYTES * file.take("<Q")[0])
            yield Image(name, tuple(numbers[:4]), tuple(numbers[4:]), camera_id)
        file.end()
