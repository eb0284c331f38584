"""Parts that small networks of a photo are built of: residual blocks, attention and heads."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class Skippable(nn.Module):
    """A residual branch that is left out for some samples in training (1603.09382)."""

    def __init__(self, skipped: float) -> None:
        super().__init__()
        self.skipped = skipped

    def add(self, x: Tensor, branch: Tensor) -> Tensor:
        """Return x plus the branch, which is left out of some rows in training."""
        if self.training and self.skipped > 0.0:
            kept = torch.rand(len(x), *(1,) * (x.dim() - 1), device=x.device) >= self.skipped
            branch = branch * kept / (1.0 - self.skipped)
        return x + branch


class ConvBlock(Skippable):
    """Two convolutions of 3 x 3 beside the identity, shape [B, C, H, W] to the same."""

    def __init__(self, channels: int, skipped: float) -> None:
        super().__init__(skipped)
        self.branch = nn.Sequential(
            nn.GroupNorm(8, channels),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.GroupNorm(8, channels),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return the features with the branch added."""
        return self.add(x, self.branch(x))


class TokenBlock(Skippable):
    """Attention between tokens and a perceptron of each, shape [B, T, C] to the same."""

    def __init__(self, channels: int, heads: int, dropout: float, skipped: float) -> None:
        super().__init__(skipped)
        self.heads = heads
        self.norm = nn.LayerNorm(channels)
        self.qkv = nn.Linear(channels, 3 * channels)
        self.out = nn.Linear(channels, channels)
        self.mlp = nn.Sequential(
            nn.LayerNorm(channels),
            nn.Linear(channels, 4 * channels),
            nn.GELU(),
            nn.Dropout(dropout),
            nn.Linear(4 * channels, channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return the tokens with both branches added."""
        batch, count, _ = x.shape
        qkv = self.qkv(self.norm(x)).view(batch, count, 3, self.heads, -1)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(x.shape)
        x = self.add(x, self.out(mixed))
        return self.add(x, self.mlp(x))


def head(channels: int, dropout: float, count: int) -> nn.Sequential:
    """Return a head whose first answers are nearly the same for all photos."""
    last = nn.Linear(channels, count)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.LayerNorm(channels), nn.Dropout(dropout), last)
