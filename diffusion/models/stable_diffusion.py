"""Stable Diffusion 2.x (or 1.5) as a prior: autoencoder, UNet and text encoder, all frozen.

Weights and schedule are read by diffusers and transformers from a folder that was checked first.
The attention processors stay diffusers' own: replacing them loses the care that Stable Diffusion
2.1 needs in fp16.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
import transformers.utils.logging
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers import CLIPTextModel, CLIPTokenizer

from warpir.diffusion.models.hub import find_model, hub_offline
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import (
    LATENT_CHANNELS,
    ModelFolder,
    check_model_folder,
)
from warpir.diffusion.models.network_prior import DTYPES, NetworkPrior, name_of_dtype
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
CHECK_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times at which `StableDiffusion.self_check` measures the prompt's effect."""


class StableDiffusion(NetworkPrior):
    """Stable Diffusion behind `warpir.diffusion.prior.Prior`; made by `load_stable_diffusion`.

    Args:
        unet: Predicts noise, v or the clean sample.
        vae: Pictures to latents and back.
        text_encoder: Ids to embeddings, fp32.
        tokenizer: Words to ids.
        scheduler_config: The model's own; `SCHEDULE_WORDS` of it are used.
        file_hashes: sha256 by name of every file that it was made of.
        checkpoint_vae: Recompute the VAE's encoder in the backward pass instead of keeping it.
        graphs: Record what is done often as CUDA graphs; the device must be one.
        in_chunks: How larger batches are computed.
    """

    name = "stable-diffusion"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        scheduler_config: dict[str, Any],
        file_hashes: dict[str, str],
        checkpoint_vae: bool = True,
        graphs: bool = False,
        in_chunks: InChunks = at_once,
    ) -> None:
        self.vae, self.tokenizer = vae, tokenizer
        self.text_encoder: CLIPTextModel | None = text_encoder
        for model in (vae, text_encoder):
            model.requires_grad_(False).eval()
        if checkpoint_vae:
            self._checkpoint_vae()
        solver_config = {
            word: scheduler_config[word] for word in SCHEDULE_WORDS if word in scheduler_config
        }
        side: int = unet.config.sample_size
        super().__init__(
            unet,
            _noise_schedule(solver_config),
            solver_config,
            (LATENT_CHANNELS, side, side),
            side * 2 ** (len(vae.config.block_out_channels) - 1),
            file_hashes,
            graphs,
            in_chunks,
        )
        self._mean = _PosteriorMean(vae)
        self._recorded_mean = self.graphs.recorded_module(self._mean) if self.graphs else None
        self._latent_scale: float = vae.config.scaling_factor

    def _checkpoint_vae(self) -> None:
        # There is no randomness to repeat, and asking for its state would stop a recording.
        self.vae.enable_gradient_checkpointing(
            partial(checkpoint, use_reentrant=False, preserve_rng_state=False)
        )
        # The encoder recomputes this block as a whole: once is enough.
        self.vae.encoder.mid_block.gradient_checkpointing = False

    def spare_memory(self) -> None:
        """Do without recordings, and recompute the VAE's encoder in its backward pass."""
        super().spare_memory()
        self._checkpoint_vae()

    @property
    def precision(self) -> dict[str, str]:
        """Arithmetic of UNet and VAE."""
        return {**super().precision, "vae": name_of_dtype(self.vae.dtype)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        super().load_state_dict(state)
        if state["precision"]["vae"] == "fp32":
            self._upcast_vae()

    def upcast(self) -> bool:
        """Let UNet and VAE compute in fp32 from now on; return False where they do already."""
        is_vae_low = self._upcast_vae()
        return super().upcast() or is_vae_low

    def _upcast_vae(self) -> bool:
        if self.vae.dtype is torch.float32:
            return False
        self.forget_graphs()
        self.vae.float()
        return True

    def free_text_encoder(self) -> None:
        """Drop the text encoder and its memory; embeddings that were made stay."""
        self.text_encoder = None
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def encode(self, image: Tensor) -> Tensor:
        """Return latents, float32, shape [B, 4, h, w]: the posterior's mean, scaled.

        Differentiable. With a VAE in fp16, sum the loss over the latents rather than averaging it:
        a mean's small gradients underflow on their way back.

        Args:
            image: Display-encoded, in [0, 1], shape [B, 3, resolution, resolution].

        Raises:
            ValueError: The image has another shape.
        """
        expected = (3, self.resolution, self.resolution)
        if image.ndim != 4 or image.shape[1:] != expected:
            raise ValueError(
                f"image: shape {tuple(image.shape)} (expected [B, 3, R, R], {expected})"
            )
        pixels = (2.0 * image - 1.0).to(self.device, self.vae.dtype)
        mean_of: Callable[[Tensor], tuple[Tensor, ...]] = self._mean
        if self.graphs and self._recorded_mean and pixels.requires_grad and torch.is_grad_enabled():
            mean_of = self._recorded_mean
        (mean,) = mean_of(pixels)
        return mean.float() * self._latent_scale

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Return pictures, float32, in [0, 1], shape [B, 3, resolution, resolution].

        Each is decoded by itself, so that memory does not grow with their number.
        """
        scaled = (latents.to(self.device) / self._latent_scale).to(self.vae.dtype)
        images = [self.vae.decode(latent[None]).sample.float() for latent in scaled]
        return (torch.cat(images) / 2.0 + 0.5).clamp(0.0, 1.0)

    @torch.no_grad()
    def self_check(self, image: Tensor, prompt: str, seed: int = 0) -> dict[str, float]:
        """Return figures that tell a working model from a broken one, for a photo.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, resolution, resolution].
            prompt: What it shows.
            seed: Of the noise.

        Returns:
            ``noise_error``: mean squared error of the noise at time 0.5; a trained model stays well
            below 1, which is that of predicting no noise. ``difference_0.1`` and so on: what the
            prompt changes in the prediction, root mean square, by time. ``precision``: see
            `precision_check`, with the differences at all times.
        """
        latents, noise = self.encode(image), self._noise([seed])
        pair = self.embed([prompt, ""])

        def noise_at(t: Tensor, embeddings: Tensor) -> Tensor:
            noisy = self.schedule.add_noise(
                latents.expand(len(t), -1, -1, -1), noise.expand(len(t), -1, -1, -1), t
            )
            return self.predict(noisy, t, embeddings, [None] * len(t))

        def difference() -> Tensor:
            times = torch.tensor(CHECK_TIMES, device=self.device)
            count = len(times)
            both = noise_at(times.repeat(2), pair.repeat_interleave(count, dim=0))
            return both[:count] - both[count:]

        half = torch.tensor([0.5], device=self.device)
        figures = {"noise_error": float((noise_at(half, pair[:1]) - noise).square().mean())}
        sizes = difference().square().mean(dim=(1, 2, 3)).sqrt().tolist()
        figures |= {f"difference_{t}": s for t, s in zip(CHECK_TIMES, sizes, strict=True)}
        return figures | {"precision": self.precision_check(difference)}

    @torch.no_grad()
    def _encode_text(self, prompt: str) -> Tensor:
        """Return a prompt's embedding, float32, shape [token, channel]."""
        if self.text_encoder is None:
            what = f"the text encoder was freed before the prompt {prompt!r} was embedded"
            raise ModelError(self.name, what)
        length: int = self.text_encoder.config.max_position_embeddings
        ids = self.tokenizer(prompt, truncation=False, verbose=False).input_ids
        if len(ids) > length:
            last = self.tokenizer.decode(ids[length - 7 : length - 1]).strip()
            self._notice(
                f"a prompt of {len(ids)} tokens is truncated after {length}: ... {last!r} is the "
                f"last that is read"
            )
        padded = self.tokenizer(
            prompt,
            padding="max_length",
            max_length=length,
            truncation=True,
            return_tensors="pt",
        ).input_ids
        hidden: Tensor = self.text_encoder(padded.to(self.device))[0]
        return hidden[0].float()


class _PosteriorMean(nn.Module):
    """The mean of the latents' distribution, shape [B, 4, h, w], and nothing else."""

    def __init__(self, vae: AutoencoderKL) -> None:
        super().__init__()
        self.vae = vae

    def forward(self, pixels: Tensor) -> tuple[Tensor, ...]:
        return (self.vae.encode(pixels).latent_dist.mean,)


def load_stable_diffusion(
    settings: ModelSettings, device: torch.device | str, in_chunks: InChunks = at_once
) -> StableDiffusion:
    """Load a model from a folder, or from a hub id in the local cache.

    UNet, VAE and text encoder go to ``device``; on the CPU all is computed in fp32. ``in_chunks``
    says how larger batches are computed.

    Raises:
        ModelError: The model is not there, is another one or is damaged; one sentence says how.
        ValueError: A precision is unknown.
    """
    device = torch.device(device)
    asked = settings.precision, settings.vae_precision
    for name in asked:
        if name not in DTYPES:
            raise ValueError(f"precision: {', '.join(DTYPES)} (found {name!r})")
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
        prior = StableDiffusion(
            unet,
            vae,
            text_encoder,
            tokenizer,
            folder.configs["scheduler"],
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
    """Load one part's network, with exactly the weights it needs, all of them finite.

    Raises:
        ModelError: The weights are not the network's, or not finite in this precision.
    """
    path, weights = folder.path / part, folder.weights[part]
    with _one_sentence(str(path)):
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
            raise ModelError(str(path), f"{what} weights ({len(names)}, such as {names[0]})")
    network = network.to(device)
    for name, weight in network.named_parameters():
        if not bool(torch.isfinite(weight).all()):
            raise ModelError(str(path), f"{name} is not finite in {precision}")
    return network


def _load_tokenizer(folder: ModelFolder, vocabulary: int) -> CLIPTokenizer:
    """Load the tokenizer.

    Raises:
        ModelError: It cannot be read, or has ids that the text encoder has not.
    """
    path = folder.path / "tokenizer"
    with _one_sentence(str(path)):
        tokenizer = CLIPTokenizer.from_pretrained(
            path, local_files_only=True, trust_remote_code=False
        )
        count = len(tokenizer)
    if count > vocabulary:
        raise ModelError(str(path), f"{count} tokens (expected {vocabulary}, the text encoder's)")
    return tokenizer


def _noise_schedule(config: dict[str, Any]) -> NoiseSchedule:
    """Return the schedule of a scheduler's configuration, as diffusers computes it.

    Raises:
        ModelError: It is none of the kinds that Stable Diffusion has.
    """
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
def _one_sentence(where: str) -> Iterator[None]:
    """Turn whatever a library raises about a file into one `ModelError`, and hush its log.

    Raises:
        ModelError: Something was raised that is no lack of memory.
    """
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
