"""Table and plot of `benchmarks.speed`, from the JSON files of its runs.

    python -m benchmarks.speed.report [DOCS]

writes both again from ``DOCS/speed/*.json``, after another device's file was put there.
"""

import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.measure import table, write_json
from benchmarks.speed.cost import cost_text, kept_runs
from benchmarks.speed.ratios import STEPS

NAME = "speed_against_error"
STYLES = {
    "mitsuba": ("Mitsuba 3", "tab:blue", "o"),
    "mis": ("mis", "tab:orange", "s"),
    "transport": ("transport, one step", "tab:green", "*"),
}

INTRODUCTION = """# Speed against error: `mis`, `transport` and Mitsuba 3

One step is the object's radiance and the plane's shadow ratio, forward and backward to the map of
the light, as the optimisation of a light needs them. All renderers see the same triangles,
materials, camera, pixels and map; all run in one process, in turn, on the same cores or card.

Mitsuba renders the object with its own `prb`, film cropped to the object (ToyCar, whose emission
texture `prb` does not see: with the referee's path replay, which takes half the time there), and
the shadow ratio from rays of the compared pixels alone, both radiances from the same samples, the
gradient by Dr.Jit's automatic differentiation. Its sampler is `ldsampler`, with which it takes an
eighth of `independent`'s time to an image of equal error here, a third to a gradient; its functions
are frozen (`dr.freeze`), so that Python does not trace them again in each step; where Dr.Jit
refuses that (ToyCar and `textured` on CUDA, run with `--no-freeze`), Mitsuba's pictures of the
object hold 30 to 45 ms of tracing, its time at 4 samples, and its steps 80 to 120 ms: there the
ratios flatter us, those of pictures by up to a quarter, those of steps by up to seven tenths, and
those of `expects_light False` there are nearly all Python.
Kernels are compiled and scenes built before the clock runs.

The scene `textured` is a heap of five balls of 50,000 vertices together, each with textures of its
own for base colour, metal and roughness, and normals: fifteen of 512 x 512, made from a seed. Both
renderers read the same texels, normal maps included, by glTF's rules, Mitsuba in all scenes through
the BSDF of `warpir.mitsuba` that the referee uses.

Errors are relative RMSE against references of both renderers; products of differences to two
independent references free them of the references' noise. `image` joins foreground and shadow
ratio, `gradient` the gradients of their weighted sums with respect to the texels, as
`sqrt((e_fg^2 + e_ratio^2) / 2)`. 2 % of the pixels, those in which a pilot of `mis` is noisiest,
are left out of `image`: a handful of mirrored suns holds 99 % of ToyCar's squared error in every
renderer. The error with them is the column `all`. Among the others are fireflies enough that in one
to three runs chance decides ToyCar's forward ratio; `benchmarks.speed.fireflies` runs it over many
seeds ([figures](figures.md)).

Without a gradient `mis` samples otherwise: it picks a direction toward the light among eight, with
what all would bring as its control variate, and on the CPU gives more samples to pixels where a
pilot finds noise (`warpir.render.allocation`), here by the error of linear radiance, by which it is
judged. So the forward image has an error of its own. Pictures are shared out by the error that is
shown, in which highlights hardly count: the gain on metal below is theirs. A GPU is not filled by a
few noisy pixels, whose rays are long besides: below 2^26 samples it takes as many of each pixel.

The ratios say how many times longer Mitsuba takes when its error has come down to ours, in image or
in gradient, whichever it reaches sooner. It may split its samples between object and plane as suits
it best. `>=`: its longest run has not come down that far. `600 steps` includes tracing `transport`.
The map has 32 rows."""


def number(value: float | None, digits: int = 3) -> str:
    """Write a number with that many significant digits."""
    if value is None:
        return "-"
    text = f"{value:.{digits}g}"
    return f"{float(text):.0f}" if "e+" in text else text


def percent(value: float) -> str:
    """Write a share."""
    return f"{number(100.0 * value)} %"


def settings_text(settings: dict[str, Any]) -> str:
    """Write settings as a reader would name them."""
    if "spp" in settings:
        return f"{settings['spp']} samples"
    if not settings:
        return "defaults"
    return ", ".join(f"{k} {v}" for k, v in settings.items())


def times(value: float | None, at_least: bool) -> str:
    """Write a ratio."""
    return "-" if value is None else f"{'>= ' if at_least else ''}{number(value)} x"


def transport_table(result: dict[str, Any]) -> str:
    """Write the ratios of `transport`."""
    head = ("scene", "transport", "tracing", "step")
    head += ("Mitsuba's step at equal image / gradient", "**step**", "**600 steps**", "level after")

    def seconds(entry: dict[str, Any], name: str) -> str:
        bound = ">= " if entry[f"mitsuba_at_least_by_{name}"] else ""
        return f"{bound}{number(entry[f'mitsuba_seconds_step_by_{name}'])} s"

    def cells(record: dict[str, Any], entry: dict[str, Any]) -> tuple[str, ...]:
        level = entry["break_even_steps"]
        return (
            *(record["scene"], settings_text(entry["settings"])),
            f"{number(entry['seconds_traced'])} s",
            f"{number(1000.0 * entry['seconds_step'])} ms",
            f"{seconds(entry, 'image')} / {seconds(entry, 'gradient')}",
            *(times(entry[name], entry["at_least"]) for name in ("step", "run_600")),
            "never" if level is None else f"{number(level, 2)} steps",
        )

    rows = (cells(record, entry) for record in result["ratios"] for entry in record["transport"])
    return table(head, rows)


def mis_table(result: dict[str, Any]) -> str:
    """Write the ratios of `mis`."""

    def cell(entry: dict[str, float]) -> str:
        return f"{times(entry['ratio'], False)} at {percent(entry['rmse'])}"

    names = ("forward_image", "step_image", "step_gradient")
    rows = (
        (record["scene"], *(cell(record["mis"][name]) for name in names))
        for record in result["ratios"]
    )
    return table(("scene", "forward, image", "step, image", "step, gradient"), rows)


def row_table(result: dict[str, Any]) -> str:
    """Write what was measured."""
    head = ("scene", "integrator", "settings", "tracing", "forward", "its image", "step")
    head += ("image", "all", "gradient", "object / ratio", "gradient of object / ratio", "MiB")

    def pair(row: dict[str, Any], name: str) -> str:
        return " / ".join(percent(row["parts"][p][name]) for p in ("foreground", "ratio"))

    def cells(row: dict[str, Any]) -> tuple[str, ...]:
        traced = row.get("seconds_traced")
        return (
            *(row["scene"], row["integrator"], settings_text(row["settings"])),
            "" if traced is None else f"{number(traced)} s",
            f"{number(1000.0 * row['seconds_forward'])} ms",
            percent(row["rmse_forward"]),
            f"{number(1000.0 * row['seconds_step'])} ms",
            *(percent(row[f"rmse_{name}"]) for name in ("image", "image_all", "gradient")),
            *(pair(row, name) for name in ("rmse_image", "rmse_gradient")),
            number(row["peak_mib"]),
        )

    return table(head, map(cells, result["rows"]))


def summary(result: dict[str, Any]) -> str:
    """Return what a run prints."""
    parts = [
        f"{result['conditions']['device']}, {result['conditions']['seconds']:.0f} s",
        row_table(result),
        transport_table(result),
        mis_table(result),
    ]
    parts += [f"not run: {reason}" for reason in result["skipped"]]
    parts += [f"references: {line}" for line in result["disagreements"]]
    return "\n\n".join(parts)


def device_text(result: dict[str, Any]) -> str:
    """Return one device's chapter."""
    c = result["conditions"]
    resolution = {r["scene"]: r["rmse_resolution"] for r in result["rows"]}
    costs = ", ".join(f"{scene} {percent(e)}" for scene, e in resolution.items())
    threads = f", {c['threads']} threads, {c['instructions']}" if c["threads"] else ""
    pixels = "; ".join(
        f"{s['name']}: {s['triangles']} triangles, D = {s['depth']}, {s['object_pixels']} object "
        f"pixels, {s['receiver_pixels']} of the plane"
        for s in result["scenes"]
    )
    parts = [
        f"## {c['device']}{threads}",
        f"{c['date']}, commit {c['commit']}, warp {c['warp']}, torch {c['torch']}, Mitsuba "
        f"{c['mitsuba']} (`{c['variant']}`), {c['size'][0]} x {c['size'][1]} pixels. {pixels}.",
        "    " + c["command"],
        "How many times longer Mitsuba takes than `transport`:",
        transport_table(result),
        "and than `mis`, at the smallest error that both sweeps reach:",
        mis_table(result),
        "What rasterising the lobes to the map costs, relative RMSE of the image to that under the "
        f"lobes themselves: {costs}.",
        "<details><summary>All that was measured</summary>",
        row_table(result),
        "</details>",
    ]
    parts += [f"Not run: {reason}." for reason in result["skipped"]]
    parts += [f"References: {line}." for line in result["disagreements"]]
    if not result["disagreements"]:
        parts.append(
            "The two renderers' references differ nowhere by more than their noise or a tenth of "
            "the smallest error compared."
        )
    return "\n\n".join(parts)


def keep_run(result: dict[str, Any], docs: Path) -> Path:
    """Keep a run beside those of other devices."""
    slug = re.sub(r"[^a-z0-9]+", "_", result["conditions"]["device"].lower()).strip("_")
    path = docs / "speed" / f"{slug}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return path


def write_documents(docs: Path) -> None:
    """Write table and plot from all runs that are kept."""
    results = [
        json.loads(path.read_text(encoding="utf-8"))
        for path in sorted((docs / "speed").glob("*.json"))
    ]
    results.sort(key=lambda result: result["conditions"]["threads"] is None)
    text = [INTRODUCTION, f"![Error over time of one step]({NAME}.png)"]
    text += [device_text(result) for result in results]
    costs = kept_runs(docs / "speed" / "cost")
    text += [cost_text(costs)] if costs else []
    (docs / f"{NAME}.md").write_text("\n\n".join(text) + "\n", encoding="utf-8")
    plot(results, docs / f"{NAME}.png")


def plot(results: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw error over time of one step: a row per scene, image and gradient of each device."""
    import matplotlib
    from PIL import Image

    matplotlib.use("Agg")
    from matplotlib import pyplot

    scenes = list(dict.fromkeys(s["name"] for result in results for s in result["scenes"]))
    quantities = (("rmse_image", "image"), ("rmse_gradient", "gradient"))
    figure, axes = pyplot.subplots(
        len(scenes),
        2 * len(results),
        figsize=(4.2 * 2 * len(results), 3.2 * len(scenes)),
        squeeze=False,
        layout="constrained",
    )
    for d, result in enumerate(results):
        for q, (key, label) in enumerate(quantities):
            for s, scene in enumerate(scenes):
                axis = axes[s][2 * d + q]
                _panel(axis, [r for r in result["rows"] if r["scene"] == scene], key)
                axis.set_title(f"{scene}, {label}\n{result['conditions']['device']}", fontsize=9)
                if s == len(scenes) - 1:
                    axis.set_xlabel("time of one step [s]")
                if q == 0:
                    axis.set_ylabel("relative RMSE")
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    figure.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=4, frameon=False
    )
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
    with Image.open(path) as image:
        few = image.convert("RGB").quantize(64)
    few.save(path, optimize=True)


def _panel(axis: Any, rows: list[dict[str, Any]], key: str) -> None:
    for name, (label, color, marker) in STYLES.items():
        found = [r for r in rows if r["integrator"] == name and r[key] > 0.0]
        if not found:
            continue
        x, y = [r["seconds_step"] for r in found], [r[key] for r in found]
        if name == "transport":
            whole = [r["seconds_step"] + r["seconds_traced"] / STEPS for r in found]
            for a, b, e in zip(x, whole, y, strict=True):
                axis.plot([a, b], [e, e], color=color, linewidth=0.8, alpha=0.6)
            axis.plot(x, y, marker, color=color, markersize=11, label=label)
            hollow = {"markersize": 11, "markerfacecolor": "white"}
            label = f"transport, mean of {STEPS} steps and tracing"
            axis.plot(whole, y, marker, color=color, label=label, **hollow)
        else:
            axis.plot(x, y, marker=marker, color=color, markersize=5, label=label)
    axis.set_xscale("log")
    axis.set_yscale("log")
    axis.grid(True, which="major", alpha=0.4)
    axis.grid(True, which="minor", alpha=0.12)
    axis.tick_params(labelsize=8)
    from matplotlib.ticker import FuncFormatter, LogLocator

    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{100 * v:g} %"))
    axis.yaxis.set_minor_formatter("")


if __name__ == "__main__":
    write_documents(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
