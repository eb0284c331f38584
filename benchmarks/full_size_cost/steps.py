"""Time of single steps of LoRA and loop, and of the rendering in one."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

import torch

from benchmarks.full_size_cost.watch import Watch
from warpir.app.config import InsertConfig
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.diffusion.personalization.lora_files import initial_lora
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.prompts import make_prompts
from warpir.optimize.light import LightOptimization

WARM_STEPS, TIMED_STEPS = 8, 12
"""Steps before and within a measurement of single steps."""


@contextmanager
def with_graphs(prior: StableDiffusion, loop: LightOptimization, wanted: bool) -> Iterator[None]:
    """Within this context the passes of model and loop are replayed or not."""
    prior.forget_graphs()
    kept = prior.graphs, loop._recorded
    if not wanted:
        prior.graphs = loop._recorded = None
    try:
        yield
    finally:
        prior.graphs, loop._recorded = kept
        prior.forget_graphs()


def lora_step_ms(prior: StableDiffusion, config: InsertConfig) -> float:
    """Return the time of a training step on random latents [ms]."""
    latents = torch.randn(8, *prior.latent_shape)
    assert config.guidance.prompt is not None
    prompts = make_prompts(config.guidance.prompt, config.adapter)
    embeddings = prior.embed([prompts.photo, prompts.class_])
    lora = initial_lora(prior, config.adapter.lora_layers, config.adapter.lora_rank, 0)
    given = latents, latents, embeddings, config.adapter, 0
    with LoraTraining(prior, lora, *given, name="timed") as made:
        update = prior.graphs.recorded_step(made.update) if prior.graphs else made.update

        def steps(count: int) -> None:
            for step in range(count):
                made.prepare(step)
                update()

        return mean_ms(prior.device, steps)


def mean_ms(device: torch.device, steps: Callable[[int], None]) -> float:
    """Return the mean time of a step, after some that are not counted [ms]."""

    def now() -> float:
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        return time.perf_counter()

    steps(WARM_STEPS)
    start = now()
    steps(TIMED_STEPS)
    return 1e3 * (now() - start) / TIMED_STEPS


def light_steps(loop: LightOptimization, count: int) -> None:
    """Take steps from the middle of the run on, without scores."""
    steps = loop.settings.step_count
    loop.settings = replace(loop.settings, score_every=0)
    for _ in range(count):
        # Behind the middle, and never where light transport may be traced again.
        loop.state.step = steps // 2 + 1
        loop.step()


def renderings(loop: LightOptimization, count: int) -> None:
    """Make the picture of such steps, forward and backward."""
    for _ in range(count):
        image = loop.composite(loop.settings.step_count // 2 + 1).image
        torch.autograd.backward([image], [torch.ones_like(image)])


def measure_steps(watch: Watch, config: InsertConfig) -> dict[str, Any]:
    """Return the times of single steps, as they are and replayed."""
    prior, loop = watch.made["prior"], watch.made["loop"]
    found: dict[str, Any] = {"lora": {}, "light": {}, "rendering": {}}
    for word, wanted in (("eager", False), ("graphs", True)):
        if wanted and prior.graphs is None:
            continue
        with with_graphs(prior, loop, wanted):
            found["light"][word] = mean_ms(prior.device, partial(light_steps, loop))
            found["rendering"][word] = mean_ms(prior.device, partial(renderings, loop))
        with with_graphs(prior, loop, wanted):
            found["lora"][word] = lora_step_ms(prior, config)
    return found
