"""The network that estimates cameras from a photo: a distribution over each of its numbers.

A photo is stretched to 64 x 96 pixels and described by fixed features: histograms of the directions
of its edges in 8 x 12 cells and in the whole (histograms of oriented gradients: Dalal and Triggs
2005), the strength of edges and the colour of each cell. Directions are measured in the photo's own
shape, before it was stretched. A perceptron of three layers answers with a histogram of each
number, so that "looks up" and "was corrected to upright" can both stay open. It is small enough to
be trained on two cores.

Photos are blurred alike before they are seen. The panoramas that it learned from are coarse beside
photos, so sharpness would otherwise tell the field of view in training and mislead afterwards.

Frames and signs are those of `warpir.scene.camera`: the camera looks along its -Z with +X right and
+Y up, and its rotation to the world is Ry(yaw) Rx(pitch) Rz(roll).
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from safetensors.torch import load_file, save
from torch import Tensor, nn

from warpir.core.atomic import write_file
from warpir.core.color import LUMINANCE_WEIGHTS
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.model_error import ModelError
from warpir.diffusion.models.weight_files import CALIBRATOR_FORMAT, check_calibrator, values_hash

HEIGHT, WIDTH = 64, 96
"""Size that the network sees [px]; photos of other shapes are stretched."""
CELL = 8
"""Side of the squares that are described [px]."""
DIRECTIONS, FINE_DIRECTIONS = 18, 60
"""Bins over 180 degrees of the directions of edges, of a cell and of the whole photo."""
FEATURES = (HEIGHT // CELL) * (WIDTH // CELL) * (DIRECTIONS + 4) + FINE_DIRECTIONS + 1
BLUR = 0.7
"""Standard deviation of the blur of every photo that the network sees, over the photo's height
times `HEIGHT`: 1 is a row of what it sees."""
MIRRORED = ("roll", "x")
"""Numbers whose distribution turns over when the photo is mirrored."""


class Bins(NamedTuple):
    """The histogram of one number of the camera."""

    low: float
    high: float
    count: int

    def centres(self, like: Tensor) -> Tensor:
        """Return the middle of each bin, shape [K]."""
        step = (self.high - self.low) / self.count
        return self.low + step * (torch.arange(self.count, device=like.device) + 0.5)

    def quantile(self, probability: Tensor, share: float) -> Tensor:
        """Return the value below which a share of each distribution lies, shape [B].

        Args:
            probability: Of each bin, spread evenly within it; rows sum to 1; shape [B, K].
            share: In (0, 1).
        """
        above = probability.cumsum(dim=1)
        index = (above < share).sum(dim=1, keepdim=True).clamp(max=self.count - 1)
        inside = probability.gather(1, index).clamp(min=1e-12)
        below = above.gather(1, index) - inside
        step = (self.high - self.low) / self.count
        position = index + ((share - below) / inside).clamp(0.0, 1.0)
        return self.low + step * position[:, 0]


NUMBERS = {
    "pitch": Bins(-92.0, 64.0, 104),
    "roll": Bins(-45.5, 45.5, 91),
    "focal": Bins(-1.15, 1.45, 65),
    "x": Bins(0.0, 1.0, 41),
    "y": Bins(-0.2, 1.2, 57),
}
"""Pitch [deg], roll [deg], natural logarithm of the focal length over the photo's height, and the
principal point as shares of width and height from the top left; the order of the heads."""


@dataclass(frozen=True)
class CalibratorConfig:
    """Size of the network."""

    hidden: int = 384
    """Features of both hidden layers."""
    dropout: float = 0.35


class CameraNumbers(NamedTuple):
    """Most likely cameras of B photos, and how wrong they may be; shape [B, 5], as `NUMBERS`."""

    value: Tensor
    sigma: Tensor
    """Standard deviations in the same units; 68 % of errors lie within one."""


def soften(photo: Tensor, sigma: Tensor) -> Tensor:
    """Blur pictures by Gaussians of their own.

    Args:
        photo: Shape [B, C, H, W].
        sigma: Standard deviation down and across [px], shape [B, 2]; 0 leaves a picture as it is.
    """
    for axis in (0, 1):
        # The kernel is cut at three standard deviations of the widest picture of the batch.
        reach = max(1, math.ceil(3.0 * float(sigma[:, axis].max())))
        offsets = torch.arange(-reach, reach + 1, device=photo.device, dtype=photo.dtype)
        weights = torch.exp(-0.5 * (offsets / sigma[:, axis : axis + 1].clamp(min=1e-3)) ** 2)
        weights = weights / weights.sum(dim=1, keepdim=True)
        size = photo.shape[2 + axis]
        padding = (0, 0, reach, reach) if axis == 0 else (reach, reach, 0, 0)
        padded = F.pad(photo, padding, mode="replicate")
        photo = torch.zeros_like(photo)
        for k, weight in enumerate(weights.unbind(dim=1)):
            photo.addcmul_(padded.narrow(2 + axis, k, size), weight[:, None, None, None])
    return photo


def blur_sigma(rows: Tensor, aspect: Tensor) -> Tensor:
    """Return the blur [px] down and across of stretched photos, shape [B, 2].

    Args:
        rows: The blur, over the photo's height times `HEIGHT`, shape [B].
        aspect: Width of the photo over its height before it was stretched, shape [B].
    """
    return torch.stack([rows, rows * (WIDTH / HEIGHT) / aspect], dim=1)


def seen(photo: Tensor) -> Tensor:
    """Return photos as the network sees them: stretched to 64 x 96 and blurred.

    Args:
        photo: Display-encoded, shape [B, 3, H, W].
    """
    height, width = photo.shape[2:]
    small = F.interpolate(photo, (HEIGHT, WIDTH), mode="bilinear", antialias=True)
    rows = torch.full((len(photo),), BLUR, device=photo.device)
    return soften(small, blur_sigma(rows, torch.full_like(rows, width / height)).clamp(max=WIDTH))


def describe(photo: Tensor, aspect: Tensor) -> Tensor:
    """Return the features of photos, shape [B, FEATURES].

    Args:
        photo: As `seen` gives it, shape [B, 3, 64, 96].
        aspect: Width over height before it was stretched, shape [B].
    """
    grey = torch.einsum("bchw,c->bhw", photo, photo.new_tensor(LUMINANCE_WEIGHTS))
    padded = F.pad(grey[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    # Per height of the photo; up is positive.
    right = (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) * (WIDTH / HEIGHT) / aspect[:, None, None]
    up = padded[:, :-2, 1:-1] - padded[:, 2:, 1:-1]
    strength = torch.sqrt(right**2 + up**2)
    direction = torch.atan2(up, right) / math.pi % 1.0
    cells = F.avg_pool2d(_directions(direction, strength, DIRECTIONS), CELL)
    edges = cells.sum(dim=1, keepdim=True)
    # The floors keep the noise of even areas from looking like edges.
    parts = [torch.sqrt(cells / (edges + 0.01)), 0.3 * torch.log(edges + 0.003)]
    parts.append(2.0 * F.avg_pool2d(photo, CELL) - 1.0)
    whole = _directions(direction, strength, FINE_DIRECTIONS).mean(dim=(2, 3))
    whole = torch.sqrt(whole / (whole.sum(dim=1, keepdim=True) + 0.005))
    return torch.cat([torch.cat(parts, dim=1).flatten(1), whole, aspect.log()[:, None]], dim=1)


def _directions(direction: Tensor, strength: Tensor, count: int) -> Tensor:
    """Return edges by their direction, each shared by the two nearest bins, [B, count, H, W].

    Args:
        direction: Over 180 degrees, in [0, 1], shape [B, H, W].
        strength: Shape [B, H, W].
        count: Bins, round the circle.
    """
    position = direction * count
    below = position.floor()
    share = position - below
    first = below.long() % count
    bins = strength.new_zeros(len(strength), count, *strength.shape[1:])
    bins.scatter_(1, first[:, None], (strength * (1.0 - share))[:, None])
    return bins.scatter_add_(1, (first[:, None] + 1) % count, (strength * share)[:, None])


class Calibrator(nn.Module):
    """Features of a photo, and perhaps its focal length, to distributions of the numbers."""

    mean: Tensor
    """Of each feature over the training, shape [FEATURES]."""
    deviation: Tensor
    """Standard deviation of each feature over the training, shape [FEATURES]."""
    spread: Tensor
    """Factor on the width of each distribution; calibrated on held-out places, shape [5]."""

    def __init__(self, config: CalibratorConfig) -> None:
        super().__init__()
        self.config = config
        self.record: dict[str, Any] = {}
        """How it was trained; plain values."""
        self.register_buffer("mean", torch.zeros(FEATURES))
        self.register_buffer("deviation", torch.ones(FEATURES))
        self.register_buffer("spread", torch.ones(len(NUMBERS)))
        hidden, last = config.hidden, sum(bins.count for bins in NUMBERS.values())
        self.layers = nn.Sequential(
            nn.Dropout(0.1),
            nn.Linear(FEATURES + 2, hidden),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(hidden, hidden),
            nn.GELU(),
            nn.Dropout(config.dropout),
            nn.Linear(hidden, last),
        )

    def forward(self, features: Tensor, focal: Tensor) -> dict[str, Tensor]:
        """Return the logits of each number's bins, shape [B, K], by the names of `NUMBERS`.

        Args:
            features: As `describe` gives them, shape [B, FEATURES].
            focal: Logarithm of the focal length over the height where it is known, else NaN,
                shape [B].
        """
        known = torch.stack([~focal.isnan(), focal.nan_to_num()], dim=1)
        inputs = torch.cat([(features - self.mean) / self.deviation, known], dim=1)
        counts = [bins.count for bins in NUMBERS.values()]
        return dict(zip(NUMBERS, self.layers(inputs).split(counts, dim=1), strict=True))

    @torch.no_grad()
    def predict(self, photo: Tensor, aspect: Tensor, focal: Tensor) -> CameraNumbers:
        """Return the medians of the distributions and their calibrated standard deviations.

        The network is asked twice, for the photo and for its mirror image, and the distributions
        are averaged: a mirrored photo gives the mirrored camera by construction.

        Args:
            photo: As `seen` gives it, shape [B, 3, 64, 96].
            aspect: Width over height before it was stretched, shape [B].
            focal: As of `forward`.
        """
        both = (describe(picture, aspect) for picture in (photo, photo.flip(-1)))
        return self.answer(*both, focal)

    @torch.no_grad()
    def answer(self, features: Tensor, mirrored: Tensor, focal: Tensor) -> CameraNumbers:
        """Return the same from the features of photos and of their mirror images."""
        plain, turned = (self(part, focal) for part in (features, mirrored))
        value, sigma = [], []
        for name, bins in NUMBERS.items():
            other = turned[name].flip(-1) if name in MIRRORED else turned[name]
            probability = 0.5 * (plain[name].softmax(dim=1) + other.softmax(dim=1))
            value.append(bins.quantile(probability, 0.5))
            # A Gaussian has 68 % between these two, one standard deviation to either side.
            low, high = (bins.quantile(probability, share) for share in (0.16, 0.84))
            sigma.append(0.5 * (high - low))
        return CameraNumbers(torch.stack(value, 1), torch.stack(sigma, 1) * self.spread)


def random_calibrator(seed: int, config: CalibratorConfig | None = None) -> Calibrator:
    """Return a network with random weights: a start for training, and a control that must fail."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return Calibrator(config or CalibratorConfig()).eval()


def save_calibrator(network: Calibrator, path: Path, record: Mapping[str, Any]) -> None:
    """Write a network: fp16 weights, whole or not at all.

    Args:
        network: Its calibration goes along.
        path: The safetensors file.
        record: How it was trained, plain values; read back as `Calibrator.record`.

    Raises:
        OSError: The disk is full or the folder is not writable; an older file is still whole.
    """
    state = {k: v.half().cpu().contiguous() for k, v in network.state_dict().items()}
    config = json.dumps(asdict(network.config))
    about = {
        "format": CALIBRATOR_FORMAT,
        "config": config,
        "weights": values_hash({name: part.numpy() for name, part in state.items()}, config),
        "record": json.dumps(dict(record), allow_nan=False),
    }
    write_file(path, save(state, metadata=about))


def load_calibrator(path: Path | None = None, device: str | torch.device = "cpu") -> Calibrator:
    """Read a network for `warpir.calibration.estimate.estimate_camera`.

    Args:
        path: The safetensors file; None: the one in the package.
        device: Where it shall run.

    Raises:
        InputError: The file is absent, damaged or of another kind (`ExitCode.MODEL`).
    """
    try:
        file = check_calibrator(path)
        config: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v
            for k, v in json.loads(file.about["config"]).items()
        }
        # Not on "meta" first: its sizes are checked, and random numbers there import the compiler.
        network = Calibrator(CalibratorConfig(**config))
        if {name: part.shape for name, part in network.state_dict().items()} != file.shapes:
            what = "damaged (the weights are not those of its network)"
            raise ModelError(str(file.path), what)
        weights = {name: part.float() for name, part in load_file(file.path).items()}
        network.load_state_dict(weights)
    except ModelError as error:
        raise InputError(error.where, error.what, error.advice, ExitCode.MODEL) from None
    network.record = json.loads(file.about["record"])
    return network.to(device).eval().requires_grad_(False)
