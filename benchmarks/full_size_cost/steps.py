"""Time of single steps of LoRA and loop, and of the parts of one."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from unittest import mock

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


class Stopwatch:
    """Adds up what some methods take, the device's work included."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.seconds: dict[str, float] = {}
        self._starts: dict[str, float] = {}

    def now(self) -> float:
        """Return the time when the device is idle [s]."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()

    def start(self, name: str) -> None:
        """Start a part."""
        self._starts[name] = self.now()

    def stop(self, name: str) -> None:
        """End a part."""
        spent = self.now() - self._starts.pop(name)
        self.seconds[name] = self.seconds.get(name, 0.0) + spent

    @contextmanager
    def around(self, owner: Any, method: str, name: str) -> Iterator[None]:
        """Within this context every call of an object's method is timed."""
        plain = getattr(owner, method)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self.start(name)
            result = plain(*args, **kwargs)
            self.stop(name)
            return result

        with mock.patch.object(owner, method, timed):
            yield

    @contextmanager
    def around_gradient(self, owner: Any, method: str, name: str) -> Iterator[None]:
        """Within this context the backward pass of a method of one tensor is timed."""
        plain = getattr(owner, method)

        def timed(x: torch.Tensor) -> Any:
            result = plain(x)
            if result.requires_grad:
                result.register_hook(lambda _: self.start(name))
                x.register_hook(lambda _: self.stop(name))
            return result

        with mock.patch.object(owner, method, timed):
            yield


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
    watch = Stopwatch(device)
    steps(WARM_STEPS)
    start = watch.now()
    steps(TIMED_STEPS)
    return 1e3 * (watch.now() - start) / TIMED_STEPS


def light_steps(loop: LightOptimization, count: int) -> None:
    """Take steps from the middle of the run on, without scores."""
    steps = loop.settings.step_count
    loop.settings = replace(loop.settings, score_every=0)
    for _ in range(count):
        # Behind the middle, and never where light transport may be traced again.
        loop.state.step = steps // 2 + 1
        loop.step()


def light_step_split(loop: LightOptimization, prior: StableDiffusion) -> dict[str, float]:
    """Return the parts of an optimisation step, each measured between two waits [ms]."""
    watch = Stopwatch(prior.device)
    with (
        watch.around_gradient(prior, "encode", "vae_backward"),
        watch.around(prior, "encode", "vae_forward"),
        watch.around(prior, "predict", "unet"),
        watch.around(loop.guide, "gradient", "guidance"),
        watch.around(loop, "composite", "render_forward"),
        watch.around(loop, "step", "step"),
    ):
        light_steps(loop, WARM_STEPS)
        watch.seconds.clear()
        light_steps(loop, TIMED_STEPS)
    step = loop.settings.step_count // 2 + 1
    for k in range(WARM_STEPS + TIMED_STEPS):
        image = loop.composite(step).image
        if k >= WARM_STEPS:
            watch.start("render_backward")
        torch.autograd.backward([image], [torch.ones_like(image)])
        if k >= WARM_STEPS:
            watch.stop("render_backward")
    ms = {name: 1e3 * spent / TIMED_STEPS for name, spent in watch.seconds.items()}
    guidance, whole = ms.pop("guidance"), ms.pop("step")
    rendering = ms["render_forward"] + ms["render_backward"]
    model = ms["vae_forward"] + ms["vae_backward"] + ms["unet"]
    return {
        **ms,
        "crop_and_residual": guidance - model,
        "regularisers_and_optimiser": whole - guidance - rendering,
        "sum": whole,
    }


def measure_steps(watch: Watch, config: InsertConfig) -> dict[str, Any]:
    """Return the times of single steps, as they are and replayed."""
    prior, loop = watch.made["prior"], watch.made["loop"]
    found: dict[str, Any] = {"lora": {}, "light": {}, "light_split": {}}
    for word, wanted in (("eager", False), ("graphs", True)):
        if wanted and prior.graphs is None:
            continue
        with with_graphs(prior, loop, wanted):
            found["light"][word] = mean_ms(prior.device, partial(light_steps, loop))
            found["light_split"][word] = light_step_split(loop, prior)
        with with_graphs(prior, loop, wanted):
            found["lora"][word] = lora_step_ms(prior, config)
    return found
