"""CUDA graphs: replays equal plain calls, and nothing stale is ever replayed.

The plain functions are the reference. What cannot run without a CUDA device is skipped; on the CPU
stays what makes a recording possible at all.
"""

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils._python_dispatch import TorchDispatchMode

import warpir.diffusion.personalization.personalize as personalize_module
from tests.builders.loops import SETTINGS as LOOP
from tests.builders.loops import TRACED, Pull, a_frame, bent
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.models.cuda_graphs import PLAIN_CALLS, Graphs
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.lora_files import (
    initial_lora,
    install_lora,
    lora_parameters,
    remove_lora,
)
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.personalization.personalize import personalize
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import GuidanceSettings, ModelSettings, PersonalizeSettings
from warpir.optimize.light import Function, LightOptimization, Record
from warpir.optimize.view import expected_light

pytestmark = pytest.mark.usefixtures("one_thread")

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need CUDA")
DEVICE = "cuda"
LATENT, RESOLUTION = 8, 64
CALLS = PLAIN_CALLS + 3
"""Enough for a recording and replays of it."""
PERSONALIZE = PersonalizeSettings(class_images=3, class_steps=2, lora_steps=12, lora_rate=3e-3)
PROMPTS = make_prompts("a black SUV car", PERSONALIZE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("model"))


def load(folder: Path, device: str = DEVICE, **settings: Any) -> StableDiffusion:
    prior = load_stable_diffusion(ModelSettings(model=str(folder), **settings), device)
    prior.embed(["scene", "", "sks"])
    return prior


@pytest.fixture
def both(folder: Path) -> tuple[StableDiffusion, StableDiffusion]:
    """The same model with graphs and without, each with the same adapter ``scene``."""
    made = load(folder), load(folder, graphs=False)
    for prior in made:
        adapt(prior, seed=1)
    return made


def adapt(prior: StableDiffusion, seed: int) -> None:
    """Install a LoRA ``scene`` that does something."""
    lora = initial_lora(prior, ("to_q", "to_k", "to_v", "to_out.0", "conv1"), 4, seed)
    generator = torch.Generator().manual_seed(seed)
    for key, weight in lora.weights.items():
        if ".lora_B." in key:
            weight.copy_(0.2 * torch.randn(weight.shape, generator=generator))
    install_lora(prior, lora, "scene")


def predict(prior: StableDiffusion, names: list[str | None], seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    latents = torch.randn(len(names), 4, LATENT, LATENT, generator=generator)
    t = torch.rand(len(names), generator=generator)
    words = [["scene", "", "sks"][(k + seed) % 3] for k in range(len(names))]
    return prior.predict(latents, t, prior.embed(words), names)


def picture(count: int, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, RESOLUTION, RESOLUTION, generator=generator)


def close(found: Tensor, expected: Tensor) -> None:
    """Assert equality within a few roundings of half precision."""
    torch.testing.assert_close(found, expected, rtol=2e-3, atol=2e-3)


# Without a CUDA device


class Operations(TorchDispatchMode):
    """Notes the names of all operations."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.names: set[str] = set()

    def __torch_dispatch__(
        self, function: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        self.names.add(function.name().split("::")[-1].split(".")[0])
        return function(*args, **(kwargs or {}))


WAITING = {"_local_scalar_dense", "nonzero", "item", "masked_select", "is_nonzero"}
UPLOADING = {"lift_fresh", "index", "index_put", "index_put_", "_index_put_impl_"}
RANDOM = {"randn", "rand", "bernoulli_", "normal_", "native_dropout"}


@pytest.mark.parametrize("names", [[None, None], ["scene", "scene"], ["scene", None, "scene"]])
def test_passes_neither_wait_nor_upload(folder: Path, names: list[str | None]) -> None:
    """No operation of a UNet pass needs the host, with whatever adapters."""
    prior = load(folder, "cpu")
    adapt(prior, seed=1)
    predict(prior, names, 0)
    arguments = (
        torch.randn(len(names), 4, LATENT, LATENT),
        torch.full((len(names),), 300),
        prior.embed(["scene"] * len(names)),
    )
    with Operations() as seen:
        prior._denoise(*arguments, tuple(names))
    assert {"convolution", "silu", "native_group_norm"} <= seen.names
    assert not seen.names & (WAITING | UPLOADING | RANDOM)


@pytest.mark.parametrize("vae_checkpointing", [True, False])
def test_encoding_and_its_gradient_neither_wait_nor_upload(
    folder: Path, vae_checkpointing: bool
) -> None:
    """Checkpointing included, which by default asks for the state of the random numbers."""
    prior = load(folder, "cpu", vae_checkpointing=vae_checkpointing)
    pixels = picture(1, 0).requires_grad_()
    with Operations() as seen:
        (d_pixels,) = torch.autograd.grad(prior._mean(pixels)[0].sum(), pixels)
    assert "convolution_backward" in seen.names and bool(d_pixels.any())
    assert not seen.names & (WAITING | UPLOADING | RANDOM)


def training_of(prior: StableDiffusion) -> LoraTraining:
    latents = torch.randn(4, 4, LATENT, LATENT, generator=torch.Generator().manual_seed(0))
    settings = replace(PERSONALIZE, lora_steps=20)
    lora = initial_lora(prior, settings.lora_layers, 4, 0)
    return LoraTraining(prior, lora, latents, latents, prior.embed(["scene", ""]), settings, 0)


def test_training_neither_waits_nor_uploads(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Loss, gradient and clipping; Adam on the CPU counts on the host, on CUDA on the device."""
    prior = load(folder, "cpu")
    with training_of(prior) as training:
        monkeypatch.setattr(training, "_step_where_finite", lambda norm: None)
        training.prepare(0)
        with Operations() as seen:
            training.update()
    assert {"convolution_backward", "native_group_norm_backward"} <= seen.names
    assert not seen.names & (WAITING | UPLOADING | RANDOM)


def test_the_cpu_has_no_graphs(folder: Path) -> None:
    assert load(folder, "cpu").graphs is None


def test_who_changes_adapters_or_precision_forgets_recordings(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of them moves weights that a recording would go on reading."""
    prior = load(folder, "cpu")
    forgotten: list[str] = []
    monkeypatch.setattr(prior, "forget_graphs", lambda: forgotten.append(""))
    for change in (
        lambda: adapt(prior, seed=1),
        lambda: adapt(prior, seed=2),
        lambda: remove_lora(prior, "scene"),
        prior.use_full_precision,
    ):
        forgotten.clear()
        change()
        assert forgotten


# Passes of the UNet


@needs_cuda
@pytest.mark.parametrize(
    "names", [[None], ["scene", "scene"], ["scene", None], ["scene", None, None, "scene"]]
)
@pytest.mark.parametrize("precision", ["fp16", "fp32"])
def test_replayed_predictions_equal_plain_ones(
    folder: Path, names: list[str | None], precision: str
) -> None:
    """Other latents, times and prompts in every call; the first ones are not recorded."""
    graphed = load(folder, precision=precision)
    plain = load(folder, precision=precision, graphs=False)
    for prior in (graphed, plain):
        adapt(prior, seed=1)
    assert plain.graphs is None and graphed.graphs is not None
    for seed in range(CALLS):
        found, expected = predict(graphed, names, seed), predict(plain, names, seed)
        close(found, expected)
    assert len(graphed.graphs._passes) == 1
    assert (predict(plain, names, 0) - expected).abs().mean() > 0.1  # the calls differ


@needs_cuda
def test_results_outlive_later_replays(both: tuple[StableDiffusion, StableDiffusion]) -> None:
    graphed, plain = both
    for seed in range(CALLS):
        predict(graphed, ["scene", None], seed)
    kept = [predict(graphed, ["scene", None], seed) for seed in (1, 2)]
    for found, seed in zip(kept, (1, 2), strict=True):
        close(found, predict(plain, ["scene", None], seed))


@needs_cuda
def test_recordings_of_several_shapes_take_turns(
    both: tuple[StableDiffusion, StableDiffusion],
) -> None:
    """They share memory, and adapters and batch tell them apart."""
    graphed, plain = both
    kinds: list[list[str | None]] = [[None] * 4, ["scene", None], [None, "scene"], ["scene"]]
    for seed in range(CALLS):
        for names in kinds:
            close(predict(graphed, names, seed), predict(plain, names, seed))
    assert graphed.graphs is not None and len(graphed.graphs._passes) == len(kinds)


@needs_cuda
def test_another_adapter_of_the_name_is_another_recording(
    both: tuple[StableDiffusion, StableDiffusion],
) -> None:
    graphed, plain = both
    for seed in range(CALLS):
        before = predict(graphed, ["scene", None], seed)
    for prior in both:
        adapt(prior, seed=2)
    for seed in range(CALLS):
        found = predict(graphed, ["scene", None], seed)
        close(found, predict(plain, ["scene", None], seed))
    assert (found[0] - before[0]).abs().max() > 0.05


@needs_cuda
def test_full_precision_is_another_recording(
    both: tuple[StableDiffusion, StableDiffusion],
) -> None:
    """A look at full precision leaves recordings valid; going on in it drops them."""
    graphed, plain = both
    for seed in range(CALLS):
        predict(graphed, ["scene", None], seed)
    with graphed.in_full_precision(), plain.in_full_precision():
        for seed in range(CALLS):
            found = predict(graphed, ["scene", None], seed)
            close(found, predict(plain, ["scene", None], seed))
    close(predict(graphed, ["scene", None], 3), predict(plain, ["scene", None], 3))
    for prior in both:
        prior.use_full_precision()
    for seed in range(CALLS):
        found = predict(graphed, ["scene", None], seed)
        torch.testing.assert_close(
            found, predict(plain, ["scene", None], seed), rtol=1e-4, atol=1e-4
        )


@needs_cuda
def test_samples_equal_plain_ones(folder: Path) -> None:
    """Pictures of many steps, the last batch smaller than the others."""
    made = []
    for graphs in (True, False):
        prior = load(folder, graphs=graphs, precision="fp32")
        made.append(prior.sample(["scene", "sks", ""], [1, 2, 3], steps=8, scale=7.5, batch=2))
    torch.testing.assert_close(made[0], made[1], rtol=0, atol=1e-2)


# The autoencoder's gradient


def gradient(prior: StableDiffusion, seed: int, between: bool = False) -> tuple[Tensor, Tensor]:
    """Return latents and the gradient of their product with fixed numbers."""
    image = picture(1, seed).to(prior.device).requires_grad_()
    latents = prior.encode(image)
    if between:
        predict(prior, ["scene", None], seed)
    direction = torch.randn(latents.shape, generator=torch.Generator().manual_seed(seed))
    (d_image,) = torch.autograd.grad(latents, image, direction.to(latents))
    return latents.detach(), d_image


@needs_cuda
@pytest.mark.parametrize("vae_checkpointing", [True, False])
def test_replayed_gradients_equal_plain_ones(folder: Path, vae_checkpointing: bool) -> None:
    graphed = load(folder, vae_checkpointing=vae_checkpointing)
    plain = load(folder, vae_checkpointing=vae_checkpointing, graphs=False)
    for seed in range(CALLS):
        for found, expected in zip(gradient(graphed, seed), gradient(plain, seed), strict=True):
            scale = float(expected.abs().max())
            torch.testing.assert_close(found, expected, rtol=0, atol=5e-3 * scale)
    recorded = graphed._recorded_mean
    assert recorded is not None and len(recorded._gradients) == 1


@needs_cuda
def test_passes_between_encoding_and_its_gradient_disturb_nothing(
    both: tuple[StableDiffusion, StableDiffusion],
) -> None:
    """As guidance has it: encode, predict, then the gradient."""
    graphed, plain = both
    for seed in range(CALLS):
        found, expected = gradient(graphed, seed, between=True), gradient(plain, seed)
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=5e-3 * float(b.abs().max()))


@needs_cuda
def test_a_gradient_that_comes_too_late_is_refused(folder: Path) -> None:
    """What it needs was overwritten: better no gradient than a wrong one."""
    prior = load(folder)
    for seed in range(CALLS):
        gradient(prior, seed)
    image = picture(1, 0).to(prior.device).requires_grad_()
    first = prior.encode(image)
    prior.encode(image)
    with pytest.raises(RuntimeError, match="too late: 1 passes"):
        first.sum().backward()


@needs_cuda
def test_guidance_equals_plain_guidance(both: tuple[StableDiffusion, StableDiffusion]) -> None:
    """Gradients and scores of a run of steps."""
    mask = torch.zeros(40, 60)
    mask[10:30, 20:40] = 1.0
    image = torch.rand(1, 3, 40, 60, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    prompt, settings = "scene", GuidanceSettings(noises=2)
    found = []
    for prior in both:
        guide = Guidance(prior, prompt, settings, mask, 20, 0, "scene")
        steps = [guide.gradient(image, step) for step in range(CALLS)]
        assert all(step is not None for step in steps)
        found.append((torch.cat([s for s in steps if s is not None]), guide.score(image)))
    (graphed, score), (plain, expected) = found
    torch.testing.assert_close(graphed, plain, rtol=0, atol=0.03 * float(plain.abs().max()))
    assert score == pytest.approx(expected, rel=0.05, abs=1e-4)


# Training


def trained(prior: StableDiffusion, photo: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    made = personalize(prior, photo, PROMPTS, PERSONALIZE, 0, None)
    return made.losses, made.lora.weights


@needs_cuda
def test_replayed_training_equals_plain_training(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Losses and weights of every step; the adapter ends where the plain one ends."""
    monkeypatch.setattr(personalize_module, "CROP_COUNT", 8)
    photo = picture(1, 5)
    losses, weights = trained(load(folder), photo)
    plain_losses, plain_weights = trained(load(folder, graphs=False), photo)
    torch.testing.assert_close(losses, plain_losses, rtol=1e-3, atol=1e-4)
    for key, weight in weights.items():
        # Adam's first steps have the rate's size whatever the gradient: signs must agree.
        torch.testing.assert_close(weight, plain_weights[key], rtol=0, atol=3e-3)
    moved = torch.cat([w.flatten() for k, w in plain_weights.items() if ".lora_B." in k])
    assert moved.abs().mean() > 3e-3
    found = torch.cat([w.flatten() for k, w in weights.items() if ".lora_B." in k])
    assert torch.nn.functional.cosine_similarity(found, moved, dim=0) > 0.999


@needs_cuda
def test_training_leaves_the_models_own_weights_alone(folder: Path) -> None:
    """They are in bf16 meanwhile."""
    prior = load(folder)
    before = [weight.clone() for weight in prior.unet.parameters()]
    with training_of(prior) as training:
        assert {w.dtype for w in prior.unet.parameters()} == {torch.bfloat16, torch.float32}
        training.prepare(0)
        training.update()
    after = list(prior.unet.parameters())
    assert {weight.dtype for weight in after} == {torch.float16}
    assert all(torch.equal(a, b) for a, b in zip(after, before, strict=True))


@needs_cuda
def test_a_recorded_step_takes_one_step_a_call(folder: Path) -> None:
    """Recording itself takes none: Adam's count says so."""
    prior = load(folder)
    with training_of(prior) as training:
        assert prior.graphs is not None
        update = prior.graphs.recorded_step(training.update)
        for step in range(9):
            training.prepare(step)
            update()
            held = next(iter(training.optimizer.state.values()))
            assert float(held["step"]) == step + 1
    assert lora_parameters(prior, "scene") == {}


def test_first_steps_wait_for_their_own_card(monkeypatch: pytest.MonkeyPatch) -> None:
    """What was uploaded is in that card's stream, whichever card is torch's current one."""
    order: list[str] = []

    class Stream:
        def __init__(self, name: str) -> None:
            self.name = name

        def wait_stream(self, other: "Stream") -> None:
            order.append(f"{self.name} after {other.name}")

    def current(device: torch.device | None = None) -> Stream:
        return Stream("cuda:0" if device is None else str(device))

    monkeypatch.setattr(torch.cuda, "Stream", lambda device: Stream("own"))
    monkeypatch.setattr(torch.cuda, "current_stream", current)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    Graphs(torch.device("cuda:1")).recorded_step(lambda: order.append("update"))()
    assert order == ["own after cuda:1", "update", "cuda:1 after own"]


# The loop over lights


def loop_of(device: str, record: Record | None, **changes: Any) -> LightOptimization:
    unknowns = bent().to(device)
    rows = replace(TRACED, height_fg=TRACED.height_fg // 2)  # the map is resampled
    settings = replace(LOOP, **changes)
    return LightOptimization(
        a_frame(device), Pull(), settings, unknowns, transport=rows, record=record
    )


def test_the_loops_torch_half_neither_waits_nor_uploads(device: str) -> None:
    """Also its gradient; here it is taken as it is, which must change nothing."""
    asked: list[nn.Module] = []

    def record(half: nn.Module) -> Function:
        asked.append(half)
        return half

    plain, recorded = loop_of(device, None), loop_of(device, record)
    (half,) = asked
    parameters = list(recorded.unknowns.parameters())
    assert {id(p) for p in half.parameters()} == {id(p) for p in parameters}
    scale = torch.tensor(0.3, device=parameters[0].device)
    plain_parts = half(scale)  # constants are uploaded once
    aliases = {name: p.detach().requires_grad_() for name, p in half.named_parameters()}
    aliased_parts = functional_call(half, aliases, (scale,))
    for found, expected in zip(aliased_parts, plain_parts, strict=True):
        torch.testing.assert_close(found, expected)
    torch.autograd.grad(sum(x.sum() for x in aliased_parts), list(aliases.values()))
    with Operations() as seen:
        torch.autograd.grad(sum(x.sum() for x in half(scale)), parameters)
    assert "exp" in seen.names
    assert seen.names & (WAITING | RANDOM | {"lift_fresh"}) == set()
    for _ in range(4):
        plain.step()
        recorded.step()
    for name, value in plain.unknowns.state_dict().items():
        # The fusion's scale is a number there and a float32 tensor here.
        torch.testing.assert_close(
            recorded.unknowns.state_dict()[name], value, rtol=1e-4, atol=1e-5, msg=name
        )
    assert [sorted(e) for e in recorded.state.history] == [sorted(e) for e in plain.state.history]


@needs_cuda
@pytest.mark.parametrize(
    "changes",
    [{}, {"fusion": "single"}, {"fusion": "none"}, {"tone_curve": False}, {"lobe_shape": False}],
)
def test_replayed_light_steps_equal_plain_ones(changes: dict[str, Any]) -> None:
    """Parameters and regularisers of a run, through recording and replays."""
    graphs = Graphs(torch.device(DEVICE, 0))
    plain = loop_of("cuda:0", None, **changes)
    recorded = loop_of("cuda:0", graphs.recorded_module, **changes)
    for _ in range(12):
        plain.step()
        recorded.step()
    assert graphs.seconds > 0.0
    for name, value in plain.unknowns.state_dict().items():
        torch.testing.assert_close(
            recorded.unknowns.state_dict()[name], value, rtol=1e-3, atol=2e-3, msg=name
        )
    for found, expected in zip(recorded.state.history, plain.state.history, strict=True):
        assert found == pytest.approx(expected, rel=2e-3, abs=1e-5)


@needs_cuda
def test_rows_that_are_traced_again_are_recorded_again() -> None:
    """The recording before read the old rows."""
    graphs = Graphs(torch.device(DEVICE, 0))
    recorded = loop_of("cuda:0", graphs.recorded_module)
    for _ in range(CALLS):
        recorded.step()
    plain = loop_of("cuda:0", None)
    for loop in (recorded, plain):
        loop.unknowns.load_state_dict(bent().state_dict())
        even = torch.ones(8, 16, 3)
        loop.expected = expected_light(even, even)
        loop.view = loop._trace()
    for step in range(CALLS):
        found, expected = recorded.composite(step).image, plain.composite(step).image
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)


# Memory


@needs_cuda
def test_what_is_forgotten_leaves_no_memory(
    both: tuple[StableDiffusion, StableDiffusion],
) -> None:
    graphed, _ = both
    assert graphed.graphs is not None

    def use() -> int:
        for seed in range(CALLS):
            predict(graphed, [None] * 4, seed)
            gradient(graphed, seed)
        torch.cuda.synchronize()
        held = torch.cuda.memory_reserved()
        graphed.forget_graphs()
        return held - torch.cuda.memory_reserved()

    use()  # libraries' workspaces stay
    before = torch.cuda.memory_allocated()
    freed = use()
    assert freed > 0
    assert torch.cuda.memory_allocated() <= before
    assert graphed.graphs._passes == {}


@needs_cuda
def test_rare_calls_are_not_recorded() -> None:
    graphs = Graphs(torch.device(DEVICE, 0))
    calls = []

    def double(x: Tensor) -> Tensor:
        calls.append(x.shape)
        return 2.0 * x

    for k in range(PLAIN_CALLS):
        assert graphs.run("double", double, torch.full((3,), float(k), device=DEVICE))[0] == 2 * k
    assert graphs.seconds == 0.0 and len(calls) == PLAIN_CALLS
    for k in range(5):
        assert graphs.run("double", double, torch.full((3,), float(k), device=DEVICE))[0] == 2 * k
    assert graphs.seconds > 0.0 and len(calls) == PLAIN_CALLS + 2
