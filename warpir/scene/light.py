"""Light at infinity: spherical Gaussians plus a lat-long map, as plain arrays.

Frame: world, +Y up. Map: OpenEXR lat-long orientation (image centre = +Z, left quarter = +X).
Radiance is linear Rec.709, relative [W/(m^2 sr)].
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, in_bands
from warpir.core.color import luminance
from warpir.core.latlong import (
    latitudes,
    longitudes,
    map_directions,
    resize_map,
    rotate_map,
    texel_solid_angles,
    uv_of,
)

SUN_RADIUS_DEG = 0.2665
"""Mean angular radius of the sun [deg]."""


@dataclass(frozen=True)
class Lobes:
    """Spherical Gaussians ``amplitude * exp(sharpness * (dot(v, axis) - 1))``."""

    amplitude: FloatArray
    """Peak radiance, shape [lobe, 3]."""
    axis: FloatArray
    """Unit axes, world frame, shape [lobe, 3]."""
    sharpness: FloatArray
    """Concentration, 1 / sigma^2 [1], shape [lobe]."""

    def flux(self) -> Float64Array:
        """Integrate each lobe over the sphere: ``2 pi c / s (1 - exp(-2 s))``, shape [lobe, 3]."""
        s = self.sharpness.astype(np.float64)
        return self.amplitude * (2.0 * np.pi * -np.expm1(-2.0 * s) / s)[:, None]


@dataclass(frozen=True)
class Light:
    """The sum of some lobes and at most one map."""

    lobes: Lobes | None = None
    texels: FloatArray | None = None
    """Lat-long radiance, shape [He, We, 3]."""

    def scaled(self, factor: float) -> Light:
        """Return the light times ``factor``."""
        lobes = self.lobes
        if lobes is not None:
            lobes = replace(lobes, amplitude=(lobes.amplitude * factor).astype(np.float32))
        texels = self.texels
        if texels is not None:
            texels = (texels * np.float32(factor)).astype(np.float32, copy=False)
        return Light(lobes, texels)

    def rotated(self, degrees: float) -> Light:
        """Turn the light about +Y, counter-clockwise seen from above."""
        lobes = self.lobes
        if lobes is not None:
            a = np.radians(degrees)
            turn = np.array(
                [[np.cos(a), 0.0, np.sin(a)], [0.0, 1.0, 0.0], [-np.sin(a), 0.0, np.cos(a)]]
            )
            lobes = replace(lobes, axis=(lobes.axis @ turn.T).astype(np.float32))
        texels = self.texels
        if texels is not None:
            texels = rotate_map(texels, degrees)
        return Light(lobes, texels)

    def irradiance(self, normal: Float64Array) -> Float64Array:
        """Irradiance of a surface [W/m^2], RGB, by quadrature over a map of the whole light."""
        total = np.zeros(3)
        if self.texels is not None:
            height, width = self.texels.shape[:2]
            lon, lat = longitudes(width), latitudes(height)
            across = normal[0] * np.sin(lon) + normal[2] * np.cos(lon)
            solid_angles = texel_solid_angles(height, width)
            for row in range(height):  # the directions of a large map would take gigabytes
                cosine = np.cos(lat[row]) * across + np.sin(lat[row]) * normal[1]
                weight = np.maximum(cosine, 0.0) * solid_angles[row]
                total += weight @ self.texels[row].astype(np.float64)
        if self.lobes is not None:
            for flux, axis, s in zip(
                self.lobes.flux(), self.lobes.axis, self.lobes.sharpness, strict=True
            ):
                total += flux * lobe_cosine(float(np.dot(axis, normal)), float(s))
        return total


def lobe_cosine(cos_axis: float, sharpness: float) -> float:
    """Return the mean clamped cosine over a lobe's directions, by quadrature in its own frame.

    Args:
        cos_axis: Cosine between the lobe's axis and the surface normal.
        sharpness: Concentration of the lobe.
    """
    # Equal-probability rings of the lobe: t = 1 - cos of the angle to the axis.
    u = (np.arange(256) + 0.5) / 256.0
    t = np.clip(-np.log1p(u * np.expm1(-2.0 * sharpness)) / sharpness, 0.0, 2.0)
    phi = (np.arange(256) + 0.5) / 256.0 * 2.0 * np.pi
    sin_axis = np.sqrt(max(0.0, 1.0 - cos_axis * cos_axis))
    radial = np.sqrt(t * (2.0 - t))[:, None] * np.cos(phi)[None, :]
    cosine = (1.0 - t)[:, None] * cos_axis + radial * sin_axis
    return float(np.maximum(cosine, 0.0).mean())


def fibonacci(count: int) -> Float64Array:
    """Return evenly spread unit directions, world frame, shape [count, 3] (a Fibonacci spiral)."""
    k = np.arange(count) + 0.5
    y = 1.0 - 2.0 * k / count
    lon = np.pi * (1.0 + np.sqrt(5.0)) * k
    r = np.sqrt(1.0 - y * y)
    return np.stack([r * np.sin(lon), y, r * np.cos(lon)], axis=1)


def axis_from_angles(azimuth_deg: float, elevation_deg: float) -> Float64Array:
    """Return the unit direction toward (azimuth, elevation), world frame.

    Azimuth is measured from -Z (straight ahead of an unturned camera) clockwise seen from above, so
    +90 is to the right (+X).
    """
    a, e = np.radians(azimuth_deg), np.radians(elevation_deg)
    return np.array([np.cos(e) * np.sin(a), np.sin(e), -np.cos(e) * np.cos(a)])


def angles_from_axis(axis: Float64Array) -> tuple[float, float]:
    """Return (azimuth, elevation) [deg] of a direction; the inverse of `axis_from_angles`."""
    x, y, z = (float(c) for c in axis)
    return float(np.degrees(np.arctan2(x, -z))), float(np.degrees(np.arctan2(y, np.hypot(x, z))))


def sun_lobe(
    azimuth_deg: float, elevation_deg: float, irradiance: tuple[float, float, float]
) -> Lobes:
    """Return one lobe with the sun's angular size.

    Args:
        azimuth_deg: See `axis_from_angles` [deg].
        elevation_deg: Above the horizon [deg].
        irradiance: Irradiance of a surface that faces the sun, linear RGB, relative [W/m^2].
    """
    # A uniform disc of radius r has the per-axis variance r^2 / 4; a lobe has 1 / sharpness.
    sharpness = 4.0 / np.radians(SUN_RADIUS_DEG) ** 2
    amplitude = np.asarray(irradiance) * sharpness / (2.0 * np.pi)
    axis = axis_from_angles(azimuth_deg, elevation_deg)
    return Lobes(
        amplitude[None].astype(np.float32),
        axis[None].astype(np.float32),
        np.array([sharpness], np.float32),
    )


def plain_sky(sky: tuple[float, float, float], ground: tuple[float, float, float]) -> FloatArray:
    """Return a map of one colour above the horizon and another below, shape [64, 128, 3]."""
    texels = np.empty((64, 128, 3), np.float32)
    texels[:32] = sky
    texels[32:] = ground
    return texels


@dataclass(frozen=True)
class LightSummary:
    """Brightness, main direction and concentration of a light."""

    peak_luminance: float
    mean_luminance: float
    """Mean luminance over the sphere, relative [W/(m^2 sr)]."""
    azimuth_deg: float
    elevation_deg: float
    """Elevation of the brightest part [deg]."""
    peak_share: float
    """Share of the total flux within 5 degrees of the brightest part [1]."""


FAINTEST = 40.0
"""Exponent of a lobe's faintest part that a map holds [1]: below, float32 beside any light is 0."""


def rasterize_lobes(lobes: Lobes, height: int, width: int) -> FloatArray:
    """Return the mean radiance of the lobes in each texel, shape [height, width, 3].

    For files and summaries; power within 1 %. A lobe whose standard deviation is below a quarter of
    a texel is put into its texel with its flux.
    """
    texels = np.zeros((height, width, 3))
    lobes = _some(lobes, lobes.amplitude.max(axis=1) > 0.0)
    narrow = lobes.sharpness > (4.0 * height / np.pi) ** 2
    # A lobe of two texels and more is as good with few directions.
    broad = lobes.sharpness <= (height / (2.0 * np.pi)) ** 2
    _add_lobes(texels, _some(lobes, broad), 2, 1)
    _add_lobes(texels, _some(lobes, ~broad & ~narrow), 6, 6)
    omega = texel_solid_angles(height, width)
    for flux, axis in zip(lobes.flux()[narrow], lobes.axis[narrow], strict=True):
        u, v = uv_of(axis.astype(np.float64))
        i, j = min(int(v * height), height - 1), int(u * width) % width
        texels[i, j] += flux / omega[i]
    return texels.astype(np.float32)


def _add_lobes(texels: Float64Array, lobes: Lobes, along: int, across: int) -> None:
    """Add the mean of so many directions in each texel, an even number of rows and some columns."""
    height, width = texels.shape[:2]
    if len(lobes.sharpness) == 0:
        return
    # Rows at the two-point Gauss-Legendre nodes of even bands: midpoints misjudge a lobe at a pole
    # by up to 4 %.
    step = np.pi / (height * along)
    theta = (np.arange(height * along) // 2 * 2 + 1.0) * step
    theta += np.tile([-1.0, 1.0], height * along // 2) * step / np.sqrt(3.0)
    sin_theta, cos_theta = (f(theta).reshape(height, along, 1) for f in (np.sin, np.cos))
    # Within the texels at a pole, the points nearer to it stand for less of the sphere.
    share = sin_theta / sin_theta.sum(axis=1, keepdims=True)
    lon = longitudes(width * across)
    sharpness = lobes.sharpness.astype(np.float64)
    x, y, z = sharpness * lobes.axis.T.astype(np.float64)
    level = np.outer(x, np.sin(lon)) + np.outer(z, np.cos(lon))
    near = (_rows_near(*lobe, height) for lobe in zip(lobes.axis, sharpness, strict=True))
    first, last = np.array([(rows.start, rows.stop) for rows in near]).T

    def add(band: slice) -> None:
        here = np.flatnonzero((first < band.stop) & (last > band.start))
        if len(here) == 0:
            return
        # Shapes [rows, along, lobes, columns]; all lobes in one product with their colours.
        exponent = sin_theta[band, ..., None] * level[here]
        exponent += (cos_theta[band] * y[here] - sharpness[here])[..., None]
        fine = np.exp(exponent.astype(np.float32))
        if across > 1:
            fine = fine.reshape(*fine.shape[:-1], width, across).mean(axis=-1)
        weight = (share[band, ..., None] * lobes.amplitude[here]).reshape(len(fine), -1, 3)
        mean = weight.swapaxes(1, 2).astype(np.float32) @ fine.reshape(len(fine), -1, width)
        texels[band] += mean.swapaxes(1, 2)

    in_bands(add, height, width * along * across * len(sharpness) // 8)


def _rows_near(axis: FloatArray, sharpness: float, height: int) -> slice:
    """Return the rows of a map where a lobe is above ``exp(-FAINTEST)`` of its peak."""
    polar = np.arccos(np.clip(float(axis[1]), -1.0, 1.0))
    reach = np.arccos(1.0 - FAINTEST / max(float(sharpness), FAINTEST / 2.0))
    first = int((polar - reach) / np.pi * height)
    last = int((polar + reach) / np.pi * height)
    return slice(max(first - 1, 0), min(last + 2, height))


def _some(lobes: Lobes, chosen: BoolArray) -> Lobes:
    return Lobes(lobes.amplitude[chosen], lobes.axis[chosen], lobes.sharpness[chosen])


def as_map(light: Light, height: int) -> FloatArray:
    """Return the whole light as one map of ``height`` rows, for files and previews.

    A given map is resampled only if its size differs: averaged down, or repeated up.
    """
    width = 2 * height
    texels = np.zeros((height, width, 3), np.float32)
    if light.texels is not None:
        texels += resize_map(light.texels, height)
    if light.lobes is not None:
        texels += rasterize_lobes(light.lobes, height, width)
    return texels


def as_file_map(light: Light) -> FloatArray:
    """Return the light as a map for files: a given map's own size, lobes on 512 rows or more."""
    if light.texels is not None and light.lobes is None:
        return light.texels
    rows = 0 if light.texels is None else light.texels.shape[0]
    return as_map(light, max(rows, 512))


def summarize(light: Light) -> LightSummary:
    """Measure a light for printing and ``run.json``."""
    texels = as_map(light, 128).astype(np.float64)
    omega = texel_solid_angles(128, 256)[:, None]
    lum = luminance(texels)
    i, j = np.unravel_index(np.argmax(lum), lum.shape)
    directions = map_directions(128, 256)
    axis = directions[i, j]
    near = directions @ axis > np.cos(np.radians(5.0))
    flux = float((lum * omega).sum())
    azimuth, elevation = angles_from_axis(axis)
    return LightSummary(
        peak_luminance=float(lum.max()),
        mean_luminance=flux / (4.0 * np.pi),
        azimuth_deg=azimuth,
        elevation_deg=elevation,
        peak_share=float((lum * omega)[near].sum()) / flux if flux > 0.0 else 0.0,
    )


def bearing(axis: Float64Array, c2w: Float64Array) -> float:
    """Return a direction's azimuth from where a camera looks, clockwise seen from above [deg].

    Of a camera that looks straight up or down, what its picture shows at the bottom counts as
    behind.

    Args:
        axis: Unit direction, world frame, shape [3].
        c2w: Pose of the camera, shape [4, 4].
    """
    level = np.array([1.0, 0.0, 1.0])
    ahead = -np.asarray(c2w, np.float64)[:3, 2] * level
    if float(np.linalg.norm(ahead)) < 1e-3:
        ahead = np.asarray(c2w, np.float64)[:3, 1] * level
    right = np.array([-ahead[2], 0.0, ahead[0]])  # ahead x up
    return float(np.degrees(np.arctan2(axis @ right, axis @ ahead)))


def describe(summary: LightSummary, c2w: Float64Array) -> str:
    """Return a light in words, as a person at the camera would point at it.

    Args:
        summary: Summary of the light, in the world frame.
        c2w: Pose of the camera, shape [4, 4].
    """
    axis = axis_from_angles(summary.azimuth_deg, summary.elevation_deg)
    around = bearing(axis, c2w) % 360.0
    sides = (
        *("ahead", "ahead on the right", "the right", "behind on the right"),
        *("behind", "behind on the left", "the left", "ahead on the left"),
    )
    side = sides[round(around / 45.0) % 8]
    is_overhead = summary.elevation_deg > 75.0
    where = "overhead" if is_overhead else f"from {side}, {summary.elevation_deg:.0f} deg high"
    return f"light {where}, {100.0 * summary.peak_share:.0f} % of it from there"
