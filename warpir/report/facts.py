"""Facts about a run as rows of text, read from its ``run.json``.

Files are called by their names alone, since a report is passed on; ``run.json`` has whole paths.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import PurePath
from typing import Any

from warpir.app.command import FLAGS, FORMS, SEPARATORS
from warpir.app.config import DEFAULTS, flag
from warpir.app.photo_world import WORDS
from warpir.app.record import PATHS, config_of_picture, is_hub_id, name_of
from warpir.app.settings import LightConfig

Rows = list[tuple[str, str]]
"""Name and text of each row."""


@dataclass(frozen=True)
class Setting:
    """One setting of a run."""

    name: str
    value: str
    is_set: bool
    """Whether it differs from the default."""
    is_settled: bool
    """Whether the prior's default was used for an open value."""


ABOUT_FILES = (
    ("composite.png", "The result, at the photo's own resolution, depth and profile"),
    ("layers.exr", "The composite and its layers, linear, for Nuke, Natron, Fusion, Blender"),
    ("envmap.exr", "The light of the place, a lat-long map in OpenEXR's orientation, float32"),
    ("envmap.hdr", "The same as Radiance RGBE"),
    ("envmap_preview.png", "The same as a picture"),
    ("envmap_shadow*", "The light that casts the shadow, where it has one of its own"),
    ("envmap_detail*", "The light on the object, with what the photo shows reflected in it"),
    ("envmap_web.hdr", "The light on the object as three.js reads it"),
    ("lobes.json", "The light's spherical Gaussians: --light reads them back"),
    ("lobes_shadow.json", "Those of the shadow's light"),
    ("lamps.json", "The lamps near the object, with the powers found: --lamps reads them back"),
    ("curves.json", "Knots of the tone curves"),
    ("tone_curve_object.cube", "The object's tone curve as a table for Nuke, Resolve, OCIO"),
    ("tone_curve_shadow.cube", "The shadow's tone curves as a table"),
    ("viewer.html", "The object on the photo in 3D, by three.js: one page that needs nothing else"),
    ("response.cube", "The camera's response, behind the tone curves, as a table"),
    ("camera.json", "The camera: --camera reads it back"),
    ("balls.png", "A mirror ball and a grey ball under the light"),
    ("materials.json", "Every material's factors, before and after: --materials reads them back"),
    ("optimization.json", "Numbers of every step of the optimisation"),
    ("prior.png", "What the model paints, before and after it was adapted to the photo"),
    ("lora_diffusers.safetensors", "The adapter that the model got for this photo, for diffusers"),
    ("lora_kohya.safetensors", "The same for kohya's tools and web interfaces"),
    ("object.glb", "The object where it stands, with the photo's camera, for any 3D tool"),
    ("photo.png", "The photo, upright, as Blender's script reads it"),
    ("blender_setup.py", "Builds the scene: blender --python blender_setup.py"),
    ("scene.usdz", "Object, light and camera for OpenUSD"),
    ("mitsuba/*", "The insertion as a scene of Mitsuba 3"),
    ("report.html", "This page"),
    ("run.json", "Settings, hashes, versions, figures: --config reads it back; written last"),
)
"""Purpose of each file by a pattern of its name; the first pattern that fits counts."""


def about_file(name: str) -> str:
    """Return the purpose of a run's file; empty where unknown."""
    return next((about for p, about in ABOUT_FILES if fnmatchcase(name, p)), "")


def without_folders(text: str, asked: Mapping[str, Any]) -> str:
    """Return a line of the run with file names in place of paths.

    Folders of configured files are removed first, as these may be relative; then those of absolute
    paths. A JSON pointer of glTF, such as ``/materials/0``, stays.
    """
    given = {path for name in PATHS if (path := asked.get(name)) is not None}
    if is_hub_id(asked.get("model")):
        given.discard(asked["model"])
    for path in sorted(given, key=len, reverse=True):
        if path != (called := name_of(path)) and set(path) - set("./~"):
            literal = called.replace("\\", r"\\")
            text = re.sub(rf"{_START}{re.escape(path)}(?![\w/])", literal, text)
    for folder in sorted({str(PurePath(path).parent) for path in given}, key=len, reverse=True):
        if set(folder) - set("./~"):
            text = re.sub(rf"{_START}{re.escape(folder)}/+(?=\S)", "", text)
    for pattern, separators in _WHOLE_PATHS:
        text = pattern.sub(partial(_last_part, separators), text)
    return text


def _last_part(separators: str, match: re.Match[str]) -> str:
    path = match[0]
    if _POINTER.fullmatch(path):
        return path
    return re.split(f"[{separators}]", path.rstrip(separators))[-1]


_START = r"(?<![\w./\\~-])"
"""Pattern of the start of a word or path."""


def _path_pattern(root: str, separators: str) -> re.Pattern[str]:
    """Return a pattern of whole paths.

    A folder's name may hold spaces, but no colon, semicolon or comma before one, and it ends with
    nothing that opens a quotation. Of the last part what follows a space is the sentence's.
    """
    word = rf"(?:[^{separators}\s:;,]|[:;,](?!\s|$))+"
    folder = rf"{word}(?: {word})*(?<![('\"\[=<])[{separators}]+"
    return re.compile(rf"(?:{root})(?:{folder})*{word}[{separators}]*")


_WHOLE_PATHS = (
    (_path_pattern(rf"{_START}(?:[A-Za-z]:[\\/]+|\\\\)", r"\\/"), r"\\/"),  # Windows
    # A file's address, a home, the root; an address of the web is no path.
    (_path_pattern(rf"file:/+|{_START}~[\w.-]*/+|(?<![:\w./\\~)<-])/+|(?<=\w:)/(?!/)", "/"), "/"),
)
"""Patterns of absolute paths, each with its separators."""
_POINTER = re.compile(
    r"/(?:accessors|animations|buffers|bufferViews|cameras|images|materials|meshes|nodes|samplers|"
    r"scenes|skins|textures|extensions/[A-Z]+_\w+(?:/lights)?)(?:/\d+(?:/\w+)*)?[^\w/]*"
)
"""Pattern of a JSON pointer of glTF 2.0, by the names of its top level."""


def command_line(asked: Mapping[str, Any]) -> str:
    """Return a command that makes the same result, files by their names alone."""
    words = ["python", "-m", "warpir.insert"]
    changed = config_of_picture(asked)
    for name in FORMS:
        value = changed.get(name, DEFAULTS[name])
        if value == DEFAULTS[name]:
            continue
        if isinstance(value, bool):
            is_open = DEFAULTS[name] is None and not value  # its flag alone would say yes
            words.append("--no-" + name.replace("_", "-") if is_open else flag(name))
        else:
            words.append(flag(name))
            words.append(in_words(name, value))
    return " ".join(shlex.quote(word) for word in [*words, "--out", "OUT"])


def in_words(name: str, value: Any) -> str:
    """Return a setting's value as on the command line; yes and no for True and False."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, tuple | list):
        return SEPARATORS.get(name, ",").join(in_words(name, part) for part in value)
    return str(value)


def settings(asked: Mapping[str, Any], record: Mapping[str, Any]) -> dict[str, list[Setting]]:
    """Return all settings by heading, without those that concern this one run alone.

    Args:
        asked: Settings as they were asked for, from `InsertConfig.flat`.
        record: Content of ``run.json``; ``measured`` holds what stood for open settings.
    """
    settled = record["measured"].get("settings", {})
    changed = config_of_picture(asked)
    by_heading: dict[str, list[Setting]] = {}
    for heading, forms in FLAGS.items():
        for name in (n for n in forms if n in changed):
            value, is_set = changed[name], changed[name] != DEFAULTS[name]
            is_settled = value is None and name in settled
            if is_settled:
                value = settled[name]
            words = "" if value is None or value == "" else in_words(name, value)
            by_heading.setdefault(heading, []).append(
                Setting(name.replace("_", "-"), words, is_set, is_settled)
            )
    return by_heading


# ------------------------------------------------------------------- where the light comes from


def light_sources(record: Mapping[str, Any], asked: LightConfig) -> Rows:
    """Return the origin of the light, with the uncertainty of estimates.

    Args:
        record: Content of ``run.json``.
        asked: What the user stated about the light.
    """
    measured = record["measured"]
    rows: Rows = [("the light", _source(record, asked))]
    if regression := measured.get("regression"):
        text = (
            f"± {regression['spread_deg']:.0f}° in the direction (concentration "
            f"{regression['concentration']:.1f}; 0 would be no idea); a factor of "
            f"{math.exp(regression['sun_log_std']):.1f} either way in the main light's "
            f"strength, {math.exp(regression['ambient_log_std']):.1f} in the rest's"
        )
        rows.append(("how sure the regressor was", text))
    if ground := measured.get("ground"):
        text = (
            f"{ground['implied_albedo']:.2g} under the light as it was regressed, "
            f"{ground['albedo']:.2g} after {ground['stops']:+.2f} EV on all of the light"
        )
        rows.append(("albedo of the ground", text))
    if "detail_seen" in measured:
        seen = 100.0 * measured["detail_seen"]
        rows.append(("reflections", f"the photo shows {seen:.0f} % of what is around the object"))
    prior = measured["prior"]
    if prior == "none":
        return rows
    rows.append(("prior", without_folders(_prior(prior, measured), record["config"])))
    rows += _guided(measured)
    return rows


def summary_line(record: Mapping[str, Any]) -> str:
    """Return the light's origin and the device of a run in one line."""
    measured = record["measured"]
    digest = measured.get("prior_sha256")
    prior = measured["prior"] + (f" (sha256 {digest[:16]}...)" if digest else "")
    accepted = measured.get("acceptance", {}).get("is_accepted")
    words = {True: ", its end accepted", False: ", its start kept", None: ""}[accepted]
    parts = [f"prior {prior}{words}"]
    if "regression" in measured:
        spread = measured["regression"]["spread_deg"]
        parts.append(f"light regressed from the photo, +- {spread:.0f} degrees")
    return f"summary: {'; '.join(parts)}; {_integrators(measured)} on {record['device']}"


def _integrators(measured: Mapping[str, Any]) -> str:
    names = measured.get("loop_integrator"), measured["integrator"]
    return " and ".join(dict.fromkeys(name for name in names if name))


def _source(record: Mapping[str, Any], asked: LightConfig) -> str:
    measured, values = record["measured"], record["config"]
    if asked.reuse is not None:
        text = f"that of an earlier run, {name_of(asked.reuse)}"
    elif asked.file is not None:
        text = f"given: {name_of(asked.file)}"
    elif asked.sun is not None or asked.sky is not None:
        parts = [f"--{n} {in_words(n, v)}" for n in ("sun", "sky") if (v := getattr(asked, n))]
        text = f"described: {' '.join(parts)}"
    elif "regression" in measured:
        found = measured["regression"]
        text = (
            f"estimated from the photo by warpir's regressor: azimuth {found['azimuth_deg']:.0f}°, "
            f"elevation {found['elevation_deg']:.0f}°"
        )
        if found.get("sun_in_view") is not None:
            text += f", where the photo shows the sun ({100.0 * found['sun_in_view']:.0f} % sure)"
    elif values.get("demo") and asked.start != "uniform":
        text = "the demo's own"
    else:
        text = "even, as none was given"
    if measured["prior"] != "none" and values.get("refine") is None:
        verdict = measured.get("acceptance")
        if verdict is not None and not verdict["is_accepted"]:
            return f"{text}; guidance proposed another, which was not accepted"
        return f"{text}, then changed by guidance"
    return text


def _prior(name: str, measured: Mapping[str, Any]) -> str:
    text = "Stable Diffusion" if name == "stable-diffusion" else name
    if measured.get("prior_sha256"):
        text += f" (sha256 {measured['prior_sha256'][:16]}...)"
    return text


def _guided(measured: Mapping[str, Any]) -> Rows:
    rows: Rows = []
    if prompt := measured.get("prompts", {}).get("guidance"):
        rows.append(("asked for", f"“{prompt}”"))
    if errors := measured.get("personalization", {}).get("error_before_after"):
        text = f"its error on the photo {errors[0]:.3g} before, {errors[-1]:.3g} after"
        rows.append(("adapted to the photo", text))
    if went := measured.get("optimization"):
        text = f"{went['steps']}, of which step {went['best_step']} was kept"
        skipped = went["skipped_steps"]
        text += f"; {skipped} were skipped for want of a finite gradient" if skipped else ""
        rows.append(("steps", text))
        if went["score_at_start"] is not None and went["best_score"] is not None:
            text = f"{went['score_at_start']:.4g} at the start, {went['best_score']:.4g} at the end"
            rows.append(("guidance score", f"{text} (lower is better)"))
    if verdict := measured.get("acceptance"):
        kept = "accepted" if verdict["is_accepted"] else "not accepted: the start was kept"
        if verdict["rise"] is not None and verdict["error"] is not None:
            kept += (
                f". Asked anew with {verdict['draws']} noises, the potential changed by "
                f"{verdict['rise']:.3g} ± {verdict['error']:.2g} from start to end"
            )
        rows.append(("the end", kept))
    return rows


def figures(record: Mapping[str, Any]) -> Rows:
    """Return plain figures of the run."""
    measured = record["measured"]
    rows: Rows = [
        ("device", str(record["device"])),
        ("integrator", _integrators(measured)),
        ("rays", measured["rays"]),
        ("triangles", f"{measured['triangles']:,}"),
        ("pixels of the object, as rendered", f"{measured['object_pixels']:,}"),
        ("pixels whose shadow was traced, as rendered", f"{measured['shadow_pixels']:,}"),
        ("pixels of the picture that differ from the photo", f"{measured['changed_pixels']:,}"),
        ("exposure of the light", f"{measured['exposure_ev']:+.2f} EV"),
        *([("noise taken out by", found)] if (found := measured.get("denoiser")) else []),
        *_look(measured.get("look", {})),
        *_coat(measured.get("ground_coat", {})),
    ]
    for key, what in (
        ("values_clamped_to_half", "values clamped to half precision"),
        ("bad_pixels", "pixels that stayed non-finite, set to black"),
    ):
        if measured[key]:
            rows.append((what, f"{measured[key]:,}"))
    return rows


def camera_sources(record: Mapping[str, Any]) -> Rows:
    """Return the camera's numbers with their sources and, of estimates, their uncertainty.

    Those of a camera file are in ``camera.json``; files of older runs say nothing.
    """
    numbers = record["measured"].get("camera", {})
    rows: Rows = []
    for name, what in WORDS.items():
        if number := numbers.get(name):
            sigma = "" if number["sigma"] is None else f" ± {number['sigma']:.1f}"
            rows.append((what, f"{number['value']:.1f}{sigma}° ({number['source']})"))
    if axis := numbers.get("principal"):
        across, down = (100.0 * share for share in axis["value"])
        text = f"{across:.0f} % from the left, {down:.0f} % from the top ({axis['source']})"
        rows.append(("optical axis in the photo", text))
    return rows


def _look(look: Mapping[str, Any]) -> Rows:
    """Return what of the photo's camera the object got; files of older runs say nothing."""
    rows: Rows = []
    if response := look.get("response"):
        toe = response.get("toe", 0.0)
        text = f"contrast {response['exponent']:.2f}, toe {toe:.4f} over gamma 2.2"
        if response["black"] is not None:
            text += f"; the photo's blacks are at code {255.0 * response['black']:.0f}"
        rows.append(("response of the object, as of the photo", text))
    if blur := look.get("blur"):
        rows.append(("blur of the object, as of the photo", f"{blur['sigma']:.2f} px"))
    if grain := look.get("grain"):
        weakest, strongest = (255.0 * f(map(f, grain["strength"])) for f in (min, max))
        text = f"{weakest:.1f} to {strongest:.1f} codes of 255, {grain['size']:.1f} px wide"
        rows.append(("grain on the object, as of the photo", text))
    if frame := look.get("frame"):
        text = f"frame {frame} of the sequence, for all frames of its size"
        rows.append(("photo in which these were estimated", text))
    if jpeg := look.get("jpeg"):
        rows.append(("JPEG coding of the object, as of the photo", f"quality {jpeg['quality']}"))
    return rows


def _coat(coat: Mapping[str, Any]) -> Rows:
    """Return what the photo's mirror images say of the ground, if they were asked for."""
    if not coat:
        return []
    text = coat["reason"]
    if coat["roughness"] is not None:
        text = f"{coat['roughness']:.2f} ± {coat['spread']:.2f}"
    return [("roughness of the ground, from its mirror images", text)]


def stage_words(stage: str) -> str:
    """Return the name of a stage of the timings in words."""
    return _STAGES.get(stage, re.sub("[_-]", " ", stage))


_STAGES = {
    "read": "read and check all inputs",
    "load": "load the renderer",
    "regress": "estimate the light from the photo",
    "preview": "preview",
    "scene": "build the scene, see what the photo shows around and what its camera did",
    "model": "load the prior",
    "personalize": "adapt the prior to the photo",
    "trace": "trace the transport",
    "optimize": "optimise",
    "accept": "judge the end",
    "render": "render",
    "write": "write the files",
}
