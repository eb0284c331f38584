"""Refine materials, emission or tone curves by a prompt, under a known light (DiPIR, section 6).

The light is fixed: an image does not separate its colour from the object's, so only one of the two
can be free. Parts that do not depend on the unknowns are rendered once: the plane always, and for
tone curves the object too, so that their steps trace no ray.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from warpir.app.config import REFINE_PARTS
from warpir.app.run import Run
from warpir.app.settings import OptimizeSettings, TaskConfig
from warpir.core.memory import release
from warpir.io.meshes.materials_file import MATERIALS, materials_to_json
from warpir.lighting.regularizers import bend
from warpir.lighting.scene_light import SceneLight
from warpir.optimize.course import (
    Outcome,
    follow,
    make_frame,
    open_checkpoints,
)
from warpir.optimize.loop import Composite, Guide, Optimization
from warpir.optimize.model import make_guide, prepare_guidance
from warpir.optimize.view import LitFrame
from warpir.render.bridge import ShadeForeground
from warpir.render.integrator import MaterialTensors
from warpir.render.mis.integrator import MisIntegrator
from warpir.render.tone_curve import Knots, ToneCurve
from warpir.scene.asset import Asset, Material
from warpir.scene.camera import Camera
from warpir.scene.tone_curves import Curves, ToneKnots

MARGIN = 0.05
"""Overshoot of a factor's sigmoid beyond its bounds, in spans: raw values of 0 and 1 are finite,
3 either way, where the sigmoid still has a fifth of its slope."""
RAW_LIMIT = 0.9999 * float(np.log((1.0 + MARGIN) / MARGIN))
"""Greatest raw value, just inside the bound's: rounding then never leaves the bounds."""
LOWEST = {"base_color": 0.0, "metallic": 0.0, "roughness": 0.05}
"""Lower bounds of the factors [1]; the upper bound is 1."""
EMISSION_START = 0.01
"""Least start of a material's emission, relative [W/(m^2 sr)]."""
GROUND_IS_DARK = "what the object emits does not light the ground"
GROUND_IS_UNSEEN = "guidance did not see what the object emits onto the ground; the picture does"


# ------------------------------------------------------------------------------ unknowns


class Between(torch.nn.Module):
    """Values from a lower bound to 1, both within reach: a sigmoid that is stretched by `MARGIN`.

    The start, of any shape, is brought into the bounds.
    """

    rounding: Tensor

    def __init__(self, start: Tensor, low: float) -> None:
        super().__init__()
        self.low, self.span = low, 1.0 - low
        start = start.clamp(low, 1.0)
        share = (start.double() - low) / self.span
        raw = torch.logit((share + MARGIN) / (1.0 + 2.0 * MARGIN))
        self.raw = torch.nn.Parameter(raw.float())
        # The start is exact, though its inverse was rounded.
        self.register_buffer("rounding", torch.zeros_like(start))
        self.rounding += start - self.forward().detach()

    def forward(self) -> Tensor:
        """Return the values."""
        share = (1.0 + 2.0 * MARGIN) * torch.sigmoid(self.raw) - MARGIN
        return self.low + self.span * share + self.rounding

    def project(self) -> None:
        """Bring the raw values back within the bounds."""
        with torch.no_grad():
            self.raw.clamp_(-RAW_LIMIT, RAW_LIMIT)


class Positive(torch.nn.Module):
    """Values above 0 without a bound: a softplus.

    Args:
        start: Any shape, above 0.
    """

    def __init__(self, start: Tensor) -> None:
        super().__init__()
        raw = start.double() + torch.log(-torch.expm1(-start.double()))
        self.raw = torch.nn.Parameter(raw.float())

    def forward(self) -> Tensor:
        """Return the values."""
        return torch.nn.functional.softplus(self.raw)


class Factors(torch.nn.Module):
    """Factors of an asset's materials, some of them free.

    Args:
        asset: Asset whose materials change.
        chosen: Indices of the materials that change.
        parts: Free factors, some of ``base_color``, ``metallic``, ``roughness``, ``emission``.
    """

    indices: Tensor

    def __init__(self, asset: Asset, chosen: Sequence[int], parts: Sequence[str]) -> None:
        super().__init__()
        self.asset, self.chosen = asset, list(chosen)
        self.register_buffer("indices", torch.tensor(self.chosen), persistent=False)
        self.parts = torch.nn.ModuleDict()
        for part in parts:
            own = torch.tensor([getattr(m, part) for m in asset.materials])
            self.register_buffer(f"own_{part}", own, persistent=False)
            start = own[self.indices]
            self.parts[part] = (
                Positive(start.clamp(min=EMISSION_START))
                if part == "emission"
                else Between(start, LOWEST[part])
            )

    def forward(self) -> MaterialTensors:
        """Return the free factors of all materials; the others are absent."""
        return MaterialTensors(
            **{
                part: getattr(self, f"own_{part}").index_copy(0, self.indices, values())
                for part, values in self.parts.items()
            }
        )

    def project(self) -> None:
        """Bring the bounded factors back within their bounds."""
        for values in self.parts.values():
            if isinstance(values, Between):
                values.project()

    def materials(self) -> tuple[Material, ...]:
        """Return the asset's materials with the factors as they are."""
        with torch.no_grad():  # on CUDA a start at a bound may be a rounding beyond it
            rows_by_part = {
                part: values()
                .clamp(LOWEST.get(part, 0.0), 1.0 if part in LOWEST else None)
                .tolist()
                for part, values in self.parts.items()
            }
        materials = list(self.asset.materials)
        for row, index in enumerate(self.chosen):
            factors: dict[str, Any] = {
                part: tuple(rows[row]) if isinstance(rows[row], list) else rows[row]
                for part, rows in rows_by_part.items()
            }
            materials[index] = replace(materials[index], **factors)
        return tuple(materials)


class ToneUnknowns(torch.nn.Module):
    """The unknowns of tone refinement: four curves.

    Args:
        curves: Curves at the start.
    """

    def __init__(self, curves: Curves) -> None:
        super().__init__()
        self.curve_fg = ToneCurve.from_knots(curves.foreground)
        self.curve_shadow = ToneCurve.from_knots(curves.shadow_ratio)


# ---------------------------------------------------------------------------------- loops


class MaterialRefinement(Optimization):
    """Material factors, or emission, of an object under a known light; by `mis`.

    Args:
        lit: The frame under its light.
        curves: The light's tone curves, which stand still.
        guide: Gradient and score of the image.
        settings: Steps, rates, samples.
        unknowns: Parameters at their start; changed in place.
    """

    unknowns: Factors

    def __init__(
        self,
        lit: LitFrame,
        curves: Curves,
        guide: Guide,
        settings: OptimizeSettings,
        unknowns: Factors,
    ) -> None:
        rates = {"emission": settings.rate_emission}
        groups = [
            {"params": [*values.parameters()], "rate": rates.get(part, settings.rate_material)}
            for part, values in unknowns.parts.items()
        ]
        frame = lit.frame
        super().__init__(unknowns, groups, guide, settings, frame.seed, frame.renderer.memory)
        self.lit = lit
        self.curves = [_fixed(k) for k in (curves.foreground, curves.shadow_ratio)]
        nowhere = np.zeros(0, np.int32)
        self.mis = MisIntegrator(
            frame.renderer, lit.object_pixels, nowhere, settings.mis_samples, 1, frame.depth
        )

    def composite(self, step: int) -> Composite:
        """Return the composite of a step; its gradient comes from other samples.

        Guidance follows the noise of an image too. With the same samples the gradient would also
        lessen that noise: smoother metal, darker paint. Bounds replace regularisers.
        """
        self.lit.frame.renderer.bad_pixels.iteration = step
        image = self.final_image(self.seed + 2 * step)
        with torch.no_grad():
            shown = self.final_image(self.seed + 2 * step + 1)
        return Composite(image + (shown - image.detach()))

    def final_image(self, seed: int) -> Tensor:
        """Return the composite with the materials as they are."""
        factors = vars(self.unknowns()).values()
        # The light is fixed, so there is no map to differentiate.
        foreground: Tensor = ShadeForeground.apply(
            self.mis, self.lit.args_fg, seed, torch.is_grad_enabled(), None, *factors
        )
        return self.lit.image(foreground, *self.curves)

    def project(self) -> None:
        """Keep the factors within their bounds."""
        self.unknowns.project()

    def prepare(self, step: int) -> None:
        """Do nothing: the light is fixed."""

    def describe(self, camera: Camera) -> str:
        """Return the factors of the first material that changes."""
        chosen, materials = self.unknowns.chosen, self.unknowns.materials()
        first = materials[chosen[0]]
        words = [_words(part, getattr(first, part)) for part in self.unknowns.parts]
        more = f" (and {len(chosen) - 1} more)" if len(chosen) > 1 else ""
        return f"{first.name}: {', '.join(words)}{more}"


class ToneRefinement(Optimization):
    """Tone curves of a picture whose light and materials are known.

    Args:
        lit: The frame under its light.
        guide: Gradient and score of the image.
        settings: Steps, rates, weights.
        unknowns: Parameters at their start; changed in place.
    """

    unknowns: ToneUnknowns

    def __init__(
        self, lit: LitFrame, guide: Guide, settings: OptimizeSettings, unknowns: ToneUnknowns
    ) -> None:
        groups = [{"params": [*unknowns.parameters()], "rate": settings.rate_tone}]
        memory = lit.frame.renderer.memory
        super().__init__(unknowns, groups, guide, settings, lit.frame.seed, memory)
        self.lit = lit

    def composite(self, step: int) -> Composite:
        """Return the composite, of the same samples at every step, with the curves' prior."""
        curves = self.unknowns.curve_fg(), self.unknowns.curve_shadow()
        image = self.lit.image(self.lit.foreground, *curves)
        return Composite(image, {"bend": (self.settings.bend, bend(curves[0]) + bend(curves[1]))})

    def final_image(self, seed: int) -> Tensor:
        """Return the composite with the curves as they are; it has the samples of `LitFrame`."""
        curves = self.unknowns.curve_fg(), self.unknowns.curve_shadow()
        return self.lit.image(self.lit.foreground, *curves)

    def project(self) -> None:
        """Do nothing: the parameters of curves are unbounded."""

    def prepare(self, step: int) -> None:
        """Do nothing: the light is fixed."""

    def describe(self, camera: Camera) -> str:
        """Return the mid tones after the curves, by linear interpolation between knots."""
        fg, shadow = self.unknowns.curve_fg.plain(), self.unknowns.curve_shadow.plain()
        shown = np.interp(0.5, fg.x[0], fg.y[0])
        ratios = (f"{np.interp(0.5, x, y):.2f}" for x, y in zip(shadow.x, shadow.y, strict=True))
        return f"mid tone 0.5 becomes {shown:.2f}, of the shadow {' '.join(ratios)}"


def _fixed(knots: ToneKnots) -> Knots:
    return Knots(*(torch.from_numpy(part) for part in knots.arrays()))


def _words(part: str, value: float | tuple[float, ...]) -> str:
    numbers = value if isinstance(value, tuple) else (value,)
    return f"{part.replace('_', ' ')} {' '.join(f'{number:.2f}' for number in numbers)}"


# ---------------------------------------------------------------------------------- the run


def refine(run: Run, light: SceneLight) -> Outcome:
    """Optimise what ``--refine`` names toward the prompt.

    Args:
        run: Configuration, inputs, output folder.
        light: The known light, and the tone curves to start from.

    Returns:
        Light with its curves, and the asset with its materials.

    Raises:
        InputError: As `warpir.optimize.recover.recover`.
    """
    run = replace(run, config=run.config.settled())
    asset = run.inputs.asset
    checkpoints = open_checkpoints(run)
    with run.timings.stage("scene"):
        # Curves of an earlier run belong to its tone operator.
        frame = replace(make_frame(run), is_reinhard=light.curves.tone == "reinhard")
    guided = prepare_guidance(run, checkpoints)
    with run.timings.stage("trace"):
        release()
        guide = make_guide(run, guided, frame)
        lit = LitFrame(frame, light, torch.device(run.device))
    loop = _loop_of(run, lit, light.curves, guide)
    moves = what_moves(run.config.task, asset)
    run.log.say(f"free: {', '.join(moves['free'])}; frozen: {', '.join(moves['frozen'])}")
    course = follow(run, loop, guided, guide, frame.renderer)
    with run.timings.stage("write"):
        course.write()
    notices = tuple(course.notices())
    if isinstance(loop, ToneRefinement):
        fitted = loop.unknowns.curve_fg.plain(), loop.unknowns.curve_shadow.plain()
        light = replace(light, curves=Curves(light.curves.tone, *fitted))
    else:
        refined = loop.unknowns.materials()
        run.output.write_json(MATERIALS, materials_to_json(asset.materials, refined))
        asset = replace(asset, materials=refined)
        if run.config.task.refine == "emission":
            unseen = GROUND_IS_UNSEEN if run.config.render.bounce else GROUND_IS_DARK
            notices = (*notices, unseen)
    inputs = replace(run.inputs, asset=asset)
    return Outcome(light, inputs, {**course.record("mis"), "refine": moves}, notices)


def _loop_of(
    run: Run, lit: LitFrame, curves: Curves, guide: Guide
) -> MaterialRefinement | ToneRefinement:
    """Return the loop over what ``--refine`` names, at its start."""
    task, settings, asset = run.config.task, run.config.optimize, run.inputs.asset
    if task.refine == "tone":
        return ToneRefinement(lit, guide, settings, ToneUnknowns(curves).to(run.device))
    chosen = asset.materials_named(task.refine_materials)
    unknowns = Factors(asset, chosen, free_parts(task)).to(run.device)
    return MaterialRefinement(lit, curves, guide, settings, unknowns)


def free_parts(task: TaskConfig) -> list[str]:
    """Return the fields of `Material` that ``--refine`` changes; none of them for tone."""
    chosen = {
        "material": task.refine_parts or REFINE_PARTS,
        "emission": ("emission",),
        "tone": (),
    }[task.refine or "tone"]
    return [name.replace("-", "_") for name in chosen]


def what_moves(task: TaskConfig, asset: Asset) -> dict[str, Any]:
    """Return the entry of ``run.json`` about free and frozen parameters."""
    parts = free_parts(task)
    known = ("tone curves", *LOWEST, "emission")
    free = parts or ["tone curves"]
    chosen = asset.materials_named(task.refine_materials) if parts else []
    return {
        "what": task.refine,
        "free": free,
        "frozen": ["light", *(name for name in known if name not in free)],
        "materials": [asset.materials[index].name for index in chosen],
    }
