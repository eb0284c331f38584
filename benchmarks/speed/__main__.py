"""How long does each renderer take for an image and its light gradient of a given error?

    python -m benchmarks.speed [--quick] [--device cpu|cuda] [--json FILE]

Runs `mis`, `transport` and Mitsuba 3 on the same scenes under the same maps, in one process and in
turn, measures their errors against references of both renderers, and states how many times longer
Mitsuba takes at equal error. Without ``--quick`` it also writes ``docs/speed_against_error.md`` and
``.png`` again, from this run and from those of other devices in ``docs/speed/``.

A step is foreground and shadow ratio, forward and backward to the map. What is built once per scene
(meshes, trees, kernels) is not timed; what `transport` traces once is, and is stated.
"""

import argparse
import gc
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.measure import context, flags, write_json
from benchmarks.speed.candidates import (
    PARTS,
    Bench,
    Images,
    MisPart,
    MitsubaPart,
    Step,
    Transport,
    use_device,
)
from benchmarks.speed.ratios import combined, ratios
from benchmarks.speed.references import REFERENCE_SPP, References
from benchmarks.speed.report import keep_run, summary, write_documents
from benchmarks.speed.scenes import NAMES, SpeedScene, make_scene
from warpir.core.memory import core_count
from warpir.render.device import choose_device

RUN_SEED = 100
"""First seed of what is measured; references and warm-up have others."""
ERRORS = ("rmse_forward", "rmse_image", "rmse_image_all", "rmse_gradient")
TRANSPORT_STEPS = 10
"""Steps timed on each traced transport."""


@dataclass(frozen=True)
class Plan:
    """What a run measures; by default all of it."""

    width: int = 384
    height: int = 256
    mis_spp: tuple[int, ...] = (4, 16, 64, 256)
    mitsuba_spp: tuple[int, ...] = (4, 16, 64, 256, 1024)
    transport: tuple[dict[str, Any], ...] = (
        {},
        {"subsamples": 16, "paths": 32, "bright_directions": 256},
        {"subsamples": 64, "paths": 128, "bright_directions": 4096},
        {"expects_light": False},
    )
    """Settings, see `Transport`."""
    rounds: int = 3
    """Runs of each candidate, in turn with all others."""
    transport_rounds: int = 2
    """Rounds in which transport is traced again."""
    budget_s: float = 10.0
    """A candidate that would take longer than this in all is not run again."""
    reference_spp: tuple[int, int] = REFERENCE_SPP
    """Of `References`; half of Mitsuba's is its largest here, so that nothing else is compiled."""


QUICK = Plan(
    *(96, 64, (4, 16, 64), (16, 256), ({},)),
    rounds=2,
    transport_rounds=1,
    budget_s=2.0,
    reference_spp=(256, 512),
)
WARM_TRANSPORT = {"subsamples": 1, "bright_directions": 0, "paths": 1}


@dataclass
class Runs:
    """What was measured of one candidate."""

    seconds_forward: list[float] = field(default_factory=list)
    seconds_step: list[float] = field(default_factory=list)
    seconds_traced: list[float] = field(default_factory=list)
    rmse: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    """By part: of ``image``, ``image_all`` and ``gradient``, one record per seed."""
    peak_mib: float = 0.0
    bytes: int = 0

    @property
    def spent(self) -> float:
        """All timed seconds."""
        return sum(self.seconds_forward) + sum(self.seconds_step) + sum(self.seconds_traced)

    def time(self, candidate: MisPart | MitsubaPart | Transport, seed: int) -> tuple[Images, Step]:
        """Run the candidate forward and for one step."""
        start = time.perf_counter()
        images = candidate.forward(seed)
        middle = time.perf_counter()
        download = candidate.step(seed + 1000)
        end = time.perf_counter()
        self.seconds_forward.append(middle - start)
        self.seconds_step.append(end - middle)
        return images(), download()

    def judge(self, found: tuple[Images, Step], references: References) -> None:
        """Add the errors of the forward image and of a step's image and gradient."""
        images, step = found
        for part, (image, gradient) in step.items():
            reference = references.by_part[part]
            errors = reference.rmse((image, gradient))
            errors["forward"] = reference.rmse((images[part], gradient))["image"]
            self.rmse.setdefault(part, []).append(errors)

    def errors(self, part: str) -> dict[str, float]:
        """Root mean square over seeds."""
        records = self.rmse[part]
        return {
            f"rmse_{name}": float(np.sqrt(np.mean([r[name] ** 2 for r in records])))
            for name in records[0]
        }


def log(text: str) -> None:
    """Say on the error stream how far the run is."""
    print(f"[{time.perf_counter() - STARTED:6.1f} s] {text}", file=sys.stderr, flush=True)


STARTED = time.perf_counter()


def measure_scene(bench: Bench, plan: Plan, references: References) -> list[dict[str, Any]]:
    """Run every candidate of a scene in turn; return its rows."""
    parts: list[MisPart | MitsubaPart] = []
    for part in PARTS:
        parts += [MisPart(bench, part, spp) for spp in plan.mis_spp]
        parts += [MitsubaPart(bench, part, spp) for spp in plan.mitsuba_spp]
    name = bench.scene.name
    Transport(bench, WARM_TRANSPORT, seed=0).warm()
    warmed: set[tuple[Any, ...]] = set()
    for candidate in parts:
        if candidate.warm_key not in warmed:
            warmed.add(candidate.warm_key)
            candidate.warm()
    log(f"{name}: kernels are warm")

    part_runs = [Runs() for _ in parts]
    whole_runs = [Runs() for _ in plan.transport]
    for k in range(plan.rounds):
        for candidate, runs in zip(parts, part_runs, strict=True):
            if k > 0 and runs.spent * (k + 1) / k > plan.budget_s:
                continue
            if k == 0:
                bench.memory.start()
            found = runs.time(candidate, RUN_SEED + k)
            if k == 0:
                runs.peak_mib = bench.memory.stop()
            runs.judge(found, references)
        if k < plan.transport_rounds:
            for settings, runs in zip(plan.transport, whole_runs, strict=True):
                _measure_transport(bench, settings, references, RUN_SEED + k, runs)
        log(f"{name}: round {k + 1} of {plan.rounds}")

    resolution = references.resolution()
    rows = []
    for which in (MitsubaPart.integrator, MisPart.integrator):
        rows += _sweep_rows(bench, which, parts, part_runs)
    rows += [_transport_row(*pair) for pair in zip(plan.transport, whole_runs, strict=True)]
    return [{**row, "scene": name, "rmse_resolution": resolution} for row in rows]


def _measure_transport(
    bench: Bench, settings: dict[str, Any], references: References, seed: int, runs: Runs
) -> None:
    """Trace once and time several steps; the frozen samples have one error, whatever the step."""
    bench.memory.start()
    transport = Transport(bench, settings, seed)
    runs.seconds_traced.append(transport.traced.seconds_traced)
    runs.bytes = transport.traced.bytes
    transport.warm()
    for k in range(TRANSPORT_STEPS):
        found = runs.time(transport, seed + k)
    runs.peak_mib = max(runs.peak_mib, bench.memory.stop())
    runs.judge(found, references)
    del transport, found
    gc.collect()


def _part(runs: Runs, part: str) -> dict[str, float]:
    return {
        "seconds_forward": float(np.median(runs.seconds_forward)),
        "seconds_step": float(np.median(runs.seconds_step)),
        **runs.errors(part),
        "runs": len(runs.seconds_step),
    }


def _sweep_rows(
    bench: Bench, which: str, parts: Sequence[MisPart | MitsubaPart], runs: Sequence[Runs]
) -> list[dict[str, Any]]:
    """Join both parts at the same samples per pixel into rows."""
    pairs = zip(parts, runs, strict=True)
    found = {(c.part, c.spp): r for c, r in pairs if c.integrator == which}
    rows = []
    for spp in sorted({spp for _, spp in found}):
        by_part = {part: _part(found[part, spp], part) for part in PARTS}
        fg, ratio = by_part.values()
        settings: dict[str, Any] = {"spp": spp}
        if which == MitsubaPart.integrator:
            settings |= {"integrator": bench.mitsuba_integrator, "sampler": bench.sampler}
        row: dict[str, Any] = {"integrator": which, "settings": settings}
        row |= {key: fg[key] + ratio[key] for key in ("seconds_forward", "seconds_step")}
        row |= {key: combined(fg[key], ratio[key]) for key in ERRORS}
        # One after the other: the larger of the two
        peak = max(found[part, spp].peak_mib for part in PARTS)
        rows.append({**row, "peak_mib": round(peak, 1), "parts": by_part})
    return rows


def _transport_row(settings: dict[str, Any], runs: Runs) -> dict[str, Any]:
    errors = {part: runs.errors(part) for part in PARTS}
    return {
        "integrator": "transport",
        "settings": settings,
        "seconds_forward": float(np.median(runs.seconds_forward)),
        "seconds_step": float(np.median(runs.seconds_step)),
        "seconds_traced": float(np.median(runs.seconds_traced)),
        **{key: combined(*(errors[part][key] for part in PARTS)) for key in ERRORS},
        "peak_mib": round(runs.peak_mib, 1),
        "transport_mib": round(runs.bytes / 2**20, 1),
        "runs": len(runs.seconds_step),
        "parts": errors,
    }


def disagreements(agreement: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]]) -> list[str]:
    """Name what the two renderers' references differ in by too much (design, 7.3).

    Too much is a tenth of the smallest error compared, where chance does not explain it.
    """
    found = []
    for entry in agreement:
        scene, part = entry["scene"], entry["part"]
        here = [r for r in rows if r["scene"] == scene]
        for quantity in ("image", "gradient"):
            least = min((r["parts"][part][f"rmse_{quantity}"] for r in here), default=np.inf)
            apart = entry[quantity]["without_noise"]
            if apart > max(0.1 * least, entry[quantity]["resolved"]):
                found.append(
                    f"{scene}, {part} {quantity}: the references differ by "
                    f"{100 * apart:.3f} % beyond their noise; the smallest error compared is "
                    f"{100 * least:.3f} %"
                )
    return found


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the options of a command line."""
    parser = flags(__doc__)
    parser.add_argument("--quick", action="store_true", help="64 rows, short sweeps: two minutes")
    parser.add_argument("--scenes", nargs="*", default=list(NAMES), choices=NAMES)
    parser.add_argument("--threads", type=int, default=0, help="CPU threads of every renderer")
    parser.add_argument("--sampler", default="ldsampler", help="of Mitsuba")
    about = "let Mitsuba's Python trace every call anew"
    parser.add_argument("--no-freeze", action="store_true", help=about)
    parser.add_argument("--budget", type=float, help="seconds per candidate")
    parser.add_argument("--cache", type=Path, default=Path("out/speed"), help="of references")
    about = "write table and plot here (docs, unless --quick)"
    parser.add_argument("--docs", type=Path, help=about)
    return parser.parse_args(arguments)


def measured(
    scene: SpeedScene, plan: Plan, options: argparse.Namespace
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the rows of a scene, and how far its references agree."""
    import drjit as dr

    bench = Bench(scene, options.sampler, not options.no_freeze)
    references = References(bench, options.cache, plan.reference_spp, log)
    rows = measure_scene(bench, plan, references)
    agreement = [
        {"scene": scene.name, "part": part, **reference.agreement()}
        for part, reference in references.by_part.items()
    ]
    del bench, references
    gc.collect()
    dr.flush_malloc_cache()
    return rows, agreement


def main(arguments: list[str] | None = None) -> None:
    """Measure, write the JSON and, after a full run, the documents."""
    options = parse(arguments)
    plan = QUICK if options.quick else Plan()
    if options.budget:
        plan = replace(plan, budget_s=options.budget)
    device = choose_device(options.device)
    threads = options.threads or core_count()
    use_device("cpu" if device == "cpu" else "cuda", threads)

    import drjit as dr
    import mitsuba as mi

    # Modules stay; to look through them took half a second at each mark of the memory.
    gc.freeze()
    rows: list[dict[str, Any]] = []
    agreement: list[dict[str, Any]] = []
    scenes: list[dict[str, Any]] = []
    skipped = []
    for name in options.scenes:
        try:
            scene = make_scene(name, plan.width, plan.height, options.assets, device, threads)
        except FileNotFoundError as error:
            skipped.append(f"{name}: {error} (--assets)")
            log(f"skipped {skipped[-1]}")
            continue
        found = measured(scene, plan, options)
        rows += found[0]
        agreement += found[1]
        scenes.append(scene.record())
    conditions = {
        **context(wp.get_device(device), threads),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "variant": mi.variant(),
        "torch": version("torch"),
        "instructions": torch.backends.cpu.get_cpu_capability() if device == "cpu" else None,
        "quick": options.quick,
        "size": [plan.width, plan.height],
        "command": "python -m benchmarks.speed " + " ".join(arguments or sys.argv[1:]),
        "seconds": round(time.perf_counter() - STARTED, 1),
    }
    for row in rows:
        row["device"] = conditions["device"]
    result = {
        "conditions": conditions,
        "scenes": scenes,
        "skipped": skipped,
        "ratios": ratios(rows),
        "references": agreement,
        "disagreements": disagreements(agreement, rows),
        "rows": rows,
    }
    write_json(options.json, result)
    print(summary(result))
    docs = options.docs or (None if options.quick else Path("docs"))
    if docs is not None:
        keep_run(result, docs)
        write_documents(docs)


if __name__ == "__main__":
    main()
