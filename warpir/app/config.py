"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each value is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``; its field in
`warpir.app.settings` holds all there is to know about it. Angles are degrees here and at the
command line, radians everywhere inside.
"""

import math
import re
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, get_type_hints

from warpir.app.settings import (
    CameraConfig,
    GuidanceConfig,
    InputConfig,
    LightConfig,
    LookConfig,
    OptimizeSettings,
    OutputConfig,
    PlacementConfig,
    RenderConfig,
    TaskConfig,
)
from warpir.core.errors import ExitCode, InputError, raise_all
from warpir.core.limits import Limits
from warpir.core.options import Rule, is_a, plain, rule_of
from warpir.diffusion.prompts import make_prompts
from warpir.diffusion.settings import ModelSettings, PersonalizeSettings

if TYPE_CHECKING:
    from warpir.scene.asset import Asset

SKY_PRESETS = ("clear", "overcast", "sunset")
REFINE_STEPS = {"material": 300, "emission": 300, "tone": 200}
REFINE_PARTS = ("base-color", "metallic", "roughness")
DEVICE_FORM = re.compile(r"cpu|cuda(:\d+)?")
DEMO_HINT = "--demo needs neither --photo nor --asset"


@dataclass(frozen=True, init=False)
class InsertConfig:
    """One insertion: a part for each stage. Files are checked later.

    It is made by the names of the command line, ``InsertConfig(photo="a.jpg", camera_height=1.6)``;
    each part is an attribute, ``config.camera.height``.

    Raises:
        InputError: A value is out of range, or two values exclude each other
            (`ExitCode.USAGE`; further problems are in ``also``).
        TypeError: A name is unknown.
    """

    inputs: InputConfig
    camera: CameraConfig
    placement: PlacementConfig
    light: LightConfig
    render: RenderConfig
    look: LookConfig
    guidance: GuidanceConfig
    diffusion: ModelSettings
    adapter: PersonalizeSettings
    optimize: OptimizeSettings
    task: TaskConfig
    output: OutputConfig
    limits: Limits

    def __init__(self, **values: Any) -> None:
        """Check everything that can be checked without opening a file."""
        parts: dict[str, dict[str, Any]] = {part.name: {} for part in fields(InsertConfig)}
        for name, value in values.items():
            if name not in OPTIONS:
                raise TypeError(f"InsertConfig has no value {name!r}")
            parts[OPTIONS[name].part][OPTIONS[name].field] = plain(value)
        for name, given in parts.items():
            # Frozen for everybody else.
            object.__setattr__(self, name, PARTS[name](**given))
        raise_all([*_values_out_of_range(self), *_values_that_clash(self)])

    def flat(self) -> dict[str, Any]:
        """Return all values by the names that the command line and ``run.json`` use."""
        return {
            name: getattr(getattr(self, option.part), option.field)
            for name, option in OPTIONS.items()
        }

    def changed(self, **values: Any) -> "InsertConfig":
        """Return the same with other values, by the names that `InsertConfig` takes."""
        return InsertConfig(**{**self.flat(), **values})

    @property
    def is_guided(self) -> bool:
        """Whether a diffusion model guides."""
        asked, model = self.guidance.kind, self.diffusion.model
        return asked == "stable-diffusion" or (asked is None and model is not None)

    @property
    def tone_operator(self) -> str:
        """`tone`, or what stands for it; a light far from its start wants one that never clips."""
        return self.light.tone or ("reinhard" if self.is_guided else "linear")

    def settled(self) -> "InsertConfig":
        """Return the same with the steps that ``--refine`` takes where none are named."""
        if self.optimize.steps is not None or self.task.refine is None:
            return self
        return self.changed(steps=REFINE_STEPS[self.task.refine])

    def require_inputs(self) -> None:
        """Check that what every run needs is named.

        Kept apart from construction so that a notebook can build a configuration in steps.

        Raises:
            InputError: A needed value is absent (`ExitCode.USAGE`).
        """
        # The lines of a sequence may name photos and assets; each frame is checked by itself.
        is_whole = self.inputs.demo or self.task.sequence
        needed = {} if is_whole else dict.fromkeys(("photo", "asset"), DEMO_HINT)
        needed["out"] = ""
        if self.is_guided:
            needed["model"] = "--guidance stable-diffusion needs a folder or a hub id"
            needed["prompt"] = "say in a few words what the object is"
        values = self.flat()
        missing = {name: advice for name, advice in needed.items() if values[name] is None}
        raise_all([usage(flag(name), "needed", advice) for name, advice in missing.items()])


@dataclass(frozen=True)
class Option:
    """One value of a configuration."""

    part: str
    """Attribute of `InsertConfig`."""
    field: str
    """Attribute of that part."""
    kind: Any
    """Annotation."""
    default: Any
    rule: Rule


def _options() -> dict[str, Option]:
    found = {}
    for part, settings in PARTS.items():
        kinds = get_type_hints(settings)
        for field in fields(settings):
            name, rule = field.name, rule_of(field)
            flat = f"max_{name}" if part == "limits" else rule.name or name
            found[flat] = Option(part, name, kinds[name], field.default, rule)
    return found


PARTS: dict[str, Any] = {part.name: part.type for part in fields(InsertConfig)}
"""The parts' classes by their names."""
OPTIONS = _options()
"""Every value by the name that the command line, files and ``run.json`` give it."""
DOTTED = {f"{option.part}.{option.field}": name for name, option in OPTIONS.items()}
"""The same names by part and field, as ``camera.height``."""
DEFAULTS = {name: option.default for name, option in OPTIONS.items()}
"""What a value is when nobody names it."""


def flag(name: str) -> str:
    """Return a field's spelling at the command line; what is on by default is switched off."""
    return ("--no-" if DEFAULTS[name] is True else "--") + name.replace("_", "-")


def usage(where: str, what: str, advice: str = "") -> InputError:
    """Make the error of a wrong command line or configuration."""
    return InputError(where, what, advice, ExitCode.USAGE)


@contextmanager
def as_usage() -> Iterator[None]:
    """Let errors in the block be those of a wrong configuration, whatever found them."""
    try:
        yield
    except InputError as error:
        error.code = ExitCode.USAGE
        raise


LARGEST = 1e9
"""Of a coordinate [m] and of a light's strength; float32 products overflow from 10^19 on."""
LEAST_RADIUS = 1e-4
"""Of a lamp [m], as in its file (`warpir.scene.near.lamps`), which needs NumPy."""
LOSSES_OF_BASE = ("csd", "sds-base", "good-bad", "sds-good-bad", "dataset-update")
"""Losses that do without an adapter."""
LOSSES_WITHOUT_LORA = ("csd", "sds-base", "good-bad")
"""Losses that use the base model alone."""
LOSSES_AWAY = ("lds-negative", "good-bad", "sds-good-bad")
"""Losses that move away from a negative prompt."""
LIGHTS = ("light", "sun", "sky", "reuse")
"""Fields that name a light."""
OF_LIGHT = """lobes lobe_width light_height object_light_height fusion fusion_start fusion_end
lobe_shape integrator transport_memory retrace_at rate_intensity rate_axis rate_width rate_chroma
consistency spread chroma trust chroma_limit intensity_limit tone_bins"""
"""Fields that the recovery of a light alone reads."""


Check = Callable[[str, bool, str], Iterator[InputError]]
Needs = Iterator[tuple[str, bool, str]]


def _values_out_of_range(config: InsertConfig) -> Iterator[InputError]:
    def check(name: str, accepted: bool, expected: str) -> Iterator[InputError]:
        value = values[name]
        # A NaN fails every comparison and is reported as not finite.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    values = config.flat()
    of_other_kinds = []
    for name, value in values.items():
        if not is_a(value, OPTIONS[name].kind):
            expected = str(OPTIONS[name].kind).removeprefix("<class '").removesuffix("'>")
            of_other_kinds.append(usage(flag(name), f"expected {expected} (found {_shown(value)})"))
    raise_all(of_other_kinds)  # from Python alone; no other check would know what to do with them
    for name, value in values.items():
        yield from _not_plain(name, value, config.limits.prompt_bytes)
    in_order = config.optimize.fusion_end >= config.optimize.fusion_start
    yield from check("fusion_end", in_order, "at least --fusion-start")
    for name in ("place", "ground", "sun", "sky", "at", "lamp"):
        parts = values[name]
        if isinstance(parts, tuple):
            within = not any(abs(part) > LARGEST for part in parts)
            yield from check(name, within, f"numbers up to {LARGEST:g}")
    yield from _light_and_ground_problems(config, check)
    if config.render.device is not None:
        known = DEVICE_FORM.fullmatch(config.render.device) is not None
        yield from check("device", known, "cpu, cuda or cuda:N")
    if config.guidance.prompt and config.adapter.token:
        try:
            make_prompts(config.guidance.prompt, config.adapter)
        except ValueError as error:
            name, _, what = str(error).partition(": ")
            yield usage(flag(name), what)
    if config.task.refine_parts is not None:
        known = set(config.task.refine_parts) <= set(REFINE_PARTS)
        yield from check("refine_parts", known, f"some of {', '.join(REFINE_PARTS)}")
    for name, value in values.items():
        expected = OPTIONS[name].rule.problem(value) if value is not None else ""
        yield from check(name, not expected, expected)


def _light_and_ground_problems(config: InsertConfig, check: Check) -> Iterator[InputError]:
    ground, sun, sky = config.camera.ground, config.light.sun, config.light.sky
    lamp = config.light.lamp
    if lamp is not None:
        yield from check(
            "lamp", not lamp[3] < LEAST_RADIUS, f"a radius of at least {LEAST_RADIUS:g}"
        )
        yield from check("lamp", not min(lamp[4:]) < 0.0, "power and colour of at least 0")
    if ground is not None and all(map(math.isfinite, ground)):
        yield from check("ground", any(ground[:3]), "a normal a,b,c that is not 0")
    if sun is not None:
        yield from check("sun", -90.0 <= sun[1] <= 90.0, "elevation -90 to 90")
        yield from check("sun", len(sun) < 3 or sun[-1] >= 0.0, "strength at least 0")
    if isinstance(sky, tuple):
        yield from check("sky", min(sky) >= 0.0, "radiance at least 0")
    else:
        yield from check("sky", sky in SKY_PRESETS, f"{', '.join(SKY_PRESETS)} or R,G,B")


def _not_plain(name: str, value: object, prompt_limit: int) -> Iterator[InputError]:
    """Find numbers that are not finite and texts that no file or model can be asked for."""
    parts = value if isinstance(value, tuple) else (value,)
    if any(isinstance(part, float) and not math.isfinite(part) for part in parts):
        yield usage(flag(name), f"finite numbers (found {_shown(value)})")
    texts = [part for part in parts if isinstance(part, str)]
    if not parts or any("\0" in t or not (t or OPTIONS[name].rule.may_be_empty) for t in texts):
        yield usage(flag(name), "a text that is not empty and holds no NUL")
    longest = max((len(text.encode("utf-8", "replace")) for text in texts), default=0)
    if OPTIONS[name].rule.is_prompt and longest > prompt_limit:
        found = f"a text too long (found {longest} bytes; limit {prompt_limit})"
        yield usage(flag(name), f"{found}; --max-prompt-bytes raises it")


EXCLUSIVE = (
    ("demo", "photo"), ("demo", "asset"), ("demo", "camera"),
    ("camera", "fov"), ("camera", "pitch"), ("camera", "roll"), ("camera", "horizon"),
    ("camera", "camera_height"), ("pitch", "horizon"), ("ground", "ground_points"),
    ("place", "at"), ("scale", "size"),
    ("light", "sun"), ("light", "sky"), ("light", "start"), ("sun", "start"), ("sky", "start"),
    ("reuse", "start"), ("reuse", "demo"), ("reuse", "light"), ("reuse", "sun"), ("reuse", "sky"),
    ("sequence", "refine"), ("resume", "overwrite"),
)  # fmt: skip
"""Pairs of fields of which at most one may be given."""


def replaced_by(changes: Mapping[str, Any], among: Container[str]) -> dict[str, Any]:
    """Return what changes leave no room for, at its default: "at" on a line replaces --place.

    Args:
        changes: Values by their fields, which replace others.
        among: Fields that may be given up for them.
    """
    return {
        other: DEFAULTS[other]
        for pair in EXCLUSIVE
        for name, other in (pair, pair[::-1])
        if changes.get(name, DEFAULTS[name]) != DEFAULTS[name]
        and other in among
        and other not in changes
    }


def _values_that_clash(config: InsertConfig) -> Iterator[InputError]:
    values = config.flat()
    given = {name for name, value in values.items() if value != DEFAULTS[name]}
    for first, second in EXCLUSIVE:
        if {first, second} <= given:
            yield usage(flag(second), f"cannot be used with {flag(first)}", "leave one of them out")
    if "reuse" in given and config.is_guided and "refine" not in given:
        yield usage(
            "--guidance" if "guidance" in given else "--model",
            "cannot be used with --reuse, whose light is known",
            "leave one of them out, or say with --refine what is to change under that light",
        )
    if "shadow_mask" in given and config.is_guided:
        yield usage(
            "--shadow-mask",
            "cannot be used while a model changes the light or the object",
            "recover the light first, then give the mask with --reuse",
        )
    if config.light.has_lamps and config.is_guided and config.task.refine == "material":
        # What of a path's radiance comes from a lamp has no gradient to the materials.
        lamp = "--lamp" if "lamp" in given else "--lamps"
        yield usage(lamp, "cannot be used with --refine material", "leave one of them out")
    for name, fulfilled, what in (*_needs_of_scene(config, given), *_needs_of_prior(config)):
        if name in given and not fulfilled:
            yield usage(flag(name), f"needs {what}")
    if not config.adapter.personalize:
        if "show_prior" in given and config.is_guided:
            what = "cannot be used with --show-prior, which shows its effect"
            yield usage("--no-personalize", what)
        if "lora" in given:
            what = "cannot be used with --lora"
            yield usage("--no-personalize", what, "leave one of them out")
    if config.task.refine == "tone" and not config.optimize.tone_curve:
        what = "cannot be used with --refine tone, which changes nothing else"
        yield usage("--no-tone-curve", what)
    if config.render.ground_roughness != "off" and "proxy" in given:
        what = "cannot be used with --proxy: a plane mirrors the object, a mesh does not"
        yield usage("--ground-roughness", what, "leave one of them out")
    if config.render.ground_roughness == "auto" and "sequence" in given:
        what = "cannot be used with --sequence: each frame would have a roughness of its own"
        yield usage("--ground-roughness auto", what, "state the roughness")
    yield from _losses_that_clash(config)


def _needs_of_scene(config: InsertConfig, given: Container[str]) -> Needs:
    """Yield (name, whether it has what it needs, what that is) of camera, light and output."""
    # The lines of a sequence may name what its command line does not; each is checked by itself.
    has_camera, has_proxy = (name in given or "sequence" in given for name in ("camera", "proxy"))
    yield "plane", has_proxy, "--proxy, without which there is no other ground"
    yield "mitsuba", config.output.hand_off, "the files that --no-hand-off leaves out"
    yield "fit_lobes", "light" in given, "--light with a panorama to fit"
    yield "light_convention", "light" in given, "--light with a panorama"
    yield "up", has_camera, "--camera; without a camera file the world is Y up"
    for name in ("frame", "undistort", "ground_points"):
        yield name, has_camera, "--camera with a camera file"
    yield "sequence", "reuse" in given, "--reuse: one light for all frames"
    yield "fps", "sequence" in given, "--sequence, of which the video is made"
    is_demo_lit = "demo" in given and (config.guidance.kind == "none" or "refine" in given)
    is_lit = is_demo_lit or any(name in given for name in LIGHTS)
    level = "--light, --sun or --sky: with --model alone the light's level is recovered"
    yield "exposure", is_lit or not config.is_guided, level
    is_turned = "light" in given or "reuse" in given or is_demo_lit
    yield "light_rotate", is_turned, "--light or --reuse; of --sun, give another azimuth"
    yield "refine", is_lit, "a known light: --reuse, --light, --sun or --sky"


def _needs_of_prior(config: InsertConfig) -> Needs:
    """As `_needs_of_scene`, of what a model is asked."""
    guided = config.is_guided
    yield "show_prior", guided, "--model"
    yield "resume", guided, "--model: nothing else has checkpoints"
    is_judged = guided and config.task.refine is None
    yield "accept", is_judged, "--model without --refine: it judges a light that is recovered"
    is_recovering = guided and config.task.refine is None and config.light.has_lamps
    yield "recover_lamps", is_recovering, "--lamp or --lamps, and --model without --refine"
    yield "refine", guided, "--model, which judges the change"
    yield "refine_parts", config.task.refine == "material", "--refine material"
    with_materials = config.task.refine in ("material", "emission")
    yield "refine_materials", with_materials, "--refine material or emission"


def _losses_that_clash(config: InsertConfig) -> Iterator[InputError]:
    """Find what a loss lacks, and ranges that are empty."""
    asked, loss = config.guidance, config.guidance.loss
    if config.is_guided and not config.adapter.personalize and loss not in LOSSES_OF_BASE:
        yield usage(
            "--no-personalize",
            f"cannot be used with --loss {loss}, which compares the adapted model",
            f"add --loss {' or '.join(LOSSES_OF_BASE)}, or leave it out",
        )
    if loss in LOSSES_AWAY and not asked.negative_prompt:
        yield usage("--loss", f"{loss} needs --negative-prompt, which it moves away from")
    if asked.accept and loss == "dataset-update":
        yield usage("--accept", "cannot be used with --loss dataset-update, which has no potential")
    ends = ("time_min", "time_max_end"), ("time_max_end", "time_max")
    for low, high in (("time_min", "time_max"), *ends, ("crop_min", "crop_max")):
        least, greatest = getattr(asked, low), getattr(asked, high)
        if least > greatest:
            yield usage(flag(low), f"at most {flag(high)} (found {least:g} and {greatest:g})")


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        value = ",".join(f"{p:g}" if isinstance(p, int | float) else str(p) for p in value)
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."


def refused_refinement(config: InsertConfig, asset: "Asset") -> Iterator[InputError]:
    """Yield why ``--refine`` cannot change the asset as it is asked to."""
    found = ", ".join(dict.fromkeys(ascii(m.name) for m in asset.materials))[:400]
    for name in config.task.refine_materials or ():
        if not asset.materials_named([name]):
            what = f"no material {name[:60]!a} in {config.inputs.asset} (found {found})"
            yield usage("--refine-materials", what, "name some of these, or leave it out for all")
    if config.task.refine in ("material", "emission"):
        for m in asset.materials:
            if m.is_solid_glass:
                # What comes through glass has no gradient to the materials.
                what = f"cannot be used with the solid glass {m.name[:60]!a} in the object"
                yield usage("--refine", what, "leave one of them out")
                return
    if config.task.refine == "material" and config.task.refine_parts != ("roughness",):
        for index in asset.materials_named(config.task.refine_materials):
            m = asset.materials[index]
            if m.transmission > 0.0:
                # Both change which rays pass a thin wall, and a decision has no derivative.
                what = f"changes no base color and no metallic of the thin glass {m.name[:60]!a}"
                advice = "name other materials by --refine-materials, or --refine-parts roughness"
                yield usage("--refine", what, advice)
                return


READ_ANYWAY = ("guidance", "model", "preview_every", "guidance_width")
"""Fields of a model's parts that say something without one: two are those of the preview."""


def fields_of(part: str) -> list[str]:
    """Return the fields of a part that only a model reads."""
    named = [name for name, o in OPTIONS.items() if o.part == part and not o.rule.by_hand]
    return [name for name in named if name not in READ_ANYWAY]


def unread_by_loss(config: InsertConfig) -> Iterator[tuple[str, str]]:
    """Yield a reason, and the fields of what a model is asked that nothing reads for it."""
    loss, adapter = config.guidance.loss, config.adapter
    is_away, is_edit = loss in LOSSES_AWAY, loss == "dataset-update"
    is_shown, without_lora = bool(config.guidance.show_prior), loss in LOSSES_WITHOUT_LORA
    is_read = {
        "negative_prompt": is_away,
        "guidance_scale": loss in ("sds", "sds-base"),
        "null_prompt": not (is_away or is_edit),
        "base_prompt": without_lora or (loss == "sds-good-bad" and not adapter.personalize),
        "update_every update_steps update_scale": is_edit,
        "noises weight literal_alpha time_min": not is_edit,
        "lora": is_shown or not without_lora,
    }
    yield f"with --loss {loss}", " ".join(names for names, read in is_read.items() if not read)
    is_trained = is_shown or (adapter.lora is None and not without_lora)
    if not (adapter.personalize and is_trained):
        of_training = {*fields_of("adapter")} - {"personalize", "token", "lora"}
        yield "where no LoRA is trained", " ".join(sorted(of_training))


def unread_by_loop(config: InsertConfig) -> Iterator[tuple[str, str]]:
    """As `unread_by_loss`, of how a light is recovered or an object refined."""
    refine, optimize = config.task.refine, config.optimize
    rates = {"material": "rate_material", "emission": "rate_emission"}
    others = " ".join(rate for what, rate in rates.items() if what != refine)
    if refine is not None:
        others += " mis_samples" if refine == "tone" else " tone_curve rate_tone bend"
        yield f"with --refine {refine}", f"{OF_LIGHT} {others}"
        return
    yield "without --refine", others
    names = "transport_memory object_light_height retrace_at"
    names = names if optimize.integrator == "mis" else "mis_samples"
    yield f"with --integrator {optimize.integrator}", names
    if optimize.fusion != "schedule":
        terms = " consistency spread" if optimize.fusion == "single" else ""
        yield f"with --fusion {optimize.fusion}", f"fusion_start fusion_end{terms}"
    if config.light.is_described:
        yield "where a light is given", "lobe_width trust"
    elif config.light.start == "uniform":
        yield "with --start uniform", "trust"
    else:
        yield "where the light is estimated from the photo", "lobes lobe_width"
