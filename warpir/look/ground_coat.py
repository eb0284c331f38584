"""Whether the ground of a photo shows mirror images, and how rough its coat then is.

The photo is unrolled to azimuth and elevation. A flat, coated ground shows what stands on it upside
down below its foot, in the same azimuth, times Fresnel's share and blurred by the coat's lobe. Such
images are predicted from the photo itself and compared with what is left of the ground's luminance
once its mean along azimuth is taken off. A roughness is stated only where the prediction explains
the ground clearly better than the same prediction displaced sideways or flipped left to right, and
where near and far ground agree about its strength, which is about Fresnel's: walls and posts that
go on below the horizon, shadows and texture pass some of these tests, but not all.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates

from warpir.core.arrays import AnyFloatArray, Float64Array
from warpir.core.color import luminance
from warpir.scene.camera import Camera

STEP = 0.4
"""Of azimuth and elevation [deg]."""
ROUGHNESSES = (0.05, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
"""Perceptual roughnesses of the coat that are tried [1]."""
FEET = (0.0, 0.04, 0.08, 0.12, 0.17, 0.23, 0.3, 0.4, 0.55)
"""Where what is mirrored may stand: the camera's height over the distance [1]."""
LOWEST, HIGHEST, LEVEL = -40.0, -5.0, 80.0
"""Elevations of the ground that is looked at, and largest azimuth and elevation [deg]."""
NORMALS = 64
"""Normals of the coat per roughness."""
DETAIL = 4.0
"""Standard deviation of the mean along azimuth that is taken off [deg]."""
SECTOR = 10.0
"""Width of what stands at one distance [deg]."""
DISPLACED = 8.0
"""Least sideways displacement of a prediction that cannot be right [deg]."""
KNOWN, MIDDLE = 0.6, 0.2
"""Least share of the lobe that the photo shows, of a coat of the second roughness [1]."""
BANDS = 3
"""Bands of elevation that must agree."""
INDEX = 1.5
"""Refractive index of the coat, as the renderer has it [1]."""
FAINT = 1e-3
"""Squares of a prediction in a sector, over the largest, that explain nothing yet [1]."""
BLACK = 1e-3
"""Display-linear value below which contrasts are not relative any more [1]."""
CLEARLY = 1.15
"""Least share of the variance explained over the best displaced prediction's [1]."""
AGREEMENT = 0.25
"""Least correlation in each band [1]."""
STRENGTH = (0.15, 1.3)
"""Strength of the image over Fresnel's, in all bands together: sources that the camera clips make
it larger, a mean that is taken off smaller [1]."""
UNEVEN = 3.0
"""Most that the strengths of two bands may differ by [1]."""


@dataclass(frozen=True)
class GroundCoat:
    """What a photo says of its ground's coat."""

    roughness: float | None
    """Perceptual roughness [1]; None: no mirror image is found."""
    spread: float | None
    """Standard deviation of the roughness over sectors of azimuth (jackknife) [1]."""
    reason: str
    """Why there is none, in one line; empty where there is one."""
    explained: float = 0.0
    """Share of the ground's contrasts that the best prediction explains [1]."""
    over_displaced: float = 0.0
    """The same over what the best displaced prediction explains [1]."""
    strength: float = 0.0
    """Of the mirror image, over Fresnel's [1]."""
    bands: tuple[tuple[float, float], ...] = ()
    """(correlation, strength) in bands of the ground, from the horizon down [1]."""

    @property
    def line(self) -> str:
        """What was found, a sentence."""
        if self.roughness is None:
            return f"the ground is matt: {self.reason} (--ground-roughness)"
        return (
            f"the ground mirrors with the roughness {self.roughness:.2f} +- {self.spread:.2f}: the "
            f"photo's mirror images explain {100.0 * self.explained:.0f} % of its contrasts, "
            f"{self.over_displaced:.1f} times as much as displaced ones (--ground-roughness)"
        )

    def record(self) -> dict[str, Any]:
        """Return what ``run.json`` holds."""
        return asdict(self)


@dataclass(frozen=True)
class _View:
    """A photo by azimuth and elevation, and the rows of it that may be ground."""

    values: Float64Array
    """Luminance, 0 outside the photo, shape [row, column]."""
    inside: Float64Array
    """1 in the photo, else 0, shape [row, column]."""
    elevation: Float64Array
    """Of the rows, falling [deg]."""
    rows: NDArray[np.intp]
    """Indices of the ground's rows, shape [ground row]."""

    @property
    def depression(self) -> Float64Array:
        """Of the ground's rows below the horizon [rad], shape [ground row]."""
        return np.asarray(np.radians(-self.elevation[self.rows]))


@dataclass(frozen=True)
class _Ground:
    """Contrasts of the ground along azimuth, shape [ground row, column] each."""

    detail: Float64Array
    """Luminance over its mean, less 1 [1]."""
    mean: Float64Array
    weight: Float64Array
    """0 outside the photo; each row has about the same weight times square of detail."""
    inside: Float64Array


def estimate_coat(linear: AnyFloatArray, camera: Camera, up: Float64Array) -> GroundCoat:
    """Estimate the roughness of the ground's coat, where the photo shows mirror images on it.

    Args:
        linear: Display-linear photo, shape [H, W, 3].
        camera: Of the photo.
        up: The ground's unit normal, world frame, shape [3].
    """
    view = _unrolled(linear, camera, up)
    if len(view.rows) < 10 or view.elevation[0] < 3.0:
        return GroundCoat(None, None, "the photo does not show ground and what it would mirror")
    columns = np.arange(view.values.shape[1])
    apart = np.minimum(columns, len(columns) - columns) * STEP >= DISPLACED
    if not apart.any():
        return GroundCoat(None, None, "the photo is too narrow to tell mirror images from chance")
    ground = _ground(view)
    fit, power = _agreement(view, ground)
    gain = _gain(fit, power, FAINT)
    of_sector = gain.max(axis=1)  # at the best distance; [roughness, flip, sector, shift]
    total = of_sector.sum(axis=2) / max(float((ground.weight * ground.detail**2).sum()), 1e-12)
    best = int(total[:, 0, 0].argmax())
    chance = float(np.delete(total.max(axis=0), columns[~apart], axis=1).max())
    explained = float(total[best, 0, 0])
    distances = gain[best, :, 0, :, 0].argmax(axis=0)
    bands, strength = _bands(view, ground, best, distances)
    # The floor is more of a blurred image than of a sharp one, so that it favours the sharp ones.
    roughness, spread = _peak(_gain(fit, power, 1e-3 * FAINT)[:, :, 0, :, 0].max(axis=1))
    numbers = explained, explained / max(chance, 1e-12), strength, bands
    reason = _doubt(*numbers)
    if reason:
        return GroundCoat(None, None, reason, *numbers)
    return GroundCoat(roughness, spread, "", *numbers)


def _doubt(
    explained: float, over_displaced: float, strength: float, bands: tuple[tuple[float, float], ...]
) -> str:
    """Return why what was found is no mirror image, or nothing."""
    if explained <= 0.0 or over_displaced < CLEARLY:
        return "no mirror image found on the ground"
    if min(correlation for correlation, _ in bands) < AGREEMENT:
        return "what looks like a mirror image is in a part of the ground only"
    strengths = [value for _, value in bands]
    uneven = max(strengths) / min(strengths)
    if not STRENGTH[0] <= strength <= STRENGTH[1] or uneven > UNEVEN:
        return "what looks like a mirror image is not as strong as one, near and far"
    return ""


# ------------------------------------------------------------------------------- the photo


def _unrolled(linear: AnyFloatArray, camera: Camera, up: Float64Array) -> _View:
    """Return the photo's luminance by azimuth and by elevation above the ground's horizon."""
    height, width = linear.shape[:2]
    ahead = -camera.c2w[:3, 2] + (camera.c2w[:3, 2] @ up) * up
    ahead = ahead / max(float(np.linalg.norm(ahead)), 1e-12)
    to_camera = np.stack([np.cross(ahead, up), up, ahead]) @ camera.c2w[:3, :3]
    v, u = np.meshgrid(np.linspace(0, height, 33), np.linspace(0, width, 33), indexing="ij")
    right, above, forward = np.moveaxis(camera.toward(u, v) @ to_camera.T, -1, 0)
    azimuth = np.degrees(np.arctan2(right, forward)).clip(-LEVEL, LEVEL)
    elevation = np.degrees(np.arctan2(above, np.hypot(right, forward)))
    columns = np.arange(azimuth.min(), azimuth.max(), STEP)
    rows = np.arange(min(elevation.max(), LEVEL), max(elevation.min(), LOWEST), -STEP)
    a, e = np.meshgrid(np.radians(columns), np.radians(rows))
    rays = np.stack([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)], -1)
    x, y, z = np.moveaxis(rays @ to_camera, -1, 0)
    depth = np.maximum(-z, 1e-6)
    u, v = camera.cx + camera.fx * x / depth, camera.cy - camera.fy * y / depth
    inside = (z < 0.0) & (u > 0.0) & (u < width) & (v > 0.0) & (v < height)
    side = max(1, int(camera.fx * np.radians(STEP)))  # a large photo is averaged first
    lum = luminance(np.asarray(linear[: height // side * side, : width // side * side], np.float64))
    small = lum.reshape(height // side, side, width // side, side).mean(axis=(1, 3))
    values = map_coordinates(small, [v / side - 0.5, u / side - 0.5], order=1, mode="nearest")
    is_ground = (rows < HIGHEST) & (inside.mean(axis=1) > 0.3)
    return _View(values * inside, inside.astype(np.float64), rows, np.flatnonzero(is_ground))


def _ground(view: _View) -> _Ground:
    """Return the ground's contrasts; a glint counts as twice its surroundings."""
    inside = view.inside[view.rows]
    mean = np.maximum(_along_azimuth(view.values[view.rows], inside), BLACK)
    detail = np.clip(view.values[view.rows] / mean - 1.0, -1.0, 1.0) * inside
    square = (detail**2).sum(axis=1) + 1e-4 * inside.sum(axis=1)
    return _Ground(detail, mean, inside / np.maximum(square, 1e-12)[:, None], inside)


def _along_azimuth(values: Float64Array, weight: Float64Array) -> Float64Array:
    """Return the weighted Gaussian mean of each row, shape [row, column]."""
    sums = (
        gaussian_filter1d(x, DETAIL / STEP, axis=1, mode="constant")
        for x in (values * weight, weight)
    )
    return np.asarray(next(sums) / np.maximum(next(sums), 1e-6))


# ------------------------------------------------------------------------ what it would mirror


def _fresnel(cos: Float64Array) -> Float64Array:
    """Return what a dielectric of `INDEX` reflects of unpolarised light [1]."""
    g = np.sqrt(INDEX**2 - 1.0 + cos**2)
    across, along = (g - cos) / (g + cos), (cos * (g + cos) - 1.0) / (cos * (g - cos) + 1.0)
    return np.asarray(0.5 * across**2 * (1.0 + along**2))


def _lobe(
    depression: Float64Array, roughness: float, foot: float
) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return where a rough ground sees what stands upright at a distance, and how much of it.

    Slopes are drawn from the GGX distribution of alpha = roughness^2; each counts as much as the
    eye sees of it, with Smith's uncorrelated masking of both directions (Walter et al. 2007).

    Args:
        depression: Of the ground below the horizon [rad], shape [row].
        roughness: Perceptual [1].
        foot: Height of the camera over the distance of what is mirrored [1].

    Returns:
        Weights with Fresnel's share [1], and elevation and azimuth of what is seen, from the
        camera, the latter relative to the ground's [deg]; shape [row, normal] each.
    """
    alpha, count = roughness**2, np.arange(NORMALS) + 0.5
    slope, turn = alpha * np.sqrt(count / (NORMALS - count)), np.pi * (5.0**0.5 - 1.0) * count
    normal = np.stack([slope * np.cos(turn), np.ones(NORMALS), slope * np.sin(turn)], -1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    sin, cos = np.sin(depression), np.cos(depression)
    to_eye = np.stack([0.0 * sin, sin, -cos], -1)
    facing = to_eye @ normal.T
    right, above, forward = np.moveaxis(2.0 * facing[..., None] * normal - to_eye[:, None], -1, 0)
    # How much of the way to what is mirrored lies beyond the ground point.
    left = 1.0 - foot / np.tan(depression)[:, None]

    def masking(c: Float64Array) -> Float64Array:
        square = np.maximum(c, 1e-3) ** 2
        return np.asarray(2.0 / (1.0 + np.sqrt(1.0 + alpha**2 * (1.0 - square) / square)))

    weight = facing / (normal[:, 1] * sin[:, None]) * masking(sin)[:, None] * masking(above)
    weight = np.where((facing > 0.0) & (above > 0.0) & (left > 0.02), weight / NORMALS, 0.0)
    level = np.maximum(np.hypot(right, forward), 1e-9)
    seen = np.degrees(np.arctan(left * above / level - foot))
    aside = np.degrees(left * np.arctan2(right, forward))
    return weight * _fresnel(np.clip(facing, 1e-6, 1.0)), seen, aside


def _through_lobe(
    view: _View, picture: Float64Array, around: Float64Array, roughness: float, foot: float
) -> tuple[Float64Array, Float64Array]:
    """Return what the ground would show of a picture, by azimuth and elevation.

    Args:
        view: The photo.
        picture: Shape [row, column].
        around: What is to the left and right of each of its rows, and above all, shape [row].
        roughness: Perceptual [1].
        foot: Height of the camera over the distance of what is mirrored [1].

    Returns:
        That, shape [ground row, column], and what a white picture would show, [ground row, 1].
    """
    weight, seen, aside = _lobe(view.depression, roughness, foot)
    height, width = picture.shape
    table = np.repeat(np.append(around, around[0])[:, None], 3 * width, axis=1)
    table[:height, width : 2 * width] = picture
    row = np.rint((view.elevation[0] - seen) / STEP).astype(int)
    row = np.where((row >= 0) & (row < height), row, height)
    start = row * 3 * width + np.clip(np.rint(aside / STEP).astype(int), -width, width) + width
    shown, flat = np.zeros((len(row), width)), table.reshape(-1)
    for k in range(NORMALS):
        shown += weight[:, k, None] * flat[start[:, k, None] + np.arange(width)]
    return shown, weight.sum(axis=1, keepdims=True)


def _known(view: _View, ground: _Ground, foot: float) -> Float64Array:
    """Return 1 where a mirror image is looked for, else 0, shape [ground row, column].

    For all roughnesses the same, or the one that is known in most rows would explain most.
    """
    outside = np.zeros(len(view.inside))
    known, whole = _through_lobe(view, view.inside, outside, MIDDLE, foot)
    is_before = np.tan(view.depression) > 1.1 * foot + (0.025 if foot else 0.0)
    return np.asarray((known > KNOWN * whole) * ground.inside * is_before[:, None])


def _contrasts(view: _View, is_known: Float64Array, roughness: float, foot: float) -> Float64Array:
    """Return the mirror image without its mean along azimuth, shape [ground row, column].

    Around the photo its rows go on without contrast, above it the first of them.
    """
    means = view.values.sum(axis=1) / np.maximum(view.inside.sum(axis=1), 1.0)
    first = int(view.inside.any(axis=1).argmax())
    means[:first] = means[first]
    filled = np.where(view.inside > 0.0, view.values, means[:, None])
    image, _ = _through_lobe(view, filled, means, roughness, foot)
    return (image - _along_azimuth(image, is_known)) * is_known


# ---------------------------------------------------------------------------- how they agree


def _agreement(view: _View, ground: _Ground) -> tuple[Float64Array, Float64Array]:
    """Return the products of ground and prediction, and the prediction's squares.

    Every displacement along azimuth at once, by Fourier's transform.

    Returns:
        Shape [roughness, foot, not flipped or flipped, sector, displacement] each.
    """
    width = ground.mean.shape[1]
    sectors = max(1, round(width * STEP / SECTOR))
    sector = (np.arange(width) * sectors // width == np.arange(sectors)[:, None])[:, None]
    of_ground = np.fft.rfft(sector * (ground.weight * ground.detail / ground.mean))
    of_weight = np.fft.rfft(sector * (ground.weight / ground.mean**2))
    fit, power = np.zeros((2, len(ROUGHNESSES), len(FEET), 2, sectors, width))
    for j, foot in enumerate(FEET):
        is_known = _known(view, ground, foot)
        if is_known.any(axis=1).sum() < 8:
            continue
        for i, roughness in enumerate(ROUGHNESSES):
            image = _contrasts(view, is_known, roughness, foot)
            for k, shown in enumerate((image, image[:, ::-1])):
                conjugates = (np.conj(np.fft.rfft(x)) for x in (shown, shown**2))
                fit[i, j, k] = np.fft.irfft((of_ground * next(conjugates)).sum(1), width)
                power[i, j, k] = np.fft.irfft((of_weight * next(conjugates)).sum(1), width)
    return fit, np.maximum(power, 0.0)


def _gain(fit: Float64Array, power: Float64Array, floor: float) -> Float64Array:
    """Return the squares that a prediction explains; a faint prediction explains less."""
    explained = np.maximum(fit, 0.0) ** 2 / (power + floor * power.max() + 1e-12)
    return np.asarray(explained)


def _bands(
    view: _View, ground: _Ground, best: int, distances: NDArray[np.intp]
) -> tuple[tuple[tuple[float, float], ...], float]:
    """Return correlation and strength of the best prediction in each band, and its strength.

    Args:
        view: The photo.
        ground: Its contrasts.
        best: Index of the roughness.
        distances: Index of each sector's foot.
    """
    width = ground.mean.shape[1]
    of_column = distances[np.arange(width) * len(distances) // width]
    image, is_known = np.zeros_like(ground.mean), np.zeros_like(ground.mean)
    for j in set(of_column.tolist()):
        where = _known(view, ground, FEET[j])
        shown = _contrasts(view, where, ROUGHNESSES[best], FEET[j])
        image[:, of_column == j] = shown[:, of_column == j]
        is_known[:, of_column == j] = where[:, of_column == j]
    weight = ground.weight * is_known
    fit = (weight * ground.detail * image / ground.mean).sum(axis=1)
    power = (weight * (image / ground.mean) ** 2).sum(axis=1)
    square = (weight * ground.detail**2).sum(axis=1)
    bands = []
    for rows in np.array_split(np.flatnonzero(is_known.mean(axis=1) > 0.1), BANDS):
        f, p, s = (float(x[rows].sum()) for x in (fit, power, square))
        bands.append((f / max((p * s) ** 0.5, 1e-12), f / max(p, 1e-12)))
    return tuple(bands), float(fit.sum() / max(power.sum(), 1e-12))


def _peak(gain: Float64Array) -> tuple[float, float]:
    """Return the roughness of most gain [roughness, sector], and its jackknife deviation."""

    def peak(of: Float64Array) -> float:
        k = int(np.clip(of.argmax(), 1, len(ROUGHNESSES) - 2))
        a, b, c = np.polyfit(ROUGHNESSES[k - 1 : k + 2], of[k - 1 : k + 2], 2)
        del c
        inside = -b / (2.0 * a) if a < 0.0 else ROUGHNESSES[int(of.argmax())]
        return float(np.clip(inside, ROUGHNESSES[k - 1], ROUGHNESSES[k + 1]))

    whole = gain.sum(axis=1)
    count = gain.shape[1]
    left_out = np.array([peak(whole - gain[:, k]) for k in range(count)])
    spread = ((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum()) ** 0.5
    return peak(whole), float(spread)
