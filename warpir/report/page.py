"""The report of a run: one page for a person, ``report.html``, that needs nothing beside itself.

    python -m warpir.report out/street --to street.html

makes it anew from a finished run's folder; the photo and the object need not be there any more.
Pictures are data URIs, style and script are inline and named by their hashes in the page's content
security policy, so that nothing else in it can run and nothing is ever asked for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from importlib.resources import files
from pathlib import Path, PurePath
from string import Template
from typing import Any

import numpy as np

import warpir
from warpir.app.command import BY_HAND, Parser, read_values
from warpir.app.config import DEFAULTS, InsertConfig, flag
from warpir.app.finished import config_of_record
from warpir.app.program import run_program, say
from warpir.app.record import name_of
from warpir.app.reuse import check_files, run_record
from warpir.core.arrays import CodeArray, Float64Array, FloatArray
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_json_object
from warpir.io.curves_file import read_curves
from warpir.io.images.decoder import decode_image
from warpir.io.images.photos import read_envmap
from warpir.io.results import Layers, OutputFolder, read_layers
from warpir.report.facts import (
    about_file,
    command_line,
    figures,
    settings,
    stage_words,
    who_spoke,
    without_folders,
)
from warpir.report.page_policy import source_hash
from warpir.report.pictures import (
    PANORAMA_HEIGHT,
    STOPS,
    Shown,
    before_and_after,
    jpeg,
    layers_shown,
    object_box,
    panorama,
)
from warpir.report.plots import Series, bar, line_plot
from warpir.report.words import (
    EVEN,
    LightCharacter,
    characterize,
    color_words,
    direction_words,
    softness_words,
    strength_words,
)
from warpir.scene.light import bearing
from warpir.scene.tone_curves import Curves, ToneKnots

REPORT = "report.html"
CLOCK, END = "<!--clock-->", "<!--/clock-->"
"""Round what differs from one run of a command to the next, and nothing else does: seconds and
memory."""
MADE_BY = b'<meta name="generator" content="warpir '
"""By which a page of ours is known; it stands within its first 4096 bytes."""
LEAST_PHOTO = 8.0
"""Share of the picture that the slider at first leaves to the photo [%]."""
OPEN_END = 1e-3
"""How far a tone curve's knots may be from the diagonal to count as the identity [1]."""


@dataclass(frozen=True)
class Results:
    """What a run left, or has in memory; what is absent is not told of."""

    record: Mapping[str, Any] = field(default_factory=dict)
    """Content of ``run.json``, with or without ``files``."""
    files: Mapping[str, str] = field(default_factory=dict)
    """sha256 of the files by their names."""
    sizes: Mapping[str, int] = field(default_factory=dict)
    """Of the same [byte]."""
    layers: Layers | None = None
    light: FloatArray | None = None
    """The light of the place, as in ``envmap.exr``, shape [He, 2 He, 3]."""
    light_shadow: FloatArray | None = None
    """That of the shadow, where it has one of its own."""
    light_detail: FloatArray | None = None
    """That on the object with what the photo shows, where it has that."""
    balls: CodeArray | None = None
    """Content of ``balls.png``."""
    curves: Curves | None = None
    camera: Mapping[str, Any] | None = None
    """Content of ``camera.json``."""
    optimization: Mapping[str, Any] | None = None
    """Content of ``optimization.json``, where a prior guided."""
    missing: tuple[str, ...] = ()
    """Files that are not there any more, or are not what the run wrote."""

    @property
    def pose(self) -> Float64Array:
        """Pose of the camera, shape [4, 4]."""
        return np.asarray((self.camera or {}).get("c2w", np.eye(4)), np.float64)

    @cached_property
    def character(self) -> LightCharacter | None:
        """Of `light`; None where there is none, or it is black."""
        return self._characterized(self.light)

    @cached_property
    def character_shadow(self) -> LightCharacter | None:
        """Of `light_shadow`."""
        return self._characterized(self.light_shadow)

    def _characterized(self, texels: FloatArray | None) -> LightCharacter | None:
        if texels is None or not texels.any():
            return None
        placement = self.record["measured"].get("placement", {})
        normal = np.asarray(placement.get("ground", (0.0, 1.0, 0.0, 0.0))[:3], np.float64)
        return characterize(texels, normal, self.pose)


def write_report(output: OutputFolder, results: Results) -> None:
    """Stage ``report.html``.

    Args:
        output: Holds all other files, which are told of with their hashes.
        results: The run's; its files, and what it wrote on its way, are taken from there.

    Raises:
        InputError: The disk is full (exit 5).
    """
    steps = "optimization.json"
    if steps in output.hashes:
        results = replace(results, optimization=read_json_object(output.staging / steps, LIMITS))
    results = replace(results, files=output.hashes, sizes=output.sizes())
    output.write_bytes(REPORT, report_page(results))


def report_page(results: Results) -> bytes:
    """Return the page, in UTF-8."""
    config = config_of(results.record)
    sections = [
        _notice_of_missing(results),
        _result(results),
        _layers(results),
        _light(results),
        section("Where the light comes from", _rows(who_spoke(results.record, config))),
        _curves(results),
        _convergence(results),
        _notices(results, config),
        section("Figures", _rows(figures(results.record), "short")),
        _clock(results),
        _again(config),
        _settings(config, results),
        _inputs(config, results),
        _files(results),
        _versions(results),
    ]
    photo = "the demo's photo" if config.demo else PurePath(config.photo or "photo").name
    asset = "A car" if config.demo else PurePath(config.asset or "object").name
    return html_page(
        kind="warpir, report of a run",
        title=f"{asset} in {photo}",
        lead=_lead(results),
        sections=sections,
    )


def html_page(kind: str, title: str, lead: str, sections: Sequence[str]) -> bytes:
    """Return a page of our style, in UTF-8.

    Args:
        kind: What it is, plain text as the next two.
        title: Of what.
        lead: In a sentence.
        sections: HTML; empty ones are left out.
    """
    style, script = _part("report.css.in"), _part("report.js.in")
    policy = {
        "default-src": "'none'",
        "img-src": "data:",
        "style-src": source_hash(style.encode()),
        "script-src": source_hash(script.encode()),
        "base-uri": "'none'",
        "form-action": "'none'",
    }
    page = Template(_part("report.html.in")).substitute(
        csp="; ".join(f"{name} {value}" for name, value in policy.items()),
        version=warpir.__version__,
        kind=escape(kind),
        title=escape(title),
        lead=escape(lead),
        css=style,
        js=script,
        sections="\n".join(part for part in sections if part),
    )
    return page.encode("utf-8", "replace")  # names of files need not be text


def config_of(record: Mapping[str, Any]) -> InsertConfig:
    """Return the configuration that a ``run.json`` holds.

    Raises:
        InputError: A value is none that a run could have had.
    """
    known = {name: value for name, value in record["config"].items() if name in DEFAULTS}
    return config_of_record(known)


def _part(name: str) -> str:
    return files("warpir.report").joinpath("templates", name).read_text("utf-8")


# ---------------------------------------------------------------------------- pieces of HTML


def section(heading: str, *parts: str) -> str:
    """Return a section; nothing where it has no content."""
    content = "".join(parts)
    return f"<section><h2>{escape(heading)}</h2>{content}</section>" if content else ""


def _rows(rows: Sequence[tuple[str, str]], kind: str = "long") -> str:
    if not rows:
        return ""
    pairs = (f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in rows)
    return f'<dl class="{kind}">{"".join(pairs)}</dl>'


def _img(picture: Shown, alt: str, of: str = "") -> str:
    kind = f' class="{of}"' if of else ""
    return (
        f'<img{kind} src="{picture.uri}" width="{picture.width}" height="{picture.height}" '
        f'alt="{escape(alt)}" draggable="false">'
    )


def _chips(legend: str, group: str, choices: Sequence[tuple[str, str]]) -> str:
    """Return radio buttons; each shows the figure whose id it holds."""
    buttons = (
        f'<label><input type="radio" name="{group}" value="{escape(at)}"'
        f"{' checked' if k == 0 else ''}><span>{escape(name)}</span></label>"
        for k, (at, name) in enumerate(choices)
    )
    return f'<fieldset class="chips"><legend>{escape(legend)}</legend>{"".join(buttons)}</fieldset>'


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], kind: str = "stack") -> str:
    """Return a table; cells are HTML already."""
    if not rows:
        return ""
    heads = "".join(f"<th>{escape(name)}</th>" for name in head)
    lines = ("".join(f"<td>{cell}</td>" for cell in row) for row in rows)
    body = "".join(f"<tr>{line}</tr>" for line in lines)
    return f'<table class="{kind}"><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'


# --------------------------------------------------------------------------------- sections


def _lead(results: Results) -> str:
    measured = results.record["measured"]
    parts = [measured["placement"]["summary"]] if "placement" in measured else []
    character = results.character
    if character is not None:
        parts.append(f"The light comes {_direction(character)}")
    return ". ".join(part[:1].upper() + part[1:] for part in parts) + ("." if parts else "")


def _notice_of_missing(results: Results) -> str:
    if not results.missing:
        return ""
    names = ", ".join(results.missing)
    text = f"Not there any more, or changed since the run, so not shown: {names}."
    return f'<ul class="notices"><li class="warn">{escape(text)}</li></ul>'


def _result(results: Results) -> str:
    layers = results.layers
    if layers is None:
        return ""
    views = [("view-whole", "Whole picture", before_and_after(layers))]
    start = 50.0
    if (box := object_box(layers)) is not None:
        # At first all of the object is seen, and beside it the photo as it was.
        start = max(100.0 * box[0] / layers.matte.shape[1], LEAST_PHOTO)
        views.append(("view-object", "The object", before_and_after(layers, box)))
    shown = []
    for at, name, (before, after) in views:
        shown.append(
            f'<div class="view compare" id="{at}">{_img(before, f"{name}: the photo")}'
            f"{_img(after, f'{name}: the result', 'after')}"
            '<span class="tag left">Photo</span><span class="tag right">Result</span>'
            '<span class="line"></span></div>'
        )
    chips = _chips("What is shown", "view", [v[:2] for v in views]) if len(views) > 1 else ""
    height, width = layers.matte.shape
    small = views[0][2][0]
    size = f"{width} × {height} pixels"
    if small.width < width:
        size += f", here averaged to {small.width} × {small.height}"
    range_ = (
        '<div class="slide"><label for="cut">Photo or result</label><input type="range" id="cut" '
        f'min="0" max="100" step="0.5" value="{start:.1f}"></div>'
    )
    note = "" if (layers.matte > 0.0).any() else " The object is not seen in the photo."
    caption = f'<p class="note">{escape(size + "." + note)} Full size: composite.png.</p>'
    return section("Photo and result", chips, *shown, range_, caption)


def _layers(results: Results) -> str:
    if results.layers is None:
        return ""
    found = layers_shown(results.layers)
    chips = _chips("Layer", "layer", [(f"layer-{layer.name}", layer.name) for layer in found])
    shown = (
        f'<figure class="layer" id="layer-{layer.name}">'
        f"{_img(layer.picture, f'Layer {layer.name}', 'alpha' if layer.has_alpha else '')}"
        f"<figcaption><b>{layer.name}</b>: {escape(layer.about)}</figcaption></figure>"
        for layer in found
    )
    note = (
        '<p class="note">Cut to the object and its shadow. The layers themselves are linear, in '
        "layers.exr at the photo's size.</p>"
    )
    return section("Layers", chips, *shown, note)


def _direction(character: LightCharacter) -> str:
    words = direction_words(character.bearing_deg, character.elevation_deg)
    return words if character.direct_share >= EVEN else f"from all around, brightest {words}"


def _light(results: Results) -> str:
    if results.light is None:
        return ""
    skies = [("sky-light", "Light", results.light)]
    if results.light_detail is not None:
        skies.append(("sky-detail", "With reflections", results.light_detail))
    if results.light_shadow is not None:
        skies.append(("sky-shadow", "Of the shadow", results.light_shadow))
    chips = _chips("Panorama", "sky", [s[:2] for s in skies]) if len(skies) > 1 else ""
    shown = (_sky(results, at, texels, about) for at, about, texels in skies)
    balls = ""
    if results.balls is not None:
        balls = (
            f'<figure class="balls">{_img(jpeg(results.balls), "A mirror ball and a grey ball")}'
            "<figcaption>A mirror ball and a matt ball of 18 % grey under the light on the object, "
            "as the camera sees them.</figcaption></figure>"
        )
    words = _light_words(results)
    below = f'<div class="two">{words}{balls}</div>' if balls and words else words + balls
    return section("The light", chips, *shown, f"<h3>In words</h3>{below}" if words else below)


def _sky(results: Results, at: str, texels: FloatArray, about: str) -> str:
    tone = results.curves.tone if results.curves is not None else "linear"
    made = panorama(texels, results.pose, tone)
    width, height = made.picture.width, made.picture.height
    marks = [f'<path class="under" d="M0 {height / 2}H{width}"/>']
    marks.append(f'<path d="M0 {height / 2}H{width}"/>')
    if (frame := _frame(results)) is not None:
        marks += [f'<path class="under" d="{frame}"/>', f'<path class="frame" d="{frame}"/>']
    is_shadow = texels is results.light_shadow
    character = results.character_shadow if is_shadow else results.character
    if character is not None and character.direct_share >= EVEN:
        x = (0.5 + character.bearing_deg / 360.0) * width
        y = (0.5 - character.elevation_deg / 180.0) * height
        ring = f"M{x - 7:.1f} {y:.1f}a7 7 0 1 0 14 0a7 7 0 1 0 -14 0"
        marks += [f'<path class="under" d="{ring}"/>', f'<path class="aim" d="{ring}"/>']
    return (
        f'<figure class="panorama" id="{at}"><div class="sky" data-rgbe="{made.rgbe}" '
        f'data-tone="{escape(tone)}" data-slider="{at}-stops">'
        f"{_img(made.picture, f'{about}: a panorama, ahead of the camera in the middle')}"
        f'<canvas width="{width}" height="{height}" hidden></canvas>'
        f'<svg viewBox="0 0 {width} {height}" aria-hidden="true">{"".join(marks)}</svg></div>'
        '<div class="compass" aria-hidden="true"><span>behind</span><span>left</span>'
        "<span>ahead</span><span>right</span><span>behind</span></div>"
        f'<div class="slide"><label for="{at}-stops">Exposure</label><input type="range" '
        f'id="{at}-stops" min="{-STOPS:g}" max="{STOPS:g}" step="0.5" value="{made.stops:g}">'
        f"<output>{made.stops:+g} EV</output></div>"
        "<figcaption>At 0 EV as the photo is exposed. The line is the horizon, the dashed frame "
        "what the photo shows, the ring the brightest direction.</figcaption></figure>"
    )


def _frame(results: Results) -> str | None:
    """Return the outline of the photo in the panorama, where it does not cross the seam."""
    camera = results.camera
    if camera is None:
        return None
    w, h = camera["w"], camera["h"]
    edge = np.linspace(0.0, 1.0, 25)
    zero, one = np.zeros(25), np.ones(25)
    u = np.concatenate([edge, one, edge[::-1], zero]) * w
    v = np.concatenate([zero, edge, one, edge[::-1]]) * h
    rays = np.stack(
        [(u - camera["cx"]) / camera["fx"], -(v - camera["cy"]) / camera["fy"], -np.ones_like(u)],
        axis=1,
    )
    pose = results.pose
    rays = rays @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    around = np.radians([bearing(ray, pose) for ray in rays])
    up = np.arcsin(np.clip(rays[:, 1], -1.0, 1.0))
    if np.abs(np.diff(around)).max() > np.pi / 2.0:  # a pole is in the picture
        return None
    x = (0.5 + around / (2.0 * np.pi)) * 2 * PANORAMA_HEIGHT
    y = (0.5 - up / np.pi) * PANORAMA_HEIGHT
    return "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x, y, strict=True)) + "Z"


def _light_words(results: Results) -> str:
    character = results.character
    if character is None:
        return ""
    rows = [("direction", _direction(character))]
    if character.direct_share >= EVEN:
        rows.append(
            (
                "in degrees",
                f"azimuth {character.azimuth_deg:.0f}° (clockwise from -Z of the world, seen from "
                f"above), elevation {character.elevation_deg:.0f}°; "
                f"{character.bearing_deg:+.0f}° from where the camera looks",
            )
        )
    rows.append(("strength", strength_words(character)))
    direct, sky = color_words(character.direct), color_words(character.sky)
    if character.direct_share >= EVEN:
        rows += [("colour of the direct light", direct), ("colour of the rest", sky)]
    else:
        rows.append(("colour", sky))
    shadow = character
    if results.light_shadow is not None:
        found = results.character_shadow
        if found is not None:
            shadow = found
            rows.append(("light of the shadow", _direction(found)))
    rows.append(("shadow", softness_words(shadow)))
    return _rows(rows)


def _curves(results: Results) -> str:
    curves = results.curves
    if curves is None or all(
        _is_identity(knots) for knots in (curves.foreground, curves.shadow_ratio)
    ):
        return ""
    x = np.linspace(0.0, 1.0, 101)
    same = Series("unchanged", np.array([0.0, 1.0]), np.array([0.0, 1.0]), "same")
    plots = []
    for knots, title, styles in (
        (curves.foreground, "Tone curve of the object", ("s0",)),
        (curves.shadow_ratio, "Tone curves of the shadow", ("s1", "s2", "s3")),
    ):
        y = knots.evaluate(x)
        lines = [Series(style, x, y[:, k], style) for k, style in enumerate(styles)]
        plot = line_plot(
            [same, *lines], title, ("in", "out"), x_range=(0.0, 1.0), y_range=(0.0, 1.0)
        )
        keys = ""
        if len(styles) == 3:
            names = zip(styles, ("red", "green", "blue"), strict=True)
            keys = "".join(
                f'<span class="name"><span class="key {s}"></span>{name}</span> '
                for s, name in names
            )
        caption = f"{title}. {keys}" if keys else f"{title}."
        plots.append(f"<figure>{plot}<figcaption>{caption}</figcaption></figure>")
    operator = "Reinhard's operator stands before the object's" if curves.tone == "reinhard" else ""
    note = "Recovered from the photo; display-linear values, dashed: unchanged."
    text = f"{note} {operator}." if operator else note
    return section(
        "Tone curves", f'<div class="plots">{"".join(plots)}</div><p class="note">{text}</p>'
    )


def _is_identity(knots: ToneKnots) -> bool:
    x = np.linspace(0.0, 1.0, 33)
    return bool(np.abs(knots.evaluate(x) - x[:, None]).max() < OPEN_END)


_TERMS = {
    "score": "guidance score (lower is better)",
    "gradient": "norm of guidance's gradient",
    "trust": "penalty: distance from the start",
    "consistency": "penalty: both lights differ",
    "spread": "penalty: spread of the shadow's light",
    "chroma": "penalty: colour of the light",
    "bend": "penalty: bend of the tone curves",
}


def _convergence(results: Results) -> str:
    if results.optimization is None:
        return ""
    columns = results.optimization["by_step"]
    order = [name for name in _TERMS if name in columns]
    plots = []
    for name in (*order, *sorted(set(columns) - set(order))):
        known = [(k + 1, value) for k, value in enumerate(columns[name]) if value is not None]
        if name == "score" and results.optimization.get("score_at_start") is not None:
            known.insert(0, (0, results.optimization["score_at_start"]))
        if not known:
            continue
        step, value = (np.array(column, np.float64) for column in zip(*known, strict=True))
        about = _TERMS.get(name, name.replace("_", " "))
        marks = {"kept": float(results.optimization["best_step"])} if name == "score" else {}
        plot = line_plot(
            [Series(name, step, value)],
            f"{about} by step: from {value[0]:.4g} to {value[-1]:.4g}",
            ("step", name.replace("_", " ")),
            x_range=(0.0, float(max(len(columns[name]), 1))),
            marks=marks,
        )
        plots.append(f"<figure>{plot}<figcaption>{escape(about)}</figcaption></figure>")
    return section("Convergence", f'<div class="plots">{"".join(plots)}</div>' if plots else "")


def _notices(results: Results, config: InsertConfig) -> str:
    lines = [
        (kind, without_folders(line, config))
        for kind, name in (("warn", "notices"), ("", "assumed"))
        for line in results.record[name]
    ]
    items = (
        f'<li class="{kind}">{"Notice" if kind else "Assumed"}: {escape(line)}</li>'
        for kind, line in lines
    )
    body = f'<ul class="notices">{"".join(items)}</ul>' if lines else ""
    return section("What was noticed and assumed", body)


def _clock(results: Results) -> str:
    seconds = {k: v for k, v in results.record["seconds"].items() if k != "report"}
    total = sum(seconds.values())
    rows = [
        (
            escape(stage_words(stage)),
            f"{spent:.2f} s",
            bar(spent / total if total > 0.0 else 0.0),
        )
        for stage, spent in seconds.items()
    ]
    peak = results.record.get("peak_mib", {})
    held = "; ".join(f"{where} {mib:,.0f} MiB" for where, mib in peak.items())
    memory = f'<p class="note">Most memory held at once: {escape(held)}.</p>' if held else ""
    table = _table(("stage", "time", "share"), rows, "times")
    body = f'{table}<p class="note">{total:.1f} s in all.</p>{memory}' if rows else memory
    return f"{CLOCK}{section('Time and memory', body)}{END}"


def _again(config: InsertConfig) -> str:
    by_hand = [flag(name) for name in BY_HAND if getattr(config, name)]
    exact = " ".join(["python -m warpir.insert --config run.json", *by_hand, "--out OUT"])
    return section(
        "The same again",
        "<p>Where the run was started, by the path of the run.json that lies beside this page:</p>",
        f"<pre><code>{exact}</code></pre>",
        "<p>Or with flags, in a folder that holds the input files:</p>",
        f"<pre><code>{escape(command_line(config))}</code></pre>",
        '<p class="note">OUT is a new folder. The same versions give the same bytes on a CPU.</p>',
    )


def _settings(config: InsertConfig, results: Results) -> str:
    groups = []
    for heading, found in settings(config, results.record).items():
        rows = []
        for setting in found:
            mark = '<span class="mark">set</span>' if setting.is_set else ""
            mark = '<span class="mark">by the prior</span>' if setting.is_settled else mark
            kind = ' class="set"' if setting.is_set else ""
            value = escape(setting.value) or '<span class="hash">not given</span>'
            rows.append((f"<span{kind}>{escape(setting.name)}</span>{mark}", value))
        count = sum(setting.is_set for setting in found)
        told = f' <span class="mark">{count} set</span>' if count else ""
        is_open = " open" if count else ""
        groups.append(
            f"<details{is_open}><summary>{escape(heading)}{told}</summary>"
            f"{_table(('setting', 'value'), rows, 'settings')}</details>"
        )
    note = '<p class="note">What is not marked has its default value.</p>'
    return section("Settings", *groups, note)


def _inputs(config: InsertConfig, results: Results) -> str:
    rows = []
    for name, digest in results.record["inputs"].items():
        field, _, file = name.partition("/")
        given = getattr(config, field, None)
        called = file or (name_of(given) if isinstance(given, str) else "")
        if not called and config.demo:
            called = "the demo's own"
        digest = without_folders(str(digest), config)
        rows.append((escape(name), escape(called), f'<code class="hash">{escape(digest)}</code>'))
    return section("Inputs", _table(("input", "file", "sha256"), rows))


def _files(results: Results) -> str:
    rows = []
    for name, digest in sorted(results.files.items()):
        if name == REPORT:
            continue
        size = results.sizes.get(name)
        about = about_file(name)
        told = f"<b>{escape(name)}</b><br>{escape(about)}" if about else f"<b>{escape(name)}</b>"
        rows.append(
            (
                told,
                "" if size is None else f'<span class="size">{_size(size)}</span>',
                f'<code class="hash">{escape(str(digest))}</code>',
            )
        )
    body = _table(("file", "size", "sha256"), rows)
    note = (
        f'<p class="note">And <b>run.json</b>, which holds these hashes and that of this page: '
        f"{escape(about_file('run.json')[:1].lower() + about_file('run.json')[1:])}.</p>"
    )
    return section("Files", body, note if body else "")


def _size(count: int) -> str:
    return f"{count / 1e6:.1f} MB" if count >= 1e6 else f"{count / 1e3:.1f} kB"


def _versions(results: Results) -> str:
    rows = [(str(name), str(text)) for name, text in results.record["versions"].items()]
    return section("Versions", _rows(rows, "short"))


# ------------------------------------------------------------------- of a finished folder


def read_results(folder: Path, limits: Limits = LIMITS) -> Results:
    """Return what a finished run left in its folder.

    Args:
        folder: The run's ``--out``.
        limits: How large its pictures and maps may be; its ``run.json`` is of a stranger's and
            raises none.

    Raises:
        InputError: The folder holds no finished run, or a picture is larger.
    """
    record = run_record(folder, LIMITS)
    listed = {str(name): str(digest) for name, digest in record["files"].items()}
    missing, sizes = [], {}
    for name, digest in listed.items():
        try:
            check_files(folder, {name: digest})
            sizes[name] = (folder / name).stat().st_size
        except InputError:
            missing.append(name)
    there = {name: folder / name for name in sizes}

    def texels(name: str) -> FloatArray | None:
        if name not in there:
            return None
        return read_envmap(there[name], strict=True, max_width=limits.envmap_width)

    def content(name: str) -> dict[str, Any] | None:
        return read_json_object(there[name], LIMITS) if name in there else None

    balls = there.get("balls.png")
    return Results(
        record,
        listed,
        sizes,
        layers=read_layers(there["layers.exr"], limits.pixels) if "layers.exr" in there else None,
        light=texels("envmap.exr"),
        light_shadow=texels("envmap_shadow.exr"),
        light_detail=texels("envmap_detail.exr"),
        balls=None if balls is None else decode_image(balls, limits.pixels).pixels,
        curves=read_curves(there["curves.json"]) if "curves.json" in there else None,
        camera=content("camera.json"),
        optimization=content("optimization.json"),
        missing=tuple(name for name in missing if name != REPORT),
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments without the program's name; ``sys.argv`` when absent.

    Returns:
        The exit status, as of `warpir.insert`.
    """
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    parser = Parser(
        prog="python -m warpir.report",
        description="Make the report of a finished run anew.",
        allow_abbrev=False,
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="what --out of the run named")
    parser.add_argument("--to", type=Path, metavar="FILE", help="default: DIR/report.html")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE")
    raised = ("max_pixels", "max_envmap_width")
    for name in raised:
        parser.add_argument(
            f"--{name.replace('_', '-')}", metavar="N", help=f"default: {DEFAULTS[name]}"
        )
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    given = parser.parse_args(arguments)
    texts = {name: text for name in raised if (text := getattr(given, name)) is not None}
    values = read_values({name: (text, flag(name)) for name, text in texts.items()})
    results = read_results(given.folder, InsertConfig(**values).limits)
    try:
        page = report_page(results)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        # A file of a stranger's, which may hold anything under the names that a run writes.
        what = f"not what a run of this version writes ({type(error).__name__}: {error})"
        raise InputError(given.folder / "run.json", what) from error
    path = given.to or given.folder / REPORT
    if path.name in results.files and path.parent.resolve() == given.folder.resolve():
        # Its hash stands in run.json, by which others see that the results are as they were.
        raise InputError(
            path, "is of the run itself", "name another file with --to", ExitCode.OUTPUT
        )
    if path.exists() and not given.overwrite:
        raise InputError(path, "exists", "pass --overwrite to replace it", ExitCode.OUTPUT)
    write_file(path, page)
    for name in results.missing:
        say(f"notice: {name} is not there any more, or has changed: its part is left out")
    say(str(path))
    return ExitCode.DONE
