"""How good the network of an embedded prior is, on fixed pictures, times and noises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from warpir.diffusion.draws import seed_of
from warpir.diffusion.models.embedded import CONDITIONS, EmbeddedNetwork
from warpir.diffusion.models.embedded_words import training_tokens
from warpir.diffusion.models.network_prior import no_tf32
from warpir.diffusion.train.objective import Batch, Objective, Pair, TrainSettings, schedule_on

SIGMA_EDGES = (0.0, 0.3, 0.6, 0.85, 1.0)
"""Ranges of the noise level for which validation is reported."""


class Validation:
    """How good a network is on fixed pictures, times and noises; everything in fp32.

    Called with a network it returns plain values:

    * ``loss``: by set, the training's loss with all conditions and words, over ``all`` times and by
      range of the noise level (`SIGMA_EDGES`).
    * ``difference``: by set, for wrongly lit pictures x and their consistent twins y, the cosine
      between the guidance's force and x - y, the way back: ``sds`` e(good) - noise,
      ``good-bad``, and ``csd`` e(good) - e(null), each over ``all`` times and by range; and
      ``ranked``, the share of pairs in which the error of "consistent" less that of "mismatched" is
      lower for y than for x at equal noise (chance: 0.5).

    Args:
        settings: Times and weights.
        device: Where.
        sets: Fixed batches by name.
        pairs: Fixed pairs by name.
    """

    def __init__(
        self,
        settings: TrainSettings,
        device: torch.device,
        sets: Mapping[str, Sequence[Batch]],
        pairs: Mapping[str, Sequence[Pair]],
    ) -> None:
        self.settings, self.device, self.sets, self.pairs = settings, device, sets, pairs
        self.schedule = schedule_on(device)

    @torch.no_grad()
    def __call__(self, network: EmbeddedNetwork) -> dict[str, Any]:
        """Return the figures of a network."""
        with no_tf32():
            loss = {name: self._losses(network, name, held) for name, held in self.sets.items()}
            difference = {
                name: self._differences(network, name, held) for name, held in self.pairs.items()
            }
        return {"loss": loss, "difference": difference}

    def _draws(self, name: str, place: int, count: int) -> tuple[Tensor, Tensor]:
        """Return fixed times, spread evenly, and noises of a batch."""
        random = torch.Generator().manual_seed(seed_of("validation", name, place))
        s = self.settings
        t = (torch.randperm(count, generator=random) + 0.5) / count
        t = s.time_min + (s.time_max - s.time_min) * t
        noise = torch.randn(count, 3, 64, 64, generator=random)
        return t.to(self.device), noise.to(self.device)

    def _losses(
        self, network: EmbeddedNetwork, name: str, batches: Sequence[Batch]
    ) -> dict[str, Any]:
        objective = Objective(network, self.settings)
        losses, sigmas = [], []
        for place, batch in enumerate(batches):
            count = len(batch.image)
            t, noise = self._draws(name, place, count)
            a, s = self.schedule.alpha_sigma(t)
            present = torch.ones(count, len(CONDITIONS), device=self.device)
            ids = training_tokens(batch.noun, batch.setting, batch.weather, batch.kind)
            timesteps = self.schedule.timestep(t)
            losses.append(
                objective(
                    batch.image, batch.background, batch.gbuffer, present, ids, timesteps, noise,
                    a, s,
                )
            )  # fmt: skip
            sigmas.append(s)
        return by_sigma(torch.cat(losses), torch.cat(sigmas))

    def _differences(
        self, network: EmbeddedNetwork, name: str, pairs: Sequence[Pair]
    ) -> dict[str, Any]:
        forces: dict[str, list[Tensor]] = {"sds": [], "good-bad": [], "csd": []}
        ranked, sigmas = [], []
        for place, (right, wrong) in enumerate(pairs):
            count = len(right.image)
            t, noise = self._draws(name, place, count)
            a, s = (x[:, None, None, None] for x in self.schedule.alpha_sigma(t))
            words = wrong.noun, wrong.setting, wrong.weather
            kind = torch.zeros_like(wrong.kind)
            good, bad = (training_tokens(*words, k) for k in (kind, kind - 1))
            present = torch.ones(count, len(CONDITIONS), device=self.device)

            def noise_in(
                image: Tensor,
                ids: Tensor,
                held: Batch = wrong,
                t: Tensor = t,
                noisy: tuple[Tensor, Tensor, Tensor] = (a, s, noise),
                present: Tensor = present,
            ) -> Tensor:
                a, s, noise = noisy
                z = a * (2.0 * image - 1.0) + s * noise
                v: Tensor = network(
                    z,
                    self.schedule.timestep(t),
                    network.embed(ids),
                    held.background,
                    held.gbuffer,
                    present,
                )
                return a * v + s * z

            e_good, e_bad = noise_in(wrong.image, good), noise_in(wrong.image, bad)
            e_null = noise_in(wrong.image, torch.zeros_like(good))
            back = (wrong.image - right.image).flatten(1)
            for force, delta in (
                ("sds", e_good - noise), ("good-bad", e_good - e_bad), ("csd", e_good - e_null),
            ):  # fmt: skip
                cosine = torch.nn.functional.cosine_similarity(delta.flatten(1), back, dim=1)
                forces[force].append(cosine)
            f_good, f_bad = noise_in(right.image, good), noise_in(right.image, bad)
            of_wrong = (e_good - noise).square() - (e_bad - noise).square()
            of_right = (f_good - noise).square() - (f_bad - noise).square()
            ranked.append((of_right.mean(dim=(1, 2, 3)) < of_wrong.mean(dim=(1, 2, 3))).float())
            sigmas.append(s.flatten())
        sigma = torch.cat(sigmas)
        figures: dict[str, Any] = {
            force: by_sigma(torch.cat(values), sigma) for force, values in forces.items()
        }
        return figures | {"ranked": by_sigma(torch.cat(ranked), sigma)}


def by_sigma(values: Tensor, sigma: Tensor) -> dict[str, float]:
    """Return the mean of values, over all and by range of noise level; empty ones are left out."""
    figures = {"all": values.mean()}
    for low, high in pairwise(SIGMA_EDGES):
        within = (sigma >= low) & (sigma < high)
        if bool(within.any()):
            figures[f"{low:g}-{high:g}"] = values[within].mean()
    return {name: round(float(value), 6) for name, value in figures.items()}
