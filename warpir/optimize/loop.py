"""The loop of every optimisation: unknowns follow a gradient on the composite (DiPIR, section 4.3).

    image   = render and compose(unknowns)            `LightOptimization`,
    `warpir.optimize.materials` d_image = guide.gradient(image, step)             what a diffusion
    model, or a test, asks for Adam on d_image and on the regularisers (eq. 9)

Everything random is a function of the seed and the step, and the whole state is plain tensors and
numbers: a run that was stopped and restored ends as if it had not been.

A step whose picture, loss or gradient is not finite is not taken: it is counted, and the learning
rate is halved until steps are good again. What lacks memory is tried once more.
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

from warpir.app.optimize_settings import OptimizeSettings
from warpir.core.errors import ExitCode, InputError
from warpir.core.memory import Memory
from warpir.scene.camera import Camera

BAD_STEPS_MAX = 5
"""Steps in a row without a finite gradient that end the run."""
BACK_OFF = 0.5
"""Share of the learning rate that a step without a finite gradient leaves to the next ones."""
GOOD_STEPS = 10
"""Steps in a row after which it doubles again, up to what the schedule says."""
LOWER = "--guidance-width"
"""What lowers the memory of a step."""
SCORE_SEED = 0x5C0E5
"""Added to the seed for the renders that judge a state."""


Rendered = tuple[Tensor, dict[str, tuple[float, Tensor]]]
"""A picture, and the regularisers with their weights."""

log = logging.getLogger(__name__)


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


@dataclass
class State:
    """Where an optimisation stands, beside its parameters and Adam's moments."""

    step: int = 0
    """Steps that are done."""
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry a step: norm of the image's gradient, regularisers, and sometimes the score."""
    bad_steps: int = 0
    """Without a finite gradient, in a row."""
    skipped: int = 0
    """Without a finite gradient, in all."""
    rate_share: float = 1.0
    """What bad steps have left of the learning rate [1]."""
    good_steps: int = 0
    """Since `rate_share` fell or rose."""
    best_score: float | None = None
    """Lower is better."""
    best_step: int = -1
    """The step after which that state stood; -1: none was scored."""


class Optimization(ABC):
    """A loop over some unknowns; subclasses say how they become an image.

    Args:
        unknowns: What is optimised, from where it starts; changed in place.
        groups: Adam's parameter groups: ``params`` and ``rate``, the rate before the schedule.
        guide: What looks right.
        settings: Steps, rates, weights, schedules.
        seed: Base seed of the renders.
        memory: Is told where memory was short.
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
            [{**group, "lr": settings.rate_of_all * group["rate"]} for group in groups],
            betas=(settings.adam_beta1, settings.adam_beta2),
            eps=1e-15,
        )
        self.state = State()
        self.best: dict[str, Tensor] = {}

    @abstractmethod
    def image(self, step: int) -> Tensor:
        """Return the composite of a step, differentiable, shape [1, 3, H, W]."""

    @abstractmethod
    def final_image(self, seed: int) -> Tensor:
        """Return the composite as the current state would be delivered, shape [1, 3, H, W]."""

    @abstractmethod
    def terms(self) -> dict[str, tuple[float, Tensor]]:
        """Return the regularisers by name, each with its weight."""

    @abstractmethod
    def describe(self, camera: Camera) -> str:
        """Return in a few words where the unknowns stand, for a person who waits."""

    @abstractmethod
    def project(self) -> None:
        """Bring the unknowns back within their bounds."""

    @abstractmethod
    def prepare(self, step: int) -> None:
        """Do what must be done before a step's image is rendered."""

    def run(self, on_step: Callable[[Self], None] = lambda _: None) -> None:
        """Take all steps that are left; ``on_step`` sees the loop after each. Keep the best state.

        Raises:
            InputError: The gradient stayed non-finite (`ExitCode.NUMERIC`).
        """
        while self.state.step < self.settings.step_count:
            self.step()
            on_step(self)
        if self.best:
            self.unknowns.load_state_dict(self.best)

    def step(self) -> None:
        """Take one step."""
        step = self.state.step
        made = self._rendered(step)
        d_image, terms = None, {}
        if made is not None:
            terms = {name: term.detach() for name, (_, term) in made[1].items()}
            d_image = self.guide.gradient(made[0].detach(), step)
        if d_image is not None and not bool(d_image.isfinite().all()):
            d_image = None
        if d_image is not None:
            # One reference to the graph: a second attempt needs the memory of the first.
            graphs = [made]
            del made
            self.memory.again(
                lambda: self._differentiate(graphs.pop() if graphs else None, d_image, step),
                "the gradient of a step",
                LOWER,
            )
        is_finite = d_image is not None and self._gradients_are_finite()
        if is_finite:
            for group in self.optimizer.param_groups:
                factor = self.settings.rate_of_all * self._rate_factor(step)
                group["lr"] = group["rate"] * factor * self.state.rate_share
            self.optimizer.step()
            self.project()
        self._count(is_finite)
        entry = {name: float(term) for name, term in terms.items()}
        if d_image is not None:
            entry["gradient"] = float(d_image.double().norm())
        # Checkpoints hold no number that JSON lacks.
        entry = {name: value for name, value in entry.items() if np.isfinite(value)}
        self.state.step = step + 1
        self.state.history.append(entry)
        every = self.settings.score_every
        if every and (self.state.step % every == 0 or self.state.step == self.settings.step_count):
            self._keep_if_best(entry)

    def _rendered(self, step: int) -> Rendered | None:
        """Return a step's picture and terms; None where they are certain not to be finite."""

        def render() -> Rendered:
            self.prepare(step)
            return self.image(step), self.terms()

        try:
            return self.memory.again(render, "the picture of a step", LOWER)
        except InputError as error:
            if error.code != ExitCode.NUMERIC:
                raise
            log.warning("step %d: %s", step, error)
            return None

    def _differentiate(self, made: Rendered | None, d_image: Tensor, step: int) -> None:
        """Leave the gradient of the picture and of the terms in the unknowns' ``grad``.

        Args:
            made: What was rendered, used up; None: it is rendered again, which gives the same.
            d_image: Loss gradient of the picture.
            step: From 0.
        """
        image, terms = made or (self.image(step), self.terms())
        self.optimizer.zero_grad()
        roots, gradients = [image], [d_image]
        roots += [weight * term for weight, term in terms.values()]
        gradients += [torch.ones_like(root) for root in roots[1:]]
        torch.autograd.backward(roots, gradients)

    def _rate_factor(self, step: int) -> float:
        """Return 1 in the first half, then a cosine that falls to ``rate_end``."""
        share = max(2.0 * step / max(self.settings.step_count, 1) - 1.0, 0.0)
        end = self.settings.rate_end
        return float(end + (1.0 - end) * 0.5 * (1.0 + np.cos(np.pi * share)))

    def _gradients_are_finite(self) -> bool:
        found = [p.grad for p in self.unknowns.parameters() if p.grad is not None]
        return bool(torch.stack([g.isfinite().all() for g in found]).all())

    def _count(self, is_finite: bool) -> None:
        state = self.state
        state.bad_steps = 0 if is_finite else state.bad_steps + 1
        state.skipped += not is_finite
        state.good_steps = state.good_steps + 1 if is_finite else 0
        if not is_finite:
            state.rate_share *= BACK_OFF
        elif state.rate_share < 1.0 and state.good_steps == GOOD_STEPS:
            state.rate_share, state.good_steps = state.rate_share / BACK_OFF, 0
        if state.bad_steps >= BAD_STEPS_MAX:
            raise InputError(
                "guidance",
                f"no finite gradient in {BAD_STEPS_MAX} steps in a row (step {state.step})",
                "try --precision fp32; the last checkpoint holds the state before",
                ExitCode.NUMERIC,
            )

    def _keep_if_best(self, entry: dict[str, float]) -> None:
        """Judge the state as it would be delivered, and keep it if it is the best so far.

        Only the second half counts: before it, the lights were not the ones that fusion leads to.
        """
        state = self.state
        with torch.no_grad():
            score = self.guide.score(self.final_image(self.seed + SCORE_SEED))
        if score is None or not np.isfinite(score):
            return
        entry["score"] = score
        is_late = 2 * state.step >= self.settings.step_count
        if is_late and (state.best_score is None or score < state.best_score):
            state.best_score, state.best_step = score, state.step
            self.best = {k: v.detach().clone() for k, v in self.unknowns.state_dict().items()}

    def state_dict(self) -> dict[str, Any]:
        """Return everything that a later run needs to go on: nested tensors and plain values."""
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

    Beside the tensors of a checkpoint they are short; as text they would outgrow it.
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
