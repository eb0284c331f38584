"""Random tensors for a batch: one value, or one array of them, for each of its rows."""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Sampler:
    """Draws for the rows of a batch."""

    def __init__(self, count: int, generator: torch.Generator) -> None:
        self.count, self.generator, self.device = count, generator, generator.device

    def unit(self, *shape: int) -> Tensor:
        """Return even values in [0, 1), shape [count, *shape]."""
        return torch.rand(self.count, *shape, generator=self.generator, device=self.device)

    def normal(self, *shape: int) -> Tensor:
        """Return values of mean 0 and variance 1, shape [count, *shape]."""
        return torch.randn(self.count, *shape, generator=self.generator, device=self.device)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Return even values in [low, high), shape [count, *shape]."""
        return low + (high - low) * self.unit(*shape)

    def log_uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Return values whose logarithm is even, shape [count, *shape]."""
        return torch.exp(self.uniform(math.log(low), math.log(high), *shape))

    def chance(self, probability: float, *shape: int) -> Tensor:
        """Return True with a probability, shape [count, *shape]."""
        return self.unit(*shape) < probability

    def sign(self, *shape: int) -> Tensor:
        """Return -1 or 1, shape [count, *shape]."""
        return torch.where(self.chance(0.5, *shape), -1.0, 1.0)

    def index(self, size: int) -> Tensor:
        """Return indices below a size, int64, shape [count]."""
        return (self.unit() * size).long()

    def category(self, shares: list[float]) -> Tensor:
        """Return indices into shares, with these probabilities, int64, shape [count]."""
        weights = torch.tensor(shares, device=self.device)
        return torch.multinomial(weights, self.count, replacement=True, generator=self.generator)
