"""What a study shows to whom: sides, order, repeats and catch pairs, all of it from one seed.

Two-alternative forced choice as in DiPIR's supplement C.1: the method against one baseline, sides
and order shuffled for each rater. No file is touched here.
"""

import hashlib
import json
import math
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Kind = Literal["pair", "repeat", "catch"]

ALL, UNGROUPED = "all", "no group"
"""What all scenes together, and those without a group, are called among the groups."""
PAIRS_PER_REPEAT = 10
"""One pair in so many is shown twice."""
PAIRS_PER_CATCH = 20
"""Pairs for each catch pair, where these are generated."""
MIXINGS = 20
"""Random exchanges for each cell of a table of sides."""


@dataclass(frozen=True)
class Pair:
    """Two images of one scene, `a` and `b`, which only the key tells apart."""

    scene: str
    group: str
    """Of scenes that are scored apart, such as ``sunny``; may be empty."""
    baseline: str
    """Whose image `b` is; `a` is the method's. Empty of a catch pair."""
    how: str = ""
    """Of a catch pair: how `b`, the obviously worse image, came to be."""

    @property
    def is_catch(self) -> bool:
        """Whether the answer is known beforehand."""
        return bool(self.how)


@dataclass(frozen=True)
class Trial:
    """One choice that one rater makes."""

    id: str
    pair: int
    """Index of the pair."""
    kind: Kind
    a_side: int
    """Where image `a` is shown, 1 or 2."""


@dataclass(frozen=True)
class Rater:
    """One sheet of a study, for one person."""

    token: str
    """What stands in the address; names the page and the file of answers."""
    run: int
    """Which repetition of the study this is part of, from 1."""
    trials: tuple[Trial, ...]


@dataclass(frozen=True)
class Plan:
    """A whole study."""

    id: str
    seed: int
    pairs: tuple[Pair, ...]
    raters: tuple[Rater, ...]


def opaque(seed: int, *parts: object, digits: int = 20) -> str:
    """Return a name that tells nothing without the seed: hexadecimal digits of a sha256."""
    text = json.dumps([str(seed), *map(str, parts)])
    return hashlib.sha256(text.encode()).hexdigest()[:digits]


def make_plan(
    pairs: Sequence[Pair],
    *,
    raters: int,
    runs: int,
    seed: int,
    repeats: int | None = None,
    pairs_per_rater: int | None = None,
) -> Plan:
    """Plan who sees what.

    In each run every pair is seen by `raters` people, with its method on side 1 for half of them
    (odd numbers: one more or less), and everyone has it on side 1 for half of their pairs. All
    catch pairs are shown to everyone.

    Args:
        pairs: Pairs and catch pairs, in any order.
        raters: People who see a pair in a run.
        runs: How often the study is run, each time with other people.
        seed: Of all that is random. Equal arguments give an equal plan.
        repeats: Pairs that a rater sees twice, the second time with sides exchanged; one in
            `PAIRS_PER_REPEAT` when absent. Never more than a rater has pairs.
        pairs_per_rater: Most pairs for one person; with fewer than all, there are more people.
    """
    rng = random.Random(seed)
    ordinary = [k for k, pair in enumerate(pairs) if not pair.is_catch]
    catches = [k for k, pair in enumerate(pairs) if pair.is_catch]
    block_count = math.ceil(len(ordinary) / (pairs_per_rater or len(ordinary)))
    study = opaque(seed, "study", pairs, raters, runs, repeats, pairs_per_rater)
    people: list[Rater] = []
    for run in range(1, runs + 1):
        rng.shuffle(ordinary)
        for block in (ordinary[k::block_count] for k in range(block_count)):
            for sides in balanced_sides(raters, len(block), rng):
                token = opaque(seed, study, "rater", len(people))
                shown = _order(block, sides, catches, repeats, rng)
                trials = (
                    Trial(opaque(seed, token, "trial", place), *trial)
                    for place, trial in enumerate(shown)
                )
                people.append(Rater(token, run, tuple(trials)))
    return Plan(study, seed, tuple(pairs), tuple(people))


def balanced_sides(rows: int, columns: int, rng: random.Random) -> list[list[int]]:
    """Return a random table of sides, 1 or 2, shape [rows][columns], even in each row and column.

    A chessboard is even; exchanging two rows' cells in two columns where they are crossed keeps
    every count.
    """
    flipped = rng.randrange(2)
    table = [[(i + j + flipped) % 2 for j in range(columns)] for i in range(rows)]
    if rows > 1 and columns > 1:
        for _ in range(MIXINGS * rows * columns):
            (i, k), (j, m) = rng.sample(range(rows), 2), rng.sample(range(columns), 2)
            if table[i][j] == table[k][m] != table[i][m] == table[k][j]:
                for row in (i, k):
                    table[row][j], table[row][m] = table[row][m], table[row][j]
    return [[1 + cell for cell in row] for row in table]


def _order(
    block: Sequence[int],
    sides: Sequence[int],
    catches: Sequence[int],
    repeats: int | None,
    rng: random.Random,
) -> list[tuple[int, Kind, int]]:
    """Return (pair, kind, side of `a`) in the order in which one person sees them."""
    count = math.ceil(len(block) / PAIRS_PER_REPEAT) if repeats is None else repeats
    count = min(count, len(block))
    shown: list[tuple[int, Kind, int]] = [
        (pair, "pair", side) for pair, side in zip(block, sides, strict=True)
    ]
    rng.shuffle(shown)
    # Half of the pairs lie between a pair and its repeat, so that it is not simply remembered.
    gap = max(1, len(block) // 2)
    early = shown[: max(count, len(shown) - gap)]
    for first in rng.sample(early, count):
        earliest = min(shown.index(first) + gap + 1, len(shown))
        again: tuple[int, Kind, int] = (first[0], "repeat", 3 - first[2])
        shown.insert(rng.randint(earliest, len(shown)), again)
    for pair in catches:
        shown.insert(rng.randint(0, len(shown)), (pair, "catch", rng.randint(1, 2)))
    return shown
