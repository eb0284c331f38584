"""One value of a configuration: its form, range and help stand on its field, and nowhere else.

The help is the docstring below the field: ``--help`` shows it up to the first semicolon.
"""

import ast
import inspect
import os
from dataclasses import Field, dataclass, field
from numbers import Integral, Real
from types import UnionType
from typing import Any, Union, get_args, get_origin


@dataclass(frozen=True)
class Rule:
    """What a user may give for one field."""

    form: str = ""
    """What stands for the value in ``--help``, in brackets if the flag alone says yes; empty for a
    switch."""
    expert: bool = False
    """Whether ``--help-all`` alone shows it."""
    name: str = ""
    """Name on the command line and in files; empty: the field's."""
    low: float | None = None
    """Least value."""
    high: float | None = None
    """Greatest value."""
    above: float | None = None
    """Value that it must exceed."""
    below: float | None = None
    """Value that must exceed it."""
    choices: tuple[str, ...] = ()
    """All words that it may be; of a number, those that may stand in its place."""
    is_prompt: bool = False
    """Whether it is a text for a text encoder, whose length is limited."""
    may_be_empty: bool = False
    """Whether the empty text means something."""
    separator: str = ","
    """What parts the texts of a list."""
    by_hand: bool = False
    """Whether the command line alone may set it: it opens the network, or runs code."""

    def problem(self, value: Any) -> str:
        """Return what a value should be, or nothing if it is that; NaN is for others to find."""
        if isinstance(value, str):
            of_numbers = "" if self.low is None else f", or {self.low:g} to {self.high:g}"
            accepted = not self.choices or value in self.choices
            return "" if accepted else " or ".join(self.choices) + of_numbers
        if self.above is not None and self.below is not None:
            inside = not (value <= self.above or value >= self.below)
            return "" if inside else f"between {self.above:g} and {self.below:g}"
        if self.above is not None and value <= self.above:
            return f"more than {self.above:g}"
        if self.low is not None and value < self.low:
            return f"at least {self.low}"
        if self.high is not None and value > self.high:
            return f"at most {self.high}"
        return ""


def option(default: Any, form: str = "", **rule: Any) -> Any:
    """Return a dataclass field with the rule of its value (`Rule`)."""
    return field(default=default, metadata={"rule": Rule(form, **rule)})


def rule_of(field: Field[Any]) -> Rule:
    """Return the rule of a field that `option` made."""
    rule: Rule = field.metadata["rule"]
    return rule


def help_of(settings: type) -> dict[str, str]:
    """Read the docstring below each field of a class, from its source."""
    body = ast.parse(inspect.getsource(settings)).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for stated, below in zip(body.body, body.body[1:], strict=False):
        if isinstance(stated, ast.AnnAssign) and isinstance(below, ast.Expr):
            assert isinstance(stated.target, ast.Name) and isinstance(below.value, ast.Constant)
            text = inspect.cleandoc(str(below.value.value))
            found[stated.target.id] = text.replace("\n", " ")
    return found


def plain(value: object) -> object:
    """Return a value as JSON holds it: a path as text, NumPy's numbers and arrays as Python's."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, tuple | list):
        return tuple(map(plain, value))
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, bool | str):
        return value
    if isinstance(value, Integral):
        return int(value)
    return float(value) if isinstance(value, Real) else value


def is_a(value: object, kind: Any) -> bool:
    """Return whether a plain value is what an annotation says; a whole number is a float too."""
    if get_origin(kind) is UnionType:
        return any(is_a(value, alternative) for alternative in get_args(kind))
    if get_origin(kind) is tuple:
        parts = get_args(kind)
        if not isinstance(value, tuple):
            return False
        parts = parts[:1] * len(value) if parts[-1] is Ellipsis else parts
        return len(parts) == len(value) and all(map(is_a, value, parts))
    if kind is bool or isinstance(value, bool):
        return kind is bool and isinstance(value, bool)
    return isinstance(value, int | float if kind is float else kind)


def convert(value: Any, hint: Any, separator: str = ",") -> Any:
    """Turn a flag's text or a file's value into the field's type.

    Raises:
        ValueError: It cannot be read as that type.
    """
    if get_origin(hint) in (Union, UnionType):
        if value is None and type(None) in get_args(hint):
            return None
        # The narrow forms come first: any text would pass as str.
        for arm in sorted(get_args(hint), key=lambda arm: arm is str):
            try:
                return convert(value, arm, separator)
            except (TypeError, ValueError):
                continue
        raise ValueError
    if get_origin(hint) is tuple:
        parts = value.split(separator) if isinstance(value, str) else value
        kinds = get_args(hint)
        if not isinstance(parts, list | tuple):
            raise ValueError
        if kinds[-1] is Ellipsis:
            return tuple(convert(part, kinds[0]).strip() for part in parts)
        if len(parts) != len(kinds):
            raise ValueError
        return tuple(convert(part, kind) for part, kind in zip(parts, kinds, strict=True))
    if hint in (bool, str):
        if not isinstance(value, hint):
            raise ValueError
        return value
    if not isinstance(value, str | int | float) or isinstance(value, bool):
        raise ValueError
    if hint is int and isinstance(value, float):
        raise ValueError
    if isinstance(value, str) and "_" in value:
        raise ValueError  # Python would read 1_0 as 10
    try:
        return hint(value)
    except OverflowError:
        raise ValueError from None
