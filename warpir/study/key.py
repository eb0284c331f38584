"""The two files of a study that raters never get: ``study.json``, the protocol, and ``key.json``.

The protocol is what was decided before anybody answered, the rule of exclusion included. The key
says which side is which, and holds the sha256 of the protocol: one that was changed afterwards is
refused.
"""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import warpir
from warpir.app.record import file_hash
from warpir.core.errors import InputError
from warpir.core.strict_json import read_json_object
from warpir.study.pairs import Words
from warpir.study.plan import Pair, Plan, Rater, Trial

FORMAT = 1
"""Layout number of ``study.json``, ``key.json`` and the files of answers."""
PROTOCOL, KEY, PAGES, ANSWERS = "study.json", "key.json", "pages", "answers"
"""In the folder of a study: two files, what may be published, what came back."""


@dataclass(frozen=True)
class Study:
    """A study as its folder has it."""

    plan: Plan
    method: str
    """Name of the method; the others are in the pairs."""
    raters: int
    """People who see a pair in a run."""
    runs: int
    most_catches_missed: int
    """A rater who misses more catch pairs is excluded."""
    title: str


def exclusion_rule(most_catches_missed: int) -> str:
    """Word the rule by which raters are excluded."""
    return (
        f"A rater who misses more than {most_catches_missed} of the catch pairs is excluded; "
        "figures are given with and without those who are."
    )


def protocol_bytes(study: Study, words: Words) -> bytes:
    """Return the content of ``study.json``."""
    plan = study.plan
    return _json(
        {
            "format": FORMAT,
            "warpir": warpir.__version__,
            "study": plan.id,
            **asdict(words),
            "raters": study.raters,
            "runs": study.runs,
            "pairs": sum(not pair.is_catch for pair in plan.pairs),
            "catch_pairs": sum(pair.is_catch for pair in plan.pairs),
            "repeats": sum(trial.kind == "repeat" for trial in plan.raters[0].trials),
            "exclusion": {
                "most_catches_missed": study.most_catches_missed,
                "rule": exclusion_rule(study.most_catches_missed),
            },
            "pages": [f"{PAGES}/{rater.token}.html" for rater in plan.raters],
        }
    )


def key_bytes(
    study: Study, protocol: bytes, images: Sequence[Mapping[str, Mapping[str, str]]]
) -> bytes:
    """Return the content of ``key.json``.

    Args:
        study: The study.
        protocol: Content of ``study.json``.
        images: Of each pair what is known of its files, by ``a``, ``b`` and ``photo``.
    """
    plan = study.plan
    return _json(
        {
            "format": FORMAT,
            "about": "Which side is which. Never publish this file.",
            "study": plan.id,
            "seed": plan.seed,
            "method": study.method,
            "protocol_sha256": hashlib.sha256(protocol).hexdigest(),
            "pairs": [
                {**asdict(pair), "images": dict(files)}
                for pair, files in zip(plan.pairs, images, strict=True)
            ],
            "raters": [asdict(rater) for rater in plan.raters],
        }
    )


def read_study(folder: Path) -> Study:
    """Read a study's folder.

    Raises:
        InputError: There is no study in it, or it was changed after it was made.
    """
    if not os.path.isfile(folder / KEY):
        raise InputError(folder, f"no study (found no {KEY})", "python -m warpir.study make")
    key, protocol = read_json_object(folder / KEY), read_json_object(folder / PROTOCOL)
    for name, record in ((KEY, key), (PROTOCOL, protocol)):
        if record.get("format") != FORMAT:
            found = json.dumps(record.get("format"))[:20]
            raise InputError(folder / name, f"/format: {found} (expected {FORMAT})")
    if key.get("protocol_sha256") != file_hash(folder / PROTOCOL):
        raise InputError(
            folder / PROTOCOL,
            "not the protocol that the key was made with (its sha256 differs)",
            "rules are not changed after the fact: put the file back as it was",
        )
    try:
        return _study(key, protocol)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(folder / KEY, f"damaged ({type(error).__name__}: {error})") from error


def _study(key: Mapping[str, Any], protocol: Mapping[str, Any]) -> Study:
    pairs = tuple(
        Pair(**{name: str(entry[name]) for name in ("scene", "group", "baseline", "how")})
        for entry in key["pairs"]
    )
    raters = tuple(
        Rater(entry["token"], int(entry["run"]), tuple(Trial(**t) for t in entry["trials"]))
        for entry in key["raters"]
    )
    runs = int(protocol["runs"])
    if not 1 <= runs <= len(raters):  # each has raters of its own
        raise ValueError(f"{runs} runs of {len(raters)} raters")
    for rater in raters:
        if not isinstance(rater.token, str) or not 1 <= rater.run <= runs:
            raise ValueError(f"rater {rater.token}")
        for trial in rater.trials:
            _check_trial(trial, pairs)
    return Study(
        Plan(key["study"], int(key["seed"]), pairs, raters),
        str(key["method"]),
        int(protocol["raters"]),
        runs,
        int(protocol["exclusion"]["most_catches_missed"]),
        str(protocol["title"]),
    )


def _check_trial(trial: Trial, pairs: Sequence[Pair]) -> None:
    """Check what a trial of the key holds; raises `ValueError`."""
    if not isinstance(trial.id, str) or trial.kind not in ("pair", "repeat", "catch"):
        raise ValueError(f"trial {trial.id}")
    if trial.a_side not in (1, 2) or type(trial.pair) is not int:
        raise ValueError(f"trial {trial.id}")
    if not 0 <= trial.pair < len(pairs) or pairs[trial.pair].is_catch != (trial.kind == "catch"):
        raise ValueError(f"pair of trial {trial.id}")


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
