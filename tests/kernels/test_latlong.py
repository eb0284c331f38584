"""Lat-long maps: kernels against the OpenEXR orientation and the float64 bilinear lookup."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import differentiate, launch, upload
from tests import oracles as o
from warpir.kernels.maths.latlong import (
    bilinear_tap,
    direction_to_uv,
    map_radiance,
    map_scalar,
    uv_to_direction,
)

DIRECTION_ABS = 1e-6
"""Sine and cosine of float32 angles up to pi: half an ulp of pi, 1.2e-7, a few times."""
UV_ABS = 5e-7
"""One ulp of 1, 1.2e-7, through an arc tangent, a product and a difference."""
WEIGHT_ULPS = 4
"""A weight is what is left of ``u * width``, whose ulp is ``width * 2^-24``."""
ADJOINT = 1e-6
"""float32 sums of a thousand terms of both signs, relative to the product's scale."""


@wp.kernel
def uv_kernel(d: wp.array[wp.vec3], uv: wp.array[wp.vec2]):
    i = wp.tid()
    uv[i] = direction_to_uv(d[i])


@wp.kernel
def direction_kernel(uv: wp.array[wp.vec2], d: wp.array[wp.vec3]):
    i = wp.tid()
    d[i] = uv_to_direction(uv[i][0], uv[i][1])


@wp.kernel
def lookup_kernel(
    uv: wp.array[wp.vec2],
    height: int,
    width: int,
    texels: wp.array2d[wp.vec3],
    scalar: wp.array2d[float],
    radiance: wp.array[wp.vec3],
    value: wp.array[float],
):
    i = wp.tid()
    tap = bilinear_tap(uv[i], height, width)
    radiance[i] = map_radiance(texels, tap)
    value[i] = map_scalar(scalar, tap)


def to_uv(d: np.ndarray, device: str) -> np.ndarray:
    return launch(uv_kernel, len(d), [upload(d, wp.vec3, device)], wp.vec2, device=device)[0]


def to_direction(uv: np.ndarray, device: str) -> np.ndarray:
    inputs = [upload(uv, wp.vec2, device)]
    return launch(direction_kernel, len(uv), inputs, wp.vec3, device=device)[0]


def wrapped(difference: np.ndarray) -> np.ndarray:
    """Return a difference of coordinates with ``u`` taken modulo one turn."""
    return np.stack([(difference[:, 0] + 0.5) % 1.0 - 0.5, difference[:, 1]], axis=-1)


def test_latlong_direction_matches_oracle(device: str, rng: np.random.Generator) -> None:
    """``uv_to_direction`` equals the float64 formula and is a unit vector."""
    uv = rng.random((20000, 2), dtype=np.float32)
    d = to_direction(uv, device)
    assert np.abs(d - o.latlong_direction(uv)).max() < DIRECTION_ABS
    assert np.abs(np.linalg.norm(d, axis=-1) - 1.0).max() < DIRECTION_ABS


def test_latlong_uv_matches_oracle(device: str, rng: np.random.Generator) -> None:
    """``direction_to_uv`` equals the float64 formula, near the poles too, and stays in range."""
    d = o.normalize(
        rng.normal(size=(20000, 3)) * np.repeat([[1, 1, 1], [1, 100, 1]], 10000, axis=0)
    )
    d = d.astype(np.float32)
    uv = to_uv(d, device)
    assert np.abs(wrapped(uv - o.latlong_uv(d))).max() < UV_ABS
    assert uv[:, 0].min() >= 0.0 and uv[:, 0].max() < 1.0
    assert uv[:, 1].min() >= 0.0 and uv[:, 1].max() <= 1.0


def test_latlong_uv_at_the_seam_and_the_poles(device: str) -> None:
    """Signed zeros at -Z and the poles themselves give finite coordinates with ``u`` in [0, 1)."""
    d = np.array(
        [
            [0.0, 0, -1],
            [-0.0, 0, -1],
            [-1e-30, 0, -1],
            [1e-30, 0, -1],
            [0, 1, 0],
            [0, -1, 0],
            [-0.0, 1, -0.0],
            [-1e-8, 0, -1],
            [-3e-7, 0, -1],
        ]
    )
    uv = to_uv(d, device)
    assert np.all(np.isfinite(uv)) and np.all((uv[:, 0] >= 0.0) & (uv[:, 0] < 1.0))
    assert uv[4:7, 1] == pytest.approx([0.0, 1.0, 0.0], abs=UV_ABS)


MAP_SIZES = [(1, 1), (1, 2), (2, 1), (3, 2), (16, 32), (128, 256)]


def edge_uv(rng: np.random.Generator) -> np.ndarray:
    """Return random coordinates and all the awkward ones."""
    edge = np.array([0.0, 1e-9, 0.25, 0.5, 1.0 - 2.0**-24, 1.0])
    corners = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    return np.concatenate([corners, rng.random((2000, 2))]).astype(np.float32)


@pytest.mark.parametrize("height, width", MAP_SIZES)
def test_lookup_matches_oracle(
    device: str, rng: np.random.Generator, height: int, width: int
) -> None:
    """Bilinear, texel centres at +0.5, wrapped in longitude, clamped in latitude."""
    texels = rng.random((height, width, 3), dtype=np.float32)
    uv = edge_uv(rng)
    maps = upload(texels, wp.vec3, device), upload(texels[..., 1], float, device)
    inputs = [upload(uv, wp.vec2, device), height, width, *maps]
    radiance, value = launch(lookup_kernel, len(uv), inputs, wp.vec3, float, device=device)
    expected = o.bilinear_lookup(texels, uv)
    tolerance = ADJOINT + WEIGHT_ULPS * max(height, width) * 2.0**-24
    assert radiance == pytest.approx(expected, abs=tolerance)
    assert value == pytest.approx(expected[:, 1], abs=tolerance)


@pytest.mark.parametrize("height, width", MAP_SIZES)
def test_lookup_adjoint_has_the_same_weights(
    device: str, rng: np.random.Generator, height: int, width: int
) -> None:
    """``<A texels, y> = <texels, A^T y>``, and ``A^T y`` scatters the oracle's four weights."""
    texels = rng.random((height, width, 3), dtype=np.float32)
    uv = edge_uv(rng)
    y = rng.normal(size=(len(uv), 3)).astype(np.float32)
    maps = upload(texels, wp.vec3, device, True), upload(np.zeros((height, width)), float, device)
    inputs = [upload(uv, wp.vec2, device), height, width, *maps]
    (radiance, _), (adjoint,) = differentiate(
        lookup_kernel, inputs, y, wp.vec3, float, device=device
    )
    rows, columns, weights = o.bilinear_weights(uv, height, width)
    expected = np.zeros((height, width, 3))
    np.add.at(expected, (rows, columns), weights[..., None] * y[:, None, :])
    # Each point may miss its weights by the rounding of ``u * width``.
    touched = np.zeros((height, width, 3))
    np.add.at(touched, (rows, columns), np.abs(y)[:, None, :] * np.ones((1, 4, 1)))
    bound = touched * (ADJOINT + WEIGHT_ULPS * max(height, width) * 2.0**-24)
    assert np.all(np.abs(adjoint - expected) <= bound)
    scale = float(np.abs(y).sum())
    forward = np.sum(radiance * y)
    assert forward == pytest.approx(np.sum(adjoint * texels), abs=ADJOINT * scale)
