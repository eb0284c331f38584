"""Which panoramas show one place, and how places are split into folds."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np

SAME_SKY = (("rustig", "qwantani", "autumn"), ("mpumalanga", "lonely"))
"""First words of panoramas that were taken under nearly one sky."""


def place_of(name: str) -> str:
    """Return what panoramas of one place share: the first word of their names.

    Unlike places may share one; then they are held out together, which does no harm.
    """
    word = name.lower().partition("_")[0]
    return next((group[0] for group in SAME_SKY if word in group), word)


def without_size(name: str) -> str:
    """Return a panorama's name without the size that Poly Haven's files end in, such as ``_4k``."""
    return re.sub(r"_\d+k$", "", name)


def _shuffled(names: Collection[str], known: Collection[str]) -> list[str]:
    """Return the places of these panoramas, without the known ones, in one fixed random order."""
    places = sorted({place_of(n) for n in names} - {place_of(n) for n in known})
    order = np.random.default_rng(0).permutation(len(places))
    return [places[k] for k in order]


def of_fold(
    names: Sequence[str], fold: tuple[int, int] | None, known: Collection[str]
) -> list[str]:
    """Return the panoramas of one fold, whole places each.

    Args:
        names: Of all panoramas.
        fold: Index and number of folds, or None for an empty one.
        known: Panoramas that the weights to begin with have learned from: their places are in no
            fold, for nothing could be judged by them.
    """
    if fold is None:
        return []
    chosen = set(_shuffled(names, known)[fold[0] :: fold[1]])
    return [name for name in names if place_of(name) in chosen]


def some_places(names: Sequence[str], count: int | None, known: Collection[str]) -> set[str]:
    """Return about that many panoramas, whole places each, the known ones of `of_fold` first."""
    if count is None:
        return set(names)
    fresh = _shuffled(names, known)
    chosen = {name for name in names if place_of(name) not in fresh}
    for place in fresh:
        if len(chosen) >= count:
            break
        chosen |= {name for name in names if place_of(name) == place}
    return chosen


def learned_from(record: Mapping[str, Any]) -> set[str]:
    """Return the panoramas that a network, and those it started from, have learned from.

    Names are `without_size`: the same place in another size is no new one.

    Args:
        record: Of the network's weights, as `warpir.lighting.regressor.Regressor.record`.
    """
    names: set[str] = set()
    records = [record]
    while records:
        each = records.pop()
        names |= {without_size(name) for name in each.get("panoramas", ())}
        records += each.get("members", [])
        records += [each["started_from"]] if each.get("started_from") else []
    return names
