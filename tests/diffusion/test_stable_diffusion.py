"""Stable Diffusion behind the prior's interface, on tiny folders of its true classes and shapes."""

import gc
import json
import math
import shutil
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.builders.tiny_stable_diffusion import (
    ATTENTION,
    RESOLUTION,
    add_lora,
    edit_json,
    make_tiny_stable_diffusion,
)
from warpir.diffusion.cache import model_key
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.settings import PREDICTION_TYPES, ModelSettings

ROUNDING = 1e-5
"""Between two orders of the same float32 sums, on values of about 1."""
LATENT = RESOLUTION // 8
LAYERS = (*ATTENTION, "conv1")


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Folders by prediction type, made once; never changed."""
    made: dict[str, Path] = {}

    def folder(prediction_type: str = "epsilon") -> Path:
        if prediction_type not in made:
            place = tmp_path_factory.mktemp(prediction_type)
            made[prediction_type] = make_tiny_stable_diffusion(place, prediction_type)
        return made[prediction_type]

    return folder


def load(folder: Path, **settings: Any) -> StableDiffusion:
    return load_stable_diffusion(ModelSettings(model=str(folder), **settings), "cpu")


@pytest.fixture(scope="module", params=["epsilon", "v_prediction"])
def prior(request: pytest.FixtureRequest, folders: Callable[[str], Path]) -> StableDiffusion:
    """Model of both prediction types in use; tests leave it as it was."""
    return load(folders(request.param))


@pytest.fixture
def fresh(folders: Callable[[str], Path]) -> StableDiffusion:
    """Model that a test may change."""
    return load(folders("epsilon"))


@pytest.fixture(scope="module")
def adapted(folders: Callable[[str], Path]) -> StableDiffusion:
    """Model with two LoRAs, first and second."""
    prior = load(folders("epsilon"))
    add_lora(prior, "first", 1, layers=LAYERS)
    add_lora(prior, "second", 2, layers=LAYERS)
    return prior


def noise(count: int, seed: int = 0) -> Tensor:
    return torch.randn(count, 4, LATENT, LATENT, generator=torch.Generator().manual_seed(seed))


def picture(count: int = 1, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, RESOLUTION, RESOLUTION, generator=generator)


# The interface


def test_prior_says_what_it_is(prior: StableDiffusion) -> None:
    """Resolution is the latents' side times the autoencoder's factor."""
    assert prior.name == "stable-diffusion"
    assert prior.resolution == 64 and prior.device == torch.device("cpu")
    assert len(prior.digest) == 64 and prior.adapters == set()
    assert prior.encode(picture(2)).shape == (2, 4, LATENT, LATENT)
    assert prior.embed(["scene", ""]).shape == (2, 77, 32)
    models = (prior.unet, prior.vae, prior.text_encoder)
    for model in models:
        assert model is not None and not model.training
        assert not any(weight.requires_grad for weight in model.parameters())


def test_attention_processors_are_left_alone(prior: StableDiffusion) -> None:
    """Others lose the upcasting that Stable Diffusion 2.1 needs in half precision."""
    kinds = {type(p).__name__ for p in prior.unet.attn_processors.values()}
    assert kinds == {"AttnProcessor2_0"}


def test_other_shapes_work_alike(tmp_path: Path) -> None:
    """As Stable Diffusion 1.5: another width, a tokenizer that pads with its end, no v."""
    folder = make_tiny_stable_diffusion(tmp_path, cross_attention_dim=48)
    edit_json(folder / "unet/config.json", sample_size=16)
    edit_json(folder / "tokenizer/special_tokens_map.json", pad_token="<|endoftext|>")
    scheduler = {
        "_class_name": "PNDMScheduler", "beta_start": 0.00085, "beta_end": 0.012,
        "beta_schedule": "scaled_linear", "skip_prk_steps": True, "steps_offset": 1,
    }  # fmt: skip
    (folder / "scheduler/scheduler_config.json").write_text(json.dumps(scheduler))
    prior = load(folder)
    assert prior.resolution == 128 and prior.schedule.prediction_type == "epsilon"
    images = prior.sample(["a scene"], [1], steps=2, scale=7.5)
    assert images.shape == (1, 3, 128, 128) and bool(torch.isfinite(images).all())
    assert prior.encode(images).shape == (1, 4, 16, 16)


# Schedules


def test_schedule_is_the_configuration_s(
    prior: StableDiffusion, folders: Callable[[str], Path]
) -> None:
    """Prediction type and alpha-bar come from the file, not from the model's name."""
    kind = prior.schedule.prediction_type
    assert kind in folders(kind).name
    betas = torch.linspace(0.00085**0.5, 0.012**0.5, 1000, dtype=torch.float64) ** 2
    expected = (1.0 - betas).cumprod(0)
    torch.testing.assert_close(prior.schedule.alphas_cumprod, expected, rtol=1e-4, atol=0)


def test_trained_betas_are_used(folders: Callable[[str], Path], tmp_path: Path) -> None:
    folder = Path(shutil.copytree(folders("epsilon"), tmp_path / "model"))
    betas = torch.linspace(0.01, 0.3, 50).tolist()
    config = folder / "scheduler/scheduler_config.json"
    edit_json(config, trained_betas=betas, num_train_timesteps=50)
    prior = load(folder)
    expected = torch.tensor([math.prod(1.0 - b for b in betas[: i + 1]) for i in range(50)])
    torch.testing.assert_close(prior.schedule.alphas_cumprod.float(), expected)
    assert bool(torch.isfinite(prior.sample(["a"], [1], steps=5, scale=2.0)).all())


@pytest.mark.parametrize("prediction_type", ["epsilon", "v_prediction"])
def test_zero_terminal_snr_is_finite_at_one(tmp_path: Path, prediction_type: str) -> None:
    """No signal is left at the end of such a schedule, and nothing is divided by it."""
    prior = load(make_tiny_stable_diffusion(tmp_path, prediction_type, zero_terminal_snr=True))
    assert prior.schedule.alphas_cumprod[-1] == 0.0
    predicted = prior.predict(noise(1), torch.ones(1), prior.embed(["scene"]), [None])
    assert bool(torch.isfinite(predicted).all())
    image = prior.sample(["scene"], [1], steps=3, scale=5.0)
    assert bool(torch.isfinite(image).all())
    edited = prior.edit(image, "scene", 2, strength=1.0, steps=3, scale=5.0)
    assert bool(torch.isfinite(edited).all())


# Prediction


def test_predict_is_the_network_s_noise(prior: StableDiffusion) -> None:
    """The UNet by itself, converted by the definitions in float64."""
    noisy, t = noise(2), torch.tensor([0.2, 0.7])
    embeddings = prior.embed(["a scene", ""])
    found = prior.predict(noisy, t, embeddings, [None, None])
    with torch.no_grad():
        raw = prior.unet(noisy, torch.tensor([200, 700]), embeddings).sample.double()
    if prior.schedule.prediction_type == "v_prediction":
        bar = prior.schedule.alphas_cumprod[[200, 700]].view(-1, 1, 1, 1)
        raw = bar.sqrt() * raw + (1.0 - bar).sqrt() * noisy.double()
    torch.testing.assert_close(found.double(), raw, rtol=0, atol=ROUNDING)
    assert found.dtype == torch.float32 and not found.requires_grad


@pytest.mark.parametrize("prediction_type", PREDICTION_TYPES)
def test_right_networks_of_all_types_agree(
    folders: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch, prediction_type: str
) -> None:
    """Whatever a network predicts: when it is right, the noise comes out, and sampling ends there.

    All of a picture's own latents can be known to the network, since it is told nothing else.
    """
    prior = load(folders(prediction_type))
    clean, eps, t = noise(3, 1), noise(3, 2), torch.tensor([0.1, 0.5, 0.9])

    def right(latents: Tensor, timesteps: Tensor, *rest: Any) -> Tensor:
        bar = prior.schedule.alphas_cumprod[timesteps].float().view(-1, 1, 1, 1)
        a, s = bar.sqrt(), (1.0 - bar).sqrt()
        known = clean[:1] if len(latents) < 3 else clean
        its_noise = (latents - a * known) / s
        return {
            "epsilon": its_noise,
            "sample": known.expand_as(latents),
            "v_prediction": a * its_noise - s * known,
        }[prediction_type]

    monkeypatch.setattr(prior, "_denoise", right)
    noisy = prior.schedule.add_noise(clean, eps, t)
    found = prior.predict(noisy, t, prior.embed(["a", "b", "c"]), [None] * 3)
    torch.testing.assert_close(found, eps, rtol=0, atol=5e-5)  # divided by sigma 0.3 and back
    expected = prior.decode(clean[:1])
    sampled = prior.sample(["a"], [7], steps=6, scale=7.5)
    torch.testing.assert_close(sampled, expected, rtol=0, atol=1e-3)
    edited = prior.edit(picture(), "a", 7, strength=0.8, steps=4, scale=7.5)
    torch.testing.assert_close(edited, expected, rtol=0, atol=1e-3)


# Adapters


def test_mixed_batch_equals_one_pass_per_adapter(adapted: StableDiffusion) -> None:
    """One call of the UNet for samples of three kinds gives what three calls give."""
    names = ["first", None, "second", "first", None]
    noisy, t = noise(5), torch.linspace(0.1, 0.9, 5)
    embeddings = adapted.embed(["a scene", "", "sks", "style", "rendering"])
    mixed = adapted.predict(noisy, t, embeddings, names)
    kinds = {}
    for name in (None, "first", "second"):
        alone = adapted.predict(noisy, t, embeddings, [name] * 5)
        kinds[name] = alone
        for i in (i for i, of in enumerate(names) if of == name):
            torch.testing.assert_close(mixed[i], alone[i], rtol=0, atol=ROUNDING)
    for one, other in ((None, "first"), (None, "second"), ("first", "second")):
        assert (kinds[one] - kinds[other]).abs().mean() > 1e-2  # they do something


def test_base_weights_are_untouched_by_adapters(
    adapted: StableDiffusion, fresh: StableDiffusion
) -> None:
    arguments = (noise(2), torch.tensor([0.3, 0.6]), fresh.embed(["a", "b"]), [None, None])
    assert torch.equal(adapted.predict(*arguments), fresh.predict(*arguments))


@pytest.mark.parametrize("names", [[None, None], ["second", "second"], ["first", None]])
@pytest.mark.parametrize("disabled", [False, True])
def test_predict_leaves_adapters_as_they_were(
    adapted: StableDiffusion, names: list[str | None], disabled: bool
) -> None:
    """A training that asks for a prediction goes on with the same weights and gradients."""
    from peft.tuners.lora.layer import LoraLayer

    layers = [module for module in adapted.unet.modules() if isinstance(module, LoraLayer)]

    def state() -> list[Any]:
        flags = [weight.requires_grad for weight in adapted.unet.parameters()]
        hooks = [len(layer._forward_pre_hooks) for layer in layers]
        return [flags, hooks, [(layer.active_adapters, layer.disable_adapters) for layer in layers]]

    adapted.unet.set_adapter("first")
    if disabled:
        adapted.unet.disable_adapters()
    before = state()
    arguments = (noise(2), torch.tensor([0.3, 0.6]), adapted.embed(["a", "b"]), names)
    found = adapted.predict(*arguments)
    assert state() == before
    adapted.unet.enable_adapters()
    assert torch.equal(adapted.predict(*arguments), found)
    adapted.unet.requires_grad_(False)


def test_unknown_adapter_is_refused(adapted: StableDiffusion) -> None:
    embeddings = adapted.embed(["a"])
    with pytest.raises(ModelError, match=r"'third'.*first, second"):
        adapted.predict(noise(1), torch.tensor([0.5]), embeddings, ["third"])
    with pytest.raises(ModelError, match="'third'"):
        adapted.sample(["a"], [1], steps=2, scale=2.0, adapter="third")
    with pytest.raises(ModelError, match="'third'"):
        adapted.edit(picture(), "a", 1, strength=0.5, steps=2, scale=2.0, adapter="third")


# Pictures and latents


def test_encode_is_the_scaled_mean(prior: StableDiffusion) -> None:
    """No sampling noise: the mean of the posterior of 2 x - 1, times the model's factor."""
    image = picture(2)
    with torch.no_grad():
        moments = prior.vae.quant_conv(prior.vae.encoder(2.0 * image - 1.0))
    expected = 0.18215 * moments[:, :4]
    found = prior.encode(image)
    torch.testing.assert_close(found, expected, rtol=0, atol=ROUNDING)
    assert found.dtype == torch.float32 and torch.equal(found, prior.encode(image))


def test_checkpointing_changes_memory_only(folders: Callable[[str], Path]) -> None:
    """The encoder runs twice, and the gradient is the same to the last bit."""
    gradients, calls = [], []
    for checkpointing in (True, False):
        prior = load(folders("epsilon"), vae_checkpointing=checkpointing)
        counts = {"down": 0, "mid": 0}
        blocks = {"down": prior.vae.encoder.down_blocks[0], "mid": prior.vae.encoder.mid_block}
        for name, block in blocks.items():
            resnet = block.resnets[0]

            def count(*_: Any, name: str = name, counts: dict[str, int] = counts) -> None:
                counts[name] += 1

            resnet.register_forward_hook(count)
        image = picture().requires_grad_()
        (prior.encode(image) * noise(1)).sum().backward()
        gradients.append(image.grad)
        calls.append(counts)
    assert calls == [{"down": 2, "mid": 2}, {"down": 1, "mid": 1}]
    assert torch.equal(*gradients)


def test_half_precision_autoencoder_needs_sums(fresh: StableDiffusion) -> None:
    """A sum's gradient survives fp16; that of a mean over the latents partly underflows."""

    def gradient(reduce: Callable[[Tensor], Tensor]) -> Tensor:
        image = picture().requires_grad_()
        reduce(fresh.encode(image) * 1e-2 * noise(1)).backward()
        assert image.grad is not None and fresh.encode(image).dtype == torch.float32
        return image.grad.double().flatten()

    exact = gradient(torch.sum)
    fresh.vae.half()
    cosines = [
        float(torch.cosine_similarity(gradient(reduce), exact, dim=0))
        for reduce in (torch.sum, torch.mean)
    ]
    assert cosines[0] > 0.9999 and cosines[1] < 0.95


def test_decode_is_sliced_and_bounded(
    prior: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Memory does not grow with the number of pictures, which are those of one batch."""
    latents = 2.0 * noise(3)
    with torch.no_grad():
        whole = prior.vae.decode(latents / 0.18215).sample / 2.0 + 0.5
    sizes = []
    decode = prior.vae.decode
    monkeypatch.setattr(prior.vae, "decode", lambda z: (sizes.append(len(z)), decode(z))[1])
    found = prior.decode(latents)
    assert sizes == [1, 1, 1]
    torch.testing.assert_close(found, whole.clamp(0.0, 1.0), rtol=0, atol=ROUNDING)
    assert 0.0 <= found.min() and found.max() <= 1.0


# Sampling and editing


def test_sample_is_the_pipeline_s(folders: Callable[[str], Path], prior: StableDiffusion) -> None:
    """Diffusers' own pipeline with the same solver and the same first noise."""
    from diffusers import DPMSolverMultistepScheduler, StableDiffusionPipeline

    folder = folders(prior.schedule.prediction_type)
    pipeline = StableDiffusionPipeline.from_pretrained(folder, local_files_only=True)
    pipeline.scheduler = DPMSolverMultistepScheduler.from_config(pipeline.scheduler.config)
    expected = pipeline(
        ["a scene", "sks style"],
        negative_prompt=["", ""],
        latents=torch.cat([noise(1, 11), noise(1, 12)]),
        num_inference_steps=4,
        guidance_scale=5.0,
        output_type="pt",
    ).images
    found = prior.sample(["a scene", "sks style"], [11, 12], steps=4, scale=5.0)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)  # 4 steps, amplified by 5


def test_sample_does_not_depend_on_its_batch(prior: StableDiffusion) -> None:
    """Each picture is a function of its prompt and seed; two runs give the same bytes."""
    prompts, seeds = ["a scene", "sks", "style"], [5, 6, 7]
    arguments: dict[str, Any] = {"steps": 3, "scale": 4.0}
    together = prior.sample(prompts, seeds, **arguments)
    assert torch.equal(together, prior.sample(prompts, seeds, **arguments))
    apart = prior.sample(prompts, seeds, batch=1, **arguments)
    torch.testing.assert_close(together, apart, rtol=0, atol=1e-4)
    last = prior.sample(prompts[::-1], seeds[::-1], batch=2, **arguments)[0]
    torch.testing.assert_close(together[2], last, rtol=0, atol=1e-4)
    assert (prior.sample(prompts[:1], [8], **arguments) - together[0]).abs().mean() > 1e-2


def test_sample_at_scale_one_needs_no_null(
    prior: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Null + 1 (prompt - null) is the prompt's prediction: half the work is left out."""
    sizes = []
    denoise = prior._denoise

    def seen(latents: Tensor, *rest: Any) -> Tensor:
        sizes.append(len(latents))
        return denoise(latents, *rest)

    monkeypatch.setattr(prior, "_denoise", seen)
    plain = prior.sample(["scene"], [3], steps=2, scale=1.0)
    nearly = prior.sample(["scene"], [3], steps=2, scale=1.0 + 1e-6)
    assert sizes == [1, 1, 2, 2]
    torch.testing.assert_close(plain, nearly, rtol=0, atol=1e-4)


def test_sample_and_edit_use_the_adapter(adapted: StableDiffusion) -> None:
    arguments: dict[str, Any] = {"steps": 2, "scale": 3.0}
    pictures = [
        adapted.sample(["scene"], [3], adapter=name, **arguments) for name in (None, "first")
    ]
    assert (pictures[0] - pictures[1]).abs().mean() > 1e-3
    edits = [
        adapted.edit(pictures[0], "scene", 3, strength=0.7, adapter=name, **arguments)
        for name in (None, "first")
    ]
    assert (edits[0] - edits[1]).abs().mean() > 1e-3


def test_edit_at_strength_zero_is_the_round_trip(prior: StableDiffusion) -> None:
    image = picture()
    found = prior.edit(image, "scene", 1, strength=0.0, steps=5, scale=7.5)
    assert torch.equal(found, prior.decode(prior.encode(image)))


def test_edit_is_ddim(prior: StableDiffusion) -> None:
    """Noised to time 0.4 and brought back by DDIM's formula (arXiv 2010.02502, eq. 12, eta 0)."""
    image, embeddings = picture(), prior.embed(["a scene"])
    with torch.no_grad():
        clean = prior.encode(image)
    bars = [*prior.schedule.alphas_cumprod[[400, 300, 200, 100]].tolist(), 1.0]
    latents = math.sqrt(bars[0]) * clean + math.sqrt(1.0 - bars[0]) * noise(1, 21)
    for t, bar, later in zip((0.4, 0.3, 0.2, 0.1), bars[:-1], bars[1:], strict=True):
        eps = prior.predict(latents, torch.tensor([t]), embeddings, [None])
        x0 = (latents - math.sqrt(1.0 - bar) * eps) / math.sqrt(bar)
        latents = math.sqrt(later) * x0 + math.sqrt(1.0 - later) * eps
    found = prior.edit(image, "a scene", 21, strength=0.4, steps=4, scale=1.0)
    torch.testing.assert_close(found, prior.decode(latents), rtol=0, atol=1e-4)


def test_edit_is_repeatable_and_grows_with_strength(prior: StableDiffusion) -> None:
    """More noise leaves less of the picture; more steps than timesteps do no harm."""
    image = prior.decode(noise(1))
    rest = prior.decode(prior.encode(image))

    def change(strength: float, steps: int = 5) -> float:
        edited = [
            prior.edit(image, "a", 4, strength=strength, steps=steps, scale=2.0) for _ in range(2)
        ]
        assert torch.equal(*edited)
        return float((edited[0] - rest).abs().mean())

    changes = [change(0.005, steps=20), change(0.1), change(0.5)]
    assert 0.0 < changes[0] < changes[1] < changes[2]


# Prompts


def test_embeddings_are_the_pipeline_s(
    folders: Callable[[str], Path], prior: StableDiffusion
) -> None:
    """Diffusers' own encoding, padding of Stable Diffusion 2 included; null as well."""
    from diffusers import StableDiffusionPipeline

    folder = folders(prior.schedule.prediction_type)
    pipeline = StableDiffusionPipeline.from_pretrained(folder, local_files_only=True)
    prompts = ["a scene in the style of sks rendering", ""]
    with torch.no_grad():
        expected = pipeline.encode_prompt(prompts, "cpu", 1, False)[0]
    torch.testing.assert_close(prior.embed(prompts), expected, rtol=0, atol=ROUNDING)
    padded = prior.tokenizer("sks", padding="max_length", max_length=77).input_ids
    assert padded[-1] == prior.tokenizer.convert_tokens_to_ids("!")


def test_prompts_are_embedded_once(fresh: StableDiffusion) -> None:
    """The text encoder sees each prompt once, and may then be freed."""
    assert fresh.text_encoder is not None
    calls: list[int] = []
    handle = fresh.text_encoder.register_forward_hook(lambda *_: calls.append(1))
    first = fresh.embed(["scene", "", "scene"])
    assert len(calls) == 2 and torch.equal(first[0], first[2])
    fresh.sample(["scene", "scene"], [1, 2], steps=1, scale=2.0)
    assert len(calls) == 2
    handle.remove()

    gone = weakref.ref(fresh.text_encoder)
    fresh.free_text_encoder()
    gc.collect()
    assert gone() is None
    assert torch.equal(fresh.embed(["", "scene"]), first[1:])
    with pytest.raises(ModelError, match=r"freed.*'sks'"):
        fresh.embed(["scene", "sks"])


@pytest.mark.case("F4")
def test_long_prompt_is_cut_with_a_notice(fresh: StableDiffusion) -> None:
    """77 tokens are read, two of them marks; the notice tells where the rest was left off."""
    count = len(fresh.notices)
    fits, longer = " ".join(["scene"] * 75), " ".join(["scene"] * 74 + ["style", "sks", "sks"])
    fresh.embed([fits])
    assert len(fresh.notices) == count
    cut = fresh.embed([longer, longer, " ".join(["scene"] * 74 + ["style"])])
    assert torch.equal(cut[0], cut[2])
    (notice,) = fresh.notices[count:]
    assert "79 tokens" in notice and "truncated after 77" in notice and "style'" in notice


# Weights, precision, memory


def test_digest_follows_every_file(folders: Callable[[str], Path], tmp_path: Path) -> None:
    """A changed bit, another line: another model. The same bytes elsewhere: the same."""
    import hashlib

    folder = Path(shutil.copytree(folders("epsilon"), tmp_path / "model"))
    prior = load(folder)
    assert prior.digest == load(folders("epsilon")).digest
    assert prior.file_hashes == {
        name: hashlib.sha256((folder / name).read_bytes()).hexdigest()
        for name in (
            "scheduler/scheduler_config.json",
            "text_encoder/config.json",
            "text_encoder/model.safetensors",
            "tokenizer/merges.txt",
            "tokenizer/special_tokens_map.json",
            "tokenizer/tokenizer_config.json",
            "tokenizer/vocab.json",
            "unet/config.json",
            "unet/diffusion_pytorch_model.safetensors",
            "vae/config.json",
            "vae/diffusion_pytorch_model.safetensors",
        )
    }
    digests = {prior.digest}
    changed = [name for name in prior.file_hashes if name.endswith(".safetensors")]
    changed += ["vae/config.json", "tokenizer/vocab.json"]
    for name in changed:
        content = bytearray((folder / name).read_bytes())
        if name.endswith(".safetensors"):
            content[-4] ^= 1  # the last bit of a number
        else:
            content += b"\n"
        (folder / name).write_bytes(content)
        digests.add(load(folder).digest)
    assert len(digests) == 1 + len(changed)


def test_precision_is_in_the_key_of_what_is_made(fresh: StableDiffusion) -> None:
    """Pictures and LoRAs of half precision are none of full precision's, of either network."""
    keys = {model_key(fresh)}
    for part in ("unet", "vae"):
        getattr(fresh, part).half()
        fresh.unet_dtype = fresh.unet.dtype
        keys.add(model_key(fresh))
    assert len(keys) == 3 and fresh.precision == {"unet": "fp16", "vae": "fp16"}


@pytest.mark.case("L7")
def test_a_resumed_run_keeps_the_precision_it_fell_back_to(fresh: StableDiffusion) -> None:
    """And what was said of it; a model that had no need to stays as it is."""
    for part in (fresh.unet, fresh.vae):
        part.half()
    fresh.unet_dtype, before = torch.float16, fresh.notices
    fresh.load_state_dict(fresh.state_dict())
    assert fresh.precision == {"unet": "fp16", "vae": "fp16"} and fresh.notices == before
    state = {"precision": {"unet": "fp32", "vae": "fp32"}, "notices": [*before, "fell back"]}
    fresh.load_state_dict(state)
    assert fresh.precision == {"unet": "fp32", "vae": "fp32"}
    assert fresh.notices == (*before, "fell back")


def test_cpu_computes_in_fp32_and_says_so(folders: Callable[[str], Path]) -> None:
    prior = load(folders("epsilon"), precision="fp16", vae_precision="bf16")
    assert {prior.unet.dtype, prior.vae.dtype, prior.unet_dtype} == {torch.float32}
    assert "fp32" in prior.notices[0] and "bf16, fp16" in prior.notices[0]
    assert load(folders("epsilon"), precision="fp32", vae_precision="fp32").notices == ()


@pytest.fixture
def low(fresh: StableDiffusion) -> Iterator[StableDiffusion]:
    """UNet in bf16, as on a GPU; the CPU can do it too."""
    add_lora(fresh, "scene", 1, layers=LAYERS)
    fresh.unet.to(torch.bfloat16)
    fresh.unet_dtype = torch.bfloat16
    yield fresh


def differences(prior: StableDiffusion, distance: float) -> Callable[[], Tensor]:
    """Return LDS-like differences of two predictions whose prompts are ``distance`` apart."""
    noisy, t = noise(2).repeat(2, 1, 1, 1), torch.tensor([0.3, 0.6]).repeat(2)
    one, other = prior.embed(["a scene", "rendering"])
    embeddings = torch.stack([one, one, one + distance * (other - one), one])
    embeddings[3] = embeddings[2]

    def difference() -> Tensor:
        first, second = prior.predict(noisy, t, embeddings, [None] * 4).chunk(2)
        return first - second

    return difference


@pytest.mark.case("L7")
def test_precision_check_sees_what_rounding_spoils(low: StableDiffusion) -> None:
    """The smaller the difference, the more of it is rounding; fp32 has none to speak of."""
    cosines = [low.precision_check(differences(low, distance)) for distance in (1.0, 0.01)]
    assert cosines[1] < 0.9 < cosines[0] < 1.0
    with low.in_full_precision():
        assert low.precision_check(differences(low, 0.01)) == 1.0


def test_full_precision_is_exact_and_undone(low: StableDiffusion) -> None:
    """Within the context all arithmetic is fp32, adapters included; then memory is as before."""
    arguments = (noise(2), torch.tensor([0.3, 0.6]), low.embed(["a", "b"]), ["scene", None])
    before = low.predict(*arguments)
    addresses = [weight.data_ptr() for weight in low.unet.parameters()]
    exact = load_exact_copy(low)
    with low.in_full_precision():
        assert {weight.dtype for weight in low.unet.parameters()} == {torch.float32}
        full = low.predict(*arguments)
    assert torch.equal(full, exact.predict(*arguments))
    assert [weight.data_ptr() for weight in low.unet.parameters()] == addresses
    assert torch.equal(low.predict(*arguments), before)
    assert 0.0 < (full - before).abs().max() < 0.1


def load_exact_copy(prior: StableDiffusion) -> StableDiffusion:
    """Return a model in fp32 whose weights were rounded as the prior's."""
    import copy

    other = copy.copy(prior)
    other.unet = copy.deepcopy(prior.unet).float()
    other.unet_dtype = torch.float32
    return other


@pytest.mark.case("L7")
def test_ensure_precision_falls_back_with_a_notice(low: StableDiffusion) -> None:
    count = len(low.notices)
    assert low.ensure_precision(differences(low, 3.0)) >= 0.98
    assert low.unet_dtype is torch.bfloat16 and len(low.notices) == count
    assert low.ensure_precision(differences(low, 0.01)) < 0.98
    assert low.unet_dtype is low.unet.dtype is torch.float32
    (notice,) = low.notices[count:]
    assert "bf16" in notice and "fp32" in notice
    assert low.ensure_precision(differences(low, 0.01)) == 1.0


@pytest.mark.case("L7")
def test_ensure_precision_falls_back_from_overflow(fresh: StableDiffusion) -> None:
    """Values of attention that overflow in fp16 give nan, whose cosine is no number either."""
    for name, weight in fresh.unet.named_parameters():
        weight.data *= 3e5 if "to_v" in name else 1e-5 if "to_out.0.weight" in name else 1.0
    difference = differences(fresh, 1.0)
    assert bool(torch.isfinite(difference()).all())
    fresh.unet.half()
    fresh.unet_dtype = torch.float16
    assert math.isnan(fresh.ensure_precision(difference))
    assert fresh.unet_dtype is torch.float32 and bool(torch.isfinite(difference()).all())


def test_fp32_convolutions_are_not_rounded(
    low: StableDiffusion, monkeypatch: pytest.MonkeyPatch
) -> None:
    """TF32, which cuDNN uses unasked, has no more bits than fp16."""
    seen = []
    low.unet.conv_in.register_forward_hook(lambda *_: seen.append(torch.backends.cudnn.allow_tf32))
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    arguments = (noise(1), torch.tensor([0.5]), low.embed(["a"]), [None])
    low.predict(*arguments)
    with low.in_full_precision():
        low.predict(*arguments)
    assert seen == [True, False] and torch.backends.cudnn.allow_tf32
