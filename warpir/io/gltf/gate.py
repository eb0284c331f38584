"""The strict gate in front of a glTF 2.0 file: container, typed JSON access, accessors as NumPy.

Every value is read through an `Entry`, which knows its JSON pointer; whatever the specification
(https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html) forbids ends in one sentence with that
pointer. Sizes are checked before anything is allocated.
"""

import json
import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.core.errors import Faults, InputError
from warpir.core.limits import Limits
from warpir.core.strict_json import parse_json_object
from warpir.io.meshes.asset_files import read_regular, read_uri

COMPONENTS: dict[int, np.dtype[Any]] = {
    5120: np.dtype("<i1"),
    5121: np.dtype("<u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
ZERO_BYTES = 256 << 20
"""Largest sparse accessor that begins as zeros and not as a buffer view [byte]."""
RE_EXPORT_MESH = "re-export without mesh compression (Draco, meshopt)"
GLTF = Faults(
    "gltf",
    {
        "beyond_data": "{what} end at byte {found}, but there are {limit}",
        "camera": "camera of type {found!r}, expected perspective",
        "component_type": "{what} of a wrong kind of number",
        "container": ("damaged .glb: {what} at byte {found}", "export or copy it again"),
        "count": "{found} {what}, but {limit} {of}",
        "cycle": "the nodes form a cycle ({found} nodes hang on no root)",
        "extension": "{found} is not supported",
        "index_out_of_range": "{what} {found}, but {limit} {of}",
        "kind": ("not a .glb file (starts with {found!r}; expected b'glTF')", "convert it to GLB"),
        "matrix": "{what}",
        "missing": "{what} is missing",
        "no_weight": "vertex {found} has no weight",
        "not_finite": "{what} NaN or infinite",
        "range": "{what} out of range",
        "singular": (
            "singular {what} (a scale of zero?)",
            "give the object a thickness, or remove it",
        ),
        "sparse_order": "the indices do not increase",
        "stride": "byteStride {found}, but elements of {limit} bytes",
        "texture_format": "only a {found} image",
        "too_large": ("{found} bytes of zeros (limit {limit})", RE_EXPORT_MESH),
        "transform_too_large": "{what} with numbers beyond {limit:g}",
        "two_parents": "node {found} is listed twice",
        "type": "{what} of another type",
        "uv_set": "texCoord {found}, but only sets 0 to {limit} are supported",
        "min_version": ("needs a reader of glTF {found!r}, this one reads 2.0", RE_EXPORT_MESH),
        "version": ("asset version is {found!r}, expected 2.0", "convert it to glTF 2.0"),
    },
)
"""What a file may have wrong; ``pointer`` is its JSON pointer, ``what`` the member or thing."""


class Entry:
    """One JSON value of the file together with the pointer that names it."""

    def __init__(self, path: Path, pointer: str, value: Any) -> None:
        self.path = path
        self.pointer = pointer
        self.value = value

    def error(self, reason: str, /, *, advice: str = "", **fields: object) -> InputError:
        """Return the error of a reason of `GLTF` that names the file and this place in it."""
        return GLTF.error(self.path, reason, advice=advice, pointer=self.pointer or "/", **fields)

    def out_of_range(self, what: str, found: int, limit: int, of: str) -> InputError:
        """Return the error of an index: ``what`` is ``found``, but there are ``limit`` of them."""
        return self.error("index_out_of_range", what=what, found=found, limit=limit, of=of)

    def __contains__(self, key: str) -> bool:
        return key in self.value

    def _get(self, key: str, kinds: tuple[type, ...], expected: str, default: Any) -> Any:
        """Return member ``key`` when it is one of ``kinds``; ``default`` when absent."""
        if key not in self.value:
            if default is not None:
                return default
            raise self.error("missing", what=key)
        value = self.value[key]
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            found = json.dumps(value)[:40]
            raise self.error("type", what=key, found=found, expected=expected)
        return value

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string; without ``default`` it must be there."""
        return str(self._get(key, (str,), "a string", default))

    def flag(self, key: str) -> bool:
        """Return a boolean, false when absent."""
        return bool(self._get(key, (bool,), "true or false", False))

    def integer(self, key: str, default: int | None = None, low: int = 0) -> int:
        """Return an integer of at least ``low``; without ``default`` it must be there."""
        value = self._get(key, (int,), "an integer", default)
        if value < low:
            raise self.error("range", what=key, found=value, limit=low)
        return int(value)

    def number(self, key: str, default: float) -> float:
        """Return a finite number."""
        return self._finite(key, self._get(key, (int, float), "a number", default))

    def numbers(self, key: str, default: tuple[float, ...]) -> tuple[float, ...]:
        """Return as many finite numbers as ``default`` has."""
        values = self._get(key, (list,), "a list of numbers", list(default))
        if len(values) != len(default):
            raise self.error("type", what=key, expected=f"{len(default)} numbers")
        if not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            raise self.error("type", what=key, expected="numbers alone")
        return tuple(self._finite(key, v) for v in values)

    def _finite(self, key: str, value: float) -> float:
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if not math.isfinite(number):
            raise self.error("not_finite", what=f"{key} is")
        return number

    def integers(self, key: str) -> list[int]:
        """Return a list of non-negative integers, empty when absent."""
        values = self._get(key, (list,), "a list of indices", [])
        for value in values:
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                found = json.dumps(value)[:40]
                raise self.error("type", what=key, found=found, expected="indices")
        return list(values)

    def child(self, key: str) -> "Entry":
        """Return an object, empty when absent."""
        value = self._get(key, (dict,), "an object", {})
        return Entry(self.path, f"{self.pointer}/{key}", value)

    def size(self, key: str) -> int:
        """Return the length of a list, 0 when absent."""
        return len(self._get(key, (list,), "a list", []))

    def item(self, key: str, index: int, user: "Entry", what: str) -> "Entry":
        """Return object ``index`` of list ``key``.

        Where the index, member ``what`` of ``user``, is out of range, that entry is blamed.
        """
        count = self.size(key)
        if not 0 <= index < count:
            raise user.out_of_range(what, index, count, key)
        value = self.value[key][index]
        pointer = f"{self.pointer}/{key}/{index}"
        if not isinstance(value, dict):
            raise Entry(self.path, pointer, value).error("type", what="entry", expected="an object")
        return Entry(self.path, pointer, value)

    def items(self, key: str) -> Iterator["Entry"]:
        """Yield the objects of list ``key``."""
        for index in range(self.size(key)):
            yield self.item(key, index, self, key)

    def extension(self, name: str) -> "Entry | None":
        """Return the object of extension ``name``, or None."""
        extensions = self.child("extensions")
        return extensions.child(name) if name in extensions else None


class GltfFile:
    """A glTF 2.0 file, ``.glb`` or ``.gltf``, whose container has been checked.

    Raises:
        InputError: The container or the JSON is damaged.
    """

    def __init__(self, path: Path, limits: Limits) -> None:
        self.path = path
        self.limits = limits
        self.hashes: dict[str, str] = {}
        is_text = path.suffix.lower() == ".gltf"
        content = read_regular(
            path,
            path,
            limits,
            limit="gltf_json_bytes" if is_text else "file_bytes",
            hashes=self.hashes,
        )
        self._binary: memoryview | None = None
        if content[:4] == b"glTF" or path.suffix.lower() == ".glb":
            text = self._open_container(content)
        else:
            text = content
        self._check_json(len(text))
        self.root = Entry(path, "", parse_json_object(path, text.rstrip(b"\0"), limits))
        version = self.root.child("asset").text("version", "")
        if version.split(".")[0] != "2":
            raise self.root.error("version", found=version)
        least = self.root.child("asset").text("minVersion", "2.0")
        if least != "2.0":
            raise self.root.error("min_version", found=least)
        self._buffers: dict[int, memoryview] = {}

    def _check_json(self, length: int) -> None:
        what = "glTF JSON is too large"
        self.limits.check("gltf_json_bytes", length, self.path, what, more=" bytes")

    def _open_container(self, content: bytes) -> bytes:
        """Return the JSON chunk of a ``.glb`` and keep its binary chunk."""

        def damaged(what: str, offset: int) -> InputError:
            return GLTF.error(self.path, "container", what=what, found=offset)

        if content[:4] != b"glTF":
            raise GLTF.error(self.path, "kind", found=content[:4])
        if len(content) < 20:
            raise damaged(f"the file ends ({len(content)} bytes)", len(content))
        version, total = struct.unpack_from("<II", content, 4)
        if version != 2:
            raise damaged(f"container version {version} (expected 2)", 4)
        if total != len(content):
            raise damaged(f"total length {total}, but the file has {len(content)} bytes", 8)
        text, offset = None, 12
        while offset + 8 <= total:
            length, kind = struct.unpack_from("<I4s", content, offset)
            start, offset = offset + 8, offset + 8 + length
            if offset > total:
                raise damaged(f"chunk of {length} bytes leaves the file", start - 8)
            if text is None:
                if kind != b"JSON":
                    raise damaged(f"first chunk is {kind!r} (expected b'JSON')", start - 4)
                self._check_json(length)
                text = content[start:offset]
            elif kind == b"BIN\0" and self._binary is None:
                self._binary = memoryview(content)[start:offset]
        if text is None:
            raise damaged("no JSON chunk", 12)
        return text

    def buffer(self, index: int, user: Entry) -> memoryview:
        """Return the bytes of buffer ``index``, read once."""
        if index not in self._buffers:
            entry = self.root.item("buffers", index, user, "buffer")
            if "uri" in entry:
                where = f"{entry.pointer}: "
                uri = entry.text("uri")
                content = memoryview(read_uri(uri, self.path, where, self.limits, self.hashes))
            elif index == 0 and self._binary is not None:
                content = self._binary
            else:
                raise entry.error("missing", what="uri, and a binary chunk,", advice=RE_EXPORT_MESH)
            length = entry.integer("byteLength", low=1)
            if length > len(content):
                limit = len(content)
                raise entry.error("beyond_data", what="its bytes", found=length, limit=limit)
            self._buffers[index] = content[:length]
        return self._buffers[index]

    def view(self, index: int, user: Entry) -> tuple[memoryview, Entry]:
        """Return the bytes of buffer view ``index`` and its entry."""
        entry = self.root.item("bufferViews", index, user, "bufferView")
        content = self.buffer(entry.integer("buffer"), entry)
        start, length = entry.integer("byteOffset", 0), entry.integer("byteLength", low=1)
        end = start + length
        if end > len(content):
            raise entry.error("beyond_data", what="its bytes", found=end, limit=len(content))
        return content[start:end], entry

    def count(self, index: int, user: Entry, what: str) -> int:
        """Return how many elements accessor ``index`` promises, without reading them."""
        return self.root.item("accessors", index, user, what).integer("count", low=1)

    def accessor(self, index: int, user: Entry, what: str, types: tuple[str, ...]) -> NDArray[Any]:
        """Return the elements of accessor ``index`` as the file stores them.

        Returns:
            A read-only view of the file, shape [count, width], or a copy where elements are
            sparse; normalised integers become float32, other integers stay.
        """
        entry = self.root.item("accessors", index, user, what)
        kind, component = entry.text("type"), entry.integer("componentType")
        if kind not in types:
            raise entry.error("type", what=what, found=kind, expected=" or ".join(types))
        if component not in COMPONENTS:
            raise entry.error("component_type", what="componentType", found=component)
        dtype, width, count = COMPONENTS[component], WIDTHS[kind], entry.integer("count", low=1)
        if "bufferView" in entry:
            elements = self._stored(entry, count, width, dtype)
        elif "sparse" in entry:
            size = count * width * dtype.itemsize
            if size > ZERO_BYTES:
                raise entry.error("too_large", found=size, limit=ZERO_BYTES)
            elements = np.zeros((count, width), dtype)
        else:
            used = f"bufferView, used by {user.pointer} ({what}),"
            raise entry.error("missing", what=used, advice=RE_EXPORT_MESH)
        if "sparse" in entry:
            elements = self._replaced(entry.child("sparse"), elements)
        if dtype.kind == "f":
            bad = np.flatnonzero(~np.isfinite(elements).all(axis=1))
            if len(bad):
                what = f"{len(bad)} elements, first {bad[0]}, are"
                raise entry.error("not_finite", what=what, found=len(bad))
        elif entry.flag("normalized"):
            if component == 5125:
                raise entry.error("component_type", what="normalized 32-bit integers are")
            elements = np.maximum(elements / np.float32(np.iinfo(dtype).max), np.float32(-1.0))
        return elements

    def _stored(self, entry: Entry, count: int, width: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Return the elements that ``bufferView`` and ``byteOffset`` of an entry refer to."""
        content, view = self.view(entry.integer("bufferView"), entry)
        size = dtype.itemsize * width
        stride = view.integer("byteStride", size, low=-(1 << 62))
        if stride < size:
            raise view.error("stride", found=stride, limit=size)
        start = entry.integer("byteOffset", 0)
        end = start + stride * (count - 1) + size
        if end > len(content):
            what = f"{count} elements"
            raise entry.error("beyond_data", what=what, found=end, limit=len(content))
        return np.ndarray((count, width), dtype, content, start, (stride, dtype.itemsize))

    def _replaced(self, sparse: Entry, elements: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of an accessor's elements with those that ``sparse`` lists replaced."""
        count, (total, width) = sparse.integer("count", low=1), elements.shape
        indices, values = sparse.child("indices"), sparse.child("values")
        component = indices.integer("componentType")
        if component not in (5121, 5123, 5125):
            raise indices.error("component_type", what="componentType", found=component)
        where = self._stored(indices, count, 1, COMPONENTS[component])[:, 0].astype(np.int64)
        if (np.diff(where) <= 0).any():
            raise indices.error("sparse_order")
        if where[-1] >= total:
            raise indices.out_of_range("index", int(where[-1]), total, "elements")
        replaced = elements.copy()
        replaced[where] = self._stored(values, count, width, elements.dtype)
        return replaced
