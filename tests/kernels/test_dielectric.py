"""The interface of two dielectrics: Fresnel, Snell and Walter's lobes in float64, draws, energy."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import launch, upload
from tests.oracles import fresnel
from tests.statistics import chi_square
from warpir.core.arrays import Float64Array
from warpir.kernels.dielectric.interface import (
    Interface,
    fresnel_dielectric,
    interface_f,
    interface_sample,
    refracted,
)

INDICES = (0.4, 1.0 / 1.5, 0.9, 1.2, 1.5, 2.4)
TINT = (0.9, 0.5, 0.2)
CASES = [
    (eta, alpha, cos_o) for eta in (1.5, 1 / 1.5, 2.4) for alpha, cos_o in ((0.2, 0.9), (0.5, 0.3))
]
SAMPLE_COUNT = 100_000


@wp.func
def interface_of(wo: wp.vec3, eta: float, alpha: float) -> Interface:
    interface = Interface()
    interface.wo = wo
    interface.eta = eta
    interface.alpha = alpha
    interface.tint = wp.vec3(0.9, 0.5, 0.2)
    return interface


@wp.kernel(enable_backward=False)
def smooth_kernel(wo: wp.array[wp.vec3], eta: float, F: wp.array[float], wt: wp.array[wp.vec3]):
    i = wp.tid()
    F[i] = fresnel_dielectric(wo[i][2], eta)
    wt[i] = refracted(wo[i], wp.vec3(0.0, 0.0, 1.0), eta)


@wp.kernel(enable_backward=False)
def value_kernel(
    wo: wp.vec3, eta: float, alpha: float, wi: wp.array[wp.vec3], value: wp.array[wp.vec4]
):
    i = wp.tid()
    value[i] = interface_f(interface_of(wo, eta, alpha), wi[i])


@wp.kernel(enable_backward=False)
def sample_kernel(
    wo: wp.vec3,
    eta: float,
    alpha: float,
    u: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    weight: wp.array[wp.vec3],
    pdf: wp.array[float],
):
    i = wp.tid()
    pair = wp.vec2(u[i][0], u[i][1])
    drawn = interface_sample(interface_of(wo, eta, alpha), pair, u[i][2])
    wi[i] = drawn.wi
    weight[i] = drawn.weight
    pdf[i] = drawn.pdf


def at(cos_o: Float64Array | float) -> Float64Array:
    """Directions of these cosines in a fixed azimuth."""
    c = np.atleast_1d(np.asarray(cos_o, float))
    s = np.sqrt(1.0 - c * c)
    return np.stack([0.6 * s, 0.8 * s, c], axis=-1)


def values(
    wo: Float64Array, eta: float, alpha: float, wi: Float64Array, device: str
) -> Float64Array:
    """``f |cos|``, RGB, and the density, shape [direction, 4]."""
    inputs = [wp.vec3(*wo), eta, alpha, upload(wi.reshape(-1, 3), wp.vec3, device)]
    (found,) = launch(value_kernel, wi.size // 3, inputs, wp.vec4, device=device)
    return found.reshape(*wi.shape[:-1], 4)


def draws(wo: Float64Array, eta: float, alpha: float, device: str) -> list[Float64Array]:
    """Directions, weights and densities of `SAMPLE_COUNT` draws."""
    u = np.random.default_rng(3).random((SAMPLE_COUNT, 3), np.float32)
    inputs = [wp.vec3(*wo), eta, alpha, upload(u, wp.vec3, device)]
    return launch(sample_kernel, len(u), inputs, wp.vec3, wp.vec3, float, device=device)


@pytest.mark.parametrize("eta", INDICES)
def test_fresnel_and_snell_are_those_of_float64(eta: float, device: str) -> None:
    """Also beyond the critical angle, where all is reflected."""
    wo = at(np.linspace(0.001, 0.9999, 4001)).astype(np.float32)
    inputs = [upload(wo, wp.vec3, device), eta]
    F, wt = launch(smooth_kernel, len(wo), inputs, float, wp.vec3, device=device)
    cos_o = wo[:, 2].astype(float)
    sin_t = np.sqrt(1.0 - cos_o**2) / eta
    # Next to the critical angle the slope is infinite.
    clear = np.abs(sin_t - 1.0) > 1e-5
    np.testing.assert_allclose(F[clear], fresnel(cos_o, eta)[clear], rtol=2e-4, atol=2e-6)
    assert (F[sin_t > 1.0 + 1e-5] == 1.0).all()
    assert (sin_t > 1.0 + 1e-5).any() == (eta < 1.0)
    passes = clear & (sin_t < 1.0)
    found = wt[passes]
    expected = np.stack(
        [-wo[:, 0] / eta, -wo[:, 1] / eta, -np.sqrt(np.maximum(1.0 - sin_t**2, 0.0))], axis=-1
    )[passes]
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_fresnel_at_normal_incidence(device: str) -> None:
    """((n - 1) / (n + 1))^2, 4 % for glass."""
    inputs = [upload([[0.0, 0.0, 1.0]], wp.vec3, device), 1.5]
    F, _ = launch(smooth_kernel, 1, inputs, float, wp.vec3, device=device)
    assert F[0] == pytest.approx(0.04, abs=1e-7)


def walter(wo: Float64Array, wi: Float64Array, eta: float, alpha: float) -> Float64Array:
    """``f |cos|`` of Walter et al. 2007, eqs. 20, 21, 33 and 34."""
    is_reflected = wi[..., 2] > 0.0
    beyond = np.where(is_reflected, 1.0, eta)
    h = wo + wi * beyond[..., None]
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    h *= np.sign(h[..., 2:])
    o, i = h @ wo, np.einsum("...k,...k", h, wi)

    def tan2(w: Float64Array) -> Float64Array:
        return (1.0 - w[..., 2] ** 2) / w[..., 2] ** 2

    def G1(w: Float64Array) -> Float64Array:
        return 2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * tan2(w)))

    D = alpha**2 / (np.pi * h[..., 2] ** 4 * (alpha**2 + tan2(h)) ** 2)
    G = G1(wo) * G1(wi)
    F = fresnel(np.clip(o, 0.0, 1.0), eta)
    reflected = F * G * D / (4.0 * wo[2])
    through = np.abs(i * o) / wo[2] * eta**2 * (1.0 - F) * G * D / (eta * i + o) ** 2
    is_seen = (o > 0.0) & (i * wi[..., 2] > 0.0)
    rgb = np.where(is_reflected, reflected, through)[..., None] * np.where(
        is_reflected[..., None], 1.0, TINT
    )
    return np.where(is_seen[..., None], rgb, 0.0)


@pytest.mark.parametrize(("eta", "alpha", "cos_o"), CASES)
def test_rough_interface_is_walters(eta: float, alpha: float, cos_o: float, device: str) -> None:
    """Reflection and refraction, both from outside and from inside."""
    rng = np.random.default_rng(1)
    wi = rng.normal(size=(20_000, 3))
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    wi = wi.astype(np.float32).astype(float)
    wi = wi[np.abs(wi[:, 2]) > 0.01]
    wo = at(cos_o)[0].astype(np.float32).astype(float)
    found = values(wo, eta, alpha, wi, device)[:, :3]
    expected = walter(wo, wi, eta, alpha)
    assert (expected > 0.01).any(axis=1).sum() > 2000
    np.testing.assert_allclose(found, expected, rtol=5e-3, atol=2e-4)


@pytest.mark.parametrize(("eta", "alpha", "cos_o"), CASES)
def test_draws_follow_their_density(eta: float, alpha: float, cos_o: float, device: str) -> None:
    """Chi-square over the sphere; and weight times density is the value."""
    wo = at(cos_o)[0]
    wi, weight, pdf = draws(wo, eta, alpha, device)
    used = weight.max(axis=1) > 0.0
    value = values(wo, eta, alpha, wi[used], device)
    np.testing.assert_allclose(value[:, 3], pdf[used], rtol=1e-3)
    np.testing.assert_allclose(value[:, :3], weight[used] * pdf[used, None], rtol=5e-3, atol=1e-5)
    verdict = chi_square(
        wi[used],
        lambda w: values(wo, eta, alpha, w, device)[..., 3],
        np.concatenate(
            [np.linspace(0.0, 0.5 * np.pi, 25), np.linspace(0.5 * np.pi, np.pi, 25)[1:]]
        ),
        np.linspace(-np.pi, np.pi, 33),
        sample_count=SAMPLE_COUNT,
        case_count=len(CASES),
    )
    assert verdict.passed, verdict


@pytest.mark.parametrize("eta", INDICES)
@pytest.mark.parametrize("cos_o", [0.02, 0.4, 1.0])
def test_smooth_draws_lose_nothing(eta: float, cos_o: float, device: str) -> None:
    """The weight of reflection is exactly 1, of refraction the tint; their shares are Fresnel's."""
    wi, weight, pdf = draws(at(cos_o)[0], eta, 0.0, device)
    is_reflected = wi[:, 2] > 0.0
    assert (weight[is_reflected] == 1.0).all()
    assert (weight[~is_reflected] == np.float32(TINT)).all()
    assert (pdf == 0.0).all()
    expected = float(fresnel(np.array([min(cos_o, 1.0 - 1e-9)]), eta)[0])
    assert is_reflected.mean() == pytest.approx(expected, abs=4.0 * 0.5 / SAMPLE_COUNT**0.5)


def test_equal_indices_let_light_pass_straight(device: str) -> None:
    """Whatever the roughness."""
    wo = at(0.3)[0]
    wi, weight, _ = draws(wo, 1.0, 0.5, device)
    np.testing.assert_allclose(wi, np.broadcast_to(-wo, wi.shape), atol=1e-7)
    assert (weight == np.float32(TINT)).all()
