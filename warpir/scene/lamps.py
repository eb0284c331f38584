"""Lamps: narrow strong parts of a light, such as the sun, separated from their surroundings.

One definition for lobes and maps: a lamp is what exceeds its surroundings within `LAMP_RADIUS_DEG`
and sends more than `LAMP_SHARE` of the light's flux.
"""

from dataclasses import dataclass, replace

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray
from warpir.core.color import luminance
from warpir.core.latlong import map_directions, resize_map, texel_solid_angles
from warpir.scene.light import Light

LAMP_SHARE = 0.03
"""Share of the flux above which a compact source counts [1]."""
LAMP_RADIUS_DEG = 6.0
"""Surroundings within which a compact source is measured [deg]; also the limit on a
lobe's standard deviation."""
LAMP_COUNT_MAX = 8
LAMP_SHARPNESS_MAX = 1e5
SUN_ROWS = 512
"""Most rows of a map whose lamps become suns [px]."""


@dataclass(frozen=True)
class MapLamps:
    """Compact sources of a map."""

    axes: Float64Array
    """Unit directions, world frame, shape [lamp, 3]."""
    sharpness: Float64Array
    """Sharpness of lobes with the lamps' spread, shape [lamp]."""
    near: list[BoolArray]
    """Texels of each lamp's surroundings, shape [He, We]."""
    rest: Float64Array
    """Luminance of the map without the lamps, shape [He, We]."""


def lamps_of(texels: FloatArray, limit: int = LAMP_COUNT_MAX) -> MapLamps:
    """Find compact sources: axis and sharpness by the moments of what exceeds the surroundings.

    Args:
        texels: Radiance, shape [He, We, 3].
        limit: Most lamps to find.
    """
    height, width = texels.shape[:2]
    directions = map_directions(height, width)
    omega = np.broadcast_to(texel_solid_angles(height, width)[:, None], (height, width))
    lum: Float64Array = np.asarray(luminance(texels.astype(np.float64)), np.float64)
    total = (lum * omega).sum()
    left = lum.copy()
    axes: list[Float64Array] = []
    sharpnesses: list[float] = []
    covered: list[BoolArray] = []
    while len(axes) < limit and total > 0.0:
        peak = directions[np.unravel_index(np.argmax(left), left.shape)]
        cosine = directions @ peak
        near = cosine > np.cos(np.radians(LAMP_RADIUS_DEG))
        ring = ~near & (cosine > np.cos(np.radians(2.0 * LAMP_RADIUS_DEG)))
        level = float(np.median(lum[ring])) if ring.any() else 0.0
        excess = np.maximum(left[near] - level, 0.0) * omega[near]
        if excess.sum() < LAMP_SHARE * total:
            break
        resultant = excess @ directions[near]
        axis = resultant / np.linalg.norm(resultant)
        # Mean of 1 - cos is 1 / sharpness for a sharp lobe.
        spread = float(excess @ (0.5 * ((directions[near] - axis) ** 2).sum(axis=-1)))
        spread /= float(excess.sum())
        axes.append(axis)
        sharpnesses.append(min(1.0 / max(spread, 1e-9), LAMP_SHARPNESS_MAX))
        covered.append(near)
        left[near] = np.minimum(left[near], level)
    if not axes:
        return MapLamps(np.zeros((0, 3)), np.zeros(0), [], left)
    return MapLamps(np.array(axes), np.array(sharpnesses), covered, left)


def without_lamps(light: Light, share: float = 1.0) -> Light:
    """Return the light less a share [1] of its lamps; the same object where it has none."""
    lobes, texels = light.lobes, light.texels
    is_lamp = _lamp_lobes(light)
    if lobes is not None and is_lamp.any():
        kept = np.where(is_lamp, 1.0 - share, 1.0)[:, None]
        lobes = replace(lobes, amplitude=(lobes.amplitude * kept).astype(np.float32))
    if texels is not None:
        lamps = lamps_of(texels)
        if len(lamps.axes):
            whole = luminance(texels.astype(np.float64))
            rest = np.where(whole > 0.0, lamps.rest / np.where(whole > 0.0, whole, 1.0), 1.0)
            kept = 1.0 - share * (1.0 - rest)
            texels = (texels * kept[..., None]).astype(np.float32)
    if lobes is light.lobes and texels is light.texels:
        return light
    return Light(lobes, texels)


def lamps_alone(light: Light) -> Light:
    """Return what `without_lamps` takes away."""
    rest = without_lamps(light)
    lobes, texels = light.lobes, light.texels
    if lobes is not None and rest.lobes is not None:
        lobes = replace(lobes, amplitude=lobes.amplitude - rest.lobes.amplitude)
    if texels is not None and rest.texels is not None:
        texels = np.maximum(texels - rest.texels, 0.0)
    return Light(lobes, texels)


@dataclass(frozen=True)
class Sun:
    """A lamp of a map as a disc at infinity."""

    axis: Float64Array
    """Unit direction toward it, world frame, shape [3]."""
    irradiance: Float64Array
    """Of a surface that faces it [W/m^2], RGB, shape [3]."""
    angle: float
    """Across the disc [rad]; its mean 1 - cos is the lamp's."""
    behind: Float64Array
    """Radiance within `LAMP_RADIUS_DEG` without it: the median of the ring around, RGB, shape [3].
    """


def suns_of(texels: FloatArray) -> list[Sun]:
    """Return a map's lamps; they and the map, with ``behind`` in their places, are the same light.

    Where two are near each other, the earlier one has been replaced before the later is measured.

    Args:
        texels: Radiance, shape [He, We, 3].
    """
    if texels.shape[0] > SUN_ROWS:
        texels = resize_map(texels, SUN_ROWS)
    lamps = lamps_of(texels)
    directions = map_directions(*texels.shape[:2])
    omega = np.broadcast_to(texel_solid_angles(*texels.shape[:2])[:, None], texels.shape[:2])
    near, far = np.cos(np.radians((LAMP_RADIUS_DEG, 2.0 * LAMP_RADIUS_DEG)))
    left = texels.astype(np.float64)
    suns = []
    for axis, sharpness in zip(lamps.axes, lamps.sharpness, strict=True):
        cosine = directions @ axis
        ring = (cosine > far) & (cosine <= near)
        behind = np.median(left[ring], axis=0) if ring.any() else np.zeros(3)
        inside = cosine > near
        excess = omega[inside] @ (left[inside] - behind)
        left[inside] = behind
        # A disc of radius r, small: mean 1 - cos = r^2 / 4.
        if excess.max() > 0.0:
            angle = 4.0 / float(np.sqrt(sharpness))
            suns.append(Sun(axis, np.maximum(excess, 0.0), angle, behind))
    return suns


def lamp_axes(light: Light) -> Float64Array:
    """Return the unit directions toward all lamps, world frame, shape [lamp, 3]."""
    axes = [np.zeros((0, 3))]
    if light.lobes is not None:
        axes.append(light.lobes.axis[_lamp_lobes(light)].astype(np.float64))
    if light.texels is not None:
        axes.append(lamps_of(light.texels).axes)
    return np.concatenate(axes)


def _lamp_lobes(light: Light) -> BoolArray:
    """Return which lobes are lamps, shape [lobe]."""
    if light.lobes is None:
        return np.zeros(0, bool)
    flux = luminance(light.lobes.flux())
    total = float(flux.sum())
    if light.texels is not None:
        omega = texel_solid_angles(*light.texels.shape[:2])[:, None]
        total += float((luminance(light.texels.astype(np.float64)) * omega).sum())
    narrow = light.lobes.sharpness > 1.0 / np.radians(LAMP_RADIUS_DEG) ** 2
    is_lamp: BoolArray = narrow & (flux > LAMP_SHARE * total)
    return is_lamp
