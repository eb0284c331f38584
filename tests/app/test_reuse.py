"""``--reuse``: the light and the curves of an earlier run, and folders that hold none."""

import hashlib
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import oracles as o
from tests.app.test_limits import TELL, validated
from tests.builders.insertions import (
    HALF,
    Run,
    arguments,
    digest,
    go,
    read_layers,
    record_of,
    rgb,
)
from tests.builders.refusals import assert_fails
from warpir.app.command import parse
from warpir.app.config import InsertConfig
from warpir.app.earlier_runs import read_run
from warpir.app.inputs import read_inputs
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import rotate_map
from warpir.io.curves_file import curves_to_json, read_curves
from warpir.io.images.photos import read_envmap
from warpir.lighting.scene_light import make_light
from warpir.scene.tone_curves import Curves, ToneKnots

CHEAP = {"samples": "2", "depth": "2"}


@pytest.fixture(scope="module")
def first(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The earlier run: a box under a panorama, dark enough that nothing is clipped."""
    out = tmp_path_factory.mktemp("first") / "out"
    return go(arguments(inputs, out, exposure="-6", device="cpu", **CHEAP), out)


@pytest.fixture
def copy(first: Run, tmp_path: Path) -> Path:
    """A copy of the earlier run's folder, to be changed."""
    return Path(shutil.copytree(first.out, tmp_path / "run"))


def again(inputs: Path, run: Path, out: Path, **changes: str | None) -> Run:
    """The same box in the same photo under the light of a run."""
    flags: dict[str, str | None] = {
        "light": None, "device": "cpu", "reuse": str(run), **CHEAP, **changes
    }  # fmt: skip
    return go(arguments(inputs, out, **flags), out)


def rewrite(run: Path, name: str, content: bytes) -> None:
    """Replace one file of a run, and its sha256 in ``run.json``."""
    (run / name).write_bytes(content)
    record = record_of(run)
    record["files"][name] = hashlib.sha256(content).hexdigest()
    (run / "run.json").write_text(json.dumps(record))


def bent(rng: np.random.Generator, tone: str = "linear") -> Curves:
    """Curves far from the identity, from the oracle's knots."""
    knots = [np.asarray(part, np.float32) for part in o.spline_knots(rng.normal(0.0, 1.5, (4, 16)))]
    fg, shadow = ([part[rows] for part in knots] for rows in (slice(0, 1), slice(1, 4)))
    return Curves(tone, ToneKnots(*fg), ToneKnots(*shadow))


# ------------------------------------------------------------------------ what is used again


def test_same_scene_gives_the_same_picture(inputs: Path, first: Run, tmp_path: Path) -> None:
    """Light, curves and exposure of the run are used as they are: not a byte differs."""
    run = again(inputs, first.out, tmp_path / "o")
    assert set(run.record["files"]) == set(first.record["files"])
    for name in ("composite.png", "envmap.exr", "envmap.hdr", "curves.json", "balls.png"):
        assert run.record["files"][name] == first.record["files"][name]
    recorded = hashlib.sha256((first.out / "run.json").read_bytes()).hexdigest()
    assert run.record["inputs"]["reuse"] == recorded
    assert run.record["measured"]["exposure_ev"] == 0.0
    assert not any("world of" in line for line in run.record["assumed"])


def test_another_object_elsewhere_is_lit_by_the_run(
    inputs: Path, first: Run, tmp_path: Path
) -> None:
    """Another asset, photo and place: as if that light had been given at that exposure."""
    changes = {"asset": str(inputs / "box.obj"), "photo": str(inputs / "deep.png"),
               "place": "0.4,0,-4", "rotate_y": "30"}  # fmt: skip
    run = again(inputs, first.out, tmp_path / "a", **changes)
    given = go(
        arguments(inputs, tmp_path / "b", exposure="-6", device="cpu", **CHEAP, **changes),
        tmp_path / "b",
    )
    assert run.record["files"]["composite.png"] == given.record["files"]["composite.png"]


def test_light_rotate_and_exposure_change_the_runs_light(
    inputs: Path, first: Run, tmp_path: Path
) -> None:
    """For a photo of another heading or exposure the light is turned and scaled."""
    config = InsertConfig(
        photo=str(inputs / "photo.png"), asset=str(inputs / "box.glb"), out=str(tmp_path / "o"),
        reuse=str(first.out), light_rotate=90.0, exposure=1.0,
    )  # fmt: skip
    read = read_inputs(config.changed(ground_albedo=0.4))
    assert any("--ground-albedo: without effect" in notice for notice in read.notices)
    light = make_light(read, config.light, config.tone_operator)
    expected = 2.0 * rotate_map(read_envmap(first.out / "envmap.exr"), 90.0)
    assert light.light is light.light_shadow and light.light.texels is not None
    np.testing.assert_allclose(light.light.texels, expected, rtol=1e-6)


def test_curves_and_tone_of_the_run_are_applied(
    inputs: Path, first: Run, copy: Path, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Object and ratio pass through the run's curves, behind its operator; they are written."""
    curves = bent(rng, tone="reinhard")
    rewrite(copy, "curves.json", json.dumps(curves_to_json(curves)).encode())
    run = again(inputs, copy, tmp_path / "o")
    plain, curved = (read_layers(folder / "layers.exr") for folder in (first.out, run.out))
    mask = plain["matte.A"][..., None]
    # The first run's tone is linear, and its light so weak that it shows radiance.
    radiance = rgb(plain, "fg.") / np.where(mask > 0.0, mask, 1.0)
    assert 0.0 < radiance.max() < 0.9
    (knots,) = zip(*curves.foreground.arrays(), strict=True)
    expected, slope = o.spline(radiance / (1.0 + radiance), *knots)
    error = np.abs(rgb(curved, "fg.") - mask * expected)
    # The radiance was read back as a half float, which the curve's slope amplifies.
    assert (error <= HALF + 1e-3 * slope * radiance).all()
    assert np.abs(expected - radiance)[mask[..., 0] > 0].max() > 20.0 * HALF
    ratio = rgb(plain, "shadow.")
    for channel, knots in enumerate(zip(*curves.shadow_ratio.arrays(), strict=True)):
        expected, slope = o.spline(ratio[..., channel], *knots)
        # Where the object throws light on the ground, beyond 1, the curve goes on straight.
        expected += np.maximum(ratio[..., channel] - 1.0, 0.0) * slope
        error = np.abs(rgb(curved, "shadow.")[..., channel] - expected)
        assert (error <= HALF + 1e-3 * slope).all()
    # In the file 1 is what is next to it as well; above the horizon nothing is.
    assert (ratio[0] == 1.0).all() and (rgb(curved, "shadow.")[0] == 1.0).all()
    written = read_curves(run.out / "curves.json")
    for name in ("foreground", "shadow_ratio"):
        pairs = zip(getattr(written, name).arrays(), getattr(curves, name).arrays(), strict=True)
        for a, b in pairs:
            np.testing.assert_array_equal(a, b)
    assert written.tone == "reinhard"
    with pytest.raises(InputError, match="--tone: cannot be reinhard"):
        config = parse(run.argv).config.changed(reuse=str(first.out), tone="reinhard")
        make_light(read_inputs(config), config.light, config.tone_operator)


def test_shadow_light_of_the_run_casts_the_shadow(
    inputs: Path, first: Run, copy: Path, tmp_path: Path
) -> None:
    """With envmap_shadow.exr the object has one light, its shadow the other; both are written."""
    turned = again(inputs, first.out, tmp_path / "turned", light_rotate="120")
    rewrite(copy, "envmap_shadow.exr", (turned.out / "envmap.exr").read_bytes())
    run = again(inputs, copy, tmp_path / "two")
    one, other, both = (read_layers(r.out / "layers.exr") for r in (first, turned, run))
    np.testing.assert_array_equal(rgb(both, "fg."), rgb(one, "fg."))
    np.testing.assert_array_equal(rgb(both, "shadow."), rgb(other, "shadow."))
    assert np.abs(rgb(one, "shadow.") - rgb(other, "shadow.")).max() > 0.1
    for name, source in (("envmap", first), ("envmap_shadow", turned)):
        written = read_envmap(run.out / f"{name}.exr")
        np.testing.assert_array_equal(written, read_envmap(source.out / "envmap.exr"))
    # A run of two lights can be reused in turn.
    found = read_run(run.out)
    assert found.light_shadow is not found.light_fg


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ({}, None),
        ({"pitch": "-20"}, "the camera looks along -Z of the world of"),
        ({"fov": "50"}, None),
        ({"camera": "own"}, None),
        ({"camera": "moved"}, "the world of moved.json is that of"),
    ],
    ids=["same", "pitch", "fov", "camera-file", "other-camera-file"],
)
def test_what_is_assumed_of_the_world_is_said(
    inputs: Path, first: Run, tmp_path: Path, pose: dict[str, str], words: str | None
) -> None:
    """Another pose is another camera: the run says whose world it is taken to stand in."""
    changes: dict[str, str | None] = dict(pose)
    if "camera" in pose:
        content = json.loads((first.out / "camera.json").read_text())
        content["c2w"][0][3] += 1.0 if pose["camera"] == "moved" else 0.0
        path = tmp_path / f"{pose['camera']}.json"
        path.write_text(json.dumps(content))
        changes = {"camera": str(path), "fov": None, "pitch": None, "camera_height": None}
    argv = arguments(inputs, tmp_path / "o", light=None, reuse=str(first.out), **changes)
    found = [line for line in read_inputs(parse(argv).config).assumed if "--light-rotate" in line]
    assert len(found) == (words is not None)
    assert words is None or words in found[0]


# ------------------------------------------------------------------ folders that hold no run


def removed(name: str) -> Callable[[Path], None]:
    return lambda run: (run / name).unlink()


def cut(name: str) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        content = (run / name).read_bytes()
        (run / name).write_bytes(content[: len(content) // 2])

    return change


def replaced(name: str, make: Callable[[Path], None]) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        (run / name).unlink()
        make(run / name)

    return change


def record_with(**changes: Any) -> Callable[[Path], None]:
    def change(run: Path) -> None:
        record = record_of(run)
        (run / "run.json").write_text(json.dumps({**record, **changes}))

    return change


def edited(name: str, *path: str | int, to: Any) -> Callable[[Path], None]:
    """Change one value inside a JSON file, as a run that wrote it so."""

    def change(run: Path) -> None:
        content = json.loads((run / name).read_text())
        inner = content
        for key in path[:-1]:
            inner = inner[key]
        inner[path[-1]] = to
        rewrite(run, name, json.dumps(content).encode())

    return change


def emptied(run: Path) -> None:
    for path in run.iterdir():
        path.unlink()


def gone(run: Path) -> None:
    emptied(run)
    run.rmdir()


def negative_light(run: Path) -> None:
    from warpir.io.results import OutputFolder

    with OutputFolder(run / "other") as output:
        planes = {c: np.full((16, 32), -1.0, np.float32) for c in "RGB"}
        output.write_exr("envmap.exr", planes)
        output.write_json("run.json", {})
    rewrite(run, "envmap.exr", (run / "other" / "envmap.exr").read_bytes())


def curve(*path: str | int, to: Any) -> Callable[[Path], None]:
    return edited("curves.json", *path, to=to)


KNOTS = [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
BAD = {
    "no-folder": (gone, "run: not a finished run (found no such folder)"),
    "empty-folder": (emptied, "run: not a finished run (found no run.json)"),
    "unfinished": (removed("run.json"), "run: not a finished run (found no run.json)"),
    "record-cut": (cut("run.json"), "run.json: line"),
    "record-newer": (record_with(format=99), "run.json of unknown format (found 99"),
    "record-without-files": (record_with(files=None), "run.json: /files"),
    "no-light": (removed("envmap.exr"), "envmap.exr: no such file"),
    "no-curves": (removed("curves.json"), "curves.json: no such file"),
    "I18-light-is-a-pipe": (replaced("envmap.exr", os.mkfifo), "envmap.exr: not a regular file"),
    "I18-light-is-a-device": (
        replaced("envmap.exr", lambda path: path.symlink_to("/dev/zero")),
        "envmap.exr: not a regular file",
    ),
    "light-cut": (cut("envmap.exr"), "envmap.exr: changed since the run wrote it"),
    "curves-cut": (cut("curves.json"), "curves.json: changed since the run wrote it"),
    "light-unlisted": (record_with(files={}), "envmap.exr: changed since the run"),
    "light-negative": (negative_light, "envmap.exr:"),
    "camera-pose": (edited("camera.json", "c2w", to=[[1.0]]), "camera.json: /c2w"),
    "curves-format": (curve("version", to=2), "curves.json: not curves"),
    "curves-tone": (curve("tone", to="filmic"), "/tone: reinhard or linear"),
    "curves-absent": (curve("foreground", to=None), "/foreground: an object"),
    "curves-two": (
        curve("shadow_ratio", to={"x": [KNOTS], "y": [KNOTS], "slope": [KNOTS[1:]]}),
        "/shadow_ratio: x, y and slope of one size",
    ),
    "curves-count": (
        curve("foreground", to={k: [KNOTS] * 2 for k in ("x", "y")}
               | {"slope": [[1.0] * 6] * 2}),
        "/foreground: curves miscounted (found 2; expected 1)",
    ),
    "curves-ragged": (curve("foreground", "x", to=[[0.0, 1.0], [0.0]]), "/x: lists"),
    "curves-text": (curve("foreground", "x", 0, 1, to="0.2"), "/x: lists of numbers"),
    "curves-true": (curve("foreground", "x", 0, 5, to=True), "/x: lists of numbers"),
    "curves-huge": (curve("foreground", "x", 0, 5, to=10**400), "foreground"),
    "curves-inf": (curve("foreground", "y", 0, 2, to=1e300), "/foreground/y: knots"),
    "curves-nan": (curve("foreground", "y", 0, 2, to=float("nan")), "NaN"),
    "curves-fall": (curve("foreground", "y", 0, 2, to=0.9), "/foreground/y: knots"),
    "curves-flat": (curve("shadow_ratio", "x", 2, 2, to=0.2), "/shadow_ratio/x"),
    "curves-end": (curve("shadow_ratio", "y", 1, 5, to=1.1), "/shadow_ratio/y"),
    "curves-slope": (curve("foreground", "slope", 0, 3, to=0.0), "/slope: more than"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_run_is_one_line(
    case: str, inputs: Path, copy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that no run finished, or whose files are wrong, is refused before anything else."""
    change, words = BAD[case]
    change(copy)
    before = digest(tmp_path)
    argv = arguments(inputs, tmp_path / "o", light=None, reuse=str(copy))
    lines = assert_fails(capsys, argv, ExitCode.INPUT, words)
    assert len(lines) <= 2
    assert digest(tmp_path) == before and not (tmp_path / "o").exists()


def test_bad_run_is_listed_with_the_other_inputs(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All problems of one pass, the run's among them."""
    argv = arguments(inputs, tmp_path / "o", light=None, reuse="nowhere", photo="none.png")
    lines = assert_fails(capsys, argv, ExitCode.INPUT, "none.png")
    assert any(line.startswith("also: nowhere: not a finished run") for line in lines)


def test_run_is_never_written_over(
    inputs: Path, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--out may not be the folder that is reused: --overwrite would replace it."""
    before = digest(copy)
    argv = [*arguments(inputs, copy, light=None, reuse=str(copy / ".")), "--overwrite"]
    assert_fails(capsys, argv, ExitCode.USAGE, "--out: holds the input")
    assert digest(copy) == before


def test_reuse_is_validated_without_renderer(inputs: Path, first: Run, tmp_path: Path) -> None:
    argv = arguments(inputs, "o", light=None, reuse=str(first.out))
    assert validated(argv, tmp_path, before=TELL).out.splitlines()[-1] == "loaded []"
