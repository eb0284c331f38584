"""Owen-scrambled Sobol' pairs: stratified along a pixel, uniform and independent across seeds."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from benchmarks.stability.case import launch
from tests.statistics import SIGNIFICANCE, chi_square_counts, sidak
from warpir.kernels.maths.rng import pixel_seed, sobol_pair, sobol_point, sobol_shuffled

SEED_COUNT = 1 << 15
"""Independent scrambles of a uniformity test; 128 expected in each of 16 x 16 cells."""
SHUFFLE_INFLATION = 2.0
"""Nested shuffling flips the leading digits of neighbours in step, so the correlation of two pairs
has up to twice the variance, 2 / N, that independent points have; it is still of order 1 / N."""

wp.set_module_options({"enable_backward": False})


@wp.kernel
def sobol_kernel(
    index: wp.array[int],
    seed: wp.array[int],
    pixel: wp.array[int],
    pair: wp.array[int],
    u: wp.array[wp.vec2],
):
    i = wp.tid()
    u[i] = sobol_pair(index[i], pixel_seed(seed[i], pixel[i]), pair[i])


@wp.kernel
def run_kernel(index: wp.array[int], count: int, pair: int, u: wp.array2d[wp.vec2]):
    i, c = wp.tid()
    key = pixel_seed(1, 7)
    run = sobol_shuffled(index[i], key, pair) * wp.uint32(count)
    u[i, c] = sobol_point(run + wp.uint32(c), key, pair)


def draw(
    device: str,
    index: np.typing.ArrayLike,
    seed: np.typing.ArrayLike = 1,
    pixel: np.typing.ArrayLike = 7,
    pair: np.typing.ArrayLike = 0,
) -> np.ndarray:
    """Return points of the broadcast arguments, shape [..., 2]."""
    index, seed, pixel, pair = np.broadcast_arrays(index, seed, pixel, pair)
    arrays = [
        wp.array(np.ascontiguousarray(a, np.int32).ravel(), dtype=int, device=device)
        for a in (index, seed, pixel, pair)
    ]
    (u,) = launch(sobol_kernel, index.size, arrays, wp.vec2, device=device)
    return u.reshape(*index.shape, 2)


def assert_is_net(u: np.ndarray, k: int) -> None:
    """Check that each elementary interval of area 2^-k holds exactly one of the 2^k points."""
    for a in range(k + 1):
        cell = (u[:, 0] * 2**a).astype(int) * 2 ** (k - a) + (u[:, 1] * 2 ** (k - a)).astype(int)
        assert np.array_equal(np.sort(cell), np.arange(2**k)), f"2^-{a} x 2^-{k - a}"


def test_sobol_range_and_determinism(device: str) -> None:
    """Numbers lie in [0, 1) and depend on the arguments alone."""
    u = draw(device, np.arange(1 << 17), seed=3, pair=5)
    assert u.min() >= 0.0 and u.max() < 1.0
    backwards = draw(device, np.arange(1 << 17)[::-1], seed=3, pair=5)[::-1]
    assert np.array_equal(u, backwards)


@pytest.mark.parametrize("k", [0, 1, 2, 3, 4, 5, 8, 12])
@pytest.mark.parametrize("pair", [0, 1, 2, 7, 40])
def test_sobol_first_points_are_a_net(device: str, k: int, pair: int) -> None:
    """The first 2^k points of each pair are a (0, k, 2)-net (Burley 2020; Sobol' 1967)."""
    for seed in (0, 1, 123456789, -1):
        assert_is_net(draw(device, np.arange(2**k), seed=seed, pair=pair), k)


def test_sobol_aligned_runs_are_nets(device: str) -> None:
    """So is any aligned run of 2^k indices, beyond the first 2^16 too."""
    for first in (64, 5 * 64, 65536 - 64, 65536, 65536 * 3 + 128):
        assert_is_net(draw(device, first + np.arange(64), pair=3), 6)


@pytest.mark.parametrize("count", [1, 2, 8])
def test_sobol_runs_of_points_are_nets(device: str, count: int) -> None:
    """So are the points of an aligned run of indices that take several points each."""
    for first in (0, 5 * 64, 65536 - 64, 65536 * 3 + 128):
        index = wp.array(np.arange(first, first + 64, dtype=np.int32), dtype=int, device=device)
        u = wp.zeros((64, count), dtype=wp.vec2, device=device)
        wp.launch(run_kernel, u.shape, inputs=[index, count, 3], outputs=[u], device=device)
        points = u.numpy().astype(np.float64)
        for one in points:
            assert_is_net(one, count.bit_length() - 1)
        assert_is_net(points.reshape(-1, 2), 6 + count.bit_length() - 1)


def test_sobol_wrap_does_not_repeat(device: str) -> None:
    """Past 2^16 samples the pattern comes back under another scramble."""
    first, second = draw(device, np.arange(4096)), draw(device, 65536 + np.arange(4096))
    assert np.mean(np.all(first == second, axis=-1)) < 0.01


@pytest.mark.parametrize("index", [0, 1, 2, 5, 63, 4095, 65535])
def test_sobol_is_uniform_over_seeds(device: str, index: int) -> None:
    """Each single point is uniform on the square over scrambles (Owen 1995): unbiased estimates."""
    u = draw(device, index, seed=np.arange(SEED_COUNT))
    count, _, _ = np.histogram2d(u[:, 0], u[:, 1], bins=16, range=((0, 1), (0, 1)))
    verdict = chi_square_counts(count, np.full((16, 16), SEED_COUNT / 256), case_count=7)
    assert verdict.passed, verdict


@pytest.mark.parametrize("axis", ["seed", "pixel"])
@pytest.mark.parametrize("index", [0, 1, 9])
@pytest.mark.parametrize("pairs", [(0, 1), (1, 2), (0, 3), (2, 9)])
def test_sobol_pairs_are_independent_over_seeds(
    device: str, axis: str, index: int, pairs: tuple[int, int]
) -> None:
    """Any two coordinates of two pairs are jointly uniform over seeds and over pixels."""
    keys = {axis: np.arange(SEED_COUNT)}
    a, b = (draw(device, index, pair=pair, **keys) for pair in pairs)
    for i in range(2):
        for j in range(2):
            count, _, _ = np.histogram2d(a[:, i], b[:, j], bins=16, range=((0, 1), (0, 1)))
            expected = np.full((16, 16), SEED_COUNT / 256)
            verdict = chi_square_counts(count, expected, case_count=2 * 3 * 4 * 4)
            assert verdict.passed, (i, j, verdict)


def test_sobol_neighbours_are_independent(device: str) -> None:
    """The same point of adjacent pixels, and of successive seeds, is jointly uniform."""
    pixel = draw(device, 0, pixel=np.arange(SEED_COUNT + 1))
    row = draw(device, 0, pixel=np.arange(SEED_COUNT + 384))
    seed = draw(device, 0, seed=np.arange(SEED_COUNT + 1))
    cases = [(pixel[:-1], pixel[1:]), (row[:SEED_COUNT], row[384:]), (seed[:-1], seed[1:])]
    for a, b in cases:
        for i in range(2):
            count, _, _ = np.histogram2d(a[:, i], b[:, i], bins=16, range=((0, 1), (0, 1)))
            expected = np.full((16, 16), SEED_COUNT / 256)
            verdict = chi_square_counts(count, expected, case_count=6)
            assert verdict.passed, verdict


def test_sobol_pairs_are_uncorrelated_along_a_pixel(device: str) -> None:
    """Within one sequence two pairs correlate no more than chance: they are shuffled apart."""
    point_count, seed_count = 1024, 256
    index, seed = np.arange(point_count)[None, :], np.arange(seed_count)[:, None]
    a, b = draw(device, index, seed=seed, pair=0), draw(device, index, seed=seed, pair=1)
    z = (
        12
        * np.sqrt(point_count)
        * np.mean((a[..., :, None] - 0.5) * (b[..., None, :] - 0.5), axis=1)
    )
    limit = stats.norm.isf(sidak(SIGNIFICANCE, z.size) / 2) * np.sqrt(SHUFFLE_INFLATION)
    assert np.abs(z).max() < limit
    assert np.mean(z**2) < SHUFFLE_INFLATION
    # Over scrambles the correlation has no bias: 256 * 4 values of a variance of at most 2.
    assert abs(np.mean(z)) < 4 * np.sqrt(SHUFFLE_INFLATION / z.size)


def test_sobol_integrates_better_than_random_numbers(device: str) -> None:
    """Over 256 points the error of a smooth integral is far below random 1 / sqrt(N)."""
    u = draw(device, np.arange(256)[None, :], seed=np.arange(200)[:, None])
    value = np.mean(np.sin(np.pi * u[..., 0]) * u[..., 1] ** 2, axis=1) * (1.5 * np.pi)
    random_rms = 1.0 / np.sqrt(256)
    assert np.mean(value) == pytest.approx(1.0, abs=1e-3)
    assert np.std(value) < 0.1 * random_rms
