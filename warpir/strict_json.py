"""JSON as the standard has it: Python's reader also takes NaN and duplicate keys, this one not."""

import json
import math
import re
from pathlib import Path
from typing import Any

from warpir.errors import InputError

JSON_BYTES_MAX = 16 * 1024 * 1024
"""Default size limit of configuration and camera files [byte]."""


class _Refused(Exception):
    """A construct that the standard forbids; `pattern` finds it in the text."""

    def __init__(self, what: str, pattern: str) -> None:
        super().__init__(what)
        self.what = what
        self.pattern = pattern


def read_json_object(path: str | Path, byte_limit: int = JSON_BYTES_MAX) -> dict[str, Any]:
    """Read a file that holds one JSON object.

    Args:
        path: A regular file, UTF-8 with or without a byte order mark.
        byte_limit: Largest file accepted [byte].

    Raises:
        InputError: Missing, too large, or not strict JSON; the text names the line.
    """
    path = Path(path)
    try:
        if not path.is_file():
            raise InputError(path, "no such file" if not path.exists() else "not a regular file")
        size = path.stat().st_size
        if size > byte_limit:
            raise InputError(path, f"too large (found {size} bytes; expected at most {byte_limit})")
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from error
    return parse_json_object(path, raw)


def parse_json_object(where: str | Path, raw: bytes) -> dict[str, Any]:
    """Parse the bytes of one JSON object; `where` is named in the error text."""

    def constant(word: str) -> float:
        raise _Refused(f"{word} is not JSON", rf"(?<![\w\"]){re.escape(word)}(?![\w\"])")

    def number(digits: str) -> float:
        value = float(digits)
        if not math.isfinite(value):
            raise _Refused(f"number {digits[:20]} is too large", re.escape(digits))
        return value

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        record: dict[str, Any] = {}
        for key, value in pairs:
            if key in record:
                shown = json.dumps(key)
                raise _Refused(
                    f"key {shown[:60]} appears twice",
                    rf"{re.escape(shown)}\s*:[\s\S]*?{re.escape(shown)}\s*(?=:)",
                )
            record[key] = value
        return record

    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise InputError(where, f"line {line}: not UTF-8 text") from error
    try:
        root = json.loads(
            text, parse_constant=constant, parse_float=number, object_pairs_hook=unique
        )
    except json.JSONDecodeError as error:
        raise InputError(where, f"line {error.lineno}: not JSON ({error.msg})") from error
    except _Refused as refused:
        found = re.search(refused.pattern, text)
        line = text.count("\n", 0, found.end()) + 1 if found else 1
        raise InputError(where, f"line {line}: {refused.what}") from refused
    except (RecursionError, ValueError) as error:  # deep nesting; integers of 5000 digits
        raise InputError(
            where, "not JSON that can be read (nested or long beyond reason)"
        ) from error
    if not isinstance(root, dict):
        raise InputError(
            where, f"line 1: not a JSON object (found {type(root).__name__}; expected an object)"
        )
    return root


def read_numbers(path: str | Path, pointer: str, value: Any, count: int) -> list[float]:
    """Return a list of numbers that was read from a JSON file.

    Args:
        path: The file.
        pointer: Where the list stands in it.
        value: What stands there.
        count: How many are expected; one stands by itself in the file.

    Raises:
        InputError: It is something else.
    """
    numeric = isinstance(value, list) and len(value) == count
    if not numeric or any(isinstance(v, bool) or not isinstance(v, int | float) for v in value):
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise InputError(path, f"{pointer}: {expected} expected")
    numbers = []
    for v in value:
        try:
            numbers.append(float(v))
        except OverflowError:
            raise InputError(path, f"{pointer}: a number beyond every use") from None
    return numbers
