"""Folds of whole places, replayed photos and joined networks."""

import itertools
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.light import mean_temperature
from tests.builders.image_files import write_envmap
from tests.lighting.test_regressor import SMALL
from warpir.evaluate.stage import unseen_by
from warpir.lighting.regressor import Prediction, load_regressor, mixture, split
from warpir.train.batches import PhotoBatch, Replay
from warpir.train.networks.regressor import random_regressor, read_regressor, save_regressor
from warpir.train.places import of_fold, place_of, some_places
from warpir.train.regressor import join_members
from warpir.train.sampler import Sampler
from warpir.train.scenes.layout import Views, misjudged

NAMES = [f"{place}_{kind}" for place in "abcdefghijk" for kind in ("noon", "night")]


def test_folds_hold_whole_places_each_once() -> None:
    known = ["a_other"]
    folds = [of_fold(NAMES, (k, 4), known) for k in range(4)]
    assert sorted(itertools.chain(*folds)) == sorted(NAMES[2:])
    for fold in folds:
        assert fold and all(
            {f"{place_of(name)}_noon", f"{place_of(name)}_night"} <= set(fold) for name in fold
        )
    assert of_fold(NAMES, None, known) == []
    assert place_of("qwantani_puresky") == place_of("rustig_koppie_puresky")


def test_some_places_begin_with_the_known_ones() -> None:
    few = some_places(NAMES, 6, ["k"])
    assert {"k_noon", "k_night"} < few and len(few) == 6
    assert few < some_places(NAMES, 12, ["k"])
    assert some_places(NAMES, None, []) == set(NAMES)


def test_replayed_photos_are_drawn_from_the_newest() -> None:
    made = []

    def batches(count: int, generator: torch.Generator) -> PhotoBatch:
        made.append(len(made))
        value = torch.full((count,), float(made[-1]))
        return PhotoBatch(**dict.fromkeys(PhotoBatch.__annotations__, value))

    replay, generator = Replay(batches, uses=3, kept=4), torch.Generator().manual_seed(0)
    drawn = [replay(8, generator).share for _ in range(30)]
    assert len(made) == 10
    for step, values in enumerate(drawn):
        newest = step // 3
        assert float(values.max()) <= newest and float(values.min()) >= max(newest - 3, 0)
    assert len(drawn[-1].unique()) > 1


def test_a_misjudged_camera_keeps_its_yaw() -> None:
    """On average the rays are the true ones, and what is ahead stays ahead."""
    count = 4000
    draw = Sampler(count, torch.Generator().manual_seed(0))
    zero, axes = torch.zeros(count), (torch.eye(3)[k].expand(count, 3) for k in range(3))
    views = Views(torch.zeros(count, 3), *axes, zero, zero + 0.6, zero + 0.4)
    rays = misjudged(draw, views).rays((4, 6))
    torch.testing.assert_close(rays.norm(dim=1), torch.ones(count, 4, 6))
    truth = views.rays((4, 6))[:1]
    angle = torch.rad2deg(torch.acos((rays * truth).sum(dim=1).clamp(-1.0, 1.0)))
    assert 2.0 < float(angle.mean()) < 6.0
    middle = rays[:, :, 1:3, 2:4].mean(dim=(2, 3))
    assert float(middle[:, 0].abs().max()) < 0.02
    torch.testing.assert_close(rays.mean(dim=0), truth[0], atol=0.01, rtol=0)


def test_joined_networks_answer_with_the_mean_and_its_doubt(tmp_path: Path) -> None:
    """Logits at each member's temperature and levels are averaged; disagreement adds variance."""
    torch.manual_seed(0)  # one of a hundred draws has a variance at which logarithms are cut
    paths, networks = [], []
    for seed, temperature in ((0, 2.0), (1, 0.5)):
        network = random_regressor(seed, SMALL)
        network.temperature.fill_(temperature)
        network.directions.copy_(network.directions.flip(0))
        torch.nn.init.normal_(network.members[0].level_head[-1].weight)
        paths.append(tmp_path / f"{seed}.safetensors")
        save_regressor(network, paths[-1], {"panoramas": [f"place_{seed}"]})
        networks.append(read_regressor(paths[-1]))
    join_members(paths, tmp_path / "joined.safetensors")
    joined = read_regressor(tmp_path / "joined.safetensors")
    assert joined.config.members == 2 and float(joined.temperature) == 1.0
    assert [m["panoramas"] for m in joined.record["members"]] == [["place_0"], ["place_1"]]
    torch.testing.assert_close(joined.directions, networks[0].directions)
    photo = torch.rand(3, 3, 96, 144)
    rays = torch.nn.functional.normalize(torch.randn(3, 3, 96, 144), dim=1)
    each = [split(n(photo, rays)[0].detach()) for n in networks]
    flats = joined(photo, rays).detach().numpy()
    both = Prediction(*map(torch.from_numpy, mixture(flats)))
    logits = [p.logits / n.temperature for p, n in zip(each, networks, strict=True)]
    torch.testing.assert_close(both.logits, sum(logits) / 2.0, atol=2e-2, rtol=2e-2)
    torch.testing.assert_close(both.level, sum(p.level for p in each) / 2.0, atol=1e-3, rtol=1e-3)
    gap = 0.5 * (each[0].level - each[1].level)
    variance = sum(p.level_log_var.exp() for p in each) / 2.0 + gap**2
    torch.testing.assert_close(both.level_log_var, variance.log(), atol=1e-2, rtol=1e-2)


@pytest.mark.slow
def test_the_means_temperature_is_set_by_a_folder_of_places(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    rng: np.random.Generator,
) -> None:
    for place in ("here", "there"):
        write_envmap(tmp_path / place, place, rng.random((64, 128, 3)).astype(np.float32))
    car = Path(__file__).parents[2] / "warpir" / "demo" / "car.glb"
    argv = ["", str(tmp_path), "--asset", str(car), "--scenes", "2"]
    monkeypatch.setattr(sys, "argv", argv)
    mean_temperature.main()
    assert capsys.readouterr().out.splitlines()[-1].startswith("all: ")


def test_a_fold_that_makes_no_sense_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    from warpir.train.command import main

    assert main(["regressor", "--panoramas", ".", "--out", "out", "--fold", "5/5"]) == 2
    assert "--fold" in capsys.readouterr().err


def test_a_panorama_is_judged_by_the_networks_that_have_not_learned_from_it(
    tmp_path: Path,
) -> None:
    paths = []
    for k in range(3):
        paths.append(tmp_path / f"{k}.safetensors")
        two = ["two"] if k < 2 else []
        names = ["all", f"p{k}", *two, "grass_1k"]
        record = {"panoramas": names, "started_from": {"panoramas": ["old"]}}
        save_regressor(random_regressor(k, SMALL), paths[-1], record)
    join_members(paths, tmp_path / "joined.safetensors")
    joined = replace(load_regressor(tmp_path / "joined.safetensors"), temperature=0.5)
    assert unseen_by(joined, "new") is joined
    assert unseen_by(joined, "old") is None and unseen_by(joined, "all") is None
    # The same places in other sizes, as Poly Haven names its files
    assert unseen_by(joined, "all_2k") is None and unseen_by(joined, "grass_16k") is None
    assert unseen_by(joined, "grass_1") is joined
    part = unseen_by(joined, "p1")
    assert part is not None and part.members == (0, 2)
    assert part.temperature == 0.5  # that of the mean
    single = unseen_by(joined, "two")
    assert single is not None and single.members == (2,)
    assert single.temperature == 1.0  # a network's own is in its logits
    photo, rays = torch.rand(96, 144, 3).double().numpy(), torch.zeros(96, 144, 3).numpy()
    alone = [load_regressor(paths[k]).predict(photo, rays).level for k in (0, 2)]
    assert part.predict(photo, rays).level == pytest.approx(sum(alone) / 2.0)
