"""A run that is stopped hard inside a function."""

from importlib import import_module
from typing import Any

import pytest

from warpir.app.command import parse


class Killed(BaseException):
    """Stands for SIGKILL: nothing of ours catches it."""


def stop_run(arguments: list[str], place: str, count: int) -> None:
    """Start a run that ends at the ``count``-th call of a function, as if it had been killed.

    The program's own explanation of exceptions is left out.
    """
    from warpir.insert import insert

    module, name = place.rsplit(".", 1)
    owner: Any = import_module("warpir." + module.split(":")[0])
    for part in module.split(":")[1:]:
        owner = getattr(owner, part)
    original, calls = getattr(owner, name), [0]

    def stopping(*args: Any, **kwargs: Any) -> Any:
        calls[0] += 1
        if calls[0] == count:
            raise Killed
        return original(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Killed):
        patch.setattr(owner, name, stopping)
        insert(parse(arguments).config)
