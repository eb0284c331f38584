"""The nodes for ComfyUI, loaded as ComfyUI loads custom nodes, and called as it calls them."""

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from tests.builders.insertions import write_inputs
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.core.errors import InputError

FOLDER = Path(__file__).resolve().parents[2] / "integrations/comfyui"
OWN = {"LoadImage": ("IMAGE", "MASK"), "PreviewImage": (), "SaveImage": ()}
"""ComfyUI's own nodes in the example, and what they return."""


@pytest.fixture(scope="module")
def nodes() -> ModuleType:
    """The folder, under a name that is its path, as ComfyUI's loader has it."""
    name = str(FOLDER).replace(".", "_x_")
    spec = importlib.util.spec_from_file_location(name, FOLDER / "__init__.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results are written here."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def called(nodes: ModuleType, name: str, **inputs: Any) -> tuple[Any, ...]:
    kind = nodes.NODE_CLASS_MAPPINGS[name]
    with torch.inference_mode():  # as ComfyUI runs every node
        result: tuple[Any, ...] = getattr(kind(), kind.FUNCTION)(**inputs)
    assert len(result) == len(kind.RETURN_TYPES)
    types = {"FLOAT": float, "STRING": str, "IMAGE": torch.Tensor, "MASK": torch.Tensor}
    for value, stated in zip(result, kind.RETURN_TYPES, strict=True):
        assert isinstance(value, types[stated]), (value, stated)
        if stated == "IMAGE":
            assert value.dtype == torch.float32 and value.ndim == 4 and value.shape[3] == 3
    return result


def image_of(path: Path) -> torch.Tensor:
    with Image.open(path) as picture:
        return torch.from_numpy(np.asarray(picture.convert("RGB"), np.float32) / 255.0)[None]


def test_nodes_state_what_comfyui_asks_for(nodes: ModuleType) -> None:
    assert set(nodes.NODE_CLASS_MAPPINGS) == set(nodes.NODE_DISPLAY_NAME_MAPPINGS)
    for kind in nodes.NODE_CLASS_MAPPINGS.values():
        assert kind.CATEGORY == "warpir" and callable(getattr(kind, kind.FUNCTION))
        assert len(kind.RETURN_TYPES) == len(kind.RETURN_NAMES) == len(kind.OUTPUT_TOOLTIPS)
        groups = kind.INPUT_TYPES()
        assert set(groups) <= {"required", "optional"}
        for _, about in (entry for group in groups.values() for entry in group.values()):
            assert about["tooltip"]


def test_a_place_is_rounded_to_thousandths(nodes: ModuleType) -> None:
    """The front end rounds what is typed to the step's decimals: 1.3 pixels of 1280, not 12.8."""
    known = nodes.NODE_CLASS_MAPPINGS["WarpirInsertObject"].INPUT_TYPES()["optional"]
    assert all(known[name][1]["step"] == 0.001 for name in ("at_x", "at_y"))


def test_example_fits_the_nodes(nodes: ModuleType) -> None:
    """Each link carries what its input takes, and nothing that is required is missing."""
    graph = json.loads((FOLDER / "insert_object.json").read_text())
    known = nodes.NODE_CLASS_MAPPINGS
    for node in graph.values():
        if node["class_type"] in OWN:
            continue
        groups = known[node["class_type"]].INPUT_TYPES()
        stated = {**groups["required"], **groups.get("optional", {})}
        assert set(groups["required"]) <= set(node["inputs"]) <= set(stated)
        for name, value in node["inputs"].items():
            if isinstance(value, list):
                source = graph[value[0]]["class_type"]
                returned = OWN.get(source) or known[source].RETURN_TYPES
                assert returned[value[1]] == stated[name][0]


@pytest.mark.slow
def test_camera_and_light_are_estimated(nodes: ModuleType) -> None:
    import warpir.demo

    photo = image_of(Path(warpir.demo.__file__).parent / "photo.png")[:, ::4, ::4]
    pitch, roll, vfov, horizon, summary = called(nodes, "WarpirEstimateCamera", image=photo)
    assert -12.0 < pitch < 4.0 and abs(roll) < 3.0 and 20.0 < vfov < 45.0 and 0.2 < horizon < 0.6
    assert "+-" in summary
    light, _, _, azimuth, elevation, spread, numbers = called(
        nodes, "WarpirEstimateLight", image=photo
    )
    assert Path(light).is_file() and json.loads(numbers)["elevation_deg"] == elevation
    assert -180.0 <= azimuth <= 180.0 and 10.0 < elevation < 70.0 and 0.0 < spread < 60.0


def test_object_is_inserted(nodes: ModuleType, tmp_path: Path) -> None:
    write_inputs(tmp_path)
    photo = image_of(tmp_path / "photo.png")
    occluder = torch.zeros(1, 64, 64)  # what Load Image gives for a photo without alpha
    composite, mask, alone, shadow, light, folder = called(
        nodes,
        "WarpirInsertObject",
        image=photo,
        asset=str(tmp_path / "box.obj"),
        light=str(tmp_path / "sky.hdr"),
        at_x=0.5,
        at_y=0.7,
        occluder=occluder,
        size=0.4,
        samples=4,
    )
    assert composite.shape == alone.shape == shadow.shape == photo.shape
    assert mask.shape == photo.shape[:3] and 0.0 < float(mask.mean()) < 0.5
    untouched = (mask == 0.0) & (shadow == 1.0).all(dim=-1)
    assert untouched.any() and torch.equal(composite[untouched], photo[untouched])
    assert (Path(folder) / "report.html").is_file() and Path(light).is_file()


@pytest.mark.slow
def test_cancelling_stops_an_insertion(
    nodes: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ComfyUI's flag is asked while the picture is made, and its own exception comes through."""

    class InterruptProcessingException(Exception):
        pass

    asked = 0

    def throw_exception_if_processing_interrupted() -> None:
        nonlocal asked
        asked += 1
        if asked == 5:  # as ComfyUI's, which takes the flag back
            raise InterruptProcessingException

    stub = ModuleType("comfy.model_management")
    vars(stub)["throw_exception_if_processing_interrupted"] = (
        throw_exception_if_processing_interrupted
    )
    monkeypatch.setitem(sys.modules, "comfy", ModuleType("comfy"))
    monkeypatch.setitem(sys.modules, "comfy.model_management", stub)
    write_inputs(tmp_path)
    inputs = {"image": image_of(tmp_path / "photo.png"), "asset": str(tmp_path / "box.obj")}
    inputs |= {"light": str(tmp_path / "sky.hdr"), "size": 0.4, "samples": 4}
    with pytest.raises(InterruptProcessingException):
        called(nodes, "WarpirInsertObject", **inputs)
    assert not [*tmp_path.rglob("composite.png")]
    *_, folder = called(nodes, "WarpirInsertObject", **inputs)
    assert (Path(folder) / "composite.png").is_file() and asked > 10


@pytest.mark.slow
def test_linked_light_keeps_its_level(nodes: ModuleType, tmp_path: Path) -> None:
    """The estimated map has the photo's level, which another map is scaled to."""
    write_inputs(tmp_path)
    photo = image_of(tmp_path / "photo.png")
    estimated = called(nodes, "WarpirEstimateLight", image=photo)[0]
    inputs = {"image": photo, "asset": str(tmp_path / "box.obj"), "size": 0.4, "samples": 1}
    *_, linked, folder = called(nodes, "WarpirInsertObject", light=estimated, **inputs)
    assert json.loads((Path(folder) / "run.json").read_text())["config"]["exposure"] == 0.0
    *_, folder = called(nodes, "WarpirInsertObject", light=linked, **inputs)
    assert json.loads((Path(folder) / "run.json").read_text())["config"]["exposure"] == 0.0
    *_, folder = called(nodes, "WarpirInsertObject", light=str(tmp_path / "sky.hdr"), **inputs)
    assert json.loads((Path(folder) / "run.json").read_text())["config"]["exposure"] is None


def test_half_a_place_is_refused(nodes: ModuleType) -> None:
    with pytest.raises(ValueError, match="at_x and at_y"):
        called(nodes, "WarpirInsertObject", image=torch.zeros(1, 8, 8, 3), asset="", at_y=0.8)


@pytest.mark.slow
def test_a_model_guides(nodes: ModuleType, tmp_path: Path) -> None:
    """It needs derivatives, which ComfyUI turns off round a node."""
    write_inputs(tmp_path)
    model = make_tiny_stable_diffusion(tmp_path / "model")
    *_, folder = called(
        nodes, "WarpirInsertObject", image=image_of(tmp_path / "photo.png"), size=0.4,
        asset=str(tmp_path / "box.obj"), model=str(model), prompt="a box", samples=4, steps=2,
        loss="sds-base", personalize=False, device="cpu",
    )  # fmt: skip
    record = json.loads((Path(folder) / "run.json").read_text())
    assert record["measured"]["optimization"]["steps"] == 2


def test_missing_asset_is_named(nodes: ModuleType) -> None:
    with pytest.raises(InputError, match=r"nowhere\.glb"):
        called(
            nodes, "WarpirInsertObject", image=torch.full((1, 40, 60, 3), 0.5), asset="nowhere.glb"
        )
