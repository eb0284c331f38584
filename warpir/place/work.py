"""What the page asks for that needs torch or Warp, in a process of its own.

The process reads one job per line from standard input and answers on standard output, both JSON;
`warpir.place.worker` starts it, and ends it to cancel a job. torch and Warp are loaded with the
first job that needs them, and stay.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from warpir.app.command import read_values
from warpir.app.config import InsertConfig, flag
from warpir.app.inputs import Inputs, Loaders, read_inputs
from warpir.app.program import explain
from warpir.core.arrays import FloatArray
from warpir.core.errors import InputError
from warpir.io.images.photos import Photo, read_photo
from warpir.scene.camera import Camera
from warpir.scene.light import angles_from_axis

if TYPE_CHECKING:
    from warpir.lighting.regression import Regression

CLEAR_DEG = 40.0
"""Expected angle to the truth up to which a direction of the light counts as seen [deg]: that of a
network that sees nothing is 65, an even distribution over its directions."""

PREVIEW_SAMPLES, PREVIEW_DEPTH, PREVIEW_LIMIT = 12, 3, 8.0
"""Samples per pixel, longest light path, and most radiance after its first bounce of a preview."""
PREVIEW_ROWS = 160
"""Rows of its map of what the photo shows of the surroundings."""

Say = Callable[[dict[str, Any]], None]


def estimated_light(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Estimate the light of the photo as `warpir.insert` does where none is given.

    Args:
        job: ``config`` of the session and ``camera`` of the page.
        say: Hears of the progress.

    Returns:
        Plain values of `light_record`.

    Raises:
        InputError: The photo or the weights cannot be read.
    """
    from warpir.lighting.regression import regress
    from warpir.lighting.regressor import load_regressor
    from warpir.lighting.visible_sun import with_visible_sun

    config = config_of(job["config"])
    photo, camera = photo_of(config), camera_of(job["camera"])
    found = regress(load_regressor(None, "cpu"), photo.srgb, camera)
    return light_record(with_visible_sun(found, photo.srgb, camera))


def render_preview(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Insert as `warpir.insert` does, at preview quality, and write the composite.

    The photo is shrunk first, so that everything that follows is fast; its grain and its sharpness
    are those of the shrunk photo.

    Args:
        job: ``config`` of a placement; ``width`` of the picture [px] and ``picture``, the PNG file
            that is written.
        say: Hears of the progress: ``stage``, and ``share`` of it that is done [1].

    Returns:
        ``width`` [px], ``assumed``: one line each.

    Raises:
        InputError: As `warpir.insert` refuses it.
    """
    from warpir.lighting.detail import detail_of, with_detail
    from warpir.lighting.estimate import estimate_light
    from warpir.lighting.scene_light import make_light
    from warpir.render.composite import Quality, make_picture, scene_of
    from warpir.render.device import choose_device
    from warpir.render.renderer import Renderer

    say({"stage": "reading", "share": 0.0})
    config = config_of(job["config"])
    device, tone = choose_device(config.render.device), config.tone_operator
    inputs = shrunk(read_inputs(config, LOADERS), int(job["width"]))
    say({"stage": "light", "share": None})
    lit = make_light(inputs, config.light, tone)
    if lit is None:
        lit = estimate_light(inputs, config.light, tone, device).light
    detail = detail_of(inputs, lit.curves, PREVIEW_ROWS)
    lit = replace(lit, detailed=with_detail(lit.light, detail))
    say({"stage": "picture", "share": 0.0})
    scene = scene_of(inputs, inputs.camera, device, lit.curves)

    def report(stage: str, share: float) -> None:
        say({"stage": stage or "picture", "share": share})

    picture = make_picture(
        Renderer(scene, config.render.threads or 0, report),
        lit.on_object,
        lit.light_shadow,
        inputs.photo,
        Quality(PREVIEW_SAMPLES, 1, PREVIEW_DEPTH, config.render.seed, PREVIEW_LIMIT),
        lit.curves.foreground,
        lit.curves.shadow_ratio,
        is_reinhard=lit.curves.tone == "reinhard",
        occluder=inputs.occluder,
    )
    codes = np.round(np.clip(picture.image, 0.0, 1.0) * 255.0).astype(np.uint8)
    Image.fromarray(codes).save(job["picture"], "PNG", compress_level=1)
    return {"width": inputs.camera.width, "assumed": [*inputs.assumed, *lit.assumed]}


def shrunk(inputs: Inputs, width: int) -> Inputs:
    """Return the inputs with the photo, its camera and its mask at most this wide [px]."""
    photo, camera = inputs.photo, inputs.camera
    if camera.width <= width:
        return inputs
    size = width, max(1, round(width * camera.height / camera.width))

    def small(plane: FloatArray) -> FloatArray:
        return np.asarray(Image.fromarray(plane).resize(size, Image.Resampling.BOX))

    def each(planes: FloatArray) -> FloatArray:
        return np.stack([small(planes[..., k]) for k in range(3)], axis=-1)

    srgb = each(photo.srgb)
    codes = each(photo.codes) if photo.is_linear else np.round(srgb * 255.0).astype(np.uint8)
    occluder = inputs.occluder
    return replace(
        inputs,
        photo=replace(photo, codes=codes, srgb=srgb, kind="png", icc=None, jpeg=None),
        camera=camera.scaled(*size),
        occluder=None if occluder is None else small(occluder),
    )


def light_record(found: Regression) -> dict[str, Any]:
    """Return an estimated light as the page shows it, plain values.

    Irradiances and radiances are linear RGB in the photo's unit; of a light without a clear
    direction (`CLEAR_DEG`) the direction is None, and its irradiance is spread as the estimate's
    probability is.
    """
    is_clear = found.spread_deg <= CLEAR_DEG
    rest = replace(found, sun=np.zeros(3)) if is_clear else found
    up = np.array([0.0, 1.0, 0.0])
    above, below = (rest.irradiance(normal) / math.pi for normal in (up, -up))
    return {
        "direction": list(angles_from_axis(found.axis)) if is_clear else None,
        "spread_deg": found.spread_deg,
        "sun": found.sun.tolist() if is_clear else [0.0, 0.0, 0.0],
        "sun_log_std": found.sun_log_std,
        "sky": above.tolist(),
        "bounce": below.tolist(),
        "sun_in_view": found.sun_in_view,
    }


def config_of(values: Mapping[str, Any]) -> InsertConfig:
    """Return the configuration of plain values, as a configuration file has them."""
    return InsertConfig(**read_values({name: (v, flag(name)) for name, v in values.items()}))


def camera_of(record: Mapping[str, Any]) -> Camera:
    """Return the camera of a record that `warpir.scene.camera.Camera.record` has made."""
    width, height, fx, fy, cx, cy = (record[name] for name in ("w", "h", "fx", "fy", "cx", "cy"))
    return Camera(width, height, fx, fy, cx, cy, np.array(record["c2w"]))


@lru_cache(maxsize=1)
def _photo(path: str, layer: str | None, alpha: str, strict: bool, max_pixels: int) -> Photo:
    return read_photo(path, layer=layer, alpha=alpha, strict=strict, max_pixels=max_pixels)


def photo_of(config: InsertConfig) -> Photo:
    """Return the photo of a configuration; the last one is kept."""
    asked = config.inputs
    assert asked.photo is not None
    return _photo(asked.photo, asked.layer, asked.alpha, asked.strict, config.limits.pixels)


def warm_up(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Load what a preview needs, while nobody waits."""
    import_module("warpir.lighting.estimate")
    import_module("warpir.render.composite")
    from warpir.render.device import choose_device

    return {"device": choose_device(None)}


LOADERS = Loaders()
"""Keeps the asset between two previews."""
JOBS: dict[str, Callable[[Mapping[str, Any], Say], dict[str, Any]]] = {
    "light": estimated_light,
    "preview": render_preview,
    "warm": warm_up,
}
"""What is answered, by the job's kind."""


def serve() -> None:
    """Answer jobs until standard input ends."""
    # Ctrl-C at the terminal reaches this process too: who started it ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # What libraries print must not stand between the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def say(answer: dict[str, Any]) -> None:
        print(json.dumps(answer, allow_nan=False), file=answers, flush=True)

    for line in sys.stdin:
        job = json.loads(line)
        try:
            say({"answer": JOBS[job["kind"]](job, say)})
        except InputError as error:
            say({"error": [str(error.where), error.what, error.advice]})
        except Exception as error:
            say({"error": ["warpir", explain(error)[1][0], ""]})


if __name__ == "__main__":
    serve()
