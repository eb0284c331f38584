"""Tensors in safetensors files: read whole, and written as the same bytes each time."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import fault_of, read_header


def read_safetensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors and what the header says of a safetensors file.

    Raises:
        ModelError: It is not there, or not a whole safetensors file.
    """
    header = read_header(path)
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            return {key: file.get_tensor(key) for key in file.keys()}, header.about
    except (SafetensorError, OSError, RuntimeError) as error:
        raise ModelError(path, *fault_of(path)) from error


def serialize(tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> bytes:
    """Return a safetensors file; unlike the library's its header is always in the same order."""
    content = save({k: v.detach().cpu().contiguous() for k, v in tensors.items()}, dict(header))
    length = int.from_bytes(content[:8], "little")
    names = json.loads(content[8 : 8 + length])
    names["__metadata__"] = dict(sorted(names["__metadata__"].items()))
    text = json.dumps(names, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + content[8 + length :]
