"""Lat-long maps as tensors: what `warpir.core.latlong` says of arrays, with gradients where it can.

Maps have the shape [..., He, We, 3]: linear Rec.709 radiance, relative [W/(m^2 sr)].
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from warpir.core import latlong
from warpir.core.color import LUMINANCE_WEIGHTS


def luminance(rgb: Tensor) -> Tensor:
    """Return the luminance of linear Rec.709 values, shape [..., 3] to [...]."""
    red, green, blue = LUMINANCE_WEIGHTS
    return red * rgb[..., 0] + green * rgb[..., 1] + blue * rgb[..., 2]


def solid_angles(texels: Tensor) -> Tensor:
    """Return the solid angle of each row's texels [sr], shape [He, 1]."""
    return _solid_angles(texels.shape[-3], texels.shape[-2], texels.device, texels.dtype)


@lru_cache(maxsize=8)
def _solid_angles(rows: int, columns: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(latlong.texel_solid_angles(rows, columns)).to(device, dtype)[:, None]


@lru_cache(maxsize=8)
def map_directions(
    height: int, width: int, device: torch.device, dtype: torch.dtype = torch.float32
) -> Tensor:
    """Return the unit direction of each texel centre, shape [height, width, 3]; do not write it."""
    return torch.from_numpy(latlong.map_directions(height, width)).to(device, dtype)


def uv_of(directions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the map coordinates of unit directions, ``u`` right and ``v`` down, in [0, 1].

    Args:
        directions: In the frame of the map, shape [..., 3].

    Returns:
        ``u`` and ``v``, shape [...] each.
    """
    u = 0.5 - torch.atan2(directions[..., 0], directions[..., 2]) / (2.0 * torch.pi)
    return u, torch.arccos(directions[..., 1].clamp(-1.0, 1.0)) / torch.pi


def directions_of(u: Tensor, v: Tensor) -> Tensor:
    """Return the unit directions of map coordinates in [0, 1], shape [..., 3]; see `uv_of`."""
    lon, theta = torch.pi * (1.0 - 2.0 * u), torch.pi * v
    s = theta.sin()
    return torch.stack([lon.sin() * s, theta.cos(), lon.cos() * s], dim=-1)


def shrunk(maps: Tensor, height: int) -> Tensor:
    """Return maps of fewer rows; each texel is the mean over its solid angle.

    Args:
        maps: Shape [B, He, We, 3].
        height: A divisor of He.

    Returns:
        Shape [B, height, We height / He, 3].
    """
    count, rows, columns, _ = maps.shape
    factor = rows // height
    weighted = maps * solid_angles(maps)[..., None]
    summed = weighted.view(count, height, factor, columns // factor, factor, 3).sum(dim=(2, 4))
    return summed / solid_angles(summed)[..., None]
