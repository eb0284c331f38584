"""The oracles obey the identities of their sources and agree with independent quadrature."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy import integrate, ndimage

from tests import oracles as o
from tests.statistics import (
    central_differences,
    chi_square,
    chi_square_counts,
    compare_gradients,
    z_test,
)

EXACT = 1e-12
"""float64 round-off of a few operations."""
QUADRATURE = 1e-6
"""Both sides are quadratures of kinked integrands; scipy's own default is 1.5e-8."""
UP = np.array([0.0, 1.0, 0.0])


def hemisphere(function: Callable[[float, float], float], epsabs: float = 1e-9) -> float:
    """Integrate ``function(cos_theta, phi)`` over the upper hemisphere with scipy."""
    value, _ = integrate.dblquad(
        lambda phi, cos: function(cos, phi), 0.0, 1.0, 0.0, 2.0 * np.pi, epsabs=epsabs, epsrel=1e-8
    )
    return float(value)


# ------------------------------------------------------------------------- lat-long maps


@pytest.mark.parametrize("height, width", [(1, 1), (2, 4), (32, 64), (127, 255), (512, 1024)])
def test_solid_angle_sums_to_the_sphere(height: int, width: int) -> None:
    """Texel solid angles sum to 4 pi and equal the printed difference of cosines."""
    d_omega = o.texel_solid_angle(height, width)
    i = np.arange(height)
    printed = 2 * np.pi / width * (np.cos(np.pi * i / height) - np.cos(np.pi * (i + 1) / height))
    assert d_omega.sum() * width == pytest.approx(4 * np.pi, rel=EXACT)
    assert d_omega == pytest.approx(printed, abs=1e-15)


def test_latlong_orientation() -> None:
    """Centre is +Z, left quarter +X, right quarter -X, both edges -Z, top +Y (OpenEXR)."""
    uv = np.array(
        [[0.5, 0.5], [0.25, 0.5], [0.75, 0.5], [0.0, 0.5], [1.0, 0.5], [0.3, 0.0], [0.3, 1.0]]
    )
    expected = [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1], [0, 0, -1], [0, 1, 0], [0, -1, 0]]
    assert o.latlong_direction(uv) == pytest.approx(np.array(expected, float), abs=1e-15)


def test_latlong_round_trip(rng: np.random.Generator) -> None:
    """``uv(direction(uv)) = uv`` away from the poles, ``direction(uv(d)) = d`` everywhere."""
    uv = np.stack([rng.random(10000), rng.uniform(1e-4, 1 - 1e-4, 10000)], axis=-1)
    assert o.latlong_uv(o.latlong_direction(uv)) == pytest.approx(uv, abs=1e-11)
    d = o.normalize(rng.normal(size=(10000, 3)) * [1, 100, 1])
    assert o.latlong_direction(o.latlong_uv(d)) == pytest.approx(d, abs=1e-14)


def test_bilinear_against_scipy(rng: np.random.Generator) -> None:
    """The lookup equals scipy's linear interpolation of a map padded by wrapping and clamping."""
    texels = rng.random((7, 12, 3))
    uv = rng.random((500, 2))
    uv[:4] = [[0, 0], [1, 1], [0.999999, 0.5], [0.02, 0.999]]
    padded = np.pad(
        np.pad(texels, ((1, 1), (0, 0), (0, 0)), "edge"), ((0, 0), (1, 1), (0, 0)), "wrap"
    )
    at = np.stack([uv[:, 1] * 7 + 0.5, uv[:, 0] * 12 + 0.5])
    expected = np.stack(
        [ndimage.map_coordinates(padded[..., c], at, order=1) for c in range(3)], -1
    )
    assert o.bilinear_lookup(texels, uv) == pytest.approx(expected, abs=EXACT)
    rows, columns, weights = o.bilinear_weights(uv, 7, 12)
    assert weights.sum(axis=-1) == pytest.approx(1.0, abs=EXACT)
    assert weights.min() >= 0.0 and rows.max() <= 6 and columns.max() <= 11


def test_bilinear_returns_the_texel_at_its_centre(rng: np.random.Generator) -> None:
    """Texel centres lie at +0.5."""
    texels = rng.random((5, 8, 3))
    uv = o.latlong_uv(o.texel_direction(5, 8))
    assert o.bilinear_lookup(texels, uv) == pytest.approx(texels, abs=1e-13)


# -------------------------------------------------------------------- spherical Gaussians


@pytest.mark.parametrize("sharpness", [1e-3, 0.1, 1.0, 30.0, 1e3, 1e6])
def test_sg_flux_by_quadrature(sharpness: float) -> None:
    """Lobe flux is ``2 pi / s (1 - exp(-2 s))`` (method 2.1), stable from 1e-3 to 1e6."""
    end = min(2.0, 60.0 / sharpness)
    value, _ = integrate.quad(lambda t: 2 * np.pi * np.exp(-sharpness * t), 0.0, end, epsrel=1e-12)
    assert o.sg_flux(sharpness) == pytest.approx(value, rel=1e-10)


def test_sg_power_on_a_map() -> None:
    """The sum over texels times solid angle is the flux; DiPIR writes sharpness = 1 / sigma^2."""
    axis, sigma = o.normalize([0.3, 0.8, -0.5]), 0.2
    amplitude = np.array([1.0, 2.0, 3.0])
    texels = o.sg_radiance(o.texel_direction(256, 512), [amplitude], [axis], [1 / sigma**2])
    power = np.einsum("ijc,i->c", texels, o.texel_solid_angle(256, 512))
    assert power == pytest.approx(amplitude * o.sg_flux(1 / sigma**2), rel=1e-5)
    assert o.sg_flux(1 / sigma**2) == pytest.approx(2 * np.pi * sigma**2 * -np.expm1(-2 / sigma**2))


@pytest.mark.parametrize("lobe_count", [16, 64, 256])
def test_sg_uniform_start(lobe_count: int) -> None:
    """Grey lobes of width ``0.6 sqrt(4 pi / N)`` have mean 2.262 (method, light.init_sigma)."""
    sigma = 0.6 * np.sqrt(4 * np.pi / lobe_count)
    assert lobe_count * o.sg_flux(1 / sigma**2) / (4 * np.pi) == pytest.approx(2.262, abs=2e-3)


@pytest.mark.parametrize("sharpness", [1e-3, 0.5, 8.0, 200.0])
@pytest.mark.parametrize("tilt", [0.0, 0.4, 1.2, 1.55, 1.7, 2.6, np.pi])
def test_sg_irradiance_by_quadrature(sharpness: float, tilt: float) -> None:
    """Irradiance of a plane under a lobe against scipy over the plane's own hemisphere."""
    axis = np.array([np.sin(tilt), np.cos(tilt), 0.0])
    value, _ = integrate.dblquad(
        lambda phi, c: (
            2
            * c
            * np.exp(sharpness * (np.sqrt(1 - c * c) * np.cos(phi) * axis[0] + c * axis[1] - 1))
        ),
        0.0,
        1.0,
        0.0,
        np.pi,
        epsabs=1e-11,
        epsrel=1e-9,
    )
    assert o.sg_irradiance(UP, axis, sharpness) == pytest.approx(value, rel=1e-6, abs=1e-10)


def test_sg_irradiance_limits() -> None:
    """A flat lobe gives pi, a narrow one its flux times the cosine; nothing from far below."""
    axis = np.array([0.0, np.cos(1.0), np.sin(1.0)])
    assert o.sg_irradiance(UP, axis, 1e-9) == pytest.approx(np.pi, rel=1e-8)
    narrow = o.sg_flux(1e6) * np.cos(1.0) * (1 / np.tanh(1e6) - 1e-6)
    assert o.sg_irradiance(UP, axis, 1e6) == pytest.approx(narrow, rel=1e-10)
    assert o.sg_irradiance(UP, -UP, 1e6) == 0.0


# ------------------------------------------------------------------------------ the BRDF


@pytest.mark.parametrize("alpha", [1e-3, 0.01, 0.1, 0.5, 1.0])
def test_ggx_projected_normals_cover_the_surface(alpha: float) -> None:
    """``int D cos = 1`` (Heitz 2014)."""
    s, weight = o.gauss_legendre(np.linspace(0, 0.5 * np.pi, 65), 16)
    theta = np.arctan(alpha * np.tan(s))
    jacobian = alpha / (np.cos(s) ** 2 + alpha**2 * np.sin(s) ** 2)
    value = (
        o.ggx_d(o.spherical(np.cos(theta), 0.0), alpha) * np.cos(theta) * np.sin(theta) * jacobian
    )
    assert 2 * np.pi * np.sum(value * weight) == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
@pytest.mark.parametrize("cos_o", [1.0, 0.5, 0.05])
def test_vndf_integrates_to_one(alpha: float, cos_o: float) -> None:
    """Visible normals are a density: the definition of Smith's masking (Heitz 2014)."""
    wo = np.array([np.sqrt(1 - cos_o**2), 0.0, cos_o])
    s, weight = o.gauss_legendre(np.linspace(0, 0.5 * np.pi, 65), 16)
    theta = np.arctan(alpha * np.tan(s))
    jacobian = alpha / (np.cos(s) ** 2 + alpha**2 * np.sin(s) ** 2)
    phi = 2 * np.pi * (np.arange(2048) + 0.5) / 2048
    density = o.vndf(wo, o.spherical(np.cos(theta)[:, None], phi), alpha).mean(axis=1)
    assert 2 * np.pi * np.sum(density * np.sin(theta) * jacobian * weight) == pytest.approx(
        1.0, abs=1e-5
    )


def test_reflection_pdf_integrates_to_one_over_the_sphere() -> None:
    """The weak white furnace test (Heitz 2014): with masking alone no energy is lost."""
    wo, alpha = o.normalize([0.6, 0.0, 0.5]), 0.4
    theta, weight = o.gauss_legendre(np.linspace(0, np.pi, 257), 8)
    phi = 2 * np.pi * (np.arange(1024) + 0.5) / 1024
    pdf = o.vndf_reflection_pdf(wo, o.spherical(np.cos(theta)[:, None], phi), alpha).mean(axis=1)
    assert 2 * np.pi * np.sum(pdf * np.sin(theta) * weight) == pytest.approx(1.0, abs=1e-4)


def test_smith_g2_lies_between_separable_and_single(rng: np.random.Generator) -> None:
    """Height correlation only lets more light through: ``G1 G1 <= G2 <= min G1`` (Heitz 2014)."""
    wo, wi = (o.spherical(rng.uniform(0.01, 1, 1000), rng.uniform(0, 6.28, 1000)) for _ in range(2))
    wm, alpha = o.normalize(wo + wi), rng.uniform(0.001, 1, 1000)
    g2 = o.smith_g2(wo, wi, wm, alpha)
    a, b = o.smith_g1(wo, wm, alpha), o.smith_g1(wi, wm, alpha)
    assert np.all(a * b <= g2 * (1 + EXACT)) and np.all(g2 <= np.minimum(a, b) * (1 + EXACT))


def test_specular_brdf_is_the_printed_visibility_form(rng: np.random.Generator) -> None:
    """``nu D`` with the square roots as glTF B.3.2 prints them equals the Lambda form."""
    wo, wi = (o.spherical(rng.uniform(0.01, 1, 1000), rng.uniform(0, 6.28, 1000)) for _ in range(2))
    a = rng.uniform(0.01, 1, 1000)
    nl, nv, nh = wi[:, 2], wo[:, 2], o.normalize(wo + wi)[:, 2]
    d = a**2 / (np.pi * (nh**2 * (a**2 - 1) + 1) ** 2)
    nu = 0.5 / (nv * np.sqrt(a**2 + (1 - a**2) * nl**2) + nl * np.sqrt(a**2 + (1 - a**2) * nv**2))
    assert o.specular_brdf(wo, wi, [1.0], a)[:, 0] == pytest.approx(nu * d, rel=1e-8)


def test_gltf_brdf_is_reciprocal_and_zero_below(rng: np.random.Generator) -> None:
    """``f(wo, wi) = f(wi, wo)``; nothing below the surface."""
    wo, wi = (o.spherical(rng.uniform(-1, 1, 1000), rng.uniform(0, 6.28, 1000)) for _ in range(2))
    args = (rng.random((1000, 3)), rng.random(1000), rng.random(1000))
    f = o.gltf_brdf(wo, wi, *args)
    assert f == pytest.approx(o.gltf_brdf(wi, wo, *args), rel=1e-10)
    below = (wo[:, 2] <= 0) | (wi[:, 2] <= 0)
    assert np.all(f[below] == 0) and np.all(f[~below] > 0)


def test_gltf_brdf_mixes_two_materials() -> None:
    """Normal incidence, white, half metal: 0.5 (1 - 0.04) of Lambert and F0 = 0.52 (glTF B.2)."""
    n, one = np.array([0.0, 0, 1]), np.ones(3)
    specular = o.specular_brdf(n, n, 0.52 * one, 1.0)
    diffuse = o.gltf_brdf(n, n, one, 0.5, 1.0) - specular
    assert np.pi * diffuse == pytest.approx(0.48)


@pytest.mark.slow
@pytest.mark.parametrize("cos_o, alpha, f0", [(1.0, 1.0, 1.0), (0.7, 0.5, 0.04), (0.2, 0.3, 1.0)])
def test_specular_albedo_by_quadrature(cos_o: float, alpha: float, f0: float) -> None:
    """Half-vector quadrature against scipy over incident directions."""
    wo = np.array([np.sqrt(1 - cos_o**2), 0.0, cos_o])

    def integrand(cos: float, phi: float) -> float:
        return float(o.specular_brdf(wo, o.spherical(cos, phi), [f0], alpha)[0] * cos)

    value, _ = integrate.nquad(
        integrand, [(1e-12, 1.0), (0.0, np.pi)], opts={"epsabs": 1e-7, "epsrel": 1e-7, "limit": 200}
    )
    assert o.specular_albedo(cos_o, alpha, f0) == pytest.approx(2 * value, abs=3e-5)


def test_diffuse_albedo_by_quadrature() -> None:
    """The ``1 - F(V . H)`` weighted Lambert base against scipy."""
    wo = np.array([0.8, 0.0, 0.6])

    def integrand(cos: float, phi: float) -> float:
        h = o.normalize(wo + o.spherical(cos, phi))
        return float((1 - o.schlick(0.04, wo @ h)) * cos / np.pi)

    assert o.diffuse_albedo(0.6, 0.04) == pytest.approx(hemisphere(integrand), abs=QUADRATURE)


def test_specular_furnace_never_exceeds_one() -> None:
    """With F0 = 1 the GGX lobe loses energy and never gains any (Heitz 2014)."""
    for roughness in (0.0, 0.1, 0.3, 0.6, 1.0):
        for cos_o in (1.0, 0.5, 0.1, 0.01):
            albedo = o.specular_albedo(cos_o, float(o.ggx_alpha(roughness)), 1.0, count=512)
            assert 0.3 < albedo <= 1.0 + QUADRATURE


@pytest.mark.parametrize(
    "roughness, cos_o, albedo",
    [
        (0.0, 1.0, 1.000),
        (0.0, 0.1, 1.547),
        (0.0, 0.01, 1.879),
        (0.3, 1.0, 1.000),
        (0.3, 0.5, 1.025),
        (0.3, 0.1, 1.284),
        (0.5, 0.5, 1.011),
        (0.5, 0.1, 1.110),
        (1.0, 0.5, 0.976),
        (1.0, 0.01, 1.013),
    ],
)
def test_white_dielectric_exceeds_one_at_grazing_angles(
    roughness: float, cos_o: float, albedo: float
) -> None:
    """The coupling ``(1 - F(V . H))`` of glTF gains energy at grazing angles, as its B.4 admits.

    A record of by how much; the values are quadratures of the specification, checked above.
    """
    assert o.gltf_albedo(cos_o, 1.0, 0.0, roughness) == pytest.approx(albedo, abs=1e-3)


# ------------------------------------------------------------------------- tone mapping


def test_reinhard() -> None:
    """Maps 0, 1, infinity to 0, 1/2, 1."""
    assert o.reinhard([0.0, 1.0, 3.0, 1e12]) == pytest.approx([0.0, 0.5, 0.75, 1.0])


def test_spline_of_zero_parameters_is_the_identity() -> None:
    """Zero raw numbers give equally spaced knots of slope 1 (nflows, identity init)."""
    x, y, slope = o.spline_knots(np.zeros(16))
    t = np.linspace(0, 1, 1001)
    f, df = o.spline(t, x, y, slope)
    assert x == pytest.approx(np.linspace(0, 1, 6)) and y == pytest.approx(x)
    assert (
        slope == pytest.approx(1.0)
        and f == pytest.approx(t, abs=EXACT)
        and df == pytest.approx(1.0)
    )


@pytest.mark.parametrize("scale", [0.3, 1.0, 3.0, 10.0])
def test_spline_is_monotone_smooth_and_pinned(rng: np.random.Generator, scale: float) -> None:
    """``f(0) = 0``, ``f(1) = 1``, knots and slopes are met, ``f'`` is the quotient."""
    for _ in range(10):
        x, y, slope = o.spline_knots(rng.normal(scale=scale, size=16))
        assert x[0] == y[0] == 0.0 and x[-1] == y[-1] == 1.0
        assert np.diff(x).min() >= 0.999e-3 and np.diff(y).min() >= 0.999e-3 and slope.min() >= 1e-3
        f, df = o.spline(x, x, y, slope)
        assert f == pytest.approx(y, abs=EXACT) and df == pytest.approx(slope, rel=1e-6)
        t = rng.uniform(0.0, 1.0, 200)
        h = 1e-8
        inside = np.abs(t[:, None] - x).min(axis=1) > 10 * h
        quotient = (o.spline(t + h, x, y, slope)[0] - o.spline(t - h, x, y, slope)[0]) / (2 * h)
        df = o.spline(t, x, y, slope)[1]
        assert np.all(df > 0)
        assert quotient[inside] == pytest.approx(df[inside], rel=1e-4, abs=1e-6)


# ------------------------------------------------------- fusion, regularisers, composite


def test_fuse_closed_form_is_the_printed_one(rng: np.random.Generator) -> None:
    """(S 1-3) in three steps equals one factor, which is at least ``2 sqrt 2 - 2``."""
    fg, shadow = np.exp(rng.normal(scale=3, size=(2, 8, 16, 3)))
    factor = o.fuse_factor(fg, shadow)
    assert fg * factor[..., None] == pytest.approx(o.fuse_literal(fg, shadow), rel=1e-11)
    assert factor.min() >= 2 * np.sqrt(2) - 2 - EXACT
    both = o.fuse(fg, shadow, 1.0)
    assert np.array_equal(both[0], both[1])
    assert np.array_equal(o.fuse(fg, shadow, 0.0)[0], fg)
    assert np.array_equal(o.fuse(fg, shadow, 0.0)[1], shadow)


def test_fuse_factor_attains_its_minimum_and_its_peak_value() -> None:
    """Least factor at ``S = (sqrt 2 - 1) F``, ``F = M``; at the peak ``(F^2 + S^2) / (F + S)``."""
    fg, shadow = np.full((1, 2, 3), 2.0), np.full((1, 2, 3), 2.0 * (np.sqrt(2) - 1))
    assert o.fuse_factor(fg, shadow) == pytest.approx(2 * np.sqrt(2) - 2, rel=EXACT)
    shadow[:] = 5.0
    fused = o.luminance(fg) * o.fuse_factor(fg, shadow)
    assert fused == pytest.approx((2.0**2 + 5.0**2) / 7.0)


def test_fuse_survives_black_texels() -> None:
    """No division by ``F``: dark foreground texels stay dark with the factor ``1 + S / M``."""
    fg, shadow = np.zeros((1, 3, 3)), np.zeros((1, 3, 3))
    fg[0, 0], shadow[0, 1] = 4.0, 8.0
    assert o.fuse_factor(fg, shadow) == pytest.approx(np.array([[1.0, 3.0, 1.0]]))


def test_consistency_is_a_cross_entropy(rng: np.random.Generator) -> None:
    """(M 10) of flat maps is ``log 4 pi``, ignores scale, and is least where both maps agree."""
    flat = np.ones((16, 32, 3))
    assert o.consistency(flat, flat) == pytest.approx(np.log(4 * np.pi), abs=1e-6)
    a, b = np.exp(rng.normal(size=(2, 16, 32, 3)))
    assert o.consistency(5 * a, 7 * b) == pytest.approx(o.consistency(a, b))
    assert o.consistency(b, b) < o.consistency(a, b)


def test_cauchy_of_a_flat_map() -> None:
    """(M 11) of ``L = 1`` is ``12 pi ln 3`` = 41.4."""
    assert o.cauchy(np.ones((8, 16, 3))) == pytest.approx(12 * np.pi * np.log(3), rel=EXACT)


def test_composite_and_encode(rng: np.random.Generator) -> None:
    """Coverage 0 leaves photo times ratio, coverage 1 the object (M 6); encode undoes ``x^2.2``."""
    photo, foreground, ratio = rng.random((3, 10, 3))
    assert np.array_equal(o.composite(photo, np.zeros(10), foreground, np.ones((10, 3))), photo)
    assert np.array_equal(o.composite(photo, np.ones(10), foreground, ratio), foreground)
    half = 0.5 * ratio * photo + 0.5 * foreground
    assert o.composite(photo, np.full(10, 0.5), foreground, ratio) == pytest.approx(half, rel=EXACT)
    assert o.encode(photo**2.2) == pytest.approx(photo, rel=EXACT)


# ----------------------------------------------------------------------- closed-form shadows


def sky_directions(count: int = 1500) -> np.ndarray:
    """Return directions above ``Y = 0`` of equal shares of its irradiance, midpoint rule."""
    cos2 = (np.arange(count) + 0.5) / count
    phi = 2 * np.pi * (np.arange(2 * count) + 0.5) / (2 * count)
    sin, cos = np.sqrt(1 - cos2)[:, None], np.sqrt(cos2)[:, None]
    return np.stack(np.broadcast_arrays(sin * np.cos(phi), cos, sin * np.sin(phi)), -1)


def sky_ratio(blocked: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the open share of a constant sky's irradiance on ``Y = 0``."""
    return float(1.0 - np.mean(blocked(sky_directions())))


@pytest.mark.parametrize("x", [-3.0, -0.4, 0.0, 0.7, 2.5])
def test_half_plane_shadow_by_quadrature(x: float) -> None:
    """Half-plane over a plane under a constant sky against counting directions."""
    value = sky_ratio(lambda d: x * d[..., 1] + 0.8 * d[..., 0] > 0)
    assert o.half_plane_ratio(x, 0.8) == pytest.approx(value, abs=1e-3)


def test_half_plane_shadow_under_lobes() -> None:
    """A flat lobe gives the constant sky's ratio, a narrow one 1 or 0, one on the edge 1/2."""
    axis = o.normalize([-0.5, 1.0, 0.3])
    assert o.half_plane_ratio_lobe(0.7, 0.8, axis, 1e-9) == pytest.approx(
        o.half_plane_ratio(0.7, 0.8)
    )
    assert o.half_plane_ratio_lobe(0.3, 1.0, axis, 3e3) == pytest.approx(1.0, abs=1e-4)
    assert o.half_plane_ratio_lobe(0.7, 1.0, axis, 3e3) == pytest.approx(0.0, abs=1e-4)
    assert o.half_plane_ratio_lobe(0.5, 1.0, axis, 3e3) == pytest.approx(0.5, abs=1e-2)


@pytest.mark.parametrize("sharpness, x", [(4.0, 0.2), (60.0, 0.55)])
def test_half_plane_lobe_by_quadrature(sharpness: float, x: float) -> None:
    """The lune quadrature against a weighted count of directions."""
    axis, d = o.normalize([-0.5, 1.0, 0.3]), sky_directions()
    lobe = np.exp(sharpness * (d @ axis - 1))
    value = np.sum(lobe * (x * d[..., 1] + d[..., 0] < 0)) / np.sum(lobe)
    assert o.half_plane_ratio_lobe(x, 1.0, axis, sharpness) == pytest.approx(value, abs=1e-3)


def test_rectangle_shadow() -> None:
    """Square occluder: against counting, and against the half-plane when it is huge."""
    x, z, height, half = 0.4, -0.3, 0.8, 1.5

    def blocked(d: np.ndarray) -> np.ndarray:
        t = height / d[..., 1]
        return (np.abs(x + t * d[..., 0]) < half) & (np.abs(z + t * d[..., 2]) < half)

    assert o.rectangle_ratio(x, z, height, half) == pytest.approx(sky_ratio(blocked), abs=1e-3)
    far = 1e5
    assert o.rectangle_ratio(0.6 - far, 0.0, 0.8, far) == pytest.approx(
        o.half_plane_ratio(0.6, 0.8), abs=1e-4
    )


@pytest.mark.parametrize("distance, height", [(0.0, 1.0), (0.0, 2.0), (1.0, 1.0), (3.0, 1.3)])
def test_sphere_shadow_by_quadrature(distance: float, height: float) -> None:
    """Sphere over a plane under a constant sky: ``1 - R^2 H / D^3``; black under a resting one."""
    centre = np.array([distance, height, 0.0])

    def blocked(d: np.ndarray) -> np.ndarray:
        along = d @ centre
        return (along > 0) & (along**2 > centre @ centre - 1.0)

    assert o.sphere_ratio(distance, height, 1.0) == pytest.approx(sky_ratio(blocked), abs=1e-3)


# ------------------------------------------------------------------------- the statistics


def test_chi_square_accepts_and_rejects(rng: np.random.Generator) -> None:
    """Uniform directions pass as uniform, fail as a wide lobe, and fail on one forbidden sample."""
    d = o.normalize(rng.normal(size=(50000, 3)))
    theta, phi = np.linspace(0, np.pi, 21), np.linspace(0, 2 * np.pi, 31)
    uniform = chi_square(d, lambda w: np.full(w.shape[:-1], 1 / (4 * np.pi)), theta, phi)
    assert uniform.passed and uniform.cell_count == 600
    assert not chi_square(d, lambda w: o.sg_pdf(w, UP, 0.3), theta, phi).passed
    upper = np.abs(d) * [1, 1, 1] * np.sign(d) ** [1, 1, 0]
    half = lambda w: (w[..., 2] > 0) / (2 * np.pi)  # noqa: E731
    theta = np.linspace(0, np.pi, 21)
    assert chi_square(upper, half, theta, phi).passed
    upper[7, 2] *= -1
    assert "density is 0" in chi_square(upper, half, theta, phi).reason


def test_chi_square_pools_small_cells() -> None:
    """Cells that expect fewer than 5 samples count as one, and a single giant cell is refused."""
    verdict = chi_square_counts([100, 100, 3, 2, 1], [100, 100, 2, 2, 2])
    assert verdict.passed and verdict.cell_count == 3
    assert not chi_square_counts([10], [10]).passed


def test_z_test_finds_a_shifted_image(rng: np.random.Generator) -> None:
    """Noise of the stated variance passes, a bias of many sigmas and a NaN do not."""
    mean, variance = rng.random((32, 32, 3)), np.full((32, 32, 3), 0.01)
    image = mean + rng.normal(scale=0.1, size=mean.shape)
    assert z_test(image, mean, variance).passed
    assert not z_test(image + 0.8, mean, variance).passed
    assert not z_test(np.full_like(mean, np.nan), mean, variance).passed
    assert z_test(mean, mean, np.zeros_like(mean)).passed


def test_compare_gradients_and_central_differences(rng: np.random.Generator) -> None:
    """A gradient 3 % too long has relative L2 and bias 0.03, cosine 1; a quadratic is exact."""
    x = rng.normal(size=(3, 4))
    gradient = central_differences(lambda a: float(np.sum(a**2)), x, 1e-4)
    match = compare_gradients(1.03 * gradient, 2 * x)
    assert match.relative_l2 == pytest.approx(0.03, abs=1e-6)
    assert match.cosine == pytest.approx(1.0) and match.signed_bias == pytest.approx(0.03, abs=1e-6)
