"""Materials of a scene on one device: factors, textures' slots, glTF's extensions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import warp as wp

from warpir.core.arrays import FloatArray
from warpir.kernels.types import ANISOTROPY, IRIDESCENCE, LAYERS, Extensions, MaterialArgs
from warpir.render.device import copied
from warpir.scene.asset import Material, TextureSlot
from warpir.scene.sheen import sheen_albedo_table

ALPHA_MODES = {"OPAQUE": 0, "MASK": 1, "BLEND": 2}
SLOTS = (
    "base_color", "metallic_roughness", "normal", "emission",
    "specular", "specular_color", "clearcoat", "clearcoat_roughness", "clearcoat_normal",
    "sheen_color", "sheen_roughness", "transmission", "anisotropy",
    "iridescence", "iridescence_thickness",
)  # fmt: skip
"""Texture slots in the order of `warpir.kernels.tracing.texture`."""
FACTORS = (
    ("base_color", wp.vec3),
    ("metallic", wp.float32),
    ("roughness", wp.float32),
    ("emission", wp.vec3),
)
"""Material factors that can be replaced and differentiated."""


def material_args(materials: Sequence[tuple[Material, int]], device: wp.Device) -> MaterialArgs:
    """Upload materials; rays stop at solid glass.

    Args:
        materials: Each with the index of its asset's first texture in the scene; without any, a
            plain one is there that nothing has.
        device: Warp device.
    """
    rows = materials or [(Material(), 0)]
    plain = [m for m, _ in rows]

    def array(values: object, dtype: type) -> wp.array:
        kind = np.int32 if dtype is wp.int32 else np.float32
        return wp.array(np.asarray(values, kind), dtype=dtype, device=device)

    args = MaterialArgs()
    for name in ("metallic", "roughness", "alpha", "alpha_cutoff", "normal_scale"):
        setattr(args, name, array([getattr(m, name) for m in plain], wp.float32))
    args.base_color = array([m.base_color for m in plain], wp.vec3)
    args.emission = array([m.emission for m in plain], wp.vec3)
    args.alpha_mode = array([ALPHA_MODES[m.alpha_mode] for m in plain], wp.int32)
    args.double_sided = array([m.double_sided for m in plain], wp.int32)

    slots = [[_slot(getattr(m, f"{name}_texture"), first) for name in SLOTS] for m, first in rows]
    args.slot_texture = array([[s[0] for s in row] for row in slots], wp.int32)
    args.slot_uv_set = array([[s[1] for s in row] for row in slots], wp.int32)
    args.slot_u = array([[s[2][:3] for s in row] for row in slots], wp.vec3)
    args.slot_v = array([[s[2][3:] for s in row] for row in slots], wp.vec3)

    extensions = [_extensions(m, 0.0 if m.is_solid_glass else m.transmission) for m in plain]
    args.extensions = wp.array(extensions, dtype=Extensions, device=device)
    args.any_layers = LAYERS * any(e.present for e in extensions)
    args.any_layers |= ANISOTROPY * any(e.anisotropy > 0.0 for e in extensions)
    args.any_layers |= IRIDESCENCE * any(e.iridescence > 0.0 for e in extensions)
    has_sheen = any(max(m.sheen_color) > 0.0 for m in plain)
    args.sheen_albedo = array(sheen_albedo_table() if has_sheen else np.zeros((2, 2)), wp.float32)

    args.any_culled = int(any(not m.double_sided for m in plain))
    args.any_emission = int(any(max(m.emission) > 0.0 for m in plain))
    return args


def with_factors(
    own: MaterialArgs, factors: Sequence[FloatArray | None], device: wp.Device
) -> MaterialArgs:
    """Return materials with other factors, in the order of `FACTORS`; None: their own."""
    args: MaterialArgs = copied(own)
    for factor, (name, dtype) in zip(factors, FACTORS, strict=True):
        if factor is not None:
            setattr(args, name, wp.array(factor, dtype=dtype, device=device))
    if factors[3] is not None:
        args.any_emission = 1
    return args


def passed_straight(
    own: MaterialArgs, materials: Sequence[Material], shares: Sequence[float], device: wp.Device
) -> MaterialArgs:
    """Return materials as rays of the shadow take them: solid glass is passed straight.

    Args:
        own: From `material_args`.
        materials: What they were uploaded from.
        shares: Of light that passes each where it does not reflect [1].
        device: Warp device.
    """
    extensions = [_extensions(m, share) for m, share in zip(materials, shares, strict=True)]
    args: MaterialArgs = copied(own)
    args.extensions = wp.array(extensions, dtype=Extensions, device=device)
    return args


def _slot(slot: TextureSlot | None, first_texture: int) -> tuple[int, int, list[float]]:
    """Return texture index, UV set and the six numbers of the transform."""
    if slot is None:
        return -1, 0, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    return first_texture + slot.texture, slot.uv_set, list(slot.transform)


def _extensions(material: Material, transmission: float) -> Extensions:
    """Return a material's glTF extensions for the kernels, with this share of light passing it."""
    plain = Material()
    names = (
        "ior", "specular", "specular_color", "clearcoat", "sheen_color", "transmission",
        "anisotropy", "iridescence",
    )  # fmt: skip
    out = Extensions()
    out.present = int(any(getattr(material, name) != getattr(plain, name) for name in names))
    if material.specular_texture or material.specular_color_texture:
        out.present = 1
    # KHR_materials_ior; an index of 0 stands for infinity and gives 1 as well.
    f0 = ((1.0 - material.ior) / (1.0 + material.ior)) ** 2
    out.f0 = wp.vec3(*(f0 * channel for channel in material.specular_color))
    out.sheen_color = wp.vec3(*material.sheen_color)
    for name in (
        "specular", "clearcoat", "clearcoat_roughness", "clearcoat_normal_scale",
        "sheen_roughness", "anisotropy", "iridescence",
    ):  # fmt: skip
        setattr(out, name, getattr(material, name))
    rotation = material.anisotropy_rotation
    out.stretch = wp.vec2(math.cos(rotation), math.sin(rotation))
    out.film_ior = material.iridescence_ior
    out.film_minimum, out.film_thickness = material.iridescence_thickness
    out.transmission = transmission
    return out
