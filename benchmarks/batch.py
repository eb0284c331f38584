"""How many scenes a minute does a batch do, against one process after another?

    python -m benchmarks.batch [--scenes N] [--samples N] [--out DIR] [--json FILE]

The scene that ships with warpir under its own light, each with another seed: by `warpir.insert` in
a process for each, one after another, then by `warpir.batch` with one and with two workers. All of
them must leave the same bytes. Prints a table in Markdown, for docs/batch.md; CPU seconds tell what
was saved on a machine that others use too.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import warp as wp

from benchmarks.measure import context, flags, report, table
from warpir.core.memory import core_count

WORKERS = (1, 2)
wp.config.log_level = wp.LOG_ERROR


def main() -> None:
    """Measure, compare and print."""
    parser = flags(__doc__, "json")
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--samples", type=int, default=16)
    parser.add_argument("--out", type=Path, help="where results go for a while (default: TMPDIR)")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.out, prefix="warpir-bench-") as folder:
        measure(Path(folder), options.scenes, options.samples, options.json)


def measure(folder: Path, count: int, samples: int, path: Path | None) -> None:
    """Do the same scenes in each way.

    Raises:
        AssertionError: Two ways leave other bytes.
    """
    same = ["--demo", "--guidance", "none", "--device", "cpu", "--samples", str(samples)]
    rows = [{"name": f"scene-{seed}", "seed": seed} for seed in range(count)]
    (folder / "scenes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))

    def singly(out: Path, seeds: range) -> None:
        for seed in seeds:
            scene = ["--seed", str(seed), "--out", str(out / f"scene-{seed}")]
            run("warpir.insert", [*same, *scene])

    def batch(out: Path, workers: int) -> None:
        argv = [str(folder / "scenes.jsonl"), *same, "--workers", str(workers)]
        run("warpir.batch", [*argv, "--out", str(out)])

    singly(folder / "warm", range(1))  # no compilation is measured
    ways = {"`insert`, one process after another": partial(singly, seeds=range(count))}
    ways |= {f"`batch --workers {n}`": partial(batch, workers=n) for n in WORKERS}
    spent: dict[str, tuple[float, float]] = {}
    written = []
    for number, (name, do) in enumerate(ways.items()):
        out = folder / str(number)
        start, before = time.perf_counter(), cpu_seconds()
        do(out)
        spent[name] = time.perf_counter() - start, cpu_seconds() - before
        records = [out / f"scene-{seed}" / "run.json" for seed in range(count)]
        written.append([json.loads(record.read_text())["files"] for record in records])
        for files in written[-1]:
            files.pop("report.html", None)  # which tells the seconds
    assert written[1:] == written[:-1], "the bytes differ"
    print(f"{count} scenes of {samples} samples, {len(written[0][0])} files each, the same bytes")
    first = next(iter(spent.values()))[0]
    cells = (
        (name, f"{s:.1f}", f"{cpu:.1f}", f"{60.0 * count / s:.1f}", f"{first / s:.2f} x")
        for name, (s, cpu) in spent.items()
    )
    print("\n" + table(("", "s", "CPU s", "scenes a minute", ""), cells))
    cores = core_count()
    figures: dict[str, Any] = {
        "question": "batch",
        "scenes": count,
        "samples": samples,
        "cores": cores,
        "load": round(os.getloadavg()[0], 1),
        "seconds and CPU seconds": {
            name.replace("`", ""): [round(s, 2) for s in both] for name, both in spent.items()
        },
    }
    report({**figures, **context(wp.get_device("cpu"), cores)}, path)


def run(program: str, argv: list[str]) -> None:
    """Run a program of warpir quietly, from this folder."""
    command = [sys.executable, "-P", "-m", program, *argv]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def cpu_seconds() -> float:
    """Return what all processes that have ended took so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


if __name__ == "__main__":
    main()
