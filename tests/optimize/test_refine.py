"""Refinement under a known light: what it finds again, what it leaves alone, end to end."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks.light.recovery import TowardTruth
from tests import oracles as o
from tests.builders.insertions import ALWAYS, arguments, digest, record_of, write_inputs
from tests.builders.programs.stops import stop_run
from tests.builders.records import factor_arrays, path_means, plain_factors, shade_vertices
from tests.builders.refusals import assert_fails
from tests.builders.shapes import camera, ground, sphere
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from tests.conftest import devices
from tests.statistics import compare_gradients
from warpir.app.config import REFINE_PARTS, InsertConfig, refused_refinement
from warpir.app.settings import OptimizeSettings
from warpir.core.errors import ExitCode, InputError
from warpir.insert import main
from warpir.io.images.photos import Photo
from warpir.io.meshes.materials_file import materials_to_json, with_materials
from warpir.lighting.scene_light import SceneLight
from warpir.optimize import materials as refine_module
from warpir.optimize.loop import Optimization
from warpir.optimize.materials import (
    LOWEST,
    Between,
    Factors,
    MaterialRefinement,
    Positive,
    ToneRefinement,
    ToneUnknowns,
    free_parts,
    what_moves,
)
from warpir.optimize.view import STILL_SAMPLES, Frame, LitFrame
from warpir.render.bridge import ShadeForeground
from warpir.render.composite import make_picture
from warpir.render.device_scene import Placed, Scene
from warpir.render.mis.samples import ObjectSamples
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.render.tone_curve import ToneCurve
from warpir.scene.asset import Asset, Material
from warpir.scene.light import Light, Lobes, plain_sky
from warpir.scene.tone_curves import Curves, ToneKnots

WIDTH, HEIGHT = 48, 32
PARTS = ("base_color", "metallic", "roughness")
RELATIVE_L2 = 0.02
"""Asked of gradients; float32 differences with these steps are good to about 0.5 %."""
COLOR, METALLIC, ROUGHNESS = 0.02, 0.03, 0.03
"""How near a recovered factor is; 0.01 of each is seen, from 80 pixels a ball."""
EMISSION = 0.03
"""Relative; half of it is seen."""
TONE = 0.01
"""Of display-linear values that the scene shows; 0.006 of it is seen."""
TONE_RMS = 1e-3
"""Of the picture, which began 25 times as far away; half of it is seen."""
TRUE = (
    Material("left", base_color=(0.7, 0.15, 0.1), metallic=0.2, roughness=0.4),
    Material("right", base_color=(0.3, 0.5, 0.8), metallic=0.8, roughness=0.3),
)
MATTE = tuple(replace(m, base_color=(0.5,) * 3, metallic=0.0, roughness=1.0) for m in TRUE)
"""The authors' start: a purely diffuse asset."""


pytestmark = pytest.mark.usefixtures("one_thread", "own_cache")


def scene_light(curves: Curves | None = None) -> SceneLight:
    """A broad sun from the left and a sky; the shadow's is another, from the right."""
    sky = plain_sky((0.4, 0.5, 0.7), (0.15, 0.15, 0.12))
    lobes = [
        Lobes(
            np.array([[12.0, 11.0, 10.0]], np.float32),
            np.array([o.normalize((x, 0.7, 0.5))], np.float32),
            np.array([40.0], np.float32),
        )
        for x in (-0.6, 0.6)
    ]
    fg, shadow = (Light(one, sky) for one in lobes)
    return SceneLight(fg, shadow, curves or Curves.identity("reinhard"), 0.0, ())


def balls(materials: tuple[Material, ...]) -> Asset:
    parts = (sphere((x, 0.5, -4.0), 0.5, 3, k) for k, x in enumerate((-0.7, 0.7)))
    return Asset("balls", tuple(parts), materials)


def lit_frame(asset: Asset, light: SceneLight, device: str = "cpu") -> LitFrame:
    """Two balls on the ground of a photo with structure."""
    view = camera(WIDTH, HEIGHT, 40.0, (0.0, 1.0, 0.0))
    renderer = Renderer(Scene([Placed(asset, np.eye(4))], view, ground(0.0), device))
    frame = Frame(renderer, some_photo().linear(), True, depth=2, seed=3)
    return LitFrame(frame, light, torch.device(device))


def some_photo() -> Photo:
    srgb = np.random.default_rng(0).uniform(0.4, 0.7, (HEIGHT, WIDTH, 3)).astype(np.float32)
    return Photo(np.round(srgb * 255.0).astype(np.uint8), srgb, "png")


SETTINGS = OptimizeSettings(steps=150, rate_material=0.1, rate_tone=0.1)
"""Faster than a diffusion model allows: here the gradient knows the answer."""
FINE = replace(SETTINGS, mis_samples=512)


class Nobody:
    """A guide that is not asked."""

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(name)


def material_loop(
    asset: Asset,
    parts: tuple[str, ...],
    guide: Any = None,
    settings: OptimizeSettings = SETTINGS,
    chosen: tuple[int, ...] = (0, 1),
    device: str = "cpu",
) -> MaterialRefinement:
    light = scene_light()
    lit, unknowns = lit_frame(asset, light, device), Factors(asset, chosen, parts).to(device)
    return MaterialRefinement(lit, light.curves, guide or Nobody(), settings, unknowns)


def truth_of(asset: Asset) -> Tensor:
    with torch.no_grad():
        return material_loop(asset, ("roughness",), settings=FINE).final_image(99)


# ------------------------------------------------------------------------------ unknowns


@pytest.mark.parametrize("low", [0.0, 0.05])
def test_between_starts_exactly_and_keeps_its_bounds(low: float) -> None:
    """Starts at 0 and 1 have finite raw values that still move; steps of any size end inside."""
    start = torch.tensor([0.0, 1e-4, low, 0.3, 0.5, 1.0 / 3.0, 0.999, 1.0])
    values = Between(start, low)
    assert torch.equal(values(), start.clamp(min=low))
    assert values.raw.isfinite().all()
    (slope,) = torch.autograd.grad(values().sum(), values.raw)
    assert slope.min() > 0.15 * slope.max()
    for far in (1e9, -1e9):
        with torch.no_grad():
            values.raw.fill_(far)
        values.project()
        found = values().detach()
        assert (found >= low).all() and (found <= 1.0).all()
        assert (found - (1.0 if far > 0.0 else low)).abs().max() < 1e-4
        # From either bound there is a way back.
        (slope,) = torch.autograd.grad(values().sum(), values.raw)
        assert slope.min() > 0.04


def test_positive_reproduces_its_start() -> None:
    """Softplus undone over nine decades, and never below 0."""
    start = torch.tensor([1e-6, 0.01, 1.0, 20.0, 1000.0])
    values = Positive(start)
    torch.testing.assert_close(values().detach(), start, rtol=2e-6, atol=0.0)
    with torch.no_grad():
        values.raw.fill_(-1e4)
    assert (values() >= 0.0).all()


def test_factors_change_the_chosen_parts_of_the_chosen_materials_only() -> None:
    """All else is the asset's own, bit for bit, whatever the raw values are."""
    asset = balls((replace(TRUE[0], emission=(0.0, 2.0, 0.005)), TRUE[1]))
    unknowns = Factors(asset, [1], ("metallic", "emission"))
    found = unknowns()
    assert found.base_color is None and found.roughness is None
    assert unknowns.materials()[1].emission == pytest.approx((0.01,) * 3)
    with torch.no_grad():
        for parameter in unknowns.parameters():
            parameter += 0.7
    first, second = unknowns.materials()
    assert first == asset.materials[0]
    assert second.metallic > 0.8 and min(second.emission) > 0.01
    assert replace(second, metallic=0.8, emission=(0.0,) * 3) == TRUE[1]
    emission = unknowns().emission
    assert emission is not None and emission[0].tolist() == pytest.approx((0.0, 2.0, 0.005))
    # More than the start's least is kept.
    assert Factors(asset, [0], ("emission",)).materials()[0].emission == pytest.approx(
        (0.01, 2.0, 0.01)
    )


def test_curves_start_at_given_knots(rng: np.random.Generator) -> None:
    """The oracle's knots come back; the identity's raw numbers are 0."""
    knots = [np.asarray(k, np.float32) for k in o.spline_knots(rng.normal(0.0, 1.5, (3, 16)))]
    curve = ToneCurve.from_knots(ToneKnots(*knots))
    for found, given in zip(curve.plain().arrays(), knots, strict=True):
        np.testing.assert_allclose(found, given, rtol=2e-5, atol=1e-6)
    plain = ToneCurve.from_knots(ToneKnots.identity(1, 7))
    for parameter in plain.parameters():
        assert parameter.detach().abs().max() < 1e-6
    # What no parameters mean is brought near it and stays a curve.
    extreme = [0.0, 1e-5, 1.0], [0.0, 0.5, 1.0], [1e-6, 300.0, 1e6]
    hard = ToneCurve.from_knots(ToneKnots(*(np.array([k], np.float32) for k in extreme))).plain()
    assert hard.x[0, 1] == pytest.approx(1e-3, rel=0.01)
    np.testing.assert_allclose(hard.slope[0], [1e-3, 300.0, 1e6], rtol=0.01)


# ---------------------------------------------------------------------------------- loops


@pytest.mark.slow
@pytest.mark.parametrize("bins", [1, 2, 64])
def test_curves_of_any_bins_go_from_0_to_1(bins: int) -> None:
    """A single bin has two knots as well: with fewer the kernels read beyond the array."""
    knots = ToneCurve(3, bins).plain()
    even = np.tile(np.linspace(0.0, 1.0, bins + 1), (3, 1))
    for part in (knots.x, knots.y):
        assert part.shape == even.shape
        np.testing.assert_allclose(part, even, atol=1e-6)
    assert knots.slope.shape == (3, bins + 1)


def test_start_is_the_unrefined_image() -> None:
    """Free factors at their start give the asset's own picture, to the last bit."""
    own = (
        replace(TRUE[0], base_color=(1.0, 0.0, 0.3), metallic=0.0, roughness=1.0),
        replace(TRUE[1], metallic=1.0),
    )
    loop = material_loop(balls(own), PARTS, settings=replace(SETTINGS, mis_samples=64))
    lit = loop.lit
    with torch.no_grad():
        refined = loop.final_image(3)
        plain = ShadeForeground.apply(loop.mis, lit.args_fg, 3, False, *(None,) * 5)
        assert torch.equal(refined, lit.image(plain, *loop.curves))
        # With the same samples this is the object that was rendered once.
        assert torch.equal(plain, lit.foreground)


def test_loops_see_what_is_delivered(device: str, rng: np.random.Generator) -> None:
    """Two lights, curves, shadow: the final renderer's picture at the loop's size and samples."""
    light = scene_light(some_curves(rng))
    loop = tone_loop(light, Nobody(), device=device)
    frame = loop.lit.frame
    # Of 16 bits: the layers of an 8-bit photo are halves, and so is the picture made of them.
    photo = replace(some_photo(), codes=some_photo().codes.astype(np.uint16))
    picture = make_picture(
        frame.renderer, light.light, light.light_shadow, photo,
        Quality(STILL_SAMPLES, 1, frame.depth, frame.seed), light.curves,
    )  # fmt: skip
    with torch.no_grad():
        image = loop.final_image(0)[0].permute(1, 2, 0).cpu().numpy()
    np.testing.assert_allclose(image, picture.image, atol=1e-4)
    is_ground = picture.layers.matte == 0.0
    assert (~is_ground).sum() > 150
    assert (picture.layers.shadow_ratio[is_ground].min(axis=-1) < 0.9).sum() > 30


@pytest.mark.parametrize("kind", ["material", "tone"])
def test_loops_run_on_every_device(device: str, kind: str, rng: np.random.Generator) -> None:
    """A few steps there lead where they lead on the CPU, state out and in included."""
    if "cpu" not in devices():
        pytest.skip("Warp compiles nothing for the CPU here")
    image = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    settings = replace(SETTINGS, steps=6, score_every=2)
    ends = []
    for place in (device, "cpu"):
        guide = TowardTruth(image)
        loop: Optimization = (
            tone_loop(scene_light(), guide, settings, place)
            if kind == "tone"
            else material_loop(balls(TRUE), (*PARTS, "emission"), guide, settings, device=place)
        )
        start = [p.detach().clone() for p in loop.unknowns.parameters()]
        loop.run()
        loop.load_state_dict(loop.state_dict())
        ends.append([p.detach().cpu() for p in loop.unknowns.parameters()])
        moved = (p.detach() - s for p, s in zip(loop.unknowns.parameters(), start, strict=True))
        assert all(m.abs().max() > 0.05 for m in moved)
    for found, expected in zip(*ends, strict=True):
        assert (found - expected).abs().mean() < 0.05


def test_image_shows_other_samples_than_its_gradient() -> None:
    """The value of a step is an unbiased picture; its gradient does not see that picture's noise.

    Of a squared error with the same samples, the gradient would have the noise's variance in it.
    """
    loop = material_loop(balls(TRUE), ("roughness",), settings=replace(SETTINGS, mis_samples=2))
    with torch.no_grad():
        replayed, shown = loop.final_image(3 + 8), loop.final_image(3 + 9)
    image = loop.composite(4).image
    torch.testing.assert_close(image.detach(), shown, rtol=0.0, atol=1e-6)
    assert (shown - replayed).abs().max() > 0.01
    (found,) = torch.autograd.grad(image.sum(), loop.unknowns.parts["roughness"].raw)
    (expected,) = torch.autograd.grad(
        loop.final_image(3 + 8).sum(), loop.unknowns.parts["roughness"].raw
    )
    assert torch.equal(found, expected)


@pytest.mark.parametrize("target", [0.0, 1.0])
def test_loop_keeps_its_bounds(target: float, tmp_path: Path) -> None:
    """Steps far too long toward black or white end at factors that a file may hold."""
    guide = TowardTruth(torch.full((1, 3, HEIGHT, WIDTH), target))
    settings = replace(SETTINGS, steps=12, mis_samples=1, rate_material=3.0)
    asset = balls(TRUE)
    loop = material_loop(asset, PARTS, guide, replace(settings, score_every=0))
    loop.run()
    found = loop.unknowns.materials()
    path = tmp_path / "materials.json"
    path.write_text(json.dumps(materials_to_json(TRUE, found)))
    assert with_materials(asset, path).materials == found
    for part in PARTS:  # as the renderer sees them
        values = getattr(loop.unknowns(), part)
        assert (values >= LOWEST[part]).all() and (values <= 1.0).all()
    colors = np.array([m.base_color for m in found])
    assert np.abs(colors - target).max() < 1e-4


@pytest.mark.parametrize("part", [*PARTS, "emission"])
def test_material_gradient_matches_central_differences(part: str) -> None:
    """Of the composite by raw parameters, with the samples pinned."""
    loop = material_loop(balls(TRUE), (part,), settings=replace(SETTINGS, mis_samples=4))
    lit, seed = loop.lit, 5
    weight = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    raw = loop.unknowns.parts[part].raw
    (found,) = torch.autograd.grad((weight * loop.final_image(seed)).sum(), raw)

    factors = plain_factors(loop.unknowns())
    samples = ObjectSamples(loop.mis, lit.args_fg, seed, factors, (False,) + (True,) * 4)
    _, _, record = samples.draw(slice(None))
    assert record is not None

    def pinned() -> float:
        arrays = factor_arrays(loop.mis.renderer, plain_factors(loop.unknowns()))
        means = path_means(samples, shade_vertices(samples, record, arrays))
        foreground = torch.from_numpy(means).float()
        return float((weight * lit.image(foreground, *loop.curves)).double().sum())

    with torch.no_grad():
        differences = torch.zeros_like(raw).double()
        for i in range(raw.numel()):
            sides = []
            for step in (0.02, -0.02):
                raw.view(-1)[i] += step
                sides.append(pinned())
                raw.view(-1)[i] -= step
            differences.view(-1)[i] = (sides[0] - sides[1]) / 0.04
    match = compare_gradients(found.double().numpy(), differences.numpy())
    assert match.relative_l2 <= RELATIVE_L2, match


def test_tone_gradient_matches_central_differences(rng: np.random.Generator) -> None:
    """Of the composite by the raw numbers of bent curves."""
    light = scene_light(some_curves(rng))
    loop = tone_loop(light, Nobody())
    weight = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    parameters = list(loop.unknowns.parameters())
    found = torch.autograd.grad((weight * loop.final_image(0)).sum(), parameters)
    with torch.no_grad():
        for parameter, gradient in zip(parameters, found, strict=True):
            differences = torch.zeros_like(parameter).double()
            for i in range(parameter.numel()):
                sides = []
                for step in (0.01, -0.01):
                    parameter.view(-1)[i] += step
                    sides.append(float((weight * loop.final_image(0)).double().sum()))
                    parameter.view(-1)[i] -= step
                differences.view(-1)[i] = (sides[0] - sides[1]) / 0.02
            match = compare_gradients(gradient.double().numpy(), differences.numpy())
            assert match.relative_l2 <= RELATIVE_L2, match


@pytest.mark.slow
def test_material_is_found_again() -> None:
    """From matte grey to paint and metal, toward a true composite of other samples."""
    true = balls(TRUE)
    loop = material_loop(balls(MATTE), PARTS, TowardTruth(truth_of(true)))
    before = loop.guide.score(loop.final_image(3).detach())
    loop.run()
    for found, expected in zip(loop.unknowns.materials(), TRUE, strict=True):
        assert found.base_color == pytest.approx(expected.base_color, abs=COLOR), found
        assert found.metallic == pytest.approx(expected.metallic, abs=METALLIC), found
        assert found.roughness == pytest.approx(expected.roughness, abs=ROUGHNESS), found
    assert before is not None and loop.state.best_score is not None
    assert loop.state.best_score < 0.02 * before


@pytest.mark.slow
def test_frozen_parts_and_materials_stay() -> None:
    """Base colour of one ball is found; the other's and all other factors are the asset's."""
    start = (replace(TRUE[0], base_color=(0.5,) * 3), TRUE[1])
    guide = TowardTruth(truth_of(balls(TRUE)))
    settings = replace(SETTINGS, steps=80, rate_material=0.2)
    loop = material_loop(balls(start), ("base_color",), guide, settings, chosen=(0,))
    loop.run()
    left, right = loop.unknowns.materials()
    assert right == TRUE[1]
    assert left.base_color == pytest.approx(TRUE[0].base_color, abs=COLOR)
    assert replace(left, base_color=TRUE[0].base_color) == TRUE[0]


@pytest.mark.slow
def test_emission_is_found_again() -> None:
    """A ball that glows red, and one that does not, both from the start value."""
    glow = (0.6, 0.15, 0.05)
    true = balls((replace(TRUE[0], emission=glow), TRUE[1]))
    settings = replace(SETTINGS, steps=120, rate_emission=0.15)
    loop = material_loop(balls(TRUE), ("emission",), TowardTruth(truth_of(true)), settings)
    loop.run()
    left, right = loop.unknowns.materials()
    assert left.emission == pytest.approx(glow, rel=EMISSION)
    assert max(right.emission) < 0.01
    assert (left.base_color, right.roughness) == (TRUE[0].base_color, TRUE[1].roughness)


def some_curves(rng: np.random.Generator) -> Curves:
    """Curves bent by a third of what the recovery allows itself at most."""
    fg, shadow = (
        ToneKnots(*(np.asarray(k, np.float32) for k in o.spline_knots(raw)))
        for raw in (rng.normal(0.0, 0.4, (1, 16)), rng.normal(0.0, 0.4, (3, 16)))
    )
    return Curves("reinhard", fg, shadow)


def tone_loop(
    light: SceneLight, guide: Any, settings: OptimizeSettings = SETTINGS, device: str = "cpu"
) -> ToneRefinement:
    asset = balls((replace(TRUE[0], roughness=0.2), Material("white", metallic=0.0)))
    unknowns = ToneUnknowns(light.curves).to(device)
    return ToneRefinement(lit_frame(asset, light, device), guide, settings, unknowns)


@pytest.mark.parametrize("from_identity", [True, False])
def test_curves_are_found_again(rng: np.random.Generator, from_identity: bool) -> None:
    """From no curves, or from an earlier run's, to those of an altered picture."""
    _, earlier, *_, altered = (some_curves(rng) for _ in range(6))  # two that are far apart
    light = scene_light(altered)
    with torch.no_grad():
        image = tone_loop(light, Nobody()).final_image(0)
    first = scene_light(None if from_identity else earlier)
    loop = tone_loop(first, TowardTruth(image))
    assert (loop.final_image(0) - image).square().mean().sqrt() > 20.0 * TONE_RMS
    loop.run()
    assert (loop.final_image(0) - image).square().mean().sqrt() < TONE_RMS
    lit = loop.lit
    mask = lit.constants.mask.numpy()[:, None]
    shown = o.reinhard((lit.foreground.numpy() / mask.clip(1e-3))[mask[:, 0] > 0.5])
    ratio = (lit.lit / lit.unoccluded).numpy()[lit.unoccluded.numpy().min(axis=1) > 0.0]
    pairs = [(shown, light.curves.foreground, loop.unknowns.curve_fg, 0)]
    pairs += [
        (ratio[:, c], light.curves.shadow_ratio, loop.unknowns.curve_shadow, c) for c in range(3)
    ]
    for values, given, curve, row in pairs:
        x = np.quantile(values, np.linspace(0.05, 0.95, 19))
        expected, _ = o.spline(x, *(knots[row] for knots in given.arrays()))
        found, _ = o.spline(x, *(knots[row] for knots in curve.plain().arrays()))
        assert np.abs(found - expected).max() < TONE, row


def test_tone_starts_at_the_runs_picture(rng: np.random.Generator) -> None:
    """An earlier run's curves reproduce its picture before the first step."""
    light = scene_light(some_curves(rng))
    loop = tone_loop(light, Nobody())
    knots = [refine_module._fixed(k) for k in (light.curves.foreground, light.curves.shadow_ratio)]
    with torch.no_grad():
        difference = loop.final_image(0) - loop.lit.image(loop.lit.foreground, *knots)
    assert difference.abs().max() < 2e-5


@pytest.mark.parametrize("kind", ["material", "tone"])
def test_resumed_loop_ends_as_if_it_had_not_stopped(rng: np.random.Generator, kind: str) -> None:
    """State in, state out: the same bits."""
    image = torch.rand(1, 3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(1))
    settings = replace(SETTINGS, steps=8, mis_samples=2, score_every=2)

    def new() -> Optimization:
        if kind == "tone":
            return tone_loop(scene_light(), TowardTruth(image), settings)
        return material_loop(balls(MATTE), PARTS, TowardTruth(image), settings)

    whole, part, rest = new(), new(), new()
    whole.run()
    while part.state.step < 5:
        part.step()
    rest.load_state_dict(part.state_dict())
    rest.run()
    assert rest.state == whole.state
    for name, values in whole.unknowns.state_dict().items():
        assert torch.equal(values, rest.unknowns.state_dict()[name]), name


# ---------------------------------------------------------------------------- the command


def refining(kind: str, **changes: Any) -> InsertConfig:
    return InsertConfig(
        **{"refine": kind, "light": "l.hdr", "prompt": "p", "guidance": "stable-diffusion"},
        **changes,
    )


def test_what_moves_and_what_does_not() -> None:
    """run.json's words; the light is frozen in all three, so never joint with a colour."""
    asset = balls(TRUE)
    every = {"light", "tone curves", *LOWEST, "emission"}
    cases: list[tuple[str, dict[str, Any], set[str]]] = [
        ("material", {}, set(LOWEST)),
        ("material", {"refine_parts": ("base-color",)}, {"base_color"}),
        ("emission", {"refine_materials": ("left",)}, {"emission"}),
        ("tone", {}, {"tone curves"}),
    ]
    for kind, changes, free in cases:
        moves = what_moves(refining(kind, **changes).task, asset)
        assert set(moves["free"]) == free and set(moves["frozen"]) == every - free
        names = {"tone": [], "emission": ["left"]}.get(kind, ["left", "right"])
        assert moves["what"] == kind and moves["materials"] == names
    parts = [part.replace("-", "_") for part in REFINE_PARTS]
    assert free_parts(refining("material").task) == parts


def test_each_kind_has_its_own_number_of_steps() -> None:
    """--steps where it is given, 600 too; else the kind's own."""
    steps = [
        refining(kind).settled().optimize.step_count for kind in ("material", "emission", "tone")
    ]
    assert steps == [300, 300, 200]
    assert refining("tone", steps=600).settled().optimize.step_count == 600
    assert (
        InsertConfig(model="m").settled().optimize.step_count
        == OptimizeSettings().step_count
        == 600
    )


def test_materials_survive_the_file(tmp_path: Path) -> None:
    """What was written is put onto the asset again; textures and alpha are the asset's own."""
    own = balls((replace(TRUE[0], alpha=0.5, emission=(0.0, 3.0, 0.1)), TRUE[1]))
    third = replace(own.materials[1], base_color=(1.0 / 3.0, 0.0, 1.0), metallic=0.1, roughness=0.2)
    path = tmp_path / "materials.json"
    path.write_text(json.dumps(materials_to_json(own.materials, (own.materials[0], third))))
    assert with_materials(own, path).materials == (own.materials[0], third)
    content = json.loads(path.read_text())
    assert content["materials"][1]["before"]["base_color"] == [0.3, 0.5, 0.8]


BAD = {
    "format": (lambda c: c.update(format="warpir-lobes"), "not materials"),
    "version": (lambda c: c.update(version=2), "not materials (found 'warpir-materials' version 2"),
    "count": (lambda c: c["materials"].pop(), "(found 1; expected 2)"),
    "none": (lambda c: c.pop("materials"), "(found no list; expected 2)"),
    "name": (lambda c: c["materials"][1].update(name="door"), "/materials/1/name: of another"),
    "kind": (lambda c: c.update(materials=[1, 2]), "/materials/0: an object"),
    "unknown": (lambda c: c["materials"][0].update(sheen=1), "/materials/0: an object with"),
    "missing": (
        lambda c: c["materials"][0].pop("metallic"),
        "/0/metallic: missing or of another kind (expected a number)",
    ),
    "text": (
        lambda c: c["materials"][0].update(roughness="0.5"),
        "/roughness: missing or of another kind (expected a number)",
    ),
    "short": (
        lambda c: c["materials"][0].update(base_color=[1, 1]),
        "/base_color: missing or of another kind (expected a list of 3",
    ),
    "bright": (lambda c: c["materials"][0].update(base_color=[0, 1.1, 0]), "/base_color: 0 to 1"),
    "negative": (lambda c: c["materials"][0].update(emission=[0, 0, -1]), "/emission: 0 to 1e+12"),
    "huge": (lambda c: c["materials"][0].update(metallic=10**400), "/metallic: a number beyond"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_materials_are_refused(case: str, tmp_path: Path) -> None:
    """Files of another asset or another kind name the place that is wrong."""
    change, words = BAD[case]
    content = materials_to_json(TRUE, TRUE)
    change(content)
    path = tmp_path / "materials.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError) as caught:
        with_materials(balls(TRUE), path)
    assert caught.value.where == str(path) and words in caught.value.what


CHEAP = {
    "guidance": "stable-diffusion",
    "prompt": "a carmine red box",
    "class_images": "1",
    "class_steps": "1",
    "lora_steps": "2",
    "steps": "4",
    "guidance_width": "32",
    "mis_samples": "2",
    "checkpoint_every": "2",
    "score_every": "2",
    "device": "cpu",
}
LORA = ("lora_diffusers.safetensors", "lora_kohya.safetensors")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photo, box, model, and an earlier run to take the light from."""
    made = tmp_path_factory.mktemp("refined")
    write_inputs(made)
    make_tiny_stable_diffusion(made / "model")
    flags = {"asset": str(made / "box.obj"), "device": "cpu", "tone": "reinhard"}
    assert main(arguments(made, made / "earlier", **flags)) == ExitCode.DONE
    return made


def argv(folder: Path, out: Path, refine: str, **changes: str | None) -> list[str]:
    flags: dict[str, str | None] = {**CHEAP, "refine": refine, "model": str(folder / "model")}
    flags |= {"light": None, "reuse": str(folder / "earlier"), "asset": str(folder / "box.obj")}
    return arguments(folder, out, **{**flags, **changes})


@pytest.fixture(scope="module")
def refined(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A material refinement that nothing stopped."""
    out = tmp_path_factory.mktemp("material") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WARPIR_CACHE", str(out.parent / "cache"))
        assert main(argv(folder, out, "material")) == ExitCode.DONE
    return out


@pytest.mark.slow
def test_refined_material_is_written_and_rendered(
    folder: Path, refined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All files are there, light and curves are the earlier run's, and --materials repeats it."""
    files = {*ALWAYS, *LORA, "materials.json", "optimization.json", "run.json"}
    assert {p.name for p in refined.iterdir()} == files
    run, found = record_of(refined), digest(refined)
    measured = run["measured"]
    assert measured["refine"] == {
        "what": "material",
        "free": ["base_color", "metallic", "roughness"],
        "frozen": ["light", "tone curves", "emission"],
        "materials": ["red"],
    }
    assert measured["loop_integrator"] == "mis" and measured["optimization"]["steps"] == 4
    assert "a photo of a carmine red box in a scene" in measured["prompts"]["guidance"]
    earlier = digest(folder / "earlier")
    for name in ("envmap.exr", "curves.json", "camera.json"):
        assert found[name] == earlier[name]
    (entry,) = json.loads((refined / "materials.json").read_text())["materials"]
    assert entry["name"] == "red" and entry["before"]["base_color"] == [0.8, 0.1, 0.1]
    assert entry["emission"] == entry["before"]["emission"] == [0.0] * 3
    assert entry["base_color"] != entry["before"]["base_color"]
    assert found["composite.png"] != earlier["composite.png"]

    # --reuse alone says what it leaves out; --materials puts it on again.
    flags = {"light": None, "reuse": str(refined), "asset": str(folder / "box.obj")}
    plain, again = tmp_path / "plain", tmp_path / "again"
    capsys.readouterr()
    assert main(arguments(folder, plain, device="cpu", **flags)) == ExitCode.DONE
    said = f"--materials {refined / 'materials.json'}"
    assert sum(said in line for line in record_of(plain)["notices"]) == 1
    assert said in capsys.readouterr().out
    assert digest(plain)["composite.png"] == earlier["composite.png"]
    flags["materials"] = str(refined / "materials.json")
    assert main(arguments(folder, again, device="cpu", **flags)) == ExitCode.DONE
    assert digest(again)["composite.png"] == found["composite.png"]
    assert not any("--materials" in line for line in record_of(again)["notices"])
    assert record_of(again)["inputs"]["materials"] == found["materials.json"]
    # A run that was given them says so in its turn.
    flags |= {"reuse": str(again), "materials": None}
    third = tmp_path / "third"
    assert main(arguments(folder, third, device="cpu", **flags)) == ExitCode.DONE
    assert any(said in line for line in record_of(third)["notices"])


@pytest.mark.slow
def test_refinement_replays(refined: Path, tmp_path: Path) -> None:
    out = tmp_path / "replayed"
    assert main(["--config", str(refined / "run.json"), "--out", str(out)]) == ExitCode.DONE
    for name in ("composite.png", "materials.json", "optimization.json"):
        assert digest(out)[name] == digest(refined)[name]


@pytest.mark.slow
def test_refinement_judges_with_the_earlier_runs_operator(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without guidance is linear, and so is what is changed under its light."""
    import warpir.optimize.materials

    seen = []

    def watched(frame: Frame, *rest: Any) -> LitFrame:
        seen.append(frame.is_reinhard)
        return LitFrame(frame, *rest)

    monkeypatch.setattr(warpir.optimize.materials, "LitFrame", watched)
    linear, out = tmp_path / "linear", tmp_path / "out"
    flags = {"asset": str(folder / "box.obj"), "device": "cpu"}
    assert main(arguments(folder, linear, **flags)) == ExitCode.DONE
    changes = {"reuse": str(linear), "steps": "0", "loss": "csd", "no_personalize": ""}
    assert main(argv(folder, out, "tone", **changes)) == ExitCode.DONE
    assert seen == [False]
    assert json.loads((out / "curves.json").read_text())["tone"] == "linear"


@pytest.mark.slow
def test_stopped_refinement_resumes(folder: Path, refined: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    stop_run(argv(folder, out, "material"), "optimize.loop:Optimization.step", 4)
    assert main([*argv(folder, out, "material"), "--resume"]) == ExitCode.DONE
    for name in ("composite.png", "materials.json", "optimization.json"):
        assert digest(out)[name] == digest(refined)[name]


@pytest.mark.slow
@pytest.mark.parametrize("no_bounce", [None, ""])
def test_emission_refinement_runs(folder: Path, tmp_path: Path, no_bounce: str | None) -> None:
    """Under a light that is given; the run says who sees what falls on the ground."""
    out = tmp_path / "out"
    light = {"reuse": None, "sky": "overcast", "refine_materials": "red", "no_bounce": no_bounce}
    assert main(argv(folder, out, "emission", no_personalize="", loss="csd", **light)) == 0
    run = record_of(out)
    assert run["measured"]["refine"]["free"] == ["emission"]
    told = refine_module.GROUND_IS_UNSEEN, refine_module.GROUND_IS_DARK
    assert [line for line in run["notices"] if line in told] == [told[no_bounce is not None]]
    (entry,) = json.loads((out / "materials.json").read_text())["materials"]
    assert min(entry["emission"]) > 0.0
    assert {k: entry[k] for k in LOWEST} == {k: entry["before"][k] for k in LOWEST}


@pytest.mark.slow
def test_tone_refinement_runs_on_an_altered_photo(folder: Path, tmp_path: Path) -> None:
    """Another photo of the place: curves move from the earlier run's, light and materials stay."""
    out = tmp_path / "out"
    changes = {"photo": str(folder / "deep.png"), "no_personalize": "", "loss": "csd"}
    assert main(argv(folder, out, "tone", **changes)) == ExitCode.DONE
    names = {p.name for p in out.iterdir()}
    assert names == {*ALWAYS, "optimization.json", "run.json"}
    found, earlier = digest(out), digest(folder / "earlier")
    assert found["envmap.exr"] == earlier["envmap.exr"]
    assert found["curves.json"] != earlier["curves.json"]
    assert json.loads((out / "curves.json").read_text())["tone"] == "reinhard"
    moves = record_of(out)["measured"]["refine"]
    assert moves["free"] == ["tone curves"] and moves["materials"] == []


@pytest.mark.parametrize(
    ("refine", "changes", "words"),
    [
        ("material", {"refine_materials": "red,doors"}, "no material 'doors' in"),
        ("tone", {"no_tone_curve": ""}, "--no-tone-curve"),
        ("tone", {"accept": ""}, "--accept: needs --model without --refine"),
        ("material", {"refine_parts": "sheen"}, "--refine-parts"),
    ],
)
def test_wrong_wishes_are_one_line(
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    refine: str,
    changes: dict[str, str | None],
    words: str,
) -> None:
    """Refused before anything is loaded or written; an unknown material is told the known ones."""
    out = tmp_path / "out"
    wish = argv(folder, out, refine, **changes)
    (line, *_) = assert_fails(capsys, [*wish, "--validate"], ExitCode.USAGE, words)
    if "refine_materials" in changes:
        assert "(found 'red')" in line
    assert not out.exists()


@pytest.mark.parametrize("what", ["material", "emission", "tone"])
def test_solid_glass_keeps_its_materials(what: str) -> None:
    """What comes through it has no gradient to materials; tone curves have one."""
    glass = Material(name="pane", transmission=1.0, thickness=0.1)
    given = {"photo": "room.jpg", "asset": "vase.glb", "sky": "overcast"}
    config = InsertConfig().changed(**given, model="sd", prompt="a vase", refine=what)
    problems = list(refused_refinement(config, Asset("vase", (), (Material(), glass))))
    assert len(problems) == (what != "tone")
    for problem in problems:
        assert problem.code == ExitCode.USAGE and "'pane'" in str(problem)


def test_thin_glass_keeps_what_decides_what_passes_it() -> None:
    """Its base colour and metallic have no gradient; other materials and its roughness do."""
    materials = (Material(name="paint"), Material(name="window", transmission=1.0))
    given = {"photo": "road.jpg", "asset": "car.glb", "sky": "overcast", "model": "sd"}

    def refused(refine: str, **changes: Any) -> list[str]:
        config = InsertConfig().changed(**given, prompt="a car", refine=refine, **changes)
        problems = refused_refinement(config, Asset("car", (), materials))
        return [str(problem) for problem in problems if problem.code == ExitCode.USAGE]

    (told,) = refused("material")
    assert "no base color" in told and "'window'" in told
    assert refused("material", refine_parts=("roughness", "metallic"))
    assert not refused("material", refine_materials=("paint",))
    assert not refused("material", refine_parts=("roughness",))
    assert not refused("emission") and not refused("tone")
