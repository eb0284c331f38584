"""The embedded prior: words, network, files, and the contract it shares with Stable Diffusion."""

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

import warpir.diffusion.personalization.personalize as personalize_module
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.models.embedded import (
    CONDITIONS,
    GBUFFER_CHANNELS,
    HEADER_KEY,
    WEIGHTS,
    EmbeddedPrior,
    NetworkConfig,
    build_network,
    cosine_schedule,
    load_embedded,
    pack,
    random_embedded,
    save_embedded,
)
from warpir.diffusion.models.embedded_words import (
    DROP_ATTRIBUTE,
    DROP_KIND,
    DROP_PROMPT,
    KINDS,
    NOUNS,
    RESERVED,
    SETTINGS,
    SYNONYMS,
    TOKEN_COUNT,
    UNKNOWN_SHARE,
    VOCABULARY,
    VOCABULARY_SIZE,
    WEATHERS,
    embedded_prompts,
    tokenize,
    training_tokens,
)
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.network_prior import NetworkPrior
from warpir.diffusion.models.stable_diffusion import load_stable_diffusion
from warpir.diffusion.personalization.lora_files import (
    Lora,
    initial_lora,
    install_lora,
    remove_lora,
    save_lora,
)
from warpir.diffusion.personalization.personalize import personalize
from warpir.diffusion.prior import Condition
from warpir.diffusion.settings import GuidanceSettings, ModelSettings, PersonalizeSettings

LORA_RANK, LORA_LAYERS = 8, ("to_q", "to_k", "to_v", "to_out.0", "conv1", "conv2")
TINY = NetworkConfig(
    widths=(16, 32), layers=1, attention_from=1, head_width=16, groups=8, embedding_width=16
)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def tiny() -> EmbeddedPrior:
    return random_embedded(0, "cpu", TINY)


@pytest.fixture
def embedded(tiny: EmbeddedPrior) -> Iterator[EmbeddedPrior]:
    """The tiny prior, without adapters before and after."""
    yield tiny
    for name in list(tiny.adapters):
        remove_lora(tiny, name)


@pytest.fixture(scope="module")
def both(tiny: EmbeddedPrior, tmp_path_factory: pytest.TempPathFactory) -> dict[str, NetworkPrior]:
    folder = make_tiny_stable_diffusion(tmp_path_factory.mktemp("model"), "v_prediction")
    loaded = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    return {"embedded": tiny, "stable-diffusion": loaded}


def scene(count: int = 1, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return random pictures, backgrounds and G-buffers with a square object."""
    g = torch.Generator().manual_seed(seed)
    image, background = (torch.rand(count, n, 64, 64, generator=g) for n in (3, 6))
    mask = torch.zeros(count, 1, 64, 64)
    mask[:, :, 20:44, 16:40] = 1.0
    rest = torch.rand(count, GBUFFER_CHANNELS - 1, 64, 64, generator=g)
    return image, background, torch.cat([mask, mask * rest], dim=1)


def words_of(ids: list[int]) -> str:
    return " ".join(VOCABULARY[i] for i in ids if i)


# Words


def test_vocabulary_fits_its_table() -> None:
    """Every word once, and what synonyms stand for is in it."""
    assert len(set(VOCABULARY)) == len(VOCABULARY) <= VOCABULARY_SIZE == 64
    assert VOCABULARY[0] == "<pad>" and NOUNS[0] == "object" and KINDS[0] == "consistent"
    assert len(RESERVED) == 8 and "sks" in RESERVED
    assert set(SYNONYMS.values()) <= set(VOCABULARY) and not set(SYNONYMS) & set(VOCABULARY)


@pytest.mark.parametrize(
    ("prompt", "words"),
    [
        ("", ""),
        ("   ", ""),
        ("a photo of a car", "consistent car"),
        ("A photo of an SUV, outdoors!", "consistent car outdoor"),
        ("a black SUV car", "consistent <unk> car"),
        ("a scene in the style of sks rendering", "consistent sks"),
        ("mismatched color truck", "mismatched colour truck"),
        ("mismatched shadows of two mugs", "mismatched shadow <unk> mug"),
        ("consistent cow at dusk", "consistent cow twilight"),
        ("a very old wooden chair", "consistent <unk> chair"),
        ("a glass", "consistent cup"),
        ("a photo", "consistent"),
    ],
)
def test_sentences_map_to_known_words(prompt: str, words: str) -> None:
    ids = tokenize(prompt)
    assert len(ids) == TOKEN_COUNT and words_of(ids) == words


def test_a_long_prompt_is_cut() -> None:
    ids = tokenize(" ".join(NOUNS))
    assert words_of(ids).split() == ["consistent", *NOUNS[: TOKEN_COUNT - 1]]


def test_training_says_what_a_sentence_says() -> None:
    """Without dropping, ids are those of the words in order; every index of every kind."""
    count = len(NOUNS)
    index = torch.arange(count)
    setting, weather = index % len(SETTINGS), index % len(WEATHERS)
    kind = index % len(KINDS)
    ids = training_tokens(index, setting, weather, kind)
    assert ids.shape == (count, TOKEN_COUNT) and ids.dtype == torch.int64
    for place in range(count):
        judged = "consistent" if kind[place] == 0 else f"mismatched {KINDS[int(kind[place])]}"
        prompt = f"{judged} {NOUNS[place]} {SETTINGS[setting[place]]} {WEATHERS[weather[place]]}"
        assert ids[place].tolist() == tokenize(prompt)


def test_what_is_not_known_is_not_said() -> None:
    unsaid = torch.tensor([-1])
    ids = training_tokens(torch.tensor([1]), unsaid, unsaid, unsaid)
    assert ids[0].tolist() == tokenize("mismatched car")


def test_words_are_dropped_as_often_as_stated() -> None:
    """The judgement goes only with the whole prompt; reserved words never come."""
    count = 40_000
    ones = torch.ones(count, dtype=torch.int64)
    g = torch.Generator().manual_seed(0)
    ids = training_tokens(ones, ones, ones, ones, g)

    def share(word: str) -> float:
        return float((ids == VOCABULARY.index(word)).any(dim=1).float().mean())

    prompted = 1.0 - DROP_PROMPT
    tolerance = 4.0 * math.sqrt(0.25 / count)
    assert float((ids == 0).all(dim=1).float().mean()) == pytest.approx(DROP_PROMPT, abs=tolerance)
    assert share("mismatched") == pytest.approx(prompted, abs=tolerance)
    assert share("direction") == pytest.approx(prompted * (1 - DROP_KIND), abs=tolerance)
    for word in (NOUNS[1], SETTINGS[1], WEATHERS[1]):
        assert share(word) == pytest.approx(prompted * (1 - DROP_ATTRIBUTE), abs=tolerance)
    none_unknown = (1.0 - DROP_ATTRIBUTE * UNKNOWN_SHARE) ** 3
    assert share("<unk>") == pytest.approx(prompted * (1 - none_unknown), abs=tolerance)
    assert int(ids.max()) < VOCABULARY.index(RESERVED[0])
    # No gaps: after the first padding there is nothing but padding.
    is_pad = ids == 0
    assert bool((is_pad[:, 1:] | ~is_pad[:, :-1]).all())


def test_prompts_of_a_run() -> None:
    plain = PersonalizeSettings()
    made = embedded_prompts("a black SUV at night", plain)
    assert made.guidance == "consistent car night" and made.negative == "mismatched car night"
    assert made.noun == "car" and made.unknown == ("black",)
    unknown = embedded_prompts("a sofa", replace(plain, indoors=True), personalized=True)
    assert words_of(tokenize(unknown.guidance)) == "consistent object indoor sks"
    assert words_of(tokenize(unknown.class_)) == "consistent object"
    assert words_of(tokenize(unknown.photo)) == "consistent sks"
    assert embedded_prompts("a red sofa", replace(plain, class_noun="chair")).noun == "chair"
    with pytest.raises(ValueError, match="prompt"):
        embedded_prompts(" ", plain)


# The network


def test_the_network_has_its_size() -> None:
    """At most 20.6 MB in fp16, heads of 32 channels, and every weight counts."""
    network = build_network()
    assert 9.9e6 < sum(p.numel() for p in network.parameters()) < 10.3e6
    heads = {
        module.to_q.out_features // module.heads
        for module in network.modules()
        if hasattr(module, "to_q")
    }
    assert heads == {32}
    _, background, gbuffer = scene(2)
    ids = training_tokens(*[torch.arange(2)] * 4)
    present = torch.ones(2, len(CONDITIONS))
    noisy, timesteps = torch.randn(2, 3, 64, 64), torch.tensor([10, 800])
    v = network(noisy, timesteps, network.embed(ids), background, gbuffer, present)
    assert v.shape == (2, 3, 64, 64)
    v.square().mean().backward()
    idle = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.any()]
    assert idle == []


def test_folding_is_orthonormal() -> None:
    """White noise stays white: packing keeps lengths, unpacking undoes it."""
    noisy = torch.randn(2, 3, 64, 64)
    none = torch.zeros(2, GBUFFER_CHANNELS, 64, 64)
    packed = pack(noisy, none[:, :6], none, torch.zeros(2, len(CONDITIONS)))
    assert packed.shape == (2, 93, 32, 32)
    assert float(packed.norm()) == pytest.approx(float(noisy.norm()), rel=1e-6)
    assert torch.equal(nn.functional.pixel_shuffle(packed[:, :12], 2), noisy)


def test_only_what_is_shown_reaches_the_network() -> None:
    """Each condition alone has its channels and its flag; a shown mask blanks the background."""
    image, background, gbuffer = scene()
    gbuffer[:, 1:] += 0.1
    channels = {
        "background": (12, 36), "mask": (36, 40), "albedo": (40, 52), "normals": (52, 64),
        "light": (64, 88),
    }  # fmt: skip
    for place, name in enumerate(CONDITIONS):
        present = torch.zeros(1, len(CONDITIONS))
        present[0, place] = 1.0
        # Of the light nothing is known without the photo.
        expected = [] if name == "light" else [name]
        for _ in range(2):
            packed = pack(image, background, gbuffer, present)[0]
            for other, (low, high) in channels.items():
                assert bool(packed[low:high].any()) is (other in expected)
            flags = [float(other in expected) for other in CONDITIONS]
            assert packed[88:].mean(dim=(1, 2)).tolist() == flags
            present[0, 0] = 1.0
            expected = ["background", name]
    both = pack(image, background, gbuffer, torch.tensor([[1.0, 1.0, 0.0, 0.0, 0.0]]))
    shown = nn.functional.pixel_shuffle(both[:, 12:36], 2)
    told = 2.0 * background - 1.0
    assert torch.equal(shown[:, :3], told[:, :3] * (1.0 - gbuffer[:, :1]))
    # The whole photo is told as it is: the mask is the crop's.
    assert torch.equal(shown[:, 3:], told[:, 3:])


def test_schedule_is_a_cosine() -> None:
    """guidance.md 1.3: t = .3 / .5 / .6 / .8 / .9 -> sigma .454 / .707 / .809 / .951 / .988."""
    schedule = cosine_schedule()
    t = torch.tensor([0.3, 0.5, 0.6, 0.8, 0.9])
    a, s = schedule.alpha_sigma(t)
    assert s.tolist() == pytest.approx([0.454, 0.707, 0.809, 0.951, 0.988], abs=1.5e-3)
    assert (a.square() + s.square()).tolist() == pytest.approx([1.0] * 5)
    assert float(schedule.alphas_cumprod[-1]) > 0.0


# The contract of `warpir.diffusion.prior.Prior`, for both


@pytest.mark.parametrize("name", ["embedded", "stable-diffusion"])
def test_priors_honour_the_same_contract(both: dict[str, NetworkPrior], name: str) -> None:
    prior = both[name]
    assert prior.name == name and len(prior.digest) == 64 and prior.resolution == 64
    assert all(len(sha256) == 64 for sha256 in prior.file_hashes.values())
    embeddings = prior.embed(["a photo of a car", ""])
    assert embeddings.ndim == 3 and embeddings.dtype == torch.float32
    assert not torch.equal(embeddings[0], embeddings[1])
    assert torch.equal(embeddings[:1], prior.embed(["a photo of a car"]))

    image, background, gbuffer = scene(2)
    image.requires_grad_()
    latents = prior.encode(image)
    assert latents.shape == (2, *prior.latent_shape) and latents.dtype == torch.float32
    (d_image,) = torch.autograd.grad(latents.square().sum(), image)
    assert bool(torch.isfinite(d_image).all()) and d_image.norm() > 0
    with pytest.raises(ValueError, match="image"):
        prior.encode(image[:, :, :32])

    t = torch.tensor([0.2, 0.8])
    noisy = prior.schedule.add_noise(latents, torch.randn_like(latents), t)
    for conditions in ((None, None), (background, None), (None, gbuffer), (background, gbuffer)):
        e = prior.predict(noisy, t, embeddings, [None, None], *conditions)
        assert e.shape == latents.shape and e.dtype == torch.float32 and not e.requires_grad
        assert bool(torch.isfinite(e).all())
        single = [None if c is None else c[1:] for c in conditions]
        alone = prior.predict(noisy[1:], t[1:], embeddings[1:], [None], *single)
        torch.testing.assert_close(alone, e[1:], atol=2e-5, rtol=1e-4)
    with pytest.raises(ModelError, match="no adapter 'scene'"):
        prior.predict(noisy, t, embeddings, [None, "scene"], background, gbuffer)
    kept = prior.predict(noisy, t, embeddings, [None] * 2, background, gbuffer, [True, True])
    assert torch.equal(kept, e)

    pictures = prior.sample(["a car"], [1], steps=2, scale=2.0)
    assert pictures.shape == (1, 3, 64, 64) and 0.0 <= pictures.min() <= pictures.max() <= 1.0
    edited = prior.edit(image[:1].detach(), "a car", 0, strength=0.5, steps=2, scale=1.0)
    assert edited.shape == (1, 3, 64, 64)
    assert prior.ensure_precision(lambda: noisy) == 1.0
    prior.forget_graphs()


def test_predict_is_the_networks_noise(embedded: EmbeddedPrior) -> None:
    """``e = a v + s z``, and each condition changes it."""
    image, background, gbuffer = scene(2)
    z, t = 2.0 * image - 1.0, torch.tensor([0.3, 0.7])
    embeddings = embedded.embed(["a car", "a cow"])
    a, s = (x[:, None, None, None] for x in embedded.schedule.alpha_sigma(t))

    def expected(present: list[list[float]]) -> Tensor:
        with torch.no_grad():
            v = embedded.network(
                z, (t * 1000).long(), embeddings, background, gbuffer, torch.tensor(present)
            )
        return a * v + s * z

    def found(
        background: Tensor | None, gbuffer: Tensor | None, keep: list[bool] | None = None
    ) -> Tensor:
        return embedded.predict(z, t, embeddings, [None] * 2, background, gbuffer, keep)

    for got, present in (
        (found(background, gbuffer), [[1.0] * 5] * 2),
        (found(None, gbuffer), [[0.0, 1.0, 1.0, 1.0, 1.0]] * 2),
        (found(background, None), [[1.0, 0.0, 0.0, 0.0, 0.0]] * 2),
        (found(None, None), [[0.0] * 5] * 2),
        (found(background, gbuffer, [True, False]), [[1.0] * 5, [0.0, 1.0, 1.0, 1.0, 1.0]]),
    ):
        torch.testing.assert_close(got, expected(present), atol=1e-6, rtol=1e-5)
    full = found(background, gbuffer)
    for other in (found(None, gbuffer), found(background, None)):
        assert (full - other).abs().max() > 1e-4


def test_conditions_of_another_size_are_refused(embedded: EmbeddedPrior) -> None:
    image, background, gbuffer = scene(2)
    arguments = image, torch.full((2,), 0.5), embedded.embed(["", ""]), [None, None]
    with pytest.raises(ValueError, match="background"):
        embedded.predict(*arguments, background[:1], gbuffer)
    with pytest.raises(ValueError, match="gbuffer"):
        embedded.predict(*arguments, background, gbuffer[:, :6])
    with pytest.raises(ValueError, match="keep_background"):
        embedded.predict(*arguments, background, gbuffer, [True])


def test_a_pixel_is_its_own_latent(embedded: EmbeddedPrior) -> None:
    image = scene()[0]
    assert torch.equal(embedded.encode(image), 2.0 * image - 1.0)
    torch.testing.assert_close(embedded.decode(embedded.encode(image)), image)


# Guidance and personalisation by the code that Stable Diffusion has


def adapted(prior: EmbeddedPrior, gain: float) -> EmbeddedPrior:
    """Put a LoRA ``scene`` beside the weights; gain 0 adapts nothing."""
    lora = initial_lora(prior, LORA_LAYERS, LORA_RANK, seed=0)
    g = torch.Generator().manual_seed(5)
    weights = {
        name: gain * torch.randn(value.shape, generator=g) if ".lora_B" in name else value
        for name, value in lora.weights.items()
    }
    install_lora(prior, Lora(weights, lora.alphas, lora.targets), "scene")
    return prior


def guidance_of(prior: EmbeddedPrior, loss: str) -> tuple[Guidance, Tensor, Tensor]:
    """Return guidance on a picture of 72 x 96, the picture, and its mask."""
    g = torch.Generator().manual_seed(3)
    image, background = (torch.rand(1, 3, 72, 96, generator=g) for _ in range(2))
    gbuffer = torch.zeros(1, GBUFFER_CHANNELS, 72, 96)
    gbuffer[:, :, 30:60, 40:70] = 1.0
    prompts = embedded_prompts("a car", PersonalizeSettings(), personalized=True)
    condition = Condition(
        prompts.guidance,
        negative_prompt=prompts.negative,
        background=background,
        gbuffer=gbuffer,
    )
    settings = replace(GuidanceSettings(), loss=loss, noises=2, weight="uniform")
    mask = gbuffer[0, 0]
    return Guidance(prior, condition, settings, mask, 10, 3, "scene"), image, mask


@pytest.mark.parametrize("loss", ["lds", "csd", "sds", "lds-negative"])
def test_guidance_moves_the_object(embedded: EmbeddedPrior, loss: str) -> None:
    guide, image, mask = guidance_of(adapted(embedded, 0.1), loss)
    d_image = guide.gradient(image, 0)
    assert d_image is not None and d_image.shape == image.shape
    assert bool(torch.isfinite(d_image).all()) and (d_image * mask).norm() > 0
    assert guide.ensure_precision(image) == 1.0


def test_zero_lora_makes_lds_equal_csd_exactly(embedded: EmbeddedPrior) -> None:
    for gain in (0.0, 0.1):
        adapted(embedded, gain)
        made = []
        for loss in ("lds", "csd"):
            guide, image, _ = guidance_of(embedded, loss)
            made.append(guide.gradient(image, 4))
        assert made[0] is not None and made[1] is not None and made[0].norm() > 0
        assert torch.equal(made[0], made[1]) is (gain == 0.0)


def own_weights(prior: EmbeddedPrior) -> dict[str, Tensor]:
    """Return copies of the network's weights by name, as if it never had an adapter."""
    held = prior.network.state_dict().items()
    return {k.replace(".base_layer", ""): v.clone() for k, v in held if ".lora_" not in k}


def test_personalisation_learns_the_photo(
    embedded: EmbeddedPrior, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code of Stable Diffusion, with class images of its own; the weights stay as they were."""
    monkeypatch.setattr(personalize_module, "CROP_COUNT", 4)
    before = own_weights(embedded)
    settings = PersonalizeSettings(
        lora_rank=LORA_RANK, lora_layers=LORA_LAYERS, lora_steps=12, lora_rate=3e-3,
        class_images=2, class_steps=2, class_scale=1.0,
    )  # fmt: skip
    prompts = embedded_prompts("a car", settings, personalized=True)
    photo = torch.linspace(0.1, 0.9, 3)[None, :, None, None].expand(1, 3, 80, 96).contiguous()
    made = personalize(embedded, photo, prompts, settings, 0, None)
    assert made.evaluation is not None and made.evaluation[1] < made.evaluation[0]
    assert made.losses.shape == (12, 2) and bool((made.losses > 0).all())
    assert embedded.adapters == {"scene"}
    files = save_lora(made.lora, tmp_path, 16, "v_prediction", prompts.photo, embedded.name)
    assert [file.name for file in files] == ["lora_diffusers.safetensors"]

    z, t = torch.randn(1, 3, 64, 64), torch.tensor([0.5])
    asked = z, t, embedded.embed([prompts.guidance])
    trained = embedded.predict(*asked, ["scene"])
    assert not torch.equal(trained, embedded.predict(*asked, [None]))
    given = replace(settings, lora=str(files[0]))
    personalize(embedded, photo, prompts, given, 0, None)
    torch.testing.assert_close(embedded.predict(*asked, ["scene"]), trained)
    remove_lora(embedded, "scene")
    after = own_weights(embedded)
    assert all(torch.equal(before[name], after[name]) for name in before)


# Files


def test_files_come_back(tmp_path: Path) -> None:
    """Weights are rounded to fp16 once; the same weights give the same bytes."""
    file, again = tmp_path / "prior.safetensors", tmp_path / "again.safetensors"
    network = build_network(TINY, seed=4)
    save_embedded(network, file, {"steps": 7})
    found = load_embedded(file, "cpu")
    assert found.training == {"steps": 7} and found.network.config == TINY
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    assert found.file_hashes == {"prior.safetensors": sha256}
    held = found.network.state_dict()
    for name, value in network.state_dict().items():
        assert held[name].dtype == torch.float32
        assert torch.equal(held[name], value.half().float())
    save_embedded(found.network, again, {"steps": 7})
    assert again.read_bytes() == file.read_bytes()


def test_random_priors_differ_by_seed_alone() -> None:
    first, second, other = (random_embedded(seed, "cpu", TINY) for seed in (1, 1, 2))
    assert first.digest == second.digest != other.digest
    state = torch.get_rng_state()
    random_embedded(3, "cpu", TINY)
    assert torch.equal(torch.get_rng_state(), state)


def changed_header(content: bytes, **changes: object) -> bytes:
    """Return a safetensors file with another description of its weights."""
    length = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + length])
    described = json.loads(header["__metadata__"][HEADER_KEY]) | changes
    header["__metadata__"][HEADER_KEY] = json.dumps(described)
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + content[8 + length :]


def test_faulty_files_are_refused_in_one_line(tmp_path: Path) -> None:
    file, bad = tmp_path / "prior.safetensors", tmp_path / "bad.safetensors"
    save_embedded(build_network(TINY), file, {})
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[-100] ^= 1
    size = asdict(TINY)
    foreign = Lora({"a.lora_A.weight": torch.ones(1, 2), "a.lora_B.weight": torch.ones(2, 1)}, {})
    save_lora(replace(foreign, alphas={"a": 1.0}), tmp_path, 16, "v_prediction", "", "embedded")
    for content, reason in (
        (whole[: len(whole) // 2], "cut or damaged"),
        (bytes(flipped), "not those that were written"),
        (b"PK\x03\x04", "pickle"),
        ((tmp_path / "lora_diffusers.safetensors").read_bytes(), "holds no embedded prior"),
        (changed_header(whole, format=99), "format 99"),
        (changed_header(whole, vocabulary=["car"]), "another vocabulary"),
        (changed_header(whole, network={**size, "layers": 3}), "do not fit"),
        (changed_header(whole, network={"depth": 3, "widths": [1]}), "header is damaged"),
        (changed_header(whole, network={**size, "groups": 0}), "groups 0"),
        (changed_header(whole, training=[]), "header is damaged"),
    ):
        bad.write_bytes(content)
        with pytest.raises(ModelError, match=reason) as caught:
            load_embedded(bad, "cpu")
        assert caught.value.where == str(bad) and "\n" not in str(caught.value)
    with pytest.raises(ModelError, match="no such file"):
        load_embedded(tmp_path / "absent.safetensors", "cpu")


def test_values_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    network = build_network(TINY)
    with torch.no_grad():
        network.places[0, 0] = math.inf
    save_embedded(network, tmp_path / "prior.safetensors", {})
    with pytest.raises(ModelError, match="places: values are not finite"):
        load_embedded(tmp_path / "prior.safetensors", "cpu")


def test_weights_of_the_package_are_missed_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "warpir.diffusion.models.embedded.WEIGHTS", Path("/nowhere/prior.safetensors")
    )
    with pytest.raises(ModelError, match="not in this installation"):
        load_embedded(None, "cpu")


def test_shipped_weights_denoise() -> None:
    """They are this network's, small enough, and find most of the noise in a smooth picture."""
    prior = load_embedded(None, "cpu")
    assert prior.network.config == NetworkConfig() and WEIGHTS.stat().st_size <= 21_000_000
    assert prior.training["samples"] > 0
    ramp = torch.linspace(0.2, 0.7, 64).view(1, 1, 64, 1).expand(2, 3, 64, 64)
    latents = prior.encode(ramp)
    noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([0.4, 0.8])
    noisy = prior.schedule.add_noise(latents, noise, t)
    background = torch.cat([ramp, ramp], dim=1)
    (embedding,) = prior.embed(["consistent object"])
    found = prior.predict(noisy, t, embedding[None].expand(2, -1, -1), [None] * 2, background, None)
    errors = (found - noise).square().mean(dim=(1, 2, 3))
    assert float(errors.max()) < 0.1
