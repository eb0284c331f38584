"""What is written, and that it is whole or not there; values are asserted exactly."""

import errno
import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from PIL import Image

from tests.builders.image_files import four_lobes, matrix_profile
from tests.builders.insertions import digest
from warpir.core import color, signals
from warpir.core.atomic import write_folder
from warpir.core.errors import ExitCode, InputError
from warpir.io import results as files
from warpir.io.images.photos import read_envmap, read_photo
from warpir.io.images.writers import envmap_preview
from warpir.io.layers import BACKGROUND_DEPTH, Layers, read_layers, write_layers
from warpir.io.results import OutputFolder
from warpir.scene.camera import Camera, camera_from_fov


def write_small(folder: Path, seed: int = 0, overwrite: bool = False) -> None:
    codes = np.random.default_rng(seed).integers(0, 256, (6, 5, 3), dtype=np.uint8)
    with OutputFolder(folder, overwrite=overwrite) as out:
        out.write_png("composite.png", codes)
        out.write_json("camera.json", {"seed": seed})
        out.write_json("run.json", {"seed": seed})


def test_folder_is_complete_and_clean(tmp_path: Path) -> None:
    write_small(tmp_path / "out")
    assert sorted(os.listdir(tmp_path / "out")) == ["camera.json", "composite.png", "run.json"]
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    hashes = digest(tmp_path / "out")
    del hashes["run.json"]
    assert run == {"seed": 0, "files": hashes}


def test_results_are_not_overwritten_unless_asked(tmp_path: Path) -> None:  # F5
    write_small(tmp_path / "out")
    before = digest(tmp_path / "out")
    with pytest.raises(InputError, match=r"run\.json") as caught:
        write_small(tmp_path / "out", seed=1)
    assert caught.value.code == ExitCode.OUTPUT
    assert digest(tmp_path / "out") == before
    write_small(tmp_path / "out", seed=1, overwrite=True)
    assert digest(tmp_path / "out") != before


def test_overwriting_takes_away_what_the_old_run_wrote_and_nothing_else(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with OutputFolder(folder) as out:
        out.write_json("lobes.json", {"old": 1})
        out.write_json("edited.json", {"old": 2})
        out.write_json("run.json", {})
    (folder / "notes.txt").write_text("mine")
    (folder / "edited.json").write_text("mine too")
    write_small(folder, overwrite=True)
    names = {"camera.json", "composite.png", "run.json", "notes.txt", "edited.json"}
    assert set(os.listdir(folder)) == names
    assert (folder / "edited.json").read_text() == "mine too"


def write_nested(folder: Path, name: str, overwrite: bool = False) -> None:
    with OutputFolder(folder, overwrite=overwrite) as out:
        out.write_bytes("top.bin", b"1")
        out.write_bytes(f"sub/{name}", name.encode())
        out.write_json("run.json", {})


def test_files_in_a_folder_follow_the_same_rules(tmp_path: Path) -> None:
    """Listed, replaced, taken away with their empty folder, left alone when a run fails."""
    folder = tmp_path / "out"
    write_nested(folder, "a.bin")
    files = json.loads((folder / "run.json").read_text())["files"]
    assert files["sub/a.bin"] == hashlib.sha256(b"a.bin").hexdigest()
    write_nested(folder, "b.bin", overwrite=True)
    assert os.listdir(folder / "sub") == ["b.bin"]

    (folder / "sub" / "c.bin").mkdir()
    with pytest.raises(InputError, match="a folder in place of a file"):
        write_nested(folder, "c.bin", overwrite=True)
    assert sorted(os.listdir(folder / "sub")) == ["b.bin", "c.bin"]
    assert json.loads((folder / "run.json").read_text())["files"].keys() == {"top.bin", "sub/b.bin"}
    (folder / "sub" / "c.bin").rmdir()
    (folder / "sub" / "mine.txt").write_text("mine")
    write_small(folder, overwrite=True)
    assert os.listdir(folder / "sub") == ["mine.txt"]
    (folder / "sub" / "mine.txt").unlink()
    write_nested(folder, "a.bin", overwrite=True)
    write_small(folder, overwrite=True)
    assert not (folder / "sub").exists()


def test_a_link_in_place_of_a_folder_is_not_followed(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (tmp_path / "elsewhere").mkdir()
    (folder / "sub").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="link") as caught:
        write_nested(folder, "a.bin", overwrite=True)
    assert caught.value.code == ExitCode.RESOURCES
    assert os.listdir(tmp_path / "elsewhere") == [] and os.listdir(folder) == ["sub"]
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")  # the output folder itself may be one
    write_nested(tmp_path / "link", "a.bin")
    assert (tmp_path / "elsewhere" / "sub" / "a.bin").exists()


@pytest.mark.parametrize("existing", [False, True])
def test_failed_run_leaves_everything_as_it_was(tmp_path: Path, existing: bool) -> None:
    folder = tmp_path / "out"
    if existing:
        write_small(folder)
    before = digest(folder) if existing else {}
    with pytest.raises(KeyboardInterrupt), OutputFolder(folder, overwrite=True) as out:
        out.write_png("composite.png", np.zeros((4, 4, 3), np.uint8))
        raise KeyboardInterrupt
    assert folder.exists() == existing
    if existing:
        assert digest(folder) == before
        assert sorted(os.listdir(folder)) == sorted(before)


@pytest.mark.case("R4")
@pytest.mark.parametrize("failing", ["camera.json", "run.json"])
def test_failed_rename_leaves_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: str
) -> None:
    """Once the old ``run.json`` is gone there is none, and of the new files none either."""
    folder = tmp_path / "out"
    write_small(folder)
    (folder / "notes.txt").write_text("mine")
    replace = os.replace

    def no_space(source: Path, target: Path) -> None:
        if Path(target) == folder / failing:
            raise OSError(28, "No space left on device")
        replace(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", no_space)
        with pytest.raises(InputError) as caught:
            write_small(folder, seed=1, overwrite=True)
    assert caught.value.code == ExitCode.RESOURCES
    left = set(os.listdir(folder))
    assert "notes.txt" in left and "run.json" not in left and ".lock" not in left
    assert not any(name.startswith(".partial") for name in left)
    write_small(folder, seed=1, overwrite=True)
    assert json.loads((folder / "run.json").read_text())["seed"] == 1


@pytest.mark.case("F6")
def test_second_run_is_locked_out(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with OutputFolder(folder):
        for error in refuses_entry(OutputFolder(folder, overwrite=True)):
            assert f"locked by pid {os.getpid()} on " in error.what
            assert error.code == ExitCode.OUTPUT
        assert (folder / ".lock").exists()
    write_small(folder, overwrite=True)  # the lock went with its owner


def test_killed_run_leaves_no_lock(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / ".lock").write_text("99999 on elsewhere\n")
    (folder / ".partial-99999").mkdir()
    (folder / ".partial-99999" / "composite.png").write_bytes(b"half")
    write_small(folder)
    assert sorted(os.listdir(folder)) == ["camera.json", "composite.png", "run.json"]


@pytest.mark.parametrize(
    "name", ["../x.json", "a/b/c.json", "a/../x.json", "a/.lock", "/x.json", ".lock", ""]
)
def test_names_never_become_paths(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match="plain"), OutputFolder(tmp_path / "out") as out:
        out.write_json(name, {})


FULL_DISK = """
import resource, sys
import numpy as np
import OpenEXR, OpenImageIO
from warpir.core.errors import InputError
from warpir.io.results import OutputFolder
limit, kind, folder = int(sys.argv[1]), sys.argv[2], sys.argv[3]
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
rng = np.random.default_rng(1)
try:
    with OutputFolder(folder, overwrite=True) as out:
        if kind == "png":
            out.write_png("composite.png", rng.integers(0, 65536, (300, 400, 3), dtype=np.uint16))
        elif kind == "exr":
            out.write_exr("layers.exr", {"R": rng.random((400, 400), dtype=np.float32)})
        elif kind == "hdr":
            out.write_hdr("envmap.hdr", rng.random((300, 600, 3), dtype=np.float32))
        else:
            out.write_json("camera.json", {"text": "x" * 600000})
        out.write_json("run.json", {"seed": 2})
except InputError as error:
    print(error.code, error)
    sys.exit(int(error.code))
"""


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, id=f"R4-{kind}") for kind in ("png", "exr", "hdr", "json")]
)
def test_full_disk(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "out"
    write_small(folder)
    before = digest(folder)
    for limit in (1_000, 10_000, 100_000, 500_000):
        child = subprocess.run(
            [sys.executable, "-c", FULL_DISK, str(limit), kind, str(folder)],
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert child.returncode == ExitCode.RESOURCES, child.stdout + child.stderr
        assert "Traceback" not in child.stderr
        assert digest(folder) == before
        assert sorted(os.listdir(folder)) == sorted(before)


def test_json_is_strict_and_plain(tmp_path: Path) -> None:
    with OutputFolder(tmp_path / "out") as out:
        out.write_json("a.json", {"x": np.float32(0.5), "y": np.arange(3), "z": Path("p")})
        with pytest.raises(ValueError, match="JSON"):
            out.write_json("b.json", {"x": float("nan")})
    assert json.loads((tmp_path / "out" / "a.json").read_text()) == {
        "x": 0.5,
        "y": [0, 1, 2],
        "z": "p",
    }


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(1, 1, 3), (17, 5, 3), (9, 4)])
def test_png_round_trip(
    tmp_path: Path, rng: np.random.Generator, dtype: type, shape: tuple[int, ...]
) -> None:
    codes = rng.integers(0, np.iinfo(dtype).max + 1, shape, dtype=dtype)
    with OutputFolder(tmp_path / "out") as out:
        out.write_png("p.png", codes)
        out.write_png("plain.png", codes, mark=False)
        out.write_png("tagged.png", codes, icc=matrix_profile("p3"), description="what it is")
    reader = oiio.ImageInput.open(str(tmp_path / "out" / "p.png"))
    pixels = reader.read_image(0, 0, 0, reader.spec().nchannels, reader.spec().format)
    assert pixels.dtype == dtype
    np.testing.assert_array_equal(pixels.reshape(shape), codes)
    with Image.open(tmp_path / "out" / "p.png") as picture:
        picture.load()
        assert "compositeSynthetic" in picture.info["XML:com.adobe.xmp"]
        assert "icc_profile" not in picture.info
    with Image.open(tmp_path / "out" / "plain.png") as picture:
        assert "XML:com.adobe.xmp" not in picture.info
    with Image.open(tmp_path / "out" / "tagged.png") as picture:
        assert picture.info["icc_profile"] == matrix_profile("p3")
        assert picture.info["Description"] == "what it is"


def test_envmap_files(tmp_path: Path) -> None:
    texels = four_lobes(32)
    texels[3, 5] = 2e5  # a sun above the half range
    with OutputFolder(tmp_path / "out") as out:
        out.write_envmap(texels)
    np.testing.assert_array_equal(read_envmap(tmp_path / "out" / "envmap.exr"), texels)
    hdr = read_envmap(tmp_path / "out" / "envmap.hdr")
    assert np.abs(hdr - texels).max(axis=-1) == pytest.approx(0.0, abs=2e5 / 128)
    assert (np.abs(hdr - texels) <= texels.max(axis=-1, keepdims=True) / 127).all()
    preview = read_photo(tmp_path / "out" / "envmap_preview.png").srgb
    # Rolled: magenta, which shines along -Z, is in the middle.
    assert preview[16, 32] @ (1.0, -1.0, 1.0) > 0.9
    with OutputFolder(tmp_path / "bad") as out, pytest.raises(InputError) as caught:
        out.write_envmap(-texels)
    assert caught.value.code == ExitCode.NUMERIC


def test_the_preview_of_a_large_map_is_small() -> None:
    texels = np.full((2048, 4096, 3), 0.5, np.float32)
    texels[:1024] = 0.1
    preview = envmap_preview(texels)
    assert preview.shape == (1024, 2048, 3)
    assert len(np.unique(preview[:512])) == len(np.unique(preview[512:])) == 1


def small_layers(rng: np.random.Generator) -> tuple[Layers, Camera]:
    camera = camera_from_fov(20, 12, 60.0, -5.0, 1.5)
    shape = (12, 20)
    foreground = rng.random((*shape, 4)).astype(np.float32)
    foreground[:6] = 0.0
    plate = (rng.random((*shape, 3)) * 4.0).astype(np.float32)
    shadow_ratio = np.ones((*shape, 3), np.float32)
    shadow_ratio[4:9] = rng.random((5, 20, 3)) * 1.5
    depth = np.full(shape, np.inf, np.float32)
    depth[6:] = 123.456
    layers = Layers(
        composite=foreground[..., :3] + (1 - foreground[..., 3:]) * plate * shadow_ratio,
        foreground=foreground,
        shadow_ratio=shadow_ratio,
        plate=plate,
        matte=foreground[..., 3],
        depth=depth,
        position=rng.normal(size=(*shape, 3)).astype(np.float32),
        normal=rng.normal(size=(*shape, 3)).astype(np.float32),
        roughness=np.full(shape, 0.25, np.float32),
        diffuse=np.full((*shape, 3), 1e6, np.float32),
    )
    return layers, camera


def read_channels(path: Path) -> tuple[dict[str, np.ndarray], Any]:
    """Read by OpenImageIO, each channel in float32."""
    reader = oiio.ImageInput.open(str(path))
    spec = reader.spec()
    pixels = reader.read_image(0, 0, 0, spec.nchannels, "float")
    return {name: pixels[..., k] for k, name in enumerate(spec.channelnames)}, spec


def test_layers_recompute_the_composite(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    with OutputFolder(tmp_path / "out") as out:
        assert write_layers(out, layers, camera, config={"b": 1, "a": 2}) == 12 * 20 * 3
    planes, spec = read_channels(tmp_path / "out" / "layers.exr")
    fg = np.stack([planes[f"fg.{c}"] for c in "RGBA"], axis=-1)
    plate, ratio = (np.stack([planes[f"{n}.{c}"] for c in "RGB"], -1) for n in ("plate", "shadow"))
    composite = np.stack([planes[c] for c in "RGB"], axis=-1)
    ulp = 2.0**-11  # relative rounding of one half number; four of them meet here
    np.testing.assert_allclose(
        composite, fg[..., :3] + (1 - fg[..., 3:]) * plate * ratio, rtol=5 * ulp, atol=5 * ulp
    )
    untouched = (fg[..., 3] == 0) & (ratio == 1).all(axis=-1)
    assert untouched.any()
    np.testing.assert_array_equal(composite[untouched], plate[untouched])
    np.testing.assert_array_equal(planes["position.X"], layers.position[..., 0])
    np.testing.assert_array_equal(planes["Z"][6:], np.float32(123.456))
    np.testing.assert_array_equal(planes["Z"][:6], np.float32(BACKGROUND_DEPTH))
    np.testing.assert_array_equal(planes["diffuse.G"], 65504.0)
    assert "albedo.R" not in planes
    formats = dict(zip(spec.channelnames, map(str, spec.channelformats), strict=True))
    floats = {name for name, kind in formats.items() if kind == "float"}
    assert floats == {"Z", *(f"{n}.{c}" for n in ("position", "normal") for c in "XYZ")}
    np.testing.assert_allclose(spec.getattribute("chromaticities"), color.REC709_CHROMATICITIES)
    assert spec.getattribute("colorInteropID") == "lin_rec709_scene"
    assert json.loads(spec.getattribute("warpir/config")) == {"a": 2, "b": 1}
    assert spec.getattribute("capDate") is None
    assert spec.getattribute("DateTime") is None
    # The stored matrix multiplies row vectors: its translation is in the last row.
    matrix = np.array(spec.getattribute("worldToCamera")).reshape(4, 4)
    np.testing.assert_allclose(matrix[:, 3], [0, 0, 0, 1])
    ndc = np.array(spec.getattribute("worldToNDC")).reshape(4, 4)
    point = np.array([0.3, 0.2, -5.0])
    row = np.append(point, 1.0) @ ndc
    np.testing.assert_allclose(
        row[:2] / row[3] * [20, 12], camera.project(point[None])[0], atol=1e-3
    )


def test_layers_are_read_back(tmp_path: Path, rng: np.random.Generator) -> None:
    """Floats as they were, the rest rounded to half; what was not made is absent again."""
    layers, camera = small_layers(rng)
    with OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)
    found = read_layers(tmp_path / "out" / "layers.exr")
    for name in ("depth", "position", "normal"):
        np.testing.assert_array_equal(getattr(found, name), getattr(layers, name))
    for name in ("composite", "foreground", "shadow_ratio", "plate", "matte", "roughness"):
        halves = getattr(layers, name).astype(np.float16)
        np.testing.assert_array_equal(getattr(found, name), halves)
    assert found.albedo is found.emission is found.specular is None


def test_layers_of_others_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    """A panorama, half a file and no file: one line each, which names the file."""
    layers, camera = small_layers(rng)
    with OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)
        out.write_envmap(four_lobes(8))
    whole = (tmp_path / "out" / "layers.exr").read_bytes()
    (tmp_path / "half.exr").write_bytes(whole[: len(whole) // 2])
    for path, found in (
        (tmp_path / "out" / "envmap.exr", "found no fg.R, fg.G, fg.B, fg.A"),
        (tmp_path / "half.exr", "truncated"),
        (tmp_path / "out" / "envmap.hdr", "not an EXR file"),
        (tmp_path / "absent.exr", "absent"),
    ):
        with pytest.raises(InputError, match=found) as caught:
            read_layers(path)
        assert str(path) in str(caught.value)


def test_layers_are_the_same_bytes_every_time(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    for name in ("a", "b"):
        with OutputFolder(tmp_path / name) as out:
            write_layers(out, layers, camera)
            out.write_envmap(four_lobes(8))
    assert digest(tmp_path / "a") == digest(tmp_path / "b")


@pytest.mark.case("E13")
def test_e13_mitsuba_reads_what_is_written(tmp_path: Path, rng: np.random.Generator) -> None:
    """A second reader finds the same values under the same names (OpenImageIO is the first)."""
    mitsuba = pytest.importorskip("mitsuba", reason="Mitsuba is not installed (extra bench)")
    mitsuba.set_variant("scalar_rgb")
    layers, camera = small_layers(rng)
    texels = four_lobes(16)
    texels[3, 5] = 2e5
    with OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)
        out.write_envmap(texels)
    envmap = np.array(mitsuba.Bitmap(str(tmp_path / "out" / "envmap.exr")))
    np.testing.assert_array_equal(envmap, texels)
    hdr = np.array(mitsuba.Bitmap(str(tmp_path / "out" / "envmap.hdr")))
    np.testing.assert_array_equal(hdr, read_envmap(tmp_path / "out" / "envmap.hdr"))
    planes, _ = read_channels(tmp_path / "out" / "layers.exr")
    bitmap = mitsuba.Bitmap(str(tmp_path / "out" / "layers.exr"))
    names = [bitmap.struct_()[k].name for k in range(bitmap.channel_count())]
    assert set(names) == set(planes)
    pixels = np.array(bitmap)  # all of one type: half, as the first channel is
    with np.errstate(over="ignore"):
        for k, name in enumerate(names):
            np.testing.assert_array_equal(pixels[..., k], planes[name].astype(pixels.dtype))


def test_layers_that_do_not_add_up_are_our_bug(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    layers.composite[7, 7] += 0.5
    with pytest.raises(ValueError, match="differs"), OutputFolder(tmp_path / "out") as out:
        write_layers(out, layers, camera)


def test_non_finite_layer_is_a_numeric_failure(tmp_path: Path, rng: np.random.Generator) -> None:
    layers, camera = small_layers(rng)
    assert layers.normal is not None
    layers.normal[0, 0, 1] = np.nan
    with pytest.raises(InputError, match=r"normal\.Y") as caught:
        with OutputFolder(tmp_path / "out") as out:
            write_layers(out, layers, camera)
    assert caught.value.code == ExitCode.NUMERIC
    assert not (tmp_path / "out").exists()


def test_importing_loads_no_heavy_library() -> None:
    code = (
        "import sys, warpir.io.results, warpir.io.images.photos, warpir.scene.camera; "
        "heavy = {'torch', 'warp', 'trimesh', 'PIL', 'OpenImageIO', 'OpenEXR', 'colour'}; "
        "print(*sorted(heavy & set(sys.modules)))"
    )
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (child.returncode, child.stdout) == (0, "\n"), child.stderr


def refuses_entry(folder: OutputFolder) -> Iterator[InputError]:
    """Yield what `check` finds, and the same on entering."""
    for enter in (folder.check, folder.__enter__):
        with pytest.raises(InputError) as caught:
            enter()
        yield caught.value


@pytest.mark.case("F5")
@pytest.mark.parametrize(
    "name",
    ["checkpoints/model.safetensors", "checkpoints/run.json", "progress/notes.txt", "progress"],
)
def test_folder_of_somebody_else_is_a_result(tmp_path: Path, name: str) -> None:
    """Only what our names say is ours counts as an unfinished run's."""
    path = tmp_path / "out" / name
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    for error in refuses_entry(OutputFolder(tmp_path / "out")):
        assert "already holds files" in error.what and name in error.what
        assert error.code == ExitCode.OUTPUT
    assert path.read_text() == "mine" and len(list((tmp_path / "out").iterdir())) == 1


@pytest.mark.case("F5")
def test_lock_of_somebody_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text("precious")
    with pytest.raises(InputError, match="not a lock") as caught, OutputFolder(tmp_path, True):
        pass
    assert caught.value.code == ExitCode.OUTPUT
    assert (tmp_path / ".lock").read_text() == "precious"


@pytest.mark.case("F5")
@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir], ids=["FIFO", "folder"])
def test_lock_that_is_no_file_is_refused(tmp_path: Path, make: Callable[[Path], None]) -> None:
    """At once: who opens a FIFO waits for its other end."""
    make(tmp_path / ".lock")
    for error in refuses_entry(OutputFolder(tmp_path, overwrite=True)):
        assert error.code in (ExitCode.OUTPUT, ExitCode.RESOURCES)
    assert os.listdir(tmp_path) == [".lock"]


@pytest.mark.case("R6")
def test_old_file_that_cannot_be_read_costs_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is replaced where it has a new one's name, and stays where it has not."""
    with OutputFolder(tmp_path) as out:
        for name in ("a.txt", "b.txt"):
            out.write_bytes(name, b"old")
        out.write_json("run.json", {})
    opened = Path.open

    def denied(self: Path, *args: Any, **more: Any) -> Any:
        if self.parent == tmp_path and self.suffix == ".txt":
            raise PermissionError(errno.EACCES, "Permission denied", str(self))
        return opened(self, *args, **more)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", denied)
        with OutputFolder(tmp_path, overwrite=True) as out:
            out.write_bytes("a.txt", b"new")
            out.write_json("run.json", {})
    assert (tmp_path / "a.txt").read_bytes() == b"new"
    assert (tmp_path / "b.txt").read_bytes() == b"old"


@pytest.mark.case("F5")
def test_folder_that_cannot_be_listed_is_no_output(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def denied(path: Path) -> Any:
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(files, "results_in", denied)
    for error in refuses_entry(OutputFolder(tmp_path)):
        assert "Permission denied" in error.what
        assert error.code == ExitCode.RESOURCES and error.where == str(tmp_path)
    assert os.listdir(tmp_path) == []


def test_a_signal_ends_writers_with_the_file_they_are_at(tmp_path: Path) -> None:
    """It comes while one of two has a file to go, and nothing is left of either."""
    went_on = threading.Event()

    def write(folder: OutputFolder, first: str, second: str) -> None:
        folder.write_bytes(first, b"1")
        if first == "a.bin":
            os.kill(os.getpid(), signal.SIGTERM)
        while not signals.is_pending():
            time.sleep(0.001)
        folder.write_bytes(second, b"2")
        went_on.set()

    with pytest.raises(signals.Stopped), signals.handled(), OutputFolder(tmp_path / "out") as out:
        out.write_together(
            lambda: write(out, "a.bin", "b.bin"), lambda: write(out, "c.bin", "d.bin")
        )
    assert not went_on.is_set() and os.listdir(tmp_path) == []


# ------------------------------------------------------------------- folders that are replaced


def replace_folder(path: Path) -> None:
    write_folder(path, [("a.txt", b"new"), ("deep/b.txt", b"new")])


@pytest.mark.case("R2")
@pytest.mark.parametrize("turn", [1, 2])
def test_a_signal_leaves_a_whole_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, turn: int
) -> None:
    """SIGTERM after either of the two renames waits for the other; nothing else is left."""
    path, calls, inner = tmp_path / "state", [0], os.rename
    write_folder(path, [("a.txt", b"old")])

    def renamed(source: Path, target: Path) -> None:
        inner(source, target)
        calls[0] += 1
        if calls[0] == turn:
            signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(os, "rename", renamed)
    with pytest.raises(signals.Stopped), signals.handled():
        replace_folder(path)
    assert (path / "a.txt").read_bytes() == (path / "deep" / "b.txt").read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["state"]


def test_an_exception_gives_the_folder_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C where no handler of ours is."""
    path, inner = tmp_path / "state", os.rename
    write_folder(path, [("a.txt", b"old")])

    def renamed(source: Path, target: Path) -> None:
        inner(source, target)
        if source == path:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "rename", renamed)
    with pytest.raises(KeyboardInterrupt):
        replace_folder(path)
    assert os.listdir(tmp_path) == ["state"] and os.listdir(path) == ["a.txt"]


@pytest.mark.case("F5")
@pytest.mark.parametrize("name", ["checkpoints", "progress", "progress-new", "mitsuba"])
def test_link_in_place_of_a_folder_is_refused(tmp_path: Path, name: str) -> None:
    """What is written into it would lie outside of --out, --overwrite or not."""
    (tmp_path / "else").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).symlink_to(tmp_path / "else")
    for error in refuses_entry(OutputFolder(tmp_path / "out", overwrite=True)):
        assert "a link in place" in error.what and error.code == ExitCode.OUTPUT
    assert not list((tmp_path / "else").iterdir()) and (tmp_path / "out" / name).is_symlink()


BLACK = np.zeros((2, 2, 3), np.uint8)


def write_previews(out: Path, *steps: int, codes: np.ndarray = BLACK, **options: bool) -> None:
    """Make a run that shows previews and has a result."""
    with OutputFolder(out, **options) as folder:
        for step in steps:
            folder.write_preview(step, codes)
        folder.write_json("run.json", {})


def assert_shown(out: Path, *steps: int) -> None:
    """Check that these previews stand in their place, and no others anywhere."""
    names = [f"preview-{step:06d}.png" for step in steps]
    assert sorted(p.name for p in (out / "progress").iterdir()) == names
    assert not (out / "progress-new").exists()


@pytest.mark.case("N8")
@pytest.mark.parametrize("turn", ["killed before", "killed at the commit", "not killed"])
def test_previews_of_an_earlier_result_stay_until_it_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, turn: str
) -> None:
    """Those of the new run stand beside them, and come with its result, also after a kill."""
    out = tmp_path / "out"
    write_previews(out, 0, 50)
    old = (out / "progress" / "preview-000000.png").read_bytes()
    killed = RuntimeError("stands for a kill: nothing of ours runs after it")
    try:
        with OutputFolder(out, overwrite=True) as folder:
            assert folder.write_preview(0, BLACK + 255).parent.name == "progress-new"
            assert (out / "progress" / "preview-000000.png").read_bytes() == old
            folder.write_json("run.json", {})
            if turn == "killed before":
                raise killed
            if turn == "killed at the commit":
                monkeypatch.setattr(folder, "_show_previews", lambda: (_ for _ in ()).throw(killed))
    except RuntimeError as error:
        assert error is killed
        assert (out / "progress" / "preview-000000.png").read_bytes() == old
        write_previews(out, overwrite=True)
    assert_shown(out, 0)
    assert (out / "progress" / "preview-000000.png").read_bytes() != old


def test_kill_between_two_results_loses_no_preview(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed when it moves its folder of previews, or removes it; then it goes on to write one."""
    out = tmp_path / "out"
    write_previews(out, 0)
    replace, rmdir = os.replace, Path.rmdir

    def replace_or_die(source: Path, target: Path) -> None:
        if Path(source).name == "progress-new":
            raise RuntimeError("killed")
        replace(source, target)

    def remove_or_die(self: Path) -> None:
        if self.name == "progress-new":
            raise RuntimeError("killed")
        rmdir(self)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", replace_or_die)
        patch.setattr(Path, "rmdir", remove_or_die)
        with pytest.raises(RuntimeError, match="killed"):
            write_previews(out, 0, codes=BLACK + 255, overwrite=True)
    write_previews(out, 50, codes=BLACK + 255, overwrite=True)
    assert_shown(out, 0, 50)


def test_run_resumed_beside_its_own_result_keeps_its_previews(tmp_path: Path) -> None:
    """Killed between its result and the end of its checkpoints; the last step is done again."""
    write_previews(tmp_path, 0, 50)
    write_previews(tmp_path, 50, overwrite=True, is_resumed=True)
    assert_shown(tmp_path, 0, 50)


@pytest.mark.case("R6")
@pytest.mark.parametrize("what", ["gone", "changed", "another", "lock"])
def test_folder_that_somebody_disturbs_is_not_committed(tmp_path: Path, what: str) -> None:
    """A staged file gone or changed, a file that came meanwhile, a lock that was deleted."""
    out = tmp_path / "out"
    codes = {"gone": 5, "changed": 5, "another": 7, "lock": 7}
    with pytest.raises(InputError) as caught, OutputFolder(out) as folder:
        folder.write_bytes("a.txt", b"content")
        folder.write_json("run.json", {})
        if what == "gone":
            (folder.staging / "a.txt").unlink()
        elif what == "changed":
            (folder.staging / "a.txt").write_bytes(b"CONTENT")
        elif what == "another":
            (out / "a.txt").write_bytes(b"mine")
        else:
            (out / ".lock").unlink()
    assert caught.value.code == codes[what]
    left = [path.name for path in out.rglob("*")] if out.exists() else []
    assert left == (["a.txt"] if what == "another" else [])


@pytest.mark.case("F5")
def test_name_that_is_not_utf8_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="UTF-8") as caught:
        OutputFolder(tmp_path / "o\udcff").check()
    assert caught.value.code == ExitCode.USAGE and caught.value.where == "--out"
