"""Reads the weights of the networks of a photo: fp16, with sizes, digest and record beside them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import load_file

from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import WeightFile

Shapes = Mapping[str, tuple[int, ...]]
"""Of parameters, by their names in torch."""


@dataclass(frozen=True)
class Weights:
    """What a file of weights holds."""

    sizes: Mapping[str, Any]
    """Of the network: fields of its `warpir.train.networks.blocks.TokenSizes`."""
    values: Mapping[str, NDArray[Any]]
    """Of each parameter by its name in torch, as they were written."""
    record: Mapping[str, Any]
    """How it was trained; plain values."""

    def float64(self, name: str) -> NDArray[np.float64]:
        """Return the values of one name."""
        return self.values[name].astype(np.float64)


def read_weights(
    check: Callable[[Path | None], WeightFile],
    shapes: Callable[[Mapping[str, Any]], Shapes],
    path: Path | None,
) -> Weights:
    """Read a network's weights; without a path, those in the package.

    Args:
        check: Of `warpir.diffusion.models.weight_files`.
        shapes: Gives the shapes that the network of these sizes has.
        path: The file.

    Raises:
        InputError: The file is absent, damaged or of another kind (`ExitCode.MODEL`).
    """
    file = check(path)
    sizes = json.loads(file.about["config"])
    if shapes(sizes) != file.shapes:
        what = "damaged (the weights are not those of its network)"
        raise ModelError(file.path, what)
    values = load_file(file.path)
    return Weights(sizes, values, json.loads(file.about["record"]))
