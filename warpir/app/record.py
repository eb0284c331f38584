"""What a run leaves about itself: the content of ``run.json``."""

import hashlib
import importlib.util
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warpir
from warpir.app.config import InsertConfig
from warpir.core.atomic import sha256_of
from warpir.core.errors import InputError

OF_THE_RUN = ("out", "overwrite", "resume", "threads", "report")
"""Settings that change nothing in a result, so that its pictures do not hold them."""
PATHS = (
    *("photo", "occluder_mask", "asset", "materials", "camera", "ground_points", "proxy"),
    *("shadow_mask", "light", "lamps", "regressor", "model", "lora", "reuse", "sequence", "out"),
)
"""Settings that name a file or a folder."""
RUN_FORMAT = 1
"""Layout number of ``run.json``; a newer one is refused: its keys may mean other things."""
RECORDED_PACKAGES = (
    *("warp-lang", "torch", "numpy", "trimesh", "OpenEXR", "OpenImageIO", "pillow"),
    *("embreex", "diffusers", "transformers", "peft", "safetensors"),
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

    def rounded(self) -> dict[str, float]:
        """Return seconds by stage as they are told, to the millisecond."""
        return {name: round(spent, 3) for name, spent in self.seconds.items()}


def config_of_picture(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the configuration as a picture carries it, which may be given to others.

    Of paths only the names are left: where somebody keeps their files is for ``run.json``. A
    model's name in the hub is no path.
    """
    return {
        name: name_of(value) if name in PATHS and value is not None else value
        for name, value in values.items()
        if name not in OF_THE_RUN
    } | ({"model": values["model"]} if is_hub_id(values["model"]) else {})


def is_hub_id(model: str | None) -> bool:
    """Return whether a model is called by its name in the hub, and is no folder here."""
    from warpir.diffusion.models.hub import HUB_ID

    return model is not None and HUB_ID.fullmatch(model) is not None and not os.path.isdir(model)


def name_of(path: str) -> str:
    """Return the last part of a path, of ``.`` that of the folder it stands for."""
    return Path(os.path.abspath(path)).name


def input_files(config: InsertConfig) -> dict[str, Path]:
    """Return every input file that a flag names, by the name of its field; of a model, its files.

    Not the asset, the mesh of the place and the earlier run, whose readers hash what they read.
    """
    # Here, since the command line imports this module and must not load NumPy for --help.
    from warpir.diffusion.models.weight_files import beside_lora
    from warpir.io.cameras.colmap_model import is_model, model_files

    names = (
        *("photo", "occluder_mask", "materials", "camera", "light", "lora"),
        *("regressor", "ground_points", "shadow_mask", "lamps"),
    )
    paths = {name: Path(path) for name in names if (path := config.flat()[name]) is not None}
    for name, stems in MODEL_STEMS.items():
        if name in paths and is_model(paths[name]):
            files = model_files(paths.pop(name), *stems)
            paths |= {f"{name}/{file.name}": file for file in files}
    if "lora" in paths and (beside := beside_lora(paths["lora"])) is not None:
        paths[f"lora/{beside.name}"] = beside
    return paths


def file_hash(path: Path) -> str:
    """Return the sha256 of a file, or `warpir.scene.asset.ABSENT` where there is none.

    Raises:
        InputError: It cannot be read.
    """
    from warpir.scene.asset import ABSENT

    try:
        return sha256_of(path)
    except FileNotFoundError:
        return ABSENT
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from error


def sources_hash() -> str:
    """Return the sha256 of warpir's own modules: a checkout changes without another version."""
    files: dict[str, Path] = {}
    for package in ("warpir", "warpir.kernels", "warpir.diffusion"):
        spec = importlib.util.find_spec(package)
        assert spec is not None and spec.origin is not None
        folder = Path(spec.origin).parent
        for file in folder.rglob("*.py"):
            # In a wheel the folders kernels and diffusion lie in warpir: the same names there.
            files[f"{package.replace('.', '/')}/{file.relative_to(folder).as_posix()}"] = file
    digest = hashlib.sha256()
    for name, file in sorted(files.items()):
        digest.update(f"{name}\0".encode() + file.read_bytes())
    return digest.hexdigest()


def commit() -> str:
    """Return the commit of this checkout; "unknown" for an installed package, or without git."""
    root = Path(warpir.__file__).parents[1]
    if not (root / ".git").exists() or shutil.which("git") is None:
        return "unknown"  # git would name that of a repository around the installed package
    git = subprocess.run(
        ["git", "-C", str(root), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    )
    return git.stdout.strip() or "unknown"


def versions() -> dict[str, str]:
    """Return the versions that a result depends on, without importing the packages."""
    import importlib.metadata

    found = {"python": platform.python_version(), "platform": sys.platform}
    found["warpir"] = f"{warpir.__version__} (sources {sources_hash()[:16]})"
    for name in RECORDED_PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "absent"
    return found
