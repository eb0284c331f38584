"""Makes the report of a finished run anew: ``python -m warpir.report``.

    python -m warpir.report out/street --to street.html

reads the run's folder; the photo and the object need not be there any more.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpir.app.command import Parser, read_values
from warpir.app.config import DEFAULTS, InsertConfig, flag
from warpir.app.earlier_runs import check_files, run_record
from warpir.app.program import run_program, say
from warpir.core.arrays import FloatArray
from warpir.core.atomic import write_file
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS, Limits
from warpir.core.strict_json import read_json_object
from warpir.io.curves_file import read_curves
from warpir.io.images.decoder import decode_image
from warpir.io.images.photos import read_envmap
from warpir.io.layers import read_layers
from warpir.report.page import REPORT, Results, report_page


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`."""
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    parser = Parser(
        prog="python -m warpir.report",
        description="Make the report of a finished run anew.",
        allow_abbrev=False,
    )
    parser.add_argument("folder", type=Path, metavar="DIR", help="what --out of the run named")
    parser.add_argument("--to", type=Path, metavar="FILE", help="default: DIR/report.html")
    parser.add_argument("--overwrite", action="store_true", help="replace FILE")
    raised = ("max_pixels", "max_envmap_width")
    for name in raised:
        parser.add_argument(flag(name), metavar="N", help=f"default: {DEFAULTS[name]}")
    parser.add_argument("--debug", action="store_true", help="show tracebacks")
    given = parser.parse_args(arguments)
    texts = {name: text for name in raised if (text := getattr(given, name)) is not None}
    values = read_values(texts)
    results = read_results(given.folder, InsertConfig(**values).limits)
    try:
        path = given.to or given.folder / REPORT
        is_beside = path.parent.resolve() == given.folder.resolve()
        page = report_page(results, is_beside)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        # A file of unknown origin may hold anything under the names that a run writes.
        what = f"not what a run of this version writes ({type(error).__name__}: {error})"
        raise InputError(given.folder / "run.json", what) from error
    folder = given.folder.resolve()
    if path.resolve() in [folder / name for name in (*results.files, "run.json")]:
        # Hashes stand in run.json, by which others see that the results are unchanged.
        raise InputError(
            path, "is of the run itself", "name another file with --to", ExitCode.OUTPUT
        )
    if path.exists() and not given.overwrite:
        raise InputError(path, "exists", "pass --overwrite to replace it", ExitCode.OUTPUT)
    write_file(path, page)
    for name in results.missing:
        say(f"notice: {name} is not there any more, or has changed: its part is left out")
    say(str(path))
    return ExitCode.DONE


def read_results(folder: Path, limits: Limits = LIMITS) -> Results:
    """Return the results in a finished run's folder.

    Args:
        folder: The run's ``--out``.
        limits: How large its pictures and maps may be; those in its ``run.json`` are ignored.

    Raises:
        InputError: The folder holds no finished run, or a picture is larger.
    """
    record = run_record(folder, LIMITS)
    listed = {str(name): str(digest) for name, digest in record["files"].items()}
    missing, sizes = [], {}
    for name, digest in listed.items():
        try:
            check_files(folder, {name: digest})
            sizes[name] = (folder / name).stat().st_size
        except InputError:
            missing.append(name)
    there = {name: folder / name for name in sizes}

    def texels(name: str) -> FloatArray | None:
        if name not in there:
            return None
        return read_envmap(there[name], strict=True, max_width=limits.envmap_width)

    def content(name: str) -> dict[str, Any] | None:
        return read_json_object(there[name], LIMITS) if name in there else None

    balls = there.get("balls.png")
    return Results(
        record,
        listed,
        sizes,
        layers=read_layers(there["layers.exr"], limits.pixels) if "layers.exr" in there else None,
        light=texels("envmap.exr"),
        light_shadow=texels("envmap_shadow.exr"),
        light_detail=texels("envmap_detail.exr"),
        balls=None if balls is None else decode_image(balls, limits.pixels).pixels,
        curves=read_curves(there["curves.json"]) if "curves.json" in there else None,
        camera=content("camera.json"),
        optimization=content("optimization.json"),
        missing=tuple(name for name in missing if name != REPORT),
    )
