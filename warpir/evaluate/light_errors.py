"""Errors of a light against the true one: directions, ratios, exposure and colour.

Both maps are lat-long, in one and the same frame (+Y up) and unit; errors are measured after both
were averaged down to 128 x 256 texels.

A map of one colour has no brightest direction. Wherever a direction is missing, an angle counts
as 90 degrees, the mean over random guesses, so that an absent answer never beats guessing.

Sources: the angle between brightest directions after Hold-Geoffroy et al. 2019
(https://arxiv.org/abs/1905.03897) and LuxDiT (https://arxiv.org/abs/2509.03680), who do not state
their smoothing; the directional error after EnvMapNet (Somanath & Kurz 2021,
https://arxiv.org/abs/2011.10687).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from scipy.ndimage import binary_dilation, label
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from warpir.core.arrays import BoolArray, Float64Array, FloatArray, Int64Array, IntArray
from warpir.core.color import luminance
from warpir.core.latlong import (
    directions_at,
    latitudes,
    map_directions,
    resize_map,
    texel_solid_angles,
)
from warpir.scene.light import angles_from_axis

HEIGHT = 128
"""Rows of the maps that are compared; there are twice as many columns."""
CHANCE_DEG = 90.0
"""Mean angle between a direction and a random one: what a missing direction counts as [deg]."""
PEAK_CONTRAST = 1.001
"""A map has a direction when its brightest texel exceeds its mean by this factor [1]."""
BRIGHT_PERCENTILE = 95.0
"""Luminance above this percentile of the sphere has the bright centroid [%]."""
SUNNY_SHARE = 0.25
"""Share of the flux that the truth's brightest 5 degrees hold when it counts as sunny [1].

The light of 20 panoramas falls into two groups at this value: at most .17, and .33 to .79.
"""
SUNNY_RADIUS_DEG = 5.0
"""Half angle of the cap of `SUNNY_SHARE` [deg]."""
SUN_RADIUS_DEG = 20.0
"""Half angle of the cap whose flux is the sun's in the sun/sky ratio [deg]; wide enough for a lobe
that stands for a sun without knowing it sharply."""
DARK = 1e-9
"""Added to every texel's flux, over the true map's mean, so that black has a logarithm [1]."""
SHARE_FLOOR = 1e-4
"""Shares of the flux are clipped this far from 0 and 1 before their logarithm."""

LIGHT_COUNT_MAX = 5
"""Lights of a map that the directional error compares (EnvMapNet)."""
BLOB_COUNT_MAX = 15
"""Blobs that the search for lights finds at most (as all that follow, EnvMapNet)."""
BLOB_RATIO = 0.3
"""A blob reaches down to this share of its peak [1]."""
REST_ENERGY = 0.2
"""The search ends when less than this share of the energy is left [1]."""
REST_AREA = 0.1
"""The search ends when less than this share of the texels is left [1]."""
AREA_MAX = 0.5
"""A blob of more than this share of the map is ambient light [1]."""
LENGTH_MAX = 0.9
"""A blob longer than this share of the map's width is ambient light too [1]."""

Axis = Float64Array | None
"""A unit direction, or nothing where a map has none."""


@dataclass(frozen=True)
class _Directions:
    """Main directions of one map."""

    peak: Axis
    """Direction of the brightest texel; the centroid of several equally bright ones."""
    bright: Axis
    """Luminance centroid above `BRIGHT_PERCENTILE`."""
    blob: Axis
    """Luminance centroid of the texels above half the peak that touch it."""


def light_errors(predicted: FloatArray, true: FloatArray) -> dict[str, float]:
    """Return the errors of a light against the truth.

    Args:
        predicted: Radiance, lat-long, shape [He, 2 He, 3].
        true: True light in the same frame and unit, of any size.

    Returns:
        * ``peak_angle_deg``, ``bright_angle_deg``, ``blob_angle_deg``: angle between the brightest
          texels, between the luminance centroids above the 95th percentile of the sphere, and
          between the centroids of the connected texels above half the peak [deg].
        * ``azimuth_error_deg``, ``elevation_error_deg``: of the brightest texel, absolute [deg];
          absent where either map has no direction.
        * ``log_sun_sky_ratio_error``: signed, of the natural logarithm of the flux within 20
          degrees of the centroid of the true map's blob over the flux of the rest, in both maps.
        * ``log_own_sun_sky_ratio_error``: the same with each map's cap around its own blob, so
          that a sun of the right strength in the wrong place counts as right.
        * ``log_flux_error``: natural logarithm of predicted over true mean luminance (exposure).
        * ``rgb_angle_deg``: angle between the RGB vectors of the total flux [deg].
        * ``ambient_log_error``, ``ambient_red_log_error``, ``ambient_blue_log_error``: of all light
          beyond 20 degrees of each map's own blob, the mean over directions of the absolute log
          ratio of irradiances, and the absolute errors of the logarithms of red over green and blue
          over green of the flux.
        * ``true_peak_share``, ``true_is_sunny``: share of the true flux within 5 degrees of its
          peak, and 1 where it is at least `SUNNY_SHARE`, else 0.
        * ``predicted_has_direction``: 0 for a map of one colour, else 1.
        * ``directional_deg``: `directional_error`; absent where the truth has no light to find.
        * ``directional_published_deg``: as the published code has it, see `published_lights_of`;
          absent where either map has no light, for there the code leaves the map out.

    Raises:
        ValueError: Not two lat-long maps, or one is black, negative or not finite.
    """
    maps = checked_maps(predicted, true)
    lum = [_luminance(texels) for texels in maps]
    flux = [texels * _solid_angles()[..., None] for texels in maps]
    predicted_axes, wanted = (_directions(values) for values in lum)
    total, true_total = (part.sum(axis=(0, 1)) for part in flux)
    errors = _angle_errors(predicted_axes, wanted)
    shared = _sun_axis(wanted.blob, predicted_axes.blob)
    errors["log_sun_sky_ratio_error"] = _log_ratio(lum[0], shared) - _log_ratio(lum[1], shared)
    errors["log_own_sun_sky_ratio_error"] = _log_ratio(
        lum[0], _sun_axis(predicted_axes.blob, wanted.blob)
    ) - _log_ratio(lum[1], shared)
    errors["log_flux_error"] = float(np.log(luminance(total) / luminance(true_total)))
    errors["rgb_angle_deg"] = _angle_deg(
        total / np.linalg.norm(total), true_total / np.linalg.norm(true_total)
    )
    errors |= _ambient_errors(maps, [predicted_axes.blob, wanted.blob])
    share = 0.0 if wanted.peak is None else _cap_share(lum[1], wanted.peak, SUNNY_RADIUS_DEG)
    errors["true_peak_share"] = share
    errors["true_is_sunny"] = float(share >= SUNNY_SHARE)
    errors["predicted_has_direction"] = float(predicted_axes.peak is not None)
    return errors | _directional_errors(maps)


def _ambient_errors(maps: list[Float64Array], blobs: list[Axis]) -> dict[str, float]:
    """Return the errors of what lies beyond `SUN_RADIUS_DEG` of each map's own blob."""
    irradiance, ratios = [], []
    for texels, blob in zip(maps, blobs, strict=True):
        flux = texels * _solid_angles()[..., None]
        if blob is not None:
            flux[_texel_directions() @ blob > np.cos(np.radians(SUN_RADIUS_DEG))] = 0.0
        flux = flux.reshape(-1, 3) + DARK * maps[1].mean()
        red, green, blue = flux.sum(axis=0)
        ratios.append(np.log([red / green, blue / green]))
        irradiance.append(_surface_cosines() @ luminance(flux))
    off = np.abs(ratios[0] - ratios[1])
    level = np.abs(np.log(irradiance[0] / irradiance[1])).mean()
    names = ("ambient_log_error", "ambient_red_log_error", "ambient_blue_log_error")
    return dict(zip(names, map(float, (level, *off)), strict=True))


@cache
def _surface_cosines() -> Float64Array:
    """Return the positive part of the cosines of 26 surfaces and texels, shape [26, texel].

    The surfaces face the faces, edges and corners of a cube.
    """
    steps = np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))
    normals = steps[np.abs(steps).sum(axis=1) > 0.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosines: Float64Array = np.maximum(normals @ _texel_directions().reshape(-1, 3).T, 0.0)
    return cosines


def _angle_errors(predicted: _Directions, wanted: _Directions) -> dict[str, float]:
    """Return the angles between the directions of two maps [deg]."""
    errors = {
        "peak_angle_deg": _angle_deg(predicted.peak, wanted.peak),
        "bright_angle_deg": _angle_deg(predicted.bright, wanted.bright),
        "blob_angle_deg": _angle_deg(predicted.blob, wanted.blob),
    }
    if predicted.peak is not None and wanted.peak is not None:
        azimuth, elevation = angles_from_axis(predicted.peak)
        true_azimuth, true_elevation = angles_from_axis(wanted.peak)
        turn = (azimuth - true_azimuth + 180.0) % 360.0 - 180.0
        errors["azimuth_error_deg"] = abs(turn)
        errors["elevation_error_deg"] = abs(elevation - true_elevation)
    return errors


def _directional_errors(maps: list[Float64Array]) -> dict[str, float]:
    """Return the directional errors of a predicted map and a true one, as far as they exist."""
    errors = {}
    true_lights = lights_of(maps[1])
    if len(true_lights):
        errors["directional_deg"] = directional_error(lights_of(maps[0]), true_lights)
    published = [published_lights_of(texels) for texels in maps]
    if all(len(lights) for lights in published):
        # The code doubles a single light and cuts both lists to the length of the shorter one.
        pair = [lights if len(lights) > 1 else np.tile(lights, (2, 1)) for lights in published]
        count = min(len(lights) for lights in pair)
        errors["directional_published_deg"] = directional_error(pair[0][:count], pair[1][:count])
    return errors


def sun_sky_ratio_error(predicted: FloatArray, true: FloatArray) -> float:
    """Return ``log_sun_sky_ratio_error`` of `light_errors` alone."""
    lum, true_lum = (_luminance(texels) for texels in checked_maps(predicted, true))
    axis = _sun_axis(_directions(true_lum).blob, _directions(lum).blob)
    return _log_ratio(lum, axis) - _log_ratio(true_lum, axis)


def checked_maps(*maps: FloatArray) -> list[Float64Array]:
    """Return maps as float64, averaged to 128 x 256 texels.

    Raises:
        ValueError: One is not a lat-long map of finite radiance >= 0, or is black.
    """
    for texels in maps:
        if texels.ndim != 3 or texels.shape[2] != 3 or texels.shape[1] != 2 * texels.shape[0]:
            raise ValueError(f"not a lat-long map: shape {texels.shape}, expected [He, 2 He, 3]")
        if not bool((np.isfinite(texels) & (texels >= 0.0)).all()):
            raise ValueError("radiance is negative or not finite")
        if not texels.any():
            raise ValueError("the map is black: it has no light to compare")
    return [resize_map(texels, HEIGHT).astype(np.float64) for texels in maps]


# ------------------------------------------------------------------------------- directions


@cache
def _texel_directions() -> Float64Array:
    """Return `map_directions` at the size that is compared."""
    return map_directions(HEIGHT, 2 * HEIGHT)


@cache
def _solid_angles() -> Float64Array:
    """Return the solid angle of every texel [sr], shape [128, 256]."""
    column = texel_solid_angles(HEIGHT, 2 * HEIGHT)[:, None]
    return np.broadcast_to(column, (HEIGHT, 2 * HEIGHT)).copy()


def _luminance(texels: Float64Array) -> Float64Array:
    """Return the luminance of a map in float64."""
    lum: Float64Array = luminance(texels).astype(np.float64, copy=False)
    return lum


def _directions(lum: Float64Array) -> _Directions:
    """Return the main directions of a map of luminance, shape [128, 256]."""
    energy = lum * _solid_angles()
    top = float(lum.max())
    if top <= PEAK_CONTRAST * energy.sum() / (4.0 * np.pi):
        return _Directions(None, None, None)
    # Clipped maps have many brightest texels; the first in memory would be an arbitrary choice.
    brightest = lum == top
    order = np.argsort(lum, axis=None)
    covered = np.cumsum(_solid_angles().ravel()[order]) / (4.0 * np.pi)
    threshold = lum.ravel()[order][int(np.searchsorted(covered, BRIGHT_PERCENTILE / 100.0))]
    return _Directions(
        _centroid(energy, brightest),
        _centroid(energy, lum >= threshold),
        _centroid(energy, _touching(lum >= 0.5 * top, brightest)),
    )


def _centroid(energy: Float64Array, mask: BoolArray) -> Axis:
    """Return the mean direction of the energy within a mask, or nothing where it cancels."""
    total = (energy[mask][:, None] * _texel_directions()[mask]).sum(axis=0)
    length = float(np.linalg.norm(total))
    return total / length if length > 1e-6 * float(energy[mask].sum()) else None


def _angle_deg(a: Axis, b: Axis) -> float:
    """Return the angle of two unit directions [deg]; `CHANCE_DEG` where one is missing."""
    if a is None or b is None:
        return CHANCE_DEG
    # Kahan: exact near 0 and 180 degrees, where the arc cosine is not.
    half = np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b))
    return float(np.degrees(2.0 * half))


@cache
def _neighbours() -> tuple[Int64Array, Int64Array]:
    """Return the pairs of texels that touch on the sphere: also over the seam and the poles."""
    width = 2 * HEIGHT
    index = np.arange(HEIGHT * width).reshape(HEIGHT, width)
    pairs = [(index, np.roll(index, -1, axis=1))]
    pairs += [(index[:-1], np.roll(index[1:], shift, axis=1)) for shift in (-1, 0, 1)]
    pairs += [(index[row], np.roll(index[row], HEIGHT)) for row in (0, -1)]
    first, second = (np.concatenate([pair[k].ravel() for pair in pairs]) for k in (0, 1))
    return first, second


def _parts(mask: BoolArray) -> IntArray:
    """Number the connected parts of a mask, shape [128, 256]; each other texel is alone."""
    first, second = _neighbours()
    flat = mask.ravel()
    kept = flat[first] & flat[second]
    edges = (np.ones(int(kept.sum()), np.int8), (first[kept], second[kept]))
    _, parts = connected_components(coo_array(edges, shape=(mask.size, mask.size)), directed=False)
    return np.asarray(parts, np.int32).reshape(mask.shape)


def _touching(mask: BoolArray, seeds: BoolArray) -> BoolArray:
    """Return the texels of a mask that are connected to one of some seeds within it."""
    parts = _parts(mask)
    return mask & np.isin(parts, parts[seeds])


# ----------------------------------------------------------------------------------- ratios


def _sun_axis(first: Axis, second: Axis) -> Float64Array:
    """Return the direction of the cap: the second where the first has none, up where both lack."""
    for axis in (first, second):
        if axis is not None:
            return axis
    return np.array([0.0, 1.0, 0.0])


def _cap_share(lum: Float64Array, axis: Float64Array, radius_deg: float) -> float:
    """Return the share of a map's flux that comes from within an angle of a direction."""
    energy = lum * _solid_angles()
    near = _texel_directions() @ axis > np.cos(np.radians(radius_deg))
    return float(energy[near].sum() / energy.sum())


def _log_ratio(lum: Float64Array, axis: Float64Array) -> float:
    """Return the logarithm of the flux within `SUN_RADIUS_DEG` of an axis over the rest."""
    share = np.clip(_cap_share(lum, axis, SUN_RADIUS_DEG), SHARE_FLOOR, 1.0 - SHARE_FLOOR)
    return float(np.log(share / (1.0 - share)))


# ------------------------------------------------------------------- EnvMapNet's directional error


def directional_error(predicted: Float64Array, true: Float64Array) -> float:
    """Return the symmetric mean of the angles to the nearest light [deg] (EnvMapNet).

    Args:
        predicted: Unit directions of the predicted lights, shape [light, 3]; none give
            `CHANCE_DEG`.
        true: Directions of the true lights, at least one.
    """
    if not len(predicted):
        return CHANCE_DEG
    chord = np.linalg.norm(predicted[:, None] - true[None], axis=-1)
    angle = 2.0 * np.degrees(np.arcsin(np.clip(0.5 * chord, 0.0, 1.0)))
    nearest = np.concatenate([angle.min(axis=0), angle.min(axis=1)])
    return float(nearest.mean())


def _blobs(
    values: Float64Array,
    energy: Float64Array,
    touching: Callable[[BoolArray, BoolArray], BoolArray],
) -> Iterator[BoolArray]:
    """Yield blobs of light, each around the brightest texel that is left.

    Values define a blob's peak and edge, the energy ends the search; shape [128, 256] each.
    """
    left = np.ones(values.shape, bool)
    for _ in range(BLOB_COUNT_MAX):
        peak = float(values[left].max())
        blob = touching(left & (values >= BLOB_RATIO * peak), left & (values >= peak))
        yield blob
        left &= ~blob
        if left.mean() < REST_AREA or energy[left].sum() < REST_ENERGY * energy.sum():
            return


def lights_of(texels: Float64Array) -> Float64Array:
    """Return the directions of a map's lights, the one of most flux first, shape [light, 3].

    EnvMapNet's search with its slips put right: luminance, connected over seam and poles, centres
    weighted by energy, at most five and the brightest ones.

    Args:
        texels: Radiance, shape [128, 256, 3].
    """
    lum = _luminance(texels)
    if _directions(lum).peak is None:
        return np.zeros((0, 3))
    energy = lum * _solid_angles()
    mask = np.zeros(lum.shape, bool)
    for blob in _blobs(lum, energy, _touching):
        if float(_solid_angles()[blob].sum()) <= AREA_MAX * 4.0 * np.pi:
            mask |= blob
    parts = _parts(mask)
    blobs = [(energy * (parts == part), parts == part) for part in np.unique(parts[mask])]
    blobs.sort(key=lambda light: -float(light[0].sum()))
    axes = [_centroid(light, where) for light, where in blobs[:LIGHT_COUNT_MAX]]
    return np.array([axis for axis in axes if axis is not None]).reshape(-1, 3)


def published_lights_of(texels: Float64Array) -> Float64Array:
    """Return the directions of a map's lights as the published code finds them, shape [light, 3].

    Its grey is the blue channel alone, blobs end at the map's edge, "the first five" are the first
    from the top of the map, and pixel centres are moved by a half to the lower right. One thing
    differs: the centre is the mean of the blob's texels, there that of an ellipse fitted to its
    contour.

    Args:
        texels: Radiance, shape [128, 256, 3].
    """
    grey = texels[..., 2]
    if grey.max() <= PEAK_CONTRAST * grey.mean():
        return np.zeros((0, 3))
    energy = grey * np.cos(latitudes(HEIGHT))[:, None]

    def touching(mask: BoolArray, seeds: BoolArray) -> BoolArray:
        parts, _ = label(mask, np.ones((3, 3)))
        where: BoolArray = np.isin(parts, parts[seeds]) & mask
        return where

    mask = np.zeros(grey.shape, bool)
    for blob in _blobs(energy, energy, touching):
        columns = np.flatnonzero(blob.any(axis=0))
        is_long = np.ptp(columns) + 1 > LENGTH_MAX * blob.shape[1]
        if blob.mean() <= AREA_MAX and not is_long:
            mask |= blob
    parts, count = label(binary_dilation(mask, np.ones((2, 2))), np.ones((3, 3)))
    centres = [
        [float(np.mean(where)) for where in np.nonzero(parts == part)]
        for part in range(1, min(count, LIGHT_COUNT_MAX) + 1)
    ]
    rows, columns = np.array(centres).reshape(-1, 2).T
    lat, lon = np.pi * (0.5 - (rows + 1.0) / HEIGHT), np.pi * (1.0 - (columns + 1.0) / HEIGHT)
    return np.diagonal(directions_at(lat, lon)).T
