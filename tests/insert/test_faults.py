"""Bad inputs at the command line: one of each kind; the readers' own tests hold the variants."""

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from tests.builders.faults import assert_fails
from tests.builders.gltf_files import Builder
from tests.builders.image_files import png_header
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


def truncated_photo(kind: str) -> Make:
    """The first 60 percent of a photo's file."""

    def write(path: Path) -> None:
        rng = np.random.default_rng(0)
        Image.fromarray(rng.integers(0, 255, (64, 64, 3), dtype=np.uint8)).save(path)
        os.truncate(path, path.stat().st_size * 6 // 10)

    return written(f"cut.{kind}", "photo", write)


def cut_light(name: str) -> Make:
    """A panorama cut in the middle."""

    def write(path: Path) -> None:
        write_panorama(path)
        os.truncate(path, path.stat().st_size // 2)

    return written(name, "light", write)


def glb(change: Callable[[Builder], None], cut: int = 0) -> Make:
    """A GLB with a planted fault, ``cut`` bytes short."""

    def write(path: Path) -> None:
        builder = Builder()
        change(builder)
        content = builder.glb()
        path.write_bytes(content[: len(content) - cut])

    return written("bad.glb", "asset", write)


def not_a_number(builder: Builder) -> None:
    corners = np.zeros((4, 3), np.float32)
    corners[1, 1] = np.nan
    builder.attribute("POSITION", corners)


def own_camera(**changes: object) -> Make:
    """A camera file with some members replaced."""
    pose = np.eye(4)
    pose[1, 3] = 1.5
    content = {
        "w": WIDTH, "h": HEIGHT, "fx": 40.0, "fy": 40.0, "cx": 24.0, "cy": 16.0,
        "c2w": pose.tolist(), **changes,
    }  # fmt: skip
    return camera_text(json.dumps(content))


def camera_text(text: str) -> Make:
    return named("camera.json", text, "camera", **NO_POSE)


def flags(**changes: str | None) -> Make:
    """Only flags change."""
    return lambda folder: changes


def emitting_obj(folder: Path) -> dict[str, str | None]:
    (folder / "m.mtl").write_text("newmtl lamp\nKe 1e13 1 1\n")
    (folder / "m.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl lamp\nf 1 2 3\n")
    return {"asset": str(folder / "m.obj")}


def far_texture(builder: Builder) -> None:
    transform = {"KHR_texture_transform": {"scale": [1e300, 1]}}
    builder.pbr["baseColorTexture"] = {"index": builder.texture(), "extensions": transform}


def lobes_with(**changes: object) -> Make:
    """A lobes file with some members replaced."""
    return named("bad.json", json.dumps({**LOBES, **changes}), "light")


def four_channels(folder: Path) -> dict[str, str | None]:
    spec = oiio.ImageSpec(32, 16, 2, oiio.FLOAT)
    spec.channelnames = ("U", "V")
    writer = oiio.ImageOutput.create(str(folder / "uv.exr"))
    assert writer.open(str(folder / "uv.exr"), spec)
    assert writer.write_image(np.ones((16, 32, 2), np.float32)) and writer.close()
    return {"light": str(folder / "uv.exr")}


DRACO = "KHR_draco_mesh_compression"
NO_POSE: dict[str, str | None] = {"fov": None, "pitch": None, "camera_height": None}
SHEARED = np.eye(4)
SHEARED[0, 1] = 0.5
LEFT_HANDED = np.diag([1.0, 1.0, -1.0, 1.0])
FSPY = json.dumps({"cameraParameters": None, "imageState": {}, "version": 1})

BAD = {
    # Photo
    "I1-missing": Bad(3, ("none.png",), flags(photo="none.png")),
    "I1-folder": Bad(3, ("I1-folder",), lambda f: {"photo": str(f)}),
    "I2-empty": Bad(3, ("empty.png", "empty"), named("empty.png", b"", "photo")),
    "I3-truncated-jpeg": Bad(3, ("cut.jpg", "truncated"), truncated_photo("jpg")),
    "I3-truncated-png": Bad(3, ("cut.png", "truncated"), truncated_photo("png")),
    "I3-truncated-webp": Bad(3, ("cut.webp",), truncated_photo("webp")),
    "I3-truncated-tiff": Bad(3, ("cut.tif",), truncated_photo("tif")),
    "I4-huge-header": Bad(3, ("big.png", "max-pixels"),
                          named("big.png", png_header(20000, 20000), "photo")),
    "I5-max-pixels": Bad(3, ("photo.png", "48 x 32", "--max-pixels"), flags(max_pixels="100")),
    "I6-text-as-jpeg": Bad(3, ("note.jpg",), named("note.jpg", "hello\n" * 99, "photo")),
    "I6-eps-as-png": Bad(3, ("x.png",), named("x.png", "%!PS-Adobe-3.0 EPSF-3.0\n", "photo")),
    "I10-transparent": Bad(3, ("glass.png", "transparen"), written(
        "glass.png", "photo", Image.new("RGBA", (WIDTH, HEIGHT), (9, 9, 9, 100)).save)),
    "I13-gif": Bad(3, ("moving.gif",), written(
        "moving.gif", "photo", Image.new("P", (WIDTH, HEIGHT)).save)),
    "I18-fifo": Bad(3, ("pipe.png", "regular file"), written("pipe.png", "photo", os.mkfifo)),
    "I18-symlink-loop": Bad(3, ("loop.png",), written(
        "loop.png", "photo", lambda path: path.symlink_to(path))),
    "I18-device": Bad(3, ("/dev/zero", "regular file"), flags(photo="/dev/zero")),
    # Light
    "E1-truncated-exr": Bad(3, ("cut.exr",), cut_light("cut.exr")),
    "E7-no-rgb": Bad(3, ("uv.exr",), four_channels),
    "E7-not-a-panorama": Bad(3, ("photo.png",), lambda f: {"light": str(f.parent / "photo.png")}),
    "E12-cut-hdr": Bad(3, ("cut.hdr",), cut_light("cut.hdr")),
    "E12-garbage-hdr": Bad(3, ("x.hdr",), named("x.hdr", b"#?RADIANCE\n\xff\xfe\n\n", "light")),
    "E-missing": Bad(3, ("none.hdr",), flags(light="none.hdr")),
    "E-lobes-empty": Bad(3, ("bad.json", "/lobes"), lobes_with(lobes=[])),
    "E-lobes-format": Bad(3, ("bad.json", "not lobes"), lobes_with(format="x")),
    "E-lobes-cut": Bad(3, ("bad.json",), named("bad.json", json.dumps(LOBES)[:-9], "light")),
    "E-lobes-sharpness": Bad(3, ("bad.json", "/lobes/0/sharpness"), lobes_with(
        lobes=[{**LOBES["lobes"][0], "sharpness": 1e-300}])),
    "E-fit-lobes-of-lobes": Bad(2, ("--fit-lobes",), lambda f: {
        "light": str(f.parent / "lobes.json"), "fit_lobes": "4"}),
    # Asset
    "M1-empty-glb": Bad(3, ("e.glb",), named("e.glb", b"", "asset")),
    "M1-cut-glb": Bad(3, ("bad.glb",), glb(lambda b: None, cut=40)),
    "M1-png-inside": Bad(3, ("p.glb",), named("p.glb", png_header(4, 4), "asset")),
    "M2-cut-gltf": Bad(3, ("a.gltf",), named("a.gltf", '{"asset": {"ver', "asset")),
    "M3-missing-bin": Bad(3, ("a.gltf",), named("a.gltf", json.dumps({
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"uri": "none.bin", "byteLength": 36}]}), "asset")),
    "M7-index": Bad(3, ("bad.glb", "999"), glb(
        lambda b: b.primitive.update(indices=b.accessor(np.array([0, 1, 999], np.uint16))))),
    "M8-nan": Bad(3, ("bad.glb",), glb(not_a_number)),
    "M18-emission": Bad(3, ("bad.glb", "emission out of range (found 1e+38"), glb(
        lambda b: b.material.update(emissiveFactor=[1e38, 1, 1]))),
    "M18-emission-of-mtl": Bad(3, ("m.obj", "1e+13"), emitting_obj),
    "M8-texture-transform": Bad(3, ("bad.glb", "1e+300"), glb(far_texture)),
    "M8-texture-coordinates": Bad(3, ("t.obj", "texture coordinates of 1e+30"), named(
        "t.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 1e30 0\nf 1/1 2/1 3/1\n", "asset")),
    "M12-points-only": Bad(3, ("p.obj",), named("p.obj", "v 0 0 0\nv 1 0 0\np 1 2\n", "asset")),
    "M17-draco": Bad(3, ("bad.glb", "draco"), glb(
        lambda b: b.json.update(extensionsRequired=[DRACO], extensionsUsed=[DRACO]))),
    "M20-index-zero": Bad(3, ("z.obj",), named("z.obj", "v 0 0 0\nf 0 1 1\n", "asset")),
    "M20-missing-mtl": Bad(3, ("m.obj", "none.mtl"), named(
        "m.obj", "mtllib none.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "asset")),
    "M21-png-as-obj": Bad(3, ("p.obj",), named("p.obj", png_header(4, 4), "asset")),
    "M21-fbx": Bad(3, ("car.fbx", "not a mesh"), named("car.fbx", b"Kaydara FBX", "asset")),
    "M-missing": Bad(3, ("none.glb",), flags(asset="none.glb")),
    # Place
    "M22-behind": Bad(3, ("--place", "behind"), flags(place="0,0,5")),
    "M22-around": Bad(3, ("--place", "inside"), flags(place="0,0,0", size="9")),
    "M22-out-of-frame": Bad(3, ("--place", "outside the photo"), flags(place="40,0,-5")),
    "M22-above-horizon": Bad(3, ("--at",), flags(place=None, at="24,0", pitch="0")),
    "M22-outside-pixel": Bad(3, ("--at", "outside"), flags(place=None, at="24,99")),
    # Camera and ground
    "C1-fspy-null": Bad(3, ("camera.json",), camera_text(FSPY)),
    "C2-other-aspect": Bad(3, ("camera.json",), own_camera(w=100, h=100)),
    "C3-fov-zero": Bad(2, ("--fov",), flags(fov="0")),
    "C3-fov-nan": Bad(2, ("--fov",), flags(fov="nan")),
    "C4-sheared": Bad(3, ("camera.json", "c2w"), own_camera(c2w=SHEARED.tolist())),
    "C4-left-handed": Bad(3, ("camera.json", "c2w"), own_camera(c2w=LEFT_HANDED.tolist())),
    "C8-ground-through-camera": Bad(3, ("--ground",), flags(ground="0,1,0,-1.5")),
    "C8-ground-normal-zero": Bad(2, ("--ground",), flags(ground="0,0,0,1")),
    "C9-nan": Bad(3, ("camera.json",), camera_text('{"w": 48, "h": 32, "fx": NaN}')),
    "C9-twice": Bad(3, ("camera.json",), camera_text('{"w": 48, "w": 48}')),
    "C9-list": Bad(3, ("camera.json",), camera_text("[1, 2]")),
    "C9-comma": Bad(3, ("camera.json",), camera_text('{"w": 48,}')),
    "C-missing": Bad(3, ("none.json",), flags(camera="none.json", **NO_POSE)),
    # Flags and device
    "F1-samples": Bad(2, ("--samples",), flags(samples="0")),
    "F5-out-is-a-file": Bad(7, ("plain",), named("plain", "text", "out")),
    "F5-out-holds-the-photo": Bad(2, ("--out", "photo.png"), lambda f: {"out": str(f.parent)}),
    "F5-out-is-the-root": Bad(2, ("--out",), flags(out="/")),
    "F8-seed": Bad(2, ("--seed",), flags(seed="-1")),
    "R8-no-such-device": Bad(2, ("--device", "cuda:7"), flags(device="cuda:7")),
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
