"""Reads PLY files into columns: ASCII and binary of either byte order, lists of any length.

Format: G. Turk, "The PLY Polygon File Format" (1994). What the elements mean is left to the caller.
"""

import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.core.errors import Faults, InputError

TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
ORDERS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
HEADER_BYTES = 1 << 20
"""Longest header [byte]."""
ADVICE = "export it again, or as GLB"
PLY = Faults(
    "ply",
    {
        "color": "vertex colours from {found} (expected 0 to 1, or integers)",
        "damaged": ("damaged PLY: {what}", ADVICE),
        "header": ("damaged PLY: {what}", ADVICE),
        "index": "index {found:g} is no whole number",
        "index_out_of_range": "index {found}, but {limit} vertices",
        "kind": ("not a PLY file (does not start with 'ply')", "convert it to GLB"),
        "no_positions": ("no x, y and z of vertices", "convert it to GLB"),
        "range": ("damaged PLY: {element} {name} {found:g} is no {kind}", ADVICE),
    },
)
"""What a file may have wrong."""


@dataclass(frozen=True)
class Lists:
    """A list property: one list per row of its element."""

    lengths: NDArray[np.int64]
    """Entries of each list, shape [row]."""
    values: NDArray[Any]
    """All lists one after the other, shape [entry]."""

    def by_length(self) -> dict[int, NDArray[Any]]:
        """Return the lists of each length, shape [list, length]."""
        starts = np.cumsum(self.lengths) - self.lengths
        return {
            int(n): self.values[starts[self.lengths == n][:, None] + np.arange(n)]
            for n in np.unique(self.lengths)
        }


@dataclass
class Element:
    """One element of the header and, once read, its columns."""

    name: str
    count: int
    types: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Type of each property, and the type of its length, empty where it is no list."""
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    """Properties with one value, shape [row], in the type that the header states."""
    lists: dict[str, Lists] = field(default_factory=dict)

    def table(self, *names: str) -> NDArray[np.float64] | None:
        """Return columns side by side, shape [row, column]; None when one is absent."""
        if not all(name in self.columns for name in names):
            return None
        return np.column_stack([self.columns[name].astype(np.float64) for name in names])


@dataclass(frozen=True)
class Ply:
    """A PLY file."""

    elements: dict[str, Element]
    comments: tuple[str, ...]

    def element(self, name: str) -> Element:
        """Return an element, empty where the file has none of that name."""
        return self.elements.get(name) or Element(name, 0)


def read_ply(path: Path, content: bytes) -> Ply:
    """Read all elements of a PLY file.

    Raises:
        InputError: The header is not PLY's, or the body is shorter or longer than it promises.
    """
    ply, order, start = read_header(path, content)
    body = content[start:]
    cell = ""
    if order == "ascii":
        # As binary, with every number a float64: they hold all of PLY's integers exactly.
        try:
            if b"_" in body:  # Python would read 1_0 as 10
                raise ValueError("a number with _")
            body = np.array(body.split(), dtype=np.float64).astype("<f8").tobytes()
        except ValueError as error:
            raise PLY.error(path, "damaged", what=str(error)[:80]) from None
        cell = "f8"
    at = 0
    for element in ply.elements.values():
        try:
            at = _read_element(element, body, at, ORDERS[order], cell)
        except (struct.error, ValueError, OverflowError):
            what = f"it ends within its {element.count} {element.name} elements"
            raise PLY.error(path, "damaged", what=what) from None
        for name, column in element.columns.items():
            element.columns[name] = _as_stated(path, element, name, column)
        for name, lists in element.lists.items():
            stated = _as_stated(path, element, name, lists.values)
            element.lists[name] = Lists(lists.lengths, stated)
    rest = len(body) - at
    if order == "ascii" and rest:
        raise PLY.error(path, "damaged", what=f"{rest // 8} numbers too many")
    return ply


def read_header(path: Path, content: bytes) -> tuple[Ply, str, int]:
    """Return the elements, not yet read, the encoding, and where the body begins [byte].

    Raises:
        InputError: With the line at fault.
    """
    if not content.startswith(b"ply"):
        raise PLY.error(path, "kind")
    newline = b"\r" if content[3:4] == b"\r" and content[4:5] != b"\n" else b"\n"
    end = content.find(newline + b"end_header", 0, HEADER_BYTES) + 1  # a comment may hold the word
    if not end:
        raise PLY.error(path, "header", what="no end_header")
    start = content.find(newline, end) + 1 or len(content)
    ply, order = Ply({}, ()), ""
    comments: list[str] = []
    element: Element | None = None
    for line, text in enumerate(content[:end].decode("latin-1").splitlines(), 1):

        def wrong(what: str, line: int = line, text: str = text) -> InputError:
            return PLY.error(path, "header", what=f"{text[:40]!r}, {what}", line=line)

        match text.split():
            case ["ply"] | ["obj_info", *_] | []:
                pass
            case ["comment", *words]:
                comments.append(" ".join(words))
            case ["format", order, "1.0"] if order in ORDERS:
                pass
            case ["element", name, count] if (
                count.isdecimal() and len(count) < 20 and name not in ply.elements
            ):
                element = ply.elements[name] = Element(name, int(count))
                if element.count > len(content):  # a row takes at least a byte
                    raise wrong(f"in {len(content)} bytes")
            case ["property", "list", length, kind, name] if (
                element and TYPES.get(length, "f")[0] != "f" and kind in TYPES
            ):
                element.types[name] = TYPES[kind], TYPES[length]
            case ["property", kind, name] if element and kind in TYPES:
                element.types[name] = TYPES[kind], ""
            case _:
                raise wrong("expected a statement of PLY 1.0")
    if not order:
        raise PLY.error(path, "header", what="no format")
    return Ply(ply.elements, tuple(comments)), order, start


def _read_element(element: Element, body: bytes, at: int, order: str, cell: str) -> int:
    """Fill the columns and lists of an element and return where the next one begins [byte].

    ``cell`` replaces all types where it is not empty.

    Raises:
        ValueError: The body is too short; `struct.error` likewise.
    """
    types = {
        name: (order + (cell or kind), order + (cell or length) if length else "")
        for name, (kind, length) in element.types.items()
    }
    if not element.count or not types:
        return at
    # Most files have lists of one length: then all rows are laid out as the first.
    lengths = _first_lengths(types, body, at)
    fields: list[Any] = []
    for name, (kind, length) in types.items():
        if length:
            fields += [(f"{name} length", length), (name, kind, (lengths[name],))]
        else:
            fields.append((name, kind))
    row = np.dtype(fields)
    end = at + row.itemsize * element.count
    if lengths and end > len(body):
        return _read_uneven(element, types, body, at)
    rows = np.frombuffer(body, row, element.count, at)
    if any((rows[f"{name} length"] != n).any() for name, n in lengths.items()):
        return _read_uneven(element, types, body, at)
    for name in types:
        if name in lengths:
            same = np.full(element.count, lengths[name], dtype=np.int64)
            element.lists[name] = Lists(same, rows[name].reshape(-1))
        else:
            element.columns[name] = rows[name]
    return end


def _first_lengths(types: dict[str, tuple[str, str]], body: bytes, at: int) -> dict[str, int]:
    """Return how long the lists of the first row are."""
    found = {}
    for name, (kind, length) in types.items():
        if length:
            found[name], at = _length(length, body, at)
            at += found[name] * np.dtype(kind).itemsize
        else:
            at += np.dtype(kind).itemsize
    return found


def _length(kind: str, body: bytes, at: int) -> tuple[int, int]:
    """Return the length of the list that begins at a byte, and where its values begin."""
    code = kind[0] + np.dtype(kind).char
    (value,) = struct.unpack_from(code, body, at)
    count = int(value)
    if count < 0 or count > len(body):
        raise ValueError("length of a list")
    return count, at + struct.calcsize(code)


def _read_uneven(element: Element, types: dict[str, tuple[str, str]], body: bytes, at: int) -> int:
    """Read rows whose lists differ in length, one by one."""
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in types}
    for _ in range(element.count):
        for name, (kind, length) in types.items():
            count = 1
            if length:
                count, at = _length(length, body, at)
            parts[name].append(np.frombuffer(body, kind, count, at))
            at += parts[name][-1].nbytes
    for name, (_, length) in types.items():
        values = np.concatenate(parts[name])
        if length:
            lengths = np.array([len(part) for part in parts[name]], dtype=np.int64)
            element.lists[name] = Lists(lengths, values)
        else:
            element.columns[name] = values
    return at


def _as_stated(path: Path, element: Element, name: str, column: NDArray[Any]) -> NDArray[Any]:
    """Return a column in the type of the header; ASCII columns arrive as float64."""
    kind = element.types[name][0]
    if kind[0] == "f":
        return column.astype(np.float64)
    with np.errstate(invalid="ignore"):
        stated = column.astype(kind)
    if (stated != column).any():
        found = float(column[stated != column][0])
        raise PLY.error(path, "range", element=element.name, name=name, found=found, kind=kind)
    return stated
