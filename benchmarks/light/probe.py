"""Which light does the embedded prior prefer? Its force along families of lights around the truth.

No optimiser stands between: scenes are rendered under lights that differ from the true one in one
respect, the force of each loss is asked in the pictures, and its work from picture to picture gives
a potential. Where that is lowest is what the loss would find. Times, noises and crops are the same
for all lights of a scene.
"""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.measure import flags
from warpir.diffusion.models.embedded import EmbeddedPrior, load_embedded, random_embedded
from warpir.lighting.regressor import load_regressor
from warpir.render.device import choose_device
from warpir.train.batches import PriorBatch
from warpir.train.command import files_in
from warpir.train.lights import load_panoramas
from warpir.train.meshes import make_meshes
from warpir.train.scenes.generator import Mixture, SceneGenerator
from warpir.train.scenes.lighting import Lighting
from warpir.train.scenes.render import Stock

SEED = 2_000_000
"""No training draws these scenes, nor these objects."""
AZIMUTHS = 16
STOPS = tuple(float(s) for s in np.linspace(-2.0, 2.0, 9))
ROWS = {
    "sds": (1.0, 0.0, 0.0, 0.0, -1.0),
    "csd": (1.0, -1.0, 0.0, 0.0, 0.0),
    "good-bad": (1.0, 0.0, -1.0, 0.0, 0.0),
    "sds-good-bad": (3.0, 0.0, -2.0, 0.0, -1.0),
    "csd-drop": (1.0, 0.0, 0.0, -1.0, 0.0),
    "sds-drop-2": (2.0, 0.0, 0.0, -1.0, -1.0),
    "sds-drop-4": (4.0, 0.0, 0.0, -3.0, -1.0),
}
"""Coefficients of consistent, null, mismatched, null without the photo (--null-background drop; the
number is the guidance scale), and of the noise itself."""
TIMES = {"low": (0.05, 0.35), "middle": (0.3, 0.6), "high": (0.55, 0.9)}
"""Ranges of the time, of which the noise level is sin(pi t / 2)."""


def families() -> dict[str, list[Callable[[Lighting], Lighting]]]:
    """Return by name the changes of a light, each family with the true light among them."""

    def turned(k: int) -> Callable[[Lighting], Lighting]:
        angle = 2.0 * np.pi * k / AZIMUTHS
        return lambda light: light.turned(torch.full_like(light.yaw, angle))

    def scaled(stops: float, sun: bool, rest: bool) -> Callable[[Lighting], Lighting]:
        factor = 2.0**stops
        return lambda light: replace(
            light,
            sun=light.sun * (factor if sun else 1.0),
            gain=light.gain * (factor if rest else 1.0),
        )

    return {
        "azimuth": [turned(k) for k in range(AZIMUTHS)],
        "exposure": [scaled(s, True, True) for s in STOPS],
        "sun": [scaled(s, True, False) for s in STOPS],
    }


@torch.no_grad()
def potentials(
    prior: EmbeddedPrior,
    batches: Sequence[PriorBatch],
    is_ring: bool,
    noises: int,
    span: tuple[float, float],
) -> dict[str, Tensor]:
    """Return by row the potential of each light, shape [light, scene].

    Args:
        prior: What is asked.
        batches: The same scenes under each light.
        is_ring: The last light is next to the first; what does not close is spread evenly.
        noises: Times and noises.
        span: Range of the times.
    """
    count = len(batches[0].image)
    device = batches[0].image.device
    words = ["consistent object", "", "mismatched object", ""]
    sees = [True, True, True, False]
    embeddings = prior.embed(words)
    latents = [prior.encode(b.image) for b in batches]
    gbuffer = batches[0].gbuffer
    shown = batches[0].background
    forces: dict[str, list[Tensor]] = {row: [] for row in ROWS}
    for z in latents:
        total = {row: torch.zeros_like(z) for row in ROWS}
        for k in range(noises):
            generator = torch.Generator().manual_seed(k)
            noise = torch.randn(z.shape, generator=generator).to(device)
            t = span[0] + (span[1] - span[0]) * (k + 0.5) / noises
            times = torch.full((count,), t, device=device)
            sigma = float(np.sin(np.pi * t / 2.0))
            noisy = prior.schedule.add_noise(z, noise, times)
            predicted = [
                prior.predict(
                    noisy, times, e[None].expand(count, -1, -1), [None] * count, shown, gbuffer,
                    [is_seen] * count,
                )
                for e, is_seen in zip(embeddings, sees, strict=True)
            ]  # fmt: skip
            for row, weights in ROWS.items():
                terms = zip(weights, [*predicted, noise], strict=True)
                total[row] += sigma * sum(w * x for w, x in terms) / noises
        for row in ROWS:
            forces[row].append(total[row])
    found = {}
    for row, force in forces.items():
        steps = []
        pairs = len(latents) if is_ring else len(latents) - 1
        for i in range(pairs):
            j = (i + 1) % len(latents)
            middle = 0.5 * (force[i] + force[j])
            steps.append((middle * (latents[j] - latents[i])).flatten(1).sum(dim=1))
        rises = torch.stack(steps)
        if is_ring:
            rises = rises[:-1] - rises.mean(dim=0)
        found[row] = torch.cat([torch.zeros_like(rises[:1]), rises.cumsum(dim=0)])
    return found


def figures(name: str, potential: Tensor, counted: Tensor) -> dict[str, float]:
    """Return how far the lowest light is from the true one, over the scenes that count."""
    lowest = potential[:, counted].argmin(dim=0).cpu().numpy()
    if name == "azimuth":
        error = 360.0 / AZIMUTHS * np.minimum(lowest, AZIMUTHS - lowest)
        return {
            "mean": float(error.mean()),
            "median": float(np.median(error)),
            "below_30": float((error < 30.0).mean()),
        }
    error = np.array(STOPS)[lowest]
    return {
        "bias": float(error.mean()),
        "mean": float(np.abs(error).mean()),
        "within_1": float((np.abs(error) <= 1.0).mean()),
    }


def measure(
    prior: EmbeddedPrior, scenes: SceneGenerator, count: int, noises: int, other: bool = False
) -> dict[str, Any]:
    """Return figures by family, range of times and row; chance is 90 degrees and 1.1 stops.

    Args:
        prior: What is asked.
        scenes: Where scenes come from.
        count: Scenes.
        noises: Times and noises.
        other: Condition on the background of another scene, which must fail.
    """
    result: dict[str, Any] = {}
    for family, changes in families().items():
        batches = scenes.relit(0, count, changes, other)
        truth = batches[0 if family == "azimuth" else len(batches) // 2]
        light = scenes.light_of(0, count)
        counted = (light > 0.25) & (truth.gbuffer[:, 0].mean(dim=(1, 2)) > 0.03)
        result[family] = {"scenes": int(counted.sum())} | {
            span: {
                row: figures(family, potential, counted)
                for row, potential in potentials(
                    prior, batches, family == "azimuth", noises, limits
                ).items()
            }
            for span, limits in TIMES.items()
        }
    return result


def main() -> None:
    """Print a table and one JSON line."""
    parser = flags(__doc__, has_assets=False)
    parser.add_argument("--panoramas", type=Path, nargs="*", default=[])
    parser.add_argument("--only", nargs="*", default=[], help="names of panoramas that are used")
    parser.add_argument("--prior", type=Path, default=None)
    parser.add_argument("--regressor", type=Path, default=None)
    parser.add_argument("--random", action="store_true", help="random weights: must be at chance")
    parser.add_argument("--other", action="store_true", help="another background: must fail")
    parser.add_argument("--scenes", type=int, default=32)
    parser.add_argument("--noises", type=int, default=4)
    options = parser.parse_args()
    name = choose_device(options.device)
    device = torch.device(name)
    prior = random_embedded(0, device) if options.random else load_embedded(options.prior, device)
    regressor = load_regressor(options.regressor, device)
    paths = [p for p in files_in(options.panoramas, (".hdr", ".exr")) if p.stem in options.only]
    stock = Stock(make_meshes(48, SEED), load_panoramas(paths, device), name)
    kinds = {"procedural": Mixture(made_up=1.0, hybrid=0.0, mismatched=0.0)}
    if paths:
        kinds["panoramas"] = Mixture(made_up=0.0, hybrid=0.0, proxies=0.0, mismatched=0.0)
    result = {
        kind: measure(
            prior, SceneGenerator(stock, SEED, mixture, regressor), options.scenes, options.noises,
            options.other,
        )
        for kind, mixture in kinds.items()
    }  # fmt: skip
    for kind, by_family in result.items():
        for family, by_span in by_family.items():
            print(f"{kind}, {family}, {by_span['scenes']} scenes")
            for span in TIMES:
                for row, numbers in by_span[span].items():
                    text = ", ".join(f"{key} {value:.2f}" for key, value in numbers.items())
                    print(f"    {span:8s}{row:14s}{text}")
    if options.json:
        options.json.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
