"""Health check of a diffusion model: measurements that separate a trained one from a broken one.

Measured are the error of denoising a photo, the effect of a prompt, the loss by half precision, the
learning of a LoRA and the time of a step; the quality of guidance is not.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from warpir.app.config import InsertConfig
from warpir.app.record import versions
from warpir.core.atomic import write_file
from warpir.core.errors import disk_errors
from warpir.core.strict_json import json_bytes
from warpir.diffusion.crop import Crop
from warpir.diffusion.guidance import Guidance
from warpir.diffusion.models.loading import load_stable_diffusion
from warpir.diffusion.models.stable_diffusion import (
    CHECK_TIMES,
    LEAST_COSINE,
    StableDiffusion,
)
from warpir.diffusion.personalization.lora_training import LoraTraining
from warpir.diffusion.personalization.personalize import personalize
from warpir.diffusion.prior import NonFiniteError
from warpir.diffusion.prompts import Prompts, make_prompts
from warpir.diffusion.settings import GuidanceSettings, PersonalizeSettings
from warpir.render.device import choose_device

PROMPT = "a small red car"
"""Default prompt: a plausible object for a street."""
NOISE_TIME = 0.5
"""Time at which `StableDiffusion.self_check` measures the error of the noise."""
NOISE_ERROR_MAX = 0.5
"""Greatest error, over that of a zero prediction [1]. Random weights have 1 or more, a trained
network read with the wrong prediction type about 0.9."""
EFFECT_MIN, EFFECT_MAX = 1e-4, 1.0
"""Range of a prompt's effect, root mean square; the noise itself has 1."""
LORA_STEPS, LORA_RATE = 30, 5e-4
"""Few steps, with a larger rate than a run's so that their effect can be measured."""
GUIDANCE_STEPS = 10
WARM_STEPS = 3
"""Untimed first steps, which record graphs and choose algorithms."""
KNOWN = {
    (512, "epsilon"): "as Stable Diffusion 2.1-base and 1.5",
    (768, "v_prediction"): "as Stable Diffusion 2.1",
}


@dataclass(frozen=True)
class Verdict:
    """Result of one check."""

    name: str
    ok: bool
    found: str
    """Measurement in words."""
    expected: str
    values: dict[str, float]
    """Measurement as plain numbers."""

    @property
    def line(self) -> str:
        """Verdict in one line."""
        end = "ok" if self.ok else f"NOT AS A TRAINED MODEL (expected {self.expected})"
        return f"{self.name}: {self.found}: {end}"


@dataclass(frozen=True)
class Report:
    """All verdicts on a model, and its timings."""

    model: dict[str, Any]
    verdicts: tuple[Verdict, ...]
    seconds: dict[str, float]
    """Time of a LoRA step and of a guidance step [s]."""

    @property
    def ok(self) -> bool:
        """Whether all checks passed."""
        return all(verdict.ok for verdict in self.verdicts)

    def record(self) -> dict[str, Any]:
        """Return the content of ``--json``."""
        return {
            "format": "warpir-model-check",
            "version": 1,
            "ok": self.ok,
            "model": self.model,
            "checks": [asdict(verdict) for verdict in self.verdicts],
            "seconds": self.seconds,
            "versions": versions(),
        }


def load_and_check(
    config: InsertConfig, photo: NDArray[np.float32], say: Callable[[str], None]
) -> Report:
    """Load the configured model and check it.

    Args:
        config: Model, device, and what `check_model` asks for.
        photo: Display-encoded, in [0, 1], shape [H, W, 3].
        say: Prints a line.

    Raises:
        InputError: The model cannot be used, or there is no such device.
    """
    device = torch.device(choose_device(config.render.device))
    prior = load_stable_diffusion(config.diffusion, device)
    report = check_model(prior, photo, config, say)
    for notice in prior.notices:
        say(f"notice: {notice}")
    return report


def check_model(
    prior: StableDiffusion,
    photo: NDArray[np.float32],
    config: InsertConfig,
    say: Callable[[str], None],
) -> Report:
    """Measure and judge a model; report each verdict at once.

    Args:
        prior: The model.
        photo: Display-encoded, in [0, 1], shape [H, W, 3].
        config: Prompt, seed, and the settings of a run.
        say: Prints a line.

    Raises:
        ModelError: Its latents or losses are not finite.
    """
    model = _model_of(prior)
    kind = KNOWN.get((prior.resolution, prior.schedule.prediction_type))
    side = f"{prior.resolution} x {prior.resolution} pixels"
    say(f"model: {config.diffusion.model}, sha256 {prior.digest[:16]}...")
    say(
        f"{side}, predicts {prior.schedule.prediction_type}, UNet in {model['unet_precision']}, "
        f"VAE in {model['vae_precision']}, on {prior.device}"
        f" ({kind or 'no Stable Diffusion that the method was made with'})"
    )
    image = torch.from_numpy(photo).permute(2, 0, 1)[None].contiguous()
    prompts = make_prompts(config.guidance.prompt or PROMPT, config.adapter)
    verdicts: list[Verdict] = []

    def judged(*new: Verdict) -> None:
        for verdict in new:
            say(verdict.line)
        verdicts.extend(new)

    seed = config.render.seed
    settings = config.guidance
    square = _middle(image).apply(image, prior.resolution)
    figures = prior.self_check(square, prompts.guidance, seed)
    judged(
        judge_noise(figures["noise_error"], _silent_error(prior, square, seed)),
        judge_effect([figures[f"difference_{t}"] for t in CHECK_TIMES]),
        judge_precision(figures["precision"], model["unet_precision"]),
    )
    verdict, lora_seconds = _try_lora(prior, image, prompts, config.adapter, seed)
    judged(verdict)
    verdict, guidance_seconds = _try_guidance(prior, image, prompts, settings, seed)
    judged(verdict)
    seconds = {"lora_step": lora_seconds, "guidance_step": guidance_seconds}
    minutes = (
        config.adapter.lora_steps * lora_seconds + config.optimize.step_count * guidance_seconds
    ) / 60.0
    say(
        f"cost: {lora_seconds:.3g} s per LoRA step, {guidance_seconds:.3g} s per guidance step; "
        f"the {config.adapter.lora_steps} and {config.optimize.step_count} of a run take "
        f"{minutes:.1f} min (class images and rendering come on top)"
    )
    return Report(model, tuple(verdicts), seconds)


def judge_noise(error: float, silent: float) -> Verdict:
    """Judge the error of the noise against that of a zero prediction.

    Args:
        error: Mean squared error at `NOISE_TIME`.
        silent: The same of a zero prediction; 1 where that is the noise, less where it is v.
    """
    share = error / silent
    return Verdict(
        "noise",
        share < NOISE_ERROR_MAX,
        f"mean squared error {error:.3g} at t = {NOISE_TIME}, {share:.0%} of saying nothing",
        f"below {NOISE_ERROR_MAX:.0%}; wrong or random weights, or a wrong prediction_type",
        {"error": error, "error_of_nothing": silent},
    )


def judge_effect(sizes: Sequence[float]) -> Verdict:
    """Judge the change of the prediction by the prompt, root mean square by `CHECK_TIMES`."""
    by_time = dict(zip(CHECK_TIMES, sizes, strict=True))
    return Verdict(
        "prompt",
        all(EFFECT_MIN < size < EFFECT_MAX for size in sizes),
        "effect by t " + ", ".join(f"{t}: {size:.2g}" for t, size in by_time.items()),
        f"between {EFFECT_MIN:g} and {EFFECT_MAX:g}; wrong text encoder or tokenizer",
        {f"effect_{t}": size for t, size in by_time.items()},
    )


def judge_precision(cosine: float, precision: str) -> Verdict:
    """Judge the cosine between the prompt's effect as computed and in fp32."""
    known = "fp32, nothing is lost" if precision == "fp32" else f"{precision}, cosine {cosine:.4f}"
    return Verdict(
        "precision",
        cosine >= LEAST_COSINE,
        f"the prompt's effect in {known}",
        f"at least {LEAST_COSINE}; a run would go on in fp32: use --precision fp32",
        {"cosine": cosine},
    )


def judge_lora(before: float, after: float) -> Verdict:
    """Judge the error on fixed draws from the photo, before and after the LoRA was trained."""
    return Verdict(
        "LoRA",
        after < before,
        f"error on the photo {before:.5g} before and {after:.5g} after {LORA_STEPS} steps",
        "a fall",
        {"error_before": before, "error_after": after},
    )


def judge_gradient(norms: Sequence[float]) -> Verdict:
    """Judge the norms of guidance gradients; nan where there was no finite one."""
    bad = sum(not (math.isfinite(norm) and norm > 0.0) for norm in norms)
    return Verdict(
        "guidance",
        bad == 0,
        f"{len(norms) - bad} of {len(norms)} gradients usable",
        "all of them; try --vae-precision fp32",
        {"unusable": float(bad), "steps": float(len(norms))},
    )


def _model_of(prior: StableDiffusion) -> dict[str, Any]:
    return {
        "name": prior.name,
        "sha256": prior.file_hashes,
        "resolution": prior.resolution,
        "prediction_type": prior.schedule.prediction_type,
        "unet_precision": prior.precision["unet"],
        "vae_precision": prior.precision["vae"],
        "device": str(prior.device),
    }


def _middle(image: Tensor) -> Crop:
    """Return the largest square in the middle."""
    height, width = image.shape[-2:]
    side = min(height, width)
    return Crop((width - side) / 2.0, (height - side) / 2.0, side)


@torch.no_grad()
def _silent_error(prior: StableDiffusion, square: Tensor, seed: int) -> float:
    """Return the error of the noise where the network predicts 0, for the same photo and time."""
    latents = prior.encode(square).cpu()
    noise = torch.randn(latents.shape, generator=torch.Generator().manual_seed(seed))
    t = torch.tensor([NOISE_TIME])
    noisy = prior.schedule.add_noise(latents, noise, t)
    predicted = prior.schedule.to_noise(torch.zeros_like(noisy), noisy, t)
    return float((predicted - noise).square().mean())


class _StepClock:
    """Seconds per step, without the first ones."""

    def __init__(self, device: torch.device) -> None:
        self.device, self.count, self.start = device, 0, math.nan

    def tick(self) -> None:
        """Count a finished step."""
        self.count += 1
        if self.count == WARM_STEPS:
            self.start = self._now()

    def seconds(self) -> float:
        """Return the mean of the steps since the first ones [s]."""
        return (self._now() - self.start) / (self.count - WARM_STEPS)

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        return time.perf_counter()


def _try_lora(
    prior: StableDiffusion, image: Tensor, prompts: Prompts, adapter: PersonalizeSettings, seed: int
) -> tuple[Verdict, float]:
    """Train a LoRA for a few steps without class images; return with it attached."""
    clock, spent = _StepClock(prior.device), [math.nan]

    def on_step(training: LoraTraining) -> None:
        clock.tick()
        if training.step_count == LORA_STEPS:
            spent[0] = clock.seconds()

    settings = replace(adapter, class_images=0, lora_steps=LORA_STEPS, lora_rate=LORA_RATE)
    learnt = personalize(prior, image, prompts, settings, seed, None, on_step=on_step)
    assert learnt.evaluation is not None
    return judge_lora(*learnt.evaluation), spent[0]


def _try_guidance(
    prior: StableDiffusion, image: Tensor, prompts: Prompts, settings: GuidanceSettings, seed: int
) -> tuple[Verdict, float]:
    """Compute guidance gradients of the photo for some steps."""
    image = image.to(prior.device)
    mask = torch.zeros(image.shape[-2:])
    height, width = mask.shape
    mask[height // 3 : height - height // 3, width // 3 : width - width // 3] = 1.0
    guide = Guidance(prior, prompts.guidance, settings, mask, GUIDANCE_STEPS, seed, "scene")
    guide.ensure_precision(image)
    clock, norms = _StepClock(prior.device), []
    for step in range(GUIDANCE_STEPS):
        try:
            gradient = guide.gradient(image, step)
        except NonFiniteError:
            norms.append(math.nan)
            break
        norms.append(math.nan if gradient is None else float(gradient.norm()))
        clock.tick()
    return judge_gradient(norms), clock.seconds()


def write_report(path: str, report: Report) -> None:
    """Write a report as JSON.

    Raises:
        InputError: The file cannot be written.
    """
    with disk_errors(path):
        write_file(Path(path), json_bytes(report.record()))
