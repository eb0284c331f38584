"""How the networks are trained: settings, the optimiser, its rate, and the moving average."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn


@dataclass(frozen=True)
class StepSettings:
    """How a network is stepped."""

    batch: int
    learning_rate: float
    weight_decay: float = 0.05
    warmup_steps: int = 150
    """After every start: Adam's moments are kept, but the scenes are new."""
    constant_share: float = 0.5
    """Share of the planned training at full rate; then it falls."""
    clip: float = 1.0
    """Largest norm of a step's gradient."""
    average: float = 0.998
    """Decay of the moving average of the weights."""
    validate_minutes: float = 0.5


@dataclass(frozen=True)
class TrainingSettings(StepSettings):
    """How the light regressor is trained; its rate falls linearly."""

    batch: int = 512
    learning_rate: float = 1e-3
    final_rate: float = 0.01
    """Share of the learning rate that is left at the end."""
    label_sigma_deg: float = 6.0
    """Width of the direction's soft label [deg]."""
    crop_share: float = 0.5
    """Share of photos of which a random part is stretched over the picture."""
    erase_share: float = 0.3
    """Chance of each of three patches to be painted over."""
    grey_share: float = 0.05
    """Share of photos without colour; their light has none either."""
    noise: float = 0.02
    """Largest standard deviation of noise on the encoded photo."""
    save_minutes: float = 2.0
    compile: bool = False
    """``torch.compile`` on CUDA."""
    step_limit: int = 0
    """Steps after which the training is complete, whatever the clock says; 0: no such limit."""


@dataclass(frozen=True)
class CameraSettings(StepSettings):
    """How the network that estimates cameras is trained; its rate falls along a cosine to 0."""

    batch: int = 256
    learning_rate: float = 1.2e-3
    constant_share: float = 0.4
    validation_photos: int = 1536


def make_optimizer(network: nn.Module, settings: StepSettings, **more: bool) -> torch.optim.AdamW:
    """Return AdamW that does not pull norms, biases and the tokens that ask toward 0."""
    pulled, plain = list[nn.Parameter](), list[nn.Parameter]()
    for name, p in network.named_parameters():
        (plain if p.dim() < 2 or name.endswith("asking") else pulled).append(p)
    groups = [
        {"params": pulled, "weight_decay": settings.weight_decay},
        {"params": plain, "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, betas=(0.9, 0.99), **more)


def left_to_fall(settings: StepSettings, progress: float) -> float:
    """Return 1 while the rate is constant, then what is left of the time until the end [1]."""
    return min((1.0 - progress) / (1.0 - settings.constant_share), 1.0)


def warmed_up(settings: StepSettings, share: float, steps: int) -> float:
    """Return a share of the learning rate, which grows over the first steps."""
    return settings.learning_rate * share * min((steps + 1) / settings.warmup_steps, 1.0)


def follow(average: nn.Module, network: nn.Module, steps: int, decay: float) -> None:
    """Move the average of the weights toward them; at first it follows closely."""
    share = 1.0 - min(decay, (1.0 + steps) / (10.0 + steps))
    held, weights = ([p.detach() for p in n.parameters()] for n in (average, network))
    torch._foreach_lerp_(held, weights, share)
