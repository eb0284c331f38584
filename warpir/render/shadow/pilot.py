"""Where the object changes the ground's light, in blocks of pixels, before a picture is made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.kernels.types import CameraArgs, LightArgs
from warpir.scene.camera import Camera

if TYPE_CHECKING:
    from warpir.render.renderer import Renderer

BLOCK = 4
"""Side of the blocks [px]."""
SAMPLES = 32
UNSEEN_SHADOW = 1e-3
"""Loss of light below which no shadow is traced [1]: an eighth of an 8-bit code at white."""
UNSEEN_GAIN = 2e-3
"""Gain of light below which it is not traced [1]: a quarter of an 8-bit code at white."""


@dataclass(frozen=True)
class Pilot:
    """What a first pass over blocks of pixels says of the ground; shapes are [rows, columns]."""

    view: CameraArgs
    """The scene's view in blocks; those at the right and lower border may reach past the photo."""
    changes: BoolArray
    """Where the object may change the light: elsewhere the photo stays, bit for bit."""
    gains: BoolArray
    """Where it may throw light."""
    open_radiance: Float64Array
    """Radiance of the white receiver without the object, mean over what is seen, shape [3]."""

    def pixels_of(self, blocks: BoolArray, camera: Camera) -> BoolArray:
        """Return the pixels within ``blocks``, row-major, shape [H * W]."""
        full = blocks.repeat(BLOCK, axis=0).repeat(BLOCK, axis=1)
        inside: BoolArray = full[: camera.height, : camera.width].reshape(-1)
        return inside


def run_pilot(
    renderer: Renderer, light: LightArgs, seed: int, indirect_limit: float = 0.0
) -> Pilot:
    """Trace the receiver over blocks, each sample at a position of its own in the block.

    A block is left alone where its 3 x 3 neighbourhood loses less than `UNSEEN_SHADOW` of its light
    and gains less than `UNSEEN_GAIN`.

    Args:
        renderer: The scene.
        light: From `light_args`.
        seed: Base seed.
        indirect_limit: As `Renderer.receiver` has it.
    """
    camera = renderer.scene.camera
    width, height = -(-camera.width // BLOCK), -(-camera.height // BLOCK)
    focal = camera.fx / BLOCK, camera.fy / BLOCK
    centre = camera.cx / BLOCK, camera.cy / BLOCK
    view = renderer.scene.camera_args_at(Camera(width, height, *focal, *centre, camera.c2w))
    if renderer.scene.triangle_count == 0:
        nothing = np.zeros((height, width), np.bool_)
        return Pilot(view, nothing, nothing, np.zeros(3))
    pixels = np.arange(width * height, dtype=np.int32)
    seen = renderer.receiver(
        light,
        pixels,
        np.zeros(len(pixels), np.int32),
        SAMPLES,
        1,
        seed,
        view,
        indirect_limit=indirect_limit,
    )

    def blocks_of(change: FloatArray, unseen: float) -> BoolArray:
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(seen.unoccluded > 0.0, np.abs(change) / seen.unoccluded, 0.0)
        share = share.max(axis=1).reshape(height, width)
        return dilate(_mean_of_neighbours(share) > unseen)

    gains = blocks_of(seen.thrown, UNSEEN_GAIN)
    lost = seen.unoccluded - (seen.lit - seen.thrown)
    changes = blocks_of(lost, UNSEEN_SHADOW) | gains
    lit = seen.unoccluded.max(axis=1) > 0.0
    radiance = seen.unoccluded[lit].mean(axis=0, dtype=np.float64) if lit.any() else np.zeros(3)
    return Pilot(view, changes, gains, radiance)


def shaded_pixels(renderer: Renderer, light: LightArgs, seed: int) -> IntArray:
    """Return the pixels where the object may change the receiver's light, row-major."""
    pilot = run_pilot(renderer, light, seed)
    inside = pilot.pixels_of(pilot.changes, renderer.scene.camera)
    return np.flatnonzero(inside).astype(np.int32)


def dilate(mask: BoolArray) -> BoolArray:
    """Grow a mask by one element in all eight directions."""
    return np.asarray(np.any(neighbourhood(np.pad(mask, 1)), axis=0))


def _mean_of_neighbours(values: FloatArray) -> FloatArray:
    """Average each value with its eight neighbours."""
    return np.asarray(sum(neighbourhood(np.pad(values, 1, mode="edge"))) / 9.0, np.float32)


def neighbourhood(padded: NDArray[Any]) -> list[NDArray[Any]]:
    """Return the nine shifts of an array that is padded by one on all sides, row by row."""
    rows, columns = padded.shape[0] - 2, padded.shape[1] - 2
    return [padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)]
