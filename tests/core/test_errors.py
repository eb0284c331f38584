"""The tables of reasons: every call of one gives its sentence what it needs."""

import ast
import pickle
import string
from collections import defaultdict
from copy import copy
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest

import warpir
from warpir.core.errors import ExitCode, Faults, InputError
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.prior import NonFiniteError

ROOT = Path(warpir.__file__).parent
SOURCES = {path: path.read_text("utf-8") for path in sorted(ROOT.rglob("*.py"))}


def tables() -> dict[str, Faults]:
    """Return the tables of all modules by their names."""
    found = {}
    for path, text in SOURCES.items():
        for node in ast.parse(text).body if "= Faults(" in text else ():
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
                called = node.value.func
                if isinstance(called, ast.Name) and called.id == "Faults":
                    (target,) = node.targets
                    assert isinstance(target, ast.Name) and target.id not in found
                    name = ".".join(path.relative_to(ROOT.parent).with_suffix("").parts)
                    found[target.id] = getattr(import_module(name), target.id)
    return found


TABLES = tables()


def needed(table: Faults, reason: str) -> set[str]:
    """Return the fields that stand in a sentence."""
    stated = table.sentences[reason]
    sentence = stated if isinstance(stated, str) else stated[0]
    return {name for _, name, _, _ in string.Formatter().parse(sentence) if name}


@cache
def calls() -> list[tuple[Path, str, set[str], ast.Call]]:
    """Return each call of the sources: its file, its function, the texts among its arguments."""
    found = []
    for path, text in SOURCES.items():
        for call in ast.walk(ast.parse(text)):
            if isinstance(call, ast.Call):
                parts = (part for argument in call.args for part in ast.walk(argument))
                constants = {part.value for part in parts if isinstance(part, ast.Constant)}
                texts = {value for value in constants if isinstance(value, str)}
                if texts:
                    found.append((path, ast.unparse(call.func), texts, call))
    return found


@pytest.mark.parametrize("name", TABLES)
def test_every_call_fills_its_sentence(name: str) -> None:
    """No error fails for a field that its sentence has and the call has not; none is unused."""
    table, used = TABLES[name], defaultdict[str, int](int)
    for path, function, constants, call in calls():
        # An entry of a glTF file knows its path.
        is_call = function == f"{name}.error" or (
            name == "GLTF" and "gltf" in str(path) and function.endswith(".error")
        )
        for reason in constants & set(table.sentences):
            used[reason] += 1
            if is_call:
                given = {keyword.arg for keyword in call.keywords}
                missing = needed(table, reason) - given
                assert not missing or None in given, f"{path}:{call.lineno}: {missing}"
    assert set(table.sentences) == set(used)


def test_sentence_is_made_of_its_fields() -> None:
    """The place first, then the sentence, then the values that it does not hold itself."""
    table = Faults(
        "kind", {"far": ("too far from {place}", "come nearer"), "odd": "{found} is odd"}
    )
    error = table.error("file", "far", pointer="/a", line=3, place="home", found=2.5, limit=(1, 2))
    assert error.what == "/a: line 3: too far from home (found 2.5; limit 1 x 2)"
    assert (error.where, error.reason, error.advice) == ("file", "kind.far", "come nearer")
    assert error.fields == {
        "pointer": "/a", "line": 3, "place": "home", "found": 2.5, "limit": (1, 2)
    }  # fmt: skip
    odd = table.error("file", "odd", found="{x}", expected="even", advice="add one")
    assert (odd.what, odd.advice) == ("{x} is odd (expected even)", "add one")


@pytest.mark.parametrize(
    "error",
    [
        InputError("a.jpg", "is bad", "mend it", ExitCode.OUTPUT, reason="a.b", found=(1, 2)),
        ModelError("dir", "is no model"),
        NonFiniteError("the loss is NaN"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_errors_leave_a_process_whole(error: InputError) -> None:
    """One that cannot be read back breaks a whole `ProcessPoolExecutor`."""
    error.also = (InputError("b.jpg", "too"),)
    for other in (pickle.loads(pickle.dumps(error)), copy(error)):
        assert (type(other), str(other)) == (type(error), str(error))
        assert {**vars(other), "also": 0} == {**vars(error), "also": 0}
        assert str(other.also[0]) == "b.jpg: too"
