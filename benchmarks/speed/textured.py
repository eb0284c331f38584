"""An asset with as many textures as assets of the trade have: five balls in a heap, made here.

Each ball has a material with textures of its own for base colour, metal and roughness, and normals,
so that rays in hardly any order read fifteen of them.
"""

from dataclasses import replace

import numpy as np

from benchmarks.referee.subjects import grid_ball
from warpir.core.arrays import CodeArray, Float64Array
from warpir.scene.asset import Asset, Material, Primitive, Texture, TextureSlot

SIDE = 100
"""Vertices of a ball from pole to pole, and around it."""
TEXELS = 512
"""Width and height of a texture."""
CENTERS = ((-1, 1, -1), (1, 1, -1), (-1, 1, 1), (1, 1, 1), (0, 1 + np.sqrt(2.0), 0))
"""Of unit balls: four that touch the ground and each other, one on top."""


def textured_heap() -> Asset:
    """Return the heap standing on y = 0."""
    rng = np.random.default_rng(5)
    return Asset(
        "textured",
        tuple(_ball(np.array(center), k) for k, center in enumerate(CENTERS)),
        tuple(_material(k) for k in range(len(CENTERS))),
        tuple(Texture(codes) for _ in CENTERS for codes in _textures(rng)),
    )


def _ball(center: Float64Array, material: int) -> Primitive:
    """Return a unit ball whose vertices are a grid over its texture coordinates."""
    share = np.arange(SIDE) / (SIDE - 1)
    ball = grid_ball(np.pi * share, 2.0 * np.pi * share)
    return replace(ball, positions=ball.positions + center, material=material)


def _material(k: int) -> Material:
    """Return the material of a ball, whose textures alone say what it is."""
    base_color, metallic_roughness, normal = (TextureSlot(3 * k + slot) for slot in range(3))
    return Material(
        f"ball {k}",
        base_color_texture=base_color,
        metallic_roughness_texture=metallic_roughness,
        normal_texture=normal,
    )


def _textures(rng: np.random.Generator) -> tuple[CodeArray, CodeArray, CodeArray]:
    """Return base colour, metal and roughness, and normals of one ball."""
    one, other = rng.uniform(0.1, 0.9, (2, 3))
    share = _between(_noise(rng, 80.0))[..., None]
    base_color = share * one + (1.0 - share) * other
    roughness = 0.3 + 0.5 * _between(_noise(rng, 60.0))
    metallic = _between(4.0 * _noise(rng, 100.0))
    height = 2.5 * _noise(rng, 40.0)
    # Green is up, rows go down
    slope = [-np.gradient(height, axis=1), np.gradient(height, axis=0), np.ones_like(height)]
    normal = np.stack(slope, axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return (
        _codes(base_color),
        _codes(np.stack([np.zeros_like(roughness), roughness, metallic], axis=-1)),
        _codes(0.5 + 0.5 * normal),
    )


def _noise(rng: np.random.Generator, width: float) -> Float64Array:
    """Return noise of deviation 1 that repeats, of spots about that wide [px]."""
    frequency = np.hypot(np.fft.fftfreq(TEXELS)[:, None], np.fft.rfftfreq(TEXELS))
    blur = np.exp(-0.5 * np.square(frequency * width))
    field = np.fft.irfft2(np.fft.rfft2(rng.normal(size=(TEXELS, TEXELS))) * blur)
    scaled: Float64Array = field / field.std()
    return scaled


def _between(values: Float64Array) -> Float64Array:
    """Press numbers into 0 to 1."""
    pressed: Float64Array = 0.5 + 0.5 * np.tanh(values)
    return pressed


def _codes(values: Float64Array) -> CodeArray:
    """Return RGB as codes, opaque."""
    rgba = np.concatenate([values, np.ones((*values.shape[:2], 1))], axis=-1)
    return np.rint(255.0 * rgba).astype(np.uint8)
