"""The light and the tone curves of an earlier run, for ``--reuse``: nothing is optimised again.

The light is in the run's world frame, the one of its ``camera.json``. A photo of the same place
with a camera in that world needs nothing else; for any other camera the light is taken as it is,
which the run says, and ``--light-rotate`` turns it. The light is at the exposure of the run's
photo; for a photo of another exposure ``--exposure`` scales it.
"""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpir.app.record import RUN_FORMAT, file_hash
from warpir.core.atomic import sha256_of
from warpir.core.errors import InputError, shown
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_json_object
from warpir.io.cameras.source import rigid
from warpir.io.curves_file import read_curves
from warpir.io.images.kinds import check_regular_file
from warpir.io.images.photos import read_envmap
from warpir.io.meshes.materials_file import MATERIALS
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
