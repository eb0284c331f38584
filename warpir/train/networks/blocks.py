"""Parts that small networks of a photo are built of: residual blocks, attention and heads."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpir.calibration.forward import GATHERINGS, GROUPS


@dataclass(frozen=True)
class TokenSizes:
    """Sizes of a `TokenNetwork`."""

    channels: tuple[int, int, int] = (48, 96, 192)
    """Features at 1/2, 1/4 and 1/8 of the resolution."""
    blocks: tuple[int, int] = (2, 2)
    """Residual blocks at 1/2 and 1/4."""
    depth: int = 4
    """Transformer blocks over the tokens."""
    heads: int = 6
    dropout: float = 0.1
    skipped: float = 0.1
    """Chance that a block is left out in training (stochastic depth)."""


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
            nn.GroupNorm(GROUPS, channels),
            nn.SiLU(),
            nn.Conv2d(channels, channels, 3, padding=1),
            nn.GroupNorm(GROUPS, channels),
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


class TokenNetwork(nn.Module):
    """A photo to tokens of 8 x 8 pixels, and learned tokens, one for each head, that ask them.

    A head reads its learned token plus weighted means of the others. The means matter: without them
    training stays long at the one answer that fits all photos.

    A pixel has ``planes`` numbers. ``places`` numbers say where a token looks; they take the place
    of a position. ``asking`` counts the heads.
    """

    def __init__(self, config: TokenSizes, planes: int, places: int, asking: int) -> None:
        super().__init__()
        fine, middle, wide = config.channels
        # Space to depth keeps every pixel: the edges of shadows are what tells the light.
        self.stem = nn.Conv2d(4 * planes, fine, 3, padding=1)
        self.fine = nn.Sequential(*(ConvBlock(fine, 0.0) for _ in range(config.blocks[0])))
        self.down1 = nn.Conv2d(fine, middle, 3, stride=2, padding=1)
        self.middle = nn.Sequential(
            *(ConvBlock(middle, config.skipped / 2.0) for _ in range(config.blocks[1]))
        )
        self.down2 = nn.Conv2d(middle, wide, 3, stride=2, padding=1)
        self.norm = nn.GroupNorm(GROUPS, wide)
        self.place = nn.Sequential(nn.Linear(places, wide), nn.GELU(), nn.Linear(wide, wide))
        self.asking = nn.Parameter(torch.randn(asking, wide) * 0.02)
        self.blocks = nn.ModuleList(
            TokenBlock(wide, config.heads, config.dropout, config.skipped)
            for _ in range(config.depth)
        )
        self.gather = nn.Linear(wide, asking * GATHERINGS, bias=False)
        # Clearly different weights from the start: an even mean tells nothing of where.
        nn.init.normal_(self.gather.weight, std=3.0 / math.sqrt(wide))

    def features(self, x: Tensor) -> Tensor:
        """Return features of shape [B, C, H / 8, W / 8] from planes of shape [B, planes, H, W]."""
        x = self.fine(self.stem(F.pixel_unshuffle(x, 2)))
        x = self.middle(self.down1(x))
        return self.norm(self.down2(x))  # type: ignore[no-any-return]

    def mixed(self, tokens: Tensor) -> Tensor:
        """Put the learned tokens in front and let all see each other, shape [B, T, C]."""
        tokens = torch.cat([self.asking.expand(len(tokens), -1, -1), tokens], dim=1)
        for block in self.blocks:
            tokens = block(tokens)
        return tokens

    def read(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Return what each head reads, shape [B, head, C], and the tokens that are none's."""
        count = len(self.asking)
        tokens = tokens.to(self.gather.weight.dtype)
        asked, others = tokens[:, :count], tokens[:, count:]
        weights = self.gather(others).softmax(dim=1).unflatten(2, (count, GATHERINGS))
        groups = others.unflatten(2, (GATHERINGS, -1))
        return asked + torch.einsum("btag,btgc->bagc", weights, groups).flatten(2), others
