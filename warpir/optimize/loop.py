"""Optimisation loop: unknowns follow a diffusion model's gradient (DiPIR, section 4.3).

    for step in range(step_count):
        composite = render and compose(unknowns)           `Optimization.composite`, of a subclass
        d_image = guide.gradient(composite.image, step)    of a diffusion model or a test
        composite.backward(d_image)                        with the regularisers (eq. 9)
        Adam's step, then back within bounds               `Optimization.step`

All random numbers are functions of the seed and the step, and the state is plain tensors and
numbers: a run that was stopped and restored ends with the same bits as one that was not.

A step whose composite, loss or gradient is not finite is skipped and counted, and the learning rate
is halved until steps are finite again. A gradient that lacks memory is computed a second time.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

import numpy as np
import torch
from torch import Tensor

from warpir.app.settings import OptimizeSettings
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import Memory
from warpir.diffusion.prior import BAD_STEPS_MAX, BadSteps
from warpir.scene.camera import Camera

BACK_OFF = 0.5
"""Factor on the learning rate after a step without a finite gradient."""
GOOD_STEPS = 10
"""Finite steps in a row after which the rate doubles again, up to the schedule's."""
LOWER = "--guidance-width"
"""Flag that lowers the memory of a step."""
SCORE_SEED = 0x5C0E5
"""Added to the seed for the renders that are scored."""

log = logging.getLogger(__name__)


class Guide(Protocol):
    """Gradient and score of an image: a diffusion model's, or a test's with a known answer."""

    def gradient(self, image: Tensor, step: int) -> Tensor | None:
        """Return the loss gradient of an image, or None when this step has none that is finite.

        Args:
            image: Display-encoded composite, detached, shape [1, 3, H, W].
            step: From 0.
        """

    def score(self, image: Tensor) -> float | None:
        """Return the loss of an image, lower is better; None when it is unknown."""

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs: tensors and plain values."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""


@dataclass(frozen=True)
class Composite:
    """The composite of one step, and the regularisers at the same unknowns."""

    image: Tensor
    """Display-encoded, differentiable, shape [1, 3, H, W]."""
    terms: dict[str, tuple[float, Tensor]] = field(default_factory=dict)
    """Weight and value of each regulariser."""

    def backward(self, d_image: Tensor) -> None:
        """Add the gradient of ``<d_image, image> + sum(weight * term)`` (eq. 9) to ``grad``."""
        weighted = [weight * term for weight, term in self.terms.values()]
        ones = [torch.ones_like(term) for term in weighted]
        torch.autograd.backward([self.image, *weighted], [d_image, *ones])


@dataclass
class State(BadSteps):
    """Progress of an optimisation, beside its parameters and Adam's moments."""

    step: int = 0
    """Number of finished steps."""
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry a step: norm of the image's gradient, regularisers, and sometimes the score."""
    rate_share: float = 1.0
    """Factor on the learning rate that bad steps have left [1]."""
    good_steps: int = 0
    """Number of finite steps since `rate_share` last changed."""
    best_score: float | None = None
    """Lowest score so far."""
    best_step: int = -1
    """Step after which `best_score` was reached; -1: none was scored."""


class Optimization(ABC):
    """A loop over some unknowns; subclasses compose the image.

    Args:
        unknowns: Parameters at their start; changed in place.
        groups: Adam's parameter groups: ``params`` and ``rate``, the rate before the schedule.
        guide: Gradient and score of the image.
        settings: Steps, rates, weights, schedules.
        seed: Base seed of the renders.
        memory: Counts the gradients that were computed twice for want of memory.
    """

    def __init__(
        self,
        unknowns: torch.nn.Module,
        groups: list[dict[str, Any]],
        guide: Guide,
        settings: OptimizeSettings,
        seed: int,
        memory: Memory | None = None,
    ) -> None:
        self.memory = memory or Memory()
        self.unknowns, self.guide, self.settings, self.seed = unknowns, guide, settings, seed
        # Adam ignores the overall scale of a gradient; this eps keeps that true of tiny ones.
        self.optimizer = torch.optim.Adam(
            [{**group, "lr": settings.rate * group["rate"]} for group in groups],
            betas=(settings.adam_beta1, settings.adam_beta2),
            eps=1e-15,
        )
        self.state = State()
        self.best: dict[str, Tensor] = {}

    @abstractmethod
    def composite(self, step: int) -> Composite:
        """Return the composite of a step, with its regularisers."""

    @abstractmethod
    def final_image(self, seed: int) -> Tensor:
        """Return the composite as the current state would be delivered, shape [1, 3, H, W]."""

    @abstractmethod
    def describe(self, camera: Camera) -> str:
        """Return the unknowns' values in a few words, for the progress line."""

    @abstractmethod
    def project(self) -> None:
        """Bring the unknowns back within their bounds."""

    @abstractmethod
    def prepare(self, step: int) -> None:
        """Update what a step's composite depends on besides the unknowns."""

    def run(self, on_step: Callable[[Self], None] = lambda _: None) -> None:
        """Take the remaining steps, ``on_step`` after each, and restore the best state.

        Raises:
            InputError: The gradient stayed non-finite (`ExitCode.NUMERIC`).
        """
        while self.state.step < self.settings.step_count:
            self.step()
            on_step(self)
        if self.best:
            self.unknowns.load_state_dict(self.best)

    def step(self) -> None:
        """Take one step of Adam; a step without a finite gradient changes no unknown.

        Raises:
            InputError: Memory is short, or there was no finite gradient for too long.
        """
        step = self.state.step
        before = self.guide.state_dict()  # the guide counts and remembers gradients
        numbers = self.memory.again(
            lambda: self.differentiate(step),
            "the gradient of a step",
            LOWER,
            lambda: self.guide.load_state_dict(before),
        )
        is_finite = "gradient" in numbers and self._gradients_are_finite()
        if is_finite:
            self._set_rates(step)
            self.optimizer.step()
            self.project()
        self._count(is_finite)
        self.state.step += 1
        self.state.history.append(numbers)
        every = self.settings.score_every
        if every and (self.state.step % every == 0 or self.state.step == self.settings.step_count):
            self._keep_if_best(numbers)

    def differentiate(self, step: int) -> dict[str, float]:
        """Set the unknowns' ``grad`` to the gradient of guidance and regularisers (eq. 9).

        Returns:
            Finite values of the regularisers, and the norm of the guidance as ``gradient``, which
            is absent where guidance is not finite; ``grad`` is then empty.
        """
        self.optimizer.zero_grad()
        try:
            self.prepare(step)
            composite = self.composite(step)
        except InputError as error:
            if error.code != ExitCode.NUMERIC:
                raise
            log.warning("step %d: %s", step, error)
            return {}
        d_image = self.guide.gradient(composite.image.detach(), step)
        numbers = {name: float(term.detach()) for name, (_, term) in composite.terms.items()}
        if d_image is not None and bool(d_image.isfinite().all()):
            composite.backward(d_image)
            numbers["gradient"] = float(d_image.double().norm())
        return {name: value for name, value in numbers.items() if np.isfinite(value)}

    def _set_rates(self, step: int) -> None:
        """Give each group its rate: constant in the first half, then falling by a cosine."""
        share = self.settings.rate * self._rate_factor(step) * self.state.rate_share
        for group in self.optimizer.param_groups:
            group["lr"] = group["rate"] * share

    def _rate_factor(self, step: int) -> float:
        """Return 1 in the first half, then a cosine that falls to ``rate_end``."""
        share = max(2.0 * step / max(self.settings.step_count, 1) - 1.0, 0.0)
        end = self.settings.rate_end
        return float(end + (1.0 - end) * 0.5 * (1.0 + np.cos(np.pi * share)))

    def _gradients_are_finite(self) -> bool:
        gradients = [p.grad for p in self.unknowns.parameters() if p.grad is not None]
        return bool(torch.stack([g.isfinite().all() for g in gradients]).all())

    def _count(self, is_finite: bool) -> None:
        """Count a step, and lower the learning rate after one that is not finite.

        Raises:
            InputError: `BAD_STEPS_MAX` in a row are not (`ExitCode.NUMERIC`).
        """
        state = self.state
        if state.count_step(is_finite):
            raise InputError(
                "guidance",
                f"no finite gradient in {BAD_STEPS_MAX} steps in a row (step {state.step})",
                "try --precision fp32; the last checkpoint holds the state before",
                ExitCode.NUMERIC,
                reason="guidance.no_finite_gradient",
            )
        state.good_steps = state.good_steps + 1 if is_finite else 0
        if not is_finite:
            state.rate_share *= BACK_OFF
        elif state.rate_share < 1.0 and state.good_steps == GOOD_STEPS:
            state.rate_share, state.good_steps = state.rate_share / BACK_OFF, 0

    def _keep_if_best(self, numbers: dict[str, float]) -> None:
        """Score the state as it would be delivered, and keep it if it is the best so far.

        Only states of the second half are kept: before it, the two lights are not fused.
        """
        state = self.state
        with torch.no_grad():
            score = self.guide.score(self.final_image(self.seed + SCORE_SEED))
        if score is None or not np.isfinite(score):
            return
        numbers["score"] = score
        is_late = 2 * state.step >= self.settings.step_count
        if is_late and (state.best_score is None or score < state.best_score):
            state.best_score, state.best_step = score, state.step
            self.best = {k: v.detach().clone() for k, v in self.unknowns.state_dict().items()}

    def state_dict(self) -> dict[str, Any]:
        """Return the state that a resumed run needs: nested tensors and plain values."""
        moments = self.optimizer.state_dict()["state"]
        return {
            "state": vars(self.state) | {"history": _columns(self.state.history)},
            "unknowns": dict(self.unknowns.state_dict()),
            "best": dict(self.best),
            "adam": {str(index): dict(entry) for index, entry in moments.items()},
            "guide": self.guide.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from `state_dict`."""
        self.state = State(**state["state"])
        self.state.history = _rows(state["state"]["history"], self.state.step)
        self.unknowns.load_state_dict(state["unknowns"])
        self.best = dict(state["best"])
        packed = self.optimizer.state_dict()
        packed["state"] = {int(index): dict(entry) for index, entry in state["adam"].items()}
        self.optimizer.load_state_dict(packed)
        self.guide.load_state_dict(state["guide"])


def _columns(history: Sequence[Mapping[str, float]]) -> dict[str, Tensor]:
    """Return a history as one tensor a name, NaN where a step has no such number.

    Tensors, since a long history as JSON would be larger than the rest of a checkpoint.
    """
    names = sorted({name for entry in history for name in entry})
    return {
        name: torch.tensor([entry.get(name, np.nan) for entry in history], dtype=torch.float64)
        for name in names
    }


def _rows(columns: Mapping[str, Tensor], count: int) -> list[dict[str, float]]:
    """Undo `_columns` of ``count`` entries."""
    history: list[dict[str, float]] = [{} for _ in range(count)]
    for name, column in columns.items():
        for entry, value in zip(history, column.tolist(), strict=True):
            if not np.isnan(value):
                entry[name] = value
    return history
