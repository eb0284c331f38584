"""What priors have in common whose denoiser is a UNet of diffusers, frozen, with LoRAs beside it.

Differences between predictions are tiny beside the predictions, so the UNet computes in fp16 or
fp32 rather than bf16, and `NetworkPrior.ensure_precision` tells whether fp16 is enough. Each sample
of a batch has its own prompt and adapter. What a prior adds is how pictures become latents and how
words become embeddings.
"""

from __future__ import annotations

import contextlib
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from warpir.diffusion.models.adapters import with_adapters
from warpir.diffusion.models.cuda_graphs import Graphs
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.prior import InChunks, NonFiniteError, at_once
from warpir.diffusion.schedule import TIME_LIMIT, NoiseSchedule

if TYPE_CHECKING:
    from diffusers import DPMSolverMultistepScheduler, UNet2DConditionModel

DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16, "fp32": torch.float32}
LEAST_COSINE = 0.98
"""Between a difference in low precision and in fp32; below it, fp16 spoils the guidance."""


class NetworkPrior(ABC):
    """A UNet behind `warpir.diffusion.prior.Prior`, and what personalisation needs of it.

    Args:
        unet: Predicts noise, v or the clean sample; frozen from now on.
        schedule: Its noise schedule.
        solver_config: The same for diffusers' solvers, and what else they have to know.
        latent_shape: Shape of one picture's latents, [C, h, w].
        resolution: Side of the pictures that it judges [px].
        file_hashes: sha256 by name of every file that it was made of.
        graphs: Record what is done often as CUDA graphs; the device must be one.
        in_chunks: How larger batches are computed.
    """

    name: str
    """Such as ``stable-diffusion``."""

    def __init__(
        self,
        unet: UNet2DConditionModel,
        schedule: NoiseSchedule,
        solver_config: Mapping[str, Any],
        latent_shape: tuple[int, int, int],
        resolution: int,
        file_hashes: Mapping[str, str],
        graphs: bool,
        in_chunks: InChunks = at_once,
    ) -> None:
        unet.requires_grad_(False).eval()
        self.unet, self.schedule = unet, schedule
        self.device: torch.device = unet.device
        self.graphs = Graphs(self.device) if graphs else None
        self.unet_dtype: torch.dtype = unet.dtype
        """Arithmetic of the UNet; an adapter in training may have its own."""
        self.latent_shape, self.resolution = latent_shape, resolution
        self.file_hashes = dict(sorted(file_hashes.items()))
        lines = "".join(f"{name} {sha256}\n" for name, sha256 in self.file_hashes.items())
        self.digest = hashlib.sha256(lines.encode()).hexdigest()
        self.in_chunks = in_chunks
        self.adapters: set[str] = set()
        """Whoever adds an adapter to the UNet names it here."""
        self.notices: tuple[str, ...] = ()
        """What the user is told about: precision, prompts that are not wholly read."""
        self._solver_config = dict(solver_config)
        self._embeddings: dict[str, Tensor] = {}

    @property
    def precision(self) -> dict[str, str]:
        """Arithmetic of each network that decides what is made, such as ``unet``: ``fp16``."""
        return {"unet": name_of_dtype(self.unet_dtype)}

    @property
    def editor(self) -> NetworkPrior:
        """Return what edits pictures."""
        return self

    @property
    def half_precision(self) -> NetworkPrior:
        """Return what switches to full precision."""
        return self

    def state_dict(self) -> dict[str, Any]:
        """Return what a run has changed in it beside adapters: plain values."""
        return {"precision": self.precision, "notices": self.notices}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`: what had to go over to fp32 computes in it from the start."""
        if state["precision"]["unet"] == "fp32" and self.unet_dtype is not torch.float32:
            self.use_full_precision()
        self.notices = tuple(dict.fromkeys([*state["notices"], *self.notices]))

    @abstractmethod
    def encode(self, image: Tensor) -> Tensor:
        """Return latents; see `warpir.diffusion.prior.Prior`."""

    @abstractmethod
    def decode(self, latents: Tensor) -> Tensor:
        """Return pictures, float32, in [0, 1], shape [B, 3, resolution, resolution]."""

    @abstractmethod
    def free_text_encoder(self) -> None:
        """Drop what turns words into embeddings; embeddings that were made stay."""

    @abstractmethod
    def _encode_text(self, prompt: str) -> Tensor:
        """Return a prompt's embedding, float32, shape [token, channel]."""

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

    def predict(
        self,
        latents_noisy: Tensor,
        t: Tensor,
        embeddings: Tensor,
        adapters: Sequence[str | None],
    ) -> Tensor:
        """Return the predicted noise, float32, detached; see `warpir.diffusion.prior.Prior`.

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
            ValueError: There are not as many seeds as prompts.
        """
        if len(prompts) != len(seeds):
            raise ValueError(f"seeds: {len(seeds)} (expected {len(prompts)}, one per prompt)")
        self._check_adapters([adapter])
        wanted, null = self.embed(prompts), self.embed([""])
        images: list[Tensor] = []
        for start in range(0, len(prompts), batch):

            def made(first: int, last: int, start: int = start) -> Tensor:
                these = slice(start + first, start + last)
                solver = self._solver(order=2)
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
        in [0, 1] that it is noised to; 0: only through the VAE and back. Prompt, scale and adapter
        are as of `sample`.

        Picture and edit are display-encoded, in [0, 1], shape [1, 3, resolution, resolution].

        Raises:
            ModelError: The adapter is unknown, or the text encoder was freed.
        """
        self._check_adapters([adapter])
        wanted, null = self.embed([prompt]), self.embed([""])
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
            used = self.precision["unet"]
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

    def upcast(self) -> bool:
        """Let all networks compute in fp32 from now on; return False where they do already."""
        if self.unet_dtype is torch.float32:
            return False
        self.use_full_precision()
        return True

    def finite(self, compute: Callable[[], Tensor], what: str) -> Tensor:
        """Return what is computed; in fp32 and from now on so, where half precision overflows.

        Args:
            compute: Called again in fp32.
            what: What it computes, for a person.

        Raises:
            NonFiniteError: It is not finite in fp32 either.
        """
        computed = compute()
        if bool(computed.isfinite().all()):
            return computed
        if self.upcast():
            self._notice(f"the model computes in fp32: {what} were not finite before")
            computed = compute()
            if bool(computed.isfinite().all()):
                return computed
        raise NonFiniteError(f"{what} are not finite (found nan or inf), in fp32 too")

    def spare_memory(self) -> None:
        """Do without what only makes it faster: recordings hold memory of their own."""
        self.forget_graphs()
        self.graphs = None

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
        """Return what the network predicts, whatever that is; differentiable.

        With the adapters that are switched on, for personalisation.

        Args:
            latents_noisy: On the device, shape [B, C, h, w].
            timesteps: Shape [B], int64.
            embeddings: Shape [B, token, channel].
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
        """Return what the UNet predicts, whatever that is, float32; its only call.

        Args:
            latents: Noisy, shape [B, C, h, w].
            timesteps: Shape [B], int64.
            embeddings: Shape [B, token, channel].
            adapters: One name per sample, or None.
        """
        kind = self.unet_dtype

        def unet(latents: Tensor, timesteps: Tensor, embeddings: Tensor) -> Tensor:
            with with_adapters(self.unet, adapters), self._exact_convolutions():
                predicted: Tensor = self.unet(
                    latents.to(kind), timesteps, encoder_hidden_states=embeddings.to(kind)
                ).sample
            return predicted.float()

        arguments = [x.to(self.device) for x in (latents, timesteps, embeddings)]
        if self.graphs is None:
            return unet(*arguments)
        return self.graphs.run((kind, adapters), unet, *arguments)

    def _exact_convolutions(self) -> AbstractContextManager[None]:
        """Keep cuDNN from rounding a UNet in fp32 to TF32, which has no more bits than fp16."""
        return no_tf32() if self.unet_dtype is torch.float32 else contextlib.nullcontext()

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

    def _solver(self, order: int) -> DPMSolverMultistepScheduler:
        """Return DPM-Solver++ on the model's schedule; of first order it is DDIM."""
        from diffusers import DPMSolverMultistepScheduler

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


def name_of_dtype(dtype: torch.dtype) -> str:
    """Return what a user calls one of `DTYPES`."""
    return next(name for name, known in DTYPES.items() if known is dtype)


@contextmanager
def no_tf32() -> Iterator[None]:
    """Keep cuDNN from rounding fp32 to TF32 within this context."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
