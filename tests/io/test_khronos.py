"""Every GLB that we write passes the Khronos validator, and so do the reader's valid fixtures.

Two findings are let through, by name. MESH_PRIMITIVE_GENERATED_TANGENT_SPACE: a normal map without
tangents is what the asset has; we do not make tangents up on writing. UNUSED_OBJECT and
UNUSED_MESH_TANGENT are remarks on attributes that no texture reads, which are kept nevertheless.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.builders.gltf_files import CORNERS, NORMALS, UVS, Builder, png
from tests.builders.programs.khronos import validate
from tests.development_data import MESHES, needs_shared
from tests.io.test_gltf import REAL, TANGENTS, instanced, node, skinned, sparse
from tests.io.test_gltf_writer import EXTENDED, IDENTITY, everything, extended, patch, placed
from warpir import demo
from warpir.io.assets import load_asset
from warpir.io.gltf.writer import write_glb
from warpir.scene.asset import Material
from warpir.scene.camera import camera_from_fov

REMARKS = {"UNUSED_OBJECT", "UNUSED_MESH_TANGENT"}
CAMERA = replace(camera_from_fov(640, 480, 50.0, -8.0, 1.6), cx=300.0)


def assert_valid(folder: Path, files: dict[str, bytes], made_tangents: bool = False) -> None:
    """Assert that the validator has no error and no warning beyond those named above."""
    for name, found in validate(folder, files).items():
        assert found["error"] == [], name
        codes = {line.split()[0] for line in found["warning"]}
        allowed = {"MESH_PRIMITIVE_GENERATED_TANGENT_SPACE"} if made_tangents else set()
        assert codes <= allowed, (name, found["warning"])
        remarks = {line.split()[0] for line in found["information"] + found["hint"]}
        assert remarks <= REMARKS, (name, found)


def test_validator_finds_a_planted_fault(tmp_path: Path) -> None:
    """The validator is really asked: a count that lies is an error."""
    content = write_glb(everything(), IDENTITY)
    wrong = content.replace(b'"count":7', b'"count":6', 1)
    found = validate(tmp_path, {"good": content, "wrong": wrong})
    assert found["good"]["error"] == [] and found["wrong"]["error"] != []


def test_written_assets_are_valid(tmp_path: Path) -> None:
    """All attributes, all material extensions, cameras, placements, and the demo's car."""
    files = {
        "everything": write_glb(everything(), IDENTITY),
        "placed with a camera": write_glb(everything(), placed(), CAMERA),
        "the demo's car": demo.ASSET.read_bytes(),
    }
    for name, (material, _) in EXTENDED.items():
        files[name] = write_glb(extended(material), placed(), CAMERA)
    bare = replace(patch(4, 0, full=False), uv1=UVS)
    files["second UV set only"] = write_glb(
        replace(extended(Material()), primitives=(bare,)), IDENTITY
    )
    assert_valid(tmp_path, files)


@needs_shared
@pytest.mark.parametrize("name", REAL)
def test_real_assets_are_valid_when_written(name: str, tmp_path: Path) -> None:
    """What was read from other tools' files is valid once we have written it."""
    asset = load_asset(MESHES / name)
    # A megapixel of zeros is as valid as a picture, and written in no time.
    small = tuple(replace(t, pixels=t.pixels[:4, :4]) for t in asset.textures)
    content = write_glb(replace(asset, textures=small), placed(), CAMERA)
    assert_valid(tmp_path, {name: content}, made_tangents=True)


def test_fixtures_of_the_reader_are_valid(tmp_path: Path) -> None:
    """The small files that the reader must load are correct glTF: loading them means something."""
    files: dict[str, Builder] = {"plain": Builder()}

    def add(name: str) -> Builder:
        files[name] = Builder()
        return files[name]

    textured = add("textures")
    textured.base_color(wrapS=33071, wrapT=33648)
    textured.material["normalTexture"] = {"index": textured.texture(), "scale": 0.5}
    textured.attribute("TANGENT", TANGENTS)
    second = add("second UV set, transformed")
    second.attribute("TEXCOORD_1", UVS)
    second.base_color()["extensions"] = {"KHR_texture_transform": {"scale": [2, 3], "texCoord": 1}}
    second.json["extensionsUsed"] = ["KHR_texture_transform"]
    quantised = add("quantised")
    quantised.json["extensionsUsed"] = ["KHR_mesh_quantization"]
    quantised.json["extensionsRequired"] = ["KHR_mesh_quantization"]
    quantised.attribute("POSITION", (CORNERS * 255).astype("H"), stride=8)
    quantised.attribute("NORMAL", (NORMALS * 127).astype("b"), normalized=True, stride=4)
    node(scale=[1 / 255] * 3)(quantised)
    sparse([2], CORNERS[2:3])(add("sparse"))
    instanced(TRANSLATION=CORNERS, SCALE=np.ones((4, 3), "f"))(add("instances"))
    skin = [{"children": [2], "scale": [2, 2, 2]}, {"translation": [0, 0, 3]}]
    skinned([[1, 0], [1, 0], [0.5, 0.5], [0, 1]], skin)(add("skin"))
    webp = add("WebP")
    webp.base_color({"bufferView": webp.view(png(kind="WEBP")), "mimeType": "image/webp"})
    webp.json["textures"][0] = {"extensions": {"EXT_texture_webp": {"source": 0}}}
    webp.json["extensionsUsed"] = webp.json["extensionsRequired"] = ["EXT_texture_webp"]
    add("fan").primitive.update(mode=6, indices=files["fan"].accessor(np.array([0, 1, 2, 3], "B")))
    for name, found in validate(tmp_path, {k: b.glb() for k, b in files.items()}).items():
        assert found["error"] == [], name
