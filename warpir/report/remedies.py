"""What to change where a picture looks wrong: commands that start from the run's own settings."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from warpir.app.command import BY_HAND
from warpir.app.config import InsertConfig, flag
from warpir.report.facts import in_words


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
    config: InsertConfig, record: Mapping[str, Any], camera: Mapping[str, Any] | None
) -> list[Remedy]:
    """Return what can be changed in a run, each with a value near the run's own.

    Args:
        config: Of the run.
        record: Content of its ``run.json``.
        camera: Content of its ``camera.json``; None where that is gone.
    """
    asked, measured = config.flat(), record["measured"]
    samples = measured.get("samples", asked["samples"])  # older records state the asked number
    samples = max(samples, *map(round, measured.get("mean_samples", {}).values()), 1)
    found = [] if config.is_guided else [*_light(asked, measured)]
    if asked["camera"] is None and not asked["demo"]:
        found += _camera(asked, measured, camera)
    found += _placement(asked, measured["placement"])
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
    is_demo_lit = asked["demo"] and asked["guidance"] == "none"
    if asked["light"] is not None or asked["reuse"] is not None or is_demo_lit:
        turned = (asked["light_rotate"] or 0.0) + 30.0
        about = "turns the light counter-clockwise as seen from above [degrees]"
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


def _camera(
    asked: Mapping[str, Any], measured: Mapping[str, Any], camera: Mapping[str, Any] | None
) -> Iterator[Remedy]:
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
    if camera is not None:
        fov = math.degrees(2.0 * math.atan(camera["w"] / 2.0 / camera["fx"]))
        about = f"horizontal field of view [degrees]; here {fov:.1f}"
        fault = "Near and far parts of it are in the wrong proportion"
        yield Remedy(fault, again(asked, fov=round(min(1.2 * fov, 120.0), 1)), about)


def _placement(asked: Mapping[str, Any], placed: Mapping[str, Any]) -> Iterator[Remedy]:
    # Where an object stands that was not placed, and how large it is then, follow from each other:
    # what shall stay is told.
    is_placed = any(asked[name] is not None for name in ("place", "at")) or asked["demo"]
    is_sized = any(asked[name] is not None for name in ("size", "scale"))
    at = {} if is_placed or placed.get("at") is None else {"at": tuple(placed["at"])}
    scale = {} if is_placed or is_sized or not at else {"scale": float(f"{placed['scale']:.4g}")}
    fault = "It stands in the wrong place"
    if asked["place"] is not None:
        about = "x, y, z of the ground under the object [metres]"
        yield Remedy(fault, again(asked, place=asked["place"]), about)
    elif asked["at"] is not None or at:
        about = "the photo's pixel of the ground on which it stands, from the top left"
        yield Remedy(fault, again(asked, **{"at": asked["at"]} | at, **scale), about)
    turn = asked["rotate_y"] or 0.0
    about = f"counter-clockwise as seen from above [degrees]; here {turn:g}"
    fault = "It looks the wrong way"
    yield Remedy(fault, again(asked, rotate_y=turn + 45.0, **at, **scale), about)
    fault = "It is too small or too large"
    if asked["size"] is not None:
        size = float(f"{1.2 * asked['size']:.3g}")
        about = f"its longest side [metres]; here {asked['size']:g}"
        yield Remedy(fault, again(asked, size=size, **at), about)
    elif "scale" in placed:
        about = f"factor on the file's own size; here {placed['scale']:.3g}"
        value = float(f"{1.2 * placed['scale']:.3g}")
        yield Remedy(fault, again(asked, scale=value, **at), about)
