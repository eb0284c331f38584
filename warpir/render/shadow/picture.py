"""The shadow ratio of a whole picture: in blocks where it is smooth, else pixel by pixel.

The light on a plane changes slowly away from the object's contact and the edges of its shadow, so
irradiance is computed there at fewer places and interpolated (Ward and Heckbert 1992, "Irradiance
Gradients"). A place then affords more samples than a pixel would, and they go where the object is
(`warpir.kernels.receiver`): of the demo's ground a fifth is left to be traced by the pixel.

Interpolation errs by an eighth of the second difference over a block. Where that exceeds `BEND`,
noise included, the ratio comes from `Renderer.receiver`; so does all of it near lamps or on a mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, IntArray
from warpir.io.images.resize import resize
from warpir.kernels.types import LightArgs
from warpir.render.allocation import Sharing, as_shown
from warpir.render.picture.quality import Quality
from warpir.render.renderer import Renderer
from warpir.render.shadow.pilot import BLOCK, Pilot, dilate, neighbourhood, run_pilot

BEND = 8e-3
"""Second difference of neighbouring blocks up to which a ratio is interpolated [1]."""
LOSS_SAMPLES, GAIN_SAMPLES = 2, 4
"""Samples of a block over those of a pixel, for what the object takes and for what it throws."""


def picture_ratio(
    renderer: Renderer,
    light: LightArgs,
    may_see_object: IntArray,
    wanted: BoolArray,
    quality: Quality,
) -> tuple[IntArray, FloatArray]:
    """Return the pixels whose light the object may change, and their shadow ratio per channel.

    Args:
        renderer: The scene.
        light: From `light_args`.
        may_see_object: 1 where the object may hide the receiver, row-major, shape [H * W].
        wanted: Pixels to return at most, shape [H * W].
        quality: Counts and seed; of its limit `THROWN_LIMIT` is that of what is thrown onto ground
            of radiance 1 or more, and a share of it onto darker ground.

    Returns:
        Row-major pixels, shape [receiver_pixel], and ratios, shape [receiver_pixel, 3].
    """
    camera = renderer.scene.camera
    pilot = run_pilot(renderer, light, quality.seed, quality.indirect_limit)
    pixels = np.flatnonzero(wanted & pilot.pixels_of(pilot.changes, camera)).astype(np.int32)
    # A speck shows beside the ground's own light, which in a dark photo is little.
    limit = quality.indirect_limit * min(1.0, float(pilot.open_radiance.max()))
    quality = replace(quality, indirect_limit=limit)
    gains = pilot.pixels_of(pilot.gains, camera)[pixels]
    ratio = np.ones((len(pixels), 3), np.float32)
    bends, gain_bends = np.ones(len(pixels), np.bool_), gains
    thrown = np.zeros_like(ratio)
    # The light of a lamp near the ground falls off from block to block.
    is_even = renderer.scene.receiver.mesh is None and not renderer.scene.lamps
    if is_even and pilot.open_radiance.min() > 0.0:
        blocks = _Blocks(renderer, light, pilot, quality)
        bends, gain_bends = (
            pilot.pixels_of(b, camera)[pixels] for b in (blocks.bends, blocks.gain_bends)
        )
        lost, thrown = (
            _enlarged(plane, camera.height, camera.width)[pixels]
            for plane in (blocks.lost, blocks.thrown)
        )
        ratio = np.maximum(1.0 - lost, 0.0)
    whole = np.flatnonzero(bends | gain_bends)
    traced = renderer.receiver(
        light,
        pixels[whole],
        may_see_object[pixels[whole]],
        quality.samples,
        quality.rays,
        quality.seed,
        indirect_limit=quality.indirect_limit,
        may_gain=gain_bends[whole],
        sharing=Sharing(as_shown, quality.noise),
    )
    ratio[whole] = renderer.ratio(traced)
    return pixels, np.where(gain_bends[:, None], ratio, ratio + thrown)


class _Blocks:
    """Loss and gain of the blocks that change, over the open plane's radiance.

    Attributes:
        lost: Share that the object takes [1], shape [rows, columns, 3].
        thrown: Share that it adds [1], shape [rows, columns, 3].
        bends: Blocks whose loss must not be interpolated, shape [rows, columns].
        gain_bends: The same of their gain.
    """

    def __init__(
        self, renderer: Renderer, light: LightArgs, pilot: Pilot, quality: Quality
    ) -> None:
        spp, rays = quality.samples, quality.rays
        # The pilot's samples decided which blocks are here: others than those say how much.
        seed = quality.seed + 1

        def of_blocks(
            blocks: BoolArray, share_of: Callable[[IntArray], FloatArray]
        ) -> Float64Array:
            values = np.zeros((*blocks.shape, 3))
            values[blocks] = share_of(np.flatnonzero(blocks).astype(np.int32))
            return values

        def taken(index: IntArray) -> FloatArray:
            nothing = np.zeros(len(index), np.int32)
            seen = renderer.receiver(
                light,
                index,
                nothing,
                LOSS_SAMPLES * spp,
                rays,
                seed,
                pilot.view,
                may_gain=nothing > 0,
            )
            # Near the object the noise of both sums cancels in their ratio alone.
            return 1.0 - renderer.ratio(seen)

        def added(index: IntArray) -> FloatArray:
            limit = quality.indirect_limit
            thrown = renderer.thrown(
                light, index, GAIN_SAMPLES * spp, rays, seed, pilot.view, limit
            )
            return np.asarray(thrown / pilot.open_radiance.astype(np.float32), np.float32)

        self.lost = of_blocks(dilate(pilot.changes), taken)
        self.thrown = of_blocks(dilate(pilot.gains), added)
        self.bends = dilate(~(_bend(self.lost) <= BEND))
        self.gain_bends = pilot.gains & dilate(~(_bend(self.thrown) <= BEND))
        # What is not finite bends, so it is traced and counted by the pixel.
        for plane in (self.lost, self.thrown):
            plane[~np.isfinite(plane)] = 0.0


def _bend(plane: Float64Array) -> Float64Array:
    """Return the largest second difference along rows, columns and diagonals, any channel."""
    around = neighbourhood(np.pad(plane, ((1, 1), (1, 1), (0, 0)), mode="edge"))
    pairs = [np.abs(around[k] + around[8 - k] - 2.0 * plane) for k in range(4)]
    return np.asarray(np.max(pairs, axis=(0, -1)))


def _enlarged(plane: Float64Array, height: int, width: int) -> FloatArray:
    """Interpolate blocks at the centres of the picture's pixels, shape [H * W, 3]."""
    rows, columns = plane.shape[0] * BLOCK, plane.shape[1] * BLOCK
    full = resize(plane.astype(np.float32), rows, columns)
    return full[:height, :width].reshape(-1, 3)
