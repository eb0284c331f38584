"""Progress where there is no terminal: a line now and then."""

from concurrent.futures import ThreadPoolExecutor

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


@pytest.mark.parametrize("is_terminal", [False, True])
def test_asking_is_of_one_block_and_thread(
    monkeypatch: pytest.MonkeyPatch, is_terminal: bool
) -> None:
    """What is asked with a report raises where that is made."""
    monkeypatch.setattr("sys.stderr.isatty", lambda: is_terminal, raising=False)

    def stop() -> None:
        raise InterruptedError

    steps = progress.StepProgress(lambda _: None)
    with progress.progress_bar(lambda _: None) as report:
        with progress.asking(stop):
            with ThreadPoolExecutor(1) as pool:  # another run's
                pool.submit(steps.report, "training", 1, 2).result()
            with pytest.raises(InterruptedError):
                report("object", 0.5)
            with pytest.raises(InterruptedError):
                steps.report("training", 1, 2)
        report("object", 0.5)
        steps.report("training", 1, 2)
