"""Files of the networks of a photo: fp16 weights, with their sizes, digest and record beside."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors.torch import load_file, save
from torch import nn

from warpir.calibration.blocks import TokenSizes
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import WeightFile, values_hash

Network = TypeVar("Network", bound=nn.Module)


def random_network(seed: int, make: Callable[[], Network]) -> Network:
    """Return a network with random weights: a start for training, and a control that must fail."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return make().eval()


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


def load_network(
    check: Callable[[Path | None], WeightFile],
    make: Callable[[dict[str, Any]], Network],
    path: Path | None,
    device: str | torch.device,
) -> tuple[Network, dict[str, Any]]:
    """Read a network and its record; without a path, the one in the package.

    ``check`` is of `warpir.diffusion.models.weight_files`, ``make`` makes the network of the sizes
    in the file.

    Raises:
        InputError: The file is absent, damaged or of another kind (`ExitCode.MODEL`).
    """
    try:
        file = check(path)
        sizes = json.loads(file.about["config"])
        # Not on "meta" first: its sizes are checked, and random numbers there import the compiler.
        network = make({k: tuple(v) if isinstance(v, list) else v for k, v in sizes.items()})
        if {name: part.shape for name, part in network.state_dict().items()} != file.shapes:
            what = "damaged (the weights are not those of its network)"
            raise ModelError(str(file.path), what)
        network.load_state_dict({k: part.float() for k, part in load_file(file.path).items()})
    except ModelError as error:
        raise InputError(error.where, error.what, error.advice, ExitCode.MODEL) from None
    network = network.to(device).eval().requires_grad_(False)
    return network, json.loads(file.about["record"])
