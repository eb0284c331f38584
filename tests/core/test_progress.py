"""Progress where there is no terminal: a line now and then."""

import pytest

from warpir.core import progress


@pytest.mark.parametrize("seconds", [0.0, 3600.0])
def test_a_render_prints_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, seconds: float
) -> None:
    """Stages by name and share, and nothing in a short run."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: False, raising=False)
    monkeypatch.setattr(progress, "LINE_SECONDS", seconds)
    lines: list[str] = []
    with progress.progress_bar(lines.append) as report:
        report("", 0.1)
        report("object", 0.4)
        report("shadow", 1.0)
    shown = ["object: 40 of 100 %", "shadow: 100 of 100 %"]
    assert lines == (shown if seconds == 0.0 else [])
