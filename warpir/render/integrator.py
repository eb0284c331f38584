"""Interface of the integrators: maps and materials to three radiance arrays."""

from dataclasses import dataclass
from typing import Protocol

from torch import Tensor


@dataclass(frozen=True)
class MaterialTensors:
    """Material factors of the optimiser; absent ones keep the asset's value."""

    base_color: Tensor | None = None
    """Linear RGB factor [1], shape [material, 3]."""
    metallic: Tensor | None = None
    """Factor [1], shape [material]."""
    roughness: Tensor | None = None
    """Perceptual factor [1], shape [material]."""
    emission: Tensor | None = None
    """Radiance factor, relative [W/(m^2 sr)], shape [material, 3]."""


@dataclass(frozen=True)
class Radiance:
    """Radiance of object and receiver, differentiable as the integrator declares."""

    foreground: Tensor
    """Object radiance, premultiplied by coverage, shape [object_pixel, 3]."""
    lit: Tensor
    """White plane with the object, shape [receiver_pixel, 3]."""
    unoccluded: Tensor
    """White plane without it, shape [receiver_pixel, 3]."""


class Integrator(Protocol):
    """Light transport for one scene and view; each states in which inputs it is differentiable."""

    def radiance(
        self,
        light_fg: Tensor,
        light_shadow: Tensor,
        seed: int,
        *,
        lamp_powers: Tensor | None = None,
    ) -> Radiance:
        """Render the object under ``light_fg`` and the plane under ``light_shadow``.

        Both are lat-long radiance, relative [W/(m^2 sr)], shape [He, We, 3]. ``lamp_powers``,
        relative [W], shape [lamp, 3], take the place of the scene's own.
        """
        ...
