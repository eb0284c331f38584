"""The glTF metallic-roughness BRDF: values, sampling, energy, gradients."""

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.brdf import evaluate
from benchmarks.stability.case import launch, upload
from tests import oracles as o
from tests.statistics import chi_square, graded_edges
from warpir.kernels.bsdf import bsdf_f, bsdf_of, bsdf_sample
from warpir.kernels.types import Layers

VALUE_RTOL = 1e-4
"""float32, few operations."""
VALUE_ATOL = 1e-7
"""Below this a BRDF value [1/sr] contributes nothing."""
SAMPLE_COUNT = 100_000
"""Cells of the lobe's core hold a few hundred samples; a million where marked slow."""
FURNACE_MAX = 1.0 + 1e-4
"""float32 round-off of a mean of weights that are at most 1."""
Z_MAX = 4.0
"""Standard errors; 6e-5 per case at a fixed seed."""

ROUGHNESS = [0.0, 0.05, 0.15, 0.3, 0.6, 1.0]
COS_O = [1.0, 0.7, 0.3, 0.1, 0.02]


@wp.kernel
def eval_kernel(
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    metallic: wp.array[float],
    roughness: wp.array[float],
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    pdf: wp.array[float],
    p_specular: wp.array[float],
):
    i = wp.tid()
    bsdf = bsdf_of(wo[i], base_color[i], metallic[i], roughness[i], Layers())
    value = bsdf_f(bsdf, wi[i])
    diffuse[i] = value.diffuse
    specular[i] = value.specular
    pdf[i] = value.pdf
    p_specular[i] = bsdf.p[1]


@wp.kernel
def sample_kernel(
    wo: wp.vec3,
    u: wp.array[wp.vec2],
    u_lobe: wp.array[float],
    base_color: wp.vec3,
    metallic: float,
    roughness: float,
    wi: wp.array[wp.vec3],
):
    i = wp.tid()
    wi[i] = bsdf_sample(bsdf_of(wo, base_color, metallic, roughness, Layers()), u[i], u_lobe[i])


OUTPUTS = (wp.vec3, wp.vec3, float, float)


class Case:
    """Directions and materials, one row each, as float32 arrays."""

    def __init__(
        self,
        wo: np.ndarray,
        wi: np.ndarray,
        base_color: np.typing.ArrayLike = 1.0,
        metallic: np.typing.ArrayLike = 0.0,
        roughness: np.typing.ArrayLike = 0.5,
    ) -> None:
        wo, wi = np.broadcast_arrays(np.asarray(wo, np.float32), np.asarray(wi, np.float32))
        self.wo, self.wi = wo.reshape(-1, 3), wi.reshape(-1, 3)
        count = len(self.wo)
        self.base_color = np.broadcast_to(np.asarray(base_color, np.float32), (count, 3))
        self.metallic = np.broadcast_to(np.asarray(metallic, np.float32), (count,))
        self.roughness = np.broadcast_to(np.asarray(roughness, np.float32), (count,))

    def arrays(self, device: str, requires_grad: bool = False) -> list[wp.array]:
        return [
            upload(self.wo, wp.vec3, device),
            upload(self.wi, wp.vec3, device),
            upload(self.base_color, wp.vec3, device, requires_grad),
            upload(self.metallic, float, device, requires_grad),
            upload(self.roughness, float, device, requires_grad),
        ]

    def evaluate(self, device: str) -> list[np.ndarray]:
        """Return diffuse and specular, [row, 3], density and probability of the specular lobe."""
        return launch(eval_kernel, len(self.wo), self.arrays(device), *OUTPUTS, device=device)

    def oracle(self) -> np.ndarray:
        """Return the specification's value, shape [row, 3]."""
        return o.gltf_brdf(self.wo, self.wi, self.base_color, self.metallic, self.roughness)


def outgoing(cos_o: float, phi: float = 0.0) -> np.ndarray:
    """Return a unit float32 direction toward the camera at azimuth ``phi``."""
    return o.spherical(cos_o, phi).astype(np.float32)


def draw(
    wo: np.ndarray,
    base_color: float,
    metallic: float,
    roughness: float,
    rng: np.random.Generator,
    device: str,
    count: int = SAMPLE_COUNT,
) -> np.ndarray:
    u = upload(rng.random((count, 2), dtype=np.float32), wp.vec2, device)
    u_lobe = upload(rng.random(count, dtype=np.float32), float, device)
    inputs = [wp.vec3(*map(float, wo)), u, u_lobe, wp.vec3(base_color), metallic, roughness]
    return launch(sample_kernel, count, inputs, wp.vec3, device=device)[0]


def random_case(rng: np.random.Generator, count: int, cos_min: float = 1e-3) -> Case:
    """Random directions above the surface, a third of them near the mirror direction."""
    wo = o.spherical(np.exp(rng.uniform(np.log(cos_min), 0.0, count)), rng.uniform(0, 6.28, count))
    wi = o.spherical(np.exp(rng.uniform(np.log(cos_min), 0.0, count)), rng.uniform(0, 6.28, count))
    roughness = rng.random(count)
    near = slice(0, count // 3)
    mirror = wo[near] * [-1, -1, 1] + 0.5 * roughness[near, None] ** 2 * rng.normal(
        size=(count // 3, 3)
    )
    wi[near] = o.normalize(np.stack([mirror[:, 0], mirror[:, 1], np.abs(mirror[:, 2])], axis=-1))
    return Case(wo, wi, rng.random((count, 3)), rng.random(count), roughness)


# ------------------------------------------------------------------------------- values


def test_brdf_matches_oracle(device: str, rng: np.random.Generator) -> None:
    """Diffuse plus specular is glTF's mix for any material, also at grazing angles."""
    case = random_case(rng, 30000)
    diffuse, specular, *_ = case.evaluate(device)
    np.testing.assert_allclose(diffuse + specular, case.oracle(), rtol=VALUE_RTOL, atol=VALUE_ATOL)


def test_brdf_parts(device: str, rng: np.random.Generator) -> None:
    """The split is the specification's: what the dielectric's Fresnel term leaves is diffuse."""
    case = random_case(rng, 5000)
    diffuse, specular, *_ = case.evaluate(device)
    f0 = (
        o.DIELECTRIC_F0
        + (case.base_color.astype(np.float64) - o.DIELECTRIC_F0) * case.metallic[:, None]
    )
    expected = o.specular_brdf(case.wo, case.wi, f0, o.ggx_alpha(case.roughness))
    np.testing.assert_allclose(specular, expected, rtol=VALUE_RTOL, atol=VALUE_ATOL)
    above = (case.wo[:, 2] > 0.0) & (case.wi[:, 2] > 0.0)
    fresnel = o.schlick(o.DIELECTRIC_F0, o.dot(case.wo, o.normalize(case.wo + case.wi)))
    share = np.where(above, (1.0 - case.metallic) * (1.0 - fresnel) / np.pi, 0.0)
    expected = share[:, None] * case.base_color
    np.testing.assert_allclose(diffuse, expected, rtol=VALUE_RTOL, atol=VALUE_ATOL)


@pytest.mark.parametrize("cos_min", [1e-12, 1e-18, 1e-30])
def test_brdf_is_finite_at_extreme_angles(device: str, cos_min: float) -> None:
    """Grazing and retro directions, down to any positive cosine, give finite values >= 0."""
    cos = np.array([1.0, 0.5, 1e-2, 1e-4, 1e-6, cos_min], np.float32)
    wo, wi = (a.ravel() for a in np.meshgrid(cos, cos))
    for phi in (0.0, np.pi, 1.0):
        for roughness in (0.0, 0.5, 1.0):
            case = Case(o.spherical(wo, 0.0), o.spherical(wi, phi), 1.0, 0.5, roughness)
            for values in case.evaluate(device)[:3]:
                assert np.all(np.isfinite(values)) and np.all(values >= 0.0)


# ------------------------------------------------------------------------------ sampling


def test_brdf_pdf_matches_oracle(device: str, rng: np.random.Generator) -> None:
    """A mix of visible-normal reflection (Heitz 2018) and the cosine, with a proper probability."""
    case = random_case(rng, 20000)
    _, _, pdf, p = case.evaluate(device)
    assert p.min() > 0.0 and p.max() <= 1.0
    expected = p * o.vndf_reflection_pdf(case.wo, case.wi, o.ggx_alpha(case.roughness))
    expected += (1.0 - p) * o.cosine_pdf(case.wi)
    np.testing.assert_allclose(pdf, expected, rtol=VALUE_RTOL, atol=VALUE_ATOL)


def check_sampling(
    device: str,
    rng: np.random.Generator,
    metallic: float,
    roughness: float,
    cos_o: float,
    count: int,
    case_count: int,
) -> None:
    """Compare samples with the oracle's density on cells graded toward the mirror direction."""
    # The camera's azimuth is a general one; cells are taken about the mirror direction's.
    wo = outgoing(cos_o, 0.8)
    wi = draw(wo, 0.7, metallic, roughness, rng, device, count)
    p = Case(wo[None], wo[None], 0.7, metallic, roughness).evaluate(device)[3]
    alpha = float(o.ggx_alpha(roughness))

    def pdf(d: np.ndarray) -> np.ndarray:
        value = p[0] * o.vndf_reflection_pdf(wo, d, alpha) + (1.0 - p[0]) * o.cosine_pdf(d)
        return np.where(d[..., 2] > 0.0, value, 0.0)

    theta_o = float(np.arccos(cos_o))
    sin_o = max(np.sin(theta_o), alpha)
    theta = graded_edges(theta_o, 2 * alpha, 0.0, 0.5 * np.pi, 40)
    phi = (
        0.8
        + np.pi
        + graded_edges(0.0, min(2 * alpha * max(cos_o, 0.1) / sin_o, 1.5), -np.pi, np.pi, 40)
    )
    # Below the horizon the renderer drops samples: they are the cell that the density lacks.
    above = wi[wi[:, 2] > 0.0]
    verdict = chi_square(
        above, pdf, theta, phi, sample_count=count, case_count=case_count, order=12
    )
    assert verdict.passed, verdict


@pytest.mark.parametrize("metallic", [1.0, 0.2])
@pytest.mark.parametrize(
    "roughness, cos_o",
    [(0.0, 0.7), (0.05, 0.3), (0.15, 0.02), (0.3, 1.0), (0.6, 0.1), (1.0, 0.7), (1.0, 0.02)],
)
def test_brdf_sample(
    device: str, rng: np.random.Generator, metallic: float, roughness: float, cos_o: float
) -> None:
    """Samples follow the density, for a metal and for a mix, from mirror to rough and grazing."""
    check_sampling(device, rng, metallic, roughness, cos_o, SAMPLE_COUNT, 14)


@pytest.mark.slow
@pytest.mark.parametrize("metallic", [1.0, 0.5, 0.0])
@pytest.mark.parametrize("cos_o", COS_O)
@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_brdf_sample_million(
    device: str, rng: np.random.Generator, metallic: float, roughness: float, cos_o: float
) -> None:
    """The same over the whole grid with a million samples."""
    check_sampling(
        device, rng, metallic, roughness, cos_o, 1_000_000, 3 * len(COS_O) * len(ROUGHNESS)
    )


# ------------------------------------------------------------------------------- furnace


def albedo_samples(
    device: str,
    rng: np.random.Generator,
    cos_o: float,
    metallic: float,
    roughness: float,
    base: float,
) -> np.ndarray:
    """Return one estimate ``f cos / pdf`` of the directional albedo per sample."""
    wo = outgoing(cos_o)
    wi = draw(wo, base, metallic, roughness, rng, device)
    diffuse, specular, pdf, _ = Case(wo, wi, base, metallic, roughness).evaluate(device)
    value = (diffuse + specular)[:, 0] * np.maximum(wi[:, 2], 0.0)
    return np.divide(value, pdf, out=np.zeros_like(value), where=pdf > 0.0)


@pytest.mark.parametrize("roughness", ROUGHNESS)
def test_specular_furnace(device: str, rng: np.random.Generator, roughness: float) -> None:
    """A white metal (F0 = 1) reflects at most what it receives, sample by sample, at every angle.

    With F = 1 a visible-normal sample weighs ``G2 / G1 <= 1`` (Heitz 2018); the mean is the
    oracle's directional albedo.
    """
    for cos_o in COS_O:
        weight = albedo_samples(device, rng, cos_o, 1.0, roughness, 1.0)
        assert weight.max() <= 1.0 + VALUE_RTOL
        assert weight.mean() <= FURNACE_MAX
        expected = o.specular_albedo(cos_o, float(o.ggx_alpha(roughness)), 1.0, count=512)
        assert weight.mean() == pytest.approx(
            expected, abs=Z_MAX * float(weight.std()) / 316 + 2e-4
        )


@pytest.mark.parametrize(
    "roughness, base", [(0.0, 1.0), (0.3, 1.0), (0.6, 1.0), (1.0, 1.0), (0.3, 0.5)]
)
def test_dielectric_albedo_is_the_specification_s(
    device: str, rng: np.random.Generator, roughness: float, base: float
) -> None:
    """Where glTF's coupling gains energy, at grazing angles, the kernel gains exactly as much."""
    for cos_o in (1.0, 0.5, 0.1, 0.02):
        weight = albedo_samples(device, rng, cos_o, 0.0, roughness, base)
        error = float(weight.std()) / np.sqrt(len(weight))
        expected = o.gltf_albedo(cos_o, base, 0.0, roughness)
        assert weight.mean() == pytest.approx(expected, abs=Z_MAX * error + 5e-4), (cos_o, expected)


@pytest.mark.parametrize("metallic", [0.0, 0.3, 1.0])
def test_sample_weights_are_bounded(device: str, rng: np.random.Generator, metallic: float) -> None:
    """No material gives a sample weight above 10: a lobe keeps a tenth of the samples."""
    for roughness in ROUGHNESS:
        for cos_o in COS_O:
            weight = albedo_samples(device, rng, cos_o, metallic, roughness, 0.9)
            assert weight.max() <= 10.0


# ------------------------------------------------------------------------------ gradients


def test_brdf_gradient_is_finite_everywhere(device: str) -> None:
    """Below the horizon, on it, at grazing and at roughness 0 the adjoints are finite numbers."""
    wo = np.array(
        [[0, 0, 1], [0.6, 0, 0.8], [0.6, 0, -0.8], [1, 0, 0], [1, 0, 1e-6], [0.6, 0, 0.8]], float
    )
    wi = np.array(
        [[0, 0, 1], [0.6, 0, -0.8], [-0.6, 0, 0.8], [0, 0, 1], [-1, 0, 1e-6], [-0.6, 0, 0.8]], float
    )
    rows = np.zeros(wo.shape), np.ones(len(wo)), np.zeros(len(wo))
    for gradient in evaluate(device, wo, wi, *rows)[2]:
        assert np.all(np.isfinite(gradient))
