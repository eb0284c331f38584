"""Numbers that are not finite: in a picture, a gradient, a loss, a network; counted, never hidden.

A NaN is planted at one place for one step, or for good, and the run must go on with everything
else, or end with exit code 6 and its last good state.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp
from torch import Tensor

from tests.builders.faults import snapshot
from tests.builders.guided_runs import guided_flags
from tests.builders.insertions import arguments, record_of
from tests.builders.loops import SETTINGS, Pull, a_loop, bent, values
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from tests.core.test_memory import a_scene, sky
from tests.test_layers import sources
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.class_images import make_class_images
from warpir.diffusion.personalization.lora_files import initial_lora
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.prior import BAD_STEPS_MAX, NonFiniteError
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import GuidanceSettings, ModelSettings, PersonalizeSettings
from warpir.insert import main
from warpir.optimize.light import LightOptimization
from warpir.optimize.loop import BACK_OFF, GOOD_STEPS, Composite
from warpir.render import bad_pixels
from warpir.render.bad_pixels import NAMED, BadPixels
from warpir.render.device import Rows
from warpir.render.device_light import light_args
from warpir.render.integrator import Radiance
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import shaded_pixels

pytestmark = pytest.mark.usefixtures("one_thread")

NAN = float("nan")
WIDTH = 36
"""Of the scene of `tests.core.test_memory` [px]."""


@pytest.mark.case("R10")
def test_no_number_is_washed() -> None:
    """``nan_to_num`` alone hides faults."""
    found = [p for p in sources("warpir", "kernels", "diffusion") if "nan_to_num" in p.read_text()]
    assert found == []


# -------------------------------------------------------------------------------- pictures


def with_a_bad_texel(renderer: Renderer) -> Any:
    """Return a light one of whose texels became a NaN on the device."""
    args = light_args(sky(), renderer.device)
    texels = args.texels.numpy().copy()
    texels[3, 7, 1] = NAN
    args.texels = wp.array(texels, dtype=wp.vec3, device=renderer.device)
    return args


@pytest.mark.parametrize("stage", ["object", "shadow"], ids=lambda s: f"R10-{s}")
def test_bad_pixels_are_black_counted_and_named(
    device: str, stage: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first sample that is named is the first bad one; all other pixels are as without it.

    Under the open sky of a shadow's bright side every pixel has the texel's light.
    """
    monkeypatch.setattr(bad_pixels, "BAD_SHARE", 1.0)
    renderer, spp = a_scene(device), 8
    pixels = renderer.gbuffer(1).object_pixels
    if stage == "shadow":
        pixels = shaded_pixels(renderer, light_args(sky(), renderer.device), 1)

    def planes(args: Any, spp: int, chosen: Any = pixels) -> list[np.ndarray[Any, Any]]:
        if stage == "object":
            found = renderer.foreground(args, chosen, spp, 1, 2, 1)
            return [found.radiance, found.diffuse, found.emission]
        plane = renderer.receiver(args, chosen, np.zeros(len(chosen), np.int32), spp, 1, 1)
        return [plane.lit, plane.unoccluded]

    clean = planes(light_args(sky(), renderer.device), spp)
    args, renderer.bad_pixels.iteration = with_a_bad_texel(renderer), 4
    seen = planes(args, spp)
    bad = renderer.bad_pixels
    is_bad = (seen[0] == 0.0).all(axis=1) & (clean[0] != 0.0).any(axis=1)
    assert 0 < bad.count == int(is_bad.sum()) <= len(pixels)
    assert len(bad.named) == min(NAMED, bad.count)
    for now, before in zip(seen, clean, strict=True):
        assert np.isfinite(now).all() and (now[is_bad] == 0.0).all()
        if stage == "object":
            np.testing.assert_array_equal(now[~is_bad], before[~is_bad])
    assert len([*bad.notices()]) == 1
    for pixel, text in zip(pixels[is_bad], bad.named, strict=False):
        x, y = pixel % WIDTH, pixel // WIDTH
        place, sample = text.rsplit(", iteration 4)", 1)[0].rsplit(", sample ", 1)
        assert place == f"({stage}, x {x}, y {y}" and 0 <= int(sample) < spp
        one = np.array([pixel], np.int32)
        for count, is_clean in ((int(sample), True), (int(sample) + 1, False)):
            renderer.bad_pixels = BadPixels()
            if count:
                planes(args, count, one)
                assert (renderer.bad_pixels.count == 0) is is_clean


def test_bad_pixels_are_counted_on_by_a_resumed_run() -> None:
    """The sum of both halves, and the names of the first."""
    plane, pixels = np.array([[np.nan], *[[1.0]] * 199], np.float32), np.arange(200, dtype=np.int32)
    whole, first, second = BadPixels(), BadPixels(), BadPixels()
    for step in range(4):
        if step == 2:
            second.load_state_dict(json.loads(json.dumps(first.state_dict())))
        half = first if step < 2 else second
        for counter in (whole, half):
            counter.iteration = step
            counter.blackened((plane,), pixels, 10, "object")
    assert whole.state_dict() == second.state_dict() and whole.count == 4


@pytest.mark.parametrize(
    ("bad", "count", "is_refused"),
    [
        pytest.param(1, 20, False, id="R10-one-speck"),
        pytest.param(2, 200, False, id="R10-one-percent"),
        pytest.param(3, 200, True, id="R10-more"),
        pytest.param(200, 200, True, id="R10-all"),
    ],
)
def test_too_many_bad_pixels_are_no_picture(bad: int, count: int, is_refused: bool) -> None:
    plane = np.ones((count, 3), np.float32)
    plane[:bad, 2] = np.inf
    found, pixels = BadPixels(), np.arange(count, dtype=np.int32)
    if is_refused:
        with pytest.raises(InputError, match=f"{bad} of {count} pixels") as caught:
            found.blackened((plane,), pixels, 10, "object")
        assert caught.value.code == ExitCode.NUMERIC and "x 2, y 0" in caught.value.what
        return
    (black,) = found.blackened((plane,), pixels, 10, "object")
    assert found.count == bad and (black[:bad] == 0.0).all() and (black[bad:] == 1.0).all()
    assert np.isinf(plane[:bad, 2]).all(), "what was handed in stays as it was"


def test_a_clean_picture_is_not_copied() -> None:
    planes = (np.full((4, 3), 3e38, np.float32), np.zeros(4, np.float32))
    found = BadPixels()
    assert found.blackened(planes, np.arange(4, dtype=np.int32), 2, "object") is planes
    assert found.count == 0 and [*found.notices()] == []


@pytest.mark.parametrize("part", ["lobes", "map"], ids=lambda p: f"R10-{p}")
def test_a_light_that_is_not_finite_is_numeric(device: str, part: str) -> None:
    """Not a fault of the program: exit code 6, with the count."""
    light = sky()
    assert light.texels is not None
    if part == "map":
        light.texels[0, 0, 0] = NAN
    else:
        from warpir.scene.light import Light, Lobes

        axis = np.array([[0.0, 1.0, 0.0]], np.float32)
        light = Light(Lobes(np.full((1, 3), NAN, np.float32), axis, np.ones(1, np.float32)))
    with pytest.raises(InputError, match=f"{part} are not finite") as caught:
        light_args(light, wp.get_device(device))
    assert caught.value.code == ExitCode.NUMERIC


# ------------------------------------------------------------------------------- the loop


class Toward(Pull):
    """Wants a grey picture; what it is shown comes back in its gradient."""

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        return image - 0.5


def plant(owner: Any, name: str, now: Callable[[], bool], spoil: Callable[[Any], Any]) -> None:
    """Spoil what a method returns at some times."""
    own = getattr(owner, name)

    def planted(*given: Any, **named: Any) -> Any:
        found = own(*given, **named)
        return spoil(found) if now() else found

    setattr(owner, name, planted)


def with_nan(values: Tensor, *place: int) -> Tensor:
    bad = torch.zeros_like(values)
    bad[place] = NAN
    return values + bad


def plant_gradient(loop: LightOptimization, now: Callable[[], bool]) -> None:
    plant(loop.guide, "gradient", now, lambda d_image: with_nan(d_image, 0, 1, 3, 5))


def plant_loss(loop: LightOptimization, now: Callable[[], bool]) -> None:
    def spoil(found: Composite) -> Composite:
        term = found.terms["consistency"][1]
        return replace(found, terms=found.terms | {"consistency": (1.0, term * NAN)})

    plant(loop, "composite", now, spoil)


def plant_texel(loop: LightOptimization, now: Callable[[], bool]) -> None:
    plant(loop, "_separate", now, lambda maps: (with_nan(maps[0], 4, 7, 0), maps[1]))


def plant_curve(loop: LightOptimization, now: Callable[[], bool]) -> None:
    curve = loop.unknowns.curve_fg
    plant(curve, "forward", now, lambda knots: replace(knots, y=knots.y * NAN))


def plant_radiance(loop: LightOptimization, now: Callable[[], bool]) -> None:
    def spoil(found: Radiance) -> Radiance:
        middle = len(found.foreground) // 2
        return replace(found, foreground=with_nan(found.foreground, middle))

    plant(loop.view.integrator, "radiance", now, spoil)


def plant_emission(loop: LightOptimization, now: Callable[[], bool]) -> None:
    """What the rows hold as emitted, for a step."""
    own, rows = loop.view.integrator.radiance, loop.view.transport

    def radiance(*given: Any, **named: Any) -> Any:
        assert rows is not None
        clean = rows.emission
        if now():
            rows.emission = with_nan(clean, len(clean) // 2)
        found = own(*given, **named)
        rows.emission = clean
        return found

    loop.view.integrator.radiance = radiance  # type: ignore[method-assign]


PLACES = {
    "gradient": plant_gradient,
    "loss": plant_loss,
    "env-texel": plant_texel,
    "tone-curve": plant_curve,
    "radiance": plant_radiance,
    "emission": plant_emission,
}
EVERYWHERE = [
    pytest.param(place, integrator, id=f"R10-{place}-{integrator}")
    for place in PLACES
    for integrator in ("transport", "mis")
    if (place, integrator) != ("emission", "mis")
]


@pytest.mark.parametrize(("place", "integrator"), EVERYWHERE)
def test_one_bad_number_skips_one_step(
    device: str, place: str, integrator: str, tmp_path: Path
) -> None:
    """The step is counted, nothing moves in it, and the run ends with finite numbers."""
    loop = a_loop(device, Toward(), replace(SETTINGS, steps=5, integrator=integrator), bent())
    PLACES[place](loop, lambda: loop.state.step == 2)
    for step in range(5):
        before = values(loop)
        loop.step()
        has_moved = any(not torch.equal(v, before[k]) for k, v in values(loop).items())
        assert has_moved is (step != 2)
    assert (loop.state.skipped, loop.state.bad_steps) == (1, 0)
    assert loop.state.rate_share == BACK_OFF
    assert all(bool(v.isfinite().all()) for v in values(loop).values())
    Checkpoints(tmp_path, {}).save("optimize", 5, loop.state_dict())


@pytest.mark.parametrize(("place", "integrator"), EVERYWHERE)
def test_five_in_a_row_keep_the_last_good_state(device: str, place: str, integrator: str) -> None:
    loop = a_loop(device, Toward(), replace(SETTINGS, integrator=integrator), bent())
    PLACES[place](loop, lambda: loop.state.step >= 2)
    loop.step()
    loop.step()
    before = values(loop)
    with pytest.raises(InputError, match="5 steps in a row") as caught:
        loop.run()
    assert caught.value.code == ExitCode.NUMERIC and loop.state.skipped == BAD_STEPS_MAX
    assert all(torch.equal(v, before[k]) for k, v in values(loop).items())


@pytest.mark.case("R10")
def test_rate_backs_off_and_comes_back(device: str) -> None:
    """Halved by each bad step, doubled by ten good ones; the restored loop knows it."""
    bad = {1, 2, 5}
    settings = replace(SETTINGS, steps=40)
    loop = a_loop(device, Toward(), settings, bent())
    plant_gradient(loop, lambda: loop.state.step in bad)
    base = [group["rate"] * settings.rate for group in loop.optimizer.param_groups]
    shares = []
    for step in range(40):
        if step == 20:
            state = loop.state_dict()
            loop = a_loop(device, Toward(), settings, bent())
            loop.load_state_dict(state)
        loop.step()
        if step not in bad:
            first = loop.optimizer.param_groups[0]["lr"] / base[0]
            shares.append((step, first / loop._rate_factor(step)))
    expected = {0: 1.0, 3: 0.25, 4: 0.25, 6: 0.125, 15: 0.125, 16: 0.25, 26: 0.5, 36: 1.0, 39: 1.0}
    assert GOOD_STEPS == 10 and BACK_OFF == 0.5
    assert {step: share for step, share in shares if step in expected} == pytest.approx(expected)


# ------------------------------------------------------------------------------ the model


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("model"))


@pytest.fixture
def prior(folder: Path, device: str) -> StableDiffusion:
    settings = ModelSettings(model=str(folder), precision="fp32", vae_precision="fp32")
    return load_stable_diffusion(settings, device)


def in_low_precision(prior: StableDiffusion) -> None:
    prior.unet.to(torch.bfloat16)
    prior.unet_dtype = torch.bfloat16


def overflow(prior: StableDiffusion, monkeypatch: pytest.MonkeyPatch, *, always: bool) -> None:
    """Let the attention put out NaN: below fp32, or whatever it computes in."""
    own = prior.unet.forward

    def forward(*args: Any, **kwargs: Any) -> Any:
        found = own(*args, **kwargs)
        if always or prior.unet_dtype is not torch.float32:
            found.sample = found.sample * NAN
        return found

    monkeypatch.setattr(prior.unet, "forward", forward)


CLASS = PersonalizeSettings(class_images=2, class_steps=2, class_batch=2)


@pytest.mark.case("L7")
def test_black_images_are_made_again_in_fp32(
    prior: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One notice, and everything after it is in fp32 too."""
    in_low_precision(prior)
    overflow(prior, monkeypatch, always=False)
    made = make_class_images(prior, make_prompts("a box", CLASS), CLASS, 0, None)
    assert made.images.float().std() > 0.0
    assert prior.unet_dtype is torch.float32
    assert {p.dtype for p in prior.unet.parameters()} == {torch.float32}
    assert len(prior.notices) == 1 and "fp32" in prior.notices[0]


@pytest.mark.case("L7")
@pytest.mark.parametrize("is_low", [False, True])
def test_black_images_in_fp32_end_with_6(
    prior: StableDiffusion, is_low: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    if is_low:
        in_low_precision(prior)
    overflow(prior, monkeypatch, always=True)
    with pytest.raises(InputError, match="pictures of the class are not finite") as caught:
        make_class_images(prior, make_prompts("a box", CLASS), CLASS, 0, tmp_path)
    assert caught.value.code == ExitCode.NUMERIC and [*tmp_path.iterdir()] == []


@pytest.mark.case("L7")
def test_guidance_goes_on_in_fp32(prior: StableDiffusion, monkeypatch: pytest.MonkeyPatch) -> None:
    """The very step is taken, not skipped; a bad picture is no reason for it."""
    in_low_precision(prior)
    overflow(prior, monkeypatch, always=False)
    image, mask = torch.rand(1, 3, 64, 64), torch.ones(64, 64)
    guide = Guidance(prior, "a box", GuidanceSettings(loss="csd"), mask, 9, 0, None)
    assert guide.gradient(image * NAN, 0) is None and prior.unet_dtype is torch.bfloat16
    d_image = guide.gradient(image, 1)
    assert d_image is not None and bool(d_image.isfinite().all())
    assert prior.unet_dtype is torch.float32


@pytest.mark.case("L7")
def test_half_weights_are_upcast_on_the_cpu(folder: Path, tmp_path: Path) -> None:
    """The files may hold fp16; the CPU computes in fp32 with the same weights."""
    import shutil

    shutil.copytree(folder, tmp_path / "half")
    settings = ModelSettings(model=str(folder), precision="fp32", vae_precision="fp32")
    whole = load_stable_diffusion(settings, "cpu")
    whole.unet.half().save_pretrained(tmp_path / "half" / "unet")
    loaded = load_stable_diffusion(replace(settings, model=str(tmp_path / "half")), "cpu")
    for one, other in zip(loaded.unet.parameters(), whole.unet.parameters(), strict=True):
        assert one.dtype is torch.float32 and torch.equal(one, other.float())
    assert bool(loaded.sample(["a box"], [0], steps=1, scale=1.0).isfinite().all())


@pytest.fixture
def training(prior: StableDiffusion) -> LoraTraining:
    settings = PersonalizeSettings(lora_steps=12, lora_class_batch=1)
    random = torch.Generator().manual_seed(2)
    photo, classes = (torch.randn(3, 4, 8, 8, generator=random) for _ in range(2))
    embeddings = prior.embed(["a photo", "a box"])
    lora = initial_lora(prior, settings.lora_layers, settings.lora_rank, 0)
    return LoraTraining(prior, lora, photo, classes, embeddings, settings, 0)


def trained(training: LoraTraining, bad: set[int], steps: int) -> None:
    """Take steps; the losses of some are not a number."""
    clean = training.prior.denoise
    for step in range(steps):
        training.prepare(step)
        factor = NAN if step in bad else 1.0
        training.prior.denoise = lambda *a, f=factor: f * clean(*a)  # type: ignore[method-assign]
        training.update()
        training.count_step()
    training.prior.denoise = clean  # type: ignore[method-assign]


@pytest.mark.case("R10")
def test_lora_skips_a_bad_step(training: LoraTraining) -> None:
    with training:
        trained(training, set(), 2)
        before = training.lora().weights
        training.step_count = 0
        trained(training, {0}, 1)
        assert all(torch.equal(v, before[k]) for k, v in training.lora().weights.items())
        training.step_count = 0
        trained(training, {1, 2, 3, 4}, 6)
        assert training.losses().isfinite().all(dim=1).tolist() == [True, *[False] * 4, True]
        assert training.skipped == 4
        weights = training.lora().weights
        assert all(bool(v.isfinite().all()) for v in weights.values())
        assert any(not torch.equal(v, before[k]) for k, v in weights.items())


@pytest.mark.case("R10")
def test_lora_ends_after_five_bad_steps(training: LoraTraining) -> None:
    with training:
        trained(training, {1, 2, 3, 4, 5}, 6)
        assert BAD_STEPS_MAX == 5
        with pytest.raises(NonFiniteError, match="not finite from step 2 on"):
            training.losses()


# ----------------------------------------------------------------------------- whole runs


def spoil_render(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let the first pixels of every rendered object be bad, on any device."""
    launch = Renderer.launch

    def spoilt(self: Renderer, kernel: Any, size: int, args: Any, *rest: Any, **more: Any) -> None:
        launch(self, kernel, size, args, *rest, **more)
        if rest[1:2] == ("object",) and size > 1:
            # Radiance is the first of the kernel's outputs, which alone are arrays of vectors.
            arrays = (a.array for a in args if isinstance(a, Rows))
            radiance = next(a for a in arrays if getattr(a, "dtype", None) is wp.vec3)
            radiance[: min(count, size)].fill_(wp.vec3(NAN, 0.0, 0.0))

    monkeypatch.setattr(Renderer, "launch", spoilt)


@pytest.mark.slow
def test_bad_radiance_is_told_or_ends_with_6(
    guided_inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """One bad pixel: done, black, counted in run.json. All: exit code 6, old results whole."""
    out = tmp_path / "out"
    spoil_render(monkeypatch, 1)
    assert main(arguments(guided_inputs, out)) == ExitCode.DONE
    run = record_of(out)
    assert run["measured"]["bad_pixels"] == 1
    (notice,) = (n for n in run["notices"] if "not finite" in n)
    assert "x " in notice and f"notice: {notice}" in capsys.readouterr().out
    before = snapshot(tmp_path)
    monkeypatch.undo()
    spoil_render(monkeypatch, 1 << 20)
    assert main([*arguments(guided_inputs, out), "--overwrite"]) == ExitCode.NUMERIC
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("error: object:") and len(lines) == 2
    assert snapshot(tmp_path) == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bad", "status"),
    [
        pytest.param({1}, ExitCode.DONE, id="R10-run-skips"),
        pytest.param({1, 2, 3, 4, 5}, ExitCode.NUMERIC, id="R10-run-ends"),
    ],
)
def test_guided_run_counts_bad_steps(
    bad: set[int],
    status: int,
    guided_inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """run.json says how many; after five in a row the state before them is a checkpoint."""
    monkeypatch.setenv("WARPIR_CACHE", str(tmp_path / "cache"))
    own = Guidance._gradient

    def gradient(self: Guidance, image: Tensor, step: int) -> Tensor:
        return own(self, image, step) * (NAN if step in bad else 1.0)

    monkeypatch.setattr(Guidance, "_gradient", gradient)
    out = tmp_path / "out"
    flags = guided_flags(guided_inputs, out, steps="7", checkpoint_every="0")
    assert main(flags) == status
    captured = capsys.readouterr()
    if status == ExitCode.DONE:
        assert record_of(out)["measured"]["optimization"]["skipped_steps"] == 1
        assert any("were skipped" in notice for notice in record_of(out)["notices"])
        return
    lines = captured.err.splitlines()
    assert sum(line.startswith("error:") for line in lines) == 1 and "5 steps in a row" in lines[0]
    assert "kept:" in captured.out and not (out / "run.json").exists()
    (manifest,) = (out / "checkpoints").glob("*-optimize-5/manifest.json")
    state = Checkpoints(out, json.loads(manifest.read_text())["identity"]).load(print).state
    assert all(bool(v.isfinite().all()) for v in state["loop"]["unknowns"].values())
    assert state["loop"]["state"]["rate_share"] == BACK_OFF**4
