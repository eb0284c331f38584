"""What a run leaves about itself: the content of ``run.json``."""

import hashlib
import platform
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import warpir
from warpir.config import InsertConfig

RUN_FORMAT = 1
"""Layout number of ``run.json``; a newer one is refused: its keys may mean other things."""
RECORDED_PACKAGES = (
    *("warp-lang", "torch", "numpy", "trimesh", "OpenEXR", "OpenImageIO", "pillow"),
    *("diffusers", "transformers", "peft", "safetensors"),
)

MODEL_STEMS = {"camera": ("cameras", "images"), "ground_points": ("points3D",)}
"""What is read of a COLMAP model, by field."""


class Timings:
    """Seconds by stage, in the order of the run."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a ``with`` block; a stage entered twice adds up."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self.seconds[name] = self.seconds.get(name, 0.0) + spent


def run_record(
    config: InsertConfig,
    *,
    inputs: Mapping[str, str],
    device: str,
    timings: Timings,
    assumed: Sequence[str] = (),
    notices: Sequence[str] = (),
    measured: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the content of ``run.json``; ``--config run.json`` runs it again.

    Args:
        config: What was asked for.
        inputs: sha256 of the files that were read, from `input_hashes`.
        device: What computed it, such as ``cpu`` or the name of a card.
        timings: Seconds by stage.
        assumed: What was chosen because nothing was given, one line each.
        notices: What was repaired, converted or left out, one line each.
        measured: Plain numbers about the result, such as photometry and clamped pixels.
    """
    return {
        "format": RUN_FORMAT,
        "warpir": warpir.__version__,
        "config": asdict(config),
        "inputs": dict(inputs),
        "assumed": list(assumed),
        "notices": list(notices),
        "measured": dict(measured or {}),
        "device": device,
        "versions": versions(),
        "seconds": {name: round(spent, 3) for name, spent in timings.seconds.items()},
    }


def input_hashes(config: InsertConfig) -> dict[str, str]:
    """Return the sha256 of every input file, by the name of its field; of a model, of its files.

    An earlier run is known by its ``run.json``, which holds the sha256 of its other files.
    """
    # Here, since the command line imports this module and must not load NumPy for --help.
    from warpir.colmap_model import is_model, model_files

    names = (
        *("photo", "occluder_mask", "asset", "materials", "camera", "light", "lora", "reuse"),
        *("prior", "regressor", "ground_points", "proxy", "shadow_mask"),
    )
    paths = {name: Path(path) for name in names if (path := getattr(config, name)) is not None}
    for name, stems in MODEL_STEMS.items():
        if name in paths and is_model(paths[name]):
            files = model_files(paths.pop(name), *stems)
            paths |= {f"{name}/{file.name}": file for file in files}
    if config.reuse is not None:
        paths["reuse"] /= "run.json"
    hashes = {}
    for name, path in paths.items():
        with path.open("rb") as stream:
            hashes[name] = hashlib.file_digest(stream, "sha256").hexdigest()
    return hashes


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, without importing the packages."""
    import importlib.metadata

    found = {"python": platform.python_version(), "platform": sys.platform}
    for name in RECORDED_PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    return found
