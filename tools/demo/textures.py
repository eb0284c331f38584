"""Textures of the demo's place: pavers, bricks and plaster, drawn from noise."""

import numpy as np
from numpy.typing import NDArray

from tools.demo.noise import blurred_noise
from warpir.core.arrays import Float64Array
from warpir.core.color import codes_of, linear_to_srgb
from warpir.scene.asset import Texture

PAVED = 18.0
"""Edge of the square that carries the ground's large texture [m]."""


def _encoded(reflectance: Float64Array) -> Texture:
    """Encode linear reflectance, shape [H, W, 3], as an sRGB texture."""
    codes = codes_of(linear_to_srgb(np.clip(reflectance, 0.0, 1.0)))
    return Texture(np.pad(codes, ((0, 0), (0, 0), (0, 1)), constant_values=255))


def _courses(
    size: int, rows: int, columns: int, joint: float, seed: int
) -> tuple[NDArray[np.int64], Float64Array, Float64Array]:
    """Lay blocks in running bond over a square texture that tiles.

    Args:
        size: Rows and columns of the texture.
        rows: Courses in the texture, even.
        columns: Blocks in a course.
        joint: Width of a joint, as a share of the texture's edge.
        seed: Of the blocks' slightly uneven edges.

    Returns:
        Number of the block at each texel; depth inside the block as a share of the edge (negative
        in the joint); and the share of the way up the block; each of shape [size, size].
    """
    wobble = 0.12 * joint * blurred_noise(size, size / 170.0, seed)
    v = (np.arange(size) + 0.5)[:, None] / size + wobble
    u = (np.arange(size) + 0.5)[None, :] / size + wobble.T
    course = np.floor(v * rows).astype(int)
    shifted = u * columns + 0.5 * (course % 2)
    block = np.floor(shifted).astype(int) % columns
    up, along = v * rows - course, shifted - np.floor(shifted)
    depth = (
        np.minimum(np.minimum(up, 1.0 - up) / rows, np.minimum(along, 1.0 - along) / columns)
        - 0.5 * joint
    )
    return (course % rows) * columns + block, depth, up


def paving_texture(size: int = 4096) -> Texture:
    """Draw the square's concrete pavers: joints, blotches, gravel grain and two oil stains."""
    rows, columns = 48, 32
    block, depth, _ = _courses(size, rows, columns, 0.009 / PAVED, seed=1)
    rng = np.random.default_rng(2)
    tone = 1.0 + 0.075 * rng.standard_normal(rows * columns)
    warmth = 0.03 * rng.standard_normal(rows * columns)
    texel = PAVED / size
    grain = blurred_noise(size, 0.7, 3)
    level = 0.285 * tone[block] * (1.0 + 0.055 * grain)
    level *= 1.0 + 0.05 * blurred_noise(size, 0.10 / texel, 4)
    level *= 1.0 + 0.06 * blurred_noise(size, 0.7 / texel, 5)
    level *= np.where(grain > 2.6, 0.7, 1.0)
    edge = np.clip(depth * PAVED / 0.02, 0.0, 1.0)
    level *= 0.86 + 0.14 * edge
    inside = np.clip(depth * size + 0.5, 0.0, 1.0)
    v, u = np.mgrid[0:size, 0:size] * texel
    patch = blurred_noise(size, 0.06 / texel, 6)
    for column, row, radius in ((11.9, 12.4, 0.42), (5.2, 13.1, 0.30), (13.6, 8.6, 0.35)):
        distance = np.hypot(u - column, 0.8 * (v - row)) / radius + 0.28 * patch
        level *= 1.0 - 0.38 * np.clip(1.25 - distance, 0.0, 0.6)
    stone = level[..., None] * (
        np.array([1.03, 1.0, 0.94]) + warmth[block][..., None] * np.array([1.0, 0.0, -1.0])
    )
    sand = 0.115 * (1.0 + 0.15 * grain[..., None]) * np.array([1.05, 1.0, 0.86])
    moss = np.clip(blurred_noise(size, 0.5 / texel, 7) - 0.7, 0.0, 1.0)[..., None]
    sand = sand * (1.0 - 0.5 * moss * np.array([0.8, 0.2, 1.0]))
    return _encoded(inside[..., None] * stone + (1.0 - inside[..., None]) * sand)


def brick_texture() -> Texture:
    """Draw red bricks with pale mortar; the tile is 1.92 m wide."""
    size, rows, columns = 1024, 24, 8
    block, depth, _ = _courses(size, rows, columns, 0.0062, seed=8)
    rng = np.random.default_rng(9)
    tone = np.exp(0.20 * rng.standard_normal(rows * columns))
    hue = 0.08 * rng.standard_normal(rows * columns)
    level = tone[block] * (
        1.0 + 0.09 * blurred_noise(size, 0.8, 10) + 0.06 * blurred_noise(size, 7.0, 11)
    )
    tint = np.array([0.265, 0.122, 0.082]) * (
        1.0 + hue[block][..., None] * np.array([0.3, 1.0, 1.2])
    )
    mortar = (
        0.34 * np.array([1.0, 0.96, 0.88]) * (1.0 + 0.08 * blurred_noise(size, 1.0, 12)[..., None])
    )
    inside = np.clip(depth * size * 0.7 + 0.3, 0.0, 1.0)[..., None]
    return _encoded(inside * level[..., None] * tint + (1.0 - inside) * mortar)


def plaster_texture() -> Texture:
    """Draw a warm white rendered wall."""
    fine, coarse = blurred_noise(512, 1.0, 13), blurred_noise(512, 30.0, 14)
    level = 0.60 * (1.0 + 0.02 * fine + 0.025 * coarse)
    return _encoded(level[..., None] * np.array([1.0, 0.93, 0.80]))
