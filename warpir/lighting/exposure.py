"""The level of an estimated light, by two witnesses: the regressor, and the ground in the photo.

The regressor's levels are relative to the photo's mean luminance. The ground's radiance times pi,
over the irradiance that the light gives it, is its albedo, and albedos of grounds are log-normal.
With x the natural logarithm of the factor on the light, s the regressor's standard deviation and a
the albedo that the ground would have under the light as it was regressed,

    p(x) ~ exp(-x^2 / (2 s^2)) (1 + (ln a - x - ln A)^2 / (n S^2))^(-(n + 1) / 2),

whose mean is taken. Student's t in place of the normal lets snow, asphalt and ground in the shade
count for little. On places that the regressor has not seen this helps too little to be trusted
(``docs/evaluation.md``): it is shown, and put on the light where the user states the albedo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpir.app.inputs import Inputs
from warpir.core.arrays import Float64Array
from warpir.core.color import luminance
from warpir.lighting.regression import LOG_STD_MAX, Regression
from warpir.lighting.scene_light import (
    GROUND_PERCENTILE,
    believed,
    foot_of,
    lit_ground,
    photo_luminance,
    seen_past_mesh,
)
from warpir.scene.light import Light

ALBEDO = 0.19
"""Median albedo of the ground over some 300 panoramas [1]; the next constants fit 45 places, see
``docs/evaluation.md``."""
ALBEDO_LOG_STD = 0.8
"""Scale of its natural logarithm [1]."""
STATED_LOG_STD = 0.3
"""The same for an albedo that the user states: ground has a texture, and parts in the shade [1]."""
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
    weighed: float
    """Change of all of the light that both witnesses give [EV]."""
    is_stated: bool
    """Whether the user states the albedo; only then the light is changed."""

    @property
    def stops(self) -> float:
        """Change that is put on all of the light [EV]."""
        return self.weighed if self.is_stated else 0.0

    @property
    def albedo(self) -> float:
        """Albedo that the ground has under the light after `stops` [1]."""
        return float(self.implied / 2.0**self.stops)

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``."""
        return {
            "implied_albedo": self.implied,
            "albedo": self.albedo,
            "weighed_stops": self.weighed,
            "stops": self.stops,
        }


def ask_ground(
    regression: Regression, inputs: Inputs, stated: float | None = None
) -> GroundWitness | None:
    """Weigh the regressor's level against the ground between the camera and past the object.

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
    log_std = DOUBT * level_log_std(regression, normal)
    if stated is not None:
        change = expected_change(math.log(implied / stated), log_std, STATED_LOG_STD)
    else:
        # Less sure of itself, it would let the light follow a black floor.
        log_std = min(log_std, LOG_STD_MAX)
        change = expected_change(math.log(implied / ALBEDO), log_std, ALBEDO_LOG_STD)
    return GroundWitness(implied, change / math.log(2.0), stated is not None)


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


def expected_change(excess: float, log_std: float, albedo_log_std: float) -> float:
    """Return the mean of the log factor on the light, given both witnesses [1].

    The excess is the natural logarithm of implied over expected albedo; the others are standard
    deviation and scale of the logarithms of the regressed level and of the albedo.
    """
    change = np.linspace(-LOG_FACTOR_MAX, LOG_FACTOR_MAX, 4001)
    misfit = (excess - change) / albedo_log_std
    log_density = -0.5 * (change / log_std) ** 2
    log_density -= 0.5 * (FREEDOM + 1.0) * np.log1p(misfit**2 / FREEDOM)
    density = np.exp(log_density - log_density.max())
    return float(density @ change / density.sum())
