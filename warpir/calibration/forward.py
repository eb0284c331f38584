"""The forward pass of the networks that see a photo, in NumPy.

Training needs torch, whose import alone takes longer than the answer of such a small network. So
what asks one photo computes here what `warpir.train.networks.blocks.TokenNetwork` defines, from
the same weights. In float64, so that kinds of processors, which round sums differently, agree.

A photo's features have the shape [H, W, C], tokens [T, C].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.special import erf, expit

from warpir.calibration.weights import Shapes, Weights
from warpir.core.arrays import Float64Array

GROUPS = 8
"""Of channels, in a group norm."""
GATHERINGS = 4
"""Weighted means of the tokens that each head reads, of an equal part of the features each."""
EPSILON = 1e-5
"""Added to the variance in a norm."""


def softmax(x: Float64Array) -> Float64Array:
    """Return the softmax over the last axis."""
    raised = np.exp(x - x.max(axis=-1, keepdims=True))
    return raised / raised.sum(axis=-1, keepdims=True)  # type: ignore[no-any-return]


class Forward:
    """The layers of one network.

    Args:
        weights: Of it, and perhaps of others.
        prefix: What the names of its parameters begin with.
    """

    def __init__(self, weights: Weights, prefix: str = "") -> None:
        start = len(prefix)
        self.weights = {
            name[start:]: part.astype(np.float64)
            for name, part in weights.values.items()
            if name.startswith(prefix)
        }
        self.sizes = weights.sizes

    def linear(self, name: str, x: Float64Array) -> Float64Array:
        """Return what a linear layer makes of the last axis."""
        found: Float64Array = x @ self.weights[f"{name}.weight"].T
        bias = self.weights.get(f"{name}.bias")
        return found if bias is None else found + bias

    def conv(self, name: str, x: Float64Array, stride: int = 1) -> Float64Array:
        """Return a convolution of 3 x 3 with a border of zeros."""
        weight = self.weights[f"{name}.weight"]
        padded = np.pad(x, ((1, 1), (1, 1), (0, 0)))
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1))
        windows = windows[::stride, ::stride].transpose(0, 1, 3, 4, 2)
        rows = windows.reshape(-1, weight[0].size)
        found = rows @ weight.transpose(0, 2, 3, 1).reshape(len(weight), -1).T
        found += self.weights[f"{name}.bias"]
        return found.reshape(*windows.shape[:2], -1)

    def group_norm(self, name: str, x: Float64Array) -> Float64Array:
        """Return features with mean 0 and variance 1 in each group of channels, then scaled."""
        grouped = x.reshape(-1, GROUPS, x.shape[2] // GROUPS)
        return self._scaled(name, _normed(grouped, (0, 2)).reshape(x.shape))

    def layer_norm(self, name: str, x: Float64Array) -> Float64Array:
        """Return tokens with mean 0 and variance 1 each, then scaled."""
        return self._scaled(name, _normed(x, (-1,)))

    def _scaled(self, name: str, x: Float64Array) -> Float64Array:
        return x * self.weights[f"{name}.weight"] + self.weights[f"{name}.bias"]

    def conv_block(self, name: str, x: Float64Array) -> Float64Array:
        """Return features after a `ConvBlock`."""
        branch = x
        for norm, conv in (("branch.0", "branch.2"), ("branch.3", "branch.5")):
            branch = self.group_norm(f"{name}.{norm}", branch)
            branch = self.conv(f"{name}.{conv}", branch * expit(branch))
        return x + branch

    def token_block(self, name: str, x: Float64Array) -> Float64Array:
        """Return tokens after a `TokenBlock`."""
        qkv = self.linear(f"{name}.qkv", self.layer_norm(f"{name}.norm", x))
        q, k, v = qkv.reshape(len(x), 3, self.sizes["heads"], -1).transpose(1, 2, 0, 3)
        attention = softmax(q @ k.transpose(0, 2, 1) / math.sqrt(q.shape[2]))
        mixed = (attention @ v).transpose(1, 0, 2).reshape(x.shape)
        x = x + self.linear(f"{name}.out", mixed)
        raised = self.linear(f"{name}.mlp.1", self.layer_norm(f"{name}.mlp.0", x))
        return x + self.linear(f"{name}.mlp.4", _gelu(raised))

    def features(self, x: Float64Array) -> Float64Array:
        """Return features of 1/8 of the resolution from the planes of a photo."""
        high, wide, planes = x.shape
        # Space to depth, a channel's four pixels beside each other.
        x = x.reshape(high // 2, 2, wide // 2, 2, planes).transpose(0, 2, 4, 1, 3)
        x = self.conv("stem", x.reshape(high // 2, wide // 2, 4 * planes))
        fine, middle = self.sizes["blocks"]
        for part, count, down in (("fine", fine, "down1"), ("middle", middle, "down2")):
            for k in range(count):
                x = self.conv_block(f"{part}.{k}", x)
            x = self.conv(down, x, stride=2)
        return self.group_norm("norm", x)

    def tokens(self, features: Float64Array, places: Float64Array) -> Float64Array:
        """Return tokens after all blocks, those that ask in front.

        Args:
            features: Shape [H, W, C].
            places: What says where each looks, shape [H W, places].
        """
        looking = self.linear("place.2", _gelu(self.linear("place.0", places)))
        x = features.reshape(-1, features.shape[2]) + looking
        x = np.concatenate([self.weights["asking"], x])
        for k in range(self.sizes["depth"]):
            x = self.token_block(f"blocks.{k}", x)
        return x

    def read(self, tokens: Float64Array) -> Float64Array:
        """Return what each head reads, shape [head, C]."""
        count = len(self.weights["asking"])
        asked, others = tokens[:count], tokens[count:]
        weights = softmax(self.linear("gather", others).T).reshape(count, GATHERINGS, -1)
        groups = others.reshape(len(others), GATHERINGS, -1)
        means: Float64Array = np.einsum("agt,tgc->agc", weights, groups)
        return asked + means.reshape(asked.shape)

    def head(self, name: str, x: Float64Array) -> Float64Array:
        """Return the answer of a head."""
        return self.linear(f"{name}.2", self.layer_norm(f"{name}.0", x))


def token_shapes(sizes: Mapping[str, Any], planes: int, places: int, asking: int) -> Shapes:
    """Return the shapes of a `TokenNetwork`; arguments as its own, sizes as in a file's header."""
    fine, middle, wide = sizes["channels"]
    shapes: dict[str, tuple[int, ...]] = {"asking": (asking, wide)}
    shapes["gather.weight"] = (asking * GATHERINGS, wide)

    def add(name: str, *weight: int) -> None:
        shapes[f"{name}.weight"], shapes[f"{name}.bias"] = weight, weight[:1]

    def convolutions(name: str, channels: int, count: int) -> None:
        for block in (f"{name}.{k}.branch" for k in range(count)):
            for norm, conv in ((0, 2), (3, 5)):
                add(f"{block}.{norm}", channels)
                add(f"{block}.{conv}", channels, channels, 3, 3)

    add("stem", fine, 4 * planes, 3, 3)
    convolutions("fine", fine, sizes["blocks"][0])
    add("down1", middle, fine, 3, 3)
    convolutions("middle", middle, sizes["blocks"][1])
    add("down2", wide, middle, 3, 3)
    add("norm", wide)
    add("place.0", wide, places)
    add("place.2", wide, wide)
    for block in (f"blocks.{k}" for k in range(sizes["depth"])):
        for norm in ("norm", "mlp.0"):
            add(f"{block}.{norm}", wide)
        add(f"{block}.qkv", 3 * wide, wide)
        add(f"{block}.out", wide, wide)
        add(f"{block}.mlp.1", 4 * wide, wide)
        add(f"{block}.mlp.4", wide, 4 * wide)
    return shapes


def head_shapes(name: str, channels: int, count: int) -> Shapes:
    """Return the shapes of a head with ``count`` answers."""
    norm, last = (channels,), (count, channels)
    parts = {"0.weight": norm, "0.bias": norm, "2.weight": last, "2.bias": last[:1]}
    return {f"{name}.{part}": shape for part, shape in parts.items()}


def _normed(x: Float64Array, axes: tuple[int, ...]) -> Float64Array:
    """Return values with mean 0 and variance 1 over some axes."""
    centred = x - x.mean(axis=axes, keepdims=True)
    variance = np.square(centred).mean(axis=axes, keepdims=True)
    return centred / np.sqrt(variance + EPSILON)  # type: ignore[no-any-return]


def _gelu(x: Float64Array) -> Float64Array:
    """Return x times the Gaussian distribution's function of x."""
    return 0.5 * x * (1.0 + erf(x * math.sqrt(0.5)))  # type: ignore[no-any-return]
