"""Tone curves: the rational-quadratic spline and Reinhard's operator, values and gradients."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import differentiate, launch, upload
from benchmarks.stability.tone import reinhard_kernel
from tests import oracles as o
from warpir.kernels.tone import ratio_curve, tone_curve

VALUE_ABS = 1e-6
"""float32 values in [0, 1] after about ten operations."""
STEEP_ULPS = 8.0
"""Rounding of ``x`` and of the knots, 2^-24 each, is amplified by the slope of the curve."""
GRADIENT_RELATIVE_L2 = 1e-3
"""float32 adjoint against central differences of the float64 oracle."""


@wp.kernel
def curve_kernel(
    x: wp.array[float],
    curve: wp.array[int],
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    y: wp.array[float],
):
    i = wp.tid()
    y[i] = tone_curve(x[i], curve[i], knot_x, knot_y, knot_slope, bin_count)


@wp.kernel
def ratio_kernel(
    x: wp.array[float],
    knot_x: wp.array2d[float],
    knot_y: wp.array2d[float],
    knot_slope: wp.array2d[float],
    bin_count: int,
    y: wp.array[float],
):
    i = wp.tid()
    y[i] = ratio_curve(x[i], 0, knot_x, knot_y, knot_slope, bin_count)


def floats(values: np.typing.ArrayLike, device: str, grad: bool = False) -> wp.array:
    return upload(values, float, device, grad)


def apply_curve(
    x: np.ndarray, curve: np.ndarray, knots: tuple[np.ndarray, ...], device: str
) -> np.ndarray:
    index = wp.array(np.asarray(curve, np.int32), dtype=int, device=device)
    inputs = [floats(x, device), index, *(floats(k, device) for k in knots), knots[0].shape[1] - 1]
    return launch(curve_kernel, len(x), inputs, float, device=device)[0]


def float32_knots(raw: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return the oracle's knots of raw parameters [curve, 16], rounded as the kernel reads them."""
    x, y, slope = (k.astype(np.float32) for k in o.spline_knots(raw))
    return x, y, slope


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0])
def test_curve_matches_oracle(device: str, rng: np.random.Generator, scale: float) -> None:
    """Three curves of random parameters equal the spline of Durkan 2019, eq. 4."""
    knots = float32_knots(rng.normal(scale=scale, size=(3, 16)))
    x = rng.random(6000, dtype=np.float32)
    curve = rng.integers(0, 3, 6000)
    y = apply_curve(x, curve, knots, device)
    for c in range(3):
        expected, slope = o.spline(x[curve == c], *(k[c] for k in knots))
        tolerance = VALUE_ABS + STEEP_ULPS * slope * 2.0**-24
        assert np.all(np.abs(y[curve == c] - expected) <= tolerance)


def test_curve_ends_are_exact(device: str, rng: np.random.Generator) -> None:
    """``f(0) = 0`` and ``f(1) = 1`` exactly: a shadow ratio of 1 leaves the photo alone."""
    knots = float32_knots(rng.normal(scale=2.0, size=(50, 16)))
    curve = np.arange(50)
    assert np.all(apply_curve(np.zeros(50), curve, knots, device) == 0.0)
    assert np.all(apply_curve(np.ones(50), curve, knots, device) == 1.0)


def test_curve_is_monotone(device: str, rng: np.random.Generator) -> None:
    """Curves rise, across knots too, up to round-off (Durkan 2019, sec. 3.1)."""
    knots = float32_knots(rng.normal(scale=3.0, size=(20, 16)))
    for c in range(20):
        x = np.sort(
            np.concatenate([np.linspace(0, 1, 4001), np.nextafter(knots[0][c], 0), knots[0][c]])
        )
        y = apply_curve(x, np.full(len(x), c), knots, device)
        assert np.diff(y).min() >= -VALUE_ABS and y.min() >= 0.0 and y.max() <= 1.0


@pytest.mark.parametrize("bin_count", [1, 2, 5, 8, 20])
def test_curve_of_other_bin_counts(device: str, rng: np.random.Generator, bin_count: int) -> None:
    """The number of bins is an argument: 1, 2, 8 and 20 work as 5 does."""
    step = rng.uniform(0.2, 1.0, (2, bin_count))
    knot_x, knot_y = (np.append(0.0, np.cumsum(s) / s.sum()).astype(np.float32)[None] for s in step)
    slope = rng.uniform(0.2, 3.0, (1, bin_count + 1)).astype(np.float32)
    x = rng.random(2000, dtype=np.float32)
    y = apply_curve(x, np.zeros(2000), (knot_x, knot_y, slope), device)
    np.testing.assert_allclose(y, o.spline(x, knot_x[0], knot_y[0], slope[0])[0], atol=1e-5)


def curve_gradients(
    x: np.ndarray, curve: np.ndarray, knots: tuple[np.ndarray, ...], y: np.ndarray, device: str
) -> list[np.ndarray]:
    """Return gradients of ``sum(y * curve(x))`` by ``x`` and the three knot arrays."""
    arrays = [floats(a, device, True) for a in (x, *knots)]
    index = wp.array(np.asarray(curve, np.int32), dtype=int, device=device)
    inputs = [arrays[0], index, *arrays[1:], knots[0].shape[1] - 1]
    return differentiate(curve_kernel, inputs, y, float, device=device)[1]


def test_ratio_curve_goes_on_straight(device: str, rng: np.random.Generator) -> None:
    """Beyond 1 the last slope goes on, in value and gradient; below, it is the curve itself."""
    knots = float32_knots(rng.normal(scale=0.8, size=(1, 16)))
    below, beyond = np.array([0.0, 0.3, 0.9, 1.0]), np.array([1.0 + 1e-3, 1.5, 40.0])
    inputs = [floats(a, device, True) for a in (np.concatenate([below, beyond]), *knots)]
    (y,), (d_x, _, _, d_slope) = differentiate(
        ratio_kernel, [*inputs, 5], np.ones(len(inputs[0])), float, device=device
    )
    last = float(knots[2][0, -1])
    plain = apply_curve(below, np.zeros(4), knots, device)
    np.testing.assert_array_equal(y[:4], plain)
    np.testing.assert_allclose(y[4:], 1.0 + last * (beyond - 1.0), rtol=1e-6)
    np.testing.assert_allclose(d_x[4:], last, rtol=1e-6)
    at_one = curve_gradients(below, np.zeros(4), knots, np.ones(4), device)[3]
    d_last = d_slope[0, -1] - at_one[0, -1]
    assert d_last == pytest.approx((beyond - 1.0).sum(), rel=1e-5)


def test_reinhard(device: str) -> None:
    """``x / (1 + x)`` from 0 to suns, finite and at most 1 beyond, and its slope; none below 0."""
    x = np.array([-1.0, 0.0, 1e-8, 0.18, 1.0, 16.0, 1e4, 1e9, 1e15, 1e30, 3e38], np.float32)
    inputs = [floats(x, device, True)]
    (y,), (d_x,) = differentiate(reinhard_kernel, inputs, np.ones(len(x)), float, device=device)
    np.testing.assert_allclose(y[1:], o.reinhard(x[1:]), rtol=1e-6)
    slope = 1.0 / (1.0 + x[1:9].astype(np.float64)) ** 2
    np.testing.assert_allclose(d_x[:9], np.append(0.0, slope), rtol=1e-6)


@pytest.mark.parametrize("x", [[0, 0.5, 0.5, 1], [0, 0.5, 1, 1], [0, 0, 0.5, 1], [0, 0.3, 0.7, 1]])
@pytest.mark.parametrize("y", [[0, 0.5, 0.5, 1], [0, 0, 0.5, 1], [0, 0.5, 1, 1], [0, 0.3, 0.7, 1]])
def test_curve_of_empty_bins(device: str, x: list[float], y: list[float]) -> None:
    """Bins of no width or no height are finite and rise, at their knots too, and end at 1."""
    knots = tuple(np.array([k], np.float32) for k in (x, y, [1, 1, 1, 1]))
    at = np.sort(np.concatenate([np.linspace(0, 1, 101), x])).astype(np.float32)
    values = apply_curve(at, np.zeros(len(at)), knots, device)
    assert np.all(np.isfinite(values)) and np.diff(values).min() >= -VALUE_ABS
    assert values[-1] == 1.0 and values.min() >= 0.0
    gradients = curve_gradients(at, np.zeros(len(at)), knots, np.ones(len(at)), device)
    assert all(np.all(np.isfinite(g)) for g in gradients)
