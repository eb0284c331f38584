"""One insertion end to end: the files, their agreement, replay, and what bad input leaves alone."""

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.builders.insertions import (
    ALWAYS,
    DETAIL,
    HALF,
    HEIGHT,
    WIDTH,
    Run,
    arguments,
    digest,
    go,
    read_image,
    read_layers,
    rgb,
    untouched,
)
from tests.builders.outcome import outcome
from tests.conftest import devices
from warpir import insert
from warpir.app.command import parse
from warpir.app.config import InsertConfig
from warpir.batch.task import CHECK, Task, do_task
from warpir.core.arrays import FloatArray, PixelArray
from warpir.core.color import linear_to_gamma
from warpir.core.errors import ExitCode
from warpir.insert import main
from warpir.io.cameras.reader import read_camera
from warpir.io.images.photos import read_envmap, read_photo
from warpir.io.images.undistort import undistort_photo
from warpir.io.lobes_file import read_lobes
from warpir.scene.lens import Lens
from warpir.scene.light import as_map
from warpir.train.networks.regressor import random_regressor, save_regressor

RGBE = 0.01
"""Relative to the pixel's largest channel: 8-bit mantissas."""


@pytest.fixture(scope="module", params=devices())
def run(
    request: pytest.FixtureRequest, inputs: Path, tmp_path_factory: pytest.TempPathFactory
) -> Run:
    """A run under a panorama."""
    out = tmp_path_factory.mktemp("run") / "out"
    return go(arguments(inputs, out, device=str(request.param)), out)


# ------------------------------------------------------------------------------ the files


def test_run_writes_every_promised_file(run: Run) -> None:
    """Exactly the promised names, run.json the last one renamed, nothing staged left behind."""
    names = sorted(p.name for p in run.out.iterdir())
    assert names == sorted([*ALWAYS, "run.json"])
    assert set(run.record["files"]) == set(ALWAYS)
    last = max(ALWAYS, key=lambda name: (run.out / name).stat().st_mtime_ns)
    assert (run.out / "run.json").stat().st_mtime_ns >= (run.out / last).stat().st_mtime_ns


def test_record_tells_what_was_used_and_assumed(run: Run, inputs: Path) -> None:
    """Hashes of inputs and outputs are the files'; settings, versions, seconds are there."""
    record = run.record
    for name, path in (("photo", "photo.png"), ("asset", "box.glb"), ("light", "sky.hdr")):
        content = (inputs / path).read_bytes()
        assert record["inputs"][name] == hashlib.sha256(content).hexdigest()
    found = {k: v for k, v in digest(run.out).items() if k != "run.json"}
    assert record["files"] == found
    assert record["config"]["seed"] == 3 and record["config"]["samples"] == 4
    assert any("--ground-albedo" in line for line in record["assumed"])
    assert any("y = 0" in line for line in record["assumed"])
    assert record["device"].startswith(("cpu", "cuda"))
    assert {"read", "render", "write"} <= set(record["seconds"])
    assert {"python", "warp-lang", "numpy"} <= set(record["versions"])
    measured = record["measured"]
    assert measured["object_pixels"] > 30 and measured["shadow_pixels"] > 10
    assert measured["triangles"] == 12 and measured["values_clamped_to_half"] == 0


def recomposed(planes: dict[str, FloatArray]) -> FloatArray:
    """What ``warpir/formula`` says, in float32."""
    outside = np.float32(1.0) - planes["fg.A"][..., None]
    return rgb(planes, "fg.") + outside * rgb(planes, "plate.") * rgb(planes, "shadow.")


def encoded(linear: FloatArray, top: int) -> PixelArray:
    """Codes of a composite, as a viewer of gamma 2.2 makes them."""
    display = np.clip(linear_to_gamma(linear), 0.0, 1.0)
    return np.round(display.astype(np.float64) * top)


def test_composite_is_recomputed_from_the_layers(run: Run) -> None:
    """The layers compute every code of composite.png and, rounded, layers.exr's own RGB (B5)."""
    planes = read_layers(run.out / "layers.exr")
    composite = recomposed(planes)
    np.testing.assert_array_equal(encoded(composite, 255), run.image())
    np.testing.assert_array_equal(rgb(planes), composite.astype(np.float16))
    parts = sum(rgb(planes, f"{name}.") for name in ("diffuse", "specular", "emission"))
    np.testing.assert_allclose(parts, rgb(planes, "fg."), atol=HALF)
    np.testing.assert_array_equal(planes["matte.A"], planes["fg.A"])
    assert (planes["A"] == 1.0).all() and planes["Z"].min() > 3.0


def test_pixels_that_differ_are_counted(run: Run, inputs: Path) -> None:
    """Those with another code, not all that a shadow too faint for one falls on."""
    photo, _ = read_image(inputs / "photo.png")
    differing = (photo != run.image()).any(axis=-1).sum()
    assert run.record["measured"]["changed_pixels"] == differing
    planes = read_layers(run.out / "layers.exr")
    shaded = (planes["matte.A"] > 0.0) | (rgb(planes, "shadow.") != 1.0).any(axis=-1)
    assert shaded.sum() > differing > 30


def test_picture_shows_the_object_where_it_was_placed(run: Run) -> None:
    """A box of 1 m at (0, 0, -5) covers where its middle is; the ground loses and gains light."""
    planes = read_layers(run.out / "layers.exr")
    view = read_camera(run.out / "camera.json", (WIDTH, HEIGHT))
    ((u, v),) = view.project(np.array([[0.0, 0.5, -4.5]]))
    assert planes["matte.A"][int(v), int(u)] == 1.0
    np.testing.assert_allclose(planes["position.Z"][int(v), int(u)], -4.5, atol=0.05)
    shadow = rgb(planes, "shadow.")
    assert shadow.min() < 0.8 and 1.0 < shadow.max() < 1.5
    assert 0.02 < planes["matte.A"].mean() < 0.5


def test_pixels_outside_are_the_photos_own(run: Run, inputs: Path) -> None:
    """What neither object nor shadow touches keeps its codes, bit for bit."""
    photo = read_image(inputs / "photo.png")[0]
    planes = read_layers(run.out / "layers.exr")
    outside = untouched(planes)
    assert 200 < outside.sum() < outside.size - 100
    np.testing.assert_array_equal(run.image()[outside], photo[outside])
    assert (run.image()[~outside] != photo[~outside]).mean() > 0.3


def test_light_files_hold_the_light_at_the_photos_exposure(run: Run, inputs: Path) -> None:
    """envmap.exr is the panorama times 2^exposure, .hdr the same within RGBE."""
    exposure = run.record["measured"]["exposure_ev"]
    given = read_envmap(inputs / "sky.hdr")
    texels = read_envmap(run.out / "envmap.exr")
    np.testing.assert_allclose(texels, given * 2.0**exposure, rtol=1e-6)
    coarse = read_envmap(run.out / "envmap.hdr")
    assert (np.abs(coarse - texels) <= RGBE * texels.max(axis=-1, keepdims=True)).all()
    preview = run.image("envmap_preview.png")
    assert preview.shape == (16, 32, 3) and preview.dtype == np.uint8
    # The preview is rolled by half its width: the sun of column 20 is in column 4.
    assert np.unravel_index(np.argmax(preview.sum(axis=-1)), (16, 32)) == (3, 4)
    assert run.image("balls.png").shape == (192, 384, 3)


def test_curves_are_the_identity(run: Run) -> None:
    """Nothing recovers curves here: knots on the diagonal, slope 1, one and three curves."""
    curves = json.loads((run.out / "curves.json").read_text())
    assert curves["format"] == "warpir-curves"
    assert curves["tone"] == "linear"
    for name, count in (("foreground", 1), ("shadow_ratio", 3)):
        np.testing.assert_allclose(curves[name]["x"], curves[name]["y"])
        assert np.shape(curves[name]["x"]) == (count, 6)
        np.testing.assert_array_equal(curves[name]["slope"], 1.0)


def test_camera_file_gives_the_same_picture(run: Run, inputs: Path, tmp_path: Path) -> None:
    """camera.json, read back with --camera, changes no byte of the composite."""
    argv = arguments(
        inputs,
        tmp_path / "again",
        device=run.record["config"]["device"],
        camera=str(run.out / "camera.json"),
        fov=None,
        pitch=None,
        camera_height=None,
    )
    again = go(argv, tmp_path / "again")
    assert (again.out / "composite.png").read_bytes() == (run.out / "composite.png").read_bytes()


def test_bent_photo_is_composed_straight(run: Run, inputs: Path, tmp_path: Path) -> None:
    """--undistort: what nothing touches has the straightened photo's codes; run.json says so."""
    known = read_camera(run.out / "camera.json", (WIDTH, HEIGHT))
    z_up = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]) @ known.c2w
    frame = {"file_path": "images/photo.jpg", "transform_matrix": z_up.tolist()}
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": known.fx, "fl_y": known.fy, "k1": -0.1}
    (tmp_path / "transforms.json").write_text(json.dumps({**content, "frames": [frame]}))
    out, camera = tmp_path / "out", str(tmp_path / "transforms.json")
    nothing = dict.fromkeys(("fov", "pitch", "camera_height"))
    device = run.record["config"]["device"]
    bent = go(arguments(inputs, out, camera=camera, undistort="", device=device, **nothing), out)
    lens = Lens((-0.1, 0.0, 0.0, 0.0))
    straight, border = undistort_photo(read_photo(inputs / "photo.png"), known, lens)
    planes = read_layers(out / "layers.exr")
    outside = untouched(planes)
    np.testing.assert_array_equal(bent.image()[outside], straight.codes[outside])
    # The camera is the same pinhole, to the rounding of a turned matrix.
    before = read_layers(run.out / "layers.exr")
    assert np.abs(planes["matte.A"] - before["matte.A"]).max() <= HALF
    said = {"radial": [-0.1, 0.0, 0.0, 0.0], "tangential": [0.0, 0.0], "border_share": border}
    assert bent.record["measured"]["undistorted"] == said
    assert any("straightened" in line for line in bent.record["notices"])


# ------------------------------------------------------------------- same bytes and replay


def test_same_seed_gives_the_same_bytes(
    run: Run, inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two runs of one command give identical files, but for seconds (`tests.builders.outcome`)."""
    folders = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        monkeypatch.chdir(tmp_path / name)
        assert main(arguments(inputs, "out", device=run.record["config"]["device"])) == 0
        folders.append(tmp_path / name / "out")
    first, second = (outcome(f) for f in folders)
    assert first == second
    # The folder's name is in layers.exr; the picture does not depend on it.
    assert first["composite.png"] == run.record["files"]["composite.png"]


def test_another_seed_gives_another_picture(run: Run, inputs: Path, tmp_path: Path) -> None:
    """The seed reaches the samples, and nothing else: light and camera files stay."""
    device = run.record["config"]["device"]
    other = go(arguments(inputs, tmp_path / "o", seed="4", device=device), tmp_path / "o")
    assert other.record["files"]["composite.png"] != run.record["files"]["composite.png"]
    for name in ("envmap.exr", "balls.png", "camera.json", "curves.json"):
        assert other.record["files"][name] == run.record["files"][name]


def test_run_record_replays_the_run(run: Run, tmp_path: Path) -> None:
    """--config run.json with another --out gives the same picture (F2)."""
    out = tmp_path / "replayed"
    replayed = go(["--config", str(run.out / "run.json"), "--out", str(out)], out)
    for name in ("composite.png", "envmap.exr", "balls.png", "camera.json", "curves.json"):
        assert replayed.record["files"][name] == run.record["files"][name]
    differs = {
        key
        for key, value in run.record["config"].items()
        if replayed.record["config"][key] != value
    }
    assert differs == {"out"}


def test_insert_from_python(run: Run, inputs: Path, tmp_path: Path) -> None:
    """``from warpir import insert; insert(InsertConfig(...))`` is the command line's twin."""
    insertion = insert(
        InsertConfig(
            photo=str(inputs / "photo.png"),
            asset=str(inputs / "box.glb"),
            out=str(tmp_path / "py"),
            fov=60.0,
            pitch=-15.0,
            camera_height=1.5,
            place=(0.0, 0.0, -5.0),
            samples=4,
            depth=2,
            seed=3,
            light=str(inputs / "sky.hdr"),
            device=run.record["config"]["device"],
        )
    )
    assert insertion.out == tmp_path / "py"
    assert insertion.files[-1] == "run.json" and set(insertion.files[:-1]) == set(ALWAYS)
    assert insertion.record["files"]["composite.png"] == run.record["files"]["composite.png"]


# ------------------------------------------------------------------------ photos and sizes


def test_16_bit_photo_stays_16_bit(inputs: Path, tmp_path: Path, device: str) -> None:
    """A 16-bit photo gives a 16-bit composite whose untouched pixels are its own (I11)."""
    out = tmp_path / "out"
    deep = go(arguments(inputs, out, photo=str(inputs / "deep.png"), device=device), out)
    photo, codes = read_image(inputs / "deep.png")[0], deep.image()
    assert codes.dtype == np.uint16
    planes = read_layers(out / "layers.exr")
    outside = untouched(planes)
    assert outside.any()
    np.testing.assert_array_equal(codes[outside], photo[outside])
    # Float32 throughout: halves would miss these codes by up to 15.
    np.testing.assert_array_equal(rgb(planes), recomposed(planes))
    np.testing.assert_array_equal(encoded(recomposed(planes), 65535), codes)


@pytest.mark.parametrize("width", ["24", "96"])
def test_width_changes_the_rendering_alone(
    inputs: Path, tmp_path: Path, device: str, width: str
) -> None:
    """--width renders smaller or larger; every picture has the photo's size."""
    out = tmp_path / "out"
    sized = go(arguments(inputs, out, width=width, device=device), out)
    assert sized.image().shape == (HEIGHT, WIDTH, 3)
    planes = read_layers(out / "layers.exr")
    assert planes["fg.A"].shape == (HEIGHT, WIDTH)
    photo = read_image(inputs / "photo.png")[0]
    outside = untouched(planes)
    assert outside.sum() > 200
    np.testing.assert_array_equal(sized.image()[outside], photo[outside])
    camera = json.loads((out / "camera.json").read_text())
    assert (camera["w"], camera["h"]) == (WIDTH, HEIGHT)
    told = any("a preview" in line for line in sized.record["notices"])
    assert told == (int(width) < WIDTH)


# --------------------------------------------------------------------------------- lights


def test_obj_under_lobes_writes_them(inputs: Path, tmp_path: Path, device: str) -> None:
    """--light lobes.json: lobes.json comes out at the photo's exposure, and as a map."""
    out = tmp_path / "out"
    changes = {"asset": str(inputs / "box.obj"), "light": str(inputs / "lobes.json")}
    lit = go(arguments(inputs, out, device=device, **changes), out)
    assert set(lit.record["files"]) == {*ALWAYS, *DETAIL, "lobes.json"}
    assert 0.0 < lit.record["measured"]["detail_seen"] < 1.0
    given, found = read_lobes(inputs / "lobes.json"), read_lobes(out / "lobes.json")
    factor = 2.0 ** lit.record["measured"]["exposure_ev"]
    np.testing.assert_allclose(found.amplitude, given.amplitude * factor, rtol=1e-5)
    np.testing.assert_allclose(found.axis, given.axis, atol=1e-6)
    from warpir.scene.light import Light

    expected = as_map(Light(found), 512)
    np.testing.assert_allclose(read_envmap(out / "envmap.exr"), expected, rtol=1e-5, atol=1e-7)
    albedo = rgb(read_layers(out / "layers.exr"), "albedo.")
    seen = read_layers(out / "layers.exr")["matte.A"] == 1.0
    assert (albedo[seen][:, 0] > 4.0 * albedo[seen][:, 1]).all()


@pytest.mark.slow
def test_fit_lobes_reports_its_error(inputs: Path, tmp_path: Path, device: str) -> None:
    """--fit-lobes 8 writes 8 lobes and how well they fit; --no-detail leaves it at that."""
    out = tmp_path / "out"
    fitted = go([*arguments(inputs, out, fit_lobes="8", device=device), "--no-detail"], out)
    assert set(fitted.record["files"]) == {*ALWAYS, "lobes.json"}
    assert len(read_lobes(out / "lobes.json").sharpness) == 8
    fit = fitted.record["measured"]["lobe_fit"]
    assert 0.0 <= fit["irradiance_error"] < 0.2 and 0.0 <= fit["flux_error"] < 0.1
    assert fit["lamps"] == 1


@pytest.mark.parametrize(
    ("changes", "azimuth", "elevation"),
    [
        ({"sun": "60,35"}, 60.0, 35.0),
        ({"sun": "-150,20,9", "sky": "overcast"}, -150.0, 20.0),
        ({"sky": "0.2,0.3,0.4"}, None, None),
        ({"guidance": "none", "sky": "sunset"}, None, None),
        ({"sun": "10,50", "sky": "clear", "tone": "linear", "exposure": "-1"}, 10.0, 50.0),
    ],
    ids=["sun", "sun-strength-sky", "sky-rgb", "sunset", "linear-tone"],
)
def test_sun_and_sky_flags_light_the_scene(
    inputs: Path,
    tmp_path: Path,
    device: str,
    changes: dict[str, str],
    azimuth: float | None,
    elevation: float | None,
) -> None:
    """--sun and --sky reach the light's files; the sun is where the flag says."""
    out = tmp_path / "out"
    lit = go(arguments(inputs, out, light=None, device=device, **changes), out)
    assert ((out / "lobes.json").exists()) == (azimuth is not None)
    if azimuth is not None:
        assert lit.record["measured"]["light"]["azimuth_deg"] == pytest.approx(azimuth, abs=1.0)
        assert lit.record["measured"]["light"]["elevation_deg"] == pytest.approx(elevation, abs=1.0)
    if "exposure" in changes:
        assert lit.record["measured"]["exposure_ev"] == -1.0


@pytest.mark.slow
def test_without_a_light_the_photo_is_asked(inputs: Path, tmp_path: Path, device: str) -> None:
    """--guidance none lights the object as the regressor says, at the photo's own exposure."""
    weights = tmp_path / "regressor.safetensors"
    save_regressor(random_regressor(4), weights, {})
    found = []
    for exposure in ("0", "1"):
        out = tmp_path / f"out{exposure}"
        changes = {"guidance": "none", "regressor": str(weights), "exposure": exposure}
        lit = go(arguments(inputs, out, light=None, device=device, **changes), out)
        run = lit.record["measured"]
        assert run["prior"] == "none" and run["exposure_ev"] == float(exposure)
        assert set(lit.record["inputs"]) == {"photo", "asset", "regressor"}
        (line,) = [x for x in lit.record["assumed"] if "regressor" in x]
        said = run["regression"]
        assert f"azimuth {said['azimuth_deg']:.0f}, elevation {said['elevation_deg']:.0f}" in line
        assert f"+- {said['spread_deg']:.0f} degrees" in line
        found.append(read_lobes(out / "lobes.json"))
        np.testing.assert_allclose(found[-1].axis[0], said["axis"], atol=1e-6)
    np.testing.assert_allclose(found[1].amplitude, 2.0 * found[0].amplitude, rtol=1e-6)


@pytest.mark.slow
def test_light_rotate_turns_panorama_and_lobes(inputs: Path, tmp_path: Path, device: str) -> None:
    """--light-rotate moves the brightest direction by that angle, counter-clockwise from above."""
    found = []
    for light in ("sky.hdr", "lobes.json"):
        angles = []
        for degrees in ("0", "90"):
            out = tmp_path / f"{light}{degrees}"
            changes = {"light": str(inputs / light), "light_rotate": degrees}
            lit = go(arguments(inputs, out, device=device, **changes), out)
            angles.append(lit.record["measured"]["light"]["azimuth_deg"])
        found.append((angles[0] - angles[1]) % 360.0)
    # Azimuth runs clockwise, so it falls; the panorama's texels are 11 degrees wide.
    assert found[0] == pytest.approx(90.0, abs=2.0) and found[1] == pytest.approx(90.0, abs=2.0)


# ----------------------------------------------------------------------- out of the frame


def test_cut_object_is_noted(inputs: Path, tmp_path: Path, device: str) -> None:
    out = tmp_path / "out"
    cut = go(arguments(inputs, out, place="-2.8,0,-5", device=device), out)
    assert any("cut by the photo's edge" in line for line in cut.record["notices"])
    assert cut.record["measured"]["object_pixels"] > 0


# ---------------------------------------------------------------------------- earlier results


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """An output folder with earlier results."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "composite.png").write_bytes(b"an earlier picture")
    (out / "run.json").write_text('{"format": 1, "files": {"composite.png": ""}}')
    return out


def test_failure_while_rendering_keeps_old_results(
    inputs: Path, results: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """What goes wrong after the folder was locked leaves it as it was, lock and staging gone."""
    import warpir.report.result

    def fail(*args: object, **kwargs: object) -> None:
        raise MemoryError

    before = digest(results)
    monkeypatch.setattr(warpir.report.result, "make_picture", fail)
    assert main([*arguments(inputs, results), "--overwrite"]) == ExitCode.RESOURCES
    assert "error: memory:" in capsys.readouterr().err
    assert digest(results) == before
    assert {p.name for p in results.iterdir()} == {"composite.png", "run.json"}


@pytest.mark.slow
def test_demo_runs_small(tmp_path: Path, device: str) -> None:
    """--demo at width 64 and one sample writes everything at the photo's size, and replays."""
    out = tmp_path / "demo"
    argv = ["--demo", "--out", str(out), "--width", "64", "--samples", "1", "--device", device]
    demo = go(argv, out)
    assert set(demo.record["files"]) >= set(ALWAYS)
    assert demo.image().shape == (853, 1280, 3)
    assert demo.record["measured"]["object_pixels"] > 100
    replayed = go(["--config", str(out / "run.json"), "--out", str(tmp_path / "r")], tmp_path / "r")
    assert replayed.record["files"]["composite.png"] == demo.record["files"]["composite.png"]
    # The light is read off the photo, by what is in the package.
    assert "regression" in demo.record["measured"] and "light" not in demo.record["inputs"]
    assert (out / "progress" / "preview-000000.png").is_file() == (device == "cpu")
    checked = do_task(Task(CHECK, parse(argv).config.flat()))
    assert checked.found == {"is_done": True}, "a batch knows it by the files of the package"


@pytest.mark.slow
def test_more_samples_where_their_noise_would_be_seen(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without ``--samples``; with it there are as many as asked for. The remedy names them."""
    monkeypatch.setattr("warpir.report.result.SEEN_NOISE", 1e-4)
    for asked in (None, "32"):
        out = tmp_path / f"of-{asked}"
        changes = {"width": "384", "device": "cpu", "denoise": "off", "samples": asked}
        measured = go(arguments(inputs, out, **changes), out).record["measured"]
        assert measured["samples"] == 32
        taken = measured["mean_samples"]["object"]
        assert 96.0 < taken <= 128.0 if asked is None else 28.0 < taken <= 32.0
        of_remedy = 4 * max(32, round(taken))
        assert f"--samples {of_remedy}" in (out / "report.html").read_text()


@pytest.mark.slow
def test_preview_of_a_large_photo_is_small(inputs: Path, tmp_path: Path, device: str) -> None:
    """With what stays in front of the object; the result has the photo's size. A card has none."""
    large = {"photo": tmp_path / "photo.png", "mask": tmp_path / "mask.png"}
    Image.fromarray(read_image(inputs / "photo.png")[0]).resize((1728, 1152)).save(large["photo"])
    Image.new("L", (1728, 1152)).save(large["mask"])
    argv = arguments(
        inputs, tmp_path / "out", photo=str(large["photo"]), occluder_mask=str(large["mask"]),
        light=None, at="860,800", place=None, width="64", device=device, samples=None,
    )  # fmt: skip
    run = go(argv, tmp_path / "out")
    assert run.image().shape == (1152, 1728, 3)
    if device == "cpu":
        assert run.image("progress/preview-000000.png").shape == (576, 864, 3)
    else:
        assert not (run.out / "progress").exists()
    assert run.record["measured"]["samples"] == 32
    assert "--samples 128" in (run.out / "report.html").read_text()


@pytest.mark.parametrize("change", ["replaced", "removed"])
def test_inputs_that_change_while_it_renders(
    inputs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: str
) -> None:
    """What was read counts: run.json tells its sha256, and nothing is read again at the end."""
    import warpir.report.result

    photo = tmp_path / "photo.png"
    photo.write_bytes((inputs / "photo.png").read_bytes())
    make = warpir.report.result.make_picture

    def disturbed(*args: Any, **kwargs: Any) -> Any:
        if change == "removed":
            photo.unlink(missing_ok=True)
        else:
            photo.write_bytes(b"another")
        return make(*args, **kwargs)

    monkeypatch.setattr(warpir.report.result, "make_picture", disturbed)
    out = tmp_path / "out"
    changes = {"photo": str(photo), "asset": str(inputs / "box.obj")}
    done = go(arguments(inputs, out, **changes), out)
    expected = {
        name: hashlib.sha256((inputs / file).read_bytes()).hexdigest()
        for name, file in {
            "photo": "photo.png", "light": "sky.hdr",
            "asset": "box.obj", "asset/box.mtl": "box.mtl",
        }.items()
    }  # fmt: skip
    assert done.record["inputs"] == expected


@pytest.mark.slow
def test_camera_that_nothing_tells_is_estimated(inputs: Path, tmp_path: Path) -> None:
    """From the photo to ``run.json`` and ``camera.json``; the same bytes a second time."""
    nothing = {"fov": None, "pitch": None, "camera_height": None, "place": None}
    first, second = (
        go(arguments(inputs, tmp_path / name, **nothing), tmp_path / name) for name in ("a", "b")
    )
    numbers = first.record["measured"]["camera"]
    assert {numbers[name]["source"] for name in ("pitch_deg", "vfov_deg")} == {"estimate"}
    assert numbers["pitch_deg"]["sigma"] > 0.1
    camera = read_camera(first.out / "camera.json", (WIDTH, HEIGHT))
    assert camera.numbers()["pitch_deg"]["value"] == pytest.approx(numbers["pitch_deg"]["value"])
    assert any("estimated from the photo" in line for line in first.record["assumed"])
    for name in ("composite.png", "camera.json"):
        assert (first.out / name).read_bytes() == (second.out / name).read_bytes()
