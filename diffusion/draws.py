"""Random numbers as functions of a key, so that a resumed run draws what it would have drawn."""

from __future__ import annotations

import hashlib

import torch


def seed_of(*key: int | str) -> int:
    """Return a seed of 63 bits that is a function of the key alone."""
    digest = hashlib.sha256(repr(key).encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1


def generator_of(*key: int | str) -> torch.Generator:
    """Return random numbers that are a function of the key alone, drawn on the CPU."""
    return torch.Generator().manual_seed(seed_of(*key))
