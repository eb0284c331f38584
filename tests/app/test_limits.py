"""The order of the checks, the output folder, limits: what ends a run before torch is loaded."""

import json
import os
import struct
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.faults import Ended, assert_fails, run_case, snapshot
from tests.builders.gltf_files import Builder
from tests.builders.image_files import png_header
from tests.builders.insertions import arguments, read_layers, record_of
from tests.insert.test_faults import NO_POSE, Make, named, written
from warpir.app.config import OPTIONS, InsertConfig
from warpir.app.config_file import YAML_SHARE
from warpir.app.inputs import read_inputs
from warpir.app.run import needed_bytes
from warpir.core.errors import ExitCode
from warpir.core.limits import LIMITS, Limits
from warpir.io.curves_file import curves_to_json
from warpir.io.results import OutputFolder
from warpir.scene.tone_curves import Curves

HEAVY = ("torch", "warp", "diffusers", "transformers", "peft", "colour")
TELL = (
    "import atexit, sys\n"
    f"atexit.register(lambda: print('loaded', [m for m in {HEAVY!r} if m in sys.modules]))"
)
"""Says at the end of a child what it had loaded."""
UNPRIVILEGED = (
    "import ctypes, struct\nctypes.CDLL(None).capset(struct.pack('Ii', 0x20080522, 0), bytes(24))"
)
"""Gives up what lets root write into folders that are read-only."""
FULL = (
    "import collections, shutil\n"
    "usage = collections.namedtuple('usage', 'total used free')\n"
    "shutil.disk_usage = lambda path: usage(2**40, 2**40 - 2**20, 2**20)"
)
"""Leaves a MiB of the disk."""


def sparse(path: Path, size: int) -> Path:
    """A file of a size that takes no room."""
    with path.open("wb") as stream:
        stream.truncate(size)
    return path


def validated(argv: list[str], cwd: Path, **same: Any) -> Ended:
    """Check that --validate accepts, in time and memory, and leaves everything as it was."""
    before = snapshot(cwd)
    ended = run_case([*argv, "--validate"], cwd, **same)
    assert (ended.status, ended.err) == (0, ""), ended
    assert "inputs are valid" in ended.out
    assert snapshot(cwd) == before and not ended.left and not ended.children
    assert ended.seconds < 10.0
    return ended


# ------------------------------------------------------------------------------------- order


@pytest.mark.parametrize("case", ["light-given", "regressor", "panorama-to-fit"])
def test_validate_asks_for_models_without_torch(case: str, inputs: Path, tmp_path: Path) -> None:
    demo = ["--demo", "--out", "out"]
    argv = {
        "light-given": [*demo, "--guidance", "none"],
        "regressor": demo,
        "panorama-to-fit": arguments(inputs, "out", fit_lobes="4"),
    }[case]
    assert validated(argv, tmp_path, before=TELL).out.splitlines()[-1] == "loaded []"


def weights(change: Callable[[bytearray], None], name: str) -> Callable[[Path], list[str]]:
    """A changed copy of weights that we ship, and the flags that name it."""

    def make(folder: Path) -> list[str]:
        from warpir.diffusion.models.weight_files import SHIPPED

        content = bytearray((SHIPPED / f"{name}.safetensors").read_bytes())
        change(content)
        (folder / "own.safetensors").write_bytes(content)
        return [f"--{name}", "own.safetensors"]

    return make


def cut(content: bytearray) -> None:
    del content[len(content) // 2 :]


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (weights(cut, "regressor"), "cut or damaged"),
        (lambda folder: ["--regressor", "none.safetensors"], "no such file"),
        (lambda folder: ["--model", "nowhere", "--prompt", "car"], "no such folder"),
    ],
    ids=["L2-cut-regressor", "missing-regressor", "L1-missing-model"],
)
@pytest.mark.parametrize("mode", [[], ["--validate"]], ids=["run", "validate"])
def test_models_are_looked_at_before_torch_is_loaded(
    make: Callable[[Path], list[str]], words: str, mode: list[str], tmp_path: Path
) -> None:
    """A run, too, checks them by their files: within a second, and --out is not made."""
    argv = ["--demo", "--out", "out", *make(tmp_path), *mode]
    assert_fails(argv, ExitCode.MODEL, words, cwd=tmp_path)
    assert run_case(argv, tmp_path, before=TELL).out.endswith("loaded []\n")


@pytest.mark.parametrize("mode", [[], ["--validate"]], ids=["run", "validate"])
def test_checks_come_in_order(inputs: Path, tmp_path: Path, mode: list[str]) -> None:
    """Arguments, inputs, models' files, output, disk: what comes first decides the status."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "run.json").write_text("{}")
    weights(cut, "regressor")(tmp_path)
    broken = {"photo": "none.png", "light": None, "regressor": "own.safetensors"}

    def ends(code: int, word: str, *more: str, **repaired: str | None) -> None:
        argv = [*arguments(inputs, out, **{**broken, **repaired}), *more, *mode]
        assert_fails(argv, code, word, cwd=tmp_path, before=FULL)

    ends(ExitCode.USAGE, "--samples", samples="0")
    ends(ExitCode.INPUT, "none.png")
    good: dict[str, str | None] = {"photo": str(inputs / "photo.png")}
    ends(ExitCode.MODEL, "own.safetensors", **good)
    good["regressor"] = None
    ends(ExitCode.OUTPUT, "already holds files", **good)
    ends(ExitCode.RESOURCES, "disk space", "--overwrite", **good)


# ------------------------------------------------------------------------------ output folder


@dataclass
class Out:
    """An --out that cannot be used: what it needs, its name, how the run ends."""

    out: str
    code: int
    words: tuple[str, ...]
    make: Callable[[Path], object] = lambda folder: None
    before: str = ""


def sealed(folder: Path) -> None:
    (folder / "sealed").mkdir(mode=0o555)


def results(folder: Path) -> None:
    (folder / "done").mkdir()
    (folder / "done" / "run.json").write_text("{}")


OUTS = {
    "F5-file": Out("plain", 7, ("plain", "a file in its place"),
                   lambda f: (f / "plain").write_text("x")),
    "F5-below-a-file": Out("plain/x", 7, ("a file in its place",),
                           lambda f: (f / "plain").write_text("x")),
    "F5-link-to-nothing": Out("link", 7, ("link",), lambda f: (f / "link").symlink_to("gone")),
    "F5-link-loop": Out("loop", 7, ("loop",), lambda f: (f / "loop").symlink_to("loop")),
    "F5-inside-the-asset-folder": Out("{inputs}", 2, ("--out", "holds the input")),
    "F5-dotdot-to-the-asset-folder": Out("{inputs}/x/..", 2, ("--out", "holds the input")),
    "F5-root": Out("/", 2, ("--out", "root")),
    "F5-dotdot-to-the-root": Out("/usr/..", 2, ("--out", "root")),
    "F5-read-only": Out("sealed", 5, ("sealed",), sealed, UNPRIVILEGED),
    "F5-below-read-only": Out("sealed/new/er", 5, ("sealed",), sealed, UNPRIVILEGED),
    "F5-long-name": Out("n" * 300, 5, ("name too long",)),
    "F5-full-disk": Out("new", 5, ("new", "found 1 MiB free; expected about"), before=FULL),
    "F5-existing-results": Out("done", 7, ("already holds files", "run.json"), results),
}  # fmt: skip


@pytest.mark.parametrize("mode", [[], ["--validate"]], ids=["run", "validate"])
@pytest.mark.parametrize("case", OUTS)
def test_unusable_output_is_refused(
    case: str, mode: list[str], inputs: Path, tmp_path: Path
) -> None:
    """A run and --validate say the same, and neither makes or changes anything."""
    bad = OUTS[case]
    bad.make(tmp_path)
    argv = [*arguments(inputs, bad.out.format(inputs=inputs)), *mode]
    lines = assert_fails(argv, bad.code, cwd=tmp_path, before=bad.before)
    for word in bad.words:
        assert word.lower() in lines[0].lower()


@pytest.mark.case("F5", "F6")
def test_abandoned_lock_and_new_folders_are_accepted(inputs: Path, tmp_path: Path) -> None:
    """The lock of a killed run is nobody's, and --validate leaves it; a new --out is not made."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".lock").write_text("99999 on elsewhere\n")
    validated(arguments(inputs, "out"), tmp_path)
    validated(arguments(inputs, "a/b/../c"), tmp_path)


def test_disk_estimate_covers_a_run(inputs: Path, tmp_path: Path) -> None:
    """What the demo's run wrote, every file counted: 15.3 MB, and 8.2 MB for Mitsuba."""
    from warpir.demo import demo_config

    plain = InsertConfig(demo=True, out=str(tmp_path), guidance="none")
    for mitsuba, size in ((False, 15.3e6), (True, 22.7e6)):
        config = demo_config(plain.changed(mitsuba=mitsuba))
        needed = needed_bytes(config, read_inputs(config))
        assert size < needed < 5 * size


# -------------------------------------------------------------------------------- limits


Made = dict[str, str | None]


def sparse_file(name: str, flag: str, size: int, **more: str | None) -> Make:
    """Give a file of a size to a flag."""
    return written(name, flag, lambda path: sparse(path, size), **more)


def json_of_glb(path: Path) -> None:
    """A GLB whose JSON takes as much, and holds nothing."""
    size = 1 << 28
    sparse(path, size)
    with path.open("r+b") as stream:
        stream.write(struct.pack("<4sIII4s", b"glTF", 2, size, size - 20, b"JSON"))


def glb_file(plant: Callable[[Builder], None], flag: str = "asset", **more: str | None) -> Make:
    """A GLB that is correct but for its size."""

    def write(path: Path) -> None:
        builder = Builder()
        plant(builder)
        path.write_bytes(builder.glb())

    return written("big.glb", flag, write, **more)


def far_buffer(builder: Builder) -> None:
    builder.json["buffers"].append({"uri": "big.bin", "byteLength": 10})
    builder.json["bufferViews"].append({"buffer": 1, "byteLength": 10})
    accessor = {"bufferView": len(builder.json["bufferViews"]) - 1, "componentType": 5123}
    builder.json["accessors"].append({**accessor, "count": 3, "type": "SCALAR"})
    builder.primitive["indices"] = len(builder.json["accessors"]) - 1


def buffer_beside(folder: Path) -> Made:
    sparse(folder / "big.bin", LIMITS.file_bytes + 1)
    return glb_file(far_buffer)(folder)


def textures(count: int, side: int) -> Callable[[Builder], None]:
    """As many materials, each drawn, each with a picture that claims a size."""

    def plant(builder: Builder) -> None:
        content = png_header(side, side)
        primitives = builder.json["meshes"][0]["primitives"]
        for k in range(count):
            image = {"bufferView": builder.view(content), "mimeType": "image/png"}
            index = builder.texture(image)
            slot = {"baseColorTexture": {"index": index}}
            builder.json["materials"].append({"pbrMetallicRoughness": slot})
            primitives.append({**builder.primitive, "material": k + 1})

    return plant


def many_triangles(builder: Builder) -> None:
    """50 million triangles in a file of a few KB: the accessor only promises them."""
    builder.json["accessors"][builder.primitive["indices"]]["count"] = 150_000_000


def children(builder: Builder) -> None:
    builder.json["nodes"] = [{"mesh": 0}] * 3
    builder.json["scenes"] = [{"nodes": [0, 1, 2]}]


def nested(levels: int) -> str:
    """JSON whose lists lie in each other."""
    return '{"a": ' + "[" * (levels - 1) + "]" * (levels - 1) + "}"


def colmap(folder: Path) -> Made:
    sparse(folder / "cameras.bin", 100)
    sparse(folder / "images.bin", LIMITS.file_bytes + 1)
    return {"camera": ".", **NO_POSE}


POINTS = "".join(f"{k} 0 {-k}\n" for k in range(9))
CAMERA = {
    "w": 48, "h": 32, "fx": 40.0, "fy": 40.0, "cx": 24.0, "cy": 16.0,
    "c2w": [[1, 0, 0, 0], [0, 1, 0, 1.5], [0, 0, 1, 0], [0, 0, 0, 1]],
}  # fmt: skip
PLY = "ply\nformat ascii 1.0\nelement vertex 9\n" + "".join(
    f"property float {c}\n" for c in "xyz"
) + "end_header\n" + POINTS  # fmt: skip


def with_points(name: str, content: str) -> Any:
    def make(folder: Path) -> Made:
        (folder / "camera.json").write_text(json.dumps(CAMERA))
        (folder / name).write_text(content)
        return {"camera": "camera.json", "ground_points": name, "max_points": "8", **NO_POSE}

    return make


TOO_MUCH: dict[str, tuple[int, str, Make]] = {
    # What no flag is needed for: the limits themselves.
    "I4-20000x20000": (3, "pixels", named("p.png", png_header(20000, 20000), "photo")),
    "I4-mask-20000x20000": (
        3, "pixels", named("m.png", png_header(20000, 20000), "occluder_mask")),
    "E4-exr-1e6x1e6": (3, "envmap_width", lambda f: huge_exr(f)),
    "E12-hdr-1e9-wide": (3, "envmap_width", named(
        "w.hdr", "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 10 +X 1000000000\n", "light")),
    "E12-hdr-32768-wide": (3, "envmap_width", named(
        "w.hdr", "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16384 +X 32768\n", "light")),
    "E4-png-panorama": (3, "envmap_width", named("p.png", png_header(40000, 20000), "light")),
    "M2-glb-of-3-GiB": (3, "file_bytes", sparse_file("a.glb", "asset", 3 << 30)),
    "M2-obj-of-3-GiB": (3, "file_bytes", sparse_file("a.obj", "asset", 3 << 30)),
    "M2-proxy-of-3-GiB": (3, "file_bytes", sparse_file("a.ply", "proxy", 3 << 30)),
    "M2-buffer-of-2-GiB": (3, "file_bytes", buffer_beside),
    "M2-gltf-JSON-of-1-GiB": (3, "gltf_json_bytes", sparse_file("a.gltf", "asset", 1 << 30)),
    "M2-JSON-of-256-MiB-in-glb": (3, "gltf_json_bytes", written("a.glb", "asset", json_of_glb)),
    "M2-nested": (3, "nesting", named("a.gltf", "[" * 100_000, "asset")),
    "M14-50-million-triangles": (3, "triangles", glb_file(many_triangles)),
    "M14-64-textures-of-8k": (3, "texture_pixels", glb_file(textures(64, 8192))),
    "M14-proxy-of-50-million": (3, "triangles", glb_file(many_triangles, "proxy")),
    "M10-100001-nodes": (3, "nodes", glb_file(
        lambda b: b.json.update(nodes=[{}] * (LIMITS.nodes + 1)))),
    "C9-camera-of-17-MiB": (3, "json_bytes", sparse_file("c.json", "camera", 17 << 20, **NO_POSE)),
    "C9-nested": (3, "nesting", named("c.json", nested(101), "camera", **NO_POSE)),
    "C9-nested-beyond-Python": (3, "nesting", named(
        "c.json", nested(100_000), "camera", **NO_POSE)),
    "C6-COLMAP-of-2-GiB": (3, "file_bytes", colmap),
    "E-lobes-of-17-MiB": (3, "json_bytes", sparse_file("l.json", "light", 17 << 20)),
    "M-materials-of-17-MiB": (3, "json_bytes", sparse_file("m.json", "materials", 17 << 20)),
    "F1-config-of-17-MiB": (2, "json_bytes", sparse_file("c.json", "config", 17 << 20)),
    "F1-yaml-of-17-MiB": (2, "json_bytes", sparse_file("c.yaml", "config", 17 << 20)),
    "C9-brackets-of-8-MB": (3, "json_values", named(
        "c.json", '{"a": [' + ("[" * 90 + "]" * 90 + ",") * 45_000 + "0]}", "camera", **NO_POSE)),
    "F1-nested-json": (2, "nesting", named("c.json", nested(101), "config")),
    "F1-nested-yaml": (2, "nesting", named("c.yaml", "a: " + "[" * 101, "config")),
    "F4-1-MB": (2, "prompt_bytes", lambda f: {"prompt": "car " * 2**18}),
    "F4-4097-bytes": (2, "prompt_bytes", lambda f: {"prompt": "c" * 4097}),
    # What is within them, and beyond what a flag says.
    "I5-photo": (3, "pixels", lambda f: {"max_pixels": "100"}),
    "E-width": (3, "envmap_width", lambda f: {"max_envmap_width": "16"}),
    "M-file": (3, "file_bytes", lambda f: {"max_file_bytes": "100"}),
    "M-json": (3, "gltf_json_bytes", lambda f: {"max_gltf_json_bytes": "100"}),
    "M-nodes": (3, "nodes", glb_file(children, max_nodes="2")),
    "M10-instances": (3, "instances", glb_file(children, max_instances="2")),
    "M14-triangles": (3, "triangles", lambda f: {"max_triangles": "11"}),
    "M14-texture-pixels": (3, "texture_pixels", glb_file(
        textures(2, 64), max_texture_pixels="5000")),
    "C-points": (3, "points", with_points("p.txt", POINTS)),
    "C-points-ply": (3, "points", with_points("p.ply", PLY)),
    "C-json": (3, "json_bytes", named(
        "c.json", json.dumps(CAMERA), "camera", max_json_bytes="50", **NO_POSE)),
    "F4-prompt": (2, "prompt_bytes", lambda f: {"prompt": "a car", "max_prompt_bytes": "4"}),
}  # fmt: skip


def huge_exr(folder: Path) -> Made:
    import io

    import OpenEXR

    stream = io.BytesIO()
    plane = np.zeros((8, 8), np.float32)
    OpenEXR.File({"type": OpenEXR.scanlineimage}, dict.fromkeys("RGB", plane)).write(stream)
    content, marker = stream.getvalue(), b"dataWindow\0box2i\0"
    start = content.index(marker) + len(marker) + 4
    window = struct.pack("<4i", 0, 0, 999_999, 999_999)
    (folder / "e.exr").write_bytes(content[:start] + window + content[start + 16 :])
    return {"light": "e.exr"}


@pytest.mark.parametrize("case", TOO_MUCH)
def test_limits_are_told_with_their_flags(case: str, inputs: Path, tmp_path: Path) -> None:
    """Seconds and little memory, and the error's own line says which flag raises the limit."""
    code, name, make = TOO_MUCH[case]
    argv = [*arguments(inputs, "out", **make(tmp_path)), "--validate"]
    flag = f"--max-{name.replace('_', '-')} raises it"
    (line,) = assert_fails(argv, code, flag, cwd=tmp_path)[:1]
    assert "limit " in line


def test_every_limit_is_a_flag_and_is_tried() -> None:
    limits = {field.name for field in fields(Limits)}
    listed = {name for name, option in OPTIONS.items() if option.part == "limits"}
    assert listed == {f"max_{name}" for name in limits}
    assert {name for _, name, _ in TOO_MUCH.values()} == limits
    assert InsertConfig().limits == LIMITS
    assert InsertConfig(max_nodes=3, max_pixels=7).limits == Limits(nodes=3, pixels=7)


@pytest.mark.parametrize(
    ("name", "flag", "content"),
    [
        ("frames.jsonl", "--max-json-bytes", '{"place": [0, 0, -5]}\n' * 9),
        ("nested.jsonl", "--max-nesting", nested(101)),
    ],
    ids=["F1-sequence-bytes", "F1-sequence-nesting"],
)
def test_limits_hold_for_sequences_and_earlier_runs(
    name: str, flag: str, content: str, inputs: Path, tmp_path: Path
) -> None:
    """The lines of --sequence, and the files of the run that --reuse names."""
    with OutputFolder(tmp_path / "run") as run:
        run.write_envmap(np.ones((8, 16, 3), np.float32))
        run.write_json("curves.json", curves_to_json(Curves.identity("linear")))
        run.write_json("camera.json", CAMERA)
        run.write_json("run.json", {"format": 1, "config": {}})
    (tmp_path / name).write_text(content)
    argv = arguments(inputs, "out", light=None, reuse="run", sequence=name)
    small = ["--max-json-bytes", "100"] if flag == "--max-json-bytes" else []
    code = ExitCode.INPUT if small else ExitCode.USAGE
    lines = assert_fails([*argv, *small, "--validate"], code, flag, cwd=tmp_path)
    assert ("run.json" in lines[0]) == bool(small)


@pytest.mark.parametrize(
    ("levels", "limit", "accepted"), [(100, "100", True), (101, "100", False), (150, "150", True)]
)
def test_F1_nesting_is_counted_exactly(
    levels: int, limit: str, accepted: bool, tmp_path: Path
) -> None:
    """As many levels as the flag says, in JSON and YAML alike; deeper is refused for that."""
    for name in ("c.json", "c.yaml"):
        (tmp_path / name).write_text(nested(levels))
        argv = ["--out", "o", "--config", name, "--max-nesting", limit]
        word = "unknown key 'a'" if accepted else f"(found {levels} levels; limit {limit})"
        assert_fails(argv, ExitCode.USAGE, word, cwd=tmp_path)


@pytest.mark.case("F1")
def test_yaml_at_its_limit_is_read_in_time(tmp_path: Path) -> None:
    """The most that YAML may hold takes seconds; it is shorter than JSON for that."""
    size = LIMITS.json_bytes // YAML_SHARE
    (tmp_path / "c.yaml").write_text("place: [" + "1," * (size // 2 - 5) + "]\n")
    assert (tmp_path / "c.yaml").stat().st_size <= size
    assert_fails(["--config", "c.yaml"], ExitCode.USAGE, "--place", cwd=tmp_path)


# ------------------------------------------------------------------ what works although it is odd


def endless(path: Path) -> None:
    path.symlink_to("/dev/zero")


NO_FILES: dict[str, tuple[str, Callable[[Path], None]]] = {
    "I18-fifo": ("photo", os.mkfifo),
    "I18-link-loop": ("photo", lambda path: path.symlink_to(path)),
    "I18-asset-fifo": ("asset", os.mkfifo),
    "I18-light-device": ("light", endless),
    "I18-mask-device": ("occluder_mask", endless),
    "I18-materials-fifo": ("materials", os.mkfifo),
    "I18-camera-fifo": ("camera", os.mkfifo),
    "I18-config-device": ("config", endless),
}


@pytest.mark.parametrize("case", NO_FILES)
def test_what_is_no_file_is_never_opened(case: str, inputs: Path, tmp_path: Path) -> None:
    """Nobody writes into the pipe and the device has no end: a reader would wait for ever."""
    flag, make = NO_FILES[case]
    name = "x.glb" if flag == "asset" else "x.json" if flag == "materials" else "x.png"
    make(tmp_path / name)
    pose = NO_POSE if flag == "camera" else {}
    code = ExitCode.USAGE if flag == "config" else ExitCode.INPUT
    argv = [*arguments(inputs, "out", **{flag: name}, **pose), "--validate"]
    assert_fails(argv, code, name, "not a regular file", cwd=tmp_path)


@pytest.mark.case("I1")
def test_unreadable_photo(inputs: Path, tmp_path: Path) -> None:
    path = tmp_path / "secret.png"
    path.write_bytes((inputs / "photo.png").read_bytes())
    path.chmod(0)
    argv = [*arguments(inputs, "out", photo="secret.png"), "--validate"]
    before = snapshot(tmp_path) if os.access(path, os.R_OK) else None
    ended = run_case(argv, tmp_path, before=UNPRIVILEGED)
    assert ended.status == ExitCode.INPUT
    assert ended.err.startswith("error: secret.png: cannot be read (Permission denied)")
    assert before is None or snapshot(tmp_path) == before


# -------------------------------------------------------------------- configuration and prompt


PROMPTS = {
    "F4-emoji": "a car \U0001f697",
    "F4-newlines": "a car,\n\nred\n",
    "F4-shell": "$(touch made); `touch made` | touch made ../made",
    "F4-path": "../../made/car",
    "F4-4096-bytes": "car " * 1024,
}


@pytest.mark.parametrize("case", PROMPTS)
def test_prompts(case: str, inputs: Path, tmp_path: Path) -> None:
    """A text for a model, whatever is in it: never a path, and nothing that a shell sees."""
    argv = arguments(inputs, "out", light=None, steps="9")
    validated([*argv, "--prompt=" + PROMPTS[case]], tmp_path)


def test_F4_longer_prompts_are_a_flag(inputs: Path, tmp_path: Path) -> None:
    argv = arguments(inputs, "out", light=None, steps="9", prompt="car " * 2000)
    validated([*argv, "--max-prompt-bytes", "8000"], tmp_path)


@pytest.mark.slow
@pytest.mark.case("F7")
def test_least_of_everything_gives_valid_results(inputs: Path, tmp_path: Path) -> None:
    """No step, one sample, eight pixels: complete results, every number finite."""
    least = {"steps": "0", "width": "8", "samples": "1", "depth": "1", "device": "cpu"}
    argv = arguments(inputs, "out", light=None, guidance_width="8", light_height="4", **least)
    ended = run_case(argv, tmp_path)
    assert ended.status == 0, ended
    record = record_of(tmp_path / "out")
    assert set(record["files"]) <= set(os.listdir(tmp_path / "out"))
    planes = read_layers(tmp_path / "out" / "layers.exr")
    assert all(np.isfinite(plane).all() for plane in planes.values())
    assert planes["matte.A"].max() > 0.0
