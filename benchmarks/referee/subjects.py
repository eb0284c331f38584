"""What is looked at in checks: a sphere, a square, a camera and a light."""

import numpy as np

from tests.builders.poses import rotation
from tests.builders.shapes import camera, quad
from warpir.core.arrays import Float64Array, FloatArray
from warpir.scene.asset import Asset, Material, Primitive, Texture
from warpir.scene.camera import Camera


def grid_ball(polar: Float64Array, azimuth: Float64Array) -> Primitive:
    """Return the unit sphere about the origin, poles on the Y axis, shading normals exact.

    Its vertices are a grid over angles from +Y and about it [rad], each from end to end.
    """
    theta, phi = np.meshgrid(polar, azimuth, indexing="ij")
    axes = [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)]
    positions = np.stack(axes, axis=-1).reshape(-1, 3)
    uv = np.stack([phi / (2.0 * np.pi), theta / np.pi], axis=-1).reshape(-1, 2)
    row, column = np.mgrid[0 : len(polar) - 1, 0 : len(azimuth) - 1]
    a = row * len(azimuth) + column
    b, c, d = a + 1, a + len(azimuth), a + len(azimuth) + 1
    # At the poles one triangle of each cell has no area
    upper, lower = np.stack([a, c, b], axis=-1)[1:], np.stack([b, c, d], axis=-1)[:-1]
    return Primitive(
        positions,
        np.concatenate([upper.reshape(-1, 3), lower.reshape(-1, 3)]).astype(np.int32),
        0,
        normals=positions.astype(np.float32),
        uv0=uv.astype(np.float32),
    )


def ball(rings: int = 64) -> Primitive:
    """Return `grid_ball` of as many rings and twice as many sides."""
    azimuth = np.linspace(0.0, 2.0 * np.pi, 2 * rings + 1)
    return grid_ball(np.linspace(0.0, np.pi, rings + 1), azimuth)


def sphere(material: Material, textures: tuple[Texture, ...] = (), rings: int = 64) -> Asset:
    """Return the unit sphere in one material."""
    return Asset("sphere", (ball(rings),), (material,), textures)


def square(material: Material, side: float, height: float, up: bool = False) -> Asset:
    """Square in the plane y = ``height`` (or standing in z = 0), facing +Y (or +Z)."""
    h = 0.5 * side
    edge = (0.0, h, 0.0) if up else (0.0, 0.0, -h)
    return Asset("square", (quad((0.0, height, 0.0), (h, 0.0, 0.0), edge),), (material,))


def view(
    distance: float, width: int = 32, height: int = 32, fov: float = 25.0, turn: float = 0.0
) -> Camera:
    """Camera at ``(0, 0, distance)`` turned about +Y to look from another side, along -Z."""
    focal = 0.5 * width / np.tan(np.radians(0.5 * fov))
    c2w = np.eye(4)
    c2w[:3, :3] = rotation(np.radians(turn))
    c2w[:3, 3] = c2w[:3, :3] @ [0.0, 0.0, distance]
    return Camera(width, height, focal, focal, 0.5 * width, 0.5 * height, c2w)


def from_above(width: int = 96, height: int = 64, eye: float = 2.0) -> Camera:
    """Look down at the object from before it."""
    return camera(width, height, 96.0, (0.0, eye, 4.5), pitch=-20.0)


def sun_and_sky(rng: np.random.Generator, rows: int = 32) -> FloatArray:
    """Noisy coloured sky with one texel 2000 times brighter, shape [rows, 2 rows, 3]."""
    texels = rng.exponential(size=(rows, 2 * rows, 3))
    texels[rows // 4, rows // 2] *= 2000.0
    return texels.astype(np.float32)
