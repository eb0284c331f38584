"""Cheap guided runs with random weights, and ways to stop one."""

import json
from pathlib import Path

from tests.builders.outcome import outcome, without_clock


def guided_flags(inputs: Path, out: str | Path, **changes: str | None) -> list[str]:
    """Return a run that the inputs' prior guides, as cheap as can be."""
    from tests.builders.insertions import arguments

    flags: dict[str, str | None] = {
        name: str(inputs / f"{name}.safetensors") for name in ("prior", "regressor")
    }
    flags |= {"guidance_width": "32", "light_height": "16", "object_light_height": "8"}
    flags |= {"samples": "2", "light": None}
    return arguments(inputs, out, **{**flags, **changes})


def guided_argv(inputs: Path) -> list[str]:
    """Return a cheap run through every stage, but for the name of its folder."""
    changes = {"lora_steps": "4", "class_images": "2", "class_steps": "2", "personalize": ""}
    changes |= {"steps": "6", "score_every": "2", "checkpoint_every": "2", "preview_every": "2"}
    changes |= {"no_accept": "", "no_hand_off": "", "device": "cpu"}
    return guided_flags(inputs, "out", **changes)


def write_guided_inputs(folder: Path) -> None:
    """Write photo, box, and random weights of both networks."""
    from tests.builders.insertions import write_inputs
    from tests.optimize.test_recover_embedded import NETWORK
    from warpir.diffusion.models import embedded
    from warpir.lighting.regressor import random_regressor, save_regressor

    write_inputs(folder)
    network = embedded.build_network(NETWORK, seed=1)
    embedded.save_embedded(network, folder / "prior.safetensors", {})
    save_regressor(random_regressor(1), folder / "regressor.safetensors", {})


def results_of(out: Path) -> dict[str, str]:
    """Return all files, previews too; `run.json` without what a clock or a cache decides."""
    found = outcome(out)
    run = json.loads(without_clock(out / "run.json"))
    run["measured"]["personalization"] |= {"seconds": {}, "reused": False}
    return {**found, "run.json": json.dumps(run, sort_keys=True)}
