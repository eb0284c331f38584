"""Spherical Gaussians: radiance, its gradient, and lobes on a lat-long map."""

import numpy as np
import pytest
import warp as wp
from warp import autograd

from tests import oracles as o
from tests.statistics import central_differences, compare_gradients
from warpir.kernels.rasterize import rasterize
from warpir.kernels.sg import sg_radiance, sg_shape

VALUE_RTOL = 1e-4
"""float32, few operations; the exponent is at most 20 where it is compared."""
GRADIENT_RELATIVE_L2 = 1e-4
"""float32 adjoint against the float64 derivative."""
TEXEL_RTOL = 5e-3
"""The midpoint rule with three directions per standard deviation, as the kernel states."""
POWER_RTOL = 0.01
"""Energy of a lobe on the map, up to the sharpness that its sub-texels resolve."""


@wp.kernel
def shape_kernel(v: wp.array[wp.vec3], axis: wp.vec3, sharpness: float, shape: wp.array[float]):
    i = wp.tid()
    shape[i] = sg_shape(v[i], axis, sharpness)


@wp.kernel
def radiance_kernel(
    v: wp.array[wp.vec3],
    amplitude: wp.array[wp.vec3],
    axis: wp.array[wp.vec3],
    sharpness: wp.array[float],
    lobe_count: int,
    L: wp.array[wp.vec3],
):
    i = wp.tid()
    L[i] = sg_radiance(v[i], amplitude, axis, sharpness, lobe_count)


def upload(values: np.ndarray, dtype: type, device: str, requires_grad: bool = False) -> wp.array:
    values = np.ascontiguousarray(values, np.float32)
    return wp.array(values, dtype=dtype, device=device, requires_grad=requires_grad)


def random_lobes(rng: np.random.Generator, count: int, sharpness_max: float = 100.0):
    """Return float32 amplitude, unit axis and sharpness of ``count`` lobes."""
    return (
        rng.uniform(0.1, 2.0, (count, 3)).astype(np.float32),
        o.normalize(rng.normal(size=(count, 3))).astype(np.float32),
        np.exp(rng.uniform(np.log(0.1), np.log(sharpness_max), count)).astype(np.float32),
    )


@pytest.mark.parametrize("sharpness", [1e-3, 0.1, 1.0, 30.0, 1e3, 1e5, 1e6])
def test_sg_shape(device: str, rng: np.random.Generator, sharpness: float) -> None:
    """``exp(s (v . axis - 1))`` keeps its digits from a flat sky to a sun (M 2)."""
    axis = o.normalize([0.48, -0.6, 0.64]).astype(np.float32)
    # Directions out to an exponent of 20, as far as the sphere goes.
    cos = 1.0 - np.minimum(rng.uniform(0.0, 20.0, 20000) / sharpness, 2.0)
    v = (o.spherical(cos, rng.uniform(0, 2 * np.pi, 20000)) @ o.frame_of(axis).T).astype(np.float32)
    out = wp.zeros(len(v), dtype=float, device=device)
    inputs = [upload(v, wp.vec3, device), wp.vec3(*map(float, axis)), sharpness]
    wp.launch(shape_kernel, len(v), inputs=inputs, outputs=[out], device=device)
    expected = np.exp(-sharpness * o.one_minus_cos(v, axis))
    np.testing.assert_allclose(out.numpy(), expected, rtol=VALUE_RTOL)


@pytest.mark.parametrize("lobe_count", [0, 1, 2, 7, 17, 64])
def test_sg_radiance(device: str, rng: np.random.Generator, lobe_count: int) -> None:
    """The sum over lobes (M 3): none, one, odd counts, more than the compiler unrolls."""
    amplitude, axis, sharpness = random_lobes(rng, lobe_count)
    v = o.normalize(rng.normal(size=(3000, 3))).astype(np.float32)
    out = wp.zeros(len(v), dtype=wp.vec3, device=device)
    arrays = [
        upload(amplitude, wp.vec3, device),
        upload(axis, wp.vec3, device),
        upload(sharpness, float, device),
    ]
    wp.launch(
        radiance_kernel,
        len(v),
        inputs=[upload(v, wp.vec3, device), *arrays, lobe_count],
        outputs=[out],
        device=device,
    )
    expected = o.sg_radiance(v, amplitude, axis, sharpness)
    np.testing.assert_allclose(out.numpy(), expected, rtol=VALUE_RTOL, atol=1e-7)


def tangential(gradient: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Return the part that normalising the axis lets through."""
    return gradient - o.dot(gradient, axis)[..., None] * axis


@pytest.mark.parametrize("lobe_count", [1, 3, 17, 64])
@pytest.mark.parametrize("sharpness_max", [5.0, 1e4])
def test_sg_gradient(
    device: str, rng: np.random.Generator, lobe_count: int, sharpness_max: float
) -> None:
    """Adjoints of amplitude, axis (in its tangent plane) and sharpness are those of (M 2)."""
    amplitude, axis, sharpness = random_lobes(rng, lobe_count, sharpness_max)
    # Half of the directions lie on the lobes, so that narrow ones have a gradient at all.
    near = o.normalize(
        np.repeat(axis, 64, axis=0)
        + rng.normal(size=(64 * lobe_count, 3)) * np.repeat(1 / np.sqrt(sharpness), 64)[:, None]
    )
    v = np.concatenate([near, o.normalize(rng.normal(size=(500, 3)))]).astype(np.float32)
    y = rng.normal(size=(len(v), 3)).astype(np.float32)
    arrays = [
        upload(amplitude, wp.vec3, device, True),
        upload(axis, wp.vec3, device, True),
        upload(sharpness, float, device, True),
    ]
    out = wp.zeros(len(v), dtype=wp.vec3, device=device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(
            radiance_kernel,
            len(v),
            inputs=[upload(v, wp.vec3, device), *arrays, lobe_count],
            outputs=[out],
            device=device,
        )
    tape.backward(grads={out: upload(y, wp.vec3, device)})

    v, y, axis = o.normalize(v), y.astype(np.float64), o.normalize(axis)
    t = o.one_minus_cos(v[:, None], axis[None])
    shape = np.exp(-sharpness * t)
    weighted = shape * (y @ amplitude.T.astype(np.float64))
    d_amplitude = shape.T @ y
    d_axis = np.einsum("ik,ic->kc", weighted * sharpness, v)
    d_sharpness = -np.sum(weighted * t, axis=0)
    for array, expected in zip(arrays, (d_amplitude, d_axis, d_sharpness), strict=True):
        gradient = array.grad.numpy().astype(np.float64)
        if expected is d_axis:
            gradient, expected = tangential(gradient, axis), tangential(expected, axis)
        match = compare_gradients(gradient, expected)
        assert match.relative_l2 < GRADIENT_RELATIVE_L2, match


# ----------------------------------------------------------------------------- rasterize


def run_rasterize(
    device: str,
    height: int,
    width: int,
    arrays: list[wp.array],
    lobe_count: int,
    grad: bool = False,
) -> wp.array:
    texels = wp.zeros((height, width), dtype=wp.vec3, device=device, requires_grad=grad)
    wp.launch(
        rasterize,
        (height, width),
        inputs=[height, width, *arrays, lobe_count],
        outputs=[texels],
        device=device,
    )
    return texels


def mean_radiance(
    height: int,
    width: int,
    order: int,
    amplitude: np.ndarray,
    axis: np.ndarray,
    sharpness: np.ndarray,
) -> np.ndarray:
    """Return the mean of the lobes over each texel's solid angle, Gauss-Legendre in sin(lat)."""
    y, weight_y = o.gauss_legendre(np.linspace(-1.0, 1.0, 2), order)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    sin_lat = 0.5 * (edges[:-1] + edges[1:])[:, None] + 0.5 * (edges[:-1] - edges[1:])[:, None] * y
    u = (np.arange(width)[:, None] + 0.5 + 0.5 * y) / width
    v = 0.5 - np.arcsin(sin_lat) / np.pi
    uv = np.stack(np.broadcast_arrays(u[None, None], v[:, :, None, None]), axis=-1)
    L = o.sg_radiance(o.latlong_direction(uv), amplitude, axis, sharpness)
    return np.einsum("iajbc,a,b->ijc", L, 0.5 * weight_y, 0.5 * weight_y)


def test_rasterize_is_the_mean_over_each_texel(device: str, rng: np.random.Generator) -> None:
    """Texels hold the mean radiance over their solid angle, broad and narrow lobes alike."""
    amplitude, axis, sharpness = random_lobes(rng, 5, 200.0)
    arrays = [
        upload(amplitude, wp.vec3, device),
        upload(axis, wp.vec3, device),
        upload(sharpness, float, device),
    ]
    texels = run_rasterize(device, 16, 32, arrays, 5).numpy().astype(np.float64)
    expected = mean_radiance(16, 32, 8, amplitude, axis, sharpness)
    assert np.abs(texels - expected).max() < TEXEL_RTOL * expected.max()


def test_rasterize_orientation(device: str) -> None:
    """A lamp at +X lights the left quarter, one at +Y the first row (OpenEXR)."""
    for axis, row, column in (([1, 0, 0], None, 8), ([0, 1, 0], 0, None), ([0, 0, 1], None, 16)):
        arrays = [
            upload(np.ones((1, 3)), wp.vec3, device),
            upload(np.array([axis]), wp.vec3, device),
            upload(np.array([50.0]), float, device),
        ]
        texels = run_rasterize(device, 17, 33, arrays, 1).numpy()[..., 0]
        i, j = np.unravel_index(np.argmax(texels), texels.shape)
        assert (row is None or i == row) and (column is None or abs(j - column) <= 1)


@pytest.mark.parametrize("sharpness", [0.01, 10.0, 1e3, 2e4, 4e4])
@pytest.mark.parametrize("axis", [[0.3, 0.8, -0.5], [0.0, 1.0, 0.0], [0.02, -0.99, 0.05]])
def test_rasterize_keeps_the_power(device: str, sharpness: float, axis: list[float]) -> None:
    """Texels times solid angle sum to ``2 pi c / s (1 - exp(-2 s))``, next to the poles too.

    On 32 x 64 texels, whose side is 25 times the width of the narrowest lobe.
    """
    unit = o.normalize([axis])
    arrays = [
        upload(np.full((1, 3), 2.0), wp.vec3, device),
        upload(unit, wp.vec3, device),
        upload(np.array([sharpness]), float, device),
    ]
    texels = run_rasterize(device, 32, 64, arrays, 1).numpy().astype(np.float64)
    power = np.einsum("ijc,i->c", texels, o.texel_solid_angle(32, 64))
    assert power == pytest.approx(2.0 * float(o.sg_flux(sharpness)), rel=POWER_RTOL)


@pytest.mark.parametrize("sharpness", [30.0, 1e3, 6e3, 1e5])
def test_rasterize_keeps_the_power_at_a_pole(device: str, sharpness: float) -> None:
    """A lobe straight above keeps its power within 0.1 % at three directions per deviation.

    Midpoints in latitude gave it 0.4 % too much: the integrand starts at the pole with a slope.
    """
    arrays = [
        upload(np.ones((1, 3)), wp.vec3, device),
        upload(np.array([[0.0, 1.0, 0.0]]), wp.vec3, device),
        upload(np.array([sharpness]), float, device),
    ]
    texels = run_rasterize(device, 64, 128, arrays, 1).numpy().astype(np.float64)
    power = np.einsum("ijc,i->c", texels, o.texel_solid_angle(64, 128))
    assert power == pytest.approx(float(o.sg_flux(sharpness)), rel=1e-3)


def rasterize_gradient(
    device: str, lobes: tuple[np.ndarray, ...], y: np.ndarray
) -> list[np.ndarray]:
    """Return the kernel's gradient of ``sum(y * texels)``; the axis' part in its tangent plane."""
    amplitude, axis, sharpness = lobes
    arrays = [
        upload(amplitude, wp.vec3, device, True),
        upload(axis, wp.vec3, device, True),
        upload(sharpness, float, device, True),
    ]
    with wp.Tape() as tape:
        texels = run_rasterize(device, *y.shape[:2], arrays, len(axis), grad=True)
    tape.backward(grads={texels: upload(y, wp.vec3, device)})
    gradients = [a.grad.numpy().astype(np.float64) for a in arrays]
    gradients[1] = tangential(gradients[1], o.normalize(axis))
    return gradients


def test_rasterize_gradient(device: str, rng: np.random.Generator) -> None:
    """The adjoint of the map is the derivative of the mean radiance over each texel."""
    lobes = random_lobes(rng, 5, 20.0)
    y = rng.normal(size=(6, 12, 3)).astype(np.float32)
    gradients = rasterize_gradient(device, lobes, y)
    amplitude, axis, sharpness = (a.astype(np.float64) for a in lobes)

    def loss(amplitude: np.ndarray, axis: np.ndarray, sharpness: np.ndarray) -> float:
        return float(np.sum(y * mean_radiance(6, 12, 6, amplitude, o.normalize(axis), sharpness)))

    expected = [
        central_differences(lambda x: loss(x, axis, sharpness), amplitude, 1e-4),
        central_differences(lambda x: loss(amplitude, x, sharpness), axis, 1e-5),
        central_differences(lambda x: loss(amplitude, axis, x), sharpness, 1e-5 * sharpness),
    ]
    for gradient, reference in zip(gradients, expected, strict=True):
        match = compare_gradients(gradient, reference)
        # Three directions per standard deviation of a lobe against the exact mean.
        assert match.relative_l2 < 1e-2 and match.cosine > 0.9999, match


def test_rasterize_gradient_is_that_of_its_own_directions(
    device: str, rng: np.random.Generator
) -> None:
    """Finite differences of the forward kernel agree with its adjoint."""
    lobes = random_lobes(rng, 3, 20.0)
    y = rng.normal(size=(4, 7, 3)).astype(np.float32)
    gradients = rasterize_gradient(device, lobes, y)

    def loss(k: int, x: np.ndarray) -> float:
        moved = list(lobes)
        moved[k] = o.normalize(x) if k == 1 else x
        arrays = [
            upload(a, t, device) for a, t in zip(moved, (wp.vec3, wp.vec3, float), strict=True)
        ]
        return float(np.sum(y * run_rasterize(device, 4, 7, arrays, 3).numpy().astype(np.float64)))

    for k, gradient in enumerate(gradients):
        x = lobes[k].astype(np.float64)
        reference = central_differences(
            lambda x, k=k: loss(k, x), x, 2e-3 * np.maximum(np.abs(x), 0.5)
        )
        match = compare_gradients(gradient, reference)
        # float32 sums over steps of 0.2 %.
        assert match.relative_l2 < 5e-3, (k, match)


def test_rasterize_gradcheck(device: str, rng: np.random.Generator) -> None:
    """Warp's own finite differences agree with the adjoint of a small map."""
    amplitude, axis, sharpness = random_lobes(rng, 3, 5.0)
    texels = wp.zeros((3, 4), dtype=wp.vec3, device=device, requires_grad=True)
    inputs = [
        3,
        4,
        upload(amplitude, wp.vec3, device, True),
        upload(axis, wp.vec3, device, True),
        upload(sharpness, float, device, True),
        3,
    ]
    assert autograd.gradcheck(
        rasterize,
        dim=(3, 4),
        inputs=inputs,
        outputs=[texels],
        device=device,
        eps=1e-2,
        raise_exception=False,
        show_summary=False,
    )
