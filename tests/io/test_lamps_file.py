"""Lamps on the command line and in files, and what a run with them leaves."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.builders.gltf_files import Builder
from tests.builders.insertions import arguments, go, read_layers, rgb
from tests.builders.refusals import assert_fails
from warpir.core.errors import InputError
from warpir.core.limits import LIMITS
from warpir.io.lamps_file import POINT_RADIUS, read_lamps
from warpir.report.result import NOT_HANDED_OVER
from warpir.scene.near.lamps import RectangleLamp, SphereLamp

BALL = {"center": [0.5, 1.0, -4.0], "radius": 0.1, "power": 20.0, "color": [1.0, 0.5, 0.0]}
FLAT = {"center": [0, 2, -4], "edge_x": [1, 0, 0], "edge_y": [0, 0, 0.5], "power": 30}
LAMP = "0.9,1.2,-4.2,0.1,60,1,0.5,0.25"


def written(path: Path, *lamps: Any, **changes: Any) -> Path:
    path.write_text(
        json.dumps({"format": "warpir-lamps", "version": 1, "lamps": list(lamps), **changes})
    )
    return path


def test_lamps_of_a_list(tmp_path: Path) -> None:
    ball, flat = read_lamps(written(tmp_path / "l.json", BALL, FLAT), LIMITS, [])
    assert isinstance(ball, SphereLamp) and isinstance(flat, RectangleLamp)
    assert ball.radius == 0.1 and ball.power.tolist() == [20.0, 10.0, 0.0]
    np.testing.assert_allclose(ball.radiance, ball.power / (4.0 * np.pi**2 * 0.01))
    np.testing.assert_allclose(flat.radiance, 30.0 / (np.pi * 0.5))
    assert flat.corner.tolist() == [-0.5, 2.0, -4.25]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"radius": -0.1}, "/lamps/0: a radius of"),
        ({"radius": 0}, "/lamps/0: a radius of"),
        ({"power": -1.0}, "/lamps/0: power and colour of 0"),
        ({"color": [1, -1, 0]}, "/lamps/0: power and colour of 0"),
        ({"power": 1e300}, "/lamps/0: power and colour of 0"),
        ({"power": "bright"}, "/lamps/0/power"),
        ({"center": [0, 1]}, "/lamps/0/center"),
        ({"center": [0, 1, 1e12]}, "/lamps/0: a place within"),
        ({"edge_x": [1, 0, 0]}, "radius"),
        ({"colour": [1, 1, 1]}, "colour"),
        ({"radius": None}, "/lamps/0/radius"),
    ],
    ids=str,
)
def test_lamps_of_a_list_that_are_wrong(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    path = written(tmp_path / "l.json", BALL | change)
    with pytest.raises(InputError, match=words):
        read_lamps(path, LIMITS, [])


def test_lamps_of_a_list_that_is_none(tmp_path: Path) -> None:
    slanted = FLAT | {"edge_y": [0.5, 0.0, 0.5]}
    flat = FLAT | {"edge_y": [0.0, 0.0, 0.0]}
    for row, words in ((slanted, "right angles"), (flat, "edges of"), ("lamp", "an object")):
        with pytest.raises(InputError, match=words):
            read_lamps(written(tmp_path / "l.json", row), LIMITS, [])
    for path in (
        written(tmp_path / "none.json"),
        written(tmp_path / "other.json", BALL, format="warpir-lobes"),
        written(tmp_path / "many.json", *[BALL] * 65),
        tmp_path / "absent.json",
    ):
        with pytest.raises(InputError):
            read_lamps(path, LIMITS, [])
    (tmp_path / "nan.json").write_text(json.dumps({"lamps": [BALL | {"radius": np.nan}]}))
    with pytest.raises(InputError):
        read_lamps(tmp_path / "nan.json", LIMITS, [])


def test_lamps_of_gltf_are_small_spheres(tmp_path: Path) -> None:
    """Point lights, moved by the nodes above them; 54 351.4 cd are Blender's 1000 W."""
    builder = Builder()
    lights = [{"type": "point", "intensity": 54351.41306588226, "color": [1, 0.5, 0]}]
    lights += [{"type": "spot", "spot": {}}, {"type": "directional"}]
    use = "KHR_lights_punctual"
    builder.json["extensions"] = {use: {"lights": lights}}
    builder.json["nodes"] += [
        {"translation": [1, 2, 3], "scale": [2, 2, 2], "children": [2]},
        {"translation": [0, 0, 0.5], "extensions": {use: {"light": 0}}},
        {"extensions": {use: {"light": 1}}},
        {"extensions": {use: {"light": 0}}},  # in no scene
    ]
    builder.json["scenes"][0]["nodes"] += [1, 3]
    path = tmp_path / "room.glb"
    path.write_bytes(builder.glb())
    notices: list[str] = []
    (lamp,) = read_lamps(path, LIMITS, notices)
    assert isinstance(lamp, SphereLamp) and lamp.radius == POINT_RADIUS
    assert lamp.center.tolist() == [1.0, 2.0, 4.0]
    np.testing.assert_allclose(lamp.power, [1000.0, 500.0, 0.0], rtol=1e-5)
    assert any("'spot'" in line for line in notices)
    del builder.json["nodes"][2]["extensions"]
    path.write_bytes(builder.glb())
    with pytest.raises(InputError, match="no point light"):
        read_lamps(path, LIMITS, [])


@pytest.mark.parametrize(
    ("lamp", "words"),
    [
        ("0,1,-4,-0.1,60", "radius"),
        ("0,1,-4,0,60", "radius"),
        ("0,1,-4,0.1,-60", "power"),
        ("0,1,-4,0.1,60,1,-1,1", "colour"),
        ("0,nan,-4,0.1,60", "finite"),
        ("0,inf,-4,0.1,60", "finite"),
        ("0,1e12,-4,0.1,60", "up to 1e+09"),
        ("0,1,-4,0.1", "--lamp"),
        ("0,1,-4,0.1,60,1", "--lamp"),
        ("here", "--lamp"),
    ],
)
def test_lamps_on_the_command_line_that_are_wrong(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], lamp: str, words: str
) -> None:
    assert_fails(capsys, arguments(inputs, tmp_path / "o", lamp=lamp), 2, "--lamp", words)


def test_lamps_are_refused_where_they_cannot_be_used(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    guided = {"model": "m", "prompt": "a box", "refine": "material"}
    for name, value in (("lamp", LAMP), ("lamps", "l.json")):
        argv = arguments(inputs, tmp_path / "o", **guided, **{name: value})
        assert_fails(capsys, argv, 2, f"--{name}: cannot be used with --refine material")
    argv = arguments(inputs, tmp_path / "o", lamps=str(tmp_path / "absent.json"))
    assert_fails(capsys, argv, 3, "absent.json")
    argv = arguments(inputs, tmp_path / "o", lamps=str(written(tmp_path / "l.json", {})))
    assert_fails(capsys, argv, 3, "/lamps/0")


def test_lamps_light_an_insertion(inputs: Path, tmp_path: Path) -> None:
    """Object and shadow change, --config gives the same bytes, and the record names the lamps."""
    asked = {"exposure": "0", "light": str(inputs / "sky.exr")}
    dark = go(arguments(inputs, tmp_path / "dark", **asked), tmp_path / "dark")
    path = written(tmp_path / "l.json", FLAT)
    more = asked | {"lamp": LAMP, "lamps": str(path)}
    lit = go(arguments(inputs, tmp_path / "lit", **more), tmp_path / "lit")
    a, b = (read_layers(run.out / "layers.exr") for run in (dark, lit))
    inside = a["matte.A"] == 1.0
    assert inside.any() and (rgb(b)[inside].mean(axis=0) > rgb(a)[inside].mean(axis=0)).all()
    assert "lamps" not in dark.record["measured"] and "lamps" in lit.record["inputs"]
    ball, flat = lit.record["measured"]["lamps"]
    assert ball["power"] == [60.0, 30.0, 15.0] and flat["edge_x"] == [1, 0, 0]
    assert NOT_HANDED_OVER in lit.record["notices"]
    again = ["--config", str(lit.out / "run.json"), "--out", str(tmp_path / "again")]
    same = go(again, tmp_path / "again")
    assert (same.out / "layers.exr").read_bytes() == (lit.out / "layers.exr").read_bytes()


def test_lamps_below_the_ground_are_told(inputs: Path, tmp_path: Path) -> None:
    out = tmp_path / "o"
    run = go(arguments(inputs, out, exposure="0", lamp="0,-1,-4,0.5,60"), out)
    assert any("lamp 1 is below the ground" in line for line in run.record["notices"])
    without = go(arguments(inputs, tmp_path / "p", exposure="0"), tmp_path / "p")
    a, b = (read_layers(r.out / "layers.exr") for r in (run, without))
    np.testing.assert_array_equal(rgb(a, "fg."), rgb(b, "fg."))
    # Its ratio is traced by the pixel, 4 samples of it.
    assert abs(rgb(a, "shadow.").mean() - rgb(b, "shadow.").mean()) < 2e-3


def test_lamps_take_their_share_of_the_ground_from_the_exposure(
    inputs: Path, tmp_path: Path
) -> None:
    """The more a lamp lights the ground, the less is left for the light from afar."""
    exposures = []
    for k, power in enumerate((0, 20, 1e6)):
        out = tmp_path / str(k)
        run = go(arguments(inputs, out, lamp=f"0,8,-5,0.1,{power}", samples="1"), out)
        exposures.append(run.record["measured"]["exposure_ev"])
    assert exposures[0] > exposures[1] > exposures[2]
    assert exposures[2] == pytest.approx(exposures[0] + np.log2(0.05), abs=1e-6)
