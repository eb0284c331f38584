"""At equal error, how many times longer does one renderer take than another? Pure arithmetic.

A renderer's sweep over sample counts gives, for foreground and shadow ratio apart, a curve of time
over error. A renderer may spend its samples on the two as it likes: `best_split` finds the split
that reaches a combined error ``sqrt((e_fg^2 + e_ratio^2) / 2)`` in the least time. Between measured
points curves are straight in log-log. Beyond the longest run a time is only bounded from below
(``at_least``), by an error that falls like 1 / time; samples of both renderers fall more slowly.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warpir.core.arrays import BoolArray, Float64Array

ROUNDING = 1e-9
SMALLEST = 1e-9
"""An error of 0 is one that the references cannot tell from 0."""
SPLITS = 721
"""How many ways to share the error between foreground and shadow ratio are tried."""
STEPS = 600
"""Optimisation steps of a run."""


@dataclass(frozen=True)
class Time:
    """A time and whether the true one may be longer."""

    seconds: float
    at_least: bool = False


class Curve:
    """Times [s] over errors, relative RMSE [1], of one renderer and one quantity.

    Points that are beaten in both by another are dropped, so that error falls as time grows.

    Raises:
        ValueError: No point has a finite error above 0.
    """

    def __init__(self, seconds: ArrayLike, errors: ArrayLike) -> None:
        s, e = np.asarray(seconds, np.float64), np.asarray(errors, np.float64)
        usable = np.isfinite(e) & (e > 0.0)
        order = np.argsort(s[usable], kind="stable")
        s, e = s[usable][order], e[usable][order]
        best = np.minimum.accumulate(e)
        keep = np.concatenate([[True], e[1:] < best[:-1]]) if len(e) else np.zeros(0, bool)
        self.seconds, self.errors = s[keep], e[keep]
        if len(self.seconds) == 0:
            raise ValueError("a curve needs a point with an error above 0")

    def at(self, error: ArrayLike) -> tuple[Float64Array, BoolArray]:
        """Return the least time that reaches each error, and where it is a lower bound.

        The first point is the least that can be run: larger errors cost its time.
        """
        wanted = np.asarray(error, np.float64)
        x = np.log(np.maximum(wanted, SMALLEST))
        seconds = np.exp(np.interp(-x, -np.log(self.errors), np.log(self.seconds)))
        is_bound = wanted < self.errors[-1]
        beyond = np.where(is_bound, self.errors[-1] / np.exp(x), 1.0)
        return seconds * beyond, is_bound


def best_split(foreground: Curve, ratio: Curve, error: float) -> Time:
    """Return the least time for a combined error, samples split freely between the two parts."""
    reach = np.sqrt(2.0) * error
    # Evenly spaced, and where either part stands on a measured point
    angle = np.linspace(0.0, 0.5 * np.pi, SPLITS)[1:-1]
    on_foreground = np.arccos(np.minimum(foreground.errors / reach, 1.0))
    on_ratio = np.arcsin(np.minimum(ratio.errors / reach, 1.0))
    angle = np.concatenate([angle, on_foreground, on_ratio])
    first, first_bound = foreground.at(reach * np.cos(angle) * (1.0 + ROUNDING))
    second, second_bound = ratio.at(reach * np.sin(angle) * (1.0 + ROUNDING))
    total, bound = first + second, first_bound | second_bound
    k = int(np.argmin(total))
    return Time(float(total[k]), bool(bound[k]))


def curves(rows: Sequence[dict[str, Any]], seconds: str, rmse: str) -> tuple[Curve, Curve]:
    """Return foreground's and ratio's curve of one renderer's sweep, by the names of its fields."""

    def curve(name: str) -> Curve:
        parts = [row["parts"][name] for row in rows]
        return Curve([p[seconds] for p in parts], [p[rmse] for p in parts])

    return curve("foreground"), curve("ratio")


def transport_ratio(row: dict[str, Any], theirs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compare one transport row with another renderer's sweep on the same scene.

    The other's time is the smaller of the two at which it reaches transport's error of the image
    and of the gradient, so transport has an equal or lower error of both.

    Returns:
        ``step``, ``run_600``, whether they are lower bounds, and the numbers they are made of.
    """
    by_image = best_split(*curves(theirs, "seconds_step", "rmse_image"), row["rmse_image"])
    by_gradient = best_split(*curves(theirs, "seconds_step", "rmse_gradient"), row["rmse_gradient"])
    other = min(by_image, by_gradient, key=lambda t: t.seconds)
    step, traced = row["seconds_step"], row["seconds_traced"]
    gain = other.seconds - step
    return {
        "step": other.seconds / step,
        "run_600": STEPS * other.seconds / (traced + STEPS * step),
        "at_least": other.at_least,
        "seconds_step": step,
        "seconds_traced": traced,
        "mitsuba_seconds_step_by_image": by_image.seconds,
        "mitsuba_at_least_by_image": by_image.at_least,
        "mitsuba_seconds_step_by_gradient": by_gradient.seconds,
        "mitsuba_at_least_by_gradient": by_gradient.at_least,
        "break_even_steps": traced / gain if gain > 0.0 else None,
    }


def mis_ratio(
    ours: Sequence[dict[str, Any]], theirs: Sequence[dict[str, Any]]
) -> dict[str, dict[str, float]]:
    """Compare two sweeps at the smallest error both reach: forward by image, step by both."""
    found = {}
    for name, seconds, rmse in (
        ("forward_image", "seconds_forward", "rmse_forward"),
        ("step_image", "seconds_step", "rmse_image"),
        ("step_gradient", "seconds_step", "rmse_gradient"),
    ):
        own, other = curves(ours, seconds, rmse), curves(theirs, seconds, rmse)
        # The smallest that both sweeps reach
        error = max(combined(fg.errors[-1], ratio.errors[-1]) for fg, ratio in (own, other))
        t_own, t_other = best_split(*own, error), best_split(*other, error)
        found[name] = {
            "ratio": t_other.seconds / t_own.seconds,
            "rmse": error,
        }
    return found


def ratios(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one record per scene: ``mis``, and one entry of ``transport`` per setting."""
    records = []
    for scene in dict.fromkeys(r["scene"] for r in rows):
        mis, theirs, traced = (
            [r for r in rows if (r["scene"], r["integrator"]) == (scene, name)]
            for name in ("mis", "mitsuba", "transport")
        )
        transport = [
            {"settings": row["settings"], **transport_ratio(row, theirs)} for row in traced
        ]
        records.append({"scene": scene, "mis": mis_ratio(mis, theirs), "transport": transport})
    return records


def combined(foreground: float, ratio: float) -> float:
    """Return the error of a whole picture from its two parts'."""
    return float(np.sqrt(0.5 * (foreground**2 + ratio**2)))


def rmse(values: Float64Array, references: Float64Array, weights: Float64Array) -> float:
    """Return the relative RMSE of ``values`` against a truth known several times.

    A product of differences to two references with independent noise, ``(x - a)(x - b)``, is the
    squared error of x free of their noise; all pairs are averaged, and ``a b`` is the truth's own
    square likewise. ``references`` are unbiased, shape [reference, ...], and trusted by weights,
    shape [reference].
    """

    def square(x: Float64Array | float) -> float:
        pairs = weights.sum() ** 2 - np.square(weights).sum()
        total = alone = 0.0
        for reference, weight in zip(references, weights, strict=True):
            total = total + weight * (x - reference)
            alone = alone + np.square(weight * (x - reference))
        return float((np.square(total) - alone).mean() / pairs)

    return float(np.sqrt(max(square(values), 0.0) / square(0.0)))
