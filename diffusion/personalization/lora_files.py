"""LoRA files: others' are read at their exact strength, and ours can be read by others.

A LoRA adds ``(alpha / rank) B A x`` to a layer's output. Three ways to name its parts are in use:

* diffusers: ``unet.<layer>.lora.down.weight`` or ``unet.<layer>.lora_A.weight``, with peft's
  configuration in the header where alpha differs from the rank;
* kohya (A1111, ComfyUI, InvokeAI): ``lora_unet_<layer_>.lora_down.weight`` beside ``.alpha``;
* peft: ``base_model.model.<layer>.lora_A.weight`` beside a file ``adapter_config.json``.

Names are translated by diffusers' converters. What they get wrong is put right here: their kohya
writer says alpha = rank whatever was trained, their kohya reader loses alphas that differ between
layers, and what matches no layer is a line in their log.
"""

from __future__ import annotations

import json
import math
import re
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from warpir.core.atomic import write_file
from warpir.diffusion.draws import generator_of
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import read_json
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.models.tensor_files import read_safetensors, serialize
from warpir.diffusion.models.weight_files import beside_lora, check_lora, not_a_lora

HEADER_KEY = "lora_adapter_metadata"
"""Where diffusers keeps peft's configuration in a file's header."""
KOHYA = "lora_unet_"
_LAYER_PATTERN = re.compile(r"\^?(?:[A-Za-z0-9_]|\\?[.-])+\$?")
KOHYA_PARTS = (".lora_down.weight", ".lora_up.weight", ".alpha")


@dataclass(frozen=True)
class Lora:
    """A LoRA for the UNet, apart from any model."""

    weights: dict[str, Tensor]
    """``<layer>.lora_A.weight`` [rank, in, ...] and ``<layer>.lora_B.weight`` [out, rank, ...],
    float32 on the CPU."""
    alphas: dict[str, float]
    """alpha by layer."""
    targets: tuple[str, ...] = ()
    """Ends of the names of all layers that it adapts, where the file says so."""

    def rank(self, layer: str) -> int:
        """Return the rank at a layer."""
        return int(self.weights[f"{layer}.lora_A.weight"].shape[0])

    def config(self) -> dict[str, Any]:
        """Return the arguments of peft's LoraConfig, as plain JSON values in a fixed order."""
        ranks = {layer: self.rank(layer) for layer in sorted(self.alphas)}
        alphas = {layer: _plain(self.alphas[layer]) for layer in sorted(self.alphas)}
        rank, alpha = _commonest(ranks.values()), _commonest(alphas.values())
        return {
            "r": rank,
            "lora_alpha": alpha,
            "rank_pattern": {f"^{k}": r for k, r in ranks.items() if r != rank},
            "alpha_pattern": {f"^{k}": a for k, a in alphas.items() if a != alpha},
            "target_modules": sorted(self.targets or self.alphas),
        }


def _plain(alpha: float) -> float:
    return int(alpha) if alpha == int(alpha) else alpha


def _commonest(values: Iterable[float]) -> float:
    return Counter(values).most_common(1)[0][0]


def initial_lora(prior: StableDiffusion, layers: tuple[str, ...], rank: int, seed: int) -> Lora:
    """Return a LoRA that changes nothing yet: A is Gaussian of deviation 1/rank, B is zero.

    Layers are ends of the names of the UNet's layers, such as ``to_q``; alpha is the rank.

    Raises:
        ModelError: The rank is below 1, or an end matches no layer.
    """
    if rank < 1:
        raise ModelError("lora_rank", f"too small (found {rank}; expected at least 1)")
    weights, alphas = {}, {}
    known = adaptable_layers(prior.unet)
    for end in layers:
        matching = [name for name in known if _is_target(name, (end,))]
        if not matching:
            raise ModelError("lora_layers", f"no layer of the UNet (found {end!r})")
        for name in matching:
            weight = known[name].weight
            assert isinstance(weight, Tensor)
            shape_a, shape_b = _shapes(weight, rank)
            random = torch.randn(shape_a, generator=generator_of(seed, "lora", name))
            weights[f"{name}.lora_A.weight"] = random / rank
            weights[f"{name}.lora_B.weight"] = torch.zeros(shape_b)
            alphas[name] = float(rank)
    return Lora(weights, alphas, layers)


def adaptable_layers(unet: nn.Module) -> dict[str, nn.Module]:
    """Return the linear and convolution layers of a UNet by name, with or without LoRAs on them."""
    from peft.tuners.tuners_utils import BaseTunerLayer

    layers: dict[str, nn.Module] = {}
    inside: tuple[str, ...] = ()
    for name, module in unet.named_modules():
        if inside and name.startswith(inside):
            continue
        if isinstance(module, BaseTunerLayer):
            inside = (*inside, f"{name}.")
            layers[name] = module.get_base_layer()
        elif isinstance(module, nn.Linear | nn.Conv2d):
            layers[name] = module
    return layers


def _is_target(layer: str, targets: tuple[str, ...]) -> bool:
    return any(layer == end or layer.endswith(f".{end}") for end in targets)


def _shapes(weight: Tensor, rank: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the shapes of A and B beside a layer's weight [out, in, ...]."""
    return (rank, *weight.shape[1:]), (weight.shape[0], rank, *[1] * (weight.ndim - 2))


# Reading


def read_lora(path: str | Path) -> Lora:
    """Read a LoRA with keys of diffusers, kohya or peft.

    Args:
        path: A safetensors file; peft's ``adapter_config.json`` is read where it lies beside.

    Raises:
        ModelError: The file is not a safetensors file, is cut, holds other things than a LoRA of
            the UNet, has rank 0 or values that are not finite.
    """
    path = Path(path)
    check_lora(path, None)
    tensors, header = read_safetensors(path)
    config = _own_config(path, header)
    weights, alphas = _parts(path, tensors)
    layers = sorted({key.rsplit(".lora_", 1)[0] for key in weights})
    for key, tensor in weights.items():
        if not bool(torch.isfinite(tensor).all()):
            raise ModelError(path, f"{key}: values are not finite (found nan or inf)")
    for layer in layers:
        rank = len(weights[f"{layer}.lora_A.weight"])
        try:
            alphas.setdefault(layer, _alpha(config, layer, rank))
        except (TypeError, ValueError, AttributeError) as error:
            what = "its configuration is damaged (lora_alpha, alpha_pattern)"
            raise ModelError(path, what) from error
        if not math.isfinite(alphas[layer]):
            raise ModelError(path, f"{layer}: alpha is not finite (found {alphas[layer]})")
    if set(alphas) != set(layers):
        extra = sorted(set(alphas) - set(layers))[0]
        raise ModelError(path, f"an alpha without a layer (found {extra})")
    targets = config.get("target_modules")
    partial = config.get("layers_to_transform") or config.get("exclude_modules")
    listed = isinstance(targets, list) and not partial
    return Lora(weights, alphas, tuple(sorted(targets)) if listed and targets else ())


def _own_config(path: Path, header: dict[str, str]) -> dict[str, Any]:
    """Return what the file itself says of its LoRA: peft's configuration, or nothing."""
    beside = beside_lora(path)
    if HEADER_KEY in header:
        where = f"{path}: {HEADER_KEY}"
        try:
            config = json.loads(header[HEADER_KEY])
        except (ValueError, RecursionError) as error:
            raise ModelError(where, "not JSON") from error
        if not isinstance(config, dict):
            raise ModelError(where, "not a JSON object")
    elif beside is not None:
        where, config = str(beside), read_json(beside)
    else:
        return {}
    config = {key.removeprefix("unet."): value for key, value in config.items()}
    for key in ("use_dora", "lora_bias", "modules_to_save", "trainable_token_indices"):
        if config.get(key):
            raise ModelError(where, f"a kind of LoRA that is not supported (found {key})")
    return config


def _alpha(config: Mapping[str, Any], layer: str, rank: int) -> float:
    """Return a layer's alpha: what the configuration says, else the rank.

    Raises:
        ValueError: A key of ``alpha_pattern`` is more than the end of a layer's name: peft takes
            it as a regular expression, which can be made never to end.
    """
    if "lora_alpha" not in config:
        return float(rank)
    alpha = config["lora_alpha"]
    for pattern, stated in reversed((config.get("alpha_pattern") or {}).items()):
        if _LAYER_PATTERN.fullmatch(pattern) is None:
            raise ValueError
        name = pattern.replace("\\", "").removesuffix("$")
        if layer == name.removeprefix("^") or layer.endswith(f".{name}"):
            alpha = stated  # the first of them counts
    # Rank-stabilised LoRA divides by sqrt(rank) in place of the rank.
    return float(alpha) * (math.sqrt(rank) if config.get("use_rslora") else 1.0)


def _parts(path: Path, tensors: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, float]]:
    """Return A and B of every layer under peft's names, and the alphas that lie beside them."""
    from diffusers.loaders.lora_pipeline import StableDiffusionLoraLoaderMixin
    from diffusers.utils.state_dict_utils import convert_unet_state_dict_to_peft

    alphas: dict[str, Any] = {}
    named = {key.removeprefix("base_model.model."): value for key, value in tensors.items()}
    if any(key.startswith(KOHYA) for key in named):
        odd = [k for k in named if not (k.startswith(KOHYA) and k.endswith(KOHYA_PARTS))]
        if odd:
            raise not_a_lora(path, odd, len(named))
        alphas = {k: v for k, v in named.items() if k.endswith(".alpha")}
        try:
            named, alphas = StableDiffusionLoraLoaderMixin.lora_state_dict(dict(named))
        except (KeyError, ValueError) as error:
            raise ModelError(path, "its keys are not those of a whole kohya LoRA") from error
    else:
        alphas = {key: float(v) for key, v in named.items() if key.endswith(".alpha")}
        named = {key: v for key, v in named.items() if not key.endswith(".alpha")}

    def renamed(parts: dict[str, Any]) -> dict[str, Any]:
        parts = {key.removeprefix("unet."): value for key, value in parts.items()}
        return dict(convert_unet_state_dict_to_peft(parts))

    weights = renamed(named)
    layers = {key.rsplit(".lora_", 1)[0] for key in weights}
    odd = sorted(set(weights) ^ {f"{k}.lora_{part}.weight" for k in layers for part in "AB"})
    if odd:
        raise not_a_lora(path, odd, len(weights))
    # The converter calls an alpha after the part that stood beside it.
    by_layer = {
        key.removesuffix(".alpha").split(".lora_A")[0]: float(alpha)
        for key, alpha in renamed(alphas or {}).items()
    }
    return {key: weights[key].float().contiguous() for key in sorted(weights)}, by_layer


# Putting a LoRA beside a model's weights


def load_lora(prior: StableDiffusion, path: str | Path, name: str = "scene") -> Lora:
    """Read a LoRA file and put it beside the prior's weights under a name.

    Raises:
        ModelError: As `read_lora`, or the LoRA belongs to another model.
    """
    lora = read_lora(path)
    install_lora(prior, lora, name, path)
    return lora


def install_lora(prior: StableDiffusion, lora: Lora, name: str, where: str | Path = "LoRA") -> None:
    """Put a LoRA beside the UNet's weights, in place of one of the same name.

    It is frozen and has the UNet's precision. The prior's ``adapters`` get its name; an error names
    ``where``.

    Raises:
        ModelError: A layer is not in the UNet, has another shape, or is missing from the LoRA.
    """
    check_fit(prior.unet, lora, where)
    remove_lora(prior, name)
    with warnings.catch_warnings(action="ignore"):  # several adapters are meant
        prior.unet.load_lora_adapter(
            dict(lora.weights), prefix=None, adapter_name=name, metadata=lora.config()
        )
    put_weights(prior, name, lora.weights, prior.unet_dtype)
    for parameter in lora_parameters(prior, name).values():
        parameter.requires_grad_(False)
    prior.unet.eval()
    prior.adapters.add(name)


def check_fit(unet: nn.Module, lora: Lora, where: str | Path) -> None:
    """Raise a ModelError unless the LoRA belongs to the UNet, whole."""
    layers, advice = adaptable_layers(unet), "give a LoRA that was trained on this model"
    for layer in lora.alphas:
        base = layers.get(layer)
        if base is None:
            continue
        assert isinstance(base.weight, Tensor)
        expected = _shapes(base.weight, lora.rank(layer))
        a, b = (tuple(lora.weights[f"{layer}.lora_{part}.weight"].shape) for part in "AB")
        if (a, b) == expected:
            continue
        if layer.endswith(("attn2.to_k", "attn2.to_v")) and b == expected[1]:
            what = f"made for another base model (found cross-attention {a[1]}; expected "
            what += f"{expected[0][1]})"
        else:
            what = f"{layer}: another shape than the model's (found {list(a)}, {list(b)}; "
            what += f"expected {list(expected[0])}, {list(expected[1])})"
        raise ModelError(where, what, advice)
    unknown = [layer for layer in lora.alphas if layer not in layers]
    if unknown:
        found = f"{len(unknown)} of its {len(lora.alphas)} layers are not in the model, such as "
        raise ModelError(where, f"{found}{unknown[0]}", advice)
    absent = [name for name in layers if _is_target(name, lora.targets) and name not in lora.alphas]
    if absent:
        found = f"{len(lora.alphas)} of {len(lora.alphas) + len(absent)} layers"
        raise ModelError(where, f"not whole (found {found}; missing {absent[0]})")


def remove_lora(prior: StableDiffusion, name: str) -> None:
    """Take an adapter away; nothing happens when there is none of that name."""
    prior.forget_graphs()
    if name in getattr(prior.unet, "peft_config", {}):
        with warnings.catch_warnings(action="ignore"):
            prior.unet.delete_adapters(name)
    prior.adapters.discard(name)


def lora_parameters(prior: StableDiffusion, name: str) -> dict[str, nn.Parameter]:
    """Return an adapter's parameters under the names that `Lora` gives its weights, sorted."""
    from peft.tuners.lora.layer import LoraLayer

    found: dict[str, nn.Parameter] = {}
    for layer, module in prior.unet.named_modules():
        if isinstance(module, LoraLayer) and name in module.lora_A:
            for part, held in (("A", module.lora_A), ("B", module.lora_B)):
                found[f"{layer}.lora_{part}.weight"] = held[name].get_parameter("weight")
    return {key: found[key] for key in sorted(found)}


def put_weights(
    prior: StableDiffusion, name: str, weights: Mapping[str, Tensor], dtype: torch.dtype
) -> None:
    """Give an adapter's parameters values and a precision."""
    prior.forget_graphs()
    for key, parameter in lora_parameters(prior, name).items():
        parameter.data = weights[key].detach().to(parameter.device, dtype, copy=True)


# Writing


def save_lora(
    lora: Lora,
    folder: str | Path,
    cross_attention: int,
    prediction_type: str,
    trigger: str,
) -> tuple[Path, Path]:
    """Write ``lora_diffusers.safetensors`` and ``lora_kohya.safetensors``, always the same bytes.

    The base is told by the width of its prompts' embeddings, 768 in Stable Diffusion 1 and 1024 in
    2, and by what its schedule predicts; ``trigger`` are the words that call up what was learnt.

    Raises:
        OSError: A file cannot be written; older ones are still whole.
    """
    from diffusers.utils.state_dict_utils import convert_state_dict_to_diffusers

    config = lora.config()
    keyed = convert_state_dict_to_diffusers(lora.weights)
    if any(".lora_A." in key for key in keyed):
        # It knows attention layers only, and readers take one way of naming for the whole file.
        keyed = lora.weights
    own = {f"unet.{key}": value for key, value in config.items()}
    diffusers_file = Path(folder) / "lora_diffusers.safetensors"
    write_file(
        diffusers_file,
        serialize(
            {f"unet.{key}": value for key, value in keyed.items()},
            {"format": "pt", HEADER_KEY: json.dumps(own, sort_keys=True)},
        ),
    )
    kohya_file = Path(folder) / "lora_kohya.safetensors"
    write_file(kohya_file, _kohya_bytes(lora, cross_attention, prediction_type, trigger))
    return diffusers_file, kohya_file


def _kohya_bytes(lora: Lora, cross_attention: int, prediction_type: str, trigger: str) -> bytes:
    """Return a LoRA in kohya's form; arguments as in `save_lora`."""
    from diffusers.utils.state_dict_utils import convert_state_dict_to_kohya

    config = lora.config()
    named = {f"unet.{key}": value for key, value in lora.weights.items()}
    kohya = convert_state_dict_to_kohya(named)
    for layer, alpha in lora.alphas.items():
        kohya[f"lora_unet_{layer.replace('.', '_')}.alpha"] = torch.tensor(alpha)
    first = cross_attention == 768
    header = {
        "format": "pt",
        "ss_base_model_version": "sd_v1" if first else "sd_v2",
        "ss_v2": str(not first),
        "ss_network_module": "networks.lora",
        "ss_network_dim": str(config["r"]),
        "ss_network_alpha": str(float(config["lora_alpha"])),
        "ss_tag_frequency": json.dumps({"1_scene": {trigger: 1}}),
        "modelspec.trigger_phrase": trigger,
        "modelspec.prediction_type": "v" if prediction_type == "v_prediction" else prediction_type,
    }
    return serialize(kohya, header)
