"""The light that the regressor estimates from a photo, for runs that are given none."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpir.app.inputs import Inputs
from warpir.app.settings import LightConfig
from warpir.lighting.exposure import DARK, GroundWitness, ask_ground
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
    ground: GroundWitness | None
    """What the ground says of its level; None where it was not asked, or not seen."""
    gain: float
    """Factor on its light: the ground's, and what the tone operator needs to show it as the photo
    does."""
    light: SceneLight

    def record(self) -> dict[str, Any]:
        """Return what ``run.json`` says of it, plain values."""
        ground = None if self.ground is None else self.ground.record()
        return {"regression": self.regression.record(), "ground": ground}


def estimate_light(
    inputs: Inputs,
    asked: LightConfig,
    tone: str,
    regression: Regression | None = None,
) -> Estimate:
    """Estimate the light of the photo with the regressor, and check its level by the ground.

    What the regressor sees in the photo as `Photo.exposed` may be given where it is known.

    Raises:
        InputError: The weights are absent or damaged (`ExitCode.MODEL`).
    """
    path = None if asked.regressor is None else Path(asked.regressor)
    shown, gain_of_photo = inputs.photo.exposed()
    if regression is None:
        regression = regress(load_regressor(path), shown, inputs.camera)
    if asked.visible_sun:
        regression = with_visible_sun(regression, shown, inputs.camera)
    if gain_of_photo != 1.0:
        regression = regression.scaled(1.0 / gain_of_photo)
    stops, ground = asked.exposure, None
    assumed = [_describe_direction(regression)]
    if stops is None:
        ground = ask_ground(regression, inputs, asked.ground_albedo)
        stops = 0.0 if ground is None else ground.stops
        assumed.append(_describe_level(ground))
    gain = tone_gain(inputs, tone) * 2.0**stops
    shadow = light = Light(lobes=regression.lobes()).scaled(gain)
    if not regression.is_clear and inputs.shadow_mask is None:  # a mask tells of a lamp
        shadow = Light(lobes=regression.shadow_lobes()).scaled(gain)
    curves = Curves.identity(tone)
    scene_light = SceneLight(light, shadow, curves, float(np.log2(gain)), tuple(assumed))
    return Estimate(regression, ground, gain, scene_light)


def tone_gain(inputs: Inputs, tone: str) -> float:
    """Return by what a light in the photo's own unit is to be multiplied for the tone operator.

    An operator that never clips shows everything darker than it is; with this factor, white ground
    under an even light looks as the photo's ground does.
    """
    return 1.0 if tone == "linear" else 1.0 + start_level(inputs, tone)


def _describe_direction(regression: Regression) -> str:
    azimuth, elevation = angles_from_axis(regression.axis)
    if regression.sun_in_view is not None:
        return (
            f"the photo shows the sun: azimuth {azimuth:.0f}, elevation {elevation:.0f}, as strong "
            "as suns in view are; all other light is what the regressor sees in the photo "
            "(--no-visible-sun, --sun, --light)"
        )
    unclear = "from no clear direction, so its shadow is soft, perhaps mainly from"
    where = "mainly from" if regression.is_clear else unclear
    return (
        f"the light is what the regressor sees in the photo: {where} azimuth "
        f"{round(azimuth)}, elevation {round(elevation)}, +- {regression.spread_deg:.0f} degrees "
        "(--light, --sun, --sky)"
    )


def _describe_level(ground: GroundWitness | None) -> str:
    if ground is None:
        return (
            "the light's level is the estimated one: the photo shows too little of the ground to "
            "check it (--exposure)"
        )
    if ground.stops:
        return (
            f"the light is {ground.stops:+.2f} EV from the estimated one: the albedo of the "
            f"ground is {ground.albedo:.2g} instead of {ground.implied:.2g} (--exposure)"
        )
    doubt = ", which few grounds have: it may be too strong" if ground.implied < DARK else ""
    return (
        "the light's level is the estimated one, under which the ground's albedo is "
        f"{ground.implied:.2g}{doubt} (--ground-albedo, --exposure)"
    )
