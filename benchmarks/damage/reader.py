"""The process that meets damaged files: reads one after the other and tells how each ended.

    python -m benchmarks.damage.reader

Each line of its input names a reader and a file; each line of its output is what a user would have
seen of it: exit status, standard output and error, seconds, memory. Nothing of torch is loaded
before a reader needs it. The process is small and may die: its owner starts another.
"""

import contextlib
import json
import os
import re
import resource
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpir.app.program import run_program
from warpir.core.errors import ExitCode

PHOTO_SIZE = (48, 36)
"""What cameras and masks belong to [px]."""
PIXELS = 1_000_000
"""Limit of a picture: what is within ``--max-pixels`` may cost what it costs, padding included."""
ADDRESS_SPACE = 3 * 2**30
"""Virtual memory beyond what the process has before [byte]. More than the promised 500 MB, which
are of memory that is touched: decoders reserve what a header announces before they read on."""


def _finite(*arrays: Any) -> None:
    for array in arrays:
        if array is not None and not np.isfinite(np.asarray(array, np.float64)).all():
            raise AssertionError("numbers that are not finite came through")


def _photo(path: Path) -> None:
    from warpir.io.images.photos import read_photo

    photo = read_photo(path, max_pixels=PIXELS, alpha="ignore")
    _finite(photo.srgb, photo.codes, photo.focal_35mm)
    photo.encode(photo.srgb, np.ones(photo.srgb.shape[:2], bool))


def _envmap(path: Path) -> None:
    from warpir.io.images.photos import read_envmap

    texels = read_envmap(path, pictures=True, max_width=1000, notices=[])
    _finite(texels)
    assert texels.min() >= 0.0


def _mask(path: Path) -> None:
    from warpir.io.images.photos import read_mask

    _finite(read_mask(path, PHOTO_SIZE, max_pixels=PIXELS))


def _asset(path: Path) -> None:
    from warpir.io.assets import load_asset

    asset = load_asset(path)
    for part in asset.primitives:
        _finite(part.positions, part.normals, part.tangents, part.uv0, part.uv1, part.colors)
        assert 0 <= part.indices.min() <= part.indices.max() < len(part.positions)


def _camera(path: Path) -> None:
    from warpir.io.cameras.reader import read_photo_camera

    view = read_photo_camera(path, PHOTO_SIZE, photo_name="2.png", undistort=True)
    camera = view.camera
    _finite(camera.c2w, [camera.fx, camera.fy, camera.cx, camera.cy], view.world)
    assert camera.fx > 0.0 and camera.fy > 0.0
    assert (camera.width, camera.height) == PHOTO_SIZE
    assert np.allclose(camera.c2w[:3, :3] @ camera.c2w[:3, :3].T, np.eye(3), atol=1e-6)


def _points(path: Path) -> None:
    from warpir.io.meshes.point_cloud import read_point_cloud

    _finite(read_point_cloud(path))


def _lobes(path: Path) -> None:
    from warpir.io.lobes_file import read_lobes

    lobes = read_lobes(path)
    _finite(lobes.amplitude, lobes.axis, lobes.sharpness)


def _curves(path: Path) -> None:
    from warpir.io.curves_file import read_curves

    curves = read_curves(path)
    _finite(curves.foreground.evaluate(np.linspace(0.0, 1.0, 9)))
    _finite(curves.shadow_ratio.evaluate(np.linspace(0.0, 1.0, 9)))


def _materials(path: Path) -> None:
    from warpir.io.assets import load_asset
    from warpir.io.meshes.materials_file import with_materials

    with_materials(load_asset(path.parent / "asset.glb"), path)


def _config(path: Path) -> None:
    from warpir.app.command import parse

    parse(["--config", str(path)])


def _run(path: Path) -> None:
    from warpir.app.earlier_runs import read_run

    run = read_run(path.parent)
    _finite(run.c2w, run.light_fg.texels, run.light_shadow.texels)


def _sequence(path: Path) -> int:
    from warpir.insert import main

    with contextlib.chdir(path.parent):
        argv = ["--photo", "photo.png", "--asset", "asset.glb", "--out", "out", "--validate"]
        return main([*argv, "--sequence", path.name, "--reuse", "run"])


def _insert(path: Path) -> int:
    from warpir.insert import main
    from warpir.io.layers import read_layers

    status = main(json.loads(path.read_text()))
    if (path.parent / "out" / "run.json").exists():
        layers = read_layers(path.parent / "out" / "layers.exr")
        planes = vars(layers) | {"depth": None}  # which is infinite behind the object
        _finite(*planes.values())
    return status


def _regressor(path: Path) -> None:
    from warpir.lighting.regressor import load_regressor

    load_regressor(path)


def _lora(path: Path) -> None:
    from warpir.diffusion.personalization.lora_files import read_lora

    read_lora(path)


def _checkpoint(path: Path) -> None:
    from warpir.core.atomic import Checkpoints

    Checkpoints(path.parents[2], {"config": {"seed": 1}}).load(lambda line: None)


READERS: dict[str, Callable[[Path], int | None]] = {
    **{"photo": _photo, "envmap": _envmap, "mask": _mask, "asset": _asset, "camera": _camera},
    **{"points": _points, "lobes": _lobes, "curves": _curves, "materials": _materials},
    **{"config": _config, "run": _run, "sequence": _sequence, "insert": _insert},
    **{"regressor": _regressor, "lora": _lora, "checkpoint": _checkpoint},
}


def _memory(name: str) -> int:
    """Return a figure of this process [byte]: VmHWM is the most that was resident."""
    found = re.search(rf"{name}:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return 1024 * int(found[1])


def _meet(reader: Callable[[Path], int | None], path: Path) -> dict[str, Any]:
    """Read a file as a program would, and return how it ended."""
    saved = os.dup(1), os.dup(2)
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        Path("/proc/self/clear_refs").write_text("5")  # VmHWM begins again
        before = _memory("VmHWM")
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        start = time.perf_counter()
        try:
            status = run_program(lambda _: reader(path) or ExitCode.DONE, [])
            sys.stdout.flush()
            sys.stderr.flush()
        finally:
            seconds = time.perf_counter() - start
            for number, stream in zip(saved, (1, 2), strict=True):
                os.dup2(number, stream)
                os.close(number)
        ended: dict[str, Any] = {
            "status": int(status),
            "seconds": seconds,
            "bytes": _memory("VmHWM") - before,
        }
        for name, file in (("out", out), ("err", err)):
            file.seek(0)
            ended[name] = file.read(20_000).decode("utf-8", "replace")
    return ended


def main() -> None:
    """Serve until the input ends."""
    answers = os.fdopen(os.dup(1), "w")
    warnings.simplefilter("always")  # a warning is told each time, not once a process
    for line in sys.stdin:
        request = json.loads(line)
        # The first file of a format is sound, and reading it loads what others need too.
        space = resource.RLIM_INFINITY if request["first"] else _memory("VmSize") + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (space, resource.RLIM_INFINITY))
        ended = _meet(READERS[request["reader"]], Path(request["path"]))
        answers.write(json.dumps(ended) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
