"""The demo's light: a clear-day sky with a sun, thin clouds and a ground, as a lat-long map.

Perez sky with the coefficients of Preetham, Shirley and Smits, "A Practical Analytic Model for
Daylight" (1999); the map has the OpenEXR orientation (centre +Z, left quarter +X).
"""

import numpy as np

from tools.demo.noise import value_noise
from warpir.core.arrays import Float64Array, FloatArray
from warpir.core.latlong import directions_at, map_directions, texel_solid_angles, uv_of
from warpir.scene.light import axis_from_angles

SUN_AZIMUTH, SUN_ELEVATION = -136.0, 37.0
"""Sun: azimuth from -Z toward +X (negative: to the left, behind the camera); elevation [deg]."""
SUN_RADIUS = 0.267
"""Angular radius of the sun's disc [deg]."""
SKY_IRRADIANCE, SUN_TO_SKY = 0.78, 4.6
"""Of the sky without the sun on level ground, rel. [W/m^2]; the sun's share relative to it [1]."""
SUN_TINT = np.array([1.0, 0.92, 0.80])
GROUND_ALBEDO = np.array([0.27, 0.255, 0.235])
TURBIDITY = 3.0
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
XYZ_TO_REC709 = np.array(
    [
        [3.2404542, -1.5371385, -0.4985314],
        [-0.9692660, 1.8760108, 0.0415560],
        [0.0556434, -0.2040259, 1.0572252],
    ]
)

PEREZ = {
    "Y": (0.1787, -1.4630, -0.3554, 0.4275, -0.0227, 5.3251, 0.1206, -2.5771, -0.0670, 0.3703),
    "x": (-0.0193, -0.2592, -0.0665, 0.0008, -0.0004, 0.2125, -0.0641, -0.8989, -0.0033, 0.0452),
    "y": (-0.0167, -0.2608, -0.0950, 0.0092, -0.0079, 0.2102, -0.0441, -1.6537, -0.0109, 0.0529),
}
"""A to E of (Perez 1993), each linear in turbidity: slope, intercept."""
ZENITH = {
    "x": (
        (0.00166, -0.00375, 0.00209, 0.0),
        (-0.02903, 0.06377, -0.03202, 0.00394),
        (0.11693, -0.21196, 0.06052, 0.25886),
    ),
    "y": (
        (0.00275, -0.00610, 0.00317, 0.0),
        (-0.04214, 0.08970, -0.04153, 0.00516),
        (0.15346, -0.26756, 0.06670, 0.26688),
    ),
}
"""Zenith chromaticity: rows for turbidity^2, turbidity, 1; cubic in the sun's zenith angle."""


def sun_direction() -> Float64Array:
    """Return the unit direction toward the sun, world frame, shape [3]."""
    return axis_from_angles(SUN_AZIMUTH, SUN_ELEVATION)


def _perez(
    name: str, cos_zenith: Float64Array | float, gamma: Float64Array | float
) -> Float64Array:
    """Evaluate Perez' function at the cosine of a zenith angle and an angle to the sun."""
    a, b, c, d, e = (PEREZ[name][2 * k] * TURBIDITY + PEREZ[name][2 * k + 1] for k in range(5))
    value: Float64Array = np.asarray(
        (1.0 + a * np.exp(b / cos_zenith)) * (1.0 + c * np.exp(d * gamma) + e * np.cos(gamma) ** 2)
    )
    return value


def _clear_sky(direction: Float64Array) -> Float64Array:
    """Return sky radiance above the horizon up to a factor, linear Rec.709."""
    sun = sun_direction()
    theta_sun = np.arccos(sun[1])
    cos_zenith = np.maximum(direction[..., 1], 0.015)
    gamma = np.arccos(np.clip(direction @ sun, -1.0, 1.0))
    ratio = {name: _perez(name, cos_zenith, gamma) / _perez(name, 1.0, theta_sun) for name in PEREZ}
    powers = theta_sun ** np.array([3.0, 2.0, 1.0, 0.0])
    turbidity = TURBIDITY ** np.array([2.0, 1.0, 0.0])
    x, y = (ratio[name] * (turbidity @ np.array(ZENITH[name]) @ powers) for name in "xy")
    luminance = ratio["Y"]
    xyz = np.stack([x / y * luminance, luminance, (1.0 - x - y) / y * luminance], axis=-1)
    radiance: Float64Array = np.maximum(xyz @ XYZ_TO_REC709.T, 0.0)
    return radiance


def _clouds(direction: Float64Array) -> Float64Array:
    """Return the cover of thin fair-weather clouds, 0 to 1."""
    high = np.maximum(direction[..., 1], 0.0)
    flat = direction[..., [0, 2]] / (high + 0.12)[..., None]
    density = np.zeros(high.shape)
    for octave in range(6):
        scale = 1.35 * 2.0**octave
        density += 0.5 ** (octave + 1) * value_noise(
            flat[..., 0] * scale * 0.75, flat[..., 1] * scale, seed=11 + octave
        )
    cover = np.clip((density - 0.57) / 0.28, 0.0, 1.0)
    cover = cover * cover * (3.0 - 2.0 * cover)
    return np.asarray(cover * np.clip((high - 0.015) / 0.10, 0.0, 1.0))


def _sun(height: int) -> Float64Array:
    """Return the share of each texel that the sun's disc covers [1], shape [H, W]."""
    sun = sun_direction()
    u, v = uv_of(sun)
    row, column = float(v) * height, float(u) * 2 * height
    reach = int(np.ceil(SUN_RADIUS / 180.0 * height / np.cos(np.radians(SUN_ELEVATION)))) + 1
    rows = np.arange(int(row) - reach, int(row) + reach + 1)
    columns = np.arange(int(column) - reach, int(column) + reach + 1)
    fine = 16
    inner: Float64Array = (np.arange(fine) + 0.5) / fine
    direction = directions_at(
        np.pi * (0.5 - np.add.outer(rows, inner).ravel() / height),
        np.pi * (1.0 - np.add.outer(columns, inner).ravel() / height),
    )
    inside = direction @ sun > np.cos(np.radians(SUN_RADIUS))
    share = inside.reshape(len(rows), fine, len(columns), fine).mean(axis=(1, 3))
    cover = np.zeros((height, 2 * height))
    cover[np.ix_(rows, columns % (2 * height))] = share
    return cover


def sky(height: int = 512) -> FloatArray:
    """Make the light.

    The sun's energy is exact at every resolution: its disc is spread over the texels it covers.

    Args:
        height: Rows of the map; it is twice as wide.

    Returns:
        Radiance, linear Rec.709, relative [W/(m^2 sr)], shape [height, 2 height, 3].
    """
    direction = map_directions(height, 2 * height)
    omega = texel_solid_angles(height, 2 * height)[:, None]
    up = direction[..., 1]
    texels = _clear_sky(direction)
    cover = _clouds(direction)[..., None]
    level = float(np.median((texels @ LUMINANCE)[up > 0.0]))
    glow = 0.35 * np.clip(direction @ sun_direction(), 0.0, 1.0)[..., None] ** 4
    haze = 0.9 * np.exp(-np.maximum(up, 0.0) / 0.22)[..., None]
    texels += haze * (level * np.array([2.5, 3.7, 5.4]) - texels)
    texels += 0.9 * cover * (level * (7.0 + glow) * np.array([1.0, 0.99, 0.98]) - texels)

    # Scale the sky to its irradiance, then add the sun and the ground.
    falling = np.maximum(up, 0.0) * omega
    texels *= SKY_IRRADIANCE / float((texels @ LUMINANCE * falling).sum())
    sun_level = SUN_TO_SKY * SKY_IRRADIANCE
    tint = SUN_TINT / (SUN_TINT @ LUMINANCE)
    disc = _sun(height)
    sun_radiance = sun_level / float((disc * falling).sum())
    irradiance = np.einsum("hwc,hw->c", texels, falling) + sun_level * tint
    ground = GROUND_ALBEDO * irradiance / np.pi
    horizon = texels[np.argmin(np.abs(up[:, 0] - 0.02))].mean(axis=0)
    blend = 0.5 * np.exp(np.minimum(up, 0.0) / 0.03)[..., None]
    below = blend * horizon + (1.0 - blend) * ground
    texels = np.where(up[..., None] > 0.0, texels, below)
    texels += sun_radiance * tint * disc[..., None]
    return texels.astype(np.float32)
