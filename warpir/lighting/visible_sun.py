"""A sun in the photo is where the photo shows it, and as strong as suns in view are.

A camera clips the sun and its glow to a round white spot around which the sky falls off on every
side. White walls, clouds and windows are clipped too, but they are not round, or have a hard edge,
or share the picture with others. A logistic rule of six numbers tells them apart, the last of which
is how likely the regressor holds the spot's direction to be. Spots below the horizon are mirror
images and glints, and never count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import label

from warpir.core.arrays import AnyFloatArray, BoolArray, Float64Array
from warpir.core.color import GAMMA, luminance
from warpir.io.images.resize import resize
from warpir.lighting.regression import Regression
from warpir.scene.camera import Camera
from warpir.scene.light import SUN_RADIUS_DEG

CLIPPED = 0.985
"""Display value of the middle channel from which a pixel counts as clipped [1]: a low sun leaves
its blue."""
PIXEL_DEG = 0.25
"""Larger photos are averaged down until a pixel in the middle is this large [deg]."""
LEAST_PIXELS = 3
"""A spot of fewer pixels is noise."""
MOST_SPOTS = 12
"""Number of spots that are measured, the largest first."""
RADIUS_MAX_DEG = 10.0
"""A larger spot is a sky or a wall [deg]."""
RINGS_DEG = ((0.5, 2.0), (2.0, 4.0))
"""Two rings around a spot, from its edge [deg]."""
SECTORS = 8
"""Number of equal sectors of the inner ring."""
NEAR_DEG = 25.0
"""Angle around a spot within which the regressor's probability is summed [deg]."""
SPREAD_DEG = 0.6
"""Expected angle between a spot's centre and the sun [deg], see ``docs/evaluation.md``."""
WEIGHTS = np.array([0.86, 8.78, 4.58, 14.7, 5.98, 0.9])
"""Of `features_of`, with `BIAS`: logistic regression on half of the places of
``benchmarks/light/visible_sun.py``."""
BIAS = -6.96
PROBABILITY_MIN = 0.82
"""Least probability with which a spot is taken for the sun [1]."""
LOG_RATIO, LOG_RATIO_STD = 0.5, 0.66
"""Mean and standard deviation of the logarithm of what a sun in view gives a surface that faces it
over the flux of all other light, over places."""
LOG_TOTAL, LOG_TOTAL_STD = 2.3, 0.6
"""Mean and standard deviation of the logarithm of the sum of both over the mean luminance of a
photo that shows the sun, over photos."""


@dataclass(frozen=True)
class Spot:
    """A connected clipped part of a photo, and what surrounds it."""

    axis: Float64Array
    """Unit direction of its centre, world frame, shape [3]."""
    radius_deg: float
    """Of a disc of the same solid angle [deg]."""
    elongation: float
    """Its root mean square radius over such a disc's: 1 for a disc, above for everything else."""
    glow: float
    """Display value of the darkest sector of the inner ring [1]."""
    fall: float
    """By how much the outer ring is darker than the inner one [1]."""
    share: float
    """Of all that is clipped in the photo, by solid angle [1]."""

    def features(self) -> Float64Array:
        """Return what the rule weighs, shape [5].

        Each is limited where more of it says nothing, so that none can make up for another.
        """
        return np.array(
            [
                math.log(min(self.radius_deg, 2.0)),
                -min(max(math.log(self.elongation), 0.0), 0.3),
                min(self.glow, 0.75),
                min(self.fall, 0.12),
                min(self.share, 0.6),
            ]
        )


def find_spots(photo_srgb: AnyFloatArray, camera: Camera) -> list[Spot]:
    """Return the clipped spots above the horizon, the largest first.

    Args:
        photo_srgb: Display-encoded, in [0, 1], shape [H, W, 3].
        camera: Of the photo, of any size with the photo's aspect.
    """
    red, green, blue = (photo_srgb[..., k] for k in range(3))
    low, high = np.minimum(red, green), np.maximum(red, green)
    shown, view = _shrunk(np.clip(blue, low, high), camera)  # the middle channel
    rays, omega = _pixel_rays(view)
    parts, count = label(shown >= CLIPPED, np.ones((3, 3)))
    sizes = np.bincount(parts.ravel(), omega.ravel(), count + 1)
    whole = float(sizes[1:].sum())
    spots = []
    for part in 1 + np.argsort(-sizes[1:], kind="stable")[:MOST_SPOTS]:
        inside = parts == part
        radius = math.degrees(math.sqrt(sizes[part] / math.pi))
        if inside.sum() >= LEAST_PIXELS and radius < RADIUS_MAX_DEG:
            spot = _measure(inside, shown, rays, omega, radius, float(sizes[part]) / whole)
            if spot is not None and spot.axis[1] > 0.0:
                spots.append(spot)
    return spots


def _measure(
    inside: BoolArray,
    shown: Float64Array,
    rays: Float64Array,
    omega: Float64Array,
    radius: float,
    share: float,
) -> Spot | None:
    """Measure one spot; None where the photo does not show what is around it.

    Args:
        inside: Its pixels, shape [H, W].
        shown: Display values, shape [H, W].
        rays: Unit directions of the pixels, world frame, shape [H, W, 3].
        omega: Solid angles of the pixels [sr], shape [H, W].
        radius: Of a disc of its solid angle [deg].
        share: Of all that is clipped [1].
    """
    axis = omega[inside] @ rays[inside]
    axis = axis / np.linalg.norm(axis)
    angle = np.degrees(np.arccos(np.clip(rays @ axis, -1.0, 1.0)))
    square = float(omega[inside] @ angle[inside] ** 2 / omega[inside].sum())
    # Mirror images must agree: sectors are counted from the vertical plane through the spot.
    across = np.cross(axis, (0.0, 1.0, 0.0))
    across = across / max(float(np.linalg.norm(across)), 1e-12)
    turn = np.arctan2(rays @ np.cross(across, axis), rays @ across)
    sector = ((turn + math.pi) * (SECTORS / (2.0 * math.pi))).astype(int) % SECTORS
    levels, darkest = [], 0.0
    for low, high in RINGS_DEG:
        ring = (angle > radius + low) & (angle <= radius + high) & ~inside
        if ring.sum() < SECTORS:
            return None
        area = np.bincount(sector[ring], omega[ring], SECTORS)
        total = np.bincount(sector[ring], omega[ring] * shown[ring], SECTORS)
        seen = area > 0.02 * area.sum()
        levels.append(float(total.sum() / area.sum()))
        if len(levels) == 1:
            darkest = float((total[seen] / area[seen]).min())
    elongation = math.sqrt(2.0 * square) / radius
    return Spot(axis, radius, elongation, darkest, levels[0] - levels[1], share)


def _shrunk(shown: AnyFloatArray, camera: Camera) -> tuple[Float64Array, Camera]:
    """Average a photo until its pixels are `PIXEL_DEG` large; return it and its camera."""
    height, width = shown.shape
    focal = camera.fx * width / camera.width
    share = min(1.0, math.degrees(1.0 / focal) / PIXEL_DEG)
    size = (max(2, round(height * share)), max(2, round(width * share)))
    return resize(shown, *size).astype(np.float64), camera.scaled(size[1], size[0])


def _pixel_rays(view: Camera) -> tuple[Float64Array, Float64Array]:
    """Return pixels' unit directions, world frame, [H, W, 3], and solid angles [sr], [H, W]."""
    u, v = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    local = view.toward(u, v)
    square = (local**2).sum(axis=-1)
    rays = local @ view.c2w[:3, :3].T / np.sqrt(square)[..., None]
    return rays, square**-1.5 / (view.fx * view.fy)


def with_visible_sun(
    regression: Regression, photo_srgb: AnyFloatArray, camera: Camera
) -> Regression:
    """Return the light with its dominant part where the photo shows the sun, if it shows one.

    The photo is display-encoded, in [0, 1], shape [H, W, 3]; the camera is of any size with the
    photo's aspect.
    """
    found = [(probability(s, regression), s.axis) for s in find_spots(photo_srgb, camera)]
    best, axis = max(found, key=lambda pair: pair[0], default=(0.0, regression.axis))
    if best < PROBABILITY_MIN:
        return regression
    mean = float(luminance(np.clip(photo_srgb, 0.0, 1.0).astype(np.float64) ** GAMMA).mean())
    return with_sun(regression, axis, best, mean)


def probability(spot: Spot, regression: Regression) -> float:
    """Return how likely a spot is the sun [1]."""
    return 1.0 / (1.0 + math.exp(-float(WEIGHTS @ features_of(spot, regression)) - BIAS))


def features_of(spot: Spot, regression: Regression) -> Float64Array:
    """Return what the rule weighs, shape [6]: of the spot, and the regressor's opinion.

    That is the log of how much likelier the spot's direction is to it than by chance.
    """
    near = regression.directions @ spot.axis > math.cos(math.radians(NEAR_DEG))
    mass = float(regression.probability[near].sum())
    opinion = math.log(max(mass, 1e-4) / max(float(near.mean()), 1e-4))
    return np.append(spot.features(), min(max(opinion, -4.0), 1.5))


def with_sun(
    regression: Regression, axis: Float64Array, likely: float, photo_mean: float
) -> Regression:
    """Return the light with the sun in a direction as its dominant part, as strong as one in view.

    Two logarithms, of the ratio of sun to rest and of the sum of both, are means of the
    regressor's and of what suns in view have (`LOG_RATIO`, `LOG_TOTAL`), weighted by the inverse
    variances. Colours stay, and so does how the rest is spread; the sun has its own width.

    Args:
        regression: What the regressor sees.
        axis: Unit, world frame, shape [3].
        likely: Probability that this is the sun [1].
        photo_mean: Mean linear luminance of the photo [1].
    """
    sun = float(luminance(regression.sun))
    rest = float(luminance(regression.ambient.flux().sum(axis=0)))
    share = sun / (sun + rest)
    of_sun, of_rest = regression.sun_log_std**2, regression.ambient_log_std**2
    log_ratio, ratio_std = _weighed(
        math.log(sun / rest), of_sun + of_rest, LOG_RATIO, LOG_RATIO_STD
    )
    log_total, total_std = _weighed(
        math.log((sun + rest) / photo_mean),
        share**2 * of_sun + (1.0 - share) ** 2 * of_rest,
        LOG_TOTAL,
        LOG_TOTAL_STD,
    )
    ratio, total = math.exp(log_ratio), photo_mean * math.exp(log_total)
    share = ratio / (1.0 + ratio)
    gain, dimmed = total * share / sun, total * (1.0 - share) / rest
    spread = math.radians(SPREAD_DEG)
    return replace(
        regression,
        axis=axis,
        spread_deg=SPREAD_DEG,
        # Of a narrow von Mises-Fisher distribution the expected angle is sqrt(pi / (2 kappa)).
        concentration=math.pi / (2.0 * spread**2),
        directions=axis[None],
        probability=np.ones(1),
        sun=regression.sun * gain,
        sun_log_std=math.hypot(total_std, (1.0 - share) * ratio_std),
        # A uniform disc of radius r has the per-axis variance r^2 / 4.
        sigma=math.radians(SUN_RADIUS_DEG) / 2.0,
        share=share,
        ambient=replace(
            regression.ambient, amplitude=regression.ambient.amplitude * np.float32(dimmed)
        ),
        ambient_log_std=math.hypot(total_std, share * ratio_std),
        sun_in_view=likely,
    )


def _weighed(own: float, variance: float, usual: float, usual_std: float) -> tuple[float, float]:
    """Return a logarithm and its deviation by two witnesses: the regressor, and suns in view."""
    by_own, by_usual = 1.0 / variance, usual_std**-2
    return (by_own * own + by_usual * usual) / (by_own + by_usual), (by_own + by_usual) ** -0.5
