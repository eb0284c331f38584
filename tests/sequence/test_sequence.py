"""``--sequence``: frames under one light, what is skipped, and lines that are wrong."""

import hashlib
import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NoReturn

import pytest

import warpir.report.result
from tests.builders.insertions import ALWAYS, Run, arguments, digest, go, record_of
from tests.builders.refusals import assert_fails, refused
from warpir import insert
from warpir.app.command import parse
from warpir.app.config import EXCLUSIVE, InsertConfig
from warpir.app.inputs import Loaders
from warpir.batch.task import CHECK, Answer, Task, do_task
from warpir.core.errors import ExitCode, InputError
from warpir.insert import insert as insert_now
from warpir.insert import main
from warpir.sequence.frames import FRAME_FIELDS, read_sequence

FAST: dict[str, str | None] = {"samples": "1", "depth": "1", "device": "cpu"}
FRAMES: list[dict[str, Any]] = [
    {},
    {"asset": "box.obj", "place": [0.3, 0, -5], "rotate-y": 20},
    {"photo": "deep.png", "at": "24,24", "size": 0.8, "exposure": -1, "seed": 5},
]
"""Nothing changed; another object and pose; another photo, and --at in place of --place."""


@pytest.fixture(scope="module", autouse=True)
def without_ffmpeg(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Frames have no video here, whatever is installed; ``test_video.py`` has its tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PATH", str(tmp_path_factory.mktemp("empty")))
        yield


@pytest.fixture(scope="module")
def first(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Run:
    """The run whose light is used."""
    out = tmp_path_factory.mktemp("first") / "out"
    return go(arguments(inputs, out, **FAST), out)


def write_lines(path: Path, lines: Sequence[object], inputs: Path) -> Path:
    """Write frames with the files' full names; text goes into the file as it is."""
    texts = []
    for line in lines:
        if isinstance(line, dict):
            named = {"photo", "asset"} & set(line)
            line = json.dumps({**line, **{name: str(inputs / line[name]) for name in named}})
        texts.append(line)
    path.write_text("\n".join(map(str, texts)) + "\n")
    return path


def argv_of(inputs: Path, first: Run, lines: Path, out: Path, **changes: str | None) -> list[str]:
    flags = {"light": None, "reuse": str(first.out), "sequence": str(lines), **FAST, **changes}
    return arguments(inputs, out, **flags)


@pytest.fixture(scope="module")
def frames(
    inputs: Path, first: Run, tmp_path_factory: pytest.TempPathFactory
) -> tuple[list[str], Path]:
    """A finished sequence of three frames: its command and its folder."""
    folder = tmp_path_factory.mktemp("frames")
    lines = write_lines(folder / "s.jsonl", [FRAMES[0], "", *FRAMES[1:]], inputs)
    argv = argv_of(inputs, first, lines, folder / "out")
    assert main(argv) == ExitCode.DONE
    return argv, folder / "out"


def refuse_to_render(*args: object, **kwargs: object) -> NoReturn:
    raise AssertionError("a finished frame was rendered again")


def test_sequence_writes_complete_folders(
    frames: tuple[list[str], Path], inputs: Path, first: Run
) -> None:
    """One result folder a frame; the summary names each, its line, changes and record."""
    _, out = frames
    names = ["0001", "0002", "0003", "sequence.html", "sequence.json"]
    assert sorted(p.name for p in out.iterdir()) == names
    summary = json.loads((out / "sequence.json").read_text())
    assert summary["format"] == "warpir-sequence" and summary["reuse"] == str(first.out)
    assert [frame["line"] for frame in summary["frames"]] == [1, 3, 4]
    assert summary["frames"][0]["changes"] == {}
    assert summary["frames"][2]["changes"] == {
        "photo": str(inputs / "deep.png"), "at": [24.0, 24.0], "size": 0.8, "exposure": -1.0,
        "seed": 5,
    }  # fmt: skip
    for frame in summary["frames"]:
        folder = out / frame["folder"]
        assert {p.name for p in folder.iterdir()} == {*ALWAYS, "run.json"}
        assert frame["run"] == hashlib.sha256((folder / "run.json").read_bytes()).hexdigest()
        config = record_of(folder)["config"]
        assert config["sequence"] is None and config["out"] == str(folder)
    third = record_of(out / "0003")["config"]
    assert third["at"] == [24.0, 24.0] and third["place"] is None
    light, other = ((out / f / "envmap.exr").read_bytes() for f in ("0001", "0002"))
    assert light == other


def test_frame_is_the_single_runs_twin(
    frames: tuple[list[str], Path], inputs: Path, first: Run, tmp_path: Path
) -> None:
    """A frame equals the run of the same flags, and its run.json replays it."""
    _, out = frames
    changes = {"asset": str(inputs / "box.obj"), "place": "0.3,0,-5", "rotate_y": "20"}
    argv = arguments(inputs, tmp_path / "a", light=None, reuse=str(first.out), **FAST, **changes)
    frame = record_of(out / "0002")
    single = go(argv, tmp_path / "a")
    replay = ["--config", str(out / "0002" / "run.json"), "--out", str(tmp_path / "b")]
    replayed = go(replay, tmp_path / "b")
    for name in ("composite.png", "envmap.exr", "camera.json", "curves.json", "balls.png"):
        assert frame["files"][name] == single.record["files"][name]
        assert frame["files"][name] == replayed.record["files"][name]


def test_a_long_check_says_how_far_it_is(
    frames: tuple[list[str], Path], monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    """Large frames are read for minutes before the first is rendered."""
    monkeypatch.setattr("warpir.sequence.run.LINE_SECONDS", 0.0)
    assert main([*frames[0], "--validate"]) == ExitCode.DONE
    assert "checked: frames up to 0003" in capsys.readouterr().out


def test_finished_frames_are_left_alone(
    frames: tuple[list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """The same command again renders nothing, changes no byte and says so."""
    argv, out = frames
    before = digest(out)
    monkeypatch.setattr(warpir.report.result, "make_picture", refuse_to_render)
    assert main(argv) == ExitCode.DONE
    said = capsys.readouterr().out
    assert [f"frame 000{k}: done already" in said for k in (1, 2, 3)] == [True] * 3
    assert digest(out) == before
    insertion = insert(parse(argv).config)
    names = ("0001/composite.png", "0002/composite.png", "0003/composite.png", "sequence.json")
    assert insertion.files == names and insertion.record["frames"][1]["folder"] == "0002"
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert "frames: 3, of which 3 are done already" in capsys.readouterr().out


def test_moved_frames_are_left_alone(
    frames: tuple[list[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sequence whose folder was moved since, or is named otherwise, is done already."""
    argv, out = frames
    shutil.copytree(out, tmp_path / "moved")
    assert main([*argv, "--out", str(tmp_path / "moved"), "--validate"]) == ExitCode.DONE
    assert "frames: 3, of which 3 are done already" in capsys.readouterr().out


def stop_at_the_second_picture(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Interrupt the second frame once; what is returned has an element for each that began."""
    make_picture, calls = warpir.report.result.make_picture, []

    def stop_at_the_second(*args: Any, **kwargs: Any) -> Any:
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return make_picture(*args, **kwargs)

    monkeypatch.setattr(warpir.report.result, "make_picture", stop_at_the_second)
    return calls


def test_frames_left_by_a_longer_sequence_are_told(
    frames: tuple[list[str], Path], inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """They stay, but a player of all folders would show them behind the last frame."""
    argv, done = frames
    out = shutil.copytree(done, tmp_path / "out")
    lines = write_lines(tmp_path / "s.jsonl", [FRAMES[0]], inputs)
    argv = [*argv, "--sequence", str(lines), "--out", str(out)]
    assert main(argv) == ExitCode.DONE
    assert f"notice: {out} still holds 0002 to 0003, of a longer" in capsys.readouterr().out
    assert (out / "0003" / "run.json").exists()


def test_interrupted_sequence_goes_on(
    frames: tuple[list[str], Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Stopped in the second frame, it keeps the first and ends as if nothing had happened (R16)."""
    argv, finished = frames
    argv = [*argv]
    argv[argv.index("--out") + 1] = str(tmp_path / "out")
    calls = stop_at_the_second_picture(monkeypatch)
    assert main(argv) == 130
    assert (tmp_path / "out" / "0001" / "run.json").exists()
    assert not (tmp_path / "out" / "0002").exists()
    assert not (tmp_path / "out" / "sequence.json").exists()
    assert main(argv) == ExitCode.DONE
    said = capsys.readouterr().out
    assert len(calls) == 4 and "frame 0001: done already" in said
    assert "frame 0003: line 4 of" in said and ", 1 of 2 rendered, about " in said
    for folder in ("0001", "0002", "0003"):
        one, other = (record_of(o / folder)["files"] for o in (finished, tmp_path / "out"))
        assert one["composite.png"] == other["composite.png"]


def test_other_results_are_not_replaced(
    frames: tuple[list[str], Path], inputs: Path, first: Run, tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """A frame made otherwise, or damaged, is reported by its line; --overwrite renders it again."""
    _, done = frames
    out = tmp_path / "out"
    shutil.copytree(done, out)
    lines = write_lines(tmp_path / "s.jsonl", [*FRAMES[:2], {**FRAMES[2], "seed": 6}, {}], inputs)
    (out / "0002" / "layers.exr").write_bytes(b"cut")
    (out / "0004").mkdir()
    (out / "0004" / "notes.txt").write_text("mine")
    before = digest(out)
    argv = argv_of(inputs, first, lines, out)
    found = assert_fails(capsys, argv, ExitCode.OUTPUT, "s.jsonl:2:", "layers.exr: changed since")
    assert found[1] == "pass --overwrite to replace results"
    assert "s.jsonl:3:" in found[2] and "a run of other settings or other files" in found[2]
    assert "s.jsonl:4:" in found[3] and "no finished run" in found[3] and len(found) == 4
    assert digest(out) == before
    other = write_lines(tmp_path / "one.jsonl", [{"seed": 6}], inputs)
    argv = argv_of(inputs, first, other, out)
    assert_fails(capsys, argv, ExitCode.OUTPUT, "one.jsonl:1:")
    assert main([*argv, "--overwrite"]) == ExitCode.DONE
    assert record_of(out / "0001")["config"]["seed"] == 6
    capsys.readouterr()
    # What --overwrite wrote is done for the command without it.
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert "frames: 1, of which 1 are done already" in capsys.readouterr().out


@pytest.mark.slow
def test_renewed_sequence_keeps_what_is_done(
    frames: tuple[list[str], Path], inputs: Path, first: Run, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Only frames that differ are rendered again, and each of them once, whenever it is stopped."""
    out = tmp_path / "out"
    shutil.copytree(frames[1], out)
    changed = [FRAMES[0], *({**frame, "seed": 9} for frame in FRAMES[1:])]
    config = parse(argv_of(inputs, first, write_lines(tmp_path / "s", changed, inputs), out)).config
    calls = stop_at_the_second_picture(monkeypatch)
    with pytest.raises(KeyboardInterrupt):
        insert_now(config, renews=True)
    insert_now(config, renews=True)
    assert len(calls) == 3 and "it is rendered again" in capsys.readouterr().out
    seeds = [record_of(out / f"000{k}")["config"]["seed"] for k in (1, 2, 3)]
    assert seeds == [3, 9, 9], "the first as the command line says"
    (out / "0002" / "layers.exr").write_bytes(b"edited")
    with pytest.raises(InputError, match="changed since the run wrote it"):
        insert_now(config, renews=True)


@pytest.mark.slow
def test_batch_looks_at_all_that_a_sequence_takes(
    frames: tuple[list[str], Path], inputs: Path, first: Run, tmp_path: Path
) -> None:
    """Memory of the largest frame, disk of all that are not done; and a page that is not ours."""

    def check(out: Path, *lines: dict[str, Any]) -> Answer:
        listed = write_lines(tmp_path / "s.jsonl", lines, inputs)
        config = parse(argv_of(inputs, first, listed, out)).config
        return do_task(Task(CHECK, config.flat()))

    one, two, whole = (check(tmp_path / "none", *FRAMES[:count]) for count in (1, 2, 3))
    assert 0 < one.found["memory"] <= two.found["memory"] <= whole.found["memory"]
    assert 0 < one.found["disk"] < two.found["disk"] < whole.found["disk"]
    shutil.copytree(frames[1], tmp_path / "out")
    rest = check(tmp_path / "out", *FRAMES[:2], {**FRAMES[2], "seed": 9})
    assert rest.found["disk"] == whole.found["disk"] - two.found["disk"]
    (tmp_path / "out" / "sequence.html").write_text("<p>mine</p>")
    answer = check(tmp_path / "out", *FRAMES)
    assert answer.status == ExitCode.OUTPUT and "not a page of warpir's" in answer.lines[0]


def test_a_video_that_could_be_made_now_is_missing(
    frames: tuple[list[str], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch has done a sequence without its video only where there is no ffmpeg."""
    monkeypatch.setenv("PATH", str(tmp_path))
    task = Task(CHECK, parse(frames[0]).config.flat())
    assert do_task(task).found["is_done"]
    (tmp_path / "ffmpeg").touch(0o755)
    assert not do_task(task).found["is_done"]


def test_changed_inputs_are_noticed(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A photo of the same name and another content makes another frame."""
    (tmp_path / "photo.png").write_bytes((inputs / "photo.png").read_bytes())
    lines = write_lines(tmp_path / "s.jsonl", [{}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out", photo=str(tmp_path / "photo.png"))
    assert main(argv) == ExitCode.DONE
    (tmp_path / "photo.png").write_bytes((inputs / "deep.png").read_bytes())
    found = assert_fails(capsys, argv, ExitCode.OUTPUT, "s.jsonl:1:", "other settings or other")
    assert "remove that folder" in found[1]  # --overwrite would render all frames again


BAD_LINES: list[tuple[object, str]] = [
    ('{"place": [0, 0, -5]', "not JSON"),
    ("[1, 2]", "not a JSON object"),
    ('{"seed": 1, "seed": 2}', 'key "seed" appears twice'),
    ('{"fov": NaN}', "NaN is not JSON"),
    ({"plaice": [0, 0, -5]}, "unknown key 'plaice'"),
    ({"samples": 4}, "key 'samples' is one for all frames"),
    ({"light": "sky.hdr"}, "key 'light' is one for all frames"),
    ({"place": [0, 0]}, "place: expected X,Y,Z (found a list of 2)"),
    ({"seed": None}, "seed: expected a whole number (found null)"),
    ({"scale": -1}, "--scale: at least 1e-09 (found -1.0)"),
    ({"place": [0, 0, -5], "at": [3, 3]}, "--at: cannot be used with --place"),
    ({"photo": "none.png"}, "none.png: no such file"),
    ({"asset": "photo.png"}, "photo.png: not a mesh"),
    ({"at": [3000, 3]}, "--at: outside the photo"),
    ({"photo": None}, "--photo: needed"),
]


def test_every_bad_line_is_listed(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All lines are looked at before the first is rendered; each problem names its line."""
    wrong = [json.dumps(b) if b == {"photo": None} else b for b, _ in BAD_LINES]
    lines = write_lines(tmp_path / "s.jsonl", [{}, *wrong, {}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out")
    found = assert_fails(capsys, argv, ExitCode.USAGE, f"{lines}:2:", "not JSON")
    problems = [line for line in found if line.startswith(("error:", "also:"))]
    assert len(problems) == len(BAD_LINES)
    for number, (problem, (_, words)) in enumerate(zip(problems, BAD_LINES, strict=True), start=2):
        assert f"{lines}:{number}: " in problem and words in problem
        assert "line 1:" not in problem
    assert not (tmp_path / "out").exists()


def test_line_replaces_what_excludes_it(inputs: Path, first: Run, tmp_path: Path) -> None:
    """``at`` takes the place of --place, a camera file that of all flags about the camera."""
    camera = str(first.out / "camera.json")
    changes: list[dict[str, Any]] = [
        {"at": [24, 24]}, {"camera": camera}, {"horizon": 5}, {"fov": 50, "size": 1.5},
    ]  # fmt: skip
    lines = write_lines(tmp_path / "s.jsonl", changes, inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out", scale="2")
    configs = [frame.config for frame in read_sequence(parse(argv).config, Loaders())]
    assert configs[0].placement.place is None and configs[0].placement.scale == 2.0
    gone = [configs[1].camera.fov, configs[1].camera.pitch, configs[1].camera.height]
    assert gone == [None] * 3 and configs[1].placement.place == (0.0, 0.0, -5.0)
    assert configs[2].camera.pitch is None and configs[2].camera.fov == 60.0
    assert (configs[3].camera.fov, configs[3].camera.pitch) == (50.0, -15.0)
    assert configs[3].placement.scale is None
    inside = [pair for pair in EXCLUSIVE if set(pair) <= set(FRAME_FIELDS)]
    assert len(inside) == 9


def test_object_may_leave_the_frame(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frame that does not see the object is a frame; without any other the place is wrong."""
    lines = write_lines(tmp_path / "s.jsonl", [{}, {"place": [0, 0, 50]}], inputs)
    out = tmp_path / "out"
    assert main(argv_of(inputs, first, lines, out)) == ExitCode.DONE
    seen, unseen = (record_of(out / name)["measured"] for name in ("0001", "0002"))
    assert seen["object_pixels"] > 0 and unseen["object_pixels"] == 0
    assert "notice: the object is behind the camera" in capsys.readouterr().out
    write_lines(lines, [{"place": [0, 0, 50]}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "other")
    assert_fails(capsys, argv, ExitCode.INPUT, "no frame sees the object")


def test_what_needs_a_camera_finds_it_on_the_line(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--up for all frames, whose cameras the lines name; a line that names none is told."""
    camera = str(first.out / "camera.json")
    lines = write_lines(tmp_path / "s.jsonl", [{"camera": camera}, {}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out", up="y")
    (problem, *_) = assert_fails(capsys, argv, ExitCode.USAGE, "s.jsonl:2: --up: needs --camera")
    assert "s.jsonl:1" not in problem


@pytest.mark.parametrize(("place", "at", "moves"), [
    (None, None, True), (None, "24,24", True), ("0,0,-5", None, False),
])  # fmt: skip
def test_object_that_follows_the_camera_is_said(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    place: str | None, at: str | None, moves: bool,
) -> None:  # fmt: skip
    """A place in the photo is another one of the world in each frame of a camera that moves."""
    lines = write_lines(tmp_path / "s.jsonl", [{}, {"pitch": -16}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out", place=place, at=at)
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert ("it moves with the camera" in capsys.readouterr().out) == moves


@pytest.mark.parametrize(("tracked", "is_told"), [(1, True), (2, False), (0, False)])
def test_a_frame_without_the_camera_of_the_others_is_told(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    tracked: int, is_told: bool,
) -> None:  # fmt: skip
    """A tracker that loses a frame leaves a gap; another camera would let the object jump."""
    known = {"camera": str(first.out / "camera.json"), "place": [0, 0, -5]}
    lines = [known] * tracked + [{"fov": 60, "place": [0, 0, -5]}] * (2 - tracked)
    path = write_lines(tmp_path / "s.jsonl", lines, inputs)
    argv = argv_of(inputs, first, path, tmp_path / "out", horizon=None, fov=None)
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert ("notice: line 2 of 2 has no --camera" in capsys.readouterr().out) == is_told


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "no such file"),
        (b"", "frames miscounted (found 0"),
        (b"\n \n", "frames miscounted (found 0"),
        (b"{}\n" * 10_000, "frames miscounted (found 10000"),
        (b'{"photo": "\xff\xfe"}\n', "not UTF-8"),
        (b"\xff\xfe\n", "not JSON lines"),
    ],
    ids=["missing", "empty", "blank", "many", "latin", "binary"],
)
def test_bad_sequence_file(
    content: bytes | None, words: str, inputs: Path, first: Run, tmp_path: Path
) -> None:
    """A file that holds no frames is refused before any input is looked at (F1)."""
    path = tmp_path / "s.jsonl"
    if content is not None:
        path.write_bytes(content)
    config = parse(argv_of(inputs, first, path, tmp_path / "out")).config
    with pytest.raises(InputError) as caught:
        read_sequence(config, Loaders())
    assert caught.value.code == ExitCode.USAGE and words in caught.value.what


def test_bad_run_is_one_problem(
    inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A folder that holds no run is not a problem of every line."""
    lines = write_lines(tmp_path / "s.jsonl", FRAMES, inputs)
    argv = arguments(inputs, tmp_path / "o", light=None, reuse="nowhere", sequence=str(lines))
    found = assert_fails(capsys, argv, ExitCode.INPUT, "nowhere: not a finished run")
    assert not any(line.startswith("also:") for line in found)


def test_folder_of_a_single_run_is_no_place_for_a_sequence(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Frames would lie beside another result: refused, even with --overwrite."""
    lines = write_lines(tmp_path / "s.jsonl", FRAMES, inputs)
    before = digest(first.out)
    argv = [*argv_of(inputs, first, lines, first.out), "--overwrite"]
    assert_fails(capsys, argv, ExitCode.OUTPUT, "holds the result of one run")
    assert digest(first.out) == before


def test_sequence_needs_photo_and_asset_on_every_line_or_once() -> None:
    """The command line need not name what every line names."""
    config = InsertConfig(out="o", reuse="r", sequence="s.jsonl")
    config.require_inputs()
    error = refused(["--out", "o", "--sequence", "s.jsonl"])
    assert error.where == "--sequence" and "needs --reuse" in error.what


def test_changed_files_of_the_asset_are_noticed(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Another material makes another frame, though the asset's own file is the same."""
    for name in ("box.obj", "box.mtl"):
        (tmp_path / name).write_bytes((inputs / name).read_bytes())
    lines = write_lines(tmp_path / "s.jsonl", [{}], inputs)
    argv = argv_of(inputs, first, lines, tmp_path / "out", asset=str(tmp_path / "box.obj"))
    assert main(argv) == ExitCode.DONE
    assert main([*argv, "--validate"]) == ExitCode.DONE
    assert "1 are done already" in capsys.readouterr().out
    (tmp_path / "box.mtl").write_text("newmtl red\nKd 0.1 0.1 0.8\n")
    assert_fails(capsys, argv, ExitCode.OUTPUT, "s.jsonl:1:", "other settings or other files")
    (tmp_path / "box.mtl").unlink()
    assert main(argv) != ExitCode.DONE


@pytest.mark.case("F5")
def test_summary_replaces_no_other_file(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A list that lies in --out under the summary's name, and a file of that name."""
    lines = write_lines(tmp_path / "sequence.json", [{}], inputs)
    before = lines.read_bytes()
    argv = argv_of(inputs, first, lines, tmp_path)
    for more in ([], ["--overwrite"]):
        assert_fails(capsys, [*argv, *more], ExitCode.USAGE, "would replace --sequence")
    assert lines.read_bytes() == before
    other = write_lines(tmp_path / "s.jsonl", [{}], inputs)
    argv = argv_of(inputs, first, other, tmp_path)
    assert_fails(capsys, argv, ExitCode.OUTPUT, "sequence.json: not the summary")
    assert lines.read_bytes() == before


def test_page_shows_every_frame(frames: tuple[list[str], Path], inputs: Path) -> None:
    """A picture of each, what its line changes by the names of files, and its own report."""
    page = (frames[1] / "sequence.html").read_text("utf-8")
    for name in ("0001", "0002", "0003"):
        assert f'href="{name}/report.html"' in page and (frames[1] / name / "report.html").exists()
    assert page.count('src="data:image/jpeg') == 3 and "photo deep.png, at 24.0,24.0" in page
    assert str(inputs) not in page and "default-src 'none'" in page


def test_page_is_there_before_the_summary(
    frames: tuple[list[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the summary others see that nothing is left to do, so the page comes first."""

    def stop(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    argv, out = frames
    page = (out / "sequence.html").read_bytes()
    (out / "sequence.html").unlink()
    monkeypatch.setattr("warpir.sequence.run.write_summary", stop)
    assert main(argv) == 130
    assert (out / "sequence.html").read_bytes() == page


def test_page_that_fails_is_a_notice(
    frames: tuple[list[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """All frames are there: the exit status is theirs, and the page of before stays."""

    def fail(*_: object) -> None:
        raise ValueError("odd")

    before = (frames[1] / "sequence.html").read_bytes()
    monkeypatch.setattr("warpir.sequence.page.thumbnail", fail)
    assert main(frames[0]) == ExitCode.DONE
    told = capsys.readouterr().out
    assert "notice: sequence.html could not be made (ValueError: odd)" in told
    assert (frames[1] / "sequence.html").read_bytes() == before


def test_page_replaces_no_other_file(
    inputs: Path, first: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A page of somebody's own is not lost, and not asked for where none is written."""
    out = tmp_path / "out"
    out.mkdir()
    (out / "sequence.html").write_text("<p>mine</p>")
    argv = argv_of(inputs, first, write_lines(tmp_path / "s.jsonl", [{}], inputs), out)
    before = digest(tmp_path)
    assert_fails(capsys, argv, ExitCode.OUTPUT, "sequence.html: not a page of warpir's")
    assert_fails(capsys, [*argv, "--validate"], ExitCode.OUTPUT, "not a page of warpir's")
    assert digest(tmp_path) == before
    assert main([*argv, "--validate", "--no-report"]) == ExitCode.DONE
