"""What a picture costs: seconds and memory over image size, triangles and samples.

    python -m benchmarks.speed.cost [--device cpu|cuda] [--quick]

A ball on the plane under a sun and a sky, rendered as a run renders its last picture (object,
bounce and shadow), one thing varied at a time. Each picture has a process of its own, so that its
memory is; kernels are compiled before. Writes ``docs/speed/cost/DEVICE.json`` and draws
``docs/speed_cost.png``, which ``docs/speed_against_error.md`` shows; ``--quick`` writes nothing.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.measure import context, flags, peak_mib, table, write_json
from benchmarks.scenes import on_the_ground
from benchmarks.speed.scenes import standing_ball, sun_and_sky
from warpir.core.memory import core_count
from warpir.render.device import choose_device
from warpir.render.picture.planes import render
from warpir.render.picture.quality import Quality
from warpir.scene.asset import Asset, Material
from warpir.scene.camera import camera_from_fov
from warpir.scene.light import Light, rasterize_lobes
from warpir.scene.placement import place_asset
from warpir.scene.tone_curves import Curves

BASE = {"width": 1024, "triangles": 65_000, "samples": 64}
SWEEPS: dict[str, tuple[int, ...]] = {
    "width": (256, 512, 1024, 2048),
    "triangles": (10_000, 100_000, 1_000_000, 10_000_000),
    "samples": (4, 16, 64, 256),
}
QUICK: dict[str, tuple[int, ...]] = {
    "width": (128, 256),
    "triangles": (10_000, 100_000),
    "samples": (4, 16),
}
LABELS = {
    "width": "image width, 3:2 [px]",
    "triangles": "triangles of the object",
    "samples": "samples per pixel",
}
RUNS = Path("docs/speed/cost")
PLOT = Path("docs/speed_cost.png")
DEPTH, BOUNCE_DEPTH = 4, 2


def render_one(width: int, triangles: int, samples: int, device: str) -> dict[str, Any]:
    """Render one picture; return its seconds, those of building the scene, and the peak memory.

    Memory is that of the process [MiB], of the card on CUDA.
    """
    camera = camera_from_fov(width, width * 2 // 3, 40.0, -12.0, 1.4)
    rows = max(8, round(np.sqrt(triangles / 4.0)))
    asset = Asset("ball", (standing_ball(rows),), (Material(roughness=0.4),))
    pose = place_asset(*asset.bounds(), camera, place=(-0.3, 0.0, -5.5), size=1.5).asset_to_world
    curves = Curves.identity("reinhard")
    light = Light(None, rasterize_lobes(sun_and_sky(), 256, 512))

    def picture(seed: int, count: int) -> None:
        quality = Quality(count, 1, DEPTH, seed)
        render(own, light, light, quality, curves)
        wp.synchronize_device(own.device)

    start = time.perf_counter()
    own = on_the_ground(asset, pose, camera, device, bounce_depth=BOUNCE_DEPTH)
    wp.synchronize_device(own.device)
    built = time.perf_counter() - start
    picture(1, 1)
    start = time.perf_counter()
    picture(2, samples)
    return {
        "width": width,
        "triangles": sum(len(p.indices) for p in asset.primitives),
        "samples": samples,
        "seconds_scene": built,
        "seconds_picture": time.perf_counter() - start,
        "peak_mib": peak_mib(own.device),
        "rays": own.scene.rays,
        **context(own.device, core_count()),
    }


def sweep(device: str, sweeps: dict[str, tuple[int, ...]]) -> list[dict[str, Any]]:
    """Measure every point in a process of its own; points that sweeps share, once each."""
    rows: list[dict[str, Any]] = []
    base = {name: min(BASE[name], max(values)) for name, values in sweeps.items()}
    for name, values in sweeps.items():
        for value in values:
            point = {**base, name: value}
            words = [str(point[key]) for key in BASE]
            command = [sys.executable, "-m", "benchmarks.speed.cost", "--device", device]
            done = subprocess.run(
                [*command, "--one", *words], capture_output=True, text=True, check=False
            )
            if done.returncode:
                sys.exit(f"{point}: {done.stderr.strip()[-400:]}")
            rows.append({"sweep": name, **json.loads(done.stdout.splitlines()[-1])})
            print(f"| {' | '.join(cost_cells(rows[-1]))} |", flush=True)
    return rows


def cost_cells(row: dict[str, Any]) -> tuple[str, ...]:
    """Return a row of the table."""
    what = str(row["width"]), f"{row['triangles']:,}", str(row["samples"])
    seconds = f"{row['seconds_scene']:.3g} s", f"{row['seconds_picture']:.3g} s"
    return (*what, *seconds, f"{row['peak_mib']:.0f} MiB")


def cost_text(runs: Sequence[dict[str, Any]]) -> str:
    """Return the section of ``docs/speed_against_error.md`` on what a picture costs."""
    text = [
        "## What a picture costs",
        "A ball on the plane under a sun and a sky as one map, with bounce, as a run renders its "
        f"last picture at depth {DEPTH}: `python -m benchmarks.speed.cost`. The scene is built "
        "once, and the first also compiles what a fresh machine lacks; memory is that of the "
        "process, of the card on CUDA.",
        f"![Seconds of a picture]({PLOT.name})",
    ]
    for run in runs:
        rows, here = run["rows"], run["rows"][0]
        text.append(
            f"{here['device']}, {here['date']}, commit {here['commit']}, rays: {here['rays']}"
        )
        head = ("width", "triangles", "samples", "scene", "picture", "peak")
        text.append(table(head, map(cost_cells, rows)))
    return "\n\n".join(text)


def plot(runs: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw seconds over each thing that is varied, a line a device."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(
        1, len(LABELS), figsize=(4.0 * len(LABELS), 3.2), layout="constrained", sharey=True
    )
    for axis, (name, label) in zip(axes, LABELS.items(), strict=True):
        for run in runs:
            rows = [row for row in run["rows"] if row["sweep"] == name]
            x = [row[name] for row in rows]
            title = f"{rows[0]['device']}, {rows[0]['threads'] or 'one card'}"
            title += " threads" if rows[0]["threads"] else ""
            seconds = [row["seconds_picture"] for row in rows]
            (line,) = axis.plot(x, seconds, marker="o", label=title)
            if name == "triangles":
                seconds = [row["seconds_scene"] for row in rows]
                of_scene = {"color": line.get_color(), "label": "its scene, built once"}
                axis.plot(x, seconds, "--", marker="o", **of_scene)
        axis.set_xscale("log", base=2.0 if name == "width" else 10.0)
        axis.set_yscale("log")
        axis.set_xlabel(label)
        axis.grid(True, alpha=0.4)
        axis.legend(fontsize=7, frameon=False)
    axes[0].set_ylabel("seconds")
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def kept_runs(folder: Path) -> list[dict[str, Any]]:
    """Return what was measured on each device."""
    return [json.loads(path.read_text("utf-8")) for path in sorted(folder.glob("*.json"))]


def main() -> None:
    """Measure and, unless it is to be quick, keep the run and draw the plot."""
    parser = flags(__doc__, "device", "json")
    parser.add_argument("--quick", action="store_true", help="two small pictures a sweep")
    parser.add_argument("--one", type=int, nargs=3, metavar=("WIDTH", "TRIANGLES", "SAMPLES"))
    options = parser.parse_args()
    device = choose_device(options.device)
    if options.one:
        width, triangles, samples = options.one
        print(json.dumps(render_one(width, triangles, samples, device)))
        return
    rows = sweep(device, QUICK if options.quick else SWEEPS)
    write_json(options.json, {"rows": rows})
    if not options.quick:
        RUNS.mkdir(parents=True, exist_ok=True)
        name = rows[0]["device"].lower().replace(" ", "_")
        write_json(RUNS / f"{name}.json", {"rows": rows})
        plot(kept_runs(RUNS), PLOT)


if __name__ == "__main__":
    main()
