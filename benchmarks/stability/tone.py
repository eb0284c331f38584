"""Shadow ratio, tone, encoding and fusion at the ends of their ranges."""

from functools import partial
from itertools import pairwise

import numpy as np
import torch
import warp as wp

from benchmarks.stability.case import (
    Float64Array,
    Measured,
    differentiate,
    finite,
    max_relative,
    upload,
    worst_l2,
)
from tests import oracles as o
from tests.statistics import central_differences
from warpir.kernels.composite import compose
from warpir.kernels.shadow_ratio import shadow_ratio
from warpir.kernels.tone import reinhard, tone_curve
from warpir.lighting.fusion import fuse
from warpir.render.tone_curve import ToneCurve


@wp.kernel
def curve_kernel(
    x: wp.array[float],
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    y: wp.array[float],
):
    """One tone curve."""
    i = wp.tid()
    y[i] = tone_curve(x[i], 0, knot_x, knot_y, knot_slope, bin_count)


@wp.kernel
def reinhard_kernel(x: wp.array[float], y: wp.array[float]):
    """Reinhard's operator."""
    i = wp.tid()
    y[i] = reinhard(x[i])


def ratio(device: str, level: float) -> Measured:
    """``lit / unoccluded`` and its gradient at one level of light; 1 where there is none."""
    share = np.linspace(0.0, 1.0, 33)
    unoccluded = np.full((33, 3), level, np.float32)
    lit = (unoccluded * share[:, None]).astype(np.float32)
    arrays = [upload(a, wp.vec3, device, True) for a in (lit, unoccluded)]
    even = np.ones((33, 3))
    (out,), gradients = differentiate(shadow_ratio, arrays, even, wp.vec3, device=device)
    a, b = lit.astype(np.float64), unoccluded.astype(np.float64)
    # Below 1e-30 the plane counts as dark.
    if level < 1e-30:
        truth, slopes = np.ones_like(a), [np.zeros_like(a), np.zeros_like(a)]
    else:
        truth = a / b
        h = 1e-4 * b
        by_lit, by_unoccluded = (a + h) / b - (a - h) / b, a / (b + h) - a / (b - h)
        slopes = [by_lit / (2.0 * h), by_unoccluded / (2.0 * h)]
    gradient_error = worst_l2([g * level for g in gradients], [s * level for s in slopes])
    return Measured(float(np.abs(out - truth).max()), finite(out, *gradients), gradient_error)


def run_curve(
    device: str, x: np.ndarray, knots: tuple[np.ndarray, ...], y: np.ndarray
) -> tuple[Float64Array, list[Float64Array]]:
    """Return values of a curve and gradients by ``x`` and the knots' x, y and slopes."""
    arrays = [upload(x, float, device, True)]
    arrays += [upload(k[None], float, device, True) for k in knots]
    inputs = [*arrays, len(knots[0]) - 1]
    (out,), gradients = differentiate(curve_kernel, inputs, y, float, device=device)
    return out, gradients


COLLAPSED = {
    "identity": np.zeros(16),
    "widths at their least": np.array([12.0, *[-12] * 4, *[0] * 11]),
    "heights at their least": np.array([*[0.0] * 5, -12, -12, 12, -12, -12, *[0] * 6]),
    "slopes at their least": np.concatenate([np.zeros(10), np.full(6, -12.0)]),
    "slopes of 30": np.concatenate([np.zeros(10), np.full(6, 30.0)]),
}
"""Raw parameters; 12 is where softmax and softplus have reached their floors to 1e-5."""


def curve(device: str, raw: np.ndarray) -> Measured:
    """A curve within its ends: values over one plus the slope, and gradients."""
    knots = tuple(k.astype(np.float32) for k in o.spline_knots(raw))
    wide = [k.astype(np.float64) for k in knots]
    inside = np.concatenate([np.linspace(a, b, 41)[1:-1] for a, b in pairwise(wide[0])])
    x = np.concatenate([inside, wide[0]]).astype(np.float32)
    y = np.concatenate([np.ones(len(inside)), np.zeros(len(wide[0]))])
    values, gradients = run_curve(device, x, knots, y)
    truth, slope = o.spline(x, *wide)
    error = float(np.max(np.abs(values - truth) / (1.0 + slope)))
    x64 = x[: len(inside)].astype(np.float64)

    def loss(k: int, value: Float64Array) -> float:
        moved = [value if i == k else w for i, w in enumerate(wide)]
        return float(np.sum(o.spline(x64, *moved)[0]))

    slopes = [slope[: len(inside)]]
    slopes += [central_differences(partial(loss, k), wide[k], 1e-8) for k in range(3)]
    found = [gradients[0][: len(inside)], *(g[0] for g in gradients[1:])]
    # The outermost knots are the ends of the interval, never free.
    found[1], slopes[1] = found[1][1:-1], slopes[1][1:-1]
    return Measured(error, finite(values, *gradients), worst_l2(found, slopes))


def beyond(device: str) -> Measured:
    """At the ends and beyond: exactly 0 and 1, and no gradient from outside."""
    x = np.array([-3e38, -1.0, -1e-30, 0.0, 1.0, 1.0 + 2.0**-23, 5.0, 3e38])
    truth = np.array([0.0, 0, 0, 0, 1, 1, 1, 1])
    worst, values = 0.0, []
    for raw in COLLAPSED.values():
        knots = tuple(k.astype(np.float32) for k in o.spline_knots(raw))
        found, gradients = run_curve(device, x, knots, np.ones(8))
        outside = np.delete(gradients[0], [3, 4])
        worst = max(worst, float(np.abs(found - truth).max()), float(np.abs(outside).max()))
        values += [found, *gradients]
    return Measured(worst, finite(*values))


def empty_bins(device: str) -> Measured:
    """Bins of no width or no height at all, at their knots too: finite, monotone, in [0, 1]."""
    worst, values = 0.0, []
    plain = [0.0, 0.3, 0.7, 1.0]
    empty = [0.0, 0.5, 0.5, 1.0], [0.0, 0.5, 1.0, 1.0], [0.0, 0.0, 0.5, 1.0]
    for knot_x, knot_y in (*((k, plain) for k in empty), *((plain, k) for k in empty)):
        knots = tuple(np.array(k, np.float32) for k in (knot_x, knot_y, np.ones(4)))
        x = np.sort(np.concatenate([np.linspace(0, 1, 101), knots[0]])).astype(np.float32)
        found, gradients = run_curve(device, x, knots, np.ones(len(x)))
        values += [found, *gradients]
        worst = max(worst, float(-np.diff(found).min()), float(-found.min()), found.max() - 1.0)
    return Measured(max(worst, 0.0), finite(*values))


def raw_curve(device: str) -> Measured:
    """Raw parameters of 1e3 and 1e30: knots that rise by the least bin, finite gradients."""
    worst, values = 0.0, []
    for size in (0.0, 30.0, 1e3, 1e30):
        model = ToneCurve(3)
        with torch.no_grad():
            for k, parameter in enumerate(model.parameters()):
                sign = torch.where(torch.arange(parameter.numel()) % 2 == k % 2, size, -size)
                parameter.copy_(sign.reshape(parameter.shape))
        knots = model.forward()
        (knots.x.sum() + knots.y.sum() + knots.slope.sum()).backward()
        for edges in (knots.x, knots.y):
            step = edges.detach().numpy().astype(np.float64)
            worst = max(worst, 1e-3 - float(np.diff(step, axis=1).min()))
        if size <= 1e3:
            raw = np.concatenate([p.detach().numpy() for p in model.parameters()], axis=1)
            truth = o.spline_knots(raw)
            for found, expected in zip((knots.x, knots.y, knots.slope), truth, strict=True):
                worst = max(worst, max_relative(found.detach().numpy(), expected, 1.0))
        values += [np.asarray(k.detach()) for k in (knots.x, knots.y, knots.slope)]
        values += [np.asarray(p.grad) for p in model.parameters()]
    return Measured(worst, finite(*values))


def bright(device: str) -> Measured:
    """Reinhard's operator from black to 1e30, and its gradient."""
    x = np.concatenate([[0.0], np.geomspace(1e-30, 1e30, 241)]).astype(np.float32)
    inputs = [upload(x, float, device, True)]
    even = np.ones(len(x))
    (out,), (gradient,) = differentiate(reinhard_kernel, inputs, even, float, device=device)
    x64 = x.astype(np.float64)
    # Beyond 1e19 the slope, 1 / x^2, leaves float32's normal numbers, and CUDA makes it 0: what
    # is below 1e-32 is compared absolutely, to 1e-37.
    slope = 1.0 / (1.0 + x64) ** 2
    error, gradient_error = max_relative(out, o.reinhard(x64)), max_relative(gradient, slope, 1e-32)
    return Measured(error, finite(out, gradient), gradient_error)


def encoding(device: str) -> Measured:
    """Display encoding from 0 to beyond 1, and its gradient above the linear toe."""
    x = np.concatenate([[0.0], np.geomspace(1e-30, 1.0, 400)[:-1], [1.5, 1e30]]).astype(np.float32)
    count = len(x)
    display = upload(np.repeat(x[:, None], 3, axis=1), wp.vec3, device, True)
    row = wp.array(np.arange(count, dtype=np.int32), dtype=int, device=device)
    none = wp.array(np.full(count, -1, np.int32), dtype=int, device=device)
    blank = upload(np.zeros((count, 3)), wp.vec3, device)
    mask = upload(np.ones(count), float, device)
    inputs = [blank, row, none, mask, display, blank]
    even = np.ones((count, 3))
    (out,), (by_display,) = differentiate(compose, inputs, even, wp.vec3, device=device)
    gradient = by_display[:, 0]
    x64 = x.astype(np.float64)
    power = (x64 > 1.1e-6) & (x64 < 1.0)
    h = 1e-4 * x64[power]
    slope = (o.encode(x64[power] + h) - o.encode(x64[power] - h)) / (2.0 * h)
    error = float(np.abs(out[:, 0] - np.minimum(o.encode(x64), 1.0)).max())
    return Measured(error, finite(out, gradient), max_relative(gradient[power], slope))


def fusion(device: str, fg_level: float, shadow_level: float, black: str) -> Measured:
    """Both primed maps in float32, and the gradient in float64."""
    rng = np.random.default_rng(19)
    fg = fg_level * rng.uniform(0.2, 1.0, (4, 6, 3))
    shadow = shadow_level * rng.uniform(0.2, 1.0, (4, 6, 3))
    if black in ("fg", "both"):
        fg[1, 2] = 0.0
    if black in ("shadow", "both"):
        shadow[1, 2] = 0.0
        shadow[2, 3] = 0.0
    y = rng.uniform(0.5, 1.5, (2, 4, 6, 3))
    dark = fg.max() == 0.0
    peak = max(float(fg.max()), float(shadow.max()), 1e-300)

    def primed(a: Float64Array, b: Float64Array) -> tuple[Float64Array, Float64Array]:
        if dark:
            # By definition: without a foreground there is nothing to fuse.
            return a, 0.5 * a + 0.5 * b
        return o.fuse(a, b, 0.5)

    def loss(a: Float64Array, b: Float64Array) -> float:
        return float(sum(np.sum(w * x) for w, x in zip(y, primed(a, b), strict=True)))

    single = fuse(torch.tensor(fg).float(), torch.tensor(shadow).float(), 0.5)
    error = max(
        float(np.abs(f.numpy().astype(np.float64) - t).max() / peak)
        for f, t in zip(single, primed(fg, shadow), strict=True)
    )
    tensors = [torch.tensor(a, requires_grad=True) for a in (fg, shadow)]
    out = fuse(tensors[0], tensors[1], 0.5)
    (torch.tensor(y) * torch.stack(out)).sum().backward()
    gradients = [np.asarray(t.grad) for t in tensors]
    # The steps follow the scales of the equation: the foreground's own, and the larger one.
    step = 1e-5 * (fg_level or 1.0), 1e-6 * (max(fg_level, shadow_level) or 1.0)
    slopes = [
        central_differences(lambda a: loss(a, shadow), fg, step[0]),
        central_differences(lambda b: loss(fg, b), shadow, step[1]),
    ]
    return Measured(error, finite(*single, *gradients), worst_l2(gradients, slopes))
