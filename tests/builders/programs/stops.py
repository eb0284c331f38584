"""Ways to stop a run inside a function, softly or hard."""

import sys
from typing import Any

import pytest

from warpir.app.command import parse


class Killed(BaseException):
    """Stands for SIGKILL: nothing of ours catches it."""


def stop_at(monkeypatch: pytest.MonkeyPatch, place: str, count: int) -> None:
    """Raise at the ``count``-th call of a function of the run."""
    module, name = place.rsplit(".", 1)
    owner = sys.modules["warpir." + module.split(":")[0]]
    for part in module.split(":")[1:]:
        owner = getattr(owner, part)
    original, calls = getattr(owner, name), [0]

    def stopping(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        if calls[0] == count:
            raise Killed
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, stopping)


def stop_hard(arguments: list[str]) -> None:
    """Run without the program's own explanation of exceptions."""
    from warpir.insert import insert

    insert(parse(arguments).config)
