"""Scenes as tables of the kernel that renders them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from warpir.kernels.training.render import render_scenes
from warpir.kernels.training.scene import (
    GroundTable,
    LightTable,
    MapTable,
    OccluderTable,
    ViewTable,
)
from warpir.train.scenes.layout import Views
from warpir.train.scenes.lighting import Lighting

SIDE = 2
"""Its square is the number of points per pixel."""


@dataclass
class Scenes:
    """What a batch of scenes is made of; all tensors, one row per scene."""

    tables: dict[str, Any]
    """Arguments of the kernel."""
    lighting: Lighting
    views: Views
    is_panorama: Tensor
    """Bool: the photo is a panorama crop."""


@dataclass(frozen=True)
class Rendered:
    """Photos of a batch."""

    radiance: Tensor
    """Linear, shape [B, 3, H, W]."""
    solid: Tensor
    """Share of each pixel that shows solids, shape [B, H, W]."""


def render(scenes: Scenes, size: tuple[int, int]) -> Rendered:
    """Render each scene's photo; the size is height and width [px]."""
    (height, width), count = size, len(scenes.is_panorama)
    tables, x = scenes.tables, scenes.lighting
    pixels, device = count * height * width, scenes.is_panorama.device
    radiance, solid = torch.empty(pixels, 3, device=device), torch.empty(pixels, device=device)
    light = (
        tables["light"]
        | {"map": x.map, "yaw": x.yaw, "mirror": x.mirror, "gain": x.gain}
        | {"sun_axis": x.axis, "sun": x.sun, "sun_sigma": x.sigma}
    )
    wp.launch(
        render_scenes,
        dim=pixels,
        inputs=[
            width, height, SIDE,
            filled(ViewTable, tables["views"]),
            filled(LightTable, light),
            filled(MapTable, tables["maps"]),
            filled(OccluderTable, tables["solids"]),
            filled(GroundTable, tables["ground"]),
        ],
        outputs=[wp.from_torch(radiance, dtype=wp.vec3), wp.from_torch(solid)],
        device=wp.device_from_torch(device),
    )  # fmt: skip
    shown = radiance.view(count, height, width, 3).permute(0, 3, 1, 2)
    return Rendered(shown, solid.view(count, height, width))


def filled(kind: Any, tensors: dict[str, Tensor]) -> Any:
    """Return one of the kernel's tables, filled with views of tensors, which must outlive it."""
    table = kind()
    for name, variable in kind.vars.items():
        setattr(table, name, wp.from_torch(tensors[name].contiguous(), dtype=variable.type.dtype))
    return table
