"""Plots of the report, as SVG without scripts and without styles of their own.

Colours come from the page's style sheet by class, so that a plot is dark on light and light on dark
as the page is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np

from warpir.core.arrays import Float64Array

WIDTH, HEIGHT = 360, 250
LEFT, RIGHT, TOP, BOTTOM = 58, 14, 14, 44
"""Room for the axes [px]."""
POINTS_MAX = 400
"""Of a line: more cannot be told apart."""


@dataclass(frozen=True)
class Series:
    """One line, or single points where values are missing between them."""

    name: str
    x: Float64Array
    y: Float64Array
    style: str = "s0"
    """Class of the style sheet."""


def line_plot(
    series: Sequence[Series],
    title: str,
    labels: tuple[str, str],
    *,
    x_range: tuple[float, float] | None = None,
    y_range: tuple[float, float] | None = None,
    marks: Mapping[str, float] | None = None,
) -> str:
    """Return a plot with axes, ticks and labels.

    Args:
        series: At least one, each with at least one point.
        title: Says what is plotted, for those who cannot see it.
        labels: Of the axes.
        x_range: Of the axis; that of the values when absent.
        y_range: Likewise.
        marks: Vertical lines, by what they stand for.
    """
    x_low, x_high = x_range or _range_of([s.x for s in series])
    y_low, y_high = y_range or _range_of([s.y for s in series])
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM

    def at_x(x: float) -> float:
        return LEFT + (x - x_low) / (x_high - x_low) * (right - LEFT)

    def at_y(y: float) -> float:
        return bottom - (y - y_low) / (y_high - y_low) * (bottom - TOP)

    parts = [
        f'<svg class="plot" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">'
    ]
    for tick in ticks(x_low, x_high, 5):
        x = at_x(tick)
        parts.append(f'<path class="grid" d="M{x:.1f} {TOP}V{bottom}"/>')
        parts.append(f'<text x="{x:.1f}" y="{bottom + 16}" text-anchor="middle">{tick:.6g}</text>')
    for tick in ticks(y_low, y_high, 5):
        y = at_y(tick)
        parts.append(f'<path class="grid" d="M{LEFT} {y:.1f}H{right}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{tick:.6g}</text>')
    parts.append(f'<path class="axis" d="M{LEFT} {TOP}V{bottom}H{right}"/>')
    for name, value in (marks or {}).items():
        x = at_x(value)
        anchor, shift = ("end", -4) if x > (LEFT + right) / 2 else ("start", 4)
        parts.append(f'<path class="mark" d="M{x:.1f} {TOP}V{bottom}"/>')
        parts.append(
            f'<text class="mark" x="{x + shift:.1f}" y="{TOP + 10}" text-anchor="{anchor}">'
            f"{escape(name)}</text>"
        )
    for s in series:
        every = max(1, len(s.x) // POINTS_MAX)
        chosen = sorted({*range(0, len(s.x), every), len(s.x) - 1})
        points = [f"{at_x(s.x[k]):.1f} {at_y(s.y[k]):.1f}" for k in chosen]
        parts.append(f'<path class="line {s.style}" d="M{" L".join(points)}"/>')
        if len(points) <= 12:  # few enough to be measured one by one
            dots = (p.split() for p in points)
            parts += [f'<circle class="dot {s.style}" cx="{x}" cy="{y}" r="2.5"/>' for x, y in dots]
    middle = (LEFT + right) / 2
    parts.append(
        f'<text class="label" x="{middle}" y="{HEIGHT - 8}" text-anchor="middle">'
        f"{escape(labels[0])}</text>"
    )
    parts.append(
        f'<text class="label" transform="translate(13 {(TOP + bottom) / 2}) rotate(-90)" '
        f'text-anchor="middle">{escape(labels[1])}</text></svg>'
    )
    return "".join(parts)


def bar(share: float) -> str:
    """Return a horizontal bar of a share of the full width [1]."""
    width = f"{100.0 * min(max(share, 0.0), 1.0):.2f}"
    return (
        '<svg class="bar" viewBox="0 0 100 8" preserveAspectRatio="none" aria-hidden="true">'
        f'<rect class="trough" width="100" height="8"/><rect width="{width}" height="8"/></svg>'
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
