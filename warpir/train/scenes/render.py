"""Meshes and lights that all scenes share, and the kernels that render scenes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from warpir.diffusion.models.embedded_words import NOUNS
from warpir.kernels.training.render import Pixels, render_scenes
from warpir.kernels.training.render import sun_reaches as sun_reaches_kernel
from warpir.kernels.training.scene import (
    GroundTable,
    LightTable,
    MapTable,
    ObjectTable,
    OccluderTable,
    ViewTable,
)
from warpir.train.lights import LightPool
from warpir.train.meshes import TrainingMesh
from warpir.train.scenes.layout import Stands, rays_in
from warpir.train.scenes.lighting import Lighting


class Stock:
    """Meshes and lights on one device, shared by all generators.

    Args:
        meshes: Objects to insert.
        panoramas: From `warpir.train.lights.load_panoramas`; may be none.
        device: Warp device; torch uses the same.
    """

    def __init__(self, meshes: Sequence[TrainingMesh], panoramas: LightPool, device: str) -> None:
        self.device, self.panoramas = wp.get_device(device), panoramas
        self.torch_device = panoramas.fine.device
        self.meshes = [
            wp.Mesh(
                wp.array(m.vertices, dtype=wp.vec3, device=device),
                wp.array(m.faces.ravel(), dtype=wp.int32, device=device),
            )
            for m in meshes
        ]

        def tensor(values: Any, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.as_tensor(np.asarray(values), dtype=dtype, device=self.torch_device)

        self.ids = torch.tensor([m.id for m in self.meshes], dtype=torch.int64).to(
            self.torch_device
        )
        counts = np.array([len(m.faces) for m in meshes])
        self.first_face = tensor(np.cumsum(counts) - counts, torch.int32)
        self.normals = tensor(np.concatenate([m.normals.reshape(-1, 3) for m in meshes]))
        self.albedos = tensor(np.concatenate([m.albedo for m in meshes]))
        spheres = []
        for m in meshes:
            middle = 0.5 * (m.vertices.min(axis=0) + m.vertices.max(axis=0))
            radius = float(np.linalg.norm(m.vertices - middle, axis=1).max())
            spheres.append([*middle, 1.001 * radius])
        self.spheres = tensor(spheres)
        self.nouns = tensor(
            [NOUNS.index(m.noun) if m.noun in NOUNS else 0 for m in meshes], torch.int64
        )

    def objects(self, stands: Stands, with_object: bool) -> dict[str, Tensor]:
        """Return the objects but for their surfaces, columns of the kernel's ``ObjectTable``."""
        ids = self.ids[stands.mesh]
        return {
            "mesh": ids if with_object else torch.zeros_like(ids),
            "place": stands.place,
            "yaw": stands.yaw,
            "scale": stands.scale,
            "sphere": stands.sphere,
            "first_face": self.first_face[stands.mesh],
            "normals": self.normals,
            "albedos": self.albedos,
        }


@dataclass
class Scenes:
    """What a batch of scenes is made of; all tensors, one row per scene."""

    tables: dict[str, Any]
    """Arguments of the kernel."""
    lighting: Lighting
    object_lighting: Lighting
    right: Tensor
    up: Tensor
    back: Tensor
    photo_window: Tensor
    crop_window: Tensor
    is_panorama: Tensor
    """Bool: the photo is a panorama crop."""
    kind: Tensor
    black: Tensor
    """By how much the object's display values are lifted where they are black, shape [B]."""
    noun: Tensor
    setting: Tensor
    weather: Tensor

    def rays(self, size: tuple[int, int]) -> Tensor:
        """Return the photos' unit viewing directions, shape [B, 3, height, width]."""
        return rays_in(self.photo_window, size, self.right, self.up, self.back)


@dataclass(frozen=True)
class Rendered:
    """Planes of a batch, shape [B, C, H, W]; see the kernel's ``Pixels``."""

    background: Tensor
    object: Tensor
    coverage: Tensor
    albedo: Tensor
    normal: Tensor
    ratio: Tensor
    solid: Tensor


def sun_reaches(stock: Stock, solids: dict[str, Tensor], point: Tensor, axis: Tensor) -> Tensor:
    """Return 1 where no solid stands between the points and the sun, else 0, shape [B]."""
    reached = torch.empty(len(point), device=point.device)
    wp.launch(
        sun_reaches_kernel,
        dim=len(point),
        inputs=[_struct(OccluderTable, solids), _vectors(point), _vectors(axis)],
        outputs=[wp.from_torch(reached)],
        device=stock.device,
    )
    return reached


def render(
    stock: Stock,
    scenes: Scenes,
    window: Tensor,
    size: tuple[int, int],
    side: int,
    with_object: bool = True,
) -> Rendered:
    """Render a window of each scene.

    Args:
        stock: Holds the meshes.
        scenes: What is rendered.
        window: Left, upper, width and height on the image plane at depth 1, shape [B, 4].
        size: Height and width [px].
        side: Its square is the number of points per pixel.
        with_object: Or the scenes without their objects.
    """
    (height, width), count = size, len(window)
    tables, device = scenes.tables, stock.torch_device
    names = ("background", "object", "albedo", "normal", "ratio")
    pixels = count * height * width
    planes = {name: torch.empty(pixels, 3, device=device) for name in names}
    planes |= {name: torch.empty(pixels, device=device) for name in ("coverage", "solid")}
    lights = [
        _struct(
            LightTable,
            tables[name]
            | {"map": x.map, "yaw": x.yaw, "mirror": x.mirror, "gain": x.gain}
            | {"sun_axis": x.axis, "sun": x.sun, "sun_sigma": x.sigma},
        )
        for name, x in (("light", scenes.lighting), ("object_light", scenes.object_lighting))
    ]
    objects = tables["objects"]
    if not with_object:
        objects = objects | {"mesh": torch.zeros_like(objects["mesh"])}
    wp.launch(
        render_scenes,
        dim=pixels,
        inputs=[
            width, height, side, wp.from_torch(tables["blur_min"]),
            _struct(ViewTable, tables["views"] | {"window": window.contiguous()}),
            *lights,
            _struct(MapTable, tables["maps"]),
            _struct(OccluderTable, tables["solids"]),
            _struct(GroundTable, tables["ground"]),
            _struct(ObjectTable, objects),
        ],
        outputs=[_struct(Pixels, planes)],
        device=stock.device,
    )  # fmt: skip

    def plane(name: str) -> Tensor:
        return planes[name].view(count, height, width, -1).permute(0, 3, 1, 2)

    return Rendered(**{name: plane(name) for name in planes})


def _vectors(values: Tensor) -> wp.array:
    return wp.from_torch(values.contiguous(), dtype=wp.vec3)


def _struct(kind: Any, tensors: dict[str, Tensor]) -> Any:
    """Fill one of the kernel's tables with views of tensors; ids of meshes must outlive it."""
    table = kind()
    for name, variable in kind.vars.items():
        values = tensors[name].contiguous()
        dtype = variable.type.dtype
        if dtype is wp.uint64:
            array = wp.array(
                ptr=values.data_ptr(), dtype=wp.uint64, shape=values.shape,
                device=wp.device_from_torch(values.device), copy=False,
            )  # fmt: skip
        else:
            array = wp.from_torch(values, dtype=dtype)
        setattr(table, name, array)
    return table
