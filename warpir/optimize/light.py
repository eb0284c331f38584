"""Recovery of a scene's light and tone curves (DiPIR, sections 4.1 to 4.3, supplement S 1-7).

Two sets of lobes, one that lights the object and one that casts its shadow, become one light over
the run; a tone curve belongs to the object, three to the shadow ratio.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpir.app.settings import OptimizeSettings
from warpir.lighting.fusion import fuse
from warpir.lighting.regularizers import TrustRegion, bend, chroma, consistency, spread
from warpir.lighting.sg_light import LightBounds, SGLight, bounded_ratios, narrowest
from warpir.optimize.loop import Composite, Guide, Optimization
from warpir.optimize.view import Frame, View, expected_light
from warpir.render.bridge import compose
from warpir.render.integrator import Radiance
from warpir.render.tone_curve import Knots, ToneCurve
from warpir.render.transport.rows import TransportSettings
from warpir.scene.camera import Camera
from warpir.scene.light import Light, Lobes, describe, summarize
from warpir.scene.near.lamps import LARGEST, Lamp

RETRACE_EVERY = 25
"""Steps between two checks of the traced rows' staleness."""

Function = Callable[..., tuple[Tensor, ...]]
Record = Callable[[torch.nn.Module], Function]
"""Returns a faster function equal to a module, such as the replay of its CUDA graph."""


class LampPowers(torch.nn.Module):
    """Powers of lamps near the object, as factors on those given; a lamp of power 0 stays dark.

    Args:
        lamps: Lamps with the given powers.
        bounds: Greatest factor and log colour ratio, either way.
    """

    own: Tensor

    def __init__(self, lamps: Sequence[Lamp], bounds: LightBounds) -> None:
        super().__init__()
        self.lamps, self.bounds = tuple(lamps), bounds
        own = torch.tensor(np.stack([lamp.power for lamp in lamps]), dtype=torch.float32)
        self.register_buffer("own", own, persistent=False)
        self.log_factor = torch.nn.Parameter(torch.zeros(len(own)))
        self.chroma = torch.nn.Parameter(torch.zeros(len(own), 3))

    def forward(self) -> Tensor:
        """Return the powers, relative [W], shape [lamp, 3]."""
        return self.own * torch.exp(self.log_factor[:, None] + self.log_ratios())

    def log_ratios(self) -> Tensor:
        """Return the bounded log ratios to the given colours, shape [lamp, 3]."""
        return bounded_ratios(self.chroma, self.bounds)

    def project(self) -> None:
        """Bring the factors back within their bounds."""
        with torch.no_grad():
            self.log_factor.clamp_(-np.log(self.bounds.intensity), np.log(self.bounds.intensity))

    def found(self) -> tuple[Lamp, ...]:
        """Return the lamps with the powers as they are."""
        powers = self().detach().cpu().double().clamp(max=LARGEST).numpy()
        return tuple(replace(k, power=p) for k, p in zip(self.lamps, powers, strict=True))


class Unknowns(torch.nn.Module):
    """The unknowns of the recovery: two lights, four tone curves, and powers of lamps if asked.

    Args:
        light_fg: Light on the object.
        light_shadow: Light that casts its shadow.
        bins: Bins of each tone curve.
        lamps: Lamps near the object whose powers are unknown.
    """

    def __init__(
        self,
        light_fg: SGLight,
        light_shadow: SGLight,
        bins: int = 5,
        lamps: LampPowers | None = None,
    ) -> None:
        super().__init__()
        self.light_fg, self.light_shadow = light_fg, light_shadow
        self.curve_fg, self.curve_shadow = ToneCurve(1, bins), ToneCurve(3, bins)
        self.lamps = lamps

    @staticmethod
    def start(
        lobes: Lobes | None, level: float, settings: OptimizeSettings, lamps: Sequence[Lamp] = ()
    ) -> Unknowns:
        """Return the unknowns at their start.

        Args:
            lobes: A light to start from, or None for an even one.
            level: Radiance of that even light, relative [W/(m^2 sr)].
            settings: Count and bounds of the lobes.
            lamps: Lamps near the object; their powers are unknowns if the settings say so.
        """
        bounds = LightBounds(
            narrowest(settings.light_height), settings.chroma_limit, settings.intensity_limit
        )

        def light() -> SGLight:
            if lobes is not None:
                return SGLight(lobes, level, bounds)
            return SGLight.uniform(settings.lobes, level, bounds, settings.lobe_width)

        near = LampPowers(lamps, bounds) if settings.recover_lamps else None
        return Unknowns(light(), light(), settings.tone_bins, near)

    def lamp_powers(self) -> Tensor | None:
        """Return the powers, shape [lamp, 3]; None where the scene's are known."""
        return None if self.lamps is None else self.lamps()


@dataclass(frozen=True)
class Parts:
    """Inputs of a step's composite, and its regularisers."""

    radiance: Radiance
    curve_fg: Knots
    curve_shadow: Knots
    terms: dict[str, Tensor]
    """Regularisers by name."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Return all tensors in a fixed order."""
        groups = (self.radiance, self.curve_fg, self.curve_shadow)
        return *(x for group in groups for x in vars(group).values()), *self.terms.values()

    @staticmethod
    def of(tensors: Sequence[Tensor], names: Sequence[str]) -> Parts:
        """Undo `tensors`; ``names`` are those of the terms."""
        radiance, curve_fg, curve_shadow = tensors[:3], tensors[3:6], tensors[6:9]
        terms = dict(zip(names, tensors[9:], strict=True))
        return Parts(Radiance(*radiance), Knots(*curve_fg), Knots(*curve_shadow), terms)


class LightOptimization(Optimization):
    """Light and tone curves of one frame.

    Args:
        frame: Scene, photo, tone operator.
        guide: Gradient and score of the image.
        settings: Steps, rates, weights, schedules.
        unknowns: Parameters at their start; changed in place.
        cache: Folder for traced rows, or None.
        transport: Resolution of light transport; by default the settings'.
        record: Speeds up steps with `transport`, such as by CUDA graphs.
        region: Trust region of the light, or None.
    """

    unknowns: Unknowns

    def __init__(
        self,
        frame: Frame,
        guide: Guide,
        settings: OptimizeSettings,
        unknowns: Unknowns,
        cache: Path | None = None,
        transport: TransportSettings | None = None,
        record: Record | None = None,
        region: TrustRegion | None = None,
    ) -> None:
        memory = frame.renderer.memory
        super().__init__(unknowns, _groups(unknowns, settings), guide, settings, frame.seed, memory)
        self.frame, self.cache, self.rows = frame, cache, transport
        if transport is None and settings.integrator == "transport":
            self.rows = TransportSettings(
                height_fg=settings.object_light_height,
                height_shadow=settings.light_height,
                memory_mib=settings.transport_memory,
            )
        self.retraced = 0
        self.region = region if settings.trust > 0.0 else None
        self._record = record
        with torch.no_grad():
            self.expected = expected_light(*self.lights(0.0))
        self.view = self._trace()

    def _trace(self) -> View:
        view = View(self.frame, self.expected, self.rows, self.settings.mis_samples, self.cache)
        # A recording reads the rows of the previous view.
        self._recorded = None
        if self._record is not None and view.transport is not None:
            self._recorded = self._record(_TorchHalf(self))
        return view

    def fusion(self, step: int) -> float:
        """Return ``s_fuse`` of a step: 0 for two lights, 1 for one [1]."""
        if self.settings.fusion == "schedule":
            share = step / max(self.settings.step_count - 1, 1)
            start, end = self.settings.fusion_start, self.settings.fusion_end
            return min(max((share - start) / max(end - start, 1e-9), 0.0), 1.0)
        return 0.0

    @property
    def final_fusion(self) -> float:
        """``s_fuse`` of the delivered light."""
        return 1.0 if self.settings.fusion == "schedule" else 0.0

    def lights(self, scale: float, height: int | None = None) -> tuple[Tensor, Tensor]:
        """Return the maps that light the object and cast its shadow, shape [He, We, 3].

        Args:
            scale: ``s_fuse`` [1].
            height: Rows; the settings' when absent.
        """
        return self._fused(self._separate(height or self.settings.light_height), scale)

    def _separate(self, height: int) -> tuple[Tensor, Tensor]:
        """Return the maps of both sets of lobes, before fusion."""
        texels_fg = self.unknowns.light_fg.texels(height)
        if self.settings.fusion == "single":
            return texels_fg, texels_fg
        return texels_fg, self.unknowns.light_shadow.texels(height)

    def parts(self, scale: float | Tensor, seed: int = 0) -> Parts:
        """Return the inputs of the composite; by torch alone with `transport`."""
        unknowns, maps = self.unknowns, self._separate(self.settings.light_height)
        curves = unknowns.curve_fg(), unknowns.curve_shadow()
        radiance = self.view.integrator.radiance(
            *self._fused(maps, scale), seed, lamp_powers=unknowns.lamp_powers()
        )
        return Parts(radiance, *curves, self._terms(maps, curves))

    def _fused(self, maps: tuple[Tensor, Tensor], scale: float | Tensor) -> tuple[Tensor, Tensor]:
        return maps if self.settings.fusion == "single" else fuse(*maps, scale)

    @property
    def term_names(self) -> tuple[str, ...]:
        """Names of the regularisers, in the order of `Parts.terms`."""
        has_two = self.settings.fusion != "single"
        is_used = {
            "chroma": self.settings.lobe_shape,
            "consistency": has_two,
            "spread": has_two,
            "bend": self.settings.tone_curve,
            "trust": self.region is not None,
        }
        return tuple(name for name, used in is_used.items() if used)

    def _terms(self, maps: tuple[Tensor, Tensor], curves: tuple[Knots, Knots]) -> dict[str, Tensor]:
        """Return the regularisers: the authors' (eq. 10, 11), plain curves, the trust region."""
        fg, shadow = self.unknowns.light_fg, self.unknowns.light_shadow
        formulas: dict[str, Callable[[], Tensor]] = {
            "chroma": lambda: 0.5 * (chroma(fg) + chroma(shadow)) + self._recolored(),
            "consistency": lambda: consistency(*maps),
            "spread": lambda: spread(maps[1]),
            "bend": lambda: bend(curves[0]) + bend(curves[1]),
            "trust": self._distance,
        }
        return {name: formulas[name]() for name in self.term_names}

    def _recolored(self) -> Tensor | float:
        """Return the mean squared log ratio of the lamps' colours to those given [1]."""
        lamps = self.unknowns.lamps
        return 0.0 if lamps is None else lamps.log_ratios().square().sum(dim=1).mean()

    def _distance(self) -> Tensor:
        """Return the distance of the lights from where they are expected."""
        assert self.region is not None
        distance = self.region.distance(self.unknowns.light_fg)
        if self.settings.fusion == "single":
            return distance
        return distance + self.region.distance(self.unknowns.light_shadow)

    def composite(self, step: int) -> Composite:
        """Return the composite of a step under lights fused by the schedule, with regularisers.

        Guidance follows the noise of an image by `mis` too, so the gradient comes from other
        samples; with the same ones, the light would also move to lessen that noise.
        """
        scale = self.fusion(step)
        self.frame.renderer.bad_pixels.iteration = step
        if self._recorded is None:
            parts = self.parts(scale, self.seed + 2 * step)
        else:
            device = self.unknowns.light_fg.axis.device
            tensors = self._recorded(torch.full((), scale, device=device))
            parts = Parts.of(tensors, self.term_names)
        curves = parts.curve_fg, parts.curve_shadow
        image = compose(self.view.constants, parts.radiance, *curves)
        if self.view.transport is None:
            with torch.no_grad():
                shown = self._image(scale, *curves, self.seed + 2 * step + 1)
            image = image + (shown - image.detach())
        terms = {name: (getattr(self.settings, name), term) for name, term in parts.terms.items()}
        return Composite(image, terms)

    def final_image(self, seed: int) -> Tensor:
        """Return the composite under the light as it would be delivered."""
        curves = self.unknowns.curve_fg(), self.unknowns.curve_shadow()
        return self._image(self.final_fusion, *curves, seed)

    def _image(self, scale: float, curve_fg: Knots, curve_shadow: Knots, seed: int) -> Tensor:
        powers = self.unknowns.lamp_powers()
        return self.view.image(*self.lights(scale), curve_fg, curve_shadow, seed, powers)

    def describe(self, camera: Camera) -> str:
        """Return the direction of the light and its share in a few words."""
        with torch.no_grad():
            texels = self.lights(self.final_fusion)[1].cpu().numpy()
        words = describe(summarize(Light(texels=texels)), camera.c2w)
        lamps = self.unknowns.lamps
        if lamps is None:
            return words
        powers = (f"{lamp.power.max():.3g}" for lamp in lamps.found())
        return f"{words}; lamps of power {', '.join(powers)}"

    def project(self) -> None:
        """Keep both lights within their bounds."""
        self.unknowns.light_fg.project()
        self.unknowns.light_shadow.project()
        if self.unknowns.lamps is not None:
            self.unknowns.lamps.project()

    def prepare(self, step: int) -> None:
        """Trace light transport again when its rows have become too noisy for the light."""
        transport = self.view.transport
        if transport is None or step == 0 or step % RETRACE_EVERY:
            return
        with torch.no_grad():
            texels = self.lights(self.fusion(step))
            lights = (Light(texels=t.cpu().numpy()) for t in texels)
            if transport.staleness(*lights) > self.settings.retrace_at:
                self.expected = expected_light(*texels)
                self.view = self._trace()
                self.retraced += 1

    def final_lights(self, height: int) -> tuple[Light, Light]:
        """Return the delivered lights as maps of ``height`` rows; one and the same when fused."""
        with torch.no_grad():
            fg, shadow = self.lights(self.final_fusion, height)
        light_fg = Light(texels=fg.cpu().numpy())
        if self.settings.fusion in ("schedule", "single"):
            return light_fg, light_fg
        return light_fg, Light(texels=shadow.cpu().numpy())

    def state_dict(self) -> dict[str, Any]:
        """Return the loop's state and the light that guided the tracing of the rows."""
        assert self.expected.texels is not None
        return {
            **super().state_dict(),
            "expected": torch.from_numpy(self.expected.texels),
            "retraced": self.retraced,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore `state_dict`; light transport is traced again or read from the cache."""
        super().load_state_dict(state)
        self.retraced = state["retraced"]
        if not torch.equal(state["expected"], torch.from_numpy(self.expected.texels)):
            self.expected = Light(texels=state["expected"].numpy())
            self.view = self._trace()


class _TorchHalf(torch.nn.Module):
    """`LightOptimization.parts` as a module of its unknowns, for recording."""

    def __init__(self, loop: LightOptimization) -> None:
        super().__init__()
        self.loop, self.unknowns = loop, loop.unknowns

    def forward(self, scale: Tensor) -> tuple[Tensor, ...]:
        """Return the parts of a step; ``scale`` is ``s_fuse`` [1]."""
        return self.loop.parts(scale).tensors()


def _groups(unknowns: Unknowns, settings: OptimizeSettings) -> list[dict[str, Any]]:
    """Return each kind of parameter with its learning rate."""
    rates = {
        "log_intensity": settings.rate_intensity,
        "chroma": settings.rate_chroma,
        "axis": settings.rate_axis,
        "log_sigma": settings.rate_width,
    }
    groups: list[dict[str, Any]] = []
    for light in (unknowns.light_fg, unknowns.light_shadow):
        for name, rate in rates.items():
            parameter = getattr(light, name)
            if settings.lobe_shape or name in ("log_intensity", "axis"):
                groups.append({"params": [parameter], "rate": rate})
            else:
                parameter.requires_grad_(False)
    if unknowns.lamps is not None:
        groups.append({"params": [unknowns.lamps.log_factor], "rate": settings.rate_intensity})
        unknowns.lamps.chroma.requires_grad_(settings.lobe_shape)
        if settings.lobe_shape:
            groups.append({"params": [unknowns.lamps.chroma], "rate": settings.rate_chroma})
    curves = [*unknowns.curve_fg.parameters(), *unknowns.curve_shadow.parameters()]
    if settings.tone_curve:
        groups.append({"params": curves, "rate": settings.rate_tone})
    else:
        for parameter in curves:
            parameter.requires_grad_(False)
    return groups
