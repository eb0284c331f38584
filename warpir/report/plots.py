"""Geometry of the report's plots; the template ``macros.html.j2`` draws them as SVG.

Colours come from the page's style sheet by class, so that a plot is dark on light and light on dark
as the page is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import Float64Array

WIDTH, HEIGHT = 360, 250
LEFT, RIGHT, TOP, BOTTOM = 58, 346, 14, 206
"""Edges of the area between the axes [px]."""
POINTS_MAX = 400
"""Largest number of points of a line; more are not distinguishable."""
DOTS_MAX = 12
"""Largest number of points that are also drawn as dots."""

Point = tuple[float, float]


@dataclass(frozen=True)
class Series:
    """One line of values, or a single point."""

    x: Float64Array
    y: Float64Array
    style: str = "s0"
    """Class of the style sheet."""


@dataclass(frozen=True)
class Line:
    """A series in pixels of the plot."""

    style: str
    points: list[Point]

    @property
    def has_dots(self) -> bool:
        """Whether its points are few enough to be read one by one."""
        return len(self.points) <= DOTS_MAX


@dataclass(frozen=True)
class Plot:
    """A plot in pixels: axes with ticks, lines, and vertical marks."""

    title: str
    """Description of the plot for screen readers."""
    labels: tuple[str, str]
    """Labels of the axes."""
    x_ticks: list[tuple[float, str]]
    """Position and text of each tick."""
    y_ticks: list[tuple[float, str]]
    lines: list[Line]
    marks: list[tuple[float, str]]
    """Position and name of each mark."""
    width: int = WIDTH
    height: int = HEIGHT
    left: int = LEFT
    right: int = RIGHT
    top: int = TOP
    bottom: int = BOTTOM

    @property
    def middle(self) -> Point:
        """Middle of the area between the axes."""
        return (self.left + self.right) / 2, (self.top + self.bottom) / 2


@dataclass(frozen=True)
class _Axis:
    """A range of values along an edge of the plot."""

    low: float
    high: float
    start: int
    """Position of `low` [px]."""
    end: int

    def at(self, value: float) -> float:
        """Return the position of a value [px]."""
        share = (value - self.low) / (self.high - self.low)
        return round(float(self.start + share * (self.end - self.start)), 1)

    def ticks(self) -> list[tuple[float, str]]:
        return [(self.at(tick), f"{tick:.6g}") for tick in ticks(self.low, self.high, 5)]


def line_plot(
    series: Sequence[Series],
    title: str,
    labels: tuple[str, str],
    *,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    marks: Mapping[str, float] | None = None,
) -> Plot:
    """Lay out a plot with axes, ticks and labels.

    Args:
        series: At least one, each with at least one point.
        title: Description of the plot for screen readers.
        labels: Labels of the axes.
        x_range: Range of the x axis; that of the values when absent.
        y_range: Likewise.
        marks: Vertical lines, by their names.
    """
    x_axis = _Axis(*(x_range or _range_of([s.x for s in series])), LEFT, RIGHT)
    y_axis = _Axis(*(y_range or _range_of([s.y for s in series])), BOTTOM, TOP)
    lines = []
    for s in series:
        every = max(1, len(s.x) // POINTS_MAX)
        chosen = sorted({*range(0, len(s.x), every), len(s.x) - 1})
        lines.append(Line(s.style, [(x_axis.at(s.x[k]), y_axis.at(s.y[k])) for k in chosen]))
    return Plot(
        title,
        labels,
        x_axis.ticks(),
        y_axis.ticks(),
        lines,
        [(x_axis.at(value), name) for name, value in (marks or {}).items()],
    )


def ticks(low: float, high: float, count: int) -> list[float]:
    """Return round numbers within a range, about ``count`` of them."""
    raw = (high - low) / count
    size = 10.0 ** np.floor(np.log10(raw))
    step = next((s * size for s in (1.0, 2.0, 5.0) if s * size >= raw * 0.999), 10.0 * size)
    first, last = int(np.ceil(low / step - 1e-9)), int(np.floor(high / step + 1e-9))
    return [float(f"{k * step:.9g}") for k in range(first, last + 1)]


def _range_of(values: Sequence[Float64Array]) -> tuple[float, float]:
    """Return the range of some values with a little room; never empty."""
    low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
    room = 0.05 * (high - low) or 0.5 * abs(low) or 1.0
    return low - room, high + room
