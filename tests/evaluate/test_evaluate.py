"""The evaluation: scenes from a seed, rows that must be right or wrong, intervals, the command."""

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

import warpir
from tests.builders.image_files import write_envmap
from tests.builders.shapes import a_camera
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from tests.lighting.test_regressor import SMALL
from warpir.app.config import InsertConfig
from warpir.app.run import Run
from warpir.core.arrays import FloatArray
from warpir.core.color import expose
from warpir.core.errors import ExitCode, InputError
from warpir.core.latlong import map_directions, rotate_map, texel_solid_angles
from warpir.evaluate import results
from warpir.evaluate.command import main
from warpir.evaluate.judge import light_figures
from warpir.evaluate.light_errors import light_errors
from warpir.evaluate.report import (
    Entry,
    bootstrap,
    by_kind,
    compare,
    kind_table,
    mean_of,
    summarize,
)
from warpir.evaluate.rows import ROWS, chosen_rows, usable_rows
from warpir.evaluate.scenes import (
    HEIGHT_SHARE,
    RESPONSES,
    Place,
    Places,
    Subject,
    crop_camera,
    crop_radiance,
    find_files,
    mirrored,
)
from warpir.evaluate.stage import Bench, Prediction, Stage
from warpir.lighting.regression import Regression, regress
from warpir.lighting.regressor import load_regressor
from warpir.render.picture.quality import Quality
from warpir.scene.light import Light, Lobes, as_map, axis_from_angles, rasterize_lobes
from warpir.scene.tone_curves import Curves
from warpir.train.networks.regressor import random_regressor, save_regressor
from warpir.train.regressor import join_members

SUNS = {"east": (70.0, 35.0), "west": (-110.0, 50.0), "north": (10.0, 20.0)}
"""Azimuth and elevation of the made-up panoramas' suns [deg]."""
WIDTH = 64
Scenes = list[tuple[Place, list[Subject]]]


def panorama(azimuth: float, elevation: float) -> FloatArray:
    """A blue sky over mottled ground, and a sun that gives two thirds of the light."""
    directions = map_directions(64, 128)
    texels = np.where(directions[..., 1:2] > 0.0, (0.3, 0.45, 0.8), (0.25, 0.2, 0.12))
    texels = texels * (1.0 + 0.3 * np.sin(9.0 * directions[..., :1]))
    row, column = np.unravel_index(
        int(np.argmax(directions @ axis_from_angles(azimuth, elevation))), (64, 128)
    )
    texels[row, column] = 10.0 / texel_solid_angles(64, 128)[row]
    return texels.astype(np.float32)


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folders ``panoramas`` and ``assets``, and ``regressor.safetensors`` with random weights."""
    folder = tmp_path_factory.mktemp("data")
    for name, sun in SUNS.items():
        write_envmap(folder / "panoramas" / name, name, panorama(*sun))
    (folder / "assets").mkdir()
    trimesh.creation.box((1.0, 0.7, 0.5)).export(folder / "assets" / "cube.ply")
    save_regressor(random_regressor(3), folder / "regressor.safetensors", {})
    return folder


def make_places(data: Path, seed: int = 5, response: str = "gamma") -> Places:
    panoramas = find_files([data / "panoramas"], (".exr", ".hdr"), "--panoramas")
    assets = find_files([data / "assets"], (".ply",), "--assets")
    return Places(panoramas, assets, seed, WIDTH, response=response)


@pytest.fixture(scope="module")
def scenes(data: Path) -> Scenes:
    return make_places(data).make(3)


def sunlit(subject: Subject, samples: int = 32) -> Stage:
    return Stage(subject, "cpu", Quality(samples, 2, 2, 1, 8.0))


def make_bench(data: Path, scenes: Scenes) -> Bench:
    config = InsertConfig(regressor=str(data / "regressor.safetensors"))
    return Bench(scenes, "cpu", 0, config)


# ---------------------------------------------------------------------------------------- scenes


def test_scenes_follow_from_the_seed_alone(data: Path, scenes: Scenes) -> None:
    """Fewer scenes are the first ones of more; another seed gives others."""
    again = make_places(data).make(2)
    for (place, subjects), (same, others) in zip(scenes, again, strict=False):
        assert (place.name, place.azimuth, place.pitch) == (same.name, same.azimuth, same.pitch)
        assert np.array_equal(place.photo, same.photo)
        for a, b in zip(subjects, others, strict=True):
            assert a.name == b.name
            assert np.array_equal(a.placement.asset_to_world, b.placement.asset_to_world)
    other = make_places(data, seed=6).make(1)[0][0]
    assert not np.array_equal(other.photo, scenes[0][0].photo)


def test_every_panorama_is_seen_before_one_is_seen_again(data: Path) -> None:
    made = make_places(data).make(6)
    names = [place.panorama for place, _ in made]
    assert set(names[:3]) == set(names[3:]) == set(SUNS)
    assert len({place.name for place, _ in made}) == 6
    assert len({place.azimuth for place, _ in made}) > 3


def test_files_that_cannot_be_used_are_left_out(data: Path, tmp_path: Path) -> None:
    (tmp_path / "broken.exr").write_bytes(b"no picture")
    good = data / "panoramas" / "east" / "east.exr"
    places = Places([tmp_path / "broken.exr", good], [data / "assets" / "cube.ply"], 0, WIDTH)
    assert [p.panorama for p, _ in places.make(3)] == ["east"] * 3
    assert len(places.notices) == 1
    assert "broken.exr" in places.notices[0]
    with pytest.raises(InputError, match="none of the files"):
        Places([tmp_path / "broken.exr"], [data / "assets" / "cube.ply"], 0, WIDTH).make(1)


def test_objects_have_room_in_the_narrowest_photographs(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those that look down most, with the foot as high as it may be."""
    monkeypatch.setattr("warpir.evaluate.scenes.PITCH", (-15.0, -14.99))
    monkeypatch.setattr("warpir.evaluate.scenes.FOOT_ROW", (0.35, 0.351))
    files = [[data / "panoramas" / "east" / "east.exr"], [data / "assets" / "cube.ply"]]
    for place, subjects in Places(*files, 0, WIDTH, fov=20.0).make(6):
        assert sunlit(subjects[0], 1).mask.any(), place.name


def test_objects_stand_in_view_at_the_stated_size(data: Path) -> None:
    for place, (diffuse, glossy) in make_places(data, seed=11).make(6):
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        low, high = diffuse.asset.bounds()
        matrix = diffuse.placement.asset_to_world
        world = (low + corners * (high - low)) @ matrix[:3, :3].T + matrix[:3, 3]
        assert world[:, 1].min() == pytest.approx(0.0, abs=1e-9)
        pixels = place.camera.project(world) / (place.camera.width, place.camera.height)
        assert pixels.min() >= 0.0
        assert pixels.max() <= 1.0
        height = np.ptp(pixels[:, 1])
        assert height <= HEIGHT_SHARE[1] + 1e-6
        assert height >= HEIGHT_SHARE[0] - 1e-6 or np.ptp(pixels[:, 0]) > 0.44
        assert np.array_equal(matrix, glossy.placement.asset_to_world)
        assert [m.metallic for m in diffuse.asset.materials] == [0.0]
        assert [m.metallic for m in glossy.asset.materials] == [1.0]


def test_the_camera_frame_has_ahead_at_minus_z(scenes: Scenes) -> None:
    """A sun at azimuth a, seen by a camera turned to b, is at a - b in the camera-yaw frame."""
    for place, _ in scenes:
        turned = place.to_camera(place.texels)
        height, width = turned.shape[:2]
        peak = np.unravel_index(int(np.argmax(turned.sum(axis=-1))), (height, width))
        azimuth, elevation = SUNS[place.panorama]
        wanted = axis_from_angles(azimuth - place.azimuth, elevation)
        # A texel of the panorama is 2.8 degrees wide, the peak is somewhere in its middle.
        assert map_directions(height, width)[peak] @ wanted > np.cos(np.radians(3.0))
        assert np.array_equal(place.to_world(turned), place.texels)


def test_photographs_are_the_light_at_its_exposure(data: Path) -> None:
    """What is not clipped decodes to radiance times exposure, through the camera's response."""
    for response in RESPONSES:
        place, _ = make_places(data, response=response).make(1)[0]
        seen = crop_radiance(panorama(*SUNS[place.panorama]), place.camera) * place.exposure
        shown = RESPONSES[response].show(seen) ** (1.0 / 2.2)
        assert np.abs(place.photo - shown).max() <= 0.5 / 255.0 + 2e-3
        assert place.is_sunny


def test_responses_can_be_inverted() -> None:
    x = np.linspace(0.0, 0.9, 50)
    for response in RESPONSES.values():
        shown = response.show(x)
        assert shown.min() >= 0.0
        assert shown.max() <= 1.0
        assert response.invert(shown) == pytest.approx(x, abs=1e-9)


def test_a_mirrored_light_has_left_and_right_exchanged() -> None:
    """Lobes and maps are mirrored alike; twice is the light itself; ahead stays ahead."""
    azimuth = 45.0
    lobes = Lobes(
        np.array([[1.0, 2.0, 3.0]], np.float32),
        axis_from_angles(azimuth + 30.0, 20.0)[None].astype(np.float32),
        np.array([50.0], np.float32),
    )
    flipped = mirrored(Light(lobes), azimuth).lobes
    assert flipped is not None
    assert flipped.axis[0] == pytest.approx(axis_from_angles(azimuth - 30.0, 20.0), abs=1e-6)
    texels = rasterize_lobes(lobes, 32, 64)
    from_map = mirrored(Light(texels=texels), azimuth).texels
    assert from_map == pytest.approx(rasterize_lobes(flipped, 32, 64), abs=1e-3)
    assert np.array_equal(mirrored(Light(texels=from_map), azimuth).texels, texels)


# ------------------------------------------------------------------------------------------ rows


def test_the_fitted_exposure_undoes_a_dimmed_light(scenes: Scenes) -> None:
    """The same random numbers make radiance linear in the light, so the factor is exact."""
    place, (diffuse, _) = scenes[0]
    stage = sunlit(diffuse)
    dim = Light(texels=(place.texels / np.float32(8.0)).astype(np.float32))
    prediction = Prediction(dim, dim, None)
    rendered = stage.render(prediction)
    gain = stage.fit_exposure(rendered, None)
    assert gain == pytest.approx(8.0, rel=0.01)
    before = np.abs(stage.compose(rendered, None) - stage.truth).max()
    after = np.abs(stage.compose(rendered, None, gain) - stage.truth).max()
    assert after < 0.05 * before


def test_identity_curves_are_the_gamma_response_and_not_the_filmic_one(data: Path) -> None:
    for response in RESPONSES:
        _, (diffuse, _) = make_places(data, response=response).make(1)[0]
        stage = sunlit(diffuse, 8)
        image = stage.compose(stage.true, Curves.identity("linear"))
        difference = np.abs(image - stage.truth).max()
        assert difference < 1e-5 if response == "gamma" else difference > 0.02
        # Far from object and shadow the photograph is untouched.
        outside = (stage.mask == 0.0) & (stage.ratio == 1.0).all(axis=-1)
        assert outside.any()
        assert np.abs(stage.truth - stage.place.photo)[outside].max() < 1e-5


def test_the_tone_floor_is_below_reinhard_alone(scenes: Scenes) -> None:
    _, (diffuse, _) = scenes[1]
    stage = sunlit(diffuse, 8)

    def error(curves: Curves) -> float:
        return float(np.square(stage.compose(stage.true, curves) - stage.truth).mean())

    assert error(stage.tone_floor()) < 0.05 * error(Curves.identity("reinhard"))


def test_the_brightest_region_is_where_the_sun_is_seen(data: Path, scenes: Scenes) -> None:
    """A panorama turned so that its sun is in the picture."""
    azimuth, elevation = SUNS["north"]
    camera = crop_camera(96, 64, 80.0, azimuth - 15.0, 0.0, 1.6)
    photo, _ = expose(crop_radiance(panorama(azimuth, elevation), camera))
    place = replace(scenes[0][0], camera=camera, photo=photo.astype(np.float32))
    found = ROWS["brightest-region"].of_place
    assert found is not None
    lobes = found(make_bench(data, scenes), place).light.lobes
    assert lobes is not None
    assert lobes.axis[0] @ axis_from_angles(azimuth, elevation) > np.cos(np.radians(5.0))


def test_rows_are_named_or_chosen_by_group() -> None:
    assert chosen_rows("uniform,truth", False) == ["truth", "uniform"]
    assert set(chosen_rows("baselines", False)) == {
        "uniform", "mean-training-light", "brightest-region",
    }  # fmt: skip
    assert "predictions" in chosen_rows(None, True)
    plain, guided = (chosen_rows(None, False, is_guided) for is_guided in (False, True))
    assert set(guided) - set(plain) == {"lds-uniform", "lds-regression"} and "regression" in plain
    assert chosen_rows("lds-regression", False, False) == ["lds-regression"]
    assert "predictions" not in chosen_rows("all", False)
    for text in ("unifrom", "truth,,uniform"):
        with pytest.raises(InputError) as caught:
            chosen_rows(text, False)
        assert caught.value.code == ExitCode.USAGE
    with pytest.raises(InputError):
        chosen_rows("predictions", False)


def test_the_true_light_has_no_error_and_a_turned_one_has_its_angle(scenes: Scenes) -> None:
    place = scenes[0][0]
    errors = light_figures(place, place.texels)
    assert errors["light.peak_angle_deg"] == 0.0
    assert errors["spheres.linear_diffuse_rmse"] == 0.0
    turned = light_figures(place, rotate_map(place.texels, 90.0))
    elevation = np.radians(SUNS[place.panorama][1])
    # Two directions of one elevation e, 90 degrees apart: cos = sin^2 e
    wanted = np.degrees(np.arccos(np.sin(elevation) ** 2))
    assert turned["light.peak_angle_deg"] == pytest.approx(wanted, abs=3.0)


# ------------------------------------------------------------------------------------ statistics


def test_bootstrap_interval_of_a_normal_mean(rng: np.random.Generator) -> None:
    """1.96 standard errors either way."""
    values = rng.normal(3.0, 2.0, 400)
    low, high = bootstrap(values.tolist(), [str(k) for k in range(400)])
    error = values.std() / np.sqrt(400)
    assert (high - low) / 2.0 == pytest.approx(1.96 * error, rel=0.04)
    assert (high + low) / 2.0 == pytest.approx(values.mean(), abs=0.1 * error)


def test_bootstrap_draws_groups_as_a_whole(rng: np.random.Generator) -> None:
    """Ten equal values in each of 60 groups tell no more than one."""
    values = rng.normal(0.0, 1.0, 60)
    groups = [str(k) for k in range(60)]
    once = bootstrap(values.tolist(), groups)
    often = bootstrap(np.repeat(values, 10).tolist(), [g for g in groups for _ in range(10)])
    assert often == pytest.approx(once)


def entry(row: str, scene: str, value: float, material: str = "diffuse") -> Entry:
    return Entry(row, scene, scene[0], True, material, {"image.box.rmse": value}, {})


def test_kinds_of_places_have_means_of_their_own() -> None:
    entries = [
        Entry("a", scene, scene[0], False, "diffuse", {"image.box.rmse": error}, {}, kind)
        for scene, error, kind in (("x1", 0.1, "night"), ("x2", 0.3, "night"), ("y", 0.5, ""))
    ]
    kinds = by_kind(entries)
    assert kinds == {"night": {"a": {"scenes": 2, "panoramas": 1, "image.box.rmse": 0.2}}}
    assert any("| night | 2 (1) | a |" in line for line in kind_table(kinds))
    assert list(kind_table(by_kind(entries[2:]))) == []


def test_pairs_are_compared_scene_by_scene() -> None:
    """Scenes differ by far more than rows do; the pairs see the rows."""
    entries = []
    for k in range(20):
        base = 0.1 * k
        entries += [
            entry("uniform", f"{k}", base + 0.02),
            entry("lds-uniform", f"{k}", base + (0.0 if k else 0.05)),
        ]
    pair = next(p for p in compare(entries, {"lds-uniform": "uniform"}) if p.group == "all")
    assert (pair.row, pair.against, pair.is_start) == ("lds-uniform", "uniform", True)
    assert (pair.better, pair.worse) == (19, 1)
    assert pair.difference.mean == pytest.approx((-0.02 * 19 + 0.03) / 20)
    assert pair.difference.is_sure
    summary = summarize(entries)
    rows = [summary[row]["all"]["image.box.rmse"] for row in ("uniform", "lds-uniform")]
    assert rows[0].low < rows[1].mean < rows[0].high


def test_a_scene_counts_once_whatever_stands_in_it() -> None:
    entries = [entry("r", "a", 1.0), entry("r", "a", 3.0, "glossy"), entry("r", "b", 5.0)]
    summary = summarize(entries)["r"]
    assert summary["all"]["image.box.rmse"].mean == 3.5
    assert summary["all"]["image.box.rmse"].count == 2
    assert summary["glossy"]["image.box.rmse"].mean == 3.0
    assert mean_of({"a": 2.0}, {"a": "p"}).low == 2.0


# ----------------------------------------------------------------------------------- the command


def arguments(data: Path, *more: str) -> list[str]:
    paths = ["--panoramas", str(data / "panoramas"), "--assets", str(data / "assets")]
    small = ["--width", str(WIDTH), "--samples", "8", "--device", "cpu", "--seed", "5"]
    return [*paths, *small, *more]


@pytest.mark.slow
def test_main_judges_rows_and_writes_everything(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, numbers = tmp_path / "out", tmp_path / "numbers.json"
    rows = "truth,oracle,turned-180,uniform,regression,mirrored"

    status = main(
        arguments(
            data,
            *("--scenes", "2", "--rows", rows, "--json", str(numbers), "--out", str(out)),
            *("--regressor", str(data / "regressor.safetensors")),
        )
    )

    printed = capsys.readouterr()
    assert status == 0, printed.err
    record = json.loads(numbers.read_text())
    assert [s["name"][:3] for s in record["scenes"]] == ["000", "001"]
    assert all(s["is_sunny"] for s in record["scenes"])
    assert len(record["weights"]["regressor"]) == 64
    mean = {row: groups["all"] for row, groups in record["summary"].items()}
    assert set(mean) == set(chosen_rows(rows, False))
    for figures in (mean["truth"],):
        for region in ("full", "box", "asset", "shadow"):
            assert figures[f"image.{region}.rmse"]["mean"] == 0.0
            assert figures[f"image.{region}.si_rmse"]["mean"] == pytest.approx(0.0, abs=1e-7)
        assert figures["light.peak_angle_deg"]["mean"] == 0.0
    # What comes near the truth, and what must not
    asset = {row: figures["image.asset.rmse"]["mean"] for row, figures in mean.items()}
    assert asset["oracle"] < asset["turned-180"]
    angle = {row: figures["light.peak_angle_deg"]["mean"] for row, figures in mean.items()}
    assert angle["oracle"] < 5.0 < 60.0 < angle["turned-180"]
    # A network that was never trained flips its answer all the same
    assert mean["mirrored"]["light.same_deg"]["mean"] == pytest.approx(0.0, abs=1e-3)
    assert mean["uniform"]["fitted.asset.rmse"]["mean"] <= asset["uniform"] + 1e-9
    for text in ((out / "tables.md").read_text(), printed.out):
        assert "| oracle |" in text
        assert "## Composites: glossy (2 scenes)" in text
        assert "| regression | uniform |" in text
    sheet = np.asarray(Image.open(out / "contact_sheet.png"))
    assert sheet.shape == (4 * (28 + round(WIDTH / 1.5)), 4 * WIDTH, 3)


@pytest.mark.slow
def test_main_scores_maps_that_another_system_made(data: Path, tmp_path: Path) -> None:
    """The true light, written as the exported index asks for it, comes back without an error."""
    crops, maps = tmp_path / "crops", tmp_path / "maps"
    chosen = arguments(data, "--scenes", "2", "--rows", "uniform")
    assert main([*chosen, "--export-crops", str(crops)]) == 0
    index = json.loads((crops / "crops.json").read_text())
    index["maps"] = {"frame": "level", "scale": 1.0}
    maps.mkdir()
    (maps / "crops.json").write_text(json.dumps(index))
    for place, _ in make_places(data).make(2):
        assert (crops / f"{place.name}.png").is_file()
        # Image centre = ahead; in the camera-yaw frame ahead is at both edges.
        centred = np.roll(place.to_camera(place.texels), place.texels.shape[0], axis=1)
        np.save(maps / f"{place.name}.npy", centred)

    numbers = tmp_path / "numbers.json"
    assert main([*chosen, "--predictions", str(maps), "--json", str(numbers)]) == 0

    summary = json.loads(numbers.read_text())["summary"]
    assert summary["predictions"]["all"]["light.peak_angle_deg"]["mean"] == pytest.approx(0.0)
    assert summary["predictions"]["all"]["image.full.rmse"]["mean"] < 1e-6
    assert summary["uniform"]["all"]["image.full.rmse"]["mean"] > 0.01


@pytest.mark.slow
def test_scenes_without_a_map_or_a_kind_are_left_out(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (place, _), (other, _) = make_places(data).make(2)
    np.save(tmp_path / f"{place.name}.npy", np.ones((8, 16, 3)))
    numbers, kinds = tmp_path / "numbers.json", tmp_path / "kinds.json"
    kinds.write_text(json.dumps({f"{place.panorama}_4k": "sunny"}))
    chosen = arguments(data, "--scenes", "2", "--rows", "uniform", "--samples", "1")
    chosen += ["--predictions", str(tmp_path), "--kinds", str(kinds), "--json", str(numbers)]
    assert main(chosen) == 0
    printed = capsys.readouterr().out
    assert "notice: 1 scenes have no map" in printed and "| sunny | 1 (1) | uniform |" in printed
    assert f"notice: no kind of {other.panorama} in" in printed
    summary = json.loads(numbers.read_text())["summary"]
    counts = {row: groups["all"]["image.box.rmse"]["count"] for row, groups in summary.items()}
    assert counts == {"uniform": 2, "predictions": 1}


def test_main_says_in_a_line_what_is_wrong(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    cases = [
        (["--assets", str(data)], ExitCode.USAGE, "--panoramas"),
        (arguments(data, "--rows", "best"), ExitCode.USAGE, "best"),
        (arguments(data, "--curve", "log"), ExitCode.USAGE, "log"),
        (arguments(data, "--scenes", "0"), ExitCode.USAGE, "--scenes"),
        (arguments(data, "--width", "9"), ExitCode.USAGE, "--width"),
        (arguments(data, "--fov", "12"), ExitCode.USAGE, "between 20 and 120 degrees"),
        (arguments(data, "--seed", "x"), ExitCode.USAGE, "--seed: expected a whole number"),
        (arguments(data, "--camera"), ExitCode.USAGE, "--assets: has no use with --camera"),
        (arguments(data, "--json", str(tmp_path)), ExitCode.OUTPUT, "a folder"),
        (arguments(data / "absent"), ExitCode.INPUT, "absent"),
        (["--panoramas", str(data / "assets"), "--assets", str(data)], ExitCode.INPUT, "nothing"),
        (
            arguments(data, "--rows", "regression", "--regressor", str(tmp_path / "none")),
            ExitCode.MODEL,
            "none",
        ),
        (arguments(data, "--lpips", str(tmp_path / "none")), ExitCode.USAGE, "--lpips"),
        (arguments(data, "--out", str(tmp_path / "full")), ExitCode.OUTPUT, "full"),
    ]
    for argv, status, word in cases:
        assert main(argv) == status, argv
        error = capsys.readouterr().err
        assert error.startswith("error: "), error
        assert word in error.splitlines()[0]


def test_a_row_that_cannot_be_made_is_left_out_unless_it_was_named(data: Path) -> None:
    """With one panorama there is no other scene."""
    good = data / "panoramas" / "east" / "east.exr"
    bench = make_bench(data, Places([good], [data / "assets" / "cube.ply"], 0, WIDTH).make(2))
    notices: list[str] = []
    assert usable_rows(bench, ["truth", "other-light", "regression"], False, notices) == [
        "truth", "regression",
    ]  # fmt: skip
    assert "other-light" in notices[0]
    with pytest.raises(InputError, match="two panoramas"):
        usable_rows(bench, ["truth", "other-light"], True, notices)


def test_guided_rows_start_from_networks_that_have_not_learned_from_the_panorama(
    data: Path, scenes: Scenes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = scenes[0][1][0]
    paths = [tmp_path / f"{k}.safetensors" for k in range(2)]
    for k, path in enumerate(paths):
        record = {"panoramas": [subject.place.panorama]} if k else {}
        save_regressor(random_regressor(k, SMALL), path, record)
    join_members(paths, tmp_path / "both.safetensors")
    config = InsertConfig(regressor=str(tmp_path / "both.safetensors"))
    starts = []

    def recover(run: Run, given: object, regression: Regression) -> None:
        starts.append(regression.probability)
        raise InterruptedError

    monkeypatch.setattr("warpir.evaluate.rows.recover", recover)
    row = ROWS["lds-regression"].of_subject
    assert row is not None
    with pytest.raises(InterruptedError):
        row(Bench(scenes, "cpu", 0, config), sunlit(subject, 1), subject)
    place = subject.place
    alone = regress(load_regressor(paths[0]), place.photo, place.camera)
    assert np.allclose(starts[0], alone.probability, atol=1e-4)


def test_the_commit_is_this_checkouts_or_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A machine without git, and a package that is installed inside of another repository."""
    monkeypatch.setenv("PATH", "")
    assert results.commit() == "unknown"
    monkeypatch.undo()
    installed = tmp_path / "venv" / "warpir"
    installed.mkdir(parents=True)
    who = ("-c", "user.name=a", "-c", "user.email=a@b")
    for words in (("init", "-q"), (*who, "commit", "-q", "--allow-empty", "-m", "a")):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True)
    for module in (warpir, results):
        monkeypatch.setattr(module, "__file__", str(installed / "results.py"))
    assert results.commit() == "unknown"


def test_a_panorama_that_all_networks_have_learned_from_is_named(
    data: Path, scenes: Scenes, tmp_path: Path
) -> None:
    """Also where the file that was learned from had another size."""
    path = tmp_path / "regressor.safetensors"
    save_regressor(random_regressor(3), path, {"panoramas": ["east_2k"]})
    bench = Bench(scenes, "cpu", 0, InsertConfig(regressor=str(path)))
    notices: list[str] = []
    assert usable_rows(bench, ["truth"], True, notices) and not notices
    assert usable_rows(bench, ["truth", "regression"], True, notices)
    assert len(notices) == 1 and "learned from east:" in notices[0]


def test_other_scenes_are_seen_by_this_camera(data: Path, scenes: Scenes) -> None:
    """Another place's light keeps its place in the picture: both agree in the camera-yaw frame."""
    bench = make_bench(data, scenes)
    place = scenes[0][0]
    other = bench.other(place)
    assert other.panorama != place.panorama
    from_map, from_photo = ROWS["other-light"].of_place, ROWS["other-photo"].of_place
    regression = ROWS["regression"].of_place
    assert from_map is not None and from_photo is not None and regression is not None
    texels = from_map(bench, place).light.texels
    assert texels is not None
    assert np.array_equal(place.to_camera(texels), other.to_camera(other.texels))
    seen, own = (as_map(p.light, 32) for p in (from_photo(bench, place), regression(bench, other)))
    assert light_errors(place.to_camera(seen), other.to_camera(own))["peak_angle_deg"] < 6.0


def test_estimated_camera_that_is_right_gives_the_same_light(
    data: Path, scenes: Scenes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the true camera only the azimuth is used; another pitch gives another light."""
    bench = make_bench(data, scenes)
    place = scenes[0][0]
    known, estimated = ROWS["regression"].of_place, ROWS["regression-estimated-camera"].of_place
    assert known is not None and estimated is not None
    vfov = np.degrees(2.0 * np.arctan(place.camera.height / 2.0 / place.camera.fy))
    found = a_camera(pitch_deg=place.pitch, vfov_deg=float(vfov))
    monkeypatch.setattr("warpir.evaluate.rows.estimate_camera", lambda *_: found)
    expected, seen = (as_map(row(bench, place).light, 32) for row in (known, estimated))
    np.testing.assert_allclose(seen, expected, rtol=1e-3, atol=1e-5)
    wrong = replace(found, pitch_deg=place.pitch + 30.0)
    monkeypatch.setattr("warpir.evaluate.rows.estimate_camera", lambda *_: wrong)
    assert not np.allclose(as_map(estimated(bench, place).light, 32), expected, rtol=1e-2)


@pytest.mark.slow
def test_guided_rows_run_what_insert_runs(data: Path, tmp_path: Path) -> None:
    """With random weights: they end, say who guided, and the mirrored run too."""
    model = make_tiny_stable_diffusion(tmp_path / "model")
    numbers = tmp_path / "numbers.json"
    rows = "regression,lds-regression,lds-mirrored,s3-sds-no-lora"

    status = main(
        arguments(
            data,
            *("--scenes", "1", "--rows", rows, "--json", str(numbers), "--steps", "2"),
            *("--regressor", str(data / "regressor.safetensors"), "--model", str(model)),
        )
    )

    assert status == 0
    record = json.loads(numbers.read_text())
    entries = {(e["row"], e["material"]): e for e in record["entries"]}
    assert len(entries) == 8
    for material in ("diffuse", "glossy"):
        found = entries["lds-regression", material]
        said = found["about"]["record"]
        assert said["prior"] == "stable-diffusion" and len(said["prior_sha256"]) == 64
        assert entries["s3-sds-no-lora", material]["about"]["record"]["prompts"]
        # Mirrored back, the light is where it was found.
        assert entries["lds-mirrored", material]["figures"]["light.same_deg"] < 20.0
    starts = {(p["row"], p["against"]) for p in record["pairs"] if p["is_start"]}
    assert starts == {("lds-regression", "regression")}
