"""Traced rows on disk, found again by their content: another prompt traces nothing."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import warpir
from warpir.light import Light
from warpir.transport_rows import TransportSettings

if TYPE_CHECKING:
    from warpir.scene import Scene

IntArray = NDArray[np.int32]

FORMAT = 1
"""Layout and meaning of the stored arrays; part of every key."""
CACHE_BYTES = 4 << 30
"""What the folder may hold; the files that were used longest ago go first."""

log = logging.getLogger(__name__)


def default_cache() -> Path:
    """Return the folder for traced rows: ``WARPIR_CACHE``, or the user's cache folder."""
    own = os.environ.get("WARPIR_CACHE")
    if own:
        return Path(own) / "transport"
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "warpir" / "transport"


def content_key(
    scene: Scene,
    object_pixels: IntArray,
    proxy_pixels: IntArray,
    depth: int,
    settings: TransportSettings,
    expected: Light,
    seed: int,
) -> str:
    """Return a hash of everything that the rows depend on, as 64 hexadecimal digits.

    The scene counts by what is on the device: geometry where it stands, materials, textures,
    camera and plane. Names, files and prompts do not.
    """
    digest = hashlib.sha256()

    def add(value: Any) -> None:
        array = np.ascontiguousarray(value)
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(array.data if array.size else b"")

    digest.update(
        f"{FORMAT} {warpir.__version__} {depth} {seed} {sorted(asdict(settings).items())}".encode()
    )
    for content in scene.contents():
        add(content)
    add(object_pixels)
    add(proxy_pixels)
    lobes = expected.lobes
    for array in (
        *((lobes.amplitude, lobes.axis, lobes.sharpness) if lobes is not None else ()),
        *((expected.texels,) if expected.texels is not None else ()),
    ):
        add(array)
    return digest.hexdigest()


def load_rows(path: Path, device: torch.device) -> dict[str, Tensor] | None:
    """Return the arrays of a cached file, or None when there is none that can be read."""
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    if not path.is_file():
        return None
    try:
        rows = load_file(path, device=str(device))
        os.utime(path)
    except (SafetensorError, OSError) as error:
        log.warning("%s: not readable, tracing again (%s)", path, error)
        return None
    return rows


def save_rows(path: Path, rows: dict[str, Tensor]) -> None:
    """Write the arrays, whole or not at all, and make room; a full disk is only a notice."""
    from safetensors.torch import save_file

    staged = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(suffix=".part", dir=path.parent)
        os.close(handle)
        staged = Path(name)
        save_file({k: v.contiguous() for k, v in rows.items()}, staged)
        os.replace(staged, path)
        _evict(path.parent, keep=path)
    except Exception as error:  # safetensors reports a full disk by its own type
        log.warning("%s: not kept (%s)", path, error)
        if staged is not None:
            staged.unlink(missing_ok=True)


def _evict(folder: Path, keep: Path) -> None:
    """Delete the files that were used longest ago until the folder fits `CACHE_BYTES`."""
    files = sorted(folder.glob("*.safetensors"), key=lambda f: f.stat().st_mtime, reverse=True)
    total = 0
    for file in files:
        total += file.stat().st_size
        if total > CACHE_BYTES and file != keep:
            file.unlink(missing_ok=True)
