"""Files of weights at the command line: LoRA and the regressor's.

Each fault is met before torch is loaded. What only the networks can tell is in the tests of their
readers (test_lora_files, test_regressor).
"""

import json
import os
import pickle
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import save_file

from tests.builders.faults import NO_TORCH, assert_fails, run_case
from tests.builders.insertions import arguments
from tests.lighting.test_regressor import SMALL
from warpir.app.config import InsertConfig
from warpir.app.record import input_files
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import check_lora, check_regressor, values_hash
from warpir.diffusion.personalization.lora_files import read_lora
from warpir.train.networks.regressor import random_regressor, save_regressor

WRITTEN = "damaged (its weights are not those that were written)"
LAYER = "mid_block.attentions.0.transformer_blocks.0.attn2.to_k"
FLAGS = ("lora", "regressor")


def adapter(prefix: str) -> dict[str, Any]:
    """Tensors of a LoRA of rank 2 for one layer."""
    a, b = np.ones((2, 32), np.float32), np.ones((64, 2), np.float32)
    return {f"{prefix}.{LAYER}.lora_A.weight": a, f"{prefix}.{LAYER}.lora_B.weight": b}


@pytest.fixture(scope="module")
def inputs(guided_inputs: Path) -> Path:
    """Inputs of a run, a model's folder, and a good file of each kind; never changed."""
    save_file(adapter("unet"), guided_inputs / "lora.safetensors")
    save_regressor(random_regressor(0, SMALL), guided_inputs / "regressor.safetensors", {})
    return guided_inputs


def run_with(inputs: Path, flag: str, file: Path | str) -> list[str]:
    """Arguments of a run that reads one of the files."""
    changes: dict[str, str | None] = {
        "lora": {"model": str(inputs / "model"), "prompt": "a red ball"},
        "regressor": {"light": None},
    }[flag]  # type: ignore[assignment]
    return arguments(inputs, "out", device="cpu", **{flag: str(file), **changes})


def tensors_of(path: Path) -> tuple[dict[str, Any], dict[str, str]]:
    with safe_open(path, framework="np") as content:
        return {k: content.get_tensor(k) for k in content.keys()}, dict(content.metadata() or {})


def edited(change: Callable[[dict[str, Any], dict[str, str]], object]) -> Callable[[Path], None]:
    """Change the tensors or what the header says, and write the file anew."""

    def damage(path: Path) -> None:
        tensors, about = tensors_of(path)
        change(tensors, about)
        save_file(tensors, path, metadata=about)

    return damage


def set_first(value: float) -> Callable[[Path], None]:
    def change(tensors: dict[str, Any], about: dict[str, str]) -> None:
        tensors[min(tensors)].flat[0] = value

    return edited(change)


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "absent": (Path.unlink, "no such file"),
    "folder": (lambda p: [p.unlink(), p.mkdir()], "is a folder"),
    "FIFO": (pipe, "not a regular file"),
    "empty": (lambda p: p.write_bytes(b""), "an empty file"),
    "cut": (lambda p: p.write_bytes(p.read_bytes()[:-20]), "not a whole safetensors file"),
    "long": (lambda p: p.write_bytes(p.read_bytes() + b"x"), "not a whole safetensors file"),
    "junk": (lambda p: p.write_bytes(b"junk" * 999), "not a whole safetensors file"),
    "header-2^62": (
        lambda p: p.write_bytes(struct.pack("<Q", 2**62) + p.read_bytes()[8:]),
        "not a whole safetensors file",
    ),
    "pickle": (lambda p: p.write_bytes(pickle.dumps({"a": 1})), "is a pickle"),
    "zip": (lambda p: torch.save({"a": torch.ones(1)}, p), "is a pickle"),
    "pointer": (lambda p: p.write_text("version https://git-lfs.github.com/spec/v1\n"), "LFS"),
}


def refused(
    inputs: Path, folder: Path, flag: str, spoil: Callable[[Path], object], words: str
) -> None:
    """Assert that a spoilt copy of a good file ends a run before torch is loaded."""
    file = folder / "file.safetensors"
    file.write_bytes((inputs / f"{flag}.safetensors").read_bytes())
    spoil(file)
    argv = run_with(inputs, flag, file)
    assert_fails(argv, 4, str(file), words, cwd=folder, before=NO_TORCH)


@pytest.mark.parametrize("flag", FLAGS)
@pytest.mark.parametrize("damage", DAMAGES, ids="L2-{}".format)
def test_files_that_are_no_weights_are_refused(
    inputs: Path, tmp_path: Path, flag: str, damage: str
) -> None:
    refused(inputs, tmp_path, flag, *DAMAGES[damage])


@pytest.mark.parametrize("flag", FLAGS)
@pytest.mark.parametrize("value", [np.nan, -np.inf], ids=["L2-NaN", "L2-inf"])
def test_values_that_are_not_finite_are_refused(
    inputs: Path, tmp_path: Path, flag: str, value: float
) -> None:
    refused(inputs, tmp_path, flag, set_first(value), "not finite")


@pytest.mark.parametrize(
    ("flag", "other"),
    [
        pytest.param(flag, other, id=f"L2-{flag}-is-a-{other}")
        for flag in FLAGS
        for other in (*FLAGS, "unet")
        if flag != other
    ],
)
def test_weights_of_another_kind_are_refused(
    inputs: Path, tmp_path: Path, flag: str, other: str
) -> None:
    """Each reader knows its own files by their header or names."""
    unet = inputs / "model/unet/diffusion_pytorch_model.safetensors"
    file = unet if other == "unet" else inputs / f"{other}.safetensors"
    words = {"lora": "not a LoRA", "regressor": "no weights of the"}
    assert_fails(
        run_with(inputs, flag, file), 4, str(file), words[flag], cwd=tmp_path, before=NO_TORCH
    )


def describe(key: str, text: str) -> Callable[[Path], None]:
    return edited(lambda tensors, about: about.update({key: text}))


def configured(**changes: object) -> Callable[[Path], None]:
    """Change what the header says of the network."""
    return edited(lambda tensors, about: restate(about, **changes))


def restate(about: dict[str, str], **changes: object) -> None:
    about["config"] = json.dumps(json.loads(about["config"]) | changes)


def as_written(
    spoil: Callable[[dict[str, Any]], object] = lambda tensors: None, **changes: object
) -> Callable[[Path], None]:
    """Change weights, or what the header says of the network, and the hash of them too."""

    def change(tensors: dict[str, Any], about: dict[str, str]) -> None:
        spoil(tensors)
        restate(about, **changes)
        about["weights"] = values_hash(tensors, about["config"])

    return edited(change)


@pytest.mark.parametrize("sizes", [{"members": 2}, {"depth": 9}, {"blocks": [1, 2]}], ids=str)
def test_sizes_that_the_weights_do_not_have_are_refused(
    inputs: Path, tmp_path: Path, sizes: dict[str, object]
) -> None:
    refused(inputs, tmp_path, "regressor", as_written(**sizes), "not those of its network")


def test_answers_that_are_no_light_are_refused(inputs: Path, tmp_path: Path) -> None:
    """Weights that are finite, and answer with logarithms of thousands."""
    file = tmp_path / "regressor.safetensors"
    file.write_bytes((inputs / "regressor.safetensors").read_bytes())
    as_written(lambda t: t["members.0.level_head.2.bias"].fill(3e4))(file)
    argv = run_with(inputs, "regressor", file)
    assert_fails(argv, 4, "--regressor", "logarithms beyond 60", cwd=tmp_path)


def retold(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Path], None]:
    """Replace tensors, or add others."""
    return edited(lambda tensors, about: tensors.update(change(tensors)))


ONES = np.ones(2, np.float32)
OTHERS: dict[str, tuple[str, Callable[[Path], None], str]] = {
    "L2-regressor-newer": (
        "regressor", describe("format", "warpir-regressor-9"), "'warpir-regressor-9'"),
    "L2-regressor-nested": ("regressor", describe("config", "[" * 100_000), "header"),
    "L2-regressor-no-config": (
        "regressor", edited(lambda tensors, about: about.pop("config")), "header"),
    **{
        f"L2-{name}-{value}": ("regressor", configured(**{name: value}), words)
        for name, value, words in (
            ("heads", 0, "network: heads"),
            ("heads", 3, "of 3 heads"),
            ("heads", [4], "network: heads"),
            ("heads", 4, "not those that were written"),
            ("directions", 10**9, "network: directions"),
            ("depth", 10**7, "network: depth"),
            ("depth", True, "network: depth"),
            ("channels", [48, 96, 200_000], "network: channels"),
            ("channels", [48], "network: channels"),
            ("dropout", "x", "network: dropout"),
            ("more", 1, "header is damaged"),
        )
    },
    "L2-temperature": (
        "regressor",
        as_written(lambda t: t["temperature"].fill(-1.0)), "temperature: not a number"),
    "L2-directions": (
        "regressor",
        as_written(lambda t: t["directions"].fill(0.0)), "directions: not of length 1"),
    "L2-not those that were written": (
        "regressor", edited(lambda t, _: t["directions"].fill(0.0)), "not those that were written"),
    "L8-some-foreign": ("lora", retold(lambda t: {"stranger": ONES}), "foreign"),
    "L8-rank-0": (
        "lora",
        retold(lambda t: {k: v[:0] if ".lora_A" in k else v[:, :0] for k, v in t.items()}),
        "rank 0"),
    "L8-one-part": (
        "lora", edited(lambda t, about: t.pop(min(t))), "only one of its two parts"),
    "L8-wrong-base": (
        "lora", retold(lambda t: {min(t): np.ones((2, 77), np.float32)}),
        "cross-attention 77; expected 32"),
    "L8-parts-do-not-fit": (
        "lora", retold(lambda t: {min(t): np.ones((3, 32), np.float32)}), "do not fit"),
    "L8-text-encoder": (
        "lora", retold(lambda t: {"lora_te_x.lora_down.weight": ONES}), "text encoder"),
    "L8-two-alphas": (
        "lora", retold(lambda t: {f"unet.{LAYER}.alpha": ONES}),
        "alpha: shape [2] (expected one number)"),
}  # fmt: skip
"""Which file is changed, how, and the words of the refusal."""


@pytest.mark.parametrize("case", OTHERS)
def test_weights_that_say_something_else_are_refused(
    inputs: Path, tmp_path: Path, case: str
) -> None:
    refused(inputs, tmp_path, *OTHERS[case])


@pytest.mark.case("L2")
@pytest.mark.parametrize("flag", FLAGS)
def test_a_large_file_is_looked_at_in_pieces(inputs: Path, tmp_path: Path, flag: str) -> None:
    """64 MiB that take no room on the disk take little in memory; too many are not looked at."""

    def check(count: int) -> str:
        _, about = tensors_of(inputs / f"{flag}.safetensors")
        names = [f"{LAYER}.lora_A.weight", f"{LAYER}.lora_B.weight"] if flag == "lora" else ["a"]
        shapes = ([count // 32, 32], [1, count // 32]) if flag == "lora" else ([count],)
        entries: dict[str, object] = {"__metadata__": about}
        place = 0
        for name, shape in zip(names, shapes, strict=True):
            end = place + 4 * shape[0] * (shape[1] if len(shape) > 1 else 1)
            entries[name] = {"dtype": "F32", "shape": shape, "data_offsets": [place, end]}
            place = end
        text = json.dumps(entries).encode()
        file = tmp_path / "large.safetensors"
        with file.open("wb") as stream:
            stream.write(struct.pack("<Q", len(text)) + text)
            stream.truncate(8 + len(text) + place)
        tracemalloc.start()
        try:
            if flag == "lora":
                check_lora(file, None)
            else:
                check_regressor(file)
        except ModelError as error:
            return error.what
        finally:
            peak = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
            assert peak < 2**25
        return ""

    assert check(2**24) == ("" if flag == "lora" else WRITTEN)
    if flag != "lora":
        assert "expected at most" in check(2**28)


@pytest.mark.case("L9")
def test_the_configuration_beside_a_lora_is_an_input(tmp_path: Path) -> None:
    """It sets alpha: a resumed run, and a batch, must see that it changed."""
    file, beside = tmp_path / "adapter_model.safetensors", tmp_path / "adapter_config.json"
    file.touch()
    config = InsertConfig(lora=str(file))
    assert input_files(config) == {"lora": file}
    beside.touch()
    assert input_files(config) == {"lora": file, "lora/adapter_config.json": beside}


@pytest.mark.case("L2", "L8")
@pytest.mark.parametrize("flag", FLAGS)
def test_good_files_are_valid(inputs: Path, tmp_path: Path, flag: str) -> None:
    """So that none of the above is refused for another reason."""
    argv = [*run_with(inputs, flag, inputs / f"{flag}.safetensors"), "--validate"]
    ended = run_case(argv, tmp_path, before=NO_TORCH)
    assert (ended.status, ended.err) == (0, "")


@pytest.mark.case("L8")
def test_a_configuration_beside_a_lora_is_read_as_json(tmp_path: Path) -> None:
    """peft's, which may be of any size and depth when it comes from a stranger."""
    file, beside = tmp_path / "adapter_model.safetensors", tmp_path / "adapter_config.json"
    save_file(adapter("base_model.model"), file)
    for text in ("[" * 100_000, "[]", '{"r": NaN}', '{"r": 1, "r": 2}', " " * (2**24 + 1)):
        beside.write_text(text)
        with pytest.raises(ModelError, match=r"adapter_config\.json"):
            read_lora(file)
    beside.write_text(json.dumps({"r": 2, "lora_alpha": 5}))
    assert read_lora(file).alphas == {LAYER: 5.0}


ALPHA_PATTERNS = [
    pytest.param(f"^{LAYER}", 7.0, id="L8-whole-name"),
    pytest.param(f"^{LAYER}$", 7.0, id="L8-whole-name-and-end"),
    pytest.param(f"^{LAYER[3:]}", 4.0, id="L8-other-whole-name"),
    pytest.param("attn2.to_k", 7.0, id="L8-end"),
    pytest.param(r"attn2\.to_k", 7.0, id="L8-escaped-end"),
    pytest.param("ttn2.to_k", 4.0, id="L8-no-end"),
    pytest.param("([a-z0-9_.]+)+X", None, id="L8-pattern-without-end"),
    pytest.param("", None, id="L8-empty-pattern"),
]


@pytest.mark.parametrize(("pattern", "alpha"), ALPHA_PATTERNS)
def test_alpha_patterns_are_names(tmp_path: Path, pattern: str, alpha: float | None) -> None:
    """By peft they are run as regular expressions; of names the answer is the same as peft's."""
    from peft.utils.other import get_pattern_key

    file = tmp_path / "lora.safetensors"
    config = {"r": 2, "lora_alpha": 4, "alpha_pattern": {pattern: 7}}
    save_file(adapter("unet"), file, {"lora_adapter_metadata": json.dumps(config)})
    if alpha is None:
        with pytest.raises(ModelError, match="alpha_pattern"):
            read_lora(file)
    else:
        assert read_lora(file).alphas == {LAYER: alpha}
        assert (get_pattern_key([pattern], LAYER) == pattern) is (alpha == 7.0)


@pytest.mark.case("L8")
@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_values_are_looked_at_in_every_kind_of_number(tmp_path: Path, kind: torch.dtype) -> None:
    """The greatest and the smallest numbers are finite; NaN and infinity of either sign are not."""
    from safetensors.torch import save_file as save_tensors

    limits, file = torch.finfo(kind), tmp_path / "lora.safetensors"
    values = torch.tensor([limits.max, limits.min, limits.tiny, -0.0], dtype=kind)
    b = torch.ones(3, 1, dtype=kind)
    name = f"unet.{LAYER}.lora"
    save_tensors({f"{name}_A.weight": values[None].contiguous(), f"{name}_B.weight": b}, file)
    check_lora(file, None)
    for bad in (torch.nan, -torch.nan, torch.inf, -torch.inf):
        values[2] = bad
        save_tensors({f"{name}_A.weight": values[None].contiguous(), f"{name}_B.weight": b}, file)
        with pytest.raises(ModelError, match="not finite"):
            check_lora(file, None)
