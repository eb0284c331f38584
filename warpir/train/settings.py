"""How the light regressor is trained."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingSettings:
    """How a network is trained."""

    batch: int = 512
    learning_rate: float = 1e-3
    weight_decay: float = 0.05
    warmup_steps: int = 150
    """After every start: Adam's moments are kept, but the scenes are new."""
    constant_share: float = 0.5
    """Share of the planned training at full rate; then it falls linearly."""
    final_rate: float = 0.01
    """Share of the learning rate that is left at the end."""
    clip: float = 1.0
    """Largest norm of a step's gradient."""
    average: float = 0.998
    """Decay of the moving average of the weights."""
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
    validate_minutes: float = 0.5
    save_minutes: float = 2.0
    compile: bool = False
    """``torch.compile`` on CUDA."""
    step_limit: int = 0
    """Steps after which the training is complete, whatever the clock says; 0: no such limit."""
