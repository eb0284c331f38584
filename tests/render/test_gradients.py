"""The gradient that an optimiser reads, over the whole pipeline, against central differences."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from tests.builders.records import (
    factor_arrays,
    object_sums,
    path_means,
    plain_factors,
    plane_sums,
    shade_vertices,
)
from tests.builders.shapes import box, camera, ground, placed, sphere
from tests.conftest import devices
from tests.statistics import compare_gradients
from warpir.render import renderer as render
from warpir.render.bridge import ComposeConstants, compose, host_light
from warpir.render.device_light import light_args
from warpir.render.device_scene import Scene
from warpir.render.integrator import MaterialTensors, Radiance
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.mis.samples import ObjectSamples, ReceiverSamples
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.tone_curve import ToneCurve
from warpir.scene.asset import Material

WIDTH, HEIGHT = 48, 32
SEED = 3
RELATIVE_L2 = 0.02
"""Asked of the whole pipeline; float32 differences with these steps are good to about 0.5 %."""
COSINE = 0.999
ATOMICS_L2 = 1e-5
"""float32 sums of about 1e4 terms in another order."""
MATERIAL = ("base_color", "metallic", "roughness", "emission")
STEP = {"texels": 5e-2}
"""Steps of the central differences where 1e-2 is lost in float32 noise."""


@pytest.fixture(autouse=True)
def one_thread_a_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows of a record are pixels then, on CUDA too."""
    monkeypatch.setattr(render, "FULL_THREADS", 0)


LACQUER = Material(
    ior=1.7, specular_color=(1.0, 0.8, 0.5), clearcoat=0.9, clearcoat_roughness=0.2,
    transmission=0.3,
)  # fmt: skip
CLOTH = Material(sheen_color=(0.6, 0.3, 0.2), sheen_roughness=0.5, clearcoat=0.3)


def two_objects(device: str, *materials: Material) -> Scene:
    """A ball of smooth metal paint and a rough box that glows a little; they see each other."""
    parts = sphere((0.0, 0.5, -4.0), 0.5, 3), box((0.7, 0.3, -4.0), (0.3, 0.6, 0.3), 1)
    thing = placed(parts, *(materials or (Material(), Material())))
    view = camera(WIDTH, HEIGHT, 40.0, (0.0, 1.0, 0.0))
    return Scene([thing], view, ground(0.0), device)


@dataclass
class Pipeline:
    """Everything between raw parameters and the loss, with constants fixed."""

    mis: MisIntegrator
    constants: ComposeConstants
    target: Tensor
    raw: dict[str, Tensor]
    curve_fg: ToneCurve
    curve_shadow: ToneCurve

    def materials(self, raw: dict[str, Tensor]) -> MaterialTensors:
        return MaterialTensors(
            raw["base_color"], raw["metallic"], raw["roughness"], raw["emission"]
        )

    def loss(self, raw: dict[str, Tensor], radiance: Radiance) -> Tensor:
        knots = []
        for name, curve in (("fg", self.curve_fg), ("shadow", self.curve_shadow)):
            parts = {part: raw[f"curve_{name}_{part}"] for part in ("widths", "heights", "slopes")}
            knots.append(functional_call(curve, parts, ()))
        image = compose(self.constants, radiance, *knots)
        return ((image.double() - self.target) ** 2).sum()

    def free(self, raw: dict[str, Tensor]) -> Tensor:
        """The loss as the optimiser sees it."""
        light = raw["texels"]
        return self.loss(raw, self.mis.radiance(light, light, SEED, self.materials(raw)))

    @cached_property
    def samples(self) -> tuple[ObjectSamples, ReceiverSamples]:
        """What is drawn at `raw`."""
        args = light_args(host_light(self.raw["texels"]), self.mis.renderer.device)
        factors = plain_factors(self.materials(self.raw))
        of_object = ObjectSamples(self.mis, args, SEED, factors, (True,) * 5)
        return of_object, ReceiverSamples(self.mis, args, SEED, (True,))

    @cached_property
    def drawn(self) -> tuple[Any, Any]:
        """Radiance and records of `samples`."""
        of_object, of_plane = self.samples
        return of_object.draw(slice(None)), of_plane.draw(slice(None))

    def pinned(self, raw: dict[str, Tensor]) -> float:
        """The loss at ``raw`` with the samples that were drawn at `raw` of this pipeline.

        Either the light or the materials may have moved, since each record holds the other fixed.
        """
        (radiance, light_record, vertex_record), (plane, *plane_records) = self.drawn
        foreground = torch.from_numpy(radiance).double()
        lit, unoccluded = torch.from_numpy(plane.lit), torch.from_numpy(plane.unoccluded)
        if not torch.equal(raw["texels"], self.raw["texels"]):
            after, before = (object_sums(light_record, at["texels"]) for at in (raw, self.raw))
            foreground += after - before
            lit, unoccluded = receiver_sums(plane_records, raw["texels"])
        if any(not torch.equal(raw[name], self.raw[name]) for name in MATERIAL):
            factors = plain_factors(self.materials(raw))
            arrays = factor_arrays(self.mis.renderer, factors)
            shaded = shade_vertices(self.samples[0], vertex_record, arrays)
            foreground = torch.from_numpy(path_means(self.samples[0], shaded))
        with torch.no_grad():
            return float(self.loss(raw, Radiance(foreground, lit, unoccluded)))


def receiver_sums(records: list[Any], light: Tensor) -> tuple[Tensor, Tensor]:
    """The receiver with and without the object, what that throws there included."""
    record, thrown = records
    lit, unoccluded = plane_sums(record, light)
    return (lit if thrown is None else lit + object_sums(thrown, light)), unoccluded


@pytest.fixture(
    scope="module",
    params=[(device, *depths) for device in devices() for depths in ((1, 0), (3, 0), (3, 2))],
    ids=lambda p: f"{p[0]}-depth{p[1]}" + f"-bounce{p[2]}" * bool(p[2]),
)
def pipeline(request: pytest.FixtureRequest) -> Pipeline:
    device, depth, bounce_depth = request.param
    return make_pipeline(device, depth, bounce_depth=bounce_depth)


def some_texels(generator: torch.Generator) -> Tensor:
    """A sky with three lamps in it, one of them overhead."""
    texels = 0.3 * torch.rand(4, 8, 3, generator=generator) + 0.05
    texels[1, 2] = torch.tensor([6.0, 5.0, 4.0])
    texels[0, 5] = torch.tensor([2.0, 3.0, 2.5])
    texels[2, 6] = torch.tensor([0.5, 1.0, 2.0])
    return texels


def make_pipeline(device: str, depth: int, *materials: Material, bounce_depth: int = 0) -> Pipeline:
    """Set the two objects on the ground, of materials whose free factors are replaced."""
    renderer = Renderer(two_objects(device, *materials), bounce_depth=bounce_depth)
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return 0.3 * torch.randn(*shape, generator=generator)

    raw = {
        "texels": some_texels(generator),
        "base_color": torch.tensor([[0.6, 0.4, 0.2], [0.2, 0.5, 0.7]]),
        "metallic": torch.tensor([0.3, 0.1]),
        "roughness": torch.tensor([0.5, 0.7]),
        "emission": torch.tensor([[0.05, 0.02, 0.01], [0.05, 0.1, 0.02]]),
    }
    curves = ToneCurve(1), ToneCurve(3)
    for name, curve in zip(("fg", "shadow"), curves, strict=True):
        for part, values in curve.named_parameters():
            raw[f"curve_{name}_{part}"] = normal(*values.shape)
    args = light_args(host_light(raw["texels"]), renderer.device)
    objects = renderer.gbuffer(0).object_pixels
    shaded = shaded_pixels(renderer, args, 0)
    mis = MisIntegrator(renderer, objects, shaded, spp=4, rays=2, depth=depth)
    mask = renderer.foreground(args, objects, mis.spp, mis.rays, 1, SEED).mask
    photo = np.random.default_rng(0).uniform(0.2, 0.7, (HEIGHT, WIDTH, 3)).astype(np.float32)
    constants = ComposeConstants(photo, objects, shaded, mask, device)
    target = torch.rand(1, 3, HEIGHT, WIDTH, generator=generator, dtype=torch.float64)
    return Pipeline(mis, constants, target, raw, *curves)


@pytest.fixture(scope="module")
def gradient(pipeline: Pipeline) -> dict[str, Tensor]:
    return gradient_of(pipeline)


def gradient_of(pipeline: Pipeline) -> dict[str, Tensor]:
    leaves = {name: value.clone().requires_grad_(True) for name, value in pipeline.raw.items()}
    pipeline.free(leaves).backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


def test_pinned_render_equals_the_free_one(pipeline: Pipeline) -> None:
    """Records hold the picture: its light summed in float64, its materials by the kernel."""
    (radiance, light_record, vertex_record), (plane, *plane_records) = pipeline.drawn
    light, materials = pipeline.raw["texels"], pipeline.materials(pipeline.raw)
    leaf = light.clone().requires_grad_(True)
    free = pipeline.mis.radiance(leaf, leaf, SEED, materials)
    with torch.no_grad():
        lit, unoccluded = receiver_sums(plane_records, light)
        reflected = object_sums(light_record, light)
        arrays = factor_arrays(pipeline.mis.renderer, plain_factors(materials))
    shaded = path_means(
        pipeline.samples[0], shade_vertices(pipeline.samples[0], vertex_record, arrays)
    )
    np.testing.assert_array_equal(radiance, free.foreground.detach())
    np.testing.assert_array_equal(plane.lit, free.lit.detach())
    np.testing.assert_allclose(shaded, radiance, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(lit, plane.lit, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(unoccluded, plane.unoccluded, rtol=1e-5, atol=1e-6)
    dark = replace(materials, emission=torch.zeros_like(pipeline.raw["emission"]))
    unlit = pipeline.mis.radiance(leaf, leaf, SEED, dark).foreground.detach()
    np.testing.assert_allclose(reflected, unlit, rtol=1e-5, atol=1e-6)


PARAMETERS = (
    "texels",
    *MATERIAL,
    "curve_fg_widths", "curve_fg_heights", "curve_fg_slopes",
    "curve_shadow_widths", "curve_shadow_heights", "curve_shadow_slopes",
)  # fmt: skip


@pytest.mark.parametrize("name", PARAMETERS)
def test_gradient_is_that_of_the_pinned_pipeline(
    pipeline: Pipeline, gradient: dict[str, Tensor], name: str
) -> None:
    """Match central differences of the composite's loss, every parameter kind, samples pinned."""
    check_gradient(pipeline, gradient, name)


def test_gradient_of_layered_materials(device: str) -> None:
    """The same for the materials below a coat and sheen, and of glass whose passing rays stay."""
    pipeline = make_pipeline(device, 2, LACQUER, CLOTH)
    gradient = gradient_of(pipeline)
    for name in MATERIAL:
        check_gradient(pipeline, gradient, name)


def check_gradient(pipeline: Pipeline, gradient: dict[str, Tensor], name: str) -> None:
    step = STEP.get(name, 1e-2)
    values = pipeline.raw[name]
    count = min(values.numel(), 24)
    picked = np.linspace(0, values.numel() - 1, count).astype(int)
    differences = []
    for i in picked:
        sides = []
        for sign in (1.0, -1.0):
            moved = values.clone()
            moved.view(-1)[i] += sign * step
            sides.append(pipeline.pinned({**pipeline.raw, name: moved}))
        differences.append((sides[0] - sides[1]) / (2.0 * step))
    found = gradient[name].reshape(-1)[picked].double().numpy()
    match = compare_gradients(found, np.array(differences))
    assert match.relative_l2 <= RELATIVE_L2, match
    assert match.cosine >= COSINE, match


def test_gradient_is_the_same_when_asked_again(
    pipeline: Pipeline, gradient: dict[str, Tensor]
) -> None:
    """A second backward neither doubles nor drifts: nothing is kept between calls.

    The same bytes on the CPU; CUDA adds up in an order of its own.
    """
    leaves = {name: value.clone().requires_grad_(True) for name, value in pipeline.raw.items()}
    pipeline.free(leaves).backward()
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        if pipeline.mis.renderer.device.is_cpu:
            assert torch.equal(leaf.grad, gradient[name]), name
        else:
            match = compare_gradients(leaf.grad.numpy(), gradient[name].numpy())
            assert match.relative_l2 <= ATOMICS_L2, (name, match)
