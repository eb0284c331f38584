"""Statistics over scenes: means, intervals, comparisons and tables.

Intervals are bootstrap percentiles over scenes: a scene is drawn with both of its objects, and two
rows are compared on the same scenes. Scenes of one panorama are not independent of each other, so
the same is given with whole panoramas drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from warpir.core.arrays import Float64Array

ROUNDS = 10_000
"""Number of bootstrap samples."""
LEVEL = 95.0
"""Level of the intervals [%]."""
FEWEST = 6
"""Least number of scenes for an interval: that of two scenes is just both values."""
COMPARED = ("image.box.rmse", "image.full.rmse", "image.asset.rmse", "light.peak_angle_deg")
"""Figures on which rows are compared in pairs."""
AGAINST = ("uniform", "brightest-region")
"""Rows that every other row is compared with, beside its own start."""


@dataclass(frozen=True)
class Entry:
    """Figures of one row on one subject."""

    row: str
    scene: str
    panorama: str
    is_sunny: bool
    material: str
    """Material of the object, `diffuse` or `glossy`."""
    figures: Mapping[str, float]
    """Figures by dotted name, such as ``image.box.rmse``."""
    about: Mapping[str, Any]
    """Notes of `warpir.evaluate.stage.Prediction`."""
    kind: str = ""
    """Kind of place, such as ``indoor``; empty where none is known."""


GROUPS: dict[str, Callable[[Entry], bool]] = {
    "all": lambda e: True,
    "diffuse": lambda e: e.material == "diffuse",
    "glossy": lambda e: e.material == "glossy",
    "sunny": lambda e: e.is_sunny,
    "other": lambda e: not e.is_sunny,
}
"""Groups of entries that are averaged separately."""


@dataclass(frozen=True)
class Mean:
    """A mean over scenes and its intervals."""

    mean: float
    low: float
    high: float
    """95 % bootstrap interval over scenes."""
    low_panorama: float
    high_panorama: float
    """95 % bootstrap interval over panoramas, each with all of its scenes."""
    median: float
    count: int
    """Number of scenes."""

    @property
    def is_sure(self) -> bool:
        """Whether the interval over scenes excludes 0, and there are scenes enough for one."""
        return self.count >= FEWEST and (self.low > 0.0 or self.high < 0.0)


def bootstrap(
    values: Sequence[float], groups: Sequence[str], rounds: int = ROUNDS
) -> tuple[float, float]:
    """Return the percentile interval of a mean when whole groups are drawn with replacement.

    Values and groups are one a scene. Equal groups give equal draws, so intervals of rows go
    together.
    """
    _, group, counts = np.unique(groups, return_inverse=True, return_counts=True)
    drawn = _draws(len(counts), rounds)
    means = (drawn @ np.bincount(group, values)) / (drawn @ counts)
    low, high = np.percentile(means, [50.0 - 0.5 * LEVEL, 50.0 + 0.5 * LEVEL])
    return float(low), float(high)


@lru_cache(maxsize=64)
def _draws(count: int, rounds: int) -> Float64Array:
    """Return how often each of ``count`` groups is drawn, shape [rounds, count]."""
    rng = np.random.default_rng(0)
    return rng.multinomial(count, np.full(count, 1.0 / count), size=rounds).astype(np.float64)


def mean_of(by_scene: Mapping[str, float], panoramas: Mapping[str, str]) -> Mean:
    """Return mean and intervals of one figure."""
    scenes = sorted(by_scene)
    values = [by_scene[s] for s in scenes]
    low, high = bootstrap(values, scenes)
    low_panorama, high_panorama = bootstrap(values, [panoramas[s] for s in scenes])
    middle = float(np.median(values))
    return Mean(float(np.mean(values)), low, high, low_panorama, high_panorama, middle, len(values))


def figure_by_scene(
    entries: Sequence[Entry], row: str, figure: str, group: str
) -> dict[str, float]:
    """Return a figure of a row by scene, the mean over the scene's objects that are in a group."""
    values_by_scene: dict[str, list[float]] = {}
    for entry in entries:
        if entry.row == row and GROUPS[group](entry) and figure in entry.figures:
            values_by_scene.setdefault(entry.scene, []).append(entry.figures[figure])
    return {scene: float(np.mean(values)) for scene, values in values_by_scene.items()}


def summarize(entries: Sequence[Entry]) -> dict[str, dict[str, dict[str, Mean]]]:
    """Return the means of every figure: by row, group and figure."""
    panoramas = {e.scene: e.panorama for e in entries}
    summary: dict[str, dict[str, dict[str, Mean]]] = {}
    for row in dict.fromkeys(e.row for e in entries):
        figures = dict.fromkeys(f for e in entries if e.row == row for f in e.figures)
        for group in GROUPS:
            means = {}
            for figure in figures:
                by_scene = figure_by_scene(entries, row, figure, group)
                if by_scene:
                    means[figure] = mean_of(by_scene, panoramas)
            summary.setdefault(row, {})[group] = means
    return summary


@dataclass(frozen=True)
class Pair:
    """Comparison of two rows on their common scenes; lower figures are better."""

    row: str
    against: str
    is_start: bool
    """Whether the row began with the other's light."""
    figure: str
    group: str
    difference: Mean
    """Row minus the other: below 0 the row is better."""
    better: int
    worse: int
    """Number of scenes."""


def compare(entries: Sequence[Entry], starts: Mapping[str, str]) -> list[Pair]:
    """Compare every row with `AGAINST` and with the row that it starts from."""
    panoramas = {e.scene: e.panorama for e in entries}
    rows = list(dict.fromkeys(e.row for e in entries))
    pairs = []
    for row in rows:
        others = [r for r in dict.fromkeys((starts.get(row), *AGAINST)) if r in rows and r != row]
        for other in others:
            for figure in COMPARED:
                for group in GROUPS:
                    mine = figure_by_scene(entries, row, figure, group)
                    theirs = figure_by_scene(entries, other, figure, group)
                    both = {s: mine[s] - theirs[s] for s in mine if s in theirs}
                    if both:
                        better = sum(v < 0.0 for v in both.values())
                        worse = sum(v > 0.0 for v in both.values())
                        is_start = other == starts.get(row)
                        mean = mean_of(both, panoramas)
                        pairs.append(
                            Pair(row, str(other), is_start, figure, group, mean, better, worse)
                        )
    return pairs


# ---------------------------------------------------------------------------------------- tables

TABLES: tuple[tuple[str, tuple[tuple[str, str], ...]], ...] = (
    (
        "Composites",
        tuple(
            (f"{name} {region}", f"image.{region}.{key}")
            for region in ("full", "box", "asset", "shadow")
            for name, key in (("RMSE", "rmse"), ("si-RMSE", "si_rmse"))
        ),
    ),
    (
        "Composites, other measures",
        (
            ("SSIM full", "image.full.ssim"),
            ("SSIM box", "image.box.ssim"),
            ("FLIP full", "image.full.flip"),
            ("FLIP box", "image.box.flip"),
            ("LPIPS full", "image.full.lpips"),
            ("linear RMSE full", "image.full.linear_rmse"),
            ("linear RMSE asset", "image.asset.linear_rmse"),
        ),
    ),
    (
        "Composites after one exposure of the light fitted on the object",
        (
            ("RMSE full", "fitted.full.rmse"),
            ("RMSE box", "fitted.box.rmse"),
            ("RMSE asset", "fitted.asset.rmse"),
            ("SSIM full", "fitted.full.ssim"),
            ("factor [EV]", "fitted.ev"),
        ),
    ),
    (
        "Light",
        (
            ("peak angle", "light.peak_angle_deg"),
            ("in its 68 % region", "light.in_region"),
            ("centroid angle", "light.bright_angle_deg"),
            ("blob angle", "light.blob_angle_deg"),
            ("abs log sun/sky", "light.abs_log_sun_sky_ratio_error"),
            ("abs log flux", "light.abs_log_flux_error"),
            ("RGB angle", "light.rgb_angle_deg"),
            ("log ambient", "light.ambient_log_error"),
            ("log red/green", "light.ambient_red_log_error"),
            ("log blue/green", "light.ambient_blue_log_error"),
        ),
    ),
    (
        "Three spheres, published form (7.2)",
        tuple(
            (f"{sphere} {name}", f"spheres.published_{sphere}_{key}")
            for name, key in (("si-RMSE", "si_rmse"), ("angle", "angular_deg"))
            for sphere in ("diffuse", "matte", "mirror")
        ),
    ),
    (
        "Three spheres, linear form",
        tuple(
            (f"{sphere} {name}", f"spheres.linear_{sphere}_{key}")
            for name, key in (("RMSE", "rmse"), ("si-RMSE", "si_rmse"))
            for sphere in ("diffuse", "matte", "mirror")
        ),
    ),
)
"""Title and columns (words, figure) of the tables."""
OF_LIGHT = ("light.", "spheres.")
"""Figures that do not depend on the object, but for guided rows."""


def tables(
    summary: Mapping[str, Mapping[str, Mapping[str, Mean]]], words: Mapping[str, str]
) -> Iterator[str]:
    """Yield the tables as lines of Markdown."""
    for title, columns in TABLES:
        is_light = columns[0][1].startswith(OF_LIGHT)
        for group in ("all", "sunny", "other") if is_light else tuple(GROUPS):
            shown = [c for c in columns if any(c[1] in rows[group] for rows in summary.values())]
            scenes = max(
                (m.count for rows in summary.values() for m in rows[group].values()), default=0
            )
            if shown:
                rows = [
                    [row, *(_cell(groups[group].get(figure)) for _, figure in shown)]
                    for row, groups in summary.items()
                ]
                heading = f"{title}: {group} ({scenes} scenes)"
                yield from _table(heading, ["row", *(name for name, _ in shown)], rows)
    yield from _table("Rows", ["row", "what it is"], [[row, words[row]] for row in summary])


def _table(heading: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table under its heading as lines of Markdown."""
    yield f"## {heading}"
    yield ""
    yield f"| {' | '.join(columns)} |"
    yield "|---" * len(columns) + "|"
    for cells in rows:
        yield f"| {' | '.join(cells)} |"
    yield ""


KIND_COLUMNS = (
    ("peak angle", "light.peak_angle_deg"),
    ("in its 68 % region", "light.in_region"),
    ("abs log sun/sky", "light.abs_log_sun_sky_ratio_error"),
    ("abs log flux", "light.abs_log_flux_error"),
    ("log ambient", "light.ambient_log_error"),
    ("log red/green", "light.ambient_red_log_error"),
    ("log blue/green", "light.ambient_blue_log_error"),
    ("RMSE box", "image.box.rmse"),
    ("RMSE object", "image.asset.rmse"),
    ("RMSE shadow", "image.shadow.rmse"),
)
"""Columns (words, figure) of the table by kind of place."""


def by_kind(entries: Sequence[Entry]) -> dict[str, dict[str, dict[str, float]]]:
    """Return the means of `KIND_COLUMNS` by kind of place, row and figure; nothing without kinds.

    ``scenes`` and ``panoramas`` are counts.
    """
    found: dict[str, dict[str, dict[str, float]]] = {}
    for kind in sorted({e.kind for e in entries if e.kind}):
        of_kind = [e for e in entries if e.kind == kind]
        for row in dict.fromkeys(e.row for e in of_kind):
            chosen = [e for e in of_kind if e.row == row]
            means: dict[str, float] = {
                "scenes": float(len({e.scene for e in chosen})),
                "panoramas": float(len({e.panorama for e in chosen})),
            }
            for _, figure in KIND_COLUMNS:
                values = figure_by_scene(chosen, row, figure, "all").values()
                if values:
                    means[figure] = float(np.mean(list(values)))
            found.setdefault(kind, {})[row] = means
    return found


def kind_table(kinds: Mapping[str, Mapping[str, Mapping[str, float]]]) -> Iterator[str]:
    """Yield the table of `by_kind` as lines of Markdown."""
    lines = []
    for kind, rows in kinds.items():
        for row, means in rows.items():
            cells = [
                f"{means[figure]:.{1 if figure.endswith('_deg') else 4}f}"
                if figure in means
                else ""
                for _, figure in KIND_COLUMNS
            ]
            counts = f"{means['scenes']:.0f} ({means['panoramas']:.0f})"
            lines.append([kind, counts, row, *cells])
    if lines:
        columns = ["kind", "scenes (places)", "row", *(words for words, _ in KIND_COLUMNS)]
        yield from _table("By kind of place", columns, lines)


def pair_table(pairs: Sequence[Pair]) -> Iterator[str]:
    """Yield the comparisons as lines of Markdown; groups of objects are left to the JSON file."""
    rows = []
    for p in (p for p in pairs if p.group in ("all", "sunny")):
        against = f"{p.against} (its start)" if p.is_start else p.against
        difference = _cell(p.difference) + (" *" if p.difference.is_sure else "")
        counts = f"{p.better} / {p.worse}"
        rows.append([p.row, against, p.figure, p.group, difference, counts])
    if rows:
        sure = f"* the 95 % interval excludes 0, with {FEWEST} scenes or more"
        heading = f"In pairs, scene by scene (below 0: better; {sure})"
        columns = ["row", "against", "figure", "group", "difference", "better / worse"]
        yield from _table(heading, columns, rows)


def _cell(mean: Mean | None) -> str:
    if mean is None:
        return ""
    digits = 1 if max(abs(mean.low), abs(mean.high)) >= 10.0 else 4
    return f"{mean.mean:.{digits}f} ({mean.low:.{digits}f} .. {mean.high:.{digits}f})"


def as_plain(summary: Mapping[str, Mapping[str, Mapping[str, Mean]]]) -> dict[str, Any]:
    """Return a summary as plain values for JSON."""
    return {
        row: {
            group: {figure: asdict(mean) for figure, mean in figures.items()}
            for group, figures in groups.items()
        }
        for row, groups in summary.items()
    }
