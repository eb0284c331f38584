"""What a refused command line, or a refused file, must look like."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

import warpir.app.command
import warpir.insert
from warpir.app.command import parse
from warpir.core.errors import ExitCode, InputError


def assert_fails(
    capsys: pytest.CaptureFixture[str], argv: Sequence[str], code: int, *words: str
) -> list[str]:
    """Check status, exactly one ``error:`` line that holds the words, no traceback."""
    status = warpir.insert.main(argv)
    captured = capsys.readouterr()
    lines = captured.err.splitlines()
    errors = [line for line in lines if line.startswith("error:")]
    assert status == code, captured.err
    assert len(errors) == 1 and lines[0] == errors[0]
    for word in words:
        assert word in errors[0]
    assert "Traceback" not in captured.err
    return lines


def refused(argv: Sequence[str]) -> InputError:
    with pytest.raises(InputError) as caught:
        parse(argv)
    assert caught.value.code == ExitCode.USAGE
    return caught.value


def unreadable(read: Callable[..., object], path: Path, *words: str, **options: Any) -> InputError:
    """Check that reading ends in one sentence with the file and the words."""
    with pytest.raises(InputError) as caught:
        read(path, **options)
    error = caught.value
    assert (error.where, error.code) == (str(path), ExitCode.INPUT)
    assert "\n" not in str(error)
    text = f"{error.what} / {error.advice}"
    assert all(word in text for word in words), text
    return error
