"""Texels of a map and the directions drawn from their tents of bilinear interpolation."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import warp as wp

from warpir.core.arrays import Float64Array, FloatArray, IntArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, texel_solid_angles
from warpir.kernels.transport.texels import TENT_REACH, TexelArgs
from warpir.render.renderer import Renderer

LANES = 256
"""Threads per pixel on CUDA."""
ITEM_SIZE = 16
"""Directions that one thread draws in sequence."""


def tent_solid_angles(height: int) -> Float64Array:
    """Return the solid angle of a texel's tent in each row [sr], shape [height].

    That is what bilinear interpolation weighs a texel with; all texels sum to 4 pi. Within the map
    ``2 (1 - cos d) / d sin(theta)``, in the polar rows the lookup is clamped.
    """
    step = np.pi / height
    centre = (np.arange(height) + 0.5) * step
    rows = np.sin(centre) * 2.0 * (1.0 - np.cos(step)) / step
    polar = 1.0 - np.cos(0.5 * step)
    beyond = np.cos(0.5 * step) - (np.sin(1.5 * step) - np.sin(0.5 * step)) / step
    rows[0] = rows[-1] = polar + beyond
    solid: Float64Array = rows * np.pi / height
    return solid


@lru_cache(maxsize=8)
def tent_irradiance(normal: tuple[float, float, float], height: int) -> Float64Array:
    """Return what a texel of radiance 1 makes a white plane reflect [1], shape [height, 2 height].

    ``integral of tent cos / pi`` by quadrature; all texels of a constant sky sum to 1.
    """
    side = max(4, 1024 // height)
    fine = side * height
    cosine = np.maximum(map_directions(fine, 2 * fine) @ np.array(normal), 0.0) / np.pi
    cosine *= texel_solid_angles(fine, 2 * fine)[:, None]

    def tents(count: int, wraps: bool) -> Float64Array:
        """Interpolation weights of ``side * count`` positions, shape [side * count, count]."""
        x = (np.arange(side * count) + 0.5) / side - 0.5
        low = np.floor(x).astype(int)
        weight = x - low
        first, second = low % count, (low + 1) % count
        if not wraps:
            first, second = np.clip(low, 0, count - 1), np.clip(low + 1, 0, count - 1)
        matrix = np.zeros((side * count, count))
        np.add.at(matrix, (np.arange(side * count), first), 1.0 - weight)
        np.add.at(matrix, (np.arange(side * count), second), weight)
        return matrix

    irradiance: Float64Array = tents(height, False).T @ cosine @ tents(2 * height, True)
    return irradiance


def direction_counts(expected: FloatArray, budget: int) -> IntArray:
    """Return the number of directions of each texel: one, and more where light is expected.

    A texel's noise is proportional to its flux, so equal-cost directions are best shared out in
    proportion to it (Neyman's allocation); powers of two keep the sequences stratified.

    Args:
        expected: Likely radiance of the map, shape [He, 2 He, 3].
        budget: Directions to share out.

    Returns:
        Shape [He * 2 He].
    """
    flux = luminance(expected.astype(np.float64)) * tent_solid_angles(len(expected))[:, None]
    share = budget * flux / max(float(flux.sum()), 1e-30)
    counts = np.exp2(np.floor(np.log2(np.maximum(share, 1.0)))).astype(np.int32)
    flat: IntArray = counts.reshape(-1)
    return flat


def flux_noise(texels: FloatArray, counts: IntArray) -> float:
    """Return the relative noise of a pixel with these directions under this light [1].

    ``sqrt(sum flux_t^2 / count_t)`` over the whole flux: the standard deviation of a pixel if each
    direction's light were as uncertain as it is strong. A light that has moved shows by it.
    """
    flux = luminance(texels.astype(np.float64)) * tent_solid_angles(len(texels))[:, None]
    total = max(float(flux.sum()), 1e-30)
    return float(np.sqrt((np.square(flux.reshape(-1)) / counts).sum()) / total)


def texel_args(
    counts: IntArray,
    height: int,
    renderer: Renderer,
    columns: IntArray,
    normal: Float64Array | None = None,
) -> TexelArgs:
    """Describe a map's texels; directions follow the cosine with ``normal`` where it is given.

    ``columns`` are the texels that the rows hold.
    """
    device = renderer.device
    args = TexelArgs()
    args.height, args.width = height, 2 * height
    step = np.pi / height
    rows = np.arange(height)
    low, high = np.maximum(rows - 0.5, 0.0) * step, np.minimum(rows + 1.5, height) * step
    across = np.where((low < 0.5 * np.pi) & (high > 0.5 * np.pi), 1.0, np.sin([low, high]).max(0))
    bound = np.repeat(across[:, None], 2 * height, axis=1)
    centres = map_directions(height, 2 * height)
    if normal is not None:
        angle = np.arccos(np.clip(centres @ normal, -1.0, 1.0))
        bound *= np.cos(np.clip(angle - TENT_REACH * step, 0.0, 0.5 * np.pi))
    for name, values in (("d_omega", tent_solid_angles(height)), ("bound", bound.reshape(-1))):
        setattr(args, name, wp.array(values.astype(np.float32), dtype=float, device=device))
    args.direction_count = wp.array(counts, dtype=int, device=device)
    args.centre = wp.array(centres.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    # On CUDA one thread must not draw a sun's directions while its neighbours wait; but a pixel's
    # sums have one order only where one thread adds them up.
    args.lanes, args.item_size = (1, 1 << 30) if renderer.is_ordered else (LANES, ITEM_SIZE)
    pieces = -(-counts[columns] // args.item_size)
    which = np.repeat(np.arange(len(columns)), pieces)
    first = np.arange(len(which)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    args.item_count = len(which)
    for name, values in (("item_column", which), ("item_first", first * args.item_size)):
        setattr(args, name, wp.array(values.astype(np.int32), dtype=int, device=device))
    return args
