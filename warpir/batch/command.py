"""Insert many objects into many photos: the scenes of a manifest, several at the same time.

    python -m warpir.batch scenes.jsonl --out out
    python -m warpir.batch scenes.jsonl --out out --ray ADDRESS

Each line of the manifest is a scene (`warpir.batch.manifest`) and becomes a result folder of its
own, ``out/<name>``, as `warpir.insert` writes it. A scene that cannot be done takes no other one
with it; the same command again does only what is not done. All flags of an insertion may be given
for all scenes. ``docs/batch.md`` describes the rest.
"""

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from warpir.app.command import FLAGS, make_parser, read_arguments, read_values
from warpir.app.config import InsertConfig, usage
from warpir.app.program import require_packages, run_program, say
from warpir.batch.manifest import read_manifest
from warpir.batch.page import PAGE
from warpir.batch.ray import LOCAL
from warpir.batch.run import FAILURES, FORMAT, NONE_STARTED, SUMMARY, Batch, Options
from warpir.batch.scene import LOGS
from warpir.batch.task import DONE_BEFORE
from warpir.core.errors import ExitCode, InputError
from warpir.core.signals import Stopped
from warpir.core.strict_json import read_json_object
from warpir.io.folder_lock import locked

MOST_WORKERS = 1024

USAGE = "python -m warpir.batch MANIFEST --out DIR [FLAG ...]"
DESCRIPTION = "Insert the object of each line of a JSON-lines file; other flags are for all lines."
EXAMPLES = """\
examples:
  python -m warpir.batch scenes.jsonl --out out --validate
  python -m warpir.batch scenes.jsonl --out out --workers 4 --samples 128
  python -m warpir.batch scenes.jsonl --out /shared/out --ray 10.0.0.1:6379
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`.

    The status is 0 if all scenes are done, else that of the first that is not, in the manifest's
    order.
    """
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    options, given = _read_arguments(arguments)
    require_packages("warp", "torch", *(["ray"] if options.ray is not None else []))
    limits = InsertConfig(**{n: v for n, v in given.items() if n.startswith("max_")}).limits
    manifest = read_manifest(options.manifest, options.out, given, limits)
    _refuse_other_files(options)
    with Batch(options, manifest) as batch:
        if options.is_validating:
            batch.check()
            batch.raise_failures("cannot be used")
            say("all scenes can be used")
            return ExitCode.DONE
        with locked(options.out):
            try:
                batch.check()
                if not (options.out / SUMMARY).exists():
                    batch.write()  # whatever ends it, the next one knows the files for a batch's
                if options.is_all_or_nothing:
                    batch.raise_failures(NONE_STARTED)
                batch.do()
            except Stopped as error:
                how = "does all again" if options.is_fresh else "goes on with the rest"
                error.kept = (
                    f"kept: {batch.count('done', DONE_BEFORE)} of {len(batch.scenes)} scenes; "
                    f"the same command {how}"
                )
                raise
            finally:
                batch.write()
    batch.raise_failures(f"failed; {options.out / FAILURES} lists them")
    say(f"all {len(batch.scenes)} scenes are done: {options.out / PAGE}")
    return ExitCode.DONE


def _read_arguments(arguments: list[str]) -> tuple[Options, dict[str, Any]]:
    """Return what the batch is asked for, and the values of all scenes by their fields."""
    flags = {
        heading: {name: form for name, form in forms.items() if name != "resume"}
        for heading, forms in FLAGS.items()
    }
    parser = make_parser("batch", USAGE, DESCRIPTION, EXAMPLES, flags)
    group = parser.add_argument_group("the batch itself")
    add = group.add_argument
    add("manifest", metavar="MANIFEST", help="JSON lines, each a scene: its name, and what differs "
        "from the flags for all")  # fmt: skip
    add("--workers", metavar="N", help="Scenes at the same time (default: by cores, memory and "
        "GPUs)")  # fmt: skip
    add("--retries", metavar="N", help="Further attempts at a scene whose worker was killed or ran "
        "out of memory (default: 1)")  # fmt: skip
    add("--ray", metavar="ADDRESS", nargs="?", const=LOCAL, help="Use a Ray cluster: host:port, "
        "auto, or no address for one of this machine")  # fmt: skip
    add("--validate", action="store_true", help="Read and check all inputs, render nothing")
    add("--all-or-nothing", action="store_true", help="Start nothing if a line cannot be used")
    texts = read_arguments(parser, arguments)

    def number(name: str, low: int, high: int) -> int | None:
        text = texts.pop(name, None)
        if text is None:
            return None
        is_number = text.isascii() and text.isdigit() and len(text) <= 9
        if not (is_number and low <= int(text) <= high):
            raise usage(f"--{name}", f"a whole number, {low} to {high} (found {text[:60]})")
        return int(text)

    workers, retries = number("workers", 1, MOST_WORKERS), number("retries", 0, 100)
    if "out" not in texts:
        raise usage("--out", "needed", "a folder for the scenes' folders")
    options = Options(
        Path(texts.pop("manifest")),
        Path(texts.pop("out")),
        workers,
        1 if retries is None else retries,
        texts.pop("ray", None),
        texts.pop("validate", False),
        texts.pop("all_or_nothing", False),
        texts.pop("overwrite", False),
    )
    return options, read_values(texts)


def _refuse_other_files(options: Options) -> None:
    """Refuse to replace the manifest itself, or files that are none of ours.

    Raises:
        InputError: One would be replaced.
    """
    there = [
        name for name in (SUMMARY, FAILURES, PAGE, LOGS) if os.path.lexists(options.out / name)
    ]
    for name in there:
        path = options.out / name
        with suppress(OSError):  # a link to nothing is none
            if os.path.samefile(path, options.manifest):
                advice = "choose another name for it"
                raise usage("--out", f"{path} would replace the manifest", advice)
    try:
        is_ours = read_json_object(options.out / SUMMARY).get("format") == FORMAT
    except InputError:
        is_ours = False
    what = {
        SUMMARY: "not the summary of a batch, which would replace it",
        FAILURES: "there without the summary of a batch, which would replace it",
        PAGE: "there without the summary of a batch, whose page would replace it",
        LOGS: "there without the summary of a batch, which would write into it",
    }
    refused = [] if is_ours else there
    if LOGS in there and not (options.out / LOGS).is_dir():
        what[LOGS], refused = "not a folder, where a batch writes its logs", [*refused, LOGS]
    if refused:
        path = options.out / refused[0]
        raise InputError(path, what[refused[0]], "choose another --out", ExitCode.OUTPUT)
