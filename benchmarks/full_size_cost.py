"""What does a guided run cost, in time and memory, with a model of Stable Diffusion 2.1's size?

    python -m benchmarks.full_size_cost [--quick | --tiny] --json FILE

The whole program runs on the scene that ships with it: class images, LoRA, light transport, 600
steps, final render. The model has the shapes of Stable Diffusion 2.1-base and random weights, which
cost what trained ones do; what the run recovers means nothing. ``--quick`` takes a tenth of the
steps, ``--tiny`` also a tiny model, within seconds on the CPU. The same program with a tiny model
runs first, so that no compilation is measured.
"""

import argparse
import gc
import json
import os
import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import warp as wp

from benchmarks.measure import context, peak_mib
from tests.builders.tiny_stable_diffusion import (
    END,
    START,
    make_tiny_stable_diffusion,
    write_tokenizer,
)
from warpir.app.config import InsertConfig
from warpir.app.record import Timings, versions
from warpir.core.progress import StepProgress
from warpir.diffusion.models.stable_diffusion import StableDiffusion, load_stable_diffusion
from warpir.diffusion.personalization.lora_files import initial_lora
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.prompts import make_prompts
from warpir.insert import insert
from warpir.optimize.light import LightOptimization
from warpir.render.device import choose_device

PROMPT = "a small red car"
TARGETS = {"whole_run_s": 180.0, "peak_gb": 12.0, "rendering_share": 0.10}
"""On an H200; the authors state 26 minutes on an RTX A6000 and more than 12 GB."""
AUTHORS = InsertConfig(
    demo=True, guidance="stable-diffusion", prompt=PROMPT, class_images=200, lora_steps=1000,
    steps=600, guidance_width=384, start="uniform", detail=False, hand_off=False,
    report=False,
)  # fmt: skip
"""What the authors' run does; neither detail, files for other tools nor a report are theirs."""
QUICK = AUTHORS.changed(class_images=16, lora_steps=100, steps=60)
TINY = AUTHORS.changed(
 class_images=2, class_steps=2, lora_steps=4, steps=8, guidance_width=32, lobes=8,
    light_height=16, object_light_height=8, score_every=4, width=48, samples=2,
)  # fmt: skip
WARM_STEPS, TIMED_STEPS = 8, 12
"""Steps before and within a measurement of single steps."""
EXTRA_STAGES = ("class images", "encoding", "evaluation", "training")
"""Of the stage ``personalize``, which then holds what is left."""


def full_size_parts(device: torch.device, start: int, end: int) -> tuple[Any, Any, Any]:
    """Return UNet, autoencoder and text encoder of Stable Diffusion 2.1-base, random, in fp16.

    Args:
        device: Where they are made.
        start: The tokenizer's id of a prompt's start.
        end: Of its end.
    """
    from diffusers import AutoencoderKL, UNet2DConditionModel
    from transformers import CLIPTextConfig, CLIPTextModel

    torch.manual_seed(0)
    with device:
        unet = UNet2DConditionModel(
            sample_size=64,
            block_out_channels=(320, 640, 1280, 1280),
            layers_per_block=2,
            attention_head_dim=(5, 10, 20, 20),
            cross_attention_dim=1024,
            use_linear_projection=True,
        )
        vae = AutoencoderKL(
            sample_size=768,
            block_out_channels=(128, 256, 512, 512),
            layers_per_block=2,
            down_block_types=("DownEncoderBlock2D",) * 4,
            up_block_types=("UpDecoderBlock2D",) * 4,
        )
        text_encoder = CLIPTextModel(
            CLIPTextConfig(
                vocab_size=49408,
                hidden_size=1024,
                intermediate_size=4096,
                num_hidden_layers=23,
                num_attention_heads=16,
                max_position_embeddings=77,
                hidden_act="gelu",
                projection_dim=512,
                bos_token_id=start,
                eos_token_id=end,
            )
        )
    return unet.half(), vae.half(), text_encoder.half()


def write_model(folder: Path, device: torch.device) -> None:
    """Write a random pipeline with the shapes of Stable Diffusion 2.1-base."""
    from diffusers import DDIMScheduler, StableDiffusionPipeline
    from transformers import CLIPTokenizer

    vocabulary = write_tokenizer(folder / "tokenizer")
    unet, vae, text_encoder = full_size_parts(device, vocabulary[START], vocabulary[END])
    StableDiffusionPipeline(
        vae=vae,
        text_encoder=text_encoder,
        tokenizer=CLIPTokenizer.from_pretrained(folder / "tokenizer"),
        unet=unet,
        scheduler=DDIMScheduler(
            beta_schedule="scaled_linear",
            beta_start=0.00085,
            beta_end=0.012,
            steps_offset=1,
            clip_sample=False,
            set_alpha_to_one=False,
        ),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    ).save_pretrained(folder)


class Memory:
    """Peak memory by stage [GB]: torch's reserved memory and Warp's on CUDA, else resident."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.by_stage: dict[str, float] = {}
        self.allocated = 0.0
        """Greatest memory that torch had given out, of what it had reserved [GB]."""

    def mark(self, stage: str) -> None:
        """Count what was used since the last mark as a stage's."""
        if self.device.is_cuda:
            # Warp's mark cannot be set back; its share is small.
            used = torch.cuda.max_memory_reserved() + wp.get_mempool_used_mem_high(self.device)
            self.allocated = max(self.allocated, torch.cuda.max_memory_allocated() / 1e9)
            torch.cuda.reset_peak_memory_stats()
            peak = used / 1e9
        else:
            peak = peak_mib(self.device) * 2**20 / 1e9
        self.by_stage[stage] = max(self.by_stage.get(stage, 0.0), peak)


@dataclass
class Watch:
    """Looks over the program's shoulder: memory by stage, and the objects that it makes."""

    memory: Memory
    made: dict[str, Any] = field(default_factory=dict)

    @contextmanager
    def installed(self) -> Iterator[None]:
        """Within this context the program's own hooks report here."""
        memory, made = self.memory, self.made

        class WatchedTimings(Timings):
            @contextmanager
            def stage(self, name: str) -> Iterator[None]:
                memory.mark("between stages")
                with super().stage(name):
                    yield
                memory.mark(name)

        class WatchedProgress(StepProgress):
            def report(self, stage: str, done: int, total: int, words: str = "") -> None:
                memory.mark(stage)
                super().report(stage, done, total, words)

        def kept(name: str, make: Callable[..., Any]) -> Callable[..., Any]:
            def keep(*args: Any, **kwargs: Any) -> Any:
                made[name] = make(*args, **kwargs)
                return made[name]

            return keep

        with ExitStack() as stack:
            for name, substitute in (
                ("warpir.app.record.Timings", WatchedTimings),
                ("warpir.core.progress.StepProgress", WatchedProgress),
                (
                    "warpir.optimize.model.load_stable_diffusion",
                    kept("prior", load_stable_diffusion),
                ),
                ("warpir.optimize.recover.LightOptimization", kept("loop", LightOptimization)),
            ):
                stack.enter_context(mock.patch(name, substitute))
            yield


@contextmanager
def own_cache(folder: Path) -> Iterator[None]:
    """Within this context nothing of earlier runs is found."""
    with mock.patch.dict(os.environ, {"WARPIR_CACHE": str(folder)}):
        yield


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
    watch = Stopwatch(prior.device)
    latents = torch.randn(8, *prior.latent_shape)
    assert config.guidance.prompt is not None
    prompts = make_prompts(config.guidance.prompt, config.adapter)
    embeddings = prior.embed([prompts.photo, prompts.class_])
    lora = initial_lora(prior, config.adapter.lora_layers, config.adapter.lora_rank, 0)
    with LoraTraining(
        prior, lora, latents, latents, embeddings, config.adapter, 0, name="timed"
    ) as made:
        update = prior.graphs.recorded_step(made.update) if prior.graphs else made.update

        def steps(count: int) -> None:
            for step in range(count):
                made.prepare(step)
                update()

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


def light_step_ms(loop: LightOptimization, device: torch.device) -> float:
    """Return the time of an optimisation step [ms]."""
    watch = Stopwatch(device)
    light_steps(loop, WARM_STEPS)
    start = watch.now()
    light_steps(loop, TIMED_STEPS)
    return 1e3 * (watch.now() - start) / TIMED_STEPS


def light_step_split(loop: LightOptimization, prior: StableDiffusion) -> dict[str, float]:
    """Return the parts of an optimisation step, each measured between two waits [ms]."""
    watch = Stopwatch(prior.device)
    with ExitStack() as stack:
        for part in (
            watch.around_gradient(prior, "encode", "vae_backward"),
            watch.around(prior, "encode", "vae_forward"),
            watch.around(prior, "predict", "unet"),
            watch.around(loop.guide, "gradient", "guidance"),
            watch.around(loop, "composite", "render_forward"),
            watch.around(loop, "step", "step"),
        ):
            stack.enter_context(part)
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
            found["light"][word] = light_step_ms(loop, prior.device)
            found["light_split"][word] = light_step_split(loop, prior)
        with with_graphs(prior, loop, wanted):
            found["lora"][word] = lora_step_ms(prior, config)
    return found


def measure(config: InsertConfig, model: Path, room: Path, device: wp.Device) -> dict[str, Any]:
    """Run the whole program and then single steps of it; return all figures.

    Args:
        config: What to run.
        model: Folder of the model.
        room: Folder for results and caches.
        device: Where.
    """
    gc.collect()
    if device.is_cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    memory = Memory(device)
    watch = Watch(memory)
    config = config.changed(model=str(model), out=str(room / "out"), device=str(device.alias))
    with own_cache(room / "cache"), watch.installed():
        start = time.perf_counter()
        record = insert(config).record
        total = time.perf_counter() - start
    memory.mark("end")

    measured = record["measured"]
    stages = dict(record["seconds"])
    parts = measured["personalization"]["seconds"]
    for name in EXTRA_STAGES:
        stages[name] = parts[name]
        stages["personalize"] -= parts[name]
    stages["other"] = total - sum(stages.values())
    prior, loop = watch.made["prior"], watch.made["loop"]
    recording = prior.graphs.seconds if prior.graphs else 0.0
    steps = measure_steps(watch, config)
    word = "graphs" if "graphs" in steps["light"] else "eager"
    split = steps["light_split"][word]
    share = (split["render_forward"] + split["render_backward"]) / steps["light"][word]
    peak = max(memory.by_stage.values())
    found = {"whole_run_s": total, "peak_gb": peak, "rendering_share": share}
    return {
        "dtype": {
            "unet": str(prior.unet_dtype).removeprefix("torch."),
            "vae": str(prior.vae.dtype).removeprefix("torch."),
            "text_encoder": "float32",
            "training": "bfloat16 beside float32" if device.is_cuda else "float32",
        },
        "parameters": {
            "unet": sum(p.numel() for n, p in prior.unet.named_parameters() if ".lora_" not in n),
            "vae": sum(p.numel() for p in prior.vae.parameters()),
        },
        "batch": {
            "class_images": 2 * config.adapter.class_batch,
            "lora": 1 + config.adapter.lora_class_batch,
            "unet": len(loop.guide.terms) * loop.guide.settings.noises,
            "vae": loop.guide.settings.noises,
        },
        "settings": {
            "class_images": config.adapter.class_images,
            "class_steps": config.adapter.class_steps,
            "lora_steps": config.adapter.lora_steps,
            "steps": config.optimize.step_count,
            "picture": [loop.frame.photo_lin.shape[1], loop.frame.photo_lin.shape[0]],
            "lobes": config.optimize.lobes,
            "integrator": config.optimize.integrator,
            "vae_checkpointing": config.diffusion.vae_checkpointing,
            "graphs": prior.graphs is not None,
        },
        "seconds": {name: round(spent, 3) for name, spent in stages.items()},
        "seconds_recording_graphs": round(recording, 3),
        "whole_run_s": total,
        "per_step_ms": {
            "class_image": 1e3 * stages["class images"] / max(config.adapter.class_images or 1, 1),
            "lora": 1e3 * stages["training"] / max(config.adapter.lora_steps, 1),
            "light": 1e3 * stages["optimize"] / max(config.optimize.step_count, 1),
        },
        "step_ms": steps,
        "rendering_share": share,
        "peak_gb": peak,
        "peak_gb_by_stage": {k: round(v, 3) for k, v in memory.by_stage.items()},
        "peak_gb_allocated": memory.allocated,
        "notices": record["notices"],
        "retraced": loop.retraced,
        "targets": {
            name: {"limit": limit, "found": found[name], "met": found[name] <= limit}
            for name, limit in TARGETS.items()
        },
    }


def main(argv: list[str] | None = None) -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--quick", action="store_true", help="a tenth of the steps")
    size.add_argument("--tiny", action="store_true", help="a tiny model, within seconds")
    parser.add_argument("--device", default=None, help="cpu or cuda")
    parser.add_argument(
        "--set", action="append", default=[], help="setting=value, such as noises=4"
    )
    parser.add_argument("--json", type=Path, help="file for the figures")
    options = parser.parse_args(argv)
    config = TINY if options.tiny else QUICK if options.quick else AUTHORS
    for text in options.set:
        name, _, value = text.partition("=")
        config = config.changed(**{name: json.loads(value)})
    device = wp.get_device(choose_device(options.device))
    if options.tiny:
        torch.set_num_threads(1)  # more only wait for each other in a network this small
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder)
        start = time.perf_counter()
        make_tiny_stable_diffusion(room / "tiny")
        if not options.tiny:
            measure(TINY.changed(width=None), room / "tiny", room / "warm", device)
        warmed = time.perf_counter()
        model = room / "tiny"
        if not options.tiny:
            model = room / "model"
            write_model(model, torch.device(wp.device_to_torch(device)))
        written = time.perf_counter()
        figures = measure(config, model, room / "run", device)
    arguments = sys.argv[1:] if argv is None else argv
    line = {
        **context(device, os.cpu_count() or 1),
        "command": shlex.join(["python", "-m", "benchmarks.full_size_cost", *arguments]),
        "versions": versions(),
        "seconds_before": {"warm_up": warmed - start, "write_model": written - warmed},
        **figures,
    }
    text = json.dumps(line, indent=1)
    print(text)
    if options.json is not None:
        options.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
