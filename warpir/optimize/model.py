"""The diffusion model of a run: loading, personalisation to the photo, guidance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from warpir.app.config import LOSSES_WITHOUT_LORA
from warpir.app.run import Run
from warpir.core import signals
from warpir.core.atomic import Checkpoint, Checkpoints
from warpir.core.cache import cache_folder
from warpir.core.color import linear_to_gamma
from warpir.core.memory import needs_of_model
from warpir.diffusion.dataset_update import DatasetUpdate
from warpir.diffusion.guidance import Guidance, kind_of
from warpir.diffusion.models.hub import find_model, hub_offline
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.model_folder import check_model_folder
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.personalize import (
    Personalization,
    personalize,
    restore_personalization,
)
from warpir.diffusion.personalization.show_prior import show_personalization
from warpir.diffusion.prompts import Prompts, make_prompts
from warpir.diffusion.settings import PersonalizeSettings
from warpir.optimize.checkpoint import is_due
from warpir.optimize.view import Frame
from warpir.render.determinism import use_threads_for

SHOWN_SEEDS = (0, 1, 2)
"""Seeds of the images of --show-prior."""


@dataclass(frozen=True)
class Guided:
    """A model adapted to the photo, ready for guidance."""

    prior: StableDiffusion
    prompts: Prompts
    learnt: Personalization | None
    """Personalisation to the photo; None where the base model is used."""
    notices: tuple[str, ...]
    checkpoints: Checkpoints
    resumed: Checkpoint | None
    """Checkpoint to resume from, if there is one."""

    def state_dict(self) -> dict[str, Any]:
        """Return precision and adapter for a checkpoint of the loop."""
        learnt = None if self.learnt is None else self.learnt.state_dict()
        return {"prior": self.prior.state_dict(), "learnt": learnt}

    def record(self, run: Run) -> dict[str, Any]:
        """Return the entries of ``run.json`` about model, adapter and resolved settings."""
        prior, learnt = self.prior, self.learnt
        record: dict[str, Any] = {
            "model": {"name": prior.name, "sha256": prior.file_hashes},
            "prompts": asdict(self.prompts),
        }
        if learnt is not None:
            record["personalization"] = {
                "reused": learnt.is_reused,
                "class_prompts": list(learnt.class_prompts),
                "error_before_after": learnt.evaluation and list(learnt.evaluation),
                "seconds": learnt.seconds,
            }
        record |= {"prior": prior.name, "prior_sha256": prior.digest}
        steps, tone = run.config.optimize.step_count, run.config.tone_operator
        return record | {"settings": {"steps": steps, "tone": tone}}


def prepare_guidance(run: Run, checkpoints: Checkpoints) -> Guided:
    """Load the model and adapt it to the photo, or restore both from a checkpoint.

    Raises:
        InputError: The checkpoint is another run's; every difference is named.
        ModelError: The model cannot be loaded or adapted.
    """
    config = run.config
    with run.timings.stage("model"):
        prior = run.memory.again(lambda: load_prior(run), "the model", "--model")
        assert config.guidance.prompt is not None
        prompts = make_prompts(config.guidance.prompt, config.adapter)
        use_threads_for(prior.unet)
        shown = config.guidance.show_prior or ()
        prior.embed([prompts.photo, prompts.class_, prompts.guidance, "", *shown])
        asks = config.guidance
        prior.embed([asks.negative_prompt, asks.null_prompt, asks.base_prompt])
    run.log.say(f"model: {prior.name} {config.diffusion.model}, sha256 {prior.digest[:16]}...")
    resumed = checkpoint_of(run, checkpoints, prior)
    run.log.say(f'guidance asks for "{prompts.guidance}"')
    guided = adapted(run, prior, prompts, checkpoints, resumed)
    if resumed is not None and resumed.stage == "optimize":
        # After the adapter, which was rounded as the model was when it came.
        prior.load_state_dict(resumed.state["guided"]["prior"])
    return guided


def load_prior(run: Run) -> StableDiffusion:
    """Load the configured prior.

    Raises:
        InputError: Its memory is certain to be short (`ExitCode.RESOURCES`).
        ModelError: It cannot be loaded.
    """
    require_memory(run)
    return load_stable_diffusion(run.config.diffusion, run.device, run.memory.in_chunks)


def require_memory(run: Run) -> None:
    """Compare Stable Diffusion's estimated memory with the free memory.

    Raises:
        InputError: It is certain not to fit (`ExitCode.RESOURCES`).
        ModelError: It cannot be used.
    """
    model = run.config.diffusion
    with hub_offline(not model.allow_download):
        path = find_model(model.model, model.allow_download, model.allow_pickle)
        folder = check_model_folder(path, model.allow_pickle)
    files = (file for weights in folder.weights.values() for file in weights.files)
    side = 8 * int(folder.configs["unet"]["sample_size"])
    is_half = run.device != "cpu" and model.precision != "fp32"
    pictures = run.config.guidance.noises
    size = sum(file.stat().st_size for file in files)
    run.memory.require(*needs_of_model(size, side, pictures, is_half=is_half))


def checkpoint_of(run: Run, checkpoints: Checkpoints, prior: StableDiffusion) -> Checkpoint | None:
    """Return the checkpoint to resume from, written with this model; None where there is none.

    Raises:
        InputError: It is another run's; every difference is named.
    """
    checkpoints.identity["model"] = prior.file_hashes
    if checkpoints.newest is None:
        return None
    checkpoint = checkpoints.load(lambda text: run.log.say(f"notice: {text}"))
    run.log.say(f"resumed: {checkpoint.stage}, step {checkpoint.step}")
    return checkpoint


def adapted(
    run: Run,
    prior: StableDiffusion,
    prompts: Prompts,
    checkpoints: Checkpoints,
    resumed: Checkpoint | None,
) -> Guided:
    """Adapt a model to the photo if the loss needs it; free its text encoder.

    Raises:
        ModelError: The model cannot be adapted.
    """
    config = run.config
    loss, shown = config.guidance.loss, config.guidance.show_prior
    notices: tuple[str, ...] = ()
    does_without = loss in LOSSES_WITHOUT_LORA and config.adapter.lora is None and not shown
    learnt = None
    if config.adapter.personalize and does_without:
        notices = (f"--loss {loss} does without a LoRA: none was trained",)
    elif config.adapter.personalize:
        run.log.assume(*assumed_class(prompts, config.adapter))
        with run.timings.stage("personalize"):
            learnt = personalized(run, prior, prompts, checkpoints, resumed)
        notices = learnt.notices
    prior.free_text_encoder()
    return Guided(prior, prompts, learnt, notices, checkpoints, resumed)


def assumed_class(prompts: Prompts, asked: PersonalizeSettings) -> Iterator[str]:
    """Yield what is painted as the object's class, where it is the last of the prompt's words.

    That of "a vase of flowers" is another thing than the object.
    """
    is_painted = asked.lora is None and asked.class_images != 0
    is_whole = prompts.guidance.startswith(f"{prompts.class_} in ")
    if is_painted and asked.class_noun is None and not is_whole:
        yield f'the class images show "{prompts.noun}", the prompt\'s last word (--class-noun)'


def personalized(
    run: Run,
    prior: StableDiffusion,
    prompts: Prompts,
    checkpoints: Checkpoints,
    resumed: Checkpoint | None,
) -> Personalization:
    """Train the adapter on the photo, and write the images of ``--show-prior``.

    A resumed loop restores its adapter from the checkpoint, not from the cache.

    Raises:
        ModelError: The model cannot be adapted.
    """
    config = run.config
    photo = torch.from_numpy(run.inputs.photo.srgb).permute(2, 0, 1)[None].contiguous()
    given = (prior, photo, prompts, config.adapter, config.render.seed, cache_folder())

    def on_step(training: Any) -> None:
        if is_due(training.step_count, config.optimize.checkpoint_every):
            checkpoints.save("personalize", training.step_count, training.state_dict())

    def report(stage: str, done: int, total: int) -> None:
        run.progress.report(stage, done, total)
        signals.check()

    held = None
    if resumed is not None and resumed.stage == "optimize":
        held = resumed.state["guided"]["learnt"]  # None of a loss that does without an adapter
    if held is not None:
        learnt = restore_personalization(prior, held)
    else:
        state = resumed.state if resumed is not None and resumed.stage == "personalize" else None
        with signals.deferred():
            learnt = personalize(*given, report=report, on_step=on_step, resume=state)
    if shown := config.guidance.show_prior:
        sheet = show_personalization(*given, shown, SHOWN_SEEDS, run.progress.report)
        run.output.write_png("prior.png", sheet, mark=False, description="The model's idea")
    return learnt


def make_guide(run: Run, guided: Guided, frame: Frame) -> Guidance | DatasetUpdate:
    """Return the guidance of the configured loss over a picture of the frame's size."""
    config, settings = run.config, run.config.guidance
    guide = kind_of(settings)(
        guided.prior,
        guided.prompts.guidance,
        settings,
        torch.from_numpy(frame.coverage()),
        config.optimize.step_count,
        config.render.seed,
        None if guided.learnt is None else guided.learnt.adapter,
    )
    if isinstance(guide, Guidance):
        shown = linear_to_gamma(frame.photo_lin).astype(np.float32)
        guide.ensure_precision(torch.from_numpy(shown).permute(2, 0, 1)[None].to(run.device))
    return guide
