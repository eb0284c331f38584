"""Made things that are kept between runs."""

from __future__ import annotations

import hashlib

import torch
from torch import Tensor

from warpir.diffusion.models.stable_diffusion import StableDiffusion


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


def model_key(prior: StableDiffusion) -> str:
    """Return what tells a model from all others: files, schedule, resolution and arithmetic.

    The schedule counts because the same weights stand for another model under another one; version
    and device because what they make differs in its last bits, and must not depend on what is kept.
    """
    schedule = prior.schedule
    return content_key(
        prior.digest,
        schedule.prediction_type,
        schedule.alphas_cumprod,
        prior.resolution,
        sorted(prior.precision.items()),
        torch.__version__,
        prior.device.type,
        torch.are_deterministic_algorithms_enabled(),
    )
