"""Personalisation: learns the photo, resumes to the same bytes, is found again, leaves no trace."""

import gc
import hashlib
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import warpir.diffusion.personalization.personalize as module
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from tests.slow import slow
from warpir.core.cache import take_notices
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.models.tensor_files import serialize
from warpir.diffusion.personalization.class_images import to_bytes
from warpir.diffusion.personalization.lora_files import (
    Lora,
    initial_lora,
    lora_parameters,
    remove_lora,
    save_lora,
)
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.personalization.personalize import (
    EVALUATION_COUNT,
    Personalization,
    evaluate,
    personalize,
    photo_crops,
    photo_latents,
)
from warpir.diffusion.personalization.show_prior import (
    LABEL_WIDTH,
    WITH_CLASS,
    WITHOUT_CLASS,
    contact_sheet,
    show_personalization,
)
from warpir.diffusion.prior import NonFiniteError
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import ModelSettings, PersonalizeSettings

pytestmark = pytest.mark.usefixtures("one_thread")

KINDS = ("epsilon", "v_prediction")
SETTINGS = PersonalizeSettings(
    class_images=3, class_steps=2, lora_steps=6, lora_rate=3e-3, lora_class_batch=2
)
PROMPTS = make_prompts("a black SUV car", SETTINGS)


@pytest.fixture(autouse=True)
def _few_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Encoding crops takes longer than a short training."""
    monkeypatch.setattr(module, "CROP_COUNT", 8)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {kind: make_tiny_stable_diffusion(tmp_path_factory.mktemp(kind), kind) for kind in KINDS}


@pytest.fixture(scope="module")
def loaded(folders: dict[str, Path]) -> dict[str, StableDiffusion]:
    return {kind: load(folder) for kind, folder in folders.items()}


@pytest.fixture(params=KINDS)
def prior(request: pytest.FixtureRequest, loaded: dict[str, StableDiffusion]) -> StableDiffusion:
    """A model of each kind, without adapters."""
    return bare(loaded[request.param])


@pytest.fixture
def epsilon(loaded: dict[str, StableDiffusion]) -> StableDiffusion:
    return bare(loaded["epsilon"])


def load(folder: Path) -> StableDiffusion:
    return load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")


def bare(prior: StableDiffusion) -> StableDiffusion:
    for name in list(prior.adapters):
        remove_lora(prior, name)
    return prior


def make_photo(seed: int = 0) -> Tensor:
    """Return smooth random colours, shape [1, 3, 48, 72]."""
    small = torch.rand(1, 3, 4, 6, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.interpolate(small, (48, 72), mode="bilinear")


PHOTO = make_photo()


def content(lora: Lora) -> bytes:
    return serialize(lora.weights, {})


def predictions(prior: StableDiffusion, adapter: str | None) -> Tensor:
    random = torch.Generator().manual_seed(7)
    latents = torch.randn(2, 4, 8, 8, generator=random)
    embeddings = prior.embed([PROMPTS.photo, PROMPTS.guidance])
    return prior.predict(latents, torch.tensor([0.2, 0.7]), embeddings, [adapter] * 2)


def hash_of_weights(prior: StableDiffusion) -> str:
    digest = hashlib.sha256()
    for key, value in sorted(prior.unet.state_dict().items()):
        if ".lora_" not in key:
            digest.update(key.replace(".base_layer", "").encode() + value.numpy().tobytes())
    return digest.hexdigest()


# Learning


@pytest.mark.slow
def test_the_model_comes_closer_to_the_photo(prior: StableDiffusion) -> None:
    """The error on fixed draws falls, and the losses of both kinds are kept."""
    settings = replace(SETTINGS, lora_steps=60, lora_rate=1e-2)
    made = personalize(prior, PHOTO, PROMPTS, settings, 0, None)
    assert made.evaluation is not None
    before, after = made.evaluation
    assert after < 0.97 * before
    assert made.losses.shape == (60, 2)
    assert made.losses[-20:].mean(dim=0)[0] < made.losses[:20].mean(dim=0)[0]
    assert bool((made.losses > 0).all())
    assert (made.adapter, made.is_reused, made.notices) == ("scene", False, ())
    assert len(made.class_prompts) == 3
    assert set(made.seconds) == {"class images", "encoding", "training", "evaluation"}
    embedding = prior.embed([PROMPTS.photo])
    crops = photo_latents(prior, PHOTO, settings, 0)
    assert evaluate(prior, crops, embedding, 0, None) == before
    assert evaluate(prior, crops, embedding, 0, "scene") == after


def test_evaluation_is_the_error_of_the_noise(prior: StableDiffusion) -> None:
    """Restated for a prior that always predicts nothing: the mean square of noise is 1."""

    class Silent:
        schedule = prior.schedule
        finite = StableDiffusion.finite

        def predict(self, noisy: Tensor, t: Tensor, *rest: object) -> Tensor:
            times.append(t)
            return torch.zeros_like(noisy)

    times: list[Tensor] = []
    crops = torch.randn(5, 4, 64, 64, generator=torch.Generator().manual_seed(0))
    assert evaluate(Silent(), crops, torch.zeros(1, 2, 3), 0, None) == pytest.approx(1.0, abs=0.01)
    # One time in each sixteenth.
    slots = (torch.cat(times) * EVALUATION_COUNT).long()
    assert slots.tolist() == list(range(EVALUATION_COUNT))


def test_a_failure_to_learn_is_told(epsilon: StableDiffusion) -> None:
    settings = replace(SETTINGS, lora_steps=3, lora_rate=0.5)
    made = personalize(epsilon, PHOTO, PROMPTS, settings, 0, None)
    assert len(made.notices) == 1
    assert "came no closer" in made.notices[0]


def test_no_steps_change_nothing(epsilon: StableDiffusion) -> None:
    made = personalize(epsilon, PHOTO, PROMPTS, replace(SETTINGS, lora_steps=0), 0, None)
    assert made.evaluation is not None
    assert made.evaluation[0] == made.evaluation[1]
    assert made.notices == ()
    assert torch.equal(predictions(epsilon, "scene"), predictions(epsilon, None))


def test_without_class_images_none_are_made(
    epsilon: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The ablation without concept preservation."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError

    monkeypatch.setattr(epsilon, "sample", refuse)
    made = personalize(epsilon, PHOTO, PROMPTS, replace(SETTINGS, class_images=0), 0, None)
    assert bool((made.losses[:, 1] == 0).all())
    assert bool((made.losses[:, 0] > 0).all())
    assert made.class_prompts == ()


def test_a_personalisation_leaves_no_trace_but_the_adapter(epsilon: StableDiffusion) -> None:
    """Weights, gradients, modes and hooks of the UNet are as they were."""
    before, base = hash_of_weights(epsilon), predictions(epsilon, None)
    seen: list[weakref.ref[LoraTraining]] = []
    personalize(
        epsilon, PHOTO, PROMPTS, SETTINGS, 0, None, on_step=lambda t: seen.append(weakref.ref(t))
    )
    gc.collect()
    assert {held() for held in seen} == {None}
    assert hash_of_weights(epsilon) == before
    assert torch.equal(predictions(epsilon, None), base)
    assert not torch.equal(predictions(epsilon, "scene"), base)
    for parameter in epsilon.unet.parameters():
        assert not parameter.requires_grad
        assert parameter.grad is None
    for layer in epsilon.unet.modules():
        assert not layer.training
        assert not layer._forward_pre_hooks
        assert not layer._forward_hooks
    assert epsilon.adapters == {"scene"}


def test_a_training_that_stops_takes_its_adapter_away(epsilon: StableDiffusion) -> None:
    def stop(training: LoraTraining) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None, on_step=stop)
    assert epsilon.adapters == set()
    assert not lora_parameters(epsilon, "scene")
    assert not any(p.requires_grad for p in epsilon.unet.parameters())


def test_losses_that_are_not_finite_end_the_run(epsilon: StableDiffusion) -> None:
    settings = replace(SETTINGS, lora_rate=1e30, lora_steps=7, class_images=0)
    with pytest.raises(NonFiniteError, match="not finite from step 2"):
        personalize(epsilon, PHOTO, PROMPTS, settings, 0, None)
    assert epsilon.adapters == set()


@pytest.mark.parametrize(
    ("method", "wrong", "words"),
    [
        ("encode", lambda x: torch.full((len(x), 4, 8, 8), torch.inf), "latents"),
        pytest.param(
            "predict", lambda x, *_: x * torch.nan, "predictions", marks=pytest.mark.case("L7")
        ),
    ],
)
def test_networks_that_are_not_finite_end_the_run(
    epsilon: StableDiffusion, monkeypatch: pytest.MonkeyPatch, method: str, wrong: Any, words: str
) -> None:
    """As when half precision overflows; no file could hold the error of such predictions."""
    monkeypatch.setattr(epsilon, method, wrong)
    with pytest.raises(NonFiniteError, match=f"{words} are not finite"):
        personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)


# One step


@pytest.fixture
def training(prior: StableDiffusion) -> Iterator[LoraTraining]:
    with make_training(prior, SETTINGS) as made:
        yield made


@contextmanager
def make_training(
    prior: StableDiffusion, settings: PersonalizeSettings, seed: int = 0
) -> Iterator[LoraTraining]:
    random = torch.Generator().manual_seed(1)
    photo = torch.randn(6, 4, 8, 8, generator=random)
    classes = torch.randn(5, 4, 8, 8, generator=random)
    embeddings = prior.embed([PROMPTS.photo, PROMPTS.class_])
    lora = initial_lora(prior, settings.lora_layers, settings.lora_rank, seed)
    with LoraTraining(prior, lora, photo, classes, embeddings, settings, seed) as made:
        yield made


def test_the_first_step_is_adams(training: LoraTraining) -> None:
    """A has no gradient while B is 0: it only decays. B moves by the rate against the gradient."""
    rate = SETTINGS.lora_rate
    start = training.lora().weights
    training.prepare(0)
    training.update()
    moved = 0
    for key, parameter in training.parameters.items():
        if ".lora_A." in key:
            expected = start[key] * (1.0 - rate * 1e-2)
        else:
            gradient = parameter.grad
            assert gradient is not None
            moved += int((gradient.abs() > 1e-6).sum())
            expected = -rate * gradient / (gradient.abs() + 1e-8)
        torch.testing.assert_close(parameter.detach(), expected, rtol=1e-4, atol=1e-8)
    assert moved > 1000


def test_long_gradients_are_shortened_to_one(epsilon: StableDiffusion) -> None:
    """Losses of a thousandfold weight have gradients that much longer; shorter ones stay."""
    norms = []
    for weight in (1.0, 1000.0):
        with make_training(epsilon, replace(SETTINGS, lora_class_weight=weight)) as training:
            training.prepare(0)
            training.update()
            gradients = [p.grad.flatten() for p in training.parameters.values()]
            norms.append(float(torch.cat(gradients).norm()))
    assert norms[0] < 0.5
    assert norms[1] == pytest.approx(1.0, rel=1e-4)


def test_a_step_asks_for_the_right_thing(prior: StableDiffusion) -> None:
    """Losses restated through the prior: the photo's prompt for the crop, the class' for others."""
    with make_training(prior, SETTINGS) as training:
        for step in range(3):
            training.prepare(step)
            training.update()
            training.count_step()
        training.prepare(3)
        noisy, timesteps = training.latents_noisy.clone(), training.timesteps
        with torch.no_grad():
            texts = prior.embed([PROMPTS.photo, PROMPTS.class_, PROMPTS.class_])
            predicted = prior.unet(noisy, timesteps, encoder_hidden_states=texts).sample
        error = (predicted - training.target).square().flatten(1).mean(dim=1)
        training.update()
        assert training.loss_pair[0] == pytest.approx(float(error[0]), rel=1e-5)
        assert training.loss_pair[1] == pytest.approx(float(error[1:].mean()), rel=1e-5)


def test_the_class_weight_weighs_the_class(epsilon: StableDiffusion) -> None:
    """Gradients before clipping are linear in the weight: their directions show it."""
    gradients = []
    for weight in (0.0, 1.0, 2.0):
        with make_training(epsilon, replace(SETTINGS, lora_class_weight=weight)) as training:
            training.prepare(0)
            training.update()
            found = [p.grad.flatten() for k, p in training.parameters.items() if ".lora_B." in k]
            gradients.append(torch.cat(found).double())
    photo, one, two = gradients
    basis = torch.stack([photo, one], dim=1)
    rest = two - basis @ torch.linalg.lstsq(basis, two).solution
    assert rest.norm() < 1e-4 * two.norm()
    assert (one / one.norm() - photo / photo.norm()).norm() > 0.1


def test_draws_are_uniform_and_of_what_there_is(training: LoraTraining) -> None:
    """Times over the whole schedule; every crop and class image has its turn; noise is new."""
    timesteps, photos, classes, noises = [], set(), set(), set()
    schedule = training.prior.schedule
    for step in range(300):
        training.prepare(step)
        timesteps += training.timesteps.tolist()
        t = (training.timesteps.double() + 0.5) / len(schedule.alphas_cumprod)
        a, s = (x.view(-1, 1, 1, 1) for x in schedule.alpha_sigma(t))
        # What the two buffers say about the clean latent and the noise.
        if schedule.prediction_type == "epsilon":
            noise = training.target
            clean = (training.latents_noisy - s * noise) / a
        else:
            noise = a * training.target + s * training.latents_noisy
            clean = a * training.latents_noisy - s * training.target
        for place, latent in enumerate(clean):
            pool = training.classes if place else training.photo
            distance = (pool - latent).abs().flatten(1).amax(dim=1)
            assert distance.min() < 1e-3
            (classes if place else photos).add(int(distance.argmin()))
        noises.add(round(float(noise.double().sum()), 3))
    assert (photos, classes) == (set(range(6)), set(range(5)))
    assert len(noises) == 300
    assert abs(np.mean(timesteps) - 499.5) < 4 * 288.7 / np.sqrt(len(timesteps))
    assert min(timesteps) < 20
    assert max(timesteps) > 980


def test_crops_are_neither_turned_over_nor_recoloured(
    epsilon: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is encoded of a photo of ramps has the same ramps, at its crop's place and size."""
    height, width, size = 48, 72, epsilon.resolution
    y, x = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(72) + 0.5, indexing="ij")
    photo = torch.stack([x / width, y / height, torch.full_like(x, 0.3)])[None]
    seen: list[Tensor] = []

    def encode(image: Tensor) -> Tensor:
        seen.extend(image)
        return torch.zeros(len(image), 4, 8, 8)

    monkeypatch.setattr(epsilon, "encode", encode)
    monkeypatch.setattr(module, "CROP_COUNT", 64)
    assert photo_latents(epsilon, photo, SETTINGS, 0).shape == (64, 4, 8, 8)
    crops = photo_crops((height, width), SETTINGS, 0)
    assert len(seen) == len(crops) == 64
    centres = (torch.arange(size) + 0.5) / size
    for image, crop in zip(seen, crops, strict=True):
        assert 0.7 * height <= crop.side <= height
        assert crop.x >= 0 <= crop.y
        assert crop.x + crop.side <= width + 1e-9
        assert crop.y + crop.side <= height + 1e-9
        # Half a pixel from the photo's edge the bilinear filter has nothing to mix with.
        across = ((crop.x + centres * crop.side).clamp(0.5, width - 0.5) / width).expand(size, -1)
        down = ((crop.y + centres * crop.side).clamp(0.5, height - 0.5) / height)[:, None]
        torch.testing.assert_close(image[0], across.float(), rtol=0, atol=1e-5)
        torch.testing.assert_close(image[1], down.expand(-1, size).float(), rtol=0, atol=1e-5)
        torch.testing.assert_close(image[2], torch.full((size, size), 0.3), rtol=0, atol=1e-6)
    places = torch.tensor([[c.side, c.x, c.y] for c in crops])
    assert bool((places.std(dim=0) > 1.0).all())
    assert photo_crops((height, width), SETTINGS, 1) != crops


# Again and again


def test_the_same_seed_gives_the_same_bytes(epsilon: StableDiffusion) -> None:
    first = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)
    torch.rand(3)
    again = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)
    assert content(again.lora) == content(first.lora)
    assert torch.equal(again.losses, first.losses)
    assert again.evaluation == first.evaluation
    other = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 1, None)
    assert content(other.lora) != content(first.lora)


@pytest.mark.parametrize(
    ("prior", "stop"),
    [
        ("v_prediction", 4),
        pytest.param("epsilon", 1, marks=pytest.mark.slow),
        pytest.param("epsilon", 6, marks=pytest.mark.slow),
    ],
    indirect=["prior"],
)
def test_a_resumed_training_ends_with_the_same_bytes(
    prior: StableDiffusion, folders: dict[str, Path], stop: int
) -> None:
    """Stopped after any step, and resumed in a fresh process' state."""
    whole = personalize(prior, PHOTO, PROMPTS, SETTINGS, 0, None)
    kept: dict[str, Any] = {}

    def keep(training: LoraTraining) -> None:
        if training.step_count == stop:
            kept.update(training.state_dict())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        personalize(prior, PHOTO, PROMPTS, SETTINGS, 0, None, on_step=keep)
    assert {type(v) for v in kept.values()} <= {Tensor, int, str}
    steps: list[int] = []
    rest = personalize(
        load(folders[prior.schedule.prediction_type]),
        PHOTO, PROMPTS, SETTINGS, 0, None, resume=kept,
        on_step=lambda training: steps.append(training.step_count),
    )  # fmt: skip
    assert steps == list(range(stop + 1, 7))
    assert content(rest.lora) == content(whole.lora)
    assert torch.equal(rest.losses, whole.losses)
    assert rest.evaluation == whole.evaluation


def test_a_resumed_training_knows_which_steps_were_skipped(
    epsilon: StableDiffusion, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The optimiser's bias correction goes by the steps that it took."""
    kept: dict[str, Any] = {}
    real, calls = torch.nn.utils.clip_grad_norm_, []

    def first_is_bad(parameters: Any, limit: float) -> Tensor:
        calls.append(limit)
        norm: Tensor = real(parameters, limit)
        return norm * torch.nan if len(calls) == 1 else norm

    def keep(training: LoraTraining) -> None:
        if training.step_count == 3:
            kept.update(training.state_dict())

    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", first_is_bad)
    whole = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None, on_step=keep)
    assert int(whole.losses.isnan().any(dim=1).sum()) == 1
    fresh = load(folders["epsilon"])
    rest = personalize(fresh, PHOTO, PROMPTS, SETTINGS, 0, None, resume=kept)
    assert content(rest.lora) == content(whole.lora)


def test_another_trainings_checkpoint_is_refused(epsilon: StableDiffusion) -> None:
    kept: dict[str, Any] = {}
    personalize(
        epsilon, PHOTO, PROMPTS, SETTINGS, 0, None,
        on_step=lambda training: kept.update(training.state_dict()),
    )  # fmt: skip
    for photo, settings, seed in (
        (make_photo(1), SETTINGS, 0),
        (PHOTO, replace(SETTINGS, lora_rate=1e-3), 0),
        (PHOTO, SETTINGS, 1),
    ):
        with pytest.raises(ModelError, match="another personalisation"):
            personalize(epsilon, photo, PROMPTS, settings, seed, None, resume=kept)


def test_an_update_can_be_replayed(
    epsilon: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By a graph: same memory in every step, same bytes."""
    addresses = set()

    def recorded_step(update: Any) -> Any:
        # A recorder runs it once to warm up, and puts all back where it was.
        training = update.__self__
        state = training.state_dict()
        training.prepare(0)
        training.update()
        training.load_state_dict(state)

        def replay() -> None:
            held = [training.latents_noisy, training.target, training.timesteps]
            held += [training.embeddings, training.loss_pair, *training.parameters.values()]
            moments = training.optimizer.state.values()
            held += [m[word] for m in moments for word in ("step", "exp_avg", "exp_avg_sq")]
            addresses.add(tuple(tensor.data_ptr() for tensor in held))
            training.update()

        return replay

    expected = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)
    graphs = {"run": lambda _, do, *given: do(*given), "clear": lambda: None}
    monkeypatch.setattr(epsilon, "graphs", SimpleNamespace(recorded_step=recorded_step, **graphs))
    found = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)
    assert content(found.lora) == content(expected.lora)
    assert len(addresses) == 1


def test_an_earlier_lora_of_the_same_photo_is_found(
    epsilon: StableDiffusion, folders: dict[str, Path], tmp_path: Path
) -> None:
    """Nothing is made or trained, and the model predicts the same to the bit."""
    first = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, tmp_path)
    expected = predictions(epsilon, "scene")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["class-images", "lora"]
    fresh = load(folders["epsilon"])
    told: list[object] = []
    again = personalize(
        fresh, PHOTO, PROMPTS, SETTINGS, 0, tmp_path, name="other", report=lambda *s: told.append(s)
    )
    assert (again.is_reused, again.adapter, told) == (True, "other", [])
    assert (again.evaluation, again.class_prompts) == (first.evaluation, first.class_prompts)
    assert torch.equal(again.losses, first.losses)
    assert content(again.lora) == content(first.lora)
    assert again.lora.alphas == first.lora.alphas
    assert torch.equal(predictions(fresh, "other"), expected)


@pytest.mark.parametrize("change", ["photo", "model", *slow("prompt", "settings", "seed")])
def test_what_a_lora_depends_on_is_in_its_key(
    loaded: dict[str, StableDiffusion], tmp_path: Path, change: str
) -> None:
    settings = replace(SETTINGS, lora_steps=1, class_images=0)
    prior = bare(loaded["epsilon"])
    personalize(prior, PHOTO, PROMPTS, settings, 0, tmp_path)
    photo, prompts, seed = PHOTO, PROMPTS, 0
    if change == "photo":
        photo = PHOTO.clone()
        photo[0, 0, 0, 0] += 1e-6
    elif change == "prompt":
        prompts = make_prompts("a black SUV car", replace(settings, token="zwx"))
    elif change == "settings":
        settings = replace(settings, lora_crop=0.8)
    elif change == "seed":
        seed = 1
    else:
        prior = bare(loaded["v_prediction"])
    assert not personalize(prior, photo, prompts, settings, seed, tmp_path).is_reused


@pytest.mark.parametrize("fault", ["one bit", *slow("cut", "junk")])
def test_a_damaged_lora_is_trained_again(
    epsilon: StableDiffusion, tmp_path: Path, fault: str
) -> None:
    first = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, tmp_path)
    (file,) = (tmp_path / "lora").iterdir()
    flipped = bytearray(file.read_bytes())
    flipped[-9] ^= 1
    file.write_bytes({"cut": file.read_bytes()[:-50], "junk": b"junk", "one bit": flipped}[fault])
    take_notices()
    again = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, tmp_path)
    assert not again.is_reused
    assert [str(file) in line for line in take_notices()] == [True]
    assert content(again.lora) == content(first.lora)
    assert personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, tmp_path).is_reused


def test_stages_are_reported(epsilon: StableDiffusion) -> None:
    told: list[tuple[str, int, int]] = []
    personalize(
        epsilon, PHOTO, PROMPTS, SETTINGS, 0, None, report=lambda *state: told.append(state)
    )
    stages = list(dict.fromkeys(stage for stage, _, _ in told))
    assert stages == ["class images", "class latents", "LoRA"]
    for stage in stages:
        assert [d == n for s, d, n in told if s == stage][-1]
    assert [done for stage, done, _ in told if stage == "LoRA"] == list(range(1, 7))


# Files


def test_a_given_file_is_loaded_in_place_of_training(
    epsilon: StableDiffusion, tmp_path: Path
) -> None:
    made = personalize(epsilon, PHOTO, PROMPTS, SETTINGS, 0, None)
    expected = predictions(epsilon, "scene")
    _, file = save_lora(made.lora, tmp_path, 32, "epsilon", PROMPTS.photo)
    bare(epsilon)
    given: Personalization = personalize(
        epsilon, PHOTO, PROMPTS, replace(SETTINGS, lora=str(file)), 0, None
    )
    assert (given.is_reused, given.evaluation, len(given.losses)) == (True, None, 0)
    assert torch.equal(predictions(epsilon, "scene"), expected)


@pytest.mark.parametrize(
    ("photo", "words"),
    [
        (PHOTO[0], "photo: shape"),
        (PHOTO * 2.0, "outside"),
        (PHOTO * float("nan"), "outside"),
    ],
)
def test_photos_that_make_no_sense_are_refused(
    epsilon: StableDiffusion, photo: Tensor, words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        personalize(epsilon, photo, PROMPTS, SETTINGS, 0, None)


# Looking


def test_the_sheet_has_a_row_per_prompt_and_a_column_per_adapter() -> None:
    """Pictures stand untouched at their places, labels beside and above them."""
    columns = [
        torch.randint(256, (2, 3, 3, 64, 64), dtype=torch.uint8, generator=g)
        for g in map(torch.Generator().manual_seed, range(2))
    ]
    sheet = contact_sheet(
        columns, ["before", "adapted, with class images"], ["a car", "word " * 40]
    )
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == LABEL_WIDTH + 2 * (3 * 64 + 6)
    tops = []
    for place, column in enumerate(columns):
        for row in range(2):
            for seed in range(3):
                left = LABEL_WIDTH + place * (3 * 64 + 6) + seed * 64
                picture = column[row, seed].permute(1, 2, 0).numpy()
                strip = sheet[:, left : left + 64]
                found = [
                    top
                    for top in range(len(sheet) - 63)
                    if np.array_equal(strip[top : top + 64], picture)
                ]
                assert len(found) == 1
                tops.append((row, found[0]))
    (first,), (second,) = ({top for r, top in tops if r == row} for row in range(2))
    assert first + 64 <= second
    label = sheet[:, :LABEL_WIDTH]
    assert label[:first].min() == 255
    assert label[first:second].min() < 100
    # A long prompt is broken into lines within its column and row.
    assert label[second + 64 :].min() < 100
    assert label[:, -4:].min() == 255
    assert sheet[:first, LABEL_WIDTH:].min() < 100


def test_the_model_is_shown_before_and_after(epsilon: StableDiffusion, tmp_path: Path) -> None:
    """Both adapters are trained, or found again, and each column is its adapter's."""
    settings = replace(SETTINGS, lora_rate=3e-2, class_scale=1.0)
    shown = [PROMPTS.photo, "a photo of a red car"]
    arguments = (epsilon, PHOTO, PROMPTS, settings, 0, tmp_path, shown, [0, 1])
    sheet = show_personalization(*arguments)
    assert epsilon.adapters == {WITH_CLASS, WITHOUT_CLASS}
    # Diffusers looks for an adapter by "name in key", and warns of weights that are another's.
    assert WITH_CLASS not in WITHOUT_CLASS and WITHOUT_CLASS not in WITH_CLASS
    assert len(list((tmp_path / "lora").iterdir())) == 2
    side, width = epsilon.resolution, 2 * epsilon.resolution + 6
    assert sheet.shape[1] == LABEL_WIDTH + 3 * width
    columns = [sheet[:, LABEL_WIDTH + p * width :][:, : 2 * side] for p in range(3)]
    bodies = [column[-2 * side - 12 :] for column in columns]
    assert not any(np.array_equal(bodies[a], bodies[b]) for a, b in ((0, 1), (1, 2), (0, 2)))
    # In the same batches: what a picture is made beside changes its last bits on some processors.
    asked = [prompt for prompt in shown for _ in range(2)]
    alone = epsilon.sample(asked, [0, 1] * 2, steps=2, scale=1.0, adapter=WITHOUT_CLASS)
    expected = contact_sheet([to_bytes(alone).reshape(2, 2, *alone.shape[1:])], [""], shown)
    assert np.array_equal(bodies[2], expected[:, LABEL_WIDTH:][-2 * side - 12 :, : 2 * side])
    told: list[str] = []
    again = show_personalization(*arguments, report=lambda stage, *_: told.append(stage))
    assert np.array_equal(again, sheet)
    assert set(told) == {"samples"}
