"""The light that the regressor estimates from a photo, for runs that are given none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs
from warpir.lighting.regression import Regression, regress
from warpir.lighting.regressor import load_regressor
from warpir.lighting.scene_light import SceneLight, start_level
from warpir.lighting.visible_sun import with_visible_sun
from warpir.scene.light import Light, angles_from_axis
from warpir.scene.tone_curves import Curves


@dataclass(frozen=True)
class Estimate:
    """The light estimated from a photo."""

    regression: Regression
    gain: float
    """Factor on its light, so that the tone operator shows it as the photo does."""
    light: SceneLight


def estimate_light(inputs: Inputs, config: InsertConfig, device: str) -> Estimate:
    """Estimate the light of the photo with the regressor.

    Args:
        inputs: Photo and camera.
        config: Weights, tone operator, exposure.
        device: torch's name of it.

    Raises:
        InputError: The weights are absent or damaged (`ExitCode.MODEL`).
    """
    path = None if config.light.regressor is None else Path(config.light.regressor)
    regression = regress(load_regressor(path, device), inputs.photo.srgb, inputs.camera)
    if config.light.visible_sun:
        regression = with_visible_sun(regression, inputs.photo.srgb, inputs.camera)
    gain = tone_gain(inputs, config) * 2.0 ** (config.light.exposure or 0.0)
    light = Light(lobes=regression.lobes()).scaled(gain)
    curves = Curves.identity(config.tone_operator)
    scene_light = SceneLight(light, light, curves, float(np.log2(gain)), (in_words(regression),))
    return Estimate(regression, gain, scene_light)


def tone_gain(inputs: Inputs, config: InsertConfig) -> float:
    """Return by what a light in the photo's own unit is to be multiplied for the tone operator.

    An operator that never clips shows everything darker than it is; with this factor, white ground
    under an even light looks as the photo's ground does.
    """
    linear = config.tone_operator == "linear"
    return 1.0 if linear else 1.0 + start_level(inputs, config)


def in_words(regression: Regression) -> str:
    """Return what is assumed, in a line."""
    azimuth, elevation = angles_from_axis(regression.axis)
    if regression.sun_in_view is not None:
        return (
            f"the photo shows the sun: azimuth {azimuth:.0f}, elevation {elevation:.0f}, as strong "
            "as suns in view are; all other light is what the regressor sees in the photo "
            "(--no-visible-sun, --sun, --light)"
        )
    return (
        "the light is what the regressor sees in the photo: mainly from azimuth "
        f"{azimuth:.0f}, elevation {elevation:.0f}, +- {regression.spread_deg:.0f} degrees "
        "(--light, --sun, --sky)"
    )
