"""glTF's material extensions in the BRDF: values, sampling, energy, gradients, sheen's table."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from benchmarks.stability.case import download, launch, upload
from tests import oracles as o
from tests.kernels.test_brdf import VALUE_ATOL, VALUE_RTOL, Z_MAX, Case, outgoing, random_case
from tests.oracles import LayeredMaterial
from tests.statistics import chi_square, compare_gradients
from warpir.kernels.bsdf import bsdf_f, bsdf_of, bsdf_sample, layers_toward
from warpir.kernels.maths.fresnel import film_fresnel
from warpir.kernels.types import Extensions, Layers
from warpir.scene.sheen import TABLE_SIZE, sheen_albedo_table

SAMPLE_COUNT = 50_000
GRADIENT_RELATIVE_L2 = 1e-3
"""float32 adjoint against central differences of the float64 oracle."""
TABLE_ERROR, TABLE_ERROR_ROUGH = 0.02, 0.004
"""Of the table read bilinearly, over all roughness and from 0.3 on, as its docstring states."""
TILTED = (0.28, -0.1, float(np.sqrt(1 - 0.28**2 - 0.1**2)))
MATERIALS = {
    "specular": LayeredMaterial(specular=0.6, specular_color=(0.9, 0.2, 3.0), ior=1.8),
    "mirror index": LayeredMaterial(ior=0.0, specular_color=(0.5, 0.3, 0.1)),
    "glass": LayeredMaterial(ior=1.3, transmission=0.7),
    "coat": LayeredMaterial(clearcoat=0.8, clearcoat_roughness=0.25, coat_n=TILTED),
    "lacquer": LayeredMaterial(clearcoat=1.0, clearcoat_roughness=0.03),
    "cloth": LayeredMaterial(sheen_color=(0.9, 0.3, 0.1), sheen_roughness=16 / 31),
    "brushed": LayeredMaterial(anisotropy=0.7, stretch=0.9),
    "film": LayeredMaterial(iridescence=0.8, film_ior=1.33, film_thickness=450.0),
    "oil": LayeredMaterial(iridescence=1.0, film_ior=1.7, film_thickness=180.0, specular=0.8),
    "all": LayeredMaterial(
        ior=1.7, specular=0.8, specular_color=(1.0, 0.7, 0.4), transmission=0.3, clearcoat=0.6,
        clearcoat_roughness=0.4, coat_n=TILTED, sheen_color=(0.2, 0.6, 0.4),
        sheen_roughness=22 / 31, anisotropy=0.5, stretch=-1.2, iridescence=0.6, film_ior=2.2,
    ),
}  # fmt: skip
COS_O = float((29 / (TABLE_SIZE - 1)) ** 4)
"""A node of the sheen's table, so that reading it adds no error; 0.77."""
WO = outgoing(COS_O, 0.4)


@wp.func
def layers_of(
    wo: wp.vec3,
    e: wp.array[Extensions],
    coat_n: wp.vec3,
    transmitted: float,
    table: wp.array2d[float],
) -> Layers:
    m = e[0]
    return layers_toward(
        wo,
        m.f0,
        m.specular,
        m.transmission,
        transmitted,
        m.sheen_color,
        m.sheen_roughness,
        table,
        m.clearcoat,
        m.clearcoat_roughness,
        coat_n,
        m.anisotropy,
        wp.vec3(m.stretch[0], m.stretch[1], 0.5),
        m.iridescence,
        m.film_ior,
        m.film_thickness,
    )


@wp.kernel
def eval_kernel(
    wo: wp.array[wp.vec3],
    wi: wp.array[wp.vec3],
    base_color: wp.array[wp.vec3],
    metallic: wp.array[float],
    roughness: wp.array[float],
    e: wp.array[Extensions],
    coat_n: wp.vec3,
    transmitted: float,
    table: wp.array2d[float],
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    pdf: wp.array[float],
    p: wp.array[wp.vec2],
):
    i = wp.tid()
    layers = layers_of(wo[i], e, coat_n, transmitted, table)
    bsdf = bsdf_of(wo[i], base_color[i], metallic[i], roughness[i], layers)
    value = bsdf_f(bsdf, wi[i])
    diffuse[i] = value.diffuse
    specular[i] = value.specular
    pdf[i] = value.pdf
    p[i] = bsdf.p


@wp.kernel(enable_backward=False)
def sample_kernel(
    wo: wp.vec3,
    u: wp.array[wp.vec3],
    e: wp.array[Extensions],
    coat_n: wp.vec3,
    table: wp.array2d[float],
    base_color: wp.vec3,
    metallic: float,
    roughness: float,
    wi: wp.array[wp.vec3],
):
    i = wp.tid()
    layers = layers_of(wo, e, coat_n, 0.0, table)
    pair = wp.vec2(u[i][0], u[i][1])
    wi[i] = bsdf_sample(bsdf_of(wo, base_color, metallic, roughness, layers), pair, u[i][2])


def extensions(layers: LayeredMaterial, device: str) -> wp.array:
    """The material as the kernels take it."""
    e = Extensions()
    e.present = 1
    f0 = ((1.0 - layers.ior) / (1.0 + layers.ior)) ** 2
    e.f0 = wp.vec3(*(f0 * c for c in layers.specular_color))
    e.sheen_color = wp.vec3(*layers.sheen_color)
    e.stretch = wp.vec2(np.cos(layers.stretch), np.sin(layers.stretch))
    for name in (
        "specular", "transmission", "clearcoat", "clearcoat_roughness", "sheen_roughness",
        "anisotropy", "iridescence", "film_ior", "film_thickness",
    ):  # fmt: skip
        setattr(e, name, getattr(layers, name))
    return wp.array([e], dtype=Extensions, device=device)


class Rows(Case):
    """Rows with layers, seen from one direction; a share ``transmitted`` of the rays passes."""

    def __init__(
        self,
        layers: LayeredMaterial,
        wi: np.ndarray,
        base_color: np.typing.ArrayLike = 0.5,
        metallic: np.typing.ArrayLike = 0.0,
        roughness: np.typing.ArrayLike = 0.5,
        wo: np.ndarray = WO,
    ) -> None:
        super().__init__(wo, wi, base_color, metallic, roughness)
        self.layers, self.transmitted = layers, 0.0

    def launch(self, device: str, free: bool = False) -> tuple[list[wp.array], list[wp.array]]:
        """Return base colour, metallic and roughness, and value, density and probabilities."""
        arrays = self.arrays(device, free)
        kinds = (wp.vec3, wp.vec3, float, wp.vec2)
        out = [wp.zeros(len(self.wi), dtype=k, device=device, requires_grad=free) for k in kinds]
        inputs = [
            *arrays,
            extensions(self.layers, device),
            wp.vec3(*self.layers.coat_n),
            self.transmitted,
            upload(sheen_albedo_table(), float, device),
        ]
        wp.launch(eval_kernel, len(self.wi), inputs=inputs, outputs=out, device=device)
        return arrays[2:], out

    def evaluate(self, device: str) -> list[np.ndarray]:
        """Return diffuse, specular, density and lobe probabilities."""
        return [download(a) for a in self.launch(device)[1]]

    def oracle(self) -> np.ndarray:
        """Return the specifications' value, shape [row, 3]."""
        base, coat = o.layered_brdf(
            self.wo[0], self.wi, self.base_color, self.metallic, self.roughness, self.layers
        )
        return base + coat


def random_rows(layers: LayeredMaterial, rng: np.random.Generator, count: int = 4000) -> Rows:
    case = random_case(rng, count, cos_min=0.01)
    # A third near the mirror direction of either normal
    for part, n in ((slice(0, count // 3), (0.0, 0.0, 1.0)), (slice(count // 3, None, 3), TILTED)):
        mirror = 2.0 * (WO @ np.asarray(n)) * np.asarray(n) - WO
        near = mirror + 0.1 * rng.normal(size=case.wi[part].shape)
        near[:, 2] = np.maximum(np.abs(near[:, 2]), 0.01)
        case.wi[part] = o.normalize(near)
    return Rows(layers, case.wi, case.base_color, case.metallic, case.roughness)


@pytest.mark.parametrize("name", MATERIALS)
def test_layers_match_oracle(device: str, rng: np.random.Generator, name: str) -> None:
    """Base, sheen and coat are those of the specifications for any metallic and roughness."""
    rows = random_rows(MATERIALS[name], rng)
    diffuse, specular, *_ = rows.evaluate(device)
    np.testing.assert_allclose(
        diffuse + specular, rows.oracle(), rtol=VALUE_RTOL, atol=1e-6 + VALUE_ATOL
    )


def test_layers_of_defaults_change_nothing(device: str, rng: np.random.Generator) -> None:
    """All extensions at their defaults are the plain model."""
    rows = random_rows(LayeredMaterial(), rng)
    diffuse, specular, *_ = rows.evaluate(device)
    expected = o.gltf_brdf(rows.wo, rows.wi, rows.base_color, rows.metallic, rows.roughness)
    np.testing.assert_allclose(diffuse + specular, expected, rtol=VALUE_RTOL, atol=VALUE_ATOL)


def test_rays_that_stop_stand_for_those_that_pass(device: str, rng: np.random.Generator) -> None:
    """Where a share of the rays passes, the others carry the whole of what is reflected."""
    rows = random_rows(MATERIALS["all"], rng, 300)
    whole = rows.evaluate(device)
    rows.transmitted = 0.75
    for some, all_of_it in zip(rows.evaluate(device)[:2], whole[:2], strict=True):
        np.testing.assert_allclose(some, 4.0 * all_of_it, rtol=1e-6)


def test_dielectric_extensions_are_reciprocal(device: str, rng: np.random.Generator) -> None:
    """``f(wo, wi) = f(wi, wo)`` with index, strength, colour, stretch and film of the base."""
    layers = replace(
        MATERIALS["specular"], transmission=0.4, anisotropy=0.8, stretch=0.5, iridescence=0.9
    )
    for _ in range(20):
        a, b = o.spherical(rng.uniform(0.1, 1.0, 2), rng.uniform(0.0, 6.28, 2)).astype(np.float32)
        there, back = (
            np.add(*Rows(layers, y[None], 0.6, 0.3, 0.4, x).evaluate(device)[:2])
            for x, y in ((a, b), (b, a))
        )
        np.testing.assert_allclose(there, back, rtol=2e-5)


def sample(
    layers: LayeredMaterial,
    wo: np.ndarray,
    base: tuple[tuple[float, float, float], float, float],
    device: str,
    rng: np.random.Generator,
) -> np.ndarray:
    """Draw `SAMPLE_COUNT` directions; ``base`` is its colour, metallic and roughness."""
    inputs = [
        wp.vec3(*map(float, wo)),
        upload(rng.random((SAMPLE_COUNT, 3)), wp.vec3, device),
        extensions(layers, device),
        wp.vec3(*layers.coat_n),
        upload(sheen_albedo_table(), float, device),
        wp.vec3(*base[0]),
        *base[1:],
    ]
    return launch(sample_kernel, SAMPLE_COUNT, inputs, wp.vec3, device=device)[0]


@pytest.mark.parametrize("cos_o", [COS_O, 0.25])
@pytest.mark.parametrize("name", ["coat", "cloth", "brushed", "all"])
def test_layers_sample(device: str, rng: np.random.Generator, name: str, cos_o: float) -> None:
    """Samples follow the density of coat, base and cosine, also beyond the coat's horizon."""
    layers, wo, color = MATERIALS[name], outgoing(cos_o, 0.4), (0.6, 0.4, 0.3)
    wi = sample(layers, wo, (color, 0.3, 0.4), device, rng)
    p = Rows(layers, wi[:1], color, 0.3, 0.4, wo).evaluate(device)[3][0]
    n = np.asarray(layers.coat_n)
    x = o.normalize(np.cross([0.0, 1.0, 0.0], n))
    frame = np.stack([x, np.cross(n, x), n], axis=-1)

    def pdf(d: np.ndarray) -> np.ndarray:
        alphas = o.stretch_alphas(0.4, layers.anisotropy)
        turned = (o.across_stretch(w, layers.stretch) for w in (wo, d))
        base = p[1] * o.stretch_reflection_pdf(*turned, *map(float, alphas))
        base = base + (1.0 - p[1]) * o.cosine_pdf(d)
        coat = o.vndf_reflection_pdf(
            wo @ frame, d @ frame, float(o.ggx_alpha(layers.clearcoat_roughness))
        )
        return np.where(d[..., 2] > 0.0, p[0] * coat + (1.0 - p[0]) * base, 0.0)

    above = wi[wi[:, 2] > 0.0]
    np.testing.assert_allclose(
        Rows(layers, above[:2000], color, 0.3, 0.4, wo).evaluate(device)[2],
        pdf(above[:2000].astype(np.float32)),
        rtol=1e-3,
    )
    verdict = chi_square(
        above,
        pdf,
        np.linspace(0.0, 0.5 * np.pi, 33),
        np.linspace(-np.pi, np.pi, 49),
        sample_count=SAMPLE_COUNT,
        case_count=6,
        order=10,
    )
    assert verdict.passed, verdict


@pytest.mark.parametrize("cos_o", [1.0, 0.5, 0.15])
@pytest.mark.parametrize("stretch", [0.0, 0.5 * np.pi, 1.1])
def test_brushed_white_metal(
    device: str, rng: np.random.Generator, stretch: float, cos_o: float
) -> None:
    """The lobe's density integrates to 1, and visible normals lose what a single bounce does."""
    layers, wo = LayeredMaterial(anisotropy=0.9, stretch=stretch), outgoing(cos_o)
    wi = sample(layers, wo, ((1.0,) * 3, 1.0, 0.5), device, rng)
    above = wi[wi[:, 2] > 0.0]
    _, specular, pdf, _ = Rows(layers, above, 1.0, 1.0, 0.5, wo).evaluate(device)
    weight = np.zeros(len(wi))
    weight[: len(above)] = specular[:, 1] * above[:, 2] / pdf
    assert weight.max() <= 1.0 + 1e-4
    error = float(weight.std()) / np.sqrt(len(weight))
    expected = albedo(layers, cos_o, 1.0, 1.0, device)
    assert expected <= 1.0 and weight.mean() == pytest.approx(expected, abs=Z_MAX * error + 1e-4)
    cosine, part = o.gauss_legendre(np.linspace(0, 1, 17) ** 2, 8)
    phi = 2 * np.pi * (np.arange(512) + 0.5) / 512
    rows = Rows(layers, o.spherical(cosine[:, None], phi).reshape(-1, 3), 1.0, 1.0, 0.5, wo)
    density = rows.evaluate(device)[2].reshape(-1, 512).mean(axis=1)
    share = len(above) / len(wi)
    error = np.sqrt(share * (1.0 - share) / len(wi))
    assert 2 * np.pi * density @ part == pytest.approx(share, abs=Z_MAX * error + 1e-4)


@wp.kernel
def film_kernel(
    f0: wp.array[wp.vec3],
    ior: wp.array[float],
    thickness: wp.array[float],
    cosine: wp.array[float],
    out: wp.array[wp.vec3],
):
    i = wp.tid()
    out[i] = film_fresnel(f0[i], ior[i], thickness[i], cosine[i])


def film(f0: np.ndarray, *numbers: np.ndarray, device: str) -> np.ndarray:
    """Return the kernel's reflectance of films; ``numbers`` are index, thickness and cosine."""
    rows = np.broadcast_arrays(*numbers, f0[..., 0])[:3]
    inputs = [upload(f0, wp.vec3, device), *(upload(a, float, device) for a in rows)]
    return launch(film_kernel, len(rows[0]), inputs, wp.vec3, device=device)[0]


def test_film_reflects_a_share(device: str, rng: np.random.Generator) -> None:
    """No film takes light away or adds any, whatever its index, thickness and base."""
    count = 20_000
    extremes = rng.choice([0.0, 0.04, 0.5, 1.0], (count, 3))
    thickness = 10.0 ** rng.uniform(-3.0, 5.0, count)
    found = film(
        extremes, 1.0 + rng.exponential(0.6, count), thickness, rng.random(count), device=device
    )
    assert np.isfinite(found).all() and found.min() >= 0.0 and found.max() <= 1.0


def test_thick_film_has_no_color(device: str) -> None:
    """Where the path is many wavelengths, the reflections of both surfaces add up as light does."""
    cosine = np.linspace(0.1, 1.0, 20)
    found = film(np.full((20, 3), 0.04), 1.33, 2e4, cosine, device=device)
    first = o.schlick((0.33 / 2.33) ** 2, cosine)
    inner = o.schlick((0.17 / 2.83) ** 2, np.sqrt(1.0 - (1.0 - cosine**2) / 1.33**2))
    # Mean over the phase of what two surfaces reflect between them
    expected = first + (1.0 - first) ** 2 * inner / (1.0 - first * inner)
    np.testing.assert_allclose(found, np.tile(expected[:, None], 3), rtol=2e-5)


def albedo(
    layers: LayeredMaterial, cos_o: float, base: float, metallic: float, device: str
) -> float:
    """Directional albedo of the green channel, by quadrature over the kernel's values."""
    cos_i, weight = o.gauss_legendre(np.linspace(0, 1, 17) ** 2, 8)
    phi = 2 * np.pi * (np.arange(256) + 0.5) / 256
    wi = o.spherical(cos_i[:, None], phi).reshape(-1, 3)
    rows = Rows(layers, wi, base, metallic, 0.5, outgoing(cos_o))
    value = np.add(*rows.evaluate(device)[:2])[:, 1].reshape(len(cos_i), 256).mean(axis=1)
    return float(2 * np.pi * np.sum(value * cos_i * weight))


@pytest.mark.parametrize("roughness", [0.33, 0.6, 1.0])
def test_white_cloth_returns_all_it_receives(device: str, roughness: float) -> None:
    """Sheen and what it leaves to a white Lambert base make 1, within the table's error."""
    cloth = LayeredMaterial(specular=0.0, sheen_color=(1.0,) * 3, sheen_roughness=roughness)
    for cos_o in (1.0, 0.6, 0.2, 0.05):
        found = albedo(cloth, cos_o, 1.0, 0.0, device)
        assert found == pytest.approx(1.0, abs=TABLE_ERROR_ROUGH + 1e-3)


def test_coat_over_white_metal_gains_nothing(device: str) -> None:
    """The coat's share is the base's loss: a coated white metal stays at or below 1."""
    coated = LayeredMaterial(clearcoat=1.0, clearcoat_roughness=0.5)
    for cos_o in (1.0, 0.6, 0.2, 0.05):
        bare = albedo(LayeredMaterial(), cos_o, 1.0, 1.0, device)
        found = albedo(coated, cos_o, 1.0, 1.0, device)
        # Both lobes are the same here, so the mixture is that lobe.
        assert found == pytest.approx(bare, rel=1e-4) and found <= 1.0 + 1e-4


def test_sheen_table_matches_its_integral(rng: np.random.Generator) -> None:
    """Read between its nodes, the table is as near the lobe's albedo as it says."""
    table = sheen_albedo_table()
    worst = np.zeros(2)
    for roughness in (0.02, 0.12, 0.21, 0.35, 0.52, 0.81, 0.98):
        for cos_o in (0.004, 0.03, 0.12, 0.33, 0.62, 0.95):
            x, y = cos_o**0.25 * (TABLE_SIZE - 1), roughness * (TABLE_SIZE - 1)
            j, i = int(x), int(y)
            a, b = x - j, y - i
            row = table[i : i + 2, j] * (1 - a) + table[i : i + 2, j + 1] * a
            error = abs(row @ [1 - b, b] - min(o.sheen_albedo(cos_o, roughness), 1.0))
            worst = np.maximum(worst, [error, error * (roughness >= 0.3)])
    assert worst[0] < TABLE_ERROR and worst[1] < TABLE_ERROR_ROUGH


def test_sheen_sample_weights_stay_bounded(device: str, rng: np.random.Generator) -> None:
    """Cosine samples estimate the sheen's albedo without fireflies at usual roughness."""
    cloth = LayeredMaterial(specular=0.0, sheen_color=(1.0,) * 3, sheen_roughness=0.5)
    u = rng.random((20000, 2))
    wi = o.spherical(np.sqrt(1.0 - u[:, 0]), 2.0 * np.pi * u[:, 1])
    rows = Rows(cloth, wi, 0.0, 0.0, 0.5, outgoing(0.3))
    diffuse, _, pdf, _ = rows.evaluate(device)
    weight = diffuse[:, 1] * wi[:, 2] / np.maximum(wi[:, 2] / np.pi, 1e-9)
    error = float(weight.std()) / np.sqrt(len(weight))
    assert weight.mean() == pytest.approx(o.sheen_albedo(0.3, 0.5), abs=Z_MAX * error)
    assert np.all(pdf > 0.0) and weight.max() < 10.0


def row_gradients(
    loss: Callable[..., np.ndarray], factors: dict[str, np.ndarray]
) -> Iterator[np.ndarray]:
    """Yield central differences of each row's loss by its own value of each factor."""
    h = 1e-5
    for name, value in factors.items():
        value = value.astype(np.float64)
        steps = h * (np.eye(3) if value.ndim == 2 else np.ones(1))
        columns = [loss(**{name: value + s}) - loss(**{name: value - s}) for s in steps]
        yield np.stack(columns, axis=-1).reshape(value.shape) / (2 * h)


@pytest.mark.parametrize("name", ["coat", "brushed", "film", "all"])
def test_layers_gradient(device: str, rng: np.random.Generator, name: str) -> None:
    """Adjoints of the base's factors below coat and sheen, against float64 central differences."""
    rows = random_rows(MATERIALS[name], rng, 240)
    rows.metallic = rng.uniform(0.05, 0.95, 240).astype(np.float32)
    rows.roughness = rng.uniform(0.15, 1.0, 240).astype(np.float32)
    y = rng.normal(size=(240, 3)).astype(np.float32)
    y /= (1.0 + rows.oracle().max(axis=1, keepdims=True)).astype(np.float32)
    with wp.Tape() as tape:
        factors, out = rows.launch(device, free=True)
    tape.backward(grads={a: upload(y, wp.vec3, device) for a in out[:2]})
    plain = {name: getattr(rows, name) for name in ("base_color", "metallic", "roughness")}

    def loss(**moved: np.ndarray) -> np.ndarray:
        base, coat = o.layered_brdf(rows.wo[0], rows.wi, layers=rows.layers, **{**plain, **moved})
        return np.asarray(np.sum((base + coat) * y, axis=1))

    for array, expected in zip(factors, row_gradients(loss, plain), strict=True):
        match = compare_gradients(array.grad.numpy(), expected)
        assert match.relative_l2 < GRADIENT_RELATIVE_L2, match
