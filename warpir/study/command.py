"""A study with people: which of two composites looks like an unedited photograph?

    python -m warpir.study make PAIRS --out STUDY       pages for raters, and the key to them
    python -m warpir.study score STUDY                  figures from the answers

PAIRS is a manifest or a folder of scenes (`warpir.study.pairs`). The protocol is that of DiPIR's
supplement C.1 with repeated pairs, catch pairs and intervals added; docs/study.md describes it.
"""

import argparse
import json
import math
import os
import random
import secrets
from collections.abc import Iterator, Sequence
from pathlib import Path

from warpir.app.command import Parser, whole_number
from warpir.app.config import usage
from warpir.app.program import run_program, say
from warpir.app.record import file_hash
from warpir.core.atomic import write_file, write_folder
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS
from warpir.study.answers import read_sheets
from warpir.study.key import (
    ANSWERS,
    KEY,
    PAGES,
    PROTOCOL,
    Study,
    key_bytes,
    protocol_bytes,
    read_study,
)
from warpir.study.pairs import Material, Shown, read_material
from warpir.study.plan import PAIRS_PER_CATCH, PAIRS_PER_REPEAT, Pair, make_plan, opaque

LARGEST = 10_000
"""Of raters, runs and counts of pairs."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`."""
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    options = _parser().parse_args(arguments)
    run = {"make": _make, "score": _score}[options.command]
    run(options)
    return ExitCode.DONE


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m warpir.study",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="make|score")
    for name, about, add_arguments in (
        ("make", "Make the pages of a study.", _add_make_arguments),
        ("score", "Print the figures of a study.", _add_score_arguments),
    ):
        command = commands.add_parser(name, help=about, description=about, allow_abbrev=False)
        command.add_argument("--debug", action="store_true", help="show tracebacks")
        add_arguments(command)
    return parser


def _add_make_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("pairs", type=Path, metavar="PAIRS", help="manifest (JSON), or a folder of scenes")
    add("--out", type=Path, required=True, metavar="STUDY", help="new folder")
    add("--method", metavar="NAME", help="of a folder: the method the others are compared with")
    at_least_one, count = whole_number(1, LARGEST), whole_number(0, LARGEST)
    add("--raters", type=at_least_one, default=9, metavar="N", help="people a pair (default: 9)")
    add("--runs", type=at_least_one, default=3, metavar="N", help="of the study (default: 3)")
    repeats = f"pairs shown twice to a rater (default: one in {PAIRS_PER_REPEAT})"
    add("--repeats", type=count, metavar="N", help=repeats)
    catches = (
        "catch pairs that are made where the manifest gives none and scenes have a photo "
        f"(default: one to {PAIRS_PER_CATCH} pairs)"
    )
    add("--catches", type=count, metavar="N", help=catches)
    misses = "catch pairs that a rater may miss and still count (default: 0)"
    add("--catch-misses", type=count, default=0, metavar="N", help=misses)
    add("--pairs-per-rater", type=at_least_one, metavar="N", help="most pairs (default: all)")
    number = whole_number(0, 10**19 - 1)
    add("--seed", type=number, metavar="N", help="of sides and order (default: a new random one)")
    add("--alpha", choices=("refuse", "ignore"), default="refuse", help="of transparent images")
    add("--max-pixels", type=number, default=LIMITS.pixels, metavar="N", help="largest image [px]")


def _add_score_arguments(command: argparse.ArgumentParser) -> None:
    add = command.add_argument
    add("study", type=Path, metavar="STUDY", help="folder that make has written")
    answers = "files of answers, or folders of them (default: STUDY/answers)"
    add("--answers", type=Path, nargs="+", metavar="PATH", help=answers)
    automated = "count what a program answered, and say so"
    add("--include-automated", action="store_true", help=automated)
    add("--json", type=Path, metavar="FILE", help="all figures")
    add("--markdown", type=Path, metavar="FILE", help="the tables")
    add("--overwrite", action="store_true", help="replace --json and --markdown")


# -------------------------------------------------------------------------------------- make


def _make(options: argparse.Namespace) -> None:
    out: Path = options.out
    if out.name in ("", ".."):
        raise usage("--out", f"names no new folder (found {str(out)!a})", "give it a name")
    if os.path.lexists(out) and (not out.is_dir() or any(out.iterdir())):
        raise InputError(
            out,
            "exists and is not an empty folder",
            "a study is never written over: choose another --out",
            ExitCode.OUTPUT,
        )
    seed = secrets.randbits(63) if options.seed is None else options.seed
    material = read_material(options.pairs, options.method)
    shown = (*material.shown, *_catches_to_make(material, options.catches, seed))
    plan = make_plan(
        [s.pair for s in shown],
        raters=options.raters,
        runs=options.runs,
        seed=seed,
        repeats=options.repeats,
        pairs_per_rater=options.pairs_per_rater,
    )
    study = Study(
        plan,
        material.method,
        options.raters,
        options.runs,
        options.catch_misses,
        material.words.title,
    )
    write_folder(out, _files(study, shown, material, options))
    pairs = sum(not pair.is_catch for pair in plan.pairs)
    baselines = {pair.baseline for pair in plan.pairs if not pair.is_catch}
    catches = len(plan.pairs) - pairs
    say(f"study {plan.id}: {pairs} pairs against {len(baselines)} baselines, {catches} catch pairs")
    say(
        f"raters: {len(plan.raters)} pages, {options.raters} raters a pair in each of "
        f"{options.runs} runs; the longest has {max(len(r.trials) for r in plan.raters)} choices"
    )
    if not catches:
        say("notice: no catch pairs, so nobody can be excluded")
    elif options.catch_misses >= catches:
        say("notice: --catch-misses allows every catch pair, so nobody can be excluded")
    say(f"{out / PAGES} may be published; {out / KEY} must not")


def _catches_to_make(material: Material, wanted: int | None, seed: int) -> list[Shown]:
    """Choose scenes of which catch pairs are made: none where the manifest has its own.

    Raises:
        InputError: Some are asked for that cannot be made (`ExitCode.USAGE`).
    """
    from warpir.study.images import HOW_MADE

    given = any(s.pair.is_catch for s in material.shown)
    with_photo = [s for s in material.shown if s.photo is not None and not s.pair.is_catch]
    if given and wanted is not None:
        raise usage("--catches", "the manifest has catch pairs of its own", "leave it out")
    if wanted is not None and wanted > len(with_photo):
        what = f"{wanted} cannot be made of {len(with_photo)} pairs whose scene has a photo"
        raise usage("--catches", what)
    if given:
        return []
    count = math.ceil(len(material.shown) / PAIRS_PER_CATCH) if wanted is None else wanted
    rng = random.Random(opaque(seed, "catches"))
    catches = []
    for chosen in rng.sample(with_photo, min(count, len(with_photo))):
        # Of either side, so that no method is seen more often than another.
        image = chosen.b if chosen.b is not None and rng.randrange(2) else chosen.a
        catches.append(Shown(Pair(chosen.pair.scene, "", "", HOW_MADE), image, None, chosen.photo))
    return catches


def _files(
    study: Study, shown: Sequence[Shown], material: Material, options: argparse.Namespace
) -> Iterator[tuple[str, bytes]]:
    """Yield all files of a study, the key last.

    Raises:
        InputError: An image cannot be used.
    """
    from warpir.study.images import neutral_png, read_image, require_same_size, upside_down
    from warpir.study.pages import Images, page

    plan, known, files = study.plan, [], []
    for k, pair in enumerate(shown):
        given = {"a": pair.a, "b": pair.b, "photo": pair.photo}
        sources = {part: path for part, path in given.items() if path is not None}
        codes = {
            part: read_image(path, max_pixels=options.max_pixels, alpha=options.alpha)
            for part, path in sources.items()
        }
        for part, path in sources.items():
            require_same_size(pair.a, codes["a"], path, codes[part])
        if pair.b is None:
            worse = upside_down(codes["a"], codes["photo"])
            if worse is None:
                raise InputError(
                    pair.a,
                    f"no catch pair can be made of it: it does not differ from {pair.photo} in one "
                    "place that covers less than half of it",
                    "give catch pairs in a manifest, or --catches 0",
                )
            codes["b"] = worse
        # Every pair has files of its own: one that came back in many would be the method's.
        names = {part: f"{opaque(plan.seed, plan.id, 'image', k, part)}.png" for part in codes}
        for part, image in codes.items():
            yield f"{PAGES}/{names[part]}", neutral_png(image)
        height, width = codes["a"].shape[:2]
        files.append(Images(names["a"], names["b"], names.get("photo"), width, height))
        known.append(
            {part: {"file": name, **_origin(sources.get(part))} for part, name in names.items()}
        )
    for rater in plan.raters:
        yield f"{PAGES}/{rater.token}.html", page(plan, rater, files, material.words)
    protocol = protocol_bytes(study, material.words)
    yield PROTOCOL, protocol
    yield KEY, key_bytes(study, protocol, known)


def _origin(path: Path | None) -> dict[str, str]:
    """Return the source of an image for the key; empty for one that was generated."""
    return {} if path is None else {"from": path.name, "sha256": file_hash(path)}


# ------------------------------------------------------------------------------------- score


def _score(options: argparse.Namespace) -> None:
    from warpir.study.report import markdown_of, print_report
    from warpir.study.score import score

    study = read_study(options.study)
    default = options.study / ANSWERS
    if options.answers is None and not default.is_dir():
        raise _without_answers(default)
    paths = list(_answer_files(options.answers or [default]))
    _require_targets(options, paths)
    sheets = read_sheets(paths, study.plan, include_automated=options.include_automated)
    report = score(study, sheets)
    if options.json is not None:
        write_file(options.json, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())
    if options.markdown is not None:
        write_file(options.markdown, markdown_of(report).encode())
    print_report(report)


def _answer_files(given: Sequence[Path]) -> Iterator[Path]:
    """Yield files of answers, those of a folder sorted by name.

    Raises:
        InputError: There are none.
    """
    for path in given:
        if not os.path.isdir(path):
            yield path
            continue
        found = sorted(path.glob("*.json"))
        if not found:
            raise _without_answers(path)
        yield from found


def _without_answers(path: Path) -> InputError:
    advice = (
        "publish the study's folder pages, give each rater the address of one page, and put the "
        "files that they send back there; --answers names another place"
    )
    return InputError(path, "no answers (found no .json files)", advice)


def _require_targets(options: argparse.Namespace, inputs: Sequence[Path]) -> None:
    """Refuse to write over anything but earlier figures.

    Raises:
        InputError: A file exists, is an input, belongs to the study, or is to hold both the figures
            and the tables (`ExitCode.OUTPUT`).
    """
    study = Path(os.path.realpath(options.study))
    # A file is replaced by its name: what a link leads to stays, unless it is itself named.
    answers = {name for path in inputs for name in (_place(path), Path(os.path.realpath(path)))}
    for flag, target in (("--json", options.json), ("--markdown", options.markdown)):
        if target is None:
            continue
        place, advice = _place(target), "choose another"
        if place.is_relative_to(study):
            what = "a file of the study"
        elif place in answers:
            what = "a file of answers"
        elif flag == "--markdown" and options.json and place == _place(options.json):
            what = "the same file as --json"
        elif os.path.isdir(target) or (os.path.lexists(target) and not options.overwrite):
            what, advice = "exists", "--overwrite replaces it, unless it is a folder"
        else:
            continue
        raise InputError(target, f"{what} ({flag})", advice, ExitCode.OUTPUT)


def _place(path: Path) -> Path:
    """Return where a name stands, links to its folder followed."""
    return Path(os.path.realpath(path.parent), path.name)
