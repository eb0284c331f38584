"""Lat-long conventions: by its own formula every tool finds in our map what is really there."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.builders.poses import rotation
from warpir.core.latlong import map_directions, rotate_map, texel_solid_angles
from warpir.io.images.envmap_conventions import (
    IN_CAMERA_AXES,
    SEAM_SHIFTS,
    from_ours,
    rotate_directions,
    to_ours,
)
from warpir.scene.light import fibonacci

HEIGHT = 64
LOBES = {  # red, green, blue and yellow, one a quarter; nothing about it is symmetric
    (1.0, 0.0, 0.0): (1.0, 0.0, 0.0),
    (0.0, 0.0, 1.0): (0.0, 1.0, 0.0),
    (-1.0, 0.0, 0.0): (0.0, 0.0, 1.0),
    (0.0, 0.0, -1.0): (1.0, 1.0, 0.0),
}
UP_LOBE = (0.2, 0.6, 0.9)
READING = 0.012
"""Bilinear reading of lobes of concentration 6 at 64 rows: second derivative 6, step pi / 64."""

Uv = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]


def radiance(d: NDArray[np.float64]) -> NDArray[np.float64]:
    """Four coloured lobes on the horizon and a pale one at the zenith, shape [..., 3]."""
    total = np.exp(6.0 * (d[..., 1:2] - 1.0)) * UP_LOBE
    for axis, rgb in LOBES.items():
        total += np.exp(6.0 * (d @ np.array(axis) - 1.0))[..., None] * rgb
    return total


def openexr(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ImfEnvmap.h: longitude atan2(x, z) falls from pi on the left, latitude from pi / 2."""
    lat = np.arctan2(d[..., 1], np.hypot(d[..., 0], d[..., 2]))
    lon = np.arctan2(d[..., 0], d[..., 2])
    return lon / (-2.0 * np.pi) + 0.5, lat / -np.pi + 0.5


def nvdiffrec(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """render/util.py, cubemap_to_latlong and its inverse."""
    u = np.arctan2(d[..., 0], -d[..., 2]) / (2.0 * np.pi) + 0.5
    return u, np.arccos(np.clip(d[..., 1], -1.0, 1.0)) / np.pi


def threejs(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """EquirectUv of common.glsl.js; its v rises."""
    u = np.arctan2(d[..., 2], d[..., 0]) / (2.0 * np.pi) + 0.5
    return u, 1.0 - (np.arcsin(np.clip(d[..., 1], -1.0, 1.0)) / np.pi + 0.5)


def blender(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """direction_to_equirectangular of Cycles' projection.h, +Z up; its v rises."""
    x, y, z = d[..., 0], -d[..., 2], d[..., 1]
    u = (np.arctan2(y, x) - np.pi) / (-2.0 * np.pi)
    return u, 1.0 - (np.arccos(np.clip(z, -1.0, 1.0)) - np.pi) / -np.pi


def diffusionlight(d: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ball2envmap.py: the camera is at +X, image right is -Y and up +Z; phi = 2 pi u from +X."""
    x, y, z = d[..., 2], -d[..., 0], d[..., 1]
    return np.arctan2(y, x) / (2.0 * np.pi) % 1.0, np.arccos(np.clip(z, -1.0, 1.0)) / np.pi


TOOLS: dict[str, Uv] = {
    "openexr": openexr,
    "nvdiffrec": nvdiffrec,
    "threejs": threejs,
    "blender": blender,
    "diffusionlight": diffusionlight,
}


def pose(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """Camera to world rotation, angles in degrees."""
    return rotation(*np.radians([yaw, pitch, roll]))


CAMERA = pose(35.0, -12.0, 4.0)


def read(texels: NDArray[np.float32], u: NDArray[np.float64], v: NDArray[np.float64]) -> np.ndarray:
    """Bilinear reading with texel centres at halves, as all these tools do."""
    height, width = texels.shape[:2]
    x, y = u % 1.0 * width - 0.5, np.clip(v * height - 0.5, 0, height - 1)
    j, i = np.floor(x).astype(int), np.floor(y).astype(int)
    fx, fy = (x - j)[..., None], (y - i)[..., None]
    k, low = (j + 1) % width, np.minimum(i + 1, height - 1)
    j = j % width
    upper = texels[i, j] * (1 - fx) + texels[i, k] * fx
    lower = texels[low, j] * (1 - fx) + texels[low, k] * fx
    return np.asarray(upper * (1 - fy) + lower * fy)


@pytest.mark.parametrize("name", TOOLS)
def test_conventions_hold_by_each_tools_own_formula(name: str) -> None:
    """Whatever way the tool looks, it sees there what we see, and in a mirrored map it does not."""
    ours = radiance(map_directions(HEIGHT, 2 * HEIGHT)).astype(np.float32)
    theirs = from_ours(ours, name, CAMERA)
    world = np.concatenate([np.array(list(LOBES)), [[0.0, 1.0, 0.0]], fibonacci(200)])
    local = world @ CAMERA if name in IN_CAMERA_AXES else world
    u, v = TOOLS[name](local)
    np.testing.assert_allclose(read(theirs, u, v), radiance(world), atol=READING)
    for wrong in (theirs[:, ::-1], np.roll(theirs, HEIGHT // 2, axis=1), theirs[::-1]):
        assert np.abs(read(wrong, u, v) - radiance(world)).max() > 0.5


@pytest.mark.parametrize("name", TOOLS)
def test_conventions_are_undone(name: str) -> None:
    """Reading back what was written gives our map: exactly where only columns move."""
    ours = radiance(map_directions(HEIGHT, 2 * HEIGHT)).astype(np.float32)
    back = to_ours(from_ours(ours, name, CAMERA), name, CAMERA)
    np.testing.assert_allclose(back, ours, atol=2 * READING if name in IN_CAMERA_AXES else 0)
    assert set(TOOLS) == set(SEAM_SHIFTS)


def test_conventions_level_camera_moves_columns_only() -> None:
    """A camera that is only turned about +Y moves columns, and a turn of 0 nothing."""
    ours = radiance(map_directions(HEIGHT, 2 * HEIGHT)).astype(np.float32)
    np.testing.assert_array_equal(
        from_ours(ours, "diffusionlight", np.eye(4)), np.roll(ours, HEIGHT, axis=1)
    )
    quarter = np.roll(ours, -HEIGHT // 2, axis=1)
    np.testing.assert_array_equal(rotate_directions(ours, pose(90.0, 0.0, 0.0)), quarter)
    for degrees in (90.0, -270.0, 810.0):
        np.testing.assert_array_equal(rotate_map(ours, degrees), quarter)


def test_conventions_tilted_map_keeps_its_flux() -> None:
    """A turned sphere sends out as much as before."""
    ours = radiance(map_directions(HEIGHT, 2 * HEIGHT)).astype(np.float32)
    omega = texel_solid_angles(HEIGHT, 2 * HEIGHT)
    before, after = (
        np.einsum("i,ijc->c", omega, texels) for texels in (ours, rotate_directions(ours, CAMERA))
    )
    np.testing.assert_allclose(after, before, rtol=1e-3)


def test_conventions_refuse_what_cannot_be_turned() -> None:
    """A name nobody knows, and a map in camera axes without the camera."""
    ours = np.zeros((2, 4, 3), np.float32)
    with pytest.raises(ValueError, match="'maya' is not one of openexr"):
        to_ours(ours, "maya")
    with pytest.raises(ValueError, match="the camera is needed"):
        from_ours(ours, "diffusionlight")
