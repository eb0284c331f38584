"""The optimisation: light and tone curves follow a gradient on the composite (DiPIR, section 4.3).

    texels  = rasterised lobes of both lights, fused as far as the schedule says (S 1-7)
    image   = render and compose(texels, curves)
    d_image = guidance.gradient(image, step)          what a diffusion model, or a test, asks for
    Adam on d_image and on the regularisers (eq. 9)

Everything random is a function of the seed and the step, and the whole state is plain tensors and
numbers: a run that was stopped and restored ends as if it had not been.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from warpir.errors import ExitCode, InputError
from warpir.fusion import fuse
from warpir.light import Light, Lobes
from warpir.optimize_settings import OptimizeSettings
from warpir.regularizers import bend, chroma, consistency, spread
from warpir.sg_light import LightBounds, SGLight, narrowest
from warpir.tone import ToneCurve
from warpir.transport_rows import TransportSettings
from warpir.view import Frame, View, expected_light

BAD_STEPS_MAX = 5
"""Steps in a row without a finite gradient that end the run."""
RETRACE_EVERY = 25
"""Steps between two looks at whether the light has left what was expected of it."""
SCORE_SEED = 0x5C0E5
"""Added to the seed for the renders that judge a state."""
CHECK_SEED = 7919


class Guide(Protocol):
    """Says what looks right: a diffusion model's guidance, or a stand-in with a known answer."""

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        """Return the loss gradient of an image, or None when this step has none that is finite.

        Args:
            image: Display-encoded composite, detached, shape [1, 3, H, W].
            step: From 0.
        """

    def score(self, image: Tensor) -> float | None:
        """Return how wrong an image looks, lower is better; None when that is unknown."""

    def state_dict(self) -> dict[str, Any]:
        """Return what a later run needs to go on: tensors and plain values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""


class Unknowns(torch.nn.Module):
    """All that is optimised: two lights and four curves.

    Args:
        light_fg: Lights the object.
        light_shadow: Casts its shadow.
    """

    def __init__(self, light_fg: SGLight, light_shadow: SGLight) -> None:
        super().__init__()
        self.light_fg, self.light_shadow = light_fg, light_shadow
        self.curve_fg, self.curve_shadow = ToneCurve(1), ToneCurve(3)

    @staticmethod
    def start(lobes: Lobes | None, level: float, settings: OptimizeSettings) -> Unknowns:
        """Return the unknowns at their start.

        Args:
            lobes: A light to start from, or None for an even one.
            level: Radiance of that even light, relative [W/(m^2 sr)].
            settings: Count and bounds of the lobes.
        """
        bounds = LightBounds(
            narrowest(settings.light_height), settings.chroma_limit, settings.intensity_limit
        )

        def light() -> SGLight:
            if lobes is not None:
                return SGLight(lobes, level, bounds)
            return SGLight.uniform(settings.lobes, level, bounds)

        return Unknowns(light(), light())


@dataclass(frozen=True)
class Recovered:
    """What an optimisation found."""

    lobes_fg: Lobes
    lobes_shadow: Lobes
    curve_fg: ToneCurve
    curve_shadow: ToneCurve
    step: int
    """The step whose state this is: the best one, or the last."""
    score: float | None
    """The guidance's score of it, lower is better."""
    history: list[dict[str, float]]
    """One entry a step."""


@dataclass
class State:
    """Where an optimisation stands, beside its parameters and Adam's moments."""

    step: int = 0
    """Steps that are done."""
    history: list[dict[str, float]] = field(default_factory=list)
    bad_steps: int = 0
    """In a row."""
    skipped: int = 0
    retraced: int = 0
    best_score: float | None = None
    best_step: int = -1


class Optimization:
    """One optimisation of one frame.

    Args:
        frame: Scene, photo, tone operator.
        guide: What looks right.
        settings: Steps, rates, weights, schedules.
        unknowns: Where to start; changed in place.
        cache: Folder for traced rows, or None.
        transport: How finely light is traced; the heights are those of the settings.
    """

    def __init__(
        self,
        frame: Frame,
        guide: Guide,
        settings: OptimizeSettings,
        unknowns: Unknowns,
        cache: Path | None = None,
        transport: TransportSettings | None = None,
    ) -> None:
        self.frame, self.guide, self.settings, self.cache = frame, guide, settings, cache
        self.unknowns = unknowns
        self.rows = transport
        if transport is None and settings.integrator == "transport":
            self.rows = TransportSettings(
                height_fg=settings.object_light_height, height_shadow=settings.light_height
            )
        self.optimizer = torch.optim.Adam(
            self._groups(), betas=(settings.adam_beta1, settings.adam_beta2), eps=1e-15
        )
        self.state = State()
        self.best: dict[str, Tensor] = {}
        with torch.no_grad():
            self.expected = expected_light(*self.lights(0.0))
        self.view = self._trace()

    def _groups(self) -> list[dict[str, Any]]:
        """Return Adam's parameter groups; ``rate`` is the rate before the schedule."""
        settings, groups = self.settings, []
        for light in (self.unknowns.light_fg, self.unknowns.light_shadow):
            for parameter, rate in (
                (light.log_intensity, settings.rate_intensity),
                (light.chroma, settings.rate_chroma),
                (light.axis, settings.rate_axis),
                (light.log_sigma, settings.rate_width),
            ):
                groups.append({"params": [parameter], "rate": rate, "lr": rate})
        curves = [*self.unknowns.curve_fg.parameters(), *self.unknowns.curve_shadow.parameters()]
        if settings.tone_curve:
            groups.append({"params": curves, "rate": settings.rate_tone, "lr": settings.rate_tone})
        else:
            for parameter in curves:
                parameter.requires_grad_(False)
        return groups

    def _trace(self) -> View:
        return View(self.frame, self.expected, self.rows, self.settings.mis_samples, self.cache)

    def fusion(self, step: int) -> float:
        """Return ``s_fuse`` of a step: how far both lights have become one [1]."""
        if self.settings.fusion == "schedule":
            return step / max(self.settings.steps - 1, 1)
        return 0.0

    def lights(self, scale: float, height: int | None = None) -> tuple[Tensor, Tensor]:
        """Return the maps that light the object and cast its shadow, shape [He, We, 3].

        Args:
            scale: ``s_fuse`` [1].
            height: Rows; the settings' when absent.
        """
        height = height or self.settings.light_height
        texels_fg = self.unknowns.light_fg.texels(height)
        if self.settings.fusion == "single":
            return texels_fg, texels_fg
        return fuse(texels_fg, self.unknowns.light_shadow.texels(height), scale)

    def image(self, scale: float, seed: int) -> Tensor:
        """Return the composite under the current unknowns, shape [1, 3, H, W]."""
        return self.view.image(
            *self.lights(scale), self.unknowns.curve_fg(), self.unknowns.curve_shadow(), seed
        )

    def run(self, on_step: Callable[[Optimization], None] = lambda _: None) -> Recovered:
        """Take all steps that are left; `on_step` sees the state after each.

        Raises:
            InputError: The gradient stayed non-finite (`ExitCode.NUMERIC`).
        """
        while self.state.step < self.settings.steps:
            self.step()
            on_step(self)
        return self.recovered()

    def step(self) -> None:
        """Take one step."""
        step, settings = self.state.step, self.settings
        self._retrace_if_stale(step)
        scale = self.fusion(step)
        texels = self.lights(scale)
        curves = self.unknowns.curve_fg(), self.unknowns.curve_shadow()
        image = self.view.image(*texels, *curves, self.frame.seed + step)
        d_image = self.guide.gradient(image.detach(), step)
        terms = self._regularizers(*curves)
        penalty = torch.stack([weight * term for weight, term in terms.values()]).sum()
        self.optimizer.zero_grad()
        if d_image is not None:
            torch.autograd.backward([image, penalty], [d_image, None])
        is_finite = d_image is not None and self._gradients_are_finite()
        if is_finite:
            for group in self.optimizer.param_groups:
                group["lr"] = group["rate"] * self._rate_factor(step)
            self.optimizer.step()
            self.unknowns.light_fg.project()
            self.unknowns.light_shadow.project()
        self._count(is_finite)
        entry = {name: float(term.detach()) for name, (_, term) in terms.items()}
        if d_image is not None:
            entry["gradient"] = float(d_image.norm())
        self.state.step = step + 1
        self.state.history.append(entry)
        every = settings.score_every
        if every and (self.state.step % every == 0 or self.state.step == settings.steps):
            self._keep_if_best(entry)

    def _regularizers(self, *curves: Any) -> dict[str, tuple[float, Tensor]]:
        """Return the weighted terms beside the guidance (eq. 9 and ours)."""
        settings, height = self.settings, self.settings.light_height
        light_fg, light_shadow = self.unknowns.light_fg, self.unknowns.light_shadow
        terms = {"chroma": (settings.chroma, 0.5 * (chroma(light_fg) + chroma(light_shadow)))}
        if settings.fusion != "single":
            texels_shadow = light_shadow.texels(height)
            terms["consistency"] = (
                settings.consistency,
                consistency(light_fg.texels(height), texels_shadow),
            )
            terms["spread"] = settings.spread, spread(texels_shadow)
        if settings.tone_curve:
            terms["bend"] = settings.bend, bend(curves[0]) + bend(curves[1])
        return terms

    def _rate_factor(self, step: int) -> float:
        """Return 1 in the first half, then a cosine that falls to 0.1."""
        share = max(2.0 * step / max(self.settings.steps, 1) - 1.0, 0.0)
        return float(0.1 + 0.9 * 0.5 * (1.0 + np.cos(np.pi * share)))

    def _gradients_are_finite(self) -> bool:
        found = [p.grad for p in self.unknowns.parameters() if p.grad is not None]
        return bool(torch.stack([g.isfinite().all() for g in found]).all())

    def _count(self, is_finite: bool) -> None:
        state = self.state
        state.bad_steps = 0 if is_finite else state.bad_steps + 1
        state.skipped += not is_finite
        if state.bad_steps >= BAD_STEPS_MAX:
            raise InputError(
                "guidance",
                f"no finite gradient in {BAD_STEPS_MAX} steps in a row (step {state.step})",
                "try --precision fp32; the last checkpoint holds the state before",
                ExitCode.NUMERIC,
            )

    def _retrace_if_stale(self, step: int) -> None:
        """Trace light transport again once the light has left what was expected of it."""
        if self.view.transport is None or step == 0 or step % RETRACE_EVERY:
            return
        with torch.no_grad():
            texels = self.lights(self.fusion(step))
            if self.view.staleness(*texels) > self.settings.retrace_at:
                self.expected = expected_light(*texels)
                self.view = self._trace()
                self.state.retraced += 1

    def _keep_if_best(self, entry: dict[str, float]) -> None:
        """Judge the state as it would be delivered, and keep it if it is the best so far.

        Only the second half counts: before it, the lights were not the ones that fusion leads to.
        """
        state = self.state
        with torch.no_grad():
            scale = 1.0 if self.settings.fusion == "schedule" else 0.0
            score = self.guide.score(self.image(scale, self.frame.seed + SCORE_SEED))
        if score is None:
            return
        entry["score"] = score
        is_late = 2 * state.step >= self.settings.steps
        if is_late and (state.best_score is None or score < state.best_score):
            state.best_score, state.best_step = score, state.step
            self.best = {k: v.detach().clone() for k, v in self.unknowns.state_dict().items()}

    def recovered(self) -> Recovered:
        """Return the best state that was scored, else the last."""
        if self.best:
            self.unknowns.load_state_dict(self.best)
        step = self.state.best_step if self.best else self.state.step
        unknowns = self.unknowns
        return Recovered(
            unknowns.light_fg.lobes(),
            unknowns.light_shadow.lobes(),
            unknowns.curve_fg,
            unknowns.curve_shadow,
            step,
            self.state.best_score,
            self.state.history,
        )

    def final_lights(self, height: int) -> tuple[Light, Light]:
        """Return the delivered lights as maps of ``height`` rows; one and the same when fused."""
        with torch.no_grad():
            fg, shadow = self.lights(1.0 if self.settings.fusion == "schedule" else 0.0, height)
        light_fg = Light(texels=fg.cpu().numpy())
        if self.settings.fusion in ("schedule", "single"):
            return light_fg, light_fg
        return light_fg, Light(texels=shadow.cpu().numpy())
