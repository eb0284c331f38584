"""One look for a sequence: its first frame that shows the object tells it for all of its size."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from tests.builders.insertions import Run, arguments, go, record_of
from tests.builders.outcome import outcome
from tests.look.test_toning import TONES, a_scene
from warpir.core.errors import ExitCode
from warpir.insert import main

FAST: dict[str, str | None] = {"samples": "1", "depth": "1", "device": "cpu"}
PARTS = ("blur", "grain", "response")


@pytest.fixture(scope="module", autouse=True)
def without_ffmpeg(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Frames have no video here, whatever is installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(tmp_path_factory.mktemp("empty")))
        yield


def write_photographed(path: Path, seed: int, blur: float, size: tuple[int, int]) -> None:
    """Write turned squares from black to white behind a blur [px] and two codes of grain."""
    rng = np.random.default_rng(seed)
    height, width = size
    y, x = np.mgrid[0:height, 0:width]
    scene = np.full(size, 0.2)
    for value in (0.0, 0.002, 0.02, 0.3, 0.6, 0.05, 0.0, 0.8):
        turn, (cy, cx) = rng.uniform(0.0, np.pi), rng.uniform(0.1, 0.9, 2) * size
        across = (x - cx) * np.cos(turn) + (y - cy) * np.sin(turn)
        along = (y - cy) * np.cos(turn) - (x - cx) * np.sin(turn)
        scene[(np.abs(across) < height / 6) & (np.abs(along) < height / 6)] = value
    shown = np.repeat(ndimage.gaussian_filter(scene, blur)[..., None], 3, axis=2) ** (1 / 2.2)
    shown += 2.0 / 255.0 * rng.normal(size=shown.shape)
    codes = np.round(255.0 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)
    Image.fromarray(codes).save(path, quality=92)


@pytest.fixture(scope="module")
def film(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], Path, Run]:
    """Four frames: the object behind the camera, twice in view, and in a larger photo.

    Returns:
        The command, its folder and the run whose light it has, of the second frame's photo.
    """
    folder = tmp_path_factory.mktemp("film")
    small = (96, 144)
    frames = (("1.png", 1.6, small), ("2.jpg", 0.8, small), ("3.png", 1.6, small))
    for seed, (name, blur, size) in enumerate((*frames, ("4.png", 1.2, (128, 192)))):
        write_photographed(folder / name, seed, blur, size)
    lines = [{"photo": str(folder / name)} for name in ("1.png", "2.jpg", "3.png", "4.png")]
    behind: dict[str, Any] = {"place": [0, 0, 50]}
    (folder / "s.jsonl").write_text(
        "\n".join(json.dumps(line) for line in [lines[0] | behind, *lines[1:]])
    )
    photo = {"photo": str(folder / "2.jpg"), **FAST}
    light = go(arguments(inputs, folder / "light", **photo), folder / "light")
    given = {"light": None, "reuse": str(light.out), "sequence": str(folder / "s.jsonl"), **FAST}
    argv = arguments(inputs, folder / "out", **given)
    assert main(argv) == ExitCode.DONE
    return argv, folder / "out", light


def looks_of(out: Path) -> list[dict[str, Any]]:
    return [record_of(out / f"000{k}")["measured"]["look"] for k in (1, 2, 3, 4)]


def test_frames_of_one_size_have_one_look(film: tuple[list[str], Path, Run]) -> None:
    """That of the first that shows the object, which is its own run's; blocks are each photo's."""
    _, out, single = film
    looks, own = looks_of(out), single.record["measured"]["look"]
    assert [look["frame"] for look in looks] == ["0002", "0002", "0002", "0004"]
    for part in PARTS:
        assert own[part] is not None and [look[part] for look in looks[:3]] == [own[part]] * 3
        assert looks[3][part] != own[part], part
    assert ["jpeg" in look for look in looks] == [False, True, False, False]
    assert "frame" not in own
    for name in ("composite.png", "layers.exr"):
        assert record_of(out / "0002")["files"][name] != record_of(out / "0003")["files"][name]
    for folder, told in (("0001", "0002"), ("0004", "0004")):
        words = f"those of frame {told}, for all frames of its size"
        assert any(words in line for line in record_of(out / folder)["assumed"])
        report = (out / folder / "report.html").read_text()
        assert f"frame {told} of the sequence, for all frames of its size" in report


def test_frames_rendered_again_are_those_of_the_whole_run(
    film: tuple[list[str], Path, Run], tmp_path: Path
) -> None:
    """Also where the frame that tells the look is done already, and is read again for it."""
    argv, out, _ = film
    whole = shutil.copytree(out, tmp_path / "whole")
    for name in ("0001", "0003"):
        shutil.rmtree(out / name)
    assert main(argv) == ExitCode.DONE
    for name in ("0001", "0002", "0003", "0004"):
        assert outcome(out / name) == outcome(whole / name)


@pytest.mark.slow
def test_toned_frame_tones_all_of_its_size(inputs: Path, tmp_path: Path) -> None:
    """Also a frame of few tones, which alone would be taken for one in colour."""
    for name, scene in (("1.png", a_scene()), ("2.png", a_scene(0.4, 0.8))):
        codes = np.round(255.0 * np.clip(TONES["sepia"](scene), 0.0, 1.0)).astype(np.uint8)
        Image.fromarray(codes).save(tmp_path / name)
    lines = [json.dumps({"photo": str(tmp_path / name)}) for name in ("1.png", "2.png")]
    (tmp_path / "s.jsonl").write_text("\n".join(lines))
    alone = {"photo": str(tmp_path / "2.png"), **FAST}
    light = go(arguments(inputs, tmp_path / "alone", **alone), tmp_path / "alone")
    assert "toning" not in light.record["measured"]["look"]
    shared: dict[str, str | None] = {"light": None, "reuse": str(light.out), **FAST}
    shared |= {"sequence": str(tmp_path / "s.jsonl")}
    assert main(arguments(inputs, tmp_path / "out", **shared)) == ExitCode.DONE
    first, second = (record_of(tmp_path / "out" / f"000{k}")["measured"]["look"] for k in (1, 2))
    assert first["toning"] == second["toning"] and second["frame"] == "0001"


@pytest.mark.slow
def test_given_values_are_no_frames(
    film: tuple[list[str], Path, Run], inputs: Path, tmp_path: Path
) -> None:
    """A value and ``off`` stay as they are, and only what is estimated is told of a frame."""
    argv, *_ = film
    words = ["--sharpness", "1", "--response", "off", "--out"]
    assert main([*argv, *words, str(tmp_path / "a"), "--grain", "3"]) == ExitCode.DONE
    for k, look in enumerate(looks_of(tmp_path / "a"), start=1):
        assert look["blur"]["sigma"] == 1.0 and look["grain"]["strength"] == [[3.0 / 255.0] * 3]
        assert "frame" not in look and "response" not in look
        said = " ".join(record_of(tmp_path / "a" / f"000{k}")["assumed"])
        assert "of frame" not in said
    assert main([*argv, *words, str(tmp_path / "b")]) == ExitCode.DONE
    first, _, third, _ = looks_of(tmp_path / "b")
    assert first["blur"]["sigma"] == 1.0 and first["grain"] == third["grain"]
    assert first["frame"] == "0002" and "response" not in first


def begun_again(
    film: tuple[list[str], Path, Run], folder: Path, second: Callable[[list[str]], str]
) -> tuple[list[str], Path]:
    """Give the done sequence another second line, whose frame is not done."""
    argv, done, _ = film
    out = shutil.copytree(done, folder / "out")
    lines = Path(argv[argv.index("--sequence") + 1]).read_text().splitlines()
    lines[1] = second(lines)
    (folder / "s.jsonl").write_text("\n".join(lines))
    shutil.rmtree(out / "0002")
    return [*argv, "--sequence", str(folder / "s.jsonl"), "--out", str(out)], out


def test_frames_of_an_earlier_look_are_told(
    film: tuple[list[str], Path, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The frame that tells the look is another photo since; the rest is done already."""
    argv, out = begun_again(film, tmp_path, lambda lines: lines[2])
    assert main(argv) == ExitCode.DONE
    assert "notice: 0001, 0003, of an earlier run, have another" in capsys.readouterr().out
    for name in ("0001", "0003"):
        shutil.rmtree(out / name)
    assert main(argv) == ExitCode.DONE
    assert "of an earlier run" not in capsys.readouterr().out


def test_frames_rendered_now_are_not_of_an_earlier_run(
    film: tuple[list[str], Path, Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the frame that tells the look now is done already, and has the earlier one itself."""
    unseen = {"place": [0, 0, 50]}
    argv, out = begun_again(film, tmp_path, lambda lines: json.dumps(json.loads(lines[1]) | unseen))
    assert main(argv) == ExitCode.DONE
    assert record_of(out / "0002")["measured"]["look"]["frame"] == "0003"
    assert "notice: 0001, 0003, of an earlier run, have another" in capsys.readouterr().out
    assert main(argv) == ExitCode.DONE  # nothing is left to render
    assert "of an earlier run" not in capsys.readouterr().out
