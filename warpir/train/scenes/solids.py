"""What stands in the scenes beside the object: boxes, balls and pillars, houses, walls, trees."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from warpir.train.sampler import Sampler

SMALL = 6
SOLIDS = 8 + SMALL
"""Of a scene: two walls or houses, six small ones, two trees of two, and two far away."""
STREET, TABLE = 0, 2


class Solids(NamedTuple):
    """Some solids of each scene; lengths in metres."""

    kind: Tensor
    """0 box, 1 ball, 2 pillar, -1 none, shape [B, S]."""
    centre: Tensor
    """World frame, shape [B, S, 3]."""
    half: Tensor
    """Half of the size, shape [B, S, 3]."""


def packed_solids(solids: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return a table of solids with those that are there in front, and their count."""
    order = torch.argsort((solids["kind"] < 0).int(), dim=1, stable=True)

    def moved(part: Tensor) -> Tensor:
        places = order.view(*order.shape, *[1] * (part.ndim - 2))
        return part.gather(1, places.expand(-1, -1, *part.shape[2:])).contiguous()

    count = (solids["kind"] >= 0).sum(dim=1).int()
    return {name: moved(part) for name, part in solids.items()} | {"count": count}


def draw_solids(
    draw: Sampler,
    place_kind: Tensor,
    is_panorama: Tensor,
    place: Tensor,
    scale: Tensor,
    camera_height: Tensor,
    texture_count: int,
    proxies: float,
    no_cue: float,
) -> dict[str, Tensor]:
    """Draw what stands in the scenes, shape [B, SOLIDS] each.

    Args:
        draw: For the scenes of the batch.
        place_kind: 0 street, 1 yard, 2 table, 3 room, shape [B].
        is_panorama: Scenes whose photo is a panorama crop, bool, shape [B].
        place: Where the object stands, shape [B, 3] [m].
        scale: Of the object [m], shape [B].
        camera_height: Above the ground [m], shape [B].
        texture_count: Panoramas whose texels may cover a solid.
        proxies: Share of panorama crops with solids in them.
        no_cue: Share of scenes without any solid.
    """
    small = _draw_small(draw, place_kind, place, scale, camera_height)
    large, large_yaw = _draw_large(draw, place_kind, place, scale, camera_height)
    distant = _draw_distant(draw, place_kind, place, camera_height[:, None])
    kind, centre, half = (torch.cat(parts, 1) for parts in zip(large, small, distant, strict=True))
    # Few or none in panorama crops, and never a wall.
    few = draw.chance(0.35, SOLIDS)
    few[:, :2] = False
    few[:, -6:] = False
    few &= draw.chance(proxies)[:, None]
    kind = torch.where(is_panorama[:, None] & ~few, -1, kind)
    kind = torch.where(draw.chance(no_cue)[:, None], -1, kind)
    tint = 1.0 - 0.6 * draw.unit(SOLIDS, 3) * draw.unit(SOLIDS, 1)
    is_textured = draw.chance(0.4, SOLIDS) & (texture_count > 0)
    yaw = torch.cat([large_yaw, 2.0 * np.pi * draw.unit(SOLIDS - 2)], dim=1)
    albedo = (0.08 + 0.7 * draw.unit(SOLIDS, 1)) * tint
    texture = (draw.unit(SOLIDS) * max(texture_count, 1)).long()
    return packed_solids(
        {
            "kind": kind.int(),
            "centre": centre,
            "half": half.clamp(min=1e-4),
            "turn": torch.stack([yaw.cos(), yaw.sin()], dim=-1),
            "albedo": albedo,
            "texture": torch.where(is_textured, texture, -1).int(),
        }
    )


def _draw_small(
    draw: Sampler, place_kind: Tensor, place: Tensor, scale: Tensor, camera_height: Tensor
) -> Solids:
    """Draw boxes, balls and pillars round the object."""
    device = draw.device
    kind = torch.where(draw.chance(0.4, SMALL), 0, torch.where(draw.chance(0.5, SMALL), 1, 2))
    half = scale[:, None, None] * torch.exp(np.log(0.13) + draw.unit(SMALL, 3) * np.log(9.0))
    half = torch.minimum(half, camera_height[:, None, None] * 1.5)
    thin = draw.chance(0.25, SMALL)
    thin_half = torch.stack(
        [half[..., 0] * 0.25, half[..., 1].clamp(min=0.0) * 2.0, half[..., 0] * 0.25], dim=-1
    )
    half = torch.where(thin[..., None], thin_half, half)
    angle = 2.0 * np.pi * draw.unit(SMALL)
    away = scale[:, None] * torch.exp(np.log(0.9) + draw.unit(SMALL) * np.log(5.0)) + half[..., 0]
    offset = torch.stack([angle.sin(), torch.zeros_like(angle), angle.cos()], dim=-1)
    centre = place[:, None] + offset * away[..., None]
    # Nothing stands on the camera, or between it and the object.
    to_camera = torch.nn.functional.normalize(
        -place * torch.tensor([1.0, 0, 1.0], device=device), dim=1
    )
    before = (offset * to_camera[:, None]).sum(-1) > 0.75
    centre = torch.where(before[..., None], place[:, None] - offset * away[..., None], centre)
    too_near = (
        centre[..., [0, 2]].norm(dim=-1) < 2.0 * half.max(dim=-1).values + 0.5 * scale[:, None]
    )
    centre[..., 1] = half[..., 1]
    chance = torch.tensor([0.5, 0.6, 0.7, 0.6], device=device)[place_kind]
    kind = torch.where((draw.unit(SMALL) < chance[:, None]) & ~too_near, kind, -1)
    return Solids(kind, centre, half)


def _draw_large(
    draw: Sampler, place_kind: Tensor, place: Tensor, scale: Tensor, camera_height: Tensor
) -> tuple[Solids, Tensor]:
    """Draw two houses along a street, elsewhere a wall behind and one beside; also their yaws."""
    side = draw.sign(2)
    side[:, 1] = -side[:, 0]
    house = _draw_houses(draw, side, place, camera_height[:, None])
    wall, wall_yaw = _draw_walls(draw, side, place, scale, camera_height)
    is_street, is_table = (place_kind == STREET)[:, None], (place_kind == TABLE)[:, None]
    kind = torch.where(draw.unit(2) < torch.tensor([0.6, 0.45], device=draw.device), 0, -1)
    kind = torch.where(is_table & draw.chance(0.6, 2), -1, kind)
    yaw = torch.where(is_street, 0.3 * (draw.unit(2) - 0.5), wall_yaw)
    centre, half = (
        torch.where(is_street[..., None], a, b) for a, b in zip(house, wall, strict=True)
    )
    return Solids(kind, centre, half), yaw


def _draw_houses(draw: Sampler, side: Tensor, place: Tensor, h: Tensor) -> tuple[Tensor, Tensor]:
    """Draw the centres and half sizes of houses on both sides, shape [B, 2, 3] each."""
    size = h * torch.stack(
        [1.0 + 4.0 * draw.unit(2), 1.0 + 6.0 * draw.unit(2), 1.5 + 9.0 * draw.unit(2)], dim=0
    )
    half = size.permute(1, 2, 0)
    reach = torch.maximum(place[:, 0:1] * side, torch.zeros_like(side)) + h * (
        1.2 + 4.0 * draw.unit(2)
    )
    along = -h * (1.0 + 20.0 * draw.unit(2))
    return torch.stack([side * (reach + half[..., 0]), half[..., 1], along], dim=-1), half


def _draw_walls(
    draw: Sampler, side: Tensor, place: Tensor, scale: Tensor, camera_height: Tensor
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Draw the centres and half sizes of two walls, shape [B, 2, 3] each, and their yaws [rad]."""
    h = camera_height[:, None]
    half = torch.stack(
        [h * 25.0 * torch.ones_like(side), h * (0.5 + 1.6 * draw.unit(2)), 0.1 * h.expand(-1, 2)],
        dim=-1,
    )
    yaw = torch.stack([0.7 * (draw.unit() - 0.5), np.pi / 2.0 + 0.5 * (draw.unit() - 0.5)], dim=1)
    behind = place[:, 2] - scale * (0.8 + 4.0 * draw.unit()) - 0.3 * camera_height
    beside = place[:, 0] + side[:, 0] * (scale * (0.9 + 4.0 * draw.unit()) + 0.8 * camera_height)
    beyond = torch.maximum(beside * side[:, 0], camera_height * 0.8) * side[:, 0]
    zero = torch.zeros_like(behind)
    centre = torch.stack(
        [
            torch.stack([zero, half[:, 0, 1], behind], dim=1),
            torch.stack([beyond, half[:, 1, 1], zero], dim=1),
        ],
        dim=1,
    )
    return (centre, half), yaw


def _draw_distant(draw: Sampler, place_kind: Tensor, place: Tensor, h: Tensor) -> Solids:
    """Draw trees out of doors, and what stands far away before the sky."""
    device, count = draw.device, draw.count
    outdoors = (place_kind < 2)[:, None]
    around = 2.0 * np.pi * draw.unit(2)
    away = h * torch.exp(np.log(2.0) + draw.unit(2) * np.log(8.0))
    tree = place[:, None] + away[..., None] * torch.stack(
        [around.sin(), torch.zeros_like(around), -around.cos()], dim=-1
    )
    crown = h[..., None] * (0.5 + 1.8 * draw.unit(2, 1)) * (0.7 + 0.6 * draw.unit(2, 3))
    trunk = h[..., None] * torch.tensor([0.08, 0.0, 0.08], device=device).expand(count, 2, 3)
    trunk = trunk.clone()
    trunk[..., 1] = h * (0.3 + 0.9 * draw.unit(2))
    trunk_centre, crown_centre = tree.clone(), tree.clone()
    trunk_centre[..., 1] = trunk[..., 1]
    crown_centre[..., 1] = 2.0 * trunk[..., 1] + 0.8 * crown[..., 1]
    stands = draw.chance(0.45, 2) & outdoors
    # The camera stands in no crown.
    stands &= tree[..., [0, 2]].norm(dim=-1) > 1.5 * crown.max(dim=-1).values
    far = h * (12.0 + 50.0 * draw.unit(2))
    far_half = (
        h[..., None]
        * torch.exp(draw.unit(2, 3) * np.log(12.0))
        * torch.tensor([2.5, 0.6, 1.0], device=device)
    )
    far_centre = torch.stack([far * 1.4 * (draw.unit(2) - 0.5), 0.7 * far_half[..., 1], -far], -1)
    far_kind = torch.where(draw.chance(0.5, 2), 1, 0)
    far_kind = torch.where(draw.chance(0.45, 2) & outdoors, far_kind, -1)
    kind = torch.cat([torch.where(stands, 2, -1), torch.where(stands, 1, -1), far_kind], 1)
    return Solids(
        kind,
        torch.cat([trunk_centre, crown_centre, far_centre], dim=1),
        torch.cat([trunk, crown, far_half], dim=1),
    )
