"""The network that estimates HDR light, with its uncertainty, from a photo and its camera.

A small network sees the photo and the viewing direction of each pixel. It answers with a
distribution over fixed directions for the dominant light (so that "ahead or behind" can stay open),
that light's irradiance, colour, softness and share, and broad spherical Gaussians for all other
light; each level comes with a variance. Levels are logarithms relative to the photo's own mean
decoded luminance, so exposure drops out. It is asked twice, for the photo and for its mirror image,
and the answers are averaged: a mirrored photo gives the mirrored light by construction. What ships
holds several such networks, each trained without some of the places; their answers are averaged,
and where they disagree the variances grow.

The camera-yaw frame is the world turned about +Y so that the camera looks along -Z.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from warpir.calibration.forward import Forward, head_shapes, token_shapes
from warpir.calibration.weights import Shapes, Weights, read_weights
from warpir.core.arrays import AnyFloatArray, Float64Array, on_cores
from warpir.core.color import GAMMA, luminance
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.weight_files import check_regressor

HEIGHT, WIDTH = 96, 144
"""Size that the network sees [px]; photos of other shapes are stretched, and the rays say so."""
AMBIENT_SHARPNESS = 4.0
"""Of the 14 ambient lobes: with equal amplitudes their sum is even within 4 %."""
LEVEL_COUNT = 10 + 3 * 14
"""Numbers of a prediction beside the logits."""
LARGEST = 60.0
"""What no logarithm of a sensible prediction reaches."""
DARKEST = 1e-4
"""Mean luminance below which a photo counts as this bright."""
LOWEST = -0.25
"""Height y of the lowest direction that a dominant light may have."""
PLANES, PLACES, ASKING = 6, 3, 2
"""Numbers of a pixel, numbers that say where a token looks, and heads; as of `TokenNetwork`."""


class Prediction(NamedTuple):
    """The network's output, camera-yaw frame; levels are natural logarithms.

    Arrays, or tensors in training; ``...`` stands for photos, where there are several.
    """

    logits: Any
    """Of the candidate directions, shape [..., K]."""
    level: Any
    """Log luminance of the irradiance that faces the dominant light, over the photo's mean
    luminance, shape [...]."""
    level_log_var: Any
    tint: Any
    """Log ratios red / green and blue / green of that irradiance, shape [..., 2]."""
    tint_log_var: Any
    softness: Any
    """Log angular standard deviation of the dominant light [log rad], shape [...]."""
    softness_log_var: Any
    share: Any
    """Logit of the dominant light's share of a sphere's mean irradiance, shape [...]."""
    ambient: Any
    """Log amplitudes of the ambient lobes over the photo's mean luminance, shape [..., 14, 3]."""
    ambient_log_var: Any
    """Of the log irradiance of the ambient light, shape [...]."""


def split(flat: Any) -> Prediction:
    """Name the parts of a flat prediction, an array or a tensor, shape [..., K + LEVEL_COUNT]."""
    levels = flat[..., -LEVEL_COUNT:]
    return Prediction(
        logits=flat[..., :-LEVEL_COUNT],
        level=levels[..., 0],
        level_log_var=levels[..., 1].clip(-8.0, 6.0),
        tint=levels[..., 2:4],
        tint_log_var=levels[..., 4:6].clip(-8.0, 6.0),
        # The offset is where most lights lie: between the sun and a window.
        softness=levels[..., 6] - 3.0,
        softness_log_var=levels[..., 7].clip(-8.0, 6.0),
        share=levels[..., 8],
        ambient=levels[..., 9:-1].reshape(*levels.shape[:-1], -1, 3),
        ambient_log_var=levels[..., -1].clip(-8.0, 6.0),
    )


def mirrored(prediction: Prediction) -> Prediction:
    """Return what a prediction says of the mirror image: x of every direction negated."""
    count = prediction.logits.shape[-1]
    turned = (np.arange(count) + count // 2) % count
    return prediction._replace(
        logits=prediction.logits[..., turned],
        ambient=prediction.ambient[..., _ambient_mirror(), :],
    )


def averaged(seen: Float64Array, reflected: Float64Array, temperature: float) -> Prediction:
    """Return the mean over members, photo and mirror image, with calibrated logits.

    Args:
        seen: Flat predictions of the members, shape [M, ..., K + LEVEL_COUNT].
        reflected: The same for the mirror image.
        temperature: Divides the mean logits.
    """
    both = zip(mixture(seen), mirrored(mixture(reflected)), strict=True)
    mean = Prediction(*(0.5 * (a + b) for a, b in both))
    return mean._replace(logits=mean.logits / temperature)


def mixture(flats: Float64Array) -> Prediction:
    """Return the mean over members; the variance of a level is that of the mixture.

    That is the mean of the members' variances plus the variance of their answers.
    """
    mean = split(flats.mean(axis=0))
    if len(flats) == 1:
        return mean
    each = split(flats)

    def spread(levels: Float64Array, log_var: Float64Array) -> Float64Array:
        total: Float64Array = np.exp(log_var).mean(axis=0) + levels.var(axis=0)
        return np.log(total).clip(-8.0, 6.0)

    brightness = np.log(np.exp(each.ambient).sum(axis=(-2, -1)))
    return mean._replace(
        level_log_var=spread(each.level, each.level_log_var),
        tint_log_var=spread(each.tint, each.tint_log_var),
        softness_log_var=spread(each.softness, each.softness_log_var),
        ambient_log_var=spread(brightness, each.ambient_log_var),
    )


@dataclass(frozen=True)
class Regressor:
    """Photo and rays to `Prediction`, by one network or by several whose answers are averaged."""

    weights: Weights
    members: tuple[int, ...]
    """Which of the networks are asked, by their numbers in the weights."""
    temperature: float
    """Divides the mean logits; calibrated on places held out of every network."""

    @classmethod
    def of(cls, weights: Weights) -> Regressor:
        """Return what asks all networks of these weights."""
        members = tuple(range(weights.sizes["members"]))
        return cls(weights, members, float(weights.values["temperature"]))

    @property
    def directions(self) -> Float64Array:
        """Candidates, camera-yaw frame, shape [K, 3]; in the file: weights keep their own."""
        return self.weights.float64("directions")

    @property
    def mean_light(self) -> Prediction:
        """The training set's mean light as one constant prediction."""
        return split(self.weights.float64("mean_light"))

    @property
    def record(self) -> Mapping[str, Any]:
        """How it was trained; plain values."""
        return self.weights.record

    def predict(self, photo: Float64Array, rays: AnyFloatArray) -> Prediction:
        """Return the mean over the members, the photo and its mirror image, on every core.

        Args:
            photo: Display-encoded, shape [96, 144, 3].
            rays: Unit viewing directions, camera-yaw frame, shape [96, 144, 3].

        Raises:
            InputError: The weights give no light that floats can hold (`ExitCode.MODEL`).
        """
        rays = rays.astype(np.float64)
        views = (photo, rays), (photo[:, ::-1], rays[:, ::-1] * (-1.0, 1.0, 1.0))

        def asked(question: tuple[int, tuple[Float64Array, Float64Array]]) -> Float64Array:
            member, view = question
            return self._asked(member, *view)

        flats = on_cores(asked, [(member, view) for member in self.members for view in views])
        found = averaged(np.stack(flats[::2]), np.stack(flats[1::2]), self.temperature)
        # Of larger numbers light would be made that no float holds; NaN is not smaller either.
        if not (
            np.isfinite(found.logits).all() and all(np.abs(x).max() < LARGEST for x in found[1:])
        ):
            what = f"answers with logarithms beyond {LARGEST:g} (its weights were not trained)"
            raise InputError("--regressor", what, code=ExitCode.MODEL)
        return found

    def _asked(self, member: int, photo: Float64Array, rays: Float64Array) -> Float64Array:
        """Return the flat prediction of one network."""
        network = Forward(self.weights, f"members.{member}.")
        x = network.features(np.concatenate([photo * 2.0 - 1.0, rays], axis=2))
        rows, columns = x.shape[:2]
        looking = rays.reshape(rows, -1, columns, rays.shape[1] // columns, 3).mean(axis=(1, 3))
        direction, levels = network.read(network.tokens(x, looking.reshape(-1, 3)))
        answers = network.head("direction_head", direction), network.head("level_head", levels)
        return np.concatenate(answers)


def candidates(count: int) -> Float64Array:
    """Return directions that a dominant light may have, camera-yaw frame, shape [K, 3].

    Rings of cells of equal area, as if ``count`` covered the whole sphere. The second half mirrors
    the first (x negated), so that turning a distribution over is a roll by K / 2.
    """
    spacing = math.sqrt(4.0 * math.pi / count)
    lowest = math.asin(LOWEST)
    edges = np.linspace(lowest, math.pi / 2.0, round((math.pi / 2.0 - lowest) / spacing) + 1)
    rings = []
    for low, high in itertools.pairwise(edges):
        # Half of the ring, x > 0; azimuths from -Z.
        half = max(round(math.pi * (math.sin(high) - math.sin(low)) / spacing**2), 1)
        azimuth = math.pi * (np.arange(half) + 0.5) / half
        elevation = 0.5 * (low + high)
        level = math.cos(elevation)
        height = np.full(half, math.sin(elevation))
        rings.append(np.stack([level * np.sin(azimuth), height, -level * np.cos(azimuth)], axis=1))
    right = np.concatenate(rings)
    return np.concatenate([right, right * (-1.0, 1.0, 1.0)])


def ambient_axes() -> Float64Array:
    """Return the axes of the ambient lobes: faces and corners of a cube, shape [14, 3]."""
    steps = np.array(list(itertools.product((-1.0, 0.0, 1.0), repeat=3)))
    chosen: Float64Array = steps[np.isin(np.abs(steps).sum(axis=1), (1.0, 3.0))]
    axes: Float64Array = chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
    return axes


@lru_cache(maxsize=1)
def _ambient_mirror() -> list[int]:
    """Return which ambient lobe takes the place of each when the photo is mirrored."""
    axes = ambient_axes()
    return [int(np.argmax(axes @ (axis * (-1.0, 1.0, 1.0)))) for axis in axes]


def mean_luminance(photo: AnyFloatArray) -> float:
    """Return the mean decoded luminance of a display-encoded photo, shape [H, W, 3]."""
    decoded = np.maximum(photo, 0.0).astype(np.float64) ** GAMMA
    return max(float(luminance(decoded.mean(axis=(0, 1)))), DARKEST)


def least_angle(
    directions: Float64Array, probability: Float64Array
) -> tuple[Float64Array, Float64Array]:
    """Return the directions of least expected angle, shape [B, 3], and that angle [rad], [B].

    The geometric median: the best candidate, refined by Weiszfeld's steps on the sphere. A
    candidate stands for its cell, so angles are smoothed by half the spacing; without that every
    step would fall back on a candidate. Candidates are unit, shape [K, 3]; rows of their
    probabilities, shape [B, K], sum to 1.
    """

    def angles(axes: Float64Array) -> Float64Array:
        found: Float64Array = np.arccos((axes @ directions.T).clip(-1.0, 1.0))
        return found

    axis = directions[(probability @ angles(directions).T).argmin(axis=1)]
    # Of about K / (solid angle share of the candidates) cells on the whole sphere.
    half_spacing = 0.5 * math.sqrt(4.0 * math.pi * (1.0 - LOWEST) / 2.0 / len(directions))
    for _ in range(20):
        angle = angles(axis)
        pull = probability / np.sqrt(angle**2 + half_spacing**2)
        # log map: the tangent toward a candidate, as long as the angle.
        scale = pull * angle / np.maximum(np.sin(angle), 1e-6)
        tangent = scale @ directions - (scale * np.cos(angle)).sum(axis=1, keepdims=True) * axis
        tangent = tangent / pull.sum(axis=1, keepdims=True)
        length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-12)
        axis = axis * np.cos(length) + tangent / length * np.sin(length)
        axis = axis / np.linalg.norm(axis, axis=1, keepdims=True)
    return axis, (probability * angles(axis)).sum(axis=1)


def shapes(sizes: Mapping[str, Any]) -> Shapes:
    """Return the shapes of the weights of a regressor of these sizes."""
    count, wide = len(candidates(sizes["directions"])), sizes["channels"][-1]
    member = {
        **token_shapes(sizes, PLANES, PLACES, ASKING),
        **head_shapes("direction_head", wide, count),
        **head_shapes("level_head", wide, LEVEL_COUNT),
    }
    of_all = {"directions": (count, 3), "temperature": (), "mean_light": (count + LEVEL_COUNT,)}
    numbers = range(sizes["members"])
    return of_all | {
        f"members.{k}.{name}": shape for k in numbers for name, shape in member.items()
    }


def load_regressor(path: Path | None) -> Regressor:
    """Read a network for `regress`; see `read_weights`."""
    return Regressor.of(read_weights(check_regressor, shapes, path))
