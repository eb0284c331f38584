"""Networks with random weights, and files of weights, written and read for training."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import save
from torch import nn

from warpir.calibration.weights import Weights
from warpir.core.atomic import write_file
from warpir.diffusion.models.weight_files import values_hash
from warpir.train.networks.blocks import TokenSizes

Network = TypeVar("Network", bound=nn.Module)


def random_network(seed: int, make: Callable[[], Network]) -> Network:
    """Return a network with random weights: a start for training, and a control that must fail."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make().eval()


def weights_of(network: nn.Module, config: TokenSizes, record: Mapping[str, Any]) -> Weights:
    """Return the weights of a network, which `warpir.calibration.forward` takes."""
    values = {name: part.detach().cpu().numpy() for name, part in network.state_dict().items()}
    return Weights(asdict(config), values, record)


def plain_sizes(sizes: Mapping[str, Any]) -> dict[str, Any]:
    """Return sizes that were read from JSON as fields of `TokenSizes`."""
    return {k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()}


def filled(network: Network, weights: Weights, device: str | torch.device) -> Network:
    """Return a network of the weights' sizes with their values, for evaluation."""
    state = {name: torch.from_numpy(part).float() for name, part in weights.values.items()}
    network.load_state_dict(state)
    return network.to(device).eval().requires_grad_(False)


def save_network(
    network: nn.Module,
    config: TokenSizes,
    path: Path,
    record: Mapping[str, Any],
    format_: str,
    exact: Collection[str] = (),
) -> None:
    """Write a network, whole or not at all: as fp16, but for what ``exact`` names.

    Raises:
        OSError: The disk is full or the folder is not writable; an older file is still whole.
    """
    state = {
        name: (part if name in exact else part.half()).cpu().contiguous()
        for name, part in network.state_dict().items()
    }
    sizes = json.dumps(asdict(config))
    about = {
        "format": format_,
        "config": sizes,
        "weights": values_hash({name: part.numpy() for name, part in state.items()}, sizes),
        "record": json.dumps(dict(record), allow_nan=False),
    }
    write_file(path, save(state, metadata=about))
