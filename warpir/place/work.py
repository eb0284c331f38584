"""What the page asks for that needs Warp or a network, in a process of its own.

The process reads one job per line from standard input and answers on standard output, both JSON;
`warpir.place.worker` starts it, and SIGUSR1 cancels a job at its next line of progress. Warp and
the networks are loaded with the first job that needs them, and stay.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image

from warpir.app.command import read_values
from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs, read_inputs
from warpir.app.program import explain, silence_warnings
from warpir.core.color import codes_of
from warpir.core.errors import InputError
from warpir.place.kept import Kept
from warpir.scene.camera import Camera
from warpir.scene.light import angles_from_axis

if TYPE_CHECKING:
    from warpir.lighting.regression import Regression
    from warpir.lighting.scene_light import SceneLight
    from warpir.render.renderer import Renderer

PREVIEW_SAMPLES, PREVIEW_DEPTH, PREVIEW_LIMIT = 12, 3, 4.0
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
    from warpir.lighting.visible_sun import with_visible_sun

    config, camera = InsertConfig(**read_values(job["config"])), camera_of(job["camera"])
    found = KEPT.regression(config, camera)
    shown, gain = KEPT.photo(config.inputs, config.limits).exposed()
    return light_record(with_visible_sun(found, shown, camera).scaled(1.0 / gain))


def render_preview(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Insert as `warpir.insert` does, at preview quality, and write the composite.

    Args:
        job: As for `_prepared`; ``picture`` is the PNG file that is written.
        say: Hears of the progress: ``stage``, and ``share`` of it that is done [1].

    Returns:
        ``width`` [px], ``assumed``: one line each.

    Raises:
        InputError: As `warpir.insert` refuses it.
    """
    from warpir.look.camera_look import look_of_preview
    from warpir.render.composite import make_picture
    from warpir.render.device import keep_kernels
    from warpir.render.picture.quality import Quality

    config = InsertConfig(**read_values(job["config"]))
    inputs, lit, renderer = _prepared(config, int(job["width"]), say)
    picture = make_picture(
        renderer,
        lit.on_object,
        lit.light_shadow,
        inputs.photo,
        Quality(
            PREVIEW_SAMPLES, 1, PREVIEW_DEPTH, config.render.seed, PREVIEW_LIMIT * inputs.photo.unit
        ),
        lit.curves,
        occluder=inputs.occluder,
        shadow_mask=inputs.shadow_mask,
        look=look_of_preview(inputs.photo, config.look.response),
    )
    keep_kernels()  # this process may be killed
    Image.fromarray(codes_of(picture.image)).save(job["picture"], "PNG", compress_level=1)
    return {"width": inputs.camera.width, "assumed": [*inputs.assumed, *lit.assumed]}


def warm_up(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Read, load and compile what the preview of a placement needs, while nobody waits.

    Returns:
        ``device``: Warp's name of it.

    Raises:
        InputError: As `warpir.insert` refuses it.
    """
    from warpir.render.device import keep_kernels

    _, _, renderer = _prepared(InsertConfig(**read_values(job["config"])), int(job["width"]), say)
    renderer.load_kernels()
    keep_kernels()
    return {"device": str(renderer.device)}


def _prepared(config: InsertConfig, width: int, say: Say) -> tuple[Inputs, SceneLight, Renderer]:
    """Return inputs, light and renderer of a preview of that width [px].

    The photo is shrunk first, so that everything that follows is fast; its grain and its sharpness
    are those of the shrunk photo. A heavy object is thinned as for the browser.

    Raises:
        InputError: As `warpir.insert` refuses it.
    """
    from warpir.lighting.detail import detail_of, with_detail
    from warpir.lighting.estimate import estimate_light
    from warpir.lighting.scene_light import make_light
    from warpir.render.device import choose_device
    from warpir.render.picture.photo_scene import scene_of
    from warpir.render.renderer import Renderer

    say({"stage": "reading", "share": 0.0})
    device, tone = choose_device(config.render.device), config.tone_operator
    whole = KEPT.thinned(read_inputs(config, KEPT), config.inputs)
    inputs = KEPT.shrunk(whole, width)
    say({"stage": "light", "share": None})
    lit = make_light(inputs, config.light, tone)
    if lit is None:
        seen = KEPT.regression(config, whole.camera)
        lit = estimate_light(inputs, config.light, tone, seen).light
    detail = detail_of(inputs, lit.curves, PREVIEW_ROWS)
    lit = replace(lit, detailed=with_detail(lit.light, detail))
    say({"stage": "picture", "share": 0.0})
    scene = scene_of(inputs, inputs.camera, device, lit.curves)

    def report(stage: str, share: float) -> None:
        say({"stage": stage or "picture", "share": share})

    return inputs, lit, Renderer(scene, config.render.threads or 0, report)


def light_record(found: Regression) -> dict[str, Any]:
    """Return an estimated light as the page shows it, plain values.

    Irradiances and radiances are linear RGB in the photo's unit; of a light without a clear
    direction (`Regression.is_clear`) the direction is None, and its irradiance is spread as the
    estimate's probability is.
    """
    is_clear = found.is_clear
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


def camera_of(record: Mapping[str, Any]) -> Camera:
    """Return the camera of a record that `warpir.scene.camera.Camera.record` has made."""
    width, height, fx, fy, cx, cy = (record[name] for name in ("w", "h", "fx", "fy", "cx", "cy"))
    return Camera(width, height, fx, fy, cx, cy, np.array(record["c2w"]))


def load(job: Mapping[str, Any], say: Say) -> dict[str, Any]:
    """Load the libraries that every other job needs, before the page asks for anything."""
    import_module("warpir.lighting.estimate")
    import_module("warpir.render.composite")
    from warpir.render.device import choose_device

    return {"device": choose_device(None)}


KEPT = Kept()
JOBS: dict[str, Callable[[Mapping[str, Any], Say], dict[str, Any]]] = {
    "light": estimated_light,
    "load": load,
    "preview": render_preview,
    "warm": warm_up,
}
"""What is answered, by the job's kind."""


def serve() -> None:
    """Answer jobs until standard input ends."""
    # Ctrl-C at the terminal reaches this process too: who started it ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    is_cancelled = threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: is_cancelled.set())
    # What libraries print must not stand between the answers.
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    silence_warnings()

    def say(answer: dict[str, Any]) -> None:
        print(json.dumps(answer, allow_nan=False), file=answers, flush=True)

    def tell(progress: dict[str, Any]) -> None:
        if is_cancelled.is_set():
            raise InputError("the page", "stopped before it was done")
        say(progress)

    for line in sys.stdin:
        job = json.loads(line)
        is_cancelled.clear()
        try:
            say({"answer": JOBS[job["kind"]](job, tell)})
        except InputError as error:
            say({"error": [str(error.where), error.what, error.advice]})
        except Exception as error:
            say({"error": ["warpir", explain(error)[1][0], ""]})


if __name__ == "__main__":
    serve()
