"""What to change where a picture looks wrong: commands that start from the run's own settings."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from warpir.app.command import BY_HAND
from warpir.app.config import InsertConfig, flag
from warpir.core.arrays import BoolArray
from warpir.report.facts import in_words

TRIAL_FOV = 65.0
"""Horizontal field of view of a phone's main camera, a value to try [deg]."""


@dataclass(frozen=True)
class Remedy:
    """A fault that can be seen, and the command against it."""

    fault: str
    command: str
    about: str
    """Meaning of the flags, and the values of this run."""


def again(asked: Mapping[str, Any], **changes: Any) -> str:
    """Return the command that repeats a run by its ``run.json`` with some settings changed."""
    words = ["python", "-m", "warpir.insert", "--config", "run.json"]
    words += [flag(name) for name in BY_HAND if asked[name]]
    for name, value in changes.items():
        words += [flag(name), in_words(name, value)]
    return " ".join(shlex.quote(word) for word in [*words, "--out", "OUT"])


def remedies(
    config: InsertConfig, record: Mapping[str, Any], matte: BoolArray | None
) -> list[Remedy]:
    """Return what can be changed in a run, each with a value near the run's own.

    Args:
        config: Of the run.
        record: Content of its ``run.json``.
        matte: Where the object is seen, shape [H, W]; None where that is not known.
    """
    asked, measured = config.flat(), record["measured"]
    samples = measured.get("samples", asked["samples"])  # older records state the asked number
    found = [] if config.is_guided else [*_light(asked, measured)]
    if asked["camera"] is None and not asked["demo"]:
        found += _camera(asked, measured)
    found += _placement(asked, measured, matte)
    found += [
        Remedy(
            "Something in the photo should stand before the object",
            again(asked, occluder_mask="mask.png"),
            "white where the photo covers the object; warpir-place paints one",
        ),
        Remedy(
            "The object or its shadow is noisy",
            again(asked, samples=4 * samples),
            f"this run took {samples}; four times as many halve the noise",
        ),
        Remedy(
            "The object is softer, grainier or flatter than the photo",
            again(asked, sharpness="off", grain="off", response="off"),
            "leaves out what was estimated of the photo's camera; each takes a value, too",
        ),
    ]
    return found


def _light(asked: Mapping[str, Any], measured: Mapping[str, Any]) -> Iterator[Remedy]:
    azimuth, elevation = (round(measured["light"][f"{n}_deg"]) for n in ("azimuth", "elevation"))
    fault = "The shadow falls to the wrong side"
    if asked["light"] is not None or asked["reuse"] is not None or asked["demo"]:
        turned = (asked["light_rotate"] or 0.0) + 30.0
        about = "turns the light clockwise as seen from above [degrees]"
        yield Remedy(fault, again(asked, light_rotate=turned), about)
    else:
        sky = {} if asked["sky"] is not None else {"sky": "clear"}
        sun = (float(azimuth), float(max(elevation, 5)))
        about = (
            "azimuth, clockwise from -Z of the world as seen from above, and elevation of the sun "
            f"[degrees]; here {azimuth} and {elevation}"
        )
        yield Remedy(fault, again(asked, sun=sun, **sky), about)
    stops = measured["exposure_ev"]
    yield Remedy(
        "The object is too dark",
        again(asked, exposure=round(stops + 0.5, 2)),
        f"level of the light [EV]; here {stops:+.2f}. Less where it is too bright",
    )


def _camera(asked: Mapping[str, Any], measured: Mapping[str, Any]) -> Iterator[Remedy]:
    numbers = measured.get("camera", {})
    if "pitch_deg" not in numbers or "vfov_deg" not in numbers:
        return
    pitch, vfov = numbers["pitch_deg"], numbers["vfov_deg"]
    fault = "The object tilts out of the photo's perspective"
    if asked["pitch"] is None:
        axis = numbers.get("principal", {}).get("value", (0.5, 0.5))[1]
        roll = numbers.get("roll_deg", {}).get("value", 0.0)
        angles = (math.radians(degrees) for degrees in (pitch["value"], vfov["value"] / 2.0, roll))
        up, half, turn = (math.tan(next(angles)), math.tan(next(angles)), math.cos(next(angles)))
        row = axis + up / (2.0 * half * turn)
        about = "height of the horizon in the photo, 0 at its top, 1 at its bottom; here "
        yield Remedy(fault, again(asked, horizon=round(row, 3)), f"{about}{row:.2f}")
    else:
        about = f"up from the level [degrees]; here {pitch['value']:.1f}"
        yield Remedy(fault, again(asked, pitch=pitch["value"] + 3.0), about)
    about = f"horizontal field of view [degrees]; vertically this run has {vfov['value']:.0f}"
    yield Remedy(
        "Near and far parts of it are in the wrong proportion",
        again(asked, fov=asked["fov"] or TRIAL_FOV),
        about,
    )


def _placement(
    asked: Mapping[str, Any], measured: Mapping[str, Any], matte: BoolArray | None
) -> Iterator[Remedy]:
    if asked["place"] is not None:
        about = "x, y, z of the ground under the object [metres]"
        yield Remedy("It stands in the wrong place", again(asked, place=asked["place"]), about)
    else:
        at = asked["at"]
        if at is None and matte is not None and matte.any():
            rows, columns = np.nonzero(matte)
            at = (round(float(columns.mean())), int(rows.max()))
        if at is not None and not asked["demo"]:
            about = "the photo's pixel of the ground on which it stands, from the top left"
            yield Remedy("It stands in the wrong place", again(asked, at=at), about)
    turn = asked["rotate_y"] or 0.0
    about = f"counter-clockwise as seen from above [degrees]; here {turn:g}"
    yield Remedy("It looks the wrong way", again(asked, rotate_y=turn + 45.0), about)
    if asked["size"] is not None:
        size = float(f"{1.2 * asked['size']:.3g}")
        about = f"its longest side [metres]; here {asked['size']:g}"
        yield Remedy("It is too small or too large", again(asked, size=size), about)
    elif "scale" in measured["placement"]:
        scale = measured["placement"]["scale"]
        about = f"factor on the file's own size; here {scale:.3g}"
        value = float(f"{1.2 * scale:.3g}")
        yield Remedy("It is too small or too large", again(asked, scale=value), about)
