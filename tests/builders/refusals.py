"""What a refused command line must look like."""

from collections.abc import Sequence

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
