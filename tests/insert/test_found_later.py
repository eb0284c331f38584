"""Faults that an adversary's inputs found: the cases N of docs/robustness.md."""

import os
import resource
import shutil
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
import tifffile
from PIL import Image

from tests.builders.faults import assert_fails, run_case
from tests.builders.gltf_files import Builder
from tests.builders.insertions import (
    HEIGHT,
    WIDTH,
    arguments,
    go,
    read_image,
    read_layers,
    rgb,
    write_inputs,
)
from warpir.io.assets import load_asset
from warpir.io.images.decoder import decode_image
from warpir.io.layers import HALF_MAX

ROOT = Path(__file__).resolve().parents[2]
SHAPE = HEIGHT, WIDTH


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Inputs of a run that works."""
    write_inputs(tmp_path)
    return tmp_path


def codes(depth: int) -> np.ndarray:
    """Codes of a photo of one channel, unsigned integers of some bits."""
    kind = np.uint16 if depth == 16 else np.uint8
    return np.random.default_rng(0).integers(0, 2**depth, SHAPE).astype(kind)


@pytest.mark.case("N1")
@pytest.mark.parametrize("depth", [8, 16])
def test_white_is_zero(tmp_path: Path, depth: int) -> None:
    """The picture is the negative of what the file holds, at both depths."""
    stored = codes(depth)
    tifffile.imwrite(tmp_path / "scan.tif", stored, photometric="miniswhite")
    found = decode_image(tmp_path / "scan.tif", 10**6).pixels[..., 0]
    np.testing.assert_array_equal(found, np.iinfo(stored.dtype).max - stored)


def exr(*channels: str, tile: int = 0) -> Callable[[Path], None]:
    """An EXR of the photo's size with some channels; one whose header tells of larger tiles."""

    def write(path: Path) -> None:
        spec = oiio.ImageSpec(WIDTH, HEIGHT, len(channels), "float")
        spec.channelnames = channels
        picture = oiio.ImageBuf(spec)
        picture.set_write_tiles(16 if tile else 0, 16 if tile else 0)
        picture.set_pixels(oiio.ROI(), np.full((*SHAPE, len(channels)), 0.3, np.float32))
        assert picture.write(str(path)), picture.geterror()
        if tile:
            content = path.read_bytes()
            place = content.index(b"tiledesc\0") + 13
            sizes = struct.pack("<II", tile, tile)
            path.write_bytes(content[:place] + sizes + content[place + 8 :])

    return write


def tiff(photometric: int, channels: int = 1) -> Callable[[Path], None]:
    """A TIFF of 8 bits that says to be something else."""

    def write(path: Path) -> None:
        shape = SHAPE if channels == 1 else (*SHAPE, channels)
        values = np.full(shape, 90, np.uint8)
        kind = "rgb" if channels == 3 else "minisblack"
        tifffile.imwrite(path, values, photometric=kind)
        change_tag(path, 262, photometric)

    return write


def change_tag(path: Path, tag: int, value: int) -> None:
    """Write another value into a tag of a little-endian TIFF."""
    content = bytearray(path.read_bytes())
    (start,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, start)
    places = [start + 2 + 12 * k for k in range(count)]
    (place,) = (p for p in places if struct.unpack_from("<H", content, p)[0] == tag)
    struct.pack_into("<HII", content, place + 2, 4, 1, value)
    path.write_bytes(content)


def large_tile(path: Path) -> None:
    values = np.full((16, 16, 3), 90, np.uint8)
    tifffile.imwrite(path, values, photometric="rgb", tile=(16, 16))
    for tag in (322, 323):
        change_tag(path, tag, 36_000)


def palette_of_bytes(path: Path) -> None:
    colors = np.random.default_rng(0).integers(1, 256, (3, 256)).astype(np.uint16)
    tifffile.imwrite(path, codes(8), photometric="palette", colormap=colors)


def many_scans(path: Path) -> None:
    Image.new("RGB", (WIDTH, HEIGHT), (90, 80, 70)).save(path, progressive=True)
    content = path.read_bytes()
    start = content.rindex(b"\xff\xda")
    (length,) = struct.unpack_from(">H", content, start + 2)
    scan = content[start : start + 2 + length] + b"\x7f"
    path.write_bytes(content[:start] + 500 * scan + content[start:])


def large_face(path: Path) -> None:
    corners = " ".join(str(1 + k % 3) for k in range(10**6))
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf {corners}\n")


def newer_gltf(path: Path) -> None:
    builder = Builder()
    builder.json["asset"]["minVersion"] = "2.9"
    path.write_bytes(builder.glb())


FOUND: dict[str, tuple[Any, ...]] = {
    "N2-xyz": ("a.exr", exr("X", "Y", "Z"), "neither RGB nor luminance alone (found X, Y, Z"),
    "N2-depth": ("a.exr", exr("Y", "Z"), "found Y, Z"),
    "N3-tiff": ("tile.tif", large_tile, "tiles of 36000 x 36000", "--max-pixels"),
    "N3-exr": (
        *("a.exr", exr("R", "G", "B", tile=18_000)),
        *("tiles of 18000 x 18000", "--max-pixels"),
    ),
    "N4": ("scans.jpg", many_scans, "too many scans (found 5"),
    "N5-face": ("face.obj", large_face, "line 4: face with more corners", "1000000"),
    "N6": (
        *("photo.png", lambda path: os.truncate(path, 20 << 30)),
        *("too large (found 21474836480 bytes", "--max-file-bytes"),
    ),
    "N7-filter": ("a.tif", tiff(32803), "a colour filter array"),
    "N7-raw": ("a.tif", tiff(34892, 3), "linear raw values"),
    "N7-mask": ("a.tif", tiff(4), "a transparency mask"),
    "N7-palette": ("palette.tif", palette_of_bytes, "entries have 8 bits"),
    "N11": ("new.glb", newer_gltf, "needs a reader of glTF '2.9'"),
}
"""File, what writes it, and the words of the refusal."""


@pytest.mark.parametrize("case", FOUND)
def test_found_inputs_are_refused(case: str, folder: Path) -> None:
    """Within seconds, in one line that names what was found."""
    name, write, *words = FOUND[case]
    write(folder / name)
    flag = "asset" if name.endswith(("obj", "glb")) else "photo"
    argv = arguments(folder, "out", **{flag: str(folder / name)})
    assert_fails(argv, 3, *words, cwd=folder)


@pytest.mark.case("N16")
def test_hint_about_the_unit_is_by_the_size(folder: Path) -> None:
    corners = 1e3 * np.array([[0, 0, 0], [8, 0, 0], [0, 8, 0], [0, 0, 8]], np.float32)
    content = bytes(80) + struct.pack("<I", 4)
    for face in ((0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)):
        content += bytes(12) + (corners[list(face)] - 2e3).astype(np.float32).tobytes() + bytes(2)
    (folder / "chair.stl").write_bytes(content)
    argv = arguments(folder, "out", asset=str(folder / "chair.stl"))
    lines = assert_fails(argv, 3, "the camera is inside", cwd=folder)
    assert ".001 for millimetres" in lines[1]


@pytest.mark.case("N5")
def test_continued_lines_take_linear_time(tmp_path: Path) -> None:
    """2 MB of them hold one face; the comment ends where its line does."""
    path = tmp_path / "long.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 \\\n" + 400_000 * "  \\\n" + "2 \\\n3 # a\n")
    (primitive,) = load_asset(str(path)).primitives
    assert primitive.indices.tolist() == [[0, 1, 2]]


@pytest.mark.case("N10")
def test_working_folder_that_is_gone(folder: Path) -> None:
    before = "import os\nos.mkdir('gone'); os.chdir('gone'); os.rmdir('../gone')"
    argv = arguments(folder, "out")
    assert_fails(argv, 5, "working folder: was removed", cwd=folder, before=before)


@pytest.mark.case("N10")
def test_small_stack(folder: Path) -> None:
    """LLVM would overflow it while it compiles a kernel."""
    limit = (256 << 10, resource.getrlimit(resource.RLIMIT_STACK)[1])
    before = f"import resource\nresource.setrlimit(resource.RLIMIT_STACK, {limit})"
    assert_fails(arguments(folder, "out"), 5, "stack: too small", cwd=folder, before=before)


@pytest.mark.case("N10")
def test_python_without_docstrings(folder: Path) -> None:
    """PYTHONOPTIMIZE=2, which leaves out what an assertion and a docstring say."""
    argv = [*arguments(folder, "out"), "--validate"]
    command = [sys.executable, "-OO", "-m", "warpir.insert", *argv]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.endswith("inputs are valid\n"), done.stderr


@pytest.mark.slow
@pytest.mark.case("N13", "N14")
def test_narrow_photo_whose_light_is_estimated(folder: Path) -> None:
    """It works, or names the photo; nothing of torch's compiler stays behind."""
    Image.new("RGB", (1, HEIGHT), (90, 120, 150)).save(folder / "narrow.png")
    changes = {"photo": str(folder / "narrow.png"), "light": None, "samples": "1", "device": "cpu"}
    ended = run_case(arguments(folder, "out", **changes), folder, warm=True)
    assert ended.status == 0 or "narrow.png" in ended.err, ended.err
    assert ended.status in (0, 3) and "--width" not in ended.err
    assert not [name for name in ended.left if "torchinductor" in name]


@pytest.mark.case("N15")
@pytest.mark.parametrize("name", ["warpir", "warpir.place", "warpir.insert"])
def test_checkout_is_taken_for_the_package(tmp_path: Path, name: str) -> None:
    """Without kernels and diffusion, which an install maps into it: one line, no traceback."""
    shutil.copytree(ROOT / "warpir", tmp_path / "warpir", ignore=shutil.ignore_patterns("*.png"))
    command = [sys.executable, "-S", "-m", name, "--help"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and "is the checkout" in line and "pip install -e ." in line


@pytest.mark.case("N17")
def test_emitter_brighter_than_half_precision(folder: Path) -> None:
    """The ground's ratio is the largest half there, `run.json` counts it, the picture is whole."""
    file = Builder()
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 1e6}}
    file.material.update(emissiveFactor=[1, 1, 1], extensions=strength)
    file.json["extensionsUsed"] = list(strength)
    (folder / "lamp.glb").write_bytes(file.glb())
    changes = {"asset": str(folder / "lamp.glb"), "samples": "1", "device": "cpu"}
    run = go(arguments(folder, folder / "out", no_report="", **changes), folder / "out")
    assert run.record["measured"]["values_clamped_to_half"] > 30
    planes = read_layers(run.out / "layers.exr")
    assert np.isfinite(rgb(planes)).all() and rgb(planes, "shadow.").max() == HALF_MAX
    assert read_image(run.out / "composite.png")[0].max() == 255


@pytest.mark.case("N18")
def test_lora_that_is_the_root_folder(folder: Path) -> None:
    assert_fails(arguments(folder, "out", lora="/"), 4, "/: is a folder", cwd=folder)
