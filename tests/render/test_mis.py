"""The integrator `mis`: what it records, the sums over it, threads, memory."""

import sys

import numpy as np
import pytest
import torch
import warp as wp
from torch import Tensor

from tests.builders.programs.children import output_of
from tests.builders.records import (
    factor_arrays,
    object_sums,
    plain_factors,
    plane_sums,
    shade_vertices,
)
from tests.render.test_gradients import HEIGHT, WIDTH, two_objects
from tests.statistics import compare_gradients
from warpir.core.arrays import Float64Array
from warpir.render import renderer as render
from warpir.render.bridge import host_light
from warpir.render.device_light import light_args
from warpir.render.integrator import MaterialTensors, Radiance
from warpir.render.mis import samples as samples_module
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.mis.samples import ObjectSamples, ReceiverSamples
from warpir.render.renderer import Renderer

SEED = 5
SEEDS = 12
SUMS_L2 = 1e-5
"""float32 sums of about 1e4 terms in another order."""
CAMERA_SHARE = 0.03
"""Three standard errors of the white-plane test's 10^4 samples."""
MEMORY_GROWTH = 16 << 20
"""What forty steps may add to the process [B]; one record of theirs has 30 MiB. The heap settles
within the first steps, 10 to 25 MiB above the fifth, and stays there for 400."""


@pytest.fixture(autouse=True)
def one_thread_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a record are pixels then, on CUDA too."""
    monkeypatch.setattr(render, "FULL_THREADS", 0)


def integrator(device: str, threads: int = 0, spp: int = 4, depth: int = 3) -> MisIntegrator:
    """A ball and a box on the ground, in all pixels."""
    pixels = np.arange(WIDTH * HEIGHT, dtype=np.int32)
    renderer = Renderer(two_objects(device), threads)
    return MisIntegrator(renderer, pixels, pixels, spp, 2, depth)


def leaf(values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def some_light() -> Tensor:
    """A coarse map with a sun in it; a new leaf at each call."""
    texels = np.random.default_rng(0).uniform(0.05, 0.3, (4, 8, 3))
    texels[1, 2] = [20.0, 18.0, 16.0]
    return leaf(texels.tolist())


def some_materials() -> MaterialTensors:
    return MaterialTensors(
        leaf([[0.6, 0.4, 0.2], [0.2, 0.5, 0.7]]),
        leaf([0.3, 0.1]),
        leaf([0.5, 0.7]),
        leaf([[0.05, 0.02, 0.01], [0.05, 0.1, 0.02]]),
    )


def leaves(*records: Tensor | MaterialTensors) -> list[Tensor]:
    """Every tensor of these lights and materials."""
    groups = ([r] if isinstance(r, Tensor) else vars(r).values() for r in records)
    return [v for group in groups for v in group if v is not None]


def loss(radiance: Radiance) -> Tensor:
    """A sum in which every pixel has a weight of its own."""
    generator = torch.Generator().manual_seed(0)
    total = torch.zeros((), dtype=torch.float64)
    for values in (radiance.foreground, radiance.lit, radiance.unoccluded):
        weight = torch.randn(values.shape, generator=generator, dtype=torch.float64)
        total = total + (weight * values.double()).sum()
    return total


def gradients(mis: MisIntegrator) -> list[Tensor]:
    """Of two lights and the materials, all at once."""
    fg, shadow, materials = some_light(), some_light(), some_materials()
    loss(mis.radiance(fg, shadow, SEED, materials)).backward()
    found = [t.grad for t in leaves(fg, shadow, materials)]
    return [g for g in found if g is not None]


def assert_close(found: Tensor, expected: Tensor, what: str) -> None:
    match = compare_gradients(found.double().numpy(), expected.double().numpy())
    assert match.relative_l2 <= SUMS_L2, (what, match)


def test_picture_without_a_gradient_is_less_noisy(device: str) -> None:
    """Its samples are others than those whose gradient may be asked for; their mean is the same."""
    mis = integrator(device)
    light, materials = some_light(), some_materials()

    def pictures() -> Float64Array:
        drawn = [mis.radiance(light, light, SEED + k, materials) for k in range(SEEDS)]
        return torch.stack([r.foreground for r in drawn]).detach().double().numpy()

    free = pictures()
    with torch.no_grad():
        fixed = pictures()
        assert not mis.radiance(light, light, SEED, materials).lit.requires_grad
    noise = [np.sqrt(p.var(axis=0, ddof=1).mean()) for p in (free, fixed)]
    assert noise[1] < 0.9 * noise[0]
    apart = np.abs((free - fixed).sum(axis=(1, 2)).mean())
    spread = (free - fixed).sum(axis=(1, 2)).std(ddof=1) / np.sqrt(SEEDS)
    assert apart < 4.0 * spread


@pytest.mark.parametrize("depth", [1, 4])
def test_light_gradient_is_that_of_the_recorded_sum(device: str, depth: int) -> None:
    """Match torch's float64 gradient of ``sum_j weight_j L(wi_j)``."""
    mis = integrator(device, depth=depth)
    args = light_args(host_light(some_light()), mis.renderer.device)
    none = [None] * 4
    of_object = ObjectSamples(mis, args, SEED, none, (True,) + (False,) * 4)
    of_plane = ReceiverSamples(mis, args, SEED, (True,))
    radiance, record, _ = of_object.draw(slice(None))
    plane, plane_record, _ = of_plane.draw(slice(None))
    assert record is not None and plane_record is not None

    truth = some_light()
    sums = Radiance(object_sums(record, truth), *plane_sums(plane_record, truth))
    np.testing.assert_allclose(sums.foreground.detach(), radiance, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(sums.lit.detach(), plane.lit, rtol=1e-5, atol=1e-6)
    loss(sums).backward()
    fg, shadow = some_light(), some_light()
    loss(mis.radiance(fg, shadow, SEED)).backward()
    assert fg.grad is not None and shadow.grad is not None and truth.grad is not None
    assert_close(fg.grad + shadow.grad, truth.grad, "texels")


def test_material_gradient_is_that_of_the_tape(device: str) -> None:
    """Adjoints launched by hand, in parts and threads, add up to what ``wp.Tape`` finds."""
    mis = integrator(device, threads=5)
    args = light_args(host_light(some_light()), mis.renderer.device)
    factors = plain_factors(some_materials())
    samples = ObjectSamples(mis, args, SEED, factors, (False,) + (True,) * 4)
    radiance, light_record, record = samples.draw(slice(None))
    assert light_record is None and record is not None
    arrays = factor_arrays(mis.renderer, factors)
    for array in arrays:
        array.requires_grad = True
    tape = wp.Tape()
    with tape:
        contributions = shade_vertices(samples, record, arrays)
    d_radiance = np.random.default_rng(0).normal(size=radiance.shape).astype(np.float32)
    per_path = np.repeat(d_radiance / samples.path_count, samples.path_count, axis=0)
    grads = {c: wp.array(per_path, dtype=wp.vec3, device=device) for c in contributions}
    tape.backward(grads=grads)
    found = samples.gradient(d_radiance)
    assert found[0] is None
    for gradient, array in zip(found[1:], arrays, strict=True):
        assert gradient is not None
        match = compare_gradients(gradient, array.grad.numpy().astype(np.float64))
        assert match.relative_l2 <= SUMS_L2, match


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_do_not_change_a_gradient(device: str, threads: int) -> None:
    """1, 2 and 5 threads give the same bytes; on CUDA, atomics have an order of their own."""
    pairs = zip(
        gradients(integrator(device, 1)), gradients(integrator(device, threads)), strict=True
    )
    for one, several in pairs:
        if device == "cpu":
            assert torch.equal(one, several)
        else:
            assert_close(several, one, "cuda")


def test_samples_drawn_again_give_the_same_gradient(device: str) -> None:
    """The first backward uses up the records; a second draws them again, bit for bit."""
    mis = integrator(device)
    light, materials = some_light(), some_materials()
    value = loss(mis.radiance(light, light, SEED, materials))
    first = torch.autograd.grad(value, leaves(light, materials), retain_graph=True)
    again = torch.autograd.grad(value, leaves(light, materials))
    for a, b in zip(first, again, strict=True):
        if device == "cpu":
            assert torch.equal(a, b)
        else:
            assert_close(b, a, "cuda")


def test_gradient_in_parts_is_that_of_the_whole(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the records do not fit, parts of them add up to the same gradient."""
    whole = gradients(integrator(device))
    monkeypatch.setattr(samples_module, "RECORD_BYTES", 1 << 20)
    mis = integrator(device)
    args = light_args(host_light(some_light()), mis.renderer.device)
    assert len(ObjectSamples(mis, args, SEED, [None] * 4, (True,) * 5).parts) > 5
    for a, b in zip(whole, gradients(mis), strict=True):
        assert_close(b, a, "parts")


def test_material_may_change_before_backward(device: str) -> None:
    """An optimiser that steps in place after the forward pass does not move its gradient."""
    found = []
    for step in (0.0, 0.3):
        light, materials = some_light(), some_materials()
        value = loss(integrator(device).radiance(light, light, SEED, materials))
        with torch.no_grad():
            for t in leaves(light, materials):
                t += step
        value.backward()
        found.append([t.grad for t in leaves(light, materials)])
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b) if device == "cpu" else torch.allclose(a, b, rtol=1e-4)


def test_black_texels_have_a_gradient(device: str) -> None:
    """A white plane reflects all light: its texels' gradients sum to 1, be they black or not."""
    mis = integrator(device, spp=8)
    seen = np.arange(WIDTH * (HEIGHT - 4), WIDTH * HEIGHT, dtype=np.int32)
    mis = MisIntegrator(mis.renderer, seen[:0], seen, 32, 2, 1)
    half = np.zeros((8, 16, 3))
    half[:, 8:] = 1.0
    for texels in (np.zeros((8, 16, 3)), half):
        light = leaf(texels.tolist())
        radiance = mis.radiance(light, light, SEED)
        radiance.unoccluded.mean(dim=0).sum().backward()
        assert light.grad is not None
        found = light.grad.sum(dim=(0, 1)).numpy()
        np.testing.assert_allclose(found, 1.0, rtol=CAMERA_SHARE)
        black = light.grad[:4, :8].sum(dim=(0, 1)).numpy()
        np.testing.assert_allclose(black, 0.5, rtol=2 * CAMERA_SHARE)


def test_no_pixels_give_zero_gradients(device: str) -> None:
    """An object out of view leaves gradients of zero, not none."""
    mis = integrator(device)
    none = mis.object_pixels[:0]
    mis = MisIntegrator(mis.renderer, none, none, 4, 2, 2)
    light, materials = some_light(), some_materials()
    loss(mis.radiance(light, light, SEED, materials)).backward()
    for t in leaves(light, materials):
        assert t.grad is not None and not bool(t.grad.any())


def test_only_what_is_free_has_a_gradient(device: str) -> None:
    """A light without materials and materials without a light: the same numbers as both."""
    mis = integrator(device)
    light, materials = some_light(), some_materials()
    loss(mis.radiance(light, light, SEED, materials)).backward()
    fixed_light = light.detach()
    fixed_materials = MaterialTensors(*(t.detach() for t in leaves(materials)))
    light_alone, materials_alone = some_light(), some_materials()
    loss(mis.radiance(light_alone, light_alone, SEED, fixed_materials)).backward()
    loss(mis.radiance(fixed_light, fixed_light, SEED, materials_alone)).backward()
    both, alone = leaves(light, materials), leaves(light_alone, materials_alone)
    for a, b in zip(both, alone, strict=True):
        assert a.grad is not None and b.grad is not None
        assert_close(b.grad, a.grad, "alone")


MEMORY_CHILD = """
import warp as wp
wp.config.quiet = True
from tests.render.test_mis import integrator, loss, some_light, some_materials
mis = integrator({device!r}, spp=16)
def used():
    if mis.renderer.device.is_cuda:
        return wp.get_mempool_used_mem_high(mis.renderer.device)
    with open("/proc/self/statm") as stream:
        return int(stream.read().split()[1]) * 4096
light, materials = some_light(), some_materials()
before = 0
for step in range(65):
    loss(mis.radiance(light, light, step, materials)).backward()
    if step < 25:
        before = max(before, used())
print(used() - before)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.slow
def test_steps_keep_no_memory(device: str) -> None:
    """Forty steps of an optimisation leave the process as large as the first ones made it."""
    assert int(output_of(MEMORY_CHILD.format(device=device)).split()[-1]) < MEMORY_GROWTH


def test_threads_that_share_a_pixel_change_nothing(
    device: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On CUDA a pixel's samples are shared out: same picture and gradient but for the order."""
    results = []
    for threads in (0, 1 << 12):
        monkeypatch.setattr(render, "FULL_THREADS", threads)
        light, materials = some_light(), some_materials()
        out = integrator(device).radiance(light, light, SEED, materials)
        gradients = torch.autograd.grad(loss(out), leaves(light, materials))
        results.append([out.foreground.detach(), out.lit.detach(), *gradients])
    for one, shared in zip(*results, strict=True):
        assert torch.allclose(one, shared, rtol=1e-3, atol=1e-5 * float(one.abs().max()))
