"""Recover the light of a photograph: model, personalisation, guidance, optimisation, in that order.

What comes out stands in the place of a light that the user gave
(`warpir.lighting.scene_light.SceneLight`), so that everything behind it, from the final render to
the files, is one and the same.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpir.app.config import DEFAULTS, PRIOR_DEFAULTS, InsertConfig
from warpir.app.inputs import Inputs
from warpir.app.record import Timings, versions
from warpir.core import signals
from warpir.core.cache import cache_folder
from warpir.core.color import gamma_to_linear, linear_to_gamma
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import Memory, needs_of_model, release
from warpir.core.progress import StepProgress
from warpir.diffusion.dataset_update import DatasetUpdate
from warpir.diffusion.guidance import Guidance, make_guidance
from warpir.diffusion.models.embedded import load_embedded
from warpir.diffusion.models.embedded_words import embedded_prompts
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.model_folder import check_model_folder, find_model, hub_offline
from warpir.diffusion.models.network_prior import NetworkPrior
from warpir.diffusion.models.stable_diffusion import load_stable_diffusion
from warpir.diffusion.personalization.lora_files import save_lora
from warpir.diffusion.personalization.personalize import (
    Personalization,
    personalize,
    restore_personalization,
)
from warpir.diffusion.personalization.show_prior import show_personalization
from warpir.diffusion.prior import Condition, NonFiniteError
from warpir.diffusion.prompts import Prompts, make_prompts
from warpir.io.lobes_file import lobes_to_json
from warpir.io.results import OutputFolder
from warpir.lighting.estimate import Estimate, estimate_light
from warpir.lighting.fit import fit_lobes
from warpir.lighting.regression import Regression, regress
from warpir.lighting.regressor import load_regressor
from warpir.lighting.scene_light import SceneLight, start_level
from warpir.lighting.sg_light import narrowest
from warpir.lighting.trust_region import TrustRegion
from warpir.optimize.acceptance import Verdict, blend, judge
from warpir.optimize.checkpoint import Checkpoint, Checkpoints
from warpir.optimize.light import LightOptimization, Unknowns
from warpir.optimize.lit_frame import LitFrame
from warpir.optimize.loop import Optimization
from warpir.optimize.view import Frame
from warpir.render.composite import resize, scene_of
from warpir.render.determinism import use_threads_for
from warpir.render.renderer import Renderer
from warpir.render.tone_curve import ToneCurve
from warpir.scene.camera import Camera
from warpir.scene.light import Lobes, as_map, summarize
from warpir.scene.tone_curves import Curves, ToneKnots

LIGHT_HEIGHT = 256
"""Rows of the map that is delivered."""
START_HEIGHT = 128
"""Rows of the map to which a given light is fitted as a start."""
SAY_EVERY = 25
"""Steps between two looks at the light, for people."""
SHOWN_SEEDS = (0, 1, 2)
"""Of the pictures of --show-prior."""
PREVIEW_SAMPLES = 16
"""Camera samples per pixel of the first preview, which is to be there soon."""
CHECK_DRAWS = 16
"""Noises of the scores that stand beside a verdict."""
ANYTHING = "object"
"""What the embedded prior is asked for when nobody says what the object is."""
ABOUT_EMBEDDED = (
    "prior: embedded, trained on rendered scenes, experimental: it failed its release gate; for "
    "photographs Stable Diffusion is recommended (--model)"
)
LOSSES_WITHOUT_LORA = ("csd", "sds-base", "good-bad")
"""They ask the unadapted model alone."""
NOT_IDENTITY = frozenset(
    {"out", "overwrite", "resume", "preview_every", "checkpoint_every", "threads", "mark"}
    | {"allow_download", "show_prior", "samples", "rays", "indirect_limit", "width", "device"}
    | {"accept", "report"}
    | {name for name in DEFAULTS if name.startswith("max_")}
)
"""Settings that an interrupted run may change: they do not reach the optimisation, or, as the
device that was chosen, count by what came of them."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Run:
    """One guided run: what all of its stages share."""

    config: InsertConfig
    inputs: Inputs
    device: str
    """Warp device; torch uses the same."""
    output: OutputFolder
    timings: Timings
    say: Say
    progress: StepProgress
    estimate: Estimate | None = None
    """What was read off the photo, where that is the start."""
    memory: Memory = field(default_factory=Memory)
    """Is told where memory was short."""

    @property
    def torch_device(self) -> torch.device:
        """The device of model and unknowns."""
        return torch.device("cpu" if self.device == "cpu" else self.device)


@dataclass(frozen=True)
class Guided:
    """A model that has seen the photo, ready to judge composites of it."""

    prior: NetworkPrior
    prompts: Prompts
    negative_prompt: str
    """What the negative term asks for; empty: the null prompt."""
    learnt: Personalization | None
    """What the model learnt from the photo; None: it is asked as it is."""
    record: dict[str, Any]
    """What run.json says of model and personalisation."""
    notices: tuple[str, ...]

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint of the loop holds beside it: precision and adapter."""
        learnt = None if self.learnt is None else self.learnt.state_dict()
        return {"prior": self.prior.state_dict(), "learnt": learnt}


def recover(
    run: Run, start: SceneLight | None
) -> tuple[SceneLight, dict[str, Any], tuple[str, ...]]:
    """Recover light and tone curves.

    Args:
        run: Configuration, inputs, output folder.
        start: The light that was given, or the one that stands for none; None: it is read off the
            photo.

    Returns:
        Light and curves, those of the start where guidance could show no improvement; what run.json
        says about them, and notices.

    Raises:
        InputError: The model cannot be used (exit 4), memory is short (5), the numbers stayed
            non-finite (6), or what ``--resume`` finds is another run's.
    """
    run = settled(run)
    if start is None:
        with run.timings.stage("regress"):
            estimate = estimate_light(run.inputs, run.config, run.device)
        run, start = replace(run, estimate=estimate), estimate.light
        for line in start.assumed:
            run.say(f"assumed: {line}")
    config = settings = run.config
    with as_input_errors():
        checkpoints = open_checkpoints(run)
        with run.timings.stage("scene"):
            frame = make_frame(run)
            unknowns = start_of(run, start).to(run.torch_device)
            region = region_of(run, unknowns)
        if config.optimize.preview_every:
            with run.timings.stage("preview"):
                write_start(run, frame, start)
        guided, resumed = prepare_guidance(run, checkpoints)
        with run.timings.stage("trace"):
            release()
            guide = make_guide(run, guided, frame)
            graphs = guided.prior.graphs
            faster = graphs.recorded_module if graphs else None
            loop = LightOptimization(
                frame,
                guide,
                settings.optimize,
                unknowns,
                cache_folder("transport"),
                record=faster,
                region=region,
            )
        before = {k: v.detach().clone() for k, v in unknowns.state_dict().items()}
        with run.timings.stage("optimize"), torch.no_grad():
            first = loop.guide.score(loop.final_image(config.render.seed))
        optimize(run, loop, guided, frame.renderer, checkpoints, resumed)
        verdict = None
        if config.guidance.accept:
            assert isinstance(guide, Guidance)
            with run.timings.stage("accept"):
                verdict, compared = judge_end(loop, guide, before)
            run.say(verdict.line)
        notices = (*guided.prior.notices, *guided.notices, *loop_notices(loop, frame.renderer))
        unknowns = loop.unknowns
        with run.timings.stage("write"):
            light_fg, light_shadow = loop.final_lights(LIGHT_HEIGHT)
            run.output.write_json("optimization.json", convergence(loop, first))
            write_lora(run, guided)
        curves = Curves(
            config.tone_operator, knots_of(unknowns.curve_fg), knots_of(unknowns.curve_shadow)
        )
    record = {
        **guided.record,
        **who_spoke(run, guided),
        "loop_integrator": settings.optimize.integrator,
        "optimization": summary_of(loop, first) | counts_of(guide, frame),
        **({} if run.estimate is None else {"regression": run.estimate.regression.record()}),
        "start_light": asdict(summarize(start.light)),
        "end_light": asdict(summarize(light_fg)),
    }
    if verdict is not None:
        record["acceptance"] = verdict.record() | compared
        if not verdict.is_accepted:
            return start, record, (*notices, verdict.line)
    run.output.write_json("lobes.json", lobes_to_json(unknowns.light_fg.lobes()))
    if settings.optimize.fusion_kind != "single":
        run.output.write_json("lobes_shadow.json", lobes_to_json(unknowns.light_shadow.lobes()))
    light = SceneLight(light_fg, light_shadow, curves, 0.0, start.assumed)
    return light, record, notices


def settled(run: Run) -> Run:
    """Return the run with nothing left open to the prior."""
    return replace(run, config=run.config.settled(on_cuda=run.device != "cpu"))


def who_spoke(run: Run, guided: Guided) -> dict[str, Any]:
    """Return what run.json says of the prior and of what was left open to it."""
    prior = guided.prior
    about = {"prior_about": ABOUT_EMBEDDED} if prior.name == "embedded" else {}
    settings = {name: run.config.flat()[name] for name in PRIOR_DEFAULTS[prior.name]}
    settings["tone"] = run.config.tone_operator
    return {"prior": prior.name, "prior_sha256": prior.digest, **about, "settings": settings}


def judge_end(
    loop: LightOptimization, guide: Guidance, before: dict[str, torch.Tensor]
) -> tuple[Verdict, dict[str, Any]]:
    """Return whether the loop's end is better than its start, by guidance that is asked anew.

    Args:
        loop: At its end, where it also is afterwards.
        guide: Its guidance.
        before: The unknowns at the start.

    Returns:
        The verdict, and scores of both ends with common noises: of the run's own loss, and of the
        difference of the errors of the right and the wrong prompt where there is a wrong one.
    """
    after = {k: v.detach().clone() for k, v in loop.unknowns.state_dict().items()}

    def image(share: float) -> torch.Tensor:
        loop.unknowns.load_state_dict(blend(before, after, share))
        return loop.final_image(loop.seed)

    verdict = judge(guide, image)
    judges = {"score": guide}
    if guide.condition.negative_prompt and guide.settings.loss != "good-bad":
        judges["good_bad"] = guide.with_loss("good-bad")
    compared = {}
    with torch.no_grad():
        for end, share in (("start", 0.0), ("end", 1.0)):
            picture = image(share)
            for name, judging in judges.items():
                # The seed of no score that chose among the states.
                seed = loop.seed + 1
                compared[f"{name}_{end}"] = judging.score(picture, seed, CHECK_DRAWS)
    loop.unknowns.load_state_dict(after)
    return verdict, compared


def _path(name: str | None) -> Path | None:
    return None if name is None else Path(name)


def open_checkpoints(run: Run) -> Checkpoints:
    """Return the run's checkpoints; the model is not among what they depend on yet.

    Raises:
        InputError: --out holds an unfinished run that is neither resumed nor overwritten, or
            another one than is to be resumed.
    """
    config = run.config
    values = config.flat()
    identity = {
        "config": {k: v for k, v in values.items() if k not in NOT_IDENTITY and v is not None},
        "inputs": run.inputs.hashes,
        "device": run.device,
        "versions": versions(),
    }
    checkpoints = Checkpoints(run.output.path, identity)
    if config.output.resume and checkpoints.newest is not None:
        checkpoints.check()  # before anything is loaded or written
        return checkpoints
    if config.output.resume:
        run.say(f"notice: no checkpoint in {checkpoints.folder}: the run starts at its beginning")
    checkpoints.remove()
    return checkpoints


def checkpoint_of(run: Run, checkpoints: Checkpoints, prior: NetworkPrior) -> Checkpoint | None:
    """Return the checkpoint to go on from, which is of this very model; None: there is none.

    Raises:
        InputError: It is another run's; every difference is named.
    """
    checkpoints.identity["model"] = prior.file_hashes
    if checkpoints.newest is None:
        return None
    found = checkpoints.load(lambda text: run.say(f"notice: {text}"))
    run.say(f"resumed: {found.stage}, step {found.step}")
    return found


def prepare_guidance(run: Run, checkpoints: Checkpoints) -> tuple[Guided, Checkpoint | None]:
    """Load the model and adapt it to the photo; return it, and the checkpoint to go on from.

    Raises:
        InputError: As `checkpoint_of`.
        ModelError: The model cannot be loaded or adapted.
    """
    config = run.config
    with run.timings.stage("model"):
        prior, prompts, negative = run.memory.again(lambda: load_prior(run), "the model", "--model")
        use_threads_for(prior.unet)
        shown = [*(config.guidance.show_prior or ())]
        prior.embed([prompts.photo, prompts.class_, prompts.guidance, "", *shown])
        prior.embed([negative, config.guidance.null_prompt, config.guidance.base_prompt])
    weights = config.diffusion.model or config.guidance.prior or "as shipped"
    run.say(f"model: {prior.name} {weights}, sha256 {prior.digest[:16]}...")
    resumed = checkpoint_of(run, checkpoints, prior)
    run.say(f'guidance asks for "{prompts.guidance}"')
    guided = adapted(run, prior, prompts, negative, checkpoints, resumed)
    if resumed is not None and resumed.stage == "optimize":
        # After the adapter, which was rounded as the model was when it came.
        prior.load_state_dict(resumed.state["guided"]["prior"])
    return guided, resumed


def adapted(
    run: Run,
    prior: NetworkPrior,
    prompts: Prompts,
    negative: str,
    checkpoints: Checkpoints,
    resumed: Checkpoint | None,
) -> Guided:
    """Adapt a model to the photo, as far as the loss asks for it.

    A loop that is resumed goes on with the very adapter that it had, whatever has become of the
    cache.

    Raises:
        ModelError: The model cannot be adapted.
    """
    config, shown = run.config, [*(run.config.guidance.show_prior or ())]
    record: dict[str, Any] = {
        "model": {"name": prior.name, "sha256": prior.file_hashes},
        "prompts": asdict(prompts),
    }
    notices: tuple[str, ...] = (ABOUT_EMBEDDED,) if prior.name == "embedded" else ()
    does_without = (
        config.guidance.loss in LOSSES_WITHOUT_LORA and config.adapter.lora is None and not shown
    )
    if config.adapter.personalize and does_without:
        notices = (*notices, f"--loss {config.guidance.loss} does without a LoRA: none was trained")
    if not config.adapter.personalize or does_without:
        prior.free_text_encoder()
        return Guided(prior, prompts, negative, None, record, notices)
    photo = torch.from_numpy(run.inputs.photo.srgb).permute(2, 0, 1)[None].contiguous()
    cache = cache_folder()
    with run.timings.stage("personalize"):

        def on_step(training: Any) -> None:
            if is_time_to_save(config, training.step_count):
                checkpoints.save("personalize", training.step_count, training.state_dict())

        def report(stage: str, done: int, total: int) -> None:
            run.progress.report(stage, done, total)
            signals.check()

        if resumed is not None and resumed.stage == "optimize":
            made = restore_personalization(prior, resumed.state["guided"]["learnt"])
        else:
            with signals.deferred():
                made = personalize(
                    prior,
                    photo,
                    prompts,
                    config.adapter,
                    config.render.seed,
                    cache,
                    report=report,
                    on_step=on_step,
                    resume=resumed.state if resumed else None,
                )
        if shown:
            sheet = show_personalization(
                prior, photo, prompts, config.adapter, config.render.seed, cache, shown,
                SHOWN_SEEDS, run.progress.report,
            )  # fmt: skip
            run.output.write_png("prior.png", sheet, mark=False, description="The model's idea")
    prior.free_text_encoder()
    record["personalization"] = {
        "reused": made.is_reused,
        "class_prompts": list(made.class_prompts),
        "error_before_after": made.evaluation and list(made.evaluation),
        "seconds": made.seconds,
    }
    notices = (*notices, *made.notices)
    return Guided(prior, prompts, negative, made, record, notices)


def load_prior(run: Run) -> tuple[NetworkPrior, Prompts, str]:
    """Return the prior that is asked for, what it is asked, and what the negative term asks.

    Raises:
        ModelError: It cannot be loaded.
    """
    config = run.config
    if config.guided_by == "embedded":
        prompts = embedded_prompts(
            config.guidance.prompt or ANYTHING, config.adapter, bool(config.adapter.personalize)
        )
        device = run.torch_device
        graphs = config.diffusion.graphs and device.type == "cuda"
        prior = load_embedded(_path(config.guidance.prior), device, graphs, run.memory.in_chunks)
        if prompts.unknown:
            words = ", ".join(prompts.unknown)
            prior.notices += (f"the embedded prior does not know: {words}",)
        return prior, prompts, config.guidance.negative_prompt or prompts.negative
    assert config.guidance.prompt is not None
    require_memory(run)
    model = load_stable_diffusion(config.diffusion, run.torch_device, run.memory.in_chunks)
    return (
        model,
        make_prompts(config.guidance.prompt, config.adapter),
        config.guidance.negative_prompt,
    )


def require_memory(run: Run) -> None:
    """Compare what Stable Diffusion will take with what is free.

    Raises:
        InputError: It is certain not to fit (`ExitCode.RESOURCES`).
        ModelError: It cannot be used.
    """
    config = run.config
    with hub_offline(not config.diffusion.allow_download):
        found = find_model(
            config.diffusion.model, config.diffusion.allow_download, config.diffusion.allow_pickle
        )
        folder = check_model_folder(found, config.diffusion.allow_pickle)
    files = (file for weights in folder.weights.values() for file in weights.files)
    side = 8 * int(folder.configs["unet"]["sample_size"])
    is_half = run.device != "cpu" and config.diffusion.precision != "fp32"
    pictures = config.guidance_settings().noises
    size = sum(file.stat().st_size for file in files)
    run.memory.require(*needs_of_model(size, side, pictures, is_half=is_half))


def make_frame(run: Run) -> Frame:
    """Return scene and photo at the loop's resolution.

    Raises:
        InputError: The object is not seen in it; better known before the model is adapted.
    """
    config, camera = run.config, run.inputs.camera
    width = min(config.optimize.picture_width, camera.width)
    small = camera.scaled(width, max(1, round(width * camera.height / camera.width)))
    curves = Curves.identity(config.tone_operator)
    scene = run.memory.again(
        lambda: scene_of(run.inputs, small, run.device, curves), "the scene", "--asset"
    )
    renderer = Renderer(
        scene,
        config.render.threads or 0,
        memory=run.memory,
        lower="--guidance-width",
        is_ordered=config.render.deterministic,
    )
    photo = np.clip(resize(run.inputs.photo.linear(), small.height, small.width), 0.0, None)
    frame = Frame(
        renderer, photo, curves.tone == "reinhard", config.render.depth, config.render.seed
    )
    if not frame.coverage().any():
        raise InputError(
            "--guidance",
            f"the object covers no pixel of the {small.width} x {small.height} that are judged",
            "bring it nearer, or raise --guidance-width",
        )
    return frame


def start_of(run: Run, start: SceneLight) -> Unknowns:
    """Return the unknowns: lobes of the light that was given or regressed, else an even light."""
    config = run.config
    lobes, least = None, narrowest(config.optimize.light_rows)
    if run.estimate is not None:
        lobes = run.estimate.regression.lobes(least)
        lobes = replace(lobes, amplitude=(run.estimate.gain * lobes.amplitude).astype(np.float32))
    elif config.is_light_described:
        fitted = fit_lobes(as_map(start.light, START_HEIGHT), config.optimize.lobes).lobes
        lobes = widened(fitted, least)
    return Unknowns.start(lobes, start_level(run.inputs, config), config.optimize)


def region_of(run: Run, unknowns: Unknowns) -> TrustRegion | None:
    """Return where a regressed light is expected, with its uncertainty; None without one."""
    if run.estimate is None:
        return None
    found = run.estimate.regression
    spread = float(np.radians(found.spread_deg))
    light = unknowns.light_fg
    return TrustRegion.around(light, spread, found.sun_log_std, found.ambient_log_std)


def widened(lobes: Lobes, sigma_min: float) -> Lobes:
    """Return lobes that are no narrower than ``sigma_min`` [rad], of the same flux."""
    sharpness = np.minimum(lobes.sharpness, 1.0 / sigma_min**2).astype(np.float32)
    wide = Lobes(np.ones_like(lobes.amplitude), lobes.axis, sharpness)
    amplitude = (lobes.flux() / wide.flux()).astype(np.float32)
    return Lobes(amplitude, lobes.axis, sharpness)


def make_guide(run: Run, guided: Guided, frame: Frame) -> Guidance | DatasetUpdate:
    """Return the guidance of the configured loss over a picture of the frame's size."""
    config = run.config
    shown = linear_to_gamma(frame.photo_lin).astype(np.float32)
    background = torch.from_numpy(shown).permute(2, 0, 1)[None].to(run.torch_device)
    prompts = guided.prompts
    gbuffer = gbuffer_of(frame)
    if guided.prior.name == "embedded":
        path = None if config.light.regressor is None else Path(config.light.regressor)
        network = load_regressor(path, run.torch_device)
        regression = regress(network, run.inputs.photo.srgb, run.inputs.camera)
        gbuffer = with_light(gbuffer, regression, frame.renderer.scene.camera)
    condition = Condition(
        prompts.guidance,
        negative_prompt=guided.negative_prompt,
        background=background,
        gbuffer=gbuffer.to(run.torch_device),
    )
    seen = torch.from_numpy(frame.coverage())
    guide = make_guidance(
        guided.prior,
        condition,
        config.guidance_settings(),
        seen,
        config.optimize.step_count,
        config.render.seed,
        None if guided.learnt is None else guided.learnt.adapter,
    )
    if isinstance(guide, Guidance):
        guide.ensure_precision(background)
    return guide


def with_light(gbuffer: torch.Tensor, regression: Regression, camera: Camera) -> torch.Tensor:
    """Return a G-buffer with what the regressor makes of the object, shape [1, 13, H, W].

    Args:
        gbuffer: Of `gbuffer_of`, shape [1, 7, H, W].
        regression: The light, world frame.
        camera: Of the picture.
    """
    planes = gbuffer[0].permute(1, 2, 0).double().numpy()
    shown, toward = regression.matte_picture(
        gamma_to_linear(planes[..., 1:4]), planes[..., 4:7], camera.c2w
    )
    shown = shown * (planes[..., :1] > 0.0)
    light = np.concatenate([shown, np.broadcast_to(toward, shown.shape)], axis=2)
    more = torch.from_numpy(light.astype(np.float32)).permute(2, 0, 1)[None]
    return torch.cat([gbuffer, more], dim=1)


def gbuffer_of(frame: Frame) -> torch.Tensor:
    """Return what the object is, as the embedded prior sees it, shape [1, 7, H, W].

    Mask in [0, 1], albedo display-encoded, unit normals in the camera's frame (x right, y up, z
    toward the camera); all 0 beside the object. `warpir.train.batches.PriorBatch` is the same.
    """
    scene = frame.renderer.scene
    found = frame.renderer.gbuffer(frame.seed)
    seen = found.coverage > 0.0
    height, width = frame.photo_lin.shape[:2]
    plane = np.zeros((height * width, 7), np.float32)
    plane[found.object_pixels[seen]] = np.concatenate(
        [
            found.coverage[seen, None],
            linear_to_gamma(np.clip(found.base_color[seen], 0.0, 1.0)),
            found.normal[seen] @ scene.camera.c2w[:3, :3],
        ],
        axis=1,
    )
    return torch.from_numpy(plane.reshape(height, width, 7)).permute(2, 0, 1)[None].contiguous()


def optimize(
    run: Run,
    loop: Optimization,
    guided: Guided,
    renderer: Renderer,
    checkpoints: Checkpoints,
    resumed: Checkpoint | None,
) -> None:
    """Run a loop to its end, with checkpoints, previews and progress."""
    config = run.config
    if resumed is not None and resumed.stage == "optimize":
        loop.load_state_dict(resumed.state["loop"])
        renderer.bad_pixels.load_state_dict(resumed.state["bad_pixels"])
    words = ""

    def save() -> None:
        state = {
            "loop": loop.state_dict(),
            "guided": guided.state_dict(),
            "bad_pixels": renderer.bad_pixels.state_dict(),
        }
        checkpoints.save("optimize", loop.state.step, state)

    def on_step(loop: Optimization) -> None:
        nonlocal words
        step = loop.state.step
        if step % SAY_EVERY == 0 or step == config.optimize.step_count:
            score = loop.state.history[-1].get("score")
            words = loop.describe(run.inputs.camera)
            words += f"; score {score:.4g}" if score is not None else ""
        run.progress.report("optimisation", step, config.optimize.step_count, words)
        if config.optimize.preview_every and step % config.optimize.preview_every == 0:
            with torch.no_grad():
                write_preview(run, loop.final_image(config.render.seed), step)
        if is_time_to_save(config, step):
            save()
        signals.check()

    with run.timings.stage("optimize"), signals.deferred():
        try:
            loop.run(on_step)
        except (InputError, NonFiniteError) as error:
            # The step that failed changed nothing: this is the last good state.
            if not isinstance(error, InputError) or error.code == ExitCode.NUMERIC:
                save()
            raise
    if loop.state.best_score is not None:
        run.say(f"kept: step {loop.state.best_step}, score {loop.state.best_score:.4g}")


def is_time_to_save(config: InsertConfig, step: int) -> bool:
    """Return whether a checkpoint is due: every so many steps, and when the run is to stop."""
    every = config.optimize.checkpoint_every
    return bool(every) and (step % every == 0 or signals.is_pending())


def write_start(run: Run, frame: Frame, start: SceneLight) -> None:
    """Write the composite under the light of the start, before anything slow is done."""
    lit = LitFrame(frame, start, run.torch_device, PREVIEW_SAMPLES)
    curves = (ToneCurve(n).to(run.torch_device)() for n in (1, 3))
    with torch.no_grad():
        write_preview(run, lit.image(lit.foreground, *curves), 0)


def write_preview(run: Run, image: torch.Tensor, step: int) -> None:
    """Write a composite, shape [1, 3, H, W], to ``progress/``; earlier results are not touched."""
    shown = image[0].permute(1, 2, 0).cpu().numpy()
    path = run.output.write_preview(step, np.round(shown * 255.0).astype(np.uint8))
    run.say(f"preview: {path}")


def knots_of(curve: ToneCurve) -> ToneKnots:
    """Return a curve as plain arrays."""
    return ToneKnots(*curve.arrays())


def loop_notices(loop: Optimization, renderer: Renderer) -> Iterator[str]:
    """Yield what the user should know of a finished loop."""
    if loop.state.skipped:
        yield f"{loop.state.skipped} steps had no finite gradient and were skipped"
    yield from renderer.bad_pixels.notices()


def summary_of(loop: Optimization, first: float | None) -> dict[str, Any]:
    """Return the few numbers that say how a loop went."""
    state = loop.state
    return {
        "steps": state.step,
        "skipped_steps": state.skipped,
        "score_at_start": first,
        "best_score": state.best_score,
        "best_step": state.best_step if state.best_step >= 0 else state.step,
        "rate_share": state.rate_share,
    }


def counts_of(guide: Guidance | DatasetUpdate, frame: Frame) -> dict[str, int]:
    """Return what was shortened and what was set to black in a loop."""
    return {
        "clipped_steps": guide.counts.clipped_steps,
        "bad_pixels": frame.renderer.bad_pixels.count,
    }


def convergence(loop: Optimization, first: float | None) -> dict[str, Any]:
    """Return the content of ``optimization.json``: every step's numbers by name."""
    names = sorted({name for entry in loop.state.history for name in entry})
    columns = {name: [entry.get(name) for entry in loop.state.history] for name in names}
    return {
        "format": "warpir-optimization",
        "version": 1,
        **summary_of(loop, first),
        "by_step": columns,
    }


def write_lora(run: Run, guided: Guided) -> None:
    """Write the adapter in diffusers' and kohya's forms."""
    if guided.learnt is None:
        return
    lora, prior = guided.learnt.lora, guided.prior
    with tempfile.TemporaryDirectory(dir=run.output.staging) as folder:
        for path in save_lora(
            lora, folder, prior.unet.config.cross_attention_dim, prior.schedule.prediction_type,
            guided.prompts.photo,
        ):  # fmt: skip
            run.output.write_bytes(path.name, path.read_bytes())


@contextmanager
def as_input_errors() -> Iterator[None]:
    """Turn the model's errors into the program's."""
    try:
        yield
    except ModelError as error:
        raise InputError(error.where, error.what, error.advice, ExitCode.MODEL) from None
    except NonFiniteError as error:
        advice = "try --precision fp32; the last checkpoint holds the state before"
        raise InputError("guidance", str(error), advice, ExitCode.NUMERIC) from None
