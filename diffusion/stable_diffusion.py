"""Stable Diffusion 2.x (or 1.5) as a prior: autoencoder, UNet and text encoder, all frozen.

Weights and schedule are read by diffusers and transformers from a folder that was checked first.
Differences between predictions are tiny beside the predictions, so the UNet computes in fp16 or
fp32 rather than bf16, and `StableDiffusion.ensure_precision` tells whether fp16 is enough. The
attention processors stay diffusers' own: replacing them loses the care that Stable Diffusion 2.1
needs in fp16.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import torch
import transformers.utils.logging
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    DPMSolverMultistepScheduler,
    UNet2DConditionModel,
)
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers import CLIPTextModel, CLIPTokenizer

from warpir.diffusion.cuda_graphs import Graphs
from warpir.diffusion.model_folder import (
    LATENT_CHANNELS,
    ModelFolder,
    check_model_folder,
    find_model,
    hub_offline,
)
from warpir.diffusion.prior import ModelError
from warpir.diffusion.schedule import PREDICTION_TYPES, TIME_LIMIT, NoiseSchedule
from warpir.diffusion.settings import ModelSettings

DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}
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
LEAST_COSINE = 0.98
"""Between a difference in low precision and in fp32; below it, fp16 spoils the guidance."""
CHECK_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times at which `StableDiffusion.self_check` measures the prompt's effect."""


class StableDiffusion:
    """Stable Diffusion behind `warpir.diffusion.prior.Prior`; made by `load_stable_diffusion`.

    Args:
        unet: Predicts noise, v or the clean sample.
        vae: Pictures to latents and back.
        text_encoder: Ids to embeddings, fp32.
        tokenizer: Words to ids.
        scheduler_config: The model's own; `SCHEDULE_WORDS` of it are used.
        weight_hashes: sha256 by name of a weight file.
        checkpoint_vae: Recompute the VAE's encoder in the backward pass instead of keeping it.
        graphs: Record what is done often as CUDA graphs; the device must be one.
    """

    name = "stable-diffusion"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        scheduler_config: dict[str, Any],
        weight_hashes: dict[str, str],
        checkpoint_vae: bool = True,
        graphs: bool = False,
    ) -> None:
        self.unet, self.vae, self.tokenizer = unet, vae, tokenizer
        self.text_encoder: CLIPTextModel | None = text_encoder
        for model in (unet, vae, text_encoder):
            model.requires_grad_(False).eval()
        if checkpoint_vae:
            # There is no randomness to repeat, and asking for its state would stop a recording.
            vae.enable_gradient_checkpointing(
                partial(checkpoint, use_reentrant=False, preserve_rng_state=False)
            )
            # The encoder recomputes this block as a whole: once is enough.
            vae.encoder.mid_block.gradient_checkpointing = False
        self.device: torch.device = unet.device
        self.graphs = Graphs(self.device) if graphs else None
        self._mean = _PosteriorMean(vae)
        self._recorded_mean = self.graphs.recorded_module(self._mean) if self.graphs else None
        self.unet_dtype: torch.dtype = unet.dtype
        """Arithmetic of the UNet; an adapter in training may have its own."""
        self.latent_size: int = unet.config.sample_size
        """Side of the latents."""
        self.resolution = self.latent_size * 2 ** (len(vae.config.block_out_channels) - 1)
        self._latent_scale: float = vae.config.scaling_factor
        self.weight_hashes = dict(sorted(weight_hashes.items()))
        lines = "".join(f"{name} {sha256}\n" for name, sha256 in self.weight_hashes.items())
        self.digest = hashlib.sha256(lines.encode()).hexdigest()
        self.adapters: set[str] = set()
        """Whoever adds an adapter to the UNet names it here."""
        self.notices: tuple[str, ...] = ()
        """What the user is told about: precision, shortened prompts."""
        self._solver_config = {
            word: scheduler_config[word] for word in SCHEDULE_WORDS if word in scheduler_config
        }
        self.schedule = _noise_schedule(self._solver_config)
        self._embeddings: dict[str, Tensor] = {}

    def embed(self, prompts: Sequence[str]) -> Tensor:
        """Return the prompts' embeddings, float32, shape [prompt, token, channel].

        Each prompt is computed once and kept. One that is too long is cut, with a notice.

        Raises:
            ModelError: The text encoder was freed and a prompt is new.
        """
        for prompt in prompts:
            if prompt not in self._embeddings:
                self._embeddings[prompt] = self._encode_text(prompt)
        return torch.stack([self._embeddings[prompt] for prompt in prompts])

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

    def predict(
        self,
        latents_noisy: Tensor,
        t: Tensor,
        embeddings: Tensor,
        adapters: Sequence[str | None],
        background: Tensor | None = None,
        gbuffer: Tensor | None = None,
    ) -> Tensor:
        """Return the predicted noise, float32, detached; see `warpir.diffusion.prior.Prior`.

        Raises:
            ModelError: An adapter is unknown.
        """
        self._check_adapters(adapters)
        latents_noisy, t = latents_noisy.detach().to(self.device), t.to(self.device)
        predicted = self._denoise(
            latents_noisy, self.schedule.timestep(t), embeddings, tuple(adapters)
        )
        return self.schedule.to_noise(predicted, latents_noisy, t)

    def sample(
        self,
        prompts: Sequence[str],
        seeds: Sequence[int],
        *,
        steps: int,
        scale: float,
        adapter: str | None = None,
        negative_prompt: str = "",
        batch: int = 8,
    ) -> Tensor:
        """Return pictures of the prompts, in [0, 1], shape [prompt, 3, resolution, resolution].

        DPM-Solver++ of second order (arXiv 2211.01095). A picture depends on its own prompt and
        seed, not on those made with it.

        Args:
            prompts: One per picture.
            seeds: One per picture, of its first noise.
            steps: Denoising steps.
            scale: Of classifier-free guidance, ``null + scale (prompt - null)``; 1: none.
            adapter: Name of the adapter, or None for the base weights.
            negative_prompt: What stands for null.
            batch: Pictures made at once.

        Raises:
            ModelError: The adapter is unknown, or the text encoder was freed.
            ValueError: There are not as many seeds as prompts.
        """
        if len(prompts) != len(seeds):
            raise ValueError(f"seeds: {len(seeds)} (expected {len(prompts)}, one per prompt)")
        self._check_adapters([adapter])
        wanted, null = self.embed(prompts), self.embed([negative_prompt])
        images = []
        for start in range(0, len(prompts), batch):
            these = slice(start, start + batch)
            solver = self._solver(order=2)
            solver.set_timesteps(steps)
            noise = self._noise(seeds[these])
            latents = self._solve(solver, noise, wanted[these], null, scale, adapter)
            images.append(self.decode(latents))
        return torch.cat(images)

    def edit(
        self,
        image: Tensor,
        prompt: str,
        seed: int,
        *,
        strength: float,
        steps: int,
        scale: float,
        adapter: str | None = None,
        negative_prompt: str = "",
    ) -> Tensor:
        """Return a picture that was noised and denoised again (SDEdit, arXiv 2108.01073).

        DDIM, which is DPM-Solver++ of first order, with all its steps below ``strength``.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, resolution, resolution].
            prompt: What it is to become.
            seed: Of the noise.
            strength: Time in [0, 1] that it is noised to; 0: only through the VAE and back.
            steps: Denoising steps.
            scale: Of classifier-free guidance, ``null + scale (prompt - null)``; 1: none.
            adapter: Name of the adapter, or None for the base weights.
            negative_prompt: What stands for null.

        Returns:
            In [0, 1], of the image's shape.

        Raises:
            ModelError: The adapter is unknown, or the text encoder was freed.
        """
        self._check_adapters([adapter])
        wanted, null = self.embed([prompt]), self.embed([negative_prompt])
        with torch.no_grad():
            latents = self.encode(image)
        t = torch.tensor([min(strength, TIME_LIMIT)])
        start = int(self.schedule.timestep(t))
        if start > 0:
            solver = self._solver(order=1)
            times = torch.linspace(start, 0, steps + 1)[:-1].round().long().tolist()
            solver.set_timesteps(timesteps=sorted(set(times), reverse=True))
            noisy = self.schedule.add_noise(latents, self._noise([seed]), t.to(self.device))
            latents = self._solve(solver, noisy, wanted, null, scale, adapter)
        return self.decode(latents)

    def precision_check(self, difference: Callable[[], Tensor]) -> float:
        """Return the cosine between a difference of predictions as computed here and in fp32.

        Args:
            difference: Predicts and subtracts, such as guidance does with its own prompts and
                adapters; called twice, with all else equal. 1 where the UNet is in fp32 anyway.
        """
        if self.unet_dtype is torch.float32:
            return 1.0
        low = difference().double().flatten()
        with self.in_full_precision():
            full = difference().double().flatten()
        return float(torch.dot(low, full) / (low.norm() * full.norm()))

    def ensure_precision(self, difference: Callable[[], Tensor]) -> float:
        """Go on in fp32 if the difference needs it, with a notice; return `precision_check`.

        To be called before anything that holds on to the UNet's weights.
        """
        cosine = self.precision_check(difference)
        if not cosine >= LEAST_COSINE:  # nan, where half precision overflowed, counts as too small
            used = next(name for name, dtype in DTYPES.items() if dtype is self.unet_dtype)
            self._notice(
                f"the UNet computes in fp32: in {used} the guidance has cosine {cosine:.3f} with "
                f"the exact one (at least {LEAST_COSINE})"
            )
            self.use_full_precision()
        return cosine

    def use_full_precision(self) -> None:
        """Let the UNet compute in fp32 from now on; its weights stay as rounded as they were."""
        self.forget_graphs()
        for weight in self.unet.parameters():
            weight.data = weight.data.float()
        self.unet_dtype = torch.float32

    @contextmanager
    def in_full_precision(self) -> Iterator[None]:
        """Let the UNet compute in fp32 within this context, then as before on the same memory."""
        used, values = self.unet_dtype, [(w, w.data) for w in self.unet.parameters()]
        graphs, self.graphs = self.graphs, None  # recordings read this memory, and will again
        self.use_full_precision()
        try:
            yield
        finally:
            for weight, value in values:
                weight.data = value
            self.unet_dtype, self.graphs = used, graphs

    def forget_graphs(self) -> None:
        """Free what was recorded: to be called before weights or adapters change."""
        if self.graphs is not None:
            self.graphs.clear()

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
    def _denoise(
        self,
        latents: Tensor,
        timesteps: Tensor,
        embeddings: Tensor,
        adapters: tuple[str | None, ...],
    ) -> Tensor:
        """Return what the UNet predicts, whatever that is, float32; its only call.

        Args:
            latents: Noisy, shape [B, 4, h, w].
            timesteps: Shape [B], int64.
            embeddings: Shape [B, token, channel].
            adapters: One name per sample, or None.
        """
        kind = self.unet_dtype

        def unet(latents: Tensor, timesteps: Tensor, embeddings: Tensor) -> Tensor:
            with self._with_adapters(adapters), self._exact_convolutions():
                predicted: Tensor = self.unet(
                    latents.to(kind), timesteps, encoder_hidden_states=embeddings.to(kind)
                ).sample
            return predicted.float()

        arguments = [x.to(self.device) for x in (latents, timesteps, embeddings)]
        if self.graphs is None:
            return unet(*arguments)
        return self.graphs.run((kind, adapters), unet, *arguments)

    @contextmanager
    def _with_adapters(self, names: tuple[str | None, ...]) -> Iterator[None]:
        """Give each sample of a batch its adapter; afterwards all is as before.

        In mixed batches each adapter sees all samples, and what it makes of others' is erased
        between its two layers. peft's own way picks samples by lists, which are uploaded in every
        layer: slower, and a CUDA graph cannot hold it.
        """
        from peft.tuners.lora.layer import LoraLayer

        layers = [module for module in self.unet.modules() if isinstance(module, LoraLayer)]
        if not layers:
            yield
            return
        states = [(layer, layer.active_adapters, layer.disable_adapters) for layer in layers]
        # Both of peft's switches set these too, which would start or stop a training.
        trained = [(weight, weight.requires_grad) for weight in self.unet.parameters()]
        wanted = sorted({name for name in names if name is not None})

        def erase_others(name: str) -> Callable[[nn.Module, Any, Tensor], None]:
            others = [sample for sample, own in enumerate(names) if own != name]

            def erase(module: nn.Module, args: Any, reduced: Tensor) -> None:
                for sample in others:
                    reduced[sample].zero_()

            return erase

        hooks = []
        try:
            for layer in layers:
                layer.enable_adapters(bool(wanted))
                layer.set_adapter(wanted)
                for name in wanted if len(set(names)) > 1 else ():
                    if name in layer.lora_A:
                        hooks.append(layer.lora_A[name].register_forward_hook(erase_others(name)))
            yield
        finally:
            for hook in hooks:
                hook.remove()
            for layer, active, disabled in states:
                layer.set_adapter(active)
                layer.enable_adapters(not disabled)
            for weight, flag in trained:
                weight.requires_grad_(flag)

    def _exact_convolutions(self) -> AbstractContextManager[None]:
        """Keep cuDNN from rounding a UNet in fp32 to TF32, which has no more bits than fp16."""
        return _no_tf32() if self.unet_dtype is torch.float32 else contextlib.nullcontext()

    def _check_adapters(self, names: Sequence[str | None]) -> None:
        unknown = {name for name in names if name is not None} - self.adapters
        if unknown:
            known = ", ".join(sorted(self.adapters)) or "none"
            raise ModelError(self.name, f"no adapter {min(unknown)!r} (there are: {known})")

    def _noise(self, seeds: Sequence[int]) -> Tensor:
        """Return one noise per seed, shape [seed, 4, h, w]; drawn on the CPU, alike everywhere."""
        shape = (LATENT_CHANNELS, self.latent_size, self.latent_size)
        draws = [torch.randn(shape, generator=torch.Generator().manual_seed(s)) for s in seeds]
        return torch.stack(draws).to(self.device)

    def _solver(self, order: int) -> DPMSolverMultistepScheduler:
        """Return DPM-Solver++ on the model's schedule; of first order it is DDIM."""
        return DPMSolverMultistepScheduler.from_config(self._solver_config, solver_order=order)

    def _solve(
        self,
        solver: DPMSolverMultistepScheduler,
        latents: Tensor,
        wanted: Tensor,
        null: Tensor,
        scale: float,
        adapter: str | None,
    ) -> Tensor:
        """Denoise latents through the solver's timesteps, with classifier-free guidance.

        Args:
            solver: Its timesteps are set.
            latents: At the first timestep, shape [B, 4, h, w].
            wanted: Embeddings, shape [B, token, channel].
            null: Embedding of the null prompt, shape [1, token, channel].
            scale: Of the guidance.
            adapter: For all of them.
        """
        count = len(latents)
        embeddings = wanted if scale == 1.0 else torch.cat([wanted, null.expand_as(wanted)])
        repeats = len(embeddings) // count
        for timestep in solver.timesteps:
            predicted = self._denoise(
                latents.repeat(repeats, 1, 1, 1),
                timestep.expand(repeats * count),
                embeddings,
                (adapter,) * (repeats * count),
            )
            if repeats == 2:
                prompted, unprompted = predicted.chunk(2)
                predicted = unprompted + scale * (prompted - unprompted)
            latents = solver.step(predicted, timestep, latents).prev_sample
        return latents

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

    def _notice(self, text: str) -> None:
        self.notices = (*self.notices, text)


class _PosteriorMean(nn.Module):
    """The mean of the latents' distribution, shape [B, 4, h, w], and nothing else."""

    def __init__(self, vae: AutoencoderKL) -> None:
        super().__init__()
        self.vae = vae

    def forward(self, pixels: Tensor) -> tuple[Tensor, ...]:
        return (self.vae.encode(pixels).latent_dist.mean,)


def load_stable_diffusion(settings: ModelSettings, device: torch.device | str) -> StableDiffusion:
    """Load a model from a folder, or from a hub id in the local cache.

    Args:
        settings: Which model, and how it is computed; on the CPU always in fp32.
        device: Where UNet, VAE and text encoder go.

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
        folder = check_model_folder(find_model(settings.model, settings.allow_download))
        # Hashing reads what loading reads, at the same time.
        hashes = pool.map(folder.file_hash, (f for w in folder.weights.values() for f in w.files))
        unet = _load(UNet2DConditionModel, folder, "unet", unet_precision, device)
        vae = _load(AutoencoderKL, folder, "vae", vae_precision, device)
        # The attention is named lest the configuration name code of the hub.
        options = {"attn_implementation": "sdpa", "trust_remote_code": False}
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
        )
    if asked != (unet_precision, vae_precision):
        prior.notices = (f"the CPU computes in fp32 (asked for: {', '.join(sorted(set(asked)))})",)
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
            use_safetensors=True,
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
    if kind not in PREDICTION_TYPES:
        expected = ", ".join(PREDICTION_TYPES)
        raise ModelError(where, f"prediction_type {kind!r} (expected {expected})")
    count = config.get("num_train_timesteps", 1000)
    if type(count) is not int or not 2 <= count <= 100_000:
        raise ModelError(where, f"num_train_timesteps {count!r} (expected 2 to 100000)")
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
        if isinstance(error, MemoryError | torch.OutOfMemoryError) or "allocate mem" in str(error):
            raise
        reason = " ".join(str(error).split())[:160]
        what = f"cannot be loaded ({type(error).__name__}: {reason})"
        raise ModelError(where, what, "fetch the model again") from error
    finally:
        for log, level in zip(logs, levels, strict=True):
            log.setLevel(level)
        if bars:
            transformers.utils.logging.enable_progress_bar()


@contextmanager
def _no_tf32() -> Iterator[None]:
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
