"""Guidance: what a diffusion prior thinks of a picture, as a gradient on that picture.

A loss is a row of coefficients of one formula; `coefficients` is the table (DiPIR, eq. 7 and 8):

    delta   = k_p e(prompt; adapter) + k_c e(prompt) + k_0 e(null) + k_n e(negative) + k_e noise
    d_image = mean over noises of (d latents / d image)^T  w(t) delta

with ``latents = encode(crop(image))`` and all ``e`` at ``z_t = a latents + s noise``. The residual
``w(t) delta`` is summed over the latents, not averaged: that fixes what the weights of the other
terms mean, and a mean underflows in a half-precision autoencoder.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce

import torch
from torch import Tensor

from warpir.diffusion.crop import draw_crop
from warpir.diffusion.dataset_update import DATASET_UPDATE, DatasetUpdate
from warpir.diffusion.draws import generator_of
from warpir.diffusion.gradient_gate import GatedGuidance
from warpir.diffusion.schedule import weight
from warpir.diffusion.settings import GuidanceSettings

PAIR_COUNT = 8
"""Crops, times and noises of a score."""
CHECK_COUNT = 4
"""Crops, times and noises of a check of the precision."""


@dataclass(frozen=True)
class Coefficients:
    """A loss: what each prediction counts."""

    k_p: float = 0.0
    """Of the prompt, with the adapter."""
    k_c: float = 0.0
    """Of the prompt, by the base model."""
    k_0: float = 0.0
    """Of the null prompt."""
    k_n: float = 0.0
    """Of the negative prompt."""
    k_e: float = 0.0
    """Of the noise itself."""
    null_adapter: bool = False
    """Null and negative terms have the adapter too."""


def coefficients(settings: GuidanceSettings, has_adapter: bool) -> Coefficients:
    """Return the row of a loss (DiPIR, eq. 7 and 8, figure S3; CSD: arXiv 2310.19415).

    The loss sds-good-bad does with an adapter and without.
    """
    g = settings.guidance_scale
    adapted, base = (3.0, 0.0) if has_adapter else (0.0, 3.0)
    return {
        "lds": Coefficients(k_p=1.0, k_0=-1.0),
        "sds": Coefficients(k_p=g, k_0=1.0 - g, k_e=-1.0, null_adapter=True),
        "sds-base": Coefficients(k_c=g, k_0=1.0 - g, k_e=-1.0),
        "csd": Coefficients(k_c=1.0, k_0=-1.0),
        "lds-lora-both": Coefficients(k_p=1.0, k_0=-1.0, null_adapter=True),
        "lds-negative": Coefficients(k_p=1.0, k_n=-1.0),
        "good-bad": Coefficients(k_c=1.0, k_n=-1.0),
        # SDS without a null term, and twice good - bad.
        "sds-good-bad": Coefficients(adapted, base, k_n=-2.0, k_e=-1.0),
    }[settings.loss]


@dataclass(frozen=True)
class Term:
    """One prediction of the residual."""

    scale: float
    prompt: str
    adapter: str | None


@dataclass(frozen=True)
class NoisyCrops:
    """Crops of a picture, as the prior sees them at some times."""

    latents: Tensor
    """Differentiable, float32, shape [noise, C, h, w]."""
    noise: Tensor
    """Same shape."""
    latents_noisy: Tensor
    """z_t, detached, same shape."""
    t: Tensor
    """Shape [noise]."""
    weight: Tensor
    """w(t), shape [noise, 1, 1, 1]."""


class Guidance(GatedGuidance):
    """Score distillation with one row of coefficients (DiPIR, eq. 7 and 8).

    Each noise has a crop and a time of its own, so several of them also average over places and
    sizes; they share one batch of the autoencoder, and with all terms one batch of the denoiser.
    What is drawn is a function of seed, step and noise alone: resumed runs continue with it, and
    all losses of an ablation share it.

    Arguments as of `GatedGuidance`; the adapter is None where the loss does without.

    Raises:
        ValueError: The loss needs an adapter, or the mask is empty.
    """

    def prepare(self) -> None:
        """Embed the prompts of the terms that count, those whose coefficient is not 0."""
        s, adapter = self.settings, self.adapter
        self.row = row = coefficients(s, adapter is not None)
        if adapter is None and (row.k_p or row.null_adapter):
            raise ValueError(f"loss: {s.loss} needs an adapter; csd and sds-base do without")
        other = adapter if row.null_adapter else None
        terms = (
            Term(row.k_p, self.prompt, adapter),
            Term(row.k_c, s.base_prompt or self.prompt, None),
            Term(row.k_0, s.null_prompt, other),
            Term(row.k_n, s.negative_prompt, other),
        )
        self.terms = [term for term in terms if term.scale]
        self.embeddings = self.prior.embed([term.prompt for term in self.terms])

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        """Return the gradient of ``< stopgrad(w(t) delta), latents >``, averaged over the noises.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].
            step: From 0.

        Returns:
            Same shape, dtype and device; None when it is not finite.
        """
        d_image = self._gradient(image, step)
        is_spoilt = not bool(d_image.isfinite().all()) and bool(image.isfinite().all())
        if is_spoilt and self.prior.upcast("gradients"):  # half precision was too narrow
            d_image = self._gradient(image, step)
        return self.gate.passed(d_image)

    def _gradient(self, image: Tensor, step: int) -> Tensor:
        """Return the gradient as it comes, of all noises at once or of halves."""
        s = self.settings
        low, high = self.times(step)

        def of(first: int, last: int) -> Tensor:
            generators = [generator_of(self.seed, step, k) for k in range(first, last)]
            t = torch.cat([low + (high - low) * torch.rand(1, generator=g) for g in generators])
            leaf = image.detach().requires_grad_()
            crops = self._noisy_crops(leaf, t, generators)
            residual = crops.weight * self._delta(crops, self._predictions(crops)) / s.noises
            # A half-precision autoencoder keeps its backward pass in range when the greatest
            # residual is about 1; a power of two is taken out and put back without rounding.
            scale = torch.exp2(torch.frexp(residual.abs().amax()).exponent.float())
            (d_image,) = torch.autograd.grad(crops.latents, leaf, residual / scale)
            return d_image * scale.to(d_image)

        flags = "--noises or --guidance-width"
        parts = self.prior.in_chunks(of, s.noises, "guidance", flags, self.prior.spare_memory)
        return reduce(torch.add, parts)

    def with_loss(self, loss: str) -> Guidance:
        """Return the same guidance with another loss.

        Raises:
            ValueError: The loss needs an adapter.
        """
        other = replace(self.settings, loss=loss)
        return Guidance(
            self.prior, self.prompt, other, self.mask, self.steps, self.seed, self.adapter
        )

    @torch.no_grad()
    def score(
        self, image: Tensor, seed: int | None = None, pairs: int = PAIR_COUNT
    ) -> float | None:
        """Return how wrong an image looks, lower is better; None when that is not finite.

        Which of the prompts explains the picture better: the mean of
        ``w(t) (|e_first - noise|^2 - |e_second - noise|^2)`` for a difference of two predictions
        (Diffusion Classifier, arXiv 2303.16203), of ``w(t) |delta|^2`` for the losses with noise.
        Times lie in the middle of equal parts of the whole run's range.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].
            seed: Of noises and crops; the guidance's own by default.
            pairs: Noises.
        """
        score = self._score(image, seed, pairs)
        is_spoilt = not math.isfinite(score) and bool(image.isfinite().all())
        if is_spoilt and self.prior.upcast("scores"):
            score = self._score(image, seed, pairs)
        return score if math.isfinite(score) else None

    def _score(self, image: Tensor, seed: int | None, pairs: int) -> float:
        scores = []
        for crops in self._fixed_crops(image, "score", seed, pairs):
            predictions = self._predictions(crops).double()
            if self.row.k_e:
                errors = self._delta(crops, predictions).square()
            else:
                errors = self._weighted_sum((predictions - crops.noise).square())
            scores.append((crops.weight * errors).sum(dim=(1, 2, 3)))
        return float(torch.cat(scores).mean())

    @torch.no_grad()
    def work(self, start: Tensor, middle: Tensor, end: Tensor, draws: Sequence[int]) -> list[float]:
        """Return how far a short way between two pictures leads uphill, by draw.

        ``< w(t) delta, latents(end) - latents(start) >`` with the residual halfway: added up along
        a path, and averaged over draws, this is what the potential rises by whose gradient the
        guidance is. A draw is a time of the run's own distribution, a noise and a crop.

        Args:
            start: Display-encoded, in [0, 1], shape [1, 3, H, W].
            middle: Halfway, same shape.
            end: Same shape.
            draws: Seeds; none of them is a step's.
        """
        count = self.settings.noises
        found: list[float] = []
        for k in range(0, len(draws), count):
            crops = []
            for image in (middle, start, end):  # each meets the same times, crops and noises
                batch = [generator_of(self.seed, "work", draw) for draw in draws[k : k + count]]
                t = torch.cat([self._time_of_a_run(g) for g in batch])
                crops.append(self._noisy_crops(image, t, batch))
            residual = crops[0].weight * self._delta(crops[0], self._predictions(crops[0]))
            way = (crops[2].latents - crops[1].latents).double()
            found += (residual.double() * way).sum(dim=(1, 2, 3)).tolist()
        return found

    def _time_of_a_run(self, generator: torch.Generator) -> Tensor:
        """Return a time as some step of the run draws it, shape [1]."""
        u_step, u_time = torch.rand(2, generator=generator).tolist()
        step = min(int(u_step * self.steps), max(self.steps - 1, 0))
        low, high = self.times(step)
        return torch.tensor([low + (high - low) * u_time])

    @torch.no_grad()
    def ensure_precision(self, image: Tensor) -> float:
        """Let the prior compute in full precision if this loss needs it.

        Two predictions that nearly cancel keep little of a half-precision network's bits.

        Args:
            image: Display-encoded, in [0, 1], shape [1, 3, H, W].

        Returns:
            Cosine between delta as computed before and in full precision.
        """
        batches = self._fixed_crops(image, "precision", self.seed, CHECK_COUNT)
        return self.prior.ensure_precision(
            lambda: torch.cat([self._delta(crops, self._predictions(crops)) for crops in batches])
        )

    def _fixed_crops(
        self, image: Tensor, purpose: str, seed: int | None, count: int
    ) -> Sequence[NoisyCrops]:
        """Return crops at fixed times, in batches of the size of a step's."""
        s = self.settings
        low, high = self.times(0)
        times = low + (high - low) * (torch.arange(count) + 0.5) / count
        seed = self.seed if seed is None else seed
        generators = [generator_of(seed, purpose, k) for k in range(count)]
        return [
            self._noisy_crops(image, times[k : k + s.noises], generators[k : k + s.noises])
            for k in range(0, count, s.noises)
        ]

    def _noisy_crops(
        self, image: Tensor, t: Tensor, generators: Sequence[torch.Generator]
    ) -> NoisyCrops:
        """Return one crop for each time and generator, encoded and noised."""
        prior, settings, device = self.prior, self.settings, self.prior.device
        height, width = image.shape[-2:]
        crops = [draw_crop(self.box, (height, width), settings, g) for g in generators]
        w = weight(settings.weight, *prior.schedule.alpha_sigma(t), settings.literal_alpha)
        w, t = _upload(w.view(-1, 1, 1, 1), device), _upload(t, device)
        cropped = torch.cat([crop.apply(image, prior.resolution) for crop in crops])
        latents = prior.encode(cropped.to(device))
        shape = latents.shape[1:]
        drawn = torch.stack([torch.randn(shape, generator=g) for g in generators])
        noise = _upload(drawn, device)
        noisy = prior.schedule.add_noise(latents.detach(), noise, t)
        return NoisyCrops(latents, noise, noisy, t, w)

    @torch.no_grad()
    def _predictions(self, crops: NoisyCrops) -> Tensor:
        """Return each term's noise, by one call of the prior, shape [term, noise, C, h, w]."""
        term_count, noise_count = len(self.terms), len(crops.t)

        def repeated(per_noise: Tensor) -> Tensor:
            return per_noise.repeat(term_count, *[1] * (per_noise.ndim - 1))

        predicted = self.prior.predict(
            repeated(crops.latents_noisy),
            repeated(crops.t),
            self.embeddings.repeat_interleave(noise_count, dim=0),
            [term.adapter for term in self.terms for _ in range(noise_count)],
        )
        return predicted.view(term_count, *crops.noise.shape)

    def _delta(self, crops: NoisyCrops, predictions: Tensor) -> Tensor:
        """Return the sum of predictions and noise, each by its coefficient."""
        delta = self._weighted_sum(predictions)
        return delta + self.row.k_e * crops.noise if self.row.k_e else delta

    def _weighted_sum(self, per_term: Tensor) -> Tensor:
        """Return the sum over the terms, each by its coefficient.

        Not a matrix product: two terms nearly cancel, and TensorFloat32 would round them before.
        """
        return torch.stack(
            [term.scale * x for term, x in zip(self.terms, per_term, strict=True)]
        ).sum(dim=0)


def _upload(values: Tensor, device: torch.device) -> Tensor:
    """Return a copy on the device, without waiting for what the device still has to do."""
    if device.type != "cuda":
        return values.to(device)
    return values.pin_memory().to(device, non_blocking=True)


def kind_of(settings: GuidanceSettings) -> type[Guidance] | type[DatasetUpdate]:
    """Return the guidance that the settings' loss asks for."""
    return DatasetUpdate if settings.loss == DATASET_UPDATE else Guidance
