"""What one insertion is asked to do: `InsertConfig`, plain values only.

Each value is one flag of the command line (``camera_height`` is ``--camera-height``), one key of a
configuration file and one entry under ``config`` in ``run.json``; its field in
`warpir.app.settings` holds all there is to know about it. Angles are degrees here and at the
command line, radians everywhere inside.
"""

import math
import re
from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, get_type_hints

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
from warpir.diffusion.settings import (
    GuidanceSettings,
    ModelSettings,
    PersonalizeSettings,
)

SKY_PRESETS = ("clear", "overcast", "sunset")
REFINE_STEPS = {"material": 300, "emission": 300, "tone": 200}
REFINE_PARTS = ("base-color", "metallic", "roughness")
DEVICE_FORM = re.compile(r"cpu|cuda(:\d+)?")
DEMO_HINT = "--demo needs neither --photo nor --asset"
EMBEDDED_STEPS = 60
"""Steps with which the embedded prior was tried; it is not asked unless --steps says so."""


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
    def guided_by(self) -> str:
        """``guidance``, or what stands for it: embedded, stable-diffusion or none."""
        if self.guidance.kind is not None:
            return self.guidance.kind
        if self.diffusion.model is not None:
            return "stable-diffusion"
        is_lit = self.light.reuse is not None or self.light.is_described
        return "none" if is_lit else "embedded"

    @property
    def is_guided(self) -> bool:
        """Whether a prior is asked: the embedded one is where `steps` says how often."""
        return self.guided_by == "stable-diffusion" or (
            self.guided_by == "embedded" and bool(self.optimize.steps)
        )

    @property
    def tone_operator(self) -> str:
        """`tone`, or what stands for it; a light far from its start wants one that never clips."""
        return self.light.tone or PRIOR_DEFAULTS.get(self.guided_by, {"tone": "linear"})["tone"]

    def settled(self, on_cuda: bool = True) -> "InsertConfig":
        """Return the same with nothing left open to the prior; without one, as Stable Diffusion's.

        Args:
            on_cuda: Whether it runs on a CUDA device.
        """
        return self.changed(**_open_values(self, on_cuda))

    def guidance_settings(self) -> GuidanceSettings:
        """Return what guidance is asked to do; nothing may be open (`settled`)."""
        names = (field.name for field in fields(GuidanceSettings))
        return GuidanceSettings(**{name: getattr(self.guidance, name) for name in names})

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
        if self.guided_by == "stable-diffusion":
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
PRIOR_DEFAULTS: dict[str, dict[str, Any]] = {
    prior: {
        name: getattr(option.rule, prior.replace("-", "_"))
        for name, option in OPTIONS.items()
        if option.rule.embedded is not None
    }
    for prior in ("stable-diffusion", "embedded")
}
"""What a value that is None stands for, by the prior that guides.

The embedded prior's are those for which its potential is least biased
(benchmarks/light/probe.py): the photo's own share in what it expects, at noise levels of .76 to
.99. One light and no curves: a small prior cannot tell more apart, and it learnt from photos that
are clipped, not bent.
"""
CPU_DEFAULTS: dict[str, dict[str, Any]] = {
    "stable-diffusion": {},
    "embedded": {
        name: option.rule.embedded_on_cpu
        for name, option in OPTIONS.items()
        if option.rule.embedded_on_cpu is not None
    },
}
"""What it stands for on the CPU, where that differs."""


def _open_values(config: InsertConfig, on_cuda: bool = True) -> dict[str, Any]:
    """Return what stands for the fields that are open; without a prior, Stable Diffusion's."""
    prior = config.guided_by if config.guided_by in PRIOR_DEFAULTS else "stable-diffusion"
    chosen = PRIOR_DEFAULTS[prior] | ({} if on_cuda else CPU_DEFAULTS[prior])
    if config.task.refine in REFINE_STEPS:
        chosen |= {"steps": REFINE_STEPS[config.task.refine], "accept": False}
    if config.adapter.lora is not None:
        chosen |= {"personalize": True}
    if prior == "embedded" and (config.adapter.lora is not None or config.adapter.personalize):
        chosen |= {"loss": "sds"}  # the same, asked of the adapted model
    if config.guidance.loss == "dataset-update":
        chosen |= {"accept": False}
    if not config.is_guided:
        del chosen["accept"]  # there is no end that could be judged
    values = config.flat()
    # The tone belongs to the light: `InsertConfig.tone_operator`.
    return {k: v for k, v in chosen.items() if k != "tone" and values[k] is None}


def flag(name: str) -> str:
    """Return a field's spelling at the command line; what is on by default is switched off."""
    return ("--no-" if DEFAULTS[name] is True else "--") + name.replace("_", "-")


def usage(where: str, what: str, advice: str = "") -> InputError:
    """Make the error of a wrong command line or configuration."""
    return InputError(where, what, advice, ExitCode.USAGE)


LARGEST = 1e9
"""Of a coordinate [m] and of a light's strength; float32 products overflow from 10^19 on."""
LOSSES_OF_BASE = ("csd", "sds-base", "good-bad", "sds-good-bad", "dataset-update")
"""Losses that do without an adapter."""
LOSSES_AWAY = ("lds-negative", "good-bad", "sds-good-bad")
"""Losses that move away from a negative prompt."""
LIGHTS = ("light", "sun", "sky", "reuse")
"""Fields that name a light."""


Check = Callable[[str, bool, str], Iterator[InputError]]
Needs = Iterator[tuple[str, bool, str]]


def _values_out_of_range(config: InsertConfig) -> Iterator[InputError]:
    def check(name: str, accepted: bool, expected: str) -> Iterator[InputError]:
        value = values[name]
        # A NaN fails every comparison and is reported as not finite.
        if value is not None and value == value and not accepted:
            yield usage(flag(name), f"{expected} (found {_shown(value)})")

    values = config.flat()
    of_other_kinds = [name for name, value in values.items() if not is_a(value, OPTIONS[name].kind)]
    for name in of_other_kinds:
        expected = str(OPTIONS[name].kind).removeprefix("<class '").removesuffix("'>")
        yield usage(flag(name), f"expected {expected} (found {_shown(values[name])})")
    if of_other_kinds:
        return  # from Python alone, and no other check would know what to do with them
    for name, value in values.items():
        yield from _not_plain(name, value, config.limits.prompt_bytes)
    in_order = config.optimize.fusion_end >= config.optimize.fusion_start
    yield from check("fusion_end", in_order, "at least --fusion-start")
    for name in ("place", "ground", "sun", "sky", "at"):
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
    ("demo", "photo"),
    ("demo", "asset"),
    ("demo", "camera"),
    ("camera", "fov"),
    ("camera", "pitch"),
    ("camera", "horizon"),
    ("camera", "camera_height"),
    ("pitch", "horizon"),
    ("ground", "ground_points"),
    ("place", "at"),
    ("scale", "size"),
    ("light", "sun"),
    ("light", "sky"),
    ("light", "start"),
    ("sun", "start"),
    ("sky", "start"),
    ("reuse", "start"),
    ("reuse", "demo"),
    ("reuse", "light"),
    ("reuse", "sun"),
    ("reuse", "sky"),
    ("sequence", "refine"),
    ("resume", "overwrite"),
)
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
        if changes.get(name) is not None and other in among and other not in changes
    }


def _values_that_clash(config: InsertConfig) -> Iterator[InputError]:
    values = config.flat()
    given = {name for name, value in values.items() if value != DEFAULTS[name]}
    for first, second in EXCLUSIVE:
        if {first, second} <= given:
            yield usage(flag(second), f"cannot be used with {flag(first)}", "leave one of them out")
    if "reuse" in given and config.guided_by != "none" and "refine" not in given:
        yield usage(
            "--guidance" if "guidance" in given else "--model",
            "cannot be used with --reuse, whose light is known",
            "leave one of them out, or say with --refine what is to change under that light",
        )
    if "shadow_mask" in given and config.is_guided:
        yield usage(
            "--shadow-mask",
            "cannot be used while a prior changes the light or the object",
            "recover the light first, then give the mask with --reuse",
        )
    for name, fulfilled, what in (*_needs_of_scene(config, given), *_needs_of_prior(config, given)):
        if name in given and not fulfilled:
            yield usage(flag(name), f"needs {what}")
    if config.adapter.personalize is False:
        if "show_prior" in given and config.guided_by == "stable-diffusion":
            what = "cannot be used with --show-prior, which shows its effect"
            yield usage("--no-personalize", what)
        if "lora" in given:
            what = "cannot be used with --lora"
            yield usage("--no-personalize", what, "leave one of them out")
    if config.task.refine == "tone" and config.optimize.tone_curve is False:
        what = "cannot be used with --refine tone, which changes nothing else"
        yield usage("--no-tone-curve", what)
    yield from _losses_that_clash(config)


def _needs_of_scene(config: InsertConfig, given: Container[str]) -> Needs:
    """Yield (name, whether it has what it needs, what that is) of camera, light and output."""
    yield "plane", "proxy" in given, "--proxy, without which there is no other ground"
    yield "mitsuba", config.output.hand_off, "the files that --no-hand-off leaves out"
    yield "fit_lobes", "light" in given, "--light with a panorama to fit"
    yield "light_convention", "light" in given, "--light with a panorama"
    yield "up", "camera" in given, "--camera; without a camera file the world is Y up"
    for name in ("frame", "undistort", "ground_points"):
        yield name, "camera" in given, "--camera with a camera file"
    yield "sequence", "reuse" in given, "--reuse: one light for all frames"
    yield "fps", "sequence" in given, "--sequence, of which the video is made"
    is_demo_lit = "demo" in given and (config.guided_by == "none" or "refine" in given)
    is_lit = is_demo_lit or any(name in given for name in LIGHTS)
    level = "--light, --sun or --sky: with --guidance alone the light's level is recovered"
    yield "exposure", is_lit or not config.is_guided, level
    is_turned = "light" in given or "reuse" in given or is_demo_lit
    yield "light_rotate", is_turned, "--light or --reuse; of --sun, give another azimuth"
    yield "refine", is_lit, "a known light: --reuse, --light, --sun or --sky"


def _needs_of_prior(config: InsertConfig, given: Container[str]) -> Needs:
    """As `_needs_of_scene`, of what a prior is asked."""
    with_words = config.guided_by == "stable-diffusion"
    yield "show_prior", with_words, "--guidance stable-diffusion and its --model"
    asks = f"--guidance with a prior (--model, or --steps {EMBEDDED_STEPS} for the embedded one)"
    yield "resume", config.is_guided, f"{asks}: nothing else has checkpoints"
    steps = f"--guidance embedded and --steps {EMBEDDED_STEPS}: the prior is not asked without"
    yield "prior", config.is_guided and not with_words, steps
    yield "accept", config.is_guided, f"{asks}, whose result it judges"
    who_judges = "--guidance stable-diffusion, which judges the change: no other knows colours"
    yield "refine", with_words, who_judges
    yield "refine_parts", config.task.refine == "material", "--refine material"
    with_materials = config.task.refine in ("material", "emission")
    yield "refine_materials", with_materials, "--refine material or emission"


def _losses_that_clash(config: InsertConfig) -> Iterator[InputError]:
    """Find what a loss lacks, and ranges that are empty; with what is open as the prior has it."""
    made = {**config.flat(), **_open_values(config)}
    loss = made["loss"]
    if config.guided_by != "none" and not made["personalize"] and loss not in LOSSES_OF_BASE:
        losses = " or ".join(LOSSES_OF_BASE)
        if config.adapter.personalize is False:
            yield usage(
                "--no-personalize",
                f"cannot be used with --loss {loss}, which compares the adapted model",
                f"add --loss {losses}, or leave it out",
            )
        else:
            what = f"{loss} compares the adapted model"
            yield usage("--loss", what, f"add --personalize, or choose {losses}")
    says_itself = config.guided_by == "embedded" or config.guidance.negative_prompt
    if loss in LOSSES_AWAY and not says_itself:
        yield usage("--loss", f"{loss} needs --negative-prompt, which it moves away from")
    if config.guidance.accept and loss == "dataset-update":
        yield usage("--accept", "cannot be used with --loss dataset-update, which has no potential")
    for low, high in (("time_min", "time_max"), ("crop_min", "crop_max")):
        least, greatest = made[low], made[high]
        if least > greatest:
            yield usage(flag(low), f"at most {flag(high)} (found {least:g} and {greatest:g})")


def _shown(value: object) -> str:
    if isinstance(value, tuple):
        value = ",".join(f"{p:g}" if isinstance(p, int | float) else str(p) for p in value)
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
