"""Composites of a subject in its place under given lights and tone curves.

Every light is rendered by the same renderer with the same geometry, samples and random numbers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpir.app.config import InsertConfig
from warpir.app.model_files import require_model
from warpir.calibration.network import Calibrator, load_calibrator
from warpir.core.arrays import FloatArray, IntArray
from warpir.core.color import linear_to_gamma
from warpir.core.errors import ExitCode, InputError
from warpir.diffusion.models.weight_files import SHIPPED
from warpir.evaluate.scenes import RESPONSES, Place, Subject
from warpir.lighting.regressor import Regressor, load_regressor
from warpir.render.bridge import ComposeConstants, compose
from warpir.render.device_light import light_args
from warpir.render.device_scene import Placed, Receiver, Scene
from warpir.render.integrator import Radiance
from warpir.render.picture.planes import spread
from warpir.render.picture.quality import Quality
from warpir.render.picture.tone import tone_mapped
from warpir.render.renderer import Foreground, Renderer
from warpir.render.shadow.pilot import shaded_pixels
from warpir.render.tone_curve import ToneCurve
from warpir.scene.light import Light
from warpir.scene.tone_curves import Curves
from warpir.train.networks.regressor import random_regressor
from warpir.train.places import learned_from, without_size

FLOOR_EVALUATIONS = 60
"""Largest number of evaluations in the fit of the tone floor's curves."""
EXPOSURE_EV = 8.0
"""Largest change by the fitted exposure, either way [EV]."""


@dataclass(frozen=True)
class Prediction:
    """Light and tone curves that a row predicts for a scene."""

    light: Light
    """Light on the object, world frame, photo-linear."""
    light_shadow: Light
    """Light that casts the shadow; the same object where there is one light."""
    curves: Curves | None
    """Tone operator and curves; None: the camera's own response, which only the truth knows."""
    seed: int = 0
    """Added to the seed of the samples."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Notes on the prediction for the report; plain values."""

    @staticmethod
    def of(light: Light, **about: Any) -> Prediction:
        """Return the prediction of a light alone: identity curves, clipped as a photo is."""
        return Prediction(light, light, Curves.identity("linear"), about=about)


@dataclass(frozen=True)
class Rendered:
    """A scene under one light, before any tone."""

    foreground: Foreground
    receiver_pixels: IntArray
    """Row-major pixel indices, shape [receiver_pixel]."""
    ratio: FloatArray
    """Shadow ratio, shape [receiver_pixel, 3]."""


class Stage:
    """Renders one subject in its place under any light.

    Raises:
        InputError: The object covers no pixel.

    Attributes:
        truth: The true composite, display-encoded, shape [H, W, 3].
        mask: The object's share of each pixel, shape [H, W].
        ratio: True shadow ratio, shape [H, W, 3].
    """

    def __init__(self, subject: Subject, device: str, quality: Quality, threads: int = 0) -> None:
        self.place, self.quality = subject.place, quality
        placed = Placed(subject.asset, subject.placement.asset_to_world)
        ground = subject.placement.ground
        scene = Scene([placed], self.place.camera, Receiver(ground[:3], -float(ground[3])), device)
        self.renderer = Renderer(scene, threads)
        self.objects: IntArray = self.renderer.gbuffer(quality.seed).object_pixels
        if len(self.objects) == 0:
            raise InputError(subject.asset_path, f"nothing of it is seen in {self.place.name}")
        self.true = self.render(self.true_prediction())
        self.truth = self.compose(self.true, None)
        size = self.place.photo.shape[:2]
        self.mask = spread(size, self.objects, self.true.foreground.mask)
        self.ratio = spread(size, self.true.receiver_pixels, self.true.ratio, outside=1.0)

    def true_prediction(self) -> Prediction:
        """Return the place's true light with the camera's own response."""
        light = Light(texels=self.place.texels)
        return Prediction(light, light, None)

    def render(self, prediction: Prediction) -> Rendered:
        """Return object and shadow under a row's light."""
        renderer, quality = self.renderer, self.quality
        seed = quality.seed + prediction.seed
        args = light_args(prediction.light, renderer.device)
        shadow = args
        if prediction.light_shadow is not prediction.light:
            shadow = light_args(prediction.light_shadow, renderer.device)
        foreground = renderer.foreground(
            args, self.objects, quality.samples, quality.rays, quality.depth, seed,
            quality.indirect_limit,
        )  # fmt: skip
        proxies = shaded_pixels(renderer, shadow, quality.seed)
        is_object = np.zeros(self.place.photo.shape[0] * self.place.photo.shape[1], np.int32)
        is_object[self.objects] = 1
        radiance = renderer.receiver(
            shadow, proxies, is_object[proxies], quality.samples, quality.rays, seed
        )
        return Rendered(foreground, proxies, renderer.ratio(radiance))

    def compose(self, rendered: Rendered, curves: Curves | None, gain: float = 1.0) -> FloatArray:
        """Return the composite of what `render` returned, display-encoded, shape [H, W, 3].

        Without curves the camera's own response is taken; ``gain`` is a factor on the object's
        radiance.
        """
        shown, behind = self._shown(rendered, curves, gain), self._behind(rendered, curves)
        mask = rendered.foreground.mask[:, None]
        behind[self.objects] = shown * mask + (1.0 - mask) * behind[self.objects]
        return _encoded(behind).reshape(self.place.photo.shape)

    def _shown(self, rendered: Rendered, curves: Curves | None, gain: float) -> FloatArray:
        """Return the object in display-linear values, not premultiplied, [object_pixel, 3]."""
        foreground = rendered.foreground
        radiance = (foreground.radiance * np.float32(gain)).astype(np.float32)
        if curves is None:
            seen = foreground.mask[:, None] > 0.0
            linear = radiance / np.where(seen, foreground.mask[:, None], 1.0)
            response = RESPONSES[self.place.response]
            return response.show(linear.astype(np.float64)).astype(np.float32)
        lit = replace(foreground, radiance=radiance)
        shown, _ = tone_mapped(self.renderer, lit, rendered.ratio[:0], curves)
        return shown

    def _behind(self, rendered: Rendered, curves: Curves | None) -> FloatArray:
        """Return the photograph under the shadow, display-linear, shape [pixel, 3]."""
        behind = self.place.photo_lin.reshape(-1, 3).copy()
        proxies = rendered.receiver_pixels
        if curves is None:
            # The shadow falls onto the scene, and the camera's response comes after it.
            response = RESPONSES[self.place.response]
            lit = response.invert(behind[proxies].astype(np.float64))
            behind[proxies] = response.show(lit * rendered.ratio).astype(np.float32)
        else:
            _, ratio = tone_mapped(self.renderer, rendered.foreground, rendered.ratio, curves)
            behind[proxies] *= ratio
        return behind

    def fit_exposure(self, rendered: Rendered, curves: Curves | None) -> float:
        """Return the factor on the object's radiance that brings it nearest to the truth [1].

        Least squares of display values over the object's pixels; the shadow stays.
        """
        from scipy.optimize import minimize_scalar

        behind = self._behind(rendered, curves)[self.objects]
        mask = rendered.foreground.mask[:, None]
        truth = self.truth.reshape(-1, 3)[self.objects]

        def error(ev: float) -> float:
            shown = self._shown(rendered, curves, 2.0**ev)
            image = _encoded(shown * mask + (1.0 - mask) * behind)
            return float(np.square(image.astype(np.float64) - truth).sum())

        # Clipping makes it flat far out, so a coarse look comes before the search.
        grid = np.linspace(-EXPOSURE_EV, EXPOSURE_EV, 33)
        best = float(grid[int(np.argmin([error(ev) for ev in grid]))])
        found = minimize_scalar(
            error, bounds=(best - 0.5, best + 0.5), method="bounded", options={"xatol": 1e-3}
        )
        return float(2.0**found.x)

    def tone_floor(self) -> Curves:
        """Return the curves after Reinhard's operator that come nearest to the truth.

        Their error is the least of any method with this tone model.
        """
        foreground, ratio = self.true.foreground, torch.from_numpy(self.true.ratio)
        constants = ComposeConstants(
            self.place.photo_lin,
            self.objects,
            self.true.receiver_pixels,
            foreground.mask,
            str(self.renderer.device.alias),
            True,
        )
        radiance = Radiance(torch.from_numpy(foreground.radiance), ratio, torch.ones_like(ratio))
        truth = torch.from_numpy(self.truth).permute(2, 0, 1)[None]
        curve_fg, curve_shadow = ToneCurve(1), ToneCurve(3)
        optimizer = torch.optim.LBFGS(
            [*curve_fg.parameters(), *curve_shadow.parameters()],
            max_iter=FLOOR_EVALUATIONS,
            max_eval=FLOOR_EVALUATIONS,
            line_search_fn="strong_wolfe",
        )

        def error() -> float:
            optimizer.zero_grad()
            image = compose(constants, radiance, curve_fg(), curve_shadow())
            squared = (image - truth).square().sum()
            squared.backward()
            return float(squared.detach())

        optimizer.step(error)
        return Curves("reinhard", curve_fg.plain(), curve_shadow.plain())


def _encoded(linear: FloatArray) -> FloatArray:
    return np.minimum(linear_to_gamma(linear), 1.0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Bench:
    """Scenes, models and settings that the rows use."""

    scenes: list[tuple[Place, list[Subject]]]
    """All places and their subjects."""
    device: str
    """Warp device; torch uses the same."""
    seed: int
    """Seed of guided runs and of random weights."""
    config: InsertConfig
    """Base configuration of guided runs: model, regressor, steps, precision."""
    predictions: Mapping[str, FloatArray] = field(default_factory=dict)
    """Lights of another system by the place's name, world frame."""
    calibrator_file: Path | None = None
    """Weights of the network that estimates cameras; None: warpir's own."""

    @cached_property
    def network(self) -> Regressor:
        """The regressor.

        Raises:
            InputError: Its file cannot be used (`ExitCode.MODEL`).
        """
        path = self.config.light.regressor
        return load_regressor(None if path is None else Path(path))

    @cache  # noqa: B019, a bench lives as long as the program
    def network_for(self, panorama: str) -> Regressor:
        """Return the networks that have not learned from a panorama; all, if all have.

        Raises:
            InputError: There is no regressor (`ExitCode.MODEL`).
        """
        return unseen_by(self.network, panorama) or self.network

    @cache  # noqa: B019, a bench lives as long as the program
    def require_guide(self) -> None:
        """Check that a model can guide.

        Raises:
            InputError: None is named, or it is not what it should be (`ExitCode.MODEL`).
        """
        if not self.config.is_guided:
            raise InputError("--model", "needed: nothing else guides", code=ExitCode.MODEL)
        require_model(self.config.changed(start="uniform"))

    def digests(self) -> dict[str, str | None]:
        """Return the sha256 of the weights that were used, by what they are."""
        given = {"regressor": self.config.light.regressor, "calibrator": self.calibrator_file}
        digests: dict[str, str | None] = {}
        for name, file in given.items():
            path = Path(file or SHIPPED / f"{name}.safetensors")
            is_there = path.is_file()
            digests[name] = hashlib.sha256(path.read_bytes()).hexdigest() if is_there else None
        return digests

    @cached_property
    def calibrator(self) -> Calibrator:
        """The network that estimates cameras.

        Raises:
            InputError: Its file cannot be used (`ExitCode.MODEL`).
        """
        return load_calibrator(self.calibrator_file)

    @cached_property
    def random_network(self) -> Regressor:
        """A regressor with random weights."""
        return random_regressor(self.seed).regressor()

    def other(self, place: Place) -> Place:
        """Return the next place of another panorama.

        Raises:
            InputError: There is only one panorama.
        """
        places = [p for p, _ in self.scenes]
        k = places.index(place)
        for candidate in (*places[k + 1 :], *places[:k]):
            if candidate.panorama != place.panorama:
                return candidate
        raise InputError("--panoramas", "another scene's row needs two panoramas or more")


def unseen_by(network: Regressor, panorama: str) -> Regressor | None:
    """Return the mean of the networks that have not learned from a panorama; None without any.

    A panorama is known by its name `without_size`.
    """
    records, name = network.record.get("members", [network.record]), without_size(panorama)
    kept = [k for k, record in enumerate(records) if name not in learned_from(record)]
    if len(kept) == len(records):
        return network
    if not kept:
        return None
    # The temperature is that of the mean; each network's own is in its logits.
    temperature = network.temperature if len(kept) > 1 else 1.0
    return replace(network, members=tuple(kept), temperature=temperature)
