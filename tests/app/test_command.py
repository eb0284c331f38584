"""The command line: flags, configuration files, errors, exit codes, and what is not imported."""

import inspect
import json
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from PIL import Image

import warpir.app.command
import warpir.insert
from tests.builders.insertions import LOBES
from tests.builders.refusals import assert_fails, refused
from warpir.app.command import BY_HAND, FLAGS, parse
from warpir.app.config import DEFAULTS, EXCLUSIVE, OPTIONS, InsertConfig, flag
from warpir.app.config_file import ELSEWHERE
from warpir.app.inputs import _without_effect, read_inputs
from warpir.app.program import say
from warpir.app.record import PATHS, RUN_FORMAT
from warpir.app.settings import RenderConfig
from warpir.core.errors import ExitCode, InputError, raise_all

# The slowest start that still feels immediate. Measured: 0.07 s; the rest is a busy machine.
ANSWER_SECONDS = 1.0
HEAVY = ("torch", "warp", "PIL", "OpenImageIO", "OpenEXR", "trimesh", "numpy", "yaml", "colour")
NEEDED = ["--photo", "p.png", "--asset", "a.glb", "--out", "o"]
PAINTER = ["--guidance", "stable-diffusion", "--model", "m", "--prompt", "p"]


def run(argv: Sequence[str], cwd: Path, after: str = "") -> subprocess.CompletedProcess[str]:
    """Run ``main`` in a child, then the statements of `after`."""
    code = f"import sys\nfrom warpir.insert import main\nstatus = main({list(argv)!r})\n{after}\n"
    return subprocess.run(
        [sys.executable, "-c", code + "sys.exit(status)"],
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize(
    ("argv", "status"),
    [(["--help"], 0), (["--version"], 0), (["--samples", "0"], 2), (["--nonsense"], 2)],
    ids=["help", "version", "range", "unknown"],
)
def test_command_answers_at_once(argv: list[str], status: int, tmp_path: Path) -> None:
    """Help and wrong arguments take under a second and import nothing heavy."""
    loaded = f"print([m for m in {HEAVY!r} if m in sys.modules])"
    fastest = float("inf")
    for _ in range(3):
        start = time.perf_counter()
        done = run(argv, tmp_path, loaded)
        fastest = min(fastest, time.perf_counter() - start)
        if fastest < ANSWER_SECONDS:
            break
    assert done.returncode == status, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
    assert fastest < ANSWER_SECONDS


def test_command_runs_as_a_module(tmp_path: Path) -> None:
    """``python -m warpir.insert`` is the same program, and its status is the process's."""
    command = [sys.executable, "-m", "warpir.insert", "--fovv", "3"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == ExitCode.USAGE
    assert done.stderr == "error: --fovv: no such flag\ndid you mean --fov?\n"


def test_command_help_tells_every_field(capsys: pytest.CaptureFixture[str]) -> None:
    assert warpir.insert.main(["--help-all"]) == 0
    text = capsys.readouterr().out
    docs = warpir.app.command.field_docs()
    assert sorted(name for forms in FLAGS.values() for name in forms) == sorted(OPTIONS)
    assert all(f"  {flag(name)}" in text and docs[name] for name in OPTIONS)
    switches = {name for name, option in OPTIONS.items() if option.kind in (bool, bool | None)}
    assert switches == {name for name, option in OPTIONS.items() if not option.rule.form}
    for name in (name for name in switches if OPTIONS[name].kind is not bool):
        assert f"  {flag(name)}, --no-{flag(name)[2:]}" in text


def test_command_help_is_short_and_holds_what_documents_show(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """About two screens: each flag of README and manual but limits, and none for experts."""
    assert warpir.insert.main(["--help"]) == 0
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert len(lines) <= 115 and max(map(len, lines)) <= 100
    assert text.count("(") == text.count(")")
    root = Path(__file__).parents[2]
    documents = "".join(
        (root / name).read_text("utf-8") for name in ("README.md", "docs/manual.md")
    )
    for name, option in OPTIONS.items():
        assert (f"  {flag(name)}" in text.replace(",", " ")) is not option.rule.expert, name
        if re.search(rf"{flag(name)}(?![\w-])", documents) and option.part != "limits":
            assert not option.rule.expert, name


def test_dotted_names_mean_the_same(tmp_path: Path) -> None:
    """Part and field, as the configuration's own attributes, at the command line and in files."""
    flat = parse([*NEEDED, "--camera-height", "1.5", "--rate-tone=0.5"]).config
    argv = ["--camera.height", "1.5", "--optimize.rate_tone=0.5"]
    assert parse([*NEEDED, *argv]).config == flat
    path = tmp_path / "c.yaml"
    path.write_text("camera.height: 1.5\noptimize.rate-tone: 0.5\n")
    assert parse([*NEEDED, "--config", str(path)]).config == flat
    path.write_text("camera.height: 1.5\ncamera-height: 2\n")
    assert "twice" in refused([*NEEDED, "--config", str(path)]).what
    assert "no such flag" in refused([*NEEDED, "--output.report"]).what


@pytest.mark.parametrize(
    ("values", "is_guided"),
    [
        ({}, False),
        ({"demo": True}, False),
        ({"sun": (1.0, 2.0)}, False),
        ({"model": "m"}, True),
        ({"light": "l.hdr", "model": "m"}, True),
        ({"model": "m", "guidance": "none"}, False),
        ({"guidance": "stable-diffusion"}, True),
    ],
)
def test_a_model_guides(values: dict[str, Any], is_guided: bool) -> None:
    """Where one is named, unless --guidance says something else; its tone operator follows."""
    config = InsertConfig(**values)
    assert config.is_guided is is_guided
    assert config.tone_operator == ("reinhard" if is_guided else "linear")


@pytest.mark.case("F1", "F8")
def test_every_value_has_a_rule() -> None:
    """No number without a range, no name that may be anything (F1, F8)."""
    free = {  # checked in words of their own, free by nature, or text
        "horizon", "ground", "place", "at", "rotate_y", "light_rotate", "sun", "sky",
        "device", "refine_parts", "refine_materials", "lora_layers",
        "photo", "layer", "occluder_mask", "asset", "materials", "out", "camera", "light", "lora",
        "model", "reuse", "sequence", "regressor", "frame", "ground_points", "proxy",
        "shadow_mask", "lamp", "lamps",
    }  # fmt: skip
    for name, option in OPTIONS.items():
        rule = option.rule
        bounds = (rule.low, rule.high, rule.above, rule.below)
        is_ruled = any(b is not None for b in bounds) or bool(rule.choices) or rule.is_prompt
        assert is_ruled is not (name in free or not rule.form), name
        # Just outside is refused and both ends are accepted.
        kind = float if float in (option.kind, *get_args(option.kind)) else int
        for value, words in (
            (rule.low, ""),
            (rule.high, ""),
            (rule.above, "more than|between"),
            (rule.below, "between"),
            (None if rule.low is None else rule.low - 1, "at least"),
            (None if rule.high is None else rule.high + 1, "at most"),
        ):
            if value is not None:
                # Not what stands between two values: "at most --time-max".
                found = [
                    match[0]
                    for problem in problems_of(**{name: kind(value)})
                    if problem.where == flag(name) and " --" not in problem.what
                    if (match := re.match("more than|between|at least|at most", problem.what))
                ]
                assert len(found) == bool(words), (name, value, found)
                assert all(re.fullmatch(words, what) for what in found), (name, value, found)


def problems_of(**values: Any) -> list[InputError]:
    try:
        InsertConfig(**values)
    except InputError as error:
        return [error, *error.also]
    return []


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("at", (165.0, 141.0, 3.0), "tuple[float, float]"),
        ("fov", "x", "float"),
        ("steps", 2.5, "int"),
        ("overwrite", 1, "bool"),
        ("seed", True, "int"),
        ("photo", 3, "str"),
        ("place", np.zeros((3, 1)), "tuple[float, float, float]"),
        ("time_min", "x", "float"),
    ],
)
def test_values_of_another_kind_are_refused(name: str, value: Any, expected: str) -> None:
    """From Python nothing has read them before."""
    (error, *others) = problems_of(**{name: value})
    assert not others and error.code == ExitCode.USAGE
    assert str(error).startswith(f"--{name.replace('_', '-')}: expected {expected}"), error


def test_paths_lists_and_whole_numbers_are_taken() -> None:
    assert not problems_of(
        photo=Path("a.png"), at=[165, 141], fov=np.float32(50), samples=np.int64(8)
    )
    given: dict[str, Any] = {"place": np.float32([0.5, 0, -4]), "report": np.bool_(False)}
    assert InsertConfig(**given) == InsertConfig(place=(0.5, 0.0, -4.0), report=False)


def test_values_are_kept_as_json_holds_them() -> None:
    """Whatever Python gave: a record and a checkpoint of it can be written and read back."""
    place: Any = [np.float32(0.5), np.int64(2), 3]
    values: dict[str, Any] = {"fov": np.float32(50), "samples": np.int64(8), "place": place}
    values["photo"] = Path("a.png")
    config = InsertConfig(**values)
    assert config == InsertConfig(photo="a.png", fov=50.0, samples=8, place=(0.5, 2.0, 3.0))
    told = json.loads(json.dumps(config.flat()))
    assert InsertConfig(**told) == config and isinstance(config.placement.place, tuple)
    (error,) = problems_of(fov=np.float32("nan"))
    assert "finite" in error.what
    (error,) = problems_of(place=[None, 1.0, 2.0])
    assert "expected tuple[float, float, float]" in error.what


@pytest.mark.parametrize("values", [{}, {"sun": (10.0, 40.0)}, {"demo": True}], ids=str)
def test_only_a_light_that_is_given_is_turned(values: Any) -> None:
    (error,) = problems_of(light_rotate=30.0, **values)
    assert str(error).startswith("--light-rotate: needs --light or --reuse")
    assert not problems_of(light_rotate=30.0, light="sky.exr")
    assert not problems_of(light_rotate=30.0, demo=True, guidance="none")


@pytest.mark.parametrize(
    ("argv", "name", "value"),
    [
        (["--place", "-1,0,-3"], "place", (-1.0, 0.0, -3.0)),
        (["--place=-1,0,-3"], "place", (-1.0, 0.0, -3.0)),
        (["--ground", "-.5,1,0,2e-3"], "ground", (-0.5, 1.0, 0.0, 0.002)),
        (["--pitch", "-8"], "pitch", -8.0),
        (["--light", "l.exr", "--light-rotate", "-90.5"], "light_rotate", -90.5),
        (["--guidance", "none", "--exposure", "-2"], "exposure", -2.0),
        (["--camera", "f.fspy", "--up", "-z"], "up", "-z"),
        (["--asset-up", "-z"], "asset_up", "-z"),
        (["--sun", "-30,40"], "sun", (-30.0, 40.0)),
        (["--sun", "120,40,2.5"], "sun", (120.0, 40.0, 2.5)),
        (["--sky", "overcast"], "sky", "overcast"),
        (["--sky", "0.1,0.2,0.3"], "sky", (0.1, 0.2, 0.3)),
        (["--no-mark"], "mark", False),
        (["--overwrite"], "overwrite", True),
        (["--device", "cuda:1"], "device", "cuda:1"),
        (["--photo", "-x.png"], "photo", "-x.png"),
        (["--width", "8"], "width", 8),
        (["--seed", str(2**32 - 1)], "seed", 2**32 - 1),
        (["--no-personalize"], "personalize", False),
        ([*PAINTER, "--accept"], "accept", True),
        (["--regressor", "own.safetensors"], "regressor", "own.safetensors"),
        (["--no-tone-curve"], "tone_curve", False),
        (["--allow-download"], "allow_download", True),
        (["--lora-layers", "to_q, to_k"], "lora_layers", ("to_q", "to_k")),
        (["--negative-prompt", ""], "negative_prompt", ""),
        (["--prompt", "a car, \U0001f697\nred"], "prompt", "a car, \U0001f697\nred"),
        (
            [*PAINTER, "--show-prior", "a red car, new | a cat"],
            "show_prior",
            ("a red car, new", "a cat"),
        ),
        (["--steps", "0"], "steps", 0),
    ],
)
def test_command_reads_values(argv: list[str], name: str, value: object) -> None:
    """Flags arrive as their field's type, values with a leading minus too."""
    assert parse([*NEEDED, *argv]).config.flat()[name] == value


@pytest.mark.parametrize(
    ("argv", "where", "words"),
    [
        (["--samples", "0"], "--samples", "at least 1 (found 0)"),
        (["--samples", "many"], "--samples", "expected a whole number (found 'many')"),
        (["--samples", "1.5"], "--samples", "whole number"),
        pytest.param(["--fov", "1_0"], "--fov", "expected a number", id="F1-fov-1_0"),
        pytest.param(["--seed", "1_0"], "--seed", "expected a whole number", id="F1-seed-1_0"),
        pytest.param(["--seed", "1.5"], "--seed", "whole number", id="F8-fraction"),
        pytest.param(["--seed", str(2**32)], "--seed", "at most 4294967295", id="F8-2^32"),
        (["--fov", "180"], "--fov", "between 0 and 180 (found 180.0)"),
        (["--fov", "nan"], "--fov", "finite"),
        (["--fov", "1e400"], "--fov", "finite"),
        (["--place", "1,2"], "--place", "expected X,Y,Z (found '1,2')"),
        (["--place", "1,2,inf"], "--place", "finite"),
        (["--ground", "0,0,0,1"], "--ground", "normal"),
        pytest.param(["--size", "1e300"], "--size", "at most", id="F1-size-1e300"),
        pytest.param(["--sun", "0,45,1e300"], "--sun", "numbers up to 1e+09", id="F1-sun-1e300"),
        pytest.param(["--sky", "1e300,1,1"], "--sky", "numbers up to 1e+09", id="F1-sky-1e300"),
        pytest.param(["--place", "0,0,-1e30"], "--place", "numbers up", id="F1-place-1e30"),
        pytest.param(["--ground", "0,1e200,0,0"], "--ground", "numbers up", id="C8-ground-1e200"),
        pytest.param(["--ground-albedo", "1e-320"], "--ground-albedo", "least", id="F1-albedo"),
        (["--ground-roughness", "wet"], "--ground-roughness", "off, or 0 to 1"),
        (["--ground-roughness", "0", "--proxy", "p.ply"], "--ground-roughness", "--proxy"),
        (["--ground-roughness", "auto", "--proxy", "p.ply"], "--ground-roughness", "--proxy"),
        (
            "--ground-roughness auto --sequence s.txt --reuse r".split(),
            "--ground-roughness auto",
            "--sequence",
        ),
        (["--device", "tpu"], "--device", "cuda"),
        (["--sky", "purple"], "--sky", "overcast"),
        (["--sun", "0,91"], "--sun", "elevation"),
        (["--guidance", "lds"], "--guidance", "stable-diffusion or none (found lds)"),
        (["--guidance", "stable-diffusion", "--prompt", "p"], "--model", "needed"),
        (["--guidance", "stable-diffusion", "--model", "m"], "--prompt", "needed"),
        ([*PAINTER, "--no-personalize"], "--no-personalize", "--loss lds"),
        pytest.param(["--prompt", "p\0"], "--prompt", "NUL", id="F4-NUL"),
        pytest.param(["--prompt", ""], "--prompt", "empty", id="F4-empty"),
        (["--prompt", "\u00e9" * 2049], "--prompt", "4098 bytes"),
        (["--prompt", " "], "--prompt", "empty (found ' '"),
        (["--prompt", "the."], "--prompt", "empty (found 'the.'"),
        (["--prompt", "p", "--class-noun", "a"], "--class-noun", "empty (found 'a'"),
        (["--prompt", "p", "--token", " "], "--token", "empty (found ' '"),
        (["--show-prior", "a||b"], "--show-prior", "not empty"),
        (["--show-prior", "a"], "--show-prior", "needs --model"),
        (
            "--guidance stable-diffusion --show-prior a --no-personalize".split(),
            "--no-personalize",
            "--show-prior",
        ),
        ("--guidance stable-diffusion --exposure 1".split(), "--exposure", "is recovered"),
        (["--loss", "vsd"], "--loss", "lds-lora-both"),
        ([*PAINTER, "--loss", "lds-negative"], "--loss", "--negative-prompt"),
        ([*PAINTER, "--loss", "sds-good-bad"], "--loss", "--negative-prompt"),
        ([*PAINTER, "--time-min", "0.7"], "--time-min", "at most --time-max (found 0.7 and 0.6)"),
        ([*PAINTER, "--time-min", "0.4"], "--time-min", "at most --time-max-end (found 0.4 and"),
        ([*PAINTER, "--time-max", "0.2"], "--time-max-end", "at most --time-max (found 0.3 and"),
        (["--crop-min", "5"], "--crop-min", "at most --crop-max (found 5 and 3)"),
        ([*PAINTER, "--accept", "--loss", "dataset-update"], "--accept", "--loss dataset-update"),
        (["--accept"], "--accept", "needs --model"),
        (["--prior", "p"], "--prior", "no such flag"),
        (["--guidance", "embedded"], "--guidance", "stable-diffusion or none (found embedded)"),
        ([*PAINTER, "--exposure", "1"], "--exposure", "is recovered"),
        ([*PAINTER, "--lora", "l", "--no-personalize"], "--no-personalize", "--lora"),
        (["--start", "sunny"], "--start", "regressed or uniform"),
        (["--lora-rate", "0"], "--lora-rate", "more than 0"),
        (["--lora-layers", "to_q,"], "--lora-layers", "not empty"),
        (["--adam-beta2", "1"], "--adam-beta2", "at most 0.999999 (found 1.0)"),
        (["--rate-axis", "inf"], "--rate-axis", "finite"),
        (["--class-images", "1.5"], "--class-images", "whole number"),
        (["--sequence", "f"], "--sequence", "needs --reuse"),
        (["--guidance", "none", "--resume"], "--resume", "needs --model"),
        (["--refine", "light"], "--refine", "material or emission or tone"),
        (["--refine", "tone", "--prompt", "p"], "--refine", "known light"),
        (["--refine", "tone", "--prompt", "p", "--reuse", "r"], "--refine", "needs --model"),
        (["--refine", "material", "--light", "l"], "--refine", "which judges the change"),
        (["--refine-parts", "metallic"], "--refine-parts", "--refine material"),
        ([*PAINTER, "--reuse", "r"], "--guidance", "cannot be used with --reuse"),
        (["--reuse", "r", "--model", "m", "--prompt", "p"], "--model", "cannot be used with"),
        (["--mark"], "--mark", "no such flag"),
        (["--photo", ""], "--photo", "not empty"),
        (["--fit-lobes", "4"], "--fit-lobes", "--light"),
        (["--up", "z"], "--up", "--camera"),
        (["--photo"], "--photo", "expected one argument"),
        (["--overwrite=yes"], "--overwrite", "ignored explicit argument"),
        (["--lamp", "0,1,-1,0.1,5", "--lamp", "1,1,-1,0.1,5"], "--lamp", "given twice"),
        (["--asset", "b.glb"], "--asset", "given twice: a run inserts one object"),
        (["stray"], "stray", "no such flag"),
        (["--sample", "4"], "--sample", "no such flag"),
    ],
)
def test_command_refuses_values(argv: list[str], where: str, words: str) -> None:
    """A value that cannot be used names its flag, what was found and what was expected (F1, F8)."""
    error = refused([*NEEDED, *argv])
    assert error.where == where
    assert words in error.what


@pytest.mark.parametrize(
    ("stray", "advice"),
    [
        ("--yaw", "did you mean --rotate-y?"),  # --at before
        ("--height", "did you mean --camera-height?"),  # --weight before
        ("--input", "did you mean --photo?"),  # --out before
        ("--modle", "did you mean --model?"),
        ("--quiet", "see --help"),  # --out before
        ("610", "each value follows its flag, in quotes where it has spaces"),
    ],
)
def test_advice_on_unknown_flags(stray: str, advice: str) -> None:
    """Words of other programs lead to ours, likeness by chance to none."""
    assert refused([*NEEDED, stray]).advice == advice


def test_words_of_other_programs_lead_to_our_flags() -> None:
    assert set(ELSEWHERE.values()) <= {flag(name)[2:] for name in DEFAULTS}
    assert not set(ELSEWHERE) & {flag(name)[2:] for name in DEFAULTS}


@pytest.mark.parametrize(("first", "second"), EXCLUSIVE)
def test_command_refuses_flags_that_exclude_each_other(first: str, second: str) -> None:
    values = {
        "photo": "p.png", "asset": "a.glb", "camera": "c.json", "fov": "50", "pitch": "0",
        "roll": "1", "horizon": "5", "camera_height": "2", "place": "0,0,1", "at": "1,2",
        "scale": "1", "size": "1", "light": "l.hdr", "sun": "1,2", "sky": "clear", "reuse": "r",
        "refine": "tone",
        "sequence": "s.jsonl", "start": "uniform", "ground": "0,1,0,0", "ground_points": "p.ply",
    }  # fmt: skip
    argv = ["--out", "o"]
    for name in (first, second):
        argv += [flag(name), values[name]] if name in values else [flag(name)]
    error = refused(argv)
    assert error.where == flag(second)
    assert error.what == f"cannot be used with {flag(first)}"


def test_command_lists_all_problems(capsys: pytest.CaptureFixture[str]) -> None:
    """The first problem is the error, the others follow as also: lines."""
    argv = [*NEEDED, "--samples", "0", "--depth", "0", "--fov", "0"]
    lines = assert_fails(capsys, argv, 2, "--fov")
    assert [line.split(":")[1].strip() for line in lines[1:]] == ["--samples", "--depth"]
    assert all(line.startswith("also: ") for line in lines[1:])


def test_command_names_what_is_needed(capsys: pytest.CaptureFixture[str]) -> None:
    """Without --demo photo, asset and out are needed; with it only out."""
    lines = assert_fails(capsys, [], 2, "--photo: needed")
    assert lines[1:] == [
        "--demo needs neither --photo nor --asset",
        "also: --asset: needed",
        "also: --out: needed",
    ]
    assert_fails(capsys, ["--demo"], 2, "--out: needed")
    assert parse(["--demo", "--out", "o"]).config.inputs.demo


YAML = """\
photo: p.png
asset: "a.glb"
out: o
camera-height: 1.5   # a flag's spelling
rotate_y: 30         # a field's spelling
place: [-1, 0, -3.5]
sky: 0.1,0.2,0.3
samples: 16
mark: false
width: null
lora-layers: [to_q, to_out.0]
graphs: false
grain: off             # which YAML reads as false
"""


def test_config_file_gives_the_same_as_flags(tmp_path: Path) -> None:
    """YAML and JSON, lists and comma-separated text, both spellings of a name."""
    expected = parse(
        ["--photo", "p.png", "--asset", "a.glb", "--out", "o", "--camera-height", "1.5",
         "--rotate-y", "30", "--place", "-1,0,-3.5", "--sky", "0.1,0.2,0.3", "--samples", "16",
         "--no-mark", "--lora-layers", "to_q,to_out.0", "--no-graphs", "--grain", "off"]
    ).config  # fmt: skip
    path = tmp_path / "run.yaml"
    path.write_text(YAML)
    assert parse(["--config", str(path)]).config == expected
    other = tmp_path / "c.json"
    other.write_text(json.dumps(expected.flat()))
    assert parse(["--config", str(other)]).config == expected


def test_config_file_whose_paths_start_elsewhere_is_told_of(tmp_path: Path) -> None:
    """As of a run.json that is used in its results' folder: its paths start where the run did."""
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"photo": "p.png", "asset": "a.glb", "out": "o"}))
    (notice,) = parse(["--config", str(path)]).notices
    assert notice.startswith(f"p.png, named in {path}, is not in the folder where the command runs")
    photo = ["--photo", "p.png"]
    assert "a.glb, named in" in parse(["--config", str(path), *photo]).notices[-1]


@pytest.mark.case("F2")
def test_config_file_replays_a_run(tmp_path: Path) -> None:
    """``run.json`` of an earlier run is a configuration; an unknown layout is refused (F2)."""
    config = InsertConfig(
        photo="p.png", asset="a.glb", out="o", sun=(10.0, 20.0), seed=7, lora_layers=("to_q",)
    )
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"format": RUN_FORMAT, "config": config.flat(), "seconds": {}}))
    assert parse(["--config", str(path)]).config == config
    path.write_text(json.dumps({"format": RUN_FORMAT + 1, "config": config.flat()}))
    assert "format" in refused(["--config", str(path)]).what


@pytest.mark.case("F2")
def test_config_file_of_an_older_version_replays(tmp_path: Path) -> None:
    """``run.json`` of a version that knew none of guidance's settings means their defaults (F2)."""
    parts = ("diffusion", "adapter", "guidance", "optimize", "task", "limits")
    newer = {name for name, option in OPTIONS.items() if option.part in parts}
    newer -= {"guidance", "max_pixels"}
    newer |= {
        "frame", "undistort", "ground_points", "reuse", "start", "regressor", "proxy", "plane",
        "shadow_mask", "layer", "occluder_mask", "light_convention", "strict", "detail",
        "visible_sun", "hand_off", "mitsuba", "usd", "asset_up", "settle", "sink", "response",
        "denoise", "camera_from", "roll", "bounce", "lamp", "lamps", "ground_roughness",
    }  # fmt: skip
    config = InsertConfig(photo="p.png", asset="a.glb", out="o", sky="clear", depth=2)
    known = {name: value for name, value in config.flat().items() if name not in newer}
    path = tmp_path / "run.json"
    path.write_text(json.dumps({"format": 1, "warpir": "0.1.0", "config": known}))
    assert len(known) < 45 and parse(["--config", str(path)]).config == config


@pytest.mark.parametrize("name", BY_HAND, ids="F1-{}".format)
def test_config_file_opens_no_network_and_no_pickle(tmp_path: Path, name: str) -> None:
    """A configuration may be a stranger's, an earlier run.json too: the flag itself is needed."""
    path = tmp_path / "c.json"
    plain = {"photo": "p.png", "asset": "a.glb", "out": "o"}
    for content in ({name: True}, {"format": RUN_FORMAT, "config": {**plain, name: True}}):
        path.write_text(json.dumps(content))
        error = refused([*NEEDED, "--config", str(path)])
        assert error.where == str(path) and name in error.what and flag(name) in error.advice
        told = parse([*NEEDED, "--config", str(path), flag(name)])
        assert told.config.flat()[name] is True
    path.write_text(json.dumps({name: False}))
    assert parse([*NEEDED, "--config", str(path)]).config.flat()[name] is False


@pytest.mark.case("F3")
def test_config_file_yields_to_flags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A flag wins over the file, and says so (F3)."""
    path = tmp_path / "c.yaml"
    path.write_text(YAML)
    monkeypatch.chdir(tmp_path)
    for name in ("p.png", "a.glb"):
        Path(name).touch()
    command = parse(["--config", str(path), "--samples", "8"])
    assert command.config.render.samples == 8
    assert len(command.notices) == 1 and "--samples" in command.notices[0]
    # As in the lines of a batch or a sequence, a flag wins over what it excludes in the file, too.
    command = parse(["--config", str(path), "--at", "3,4", "--light", "noon.hdr"])
    assert command.config.placement.place is None and command.config.light.sky is None
    assert [notice.split()[0] for notice in command.notices] == ["place", "sky"]
    assert refused(["--config", str(path), "--at", "3,4", "--place", "0,0,1"]).where == "--at"
    path.write_text(f"{YAML}camera: c.json\n".replace("camera-height", "exposure"))
    assert refused(["--config", str(path), "--fov", "50"]).where == "--fov"


@pytest.mark.parametrize(
    ("asked", "size", "samples"),
    [
        (None, (1280, 853), 32),
        (None, (2000, 1500), 32),
        (None, (2500, 1600), 24),
        (None, (4000, 3000), 16),
        (None, (20000, 10000), 16),
        (7, (4000, 3000), 7),
    ],
)
def test_large_pictures_have_fewer_samples(
    asked: int | None, size: tuple[int, int], samples: int
) -> None:
    """Unless their number is given."""
    assert RenderConfig(samples=asked).samples_at(*size) == samples


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("c.yaml", "samples: .nan\n", "whole number"),
        ("c.yaml", "samples: true\n", "whole number"),
        pytest.param("c.yaml", "samples: -3\n", "at least 1", id="F1-negative-samples"),
        pytest.param("c.yaml", "sampels: 3\n", "unknown key 'sampels'", id="F1-unknown-key"),
        pytest.param("c.yaml", "samples: [3]\n", "whole number", id="F1-wrong-type"),
        pytest.param("c.yaml", "fov: .nan\n", "finite", id="F1-nan"),
        pytest.param("c.yaml", "fov: 1e400\n", "finite", id="F1-1e400-yaml"),
        pytest.param("c.json", '{"fov": 1e400}', "line 1", id="F1-1e400-json"),
        pytest.param(
            "c.yaml",
            "photo: !!python/object/apply:os.mkdir ['made']\n",
            "not YAML",
            id="F1-yaml-tag",
        ),
        pytest.param("c.json", '{"format": true, "config": {}}', "format", id="F2-no-version"),
        ("c.yaml", "depth: null\n", "whole number"),
        ("c.yaml", "seed: 1.5\n", "whole number"),
        ("c.yaml", "overwrite: 1\n", "true or false"),
        ("c.yaml", "place: {x: 1}\n", "X,Y,Z"),
        ("c.yaml", "camera: [a]\n", "FILE"),
        pytest.param("c.yaml", "device: !!bool maybe\n", "its tag", id="F1-yaml-bool"),
        pytest.param("c.yaml", 'fov: !!float ""\n', "its tag", id="F1-yaml-float"),
        pytest.param("c.yaml", "seed: !!timestamp x\n", "its tag", id="F1-yaml-timestamp"),
        ("c.yaml", "samples: 3\nsamples: 4\n", "line 2: key 'samples' twice"),
        ("c.yaml", "a: [\n", "not YAML"),
        pytest.param(
            "c.yaml", "at: [0640, 0610]\n", "line 1: '0640' is no dec", id="F1-yaml-octal"
        ),
        pytest.param("c.yaml", "seed: 0x1f\n", "'0x1f' is no decimal", id="F1-yaml-hex"),
        pytest.param("c.yaml", f"seed: 0x{'f' * 10_000}\n", "is no dec", id="F1-yaml-long-hex"),
        pytest.param("c.yaml", "fov: 1:30.5\n", "'1:30.5' is no decimal", id="F1-yaml-base-60"),
        pytest.param("c.yaml", "? [a]\n: 1\n", "found a sequence", id="F1-yaml-list-as-key"),
        pytest.param(
            "c.yaml", "light-rotate: 1\nlight_rotate: 2\n", "twice", id="F1-two-spellings"
        ),
        ("c.yaml", "- 1\n", "keys and values"),
        ("c.yaml", "[" * 3000, "nested too deeply"),
        ("c.yaml", "a: &a [x,x]\nb: &b [*a,*a,*a]\nplace: [*b,*b,*b]\n", "unknown key 'a'"),
        ("c.json", '{"fov": NaN}', "NaN"),
        ("c.json", '{"samples": 3, "samples": 4}', "twice"),
        ("c.json", '{"samples": 3,}', "line 1: not JSON"),
        ("c.json", "[]", "object"),
        ("c.json", "\xff", "not UTF-8"),
    ],
)
def test_config_file_refused(tmp_path: Path, name: str, text: str, words: str) -> None:
    """A bad file ends with status 2 and names its key or line; no code from it runs (F1)."""
    path = tmp_path / name
    path.write_bytes(text.encode("latin-1"))
    error = refused([*NEEDED, "--config", str(path)])
    assert words in f"{error.where}: {error.what}"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.case("F1")
@pytest.mark.parametrize(
    ("names", "end"),
    [("abcdefghi", "place: *i\nphoto: *i"), ("abcdefgh", "? *h\n: 1")],
    ids=["value", "key"],
)
def test_config_file_of_aliases_is_refused_at_once(tmp_path: Path, names: str, end: str) -> None:
    """Ten lines of aliases that stand for 10^9 entries neither hang nor print them (F1)."""
    lines = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    lines += [f"{b}: &{b} [{', '.join(['*' + a] * 9)}]" for a, b in pairwise(names)]
    path = tmp_path / "bomb.yaml"
    path.write_text("\n".join([*lines, end]))
    start = time.perf_counter()
    error = refused(["--config", str(path)])
    assert time.perf_counter() - start < 5.0
    assert len(str(error)) < 500
    if "?" in end:
        assert error.what.endswith("unknown key (found a sequence)")


@pytest.mark.case("F1")
def test_config_file_of_many_unknown_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """20 000 unknown keys, one of them of a megabyte, are a few dozen short lines at once."""
    path = tmp_path / "c.json"
    keys = {"a" * 10**6: 1, **{f"phot{k}": 1 for k in range(20_000)}}
    path.write_text(json.dumps(keys))
    start = time.perf_counter()
    assert warpir.insert.main(["--config", str(path)]) == ExitCode.USAGE
    assert time.perf_counter() - start < 5.0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 32 and lines[-1].endswith("19971 more unknown keys")
    assert max(map(len, lines)) < 300


@pytest.mark.case("F1")
def test_lines_of_an_error_are_bounded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever a file holds, an error is a line of 10 000 characters and 31 further ones."""

    def fail(config: InsertConfig) -> None:
        raise_all([InputError("a.json", f"{k}{'A' * 20_000} at last") for k in range(1000)])

    monkeypatch.setattr(warpir.insert, "insert", fail)
    assert warpir.insert.main(["--demo", "--out", "o"]) == ExitCode.INPUT
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 32 and lines[-1] == "also: and 969 more"
    assert lines[0].startswith("error: a.json: 0AAA") and lines[0].endswith("AAA at last")
    assert max(map(len, lines)) < 10_010


@pytest.mark.parametrize(
    ("flags", "shown"),
    [pytest.param([], 0, id="R11-warning"), pytest.param(["--debug"], 1, id="R11-with-debug")],
)
def test_warnings_of_libraries_are_for_debugging(
    flags: list[str], shown: int, tmp_path: Path
) -> None:
    """What NumPy warns of reaches nobody who did not ask."""
    code = (
        "import sys, numpy as np\n"
        "from warpir.app.program import run_program\n"
        "def run(argv):\n    np.float32(3e38) * np.float32(10)\n    return 0\n"
        "sys.exit(run_program(run))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, *flags], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and done.stdout == ""
    assert done.stderr.count("RuntimeWarning") == shown and bool(done.stderr) == bool(shown)


@pytest.mark.parametrize("kind", ["missing", "folder", "pipe"])
def test_config_file_that_is_no_file(tmp_path: Path, kind: str) -> None:
    """A missing file, a folder and a pipe are refused without waiting."""
    path = tmp_path / "c.yaml"
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    assert refused(["--config", str(path)]).where == str(path)


def test_command_reports_bad_inputs_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """--validate looks at every input before it stops; the first decides the status."""
    argv = ["--photo", str(tmp_path / "no.jpg"), "--asset", str(tmp_path / "no.glb"), "--out",
            str(tmp_path / "o"), "--light", str(tmp_path / "no.hdr"), "--validate"]  # fmt: skip
    lines = assert_fails(capsys, argv, ExitCode.INPUT, "no.jpg")
    also = [line for line in lines if line.startswith("also: ")]
    assert len(also) == 2 and "no.glb" in also[0] and "no.hdr" in also[1]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("flag", "name", "target"),
    [
        pytest.param("--photo", "link.png", "out/composite.png", id="F5-link-into-out"),
        pytest.param("--photo", "out/link.png", "photo.png", id="F5-link-that-lies-in-out"),
        pytest.param("--photo", "out/progress/p.png", None, id="F5-below-out"),
        pytest.param("--model", "out/model", None, id="F5-model-in-out"),
        pytest.param("--asset", "a.obj", None, id="F5-material-file-in-out"),
    ],
)
def test_command_refuses_inputs_that_a_result_could_replace(
    flag: str, name: str, target: str | None, scene: list[str], tmp_path: Path
) -> None:
    """Wherever below --out, and whether a link is there or leads there."""
    (tmp_path / "out" / "progress").mkdir(parents=True)
    for copy in ("composite.png", "progress/p.png"):
        (tmp_path / "out" / copy).write_bytes((tmp_path / "photo.png").read_bytes())
    (tmp_path / "out" / "a.mtl").write_text("newmtl red\nKd 1 0 0\n")
    (tmp_path / "a.obj").write_text("mtllib out/a.mtl\nusemtl red\n" + OBJ)
    if target is not None:
        (tmp_path / name).symlink_to(tmp_path / target)
    if flag in scene:
        scene[scene.index(flag) + 1] = str(tmp_path / name)
    else:
        scene += [flag, str(tmp_path / name)]
    argv = [*scene, "--overwrite"]
    argv += ["--prompt", "p"] if flag == "--model" else []
    with pytest.raises(InputError, match="--out: holds the input") as caught:
        read_inputs(parse(argv).config)
    assert caught.value.code == ExitCode.USAGE


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n"


@pytest.fixture
def scene(tmp_path: Path) -> list[str]:
    """Arguments of a valid run: a small photo, four triangles' corners, one lobe."""
    ramp = np.arange(48 * 64 * 3, dtype=np.uint32).reshape(48, 64, 3) % 251
    Image.fromarray(ramp.astype(np.uint8)).save(tmp_path / "photo.png")
    (tmp_path / "asset.obj").write_text(OBJ)
    (tmp_path / "lobes.json").write_text(json.dumps(LOBES))
    return ["--photo", str(tmp_path / "photo.png"), "--asset", str(tmp_path / "asset.obj"),
            "--light", str(tmp_path / "lobes.json"), "--out", str(tmp_path / "out"),
            "--pitch", "-20"]  # fmt: skip


def test_validate_reads_everything_without_torch_or_warp(scene: list[str], tmp_path: Path) -> None:
    """--validate says what is assumed, writes nothing and loads no renderer."""
    loaded = "print([m for m in ('torch', 'warp', 'colour', 'diffusers') if m in sys.modules])"
    done = run([*scene, "--validate"], tmp_path, loaded)
    lines = done.stdout.splitlines()
    assert done.returncode == 0, done.stderr
    assert lines[-2:] == ["inputs are valid", "[]"]
    assert any(line.startswith("assumed: ") and "--fov" in line for line in lines)
    assert not (tmp_path / "out").exists()


def test_flags_without_effect_are_said(
    scene: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    """What only a model would read is named where none guides, and nothing else is."""
    read = ["--preview-every", "3", "--guidance", "none", "--allow-download"]
    assert warpir.insert.main([*scene, *read, "--validate"]) == ExitCode.DONE
    assert "without effect" not in capsys.readouterr().out
    unread = ["--steps", "0", "--loss", "csd", "--trust", "2", "--no-tone-curve"]
    assert warpir.insert.main([*scene, *unread, "--validate"]) == ExitCode.DONE
    (line,) = [s for s in capsys.readouterr().out.splitlines() if "without effect" in s]
    assert {*line.partition("guides: ")[2].split(", ")} == {s for s in unread if s[:2] == "--"}
    unlit = [*scene[: scene.index("--light")], *scene[scene.index("--out") :]]
    for argv, count in (scene, 1), ([*unlit, "--start", "uniform"], 1), (unlit, 0):
        assert warpir.insert.main([*argv, "--no-visible-sun", "--validate"]) == ExitCode.DONE
        assert capsys.readouterr().out.count("--no-visible-sun: without effect") == count


@pytest.mark.parametrize(
    ("read", "why", "unread"),
    [
        ("--trust 2 --null-prompt x --lora-rank 2", "with --loss lds", "--negative-prompt x"),
        ("", "where the light is estimated from the photo", "--lobes 8"),
        ("--start uniform --lobes 8 --lobe-width 2", "with --start uniform", "--trust 2"),
        ("--sun 30,40 --lobes 8", "where a light is given", "--lobe-width 2 --trust 2"),
        ("--loss csd --base-prompt x", "where no LoRA is trained", "--indoors --lora-rank 2"),
        ("--loss csd --show-prior x --lora-rank 2 --lora l", "with --loss csd", "--update-every 2"),
        ("--lora l", "where no LoRA is trained", "--lora-steps 2"),
        ("--loss dataset-update --update-every 2", "with --loss dataset-update", "--noises 2"),
        ("--sky clear --refine tone --rate-tone 1", "with --refine tone", "--trust 2 --spread 1"),
        ("--sky clear --refine material --mis-samples 2", "with --refine material", "--bend 1"),
        ("--rate-tone 1", "without --refine", "--rate-material 1"),
        ("--integrator mis --mis-samples 2", "with --integrator mis", "--retrace-at 2"),
        ("--fusion single --chroma 1", "with --fusion single", "--fusion-start .1 --spread 1"),
        ("--fusion none --spread 1", "with --fusion none", "--fusion-start .1"),
    ],
)
def test_flags_that_guidance_does_not_read_are_said(read: str, why: str, unread: str) -> None:
    """What loss, start, refinement or integrator leave unread is named, and nothing else is."""
    config = parse([*NEEDED, *PAINTER, *read.split(), *unread.split()]).config
    flags = {text for text in unread.split() if text.startswith("--")}
    (line,) = _without_effect(config)
    assert line.startswith(f"without effect {why}: ")
    assert {*line.partition(": ")[2].split(", ")} == flags


@pytest.mark.case("M16")
@pytest.mark.parametrize("axis", [None, "y", "+z", "-z"])
def test_M16_asset_up_is_applied_and_said(scene: list[str], axis: str | None) -> None:
    """Without --asset-up an OBJ is taken as Y up; with another axis it is turned; both are said."""
    given = read_inputs(parse([*scene, *(["--asset-up", axis] if axis else [])]).config)
    low, high = given.asset.bounds()
    assumed = [line for line in given.assumed if "--asset-up" in line]
    turned = [line for line in given.notices if "--asset-up" in line]
    if axis is None:
        assert len(assumed) == 1 and "+y axis" in assumed[0] and not turned
    else:
        said = f"asset.obj: turned: its {axis} axis points up (--asset-up)"
        assert not assumed and turned == ([said] if axis != "y" else [])
    # The corners lie at 0 and 1 along each axis.
    expected = {None: (0.0, 0.0), "y": (0.0, 0.0), "+z": (0.0, -1.0), "-z": (-1.0, 0.0)}[axis]
    assert (low[1], low[2]) == expected and (high[1] - low[1]) == 1.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": "x"}, "not lobes"),
        ({"lobes": []}, "/lobes: a list of 1 to 4096 lobes"),
        ({"lobes": [{"amplitude": [1, 2], "axis": [0, 1, 0], "sharpness": 1}]}, "amplitude"),
        ({"lobes": [{"amplitude": [1, 2, -3], "axis": [0, 1, 0], "sharpness": 1}]}, "amplitude"),
        ({"lobes": [{"amplitude": [1, 2, 3], "axis": [0, 0, 0], "sharpness": 1}]}, "axis"),
        ({"lobes": [{"amplitude": [1, 2, 3], "axis": [0, 1, 0], "sharpness": 0}]}, "sharpness"),
        pytest.param(
            {"lobes": [{"amplitude": [1, 2, 3], "axis": [0, 1, 0], "sharpness": 1e-300}]},
            "sharpness",
            id="E5-sharpness-0-in-float32",
        ),
        ({"lobes": [{"amplitude": [1, 2, 3], "axis": [0, 1, 0]}]}, "sharpness"),
    ],
)
def test_validate_refuses_lobes(
    scene: list[str],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, object],
    words: str,
) -> None:
    """A lobe out of range is named by its pointer."""
    (tmp_path / "lobes.json").write_text(json.dumps({**LOBES, **change}))
    assert_fails(capsys, [*scene, "--validate"], ExitCode.INPUT, "lobes.json", words)


def test_main_reports_its_own_faults(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene: list[str]
) -> None:
    """What nobody foresaw ends with status 1, a traceback and a request to report it."""

    def fail(config: InsertConfig) -> None:
        raise ZeroDivisionError("none\nof it")

    monkeypatch.setattr(warpir.insert, "insert", fail)
    assert warpir.insert.main(scene) == ExitCode.BUG
    text = capsys.readouterr().err
    assert "Traceback" in text and "report" in text
    assert "error: warpir: a fault of its own (ZeroDivisionError: none\\nof it)\n" in text


def short_of_memory() -> BaseException:
    """Return what torch raises on the CPU."""
    import torch

    with pytest.raises(RuntimeError) as caught:
        torch.empty(10**15)
    return caught.value


@pytest.mark.parametrize(
    ("raised", "status", "words"),
    [
        (KeyboardInterrupt(), 130, "stopped"),
        (MemoryError(), ExitCode.RESOURCES, "error: memory:"),
        (short_of_memory(), ExitCode.RESOURCES, "error: memory:"),
        (RuntimeError("Failed to allocate 9 bytes on device 'cuda:0'"), 5, "error: memory:"),
        (OSError(28, "No space left on device", "o/x.exr"), ExitCode.RESOURCES, "error: o/x.exr:"),
        (ModuleNotFoundError("", name="ray"), ExitCode.USAGE, "warpir[ray]"),
        (InputError("a\nb.png", "x\x1b[31m"), ExitCode.INPUT, "error: a\\nb.png: x\\x1b[31m"),
    ],
    ids=["interrupt", "memory", "torch", "warp", "disk", "R15", "control-characters"],
)
def test_main_tells_the_truth_by_status(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    scene: list[str],
    raised: BaseException,
    status: int,
    words: str,
) -> None:
    """Each class of fault has its exit status and no traceback."""

    def fail(config: InsertConfig) -> None:
        raise raised

    monkeypatch.setattr(warpir.insert, "insert", fail)
    assert warpir.insert.main(scene) == status
    text = capsys.readouterr().err
    assert words in text and "Traceback" not in text
    assert text.count("error:") == (0 if status == 130 else 1)
    assert warpir.insert.main([*scene, "--debug"]) == status
    assert "Traceback" in capsys.readouterr().err


def test_a_line_is_written_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Threads print too: with its end written apart, two lines ran into one."""
    written = []
    monkeypatch.setattr(sys.stdout, "write", written.append)
    say("one")
    assert [text for text in written if text] == ["one\n"]


def test_insert_is_called_through_the_module() -> None:
    """``from warpir import insert; insert(config)`` reaches the same function."""
    from warpir import insert

    with pytest.raises(InputError, match="--photo: needed"):
        insert(InsertConfig(out="o"))
    with pytest.raises(InputError, match="--photo: needed"):
        insert.insert(InsertConfig(out="o"))
    with pytest.raises(TypeError, match=r"takes an InsertConfig \(found str\)"):
        insert("photo.jpg")
    assert pickle.loads(pickle.dumps(insert)) is insert, "a pool of processes can be given it"
    assert "renews" in inspect.signature(insert).parameters


def test_demo_leaves_its_light_to_guidance() -> None:
    """The demo's own light and exposure are given, except where they are to be recovered."""
    from warpir.demo import demo_config

    plain = demo_config(InsertConfig(demo=True, out="o", guidance="none"))
    assert plain.light.file is not None and plain.light.exposure == 0.0
    guided = InsertConfig(
        demo=True, out="o", guidance="stable-diffusion", model="m", prompt="a car", tone="reinhard"
    )
    assert demo_config(InsertConfig(demo=True, out="o")).light.file is None
    sunny = demo_config(InsertConfig(demo=True, out="o", sun=(10.0, 20.0)))
    assert sunny.light.file is None and not sunny.is_guided
    recovered = demo_config(guided)
    assert recovered.light == replace(plain.light, file=None, exposure=None, tone="reinhard")
    assert recovered.inputs == plain.inputs and recovered.placement == plain.placement
    # Refinement changes the object under a light that is known.
    assert demo_config(guided.changed(refine="material")).light.file == plain.light.file


def test_paths_are_what_the_flags_say() -> None:
    """Pictures carry of these settings the last name alone."""
    forms = {name: {*option.rule.form.split("|")} for name, option in OPTIONS.items()}
    assert sorted(PATHS) == sorted(name for name, f in forms.items() if f & {"FILE", "DIR"})
