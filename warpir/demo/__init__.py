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
    """Return the configuration with the demo's files filled in.

    Its light and exposure are too with ``--guidance none`` and for ``--refine``; otherwise the
    light is what is to be found out.
    """
    from warpir.demo.place import placement

    where = placement()
    is_given = any(getattr(config, name) is not None for name in LIGHTS)
    is_recovered = is_given or (config.guided_by != "none" and config.refine is None)
    return replace(
        config,
        demo=False,
        photo=str(PHOTO),
        asset=str(ASSET),
        camera=str(CAMERA),
        place=where.place,
        rotate_y=where.rotate_y,
        light=config.light if is_recovered else str(LIGHT),
        exposure=config.exposure if is_recovered else 0.0,
        tone=config.tone if is_recovered else "linear",
    )
