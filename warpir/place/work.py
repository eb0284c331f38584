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
from typing import TYPE_CHECKING, Any

import numpy as np

from warpir.app.command import read_values
from warpir.app.config import InsertConfig, flag
from warpir.app.program import explain
from warpir.core.errors import InputError
from warpir.io.images.photos import Photo, read_photo
from warpir.scene.camera import Camera
from warpir.scene.light import angles_from_axis

if TYPE_CHECKING:
    from warpir.lighting.regression import Regression

CLEAR_DEG = 40.0
"""Expected angle to the truth up to which a direction of the light counts as seen [deg]: that of a
network that sees nothing is 65, an even distribution over its directions."""

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


def light_record(found: Regression) -> dict[str, Any]:
    """Return an estimated light as the page shows it, plain values.

    Irradiances and radiances are linear RGB in the photo's unit; of a light without a clear
    direction (`CLEAR_DEG`) the direction is None, and its irradiance is spread as the estimate's
    probability is.
    """
    is_clear = found.spread_deg <= CLEAR_DEG
    rest = replace(found, sun=np.zeros(3)) if is_clear else found
    above, below = rest.irradiance(np.array([[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])) / math.pi
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
    numbers = (record[name] for name in ("w", "h", "fx", "fy", "cx", "cy"))
    return Camera(*numbers, np.array(record["c2w"]))


@lru_cache(maxsize=1)
def _photo(path: str, layer: str | None, alpha: str, strict: bool, max_pixels: int) -> Photo:
    return read_photo(path, layer=layer, alpha=alpha, strict=strict, max_pixels=max_pixels)


def photo_of(config: InsertConfig) -> Photo:
    """Return the photo of a configuration; the last one is kept."""
    asked = config.inputs
    assert asked.photo is not None
    return _photo(asked.photo, asked.layer, asked.alpha, asked.strict, config.limits.pixels)


JOBS: dict[str, Callable[[Mapping[str, Any], Say], dict[str, Any]]] = {"light": estimated_light}
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
