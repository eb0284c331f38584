"""Spherical Gaussians."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import launch, upload
from tests import oracles as o
from warpir.kernels.maths.sg import sg_shape

VALUE_RTOL = 1e-4
"""float32, few operations; the exponent is at most 20 where it is compared."""


@wp.kernel
def shape_kernel(v: wp.array[wp.vec3], axis: wp.vec3, sharpness: float, shape: wp.array[float]):
    i = wp.tid()
    shape[i] = sg_shape(v[i], axis, sharpness)


@pytest.mark.parametrize("sharpness", [1e-3, 0.1, 1.0, 30.0, 1e3, 1e5, 1e6])
def test_sg_shape(device: str, rng: np.random.Generator, sharpness: float) -> None:
    """``exp(s (v . axis - 1))`` keeps its digits from a flat sky to a sun (M 2)."""
    axis = o.normalize([0.48, -0.6, 0.64]).astype(np.float32)
    # Directions out to an exponent of 20, as far as the sphere goes.
    cos = 1.0 - np.minimum(rng.uniform(0.0, 20.0, 20000) / sharpness, 2.0)
    v = (o.spherical(cos, rng.uniform(0, 2 * np.pi, 20000)) @ o.frame_of(axis).T).astype(np.float32)
    inputs = [upload(v, wp.vec3, device), wp.vec3(*map(float, axis)), sharpness]
    (shape,) = launch(shape_kernel, len(v), inputs, float, device=device)
    expected = np.exp(-sharpness * o.one_minus_cos(v, axis))
    np.testing.assert_allclose(shape, expected, rtol=VALUE_RTOL)
