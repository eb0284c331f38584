"""Rows of the lamps: radiance of object and receiver by each lamp at power 1, and its slopes.

Radiance is linear in the power of each lamp, channel by channel, so that one image a lamp gives
every power's radiance and its gradient, in both halves of the shadow ratio. Three more images a
lamp are its derivatives to the lamp's place (`warpir.kernels.lamps.places`): exact where the lamp
is, first order where it has moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from warpir.core.arrays import FloatArray, IntArray
from warpir.render.device_light import light_args
from warpir.render.integrator import Radiance
from warpir.render.near.places import place_slopes
from warpir.render.renderer import Renderer, index_of
from warpir.scene.light import Light
from warpir.scene.near.lamps import Lamp

LAMP_SAMPLES = 64
"""Samples per pixel of the rows, which are traced once."""


@dataclass(frozen=True)
class LampRows:
    """What each lamp gives at power 1; differentiable in the powers."""

    own: Tensor
    """Powers of the scene's lamps, relative [W], shape [lamp, 3]."""
    foreground: Tensor
    """Object radiance per power [1/(m^2 sr)], shape [lamp, 1, object_pixel, 3]; with slopes, rows 1
    to 3 are its derivatives to x, y and z [1/m], shape [lamp, 4, object_pixel, 3]."""
    lit: Tensor
    """White receiver with the object, of the same form."""
    unoccluded: Tensor
    """White receiver without it, of the same form."""

    def added(
        self, rest: Radiance, powers: Tensor | None = None, moved: Tensor | None = None
    ) -> Radiance:
        """Return radiance with the lamps' light; differentiable in both tensors.

        Args:
            rest: Radiance without lamps.
            powers: Relative [W], shape [lamp, 3]; None: those of the scene.
            moved: How far each lamp is from where it was traced, world frame [m], shape [lamp, 3];
                None: not at all. It needs rows with slopes.
        """
        device = self.own.device
        powers = (self.own if powers is None else powers).to(device)
        shares = torch.ones(len(powers), 1, device=device)
        if moved is not None:
            shares = torch.cat((shares, moved.to(device)), dim=1)

        def near(name: str) -> Tensor:
            T: Tensor = getattr(self, name)[:, : shares.shape[1]]
            return torch.einsum("kjpc,kj,kc->pc", T, shares, powers)

        return Radiance(**{n: L + near(n).to(L) for n, L in vars(rest).items()})


def with_lamps(renderer: Renderer, lamps: Sequence[Lamp]) -> Renderer:
    """Return a renderer of the same scene with other lamps; both count into one record."""
    other = copy(renderer)
    other.scene = renderer.scene.with_lamps(lamps)
    return other


def lamp_rows(
    renderer: Renderer,
    object_pixels: IntArray,
    receiver_pixels: IntArray,
    depth: int,
    seed: int,
    device: torch.device,
    has_slopes: bool = False,
) -> LampRows:
    """Trace the rows of the scene's lamps.

    Args:
        renderer: The scene with its lamps.
        object_pixels: Row-major pixel indices, shape [object_pixel].
        receiver_pixels: The same of the receiver, shape [receiver_pixel].
        depth: Surface interactions of the object's paths.
        seed: Base seed.
        device: Where the rows are kept.
        has_slopes: Whether to trace derivatives to the lamps' places too.

    Raises:
        ValueError: As `place_slopes`.
    """
    camera, lamps = renderer.scene.camera, renderer.scene.lamps
    index = index_of(object_pixels, camera.width * camera.height)
    seen = (index[receiver_pixels] >= 0).astype(np.int32)
    dark = light_args(Light(texels=np.zeros((8, 16, 3), np.float32)), renderer.device)

    def traced(one: Lamp, power: float) -> tuple[FloatArray, ...]:
        alone = with_lamps(renderer, [replace(one, power=np.full(3, power))])
        lit = alone.foreground(dark, object_pixels, LAMP_SAMPLES, 1, depth, seed)
        ground = alone.receiver(dark, receiver_pixels, seen, LAMP_SAMPLES, 1, seed)
        return lit.radiance, ground.lit, ground.unoccluded

    # What does not depend on lamps, such as emission: the same samples see it, and it drops out.
    rest = traced(lamps[0], 0.0)
    rows = []
    for lamp in lamps:
        images = [(a - b)[None] for a, b in zip(traced(lamp, 1.0), rest, strict=True)]
        if has_slopes:
            alone = with_lamps(renderer, [replace(lamp, power=np.ones(3))])
            pixels = object_pixels, receiver_pixels, seen
            slopes = place_slopes(alone, *pixels, LAMP_SAMPLES, depth, seed)
            images = [np.concatenate(both) for both in zip(images, slopes, strict=True)]
        rows.append(images)
    halves = (torch.from_numpy(np.stack(part)).to(device) for part in zip(*rows, strict=True))
    own = torch.from_numpy(np.stack([lamp.power for lamp in lamps]).astype(np.float32))
    return LampRows(own.to(device), *halves)
