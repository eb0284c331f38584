"""What does a guided run cost, in time and memory, with a model of Stable Diffusion 2.1's size?

    python -m benchmarks.full_size_cost [--tiny] --json FILE

The whole program runs on the scene that ships with it: class images, LoRA, light transport, 600
steps, final render. The model has the shapes of Stable Diffusion 2.1-base and random weights, which
cost what trained ones do; what the run recovers means nothing. ``--tiny`` takes few steps with a
tiny model, within seconds on the CPU. Without it that runs first, so that no compilation is
measured.
"""

import gc
import json
import os
import shlex
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from unittest import mock

import torch
import warp as wp

from benchmarks.full_size_cost.model import write_model
from benchmarks.full_size_cost.steps import measure_steps
from benchmarks.full_size_cost.watch import Memory, Watch
from benchmarks.measure import context, flags, write_json
from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
from warpir.app.config import InsertConfig
from warpir.app.record import versions
from warpir.diffusion.models.stable_diffusion import StableDiffusion
from warpir.insert import insert
from warpir.optimize.light import LightOptimization
from warpir.render.device import choose_device

PROMPT = "a small red car"
TARGETS = {"whole_run_s": 180.0, "peak_gb": 12.0, "rendering_share": 0.10}
"""On an H200; the authors state 26 minutes on an RTX A6000 and more than 12 GB."""
AUTHORS = InsertConfig(
    demo=True, guidance="stable-diffusion", prompt=PROMPT, class_images=200, lora_steps=1000,
    steps=600, guidance_width=384, start="uniform", preview_every=0, detail=False, hand_off=False,
    report=False,
)  # fmt: skip
"""What the authors' run does; neither detail, files for other tools nor a report are theirs."""
TINY = AUTHORS.changed(
    class_images=2, class_steps=2, lora_steps=4, steps=8, guidance_width=32, lobes=8,
    light_height=16, object_light_height=8, score_every=4, width=48, samples=2,
)  # fmt: skip
EXTRA_STAGES = ("class images", "encoding", "evaluation", "training")
"""Of the stage ``personalize``, which then holds what is left."""


def measure(config: InsertConfig, model: Path, room: Path, device: wp.Device) -> dict[str, Any]:
    """Run the whole program and then single steps of it; return all figures."""
    gc.collect()
    if device.is_cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    memory = Memory(device)
    watch = Watch(memory)
    config = config.changed(model=str(model), out=str(room / "out"), device=str(device.alias))
    own_cache = mock.patch.dict(os.environ, {"WARPIR_CACHE": str(room / "cache")})
    with own_cache, watch.installed():
        start = time.perf_counter()
        record = insert(config).record
        total = time.perf_counter() - start
    memory.mark("end")

    stages = _seconds_by_stage(record, total)
    prior, loop = watch.made["prior"], watch.made["loop"]
    recording = prior.graphs.seconds if prior.graphs else 0.0
    steps = measure_steps(watch, config)
    word = "graphs" if "graphs" in steps["light"] else "eager"
    share = steps["rendering"][word] / steps["light"][word]
    peak = max(memory.by_stage.values())
    found = {"whole_run_s": total, "peak_gb": peak, "rendering_share": share}
    return {
        **_what_ran(config, prior, loop),
        "seconds": {name: round(spent, 3) for name, spent in stages.items()},
        "seconds_recording_graphs": round(recording, 3),
        "whole_run_s": total,
        "step_ms": steps,
        "rendering_share": share,
        "peak_gb": peak,
        "peak_gb_by_stage": {k: round(v, 3) for k, v in memory.by_stage.items()},
        "targets": {
            name: {"limit": limit, "found": found[name], "met": found[name] <= limit}
            for name, limit in TARGETS.items()
        },
    }


def _seconds_by_stage(record: dict[str, Any], total: float) -> dict[str, float]:
    """Return the seconds of each stage of a run; those of personalisation one by one."""
    stages = dict(record["seconds"])
    parts = record["measured"]["personalization"]["seconds"]
    for name in EXTRA_STAGES:
        stages[name] = parts[name]
        stages["personalize"] -= parts[name]
    return {**stages, "other": total - sum(stages.values())}


def _what_ran(
    config: InsertConfig, prior: StableDiffusion, loop: LightOptimization
) -> dict[str, Any]:
    """Return precision, size and settings of a run's networks and loop."""
    adapter = config.adapter
    is_cuda = prior.device.type == "cuda"
    return {
        "dtype": {
            "unet": str(prior.unet_dtype).removeprefix("torch."),
            "vae": str(prior.vae.dtype).removeprefix("torch."),
            "text_encoder": "float32",
            "training": "bfloat16 beside float32" if is_cuda else "float32",
        },
        "parameters": {
            "unet": sum(p.numel() for n, p in prior.unet.named_parameters() if ".lora_" not in n),
            "vae": sum(p.numel() for p in prior.vae.parameters()),
        },
        "settings": {
            "class_images": adapter.class_images,
            "class_steps": adapter.class_steps,
            "lora_steps": adapter.lora_steps,
            "steps": config.optimize.step_count,
            "picture": [loop.frame.photo_lin.shape[1], loop.frame.photo_lin.shape[0]],
            "lobes": config.optimize.lobes,
            "integrator": config.optimize.integrator,
            "vae_checkpointing": config.diffusion.vae_checkpointing,
            "graphs": prior.graphs is not None,
        },
    }


def main(argv: list[str] | None = None) -> None:
    """Measure and write the figures."""
    parser = flags(__doc__, "device", "json")
    parser.add_argument("--tiny", action="store_true", help="a tiny model, within seconds")
    about = "setting=value, such as noises=4"
    parser.add_argument("--set", action="append", default=[], help=about)
    options = parser.parse_args(argv)
    config = TINY if options.tiny else AUTHORS
    for text in options.set:
        name, _, value = text.partition("=")
        config = config.changed(**{name: json.loads(value)})
    device = wp.get_device(choose_device(options.device))
    if options.tiny:
        torch.set_num_threads(1)  # more only wait for each other in a network this small
    with tempfile.TemporaryDirectory() as folder:
        room = Path(folder)
        model = room / "tiny"
        make_tiny_stable_diffusion(model)
        if not options.tiny:
            measure(TINY.changed(width=None), model, room / "warm", device)
            model = room / "model"
            write_model(model, torch.device(wp.device_to_torch(device)))
        figures = measure(config, model, room / "run", device)
    arguments = sys.argv[1:] if argv is None else argv
    line = {
        **context(device, os.cpu_count() or 1),
        "command": shlex.join(["python", "-m", "benchmarks.full_size_cost", *arguments]),
        "versions": versions(),
        **figures,
    }
    print(json.dumps(line, indent=1))
    write_json(options.json, line)


if __name__ == "__main__":
    main()
