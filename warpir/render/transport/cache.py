"""Cache of traced rows on disk, keyed by the scene's content: another prompt traces nothing."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

import warpir
from warpir.core.arrays import IntArray
from warpir.core.atomic import replacing
from warpir.core.cache import find_kept, notice, seal
from warpir.render.transport.rows import TransportSettings
from warpir.scene.light import Light

if TYPE_CHECKING:
    from warpir.render.device_scene import Scene


FORMAT = 3
"""Layout and meaning of the stored arrays; part of every key."""


def content_key(
    scene: Scene,
    object_pixels: IntArray,
    receiver_pixels: IntArray,
    depth: int,
    settings: TransportSettings,
    expected: Light,
    seed: int,
    is_ordered: bool,
    bounce_depth: int,
) -> str:
    """Return a hash of everything that the rows depend on, as 64 hexadecimal digits.

    It covers the device and its order of summation, which affect the last bits, and the uploaded
    scene: geometry in place, materials, textures, camera and plane; not names, files or prompts.
    """
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        array = np.ascontiguousarray(value)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.data if array.size else b"")

    digest.update(
        f"{FORMAT} {warpir.__version__} {depth} {seed} {sorted(asdict(settings).items())} "
        f"{scene.device.name} {is_ordered} {bounce_depth}".encode()
    )
    for content in scene.contents():
        add(content)
    add(object_pixels)
    add(receiver_pixels)
    lobes = expected.lobes
    for array in (
        *((lobes.amplitude, lobes.axis, lobes.sharpness) if lobes is not None else ()),
        *((expected.texels,) if expected.texels is not None else ()),
    ):
        add(array)
    return digest.hexdigest()


def load_rows(path: Path, device: torch.device) -> dict[str, Tensor] | None:
    """Return the arrays of a cached file, or None if it is absent or damaged."""
    from safetensors.torch import load_file

    kept = find_kept(path)
    return None if kept is None else load_file(kept, device=str(device))


def save_rows(path: Path, rows: dict[str, Tensor]) -> None:
    """Write the arrays atomically and evict old files; a full disk is only a notice."""
    from safetensors import SafetensorError
    from safetensors.torch import save_file

    try:
        with replacing(path) as staged:
            save_file({k: v.contiguous() for k, v in rows.items()}, staged)
        seal(path, "*.safetensors.*")
    except (SafetensorError, OSError) as error:
        notice(f"{path}: not kept ({error})")
