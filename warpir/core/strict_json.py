"""JSON as the standard has it: Python's reader also takes NaN and duplicate keys, this one not."""

import hashlib
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from warpir.core.errors import ExitCode, Faults, InputError
from warpir.core.limits import LIMITS, Limits

JSON = Faults(
    "json",
    {
        "constant": "{word} is not JSON",
        "format": "not {what}",
        "line_count": "{what} miscounted",
        "long_integer": "not JSON that can be read (a number of 5000 digits)",
        "missing": "no such file",
        "lines": "not JSON lines",
        "nesting": "JSON nested too deeply (limit {limit}); --max-nesting raises it",
        "not_an_object": "not a JSON object",
        "not_regular": "not a regular file",
        "number": "a number beyond every use",
        "overflow": "number {digits} is too large",
        "syntax": "not JSON ({problem})",
        "twice": "key {key} appears twice",
        "type": "missing or of another kind",
        "unreadable": "cannot be read",
        "utf8": "not UTF-8 text",
    },
)
"""What a JSON file may have wrong."""


class _Refused(Exception):
    """A construct that the standard forbids; `pattern` finds it in the text."""

    def __init__(self, pattern: str, reason: str, **fields: str) -> None:
        super().__init__(reason)
        self.pattern = pattern
        self.reason = reason
        self.fields = fields


def read_json_object(path: str | Path, limits: Limits = LIMITS) -> dict[str, Any]:
    """Read a file that holds one JSON object.

    Args:
        path: A regular file, UTF-8 with or without a byte order mark.
        limits: How large and how nested it may be.

    Raises:
        InputError: Missing, too large, or not strict JSON; the text names the line.
    """
    return parse_json_object(path, _read(Path(path), limits), limits)


def _read(path: Path, limits: Limits) -> bytes:
    """Return what a regular file holds.

    Raises:
        InputError: Missing or too large.
    """
    try:
        if not path.is_file():
            raise JSON.error(path, "not_regular" if path.exists() else "missing")
        limits.check("json_bytes", path.stat().st_size, path, "too large", more=" bytes")
        return path.read_bytes()
    except OSError as error:
        raise JSON.error(path, "unreadable", found=error.strerror) from error


def parse_json_object(where: str | Path, raw: bytes, limits: Limits = LIMITS) -> dict[str, Any]:
    """Parse the bytes of one JSON object; `where` is named in the error text.

    Raises:
        InputError: It is not strict JSON, holds too much, is nested too deeply, or another value.
    """
    # Before it is parsed: a list of nothing takes 3 bytes in the file and 80 in memory. Those that
    # stand in texts are counted, too.
    values = sum(map(raw.count, (b"{", b"[", b",")))
    limits.check("json_values", values, where, "too many values in JSON")

    def constant(word: str) -> float:
        raise _Refused(rf"(?<![\w\"]){re.escape(word)}(?![\w\"])", "constant", word=word)

    def number(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise _Refused(re.escape(digits), "overflow", digits=digits[:20])
        return value

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        record: dict[str, Any] = {}
        for key, value in pairs:
            if key in record:
                shown = json.dumps(key)
                pattern = rf"{re.escape(shown)}\s*:[\s\S]*?{re.escape(shown)}\s*(?=:)"
                raise _Refused(pattern, "twice", key=shown[:60])
            record[key] = value
        return record

    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise JSON.error(where, "utf8", line=line) from error
    try:
        root = json.loads(
            text, parse_constant=constant, parse_float=number, object_pairs_hook=unique
        )
    except json.JSONDecodeError as error:
        raise JSON.error(where, "syntax", line=error.lineno, problem=error.msg) from error
    except _Refused as refused:
        found = re.search(refused.pattern, text)
        line = text.count("\n", 0, found.end()) + 1 if found else 1
        raise JSON.error(where, refused.reason, line=line, **refused.fields) from refused
    except RecursionError as error:  # beyond every limit that can be given
        raise JSON.error(where, "nesting", limit=limits.nesting) from error
    except ValueError as error:  # integers of 5000 digits
        raise JSON.error(where, "long_integer") from error
    if not isinstance(root, dict):
        raise JSON.error(where, "not_an_object", line=1, found=type(root).__name__)
    limits.check("nesting", _depth(root), where, "JSON nested too deeply", more=" levels")
    return root


def read_json_lines(
    path: str | Path, what: str, most: int, limits: Limits = LIMITS
) -> tuple[list[tuple[int, bytes]], str]:
    """Read a file of JSON objects, one a line; `parse_json_object` parses a line.

    It may have ``most`` lines; ``what`` they are is in the plural, for a person.

    Returns:
        The number and the bytes of each line that is not blank, and the sha256 of the whole file.

    Raises:
        InputError: Missing, too large, of another format, such as CSV, a JSON list or an object
            over several lines, or of another number of lines (`ExitCode.USAGE`).
    """
    try:
        raw = _read(Path(path), limits)
        lines = [(number, line) for number, line in enumerate(raw.split(b"\n"), 1) if line.strip()]
        if not 1 <= len(lines) <= most:
            expected = f"1 to {most}"
            raise JSON.error(path, "line_count", what=what, found=len(lines), expected=expected)
        ends = {line.strip()[:1] + line.strip()[-1:] for _, line in lines}
        is_over_lines = len(lines) > 1 and b"{}" not in ends
        if b"{" not in raw or raw.lstrip().startswith(b"[") or is_over_lines:
            raise JSON.error(path, "lines", expected="an object {...} on each line")
    except InputError as error:
        error.code = ExitCode.USAGE
        raise
    return lines, hashlib.sha256(raw).hexdigest()


def json_bytes(content: object, default: Callable[[Any], Any] | None = None) -> bytes:
    """Return a file of JSON for people and programs.

    Args:
        content: Plain values.
        default: Makes plain what is not.

    Raises:
        ValueError: A number is not finite.
    """
    return (json.dumps(content, indent=2, allow_nan=False, default=default) + "\n").encode()


def _depth(root: dict[str, Any]) -> int:
    """Return how many objects and lists are within each other at most."""
    depth = 0
    level: list[dict[str, Any] | list[Any]] = [root]
    while level:
        depth += 1
        level = [
            value
            for held in level
            for value in (held.values() if isinstance(held, dict) else held)
            if isinstance(value, dict | list)
        ]
    return depth


def read_numbers(path: str | Path, pointer: str, value: Any, count: int) -> list[float]:
    """Return a list of ``count`` numbers, the value at a pointer of a JSON file.

    Of one, which stands by itself in the file, the value is a list too.

    Raises:
        InputError: It is something else.
    """
    numeric = isinstance(value, list) and len(value) == count
    if not numeric or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise JSON.error(path, "type", pointer=pointer, expected=expected)
    try:
        return [float(v) for v in value]
    except OverflowError:
        raise JSON.error(path, "number", pointer=pointer) from None


def read_versioned(
    path: str | Path, what: str, version: int, limits: Limits = LIMITS
) -> dict[str, Any]:
    """Read one of our own files: a JSON object whose ``format`` is ``warpir-`` and ``what``.

    Raises:
        InputError: Missing, too large, not strict JSON, or of another format or version.
    """
    root = read_json_object(path, limits)
    if root.get("format") != f"warpir-{what}" or root.get("version") != version:
        found = f"{root.get('format')!r:.40} version {root.get('version')!r:.10}"
        expected = f"'warpir-{what}' version {version}"
        raise JSON.error(path, "format", what=what, found=found, expected=expected)
    return root
