"""Running a loop: its frame, checkpoints, previews and progress, and its summary."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from warpir.app.config import DEFAULTS
from warpir.app.inputs import Inputs
from warpir.app.record import versions
from warpir.app.run import Run
from warpir.core import signals
from warpir.core.atomic import Checkpoints
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.dataset_update import DatasetUpdate
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.personalization.lora_files import save_lora
from warpir.io.images.photos import Photo
from warpir.io.images.resize import resize
from warpir.io.unfinished import remove_unfinished
from warpir.lighting.scene_light import SceneLight
from warpir.optimize.checkpoint import is_due
from warpir.optimize.loop import Optimization
from warpir.optimize.model import Guided
from warpir.optimize.view import Frame, LitFrame
from warpir.render.picture.photo_scene import scene_of
from warpir.render.renderer import Renderer
from warpir.render.tone_curve import ToneCurve
from warpir.scene.tone_curves import Curves

SAY_EVERY = 25
"""Steps between two progress lines that describe the unknowns."""
STOPS_MAX = 3.0
"""How far the exposure of a plate may be from a photograph's before it is said [EV]."""
PREVIEW_SAMPLES = 16
"""Camera samples per pixel of the first preview, which is written before the slow stages."""
NOT_IDENTITY = frozenset(
    {"out", "overwrite", "resume", "preview_every", "checkpoint_every", "threads", "mark"}
    | {"allow_download", "show_prior", "samples", "rays", "indirect_limit", "width", "device"}
    | {"accept", "report", "precision", "vae_precision"}
    | {name for name in DEFAULTS if name.startswith("max_")}
)
"""Settings that a resumed run may change: they do not affect the optimisation, or are compared by
their resolved value, as the device, or are what a run that overflowed shall change: precision."""


@dataclass(frozen=True)
class Outcome:
    """Light and inputs after guidance, ready for the final render."""

    light: SceneLight
    inputs: Inputs
    """With what guidance changed of the object or the lamps."""
    record: dict[str, Any]
    """Entries of ``run.json`` about model and loop."""
    notices: tuple[str, ...]


@dataclass(frozen=True)
class Course:
    """A finished loop, its guidance and its start."""

    run: Run
    loop: Optimization
    guided: Guided
    guide: Guidance | DatasetUpdate
    renderer: Renderer
    first: float | None
    """Score of the loop's start."""

    def summary(self) -> dict[str, Any]:
        """Return counts and scores of the loop."""
        state = self.loop.state
        return {
            "steps": state.step,
            "skipped_steps": state.skipped,
            "score_at_start": self.first,
            "best_score": state.best_score,
            "best_step": state.best_step if state.best_step >= 0 else state.step,
            "rate_share": state.rate_share,
        }

    def record(self, integrator: str) -> dict[str, Any]:
        """Return the entries of ``run.json`` about model, loop and its integrator."""
        counts = {
            "clipped_steps": self.guide.gate.clipped_steps,
            "bad_pixels": self.renderer.bad_pixels.count,
        }
        return {
            **self.guided.record(self.run),
            "loop_integrator": integrator,
            "optimization": self.summary() | counts,
        }

    def notices(self) -> Iterator[str]:
        """Yield the notices of model, loop and renderer."""
        yield from self.guided.prior.notices
        yield from self.guided.notices
        if self.loop.state.skipped:
            yield f"{self.loop.state.skipped} steps had no finite gradient and were skipped"
        yield from self.renderer.bad_pixels.notices()

    def write(self) -> None:
        """Write ``optimization.json``, every step's numbers by name, and the adapter's files."""
        history = self.loop.state.history
        names = sorted({name for entry in history for name in entry})
        content = {
            "format": "warpir-optimization",
            "version": 1,
            **self.summary(),
            "by_step": {name: [entry.get(name) for entry in history] for name in names},
        }
        self.run.output.write_json("optimization.json", content)
        self._write_lora()

    def _write_lora(self) -> None:
        """Write the adapter in diffusers' and kohya's forms."""
        if self.guided.learnt is None:
            return
        output, prior = self.run.output, self.guided.prior
        with tempfile.TemporaryDirectory(dir=output.staging) as folder:
            paths = save_lora(
                self.guided.learnt.lora,
                folder,
                prior.unet.config.cross_attention_dim,
                prior.schedule.prediction_type,
                self.guided.prompts.photo,
            )
            for path in paths:
                output.write_bytes(path.name, path.read_bytes())


def open_checkpoints(run: Run) -> Checkpoints:
    """Return the run's checkpoints; their identity does not include the model yet.

    Raises:
        InputError: --out holds an unfinished run that is neither resumed nor overwritten, or
            another one than is to be resumed.
    """
    values = run.config.flat()
    identity = {
        "config": {k: v for k, v in values.items() if k not in NOT_IDENTITY and v is not None},
        "inputs": run.inputs.hashes,
        "device": run.device,
        "versions": versions(),
    }
    checkpoints = Checkpoints(run.output.path, identity)
    if run.config.output.resume and checkpoints.newest is not None:
        checkpoints.check()  # before anything is loaded or written
        return checkpoints
    if run.config.output.resume:
        folder = checkpoints.folder
        run.log.say(f"notice: no checkpoint in {folder}: the run starts at its beginning")
    remove_unfinished(checkpoints.folder)
    return checkpoints


def unseen_plate(photo: Photo) -> Iterator[str]:
    """Yield how dark or bright a linear plate is for the model, which sees its values up to 1."""
    stops = math.log2(photo.exposure)
    if abs(stops) > STOPS_MAX:
        yield (
            "the model sees the plate's own values, clipped at 1, which are "
            f"{abs(stops):.0f} stops too {'dark' if stops > 0.0 else 'bright'} for it: give the "
            f"plate times {photo.exposure:.2g}"
        )


def make_frame(run: Run) -> Frame:
    """Return scene and photo at the loop's resolution.

    Raises:
        InputError: The object covers no pixel; checked before the model is adapted.
    """
    config, camera = run.config, run.inputs.camera
    run.log.notice(*unseen_plate(run.inputs.photo))
    width = min(config.optimize.guidance_width, camera.width)
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
        bounce_depth=config.render.bounce_depth,
    )
    photo = np.clip(resize(run.inputs.photo.linear(), small.height, small.width), 0.0, None)
    quality = config.render
    frame = Frame(renderer, photo, curves.tone == "reinhard", quality.depth, quality.seed)
    if not frame.coverage().any():
        raise InputError(
            "--guidance",
            f"the object covers no pixel of the {small.width} x {small.height} that are judged",
            "bring it nearer, or raise --guidance-width",
        )
    return frame


def follow(
    run: Run,
    loop: Optimization,
    guided: Guided,
    guide: Guidance | DatasetUpdate,
    renderer: Renderer,
) -> Course:
    """Run a loop to its end, with checkpoints, previews and progress.

    Raises:
        InputError: Memory is short (5), or the numbers stayed non-finite (6).
    """
    with run.timings.stage("optimize"), torch.no_grad():
        first = loop.guide.score(loop.final_image(run.config.render.seed))
    resumed = guided.resumed
    if resumed is not None and resumed.stage == "optimize":
        loop.load_state_dict(resumed.state["loop"])
        renderer.bad_pixels.load_state_dict(resumed.state["bad_pixels"])

    def save() -> None:
        state = {
            "loop": loop.state_dict(),
            "guided": guided.state_dict(),
            "bad_pixels": renderer.bad_pixels.state_dict(),
        }
        guided.checkpoints.save("optimize", loop.state.step, state)

    watch = _Watch(run)

    def on_step(loop: Optimization) -> None:
        watch.show(loop)
        if is_due(loop.state.step, run.config.optimize.checkpoint_every):
            save()
        signals.check()

    with run.timings.stage("optimize"), signals.deferred():
        try:
            loop.run(on_step)
        except InputError as error:
            # The step that failed changed nothing: this is the last good state.
            if error.code == ExitCode.NUMERIC:
                save()
            raise
    if loop.state.best_score is not None:
        run.log.say(f"kept: step {loop.state.best_step}, score {loop.state.best_score:.4g}")
    return Course(run, loop, guided, guide, renderer, first)


class _Watch:
    """Prints progress lines and writes previews of a loop."""

    def __init__(self, run: Run) -> None:
        self.run, self.words = run, ""

    def show(self, loop: Optimization) -> None:
        """Show the state after a step."""
        settings, step = self.run.config.optimize, loop.state.step
        if step % SAY_EVERY == 0 or step == settings.step_count:
            score = loop.state.history[-1].get("score")
            self.words = loop.describe(self.run.inputs.camera)
            self.words += f"; score {score:.4g}" if score is not None else ""
        self.run.progress.report("optimisation", step, settings.step_count, self.words)
        if settings.preview_every and step % settings.preview_every == 0:
            with torch.no_grad():
                write_preview(self.run, loop.final_image(self.run.config.render.seed), step)


def write_start(run: Run, frame: Frame, start: SceneLight) -> None:
    """Write the composite under the start's light, before the slow stages."""
    lit = LitFrame(frame, start, torch.device(run.device), PREVIEW_SAMPLES)
    curves = (ToneCurve(n).to(run.device)() for n in (1, 3))
    with torch.no_grad():
        write_preview(run, lit.image(lit.foreground, *curves), 0)


def write_preview(run: Run, image: torch.Tensor, step: int) -> None:
    """Write a composite, shape [1, 3, H, W], to ``progress/``; earlier results stay."""
    shown = image[0].permute(1, 2, 0).cpu().numpy()
    path = run.output.write_preview(step, np.round(shown * 255.0).astype(np.uint8))
    run.log.say(f"preview: {path}")
