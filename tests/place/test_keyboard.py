"""The placing page by keyboard alone."""

from pathlib import Path

import pytest

from tests.builders.programs.browser import needs_chromium
from tests.builders.programs.placing import STATE, command, enter, placing, press


@needs_chromium
@pytest.mark.slow
def test_comma_is_a_decimal_sign(inputs: Path, tmp_path: Path) -> None:
    """1,5 is neither 15 nor nothing, typed or pasted."""
    with placing(command(inputs, tmp_path / "out"), 700, 500) as opened:
        for write in (opened.page.keyboard.type, opened.page.keyboard.insert_text):
            enter(opened, "size", "2")
            opened.page.focus("#size")
            press(opened, "Control+a")
            write("1,5")
            press(opened, "Enter")
            assert opened.page.evaluate(STATE)["size"] == 1.5


@needs_chromium
@pytest.mark.slow
def test_refused_number_is_told(inputs: Path, tmp_path: Path) -> None:
    """What a field does not take is said, and what warpir can use is taken."""
    with placing(command(inputs, tmp_path / "out", "--fov", "150"), 700, 500) as opened:
        page = opened.page
        before = page.evaluate(STATE)
        for field, typed, expected in (
            ("pitch", "95", "Pitch, up is positive: expected -89 to 89 ° (found 95)."),
            ("size", "-3", "Size: expected more than 0 (found -3)."),
            ("size", "", ""),
        ):
            enter(opened, field, typed)
            assert page.inner_text("#problem") == expected
            assert page.is_visible("#problem") == bool(expected)
            assert page.evaluate(STATE) == before
        for field, typed in (("fov", "155"), ("right", "-30")):
            enter(opened, field, typed)
            assert page.is_hidden("#problem")
            assert float(page.input_value(f"#{field}")) == float(typed)
