"""The image layers of a run, ``layers.exr``, written and read back."""

import json
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np

from warpir.core.arrays import PixelArray, in_bands, on_cores
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.io.images.decoder import read_exr_channels
from warpir.io.images.writers import color_header
from warpir.io.results import OutputFolder
from warpir.scene.camera import Camera, exr_matrices

HALF_MAX = 65504.0
"""Largest finite half-precision number."""
BACKGROUND_DEPTH = 1e10
"""``Z`` where no object is [m]."""


@dataclass(frozen=True)
class Layers:
    """What ``layers.exr`` holds, all linear Rec.709; buffers that a run has not made are absent."""

    composite: PixelArray
    """``foreground.rgb + (1 - foreground.a) * plate * shadow_ratio``, plus `mirror` and `grain`
    where there are any [1], shape [H, W, 3]."""
    foreground: PixelArray
    """Object alone, premultiplied by coverage [1], shape [H, W, 4]."""
    shadow_ratio: PixelArray
    """Multiplies the plate; 1 where the object changes nothing [1], shape [H, W, 3]."""
    plate: PixelArray
    """Linearised photograph [1], shape [H, W, 3]."""
    matte: PixelArray
    """Object coverage, 0 to 1, shape [H, W]."""
    depth: PixelArray | None = None
    """Distance along the viewing axis [m], infinite on the background, shape [H, W]."""
    position: PixelArray | None = None
    """World position [m], shape [H, W, 3]."""
    normal: PixelArray | None = None
    """World unit normal, shape [H, W, 3]."""
    albedo: PixelArray | None = None
    """Base colour [1], shape [H, W, 3]."""
    roughness: PixelArray | None = None
    """Perceptual roughness [1], shape [H, W]."""
    emission: PixelArray | None = None
    """Part of `foreground` that the object emits [1], shape [H, W, 3]."""
    diffuse: PixelArray | None = None
    """Part of `foreground` reflected diffusely [1], shape [H, W, 3]."""
    specular: PixelArray | None = None
    """Part of `foreground` reflected specularly [1], shape [H, W, 3]."""
    mirror: PixelArray | None = None
    """What the object's mirror image on a glossy ground adds to the composite, of either sign [1],
    shape [H, W, 3]."""
    grain: PixelArray | None = None
    """What grain and JPEG blocks add to the composite, of either sign [1], shape [H, W, 3]."""


_CHANNELS = {
    "composite": ("", "RGB"),
    "foreground": ("fg", "RGBA"),
    "shadow_ratio": ("shadow", "RGB"),
    "plate": ("plate", "RGB"),
    "matte": ("matte", "A"),
    "depth": ("", "Z"),
    "position": ("position", "XYZ"),
    "normal": ("normal", "XYZ"),
    "albedo": ("albedo", "RGB"),
    "roughness": ("roughness", "Y"),
    "emission": ("emission", "RGB"),
    "diffuse": ("diffuse", "RGB"),
    "specular": ("specular", "RGB"),
    "mirror": ("mirror", "RGB"),
    "grain": ("grain", "RGB"),
}
"""Layer and channels that each plane has in ``layers.exr``."""
_FULL_FLOATS = {"depth", "position", "normal"}
_DEEP = {"composite", "foreground", "shadow_ratio", "plate", "mirror", "grain"}
"""What is stored as float32: always, and of a photograph of more than 8 bits."""


def _channel_names(plane: str) -> list[str]:
    prefix, suffixes = _CHANNELS[plane]
    return [f"{prefix}.{suffix}" if prefix else suffix for suffix in suffixes]


def read_layers(path: str | Path, max_pixels: int = LIMITS.pixels) -> Layers:
    """Read what `write_layers` made, as far as its own precision goes; all planes are float32.

    Raises:
        InputError: Missing, too large, truncated, or without the layers that every such file has.
    """
    channels = read_exr_channels(Path(path), max_pixels)
    planes: dict[str, PixelArray] = {}
    for plane in _CHANNELS:
        names = _channel_names(plane)
        if all(name in channels for name in names):
            values = [channels[name] for name in names]
            planes[plane] = np.stack(values, axis=-1) if len(values) > 1 else values[0]
    missing = [f.name for f in fields(Layers) if f.default is MISSING and f.name not in planes]
    if missing:
        wanted = ", ".join(_channel_names(missing[0]))
        raise InputError(path, f"not the layers of a run (found no {wanted})")
    if "depth" in planes:
        planes["depth"] = np.where(planes["depth"] >= BACKGROUND_DEPTH, np.inf, planes["depth"])
    return Layers(**planes)


def write_layers(
    folder: OutputFolder,
    layers: Layers,
    camera: Camera,
    *,
    is_deep: bool = False,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> int:
    """Stage ``layers.exr``: half channels, float32 for depth, position and normal.

    The composite recomposes exactly. Of a photograph of 8 bits the layers hold halves to begin with
    (`warpir.render.composite`), so nothing is lost here, and the composite is stored rounded to
    half. A deeper one has codes that halves cannot tell apart: its composite and its layers are
    float32.

    Args:
        folder: Where.
        layers: The image planes.
        camera: The camera that made them, at their resolution.
        is_deep: Whether the photograph has more than 8 bits (`Photo.is_deep`).
        config: Resolved configuration, kept as JSON in the attribute ``warpir/config``.
        inputs: sha256 of the input files by name, kept as JSON in ``warpir/inputs``.

    Returns:
        How many values were beyond the half range and are its end; for ``run.json``.

    Raises:
        ValueError: Shapes disagree, or the composite is not what its layers compute.
        InputError: A value is not finite (exit 6), or the disk is full (exit 5).
    """
    height, width = camera.height, camera.width
    formula = _checked_formula(layers)
    channels, clamped = _stored_channels(layers, height, width, is_deep)
    channels["A"] = np.ones((height, width), np.float16)

    world_to_camera, world_to_ndc = (m.astype(np.float32) for m in exr_matrices(camera))
    folder.write_exr(
        "layers.exr",
        channels,
        {
            **color_header(),
            "worldToCamera": world_to_camera,
            "worldToNDC": world_to_ndc,
            "warpir/formula": formula,
            "warpir/config": json.dumps(config or {}, sort_keys=True, default=str),
            "warpir/inputs": json.dumps(inputs or {}, sort_keys=True),
        },
    )
    return clamped


def _checked_formula(layers: Layers) -> str:
    """Check how the composite follows from the other layers; return it, by channels' names."""
    formula = "RGB = fg.RGB + (1 - fg.A) * plate.RGB * shadow.RGB"
    added = []
    for name, plane in (("mirror", layers.mirror), ("grain", layers.grain)):
        if plane is not None:
            added.append(plane)
            formula += f" + {name}.RGB"
    planes = layers.composite, layers.foreground, layers.plate, layers.shadow_ratio, *added

    def check(rows: slice) -> None:
        composite, foreground, plate, ratio, *more = (plane[rows] for plane in planes)
        recomputed = foreground[..., :3] + (1.0 - foreground[..., 3:]) * plate * ratio + sum(more)
        if not np.allclose(composite, recomputed, rtol=2e-3, atol=2e-3, equal_nan=True):
            worst = float(np.nanmax(np.abs(composite - recomputed)))
            raise ValueError(f"composite differs from its layers by up to {worst:g}")

    in_bands(check, *layers.composite.shape[:2])
    return formula


def _stored_channels(
    layers: Layers, height: int, width: int, is_deep: bool
) -> tuple[dict[str, PixelArray], int]:
    """Return the channels as they are stored, shape [height, width], and how many were clamped."""
    channels: dict[str, PixelArray] = {}
    clamped = 0
    for name in _CHANNELS:
        plane: PixelArray | None = getattr(layers, name)
        if plane is None:
            continue
        if name == "depth":
            plane = np.where(np.isposinf(plane), BACKGROUND_DEPTH, plane)
        plane = plane[..., None] if plane.ndim == 2 else plane
        names = _channel_names(name)
        if plane.shape != (height, width, len(names)):
            expected = (height, width, len(names))
            raise ValueError(f"layer {name}: shape {plane.shape}, expected {expected}")
        is_float = name in _FULL_FLOATS or (is_deep and name in _DEEP)
        # Of all values, without an array of their sizes.
        largest = max(plane.max(initial=0.0), -plane.min(initial=0.0))
        if not is_float and not largest < HALF_MAX:
            clamped += int((np.isfinite(plane) & (np.abs(plane) >= HALF_MAX)).sum())
            # NaN and Inf pass through, and the writer refuses them.
            plane = np.where(np.isfinite(plane), np.clip(plane, -HALF_MAX, HALF_MAX), plane)
        kind = np.float32 if is_float else np.float16
        stored = on_cores(methodcaller("astype", kind), np.moveaxis(plane, -1, 0))
        channels |= dict(zip(names, stored, strict=True))
    return channels, clamped
