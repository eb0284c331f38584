"""Bad inputs at the command line: one of each kind; the readers' own tests hold the variants."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.builders.faults import assert_fails
from tests.builders.gltf_files import Builder
from tests.builders.image_files import write_image
from tests.builders.insertions import HEIGHT, LOBES, WIDTH, arguments, write_panorama

Make = Callable[[Path], dict[str, str | None]]


@dataclass
class Bad:
    """A broken input: files it makes in ``folder``, flags it changes, how the run must end."""

    code: int
    words: tuple[str, ...]
    make: Make


def written(name: str, flag: str, write: Callable[[Path], object], **more: str | None) -> Make:
    """Make one file and give it to a flag."""

    def make(folder: Path) -> dict[str, str | None]:
        write(folder / name)
        return {flag: str(folder / name), **more}

    return make


def named(name: str, content: bytes | str, flag: str, **more: str | None) -> Make:
    """Write one file's content and give it to a flag."""
    data = content.encode() if isinstance(content, str) else content
    return written(name, flag, lambda path: path.write_bytes(data), **more)


def cut_photo(path: Path) -> None:
    rng = np.random.default_rng(0)
    Image.fromarray(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
    os.truncate(path, path.stat().st_size * 6 // 10)


def cut_light(path: Path) -> None:
    write_panorama(path)
    os.truncate(path, path.stat().st_size // 2)


def bad_light(path: Path) -> None:
    texels = np.ones((4, 8, 3), np.float32)
    texels[1, 1] = np.nan
    write_image(path, texels)


def glb(change: Callable[[Builder], None], cut: int = 0) -> Make:
    """A GLB with a planted fault, ``cut`` bytes short."""

    def write(path: Path) -> None:
        builder = Builder()
        change(builder)
        content = builder.glb()
        path.write_bytes(content[: len(content) - cut])

    return written("bad.glb", "asset", write)


def flags(**changes: str | None) -> Make:
    """Only flags change."""
    return lambda folder: changes


def far_texture(builder: Builder) -> None:
    transform = {"KHR_texture_transform": {"scale": [1e300, 1]}}
    builder.pbr["baseColorTexture"] = {"index": builder.texture(), "extensions": transform}


NO_POSE: dict[str, str | None] = {"fov": None, "pitch": None, "camera_height": None}
BAD = {
    # Photo
    "I1-missing": Bad(3, ("none.png",), flags(photo="none.png")),
    "I2-empty": Bad(3, ("empty.png", "empty"), named("empty.png", b"", "photo")),
    "I3-truncated-jpeg": Bad(3, ("cut.jpg", "truncated"), written("cut.jpg", "photo", cut_photo)),
    "I6-text-as-jpeg": Bad(3, ("note.jpg",), named("note.jpg", "hello\n" * 99, "photo")),
    "I10-transparent": Bad(3, ("glass.png", "transparen"), written(
        "glass.png", "photo", Image.new("RGBA", (WIDTH, HEIGHT), (9, 9, 9, 100)).save)),
    "I13-gif": Bad(3, ("moving.gif",), written(
        "moving.gif", "photo", Image.new("P", (WIDTH, HEIGHT)).save)),
    "I20-size": Bad(3, ("mask.png: not of the photo's size (found 24 x 16",), written(
        "mask.png", "occluder_mask", Image.new("L", (24, 16)).save)),
    # Light
    "E1-truncated-exr": Bad(3, ("cut.exr",), written("cut.exr", "light", cut_light)),
    "E5-strict": Bad(3, ("m.exr: not clean radiance",), written(
        "m.exr", "light", bad_light, strict="")),
    "E7-not-a-panorama": Bad(3, ("photo.png", "expected 2:1"), lambda f: {
        "light": str(f.parent / "photo.png")}),
    "E-missing": Bad(3, ("none.hdr",), flags(light="none.hdr")),
    "E-lobes-cut": Bad(3, ("bad.json",), named("bad.json", json.dumps(LOBES)[:-9], "light")),
    "E-fit-lobes-of-lobes": Bad(2, ("--fit-lobes",), lambda f: {
        "light": str(f.parent / "lobes.json"), "fit_lobes": "4"}),
    "E-convention": Bad(2, ("--light-convention",), flags(light_convention="maya")),
    "E-convention-of-lobes": Bad(2, ("--light-convention: is for panoramas",), lambda f: {
        "light": str(f.parent / "lobes.json"), "light_convention": "blender"}),
    # Asset
    "M1-cut-glb": Bad(3, ("bad.glb",), glb(lambda b: None, cut=40)),
    "M7-index": Bad(3, ("bad.glb", "999"), glb(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 1, 999], np.uint16))))),
    "M8-nan": Bad(3, ("bad.glb",), glb(
        lambda b: b.attribute("POSITION", np.diag([np.nan, 1, 1, 1])[:, :3].astype("f")))),
    "M8-texture-transform": Bad(3, ("bad.glb", "1e+300"), glb(far_texture)),
    "M8-texture-coordinates": Bad(3, ("t.obj", "texture coordinates of 1e+30"), named(
        "t.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 1e30 0\nf 1/1 2/1 3/1\n", "asset")),
    "M17-draco": Bad(3, ("bad.glb", "draco"), glb(
        lambda b: b.json.update(extensionsRequired=["KHR_draco_mesh_compression"]))),
    "M20-index-zero": Bad(3, ("z.obj",), named("z.obj", "v 0 0 0\nf 0 1 1\n", "asset")),
    "M-missing": Bad(3, ("none.glb",), flags(asset="none.glb")),
    # Place
    "M22-behind": Bad(3, ("--place", "behind"), flags(place="0,0,5")),
    # Camera and ground
    "C3-fov-zero": Bad(2, ("--fov",), flags(fov="0")),
    "C9-comma": Bad(3, ("camera.json",), named("camera.json", '{"w": 48,}', "camera", **NO_POSE)),
    "C-missing": Bad(3, ("none.json",), flags(camera="none.json", **NO_POSE)),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_faults(case: str, inputs: Path) -> None:
    """Status, one ``error:`` line with file and reason, nothing new, old results byte-identical."""
    bad = BAD[case]
    folder = inputs / case
    results = folder / "out"
    results.mkdir(parents=True)
    (results / "composite.png").write_bytes(b"an earlier picture")
    (results / "run.json").write_text('{"format": 1, "files": {"composite.png": ""}}')
    argv = arguments(inputs, results, **bad.make(folder))
    lines = assert_fails([*argv, "--overwrite"], bad.code, cwd=inputs)
    for word in bad.words:
        assert word in "".join(lines[:2])
    assert len(lines) <= 2
