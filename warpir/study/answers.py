"""The file of answers of one rater, as the page saves it.

    {"format": 1, "study": ID, "rater": TOKEN, "source": "browser", "resumed": 0,
     "answers": [{"trial": ID, "choice": 1, "ms": 4210, "zoomed": true}, ...]}

One answer for each trial, in the order in which they were shown. ``source`` is ``automated`` where
a program drove the browser: such answers are nobody's opinion.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpir.core.errors import InputError, raise_all, shown
from warpir.core.strict_json import read_json_object
from warpir.study.key import FORMAT
from warpir.study.plan import Plan, Rater, Trial

BROWSER, AUTOMATED = "browser", "automated"
KEYS = {"format", "study", "rater", "source", "resumed", "answers"}
ANSWER_KEYS = {"trial", "choice", "ms", "zoomed"}
LONGEST_MS = 7 * 24 * 3600 * 1000
"""A tab may stay open over night; a response that took a week is a broken clock."""


@dataclass(frozen=True)
class Answer:
    """One choice."""

    trial: Trial
    is_a: bool
    """Whether image `a` was preferred."""
    seconds: float
    """From both images being shown to the choice [s]."""
    zoomed: bool


@dataclass(frozen=True)
class Sheet:
    """All that one rater answered."""

    rater: Rater
    is_automated: bool
    answers: tuple[Answer, ...]

    @property
    def catches_missed(self) -> int:
        """Catch pairs whose obviously worse image was chosen."""
        return sum(a.trial.kind == "catch" and not a.is_a for a in self.answers)


def check_sheet(where: str | Path, record: Mapping[str, Any], plan: Plan) -> Sheet:
    """Check the content of a file of answers.

    Raises:
        InputError: It is of another study or rater, incomplete, or holds anything unexpected.
    """

    def wrong(pointer: str, what: str) -> InputError:
        return InputError(where, f"{pointer}: {what}")

    if set(record) != KEYS:
        odd = ", ".join(shown(key) for key in sorted(set(record) ^ KEYS)[:4])
        raise wrong("/", f"missing or unknown keys: {odd}")
    if record["format"] != FORMAT or isinstance(record["format"], bool):
        raise wrong("/format", f"another format (expected {FORMAT})")
    if record["study"] != plan.id:
        raise wrong("/study", f"answers of another study (expected {plan.id})")
    rater = {r.token: r for r in plan.raters}.get(str(record["rater"]))
    if rater is None:
        raise wrong("/rater", "no rater of this study")
    if record["source"] not in (BROWSER, AUTOMATED):
        raise wrong("/source", f"expected {BROWSER} or {AUTOMATED}")
    if not _is_count(record["resumed"]):
        raise wrong("/resumed", "a count expected")
    answers = record["answers"]
    if not isinstance(answers, list) or len(answers) != len(rater.trials):
        found = len(answers) if isinstance(answers, list) else "none"
        raise wrong("/answers", f"not complete (found {found}; expected {len(rater.trials)})")
    checked = []
    for k, (entry, trial) in enumerate(zip(answers, rater.trials, strict=True)):
        pointer = f"/answers/{k}"
        if not isinstance(entry, dict) or set(entry) != ANSWER_KEYS:
            raise wrong(pointer, f"expected {', '.join(sorted(ANSWER_KEYS))}")
        if entry["trial"] != trial.id:
            raise wrong(f"{pointer}/trial", "not the trial that was shown here")
        if not _is_count(entry["choice"]) or entry["choice"] not in (1, 2):
            raise wrong(f"{pointer}/choice", "expected 1 or 2")
        if not _is_count(entry["ms"]) or entry["ms"] > LONGEST_MS:
            raise wrong(f"{pointer}/ms", f"expected whole milliseconds, at most {LONGEST_MS}")
        if not isinstance(entry["zoomed"], bool):
            raise wrong(f"{pointer}/zoomed", "expected true or false")
        is_a = entry["choice"] == trial.a_side
        checked.append(Answer(trial, is_a, entry["ms"] / 1000.0, entry["zoomed"]))
    return Sheet(rater, record["source"] == AUTOMATED, tuple(checked))


def read_sheets(
    paths: Iterable[Path], plan: Plan, *, include_automated: bool = False
) -> list[Sheet]:
    """Read files of answers.

    Raises:
        InputError: One is bad, automated, or of a rater whose answers another one holds; all that
            are bad are listed.
    """
    problems: list[InputError] = []
    sheets: dict[str, tuple[Path, Sheet]] = {}
    for path in paths:
        try:
            sheet = check_sheet(path, read_json_object(path), plan)
        except InputError as error:
            problems.append(error)
            continue
        if sheet.is_automated and not include_automated:
            problems.append(
                InputError(
                    path,
                    "answered by a program (source: automated), which is nobody's opinion",
                    "leave it out; --include-automated is for tests of the pages",
                )
            )
        earlier, _ = sheets.setdefault(sheet.rater.token, (path, sheet))
        if earlier != path:
            problems.append(InputError(path, f"answers of the same rater as {earlier}"))
    raise_all(problems)
    return [sheet for _, sheet in sheets.values()]


def _is_count(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0
