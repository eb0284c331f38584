"""`transport` against `mis` on one map, its algebra, its gradients, its cache and its choices."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from tests.builders.shapes import all_pixels, box, camera, constant, ground, lobe, placed, sphere
from tests.oracles import gauss_legendre
from tests.statistics import compare_gradients, sidak, z_test
from warpir.core import cache as caches
from warpir.core.arrays import Float64Array, IntArray
from warpir.core.cache import take_notices
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.render.device_scene import Scene
from warpir.render.integrator import Radiance
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.renderer import Renderer
from warpir.render.transport import cache as transport_cache
from warpir.render.transport import matrix
from warpir.render.transport import rows as transport_rows
from warpir.render.transport.integrator import TransportIntegrator
from warpir.render.transport.matrix import DenseRows, product
from warpir.render.transport.rows import TransportSettings
from warpir.render.transport.tents import direction_counts, tent_irradiance, tent_solid_angles
from warpir.scene.asset import Material
from warpir.scene.light import Light, Lobes, as_map

HEIGHT = 12
SMALL = TransportSettings(
    height_fg=HEIGHT, height_shadow=HEIGHT, subsamples=8, paths=32, bright_directions=64
)
EXACT = replace(SMALL, dtype="float32")
TRACINGS, RUNS = 96, 16
"""Independent tracings of `transport` and runs of `mis` behind each variance."""
FLOOR = 2e-5
"""Added to the standard errors: events that few runs saw have no honest variance."""
BFLOAT16 = 2.0**-8
"""Largest relative rounding error of a bfloat16, of entries and of the product."""
COSINE, SIGNED_BIAS = 0.99, 0.01
"""Asked of `transport` against `mis` (same loss, same map)."""


def scene_of(
    device: str,
    roughness: tuple[float, float] = (0.3, 0.8),
    metallic: tuple[float, float] = (1.0, 0.0),
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0),
    size: tuple[int, int] = (24, 16),
) -> Renderer:
    """A ball and a box that see each other, on the ground, from above."""
    materials = (
        Material(base_color=(0.8, 0.6, 0.5), metallic=metallic[0], roughness=roughness[0]),
        Material(
            base_color=(0.5, 0.6, 0.8),
            metallic=metallic[1],
            roughness=roughness[1],
            emission=emission,
        ),
    )
    parts = sphere((0.0, 0.5, -4.0), 0.5), box((0.8, 0.4, -4.0), (0.4, 0.8, 0.4), material=1)
    view = camera(*size, 1.6 * size[0], (0.3, 1.5, 0.0), pitch=-14.0)
    return Renderer(Scene([placed(parts, *materials)], view, ground(0.0), device))


def pixels_of(renderer: Renderer) -> tuple[IntArray, IntArray]:
    """Object pixels, and those that the plane fills for the better part."""
    seen = renderer.gbuffer(0, spp=64)
    covered = seen.object_pixels[seen.coverage > 0.5]
    plane = np.setdiff1d(all_pixels(renderer.scene.camera), covered).astype(np.int32)
    return seen.object_pixels, plane


def lights(sun: float = 60.0) -> Lobes:
    """A sun and two broad lobes."""
    axis = np.array([[0.4, 0.7, 0.35], [-0.6, 0.5, -0.2], [0.1, 0.2, 0.9]])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    peak = np.array([[3.0, 2.6, 2.0], [0.4, 0.5, 0.9], [0.5, 0.4, 0.3]])
    peak[0] *= sun / 6.0
    sharpness = np.array([sun, 3.0, 8.0])
    return Lobes(*(a.astype(np.float32) for a in (peak, axis, sharpness)))


def test_transport_tents_share_out_the_sphere() -> None:
    """Solid angles of the tents sum to 4 pi and equal their quadrature, polar rows included."""
    for height in (4, 12, 64):
        rows = tent_solid_angles(height)
        assert rows.sum() * 2 * height == pytest.approx(4.0 * np.pi, rel=1e-12)
        step = np.pi / height
        edges = np.array([0.0, 0.5, 1.5, 2.5]) * step
        node, weight = gauss_legendre(edges, 12)
        polar = np.clip(1.5 - node / step, 0.0, 1.0)
        inner = np.clip(1.0 - np.abs(node / step - 1.5), 0.0, 1.0)
        for k, tent in ((0, polar), (1, inner)):
            truth = (tent * np.sin(node) * weight).sum() * step
            assert rows[k] == pytest.approx(truth, rel=1e-10), (height, k)


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.3, 0.8, -0.5)])
def test_transport_irradiance_of_the_open_plane(normal: tuple[float, float, float]) -> None:
    """Texels of a white sky sum to 1, and a map's irradiance is that of `Light.irradiance`."""
    n = np.array(normal) / np.linalg.norm(normal)
    weights = tent_irradiance(tuple(n), 16)
    assert weights.sum() == pytest.approx(1.0, abs=2e-6)
    texels = as_map(Light(lobes=lights(6.0)), 16).astype(np.float64)
    # The truth integrates the bilinear map on a grid of its own.
    fine = 16 * 40
    rows = (np.arange(fine) + 0.5) / 40 - 0.5
    low, part = np.floor(rows).astype(int), rows - np.floor(rows)
    by_row = (
        texels[np.clip(low, 0, 15)] * (1 - part)[:, None, None]
        + texels[np.clip(low + 1, 0, 15)] * part[:, None, None]
    )
    columns = (np.arange(2 * fine) + 0.5) / 40 - 0.5
    low, part = np.floor(columns).astype(int), columns - np.floor(columns)
    big = (
        by_row[:, low % 32] * (1 - part)[None, :, None]
        + by_row[:, (low + 1) % 32] * part[None, :, None]
    )
    cosine = np.maximum(map_directions(fine, 2 * fine) @ n, 0.0)
    cosine *= texel_solid_angles(fine, 2 * fine)[:, None] / np.pi
    truth = np.einsum("ij,ijc->c", cosine, big)
    assert np.einsum("ij,ijc->c", weights, texels) == pytest.approx(truth, rel=1e-5)


CASES = [
    # roughness, metallic, depth, sharpness of the sun
    ((0.3, 0.8), (1.0, 0.0), 1, 60.0),
    ((0.3, 0.8), (1.0, 0.0), 3, 60.0),
    ((0.05, 0.5), (1.0, 0.0), 3, 6.0),
    ((1.0, 1.0), (0.0, 0.0), 2, 6.0),
]


@pytest.mark.slow
@pytest.mark.parametrize(("roughness", "metallic", "depth", "sun"), CASES)
def test_transport_agrees_with_mis(
    device: str,
    roughness: tuple[float, float],
    metallic: tuple[float, float],
    depth: int,
    sun: float,
) -> None:
    """Object and plane have the expectation of `mis` under one map: pixels, and their sum."""
    own, other = both_ways(scene_of(device, roughness, metallic), depth, sun)
    check_equal(objects_of(own), objects_of(other), 2 * len(CASES))
    check_equal(ratios_of(own), ratios_of(other), 2 * len(CASES))


def both_ways(
    renderer: Renderer, depth: int, sun: float, runs: int = RUNS
) -> tuple[list[Radiance], list[Radiance]]:
    """Radiance under one light by rows of recorded directions, and by `mis`, of several seeds."""
    objects, proxies = pixels_of(renderer)
    light = Light(lobes=lights(sun))
    texels = torch.from_numpy(as_map(light, HEIGHT))
    own = [
        TransportIntegrator(renderer, objects, proxies, depth, EXACT, light, seed).radiance(
            texels, texels, 0
        )
        for seed in range(TRACINGS)
    ]
    reference = MisIntegrator(renderer, objects, proxies, spp=512, rays=1, depth=depth)
    other = [reference.radiance(texels, texels, 1000 + seed) for seed in range(runs)]
    return own, other


def check_equal(mine: Float64Array, theirs: Float64Array, tests: int, widened: float = 1.0) -> None:
    """Compare pixels of runs [run, pixel, 3], and their sum, which is one of several tests.

    The pixels of a run share drawn directions of the light, so that the sum's variance is that of
    the runs' sums, not the sum of variances. ``widened`` multiplies the variance of pixels: of few
    runs they have the outliers of a t distribution.
    """
    variance = sum(runs.var(axis=0, ddof=1) / len(runs) for runs in (mine, theirs))
    means = [runs.mean(axis=0) for runs in (mine, theirs)]
    assert z_test(*means, widened * variance + FLOOR**2).passed
    sums = [runs.sum(axis=(1, 2)) for runs in (mine, theirs)]
    total = stats.ttest_ind(*sums, equal_var=False)
    assert total.pvalue > sidak(0.01, tests), total


def objects_of(runs: list[Radiance]) -> Float64Array:
    """Radiance of the object's pixels, shape [run, pixel, 3]."""
    stack = np.stack([r.foreground.detach().cpu().numpy() for r in runs])
    return stack.astype(np.float64)


def ratios_of(runs: list[Radiance]) -> Float64Array:
    """Quotient of ``lit`` and ``unoccluded``, linearised about their means: [run, pixel, 3]."""
    lit, unoccluded = (
        np.stack([getattr(r, name).detach().cpu().numpy() for r in runs]).astype(np.float64)
        for name in ("lit", "unoccluded")
    )
    ratio = lit.mean(axis=0) / unoccluded.mean(axis=0)
    return ratio + (lit - ratio * unoccluded) / unoccluded.mean(axis=0)


def check_light_gradient(
    renderer: Renderer, depth: int, tracings: int, runs: int, *, of_object: bool
) -> None:
    """Compare direction and size of the light's gradient with that of `mis` on the same map."""
    objects, proxies = pixels_of(renderer)
    light = Light(lobes=lights())
    texels = torch.tensor(as_map(light, HEIGHT), requires_grad=True)
    rng = np.random.default_rng(3)
    weight_fg, weight_ratio = (
        torch.tensor(rng.uniform(0.5, 1.5, (len(pixels), 3)), dtype=torch.float32)
        for pixels in (objects, proxies)
    )

    def gradient(integrator: TransportIntegrator | MisIntegrator, seed: int) -> Float64Array:
        out = integrator.radiance(texels, texels, seed)
        ratio = out.lit / out.unoccluded.clamp(min=1e-6)
        loss = (ratio.cpu() * weight_ratio).sum()
        if of_object:
            loss = loss + (out.foreground.cpu() * weight_fg).sum()
        (d_texels,) = torch.autograd.grad(loss, texels)
        return d_texels.double().numpy()

    own = [
        gradient(TransportIntegrator(renderer, objects, proxies, depth, EXACT, light, s), 0)
        for s in range(tracings)
    ]
    reference = MisIntegrator(renderer, objects, proxies, spp=256, rays=1, depth=depth)
    theirs = [gradient(reference, s) for s in range(runs)]
    match = compare_gradients(np.mean(own, axis=0), np.mean(theirs, axis=0))
    assert match.cosine > COSINE and abs(match.signed_bias) < SIGNED_BIAS, match


@pytest.mark.slow
def test_transport_gradient_agrees_with_mis(device: str) -> None:
    """Of object and shadow ratio."""
    check_light_gradient(scene_of(device), 2, tracings=8, runs=16, of_object=True)


def check_map_gradient(loss: Callable[[torch.Tensor], torch.Tensor], lobes: Lobes) -> None:
    """Compare a loss's gradient by some texels of a map with central differences."""
    texels = torch.tensor(as_map(Light(lobes=lobes), HEIGHT), requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(texels), texels)
    picked = np.linspace(0, texels.numel() - 1, 48).astype(int)
    numeric, step = np.zeros(len(picked)), 0.05
    for k, index in enumerate(picked):
        sides = []
        for sign in (1.0, -1.0):
            moved = texels.detach().clone()
            moved.view(-1)[index] += sign * step
            sides.append(float(loss(moved)))
        numeric[k] = (sides[0] - sides[1]) / (2.0 * step)
    match = compare_gradients(gradient.reshape(-1)[picked].numpy(), numeric)
    assert match.relative_l2 < 0.02 and match.cosine > 0.999, match


def test_transport_gradient_matches_central_differences(device: str) -> None:
    """Gradients with respect to texels are those of the very function that radiance computes."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    made = TransportIntegrator(renderer, objects, proxies, 2, EXACT, Light(lobes=lights(20.0)))

    def loss(texels: torch.Tensor) -> torch.Tensor:
        out = made.radiance(texels, texels, 0)
        weight = torch.linspace(0.5, 1.5, 3)
        ratio = out.lit / out.unoccluded
        return ((out.foreground * weight).double() ** 2).sum() + (ratio.double() ** 3).sum()

    check_map_gradient(loss, lights(20.0))


def test_transport_adjoint_and_linearity(device: str) -> None:
    """``<T L, y> = <L, T^T y>`` and ``T (a L + b M) = a T L + b T M``, to float32 sums."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    made = TransportIntegrator(renderer, objects, proxies, 2, EXACT)
    rng = np.random.default_rng(1)
    for rows, columns, count in (
        (made.T_fg, 2 * HEIGHT * HEIGHT, len(objects)),
        (made.T_shadow, len(made.above), len(proxies)),
    ):
        first, second = (
            torch.tensor(rng.uniform(size=(columns, 3)), dtype=torch.float32).to(made.device)
            for _ in range(2)
        )
        first.requires_grad_()
        y = torch.tensor(rng.uniform(size=(count, 3)), dtype=torch.float32).to(made.device)
        out = product(rows, first)
        (d_first,) = torch.autograd.grad((out * y).sum(), first)
        left = float((out.detach().double() * y).sum())
        assert float((first.double() * d_first).sum()) == pytest.approx(left, rel=1e-6)
        mixed = product(rows, 2.0 * first + 3.0 * second)
        parts = 2.0 * out + 3.0 * product(rows, second)
        assert torch.allclose(mixed, parts, rtol=1e-5, atol=1e-6)


def test_transport_stores_small_numbers_well(device: str) -> None:
    """bfloat16 rows keep image and gradient within the rounding of their type, and the mean."""
    rng = np.random.default_rng(2)
    T = torch.tensor(rng.uniform(size=(3, 200, 512)) ** 4, dtype=torch.float32).to(device)
    x = torch.tensor(np.exp(rng.normal(0.0, 3.0, (512, 3))), dtype=torch.float32).to(device)
    x.requires_grad_()
    results = []
    for rows in (DenseRows(T), DenseRows(T.to(torch.bfloat16))):
        out = product(rows, x)
        (d_x,) = torch.autograd.grad((out**2).sum(), x)
        results.append((out.detach().double(), d_x.double()))
    for small, truth in zip(results[1], results[0], strict=True):
        error = (small / truth - 1.0).abs()
        assert float(error.max()) < 4.0 * BFLOAT16
        assert abs(float((small / truth - 1.0).mean())) < 0.1 * BFLOAT16


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("is_wide", [False, True])
def test_products_on_any_cpu(monkeypatch: pytest.MonkeyPatch, channels: int, is_wide: bool) -> None:
    """With AVX-512 in the small type, else in float32 piece by piece, which does not round more."""
    monkeypatch.setattr(matrix, "_has_wide_registers", lambda: is_wide)
    rng = np.random.default_rng(3)
    count, across = 2 * matrix.PIECE // 900 + 7, 900
    T = torch.tensor(rng.uniform(size=(channels, count, across)), dtype=torch.bfloat16)
    x, d = (torch.tensor(rng.uniform(size=(n, 3)), dtype=torch.float32) for n in (across, count))
    rows = DenseRows(T)
    exact = T.double().expand(3, -1, -1)
    for found, truth in (
        (rows.times(x), torch.einsum("crk,kc->rc", exact, x.double())),
        (rows.transposed_times(d), torch.einsum("crk,rc->kc", exact, d.double())),
    ):
        error = float((found / truth - 1.0).abs().max())
        assert error < (4.0 * BFLOAT16 if is_wide else 1e-5)


def test_transport_shadow_ratio_stays_within_its_bounds(device: str) -> None:
    """No pixel gains light, one that loses none has ratio 1, and the deepest shadow is dark."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    handed = lights(400.0)
    made = TransportIntegrator(renderer, objects, proxies, 1, SMALL, Light(lobes=handed))
    sun = Light(lobes=Lobes(handed.amplitude[:1], handed.axis[:1], handed.sharpness[:1]))
    texels = torch.from_numpy(as_map(sun, HEIGHT))
    out = made.radiance(texels, texels, 0)
    ratio = out.lit / out.unoccluded
    assert float(ratio.max()) <= 1.0 and float(ratio.min()) >= 0.0
    counts = made.T_shadow.by_row.crow_indices().diff().cpu()
    assert (counts == 0).any(), "some of the plane is out of the object's reach"
    assert bool((ratio[counts == 0] == 1.0).all())
    assert float(ratio.min()) < 0.05
    share = made.T_shadow.by_row.to_dense().cpu() / made.irradiance.cpu()
    assert float(share.max()) <= 1.0 + 1e-6


def test_transport_adds_what_does_not_depend_on_the_light(device: str) -> None:
    """In darkness the object shows its own emission, and that of what it reflects."""
    renderer = scene_of(device, emission=(2.0, 1.0, 0.5))
    objects, proxies = pixels_of(renderer)
    dark = torch.zeros(HEIGHT, 2 * HEIGHT, 3)
    settings = replace(EXACT, subsamples=32, paths=256)
    own = TransportIntegrator(renderer, objects, proxies, 2, settings).radiance(dark, dark, 0)
    reference = MisIntegrator(renderer, objects, proxies, spp=512, rays=1, depth=2)
    truth = reference.radiance(dark, dark, 1).foreground
    assert float(truth.max()) > 1.0
    assert float(own.foreground.sum()) == pytest.approx(float(truth.sum()), rel=0.01)
    assert bool((own.lit == own.unoccluded).all())


def test_transport_does_not_depend_on_threads_or_chunks(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are a function of seed and pixel alone."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    first = TransportIntegrator(renderer, objects, proxies, 3, SMALL)
    monkeypatch.setattr(transport_rows, "CHUNK_BYTES", 40_000)
    for threads in (1, 5):
        other = TransportIntegrator(
            Renderer(renderer.scene, threads=threads), objects, proxies, 3, SMALL
        )
        # On CUDA the paths of one pixel add up in any order; shares of directions are exact.
        tolerance = 0.0 if device == "cpu" else BFLOAT16
        assert torch.allclose(other.T_fg.T, first.T_fg.T, rtol=tolerance, atol=tolerance)
        assert torch.equal(other.T_shadow.by_row.values(), first.T_shadow.by_row.values())
        assert torch.equal(other.T_shadow.by_column.values(), first.T_shadow.by_column.values())


def test_transport_puts_directions_where_light_is_expected() -> None:
    """Each texel gets one direction; a sun gets a power of two of the budget."""
    sun = as_map(lobe((0.0, 1.0, 0.3), 500.0), 16)
    counts = direction_counts(sun, 256)
    assert counts.min() == 1 and counts.sum() <= 256 + counts.size
    assert counts.argmax() == sun[..., 0].argmax()
    assert set(np.unique(counts)) <= {2**k for k in range(9)}
    assert (direction_counts(np.zeros((16, 32, 3), np.float32), 256) == 1).all()


def test_transport_splits_directions_between_texels_that_share_a_sun(device: str) -> None:
    """A lobe on the border of two texels gives both the same number of directions."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    angle = np.pi * (1.0 - 2.0 * 10 / (2 * HEIGHT))  # where columns 9 and 10 meet
    sun = lobe((np.sin(angle), 0.13, np.cos(angle)), 200.0)
    made = TransportIntegrator(renderer, objects, proxies, 1, SMALL, sun)
    counts = direction_counts(made.expected[0], 100).reshape(HEIGHT, -1)
    row = counts.max(axis=1).argmax()
    assert counts[row, 9] == counts[row, 10] > 8


def test_transport_says_when_the_light_has_moved(device: str) -> None:
    """Staleness is 1 for the light that was expected and large for a sun elsewhere."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    expected = Light(lobes=lights(400.0))
    made = TransportIntegrator(renderer, objects, proxies, 1, SMALL, expected)
    assert made.staleness(expected, expected) == pytest.approx(1.0)
    moved = expected.rotated(90.0)
    assert made.staleness(expected, moved) > 2.0 and made.staleness(moved, expected) > 2.0


def test_transport_cache_is_keyed_by_content(device: str, tmp_path: Path) -> None:
    """The same content is read back bit for bit; any other, or a damaged file, is traced anew."""

    def made(renderer: Renderer, seed: int = 0, depth: int = 2) -> TransportIntegrator:
        objects, proxies = pixels_of(renderer)
        return TransportIntegrator(
            renderer, objects, proxies, depth, SMALL, constant(), seed, tmp_path
        )

    first, again = made(scene_of(device)), made(scene_of(device))
    assert not first.is_cached and again.is_cached
    assert torch.equal(first.T_fg.T, again.T_fg.T)
    assert torch.equal(first.T_shadow.by_column.values(), again.T_shadow.by_column.values())
    assert np.array_equal(first.mask, again.mask) and torch.equal(first.emission, again.emission)
    bouncing = [made(Renderer(scene_of(device).scene, bounce_depth=2)) for _ in range(2)]
    assert bouncing[1].is_cached and torch.equal(*(b.T_thrown.T for b in bouncing))
    assert torch.equal(*(b.emission_thrown for b in bouncing))
    for other in (
        made(scene_of(device), seed=1),
        made(scene_of(device), depth=3),
        made(scene_of(device, roughness=(0.31, 0.8))),
        made(scene_of(device, size=(25, 16))),
        made(Renderer(scene_of(device).scene, bounce_depth=1)),
    ):
        assert not other.is_cached
    for file in tmp_path.iterdir():
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 4
        file.write_bytes(content)
    take_notices()
    damaged = made(scene_of(device))
    assert not damaged.is_cached and torch.equal(damaged.T_fg.T, first.T_fg.T)
    assert any("damaged, made again" in line for line in take_notices())
    assert made(scene_of(device)).is_cached


def test_transport_cache_keeps_within_its_size(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files used longest ago go first; a folder that cannot be written is only a notice."""
    monkeypatch.setattr(caches, "CACHE_BYTES", 3000)
    rows = {"a": torch.zeros(250)}
    import os

    for k in range(4):
        path = tmp_path / f"{k}.safetensors"
        transport_cache.save_rows(path, rows)
        (kept,) = tmp_path.glob(f"{path.name}.*")
        os.utime(kept, (k, k))
    names = sorted(f.name.split(".")[0] for f in tmp_path.iterdir())
    assert names == ["2", "3"]
    (tmp_path / "file").write_text("not a folder")
    transport_cache.save_rows(tmp_path / "file" / "x.safetensors", rows)
    assert any("not kept" in line for line in take_notices())


def test_transport_refuses_what_it_cannot_do(device: str) -> None:
    """More memory than allowed is one error with size and limit."""
    renderer = scene_of(device)
    objects, proxies = pixels_of(renderer)
    with pytest.raises(InputError, match=r"needs \d+ MiB.*limit is 1 MiB") as caught:
        TransportIntegrator(
            renderer, objects, proxies, 1, TransportSettings(height_fg=64, memory_mib=1)
        )
    assert caught.value.code == ExitCode.RESOURCES


def test_transport_refuses_pixels_outside_the_picture() -> None:
    """They were traced as if the picture went on."""
    renderer = scene_of("cpu")
    objects, proxies = pixels_of(renderer)
    before = np.append(proxies, np.int32(-1))
    with pytest.raises(ValueError, match="expected row-major indices from 0"):
        TransportIntegrator(renderer, objects, before, 1, SMALL)


def test_type_of_stored_rows_is_checked_at_once() -> None:
    """It was a KeyError once all else was prepared."""
    with pytest.raises(ValueError, match=r"dtype: expected bfloat16 or float32 \(found 'float16'"):
        TransportSettings(dtype="float16")


def test_transport_of_nothing(device: str) -> None:
    """No triangles, no pixels: no rows, and the plane keeps its light."""
    view = camera(8, 6, 10.0, (0.0, 1.0, 0.0), pitch=-30.0)
    renderer = Renderer(Scene([], view, ground(0.0), device))
    none = np.zeros(0, np.int32)
    made = TransportIntegrator(renderer, none, all_pixels(view), 2, SMALL)
    light = torch.ones(HEIGHT, 2 * HEIGHT, 3, requires_grad=True)
    out = made.radiance(light, light, 0)
    assert out.foreground.shape == (0, 3) and torch.equal(out.lit, out.unoccluded)
    assert float(out.lit.detach().mean()) == pytest.approx(1.0, abs=1e-4)
    made = TransportIntegrator(renderer, none, none, 2, SMALL)
    assert made.radiance(light, light, 0).lit.shape == (0, 3)
