"""The network that estimates a camera from a photo: a distribution over each of its numbers.

A photo is stretched to 128 x 192 pixels; the coordinates of its pixels, in units of its height,
come along and say how it was stretched. A distribution is a histogram, so that "looks up" and "was
corrected to upright" can both stay open.
Photos are blurred alike before they are seen. The panoramas that it learned from are coarse beside
photos, so sharpness would otherwise tell the field of view in training and mislead afterwards.

Frames and signs are those of `warpir.scene.camera`: the camera looks along its -Z with +X right and
+Y up, and its rotation to the world is Ry(yaw) Rx(pitch) Rz(roll).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d

from warpir.calibration.forward import Forward, head_shapes, softmax, token_shapes
from warpir.calibration.weights import Shapes, Weights, read_weights
from warpir.core.arrays import AnyFloatArray, Float64Array, on_cores
from warpir.diffusion.models.weight_files import check_calibrator
from warpir.io.images.resize import resize

HEIGHT, WIDTH = 128, 192
"""Size that the network sees [px]; photos of other shapes are stretched."""
BLUR = 1.4
"""Standard deviation of the blur of every photo that the network sees, over the photo's height
times `HEIGHT`: 1 is a row of what it sees."""
BLUR_REACH = 3.0
"""Standard deviations at which a blur is cut."""
MIRRORED = ("roll", "x")
"""Numbers whose distribution turns over when the photo is mirrored."""


class Bins(NamedTuple):
    """The histogram of one number of the camera."""

    low: float
    high: float
    number: int

    def centres(self) -> Float64Array:
        """Return the middle of each bin, shape [K]."""
        step = (self.high - self.low) / self.number
        return np.linspace(self.low + 0.5 * step, self.high - 0.5 * step, self.number)

    def quantile(self, probability: Float64Array, share: float) -> Float64Array:
        """Return the value below which a share of each distribution lies, shape [...].

        Args:
            probability: Of each bin, spread evenly within it; rows sum to 1; shape [..., K].
            share: In (0, 1).
        """
        above = probability.cumsum(axis=-1)
        index = np.minimum((above < share).sum(axis=-1, keepdims=True), self.number - 1)
        inside = np.maximum(np.take_along_axis(probability, index, axis=-1), 1e-12)
        below = np.take_along_axis(above, index, axis=-1) - inside
        position = index + np.clip((share - below) / inside, 0.0, 1.0)
        value: Float64Array = self.low + (self.high - self.low) / self.number * position[..., 0]
        return value


NUMBERS = {
    "pitch": Bins(-92.0, 64.0, 104),
    "roll": Bins(-45.5, 45.5, 91),
    "focal": Bins(-1.15, 1.45, 65),
    "x": Bins(0.0, 1.0, 41),
    "y": Bins(-0.2, 1.2, 57),
}
"""Pitch [deg], roll [deg], natural logarithm of the focal length over the photo's height, and the
principal point as shares of width and height from the top left; the order of the heads."""
PLANES, PLACES = 5, 5
"""Numbers of a pixel, and numbers that say where a token looks."""


class CameraNumbers(NamedTuple):
    """Most likely cameras, and how wrong they may be; shape [..., 5], as `NUMBERS`."""

    value: Float64Array
    sigma: Float64Array
    """Standard deviations in the same units; 68 % of errors lie within one."""


def medians(
    plain: Mapping[str, Float64Array], mirrored: Mapping[str, Float64Array], spread: Float64Array
) -> CameraNumbers:
    """Return the medians of distributions and their calibrated standard deviations.

    The distributions for a photo and for its mirror image are averaged: a mirrored photo gives the
    mirrored camera by construction.

    Args:
        plain: Logits of each number's bins for a photo, shape [..., K].
        mirrored: The same for its mirror image.
        spread: Factor on the width of each distribution, shape [5].
    """
    value, sigma = [], []
    for name, bins in NUMBERS.items():
        turned = softmax(mirrored[name])
        turned = turned[..., ::-1] if name in MIRRORED else turned
        probability = 0.5 * (softmax(plain[name]) + turned)
        value.append(bins.quantile(probability, 0.5))
        # A Gaussian has 68 % between these two, one standard deviation to either side.
        low, high = (bins.quantile(probability, share) for share in (0.16, 0.84))
        sigma.append(0.5 * (high - low))
    return CameraNumbers(np.stack(value, axis=-1), np.stack(sigma, axis=-1) * spread)


def seen(photo: AnyFloatArray) -> Float64Array:
    """Return a photo as the network sees it: stretched to 128 x 192 and blurred.

    Args:
        photo: Display-encoded, shape [H, W, 3].
    """
    height, width = photo.shape[:2]
    small = resize(photo, HEIGHT, WIDTH).astype(np.float64)
    for axis, sigma in enumerate(blur_sigma(BLUR, width / height)):
        sigma = min(sigma, WIDTH)
        reach = math.ceil(BLUR_REACH * sigma)
        small = gaussian_filter1d(small, sigma, axis, mode="nearest", radius=reach)
    return small


def blur_sigma(rows: Any, aspect: Any) -> tuple[Any, Any]:
    """Return the blur of stretched photos down and across [px], numbers or tensors.

    Args:
        rows: The blur, over the photo's height times `HEIGHT`.
        aspect: Width of the photo over its height before it was stretched.
    """
    return rows, rows * (WIDTH / HEIGHT) / aspect


@dataclass(frozen=True)
class Calibrator:
    """Photo, its shape and perhaps its focal length to the camera's numbers."""

    weights: Weights

    @property
    def record(self) -> Mapping[str, Any]:
        """How it was trained; plain values."""
        return self.weights.record

    def predict(self, photo: Float64Array, aspect: float, focal: float) -> CameraNumbers:
        """Return the most likely camera of a photo, shape [5], asked for its mirror image too.

        Args:
            photo: As `seen` gives it, shape [128, 192, 3].
            aspect: Width over height before it was stretched.
            focal: Logarithm of the focal length over the height where it is known, else NaN.
        """
        network = Forward(self.weights)
        known = not math.isnan(focal)
        about = np.array([math.log(aspect), known, focal if known else 0.0])

        def asked(view: Float64Array) -> dict[str, Float64Array]:
            plane = _coordinates(aspect, HEIGHT, WIDTH)
            x = network.features(np.concatenate([view * 2.0 - 1.0, plane], axis=2))
            where = _coordinates(aspect, *x.shape[:2]).reshape(-1, 2)
            places = np.concatenate([where, np.tile(about, (len(where), 1))], axis=1)
            read = network.read(network.tokens(x, places))
            return {
                name: network.head(f"numbers.{name}", read[k]) for k, name in enumerate(NUMBERS)
            }

        plain, mirrored = on_cores(asked, (photo, photo[:, ::-1]))
        return medians(plain, mirrored, self.weights.float64("spread"))


def _coordinates(aspect: float, height: int, width: int) -> Float64Array:
    """Return right and down from the middle, in units of the photo's height, [H, W, 2]."""
    across = aspect * ((np.arange(width) + 0.5) / width - 0.5)
    down = (np.arange(height) + 0.5) / height - 0.5
    return np.stack(np.meshgrid(across, down), axis=2)


def shapes(sizes: Mapping[str, Any]) -> Shapes:
    """Return the shapes of the weights of a calibrator of these sizes."""
    wide = sizes["channels"][-1]
    heads = {f"numbers.{name}": bins.number for name, bins in NUMBERS.items()} | {"field": 3}
    found = {"spread": (len(NUMBERS),), **token_shapes(sizes, PLANES, PLACES, len(NUMBERS))}
    for name, count in heads.items():
        found |= head_shapes(name, wide, count)
    return found


def load_calibrator(path: Path | None = None) -> Calibrator:
    """Read a network for `warpir.calibration.estimate.estimate_camera`; see `read_weights`."""
    return Calibrator(read_weights(check_calibrator, shapes, path))
