"""Inputs of a small insertion, its command line, and readers of what it writes."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import trimesh

from warpir.core.arrays import BoolArray, FloatArray, PixelArray
from warpir.core.errors import ExitCode
from warpir.insert import main

ALWAYS = (
    "balls.png",
    "blender_setup.py",
    "camera.json",
    "composite.png",
    "curves.json",
    "envmap.exr",
    "envmap.hdr",
    "envmap_preview.png",
    "envmap_web.hdr",
    "layers.exr",
    "object.glb",
    "photo.png",
    "report.html",
    "tone_curve_object.cube",
    "tone_curve_shadow.cube",
    "viewer.html",
)
"""Every run writes these, and ``run.json`` behind them."""


DETAIL = ("envmap_detail.exr", "envmap_detail.hdr", "envmap_detail_preview.png")
"""Where the light has no panorama's detail of its own, also these."""


HALF = 2e-3
"""Error of linear values in [0, 1] as half floats; the writer's own limit."""


WIDTH, HEIGHT = 48, 32


def digest(folder: Path) -> dict[str, str]:
    """Sha256 of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def write_photo(path: Path, bits: int = 8) -> PixelArray:
    """A photo with structure in every pixel; returns its codes."""
    rng = np.random.default_rng(9)
    top = 2**bits - 1
    codes = rng.integers(top // 5, top - top // 5, (HEIGHT, WIDTH, 3))
    codes = codes.astype(np.uint8 if bits == 8 else np.uint16)
    buffer = oiio.ImageBuf(codes)
    assert buffer.write(str(path)), buffer.geterror()
    return codes


def write_panorama(path: Path) -> PixelArray:
    """A small panorama: a blue sky, dark ground and a sun."""
    texels = np.full((16, 32, 3), (0.3, 0.5, 1.0), np.float32)
    texels[8:] = 0.1
    texels[3, 20] = 60.0
    buffer = oiio.ImageBuf(texels)
    assert buffer.write(str(path)), buffer.geterror()
    return texels


LOBES = {
    "format": "warpir-lobes",
    "version": 1,
    "lobes": [
        {"amplitude": [30, 28, 25], "axis": [0.5, 0.8, 0.3], "sharpness": 60},
        {"amplitude": [0.4, 0.5, 0.7], "axis": [0, 1, 0], "sharpness": 0.5},
    ],
}


def write_inputs(folder: Path) -> None:
    """Photo, assets and lights of all tests."""
    write_photo(folder / "photo.png")
    write_photo(folder / "deep.png", 16)
    trimesh.creation.box(extents=(1.0, 1.0, 1.0)).export(folder / "box.glb")
    (folder / "box.mtl").write_text("newmtl red\nKd 0.8 0.1 0.1\n")
    mesh = trimesh.creation.box(extents=(1.0, 1.0, 1.0))
    lines = ["mtllib box.mtl", "usemtl red"]
    lines += [f"v {x} {y} {z}" for x, y, z in mesh.vertices]
    lines += [f"f {a} {b} {c}" for a, b, c in mesh.faces + 1]
    (folder / "box.obj").write_text("\n".join(lines) + "\n")
    write_panorama(folder / "sky.hdr")
    write_panorama(folder / "sky.exr")
    (folder / "lobes.json").write_text(json.dumps(LOBES))


POSE = ["--fov", "60", "--pitch", "-15", "--camera-height", "1.5", "--place", "0,0,-5"]


CHEAP = ["--samples", "4", "--depth", "2", "--seed", "3"]


def arguments(folder: Path, into: Path | str, **changes: str | None) -> list[str]:
    """A cheap valid run; ``changes`` replace a flag's value, or remove it with None."""
    flags: dict[str, str | None] = {
        "photo": str(folder / "photo.png"),
        "asset": str(folder / "box.glb"),
        "out": str(into),
        **{POSE[k][2:].replace("-", "_"): POSE[k + 1] for k in range(0, len(POSE), 2)},
        **{CHEAP[k][2:]: CHEAP[k + 1] for k in range(0, len(CHEAP), 2)},
        "light": str(folder / "sky.hdr"),
        **changes,
    }
    argv: list[str] = []
    for name, value in flags.items():
        if value is not None:
            argv += ["--" + name.replace("_", "-"), *([value] if value else [])]
    return argv


@dataclass(frozen=True)
class Run:
    """A finished run and what it printed."""

    out: Path
    argv: list[str]
    record: dict[str, Any] = field(default_factory=dict)

    def image(self, name: str = "composite.png") -> PixelArray:
        """Codes of a PNG in their own depth."""
        return read_image(self.out / name)[0]


def read_image(path: Path) -> tuple[PixelArray, list[str]]:
    """PixelArray in the file's type, and channel names."""
    reader = oiio.ImageInput.open(str(path))
    assert reader is not None, oiio.geterror()
    spec = reader.spec()
    kind = spec.format if path.suffix == ".png" else oiio.FLOAT
    pixels = reader.read_image(0, 0, 0, spec.nchannels, kind)
    names = list(spec.channelnames)
    reader.close()
    return pixels, names


def read_layers(path: Path) -> dict[str, FloatArray]:
    """The planes of ``layers.exr`` by their full names."""
    pixels, names = read_image(path)
    return {name: pixels[..., k] for k, name in enumerate(names)}


def rgb(planes: dict[str, FloatArray], prefix: str = "") -> FloatArray:
    """Three planes of a layer, shape [H, W, 3]."""
    return np.stack([planes[f"{prefix}{c}"] for c in "RGB"], axis=-1)


def untouched(planes: dict[str, FloatArray]) -> BoolArray:
    """Pixels that neither object nor shadow changes, by the layers, shape [H, W]."""
    return (planes["matte.A"] == 0.0) & (rgb(planes, "shadow.") == 1.0).all(axis=-1)


def go(argv: list[str], out: Path) -> Run:
    """Run in-process, expecting success."""
    assert main(argv) == ExitCode.DONE
    return Run(out, argv, record_of(out))


def record_of(out: Path) -> dict[str, Any]:
    """The ``run.json`` of a finished run."""
    record: dict[str, Any] = json.loads((out / "run.json").read_text())
    return record
