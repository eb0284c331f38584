"""Put an object into a photograph: the program, from the command line to the files written.

    python -m warpir.insert --photo street.jpg --asset car.glb --light street.hdr --out out

or from Python, where the module itself can be called:

    from warpir import insert
    from warpir.config import InsertConfig

    insertion = insert(InsertConfig(photo="street.jpg", asset="car.glb", out="out"))

torch and Warp are imported when all inputs are known to be good, so ``--help``, wrong arguments
and ``--validate`` answer without them.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

from warpir.command import parse
from warpir.config import EMBEDDED_STEPS, InsertConfig
from warpir.errors import ExitCode, InputError
from warpir.program import run_program, say

if TYPE_CHECKING:
    from warpir.camera import Camera
    from warpir.files import OutputFolder
    from warpir.inputs import Inputs, Loaders
    from warpir.lighting import SceneLight
    from warpir.picture import Picture
    from warpir.record import Timings

__all__ = ["InsertConfig", "Insertion", "insert", "main"]

NOT_ASKED = (
    f"the embedded prior was not asked (--steps {EMBEDDED_STEPS}: experimental, it failed its "
    "release gate)"
)
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


def insert(config: InsertConfig) -> Insertion:
    """Insert one object into one photograph, or into a sequence of them, and write the files.

    Args:
        config: What to do. Assumptions and notices are printed on standard output.

    Raises:
        InputError: An input or the output folder cannot be used; nothing was written then.
    """
    config.require_inputs()
    if config.sequence is not None:
        return _insert_sequence(config)
    try:
        return _insert_one(config)
    except BaseException as error:
        _say_what_is_kept(config, error)
        raise


def _say_what_is_kept(config: InsertConfig, error: BaseException) -> None:
    """Tell of the checkpoints that a run left when it was stopped or broke down on its way."""
    if isinstance(error, InputError) and error.code not in (ExitCode.RESOURCES, ExitCode.NUMERIC):
        return  # refused before it began
    assert config.out is not None
    kept = sorted((Path(config.out) / "checkpoints").glob("[0-9]*"))
    if kept:
        say(f"kept: {kept[-1]}; the same command with --resume goes on from there")


def _insert_sequence(config: InsertConfig) -> Insertion:
    from warpir.inputs import Loaders
    from warpir.sequence import SUMMARY, read_sequence, write_summary

    loaders = Loaders()
    frames = read_sequence(config, loaders)
    for frame in frames:
        if frame.is_done:
            say(f"frame {frame.folder.name}: done already")
        else:
            say(f"frame {frame.folder.name}: line {frame.line} of {config.sequence}")
            _insert_one(frame.config, loaders)
    assert config.out is not None
    record = write_summary(config, frames)
    composites = (f"{frame.folder.name}/composite.png" for frame in frames)
    return Insertion(Path(config.out), (*composites, SUMMARY), record)


def _insert_one(config: InsertConfig, loaders: "Loaders | None" = None) -> Insertion:
    from warpir.progress import progress_bar
    from warpir.record import Timings, input_hashes, run_record
    from warpir.strict_json import read_json_object

    timings = Timings()
    with timings.stage("read"):
        # The demo fills in its files; what was asked for is what run.json repeats.
        asked = config
        config, inputs, light = _read(config, loaders)

    from warpir.checkpoint import Checkpoints
    from warpir.files import OutputFolder

    assert config.out is not None
    checkpoints = Checkpoints(Path(config.out), {})
    if config.resume and checkpoints.newest is None and Path(config.out, "run.json").exists():
        raise InputError(
            "--resume",
            f"the run in {config.out} is finished",
            "to run it again, give --overwrite in place of --resume",
            ExitCode.OUTPUT,
        )
    # A run to resume was allowed to replace what is there, or has made it.
    overwrite = config.overwrite or (config.resume and checkpoints.newest is not None)
    with OutputFolder(config.out, overwrite=overwrite) as output:
        # Warp is loaded here, after everything that can be wrong was looked at.
        with timings.stage("load"):
            from warpir.picture import Quality, make_picture, scene_of
            from warpir.render import Renderer, choose_device

            device = choose_device(config.device)
            say(f"device: {device} (the first run compiles the kernels)")
        recovered: dict[str, Any] = {}
        notices = inputs.notices
        if config.is_guided:
            inputs, light, recovered, found = _guide(config, inputs, light, device, output, timings)
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
            scene = scene_of(inputs, camera, device, light.curves)
        with timings.stage("render"), progress_bar() as report:
            picture = make_picture(
                Renderer(scene, config.threads or 0, report),
                light.on_object,
                light.light_shadow,
                inputs.photo,
                Quality(
                    config.samples,
                    config.rays,
                    config.depth,
                    config.seed,
                    config.indirect_limit,
                ),
                light.curves.foreground,
                light.curves.shadow_ratio,
                is_reinhard=is_reinhard,
                occluder=inputs.occluder,
                shadow_mask=inputs.shadow_mask,
            )
        with timings.stage("write"):
            measured = _write(output, config, inputs, light, picture)
        record = run_record(
            asked,
            inputs=input_hashes(config),
            device=str(scene.device),
            timings=timings,
            assumed=(*inputs.assumed, *light.assumed),
            notices=notices,
            measured={
                "triangles": scene.triangle_count,
                **inputs.measured,
                **measured,
                **recovered,
            },
        )
        output.write_json("run.json", record)
    _say_who_spoke(record)
    if config.is_guided:
        # The results are in place: what was kept for a run that stops is not needed any more.
        checkpoints.remove()
    record = read_json_object(output.path / "run.json")
    return Insertion(output.path, (*record["files"], "run.json"), record)


def _regress(
    config: InsertConfig, inputs: "Inputs", device: str, timings: "Timings"
) -> "tuple[SceneLight, dict[str, Any]]":
    """Read the light off the photo; return it, and what run.json says of it."""
    with timings.stage("regress"):
        from warpir.estimate import estimate_light

        estimate = estimate_light(inputs, config, device)
    for line in estimate.light.assumed:
        say(f"assumed: {line}")
    return estimate.light, {"regression": estimate.regression.record()}


def _detailed(
    config: InsertConfig, inputs: "Inputs", light: "SceneLight", timings: "Timings"
) -> "tuple[SceneLight, dict[str, Any]]":
    """Put into the light what the photo shows of it, unless a panorama has its own detail."""
    has_own = config.light is not None and light.light.lobes is None
    if inputs.run is not None:  # lit by what an earlier run was lit by, with or without
        has_own = not Path(inputs.run.path, "envmap_detail.exr").exists()
    if not config.detail or has_own:
        return light, {}
    with timings.stage("detail"):
        from warpir.detail import detail_of, with_detail

        detail = detail_of(inputs, light.curves)
        light = replace(light, detailed=with_detail(light.light, detail))
    say(
        f"detail: the photo shows {100.0 * detail.seen:.0f} % of what is round the object, which "
        "may be reflected in it (--no-detail)"
    )
    return light, {"detail_seen": detail.seen}


def _has_lamps(light: "SceneLight") -> bool:
    from warpir.lamps import lamp_axes

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
    from warpir.picture import Quality, make_picture, scene_of
    from warpir.render import Renderer

    settings = config.settled(on_cuda=device != "cpu")
    if not settings.preview_every:
        return
    width = min(settings.picture_width, _rendering_camera(inputs.camera, config).width)
    camera = _rendering_camera(inputs.camera, replace(config, width=width))
    is_reinhard = light.curves.tone == "reinhard"
    picture = make_picture(
        Renderer(scene_of(inputs, camera, device, light.curves), config.threads or 0),
        light.on_object,
        light.light_shadow,
        inputs.photo,
        Quality(PREVIEW_SAMPLES, 1, config.depth, config.seed, config.indirect_limit),
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
) -> "tuple[Inputs, SceneLight, dict[str, Any], tuple[str, ...]]":
    """Let the prior find the light, or change the object under the light it has.

    Returns:
        Inputs and light as they are to be rendered, what run.json says of it, and notices.
    """
    from warpir.progress import StepProgress
    from warpir.recover import Run, recover

    with StepProgress(say) as progress:
        run = Run(config, inputs, device, output, timings, say, progress)
        if config.refine is None:
            light, record, notices = recover(run, light)
        else:
            from warpir.refine import refine

            assert light is not None  # the configuration names it
            light, asset, record, notices = refine(run, light)
            inputs = replace(inputs, asset=asset)
    for notice in notices:
        say(f"notice: {notice}")
    return inputs, light, record, notices


def _rendering_camera(camera: "Camera", config: InsertConfig) -> "Camera":
    """Return the photo's camera, or the same view at --width."""
    if config.width is None:
        return camera
    return camera.scaled(config.width, max(1, round(config.width * camera.height / camera.width)))


def _write(
    output: "OutputFolder",
    config: InsertConfig,
    inputs: "Inputs",
    light: "SceneLight",
    picture: "Picture",
) -> dict[str, Any]:
    """Stage all files but ``run.json``; return the numbers that belong into it."""
    from warpir.curves import curves_to_json
    from warpir.files import write_layers
    from warpir.light import summarize
    from warpir.lobes_file import lobes_to_json
    from warpir.picture import as_file_map, balls
    from warpir.record import input_hashes

    photo, camera = inputs.photo, inputs.camera
    codes = photo.encode(picture.image, picture.changed)
    output.write_png("composite.png", codes, icc=photo.icc, mark=config.mark)
    clamped = write_layers(
        output,
        picture.layers,
        camera,
        is_deep=photo.is_deep,
        config=asdict(config),
        inputs=input_hashes(config),
    )
    output.write_envmap(as_file_map(light.light))
    if light.light_shadow is not light.light:
        output.write_envmap(as_file_map(light.light_shadow), "envmap_shadow")
    on_object, its_map = as_file_map(light.on_object), "envmap.exr"
    if light.detailed is not None:
        output.write_envmap(on_object, "envmap_detail")
        its_map = "envmap_detail.exr"
    if light.light.lobes is not None:
        output.write_json("lobes.json", lobes_to_json(light.light.lobes))
    output.write_json("curves.json", curves_to_json(light.curves))
    output.write_json("camera.json", camera.record())
    output.write_png(
        "balls.png",
        balls(light.on_object, camera, light.curves.tone == "reinhard"),
        mark=False,
        description="Mirror ball and white diffuse ball under the light",
    )
    handed: dict[str, Any] = {}
    if config.hand_off:
        from warpir.handoff import write_hand_off

        handed, notices = write_hand_off(output, inputs, light.curves, on_object, its_map)
        for line in notices:
            say(f"notice: {line}")
    if config.mitsuba:
        from warpir.mitsuba_scene import write_mitsuba

        write_mitsuba(output, inputs, on_object, config.depth)
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
    return {
        "prior": "none",
        "integrator": "mis",
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
        "shadow_pixels": picture.proxy_pixel_count,
        "changed_pixels": int(picture.changed.sum()),
        "values_clamped_to_half": clamped,
        **handed,
    }


def _read(
    config: InsertConfig, loaders: "Loaders | None" = None
) -> "tuple[InsertConfig, Inputs, SceneLight | None]":
    """Read and check all inputs and say what was assumed; the demo brings its own.

    The light is None where it is to be read off the photo.
    """
    from warpir.inputs import read_inputs
    from warpir.lighting import make_light

    if config.demo:
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
    if command.validate:
        _validate(command.config)
        say("inputs are valid")
        return ExitCode.DONE
    insertion = insert(command.config)
    for name in insertion.files:
        say(str(insertion.out / name))
    return ExitCode.DONE


def _validate(config: InsertConfig) -> None:
    if config.sequence is None:
        config, _, light = _read(config)
        if light is None or config.is_guided:
            from warpir.recover import require_model

            require_model(config)
        return
    from warpir.inputs import Loaders
    from warpir.sequence import read_sequence

    frames = read_sequence(config, Loaders())
    say(f"frames: {len(frames)}, of which {sum(f.is_done for f in frames)} are done already")


class _CallableModule(ModuleType):
    """Lets ``from warpir import insert; insert(config)`` work: the module calls its function."""

    def __call__(self, config: InsertConfig) -> Insertion:
        """Insert one object; see `insert`."""
        return insert(config)


sys.modules[__name__].__class__ = _CallableModule

if __name__ == "__main__":
    sys.exit(main())
