"""The optimised lobes: start, bounds, texels and their gradients against float64 restatements."""

import numpy as np
import pytest
import torch

from tests import oracles as o
from tests.statistics import central_differences, compare_gradients
from warpir.core.arrays import Float64Array
from warpir.lighting.sg_light import (
    TEXELS_PER_SIGMA,
    WIDEST,
    LightBounds,
    SGLight,
    narrowest,
)
from warpir.scene.light import Lobes, fibonacci, rasterize_lobes

FLOAT32 = 2e-6
"""About ten float32 operations, relative: logarithms, exponentials, norms."""
BOUNDS = LightBounds(sigma_min=narrowest(32))
NAMES = ("log_intensity", "chroma", "axis", "log_sigma")


def coloured(rng: np.random.Generator, count: int = 5, bounds: LightBounds = BOUNDS) -> Lobes:
    """Lobes well within the bounds: contrast 1e4, every width, moderate colours."""
    level = np.exp(rng.uniform(np.log(1e-2), np.log(1e2), (count, 1)))
    ratio = rng.uniform(-0.6, 0.6, (count, 3))
    sigma = np.exp(rng.uniform(np.log(1.01 * bounds.sigma_min), np.log(0.99 * WIDEST), count))
    axis = o.normalize(rng.normal(size=(count, 3)))
    parts = level * np.exp(ratio), axis, sigma**-2.0
    return Lobes(*(p.astype(np.float32) for p in parts))


def restated(light: SGLight, height: int) -> Float64Array:
    """The map that the lobes mean at texel centres (DiPIR, eq. 2 and 3), in float64."""
    lobes = light.lobes()
    directions = o.texel_direction(height, 2 * height)
    return o.sg_radiance(directions, lobes.amplitude, lobes.axis, lobes.sharpness)


def maps_mean(texels: Float64Array) -> float:
    """Mean over the sphere."""
    omega = o.texel_solid_angle(*texels.shape[:2])[:, None, None]
    return float((texels * omega).sum() / (4.0 * np.pi * texels.shape[2]))


def one_lobe(
    axis: tuple[float, float, float],
    sigma: float,
    amplitude: tuple[float, float, float] = (1.0, 1.0, 1.0),
    bounds: LightBounds = BOUNDS,
) -> SGLight:
    lobes = Lobes(
        np.array([amplitude], np.float32),
        o.normalize(axis)[None].astype(np.float32),
        np.array([sigma**-2.0], np.float32),
    )
    return SGLight(lobes, 1.0, bounds)


# ------------------------------------------------------------------------------ the start


@pytest.mark.parametrize("count", [1, 2, 8, 32, 64, 256, 2000])
def test_uniform_start_has_its_mean(count: int) -> None:
    """Whatever the count, and where the narrowest width is wider than the spacing asks for."""
    light = SGLight.uniform(count, 0.3, BOUNDS)
    assert maps_mean(restated(light, 32)) == pytest.approx(0.3, rel=1e-5)  # and the quadrature
    lobes = light.lobes()
    assert np.ptp(lobes.amplitude) == 0.0 and np.ptp(lobes.sharpness) == 0.0


@pytest.mark.parametrize(("count", "ripple"), [(16, 0.036), (64, 0.018), (256, 0.009)])
def test_uniform_start_is_even(count: int, ripple: float) -> None:
    """Its ripple falls with the root of the count from the 1.8 % (rms) that `WIDTH_FACTOR` names.

    The spiral is irregular near its poles alone, which are a share of the sphere that falls with
    the count: nowhere is the light more than 11 % from even.
    """
    texels = restated(SGLight.uniform(count, 1.0, LightBounds(0.01)), 64)
    omega = o.texel_solid_angle(64, 128)[:, None, None]
    rms = np.sqrt(((texels - 1.0) ** 2 * omega).sum() / (12.0 * np.pi))
    assert 0.8 * ripple < rms < 1.1 * ripple
    assert np.abs(texels - 1.0).max() < 0.11


def test_fibonacci_spreads_directions_evenly() -> None:
    """Unit vectors, centroid at 0, and no two nearer than half the mean spacing."""
    for count in (16, 64, 500):
        axis = fibonacci(count).astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(axis, axis=1), 1.0, atol=1e-6)
        assert np.abs(axis.mean(axis=0)).max() < 1.0 / count
        cosine = axis @ axis.T - 2.0 * np.eye(count)
        nearest = np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0))
        assert nearest.min() > 0.5 * np.sqrt(4.0 * np.pi / count)


def test_light_comes_back_as_it_was_given(rng: np.random.Generator) -> None:
    """Amplitude, axis and sharpness of lobes within the bounds survive the raw parameters."""
    given = coloured(rng, 200)
    back = SGLight(given, 1.0, BOUNDS).lobes()
    np.testing.assert_allclose(back.amplitude, given.amplitude, rtol=5.0 * FLOAT32)
    np.testing.assert_allclose(back.axis, given.axis, atol=FLOAT32)
    np.testing.assert_allclose(back.sharpness, given.sharpness, rtol=5.0 * FLOAT32)


def test_light_comes_back_at_the_edge_of_its_colours() -> None:
    """The inverse of the bound is exact up to 99 % of it, ``exp(1.48)`` above the mean."""
    ratio = 0.989 * BOUNDS.chroma * np.array([1.0, -0.5, -0.5])
    for sign in (1.0, -1.0):
        amplitude = tuple(np.exp(sign * ratio))
        r, g, b = amplitude
        found = one_lobe((0.3, 0.5, -0.2), 0.4, (r, g, b)).lobes().amplitude[0]
        np.testing.assert_allclose(found, amplitude, rtol=50.0 * FLOAT32)


@pytest.mark.parametrize("amplitude", [(5.0, 0.0, 0.0), (0.0, 0.0, 5.0), (900.0, 1.0, 0.01)])
def test_light_of_excluded_colour_keeps_its_luminance(
    amplitude: tuple[float, float, float],
) -> None:
    """It is drawn toward white until the bound holds, and its hue stays."""
    light = one_lobe((0.0, 1.0, 0.0), 0.5, amplitude)
    found = light.lobes().amplitude[0].astype(np.float64)
    assert o.luminance(found) == pytest.approx(o.luminance(amplitude), rel=1e-5)
    assert np.argsort(found).tolist()[-1] == int(np.argmax(amplitude))
    ratio = np.log(found) - np.log(found).mean()
    assert np.abs(ratio).max() <= BOUNDS.chroma
    assert np.abs(ratio).max() > 0.85 * BOUNDS.chroma


def test_light_beyond_its_bounds_starts_at_them() -> None:
    """Black is the least intensity, the brightest the greatest; widths are clamped."""
    bounds = LightBounds(0.1, intensity=100.0)
    black = one_lobe((1.0, 0.0, 0.0), 0.3, (0.0, 0.0, 0.0), bounds)
    bright = one_lobe((1.0, 0.0, 0.0), 0.3, (1e6, 1e6, 1e6), bounds)
    np.testing.assert_allclose(black.lobes().amplitude, 0.01, rtol=FLOAT32)
    np.testing.assert_allclose(bright.lobes().amplitude, 100.0, rtol=FLOAT32)
    for sigma, kept in ((0.001, 0.1), (50.0, WIDEST)):
        light = one_lobe((1.0, 0.0, 0.0), sigma, bounds=bounds)
        assert light.lobes().sharpness[0] == pytest.approx(kept**-2.0, rel=FLOAT32)


# ----------------------------------------------------------------------------- the texels


@pytest.mark.parametrize("height", [8, 32, 64])
def test_texels_are_the_papers(rng: np.random.Generator, height: int) -> None:
    """Each texel is the sum of the lobes at its centre (eq. 3), coloured, every width."""
    light = SGLight(coloured(rng, 20, LightBounds(0.06)), 1.0, LightBounds(0.06))
    with torch.no_grad():
        texels = light.texels(height).numpy()
    assert texels.shape == (height, 2 * height, 3)
    # 1 - cos in float32, times a sharpness of 270.
    np.testing.assert_allclose(texels, restated(light, height), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize("sigma", [narrowest(64), 0.1, 0.5, 1.0, WIDEST])
def test_texels_hold_the_flux(sigma: float) -> None:
    """``2 pi c sigma^2 (1 - exp(-2 / sigma^2))``: to 0.1 % at a narrow lobe away from the poles.

    Within a width of a pole the midpoint rule ends in a point, and 3 % are too much; lobes of more
    than two texels lose a twentieth of a percent at most.
    """
    height, bounds = 64, LightBounds(narrowest(64))
    omega = o.texel_solid_angle(height, 2 * height)[:, None]
    flux = 2.0 * np.pi * sigma**2 * (1.0 - np.exp(-2.0 / sigma**2))
    assert flux == pytest.approx(float(o.sg_flux(sigma**-2.0)), rel=1e-12)
    for axis in ((0.3, 0.2, -0.9), (-0.7, 0.6, 0.2), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
        light = one_lobe(axis, sigma, bounds=bounds)
        assert light.lobes().flux()[0, 0] == pytest.approx(flux, rel=1e-5)
        with torch.no_grad():
            found = (light.texels(height).numpy()[..., 0].astype(np.float64) * omega).sum()
        is_pole, is_narrow = axis[0] == 0.0, sigma < 0.1
        bound = 0.03 if is_narrow and is_pole else 0.012 if is_pole else 1e-3
        assert found == pytest.approx(flux, rel=bound), axis


@pytest.mark.parametrize("height", [16, 32])
def test_texels_agree_with_averaging(height: int) -> None:
    """`rasterize_lobes` averages over texels: the same flux, and the same texels to two orders.

    Fluxes agree to 3 % at a pole, elsewhere to 0.3 % (lobes six times as wide reach the poles). A
    texel's mean of a parabola of curvature ``1 / sigma^2`` is ``2 / 24 / 1.25^2`` = 5.3 % of the
    peak away from its centre for the narrowest lobe; and the texel's centre of mass is
    ``1 / (12 (row + 1/2))`` of a row farther from the pole than its centre, on a slope of
    ``exp(-1/2) / sigma`` at most.
    """
    bounds = LightBounds(narrowest(height))
    omega = o.texel_solid_angle(height, 2 * height)[:, None]
    row = np.minimum(np.arange(height), np.arange(height)[::-1])
    curvature = 2.0 / 24.0 / TEXELS_PER_SIGMA**2
    slope = np.exp(-0.5) / TEXELS_PER_SIGMA / (12.0 * (row + 0.5))
    for axis in ((0.3, 0.2, -0.9), (-0.7, 0.6, 0.2), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)):
        for factor in (1.0, 6.0):
            light = one_lobe(axis, factor * bounds.sigma_min, bounds=bounds)
            averaged = rasterize_lobes(light.lobes(), height, 2 * height)
            mean = averaged[..., 0].astype(np.float64)
            with torch.no_grad():
                texels = light.texels(height).numpy()[..., 0].astype(np.float64)
            bound = 0.03 if axis[0] == 0.0 else 0.003
            assert (texels * omega).sum() == pytest.approx((mean * omega).sum(), rel=bound)
            differences = np.abs(texels - mean).max(axis=1)
            assert (differences < curvature / factor**2 + slope / factor).all()


@pytest.mark.parametrize("name", NAMES)
def test_texels_gradient_against_central_differences(rng: np.random.Generator, name: str) -> None:
    """All four raw parameters, in float64; the axis is differentiated through its normalisation."""
    light = SGLight(coloured(rng), 1.0, BOUNDS).double()
    y = torch.from_numpy(rng.normal(size=(8, 16, 3)))
    parameter = light.get_parameter(name)
    start = parameter.detach().numpy().copy()

    def loss(values: Float64Array) -> float:
        with torch.no_grad():
            parameter.copy_(torch.from_numpy(values))
            return float((y * light.texels(8)).sum())

    (gradient,) = torch.autograd.grad((y * light.texels(8)).sum(), parameter)
    match = compare_gradients(gradient.numpy(), central_differences(loss, start, 1e-5))
    # Steps of 1e-5 in float64: 1e-10 of curvature (sharpness 60), 1e-10 of round-off.
    assert match.relative_l2 < 1e-7, match


def test_texels_gradient_in_float32(rng: np.random.Generator) -> None:
    """What the optimiser reads is that of the float64 module to float32's digits."""
    y = torch.from_numpy(rng.normal(size=(32, 64, 3)))
    light = SGLight(coloured(rng, 10), 1.0, BOUNDS)
    gradients = []
    for module in (light, SGLight(light.lobes(), 1.0, BOUNDS).double()):
        texels = module.texels(32)
        gradients.append(
            torch.autograd.grad((y.to(texels) * texels).sum(), list(module.parameters()))
        )
    for single, double in zip(*gradients, strict=True):
        match = compare_gradients(single.double().numpy(), double.numpy())
        assert match.relative_l2 < 1e-4, match


# ----------------------------------------------------------------------------- the bounds


def test_project_changes_nothing_inside_the_bounds(rng: np.random.Generator) -> None:
    """Neither parameters, once axes and colours are normal, nor, before that, what they mean."""
    light = SGLight(coloured(rng, 30), 1.0, BOUNDS)
    before = {k: v.clone() for k, v in light.state_dict().items()}
    light.project()
    for name, value in light.state_dict().items():
        np.testing.assert_allclose(value.numpy(), before[name].numpy(), rtol=0.0, atol=3e-7)
    with torch.no_grad():
        light.axis *= torch.linspace(0.5, 2.0, 30)[:, None]
        light.chroma += torch.linspace(-1.0, 1.0, 30)[:, None]
        texels = light.texels(16)
        light.project()
        torch.testing.assert_close(light.texels(16), texels, rtol=1e-4, atol=0.0)
        torch.testing.assert_close(light.axis.norm(dim=1), torch.ones(30))
        assert float(light.chroma.mean(dim=1).abs().max()) < 1e-6


def test_project_brings_everything_back(rng: np.random.Generator) -> None:
    """From anywhere: intensities and widths within their ranges, unit axes."""
    bounds = LightBounds(0.07, intensity=1e3)
    light = SGLight(coloured(rng, 40, bounds), 2.0, bounds)
    with torch.no_grad():
        for parameter in light.parameters():
            parameter.add_(torch.from_numpy(30.0 * rng.normal(size=parameter.shape)))
    light.project()
    lobes = light.lobes()
    mean = np.exp(np.log(lobes.amplitude.astype(np.float64)).mean(axis=1))
    assert mean.min() == pytest.approx(2e-3, rel=1e-5) and mean.max() == pytest.approx(
        2e3, rel=1e-5
    )
    sigma = lobes.sharpness.astype(np.float64) ** -0.5
    assert sigma.min() == pytest.approx(0.07, rel=1e-5)
    assert sigma.max() == pytest.approx(WIDEST, rel=1e-5)
    np.testing.assert_allclose(np.linalg.norm(lobes.axis, axis=1), 1.0, atol=FLOAT32)


@pytest.mark.parametrize("size", [1.0, 10.0, 1e3, 1e6])
def test_colours_stay_bounded(rng: np.random.Generator, size: float) -> None:
    """No channel leaves ``exp(+- limit)`` of its lobe's geometric mean, whatever the parameter."""
    for limit in (0.3, 1.5):
        light = SGLight.uniform(64, 1.0, LightBounds(0.1, chroma=limit))
        with torch.no_grad():
            light.chroma.copy_(torch.from_numpy(size * rng.normal(size=(64, 3))))
            light.chroma[0] = size * torch.tensor([1.0, -0.5, -0.5])
            light.chroma[1] = size * torch.tensor([-1.0, 0.5, 0.5])
        amplitude = light.lobes().amplitude.astype(np.float64)
        ratio = np.log(amplitude) - np.log(amplitude).mean(axis=1, keepdims=True)
        assert np.abs(ratio).max() <= limit * (1.0 + 1e-5)
        if size >= 1e3:  # the bound is reached, so it forbids no more than it says
            assert ratio[0, 0] == pytest.approx(limit, rel=1e-4)
            assert ratio[1, 0] == pytest.approx(-limit, rel=1e-4)


def test_small_colours_are_free() -> None:
    """Where ratios are small, they are the raw parameters: the bound acts to third order."""
    light = SGLight.uniform(1, 1.0, BOUNDS)
    raw = torch.tensor([[0.1, -0.03, -0.07]])
    with torch.no_grad():
        light.chroma.copy_(raw)
        found = light.log_ratios()
    size = float(raw.norm()) / BOUNDS.chroma_length
    torch.testing.assert_close(found, raw * (1.0 - 0.5 * size**2), rtol=size**4, atol=0.0)


@pytest.mark.parametrize("sigma", [BOUNDS.sigma_min, WIDEST])
@pytest.mark.parametrize("extreme", [0.0, 1e6, -1e6])
def test_gradients_stay_finite_at_the_extremes(sigma: float, extreme: float) -> None:
    """Colour parameters of a million, both ends of width and intensity, a pole: all finite."""
    for intensity in (1e-6, 1.0, 1e6):
        light = one_lobe((0.0, 1.0, 0.0), sigma, (intensity,) * 3)
        with torch.no_grad():
            light.chroma[0, 0] = extreme
            light.chroma[0, 2] = -0.5 * extreme
        texels = light.texels(32)
        assert bool(texels.isfinite().all()) and float(texels.detach().min()) >= 0.0
        texels.square().sum().backward()
        for name in NAMES:
            gradient = light.get_parameter(name).grad
            assert gradient is not None and bool(gradient.isfinite().all()), name
