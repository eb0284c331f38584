"""Error over time of ToyCar's object, over so many seeds that its fireflies are counted.

    python -m benchmarks.speed.fireflies --runs 40

A few runs say little of a picture whose squared error lies in a handful of mirrored suns: whether a
run meets one is chance. The mean square over many runs says more; the standard error of its root
is too small where the rarest fireflies were not met.
"""

import time
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.measure import context, flags, write_json
from benchmarks.speed.candidates import Bench, MisPart, MitsubaPart, use_device
from benchmarks.speed.references import REFERENCE_SPP, References
from benchmarks.speed.scenes import NAMES, make_scene
from warpir.core.memory import core_count
from warpir.render.device import choose_device

FIRST_SEED = 5000
PART = "foreground"
POINTS = ((MisPart, 16), (MisPart, 64), (MitsubaPart, 16), (MitsubaPart, 64), (MitsubaPart, 256))
"""Renderers and their samples of a pixel."""


def measured(
    candidate: MisPart | MitsubaPart, references: References, runs: int
) -> dict[str, float | int | str]:
    """Run a candidate with so many seeds; return its time and errors, relative RMSE."""
    candidate.warm()
    reference = references.by_part[PART]
    seconds, errors = [], []
    for seed in range(FIRST_SEED, FIRST_SEED + runs):
        start = time.perf_counter()
        download = candidate.forward(seed)
        seconds.append(time.perf_counter() - start)
        errors.append(reference.rmse((download()[PART], reference.own[1][0]))["image"])
    squares = np.square(errors)
    mean = float(squares.mean())
    return {
        "integrator": candidate.integrator,
        "samples": candidate.spp,
        "runs": runs,
        "seconds": float(np.median(seconds)),
        "rmse": mean**0.5,
        "rmse_standard_error": float(squares.std(ddof=1) / runs**0.5 / (2.0 * mean**0.5)),
        "median_rmse": float(np.median(errors)),
    }


def main() -> None:
    """Measure and print a line for each renderer and count of samples."""
    parser = flags(__doc__)
    parser.add_argument("--scene", default="toycar", choices=NAMES)
    parser.add_argument("--runs", type=int, default=40, help="seeds; a quarter at 256 samples")
    parser.add_argument("--cache", type=Path, default=Path("out/speed"), help="of references")
    options = parser.parse_args()
    device, threads = choose_device(options.device), core_count()
    use_device("cpu" if device == "cpu" else "cuda", threads)
    scene = make_scene(options.scene, 384, 256, options.assets, device, threads)
    bench = Bench(scene, "ldsampler", freeze=device == "cpu")  # Dr.Jit refuses ToyCar on CUDA
    references = References(bench, options.cache, REFERENCE_SPP, partial(print, flush=True))
    rows = []
    for make, samples in POINTS:
        runs = options.runs if samples < 256 else max(2, options.runs // 4)
        rows.append(measured(make(bench, PART, samples), references, runs))
        row = rows[-1]
        print(
            f"{row['integrator']:8} {samples:4} samples, {runs} runs: {row['seconds']:.3g} s, "
            f"{100 * float(row['rmse']):.3g} +- {100 * float(row['rmse_standard_error']):.2g} %, "
            f"median {100 * float(row['median_rmse']):.3g} %",
            flush=True,
        )
    write_json(options.json, {**context(scene.renderer.device, threads), "rows": rows})


if __name__ == "__main__":
    main()
