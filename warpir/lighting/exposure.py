"""The albedo of the ground under an estimated light, and what a stated one says of its level.

The regressor's levels are relative to the photo's mean luminance. The ground's radiance times pi,
over the irradiance that the light gives it, is its albedo. Where the user states the albedo, both
witnesses are weighed. With x the natural logarithm of the factor on the light, s the regressor's
standard deviation, a the albedo that the ground would have under the light as it was regressed and
A the stated one,

    p(x) ~ exp(-x^2 / (2 s^2)) (1 + (ln a - x - ln A)^2 / (n S^2))^(-(n + 1) / 2),

whose mean is taken. Student's t in place of the normal lets ground in the shade count for little.
Without the user's word the light stays: what is known of grounds in general makes no picture better
of a place that the regressor has not seen (``docs/evaluation.md``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array
from warpir.core.color import luminance
from warpir.lighting.regression import Regression
from warpir.lighting.scene_light import (
    GROUND_PERCENTILE,
    believed,
    foot_of,
    lit_ground,
    photo_luminance,
    seen_past_mesh,
)
from warpir.scene.light import Light

DARK = 0.025
"""Under this albedo of the ground a light is mostly too strong [1], see ``docs/evaluation.md``."""
STATED_LOG_STD = 0.3
"""Scale of the natural logarithm of the ground's albedo about the stated one [1]: ground has a
texture, and parts in the shade."""
FREEDOM = 3.0
"""Degrees of freedom of Student's t [1]."""
DOUBT = 1.4
"""Factor on the regressor's standard deviation: on places that it has not seen it errs more [1]."""
GRID = (32, 48)
"""Rows and columns of the pixels that are looked at [1]."""
GRID_PAST_MESH = (12, 18)
"""The same where --proxy is asked for each, triangle by triangle [1]."""
REACH_HEIGHTS = 5.0
"""Ground counts up to this distance, in heights of the camera above it [1]."""
REACH_OBJECT = 1.5
"""Or up to this one, in distances of the object, where that is further [1]."""
LEAST_SEEN = 0.02
"""Share of the looks at the photo that must meet the ground to ask it [1]."""
LOG_FACTOR_MAX = 4.0
"""Greatest logarithm of the factor [1]."""


@dataclass(frozen=True)
class GroundWitness:
    """What the ground in the photo says of the level of a light."""

    implied: float
    """Albedo that the ground would have under the light as it was regressed [1]."""
    stops: float
    """Change that is put on all of the light [EV]; 0 where the user states no albedo."""

    @property
    def albedo(self) -> float:
        """Albedo that the ground has under the light after `stops` [1]."""
        return float(self.implied / 2.0**self.stops)

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``."""
        return {"implied_albedo": self.implied, "albedo": self.albedo, "stops": self.stops}


def ask_ground(
    regression: Regression, inputs: Inputs, stated: float | None = None
) -> GroundWitness | None:
    """Check the regressor's level by the ground between the camera and past the object.

    Args:
        regression: The light, photo-linear units.
        inputs: Photo, camera, placement; ground behind the occluder mask, and ground that a mesh or
            a shadow mask says no lamp reaches, is left out.
        stated: The ground's albedo where the user knows it [1].

    Returns:
        None where the photo shows too little of the ground, or no light reaches it.
    """
    points, looks = ground_in_view(inputs)
    light = Light(lobes=regression.lobes())
    if len(points):
        points, light = lit_ground(points, light, inputs)
    seen = photo_luminance(inputs, points)
    normal = inputs.placement.ground[:3]
    irradiance = float(luminance(light.irradiance(normal)))
    if len(seen) < LEAST_SEEN * looks or not irradiance > 0.0:
        return None
    level = believed(float(np.percentile(seen, GROUND_PERCENTILE)), inputs.photo)
    implied = math.pi * level / irradiance
    if stated is None:
        return GroundWitness(implied, 0.0)
    log_std = DOUBT * level_log_std(regression, normal)
    return GroundWitness(implied, expected_stops(math.log(implied / stated), log_std))


def ground_in_view(inputs: Inputs) -> tuple[Float64Array, int]:
    """Return points of the ground that the photo shows, evenly over its pixels.

    Returns:
        Points, world frame [m], shape [point, 3], and how many pixels were looked at.
    """
    camera, plane = inputs.camera, inputs.placement.ground
    rows, columns = GRID if inputs.proxy is None else GRID_PAST_MESH
    u, v = np.meshgrid(
        (np.arange(columns) + 0.5) * camera.width / columns,
        (np.arange(rows) + 0.5) * camera.height / rows,
    )
    rays = camera.toward(u, v).reshape(-1, 3) @ camera.c2w[:3, :3].T
    eye, normal = camera.c2w[:3, 3], plane[:3]
    height = float(eye @ normal + plane[3])
    distance = float(np.linalg.norm(foot_of(inputs) - eye))
    reach = max(REACH_HEIGHTS * height, REACH_OBJECT * distance)
    slope = rays @ normal
    # Beyond the reach no ray needs its point, so the horizon's are left out before the division.
    is_near = -slope * height > height**2 / reach * np.linalg.norm(rays, axis=1)
    points = eye - rays[is_near] * (height / slope[is_near])[:, None]
    return points[seen_past_mesh(points, inputs)], u.size


def level_log_std(regression: Regression, normal: Float64Array) -> float:
    """Return the standard deviation of the logarithm of a surface's regressed irradiance.

    Args:
        regression: Holds those of both parts of the light, which are taken as independent.
        normal: Of the surface, unit, world frame, shape [3].
    """
    whole = float(luminance(Light(lobes=regression.lobes()).irradiance(normal)))
    ambient = float(luminance(Light(lobes=regression.ambient).irradiance(normal)))
    share = ambient / whole
    return math.hypot((1.0 - share) * regression.sun_log_std, share * regression.ambient_log_std)


def expected_stops(excess: float, log_std: float) -> float:
    """Return the mean change of the light, given both witnesses [EV].

    The excess is the natural logarithm of implied over stated albedo; the other is the standard
    deviation of the logarithm of the regressed level.
    """
    change = np.linspace(-LOG_FACTOR_MAX, LOG_FACTOR_MAX, 4001)
    misfit = (excess - change) / STATED_LOG_STD
    log_density = -0.5 * (change / log_std) ** 2
    log_density -= 0.5 * (FREEDOM + 1.0) * np.log1p(misfit**2 / FREEDOM)
    density = np.exp(log_density - log_density.max())
    return float(density @ change / density.sum() / math.log(2.0))
