"""The light that the regressor estimates from a photo, in the world and in the photo's units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import expit

from warpir.calibration.forward import softmax
from warpir.core.arrays import AnyFloatArray, Float64Array, FloatArray
from warpir.core.color import LUMINANCE_WEIGHTS
from warpir.io.images.resize import resize
from warpir.lighting.regressor import (
    AMBIENT_SHARPNESS,
    HEIGHT,
    WIDTH,
    Prediction,
    Regressor,
    ambient_axes,
    least_angle,
    mean_luminance,
)
from warpir.scene.camera import Camera
from warpir.scene.light import Light, Lobes, angles_from_axis

LOG_STD_MIN, LOG_STD_MAX = 0.1, 0.7
"""Least and greatest standard deviation that a log intensity is believed to have: without the
greatest one, guidance puts out a sun that the regressor is not sure of, for soft light is never
quite wrong."""

CLEAR_DEG = 40.0
"""Expected angle to the truth up to which a direction of the light counts as seen [deg]: that of a
network that sees nothing is 65, an even distribution over its directions."""
SOFTENING = 0.5
"""Least angular standard deviation of the dominant light that casts a shadow where it does not
count as seen, over the expected angle to the truth [1]."""


@dataclass(frozen=True)
class Regression:
    """The light that the network estimates from a photo, world frame, photo-linear units."""

    axis: Float64Array
    """Unit direction toward the dominant light: least expected angle, shape [3]."""
    spread_deg: float
    """Expected angle between `axis` and the truth [deg]."""
    concentration: float
    """kappa of the von Mises-Fisher distribution about `axis` nearest to the predicted one."""
    directions: Float64Array
    """Candidates for the direction, shape [K, 3]."""
    probability: Float64Array
    """Of each, sums to 1, shape [K]."""
    sun: Float64Array
    """Irradiance of a surface that faces the dominant light, linear RGB, shape [3]."""
    sun_log_std: float
    """Standard deviation of the logarithm of its luminance."""
    sigma: float
    """Angular standard deviation of the dominant light [rad]."""
    share: float
    """Share of a sphere's mean irradiance that the dominant light gives, in [0, 1]."""
    ambient: Lobes
    """All other light."""
    ambient_log_std: float
    """Standard deviation of the logarithm of the ambient irradiance."""
    sun_in_view: float | None = None
    """Probability that a spot of the photo is the sun, whose direction `axis` then is; None: no
    spot looks like it [1]."""

    def lobes(self, sigma_min: float = 0.0) -> Lobes:
        """Return the light as lobes, the dominant one first.

        Args:
            sigma_min: Least angular standard deviation of the dominant lobe [rad]; its irradiance
                stays.
        """
        sharpness = 1.0 / max(self.sigma, sigma_min) ** 2
        amplitude = self.sun / facing_irradiance(sharpness)
        return Lobes(
            np.concatenate([amplitude[None], self.ambient.amplitude]).astype(np.float32),
            np.concatenate([self.axis[None], self.ambient.axis]).astype(np.float32),
            np.append(sharpness, self.ambient.sharpness).astype(np.float32),
        )

    def shadow_lobes(self) -> Lobes:
        """Return the lobes that cast the shadow: soft where the dominant light is not seen.

        A hard shadow in a wrong direction is further from the truth than a soft one, whereas the
        object's glints stay as sharp as lamps are.
        """
        return self.lobes(0.0 if self.is_clear else SOFTENING * math.radians(self.spread_deg))

    def irradiance(self, normal: Float64Array) -> Float64Array:
        """Return the expected irradiance of a surface over all directions, linear RGB, shape [3].

        Args:
            normal: Unit, world frame, shape [3].
        """
        cosine = float(np.maximum(self.directions @ normal, 0.0) @ self.probability)
        rest: Float64Array = Light(lobes=self.ambient).irradiance(normal)
        return cosine * self.sun + rest

    def scaled(self, factor: float) -> Regression:
        """Return all of the light in another unit."""
        ambient = self.ambient.amplitude * np.float32(factor)
        return replace(
            self, sun=self.sun * factor, ambient=replace(self.ambient, amplitude=ambient)
        )

    @property
    def is_clear(self) -> bool:
        """Whether the photo shows where the light comes from (`CLEAR_DEG`)."""
        return self.spread_deg <= CLEAR_DEG

    def record(self) -> dict[str, Any]:
        """Return plain values for ``run.json``."""
        azimuth, elevation = angles_from_axis(self.axis)
        return {
            "axis": self.axis.tolist(),
            "azimuth_deg": azimuth,
            "elevation_deg": elevation,
            "spread_deg": self.spread_deg,
            "concentration": self.concentration,
            "sun": self.sun.tolist(),
            "sun_log_std": self.sun_log_std,
            "sigma": self.sigma,
            "share": self.share,
            "ambient": {
                "amplitude": self.ambient.amplitude.tolist(),
                "axis": self.ambient.axis.tolist(),
                "sharpness": self.ambient.sharpness.tolist(),
            },
            "ambient_log_std": self.ambient_log_std,
            "sun_in_view": self.sun_in_view,
        }


def facing_irradiance(sharpness: float) -> float:
    """Return the irradiance that a lobe of amplitude 1 gives a surface that faces it.

    ``2 pi integral_0^1 t exp(s (t - 1)) dt = 2 pi (s - 1 + exp(-s)) / s^2``.
    """
    return 2.0 * math.pi * (sharpness + math.expm1(-sharpness)) / sharpness**2


def yaw_to_world(camera: Camera) -> Float64Array:
    """Return the rotation from the camera-yaw frame to the world, shape [3, 3].

    A camera that looks straight up or down is turned as its up axis says.
    """
    _, up, back = camera.c2w[:3, :3].T
    ahead = -back * (1.0, 0.0, 1.0)
    if np.linalg.norm(ahead) < 1e-6:
        ahead = up * (1.0, 0.0, 1.0) * np.sign(back[1])
    ahead = ahead / np.linalg.norm(ahead)
    vertical = np.array([0.0, 1.0, 0.0])
    return np.stack([np.cross(ahead, vertical), vertical, -ahead], axis=1)


def camera_rays(camera: Camera, height: int = HEIGHT, width: int = WIDTH) -> FloatArray:
    """Return the unit viewing direction of each pixel, camera-yaw frame, shape [height, width, 3].

    The photo's camera may be of any size: the picture is stretched to the size asked for.
    """
    view = camera.scaled(width, height)
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = view.toward(u, v) @ (yaw_to_world(camera).T @ camera.c2w[:3, :3]).T
    unit: FloatArray = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    return unit


def regress(network: Regressor, photo_srgb: AnyFloatArray, camera: Camera) -> Regression:
    """Estimate the light of a photo, display-encoded, in [0, 1], shape [H, W, 3].

    The network is that of `load_regressor`, the camera of any size with the photo's aspect.
    """
    photo = _network_photo(photo_srgb)
    prediction = network.predict(photo, camera_rays(camera))
    return _regression(network, prediction, mean_luminance(photo), camera)


def mean_training_light(
    network: Regressor, photo_srgb: AnyFloatArray, camera: Camera
) -> Regression:
    """Return the training set's mean light at a photo's exposure: a guess without looking.

    Only the mean luminance of the photo counts, display-encoded, shape [H, W, 3], and only the
    camera's yaw.
    """
    level = mean_luminance(_network_photo(photo_srgb))
    return _regression(network, network.mean_light, level, camera)


def _network_photo(photo_srgb: AnyFloatArray) -> Float64Array:
    """Bring a photo to the network's size by area, shape [96, 144, 3]."""
    return resize(photo_srgb, HEIGHT, WIDTH).clip(0.0, 1.0).astype(np.float64)


def _regression(
    network: Regressor, one: Prediction, luminance: float, camera: Camera
) -> Regression:
    """Turn a photo's prediction into numbers in the world, by the photo's mean luminance."""
    to_world = yaw_to_world(camera)
    directions = network.directions
    probability = softmax(one.logits)
    (axis,), (spread,) = least_angle(directions, probability[None])
    # Most likely kappa for samples about a known mean direction: coth(kappa) - 1 / kappa = R; the
    # inverse is Banerjee et al. 2005, eq. 4 in 3 dimensions.
    resultant = min(max(float(probability @ directions @ axis), 0.0), 1.0 - 1e-6)
    log_red, log_blue = one.tint
    ratios = np.exp([log_red, 0.0, log_blue])
    level = luminance * math.exp(one.level)
    ambient_axis = ambient_axes() @ to_world.T
    return Regression(
        axis=to_world @ axis,
        spread_deg=math.degrees(spread),
        concentration=resultant * (3.0 - resultant**2) / (1.0 - resultant**2),
        directions=directions @ to_world.T,
        probability=probability,
        sun=level * ratios / float(ratios @ LUMINANCE_WEIGHTS),
        sun_log_std=math.exp(0.5 * one.level_log_var),
        sigma=min(math.exp(one.softness), 1.0),
        share=float(expit(one.share)),
        ambient=Lobes(
            (luminance * np.exp(one.ambient)).astype(np.float32),
            ambient_axis.astype(np.float32),
            np.full(len(ambient_axis), AMBIENT_SHARPNESS, np.float32),
        ),
        ambient_log_std=math.exp(0.5 * one.ambient_log_var),
    )
