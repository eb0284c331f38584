"""Evaluation of the light and of the insertions under it.

    python -m warpir.evaluate --panoramas PATH ... --assets PATH ... --scenes N --json FILE
    python -m warpir.evaluate --camera --panoramas PATH ... --scenes N --seed S --json FILE

Photographs are cut out of panoramas, so that their light is known; a diffuse and a glossy object is
put into each under the true light and under the light of every row (`warpir.evaluate.rows`), and
light and picture are compared. `docs/evaluation.md` describes the method. With ``--camera`` the
estimated cameras of photographs are compared instead, and nothing is rendered (`docs/camera.md`).
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpir.app.command import Parser, whole_number
from warpir.app.config import InsertConfig, usage
from warpir.app.program import run_program, say
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from warpir.evaluate.image_errors import Distance
    from warpir.evaluate.report import Entry
    from warpir.evaluate.results import Panel
    from warpir.evaluate.scenes import Place, Subject
    from warpir.evaluate.stage import Bench
    from warpir.io.results import OutputFolder

    FloatArray = NDArray[np.float32]

SHEET_ROWS = ("lds-regression", "lds-uniform", "regression", "predictions", "brightest-region")
"""Rows for the contact sheet; the first of these that was asked for is shown."""
SAVED = ("tables.md", "contact_sheet.png")
OF_CAMERA = ("camera", "panoramas", "scenes", "seed", "width", "calibrator", "json", "debug")
"""Flags that go with ``--camera``."""
COUNT = whole_number(0, 2**32 - 1)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`."""
    return run_program(_run, argv)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="python -m warpir.evaluate", description=__doc__.partition("\n")[0])
    _add_scene_flags(parser)
    add = parser.add_argument
    add("--out", type=Path, metavar="DIR", help="folder for " + " and ".join(SAVED))
    add("--overwrite", action="store_true", help="replace results in --out")
    add("--predictions", type=Path, metavar="DIR", help="another system's maps of exported crops")
    add("--export-crops", type=Path, metavar="DIR", help="write the photographs for another system")
    words = "rendered photographs on which the regressor's direction is measured too"
    add("--procedural", type=COUNT, default=0, metavar="N", help=words)
    _add_model_flags(parser)
    words = "measure the estimated cameras instead of the light; nothing is rendered"
    add("--camera", action="store_true", help=words)
    words = "weights of the network that estimates cameras (default: warpir's own)"
    add("--calibrator", type=Path, metavar="FILE", help=words)
    add("--debug", action="store_true", help="tracebacks and the libraries' messages")
    return parser


def _add_scene_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    words = "lat-long .hdr and .exr files, or folders of them"
    add("--panoramas", type=Path, nargs="+", metavar="PATH", help=words)
    add("--assets", type=Path, nargs="+", metavar="PATH", help="objects, or folders of them")
    add("--scenes", type=COUNT, default=20, metavar="N", help="photographs (default: 20)")
    add("--seed", type=COUNT, default=0, metavar="S", help="of everything that is random")
    add("--json", type=Path, metavar="FILE", help="all numbers")
    words = "JSON: kind of place by the panorama's name; adds a table by kind"
    add("--kinds", type=Path, metavar="FILE", help=words)
    words = "names of rows or of groups of rows, or all (--list-rows)"
    add("--rows", metavar="A,B,...", help=words)
    add("--list-rows", action="store_true", help="print the rows and end")
    words = "of the photographs [px] (default: 384)"
    add("--width", type=COUNT, default=384, metavar="W", help=words)
    words = "vertical field of view (default: 60)"
    add("--fov", type=float, default=60.0, metavar="DEG", help=words)
    words = "the camera's response, which no row knows: gamma (default) or filmic"
    add("--curve", default="gamma", metavar="NAME", help=words)
    add("--samples", type=COUNT, default=64, metavar="N", help="per pixel (default: 64)")
    add("--device", metavar="NAME", help="cpu, cuda or cuda:N")
    add("--threads", type=COUNT, default=0, metavar="N", help="on the CPU (default: one per core)")


def _add_model_flags(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    words = "weights of LPIPS (warpir/evaluate/lpips.py says which)"
    add("--lpips", type=Path, metavar="FILE", help=words)
    words = "weights of the regressor (default: warpir's own)"
    add("--regressor", type=Path, metavar="FILE", help=words)
    add("--model", metavar="DIR", help="a Stable Diffusion for the rows that guide")
    add("--prompt", metavar="TEXT", help="what all objects are (default: their files' names)")
    add("--steps", type=COUNT, metavar="N", help="of the guided rows")


def _run(arguments: list[str]) -> int:
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.camera:
        for name, value in vars(options).items():
            if name not in OF_CAMERA and value != parser.get_default(name):
                raise usage(f"--{name.replace('_', '-')}", "has no use with --camera", "omit it")
        _check(options, ("panoramas",))
        _evaluate_cameras(options)
        return ExitCode.DONE

    from warpir.evaluate.rows import GROUPS, ROWS, chosen_rows

    rows = chosen_rows(options.rows, options.predictions is not None, options.model is not None)
    if options.list_rows:
        for name, row in ROWS.items():
            say(f"{name:20} {row.group:12} {row.words}")
        for group, words in GROUPS.items():
            say(f"group {group}: {words}")
        return ExitCode.DONE
    _check(options, ("panoramas", "assets"))
    if options.out is None:
        evaluate(options, rows, None)
        return ExitCode.DONE

    from warpir.io.results import OutputFolder

    with OutputFolder(options.out, options.overwrite) as output:
        evaluate(options, rows, output)
    say(f"written: {', '.join(SAVED)} in {options.out}")
    return ExitCode.DONE


def _check(options: argparse.Namespace, needed: Sequence[str]) -> None:
    """Check the options, and that those needed are given.

    Raises:
        InputError: A flag is missing or out of range (`ExitCode.USAGE`).
    """
    from warpir.evaluate.scenes import RESPONSES

    for name in needed:
        if getattr(options, name) is None:
            raise usage(f"--{name}", "needed", "a folder or files")
    if options.scenes < 1:
        raise usage("--scenes", "at least 1")
    if not 16 <= options.width <= 4096:
        raise usage("--width", f"between 16 and 4096 (found {options.width})")
    # In a narrower photograph that looks down there is no room above the object's foot.
    if not 20.0 <= options.fov <= 120.0:
        raise usage("--fov", f"between 20 and 120 degrees (found {options.fov:g})")
    if options.samples < 1:
        raise usage("--samples", "at least 1")
    if options.curve not in RESPONSES:
        raise usage("--curve", f"no response {options.curve!a}", f"known: {', '.join(RESPONSES)}")
    if options.json is not None:
        if not options.json.absolute().parent.is_dir():
            raise InputError(options.json, "its folder does not exist", code=ExitCode.RESOURCES)
        if options.json.is_dir():
            raise InputError(options.json, "a folder", "name a file for --json", ExitCode.OUTPUT)


def _evaluate_cameras(options: argparse.Namespace) -> None:
    """Measure estimated cameras, print their errors and write them.

    Raises:
        InputError: The weights or a panorama cannot be used.
    """
    from warpir.calibration.network import load_calibrator
    from warpir.evaluate.camera.measure import lines_of, measure_cameras, unlearned
    from warpir.evaluate.scenes import PANORAMA_SUFFIXES, find_files
    from warpir.train.lights import SKY_ONLY

    network = load_calibrator(options.calibrator)
    files = find_files(options.panoramas, PANORAMA_SUFFIXES, "--panoramas")
    panoramas, notices = unlearned([p for p in files if SKY_ONLY not in p.stem], network)
    measured = measure_cameras(panoramas, options.scenes, options.seed, options.width, network)
    notices += measured.pop("notices")
    for notice in notices:
        say(f"notice: {notice}")
    for line in lines_of(measured):
        say(line)
    if options.json is not None:
        record = {
            "panoramas": measured.pop("panoramas"),
            "camera": measured,
            "scenes": options.scenes,
            "seed": options.seed,
            "width": options.width,
            "notices": notices,
        }
        _write_json(options.json, record)


def _write_json(path: Path, record: dict[str, Any]) -> None:
    write_file(path, (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    say(f"written: {path}")


def evaluate(
    options: argparse.Namespace, rows: Sequence[str], output: "OutputFolder | None"
) -> None:
    """Make the scenes, evaluate every row, print and write the results.

    Rows are names in `warpir.evaluate.rows.ROWS`, ``output`` is for tables and contact sheet.
    """
    started = time.perf_counter()
    from warpir.evaluate.judge import Judge, procedural_errors
    from warpir.evaluate.results import contact_sheet, plain_values, run_record, summarize
    from warpir.evaluate.rows import usable_rows
    from warpir.render.device import choose_device
    from warpir.train.networks.regressor import read_regressor

    lpips = _load_lpips(options)
    notices = _missing_measures(lpips)
    scenes = _make_scenes(options, notices)
    kinds = _kinds(options.kinds, {place.panorama for place, _ in scenes}, notices)
    predictions = _exchange(options, [place for place, _ in scenes], notices)
    device = choose_device(options.device)
    say(f"device: {device} (the first run compiles the kernels)")
    bench = _make_bench(options, scenes, device, predictions)
    rows = usable_rows(bench, rows, options.rows is not None, notices)
    for notice in notices:
        say(f"notice: {notice}")
    sheet_row = next((r for r in SHEET_ROWS if r in rows), rows[0])
    judge = Judge(bench, rows, options.samples, options.threads, lpips, sheet_row, kinds)
    entries: list[Entry] = []
    panels: list[Panel] = []
    for place, subjects in scenes:
        judged, shown = judge.place(place, subjects)
        entries += judged
        panels += shown
        found = [e.figures["image.box.rmse"] for e in judged if e.row == sheet_row]
        words = f"RMSE of the box {float(np.mean(found)):.4f}" if found else "no map"
        say(f"{place.name}: {sheet_row}, {words}")
    record = run_record(options, bench, scenes, notices)
    if options.procedural:
        network = read_regressor(options.regressor, device)
        record["procedural"] = procedural_errors(network, options.procedural, options.seed)
    record["seconds"] = round(time.perf_counter() - started, 1)
    lines = summarize(record, entries, rows)
    for line in lines:
        say(line)
    if output is not None:
        output.write_bytes("tables.md", ("\n".join(lines) + "\n").encode())
        sheet = contact_sheet(panels, sheet_row)
        output.write_png("contact_sheet.png", sheet, mark=False, description="Evaluation")
    if options.json is not None:
        _write_json(options.json, plain_values(record))


def _make_scenes(
    options: argparse.Namespace, notices: list[str]
) -> "list[tuple[Place, list[Subject]]]":
    """Cut the photographs out of the panoramas; add assumptions to the notices."""
    from warpir.evaluate.scenes import ASSET_SUFFIXES, PANORAMA_SUFFIXES, Places, find_files

    places = Places(
        find_files(options.panoramas, PANORAMA_SUFFIXES, "--panoramas"),
        find_files(options.assets, ASSET_SUFFIXES, "--assets"),
        options.seed,
        options.width,
        options.fov,
        options.curve,
    )
    scenes = places.make(options.scenes)
    notices += places.notices
    return scenes


def _kinds(path: Path | None, panoramas: set[str], notices: list[str]) -> dict[str, str]:
    """Read the kinds of places by the panoramas' names, `without_size` in the file or not.

    Raises:
        InputError: The file cannot be read, or holds something else.
    """
    if path is None:
        return {}
    from warpir.core.strict_json import read_json_object
    from warpir.train.places import without_size

    kinds = {without_size(name): kind for name, kind in read_json_object(path).items()}
    if not all(isinstance(kind, str) for kind in kinds.values()):
        raise InputError(path, "expected one word for each panorama's name")
    unknown = sorted(name for name in panoramas if without_size(name) not in kinds)
    if unknown:
        notices.append(f"no kind of {', '.join(unknown)} in {path}: the table by kind is without")
    return {name: kinds[without_size(name)] for name in panoramas.difference(unknown)}


def _load_lpips(options: argparse.Namespace) -> "Distance | None":
    if options.lpips is None:
        return None
    from warpir.evaluate.lpips import SIDE_MIN, Lpips

    if options.width / 1.5 < SIDE_MIN:
        raise usage("--lpips", f"needs photographs of {SIDE_MIN} pixels or more", "raise --width")
    return Lpips(options.lpips)


def _missing_measures(lpips: "Distance | None") -> list[str]:
    from warpir.evaluate.image_errors import has_flip

    notices = []
    if not has_flip():
        notices.append("FLIP is left out: pip install 'warpir[bench]' brings it")
    if lpips is None:
        notices.append("LPIPS is left out: its weights are not part of warpir (--lpips)")
    return notices


def _exchange(
    options: argparse.Namespace, places: "list[Place]", notices: list[str]
) -> "dict[str, FloatArray]":
    """Write crops for, and read maps of, another system."""
    from warpir.evaluate.predictions import export_crops, read_predictions

    if options.export_crops is not None:
        export_crops(places, options.export_crops, options.overwrite)
        say(f"written: {len(places)} crops in {options.export_crops}")
    if options.predictions is None:
        return {}
    predictions = read_predictions(options.predictions, places)
    if predictions.missing:
        left_out = f"{len(predictions.missing)} scenes have no map in {options.predictions}"
        notices.append(f"{left_out}: the row predictions is without them")
    notices += [f"{options.predictions}: {name} is of no scene" for name in predictions.unused]
    return predictions.maps


def _make_bench(
    options: argparse.Namespace,
    scenes: "list[tuple[Place, list[Subject]]]",
    device: str,
    predictions: "dict[str, FloatArray]",
) -> "Bench":
    from warpir.evaluate.stage import Bench

    config = InsertConfig(
        model=options.model,
        regressor=None if options.regressor is None else str(options.regressor),
        prompt=options.prompt,
        steps=options.steps or None,
        threads=options.threads or None,
        # The truth is the paper's: its ratio, without light that the object throws on the ground.
        bounce=False,
    )
    bench = Bench(scenes, device, options.seed, config, predictions, options.calibrator)
    if options.regressor is not None:
        _ = bench.network  # what was named must be usable, whatever the rows need
    return bench
