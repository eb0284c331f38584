"""How right is the light, and how right are the insertions that it makes?

    python -m warpir.evaluate --panoramas PATH ... --assets PATH ... --scenes N --json FILE

Photographs are cut out of panoramas, so that their light is known; a diffuse and a glossy object is
put into each under the true light and under the light of every row (`warpir.evaluate.rows`), and
light and picture are compared. `docs/evaluation.md` says how.
"""

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import warpir
from warpir.app.config import EMBEDDED_STEPS, InsertConfig, usage
from warpir.app.program import run_program, say
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from warpir.evaluate.contact_sheet import Panel
    from warpir.evaluate.image_errors import Distance
    from warpir.evaluate.report import Entry
    from warpir.evaluate.rows import Bench
    from warpir.evaluate.scenes import Place, Subject
    from warpir.evaluate.stage import Prediction
    from warpir.io.results import OutputFolder
    from warpir.lighting.regressor import Regressor

    FloatArray = NDArray[np.float32]

FORMAT, VERSION = "warpir-evaluation", 1
LIGHT_HEIGHT = 128
"""Rows of the maps on which lights are compared."""
SHEET_ROWS = ("lds-regression", "lds-uniform", "regression", "predictions", "brightest-region")
"""Whose pictures the contact sheet shows: the first of these that was asked for."""
UNSEEN_SEED = 0xE7A1
"""Added to the seed of made-up photographs; training and its validation use others."""
PROCEDURAL_BATCH = 64
"""Of those, rendered at once."""
SAVED = ("tables.md", "contact_sheet.png")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments without the program's name; ``sys.argv`` when absent.

    Returns:
        The exit status, as of `warpir.insert`.
    """
    return run_program(_run, argv)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m warpir.evaluate", description=__doc__.partition("\n")[0]
    )
    add = parser.add_argument
    add(
        "--panoramas",
        type=Path,
        nargs="+",
        metavar="PATH",
        help="lat-long .hdr and .exr files, or folders of them",
    )
    add("--assets", type=Path, nargs="+", metavar="PATH", help="objects, or folders of them")
    add("--scenes", type=_count, default=20, metavar="N", help="photographs (default: 20)")
    add("--seed", type=_count, default=0, metavar="S", help="of everything that is random")
    add("--json", type=Path, metavar="FILE", help="all numbers")
    add(
        "--rows", metavar="A,B,...", help="names of rows or of groups of rows, or all (--list-rows)"
    )
    add("--list-rows", action="store_true", help="print the rows and end")
    add(
        "--width",
        type=_count,
        default=384,
        metavar="W",
        help="of the photographs [px] (default: 384)",
    )
    add(
        "--fov",
        type=float,
        default=60.0,
        metavar="DEG",
        help="vertical field of view (default: 60)",
    )
    add(
        "--curve",
        default="gamma",
        metavar="NAME",
        help="the camera's response: gamma (default) or filmic, which no row is told of",
    )
    add("--samples", type=_count, default=64, metavar="N", help="per pixel (default: 64)")
    add("--device", metavar="NAME", help="cpu, cuda or cuda:N")
    add("--threads", type=_count, default=0, metavar="N", help="on the CPU (default: one per core)")
    add("--out", type=Path, metavar="DIR", help="folder for " + " and ".join(SAVED))
    add("--overwrite", action="store_true", help="replace results in --out")
    add(
        "--predictions",
        type=Path,
        metavar="DIR",
        help="maps that another system made of the exported crops",
    )
    add("--export-crops", type=Path, metavar="DIR", help="write the photographs for another system")
    add(
        "--procedural",
        type=_count,
        default=0,
        metavar="N",
        help="made-up photographs on which the regressor's direction is measured too",
    )
    add(
        "--lpips",
        type=Path,
        metavar="FILE",
        help="weights of LPIPS (warpir/evaluate/lpips.py says which)",
    )
    add("--prior", metavar="FILE", help="weights of the embedded prior (default: warpir's own)")
    add(
        "--regressor",
        type=Path,
        metavar="FILE",
        help="weights of the regressor (default: warpir's own)",
    )
    add(
        "--model",
        metavar="DIR",
        help="a Stable Diffusion that guides in place of the embedded prior",
    )
    add("--prompt", metavar="TEXT", help="what all objects are (default: their files' names)")
    add("--steps", type=_count, metavar="N", help="of the guided rows")
    add("--debug", action="store_true", help="tracebacks and the libraries' messages")
    return parser


def _count(text: str) -> int:
    number = int(text)
    if not 0 <= number < 2**32:
        raise ValueError
    return number


def _run(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)

    from warpir.evaluate.rows import GROUPS, ROWS, chosen_rows

    is_guided = bool(options.model or options.prior or options.steps)
    rows = chosen_rows(options.rows, options.predictions is not None, is_guided)
    if options.list_rows:
        for name, row in ROWS.items():
            say(f"{name:20} {row.group:12} {row.words}")
        for group, words in GROUPS.items():
            say(f"group {group}: {words}")
        return ExitCode.DONE
    _check(options)
    if options.out is None:
        evaluate(options, rows, None)
        return ExitCode.DONE

    from warpir.io.results import OutputFolder

    with OutputFolder(options.out, options.overwrite) as output:
        evaluate(options, rows, output)
    say(f"written: {', '.join(SAVED)} in {options.out}")
    return ExitCode.DONE


def _check(options: argparse.Namespace) -> None:
    """Refuse what cannot be meant.

    Raises:
        InputError: A flag is missing or out of range (`ExitCode.USAGE`).
    """
    from warpir.evaluate.scenes import RESPONSES

    for name in ("panoramas", "assets"):
        if getattr(options, name) is None:
            raise usage(f"--{name}", "needed", "a folder or files")
    if options.scenes < 1:
        raise usage("--scenes", "at least 1")
    if not 16 <= options.width <= 4096:
        raise usage("--width", f"between 16 and 4096 (found {options.width})")
    if not 10.0 <= options.fov <= 120.0:
        raise usage("--fov", f"between 10 and 120 degrees (found {options.fov:g})")
    if options.samples < 1:
        raise usage("--samples", "at least 1")
    if options.curve not in RESPONSES:
        raise usage("--curve", f"no response {options.curve!a}", f"known: {', '.join(RESPONSES)}")
    if options.json is not None and not options.json.absolute().parent.is_dir():
        raise InputError(options.json, "its folder does not exist", code=ExitCode.RESOURCES)


def evaluate(
    options: argparse.Namespace, rows: Sequence[str], output: "OutputFolder | None"
) -> dict[str, Any]:
    """Make the scenes, ask every row, print and write what came of it.

    Args:
        options: Of the command line.
        rows: Names in `warpir.evaluate.rows.ROWS`.
        output: For tables and contact sheet, or None.

    Returns:
        What the JSON file holds.
    """
    started = time.perf_counter()
    from warpir.evaluate.report import as_plain, compare, pair_table, summarize, tables
    from warpir.evaluate.rows import ROWS
    from warpir.evaluate.scenes import ASSET_SUFFIXES, PANORAMA_SUFFIXES, Places, find_files

    lpips = _load_lpips(options)
    notices = _missing_measures(lpips)
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
    predictions = _exchange(options, [place for place, _ in scenes], notices)

    from warpir.render.device import choose_device

    device = choose_device(options.device)
    say(f"device: {device} (the first run compiles the kernels)")
    bench = _make_bench(options, scenes, device, predictions)
    rows = usable_rows(bench, rows, options.rows is not None, notices)
    for notice in notices:
        say(f"notice: {notice}")
    sheet_row = next((r for r in SHEET_ROWS if r in rows), rows[0])
    entries: list[Entry] = []
    panels: list[Panel] = []
    for place, subjects in scenes:
        made, shown = _judge(bench, place, subjects, rows, options, lpips, sheet_row)
        entries += made
        panels += shown
        best = [e for e in made if e.row == sheet_row]
        error = float(np.mean([e.figures["image.box.rmse"] for e in best]))
        say(f"{place.name}: {sheet_row}, RMSE of the box {error:.4f}")

    starts = {name: row.start for name, row in ROWS.items() if row.start is not None}
    summary, pairs = summarize(entries), compare(entries, starts)
    record = _record(options, bench, scenes, notices)
    if options.procedural:
        record["procedural"] = procedural_errors(
            bench.network, options.procedural, options.seed, device
        )
    record["seconds"] = round(time.perf_counter() - started, 1)
    lines = [
        *_head(record),
        *_verdicts(entries),
        *tables(summary, {name: ROWS[name].words for name in rows}),
        # What is known of the truth needs no comparison; the JSON file has it all the same.
        *pair_table([p for p in pairs if ROWS[p.row].group != "references"]),
    ]
    record["entries"] = [asdict(entry) for entry in entries]
    record["summary"] = as_plain(summary)
    record["pairs"] = [asdict(pair) for pair in pairs]
    for line in lines:
        say(line)
    if output is not None:
        from warpir.evaluate.contact_sheet import contact_sheet

        output.write_bytes("tables.md", ("\n".join(lines) + "\n").encode())
        sheet = contact_sheet(panels, sheet_row)
        output.write_png("contact_sheet.png", sheet, mark=False, description="Evaluation")
    if options.json is not None:
        text = json.dumps(_plain(record), indent=1, allow_nan=False) + "\n"
        write_file(options.json, text.encode())
        say(f"written: {options.json}")
    return record


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
) -> "dict[str, FloatArray] | None":
    """Write crops for, and read maps of, another system."""
    from warpir.evaluate.predictions import export_crops, read_predictions

    if options.export_crops is not None:
        export_crops(places, options.export_crops, options.overwrite)
        say(f"written: {len(places)} crops in {options.export_crops}")
    if options.predictions is None:
        return None
    found = read_predictions(options.predictions, places)
    if found.missing:
        notices.append(f"{len(found.missing)} scenes have no map in {options.predictions}")
    notices += [f"{options.predictions}: {name} is of no scene" for name in found.unused]
    return found.maps


def _make_bench(
    options: argparse.Namespace,
    scenes: "list[tuple[Place, list[Subject]]]",
    device: str,
    predictions: "dict[str, FloatArray] | None",
) -> "Bench":
    from warpir.evaluate.rows import Bench
    from warpir.lighting.regressor import load_regressor

    network, missing = None, None
    try:
        network = load_regressor(options.regressor, device)
    except InputError as error:
        if options.regressor is not None:
            raise
        missing = error
    # Ablations that adapt the small prior do so in proportion: its recipe of 150 to 300 steps.
    adaptation: dict[str, Any] = {"class_images": 40, "lora_steps": 200, "lora_rank": 8}
    config = InsertConfig(
        **({} if options.model is not None else adaptation),
        guidance="stable-diffusion" if options.model is not None else "embedded",
        model=options.model,
        prior=options.prior,
        regressor=None if options.regressor is None else str(options.regressor),
        prompt=options.prompt,
        # Rows that guide ask the embedded prior, which a plain run does not.
        steps=options.steps or (EMBEDDED_STEPS if options.model is None else None),
        threads=options.threads or None,
    )
    return Bench(scenes, device, options.seed, config, network, missing, predictions)


def usable_rows(
    bench: "Bench", rows: Sequence[str], is_asked: bool, notices: list[str]
) -> list[str]:
    """Return the rows that can be made; those that cannot end the run only if they were named.

    Raises:
        InputError: A row that was asked for needs what is not there.
    """
    from warpir.evaluate.rows import ROWS

    usable = []
    for name in rows:
        try:
            ROWS[name].require(bench)
        except InputError as error:
            if is_asked:
                raise
            notices.append(f"row {name} is left out: {error.where}: {error.what}")
        else:
            usable.append(name)
    return usable


def _judge(
    bench: "Bench",
    place: "Place",
    subjects: "list[Subject]",
    rows: Sequence[str],
    options: argparse.Namespace,
    lpips: "Distance | None",
    sheet_row: str,
) -> "tuple[list[Entry], list[Panel]]":
    """Return what every row gets in one place, and what the contact sheet shows of it."""
    from warpir.evaluate.contact_sheet import Panel, to_codes
    from warpir.evaluate.image_errors import image_errors, make_regions
    from warpir.evaluate.light_errors import light_errors
    from warpir.evaluate.report import Entry
    from warpir.evaluate.rows import ROWS
    from warpir.evaluate.stage import Quality, Stage
    from warpir.scene.light import as_map

    entries, panels = [], []
    of_place: dict[str, tuple[Prediction, FloatArray, dict[str, float]]] = {}
    for subject in subjects:
        quality = Quality(samples=options.samples)
        stage = Stage(subject, bench.device, quality, options.seed, options.threads)
        regions = make_regions(stage.mask, stage.ratio)
        lights: dict[str, FloatArray] = {}
        for name in rows:
            row = ROWS[name]
            if row.of_subject is not None:
                prediction = row.of_subject(bench, stage, subject)
                texels = as_map(prediction.light, LIGHT_HEIGHT)
                of_light = light_figures(place, texels)
            elif name in of_place:
                prediction, texels, of_light = of_place[name]
            else:
                assert row.of_place is not None
                prediction = row.of_place(bench, place)
                texels = as_map(prediction.light, LIGHT_HEIGHT)
                of_light = light_figures(place, texels)
                of_place[name] = prediction, texels, of_light
            lights[name], figures = texels, dict(of_light)
            if row.same_as in lights:
                figures["light.same_deg"] = light_errors(texels, lights[row.same_as])[
                    "peak_angle_deg"
                ]
            rendered = stage.render(prediction)
            image = stage.compose(rendered, prediction.curves)
            figures |= _flat("image", image_errors(image, stage.truth, regions, lpips))
            gain = stage.fit_exposure(rendered, prediction.curves)
            fitted = stage.compose(rendered, prediction.curves, gain)
            figures |= _flat("fitted", image_errors(fitted, stage.truth, regions, lpips))
            figures["fitted.ev"] = float(np.log2(gain))
            entries.append(
                Entry(
                    name,
                    place.name,
                    place.panorama,
                    place.is_sunny,
                    subject.material,
                    figures,
                    prediction.about,
                )
            )
            if name == sheet_row:
                error = figures["image.box.rmse"]
                pictures = (place.photo, image, stage.truth)
                panels.append(Panel(subject.name, error, *map(to_codes, pictures)))
    return entries, panels


def light_figures(place: "Place", texels: "FloatArray") -> dict[str, float]:
    """Return the errors of a light, ``light.*`` and ``spheres.*``, in the camera-yaw frame.

    Args:
        place: Knows the truth.
        texels: Lat-long radiance, world frame, shape [He, 2 He, 3].
    """
    from warpir.evaluate.light_errors import light_errors
    from warpir.evaluate.three_spheres import sphere_errors

    found, true = place.to_camera(texels), place.to_camera(place.texels)
    errors = light_errors(found, true)
    for name in [n for n in errors if n.startswith("log_")]:
        errors[f"abs_{name}"] = abs(errors[name])
    return _flat("", {"light": errors, "spheres": sphere_errors(found, true)})


def procedural_errors(
    network: "Regressor", count: int, seed: int, device: str
) -> dict[str, dict[str, float]]:
    """Return how well the regressor finds the direction in made-up photographs never seen.

    Args:
        network: The regressor.
        count: Photographs.
        seed: Objects, lights and photographs are those of no training run.
        device: Warp device.

    Returns:
        Angle between found and true dominant direction [deg]: median, mean and 95 % interval of the
        mean, of the photographs with a visible cue and of those without; beside it that of a guess,
        the direction of the mean training light.
    """
    import torch

    from warpir.lighting.regressor import least_angle
    from warpir.train.lights import load_panoramas
    from warpir.train.meshes import make_meshes
    from warpir.train.scenes.generator import Mixture, SceneGenerator
    from warpir.train.scenes.render import Stock

    where = network.directions.device
    stock = Stock(make_meshes(24, UNSEEN_SEED + seed), load_panoramas([], where), device)
    scenes = SceneGenerator(stock, UNSEEN_SEED + seed, Mixture(made_up=1.0, hybrid=0.0))
    guess, _ = least_angle(
        network.directions, network.split(network.mean_light[None]).logits.softmax(dim=1)
    )
    angles: dict[str, list[float]] = {"found": [], "guessed": []}
    cues: list[bool] = []
    for index, first in enumerate(range(0, count, PROCEDURAL_BATCH)):
        batch = scenes.photo_batch(index, PROCEDURAL_BATCH)
        said = network.predict(batch.photo, batch.rays)
        axis, _ = least_angle(network.directions, said.logits.softmax(dim=1))
        wanted = min(PROCEDURAL_BATCH, count - first)
        cues += batch.has_cue[:wanted].tolist()
        for name, directions in (("found", axis), ("guessed", guess.expand_as(axis))):
            cosine = (directions * batch.axis).sum(dim=1).clamp(-1.0, 1.0)
            angles[name] += torch.rad2deg(torch.acos(cosine))[:wanted].tolist()
    return {
        f"{name}, {words}": _spread([a for a, c in zip(values, cues, strict=True) if c == is_cue])
        for name, values in angles.items()
        for words, is_cue in (("visible cue", True), ("no cue", False))
        if is_cue in cues
    }


def _spread(angles: list[float]) -> dict[str, float]:
    from warpir.evaluate.report import bootstrap

    low, high = bootstrap(angles, [str(k) for k in range(len(angles))], rounds=1000)
    return {
        "median_deg": float(np.median(angles)),
        "mean_deg": float(np.mean(angles)),
        "mean_low_deg": low,
        "mean_high_deg": high,
        "count": len(angles),
    }


def _flat(prefix: str, nested: dict[str, dict[str, float]]) -> dict[str, float]:
    """Return nested figures by dotted name."""
    start = f"{prefix}." if prefix else ""
    return {f"{start}{k}.{n}": v for k, errors in nested.items() for n, v in errors.items()}


# ---------------------------------------------------------------------------------- what is written


def _record(
    options: argparse.Namespace,
    bench: "Bench",
    scenes: "list[tuple[Place, list[Subject]]]",
    notices: list[str],
) -> dict[str, Any]:
    """Return what the numbers depend on, as plain values."""
    from warpir.app.record import versions

    return {
        "format": FORMAT,
        "version": VERSION,
        "warpir": warpir.__version__,
        "commit": _commit(),
        "versions": versions(),
        "device": bench.device,
        "date": time.strftime("%Y-%m-%d"),
        "options": vars(options),
        "weights": bench.digests(),
        "notices": notices,
        "scenes": [
            {
                "name": place.name,
                "panorama": place.panorama,
                "is_sunny": place.is_sunny,
                "azimuth_deg": place.azimuth,
                "pitch_deg": place.pitch,
                "exposure": place.exposure,
                "asset": subjects[0].asset_path.name,
                "asset_to_world": subjects[0].placement.asset_to_world.tolist(),
            }
            for place, subjects in scenes
        ],
    }


def _plain(value: Any) -> Any:
    """Return what JSON can hold; a number that it lacks is null."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value if isinstance(value, bool | int | float | str | None) else str(value)


def _commit() -> str:
    """Return the commit of this checkout, or "unknown" for an installed package."""
    import subprocess

    found = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"],
        capture_output=True,
        text=True,
        check=False,
    )
    return found.stdout.strip() or "unknown"


def _head(record: dict[str, Any]) -> list[str]:
    """Return what stands above the tables, as lines of Markdown."""
    options, panoramas = record["options"], {s["panorama"] for s in record["scenes"]}
    sunny = sum(s["is_sunny"] for s in record["scenes"])
    lines = [
        "# Evaluation",
        "",
        f"{len(record['scenes'])} photographs ({sunny} sunny) of {len(panoramas)} panoramas, seed "
        f"{options['seed']}, {options['width']} pixels wide, response {options['curve']}; "
        f"{record['date']}, {record['device']}, warpir {record['warpir']}, commit "
        f"{record['commit']}.",
        "",
        "Means over scenes with 95 % bootstrap intervals; scenes of one panorama are not",
        "independent (the JSON file has intervals over panoramas too). Angles are in degrees.",
        "",
        *(f"Notice: {notice}." for notice in record["notices"]),
        "",
    ]  # fmt: skip
    if "procedural" in record:
        lines += ["## Made-up photographs never seen", ""]
        lines += [
            f"* {name}: median {s['median_deg']:.1f}, mean {s['mean_deg']:.1f} degrees "
            f"({s['mean_low_deg']:.1f} .. {s['mean_high_deg']:.1f}), {s['count']} photographs"
            for name, s in record["procedural"].items()
        ]
        lines.append("")
    return lines


def _verdicts(entries: "list[Entry]") -> list[str]:
    """Return how often guidance could show that its end is better than its start, by row."""
    verdicts: dict[str, list[bool]] = {}
    for entry in entries:
        acceptance = entry.about.get("record", {}).get("acceptance")
        if acceptance is not None:
            verdicts.setdefault(entry.row, []).append(bool(acceptance["is_accepted"]))
    if not verdicts:
        return []
    lines = ["## What guidance said of its own end", ""]
    lines += [f"* {row}: accepted in {sum(v)} of {len(v)} runs" for row, v in verdicts.items()]
    return [*lines, ""]
