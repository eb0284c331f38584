"""Stable Diffusion 2.x (or 1.5) as a prior: autoencoder, UNet and text encoder, all frozen.

Differences between predictions are tiny beside the predictions, so the UNet computes in fp16 or
fp32 rather than bf16, and `StableDiffusion.ensure_precision` tells whether fp16 is enough. Each
sample of a batch has its own prompt and adapter (a LoRA). The attention processors stay diffusers'
own: replacing them loses the care that Stable Diffusion 2.1 needs in fp16.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any

import torch
from diffusers import AutoencoderKL, DPMSolverMultistepScheduler, UNet2DConditionModel
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers import CLIPTextModel, CLIPTokenizer

from warpir.diffusion.models.adapters import with_adapters
from warpir.diffusion.models.cuda_graphs import Graphs
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.prior import InChunks, NonFiniteError
from warpir.diffusion.schedule import TIME_LIMIT, NoiseSchedule

DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}
NAMES = {dtype: name for name, dtype in DTYPES.items()}
LEAST_COSINE = 0.98
"""Between a difference in low precision and in fp32; below it, fp16 spoils the guidance."""
CHECK_TIMES = (0.1, 0.3, 0.5, 0.7, 0.9)
"""Times at which `StableDiffusion.self_check` measures the prompt's effect."""


class StableDiffusion:
    """A frozen denoiser: encodes pictures, and predicts the noise in noisy latents for a prompt.

    Made by `warpir.diffusion.models.loading.load_stable_diffusion`.

    Args:
        unet: Predicts noise, v or the clean sample.
        vae: Pictures to latents and back.
        text_encoder: Ids to embeddings, fp32.
        tokenizer: Words to ids.
        schedule: Noise schedule of the UNet.
        solver_config: The same for diffusers' solvers, and what else they have to know.
        file_hashes: sha256 by name of every file that it was made of.
        checkpoint_vae: Recompute the VAE's encoder in the backward pass instead of keeping it.
        graphs: Record what is done often as CUDA graphs; the device must be one.
        in_chunks: How larger batches are computed, such as in halves where memory is short.
    """

    name = "stable-diffusion"

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        text_encoder: CLIPTextModel,
        tokenizer: CLIPTokenizer,
        schedule: NoiseSchedule,
        solver_config: Mapping[str, Any],
        file_hashes: Mapping[str, str],
        checkpoint_vae: bool,
        graphs: bool,
        in_chunks: InChunks,
    ) -> None:
        for model in (unet, vae, text_encoder):
            model.requires_grad_(False).eval()
        self.unet, self.vae, self.tokenizer = unet, vae, tokenizer
        self.text_encoder: CLIPTextModel | None = text_encoder
        self.schedule, self._solver_config = schedule, dict(solver_config)
        self.device: torch.device = unet.device
        self.unet_dtype: torch.dtype = unet.dtype
        """Arithmetic of the UNet; an adapter in training may have its own."""
        side: int = unet.config.sample_size
        self.latent_shape = (unet.config.in_channels, side, side)
        """Shape of one picture's latents, [C, h, w]."""
        self.resolution = side * 2 ** (len(vae.config.block_out_channels) - 1)
        """Side of the square pictures that it judges [px]."""
        self._latent_scale: float = vae.config.scaling_factor
        self.file_hashes = dict(sorted(file_hashes.items()))
        lines = "".join(f"{name} {sha256}\n" for name, sha256 in self.file_hashes.items())
        self.digest = hashlib.sha256(lines.encode()).hexdigest()
        self.in_chunks = in_chunks
        self.adapters: set[str] = set()
        """Whoever adds an adapter to the UNet names it here."""
        self.notices: tuple[str, ...] = ()
        """What the user is told about: precision, prompts that are not wholly read."""
        self._embeddings: dict[str, Tensor] = {}
        self.graphs = Graphs(self.device) if graphs else None
        self._mean = _PosteriorMean(vae)
        self._recorded_mean = self.graphs.recorded_module(self._mean) if self.graphs else None
        if checkpoint_vae:
            self._checkpoint_vae()

    @property
    def precision(self) -> dict[str, str]:
        """Arithmetic of UNet and VAE, such as ``fp16``."""
        return {"unet": NAMES[self.unet_dtype], "vae": NAMES[self.vae.dtype]}

    def state_dict(self) -> dict[str, Any]:
        """Return what a run has changed in it beside adapters: plain values."""
        return {"precision": self.precision, "notices": self.notices}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`: what had to go over to fp32 computes in it from the start."""
        if state["precision"]["unet"] == "fp32":
            self.use_full_precision()
        if state["precision"]["vae"] == "fp32":
            self.forget_graphs()
            self.vae.float()
        self.notices = tuple(dict.fromkeys([*state["notices"], *self.notices]))

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
            prompt, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
        ).input_ids
        hidden: Tensor = self.text_encoder(padded.to(self.device))[0]
        return hidden[0].float()

    def free_text_encoder(self) -> None:
        """Drop the text encoder and its memory; embeddings that were made stay."""
        self.text_encoder = None
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    def encode(self, image: Tensor) -> Tensor:
        """Return latents, float32, shape [B, 4, h, w]: the posterior's mean, scaled.

        Differentiable. With a VAE in fp16, sum the loss over the latents rather than averaging it:
        a mean's small gradients underflow on their way back. The image is display-encoded, in
        [0, 1], shape [B, 3, resolution, resolution].
        """
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
    ) -> Tensor:
        """Return the predicted noise (epsilon, whatever the network predicts), float32, detached.

        One batched call; each sample has its own prompt and adapter.

        Args:
            latents_noisy: ``a z + s noise``, shape [B, C, h, w].
            t: Times in [0, 1], shape [B].
            embeddings: From `embed`, one per sample, shape [B, token, channel].
            adapters: Per sample the name of its adapter, or None for the base weights.

        Raises:
            ModelError: An adapter is unknown.
        """
        self._check_adapters(adapters)
        latents_noisy, t = latents_noisy.detach().to(self.device), t.to(self.device)
        timesteps = self.schedule.timestep(t)
        predicted = self._denoise(latents_noisy, timesteps, embeddings, tuple(adapters))
        return self.schedule.to_noise(predicted, latents_noisy, t)

    def sample(
        self,
        prompts: Sequence[str],
        seeds: Sequence[int],
        *,
        steps: int,
        scale: float,
        adapter: str | None = None,
        batch: int = 8,
    ) -> Tensor:
        """Return pictures of the prompts, in [0, 1], shape [prompt, 3, resolution, resolution].

        DPM-Solver++ of second order (arXiv 2211.01095). A picture depends on its own prompt and
        seed, that of its first noise, not on those made with it, ``batch`` at once. ``scale`` is
        that of classifier-free guidance over the empty prompt; 1: none. Without an adapter the base
        weights are used.

        Raises:
            ModelError: The adapter is unknown, or the text encoder was freed.
        """
        self._check_adapters([adapter])
        wanted, null = self.embed(prompts), self.embed([""])
        images: list[Tensor] = []
        for start in range(0, len(prompts), batch):

            def made(first: int, last: int, start: int = start) -> Tensor:
                these = slice(start + first, start + last)
                solver = DPMSolverMultistepScheduler.from_config(
                    self._solver_config, solver_order=2
                )
                solver.set_timesteps(steps)
                noise = self._noise(seeds[these])
                return self.decode(self._solve(solver, noise, wanted[these], null, scale, adapter))

            count = min(batch, len(prompts) - start)
            images += self.in_chunks(
                made, count, "pictures of the class", "--class-batch", self.spare_memory
            )
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
    ) -> Tensor:
        """Return a picture that was noised and denoised again (SDEdit, arXiv 2108.01073).

        DDIM, which is DPM-Solver++ of first order, with all its steps below ``strength``, the time
        in [0, 1] that it is noised to; 0: only through the VAE and back. Prompt, scale, adapter
        and errors are as of `sample`.

        Picture and edit are display-encoded, in [0, 1], shape [1, 3, resolution, resolution].
        """
        self._check_adapters([adapter])
        wanted, null = self.embed([prompt]), self.embed([""])
        with torch.no_grad():
            latents = self.encode(image)
        t = torch.tensor([min(strength, TIME_LIMIT)])
        start = int(self.schedule.timestep(t))
        if start > 0:
            solver = DPMSolverMultistepScheduler.from_config(self._solver_config, solver_order=1)
            times = torch.linspace(start, 0, steps + 1)[:-1].round().long().tolist()
            solver.set_timesteps(timesteps=sorted(set(times), reverse=True))
            noisy = self.schedule.add_noise(latents, self._noise([seed]), t.to(self.device))
            latents = self._solve(solver, noisy, wanted, null, scale, adapter)
        return self.decode(latents)

    @torch.no_grad()
    def self_check(self, image: Tensor, prompt: str, seed: int = 0) -> dict[str, float]:
        """Return figures that tell a working model from a broken one, for a photo of the prompt.

        The image is as for `encode`; the seed is that of the noise.

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
        sizes = difference().square().mean(dim=(1, 2, 3)).sqrt().tolist()
        return {
            "noise_error": float((noise_at(half, pair[:1]) - noise).square().mean()),
            **{f"difference_{t}": size for t, size in zip(CHECK_TIMES, sizes, strict=True)},
            "precision": self.precision_check(difference),
        }

    def precision_check(self, difference: Callable[[], Tensor]) -> float:
        """Return the cosine between a difference of predictions as computed here and in fp32.

        It predicts and subtracts, as guidance does with its own prompts and adapters, and is called
        twice with all else equal. 1 where the UNet is in fp32 anyway.
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
            self._notice(
                f"the UNet computes in fp32: in {self.precision['unet']} the guidance has cosine "
                f"{cosine:.3f} with the exact one (at least {LEAST_COSINE})"
            )
            self.use_full_precision()
        return cosine

    def use_full_precision(self) -> None:
        """Let the UNet compute in fp32 from now on; its weights stay as rounded as they were."""
        self.forget_graphs()
        for weight in self.unet.parameters():
            weight.data = weight.data.float()
        self.unet_dtype = torch.float32

    def upcast(self, what: str) -> bool:
        """Compute in fp32 from now on, as ``what`` were not finite; return False where it does."""
        before = self.precision
        self.use_full_precision()
        self.vae.float()
        if self.precision != before:
            self._notice(f"the model computes in fp32: {what} were not finite before")
        return self.precision != before

    def finite(self, compute: Callable[[], Tensor], what: str) -> Tensor:
        """Return what is computed; in fp32 from now on if half precision overflows.

        Raises:
            NonFiniteError: It is not finite in fp32 either; ``what`` names it.
        """
        computed = compute()
        if not bool(computed.isfinite().all()) and self.upcast(what):
            computed = compute()
        if not bool(computed.isfinite().all()):
            raise NonFiniteError(f"{what} are not finite (found nan or inf), in fp32 too")
        return computed

    def spare_memory(self) -> None:
        """Do without recordings, and recompute the VAE's encoder in its backward pass."""
        self.forget_graphs()
        self.graphs = None
        self._checkpoint_vae()

    def _checkpoint_vae(self) -> None:
        # There is no randomness to repeat, and asking for its state would stop a recording.
        self.vae.enable_gradient_checkpointing(
            partial(checkpoint, use_reentrant=False, preserve_rng_state=False)
        )
        # The encoder recomputes this block as a whole: once is enough.
        self.vae.encoder.mid_block.gradient_checkpointing = False

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

    def denoise(self, latents_noisy: Tensor, timesteps: Tensor, embeddings: Tensor) -> Tensor:
        """Return what the UNet predicts with the adapters that are switched on; differentiable.

        Latents are on the device, shape [B, C, h, w]; timesteps int64, shape [B]; embeddings of
        shape [B, token, channel].
        """
        predicted: Tensor = self.unet(
            latents_noisy, timesteps, encoder_hidden_states=embeddings
        ).sample
        return predicted

    @torch.no_grad()
    def _denoise(
        self,
        latents: Tensor,
        timesteps: Tensor,
        embeddings: Tensor,
        adapters: tuple[str | None, ...],
    ) -> Tensor:
        """Return what the UNet predicts with each sample's adapter or None, float32, detached."""
        kind = self.unet_dtype

        def unet(latents: Tensor, timesteps: Tensor, embeddings: Tensor) -> Tensor:
            exact = no_tf32() if kind is torch.float32 else nullcontext()
            with with_adapters(self.unet, adapters), exact:
                return self.denoise(latents.to(kind), timesteps, embeddings.to(kind)).float()

        arguments = [x.to(self.device) for x in (latents, timesteps, embeddings)]
        if self.graphs is None:
            return unet(*arguments)
        return self.graphs.run((kind, adapters), unet, *arguments)

    def _check_adapters(self, names: Sequence[str | None]) -> None:
        unknown = {name for name in names if name is not None} - self.adapters
        if unknown:
            known = ", ".join(sorted(self.adapters)) or "none"
            raise ModelError(self.name, f"no adapter {min(unknown)!r} (there are: {known})")

    def _noise(self, seeds: Sequence[int]) -> Tensor:
        """Return one noise per seed, shape [seed, C, h, w]; drawn on the CPU, alike everywhere."""
        shape = self.latent_shape
        draws = [torch.randn(shape, generator=torch.Generator().manual_seed(s)) for s in seeds]
        return torch.stack(draws).to(self.device)

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

        Latents, shape [B, 4, h, w], are those of the first timestep. Embeddings are what is wanted,
        shape [B, token, channel], and that of the null prompt, shape [1, token, channel].
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

    def _notice(self, text: str) -> None:
        self.notices = (*self.notices, text)


class _PosteriorMean(nn.Module):
    """The mean of the latents' distribution, shape [B, 4, h, w], and nothing else."""

    def __init__(self, vae: AutoencoderKL) -> None:
        super().__init__()
        self.vae = vae

    def forward(self, pixels: Tensor) -> tuple[Tensor, ...]:
        return (self.vae.encode(pixels).latent_dist.mean,)


@contextmanager
def no_tf32() -> Iterator[None]:
    """Keep cuDNN from rounding fp32 to TF32, which has no more bits than fp16."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
