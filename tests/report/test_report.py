"""The report of a run: what it shows and tells, that it needs nothing else, and that it works."""

import base64
import hashlib
import html
import io
import json
import re
import shlex
import shutil
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import pytest
from markupsafe import escape
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Locator

from tests.builders.insertions import Run, arguments, go, write_inputs
from tests.builders.outcome import outcome
from tests.builders.programs.browser import Opened, needs_chromium, open_browser
from warpir.app.command import parse
from warpir.app.config import InsertConfig
from warpir.core.errors import ExitCode, InputError
from warpir.insert import main
from warpir.io.layers import read_layers
from warpir.report import page as report
from warpir.report.command import main as remake
from warpir.report.command import read_results
from warpir.report.facts import (
    ABOUT_FILES,
    about_file,
    command_line,
    light_sources,
    without_folders,
)
from warpir.report.html import source_hash
from warpir.report.panorama import rgbe
from warpir.report.pictures import layers_shown, shrink, thumbnail
from warpir.report.plots import Series, line_plot, ticks
from warpir.report.remedies import remedies

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&"
"""As a prompt or, without the slash, as a name of a file."""
FILE_NAME = HOSTILE.replace("/", "") + ".png"
SMALL = 48, 32


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The inputs of all runs; one photo has a hostile name."""
    made = tmp_path_factory.mktemp("report")
    write_inputs(made)
    shutil.copy(made / "photo.png", made / FILE_NAME)
    return made


@pytest.fixture(scope="module")
def run(folder: Path) -> Run:
    """Under lobes, so that the light has a detailed twin; the photo's name is hostile."""
    argv = arguments(
        folder, folder / "out", photo=str(folder / FILE_NAME), light=str(folder / "lobes.json"),
        device="cpu",
    )  # fmt: skip
    return go(argv, folder / "out")


@pytest.fixture(scope="module")
def page(run: Run) -> str:
    """The report of that run."""
    return (run.out / "report.html").read_text("utf-8")


@pytest.fixture(scope="module")
def guided(run: Run) -> report.Results:
    """The same results as a guided run would have left them: steps, a verdict, recovered curves."""
    results = read_results(run.out)
    record: dict[str, Any] = json.loads(json.dumps(results.record))
    record["notices"] = [f"the prior does not know: {HOSTILE}"]
    record["config"] |= {"prompt": HOSTILE, "guidance": "stable-diffusion", "model": "/a/model"}
    record["measured"] |= {
        "prior": "stable-diffusion",
        "prior_sha256": "0" * 64,
        "prompts": {"guidance": HOSTILE},
        "loop_integrator": "transport",
        "optimization": {
            "steps": 4, "skipped_steps": 1, "best_step": 2, "score_at_start": 9.0,
            "best_score": 7.5,
        },
        "acceptance": {"is_accepted": False, "rise": 0.2, "error": 0.4, "draws": 16},
        "settings": {"steps": 4},
    }  # fmt: skip
    assert results.curves is not None
    knots = results.curves.shadow_ratio
    bent = type(knots)(knots.x, knots.y**2, knots.slope)
    by_step = {"score": [None, 7.5, None, 8.0], "gradient": [3.0, 2.0, 1.0, 0.5], "new": [None] * 4}
    return replace(
        results,
        record=record,
        curves=replace(results.curves, shadow_ratio=bent),
        optimization={**record["measured"]["optimization"], "by_step": by_step},
    )


def headings(text: str) -> list[str]:
    return [html.unescape(h) for h in re.findall("<h2>(.*?)</h2>", text)]


def opened(browser: Opened, path: Path, content: bytes | None = None) -> Opened:
    """Go to a page, which is written first where its content is given."""
    if content is not None:
        path.write_bytes(content)
    browser.page.goto(path.as_uri())
    return browser


# ------------------------------------------------------------------------------- what it is


def test_report_is_listed_with_its_hash_and_small(run: Run, page: str) -> None:
    """As every other result; its pictures are scaled down."""
    content = (run.out / "report.html").read_bytes()
    assert run.record["files"]["report.html"] == hashlib.sha256(content).hexdigest()
    assert list(run.record["files"])[-1] == "report.html"
    assert len(content) < 3e6 and "report" in run.record["seconds"]
    assert run.record["peak_mib"]["host"] > 50.0


def test_no_report_leaves_it_out_and_changes_no_other_byte(
    run: Run, folder: Path, tmp_path: Path
) -> None:
    """--no-report; the flag stands in run.json alone."""
    assert main([*run.argv, "--no-report", "--out", str(tmp_path / "out")]) == ExitCode.DONE
    with_it, without = outcome(run.out), outcome(tmp_path / "out")
    del with_it["run.json"], with_it["report.html"], without["run.json"]
    assert with_it == without
    told = json.loads((tmp_path / "out/run.json").read_text())
    assert told["config"]["report"] is False and "report" not in told["seconds"]


def test_page_allows_nothing_but_its_own_style_and_script(page: str) -> None:
    """default-src 'none'; both are named by the sha256 of what stands in the page."""
    (policy,) = re.findall('Content-Security-Policy" content="([^"]*)"', page)
    assert policy.startswith("default-src 'none'; img-src data:;") and "unsafe" not in policy
    for tag in ("style", "script"):
        (content,) = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        assert f"{tag}-src {source_hash(content.encode())}" in policy
    addresses = re.findall(r'(?:src|srcset|action)="([^"]{0,30})', page)
    assert addresses and all(address.startswith("data:image/") for address in addresses)
    assert "style=" not in page and " onclick" not in page


def test_page_tells_what_the_run_measured(run: Run, page: str) -> None:
    """Sections, files with their purposes and hashes, inputs, settings, notes."""
    text = html.unescape(page)
    assert headings(page) == [
        "Photo and result", "Layers", "The light", "Where the camera stood",
        "Where the light comes from", "What was noticed and assumed", "If it looks wrong",
        "Figures", "Time and memory", "The same again", "Settings", "Inputs", "Files", "Versions",
    ]  # fmt: skip
    for name, digest in run.record["files"].items():
        assert name == "report.html" or (name in text and digest in text)
        assert about_file(name), f"{name}: nobody says what it is for"
    assert all(digest in text for digest in run.record["inputs"].values())
    assert all(line in text for line in (*run.record["assumed"], *run.record["notices"]))
    assert all(f">{stage}" in page for stage in ("render", "write the files"))
    assert (
        "given: lobes.json" in text and run.record["measured"]["placement"]["summary"][1:] in text
    )
    assert "<dt>pitch</dt><dd>-15.0° (--pitch)</dd>" in text
    # The strongest lobe of the light: azimuth 121, elevation 54 degrees.
    assert "from the upper right, behind the camera, 5" in text
    for name in ("fg", "shadow", "plate", "matte", "depth", "normal", "albedo", "position"):
        assert f'id="layer-{name}"' in page
    assert re.search(r'samples</span><span class="mark">set</span></td><td>4<', page)


def test_files_are_links_where_the_page_lies_beside_them(run: Run, page: str) -> None:
    """Each leads to the file; a page elsewhere has names alone."""
    links = [html.unescape(link) for link in re.findall(r'<a href="([^"]*)"', page)]
    names = {name for name in run.record["files"] if name != "report.html"} | {"run.json"}
    assert set(links) == names and all((run.out / link).is_file() for link in links)
    assert b"<a href" not in report.report_page(read_results(run.out), is_beside=False)


def commands(page: str) -> list[list[str]]:
    """Return the commands of "If it looks wrong" as words."""
    part = page.split("If it looks wrong")[1].split("<section>", maxsplit=1)[0]
    return [
        shlex.split(html.unescape(line)) for line in re.findall("<code>(python.*?)</code>", part)
    ]


@pytest.mark.parametrize(
    ("changes", "flags"),
    [
        ({}, {"--light-rotate", "--exposure", "--fov", "--place", "--pitch"}),
        ({"place": None, "at": "24,22", "size": "2"}, {"--at", "--size"}),
        ({"light": None, "sun": "40,50", "pitch": None, "horizon": ".4"}, {"--sun", "--horizon"}),
    ],
)
def test_what_to_change_are_commands_that_are_understood(
    run: Run, folder: Path, changes: dict[str, str | None], flags: set[str], tmp_path: Path
) -> None:
    """Each by the run's own settings, of which it changes what it names and nothing else."""
    asked = parse(arguments(folder, tmp_path / "out", **changes)).config
    record = {**run.record, "config": asked.flat()}
    (tmp_path / "run.json").write_text(json.dumps(record))
    results = replace(read_results(run.out), record=record)
    found = commands(report.report_page(results).decode())
    given = {word for words in found for word in words if word.startswith("--")}
    assert flags < given and len(found) >= 8
    for words in found:
        argv = [str(tmp_path / "run.json") if w == "run.json" else w for w in words[3:]]
        changed = parse(argv).config.flat()
        named = {w[2:].replace("-", "_") for w in words if w.startswith("--")} - {"config"}
        assert {k for k, v in changed.items() if v != asked.flat()[k]} <= named, words
        assert changed["out"] == "OUT"


@pytest.mark.parametrize(
    ("given", "told"), [([], "--sun"), (["--guidance=none"], "--light-rotate")]
)
def test_what_to_change_of_the_demos_light_is_understood(given: list[str], told: str) -> None:
    """An estimated light is replaced, the demo's own is turned."""
    light = {"azimuth_deg": 0.0, "elevation_deg": 45.0}
    measured = {"light": light, "exposure_ev": 0.0, "samples": 40, "placement": {}}
    asked = parse(["--demo", *given, "--out", "out"]).config
    found = remedies(asked, {"measured": measured}, None)[0]
    words = shlex.split(found.command)
    assert told in words
    parse(["--demo", *given, *words[words.index("run.json") + 1 :]])
    assert (told == "--sun") or "counter-clockwise" in found.about


def test_page_tells_no_folder(run: Run, page: str, folder: Path) -> None:
    """A report is handed on: where somebody keeps their files is for run.json."""
    assert str(folder) not in html.unescape(page)
    record = {**run.record, "notices": [f"{folder}/{FILE_NAME}: odd"]}
    results = replace(read_results(run.out), record=record)
    told = html.unescape(report.report_page(results).decode())
    assert str(folder) not in told and f"{FILE_NAME}: odd" in told


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("/home/ann/.cache/warpir: full", "warpir: full"),
        ("~/.cache/warp: kernels, 3/4 of 0.5 and/or", "warp: kernels, 3/4 of 0.5 and/or"),
        ("'/home/ann/My Photos/b c.png' (/srv/a(1)/x.png)", "'b c.png' (x.png)"),
        (r"C:\Users\Ann B\x.png or \\host\ann\y.png", "x.png or y.png"),
        ("D:/Users/ann/x.png", "x.png"),
        ("in=/home/ann/x, file:///home/ann/y", "in=x, y"),
        ("models/a car/other.mtl: grey", "other.mtl: grey"),
        (
            "/materials/0/ior 3 clamped; https://a.org/b",
            "/materials/0/ior 3 clamped; https://a.org/b",
        ),
        (
            "/extensions/KHR_lights_punctual/lights/0: x",
            "/extensions/KHR_lights_punctual/lights/0: x",
        ),
        ("a / b, 5 frames/s. In ../x.png", "a / b, 5 frames/s. In x.png"),
    ],
)
def test_paths_of_a_line_keep_their_last_part(line: str, told: str) -> None:
    """Whether anybody gave them or not; fractions, pointers and addresses are no paths."""
    config = InsertConfig(asset="models/a car/a.obj", photo="../x.png", reuse=".", out="/o")
    assert without_folders(line, config.flat()) == told


def test_folder_of_a_dot_is_told_by_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The run in which somebody stands."""
    (tmp_path / "street").mkdir()
    monkeypatch.chdir(tmp_path / "street")
    assert "--reuse street " in command_line(InsertConfig(reuse=".", photo="a.png").flat())


def test_hostile_texts_stay_texts(page: str, guided: report.Results) -> None:
    """A photo's name, a prompt, a notice: escaped wherever they stand."""
    for text in (page, report.report_page(guided).decode()):
        assert "<img src=x" not in text
        assert text.count("</script>") == 1
        assert escape(FILE_NAME) in text
    assert report.report_page(guided).decode().count(escape(HOSTILE)) >= 3


def test_names_that_are_no_text_do_not_end_the_run(guided: report.Results) -> None:
    """A photo's name need not be UTF-8: what cannot be shown is a question mark."""
    record = {**guided.record, "config": {**guided.record["config"], "photo": "a\udcff.png"}}
    assert b"a?.png" in report.report_page(replace(guided, record=record))


def test_guided_run_tells_light_sources(guided: report.Results) -> None:
    """Steps, scores, verdict, curves and every series that has numbers; nothing empty."""
    text = html.unescape(report.report_page(guided).decode())
    assert {"Tone curves", "Convergence"} <= set(headings(text))
    assert "Stable Diffusion (sha256 0000" in text and "not accepted: the start was kept" in text
    assert "0.2 ± 0.4" in text and "9 at the start, 7.5 at the end" in text
    assert "1 were skipped" in text and 'by step: from 9 to 8"' in text
    assert text.count('<svg class="plot"') == 4  # both curves, score, gradient
    assert "by the prior" in text and "guidance proposed another, which was not accepted" in text


def test_missing_parts_leave_no_empty_headings(guided: report.Results) -> None:
    """Of a folder in which only run.json is left, and of a run with nothing to say."""
    empty = report.Results(record=guided.record, missing=("layers.exr",))
    text = report.report_page(empty).decode()
    gone = {"Photo and result", "Layers", "The light", "Tone curves", "Convergence", "Files"}
    assert not gone & set(headings(text)) and "not shown: layers.exr" in text
    assert not re.search(r"</h2>\s*</section>", text)
    silent = {**guided.record, "notices": [], "assumed": [], "inputs": {}, "versions": {}}
    text = report.report_page(replace(guided, record=silent)).decode()
    assert not {"What was noticed and assumed", "Inputs", "Versions"} & set(headings(text))


def test_object_that_is_not_seen_is_told(guided: report.Results) -> None:
    """Only a shadow: the whole picture alone, layers without an object."""
    assert guided.layers is not None
    none = np.zeros_like(guided.layers.matte)
    layers = replace(guided.layers, matte=none, depth=np.full_like(none, np.inf))
    text = report.report_page(replace(guided, layers=layers)).decode()
    assert "The object is not seen in the photo." in text and "view-object" not in text
    assert 'id="layer-shadow"' in text and 'id="layer-depth"' not in text


def test_object_in_pixels_that_are_cut_off_has_no_depth(guided: report.Results) -> None:
    """In the last two columns of 1925, of which one in three is left: no surface is shown."""
    assert guided.layers is not None
    planes = {
        f.name: None if p is None else np.zeros((1, 1925, *p.shape[2:]), np.float32)
        for f in fields(guided.layers)
        for p in [getattr(guided.layers, f.name)]
    }
    layers = replace(guided.layers, **planes)
    assert layers.depth is not None
    layers.depth[:] = np.inf
    layers.depth[:, -2:] = 3.0
    layers.shadow_ratio[:] = 0.5
    names = [layer.name for layer in layers_shown(layers)]
    assert "matte" in names and "depth" not in names


def test_report_that_fails_does_not_cost_the_run(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """All else is written; run.json and the output say what went wrong. A full disk stays one."""

    def fail(results: report.Results) -> bytes:
        raise raised

    monkeypatch.setattr(report, "report_page", fail)
    raised: Exception = ValueError("zero-size array")
    run = go(arguments(folder, tmp_path / "out", device="cpu"), tmp_path / "out")
    line = "report.html could not be made (ValueError: zero-size array)"
    assert line in run.record["notices"][-1] and line in capsys.readouterr().out
    assert "composite.png" in run.record["files"] and "report.html" not in run.record["files"]
    raised = InputError("out", "no room", code=ExitCode.RESOURCES)
    assert main(arguments(folder, tmp_path / "full", device="cpu")) == ExitCode.RESOURCES
    assert not (tmp_path / "full").exists()


# ------------------------------------------------------------------------------ its pieces


@pytest.mark.parametrize(
    "argv",
    [
        ["--photo", "a b.png", "--asset", "x.glb", "--place", "-1,0,-3.5", "--no-detail"],
        ["--demo", "--accept", "--model", "m", "--prompt", "p", "--steps", "60", "--allow-pickle"],
        [
            "--demo",
            "--no-tone-curve",
            "--model",
            "m",
            "--prompt",
            'it\'s a "$HOME";',
            "--no-graphs",
        ],
        ["--demo", "--model", "m", "--prompt", "p", "--show-prior", "a, b|c", "--lora-rank", "8"],
        ["--demo", "--sun", "-30,40", "--sky", "0.1,0.2,0.3"],
    ],
)
def test_command_line_repeats_the_settings(argv: list[str]) -> None:
    """What is printed for a shell is parsed into the same configuration."""
    config = parse([*argv, "--out", "OUT"]).config
    words = shlex.split(command_line(config.flat()))
    assert words[:3] == ["python", "-m", "warpir.insert"]
    assert parse(words[3:]).config == config


def test_the_same_again_runs_with_a_model_of_the_hub(
    guided: report.Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its whole name, and with what no file can switch on; a folder by its last part."""
    told = {"model": "someone/a-model", "allow_download": True}
    record = {**guided.record, "config": {**guided.record["config"], **told}}
    results = replace(guided, record=record)
    text = html.unescape(report.report_page(results).decode())
    assert "warpir.insert --config run.json --allow-download --out OUT<" in text
    assert "--model someone/a-model " in text and "--allow-pickle" not in text
    config = report.config_of(record)
    assert without_folders("someone/a-model: odd", config.flat()) == "someone/a-model: odd"
    (tmp_path / "someone" / "a-model").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert "--model a-model " in command_line(config.flat())


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"demo": True, "guidance": "none"}, "the demo's own"),
        ({"demo": True, "start": "uniform"}, "even, as none was given"),
    ],
)
def test_light_of_the_demo_is_told_where_it_is_used(values: dict[str, Any], words: str) -> None:
    """Not where an even light was asked for."""
    config = InsertConfig(**values)
    record = {"measured": {"prior": "none"}, "config": config.flat()}
    ((_, text),) = light_sources(record, config.light)
    assert text.startswith(words)


def test_every_file_of_the_table_is_one_that_runs_write() -> None:
    """No purpose is told twice, and none of a name that never fits."""
    names = [pattern for pattern, _ in ABOUT_FILES]
    assert len(set(names)) == len(names)
    assert about_file("mitsuba/scene.xml") and about_file("envmap_detail_preview.png")
    assert about_file("something.else") == ""
    # Its own purpose, not that of the run's file of the same name.
    assert about_file("mitsuba/envmap.exr") == about_file("mitsuba/scene.xml")


@pytest.mark.parametrize("size", [(10, 7), (64, 48), (100, 301)])
def test_shrunk_pictures_are_means(size: tuple[int, int], rng: np.random.Generator) -> None:
    """Whole squares of pixels, no side longer than asked for; the same where it is small."""
    plane = rng.random((*size, 3), np.float32)
    shrunk = shrink(plane, 20)
    k = -(-max(size) // 20)
    assert max(shrunk.shape[:2]) <= 20
    if k == 1:
        np.testing.assert_array_equal(shrunk, plane)
    np.testing.assert_allclose(shrunk[0, 0], plane[:k, :k].mean((0, 1)), rtol=1e-5)
    np.testing.assert_allclose(
        shrunk[-1, -1],
        plane[(shrunk.shape[0] - 1) * k :][:k, (shrunk.shape[1] - 1) * k :][:, :k].mean((0, 1)),
        rtol=1e-5,
    )


def test_rgbe_holds_the_light(rng: np.random.Generator) -> None:
    """Decoded as the page does, within one mantissa; zero stays zero."""
    linear = (10.0 ** rng.uniform(-4, 5, (20, 10, 3))).astype(np.float32)
    linear[0, 0] = 0.0
    codes = rgbe(linear).astype(np.float64)
    decoded = codes[..., :3] * 2.0 ** (codes[..., 3:] - 136.0)
    largest = linear.max(axis=-1, keepdims=True)
    assert (np.abs(decoded - linear) <= largest / 128.0).all()
    assert (decoded[0, 0] == 0.0).all()


def test_plot_has_axes_in_round_numbers() -> None:
    """Ticks within the range, in steps of 1, 2 or 5; one value alone is drawn too."""
    assert ticks(0.0, 1.0, 5) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert ticks(-3.2, 11.0, 5) == pytest.approx([0.0, 5.0, 10.0])
    plot = line_plot([Series(np.array([2.0]), np.array([3.0]))], "a", ("x", "y"))
    (line,) = plot.lines
    assert line.points == [plot.middle] and line.has_dots
    assert [text for _, text in plot.x_ticks] == ["1", "1.5", "2", "2.5", "3"]
    assert all(plot.left <= x <= plot.right for x, _ in plot.x_ticks)
    assert all(plot.top <= y <= plot.bottom for y, _ in plot.y_ticks)


# --------------------------------------------------------------------- of a finished folder


def test_report_is_made_anew_of_a_finished_folder(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same page, without the photo or the object; that of the run itself is not replaced."""
    copy = tmp_path / "copy"
    shutil.copytree(run.out, copy)
    before = outcome(copy)
    assert remake([str(copy), "--to", str(tmp_path / "new.html")]) == ExitCode.DONE
    text = (tmp_path / "new.html").read_text("utf-8")
    assert headings(text) == headings((run.out / "report.html").read_text("utf-8"))
    assert remake([str(copy)]) == ExitCode.OUTPUT
    assert remake([str(copy), "--overwrite"]) == ExitCode.OUTPUT
    assert remake([str(copy), "--to", str(tmp_path / "new.html")]) == ExitCode.OUTPUT
    record = ["--to", str(copy / "run.json"), "--overwrite"]
    assert remake([str(copy), *record]) == ExitCode.OUTPUT
    assert outcome(copy) == before
    capsys.readouterr()
    (copy / "layers.exr").unlink()
    (copy / "balls.png").write_bytes(b"another")
    again = [str(copy), "--to", str(tmp_path / "new.html"), "--overwrite"]
    assert remake(again) == ExitCode.DONE
    assert "layers.exr is not there any more" in capsys.readouterr().out
    text = (tmp_path / "new.html").read_text("utf-8")
    assert "not shown: layers.exr, balls.png" in text and "The light" in headings(text)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "the following arguments are required: DIR"),
        (["--over"], "unrecognized arguments: --over"),
        (["--max-pixels", "x"], "--max-pixels: expected"),
        (["--max-pixels", "-3"], "max-pixels"),
    ],
)
def test_wrong_arguments_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], argv: list[str], words: str
) -> None:
    """As of every command of ours: no page of usage, no abbreviations."""
    assert remake([*([str(tmp_path)] if argv else []), *argv]) == ExitCode.USAGE
    error = capsys.readouterr().err
    assert error.startswith("error: ") and words in error and "usage:" not in error


def test_pictures_beyond_the_limit_are_refused(
    run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """By the limit of every other picture, before a pixel is decoded; the flag raises it."""
    argv = [str(run.out), "--to", str(tmp_path / "new.html")]
    assert remake([*argv, "--max-pixels", "1000"]) == ExitCode.INPUT
    error = capsys.readouterr().err
    assert "layers.exr: too large (found 48 x 32 pixels; limit 1000)" in error
    assert remake([*argv, "--max-envmap-width", "32"]) == ExitCode.INPUT
    assert "envmap.exr: too large" in capsys.readouterr().err
    assert remake([*argv, "--max-envmap-width", "65536"]) == ExitCode.DONE
    with pytest.raises(InputError, match="too large"):
        thumbnail(run.out / "composite.png", 1000)


@pytest.mark.parametrize("bits", [8, 16])
def test_thumbnail_is_the_picture_in_small(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bits: int
) -> None:
    """Of both depths; Pillow's own limit is not asked, as the run's may be higher."""
    ramp = np.linspace(0.0, 1.0, 640)[None, :, None] * np.ones((32, 1, 3)) * [1.0, 0.7, 0.4]
    kind = np.uint8 if bits == 8 else np.uint16
    writer = oiio.ImageOutput.create(str(tmp_path / "ramp.png"))
    writer.open(str(tmp_path / "ramp.png"), oiio.ImageSpec(640, 32, 3, kind.__name__))
    assert writer.write_image((ramp * np.iinfo(kind).max).astype(kind))
    writer.close()
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    made = thumbnail(tmp_path / "ramp.png", 10**6)
    monkeypatch.undo()
    content = base64.b64decode(made.uri.partition(",")[2])
    found = np.asarray(Image.open(io.BytesIO(content), formats=["JPEG"]), np.float64)
    assert (made.width, made.height) == (320, 16)
    expected = 255.0 * ramp.reshape(16, 2, 320, 2, 3).mean((1, 3))
    np.testing.assert_allclose(found, expected, atol=6.0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "not a finished run (found no run.json)"),
        ("{", "run.json"),
        ('{"format": 1, "config": {}, "files": {}}', "not what a run of this version writes"),
        ('{"format": 1, "config": {"samples": "x"}, "files": {}}', "samples"),
    ],
)
def test_folder_that_is_no_run_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str | None, words: str
) -> None:
    """One line, nothing written."""
    if content is not None:
        (tmp_path / "run.json").write_text(content)
    assert remake([str(tmp_path)]) in (ExitCode.INPUT, ExitCode.USAGE)
    error = capsys.readouterr().err
    assert error.count("error:") == 1 and words in error
    assert not (tmp_path / "report.html").exists()


# ----------------------------------------------------------------------------- in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Opened]:
    with open_browser() as made:
        yield made


def look_at(element: Locator, tmp_path: Path) -> NDArray[np.int32]:
    """What a person sees of an element, codes, shape [H, W, 3]."""
    element.screenshot(path=str(tmp_path / "shot.png"))
    return np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"), np.int32)


@pytest.mark.slow
@needs_chromium
def test_page_works_in_a_browser(browser: Opened, run: Run, tmp_path: Path) -> None:
    """Slider by key and mouse, layers, panorama; no message, no request but for the file."""
    seen = opened(browser, run.out / "report.html").page
    range_, after = seen.locator("#cut"), seen.locator("#view-whole .after")
    compare = seen.locator("#view-whole")
    compare.scroll_into_view_if_needed()

    def look() -> NDArray[np.int32]:
        return look_at(compare, tmp_path)

    # By keys: to the far left the whole result is seen, to the far right the whole photo.
    range_.focus()
    seen.keyboard.press("Home")
    assert after.evaluate("e => getComputedStyle(e).clipPath") == "inset(0px 0px 0px 0%)"
    result = look()
    seen.keyboard.press("End")
    assert "100%" in after.evaluate("e => getComputedStyle(e).clipPath")
    photo = look()
    seen.keyboard.press("ArrowLeft")
    assert range_.input_value() == "99.5"
    planes = read_layers(run.out / "layers.exr")
    height, width = planes.matte.shape
    difference = np.abs(planes.composite - planes.plate).sum(axis=-1) * (planes.matte == 1.0)
    row, column = np.unravel_index(np.argmax(difference), difference.shape)
    # Pixels of the page: where the object differs most from the photo that it hides.
    y, x = int((row + 0.5) / height * photo.shape[0]), int((column + 0.5) / width * photo.shape[1])
    assert np.abs(result[y, x] - photo[y, x]).max() > 20
    # By the mouse: left of the pointer is the photo, right of it the result.
    box = compare.bounding_box()
    assert box is not None
    middle = box["y"] + box["height"] / 2
    seen.mouse.move(box["x"] + box["width"] * 0.9, middle)
    seen.mouse.down()
    seen.mouse.move(box["x"] + box["width"] * 0.25, middle)
    assert float(range_.input_value()) == pytest.approx(25.0, abs=0.6)
    seen.mouse.up()
    seen.mouse.move(box["x"] + box["width"] * 0.7, middle)
    assert float(range_.input_value()) == pytest.approx(25.0, abs=0.6)
    mixed = look()
    np.testing.assert_array_equal(mixed[y, x], result[y, x])
    np.testing.assert_array_equal(
        mixed[y, int(0.1 * mixed.shape[1])], photo[y, int(0.1 * mixed.shape[1])]
    )
    # Layers, by keys: the next one is shown, and it alone.
    seen.locator("input[value=layer-composite]").focus()
    seen.keyboard.press("ArrowRight")
    assert seen.locator("#layer-fg").is_visible()
    assert seen.locator("figure.layer:visible").count() == 1
    seen.locator("input[value=view-object]").check(force=True)
    assert seen.locator("#view-object").is_visible() and not compare.is_visible()
    # Panorama: the canvas comes over the picture, dark and then bright.
    dial, canvas = seen.locator("#sky-light-stops"), seen.locator("#sky-light canvas")
    assert not canvas.is_visible()
    dial.focus()
    seen.keyboard.press("Home")
    canvas.wait_for(state="visible")
    dark = look_at(canvas, tmp_path).mean()
    seen.keyboard.press("End")
    seen.wait_for_function("() => document.querySelector('#sky-light output').value === '+8 EV'")
    for _ in range(50):  # it is drawn soon after it is told
        if look_at(canvas, tmp_path).mean() > dark + 50.0:
            break
        seen.wait_for_timeout(20)
    assert look_at(canvas, tmp_path).mean() > dark + 50.0
    # 1:1: a pixel of the picture on a pixel of the screen, and back.
    seen.locator("input[value=view-whole]").check(force=True)
    stage, zoom = compare.locator(".stage"), seen.locator("#exact")
    fitting = stage.evaluate("e => e.clientWidth")
    zoom.click()
    assert zoom.get_attribute("aria-pressed") == "true"
    assert stage.evaluate("e => e.clientWidth * devicePixelRatio") == SMALL[0] != fitting
    zoom.click()
    assert stage.evaluate("e => e.clientWidth") == fitting
    # A view that is not shown meanwhile has the object in its middle, too.
    compare.evaluate("e => { e.style.width = '20px'; e.style.height = '12px'; }")
    scrolled = "e => [e.scrollLeft, e.scrollTop]"
    zoom.click()
    wanted = compare.evaluate(scrolled)
    zoom.click()
    seen.locator("input[value=view-object]").check(force=True)
    zoom.click()
    seen.locator("input[value=view-whole]").check(force=True)
    assert compare.evaluate(scrolled) == wanted != [0, 0]
    assert browser.errors == []
    assert browser.requests == [(run.out / "report.html").as_uri()]


@needs_chromium
@pytest.mark.parametrize("width", [1280, 380])
def test_page_fits_and_hostile_texts_do_nothing(
    browser: Opened, guided: report.Results, tmp_path: Path, width: int
) -> None:
    """No scrolling sideways at any size, all details open; no message, no request."""
    browser.requests.clear()
    browser.page.set_viewport_size({"width": width, "height": 800})
    path = tmp_path / "page.html"
    seen = opened(browser, path, report.report_page(guided)).page
    seen.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true; })")
    assert seen.evaluate("document.documentElement.scrollWidth") <= width
    assert seen.locator("img[src=x]").count() == 0
    assert seen.locator("h1").inner_text() == f"box.glb in {FILE_NAME}"
    for name in ("input", "img"):
        unnamed = {
            "input": "e => !e.labels || e.labels.length === 0 || !e.labels[0].textContent.trim()",
            "img": "e => !e.alt",
        }[name]
        assert seen.locator(name).evaluate_all(f"all => all.filter({unnamed}).length") == 0
    assert browser.errors == [] and browser.requests == [path.as_uri()]


@needs_chromium
def test_colours_have_contrast_on_light_and_dark(
    browser: Opened, page: str, tmp_path: Path
) -> None:
    """Text against its background: at least 4.5 to 1 (WCAG 2.1, AA)."""
    names = ("--ink", "--soft", "--accent", "--warn")
    for scheme in ("light", "dark"):
        browser.page.emulate_media(color_scheme=scheme)
        opened(browser, tmp_path / "page.html", page.encode())
        get = "n => getComputedStyle(document.documentElement).getPropertyValue(n).trim()"
        colors = {n: browser.page.evaluate(get, n) for n in (*names, "--paper", "--warn-tint")}
        for name in names:
            ground = colors["--warn-tint" if name == "--warn" else "--paper"]
            assert contrast(colors[name], ground) >= 4.5, (scheme, name)


def contrast(one: str, other: str) -> float:
    """Ratio of relative luminances of two colours, written #rrggbb (WCAG 2.1)."""

    def luminance(color: str) -> float:
        parts = [int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)]
        r, g, b = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts)
        return 0.2126 * r + 0.7152 * g + 0.0722 * b

    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)
