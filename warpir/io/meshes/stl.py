"""Reads STL files, binary and ASCII, into triangles.

Format: 3D Systems, "StereoLithography Interface Specification" (1989).
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warpir.core.errors import Faults

HEADER = 84
"""A binary file begins with 80 bytes of anything and the number of its triangles [byte]."""
FACET = np.dtype([("normal", "<f4", (3,)), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL = Faults("stl", {"damaged": ("damaged STL: {what}", "export it again, or as GLB")})
"""What a file may have wrong."""
VERTEX = ["vertex", "", "", ""]
WORDS = np.array(
    ["facet", "normal", "", "", "", "outer", "loop", *VERTEX * 3, "endloop", "endfacet"],
    dtype="S8",
)
"""The words of an ASCII facet; empty where numbers stand."""
NUMBERS = [8, 9, 10, 12, 13, 14, 16, 17, 18]
"""Where the corners stand among them."""
LONGEST = 64
"""Most characters of a word; all are stored as long as the longest."""


def read_stl(path: Path, content: bytes, notices: list[str]) -> NDArray[np.float64]:
    """Return the corners of all triangles, shape [triangle, 3, 3].

    Raises:
        InputError: The file is damaged, or neither kind of STL.
    """
    count = int.from_bytes(content[80:HEADER], "little") if len(content) >= HEADER else 0
    promised = HEADER + FACET.itemsize * count
    # Some binary files begin with "solid" too; their length gives them away.
    if content.lstrip()[:5].lower() == b"solid" and len(content) != promised:
        return _read_ascii(path, content)
    if len(content) < max(promised, HEADER):
        what = f"{count} triangles need {promised} bytes"
        raise STL.error(path, "damaged", what=what, found=len(content))
    if len(content) > promised:
        notices.append(f"{len(content) - promised} bytes after the last triangle ignored")
    facets = np.frombuffer(content, FACET, count, HEADER)
    if facets["attribute"].any():
        notices.append("attributes of triangles (colours, in some tools) are not read")
    return facets["corners"].astype(np.float64)


def _read_ascii(path: Path, content: bytes) -> NDArray[np.float64]:
    lines = [line.strip() for line in content.splitlines()]
    solids = sum(line[:5].lower() == b"solid" for line in lines)
    ends = sum(line[:8].lower() == b"endsolid" for line in lines)
    if solids != ends:
        raise STL.error(path, "damaged", what=f"{solids} solid and {ends} endsolid")
    inner = [
        line for line in lines if line[:5].lower() != b"solid" and line[:8].lower() != b"endsolid"
    ]
    listed = b" ".join(inner).split()
    longest = max(map(len, listed), default=1)
    if longest > LONGEST:
        raise STL.error(path, "damaged", what="a word too long", found=longest, limit=LONGEST)
    words = np.array(listed, dtype=f"S{longest}")
    width = len(WORDS)
    whole = words[: len(words) // width * width].reshape(-1, width)
    wrong = (np.char.lower(whole) != WORDS)[:, WORDS != b""].any(axis=1)
    if wrong.any() or whole.size < words.size:
        number = int(wrong.argmax()) if wrong.any() else len(whole)
        raise STL.error(path, "damaged", what=f"facet {number} is not one (counted from 0)")
    try:
        return whole[:, NUMBERS].astype(np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise STL.error(path, "damaged", what=str(error)[:80]) from None
