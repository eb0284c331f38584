"""What benchmarks share: flags, timing, peak memory, and how figures are written."""

import argparse
import json
import platform
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from warpir.app.record import commit
from warpir.core import memory

PATHS = {"type": Path, "nargs": "+", "required": True}
FOLDER = Path("../shared/data")
FLAGS: dict[str, tuple[str, dict[str, Any]]] = {
    "assets": (
        "--assets",
        {"type": Path, "default": FOLDER, "help": "folder that holds mesh/ and hdri/"},
    ),
    "objects": ("--assets", PATHS),
    "panoramas": ("--panoramas", PATHS),
    "device": ("--device", {"help": "cpu or cuda"}),
    "json": ("--json", {"type": Path, "help": "file for the figures"}),
}
"""What several benchmarks ask for."""


def flags(doc: str | None, *names: str) -> argparse.ArgumentParser:
    """Return a parser with some of `FLAGS`; ``doc`` is the module's docstring."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in names or ("assets", "device", "json"):
        flag, options = FLAGS[name]
        parser.add_argument(flag, **options)
    return parser


def seconds(work: Callable[[], object], device: wp.Device) -> float:
    """Return the median of seven run times [s], after a warm-up."""
    work()
    wp.synchronize_device(device)
    times = []
    for _ in range(7):
        start = time.perf_counter()
        work()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def peak_mib(device: wp.Device) -> float:
    """Return the peak memory of the process [MiB]: of the card on CUDA, else resident."""
    return memory.peak_mib()["Warp on the GPU" if device.is_cuda else "host"]


def context(device: wp.Device, threads: int) -> dict[str, Any]:
    """Return what a figure depends on besides the code."""
    return {
        "commit": commit(),
        "date": time.strftime("%Y-%m-%d"),
        "device": device.name if device.is_cuda else platform.machine() + " CPU",
        "threads": threads if device.is_cpu else None,
        "warp": version("warp-lang"),
        "python": platform.python_version(),
    }


def report(line: dict[str, Any], path: Path | None) -> None:
    """Print a figure as one JSON line and append it to ``path``."""
    text = json.dumps(line)
    print(text, flush=True)
    if path is not None:
        with open(path, "a", encoding="utf-8") as stream:
            stream.write(text + "\n")


def rms(values: ArrayLike) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.square(values).mean()))


def write_json(path: Path | None, content: Any, indent: int | None = 1) -> None:
    """Write figures to a file, where one is named."""
    if path is not None:
        path.write_text(json.dumps(content, indent=indent) + "\n", encoding="utf-8")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines)
