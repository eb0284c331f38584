"""Insert an object into a photograph, from the command line to the files on disk.

    python -m warpir.insert --photo street.jpg --asset car.glb --light street.hdr --out out

or from Python, where the module itself can be called:

    from warpir import insert
    from warpir.app.config import InsertConfig

    insertion = insert(InsertConfig(photo="street.jpg", asset="car.glb", out="out"))

Checked in this order: arguments, all inputs and the models' files, the output folder and its lock,
disk space. Warp is imported after these checks, so ``--help``, wrong arguments and ``--validate``
without a card answer without it; torch only where a diffusion model guides.
"""

import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from warpir.app.command import parse
from warpir.app.config import InsertConfig, usage
from warpir.app.program import attempt, extras_of, require_packages, run_program, say, stay_offline
from warpir.core.errors import ExitCode
from warpir.core.limits import LIMITS
from warpir.core.memory import Memory, no_collection, sparing, trim

if TYPE_CHECKING:
    from warpir.app.inputs import Loaders
    from warpir.app.run import Run
    from warpir.io.layers import Layers
    from warpir.lighting.scene_light import SceneLight
    from warpir.optimize.find_light import LitRun
    from warpir.report.result import RenderedResult
    from warpir.sequence.look import FirstLook

__all__ = ["InsertConfig", "Insertion", "insert", "main"]

_ONE_AT_A_TIME = threading.Lock()


@dataclass(frozen=True)
class Insertion:
    """A finished insertion."""

    out: Path
    """Folder of the files."""
    files: tuple[str, ...]
    """Names in `out`, ``run.json`` last; of a sequence, the composites and ``sequence.json``."""
    record: dict[str, Any]
    """Content of the last file; ``run.json`` holds inputs, settings, assumptions, device and
    seconds."""

    def layers(self) -> "Layers":
        """Read ``layers.exr`` as arrays; each frame of a sequence has one in its own folder.

        Raises:
            InputError: The file is absent or damaged.
        """
        from warpir.io.layers import read_layers

        settings = self.record.get("config", {})  # that of a sequence has none
        return read_layers(self.out / "layers.exr", settings.get("max_pixels", LIMITS.pixels))


def insert(config: InsertConfig, *, renews: bool = False) -> Insertion:
    """Insert one object into one photograph, or into a sequence of them, and write the files.

    Calls from several threads are serialised: Warp's tape, torch's threads and signal handlers
    belong to the process.

    Args:
        config: The insertion. Assumptions and notices are printed on standard output.
        renews: Whether frames of a sequence that have other settings or inputs are replaced, one
            after another, without ``overwrite``.

    Raises:
        InputError: An input or the output folder cannot be used; no result was written.
    """
    if not isinstance(config, InsertConfig):
        raise TypeError(f"insert takes an InsertConfig (found {type(config).__name__})")
    config.require_inputs()
    with _ONE_AT_A_TIME:
        if config.task.sequence is not None:
            from warpir.sequence.run import insert_frames

            return Insertion(*insert_frames(config, _insert_one, renews))
        try:
            return _insert_one(config)
        except BaseException as error:
            from warpir.optimize.checkpoint import report_kept

            report_kept(config.output, error)
            raise


def _insert_one(
    config: InsertConfig, loaders: "Loaders | None" = None, first: "FirstLook | None" = None
) -> Insertion:
    """Insert into one photograph: read, find the light, render, write."""
    from warpir.app.inputs import Loaders
    from warpir.calibration.photos import estimate_photo
    from warpir.core.strict_json import read_json_object
    from warpir.report.facts import summary_line

    run, given = _read(config, loaders or Loaders(estimate_photo))
    with run.output as output:
        run.require_room()
        with no_collection(), run.timings.stage("load"):  # loads Warp
            from warpir.render.device import choose_device

            # Warp and the driver start in C, which leaves the interpreter to other imports.
            with ThreadPoolExecutor(1) as pool:
                device = pool.submit(choose_device, run.config.render.device)

                from warpir.optimize.find_light import find_light, with_photo_detail
                from warpir.report.result import look_of, place_result, render_result, write_preview

            run = run.on_device(device.result()).with_ground_coat()
        run.take_cache_notices()
        lit = find_light(run, given)
        with sparing():
            with no_collection(), ThreadPoolExecutor(2) as pool:
                # On a card the picture itself comes as soon. The preview has all cores.
                if given is None and not run.config.is_guided and run.device == "cpu":
                    write_preview(lit.run, lit.light)
                detailed = pool.submit(with_photo_detail, lit)
                look = pool.submit(first or look_of, lit.run, lit.light)
                with run.timings.stage("scene"):
                    placed = place_result(lit.run, lit.light)
                    lit, seen = detailed.result(), look.result()
            rendered = render_result(lit.run, lit.light, seen, placed)
            record = _write(lit, rendered, config)
    say(summary_line(record))
    record = read_json_object(output.path / "run.json")
    return Insertion(output.path, (*record["files"], "run.json"), record)


def _read(config: InsertConfig, loaders: "Loaders | None") -> "tuple[Run, SceneLight | None]":
    """Read and check what is given, and print what is assumed; None: the light is not given."""
    from warpir.app.inputs import read_inputs
    from warpir.app.record import Timings
    from warpir.app.run import Run
    from warpir.core.progress import Log, StepProgress
    from warpir.lighting.scene_light import make_light
    from warpir.optimize.checkpoint import output_folder

    log, timings = Log(say), Timings()
    require_packages(*extras_of(config))
    with no_collection(), timings.stage("read"):
        if config.inputs.demo:
            from warpir.demo import demo_config

            config = demo_config(config)
        inputs = read_inputs(config, loaders)
        light = make_light(inputs, config.light, config.tone_operator)
        say(f"placement: {inputs.placement.summary}")
        log.assume(*inputs.assumed, *(light.assumed if light is not None else ()))
        log.notice(*inputs.notices)
    output = output_folder(config.output, config.is_guided)
    return Run(config, inputs, output, log, timings, Memory(say=say), StepProgress(say)), light


def _write(lit: "LitRun", rendered: "RenderedResult", asked: InsertConfig) -> dict[str, Any]:
    """Stage all files, ``run.json`` last; return its content."""
    from warpir.core.atomic import FOLDER
    from warpir.mitsuba.scene import write_mitsuba
    from warpir.report.page import REPORT, write_report
    from warpir.report.result import write_results

    run = lit.run
    trim()
    with run.timings.stage("write"):
        written = write_results(run, lit.light, rendered.picture)
        if run.config.output.mitsuba:
            depths = run.config.render.depth, run.config.render.bounce_depth
            write_mitsuba(run.output, run.inputs, written.maps.on_object, *depths)
    run.output.supersede(run.output.path / FOLDER)  # a finished run needs no checkpoints
    run.take_cache_notices()
    measured = run.inputs.measured | written.measured | lit.measured | rendered.measured
    record = run.record(asked.flat(), rendered.device, measured)
    if run.config.output.report:
        results = replace(written.results, record=record)
        with run.timings.stage("report"):
            record["notices"] += attempt(REPORT, lambda: write_report(run.output, results))
        record["seconds"] = run.timings.rounded()
    run.output.write_json("run.json", record)
    return record


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, as `run_program`."""
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    command = parse(arguments)
    for notice in command.notices:
        say(f"notice: {notice}")
    require_packages("warp", "torch", *extras_of(command.config))
    if command.config.is_guided and sys.flags.optimize > 1:
        advice = "run without -OO and PYTHONOPTIMIZE=2"
        raise usage("python -OO", "the model's libraries need their docstrings", advice)
    if command.validate:
        _validate(command.config)
        say("inputs are valid")
        return ExitCode.DONE
    if not command.config.diffusion.allow_download:
        stay_offline()
    insertion = insert(command.config)
    for name in insertion.files:
        say(str(insertion.out / name))
    return ExitCode.DONE


def _validate(config: InsertConfig) -> None:
    """Check everything that can be checked without rendering; write nothing."""
    if config.task.sequence is not None:
        from warpir.sequence.run import check_frames

        check_frames(config)
    else:
        run, _ = _read(config, None)
        run.output.check()
        run.require_room()
    if config.render.device not in (None, "cpu"):  # only Warp knows whether there is one
        from warpir.render.device import choose_device

        choose_device(config.render.device)


class _CallableModule(ModuleType):
    """Lets ``from warpir import insert; insert(config)`` work, and ``pool.map(insert, ...)``."""

    __call__ = staticmethod(insert)

    def __reduce__(self) -> tuple[Any, ...]:
        return import_module, (self.__name__,)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    sys.exit(main())
