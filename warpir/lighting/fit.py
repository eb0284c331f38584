"""Fit spherical Gaussians to an environment map: sharp lobes for lamps, broad ones for the rest.

Compact sources are found one after the other and measured by their moments; a Fibonacci set of
broad lobes covers the sphere; all amplitudes are then solved together by non-negative least squares
over solid angle. No gradient descent, so nothing can get stuck.
"""

from dataclasses import dataclass

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.scene.lamps import LAMP_COUNT_MAX, lamps_of
from warpir.scene.light import Lobes, fibonacci, rasterize_lobes

FIT_HEIGHT = 64
"""Rows of the map on which amplitudes are solved."""


@dataclass(frozen=True)
class LobeFit:
    """Fitted lobes and how far they are from the map."""

    lobes: Lobes
    irradiance_error: float
    """Relative RMSE of the irradiance of 512 evenly spread normals [1]."""
    flux_error: float
    """Relative error of the total luminous flux [1]."""
    lamp_count: int
    """How many lobes stand for compact sources."""


def fit_lobes(texels: FloatArray, count: int) -> LobeFit:
    """Fit ``count`` lobes to a map.

    Args:
        texels: Radiance, shape [He, We, 3].
        count: Number of lobes, at least 1.

    Raises:
        ValueError: It is less.
    """
    if count < 1:
        raise ValueError(f"a fit needs at least one lobe (found {count})")
    found = lamps_of(texels, min(count, LAMP_COUNT_MAX))
    axes, sharpnesses, lamps = found.axes, found.sharpness, len(found.axes)
    # Broad lobes spaced evenly; this width keeps their sum within 2 % of a constant.
    broad = count - lamps
    if broad > 0:
        axes = np.concatenate([axes, fibonacci(broad)])
        sharpness = 1.0 / (0.6 * np.sqrt(4.0 * np.pi / broad)) ** 2
        sharpnesses = np.concatenate([sharpnesses, np.full(broad, sharpness)])
    amplitudes = _solve(texels, axes, sharpnesses, found.near)
    lobes = Lobes(
        amplitudes.astype(np.float32), axes.astype(np.float32), sharpnesses.astype(np.float32)
    )
    return LobeFit(lobes, *_errors(texels, lobes), lamp_count=lamps)


def _solve(
    texels: FloatArray,
    axes: Float64Array,
    sharpnesses: Float64Array,
    covered: list[BoolArray],
) -> Float64Array:
    """Solve the amplitudes per channel; a lamp's neighbourhood enters as one equation, its flux."""
    from scipy.optimize import nnls

    height, width = texels.shape[:2]
    omega = np.broadcast_to(texel_solid_angles(height, width)[:, None], (height, width))
    inside = np.zeros((height, width), bool)
    for near in covered:
        inside |= near
    rest = np.where(inside[..., None], 0.0, texels.astype(np.float64) * omega[..., None])
    coarse = min(FIT_HEIGHT, height)
    energy = resize_map((rest / omega[..., None]).astype(np.float32), coarse).astype(np.float64)
    free = resize_map(np.repeat((~inside)[..., None], 3, -1).astype(np.float32), coarse)[..., 0]
    weight = texel_solid_angles(coarse, 2 * coarse)[:, None] * free
    grid = map_directions(coarse, 2 * coarse).reshape(-1, 3)
    shape = np.exp(sharpnesses * (grid @ axes.T - 1.0))
    root = np.sqrt(weight.reshape(-1))
    level = energy / np.maximum(free, 1e-6)[..., None]
    rows, values = [shape * root[:, None]], [level.reshape(-1, 3) * root[:, None]]
    for near in covered:
        solid = omega[near]
        directions = map_directions(height, width)[near]
        caught = solid @ np.exp(sharpnesses * (directions @ axes.T - 1.0))
        k = len(rows) - 1
        # A lobe narrower than a texel falls between the texel centres: all of its flux is here.
        s = sharpnesses[k]
        caught[k] = 2.0 * np.pi / s * -np.expm1(-2.0 * s)
        scale = 1.0 / np.sqrt(solid.sum())
        rows.append(caught[None] * scale)
        values.append((solid @ texels[near].astype(np.float64))[None] * scale)
    matrix, target = np.concatenate(rows), np.concatenate(values)
    return np.stack([nnls(matrix, target[:, c])[0] for c in range(3)], axis=1)


def _errors(texels: FloatArray, lobes: Lobes) -> tuple[float, float]:
    """Return relative RMSE of irradiance over normals, and relative flux error."""
    normals = fibonacci(512)
    coarse = resize_map(texels, FIT_HEIGHT)
    omega = texel_solid_angles(FIT_HEIGHT, 2 * FIT_HEIGHT)
    grid = map_directions(FIT_HEIGHT, 2 * FIT_HEIGHT).reshape(-1, 3)
    cosine = np.maximum(normals @ grid.T, 0.0) * np.repeat(omega, 2 * FIT_HEIGHT)
    truth = cosine @ coarse.reshape(-1, 3).astype(np.float64)
    fitted = cosine @ rasterize_lobes(lobes, FIT_HEIGHT, 2 * FIT_HEIGHT).reshape(-1, 3)
    scale = float(np.sqrt((truth**2).mean()))
    error = float(np.sqrt(((fitted - truth) ** 2).mean()))
    solid = texel_solid_angles(*texels.shape[:2])[:, None, None]
    flux = float(luminance((texels.astype(np.float64) * solid).sum(axis=(0, 1))))
    fitted_flux = float(luminance(lobes.flux().sum(axis=0)))
    if scale <= 0.0 or flux <= 0.0:
        return error, abs(fitted_flux)
    return error / scale, abs(fitted_flux - flux) / flux
