"""What other tools take over: each file by that tool's own formula, or by the tool itself."""

import ast
import hashlib
import importlib.util
import io
import json
import os
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path
from typing import Any

import colour
import numpy as np
import OpenImageIO as oiio
import pytest
from numpy.typing import NDArray
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from tests import oracles
from tests.builders.gltf_files import Builder
from tests.builders.insertions import (
    ALWAYS,
    arguments,
    go,
    read_image,
    read_layers,
    rgb,
    write_inputs,
)
from tests.builders.programs.children import output_of
from tests.builders.programs.llvm import LIBRARY, llvm
from tests.builders.shapes import box_before, camera
from tests.io.images.test_envmap_conventions import radiance, read, threejs
from warpir.app.config import InsertConfig
from warpir.app.inputs import Inputs, read_inputs
from warpir.core.errors import InputError
from warpir.core.latlong import map_directions
from warpir.io import export as handoff
from warpir.io.assets import load_asset
from warpir.io.cameras.reader import read_camera
from warpir.io.export import CUBE_SIZE, tone_curve_cube, web_map
from warpir.look.response import Response
from warpir.mitsuba.scene import write_mitsuba
from warpir.scene.asset import Asset, Material, Texture, TextureSlot
from warpir.scene.lamps import Sun
from warpir.scene.light import fibonacci
from warpir.scene.tone_curves import ToneKnots

HANDED = {
    "blender_setup.py",
    "envmap_web.hdr",
    "object.glb",
    "photo.png",
    "tone_curve_object.cube",
    "tone_curve_shadow.cube",
    "viewer.html",
}
CUBE_ABS = 1e-5
"""Eight decimals in the file, float32 knots in front of it."""
PIXEL = 1e-3
"""Of projections by each tool's formula [px]."""
SAMPLES = 512
"""Of the picture that Blender and Mitsuba are compared with. Of 256 some pixels of Mitsuba's have
not met the sun, and its estimate of their error is too small."""
AROUND = np.array(
    [
        *([1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]),
        *([0.36, 0.8, 0.48], [0.48, -0.8, -0.36], [0.6, 0.64, 0.48]),
    ]
)
"""Unit directions along the axes, up, down and to the sun. At a pole itself all longitudes meet,
and within half a texel of it Cycles mixes in the other pole's row."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Input files, and two runs ``out`` and ``again`` that differ in their seed."""
    folder = tmp_path_factory.mktemp("handoff")
    write_inputs(folder)
    write_light(folder / "lobes.exr")
    for name, seed in (("out", "3"), ("again", "4")):
        argv = arguments(
            folder,
            folder / name,
            light=str(folder / "lobes.exr"),
            place="0.6,0,-5",
            rotate_y="25",
            samples=str(SAMPLES),
            seed=seed,
            device="cpu",
            indirect_limit="0",
            exposure="-1.5",
            denoise="off",  # a denoiser, where there is one, hides what two seeds say of the noise
            asset=str(folder / "box.obj"),
            mitsuba="" if name == "out" else None,
        )
        go(argv, folder / name)
    return folder


def write_light(path: Path) -> None:
    """The four lobes of the conventions' test and a sun; no symmetry of the sphere keeps it."""
    d = map_directions(32, 64)
    sun = np.array([0.6, 0.64, 0.48])
    texels = radiance(d) + 8.0 * np.exp(80.0 * (d @ sun - 1.0))[..., None]
    buffer = oiio.ImageBuf(np.ascontiguousarray(texels, np.float32))
    assert buffer.write(str(path)), buffer.geterror()


def inputs_of(folder: Path, **changes: object) -> Inputs:
    """What such a run reads."""
    fields = {"fov": 60.0, "pitch": -15.0, "camera_height": 1.5, "place": (0.6, 0.0, -5.0)}
    return read_inputs(
        InsertConfig(
            photo=str(folder / "photo.png"),
            asset=str(folder / "box.glb"),
            out=str(folder / "unused"),
            **{**fields, **changes},
        )
    )


def planes_of(path: Path) -> dict[str, NDArray[np.float64]]:
    pixels, names = read_image(path)
    return {name: pixels[..., k].astype(np.float64) for k, name in enumerate(names)}


def stacked(planes: dict[str, NDArray[np.float64]], prefix: str, of: str) -> NDArray[np.float64]:
    return np.stack([planes[prefix + c] for c in of], axis=-1)


# ------------------------------------------------------------------------------- which files


def test_handoff_files_are_listed_and_can_be_left_out(folder: Path, tmp_path: Path) -> None:
    """All in run.json with their sha256; --no-hand-off writes none; --mitsuba needs them."""
    out = folder / "out"
    files = json.loads((out / "run.json").read_text())["files"]
    in_folder = {f"mitsuba/{p.name}" for p in (out / "mitsuba").iterdir()}
    assert {"mitsuba/scene.xml", "mitsuba/render.py", "mitsuba/mesh_000.ply"} <= in_folder
    assert set(files) == {*ALWAYS, *in_folder} and set(ALWAYS) >= HANDED
    for name, digest in files.items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == digest
    plain = tmp_path / "plain"
    go(arguments(folder, plain, no_hand_off="", device="cpu"), plain)
    assert {p.name for p in plain.iterdir()} == {*ALWAYS, "run.json"} - HANDED
    with pytest.raises(InputError, match="--mitsuba"):
        InsertConfig(mitsuba=True, hand_off=False)


HOSTILE = (
    '"""\'\'\'\n--->\n<integrator type="evil"/><!--\x00 ${x} $(touch x) {0} %s \\ -',
    '-->--><!DOCTYPE a SYSTEM "file:///etc/passwd"]]>&lt;&a;--',
    "---><shape type='obj'/>\n__import__('os').system('touch x')#\u202e\ud800",
    "../../evil/--------->",
)


@pytest.mark.case("I17")
@pytest.mark.parametrize("place", range(len(HOSTILE)))
def test_handoff_takes_no_code_from_names(folder: Path, tmp_path: Path, place: int) -> None:
    """Names of an asset, of files and in metadata change no script and no element of the scene."""
    name = HOSTILE[place]
    texts = {}
    for kind, used, stem in (("plain", "name", "asset"), ("hostile", name, "a\n'\"$x {0} --><b")):
        builder = Builder()
        for key in ("materials", "meshes", "nodes", "scenes"):
            builder.json[key][0]["name"] = used
        builder.json["asset"]["copyright"] = used
        (tmp_path / f"{stem}.glb").write_bytes(builder.glb())
        out = tmp_path / kind
        flags = {"asset": str(tmp_path / f"{stem}.glb"), "mitsuba": "", "device": "cpu"}
        go(arguments(folder, out, rotate_y="180", **flags), out)
        scene = out / "mitsuba" / "scene.xml"
        elements = [(e.tag, e.attrib) for e in ET.parse(scene).iter()]
        scripts = (out / "blender_setup.py", out / "mitsuba" / "render.py")
        texts[kind] = (elements, *(path.read_bytes() for path in scripts))
        names = {str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()}
        assert names == {*json.loads((out / "run.json").read_text())["files"], "run.json"}
    assert texts["hostile"] == texts["plain"]
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        ["asset.glb", "a\n'\"$x {0} --><b.glb", "plain", "hostile"]
    )


@pytest.mark.slow
@pytest.mark.case("I19")
def test_handoff_carries_nothing_of_the_photo_but_its_pixels(folder: Path, tmp_path: Path) -> None:
    """No EXIF, GPS, XMP, text or comment of any photo, in no file; no folder but in run.json.

    The pixels are turned as EXIF says.
    """
    exif = Image.Exif()
    exif[0x112] = 8
    exif[0x10F], exif[0x9286] = "SECRET maker", b"ASCII\0\0\0SECRET comment"
    exif.get_ifd(0x8825)[1] = "N"
    exif.get_ifd(0x8825)[29] = "SECRET date"
    texts = PngInfo()
    texts.add_itxt("XML:com.adobe.xmp", "<x:xmpmeta xmlns:x='adobe:ns:meta/'>SECRET</x:xmpmeta>")
    texts.add_text("Comment", "SECRET")
    xmp = b"<x:xmpmeta xmlns:x='adobe:ns:meta/'>SECRET</x:xmpmeta>" * 1000
    codes = np.random.default_rng(2).integers(0, 256, (32, 48, 3), dtype=np.uint8)
    photo = Image.fromarray(codes)
    where = tmp_path / "private place"
    where.mkdir()
    photo.save(where / "a.png", exif=exif, pnginfo=texts)
    photo.save(where / "a.jpg", exif=exif, comment=b"SECRET", xmp=xmp)
    photo.save(where / "a.webp", exif=exif, xmp=xmp, lossless=True)
    photo.save(where / "a.tif", exif=exif, description="SECRET", software="SECRET")
    for file in sorted(where.iterdir()):
        assert b"SECRET" in file.read_bytes()
        out = tmp_path / file.suffix[1:]
        go(arguments(folder, out, photo=str(file), mitsuba="", device="cpu"), out)
        for name in ("photo.png", "composite.png"):
            with Image.open(out / name) as picture:
                assert dict(picture.getexif()) == {} and "exif" not in picture.info
        for path in (p for p in out.rglob("*") if p.is_file()):
            content = path.read_bytes()
            assert b"SECRET" not in content, path
            assert path.name == "run.json" or b"private place" not in content, path
            assert path.name == "run.json" or str(tmp_path).encode() not in content, path
    np.testing.assert_array_equal(read_image(tmp_path / "png/photo.png")[0], np.rot90(codes, 1))


def test_provenance_is_marked_unless_told_otherwise(folder: Path, tmp_path: Path) -> None:
    """The composite's XMP is well-formed and says compositeSynthetic; --no-mark leaves it out."""
    with Image.open(folder / "out" / "composite.png") as picture:
        packet = picture.info["XML:com.adobe.xmp"]
    tree = ET.fromstring(packet)
    kind = tree.find(".//{http://iptc.org/std/Iptc4xmpExt/2008-02-29/}DigitalSourceType")
    assert kind is not None
    assert kind.text == "http://cv.iptc.org/newscodes/digitalsourcetype/compositeSynthetic"
    out = tmp_path / "out"
    go(arguments(folder, out, no_mark="", device="cpu"), out)
    with Image.open(out / "composite.png") as picture:
        assert "XML:com.adobe.xmp" not in picture.info
    with Image.open(folder / "out" / "photo.png") as picture:  # it is no composite
        assert "XML:com.adobe.xmp" not in picture.info


# ------------------------------------------------------------------------------- tone curves


def bent(curves: int) -> ToneKnots:
    raw = np.random.default_rng(5).normal(scale=0.7, size=(curves, 16))
    return ToneKnots(*(k.astype(np.float32) for k in oracles.spline_knots(raw)))


def read_cube(path: Path) -> Any:
    return colour.read_LUT(str(path))


@pytest.mark.parametrize("knots", [bent(1), bent(3), ToneKnots.identity(1)], ids="135")
def test_cube_reads_back_as_the_curve(tmp_path: Path, knots: ToneKnots) -> None:
    """colour-science reads domain [0, 1], three columns, and at its nodes the spline of Durkan."""
    path = tmp_path / "curve.cube"
    path.write_bytes(tone_curve_cube(knots, "about"))
    lut = read_cube(path)
    table = np.asarray(lut.table)
    np.testing.assert_array_equal(lut.domain, [[0, 0, 0], [1, 1, 1]])
    assert table.shape == (CUBE_SIZE, 3) and lut.comments == ["about"]
    x = np.linspace(0.0, 1.0, CUBE_SIZE)
    for k in range(3):
        row = min(k, len(knots.x) - 1)
        exact = oracles.spline(x, *(a[row] for a in knots.arrays()))[0]
        np.testing.assert_allclose(table[:, k], exact, atol=CUBE_ABS)
    between = np.random.default_rng(1).uniform(size=(500, 3))
    exact = np.stack(
        [knots.evaluate(between[:, k])[:, min(k, len(knots.x) - 1)] for k in range(3)], axis=-1
    )
    np.testing.assert_allclose(lut.apply(between), exact, atol=CUBE_ABS)


def test_cube_of_a_run_is_the_identity_and_says_what_it_maps(folder: Path) -> None:
    """Curves that nothing bent change nothing; the comment names operator and layer."""
    for name, layer in (("object", "fg.RGB"), ("shadow", "shadow.RGB")):
        lut = read_cube(folder / "out" / f"tone_curve_{name}.cube")
        x = np.linspace(0.0, 1.0, CUBE_SIZE)
        np.testing.assert_allclose(lut.table, np.stack([x] * 3, -1), atol=CUBE_ABS)
        assert layer in lut.comments[0] and "clipped" in lut.comments[0]


def test_response_is_a_step_of_its_own(folder: Path) -> None:
    """`response.cube` and `curves.json` take the object of a run without it to that with it."""
    changes = {"light": str(folder / "lobes.exr"), "sharpness": "off", "grain": "off"}
    runs = {}
    for name, response in (("plain", "off"), ("bent", "1.3")):
        out = folder / name
        runs[name] = go(arguments(folder, out, response=response, **changes), out)
    before, after = (read_layers(folder / name / "layers.exr") for name in runs)
    seen = before["fg.A"] > 0.9
    np.testing.assert_array_equal(before["fg.A"], after["fg.A"])
    lut = read_cube(folder / "bent" / "response.cube")
    share = before["fg.A"][seen][:, None]
    bent = lut.apply(rgb(before, "fg.")[seen] / share) * share
    np.testing.assert_allclose(rgb(after, "fg.")[seen], bent, atol=1e-3)
    assert np.abs(rgb(after, "fg.")[seen] - rgb(before, "fg.")[seen]).max() > 0.01
    knots = json.loads((folder / "bent" / "curves.json").read_text())["response"]
    np.testing.assert_allclose(knots["y"], Response(1.3).knots().y)
    assert runs["bent"].record["measured"]["look"]["response"]["exponent"] == 1.3
    assert "contrast 1.30" in (folder / "bent" / "report.html").read_text("utf-8")
    assert not (folder / "plain" / "response.cube").exists()
    assert "response" not in json.loads((folder / "plain" / "curves.json").read_text())


# -------------------------------------------------------------------------------------- light


def test_web_map_is_seen_right_by_three_js(folder: Path) -> None:
    """By three.js' formula the file shows our light; mirrored it does not."""
    web = read_image(folder / "out" / "envmap_web.hdr")[0]
    ours = read_image(folder / "out" / "envmap.exr")[0]
    d = fibonacci(100)
    height, width = ours.shape[:2]
    x, y, z = d.T
    wanted = read(ours, np.arctan2(x, -z) / (2.0 * np.pi), np.arccos(y) / np.pi)
    seen = read(web, *threejs(d))
    error = np.abs(seen - wanted).max(axis=-1) / wanted.max(axis=-1)
    assert error.max() < 0.02  # shared exponents: 8 bits of the largest channel
    mirrored = read(web[:, ::-1], *threejs(d))
    assert (np.abs(mirrored - wanted).max(axis=-1) / wanted.max(axis=-1)).max() > 0.5
    assert web.shape == (height, width, 3)


def test_web_map_fits_half_precision() -> None:
    """A sun of 1e6 is clamped and counted, the rest is left alone."""
    texels = np.ones((8, 16, 3), np.float32)
    texels[2, 3] = (1e6, 5.0, 65504.0)
    web, clamped = web_map(texels)
    assert clamped == 1 and np.isfinite(web.astype(np.float16)).all()
    assert sorted(np.unique(web)) == [1.0, 5.0, 65504.0]
    np.testing.assert_array_equal(web[2, 3 + 4], (65504.0, 5.0, 65504.0))


# ------------------------------------------------------------------------------------ Blender


def constants(script: str) -> dict[str, Any]:
    """Values of the names in capitals that the script assigns."""
    found: dict[str, Any] = {}
    for node in ast.parse(script).body:
        if isinstance(node, ast.Assign) and not isinstance(node.value, ast.Call):
            names = ast.unparse(node.targets[0]).strip("()").split(", ")
            if all(name.isupper() for name in names):
                value = ast.literal_eval(node.value)
                found.update(zip(names, value if len(names) > 1 else [value], strict=True))
    return found


def seen_by_blender(values: dict[str, Any], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels of Z-up points by Blender's own camera: BKE_camera_params_compute_viewplane, AUTO."""
    width, height = values["WIDTH"], values["HEIGHT"]
    c2w = np.array(values["CAMERA_TO_WORLD"])
    local = np.c_[points, np.ones(len(points))] @ np.linalg.inv(c2w).T
    longer = max(width, height)
    focal = 0.5 * longer / np.tan(0.5 * values["ANGLE"])
    x = focal * local[:, 0] / -local[:, 2] - values["SHIFT_X"] * longer
    y = focal * local[:, 1] / -local[:, 2] - values["SHIFT_Y"] * longer
    return np.stack([0.5 * width + x, 0.5 * height - y], axis=-1)


@pytest.mark.parametrize("ground", [None, (0.1, 1.0, -0.05, 0.2)])
def test_blender_script_is_short_and_its_numbers_are_ours(
    folder: Path, ground: tuple[float, ...] | None
) -> None:
    """At most 120 lines, bare file names, our projection, and a ground that lies in the plane."""
    inputs = inputs_of(folder, ground=ground)
    sun = Sun(
        np.array([0.6, 0.64, 0.48]), np.array([9.0, 8.0, 7.0]), 0.02, np.array([1.0, 2.0, 3.0])
    )
    scene = inputs.asset, inputs.camera, inputs.placement
    script = handoff.blender_setup(*scene, "envmap.exr", [sun])
    compile(script, "blender_setup.py", "exec")
    window = replace(inputs.asset, materials=(Material(transmission=1.0),))
    for asset, is_thin in ((window, True), (inputs.asset, False)):
        built = handoff.blender_setup(asset, *scene[1:], "envmap.exr", [sun])
        compile(built, "blender_setup.py", "exec")
        assert ("thin_walls(" in built) == is_thin
    assert script.count("\n") <= 120 and "$" not in script and str(folder) not in script
    values = constants(script)
    assert (values["PHOTO"], values["ENVMAP"], values["OBJECT"]) == (
        "photo.png",
        "envmap.exr",
        "object.glb",
    )
    assert values["SUNS"] == [((0.6, -0.48, 0.64), (9.0, 8.0, 7.0), 0.02, (1.0, 2.0, 3.0))]
    low, high = inputs.asset.bounds()
    box = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (0.1,)]
    )
    world = box @ inputs.placement.asset_to_world[:3, :3].T + inputs.placement.asset_to_world[:3, 3]
    z_up = world @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
    np.testing.assert_allclose(
        seen_by_blender(values, z_up), inputs.camera.project(world), atol=PIXEL
    )
    half = 0.5 * values["GROUND_SIZE"]
    corners = np.array([[x, y, 0.0, 1.0] for x in (-half, half) for y in (-half, half)])
    x, y, z, _ = np.array(values["GROUND_TO_WORLD"]) @ corners.T
    plane = inputs.placement.ground
    np.testing.assert_allclose(np.c_[x, z, -y] @ plane[:3] + plane[3], 0.0, atol=1e-9)
    assert half > 10.0 * np.linalg.norm(high - low)
    assert (np.linalg.norm(np.c_[x, z, -y] - world.mean(axis=0), axis=1) < 1.6 * half).all()


def test_object_stands_in_the_world(folder: Path) -> None:
    inputs = inputs_of(folder, rotate_y=25.0)
    placed = load_asset(folder / "out" / "object.glb")
    matrix = inputs.placement.asset_to_world
    expected = inputs.asset.primitives[0].positions @ matrix[:3, :3].T + matrix[:3, 3]
    found = placed.primitives[0].positions
    np.testing.assert_allclose(
        np.sort(found.round(5), axis=0), np.sort(expected.round(5), axis=0), atol=2e-5
    )


BLENDER = os.environ.get("WARPIR_BLENDER_PYTHON")
DRIVER = """
import os, runpy, sys
import bpy
from mathutils import Vector
script, out = sys.argv[1:3]
runpy.run_path(script, run_name="__main__")
scene = bpy.context.scene
scene.cycles.device, scene.cycles.samples = "CPU", 256
scene.cycles.pixel_filter_type, scene.cycles.use_denoising = "BOX", False
scene.cycles.sample_clamp_indirect = 0.0
scene.cycles.max_bounces = 1
image = scene.render.image_settings
image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGBA", "32"
scene.render.filepath = out + "/insertion.exr"
bpy.ops.render.render(write_still=True)
bpy.data.objects["photo ground"].hide_render = True
scene.render.filepath = out + "/object.exr"
bpy.ops.render.render(write_still=True)
for thing in scene.objects:
    thing.hide_render = True
scene.render.film_transparent = False
scene.render.resolution_x = scene.render.resolution_y = 4
scene.cycles.samples = 4
scene.camera.data.angle, scene.camera.data.shift_x, scene.camera.data.shift_y = 0.01, 0.0, 0.0
for k, direction in enumerate(eval(sys.argv[3])):
    scene.camera.matrix_world = Vector(direction).to_track_quat("-Z", "Y").to_matrix().to_4x4()
    scene.render.filepath = out + f"/world_{k}.exr"
    bpy.ops.render.render(write_still=True)
os._exit(0)  # bpy 4.2.0 crashes while Python unloads it
"""


@pytest.mark.skipif(
    BLENDER is None, reason="no Blender: name a Python with bpy in WARPIR_BLENDER_PYTHON"
)
def test_blender_shows_the_same_insertion(folder: Path, tmp_path: Path) -> None:
    """The script in Blender itself: silhouette, colours, shadow, and the light all around."""
    assert BLENDER is not None
    d = np.concatenate([AROUND, fibonacci(3)])
    z_up = [(float(x), float(-z), float(y)) for x, y, z in d]
    script = folder / "out" / "blender_setup.py"
    output_of(DRIVER, str(script), str(tmp_path), repr(z_up), python=BLENDER)
    # Light: the map read by the file's own convention, 2 % of reading and of a camera's 0.6 degrees
    texels = read_image(folder / "out" / "envmap.exr")[0]
    x, y, z = d.T
    u, v = np.arctan2(x, -z) / (2.0 * np.pi), np.arccos(np.clip(y, -1.0, 1.0)) / np.pi
    seen = np.array(
        [
            stacked(planes_of(tmp_path / f"world_{k}.exr"), "", "RGB").mean(axis=(0, 1))
            for k in range(len(d))
        ]
    )
    np.testing.assert_allclose(seen, read(texels, u, v), rtol=0.02, atol=2e-3)
    assert np.abs(seen - read(texels[:, ::-1], u, v)).max() > 0.5
    # The object: its coverage as a soft set, its colours on all sides
    theirs = stacked(planes_of(tmp_path / "object.exr"), "", "RGBA")
    layers = planes_of(folder / "out" / "layers.exr")
    matte = layers["matte.A"]
    overlap = np.minimum(matte, theirs[..., 3]).sum() / np.maximum(matte, theirs[..., 3]).sum()
    assert overlap > 0.97
    inside = matte > 0.999
    pair = stacked(layers, "fg.", "RGB")[inside], theirs[inside][:, :3]
    np.testing.assert_allclose(pair[1].mean(axis=0), pair[0].mean(axis=0), rtol=0.05)
    assert np.corrcoef(pair[0].ravel(), pair[1].ravel())[0, 1] > 0.99
    # The shadow: Blender's catcher is grey, so the mean of the colours is what can agree
    plate, shadow = stacked(layers, "plate.", "RGB"), stacked(layers, "shadow.", "RGB")
    ground = stacked(planes_of(tmp_path / "insertion.exr"), "", "RGBA")
    outside = matte == 0.0
    ours = (plate * (1.0 - shadow))[outside].sum()
    seen = (plate * ground[..., 3:] - ground[..., :3])[outside].sum()
    np.testing.assert_allclose(seen, ours, rtol=0.1)


# ------------------------------------------------------------------------------------ Mitsuba


MITSUBA = importlib.util.find_spec("mitsuba") is not None
WITHOUT_MITSUBA = pytest.mark.skipif(not MITSUBA, reason="Mitsuba is not installed (bench extra)")


def test_mitsuba_scene_is_xml_and_its_meshes_are_the_placed_ones(folder: Path) -> None:
    """Well-formed, names files that are there; the PLY holds the object in world coordinates."""
    import trimesh

    home = folder / "out" / "mitsuba"
    tree = ET.parse(home / "scene.xml").getroot()
    names = [s.get("value") for s in tree.iter("string") if s.get("name") == "filename"]
    assert names == ["envmap.exr", "mesh_000.ply"]
    assert all((home / str(name)).is_file() for name in names)
    compile((home / "render.py").read_text(), "render.py", "exec")
    mesh = trimesh.load(home / "mesh_000.ply", process=False)
    bounds = load_asset(folder / "out" / "object.glb").bounds()
    np.testing.assert_allclose(mesh.bounds, bounds, atol=1e-5)


class Kept:
    """Stands for the output folder: keeps the files by name."""

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}

    def write_bytes(self, name: str, content: bytes) -> None:
        self.files[name] = content

    def write_exr(self, name: str, planes: object) -> None:
        """Leave the light out."""


def test_mitsuba_scene_moves_textures_and_cuts_masks() -> None:
    """``to_uv`` is a matrix of 4 x 4 whose last column moves; MASK is written as it covers."""
    view = camera(32, 24, 40.0, (0.0, 1.6, 0.0))
    inputs = box_before(
        view, np.full((24, 32, 3), 0.5, np.float32), np.zeros((24, 32, 3), np.uint8)
    )
    pixels = np.full((1, 4, 4), 255, np.uint8)
    pixels[0, :, 3] = 100, 127, 128, 255
    slot = TextureSlot(0, transform=(2.0, 0.5, 0.25, -0.5, 3.0, 0.75))
    cut = Material(base_color_texture=slot, alpha_mode="MASK", alpha_cutoff=0.5)
    shape = replace(inputs.asset.primitives[0], uv0=np.zeros((8, 2), np.float32))
    asset = Asset("box", (shape,), (cut,), (Texture(pixels),))
    kept = Kept()
    write_mitsuba(kept, replace(inputs, asset=asset), np.ones((8, 16, 3), np.float32), 3, 1)  # type: ignore[arg-type]
    tree = ET.fromstring(kept.files["mitsuba/scene.xml"])
    textures = {t.get("name"): t for t in tree.iter("texture")}
    for texture in textures.values():
        (matrix,) = texture.iter("matrix")
        to_uv = np.array(str(matrix.get("value")).split(), float).reshape(4, 4)
        moved = to_uv @ [0.3, 0.6, 0.0, 1.0]
        assert moved[:2] == pytest.approx([2 * 0.3 + 0.5 * 0.6 + 0.25, -0.5 * 0.3 + 3 * 0.6 + 0.75])
    named = {s.get("name"): s.get("value") for s in textures["opacity"].iter("string")}
    with Image.open(io.BytesIO(kept.files[f"mitsuba/{named['filename']}"])) as picture:
        assert np.asarray(picture).ravel().tolist() == [0, 0, 255, 255]


IN_MITSUBA = """
import json, sys
import numpy as np
import mitsuba as mi
out, directions = sys.argv[1], np.array(json.loads(sys.argv[2]))
mi.set_variant("scalar_rgb")

# Light: the emitter's own lookup, of the file on its rows
light = mi.load_dict({"type": "envmap", "filename": out + "/mitsuba/envmap.exr"})
def radiance(d):
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(*d)
    return list(light.eval(si))
seen = [radiance(d) for d in directions]

# Layers, as Mitsuba reads them
bitmap = mi.Bitmap(out + "/layers.exr")
names, pixels = [f.name for f in bitmap.struct_()], np.array(bitmap).astype(np.float32)
np.savez(out + "/../seen.npz", **{n.replace(".", "_"): pixels[..., k] for k, n in enumerate(names)})

# The plain scene: silhouette and colours
scene = mi.load_file(out + "/mitsuba/scene.xml")
np.save(out + "/../plain.npy", np.array(mi.render(scene, spp=64)))
print(json.dumps(seen))
"""


@WITHOUT_MITSUBA
def test_mitsuba_reads_light_layers_and_scene(folder: Path) -> None:
    """In a process of its own: the real emitter, the real EXR reader, the real scene parser."""
    d = np.concatenate([AROUND, fibonacci(30)])
    out = folder / "out"
    printed = output_of(IN_MITSUBA, str(out), json.dumps(d.tolist()))
    texels = read_image(out / "envmap.exr")[0]
    x, y, z = d.T
    u, v = np.arctan2(x, -z) / (2.0 * np.pi), np.arccos(np.clip(y, -1.0, 1.0)) / np.pi
    seen = np.array(json.loads(printed.splitlines()[-1]))
    # Bilinear of bilinear, on rows 16 times as fine: only the kinks at our texel centres are cut
    np.testing.assert_allclose(seen, read(texels, u, v), rtol=0.003, atol=1e-4 * texels.max())
    for wrong in (texels[:, ::-1], np.roll(texels, 16, axis=1), texels[::-1]):
        assert np.abs(seen - read(wrong, u, v)).max() > 0.5

    layers = np.load(folder / "seen.npz")

    def rgb(prefix: str) -> NDArray[np.float32]:
        return np.stack([layers[prefix + c] for c in "RGB"], axis=-1)

    one = np.float32(1.0)
    composite = rgb("fg_") + (one - layers["fg_A"][..., None]) * rgb("plate_") * rgb("shadow_")
    codes = np.round(np.clip(composite ** np.float32(1.0 / 2.2), 0.0, 1.0).astype(float) * 255.0)
    np.testing.assert_array_equal(codes, read_image(out / "composite.png")[0])

    plain = np.load(folder / "plain.npy").astype(np.float64)
    ours = planes_of(out / "layers.exr")
    matte = ours["matte.A"]
    overlap = np.minimum(matte, plain[..., 3]).sum() / np.maximum(matte, plain[..., 3]).sum()
    assert overlap > 0.98
    inside = matte > 0.999
    means = stacked(ours, "fg.", "RGB")[inside].mean(axis=0), plain[inside][:, :3].mean(axis=0)
    # `principled` is not glTF's material, only near it
    np.testing.assert_allclose(means[1], means[0], rtol=0.1)


@WITHOUT_MITSUBA
@pytest.mark.skipif(llvm() is None, reason=f"no LLVM for Mitsuba: name it in {LIBRARY}")
def test_mitsuba_renders_our_insertion_to_within_its_noise(folder: Path) -> None:
    """``python mitsuba/render.py``: no pixel differs by more than both renderers' noise."""
    out = folder / "out"
    script = str(out / "mitsuba" / "render.py")
    code = f"import runpy; runpy.run_path({script!r}, run_name='__main__')"
    output_of(code, "--samples", str(SAMPLES), **{LIBRARY: str(llvm())})
    theirs = planes_of(out / "mitsuba" / "composite.exr")
    first, second = (planes_of(folder / name / "layers.exr") for name in ("out", "again"))

    def composite(planes: dict[str, NDArray[np.float64]]) -> NDArray[np.float64]:
        behind = stacked(planes, "plate.", "RGB") * stacked(planes, "shadow.", "RGB")
        return stacked(planes, "fg.", "RGB") + (1.0 - planes["fg.A"][..., None]) * behind

    pair = composite(first), composite(second)
    error = stacked(theirs, "error.", "RGB")
    mean = 0.5 * (pair[0] + pair[1])
    difference = stacked(theirs, "", "RGB") - mean
    matte = first["matte.A"]
    for mask in (matte > 0.999, (matte == 0.0) & (error > 0.0).all(axis=-1)):
        assert mask.sum() > 30
        # Ours from two seeds: of one pixel that is no estimate, of a region it is
        ours = 0.5 * np.sqrt(np.square(pair[0] - pair[1])[mask].mean(axis=0))
        z = difference[mask] / np.sqrt(error[mask] ** 2 + ours**2 + HALF_STEP**2)
        assert (np.abs(z) < 4.0).mean() > 0.9975
        assert z.std() < 1.3
        bias = np.abs(difference[mask].mean(axis=0))
        assert (bias < 0.005 * mean[mask].mean(axis=0)).all()
    view = read_camera(out / "camera.json", (48, 32))
    assert (view.width, view.height) == difference.shape[1::-1]


OF_A_PLATE = """
import sys
from pathlib import Path
import numpy as np
from warpir.mitsuba.render import Composite, write_composite

mean = np.linspace(0.0, 1.2, 48).reshape(4, 4, 3)
write_composite(Path(sys.argv[1]), Composite(mean, 0.0 * mean), True)
"""


@WITHOUT_MITSUBA
@pytest.mark.skipif(llvm() is None, reason=f"no LLVM for Mitsuba: name it in {LIBRARY}")
def test_mitsuba_encodes_a_linear_plate_as_the_run_does(tmp_path: Path) -> None:
    """By the sRGB curve, which photos are not linearised by."""
    output_of(OF_A_PLATE, str(tmp_path / "o"), **{LIBRARY: str(llvm())})
    encoded = colour.cctf_encoding(np.linspace(0.0, 1.2, 48).clip(max=1.0))
    codes = np.round(255.0 * encoded).reshape(4, 4, 3)
    np.testing.assert_array_equal(read_image(tmp_path / "o.png")[0][..., :3], codes)


HALF_STEP = 2.5e-4
"""Half a step of half numbers below 1: what the layers are rounded to."""


ON_A_SLOPE = """
from dataclasses import replace
import numpy as np
from tests.builders.shapes import camera, quad
from warpir.mitsuba.render import Setting, shadow_ratio
from warpir.scene.asset import Asset, Material

card = quad((0.0, 0.5, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0))
asset = Asset("card", (card,), (Material(metallic=0.0, double_sided=True),))
view = camera(16, 12, 24.0, (0.0, 3.0, 3.0), pitch=-45.0)
texels = np.ones((8, 16, 3), np.float32)
slope = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
slope *= np.linalg.det(slope)
for turn in (np.eye(3), slope):
    matrix, c2w = np.eye(4), view.c2w.copy()
    matrix[:3, :3], c2w[:3] = turn, turn @ c2w[:3]
    setting = Setting(asset, matrix, replace(view, c2w=c2w), texels)
    ground = (*turn[:, 1], 0.0)
    direct, whole = (shadow_ratio(setting, 1024, 1, ground, depth).mean for depth in (0, 2))
    print((whole - direct).mean())
"""


@WITHOUT_MITSUBA
@pytest.mark.skipif(llvm() is None, reason=f"no LLVM for Mitsuba: name it in {LIBRARY}")
def test_mitsuba_throws_light_on_sloping_ground() -> None:
    """Turned as a whole under an even sky, a card throws the same light on its ground."""
    printed = output_of(ON_A_SLOPE, **{LIBRARY: str(llvm())})
    level, sloping = map(float, printed.split()[-2:])
    assert sloping == pytest.approx(level, rel=0.05)


UNDER_A_TURNED_MAP = """
from dataclasses import replace
import numpy as np
from tests.builders.shapes import camera, quad
from warpir.mitsuba.render import Setting, foreground
from warpir.scene.asset import Asset, Material, Texture, TextureSlot

codes = np.array([[[220, 128, 200, 255]]], np.uint8)
card = quad((0.0, 1.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.5, 0.0))
card = replace(card, uv0=(card.positions[:, :2] * [1.0, -1.0]).astype(np.float32))
leaning = Material(metallic=0.0, double_sided=True, normal_texture=TextureSlot(0))
slot = TextureSlot(0, transform=(0.0, 1.0, 0.0, -1.0, 0.0, 0.0))
# As rough as that no lobe is longer than wide
brushed = replace(leaning, anisotropy=0.8, anisotropy_texture=slot)
texels = np.ones((8, 16, 3), np.float32)
texels[:, :4] = 20.0
for material in (leaning, brushed):
    asset = Asset("card", (card,), (material,), (Texture(codes),))
    setting = Setting(asset, np.eye(4), camera(8, 8, 24.0, (0.0, 1.0, 3.0)), texels)
    print(foreground(setting, 1, 256, 1).mean.mean())
"""


@WITHOUT_MITSUBA
@pytest.mark.skipif(llvm() is None, reason=f"no LLVM for Mitsuba: name it in {LIBRARY}")
def test_mitsuba_leans_a_normal_map_along_its_own_coordinates() -> None:
    """A turned texture of anisotropy does not turn the normal map with it."""
    printed = output_of(UNDER_A_TURNED_MAP, **{LIBRARY: str(llvm())})
    plain, brushed = map(float, printed.split()[-2:])
    assert brushed == pytest.approx(plain, rel=0.02)
