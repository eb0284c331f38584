"""Earlier runs: light and tone curves of one for ``--reuse``, and whether a folder holds a result.

The light is in the run's world frame, the one of its ``camera.json``. A photo of the same place
with a camera in that world needs nothing else; for any other camera the light is taken as it is,
which the run says, and ``--light-rotate`` turns it. The light is at the exposure of the run's
photo; for a photo of another exposure ``--exposure`` scales it.

A result is that of a configuration if its ``run.json`` was asked for the same and every file that
it read has the same sha256 now. What it wrote must be there as it wrote it: nothing is done then.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.app.command import read_values
from warpir.app.config import DEFAULTS, InsertConfig
from warpir.app.model_files import model_hashes
from warpir.app.record import RUN_FORMAT, file_hash, input_files
from warpir.core.atomic import sha256_of
from warpir.core.errors import ExitCode, InputError, shown
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_json_object
from warpir.io.cameras.source import rigid
from warpir.io.curves_file import read_curves
from warpir.io.images.kinds import check_regular_file
from warpir.io.images.photos import read_envmap
from warpir.io.meshes.materials_file import MATERIALS
from warpir.io.unfinished import results_in
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves

LIGHT, SHADOW_LIGHT = "envmap.exr", "envmap_shadow.exr"
CURVES, CAMERA = "curves.json", "camera.json"
SAME_POSE = 1e-6
"""Largest difference of two poses that are one [1, m]."""


@dataclass(frozen=True)
class EarlierRun:
    """What an earlier run found out about its photo."""

    path: Path
    light_fg: Light
    """Lights the object, at the exposure of the run's photo."""
    light_shadow: Light
    """Casts its shadow; the same object as `light_fg` where the run had one light."""
    curves: Curves
    c2w: NDArray[np.float64]
    """Pose of the run's camera, whose world is the light's, shape [4, 4]."""
    materials: Path | None = None
    """What --materials would give the run's object its materials by, if they were changed."""
    digest: str = ""
    """sha256 of its ``run.json``, which holds those of its other files."""

    def assumption(self, c2w: NDArray[np.float64], camera_path: str | None) -> str:
        """Return what is assumed of another camera's world, or an empty text for the same pose."""
        if np.allclose(c2w, self.c2w, rtol=0.0, atol=SAME_POSE):
            return ""
        if camera_path is not None:
            return (
                f"the world of {Path(camera_path).name} is that of {self.path / CAMERA}, whose "
                "light is used as it is (--light-rotate)"
            )
        return (
            f"the camera looks along -Z of the world of {self.path / CAMERA}, whose light is used "
            "as it is (--camera, --light-rotate)"
        )


def read_run(path: str | Path, limits: Limits = LIMITS) -> EarlierRun:
    """Read the light and the tone curves of a finished run.

    Args:
        path: The run's folder. What its ``run.json`` does not list is not looked at.
        limits: How large its files may be.

    Raises:
        InputError: The folder holds no finished run, or a file of it is missing, changed or wrong.
    """
    path = Path(path)
    names = [LIGHT, CURVES, CAMERA]
    record = run_record(path, limits)
    files, given = record["files"], record["config"].get("materials")
    materials = path / MATERIALS if MATERIALS in files else None
    if materials is None and isinstance(given, str):
        materials = Path(given)
    if SHADOW_LIGHT in files:
        names.append(SHADOW_LIGHT)
    check_files(path, {name: files.get(name) for name in names})
    light_fg = light_shadow = Light(
        texels=read_envmap(path / LIGHT, strict=True, max_width=limits.envmap_width)
    )
    if SHADOW_LIGHT in files:
        light_shadow = Light(
            texels=read_envmap(path / SHADOW_LIGHT, strict=True, max_width=limits.envmap_width)
        )
    digest = file_hash(path / "run.json")
    curves = read_curves(path / CURVES, limits)
    pose = rigid(path / CAMERA, "c2w", read_json_object(path / CAMERA, limits).get("c2w"))
    return EarlierRun(path, light_fg, light_shadow, curves, pose, materials, digest)


def run_record(path: Path, limits: Limits = LIMITS) -> dict[str, Any]:
    """Return the ``run.json`` of a finished run; its ``config`` and ``files`` are objects.

    Raises:
        InputError: There is none, or it is of a format that this version does not know.
    """
    if not os.path.isfile(path / "run.json"):
        found = "no run.json" if os.path.isdir(path) else "no such folder"
        raise InputError(
            path, f"not a finished run (found {found})", "name a folder that a run wrote to its end"
        )
    record = read_json_object(path / "run.json", limits)
    number = record.get("format")
    if isinstance(number, bool) or not isinstance(number, int) or not 1 <= number <= RUN_FORMAT:
        raise InputError(
            path / "run.json",
            f"run.json of unknown format (found {number!r:.40}; expected 1 to {RUN_FORMAT})",
            "use the warpir version that wrote it",
        )
    for name in ("config", "files"):
        if not isinstance(record.get(name), dict):
            raise InputError(path / "run.json", f"/{name}: an object expected")
    return record


def check_files(path: Path, digests: dict[str, Any]) -> None:
    """Check that files of a run are as it wrote them.

    Args:
        path: The run's folder.
        digests: sha256 by name, from ``run.json``.

    Raises:
        InputError: A file is missing or has changed.
    """
    for name, digest in digests.items():
        if ".." in Path(name).parts or Path(name).is_absolute():
            raise InputError(
                path / "run.json", f"/files: {shown(name)} is outside the run's folder"
            )
        check_regular_file(path / name)
        try:
            found = sha256_of(path / name)
        except OSError as error:
            raise InputError(path / name, f"cannot be read ({error.strerror})") from error
        if found != digest:
            raise InputError(
                path / name,
                "changed since the run wrote it (its sha256 is not the one in run.json)",
                "give a light of your own with --light",
            )


class OtherRun(InputError):
    """A folder holds a whole result, but of other settings or other files."""


def is_done(config: InsertConfig, filled: InsertConfig | None = None) -> bool:
    """Return whether the folder of a configuration holds its result.

    ``filled`` is the same with the demo's files, where those are asked for. With ``overwrite``
    nothing is done.

    Raises:
        OtherRun: It holds the whole result of another one.
        InputError: It holds something else.
    """
    out = config.output.folder
    if out.is_symlink():
        raise _something_else(out, "a link")
    if config.output.overwrite or not out.is_dir():
        return False
    if not (out / "run.json").exists():
        if results_in(out):
            raise _something_else(out, "no finished run")
        return False
    try:
        record = run_record(out, config.limits)
        check_files(out, record["files"])
        same = _same(config, filled or config, record)
    except InputError as error:
        raise _something_else(out, f"{error.where}: {error.what}") from error
    if not same:
        raise _something_else(out, "a run of other settings or other files", OtherRun)
    return True


def config_of_record(values: dict[str, Any]) -> InsertConfig:
    """Return the configuration whose fields are plain values, as ``run.json`` has them.

    Raises:
        InputError: A value is none of its field's.
    """
    return InsertConfig(**read_values(values, str))


def _same(config: InsertConfig, filled: InsertConfig, record: dict[str, Any]) -> bool:
    """Return whether a run was asked for the same and read the same files."""
    made = {name: value for name, value in record["config"].items() if name in DEFAULTS}
    if len(made) < len(record["config"]):
        return False
    # Elsewhere, or by as many threads as there are, it is the same picture.
    of_the_run = {name: config.flat()[name] for name in ("out", "overwrite", "resume", "threads")}
    read = record.get("inputs")
    if config_of_record(made).changed(**of_the_run) != config or not isinstance(read, dict):
        return False
    config = filled  # from here on, what names the files
    paths = input_files(config)
    for name in read:
        field, _, file = name.partition("/")
        if name not in paths and field in ("asset", "proxy") and (path := config.flat()[field]):
            paths[name] = Path(path).parent.resolve() / file if file else Path(path)
    if config.light.reuse is not None:
        paths["reuse"] = Path(config.light.reuse, "run.json")
    hashes = {name: file_hash(path) for name, path in paths.items()}
    return read == hashes and _same_model(config, record)


def _same_model(config: InsertConfig, record: Mapping[str, Any]) -> bool:
    """Return whether Stable Diffusion's files are those that guided a run.

    Other priors are among the inputs, or part of the package.
    """
    measured = record.get("measured")
    guide = measured.get("model") if isinstance(measured, dict) else None
    if not isinstance(guide, dict) or guide.get("name") != "stable-diffusion":
        return True
    return bool(guide.get("sha256") == model_hashes(config.diffusion))


def _something_else(out: Path, found: str, kind: type[InputError] = InputError) -> InputError:
    return kind(
        out,
        f"holds something other than what is asked for (found {found})",
        "pass --overwrite to replace results",
        ExitCode.OUTPUT,
    )
