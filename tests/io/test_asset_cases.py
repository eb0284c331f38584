"""The table of acceptance cases in docs/assets.md is complete and names tests that exist."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
CASES = (*(f"G{k}" for k in range(1, 30)), *(f"M{k}" for k in range(1, 23)))
TESTS = ("gltf", "obj", "placement", "render", "command", "faults", "limits")
"""Where the tests of the cases are."""


def test_every_case_has_its_row_and_its_tests() -> None:
    """Each case has one row, and each test file that the row names carries the case's id."""
    text = (ROOT / "docs" / "assets.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([GM]\d+) \|.*\| ([a-z, ]+) \|$", text, re.MULTILINE)
    assert [case for case, _ in rows] == list(CASES)
    for case, names in rows:
        for name in names.split(", "):
            assert name in TESTS
            (path,) = (ROOT / "tests").glob(f"*/test_{name}.py")
            source = path.read_text(encoding="utf-8")
            assert re.search(rf"[-_\"]{case}[-_\"]", source), f"{case} in test_{name}.py"
