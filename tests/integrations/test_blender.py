"""The Blender extension: its zip and its process everywhere, the rest in a real Blender.

The latter needs a Python with ``bpy``, named in WARPIR_BLENDER_PYTHON.
"""

import importlib.util
import json
import os
import re
import runpy
import subprocess
import sys
import time
import tomllib
import zipfile
from dataclasses import asdict
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import warpir.demo
from tests.builders.image_files import write_image
from tests.io.test_handoff import BLENDER, planes_of, stacked
from warpir.core.color import linear_to_srgb
from warpir.io.cameras.reader import read_camera
from warpir.io.export import tone_curve_cube
from warpir.io.images.decoder import decode_image
from warpir.look.grain import Grain
from warpir.look.response import Response

ROOT = Path(__file__).resolve().parents[2]
FOLDER = ROOT / "integrations/blender"
DEMO = Path(warpir.demo.__file__).parent
SHARP_END = (".", "!", "?", ",", ";", ":")
TAGS = {"Camera", "Lighting", "Render", "Compositing", "Import-Export", "3D View"}
"""Of the manual's list for add-ons, those that could fit."""


@pytest.fixture(scope="module")
def extension(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The zip, built by the documented command."""
    folder = tmp_path_factory.mktemp("dist")
    command = ["make", "-s", "blender-extension", f"DIST={folder}", f"PYTHON={sys.executable}"]
    subprocess.run(command, cwd=ROOT, check=True)
    return folder / "warpir_blender.zip"


def test_zip_holds_a_valid_manifest_and_every_module(extension: Path) -> None:
    """The manifest's rules: docs.blender.org/manual/en/latest/advanced/extensions/."""
    with zipfile.ZipFile(extension) as package:
        names = set(package.namelist())
        manifest = tomllib.loads(package.read("blender_manifest.toml").decode())
        for name in names - {"blender_manifest.toml"}:
            compile(package.read(name), name, "exec")
    assert names == {path.name for path in FOLDER.iterdir() if path.is_file()}
    assert {"__init__.py", "blender_manifest.toml"} <= names
    assert manifest["schema_version"] == "1.0.0" and manifest["type"] == "add-on"
    assert manifest["id"].isidentifier() and manifest["name"] and manifest["maintainer"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", manifest["version"])
    assert manifest["version"] == warpir.__version__
    assert manifest["blender_version_min"] == "4.2.0"
    assert manifest["license"] == ["SPDX:Apache-2.0"]
    assert "Apache License" in (ROOT / "LICENSE").read_text()
    assert set(manifest["tags"]) <= TAGS
    assert set(manifest["permissions"]) <= {"files", "network", "clipboard"}
    for line in (manifest["tagline"], *manifest["permissions"].values()):
        assert 0 < len(line) <= 64 and not line.endswith(SHARP_END)


# ------------------------------------------------------------------ the process, without Blender


@pytest.fixture(scope="module")
def job() -> ModuleType:
    spec = importlib.util.spec_from_file_location("warpir_blender_job", FOLDER / "job.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_job_tells_progress_and_can_be_cancelled(job: ModuleType, tmp_path: Path) -> None:
    endless = "import time; print('object: 3 of 12 %', flush=True); time.sleep(600)"
    run = job.Job(sys.executable, ["-c", endless], tmp_path)
    assert not run.has_ended()
    deadline = time.monotonic() + 30.0
    while len(run.lines) == 1 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert run.lines[-1] == "object: 3 of 12 %" and run.share == 0.25
    run.cancel()
    while not run.has_ended(1.0):
        pass
    assert run.has_ended()
    with pytest.raises(job.Failure, match="Cancelled"):
        run.check()


@pytest.mark.parametrize(
    ("code", "told"),
    [
        ("", None),
        ("import sys; print('error: a.jpg: no such file'); print('look'); sys.exit(2)", "a.jpg"),
        ("import sys; print(1); sys.exit(3)", "1"),
        ("import sys; sys.exit(3)", "status 3"),
        ("import warpir_is_not_here", "has no warpir"),
    ],
)
def test_job_ends_with_one_message(
    job: ModuleType, tmp_path: Path, code: str, told: str | None
) -> None:
    run = job.Job(sys.executable, ["-c", code], tmp_path)
    while not run.has_ended(1.0):
        pass
    if told is None:
        run.check()
        return
    with pytest.raises(job.Failure, match=told) as failure:
        run.check()
    assert "\n" not in str(failure.value)


def test_job_needs_a_python(job: ModuleType, tmp_path: Path) -> None:
    for python in ("", str(tmp_path / "python")):
        with pytest.raises(job.Failure, match="preferences"):
            job.Job(python, [], tmp_path)


def test_a_photo_upside_down_is_known(tmp_path: Path) -> None:
    """It is as wide and high as its upright self, which Blender has to be given in its place."""
    estimate = runpy.run_path(str(FOLDER / "estimate.py"))
    exif = Image.Exif()
    exif[0x112] = 3
    Image.new("RGB", (48, 32)).save(tmp_path / "turned.jpg", exif=exif)
    Image.new("RGB", (48, 32)).save(tmp_path / "upright.jpg")
    assert estimate["is_turned"](str(tmp_path / "turned.jpg"))
    assert not estimate["is_turned"](str(tmp_path / "upright.jpg"))


def test_grain_of_a_plate_is_as_strong_as_the_plate_is_shown(tmp_path: Path) -> None:
    """It is recorded for the plate as it is exposed, and Blender shows the plate as it is."""
    estimate = runpy.run_path(str(FOLDER / "estimate.py"))
    shown = np.tile(np.linspace(0.1, 1.0, 64), (48, 1))[..., None].repeat(3, axis=-1)
    look = {"grain": asdict(Grain((0.5,), ((0.02,) * 3,), 0.0, 0.0))}
    strengths = []
    for factor in (1.0, 0.1):
        plate = write_image(tmp_path / "p.exr", (factor * shown**2.2).astype(np.float32))
        record = {"config": {"photo": str(plate)}, "measured": {"look": look}}
        (tmp_path / "run.json").write_text(json.dumps(record), "utf-8")
        display = shown * factor ** (1.0 / 2.2)
        Image.fromarray(np.uint8(255.0 * display)).save(tmp_path / "photo.png")
        estimate["write_grain"](tmp_path, tmp_path / "grain.exr")
        strengths.append(decode_image(tmp_path / "grain.exr", 10**6).pixels.std())
    assert strengths[1] == pytest.approx(strengths[0] * 0.1 ** (1.0 / 2.2), rel=1e-3)


def test_flags_go_to_their_own_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An insertion takes the estimate's camera and light, and no flags that state them again."""
    package = ModuleType("warpir_blender")
    package.__path__ = [str(FOLDER)]
    monkeypatch.setitem(sys.modules, "bpy", MagicMock())
    monkeypatch.setitem(sys.modules, package.__name__, package)
    scenes = importlib.import_module("warpir_blender.scene")
    for name in ("scene", "job", "compositor"):
        monkeypatch.delitem(sys.modules, f"warpir_blender.{name}")
    background = SimpleNamespace(image=SimpleNamespace(size=(48, 32)))
    monkeypatch.setattr(scenes, "photo_of", lambda scene: (background, tmp_path / "photo.png"))
    monkeypatch.setattr(scenes, "_bounds", lambda context, things: (np.zeros(3), np.ones(3)))
    monkeypatch.setattr(scenes, "_camera_record", lambda context, width, height: {})
    context = MagicMock(selected_objects=[MagicMock(type="MESH")])
    context.scene.warpir.estimate_flags = "--fov 50 --camera-height 1.2"
    context.scene.warpir.flags = "--ground-roughness 0.2"
    context.scene.warpir.light = str(tmp_path)
    asked = scenes.estimate_arguments(context, tmp_path)
    assert asked[-4:] == ["--fov", "50", "--camera-height", "1.2"]
    asked = scenes.insert_arguments(context, tmp_path)
    assert asked[-2:] == ["--ground-roughness", "0.2"] and "--fov" not in asked


# ------------------------------------------------------------------------------ in a real Blender

DRIVER = """
import importlib, json, os, runpy, sys, time
from pathlib import Path
from types import SimpleNamespace
import bpy
from bpy_extras.object_utils import world_to_camera_view
from mathutils import Vector
package, python, photo, asset, out = sys.argv[1:6]
saw = {}
bpy.ops.extensions.package_install_files(
    filepath=package, repo="user_default", enable_on_install=True)
name = next(n for n in bpy.context.preferences.addons.keys() if n.endswith(".warpir"))
module = importlib.import_module(name)
preferences = bpy.context.preferences.addons[name].preferences
scene, warpir = bpy.context.scene, bpy.ops.warpir
for thing in list(scene.objects):
    bpy.data.objects.remove(thing)

def refused(operator, **values):
    try:
        assert operator(**values) == {"CANCELLED"}
    except RuntimeError as error:
        return str(error)

bpy.ops.wm.save_as_mainfile(filepath=out + "/scene.blend")
saw["report"] = refused(warpir.report)
saw["camera"] = refused(warpir.estimate)
saw["photo"] = refused(warpir.photo, filepath=out + "/nowhere.jpg")
warpir.photo(filepath=photo)
saw["unnamed"] = refused(warpir.estimate)
preferences.python = "/nowhere/python"
saw["nowhere"] = refused(warpir.estimate)
preferences.python = sys.executable
saw["without"] = refused(warpir.estimate)
preferences.python = python
image = scene.camera.data.background_images[0].image
image.filepath = out + "/moved.png"
saw["moved"] = refused(warpir.estimate)
image.filepath = photo
scene.warpir.estimate_flags = "--fov 900"
saw["flag"] = refused(warpir.estimate)

# With a window Blender goes on: a timer looks, and cancels
manager = bpy.context.window_manager
code = "import time; print('object: 1 of 4 %', flush=True); time.sleep(600)"
module._jobs.append(module.Job(python, ["-c", code], Path(out)))
while len(module._jobs[0].lines) == 1:
    time.sleep(0.05)
saw["busy"] = warpir.estimate.poll(), warpir.insert.poll()
said, run = [], module.Run
stand_in = SimpleNamespace(
    timer=manager.event_timer_add(0.2, window=bpy.context.window),
    report=lambda kind, text: said.append(text), end=lambda: run.end(stand_in))
tick = SimpleNamespace(type="TIMER")
start = time.monotonic()
saw["passes"] = list(run.modal(stand_in, bpy.context, tick))
saw["took"] = time.monotonic() - start
drawn = []
class Layout:
    def __getattr__(self, name):
        return lambda *values, **more: drawn.append([name, *values[1:], more])
module.Panel.draw(SimpleNamespace(layout=Layout()), bpy.context)
saw["drawn"] = drawn
warpir.cancel()
while (state := run.modal(stand_in, bpy.context, tick)) == {"PASS_THROUGH"}:
    time.sleep(0.05)
saw["cancelled"] = [*state, *said]

scene.warpir.estimate_flags = "--camera-height 1.6 --no-report"
assert warpir.estimate() == {"FINISHED"}
saw["norep"] = refused(warpir.report)
saw["objects"] = sorted((o.name, o.type) for o in scene.objects)
estimate = Path(scene.warpir.light)
importlib.import_module(name + ".scene").show_estimate(scene, estimate.parent)
saw["again"] = sorted((o.name, o.type) for o in scene.objects)
saw["nothing"] = refused(warpir.insert)
bpy.ops.import_scene.gltf(filepath=asset)
car = bpy.context.selected_objects[0]
car.rotation_mode = "XYZ"
car.rotation_euler.z += 0.6
car.location.y += 7.0
scene.warpir.samples = 64
assert warpir.insert() == {"FINISHED"}
saw["result"], saw["light"] = scene.warpir.result, scene.warpir.light
thin_walls = runpy.run_path(scene.warpir.result + "/blender_setup.py")["thin_walls"]
for slot in car.material_slots:
    thin_walls(slot.material.node_tree)
width, height = scene.render.resolution_x, scene.render.resolution_y
corners = [car.matrix_world @ Vector(corner) for corner in car.bound_box]
saw["corners"] = [list(corner) for corner in corners]
seen = [world_to_camera_view(scene, scene.camera, corner) for corner in corners]
saw["pixels"] = [[width * p.x, height * (1.0 - p.y)] for p in seen]

def render(path, file_format, mode, depth):
    image = scene.render.image_settings
    image.file_format, image.color_mode, image.color_depth = file_format, mode, depth
    scene.render.filepath = out + "/" + path
    bpy.ops.render.render(write_still=True)

scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", 64, False
render("layers.png", "PNG", "RGB", "8")
compositor = importlib.import_module(name + ".compositor")
compositor.show_layers(scene, Path(saw["result"], "layers.exr"), True)
render("plate.png", "PNG", "RGB", "8")
files = estimate / "photo.png", estimate.parent / "grain.exr", estimate / "response.cube"
compositor.show_render(scene, *files)
render("cycles.png", "PNG", "RGB", "8")
scene.render.use_compositing = False
render("insertion.exr", "OPEN_EXR", "RGBA", "32")
scene.objects["photo ground"].hide_render = True
render("object.exr", "OPEN_EXR", "RGBA", "32")
scene.objects["photo ground"].hide_render = car.hide_render = True
scene.render.use_compositing = True
compositor.show_render(scene, files[0], Path(out, "none"), Path(out, "response.cube"))
render("empty.png", "PNG", "RGB", "8")
Path(out, "saw.json").write_text(json.dumps(saw))
os._exit(0)  # bpy 4.2.0 crashes while Python unloads it
"""
IN_BLENDER = pytest.mark.skipif(
    BLENDER is None, reason="no Blender: name a Python with bpy in WARPIR_BLENDER_PYTHON"
)
WIDTH = int(os.environ.get("WARPIR_BLENDER_WIDTH", "320"))
"""Of the photo [px]."""


@pytest.fixture(scope="module")
def seen(extension: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    """What Blender's session left behind, and what it said."""
    assert BLENDER is not None
    out = tmp_path_factory.mktemp("blender")
    with Image.open(DEMO / "photo.png") as picture:
        size = WIDTH, round(WIDTH * picture.height / picture.width)
        picture.convert("RGB").resize(size).save(out / "photo.png")
    (out / "response.cube").write_bytes(tone_curve_cube(Response(1.3, 0.002).knots(), "a curve"))
    done = subprocess.run(
        [
            *(BLENDER, "-c", DRIVER, str(extension), sys.executable),
            *(str(out / "photo.png"), str(DEMO / "car.glb"), str(out)),
        ],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "BLENDER_USER_RESOURCES": str(out / "user")},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return out, json.loads((out / "saw.json").read_text())


def codes_of(path: Path) -> NDArray[np.int64]:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB")).astype(np.int64)


@IN_BLENDER
@pytest.mark.slow
def test_blender_refuses_in_one_line(seen: tuple[Path, dict[str, Any]]) -> None:
    said = seen[1]
    for name, words in {
        "report": "no report yet",
        "camera": "no camera",
        "photo": "nowhere.jpg",
        "unnamed": "preferences",
        "nowhere": "/nowhere/python",
        "without": "has no warpir",
        "moved": "moved.png",
        "flag": "--fov",
        "norep": "no report",
        "nothing": "Select the object",
    }.items():
        assert words in said[name] and said[name].strip().count("\n") == 0, said[name]
    assert said["busy"] == [False, False]
    assert said["passes"] == ["PASS_THROUGH"] and said["took"] < 0.5
    assert said["cancelled"] == ["CANCELLED", "Cancelled"]
    assert ["label", {"text": "photo.png", "icon": "IMAGE_DATA"}] in said["drawn"]
    assert ["progress", {"factor": 0.25, "text": "object: 1 of 4 %"}] in said["drawn"]


@IN_BLENDER
@pytest.mark.slow
def test_blender_has_the_estimates_camera(seen: tuple[Path, dict[str, Any]]) -> None:
    out, said = seen
    assert said["objects"] == said["again"]
    kinds = [kind for _, kind in said["objects"]]
    assert kinds.count("CAMERA") == 1 and kinds.count("MESH") == 1 and "LIGHT" in kinds
    size = codes_of(out / "photo.png").shape[1::-1]
    cameras = [read_camera(Path(said[n], "camera.json"), size) for n in ("light", "result")]
    corners = np.array(said["corners"]) @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]).T
    for camera in cameras:
        np.testing.assert_allclose(camera.project(corners), said["pixels"], atol=0.02)


@IN_BLENDER
@pytest.mark.slow
def test_blender_renders_what_warpir_composed(seen: tuple[Path, dict[str, Any]]) -> None:
    """Cycles against the layers: object at least .97, shadow .95; the layers to one code.

    The car's windows, which Cycles would bend light by, are made thin walls as in a run's script.
    """
    out, said = seen
    result = Path(said["result"])
    assert json.loads((result / "run.json").read_text())["config"]["reuse"] == said["light"]
    layers = planes_of(result / "layers.exr")
    fg, plate = stacked(layers, "fg.", "RGB"), stacked(layers, "plate.", "RGB")
    shadow, matte = stacked(layers, "shadow.", "RGB"), layers["matte.A"]
    alone = stacked(planes_of(out / "object.exr"), "", "RGBA")
    overlap = np.minimum(matte, alone[..., 3]).sum() / np.maximum(matte, alone[..., 3]).sum()
    assert overlap > 0.98
    # The picture ends at white, which the layers do too
    inside = (matte > 0.999) & (alone[..., 3] > 0.999)
    pair = fg[inside].ravel(), np.clip(alone[inside][:, :3], 0.0, 1.0).ravel()
    of_object = np.corrcoef(*pair)[0, 1]
    insertion = stacked(planes_of(out / "insertion.exr"), "", "RGBA")
    outside = (matte == 0.0) & (alone[..., 3] == 0.0)
    ours = (plate * (1.0 - shadow))[outside].mean(axis=-1)
    theirs = (plate * insertion[..., 3:] - insertion[..., :3])[outside].mean(axis=-1)
    of_shadow = np.corrcoef(ours, theirs)[0, 1]
    print(f"overlap {overlap:.4f}, object {of_object:.4f}, shadow {of_shadow:.4f}")
    assert of_object > 0.97 and of_shadow > 0.95
    # Blender's catcher is grey, near our red: under a blue sky it darkens less than our mean
    np.testing.assert_allclose(theirs.sum(), ours.sum(), rtol=0.15)
    np.testing.assert_allclose(pair[1].mean(), pair[0].mean(), rtol=0.1)

    composite, photo = codes_of(result / "composite.png"), codes_of(out / "photo.png")
    assert np.abs(codes_of(out / "layers.png") - composite).max() <= 1
    as_plate = 255.0 * linear_to_srgb(np.clip(stacked(layers, "", "RGB"), 0.0, 1.0))
    assert np.abs(codes_of(out / "plate.png") - as_plate).max() <= 1.5
    cycles = codes_of(out / "cycles.png")
    changed = (composite != photo).any(axis=-1)
    assert np.corrcoef(cycles[changed].ravel(), composite[changed].ravel())[0, 1] > 0.97
    untouched = insertion[..., 3] == 0.0
    assert untouched.any() and (cycles[untouched] == photo[untouched]).mean() > 0.99
    # Response and its inverse, with nothing in front of the photo
    assert np.abs(codes_of(out / "empty.png") - photo).max() <= 1
