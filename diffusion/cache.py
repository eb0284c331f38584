"""Where made things are kept between runs, and the one way in which files are written here."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

if TYPE_CHECKING:
    from warpir.diffusion.prior import Prior

CACHE_BYTES = 4 << 30
"""What a folder of the cache may hold; the files that were used longest ago go first."""


def cache_folder(kind: str = "") -> Path:
    """Return the folder for made things: ``WARPIR_CACHE``, or one in the user's cache.

    Args:
        kind: ``lora`` or ``class-images``; empty: the folder of all kinds.
    """
    own = os.environ.get("WARPIR_CACHE")
    if own:
        return Path(own) / kind
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "warpir" / kind


def write_file(path: Path, content: bytes) -> None:
    """Write a file whole or not at all; the folder is made where it is missing.

    Raises:
        OSError: The disk is full or the folder is not writable; an older file is still whole.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    staged = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with staged.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(staged, path)
    finally:
        staged.unlink(missing_ok=True)


def make_room(folder: Path, pattern: str, limit: int = CACHE_BYTES) -> None:
    """Delete the matching files that were used longest ago until the rest fits ``limit``."""
    held = []
    for file in folder.glob(pattern):
        try:
            held.append((file.stat(), file))
        except FileNotFoundError:  # another process made room
            continue
    total = 0
    for stat, file in sorted(held, key=lambda entry: entry[0].st_mtime, reverse=True):
        total += stat.st_size
        if total > limit:
            file.unlink(missing_ok=True)


def content_key(*contents: object) -> str:
    """Return a hash of everything that a made thing depends on, as 64 hexadecimal digits.

    Tensors count by type, shape and bytes, all else by its ``repr``.
    """
    digest = hashlib.sha256()
    for content in contents:
        if isinstance(content, Tensor):
            array = content.detach().cpu().contiguous().numpy()
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(array.tobytes())
        else:
            digest.update(repr(content).encode())
        digest.update(b"\0")
    return digest.hexdigest()


def model_key(prior: Prior) -> str:
    """Return what tells a model from all others: weights, schedule and resolution.

    The schedule counts because the same weights stand for another model under another one.
    """
    schedule = prior.schedule
    return content_key(
        prior.digest, schedule.prediction_type, schedule.alphas_cumprod, prior.resolution
    )
