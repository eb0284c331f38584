"""Put an object into a photograph: the program, from the command line to the files written.

    python -m warpir.insert --photo street.jpg --asset car.glb --light street.hdr --out out

or from Python, where the module itself can be called:

    from warpir import insert
    from warpir.app.config import InsertConfig

    insertion = insert(InsertConfig(photo="street.jpg", asset="car.glb", out="out"))

The order of the checks: arguments, all inputs and the models' files, the output folder and its
lock, disk space. torch and Warp are imported when all of it is known to be good, so ``--help``,
wrong arguments and ``--validate`` answer without them.
"""

import logging
import os
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from warpir.app.command import parse
from warpir.app.config import EMBEDDED_STEPS, InsertConfig, usage
from warpir.app.program import require_packages, run_program, say, stay_offline
from warpir.core.errors import ExitCode, InputError
from warpir.core.limits import LIMITS
from warpir.core.memory import Memory, Need, needs_of_photo, needs_of_scene, release, share_device
from warpir.core.signals import Stopped

if TYPE_CHECKING:
    from warpir.app.inputs import Inputs, Loaders
    from warpir.app.record import Timings
    from warpir.io.layers import Layers
    from warpir.io.results import OutputFolder
    from warpir.lighting.scene_light import SceneLight
    from warpir.render.composite import Picture
    from warpir.report.page import Results
    from warpir.scene.camera import Camera

__all__ = ["InsertConfig", "Insertion", "insert", "main"]

NOT_ASKED = (
    f"the embedded prior was not asked (--steps {EMBEDDED_STEPS}: experimental, it failed its "
    "release gate)"
)
_LOG = logging.getLogger(__name__)
_ONE_AT_A_TIME = threading.Lock()
PREVIEW_SAMPLES = 16
"""Camera samples per pixel of the preview of a run that nothing guides."""


@dataclass(frozen=True)
class Insertion:
    """A finished insertion."""

    out: Path
    """Folder that holds the files."""
    files: tuple[str, ...]
    """Names of the files in `out`, ``run.json`` last; of a sequence the composites and
    ``sequence.json``."""
    record: dict[str, Any]
    """Content of the last file; ``run.json`` holds inputs, settings, what was assumed, device and
    seconds."""

    def layers(self) -> "Layers":
        """Read ``layers.exr`` back as arrays; a sequence has one in each frame's folder.

        Raises:
            InputError: It is not there, or damaged.
        """
        from warpir.io.layers import read_layers

        told = self.record.get("config", {})  # that of a sequence has none
        return read_layers(self.out / "layers.exr", told.get("max_pixels", LIMITS.pixels))


def insert(config: InsertConfig, *, renews: bool = False) -> Insertion:
    """Insert one object into one photograph, or into a sequence of them, and write the files.

    Calls from several threads wait for each other: Warp's tape, torch's threads and the handling of
    signals belong to the process.

    Args:
        config: What to do. Assumptions and notices are printed on standard output.
        renews: Whether frames of a sequence that were made of other settings or other files are
            replaced, one after another, without ``overwrite``.

    Raises:
        InputError: An input or the output folder cannot be used; nothing was written then.
    """
    config.require_inputs()
    with _ONE_AT_A_TIME:
        if config.task.sequence is not None:
            return _insert_sequence(config, renews)
        try:
            return _insert_one(config)
        except BaseException as error:
            _say_what_is_kept(config, error)
            raise


def _say_what_is_kept(config: InsertConfig, error: BaseException) -> None:
    """Tell of the checkpoints that a run left when it was stopped or broke down on its way."""
    if isinstance(error, InputError) and error.code not in (ExitCode.RESOURCES, ExitCode.NUMERIC):
        return  # refused before it began
    assert config.output.out is not None
    folder = Path(config.output.out) / "checkpoints"
    kept = sorted(folder.glob("[0-9]*")) if os.path.isdir(folder) else []
    how = f"kept: {kept[-1]}; the same command with --resume goes on from there" if kept else ""
    if isinstance(error, Stopped):  # its line is the last one, and may know better
        error.kept = error.kept or how or "there was no checkpoint to keep yet"
    elif how:
        say(how)


def _insert_sequence(config: InsertConfig, renews: bool) -> Insertion:
    from warpir.app.inputs import Loaders
    from warpir.sequence.frames import SUMMARY, read_sequence, write_summary
    from warpir.sequence.page import PAGE, refuse_other_page, write_sequence_report

    assert config.output.out is not None
    loaders = Loaders()
    frames = read_sequence(config, loaders, renews=renews)
    refuse_other_page(config)
    done = 0
    try:
        for frame in frames:
            if frame.is_done:
                say(f"frame {frame.folder.name}: done already")
            else:
                say(f"frame {frame.folder.name}: line {frame.line} of {config.task.sequence}")
                if frame.config.output.overwrite and not config.output.overwrite:
                    say("notice: its settings or inputs have changed: it is rendered again")
                _insert_one(frame.config, loaders)
            done += 1
    except Stopped as error:
        done += bool(error.kept)  # the signal came while this frame's results were put in place
        how = "renders them again" if config.output.overwrite else "goes on with the rest"
        error.kept = f"kept: {done} of {len(frames)} frames; the same command {how}"
        raise
    if config.output.report:  # before the summary, by which others see that nothing is left to do
        _made_or_told(PAGE, lambda: write_sequence_report(config, frames))
    record = write_summary(config, frames, say)
    composites = (f"{frame.folder.name}/composite.png" for frame in frames)
    return Insertion(Path(config.output.out), (*composites, *record["video"], SUMMARY), record)


def _insert_one(config: InsertConfig, loaders: "Loaders | None" = None) -> Insertion:
    from warpir.app.disk_space import needed_bytes, require_space
    from warpir.app.record import Timings, run_record
    from warpir.core.progress import progress_bar
    from warpir.core.strict_json import read_json_object
    from warpir.optimize.checkpoint import FOLDER

    timings = Timings()
    with timings.stage("read"):
        # The demo fills in its files; what was asked for is what run.json repeats, but not how the
        # folder was found: a resumed run leaves what an uninterrupted one does.
        asked = config.changed(resume=False, overwrite=False)
        config, inputs, light = _read(config, loaders)

    assert config.output.out is not None
    memory, (of_photo, of_scene) = Memory(say=say), needs_of(inputs)
    with _output_folder(config) as output:
        require_space(config.output.out, needed_bytes(config, inputs))
        memory.require(of_photo, *of_scene, on_host=True)
        # Warp is loaded here, after everything that can be wrong was looked at.
        with timings.stage("load"):
            from warpir.render.composite import Quality, make_picture, scene_of
            from warpir.render.device import choose_device
            from warpir.render.renderer import Renderer

            device = choose_device(config.render.device)
            memory.device = device
            share_device(device)
            if device != "cpu":
                memory.require(*of_scene)
            say(f"device: {device} (the first run compiles the kernels)")
        recovered: dict[str, Any] = {}
        notices = (*inputs.notices, *_cache_notices())
        if config.is_guided:
            inputs, light, recovered, found = _guide(
                config, inputs, light, device, output, timings, memory
            )
            with timings.stage("scene"):  # the garbage of guidance makes room for it
                release()
            notices = (*notices, *found)
            light, shown = _detailed(config, inputs, light, timings)
            recovered |= shown
        else:
            if light is None:
                light, recovered = _regress(config, inputs, device, timings)
            if config.guided_by == "embedded":
                recovered["prior_about"] = NOT_ASKED
            if inputs.shadow_mask is not None and not _has_lamps(light):
                notices = (*notices, "the light has no lamp that --shadow-mask could take")
                say(f"notice: {notices[-1]}")
            light, shown = _detailed(config, inputs, light, timings)
            recovered |= shown
            with timings.stage("preview"):
                _write_preview(output, config, inputs, light, device)
        with timings.stage("scene"):
            is_reinhard = light.curves.tone == "reinhard"
            camera = _rendering_camera(inputs.camera, config)
            scene = memory.again(
                lambda: scene_of(inputs, camera, device, light.curves), "the scene", "--asset"
            )
        with timings.stage("render"), progress_bar() as report:
            renderer = Renderer(scene, config.render.threads or 0, report, memory)
            picture = make_picture(
                renderer,
                light.on_object,
                light.light_shadow,
                inputs.photo,
                Quality(
                    config.render.samples,
                    config.render.rays,
                    config.render.depth,
                    config.render.seed,
                    config.render.indirect_limit,
                ),
                light.curves.foreground,
                light.curves.shadow_ratio,
                is_reinhard=is_reinhard,
                occluder=inputs.occluder,
                shadow_mask=inputs.shadow_mask,
            )
        notices = (*notices, *memory.notices(), *renderer.bad_pixels.notices())
        for notice in renderer.bad_pixels.notices():
            say(f"notice: {notice}")
        with timings.stage("write"):
            measured, results = _write(output, config, inputs, light, picture)
        # With the results in place, what was kept for a run that stops is not needed any more.
        output.supersede(output.path / FOLDER)
        notices = (*notices, *_cache_notices())
        record = run_record(
            asked,
            inputs=inputs.hashes,
            device=str(scene.device),
            timings=timings,
            assumed=(*inputs.assumed, *light.assumed),
            notices=notices,
            measured={
                "triangles": scene.triangle_count,
                **inputs.measured,
                **measured,
                **recovered,
                "bad_pixels": renderer.bad_pixels.count,
                "memory_retries": memory.retries,
            },
        )
        if config.output.report:
            from warpir.report.page import REPORT, write_report

            results = replace(results, record=record)
            with timings.stage("report"):
                told = _made_or_told(REPORT, lambda: write_report(output, results))
            record["notices"] += told
            record["seconds"] = timings.rounded()
        output.write_json("run.json", record)
    _say_who_spoke(record)
    record = read_json_object(output.path / "run.json")
    return Insertion(output.path, (*record["files"], "run.json"), record)


def _made_or_told(page: str, make: Callable[[], None]) -> list[str]:
    """Make a page about results; where that fails return, having said so, a notice of it.

    Raises:
        InputError: There is no room for it (exit 5).
    """
    try:
        make()
    # Whatever it is: all results are there, and a page about them must not cost them.
    except Exception as error:
        if isinstance(error, InputError) and error.code == ExitCode.RESOURCES:
            raise
        _LOG.debug(page, exc_info=True)
        why = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        line = f"{page} could not be made ({why})"
        say(f"notice: {line}")
        return [line]
    return []


def _output_folder(config: InsertConfig) -> "OutputFolder":
    """Return the folder that is to be written, not yet entered.

    Raises:
        InputError: The run that is to be resumed is finished.
    """
    from warpir.io.results import OutputFolder
    from warpir.optimize.checkpoint import Checkpoints

    assert config.output.out is not None
    newest = Checkpoints(Path(config.output.out), {}).newest
    if (
        config.output.resume
        and newest is None
        and os.path.exists(Path(config.output.out, "run.json"))
    ):
        raise InputError(
            "--resume",
            f"the run in {config.output.out} is finished",
            "to run it again, give --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    if newest is not None and not (config.output.resume or config.output.overwrite):
        raise InputError(
            config.output.out,
            f"holds an unfinished run ({newest})",
            "--resume goes on with it, --overwrite starts it again",
            ExitCode.OUTPUT,
        )
    if config.output.resume and newest is not None and not config.is_guided:
        raise InputError(
            "--resume",
            f"the unfinished run in {config.output.out} was guided, this one is not",
            "give its flags, or --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    # A run to resume was allowed to replace what is there, or has made it: no other run gets in.
    overwrite = config.output.overwrite or (config.output.resume and newest is not None)
    return OutputFolder(config.output.out, overwrite=overwrite)


def _cache_notices() -> tuple[str, ...]:
    """Return what a cache has to say since the last call, having said it."""
    from warpir.core.cache import take_notices

    notices = take_notices()
    for line in notices:
        say(f"notice: {line}")
    return notices


def needs_of(inputs: "Inputs") -> tuple[Need, tuple[Need, ...]]:
    """Return what photo and layers need of the host, and the scene of the renderer's device."""
    height, width = inputs.photo.codes.shape[:2]
    asset = inputs.asset
    scene = needs_of_scene(
        sum(len(part.positions) for part in asset.primitives),
        sum(len(part.indices) for part in asset.primitives),
        sum(texture.pixels[..., 0].size for texture in asset.textures),
    )
    return needs_of_photo(height * width), scene


def _regress(
    config: InsertConfig, inputs: "Inputs", device: str, timings: "Timings"
) -> "tuple[SceneLight, dict[str, Any]]":
    """Read the light off the photo; return it, and what run.json says of it."""
    from warpir.render.determinism import fixed_arithmetic

    with timings.stage("regress"), fixed_arithmetic(device, config.render.deterministic):
        from warpir.lighting.estimate import estimate_light

        estimate = estimate_light(inputs, config, device)
    for line in estimate.light.assumed:
        say(f"assumed: {line}")
    return estimate.light, {"regression": estimate.regression.record()}


def _detailed(
    config: InsertConfig, inputs: "Inputs", light: "SceneLight", timings: "Timings"
) -> "tuple[SceneLight, dict[str, Any]]":
    """Put into the light what the photo shows of it, unless a panorama has its own detail."""
    has_own = config.light.file is not None and light.light.lobes is None
    if inputs.run is not None:  # lit by what an earlier run was lit by, with or without
        has_own = not Path(inputs.run.path, "envmap_detail.exr").exists()
    if not config.light.detail or has_own:
        return light, {}
    with timings.stage("detail"):
        from warpir.lighting.detail import detail_of, with_detail

        detail = detail_of(inputs, light.curves)
        light = replace(light, detailed=with_detail(light.light, detail))
    say(
        f"detail: the photo shows {100.0 * detail.seen:.0f} % of what is round the object, which "
        "may be reflected in it (--no-detail)"
    )
    return light, {"detail_seen": detail.seen}


def _has_lamps(light: "SceneLight") -> bool:
    from warpir.scene.lamps import lamp_axes

    return any(len(lamp_axes(x)) > 0 for x in (light.light, light.light_shadow))


def _say_who_spoke(record: dict[str, Any]) -> None:
    """Print in a line what the light comes from and what computed it."""
    measured = record["measured"]
    digest = measured.get("prior_sha256")
    prior = measured["prior"] + (f" (sha256 {digest[:16]}...)" if digest else "")
    accepted = measured.get("acceptance", {}).get("is_accepted")
    words = {True: ", its end accepted", False: ", its start kept", None: ""}[accepted]
    parts = [f"prior {prior}{words}"]
    if "regression" in measured:
        spread = measured["regression"]["spread_deg"]
        parts.append(f"light regressed from the photo, +- {spread:.0f} degrees")
    if measured.get("prior_about") == NOT_ASKED:
        parts.append(NOT_ASKED)
    integrators = " and ".join(
        dict.fromkeys(x for x in (measured.get("loop_integrator"), measured["integrator"]) if x)
    )
    say(f"summary: {'; '.join(parts)}; {integrators} on {record['device']}")


def _write_preview(
    output: "OutputFolder",
    config: InsertConfig,
    inputs: "Inputs",
    light: "SceneLight",
    device: str,
) -> None:
    """Write the composite as it will be, small and grainy, where previews are asked for."""
    from warpir.render.composite import Quality, make_picture, scene_of
    from warpir.render.renderer import Renderer

    settings = config.settled(on_cuda=device != "cpu")
    if not settings.optimize.preview_every:
        return
    width = min(settings.optimize.picture_width, _rendering_camera(inputs.camera, config).width)
    camera = _rendering_camera(inputs.camera, config.changed(width=width))
    is_reinhard = light.curves.tone == "reinhard"
    picture = make_picture(
        Renderer(scene_of(inputs, camera, device, light.curves), config.render.threads or 0),
        light.on_object,
        light.light_shadow,
        inputs.photo,
        Quality(
            PREVIEW_SAMPLES,
            1,
            config.render.depth,
            config.render.seed,
            config.render.indirect_limit,
        ),
        light.curves.foreground,
        light.curves.shadow_ratio,
        is_reinhard=is_reinhard,
        occluder=inputs.occluder,
        shadow_mask=inputs.shadow_mask,
    )
    codes = inputs.photo.encode(picture.image, picture.changed)
    say(f"preview: {output.write_preview(0, codes, inputs.photo.icc)}")


def _guide(
    config: InsertConfig,
    inputs: "Inputs",
    light: "SceneLight | None",
    device: str,
    output: "OutputFolder",
    timings: "Timings",
    memory: Memory,
) -> "tuple[Inputs, SceneLight, dict[str, Any], tuple[str, ...]]":
    """Let the prior find the light, or change the object under the light it has.

    Returns:
        Inputs and light as they are to be rendered, what run.json says of it, and notices.
    """
    from warpir.core.progress import StepProgress
    from warpir.render.determinism import fixed_arithmetic

    with StepProgress(say) as progress, fixed_arithmetic(device, config.render.deterministic):
        from warpir.optimize.recover import Run, recover

        run = Run(config, inputs, device, output, timings, say, progress, memory=memory)
        if config.task.refine is None:
            light, record, notices = recover(run, light)
        else:
            from warpir.optimize.materials import refine

            assert light is not None  # the configuration names it
            light, asset, record, notices = refine(run, light)
            inputs = replace(inputs, asset=asset)
    for notice in notices:
        say(f"notice: {notice}")
    return inputs, light, record, notices


def _rendering_camera(camera: "Camera", config: InsertConfig) -> "Camera":
    """Return the photo's camera, or the same view at --width."""
    if config.render.width is None:
        return camera
    return camera.scaled(
        config.render.width, max(1, round(config.render.width * camera.height / camera.width))
    )


def _write(
    output: "OutputFolder",
    config: InsertConfig,
    inputs: "Inputs",
    light: "SceneLight",
    picture: "Picture",
) -> "tuple[dict[str, Any], Results]":
    """Stage all files but ``run.json`` and the report.

    Returns:
        The numbers that belong into the one, and what the other shows.
    """
    from warpir.app.record import config_of_picture
    from warpir.io.curves_file import curves_to_json
    from warpir.io.layers import write_layers
    from warpir.io.lobes_file import lobes_to_json
    from warpir.render.composite import as_file_map, balls
    from warpir.report.page import Results
    from warpir.scene.light import summarize

    photo, camera = inputs.photo, inputs.camera
    codes = photo.encode(picture.image, picture.changed)
    # Many shadows are too faint for a code; a linear plate has no codes of the same kind.
    changed = picture.changed if photo.is_linear else (codes != photo.codes).any(axis=-1)
    output.write_png("composite.png", codes, icc=photo.icc, mark=config.output.mark)
    clamped = write_layers(
        output,
        picture.layers,
        camera,
        is_deep=photo.is_deep,
        config=config_of_picture(config),
        inputs=inputs.hashes,
    )
    texels, texels_shadow = as_file_map(light.light), None
    output.write_envmap(texels)
    if light.light_shadow is not light.light:
        texels_shadow = as_file_map(light.light_shadow)
        output.write_envmap(texels_shadow, "envmap_shadow")
    on_object, its_map = texels, "envmap.exr"
    if light.detailed is not None:
        on_object = as_file_map(light.on_object)
        output.write_envmap(on_object, "envmap_detail")
        its_map = "envmap_detail.exr"
    if light.light.lobes is not None:
        output.write_json("lobes.json", lobes_to_json(light.light.lobes))
    output.write_json("curves.json", curves_to_json(light.curves))
    output.write_json("camera.json", camera.record())
    pair = balls(light.on_object, camera, light.curves.tone == "reinhard")
    output.write_png(
        "balls.png",
        pair,
        mark=False,
        description="Mirror ball and grey diffuse ball under the light",
    )
    handed: dict[str, Any] = {}
    if config.output.hand_off:
        from warpir.io.export import write_hand_off

        handed, notices = write_hand_off(
            output,
            inputs.photo,
            inputs.asset,
            inputs.camera,
            inputs.placement,
            light.curves,
            on_object,
            its_map,
        )
        for line in notices:
            say(f"notice: {line}")
    if config.output.mitsuba:
        from warpir.mitsuba.scene import write_mitsuba

        write_mitsuba(output, inputs, on_object, config.render.depth)
    summary = summarize(light.light)
    say(
        f"light: brightest toward azimuth {summary.azimuth_deg:.0f}, elevation "
        f"{summary.elevation_deg:.0f} degrees; {100.0 * summary.peak_share:.0f} % of its flux "
        "comes from there"
    )
    if not (picture.layers.matte > 0.0).any():
        say("notice: the object is not seen in the photo")
    fit = light.fit
    mask = inputs.shadow_mask
    measured = {
        "prior": "none",
        "integrator": "mis",
        "placement": {
            "summary": inputs.placement.summary,
            "ground": inputs.placement.ground.tolist(),
        },
        "exposure_ev": light.exposure,
        "light": asdict(summary),
        "lobe_fit": fit
        and {
            "irradiance_error": fit.irradiance_error,
            "flux_error": fit.flux_error,
            "lamps": fit.lamp_count,
        },
        **({} if mask is None else {"shadow_mask_at_object": mask.at_object}),
        **({} if inputs.proxy is None else {"proxy_triangles": len(inputs.proxy.indices)}),
        "object_pixels": picture.object_pixel_count,
        "shadow_pixels": picture.receiver_pixel_count,
        "changed_pixels": int(changed.sum()),
        "values_clamped_to_half": clamped,
        **handed,
    }
    results = Results(
        layers=picture.layers,
        light=texels,
        light_shadow=texels_shadow,
        light_detail=None if light.detailed is None else on_object,
        balls=pair,
        curves=light.curves,
        camera=camera.record(),
    )
    return measured, results


def _read(
    config: InsertConfig, loaders: "Loaders | None" = None
) -> "tuple[InsertConfig, Inputs, SceneLight | None]":
    """Read and check all inputs and say what was assumed; the demo brings its own.

    The light is None where it is to be read off the photo.
    """
    from warpir.app.inputs import read_inputs
    from warpir.lighting.scene_light import make_light

    if config.inputs.demo:
        from warpir.demo import demo_config

        config = demo_config(config)
    inputs = read_inputs(config, loaders)
    light = make_light(inputs, config)
    say(f"placement: {inputs.placement.summary}")
    for line in (*inputs.assumed, *(light.assumed if light is not None else ())):
        say(f"assumed: {line}")
    for line in inputs.notices:
        say(f"notice: {line}")
    return config, inputs, light


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments without the program's name; ``sys.argv`` when absent.

    Returns:
        The exit status, an `ExitCode` or 128 plus the number of a signal.
    """
    return run_program(_run, argv)


def _run(arguments: list[str]) -> int:
    command = parse(arguments)
    for notice in command.notices:
        say(f"notice: {notice}")
    guides = ("diffusers", "transformers", "peft") if command.config.is_guided else ()
    require_packages("warp", "torch", *guides)
    if guides and sys.flags.optimize > 1:
        advice = "run without -OO and PYTHONOPTIMIZE=2"
        raise usage("python -OO", "the libraries of the model need their docstrings", advice)
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
    """Check everything that can be checked without torch and Warp; nothing is written."""
    from warpir.app.disk_space import needed_bytes, require_space
    from warpir.io.results import OutputFolder

    if config.task.sequence is None:
        config, inputs, _ = _read(config)
        assert config.output.out is not None
        _output_folder(config).check()
        require_space(config.output.out, needed_bytes(config, inputs))
        return
    from warpir.app.inputs import Loaders
    from warpir.sequence.frames import read_sequence
    from warpir.sequence.page import refuse_other_page

    frames = read_sequence(config, Loaders())
    refuse_other_page(config)
    assert config.output.out is not None
    OutputFolder(config.output.out, overwrite=True).check()  # the frames' folders were looked at
    say(f"frames: {len(frames)}, of which {sum(f.is_done for f in frames)} are done already")


class _CallableModule(ModuleType):
    """Lets ``from warpir import insert; insert(config)`` work: the module calls its function."""

    def __call__(self, config: InsertConfig) -> Insertion:
        """Insert one object; see `insert`."""
        return insert(config)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    sys.exit(main())
