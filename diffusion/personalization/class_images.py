"""Pictures of the object's class by the unadapted model: what keeps the concept while it adapts.

The model learns the photo and, beside it, its own pictures of the class (DiPIR, section 4.2.1), so
that added words still count and the photo's colours stay out of the object. Each picture is kept on
disk under a hash of all that it depends on: a run that was stopped makes the missing ones only.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image, PngImagePlugin
from torch import Tensor

from warpir.core.atomic import write_file
from warpir.core.cache import CACHE_BYTES, make_room
from warpir.diffusion.cache import content_key, model_key
from warpir.diffusion.draws import seed_of
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.prompts import Prompts, draw_class_prompts
from warpir.diffusion.settings import PersonalizeSettings

FORMAT = 1
"""Meaning of a stored picture; part of every key."""
COUNT_OUTDOORS, COUNT_INDOORS = 200, 40
"""Numbers of class images (DiPIR, section 4.2.1: about 200, and 30 to 40)."""

Report = Callable[[str, int, int], None]
"""Is told a stage, the steps done and the steps in all."""


@dataclass(frozen=True)
class ClassImages:
    """Pictures of the class, and how they came about."""

    images: Tensor
    """Display-encoded, uint8 on the CPU, shape [N, 3, resolution, resolution]."""
    prompts: tuple[str, ...]
    seeds: tuple[int, ...]
    made: int
    """How many were made now; the others were found on disk."""
    notices: tuple[str, ...]
    """What the user is told about, such as files that could not be read."""


def class_image_count(settings: PersonalizeSettings) -> int:
    """Return how many class images the settings ask for."""
    if settings.class_images is not None:
        return settings.class_images
    return COUNT_INDOORS if settings.indoors else COUNT_OUTDOORS


def make_class_images(
    prior: StableDiffusion,
    prompts: Prompts,
    settings: PersonalizeSettings,
    seed: int,
    cache: Path | None,
    report: Report | None = None,
) -> ClassImages:
    """Return the class images, from disk where they are there and else from the unadapted model.

    Each depends on its own prompt and seed; the batch it is made in changes its last bits, so
    batches are always the same ones, also where a stopped run goes on. Prompts, attributes and
    noise are functions of the run's seed; without a cache nothing is kept.

    Raises:
        NonFiniteError: A picture is not finite, in fp32 neither.
        ModelError: The text encoder was freed.
    """
    count = class_image_count(settings)
    texts = draw_class_prompts(prompts.noun, count, seed)
    seeds = tuple(seed_of(seed, "class image", index) for index in range(count))
    images = torch.zeros(count, 3, prior.resolution, prior.resolution, dtype=torch.uint8)
    model = model_key(prior)
    keys = [
        content_key(FORMAT, model, text, noise, settings.class_steps, settings.class_scale)
        for text, noise in zip(texts, seeds, strict=True)
    ]
    files = [cache / f"{key}.png" for key in keys] if cache else []
    missing, notices = _read_kept(files, images)
    done = count - len(missing)
    if report and count:
        report("class images", done, count)
    for start in range(0, count, settings.class_batch):
        batch = slice(start, min(start + settings.class_batch, count))
        wanted = [index for index in range(batch.start, batch.stop) if index in missing]
        if not wanted:
            continue
        pictures = _made(prior, texts[batch], seeds[batch], settings)
        for index in wanted:
            images[index] = pictures[index - start]
        try:
            for index in wanted if files else ():
                write_file(files[index], _png(images[index], texts[index], seeds[index]))
        except OSError as error:  # without a cache the run still ends as it would have
            notices.append(f"{cache}: class images are not kept ({error})")
            files = []
        done += len(wanted)
        if report:
            report("class images", done, count)
    if cache is not None and files and missing:
        with contextlib.suppress(OSError):  # a folder that is too full harms no run
            make_room(cache.glob("*.png"), CACHE_BYTES)
    return ClassImages(images, texts, seeds, len(missing), tuple(notices))


def _made(
    prior: StableDiffusion,
    texts: Sequence[str],
    seeds: Sequence[int],
    settings: PersonalizeSettings,
) -> Tensor:
    """Return one batch of pictures by the unadapted model, uint8, shape [B, 3, R, R]."""
    steps, scale, batch = settings.class_steps, settings.class_scale, settings.class_batch
    sample = partial(prior.sample, texts, seeds, steps=steps, scale=scale, batch=batch)
    return to_bytes(prior.finite(sample, "pictures of the class"))


def _read_kept(files: Sequence[Path], images: Tensor) -> tuple[set[int], list[str]]:
    """Fill in the pictures that are on disk; return the places of the others, and notices."""
    missing = set(range(len(images)))
    notices: list[str] = []
    for index, file in enumerate(files):
        try:
            if file.is_file():
                images[index] = _read_png(file, images.shape[-1])
                missing.discard(index)
        except Exception as error:  # Pillow says in a dozen ways that a file is damaged
            notices.append(f"{file}: not readable, made again ({error})")
    return missing, notices


def to_bytes(pictures: Tensor) -> Tensor:
    """Round finite pictures in [0, 1] to uint8 on the CPU."""
    return (pictures.detach().float().clamp(0.0, 1.0) * 255.0).round().to("cpu", torch.uint8)


def encode_pictures(
    prior: StableDiffusion, pictures: Tensor, batch: int, report: Report | None = None
) -> Tensor:
    """Return the pictures' latents, float32 on the CPU, shape [N, C, h, w].

    Args:
        prior: Encodes; the posterior's mean, no sampling noise.
        pictures: uint8, shape [N, 3, resolution, resolution].
        batch: Pictures at once.
        report: Is told "class latents", the number done and the number in all.
    """
    latents = [torch.zeros(0, *prior.latent_shape)]
    with torch.no_grad():
        for start in range(0, len(pictures), batch):
            part = pictures[start : start + batch].to(prior.device).float() / 255.0
            latents.append(prior.finite(partial(prior.encode, part), "latents").cpu())
            if report:
                report("class latents", start + len(part), len(pictures))
    return torch.cat(latents)


def _png(picture: Tensor, prompt: str, seed: int) -> bytes:
    """Return a PNG that names what it shows; [3, H, W] uint8."""
    pixels = np.ascontiguousarray(picture.permute(1, 2, 0).numpy())
    texts = PngImagePlugin.PngInfo()
    texts.add_itxt("prompt", prompt)
    texts.add_text("seed", str(seed))
    texts.add_text("sha256", hashlib.sha256(pixels.tobytes()).hexdigest())
    file = io.BytesIO()
    # Fast rather than small: the model waits meanwhile.
    Image.fromarray(pixels).save(file, "PNG", pnginfo=texts, compress_level=1)
    return file.getvalue()


def _read_png(path: Path, side: int) -> Tensor:
    """Return a stored picture, uint8 [3, side, side]; raise anything if it is not that."""
    with Image.open(path, formats=["PNG"]) as file:
        if file.size != (side, side):
            raise ValueError(f"found {file.size} pixels, expected {(side, side)}")
        pixels = np.array(file)
        # Decoders forgive a flipped bit in the pixels.
        if hashlib.sha256(pixels.tobytes()).hexdigest() != file.info.get("sha256"):
            raise ValueError("its pixels were changed")
    with contextlib.suppress(OSError):  # a cache that is only read is one too
        os.utime(path)
    return torch.from_numpy(pixels).permute(2, 0, 1).contiguous()
