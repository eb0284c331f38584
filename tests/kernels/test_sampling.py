"""Frames, samplers and densities: chi-square against the papers, unbiased MIS."""

import tracemalloc

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import launch, upload
from benchmarks.stability.lobes import sample_kernel as lobe_kernel
from benchmarks.stability.maps import eval_kernel, sample_kernel
from tests import oracles as o
from tests.statistics import ChiSquare, chi_square, graded_edges
from warpir.kernels.maths.frame import basis, to_local, to_world
from warpir.kernels.sampling import cosine_sample, power_heuristic
from warpir.kernels.types import LightArgs
from warpir.render.device_light import PlaneLight, light_args
from warpir.scene.light import Light, Lobes, fibonacci

SAMPLE_COUNT = 200_000
"""Enough to see a fault of 2 % in a cell of 2 % of the mass; a million where marked slow."""
UNIT_ABS = 5e-7
"""Length of a float32 vector after a rotation: a few ulps of 1."""
PDF_RTOL = 1e-4
"""float32, few operations."""
Z_MAX = 4.0
"""Standard errors; 6e-5 per case at a fixed seed."""

wp.set_module_options({"enable_backward": False})


@wp.kernel
def frame_kernel(
    n: wp.array[wp.vec3],
    v: wp.array[wp.vec3],
    x: wp.array[wp.vec3],
    y: wp.array[wp.vec3],
    local: wp.array[wp.vec3],
    back: wp.array[wp.vec3],
):
    i = wp.tid()
    frame = basis(n[i])
    x[i] = frame.x
    y[i] = frame.y
    local[i] = to_local(v[i], frame)
    back[i] = to_world(local[i], frame)


@wp.kernel
def heuristic_kernel(a: wp.array[float], b: wp.array[float], weight: wp.array[float]):
    i = wp.tid()
    weight[i] = power_heuristic(a[i], b[i])


@wp.kernel
def cosine_kernel(u: wp.array[wp.vec2], wi: wp.array[wp.vec3]):
    i = wp.tid()
    wi[i] = cosine_sample(u[i])


def heuristic(a: np.ndarray, b: np.ndarray, device: str) -> np.ndarray:
    inputs = [upload(m, float, device) for m in (a, b)]
    return launch(heuristic_kernel, len(a), inputs, float, device=device)[0]


def draw_cosine(rng: np.random.Generator, device: str) -> np.ndarray:
    inputs = [uniform2(rng, SAMPLE_COUNT, device)]
    return launch(cosine_kernel, SAMPLE_COUNT, inputs, wp.vec3, device=device)[0]


def uniform2(rng: np.random.Generator, count: int, device: str) -> wp.array:
    return wp.array(rng.random((count, 2), dtype=np.float32), dtype=wp.vec2, device=device)


def draw_light(
    light: LightArgs, rng: np.random.Generator, device: str, count: int = SAMPLE_COUNT
) -> np.ndarray:
    inputs = [light, uniform2(rng, count, device)]
    return launch(sample_kernel, count, inputs, wp.vec3, device=device)[0]


def eval_light(light: LightArgs, wi: np.ndarray, device: str) -> tuple[np.ndarray, np.ndarray]:
    inputs = [light, upload(wi.reshape(-1, 3), wp.vec3, device)]
    radiance, pdf = launch(eval_kernel, wi.size // 3, inputs, wp.vec3, float, device=device)
    return radiance.reshape(wi.shape), pdf.reshape(wi.shape[:-1])


def some_lobes() -> Lobes:
    """Three lobes: a wide sky, a lamp, a sun."""
    return Lobes(
        np.array([[0.5, 0.6, 0.9], [8.0, 6.0, 3.0], [2e5, 1.9e5, 1.7e5]], np.float32),
        o.normalize([[0.0, 1.0, 0.0], [0.8, 0.3, -0.4], [-0.3, 0.6, 0.7]]).astype(np.float32),
        np.array([0.7, 40.0, 2e4], np.float32),
    )


def sun_map(height: int = 16, width: int = 32, row: int = 4) -> np.ndarray:
    """A smooth sky whose sun, one texel, is 1e5 times the mean of the others."""
    d = o.texel_direction(height, width)
    texels = (0.2 + 0.8 * np.maximum(d[..., 1:2], 0.0) + 0.1 * d[..., :1]) * [0.7, 0.8, 1.0]
    texels[row, 9] = 1e5 * texels.mean(axis=(0, 1))
    return texels.astype(np.float32)


# ------------------------------------------------------------------------------- frames


def test_frame_is_orthonormal_and_right_handed(device: str, rng: np.random.Generator) -> None:
    """Any unit normal, both poles and their neighbours too, gets a rotation (Duff et al. 2017)."""
    n = o.normalize(rng.normal(size=(5000, 3)))
    n[:8] = o.normalize(
        [
            [0, 0, 1],
            [0, 0, -1],
            [1e-4, 0, -1],
            [0, -1e-4, -1],
            [1, 0, 0],
            [1, 0, -1e-7],
            [0, 1, 1e-7],
            [1e-6, 1e-6, -1],
        ]
    )
    v = o.normalize(rng.normal(size=(5000, 3)))
    inputs = [upload(n, wp.vec3, device), upload(v, wp.vec3, device)]
    x, y, local, back = launch(frame_kernel, len(n), inputs, *[wp.vec3] * 4, device=device)
    frame = np.stack([x, y, n], axis=-1)
    # Next to -Z the construction divides by 1 + z, so an ulp of z costs about 1e-6.
    assert np.abs(np.swapaxes(frame, 1, 2) @ frame - np.eye(3)).max() < 2e-6
    assert np.abs(np.linalg.det(frame) - 1.0).max() < 4e-6
    assert np.abs(back - v).max() < 4e-6
    assert np.abs(local[:, 2] - o.dot(n, v)).max() < UNIT_ABS


# ------------------------------------------------------------------------- power heuristic


def test_power_heuristic(device: str) -> None:
    """``a^2 / (a^2 + b^2)`` (Veach 1997), without overflow; weights of a pair sum to 1."""
    values = np.array([0.0, 1e-30, 1e-6, 0.3, 1.0, 7.0, 1e8, 1e25, 3e38], np.float32)
    a, b = (m.ravel() for m in np.meshgrid(values, values))
    a64, b64 = a.astype(np.float64), b.astype(np.float64)
    used = (a > 0) | (b > 0)
    expected = np.divide(a64**2, a64**2 + b64**2, out=np.zeros_like(a64), where=used)
    weight = heuristic(a, b, device)
    assert weight == pytest.approx(expected, abs=1e-6)
    assert (weight + heuristic(b, a, device))[used] == pytest.approx(1.0, abs=1e-6)


# ------------------------------------------------------------------------------ samplers


def test_cosine_sample(device: str, rng: np.random.Generator) -> None:
    """Directions follow ``cos / pi`` and never point below the surface."""
    d = draw_cosine(rng, device)
    assert np.abs(np.linalg.norm(d, axis=-1) - 1.0).max() < UNIT_ABS
    theta = np.linspace(0.0, np.pi, 41)
    verdict = chi_square(d, o.cosine_pdf, theta, np.linspace(-np.pi, np.pi, 33))
    assert verdict.passed, verdict


LOBE_SHARPNESS = [1e-3, 0.03, 1.0, 20.0, 1e3, 2e4, 1e5, 1e6]
LOBE_AXES = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [0.48, -0.6, 0.64]]


def lobe_verdict(wi: np.ndarray, axis: np.ndarray, sharpness: float, case_count: int) -> ChiSquare:
    """Compare samples with one lobe on rings about its axis that widen from its core outwards."""
    theta = graded_edges(0.0, min(1.0, 1.5 / np.sqrt(sharpness)), 0.0, np.pi, 48)
    return chi_square(
        wi,
        lambda d: o.sg_pdf(d, axis, sharpness),
        theta,
        np.linspace(-np.pi, np.pi, 25),
        frame=o.frame_of(axis),
        case_count=case_count,
        order=10,
    )


def draw_lobe(
    axis: np.ndarray, sharpness: float, rng: np.random.Generator, device: str, count: int
) -> np.ndarray:
    inputs = [uniform2(rng, count, device), wp.vec3(*map(float, axis)), sharpness]
    return launch(lobe_kernel, count, inputs, wp.vec3, device=device)[0]


@pytest.mark.parametrize("sharpness", LOBE_SHARPNESS)
def test_lobe_sample(device: str, rng: np.random.Generator, sharpness: float) -> None:
    """Directions follow the von Mises-Fisher density from a flat sky to a sun."""
    axis = o.normalize(LOBE_AXES[3]).astype(np.float32)
    d = draw_lobe(axis, sharpness, rng, device, SAMPLE_COUNT)
    assert np.abs(np.linalg.norm(d, axis=-1) - 1.0).max() < UNIT_ABS
    verdict = lobe_verdict(d, o.normalize(axis), sharpness, len(LOBE_SHARPNESS))
    assert verdict.passed, verdict


@pytest.mark.slow
@pytest.mark.parametrize("axis", LOBE_AXES)
@pytest.mark.parametrize("sharpness", LOBE_SHARPNESS)
def test_lobe_sample_million(
    device: str, rng: np.random.Generator, sharpness: float, axis: list[float]
) -> None:
    """The same with a million samples, along the frame's special directions too."""
    unit = o.normalize(axis).astype(np.float32)
    d = draw_lobe(unit, sharpness, rng, device, 1_000_000)
    verdict = lobe_verdict(d, o.normalize(unit), sharpness, len(LOBE_SHARPNESS) * len(LOBE_AXES))
    assert verdict.passed, verdict


# --------------------------------------------------------------------------- light: values


def test_light_radiance_is_lobes_plus_map(device: str, rng: np.random.Generator) -> None:
    """Radiance is the sum of (M 2) and the bilinear map."""
    lobes, texels = some_lobes(), sun_map()
    light = light_args(Light(lobes, texels), wp.get_device(device))
    wi = o.normalize(rng.normal(size=(20000, 3))).astype(np.float32)
    radiance, _ = eval_light(light, wi, device)
    expected = o.sg_radiance(wi, lobes.amplitude, lobes.axis, lobes.sharpness)
    expected += o.bilinear_lookup(texels, o.latlong_uv(wi))
    # Next to the sun an ulp of u * width changes the lookup by 1e-6 of the sun.
    np.testing.assert_allclose(radiance, expected, rtol=PDF_RTOL, atol=4e-6 * float(texels.max()))


# --------------------------------------------------------------------- light: sampling


def map_verdict(
    wi: np.ndarray, light: LightArgs, device: str, height: int, width: int, case_count: int
) -> ChiSquare:
    """Compare samples with the kernel's density on cells that follow the map's half texels."""
    # About +Y with azimuth from +Z toward +X, so that cells align with the map's grid.
    frame = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    theta = np.linspace(0.0, np.pi, 2 * height + 1)
    phi = np.linspace(-np.pi, np.pi, 2 * width + 1)
    return chi_square(
        wi, lambda d: eval_light(light, d, device)[1], theta, phi, frame, case_count=case_count
    )


@pytest.mark.parametrize("row", [0, 4, 15])
def test_map_sample_with_a_sun(device: str, rng: np.random.Generator, row: int) -> None:
    """A sun texel of 1e5 times the mean is drawn by its bilinear tent, next to the poles too."""
    light = light_args(Light(None, sun_map(row=row)), wp.get_device(device))
    verdict = map_verdict(draw_light(light, rng, device), light, device, 16, 32, 6)
    assert verdict.passed, verdict


@pytest.mark.parametrize("kind", ["flat", "black", "one texel"])
def test_map_sample_of_odd_maps(device: str, rng: np.random.Generator, kind: str) -> None:
    """Flat, black and all but black maps are sampled as their density says."""
    texels = np.zeros((7, 12, 3), np.float32)
    if kind == "flat":
        texels += 3.0
    elif kind == "one texel":
        texels[3, 11] = 1.0
    light = light_args(Light(None, texels), wp.get_device(device))
    if kind == "black":
        light.map_prob = 1.0
    verdict = map_verdict(draw_light(light, rng, device), light, device, 7, 12, 6)
    assert verdict.passed, verdict


def test_map_density_is_proportional_to_luminance(device: str, rng: np.random.Generator) -> None:
    """At texel centres the density of each part is luminance over flux, as d_omega interpolates."""
    texels = sun_map(64, 128, row=20)
    light = light_args(Light(None, texels), wp.get_device(device))
    d = o.texel_direction(64, 128)
    _, pdf = eval_light(light, d, device)
    shining = o.luminance(texels)
    flux = shining * o.texel_solid_angle(64, 128)[:, None]
    is_sun = shining == shining.max()
    for part, prob in ((is_sun, light.bright_prob), (~is_sun, 1.0 - light.bright_prob)):
        expected = np.where(part, prob * shining / flux[part].sum(), pdf)
        assert np.all(np.abs(pdf / expected - 1.0)[2:-2] < 2e-3)


def test_light_sample_of_a_mixture(device: str, rng: np.random.Generator) -> None:
    """Lobes and a map together: three lobes of sharpness 0.7 to 2e4 over a sky with a sun."""
    lobes = some_lobes()
    light = light_args(Light(lobes, sun_map()), wp.get_device(device))
    wi = draw_light(light, rng, device)
    frame = o.frame_of(lobes.axis[2])
    theta = graded_edges(0.0, 0.01, 0.0, np.pi, 60)
    verdict = chi_square(
        wi,
        lambda d: eval_light(light, d, device)[1],
        theta,
        np.linspace(-np.pi, np.pi, 49),
        frame,
        order=24,
    )
    assert verdict.passed, verdict


def test_a_large_map_is_proposed_in_little_memory() -> None:
    """Its tables are float32, 12 bytes a texel; what lies between is float64, for a band of it."""
    texels = np.ones((1024, 2048, 3), np.float32)
    tracemalloc.start()
    try:
        light = light_args(Light(texels=texels), wp.get_device("cpu"))
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        PlaneLight(np.array([0.0, 1.0, 0.0])).of(light)
        peak = tracemalloc.get_traced_memory()[1] - before
    finally:
        tracemalloc.stop()
    assert peak < 24 * texels[..., 0].size, "bytes a texel: 81 with tables in float64"


def on_half_texels(order: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return directions, shape [theta, phi, 3], and their weights [sr] along either axis."""
    theta, weight_t = o.gauss_legendre(np.linspace(0, np.pi, 33), order)
    phi, weight_p = o.gauss_legendre(np.linspace(-np.pi, np.pi, 65), order)
    x, y, z = np.sin(theta)[:, None] * np.sin(phi), np.cos(theta)[:, None], np.sin(theta)[:, None]
    d = np.stack(np.broadcast_arrays(x, y, z * np.cos(phi)), axis=-1)
    return d, weight_t * np.sin(theta), weight_p


def test_light_density_integrates_to_one(device: str) -> None:
    """The mixture's density is one, by quadrature on the map's half texels without the sun lobe."""
    lobes = some_lobes()
    lobes = Lobes(lobes.amplitude[:2], lobes.axis[:2], lobes.sharpness[:2])
    light = light_args(Light(lobes, sun_map()), wp.get_device(device))
    d, weight_t, weight_p = on_half_texels(8)
    _, pdf = eval_light(light, d, device)
    assert weight_t @ pdf @ weight_p == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("count", [2, 9, 10, 11, 40])
@pytest.mark.parametrize("has_map", [False, True], ids=["lobes", "map too"])
def test_every_part_of_a_light_is_drawn(device: str, count: int, has_map: bool) -> None:
    """Lobes alike, whose shares all round up: none has probability 0, and all have 1 together."""
    axes = fibonacci(count).astype(np.float32)
    lobes = Lobes(np.ones((count, 3), np.float32), axes, np.full(count, 50.0, np.float32))
    for strongest in (1.0, 3.0):
        lobes.amplitude[0] = strongest
        light = light_args(Light(lobes, sun_map() if has_map else None), wp.get_device(device))
        each = light.lobe_prob.numpy()
        assert (each > 0.0).all()
        assert each.sum() + light.map_prob == pytest.approx(1.0, abs=1e-6)
        assert has_map == (light.map_prob > 0.0)


# --------------------------------------------------------------------------------- MIS


@pytest.mark.parametrize("kind", ["lobes", "map", "both"])
def test_mis_irradiance_is_unbiased(device: str, rng: np.random.Generator, kind: str) -> None:
    """Light and cosine samples with power-heuristic weights give the plane's irradiance.

    Truth: lobes by the ring quadrature, the map by Gauss-Legendre on its half texels.
    """
    lobes = some_lobes() if kind != "map" else None
    texels = sun_map() if kind != "lobes" else None
    light = light_args(Light(lobes, texels), wp.get_device(device))
    n = o.normalize([0.2, 1.0, 0.1])
    truth = np.zeros(3)
    if lobes is not None:
        for amplitude, axis, sharpness in zip(
            lobes.amplitude, lobes.axis, lobes.sharpness, strict=True
        ):
            truth += amplitude * o.sg_irradiance(n, axis, float(sharpness))
    if texels is not None:
        d, weight_t, weight_p = on_half_texels(24)
        value = o.bilinear_lookup(texels, o.latlong_uv(d)) * np.maximum(0.0, d @ n)[..., None]
        truth += np.einsum("t,tpc,p->c", weight_t, value, weight_p)

    from_light = draw_light(light, rng, device)
    from_cosine = draw_cosine(rng, device) @ o.frame_of(n).T
    total = np.zeros((SAMPLE_COUNT, 3))
    for d, is_light in ((from_light, True), (from_cosine, False)):
        radiance, pdf_light = eval_light(light, d, device)
        cos = np.maximum(0.0, d @ n)
        pdf_cosine = cos / np.pi
        own, other = (pdf_light, pdf_cosine) if is_light else (pdf_cosine, pdf_light)
        weight = heuristic(own, other, device)
        factor = np.divide(weight * cos, own, out=np.zeros(SAMPLE_COUNT), where=own > 0)
        total += radiance * factor[:, None]
    error = total.std(axis=0) / np.sqrt(SAMPLE_COUNT)
    assert np.all(np.abs(total.mean(axis=0) - truth) < Z_MAX * error), (
        total.mean(axis=0),
        truth,
        error,
    )
    # The heuristic's point: no firefly, although the sun is 1e5 times the sky.
    assert np.all(error < 0.01 * truth)
