"""Light of a run: given, estimated from the photo or recovered, with the photo's detail.

torch and the networks are imported where they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpir.app.run import Run
from warpir.core.memory import no_collection, release
from warpir.lighting.scene_light import SceneLight
from warpir.render.determinism import fixed_arithmetic


@dataclass(frozen=True)
class LitRun:
    """A run whose light is known."""

    run: Run
    """The run, with the asset and the lamps of the final render."""
    light: SceneLight
    measured: dict[str, Any]
    """Entries of ``run.json`` about the light's origin."""


def find_light(run: Run, given: SceneLight | None) -> LitRun:
    """Return the run with its light, without the photo's detail.

    Args:
        run: On its device.
        given: Light of a file or of flags; None to estimate it from the photo.

    Raises:
        InputError: As `warpir.optimize.recover.recover`.
    """
    if run.config.is_guided:
        with run.progress, fixed_arithmetic(run.device, run.config.render.deterministic):
            lit = _guided(run, given)
        with run.timings.stage("scene"):  # frees the memory of guidance
            release()
        return lit
    light, measured = given, dict[str, Any]()
    if light is None:
        light, measured = _estimated(run)
    if run.inputs.shadow_mask is not None and not light.has_lamps:
        run.log.notice("the light has no lamp that --shadow-mask could take")
    return LitRun(run, light, measured)


def _guided(run: Run, given: SceneLight | None) -> LitRun:
    """Recover the light by guidance, or refine the object under the given light."""
    if run.config.task.refine is None:
        from warpir.optimize.recover import recover

        outcome = recover(run, given)
    else:
        from warpir.optimize.materials import refine

        assert given is not None  # the configuration names it
        outcome = refine(run, given)
    run.log.notice(*outcome.notices)
    return LitRun(replace(run, inputs=outcome.inputs), outcome.light, outcome.record)


def _estimated(run: Run) -> tuple[SceneLight, dict[str, Any]]:
    """Estimate the light from the photo; return it and its entry in ``run.json``."""
    with no_collection(), run.timings.stage("regress"):
        from warpir.lighting.estimate import estimate_light

        config = run.config
        estimate = estimate_light(run.inputs, config.light, config.tone_operator)
    run.log.assume(*estimate.light.assumed)
    return estimate.light, estimate.record()


def with_photo_detail(lit: LitRun) -> LitRun:
    """Return the run with the photo's detail in its light, unless a panorama has its own."""
    run, light = lit.run, lit.light
    has_own = run.config.light.file is not None and light.light.lobes is None
    if run.inputs.run is not None:  # the earlier run's light may have detail of its own
        has_own = not Path(run.inputs.run.path, "envmap_detail.exr").exists()
    if not run.config.light.detail or has_own:
        return lit
    from warpir.lighting.detail import detail_of, with_detail

    detail = detail_of(run.inputs, light.curves)
    light = replace(light, detailed=with_detail(light.light, detail))
    run.log.say(
        f"detail: the photo shows {100.0 * detail.seen:.0f} % of what is round the object, which "
        "may be reflected in it (--no-detail)"
    )
    return replace(lit, light=light, measured={**lit.measured, "detail_seen": detail.seen})
