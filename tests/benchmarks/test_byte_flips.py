"""Damaged files of every format, and files that promise more than they hold.

The survey itself is `benchmarks.damage`: whatever hypothesis does to a file, it is read, or
ends in one error line with the exit code of its class, within 10 s and 500 MB.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from hypothesis import given

from benchmarks.damage.__main__ import BYTES, SECONDS, Reader, survey, tried, write
from benchmarks.damage.formats import formats, weights
from benchmarks.damage.mutations import exr_attributes
from tests.builders.faults import Ended, run_case
from tests.builders.gltf_files import Builder
from tests.builders.image_files import matrix_profile, png_chunk, png_of, write_image
from tests.builders.insertions import arguments
from tests.builders.poses import write_json
from warpir.core.errors import ExitCode

FORMATS = {form.name: form for form in formats()}
QUICK, LONG = 20, 120
"""Damaged files of each format."""


@pytest.fixture(scope="module")
def reader() -> Iterator[Reader]:
    """One process for all formats, and its successors."""
    with Reader() as reader:
        yield reader


@pytest.mark.parametrize("name", FORMATS)
def test_damaged_files_are_read_or_refused(reader: Reader, name: str) -> None:
    row = survey(FORMATS[name], QUICK, reader)
    assert row.tried > QUICK // 2 and not row.faults


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_many_damaged_files_are_read_or_refused(reader: Reader, name: str) -> None:
    row = survey(FORMATS[name], LONG, reader)
    assert row.tried > LONG // 2 and not row.faults
    # Damage that always ends at the first check would say little of what is behind it.
    assert len(row.codes) > 1 or "profile" in name or "tags" in name


@pytest.mark.slow
def test_damaged_weights_are_read_or_refused(reader: Reader) -> None:
    """Regressor, checkpoint and LoRA: they are read with torch."""
    rows = [survey(form, LONG, reader) for form in weights()]
    assert len(rows) == 5
    assert not {row.name: row.faults for row in rows if row.faults}


FLAGS = {
    "photo JPEG": "photo",
    "photo EXR ZIP": "photo",
    "light HDR": "light",
    "mask PNG": "occluder_mask",
    "mesh GLB": "asset",
    "mesh PLY binary": "proxy",
    "camera COLMAP images.bin": "camera",
    "camera nerfstudio": "camera",
    "points PLY ascii": "ground_points",
    "lobes.json": "light",
    "config YAML": "config",
    "run.json to reuse": "reuse",
}
"""One format for each flag; the others differ from these in the reader alone."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FLAGS)
def test_damaged_files_at_the_command_line(inputs: Path, tmp_path: Path, name: str) -> None:
    """Through the whole command with --validate, each in a process of its own."""
    form, flag = FORMATS[name], FLAGS[name]

    @tried(6)
    @given(form.damage)
    def meet(content: bytes) -> None:
        write(form, content, tmp_path / "bad")
        path = tmp_path / "bad" / (form.target or form.file)
        path = path.parent if flag == "reuse" else path
        argv = given_file(inputs, tmp_path / "out", flag, path)
        check(run_case([*argv, "--validate"], tmp_path), DONE, *form.codes)
        assert not (tmp_path / "out").exists()

    meet()


def given_file(inputs: Path, out: Path, flag: str, path: Path) -> list[str]:
    """The arguments of a cheap run that reads a file by a flag, without what excludes that."""
    changes: dict[str, str | None] = {flag: str(path)}
    camera = dict.fromkeys(("fov", "pitch", "camera_height"))
    if flag == "camera":
        changes |= camera
    elif flag == "ground_points":
        write_json(out.parent / "camera.json", CAMERA)
        changes |= {**camera, "camera": str(out.parent / "camera.json")}
    elif flag in ("reuse", "config"):
        changes["light"] = None
    return arguments(inputs, out, **changes)


CAMERA: dict[str, Any] = {"fx": 40, "fy": 40, "cx": 24, "cy": 16, "w": 48, "h": 32}
CAMERA |= {"c2w": [[1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 1, 0], [0, 0, 0, 1]]}


def check(ended: Ended, *codes: int) -> None:
    """What every end has in common: its code, its lines, its cost."""
    assert ended.status in codes, ended
    errors = [line for line in ended.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == (ended.status != 0), ended.err
    assert "Traceback" not in ended.err and (ended.err == "") == (ended.status == 0)
    assert ended.seconds < SECONDS and ended.peak_bytes < BYTES
    assert not ended.left and not ended.children


# ------------------------------------------------------- files that promise more than they hold

GIGA, LARGEST = 2**30, (2**31 - 1, 2**31 - 1)


def deflated(size: int) -> bytes:
    """So many zero bytes, a thousandth as large."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    block = packer.compress(bytes(2**20)) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = (size % 65521) << 16 | 1  # Adler-32 of zeros
    return b"\x78\xda" + block * (size // 2**20) + b"\x03\0" + struct.pack(">I", checksum)


ROWS = zlib.compress((b"\0" + bytes(3 * 48)) * 32)
PIXELS = png_chunk(b"IDAT", ROWS) + png_chunk(b"IEND", b"")


def exr(folder: Path, **header: Any) -> Path:
    """A plate of noise whose header says otherwise."""
    plane = np.random.default_rng(1).random((32, 48), dtype=np.float32)
    path = folder / "bad.exr"
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, dict.fromkeys("RGB", plane)).write(
        str(path)
    )
    return path


def exr_bomb(folder: Path) -> Path:
    """The first chunk of an EXR replaced by a deflated gigabyte."""
    path = exr(folder, compression=OpenEXR.ZIP_COMPRESSION)
    content = path.read_bytes()
    at, size = exr_attributes(content)[-1]
    table = at + size + 1  # where the chunks stand
    packed = deflated(GIGA)
    chunk = struct.pack("<2i", 0, len(packed)) + packed
    path.write_bytes(
        content[:table] + struct.pack("<Q", len(content)) + content[table + 8 :] + chunk
    )
    return path


def named(name: str, content: bytes | str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def tiff_bomb(folder: Path) -> Path:
    """A strip that inflates to a gigabyte where 4608 bytes belong."""
    packed = deflated(GIGA)
    entries = [(256, 4, 48), (257, 4, 32), (258, 3, 8), (259, 3, 8), (262, 3, 1), (273, 4, 200),
               (277, 3, 1), (278, 4, 32), (279, 4, len(packed))]  # fmt: skip
    table = struct.pack("<H", len(entries))
    table += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in entries)
    head = b"II*\0" + struct.pack("<I", 8) + table + bytes(4)
    return named("bad.tif", head.ljust(200, b"\0") + packed)(folder)


def profile_bomb(folder: Path) -> Path:
    """A profile whose description says that it is a gigabyte long."""
    icc = matrix_profile("p3")
    broken = icc.replace(b"desc\0\0\0\0\0\0\0\x05", b"desc\0\0\0\0" + struct.pack(">I", GIGA))
    assert broken != icc
    codes = np.zeros((32, 48, 3), np.uint8)
    codes[0] = 200
    return write_image(folder / "bad.tif", codes, ICCProfile=broken)


def texture_bomb(folder: Path) -> Path:
    """A texture in a GLB whose profile inflates to a gigabyte."""
    builder = Builder()
    chunk = png_chunk(b"iCCP", b"x\0\0" + deflated(GIGA // 4))
    builder.base_color({"bufferView": builder.view(png_of(chunk, PIXELS)), "mimeType": "image/png"})
    return named("bad.glb", builder.glb())(folder)


def glb_with(change: Callable[[bytes], bytes]) -> Callable[[Path], Path]:
    return named("bad.glb", change(Builder().glb()))


def counted(folder: Path, count: int, **fields: Any) -> Path:
    """A GLB whose accessors hold more than its buffer."""
    builder = Builder()
    builder.json["accessors"][0] |= {"count": count, **fields}
    return named("bad.glb", builder.glb())(folder)


def png_with(*chunks: bytes) -> Callable[[Path], Path]:
    return named("bad.png", png_of(*chunks))


def inflating(name: bytes) -> Callable[[Path], Path]:
    """A picture with a gigabyte of a profile or a text."""
    return lambda f: png_with(png_chunk(name, b"x\0\0" + deflated(GIGA)), PIXELS)(f)


PLY = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
PLY += "property float z\nelement face 1\nproperty list {} int vertex_indices\nend_header\n"
ALIASES = "a0: &a0 [x, x]\n" + "".join(
    f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40)
)
MERGES = "a0: &a0 {x: 1}\n" + "".join(
    f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}, *a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 40)
)
COLMAP_IMAGES = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 7) + b"photo.png\0"
COLMAP_CAMERAS = struct.pack("<QIiQQ4d", 1, 7, 1, 48, 32, 40, 40, 24, 16)


def colmap(cameras: bytes, images: bytes) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        (folder / "model").mkdir()
        (folder / "model" / "cameras.bin").write_bytes(cameras)
        (folder / "model" / "images.bin").write_bytes(images)
        return folder / "model"

    return make


DONE, USAGE, INPUT = ExitCode.DONE, ExitCode.USAGE, ExitCode.INPUT
PROMISES: dict[str, tuple[str, int, Callable[[Path], Path]]] = {
    "I3-png-too-many-pixels": (
        "photo", DONE,
        lambda f: png_with(png_chunk(b"IDAT", deflated(GIGA // 4)), PIXELS[-12:])(f)),
    "I3-tiff-strip-of-a-gigabyte": ("photo", INPUT, tiff_bomb),
    "I4-png-2^31": ("photo", INPUT, named("bad.png", png_of(PIXELS, size=LARGEST))),
    "I4-webp-16383": (
        "photo", INPUT,
        named("bad.webp", b"RIFF\x1e\0\0\0WEBPVP8L\x11\0\0\0/\xff\xff\xff\x0f" + bytes(13))),
    "I4-jpeg-65500": (
        "photo", INPUT,
        named("bad.jpg", b"\xff\xd8\xff\xc0\0\x11\x08\xff\xdc\xff\xdc\x03\x01\x22\0\x02\x11\x01"
              b"\x03\x11\x01" + bytes(200))),
    "I8-icc-inflates": ("photo", DONE, inflating(b"iCCP")),
    "I8-icc-text-of-a-gigabyte": ("photo", DONE, profile_bomb),
    "I19-png-text-inflates": ("photo", DONE, inflating(b"zTXt")),
    "E3-exr-chunk-of-a-gigabyte": ("photo", INPUT, exr_bomb),
    "E4-exr-data-window": (
        "photo", INPUT,
        lambda f: exr(f, displayWindow=(np.zeros(2, np.int32), np.full(2, 10**6, np.int32)))),
    "E12-hdr-wide": (
        "light", INPUT,
        named("bad.hdr", "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2147483647 +X 2147483647\n")),
    "M1-glb-chunk-2^32": (
        "asset", INPUT, glb_with(lambda c: c[:12] + b"\xff\xff\xff\xff" + c[16:])),
    "M1-glb-total-2^32": ("asset", INPUT, glb_with(lambda c: c[:8] + b"\xff\xff\xff\xff" + c[12:])),
    "M2-nesting": ("asset", INPUT, named("bad.gltf", "[" * 100_000)),
    "M2-nesting-in-json": ("asset", INPUT, named("bad.gltf", '{"a":' * 100_000)),
    "M6-count-2^31": ("asset", INPUT, lambda f: counted(f, 2**31)),
    "M6-count-2^63": ("asset", INPUT, lambda f: counted(f, 2**63)),
    "M6-sparse-zeros": (
        "asset", INPUT,
        lambda f: counted(f, 2**40, sparse={"count": 1}, bufferView=99)),
    "M14-texture-profile-inflates": ("asset", INPUT, texture_bomb),
    "M20-obj-exponent": (
        "asset", INPUT, named("bad.obj", "v 1e999999999 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")),
    "M20-obj-digits": (
        "asset", INPUT, named("bad.obj", f"v {'9' * 400} 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\n")),
    "M20-obj-index-digits": (
        "asset", INPUT, named("bad.obj", f"v 0 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 {'9' * 9000}\n")),
    "M13-ply-list-2^31": (
        "asset", INPUT,
        named("bad.ply", PLY.format("uint").encode() + bytes(12) + struct.pack("<I", 2**31))),
    "M13-ply-list-negative": (
        "asset", INPUT,
        named("bad.ply", PLY.format("int").encode() + bytes(12) + struct.pack("<i", -1))),
    "M13-ply-count-2^63": (
        "asset", INPUT, named("bad.ply", PLY.format("int").replace("face 1", f"face {2**63}"))),
    "M13-stl-count-2^32": ("asset", INPUT, named("bad.stl", bytes(80) + b"\xff" * 4 + bytes(50))),
    "C6-cameras-2^63": (
        "camera", INPUT, colmap(struct.pack("<Q", 2**63) + COLMAP_CAMERAS[8:], COLMAP_IMAGES)),
    "C6-images-2^63": (
        "camera", INPUT, colmap(COLMAP_CAMERAS, struct.pack("<Q", 2**63) + COLMAP_IMAGES[8:])),
    "C6-points-2^63": (
        "camera", INPUT, colmap(COLMAP_CAMERAS, COLMAP_IMAGES + struct.pack("<Q", 2**63))),
    "C1-fspy-state-2^32": (
        "camera", INPUT, named("bad.fspy", b"fspy" + struct.pack("<3I", 1, 2**32 - 1, 1) + b"{}")),
    "C9-digits": ("camera", INPUT, named("bad.json", '{"fx": ' + "9" * 100_000 + "}")),
    "F1-yaml-aliases": ("config", USAGE, named("bad.yaml", ALIASES)),
    "F1-yaml-aliases-of-a-key": ("config", USAGE, named("bad.yaml", f"{ALIASES}place: *a39\n")),
    "F1-yaml-merges": ("config", USAGE, named("bad.yaml", MERGES)),
    "F1-yaml-nesting": ("config", USAGE, named("bad.yaml", "a: " + "[" * 100_000)),
    "F1-yaml-digits": ("config", USAGE, named("bad.yaml", "fov: " + "9" * 1_000_000)),
    "F1-yaml-sexagesimal": ("config", USAGE, named("bad.yaml", "horizon: 1" + ":59" * 50_000)),
    "F4-NUL-in-a-name": ("config", USAGE, named("bad.json", '{"light": "a\\u0000b"}')),
    "F4-lone-surrogate": ("config", INPUT, named("bad.json", '{"light": "\\ud800"}')),
    "I17-light-of-a-long-name": ("light", INPUT, lambda f: f / ("x" * 300)),
    "I17-camera-of-a-long-name": ("camera", INPUT, lambda f: f / ("x" * 300)),
    "I17-photo-of-a-long-name": ("photo", INPUT, lambda f: f / ("x" * 300)),
    "I17-reuse-of-a-long-name": ("reuse", INPUT, lambda f: f / ("x" * 300)),
    "I17-points-of-a-long-name": ("ground_points", INPUT, lambda f: f / ("x" * 300)),
}  # fmt: skip
"""The flag, the exit code, and the file that promises too much."""


@pytest.mark.parametrize("case", PROMISES)
def test_promises_cost_nothing(inputs: Path, tmp_path: Path, case: str) -> None:
    """What a few kilobytes announce is neither allocated nor unpacked."""
    flag, code, make = PROMISES[case]
    argv = given_file(inputs, tmp_path / "out", flag, make(tmp_path))
    check(run_case([*argv, "--validate"], tmp_path), code)


@pytest.mark.parametrize("flag", ["camera", "light", "config", "ground_points", "occluder_mask"])
@pytest.mark.case("I18")
def test_i18_pipes_are_not_waited_for(inputs: Path, tmp_path: Path, flag: str) -> None:
    os.mkfifo(tmp_path / "pipe.json")
    argv = given_file(inputs, tmp_path / "out", flag, tmp_path / "pipe.json")
    code = USAGE if flag == "config" else INPUT
    check(run_case([*argv, "--validate"], tmp_path), code)
