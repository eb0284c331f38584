"""From answers to figures, as in DiPIR's supplement C.1: majorities, runs, and how sure they are.

An image is preferred when most of its raters in a run chose it. The study is run several times; the
main figure is the mean and sample standard deviation over runs of the share of images preferred.
Intervals are over scenes: it is scenes, not votes, that stand for all the photos there are.
"""

import math
import statistics
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from warpir.study.answers import Answer, Sheet
from warpir.study.key import Study, exclusion_rule
from warpir.study.plan import ALL, UNGROUPED, Pair

LEVEL = 0.95
"""Of the intervals."""
WARNING = (
    "INCLUDES AUTOMATED ANSWERS: a program answered, not a person; these figures are nobody's "
    "opinion."
)

Votes = tuple[int, int]
"""How many preferred the method's image, and the baseline's."""


@dataclass(frozen=True)
class Proportion:
    """How many of how many, with 95 % intervals and a test against one half."""

    count: float
    """A tie counts as one half."""
    total: int
    ties: int
    clopper_pearson: tuple[float, float] | None
    """Exact interval, without ties; None where there is nothing to count."""
    wilson: tuple[float, float] | None
    p_value: float | None
    """Two-sided exact binomial test against one half, without ties."""

    @property
    def share(self) -> float | None:
        """Of the total."""
        return self.count / self.total if self.total else None


def proportion(count: int, total: int, ties: int = 0) -> Proportion:
    """Return the proportion of ``count`` with its intervals (`scipy.stats.binomtest`).

    The total includes ties, which are neither counted nor not.
    """
    from scipy.stats import binomtest

    decided = total - ties
    if decided == 0:
        return Proportion(0.5 * ties, total, ties, None, None, None)
    test = binomtest(count, decided, 0.5)
    exact, wilson = (test.proportion_ci(LEVEL, method=m) for m in ("exact", "wilson"))
    return Proportion(
        count + 0.5 * ties,
        total,
        ties,
        (float(exact.low), float(exact.high)),
        (float(wilson.low), float(wilson.high)),
        float(test.pvalue),
    )


def majority(votes: Iterable[Votes]) -> Proportion:
    """Return how many images most of their raters preferred."""
    found = list(votes)
    return proportion(sum(a > b for a, b in found), len(found), ties=sum(a == b for a, b in found))


def fleiss_kappa(counts: Sequence[Sequence[int]]) -> float | None:
    """Return the agreement of raters beyond chance (Fleiss 1971, equations 1 to 7).

    Args:
        counts: How many raters put each subject into each category, shape [subject][category].
            Subjects may have had different numbers of raters; those with one are left out, as no
            two agree on them.

    Returns:
        1 when all agree, 0 as by chance; None when everyone said the same of everything, or nobody
        can be compared.
    """
    rows = [row for row in counts if sum(row) > 1]
    if not rows:
        return None
    total = sum(map(sum, rows))
    agreement = statistics.fmean(
        sum(n * (n - 1) for n in row) / (sum(row) * (sum(row) - 1)) for row in rows
    )
    chance = sum((sum(column) / total) ** 2 for column in zip(*rows, strict=True))
    return None if math.isclose(chance, 1.0) else (agreement - chance) / (1.0 - chance)


def score(study: Study, sheets: Sequence[Sheet]) -> dict[str, Any]:
    """Return all figures of a study, as plain JSON."""
    excluded = [s for s in sheets if s.catches_missed > study.most_catches_missed]
    kept = [s for s in sheets if s not in excluded]
    catches = sum(pair.is_catch for pair in study.plan.pairs)
    automated = sum(s.is_automated for s in sheets)
    report: dict[str, Any] = {"warning": WARNING} if automated else {}
    return report | {
        "format": 1,
        "study": study.plan.id,
        "title": study.title,
        "method": study.method,
        "sheets": {
            "expected": len(study.plan.raters),
            "found": len(sheets),
            "automated": automated,
            "excluded": [s.rater.token for s in excluded],
        },
        "exclusion": exclusion_rule(study.most_catches_missed)
        if catches
        else "There are no catch pairs, so nobody can be excluded.",
        "kept": _figures(study, kept),
        "everybody": _figures(study, sheets),
    }


def _figures(study: Study, sheets: Sequence[Sheet]) -> dict[str, Any]:
    """Return the figures of some raters."""
    shown = [(sheet.rater.run, answer) for sheet in sheets for answer in sheet.answers]
    first = [(run, answer) for run, answer in shown if answer.trial.kind == "pair"]
    votes: dict[int, dict[int, Votes]] = {run: {} for run in range(1, study.runs + 1)}
    for run, answer in first:
        a, b = votes[run].get(answer.trial.pair, (0, 0))
        votes[run][answer.trial.pair] = (a + answer.is_a, b + (not answer.is_a))
    pairs = {k: pair for k, pair in enumerate(study.plan.pairs) if not pair.is_catch}
    on_side_1 = sum((a.trial.a_side == 1) == a.is_a for _, a in first)
    seconds = [a.seconds for _, a in first]
    return {
        "raters": len(sheets),
        "comparisons": [
            _comparison(baseline, group, {k: pairs[k] for k in chosen}, votes)
            for baseline, group, chosen in _groups(pairs)
        ],
        "kappa": fleiss_kappa(list(_pooled(pairs, votes).values())),
        "repeats_consistent": _plain(_consistency(sheets)),
        "catches_right": _plain(
            proportion(
                sum(a.is_a for _, a in shown if a.trial.kind == "catch"),
                sum(a.trial.kind == "catch" for _, a in shown),
            )
        ),
        "side_1_chosen": _plain(proportion(on_side_1, len(first))),
        "median_seconds": statistics.median(seconds) if seconds else None,
        "zoomed_share": statistics.fmean(a.zoomed for _, a in first) if first else None,
    }


def _groups(pairs: Mapping[int, Pair]) -> list[tuple[str, str, list[int]]]:
    """Return (baseline, group, indices of the pairs): every group, then all scenes together."""
    chosen: dict[tuple[str, str], list[int]] = defaultdict(list)
    for k, pair in pairs.items():
        chosen[pair.baseline, pair.group].append(k)
    table = []
    for baseline in dict.fromkeys(pair.baseline for pair in pairs.values()):
        own = [(group, ks) for (name, group), ks in chosen.items() if name == baseline]
        if len(own) > 1:
            table += [(baseline, group or UNGROUPED, ks) for group, ks in own]
        table.append((baseline, ALL, sorted(k for _, ks in own for k in ks)))
    return table


def _comparison(
    baseline: str,
    group: str,
    pairs: Mapping[int, Pair],
    votes: Mapping[int, Mapping[int, Votes]],
) -> dict[str, Any]:
    runs: list[dict[str, Any]] = []
    for run, of_run in votes.items():
        found = [of_run[k] for k in pairs if k in of_run]
        if not found:
            continue
        single = proportion(sum(a for a, _ in found), sum(a + b for a, b in found))
        runs.append({"run": run, "images": _plain(majority(found)), "votes": _plain(single)})
    pooled = _pooled(pairs, votes)
    return {
        "baseline": baseline,
        "group": group,
        "scenes": len(pairs),
        "scenes_without_votes": len(pairs) - len(pooled),
        "images_preferred": _spread([run["images"]["share"] for run in runs]),
        "votes_preferred": _spread([run["votes"]["share"] for run in runs]),
        "scenes_preferred": _plain(majority(pooled.values())),
        "kappa": fleiss_kappa(list(pooled.values())),
        "runs": runs,
    }


def _pooled(pairs: Iterable[int], votes: Mapping[int, Mapping[int, Votes]]) -> dict[int, Votes]:
    """Return the votes of all runs together, of the pairs that have any."""
    pooled = {}
    for k in pairs:
        found = [of_run[k] for of_run in votes.values() if k in of_run]
        if found:
            pooled[k] = (sum(a for a, _ in found), sum(b for _, b in found))
    return pooled


def _consistency(sheets: Sequence[Sheet]) -> Proportion:
    """Return how often a rater chose the same image when a pair came again, sides exchanged."""
    same: Counter[bool] = Counter()
    for sheet in sheets:
        first: dict[int, Answer] = {
            a.trial.pair: a for a in sheet.answers if a.trial.kind == "pair"
        }
        for answer in sheet.answers:
            if answer.trial.kind == "repeat":
                same[answer.is_a == first[answer.trial.pair].is_a] += 1
    return proportion(same[True], same.total())


def _spread(shares: Sequence[float]) -> dict[str, float | None]:
    """Return the mean and the sample standard deviation (n - 1) over runs."""
    return {
        "mean": statistics.fmean(shares) if shares else None,
        "sd": statistics.stdev(shares) if len(shares) > 1 else None,
    }


def _plain(found: Proportion) -> dict[str, Any]:
    return {"share": found.share, **asdict(found)}
