"""The scene that ships with warpir: a square in the sun, a small car, and the light itself.

The files beside this module are made by ``python -m tools.demo.make``, which is not installed;
nothing is downloaded or scanned.
"""

from pathlib import Path

from warpir.app.config import LIGHTS, InsertConfig

FOLDER = Path(__file__).parent
PHOTO, WET_PHOTO, ASSET, LIGHT, CAMERA = (
    FOLDER / name for name in ("photo.png", "wet.jpg", "car.glb", "sky.exr", "camera.json")
)
WET_ROUGHNESS = 0.2
"""Perceptual roughness of the film of water on the square's paving after rain [1]."""
PLACE = (0.15, 0.0, -9.3)
"""Point on the ground under the car's origin, world frame [m]: three-quarter view, about a third of
the picture's width."""
ROTATE_Y = 33.0
"""Turn of the car about +Y, from the front toward +X [deg]."""


def demo_config(config: InsertConfig) -> InsertConfig:
    """Return the configuration with the demo's files filled in, and its place where none is named.

    Its light and exposure are too with ``--guidance none`` and for ``--refine``; otherwise the
    light is what is to be found out. What the user named is kept.
    """
    is_placed = config.placement.place is not None or config.placement.at is not None
    is_given = any(config.flat()[name] is not None for name in LIGHTS)
    is_recovered = is_given or (config.guidance.kind != "none" and config.task.refine is None)
    is_wet, stated = config.inputs.demo == "wet", config.render.ground_roughness
    return config.changed(
        demo=False,
        photo=str(WET_PHOTO if is_wet else PHOTO),
        ground_roughness=WET_ROUGHNESS if is_wet and stated == "off" else stated,
        asset=str(ASSET),
        camera=str(CAMERA),
        place=config.placement.place if is_placed else PLACE,
        rotate_y=config.placement.rotate_y or ROTATE_Y,
        light=config.light.file if is_recovered else str(LIGHT),
        exposure=0.0
        if config.light.exposure is None and not is_recovered
        else config.light.exposure,
        tone=config.light.tone or (None if is_recovered else "linear"),
    )
