"""Cheap guided runs on a tiny Stable Diffusion with random weights."""

import json
import shutil
from pathlib import Path

from tests.builders.faults import snapshot
from tests.builders.insertions import arguments, record_of, write_inputs
from tests.builders.outcome import outcome, without_clock


def guided_flags(inputs: Path, out: str | Path, **changes: str | None) -> list[str]:
    """Return a run that the inputs' model guides, as cheap as can be."""
    flags: dict[str, str | None] = {
        "model": str(inputs / "model"),
        "prompt": "a box",
        "regressor": str(inputs / "regressor.safetensors"),
    }
    flags |= {"lora_steps": "4", "class_images": "2", "class_steps": "2", "lobes": "16"}
    flags |= {"guidance_width": "32", "light_height": "16", "object_light_height": "8"}
    flags |= {"samples": "2", "light": None}
    return arguments(inputs, out, **{**flags, **changes})


def guided_argv(inputs: Path) -> list[str]:
    """Return a cheap run through every stage, but for the name of its folder."""
    every = dict.fromkeys(("score_every", "checkpoint_every", "preview_every"), "2")
    return guided_flags(inputs, "out", steps="6", no_hand_off="", device="cpu", **every)


def write_guided_inputs(folder: Path) -> None:
    """Write photo, box, a tiny model, and random weights of the regressor."""
    from tests.builders.tiny_stable_diffusion import make_tiny_stable_diffusion
    from warpir.train.networks.regressor import random_regressor, save_regressor

    write_inputs(folder)
    make_tiny_stable_diffusion(folder / "model")
    save_regressor(random_regressor(1), folder / "regressor.safetensors", {})


def old_results(finished: Path, out: Path) -> dict[str, str]:
    """Put an earlier run's results in a new folder and return what is there."""
    shutil.copytree(finished, out)
    record = record_of(out)
    record["seconds"] = {"of an earlier run": 1.0}
    (out / "run.json").write_text(json.dumps(record))
    return snapshot(out)


def results_of(out: Path) -> dict[str, str]:
    """Return all files, previews too; `run.json` without what a clock or a cache decides."""
    found = outcome(out)
    run = json.loads(without_clock(out / "run.json"))
    run["measured"]["personalization"] |= {"seconds": {}, "reused": False}
    return {**found, "run.json": json.dumps(run, sort_keys=True)}
