"""LoRA files: exact strength from every way of naming, and no file that fits only in part."""

import copy
import errno
import json
import math
import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from tests.builders.tiny_stable_diffusion import ATTENTION, make_tiny_stable_diffusion
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.personalization.lora_files import (
    Lora,
    adaptable_layers,
    initial_lora,
    install_lora,
    load_lora,
    lora_parameters,
    read_lora,
    remove_lora,
    save_lora,
    serialize,
)

pytestmark = pytest.mark.usefixtures("one_thread")

MORE = (*ATTENTION, "proj_in", "ff.net.0.proj", "ff.net.2", "conv1", "time_emb_proj", "conv_in")
TRIGGER = "a scene in the style of sks rendering"


def tiny_unet(cross_attention: int = 32) -> nn.Module:
    from diffusers import UNet2DConditionModel

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return UNet2DConditionModel(
            sample_size=8,
            block_out_channels=(16, 32),
            layers_per_block=1,
            attention_head_dim=(2, 4),
            use_linear_projection=True,
            cross_attention_dim=cross_attention,
            norm_num_groups=8,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        ).requires_grad_(False)


def bare_prior(unet: nn.Module | None = None) -> Any:
    """Return as much of a prior as a LoRA touches."""
    unet = unet or tiny_unet()
    return SimpleNamespace(
        unet=unet, adapters=set(), unet_dtype=unet.dtype, forget_graphs=lambda: None
    )


def output(unet: nn.Module, cross_attention: int = 32) -> Tensor:
    random = torch.Generator().manual_seed(5)
    with torch.no_grad():
        return unet(
            torch.randn(2, 4, 8, 8, generator=random),
            torch.tensor([10, 700]),
            torch.randn(2, 7, cross_attention, generator=random),
        ).sample


def random_lora(prior: Any, layers: tuple[str, ...] = ATTENTION, rank: int = 4) -> Lora:
    """Return a LoRA that changes much."""
    lora = initial_lora(prior, layers, rank, seed=0)
    random = torch.Generator().manual_seed(1)
    weights = {k: 0.3 * torch.randn(v.shape, generator=random) for k, v in lora.weights.items()}
    return replace(lora, weights=weights)


def uneven_lora(prior: Any, layers: tuple[str, ...] = ATTENTION) -> Lora:
    """Return a LoRA whose ranks and alphas differ between layers, and from each other."""
    four, two = random_lora(prior, layers, 4), random_lora(prior, layers, 2)
    weights, alphas = {}, {}
    for place, layer in enumerate(sorted(four.alphas)):
        chosen = two if place % 3 == 0 else four
        alphas[layer] = (1.0, 8.0, 3.0, 2.5, 8.0)[place % 5]
        for part in "AB":
            key = f"{layer}.lora_{part}.weight"
            weights[key] = chosen.weights[key]
    return Lora(weights, alphas)


def merged(unet: nn.Module, lora: Lora) -> nn.Module:
    """Return the UNet with the LoRA added to its weights: W + alpha / rank B A."""
    changed = copy.deepcopy(unet)
    for layer, alpha in lora.alphas.items():
        a, b = (lora.weights[f"{layer}.lora_{part}.weight"] for part in "AB")
        update = torch.einsum("or,r...->o...", b.flatten(1), a) * (alpha / len(a))
        changed.get_submodule(layer).weight.data += update
    return changed


def save(lora: Lora, folder: Path) -> tuple[Path, Path]:
    return save_lora(lora, folder, 32, "epsilon", TRIGGER)


def test_a_new_lora_changes_nothing() -> None:
    """B is zero; A is Gaussian of deviation 1/rank, a function of seed and layer."""
    prior = bare_prior()
    before = output(prior.unet)
    lora = initial_lora(prior, ATTENTION, 4, seed=3)
    install_lora(prior, lora, "scene")
    assert prior.adapters == {"scene"}
    assert torch.equal(output(prior.unet), before)
    assert not any(p.requires_grad for p in prior.unet.parameters())
    drawn = torch.cat([v.flatten() for k, v in lora.weights.items() if ".lora_A." in k])
    assert drawn.std() == pytest.approx(0.25, rel=0.05)
    again, other = initial_lora(prior, ATTENTION, 4, seed=3), initial_lora(prior, ATTENTION, 4, 4)
    assert all(torch.equal(again.weights[k], v) for k, v in lora.weights.items())
    assert not any(torch.equal(other.weights[k], v) for k, v in lora.weights.items() if "_A" in k)


def test_the_global_random_numbers_are_left_alone() -> None:
    prior = bare_prior()
    torch.manual_seed(0)
    expected = torch.rand(3)
    torch.manual_seed(0)
    initial_lora(prior, ATTENTION, 4, seed=0)
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.case("L8")
@pytest.mark.parametrize("make", [random_lora, uneven_lora])
@pytest.mark.parametrize("layers", [ATTENTION, MORE], ids=["attention", "more"])
@pytest.mark.parametrize("place", [0, 1], ids=["diffusers", "kohya"])
def test_what_is_saved_has_the_same_strength_when_read(
    tmp_path: Path, make: Any, layers: tuple[str, ...], place: int
) -> None:
    """Against the update written out by hand, whatever alpha and rank."""
    prior = bare_prior()
    expected = merged(prior.unet, lora := make(prior, layers))
    install_lora(prior, lora, "scene")
    assert (output(prior.unet) - output(tiny_unet())).abs().max() > 0.1
    torch.testing.assert_close(output(prior.unet), output(expected), rtol=1e-4, atol=2e-5)

    fresh = bare_prior()
    read = load_lora(fresh, save(lora, tmp_path)[place], "other")
    assert read.alphas == lora.alphas
    assert all(torch.equal(read.weights[key], value) for key, value in lora.weights.items())
    assert torch.equal(output(fresh.unet), output(prior.unet))


@pytest.mark.case("L8")
@pytest.mark.parametrize("place", [0, 1], ids=["diffusers", "kohya"])
@pytest.mark.parametrize("alpha", [4.0, 8.0])
def test_diffusers_reads_what_is_saved(
    tmp_path: Path, sd_folder: Path, place: int, alpha: float
) -> None:
    """A fresh pipeline has the same UNet output, also where alpha is not the rank."""
    from diffusers import StableDiffusionPipeline

    def pipeline() -> Any:
        return StableDiffusionPipeline.from_pretrained(
            sd_folder, safety_checker=None, local_files_only=True
        )

    prior = bare_prior(pipeline().unet)
    lora = random_lora(prior)
    lora = replace(lora, alphas=dict.fromkeys(lora.alphas, alpha))
    install_lora(prior, lora, "scene")
    file = save(lora, tmp_path)[place]
    theirs = pipeline()
    theirs.load_lora_weights(tmp_path, weight_name=file.name, adapter_name="scene")
    assert torch.equal(output(theirs.unet), output(prior.unet))
    assert not torch.equal(output(theirs.unet), output(pipeline().unet))


@pytest.fixture(scope="module")
def sd_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("sd"))


def test_the_keys_are_those_that_others_know(tmp_path: Path) -> None:
    """The golden list of one attention layer in both files."""
    prior = bare_prior()
    diffusers, kohya = save(random_lora(prior), tmp_path)
    layer = "down_blocks.1.attentions.0.transformer_blocks.0.attn2"
    found = load_file(diffusers)
    assert sorted(k for k in found if layer in k) == [
        f"unet.{layer}.to_{part}.lora.{way}.weight"
        for part in ("k", "out.0", "q", "v")
        for way in ("down", "up")
    ]
    assert len(found) == 2 * len(random_lora(prior).alphas) == 2 * 32
    found = load_file(kohya)
    name = "lora_unet_" + layer.replace(".", "_")
    assert sorted(k for k in found if name in k) == [
        f"{name}_to_{part}.{ending}"
        for part in ("k", "out_0", "q", "v")
        for ending in ("alpha", "lora_down.weight", "lora_up.weight")
    ]
    assert len(found) == 3 * 32
    alpha = found[f"{name}_to_q.alpha"]
    assert (alpha.dtype, alpha.item(), alpha.ndim) == (torch.float32, 4.0, 0)


@pytest.mark.parametrize(
    ("width", "prediction", "version", "second", "kind"),
    [(768, "epsilon", "sd_v1", "False", "epsilon"), (1024, "v_prediction", "sd_v2", "True", "v")],
)
def test_the_header_names_the_base_model(
    tmp_path: Path, width: int, prediction: str, version: str, second: str, kind: str
) -> None:
    from safetensors import safe_open

    lora = uneven_lora(bare_prior())
    _, kohya = save_lora(lora, tmp_path, width, prediction, TRIGGER)
    with safe_open(kohya, framework="pt") as file:
        header = file.metadata()
    assert header["ss_base_model_version"] == version
    assert header["ss_v2"] == second
    assert (header["ss_network_dim"], header["ss_network_alpha"]) == ("4", "8.0")
    assert header["modelspec.trigger_phrase"] == TRIGGER
    assert header["modelspec.prediction_type"] == kind
    assert json.loads(header["ss_tag_frequency"]) == {"1_scene": {TRIGGER: 1}}


def test_the_same_lora_is_the_same_bytes(tmp_path: Path) -> None:
    """The library's header has another order each time."""
    lora = uneven_lora(bare_prior())
    first = [file.read_bytes() for file in save(lora, tmp_path / "0")]
    for turn in range(1, 6):
        assert [file.read_bytes() for file in save(lora, tmp_path / str(turn))] == first
    small = {"a": torch.arange(3.0), "é": torch.ones(1, dtype=torch.int64)}
    for _ in range(5):
        (tmp_path / "x").write_bytes(serialize(small, {c: c for c in "qwertyuiop"}))
        read = load_file(tmp_path / "x")
        assert all(torch.equal(read[key], value) for key, value in small.items())


def test_a_full_disk_leaves_the_old_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = save(random_lora(bare_prior()), tmp_path)
    before = [file.read_bytes() for file in files]

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        save(uneven_lora(bare_prior()), tmp_path)
    assert [file.read_bytes() for file in files] == before
    assert sorted(os.listdir(tmp_path)) == sorted(file.name for file in files)


# Ways of naming


def write_peft(lora: Lora, folder: Path, **config: Any) -> Path:
    """Write a LoRA as peft does, its configuration beside it."""
    whole = {"peft_type": "LORA", "r": 4, "target_modules": list(ATTENTION), **config}
    (folder / "adapter_config.json").write_text(json.dumps(whole))
    path = folder / "adapter_model.safetensors"
    save_file({f"base_model.model.{k}": v for k, v in lora.weights.items()}, path)
    return path


def write_kohya(lora: Lora, path: Path, alpha: float | None) -> Path:
    """Write a LoRA as kohya's scripts do, with or without its alphas."""
    kohya = {}
    for key, value in lora.weights.items():
        layer, part = key.split(".lora_")
        name = "lora_unet_" + layer.replace(".", "_")
        way = "lora_down" if part.startswith("A") else "lora_up"
        kohya[f"{name}.{way}.weight"] = value
        if alpha is not None:
            kohya[f"{name}.alpha"] = torch.tensor(alpha, dtype=torch.float16)
    save_file(kohya, path)
    return path


def renamed(lora: Lora, style: str, folder: Path) -> Path:
    """Write a LoRA as other programs do, without our writer."""
    alpha, path = next(iter(lora.alphas.values())), folder / "lora.safetensors"
    if style == "peft":
        return write_peft(lora, folder, lora_alpha=alpha)
    if style.startswith("kohya"):
        return write_kohya(lora, path, alpha if style == "kohya" else None)
    prefix = "" if style == "unet-alone" else "unet."
    pairs = {}
    if style == "diffusers":
        pairs = {"lora_A": "lora.down", "lora_B": "lora.up"}
    elif style == "diffusers-old":
        pairs = {".to_out.0.": ".to_out.", ".to_": ".processor.to_"}
        pairs |= {".lora_A": "_lora.down", ".lora_B": "_lora.up"}
    weights = {}
    for key, value in lora.weights.items():
        for ours, theirs in pairs.items():
            key = key.replace(ours, theirs)
        weights[prefix + key] = value
    config = {"peft_type": "LORA", "r": 4, "lora_alpha": alpha, "target_modules": list(ATTENTION)}
    header = {"lora_adapter_metadata": json.dumps({prefix + k: v for k, v in config.items()})}
    save_file(weights, path, {} if style == "diffusers-old" else header)
    return path


@pytest.mark.parametrize(
    ("style", "alpha"),
    [
        pytest.param("diffusers", 8.0, id="L8-diffusers-alpha-8.0"),
        pytest.param("diffusers-peft", 8.0, id="L8-diffusers-peft-alpha-8.0"),
        pytest.param("diffusers-old", 4.0, id="L8-diffusers-old-alpha-4.0"),
        pytest.param("peft", 8.0, id="L8-peft-alpha-8.0"),
        pytest.param("unet-alone", 8.0, id="L8-unet-alone-alpha-8.0"),
        pytest.param("kohya", 8.0, id="L8-kohya-alpha-8.0"),
        pytest.param("kohya", 0.5, id="L8-kohya-alpha-0.5"),
        pytest.param("kohya-without-alpha", 4.0, id="L8-kohya-without-alpha-alpha-4.0"),
    ],
)
def test_every_way_of_naming_is_read(tmp_path: Path, style: str, alpha: float) -> None:
    prior = bare_prior()
    lora = random_lora(prior)
    lora = replace(lora, alphas=dict.fromkeys(lora.alphas, alpha))
    expected = merged(prior.unet, lora)
    read = load_lora(prior, renamed(lora, style, tmp_path))
    assert read.alphas == lora.alphas
    assert all(torch.equal(read.weights[key], value) for key, value in lora.weights.items())
    torch.testing.assert_close(output(prior.unet), output(expected), rtol=1e-4, atol=2e-5)


@pytest.mark.case("L8")
def test_rank_stabilised_loras_keep_their_strength(tmp_path: Path) -> None:
    """The update is alpha / sqrt(rank) B A, as peft's configuration says."""
    path = write_peft(random_lora(bare_prior()), tmp_path, lora_alpha=3, use_rslora=True)
    read = read_lora(path)
    assert {alpha / 4 for alpha in read.alphas.values()} == {3 / 2}


def test_half_precision_models_get_half_precision_loras() -> None:
    prior = bare_prior(tiny_unet().to(torch.bfloat16))
    lora = random_lora(prior)
    install_lora(prior, lora, "scene")
    for key, parameter in lora_parameters(prior, "scene").items():
        assert torch.equal(parameter, lora.weights[key].bfloat16())


def test_a_second_lora_of_a_name_replaces_the_first() -> None:
    prior = bare_prior()
    base = output(prior.unet)
    install_lora(prior, uneven_lora(prior, MORE), "scene")
    assert set(adaptable_layers(prior.unet)) == set(adaptable_layers(tiny_unet()))
    lora = random_lora(prior)
    install_lora(prior, lora, "scene")
    alone = bare_prior()
    install_lora(alone, lora, "scene")
    assert torch.equal(output(prior.unet), output(alone.unet))
    remove_lora(prior, "scene")
    remove_lora(prior, "scene")
    assert prior.adapters == set()
    assert torch.equal(output(prior.unet), base)


# Refusals


@pytest.mark.case("L8")
def test_a_lora_for_another_base_is_refused_in_one_sentence(tmp_path: Path) -> None:
    """Stable Diffusion 1.5 has the same layers as 2.1 but another width of the prompts."""
    other = bare_prior(tiny_unet(24))
    file = save(random_lora(other), tmp_path)[1]
    prior = bare_prior()
    before = output(prior.unet)
    with pytest.raises(ModelError) as caught:
        load_lora(prior, file)
    assert "found cross-attention 24; expected 32" in str(caught.value)
    assert str(caught.value).count("\n") == 0
    assert prior.adapters == set()
    assert torch.equal(output(prior.unet), before)


def broken(kind: str, folder: Path) -> Path:
    """Return a file with one fault; `tests.insert.test_model_files` has what any reader meets."""
    named, of_kohya = map(load_file, save(random_lora(bare_prior()), folder))
    path = folder / "broken.safetensors"
    first, first_up = next(iter(named)), next(key for key in of_kohya if "lora_up" in key)
    tensors = {
        "empty": {},
        "foreign": {"model.layers.0.weight": torch.ones(2)},
        "not whole": {k: v for k, v in named.items() if "mid_block" not in k},
        "unknown layers": {k.replace("mid_block", "mid_blocks"): v for k, v in named.items()},
        "other shape": {**named, first: torch.ones(4, 5)},
        "weight decomposed": {**of_kohya, "lora_unet_mid_block_x.dora_scale": torch.ones(2)},
        "kohya without up": {k: v for k, v in of_kohya.items() if k != first_up},
        "alpha nan": {k: v * math.nan if "alpha" in k else v for k, v in of_kohya.items()},
    }
    configs = {
        "not whole": json.dumps({"unet.target_modules": list(ATTENTION), "unet.lora_alpha": 4}),
        "header not JSON": "{",
        "header a list": "[]",
        "header alpha text": json.dumps({"unet.lora_alpha": "much"}),
        "dora in the header": json.dumps({"unet.lora_alpha": 4, "unet.use_dora": True}),
    }
    header = {"lora_adapter_metadata": configs[kind]} if kind in configs else None
    save_file(tensors.get(kind, named), path, header)
    return path


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        pytest.param("empty", "no keys", id="L8-empty"),
        pytest.param("foreign", "1 of 1 keys are foreign", id="L8-foreign"),
        pytest.param("not whole", "found 24 of 32 layers", id="L8-not-whole"),
        pytest.param(
            "unknown layers", "8 of its 32 layers are not in the model", id="L8-unknown-layers"
        ),
        pytest.param("other shape", "another shape", id="L8-other-shape"),
        pytest.param("weight decomposed", "foreign", id="L8-weight-decomposed"),
        pytest.param("kohya without up", "only one of its two parts", id="L8-kohya-without-up"),
        pytest.param("alpha nan", "alpha: values are not finite", id="L8-alpha-nan"),
        pytest.param("header not JSON", "not JSON", id="L8-header-not-JSON"),
        pytest.param("header a list", "not a JSON object", id="L8-header-a-list"),
        pytest.param("header alpha text", "configuration is damaged", id="L8-header-alpha-text"),
        pytest.param("dora in the header", "use_dora", id="L8-dora-in-the-header"),
    ],
)
def test_what_is_not_a_whole_lora_is_refused(tmp_path: Path, kind: str, words: str) -> None:
    """One sentence with the file's name; nothing stays on the model."""
    prior = bare_prior()
    path = broken(kind, tmp_path)
    with pytest.raises(ModelError, match=words) as caught:
        load_lora(prior, path)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)
    assert prior.adapters == set()
    assert not lora_parameters(prior, "scene")


@pytest.mark.case("L8")
def test_flipped_bytes_raise_nothing_but_our_error(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Half of the flips hit the header, which holds names, shapes and configuration."""
    whole = save(random_lora(bare_prior()), tmp_path)
    refused = 0
    for turn in range(120):
        content = bytearray(whole[turn % 2].read_bytes())
        header = 8 + int.from_bytes(content[:8], "little")
        place = int(rng.integers(header if turn % 4 < 2 else len(content)))
        content[place] ^= 1 << int(rng.integers(8))
        path = tmp_path / "flipped.safetensors"
        path.write_bytes(content)
        prior = SimpleNamespace(unet=None, adapters=set())
        try:
            lora = read_lora(path)
        except ModelError:
            refused += 1
            continue
        assert all(bool(torch.isfinite(v).all()) for v in lora.weights.values())
        assert prior.adapters == set()
    assert refused > 20


@pytest.mark.case("L8")
@pytest.mark.parametrize(
    ("layers", "rank", "words"),
    [(ATTENTION, 0, "lora_rank"), (("to_z",), 4, "found 'to_z'"), (("q",), 4, "found 'q'")],
)
def test_settings_that_adapt_nothing_are_refused(
    layers: tuple[str, ...], rank: int, words: str
) -> None:
    """An end of a name begins at a dot: ``q`` is not ``to_q``."""
    with pytest.raises(ModelError, match=words):
        initial_lora(bare_prior(), layers, rank, seed=0)
