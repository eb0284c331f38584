"""The report of a run: ``report.html``, one page that needs no other file and no network.

Pictures are data URIs; style and script are inline and named by their hashes in the page's content
security policy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import PurePath
from typing import Any

import numpy as np

from warpir.app.config import DEFAULTS, InsertConfig
from warpir.app.earlier_runs import config_of_record
from warpir.app.record import name_of
from warpir.core.arrays import CodeArray, FloatArray, on_cores
from warpir.core.limits import LIMITS
from warpir.core.strict_json import read_json_object
from warpir.io.layers import Layers
from warpir.io.results import OutputFolder
from warpir.lighting.regression import CLEAR_DEG
from warpir.report.facts import (
    about_file,
    camera_sources,
    command_line,
    figures,
    light_sources,
    settings,
    stage_words,
    without_folders,
)
from warpir.report.html import render_page
from warpir.report.panorama import Panorama, panorama, pose_of
from warpir.report.pictures import Layer, before_and_after, jpeg, layers_shown, object_box
from warpir.report.plots import Plot, Series, line_plot
from warpir.report.remedies import again, remedies
from warpir.report.words import LightCharacter, characterize, light_rows, origin_words
from warpir.scene.tone_curves import Curves

REPORT = "report.html"
CLOCK, END = "<!--clock-->", "<!--/clock-->"
"""Comments around the part that differs between equal runs: seconds and memory."""
MADE_BY = b'<meta name="generator" content="warpir '
"""Marker of warpir's pages, within the first 4096 bytes."""
LEAST_PHOTO = 8.0
"""Initial share of the photo at the comparison's slider [%]."""


@dataclass(frozen=True)
class Results:
    """A run's results, in memory or read from its folder; the page leaves out what is absent."""

    record: Mapping[str, Any] = field(default_factory=dict)
    """Content of ``run.json``, with or without ``files``."""
    files: Mapping[str, str] = field(default_factory=dict)
    """sha256 of the files by their names."""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """Sizes of the same files [byte]."""
    layers: Layers | None = None
    light: FloatArray | None = None
    """The light of the scene, as in ``envmap.exr``, shape [He, 2 He, 3]."""
    light_shadow: FloatArray | None = None
    """The light of the shadow, where it has one of its own."""
    light_detail: FloatArray | None = None
    """The light on the object with the photo's detail, where there is one."""
    balls: CodeArray | None = None
    """Content of ``balls.png``."""
    curves: Curves | None = None
    camera: Mapping[str, Any] | None = None
    """Content of ``camera.json``."""
    optimization: Mapping[str, Any] | None = None
    """Content of ``optimization.json``, where a prior guided."""
    missing: tuple[str, ...] = ()
    """Files that are gone or have changed since the run."""

    @cached_property
    def character(self) -> LightCharacter | None:
        """Character of `light`; None where there is none, or it is black."""
        return self._characterize(self.light)

    @cached_property
    def character_shadow(self) -> LightCharacter | None:
        """Character of `light_shadow`, likewise."""
        return self._characterize(self.light_shadow)

    def _characterize(self, texels: FloatArray | None) -> LightCharacter | None:
        if texels is None or not texels.any():
            return None
        placement = self.record["measured"].get("placement", {})
        normal = np.asarray(placement.get("ground", (0.0, 1.0, 0.0, 0.0))[:3], np.float64)
        return characterize(texels, normal, pose_of(self.camera))


def write_report(output: OutputFolder, results: Results) -> None:
    """Stage ``report.html``.

    Args:
        output: Holds all other files, which the page lists with their hashes.
        results: The run's; its files and ``optimization.json`` are taken from `output`.

    Raises:
        InputError: The disk is full (exit 5).
    """
    steps = "optimization.json"
    if steps in output.hashes:
        results = replace(results, optimization=read_json_object(output.staging / steps, LIMITS))
    results = replace(results, files=output.hashes, sizes=output.sizes())
    output.write_bytes(REPORT, report_page(results))


def report_page(results: Results, is_beside: bool = True) -> bytes:
    """Return the page, in UTF-8."""
    record, config = results.record, config_of(results.record)
    asked = config.flat()
    photo = (
        "the demo's photo" if config.inputs.demo else PurePath(config.inputs.photo or "photo").name
    )
    asset = "A car" if config.inputs.demo else PurePath(config.inputs.asset or "object").name
    character = results.character
    # Encoding pictures takes most of the time.
    parts: tuple[Callable[[Results], Any], ...] = (_comparison, _layers, _skies)
    comparison, layers, skies = on_cores(lambda make: make(results), parts)
    return render_page(
        "report",
        kind="warpir, report of a run",
        title=f"{asset} in {photo}",
        lead=_lead(results),
        missing=results.missing,
        is_beside=is_beside,
        comparison=comparison,
        layers=layers,
        skies=skies,
        light=light_rows(character, results.character_shadow) if character is not None else [],
        balls=jpeg(results.balls) if results.balls is not None else None,
        camera_sources=camera_sources(record),
        light_sources=light_sources(record, config.light),
        tone_plots=_tone_plots(results.curves) if results.curves is not None else [],
        tone=results.curves.tone if results.curves is not None else "linear",
        convergence=_convergence(results.optimization) if results.optimization is not None else [],
        notices=[
            (name == "notices", without_folders(line, asked))
            for name in ("notices", "assumed")
            for line in record[name]
        ],
        figures=figures(record),
        **_clock(record),
        remedies=remedies(config, record, results.camera),
        command_by_record=again(asked),
        command_by_flags=command_line(asked),
        settings=settings(asked, record),
        inputs=_inputs(asked, record),
        files=_files(results),
        about_record=(about := about_file("run.json"))[:1].lower() + about[1:],
        versions=[(str(name), str(text)) for name, text in record["versions"].items()],
    )


def config_of(record: Mapping[str, Any]) -> InsertConfig:
    """Return the configuration that a ``run.json`` holds.

    Raises:
        InputError: A value is none that a run could have had.
    """
    known = {name: value for name, value in record["config"].items() if name in DEFAULTS}
    return config_of_record(known)


# -------------------------------------------------------------------- values of the template


def _lead(results: Results) -> str:
    measured = results.record["measured"]
    parts = [measured["placement"]["summary"]] if "placement" in measured else []
    if results.character is not None:
        parts.append(f"The light comes {origin_words(results.character)}")
        spread = measured.get("regression", {}).get("spread_deg", 0.0)
        if spread > CLEAR_DEG:
            parts[-1] += f", by an estimate that is unsure of it (± {spread:.0f} degrees)"
    return ". ".join(part[:1].upper() + part[1:] for part in parts) + ("." if parts else "")


def _comparison(results: Results) -> dict[str, Any] | None:
    """Return photo and result, whole and around the object, and the slider's start."""
    layers = results.layers
    if layers is None:
        return None
    height, width = layers.matte.shape
    views = [("view-whole", "Whole picture", before_and_after(layers))]
    start, focus = 50.0, (0.5, 0.5)
    if (box := object_box(layers)) is not None:
        # At first all of the object is seen, and beside it the photo as it was.
        start = max(100.0 * box[0] / width, LEAST_PHOTO)
        focus = (box[0] + box[2]) / 2.0 / width, (box[1] + box[3]) / 2.0 / height
        views.append(("view-object", "The object", before_and_after(layers, box)))
    small = views[0][2][0]
    size = f"{width} × {height} pixels"
    if small.width < width:
        size += f", here averaged to {small.width} × {small.height}"
    return {
        "views": [
            {"id": id_, "name": name, "before": before, "after": after}
            for id_, name, (before, after) in views
        ],
        "start": f"{start:.1f}",
        "focus": [f"{share:.3f}" for share in focus],
        "size": size,
        "there": [name for name in results.files if name in results.sizes],
        "is_seen": bool((layers.matte > 0.0).any()),
    }


def _layers(results: Results) -> list[Layer]:
    return layers_shown(results.layers) if results.layers is not None else []


def _skies(results: Results) -> list[Panorama]:
    tone = results.curves.tone if results.curves is not None else "linear"
    character = results.character
    lights = (
        ("sky-light", "Light", results.light, character),
        ("sky-detail", "With reflections", results.light_detail, character),
        ("sky-shadow", "Of the shadow", results.light_shadow, results.character_shadow),
    )
    return [
        panorama(name, id_, texels, results.camera, of, tone)
        for id_, name, texels, of in lights
        if results.light is not None and texels is not None
    ]


def _tone_plots(curves: Curves) -> list[Plot]:
    """Plot both tone curves; nothing where both are the identity."""
    if all(knots.is_identity for knots in (curves.foreground, curves.shadow_ratio)):
        return []
    x = np.linspace(0.0, 1.0, 101)
    unchanged = Series(np.array([0.0, 1.0]), np.array([0.0, 1.0]), "same")
    plots = []
    for knots, title, styles in (
        (curves.foreground, "Tone curve of the object", ("s0",)),
        (curves.shadow_ratio, "Tone curves of the shadow", ("s1", "s2", "s3")),
    ):
        y = knots.evaluate(x)
        lines = [Series(x, y[:, k], style) for k, style in enumerate(styles)]
        unit = (0.0, 1.0)
        plots.append(
            line_plot([unchanged, *lines], title, ("in", "out"), x_range=unit, y_range=unit)
        )
    return plots


_TERMS = {
    "score": "guidance score (lower is better)",
    "gradient": "norm of guidance's gradient",
    "trust": "penalty: distance from the start",
    "consistency": "penalty: both lights differ",
    "spread": "penalty: spread of the shadow's light",
    "chroma": "penalty: colour of the light",
    "bend": "penalty: bend of the tone curves",
}


def _convergence(optimization: Mapping[str, Any]) -> list[tuple[str, Plot]]:
    """Plot every series of the optimisation that has numbers, with its caption."""
    columns = optimization["by_step"]
    order = [name for name in _TERMS if name in columns]
    plots = []
    for name in (*order, *sorted(set(columns) - set(order))):
        points = [(k + 1, value) for k, value in enumerate(columns[name]) if value is not None]
        if name == "score" and optimization.get("score_at_start") is not None:
            points.insert(0, (0, optimization["score_at_start"]))
        if not points:
            continue
        step, value = np.array(points, np.float64).T
        label = name.replace("_", " ")
        about = _TERMS.get(name, label)
        plot = line_plot(
            [Series(step, value)],
            f"{about} by step: from {value[0]:.4g} to {value[-1]:.4g}",
            ("step", label),
            x_range=(0.0, float(max(len(columns[name]), 1))),
            marks={"kept": float(optimization["best_step"])} if name == "score" else None,
        )
        plots.append((about, plot))
    return plots


def _clock(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return seconds and memory, which differ between equal runs."""
    seconds = {stage: s for stage, s in record["seconds"].items() if stage != "report"}
    peak = record.get("peak_mib", {})
    return {
        "clock_start": CLOCK,
        "clock_end": END,
        "stages": [(stage_words(stage), spent) for stage, spent in seconds.items()],
        "total_seconds": sum(seconds.values()),
        "memory": "; ".join(f"{where} {mib:,.0f} MiB" for where, mib in peak.items()),
    }


def _inputs(asked: Mapping[str, Any], record: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return (input, file, sha256) of each input."""
    rows = []
    for name, digest in record["inputs"].items():
        field_name, _, file = name.partition("/")
        given = asked.get(field_name)
        called = file or (name_of(given) if isinstance(given, str) else "")
        if not called and asked["demo"]:
            called = "the demo's own"
        rows.append((name, called, without_folders(str(digest), asked)))
    return rows


def _files(results: Results) -> list[tuple[str, str, str, str]]:
    """Return (name, purpose, size, sha256) of each file but the page itself."""
    return [
        (name, about_file(name), _size(results.sizes.get(name)), digest)
        for name, digest in sorted(results.files.items())
        if name != REPORT
    ]


def _size(count: int | None) -> str:
    if count is None:
        return ""
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"
