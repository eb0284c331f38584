"""Textures of a scene on one device: the texels of all in one array."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warpir.core.color import srgb_to_linear
from warpir.kernels.types import TextureArgs
from warpir.scene.asset import Texture

WRAP_MODES = {"repeat": 0, "clamp": 1, "mirror": 2}


def texture_args(textures: Sequence[Texture], device: wp.Device) -> TextureArgs:
    """Upload textures; without any, a white texel is there that no material has."""
    rows = textures or [Texture(np.full((1, 1, 4), 255, np.uint8))]
    packed = [np.ascontiguousarray(t.pixels).view("<u4").reshape(-1) for t in rows]
    args = TextureArgs()
    args.texels = wp.array(np.concatenate(packed), dtype=wp.uint32, device=device)
    for name, numbers in (
        ("offset", np.cumsum([0] + [len(p) for p in packed[:-1]])),
        ("width", [t.pixels.shape[1] for t in rows]),
        ("height", [t.pixels.shape[0] for t in rows]),
        ("wrap_u", [WRAP_MODES[t.wrap_u] for t in rows]),
        ("wrap_v", [WRAP_MODES[t.wrap_v] for t in rows]),
    ):
        values = np.asarray(numbers, np.int32)
        setattr(args, name, wp.array(values, dtype=wp.int32, device=device))
    decode = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)
    args.decode = wp.array(decode, dtype=wp.float32, device=device)
    return args
