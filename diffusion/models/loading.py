"""Stable Diffusion from a folder or the hub's cache: checked first, then read by diffusers."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import transformers.utils.logging
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

from warpir.diffusion.models.hub import find_model, hub_offline
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import ModelFolder, check_model_folder
from warpir.diffusion.models.stable_diffusion import DTYPES, StableDiffusion
from warpir.diffusion.prior import InChunks, at_once
from warpir.diffusion.schedule import NoiseSchedule
from warpir.diffusion.settings import ModelSettings

SCHEDULE_WORDS = (
    "num_train_timesteps",
    "beta_start",
    "beta_end",
    "beta_schedule",
    "trained_betas",
    "prediction_type",
    "rescale_betas_zero_snr",
    "timestep_spacing",
    "steps_offset",
)
"""What a scheduler's configuration says about the model, and not about a way of sampling it."""


def load_stable_diffusion(
    settings: ModelSettings, device: torch.device | str, in_chunks: InChunks = at_once
) -> StableDiffusion:
    """Load a model from a folder, or from a hub id in the local cache.

    UNet, VAE and text encoder go to ``device``; on the CPU all is computed in fp32. ``in_chunks``
    says how larger batches are computed.

    Raises:
        ModelError: The model is not there, is another one or is damaged; one sentence says how.
    """
    device = torch.device(device)
    asked = settings.precision, settings.vae_precision
    unet_precision, vae_precision = ("fp32", "fp32") if device.type == "cpu" else asked

    with hub_offline(not settings.allow_download), ThreadPoolExecutor() as pool:
        found = find_model(settings.model, settings.allow_download, settings.allow_pickle)
        folder = check_model_folder(found, settings.allow_pickle)
        # Hashing reads what loading reads, at the same time.
        hashes = pool.map(folder.file_hash, folder.files)
        unet = _load(UNet2DConditionModel, folder, "unet", unet_precision, device)
        vae = _load(AutoencoderKL, folder, "vae", vae_precision, device)
        # The attention is named lest the configuration name code of the hub.
        options = {
            "attn_implementation": "sdpa",
            "trust_remote_code": False,
            "weights_only": True,  # diffusers reads no other pickles
        }
        text_encoder = _load(CLIPTextModel, folder, "text_encoder", "fp32", device, **options)
        tokenizer = _load_tokenizer(folder, text_encoder.config.vocab_size)
        config = folder.configs["scheduler"]
        solver_config = {word: config[word] for word in SCHEDULE_WORDS if word in config}
        prior = StableDiffusion(
            unet,
            vae,
            text_encoder,
            tokenizer,
            _noise_schedule(solver_config),
            solver_config,
            dict(hashes),
            settings.vae_checkpointing,
            settings.graphs and device.type == "cuda",
            in_chunks,
        )
    if asked != (unet_precision, vae_precision):
        prior.notices += (f"the CPU computes in fp32 (asked for: {', '.join(sorted(set(asked)))})",)
    pickles = [part for part, held in folder.weights.items() if held.is_pickle]
    if pickles:
        prior.notices += (f"weights read from pickles: {', '.join(pickles)} (--allow-pickle)",)
    return prior


def _load(
    kind: Any,
    folder: ModelFolder,
    part: str,
    precision: str,
    device: torch.device,
    **options: Any,
) -> Any:
    """Load one part's network, with exactly the weights it needs, all finite in its precision."""
    path, weights = folder.path / part, folder.weights[part]
    with _one_sentence(path):
        network, loaded = kind.from_pretrained(
            path,
            dtype=DTYPES[precision],
            variant=weights.variant,
            use_safetensors=not weights.is_pickle,
            local_files_only=True,
            output_loading_info=True,
            **options,
        )
    for word, what in (("missing_keys", "lacks"), ("unexpected_keys", "has foreign")):
        if loaded[word]:
            names = sorted(loaded[word])
            raise ModelError(path, f"{what} weights ({len(names)}, such as {names[0]})")
    network = network.to(device)
    for name, weight in network.named_parameters():
        if not bool(torch.isfinite(weight).all()):
            raise ModelError(path, f"{name} is not finite in {precision}")
    return network


def _load_tokenizer(folder: ModelFolder, vocabulary: int) -> CLIPTokenizer:
    """Load the tokenizer, whose ids the text encoder must have."""
    path = folder.path / "tokenizer"
    with _one_sentence(path):
        tokenizer = CLIPTokenizer.from_pretrained(
            path, local_files_only=True, trust_remote_code=False
        )
        count = len(tokenizer)
    if count > vocabulary:
        raise ModelError(path, f"{count} tokens (expected {vocabulary}, the text encoder's)")
    return tokenizer


def _noise_schedule(config: dict[str, Any]) -> NoiseSchedule:
    """Return the schedule of a scheduler's configuration, as diffusers computes it."""
    where = "scheduler/scheduler_config.json"
    kind = config.get("prediction_type", "epsilon")
    count = config.get("num_train_timesteps", 1000)
    with _one_sentence(where):
        scheduler = DDIMScheduler.from_config(config)
        betas: Tensor = scheduler.betas
    if len(betas) != count or not bool(((betas > 0.0) & (betas <= 1.0)).all()):
        raise ModelError(where, f"no noise schedule (expected {count} betas between 0 and 1)")
    return NoiseSchedule(scheduler.alphas_cumprod.double(), kind)


@contextmanager
def _one_sentence(where: str | Path) -> Iterator[None]:
    """Turn what a library raises, but a lack of memory, into one `ModelError`; hush its log."""
    logs = [logging.getLogger(name) for name in ("diffusers", "transformers")]
    levels = [log.level for log in logs]
    for log in logs:
        log.setLevel(logging.CRITICAL)
    bars = transformers.utils.logging.is_progress_bar_enabled()
    transformers.utils.logging.disable_progress_bar()
    try:
        yield
    except Exception as error:  # diffusers, transformers and tokenizers raise anything
        short = ("allocate mem", "out of memory", "Cannot allocate")
        if isinstance(error, MemoryError) or any(words in str(error) for words in short):
            raise
        reason = " ".join(str(error).split())[:160]
        what = f"cannot be loaded ({type(error).__name__}: {reason})"
        raise ModelError(where, what, "fetch the model again") from error
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)
        if bars:
            transformers.utils.logging.enable_progress_bar()
