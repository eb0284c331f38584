"""The scene that ships with warpir: a square in the sun, a small car, and the light itself.

Everything is made by ``python -m warpir.demo.make``; nothing is downloaded or scanned.
"""

from dataclasses import replace
from pathlib import Path

from warpir.config import LIGHTS, InsertConfig

FOLDER = Path(__file__).parent
PHOTO, ASSET, LIGHT, CAMERA = (
    FOLDER / name for name in ("photo.png", "car.glb", "sky.exr", "camera.json")
)


def demo_config(config: InsertConfig) -> InsertConfig:
    """Return the configuration with the demo's files filled in, and its place where none is named.

    Its light and exposure are too with ``--guidance none`` and for ``--refine``; otherwise the
    light is what is to be found out. What the user named is kept.
    """
    from warpir.demo.place import placement

    where = placement()
    is_placed = config.place is not None or config.at is not None
    is_given = any(getattr(config, name) is not None for name in LIGHTS)
    is_recovered = is_given or (config.guided_by != "none" and config.refine is None)
    return replace(
        config,
        demo=False,
        photo=str(PHOTO),
        asset=str(ASSET),
        camera=str(CAMERA),
        place=config.place if is_placed else where.place,
        rotate_y=config.rotate_y or where.rotate_y,
        light=config.light if is_recovered else str(LIGHT),
        exposure=0.0 if config.exposure is None and not is_recovered else config.exposure,
        tone=config.tone or (None if is_recovered else "linear"),
    )
